"""Run a plan with a progress bar, for the commands that measure."""

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
    continue_after_closed_output,
    convert_gigabytes_to_bytes,
    exit_after_interrupt,
    is_option_set,
    limit_to_one_thread,
    make_console,
    print_escaped,
)

if TYPE_CHECKING:
    from lavender.report import Event, Item, Plan, Records
    from lavender.report.summary_page import SummaryPage

    P = TypeVar("P", bound=Plan)

BAR_WIDTH = 40  # Largest width of a progress bar in characters; a narrow terminal has a shorter one.
PROGRESS_INTERVAL = 10.0  # [s] Time between two lines of progress if the output is not a terminal.
MIN_ELAPSED = 1.0  # [s] The remaining time is not estimated from a shorter time.


@dataclass(frozen=True)
class Measured:
    """Records of a measuring command, measured by this call or reused from its output folder.

    Parameters
    ----------
    records : Records
    stopped : whether Ctrl-C ended the measurement
    reused : number of records that were not measured again
    since : date of the first reused record
    """

    records: Records
    stopped: bool
    reused: int = 0
    since: str = ""

    @property
    def reuse_note(self) -> str:
        """Sentence on the number of reused records; empty if this call measured all records."""
        if not self.reused:
            return ""
        return f"{self.reused} of {len(self.records)} runs of {self.since} reused; --no-reuse measures again"

    @property
    def n_cases_not_loaded(self) -> int:
        """Number of cases in folders that did not load."""
        return sum(not skip.solver for skip in self.records.skips)


def check_named_problems_load(items: Sequence[Item]) -> None:
    """Load each named problem and release its memory.

    Raises
    ------
    InputError
        A problem does not load. Nothing has been measured and no page changed.
    """
    from lavender.report.runner import describe_load_error

    for item in items:
        if item.named:
            try:
                _ = item.problem
            except Exception as error:
                raise InputError(describe_load_error(item.source, error)) from None
            item.release_problem()


def make_plan(options: Mapping[str, Any], kind: type[P], **more: Any) -> P:
    """Make a plan of class `kind` from the values of `PLAN_OPTIONS`; options that are None keep the plan's default.

    Raises
    ------
    InputError
        A tolerance, budget or limit is invalid.
    """
    names = ("tolerances", "budgets", "orders")
    return kind(**{name: options[name] for name in names if options[name] is not None}, **more)


def is_campaign(context: click.Context) -> bool:
    """Return whether the options ask for a campaign: workers that measure errors and robustness but no times."""
    return is_option_set(context, "workers") or is_option_set(context, "backend")


def measure_files(
    context: click.Context, files: Sequence[str], path: Path, show_event: Callable[[Event], None]
) -> Measured:
    """Measure solvers on files, and call `show_event` with the progress.

    With workers nothing is timed. `path` is the records file.

    Raises
    ------
    InputError
        A named file does not load, or the folder cannot be written or is in use by another process.
    """
    from lavender import report

    limit_to_one_thread()
    options = context.params
    report.select_solver_names(options["solvers"])  # Reject unknown names before a problem is loaded.
    more: dict[str, Any] = {}
    plan: Plan
    if is_campaign(context):
        workers = options["workers"] if is_option_set(context, "workers") else -1
        more = {"workers": workers, "backend": options["backend"]}
        plan = make_plan({**options, "orders": options["orders"] or ()}, report.CampaignPlan)
    else:
        plan = _make_timed_plan(options, files)
    reused = 0
    with report.Store(path) as store:
        items = report.resolve_sources(list(files), options["sequence"])
        if is_option_set(context, "sequence_time_limit") and not any(item.sequence for item in items):
            raise InputError("--sequence-time-limit has no effect without a sequence: leave it out")
        check_named_problems_load(items)
        before = {name: run.started for name, run in store.records.runs.items()}
        measured: list[Records] = []

        def count_event(event: Event) -> None:
            nonlocal reused
            reused += event.reused
            show_event(event)

        stopped = False
        try:
            memory = convert_gigabytes_to_bytes(options["memory"])
            reuse = not options["no_reuse"]
            report.run(
                items, options["solvers"], plan, store, watch=count_event, memory=memory, into=measured,
                reuse=reuse, **more,
            )  # fmt: skip
        except KeyboardInterrupt:
            if not measured:
                raise
            stopped = True
    since = before.get(next(iter(measured[0].runs)), "") if reused else ""
    return Measured(measured[0], stopped, reused, since.replace("T", " ")[:16])


def _make_timed_plan(options: Mapping[str, Any], files: Sequence[str]) -> Plan:
    """Make the plan of a report that measures times."""
    from lavender.report import Plan

    if options["sequence"] and not files:
        raise InputError("--sequence needs a folder of problem files, one for each step")
    limits = (
        {"sequence_time_limit": options["sequence_time_limit"]}
        if options["sequence_time_limit"] is not None
        else {}
    )
    # Without files, the built-in suite runs; with the shorter time limit it takes about a minute.
    limits["time_limit"] = (
        (1.0 if files else 0.25) if options["time_limit"] is None else options["time_limit"]
    )
    return make_plan(options, Plan, repeats=options["repeats"], **limits)


