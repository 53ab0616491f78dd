"""The substep's map about rest: what its eigenvalues say, against the sweeps and a model of three numbers."""

import numpy as np
import pytest
from worked import after

import lavender as lv
from benchmarks.stability import critical_gain, model, modes, slowest

H = 1 / 60


def left_by_sweeps(n, sweeps):
    """Share of the slowest error in the velocities that `sweeps` sweeps leave, of a tower at rest."""
    sim = after(300, "stack", n=n, dt=H, substeps=1, order="given", solver_iterations=64)
    problem = sim.constraint_problem()
    size, rest = 1e-6, problem.guess
    columns = []
    for k in range(problem.m):
        pair = []
        for sign in (1.0, -1.0):
            start = rest.copy()
            start[k] += sign * size
            pair.append(lv.solve(problem, "sequential_impulses", tol=0, max_iter=sweeps, impulse=start).impulse)
        columns.append((pair[0] - pair[1]) / (2 * size))
    values = np.abs(np.linalg.eigvals(np.array(columns).T))
    return values[values < 1 - 1e-7].max()


@pytest.mark.parametrize(("n", "sweeps"), [(1, 4), (2, 4), (4, 4), (6, 4)])
def test_a_tower_in_place_rings_with_the_root_of_what_the_sweeps_leave(n, sweeps):
    found = modes(n, sweeps, H)
    kappa, _ = slowest(found)
    assert found.stable
    # one box settles quicker than it rings; towers by |z|^2 = rho
    if n > 1:
        assert kappa == pytest.approx(1 - left_by_sweeps(n, sweeps), rel=0.05)


def test_closing_the_whole_gap_drives_every_tower_whatever_the_substep():
    for h in (1 / 60, 1 / 240):
        for order in ("given", "symmetric", "top_down", "alternating"):
            found = modes(4, 4, h, order=order, gain=1.0)
            assert not found.stable and np.abs(found.z[0]) ** (1 / found.substeps) > 1.02, (h, order)
            assert modes(4, 4, h, order=order).stable, (h, order)


def test_the_first_mode_leaves_where_the_gain_reaches_kappa():
    for n in (4, 6):
        kappa, _ = slowest(modes(n, 4, H))
        assert 0.5 * kappa < critical_gain(n, 4, H, digits=1) < 2.0 * kappa


def test_gravity_outruns_the_sweeps_of_tall_towers_in_long_substeps():
    assert not modes(14, 8, 1 / 30).stable and modes(14, 8, 1 / 240).stable


def test_the_model_rings_with_root_rho_and_is_driven_above_kappa():
    for kappa in (0.3, 0.03, 0.003):
        z = np.abs(model(kappa, 0.0))
        np.testing.assert_allclose(np.sort(z), np.sort([1.0, *[np.sqrt(1 - kappa)] * 2]), atol=1e-6)
        assert np.abs(model(kappa, 0.5 * kappa)).max() < 1.0 < np.abs(model(kappa, 2.0 * kappa)).max()
