"""Worlds by the thousand: the bits of single solves, whatever layout, precision, threads and bad neighbours."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest

import lavender as lv
from lavender.problem.cones import project_impulse

DISKS = lv.Cones.contacts(0.5, count=4)


def worlds(n, m=12, nv=18, seed=0, dtype=np.float64):
    """J (n, m, nv), M, v* of n random worlds whose M couples all velocities."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n, nv, nv))
    mass = root @ root.transpose(0, 2, 1) / nv + np.eye(nv)
    mass = (mass + mass.transpose(0, 2, 1)) / 2
    jac = rng.standard_normal((n, m, nv))
    free = rng.standard_normal((n, nv))
    return jac.astype(dtype), mass.astype(dtype), free.astype(dtype)


def assert_same(many, i, single):
    """The arrays and the Solution of world i have the bits of a single solve."""
    own = many[i]
    found = single.residual
    assert own.impulse.tobytes() == single.impulse.tobytes()
    for name in (
        "relative",
        "energy",
        "velocity",
        "roundoff_floor",
        "worst_row",
        "energy_at_zero",
        "velocity_at_zero",
    ):
        assert getattr(own.residual, name) == getattr(found, name), name
    assert own.residual.slack.tobytes() == found.slack.tobytes()
    assert many.impulse_error[i] == (
        abs(found.error[found.worst_row]) if found.worst_row >= 0 else 0.0
    )
    assert (
        many.relative[i],
        many.energy[i],
        many.velocity_error[i],
        many.roundoff_floor[i],
        many.worst_row[i],
    ) == (found.relative, found.energy, found.velocity, found.roundoff_floor, found.worst_row)
    assert many.status[i] is own.status is single.status
    assert many.iterations[i] == own.iterations == single.iterations
    assert (own.message, own.work) == (single.message, single.work)
    assert repr(own.stages) == repr(single.stages)  # what nobody judged in between is NaN
    assert own.status_conflict == single.status_conflict


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))]
)
def test_solve_many_results_are_copied_and_pickled(again):
    """Solutions, verdicts and derivatives, of a batch and of a list in which each goes another way."""
    batch = lv.Batch(*worlds(3), cones=DISKS)
    mixed = [batch[0], lv.Problem.contact(np.eye(3), np.ones(3), mu=[(0.5, 0.2)]), batch[1]]
    for given in (batch, mixed):
        many = lv.solve_many(given, tol=1e-10)
        found = lv.residual_many(given, [s.impulse for s in many])
        twin, verdicts = again(many), again(found)
        for name in ("impulse", "velocity", "status", "relative", "worst_row", "iterations", "ptr"):
            np.testing.assert_array_equal(getattr(twin, name), getattr(many, name))
        assert verdicts.verdict.tolist() == found.verdict.tolist() and str(verdicts[1]) == str(
            found[1]
        )
        for i in range(3):
            assert_same(twin, i, many[i])
            ones = np.ones_like(many[i].impulse)
            d = lv.derivative(given[i], many[i])
            assert again(d).jvp(b=ones).slack.tolist() == d.jvp(b=ones).slack.tolist()


# -- batches and single problems ---------------------------------------------------------------------------


def triangles(mass):
    """The lower triangles of M as (values, columns, pointers)."""
    i, j = np.tril_indices(mass.shape[1])
    return mass[:, i, j], j, np.searchsorted(i, np.arange(mass.shape[1] + 1))


def stacked(law="coulomb", dtype=np.float64, n=20):
    """Worlds of one size in arrays; "own mu": each with friction coefficients of its own."""
    jac, mass, free = worlds(n, dtype=dtype)
    target = np.linspace(0.0, 0.2, 12)
    soft = np.full((n, 12), 0.01)
    cones = lv.Cones.contacts(0.0, tangents=0, count=12) if law == "lcp" else DISKS
    mu = np.random.default_rng(1).uniform(0.0, 1.0, (n, 4)) if law == "own mu" else None
    friction = "cone" if law == "cone" else "coulomb"
    batch = lv.Batch(
        jac, mass, free, target=target, cones=cones, compliance=soft, mu=mu, friction=friction
    )
    return batch, [
        lv.Problem.from_jacobian(
            jac[i],
            mass[i],
            free[i],
            target=target,
            cones=cones if mu is None else lv.Cones.contacts(mu[i]),
            compliance=soft[i],
            friction=friction,
        )
        for i in range(n)
    ]


