"""Engines of others on the same scenes, solvers of others on the same problems: error beside time.

`engines.measure_scene` steps a scene in each engine that is installed, `race.race` gives problems to the
contestants of `adapters`, both in turns. Times of a machine that others use say nothing by themselves: ratios to
ours do. A run that was written is read again here, for `lavender report --peers`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path

from lavender.bench import machine
from lavender.bench.cases import resolve
from lavender.bench.peers import engines
from lavender.bench.peers.contest import Result
from lavender.engine import Simulation
from lavender.errors import InputError, UnknownName
from lavender.io.stored import whole_file, write_text
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


@dataclass
class Peers:
    """What a run measured: steps of engines, results of solvers, where and with which versions."""

    cpu: str = field(default_factory=machine.cpu_name)
    versions: dict[str, str] = field(default_factory=lambda: machine.versions(PACKAGES))
    steps: list[engines.Step] = field(default_factory=list)
    results: list[Result] = field(default_factory=list)

    @property
    def absent(self) -> list[str]:
        """Packages that were not there to be measured."""
        return [name for name in PACKAGES if name not in self.versions]

    def write(self, path: str | Path) -> None:
        """As JSON, which `read` takes; the file is whole or absent."""
        record = asdict(self)
        write_text(Path(path), json.dumps(record | {"solvers": record.pop("results")}, indent=1))


def read(path: str | Path) -> Peers:
    """The file of `Peers.write`.

    Raises
    ------
    InputError
        No such file, or another one.
    """
    needed = "a file of `python -m benchmarks peers --out FILE` is needed"
    try:
        found = json.loads(whole_file(Path(path), "the measurements").decode())
        return Peers(
            str(found["cpu"]),
            dict(found["versions"]),
            [engines.Step(**s) for s in found["steps"]],
            [Result(**{**r, "runs": [(float(t), float(x)) for t, x in r["runs"]]}) for r in found["solvers"]],
        )
    except InputError as error:
        raise InputError(f"{error}; {needed}") from None
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path} holds something else ({type(error).__name__}: {error}); {needed}") from None


def problems(
    words: Sequence[str], say: Callable[[str], None] = lambda _: None
) -> Iterator[tuple[str, Problem]]:
    """(name, problem) of cases, files, folders, and of scenes exported by an engine.

    Parameters
    ----------
    words : names
        As `lavender report` takes them; `mujoco:SCENE:CONE` and `scene:SCENE` with a scene of
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
