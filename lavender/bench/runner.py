"""Every solver on every case: serial, timed, each record kept the moment it is made."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lavender import registry
from lavender.bench import machine
from lavender.bench.cases import Item, Source, describe, resolve
from lavender.bench.plan import Plan
from lavender.bench.record import CaseInfo, Record, Run, Skip
from lavender.bench.store import Records, Store
from lavender.bench.timing import Task, measure
from lavender.bench.worker import Worker
from lavender.errors import LavenderError
from lavender.problem import Problem
from lavender.registry import SolverSpec

__all__ = ["Event", "run", "solver_names"]

Watch = Callable[["Event"], Any]


@dataclass(frozen=True)
class Event:
    """What a watcher (a progress bar) is told: pairs of case and solver done, of how many."""

    done: int
    total: int
    case: str
    solver: str
    record: Record | None = None
    reused: bool = False


def is_foreign(spec: SolverSpec) -> bool:
    """Code that other packages brought, which a process of its own can import."""
    return (
        spec.external
        or bool(spec.requires)
        or (isinstance(spec.factory, str) and not spec.factory.startswith("lavender."))
    )


def solver_names(names: Sequence[str] | None) -> list[str]:
    """The solvers to run: those named, each of them installed; or every one that is installed.

    Raises
    ------
    UnknownName, SolverUnavailable
    """
    if names:
        for name in names:
            registry.get(name)
        return list(dict.fromkeys(names))
    return [name for name, spec in sorted(registry.specs().items()) if spec.missing() is None]


def run(
    cases: Iterable[Source] = (),
    solvers: Sequence[str] | None = None,
    plan: Plan | None = None,
    store: Store | str | Path | None = None,
    *,
    watch: Watch | None = None,
    isolate: bool = True,
    memory: int | None = None,
    into: list[Records] | None = None,
) -> Records:
    """Measure every solver that takes a case, on every case.

    Parameters
    ----------
    cases : files, folders, names of the suite, problems; all of `lavender.suite.default()` if none
    solvers : names; every installed one if None. One that refuses a case is skipped with its reason.
    plan : Plan
    store : Store or path of a `.jsonl` file, optional
        Keeps each record when it is made; a measurement that it holds already, from the same machine,
        versions and plan, is not made again.
    watch : callable (Event), optional
    isolate : run solvers that other packages bring in a process of their own
    memory : bytes, optional
        Limit of that process.
    into : list, optional
        Receives the records before the first is made, for those who stop the run and want what there is.

    Returns
    -------
    Records
        Of this run: those made and those found.
    """
    plan = plan or Plan()
    items = resolve(cases)
    names = solver_names(solvers)
    specs = registry.specs()
    packages = {module for name in names for module in specs[name].requires}
    this = machine.describe(plan.as_dict(), packages)
    if store is not None and not isinstance(store, Store):
        with Store(store) as opened:
            return run(items, names, plan, opened, watch=watch, isolate=isolate, memory=memory, into=into)
    with Worker(memory) as worker:
        runner = _Runner(this, plan, names, store, watch, worker if isolate else None)
        if into is not None:
            into.append(runner.out)
        return runner.run(items)


class _Runner:
    def __init__(
        self,
        this: Run,
        plan: Plan,
        names: list[str],
        store: Store | None,
        watch: Watch | None,
        worker: Worker | None,
    ) -> None:
        self.this, self.plan, self.names, self.store, self.watch, self.worker = (
            this,
            plan,
            names,
            store,
            watch,
            worker,
        )
        self.specs = registry.specs()
        self.out = Records(source=str(store.path) if store else "")
        self.done = 0
        self.total = 0
        self.known: dict[Any, Record] = {}
        self.skipped: set[tuple[str, str]] = set()
        if store is not None:
            self.known = {r.key: r for r in store.records.records if r.run == this.run}
            self.skipped = {(s.case, s.solver) for s in store.records.skips if s.run == this.run}

    def keep(self, entry: Run | CaseInfo | Skip | Record) -> None:
        self.out.add(entry)
        if self.store is not None:
            self.store.add(entry)

    def tell(self, case: str, solver: str, record: Record | None = None, reused: bool = False) -> None:
        if self.watch is not None:
            self.watch(Event(self.done, self.total, case, solver, record, reused))

    def run(self, items: list[Item]) -> Records:
        self.total = len(items) * len(self.names)
        self.keep(self.this)
        for item in items:
            try:
                info = describe(item, self.this.run)
            except (LavenderError, OSError) as error:
                self.keep(Skip(self.this.run, item.name, "", _not_loaded(item, error)))
                self.done += len(self.names)
                self.tell(item.name, "")
                continue
            self.keep(info)
            for name in self.names:
                self.tell(item.name, name)
                self.pair(info, item.problem, name)
                self.done += 1
            item.forget()
        self.tell("", "")
        return self.out

    def pair(self, info: CaseInfo, problem: Problem, name: str) -> None:
        spec = self.specs[name]
        reason = spec.refuses(problem)
        if reason:
            self.keep(Skip(self.this.run, info.case, name, reason))
            return
        isolated = self.worker is not None and is_foreign(spec)
        tasks = self.plan.tasks(info, problem, spec)
        record: Record | None = None
        while True:
            try:
                task = tasks.send(record)  # type: ignore[attr-defined]
            except StopIteration:
                return
            found = self.known.get(task.key)
            if found is not None:
                record = found
                self.out.add(record)
            else:
                record = self.make(problem, task, isolated)
                self.keep(record)
            self.tell(info.case, name, record, found is not None)

    def make(self, problem: Problem, task: Task, isolated: bool) -> Record:
        if isolated and self.worker is not None:
            return self.worker.measure(replace(problem, copy=False), task)
        return measure(problem, task)


def _not_loaded(item: Item, error: Exception) -> str:
    text = str(error)
    return f"did not load: {text}" if text.startswith(item.source) else f"did not load: {item.source}: {text}"
