"""Legal problems that are as unpleasant as they can be, and a run of one solver over them under a watchdog.

    python hostile.py SOLVER,SOLVER FIRST END     what each solver made of the problems FIRST .. END - 1

The watchdog is a thread of C: a solve that hangs, also inside a kernel, ends the process with its tracebacks.
"""

import faulthandler
import json
import math
import sys
import traceback
import warnings

import numpy as np
from random_problems import random_contact_problem

import lavender as lv

# s that one solve may take. Every solve here ends in milliseconds on an idle machine, a backend's first in a second.
PATIENCE = 60.0
SIZES = (1e-320, 1e-310, 1e-300, 1e-154, 1e-150, 1e-30, 1.0, 1e30, 1e150, 1e154, 1e300, 1e306)


def one_contact(rng):
    """b = 0 and a start that is not: doing nothing is the answer, and every reference of the judge is 0."""
    n = int(rng.integers(1, 4))
    g = rng.normal(size=(n, n + 1))
    a = g @ g.T
    if rng.random() < 0.3:
        a += 0.1 * rng.normal(size=(n, n))
    friction = str(rng.choice(["coulomb", "cone"]))
    return lv.Problem.contact(
        a, np.zeros(n), [rng.uniform(0.0, 1.5) * (n > 1)], friction=friction
    ), rng.normal(size=n)


def scaled_matrix(rng):
    """A and b of sizes that overflow or vanish when they meet."""
    n = int(rng.integers(1, 7))
    g = rng.normal(size=(n, int(rng.integers(1, n + 2))))
    with np.errstate(all="ignore"):
        a = np.clip(np.nan_to_num(g @ g.T * rng.choice(SIZES)), -1e307, 1e307)
        b = np.clip(np.nan_to_num(rng.normal(size=n) * rng.choice(SIZES, size=n)), -1e307, 1e307)
        if rng.random() < 0.3:
            root = np.sqrt(rng.choice(SIZES[1:], size=n))
            a = np.clip(root[:, None] * a * root, -1e307, 1e307)
        if rng.random() < 0.3:
            a[rng.integers(n)] = 0.0
        if rng.random() < 0.2:
            a = -a
        if rng.random() < 0.2:
            a[rng.integers(n), rng.integers(n)] *= 0.5
    return bounded(rng, a, b), rng.normal(size=n) * rng.choice(SIZES[2:-1])


def bounded(rng, a, b):
    n = len(b)
    kind = rng.integers(6)
    if kind == 0:
        return lv.Problem.linear(a, b)
    if kind == 1:
        return lv.Problem.lcp(a, b)
    if kind == 2:
        low = np.where(rng.random(n) < 0.5, -rng.choice(SIZES, size=n), -np.inf)
        high = np.where(rng.random(n) < 0.5, rng.choice(SIZES, size=n), np.inf)
        return lv.Problem.lcp(a, b, low, np.where(rng.random(n) < 0.2, np.maximum(low, -1e300), high))
    if kind == 3:
        return lv.Problem.lcp(a, b, 0.0, rng.choice([0.0, 1e-320, 1e300, np.inf]))
    friction = str(rng.choice(["coulomb", "cone"]))
    mu = [float(rng.choice([0.0, 1e-320, 1e-150, 0.5, 1e150, 1e300]))]
    if n in (3, 4) and rng.random() < 0.5:
        return lv.Problem.contact(a, b, mu, [float(rng.choice([0.0, 1e-300, 0.1, 1e300]))], friction=friction)
    if 1 < n <= 3:
        return lv.Problem.contact(a, b, mu, friction=friction)
    return lv.Problem.contact(a, b, np.zeros(n), friction=friction)


