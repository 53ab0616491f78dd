"""Numbers at the door: a problem in other units is the same problem, or refused by the name of the number.

Units are scaled by powers of four, so that every number, its square root and all that a solver makes of them keep
their bits.
"""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from random_problems import CONTACTS, FORMS, random_contact_problem, seeds

import lavender as lv

MOST, LEAST = 1e60, 1e-60
exponents = st.tuples(*[st.integers(-110, 110)] * 3)
near = st.tuples(*[st.integers(-40, 40)] * 3)


def joints(seed, friction, free=False, **sizes):
    """Rows of joints alone, bounded or free."""
    made = random_contact_problem(seed, friction, bodies=4, joints=4, contacts=0)
    ends = np.full(made.m, np.inf)
    cones = replace(made.cones, lower=-ends, upper=ends) if free else made.cones
    return replace(made, cones=cones, compliance=made.compliance + 0.1)


KINDS = CONTACTS | {"bounded rows": joints, "free rows": partial(joints, free=True)}


def drawn(kind, form, seed):
    """A problem given in this form, and which of its rows turn: their speeds are angular."""
    friction = ("coulomb", "cone")[seed % 2]
    rows = KINDS[kind](seed, friction, bodies=3, joints=1, contacts=3)
    turns = np.zeros(rows.m, bool)
    turns[rows.cones.spin_rows[rows.cones.spin_rows >= 0]] = True
    for k in (0, 1):
        turns[rows.cones.rolling_rows[rows.cones.rolling_rows >= 0] + k] = True
    return FORMS[form](rows), turns


def in_units(problem, turns, exponent):
    """With 1/kg, m/s and m 4^exponent times as large: (make, what the door looks at, impulse scale (m,), empty)."""
    mobile, speed, length = (4.0**k for k in exponent)
    if problem.matrix is not None:
        length = 1.0  # entries of rows in other units are compared by `d`
    c, row = problem.cones, np.where(turns, 1.0 / length, 1.0)
    impulse = speed / mobile / row
    radius = np.where(np.isin(c.kind, (lv.CONTACT_BOX, lv.CONTACT_ELLIPSE)), 1.0, length) * c.patch_radius
    arrays = SimpleNamespace(
        b=problem.b * speed * row,
        lower=c.lower * impulse,
        upper=c.upper * impulse,
        mu=c.mu,
        patch_radius=radius,
        rolling=c.rolling * length,
    )
    sizes = [c.mu, radius, c.mu * radius, arrays.rolling, [np.abs(arrays.b).max()]]
    more = {"d": problem.d * mobile * row**2}
    of_row = problem.delassus().diagonal() if problem.matrix is None else np.abs(problem.dense()).max(axis=1)
    cones = lambda: replace(  # noqa: E731
        c, lower=arrays.lower, upper=arrays.upper, patch_radius=radius, rolling=arrays.rolling
    )
    if problem.compliance is not None:
        more["compliance"] = problem.compliance * mobile * row**2
        sizes.append(more["compliance"])
    if problem.matrix is not None:
        entries = problem.dense() * mobile * row[:, None] * row
        more = {"A": entries}

        def make():
            return lv.Problem(arrays.b, cones(), entries, friction=problem.friction)

    elif problem.rows is not None:
        r = problem.rows
        jac, free = r.jac * np.tile([1.0, length], (2, 1)).repeat(3, axis=1).ravel(), r.v_free.copy()
        free[:, :3] *= speed
        free[:, 3:] *= speed / length
        fields = {
            "inv_mass": r.inv_mass * mobile,
            "inv_inertia": r.inv_inertia * mobile / length**2,
            "v_free": free,
            "jac": jac,
            "arm_a": r.arm_a * length,
            "arm_b": r.arm_b * length,
        }
        sizes += [fields["inv_mass"], np.abs(fields["inv_inertia"]).max(axis=(1, 2))]
        more |= fields

        def make():
            made = replace(r, **fields)
            return lv.Problem(
                arrays.b, cones(), rows=made, compliance=more["compliance"], friction=problem.friction
            )

    else:
        g = problem.generalized
        column = np.tile([1.0, 1.0, 1.0, length, length, length], g.nv // 6)
        mass = g.mass.toarray() * column[:, None] * column / mobile
        jac, free = g.jac.toarray() * row[:, None] * column, g.v_free * speed / column
        pivot = np.linalg.cholesky(g.mass.toarray()[::-1, ::-1]).diagonal()[::-1] ** 2 * column**2 / mobile
        sizes.append(pivot)
        more |= {"J": jac, "M": mass, "v_free": free}

        def make():
            return lv.Problem(
                arrays.b, cones(), generalized=lv.Generalized(jac, mass, free), compliance=more["compliance"],
                friction=problem.friction,
            )  # fmt: skip

    is_empty = bool(np.any(of_row * mobile * row**2 < LEAST))
    return make, (vars(arrays) | more, sizes), impulse, is_empty


def fits(numbers, sizes):
    """Whether every number is at most 1e60, and every size 0 or at least 1e-60."""
    inside = all(np.all(np.isinf(x) | (np.abs(x) <= MOST)) for x in numbers.values())
    return inside and all(np.all((np.asarray(x) == 0.0) | (np.asarray(x) >= LEAST)) for x in sizes)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds, exponent=exponents | near)
