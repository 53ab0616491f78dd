"""Pictures of a film by matplotlib: a strip of frames or an animation, for documents.

An orthographic view: `turn` [rad] about the vertical, `tilt` [rad] from above. With r, a, t the directions to the
right, away from the eye and upwards on the paper, a point p is at (p.r, p.t); faces are painted from far to near.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float, check_int
from lavender.base.errors import InputError
from lavender.io.stored import as_path, write_atomically, write_figure
from lavender.sim.engine.film import Film
from lavender.sim.scene.parts import rotation
from lavender_ext.engine.arrays import BOX, PLANE, SPHERE

PICTURES = (".gif", ".mp4", ".png", ".svg", ".pdf")
DPI = 160  # of an animation: 480 pixels at the width that is the default

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
FACES = (
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
)  # -x +x -y +y -z +z
LIGHT = np.array([-0.45, -0.62, 0.64])
COLORS = ("#7a5fb5", "#4f7cac", "#5b9279", "#b5895f", "#a85f7a", "#6b8fb5", "#8a7fb0")


def picture_suffix(path: str | PathLike[str]) -> str:
    """The suffix of a picture's file; InputError for one that cannot be made here."""
    suffix = as_path(path).suffix
    if suffix.lower() not in PICTURES:
        raise InputError(f"{str(path)!r} ends in {suffix!r}; .gif, .mp4, .png, .svg or .pdf is needed")
    if suffix.lower() == ".mp4" and which("ffmpeg") is None:
        raise InputError("an .mp4 needs ffmpeg, which is not here; a .gif needs nothing")
    return suffix.lower()


def save_picture(
    film: Film | Mapping[str, Film],
    path: str | PathLike[str],
    *,
    frames: int = 4,
    turn: float = 0.45,
    tilt: float = 0.22,
    size: float = 3.0,
    rate: float = 30,
) -> Path:
    """Write a film, or several by name (beside each other, in a strip below each other), as pictures.

    `.gif`, or `.mp4` where ffmpeg is: an animation in the time of the film, `rate` frames in a second (of a GIF the
    nearest that whole hundredths of a second allow). `.png`, `.svg`, `.pdf`: `frames` of them side by side, evenly
    spaced. `turn` and `tilt` [rad] say where the eye is, `size` [inch] how wide one frame is.
    """
    path, suffix = as_path(path), picture_suffix(path)
    films = film if isinstance(film, Mapping) else {"": film}
    if not films or not all(len(one) for one in films.values()):
        raise InputError("the film has no frames; step first")
    frames, rate = check_int("frames", frames, 1), check_float("rate [1/s]", rate, above=0.0)
    size = check_float("size [inch]", size, low=0.5, high=50.0)
    turn, tilt = check_float("turn [rad]", turn), check_float("tilt [rad]", tilt)
    stages = [Stage(one, turn, tilt, name) for name, one in films.items()]
    ends = np.array([stage.bounds for stage in stages])
    for stage in stages:  # one scale for all
        stage.bounds = tuple(np.where([1, 0, 1, 0], ends.min(axis=0), ends.max(axis=0)))
    if suffix in (".gif", ".mp4"):
        _animate(stages, path, size, rate)
    else:
        _strip(stages, path, frames, size)
    return path


