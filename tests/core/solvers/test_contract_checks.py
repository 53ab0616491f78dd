"""Each check of the contract fails, with a sentence that names the fault, on a solver that has this fault alone."""

import itertools
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
        return lv.Claim(
            lv.Status.CONVERGED if good else lv.Status.DIVERGED, n, {"sweeps": n}, "" if good else "grew"
        )

    def run(self, state, impulse, n, tol, time_limit=None):
        for i in range(n):
            if self.converged(state, impulse, tol):
                return self.claim(state, impulse, i, tol)
            self.sweep(state, impulse)
            state.done += 1
        return lv.Claim(lv.Status.MAX_ITERATIONS, n, {"sweeps": n})


class StopsEarly(Sweeps):
    def converged(self, state, impulse, tol):
        return lv.residual(state.problem, impulse).relative <= 1e-2

    def claim(self, state, impulse, n, tol):
        return lv.Claim(lv.Status.CONVERGED, n, {"sweeps": n + 1})


class StopsAtTwo(StopsEarly):
    def converged(self, state, impulse, tol):
        return state.done >= 2


class CountsNothing(Sweeps):
    def run(self, *arguments):
        claim = super().run(*arguments)
        return lv.Claim(claim.status, claim.iterations)


class MisnamesWork(Sweeps):
    def run(self, *arguments):
        claim = super().run(*arguments)
        return lv.Claim(claim.status, claim.iterations, {"passes": claim.iterations})


class Sloppy(Sweeps):
    """It stops only at ten times the tolerance."""

    def converged(self, state, impulse, tol):
        return super().converged(state, impulse, 1e3 * tol)

    def claim(self, state, impulse, n, tol):
        return lv.Claim(lv.Status.CONVERGED, n, {"sweeps": n + 1})


class ForgetsCount(Sweeps):
    def run(self, state, *arguments):
        state.done = 0
        return super().run(state, *arguments)

    def rows(self, state):
        return super().rows(state) if state.done % 2 else super().rows(state)[::-1]


class IgnoresOrder(Sweeps):
    def rows(self, state):
        return range(state.problem.m)


class IgnoresSeed(Sweeps):
    def rows(self, state):
        self.seed = 0
        return super().rows(state)


class Counts(Sweeps):
    """The object remembers how many solves it ran."""

    counter = itertools.count()

    def prepare(self, problem):
        state = super().prepare(problem)
        state.a = state.a * (1.0 + 1e-12 * next(self.counter))
        return state


class OldNumbers(Sweeps):
    """`update` keeps A and d of the first problem."""

    def update(self, state, problem):
        new = super().prepare(problem)
        new.problem = state.problem
        return new


class Absolute(Sweeps):
    """It makes no step below 1e-10 N s."""

    def sweep(self, state, impulse):
        before = impulse.copy()
        super().sweep(state, impulse)
        impulse[:] = before + np.sign(impulse - before) * np.maximum(np.abs(impulse - before) - 1e-10, 0.0)


class SpendsMore(Sweeps):
    def run(self, state, impulse, n, tol, time_limit=None):
        return super().run(state, impulse, max(n, 2), tol)


class Restarts(Sweeps):
    def run(self, state, impulse, n, tol, time_limit=None):
        if state.done == 0:
            impulse[:] = 0.0
        return super().run(state, impulse, n, tol)


class RaisesOnNothing(Sweeps):
    def prepare(self, problem):
        problem.d.max()
        return super().prepare(problem)


class Boasts(Sweeps):
    """It claims that what it did not solve has no solution."""

    def claim(self, state, impulse, n, tol):
        claim = super().claim(state, impulse, n, tol)
        if claim.status is lv.Status.DIVERGED:
            return lv.Claim(lv.Status.CONVERGED, n, {"sweeps": n})
        return claim


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


