"""References beside problem files: `pile.npz.reference` holds the solution of `pile.npz`, judged when it is read."""

from __future__ import annotations

import zipfile
from os import PathLike
from pathlib import Path

import numpy as np

from lavender.errors import InputError
from lavender.motion.reference import Reference, judged, kept, reference
from lavender.problem import Problem

__all__ = ["SUFFIX", "load_reference", "save_reference"]

SUFFIX = ".reference"


def _beside(path: str | PathLike[str]) -> Path:
    path = Path(path)
    return path.with_name(path.name + SUFFIX)


def save_reference(problem: Problem, path: str | PathLike[str]) -> Path:
    """Solve for a problem's reference, unless it is kept, and write it beside the problem's file.

    Parameters
    ----------
    problem : Problem
    path : path
        Of the problem's file; ".reference" is added to its name.

    Returns
    -------
    Path
        Of what was written.

    Raises
    ------
    InputError
        The file cannot be written, or nothing solved the problem: then there is nothing to keep.
    """
    found = reference(problem.disk)
    if not found.accepted:
        raise InputError(f"{path}: nothing reached the floor ({found}); there is no reference to write")
    out = _beside(path)
    try:
        with open(out, "wb") as stream:
            np.savez(stream, impulse=found.impulse, solver=np.array(found.solver))
    except OSError as error:
        raise InputError(f"cannot write {str(out)!r}: {error.strerror}") from None
    return out


def load_reference(problem: Problem, path: str | PathLike[str]) -> Reference | None:
    """Keep the reference beside a problem's file, if there is one and it solves this problem by the judge.

    Parameters
    ----------
    problem : Problem
    path : path
        Of the problem's file.

    Returns
    -------
    Reference or None
        None without a file, and where what it holds solves another problem: then the reference is solved for anew.

    Raises
    ------
    InputError
        A file of that name that holds no reference.
    """
    place, problem = _beside(path), problem.disk
    if not place.is_file():
        return None
    try:
        with np.load(place, allow_pickle=False) as data:
            impulse, solver = np.asarray(data["impulse"], float), str(data["solver"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
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
