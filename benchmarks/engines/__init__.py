"""Other engines, one file each: `Engine(scene, **options)` steps a scene of LavenderSim in another engine."""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import shutil
from pathlib import Path
from time import process_time
from typing import Any

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError
from lavender.sim.scene import Body, Box, Plane, Scene, Sphere

PACKAGES_OF_NODE = {
    "rapier": "@dimforge/rapier3d-compat",
    "jolt": "jolt-physics",
}  # Engine -> npm package.


class Stepping:
    """One engine with one scene; `dt` [s] is the time of one `step`."""

    scene: Scene
    dt = 0.0

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

    def measure_last_step(self) -> tuple[int, float, float]:
        """Return the number of contacts, the largest penetration or joint gap [m], and the relative residual.

        The values belong to the last step. The judge computes the residual; it is nan if the engine does not provide
        its constraint problem.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Release the resources of the engine."""


def create_engine(module: str, scene: Scene, **options: Any) -> Stepping:
    """Create the engine of a file of this folder with a scene."""
    created: Stepping = importlib.import_module(f"benchmarks.engines.{module}").Engine(
        scene, **options
    )
    return created


def get_collision_shape(body: Body, engine: str, static: bool = True) -> Plane | Sphere | Box:
    """Return the collision shape of a body.

    Raise CapabilityError if the body has no shape. If `static` is false, raise it also for a static body that
    is not a plane.
    """
    shape = body.shape
    if shape is None or (body.is_static and not static and not isinstance(shape, Plane)):
        raise CapabilityError(
            f"{body.name} has no collision shape, or a static one that is not a plane; {engine} needs "
            "another shape of this body"
        )
    return shape


def reject_joints(scene: Scene, engine: str) -> None:
    """Raise CapabilityError if a scene has joints."""
    if scene.joints:
        raise CapabilityError(
            f"the scene has joints; the adapter of {engine} accepts only scenes without joints"
        )


def get_missing_installation_command(package: str) -> str:
    """Return the command that installs a Python or npm package; empty if it is installed, or no package is needed."""
    if package in PACKAGES_OF_NODE.values():
        return explain_missing_npm_package(package)
    if not package or importlib.util.find_spec(package):
        return ""
    return f"pip install {package}"


def find_node_folder(package: str) -> Path | None:
    """Return the folder of an npm package, in ./node_modules or a folder of NODE_PATH; None if there is none."""
    search_path = filter(None, os.environ.get("NODE_PATH", "").split(os.pathsep))
    candidates = (Path(folder) / package for folder in ("node_modules", *search_path))
    return next((p.resolve() for p in candidates if (p / "package.json").is_file()), None)


def get_npm_versions() -> dict[str, str]:
    """Return the version of each npm package that is installed."""
    folders = {
        name: folder for name in PACKAGES_OF_NODE.values() if (folder := find_node_folder(name))
    }
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
