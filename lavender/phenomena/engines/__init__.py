"""One file for each engine: `Engine(scene, **options)` steps a scene; a way is an engine with its setting."""

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

from lavender._arrays import FloatArray
from lavender.phenomena.parts import Track
from lavender.scene import Scene
from lavender.scene.steppers import STEPPERS

__all__ = [
    "PACKAGES_OF_NODE",
    "WAYS",
    "Stepping",
    "Way",
    "follow",
    "make",
    "missing_in_node",
    "node_folder",
    "versions_of_node",
]

PACKAGES_OF_NODE = {"rapier": "@dimforge/rapier3d-compat", "jolt": "jolt-physics"}  # engine -> package of npm
NO_TORSION = {"spin": "it has no friction against spinning"}
NO_SPIN = "its friction against spinning has no radius that could be given"
NO_ROLLING = "it has no friction against rolling"


class Stepping:
    """One engine with one scene."""

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
        if self.module == "node":
            lack = missing_in_node(self.package)
            return f"not installed: {lack}" if lack else ""
        if not self.package or importlib.util.find_spec(self.package):
            return ""
        return f"not installed: pip install {self.package.replace('pydrake', 'drake')}"


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


def _under_node() -> list[Way]:
    settings: tuple[tuple[str, dict[str, Any], str], ...] = (
        ("rapier", {"iterations": 4}, "1/60 s, 4 iterations: its defaults"),
        ("rapier 16", {"iterations": 16}, "1/60 s, 16 iterations"),
        ("jolt", {"sweeps": 10, "substeps": 1, "gyroscopic": False}, "1/60 s, 10 sweeps: its defaults"),
        (
            "jolt 4",
            {"sweeps": 10, "substeps": 4, "gyroscopic": True},
            "1/60 s in 4 of 10 sweeps, gyroscopic torques",
        ),
    )
    found = []
    for name, options, text in settings:
        engine = name.split()[0]
        options["engine"] = engine
        found.append(Way(name, "node", PACKAGES_OF_NODE[engine], options, text, cannot=NO_TORSION))
    return found


def _newton() -> list[Way]:
    found = []
    for name, solver, iterations, text in (
        ("newton xpbd", "XPBD", 2, "2 iterations, its default"),
        ("newton xpbd 20", "XPBD", 20, "20 iterations"),
        ("newton vbd", "VBD", 10, "10 iterations, its default"),
    ):
        options = {"solver": solver, "iterations": iterations}
        cannot = NO_TORSION if solver == "VBD" else {}
        found.append(Way(name, "newton", "newton", options, f"1/60 s in 4 of {text}", cannot=cannot))
    return found


#: Name -> way; ours first.
WAYS: dict[str, Way] = {way.name: way for way in (*_own(), *_others(), *_under_node(), *_newton())}


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
    for _ in range(looks):
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
