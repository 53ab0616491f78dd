"""Worlds in lanes of vectors, whose bits test_another_way.py compares, are solved there, and by few steps."""

import numpy as np
import pytest

import lavender as lv
from lavender.batch.data import Batch


def make_batch(contacts, nv, n, law, seed=0):
    """Return worlds of 3 contacts rows and nv velocities; some have an empty row, an M with a zero, or no approach."""
    rng = np.random.default_rng(seed)
    m = 3 * contacts
    jac = rng.standard_normal((n, m, nv)) * (rng.random((n, m, nv)) < 0.5)
    half = rng.standard_normal((n, nv, nv))
    mass = 0.1 * half @ half.transpose(0, 2, 1) + np.eye(nv)
    target = rng.standard_normal((n, m)) * rng.choice([0.0, 1.0], (n, 1))
    jac[0, :3] = 0.0
    mass[1, nv - 1, 0] = mass[1, 0, nv - 1] = float(nv == 1)
    target[2] = np.tile([-1e3, 0.0, 0.0], contacts)
    jac[3, :, nv // 2 :] *= 1e-6
    compliance, mu = (
        rng.choice([0.0, 1e-3, 0.1], (n, m)),
        rng.choice([0.0, 0.3, 1.0], (n, contacts)),
    )
    cones = lv.Cones.contacts(0.6, count=contacts)
    free = rng.standard_normal((n, nv))
    return lv.Batch(
        jac, mass, free, target=target, compliance=compliance, mu=mu, cones=cones, friction=law
    )


@pytest.fixture(params=[1, 2, 4, 8])
def width(request, monkeypatch):
    """Let workers take worlds in groups of a width up to that of this processor."""
    make = Batch.make_kernel_worlds

    def make_worlds(*arguments):
        worlds = make(*arguments)
        if worlds.width < request.param:
            pytest.skip("this processor has fewer lanes")
        worlds.width = request.param
        return worlds

    monkeypatch.setattr(Batch, "make_kernel_worlds", make_worlds)
    return request.param


def test_lanes_solve_all_worlds_that_an_impulse_moves(width):
    batch = make_batch(4, 18, 64, "cone", seed=3)
    many = lv.solve_many(batch)
    assert many.success[1:].all()  # No impulse moves the empty rows of world 0.
    assert lv.residual_many(batch, many.impulse).relative[1:].max() <= 1e-6
    # Newton steps over velocities are twice as many.
    assert np.median([s.work.get("factorisations", 0) for s in many]) <= 5


@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_starts_worse_than_zero_are_replaced_by_zero(law):
    batch = make_batch(4, 18, 24, law, seed=5)
    size = 1.0 + lv.solve_many(batch).impulse
    far, further = (lv.solve_many(batch, impulse=scale * size) for scale in (1e5, 3e6))
    assert far.success[1:].all()  # No impulse moves the empty rows of world 0.
    assert far.impulse.tobytes() == further.impulse.tobytes()
    assert far.impulse[5].tobytes() == lv.solve(batch[5], impulse=1e5 * size[5]).impulse.tobytes()
