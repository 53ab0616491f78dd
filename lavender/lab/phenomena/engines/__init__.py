"""Engines, one file each: `Engine(scene, **options)` steps a scene. An `EngineVariant` is an engine with settings."""

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

PACKAGES_OF_NODE = {"rapier": "@dimforge/rapier3d-compat", "jolt": "jolt-physics"}  # Engine -> npm package.
NO_TORSION = {"spin": "it has no torsional friction"}
NO_PATCH_RADIUS = "its torsional friction has no radius parameter"
NO_ROLLING = "it has no rolling friction"


class Stepping:
    """One engine with one scene; `dt` [s] is the time of one `step`, `setting` describes step, substeps and sweeps."""

    scene: Scene
    dt = 0.0
    setting = ""

    def step(self) -> Any:
        """Make one step of dt."""
        raise NotImplementedError

    def advance(self, steps: int) -> None:
        """Make `steps` steps."""
        for _ in range(steps):
            self.step()

    def get_cpu_time(self) -> float:
        """Return the CPU time [s] of the steps so far, from an arbitrary zero."""
        return process_time()

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return positions (n, 3) [m], quaternions (n, 4) w x y z, world velocities (n, 6) [m/s, rad/s]."""
        raise NotImplementedError

    def make_initial_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return a state with every body at rest at its position in the scene."""
        x, q = (
            np.array([getattr(b, name) for b in self.scene.bodies]) for name in ("position", "quaternion")
        )
        return x, q, np.zeros((len(x), 6))

    def get_joint_force(self) -> float:
        """Return the force of the first joint [N]; nan if the engine does not provide it."""
        return float("nan")

    def measure_last_step(self) -> tuple[int, float, float]:
        """Return the number of contacts, the largest penetration or joint gap [m], and the relative residual.

        The values belong to the last step. The judge computes the residual; it is nan if the engine does not provide
        its constraint problem.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Release the resources of the engine."""


@dataclass(frozen=True)
class EngineVariant:
    """An engine with settings: its defaults, or recommended ones.

    Parameters
    ----------
    name : str
    module : str
        File of this folder.
    package : str
        Python module or npm package that the engine needs; empty if none.
    options : mapping
        Options of `Engine`.
    text : str
        Description of the settings.
    scene : mapping
        Scene parameters that the variant sets, such as the stepper of LavenderSim.
    cannot : mapping of str to str
        Unsupported feature of a scene -> reason.
    """

    name: str
    module: str
    package: str
    options: Mapping[str, Any]
    text: str
    scene: Mapping[str, Any] = field(default_factory=dict)
    cannot: Mapping[str, str] = field(default_factory=dict)

    def explain_missing(self) -> str:
        """Return the reason why the variant cannot run here; empty if it can."""
        hint = get_missing_installation_command(self.package)
        return f"not installed: {hint}" if hint else ""


def get_missing_installation_command(package: str) -> str:
    """Return the command that installs a Python or npm package; empty if it is installed, or no package is needed."""
    if package in PACKAGES_OF_NODE.values():
        return explain_missing_npm_package(package)
    if not package or importlib.util.find_spec(package):
        return ""
    return f"pip install {package.replace('pydrake', 'drake')}"


def find_node_folder(package: str) -> Path | None:
    """Return the folder of an npm package, in ./node_modules or a folder of NODE_PATH; None if there is none."""
    search_path = filter(None, os.environ.get("NODE_PATH", "").split(os.pathsep))
    candidates = (Path(folder) / package for folder in ("node_modules", *search_path))
    return next((p.resolve() for p in candidates if (p / "package.json").is_file()), None)


def get_npm_versions() -> dict[str, str]:
    """Return the version of each npm package that is installed."""
    folders = {name: folder for name in PACKAGES_OF_NODE.values() if (folder := find_node_folder(name))}
    return {
        name: str(json.loads((folder / "package.json").read_text(encoding="utf-8"))["version"])
        for name, folder in folders.items()
    }