@settings(max_examples=10)
def test_a_problem_in_any_units_is_refused_by_name_or_judged_alike(kind, form, seed, exponent):
    problem, turns = drawn(kind, form, seed)
    lam = np.random.default_rng(seed).normal(size=problem.m)
    make, (numbers, sizes), scale, is_empty = in_units(problem, turns, exponent)
    if not fits(numbers, sizes):
        with pytest.raises(lv.InputError, match=r"1e[+-]60.* unit|1e-18 to 1e18"):
            lv.residual(make(), lam)
        return
    if is_empty:
        return  # rows that count as empty have another metric
    usual, found = lv.residual(problem, lam), lv.residual(make(), lam * scale)
    assert (found.relative, found.floor) == (usual.relative, usual.floor)
    assert found.worst_row == usual.worst_row


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", KINDS)
@given(seed=seeds, exponent=near)
@settings(max_examples=3)
def test_every_solver_solves_a_problem_in_any_units_alike(kind, form, seed, exponent):
    problem, turns = drawn(kind, form, seed)
    for name in lv.available(problem, external=False):
        # where rows turn, a solver may take steps from sums over rows of different units
        units = (*exponent[:2], 0) if turns.any() else exponent
        make, (numbers, sizes), scale, is_empty = in_units(problem, turns, units)
        if not fits(numbers, sizes) or is_empty:
            continue
        usual, found = (lv.solve(p, name, tol=1e-8, max_iter=200) for p in (problem, make()))
        assert (found.status, found.iterations) == (usual.status, usual.iterations), name
        np.testing.assert_array_equal(found.impulse, usual.impulse * scale, err_msg=name)


def of_two(jac=(1.0, 1.0), mass=(1.0, 1.0), v_free=(1.0, 1.0), **given):
    """Two rows on two velocities, each on its own."""
    return lv.Problem.from_jacobian(np.diag(jac), np.diag(mass), v_free, cones=lv.Cones.free(2), **given)


def worlds(jac):
    one = np.ones((3, 1))
    return lv.Batch(
        np.full((3, 1, 1), jac), np.ones((3, 1, 1)), 0.0 * one, target=one, cones=lv.Cones.free(1)
    )


