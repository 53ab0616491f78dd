"""Programs that mean the same have the same answer, and an answer is a proof: properties that need no cases."""

import re

import numpy as np
import pytest
import scipy.sparse as sp
from calls import installed

import lavender as lv

BACKENDS = [
    "auto",
    "admm",
    *installed("clarabel", "osqp", "daqp", "piqp", "quadprog", "highs", "proxqp", "scs"),
]
FAST = ["auto", *installed("clarabel", "daqp")]
VECTORS = ("q", "h", "b", "lb", "ub")


def draw_program(seed, n=7, rows=9, equations=2):
    """Draw a strictly convex program with a feasible point inside its inequalities, some variables without bounds."""
    rng = np.random.default_rng(seed)
    half, inside = rng.normal(size=(n, n)), rng.normal(size=n)
    g, a = rng.normal(size=(rows, n)), rng.normal(size=(equations, n))
    lb, ub = inside - rng.uniform(0.05, 1.0, n), inside + rng.uniform(0.05, 1.0, n)
    lb[rng.random(n) < 0.4], ub[rng.random(n) < 0.4] = -np.inf, np.inf
    return {
        "P": half @ half.T + 0.1 * np.eye(n), "q": 5.0 * rng.normal(size=n), "G": g,
        "h": g @ inside + rng.uniform(0.01, 1.0, rows), "A": a, "b": a @ inside, "lb": lb, "ub": ub,
    }  # fmt: skip


def check_conditions(p, answer, tol):
    """The conditions of an optimum by NumPy, each over the terms of its row or column (docs/residual.md)."""
    x, y, z, box = answer.x, answer.y, answer.z, answer.z_box
    assert answer.found, str(answer)
    G, A = (np.asarray(p[name]) for name in ("G", "A"))
    size = np.abs(G) @ np.abs(x) + np.abs(np.where(np.isfinite(p["h"]), p["h"], 0.0))
    slack = p["h"] - G @ x
    assert (slack >= -4.0 * tol * size).all()
    assert (np.abs(A @ x - p["b"]) <= 4.0 * tol * (np.abs(A) @ np.abs(x) + np.abs(p["b"]))).all()
    assert (x >= p["lb"]).all() and (x <= p["ub"]).all()
    # Multipliers are a proof: of one sign exactly, and zero where a row does not hold the point.
    with np.errstate(invalid="ignore"):
        is_above, is_below = (
            x - p["lb"] > 1e-3 * np.abs(p["lb"]),
            p["ub"] - x > 1e-3 * np.abs(p["ub"]),
        )
    is_above |= np.isinf(p["lb"])
    is_below |= np.isinf(p["ub"])
    assert (z >= 0.0).all() and (box[is_above] >= 0.0).all() and (box[is_below] <= 0.0).all()
    column = p["P"] @ x + p["q"] + G.T @ z + A.T @ y + box
    cost = np.abs(p["P"]) @ np.abs(x) + np.abs(p["q"])
    pull = np.abs(G.T) @ z + np.abs(A.T) @ np.abs(y) + np.abs(box)
    assert (np.abs(column) <= 4.0 * tol * np.maximum(cost, 2.0**-43 * (cost + pull))).all()
    terms = cost @ np.abs(x) + z @ size
    assert z @ np.abs(np.where(np.isfinite(slack), slack, 0.0)) <= 4.0 * tol * terms


@pytest.mark.parametrize("tol", [1e-4, 1e-7])
@pytest.mark.parametrize("solver", BACKENDS)
def test_found_answers_meet_the_conditions_of_an_optimum(solver, tol):
    """For every backend: multipliers are not negative, belong to rows that hold the point, and balance the cost."""
    found = 0
    for seed in range(10):
        p = draw_program(seed)
        answer = lv.solve_qp(**p, solver=solver, tol=tol)
        if answer.found:
            check_conditions(p, answer, tol)
        found += answer.found
    assert found >= 8


@pytest.mark.parametrize("solver", FAST)
def test_placeholder_bounds_are_no_bounds(solver):
    """1e20 and more stand for infinity in bounds and in h, as with the backends: the same bits as without them."""
    for seed in range(6):
        p = draw_program(seed)
        expected = lv.solve_qp(**p, solver=solver)
        for size in (1e20, 1e25, 1e300):
            other = p | {"lb": np.maximum(p["lb"], -size), "ub": np.minimum(p["ub"], size)}
            answer = lv.solve_qp(**other, solver=solver)
            assert (
                answer.x.tobytes() == expected.x.tobytes()
                and answer.z_box.tobytes() == expected.z_box.tobytes()
            )
            rows = len(lv.Problem.from_qp(**other).qp.target)
            assert rows == len(lv.Problem.from_qp(**p).qp.target)
            more = p | {"G": np.vstack([p["G"][:1], p["G"]]), "h": np.concatenate([[size], p["h"]])}
            answer = lv.solve_qp(**more, solver=solver)
            assert answer.x.tobytes() == expected.x.tobytes()
            assert answer.z.tolist() == [0.0, *expected.z.tolist()]
    without = {name: value for name, value in p.items() if name not in ("lb", "ub")}
    none = lv.solve_qp(**without, solver=solver)
    infinite = lv.solve_qp(**without, lb=np.full(7, -1e21), ub=np.full(7, 1e21), solver=solver)
    assert none.x.tobytes() == infinite.x.tobytes()


