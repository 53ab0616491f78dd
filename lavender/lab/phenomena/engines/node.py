"""Engines that npm installs, under Node: `served.mjs` steps them, each with a file of its own beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.apart.lines import Lines
from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, LavenderError
from lavender.lab.phenomena.engines import PACKAGES_OF_NODE, Stepping, missing_in_node, node_folder
from lavender.lab.phenomena.engines.tree import collision_shape, parents
from lavender.sim.scene import Body, Plane, Scene, Sphere

SCRIPT = Path(__file__).with_name("served.mjs")


class Engine(Stepping):
    """Steps in the other process; a state comes back with each answer."""

    def __init__(self, scene: Scene, engine: str, dt: float = 1.0 / 60.0, **options: float) -> None:
        parents(scene, engine)  # what trees do not have is refused
        self.dt, self.spent = dt, 0.0
        self.setting = f"{1e3 * dt:.3g} ms, {', '.join(f'{k} {v}' for k, v in options.items())}"
        p = scene.parameters
        told = {
            "gravity": list(p.gravity),
            "friction": p.friction,
            "bodies": [_body(body, engine) for body in scene.bodies],
            "joints": [
                {
                    "kind": j.kind, "a": j.a, "b": j.b,
                    **{k: getattr(j, k).tolist() for k in ("anchor_a", "anchor_b", "axis_a", "axis_b")},
                }
                for j in scene.joints
            ],
        }  # fmt: skip
        place = node_folder(PACKAGES_OF_NODE[engine])
        if place is None:
            raise LavenderError(f"{engine}: {missing_in_node(PACKAGES_OF_NODE[engine])}")
        self.lines = Lines(["node", str(SCRIPT), engine, str(place)])
        self._ask({"scene": told, "options": {"dt": self.dt, **options}})
        self.spent = 0.0

    def _ask(self, message: Any) -> None:
        said = self.lines.ask(message)
        if "cannot" in said:
            raise CapabilityError(str(said["cannot"]))
        if "error" in said:
            raise LavenderError(str(said["error"]))
        self.spent += float(said["cpu"])
        # null, for what is not finite, becomes nan
        self.seen = np.array(said["state"], float).reshape(-1, 13)

    def step(self) -> None:
        """See `Stepping.step`."""
        self.advance(1)

    def advance(self, steps: int) -> None:
        """See `Stepping.advance`."""
        self._ask({"steps": steps})

    def clock(self) -> float:
        """See `Stepping.clock`: of the other process."""
        return self.spent

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """See `Stepping.state`; the engines keep 32 bits."""
        return self.seen[:, :3], self.seen[:, 3:7], self.seen[:, 7:]

    def close(self) -> None:
        """See `Stepping.close`."""
        self.lines.end()


def _body(body: Body, engine: str) -> dict[str, Any]:
    shape = collision_shape(body, engine, static=False)
    if isinstance(shape, Plane):
        told: dict[str, Any] = {"kind": "plane", "normal": list(shape.normal), "offset": shape.offset}
    elif isinstance(shape, Sphere):
        told = {"kind": "sphere", "radius": shape.radius}
    else:
        told = {"kind": "box", "size": list(shape.size)}
    position, quaternion = body.position.tolist(), body.quaternion.tolist()
    return {
        "shape": told,
        "mass": body.mass,
        "inertia": np.diag(body.inertia).tolist(),
        "position": position,
        "quaternion": quaternion,
        "velocity": body.velocity.tolist(),
        "spin": body.angular_velocity.tolist(),
        "still": [*position, *quaternion, *[0.0] * 6],  # of what does not move
    }
