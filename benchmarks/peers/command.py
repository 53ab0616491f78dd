"""`python -m benchmarks peers`: engines on the same scenes, solvers on the same problems, time and error.

All contestants run alternately in one call, and times are given as ratios to lavender's: on a shared machine times
alone are not meaningful. Missing packages and faster contestants are listed.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory

import click

from benchmarks.output import out_option, write_json
from benchmarks.peers import box3d as peer_box3d
from benchmarks.peers import engines as peer_engines
from benchmarks.peers import race
from benchmarks.peers.adapters import Result, contestants, ours
from benchmarks.peers.engines import Step
from benchmarks.peers.problems import PROBLEMS, problems
from benchmarks.peers.tables import engines_table, solvers_tables
from lavender.report import machine

PACKAGES = (
    "mujoco",
    "pybullet",
    "pin",
    "clarabel",
    "daqp",
    "highspy",
    "piqp",
    "proxsuite",
    "qoco",
    "qpalm",
    "quadprog",
    "scs",
)


@click.command("peers")
@click.argument("files", nargs=-1, metavar="[FILES | FOLDERS | NAMES]...")
@click.option("--engines/--no-engines", default=True, help="Step the scenes in every engine.")
@click.option("--solvers/--no-solvers", default=True, help="Solve the problems with every solver.")
@click.option(
    "--scenes",
    default=",".join(peer_engines.SCENES),
    show_default=True,
    help="Scenes, commas between them.",
)
@click.option(
    "--sweeps", default=16, show_default=True, help="Of every engine that takes a number of them."
)
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
@click.option(
    "--box3d",
    type=click.Path(path_type=Path),
    metavar="CHECKOUT",
    help="Checkout of github.com/erincatto/box3d, built by CMake: compare its steps only.",
)
@out_option("Write every run here too, JSON.")
def command(
    files: tuple[str, ...],
    engines: bool,
    solvers: bool,
    scenes: str,
    sweeps: int,
    limit: float,
    rounds: int,
    siconos: str,
    box3d: Path | None,
    out: Path | None,
) -> None:
    """Compare engines on the same scenes and solvers on the same problems: ratios of times, and errors.

    FILES are problems for the solvers; default: a fixed list of small and large problems.
    """

    def note(text: str) -> None:
        click.echo(text, err=True)

    if box3d is not None:
        with TemporaryDirectory() as folder:
            program = peer_box3d.build(box3d, Path(folder))
            beside = []
            for scene in peer_box3d.SCENES:
                note(scene)
                beside.append(peer_box3d.measure(program, scene))
        click.echo(peer_box3d.format_table(beside))
        if out is not None:
            write_json(out, beside)
        return
    steps: list[Step] = []
    found: list[Result] = []
    versions = machine.get_versions(PACKAGES)

    def keep() -> None:
        if out is not None:
            write_json(out, found, versions=versions, steps=[asdict(s) for s in steps])

    click.echo(f"{machine.get_cpu_name()}; " + ", ".join(f"{k} {v}" for k, v in versions.items()))
    absent = [name for name in PACKAGES if name not in versions] + (
        [] if siconos else ["siconos (--siconos)"]
    )
    click.echo("not here: " + (", ".join(absent) or "nothing") + "\n")
    if engines:
        for scene in filter(None, scenes.split(",")):
            note(scene)
            steps += peer_engines.measure_scene(scene, sweeps)
        click.echo(engines_table(steps) + "\n")
    if solvers:
        rounds_of_all = race.race(
            problems(files or PROBLEMS, note),
            [*ours(), *contestants(siconos)],
            limit=limit,
            rounds=rounds,
            watch=note,
        )
        try:
            for results in rounds_of_all:
                found += results
                keep()  # an interruption loses the results of one problem only
        except KeyboardInterrupt:
            note("stopped")
        click.echo(solvers_tables(found))
    keep()
