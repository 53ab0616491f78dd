"""Properties of every public array, registered solver, backend and form, which no single example checks."""

import json
import re
from functools import partial

import numpy as np
import pytest
import scipy.sparse as sp
from calls import SINGLE, installed, list_arrays
from random_problems import (
    CONTACTS,
    add_compliance,
    random_bodies_and_contacts,
    random_contact_problem,
    spd,
)

import lavender as lv
from lavender.base import deadline
from lavender.judge.certificates import check_certificate
from lavender.problem.cones import project_impulse
from lavender.programs.forms import choose_program_form, get_program
from lavender.programs.proofs import find_ray
from lavender.programs.running import Answer, call_backend_until_accepted, classify_status
from lavender.solvers import direct
from lavender.solvers.islands import find_islands
from lavender.solvers.polyhedral import BoundedRowSolver, convert_to_bounded_rows
from lavender.solving import auto, log, loop
from lavender.solving.velocity import accept_velocity
from lavender_ext.judge.measure import is_residual_at_floor

# -- many worlds -------------------------------------------------------------------------------------------------------


WORLDS = ("batch", "problems", "matrices", "bounded", "float32 view", "zeros of M")


def draw_worlds(kind):
    """Draw worlds: slow ones, in which the zero impulse meets 1e-3 m/s, and a heavy one with a large energy."""
    rng = np.random.default_rng(0)
    jac = rng.normal(size=(6, 6, 9))
    mass = np.array([np.diag(rng.uniform(0.5, 2.0, 9)) for _ in range(6)])
    free = (
        -(jac[:, 0] + jac[:, 3] + 0.3 * jac[:, 1])
        * np.array([1.0, 1e-6, 5e-7, 1e-7, 1.0, 1.0])[:, None]
    )
    mass[2] *= 1e6
    cones = lv.Cones.contacts(0.5, count=2)
    if kind == "matrices":
        return [lv.Problem.contact(*spd(6, seed=i), mu=0.5) for i in range(3)]
    if kind == "bounded":
        cones = [
            lv.Cones.bounded(np.full(6, 0.05 * i - 0.1), np.linspace(0.2, 0.2 * i + 0.2, 6))
            for i in range(6)
        ]
    if kind == "zeros of M":
        for world, column in zip(mass, (0, 1, 2, 1, 0, 3), strict=True):
            world[4, column] = world[column, 4] = 0.3 * world[0, 0]
    if kind == "float32 view":
        wide = np.zeros((6, 6, 14), np.float32)
        mass = mass.astype(np.float32)
        free = free.astype(np.float32)
        wide[:, :, 2:11] = jac
        jac = wide[:, :, 2:11]
    batch = lv.Batch(jac, mass, free, cones=cones)
    return list(batch) if kind == "problems" else batch


@pytest.mark.parametrize(
    "more", [{}, {"velocity_tol": 1e-3, "max_iter": 2}, {"max_iter": 1, "tol": 1e-12}]
)
@pytest.mark.parametrize("solver", ["auto", "pgs"])
@pytest.mark.parametrize("kind", WORLDS)
def test_solve_many_arrays_equal_the_numbers_of_single_solutions(kind, solver, more):
    worlds = draw_worlds(kind)
    many = lv.solve_many(worlds, solver, **more)
    judged = [
        lv.residual(p, s.impulse, precision="float64") for p, s in zip(worlds, many, strict=True)
    ]
    for name in list_arrays(many):
        expected = [SINGLE[name](s, r) for s, r in zip(many, judged, strict=True)]
        assert getattr(many, name).tolist() == expected, name
    if more == {"velocity_tol": 1e-3, "max_iter": 2} and kind == "batch":
        assert (many.success & (many.relative > many.tol)).any()
    if kind != "matrices":
        velocity = np.concatenate(
            [p.velocity(s.impulse).ravel() for p, s in zip(worlds, many, strict=True)]
        )
        np.testing.assert_allclose(many.velocity.ravel(), velocity, rtol=1e-12, atol=1e-15)


def test_velocity_tol_accepts_what_is_within_it_from_every_end_that_claims_nothing_else():
    solution = lv.solve(draw_worlds("batch")[0], "pgs", tol=0.0, max_iter=2)
    for status in lv.Status:
        ended = solution.with_fields(status=status)
        within = accept_velocity(ended, 1.01 * solution.residual.velocity).status
        claims_nothing = status in ("MAX_ITERATIONS", "STALLED", "TIME_LIMIT")
        assert within is (lv.Status.CONVERGED if claims_nothing else status)
        assert accept_velocity(ended, 0.99 * solution.residual.velocity).status is status


# -- verdicts and proofs -----------------------------------------------------------------------------------------------


def test_verdict_changes_at_its_documented_factors():
    for floor in (1e-16, 1e-12, 1e-7):
        assert is_residual_at_floor(1.99 * floor, floor) and not is_residual_at_floor(
            2.01 * floor, floor
        )
    assert is_residual_at_floor(0.99e-5, 0.9e-5) and not is_residual_at_floor(1.01e-5, 0.9e-5)
    assert not is_residual_at_floor(0.0, 1e-3)
    problem = lv.Problem.lcp([[1.0]], [1.0])
    floor = lv.residual(problem, [1.0], "float32").roundoff_floor
    for factor, expected in ((3.9, "at its floor"), (4.2, "stopped before convergence")):
        assert (
            lv.residual(problem, [1.0 - factor * floor], "float32", threshold=0.0).verdict
            == expected
        )
    fast = lv.Problem.lcp([[1.0]], [10.0])
    for speed, expected in ((0.99, "close enough"), (1.01, "stopped before convergence")):
        assert lv.residual(fast, [10.0 - 1e-3 * speed], threshold=1e-3).verdict == expected


