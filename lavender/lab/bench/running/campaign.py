"""Error and robustness over thousands of cases: no timing, many workers, the same bits whatever their number.

joblib distributes the pairs of case and solver: over processes of this machine, or over a cluster that
runs already, by joblib's own backends ("dask", "ray"). Nothing in a record depends on who made it: runs
end by iterations, never by the clock, and times are left out.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from lavender.base.arrays import several, whole_number
from lavender.base.errors import InputError
from lavender.lab.bench import machine
from lavender.lab.bench.cases import Item, Source, describe, fingerprint, is_path, resolve
from lavender.lab.bench.record import CaseInfo, Done, Record, Run, Skip
from lavender.lab.bench.running.plan import Plan
from lavender.lab.bench.running.runner import Event, Runner, Watch, is_foreign, not_loaded, solver_names
from lavender.lab.bench.running.timing import Task, one_thread
from lavender.lab.bench.running.worker import Worker
from lavender.lab.bench.store import Records, Store, opened
from lavender.lab.suite.case import FAMILIES, parse
from lavender.problem import Problem
from lavender.solvers import registry
from lavender.solvers.registry import SolverSpec

MOST_SEEDS = 1_000_000  # of a family in one run: a case's name and place take a kilobyte
MOST_WORKERS = 4096  # processes: more than any machine has cores for
ATTEMPTS = 5  # times that the remaining pairs are handed out again after workers were lost
HANDFUL = 256  # pairs handed out together to a backend that cannot give results one by one
CONNECT = 10.0  # s, for a scheduler to answer
WATCH = 0.5  # s between looks at whether the parent is still there
HANG = 60.0  # s, after which a backend of another package is killed; the only clock, and it costs its record


@dataclass(frozen=True)
class CampaignPlan(Plan):
    """A plan that ends by iterations: `cap` for runs to a level, in place of a time limit."""

    repeats: int = 1
    time_limit: float = HANG
    cap: int = 20_000
    campaign: bool = True
    way = ""  # nothing is timed


@dataclass(frozen=True)
class Pair:
    """One case and one solver; what travels to a worker."""

    index: int
    case: str
    source: str | Problem  # a name or path that the worker resolves itself, or the problem
    reason: str
    solver: str


@dataclass(frozen=True)
class Order:
    """What every worker is told beside its pair."""

    plan: CampaignPlan
    run: Run
    memory: int | None  # bytes of each backend's process; a share of the machine it runs on if None
    registered: tuple[SolverSpec, ...] = ()  # those that no worker finds by itself


def seeds(words: Iterable[str], n: int, first: int = 0) -> list[str]:
    """Cases with seed=first .. first + n - 1, where their family takes a seed; others, sets and files, once.

    Raises
    ------
    UnknownName, InputError
        A name that the suite does not have; more than a million seeds, each of which is a case with a name.
    """
    n, first = whole_number("n", n, high=None), whole_number("first", first, high=None)
    if n > MOST_SEEDS:
        raise InputError(
            f"{n} seeds are asked for; at most {MOST_SEEDS} in one run: give A:B, part after part"
        )
    out = []
    for word in several("cases", words, "names"):
        if not isinstance(word, str):
            raise InputError(f"case {word!r:.60} is no name of the suite")
        if is_path(word) or word.startswith("@"):
            out.append(word)
            continue
        name, given = parse(word)
        if name in FAMILIES and "seed" in FAMILIES[name].signature.parameters and "seed" not in given:
            for seed in range(first, first + n):
                inside = ", ".join(f"{k}={v}" for k, v in {**given, "seed": seed}.items())
                out.append(f"{name}({inside})")
        else:
            out.append(word)
    return out


def campaign(
    cases: Iterable[Source],
    solvers: Sequence[str] | None = None,
    plan: CampaignPlan | None = None,
    store: Store | str | Path | None = None,
    *,
    workers: int = -1,
    backend: str = "loky",
    watch: Watch | None = None,
    memory: int | None = None,
) -> Records:
    """Run every solver on every case, without timing, by many workers.

    Parameters
    ----------
    cases, solvers, store, watch : as `lavender.lab.bench.run`
    plan : CampaignPlan
    workers : number of processes; -1: one for each core. A cluster has as many as it has.
    backend : a backend of joblib: "loky" (processes here), "dask" (of the current dask.distributed client,
        or of DASK_SCHEDULER_ADDRESS), "ray"; "dask=ADDRESS" and "ray=ADDRESS" connect to a cluster
    memory : bytes, optional
        Limit of each process of a backend of another package; half of its machine's memory, shared by the workers
        here or by the cores of a machine of a cluster, if None.

    Returns
    -------
    Records
        In the order of cases and solvers, whatever the order they were made in; times are nan.

    Raises
    ------
    InputError
        A backend that joblib does not have here, another number of workers than -1 or 1 to 4096, or workers that were
        lost again and again.
    """
    import joblib

    check_workers(workers)
    plan = plan or CampaignPlan()
    items = resolve(cases)
    names = solver_names(solvers)
    specs = registry.specs()
    this = machine.describe(
        {**plan.as_dict(), "campaign": True}, {m for n in names for m in specs[n].requires}
    )
    # A name or path is read again by the worker: a cluster shares the files, or the suite.
    travels = [item.source if item.given is None else replace(item.given, copy=False) for item in items]
    pairs = [
        Pair(len(names) * i + j, item.name, travels[i], item.reason, name)
        for i, item in enumerate(items)
        for j, name in enumerate(names)
    ]
    here = tuple(specs[n] for n in names if not (specs[n].own or specs[n].plugged))
    out = Records()
    name, cluster = connected(backend)
    if name == "loky" and memory is None:
        memory = machine.memory_share(joblib.effective_n_jobs(workers))
    order = Order(plan, this, memory, here)
    with cluster, opened(store) as kept:
        known = {} if kept is None else _finished(kept.records, this.run, items)
        out.source = str(kept.path) if kept is not None else ""
        done = {p.index: known[p.case, p.solver] for p in pairs if (p.case, p.solver) in known}
        out.add(this)
        _keep(kept, [replace(this, whole=False)])
        for attempt in range(ATTEMPTS + 1):
            left = [p for p in pairs if p.index not in done]
            if not left:
                break
            if attempt == ATTEMPTS:
                raise InputError(
                    f"{len(left)} of {len(pairs)} pairs are not done: workers were lost {ATTEMPTS} times; "
                    "run the same command again, with fewer workers if memory is short"
                )
            for index, entries in hand_out(work, ((pair, order) for pair in left), workers, name):
                done[index], pair = entries, pairs[index]
                sha = next((e.sha for e in entries if isinstance(e, CaseInfo)), "")
                _keep(kept, [*entries, Done(this.run, pair.case, pair.solver, sha)])
                if watch is not None:
                    watch(Event(len(done), len(pairs), pair.case, pair.solver))
        _keep(kept, [this])
    for index in sorted(done):
        for entry in done[index]:
            out.add(entry)
    return out


def _keep(store: Store | None, entries: Iterable[Any]) -> None:
    if store is not None:
        for entry in entries:
            store.add(entry)


def check_workers(workers: Any) -> None:
    """InputError for another number of workers than -1 or 1 to 4096."""
    whole = isinstance(workers, int) and not isinstance(workers, bool)
    if not whole or not (workers == -1 or 1 <= workers <= MOST_WORKERS):
        raise InputError(
            f"workers is {workers!r}; -1 (one for each core) or a whole number from 1 to {MOST_WORKERS} is needed"
        )


def _finished(records: Records, run: str, items: Iterable[Item]) -> dict[tuple[str, str], list[Any]]:
    """Entries of the pairs that the file holds whole, by (case, solver); not those of problems that have changed."""
    of: dict[str, dict[str, str]] = {}
    for (begun, case, solver), done in records.done.items():
        if begun == run:
            of.setdefault(case, {})[solver] = done.sha
    closed = {}
    for item in items:
        pairs = of.get(item.name, {})
        now = _sha(item) if pairs else None
        same = not now or (item.name in records.cases and records.cases[item.name].sha == now)
        closed.update(
            {(item.name, s): sha for s, sha in pairs.items() if now is None or (same and sha == now)}
        )
    found: dict[tuple[str, str], dict[Any, Any]] = {key: {} for key in closed}
    for case, solver in closed:
        if case in records.cases:
            found[case, solver]["case"] = records.cases[case]
    for skip in records.skips:
        for key in closed if not skip.solver else ((skip.case, skip.solver),):
            if skip.run == run and key in closed and key[0] == skip.case:
                found[key]["skip"] = skip
    for r in records.records:
        if r.run == run and closed.get((r.case, r.solver)) == r.sha:
            found[r.case, r.solver][r.key] = r  # written again after a kill: the later one
    return {key: list(entries.values()) for key, entries in found.items()}


def _sha(item: Item) -> str | None:
    """What a file or a problem in memory is now, "" where it does not load; None of the suite: a run names its code."""
    if item.given is None and not is_path(item.source):
        return None
    try:
        return fingerprint(item.problem)
    except Exception:  # a file may make a reader raise anything
        return ""
    finally:
        item.forget()


def hand_out(
    function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], workers: int, backend: str
) -> Iterator[Any]:
    """What a function makes of each of its arguments, as it comes, by the backend that `connected` named.

    Ends early, without an exception, when workers were lost.
    """
    import joblib

    lost: tuple[type[BaseException], ...] = (BrokenPipeError, ConnectionError)
    with contextlib.suppress(ImportError):
        from joblib.externals.loky.process_executor import BrokenProcessPool

        lost = (*lost, BrokenProcessPool)
    with contextlib.suppress(ImportError):
        from distributed.client import FutureCancelledError
        from distributed.scheduler import KilledWorker

        lost = (*lost, KilledWorker, FutureCancelledError)
    parent = os.getpid() if backend == "loky" else 0  # 0: workers belong to a cluster
    with joblib.parallel_config(backend=backend, n_jobs=workers):
        calls = (joblib.delayed(_led)(parent, function, given) for given in arguments)
        try:
            try:
                parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1)
            except ValueError:  # ray's backend gives whole lists alone: in rounds, each kept when it is done
                parallel = joblib.Parallel(batch_size=1)
                while some := list(itertools.islice(calls, HANDFUL)):
                    yield from parallel(some)
                return
            with _deaf() if hasattr(signal, "pthread_sigmask") else contextlib.nullcontext():
                found = parallel(calls)
            try:
                for made in found:  # noqa: UP028 - which would close it before this does
                    yield made
            except GeneratorExit:
                with warnings.catch_warnings():  # joblib's, of what it cancels
                    warnings.simplefilter("ignore", UserWarning)
                    found.close()
                raise
        except lost:
            return


def _led(parent: int, function: Callable[..., Any], given: tuple[Any, ...]) -> Any:
    """One call in a worker, which ends with its parent."""
    if parent and parent != os.getpid():
        _end_with(parent)
    return function(*given)


@contextlib.contextmanager
def _deaf() -> Iterator[None]:
    """Processes that begin here hear no Ctrl-C, which a terminal sends to all; this one does, and ends them."""
    from joblib.externals.loky.backend import resource_tracker as lokys

    # Each begins once, and would leave this process hearing.
    resource_tracker.ensure_running()
    lokys.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def connected(word: str) -> tuple[str, contextlib.AbstractContextManager[Any]]:
    """The name by which joblib knows a backend, and what holds the connection to its cluster.

    Raises
    ------
    InputError
        A package is missing, nobody listens, or joblib does not know the name.
    """
    from joblib.parallel import BACKENDS

    name, _, address = word.partition("=")
    if name == "dask":
        return name, _dask(address)
    if name == "ray":
        _ray(address)
    elif name not in BACKENDS or address:
        raise InputError(
            f"joblib has no backend {word!r}: 'loky' runs processes on this machine, 'dask' or 'dask=ADDRESS' and "
            "'ray' or 'ray=ADDRESS' a cluster"
        )
    return name, contextlib.nullcontext()


def _dask(address: str) -> contextlib.AbstractContextManager[Any]:
    """A client of the scheduler, or nothing to hold where there is one already."""
    try:
        import dask
        import distributed
    except ImportError:
        raise InputError(
            "backend 'dask' needs distributed: pip install 'lavender-contact[cluster]'"
        ) from None
    address = address or dask.config.get("scheduler-address", "")
    try:
        if address:
            return distributed.Client(address, timeout=CONNECT)  # type: ignore[no-untyped-call]
        distributed.get_client()
    except (OSError, ValueError) as error:
        raise InputError(
            f"no dask scheduler answers at {address!r} ({error}); start one there"
            if address
            else "backend 'dask' needs a scheduler: give dask=tcp://HOST:8786, set DASK_SCHEDULER_ADDRESS, or make a "
            "distributed.Client first"
        ) from None
    return contextlib.nullcontext()


def _ray(address: str) -> None:
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError:
        raise InputError("backend 'ray' needs ray: pip install 'ray[default]'") from None
    if address and not ray.is_initialized():
        try:
            ray.init(address=address)
        except (ConnectionError, ValueError) as error:
            raise InputError(f"no ray cluster answers at {address!r} ({error}); start one there") from None
    register_ray()


_worker: Worker | None = None  # one for each process, kept between pairs


def work(pair: Pair, order: Order) -> tuple[int, list[Any]]:
    """All entries of one pair; runs in a worker, on one thread: the pairs are what runs side by side."""
    for spec in order.registered:
        registry.register(spec, replace=True)
    with one_thread(pair.solver):
        return _work(pair, order)


@cache
def _end_with(parent: int) -> None:
    """End this process soon after its parent was killed, whatever pair it is at."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH)
        os._exit(1)

    if hasattr(os, "getppid"):
        threading.Thread(target=watch, daemon=True).start()


