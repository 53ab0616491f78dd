"""Every registered solver meets the contract and solves every kind of problem; failures of built-in solvers."""

import numpy as np
import pytest
from enumeration import enumerate_lcp, random_bounds
from hypothesis import given
from hypothesis import strategies as st
from random_problems import (
    make_problems_of_every_kind,
    make_well_posed_problems,
    random_contact_problem,
    seeds,
    touching,
)

import lavender as lv
from lavender import contract, registry
from lavender.base.errors import TooLarge
from lavender.problem import operators
from lavender.solvers import decisions
from lavender.solving import steps

OURS = lv.available(external=False)
#: Backends that must solve every problem that they accept; others may fail if the result reports it.
REQUIRED_BACKENDS = ("osqp", "clarabel", "piqp", "daqp", "clarabel_cone")


def mark_external(names):
    """Mark backends as slow: in the tests with sanitizers they take long and run no kernel of this package."""
    return [
        pytest.param(name, marks=[pytest.mark.slow] * registry.get(name).external) for name in names
    ]


@pytest.mark.parametrize("name", mark_external(lv.available()))
def test_solver_meets_the_contract(name):
    failures = {
        check.name: failure.text for check, failure in contract.check_solver(name) if failure.text
    }
    assert not failures


@pytest.mark.parametrize("name", mark_external(lv.available()))
def test_solver_solves_every_kind_of_problem_in_every_form(name):
    spec = registry.get(name)
    tol = 1e-6 if spec.external else 1e-8
    for (law, kind), (forms, slack) in make_problems_of_every_kind().items():
        for problem in forms:
            if spec.refuses(problem) is not None:
                with pytest.raises(lv.CapabilityError):
                    lv.solve(problem, name)
                continue
            budget = max(spec.max_iter, 20_000) if spec.resumable else None
            solution = lv.solve(problem, name, tol=tol, max_iter=budget)
            if spec.external and (name not in REQUIRED_BACKENDS or kind.startswith("round")):
                assert (
                    solution.success or solution.status_conflict or solution.status != "CONVERGED"
                )
                continue
            assert solution.success and solution.claim_check == "confirmed", (law, kind, solution)
            if (
                law != "coulomb"
            ):  # The slack is unique; an impulse error of tol moves it by at most 1e3 times as much.
                size = np.abs(problem.slack(problem.start())).max()
                np.testing.assert_allclose(
                    solution.slack,
                    slack,
                    rtol=0,
                    atol=1e3 * tol * size + 1e-7 * np.abs(slack).max(),
                )


SOFT = touching(
    [[-1, 0], [-1, 0]], inv_mass=[0.0], inv_inertia=np.zeros((1, 3, 3))
)  # a body that cannot move
UNUSUAL = {
    "no rows, linear": lv.Problem.linear(np.zeros((0, 0)), []),
    "one free row": lv.Problem.linear([[2.0]], [1.0]),
    "one inactive row": lv.Problem.lcp([[2.0]], [-1.0]),
    "a negative A": lv.Problem.lcp([[-2.0]], [1.0]),
    "a zero row that is inactive": lv.Problem.lcp(np.diag([1.0, 0.0]), [1.0, -1.0]),
    "a zero row with an upper bound": lv.Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0], upper=3.0),
    "three equal bounded rows": lv.Problem.lcp(np.ones((3, 3)), [1.0, 1.0, 1.0]),
    "three equal free rows": lv.Problem.linear(np.ones((3, 3)), [1.0, 1.0, 1.0]),
    "a zero diagonal": lv.Problem.lcp([[0.0, 1.0], [1.0, 0.0]], [1.0, 1.0]),
    "an indefinite A": lv.Problem.lcp([[-1.0, 2.0], [2.0, -1.0]], [1.0, 1.0]),
    "an asymmetric A": lv.Problem.lcp([[2.0, 1.0], [-1.0, 2.0]], [1.0, 1.0]),
    "tangents that cannot move": lv.Problem.contact(
        np.diag([1.0, 0.0, 0.0]), [1.0, 0.2, 0.1], [0.5]
    ),
    "soft contacts of a static body": lv.Problem.from_rows(
        SOFT, [1.0, 2.0, 1.0, -2.0], mu=0.5, tangents=1, compliance=[1.0, 2.0, 1.0, 2.0]
    ),
}


@pytest.mark.parametrize("name", mark_external(lv.available()))
def test_unusual_problems_have_a_finite_result_or_are_refused(name):
    spec = registry.get(name)
    for kind, problem in UNUSUAL.items():
        if spec.refuses(problem) is None:
            solution = lv.solve(problem, name)
            assert np.isfinite(solution.impulse).all(), kind
            assert spec.external or solution.claim_check == "confirmed", (kind, solution)
            assert problem.m or solution.success, kind


@pytest.mark.parametrize("name", OURS)
@given(seed=seeds, m=st.integers(1, 6))
def test_claims_about_small_matrices_are_true(name, seed, m):
    rng = np.random.default_rng(seed)
    a = np.rint(2.0 * rng.normal(size=(m, m)))
    low, high = random_bounds(rng, m)
    problem = lv.Problem.lcp(a, np.rint(3.0 * rng.normal(size=m)), low, high)
    if registry.get(name).refuses(problem) is None:
        solution = lv.solve(problem, name, tol=1e-9)
        assert solution.claim_check == "confirmed" and np.isfinite(solution.impulse).all()
        assert solution.status != "INFEASIBLE" or not enumerate_lcp(a, problem.b, low, high)


