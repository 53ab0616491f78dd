"""A run in parts has the bits of the whole run: `RUNS`.

Other pairs that are compared bit by bit: every way to solve and judge, single, prepared and in batches, in
test_another_way.py; sequences of calls of prepared solvers in test_sequences.py; packed sweeps in test_packed.py;
orders of blocks in test_sweeps_large.py; lanes of factors in test_newton.py and test_sparse_factor.py; the C library
in tests/export/test_same_bits.py; the engine in tests/sim/engine/test_engine_bits.py.
"""

import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest
from calls import driven
from enumeration import random_bounds
from random_problems import as_matrix, make_problems_of_every_kind, touching

import lavender as lv
from benchmarks.core_problems import stacks
from lavender import registry
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.solvers.newton_systems import general
from lavender.solvers.pivoting import PivotState
from lavender.solving.log import SolveLog
from lavender.solving.stages import DecisionTree
from lavender_ext.core.method import OUTCOMES
from lavender_ext.pivot.lemke import Lemke

SOLVERS = lv.available(external=False)
RESUMABLE = lv.available(external=False, resumable=True)


@functools.cache
def examples():
    """Problems of every law and kind of block, each in every form."""
    kinds = make_problems_of_every_kind().items()
    return [p for (_, kind), (forms, _) in kinds if not kind.startswith("round") for p in forms]


def run_solver(problem, sizes, name, tol=1e-9, budget=1000, **options):
    """`run` of a solver, `advance` of newton, until another claim than MAX_ITERATIONS or the end of the budget."""
    solver = registry.get(name).load()(**options)
    impulse = problem.start()
    done = 0
    status = None
    state = solver.prepare(problem)
    call = solver.advance if name == "newton" else solver.run
    for size in itertools.chain(sizes, itertools.repeat(sizes[-1])):
        claim = call(state, impulse, min(size, budget - done), tol, None)
        done = done + claim.iterations
        status = claim.status
        if status is not lv.Status.MAX_ITERATIONS or done >= budget:
            return done, status, impulse.tobytes()


def run_path(problem, sizes):
    """Lemke's path, nine times begun anew where a ray ends it."""
    rows = PivotState(problem).rows
    paths = Lemke(rows)
    paths.set_start(problem.start())
    codes = [paths.run(n) for n in [*sizes, *9 * [10_000]]]
    return codes[-1], paths.pivots, paths.paths, rows.work, rows.best.impulse.tobytes()


def run_driver(problem, sizes):
    """Newton's method as hosts without Python lead it, by multiply-adds; None if the driver does not take it."""
    found = driven(problem, work=sizes[0])
    return found and (*found[:3], found[3].tobytes())


def run_over_velocities(problem, sizes):
    kernel = general.prepare_islands(problem)
    impulse = problem.start().copy()
    kernel.start(impulse, 1e-9, 300)
    while kernel.step(sizes[0], impulse) == OUTCOMES["more"]:
        pass
    return kernel.counts, impulse.tobytes()


def run_step_of_auto(problem, sizes, kind):
    """What a step remembers between its turns is not computed anew from the best impulse."""
    get_zero_impulse_reference(problem)
    log = SolveLog(problem, 1e-14, 10**6)
    log.judge_and_store_best(problem.start())
    step = DecisionTree(problem, log=log).get_step(kind)
    for n in sizes:
        step.run(n)
    return log.iterations, step.impulse.tobytes()


def opposed():
    """Two contacts that nothing can meet: sweeps stall."""
    rows = touching([[-1, 0], [-1, 0]], normal=np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    contacts = lv.Problem.from_rows(rows, 1.0)
    return [contacts, replace(as_matrix(contacts), cones=lv.Cones.free(2))]


def random_bounded():
    """Bounded rows of an A that is not symmetric, every other one with a symmetric half that is singular."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        m = int(rng.integers(1, 31))
        g, skew = rng.normal(size=(2, m, m))
        g[:, : m // 2] *= seed % 2
        low, high = random_bounds(rng, m)
        yield lv.Problem.lcp(g @ g.T + skew - skew.T, 2.0 * rng.normal(size=m), low, high)


def alternating_islands():
    """J and M of two islands whose rows alternate, under each kind of bound."""
    rng = np.random.default_rng(0)
    kinds = (
        lv.Cones.bounded(np.zeros(20), 1.0),
        lv.Cones.contacts(0.7, count=4),
        lv.Cones.contacts([0.7, 0.0, 0.3], tangents=2, patch_radius=0.1),
    )
    for cones, compliance in itertools.product(kinds, (0.0, 0.1)):
        jac = rng.normal(size=(cones.n_rows, 14))
        half = rng.normal(size=(2, 7, 7))
        first = np.repeat(np.arange(cones.n_blocks) % 2 == 0, np.diff(cones.ptr))
        jac[first, 7:] = jac[~first, :7] = 0.0
        mass = np.kron(np.eye(2), np.ones((7, 7))) * np.tile(
            np.hstack(half @ half.swapaxes(1, 2)), (2, 1)
        )
        yield lv.Problem.from_jacobian(
            jac,
            mass + np.eye(14),
            rng.normal(size=14),
            cones=cones,
            compliance=compliance,
            friction="cone",
        )


ORDERS = ({}, {"order": "random"}, {"order": "symmetric"}, {"order": "colored"})
#: Run, how to make its problems, sizes of a whole run and of its parts.
RUNS = {
    **{
        f"{name} {order.get('order', '')} to {tol:g}": (
            functools.partial(run_solver, name=name, tol=tol, budget=23, **order),
            examples,
            [23],
            [1, 7, 15],
        )
        for name in RESUMABLE
        for order in (ORDERS if registry.get(name).order else ORDERS[:1])
        for tol in (0.0, 1e-14)
    },
    **{
        f"{name} until it stalls": (
            functools.partial(run_solver, name=name, tol=1e-6),
            opposed,
            [1000],
            [7],
        )
        for name in RESUMABLE
    },
    "newton": (functools.partial(run_solver, name="newton"), examples, [1000], [2]),
    "lemke": (run_path, random_bounded, [], [3, 0, 1, 17, 40]),
    "driver": (run_driver, examples, [10**6], [1]),
    "newton over velocities": (run_over_velocities, alternating_islands, [300], [1]),
    **{
        f"a step of auto: {kind}": (
            functools.partial(run_step_of_auto, kind=kind),
            lambda: [stacks(4, 4, 0.5, False)],
            [40],
            [3, 10, 27],
        )
        for kind in ("anderson", "admm", "newton")
    },
}


@pytest.mark.parametrize("case", RUNS)
def test_solver_run_in_parts_has_the_bits_of_one_run(case):
    run, problems, whole, parts = RUNS[case]
    name = getattr(run, "keywords", {}).get("name", "newton")
    compared = 0
    for problem in problems():
        if registry.get(name).refuses(problem) is None:
            expected = run(problem, whole)
            assert run(problem, parts) == expected, problem
            compared += expected is not None
    assert compared
