"""Compare lavender's Newton solver with MuJoCo's on steps of the user's models, in one run.

Each model is simulated under random controls. At some of its steps the constraint problem is read from memory and
solved from a cold start by both solvers to the same judged residual:

    MuJoCo      `mj_fwdConstraint` with the Newton solver, at the loosest tolerance with an accepted answer
    lavender    four calls: `lavender.solve(problem)`, which prepares, solves and judges; `Prepared.solve` of an object
                prepared for the same structure; `solve_many`; and `from_mujoco` followed by `lavender.solve`

Only the fourth includes building the problem and factoring M, as MuJoCo's time does not include `mj_factorM`. Times
are minima of the same number of repetitions for both solvers.

`measure_model_warm` measures consecutive steps: MuJoCo starts from the accelerations of the step before, lavender from
the impulses of the step before, matched by key. MuJoCo uses the tolerance of the model.
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

from lavender.base.arrays import FloatArray
from lavender.batch.solve import solve_many
from lavender.io import mujoco as adapter
from lavender.io.recording import make_controller
from lavender.judge.residuals import get_zero_impulse_reference, residual
from lavender.judge.solution import Solution
from lavender.lab.bench.running.runner import carry_impulses
from lavender.problem import Problem
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve

TARGET_RESIDUAL = 1e-6  # Judged relative residual that both solvers must reach.
STRICT_RESIDUAL = 1e-9  # Tolerance of a second run of lavender's solver; its residual is reported.
MUJOCO_TOLERANCES = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-15)  # The loosest tolerance comes first.
N_REPEATS = 20
BATCH_SIZE = 64  # Number of problems in one call of solve_many.


@dataclass(frozen=True)
class WarmStep:
    """One problem of consecutive steps, each solved from the result of the step before. Residuals are relative.

    Parameters
    ----------
    model : str
    step, rows : int
    engine, ours : float, s
        Time of MuJoCo's solver, and of one call of lavender's.
    engine_residual, residual : float
        Relative residual of MuJoCo's answer, and of lavender's.
    """

    model: str
    step: int
    rows: int
    engine: float
    ours: float
    engine_residual: float
    residual: float


@dataclass(frozen=True)
class Step(WarmStep):
    """One problem, solved by both solvers from a cold start.

    Parameters
    ----------
    nv : int
    law : str
    tolerance : float
        Loosest tolerance of MuJoCo that was accepted; 0 if none was.
    many : float, s
        Time of lavender's solver per problem in solve_many.
    prepared : float, s
        Time of `Prepared.solve` for another problem of the same structure.
    imported : float, s
        Time of `from_mujoco` and one call.
    strict : float
        Relative residual of lavender's solver with the tolerance STRICT_RESIDUAL.
    coulomb : float or None
        Relative residual of lavender's solver under Coulomb's law with the tolerance STRICT_RESIDUAL; None if a
        contact has more than two tangents.
    """

    nv: int
    law: str
    tolerance: float
    many: float
    prepared: float
    imported: float
    strict: float
    coulomb: float | None


def copy_without_guess(problem: Problem) -> Problem:
    """Copy a problem without its guess and without anything derived from it."""
    return replace(problem, guess=None, copy=False)


def measure_min_time(run: Callable[[], Any], repeats: int = N_REPEATS) -> float:
    """Return the minimum time of several runs [s]."""
    best = np.inf
    for _ in range(repeats):
        start = perf_counter()
        run()
        best = min(best, perf_counter() - start)
    return float(best)


def time_mujoco_newton(mj: Any, model: Any, data: Any, problem: Problem) -> tuple[float, float, float]:
    """Return (tolerance, time [s], relative residual) of MuJoCo's Newton solver at the loosest sufficient tolerance.

    If no tolerance of MUJOCO_TOLERANCES gives TARGET_RESIDUAL, the model's own tolerance is used and returned as 0.
    """
    model = copy.copy(model)
    default = model.opt.tolerance
    model.opt.solver = mj.mjtSolver.mjSOL_NEWTON
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_WARMSTART)
    accepted = 0.0, np.inf
    for tolerance in (*MUJOCO_TOLERANCES, 0.0):
        model.opt.tolerance = tolerance or default
        mj.mj_fwdConstraint(model, data)
        accepted = tolerance, residual(problem, adapter.impulse(model, data)).relative
        if accepted[1] <= TARGET_RESIDUAL:
            break
    seconds = measure_min_time(lambda: mj.mj_fwdConstraint(model, data), N_REPEATS)
    return accepted[0], seconds, accepted[1]


def time_one_call(problem: Problem, impulse: Any = None) -> tuple[float, Solution]:
    """Solve repeatedly; return the minimum time [s] and the solution, which is equal in all repetitions."""
    best = np.inf
    for _ in range(N_REPEATS):
        cold_problem = copy_without_guess(problem)
        begin = perf_counter()
        solution = solve(cold_problem, tol=TARGET_RESIDUAL, impulse=impulse)
        best = min(best, perf_counter() - begin)
    return float(best), solution


def time_cold_solves(problem: Problem) -> tuple[float, float, float]:
    """Return (time of one call, time per problem of a batch, residual), from a cold start."""
    single_time, solution = time_one_call(problem)
    batch_time, residual_found = np.inf, solution.residual.relative
    for _ in range(N_REPEATS):
        batch = [copy_without_guess(problem) for _ in range(BATCH_SIZE)]
        begin = thread_time()  # CPU time, as a call of milliseconds may be interrupted by other processes.
        solutions = solve_many(batch, tol=TARGET_RESIDUAL)
        batch_time = min(batch_time, (thread_time() - begin) / BATCH_SIZE)
        residual_found = max(residual_found, *(solution.residual.relative for solution in solutions))
    return single_time, float(batch_time), float(residual_found)


def time_prepared(problem: Problem) -> float:
    """Return the minimum time of a prepared solve from a cold start [s]."""
    prepared = prepare(problem)
    problems = [copy_without_guess(problem) for _ in range(N_REPEATS)]
    return measure_min_time(lambda: prepared.solve(problems.pop(), tol=TARGET_RESIDUAL))


def time_import(model: Any, data: Any, start: FloatArray) -> float:
    """Return the minimum time to build the problem of MuJoCo's present state and to solve it from `start` (m,) [s]."""

    def run() -> Solution:
        return solve(adapter.from_mujoco(model, data), tol=TARGET_RESIDUAL, impulse=start)

    return measure_min_time(run)