def scaled_rows(rng):
    """Bodies, arms and compliance of absurd sizes; pinned bodies; velocities near overflow."""
    base = random_contact_problem(
        int(rng.integers(2**31)), friction=str(rng.choice(["coulomb", "cone"])),
        bodies=4, joints=int(rng.integers(0, 3)), contacts=int(rng.integers(0, 5)),
        spin=bool(rng.integers(2)),
    )  # fmt: skip
    r = base.rows
    with np.errstate(all="ignore"):
        mass = rng.choice(SIZES, size=4) if rng.random() < 0.5 else np.full(4, rng.choice(SIZES))
        mass = np.where(rng.random(4) < 0.2, 0.0, mass)
        inertia = r.inv_inertia * np.minimum(mass, 1e300)[:, None, None]
        arm = float(rng.choice([0.0, 1e-150, 1.0, 1e75, 1e150]))
        compliance = base.compliance * (rng.choice([1e-320, 1.0, 1e300]) if rng.random() < 0.3 else 1.0)
        b = base.b * rng.choice(SIZES[:-1]) if rng.random() < 0.5 else base.b
    rows = lv.Rows(
        inv_mass=r.inv_mass * np.minimum(mass, 1e300), inv_inertia=inertia, v_free=r.v_free, jac=r.jac,
        joint_ptr=r.joint_ptr, joint_body=r.joint_body, normal=r.normal, tangent=r.tangent,
        arm_a=r.arm_a * arm, arm_b=r.arm_b * arm, contact_body=r.contact_body,
    )  # fmt: skip
    problem = lv.Problem(b, base.cones, rows=rows, friction=base.friction, compliance=compliance)
    return problem, rng.normal(size=base.m) * rng.choice([1.0, 1e-300, 1e150, 1e300])


def scaled_general(rng):
    """J and M of sizes that overflow or vanish when they meet; what the door refuses is drawn again, tamer."""
    n, c = int(rng.integers(1, 5)), int(rng.integers(0, 4))
    friction = str(rng.choice(["coulomb", "cone"]))
    tangents = int(rng.integers(0, 6 if friction == "cone" else 3))
    cones = lv.Cones.free(int(rng.integers(0, 2)))
    if c or not cones.n_rows:
        cones = cones + lv.Cones.contacts(rng.uniform(0.0, 1.5, max(c, 1)) * (tangents > 0), tangents)
    g = rng.normal(size=(n, n + 1))
    for most in (len(SIZES), 8, 0):
        sizes = np.sqrt(SIZES[1 : most or 2]) if most else np.ones(1)
        jac = (
            rng.normal(size=(cones.n_rows, n))
            * rng.choice(sizes)
            * rng.choice([1.0, 1e-3, 0.0], p=[0.8, 0.1, 0.1])
        )
        root = rng.choice(sizes, size=n if rng.random() < 0.5 else 1)
        free = rng.normal(size=n) * rng.choice(sizes)
        soft = np.full(cones.n_rows, float(rng.choice([0.0, 1e-320, 1e-3, 1e300])))
        try:
            with np.errstate(all="ignore"):
                mass = np.nan_to_num(root[:, None] * (g @ g.T + np.eye(n)) * root)
            problem = lv.Problem.from_jacobian(
                jac, mass, free, cones=cones, compliance=soft, friction=friction
            )
        except lv.InputError:
            continue
        return problem, rng.normal(size=cones.n_rows) * rng.choice(SIZES[2:-1])
    raise AssertionError("a problem near 1 was refused")


def reported(rng):
    """What once hung or broke."""
    which = int(rng.integers(5))
    if which == 0:
        a = [[3, -0.15, -0.05], [-0.15, 1.75, 0.08], [-0.05, 0.08, 1.75]]
        return lv.Problem.contact(a, np.zeros(3), mu=[0.5]), np.array([-0.6, 0.5, 0.4])
    if which == 1:
        return lv.Problem.lcp(1e-150 * np.eye(2), [1e300, -1e300]), None
    if which == 2:
        return lv.Problem.linear(1e-310 * np.eye(2), [1.0, 1.0]), None
    if which == 3:
        return lv.Problem.lcp(np.eye(3) * 1e-320, [1.0, -1.0, 1e299]), np.array([1e299, 0.0, 1.0])
    return lv.Problem.lcp(np.zeros((0, 0)), []), None


