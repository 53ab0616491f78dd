"""Run a measurement plan with a progress bar."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lavender.base.errors import InputError
from lavender.cli.options import (
    console,
    echo,
    exit_interrupted,
    ignore_closed_pipe,
    reject_unused,
    set_one_thread,
    to_bytes,
    was_given,
)

if TYPE_CHECKING:
    from lavender.lab.bench import Event, Item, Plan, Records
    from lavender.lab.report.summary_page import SummaryPage

    P = TypeVar("P", bound=Plan)

PROGRESS_INTERVAL = 10.0  # [s] Time between two lines of progress if the output is not a terminal.


@dataclass(frozen=True)
class Measured:
    """Records that a command measured or reused.

    Parameters
    ----------
    records : Records
    stopped : bool
        The measurement was stopped by Ctrl-C.
    reused : int
        Number of records that an earlier run had measured.
    since : str
        Start of that run.
    """

    records: Records
    stopped: bool
    reused: int = 0
    since: str = ""

    @property
    def note(self) -> str:
        """Sentence about the records that were reused; empty if all were measured now."""
        if not self.reused:
            return ""
        return f"{self.reused} of {len(self.records)} runs of {self.since} reused; --no-reuse measures again"

    @property
    def lost(self) -> int:
        """Number of cases in folders that did not load."""
        return sum(not skip.solver for skip in self.records.skips)


def check_named(items: Sequence[Item]) -> None:
    """Load the items that were requested by name, and release their memory.

    Raises
    ------
    InputError
        One of them does not load: nothing is measured, and no page is changed.
    """
    from lavender.lab.bench.running.runner import describe_load_error

    for item in items:
        if item.named:
            try:
                _ = item.problem
            except Exception as error:
                raise InputError(describe_load_error(item.source, error)) from None
            item.forget()


def plan_of(options: Mapping[str, Any], kind: type[P], **extra_options: Any) -> P:
    """Build the plan of the options `plan_options`; options without a value keep the plan's default.

    Raises
    ------
    InputError
        A level, budget or limit is invalid.
    """
    names = ("levels", "budgets", "motion", "prove", "speed_levels", "orders")
    return kind(**{name: options[name] for name in names if options[name] is not None}, **extra_options)


def is_campaign(context: click.Context) -> bool:
    """Whether workers measure: errors and robustness, without times."""
    return was_given(context, "workers") or was_given(context, "backend")


def measure(context: click.Context, files: Sequence[str], path: Path, sweeps: Sequence[int]) -> Measured:
    """Run a plan with a progress bar and store the records in `path`; without workers, also time the report's lines.

    Raises
    ------
    InputError
        A named file does not load; the folder cannot be written, or another process is writing to it.
    """
    from lavender.lab import bench
    from lavender.lab.bench.candidates import time_candidates

    set_one_thread()
    options = context.params
    bench.solver_names(options["solvers"])  # Check the names before any file is loaded.
    campaign, cases = is_campaign(context), list(files)
    extra_options: dict[str, Any] = {}
    plan: Plan
    if campaign:
        workers = options["workers"] if was_given(context, "workers") else -1
        extra_options = {"workers": workers, "backend": options["backend"]}
        cases = bench.expand_seeds(files, len(options["seeds"]), options["seeds"].start)
        if cases == list(files):
            reject_unused(context, ["seeds"], "because no case has a seed")
        plan = plan_of({**options, "orders": options["orders"] or ()}, bench.CampaignPlan)
    else:
        plan = _timed_plan(options, files, sweeps)
    reused = 0
    with bench.Store(path) as store:
        items = bench.resolve(cases, options["sequence"])
        if was_given(context, "pass_limit") and not any(item.sequence for item in items):
            raise InputError("--pass-limit has no effect without a sequence: leave it out")
        check_named(items)
        started_of = {name: run.started for name, run in store.records.runs.items()}
        collected: list[Records] = []
        with progress() as bar:

            def count_reused(event: Event) -> None:
                """Show an event and count reused records."""
                nonlocal reused
                reused += event.reused
                bar(event)

            stopped = False
            try:
                common = {
                    "watch": count_reused,
                    "fresh": options["fresh"],
                    "memory": to_bytes(options["memory"]),
                }
                bench.run(items, options["solvers"], plan, store, into=collected, **common, **extra_options)
                if not campaign:
                    time_candidates(items, collected[0], plan, store, **common)
            except KeyboardInterrupt:
                if not collected:
                    raise
                stopped = True
    since = started_of.get(next(iter(collected[0].runs)), "") if reused else ""
    return Measured(collected[0], stopped, reused, since.replace("T", " ")[:16])


def _timed_plan(options: Mapping[str, Any], files: Sequence[str], sweeps: Sequence[int]) -> Plan:
    """Build the plan of a run that measures times."""
    from lavender.lab.bench import Plan
    from lavender.lab.proof import require_python_flint

    if options["sequence"] and not files:
        raise InputError("--sequence needs a folder of problem files, one for each step")
    limits = {"pass_limit": options["pass_limit"]} if options["pass_limit"] is not None else {}
    # Without files, the whole suite runs in about a minute.
    limits["time_limit"] = (
        (1.0 if files else 0.25) if options["time_limit"] is None else options["time_limit"]
    )
    extra_options: dict[str, Any] = {
        "repeats": options["repeats"],
        "times": options["time_budgets"],
        "sweeps": sweeps,
    }
    plan = plan_of(options, Plan, **limits, **extra_options)
    if plan.prove:
        require_python_flint()
    return plan


def show_page(page: SummaryPage, folder: Path) -> None:
    """Write a page and print its short form; exit with 130 if Ctrl-C ended the measurement."""
    path = page.write(folder)
    with ignore_closed_pipe():
        page.print_short(console())
        echo(f"\npage: {path}")
    if page.stopped:
        exit_interrupted()


@contextlib.contextmanager
def progress() -> Iterator[Callable[[Event], None]]:
    """Show progress: a bar on a terminal, otherwise a line on stderr every PROGRESS_INTERVAL seconds."""
    terminal = console(stderr=True)
    if not terminal.is_terminal:
        yield _progress_printer()
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[what]}", markup=False),
        console=terminal,
        transient=True,
        refresh_per_second=4,  # Drawing takes processor time from the measurement.
    ) as bar:
        task = bar.add_task("", total=None, what="")
        yield lambda event: bar.update(
            task, completed=event.done, total=event.total or None, what=_describe_event(event)
        )


def _progress_printer() -> Callable[[Event], None]:
    """Return a function that prints a line of progress every PROGRESS_INTERVAL seconds."""
    began = printed = time.monotonic()

    def print_progress(event: Event) -> None:
        """Print an event unless the last line is recent."""
        nonlocal printed
        now = time.monotonic()
        if now - printed >= PROGRESS_INTERVAL:
            printed = now
            count = f"{event.done} of {event.total}, " if event.total else ""
            click.echo(f"{count}{now - began:.0f} s: {_describe_event(event)}", err=True)

    return print_progress


def _describe_event(event: Event) -> str:
    """Return the case and the solver of an event."""
    return f"{event.case} {event.solver}".strip()
