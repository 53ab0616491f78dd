"""Pictures of a film with matplotlib: a strip of frames or an animation, for documents.

The view is orthographic, rotated by `turn` [rad] about the vertical and tilted by `tilt` [rad] from above. With r, a
and t the directions to the right, away from the viewer and upwards in the picture, a point p is drawn at (p.r, p.t).
Faces are painted from far to near.
"""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_float, check_int
from lavender.base.errors import InputError, require_packages
from lavender.io.stored import as_path, write_atomically, write_figure
from lavender.sim.engine.film import Film
from lavender.sim.scene.parts import convert_to_rotation_matrix
from lavender_ext.engine.arrays import BOX, PLANE, SPHERE

PICTURES = (".gif", ".mp4", ".png", ".svg", ".pdf")
ANIMATION_DPI = 160  # Dots per inch of an animation: 480 pixels at the default width.

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
# Corners of the faces -x, +x, -y, +y, -z, +z.
FACES = (
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
)
LIGHT = np.array([-0.45, -0.62, 0.64])
COLORS = ("#7a5fb5", "#4f7cac", "#5b9279", "#b5895f", "#a85f7a", "#6b8fb5", "#8a7fb0")


def get_picture_suffix(path: str | PathLike[str]) -> str:
    """Return the suffix of a picture file in lower case; raise InputError if the format cannot be written."""
    suffix = as_path(path).suffix
    if suffix.lower() not in PICTURES:
        raise InputError(f"{str(path)!r} ends in {suffix!r}; .gif, .mp4, .png, .svg or .pdf is needed")
    if suffix.lower() == ".mp4" and which("ffmpeg") is None:
        raise InputError("an .mp4 needs ffmpeg, which is not installed; give a .gif")
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
    """Write a film, or several films by name, as an animation or as a strip of frames.

    Parameters
    ----------
    film : Film or mapping of str to Film
        Several films are drawn side by side in an animation, and one below the other in a strip.
    path : path
        `.gif` or `.mp4` (needs ffmpeg): an animation in the time of the film. `.png`, `.svg` or `.pdf`: a strip.
    frames : int
        Evenly spaced frames of a strip.
    turn, tilt : float, rad
        Direction of view.
    size : float, inch
        Width of one frame.
    rate : float, 1/s
        Frames per second of an animation. A GIF uses the nearest rate with a whole number of hundredths of a second.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        The film has no frames, a value is out of range, or the file cannot be written.
    """
    path, suffix = as_path(path), get_picture_suffix(path)
    films = film if isinstance(film, Mapping) else {"": film}
    if not films or not all(len(one) for one in films.values()):
        raise InputError("the film has no frames; at least one is needed: step the simulation before writing")
    frames, rate = check_int("frames", frames, 1), check_float("rate [1/s]", rate, above=0.0)
    size = check_float("size [inch]", size, low=0.5, high=50.0)
    turn, tilt = check_float("turn [rad]", turn), check_float("tilt [rad]", tilt)
    views = [FilmView(one, turn, tilt, name) for name, one in films.items()]
    bounds = np.array([view.bounds for view in views])
    for view in views:  # Draw all films to one scale.
        view.bounds = tuple(np.where([1, 0, 1, 0], bounds.min(axis=0), bounds.max(axis=0)))
    if suffix in (".gif", ".mp4"):
        _write_animation(views, path, size, rate)
    else:
        _write_strip(views, path, frames, size)
    return path


