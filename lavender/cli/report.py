"""Define `lavender report`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from lavender.base.arrays import check_float
from lavender.base.errors import REPORT_PACKAGES, InputError, require_packages
from lavender.base.exits import EXIT_INTERRUPTED, EXIT_UNMET
from lavender.cli.completion import complete_case_or_file
from lavender.cli.measuring import Measured, is_campaign, measure_files, show_progress
from lavender.cli.options import (
    PATH,
    RECORDING_NAMES,
    ListCommand,
    ListType,
    exit_after_interrupt,
    limit_option,
    make_console,
    plan_options,
    print_escaped,
    quiet_option,
    recording_options,
    reject_options_without_effect,
)
from lavender.io.start_states import MODEL_SUFFIXES
from lavender.io.stored import check_writable
from lavender.report.drawing import FILE_KINDS


@click.command(cls=ListCommand)
@click.argument(
    "files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...", shell_complete=complete_case_or_file
)
@plan_options
@click.option(
    "--out",
    type=PATH,
    default=Path("lavender-report"),
    show_default=True,
    help="Folder of the report.",
)
@click.option(
    "--sequence/--no-sequence",
    default=None,
    help="Treat each FOLDER as consecutive steps of a simulation, and carry impulses from step to step. "
    "Default: only folders of recorded steps, as `lavender run --record` and `lavender record` write them.",
)
@click.option(
    "--workers",
    type=int,
    help="Measure error and robustness without times, with this number of processes; -1: one for each core.",
)
@click.option(
    "--backend",
    default="loky",
    show_default=True,
    help="The same with the workers of a backend of joblib, such as dask.",
)
@click.option(
    "--compare", type=PATH, help="Compare with earlier records (.jsonl, or their folder)."
)
@click.option(
    "--time-budgets",
    type=ListType(float),
    default=(),
    metavar="S,S,...",
    help="Times in seconds for which the report lists the best solver; default: three decades about the "
    "fastest.",
)
@click.option(
    "--sweeps",
    is_flag=True,
    help="Answer how many sweeps a step needs: measure only fixed numbers of sweeps (--budgets) of the "
    "solvers that sweep, on recorded steps in sequence.",
)
@recording_options
@limit_option
@click.option("--tables", is_flag=True, help="Print every table, warning and line of code.")
@click.option("--no-reuse", is_flag=True, help="Repeat runs that the folder already holds.")
@click.option(
    "--no-figures",
    is_flag=True,
    help="Write no figures; they take the largest part of the time of writing.",
)
@click.option(
    "--figure-kinds",
    type=ListType(click.Choice(FILE_KINDS)),
    default="pdf,svg,png",
    show_default=True,
    help="Formats of the figures in OUT/figures.",
)
@click.option(
    "--columns",
    type=ListType(str),
    default=(),
    metavar="A,B,...",
    help="Columns of OUT/tables/solvers.tex: solved, a tolerance such as 1e-6, ratio, slowest, accepted, "
    "false; default: solved and all tolerances.",
)
@quiet_option
@click.option(
    "--list", "listed", is_flag=True, help="List the cases of the built-in suite; measure nothing."
)
@click.pass_context
def report(
    context: click.Context,
    /,
    files: tuple[str, ...],
    out: Path,
    listed: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Measure the time and the error of solvers on problems.

    Every solver runs on every case, to each tolerance and with each budget.

    FILES are problems or quadratic programs (.npz, .hdf5), folders of them, folders of recorded steps, or cases of the
    built-in suite such as "stack(n=64)"; without any, the built-in suite runs. A MuJoCo model (.xml, .mjb) is
    simulated, and its steps are recorded in the folder of the report. For a records.jsonl, the report is written again
    without solving; --solvers then selects the solvers that it shows. After an interruption, the same command continues
    where it stopped.

    Exit code 1: a file cannot be read (the others are reported), a step could not be recorded, or nothing was measured.
    Exit code 2: a file does not exist.
    """
    reject_options_without_effect(context, is_list=listed)
    if listed:
        _list_suite()
        return
    require_packages("lavender report", *REPORT_PACKAGES)
    from lavender.report.page import check_columns
    from lavender.report.store import read, select_solvers
    from lavender.report.text import format_count
    from lavender.solvers import registry

    for seconds in options["time_budgets"]:
        check_float("time_budgets", seconds, above=0.0)
    if options["max_velocity_error"] is not None:
        check_float("max_velocity_error", options["max_velocity_error"], above=0.0)
    check_columns(options["columns"])
    shows_records = any(f.endswith(".jsonl") for f in files)
    # Records may contain solvers that are not installed.
    specs = [] if shows_records else [registry.get(name) for name in options["solvers"] or ()]
    has_model = any(Path(f).suffix.lower() in MODEL_SUFFIXES for f in files)
    reject_options_without_effect(
        context,
        shows_records=shows_records,
        is_campaign=not shows_records and is_campaign(context),
        sweeps=options["sweeps"],
        without_model=not has_model,
        without_random=has_model and context.params["control"] != "random",
        without_budgets=bool(specs) and not any(s.resumable and not s.exact for s in specs),
    )
    check_writable(out, folder=True)
    used_folders: set[Path] = set()
    recording = {name: options[name] for name in RECORDING_NAMES}
    files = tuple(_record_model(f, out, used_folders, recording) for f in files)
    old = None if options["compare"] is None else read(options["compare"])
    path = out / "records.jsonl"
    records_files = [f for f in files if f.endswith(".jsonl")]
    if records_files:
        if len(files) > 1:
            raise InputError(
                "a records.jsonl cannot be combined with problems or other records: give one file"
            )
        measured = Measured(read(records_files[0]), False)
        if not measured.lines["kind"].isin(["run", "skip"]).any():
            raise InputError(
                f"{records_files[0]} has no records: measure problems with `lavender report PROBLEM` first"
            )
        if options["solvers"]:
            measured = measured._replace(lines=select_solvers(measured.lines, options["solvers"]))
    with show_progress(quiet) as watch:
        if not records_files:
            measured = measure_files(context, files, path, watch)
        # These modules import pandas, which only a report needs.
        from lavender.report.findings import Report, print_report, write
        from lavender.report.page import DEFAULT_ERROR_LIMIT
        from lavender.report.tables import read_engine_answers

        engines = read_engine_answers(files, measured.lines)
        limit = options["max_velocity_error"]
        limit = DEFAULT_ERROR_LIMIT if limit is None else limit
        kinds, columns = options["figure_kinds"], options["columns"]
        shown = Report(measured.lines, old, options["time_budgets"], engines, limit, kinds, columns)
        # Write the files before printing, as a closed pipe can end the command while it prints. After Ctrl-C, the page
        # has no figures, so that the prompt is back soon.
        try:
            index = write(
                shown, out, figures=not (options["no_figures"] or measured.stopped), watch=watch
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                f"the page is not complete; {path} has all runs, and the same command shows them"
            ) from None
    if quiet:
        print_escaped(str(index))
    else:
        print_report(shown, make_console(), complete=options["tables"])
        print_escaped(f"\n{format_count(len(shown.runs), 'run')}; page: {index}")
        if measured.reuse_note:
            print_escaped(measured.reuse_note)
    if measured.stopped:
        print_escaped("Stopped; the same command continues from here.", style="yellow")
        raise click.exceptions.Exit(EXIT_INTERRUPTED)
    if not (records_files or len(shown.runs)):
        reasons = "; ".join(dict.fromkeys(shown.skips["reason"]))
        print_escaped(f"nothing was measured: {reasons}", style="yellow")
        raise click.exceptions.Exit(EXIT_UNMET)
    if (n_left_out := sum(map(len, shown.left_out.values()))) and not records_files:
        print_escaped(f"{format_count(n_left_out, 'case')} left out of all numbers", style="yellow")
        raise click.exceptions.Exit(EXIT_UNMET)


