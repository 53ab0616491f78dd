"""newton: its linear algebra against dense NumPy, its answers against enumeration and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from ball_pile import Pile
from calls import block_diagonal, dense_h, system_in
from hypothesis import given
from random_problems import (
    CONTACTS,
    FORMS,
    add_compliance,
    as_matrix,
    good,
    random_contact_problem,
    random_generalized_problem,
    seeds,
)
from stacks import bricks

import lavender as lv
from lavender.problem.cones import ROW
from lavender_ext.core.problem import LAWS
from lavender_ext.newton.solve import Layout, Solve


@pytest.mark.parametrize("friction", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_newton_interior_point_with_more_rows_than_velocities_takes_no_more_steps(seed, friction):
    """Its first point leaves out what H cannot reach: that was a million times the rest, and shifted every cone."""
    rng = np.random.default_rng(seed)
    nv, m = 20, 180
    jac = rng.normal(size=(m, nv))
    moves = rng.exponential(1.0, m) * (rng.random(m) < 0.6)
    cones = lv.Cones.bounded(np.zeros(m), np.full(m, np.inf))
    if friction:
        cones = lv.Cones.contacts(rng.uniform(0.1, 1.0, m // 3))
        moves.reshape(-1, 3)[:, 1:] = 0.0
    b = jac @ rng.normal(size=nv) - moves  # met by a motion
    problem = lv.Problem(b, cones, jac @ jac.T, friction="cone")
    solution = lv.solve(problem, "newton", tol=1e-6, max_iter=25)  # measured: 8 to 21
    assert solution.success, str(solution)


# -- linear algebra ---------------------------------------------------------------------------------


@pytest.mark.parametrize("law", [LAWS["cone"], LAWS["coulomb"]])
@pytest.mark.parametrize("form", ["velocity", "augmented", "impulse", "sparse"])
@given(seed=seeds)
def test_newton_system_is_the_derivative_and_is_solved(form, law, seed):
    problem = random_contact_problem(
        seed, friction="cone" if law == LAWS["cone"] else "coulomb", bodies=6, contacts=10
    )
    system = system_in(problem, "velocity" if form == "augmented" else form)
    solve = system.solve
    arrays = system.solve.view_arrays()
    m = arrays.m
    g = arrays.g
    eps = 1e-3
    rng = np.random.default_rng(seed)
    z, dz = rng.normal(size=m), rng.normal(size=m)
    solve.evaluate_natural_map(z, solve.multiply_matrix(z) - g, law, eps)
    slope = solve.multiply_by_natural_map_derivative(dz)
    # F is piecewise smooth: two nearby points on one piece give the derivative; other pieces tell nothing.
    p = arrays.p.copy()
    step = 1e-7
    sides = []
    for sign in (1.0, -1.0):
        near = z + sign * step * dz
        side = solve.evaluate_natural_map(near, solve.multiply_matrix(near) - g, law, eps)
        sides.append((side, np.abs(arrays.p - p).max()))
    if max(change for _, change in sides) < 1e-4:
        difference = (sides[0][0] - sides[1][0]) / (2.0 * step)
        # Central differences: third derivatives near the tip of a cone times step^2, rounding over step.
        np.testing.assert_allclose(
            difference, slope, rtol=0, atol=1e-5 * (1.0 + np.abs(slope).max())
        )
    solve.evaluate_natural_map(z, solve.multiply_matrix(z) - g, law, eps)
    assert solve.factor("natural", eps, augmented=form == "augmented")
    r = rng.normal(size=m)
    x = solve.solve("natural", r)
    matrix = np.eye(m) + block_diagonal(system, arrays.p) @ (
        dense_h(problem)[np.ix_(arrays.keep, arrays.keep)] + (eps - 1.0) * np.eye(m)
    )
    # eps = 1e-3 bounds the condition number by about 1e4 for these sizes.
    np.testing.assert_allclose(matrix @ x, r, rtol=0, atol=1e-9 * (1.0 + np.abs(x).max()))


@pytest.mark.slow
def test_newton_path_follows_folds():
    """Steps of a pile on which load passes from stick to slip, up to twelve times on one path."""
    paths = 0
    for step, problem in Pile(14).problems(130):
        if step >= 100 and step % 10 == 0:  # which of them need a path differs between processors
            # A path that has to search its way around a fold takes 800 and more.
            solution = lv.solve(problem, "newton", max_iter=800, impulse=np.zeros(problem.m))
            assert solution.success, f"step {step}: {solution}"
            paths += "path steps" in solution.message
    assert paths


@pytest.mark.parametrize("compliance", [1e-6, 1e-4, 1e-2])
def test_newton_interior_point_with_compliance_takes_no_more_steps(compliance):
    """V = (W + theta)^-1 = B B^T on soft contacts, too: without B they stalled, and took three times as many."""
    rigid = bricks(8, 2e-2).relaxed("cone")
    soft = replace(rigid, compliance=compliance * rigid.d)
    steps = [lv.solve(p, "newton").work["factorisations"] for p in (rigid, soft)]
    assert steps[1] <= 2 * steps[0]


@pytest.mark.parametrize("n", [3, 30, 150])
def test_newton_exchanges_in_a_cycle_end_by_count(n):
    """Newton's method on min(z, H z - g) goes round among single rows here (Ben Gharbia, Gilbert 2012)."""
    a = np.eye(n) + 2.0 * np.roll(np.eye(n), 1, axis=0)
    problem = lv.Problem.lcp(a, np.ones(n))
    solution = lv.solve(problem, "newton", tol=1e-9, impulse=np.eye(n)[0])
    assert good(solution, 1e-9), solution
    counts = dict(reversed(part.split(" ", 1)) for part in solution.message.split(", "))
    assert int(counts["exchanges"]) <= 30, solution.message


