"""Times of QP solvers on programs of several sizes and structures: `python -m benchmarks backends --out FILE.json`.

Each program is drawn with a feasible point, so that it has a solution. `lavender.solve_qp` solves it by each solver to
an error of 1e-9, in CPU time of one thread, in turn with the others; each backend also solves it alone, by qpsolvers
with the backend's default settings, and its x is compared with an answer that was found. A solver with a median above
`MAX_TIME` is left out of the larger programs of a structure, and solvers on dense matrices of programs above
`MAX_DENSE` variables.
"""

from __future__ import annotations

import math
import runpy
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import qpsolvers
import scipy.sparse as sp

import lavender as lv
from benchmarks.output import out_option, write_json

BACKENDS = ("daqp", "quadprog", "piqp", "clarabel", "osqp", "highs", "scs")
SOLVERS = ("auto", "newton", *BACKENDS)
DENSE = ("daqp", "quadprog")
MAX_DENSE = 1000
MAX_TIME = 0.2  # [s]
SEEDS = range(3)
REPEATS = 3
MAX_REPEATED_TIME = 0.3  # [s] Solves that took longer are not repeated.


def draw_dense(n: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a dense program: n inequalities, and n // 10 equations."""
    root = rng.normal(size=(n, n)) / math.sqrt(n)
    G, A = rng.normal(size=(n, n)), rng.normal(size=(n // 10, n))
    x = rng.normal(size=n)
    h = G @ x + rng.uniform(0.0, 1.0, n) * math.sqrt(n)
    arrays = {"P": root @ root.T + 0.1 * np.eye(n), "q": 3.0 * rng.normal(size=n), "G": G, "h": h}
    return arrays | ({"A": A, "b": A @ x} if n >= 10 else {})


def draw_least_squares(n: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a dense program with a P of rank n / 2, and bounds."""
    root = rng.normal(size=(n, n // 2)) / math.sqrt(n)
    G = rng.normal(size=(n // 2, n))
    h = G @ rng.uniform(-1.0, 1.0, n) + 0.1
    return {
        "P": root @ root.T,
        "q": rng.normal(size=n),
        "G": G,
        "h": h,
        "lb": -np.ones(n),
        "ub": np.ones(n),
    }


def draw_bounds(n: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a sparse program with bounds alone: a chain of springs, pressed against walls."""
    P = sp.diags(
        [np.full(n, 2.01), np.full(n - 1, -1.0), np.full(n - 1, -1.0)], [0, 1, -1], format="csc"
    )
    return {"P": P, "q": rng.normal(size=n), "lb": -0.5 * np.ones(n), "ub": 0.5 * np.ones(n)}


def draw_sparse(n: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a sparse program: n inequalities of four entries each, a diagonal P."""
    columns = rng.integers(0, n, size=(n, 4))
    G = sp.csc_matrix(
        (rng.normal(size=4 * n), (np.repeat(np.arange(n), 4), columns.ravel())), shape=(n, n)
    )
    h = G @ rng.normal(size=n) + rng.uniform(0.0, 1.0, n)
    return {
        "P": sp.diags(rng.uniform(0.5, 2.0, n), format="csc"),
        "q": 3.0 * rng.normal(size=n),
        "G": G,
        "h": h,
    }


def draw_linear(n: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a linear program with n inequalities and bounds."""
    G = rng.normal(size=(n, n))
    h = G @ rng.uniform(-1.0, 1.0, n) + 0.5
    return {"P": None, "q": rng.normal(size=n), "G": G, "h": h, "lb": -np.ones(n), "ub": np.ones(n)}


def draw_control(n: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return a program of predictive control with n variables, that of examples/control_program.py."""
    path = Path(__file__).resolve().parent.parent / "examples" / "control_program.py"
    make_program = runpy.run_path(str(path))["make_program"]
    P, q, A, b, lb, ub = make_program(n // 16, seed=int(rng.integers(1000)))
    return {"P": P, "q": q, "A": A, "b": b, "lb": lb, "ub": ub}


#: Name -> the function that draws a program, and its numbers of variables.
STRUCTURES: dict[
    str, tuple[Callable[[int, np.random.Generator], dict[str, Any]], tuple[int, ...]]
] = {
    "dense": (draw_dense, (5, 30, 100, 300)),
    "dense, singular P": (draw_least_squares, (40,)),
    "linear": (draw_linear, (30, 100)),
    "bounds, sparse": (draw_bounds, (300, 1000)),
    "sparse": (draw_sparse, (300, 1000)),
    "control": (draw_control, (160, 1600)),
}


def convert(arrays: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays for qpsolvers, which needs a P."""
    n = len(arrays["q"])
    return {**arrays, "P": sp.csc_matrix((n, n)) if arrays["P"] is None else arrays["P"]}


def solve_alone(arrays: dict[str, Any], name: str) -> Any:
    """Return x of a backend with its default settings, or None."""
    try:
        return qpsolvers.solve_qp(**convert(arrays), solver=name)
    except (
        Exception
    ):  # Backends raise exceptions of many kinds for programs that they do not accept.
        return None


def solve_here(arrays: dict[str, Any], name: str) -> Any:
    """Return the answer of `solve_qp`, or None if the solver does not accept the program."""
    try:
        return lv.solve_qp(**arrays, solver=name)
    except lv.CapabilityError:
        return None


def measure(arrays: dict[str, Any], solvers: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield a line for each solver: found, CPU time [s], and the relative difference of x of the backend alone."""
    best: dict[str, float] = {}
    answers: dict[str, Any] = {}
    for _ in range(REPEATS):
        for name in solvers:
            if best.get(name, 0.0) > MAX_REPEATED_TIME or (
                name in answers and answers[name] is None
            ):
                continue
            begin = time.process_time()
            answers[name] = solve_here(arrays, name)
            best[name] = min(best.get(name, math.inf), time.process_time() - begin)
    reference = next((a.x for a in answers.values() if a is not None and a.found), None)
    for name, answer in answers.items():
        line = {"solver": name, "accepted": answer is not None}
        line |= {"found": answer is not None and answer.found, "time": best[name], "alone": None}
        if name in BACKENDS and reference is not None:
            x = solve_alone(arrays, name)
            if x is not None and np.isfinite(x).all():
                line["alone"] = float(np.abs(x - reference).max() / np.abs(reference).max())
        yield line


@click.command()
@out_option("File of the records (JSON).")
def command(out: Path | None) -> None:
    """Measure QP solvers by size and structure, one thread; docs/generate.py makes the table of the page."""
    lines = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for structure, (draw, sizes) in STRUCTURES.items():
            solvers = list(SOLVERS)
            for n in sizes:
                if n > MAX_DENSE:
                    solvers = [name for name in solvers if name not in DENSE]
                for seed in SEEDS:
                    arrays = draw(n, np.random.default_rng(seed))
                    for line in measure(arrays, solvers):
                        lines.append({"structure": structure, "n": n, "seed": seed, **line})
                times = {
                    name: float(
                        np.median(
                            [
                                x["time"]
                                for x in lines[-len(SEEDS) * len(solvers) :]
                                if x["solver"] == name
                            ]
                        )
                    )
                    for name in solvers
                }
                click.echo(
                    f"{structure} {n}: "
                    + ", ".join(f"{k} {1e3 * t:.2g} ms" for k, t in times.items())
                )
                solvers = [name for name in solvers if times[name] <= MAX_TIME]
    if out is not None:
        write_json(out, lines)