@pytest.mark.parametrize("seed", range(4))
def test_verdict_of_the_zero_impulse_is_wrong_and_of_a_part_of_the_solution_unconverged(seed):
    problem = random_contact_problem(seed)
    solution = lv.solve(problem, tol=1e-12).impulse
    assert lv.residual(problem, problem.start(), threshold=0.0).verdict == "wrong"
    assert (
        lv.residual(problem, 0.999 * solution, threshold=0.0).verdict
        == "stopped before convergence"
    )


def test_verdict_of_a_diverged_impulse_in_a_scene_at_rest_is_wrong():
    problem = lv.Problem.lcp(np.eye(3), -np.ones(3))
    assert lv.residual(problem, np.zeros(3)).verdict == "at its floor"
    assert lv.residual(problem, np.full(3, 1e6)).verdict == "wrong"
    coupled = lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [-1.0, -1.0])
    given = lv.residual(coupled, [1e17, 1e17 + 32.0])
    assert given.rounds and given.verdict == "wrong"


@pytest.mark.parametrize("islands", [1, 2])
def test_relative_residual_of_an_impulse_that_hides_b_is_at_least_its_floor(islands):
    problem = lv.Problem.lcp(
        sp.block_diag([[[1.0, -1.0], [-1.0, 1.0]]] + [np.eye(2)] * (islands - 1)),
        -np.ones(2 * islands),
    )
    for power in range(10, 19):
        found = lv.residual(problem, np.r_[10.0**power, 10.0**power, np.zeros(2 * islands - 2)])
        assert found.relative >= found.roundoff_floor or found.roundoff_floor < 1e-3
        assert found.relative >= 1.0


@pytest.mark.parametrize("target", [1.0 + 2.0**-52, 1.0 - 2.0**-53, 0.3])
def test_row_that_no_impulse_moves_is_compared_with_its_target_and_the_velocity_of_its_body(target):
    """b = target - J v* is the rounding of both, for a driven body of infinite mass."""
    rows = lv.Rows(
        inv_mass=[0.0, 1.0],
        inv_inertia=[np.zeros((3, 3)), np.eye(3)],
        v_free=[[0.0, 0.0, 0.1 * 3 if target == 0.3 else 1.0, 0.0, 0.0, 0.0], np.zeros(6)],
        jac=np.tile(np.eye(12)[8], (2, 1)),
        joint_ptr=[0, 1, 2],
        joint_body=[(-1, 0), (-1, 1)],
    )
    problem = lv.Problem.from_rows(rows, target=[target, 0.0])
    found = lv.residual(problem, problem.start())
    assert problem.b[0] != 0.0 and found.relative == pytest.approx(
        abs(problem.b[0]) / (2.0 * target), rel=1e-12
    )


@pytest.mark.parametrize("form", ["bodies", "J and M", "matrix"])
def test_floor_energy_of_free_rows_is_that_of_numpy(form):
    """F = 2^-53 (|J| |M^-1| |J|^T |lambda| + c |lambda| + |b|), or with |A|; its energy is sqrt(sum F^2 / d)."""
    rng = np.random.default_rng(4)
    rows = random_bodies_and_contacts(rng, bodies=5, joints=4, contacts=0)
    compliance = rng.uniform(0.0, 0.1, rows.joint_ptr[-1])
    problem = lv.Problem.from_rows(rows, compliance=compliance)
    impulse = rng.normal(size=problem.m)
    b = problem.b
    d = problem.d
    mass = [np.diag(np.full(3, x)) for x in rows.inv_mass]
    inverse = sp.block_diag(
        [x for pair in zip(mass, np.abs(rows.inv_inertia), strict=True) for x in pair]
    ).toarray()
    jac = np.abs(problem.jacobian.toarray())
    terms = jac @ (inverse @ (jac.T @ np.abs(impulse))) + compliance * np.abs(impulse)
    if form == "J and M":  # with a diagonal M, which has a diagonal root
        jac = rng.normal(size=(problem.m, 12))
        mass = rng.uniform(0.5, 2.0, 12)
        problem = lv.Problem.from_jacobian(
            jac, np.diag(mass), np.ones(12), cones=problem.cones, compliance=compliance
        )
        b = problem.b
        d = problem.d
        jac = np.abs(jac)
        terms = jac @ (jac.T @ np.abs(impulse) / mass) + compliance * np.abs(impulse)
    elif form == "matrix":
        problem = lv.Problem(b, problem.cones, problem.csr)
        terms = np.abs(problem.dense()) @ np.abs(impulse)
    expected = 2.0**-53 * np.linalg.norm((terms + np.abs(b)) / np.sqrt(d))
    assert lv.residual(problem, impulse).floor_energy == pytest.approx(expected, rel=1e-10, abs=0.0)


@pytest.mark.parametrize("gap", [1e-3, 1e-6])
def test_proof_of_two_contradicting_rows_holds_below_their_residual_only(gap):
    problem = lv.Problem.lcp(np.ones((2, 2)), [1.0, 1.0 + gap], -np.inf, np.inf)
    y = [-1.0, 1.0]
    assert check_certificate(problem, y, 0.01 * gap) is None
    assert check_certificate(problem, y, 10.0 * gap) is not None


@pytest.mark.parametrize("mu", [(0.9, 0.3), (0.3, 0.9)])
def test_certificate_of_an_ellipse_proves_in_the_given_tangents(mu):
    problem = lv.Problem.contact(np.zeros((3, 3)), [-0.2, 0.5, 0.5], mu=[mu], friction="cone")
    solution = lv.solve(problem)
    assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed"
    y = solution.certificate
    assert problem.b @ y > 0.0 and np.hypot(y[1] / mu[0], y[2] / mu[1]) <= y[0] * (1.0 + 1e-12)
    assert check_certificate(problem, y) is None


