"""The race: every contestant runs in its own process, alternately; the fast ones run again in later rounds."""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from time import monotonic
from typing import Any

from benchmarks.peers.adapters import SCRATCH, TARGETS, Contestant, Result
from lavender.judge.residuals import residual
from lavender.problem import Problem
from lavender.programs.running import quiet
from lavender.report.timing import limit_to_one_thread

REPEATS, REPEAT_TIME = 30, 0.1  # repeats of one setting: maximum number, and maximum total time [s]
AGAIN = (
    4.0  # A contestant runs in later rounds if it is within this factor of the fastest of its side.
)
PATIENCE = 10.0  # s, wall time beyond four times the limit of a call after which a contestant is terminated


def _child(pipe: Any, contestant: Contestant, problem: Problem, limit: float) -> None:
    # Runs in its own process: sends (seconds, residual) of each setting, then None or the reason for stopping.
    try:
        with limit_to_one_thread(contestant.name), quiet(noisy=True):
            least = max(min(TARGETS), 2.0 * residual(problem, problem.start()).roundoff_floor)
            for call in contestant.runs(problem, limit):
                began = monotonic()
                seconds, impulse = call()
                late = (
                    max(seconds, monotonic() - began) > 0.9 * limit
                )  # the solvers' own limits are wall time
                judged = residual(problem, impulse)
                spent = seconds
                for _ in range(REPEATS):
                    if spent > REPEAT_TIME:
                        break
                    again = call()[0]
                    spent = spent + max(again, 1e-6)
                    seconds = min(seconds, again)
                pipe.send((seconds, judged.relative))
                if judged.relative <= least or judged.at_floor or late:
                    break
        pipe.send(None)
    except BaseException as error:  # code of other projects may raise anything
        pipe.send(f"{type(error).__name__}: {error}"[:200])


def _run(
    contestant: Contestant, problem: Problem, limit: float
) -> tuple[list[tuple[float, float]], str]:
    context: Any = multiprocessing.get_context("fork" if hasattr(os, "fork") else "spawn")
    mine, other = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(other, contestant, problem, limit), daemon=False)
    process.start()
    other.close()
    runs: list[tuple[float, float]] = []
    note = ""
    try:
        while True:
            # The solver limits the CPU time of a call if it can; here wall time is limited, on a loaded machine.
            patience = 4.0 * limit + PATIENCE
            if not mine.poll(patience):
                note = f"ended after {patience:g} s without an answer"
                break
            try:
                said = mine.recv()
            except EOFError:
                process.join(5.0)
                note = f"its process died ({process.exitcode})"
                break
            if said is None or isinstance(said, str):
                note = said or ""
                break
            runs.append(said)
    finally:
        process.kill()
        process.join()
        mine.close()
    return runs, note


def race(
    problems: Iterable[tuple[str, Problem]],
    all_of: Sequence[Contestant],
    *,
    limit: float = 5.0,
    rounds: int = 3,
    watch: Callable[[str], None] = lambda _: None,
) -> Iterator[list[Result]]:
    """Run every contestant on every problem that it accepts; yield the results of each problem.

    Parameters
    ----------
    problems : (name, Problem) pairs
    all_of : contestants
    limit : s
        CPU time limit of a call; tighter settings are not tried after a longer call.
    rounds : int
        Number of rounds. From the second on only contestants near the fastest of their side run, and lavender's solvers
        also from scratch.
    watch : callable
        Called with the name of what runs.
    """
    for name, problem in problems:
        here: dict[str, Result] = {}
        takers = [c for c in all_of if c.refuses(problem) is None]
        running = [c for c in takers if not c.name.endswith(SCRATCH)]
        for number in range(rounds):
            for c in running if number % 2 == 0 else running[::-1]:
                watch(f"{name}: {c.name}")
                runs, note = _run(c, problem, limit)
                result = here.setdefault(
                    c.name, Result(name, problem.m, problem.law, c.name, c.peer)
                )
                result.runs += runs
                result.note = result.note or note
            near = {c.name for c in running if _near(here[c.name], list(here.values()))}
            running = [c for c in takers if c.name.removesuffix(SCRATCH) in near]
        yield list(here.values())


def _near(one: Result, all_of: Sequence[Result]) -> bool:
    for target in TARGETS:
        side = [
            r
            for r in all_of
            if (r.peer, r.solver.endswith(SCRATCH)) == (one.peer, one.solver.endswith(SCRATCH))
        ]
        fastest = min((r.time(target) for r in side), default=math.inf)
        if math.isfinite(one.time(target)) and one.time(target) <= AGAIN * fastest:
            return True
    return False
