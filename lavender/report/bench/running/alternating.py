"""Time the calls that a report would print alternately: each repetition makes every call on every case once.

Disturbances of the machine then affect all calls equally, and differences between repetitions are the noise of a
rerun.
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
from lavender.report.bench.cases import Item, Source, resolve_sources
from lavender.report.bench.record import CaseInfo, Record
from lavender.report.bench.running.plan import Plan
from lavender.report.bench.running.runner import Runner, Watch, is_third_party_solver, open_runner
from lavender.report.bench.running.timing import (
    CallSpec,
    Task,
    copy_problem_into_new_arrays,
    make_outcome,
    make_record,
    measure_calibration_time,
)
from lavender.report.bench.store import Records, Store

DEFAULT_REPETITIONS, MIN_REPETITIONS, MAX_REPETITIONS = 7, 3, 41
# [s] Repetitions beyond DEFAULT_REPETITIONS are made only until the repetitions of all cases have taken this time.
EXTRA_REPETITION_TIME = 3.0
# All repetitions together may take this multiple of the plan's time limit; MIN_REPETITIONS are always made.
TIME_LIMIT_MULTIPLE = 20.0
CASES_IN_MEMORY = 32  # Number of cases that are loaded at the same time.
# Problems are timed as one batch if the largest has up to this multiple of the smallest's rows.
MAX_SIZE_RATIO = 10

RecordsByKey = dict[tuple[Any, ...], list[Record]]  # Records by measurement, one record for each repetition.
Cases = Sequence[tuple[Item, CaseInfo]]


def time_alternately(
    cases: Iterable[Source],
    call_specs: Sequence[CallSpec],
    known: Records,
    plan: Plan,
    store: Store | str | Path | None = None,
    *,
    watch: Watch | None = None,
    isolate: bool = True,
    memory: int | None = None,
    reuse: bool = True,
) -> Records:
    """Time calls alternately on cases that `lavender.report.bench.run` has described in `known`.

    Records in `store` are reused if the same calls were timed on the same cases.

    Parameters
    ----------
    cases, plan, store, watch, isolate, memory, reuse
        See `lavender.report.bench.run`.
    call_specs : sequence of CallSpec
        Calls of timing mode "call" on single cases, "steps" over sequences, "batch" on either.
    known : Records

    Returns
    -------
    Records
        `known`, with the new records.
    """
    this = list(known.runs.values())[-1]
    names = list(dict.fromkeys(call.solver for call in call_specs))
    with open_runner(this, plan, names, store, watch, isolate, memory, reuse) as runner:
        runner.out = known
        described = [(i, known.cases[i.name]) for i in resolve_sources(cases) if i.name in known.cases]
        identity = repr([call_specs, [info.sha for _, info in described]])
        alternation = _Alternation(runner, call_specs, hashlib.sha256(identity.encode()).hexdigest()[:12])
        single = [(i, info) for i, info in described if not i.sequence]
        parts = [single[k : k + CASES_IN_MEMORY] for k in range(0, len(single), CASES_IN_MEMORY)]
        sequences: dict[str, list[tuple[Item, CaseInfo]]] = {}
        for item, info in described:
            if item.sequence:
                sequences.setdefault(item.sequence, []).append((item, info))
        for part in (*parts, *sequences.values()):
            fraction = len(part) / len(described)
            alternation.repeat_calls_on(
                part,
                fraction * TIME_LIMIT_MULTIPLE * plan.time_limit,
                fraction * EXTRA_REPETITION_TIME,
            )
            for item, _ in part:
                item.release_problem()
    return known


class _Alternation:
    """Repeats all calls on some of the cases, interleaved; `interleave_group` identifies what was timed together."""

    def __init__(self, runner: Runner, call_specs: Sequence[CallSpec], interleave_group: str) -> None:
        self.runner, self.call_specs, self.interleave_group = runner, call_specs, interleave_group
        self.known = {r.key for r in runner.known.values() if r.interleave_group == interleave_group}
        for record in runner.known.values():
            if record.key in self.known:
                runner.out.add(record)
                runner.report_progress(record.case, record.solver, record, True)

    def repeat_calls_on(self, part: Cases, limit: float, extra: float) -> None:
        """Repeat all calls on the cases, or on the sequence, in `part`.

        `MIN_REPETITIONS` are always made. Repetitions up to `DEFAULT_REPETITIONS` stop after `limit` [s], and further
        repetitions after the smaller of `limit` and `extra` [s].
        """
        is_sequence = bool(part[0][0].sequence)
        call_specs = [
            a
            for a in self.call_specs
            if a.timing_mode == "batch" or (a.timing_mode == "steps") == is_sequence
        ]
        accepted = {call: [(i, info) for i, info in part if self.can_time(call, i)] for call in call_specs}
        records: RecordsByKey = {}
        start_time = perf_counter()
        for repetition in range(MAX_REPETITIONS):
            elapsed = perf_counter() - start_time
            allowed = limit if repetition < DEFAULT_REPETITIONS else min(limit, extra)
            if repetition >= MIN_REPETITIONS and elapsed > allowed:
                break
            first = repetition % len(call_specs) if call_specs else 0
            order = call_specs[first:] + call_specs[:first]
            if is_sequence:
                for call in order:
                    self.time_steps(call, accepted[call], records)
            else:
                for item, info in part:
                    for call in order:
                        if call.timing_mode != "batch" and any(info is other for _, other in accepted[call]):
                            self.add_record(records, self.time_call_on_case(call, item, info, None)[0])
            for call in order:
                if call.timing_mode == "batch" and _is_timed_as_batch(accepted[call], is_sequence):
                    self.time_batch(call, accepted[call], records)
        for repeated in records.values():
            self.runner.add_entry(_merge_repetitions(repeated))

    def can_time(self, call: CallSpec, item: Item) -> bool:
        """Whether the solver of a call can be timed on a case."""
        spec = self.runner.specs[call.solver]
        if is_third_party_solver(spec) and (call.timing_mode == "batch" or call.mode == "time"):
            # These calls cannot be timed in the separate process in which third-party solvers run.
            return False
        return spec.refuses(item.problem) is None

    def make_task(self, call: CallSpec, info: CaseInfo) -> Task:
        """Return the task of one repetition of a call on one case."""
        more = {
            "time_limit": call.time_limit or self.runner.plan.time_limit,
            "repeats": 1 if call.timing_mode == "steps" else 2,
            "interleave_group": self.interleave_group,
            "guarded": False,
        }
        return Task.from_call_spec(info, call, **more)

    def add_record(self, records: RecordsByKey, record: Record | None) -> None:
        """Collect a record unless it was stored before."""
        if record is not None and record.key not in self.known:
            records.setdefault(record.key, []).append(record)

    def time_call_on_case(
        self, call: CallSpec, item: Item, info: CaseInfo, before: Any
    ) -> tuple[Record | None, Any]:
        """Time a call on a case, started from the result `before` of the previous step; return (record, result)."""
        task = self.make_task(call, info)
        if task.key in self.known and call.start != "carried":
            return None, None
        record, after = self.runner.measure_step(item.problem, task, self.runner.specs[call.solver], before)
        self.runner.report_progress(info.case, call.solver, record)
        return record, after

    def time_steps(self, call: CallSpec, steps: Cases, records: RecordsByKey) -> None:
        """Time a call on all steps of a sequence, unless their records were stored before."""
        if call.timing_mode == "batch" or all(
            self.make_task(call, info).key in self.known for _, info in steps
        ):
            return
        before = None
        for item, info in steps:
            record, before = self.time_call_on_case(call, item, info, before)
            self.add_record(records, record)

    def time_batch(self, call: CallSpec, cases: Cases, records: RecordsByKey) -> None:
        """Time one call of `solve_many`; the record of each problem gets an equal part of the call's time."""
        tasks = [self.make_task(call, info) for _, info in cases]
        if all(task.key in self.known for task in tasks):
            return
        problems = [copy_problem_into_new_arrays(item.problem, call.start) for item, _ in cases]
        calibration_time = measure_calibration_time()
        start_time = perf_counter()
        try:
            solutions = solve_many(problems, call.solver, tol=call.tol, max_iter=call.max_iter or None)
        except Exception as error:  # Only the records of this call are lost.
            for task in tasks:
                self.add_record(
                    records,
                    task.make_record(status="ERROR", message=f"{type(error).__name__}: {error}"[:500]),
                )
            return
        time_per_problem = (perf_counter() - start_time) / len(cases)
        for task, s in zip(tasks, solutions, strict=True):
            self.add_record(
                records, make_record(task, s, make_outcome(s, [s], [time_per_problem], calibration_time))
            )


def _is_timed_as_batch(cases: Cases, is_sequence: bool) -> bool:
    """Whether cases are timed as one batch: steps of a sequence, or problems of similar size."""
    rows = [info.rows for _, info in cases]
    return len(rows) > 1 and (is_sequence or max(rows) <= MAX_SIZE_RATIO * min(rows))


def _merge_repetitions(records: Sequence[Record]) -> Record:
    """Return the last record, with the times of all repetitions."""
    times = [t for r in records for t in r.times]
    calibration_times = [r.calibration_time for r in records if r.calibration_time is not None]
    return replace(
        records[-1],
        repeats=len(records),
        times=tuple(times),
        residual_per_repeat=tuple(x for r in records for x in r.residual_per_repeat),
        time_min=min(times, default=records[-1].time_min),
        time_median=median(times) if times else records[-1].time_median,
        calibration_time=min(calibration_times, default=None),
    )
