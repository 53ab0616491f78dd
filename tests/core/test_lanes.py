"""Worlds in lanes of vectors, whose bits test_another_way.py compares, are solved there, and by few steps."""

import numpy as np
import pytest

import lavender as lv
from lavender.batch.data import Batch


def make_batch(contacts, nv, n, law, seed=0, change=0.0):
    """Return worlds of 3 contacts rows and nv velocities; some have an empty row, an M with a zero, or no approach.

    The velocities are those of the same worlds without `change`, times random factors near 1.
    """
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
    free *= 1.0 + change * rng.standard_normal((n, nv))
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


def make_starts(batch, exact, seed=0):
    """Return starts of the worlds: solutions, nearby ones, zeros, other worlds' solutions, noise and huge ones."""
    rng = np.random.default_rng(seed)
    size = np.abs(exact).mean()
    kinds = [
        exact,
        exact * (1.0 + 1e-3 * rng.standard_normal(exact.shape)),
        np.zeros_like(exact),
        np.roll(exact, 1, axis=0),
        size * rng.standard_normal(exact.shape),
        1e6 * exact,
    ]
    chosen = rng.integers(0, len(kinds), len(batch))
    return np.array([kinds[k][i] for i, k in enumerate(chosen)])


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize(("rows", "nv", "n"), [(3, 6, 7), (12, 18, 21), (18, 9, 10), (30, 36, 9)])
def test_starts_in_lanes_have_the_bits_of_single_calls(width, rows, nv, n, law):
    batch = make_batch(rows // 3, nv, n, law)
    exact = lv.solve_many(batch, tol=1e-9).impulse
    starts = make_starts(batch, exact)
    many = lv.solve_many(batch, impulse=starts)
    other = lv.solve_many(batch, impulse=np.roll(starts, 1, axis=0))
    moved = lv.solve_many(batch, impulse=np.where(np.arange(n)[:, None] == 4, starts, exact))
    assert (
        moved.impulse[4].tobytes() == many.impulse[4].tobytes()
    )  # whatever the neighbours' starts are
    for i in range(n):
        for found, given in ((many, starts[i]), (other, starts[i - 1])):
            one = lv.solve(batch[i], impulse=given)
            assert found.impulse[i].tobytes() == one.impulse.tobytes()
            assert (found.status[i], found.iterations[i]) == (one.status, one.iterations)
            assert (dict(found[i].work), found[i].message) == (dict(one.work), one.message)


@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_a_start_that_is_a_solution_is_returned_as_it_is(width, law):
    batch = make_batch(4, 18, 24, law, seed=7)
    exact = lv.solve_many(batch).impulse.copy()
    exact[5, exact[5] == 0.0] = -0.0
    again = lv.solve_many(batch, impulse=exact)
    solved = np.flatnonzero(again.success)
    assert len(solved) >= 22  # No impulse moves the empty rows of world 0.
    assert not again.iterations[solved].any()
    # Newton's method over velocities leaves friction up to 1e-6 beyond its bound, on which a start is projected.
    np.testing.assert_allclose(again.impulse[solved], exact[solved], rtol=1e-6)
    kept = [i for i in solved.tolist() if again[i].message == "the start is a solution"]
    assert len(kept) >= 20
    np.testing.assert_array_equal(again.impulse[kept], exact[kept])


@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_a_start_near_the_solution_takes_less_work_than_none(law):
    """The velocities of the next step differ by 0.1 %, as in a loop over steps."""
    start = lv.solve_many(make_batch(10, 36, 64, law, seed=9)).impulse
    batch = make_batch(10, 36, 64, law, seed=9, change=1e-3)
    cold, warm = lv.solve_many(batch), lv.solve_many(batch, impulse=start)
    work = [
        np.array([(s.work.get("sweeps", 0), s.work.get("factorisations", 0)) for s in many])
        for many in (cold, warm)
    ]
    assert (np.median(work[1], axis=0) < np.median(work[0], axis=0)).all()