class Stage:
    """One view for all frames: directions, bounds, and bodies as painted shapes."""

    def __init__(self, film: Film, turn: float, tilt: float, name: str = "") -> None:
        self.name = name
        s, c, up, flat = np.sin(turn), np.cos(turn), np.sin(tilt), np.cos(tilt)
        self.right = np.array([c, s, 0.0])
        self.away = np.array([-s * flat, c * flat, -up])
        self.top = np.array([-s * up, c * up, flat])
        self.film, self.bodies = film, film.header["bodies"]
        self.x, self.q, self.time = film.positions, film.quaternions, film.time
        seen = [i for i, body in enumerate(self.bodies) if body["kind"] >= SPHERE]
        reach = np.array([np.linalg.norm(self.bodies[i]["shape"][:3]) for i in seen])
        centre = self.x[:, seen] if seen else np.zeros((1, 1, 3))
        reach = reach if seen else np.ones(1)
        across, tall = centre @ self.right, centre @ self.top
        self.bounds: tuple[float, ...] = (
            float((across - reach).min()),
            float((across + reach).max()),
            float((tall - reach).min()),
            float((tall + reach).max()),
        )

    @property
    def height(self) -> float:
        """Height over width, within what a page can hold."""
        left, right, low, high = self.bounds
        return float(np.clip((high - low) / (right - left), 0.3, 2.5))

    def project(self, points: FloatArray) -> FloatArray:
        """Places in the picture of points in the world."""
        return np.stack([points @ self.right, points @ self.top], axis=-1)

    def paint(self, axes: Any, frame: int) -> None:
        """Draw a frame of the film."""
        from matplotlib.colors import to_rgb
        from matplotlib.patches import Circle, Polygon

        axes.clear()
        axes.set_axis_off()
        left, right, low, high = self.bounds
        axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
        items: list[tuple[float, Any]] = []
        for i, body in enumerate(self.bodies):
            x, q, size = self.x[frame, i], self.q[frame, i], np.array(body["shape"][:3])
            color = np.array(to_rgb(COLORS[i % len(COLORS)]))
            if body["kind"] == BOX:
                r = rotation(q)
                corners = x + (CORNERS * size) @ r.T
                for f, face in enumerate(FACES):
                    normal = (1.0 if f & 1 else -1.0) * r[:, f >> 1]
                    if normal @ self.away < 0.0:
                        points = corners[list(face)]
                        bright = 0.6 + 0.4 * (normal @ LIGHT)
                        fill = np.clip(color * bright + 0.25 * max(bright - 0.6, 0.0), 0.0, 1.0)
                        shape = Polygon(self.project(points), fc=fill, ec="#2a2035", lw=0.5)
                        items.append((float((points @ self.away).mean()), shape))
            elif body["kind"] == SPHERE:
                across, up = self.project(x)
                fill = np.clip(color * 1.1, 0.0, 1.0)
                ball = Circle((across, up), size[0], fc=fill, ec="#2a2035", lw=0.5)
                items.append((float(x @ self.away), ball))
        for depth, (_, shape) in enumerate(sorted(items, key=lambda item: -item[0])):
            shape.set_zorder(2 + depth / (len(items) + 1))
            axes.add_patch(shape)
        self._ground(axes)
        self._joints(axes, frame)
        axes.set_title(f"{self.name}  {self.time[frame]:.2f} s".strip(), fontsize=8)

    def _ground(self, axes: Any) -> None:
        if any(body["kind"] == PLANE and body["shape"][2] > 0.99 for body in self.bodies):
            left, right, *_ = self.bounds
            offset = next(b["shape"][3] for b in self.bodies if b["kind"] == PLANE and b["shape"][2] > 0.99)
            level = float(np.array([0.0, 0.0, offset]) @ self.top)
            axes.plot([left, right], [level, level], color="0.6", lw=0.8, zorder=1)

    def _joints(self, axes: Any, frame: int) -> None:
        for joint in self.film.header["joints"]:
            i = joint["body"]
            place = self.x[frame, i] + rotation(self.q[frame, i]) @ np.array(joint["anchor"])
            axes.plot(*self.project(np.stack([self.x[frame, i], place])).T, color="k", lw=0.6, zorder=4)
            axes.plot(*self.project(place), "k.", markersize=3, zorder=4)


def _strip(stages: list[Stage], path: Path, count: int, size: float) -> None:
    from matplotlib.figure import Figure

    height = size * sum(stage.height for stage in stages) + 0.3 * len(stages)
    columns = min(count, max(len(stage.time) for stage in stages))
    canvas = Figure(figsize=(size * columns, height), layout="constrained")
    rows = canvas.subplots(len(stages), columns, squeeze=False)
    for stage, row in zip(stages, rows, strict=True):
        chosen = np.linspace(0, len(stage.time) - 1, columns).round().astype(int)
        for axes, frame in zip(row, chosen, strict=True):
            stage.paint(axes, int(frame))
    write_figure(canvas, path, dpi=150)


def _animate(stages: list[Stage], path: Path, size: float, rate: float) -> None:
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.figure import Figure

    suffix = path.suffix.lower()
    first, last = min(stage.time[0] for stage in stages), max(stage.time[-1] for stage in stages)
    if suffix == ".gif":
        rate = 100.0 / max(2, round(100.0 / rate))  # a frame of a GIF stands for whole hundredths of a second
    # evenly in simulated time: a film of fewer steps shows one for longer
    wanted = np.arange(first, last + 0.5 / rate, 1.0 / rate)
    chosen = np.stack(
        [np.searchsorted(s.time, wanted - 1e-9).clip(0, len(s.time) - 1) for s in stages], axis=1
    )
    height = size * max(stage.height for stage in stages) + 0.3
    canvas = Figure(figsize=(size * len(stages), height), layout="constrained")
    row = canvas.subplots(1, len(stages), squeeze=False)[0]
    # a shade slower: the milliseconds of a frame, rounded down, are those meant
    kind, own = (PillowWriter, rate * (1.0 - 1e-9)) if suffix == ".gif" else (FFMpegWriter, rate)
    writer: Any = kind(fps=own)  # type: ignore[arg-type]

    def write(part: Path) -> None:
        made = Path(f"{part}{suffix}")  # whose suffix tells the format
        before = np.full(len(stages), -1)
        try:
            with writer.saving(canvas, str(made), dpi=DPI):
                for frames in chosen:
                    for stage, axes, frame, shown in zip(stages, row, frames, before, strict=True):
                        if frame != shown:
                            stage.paint(axes, int(frame))
                    before = frames
                    writer.grab_frame()
            made.replace(part)
        finally:
            made.unlink(missing_ok=True)

    write_atomically(path, write)
