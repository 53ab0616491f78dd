"""Kernels and small calls as rows of a table, each timed alternately with a bare loop if there is one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.core_problems import lattice_pile
from benchmarks.kernels import microbenchmarks
from benchmarks.kernels.problems import bare_contacts, raw_bytes, tridiagonal
from benchmarks.pairs import time_call, time_for
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.judge.residuals import residual
from lavender.problem import Problem
from lavender.sim.engine.simulation import Simulation
from lavender.sim.scene.scene import Scene
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve


@dataclass(frozen=True)
class Row:
    """One kernel on one problem."""

    case: str
    size: str  # size of the problem
    unit: str  # unit of `work`
    work: float  # units of work of one call
    seconds: float  # s, smallest CPU time of one call
    beside: str = ""  # name of the bare loop that was timed alternately
    limit: float = float("nan")  # s, smallest CPU time of the bare loop
    residual: float = float("nan")  # -, relative residual of the result

    @property
    def per_unit(self) -> float:
        """Nanoseconds per unit of work."""
        return 1e9 * self.seconds / self.work

    @property
    def share(self) -> float:
        """Time of the bare loop divided by the case's time; 1 is the limit."""
        return self.limit / self.seconds


@dataclass(frozen=True)
class Job:
    """Measurement of one case; fields as in `Row`."""

    case: str
    size: str
    unit: str
    work: float
    call: Callable[[], Any]
    beside: str = ""
    limit: Callable[[], Any] | None = None
    relative: Callable[[], float] | None = None  # relative residual of the result

    def row(self, seconds: float) -> Row:
        """Time the case for `seconds` and return its row."""
        both = [self.call] if self.limit is None else [self.call, self.limit]
        time, *other = time_for(seconds, *both)
        return Row(
            case=self.case,
            size=self.size,
            unit=self.unit,
            work=self.work,
            seconds=time,
            beside=self.beside,
            limit=other[0] if other else float("nan"),
            residual=float("nan") if self.relative is None else self.relative(),
        )


# -- cases -------------------------------------------------------------------------------------------

_ADD = 64  # sweeps after which the iterate no longer changes; timing starts there


def sweeps(
    problem: Problem, name: str, n: int, **options: Any
) -> tuple[Callable[[], Any], FloatArray]:
    """Return a call of n more sweeps of a prepared solver, and the impulses (m,) [N s] that it changes."""
    prepared = prepare(problem, name, **options)
    lam = problem.start()
    prepared.solver.run(prepared.state, lam, _ADD, 0.0)
    return partial(prepared.solver.run, prepared.state, lam, n, 0.0), lam


def _count(work: float) -> int:
    return max(4, int(2e5 / work))  # sweeps of one call, so that the Python call is negligible


def _impulses(contacts: int, shuffle: bool = False, **options: Any) -> Job:
    problem = lattice_pile(contacts, shuffle=shuffle)
    c = problem.n_blocks
    n = _count(20 * c)
    call, lam = sweeps(problem, "sequential_impulses", n, **options)
    raw = tuple(map(raw_bytes, bare_contacts(problem)))
    microbenchmarks.contact(*raw, _ADD)
    return Job(
        case="sequential impulses" + "".join(f", {v}" for v in options.values()),
        size=f"{c} contacts" + (" shuffled" if shuffle else ""),
        unit="contact",
        work=n * c,
        call=call,
        beside="bare",
        limit=partial(microbenchmarks.contact, *raw, n),
        relative=lambda: residual(problem, lam).relative,
    )


def _matrix(problem: Problem) -> Job:
    a = problem.csr
    n = _count(a.nnz)
    call, lam = sweeps(problem, "pgs", n)
    arrays = (a.indptr, a.indices, a.data, problem.b, np.ascontiguousarray(problem.csr_data.step))
    other = problem.start()
    microbenchmarks.csr(*arrays, other, _ADD)
    return Job(
        case="pgs",
        size=f"{problem.m:,} rows, {a.nnz / problem.m:.0f} entries each",
        unit="entry of A",
        work=n * a.nnz,
        call=call,
        beside="bare",
        limit=partial(microbenchmarks.csr, *arrays, other, n),
        relative=lambda: residual(problem, lam).relative,
    )


def frictionless(contacts: int) -> Problem:
    """Return a pile without friction, with A formed."""
    pile = lattice_pile(contacts)
    assert pile.rows is not None
    smooth = Problem.from_rows(pile.rows)
    return Problem.lcp(smooth.delassus(), smooth.b)


def _block_sweep(contacts: int) -> Job:
    problem = lattice_pile(contacts)
    c = problem.n_blocks
    n = _count(100 * c)
    call, lam = sweeps(problem, "block_gauss_seidel", n)
    return Job(
        "block_gauss_seidel",
        f"{c} contacts",
        "contact",
        n * c,
        call,
        relative=lambda: residual(problem, lam).relative,
    )


