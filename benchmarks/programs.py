"""QP backends on scaled copies of quadratic programs with exactly known solutions: `python -m benchmarks programs`.

Each base program has a solution in closed form or one that is verified in fractions: its KKT equations are solved
exactly for the active rows, and signs and slacks are compared with 0. The copies change the units of the cost, of rows
and of variables, and the size of the solution, by powers of two, so that one solution serves all copies.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from time import process_time
from typing import Any

import click
import numpy as np
import pandas as pd

import lavender as lv
from lavender.base.arrays import FloatArray

Arrays = dict[str, FloatArray]
BACKENDS = ("osqp", "clarabel", "piqp", "proxqp", "daqp", "quadprog", "highs", "scs")
COLUMNS = (
    "solves",
    "right and found",
    "wrong and found",
    "right, not found",
    "false INFEASIBLE or UNBOUNDED",
    "found differs from CONVERGED",
    "proved",
    "not proved",
    "contradicted",
)
ACCURACY = 1e-6  # Relative error of x, or of the cost, up to which an answer is right.


@dataclass(frozen=True)
class Base:
    """A program with its solution.

    Parameters
    ----------
    name : str
    arrays : mapping of str to array
        P, q, G, h, A, b, lb, ub.
    kind : {"x", "energy", "cost", "INFEASIBLE", "UNBOUNDED"}
        Quantity that is compared: x, x in the norm of P, or the cost if x is not unique; or the status.
    x : (n,) or None
    """

    name: str
    arrays: Arrays
    kind: str
    x: FloatArray | None = None


# -- exact solutions ---------------------------------------------------------------------------------


def list_rows(arrays: Arrays) -> tuple[list[list[Fraction]], list[Fraction], int]:
    """Return J, t and the number of equations of J x = t, J x >= t, as fractions."""
    n = len(arrays["q"])
    rows = []
    sides = []
    free = 0
    for matrix, side, sign in (("A", "b", 1), ("G", "h", -1)):
        if matrix in arrays:
            rows += [[sign * Fraction(float(v)) for v in row] for row in arrays[matrix]]
            sides += [sign * Fraction(float(v)) for v in arrays[side]]
            free = len(rows) if matrix == "A" else free
    for name, sign in (("lb", 1), ("ub", -1)):
        for j, bound in enumerate(arrays.get(name, [])):
            if np.isfinite(bound):
                rows.append([Fraction(sign * (i == j)) for i in range(n)])
                sides.append(sign * Fraction(float(bound)))
    return rows, sides, free


def solve_fractions(matrix: list[list[Fraction]], rhs: list[Fraction]) -> list[Fraction] | None:
    """Solve a square system exactly; None if it is singular."""
    rows = [[*row, value] for row, value in zip(matrix, rhs, strict=True)]
    for k in range(len(rows)):
        pivot = next((i for i in range(k, len(rows)) if rows[i][k]), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [v / rows[k][k] for v in rows[k]]
        for i, row in enumerate(rows):
            if i != k and row[k]:
                rows[i] = [a - row[k] * b for a, b in zip(row, rows[k], strict=True)]
    return [row[-1] for row in rows]


def solve_exactly(arrays: Arrays, active: list[int]) -> FloatArray | None:
    """Return x of the KKT equations with these active rows of `list_rows`, or None unless x is exactly optimal."""
    rows, sides, free = list_rows(arrays)
    active = [*range(free), *(i for i in active if i >= free)]
    n = len(arrays["q"])
    k = len(active)
    P = [[Fraction(float(v)) for v in row] for row in arrays["P"]]
    matrix = [[*P[j], *(-rows[i][j] for i in active)] for j in range(n)]
    matrix += [[*rows[i], *([Fraction(0)] * k)] for i in active]
    z = solve_fractions(
        matrix, [*(-Fraction(float(v)) for v in arrays["q"]), *(sides[i] for i in active)]
    )
    if z is None or any(z[n + a] < 0 for a, i in enumerate(active) if i >= free):
        return None
    slack = (
        sum(a * b for a, b in zip(rows[i], z, strict=False)) - sides[i]
        for i in range(free, len(rows))
    )
    return None if any(s < 0 for s in slack) else np.array([float(v) for v in z[:n]])


def find_solution(arrays: Arrays) -> FloatArray:
    """Return the exact solution, with the active rows of a solve that the fractions confirm."""
    answer = lv.solve_qp(lv.Problem.from_qp(**arrays), tol=1e-12)
    rows, sides, _ = list_rows(arrays)
    gaps = np.array(
        [
            float(sum(a * Fraction(float(v)) for a, v in zip(row, answer.x, strict=True)) - side)
            for row, side in zip(rows, sides, strict=True)
        ]
    )
    for near in (1e-12, 1e-9, 1e-7):
        x = solve_exactly(arrays, [int(i) for i in np.flatnonzero(np.abs(gaps) <= near)])
        if x is not None:
            return x
    raise ValueError("the active rows of the program are degenerate; another seed is needed")


# -- base programs -----------------------------------------------------------------------------------


def round_to_eighths(x: Any) -> FloatArray:
    """Round numbers to multiples of 1/8, so that sums of a few of them are exact."""
    return np.round(8.0 * np.asarray(x)) / 8.0


def list_programs(seed: int) -> Iterator[Base]:
    """Yield 14 solvable programs, and two that are not, drawn with this seed."""
    rng = np.random.default_rng(seed)
    n = 6
    y = round_to_eighths(2.0 * rng.normal(size=n))
    # Projection to the simplex: x = max(y - level, 0) with the level of its largest entries.
    order = sorted((Fraction(float(v)) for v in y), reverse=True)
    level = next(
        (sum(order[:k]) - 1) / k for k in range(n, 0, -1) if order[k - 1] > (sum(order[:k]) - 1) / k
    )
    x = np.array([float(max(Fraction(float(v)) - level, Fraction(0))) for v in y])
    simplex = {"A": np.ones((1, n)), "b": np.ones(1), "lb": np.zeros(n)}
    yield Base("simplex", {"P": np.eye(n), "q": -y, **simplex}, "x", x)
    # Isotonic regression: pools of adjacent violators have their weighted mean.
    weight = rng.integers(1, 5, n)
    pools = list[list[Any]]()
    for value, w in zip(y, weight, strict=True):
        pools.append([Fraction(float(value)), int(w), 1])
        while len(pools) > 1 and pools[-2][0] >= pools[-1][0]:
            mean, w2, count = pools.pop()
            first = pools[-1]
            first[0] = (first[0] * first[1] + mean * w2) / (first[1] + w2)
            first[1], first[2] = first[1] + w2, first[2] + count
    x = np.concatenate([[float(mean)] * count for mean, _, count in pools])
    rows = {"G": np.eye(n - 1, n) - np.eye(n - 1, n, 1), "h": np.zeros(n - 1)}
    yield Base("isotonic", {"P": np.diag(weight.astype(float)), "q": -weight * y, **rows}, "x", x)
    # Fractional knapsack: the items of the largest value per weight, until the capacity is used.
    value = rng.permutation(np.arange(3.0, 3.0 + n))
    weight = rng.integers(1, 4, n)
    value = value + 2.0**-10 * np.arange(n)  # no two ratios are equal
    order_of_ratios = np.argsort(-value / weight)
    x = np.zeros(n)
    left = Fraction(int(weight.sum()), 2)
    for j in order_of_ratios:
        share = min(Fraction(1), left / int(weight[j]))
        x[j] = float(share)
        left = left - share * int(weight[j])
    rows = {
        "G": weight[None].astype(float),
        "h": np.array([weight.sum() / 2.0]),
        "lb": np.zeros(n),
        "ub": np.ones(n),
    }
    yield Base("knapsack", {"P": np.zeros((n, n)), "q": -value, **rows}, "x", x)
    # Water filling: sum of d x^2 / 2 + c x with a fixed sum and x >= 0.
    d = rng.integers(1, 9, n).astype(float)
    c = round_to_eighths(rng.uniform(0.0, 4.0, n))
    rows = {"A": np.ones((1, n)), "b": np.array([2.0]), "lb": np.zeros(n)}
    yield make_verified("water filling", {"P": np.diag(d), "q": c, **rows})
    # Median: the sum of |x - y_i| is smallest at the middle one of an odd number of points.
    points = rng.permutation(np.arange(1.0, 6.0)) + round_to_eighths(rng.random(5) * 0.5)
    ones = np.ones((5, 1))
    eye = np.eye(5)
    x = np.concatenate([[np.median(points)], np.abs(points - np.median(points))])
    rows = {"G": np.block([[ones, -eye], [-ones, -eye]]), "h": np.concatenate([points, -points])}
    yield Base(
        "median", {"P": np.zeros((6, 6)), "q": np.array([0.0, 1, 1, 1, 1, 1]), **rows}, "x", x
    )
    # Violation that is shared by two contradictory rows: x >= 1 - s, x <= -1 + s has s = 1, x = 0.
    side = float(rng.integers(1, 5))
    rows = {
        "G": np.array([[-1.0, -1.0], [1.0, -1.0]]),
        "h": np.array([-side, -side]),
        "lb": np.array([-np.inf, 0.0]),
    }
    arrays = {"P": np.diag([0.0, 2.0]), "q": np.zeros(2), **rows}
    yield Base("contradiction, softened", arrays, "x", np.array([0.0, side]))
    # Points inside of rows, without a cost and as the first phase of a method.
    G = round_to_eighths(rng.normal(size=(8, 4)))
    inside = round_to_eighths(rng.normal(size=4))
    h = G @ inside + rng.integers(1, 9, 8) / 8.0
    low, high = np.full(4, -16.0), np.full(4, 16.0)
    arrays = {"P": np.zeros((4, 4)), "q": np.zeros(4), "G": G, "h": h, "lb": low, "ub": high}
    yield Base("feasibility", arrays, "cost", inside)
    wide = {
        "G": np.hstack([G, -np.ones((8, 1))]),
        "h": h,
        "lb": np.r_[low, 0.0],
        "ub": np.r_[high, np.inf],
    }
    last = np.r_[np.zeros(4), 1.0]
    yield Base(
        "first phase", {"P": np.zeros((5, 5)), "q": last, **wide}, "cost", np.r_[inside, 0.0]
    )
    # Obstacle: a string above supports, in variables of the string.
    string = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    supports = round_to_eighths(-1.5 * rng.random(n))
    yield make_verified("obstacle", {"P": string, "q": np.full(n, 0.5), "lb": supports})
    # Random programs: definite, of rank 3, of condition 1e8; with placeholder bounds.
    root, point, G = (round_to_eighths(rng.normal(size=s)) for s in ((5, 5), 5, (7, 5)))
    z = np.where(np.arange(7) < 2, rng.integers(1, 9, 7) / 4.0, 0.0)
    h = G @ point + np.where(z > 0.0, 0.0, rng.integers(1, 9, 7) / 8.0)
    limit = 2.0**30 if seed % 2 else 32.0
    far = {"lb": np.full(5, -limit), "ub": np.full(5, limit)}
    scale = 2.0 ** -np.array([0.0, 3.0, 6.0, 10.0, 13.0])
    for name, P, kind in (
        ("definite", root @ root.T + np.eye(5), "x"),
        ("rank 3", root[:, :3] @ root[:, :3].T, "x"),
        ("condition 1e8", (scale[:, None] * (root @ root.T + np.eye(5)) * scale), "energy"),
    ):
        q = -(P @ point) - G.T @ z
        yield make_verified(name, {"P": P, "q": q, "G": G, "h": h, **far}, kind)
    # A controller of a mass: position, velocity and a bounded force over five steps.
    steps = 5
    A = np.zeros((10, 15))
    b = np.zeros(10)
    for k in range(steps):
        A[2 * k : 2 * k + 2, 3 * k : 3 * k + 2] = np.eye(2)
        A[2 * k : 2 * k + 2, 3 * k + 2] = [-0.03125, -0.25]
        if k:
            A[2 * k : 2 * k + 2, 3 * k - 3 : 3 * k - 1] = [[-1.0, -0.25], [0.0, -1.0]]
    b[:2] = [1.0 + 0.5 * (seed % 3), 0.5]
    bounds = {
        "lb": np.tile([-np.inf, -np.inf, -1.5], steps),
        "ub": np.tile([np.inf, np.inf, 1.5], steps),
    }
    P = np.kron(np.eye(steps), np.diag([8.0, 1.0, 0.125]))
    yield make_verified("controller", {"P": P, "q": np.zeros(15), "A": A, "b": b, **bounds})
    # A stack of two boxes with repeated contacts, as impulses: only the velocities are unique.
    J = np.array([[1.0, 0.0], [-1.0, 1.0], [1.0, 0.0]])
    mass = np.array([1.0, 2.0 ** rng.integers(0, 8)])
    A = (J / mass) @ J.T
    impulses = (
        np.array([mass.sum(), mass[1], 0.0]) / 128.0
    )  # N s; gravity changes velocities by 1/128 m/s
    yield Base(
        "stack", {"P": A, "q": J @ np.full(2, -1.0 / 128.0), "lb": np.zeros(3)}, "cost", impulses
    )
    # Programs without a solution.
    w = round_to_eighths(rng.normal(size=3)) + 0.125
    rows = {"G": np.vstack([w, -w, np.eye(3)[:1]]), "h": np.array([2.5, -3.5, 1.0])}
    q = 10.0 ** rng.integers(0, 5) * rng.normal(size=3)
    yield Base("contradictory rows", {"P": np.eye(3), "q": q, **rows}, "INFEASIBLE")
    rows = {"G": np.array([[0.0, 1.0, -1.0]]), "h": np.ones(1), "lb": np.zeros(3)}
    q = np.array([0.25, -1.0, -float(rng.integers(1, 5))])
    yield Base("ray", {"P": np.diag([1.0, 0.0, 0.0]), "q": q, **rows}, "UNBOUNDED")


def make_verified(name: str, arrays: Arrays, kind: str = "x") -> Base:
    """Return a program with the solution that fractions confirm."""
    return Base(name, arrays, kind, find_solution(arrays))


# -- copies ------------------------------------------------------------------------------------------


def list_copies(
    arrays: Arrays, seed: int
) -> Iterator[tuple[str, Arrays, Callable[[FloatArray], FloatArray]]]:
    """Yield 13 copies of a program in other units: name, arrays, and the conversion of their x to the base's."""
    rng = np.random.default_rng(seed)
    n = len(arrays["q"])
    one = np.ones(n)
    mixed = 2.0 ** rng.integers(-13, 14, n)
    rows_mixed = 2.0 ** rng.integers(-13, 14, 64)
    for name, cost, rows, units, size in (
        ("as is", 0, 1.0, one, 0),
        ("cost 1e-10", -33, 1.0, one, 0),
        ("cost 1e-6", -20, 1.0, one, 0),
        ("cost 1e6", 20, 1.0, one, 0),
        ("cost 1e10", 33, 1.0, one, 0),
        ("rows 1e-8", 0, 2.0**-27, one, 0),
        ("rows 1e8", 0, 2.0**27, one, 0),
        ("rows mixed", 0, rows_mixed, one, 0),
        ("variables 1e-4", 0, 1.0, one * 2.0**-13, 0),
        ("variables 1e4", 0, 1.0, one * 2.0**13, 0),
        ("variables mixed", 0, 1.0, mixed, 0),
        ("size 1e-8", 0, 1.0, one, -27),
        ("size 1e6", 0, 1.0, one, 20),
    ):
        c, s = 2.0**cost, 2.0**size
        copy = {"P": c * units[:, None] * arrays["P"] * units, "q": c * s * units * arrays["q"]}
        for matrix, side in (("A", "b"), ("G", "h")):
            if matrix in arrays:
                e = np.broadcast_to(rows, 64)[: len(arrays[side])]
                copy[matrix] = e[:, None] * arrays[matrix] * units
                copy[side] = e * s * arrays[side]
        copy |= {bound: s * arrays[bound] / units for bound in ("lb", "ub") if bound in arrays}
        yield name, copy, lambda x, units=units, s=s: x * units / s  # type: ignore[misc]


