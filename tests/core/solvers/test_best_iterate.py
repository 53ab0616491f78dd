"""Tests of the impulse that a solve returns (`lavender_ext/judge/best.pxd`), and that it is inside its bounds."""

import numpy as np
import pytest
import scipy.sparse as sp
from random_problems import FORMS, random_contact_problem, spd

import lavender as lv
from lavender.judge.residuals import choose_start, combine_best_islands
from lavender.solvers.islands import find_islands

DT = 1.0 / 60.0
SWEEPS = lv.available(order=True, external=False)


def pendulum(torque, target=4.0):
    """A pendulum of 0.01 kg m^2 at 2 rad/s whose motor of `torque` N m presses it against its stop at 0.1 rad/s.

    The stop wins: 0.1 rad/s, and the pin of the hinge rests.
    """
    builder = lv.RowBuilder([1.0], [100.0], [(0.0, -9.81 * DT, 2.0)], DT, position=[(0.0, 0.0)])
    builder.hinge(-1, 0, anchor=(0.0, 0.0))
    builder.motor(-1, 0, speed=target, max_torque=torque)
    builder.limit(-1, 0, value=0.0, upper=0.1 * DT)
    return builder, builder.problem()


def objective(problem, impulse):
    return float(0.5 * impulse @ (problem.csr @ impulse) - problem.b @ impulse)


@pytest.mark.parametrize("form", ["bodies", "matrix"])
@pytest.mark.parametrize(("torque", "sweeps"), [(50.0, 10), (50.0, 3), (1e4, 1000)])
@pytest.mark.parametrize("name", SWEEPS)
def test_sweeps_motor_against_its_stop_returns_the_last_iterate(name, torque, sweeps, form):
    builder, problem = pendulum(torque)
    given = problem
    if form == "matrix":
        given = lv.Problem(problem.b, problem.cones, problem.csr)
    if name not in lv.available(given):
        pytest.skip("the solver takes another form")
    solution = lv.solve(given, name, max_iter=sweeps)
    velocity = builder.velocity_after(problem, solution.impulse)[0]
    np.testing.assert_allclose(velocity, [0.0, 0.0, 0.1], atol=1e-3)
    assert objective(problem, solution.impulse) < 0.0


def test_sweeps_asymmetric_matrix_with_motor_holds_the_free_rows():
    _, problem = pendulum(50.0)
    a = problem.csr.toarray()
    a[1, 0] *= 1.001  # between the two rows of the pin: asymmetric
    a[0, 0] *= 1.001
    given = lv.Problem(problem.b, problem.cones, a + 1e-3 * np.triu(np.abs(a) > 0.0, 1))
    assert not given.is_symmetric
    solution = lv.solve(given, "pgs", max_iter=10)
    slack = given.csr @ solution.impulse - given.b
    assert abs(solution.impulse).max() > 0.0 and abs(np.delete(slack, 2)).max() < 1e-2


def gear_train(contact, force=1e5, ratio=3.0, wheels=7):
    """Wheels on hinges, each driving the next `ratio` times as fast, and a motor of `force` N m on the first."""
    dt = 1.0 / 60.0
    nv = 3 * wheels
    unit = np.eye(nv)
    hinges = [unit[3 * i + k] for i in range(wheels) for k in (0, 1)]
    gears = [
        ratio * unit[3 * i + 2] - unit[3 * i + 5] + 0.1 * (unit[3 * i + 1] - unit[3 * i + 4])
        for i in range(wheels - 1)
    ]
    free = len(hinges) + len(gears)
    limit = np.r_[np.full(free, np.inf), force * dt]
    rows = [*hinges, *gears, unit[2]]
    target = [0.0] * free + [1.0]
    cones = lv.Cones.bounded(-limit, limit)
    if contact:  # The last wheel rests on the ground, and may roll on it.
        rows = [*rows, unit[-2], unit[-3], unit[-1]]
        target = [*target, 0.0, 0.0, 0.0]
        cones = cones + lv.Cones.contacts([0.5])
    v = np.zeros(nv)
    v[1::3] = -9.81 * dt
    return lv.Problem.from_jacobian(
        np.array(rows), np.diag([1.0, 1.0, 0.01] * wheels), v, target=target, cones=cones
    )


