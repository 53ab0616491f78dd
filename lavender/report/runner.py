"""Measure every solver on every case, in this process or with workers; each row is stored as soon as it is made.

A run with times measures in this process, one solve after the other. A campaign (`CampaignPlan`) measures no times:
its pairs of case and solver may be distributed over workers, and its records have the same bits with any number of
them.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby, product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_sequence
from lavender.base.errors import InputError, LavenderError, require_packages
from lavender.base.lazy_import import pandas as pd
from lavender.diagnostics.motion_error import motion_error
from lavender.problem import Problem, check_problem
from lavender.report import machine
from lavender.report.cases import (
    Item,
    Source,
    describe_case,
    hash_problem,
    resolve_item,
    resolve_sources,
)
from lavender.report.store import (
    CASE_COLUMNS,
    CASE_DETAILS,
    RUN_COLUMNS,
    Row,
    Store,
    convert_columns,
    describe_target,
    get_key,
    make_lines,
)
from lavender.report.timing import (
    CampaignPlan,
    Plan,
    Target,
    add_times,
    limit_to_one_thread,
    list_passes,
    make_task,
    measure_task,
)
from lavender.report.workers import check_workers, connect_backend, map_unordered
from lavender.solvers import registry
from lavender.solvers.registry import SolverSpec

# If a step took less than this fraction of the time limit, no guarded solve (`timing`) precedes the next step's.
UNGUARDED_TIME_RATIO = 0.05
# Each step of a sequence with more steps is solved once, not `Plan.repeats` times: the sum over many steps varies less.
MAX_REPEATED_STEPS = 20
# The error of the motion is computed for about this number of steps of a sequence, evenly distributed.
MAX_MOTION_STEPS = 20
# Columns that depend on the speed and the load of the machine.
NO_TIMES = ("carry_time", "setup_time", "solve_time", "calibration_time", "load")

Watch = Callable[["Event"], Any]


@dataclass(frozen=True)
class Event:
    """Progress of a run."""

    done: int  # Number of pairs of case and solver, or of other tasks, that are done.
    total: int  # Number of all; 0 if unknown.
    case: str
    solver: str
    row: Row | None = None  # The row of the run that was made last.
    reused: bool = False  # Whether this run was not measured now.
    phase: str = ""  # The present phase, such as "measuring".


def carry_impulses(before: Problem, impulse: FloatArray, problem: Problem) -> FloatArray:
    """Return the start of `problem` (m,) [N s] from the impulses of the previous step, if they can be assigned."""
    check_problem(problem)
    if not isinstance(before, Problem):
        raise InputError(
            f"before is a {type(before).__name__}; the problem of the previous step is needed"
        )
    start = problem._carry(before, before.make_start(impulse))[0]
    return problem.start() if start is None else start


def select_solver_names(names: str | Sequence[str] | None) -> list[str]:
    """Return the names of the solvers to run: the named ones, each of them installed, or every installed solver.

    Raises
    ------
    UnknownName, SolverUnavailable
    """
    if names is not None and not isinstance(names, str):
        names = check_sequence("solvers", names, "names")
    if names:
        names = [names] if isinstance(names, str) else names
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
    workers: int = 1,
    backend: str = "loky",
    watch: Watch | None = None,
    into: list[Row] | None = None,
    reuse: bool = True,
) -> pd.DataFrame:
    """Measure every solver on every case that it accepts.

    Parameters
    ----------
    cases : files, folders, names of the suite, problems
        Default: `lavender.suite.default()`.
    solvers : names, optional
        Default: every installed solver. A solver that refuses a case is skipped with its reason; its bounded variant
        (`pgs` for `gauss_seidel`) is run instead if there is one, but not in a campaign.
    plan : Plan, optional
        Default: `Plan()`, or with several workers or a cluster, which measure no times, `CampaignPlan()`.
    store : Store or path of a `.jsonl` file, optional
        Stores each row when it is made; a measurement that it holds from the same machine, versions and plan is not
        repeated.
    workers : int
        Number of processes; 1: this one, -1: one for each core. A cluster determines its own number.
    backend : str
        Backend of joblib: "loky" (processes here), "dask" (of the current dask.distributed client, or of
        DASK_SCHEDULER_ADDRESS); "dask=ADDRESS" connects to a cluster.
    watch : callable (Event), optional
    into : list, optional
        Receives each row when it is made, so that the rows are available if the run is interrupted.
    reuse : bool
        Do not repeat measurements that `store` holds.

    Returns
    -------
    DataFrame
        A row for each line of a records file: machine, cases, new and reused runs in the order of cases and solvers,
        and pairs that did not run. `select_runs` returns the runs. Runs of a campaign have no times.

    Raises
    ------
    InputError
        joblib does not have the backend here, the number of workers is not -1 or 1 to 4096, several workers have a
        plan that measures times, or a worker was lost; the rows that were stored stay.
    """
    require_packages("a measurement", "joblib", "pandas", "threadpoolctl")
    check_workers(workers)
    spread = workers != 1 or backend != "loky"
    plan = plan or (CampaignPlan() if spread else Plan())
    if spread and not plan.campaign:
        raise InputError(
            f"workers is {workers}, backend {backend!r}, and the plan measures times, which several workers disturb: "
            "give a CampaignPlan, or workers=1 with backend 'loky'"
        )
    items = resolve_sources(cases)
    if plan.campaign:
        items = [replace(item, sequence="", step=-1) for item in items]
    names = select_solver_names(solvers)
    specs = [registry.specs()[name] for name in names]
    packages = {
        package for spec in specs for package in (*spec.requires, spec.distribution) if package
    }
    this = machine.describe_run({**asdict(plan), "solvers": names}, packages)
    backend, cluster = connect_backend(backend) if spread else ("", contextlib.nullcontext())
    # The limit of threads covers the description of cases, which uses BLAS.
    opened: contextlib.AbstractContextManager[Store | None]
    opened = (
        contextlib.nullcontext(store) if store is None or isinstance(store, Store) else Store(store)
    )
    with cluster, opened as kept, limit_to_one_thread():
        runner = Runner(this, plan, names, kept, watch, reuse)
        runner.out = runner.out if into is None else into
        runner.measure_items(items, workers, backend)
    return make_lines(runner.out, str(kept.path) if kept else "")


class Runner:
    """Measures pairs of case and solver. Stored measurements are reused, new ones stored as soon as they are made."""

    def __init__(
        self,
        this: Row,
        plan: Plan,
        names: list[str],
        store: Store | None = None,
        watch: Watch | None = None,
        reuse: bool = True,
    ) -> None:
        self.this, self.plan, self.names = this, plan, names
        self.store, self.watch = store, watch
        self.specs = registry.specs()
        self.out: list[Row] = []
        self.done = self.total = 0
        self.known: dict[Any, Row] = {}
        self.described: dict[str, Row] = {}  # Many cases take longer to describe than to load.
        if store is not None and reuse:
            stored = (
                store.lines[store.lines["run"] == this["run"]]
                if "run" in store.lines
                else store.lines
            )
            for row in convert_columns(stored, "run", RUN_COLUMNS).to_dict("records"):
                self.known[get_key(row)] = {
                    "kind": "run",
                    **row,
                    "times": list(map(float, row["times"])),
                }
            for row in convert_columns(stored, "case", CASE_DETAILS | CASE_COLUMNS).to_dict(
                "records"
            ):
                self.described[row["case"]] = {"kind": "case", **row}

    def add_row(self, row: Row) -> None:
        """Add a row to the returned rows and to the store."""
        self.out.append(row)
        if self.store is not None:
            self.store.add(row)

    def add_skip(self, case: str, solver: str, reason: str, sequence: str = "") -> None:
        """Add the row of a solver that does not run on a case, or without a solver of a case that does not load."""
        pair = {"case": case, "solver": solver, "sequence": sequence}
        self.add_row({"kind": "skip", "run": self.this["run"], **pair, "reason": reason})

    def report_progress(
        self, case: str, solver: str, row: Row | None = None, reused: bool = False
    ) -> None:
        """Call `watch` with the number of pairs that are done."""
        if self.watch is not None:
            self.watch(Event(self.done, self.total, case, solver, row, reused, phase="measuring"))

    def measure_items(self, items: list[Item], workers: int = 1, backend: str = "") -> None:
        """Measure every case and sequence; by the workers of a joblib backend if one is named."""
        self.total = len(items) * len(self.names)
        self.add_row({**self.this, "whole": False})
        if backend:
            self.distribute_pairs(items, workers, backend)
        else:
            for _, group in groupby(items, key=lambda item: item.sequence or id(item)):
                steps = list(group)
                if steps[0].sequence:
                    self.measure_sequence(steps)
                else:
                    self.measure_case(steps[0])
                for item in steps:
                    item.release_problem()
        self.add_row(self.this)
        self.report_progress("", "")

    def distribute_pairs(self, items: list[Item], workers: int, backend: str) -> None:
        """Measure the pairs of a campaign with workers, and store the rows of each pair when a worker returns them."""
        local = tuple(
            spec for n in self.names if not ((spec := self.specs[n]).builtin or spec.distribution)
        )
        known: dict[tuple[str, str], list[Row]] = {}
        for row in self.known.values():
            known.setdefault((row["case"], row["solver"]), []).append(row)
        # A worker reads a name or path itself: machines of a cluster share files and suite.
        calls = [
            (
                number,
                item.name,
                item.source if item.in_memory is None else replace(item.in_memory, copy=False),
                name,
                self.described.get(item.name),
                known.get((item.name, name), []),
                self.this,
                self.plan,
                local,
            )
            for number, (item, name) in enumerate(product(items, self.names))
        ]
        rows: dict[int, list[Row]] = {}
        try:
            for number, new in (
                map_unordered(measure_in_worker, calls, workers, backend) if calls else ()
            ):
                for row in new:
                    is_stored = row["kind"] == "run" and get_key(row) in self.known
                    if self.store is not None and not is_stored:
                        self.store.add(row)
                rows[number] = new
                self.done += 1
                _, case, _, name, *_ = calls[number]
                for row in (row for row in new if row["kind"] == "run"):
                    self.report_progress(case, name, row, get_key(row) in self.known)
                self.report_progress(case, name)
        finally:
            self.out.extend(row for number in sorted(rows) for row in rows[number])
        if len(rows) < len(calls):
            raise InputError(
                f"a worker was lost, and {len(calls) - len(rows)} of {len(calls)} pairs are not done: run the same "
                "command again, with fewer workers if memory is short"
            )

    def load_case(self, item: Item) -> Row | None:
        """Load and describe a case. Return None, and add the reason to the rows, if it does not load."""
        try:
            case = self.described.get(item.name)
            if case is None or case["sha"] != hash_problem(item.problem):
                case = describe_case(item, self.this["run"])
        except Exception as error:  # A reader may raise any exception; only its own case is lost.
            is_expected = isinstance(error, (LavenderError, OSError))
            text = str(error) if is_expected else f"{type(error).__name__}: {error}"
            text = text if text.startswith(item.source) else f"{item.source}: {text}"
            self.add_skip(item.name, "", f"did not load: {text}", item.sequence)
            self.report_progress(item.name, "")
            return None
        if not item.sequence:
            self.add_row(case)
        return case

    def measure_case(self, item: Item, case: Row | None = None) -> None:
        """Measure every solver on a case outside sequences; `case` is its description, if it is known."""
        if case is not None:
            self.add_row(case)
        else:
            case = self.load_case(item)
        for name in self.names:
            if case is not None:
                self.report_progress(item.name, name)
                self.measure_solver(case, item.problem, name)
            self.done += 1

    def measure_sequence(self, items: list[Item]) -> None:
        """Measure every solver on the steps of a sequence, in passes: each budget and tolerance, cold and carried."""
        steps = [(item, case) for item in items if (case := self.load_case(item)) is not None]
        identity = hashlib.sha256("".join(case["sha"] for _, case in steps).encode()).hexdigest()[
            :16
        ]
        loaded = [item for item, _ in steps]
        cases = [{**case, "identity": identity} for _, case in steps]
        for case in cases:
            self.add_row(case)
        repeats = self.plan.repeats if len(steps) <= MAX_REPEATED_STEPS else 1
        for name in self.names:
            spec = self.select_solver(items[0].sequence, name, loaded)
            if spec is not None:
                for target in list_passes(self.plan, spec):
                    self.report_progress(items[0].sequence, spec.name)
                    tasks = [
                        make_task(case, spec.name, *target, self.plan.time_limit) for case in cases
                    ]
                    self.measure_pass(loaded, spec, tasks, repeats)
            self.done += len(items)

    def measure_pass(
        self, problems: list[Item], spec: SolverSpec, tasks: list[Row], repeats: int
    ) -> None:
        """Measure one pass. It ends, with a note, when its steps have taken `Plan.sequence_time_limit` together."""
        call = tasks[0]
        stride = -(-len(tasks) // MAX_MOTION_STEPS)
        limit = self.plan.sequence_time_limit
        spent = 0.0
        made = 0
        for task in tasks:
            row = self.known.get(get_key(task))
            if row is None or spent > limit:
                break
            spent = spent + _get_elapsed_time(row)
            made = made + 1
            self.out.append(row)
            self.report_progress(task["case"], spec.name, row, True)
        before: tuple[Problem, FloatArray] | None = None
        if call["start"] == "carried" and 0 < made < len(tasks) and spent <= limit:
            # If an earlier run was stopped in this pass, repeat its steps without records for the last step's impulses.
            for item, task in zip(problems[:made], tasks, strict=False):
                before = self.measure_step(item, task, spec, before)[1]
        while made < len(tasks) and spent <= limit:
            longest = max(row["times"], default=math.inf) if row else math.inf
            how = {
                "repeats": repeats,
                "is_guarded": longest >= UNGUARDED_TIME_RATIO * self.plan.time_limit,
            }
            item, task = problems[made], tasks[made]
            row, before = self.measure_step(item, task, spec, before, made % stride == 0, **how)
            self.add_row(row)
            self.report_progress(row["case"], spec.name, row)
            spent = spent + _get_elapsed_time(row)
            made = made + 1
        if made < len(tasks):
            target = describe_target(call["mode"], call["tol"], call["max_iter"])
            took = f"which took more than the pass limit of {limit:.3g} s together (--sequence-time-limit)"
            reason = f"stopped after {made} of {len(tasks)} steps, {took}"
            self.add_skip(f"{problems[0].sequence}, {target}, {call['start']}", spec.name, reason)

    def measure_step(
        self,
        item: Item,
        task: Row,
        spec: SolverSpec,
        before: tuple[Problem, FloatArray] | None,
        with_motion: bool = False,
        **how: Any,
    ) -> tuple[Row, tuple[Problem, FloatArray] | None]:
        """Measure one step; if its task has start "carried", start from the previous problem and impulses.

        In a pass of a fixed number of sweeps, the first recorded step starts from the guess in its file, and the second
        step from the engine's answer to the first one, if the file has one: a recording may begin when impulses have
        been carried for long. `with_motion` adds the error of the motion, which is not timed.
        """
        start = None
        problem = item.problem
        is_carried, is_budget = task["start"] == "carried", task["mode"] == "budget"
        is_first = is_carried and is_budget and before is None
        if is_carried:
            begun = perf_counter()
            if is_first and problem.guess is not None:
                start = problem.guess
            else:
                start = problem.start() if before is None else carry_impulses(*before, problem)
            task = task | {"carry_time": perf_counter() - begun}
        row, impulse = self.measure_task(problem, task, spec, start, **how)
        if with_motion and is_budget and spec.order and impulse is not None:
            error = motion_error(problem, impulse)
            # Without bodies, the largest difference of a row's velocity counts.
            speed = error.rows if error.speed is None else error.speed
            row["motion_error"] = math.nan if speed is None else float(speed)
        if is_first and (answer := item.load_stored()) is not None and answer.shape == (problem.m,):
            impulse = answer if np.isfinite(answer).all() else impulse
        return row, None if impulse is None else (problem, impulse)

    def select_solver(
        self, case: str, name: str, items: Sequence[Item | Problem]
    ) -> SolverSpec | None:
        """Return the solver to run for `name`.

        If it refuses a case, return its bounded variant, or record a note and return None.
        """
        spec = self.specs[name]
        for problem in (item.problem if isinstance(item, Item) else item for item in items):
            reason = spec.refuses(problem)
            if reason:
                break
        else:
            return spec
        # A pair of a campaign has only records of its own solver.
        other = None if self.plan.campaign else spec.standing_in(problem)
        if other is not None and other.name in self.names:
            other = None  # The bounded variant is measured under its own name already.
        self.add_skip(case, name, f"{name} → {other.name}: {reason}" if other else reason)
        return other

    def measure_solver(self, case: Row, problem: Problem, name: str) -> None:
        """Measure one solver on one case, at every budget and tolerance."""
        spec = self.select_solver(case["case"], name, [problem])
        if spec is None:
            return

        def measure_or_reuse(target: Target, repeats: int) -> Row:
            """Measure one target, or return its row if an earlier run stored it."""
            task = make_task(case, spec.name, *target, self.plan.time_limit)
            row = self.known.get(get_key(task))
            reused = row is not None
            if row is not None:
                self.out.append(row)
            else:
                row = self.measure_task(problem, task, spec, None, repeats=repeats)[0]
                self.add_row(row)
            self.report_progress(case["case"], spec.name, row, reused)
            return row

        self.plan.measure_solver(case, spec, measure_or_reuse)

    def measure_task(
        self, problem: Problem, task: Row, spec: SolverSpec, impulse: Any, **how: Any
    ) -> tuple[Row, Any]:
        """Solve a task; return its row and impulses (m,) [N s]."""
        if self.plan.campaign and not (spec.external or spec.requires or spec.distribution):
            task = task | {"time_limit": math.inf}
        row, found = measure_task(problem, task, impulse, **how)
        if found is not None:
            row["solution_hash"] = hashlib.sha256(found.tobytes()).hexdigest()[:16]
        if (
            self.plan.campaign
        ):  # Without times, and with the plan's limit, rows are equal on all machines.
            same = dict.fromkeys(NO_TIMES, math.nan) | {"time_limit": self.plan.time_limit}
            row = add_times(row | same, ())
        return row, found


def _get_elapsed_time(row: Row) -> float:
    """Return the time [s] that a run took, from its row, so that a resumed pass ends at the same step."""
    carry_time = row["carry_time"] if row["carry_time"] > 0.0 else 0.0
    return float(sum(row["times"]) + carry_time if row["times"] else row["time_limit"])


# -- pairs of a campaign, in workers -----------------------------------------------------------------------


@contextlib.contextmanager
def _register_solvers(specs: tuple[SolverSpec, ...]) -> Iterator[None]:
    """Register solvers of the parent for one pair: the worker may serve another run later."""
    before = registry.specs() if specs else {}
    try:
        for spec in specs:
            registry.register(spec, replace=True)
        yield
    finally:
        if specs:
            registry.registered.clear()
            registry.registered.update(before)


# Source, item and description of the case of the last pair. Pairs of one case are consecutive, so it is loaded once.
_last_case: tuple[Any, Item | None, Row | None] = None, None, None


def measure_in_worker(
    number: int,
    name: str,
    source: str | Problem,
    solver: str,
    described: Row | None,
    known: list[Row],
    this: Row,
    plan: Plan,
    local: tuple[SolverSpec, ...],
) -> tuple[int, list[Row]]:
    """Measure a pair of case and solver in a worker, on one thread as pairs run in parallel.

    `source` is a name or path that the worker resolves itself, or the problem; `described` and `known` are stored rows
    of the case and of the pair, `this` the row of the machine; the solvers `local` are registered only in the parent.
    Return `number`, and the rows of the pair.
    """
    global _last_case
    with _register_solvers(local), limit_to_one_thread(solver):
        runner = Runner(this, plan, [solver])
        runner.known = {get_key(row): row for row in known}
        runner.described = {} if described is None else {name: described}
        key, item, case = None, None, None
        if not isinstance(source, Problem):
            changed = os.stat(source).st_mtime_ns if os.path.exists(source) else 0
            key = this["run"], name, source, changed
            if _last_case[0] == key:
                _, item, case = _last_case
        item = item or resolve_item(source, name)
        runner.measure_case(item, case)
    case = next((row for row in runner.out if row["kind"] == "case"), None)
    _last_case = key, item, case
    return number, runner.out
