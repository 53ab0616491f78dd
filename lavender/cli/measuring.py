"""Running a plan or a campaign with a progress bar, for the commands that measure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lavender.cli.options import Asked, bytes_of, console, one_thread
from lavender.errors import InputError

if TYPE_CHECKING:
    from lavender.bench import Event, Item, Plan, Records

__all__ = ["Measured", "check_named", "measure", "run_campaign"]


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
        return f"{self.reused} of {len(self.records)} runs reused of {self.since}; --fresh measures again"

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
    from lavender.bench.running.runner import not_loaded

    for item in items:
        if item.named:
            try:
                _ = item.problem
            except Exception as error:
                raise InputError(not_loaded(item, error)) from None
            item.forget()


def measure(
    files: Sequence[str],
    asked: Asked,
    plan: Plan,
    path: Path,
    sequence: bool | None = None,
    fresh: bool = False,
    *,
    given: Callable[[str], bool] = lambda name: False,
) -> Measured:
    """Run with a progress bar, then time the lines that a report would print, in turns.

    Parameters
    ----------
    given : callable (name)
        Whether an option stands on the command line.

    Raises
    ------
    InputError
        A file that was named and does not load; a folder that cannot be written or that another process writes.
    """
    from lavender import bench
    from lavender.report.contenders import time_lines

    one_thread()
    bench.solver_names(asked.solvers)  # before anything is loaded: names first
    if sequence and not files:
        raise InputError("--sequence needs a folder of problem files, one for each step")
    reused = 0
    with bench.Store(path) as store:
        items = bench.resolve(files, sequence)
        if given("pass_limit") and not any(item.sequence for item in items):
            raise InputError("--pass-limit has no effect without a sequence: leave it out")
        check_named(items)
        before = {name: run.started for name, run in store.records.runs.items()}
        found: list[Records] = []
        with _Progress() as bar:

            def watch(event: Event) -> None:
                nonlocal reused
                reused += event.reused
                bar(event)

            stopped = False
            try:
                more: dict[str, Any] = {"watch": watch, "fresh": fresh, "memory": bytes_of(asked.memory)}
                bench.run(items, asked.solvers, plan, store, into=found, **more)
                time_lines(items, found[0], plan, store, **more)
            except KeyboardInterrupt:
                stopped = True
    since = before.get(next(iter(found[0].runs)), "") if reused else ""
    return Measured(found[0], stopped, reused, since.replace("T", " ")[:16])


def run_campaign(
    words: Sequence[str],
    asked: Asked,
    path: Path,
    *,
    workers: int,
    backend: str,
) -> Measured:
    """Run a campaign with a progress bar; raises as `measure`."""
    from lavender import bench

    one_thread()
    check_named(bench.resolve(words))
    plan = bench.CampaignPlan(
        levels=asked.levels, budgets=asked.budgets, orders=asked.orders or (), motion=asked.motion,
        speed_levels=asked.speed_levels,
    )  # fmt: skip
    with bench.Store(path) as store, _Progress() as watch:
        try:
            made = bench.campaign(
                words, asked.solvers, plan, store, workers=workers, backend=backend, watch=watch,
                memory=bytes_of(asked.memory),
            )  # fmt: skip
        except KeyboardInterrupt:
            return Measured(bench.read(path).latest(), True)
        return Measured(made, False)


class _Progress:
    """A progress bar over pairs of case and solver, on a terminal; silent elsewhere."""

    def __enter__(self) -> Callable[[Event], None]:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self.bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[what]}", markup=False),
            console=console(stderr=True),
            transient=True,
            refresh_per_second=4,  # drawing takes time from what is being timed
        )
        self.bar.start()
        task = self.bar.add_task("", total=None, what="")

        def watch(event: Event) -> None:
            self.bar.update(
                task, completed=event.done, total=event.total, what=f"{event.case} {event.solver}".strip()
            )

        return watch

    def __exit__(self, *_: object) -> None:
        self.bar.stop()