OUTSIDE = {
    "b": lambda: lv.Problem.lcp(np.eye(2), [1.0, 1e61]),
    "b, too small": lambda: lv.Problem.lcp(np.eye(2), [1e-61, -1e-70]),
    "A": lambda: lv.Problem.lcp(np.diag([1.0, 1e61]), [1.0, 1.0]),
    "upper": lambda: lv.Problem.lcp(np.eye(2), [1.0, 1.0], 0.0, [1.0, 1e300]),
    "mu": lambda: lv.Cones.contacts([0.5, 1e-61]),
    "patch_radius": lambda: lv.Cones.contacts(0.5, patch_radius=[1e61]),
    "mu patch_radius": lambda: lv.Cones.contacts([1e-40], patch_radius=[1e-40]),
    "rolling": lambda: lv.Cones.contacts(0.5, rolling=[1e-200]),
    "compliance": lambda: of_two(compliance=[1.0, 1e-70]),
    "M": lambda: of_two(mass=(1.0, 1e-61)),
    "J": lambda: of_two(jac=(1.0, 1e61)),
    "v_free": lambda: of_two(v_free=(0.0, -1e61)),
    "A_ii of J and M": lambda: lv.solve(of_two(jac=(1.0, 1e40), target=[1.0, 1.0])),
    "a world": lambda: worlds(1e40)[1].d,
    "updated": lambda: lv.Problem.lcp(np.eye(2), [1.0, 1.0]).updated(b=[1.0, 1e61]),
    "a scene": lambda: lv.Scene(friction=1e-61),
    "gravity": lambda: lv.Scene(gravity=1e61),
    "mass": lambda: lv.Scene().add_box(mass=1e-61),
}  # fmt: skip


@pytest.mark.parametrize("what", OUTSIDE)
def test_what_is_outside_is_refused_with_what_came_and_what_is_needed(what):
    with pytest.raises(lv.InputError) as told:
        OUTSIDE[what]()
    words = str(told.value)
    assert what.split(",")[0].split(" of ")[0].removeprefix("a ") in words or what in (
        "a world",
        "updated",
        "a scene",
    )
    assert "e+60" in words or "e-60" in words


@pytest.mark.parametrize("form", ["A", "J and M"])
def test_a_row_of_dust_is_an_empty_row(form):
    """Largest entry below 1e-60: its d is the others', and nothing is divided by it."""
    dust = 1e-61
    if form == "A":
        problem = lv.Problem([1.0, 0.0], lv.Cones.free(2), np.diag([1.0, dust]))
    else:
        problem = of_two(jac=(1.0, dust), v_free=(0.0, 0.0), target=[1.0, 0.0])
    assert problem.metric.empty.tolist() == [1] and problem.d.tolist() == [1.0, 1.0]
    assert lv.solve(problem, "auto").success
    asked = problem.updated(b=[1.0, 1.0])
    found = lv.solve(asked, "auto")
    assert not found.success or found.residual.relative <= 1e-6
    assert found.status is not lv.Status.INFEASIBLE or found.claim_check == "confirmed"


LAYOUTS = {
    "other bytes": lambda x: x.astype(x.dtype.newbyteorder()),
    "whole numbers": lambda x: x.astype(np.int64),
    "every other": lambda x: np.repeat(x, 2, axis=-1)[..., ::2],
    "columns": np.asfortranarray,
    "at an odd byte": lambda x: (
        np.frombuffer(b" " + x.tobytes(), np.uint8)[1:].view(x.dtype).reshape(x.shape)
    ),
}


@pytest.mark.parametrize("copy", [True, False])
@pytest.mark.parametrize("laid", LAYOUTS.values(), ids=LAYOUTS)
def test_arrays_in_any_layout_hold_the_same_problem(laid, copy):
    a, b, reach = np.array([[3.0, 1.0], [1.0, 2.0]]), np.array([1.0, -2.0]), np.array([4.0, 5.0])

    def made(way):
        cones = lv.Cones.bounded(way(-reach), way(reach))
        return lv.Problem(way(b), cones, way(a), copy=copy)

    assert made(laid) == made(np.copy)
    assert np.array_equal(lv.residual(made(laid), laid(b)).velocity, lv.residual(made(np.copy), b).velocity)