# -- backends ----------------------------------------------------------------------------------------------------------


def build_rows_of_every_kind(seed=2):
    """Build J and M with equal limits, two finite limits away from 0, an LCP row, a free row and a row of zeros."""
    rng = np.random.default_rng(seed)
    jac = rng.normal(size=(7, 8))
    jac[5] = 0.0
    low = np.array([0.3, 0.2, 0.0, -np.inf, -0.4, -0.5, -np.inf])
    high = np.array([0.3, 0.6, np.inf, np.inf, -0.4, 0.7, -0.1])
    target = np.r_[rng.normal(size=5), 0.2, rng.normal()]
    return lv.Problem.from_jacobian(
        jac, spd(8)[0], np.ones(8), target=target, cones=lv.Cones.bounded(low, high)
    )


@pytest.mark.parametrize("form", ["impulse", "velocity"])
@pytest.mark.parametrize(
    "name", installed("clarabel", "osqp", "daqp", "quadprog", "proxqp", "highs", "piqp", "scs")
)
def test_backend_form_with_nonzero_limits_agrees_with_newton(name, form):
    used = set()
    for seed in (2, 4, 7):
        problem = build_rows_of_every_kind(seed)
        expected = lv.solve(problem, "newton", tol=1e-13)
        found = lv.solve(problem, name, form=form, tol=1e-7)
        assert expected.success and found.success
        np.testing.assert_allclose(found.impulse, expected.impulse, atol=1e-5)
        np.testing.assert_allclose(found.slack, expected.slack, atol=1e-5)
        if found.dual is not None and form == "impulse":
            np.testing.assert_allclose(found.dual, -found.slack, atol=1e-4)
        used |= set(zip(range(7), expected.states.names, strict=True))
    assert {(1, "free"), (1, "at a bound"), (6, "free"), (6, "at a bound")} <= used


