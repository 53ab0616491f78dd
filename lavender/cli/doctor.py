"""Define `lavender doctor`: describe the installation and compare the bits of its kernels with other machines."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import click

from lavender.base.exits import EXIT_UNMET
from lavender.cli.completion import complete_case_or_file
from lavender.cli.options import ErrorReporter, escape_markup, make_console, print_escaped


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
            key: value
            for key, value in results.items()
            if key not in ("self_test", "same_bits", "memory_bytes")
        },
        "memory": f"{results['memory_bytes'] / 2**30:.1f} GiB",
        "load": "" if results["load"] is None else f"{results['load']:.1f}",
        "backends": "; ".join(f"{name}: {text}" for name, text in backends.items() if name not in missing),
        "not installed": f"{', '.join(missing)} (`lavender solvers NAME` prints the command that installs one)",
        "self-test": f"{len(self_test) - len(wrong)} of {len(self_test)} give their bits",
        **{f"  {name}": result for name, result in wrong.items()},
    }
    from rich.table import Table

    table = Table.grid(padding=(0, 2))
    for key, value in shown.items():
        text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
        if text:
            table.add_row(key, escape_markup(text))
    make_console().print(table, highlight=False)


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
