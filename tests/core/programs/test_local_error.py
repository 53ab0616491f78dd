"""Properties of the error of quadratic programs that hold for every program, on random integer programs."""

import numpy as np
import pytest

import lavender as lv
from benchmarks.programs import solve_exactly
from lavender.base import deadline
from lavender.programs.forms import get_program
from lavender.programs.proofs import find_ray

SEEDS = range(40)
POWERS = range(31)


def draw_program(seed):
    """Return arrays of an integer program, its exact solution x (n,), and the multipliers y and z."""
    rng = np.random.default_rng(seed)
    n, n_a, n_g = rng.integers([1, 0, 0], [6, 3, 5])
    root = rng.integers(-2, 3, (n, n))
    P = (root.T @ root).astype(float) * (rng.random() < 0.8)
    x = rng.integers(-4, 5, n).astype(float)
    A, G = rng.integers(-2, 3, (n_a, n)).astype(float), rng.integers(-2, 3, (n_g, n)).astype(float)
    y, z = rng.integers(-3, 4, n_a).astype(float), rng.integers(0, 4, n_g).astype(float)
    slack = np.where(z > 0.0, 0.0, rng.integers(0, 4, n_g))
    q = -(P @ x) - A.T @ y - G.T @ z
    return {"P": P, "q": q, "G": G, "h": G @ x + slack, "A": A, "b": A @ x}, x, y, z


def draw_ray(seed):
    """Return arrays of an integer program, a point that satisfies its rows, and a ray of unlimited decrease."""
    rng = np.random.default_rng(seed)
    n, n_a, n_g = rng.integers([2, 0, 0], [6, 2, 5])
    d = rng.integers(-2, 3, n).astype(float)
    d[0] = 1.0

    def remove(rows):
        return rows * (d @ d) - np.outer(rows @ d, d)

    root, A = remove(rng.integers(-1, 2, (2, n))), remove(rng.integers(-1, 2, (n_a, n)))
    G = rng.integers(-2, 3, (n_g, n)).astype(float)
    G[G @ d > 0.0] *= -1.0
    x = rng.integers(-4, 5, n).astype(float)
    q = rng.integers(-5, 6, n).astype(float)
    q -= d * (np.floor(q @ d / (d @ d)) + 1.0)
    assert q @ d < 0.0 and not (root @ d).any()
    P = root.T @ root
    return {"P": P, "q": q, "G": G, "h": G @ x + 1.0, "A": A, "b": A @ x}, x, d


def draw_point(x, n_rows, seed):
    """Return a point near or far from x, and multipliers of rows; some of them are large."""
    rng = np.random.default_rng((seed, 1))
    scale = 10.0 ** rng.uniform(-12, 3)
    point = x * (1.0 + scale * rng.normal(size=len(x))) + scale * rng.integers(-1, 2, len(x))
    lam = rng.integers(-3, 4, n_rows) * 10.0 ** rng.uniform(-3, rng.integers(1, 16), n_rows)
    return point, lam


def judge(arrays, x, lam):
    return lv.Problem.from_qp(**arrays).qp.judge(np.array(x, float), np.array(lam, float))


def add_block(arrays, side, cost, unit):
    """Return the program with two variables of their own, and the solution and the multipliers of these."""
    block = np.array([[2.0, 1.0], [1.0, 2.0]])
    n = len(arrays["q"])

    def join(first, second):
        out = np.zeros((first.shape[0] + second.shape[0], n + 2))
        out[: first.shape[0], :n], out[first.shape[0] :, n:] = first, second
        return out

    joined = {
        "P": join(arrays["P"], cost * block),
        "q": np.append(arrays["q"], np.zeros(2)),
        "A": join(arrays["A"], np.full((1, 2), unit)),
        "b": np.append(arrays["b"], unit * side),
        "G": arrays["G"] @ np.eye(n, n + 2),
        "h": arrays["h"],
    }
    return joined, np.full(2, 0.5 * side), 1.5 * cost * side / unit


