"""Scenes in the plane x, z of engines in two dimensions."""

from __future__ import annotations

import math
from typing import Any

from benchmarks.score.adapters import CannotExpress, Scene, get_moving


class PlaneScene:
    """A scene whose horizontal vectors all have one direction, which becomes the first axis; z is the second.

    The angle of a body in the plane is negative about y: counterclockwise from x to z.
    """

    def __init__(self, scene: Scene) -> None:
        if not scene["planar"]:
            raise CannotExpress("an engine in two dimensions")
        vectors = [
            scene["gravity"],
            *(b[key] for b in get_moving(scene) for key in ("velocity", "force")),
        ]
        size, first = max((math.hypot(*v[:2]), v) for v in vectors)
        self.direction = (first[0] / size, first[1] / size) if size > 0 else (1.0, 0.0)

    def project(self, vector: Any) -> tuple[float, float]:
        """Return a vector in the plane; its horizontal part is that along the direction."""
        return self.direction[0] * vector[0] + self.direction[1] * vector[1], vector[2]

    def get_angle(self, quaternion: Any) -> float:
        """Return the angle [rad] of a quaternion about the y axis."""
        return -2.0 * math.atan2(quaternion[2], quaternion[0])

    def lift(self, position: Any, angle: float, velocity: Any, spin: float) -> list[float]:
        """Return the 13 numbers of the state of a body."""
        (c, s) = self.direction
        half = -0.5 * angle
        x, v = position, velocity
        return [
            c * x[0],
            s * x[0],
            x[1],
            math.cos(half),
            0.0,
            math.sin(half),
            0.0,
            c * v[0],
            s * v[0],
            v[1],
            0.0,
            -spin,
            0.0,
        ]