def on_bodies(k, layout, lu, wide=True):
    """Newton's method whose H is K K^T, K (rows, 2, s) of the bodies `layout.node`, on rows of any problem."""
    m = len(k)
    s = layout.s
    problem = lv.Problem.lcp(np.eye(m), np.ones(m))
    panel = np.zeros((m, 2, 6))
    panel[:, :, :s] = np.where(layout.swapped[:, None, None] > 0, k[:, ::-1], k)
    columns = np.arange(s, dtype=np.int32)
    solve = Solve.over_bodies(problem.metric, panel.reshape(m, 12), columns, layout, lu, wide)
    solve.start(np.zeros(m), 0.0, 1)
    return solve


def random_columns(rng, node, n, s):
    """K of rows between bodies, and the same as a matrix (rows, n s)."""
    m = len(node)
    k = rng.normal(size=(m, 2, s))
    whole = np.zeros((m, n * s))
    k[node[:, 1] < 0, 1] = 0.0
    for i, pair in enumerate(node):
        for half, body in enumerate(pair):
            if body >= 0:
                whole[i, body * s : body * s + s] = k[i, half]
    return k, whole


@pytest.mark.parametrize("s", [1, 2, 3, 6])
@pytest.mark.parametrize(("n", "m"), [(40, 110), (40, 45), (3, 9), (2, 7)])
def test_factor_of_a_graph_of_bodies_solves_as_a_dense_matrix(s, n, m):
    """Symmetric and with row exchanges; the bits are the same with any number of lanes."""
    rng = np.random.default_rng(100 * s + m)
    body = rng.integers(-1, n, (m, 2))
    body = np.ascontiguousarray(body[body[:, 0] != body[:, 1]], np.int32)
    m = len(body)
    layout = Layout(body, n, s)
    assert (layout.node[:, 0] > layout.node[:, 1]).all()
    if n > 3:
        assert layout.supernodes < n and 0 < layout.swapped.sum() < len(body)
    k, whole = random_columns(rng, layout.node, n, s)
    v = rng.uniform(0.1, 10.0, m)
    r = rng.normal(size=m)
    expected = np.linalg.solve(np.diag(1.0 / v) + whole @ whole.T, r)
    for what in ("barrier", "pair"):
        outs = set()
        for wide in (True, False):
            solve = on_bodies(k, layout, what == "pair", wide)
            solve.view_arrays().v[:] = v
            for _ in range(2):  # what a factor leaves behind does not reach the next
                assert solve.factor(what)
                out = solve.solve(what, r)
                np.testing.assert_allclose(
                    out, expected, rtol=0, atol=1e-12 * np.abs(expected).max()
                )
                outs.add(out.tobytes())
        assert len(outs) == 1