@pytest.mark.parametrize("seed", SEEDS)
def test_independent_block_does_not_lower_the_error(seed):
    arrays, x, _, _ = draw_program(seed)
    n_a, n_g = len(arrays["b"]), len(arrays["h"])
    x, lam = draw_point(x, n_a + n_g, seed)
    error = judge(arrays, x, lam)[0]
    rng = np.random.default_rng((seed, 2))
    for _ in range(8):
        side, cost = 10.0 ** rng.uniform(-15, 15, 2)
        joined, own, multiplier = add_block(arrays, side, cost, 10.0 ** rng.uniform(-8, 8))
        after = judge(joined, [*x, *own], [*lam[:n_a], multiplier, *lam[n_a:]])[0]
        # Scales D and E of a program depend on all of its rows, and the thresholds of (5) and (6) on these.
        assert after >= error / 2.0 or error <= 1e-12


@pytest.mark.parametrize("seed", SEEDS)
def test_units_of_cost_and_rows_keep_the_error(seed):
    arrays, x, _, _ = draw_program(seed)
    n_a, n_g = len(arrays["b"]), len(arrays["h"])
    x, lam = draw_point(x, n_a + n_g, seed)
    error = judge(arrays, x, lam)[0]
    rng = np.random.default_rng((seed, 3))
    for _ in range(4):
        cost = 2.0 ** rng.integers(-100, 101)
        changed = arrays | {"P": cost * arrays["P"], "q": cost * arrays["q"]}
        np.testing.assert_allclose(judge(changed, x, cost * lam)[0], error, rtol=1e-9)
        row = 2.0 ** rng.integers(-100, 61, n_a + n_g)  # h of 1e20 is infinite.
        changed = arrays | {
            "A": row[:n_a, None] * arrays["A"],
            "b": row[:n_a] * arrays["b"],
            "G": row[n_a:, None] * arrays["G"],
            "h": row[n_a:] * arrays["h"],
        }
        # E is a power of two near 1 / (largest entry of a row), so that (5) has thresholds up to twice as large.
        after = judge(changed, x, lam / row)[0]
        assert error / 2.0 <= after <= 2.0 * error or max(after, error) <= 1e-12


@pytest.mark.parametrize("seed", SEEDS)
def test_points_along_a_ray_have_a_strict_error(seed):
    arrays, x, d = draw_ray(seed)
    problem = lv.Problem.from_qp(**arrays)
    J, m = problem.qp.generalized.jac, len(problem.qp.target)
    for power in POWERS:
        far = x + 10.0**power * d
        gradient = arrays["P"] @ far + arrays["q"]
        fitted = np.linalg.lstsq(J.toarray().T, gradient, rcond=None)[0] if m else np.zeros(0)
        for lam in (np.zeros(m), fitted):
            assert problem.qp.judge(far, lam)[1] > 1e-6
    answer = lv.solve_qp(problem, tol=1e-6)
    assert answer.solution.status is lv.Status.UNBOUNDED and not answer.found


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("spread", [0, 10, 40])
def test_exact_solution_rounded_to_doubles_has_no_error(seed, spread):
    arrays, x, y, z = draw_program(seed)
    rng = np.random.default_rng((seed, 4))
    unit, row = (
        2.0 ** rng.integers(-spread, spread + 1, size) for size in (len(x), len(y) + len(z))
    )
    third = 1.0 / 3.0  # x / 3 is rounded.
    scaled = {
        "P": unit[:, None] * arrays["P"] * unit,
        "q": third * arrays["q"] * unit,
        "A": row[: len(y), None] * arrays["A"] * unit,
        "b": row[: len(y)] * arrays["b"] * third,
        "G": row[len(y) :, None] * arrays["G"] * unit,
        "h": row[len(y) :] * arrays["h"] * third,
    }
    lam = third * np.append(-y, z) / row
    assert judge(scaled, third * x / unit, lam)[0] <= 1e-12


