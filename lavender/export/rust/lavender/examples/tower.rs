//! The tower of tower.c in Rust: the same bits.
use lavender::{budget, hash, options, self_test, sys, Body, Contact, Error, Solver};

const BOXES: usize = 8;

fn main() -> Result<(), Error> {
    let dt = 1.0 / 64.0;
    let side = [[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]];
    self_test()?;
    let mut solver = Solver::new(options(sys::LAV_SEQUENTIAL_IMPULSES)?);
    let (mut x, mut v) = (vec![0.0; 3 * BOXES], vec![0.0; 6 * BOXES]);
    let mut result = None;
    for i in 0..BOXES {
        (x[3 * i], x[3 * i + 1], x[3 * i + 2]) = (0.0625 * (i % 3) as f64, 0.03125 * (i % 2) as f64, 0.5 + i as f64);
    }
    for _ in 0..120 {
        let (mut bodies, mut contacts) = (Vec::new(), Vec::new());
        for i in 0..BOXES {
            v[6 * i + 2] -= 9.75 * dt;
            let mut body = Body { inv_mass: 1.0, ..Default::default() };
            body.velocity.copy_from_slice(&v[6 * i..6 * i + 6]);
            for k in 0..3 {
                body.inv_inertia[4 * k] = 6.0;
            }
            bodies.push(body);
            for corner in 0..4 {
                // on what is below
                let mut c = Contact { key: (4 * i + corner) as u64, bodies: [i as i32 - 1, i as i32], mu: 0.5, ..Default::default() };
                (c.normal[2], c.tangent[0]) = (1.0, 1.0);
                for k in 0..3 {
                    c.arm_b[k] = if k == 2 { -0.5 } else { side[corner][k] };
                    c.arm_a[k] = if i == 0 { 0.0 } else { x[3 * i + k] + c.arm_b[k] - x[3 * i - 3 + k] };
                }
                let below = if i == 0 { 0.0 } else { x[3 * i - 1] + 0.5 };
                c.target[0] = -(x[3 * i + 2] - 0.5 - below) / dt; // -gap / dt
                contacts.push(c);
            }
        }
        solver.set(&bodies, &contacts)?;
        result = Some(solver.run(&budget(1000, 1e-6))?);
        v = solver.velocity()?;
        for i in 0..BOXES {
            for k in 0..3 {
                x[3 * i + k] += dt * v[6 * i + k];
            }
        }
    }
    if let Some(r) = result {
        println!("{} sweeps, residual {:.2e}, floor {:.0e}, worst row {}", r.sweeps, r.verdict.relative, r.verdict.floor, r.verdict.worst);
    }
    println!("{:016x}", hash(&v, hash(&x, 0)));
    Ok(())
}