def sparse_rows(seed, m=500, even=True, near=3):
    """Bounded rows of a matrix with few entries, some of them in one row alone where it is not even."""
    rng = np.random.default_rng(seed)
    i = np.arange(m).repeat(near)
    j = rng.integers(0, m, near * m)
    x, y = rng.normal(size=(2, near * m))
    if even:
        a = sp.coo_array((np.r_[x, x], (np.r_[i, j], np.r_[j, i])), shape=(m, m))
    else:
        kept = rng.random(near * m) < 0.5
        a = sp.coo_array((np.r_[x, y[kept]], (np.r_[i, j[kept]], np.r_[j, i[kept]])), shape=(m, m))
    a = sp.csr_array(a)
    a = sp.csr_array(a + sp.diags_array(np.abs(a).sum(axis=1) + 0.1))
    return lv.Problem.lcp(a, rng.normal(size=m), upper=np.where(rng.random(m) < 0.5, 0.05, np.inf))


@pytest.mark.parametrize("even", [True, False])
@given(seed=seeds)
def test_newton_solves_sparse_free_rows_together_with_all_rows(even, seed):
    problem = sparse_rows(seed, 200, even)
    system = system_in(problem, "sparse")
    h = dense_h(problem)
    rng = np.random.default_rng(seed)
    eps = 1e-6
    free = rng.random(200) < 0.6
    r = rng.normal(size=200)
    system.solve.view_arrays().p[:] = free
    assert system.solve.factor("natural", eps)
    assert not system.solve.uses_fallback
    expected = np.linalg.solve(
        np.where(free[:, None], h, 0.0) + np.diag(np.where(free, eps, 1.0)), r
    )
    np.testing.assert_allclose(
        system.solve.solve("natural", r), expected, rtol=0, atol=1e-11 * np.abs(expected).max()
    )


@pytest.mark.parametrize("form", FORMS)
@given(seed=seeds)
def test_newton_without_friction_equals_the_cone_law_without_coulomb_rounds(form, seed):
    """mu = 0, rows that depend on each other: under either law the same convex problem."""
    p = random_contact_problem(seed, bodies=3, joints=5, contacts=25, tangents=2, spin=False)
    p = replace(p, compliance=np.zeros(p.m), cones=replace(p.cones, mu=np.zeros(p.n_blocks)))
    problem = FORMS[form](p)
    coulomb = lv.solve(problem, "newton")
    cone = lv.solve(problem.relaxed("cone"), "newton")
    assert coulomb.claim_check == "confirmed" and "Coulomb rounds" not in coulomb.work
    assert coulomb.status == cone.status
    assert np.array_equal(coulomb.impulse, cone.impulse)