GENERATORS = (one_contact, scaled_matrix, scaled_rows, scaled_general, reported)
BUDGETS = ((1e-6, 20), (1e-300, 20), (0.0, 3), (1e-12, 300), (1e300, 5), (1e-6, 0))


def draw(seed):
    """(problem, start or None, tol, max_iter) number `seed` of each generator in turn."""
    rng = np.random.default_rng(seed)
    problem, start = GENERATORS[seed % len(GENERATORS)](rng)
    if rng.random() < 0.2:
        start = None
    return problem, start, *BUDGETS[int(rng.integers(len(BUDGETS)))]


def complaint(problem, solution, external):
    """What is wrong with a solution, or None."""
    r, status = solution.residual, solution.status
    finite = np.isfinite(solution.impulse).all()
    broken = (lv.Status.DIVERGED, lv.Status.NUMERICAL_ERROR)
    if not finite and status not in broken:
        return f"an impulse that is not finite says {status.name}"
    if not finite and solution.success:
        return "an impulse that is not finite is a success"
    if math.isnan(r.relative) or math.isnan(r.floor):
        return f"relative {r.relative}, floor {r.floor}"
    if status is lv.Status.INFEASIBLE and solution.success:
        return "INFEASIBLE and a success"
    if solution.contradicted and not external:
        return f"false claim: {solution.contradicted}"
    if status is lv.Status.FLOOR and not solution.contradicted and not r.relative <= 2.0 * r.floor < np.inf:
        return f"FLOOR at {r.relative}, floor {r.floor}"
    return None


def run(name, seeds, say):
    """Solve, and `say` what is wrong; how many solves there were."""
    external, solves = lv.registry.get(name).external, 0
    for seed in seeds:
        problem, start, tol, max_iter = draw(seed)
        faulthandler.dump_traceback_later(PATIENCE, exit=True)
        try:
            wrong = complaint(
                problem, lv.solve(problem, name, impulse=start, tol=tol, max_iter=max_iter), external
            )
            solves += 1
        except lv.CapabilityError:
            wrong = None
        except Exception as error:  # whatever it is, it is too much
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "lavender" in f.filename]
            wrong = f"raised {type(error).__name__}: {error} ({frames[-1].name}, line {frames[-1].lineno})"
        finally:
            faulthandler.cancel_dump_traceback_later()
        if wrong:
            say(f"{name}, seed {seed} ({problem!r}, tol={tol:g}, max_iter={max_iter}): {wrong}")
    return solves


STEPS = "Simulation.step"


def steps(say):
    """Boxes of absurd masses on each other, stepped by solvers that a scene may name; how many steps there were."""
    count = 0
    for mass in (1e-290, 1e-150, 1.0, 1e150, 1e280):
        for ratio in (1.0, 1e-130, 1e130):
            for solver in ("sequential_impulses", "newton", "auto", "anderson", "pgs"):
                scene = lv.Scene(solver=solver)
                scene.add_plane()
                scene.add_box(mass=mass, position=(0, 0, 0.5))
                scene.add_box(mass=min(max(ratio * mass, 1e-290), 1e290), position=(0, 0, 1.49))
                faulthandler.dump_traceback_later(PATIENCE, exit=True)
                try:
                    sim = lv.Simulation(scene)
                    for _ in range(2):
                        sim.step()
                        count += 1
                except Exception as error:
                    say(f"masses {mass:g} and {ratio * mass:g}, {solver}: {type(error).__name__}: {error}")
                finally:
                    faulthandler.cancel_dump_traceback_later()
    return count


def main(names, seeds):
    """One line of JSON for each solver when it begins and when it is done: its solves and complaints."""
    for name in names:
        complaints = []
        print(json.dumps({"begins": name}), flush=True)
        solves = steps(complaints.append) if name == STEPS else run(name, seeds, complaints.append)
        print(json.dumps({"solver": name, "solves": solves, "complaints": complaints}), flush=True)


if __name__ == "__main__":
    warnings.simplefilter("error")
    main(sys.argv[1].split(","), range(*map(int, sys.argv[2:4])))
