"""Each check of the contract fails, with a sentence that names the fault, on a solver that has this fault alone."""

from dataclasses import dataclass

import numpy as np
import pytest

import lavender as lv
from lavender import contract
from lavender.contract.run import find_failure

CHECK_EVERY = 5


@dataclass
class State:
    problem: lv.Problem
    a: np.ndarray
    done: int = 0


class Sweeps:
    """Projected Gauss-Seidel on a dense A; every method is correct."""

    def __init__(self, order="given", ground=None, seed=0):
        self.order, self.seed = order, seed

    def prepare(self, problem):
        return State(problem, problem.dense())

    def update(self, state, problem):
        return self.prepare(problem)

    def rows(self, state):
        m = state.problem.m
        if self.order == "reverse":
            return range(m)[::-1]
        if self.order == "random":
            return np.random.default_rng([self.seed, state.done]).permutation(m)
        if self.order == "colored":
            return [*range(0, m, 2), *range(1, m, 2)]
        return range(m)

    def sweep(self, state, impulse):
        p = state.problem
        for i in self.rows(state):
            if p.d[i] > 0.0:
                step = impulse[i] - (state.a[i] @ impulse - p.b[i]) / p.d[i]
                impulse[i] = min(max(step, p.cones.lower[i]), p.cones.upper[i])

    def converged(self, state, impulse, tol):
        return (
            tol > 0.0
            and state.done % CHECK_EVERY == 0
            and not tol < lv.residual(state.problem, impulse).relative < 1e12
        )

    def claim(self, state, impulse, n, tol):
        good = lv.residual(state.problem, impulse).relative <= tol
        return lv.Claim(lv.Status.CONVERGED if good else lv.Status.DIVERGED, n, {"sweeps": n}, "" if good else "grew")

    def run(self, state, impulse, n, tol, time_limit=None):
        for i in range(n):
            if self.converged(state, impulse, tol):
                return self.claim(state, impulse, i, tol)
            self.sweep(state, impulse)
            state.done += 1
        return lv.Claim(lv.Status.MAX_ITERATIONS, n, {"sweeps": n})


class StopsAtTwo(Sweeps):
    def converged(self, state, impulse, tol):
        return state.done >= 2

    def claim(self, state, impulse, n, tol):
        return lv.Claim(lv.Status.CONVERGED, n, {"sweeps": n + 1})


class MisnamesWork(Sweeps):
    def run(self, *arguments):
        claim = super().run(*arguments)
        return lv.Claim(claim.status, claim.iterations, {"passes": claim.iterations})


class IgnoresOrder(Sweeps):
    def rows(self, state):
        return range(state.problem.m)


class IgnoresSeed(Sweeps):
    def rows(self, state):
        self.seed = 0
        return super().rows(state)


class SpendsMore(Sweeps):
    def run(self, state, impulse, n, tol, time_limit=None):
        return super().run(state, impulse, max(n, 2), tol)


class RaisesOnNothing(Sweeps):
    def prepare(self, problem):
        problem.d.max()
        return super().prepare(problem)


class Silent(Sweeps):
    def run(self, state, impulse, n, tol, time_limit=None):
        return lv.Claim(lv.Status.NUMERICAL_ERROR, 0, {"sweeps": 1})


class NoZeros(Sweeps):
    def prepare(self, problem):
        if not problem.dense().any(axis=1).all():
            raise ValueError("a row of A is zero")
        return super().prepare(problem)


class Option(Sweeps):
    def __init__(self, order="given", ground=None, seed=0, extra=1):
        super().__init__(order, ground, seed)


class SingleNorm(Sweeps):
    """Its stop test divides one norm of the error over all rows by one norm of b."""

    def converged(self, state, impulse, tol):
        p = state.problem
        step = np.clip(impulse - (state.a @ impulse - p.b) / p.d, p.cones.lower, p.cones.upper) - impulse
        return tol > 0.0 and np.linalg.norm(p.d * step) <= 1e-2 * tol * np.linalg.norm(p.b)

    def claim(self, state, impulse, n, tol):
        return lv.Claim(lv.Status.CONVERGED, n, {"sweeps": n + 1})


class Symmetrises(Sweeps):
    """It solves with (A + A^T)/2, and its claims are true."""

    def prepare(self, problem):
        state = super().prepare(problem)
        state.a = 0.5 * (state.a + state.a.T)
        return state


class SinglePrecision(Sweeps):
    def sweep(self, state, impulse):
        super().sweep(state, impulse)
        impulse[:] = impulse.astype(np.float32)


