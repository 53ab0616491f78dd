"""Solvers and the judge on built-in problems, whose structure these properties need."""

import dataclasses

import numpy as np
import pytest
from calls import says
from random_problems import CONTACTS, GIVEN, as_matrix
from scipy.linalg import block_diag

import lavender as lv
from lavender import suite


@pytest.mark.parametrize("form", GIVEN)
def test_correct_claims_at_any_mass_ratio_are_confirmed(form, plug_in):
    """Who solves A as it was formed is excused by rounding in its forming, at any ratio of masses."""
    for ratio in ("1", "1e4", "1e8"):
        rows = suite.case(f"box_stack(n=3, mass_ratio={ratio})").problem
        problem = GIVEN[form](rows)

        def run(given, impulse):
            found = lv.solve(as_matrix(given), tol=1e-10)
            impulse[:] = found.impulse
            return says(found.status)

        for name in (plug_in(run, operators={"matrix"}), *lv.available(problem, external=False)):
            solution = lv.solve(problem, name, tol=1e-10)
            assert solution.claim_check == "confirmed", (ratio, str(solution))


def arms_along_axes(problem):
    """Its contacts with arms along one axis each: |arm x n| has one product a component, as the floor counts them."""
    rows, keep = problem.rows, np.eye(3)[np.arange(problem.rows.n_contacts) % 3]
    return dataclasses.replace(
        problem, rows=dataclasses.replace(rows, arm_a=rows.arm_a * keep, arm_b=rows.arm_b * keep)
    )


def held_rows(problem, lam, rounding):
    """(m,) rows whose slack holds them at a bound by more than its rounding, a contact without impulse."""
    c, w = problem.cones, problem.slack(lam)
    held = ((lam == c.lower) & (w > rounding)) | ((lam == c.upper) & (-w > rounding))
    for i in np.flatnonzero(c.kind != 0):
        rows = slice(c.ptr[i], c.ptr[i + 1])
        held[rows] = w[rows][0] > rounding[rows][0] and not lam[rows].any()
    return held


@pytest.mark.parametrize("scale", [0, 180, -180])
@pytest.mark.parametrize("kind", ["four_bar(tilt=0.3)", "ring(n=8)", *(k for k in CONTACTS if k != "ellipses")])
def test_floor_over_bodies_is_that_of_the_formula(kind, scale):
    """F = 2^-53 (max(|J| |M^-1| |J|^T |lam| + c |lam|, d |lam|) + |b|), by dense matrices; squares beyond float64."""
    problem = arms_along_axes(CONTACTS[kind](3)) if kind in CONTACTS else suite.case(kind).problem
    rows = problem.rows
    inv_mass = block_diag(
        *(w for i in range(rows.n_bodies) for w in (rows.inv_mass[i] * np.eye(3), rows.inv_inertia[i]))
    )
    jac = np.abs(rows.jacobian(problem.cones).toarray())
    moved = dataclasses.replace(rows, v_free=rows.v_free * 2.0**scale)
    c = problem.cones
    cones = dataclasses.replace(c, lower=c.lower * 2.0**scale, upper=c.upper * 2.0**scale)
    scaled = dataclasses.replace(problem, b=problem.b * 2.0**scale, rows=moved, cones=cones)
    for lam in np.diag(100.0 * np.abs(problem.b).max() / problem.d):  # each row once is the one that counts
        size = jac @ (np.abs(inv_mass) @ (jac.T @ lam))
        size = np.maximum(size + problem.compliance * lam, problem.d * lam)  # a tangent alone is cut; else d is A_kk
        f = 2.0**-53 * (size + np.abs(problem.b))
        f[held_rows(problem, lam, f)] = 0.0
        start = lv.residual(problem, lam)
        energy = np.sqrt(np.sum(f**2 / problem.d)) / start.energy_at_zero
        velocity = np.max(f * problem.metric.weight / problem.d) / start.velocity_at_zero
        found = lv.residual(scaled, lam * 2.0**scale)
        assert found.roundoff_floor == pytest.approx(max(energy, velocity), rel=1e-12, abs=0.0)  # sums in another order


def test_anderson_step_that_raises_the_residual_is_undone():
    # Faces on faces with friction: mixing overshoots and is restarted, and the residual falls all the same.
    problem = lv.suite.case("box_stackF(n=6, sliding=0.5)").problem
    solution = lv.solve(problem, "anderson", tol=0.0, max_iter=400)
    assert solution.work["restarts"] > 0
    assert solution.residual.relative < lv.solve(problem, "pgs", tol=0.0, max_iter=400).residual.relative


def test_exception_of_a_callback_is_raised_by_solve():
    class Enough(Exception):
        pass

    def callback(n, impulse, residual):
        raise Enough

    with pytest.raises(Enough):
        lv.solve(suite.stack(64).problem, "pgs", callback=callback)


@pytest.mark.parametrize("name", ["pgs", "sequential_impulses", "nncg", "anderson"])
@pytest.mark.parametrize("tol", [1e-2, 1e-5])
def test_sweeps_end_soon_after_the_tolerance_is_met(name, tol):
    problem = lv.suite.case("granular(n=3)").problem
    there = 0
    while lv.solve(problem, name, tol=0.0, max_iter=there).residual.relative > tol:
        there += 1
    solution = lv.solve(problem, name, tol=tol)
    # The last check before the end was at most an eighth, or one, or half of what was expected, too early; with
    # acceleration the fall is not steady, and the expectation may be out by as much again.
    assert there <= solution.iterations <= there + max(1, there >> (3 if name in ("pgs", "sequential_impulses") else 2))
