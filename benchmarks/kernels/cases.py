"""Kernels, small calls and whole jobs as rows of a table, each timed beside its limit."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter, process_time_ns
from typing import Any

import numpy as np

from benchmarks.kernels import microbenchmarks
from benchmarks.kernels.limits import least, stream_time
from benchmarks.kernels.problems import (
    bare_contacts,
    contact_bytes,
    csr_bytes,
    lattice_pile,
    raw_bytes,
    tridiagonal,
)
from lavender._arrays import FloatArray
from lavender.engine.simulation import Simulation
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.residuals import residual
from lavender.scene.scene import Scene
from lavender.solve import Prepared, prepare, solve
from lavender.suite import granular
from lavender_ext.core import assemble
from lavender_ext.judge import measure

__all__ = ["CASES", "Row", "frictionless", "run", "scaling", "sweeps"]


@dataclass(frozen=True)
class Row:
    """One kernel on one problem."""

    case: str
    size: str  # what it ran on
    unit: str  # what `work` counts
    work: float  # units of one call
    seconds: float  # s, of one call: least CPU time (of the wall where several threads run)
    bytes: float = float("nan")  # that a unit reads and writes
    limit: float = float("nan")  # s, of one call at the limit
    limit_name: str = ""  # "bare" or "stream"
    residual: float = float("nan")  # -, the judge's, of what came out
    instructions: float = float("nan")  # of a unit

    @property
    def per_unit(self) -> float:
        """Nanoseconds a unit."""
        return 1e9 * self.seconds / self.work

    @property
    def share(self) -> float:
        """Of the limit that is reached: 1 is as fast as can be."""
        return self.limit / self.seconds


# -- cases -------------------------------------------------------------------------------------------

_ADD = 64  # sweeps beyond which an iterate moves by nothing: timing goes on from there


def sweeps(
    problem: Problem, name: str, n: int, **options: Any
) -> tuple[Callable[[], Any], Prepared, FloatArray]:
    """A call of n more sweeps of a prepared solver, that solver, and the impulses (m,) [N s] that it moves."""
    prepared = prepare(problem, name, **options)
    lam = problem.start()
    prepared.solver.run(prepared.state, lam, _ADD, 0.0)
    return partial(prepared.solver.run, prepared.state, lam, n, 0.0), prepared, lam


def _count(work: float) -> int:
    return max(4, int(2e5 / work))  # sweeps of one call: a Python call is then nothing


def _impulses(contacts: int, seconds: float, shuffle: bool = False, **options: Any) -> Row:
    problem = lattice_pile(contacts, shuffle=shuffle)
    c = problem.n_blocks
    n = _count(20 * c)
    ours, _, lam = sweeps(problem, "sequential_impulses", n, **options)
    records, bodies = bare_contacts(problem)
    raw = raw_bytes(records), raw_bytes(bodies)
    microbenchmarks.contact(*raw, _ADD)
    time, bare = least(ours, partial(microbenchmarks.contact, *raw, n), seconds=seconds)
    label = "sequential impulses" + "".join(f", {v}" for v in options.values())
    return Row(
        case=label,
        size=f"{c} contacts" + (" shuffled" if shuffle else ""),
        unit="contact",
        work=c,
        seconds=time / n,
        bytes=contact_bytes(problem),
        limit=bare / n,
        limit_name="bare",
        residual=residual(problem, lam).relative,
    )


def _threads(contacts: int, seconds: float, threads: int = 2) -> Row:
    problem = lattice_pile(contacts)
    c = problem.n_blocks
    n = max(1, int(1e-2 / (c * 25e-9)))  # about 10 ms: what the front door hands over at once is 25
    calls = [sweeps(problem, "sequential_impulses", n, order="colored", threads=t) for t in (1, threads)]
    one, many = least(calls[0][0], calls[1][0], seconds=4 * seconds, clock=_wall)
    return Row(
        case=f"colored, {threads} threads (wall)",
        size=f"{c} contacts",
        unit="contact",
        work=c,
        seconds=many / n,
        bytes=contact_bytes(problem),
        limit=one / n / threads,
        limit_name=f"1 thread / {threads}",
        residual=residual(problem, calls[1][2]).relative,
    )


def _wall() -> int:
    return int(perf_counter() * 1e9)


def _matrix(problem: Problem, size: str, name: str, seconds: float, bare: bool) -> Row:
    nnz = problem.csr.nnz
    n = _count(nnz)
    ours, _, lam = sweeps(problem, name, n)
    calls: list[Callable[[], Any]] = [ours]
    if bare:
        a, other = problem.csr, problem.start()
        arrays = (a.indptr, a.indices, a.data, problem.b, np.ascontiguousarray(problem.csr_data.step))
        microbenchmarks.csr(*arrays, other, _ADD)
        calls.append(partial(microbenchmarks.csr, *arrays, other, n))
    times = least(*calls, seconds=seconds)
    per = csr_bytes(problem)
    limit = times[1] / n if bare else stream_time(per * nnz)
    return Row(
        case=name,
        size=size,
        unit="entry of A",
        work=nnz,
        seconds=times[0] / n,
        bytes=per,
        limit=limit,
        limit_name="bare" if bare else "stream",
        residual=residual(problem, lam).relative,
    )


def frictionless(contacts: int) -> Problem:
    """A pile without friction, with A formed."""
    pile = lattice_pile(contacts)
    assert pile.rows is not None
    smooth = Problem.from_rows(pile.rows)
    return Problem.lcp(smooth.delassus(), smooth.b)


def _block_sweep(contacts: int, seconds: float) -> Row:
    problem = lattice_pile(contacts)
    c = problem.n_blocks
    n = _count(100 * c)
    ours, _, lam = sweeps(problem, "block_gauss_seidel", n)
    time = least(ours, seconds=seconds)[0]
    per = contact_bytes(problem)
    return Row(
        case="block_gauss_seidel",
        size=f"{c} contacts",
        unit="contact",
        work=c,
        seconds=time / n,
        bytes=per,
        limit=stream_time(per * c),
        limit_name="stream",
        residual=residual(problem, lam).relative,
    )


def _judge(contacts: int, seconds: float) -> Row:
    problem = lattice_pile(contacts)
    c, m = problem.n_blocks, problem.m
    lam, w, e = solve(problem, "sequential_impulses", tol=0.0, max_iter=8).impulse, np.empty(m), np.empty(m)
    time = least(lambda: measure.judge(problem.data, lam, w, e, False), seconds=seconds)[0]
    per = contact_bytes(problem) - 6 * 24.0  # no swing
    return Row(
        case="residual",
        size=f"{c} contacts",
        unit="contact",
        work=c,
        seconds=time,
        bytes=per,
        limit=stream_time(per * c),
        limit_name="stream",
        residual=residual(problem, lam).relative,
    )


def _assembly(contacts: int, seconds: float) -> Row:
    problem = lattice_pile(contacts)
    data = problem.data
    bound = assemble.bound(data)
    nnz = problem.csr.nnz
    time = least(lambda: assemble.delassus(data, *bound), seconds=seconds)[0]
    per = 12.0 + (contact_bytes(problem) + 6 * 96) * problem.n_blocks / nnz
    return Row(
        case="assembly of A",
        size=f"{problem.n_blocks} contacts",
        unit="entry of A",
        work=nnz,
        seconds=time,
        bytes=per,
        limit=stream_time(per * nnz),
        limit_name="stream",
    )


def _build(contacts: int, seconds: float) -> Row:
    rows = lattice_pile(contacts).rows
    assert rows is not None

    def build() -> None:
        _ = Problem.from_rows(replace(rows, copy=False), mu=0.5, tangents=2).data

    c = rows.n_contacts
    return Row("Problem.from_rows", f"{c} contacts", "contact", c, least(build, seconds=seconds)[0])


def _settled(scene: str, parameters: dict[str, Any]) -> Simulation:
    simulation = Simulation(Scene(scene, dt=1 / 240, solver_iterations=16, **parameters))
    for _ in range(240):
        simulation.step()
    return simulation


def _engine(scene: str, seconds: float, **parameters: Any) -> list[Row]:
    # Phases as differences of least times from one state.
    simulation = _settled(scene, parameters)
    state = simulation.state.copy()
    kernel = state.kernel
    calls: dict[str, Callable[[], Any]] = {
        "pairs": kernel.pairs,
        "prepare": kernel.prepare,
        "warm": lambda: kernel.solve(False),
        "again": kernel.prepare,
        "solve": kernel.solve,
        "finish": kernel.finish,
    }
    best = dict.fromkeys(calls, float("inf"))
    begun = perf_counter()
    while best["finish"] == float("inf") or perf_counter() - begun < seconds:
        state.take(simulation.state)
        for name, call in calls.items():
            start = process_time_ns()
            call()
            best[name] = min(best[name], 1e-9 * (process_time_ns() - start))
    contacts = max(1, int(simulation.step()[0]["solver"][2]))
    relative = float(simulation.residual()["relative"])
    bodies = sum(not b.is_static for b in simulation.scene.bodies)
    size = f"{scene}, {bodies} bodies"
    phases = (
        ("pairs", "body", bodies, best["pairs"]),
        ("collide, match, rows", "contact", contacts, max(best["prepare"], best["again"]) - best["pairs"]),
        ("16 sweeps", "contact and sweep", 16 * contacts, best["solve"] - best["warm"]),
        ("integrate, project", "body", bodies, best["finish"]),
    )
    step = least(simulation.step, seconds=seconds)[0]
    return [
        *(Row(f"engine: {name}", size, unit, work, max(time, 1e-9)) for name, unit, work, time in phases),
        Row("sim.step(), 16 sweeps", size, "step", 1, step, residual=relative),
    ]


def _small(m: int, seconds: float) -> Row:
    rng = np.random.default_rng(m)
    j = rng.normal(size=(m, m + 2))
    problem = Problem.lcp(j @ j.T, rng.normal(size=m))
    kernel_alone, _, _ = sweeps(problem, "pgs", 8)
    solution = solve(problem, "pgs", tol=0.0, max_iter=8)
    call, kernel = least(lambda: solve(problem, "pgs", tol=0.0, max_iter=8), kernel_alone, seconds=seconds)
    return Row(
        "lv.solve, 8 sweeps of pgs",
        f"{m} rows",
        "call",
        1,
        call,
        limit=kernel,
        limit_name="kernel alone",
        residual=solution.residual.relative,
    )


def _job(n: int, tol: float, seconds: float) -> Row:
    case = granular(n=n, friction="coulomb")
    problem = case.problem
    solution = solve(problem, "auto", tol=tol, time_limit=10.0)
    time = least(lambda: solve(problem, "auto", tol=tol, time_limit=10.0), seconds=seconds)[0]
    return Row(
        f"auto to {tol:.0e}",
        f"{case.name}, {problem.m} rows",
        "row",
        problem.m,
        time,
        residual=solution.residual.relative,
    )


Case = Callable[[float], "Row | list[Row]"]


def _cases() -> dict[str, Case]:
    return {
        "impulses": partial(_impulses, 1_000),
        "impulses-10k": partial(_impulses, 10_000),
        "impulses-100k": partial(_impulses, 100_000),
        "impulses-shuffled": partial(_impulses, 100_000, shuffle=True),
        "impulses-local": partial(_impulses, 100_000, shuffle=True, order="local"),
        "impulses-colored": partial(_impulses, 100_000, order="colored"),
        "threads-10k": partial(_threads, 10_000),
        "threads-100k": partial(_threads, 100_000),
        "pgs": lambda s: _matrix(frictionless(1_000), "1,000 rows", "pgs", s, True),
        "pgs-100k": lambda s: _matrix(frictionless(100_000), "100,000 rows", "pgs", s, True),
        "pgs-tridiagonal": lambda s: _matrix(tridiagonal(2_000), "tridiagonal, 2,000", "pgs", s, True),
        "pgs-tridiagonal-1m": lambda s: _matrix(tridiagonal(1_000_000), "tridiagonal, 10^6", "pgs", s, True),
        "jacobi": lambda s: _matrix(frictionless(1_000), "1,000 rows", "jacobi", s, False),
        "block": partial(_block_sweep, 1_000),
        "judge": partial(_judge, 10_000),
        "assembly": partial(_assembly, 10_000),
        "build": partial(_build, 10_000),
        "engine-pyramid": lambda s: _engine("pyramid", s, base=10),
        "engine-pile": lambda s: _engine("pile", s, n=1_000),
        "engine-box": lambda s: _engine("stack", s, n=1),
        "solve-1": partial(_small, 1),
        "solve-8": partial(_small, 8),
        "solve-64": partial(_small, 64),
        "job-1e-3": lambda s: _job(6, 1e-3, s),
        "job-1e-6": lambda s: _job(6, 1e-6, s),
        "job-1e-9": lambda s: _job(6, 1e-9, s),
    }


#: Names of the cases.
CASES = tuple(_cases())


def run(
    names: Sequence[str] = CASES, *, seconds: float = 0.2, watch: Callable[[str], None] | None = None
) -> Iterator[Row]:
    """Rows of the cases of those names, as they are measured.

    Parameters
    ----------
    names : sequence of str
    seconds : float, s
        Time for each case.
    watch : callable (name), optional

    Raises
    ------
    InputError
        No such case.
    """
    cases = _cases()
    unknown = [n for n in names if n not in cases]
    if unknown:
        raise InputError(f"no case {unknown[0]!r}; there are: {', '.join(cases)}")
    for name in names:
        if watch is not None:
            watch(name)
        found = cases[name](seconds)
        yield from [found] if isinstance(found, Row) else found


def _megabytes() -> float:
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def scaling(
    sizes: Sequence[int] = (1_000, 10_000, 100_000, 1_000_000), *, seconds: float = 0.5
) -> Iterator[dict[str, float]]:
    """Build, solve (100 sweeps) and sweep of piles of about `sizes` contacts, growing.

    Yields
    ------
    dict
        contacts, build [s], solve [s] with set-up and judge, residual, sweep and bare [ns per contact],
        megabytes: the process's largest so far.
    """
    for size in sizes:
        start = perf_counter()
        problem = lattice_pile(size)
        _ = problem.data
        build = perf_counter() - start
        start = perf_counter()
        solution = solve(problem, "sequential_impulses", tol=1e-12, max_iter=100)
        took = perf_counter() - start
        peak = _megabytes()
        c = problem.n_blocks
        n = _count(20 * c)
        ours, _, _ = sweeps(problem, "sequential_impulses", n)
        raw = tuple(map(raw_bytes, bare_contacts(problem)))
        microbenchmarks.contact(*raw, _ADD)
        sweep, bare = least(ours, partial(microbenchmarks.contact, *raw, n), seconds=seconds)
        yield {
            "contacts": c, "build": build, "solve": took, "residual": solution.residual.relative,
            "sweep": 1e9 * sweep / n / c, "bare": 1e9 * bare / n / c, "megabytes": peak,
        }  # fmt: skip