class CachesBySize(Sweeps):
    """The objects share the matrices of earlier problems of the same size."""

    cache = {}  # noqa: RUF012 - shared by all objects on purpose

    def prepare(self, problem):
        state = super().prepare(problem)
        state.a = self.cache.setdefault(problem.m, state.a)
        return state


class Deadband(Sweeps):
    """It leaves out the rows whose b is below a thousandth of the largest."""

    def rows(self, state):
        b = np.abs(state.problem.b)
        return [i for i in super().rows(state) if b[i] >= 1e-3 * b.max()]


#: Faulty solver, the check that must fail, and words of its sentence; test_contract_mistakes.py has more faults.
FAULTS = [
    (SingleNorm, "problems_are_solved", "for two islands whose b differ by 1e6 (law lcp) the result is"),
    (Symmetrises, "problems_are_solved", "for an asymmetric A (law lcp) the result is"),
    (SinglePrecision, "problems_are_solved", "CONVERGED and lv.residual"),
    (CachesBySize, "problems_are_solved", "the result is"),
    (Deadband, "problems_are_solved", "for two islands whose b differ by 1e6"),
    (Silent, "problems_are_solved", "A failure has no message"),
    (NoZeros, "problems_are_solved", "a row of A is zero"),
    (RaisesOnNothing, "problems_are_solved", "was raised in"),
    (MisnamesWork, "problems_are_solved", "Its work must count one of backend_calls"),
    (Option, "options_match_the_spec", "the options extra are in the spec or in the factory, not in both"),
    (SpendsMore, "budgets_are_kept", "max_iter=1"),
    (StopsAtTwo, "budgets_are_kept", "or the claim is wrong"),
    (StopsAtTwo, "interruptions_return_the_iterate", "TIME_LIMIT after at least 1 iteration is required"),
    (IgnoresOrder, "orders_change_the_sweep", "give the same bits after 2 sweeps"),
    (IgnoresSeed, "orders_change_the_sweep", "give the same bits after 2 sweeps"),
]


def make_spec(factory, **more):
    return lv.SolverSpec(
        **{
            "name": "twin", "factory": factory, "laws": {"linear", "lcp"}, "operators": {"matrix"}, "order": True,
            "seed": True, "summary": "of a test", "max_iter": 5000, **more,
        }
    )  # fmt: skip


def failure(spec, name):
    return find_failure(spec, contract.CHECKS[name]).text


@pytest.mark.parametrize("check", [c.name for c in contract.list_checks(make_spec(Sweeps))])
def test_contract_of_a_correct_solver_is_met(register, check):
    spec = make_spec(Sweeps)
    register(spec)
    assert failure(spec, check) == ""


@pytest.mark.parametrize("factory, check, words", FAULTS, ids=[f"{f.__name__}-{c}" for f, c, _ in FAULTS])
def test_contract_of_a_faulty_solver_names_the_unmet_check(register, factory, check, words):
    spec = make_spec(factory)
    register(spec)
    sentence = failure(spec, check)
    assert words in sentence
    assert "np." not in sentence and "assert" not in sentence


@pytest.mark.parametrize(
    "check, more, words",
    [
        ("options_match_the_spec", {"options": {"omega": "a factor"}}, "the options omega are in the spec or"),
        ("problems_are_solved", {"laws": {"lcp", "cone"}, "refusal": lambda p: "no" * (p.law == "cone")},
         "the spec lists the law cone, but refuses every problem with it"),
        ("budgets_are_kept", {"refusal": lambda p: "never"}, "the law linear, but refuses every problem with it"),
    ],
)  # fmt: skip
def test_contract_of_a_wrong_spec_names_the_unmet_check(register, check, more, words):
    spec = make_spec(Sweeps, **more)
    register(spec)
    assert words in failure(spec, check)


def test_checks_apply_to_listed_capabilities_only():
    spec = make_spec(Sweeps, order=False, seed=False, resumable=False, callback=False, history=False)
    names = {check.name for check in contract.list_checks(spec)}
    assert not names & {"orders_change_the_sweep", "interruptions_return_the_iterate"}
    assert "problems_are_solved" in names


@pytest.mark.parametrize("name", ["my solver", "a\nb"])
def test_register_name_with_other_characters_raises(name):
    with pytest.raises(lv.InputError, match="letters, digits"):
        lv.register(make_spec(Sweeps, name=name))


def test_unknown_solver_initials_suggest_the_name_with_these_initials():
    with pytest.raises(lv.UnknownName, match="did you mean 'sequential_impulses'"):
        lv.solve(lv.Problem.lcp(np.eye(2), [1.0, 1.0]), "si")
