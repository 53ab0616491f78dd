"""Define `lavender doctor`: describe the installation and compare the bits of its kernels with other machines."""

from __future__ import annotations

import json
from dataclasses import asdict

import click

from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_case_or_file
from lavender.cli.options import ErrorReporter, print_escaped


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
        for key, value in results.items():
            if key not in ("self_test", "same_bits"):
                text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
                click.echo(f"{key:<14}{text}")
        wrong = {name: result for name, result in results["self_test"].items() if result != "same"}
        click.echo(
            f"{'self-test':<14}{len(results['self_test']) - len(wrong)} of {len(results['self_test'])} give their bits"
        )
        for name, result in wrong.items():
            click.echo(f"{'':<14}{name}: {result}")
    if not results["same_bits"]:
        raise click.exceptions.Exit(EXIT_UNMET)


def _diagnose_problems(files: tuple[str, ...], as_json: bool) -> None:
    """Print probable mistakes in the data of problems, and exit with 1 if there is one."""
    from lavender import report
    from lavender.diagnostics import diagnose

    diagnostics, errors = {}, ErrorReporter()
    for item in report.resolve_sources(files):
        with errors(item):
            diagnostics[item.name] = diagnose(item.problem)
            for diagnostic in () if as_json else diagnostics[item.name]:
                print_escaped(f"{item.name}: {diagnostic}")
    suspect = sum(map(bool, diagnostics.values()))
    if as_json:
        click.echo(
            json.dumps({name: list(map(asdict, entries)) for name, entries in diagnostics.items()}, indent=2)
        )
    else:
        click.echo(f"{len(diagnostics)} problems checked, {suspect or 'none'} with diagnostics")
    errors.exit(suspect)
