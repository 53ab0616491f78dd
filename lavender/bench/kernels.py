"""Kernels, small calls and whole jobs: time, time per unit of work, bytes per unit, share of the machine's limit.

Every case is timed beside its limit, in turns, as the least CPU time of many short batches (other programs only
add time). The limit is measured in the same run (`lavender_ext/bench/`, compiled with the kernels' flags):

    bare     the same mathematics in a loop with nothing else around it
    stream   the bytes that a unit needs at the speed of the memory they fit in

Instructions are counted by valgrind's callgrind where it is asked for and installed.
"""

from __future__ import annotations

import gc
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from time import perf_counter, process_time_ns
from typing import Any

import click
import numpy as np

from lavender._arrays import FloatArray
from lavender.bench import machine
from lavender.engine.simulation import Simulation
from lavender.errors import InputError, SolverUnavailable
from lavender.problem import Problem
from lavender.residuals import residual
from lavender.rows import Rows
from lavender.scene.scene import Scene
from lavender.solve import Prepared, prepare, solve
from lavender.suite import granular
from lavender.suite.families import at_least
from lavender_ext.bench import microbenchmarks
from lavender_ext.core import assemble
from lavender_ext.judge import measure

__all__ = [
    "CASES",
    "Limit",
    "Row",
    "bare_contacts",
    "lattice_pile",
    "measure_limits",
    "run",
    "scaling",
    "table",
]


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


@dataclass(frozen=True)
class Limit:
    """One limit of this machine."""

    name: str
    kib: float  # footprint, KiB; 0 where there is none
    value: float
    unit: str  # "GB/s" or "ns"


# -- timing ------------------------------------------------------------------------------------------


def least(
    *calls: Callable[[], Any], seconds: float = 0.2, clock: Callable[[], int] = process_time_ns
) -> list[float]:
    """Least time [s] of one call of each, in turns, in batches of about a millisecond.

    Parameters
    ----------
    seconds : float, s
        Time for all; each is called at least three times.
    """
    counts = []
    for call in calls:
        start = perf_counter()
        call()
        counts.append(max(1, min(10_000, int(1e-3 / max(perf_counter() - start, 1e-8)))))
    best = [float("inf")] * len(calls)
    begun, rounds = perf_counter(), 0
    collects = gc.isenabled()
    gc.disable()
    try:
        while rounds < 3 or perf_counter() - begun < seconds:
            for i, call in enumerate(calls):
                start = clock()
                for _ in range(counts[i]):
                    call()
                best[i] = min(best[i], (clock() - start) / counts[i])
            rounds += 1
    finally:
        if collects:
            gc.enable()
    return [1e-9 * t for t in best]


# -- the machine -------------------------------------------------------------------------------------

# KiB: in the first-level cache, the second, the third, beyond all.
FOOTPRINTS = (24, 512, 8_192, 262_144)