@pytest.mark.parametrize("form", ["impulse", "velocity"])
@pytest.mark.parametrize(
    "kind", ["one tangent", *(kind for kind in CONTACTS if kind != "ellipses")]
)
def test_backend_of_cones_with_every_kind_of_contact_agrees_with_newton(kind, form):
    pytest.importorskip("clarabel")
    draw = CONTACTS.get(kind) or partial(random_contact_problem, tangents=1, spin=False)
    for seed in (3, 4):
        problem = add_compliance(draw(seed, "cone"), 0.1)
        expected = lv.solve(problem, "newton" if kind != "boxes" else "direct", tol=1e-11)
        found = lv.solve(problem, "clarabel_cone", form=form, tol=1e-6)
        assert expected.success and found.success, f"{expected}, {found}"
        np.testing.assert_allclose(found.impulse, expected.impulse, atol=1e-4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_every_solver_moves_a_row_that_no_velocity_feels_to_the_limit_that_b_requires(sign):
    """If that limit is infinite, no solution exists."""
    low, high = (-1.0, 2.0) if sign > 0.0 else (-2.0, 1.0)
    for other in (low if sign > 0.0 else high, sign * -np.inf):
        limits = sorted([other, 2.0 * sign])
        for ends, is_solved in ((limits, True), (sorted([-1.0 * sign, sign * np.inf]), False)):
            cones = lv.Cones.bounded([ends[0], 0.0], [ends[1], np.inf])
            whole = lv.Problem.from_jacobian(
                [[0.0, 0.0], [1.0, 0.0]],
                np.eye(2),
                [0.0, 0.0],
                target=[0.5 * sign, 1.0],
                cones=cones,
            )
            for problem in (whole, lv.Problem(whole.b, whole.cones, whole.csr)):
                for name in lv.available(problem, external=False):
                    solution = lv.solve(problem, name)
                    if is_solved:
                        np.testing.assert_allclose(
                            solution.impulse, [2.0 * sign, 1.0], atol=1e-6, err_msg=name
                        )
                    else:
                        assert (
                            solution.status is lv.Status.INFEASIBLE
                            and solution.claim_check == "confirmed"
                        ), name


@pytest.mark.parametrize("change", ["signs", "units", "origin"])
@pytest.mark.parametrize("name", ["lemke", "direct", "pgs", "auto"])
def test_equivalent_rows_take_the_same_work_and_have_equivalent_answers(name, change):
    """lambda = sign size lambda' + shift; A is not symmetric, so that lemke follows paths, then exchanges."""
    paths = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        m = 8
        half, skew = rng.normal(size=(m, m)), rng.normal(size=(m, m))
        a = half @ half.T / m + 0.3 * np.eye(m) + 0.7 * (skew - skew.T)
        b = 3.0 * rng.normal(size=m)
        low = np.where(rng.random(m) < 0.8, rng.uniform(-1.0, 0.5, m), -np.inf)
        high = np.where((rng.random(m) < 0.5) & np.isfinite(low), low + 1.0, np.inf)
        sign, size, shift = np.ones(m), np.ones(m), np.zeros(m)
        if change == "signs":
            sign = rng.choice([-1.0, 1.0], m)
            high = np.full(m, np.inf)  # lower limits become upper ones
        elif change == "units":
            size = 2.0 ** rng.integers(-6, 7, m)
        else:
            shift = np.where(np.isfinite(low), low, 0.0)
        factor = sign * size
        new_b = sign * size * (b - a @ shift)
        ends = (low - shift) / factor, (high - shift) / factor
        more = {"tol": 1e-8, "max_iter": 2000}
        one = lv.solve(lv.Problem.lcp(a, b, low, high), name, **more)
        changed = lv.Problem.lcp(
            a * np.outer(factor, factor), new_b, np.minimum(*ends), np.maximum(*ends)
        )
        other = lv.solve(changed, name, **more)
        assert one.success == other.success and (one.success or name == "pgs"), (
            f"{seed}: {one} {other}"
        )
        if one.success:
            np.testing.assert_allclose(factor * other.impulse + shift, one.impulse, atol=1e-5)
        if name == "lemke":
            assert one.work == other.work, f"{seed}: {one.work} {other.work}"
        paths += other.work.get("paths", 0)
    assert paths > 0 or name != "lemke"


class Steps:
    """A backend and its judge that return and accept given points, one after the other."""

    def __init__(self, statuses, accepted):
        self.statuses = statuses
        self.accepted = iter(accepted)
        self.calls = 0
        self.received = []

    def accepts(self, x, lam, is_last):
        return next(self.accepted)

    def __call__(self, scaled, start, limits, settings):
        self.calls += 1
        self.received.append(
            (int(np.sum(scaled.is_kept)) if scaled.is_kept is not None else "all", start, limits)
        )
        x = np.full(scaled.n, float(self.calls))
        work = {"iterations": 30}
        return Answer(
            lv.Status[self.statuses[self.calls - 1]],
            f"call {self.calls}",
            x,
            np.zeros(len(scaled.t)),
            work,
        )


@pytest.mark.parametrize(
    ("statuses", "accepted", "best"),
    [
        (["STALLED", "CONVERGED"], [False, True], 2),
        (["STALLED", "NUMERICAL_ERROR"], [False, False], 1),
        (["CONVERGED"], [True], 1),
        (["NUMERICAL_ERROR", "STALLED"], [False, False], 2),
    ],
)
def test_call_backend_until_accepted_returns_the_claim_of_the_best_call(statuses, accepted, best):
    program = get_program(lv.Problem.from_qp(np.eye(2), np.ones(2), G=[[1.0, 1.0]], h=[1.0]).qp)
    steps = None
    steps = Steps(statuses, accepted)
    more = {"max_iter": 100, "tol": 1e-6, "deadline": deadline.NEVER, "settings": {}}
    found = call_backend_until_accepted(program, steps, steps, **more)
    assert (steps.calls, found.message, found.status.name) == (
        len(accepted),
        f"call {best}",
        statuses[best - 1],
    )
    np.testing.assert_array_equal(
        found.point[0], program.restore_point(np.full(2, float(best)), np.zeros(1))[0]
    )
    assert found.work["backend_calls"] == steps.calls


def test_second_call_of_a_backend_has_all_rows_a_smaller_tolerance_and_the_rest_of_the_budget():
    program = get_program(
        lv.Problem.from_qp(np.diag([4.0, 1e4]), [4.0, 1e-3], G=np.eye(2), h=[1.0, 1e9]).qp
    )
    steps = Steps(["STALLED", "CONVERGED"], [False, True])
    start = (np.array([3.0, 5.0]), np.array([7.0, 11.0]))
    more = {"max_iter": 100, "tol": 1e-6, "deadline": deadline.NEVER, "settings": {}}
    call_backend_until_accepted(program, steps, steps, start=start, **more)
    (rows, x, first), (all_rows, _, second) = steps.received
    assert (rows, all_rows) == (1, "all") and second.eps < first.eps <= 1e-6
    assert (first.max_iter, second.max_iter) == (100, 70)
    for found, expected in zip(program.restore_point(*x), start, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert np.abs(x[0] - start[0]).max() > 0.0  # The scales of this program are not 1.


@pytest.mark.parametrize("x", [None, [0.0, 0.0], [-5.0, 9.0], [3.0, 2.0]])
@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-3, 1e4)])
def test_find_ray_returns_a_feasible_point_and_a_descent_direction_for_any_given_point(x, units):
    """In units of each variable, x_0 >= 2 and x_0 - x_1 = 1; the objective falls along (1, 1)."""
    units = np.array(units)
    rows = {"G": [[-1.0 / units[0], 0.0]], "h": [-2.0], "A": [[1.0, -1.0] / units], "b": [1.0]}
    program = get_program(lv.Problem.from_qp(np.zeros((2, 2)), [-1.0 / units[0], 0.0], **rows).qp)
    ray, point = find_ray(program, None if x is None else units * x, deadline.NEVER)
    np.testing.assert_allclose(ray, units / units.max(), rtol=1e-9)
    point = point / units
    assert point[0] >= 2.0 - 1e-5 and point[0] - point[1] == pytest.approx(1.0, abs=1e-5)


def test_program_form_of_more_rows_than_velocities_is_the_velocity_form():
    for m in (3, 1200):  # 1200 rows are above the limit up to which A is factored
        cones = lv.Cones.bounded(np.zeros(m), np.inf)
        problem = lv.Problem.from_jacobian(np.ones((m, 1)), [[1.0]], [-1.0], cones=cones)
        assert choose_program_form(problem, "auto") == "velocity"


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ("solved inaccurate", "STALLED"),
        ("primal infeasible inaccurate", "STALLED"),
        ("AlmostSolved", "STALLED"),
        ("AlmostPrimalInfeasible", "STALLED"),
        ("AlmostDualInfeasible", "STALLED"),
        ("PrimalInfeasible", "INFEASIBLE"),
        ("dual infeasible", "INFEASIBLE"),
        ("maximum iterations reached", "MAX_ITERATIONS"),
        ("Solved", "CONVERGED"),
        ("run time limit reached", "TIME_LIMIT"),
        ("interrupted", "INTERRUPTED"),
        ("InsufficientProgress", "STALLED"),
        ("problem non convex", "NUMERICAL_ERROR"),
    ],
)
def test_classify_status_of_a_backend_wording_is_never_more_certain(text, status):
    assert classify_status(text) is lv.Status[status]


