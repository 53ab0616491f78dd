"""A limit is the caller's clock, on built-in problems of all sizes."""

import functools

import numpy as np
import pytest
from calls import dense, over_velocities

import lavender as lv
from benchmarks.core_problems import fresh
from lavender import registry, suite
from lavender.problem.cones import project_impulse
from lavender.solvers.sweeping import SweepSolver
from lavender.solving.auto import DecisionTree, Newton, Step, estimate_cost
from lavender.solving.loop import Loop

OWN = [name for name, spec in registry.specs().items() if spec.builtin and not spec.external and name != "auto"]


# Under Coulomb's law these return their last iterate.
SWEEPS_OF_ENGINES = ("pgs", "sequential_impulses", "block_gauss_seidel", "gauss_seidel")
LIMITS = [1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3]  # s


PROBLEMS = {
    "J and M, dense": lambda: over_velocities(300, 100),
    "matrix, cone": lambda: dense(300, "cone"),
    "matrix, coulomb": lambda: dense(300, "coulomb"),
    "matrix, lcp": lambda: dense(400, "lcp"),
    "bodies, coulomb": lambda: suite.case("pyramidF(k=6)").problem,
    "bodies, lcp": lambda: suite.case("stack(n=400)").problem,
    "bodies, linear": lambda: suite.case("chain(n=60)").problem,
}


def play(monkeypatch, clock, pace, problem):
    """The clock goes by what sweeps, steps that factor and analyses of `auto` are counted for, times `pace`."""
    sweep, newton = SweepSolver.run, registry.get("newton").load()
    prepare, quiet = newton.prepare, []

    def swept(*of):
        found = sweep(*of)
        clock.now += 1e-9 * pace * found.iterations * problem.metric.work
        return found

    def turned(kind):
        turn = kind.advance

        def played(self, n):
            claim = turn(self, n)
            quiet.append(1)
            each = DecisionTree(problem).newton / DecisionTree(problem).newton_state.steps
            quiet.clear()
            clock.now += 1e-9 * pace * max(claim.iterations, 1) * each
            return claim

        return played

    def prepared(self, of):
        clock.now += 0.0 if quiet else 1e-9 * pace * estimate_cost("newton", of).setup
        return prepare(self, of)

    # A chunk takes 1 ms of the counted time, and not of the machine's.
    chunk = max(1, int(1e6 / (pace * problem.metric.work)))
    monkeypatch.setattr(Loop, "choose_chunk_size", lambda *_: chunk)
    monkeypatch.setattr(SweepSolver, "run", swept)
    monkeypatch.setattr(Newton, "advance", turned(Newton))
    monkeypatch.setattr(Step, "advance", turned(Step))  # of `direct`
    monkeypatch.setattr(newton, "prepare", prepared)


# At 3 times the estimated cost, Newton's method over dense velocities starts within 10 ms and does not end: the sweeps
# before it had half of the time, and leave 0.037 instead of 0.011 at 3 ms.
LATE_NEWTON = pytest.mark.xfail(
    reason="open: at 3 times its estimated cost, Newton starts within 10 ms and uses up the time of the sweeps"
)
PACES = [
    pytest.param(name, pace, marks=[LATE_NEWTON] if (name, pace) == ("J and M, dense", 3.0) else [])
    for name in PROBLEMS
    for pace in (0.3, 1.0, 2.0, 3.0)
]


@pytest.mark.parametrize(("name", "pace"), PACES)
def test_more_time_is_never_worse(name, pace, clock, monkeypatch):
    problem, found = PROBLEMS[name](), []
    play(monkeypatch, clock, pace, problem)
    for limit in LIMITS:
        clock.now = 0.0
        found.append(lv.solve(fresh(problem), tol=1e-9, time_limit=limit).residual.relative)
    # Residuals below tol are not compared. With more time a factorisation may start that does not end; the sweeps
    # before it had half of the time, and their last steps reduce the residual by up to a third here.
    least = np.maximum(found, 1e-9)
    assert (np.diff(least) <= 0.5 * least[:-1]).all(), found
    assert least[-1] <= least[0]


@functools.cache
def solved_once(name):
    problem = PROBLEMS[name]()
    return problem, lv.solve(problem, tol=1e-6).impulse


def has_lower_objective(problem, impulse, start):
    """Return whether the objective is at most that of the start and of the zero impulse."""
    found, given = (0.5 * x @ (problem.slack(x) - problem.b) for x in (impulse, start))
    return found <= min(given, 0.0) + 1e-9 * abs(given)


@pytest.mark.parametrize("name", [*OWN, "auto"])
@pytest.mark.parametrize("limit", [1e-6, 1e-4, 1e-3])
def test_an_answer_is_no_worse_than_its_start(name, limit):
    """By the objective, or by the energy error under Coulomb's law; there sweeps end with their last iterate."""
    spec, compared = registry.get(name), 0
    for seed, of in enumerate(PROBLEMS):
        problem, solved = solved_once(of)
        if spec.refuses(problem):
            continue
        rng = np.random.default_rng(seed)
        for size in (1e-4, 0.3, 30.0):
            start = solved + size * np.abs(solved).mean() * rng.normal(size=problem.m)
            inside = project_impulse(problem.cones, start)
            solution = lv.solve(fresh(problem), name, impulse=start, time_limit=limit, tol=1e-12)
            if problem.law != "coulomb":
                assert has_lower_objective(problem, solution.impulse, inside), (of, size)
            elif solution.iterations == 0 or name not in SWEEPS_OF_ENGINES:
                least = lv.residual(problem, inside).energy
                assert solution.residual.energy <= least * (1.0 + 1e-9), (of, size)
            compared += 1
    assert compared