def show_page(page: SummaryPage, folder: Path) -> None:
    """Write a page and print its short form; exit if Ctrl-C ended the measurement."""
    path = page.write(folder)
    with continue_after_closed_output():
        page.print_short(make_console())
        print_escaped(f"\npage: {path}")
    if page.stopped:
        exit_after_interrupt()


@contextlib.contextmanager
def explain_early_interrupt(first_result: str) -> Iterator[None]:
    """Give the exception of Ctrl-C a message with the time so far and with `first_result`, which is not complete."""
    began = time.monotonic()
    try:
        yield
    except KeyboardInterrupt:
        elapsed = time.monotonic() - began
        raise KeyboardInterrupt(
            f"nothing was complete yet after {elapsed:.1f} s; the first result is {first_result}"
        ) from None


@contextlib.contextmanager
def show_progress() -> Iterator[Callable[[Event], None]]:
    """Yield a callback that shows progress: a bar on a terminal, otherwise a line on stderr every few seconds."""
    to = make_console(stderr=True)
    if not to.is_terminal:
        yield _print_progress_lines()
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    def keep_width() -> Column:
        """Return a column that is not narrowed."""
        return Column(no_wrap=True)

    class ShortenedColumn(TextColumn):
        """Text that is cut if the terminal is narrow. Rich narrows columns that may wrap before all others."""

        def __init__(self, text: str) -> None:
            super().__init__(text, markup=False, table_column=Column())

        def render(self, task: Any) -> Any:
            text = super().render(task)
            text.no_wrap, text.overflow = True, "ellipsis"
            return text

    with Progress(
        BarColumn(min(BAR_WIDTH, to.width // 8), table_column=keep_width()),
        MofNCompleteColumn(table_column=keep_width()),
        TimeElapsedColumn(table_column=keep_width()),
        TextColumn("{task.fields[remaining]}", markup=False),
        ShortenedColumn("{task.fields[what]}"),
        console=to,
        transient=True,
        refresh_per_second=4,  # Drawing more often would take processor time from the measurement.
    ) as bar:
        task = bar.add_task("", total=None, what="starting", remaining="")
        pace = Pace()

        def show_event(event: Event) -> None:
            if pace.count_event(
                event
            ):  # Another phase begins: its count, clock and remaining time are its own.
                bar.reset(task)
            remaining = pace.format_remaining_time(event)
            bar.update(
                task,
                completed=event.done,
                total=event.total or None,
                remaining=f"{remaining}:" if remaining else "",
                what=_format_event(event),
            )

        yield show_event


def _print_progress_lines() -> Callable[[Event], None]:
    """Return a callback that prints a line of progress every `PROGRESS_INTERVAL` seconds."""
    pace, printed = Pace(), time.monotonic()

    def show_event(event: Event) -> None:
        nonlocal printed
        pace.count_event(event)
        now = time.monotonic()
        if now - printed >= PROGRESS_INTERVAL:
            printed = now
            count = f"{event.done} of {event.total}, " if event.total else ""
            remaining = pace.format_remaining_time(event)
            remaining = f", {remaining}" if remaining else ""
            click.echo(f"{count}{pace.elapsed:.0f} s{remaining}: {_format_event(event)}", err=True)

    return show_event


class Pace:
    """Clock of a phase, from which the remaining time is estimated. Reused results take no time and do not count."""

    def __init__(self) -> None:
        self.phase, self.began, self.reused_until = "", time.monotonic(), 0

    @property
    def elapsed(self) -> float:
        """Time [s] since the phase began."""
        return time.monotonic() - self.began

    def count_event(self, event: Event) -> bool:
        """Return whether an event begins another phase, after the first."""
        if event.reused:
            self.began, self.reused_until = time.monotonic(), event.done + 1
        begins = event.phase != self.phase
        if begins:
            self.phase, self.began, self.reused_until = event.phase, time.monotonic(), event.done
        return begins

    def format_remaining_time(self, event: Event) -> str:
        """Return a phrase such as "about 40 s remain"; empty if it is too early, or if steps take unequal times."""
        if event.phase == "writing":
            return ""
        return format_remaining_time(event, self.elapsed, event.done - self.reused_until)


def format_remaining_time(event: Event, elapsed: float, done: int | None = None) -> str:
    """Return a phrase such as "about 40 s remain" from the time [s] in which `done` were done, by default all."""
    remaining, done = event.remaining, event.done if done is None else done
    if remaining is None:
        if not (event.total and done > 0 and elapsed >= MIN_ELAPSED):
            return ""
        remaining = elapsed * (event.total - event.done) / done
    if remaining < 90.0:
        return f"about {max(1, round(remaining))} s remain"
    return f"about {round(remaining / 60.0)} min remain"


def _format_event(event: Event) -> str:
    text = f"{event.case} {event.solver}".strip()
    return f"{event.phase}: {text}" if event.phase else text