def laid_out(layout):
    """Worlds of 0 to 4 contacts: padded, views of wider arrays, ragged by rows, by entries, triangles of M."""
    n = 9
    (jac, mass, free) = worlds(9)
    rows = 3 * np.array([4, 1, 0, 2, 4, 3, 0, 1, 2])
    ptr = np.concatenate([[0], np.cumsum(rows)])
    each = [lv.Cones.contacts(0.4 + 0.01 * i, count=r // 3) for i, r in enumerate(rows)]
    wide = np.zeros((n, 14, 20))  # rows and velocities padded, as engines on a GPU pad them
    wide[:, :12, :18] = jac
    flat = np.concatenate([jac[i, :r] for i, r in enumerate(rows)])
    target = np.random.default_rng(3).standard_normal((n, 12))
    goal = np.concatenate([target[i, :r] for i, r in enumerate(rows)])
    whole = lv.Cones(
        ptr=np.concatenate([[0], *(c.ptr[1:] + at for c, at in zip(each, ptr, strict=False))]),
        **{
            k: np.concatenate([getattr(c, k) for c in each])
            for k in ("kind", "lower", "upper", "mu", "patch_radius")
        },
    )
    make = {
        "padded": lambda: lv.Batch(jac, mass, free, target=target, cones=each, count=rows),
        "strided": lambda: lv.Batch(
            wide[:, :12, :18], mass, free, target=target, cones=whole, count=rows
        ),
        "rows": lambda: lv.Batch(flat, mass, free, target=goal, cones=whole, row_ptr=ptr),
        "triangles": lambda: lv.Batch(
            flat, triangles(mass), free, target=goal, cones=whole, row_ptr=ptr
        ),
        "entries": lambda: lv.Batch(
            flat.ravel(),
            mass.ravel(),
            free.ravel(),
            target=goal,
            cones=each,
            row_ptr=ptr,
            velocity_ptr=18 * np.arange(n + 1),
        ),
    }
    return make[layout](), [
        lv.Problem.from_jacobian(jac[i, :r], mass[i], free[i], target=target[i, :r], cones=each[i])
        for i, r in enumerate(rows)
    ]


def with_zeros(dtype):
    """Triangles of M: in every other world every other entry off the diagonal is 0, which its factor passes over."""
    jac, mass, free = worlds(4, dtype=dtype)
    i, j = np.tril_indices(18)
    mass[::2, i[1::2], j[1::2]] *= i[1::2] == j[1::2]
    mass[::2, j[1::2], i[1::2]] *= i[1::2] == j[1::2]
    return lv.Batch(jac, triangles(mass), free, cones=DISKS), [
        *lv.Batch(jac, mass, free, cones=DISKS)
    ]


def with_zeros_that_come_and_go(step):
    """One more in each world, which elimination fills; in the last a velocity no longer reaches those before it."""
    jac, mass, free = worlds(8)
    jac[:, :6, :17] = 0.0
    for k in range(1, 7):
        at = (1, 2, 2, 3, 3, 3)[:k], (0, 0, 1, 0, 1, 2)[:k]
        mass[k][at] = mass[k][at[::-1]] = 0.0
    mass[7, 17, 11:17] = mass[7, 11:17, 17] = 0.0
    jac, mass, free = jac[::step], mass[::step], free[::step]
    return lv.Batch(jac, triangles(mass), free, cones=DISKS), [
        *lv.Batch(jac, mass, free, cones=DISKS)
    ]


def of_several_sizes():
    small = worlds(3, 6, 7)
    large = worlds(2, 6, 11, seed=4)
    jac, mass, free = (
        np.concatenate([x.ravel(), y.ravel()]) for x, y in zip(small, large, strict=True)
    )
    cones = lv.Cones.contacts(0.3, count=2)
    ptr = {"row_ptr": 6 * np.arange(6), "velocity_ptr": [0, 7, 14, 21, 32, 43]}
    return lv.Batch(jac, mass, free, cones=cones, friction="cone", **ptr), [
        lv.Problem.from_jacobian(*(x[i] for x in given), cones=cones, friction="cone")
        for given, n in ((small, 3), (large, 2))
        for i in range(n)
    ]


def ill_conditioned():
    """Residuals of worlds are refined if M is ill-conditioned."""
    jac, mass, free = worlds(5, 12, 7)
    for i, condition in enumerate((1e2, 1e6, 1e8, 1e10, 1e12)):
        basis = np.linalg.qr(mass[i])[0]
        mass[i] = (basis * np.geomspace(1.0, condition, 7)) @ basis.T
    batch = lv.Batch(jac, 0.5 * (mass + mass.transpose(0, 2, 1)), free, cones=DISKS)
    return batch, [*batch]


def boxes(friction):
    """Return stacks of two boxes of different masses, friction and targets, as bodies."""
    rng = np.random.default_rng(5)
    corners = np.array([(x, y, 0.0) for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    up = np.array([0.0, 0.0, 0.5])
    single = [
        lv.Problem.from_rows(
            lv.Rows(
                inv_mass=rng.uniform(0.5, 2.0, 2),
                inv_inertia=np.tile(6.0 * np.eye(3), (2, 1, 1)),
                v_free=[0.3, 0.0, -0.16, 0.0, 0.0, 0.0] + 0.05 * rng.standard_normal((2, 6)),
                contact_body=np.repeat([(-1, 0), (0, 1)], 4, axis=0),
                normal=np.tile([0.0, 0.0, 1.0], (8, 1)),
                tangent=np.tile([1.0, 0.0, 0.0], (8, 1)),
                arm_a=np.tile(corners + up, (2, 1)),
                arm_b=np.tile(corners - up, (2, 1)),
            ),
            mu=rng.uniform(0.1, 1.0, 8),
            friction=friction,
            compliance=0.01,
            target=0.1 * rng.standard_normal(24),
        )
        for _ in range(6)
    ]
    return single, single


def listed():
    """Problems of several forms and precisions; those of J and M take the compiled loop of batches."""
    single = [
        *stacked(n=3)[1],
        *stacked(dtype=np.float32, n=2)[1],
        lv.Problem.lcp(np.eye(2), [1.0, -1.0]),
        lv.Problem.contact(2.0 * np.eye(3), [1.0, 0.5, 0.0], 0.3),
    ]
    return single, single


#: Batches and the same problems one by one.
BATCHES = {
    **{
        f"{law}, {x.__name__}": lambda law=law, x=x: stacked(law, x)
        for law in ("lcp", "coulomb", "cone", "own mu")
        for x in (np.float64, np.float32)
    },
    **{
        name: lambda name=name: laid_out(name)
        for name in ("padded", "strided", "rows", "triangles", "entries")
    },
    **{f"zeros of M, {x.__name__}": lambda x=x: with_zeros(x) for x in (np.float64, np.float32)},
    **{f"zeros of M by {k}": lambda k=k: with_zeros_that_come_and_go(k) for k in (1, -1)},
    "several sizes": of_several_sizes,
    "ill-conditioned M": ill_conditioned,
    "a list": listed,
    **{f"bodies, {law}": lambda law=law: boxes(law) for law in ("coulomb", "cone")},
}


@pytest.mark.parametrize("name", BATCHES)
def test_a_world_has_the_bits_of_its_single_solve(name):
    """The solve, its verdict, and that of other impulses, each for the precision of the data and others."""
    given, single = BATCHES[name]()
    many = lv.solve_many(given, tol=1e-8, threads=2)
    start = 0
    for i, problem in enumerate(single):
        assert given[i] == problem and given[i].precision == problem.precision
        solution = lv.solve(problem, tol=1e-8)
        assert_same(many, i, solution)
        velocity = (
            problem.velocity(solution.impulse).ravel() if problem.matrix is None else np.zeros(0)
        )
        assert many.velocity.ravel()[start : start + velocity.size].tobytes() == velocity.tobytes()
        start += velocity.size
    impulses = [np.float32(s.impulse) * (0.99 if i % 2 else 1.0) for i, s in enumerate(many)]
    listed = impulses if many.impulse.ndim == 1 else np.zeros_like(many.impulse)
    for row, x in zip(listed, impulses, strict=True):  # of a padded batch
        row[: len(x)] = x
    if isinstance(given, lv.Batch) and many.impulse.ndim == 1:
        listed = np.concatenate(impulses)
    for precision in (None, "float32", "float64"):
        found = lv.residual_many(given, listed, precision=precision, threads=2)
        for i, (problem, impulse) in enumerate(zip(single, impulses, strict=True)):
            one = lv.residual(problem, impulse, precision=precision)
            assert (
                one.relative,
                one.energy,
                one.velocity,
                one.worst_row,
                one.verdict,
                one.roundoff_floor,
            ) == (
                found.relative[i],
                found.energy[i],
                found.velocity_error[i],
                found.worst_row[i],
                found.verdict[i],
                found.roundoff_floor[i],
            )
            own = found[i]
            assert (str(own), own.verdict, own.rounding) == (str(one), one.verdict, one.rounding)
            for field in dataclasses.fields(one):
                if field.name != "_problem":
                    np.testing.assert_array_equal(
                        getattr(own, field.name), getattr(one, field.name), field.name
                    )


def test_first_numbers_of_a_world_are_read_from_the_arrays(monkeypatch):
    """The problem of a world, which takes longer than many solves, is built only for its rows and names."""
    batch = lv.Batch(*worlds(3), cones=DISKS)
    many = lv.solve_many(batch, impulse=np.ones((3, 12)))
    found = lv.residual_many(batch, 0.9 * many.impulse)
    with monkeypatch.context() as patch:
        patch.delattr(lv.Batch, "get_world")
        for i in range(3):
            assert many[i].success and many[i].residual.relative == many.relative[i]
            assert (
                many[i].impulse.tolist() == many.impulse[i].tolist()
                and many[i].start == "the given impulses"
            )
            assert (found[i].relative, found[i].worst_row) == (
                found.relative[i],
                found.worst_row[i],
            )
    assert found[1].worst_name == batch[1].row_name(found.worst_row[1])


def test_each_column_of_a_table_of_worlds_is_that_number_of_each_world():
    many = lv.solve_many(lv.Batch(*worlds(3), cones=DISKS), "pgs", max_iter=3)
    table = many.to_pandas()
    for i, row in table.iterrows():
        one = many[i].residual
        assert (row.relative, row.energy) == (one.relative, one.energy)
        assert row.roundoff_floor == one.roundoff_floor
        assert row.velocity_error == pytest.approx(one.velocity, rel=1e-12)
        assert row.impulse_error == pytest.approx(abs(one.error[one.worst_row]), rel=1e-12)
        assert (row.status, row.iterations) == (many[i].status.name, many[i].iterations)
        assert row.worst_row == one.worst_name


def test_batch_reads_its_arrays_at_each_solve():
    wide = np.zeros((2, 14, 20))
    jac, mass, free = worlds(2)
    wide[:, :12, :18] = jac
    batch = lv.Batch(wide[:, :12, :18], mass, free, cones=DISKS)
    before = lv.solve_many(batch).impulse.copy()
    wide[0] *= 2.0
    after = lv.solve_many(batch)
    assert after.relative[0] <= 1e-6 and (after.impulse[0] != before[0]).any()
    assert after.impulse[1].tobytes() == before[1].tobytes()


def test_solve_many_begins_at_the_given_impulses():
    jac, mass, free = worlds(6)
    batch = lv.Batch(jac, mass, free, cones=DISKS, friction="cone")
    cold = lv.solve_many(batch, tol=1e-9)
    start = cold.impulse.copy()
    start[3] *= 0.5
    warm = lv.solve_many(batch, tol=1e-8, impulse=start)
    assert (warm.iterations[[0, 1, 2, 4, 5]] == 0).all() and warm.iterations[3] > 0
    for i in range(6):
        assert_same(warm, i, lv.solve(batch[i], tol=1e-8, impulse=start[i]))


def spoiled(jac, mass, free, mu):
    jac[2, 0, 0] = np.nan
    mass[4] = -mass[4]
    mu[5, 1] = -0.1
    mass[7, 0, 1] += 1e-3  # not symmetric
    free[8, 3] = np.inf
    return {
        2: "J must be finite",
        4: "not positive definite",
        5: "mu must not be negative",
        7: "not symmetric",
        8: "v_free",
    }


@pytest.mark.parametrize("threads", [1, 2])
def test_invalid_world_of_a_batch_is_named_and_others_are_solved(threads):
    jac, mass, free = worlds(10)
    mu = np.full((10, 4), 0.5)
    clean = lv.solve_many(lv.Batch(jac.copy(), mass.copy(), free.copy(), cones=DISKS, mu=mu.copy()))
    words = spoiled(jac, mass, free, mu)
    batch = lv.Batch(jac, mass, free, cones=DISKS, mu=mu)
    with pytest.raises(lv.InputError, match="world 2: J must be finite"):
        lv.solve_many(batch, threads=threads)
    many = lv.solve_many(batch, threads=threads, errors="status")
    found = lv.residual_many(batch, clean.impulse, threads=threads, errors="status")
    for i in range(10):
        if i in words:
            assert words[i] in str(many.faults[i]) and f"world {i}:" in str(many.faults[i])
            assert (
                many.status[i] is lv.Status.INVALID_PROBLEM
                and np.isnan(many.relative[i])
                and not many.success[i]
            )
            assert found.verdict[i] == "" and np.isnan(found.relative[i]) and i in found.faults
            with pytest.raises(lv.InputError, match=f"world {i}:"):
                many[i]
            # A zero would look like an answer.
            assert np.isnan(many.impulse[i]).all() and np.isnan(many.velocity[i]).all()
            assert many.iterations[i] == 0 and many.worst_row[i] == -1
        else:
            assert many.impulse[i].tobytes() == clean.impulse[i].tobytes()
            assert found.relative[i] == clean.relative[i]
    assert [one.impulse.tobytes() for one in many[many.success]] == [
        many.impulse[i].tobytes() for i in range(10) if i not in words
    ]


def test_solve_many_index_selects_worlds_as_entries_of_an_array():
    batch = lv.Batch(*worlds(5), cones=DISKS)
    many = lv.solve_many(batch)
    found = lv.residual_many(batch, many.impulse)
    mask = np.array([True, False, False, True, False])
    for which in (mask, mask.tolist(), [0, 3], np.array([0, -2]), slice(0, 5, 3)):
        assert [one.impulse.tobytes() for one in many[which]] == [
            many.impulse[i].tobytes() for i in (0, 3)
        ]
        assert [one.relative for one in found[which]] == found.relative[[0, 3]].tolist()
        assert batch[which] == [batch[0], batch[3]]
    assert many[np.int64(3)] is many[3] and many[[]] == []
    for wrong in (5, -6, mask[:4], [5]):
        with pytest.raises(IndexError):
            many[wrong]
    with pytest.raises(IndexError, match="world 5 does not exist; there are 5"):
        batch[5]


def test_solve_many_of_a_list_begins_at_its_impulses():
    given = [*lv.Batch(*worlds(2), cones=DISKS), lv.Problem.lcp(np.eye(2), [1.0, -1.0])]
    many = lv.solve_many(given)
    assert many.ptr.tolist() == [0, 12, 24, 26] and len(many.velocity) == 2 * 18
    assert len(lv.solve_many([])) == 0
    warm = lv.solve_many(given[:2], impulses=[many[0].impulse, None])
    assert warm[0].iterations == 0 < warm[1].iterations


@pytest.mark.parametrize("listed", [False, True])
def test_solve_many_with_a_start_that_is_not_finite_fails_in_its_world_only(listed):
    batch = lv.Batch(*worlds(6), cones=DISKS)
    clean = lv.solve_many(batch, tol=1e-8)
    start = clean.impulse.copy()
    start[2, 5], start[4] = np.nan, np.inf
    given, starts = (list(batch), {"impulses": start}) if listed else (batch, {"impulse": start})
    with pytest.raises(lv.InputError, match=r"world 2: impulse \[N s\] is nan at row 5"):
        lv.solve_many(given, tol=1e-8, **starts)
    many = lv.solve_many(given, tol=1e-8, errors="status", **starts)
    impulse, velocity = many.impulse.reshape(6, -1), many.velocity.reshape(6, -1)
    assert sorted(many.faults) == [2, 4] and not many.success[[2, 4]].any()
    assert many.iterations[[2, 4]].tolist() == [0, 0] and many.worst_row[[2, 4]].tolist() == [
        -1,
        -1,
    ]
    assert np.isnan(impulse[[2, 4]]).all() and np.isnan(velocity[[2, 4]]).all()
    for i in (0, 1, 3, 5):
        # Each start is a solution; its friction exceeded its bound by at most 4e-12 of it, and is projected on it.
        np.testing.assert_allclose(impulse[i], project_impulse(DISKS, start[i]), rtol=1e-15)
        np.testing.assert_allclose(impulse[i], start[i], rtol=1e-11)
        assert many.iterations[i] == 0
    again = start.copy()
    inside = [0, 1, 3, 5]
    again[inside] = impulse[inside].reshape(again[inside].shape)
    starts = {"impulses" if listed else "impulse": again}
    again = lv.solve_many(given, tol=1e-8, errors="status", **starts).impulse.reshape(6, -1)
    assert again[inside].tobytes() == impulse[inside].tobytes()
