"""Write a film of a run: an orthographic view, turned by `TURN` about the vertical, from an elevation of `TILT`.

A point p is drawn at (p.RIGHT, p.TOP), in front of all points with a larger p.AWAY.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from os import PathLike
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import require_packages
from lavender.io.stored import write_atomically
from lavender.sim.engine.layout import JOINT
from lavender.sim.engine.simulation import Simulation
from lavender.sim.scene.parts import convert_to_rotation_matrix
from lavender_ext.engine.arrays import BOX, PLANE, SPHERE

FRAME_RATE = 25  # [1/s] of simulated time; a GIF stores durations in hundredths of a second.
TURN, TILT = 0.45, 0.22  # [rad]
RIGHT = np.array([np.cos(TURN), np.sin(TURN), 0.0])
AWAY = np.array([-np.sin(TURN) * np.cos(TILT), np.cos(TURN) * np.cos(TILT), -np.sin(TILT)])
TOP = np.cross(RIGHT, AWAY)
VIEW = np.stack([RIGHT, TOP], axis=1)
LIGHT = np.array([-0.45, -0.62, 0.64])
COLORS = (
    np.array([[122, 95, 181], [79, 124, 172], [91, 146, 121], [181, 137, 95], [168, 95, 122]])
    / 255.0
)


class Film:
    """Poses of a run at `FRAME_RATE`, beginning with the present ones of a simulation, to be saved as a GIF."""

    def __init__(self, simulation: Simulation) -> None:
        require_packages("a film", "matplotlib")
        a = simulation.state.a
        self._bodies = list(zip(a["kind_of_shape"].tolist(), a["shape"].copy(), strict=True))
        self._joints: list[
            tuple[int, FloatArray]
        ] = []  # A body, and the joint's anchor in its frame [m].
        for (body_a, body_b), joint in zip(a["joint_bodies"].tolist(), a["joint"], strict=True):
            at = JOINT["anchor_b" if body_b >= 0 else "anchor_a"]
            self._joints.append((body_b if body_b >= 0 else body_a, joint[at : at + 3].copy()))
        self._frames = [
            (simulation.time, a["x"].reshape(-1, 3).copy(), a["q"].reshape(-1, 4).copy())
        ]

    def add(self, time: float, positions: FloatArray, quaternions: FloatArray) -> None:
        """Add the poses (n, 3) [m] and (n, 4) at `time` [s] if they are finite and the next frame is due."""
        is_due = time >= self._frames[0][0] + len(self._frames) / FRAME_RATE - 1e-9
        if is_due and np.isfinite(positions).all() and np.isfinite(quaternions).all():
            self._frames.append((time, positions.copy(), quaternions.copy()))

    def save(self, path: str | PathLike[str]) -> None:
        """Write a GIF; an existing file is replaced atomically."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from PIL import Image

        radii = [
            float(np.linalg.norm(shape[:3])) for kind, shape in self._bodies if kind >= SPHERE
        ] or [1.0]
        solid = [i for i, (kind, _) in enumerate(self._bodies) if kind >= SPHERE] or [0]
        centres = np.stack([x[solid] @ VIEW for _, x, _ in self._frames])
        low, high = ((centres + s * np.array(radii)[:, None]) for s in (-1, 1))
        (left, bottom), (right, top) = low.min(axis=(0, 1)), high.max(axis=(0, 1))
        height = 3.3 * float(np.clip((top - bottom) / (right - left), 0.3, 2.5))
        canvas: Any = FigureCanvasAgg(Figure(figsize=(3.0, height), dpi=160, layout="constrained"))
        axes = canvas.figure.subplots()

        def draw_frames() -> Iterator[Any]:
            for time, x, q in self._frames:
                axes.clear()
                axes.set_axis_off()
                axes.set(
                    xlim=(left, right), ylim=(bottom, top), aspect="equal", title=f"{time:.2f} s"
                )
                self._draw(axes, x, q)
                canvas.draw()
                yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")

        images = draw_frames()
        options = {"save_all": True, "duration": 1000 // FRAME_RATE, "loop": 0}
        write_atomically(
            path, lambda part: next(images).save(part, "GIF", append_images=images, **options)
        )

    def _draw(self, axes: Any, x: FloatArray, q: FloatArray) -> None:
        """Draw boxes and spheres, horizontal planes as a line, and joints as lines from a body to the anchor."""
        from matplotlib.patches import Circle, Polygon

        for i, (kind, shape) in enumerate(self._bodies):
            color = COLORS[i % len(COLORS)]
            if kind == PLANE and shape[2] > 0.99:
                axes.axhline(shape[3] * TOP[2], color="0.6", lw=0.8, zorder=-1e9)
            elif kind == SPHERE:
                ball = Circle(
                    tuple(x[i] @ VIEW),
                    shape[0],
                    fc=color,
                    ec="k",
                    lw=0.5,
                    zorder=-float(x[i] @ AWAY),
                )
                axes.add_patch(ball)
            elif kind == BOX:
                axis_vectors = convert_to_rotation_matrix(q[i]).T * shape[:3, None]
                for k, sign in product(range(3), (-1.0, 1.0)):
                    face = sign * axis_vectors[k]
                    u = axis_vectors[k - 1]
                    v = axis_vectors[k - 2]
                    if face @ AWAY < 0.0:
                        points = x[i] + face + np.stack([u + v, u - v, -u - v, v - u])
                        fill = color * (0.6 + 0.4 * (face @ LIGHT) / shape[k])
                        outline = points @ VIEW
                        depth = -float((points @ AWAY).mean())
                        axes.add_patch(Polygon(outline, fc=fill, ec="k", lw=0.5, zorder=depth))
        for i, anchor in self._joints:
            line = np.stack([x[i], x[i] + convert_to_rotation_matrix(q[i]) @ anchor]) @ VIEW
            axes.plot(*line.T, "k-o", lw=0.6, ms=1.5, markevery=[1], zorder=1e9)
