"""Define `lavender report`."""

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
    ManyValues,
    Seeds,
    ValueList,
    console,
    echo,
    plan_options,
    recording_options,
    reject_idle,
    reject_unused,
    reject_unused_recording,
    was_given,
)
from lavender.io.stored import lock_output, write_text


@click.command(cls=MultiValueCommand)
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@plan_options
@click.option(
    "--out", type=PATH, default=Path("lavender-report"), show_default=True, help="Folder for the report."
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
    help="Measure errors and robustness without times, with this number of processes; -1: one for each core.",
)
@click.option(
    "--backend",
    default="loky",
    show_default=True,
    help="Measure errors and robustness with the workers of a joblib backend, such as dask.",
)
@click.option(
    "--seeds",
    type=SeedRange(),
    default="1",
    metavar="N | A:B",
    help="With --workers: seeds 0 to N - 1, or A to B - 1, of cases that have a seed.",
)
@click.option("--compare", type=PATH, help="Compare with earlier records (.jsonl, or their folder).")
@click.option(
    "--time-budgets",
    type=ValueList(float),
    default=(),
    metavar="S,S,...",
    help="Time budgets in seconds, each with a recommended solver; default: three decades around the fastest times.",
)
@recording_options
@click.option("--tables", is_flag=True, help="Print every table, warning and line of code.")
@click.option("--fresh", is_flag=True, help="Repeat runs whose records the folder holds.")
@click.option(
    "--paper",
    is_flag=True,
    help="Also write PDF figures, LaTeX tables and a paragraph on the method to OUT/paper.",
)
@click.option("--no-figures", is_flag=True, help="Do not write SVG and PNG files.")
@click.pass_context
def report(context: click.Context, /, files: tuple[str, ...], out: Path, **options: Any) -> None:
    """Measure speed and error of every solver on every case.

    Each solver runs to each level of residual and with each budget. FILES are problems (.npz, .hdf5), folders of them,
    folders of recorded steps, or cases of the built-in suite such as "stack(n=64)"; without any, the built-in suite
    runs. A MuJoCo model (.xml) is simulated first, and its steps are recorded in the folder of the report. A
    records.jsonl is shown again without solving. After an interruption, the same command continues where it stopped.

    Exit code 1: a file in a folder cannot be read, a step could not be recorded, or nothing was measured. Exit code 2:
    a named file cannot be read, or another report is writing to the folder.
    """
    from lavender.lab import bench
    from lavender.lab.report.engine import read_engine_answers
    from lavender.lab.report.findings import Report
    from lavender.lab.report.terminal import print_report
    from lavender.lab.report.text import format_count, list_reasons
    from lavender.lab.report.write import write

    for limit in options["time_budgets"]:
        if not (math.isfinite(limit) and limit > 0.0):
            raise InputError(f"time budget {limit} must be a positive number of seconds")
    _reject_unused(context, files, options["solvers"])
    context.with_resource(lock_output(out, folder=True))
    taken: set[Path] = set()
    recording = {name: options[name] for name in RECORDING}
    files = tuple(_record_model(f, out, taken, options["fresh"], recording) for f in files)
    earlier = None if options["compare"] is None else bench.read(options["compare"])
    sweeps = options["budgets"] if was_given(context, "budgets") else ()
    path = out / "records.jsonl"
    record_files = [f for f in files if f.endswith(".jsonl")]
    if record_files:
        if len(files) > 1:
            raise InputError("a records.jsonl is shown alone: give one, and no problems")
        result = Measured(bench.read(record_files[0]), False)
        if not (result.records.records or result.records.skips):
            raise InputError(f"{record_files[0]} holds no records: there is nothing to show")
    else:
        result = measure(context, files, path, sweeps)
    engines = [] if is_campaign(context) else read_engine_answers(files, result.records.latest())
    data = Report(result.records, earlier, options["time_budgets"], sweeps, engines)
    # Write the page before printing: a closed pipe may end the command.
    index = write(data, out, figures=not options["no_figures"])
    paper = None
    if options["paper"]:
        from lavender.lab.report.latex_export import write_paper

        paper = write_paper(data, out / "paper")
    print_report(data, console(), complete=options["tables"])
    if paper is not None:
        echo(f"figures, tables and method of a paper: {paper}")
    echo(f"\n{format_count(len(result.records), 'run')}; page: {index}")
    if result.note:
        echo(result.note)
    if result.stopped:
        echo("Stopped; the same command continues from here.", style="yellow")
        raise click.exceptions.Exit(EXIT_INTERRUPTED)
    if not (record_files or result.records.records):
        echo(f"nothing was measured: {'; '.join(list_reasons(result.records.skips))}", style="yellow")
        raise click.exceptions.Exit(EXIT_UNMET)
    if result.lost and not record_files:
        echo(f"{format_count(result.lost, 'case')} of a folder left out of every number", style="yellow")
        raise click.exceptions.Exit(EXIT_UNMET)


