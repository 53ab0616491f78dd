"""Run a plan with a progress bar, for the commands that measure."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from lavender.base.errors import InputError
from lavender.base.lazy_import import pandas as pd
from lavender.cli.options import (
    exit_after_interrupt,
    is_option_set,
    limit_to_one_thread,
    make_console,
    print_escaped,
)

if TYPE_CHECKING:
    from lavender.audit.page import ResultPage
    from lavender.report import Event, Plan


REDRAW_INTERVAL = 0.25  # [s] Time between two updates of the progress on a terminal.


class Measured(NamedTuple):
    """Lines of a measuring command, measured by this call or reused from its output folder."""

    lines: pd.DataFrame
    stopped: bool  # Whether Ctrl-C ended the measurement.
    reuse_note: str = (
        ""  # Sentence on the number of reused runs; empty if this call measured all of them.
    )


def is_campaign(context: click.Context) -> bool:
    """Return whether the options ask for a campaign: workers that measure errors and robustness but no times."""
    return is_option_set(context, "workers") or is_option_set(context, "backend")


def measure_files(
    context: click.Context, files: Sequence[str], path: Path, show_event: Callable[[Event], None]
) -> Measured:
    """Measure solvers on files, and call `show_event` with the progress.

    With workers nothing is timed. `path` is the records file.
    """
    from lavender import report
    from lavender.report.store import get_key, make_lines, select_machines
    from lavender.solvers import registry

    limit_to_one_thread()
    options = context.params
    report.select_solver_names(
        options["solvers"]
    )  # Reject unknown names before a problem is loaded.
    solvers = options["solvers"]
    if options["sweeps"] and not solvers:
        specs = registry.specs()
        solvers = [
            name
            for name in report.select_solver_names(None)
            if specs[name].order and specs[name].resumable
        ]
    plan, workers = _make_plan(context, files)
    reused = 0
    with report.Store(path) as store:
        items = report.resolve_sources(list(files), options["sequence"])
        if is_option_set(context, "sequence_time_limit") and not any(
            item.sequence for item in items
        ):
            raise InputError("--sequence-time-limit has no effect without a sequence: leave it out")
        if options["sweeps"] and not any(item.sequence for item in items):
            raise InputError(
                "--sweeps needs recorded steps in sequence: a folder that lv.io.Recorder(every=1), `lavender record` "
                "or `lavender run --record` wrote, or --sequence for any folder of consecutive steps"
            )
        before = {
            name: machine["started"] for name, machine in select_machines(store.lines).items()
        }
        rows: list[dict[str, Any]] = []

        def count_event(event: Event) -> None:
            nonlocal reused
            reused += event.reused
            show_event(event)

        stopped = False
        try:
            report.run(
                items,
                solvers,
                plan,
                store,
                watch=count_event,
                into=rows,
                reuse=not options["no_reuse"],
                **workers,
            )
        except KeyboardInterrupt:
            if not rows:
                raise
            stopped = True
    dropped = "An incomplete last line of the records was dropped. " * store.lines.attrs["dropped"]
    lines = make_lines(rows, str(path))
    if not reused:
        return Measured(lines, stopped, dropped)
    since = before.get(rows[0]["run"], "").replace("T", " ")[:16]
    n_runs = len({get_key(row) for row in rows if row["kind"] == "run"})
    note = f"{reused} of {n_runs} runs of {since} reused; --no-reuse measures again"
    return Measured(lines, stopped, dropped + note)


def _make_plan(context: click.Context, files: Sequence[str]) -> tuple[Plan, dict[str, Any]]:
    """Return the plan of a report, and the workers of a campaign as arguments of `lavender.report.run`."""
    from lavender.report import CampaignPlan, Plan

    options = context.params
    names = ("tolerances", "budgets")
    values = {name: options[name] for name in names if options[name] is not None}
    values |= {"tolerances": ()} if options["sweeps"] else {}
    if is_campaign(context):
        workers = options["workers"] if is_option_set(context, "workers") else -1
        return CampaignPlan(**values), {"workers": workers, "backend": options["backend"]}
    if options["sequence"] and not files:
        raise InputError("--sequence needs a folder of problem files, one for each step")
    if options["sequence_time_limit"] is not None:
        values["sequence_time_limit"] = options["sequence_time_limit"]
    # Without files, the built-in suite runs; with the shorter time limit it takes about a minute.
    limit = (1.0 if files else 0.25) if options["time_limit"] is None else options["time_limit"]
    return Plan(**values, repeats=options["repeats"], time_limit=limit), {}


def show_page(page: ResultPage, folder: Path, is_quiet: bool = False) -> None:
    """Write a page and print its short form, or only its path; exit if Ctrl-C ended the measurement."""
    path = page.write(folder)
    if is_quiet:
        print_escaped(str(path))
    else:
        page.print_short(make_console())
        print_escaped(f"\npage: {path}")
    if page.is_stopped:
        exit_after_interrupt()


@contextlib.contextmanager
def show_progress(is_quiet: bool = False) -> Iterator[Callable[[Event], None]]:
    """Yield a callback that shows progress on stderr if it is a terminal, unless `is_quiet`."""
    from rich.progress import (
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = make_console(stderr=True)
    columns = (
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}", markup=False),
    )
    drawn = 0.0
    # Without `auto_refresh`: the thread that redraws would disturb the times that are measured.
    with Progress(
        *columns,
        console=console,
        auto_refresh=False,
        transient=True,
        disable=is_quiet or not console.is_terminal,
    ) as progress:
        task = progress.add_task("starting", total=None)

        def show_event(event: Event) -> None:
            nonlocal drawn
            if (now := time.monotonic()) - drawn > REDRAW_INTERVAL:
                drawn = now
                current = ": ".join(
                    filter(None, (event.phase, f"{event.case} {event.solver}".strip()))
                )
                progress.update(
                    task, description=current, completed=event.done, total=event.total or None
                )
                progress.refresh()

        yield show_event
