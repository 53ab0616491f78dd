"""Contacts that resist rolling: what they are, how they are judged, saved and solved."""

import numpy as np
import pytest
from random_problems import as_matrix, random_contact_problem, touching

import lavender as lv
from lavender import registry
from lavender.judge.measures import siconos_error

TAKES = [n for n in lv.available(law="coulomb") if registry.specs()[n].parts]


def soft_problem(seed, law, spin=True, **sizes):
    """With compliance on every row: A is definite, and sweeps converge."""
    base = random_contact_problem(seed, law, spin=spin, rolling=True, **sizes)
    return lv.Problem(base.b, base.cones, rows=base.rows, compliance=base.compliance + 0.3, friction=law)


@pytest.mark.parametrize(("speed", "held"), [(1e-3, True), (1.0, False)])
def test_a_ball_that_rolls_loses_what_the_moment_takes(speed, held):
    """In a step h: held where mu_r N h is enough, else the spin falls by mu_r N h / (7/5 m R^2) and v follows it."""
    radius, mass, h, reach, g = 0.5, 2.0, 1 / 120, 0.02, 9.81
    inertia = 0.4 * mass * radius**2
    rows = touching(
        [[-1, 0]], inv_mass=[1 / mass], inv_inertia=[np.eye(3) / inertia], arm_b=[(0.0, 0.0, -radius)],
        v_free=[[speed, 0.0, -g * h, 0.0, speed / radius, 0.0]],
    )  # fmt: skip
    problem = lv.Problem.from_rows(rows, mu=0.5, rolling=reach)
    for name in TAKES:
        if registry.get(name).refuses(problem) or registry.specs()[name].external:
            continue
        v = problem.velocity(lv.solve(problem, name, tol=1e-12, max_iter=20_000).impulse)[0]
        slower = reach * mass * g * h / (inertia + mass * radius**2)
        turned = 0.0 if held else speed / radius - slower
        np.testing.assert_allclose([v[4], v[0], v[2]], [turned, radius * turned, 0.0], atol=1e-9)


def test_without_a_moment_it_is_the_contact_it_was():
    """mu_r = 0: the same impulses as without the rows, bit for bit from sweeps."""
    problem = soft_problem(17, "coulomb", joints=0)
    c = problem.cones
    still = lv.Cones(c.ptr, c.kind, c.lower, c.upper, c.mu, c.patch_radius)
    plain = lv.Cones.contacts(c.mu, patch_radius=c.patch_radius)
    keep = np.concatenate([np.arange(j, j + 4) for j in c.ptr[:-1]])
    rolling = lv.Problem(problem.b, still, rows=problem.rows, compliance=problem.compliance)
    without = lv.Problem(problem.b[keep], plain, rows=problem.rows, compliance=problem.compliance[keep])
    a, b = (lv.solve(p, "sequential_impulses", tol=0.0, max_iter=20).impulse for p in (rolling, without))
    np.testing.assert_array_equal(a[keep], b)
    for name in ("newton", "anderson", "nncg", "admm"):
        found = lv.solve(rolling, name, tol=1e-9, max_iter=20_000)
        assert found.success, str(found)
        rest = np.setdiff1d(np.arange(problem.m), keep)
        assert not found.impulse[rest].any(), name


def test_siconos_error_is_zero_at_the_solution_alone():
    problem = as_matrix(soft_problem(31, "coulomb", spin=False, joints=0))
    found = lv.solve(problem, "newton", tol=1e-12)
    assert siconos_error(problem, found.impulse)["relative"] < 1e-10
    assert siconos_error(problem, found.impulse + 0.01)["relative"] > 1e-3


def test_cones_join_restrict_and_project():
    both = (
        lv.Cones.contacts(0.5, rolling=0.1, count=2)
        + lv.Cones.contacts(0.3, patch_radius=0.1, rolling=0.2)
        + lv.Cones.free(1)
    )
    assert both.has_rolling and both.n_tangents.tolist() == [2, 2, 2, 0]
    assert both.rolling_rows.tolist() == [3, 8, 14, -1]
    assert both.spin_rows.tolist() == [-1, -1, 13, -1]
    assert both.rolling.tolist() == [0.1, 0.1, 0.2, 0.0]
    x = lv.cones.project(both, np.ones(both.n_rows))
    for r, most in zip(both.rolling_rows[:3], both.rolling[:3], strict=True):
        np.testing.assert_allclose(np.hypot(x[r], x[r + 1]), most)