def _reject_unused(context: click.Context, files: tuple[str, ...], solvers: tuple[str, ...] | None) -> None:
    """Reject every option that would be ignored."""
    if any(f.endswith(".jsonl") for f in files):
        description_file = {
            "files",
            "out",
            "compare",
            "time_budgets",
            "budgets",
            "tables",
            "paper",
            "no_figures",
        }
        rest = [p.name for p in context.command.params if p.name and p.name not in description_file]
        reject_unused(context, rest, "if records are shown again and nothing is solved")
    elif is_campaign(context):
        timing_options = ["repeats", "time_limit", "pass_limit", "time_budgets", "sequence"]
        reject_unused(
            context, timing_options, "with --workers, which measures no times and ends by iterations"
        )
        reject_unused(context, ["prove"], "with --workers, which measures too many problems")
    else:
        reject_unused(context, ["seeds"], "without --workers")
    reject_unused_recording(context, any(Path(f).suffix.lower() == ".xml" for f in files))
    reject_idle(context, solvers)


def _record_model(word: str, out: Path, taken: set[Path], fresh: bool, recording: Mapping[str, Any]) -> str:
    """Return the folder of a model's recorded steps; record them unless they were recorded in the same way.

    The folder is named by the model's folder and file, as many models are called scene.xml. `taken` holds the folders
    of the models before it. Other words are returned unchanged.
    """
    path = Path(word)
    if path.suffix.lower() != ".xml":
        return word
    from lavender.io.recording import record_file
    from lavender.lab.bench.record import file_name

    model, n = str(path.resolve()), 1
    first = out / "recorded" / file_name(f"{path.resolve().parent.name}-{path.stem}")
    folder = first
    while folder in used_folders or _read_recorded_model(folder) not in ("", model):
        n += 1
        folder = first.with_name(f"{first.name}-{n}")
    taken.add(folder)
    description_file = folder / "how.json"
    options = json.dumps(
        {
            "model": model,
            "changed": _modification_times(path, recording["control"], recording["states"]),
            **recording,
        }
    )
    if fresh or not description_file.is_file() or description_file.read_text(encoding="utf-8") != options:
        description_file.unlink(missing_ok=True)  # If the recording is stopped, it is not reused.
        echo(str(record_file(path, folder, **recording, replace=True)))
        write_text(description_file, options)
    return str(folder)


def _model_of(folder: Path) -> str:
    """Return the model whose steps a folder holds; empty if it holds none."""
    try:
        return str(json.loads((folder / "how.json").read_text(encoding="utf-8"))["model"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""


def _modification_times(path: Path, controls: str, states: str | None) -> list[float]:
    """Return the modification times of the model, the files that it includes, its controls and its start states."""
    try:
        times = [path.stat().st_mtime]
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    try:
        from mujoco import FatalError, mju_getXMLDependencies
    except ImportError:  # MuJoCo is missing, or an older version.
        return times
    # An invalid model raises an error when it is read.
    with contextlib.suppress(ValueError, RuntimeError, FatalError):
        others = (*sorted(mju_getXMLDependencies(str(path))), controls, states or "")
        times += [p.stat().st_mtime for p in map(Path, others) if p.is_file()]
    return times