def _iterate_problems(mj: Any, path: Path, model: Any, steps: int, every: int) -> Iterator[Any]:
    """Yield number, data and problem of each `every`-th step under random controls; None for problems without rows."""
    data, drive = mj.MjData(model), make_controller(model, "random", 0)
    for step in range(steps):
        data.ctrl[:] = drive(data, step)
        mj.mj_step(model, data)
        if (step + 1) % every == 0:
            mj.mj_forward(model, data)
            has_rows = int(data.nefc) > 0
            yield (
                step,
                data,
                adapter.from_mujoco(model, data, name=f"{path.stem} {step}") if has_rows else None,
            )


def measure_model(mj: Any, path: Path, steps: int, every: int) -> list[Step]:
    """Measure steps of one model under random controls, except those without constraints or with a zero solution."""
    model = mj.MjModel.from_xml_path(os.fspath(path))
    out: list[Step] = []
    for step, data, problem in _iterate_problems(mj, path, model, 20 * steps * every, every):
        if problem is None or get_zero_impulse_reference(problem)[1] < 1e-9:
            continue
        tolerance, engine, engine_residual = time_mujoco_newton(mj, model, data, problem)
        ours, batch_time, residual_found = time_cold_solves(problem)
        strict = solve(copy_without_guess(problem), tol=STRICT_RESIDUAL).residual
        coulomb = None
        if not problem.cones.has_round:
            coulomb_residual = solve(
                problem.relaxed("coulomb"), tol=STRICT_RESIDUAL, impulse=problem.start(), time_limit=5.0
            ).residual
            coulomb = 0.0 if coulomb_residual.at_floor else coulomb_residual.relative
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
                many=batch_time,
                prepared=time_prepared(problem),
                imported=time_import(model, data, problem.start()),
                engine_residual=engine_residual,
                residual=residual_found,
                strict=0.0 if strict.at_floor else strict.relative,
                coulomb=coulomb,
            )
        )
        if len(out) == steps:
            break
    return out


def measure_model_warm(mj: Any, path: Path, steps: int) -> list[WarmStep]:
    """Measure consecutive steps of one model under random controls, each solved warm by both solvers."""
    model = mj.MjModel.from_xml_path(os.fspath(path))
    model.opt.solver = mj.mjtSolver.mjSOL_NEWTON
    out: list[WarmStep] = []
    before: tuple[Problem, Any] | None = None
    for step, data, problem in _iterate_problems(mj, path, model, steps, 1):
        if problem is None:
            before = None
            continue
        engine = measure_min_time(partial(mj.mj_fwdConstraint, model, data))
        start = problem.start() if before is None else carry_impulses(*before, problem)
        ours, solution = time_one_call(problem, start)
        before = problem, solution.impulse
        if get_zero_impulse_reference(problem)[1] < 1e-9:
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