def is_right(base: Base, x: FloatArray) -> bool:
    """Return whether x (n,), in the units of the base program, solves it to ACCURACY."""
    assert base.x is not None
    if not np.isfinite(x).all():
        return False
    P, q = base.arrays["P"].astype(np.longdouble), base.arrays["q"].astype(np.longdouble)
    rows, sides, free = list_rows(base.arrays)
    size = np.abs(base.x).max()
    for i, (row, side) in enumerate(zip(rows, sides, strict=True)):
        gap = sum(a * Fraction(float(v)) for a, v in zip(row, x, strict=True)) - side
        terms = sum(
            abs(float(a)) * max(abs(v), 1e-3 * size) for a, v in zip(row, base.x, strict=True)
        )
        if (abs(gap) if i < free else -gap) > ACCURACY * terms:
            return False
    if base.kind == "x":
        return bool(np.abs(x - base.x).max() <= ACCURACY * size)
    if base.kind == "energy":
        return bool((x - base.x) @ P @ (x - base.x) <= ACCURACY**2 * (base.x @ P @ base.x))
    costs = [0.5 * v @ P @ v + q @ v for v in (x, base.x)]
    size = np.abs(base.x)
    terms = max(size @ np.abs(P) @ size, np.abs(q) @ size, np.abs(P).max(), np.abs(q).max())
    return bool(abs(costs[0] - costs[1]) <= ACCURACY * terms)