@pytest.mark.parametrize("contact", [False, True])
@pytest.mark.parametrize("name", ["pgs", "block_gauss_seidel", "anderson"])
def test_sweeps_that_stop_at_a_strong_gear_train_hold_the_hinges(name, contact):
    problem = gear_train(contact)
    for sweeps in (10, 64, 1000):
        solution = lv.solve(problem, name, max_iter=sweeps)
        # Without impulses the hinges fall with 0.16 m/s; ten sweeps of a loop by hand leave 3e-4 m/s.
        assert np.abs(problem.velocity(solution.impulse).reshape(-1, 3)[:, :2]).max() < 1e-3, sweeps


@pytest.mark.parametrize("name", ["pgs", "block_gauss_seidel", "sequential_impulses"])
def test_sweeps_under_coulomb_law_return_the_last_iterate(name):
    for seed in range(10):
        problem = random_contact_problem(seed)
        for sweeps in (1, 3, 10):
            solution, last = (
                lv.solve(problem, name, tol=tol, max_iter=sweeps) for tol in (1e-13, 0.0)
            )
            if find_islands(problem)[0] == 1 and not solution.success:
                np.testing.assert_array_equal(solution.impulse, last.impulse)


def test_sweeps_stale_start_begin_at_zero_in_that_island_alone():
    problem = lv.Problem.lcp(np.diag([1.0, 1.0]) + np.array([[0.0, 0.0], [0.0, 0.0]]), [1.0, 1.0])
    assert find_islands(problem)[0] == 2
    kept = lv.solve(problem, "jacobi", impulse=[0.9, 1e6], tol=1e-30, max_iter=0)
    np.testing.assert_array_equal(
        kept.impulse, [0.9, 1e6]
    )  # Without an iteration nothing is judged.
    history = []
    lv.solve(
        lv.Problem.lcp(np.array([[2.0, 1.0, 0], [1.0, 2.0, 0], [0, 0, 1.0]]), [1.0, 1.0, 1.0]),
        "jacobi",
        impulse=[1e6, 1e6, 0.9],
        tol=1e-9,
        max_iter=3,
        callback=lambda n, x, r: history.append(x.copy()),
    )
    assert np.abs(history[1][:2]).max() < 10.0
    # With tol = 0 the start is kept: one iteration of Jacobi's method depends on it.
    exact = lv.solve(
        lv.Problem.lcp([[1.0, 0.5], [0.5, 1.0]], [1.0, 1.0]),
        "pgs",
        impulse=[0.0, 1e6],
        tol=0.0,
        max_iter=1,
    )
    assert exact.impulse[0] == 0.0 and exact.impulse[1] == 1.0


def test_solve_start_of_problem_at_rest_begins_at_zero():
    """Two separating contacts: zero impulses solve them, so that any other start is worse."""
    problem = lv.Problem.lcp(np.eye(2), [-1.0, -1.0])
    for name in ("pgs", "newton", "auto", "jacobi", "admm"):
        solution = lv.solve(problem, name, impulse=[0.3, 0.2], tol=1e-9, max_iter=1)
        np.testing.assert_array_equal(solution.impulse, 0.0, err_msg=name)


@pytest.mark.parametrize("seed", range(5))
def test_combine_best_islands_takes_the_smallest_objective_of_each_island(seed):
    """1/2 l.A l - b.l of each of three islands, of impulses within their bounds that are no solutions."""
    rng = np.random.default_rng(seed)
    size = 4
    blocks = [spd(size, seed=10 * seed + k) for k in range(3)]
    a = sp.block_diag([matrix for matrix, _ in blocks])
    problem = lv.Problem.lcp(a, np.concatenate([b for _, b in blocks]))
    near = lv.solve(problem, tol=1e-9).impulse
    points = np.vstack([near * rng.uniform(0.3, 1.5, (4, 3 * size)), problem.start()])
    values = [
        [
            0.5 * x @ matrix @ x - b @ x
            for (matrix, b), x in zip(blocks, np.split(point, 3), strict=True)
        ]
        for point in points
    ]
    found = combine_best_islands(
        problem, points[0], list(points[1:4]), 1e-12
    )  # The last is always compared, too.
    best = np.argmin(values, axis=0)
    np.testing.assert_array_equal(
        found, np.concatenate([np.split(points[i], 3)[k] for k, i in enumerate(best)])
    )