def test_program_rows_below_the_infinite_size_are_kept_and_their_multipliers_return():
    program = {
        "A": [[1.0, 1.0, 0.0]],
        "b": [1.0],
        "G": np.ones((4, 3)),
        "h": [1.0, 5e19, 1e20, np.inf],
    }
    problem = lv.Problem.from_qp(
        np.eye(3), np.ones(3), **program, lb=[-1.0, 0.5, -np.inf], ub=[np.inf, 0.5, 2.0]
    )
    qp = problem.qp
    assert (
        len(qp.target) == 2 + 2 + 2
    )  # two equations, of which one has equal bounds, two rows of G, two bounds
    scaled = get_program(qp).scaled
    lam = np.arange(1.0, len(qp.target) + 1.0)
    np.testing.assert_array_equal(scaled.join_multipliers(*scaled.split_multipliers(lam)), lam)
    x = np.array([0.3, 0.5, -0.2])
    y = lam
    convex = get_program(qp)
    for found, expected in zip(
        convex.restore_point(*convex.scale_point(x, y)), (x, y), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    "name", lv.available(lv.Problem.from_qp(np.eye(2), np.zeros(2), lb=[0.0, 0.0]), external=False)
)
def test_solve_qp_of_unequally_scaled_variables_meets_tol_in_its_own_terms(name):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        n = 6
        scale = 10.0 ** rng.uniform(-3.0, 3.0, n)
        half = rng.normal(size=(n, n))
        P = (half @ half.T / n + 0.1 * np.eye(n)) * np.outer(scale, scale)
        q = rng.normal(size=n) * scale
        G = rng.normal(size=(4, n)) * scale
        h = rng.uniform(-1.0, 1.0, 4)
        for tol in (1e-4, 1e-7):
            answer = lv.solve_qp(P, q, G, h, solver=name, tol=tol)
            assert answer.found and answer.error <= tol, f"{name}, {seed}, {tol}: {answer}"
            assert (
                G @ answer.x - h <= 10.0 * tol * (np.abs(G) @ np.abs(answer.x) + np.abs(h))
            ).all()
            assert (answer.z >= -10.0 * tol * np.abs(answer.z).max(initial=0.0)).all()


# -- the best answer ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("name", ["lemke", "direct"])
def test_converted_rows_keep_their_start_and_are_never_worse(name, friction):
    cones = lv.Cones.contacts(np.full(3, 0.6), 2, shape="box")
    for seed in range(6):
        a, b = spd(9, seed=seed)
        problem = lv.Problem(b, cones, a, friction=friction)
        inside = project_impulse(
            cones, np.random.default_rng(seed).normal(size=9) * np.array([9.0, 1.0, 1.0] * 3)
        )
        form = convert_to_bounded_rows(problem)
        np.testing.assert_allclose(form.to_impulse @ form.convert_start(inside), inside, atol=1e-14)
        good = lv.solve(problem, "newton", tol=1e-13)
        start = good.impulse * 0.9 + 1e-3
        for given in (good.impulse, start):
            found = lv.solve(problem, name, impulse=given, max_iter=1, tol=1e-15)
            before = lv.residual(problem, project_impulse(cones, given)).relative
            assert found.residual.relative <= max(before, 2.0 * found.residual.roundoff_floor) * (
                1 + 1e-9
            ), seed


def test_converted_rows_add_the_work_of_the_solver_that_continues():
    class Works:
        def __init__(self, work, status, then=None):
            self.work, self.status, self.then = work, status, then

        def prepare(self, problem):
            return problem

        def fallback(self):
            return self.then

        def run(self, state, z, max_iter, tol, time_limit=None):
            return lv.Claim(self.status, 1, self.work)

    second = Works({"pivots": 5, "paths": 1}, lv.Status.STALLED)
    solver = BoundedRowSolver(Works({"pivots": 3, "factorisations": 2}, lv.Status.STALLED, second))
    problem = lv.Problem(np.ones(3), lv.Cones.contacts(0.5, shape="box"), np.eye(3) + 0.1)
    claim = solver.run(solver.prepare(problem), problem.start(), 10, 1e-9)
    assert claim.work == {"pivots": 8, "factorisations": 2, "paths": 1}


@pytest.mark.parametrize("seed", range(3))
def test_direct_of_an_ill_conditioned_asymmetric_matrix_ends_at_its_floor(seed):
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.normal(size=(30, 30)))[0] for _ in range(2))
    a = u @ np.diag(np.logspace(0, -9, 30)) @ v
    solution = lv.solve(lv.Problem.linear(a, rng.normal(size=30)), "direct", tol=1e-15)
    assert solution.residual.at_floor, str(solution)


def test_registered_solver_that_worsens_its_start_returns_the_start(plug_in):
    def worsen(problem, impulse):
        impulse += 10.0
        return lv.Claim(lv.Status.CONVERGED, 1)

    problem = random_contact_problem(3)
    start = project_impulse(problem.cones, 0.99 * lv.solve(problem, tol=1e-12).impulse)
    found = lv.solve(problem, plug_in(worsen), impulse=start, tol=1e-9)
    np.testing.assert_array_equal(found.impulse, start)
    assert found.is_contradicted and found.status is not lv.Status.MAX_ITERATIONS


@pytest.mark.parametrize("claimed", [lv.Status.CONVERGED, lv.Status.STALLED])
def test_claim_at_the_round_off_floor_has_the_status_roundoff_limit(plug_in, claimed):
    problem = random_contact_problem(3)
    start = project_impulse(problem.cones, lv.solve(problem, "newton", tol=1e-13).impulse)
    floor = lv.residual(problem, start)
    assert floor.relative > 0.0 and floor.above_floor == 0.0
    ends = plug_in(lambda problem, impulse: lv.Claim(claimed, 1))
    found = lv.solve(problem, ends, impulse=start, tol=0.5 * floor.relative)
    assert found.status is lv.Status.ROUNDOFF_LIMIT


