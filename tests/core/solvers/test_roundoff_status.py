"""CONVERGED needs a residual and a round-off floor up to tol."""

import numpy as np
import pytest

import lavender as lv

WIDE_SEEDS = range(40)


def make_wide_problem(seed):
    """Make a problem of J and M: masses over 12 orders, bounded rows and contacts, the next-to-last row a copy."""
    rng = np.random.default_rng(seed)
    nv = int(rng.integers(3, 7))
    m = 3 * int(rng.integers(1, 4))
    masses = 10.0 ** rng.uniform(-6.0, 6.0, nv)
    jac = rng.standard_normal((m, nv)) * 10.0 ** rng.uniform(-2.0, 2.0, (m, 1))
    target = rng.standard_normal(m) * 10.0 ** rng.uniform(-3.0, 6.0, m)
    if seed % 2:
        high = 10.0 ** rng.uniform(-2.0, 4.0, m)
        cones = lv.Cones.bounded(np.where(rng.random(m) < 0.5, 0.0, -high), high)
    else:
        cones = lv.Cones.contacts(rng.uniform(0.0, 2.0, m // 3))
    return lv.Problem.from_jacobian(
        jac, np.diag(masses), rng.standard_normal(nv), target=target, cones=cones
    )


@pytest.mark.parametrize("solver", ["auto", "newton"])
@pytest.mark.parametrize("tol", [1e-6, 1e-12, 1e-15])
def test_status_converged_has_residual_and_floor_within_tol(solver, tol):
    seen = set()
    problems = [make_wide_problem(seed) for seed in WIDE_SEEDS]
    for problem in problems:
        found = lv.solve(problem, solver, tol=tol)
        seen.add(found.status)
        is_met = found.residual.relative <= tol and found.residual.roundoff_floor <= tol
        assert found.success == is_met
        if found.status is lv.Status.CONVERGED:
            assert is_met
    many = lv.solve_many(problems, solver, tol=tol)
    for i in range(len(problems)):
        assert many.success[i] == many[i].success
    if tol == 1e-6:
        assert lv.Status.CONVERGED in seen
    if tol == 1e-15:  # Below the floor of most problems.
        assert lv.Status.ROUNDOFF_LIMIT in seen