class _WithoutTimes(Runner):
    """Pairs that end by iterations; the limit of a process is the only clock, for what other packages bring."""

    stands_in = False  # a pair that is done holds records of its own solver alone

    def make(self, problem: Problem, task: Task, spec: SolverSpec, impulse: Any) -> tuple[Record, Any]:
        assert isinstance(self.plan, CampaignPlan)
        if task.mode == "tol" and task.max_iter:
            task = replace(task, max_iter=min(task.max_iter, self.plan.cap))
        limit = self.plan.time_limit if is_foreign(spec) else math.inf
        record, found = super().make(problem, replace(task, time_limit=limit), spec, impulse)
        nan = math.nan
        record = replace(
            record, setup_min=nan, setup_median=nan, solve_min=nan, solve_median=nan, time_min=nan, time_median=nan,
            pace=None, load=None, own_min=None, time_limit=self.plan.time_limit,
        )  # fmt: skip
        return record, found


def _work(pair: Pair, order: Order) -> tuple[int, list[Any]]:
    global _worker
    try:
        problem, info = _look(pair, order.run.run)
    except Exception as error:  # a file may make a reader raise anything
        return pair.index, [Skip(order.run.run, pair.case, "", not_loaded(str(pair.source), error))]
    if _worker is None:
        shared = machine.memory_share(os.cpu_count() or 1)
        _worker = Worker(shared if order.memory is None else order.memory)
    runner = _WithoutTimes(order.run, order.plan, [pair.solver], None, None, _worker)
    runner.pair(info, problem, pair.solver)
    return pair.index, [info, *runner.out.skips, *runner.out.records]


_seen: tuple[Any, tuple[Problem, CaseInfo]] | None = None  # the case before: pairs of one case come together


def _look(pair: Pair, run: str) -> tuple[Problem, CaseInfo]:
    """The problem of a pair, and what the report says of it."""
    global _seen
    key: Any = None
    if not isinstance(pair.source, Problem):
        changed = os.stat(pair.source).st_mtime_ns if os.path.exists(pair.source) else 0
        key = (run, pair.case, pair.source, changed)
        if _seen is not None and _seen[0] == key:
            return _seen[1]
    (found,) = resolve([pair.source])
    item = Item(pair.case, found.source, found.load, pair.reason)
    looked = item.problem, describe(item, run)
    _seen = (key, looked) if key is not None else None
    return looked
