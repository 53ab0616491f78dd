"""Define the small commands: `lavender explain`, `record`, `contract`, `doctor` and `export`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_case_or_file, complete_solver
from lavender.cli.options import (
    FILE,
    FOLDER,
    ErrorReporter,
    escape_markup,
    exit_after_interrupt,
    limit_to_one_thread,
    make_console,
    precision_option,
    print_escaped,
    recording_options,
    reject_options_without_effect,
)
from lavender.io.stored import check_writable


@click.command()
@click.argument(
    "files", nargs=-1, required=True, metavar="FILES...", shell_complete=complete_case_or_file
)
@click.option(
    "--tol", type=float, default=1e-6, show_default=True, help="Relative residual to reach."
)
@click.option("--json", "as_data", is_flag=True, help="Print one decision trace per line as JSON.")
def explain(files: tuple[str, ...], tol: float, as_data: bool) -> None:
    """Print the decision trace of `auto` on problems.

    FILES are files, folders or cases of the suite. Nothing is solved. Costs are counted from the structure of a
    problem, with the same rates on every machine.

    Exit code 1: a file in a folder cannot be read; the others are explained. Exit code 2: a named file cannot be read.
    """
    from lavender.base.arrays import check_float
    from lavender.report.cases import resolve_sources
    from lavender.solving.plan import explain as explain_problem

    check_float("tol", tol, above=0.0)
    errors = ErrorReporter()
    for item in resolve_sources(list(files)):
        with errors(item):
            plan = explain_problem(item.problem, tol)
            if as_data:
                click.echo(json.dumps(plan.data()))
            else:
                print_escaped(f"{item.name}: {plan}\n")
    errors.exit()


@click.command()
@click.argument("model", metavar="MODEL.xml", type=FILE)
@recording_options
@click.option("--out", required=True, type=FOLDER, help="Folder for the problems.")
@click.option(
    "--replace",
    is_flag=True,
    help="First delete the problems of an earlier recording in the folder.",
)
@precision_option
@click.pass_context
def record(
    context: click.Context,
    /,
    model: Path,
    out: Path,
    steps: int,
    precision: str | None,
    **options: Any,
) -> None:
    """Simulate a MuJoCo model and write its constraint problems.

    MODEL.xml is an MJCF file. `lavender report OUT` measures solvers on the problems. Steps from different --states are
    independent problems. After Ctrl-C, the folder has the steps until then.

    Exit code 1: a step could not be recorded.
    """
    from lavender.io.recording import record_file

    reject_options_without_effect(context, without_random=context.params["control"] != "random")
    recorded = record_file(model, out, steps, precision=precision or "float64", **options)
    print_escaped(str(recorded))
    if recorded.is_interrupted:
        exit_after_interrupt()
    if recorded.left_out:
        raise click.exceptions.Exit(EXIT_UNMET)


@click.command()
@click.argument("name", shell_complete=complete_solver)
@click.option(
    "--list",
    "list_only",
    is_flag=True,
    help="List the requirements that apply to the solver; run nothing.",
)
@click.option(
    "--out",
    type=FOLDER,
    default=Path("lavender-contract"),
    show_default=True,
    help="Folder for the problems on which requirements are not met; created for the first one.",
)
@click.pass_context
def contract(context: click.Context, name: str, list_only: bool, out: Path) -> None:
    """Check that a solver meets the requirements on every solver.

    NAME is a built-in solver or an installed plug-in. Each capability that the spec of the solver lists is exercised on
    small problems of every law, form and kind of block; each requirement that is not met is explained in a sentence,
    and its problem is written to the folder --out.

    Exit code 1: a requirement is not met.
    """
    from lavender.contract import CHECKS, check_solver, list_checks, make_problems
    from lavender.io.stored import check_writable, make_folder
    from lavender.solvers import registry

    limit_to_one_thread()
    spec = registry.get(name)
    if list_only:
        for check in list_checks(spec):
            print_escaped(f"{check.requirement}\n    {check.name}, {check.applies_to}")
        return
    unmet = total = 0
    for check, failure in check_solver(name):
        total += 1
        style = "bold red" if failure.text else ""
        print_escaped(
            f"{'NOT MET' if failure.text else 'met    '}  {check.requirement}", style=style
        )
        if failure.text:
            unmet += 1
            print_escaped(f"         {failure.text}")
        if failure.problem:
            make_folder(check_writable(out, folder=True))
            path = out / f"{check.name}.npz"
            make_problems()[failure.problem].save(path)
            print_escaped(f"         problem: {path}")
    skipped = [
        f"{check.name} ({check.applies_to})" for check in CHECKS.values() if not check.applies(spec)
    ]
    print_escaped(f"{name} meets {total - unmet} of {total} requirements")
    if skipped:
        print_escaped("\n    ".join(["not required of this solver, and not tested:", *skipped]))
    if unmet:
        context.exit(EXIT_UNMET)


@click.command()
@click.argument(
    "files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...", shell_complete=complete_case_or_file
)
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON, for a bug report.")
def doctor(files: tuple[str, ...], as_json: bool) -> None:
    """Check the installation, or the data of problems.

    Without arguments, print versions, processor, compiler and backends, and run a self-test. Exit code 1: the
    self-test gives other bits than on other machines.

    With problems, print probable mistakes in their data (flipped normals, masses in place of their inverses, rows out
    of order, ...). Exit code 1: there is a diagnostic, or a file in a folder cannot be read. Exit code 2: a named file
    cannot be read.
    """
    if files:
        _diagnose_problems(files, as_json)
        return
    from lavender.report.doctor import collect_installation_facts

    results = collect_installation_facts()
    if as_json:
        click.echo(json.dumps(results, indent=2, ensure_ascii=True))
    else:
        _print_facts(results)
    if not results["same_bits"]:
        raise click.exceptions.Exit(EXIT_UNMET)


def _print_facts(results: dict[str, Any]) -> None:
    """Print the facts about an installation in two columns, which fit into the terminal."""
    backends, self_test = results["backends"], results["self_test"]
    missing = [name for name, text in backends.items() if text.startswith("needs ")]
    wrong = {name: result for name, result in self_test.items() if result != "same"}
    shown = {
        **{
            key: x
            for key, x in results.items()
            if key not in ("self_test", "same_bits", "memory_bytes")
        },
        "memory": f"{results['memory_bytes'] / 2**30:.1f} GiB",
        "load": "" if results["load"] is None else f"{results['load']:.1f}",
        "backends": "; ".join(
            f"{name}: {text}" for name, text in backends.items() if name not in missing
        ),
        "not installed": f"{', '.join(missing)} (`lavender solvers NAME` prints the command that installs one)",
        "self-test": f"{len(self_test) - len(wrong)} of {len(self_test)} give their bits",
        **{f"  {name}": result for name, result in wrong.items()},
    }
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for key, value in shown.items():
        text = (
            ", ".join(f"{k} {v}" for k, v in value.items())
            if isinstance(value, dict)
            else str(value)
        )
        if text:
            table.add_row(key, escape_markup(text))
    make_console().print(table, highlight=False)


def _diagnose_problems(files: tuple[str, ...], as_json: bool) -> None:
    """Print probable mistakes in the data of problems, and exit with 1 if there is one."""
    from lavender import report
    from lavender.diagnostics import diagnose

    diagnostics = {}
    errors = ErrorReporter()
    for item in report.resolve_sources(files):
        with errors(item):
            diagnostics[item.name] = diagnose(item.problem)
            for diagnostic in () if as_json else diagnostics[item.name]:
                print_escaped(f"{item.name}: {diagnostic}")
    suspect = sum(map(bool, diagnostics.values()))
    if as_json:
        entries = {name: list(map(asdict, some)) for name, some in diagnostics.items()}
        click.echo(json.dumps(entries, indent=2))
    else:
        click.echo(f"{len(diagnostics)} problems checked, {suspect or 'none'} with diagnostics")
    errors.exit(suspect)


@click.command()
@click.argument("kind", type=click.Choice(["c"]))
@click.argument("folder", type=FOLDER)
@click.option("--replace", is_flag=True, help="Overwrite files of an earlier export that differ.")
@click.pass_context
def export(context: click.Context, kind: str, folder: Path, replace: bool) -> None:
    """Write the kernels as a C library with one header.

    The library does not need Python.
    """
    from lavender.export import library

    check_writable(folder, folder=True)
    written = library.write(folder, replace=replace)
    print_escaped(f"{len(written)} files in {folder}: {', '.join(p.name for p in written)}")