def judge_answer(base: Base, answer: Any, convert: Callable[[FloatArray], FloatArray]) -> str:
    """Return the column of the table to which an answer belongs, except for conflicts of its fields."""
    status = answer.solution.status.name
    if base.x is None:
        return (
            "proved" if status == base.kind else "wrong and found" if answer.found else "not proved"
        )
    if status in ("INFEASIBLE", "UNBOUNDED"):
        return "false INFEASIBLE or UNBOUNDED"
    right = is_right(base, convert(answer.x))
    if answer.found:
        return "right and found" if right else "wrong and found"
    return "right, not found" if right else "lost"


def run_backend(name: str, bases: list[Base], tol: float = 1e-6) -> tuple[Counter[str], list[str]]:
    """Solve all copies of the programs by one backend; return the counts of `COLUMNS`, CPU time [s] and failures."""
    counts = Counter[str]()
    failures = []
    for seed, base in enumerate(bases):
        for copy_name, arrays, convert in list_copies(base.arrays, seed):
            begun = process_time()
            answer = lv.solve_qp(lv.Problem.from_qp(**arrays), name, tol=tol)
            counts["CPU time [ms]"] += round(1e3 * (process_time() - begun))
            column = judge_answer(base, answer, convert)
            counts["solves"] += base.x is not None
            counts[column] += 1
            is_converged = answer.solution.status is lv.Status.CONVERGED
            counts["found differs from CONVERGED"] += (
                not answer.found == is_converged == (answer.error <= tol)
            )
            counts["contradicted"] += (
                answer.solution.claim_check == "contradicted" and column == "right and found"
            )
            if column not in ("right and found", "proved"):
                failures.append(f"{name}: {base.name}, {copy_name}: {column}, {answer}")
    return counts, failures


@click.command("programs")
@click.option(
    "--seeds",
    default=2,
    show_default=True,
    help="Number of seeds; each draws 14 programs with a solution.",
)
@click.option("--first", default=0, show_default=True, help="First seed.")
@click.option(
    "--backend",
    "backends",
    multiple=True,
    help="Name of a backend; default: eight that are installed.",
)
@click.option("--list", "shows_failures", is_flag=True, help="List the answers that are not right.")
def command(seeds: int, first: int, backends: tuple[str, ...], shows_failures: bool) -> None:
    """Count right, wrong and lost answers of QP backends on scaled copies of programs with a known solution."""
    warnings.simplefilter("ignore")
    bases = [base for seed in range(first, first + seeds) for base in list_programs(seed)]
    installed = lv.available(lv.Problem.from_qp(np.eye(1), [1.0]))
    table = {}
    failures = list[str]()
    for name in backends or [name for name in BACKENDS if name in installed]:
        table[name], failed = run_backend(name, bases)
        failures += failed
    frame = pd.DataFrame(table).reindex([*COLUMNS, "CPU time [ms]"]).fillna(0).astype(int)
    frame["all"] = frame.sum(axis=1)
    click.echo(frame.to_string())
    if shows_failures:
        click.echo("\n".join(failures))