def test_direct_with_a_factor_that_fails_at_last_returns_its_best_iterate(monkeypatch):
    """The steps of the first solves are a little too short and are refined, the third is wrong by far."""
    a = np.diag([1.0, -2.0, 3.0]) + 0.1
    steps = iter([0.99, 0.99, -1e3, 1.0])
    monkeypatch.setattr(
        direct.RankRevealingFactor, "solve", lambda self, w: next(steps) * np.linalg.solve(a, w)
    )
    solution = lv.solve(lv.Problem.linear(a, np.ones(3)), "direct", tol=1e-9)
    assert solution.residual.relative == pytest.approx(1e-4, rel=1e-3) and next(steps) == 1.0
    assert not solution.success and solution.status is lv.Status.STALLED


# -- numbers that are only shown ---------------------------------------------------------------------------------------


def test_cross_check_objective_is_that_of_numpy():
    a, b = spd(6, seed=3)
    problem = lv.Problem.lcp(a, b)
    check = lv.cross_check(problem, ["pgs", "newton"], tol=1e-3)
    best = lv.solve(problem, "newton", tol=1e-14).impulse
    for row in check.rows:
        lam = row.solution.impulse
        expected = (0.5 * lam @ a @ lam - b @ lam) - (0.5 * best @ a @ best - b @ best)
        assert row.objective == pytest.approx(expected, abs=1e-10 + 1e-3 * abs(expected))


def test_cross_check_reference_with_a_large_floor_is_not_an_optimum():
    near = 1.0 - 2.0**-40
    problem = lv.Problem.linear(
        [[1.0, near, 0.3], [near, 1.0, 0.3], [0.3, 0.3, 1.0]], [0.3, -0.7, 0.1]
    )
    check = lv.cross_check(problem, ["direct"], reference="direct")
    assert 10.0 * check.rows[0].roundoff_floor > check.rows[0].relative > 1e-5
    assert check.reference != "direct" and "direct: relative" in check.reference_note


def test_residual_of_ellipses_has_row_errors_in_the_metric_of_the_disk():
    a, b = spd(6, seed=1)
    problem = lv.Problem.contact(a, b, mu=[(0.9, 0.3), (0.2, 0.8)])
    found = lv.residual(problem, 0.1 * np.abs(b))
    assert found.velocity_by_row.max() <= found.velocity * (1.0 + 1e-12)
    np.testing.assert_allclose(
        found.velocity_by_row,
        lv.residual(problem.disk, problem.on_disk(0.1 * np.abs(b))).velocity_by_row,
    )


def test_solution_history_and_time_exclude_the_judge(monkeypatch):
    """The judge takes 1 s of a clock that nothing else moves."""
    now = [0.0]
    judge = log.measure_residual

    def judge_slowly(*given):
        now[0] += 1.0
        return judge(*given)

    for module in (loop, log):
        monkeypatch.setattr(module, "measure_residual", judge_slowly)
        monkeypatch.setattr(module, "perf_counter", lambda: now[0])
    monkeypatch.setattr(auto, "Recorder", lambda solve: log.Recorder(solve, now[0]))
    problem = random_contact_problem(0)
    solution = lv.solve(problem, "auto", history=True, tol=1e-9)
    assert now[0] > 0.0 and solution.history.time.max() == solution.solve_time == 0.0
    for name in lv.available(problem, history=True, callback=True):
        seen = []
        more = {
            "history": True,
            "callback": lambda k, x, r, seen=seen: seen.append(
                (k, r.relative, r.energy, r.velocity)
            ),
        }
        solution = lv.solve(problem, name, tol=1e-9, max_iter=40, **more)
        history = solution.history
        assert history.time.max() == solution.solve_time == 0.0, name
        columns = history.iterations, history.relative, history.energy, history.velocity
        assert list(zip(*(x.tolist() for x in columns), strict=True)) == seen, name


# -- gradients ---------------------------------------------------------------------------------------------------------


def test_gradient_by_mass_is_symmetric_and_of_a_doubled_contact_that_of_the_single_one():
    given = draw_worlds("batch")[0]
    jac = given.generalized.jac
    mass = spd(9)[0]
    problem = lv.Problem.from_jacobian(jac, mass, given.generalized.v_free, cones=given.cones)
    solution = lv.solve(problem, tol=1e-13)
    gradient = lv.derivative(problem, solution).vjp(velocity=np.arange(1.0, 10.0))
    by_mass = gradient.M.toarray()
    assert np.abs(by_mass).max() > 0.0
    np.testing.assert_allclose(by_mass, by_mass.T, rtol=1e-12, atol=1e-15)
    general = problem.generalized
    twice = lv.Problem.from_jacobian(
        sp.vstack([general.jac, general.jac]),
        general.mass,
        general.v_free,
        cones=lv.Cones.contacts(0.5, count=4),
    )
    both = lv.solve(twice, tol=1e-13)
    np.testing.assert_allclose(
        twice.velocity(both.impulse), problem.velocity(solution.impulse), atol=1e-9
    )
    found = lv.derivative(twice, both).vjp(velocity=np.arange(1.0, 10.0))
    np.testing.assert_allclose(found.v_free, gradient.v_free, atol=1e-6)


# -- reordered, cut and changed problems -------------------------------------------------------------------------------


