"""The command `python -m benchmarks peers`."""

from __future__ import annotations

from pathlib import Path

import click

from benchmarks.output import folder_of
from benchmarks.peers.compared import engines_table, solvers_tables
from lavender.bench.peers import PROBLEMS, Peers, adapters, problems, race
from lavender.bench.peers import engines as peer_engines

__all__ = ["command"]


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
def command(
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
    folder_of(out)

    def note(text: str) -> None:
        click.echo(text, err=True)

    def keep() -> None:
        if out is not None:
            found.write(out)

    found = Peers()
    click.echo(f"{found.cpu}; " + ", ".join(f"{k} {v}" for k, v in found.versions.items()))
    absent = found.absent + ([] if siconos else ["siconos (--siconos)"])
    click.echo("not here: " + (", ".join(absent) or "nothing") + "\n")
    if engines:
        for scene in filter(None, scenes.split(",")):
            note(scene)
            found.steps += peer_engines.measure_scene(scene, sweeps)
        click.echo("\n".join(engines_table(found.steps)) + "\n")
    if solvers:
        rounds_of_all = race.race(
            problems(files or PROBLEMS, note),
            adapters.contestants(siconos),
            limit=limit,
            rounds=rounds,
            watch=note,
        )
        try:
            for results in rounds_of_all:
                found.results += results
                keep()  # an interruption costs one problem
        except KeyboardInterrupt:
            note("stopped")
        click.echo("\n".join(solvers_tables(found.results)))
    keep()
