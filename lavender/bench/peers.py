"""`lavender bench peers`: engines on the same scenes, solvers on the same problems, error beside time.

Everything runs in one go and in turns, and is given as a ratio to ours: times of a machine that others use say
nothing by themselves. What is not installed is named; where another is faster, it is said.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from lavender.bench import machine, peer_engines, peer_solvers
from lavender.bench.cases import resolve
from lavender.engine import Simulation
from lavender.errors import InputError, UnknownName
from lavender.problem import Problem
from lavender.scene import Scene

__all__ = ["PROBLEMS", "Peers", "command", "problems", "read"]

#: Cases of the suite, `mujoco:SCENE:CONE` (what MuJoCo exports), `scene:SCENE` (what LavenderSim exports).
PROBLEMS = (
    "stack(n=8)",
    "stack(n=64)",
    "box_stack(n=10)",
    "box_stack(n=10, mass_ratio=1e6)",
    "pyramid(k=10)",
    "pyramid(k=10, mass_ratio=1e6)",
    "granular(n=4)",
    "chain(n=33)",
    "hang(n=33, tip_mass=1e4)",
    "box_stackF(n=10)",
    "pyramidF(k=6, sliding=0.5)",
    "granularF(n=3, sliding=0.5)",
    "granular(n=3, friction=cone)",
    "mujoco:stack6:elliptic",
    "scene:stack6",
    "stack(n=4096)",
    "pyramid(k=20)",
    "pyramid(k=20, mass_ratio=1e3)",
    "pyramid(k=20, mass_ratio=1e6)",
    "granular(n=9)",
    "granular(n=18)",
    "chain(n=3333)",
    "hang(n=3333)",
    "pyramidF(k=10, sliding=0.5)",
    "granularF(n=9)",
    "granularF(n=6, sliding=0.5)",
    "pyramid(k=10, friction=cone)",
    "pyramid(k=10, friction=cone, mass_ratio=1e6)",
    "granular(n=6, friction=cone)",
    "mujoco:pyramid55:elliptic",
    "mujoco:pyramid55:pyramidal",
    "scene:pyramid55",
)
PACKAGES = ("mujoco", "pybullet", "pin", "clarabel", "daqp", "highspy", "piqp", "proxsuite", "qoco", "qpalm",
            "quadprog", "scs")  # fmt: skip


@dataclass(frozen=True)
class Peers:
    """What a run of `lavender bench peers --out` measured."""

    cpu: str
    versions: dict[str, str]
    steps: list[peer_engines.Step]
    results: list[peer_solvers.Result]


def read(path: str | Path) -> Peers:
    """The file of `lavender bench peers --out`.

    Raises
    ------
    InputError
        No such file, or another one.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"cannot read {path} ({error}); a file of `lavender bench peers --out` is needed"
        ) from None
    try:
        found = json.loads(text)
        return Peers(
            str(found["cpu"]),
            dict(found["versions"]),
            peer_engines.from_records(found["steps"]),
            peer_solvers.from_records(found["solvers"]),
        )
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        kind = type(error).__name__
        raise InputError(
            f"{path} is no file of `lavender bench peers --out` ({kind}: {error}); give the one it wrote"
        ) from None


def problems(
    words: Sequence[str], say: Callable[[str], None] = lambda _: None
) -> Iterator[tuple[str, Problem]]:
    """(name, problem) of cases, files, folders, and of scenes exported by an engine.

    Parameters
    ----------
    words : names
        As `lavender bench` takes them; `mujoco:SCENE:CONE` and `scene:SCENE` with a scene of
        `peer_engines.SCENES`.
    say : callable
        Told what is left out.

    Raises
    ------
    InputError
        Neither a file nor a case.
    UnknownName
        No such scene or case.
    """
    for word in words:
        engine, _, rest = word.partition(":")
        if engine == "mujoco" and rest:
            scene, _, cone = rest.partition(":")
            if cone not in ("elliptic", "pyramidal"):
                raise InputError(
                    f"{word!r} names no friction cone; mujoco:SCENE:elliptic or mujoco:SCENE:pyramidal"
                )
            if find_spec("mujoco") is None:
                say(f"left out: {word} (pip install mujoco)")
                continue
            yield word, peer_engines.export(scene, cone)
        elif engine == "scene" and rest:
            if rest not in peer_engines.SCENES:
                raise UnknownName("scene", rest, peer_engines.SCENES)
            name, parameters = peer_engines.SCENES[rest]
            simulation = Simulation(Scene(name, dt=peer_engines.DT, **parameters))
            simulation.step()
            yield word, simulation.constraint_problem()
        else:
            for item in resolve([word]):
                yield item.name, item.problem


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

    def note(text: str) -> None:
        click.echo(text, err=True)

    versions = machine.versions(PACKAGES)
    click.echo(f"{machine.cpu_name()}; " + ", ".join(f"{k} {v}" for k, v in versions.items()))
    absent = [name for name in PACKAGES if name not in versions] + (
        [] if siconos else ["siconos (--siconos)"]
    )
    click.echo("not here: " + (", ".join(absent) or "nothing") + "\n")
    record: dict[str, Any] = {"versions": versions, "cpu": machine.cpu_name(), "steps": [], "solvers": []}
    if engines:
        steps: list[peer_engines.Step] = []
        for scene in filter(None, scenes.split(",")):
            note(scene)
            steps += peer_engines.run(scene, sweeps)
        click.echo("\n".join(peer_engines.table(steps)) + "\n")
        record["steps"] = peer_engines.as_records(steps)
    if solvers:
        results: list[peer_solvers.Result] = []
        race = peer_solvers.race(
            problems(files or PROBLEMS, note),
            peer_solvers.contestants(siconos),
            limit=limit,
            rounds=rounds,
            watch=note,
        )
        try:
            for found in race:
                results += found
                record["solvers"] = peer_solvers.as_records(results)
                _write(out, record)  # an interruption costs one problem
        except KeyboardInterrupt:
            note("stopped")
        click.echo("\n".join(peer_solvers.tables(results)))
    _write(out, record)


def _write(out: Path | None, record: dict[str, Any]) -> None:
    if out is not None:
        out.write_text(json.dumps(record, indent=1))
