"""Our Newton and MuJoCo's on the steps of models that one has, in one run.

Each model runs under random controls. At some of its steps the constraint problem is taken from memory and solved cold
by both sides to the same judged residual:

    MuJoCo   `mj_fwdConstraint` with the Newton solver, at the loosest tolerance whose answer the judge accepts
    ours     `lavender.solve(problem)`: prepare, solve and judge; and the same in `solve_many`

Construction of the problem, with M's factor, is apart, as `mj_factorM` is not counted either. Times are the least of
several repetitions, taken in turns.

`measure_warm` goes through consecutive steps: MuJoCo starts from its last accelerations, ours from the impulses of the
last step, by key; MuJoCo at its own tolerance.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np

from lavender.batch.solve import solve_many
from lavender.io import mujoco as adapter
from lavender.io.recording import make_controller
from lavender.judge.residuals import get_reference, residual
from lavender.judge.solution import Solution
from lavender.lab.bench.running.runner import carry
from lavender.problem import Problem
from lavender.solving.solve import solve

TARGET = 1e-6  # judged relative residual that both sides must reach
STRICT = 1e-9  # that ours is asked for besides
TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)  # of MuJoCo, loosest first
REPEATS = 5
MANY = 64  # problems in one call of solve_many


@dataclass(frozen=True)
class WarmStep:
    """One problem, both sides; of consecutive steps each from what it knew. Times in s, residuals relative."""

    model: str
    step: int
    rows: int
    engine: float
    ours: float  # one call
    engine_residual: float
    residual: float


@dataclass(frozen=True)
class Step(WarmStep):
    """One problem, both sides from nothing."""

    nv: int
    law: str
    tolerance: float  # of MuJoCo, the loosest accepted; 0 where none was
    many: float  # s, each in solve_many
    strict: float  # residual of ours when asked for STRICT
    coulomb: float | None  # the same under Coulomb's law; None where a contact has more than two tangents


def fresh(problem: Problem) -> Problem:
    """The same problem with nothing worked out of it, to be started from doing nothing."""
    return replace(problem, guess=None, copy=False)


def least(run: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Least time of several runs [s]."""
    best = np.inf
    for _ in range(repeats):
        start = perf_counter()
        run()
        best = min(best, perf_counter() - start)
    return float(best)


def engine_time(mj: Any, model: Any, data: Any, problem: Problem) -> tuple[float, float, float]:
    """(tolerance, time, residual) of MuJoCo's Newton at the loosest tolerance that is accepted; else 0, its default."""
    model = copy.copy(model)
    default = model.opt.tolerance
    model.opt.solver = mj.mjtSolver.mjSOL_NEWTON
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_WARMSTART)
    found = 0.0, np.inf
    for tolerance in (*TOLERANCES, 0.0):
        model.opt.tolerance = tolerance or default
        mj.mj_fwdConstraint(model, data)
        found = tolerance, residual(problem, adapter.impulse(model, data)).relative
        if found[1] <= TARGET:
            break
    seconds = least(lambda: mj.mj_fwdConstraint(model, data), 4 * REPEATS)
    return found[0], seconds, found[1]


def one_call(problem: Problem, impulse: Any = None) -> tuple[float, Solution]:
    """Least time of a solve [s], and its solution: the same every time."""
    best = np.inf
    for _ in range(REPEATS):
        made = fresh(problem)
        begin = perf_counter()
        solution = solve(made, tol=TARGET, impulse=impulse)
        best = min(best, perf_counter() - begin)
    return float(best), solution


def our_times(problem: Problem) -> tuple[float, float, float]:
    """(one call, each of many, residual), cold."""
    one, solution = one_call(problem)
    many, found = np.inf, solution.residual.relative
    for _ in range(REPEATS):
        batch = [fresh(problem) for _ in range(MANY)]
        begin = thread_time()  # of the processor: milliseconds are long enough to be interrupted
        made_of = solve_many(batch, tol=TARGET)
        many = min(many, (thread_time() - begin) / MANY)
        found = max(found, *(solution.residual.relative for solution in made_of))
    return one, float(many), float(found)


def _problems(mj: Any, path: Path, model: Any, steps: int, every: int) -> Iterator[Any]:
    """Number, data and problem of each `every`-th step under random controls; None for a problem without a row."""
    data, drive = mj.MjData(model), make_controller(model, "random", 0)
    for step in range(steps):
        data.ctrl[:] = drive(data, step)
        mj.mj_step(model, data)
        if (step + 1) % every == 0:
            mj.mj_forward(model, data)
            some = int(data.nefc) > 0
            yield step, data, adapter.from_mujoco(model, data, name=f"{path.stem} {step}") if some else None


def measure(mj: Any, path: Path, steps: int, every: int) -> list[Step]:
    """Steps of one model under random controls; those without constraints or nothing to do are left out."""
    model = mj.MjModel.from_xml_path(os.fspath(path))
    out: list[Step] = []
    for step, data, problem in _problems(mj, path, model, 20 * steps * every, every):
        if problem is None or get_reference(problem)[1] < 1e-9:
            continue
        tolerance, engine, engine_residual = engine_time(mj, model, data, problem)
        ours, many, found = our_times(problem)
        strict = solve(fresh(problem), tol=STRICT).residual
        coulomb = None
        if not problem.cones.has_round:
            under = solve(
                problem.relaxed("coulomb"), tol=STRICT, impulse=problem.start(), time_limit=5.0
            ).residual
            coulomb = 0.0 if under.at_floor else under.relative
        out.append(
            Step(
                model=path.stem,
                step=step,
                rows=problem.m,
                nv=int(model.nv),
                law=problem.law,
                tolerance=tolerance,
                engine=engine,
                ours=ours,
                many=many,
                engine_residual=engine_residual,
                residual=found,
                strict=0.0 if strict.at_floor else strict.relative,
                coulomb=coulomb,
            )
        )
        if len(out) == steps:
            break
    return out


def measure_warm(mj: Any, path: Path, steps: int) -> list[WarmStep]:
    """Consecutive steps of one model under random controls, each solved warm by both sides."""
    model = mj.MjModel.from_xml_path(os.fspath(path))
    model.opt.solver = mj.mjtSolver.mjSOL_NEWTON
    out: list[WarmStep] = []
    before: tuple[Problem, Any] | None = None
    for step, data, problem in _problems(mj, path, model, steps, 1):
        if problem is None:
            before = None
            continue
        engine = least(partial(mj.mj_fwdConstraint, model, data))
        start = problem.start() if before is None else carry(*before, problem)
        ours, solution = one_call(problem, start)
        before = problem, solution.impulse
        if get_reference(problem)[1] < 1e-9:
            continue
        out.append(
            WarmStep(
                model=path.stem,
                step=step,
                rows=problem.m,
                engine=engine,
                ours=ours,
                engine_residual=residual(problem, adapter.impulse(model, data)).relative,
                residual=solution.residual.relative,
            )
        )
    return out
