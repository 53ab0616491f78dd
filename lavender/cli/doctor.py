"""`lavender doctor`: what this installation is, and whether its kernels give the bits that they give elsewhere."""

from __future__ import annotations

import json
from dataclasses import asdict

import click

from lavender.cli.options import Reading, say


@click.command()
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON, for a bug report.")
def doctor(files: tuple[str, ...], as_json: bool) -> None:
    """Print versions, processor, compiler and backends, and run a self-test; or look for mistakes in problems.

    Without arguments, exit code 1: the self-test gives other bits than on other machines.

    With problems, print what looks like a mistake in their data (flipped normals, masses in place of their
    inverses, rows out of order, ...). Exit code 1: there is a diagnostic, or a file in a folder cannot be read.
    Exit code 2: a named file cannot be read.
    """
    if files:
        _suspect(files, as_json)
        return
    from lavender.lab.bench.doctor import examine

    found = examine()
    if as_json:
        click.echo(json.dumps(found, indent=2, ensure_ascii=True))
    else:
        for key, value in found.items():
            if key not in ("self_test", "same_bits"):
                text = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else value
                click.echo(f"{key:<14}{text}")
        wrong = {name: said for name, said in found["self_test"].items() if said != "same"}
        click.echo(
            f"{'self-test':<14}{len(found['self_test']) - len(wrong)} of {len(found['self_test'])} give their bits"
        )
        for name, said in wrong.items():
            click.echo(f"{'':<14}{name}: {said}")
    if not found["same_bits"]:
        raise click.exceptions.Exit(1)


def _suspect(files: tuple[str, ...], as_json: bool) -> None:
    from lavender.lab import bench
    from lavender.lab.diagnostics import diagnose

    found, reading = {}, Reading()
    for item in bench.resolve(files):
        with reading(item):
            found[item.name] = diagnose(item.problem)
            for diagnostic in () if as_json else found[item.name]:
                say(f"{item.name}: {diagnostic}")
    suspect = sum(map(bool, found.values()))
    if as_json:
        click.echo(json.dumps({name: list(map(asdict, told)) for name, told in found.items()}, indent=2))
    else:
        click.echo(f"{len(found)} looked at, {suspect or 'none'} suspicious")
    reading.end(suspect)