@cache
def measure_limits(seconds: float = 0.1) -> tuple[Limit, ...]:
    """Reading and writing speed, time of a dependent load, time of a dependent product and sum."""
    found = []
    for kib in FOOTPRINTS:
        n = kib * 128
        x = np.arange(n, dtype=np.uint64)
        found.append(
            Limit(
                "read",
                kib,
                8.0 * n / least(partial(microbenchmarks.read, x, 1), seconds=seconds)[0] * 1e-9,
                "GB/s",
            )
        )
        a, b, c = np.zeros(n // 3), np.ones(n // 3), np.ones(n // 3)
        time = least(partial(microbenchmarks.triad, a, b, c, 1), seconds=seconds)[0]
        found.append(Limit("triad", kib, 24.0 * len(a) / time * 1e-9, "GB/s"))
        ring = np.random.default_rng(kib).permutation(kib * 16).astype(np.int32)  # one entry a cache line
        step = np.zeros(kib * 256, np.int32)
        step[16 * ring] = 16 * np.roll(ring, -1)
        time = least(partial(microbenchmarks.chase, step, 20_000), seconds=seconds)[0]
        found.append(Limit("chase", kib, time / 20_000 * 1e9, "ns"))
    time = least(partial(microbenchmarks.chain, 0.5, 1.0, 20_000), seconds=seconds)[0]
    return (*found, Limit("chain", 0, time / 20_000 * 1e9, "ns"))


def stream_time(size: float) -> float:
    """Time [s] of moving `size` bytes at the speed (read or triad) of the memory that they fit in."""
    speed: dict[float, float] = {}
    for x in measure_limits():
        if x.unit == "GB/s":
            speed[x.kib] = max(x.value, speed.get(x.kib, 0.0))
    kib = next((k for k in FOOTPRINTS if size <= 1024 * k), FOOTPRINTS[-1])
    return size / speed[kib] * 1e-9


# -- problems ----------------------------------------------------------------------------------------


def lattice_pile(contacts: int, *, shuffle: bool = False, seed: int = 0) -> Problem:
    """About `contacts` contacts of spheres on a cubic lattice that stands on the ground, normals tilted a little.

    Parameters
    ----------
    contacts : int
    shuffle : bool, default False
        Number bodies and contacts at random, as a scene that was not built in space order.
    seed : int

    Raises
    ------
    InputError
        Fewer than 1 contact.
    """
    at_least(1, contacts=contacts)
    rng = np.random.default_rng(seed)
    k = max(1, round((contacts / 3) ** (1 / 3)))
    index = np.arange(k**3, dtype=np.int32).reshape(k, k, k)
    below = [np.full(k * k, -1, np.int32)]
    above = [index[:, :, 0].ravel()]
    axis = [np.full(k * k, 2)]
    for d in range(3):
        line = np.moveaxis(index, d, 0)
        below.append(line[:-1].ravel())
        above.append(line[1:].ravel())
        axis.append(np.full(line[1:].size, d))
    body = np.stack([np.concatenate(below), np.concatenate(above)], axis=1)
    along = np.concatenate(axis)
    order = (
        rng.permutation(len(body))
        if shuffle
        else np.argsort(np.where(body[:, 0] < 0, body[:, 1], body[:, 0]), kind="stable")
    )
    body, along = body[order], along[order]
    if shuffle:
        body = np.append(rng.permutation(k**3), -1).astype(np.int32)[body]
    c, n = len(body), k**3
    normal = 0.4 * (rng.random((c, 3)) - 0.5)
    normal[np.arange(c), along] += 1.0
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross(normal, np.eye(3)[(along + 1) % 3])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    inertia = np.zeros((n, 3, 3))
    inertia[:, [0, 1, 2], [0, 1, 2]] = 10.0  # 1/(kg m^2): 1 kg, radius 0.5 m
    v_free = np.zeros((n, 6))
    v_free[:, :3] = rng.normal(scale=0.1, size=(n, 3)) - [0.0, 0.0, 0.1]
    rows = Rows(
        np.ones(n), inertia, v_free, normal=normal, tangent=tangent,
        arm_a=np.where(body[:, :1] >= 0, 0.5 * normal, 0.0), arm_b=-0.5 * normal, contact_body=body, copy=False,
    )  # fmt: skip
    return Problem.from_rows(rows, mu=0.5, tangents=2, name=f"lattice pile of {c} contacts")


def tridiagonal(m: int) -> Problem:
    """A stack of m unit masses, frictionless: 2 on the diagonal, -1 beside it."""
    import scipy.sparse as sp

    a = sp.diags_array([np.full(m - 1, -1.0), np.full(m, 2.0), np.full(m - 1, -1.0)], offsets=[-1, 0, 1])
    return Problem.lcp(sp.csr_array(a), np.full(m, 0.1))


# -- bare loops --------------------------------------------------------------------------------------


def bare_contacts(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Contacts and bodies of `problem` (two tangents each, no joints) as the records of `microbenchmarks.contact`."""
    rows, data = problem.rows, problem.data
    assert rows is not None
    contacts, bodies = (
        np.zeros(rows.n_contacts, microbenchmarks.CONTACT),
        np.zeros(rows.n_bodies + 1, microbenchmarks.BODY),
    )
    contacts["body"] = rows.contact_body + 1
    for name in ("normal", "tangent", "arm_a", "arm_b"):
        contacts[name] = getattr(rows, name)
    step = data.step.reshape(-1, 3)
    contacts["step"] = step[:, :2]
    contacts["rhs"] = problem.b.reshape(-1, 3)
    contacts["mu"] = problem.cones.mu
    bodies["inv_mass"][1:] = rows.inv_mass
    bodies["inv_inertia"][1:] = rows.inv_inertia.reshape(-1, 9)
    t2 = np.cross(rows.normal, rows.tangent)
    for side, arm in enumerate((rows.arm_a, rows.arm_b)):
        body = rows.contact_body[:, side]
        inertia = np.where((body >= 0)[:, None, None], rows.inv_inertia[body], 0.0)
        swing = np.einsum("cij,cj->ci", inertia, np.cross(arm, rows.normal))
        for i, t in enumerate((rows.tangent, t2)):
            contacts["coupling"][:, i] += np.einsum("ci,ci->c", np.cross(arm, t), swing)
    return contacts, bodies


def _bytes(array: np.ndarray) -> Any:
    return array.view(np.uint8).reshape(-1)


def contact_bytes(problem: Problem) -> float:
    """Bytes that a sweep of sequential impulses reads and writes for each contact, bodies left out."""
    rows, m, c = problem.rows, problem.m, problem.n_blocks
    assert rows is not None
    given = sum(x.nbytes for x in (rows.normal, rows.tangent, rows.arm_a, rows.arm_b, rows.contact_body))
    # per row: swing, compliance, b, step, impulse (read, written); per contact: coupling, mu, order, ptr, kind
    return (given + m * 8 * (6 + 3 + 2) + c * (5 * 8 + 8 + 3 * 4)) / c


def csr_bytes(problem: Problem) -> float:
    """Bytes of a sweep over A for each entry: value and column, then b, step, bounds, impulse and start of a row."""
    return 12.0 + problem.m * (6 * 8 + 4) / problem.csr.nnz


# -- cases -------------------------------------------------------------------------------------------

_ADD = 64  # sweeps beyond which an iterate moves by nothing: timing goes on from there


def _sweeps(
    problem: Problem, name: str, n: int, **options: Any
) -> tuple[Callable[[], Any], Prepared, FloatArray]:
    prepared = prepare(problem, name, **options)
    lam = problem.start()
    prepared._solver.run(prepared._state, lam, _ADD, 0.0)
    return partial(prepared._solver.run, prepared._state, lam, n, 0.0), prepared, lam


def _count(work: float) -> int:
    return max(4, int(2e5 / work))  # sweeps of one call: a Python call is then nothing


def _impulses(contacts: int, seconds: float, shuffle: bool = False, **options: Any) -> Row:
    problem = lattice_pile(contacts, shuffle=shuffle)
    c = problem.n_blocks
    n = _count(20 * c)
    ours, _, lam = _sweeps(problem, "sequential_impulses", n, **options)
    records, bodies = bare_contacts(problem)
    raw = _bytes(records), _bytes(bodies)
    microbenchmarks.contact(*raw, _ADD)
    time, bare = least(ours, partial(microbenchmarks.contact, *raw, n), seconds=seconds)
    label = "sequential impulses" + "".join(f", {v}" for v in options.values())
    return Row(
        label, f"{c} contacts" + (" shuffled" if shuffle else ""), "contact", c, time / n, contact_bytes(problem),
        bare / n, "bare", residual(problem, lam).relative,
    )  # fmt: skip


def _threads(contacts: int, seconds: float, threads: int = 2) -> Row:
    problem = lattice_pile(contacts)
    c = problem.n_blocks
    n = max(1, int(1e-2 / (c * 25e-9)))  # about 10 ms: what the front door hands over at once is 25
    calls = [_sweeps(problem, "sequential_impulses", n, order="colored", threads=t) for t in (1, threads)]
    one, many = least(calls[0][0], calls[1][0], seconds=4 * seconds, clock=_wall)
    return Row(
        f"colored, {threads} threads (wall)", f"{c} contacts", "contact", c, many / n, contact_bytes(problem),
        one / n / threads, f"1 thread / {threads}", residual(problem, calls[1][2]).relative,
    )  # fmt: skip


def _wall() -> int:
    return int(perf_counter() * 1e9)


def _matrix(problem: Problem, size: str, name: str, seconds: float, bare: bool) -> Row:
    nnz = problem.csr.nnz
    n = _count(nnz)
    ours, _, lam = _sweeps(problem, name, n)
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
        name, size, "entry of A", nnz, times[0] / n, per, limit, "bare" if bare else "stream",
        residual(problem, lam).relative,
    )  # fmt: skip


def _frictionless(contacts: int) -> Problem:
    pile = lattice_pile(contacts)
    assert pile.rows is not None
    smooth = Problem.from_rows(pile.rows)
    return Problem.lcp(smooth.delassus(), smooth.b)


def _block_sweep(contacts: int, seconds: float) -> Row:
    problem = lattice_pile(contacts)
    c = problem.n_blocks
    n = _count(100 * c)
    ours, _, lam = _sweeps(problem, "block_gauss_seidel", n)
    time = least(ours, seconds=seconds)[0]
    per = contact_bytes(problem)
    return Row(
        "block_gauss_seidel", f"{c} contacts", "contact", c, time / n, per, stream_time(per * c), "stream",
        residual(problem, lam).relative,
    )  # fmt: skip


def _judge(contacts: int, seconds: float) -> Row:
    problem = lattice_pile(contacts)
    c, m = problem.n_blocks, problem.m
    lam, w, e = solve(problem, "sequential_impulses", tol=0.0, max_iter=8).impulse, np.empty(m), np.empty(m)
    time = least(lambda: measure.judge(problem.data, lam, w, e, False), seconds=seconds)[0]
    per = contact_bytes(problem) - 6 * 24.0  # no swing
    return Row(
        "residual", f"{c} contacts", "contact", c, time, per, stream_time(per * c), "stream",
        residual(problem, lam).relative,
    )  # fmt: skip


def _assembly(contacts: int, seconds: float) -> Row:
    problem = lattice_pile(contacts)
    data = problem.data
    bound = assemble.bound(data)
    nnz = problem.csr.nnz
    time = least(lambda: assemble.delassus(data, *bound), seconds=seconds)[0]
    per = 12.0 + (contact_bytes(problem) + 6 * 96) * problem.n_blocks / nnz
    return Row(
        "assembly of A",
        f"{problem.n_blocks} contacts",
        "entry of A",
        nnz,
        time,
        per,
        stream_time(per * nnz),
        "stream",
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
    state = simulation._state.copy()
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
        state.take(simulation._state)
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
    sweeps, _, _ = _sweeps(problem, "pgs", 8)
    solution = solve(problem, "pgs", tol=0.0, max_iter=8)
    call, kernel = least(lambda: solve(problem, "pgs", tol=0.0, max_iter=8), sweeps, seconds=seconds)
    return Row(
        "lv.solve, 8 sweeps of pgs", f"{m} rows", "call", 1, call, limit=kernel, limit_name="kernel alone",
        residual=solution.residual.relative,
    )  # fmt: skip


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
        "pgs": lambda s: _matrix(_frictionless(1_000), "1,000 rows", "pgs", s, True),
        "pgs-100k": lambda s: _matrix(_frictionless(100_000), "100,000 rows", "pgs", s, True),
        "pgs-tridiagonal": lambda s: _matrix(tridiagonal(2_000), "tridiagonal, 2,000", "pgs", s, True),
        "pgs-tridiagonal-1m": lambda s: _matrix(tridiagonal(1_000_000), "tridiagonal, 10^6", "pgs", s, True),
        "jacobi": lambda s: _matrix(_frictionless(1_000), "1,000 rows", "jacobi", s, False),
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
        ours, _, _ = _sweeps(problem, "sequential_impulses", n)
        raw = tuple(map(_bytes, bare_contacts(problem)))
        microbenchmarks.contact(*raw, _ADD)
        sweep, bare = least(ours, partial(microbenchmarks.contact, *raw, n), seconds=seconds)
        yield {
            "contacts": c, "build": build, "solve": took, "residual": solution.residual.relative,
            "sweep": 1e9 * sweep / n / c, "bare": 1e9 * bare / n / c, "megabytes": peak,
        }  # fmt: skip


# -- instructions ------------------------------------------------------------------------------------

_COUNT = """
import sys
from lavender.bench import kernels
name, n = sys.argv[1], int(sys.argv[2])
call, work = kernels.counted(name)
call()
for _ in range(n):
    call()
"""
COUNTED = ("impulses", "pgs", "pgs-tridiagonal", "jacobi", "block", "judge", "solve-8")


def counted(name: str) -> tuple[Callable[[], Any], float]:
    """A call of a case and its work, for counting instructions."""
    if name == "solve-8":
        j = np.random.default_rng(8).normal(size=(8, 10))
        problem = Problem.lcp(j @ j.T, np.ones(8))
        return lambda: solve(problem, "pgs", tol=0.0, max_iter=8), 1.0
    if name == "judge":
        problem = lattice_pile(1_000)
        lam, w, e = problem.start() + 0.01, np.empty(problem.m), np.empty(problem.m)
        return lambda: measure.judge(problem.data, lam, w, e, False), float(problem.n_blocks)
    solver = {"impulses": "sequential_impulses", "block": "block_gauss_seidel"}.get(
        name, name.partition("-")[0]
    )
    if solver in ("pgs", "jacobi"):
        problem = tridiagonal(2_000) if name.endswith("tridiagonal") else _frictionless(1_000)
        return _sweeps(problem, solver, 1)[0], float(problem.csr.nnz)
    problem = lattice_pile(1_000)
    return _sweeps(problem, solver, 1)[0], float(problem.n_blocks)


def instructions(name: str, calls: int = 50) -> float:
    """Instructions of a unit of a case, by callgrind: the difference of two runs, about a minute.

    Raises
    ------
    SolverUnavailable
        valgrind is not installed.
    InputError
        The case is not one of `COUNTED`, or valgrind failed.
    """
    if name not in COUNTED:
        raise InputError(f"instructions of {name!r} are not counted; of {', '.join(COUNTED)} they are")
    if shutil.which("valgrind") is None:
        raise SolverUnavailable("counting instructions needs valgrind (Debian: apt install valgrind)")
    totals = []
    with tempfile.TemporaryDirectory() as folder:
        for n in (0, calls):
            out = Path(folder, f"{n}.out")
            done = subprocess.run(
                [
                    "valgrind", "--tool=callgrind", f"--callgrind-out-file={out}",
                    sys.executable, "-c", _COUNT, name, str(n),
                ],
                capture_output=True,
                text=True,
                check=False,
                env={**_environment(), "PYTHONHASHSEED": "0"},
            )  # fmt: skip
            found = re.search(
                r"^(?:summary|totals):\s*(\d+)", out.read_text() if out.exists() else "", re.MULTILINE
            )
            if done.returncode or not found:
                raise InputError(f"valgrind failed on {name}: {done.stderr.strip()[-300:]}")
            totals.append(int(found[1]))
    return (totals[1] - totals[0]) / (calls * counted(name)[1])


def _environment() -> dict[str, str]:
    import os

    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


# -- printing ----------------------------------------------------------------------------------------


def _number(x: float, form: str = "{:.3g}") -> str:
    return "-" if x != x else form.format(x)


def table(rows: Sequence[Row]) -> list[str]:
    """Lines of a Markdown table."""
    lines = [
        "| case | size | time | unit | ns / unit | bytes / unit | instructions / unit | limit | share | residual |",
        "|---|---|---:|---|---:|---:|---:|---|---:|---:|",
    ]
    for r in rows:
        micro = 1e6 * r.seconds
        time = f"{micro:.2f} us" if micro < 1e3 else f"{micro / 1e3:.2f} ms"
        limit = r.limit_name and f"{r.limit_name} {1e9 * r.limit / r.work:.3g} ns"
        lines.append(
            f"| {r.case} | {r.size} | {time} | {r.unit} | {r.per_unit:.3g} | {_number(r.bytes, '{:.0f}')} | "
            f"{_number(r.instructions)} | {limit} | {_number(r.share, '{:.2f}')} | {_number(r.residual, '{:.1e}')} |"
        )
    return lines


def limits_table(found: Sequence[Limit]) -> list[str]:
    """Lines of a Markdown table of the machine's limits."""
    kinds = ("read", "triad", "chase")
    value = {(x.name, x.kib): x for x in found}
    lines = ["| footprint | read | triad | dependent load |", "|---:|---:|---:|---:|"]
    for kib in FOOTPRINTS:
        cells = [f"{value[k, kib].value:.3g} {value[k, kib].unit}" for k in kinds]
        lines.append(f"| {kib:,} KiB | " + " | ".join(cells) + " |")
    return [*lines, "", f"dependent product and sum: {value['chain', 0].value:.2f} ns"]


def scaling_table(rows: Sequence[dict[str, float]]) -> list[str]:
    """Lines of a Markdown table of `scaling`."""
    lines = [
        "| contacts | build s | 100 sweeps s | residual | ns / contact and sweep | bare ns | share | MB |",
        "|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    return lines + [
        f"| {r['contacts']:,.0f} | {r['build']:.3f} | {r['solve']:.3f} | {r['residual']:.1e} | {r['sweep']:.1f} | "
        f"{r['bare']:.1f} | {r['bare'] / r['sweep']:.2f} | {r['megabytes']:.0f} |"
        for r in rows
    ]


@click.command("kernels")
@click.argument("cases", nargs=-1, metavar="[CASES]...")
@click.option("--seconds", default=0.2, show_default=True, metavar="S", help="Time for each case.")
@click.option(
    "--largest",
    default=1_000_000,
    show_default=True,
    help="Contacts of the scaling table's last row; 0: no table.",
)
@click.option(
    "--instructions", "count", is_flag=True, help="Count instructions by valgrind's callgrind, minutes."
)
@click.option("--out", type=click.Path(path_type=Path), default=None, help="Write every row here too, JSON.")
def command(cases: tuple[str, ...], seconds: float, largest: int, count: bool, out: Path | None) -> None:
    """Kernels, small calls and whole jobs beside the limits of this machine, measured in the same run.

    CASES are names; without them all of them, then piles of growing size.
    """
    found: list[Row] = []
    click.echo(f"{machine.cpu_name()}\n")
    names = cases or CASES
    list(run(names=[n for n in names if n not in CASES]))  # a wrong name ends it here
    bounds = measure_limits()
    click.echo("\n".join(limits_table(bounds)) + "\n")
    for name in names:
        click.echo(name, err=True)
        rows = list(run([name], seconds=seconds))
        if count and name in COUNTED:
            rows = [replace(r, instructions=instructions(name)) for r in rows]
        found += rows
    click.echo("\n".join(table(found)))
    growth: list[dict[str, float]] = []
    if largest and not cases:
        sizes = [s for s in (1_000, 10_000, 100_000, 1_000_000) if s < largest] + [largest]
        growth = list(scaling(sizes, seconds=max(seconds, 0.5)))
        click.echo("\n" + "\n".join(scaling_table(growth)))
    if out is not None:
        import json

        record = {
            "cpu": machine.cpu_name(), "versions": machine.versions(), "limits": [asdict(x) for x in bounds],
            "rows": [asdict(r) | {"ns_per_unit": r.per_unit, "share": r.share} for r in found], "scaling": growth,
        }  # fmt: skip
        out.write_text(json.dumps(record, indent=1))
