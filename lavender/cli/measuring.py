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
    bytes_of,
    console,
    end_stopped,
    going_on,
    one_thread,
    refuse_unused,
    say,
    was_given,
)

if TYPE_CHECKING:
    from lavender.lab.bench import Event, Item, Plan, Records
    from lavender.lab.report.summary_page import SummaryPage

    P = TypeVar("P", bound=Plan)

EVERY = 10.0  # s between two lines of progress where there is no terminal


@dataclass(frozen=True)
class Measured:
    """What a command measured, or found measured."""

    records: Records
    stopped: bool  # by Ctrl-C
    reused: int = 0  # of the records
    since: str = ""  # when those were measured first

    @property
    def note(self) -> str:
        """What was not measured now, in words; empty where everything was."""
        if not self.reused:
            return ""
        return f"{self.reused} of {len(self.records)} runs reused of {self.since}; --no-reuse measures again"

    @property
    def lost(self) -> int:
        """Cases of folders that did not load."""
        return sum(not skip.solver for skip in self.records.skips)


def check_named(items: Sequence[Item]) -> None:
    """Load what was asked for by name, and let go of it.

    Raises
    ------
    InputError
        One of them does not load: nothing is measured, and no page touched.
    """
    from lavender.lab.bench.running.runner import describe_load_error

    for item in items:
        if item.named:
            try:
                _ = item.problem
            except Exception as error:
                raise InputError(describe_load_error(item.source, error)) from None
            item.forget()


def plan_of(asked: Mapping[str, Any], kind: type[P], **more: Any) -> P:
    """The plan that the options of `plan_options` mean; those without a default leave the plan's.

    Raises
    ------
    InputError
        A tolerance, budget or limit that means nothing.
    """
    names = ("tolerances", "budgets", "motion", "prove", "velocity_tolerances", "orders")
    return kind(**{name: asked[name] for name in names if asked[name] is not None}, **more)


def is_campaign(context: click.Context) -> bool:
    """Whether workers measure: error and robustness without times."""
    return was_given(context, "workers") or was_given(context, "backend")


def measure(context: click.Context, files: Sequence[str], path: Path, sweeps: Sequence[int]) -> Measured:
    """Run with a progress bar; without workers, then time the lines that a report would print. `path` has the records.

    Raises
    ------
    InputError
        A file that was named and does not load; a folder that cannot be written or that another process writes.
    """
    from lavender.lab import bench
    from lavender.lab.bench.candidates import time_candidates

    one_thread()
    asked = context.params
    bench.solver_names(asked["solvers"])  # before anything is loaded: names first
    campaign, words = is_campaign(context), list(files)
    more: dict[str, Any] = {}
    plan: Plan
    if campaign:
        workers = asked["workers"] if was_given(context, "workers") else -1
        more = {"workers": workers, "backend": asked["backend"]}
        words = bench.expand_seeds(files, len(asked["seeds"]), asked["seeds"].start)
        if words == list(files):
            refuse_unused(context, ["seeds"], "where no case takes one")
        plan = plan_of({**asked, "orders": asked["orders"] or ()}, bench.CampaignPlan)
    else:
        plan = _timed_plan(asked, files, sweeps)
    reused = 0
    with bench.Store(path) as store:
        items = bench.resolve(words, asked["sequence"])
        if was_given(context, "sequence_time_limit") and not any(item.sequence for item in items):
            raise InputError("--sequence-time-limit has no effect without a sequence: leave it out")
        check_named(items)
        before = {name: run.started for name, run in store.records.runs.items()}
        found: list[Records] = []
        with progress() as bar:

            def watch(event: Event) -> None:
                nonlocal reused
                reused += event.reused
                bar(event)

            stopped = False
            try:
                common: dict[str, Any] = {
                    "watch": watch,
                    "reuse": not asked["no_reuse"],
                    "memory": bytes_of(asked["memory"]),
                }
                bench.run(items, asked["solvers"], plan, store, into=found, **common, **more)
                if not campaign:
                    time_candidates(items, found[0], plan, store, **common)
            except KeyboardInterrupt:
                if not found:
                    raise
                stopped = True
    since = before.get(next(iter(found[0].runs)), "") if reused else ""
    return Measured(found[0], stopped, reused, since.replace("T", " ")[:16])


def _timed_plan(asked: Mapping[str, Any], files: Sequence[str], sweeps: Sequence[int]) -> Plan:
    from lavender.lab.bench import Plan
    from lavender.lab.proof import require

    if asked["sequence"] and not files:
        raise InputError("--sequence needs a folder of problem files, one for each step")
    limits = (
        {"sequence_time_limit": asked["sequence_time_limit"]}
        if asked["sequence_time_limit"] is not None
        else {}
    )
    # without files: all of the suite in a minute
    limits["time_limit"] = (1.0 if files else 0.25) if asked["time_limit"] is None else asked["time_limit"]
    more: dict[str, Any] = {"repeats": asked["repeats"], "times": asked["time_budgets"], "sweeps": sweeps}
    plan = plan_of(asked, Plan, **limits, **more)
    if plan.prove:
        require()
    return plan


def show_page(page: SummaryPage, folder: Path) -> None:
    """Write a page and print its short form; exit if Ctrl-C ended the measurement."""
    path = page.write(folder)
    with going_on():
        page.print_short(console())
        say(f"\npage: {path}")
    if page.stopped:
        end_stopped()


@contextlib.contextmanager
def progress() -> Iterator[Callable[[Event], None]]:
    """What is being measured: a bar on a terminal, elsewhere a line of stderr every EVERY seconds."""
    to = console(stderr=True)
    if not to.is_terminal:
        yield _lines()
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    with Progress(
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[what]}", markup=False),
        console=to,
        transient=True,
        refresh_per_second=4,  # drawing takes time from what is being timed
    ) as bar:
        task = bar.add_task("", total=None, what="")
        yield lambda event: bar.update(
            task, completed=event.done, total=event.total or None, what=_words(event)
        )


def _lines() -> Callable[[Event], None]:
    began = told = time.monotonic()

    def watch(event: Event) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told >= EVERY:
            told = now
            count = f"{event.done} of {event.total}, " if event.total else ""
            click.echo(f"{count}{now - began:.0f} s: {_words(event)}", err=True)

    return watch


def _words(event: Event) -> str:
    return f"{event.case} {event.solver}".strip()
