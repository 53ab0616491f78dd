"""`lavender doctor`: describe the installation and test whether its kernels give the same bits as elsewhere."""

from __future__ import annotations

import json
from dataclasses import asdict

import click

from lavender.cli.options import Reading, echo


@click.command()
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON, for a bug report.")
def doctor(files: tuple[str, ...], as_json: bool) -> None:
    """Print versions and run a self-test, or examine problems.

    Prints versions, processor, compiler and backends.

    Without arguments, print versions, processor, compiler and backends, and run a self-test. Exit code 1: the
    self-test gives other bits than on other machines.

    With problems, prints likely mistakes in their data (flipped normals, masses in place of their inverses, rows out of
    order, ...). Exit code 1: there is a diagnostic, or a file in a folder cannot be read. Exit code 2: a named file
    cannot be read.
    """
    if files:
        _diagnose_files(files, as_json)
        return
    from lavender.lab.bench.doctor import examine

    results = examine()
    if as_json:
        click.echo(json.dumps(results, indent=2, ensure_ascii=True))
    else:
        for key, value in results.items():
            if key not in ("self_test", "same_bits"):
                text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
                click.echo(f"{key:<14}{text}")
        wrong = {name: text for name, text in results["self_test"].items() if text != "same"}
        n = len(results["self_test"])
        click.echo(f"{'self-test':<14}{n - len(wrong)} of {n} parts give the same bits")
        for name, text in wrong.items():
            click.echo(f"{'':<14}{name}: {text}")
    if not results["same_bits"]:
        raise click.exceptions.Exit(1)


def _diagnose_files(files: tuple[str, ...], as_json: bool) -> None:
    """Print the diagnostics of problems."""
    from lavender.lab import bench
    from lavender.lab.diagnostics import diagnose

    results, reading = {}, Reading()
    for item in bench.resolve(files):
        with reading(item):
            results[item.name] = diagnose(item.problem)
            for diagnostic in () if as_json else results[item.name]:
                echo(f"{item.name}: {diagnostic}")
    suspect = sum(map(bool, results.values()))
    if as_json:
        click.echo(json.dumps({name: list(map(asdict, items)) for name, items in results.items()}, indent=2))
    else:
        click.echo(f"{len(results)} examined, {suspect or 'none'} suspicious")
    reading.end(suspect)