@pytest.mark.parametrize("name", [name for name in OURS if registry.get(name).impulse])
def test_solver_under_the_cone_law_keeps_friction_of_a_normal_without_inverse_mass(name):
    """The solution has w_n = mu |w_t| > 0 and lambda_n > 0."""
    b, impulse = (
        np.array([-0.5, 2.0, 0.0]),
        np.array([2.0, 1.0, 0.0]),
    )  # The slack is w = (0.5, -1, 0) m/s.
    one = lv.Cones.contacts([0.5])
    for problem in (
        lv.Problem.contact(np.diag([0.0, 1.0, 1.0]), b, [0.5], friction="cone"),
        lv.Problem.from_jacobian(
            np.eye(3)[:, 1:], np.eye(2), [0, 0], target=b, cones=one, friction="cone"
        ),
    ):
        if registry.get(name).refuses(problem) is None:
            kept = lv.solve(problem, name, tol=1e-9, impulse=impulse)
            assert kept.status == "CONVERGED" and not kept.iterations
            np.testing.assert_array_equal(kept.impulse, impulse)
            assert lv.solve(problem, name, tol=1e-9).success


@pytest.mark.parametrize("name", ["auto", "direct", "lemke", "newton"])
@pytest.mark.parametrize("kind", ["definite", "semidefinite", "asymmetric"])
@given(seed=seeds, m=st.integers(1, 7), whole=st.booleans())
def test_small_bounded_rows_have_the_solution_of_enumeration(name, kind, seed, m, whole):
    """`whole`: small whole numbers, so that w = 0 and lambda = 0 at once. A semidefinite A leaves w alone unique."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, max(1, m // 2) if kind == "semidefinite" else m + 2))
    skew = rng.normal(size=(m, m))
    b = 2.0 * rng.normal(size=m)
    low, high = random_bounds(rng, m)
    if whole:
        g, skew, b = np.rint(g), np.rint(skew), np.rint(b)
        if kind == "semidefinite":  # rows twice: ties at every pivot
            g[m // 2 :] = g[: m - m // 2]
    a = g @ g.T + (0.0 if kind == "semidefinite" else 0.5 * np.eye(m))
    a = a + (skew - skew.T if kind == "asymmetric" else 0.0)
    if kind == "semidefinite":  # what has a solution
        low = np.zeros(m)
        high = np.full(m, np.inf)
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


BROKEN = [MemoryError("8 GB"), TooLarge("A would have 1e10 entries"), FloatingPointError("1e400")]


@pytest.mark.parametrize(
    "error", [*BROKEN, KeyboardInterrupt()], ids=lambda error: type(error).__name__
)
@pytest.mark.parametrize("name", [name for name in OURS if name != "auto"])
def test_solver_that_raises_after_the_start_gives_a_result(name, error, monkeypatch):
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
def test_auto_continues_with_other_solvers_after_an_exception(limit, error, monkeypatch):
    def breaks(self, n):
        raise error

    problem = random_contact_problem(3, contacts=60, bodies=20, friction="coulomb")
    assert problem.m > decisions.SMALL_ROWS
    kinds = {steps.Newton, steps.Step, steps.Iterations, steps.Sweeps}
    for broken in [{kind} for kind in kinds] + [kinds]:
        for kind in broken:
            monkeypatch.setattr(kind, "advance", breaks)
        found = lv.solve(
            problem, tol=1e-13, time_limit=limit
        )  # the compiled call leaves that to the others
        ran = {stage.solver for stage in found.stages if stage.work}
        if len(broken) == 1:
            assert found.residual.relative <= 1e-6
            assert ran
        else:
            assert found.status is lv.Status.NUMERICAL_ERROR
            assert str(error) in found.message
        monkeypatch.undo()


@pytest.mark.parametrize("name", OURS)
def test_solver_on_an_a_beyond_memory_raises_before_the_start_or_does_not_form_it(
    name, monkeypatch
):
    monkeypatch.setattr(operators, "MAX_INDEXABLE_ENTRIES", 4000)  # J and M have 2,700
    spec = registry.get(name)
    rng = np.random.default_rng(4)
    jac = rng.normal(size=(90, 15))
    mass = np.diag(rng.uniform(1.0, 2.0, 15))
    chain = 0.2 * (np.eye(15, k=1) + np.eye(15, k=-1))
    for friction in ("coulomb", "cone"):
        problem = lv.Problem.from_jacobian(
            jac,
            mass + chain,
            rng.normal(size=15),
            cones=lv.Cones.contacts(0.5, count=30),
            friction=friction,
        )
        if spec.refuses(problem) is not None:
            continue
        for more in ({}, {"time_limit": 10.0}, {"tol": 1e-30}):
            if "generalized" not in spec.operators:  # It reads A.
                with pytest.raises(lv.InputError, match="use a solver that takes J and M"):
                    lv.prepare(problem, name)
            else:
                assert lv.solve(problem, name, **more).residual.relative < 1.0
        assert lv.explain(problem).stages
