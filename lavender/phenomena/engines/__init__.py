"""One file for each engine: `Engine(scene, **options)` steps a scene; a way is an engine with its setting."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import process_time
from typing import Any

import numpy as np

from lavender._arrays import FloatArray
from lavender.phenomena.parts import Track
from lavender.scene import Scene
from lavender.scene.steppers import STEPPERS

__all__ = ["WAYS", "Stepping", "Way", "follow", "make"]

NO_SPIN = "its friction against spinning has no radius that could be given"
NO_ROLLING = "it has no friction against rolling"


class Stepping:
    """One engine with one scene."""

    dt = 0.0  # s, of one `step`
    setting = ""  # step, substeps and sweeps, as run

    def step(self) -> Any:
        """One step of dt."""
        raise NotImplementedError

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions (n, 3) [m], quaternions (n, 4) w x y z, velocities (n, 6) [m/s, rad/s] in the world."""
        raise NotImplementedError

    def force(self) -> float:
        """Force of the first joint [N]; nan where the engine does not tell it."""
        return float("nan")

    def close(self) -> None:
        """Let go of what the engine holds."""


@dataclass(frozen=True)
class Way:
    """An engine with a setting: its own defaults, or one that is recommended."""

    name: str
    module: str  # of this folder
    package: str  # module that it needs; empty: none
    options: Mapping[str, Any]
    text: str  # the setting, in words
    scene: Mapping[str, Any] = field(default_factory=dict)  # asked of the scene, of our own steppers
    cannot: Mapping[str, str] = field(default_factory=dict)  # feature of a scene -> why not

    def missing(self) -> str:
        """What it lacks here; empty where it can run."""
        if not self.package or importlib.util.find_spec(self.package):
            return ""
        return f"not installed: pip install {self.package.replace('pydrake', 'drake')}"


FINE = {"substeps": 16, "solver_iterations": 4}


def _own() -> list[Way]:
    found = []
    for name, spec in STEPPERS.items():
        cannot = {} if spec.spin else {"spin": "the stepper has no spin friction"}
        cannot |= {} if spec.rolling else {"rolling": "the stepper has no rolling friction"}
        for more, words in (({}, "4 substeps of 16 sweeps"), (FINE, "16 substeps of 4 sweeps")):
            full = f"{name} 16x4" if more else name
            asked = {"stepper": name, "dt": 1 / 60, **more}
            found.append(Way(full, "own", "", {}, f"1/60 s, {words}", scene=asked, cannot=cannot))
        if spec.solvers:
            asked = {"stepper": name, "dt": 1 / 60, "solver": "newton", "substeps": 4}
            found.append(
                Way(
                    f"{name} newton",
                    "own",
                    "",
                    {},
                    "1/60 s, 4 substeps, Newton to 1e-6",
                    scene=asked,
                    cannot=cannot,
                )
            )
    return found


def _others() -> list[Way]:
    found = []
    for cone in ("pyramidal", "elliptic"):
        for noslip in (0, 10):
            more = f", {noslip} iterations of noslip" if noslip else ""
            found.append(
                Way(
                    f"mujoco {cone}{' noslip' if noslip else ''}", "mujoco", "mujoco",
                    {"cone": cone, "noslip": noslip}, f"2 ms, Newton to 1e-8{more}",
                )
            )  # fmt: skip
    found += [
        Way("pybullet", "bullet", "pybullet", {"sweeps": 50, "substeps": 1}, "1/240 s, 50 sweeps"),
        Way(
            "pybullet 4x100",
            "bullet",
            "pybullet",
            {"sweeps": 100, "substeps": 4},
            "1/240 s in 4 of 100 sweeps",
        ),
    ]
    for name, options, text in (
        ("drake", {"approximation": "lagged", "hydroelastic": False}, "1 ms, point contacts: its defaults"),
        (
            "drake lagged",
            {"approximation": "lagged", "hydroelastic": True},
            "1 ms, hydroelastic bodies of 1e8 Pa",
        ),
        (
            "drake sap",
            {"approximation": "sap", "hydroelastic": True},
            "1 ms, SAP, hydroelastic bodies of 1e8 Pa",
        ),
    ):
        found.append(
            Way(name, "drake", "pydrake", options, text, cannot={"spin": NO_SPIN, "rolling": NO_ROLLING})
        )
    for sweeps in (22, 64):
        more = f" {sweeps}" if sweeps != 22 else ""
        text = f"1/60 s in 4 of {sweeps} sweeps"
        found.append(Way(f"lavendersim{more}", "lavender_sim", "lavendersim", {"sweeps": sweeps}, text))
    return found


#: Name -> way; ours first.
WAYS: dict[str, Way] = {way.name: way for way in (*_own(), *_others())}


def make(way: Way, scene: Scene) -> Stepping:
    """The engine of a way with a scene."""
    module = importlib.import_module(f"lavender.phenomena.engines.{way.module}")
    made: Stepping = module.Engine(scene, **way.options)
    return made


def follow(engine: Stepping, seconds: float, look: float) -> Track:
    """Step for so long, and look every `look` seconds, in whole steps; a state that is not finite is the last."""
    every = max(1, round(look / engine.dt))
    looks = max(2, int(np.ceil(seconds / (every * engine.dt) - 1e-9)))
    states, spent, done = [engine.state()], 0.0, 0
    step = engine.step
    for _ in range(looks):
        begin = process_time()
        for _ in range(every):
            step()
        spent += process_time() - begin
        done += every
        states.append(engine.state())
        if not all(np.isfinite(x).all() for x in states[-1]):
            break
    x, q, v = (np.array(part, float) for part in zip(*states, strict=True))
    return Track(
        time=np.arange(len(states), dtype=float) * (every * engine.dt),
        positions=x,
        quaternions=q,
        velocities=v,
        force=engine.force(),
        cpu=spent / (done * engine.dt),
        setting=engine.setting,
    )
