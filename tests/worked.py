"""The examples and the sources, each loaded once for all tests; simulations; Python in a process of its own."""

import ast
import functools
import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from random_problems import rotation

import lavender

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "examples"))  # where they find `panels`


@functools.cache
def example(name):
    """The module of an example; what its numbers() gives is computed once."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if hasattr(module, "numbers"):
        module.numbers = functools.cache(module.numbers)
    return module


@functools.cache
def syntax_of_package():
    """Path to syntax tree of every file of the package."""
    files = sorted(Path(lavender.__file__).parent.rglob("*.py"))
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}


def after(steps, scene, **parameters):
    """A simulation of a scene, or of one of the gallery by name, that has made so many steps."""
    simulation = lavender.Simulation(
        scene if isinstance(scene, lavender.Scene) else lavender.Scene(scene, **parameters)
    )
    for _ in range(steps):
        simulation.step()
    return simulation


def energy(scene, observation):
    """Kinetic and potential energy [J] of what moves."""
    total = 0.0
    g = np.array(scene.parameters.gravity)
    seen = (observation[key] for key in ("positions", "quaternions", "velocities"))
    for body, x, q, v in zip(scene.bodies, *seen, strict=True):
        if not body.is_static:
            omega = rotation(q).T @ v[3:]
            total += (
                0.5 * body.mass * v[:3] @ v[:3]
                + 0.5 * omega @ body.inertia @ omega
                - body.mass * g @ x
            )
    return total


def chromium():
    """Where a browser is, for playwright; whoever has none is skipped."""
    names = ("chromium", "chromium-browser", "google-chrome")
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip(f"none of {', '.join(names)} is installed, and CHROMIUM names no browser")
    return found


def python(*words, status=0, **more):
    """What became of Python in a process of its own: what crashes or hangs there fails one test alone."""
    asked = {
        "capture_output": True,
        "text": True,
        "check": False,
        "cwd": ROOT,
        "timeout": 1800.0,
    } | more
    done = subprocess.run([sys.executable, *map(str, words)], **asked)
    assert done.returncode == status, done.stdout + done.stderr
    return done