def pinched(seed, form, **kind):
    """Rigid contacts of the cone's law in four pairs, the two sides of one body, b >= 0.1 m/s along both normals."""
    p = random_contact_problem(seed, "cone", bodies=3, joints=2, contacts=8, **kind)
    rows = p.rows
    b = p.b.copy()
    first = p.cones.normal_rows
    sides = {
        key: np.repeat(getattr(rows, key)[::2], 2, axis=0)
        for key in ("normal", "tangent", "arm_a", "arm_b", "contact_body")
    }
    sides["normal"][1::2] *= -1.0
    b[first[1::2]] = np.random.default_rng(seed).uniform(0.1, 1.0, 4) - b[first[::2]]
    cones = replace(p.cones, mu=0.2 + p.cones.mu)
    return FORMS[form](
        replace(p, rows=replace(rows, **sides), b=b, cones=cones, compliance=np.zeros(p.m))
    )


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", [{"tangents": 2, "spin": False}, {}, {"rolling": True}])
def test_cones_without_a_solution_are_proven_to_have_none(form, kind):
    """The way of the interior point is a proof on nearly all: 352 of 360 disks, spinning and rolling contacts."""
    proven = 0
    for seed in range(10):
        problem = pinched(seed, form, **kind)
        solution = lv.solve(problem, "newton", max_iter=150)
        assert not solution.success and solution.claim_check == "confirmed"
        proven += solution.status is lv.Status.INFEASIBLE
    assert proven >= 9


@pytest.mark.parametrize("form", FORMS)
@given(seed=seeds)
def test_cones_with_a_solution_are_never_proven_to_have_none(form, seed):
    """b = A lambda - w with lambda in the cone and w in its dual: for w.y >= 0 = lambda.A y no y proves anything."""
    p = pinched(seed, "rows", tangents=2, spin=False)
    rng = np.random.default_rng(seed)
    contacts = p.cones.contact_rows
    mu = p.cones.mu[p.cones.kind != ROW]
    normal = p.cones.normal_rows
    lam, w = np.zeros(p.m), np.zeros(p.m)
    lam[contacts], w[contacts] = rng.normal(size=(2, contacts.sum()))
    lam[normal] = rng.uniform(0.0, 2.0, 8) + np.hypot(lam[normal + 1], lam[normal + 2]) / mu
    w[normal] = rng.uniform(0.0, 2.0, 8) + np.hypot(w[normal + 1], w[normal + 2]) * mu
    problem = FORMS[form](replace(p, b=p.dense() @ lam - w))
    assert lv.solve(problem, "newton", max_iter=300).status is not lv.Status.INFEASIBLE


@pytest.mark.parametrize("law", ["lcp", "cone"])
def test_newton_on_a_stack_at_rest_takes_the_same_steps_at_any_height(law):
    """The number of factorisations does not grow with the height, because all contacts act from the first step on."""
    counts = []
    for n in (10, 80):
        rows = 1 if law == "lcp" else 3
        jac = np.zeros((rows * n, 3 * n))
        for k in range(n):
            for row, axis in enumerate((2, 0, 1)[:rows]):
                jac[rows * k + row, 3 * k + axis] = 1.0
                if k:
                    jac[rows * k + row, 3 * (k - 1) + axis] = -1.0
        v_free = np.tile([0.0, 0.0, -0.1], n)
        cones = lv.Cones.contacts(np.full(n, 0.5), tangents=rows - 1)
        problem = lv.Problem.from_jacobian(jac, np.eye(3 * n), v_free, cones=cones, friction="cone")
        solution = lv.solve(problem, "newton")
        # Each contact carries the bodies above it.
        assert solution.impulse[::rows] == pytest.approx(0.1 * np.arange(n, 0, -1), rel=1e-5)
        counts.append(solution.work["factorisations"])
    assert max(counts) <= 4


# -- Coulomb's law of J and M ---------------------------------------------------------------------


