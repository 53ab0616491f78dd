"""One file for each engine: `Engine(scene, **options)` steps a scene; a variant is an engine with a setting."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.lab.phenomena.parts import Track
from lavender.sim.scene import Scene
from lavender.sim.scene.steppers import STEPPERS

PACKAGES_OF_NODE = {"rapier": "@dimforge/rapier3d-compat", "jolt": "jolt-physics"}  # engine -> package of npm
NO_TORSION = {"spin": "it has no friction against spinning"}
NO_SPIN = "its friction against spinning has no radius that could be given"
NO_ROLLING = "it has no friction against rolling"


class Stepping:
    """One engine with one scene."""

    scene: Scene
    dt = 0.0  # s, of one `step`
    setting = ""  # step, substeps and sweeps, as run

    def step(self) -> Any:
        """One step of dt."""
        raise NotImplementedError

    def advance(self, steps: int) -> None:
        """So many steps."""
        for _ in range(steps):
            self.step()

    def clock(self) -> float:
        """CPU time that the steps took, from any moment on [s]."""
        return process_time()

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Positions (n, 3) [m], quaternions (n, 4) w x y z, velocities (n, 6) [m/s, rad/s] in the world."""
        raise NotImplementedError

    def placed(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A state with every body at rest where the scene has it."""
        x, q = (
            np.array([getattr(b, name) for b in self.scene.bodies]) for name in ("position", "quaternion")
        )
        return x, q, np.zeros((len(x), 6))

    def force(self) -> float:
        """Force of the first joint [N]; nan where the engine does not tell it."""
        return float("nan")

    def left(self) -> tuple[int, float, float]:
        """What the last step left: contacts, deepest penetration or gap of a joint [m], the judge's relative residual.

        The latter is nan where the engine's problem is not known.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Let go of what the engine holds."""


@dataclass(frozen=True)
class EngineVariant:
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
        lack = lacks(self.package)
        return f"not installed: {lack}" if lack else ""


def lacks(package: str) -> str:
    """How a package of Python or of npm would be installed; empty where it is here, or none is asked for."""
    if package in PACKAGES_OF_NODE.values():
        return missing_in_node(package)
    if not package or importlib.util.find_spec(package):
        return ""
    return f"pip install {package.replace('pydrake', 'drake')}"


def node_folder(package: str) -> Path | None:
    """Where npm has put a package: in node_modules of the current folder, or a folder of NODE_PATH; None: nowhere."""
    more = filter(None, os.environ.get("NODE_PATH", "").split(os.pathsep))
    found = (Path(place) / package for place in ("node_modules", *more))
    return next((p.resolve() for p in found if (p / "package.json").is_file()), None)


def versions_of_node() -> dict[str, str]:
    """Version of each package of npm that is here."""
    places = {name: place for name in PACKAGES_OF_NODE.values() if (place := node_folder(name))}
    return {
        name: str(json.loads((place / "package.json").read_text(encoding="utf-8"))["version"])
        for name, place in places.items()
    }


def missing_in_node(package: str) -> str:
    """What a package of npm lacks to run here; empty where it can."""
    if shutil.which("node") is None:
        return "it runs under Node, https://nodejs.org"
    return "" if node_folder(package) else f"npm install {package} in this folder, or its folder in NODE_PATH"


FINE = {"substeps": 16, "solver_iterations": 4}


def _own() -> list[EngineVariant]:
    found = []
    for name, spec in STEPPERS.items():
        cannot = {} if spec.spin else {"spin": "the stepper has no spin friction"}
        cannot |= {} if spec.rolling else {"rolling": "the stepper has no rolling friction"}
        settings: list[tuple[str, dict[str, Any], str]] = [
            (name, {}, "4 substeps of 16 sweeps"), (f"{name} 16x4", FINE, "16 substeps of 4 sweeps"),
        ]  # fmt: skip
        if spec.solvers:
            newton = {"solver": "newton", "substeps": 4}
            settings.append((f"{name} newton", newton, "4 substeps, Newton to 1e-6"))
        for full, more, words in settings:
            asked = {"stepper": name, "dt": 1 / 60, **more}
            found.append(EngineVariant(full, "own", "", {}, f"1/60 s, {words}", scene=asked, cannot=cannot))
    return found


_PATCHES = {"spin": NO_SPIN, "rolling": NO_ROLLING}
_JOLT, _RAPIER = PACKAGES_OF_NODE["jolt"], PACKAGES_OF_NODE["rapier"]
#: Engines of others.
_OTHERS = (
    *(
        EngineVariant(
            f"mujoco {cone}{' noslip' if noslip else ''}", "mujoco", "mujoco", {"cone": cone, "noslip": noslip},
            "2 ms, Newton to 1e-8" + (f", {noslip} iterations of noslip" if noslip else ""),
        )
        for cone in ("pyramidal", "elliptic") for noslip in (0, 10)
    ),
    EngineVariant("pybullet", "bullet", "pybullet", {"sweeps": 50, "substeps": 1}, "1/240 s, 50 sweeps"),
    EngineVariant("pybullet 4x100", "bullet", "pybullet", {"sweeps": 100, "substeps": 4}, "1/240 s in 4 of 100 sweeps"),
    EngineVariant("drake", "drake", "pydrake", {"approximation": "lagged", "hydroelastic": False},
        "1 ms, point contacts: its defaults", cannot=_PATCHES),
    EngineVariant("drake lagged", "drake", "pydrake", {"approximation": "lagged", "hydroelastic": True},
        "1 ms, hydroelastic bodies of 1e8 Pa", cannot=_PATCHES),
    EngineVariant("drake sap", "drake", "pydrake", {"approximation": "sap", "hydroelastic": True},
        "1 ms, SAP, hydroelastic bodies of 1e8 Pa", cannot=_PATCHES),
    EngineVariant("lavendersim", "lavender_sim", "lavendersim", {"sweeps": 22}, "1/60 s in 4 of 22 sweeps"),
    EngineVariant("lavendersim 64", "lavender_sim", "lavendersim", {"sweeps": 64}, "1/60 s in 4 of 64 sweeps"),
    EngineVariant("rapier", "node", _RAPIER, {"engine": "rapier", "iterations": 4},
        "1/60 s, 4 iterations: its defaults", cannot=NO_TORSION),
    EngineVariant("rapier 16", "node", _RAPIER, {"engine": "rapier", "iterations": 16}, "1/60 s, 16 iterations",
        cannot=NO_TORSION),
    EngineVariant("jolt", "node", _JOLT, {"engine": "jolt", "sweeps": 10, "substeps": 1, "gyroscopic": False},
        "1/60 s, 10 sweeps: its defaults", cannot=NO_TORSION),
    EngineVariant("jolt 4", "node", _JOLT, {"engine": "jolt", "sweeps": 10, "substeps": 4, "gyroscopic": True},
        "1/60 s in 4 of 10 sweeps, gyroscopic torques", cannot=NO_TORSION),
    EngineVariant("newton xpbd", "newton", "newton", {"solver": "XPBD", "iterations": 2},
        "1/60 s in 4 of 2 iterations, its default"),
    EngineVariant("newton xpbd 20", "newton", "newton", {"solver": "XPBD", "iterations": 20},
        "1/60 s in 4 of 20 iterations"),
    EngineVariant("newton vbd", "newton", "newton", {"solver": "VBD", "iterations": 10},
        "1/60 s in 4 of 10 iterations, its default", cannot=NO_TORSION),
)  # fmt: skip
#: Variants of engines by name; lavender's own steppers come first.
ENGINE_VARIANTS: dict[str, EngineVariant] = {variant.name: variant for variant in (*_own(), *_OTHERS)}


def engine(module: str, scene: Scene, **options: Any) -> Stepping:
    """The engine of a file of this folder with a scene."""
    made: Stepping = importlib.import_module(f"lavender.lab.phenomena.engines.{module}").Engine(
        scene, **options
    )
    return made


def make(variant: EngineVariant, scene: Scene) -> Stepping:
    """Create the engine of a variant for a scene."""
    return engine(variant.module, scene, **variant.options)


def follow(engine: Stepping, seconds: float, interval: float) -> Track:
    """Step for so long, a sample every `interval` seconds, in whole steps; a state that is not finite is the last."""
    every = max(1, round(interval / engine.dt))
    samples = max(2, int(np.ceil(seconds / (every * engine.dt) - 1e-9)))
    states, spent, done = [engine.state()], 0.0, 0
    for _ in range(samples):
        begin = engine.clock()
        engine.advance(every)
        spent += engine.clock() - begin
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