def preloaded_problem(seed, law, rhs_size):
    """Rows under preload (a fixed force, a motor between two torques, belts under tension), and contacts or bounds."""
    rng = np.random.default_rng(seed)
    fixed = lv.Cones.bounded([1.0, 0.5, 2.0, 1.0], [1.0, 1.5, np.inf, np.inf])
    rest = (
        lv.Cones.bounded(np.zeros(9), np.full(9, np.inf))
        if law == "lcp"
        else lv.Cones.contacts(np.full(3, 0.5))
    )
    cones = fixed + rest
    jac = rng.standard_normal((len(cones.lower), 16))
    free = rng.standard_normal(16)
    matrix = jac @ jac.T + 0.1 * np.eye(len(jac))
    b = rhs_size * -jac @ free
    return lv.Problem(b, cones, matrix, friction="cone" if law == "cone" else "coulomb")


DECADES = [*range(0, 20, 3), np.inf]


@pytest.mark.parametrize("law", ["lcp", "cone", "coulomb"])
@pytest.mark.parametrize("name", [*SWEEPS, "jacobi", "apgd", "admm"])
def test_solve_bounds_exclude_zero_returns_no_iterate_worse_than_its_last_for_any_size_of_b(
    name, law
):
    for decade in DECADES:
        problem = preloaded_problem(int(min(decade, 20.0)), law, 10.0**-decade)
        if name not in lv.available(problem):
            pytest.skip("the solver takes another law")
        for sweeps in (3, 10, 200):
            seen = []
            found = lv.solve(
                problem,
                name,
                tol=1e-17,
                max_iter=sweeps,
                callback=lambda n, x, r, seen=seen: seen.append(x.copy()),
            )
            assert found.claim_check == "confirmed"
            last, now = (lv.residual(problem, x) for x in (seen[-1], found.impulse))
            if law == "coulomb":
                assert now.energy <= last.energy + last.floor_energy
                continue
            # f is a sum of terms of this size; a thousand of their roundings are 1e-13.
            size = float(np.abs(seen[-1]) @ (np.abs(problem.csr.toarray()) @ np.abs(seen[-1])))
            assert objective(problem, found.impulse) <= objective(problem, seen[-1]) + 1e-12 * size


@pytest.mark.parametrize("law", ["lcp", "cone", "coulomb"])
@pytest.mark.parametrize("tol", [1e-17, 0.0])
@pytest.mark.parametrize("name", ["newton", "auto"])
def test_newton_bounds_exclude_zero_keeps_its_solution_for_any_size_of_b(name, tol, law):
    for decade in DECADES:
        problem = preloaded_problem(int(min(decade, 20.0)), law, 10.0**-decade)
        found = lv.solve(problem, name, tol=tol)
        assert found.claim_check == "confirmed"
        assert found.residual.above_floor == 0.0


@pytest.mark.parametrize("form", FORMS)
def test_auto_whose_start_the_zero_impulse_replaces_ends_no_worse_than_zero_under_coulomb_law(form):
    replaced = 0
    for seed in range(30):
        problem = FORMS[form](random_contact_problem(seed, bodies=6, contacts=8))
        start = np.abs(100.0 * np.random.default_rng(seed).standard_normal(problem.m))
        begin = choose_start(problem, start, 1e-13)
        if find_islands(problem)[0] > 1 or (begin - problem.start()).any():
            continue
        replaced += 1
        zero = lv.residual(problem, problem.start())
        for steps in (1, 2, 4, 8):
            found = lv.solve(problem, "auto", impulse=start, tol=1e-13, max_iter=steps)
            assert found.residual.energy <= zero.energy * (1.0 + 1e-12), (seed, steps)
    assert replaced > 5
