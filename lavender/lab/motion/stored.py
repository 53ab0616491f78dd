"""References beside problem files: `pile.npz.reference` holds the solution of `pile.npz`, judged when it is read."""

from __future__ import annotations

from contextlib import closing
from io import BytesIO
from os import PathLike
from pathlib import Path

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.io import npz
from lavender.io.stored import writable, write_bytes
from lavender.lab.motion.reference import Reference, judged, kept, reference
from lavender.problem import Problem

SUFFIX = ".reference"


def _beside(path: str | PathLike[str]) -> Path:
    path = Path(path)
    return path.with_name(path.name + SUFFIX)


def save_reference(
    problem: Problem, path: str | PathLike[str], impulse: FloatArray | None = None, source: str = "given"
) -> Path:
    """Write a problem's reference beside its file `path`: an impulse (m,) [N s] and who says so, else the one kept.

    If none is kept, it is solved for. InputError where nothing solved the problem: then there is nothing to keep.
    """
    out = writable(_beside(path))
    if impulse is not None:
        kept(problem.disk).reference = judged(problem.disk, impulse, source)
    found = reference(problem.disk)
    if not found.accepted:
        raise InputError(f"{path}: nothing reached the floor ({found}); there is no reference to write")
    buffer = BytesIO()
    np.savez(buffer, impulse=found.impulse, solver=np.array(found.solver))
    write_bytes(out, buffer.getvalue())
    return out


def load_reference(problem: Problem, path: str | PathLike[str]) -> Reference | None:
    """Keep the reference beside a problem's file, if there is one and it solves this problem by the judge.

    None without a file, and where what it holds solves another problem: then the reference is solved for anew.
    """
    place, problem = _beside(path), problem.disk
    if not place.is_file():
        return None
    try:
        with closing(npz.Archive(place)) as data:
            impulse, solver = np.asarray(data["impulse"], float), str(data.scalar("solver"))
    except (InputError, ValueError, TypeError) as error:
        raise InputError(
            f"{str(place)!r} holds no reference ({error}); delete it, or write it again with `lavender reference`"
        ) from None
    if impulse.shape != (problem.m,) or not np.isfinite(impulse).all():
        return None
    found = judged(problem, impulse, solver)
    if not found.accepted:
        return None
    kept(problem).reference = found
    return found