def test_exact_solution_of_a_column_with_many_terms_has_no_error():
    """The terms of the column are 1e13 times its cost, and cancel exactly."""
    half = 30_000
    J = np.append(np.repeat([1.0, -2.0], [half, half // 2]), 1.0)
    lam = np.full(len(J), 1.0 / 3.0)
    lam[-1] = 2.0 ** np.ceil(np.log2(1.3e-13 * (np.abs(J[:-1]) @ lam[:-1])))
    arrays = {"P": [[lam[-1]]], "q": [0.0], "G": -J[:, None], "h": -J}
    assert judge(arrays, [1.0], lam)[0] <= 1e-12
    assert judge(arrays, [2.0], lam)[0] > 0.1


@pytest.mark.parametrize("power", range(0, 26, 2))
def test_multipliers_that_cancel_hide_no_cost(power):
    """x = 0 is feasible, and 0.5 is right; no multiplier changes the cost of x_0."""
    arrays = {
        "P": np.diag([1.0, 1.0, 0.0]),
        "q": [-1.0, 0.0, 0.0],
        "A": [[1.0, -1.0, 0.0], [1.0, -1.0, 0.0]],
        "b": [0.0, 0.0],
    }
    large = 10.0**power
    assert judge(arrays, [0.0, 0.0, 0.0], [large, -large])[0] > 0.1
    # A column without a cost, x_1 = 0, whose force of 1 is not balanced.
    arrays = {
        "P": np.zeros((3, 3)),
        "q": [1.0, 0.0, 0.0],
        "A": [[1.0, 1.0, 0.0], [0.0, 1.0, -1.0], [0.0, 1.0, -1.0]],
        "b": [1.0, 0.0, 0.0],
        "lb": [0.0, -9.0, -9.0],
    }
    assert judge(arrays, [1.0, 0.0, 0.0], [1.0, large, -large, 0.0, 0.0, 0.0])[0] > 0.1


def test_row_of_rounding_counts_in_the_gap():
    """x_0 = 2^-60, x_(k+1) = 2 x_k, x_60 + u = 1: u = 0. All rows but one are below 2^-43 of the last one."""
    n = 62
    A = np.eye(n) - 2.0 * np.eye(n, k=-1)
    A[-1, -2:], A[-1, -1] = 1.0, 1.0
    b = np.zeros(n)
    b[0], b[-1] = 2.0**-60, 1.0
    P = np.zeros((n, n))
    P[-1, -1] = 1.0
    wrong = np.zeros(n)
    wrong[-1] = 1.0
    lam = np.linalg.solve(A.T, P @ wrong)
    assert judge({"P": P, "q": np.zeros(n), "A": A, "b": b}, wrong, lam)[0] > 0.1
    answer = lv.solve_qp(P, np.zeros(n), A=A, b=b, tol=1e-6)
    assert not answer.found or abs(answer.x[-1]) <= 1e-6


@pytest.mark.parametrize("side", [1.0, 1e9, 1e13])
@pytest.mark.parametrize("connection", [0.0, 1.0])
@pytest.mark.parametrize("solver", ["auto", "osqp", "quadprog"])
def test_contradicting_rows_beside_a_large_side_are_proved(side, connection, solver):
    """x_0 + x_2 = 0 and = 1; x_1 >= side, which other rows connect with x_0."""
    answer = lv.solve_qp(
        np.zeros((3, 3)),
        [0.0, 1.0, 0.0],
        G=[[-connection, -1.0, 0.0]],
        h=[0.0],
        A=[[1.0, 0.0, 1.0], [1.0, 0.0, 1.0]],
        b=[0.0, 1.0],
        lb=[-np.inf, side, -np.inf],
        solver=solver,
        tol=1e-6,
    )
    assert answer.solution.status is lv.Status.INFEASIBLE and not answer.found
    assert "A[0], A[1]" in answer.solution.message


@pytest.mark.parametrize("solver", ["auto", "osqp", "quadprog"])
def test_row_is_not_hidden_by_other_variables_costs_or_units(solver):
    """min x_0 + x_1 + 2 x_2 with x_0 >= large, x_1 + x_2 >= 1 in other units, x >= 0: x = (large, 1, 0)."""
    for large, unit, cost in (
        (1e9, 1e-9, 1.0),
        (1e6, 2.0**-50, 1.0),
        (1.0, 2.0**100, 1.0),
        (0.0, 1.0, 1e14),
    ):
        answer = lv.solve_qp(
            None,
            [cost, 1.0, 2.0],
            G=[[0.0, -unit, -unit]],
            h=[-unit],
            lb=[large, 0.0, 0.0],
            solver=solver,
        )
        assert not answer.found or np.abs(answer.x - [large, 1.0, 0.0]).max() <= 1e-8 * max(
            large, 1.0
        )
        assert answer.found or solver == "quadprog"  # It needs a definite P.


def test_error_of_scaled_integer_programs_is_judged_in_fractions():
    """Programs times powers of two up to 2^40: what is found equals the exact solution, where it is unique."""
    n_found = 0
    for seed in range(50):
        arrays, _, _, z = draw_program(seed)
        arrays["P"] = arrays["P"] + np.eye(len(arrays["q"]))
        rows = np.flatnonzero(z > 0.0) + len(arrays["b"])
        try:
            exact = solve_exactly(arrays, rows.tolist())
        except ZeroDivisionError:
            continue
        if exact is None:
            continue
        rng = np.random.default_rng((seed, 5))
        unit = 2.0 ** rng.integers(-20, 21, len(exact))
        scaled = arrays | {
            "P": unit[:, None] * arrays["P"] * unit,
            "q": arrays["q"] * unit,
            "A": arrays["A"] * unit,
            "G": arrays["G"] * unit,
        }
        for solver in ("auto", "osqp"):
            answer = lv.solve_qp(**scaled, solver=solver)
            if answer.found:
                n_found += 1
                np.testing.assert_allclose(answer.x * unit, exact, rtol=1e-6, atol=1e-8)
    assert n_found >= 30


@pytest.mark.parametrize("solver", ["newton", "pgs", "nncg", "admm"])
def test_own_solver_searches_no_proof_on_feasible_programs(solver, monkeypatch):
    def fail(*arguments, **options):
        raise AssertionError("a linear program was solved")

    monkeypatch.setattr("lavender.programs.proofs._solve_linear_program", fail)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        half, G, inside = (rng.normal(size=size) for size in ((20, 20), (30, 20), 20))
        arrays = {"P": half @ half.T + np.eye(20), "q": rng.normal(size=20), "G": G}
        answer = lv.solve_qp(**arrays, h=G @ inside + rng.random(30), solver=solver)
        assert answer.found or answer.error < 1e-4


@pytest.mark.parametrize("cost", [1.0, 1e6, 1e9, 1e12, 1e16])
@pytest.mark.parametrize("solver", ["auto", "osqp", "quadprog"])
def test_cost_of_another_component_hides_no_ray(cost, solver):
    """min (x_0 - x_1)^2 / 2 - x_0 + cost x_2 with x_2 >= 1 has the ray (1, 1, 0)."""
    answer = lv.solve_qp(
        [[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]],
        [-1.0, 0.0, cost],
        lb=[-np.inf, -np.inf, 1.0],
        solver=solver,
    )
    assert not answer.found
    assert answer.solution.status is lv.Status.UNBOUNDED
    # Two roundings of the projection; the entries are of size 1.
    np.testing.assert_allclose(answer.ray, [1.0, 1.0, 0.0], atol=1e-14)


@pytest.mark.parametrize("power", range(2, 9))
@pytest.mark.parametrize("solver", ["auto", "piqp", "osqp", "quadprog"])
def test_rounding_of_large_variables_hides_no_ray(power, solver):
    """P (1, 1) = 0 and q.(1, 1) = -1, which is 10^-power of q; at large x it is rounding of P x."""
    pytest.importorskip("piqp" if solver == "auto" else solver)
    large = 10.0**power
    P = large * np.array([[1.0, -1.0], [-1.0, 1.0]])
    answer = lv.solve_qp(P, [-large, large - 1.0], G=[[1.0, -1.0]], h=[5.0], solver=solver)
    assert not answer.found


@pytest.mark.parametrize("power", [30, 40, 43])
@pytest.mark.parametrize("scale", [1e3, 1e6])
@pytest.mark.parametrize("solver", ["auto", "clarabel", "piqp"])
def test_direction_of_little_curvature_is_no_ray(power, scale, solver):
    """P_11 exceeds 1 by 2^-power in units of `scale`: the program has a solution, far along (1, 1, 0)."""
    pytest.importorskip("piqp" if solver == "auto" else solver)
    P = np.zeros((3, 3))
    P[:2, :2] = scale * np.array([[1.0, -1.0], [-1.0, 1.0 + 2.0**-power]])
    lb = [-np.inf, -np.inf, 1.0]
    answer = lv.solve_qp(P, [-scale, scale * (1.0 - 1e-6), 1.0], lb=lb, solver=solver)
    assert answer.solution.status is not lv.Status.UNBOUNDED


@pytest.mark.parametrize("solver", ["auto", "osqp", "newton", "pgs"])
@pytest.mark.parametrize("total", [1e9, 1e10, 1e12])
def test_rows_with_a_right_hand_side_of_0_hide_no_contradiction(solver, total):
    """x_0 = x_1, x_1 = x_2 and x_0 = x_2 + 1 contradict each other beside a large sum of x."""
    answer = lv.solve_qp(
        np.eye(3),
        np.zeros(3),
        A=[[1.0, -1.0, 0.0], [0.0, 1.0, -1.0], [1.0, 0.0, -1.0], [1.0, 1.0, 1.0]],
        b=[0.0, 0.0, 1.0, total],
        solver=solver,
    )
    assert not answer.found
    assert answer.solution.status is lv.Status.INFEASIBLE


@pytest.mark.parametrize("power", [20, 40, 50, 60])
@pytest.mark.parametrize("solver", ["auto", "clarabel", "piqp", "osqp"])
def test_program_without_a_feasible_point_is_not_unbounded(power, solver):
    """x_0 + x_1 = 0 and = 1 beside a connected sum of 2^power, and a cost that falls without end."""
    pytest.importorskip("piqp" if solver == "auto" else solver)
    A = [[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0]]
    problem = lv.Problem.from_qp(
        np.zeros((4, 4)), [0, 0, 0, -1.0], [[0, 0, 1.0, -1.0]], [0.0], A, [0.0, 1.0, 2.0**power]
    )
    for x in (None, [0.0, 0.0, 2.0**power, 2.0**power], [-(2.0**power), 2.0**power, 0.0, 0.0]):
        start = None if x is None else np.array(x)
        found = find_ray(get_program(problem.qp), start, deadline.NEVER)
        assert found is None or found[1] is None
    answer = lv.solve_qp(problem, solver)
    assert not answer.found
    assert answer.solution.status is not lv.Status.UNBOUNDED


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("solver", ["auto", "clarabel", "piqp", "osqp"])
def test_solution_0_of_rows_with_right_hand_sides_of_0_is_found(seed, solver):
    """All entries of a backend's x are rounding, in units of rows and variables of 2^-20 to 2^20."""
    pytest.importorskip("piqp" if solver == "auto" else solver)
    rng = np.random.default_rng(seed)
    n, m = rng.integers([2, 4], [6, 9])
    root, G = rng.integers(-2, 3, (n, n)), rng.integers(-3, 4, (m, n))
    z = rng.integers(0, 3, m) + (np.arange(m) == 0)
    units, sides = 2.0 ** rng.integers(-20, 21, n), 2.0 ** rng.integers(-20, 21, m)
    P = (root.T @ root) * np.outer(units, units)
    answer = lv.solve_qp(
        P, -(G.T @ z) * units, G * units * sides[:, None], np.zeros(m), solver=solver
    )
    assert answer.found


@pytest.mark.parametrize("solver", ["auto", "clarabel", "piqp", "newton"])
@pytest.mark.parametrize("seed", SEEDS)
def test_costs_have_no_part_in_a_proof_that_no_point_is_feasible(seed, solver):
    """A sum of rows contradicts another row; costs of some variables are 1e8 times those of others."""
    if solver in ("clarabel", "piqp"):
        pytest.importorskip(solver)
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    G, h = rng.integers(-3, 4, (n, n)), rng.integers(-20, 21, n)
    q = rng.integers(-9, 10, n) * 1e8 ** rng.integers(0, 2, n)
    rows, sides = np.vstack([G, -G.sum(axis=0)]), np.append(h, -h.sum() - 1)
    # A row without coefficients, which holds, may have any multiplier.
    answer = lv.solve_qp(np.eye(n), q, rows, sides, np.zeros((1, n)), [0.0], solver=solver)
    assert answer.solution.status is lv.Status.INFEASIBLE
    _, z, _ = answer.qp.multipliers(answer.solution.certificate)
    assert (z >= 0.0).all()
    assert z @ sides < 0.0
    assert np.abs(rows.T @ z).max() <= 2.0**-46 * (np.abs(rows).T @ z).max()  # Rounding of sums.
