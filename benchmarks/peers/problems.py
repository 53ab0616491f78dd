"""Problems of the race: cases, files, folders, and steps of scenes exported by engines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec

from benchmarks.peers import engines
from lavender.base.errors import InputError, UnknownName
from lavender.problem import Problem
from lavender.report.cases import resolve_sources
from lavender.sim.engine import Simulation
from lavender.sim.scene import Scene

#: Cases of the suite, `mujoco:SCENE:CONE` (exported by MuJoCo), `scene:SCENE` (exported by LavenderSim).
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


def problems(
    words: Sequence[str], say: Callable[[str], None] = lambda _: None
) -> Iterator[tuple[str, Problem]]:
    """Yield (name, problem) of cases, files, folders, and of scenes exported by an engine.

    Parameters
    ----------
    words : names
        Names as in `lavender report`; `mujoco:SCENE:CONE` and `scene:SCENE` with a scene of
        `engines.SCENES`.
    say : callable
        Called with a message for each problem that is left out.

    Raises
    ------
    InputError
        A name is neither a file nor a case.
    UnknownName
        The scene or case does not exist.
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
            for item in resolve_sources([word]):
                yield item.name, item.problem