@pytest.mark.parametrize("solver", FAST)
def test_bounds_that_are_equal_up_to_rounding_are_an_equation(solver):
    for seed in range(6):
        p = draw_program(seed, equations=1)
        value = float(p["b"][0]) + 0.3
        fixed = np.array([True] + 6 * [False])
        found = []
        for low, high in (
            (value, value),
            (value, np.nextafter(value, np.inf)),
            (np.nextafter(value, -np.inf), value),
        ):
            other = p | {
                "lb": np.where(fixed, low, p["lb"]),
                "ub": np.where(fixed, high, p["ub"]),
                "h": p["h"] + 50.0,
            }
            answer = lv.solve_qp(**other, solver=solver)
            assert answer.found and low <= answer.x[0] <= high
            found.append(answer.x)
        np.testing.assert_allclose(found[1:], [found[0]] * 2, atol=1e-6)


@pytest.mark.parametrize("solver", FAST)
@pytest.mark.parametrize("shift", [1e3, 1e6])
def test_shifted_variables_have_the_shifted_optimum(solver, shift):
    """x' = x + s: the terms of each row are larger by s, and so is what tol permits; the answer stays a proof."""
    for seed in range(6):
        p = draw_program(seed)
        s = shift * np.random.default_rng(seed).choice([-1.0, 1.0], 7)
        other = p | {
            "q": p["q"] - p["P"] @ s, "h": p["h"] + p["G"] @ s, "b": p["b"] + p["A"] @ s, "lb": p["lb"] + s,
            "ub": p["ub"] + s,
        }  # fmt: skip
        expected = lv.solve_qp(**p, solver=solver, tol=1e-9)
        answer = lv.solve_qp(**other, solver=solver, tol=1e-9)
        if answer.found:
            check_conditions(other, answer, 1e-9)
            # 2e3: the condition of the small programs drawn here, from a perturbation of the data to x.
            np.testing.assert_allclose(answer.x - s, expected.x, atol=2e3 * 1e-9 * shift)
        else:
            assert answer.solution.status not in (lv.Status.INFEASIBLE, lv.Status.UNBOUNDED)


@pytest.mark.parametrize("solver", FAST)
def test_units_of_rows_variables_and_cost_change_nothing(solver):
    for seed in range(6):
        rng = np.random.default_rng(seed)
        p = draw_program(seed)
        unit, row, line = (2.0 ** rng.integers(-12, 13, n) for n in (7, 9, 2))
        for cost in (2.0**-30, 1.0, 2.0**30):
            other = {
                "P": cost * p["P"] * np.outer(unit, unit), "q": cost * p["q"] * unit, "G": row[:, None] * p["G"] * unit,
                "h": row * p["h"], "A": line[:, None] * p["A"] * unit, "b": line * p["b"], "lb": p["lb"] / unit,
                "ub": p["ub"] / unit,
            }  # fmt: skip
            expected = lv.solve_qp(**p, solver=solver, tol=1e-8)
            answer = lv.solve_qp(**other, solver=solver, tol=1e-8)
            check_conditions(other, answer, 1e-8)
            np.testing.assert_allclose(unit * answer.x, expected.x, atol=1e-5)
            np.testing.assert_allclose(answer.z * row / cost, expected.z, atol=1e-4)


@pytest.mark.parametrize("solver", FAST)
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e8])
def test_independent_block_changes_no_answer(solver, size):
    """A second program beside the first, of any size, neither moves it nor hides its errors."""
    for seed in range(5):
        p, q = draw_program(seed), draw_program(seed + 50, n=4, rows=3, equations=1)
        q = q | {name: size * q[name] for name in ("h", "b", "lb", "ub")} | {"q": size * q["q"]}
        both = {name: sp.block_diag([p[name], q[name]]).toarray() for name in ("P", "G", "A")}
        both |= {name: np.concatenate([p[name], q[name]]) for name in VECTORS}
        alone, answer = (lv.solve_qp(**x, solver=solver, tol=1e-8) for x in (p, both))
        if answer.found:
            check_conditions(both, answer, 1e-8)
            part = lv.solve_qp(**p, solver=solver, tol=1e-8, initvals=None)
            check_conditions(p, part, 1e-8)
            np.testing.assert_allclose(answer.x[:7], alone.x, atol=1e-5)
        else:
            assert answer.solution.status not in (lv.Status.INFEASIBLE, lv.Status.UNBOUNDED)


