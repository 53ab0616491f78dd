"""Read and write problems: `load`, `save`, and `read` for a problem with its stored solution and guesses.

| suffix | format | written |
|---|---|---|
| `.npz` | our own, versioned: everything a `Problem` holds, bit for bit | yes |
| `.npz` | plain box problems: A, b, lo, hi, friction cones | no |
| `.hdf5`, `.h5` | FCLIB, local (W, q, mu) and global (M, H, f, w, mu), 2D, 3D; extra `fclib` | yes |

An error names everything that a format cannot hold. `docs/formats.md` lists every entry. Problems can also be built
from the data of another engine: `from_mujoco`, `from_pinocchio`, `from_drake`; `from_mujoco_many`, `from_efc`,
`from_kamino`, `from_newton_mujoco` and `from_genesis` for many worlds at once. `record` writes the steps of a MuJoCo
simulation to a folder, `Recorder` writes problems from any loop. `step_from_mujoco`, `step_from_genesis`,
`step_from_newton_mujoco`, `step_from_warp` and `step_from_mjx` read everything that determines one step, for
`lavender.compare`; `save_step` and `load_step` store it.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from typing import Any

from lavender.base.arrays import FloatArray, check_sequence
from lavender.base.errors import InputError
from lavender.io import drake, efc, fclib, mujoco
from lavender.io.drake import from_drake
from lavender.io.efc import MujocoScratch, from_efc, from_mujoco_many
from lavender.io.engine_step import Claims, EngineStep
from lavender.io.genesis import from_genesis
from lavender.io.genesis_step import step_from_genesis
from lavender.io.kamino import from_kamino
from lavender.io.mujoco import from_mujoco
from lavender.io.mujoco_step import step_from_mujoco
from lavender.io.newton_mujoco import from_newton_mujoco
from lavender.io.npz import Stored, read_npz, write_npz
from lavender.io.pinocchio import from_pinocchio
from lavender.io.recorder import Recorder, StepVerdict, read_recorded_state
from lavender.io.recording import Recording, record
from lavender.io.step_record import StepRecord, load_step, permute_velocities, save_step
from lavender.io.stored import HDF5, as_path, read_bytes
from lavender.io.velocities import Reconstruction, reconstruct
from lavender.io.warp_step import (
    align_step,
    step_from_mjx,
    step_from_newton_mujoco,
    step_from_warp,
)
from lavender.problem import Problem

__all__ = [
    "Claims",
    "EngineStep",
    "MujocoScratch",
    "Reconstruction",
    "Recorder",
    "Recording",
    "StepRecord",
    "StepVerdict",
    "Stored",
    "align_step",
    "drake",
    "efc",
    "from_drake",
    "from_efc",
    "from_genesis",
    "from_kamino",
    "from_mujoco",
    "from_mujoco_many",
    "from_newton_mujoco",
    "from_pinocchio",
    "load",
    "load_solution",
    "load_step",
    "mujoco",
    "permute_velocities",
    "read",
    "read_recorded_state",
    "reconstruct",
    "record",
    "save",
    "save_step",
    "step_from_genesis",
    "step_from_mjx",
    "step_from_mujoco",
    "step_from_newton_mujoco",
    "step_from_warp",
]
__dir__ = sorted(__all__).copy  # Completion shows public names only.


def read(path: str | os.PathLike[str]) -> Stored:
    """Read everything that a file holds: the problem, its stored solution, guesses, and the quantities to compare.

    The format is determined from the content, not from the suffix.

    Parameters
    ----------
    path : path

    Returns
    -------
    Stored

    Raises
    ------
    InputError
        The file does not exist, is truncated, inconsistent or of another format; or h5py is needed and not installed.
    """
    start = read_bytes(path, count=8)
    if start[:2] == b"PK":
        return read_npz(path)
    if start == b"\x89HDF\r\n\x1a\n":
        return fclib.read(path)
    content = f"starts with {start!r}" if start else "is empty"
    needed = "an .npz archive or an HDF5 file is needed"
    if os.fspath(path).lower().endswith(".xml"):
        needed += " (of a MuJoCo model, `lavender record` writes such files)"
    raise InputError(f"{path} {content}; {needed}")


def load(path: str | os.PathLike[str]) -> Problem:
    """Return the problem in a file; see `read`."""
    return read(path).problem


def load_solution(path: str | os.PathLike[str]) -> FloatArray | None:
    """Return the solution (m,) [N s] stored with a problem, or None; see `read`."""
    return read(path).impulse


def save(
    problem: Problem,
    path: str | os.PathLike[str],
    *,
    impulse: Any = None,
    gap: Any = None,
    drop: Collection[str] = (),
) -> None:
    """Write a problem; the suffix selects the format. An existing file is replaced atomically.

    Parameters
    ----------
    problem : Problem
    path : path
        `.npz` (our own format), or `.hdf5`, `.h5` (FCLIB's local form, for which A is formed).
    impulse : (m,) N s, optional
        Stored with the problem as its solution.
    gap : (k,) m, optional
        `.npz` only: distance of the surfaces of each contact, nan of other blocks, for `lavender judge`.
    drop : names, optional
        FCLIB only: parts of the problem to leave out, of "names" (of blocks and velocities), "key" and "precision"
        (float32). FCLIB cannot hold them: a problem that has one of them is rejected unless `drop` names it.

    Raises
    ------
    InputError
        An unknown suffix, or a path that cannot be written.
    CapabilityError
        The format cannot hold something of this problem; the message names it.
    """
    path = as_path(path)
    drop = check_sequence("drop", drop, "names")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        if drop:
            raise InputError(
                "drop= has no effect on an .npz file, which holds everything: leave it out"
            )
        write_npz(problem, path, impulse=impulse, gap=gap)
    elif suffix in HDF5:
        if gap is not None:
            raise InputError(f"gap is given and {path} is FCLIB's; .npz is needed for it")
        fclib.write(problem, path, impulse=impulse, drop=drop)
    else:
        raise InputError(
            f"{path} ends with {suffix!r}; .npz or .hdf5 is needed, which selects the format"
        )