def explain_missing_npm_package(package: str) -> str:
    """Return the reason why an npm package cannot run here; empty if it can."""
    if shutil.which("node") is None:
        return "it runs under Node, https://nodejs.org"
    return (
        ""
        if find_node_folder(package)
        else f"npm install {package} in this folder, or its folder in NODE_PATH"
    )


# Options of the finer setting of lavender's steppers.
FINE_STEPS = {"substeps": 16, "solver_iterations": 4}


def _make_own_variants() -> list[EngineVariant]:
    """Build the variants of lavender's own steppers."""
    variants = []
    for name, spec in STEPPERS.items():
        cannot = {} if spec.spin else {"spin": "the stepper has no torsional friction"}
        cannot |= {} if spec.rolling else {"rolling": "the stepper has no rolling friction"}
        settings: list[tuple[str, dict[str, Any], str]] = [
            (name, {}, "4 substeps of 16 sweeps"), (f"{name} 16x4", FINE_STEPS, "16 substeps of 4 sweeps"),
        ]  # fmt: skip
        if spec.solvers:
            newton = {"solver": "newton", "substeps": 4}
            settings.append((f"{name} newton", newton, "4 substeps, Newton to 1e-6"))
        for full_name, overrides, description in settings:
            parameters = {"stepper": name, "dt": 1 / 60, **overrides}
            variants.append(
                EngineVariant(
                    full_name, "own", "", {}, f"1/60 s, {description}", scene=parameters, cannot=cannot
                )
            )
    return variants


_NO_PATCH_FRICTION = {"spin": NO_PATCH_RADIUS, "rolling": NO_ROLLING}
_JOLT, _RAPIER = PACKAGES_OF_NODE["jolt"], PACKAGES_OF_NODE["rapier"]
#: Third-party engines.
_THIRD_PARTY_VARIANTS = (
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
        "1 ms, point contacts: its defaults", cannot=_NO_PATCH_FRICTION),
    EngineVariant("drake lagged", "drake", "pydrake", {"approximation": "lagged", "hydroelastic": True},
        "1 ms, hydroelastic bodies of 1e8 Pa", cannot=_NO_PATCH_FRICTION),
    EngineVariant("drake sap", "drake", "pydrake", {"approximation": "sap", "hydroelastic": True},
        "1 ms, SAP, hydroelastic bodies of 1e8 Pa", cannot=_NO_PATCH_FRICTION),
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
#: Name -> engine variant; lavender's own come first.
ENGINE_VARIANTS: dict[str, EngineVariant] = {
    variant.name: variant for variant in (*_make_own_variants(), *_THIRD_PARTY_VARIANTS)
}


def create_engine(module: str, scene: Scene, **options: Any) -> Stepping:
    """Create the engine of a file of this folder with a scene."""
    created: Stepping = importlib.import_module(f"lavender.lab.phenomena.engines.{module}").Engine(
        scene, **options
    )
    return created


def make_engine(variant: EngineVariant, scene: Scene) -> Stepping:
    """Create the engine of a variant with a scene."""
    return create_engine(variant.module, scene, **variant.options)


def record_track(engine: Stepping, seconds: float, interval: float) -> Track:
    """Step an engine for `seconds` [s] and record its state every `interval` [s], rounded to whole steps.

    The recording ends after the first state that is not finite.
    """
    steps_per_sample = max(1, round(interval / engine.dt))
    samples = max(2, int(np.ceil(seconds / (steps_per_sample * engine.dt) - 1e-9)))
    states, cpu_time, n_steps = [engine.get_state()], 0.0, 0
    for _ in range(samples):
        begin = engine.get_cpu_time()
        engine.advance(steps_per_sample)
        cpu_time += engine.get_cpu_time() - begin
        n_steps += steps_per_sample
        states.append(engine.get_state())
        if not all(np.isfinite(x).all() for x in states[-1]):
            break
    x, q, v = (np.array(part, float) for part in zip(*states, strict=True))
    return Track(
        time=np.arange(len(states), dtype=float) * (steps_per_sample * engine.dt),
        positions=x,
        quaternions=q,
        velocities=v,
        force=engine.get_joint_force(),
        cpu=cpu_time / (n_steps * engine.dt),
        setting=engine.setting,
    )
