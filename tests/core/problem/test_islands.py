"""The residual by islands: rows that do not act, and bodies that never meet, change no verdict about the others."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from extreme_problems import plain_data
from hostile_problems import draw_body_problem
from hypothesis import given
from hypothesis import strategies as st
from judge_twin import Problem as Twin
from random_problems import (
    CONTACTS,
    FORMS,
    as_matrix,
    random_contact_problem,
    random_generalized_problem,
    seeds,
    side_by_side,
    touching,
    with_ground_as_body,
)

import lavender as lv
from lavender.problem.ordering import compute_block_colors, compute_block_levels_from_ground
from lavender.solvers.islands import find_islands
from lavender.solvers.registry import get

# Sums over an island's rows alone and next to others add in the same order, but what is made of the data (M's factor, d
# of two tangents) may round differently: a few dozen roundings of 2^-53.
ROUNDING = 1e-13


def rows_side_by_side(first, second):
    """Two problems of bodies as one; joints come before contacts, so the block order is not that of the two."""
    p = first.rows
    q = second.rows
    n = first.rows.n_bodies

    def shifted(bodies):
        return np.where(bodies < 0, -1, bodies + n).astype(np.int32)

    rows = lv.Rows(
        **{
            name: np.concatenate([getattr(p, name), getattr(q, name)])
            for name in (
                "inv_mass",
                "inv_inertia",
                "v_free",
                "jac",
                "normal",
                "tangent",
                "arm_a",
                "arm_b",
            )
        },
        joint_ptr=np.concatenate([p.joint_ptr, p.joint_ptr[-1] + q.joint_ptr[1:]]).astype(np.int32),
        joint_body=np.concatenate([p.joint_body, shifted(q.joint_body)]),
        contact_body=np.concatenate([p.contact_body, shifted(q.contact_body)]),
    )
    j, k, c, d = p.n_joints, q.n_joints, p.n_contacts, q.n_contacts
    cones = first.cones + second.cones
    order = np.concatenate(
        [np.arange(j), j + c + np.arange(k), j + np.arange(c), j + c + k + np.arange(d)]
    ).astype(int)
    size = np.diff(cones.ptr)
    row_order = np.concatenate(
        [np.arange(cones.ptr[i], cones.ptr[i] + size[i]) for i in order]
    ).astype(int)
    b = np.concatenate([first.b, second.b])[row_order]
    compliance = np.concatenate([first.compliance, second.compliance])[row_order]
    both = lv.Problem(
        b, cones.select(order), rows=rows, compliance=compliance, friction=first.friction
    )
    return both, row_order


def general_side_by_side(first, second):
    """Two problems in generalised coordinates as one."""
    p, q = first.generalized, second.generalized
    cones = first.cones + second.cones
    jac = sp.block_diag([p.jac, q.jac]).toarray()
    both = lv.Problem.from_jacobian(
        jac,
        sp.block_diag([p.mass, q.mass]).toarray(),
        np.concatenate([p.v_free, q.v_free]),
        cones=cones,
        compliance=np.concatenate([first.compliance, second.compliance]),
        friction=first.friction,
    )
    return both.updated(b=np.concatenate([first.b, second.b])), np.arange(both.m)


def together(first, second):
    """(both as one problem, place of each row of the two in it)."""
    if first.matrix is not None:
        return side_by_side([first, second]), np.arange(first.m + second.m)
    return (rows_side_by_side if first.rows is not None else general_side_by_side)(first, second)


def scaled(problem, factor):
    """The same problem with all velocities `factor` times as large, so that its impulses are."""
    if problem.matrix is not None:
        return replace(problem, b=factor * problem.b)
    return problem.updated(b=factor * problem.b)


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("kind", CONTACTS)
@pytest.mark.parametrize("form", FORMS)
@given(seed=seeds, power=st.integers(-6, 6))
def test_the_residual_of_two_problems_side_by_side_is_the_larger_one(
    form, kind, friction, seed, power
):
    first, second = (
        FORMS[form](CONTACTS[kind](seed + i, friction, bodies=3, joints=2, contacts=3))
        for i in range(2)
    )
    second = scaled(second, 10.0**power)
    both, rows = together(first, second)
    rng = np.random.default_rng(seed)
    lam = [rng.normal(size=first.m), 10.0**power * rng.normal(size=second.m)]
    lam[seed % 2] = lv.solve((first, second)[seed % 2], tol=1e-9).impulse
    alone = [lv.residual(p, x) for p, x in zip((first, second), lam, strict=True)]
    found = lv.residual(both, np.concatenate(lam)[rows])
    worst = max(r.relative for r in alone)
    # The residual of a solved problem is rounding, which the order of additions changes: as much as its floor.
    slack = ROUNDING * worst + 4.0 * max(r.roundoff_floor for r in alone)
    assert abs(found.relative - worst) <= slack
    if kind != "ellipses":  # whose rows are stretched
        count = sum(find_islands(p)[0] for p in (first, second))
        assert len(found.islands.relative) == find_islands(both)[0] == count
        np.testing.assert_allclose(
            np.sort(found.islands.relative),
            np.sort(np.concatenate([r.islands.relative for r in alone])),
            rtol=1e-9,
            atol=slack,
        )


def with_inactive_rows(problem, rng, sizes):
    """A problem in generalised coordinates and more rows of every kind, whose bounds hold them at zero impulse.

    Some touch nothing, the others a velocity that one of the problem's rows touches: no row connects two islands.
    """
    g = problem.generalized
    n = len(sizes)
    touched = np.flatnonzero(np.abs(g.jac.toarray()).any(axis=0))
    jac = np.zeros((5 * n, g.nv))
    at = np.concatenate([rng.choice(touched, 2 * n), np.repeat(rng.choice(touched, n), 3)])
    jac[np.arange(5 * n), at] = rng.normal(size=5 * n) * (rng.random(5 * n) < 0.7)
    inf = np.full(n, np.inf)
    cones = problem.cones + lv.Cones.bounded(np.zeros(n), inf) + lv.Cones.bounded(-inf, np.zeros(n))
    cones = cones + lv.Cones.contacts(0.5, 2, count=n)
    b = np.concatenate([-sizes, sizes, np.stack([-sizes, 0.1 * sizes, 0 * sizes], axis=1).ravel()])
    jac = np.concatenate([g.jac.toarray(), jac])
    more = lv.Problem.from_jacobian(
        jac,
        g.mass.toarray(),
        g.v_free,
        cones=cones,
        compliance=np.concatenate([problem.compliance, np.zeros(len(b))]),
        friction=problem.friction,
    )
    return more.updated(b=np.concatenate([problem.b, b]))


LARGE = st.lists(st.integers(3, 60), min_size=1, max_size=3).map(
    lambda powers: 10.0 ** np.array(powers)
)


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("form", ["matrix", "J and M"])
@given(seed=seeds, sizes=LARGE, still=st.booleans())
def test_residual_relative_does_not_depend_on_inactive_rows(form, friction, seed, sizes, still):
    rng = np.random.default_rng(seed)
    problem = random_generalized_problem(seed, friction)
    if still:  # the zero impulse is a solution
        problem = problem.updated(b=np.where(problem.cones.lower == 0.0, -np.abs(problem.b), 0.0))
    more = with_inactive_rows(problem, rng, sizes)
    lam = rng.normal(size=problem.m)
    convert = as_matrix if form == "matrix" else (lambda p: p)
    for impulse in (lam, problem.start(), lv.solve(problem, tol=1e-9).impulse):
        alone = lv.residual(convert(problem), impulse)
        found = lv.residual(convert(more), np.concatenate([impulse, np.zeros(more.m - problem.m)]))
        assert found.relative == pytest.approx(
            alone.relative, rel=1e-9, abs=4.0 * alone.roundoff_floor
        )


@pytest.mark.parametrize("form", ["matrix", "J and M"])
@pytest.mark.parametrize("size", [1e3, 1e9, 1e15, 1e30, 1e60])
@pytest.mark.parametrize("friction", ["coulomb", "cone"])
def test_solvers_with_inactive_rows_converge_as_without(friction, size, form):
    """What converges without inactive rows converges with them, with the same velocities within the tolerance."""
    tol, solved = 1e-6, 0
    convert = as_matrix if form == "matrix" else (lambda p: p)
    for seed in range(3):
        problem = random_generalized_problem(seed, friction, contacts=3)
        more = with_inactive_rows(problem, np.random.default_rng(seed), np.array([size]))
        for name in lv.available(more):
            if get(name).external:
                continue  # their own tests of a size are not ours
            alone = lv.solve(convert(problem), name, tol=tol)
            if not alone.success:
                continue
            solution = lv.solve(convert(more), name, tol=tol)
            assert solution.success, (name, seed, str(solution))
            own = lv.residual(problem, solution.impulse[: problem.m])
            assert own.relative <= tol * (1 + 1e-9), (name, seed, str(own))
            solved += 1
    assert solved >= 15


def test_solve_of_a_row_of_zeros_is_rounding_or_infeasible():
    """Its row of A is zero: b of 1e-17 beside numbers of 1 is rounding, b of 1e-3 has no solution."""
    for b, status in ((1e-17, lv.Status.CONVERGED), (1e-3, lv.Status.INFEASIBLE)):
        assert lv.solve(lv.Problem.lcp(np.diag([1.0, 0.0]), [1.0, b])).status is status


def unmoved_row_beside(b, form, target=1.0):
    """Row 0 asks for b [m/s]; row 1, which is zero, asks for `target`, and nothing can meet it."""
    if form == "A":
        return lv.Problem.lcp(np.diag([1.0, 0.0]), [b, target])
    if form == "A, one block":
        cones = lv.Cones([0, 2], [0], [0.0, 0.0], [np.inf, np.inf], [0.0], [0.0])
        return lv.Problem([b, target], cones, np.diag([1.0, 0.0]))
    if form == "A, coupled":  # Row 1 moves row 0, but no impulse moves row 1.
        return lv.Problem.lcp(np.array([[1.0, 0.1], [0.0, 0.0]]), [b, target])
    if form == "J and M":
        cones = lv.Cones.bounded([0.0, 0.0], [np.inf] * 2)
        return lv.Problem.from_jacobian(
            np.diag([1.0, 0.0]), np.eye(2), [-b, 0.0], target=[0.0, target], cones=cones
        )
    rows = lv.Rows(
        inv_mass=[1.0, 0.0, 0.0],
        inv_inertia=[np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))],
        v_free=[[0.0, 0.0, -b] + [0.0] * 3, [0.1 * target] + [0.0] * 5, [0.3 * target] + [0.0] * 5],
        contact_body=[(-1, 0), (1, 2)],
        normal=[(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)],
        tangent=[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)],
        arm_a=np.zeros((2, 3)),
        arm_b=np.zeros((2, 3)),
    )
    return lv.Problem.from_rows(rows, target=[0.0, 1.2 * target], tangents=0)


@pytest.mark.parametrize("form", ["A", "A, one block", "A, coupled", "J and M", "bodies"])
def test_residual_row_that_no_impulse_moves_does_not_depend_on_other_rows(form):
    for b, tol, target in (
        (1e6, 1e-6, 1.0),
        (1e9, 1e-8, 1.0),
        (1e9, 1e-3, 1e3),
        (1e-9, 1e-6, 1e-9),
        (1e3, 1e-3, 1.0),
    ):
        problem = unmoved_row_beside(b, form, target)
        worlds = [
            lv.solve(problem, "pgs" if form.startswith("A") else "auto", tol=tol),
            lv.solve(problem, tol=tol),
        ]
        for solution in [*worlds, *lv.solve_many([problem] * 2, "newton", tol=tol)]:
            assert solution.status is lv.Status.INFEASIBLE and not solution.success, (form, b, tol)
        assert (
            worlds[1].claim_check == "confirmed"
            and problem.row_name(1).split(",")[0] in worlds[1].message
        )
        assert worlds[1].residual.relative == pytest.approx(1.0, rel=1e-6)
        assert any(s.kind == "immovable" and s.blocks for s in lv.diagnose(problem))


@pytest.mark.parametrize("form", ["A", "J and M", "bodies"])
@pytest.mark.parametrize("b", [0.0, 0.3, 1e6])
def test_residual_of_a_satisfied_row_that_no_impulse_moves_is_zero_whatever_its_impulse_is(b, form):
    """It is its w that its bounds must allow; an impulse outside of them shows in the error of its row alone."""
    problem = unmoved_row_beside(b, form, 0.0)
    for impulse in (0.0, 2.0, -1.0, 1e6):
        found = lv.residual(problem, [b, impulse])
        assert found.relative <= 1e-12 and abs(found.error[1]) == max(0.0, -impulse)


@pytest.mark.parametrize("b", [0.0, 0.3])
def test_residual_of_tangents_that_move_under_a_normal_that_does_not_counts_their_impulse(b):
    """The normal is satisfied, its friction is 0, and an impulse of 5 N s along the tangent moves the body."""
    jac = np.zeros((4, 4))
    jac[0, 0] = jac[2, 1] = jac[3, 2] = 1.0
    low, high = [0.0, 0.0, -np.inf, -np.inf], [np.inf] * 4
    cones = lv.Cones([0, 1, 4], [0, 1], low, high, [0.0, 0.5], [0.0, 0.0])
    problem = lv.Problem.from_jacobian(
        jac, np.eye(4), np.zeros(4), target=[b, 0.0, 0.0, 0.0], cones=cones
    )
    assert lv.residual(problem, [b, 0.0, 0.0, 0.0]).relative <= 1e-12
    assert not lv.residual(problem, [b, 0.0, 5.0, 0.0]).relative <= 1.0


def row_between_driven_bodies(speed, excess, lower, form):
    """A row between two bodies driven at `speed` and `speed` + `excess` [m/s], beside one that is solved."""
    rows = lv.Rows(
        inv_mass=[0.0, 0.0, 1.0],
        inv_inertia=[np.zeros((3, 3)), np.zeros((3, 3)), np.eye(3)],
        v_free=[[speed] + [0.0] * 5, [speed + excess] + [0.0] * 5, [1.0] + [0.0] * 5],
        jac=np.tile([-1.0] + [0.0] * 5 + [1.0] + [0.0] * 5, (2, 1)),
        joint_ptr=[0, 1, 2],
        joint_body=[(0, 1), (-1, 2)],
        normal=np.zeros((0, 3)),
        tangent=np.zeros((0, 3)),
        arm_a=np.zeros((0, 3)),
        arm_b=np.zeros((0, 3)),
        contact_body=np.zeros((0, 2), np.int32),
    )
    problem = lv.Problem.from_rows(rows, target=0.0, lower=[lower, -np.inf], upper=[np.inf, np.inf])
    return as_matrix(problem) if form == "matrix" else problem


@pytest.mark.parametrize("form", ["bodies", "matrix"])
@pytest.mark.parametrize("solver", ["auto", "newton", "pgs", "direct"])
def test_row_between_driven_bodies_is_violated_by_the_velocity_that_its_bounds_do_not_allow(
    solver, form
):
    for speed, excess in ((1e3, 1e-3), (1.0, 1e-3), (1e3, -1e-3), (1e5, 1e-6), (1e3, 0.0)):
        for lower in (-np.inf, 0.0):
            problem = row_between_driven_bodies(speed, excess, lower, form)
            if solver not in lv.available(problem):
                pytest.skip("the solver takes another form")
            solution = lv.solve(problem, solver)
            is_met = excess == 0.0 or (lower == 0.0 and excess > 0.0)
            assert solution.status is (lv.Status.CONVERGED if is_met else lv.Status.INFEASIBLE), (
                str(solution)
            )
            assert solution.claim_check == "confirmed" and solution.impulse[1] == pytest.approx(
                -1.0
            )
            if is_met:
                assert (
                    solution.residual.islands.relative[0] == 0.0
                    or solution.residual.relative < 1e-9
                )
            else:
                assert solution.residual.relative == 1.0


def test_residual_with_bodies_that_do_not_move_agrees_with_long_double():
    n_unmoved = 0
    for seed in range(80):
        problem = draw_body_problem(seed)
        twin = Twin(plain_data(problem))
        for impulse in (problem.start(), lv.solve(problem).impulse):
            expected = twin.judge(impulse)
            found = lv.residual(problem, impulse)
            if expected.nothing or twin.d_edge or found.relative <= found.roundoff_floor > 1e-5:
                continue
            n_unmoved += len(problem.metric.empty) > 0
            # 1e-5: a floor of up to twice the residual is in both judgements.
            assert (
                abs(found.relative - expected.relative)
                <= 1e-5 * expected.relative + expected.allowed
            ), seed
    assert n_unmoved > 20


def test_residual_row_with_zero_b_at_rest_is_compared_with_its_own_terms():
    """Row 1 is at rest; an impulse of 0.5 N s on it moves it by 0.5 m/s, however large b of row 0 is."""
    assert not lv.residual(lv.Problem.lcp(np.eye(2), [1e9, 0.0]), [1e9, 0.5]).relative <= 1.0
    cones = lv.Cones.bounded([-np.inf] * 2, [np.inf] * 2)
    rolls = lv.Problem.from_jacobian(
        np.eye(2), np.eye(2), [-1e9, 3.0], target=[0.0, 3.0], cones=cones
    )
    # |target| + |J v*| is 6 m/s.
    assert lv.residual(rolls, [1e9, 0.5]).relative == pytest.approx(0.5 / 6.0)
    assert lv.solve(rolls, tol=1e-9).success


@pytest.mark.parametrize("seed", range(3))
def test_find_islands_ground_given_as_immovable_body_equals_ground_minus_one(seed):
    first, second = (
        random_contact_problem(seed + i, bodies=3, joints=2, contacts=4) for i in (0, 7)
    )
    both, _ = rows_side_by_side(first, scaled(second, 1000.0))
    given = with_ground_as_body(both)
    count, label = find_islands(both)
    assert count > 1
    for name, convert in FORMS.items():
        if name == "J and M":
            continue  # M of an immovable body does not exist.
        found = find_islands(convert(given))
        assert found[0] == count
        np.testing.assert_array_equal(found[1], label)
    np.testing.assert_array_equal(compute_block_colors(given), compute_block_colors(both))
    np.testing.assert_array_equal(
        compute_block_levels_from_ground(given), compute_block_levels_from_ground(both)
    )
    lam = np.random.default_rng(seed).normal(size=both.m)
    assert lv.residual(given, lam).relative == lv.residual(both, lam).relative
    for name in ("pgs", "sequential_impulses", "block_gauss_seidel", "newton", "auto"):
        one, other = (lv.solve(p, name, tol=1e-8) for p in (both, given))
        assert one.status is other.status, name
        np.testing.assert_allclose(
            lv.residual(both, other.impulse).islands.relative, other.residual.islands.relative
        )


def test_residual_rounding_of_moving_immovable_bodies_is_satisfied():
    """b = 0.2 - (0.3 - 0.1) of two immovable bodies is rounding of its terms, so that no impulse is needed."""
    problem = unmoved_row_beside(1e-3, "bodies", 1.0).updated(b=[1e-3, 2.8e-17])
    solution = lv.solve(problem, tol=1e-6)
    assert solution.success and solution.residual.relative < 1e-15


def test_newton_block_between_two_immovable_bodies_is_an_island_of_its_own():
    rows = touching(
        [(0, 1), (1, 2)], inv_mass=[0.0, 0.0, 1.0], inv_inertia=[np.zeros((3, 3))] * 2 + [np.eye(3)]
    )
    problem = lv.Problem.from_rows(rows, target=[0.0, 0.0, 0.0, 1.0, 0.5, 0.0], mu=0.5)
    assert find_islands(problem) == (2, pytest.approx([0, 1]))
    for name in ("newton", "auto", "admm", "block_gauss_seidel"):
        solution = lv.solve(problem, name, tol=1e-9)
        assert solution.success, name
        np.testing.assert_allclose(problem.velocity(solution.impulse)[2, :2], [0.5, 0.0], atol=1e-8)
