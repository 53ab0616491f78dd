"""STALLED is a claim: the whole budget from the same start does not end below half of what was returned."""

import math

import pytest
from random_problems import warmed
from worked import after

import lavender as lv
from benchmarks.random_families import wild
from lavender import registry, suite
from lavender.suite import hard

ITERATE = lv.available(external=False, resumable=True)
ROWS = 150  # at most: the set of all tests here takes seconds


def recorded():
    """Steps of the engine with their warm start."""
    scenes = [
        ("stack", {}),
        ("stack", {"n": 10}),
        ("pyramid", {"base": 3}),
        ("card_house", {}),
        ("bridge", {}),
    ]
    scenes += [
        ("chain", {"n": 8}),
        ("heavy_on_light", {}),
        ("table", {"legs": 4}),
        ("four_bar", {}),
        ("ramp", {}),
    ]
    for name, parameters in scenes:
        simulation = lv.Simulation(lv.Scene(name, **parameters))
        for step in range(100):
            if step % 10 == 5 and simulation.constraint_problem().m <= ROWS:
                yield f"{name} {parameters}, step {step}", simulation.constraint_problem()
            simulation.step()


def drawn():
    """Problems of `wild`, cold, and from the answer to targets that are a little different."""
    for seed in range(60):
        problem = wild(seed=seed, rows=ROWS).problem
        yield f"wild {seed}", problem
        warm = warmed(problem, seed)
        if warm is not None:
            yield f"wild {seed}, warm", warm


@pytest.fixture(scope="module")
def problems():
    built_in = [*suite.default(), *map(suite.case, hard.SET)]
    known = [(case.name, case.problem) for case in built_in if 0 < case.problem.m <= ROWS]
    return [*known, *recorded(), *drawn()]


@pytest.fixture(scope="module")
def stalled(problems):
    """(solver, problem, sweeps, what was returned, what the whole budget ends at) of every claim STALLED."""
    found = []
    for name in ITERATE:
        for word, problem in problems:
            if registry.get(name).refuses(problem):
                continue
            solution = lv.solve(problem, name)
            if solution.status is lv.Status.STALLED:
                whole = lv.solve(problem, name, tol=0.0).residual.relative
                found.append((name, word, solution.iterations, solution.residual.relative, whole))
    return found


@pytest.mark.slow
def test_stalled_claims_are_wrong_in_less_than_two_percent(stalled):
    wrong = [claim for claim in stalled if claim[4] < 0.5 * claim[3]]
    assert len(stalled) >= 50, "hardly anything stalls: nothing is tested"
    assert len(wrong) < 0.02 * len(stalled), wrong


# Sweeps after which a cycle, and rows that nothing can meet, were told before slopes and bounds were looked at.
RESTS = [
    ("duplicated(k=3)", {"omega": 1.0}, {"jacobi": 72}),
    ("duplicated(k=8)", {"omega": 1.0}, {"jacobi": 72}),
    (
        "infeasible(kind=squeeze)",
        {},
        {
            "pgs": 88,
            "sequential_impulses": 88,
            "block_gauss_seidel": 88,
            "nncg": 517,
            "anderson": 922,
        },
    ),
    (
        "infeasible(kind=joints)",
        {},
        {
            "pgs": 72,
            "sequential_impulses": 72,
            "block_gauss_seidel": 72,
            "gauss_seidel": 72,
            "sor": 114,
            "nncg": 578,
            "anderson": 518,
        },
    ),
]


@pytest.mark.parametrize(("text", "options", "sweeps"), RESTS)
def test_sweeps_without_progress_are_stalled_within_twice_the_sweeps(text, options, sweeps):
    problem = suite.case(text).problem
    for name, before in sweeps.items():
        solution = lv.solve(problem, name, **options)
        assert solution.status is lv.Status.STALLED, name
        assert solution.iterations <= 2 * before, name


@pytest.mark.parametrize("name", ["pgs", "sequential_impulses", "block_gauss_seidel"])
def test_slow_sweeps_use_their_budget_and_report_the_rate(name):
    problem = after(15, "stack").constraint_problem()
    solution = lv.solve(problem, name, max_iter=1000)
    assert solution.status is lv.Status.MAX_ITERATIONS and solution.iterations == 1000
    # As many sweeps more bring it down tenfold, within a factor of three: the slope is that of the last half.
    more = lv.solve(problem, name, tol=0.0, max_iter=1000 + round(solution.sweeps_per_decade))
    assert 1 / 30 < more.residual.relative / solution.residual.relative < 0.3
    assert "tol needs about" in solution.message
    sooner = solution.message.rpartition(": ")[2].split(", ")
    assert set(sooner) <= set(lv.available(problem, resumable=False)) and "newton" in sooner
    assert all(lv.solve(problem, other).success for other in sooner)
    enough = lv.solve(problem, name, max_iter=20_000)
    assert enough.success and "tol needs about" not in enough.message


@pytest.mark.parametrize("ratio", [10.0, 100.0])
def test_sweeps_per_decade_of_a_known_contraction(ratio):
    """A sphere of mass R on one of mass 1: Gauss-Seidel contracts by R / (1 + R)."""
    problem = suite.case(f"stack(n=2, mass_ratio={ratio:g})").problem
    sweeps = -1.0 / math.log10(ratio / (1.0 + ratio))
    for n in (40, 100):
        solution = lv.solve(problem, "pgs", tol=1e-14, max_iter=n)
        assert solution.sweeps_per_decade == pytest.approx(sweeps, rel=1e-2)
