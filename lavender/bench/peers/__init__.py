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

from lavender.bench.cases import resolve
from lavender.bench.peers import engines, race
from lavender.bench.peers.contest import Result
from lavender.engine import Simulation
from lavender.errors import InputError, UnknownName
from lavender.io.stored import whole_file
from lavender.problem import Problem
from lavender.scene import Scene

__all__ = ["PACKAGES", "PROBLEMS", "Peers", "problems", "read"]

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
    steps: list[engines.Step]
    results: list[Result]


def read(path: str | Path) -> Peers:
    """The file of `lavender bench peers --out`.

    Raises
    ------
    InputError
        No such file, or another one.
    """
    path = Path(path)
    try:
        text = whole_file(path, "the measurements").decode()
    except (InputError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {error}; a file of `lavender bench peers --out` is needed") from None
    try:
        found = json.loads(text)
        return Peers(
            str(found["cpu"]),
            dict(found["versions"]),
            engines.from_records(found["steps"]),
            race.from_records(found["solvers"]),
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
        `engines.SCENES`.
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
            yield word, engines.export(scene, cone)
        elif engine == "scene" and rest:
            if rest not in engines.SCENES:
                raise UnknownName("scene", rest, engines.SCENES)
            name, parameters = engines.SCENES[rest]
            simulation = Simulation(Scene(name, dt=engines.DT, **parameters))
            simulation.step()
            yield word, simulation.constraint_problem()
        else:
            for item in resolve([word]):
                yield item.name, item.problem
