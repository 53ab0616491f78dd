"""Every registered solver meets the contract (`lavender.contract`), and results of failures of built-in solvers."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_problems import random_contact_problem, seeds

import lavender as lv
from lavender import contract, registry
from lavender.base.errors import TooLarge
from lavender.contract.checks import UNSOLVABLE_MATRICES, make_well_posed_problems
from lavender.contract.enumeration import enumerate_lcp, random_bounds
from lavender.problem import operators
from lavender.solvers import steps

OURS = lv.available(external=False)
#: (solver, check); backends are slow where the kernels run with every check on, and no kernel of ours is behind them.
REQUIREMENTS = [
    pytest.param(
        name, check, id=f"{name}-{check.name}", marks=[pytest.mark.slow] * registry.get(name).external
    )
    for check in contract.CHECKS.values()
    for name in lv.available()
    if check.applies(registry.get(name))
]


@pytest.mark.parametrize("name, check", REQUIREMENTS)
def test_a_solver_meets_a_requirement(name, check):
    check.run(registry.get(name))


@pytest.mark.parametrize("name", ["auto", "direct", "lemke", "newton"])
@pytest.mark.parametrize("kind", ["definite", "semidefinite", "asymmetric"])
@given(seed=seeds, m=st.integers(1, 7), whole=st.booleans())
@settings(max_examples=20)
def test_small_bounded_rows_have_the_solution_of_enumeration(name, kind, seed, m, whole):
    """`whole`: small whole numbers, so that w = 0 and lambda = 0 at once. A semidefinite A leaves w alone unique."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, max(1, m // 2) if kind == "semidefinite" else m + 2))
    skew, b = rng.normal(size=(m, m)), 2.0 * rng.normal(size=m)
    low, high = random_bounds(rng, m)
    if whole:
        g, skew, b = np.rint(g), np.rint(skew), np.rint(b)
        if kind == "semidefinite":  # rows twice: ties at every pivot
            g[m // 2 :] = g[: m - m // 2]
    a = g @ g.T + (0.0 if kind == "semidefinite" else 0.5 * np.eye(m))
    a = a + (skew - skew.T if kind == "asymmetric" else 0.0)
    if kind == "semidefinite":  # what has a solution
        low, high = np.zeros(m), np.full(m, np.inf)
        b = a @ np.maximum(b, 0.0) - np.maximum(skew[0], 0.0)
    solution = lv.solve(lv.Problem.lcp(a, b, low, high), name, tol=1e-9)
    assert solution.success and solution.claim_check == "confirmed", solution
    truth = enumerate_lcp(a, b, low, high)
    assert truth or kind == "semidefinite"
    for x, w in truth:
        if kind == "semidefinite":
            np.testing.assert_allclose(solution.slack, w, atol=1e-6)
        else:
            np.testing.assert_allclose(solution.impulse, x, atol=1e-6)


@pytest.mark.parametrize("name", ["gauss_seidel", "sor", "jacobi", "pgs"])
@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (UNSOLVABLE_MATRICES[0], "row 0 has a zero diagonal"),
        (UNSOLVABLE_MATRICES[1], "row 1 has a negative diagonal, -1"),
        (UNSOLVABLE_MATRICES[2], "the residual grew instead of falling"),
    ],
)
def test_divergence_of_sweeps_names_the_row(name, matrix, words):
    for make, second in itertools.product((lv.Problem.linear, lv.Problem.lcp), (1.0, -1.0)):
        problem = make(matrix, [1.0, second])
        if registry.get(name).refuses(problem) is not None:
            continue
        solution = lv.solve(problem, name, tol=1e-6)
        if solution.status is lv.Status.DIVERGED and words.startswith("row"):
            assert words in str(solution)
        if problem.law == "linear" and second < 0.0:
            assert solution.status is lv.Status.DIVERGED and solution.message.startswith(words)


BROKEN = [MemoryError("8 GB"), TooLarge("A would have 1e10 entries"), FloatingPointError("1e400")]


@pytest.mark.parametrize("error", [*BROKEN, KeyboardInterrupt()], ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("name", [name for name in OURS if name != "auto"])
def test_what_breaks_down_or_is_stopped_after_the_start_is_a_result(name, error, monkeypatch):
    """With the best impulse so far, and never one that is worse than the start."""
    spec = registry.get(name)
    *_, problem = make_well_posed_problems(spec)
    start = 0.9 * lv.solve(problem).impulse
    factory = spec.load()
    runs = factory.run
    for before in (0, 1) if spec.resumable else (0,):  # calls that end well
        left = [before]

        def run(self, state, impulse, n, tol, time_limit=None, left=left):
            if left[0]:
                left[0] -= 1
                return runs(self, state, impulse, 1, tol, time_limit)
            if not spec.resumable:
                impulse[:] = 1e3
            raise error

        monkeypatch.setattr(factory, "run", run)
        found = lv.solve(problem, name, impulse=start, tol=1e-12, max_iter=500)
        if not (before and found.success):  # the first of its iterations may do
            stopped = isinstance(error, KeyboardInterrupt)
            assert found.status is (lv.Status.INTERRUPTED if stopped else lv.Status.NUMERICAL_ERROR)
            assert stopped or found.message.endswith(str(error))
            with pytest.raises(lv.SolveFailed):
                found.raise_for_status()
        assert found.residual.relative <= lv.residual(problem, start).relative
        monkeypatch.undo()


@pytest.mark.parametrize("error", BROKEN, ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("limit", [None, 10.0])
def test_auto_goes_on_with_the_others_where_one_breaks_down(limit, error, monkeypatch):
    def breaks(self, n):
        raise error

    problem = random_contact_problem(3, contacts=60, bodies=20, friction="coulomb")
    assert problem.m > registry.SMALL_ROWS
    kinds = {steps.Newton, steps.Step, steps.Iterations, steps.Sweeps}
    for broken in [{kind} for kind in kinds] + [kinds]:
        for kind in broken:
            monkeypatch.setattr(kind, "advance", breaks)
        found = lv.solve(problem, tol=1e-13, time_limit=limit)  # the compiled call leaves that to the others
        ran = {stage.solver for stage in found.stages if stage.work}
        if len(broken) == 1:
            assert found.residual.relative <= 1e-6
            assert ran
        else:
            assert found.status is lv.Status.NUMERICAL_ERROR
            assert str(error) in found.message
        monkeypatch.undo()


@pytest.mark.parametrize("name", OURS)
def test_an_a_that_is_too_large_is_told_before_the_start_or_not_needed(name, monkeypatch):
    monkeypatch.setattr(operators, "MAX_INDEXABLE_ENTRIES", 4000)  # J and M have 2,700
    spec = registry.get(name)
    rng = np.random.default_rng(4)
    jac, mass = rng.normal(size=(90, 15)), np.diag(rng.uniform(1.0, 2.0, 15))
    chain = 0.2 * (np.eye(15, k=1) + np.eye(15, k=-1))
    for friction in ("coulomb", "cone"):
        problem = lv.Problem.from_jacobian(
            jac, mass + chain, rng.normal(size=15), cones=lv.Cones.contacts(0.5, count=30), friction=friction
        )
        if spec.refuses(problem) is not None:
            continue
        for more in ({}, {"time_limit": 10.0}, {"tol": 1e-30}):
            if name in ("admm", "jacobi", "direct", "lemke"):  # which read A
                with pytest.raises(lv.InputError, match="use a solver that takes J and M"):
                    lv.prepare(problem, name)
            else:
                assert lv.solve(problem, name, **more).residual.relative < 1.0
        assert lv.explain(problem).stages
