"""`lavender report`."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from lavender.base.errors import InputError
from lavender.cli.measuring import Measured, is_campaign, measure
from lavender.cli.options import (
    EXIT_INTERRUPTED,
    EXIT_UNMET,
    PATH,
    RECORDING,
    Listed,
    ManyValues,
    Seeds,
    console,
    plan_options,
    recording_options,
    refuse_idle,
    refuse_unused,
    refuse_unused_recording,
    say,
    was_given,
)
from lavender.io.stored import lock_output, write_text


@click.command(cls=ManyValues)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@plan_options
@click.option(
    "--out", type=PATH, default=Path("lavender-report"), show_default=True, help="Folder of the report."
)
@click.option(
    "--sequence/--no-sequence",
    default=None,
    help="Treat each FOLDER as consecutive steps of a simulation, and carry impulses from step to step. Default: only "
    "folders that `lavender run --record` wrote.",
)
@click.option(
    "--workers",
    type=int,
    default=None,
    help="Measure error and robustness without times, with this number of processes; -1: one for each core.",
)
@click.option(
    "--backend",
    default="loky",
    show_default=True,
    help="The same with the workers of a backend of joblib, such as dask.",
)
@click.option(
    "--seeds",
    type=Seeds(),
    default="1",
    metavar="N | A:B",
    help="With --workers: seeds 0 to N - 1, or A to B - 1, of cases that take one.",
)
@click.option("--compare", type=PATH, help="Compare with earlier records (.jsonl, or their folder).")
@click.option(
    "--time-budgets",
    type=Listed(float),
    default=(),
    metavar="S,S,...",
    help="Time budgets in seconds, each with a recommended solver; default: three decades around the fastest times.",
)
@recording_options
@click.option("--tables", is_flag=True, help="Print every table, warning and line of code.")
@click.option("--no-reuse", is_flag=True, help="Repeat runs that the folder already holds.")
@click.option(
    "--paper",
    is_flag=True,
    help="Also write PDF figures, LaTeX tables and a paragraph on the method to OUT/paper.",
)
@click.option("--no-figures", is_flag=True, help="Do not write SVG and PNG files.")
@click.pass_context
def report(context: click.Context, /, files: tuple[str, ...], out: Path, **asked: Any) -> None:
    """Measure speed against error: every solver on every case, to each tolerance and with each budget.

    FILES are problems (.npz, .hdf5), folders of them, folders of recorded steps, or cases of the built-in
    suite such as "stack(n=64)"; without any, the built-in suite runs. A MuJoCo model (.xml) is simulated first,
    and its steps are recorded in the folder of the report. A records.jsonl is shown again
    without solving. After an interruption, the same command continues where it stopped.

    Exit code 1: a file in a folder cannot be read, a step could not be recorded, or nothing was measured. Exit code 2:
    a named file cannot be read, or another report is writing to the folder.
    """
    from lavender.lab import bench
    from lavender.lab.report.engine import read_engine_answers
    from lavender.lab.report.findings import Report
    from lavender.lab.report.terminal import print_report
    from lavender.lab.report.text import format_count, list_reasons
    from lavender.lab.report.write import write

    for limit in asked["time_budgets"]:
        if not (math.isfinite(limit) and limit > 0.0):
            raise InputError(f"time budget {limit} must be a positive number of seconds")
    _refuse_unused(context, files, asked["solvers"])
    context.with_resource(lock_output(out, folder=True))
    taken: set[Path] = set()
    how = {name: asked[name] for name in RECORDING}
    files = tuple(_recorded(f, out, taken, not asked["no_reuse"], how) for f in files)
    old = None if asked["compare"] is None else bench.read(asked["compare"])
    sweeps = asked["budgets"] if was_given(context, "budgets") else ()
    path = out / "records.jsonl"
    again = [f for f in files if f.endswith(".jsonl")]
    if again:
        if len(files) > 1:
            raise InputError("a records.jsonl is shown alone: give one, and no problems")
        done = Measured(bench.read(again[0]), False)
        if not (done.records.records or done.records.skips):
            raise InputError(f"{again[0]} holds no records: there is nothing to show")
    else:
        done = measure(context, files, path, sweeps)
    engines = [] if is_campaign(context) else read_engine_answers(files, done.records.latest())
    shown = Report(done.records, old, asked["time_budgets"], sweeps, engines)
    # before a pipe that nobody reads ends the command
    index = write(shown, out, figures=not asked["no_figures"])
    paper = None
    if asked["paper"]:
        from lavender.lab.report.latex_export import write_paper

        paper = write_paper(shown, out / "paper")
    print_report(shown, console(), complete=asked["tables"])
    if paper is not None:
        say(f"figures, tables and method of a paper: {paper}")
    say(f"\n{format_count(len(done.records), 'run')}; page: {index}")
    if done.note:
        say(done.note)
    if done.stopped:
        say("Stopped; the same command continues from here.", style="yellow")
        raise click.exceptions.Exit(EXIT_INTERRUPTED)
    if not (again or done.records.records):
        say(f"nothing was measured: {'; '.join(list_reasons(done.records.skips))}", style="yellow")
        raise click.exceptions.Exit(EXIT_UNMET)
    if done.lost and not again:
        say(f"{format_count(done.lost, 'case')} of a folder left out of every number", style="yellow")
        raise click.exceptions.Exit(EXIT_UNMET)


def _refuse_unused(context: click.Context, files: tuple[str, ...], solvers: tuple[str, ...] | None) -> None:
    """Every option that would be ignored is an error."""
    if any(f.endswith(".jsonl") for f in files):
        kept = {"files", "out", "compare", "time_budgets", "budgets", "tables", "paper", "no_figures"}
        rest = [p.name for p in context.command.params if p.name and p.name not in kept]
        refuse_unused(context, rest, "where records are shown again and nothing is solved")
    elif is_campaign(context):
        of_times = ["repeats", "time_limit", "sequence_time_limit", "time_budgets", "sequence"]
        refuse_unused(context, of_times, "with --workers, which measures no times and ends by iterations")
        refuse_unused(context, ["prove"], "with --workers, which measures too many problems")
    else:
        refuse_unused(context, ["seeds"], "without --workers")
    refuse_unused_recording(context, any(Path(f).suffix.lower() == ".xml" for f in files))
    refuse_idle(context, solvers)


def _recorded(word: str, out: Path, taken: set[Path], reuse: bool, how: Mapping[str, Any]) -> str:
    """A model's file as the folder of its recorded steps, recorded now unless that was done in the same way, `how`.

    The folder is named by the model's own folder and file: many are called scene.xml. `taken` are those of the models
    before it.
    """
    path = Path(word)
    if path.suffix.lower() != ".xml":
        return word
    from lavender.io.recording import record_file
    from lavender.lab.bench.record import file_name

    model, n = str(path.resolve()), 1
    first = out / "recorded" / file_name(f"{path.resolve().parent.name}-{path.stem}")
    folder = first
    while folder in taken or _model_of(folder) not in ("", model):
        n += 1
        folder = first.with_name(f"{first.name}-{n}")
    taken.add(folder)
    kept = folder / "how.json"
    asked = json.dumps({"model": model, "changed": _ages(path, how["control"], how["states"]), **how})
    if not reuse or not kept.is_file() or kept.read_text(encoding="utf-8") != asked:
        kept.unlink(missing_ok=True)  # a recording that is stopped on the way is none
        say(str(record_file(path, folder, **how, replace=True)))
        write_text(kept, asked)
    return str(folder)


def _model_of(folder: Path) -> str:
    """The model whose steps a folder holds; empty where there are none."""
    try:
        return str(json.loads((folder / "how.json").read_text(encoding="utf-8"))["model"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _ages(path: Path, controls: str, states: str | None) -> list[float]:
    """When the model, the files that it includes, its controls and its start states were changed."""
    try:
        found = [path.stat().st_mtime]
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    try:
        from mujoco import FatalError, mju_getXMLDependencies
    except ImportError:  # none, or an earlier one
        return found
    with contextlib.suppress(ValueError, RuntimeError, FatalError):  # no model: said where it is read
        others = (*sorted(mju_getXMLDependencies(str(path))), controls, states or "")
        found += [p.stat().st_mtime for p in map(Path, others) if p.is_file()]
    return found
