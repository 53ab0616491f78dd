//! Contact problems solved with any method of liblavender, and judged. A solver owns its memory and is `Send`; errors are
//! values with the library's own text.
pub use lavender_sys as sys;

use std::ffi::CStr;
use std::fmt;

#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Error(pub i32);

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // SAFETY: lav_text returns a string of static life for every code.
        f.write_str(unsafe { CStr::from_ptr(sys::lav_text(self.0)) }.to_str().unwrap_or("?"))
    }
}

impl fmt::Debug for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.0, self)
    }
}

impl std::error::Error for Error {}

fn check(code: i32) -> Result<i32, Error> {
    if code < 0 { Err(Error(code)) } else { Ok(code) }
}

/// Does this build have the bits of the package?
pub fn self_test() -> Result<(), Error> {
    check(unsafe { sys::lav_self_test() }).map(|_| ())
}

/// Hash of the bits of numbers.
pub fn hash(x: &[f64], seed: u64) -> u64 {
    unsafe { sys::lav_hash(x.as_ptr(), x.len() as i32, seed) }
}

/// The usual options of a method, `sys::LAV_ANDERSON` for one.
pub fn options(method: i32) -> Result<sys::lav_options, Error> {
    let mut out = std::mem::MaybeUninit::uninit();
    check(unsafe { sys::lav_default_options(method, out.as_mut_ptr()) })?;
    Ok(unsafe { out.assume_init() })
}

/// So many iterations at most, to this relative residual; 0: exactly so many.
pub fn budget(iterations: i32, tol: f64) -> sys::lav_budget {
    let mut out = std::mem::MaybeUninit::<sys::lav_budget>::uninit();
    let mut made = unsafe {
        sys::lav_default_budget(out.as_mut_ptr());
        out.assume_init()
    };
    (made.iterations, made.tol) = (iterations, tol);
    made
}

#[derive(Clone, Copy, Default)]
pub struct Body {
    pub inv_mass: f64,         // 1/kg
    pub inv_inertia: [f64; 9], // 1/(kg m^2), world
    pub velocity: [f64; 6],    // m/s, rad/s, without constraint impulses
}

/// A contact of three rows; bodies -1 are the world, the normal points from a to b.
#[derive(Clone, Copy, Default)]
pub struct Contact {
    pub key: u64,
    pub bodies: [i32; 2],
    pub normal: [f64; 3],
    pub tangent: [f64; 3],
    pub arm_a: [f64; 3],
    pub arm_b: [f64; 3],
    pub target: [f64; 3], // m/s: -gap / dt on the normal
    pub mu: f64,
}

pub struct Solver {
    options: sys::lav_options,
    memory: Vec<u64>,
    at: *mut sys::lav_solver,
    rows: usize,
    bodies: usize,
}

// SAFETY: everything a solver points to lies in its own memory, and every method takes &mut self.
unsafe impl Send for Solver {}

impl Solver {
    pub fn new(options: sys::lav_options) -> Self {
        Solver { options, memory: Vec::new(), at: std::ptr::null_mut(), rows: 0, bodies: 0 }
    }

    fn open(&mut self, problem: &sys::lav_problem, needed: u64) -> Result<(), Error> {
        let mut bytes = 0;
        check(unsafe { sys::lav_room(problem, &self.options, &mut bytes) })?;
        self.memory = vec![0; bytes.max(needed) as usize / 8 + 2];
        self.at = std::ptr::null_mut();
        let room = 8 * self.memory.len() as u64;
        check(unsafe { sys::lav_open(self.memory.as_mut_ptr().cast(), room, problem, &self.options, &mut self.at) }).map(|_| ())
    }

