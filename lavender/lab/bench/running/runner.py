"""Every solver on every case: serial, timed, each record kept the moment it is made."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from lavender.base.arrays import FloatArray, several
from lavender.base.errors import LavenderError
from lavender.judge.solution import CONTRADICTED
from lavender.judge.states import states_of
from lavender.lab import motion
from lavender.lab.bench import machine
from lavender.lab.bench.cases import Item, Source, describe, resolve
from lavender.lab.bench.record import CaseInfo, Record, Run, Skip, asked_of
from lavender.lab.bench.running.plan import Plan, passes
from lavender.lab.bench.running.timing import Ask, Task, measure, one_thread
from lavender.lab.bench.running.worker import Worker
from lavender.lab.bench.store import Records, Store, opened
from lavender.lab.motion import load_reference
from lavender.lab.motion.bound import separation
from lavender.lab.motion.reference import as_reference
from lavender.lab.proof import enclosed
from lavender.problem import Problem, check_problem
from lavender.solvers import registry
from lavender.solvers.registry import SolverSpec

SEARCH = 6  # runs of the search for several motions, once for each Coulomb problem
QUICK = 0.05  # of the time limit: after a step that took less, the next is solved without a guard
SHORT_SEQUENCE = 20  # up to which the steps of a sequence are repeated; the sum over more evens out by itself

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


def carry(before: Problem, impulse: FloatArray, problem: Problem) -> FloatArray:
    """Start of `problem` (m,) [N s] from the impulses of the step before."""
    check_problem(problem)
    return problem.carry((before, impulse))


def with_motion(record: Record, problem: Problem, impulse: Any) -> Record:
    """The record with `motion`, `motion_speed` and `bound` of the impulses (m,) [N s] that came out, None without any.

    Outside every clock. The reference, and under Coulomb's law the motions that are found, are kept with `problem`.
    """
    if impulse is None:
        return record
    problem, impulse = problem.disk, problem.on_disk(impulse)
    found = motion.motions_of(problem, SEARCH) if problem.law == "coulomb" else None
    error = (
        motion.motion_error(problem, impulse) if found is None else motion.nearest(problem, impulse, found)
    )
    speed = error.rows if error.speed is None else error.speed
    told = replace(record, motion=error.relative, motion_speed=speed, bound=error.bound)
    reference = error.reference
    if (
        record.claims
        and record.status != "INFEASIBLE"
        and reference.enclosed
        and reference.witness is not None
    ):
        apart, allowed = separation(problem, as_reference(problem, impulse), reference)
        if apart > allowed:
            words = (
                f"says {record.status}, {apart:.1e} sqrt(J) from the exact solution, {allowed:.1e} allowed"
            )
            conflict = record.status_conflict or words
            return replace(told, claim_check=CONTRADICTED, status_conflict=conflict)
    return told


def with_answer(record: Record, problem: Problem, impulse: FloatArray) -> Record:
    """The record with what its impulses (m,) [N s] are: their bits, and how many blocks are at a boundary."""
    fraction = states_of(problem, impulse).boundary_fraction
    bits = hashlib.sha256(impulse.tobytes()).hexdigest()[:16]
    return replace(record, bits=bits, degenerate=fraction)


def is_foreign(spec: SolverSpec) -> bool:
    """Code that other packages brought, which a process of its own finds: what `register` alone knows is not there."""
    return spec.plugged or (spec.own and (spec.external or bool(spec.requires)))


def solver_names(names: str | Sequence[str] | None) -> list[str]:
    """The solvers to run: those named (or the one), each of them installed; or every one that is installed.

    Raises
    ------
    UnknownName, SolverUnavailable
    """
    if names:
        names = [names] if isinstance(names, str) else several("solvers", names, "names")
        for name in names:
            registry.get(name)
        return list(dict.fromkeys(names))
    return [name for name, spec in sorted(registry.specs().items()) if spec.missing() is None]


def run(
    cases: Source | Iterable[Source] = (),
    solvers: str | Sequence[str] | None = None,
    plan: Plan | None = None,
    store: Store | str | Path | None = None,
    *,
    watch: Watch | None = None,
    isolate: bool = True,
    memory: int | None = None,
    into: list[Records] | None = None,
    fresh: bool = False,
) -> Records:
    """Measure every solver that takes a case, on every case.

    Parameters
    ----------
    cases : files, folders, names of the suite, problems; all of `lavender.lab.suite.default()` if none
    solvers : names; every installed one if None. One that refuses a case is skipped with its reason; where another
        is the same method with bounds (`pgs` for `gauss_seidel`), that one is run.
    plan : Plan
    store : Store or path of a `.jsonl` file, optional
        Keeps each record when it is made; a measurement that it holds already, from the same machine,
        versions and plan, is not made again.
    watch : callable (Event), optional
    isolate : run solvers that other packages bring in a process of their own
    memory : bytes, optional
        Limit of that process; half of the machine's memory if None.
    into : list, optional
        Receives the records before the first is made, for those who stop the run and want what there is.
    fresh : measure again what `store` holds already

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
    with opened(store) as kept, Worker(memory) as worker:
        runner = Runner(this, plan, names, kept, watch, worker if isolate else None)
        if fresh:
            runner.known = {}
        if into is not None:
            into.append(runner.out)
        with one_thread():  # describing a case computes too
            return runner.run(items)


