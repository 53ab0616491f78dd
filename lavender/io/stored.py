"""What a file of any format holds, and how files are written."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

from lavender._arrays import FloatArray
from lavender.errors import InputError
from lavender.problem import Problem

__all__ = ["MAX_BYTES", "Stored"]

MAX_BYTES = 2**31  # declared size of all arrays of a file; a megabyte can declare a terabyte


@dataclass(frozen=True)
class Stored:
    """A problem as a file gives it, with the solution and guesses that came with it."""

    problem: Problem
    format: str  # "lavender", "box", "generated", "fclib_local" or "fclib_global"
    impulse: FloatArray | None = None  # (m,) N s, the stored solution
    slack: FloatArray | None = None  # (m,) m/s, of that solution, as stored
    compare: str = ""  # what is unique, where the file says: "l,w", "r,u", "w", "u", "error", "no solution"
    guesses: tuple[FloatArray, ...] = ()  # (m,) N s each
    info: Mapping[str, str] = field(default_factory=dict)  # title, description, ... as text

    def __post_init__(self) -> None:
        object.__setattr__(self, "info", MappingProxyType(dict(self.info)))


def write_atomically(path: str | os.PathLike[str], write: Callable[[Path], None]) -> None:
    """Call `write` with a path beside `path`, then rename: readers see the old file or the new one.

    Raises
    ------
    InputError
        The folder does not exist or cannot be written, the path is a folder, the disk is full.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        if target.is_dir():
            raise IsADirectoryError("it is a folder")
        write(temporary)
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"cannot write {target}: {reason}; give a path that can be written") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def first_bytes(path: str | os.PathLike[str], count: int = 8) -> bytes:
    """The first bytes of a file.

    Raises
    ------
    InputError
        The file does not exist or cannot be read.
    """
    try:
        stream: BinaryIO
        with open(path, "rb") as stream:
            return stream.read(count)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from None
