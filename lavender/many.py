"""Many problems in one call: the results of `solve` on each, with the same bits.

Problems in generalised coordinates go through one compiled loop without the interpreter, those of few rows each through
its own compiled call; what that leaves, and every other problem, is solved one by one. Solutions are put in words when
somebody asks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.registry import SolverSpec, get
from lavender.solution import Solution
from lavender.solve import decide_empty_rows, late, solve, solve_few
from lavender.solvers._costs import general_first
from lavender.solvers._few import FEW_GENERAL
from lavender.solvers._newton import general

__all__ = ["solve_many"]


def solve_many(
    problems: Iterable[Problem],
    solver: str = "auto",
    *,
    impulses: Sequence[Any] | None = None,
    threads: int = 1,
    tol: float = 1e-6,
    max_iter: int | None = None,
    **options: Any,
) -> list[Solution]:
    """Solve every problem; the same bits as `solve` on each, whatever the number of threads.

    Parameters
    ----------
    problems : iterable of Problem
    solver : str
    impulses : sequence of (m,) N s, optional
        Warm start of each problem, None where it has none; default: as `solve`.
    threads : int
        Problems solved at the same time.
    tol, max_iter, **options
        As `solve`.

    Returns
    -------
    list of Solution
        In the order of the problems.

    Raises
    ------
    InputError
        `threads` is not a whole number from 1, or `impulses` of another length than `problems`.
    UnknownName, CapabilityError, SolverUnavailable
        As `solve`, for the first problem that is refused.
    """
    given = list(problems)
    if isinstance(threads, bool) or not isinstance(threads, (int, np.integer)) or threads < 1:
        raise InputError(f"threads is {threads!r}; a whole number from 1 is needed")
    if impulses is not None and len(impulses) != len(given):
        raise InputError(f"{len(impulses)} impulses for {len(given)} problems; one for each is needed")
    starts = [None] * len(given) if impulses is None else list(impulses)
    made: list[Solution | None] = [None] * len(given)
    spec = get(solver)
    more = {"tol": tol, "max_iter": max_iter, **options}
    at = [
        i
        for i, p in enumerate(given)
        if isinstance(p, Problem) and p.generalized is not None and p.m > FEW_GENERAL
    ]
    quick = not options and solver in ("auto", "newton") and max_iter is None and 0.0 <= tol < np.inf
    parts = [at[k::threads] for k in range(min(threads, len(at)))] if quick else []

    def together(part: list[int]) -> None:
        found = _loop([given[i] for i in part], [starts[i] for i in part], tol, spec)
        for i, solution in zip(part, found, strict=True):
            made[i] = solution

    short = spec.few is not None and not options and max_iter is None

    def alone(i: int) -> None:
        made[i] = solve_few(given[i], spec, starts[i], tol) if short else None
        if made[i] is None:
            made[i] = solve(given[i], solver, impulse=starts[i], **more)

    if threads == 1:
        for part in parts:
            together(part)
        for i in range(len(given)):
            if made[i] is None:
                alone(i)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(together, parts))
            list(pool.map(alone, [i for i in range(len(given)) if made[i] is None]))
    return [solution for solution in made if solution is not None]


def _loop(problems: list[Problem], starts: list[Any], tol: float, spec: SolverSpec) -> list[Solution | None]:
    """Those that the compiled loop ends, each with its share of the time; None for the others."""
    begin = perf_counter()
    prepared = [general.prepare(p) for p in problems]
    if spec.name == "auto":  # which begins with it where it costs next to nothing
        for i, kernel in enumerate(prepared):
            if kernel is not None and not general_first(problems[i], kernel.largest):
                prepared[i] = None
    held = [i for i, kernel in enumerate(prepared) if kernel is not None]
    if len(held) < len(problems):  # some are too large: the others alone
        those = iter(_loop([problems[i] for i in held], [starts[i] for i in held], tol, spec))
        return [None if kernel is None else next(those) for kernel in prepared]
    kernels = [kernel for kernel in prepared if kernel is not None]
    lams: list[FloatArray] = []
    proofs = []
    for p, start in zip(problems, starts, strict=True):
        if start is not None:
            lam = p.impulse_array(start)
        else:
            lam = p.start() if p.guess is None else p.guess.copy()
        proofs.append(len(p.metric.empty) > 0 and decide_empty_rows(p, lam) is not None)
        lams.append(lam)
    found = general.run_many(problems, kernels, lams, tol)
    seconds = (perf_counter() - begin) / max(1, len(problems))
    return [
        None if end is None or proof else late(p, spec, end[0], end[1], tol, seconds)
        for p, end, proof in zip(problems, found, proofs, strict=True)
    ]
