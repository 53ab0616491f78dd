"""Lines that a report would print, timed in turns: each repetition of the whole takes every line on every case once.

What a machine does meanwhile then meets all lines alike, and what differs between repetitions is the noise of a rerun.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

from lavender.batch.solve import solve_many
from lavender.lab.bench.cases import Item, Source, resolve
from lavender.lab.bench.record import CaseInfo, Record
from lavender.lab.bench.running.plan import Plan
from lavender.lab.bench.running.runner import Runner, Watch, is_foreign
from lavender.lab.bench.running.timing import Ask, Task, just_written, one_thread, outcome_of, pace, record_of
from lavender.lab.bench.running.worker import Worker
from lavender.lab.bench.store import Records, Store, opened

ROUNDS, LEAST_ROUNDS, MOST_ROUNDS = 7, 3, 41
SPARE = 3.0  # s, for more repetitions than usual where they are cheap
STAGE = 20.0  # time limits, that all repetitions may take together once there were the least
LOADED = 32  # cases that are held in memory at a time
ALIKE = 10  # rows of the largest over the smallest problem, up to which they are a batch


Made = dict[tuple[Any, ...], list[Record]]  # records of one measurement, one of each repetition
Cases = Sequence[tuple[Item, CaseInfo]]


def finals(
    cases: Iterable[Source],
    asks: Sequence[Ask],
    known: Records,
    plan: Plan,
    store: Store | str | Path | None = None,
    *,
    watch: Watch | None = None,
    isolate: bool = True,
    memory: int | None = None,
    fresh: bool = False,
) -> Records:
    """Time lines in turns; `known` of `lavender.lab.bench.run` on the same cases describes them, and gets the records.

    What `store` holds is not made again where the same lines took turns on the same cases.

    Parameters
    ----------
    cases, plan, store, watch, isolate, memory, fresh : as `lavender.lab.bench.run`
    asks : sequence of Ask
        Of way "call" on single cases, "steps" over sequences, "batch" on either.
    known : Records

    Returns
    -------
    Records
        `known`, with the new records.
    """
    names = list(dict.fromkeys(ask.solver for ask in asks))
    with opened(store) as kept, Worker(memory) as worker, one_thread():
        runner = Runner(list(known.runs.values())[-1], plan, names, kept, watch, worker if isolate else None)
        runner.out = known
        if fresh:
            runner.known = {}
        described = [(i, known.cases[i.name]) for i in resolve(cases) if i.name in known.cases]
        what = repr([asks, [info.sha for _, info in described]])
        stage = _Stage(runner, asks, hashlib.sha256(what.encode()).hexdigest()[:12])
        single = [(i, info) for i, info in described if not i.sequence]
        parts = [single[k : k + LOADED] for k in range(0, len(single), LOADED)]
        sequences: dict[str, list[tuple[Item, CaseInfo]]] = {}
        for item, info in described:
            if item.sequence:
                sequences.setdefault(item.sequence, []).append((item, info))
        for part in (*parts, *sequences.values()):
            share = len(part) / len(described)
            stage.measure_part(part, share * STAGE * plan.time_limit, share * SPARE)
            for item, _ in part:
                item.forget()
    return known


class _Stage:
    def __init__(self, runner: Runner, asks: Sequence[Ask], turns: str) -> None:
        self.runner, self.asks, self.turns = runner, asks, turns
        self.known = {r.key for r in runner.known.values() if r.turns == turns}
        for record in runner.known.values():
            if record.key in self.known:
                runner.out.add(record)
                runner.tell(record.case, record.solver, record, True)

    def measure_part(self, part: Cases, limit: float, spare: float) -> None:
        """All repetitions over a part of the cases, or over one sequence, in a time [s] and one for more than usual."""
        steps = bool(part[0][0].sequence)
        mine = [a for a in self.asks if a.way == "batch" or (a.way == "steps") == steps]
        taken = {ask: [(i, info) for i, info in part if self.takes(ask, i)] for ask in mine}
        made: Made = {}
        begun = perf_counter()
        for turn in range(MOST_ROUNDS):
            spent = perf_counter() - begun
            if turn >= LEAST_ROUNDS and spent > (limit if turn < ROUNDS else min(limit, spare)):
                break
            order = mine[turn % len(mine) :] + mine[: turn % len(mine)] if mine else []
            if steps:
                for ask in order:
                    self.run_pass(ask, taken[ask], made)
            else:
                for item, info in part:
                    for ask in order:
                        if ask.way != "batch" and any(info is other for _, other in taken[ask]):
                            self.keep(made, self.one(ask, item, info, None)[0])
            for ask in order:
                if ask.way == "batch" and _is_batch(taken[ask], steps):
                    self.batch(ask, taken[ask], made)
        for records in made.values():
            self.runner.keep(_merged(records))

    def takes(self, ask: Ask, item: Item) -> bool:
        spec = self.runner.specs[ask.solver]
        if is_foreign(spec) and (ask.way == "batch" or ask.mode == "time"):
            return False  # a process of its own adds its start, or takes no limit
        return spec.refuses(item.problem) is None

    def task(self, ask: Ask, info: CaseInfo) -> Task:
        """One repetition of a line on one case."""
        more = {
            "time_limit": ask.time_limit or self.runner.plan.time_limit,
            "repeats": 1 if ask.way == "steps" else 2,
            "turns": self.turns,
            "guarded": False,
        }
        return Task.of(info, ask, **more)

    def keep(self, made: Made, record: Record | None) -> None:
        if record is not None and record.key not in self.known:
            made.setdefault(record.key, []).append(record)

    def one(self, ask: Ask, item: Item, info: CaseInfo, before: Any) -> tuple[Record | None, Any]:
        task = self.task(ask, info)
        if task.key in self.known and ask.start != "carried":
            return None, None
        record, after = self.runner.step(item.problem, task, self.runner.specs[ask.solver], before)
        self.runner.tell(info.case, ask.solver, record)
        return record, after

    def run_pass(self, ask: Ask, steps: Cases, made: Made) -> None:
        if ask.way == "batch" or all(self.task(ask, info).key in self.known for _, info in steps):
            return
        before = None
        for item, info in steps:
            record, before = self.one(ask, item, info, before)
            self.keep(made, record)

    def batch(self, ask: Ask, some: Cases, made: Made) -> None:
        """One call of `solve_many`: each problem's record has its share of the time."""
        tasks = [self.task(ask, info) for _, info in some]
        if all(task.key in self.known for task in tasks):
            return
        fresh = [just_written(item.problem, ask.start) for item, _ in some]
        asked = ask.max_iter or None
        beside = pace()
        begun = perf_counter()
        try:
            found = solve_many(fresh, ask.solver, tol=ask.tol, max_iter=asked)
        except Exception as error:  # as in `attempt`: it costs its own records
            for task in tasks:
                self.keep(made, task.record(status="ERROR", message=f"{type(error).__name__}: {error}"[:500]))
            return
        share = (perf_counter() - begun) / len(some)
        for task, s in zip(tasks, found, strict=True):
            self.keep(made, record_of(task, s, outcome_of(s, [s], [share], beside)))


def _is_batch(some: Cases, steps: bool) -> bool:
    rows = [info.rows for _, info in some]
    return len(rows) > 1 and (steps or max(rows) <= ALIKE * min(rows))


def _merged(records: Sequence[Record]) -> Record:
    """The record of all repetitions: the last, with everybody's times."""
    times = [t for r in records for t in r.times]
    paces = [r.pace for r in records if r.pace is not None]
    return replace(
        records[-1],
        repeats=len(records),
        times=tuple(times),
        reached=tuple(x for r in records for x in r.reached),
        time_min=min(times, default=records[-1].time_min),
        time_median=median(times) if times else records[-1].time_median,
        pace=min(paces, default=None),
    )