def _list_suite() -> None:
    """Print the families of the suite, with parameters, defaults and purpose, and its sets of cases."""
    from lavender import suite

    for text, summary in sorted(suite.families().items()):
        print_escaped(text, style="bold")
        print_escaped(f"    {summary}")
    print_escaped("")
    for name, names in suite.SETS.items():
        print_escaped(f"@{name}", style="bold")
        print_escaped(
            f"    {len(names)} cases: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"
        )


def _record_model(
    word: str, out: Path, used_folders: set[Path], recording: Mapping[str, Any]
) -> str:
    """Record the steps of a model *.xml or *.mjb in the report's folder `out`, and return their folder.

    Any other word is returned unchanged. The new folder is added to `used_folders`. Its name contains the folder and
    the file of the model, since many files are called scene.xml.
    """
    path = Path(word)
    if path.suffix.lower() not in MODEL_SUFFIXES:
        return word
    from lavender.io.recording import record_file
    from lavender.report.text import make_file_name

    first = out / "recorded" / make_file_name(f"{path.resolve().parent.name}-{path.stem}")
    n = 1
    folder = first
    while folder in used_folders:
        n += 1
        folder = first.with_name(f"{first.name}-{n}")
    used_folders.add(folder)
    recorded = record_file(path, folder, **recording, replace=True)
    print_escaped(str(recorded))
    if recorded.is_interrupted:
        exit_after_interrupt()
    return str(folder)
