"""Problems in files: `load`, `save`, and `read` for the solution and guesses that come with a problem.

| suffix | format | written |
|---|---|---|
| `.npz` | our own, versioned: everything a `Problem` holds, bit for bit | yes |
| `.npz` | plain box problems: A, b, lo, hi, friction cones | no |
| `.hdf5`, `.h5` | FCLIB, local (W, q, mu) and global (M, H, f, w, mu), 2D, 3D; extra `fclib` | yes |

What a format cannot hold is refused by name. `docs/formats.md` lists every entry. Not from a file but from another
engine's memory: `from_mujoco`, `from_pinocchio`, `from_drake`, many worlds at once by `from_mujoco_many` and
`from_efc`, and `record` for a folder of steps.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from typing import Any

from lavender.base.arrays import FloatArray, check_sequence
from lavender.base.errors import InputError
from lavender.io import drake, efc, fclib, mujoco, npz
from lavender.io.drake import from_drake
from lavender.io.efc import from_efc, from_mujoco_many
from lavender.io.mujoco import from_mujoco
from lavender.io.pinocchio import from_pinocchio
from lavender.io.recording import Recording, record
from lavender.io.stored import HDF5, MAX_BYTES, Stored, as_path, first_bytes
from lavender.problem import Problem

__all__ = [
    "Recording",
    "Stored",
    "drake",
    "efc",
    "from_drake",
    "from_efc",
    "from_mujoco",
    "from_mujoco_many",
    "from_pinocchio",
    "load",
    "load_solution",
    "mujoco",
    "read",
    "record",
    "save",
]


def read(path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> Stored:
    """Everything a file holds: the problem, its stored solution, guesses, and what may be compared.

    The format is told by the content, not by the suffix.

    Parameters
    ----------
    path : path
    max_bytes : int, default 2^31
        Refuse files that would make more than this many bytes of arrays, before any is made. What counts is
        the size in memory, with numbers as float64 and a global FCLIB problem condensed; while an entry is
        converted, it is there twice.

    Raises
    ------
    InputError
        Not there, truncated, of another format, inconsistent; or HDF5 without h5py.
    """
    start = first_bytes(path)
    if start[:2] == b"PK":
        return npz.read(path, max_bytes=max_bytes)
    if start == b"\x89HDF\r\n\x1a\n":
        return fclib.read(path, max_bytes=max_bytes)
    what = f"starts with {start!r}" if start else "is empty"
    needed = "an .npz archive or an HDF5 file is needed"
    if os.fspath(path).lower().endswith(".xml"):
        needed += " (of a MuJoCo model, `lavender record` writes such files)"
    raise InputError(f"{path} {what}; {needed}")


def load(path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> Problem:
    """The problem in a file; see `read`."""
    return read(path, max_bytes=max_bytes).problem


def load_solution(path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> FloatArray | None:
    """The solution stored beside a problem (m,) [N s], or None; see `read`."""
    return read(path, max_bytes=max_bytes).impulse


def save(
    problem: Problem,
    path: str | os.PathLike[str],
    *,
    impulse: Any = None,
    form: str | None = None,
    drop: Collection[str] = (),
) -> None:
    """Write a problem; the suffix chooses the format. An existing file is replaced at once or not at all.

    Parameters
    ----------
    problem : Problem
    path : path
        `.npz` (our own format) or `.hdf5`, `.h5` (FCLIB).
    impulse : (m,) N s, optional
        Stored beside the problem as its solution.
    form : {"local", "global"}, optional
        FCLIB only: W and q, or M, H, f and w (problems with rows). Default: what the problem has.
    drop : names, optional
        FCLIB only: "names" (of blocks and velocities), "key" and "precision" (float32) may be left out; otherwise a
        problem that has them is refused.

    Raises
    ------
    InputError
        An unknown suffix, or a path that cannot be written.
    CapabilityError
        The format cannot hold something of this problem; the message names it.
    """
    path, drop = as_path(path), check_sequence("drop", drop, "names")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        if form is not None or drop:
            raise InputError("form= and drop= are for FCLIB files (.hdf5); an .npz holds everything")
        npz.write(problem, path, impulse=impulse)
    elif suffix in HDF5:
        fclib.write(problem, path, impulse=impulse, form=form, drop=drop)
    else:
        raise InputError(f"{path} ends with {suffix!r}; .npz or .hdf5 says which format is meant")