def _small() -> Job:
    j = np.random.default_rng(8).normal(size=(8, 10))
    problem = Problem.lcp(j @ j.T, np.ones(8))
    return Job(
        case="lv.solve, 8 sweeps of pgs",
        size="8 rows",
        unit="call",
        work=1,
        call=lambda: solve(problem, "pgs", tol=0.0, max_iter=8),
        beside="kernel alone",
        limit=sweeps(problem, "pgs", 8)[0],
        relative=lambda: solve(problem, "pgs", tol=0.0, max_iter=8).residual.relative,
    )


_JOBS: dict[str, Callable[[], Job]] = {
    "impulses": partial(_impulses, 1_000),
    "impulses-10k": partial(_impulses, 10_000),
    "impulses-100k": partial(_impulses, 100_000),
    "impulses-1m": partial(_impulses, 1_000_000),
    "impulses-shuffled": partial(_impulses, 100_000, shuffle=True),
    "impulses-local": partial(_impulses, 100_000, shuffle=True, order="local"),
    "impulses-colored": partial(_impulses, 100_000, order="colored"),
    "pgs": lambda: _matrix(frictionless(1_000)),
    "pgs-100k": lambda: _matrix(frictionless(100_000)),
    "pgs-tridiagonal": lambda: _matrix(tridiagonal(2_000)),
    "block": partial(_block_sweep, 1_000),
    "solve-8": _small,
}


def _engine(scene: str, seconds: float, **parameters: Any) -> list[Row]:
    """Return rows of a step and of its phases, as differences of smallest times from one state."""
    simulation = Simulation(Scene(scene, dt=1 / 240, solver_iterations=16, **parameters))
    for _ in range(240):
        simulation.step()
    state = simulation.state.copy()
    kernel = state.kernel
    calls: dict[str, Callable[[], Any]] = {
        "pairs": kernel.count_broad_phase_pairs,
        "prepare": kernel.prepare_substep,
        "warm": lambda: kernel.solve(False),
        "again": kernel.prepare_substep,
        "solve": kernel.solve,
        "finish": kernel.finish_substep,
    }
    best = dict.fromkeys(calls, float("inf"))
    spent = 0.0
    while spent < seconds:
        state.copy_from(simulation.state)
        for name, call in calls.items():
            taken = time_call(call)
            best[name] = min(best[name], taken)
            spent += taken
    contacts = max(1, int(simulation.step()[0]["solver"][2]))
    relative = float(simulation.residual()["relative"])
    bodies = sum(not b.is_static for b in simulation.scene.bodies)
    size = f"{scene}, {bodies} bodies"
    phases = (
        ("pairs", "body", bodies, best["pairs"]),
        (
            "collide, match, rows",
            "contact",
            contacts,
            max(best["prepare"], best["again"]) - best["pairs"],
        ),
        ("16 sweeps", "contact and sweep", 16 * contacts, best["solve"] - best["warm"]),
        ("integrate, project", "body", bodies, best["finish"]),
    )
    step = time_for(seconds, simulation.step)[0]
    return [
        *(
            Row(f"engine: {name}", size, unit, work, max(time, 1e-9))
            for name, unit, work, time in phases
        ),
        Row("sim.step(), 16 sweeps", size, "step", 1, step, residual=relative),
    ]


_ENGINES: dict[str, dict[str, Any]] = {
    "engine-pyramid": {"scene": "pyramid", "base": 10},
    "engine-pile": {"scene": "pile", "n": 1_000},
    "engine-box": {"scene": "stack", "n": 1},
}

#: Names of all cases.
CASES = (*_JOBS, *_ENGINES)


def job(name: str) -> Job:
    """Build the measurement of a case.

    Raises
    ------
    InputError
        No such case, or one of the engine, which is several calls.
    """
    if name not in _JOBS:
        raise InputError(f"no case {name!r} of one call; there are: {', '.join(_JOBS)}")
    return _JOBS[name]()


def run(names: Sequence[str] = CASES, *, seconds: float = 0.2) -> Iterator[Row]:
    """Yield the rows of cases as they are measured.

    Parameters
    ----------
    names : sequence of str
    seconds : float, s
        Time for each case.

    Raises
    ------
    InputError
        No such case.
    """
    unknown = [n for n in names if n not in CASES]
    if unknown:
        raise InputError(f"no case {unknown[0]!r}; there are: {', '.join(CASES)}")
    for name in names:
        if name in _ENGINES:
            yield from _engine(seconds=seconds, **_ENGINES[name])
        else:
            yield job(name).row(seconds)