#: Faulty solver, the check that must fail, and words of its sentence.
FAULTS = [
    (StopsEarly, "every_listed_law_is_solved", "CONVERGED within a relative residual of 1e-08 is required"),
    (Sloppy, "every_listed_law_is_solved", "is required, because the spec lists the law"),
    (
        Sloppy,
        "every_listed_law_is_solved",
        "Claim CONVERGED only if lv.residual(problem, impulse).relative <= tol",
    ),
    (CountsNothing, "every_listed_law_is_solved", "Its work counts nothing"),
    (MisnamesWork, "every_listed_law_is_solved", "Its work counts 'passes'; at least one of backend_calls"),
    (
        Option,
        "options_match_the_factory",
        "the factory accepts the options extra, which the spec does not list",
    ),
    (SpendsMore, "budgets_are_kept", "max_iter=1"),
    (StopsAtTwo, "budgets_are_kept", "gave a claim that the judge does not confirm"),
    (ForgetsCount, "runs_can_be_continued", "keep everything that changes in the state"),
    (ForgetsCount, "history_at_fixed_counts", "history=True changes the bits"),
    (StopsAtTwo, "time_limit_returns_the_iterate", "TIME_LIMIT after at least 1 is required"),
    (StopsAtTwo, "callback_may_stop", "INTERRUPTED are required"),
    (Restarts, "a_solution_as_start_is_kept", "0 iterations are required"),
    (IgnoresOrder, "orders_change_the_sweep", "each order must sweep differently"),
    (IgnoresSeed, "seeds_change_random_sweeps", "the seed has no effect"),
    (Counts, "results_are_reproducible", "the same call gave another result"),
    (OldNumbers, "update_equals_prepare", "is not the one after `prepare`"),
    (Absolute, "units_do_not_matter", "in other units of mass"),
    (RaisesOnNothing, "unusual_problems_have_a_result", "ValueError was raised in"),
    (Silent, "failures_have_a_message", "without a message"),
    (NoZeros, "infeasible_rows_are_reported", "a row of A is zero"),
    (Boasts, "claims_are_true", "The judge does not confirm the claim"),
]


def make_spec(factory, **more):
    return lv.SolverSpec(
        **{
            "name": "twin", "factory": factory, "laws": {"linear", "lcp"}, "operators": {"matrix"}, "order": True,
            "seed": True, "summary": "of a test", "max_iter": 5000, **more,
        }
    )  # fmt: skip


def failure(spec, name):
    return find_failure(spec, contract.CHECKS[name])


@pytest.mark.parametrize("check", [c.name for c in contract.list_checks(make_spec(Sweeps))])
def test_a_correct_solver_passes(register, check):
    spec = make_spec(Sweeps)
    register(spec)
    assert failure(spec, check) == ""


@pytest.mark.parametrize("factory, check, words", FAULTS, ids=[f"{f.__name__}-{c}" for f, c, _ in FAULTS])
def test_a_fault_is_named(register, factory, check, words):
    spec = make_spec(factory)
    register(spec)
    sentence = failure(spec, check)
    assert words in sentence
    assert "np." not in sentence and "assert" not in sentence


@pytest.mark.parametrize(
    "check, more, words",
    [
        ("options_match_the_factory", {"options": {"omega": "a factor"}}, "options omega, which the factory does not"),
        ("every_listed_law_is_solved", {"laws": {"lcp", "cone"}, "refusal": lambda p: "no" * (p.law == "cone")},
         "lists the laws cone, but the solver refuses every problem of them"),
        ("budgets_are_kept", {"refusal": lambda p: "never"}, ""),
        ("callback_may_stop", {"refusal": lambda p: "never"}, "accepts none of the well-posed problems"),
    ],
)  # fmt: skip
def test_a_wrong_spec_is_named(register, check, more, words):
    spec = make_spec(Sweeps, **more)
    register(spec)
    sentence = failure(spec, check)
    assert words in sentence and bool(words) == bool(sentence)


def test_a_check_applies_to_listed_capabilities_only():
    names = {
        c.name for c in contract.list_checks(make_spec(Sweeps, order=False, seed=False, resumable=False))
    }
    skipped = {"orders_change_the_sweep", "seeds_change_random_sweeps", "history_at_fixed_counts",
               "runs_can_be_continued", "callback_may_stop"}  # fmt: skip
    assert not names & skipped and "every_listed_law_is_solved" in names


def test_every_check_has_a_requirement_in_words():
    for check in contract.CHECKS.values():
        assert (check.requirement.endswith(".") and check.requirement[0].isupper()) or check.requirement[
            0
        ] == "`"
        assert check.applies_to
