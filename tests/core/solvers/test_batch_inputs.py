"""A batch refuses the worlds that single calls refuse, whatever number of their data is not finite."""

import numpy as np
import pytest

import lavender as lv

VALUES = np.nan, np.inf, -np.inf


def make_arrays(dtype=np.float64):
    """Return the arrays of two worlds of two contacts over four velocities."""
    rng = np.random.default_rng(0)
    half = rng.standard_normal((2, 4, 4))
    return {
        "J": rng.standard_normal((2, 6, 4)).astype(dtype),
        "M": (0.1 * half @ half.transpose(0, 2, 1) + np.eye(4)).astype(dtype),
        "v_free": rng.standard_normal((2, 4)).astype(dtype),
        "target": rng.standard_normal((2, 6)),
        "compliance": rng.uniform(0.1, 1.0, (2, 6)),
        "mu": rng.uniform(0.1, 1.0, (2, 2)),
    }


def make_batch(arrays, law):
    """Return the batch of the arrays."""
    more = {k: v for k, v in arrays.items() if k not in ("J", "M", "v_free")}
    cones = lv.Cones.contacts([0.5, 0.5])
    return lv.Batch(arrays["J"], arrays["M"], arrays["v_free"], cones=cones, friction=law, **more)


def is_refused(call):
    """Return whether a call raises an InputError."""
    try:
        call()
    except lv.InputError:
        return True
    return False


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", ["J", "M", "v_free", "target", "compliance", "mu"])
def test_a_batch_refuses_what_a_single_call_refuses(name, dtype, law):
    arrays = make_arrays(dtype)
    shape = arrays[name].shape[1:]
    for place in np.ndindex(shape):
        for value in VALUES:
            changed = arrays | {name: arrays[name].copy()}
            changed[name][(1, *place)] = value
            batch = make_batch(changed, law)
            single = is_refused(lambda batch=batch: lv.solve(batch[1]))
            for call in (
                lambda batch=batch: lv.solve_many(batch),
                lambda batch=batch: lv.solve_many(batch, impulse=np.full(batch.shape, 0.1)),
                lambda batch=batch: lv.residual_many(batch, np.ones(batch.shape)),
            ):
                assert is_refused(call) == single, (name, place, value)
            if single:
                many = lv.solve_many(batch, errors="status")
                assert list(many.faults) == [1]


def test_unknown_options_name_the_arguments_of_the_batch():
    batch = make_batch(make_arrays(), "cone")
    with pytest.raises(lv.UnknownName, match="threads") as refused:
        lv.solve_many(batch, nothing=1)
    assert all(name in str(refused.value) for name in ("errors", "like", "impulses", "tol"))


@pytest.mark.parametrize("condition", [1e2, 1e9])
def test_float32_floors_of_islands_are_those_of_a_batch(condition):
    """`above_floor` of single calls and of batches has the same bits, and is never above the relative residual."""
    rng = np.random.default_rng(3)
    n, per, nv = 40, 3, 9
    jac = np.zeros((n, 9, nv))
    mass = np.zeros((n, nv, nv))
    for k in range(3):
        own = slice(per * k, per * k + per)
        jac[:, own, own] = rng.standard_normal((n, per, per))
        scale = np.geomspace(1.0, condition, per)
        half = rng.standard_normal((n, per, per))
        turn, _ = np.linalg.qr(half)
        mass[:, own, own] = turn @ (scale[:, None] * turn.transpose(0, 2, 1))
    mass = 0.5 * (mass + mass.transpose(0, 2, 1))
    batch = lv.Batch(
        jac, mass, rng.standard_normal((n, nv)), cones=lv.Cones.contacts([0.5] * 3), friction="cone"
    )
    exact = lv.solve_many(batch, tol=1e-8, errors="status").impulse
    impulse = np.where(rng.random((n, 9)) < 0.7, exact.astype(np.float32), 0.9 * exact)
    many = lv.residual_many(batch, impulse, precision="float32")
    several = 0
    for i in range(n):
        one = lv.residual(batch[i], impulse[i], precision="float32")
        assert many[i].above_floor == one.above_floor
        assert one.above_floor <= one.relative
        several += len(one.islands.relative) > 1
    assert several == n


@pytest.mark.parametrize("seed", range(12))
def test_batch_refuses_asymmetric_masses_as_single_calls_do_in_any_unit(seed):
    """Asymmetry is relative to the masses of both velocities, which may be far apart."""
    rng = np.random.default_rng(seed)
    unit = 10.0 ** rng.uniform(-4.0, 4.0, 3)
    gap = 10.0 ** rng.uniform(-16.0, -3.0, 8)
    masses = np.array([np.diag(unit**2)] * 8)
    i, j = rng.permutation(3)[:2]
    masses[:, i, j] += gap * unit[i] * unit[j]
    jac, free = rng.standard_normal((8, 2, 3)) * unit, rng.standard_normal((8, 3)) / unit
    bounds = {"cones": lv.Cones.bounded(np.zeros(2), np.full(2, np.inf))}

    def solve_one(k):
        return lv.solve(lv.Problem.from_jacobian(jac[k], masses[k], free[k], **bounds))

    many = lv.solve_many(lv.Batch(jac, masses, free, **bounds), errors="status")
    refused = [is_refused(lambda k=k: solve_one(k)) for k in range(8)]
    assert [k in many.faults for k in range(8)] == refused
    for k in range(8):
        assert refused[k] or many[k].impulse.tobytes() == solve_one(k).impulse.tobytes()


@pytest.mark.parametrize("seed", range(8))
def test_worlds_whose_bounds_exclude_zero_have_the_numbers_of_single_calls(seed):
    """From below and from above: the reference of the residual is that of the zero impulse within the bounds."""
    rng = np.random.default_rng(seed)
    low = rng.choice([-2.0, -0.5, 0.0, 0.3], (8, 3))
    high = low + rng.choice([0.2, 1.0, np.inf], (8, 3))
    arrays = rng.standard_normal((8, 3, 4)), np.array([np.eye(4)] * 8), rng.standard_normal((8, 4))
    cones = [lv.Cones.bounded(*x) for x in zip(low, high, strict=True)]
    jac, mass, free = arrays
    batch = lv.Batch(jac.reshape(-1, 4), mass, free, cones=cones, row_ptr=3 * np.arange(9))
    many = lv.solve_many(batch, tol=1e-9)
    judged = lv.residual_many(batch, many.impulse)
    for k in range(8):
        one = lv.solve(lv.Problem.from_jacobian(jac[k], mass[k], free[k], cones=cones[k]), tol=1e-9)
        assert many[k].impulse.tobytes() == one.impulse.tobytes()
        for found in (many, judged):
            assert found.relative[k] == one.residual.relative
            assert found.velocity_at_zero[k] == one.residual.velocity_at_zero