def build_chain(order):
    """Build a branched chain of 40 velocities, numbered by `order`, of which only some have rows of J."""
    rng = np.random.default_rng(5)
    parent = [-1, *((i - 1) // 2 for i in range(1, 40))]
    root = np.eye(40) + sum(
        0.3 * np.outer(np.eye(40)[i], np.eye(40)[p]) for i, p in enumerate(parent) if p >= 0
    )
    jac = np.zeros((9, 40))
    for row, leaf in enumerate((39, 38, 30, 21, 20, 12, 7, 3, 0)):
        jac[row, leaf] = 1.0
        jac[row, parent[leaf]] += 0.5
    mass = (root.T @ root)[np.ix_(order, order)]
    return lv.Problem.from_jacobian(
        jac[:, order],
        mass,
        rng.normal(size=40)[order],
        cones=lv.Cones.contacts([0.5] * 3, 2),
        compliance=1e-3,
    )


def test_generalized_reordered_mass_is_shifted_in_the_given_order():
    n = 400
    line = sp.diags_array(
        [np.full(19, -1.0), np.full(20, 4.5), np.full(19, -1.0)], offsets=[-1, 0, 1]
    )
    order = np.random.default_rng(1).permutation(n)
    eye = sp.eye_array(20)
    mass = sp.csr_array(sp.kron(line, eye) + sp.kron(eye, line))[order][:, order]
    general = lv.Generalized(np.eye(3, n), mass, np.zeros(n))
    assert general.order is not None
    shift = np.linspace(0.0, 1.0, n)
    moved = general.with_diagonal_shift(shift)
    np.testing.assert_allclose(moved.mass.toarray(), mass.toarray() + np.diag(shift))


def test_problem_of_permuted_velocities_has_the_same_matrix_and_answers():
    plain = build_chain(np.arange(40))
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(40)
        problem = build_chain(order)
        np.testing.assert_allclose(problem.dense(), plain.dense(), atol=1e-12)
        for name in ("newton", "pgs", "auto"):
            own, other = (lv.solve(p, name, tol=1e-10).impulse for p in (plain, problem))
            np.testing.assert_allclose(own, other, atol=1e-7)


def list_problems_with_islands():
    """Return problems with several islands in every form; a tree of M also has velocities without rows."""
    chain = build_chain(np.arange(40)).generalized
    general = lv.Problem.from_jacobian(
        sp.block_diag([chain.jac, chain.jac]),
        sp.block_diag([chain.mass, chain.mass]),
        np.r_[chain.v_free, -chain.v_free],
        cones=lv.Cones.contacts([0.5] * 6, 2),
        compliance=np.linspace(0.0, 1e-2, 18),
    )
    rng = np.random.default_rng(8)
    rows = random_bodies_and_contacts(rng, bodies=12, joints=2, contacts=5)
    bodies = lv.Problem.from_rows(
        rows, mu=0.5, compliance=rng.uniform(0.0, 0.1, rows.joint_ptr[-1] + 15)
    )
    return [general, bodies, lv.Problem(bodies.b, bodies.cones, bodies.csr)]


@pytest.mark.parametrize(("row", "column"), [(0, 3), (1, 4), (2, 3), (5, 0)])
def test_islands_of_a_matrix_are_connected_by_any_of_their_rows(row, column):
    a = np.eye(6)
    assert find_islands(lv.Problem.contact(a, np.ones(6), mu=0.5))[0] == 2
    a[row, column] = a[column, row] = 0.3
    assert find_islands(lv.Problem.contact(a, np.ones(6), mu=0.5))[0] == 1


@pytest.mark.parametrize("kind", range(3))
def test_references_of_a_problem_are_those_of_its_islands_together(kind):
    problem = list_problems_with_islands()[kind]
    found = lv.residual(problem, problem.start())
    energy, velocity = (
        np.maximum(x, 0.0) for x in (found.islands.energy_at_zero, found.islands.velocity_at_zero)
    )
    assert len(energy) > 1 and velocity.argmax() < len(velocity) - 1
    assert found.energy_at_zero == pytest.approx(np.linalg.norm(energy))
    assert (
        found.velocity_at_zero == velocity.max() and found.relative == found.islands.relative.max()
    )
    solution = lv.solve(problem, "newton", velocity_tol=1e-4)
    assert solution.success and solution.residual.velocity <= 1e-4


@pytest.mark.parametrize("kind", range(3))
def test_solution_message_of_an_unfinished_solve_names_its_worst_island(kind):
    problem = list_problems_with_islands()[kind]
    solution = lv.solve(problem, "pgs", tol=1e-14, max_iter=2)
    label = solution.residual.islands[0]
    worst = solution.residual.worst_island
    name = problem.block_name(int(np.flatnonzero(label == worst)[0]))
    assert not solution.success and f"island {worst} ({name}" in solution.message


@pytest.mark.parametrize("name", ["pgs", "jacobi"])
def test_iterations_that_a_message_predicts_are_about_those_that_are_needed(name):
    n = 60
    problem = lv.Problem.lcp(2.02 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1), np.ones(n))
    stopped, solved = (lv.solve(problem, name, tol=1e-9, max_iter=limit) for limit in (150, 10**5))
    predicted = float(re.search(r"tol needs about (\S+) more", stopped.message)[1])
    assert solved.success and 0.5 < (predicted + 150) / solved.iterations < 2.0


@pytest.mark.parametrize("name", ["pgs", "jacobi", "block_gauss_seidel", "anderson"])
def test_sweeps_solve_a_slow_island_although_another_has_no_solution(name):
    n = 60
    slow = 2.02 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    problem = lv.Problem.lcp(sp.block_diag([[[1.0, -1.0], [-1.0, 1.0]], slow]), np.ones(n + 2))
    solution = lv.solve(problem, name, tol=1e-9, max_iter=20_000)
    assert not solution.success and solution.residual.islands.relative[1] <= 1e-9, str(solution)


@pytest.mark.parametrize("name", ["auto", "direct", "newton"])
def test_stages_begin_at_the_start_and_end_at_the_result(name):
    for seed in range(3):
        problem = (
            random_contact_problem(seed) if name != "direct" else lv.Problem.lcp(*spd(6, seed=seed))
        )
        start = 0.5 * lv.solve(problem, tol=1e-9).impulse
        for given in (None, start):
            solution = lv.solve(problem, name, impulse=given, tol=1e-7)
            before = lv.residual(
                problem, problem.start() if given is None else project_impulse(problem.cones, given)
            )
            if solution.stages:
                assert solution.stages[0].before == pytest.approx(before.relative, rel=1e-9)
                assert solution.stages[-1].after == pytest.approx(
                    solution.residual.relative, rel=1e-9
                )
            assert solution.stages or name != "auto"


@pytest.mark.parametrize("signs", [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_auto_proves_an_infeasible_island_of_any_signs_at_any_place(place, signs):
    """Two rows of one velocity contradict each other; limits on the other side turn both signs."""
    rows, one, other = [], *signs
    for island in range(3):
        target = [one, 0.0] if island == place else [-one, -0.5 * other]
        low, high = (
            np.where(np.array([one, -other]) > 0.0, x, -y)
            for x, y in ((0.0, np.inf), (np.inf, 0.0))
        )
        jac = [[one, 0.2 * one], [other, 0.2 * other]]
        cones = lv.Cones.bounded(low, high)
        rows.append(
            lv.Problem.from_jacobian(jac, np.eye(2), [0.0, 0.0], target=target, cones=cones)
        )
    jac = sp.block_diag([p.generalized.jac for p in rows])
    b = np.concatenate([p.b for p in rows])
    cones = lv.Cones.bounded(
        *(np.concatenate([getattr(p.cones, n) for p in rows]) for n in ("lower", "upper"))
    )
    whole = lv.Problem.from_jacobian(jac, np.eye(6), np.zeros(6), target=b, cones=cones)
    for problem in (whole, lv.Problem(whole.b, whole.cones, whole.csr)):
        solution = lv.solve(problem)
        assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == "confirmed", str(
            solution
        )
        assert np.flatnonzero(solution.certificate).tolist() == [2 * place, 2 * place + 1]
        np.testing.assert_array_equal(solution.impulse, project_impulse(cones, solution.impulse))


@pytest.mark.parametrize("order", ["colored", "bottom_up", "top_down", "given"])
def test_sweeps_move_a_pinned_body_that_turns_in_every_order(order):
    """Two bodies on a wheel whose centre is fixed: a colour must not contain both of its contacts."""
    rows = lv.Rows(
        inv_mass=[0.0, 1.0, 1.0],
        inv_inertia=np.array([np.eye(3)] * 3),
        v_free=[[0.0] * 6, [0.0, 0.0, -1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -2.0, 0.0, 0.0, 0.0]],
        normal=[[0.0, 0.0, 1.0]] * 2,
        tangent=[[1.0, 0.0, 0.0]] * 2,
        arm_a=[[1.0, 0.0, 0.0], [-0.5, 0.2, 0.0]],
        arm_b=[[0.0, 0.0, 0.0]] * 2,
        contact_body=[[0, 1], [0, 2]],
    )
    problem = lv.Problem.from_rows(rows, mu=0.3)
    assert rows.moving_block_bodies.tolist() == [[0, 1], [0, 2]]
    assert find_islands(problem)[0] == 1
    expected = lv.solve(problem, "newton", tol=1e-12).impulse
    for name in ("sequential_impulses", "pgs"):
        found = lv.solve(problem, name, order=order, tol=1e-11, max_iter=10_000).impulse
        np.testing.assert_allclose(found, expected, atol=1e-8)


# -- two options together ----------------------------------------------------------------------------------------------


def test_recorder_with_every_and_keep_worst_keeps_selected_steps(tmp_path):
    batch = lv.Batch(
        np.ones((1, 1, 1)),
        np.ones((1, 1, 1)),
        -np.ones((1, 1)),
        cones=lv.Cones.contacts(0.0, tangents=0),
    )
    with lv.io.Recorder(tmp_path / "a", every=2, keep_worst=1) as recorder:
        for error in (0.1, 0.2, 0.3, 0.05, 0.4, 0.25):
            recorder.add(lv.io.EngineStep(batch, np.array([[1.0 - error]]), None))
    lines = [
        json.loads(line) for line in (tmp_path / "a" / "engine.jsonl").read_text().splitlines()
    ]
    assert (
        sorted(line["step"] for line in lines)
        == [0, 2, 4]
        == sorted(int(name[5:11]) for name in recorder.files)
    )


@pytest.mark.parametrize("speed", [1e4, 1.0, 1e-3])
def test_solution_to_a_velocity_error_is_converged_exactly_if_it_meets_it(speed):
    (a, b) = spd(8, seed=1)
    statuses = set()
    problem = lv.Problem.lcp(a, speed * np.abs(b))
    for n in range(1, 80):
        solution = lv.solve(problem, "pgs", velocity_tol=1e-3, max_iter=n)
        statuses.add(solution.status.name)
        is_met = solution.residual.velocity <= 1e-3
        assert solution.success == is_met == (solution.status is lv.Status.CONVERGED), (
            f"{n}: {solution}"
        )
    assert statuses >= ({"CONVERGED"} if speed < 1.0 else {"MAX_ITERATIONS"})


@pytest.mark.parametrize("seed", range(2))
def test_solution_that_meets_tol_at_its_iteration_limit_is_converged(seed):
    problem = random_contact_problem(seed)
    for name in lv.available(problem, history=True):
        for n in (*range(1, 30), 45, 77, 130):
            solution = lv.solve(problem, name, tol=1e-2, max_iter=n)
            assert solution.success == (solution.status is lv.Status.CONVERGED), (
                f"{name}, {n}: {solution}"
            )