class FilmView:
    """View of a film: directions and bounds, which are the same for all frames, and drawing of a frame."""

    def __init__(self, film: Film, turn: float, tilt: float, name: str = "") -> None:
        self.name = name
        s, c, up, flat = np.sin(turn), np.cos(turn), np.sin(tilt), np.cos(tilt)
        self.right = np.array([c, s, 0.0])
        self.away = np.array([-s * flat, c * flat, -up])
        self.top = np.array([-s * up, c * up, flat])
        self.film, self.bodies = film, film.header["bodies"]
        self.x, self.q, self.time = film.positions, film.quaternions, film.time
        visible = [i for i, body in enumerate(self.bodies) if body["kind"] >= SPHERE]
        radius = np.array([np.linalg.norm(self.bodies[i]["shape"][:3]) for i in visible])
        centre = self.x[:, visible] if visible else np.zeros((1, 1, 3))
        radius = radius if visible else np.ones(1)
        across, tall = centre @ self.right, centre @ self.top
        self.bounds: tuple[float, ...] = (
            float((across - radius).min()),
            float((across + radius).max()),
            float((tall - radius).min()),
            float((tall + radius).max()),
        )

    @property
    def height(self) -> float:
        """Height divided by width, limited to 0.3 to 2.5 for a page."""
        left, right, low, high = self.bounds
        return float(np.clip((high - low) / (right - left), 0.3, 2.5))

    def project(self, points: FloatArray) -> FloatArray:
        """Return the picture coordinates (..., 2) [m] of world points (..., 3) [m]."""
        return np.stack([points @ self.right, points @ self.top], axis=-1)

    def paint(self, axes: Any, frame: int) -> None:
        """Draw frame number `frame` on `axes`."""
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
                r = convert_to_rotation_matrix(q)
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
        self._draw_ground(axes)
        self._draw_joints(axes, frame)
        axes.set_title(f"{self.name}  {self.time[frame]:.2f} s".strip(), fontsize=8)

    def _draw_ground(self, axes: Any) -> None:
        """Draw the ground as a line if the scene has a horizontal plane."""
        if any(body["kind"] == PLANE and body["shape"][2] > 0.99 for body in self.bodies):
            left, right, *_ = self.bounds
            offset = next(b["shape"][3] for b in self.bodies if b["kind"] == PLANE and b["shape"][2] > 0.99)
            level = float(np.array([0.0, 0.0, offset]) @ self.top)
            axes.plot([left, right], [level, level], color="0.6", lw=0.8, zorder=1)

    def _draw_joints(self, axes: Any, frame: int) -> None:
        """Draw a line from the body to the anchor of each joint."""
        for joint in self.film.header["joints"]:
            i = joint["body"]
            anchor = self.x[frame, i] + convert_to_rotation_matrix(self.q[frame, i]) @ np.array(
                joint["anchor"]
            )
            axes.plot(*self.project(np.stack([self.x[frame, i], anchor])).T, color="k", lw=0.6, zorder=4)
            axes.plot(*self.project(anchor), "k.", markersize=3, zorder=4)


def _write_strip(views: list[FilmView], path: Path, count: int, size: float) -> None:
    """Write a strip of `count` frames per film."""
    require_packages("a picture", "matplotlib")
    from matplotlib.figure import Figure

    height = size * sum(view.height for view in views) + 0.3 * len(views)
    columns = min(count, max(len(view.time) for view in views))
    canvas = Figure(figsize=(size * columns, height), layout="constrained")
    rows = canvas.subplots(len(views), columns, squeeze=False)
    for view, row in zip(views, rows, strict=True):
        chosen = np.linspace(0, len(view.time) - 1, columns).round().astype(int)
        for axes, frame in zip(row, chosen, strict=True):
            view.paint(axes, int(frame))
    write_figure(canvas, path, dpi=150)


def _write_animation(views: list[FilmView], path: Path, size: float, rate: float) -> None:
    """Write an animation with `rate` [1/s] frames per second of simulated time."""
    require_packages("a film", "matplotlib")
    from matplotlib.animation import FFMpegWriter, PillowWriter
    from matplotlib.figure import Figure

    suffix = path.suffix.lower()
    first, last = min(view.time[0] for view in views), max(view.time[-1] for view in views)
    if suffix == ".gif":
        # GIF stores the duration of a frame in hundredths of a second.
        rate = 100.0 / max(2, round(100.0 / rate))
    # Frames are evenly spaced in simulated time: a frame of a film with fewer steps is shown for longer.
    times = np.arange(first, last + 0.5 / rate, 1.0 / rate)
    chosen = np.stack([np.searchsorted(s.time, times - 1e-9).clip(0, len(s.time) - 1) for s in views], axis=1)
    height = size * max(view.height for view in views) + 0.3
    canvas = Figure(figsize=(size * len(views), height), layout="constrained")
    row = canvas.subplots(1, len(views), squeeze=False)[0]
    # The rate of a GIF is slightly reduced: Pillow rounds the milliseconds of a frame down.
    kind, frame_rate = (PillowWriter, rate * (1.0 - 1e-9)) if suffix == ".gif" else (FFMpegWriter, rate)
    writer: Any = kind(fps=frame_rate)  # type: ignore[arg-type]

    def write(part: Path) -> None:
        temporary = Path(f"{part}{suffix}")  # The writer selects the format by the suffix.
        before = np.full(len(views), -1)
        try:
            with writer.saving(canvas, str(temporary), dpi=ANIMATION_DPI):
                for frames in chosen:
                    for view, axes, frame, previous_frame in zip(views, row, frames, before, strict=True):
                        if frame != previous_frame:
                            view.paint(axes, int(frame))
                    before = frames
                    writer.grab_frame()
            temporary.replace(part)
        finally:
            temporary.unlink(missing_ok=True)

    write_atomically(path, write)
