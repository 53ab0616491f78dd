"""The registry: what a spec refuses to be, names and their nearest, plug-ins that fail, capabilities as data."""

import dataclasses

import numpy as np
import pytest

import lavender as lv
from lavender import registry

SPEC = registry.get("pgs")
TINY = lv.Problem.lcp(np.eye(2), np.ones(2))


def named(name, **more):
    return dataclasses.replace(SPEC, name=name, **more)


def test_claim_of_more_iterations_than_the_limit_is_a_numerical_error(plug_in):
    name = plug_in(lambda problem, impulse: lv.Claim(lv.Status.MAX_ITERATIONS, 6, {}))
    solution = lv.solve(TINY, name, max_iter=5)
    assert solution.status is lv.Status.NUMERICAL_ERROR
    assert "claims the iterations 6; a whole number from 0 to 5 is needed" in solution.message
    assert lv.solve(TINY, name, max_iter=6).iterations == 6


def test_message_names_the_row_whose_impulse_is_not_finite(plug_in):
    # A lambda has it in every row that is coupled, so that the worst row tells nothing.
    def breaks(problem, impulse):
        impulse[2] = np.nan
        return lv.Claim(lv.Status.CONVERGED, 1)

    solution = lv.solve(lv.Problem.lcp(np.eye(3) + 1.0, np.ones(3)), plug_in(breaks))
    assert (solution.status, solution.residual.worst_row) == (lv.Status.DIVERGED, 0)
    assert solution.message == "the impulse of row 2 is nan"


def test_a_plug_in_without_update_is_prepared_anew(register):
    class Bare:
        def prepare(self, problem):
            return problem

        def run(self, state, impulse, n, tol, time_limit):
            impulse[:] = state.b  # of A = 1
            return lv.Claim(lv.Status.CONVERGED, 1)

    register(named("bare", factory=Bare))
    solver = lv.prepare(TINY, "bare")
    assert solver.solve().success
    assert solver.solve(lv.Problem.lcp(np.eye(2), [2.0, 3.0])).impulse.tolist() == [2.0, 3.0]


def test_processes_of_a_plug_in_start_outside_of_its_time_limit(register, clock):
    class Slow:
        def prepare(self, problem):
            return problem

        def start_workers(self, state, time_limit):
            clock.now += 5.0

        def run(self, state, impulse, n, tol, time_limit):
            assert time_limit == 1.0
            impulse[:] = state.b  # of A = 1
            return lv.Claim(lv.Status.CONVERGED, 1)

    register(named("slow", factory=Slow, resumable=False))
    solution = lv.solve(TINY, "slow", time_limit=1.0)
    assert solution.success
    assert solution.setup_time >= 5.0


def test_available_selects_by_capabilities():
    ordered = lv.available(law="lcp", order=True)
    assert "pgs" in ordered
    assert "direct" not in ordered
    assert set(ordered).isdisjoint(lv.available(law="lcp", order=False))
    with pytest.raises(lv.UnknownName, match="did you mean 'sequential_impulses'"):
        lv.solve(TINY, "si")  # its initials


def test_register_of_a_name_twice_raises_without_replace(register):
    lv.register(named("mine"))
    assert lv.solve(TINY, "mine", tol=1e-9).solver.name == "mine"
    with pytest.raises(lv.InputError, match="replace=True"):
        lv.register(named("mine"))
    lv.register(named("mine", summary="another"), replace=True)
    assert lv.get("mine").summary == "another"


def test_impulse_of_an_infeasible_problem_is_inside_its_bounds_whatever_the_solver_returned(
    plug_in,
):
    def pull(problem, impulse):
        impulse[:] = -5.0
        return lv.Claim(lv.Status.INFEASIBLE, 1, certificate=np.ones(2))

    name = plug_in(pull)
    for tol in (1e-6, 0.0):
        solution = lv.solve(lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0]), name, tol=tol)
        assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed"
        assert (solution.impulse >= 0.0).all()
