"""Films: the poses of a run, frame by frame, in memory and in a file that the page and `lavender view` open.

A file consists of a magic word, the length of a JSON header (8 bytes, little-endian), the header (version, scene, dt,
bodies, joints, fields), and frames of little-endian float32: time [s], the eight solver values, then position (3) [m]
and quaternion (4) of each body.
"""

from __future__ import annotations

import threading
from os import PathLike
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.io.stored import pack_header, read_whole_file, unpack_header, write_bytes
from lavender.sim.engine.layout import HEAD, JOINT
from lavender.sim.engine.state import State
from lavender.sim.scene import Scene

MAGIC = b"LAVENDER-FILM\n"
VERSION = 1
LEAD = 9  # Number of entries of a frame before the poses: the time and eight solver values.
MAX_FILM_BYTES = 2**28  # [bytes] If the frames exceed this size, every second frame is dropped.
MAX_FILM_HEADER_BYTES = 2**26


class Film:
    """Frames of one scene; `add` appends frames while another thread reads.

    Parameters
    ----------
    header : dict
        Scene, dt, bodies and joints, from `make_film_header`.
    """

    def __init__(self, header: dict[str, Any]) -> None:
        self.header = header
        self.stride = 1  # Steps between two frames.
        self.ended = False
        self._width = LEAD + 7 * len(header["bodies"])
        self._frames = np.zeros((64, self._width), np.float32)
        self._count = self._seen = 0
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        with self._lock:
            return vars(self) | {"_frames": self._frames.copy(), "_lock": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=threading.Lock())

    def __len__(self) -> int:
        return self._count

    def add(self, time: float, observation: dict[str, Any]) -> None:
        """Append the observation of a step at `time` [s]; only every `stride`-th call adds a frame."""
        with self._lock:
            self._seen += 1
            if (self._seen - 1) % self.stride:
                return
            if self._count == len(self._frames):
                if 2 * self._frames.nbytes > MAX_FILM_BYTES and self._count > 2:
                    self._count = (self._count + 1) // 2
                    self._frames[: self._count] = self._frames[: 2 * self._count : 2].copy()
                    self.stride *= 2
                    if (self._seen - 1) % self.stride:
                        return
                else:
                    self._frames = np.concatenate([self._frames, np.zeros_like(self._frames)])
            row = self._frames[self._count]
            poses = row[LEAD:].reshape(-1, 7)
            with np.errstate(over="ignore"):
                row[0], row[1:LEAD] = time, observation["solver"]
                poses[:, :3], poses[:, 3:] = observation["positions"], observation["quaternions"]
            # A frame that is not finite is overwritten by the next.
            self._count += bool(np.isfinite(row).all())

    def frames(self, first: int = 0) -> np.ndarray:
        """Return a copy of the frames from number `first` on, (f, 9 + 7 n) float32."""
        with self._lock:
            return self._frames[first : self._count].copy()

    @property
    def time(self) -> FloatArray:
        """Simulated time (f,) [s] of each frame."""
        return self.frames()[:, 0].astype(np.float64)

    @property
    def solver(self) -> FloatArray:
        """Solver values (f, 8) of each frame, rounded to float32."""
        return self.frames()[:, 1:LEAD].astype(np.float64)

    @property
    def positions(self) -> FloatArray:
        """Positions (f, n, 3) [m], rounded to float32."""
        return self._read_poses()[:, :, :3]

    @property
    def quaternions(self) -> FloatArray:
        """Quaternions (f, n, 4) w x y z, rounded to float32."""
        return self._read_poses()[:, :, 3:]

    def _read_poses(self) -> FloatArray:
        poses = self.frames()[:, LEAD:].astype(np.float64)
        return poses.reshape(len(poses), -1, 7)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the film to a file; an existing file is replaced atomically."""
        write_bytes(path, self.to_bytes())

    def to_bytes(self) -> bytes:
        """Return the content of a film file."""
        return pack_header(MAGIC, {"version": VERSION, **self.header}) + self.frames().astype("<f4").tobytes()

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Film:
        """Read a file written by `save`.

        Raises
        ------
        InputError
            The file is damaged or of another version.
        """
        data = read_whole_file(path, "the film")
        try:
            header, end = unpack_header(data, MAGIC, MAX_FILM_HEADER_BYTES)
            if header.pop("version") != VERSION:
                raise ValueError
            _check_film_header(header)
            film = cls(header)
            frames = np.frombuffer(data, "<f4", offset=end).astype(np.float32)
            if len(frames) % film._width or not np.isfinite(frames).all():
                raise ValueError
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            raise InputError(
                f"{str(path)!r} is not a film file of this version of lavender; a file that `lavender run "
                "--film` or Film.save wrote is needed: record it again"
            ) from None
        film._frames = frames.reshape(-1, film._width)
        film._count = film._seen = len(film._frames)
        film.ended = True
        return film


def make_film_header(scene: Scene, state: State) -> dict[str, Any]:
    """Return the constant data that a picture needs in addition to the poses, as plain numbers."""
    a = state.a
    joints = []
    for (body_a, body_b), values in zip(a["joint_bodies"].tolist(), a["joint"].tolist(), strict=True):
        name, body = ("anchor_b", body_b) if body_b >= 0 else ("anchor_a", body_a)
        other = body_a if body_b >= 0 else body_b
        offset = JOINT[name]
        joints.append({"body": body, "other": other, "anchor": values[offset : offset + 3]})
    return {
        "scene": scene.name or "scene",
        "dt": scene.parameters.dt,
        "bodies": [
            {"name": b.name, "kind": int(kind), "shape": shape}
            for b, kind, shape in zip(scene.bodies, a["kind_of_shape"], a["shape"].tolist(), strict=True)
        ],
        "joints": joints,
        "order": int(state.head[HEAD["order"]]),
    }


def _check_film_header(header: dict[str, Any]) -> None:
    """Raise an error if the header lacks data that the page and the pictures read, or has wrong values."""
    n = len(header["bodies"])
    if not isinstance(header["scene"], str) or not 0.0 < float(header["dt"]) < np.inf:
        raise ValueError
    for body in header["bodies"]:
        if not isinstance(body["name"], str) or body["kind"] not in (0, 1, 2, 3):
            raise ValueError
        if (
            np.array(body["shape"], float).shape != (4,)
            or not np.isfinite(np.array(body["shape"], float)).all()
        ):
            raise ValueError
    for joint in header["joints"]:
        anchor = np.array(joint["anchor"], float)
        if not 0 <= int(joint["body"]) < n or anchor.shape != (3,) or not np.isfinite(anchor).all():
            raise ValueError