def draw_generalized_contacts(seed, nv, contacts, trees=1):
    """Draw J and M of `trees` kinematic trees of nv velocities; a contact couples a tree and the next one."""
    rng = np.random.default_rng(seed)
    blocks = [np.cov(rng.normal(size=(nv, 3 * nv))) for _ in range(trees)]
    jac = np.zeros((3 * contacts, trees * nv))
    for k in range(contacts):
        first = k % trees * nv
        jac[3 * k : 3 * k + 3, first : first + 2 * nv] = rng.normal(
            size=jac[:3, first : first + 2 * nv].shape
        )
    cones = lv.Cones.contacts(rng.uniform(0.1, 1.0, (contacts, 2)))
    v_free = rng.normal(size=trees * nv)
    return lv.Problem.from_jacobian(sp.csr_array(jac), blocks, v_free, cones=cones, compliance=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_newton_coulomb_jacobian_with_few_rows_equals_matrix(seed):
    problem = draw_generalized_contacts(seed, 20, 6)
    solution = lv.solve(problem, "newton", tol=1e-10)
    expected = lv.solve(as_matrix(problem), "newton", tol=1e-10)
    assert solution.success and expected.success
    assert "Coulomb rounds" not in solution.work
    # Both run the same steps on the same matrix, up to rounding.
    assert solution.work["factorisations"] == expected.work["factorisations"]
    assert solution.impulse == pytest.approx(
        expected.impulse, rel=1e-8, abs=1e-8 * abs(expected.impulse).max()
    )


def test_newton_coulomb_jacobian_with_many_rows_steps_over_velocities():
    solution = lv.solve(draw_generalized_contacts(0, 6, 40), "newton")
    assert solution.success and solution.work["Coulomb rounds"] > 0


@pytest.mark.parametrize("seed", range(3))
def test_newton_coulomb_jacobian_with_sparse_matrix_steps_over_rows(seed):
    problem = draw_generalized_contacts(seed, 12, 150, trees=50)
    solution = lv.solve(problem, "newton", tol=1e-9)
    assert solution.success and "Coulomb rounds" not in solution.work


@pytest.mark.parametrize("seed", range(3))
def test_newton_jacobian_with_two_bounds_takes_few_steps(seed):
    rng = np.random.default_rng(seed)
    jac = rng.normal(size=(30, 60))
    bound = rng.uniform(0.1, 2.0, 30)
    cones = lv.Cones.bounded(-bound, bound)
    problem = lv.Problem.from_jacobian(jac, np.eye(60), rng.normal(size=60), cones=cones)
    solution = lv.solve(problem, "newton", tol=1e-9)
    # Exchanges over rows took 1 to 3; exchanges of single rows would take as many as there are rows.
    assert solution.success and solution.work["factorisations"] < problem.m / 4


@pytest.mark.parametrize("form", ["rows", "matrix"])
def test_newton_of_cones_takes_as_many_steps_for_large_friction_as_for_small(form):
    """Between 16 and 21 steps for coefficients from 1/8 to 16."""
    for seed in (3, 5, 7):
        bodies = add_compliance(CONTACTS["disks"](seed, "cone"), 0.02)
        for power in range(-3, 5):
            mu = np.where(bodies.cones.n_tangents > 0, 2.0**power, 0.0)
            problem = FORMS[form](replace(bodies, cones=replace(bodies.cones, mu=mu)))
            solution = lv.solve(problem, "newton", tol=1e-9)
            assert solution.success and solution.iterations <= 30, f"{seed}, {power}: {solution}"


@pytest.mark.parametrize("form", ["rows", "matrix"])
@pytest.mark.parametrize("kind", ["disks", "spin", "rolling", "rolling and spin", "ellipses"])
def test_newton_of_cones_takes_as_many_steps_for_every_kind_of_contact(kind, form):
    """Up to 27 steps; contacts with several components have several cones."""
    for seed in range(6):
        problem = FORMS[form](add_compliance(CONTACTS[kind](seed, "cone"), 0.001))
        solution = lv.solve(problem, "newton", tol=1e-9)
        assert solution.success and solution.iterations <= 30, f"{seed}: {solution}"


@pytest.mark.parametrize("form", ["rows", "matrix"])
def test_newton_of_cones_takes_as_many_steps_for_upper_limits_as_for_lower_ones(form):
    for seed in range(8, 16):
        bodies = add_compliance(CONTACTS["disks"](seed, "cone", joints=8), 0.001)
        cones = bodies.cones
        is_joint = ~bodies.cones.contact_rows
        steps = []
        for sign in (1.0, -1.0):
            low, high = (-np.inf, 0.01 * (1 + seed)) if sign > 0.0 else (-0.01 * (1 + seed), np.inf)
            limits = {
                "lower": np.where(is_joint, low, cones.lower),
                "upper": np.where(is_joint, high, cones.upper),
            }
            turned = {
                "rows": replace(bodies.rows, jac=sign * bodies.rows.jac),
                "cones": replace(cones, **limits),
            }
            problem = replace(bodies, b=np.where(is_joint, sign, 1.0) * bodies.b, **turned)
            steps.append(lv.solve(FORMS[form](problem), "newton", tol=1e-9).iterations)
        assert abs(steps[0] - steps[1]) <= 3, f"{seed}: {steps}"


@pytest.mark.parametrize("compliance", [0.0, 1e-3, 0.3])
def test_newton_solves_a_chain_of_joints_directly_from_a_warm_start(compliance):
    n = 8
    builder = lv.RowBuilder(
        np.ones(n),
        [0.4 * np.eye(3)] * n,
        np.tile([0.0, 0.0, -0.1, 0.02, 0.01, 0.0], (n, 1)),
        0.01,
        position=[(i + 0.5, 0.0, 0.0) for i in range(n)],
    )
    for i in range(n):
        builder.ball(i - 1, i, (float(i), 0.0, 0.0))
    problem = builder.problem()
    problem = replace(problem, compliance=np.full(problem.m, compliance))
    exact = np.linalg.solve(problem.dense(), problem.b)
    solution = lv.solve(replace(problem, guess=0.9 * exact + 1e-3), "newton", tol=1e-9)
    assert (solution.message, solution.work) == ("joints solved directly", {"factorisations": 1})
    np.testing.assert_allclose(solution.impulse, exact, rtol=1e-9)


def test_newton_over_velocities_with_coulomb_friction_takes_few_steps():
    """Twenty problems with more contacts than velocities take 684 steps in all, up to 71 each."""
    steps = []
    for seed in range(20):
        problem = random_generalized_problem(seed, "coulomb", n=6, contacts=12, compliance=False)
        mu = np.where(problem.cones.is_contact, 1.5, 0.0)
        solution = lv.solve(
            replace(problem, cones=replace(problem.cones, mu=mu)), "newton", tol=1e-9
        )
        assert solution.success, str(solution)
        steps.append(solution.iterations)
    assert sum(steps) <= 900 and max(steps) <= 110, steps


@pytest.mark.parametrize("law", ["cone", "coulomb"])
@pytest.mark.parametrize("softest", [-3.0, 1.0])
def test_newton_needs_no_more_factorisations_for_unequal_compliances_of_a_contact(law, softest):
    """The two tangents of a contact share the regularisation with which friction is on a circle."""
    steps = [0, 0]
    fallbacks = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        n, contacts = int(rng.integers(3, 8)), int(rng.integers(1, 5))
        half = rng.normal(size=(n, n))
        jac = rng.normal(size=(3 * contacts, n))
        free = rng.normal(size=n)
        mu = rng.uniform(0.2, 1.0, contacts)
        soft = 10.0 ** rng.uniform(softest - 2.0, softest, 3 * contacts)
        for k, own in enumerate((soft, np.full(3 * contacts, soft.min()))):
            problem = lv.Problem.from_jacobian(
                jac,
                half @ half.T + np.eye(n),
                free,
                cones=lv.Cones.contacts(mu, 2),
                compliance=own,
                friction=law,
            )
            found = lv.solve(problem, "newton", tol=1e-9, form="velocity")
            assert found.success, (seed, found)
            steps[k] += found.work["factorisations"]
            fallbacks += "interior" in found.message
    assert steps[0] <= 2 * steps[1]
    assert fallbacks <= 4
