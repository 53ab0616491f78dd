"""`lavender bench peers`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from lavender.bench import machine
from lavender.bench import peers as bench_peers
from lavender.bench.peers import adapters, race
from lavender.bench.peers import engines as peer_engines
from lavender.bench.peers.contest import Result
from lavender.io.stored import write_text
from lavender.report.compared import engines_table, solvers_tables

__all__ = ["peers"]


@click.command("peers")
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--engines/--no-engines", default=True, help="Step the scenes in every engine.")
@click.option("--solvers/--no-solvers", default=True, help="Solve the problems with every solver.")
@click.option(
    "--scenes", default=",".join(peer_engines.SCENES), show_default=True, help="Scenes, commas between them."
)
@click.option("--sweeps", default=16, show_default=True, help="Of every engine that takes a number of them.")
@click.option(
    "--limit", default=2.0, show_default=True, metavar="S", help="CPU time of one call of a solver."
)
@click.option(
    "--rounds",
    type=click.IntRange(2),
    default=2,
    show_default=True,
    help="Turns of the solvers near the fastest.",
)
@click.option(
    "--siconos",
    default="",
    envvar="LAVENDER_SICONOS",
    show_envvar=True,
    metavar="PYTHON",
    help="Interpreter that has Siconos (Debian: python3-siconos).",
)
@click.option("--out", type=click.Path(path_type=Path), default=None, help="Write every run here too, JSON.")
def peers(
    files: tuple[str, ...],
    engines: bool,
    solvers: bool,
    scenes: str,
    sweeps: int,
    limit: float,
    rounds: int,
    siconos: str,
    out: Path | None,
) -> None:
    """Engines on the same scenes and solvers on the same problems: time as a ratio to ours, error beside it.

    FILES are problems for the solvers; without them a fixed list of small and large ones.
    """

    def note(text: str) -> None:
        click.echo(text, err=True)

    versions = machine.versions(bench_peers.PACKAGES)
    click.echo(f"{machine.cpu_name()}; " + ", ".join(f"{k} {v}" for k, v in versions.items()))
    absent = [name for name in bench_peers.PACKAGES if name not in versions] + (
        [] if siconos else ["siconos (--siconos)"]
    )
    click.echo("not here: " + (", ".join(absent) or "nothing") + "\n")
    record: dict[str, Any] = {"versions": versions, "cpu": machine.cpu_name(), "steps": [], "solvers": []}
    if engines:
        steps: list[peer_engines.Step] = []
        for scene in filter(None, scenes.split(",")):
            note(scene)
            steps += peer_engines.measure_scene(scene, sweeps)
        click.echo("\n".join(engines_table(steps)) + "\n")
        record["steps"] = peer_engines.as_records(steps)
    if solvers:
        results: list[Result] = []
        rounds_of_all = race.race(
            bench_peers.problems(files or bench_peers.PROBLEMS, note),
            adapters.contestants(siconos),
            limit=limit,
            rounds=rounds,
            watch=note,
        )
        try:
            for found in rounds_of_all:
                results += found
                record["solvers"] = race.as_records(results)
                _write(out, record)  # an interruption costs one problem
        except KeyboardInterrupt:
            note("stopped")
        click.echo("\n".join(solvers_tables(results)))
    _write(out, record)


def _write(out: Path | None, record: dict[str, Any]) -> None:
    if out is not None:
        write_text(out, json.dumps(record, indent=1))
