"""Engines from npm packages. The Node program `served.mjs` steps them; each engine has a file in this folder."""

from __future__ import annotations

import contextlib
import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.engines import (
    PACKAGES_OF_NODE,
    Stepping,
    explain_missing_npm_package,
    find_node_folder,
    get_collision_shape,
    reject_joints,
)
from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, LavenderError
from lavender.sim.scene import Body, Plane, Scene, Sphere

SCRIPT = Path(__file__).with_name("served.mjs")


class JsonLines:
    """A program that answers each line of JSON with one line of JSON.

    It has no time limit.
    """

    def __init__(self, command: Sequence[str], cwd: Path | None = None) -> None:
        self._name = command[0]
        self._process = subprocess.Popen(
            command,
            cwd=cwd,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )

    def request_answer(self, message: Any) -> Any:
        """Return the answer to a message; EOFError if the program ended, ValueError if the answer is not JSON."""
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None and answers is not None
        # Writing fails if the program has ended; reading its answer then raises.
        with contextlib.suppress(OSError):
            requests.write(json.dumps(message) + "\n")
            requests.flush()
        line = answers.readline()
        if not line:
            raise EOFError(f"{self._name} ended with status {self._process.wait()}")
        return json.loads(line)

    def kill(self) -> None:
        """Kill the program; a request that waits for its answer then raises EOFError."""
        self._process.kill()

    def close(self) -> None:
        """Kill the program; it has no data to save."""
        self.kill()
        with contextlib.suppress(OSError):  # The program closed a pipe itself.
            self._process.communicate()


class Engine(Stepping):
    """An engine under Node, which returns its state with each answer."""

    def __init__(self, scene: Scene, engine: str, dt: float = 1.0 / 60.0, **options: float) -> None:
        reject_joints(scene, engine)
        self.dt = dt
        self.cpu_time = 0.0
        p = scene.parameters
        request = {
            "gravity": list(p.gravity),
            "friction": p.friction,
            "bodies": [_describe_body(body, engine) for body in scene.bodies],
        }
        folder = find_node_folder(PACKAGES_OF_NODE[engine])
        if folder is None:
            raise LavenderError(
                f"{engine}: {explain_missing_npm_package(PACKAGES_OF_NODE[engine])}"
            )
        self.program = JsonLines(["node", str(SCRIPT), engine, str(folder)])
        self._request_answer({"scene": request, "options": {"dt": self.dt, **options}})
        self.cpu_time = 0.0

    def _request_answer(self, message: Any) -> None:
        """Send a message, raise errors of its answer, and store the time and state that it returns."""
        answer = self.program.request_answer(message)
        if "cannot" in answer:
            raise CapabilityError(str(answer["cannot"]))
        if "error" in answer:
            raise LavenderError(str(answer["error"]))
        self.cpu_time += float(answer["cpu"])
        # null, a number that is not finite, becomes nan.
        self.states = np.array(answer["states"][-1], float).reshape(-1, 13)

    def step(self) -> None:
        """See `Stepping.step`."""
        self.advance(1)

    def advance(self, steps: int) -> None:
        """See `Stepping.advance`."""
        self._request_answer({"steps": steps})

    def get_cpu_time(self) -> float:
        """See `Stepping.get_cpu_time`; it is the time of the other process."""
        return self.cpu_time

    def get_state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.get_state`; the engines compute in float32."""
        return self.states[:, :3], self.states[:, 3:7], self.states[:, 7:]

    def close(self) -> None:
        """See `Stepping.close`."""
        self.program.close()


def _describe_body(body: Body, engine: str) -> dict[str, Any]:
    """Build the JSON description of a body."""
    shape = get_collision_shape(body, engine, static=False)
    if isinstance(shape, Plane):
        shape_data: dict[str, Any] = {
            "kind": "plane",
            "normal": list(shape.normal),
            "offset": shape.offset,
        }
    elif isinstance(shape, Sphere):
        shape_data = {"kind": "sphere", "radius": shape.radius}
    else:
        shape_data = {"kind": "box", "size": list(shape.size)}
    position, quaternion = body.position.tolist(), body.quaternion.tolist()
    return {
        "shape": shape_data,
        "mass": body.mass,
        "inertia": np.diag(body.inertia).tolist(),
        "position": position,
        "quaternion": quaternion,
        "velocity": body.velocity.tolist(),
        "spin": body.angular_velocity.tolist(),
        # State of the body at its initial pose with zero velocity.
        "still": [*position, *quaternion, *[0.0] * 6],
    }
