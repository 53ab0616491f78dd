"""Simulate scenes in the process of an engine, within a limit of CPU time, and create the engines' environments."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np

from benchmarks.engines.node import SCRIPT, JsonLines
from benchmarks.score.adapters import CannotExpress
from benchmarks.score.scenes import Description
from benchmarks.score.settings import Entry
from lavender.base.arrays import FloatArray
from lavender.base.errors import LavenderError

ROOT = Path(__file__).resolve().parents[2]
MAX_REQUEST_TIME = 900.0  # s; a program that answers later is ended
MAX_RESIDUALS = 100  # residuals read in a scene
PROPERTY_TOLERANCE = 1e-3  # relative; float32 and text formats


class Failed(Exception):
    """A cell has no result; the message is the reason."""


def split_requirement(requirement: str) -> tuple[str, str]:
    """Return name and version of a pinned requirement of pip or npm; the version is empty if it is not pinned."""
    name, _, version = requirement.replace("==", "@").rpartition("@")
    return (name, version) if name else (requirement, "")


def find_program(entry: Entry, folder: Path) -> list[str] | None:
    """Return the command that starts an engine's worker, None if its environment does not exist.

    The interpreter of this process is used if it has the pinned packages.
    """
    if entry.node:
        package = folder / entry.engine / "node_modules" / split_requirement(entry.packages[0])[0]
        return ["node", str(SCRIPT), entry.adapter, str(package)] if package.is_dir() else None
    pinned = dict(map(split_requirement, entry.packages))
    if all(is_installed(package, version) for package, version in pinned.items()):
        return [sys.executable, "-m", "benchmarks.score.worker", entry.adapter]
    interpreter = folder / entry.engine / "bin" / "python"
    return (
        [str(interpreter), "-m", "benchmarks.score.worker", entry.adapter]
        if interpreter.exists()
        else None
    )


def is_installed(package: str, version: str) -> bool:
    """Return whether this interpreter has a package, in a version unless that is empty."""
    try:
        return importlib.metadata.version(package) == version or not version
    except importlib.metadata.PackageNotFoundError:
        return False


def create_environment(entry: Entry, folder: Path) -> None:
    """Install the packages of an engine into a subfolder of its name."""
    where = folder / entry.engine
    where.mkdir(parents=True, exist_ok=True)
    if entry.node:
        install = [
            "npm",
            "install",
            "--silent",
            "--no-audit",
            "--no-fund",
            "--prefix",
            str(where),
            *entry.packages,
        ]
    else:
        subprocess.run([sys.executable, "-m", "venv", str(where)], check=True)
        install = [
            str(where / "bin" / "python"),
            "-m",
            "pip",
            "install",
            "--quiet",
            *entry.packages,
        ]
    done = subprocess.run(install, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LavenderError(
            f"{entry.engine} does not install: {(done.stderr or done.stdout).strip()[-300:]}"
        )


class Simulator:
    """The process of one engine, which simulates one scene after another; it is started again after a failure."""

    def __init__(
        self, command: list[str], settings: dict[str, Any], limit: float, residuals: bool = False
    ) -> None:
        self.command, self.settings, self.limit, self.residuals = (
            command,
            settings,
            limit,
            residuals,
        )
        self.program: JsonLines | None = None
        self.start_cell()

    def start_cell(self, expected: int = 0) -> None:
        """Forget the CPU time, steps and residual of the scenes so far; `expected` is the number of steps to come."""
        self.cpu = 0.0
        self.steps = 0
        self.expected = expected
        self.residual = float("nan")

    def run(self, scene: Description, dt: float, every: float) -> tuple[FloatArray, FloatArray]:
        """Simulate a scene; see `scenes.Run`."""
        answer = self._request({"scene": scene, "options": {"dt": dt, **self.settings}})
        check_properties(
            scene, answer["properties"], np.array(answer["states"], float).reshape(-1, 13)
        )
        total = round(scene["seconds"] / dt)
        between = max(1, round(every / dt))
        more = {"limit": self.limit - self.cpu, "residuals": MAX_RESIDUALS if self.residuals else 0}
        more["expected"] = max(total, self.expected - self.steps)
        told = self._request({"steps": total, "every": between, **more})
        self.cpu, self.steps = self.cpu + told["cpu"], self.steps + told["done"]
        if told.get("residual") is not None:
            self.residual = np.fmax(self.residual, told["residual"])
        if told["done"] < total:
            raise Failed(
                f"too slow: over {self.limit:g} s, {1e6 * self.cpu / self.steps:.0f} µs a step"
            )
        states = [*answer["states"], *told["states"]]
        t = np.array([*range(0, total, between), total], float) * dt
        return t, np.array(states, float).reshape(len(t), -1, 13)

    def _request(self, message: Any) -> Any:
        if self.program is None:
            self.program = JsonLines(self.command, cwd=ROOT)
        timer = Timer(MAX_REQUEST_TIME, self.program.kill)
        timer.start()
        try:
            answer = self.program.request_answer(message)
        except (EOFError, json.JSONDecodeError) as error:
            self.close()
            raise Failed(f"failed: {error}") from None
        finally:
            timer.cancel()
        if "cannot" in answer:
            raise CannotExpress(answer["cannot"])
        if "error" in answer:
            raise Failed(f"failed: {answer['error']}")
        return answer

    def close(self) -> None:
        """End the process."""
        if self.program is not None:
            self.program.close()
        self.program = None


def check_properties(
    scene: Description, properties: list[list[float | None]], state: FloatArray
) -> None:
    """Raise Failed if an engine has other masses, inertias, materials or initial states than the scene."""
    names = ("mass", "inertia x", "inertia y", "inertia z", "friction", "restitution")
    for i, body in enumerate(b for b in scene["bodies"] if b["mass"] > 0):
        start = [*body["position"], *body["quaternion"], *body["velocity"], *body["spin"]]
        if not np.allclose(state[i], start, rtol=PROPERTY_TOLERANCE, atol=1e-5):
            raise Failed(
                f"failed: body {i} starts with {np.round(state[i], 4).tolist()} in the engine"
            )
        wanted = [body["mass"], *body["inertia"], scene["friction"], scene["restitution"]]
        for name, want, has in zip(names, wanted, properties[i], strict=True):
            if (
                has is not None
                and not body["kinematic"]
                and abs(has - want) > PROPERTY_TOLERANCE * abs(want)
            ):
                raise Failed(
                    f"failed: {name} of body {i} is {has:g} in the engine, {want:g} in the scene"
                )
