"""Worlds are processed in lanes of vectors, with the bits of single calls for every width."""

import numpy as np
import pytest
from random_problems import ancestors, tree_mass

import lavender as lv
from lavender.batch.data import Batch

NUMBERS = (
    "relative",
    "energy",
    "velocity_error",
    "impulse_error",
    "roundoff_floor",
    "velocity_at_zero",
    "worst_row",
)
SIZES = [(3, 6, 5), (12, 18, 21), (18, 9, 10), (30, 36, 9), (15, 1, 9)]


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


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("rows, nv, n", SIZES)
def test_lanes_have_the_bits_of_single_calls(width, rows, nv, n, law):
    batch = make_batch(rows // 3, nv, n, law)
    many = lv.solve_many(batch)
    impulses = (
        many.impulse,
        np.abs(many.impulse) * 1e8,
        np.random.default_rng(1).standard_normal((n, rows)),
    )
    judged = [(x, lv.residual_many(batch, x)) for x in impulses]
    for i in range(n):
        one = lv.solve(batch[i])
        assert many.impulse[i].tobytes() == one.impulse.tobytes()
        assert many.velocity[i].tobytes() == batch[i].velocity(one.impulse).tobytes()
        assert (many.status[i], many.iterations[i]) == (one.status, one.iterations)
        assert many.relative[i] == one.residual.relative
        assert many.roundoff_floor[i] == one.residual.roundoff_floor
        for x, found in judged:
            single = lv.residual(batch[i], x[i])
            for name, of_one in zip(
                NUMBERS,
                (
                    single.relative,
                    single.energy,
                    single.velocity,
                    None,
                    single.roundoff_floor,
                    single.velocity_at_zero,
                    single.worst_row,
                ),
                strict=True,
            ):
                assert of_one is None or getattr(found, name)[i] == of_one, name


def test_lanes_solve_all_worlds_that_an_impulse_moves(width):
    batch = make_batch(4, 18, 64, "cone", seed=3)
    many = lv.solve_many(batch)
    assert many.success[1:].all()  # No impulse moves the empty rows of world 0.
    assert lv.residual_many(batch, many.impulse).relative[1:].max() <= 1e-6
    assert np.median(many.iterations) <= 5  # Newton steps over velocities are twice as many.


def make_tree_batch(law, seed=1):
    """Return ragged worlds of twelve structures over trees, with bounded and free rows and contacts between them.

    Some worlds have several islands, a zero in M, or a zero impulse outside the bounds.
    """
    rng = np.random.default_rng(seed)
    nv, n = 14, 34
    parent = [-1, 0, 0, 2, 3, 4, 2, 6, 7, 0, 9, 10, -1, 12]
    below = [np.array(sorted(ancestors(parent, i))) for i in range(nv)]
    blocks = [
        lv.Cones.contacts(0.7, count=2)
        + lv.Cones.bounded([0.0, -0.1, -np.inf], [np.inf, 0.1, np.inf]),
        lv.Cones.bounded([0.0] * 8, [np.inf] * 8),
        lv.Cones.bounded([0.0], [np.inf])
        + lv.Cones.contacts([0.3, 1.0], count=2)
        + lv.Cones.bounded([-0.2], [0.2]),
    ]
    more = [lv.Cones.bounded([0.0] * k, [np.inf] * k) for k in range(4)]
    cones = [blocks[int(rng.integers(0, 3))] + more[int(rng.integers(0, 4))] for _ in range(n)]
    cones[3] = lv.Cones.bounded([0.1], [1.0])
    rows = [c.n_rows for c in cones]
    jac = [np.zeros((m, nv)) for m in rows]
    for i, (c, of_world) in enumerate(zip(cones, jac, strict=True)):
        for first, last in zip(c.ptr[:-1], c.ptr[1:], strict=True):
            on = below[int(rng.integers(0, nv if i % 8 == 0 else 12))]
            of_world[first:last, on] = rng.normal(size=(last - first, len(on)))
    mass = np.array([tree_mass(rng, parent) for _ in range(n)])
    mass[5, 4, 3] = mass[5, 3, 4] = 0.0
    lower = [(i, j) for i in range(nv) for j in below[i]]
    values = np.array([[m[i, j] for i, j in lower] for m in mass])
    pattern = np.array([j for _, j in lower]), np.cumsum([0] + [len(x) for x in below])
    compliance = [rng.uniform(1e-3, 0.1, m) for m in rows]
    return lv.Batch(
        np.concatenate(jac),
        (values, *pattern),
        rng.normal(size=n * nv),
        target=rng.normal(size=sum(rows)),
        cones=cones,
        compliance=np.concatenate(compliance),
        friction=law,
        row_ptr=np.cumsum([0, *rows]),
    )


@pytest.mark.parametrize("tol", [1e-6, 1e-9])
@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_mixed_worlds_over_trees_have_the_bits_of_single_calls(width, law, tol):
    batch = make_tree_batch(law)
    many = lv.solve_many(batch, tol=tol)
    judged = lv.residual_many(batch, many.impulse + 1e-4)
    for i in range(len(batch)):
        rows = batch.rows_of(i)
        one = lv.solve(batch[i], tol=tol)
        assert many.impulse[rows].tobytes() == one.impulse.tobytes()
        assert (many.status[i], many.iterations[i]) == (one.status, one.iterations)
        assert (many.relative[i], many.roundoff_floor[i]) == (
            one.residual.relative,
            one.residual.roundoff_floor,
        )
        single = lv.residual(batch[i], many.impulse[rows] + 1e-4)
        assert judged.relative[i] == single.relative
        assert (judged.roundoff_floor[i], judged.worst_row[i]) == (
            single.roundoff_floor,
            single.worst_row,
        )
    assert many.success.all()


@pytest.mark.parametrize("law", ["coulomb", "cone"])
def test_starts_worse_than_zero_are_replaced_by_zero(law):
    batch = make_batch(4, 18, 24, law, seed=5)
    size = 1.0 + lv.solve_many(batch).impulse
    far, further = (lv.solve_many(batch, impulse=scale * size) for scale in (1e5, 3e6))
    assert far.success[1:].all()  # No impulse moves the empty rows of world 0.
    assert far.impulse.tobytes() == further.impulse.tobytes()
    assert far.impulse[5].tobytes() == lv.solve(batch[5], impulse=1e5 * size[5]).impulse.tobytes()