class Runner:
    """Pairs of case and solver, one after the other: what is known is not made again, what is made is kept."""

    stands_in = True  # a solver of free rows is run as the one that is the same method with bounds

    def __init__(
        self,
        this: Run,
        plan: Plan,
        names: list[str],
        store: Store | None,
        watch: Watch | None,
        worker: Worker | None,
    ) -> None:
        self.this, self.plan, self.names = this, plan, names
        self.store, self.watch, self.worker = store, watch, worker
        self.specs = registry.specs()
        self.out = Records(source=str(store.path) if store else "")
        self.done = 0
        self.total = 0
        self.known: dict[Any, Record] = {}
        if store is not None:
            self.known = {r.key: r for r in store.records.records if r.run == this.run}

    def keep(self, entry: Run | CaseInfo | Skip | Record) -> None:
        """Add an entry to what is returned and to what is stored."""
        self.out.add(entry)
        if self.store is not None:
            self.store.add(entry)

    def tell(self, case: str, solver: str, record: Record | None = None, reused: bool = False) -> None:
        """Tell whoever watches how far it is."""
        if self.watch is not None:
            self.watch(
                Event(
                    done=self.done, total=self.total, case=case, solver=solver, record=record, reused=reused
                )
            )

    def run(self, items: list[Item]) -> Records:
        """Measure every case and sequence."""
        self.total = len(items) * len(self.names)
        self.keep(replace(self.this, whole=False))
        for name, group in _sequences(items):
            if name:
                self.sequence(group)
            else:
                self.single(group[0])
        self.keep(self.this)
        self.tell("", "")
        return self.out

    def look(self, item: Item) -> CaseInfo | None:
        """Load and describe a case; None, with a note, where it does not load. Steps are kept by `sequence`."""
        try:
            info = describe(item, self.this.run)
            if self.plan.motion:
                load_reference(item.problem, item.source)
            if self.plan.prove:
                found = enclosed(item.problem)
                told = f"within {found.velocity_radius:.1e} m/s" if found.proven else f"none: {found.reason}"
                info = replace(info, proof=told)
        except Exception as error:  # a file may make a reader raise anything; it costs its own case
            self.keep(Skip(self.this.run, item.name, "", not_loaded(item.source, error), item.sequence))
            self.done += len(self.names)
            self.tell(item.name, "")
            return None
        if not item.sequence:
            self.keep(info)
        return info

    def single(self, item: Item) -> None:
        """Every solver on a case that is no step of a sequence."""
        info = self.look(item)
        if info is None:
            return
        for name in self.names:
            self.tell(item.name, name)
            self.pair(info, item.problem, name)
            self.done += 1
        item.forget()

    def sequence(self, items: list[Item]) -> None:
        """Every solver, every pass (a budget or a level, cold or carried), step after step."""
        infos = [self.look(item) for item in items]
        identity = hashlib.sha256("".join(i.sha for i in infos if i is not None).encode()).hexdigest()[:16]
        steps = [
            (item, replace(info, identity=identity))
            for item, info in zip(items, infos, strict=True)
            if info is not None
        ]
        for _, info in steps:
            self.keep(info)
        for name in self.names:
            spec = self.taking(items[0].sequence, name, [item for item, _ in steps])
            if spec is not None:
                for ask in passes(self.plan, spec):
                    self.tell(items[0].sequence, spec.name)
                    self.run_pass(steps, spec, ask)
            self.done += len(steps)
        for item in items:
            item.forget()

    def run_pass(self, steps: list[tuple[Item, CaseInfo]], spec: SolverSpec, ask: Ask) -> None:
        """One pass. It ends where its steps have taken `Plan.pass_limit` together, and a note says so."""
        repeats = self.plan.repeats if len(steps) <= SHORT_SEQUENCE else 1
        tasks = [Task.of(info, ask, repeats=repeats, time_limit=self.plan.time_limit) for _, info in steps]
        problems = [item for item, _ in steps]
        limit, spent, made = self.plan.pass_limit, 0.0, 0
        for task in tasks:
            record = self.known.get(task.key)
            if record is None or spent > limit:
                break
            spent, made = spent + _cost(record), made + 1
            self.out.add(record)
            self.tell(task.case, spec.name, record, True)
        before: tuple[Problem, FloatArray] | None = None
        if ask.start == "carried" and 0 < made < len(tasks) and spent <= limit:
            # Stopped on the way: the impulses of the last step come from the same steps again, unrecorded.
            for item, task in zip(problems[:made], tasks, strict=False):
                again = replace(task, repeats=1)
                before = self.step(item.problem, again, spec, before)[1]
        while made < len(tasks) and spent <= limit:
            task = tasks[made]
            if record is not None and record.times and record.time_median < QUICK * self.plan.time_limit:
                task = replace(task, guarded=False)
            record, before = self.step(problems[made].problem, task, spec, before)
            self.keep(record)
            self.tell(record.case, spec.name, record)
            spent, made = spent + _cost(record), made + 1
        if made < len(tasks):
            asked = asked_of(ask.mode, ask.tol, ask.max_iter)
            reason = (
                f"stopped after {made} of {len(tasks)} steps, which took more than the pass limit of {limit:.3g} s "
                "together (--pass-limit)"
            )
            self.keep(Skip(self.this.run, f"{problems[0].sequence}, {asked}, {ask.start}", spec.name, reason))

    def step(
        self, problem: Problem, task: Task, spec: SolverSpec, before: tuple[Problem, FloatArray] | None
    ) -> tuple[Record, tuple[Problem, FloatArray] | None]:
        """One step, carried on from the problem and impulses before if the task asks for it."""
        start = None
        if task.start == "carried":
            begun = perf_counter()
            start = problem.start() if before is None else carry(*before, problem)
            task = replace(task, lead=perf_counter() - begun)
        record, impulse = self.make(problem, task, spec, start)
        return record, None if impulse is None else (problem, impulse)

    def taking(self, case: str, name: str, given: Sequence[Item | Problem]) -> SolverSpec | None:
        """The solver to run where `name` is asked for, the same method with bounds if it must be; None, with a note."""
        spec = self.specs[name]
        for problem in (item.problem if isinstance(item, Item) else item for item in given):
            reason = spec.refuses(problem)
            if reason:
                break
        else:
            return spec
        other = spec.standing_in(problem) if self.stands_in else None
        if other is not None and other.name in self.names:
            other = None  # it runs anyway
        self.keep(Skip(self.this.run, case, name, f"{name} → {other.name}: {reason}" if other else reason))
        return other

    def pair(self, info: CaseInfo, problem: Problem, name: str) -> None:
        """One solver on one case, at every budget and level."""
        spec = self.taking(info.case, name, [problem])
        if spec is None:
            return
        name = spec.name

        def one(task: Task) -> Record:
            record = self.known.get(task.key)
            reused = record is not None
            if record is not None:
                self.out.add(record)
            else:
                record = self.make(problem, task, spec, None)[0]
                self.keep(record)
            self.tell(info.case, name, record, reused)
            return record

        self.plan.carry_out(info, problem, spec, one)

    def make(self, problem: Problem, task: Task, spec: SolverSpec, impulse: Any) -> tuple[Record, Any]:
        """The record of a task, made here or in the worker, and the impulses (m,) [N s] that came out, or None."""
        if self.worker is not None and is_foreign(spec):
            record, found = self.worker.measure(replace(problem, copy=False), task, impulse)
        else:
            record, found = measure(problem, task, impulse)
        if found is not None:
            record = with_answer(record, problem, found)
        return with_motion(record, problem, found) if self.plan.motion else record, found


def _cost(record: Record) -> float:
    """Time [s] that a record took to make, from what it holds, so that a resumed pass ends where the first did."""
    spent = record.time_median * record.repeats
    return spent if math.isfinite(spent) else record.time_limit


def _sequences(items: list[Item]) -> list[tuple[str, list[Item]]]:
    """Items in runs of one sequence; those of none alone, under no name."""
    out: list[tuple[str, list[Item]]] = []
    for item in items:
        if item.sequence and out and out[-1][0] == item.sequence:
            out[-1][1].append(item)
        else:
            out.append((item.sequence, [item]))
    return out


def not_loaded(source: str, error: Exception) -> str:
    """Why a case is left out; an error that the reader did not mean to raise with its kind."""
    text = str(error)
    if not isinstance(error, (LavenderError, OSError)):
        text = f"{type(error).__name__}: {text}"
    return f"did not load: {text}" if text.startswith(source) else f"did not load: {source}: {text}"