    /// The problem of a step; impulses are carried from contacts of the same key, and start anew where memory has to grow.
    pub fn set(&mut self, bodies: &[Body], contacts: &[Contact]) -> Result<(), Error> {
        let flat = |pick: fn(&Contact) -> [f64; 3]| contacts.iter().flat_map(pick).collect::<Vec<f64>>();
        let ptr: Vec<i32> = (0..=contacts.len() as i32).map(|i| 3 * i).collect();
        let kind = vec![sys::LAV_CONTACT; contacts.len()];
        let pair: Vec<i32> = contacts.iter().flat_map(|c| c.bodies).collect();
        let key: Vec<u64> = contacts.iter().map(|c| c.key).collect();
        let mu: Vec<f64> = contacts.iter().map(|c| c.mu).collect();
        let (normal, tangent, target) = (flat(|c| c.normal), flat(|c| c.tangent), flat(|c| c.target));
        let (arm_a, arm_b) = (flat(|c| c.arm_a), flat(|c| c.arm_b));
        let mass: Vec<f64> = bodies.iter().map(|b| b.inv_mass).collect();
        let inertia: Vec<f64> = bodies.iter().flat_map(|b| b.inv_inertia).collect();
        let velocity: Vec<f64> = bodies.iter().flat_map(|b| b.velocity).collect();
        let mut out = std::mem::MaybeUninit::<sys::lav_problem>::uninit();
        check(unsafe { sys::lav_default_problem(sys::LAV_BODIES, out.as_mut_ptr()) })?;
        let mut q = unsafe { out.assume_init() };
        (q.n_bodies, q.n_blocks, q.n_rows) = (bodies.len() as i32, contacts.len() as i32, 3 * contacts.len() as i32);
        (q.block_ptr, q.kind, q.contact_body, q.key) = (ptr.as_ptr(), kind.as_ptr(), pair.as_ptr(), key.as_ptr());
        (q.mu, q.target, q.velocity) = (mu.as_ptr(), target.as_ptr(), velocity.as_ptr());
        (q.inv_mass, q.inv_inertia) = (mass.as_ptr(), inertia.as_ptr());
        (q.normal, q.tangent, q.arm_a, q.arm_b) = (normal.as_ptr(), tangent.as_ptr(), arm_a.as_ptr(), arm_b.as_ptr());
        if self.at.is_null() {
            self.open(&q, 0)?;
        }
        // SAFETY: the arrays above live until this function returns, and lav_set copies them.
        let mut code = unsafe { sys::lav_set(self.at, &q) };
        for _ in 0..40 {
            if code != sys::LAV_ERROR_ROOM {
                break;
            }
            let needed = unsafe { sys::lav_needed(self.at) };
            self.open(&q, needed)?;
            code = unsafe { sys::lav_set(self.at, &q) };
        }
        (self.rows, self.bodies) = (q.n_rows as usize, bodies.len());
        check(code).map(|_| ())
    }

    pub fn run(&mut self, budget: &sys::lav_budget) -> Result<sys::lav_result, Error> {
        let mut out: sys::lav_result = unsafe { std::mem::zeroed() };
        out.size = std::mem::size_of::<sys::lav_result>() as u32;
        check(unsafe { sys::lav_run(self.at, budget, &mut out) })?;
        Ok(out)
    }

    /// (3 contacts) N s
    pub fn impulse(&mut self) -> Result<Vec<f64>, Error> {
        let mut out = vec![0.0; self.rows];
        check(unsafe { sys::lav_impulse(self.at, out.as_mut_ptr(), self.rows as i32) })?;
        Ok(out)
    }

    /// v+ (6 bodies) m/s, rad/s
    pub fn velocity(&mut self) -> Result<Vec<f64>, Error> {
        let mut out = vec![0.0; 6 * self.bodies];
        check(unsafe { sys::lav_velocity(self.at, out.as_mut_ptr(), 6 * self.bodies as i32) })?;
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_build_has_the_bits_of_the_package() {
        self_test().unwrap();
    }

    #[test]
    fn what_is_wrong_comes_back_as_text() {
        let mut solver = Solver::new(options(sys::LAV_SEQUENTIAL_IMPULSES).unwrap());
        assert!(solver.run(&budget(1, 0.0)).is_err());
        let error = solver.set(&[], &[Contact { bodies: [-1, 7], ..Default::default() }]).unwrap_err();
        assert_eq!(error.0, sys::LAV_ERROR_INDEX);
        assert!(error.to_string().contains("out of range"));
    }
}
