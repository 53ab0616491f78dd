"""Problems of few rows take a compiled way: it must not show, but in time."""

from dataclasses import replace

import numpy as np
import pytest
from calls import check
from random_problems import random_contact_problem, random_generalized_problem

import lavender as lv
from benchmarks.core_problems import forms, stacks


@pytest.mark.parametrize("limit", [None, 10.0])
def test_impulses_that_cancel_in_rounding_are_diverged_with_any_limit(limit):
    """Two fixed impulses that cancel in a free row, whose b is 1000 times their rounding 2^-53 A lambda."""
    low = [1.5, -1.5, -np.inf]
    high = [1.5, -1.5, np.inf]
    held = lv.Problem.lcp(np.full((3, 3), 1e13), [0.0, 0.0, 1.0], low, high)
    solution = lv.solve(held, time_limit=limit)
    assert solution.residual.relative == solution.residual.roundoff_floor > 1e-3
    assert solution.status is lv.Status.DIVERGED and "float64 loses b" in solution.message
    assert lv.solve_many([held], time_limit=limit).status.tolist() == [lv.Status.DIVERGED]


def test_round_cones_are_never_solved_over_rows_of_a():
    problem = random_generalized_problem(0, "cone", n=8, compliance=False, contacts=4, tangents=5)
    with pytest.raises(lv.errors.CapabilityError, match="need form='velocity'"):
        lv.solve(problem, "newton", form="impulse")
    assert "newton over rows" not in {stage.solver for stage in lv.explain(problem).stages}
    # What it cannot take further ends as a result, not in a solver that reads past such a block.
    hard = lv.prepare(problem, "auto").solve(tol=1e-15)
    assert np.isfinite(hard.residual.relative) and hard.claim_check == "confirmed"


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("form", ["bodies", "matrix"])
@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize("tol, corners", [(1e-3, 1), (1e-6, 1), (1e-10, 1), (1e-6, 4)])
def test_islands_under_friction_are_one_call(friction, form, equal, tol, corners):
    """Cut out of A, and of bodies where these have fewer unknowns: at four corners."""
    problem = forms(stacks(40, 2, 0.4, equal, corners))[form].relaxed(friction)
    found = check(problem, "auto", tol=tol)
    first = "newton on " if corners > 1 and friction == "cone" else "anderson on 40 islands"
    assert found.success and first in found.message and "islands" in found.message
    near = found.impulse * (1.0 + 1e-4 * np.random.default_rng(1).normal(size=problem.m))
    assert check(problem, "auto", tol=tol, impulse=near).success
    assert check(problem, "auto", tol=tol, impulse=found.impulse).work == {}
    each = found.impulse.reshape(40, -1)
    assert np.array_equal(each, np.tile(each[0], (40, 1))) == equal


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("seed", range(4))
def test_islands_of_bodies_with_joints_are_one_call(law, seed):
    """Pairs of bodies, each with a joint or none, in no order; with a wrong number in a cut no call would end."""
    rng = np.random.default_rng(seed)
    drawn = random_contact_problem(
        seed, law, bodies=20, joints=8, contacts=70, tangents=2, spin=False
    )

    def pairs(n):
        second = 2 * rng.integers(0, 10, n) + 1
        return np.stack([np.where(rng.random(n) < 0.7, second - 1, -1), second], 1).astype(np.int32)

    rows = replace(drawn.rows, contact_body=pairs(70), joint_body=pairs(8))
    problem = replace(drawn, rows=rows, b=drawn.b)
    assert problem.m > 6 * rows.n_bodies
    found = check(problem, "auto", tol=1e-8)
    assert found.success and "islands" in found.message


@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_islands_that_share_an_immovable_body_are_one_call(law):
    """Columns on the ground, which is a body without inverse mass: it belongs to every island."""
    columns = stacks(4, 4, 0.4, False, 3).relaxed(law)
    rows = columns.rows
    b = columns.b + 0.1 * np.random.default_rng(0).normal(size=columns.m)

    def put_first(ground, values):
        return np.concatenate([np.full((1, *values.shape[1:]), ground), values])

    on_body = replace(
        columns,
        b=b,
        rows=replace(
            rows,
            inv_mass=put_first(0.0, rows.inv_mass),
            inv_inertia=put_first(0.0, rows.inv_inertia),
            v_free=put_first(0.0, rows.v_free),
            contact_body=rows.contact_body + 1,
        ),
    )
    found = check(on_body, "auto")
    expected = check(replace(columns, b=b), "auto")
    assert found.success and found.message == expected.message and "on 4 islands" in found.message
    np.testing.assert_allclose(
        found.impulse, expected.impulse, atol=1e-6
    )  # The bodies have another order.


def test_compiled_call_on_an_island_at_rest_returns_zero():
    """Of nine islands one leaves the ground: nothing is to be done for it, and the solution says what was done."""
    rng = np.random.default_rng(3)
    g = rng.normal(size=(12, 6))
    part = g @ g.T
    n = 9
    b = np.tile(part @ np.tile([1.0, 0.1, 0.1], 4), n)
    problem = lv.Problem.contact(np.kron(np.eye(n), part), b, np.full(4 * n, 0.5))
    start = lv.solve(problem).impulse
    b[:12], b[:12:3] = 0.0, -0.01
    found = check(problem.updated(b=b), "auto", impulse=start)
    assert found.success and found.residual.relative <= found.tol
    assert not found.impulse[:12].any()