@pytest.mark.parametrize("solver", ["auto", "admm", *installed("clarabel", "osqp", "daqp")])
@pytest.mark.parametrize("factor", [1e-8, 1.0, 1e8])
def test_another_right_hand_side_of_one_problem_has_the_bits_of_a_new_program(solver, factor):
    """q, h and b are replaced in a problem that was solved before: nothing derived from the old ones is kept."""
    for seed in range(5):
        p, other = draw_program(seed), draw_program(seed)
        rng = np.random.default_rng(seed + 9)
        changes = {"q": factor * rng.normal(size=7), "h": p["h"] + rng.uniform(0.0, 0.2, 9)}
        other |= changes
        problem = lv.Problem.from_qp(**p)
        lv.solve_qp(problem, solver=solver, tol=1e-7)
        answer = lv.solve_qp(problem, changes["q"], h=changes["h"], solver=solver, tol=1e-7)
        expected = lv.solve_qp(**other, solver=solver, tol=1e-7)
        for name in ("x", "y", "z", "z_box"):
            assert getattr(answer, name).tobytes() == getattr(expected, name).tobytes(), name
        assert (answer.error, answer.found) == (expected.error, expected.found)


def list_named_rows(message):
    return [(name, int(i)) for name, i in re.findall(r"\b(G|A|lb|ub)\[(\d+)\]", message)]


def keep_rows(p, named, keeps):
    """Return the program with only the named rows and bounds, or without them."""
    out = dict(p)
    for matrix, side in (("G", "h"), ("A", "b")):
        chosen = np.array([((matrix, i) in named) == keeps for i in range(len(p[side]))], bool)
        out[matrix], out[side] = p[matrix][chosen], p[side][chosen]
    for bound, none in (("lb", -np.inf), ("ub", np.inf)):
        out[bound] = np.array(
            [x if ((bound, i) in named) == keeps else none for i, x in enumerate(p[bound])]
        )
    return {name: value for name, value in out.items() if np.size(value)}


@pytest.mark.parametrize("solver", ["auto", *installed("clarabel", "highs")])
@pytest.mark.parametrize("kind", ["rows", "row and bounds", "equations"])
def test_named_rows_of_a_program_without_solution_are_the_reason(solver, kind):
    """Alone they contradict each other, and without them there is a solution; rows without a limit come before them."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        p = draw_program(seed, n=4, rows=2, equations=1)
        p["lb"][2:], p["ub"][2:] = -np.inf, np.inf  # The message names up to eight rows.
        direction = rng.normal(size=4)
        if kind == "row and bounds":
            direction = np.array([1.0, 1.0, 0.0, 0.0])
            p["lb"][:2], p["ub"][:2] = -0.2, np.inf
        free = np.vstack([rng.normal(size=(2, 4)), p["G"]])
        h = np.concatenate([[np.inf, 1e20], p["h"]])
        if kind == "equations":
            p["A"], p["b"] = (
                np.vstack([p["A"], direction, 2.0 * direction]),
                np.append(p["b"], [1.0, 2.5]),
            )
            p["G"], p["h"] = free, h
        else:
            against = [direction, -direction][: 1 if kind == "row and bounds" else 2]
            p["G"] = np.vstack([free[:3], *against, free[3:]])
            p["h"] = np.concatenate([h[:3], [-1.0] * len(against), h[3:]])
        answer = lv.solve_qp(**p, solver=solver)
        assert answer.solution.status is lv.Status.INFEASIBLE, str(answer)
        message = answer.solution.message.rpartition("rows: ")[2]
        named = list_named_rows(message)
        assert named and " more" not in message, message
        alone = lv.solve_qp(**keep_rows(p, named, True), solver=solver)
        assert alone.solution.status is lv.Status.INFEASIBLE, (named, str(alone))
        others = lv.solve_qp(**keep_rows(p, named, False), solver=solver)
        assert others.found, (named, str(others))


@pytest.mark.parametrize("solver", installed("clarabel", "daqp", "piqp", "quadprog"))
@pytest.mark.parametrize("size", [1e2, 1e8])
def test_equations_far_from_zero_take_one_call(solver, size):
    """Rows that hold by far at x = 0 may be left out at first, but no equation of either sign."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        a, b = rng.normal(size=(2, 6)), np.array([size, -size])
        answer = lv.solve_qp(np.eye(6), np.zeros(6), A=a, b=b, solver=solver, tol=1e-6)
        np.testing.assert_allclose(answer.x, a.T @ np.linalg.solve(a @ a.T, b), rtol=1e-5)
        assert answer.solution.work["backend_calls"] == 1
