"""Ways into kernels, a clock that is played, and problems, which tests of several floors share."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest
from random_problems import random_tree_parents, tree_mass

import lavender as lv
from lavender import registry
from lavender.judge.certificates import check_certificate
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.solvers.newton_systems.systems import MatrixSystem, make_system
from lavender_ext.driver.driver import Driver

SHORT = ("auto", "direct", "newton")


# A model of MuJoCo: two boxes on each other, and a driven arm at the end of its range.
BOXES = """<mujoco><option timestep="0.004" {options}/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
  <body name="low" pos="0 0 0.099"><freejoint/><geom name="low" type="box" size=".1 .1 .1" density="300"/></body>
  <body name="high" pos="0.02 0 0.32"><freejoint/><geom name="high" type="box" size=".1 .1 .1"/></body>
  <body pos="0.5 0 0.3"><joint name="arm" axis="0 1 0" range="-20 20" limited="true"/>
    <geom name="arm" type="capsule" size=".04" fromto="0 0 0 -.35 0 0"/></body>
</worldbody><actuator><motor joint="arm" gear="6"/></actuator></mujoco>"""
EARLY_BOXES = 'solver="CG" iterations="3"'  # plainly too few


TIMES = ("setup_time", "solve_time", "_rest")


def long_way(problem, solver, **options):
    return lv.prepare(replace(problem, copy=False), solver).solve(**options)


def facts(solution):
    """Everything a solution says but its times, arrays by their bits, numbers and turns by their words: NaN is NaN."""
    r = solution.residual
    told = {
        f.name: getattr(solution, f.name)
        for f in fields(solution)
        if f.name not in (*TIMES, "residual")
    }
    told |= {f"residual {f.name}": getattr(r, f.name) for f in fields(r) if f.name != "_problem"}
    told["line"] = re.sub(r", [\d.e+-]+ (s|ms|us)(;|$)", "", str(solution))
    words = {k: repr(v) if isinstance(v, float | tuple) else v for k, v in told.items()}
    return {k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in words.items()}


#: Name of each array of `Solutions` and `Residuals` -> the same number of a single solution and residual.
SINGLE = {
    "status": lambda s, r: s.status, "success": lambda s, r: s.success, "iterations": lambda s, r: s.iterations,
    "verdict": lambda s, r: r.verdict, "excess": lambda s, r: r.excess, "relative": lambda s, r: r.relative,
    "energy": lambda s, r: r.energy, "velocity_error": lambda s, r: r.velocity,
    "roundoff_floor": lambda s, r: r.roundoff_floor, "worst_row": lambda s, r: r.worst_row,
    "energy_at_zero": lambda s, r: r.energy_at_zero, "velocity_at_zero": lambda s, r: r.velocity_at_zero,
    "impulse_error": lambda s, r: abs(r.error[r.worst_row]) if r.worst_row >= 0 else 0.0,
}  # fmt: skip


def list_arrays(results):
    """Return the public attributes that are arrays with a number of each world."""
    names = [
        name
        for name in dir(results)
        if not name.startswith("_") and name not in ("impulse", "velocity")
    ]
    found = {
        name for name in names if getattr(getattr(results, name), "shape", None) == (len(results),)
    }
    assert found <= SINGLE.keys() and {"relative", "energy", "worst_row", "roundoff_floor"} <= found
    return found


def is_same(x, y):
    """Return whether two numbers or words are equal, or both are NaN."""
    return x == y or (x != x and y != y)


def check(problem, solver, **options):
    short = lv.solve(problem, solver, **options)
    expected = facts(long_way(problem, solver, **options))
    assert facts(short) == expected
    assert (
        facts(lv.solve(problem, solver, **options)) == expected
    )  # what is kept was left as it was found
    return short


class Clock:
    """Stands still but for counted work."""

    now = 0.0

    def __call__(self):
        return self.now


def dense(m, law, seed=0):
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(m, m // 2))
    a = half @ half.T / m + 0.01 * np.eye(m)
    b = rng.normal(size=m)
    return lv.Problem.lcp(a, b) if law == "lcp" else lv.Problem.contact(a, b, 0.5, friction=law)


def over_velocities(m, nv, seed=0, cones=None, **more):
    """Dense J and M: contacts, where no other cones of m rows are given."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(nv, nv))
    cones = lv.Cones.contacts(np.full(m // 3, 0.5), 2) if cones is None else cones
    mass = half @ half.T / nv + np.eye(nv)
    return lv.Problem.from_jacobian(
        rng.normal(size=(m, nv)), mass, rng.normal(size=nv), cones=cones, **more
    )


def prepare_sweeps(problem, name="sequential_impulses", packs=True, **options):
    """A solver by sweeps that may pack blocks, or never does."""
    prepared = lv.prepare(problem, name, **options)
    if not packs:
        prepared.state.sweeps.disable_packing()
    return prepared


def sweep_in_parts(
    problem, counts, name="sequential_impulses", *, start=None, packs=True, **options
):
    """Impulse and velocities of bodies after runs of those many sweeps each, and (packed records, stages)."""
    prepared = prepare_sweeps(problem, name, packs, **options)
    lam = (
        0.05 * np.abs(np.random.default_rng(problem.m).normal(size=problem.m))
        if start is None
        else start.copy()
    )
    for n in counts:
        prepared.solver.run(prepared.state, lam, n, 0.0)
    sweeps = prepared.state.sweeps
    return lam, sweeps.velocity[: problem.rows.n_bodies], sweeps.records


def sweep_packed(problem, counts, name="sequential_impulses", **options):
    """(records, stages) of runs that have the bits of one block after the other."""
    lam, v, pairs = sweep_in_parts(problem, counts, name, **options)
    one, v_one, none = sweep_in_parts(problem, counts, name, packs=False, **options)
    assert (lam.tobytes(), v.tobytes()) == (one.tobytes(), v_one.tobytes())
    assert none[0] == 0 and pairs[0] <= problem.n_blocks
    return pairs


def robot(seed, m=12, n=10, soft=True, number=np.float64):
    """Bounded rows on a random forest, as soft as in engines (2 to 20 % of the diagonal of A)."""
    rng = np.random.default_rng(seed)
    mass = tree_mass(rng, random_tree_parents(rng, n))
    jac = rng.normal(size=(m, n)) * (rng.random((m, n)) < 0.6)
    jac[:, 0] += 0.3
    compliance = rng.uniform(0.02, 0.2, m) * np.einsum(
        "ij,ij->i", jac, np.linalg.solve(mass, jac.T).T
    )
    upper = np.where(rng.random(m) < 0.3, rng.uniform(0.05, 0.5, m), np.inf)
    return lv.Problem.from_jacobian(
        jac.astype(number),
        mass.astype(number),
        rng.normal(size=n).astype(number),
        target=rng.uniform(-0.1, 0.1, m),
        cones=lv.Cones.bounded(np.zeros(m), upper),
        compliance=compliance if soft else None,
        name=f"robot {seed}",
    )


MORE, REACHED, CERTIFICATE = 0, 1, 4


def driven(problem, tol=1e-9, budget=1500, work=10**6):
    """(how it ended, factorisations, residual as the driver has it, impulse); None where it is not taken."""
    lv.residual(
        problem, problem.start()
    )  # d, nu and J M^-1 J^T of a problem are known once it is judged
    driver = Driver(problem.metric)
    impulse = problem.start().copy()
    if not driver.fits:
        return None
    driver.start(impulse, tol, budget)
    how = MORE
    while how in (MORE, CERTIFICATE):
        how = driver.step(work, impulse)
        proof = driver.direction
        if proof is not None and check_certificate(problem, proof) is None:
            driver.confirm_certificate()
    return how, driver.counts[1], driver.relative, impulse


def says(status, **more):
    return lv.Claim(status, 1, **more)


def dense_h(problem):
    s = 1.0 / np.sqrt(problem.d)
    return problem.dense() * s[:, None] * s[None, :]


def block_diagonal(system, values):
    """The small matrices of the elements of Newton's method as one block diagonal matrix."""
    sc = system.solve.view_arrays()
    out = np.zeros((sc.m, sc.m))
    for i, q in enumerate(sc.wptr[:-1]):
        j = sc.ptr[i]
        end = sc.ptr[i + 1]
        out[j:end, j:end] = values[q : sc.wptr[i + 1]].reshape(end - j, end - j)
    return out


def system_in(problem, form):
    """The started system of a problem; "sparse": the impulse form factored by panels whatever it costs."""
    get_zero_impulse_reference(problem)
    system = (
        MatrixSystem(problem, may_be_dense=False)
        if form == "sparse"
        else make_system(problem, form)
    )
    assert form != "sparse" or not system.dense
    system.solve.start(problem.start(), 0.0, 1)
    return system


def keep_values(monkeypatch, module, name, values, solvers):
    """Let a table of settings try only some values, with some solvers or none."""
    lines = [f for f in getattr(module, name) if f.fixed.get("solver", "") in solvers]
    kept = [f._replace(values=tuple(x for x in f.values if x in values)) for f in lines]
    monkeypatch.setattr(module, name, tuple(f for f in kept if f.values))


#: QP backends of other packages that are here, and the backends of all that need a definite A.
BACKENDS = sorted(n for n in lv.available(law="lcp") if registry.specs()[n].external)
DEFINITE = {"quadprog", "ecos", "pyqpmad"}


def installed(*names):
    """Backends by name, skipped where they are not."""
    absent = pytest.mark.skipif(True, reason="not installed")
    return [name if name in BACKENDS else pytest.param(name, marks=absent) for name in names]
