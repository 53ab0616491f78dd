"""The same scene stepped alternately by LavenderSim, MuJoCo and PyBullet: time and errors of a step.

All engines of a scene are built from its bodies, settle separately, and are then timed in alternating batches of
steps. The time is the CPU time of the fastest batch, since noise only adds time. Remaining speed and penetration are
reported as well, and the judge's residual if the engine's problem is known: LavenderSim's, and MuJoCo's through
`lavender.io.from_mujoco`. A soft contact model penetrates by design; its depth is not an error of its solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks import stand
from benchmarks.engines import create_engine, get_missing_installation_command
from benchmarks.pairs import time_call
from benchmarks.stand import Contestant, Tower
from lavender.base.errors import UnknownName
from lavender.problem import Problem
from lavender.sim.scene import Scene

DT = 1.0 / 240.0
NAN = float("nan")
SETTLE = 480  # steps, 2 s
SETTLE_LIMIT = 20.0  # s of CPU; a slower engine is left out with a note
BATCH = 5e-3  # s of CPU of one batch, far above the clock's resolution
#: Scenes of the comparison: {name: (scene of the gallery, parameters)}.
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "box": ("stack", {"n": 1}),
    "stack6": ("stack", {}),
    "stack20": ("stack", {"n": 20}),
    "pyramid55": ("pyramid", {"base": 10}),
    "pyramid210": ("pyramid", {"base": 20}),
    "pile1000": ("pile", {"n": 1000}),
    "chain50": ("chain", {"n": 50}),
}


@dataclass(frozen=True)
class Step:
    """Result of one engine on one scene, at steady contact."""

    scene: str
    engine: str
    accurate: bool  # True: iterates to its own tolerance, False: a fixed number of sweeps
    # s, CPU time of one step in the fastest batch; nan: left out, with the reason in `note`
    time: float = NAN
    contacts: int = 0
    depth: float = NAN  # m, deepest penetration, or largest joint error of a chain; nan: not known
    speed: float = NAN  # m/s, largest speed of a body
    relative: float = (
        NAN  # relative residual of the last step; nan if the engine's problem is not known
    )
    note: str = ""


def _scene(name: str, **more: Any) -> Scene:
    if name not in SCENES:
        raise UnknownName("scene", name, SCENES)
    of, parameters = SCENES[name]
    return Scene(of, **parameters, **more)


#: Engines and modes, from those of the tower benchmark; elliptic friction cones if there is a choice.
ENGINES: dict[str, Contestant] = {
    name: stand.ENGINES[name]
    for name in ("lavender", "newton", "mujoco_pgs", "mujoco_newton", "pybullet")
}
ENGINES["mujoco_pyramidal"] = replace(
    ENGINES["mujoco_newton"], name="mujoco Newton pyramidal", options={"cone": "pyramidal"}
)


def export(scene: str, cone: str = "elliptic", settle: int = 120) -> Problem:
    """Return MuJoCo's problem of a scene after some steps; cone "elliptic" (law "cone") or "pyramidal" ("lcp").

    Raises
    ------
    UnknownName
        No such scene.
    """
    import mujoco

    made: Any = create_engine("mujoco", _scene(scene), cone=cone, dt=DT, sweeps=16)
    made.advance(settle)
    mujoco.mj_forward(made.model, made.data)
    problem: Problem = made.read_last_problem()
    return problem


def measure_scene(
    scene: str,
    sweeps: int = 16,
    *,
    engines: Sequence[str] = tuple(ENGINES),
    settle: int = SETTLE,
    rounds: int = 30,
) -> list[Step]:
    """Measure every installed engine on one scene, alternately.

    Parameters
    ----------
    scene : str
        Name in `SCENES`.
    sweeps : int
        Number of sweeps of every engine with this option, at tolerance 0.
    engines : names of `ENGINES`
    settle : int
        Steps before timing starts.
    rounds : int
        Batches of each engine, alternating between engines.

    Raises
    ------
    UnknownName
        No such scene or engine.
    """
    _scene(scene)
    for name in engines:
        if name not in ENGINES:
            raise UnknownName("engine", name, ENGINES)
    asked = Tower(0, DT, sweeps)
    known = [
        ENGINES[name]
        for name in engines
        if not get_missing_installation_command(ENGINES[name].needs)
    ]
    notes: dict[int, str] = {}
    with ExitStack() as stack:
        made = []
        for one in known:
            made.append(one.step(partial(_scene, scene), asked))
            stack.callback(made[-1].close)
        size = np.ones(len(made), int)
        for i, stepping in enumerate(made):
            spent = 0.0
            for done in range(settle):
                spent += time_call(stepping.step)
                if spent > SETTLE_LIMIT:
                    notes[i] = (
                        f"did not settle: {done + 1} of {settle} steps in {SETTLE_LIMIT:g} s of CPU"
                    )
                    break
            size[i] = max(1, min(200, int(BATCH / max(spent / max(settle, 1), 1e-6))))
        best = np.full(len(made), np.inf)
        for _ in range(rounds):
            for i, stepping in enumerate(made):
                if i not in notes:
                    taken = time_call(partial(stepping.advance, size[i]))
                    best[i] = min(best[i], taken / size[i])
        found = []
        for i, (one, stepping) in enumerate(zip(known, made, strict=True)):
            name = f"{one.name}, {sweeps} sweeps" if one.sweeps else one.name
            if i in notes:
                found.append(Step(scene, name, not one.sweeps, note=notes[i]))
                continue
            stepping.step()
            contacts, depth, relative = stepping.measure_last_step()
            speed = float(np.linalg.norm(stepping.get_state()[2][:, :3], axis=1).max(initial=0.0))
            found.append(
                Step(scene, name, not one.sweeps, float(best[i]), contacts, depth, speed, relative)
            )
        return found
