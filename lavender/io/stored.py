"""What a file of any format holds, and how files are written."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from threading import get_native_id
from types import MappingProxyType
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, check_bool, check_int
from lavender.base.errors import InputError
from lavender.problem import Problem

HDF5 = (".hdf5", ".h5", ".hdf")
SUFFIXES = (".npz", *HDF5)  # of problem files
ENGINE = "engine.jsonl"  # beside recorded problems: what the engine itself said of each

MAX_BYTES = 2**31  # of what a file makes in memory; a megabyte can declare a terabyte
PART_OF_NAME = 40  # characters, at most four bytes each, of the 255 that a name may have
FOLDER_LOCK = (
    ".lavender.lock"  # The lock file of an output folder; that of an output file is FILE.lock beside it.
)
# An output is written without a lock if its file system answers with one of these errors: it has no locks.
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
LOCK_TIMEOUT = (
    0.2  # s until an output counts as held: long enough for a second try if its holder ends meanwhile.
)
NUMBER = 8  # bytes of a number once it is read: float64, or an index before it is checked
PART = re.compile(r"\..*\.(\d+)\.\d+\.part(\.\w+)?")  # names of files that are not whole yet
FORGOTTEN = 86400.0  # s, after which a part is of a writer that was killed: none takes that long


@dataclass(frozen=True, eq=False)
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

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Stored, **vars(self) | {"info": dict(self.info)}), ()


@contextlib.contextmanager
def folder_for_steps(
    path: str | os.PathLike[str], replace: bool = False, continued: bool = False
) -> Iterator[Path]:
    """A folder, made where it is not, that holds no problem file: steps of two recordings are no sequence.

    `replace` takes the problem files out that it holds; those of a recording that is `continued` stay. What an engine
    said of others goes in either case. Another recording into it is refused meanwhile.
    """
    replace = check_bool("replace", replace)
    with lock_output(path, folder=True) as folder:
        try:
            old = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file()]
            if old and not replace and not continued:
                raise InputError(
                    f"{folder} holds {len(old)} problem files, and steps of two recordings would be read as one "
                    "sequence: give another folder, or have them replaced (replace=True, --replace)"
                )
            for file in () if continued else (*old, folder / ENGINE):
                file.unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"cannot clear the folder {str(folder)!r}: {error.strerror}") from None
        yield folder


@contextlib.contextmanager
def lock_output(path: str | os.PathLike[str], folder: bool = False) -> Iterator[Path]:
    """Hold the lock of an output, a file or a folder, until the block ends, and return its path.

    The lock is the operating system's: a process that dies holds nothing. A folder is made if it is not there, and
    removed at the end if it is still empty then.

    Raises
    ------
    InputError
        Another command or another thread holds the lock, or the output cannot be written.
    """
    from filelock import FileLock, Timeout  # takes 30 ms, which commands that write nothing need not pay

    path = writable(path, folder)
    place = _behind_links(path) if folder else destination(path)  # one lock for all names of an output
    is_new = folder and not place.exists()
    if folder:
        make_folder(place)
    lock = FileLock(place / FOLDER_LOCK if folder else f"{place}.lock", thread_local=False)
    try:
        lock.acquire(timeout=LOCK_TIMEOUT)
    except Timeout:
        raise InputError(
            f"{path} is being written by another command: wait for it, or give another {'folder' if folder else 'file'}"
        ) from None
    except NotImplementedError:
        pass
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise InputError(
                f"cannot write {path} ({lock.lock_file}: {error.strerror or error}): give a path that you may write to"
            ) from None
    try:
        yield path
    finally:
        if lock.is_locked:
            with contextlib.suppress(OSError):  # an open file cannot be removed on Windows
                os.unlink(
                    lock.lock_file
                )  # before its lock goes: FileLock rejects a file that has lost its name
            lock.release()
        if is_new:
            with contextlib.suppress(OSError):
                place.rmdir()


def _behind_links(path: Path) -> Path:
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError) as error:
        what = "the working directory is gone" if isinstance(error, FileNotFoundError) else error
        raise InputError(f"cannot write {path}: {what}; give a path that can be written") from None


def destination(path: str | os.PathLike[str]) -> Path:
    """Where a file of that path is written: behind its symbolic links, a regular file or a new one.

    InputError for a folder, a pipe, a socket or a device, which is never replaced, and for links without end.
    """
    path = as_path(path)
    target = _behind_links(path)
    try:
        found = os.stat(path)
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError):
            return target
        what = getattr(error, "strerror", None) or error
        raise InputError(f"cannot write {path}: {what}; give a path that can be written") from None
    if not stat.S_ISREG(found.st_mode):
        what = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe, a socket or a device"
    elif target.exists() and os.path.samestat(found, target.stat()):
        return target
    else:
        what = "a file that has lost its name"  # of an open descriptor
    raise InputError(f"cannot write {path}: it is {what}, which is not replaced; give the name of a file")


def writable(path: str | os.PathLike[str], folder: bool = False) -> Path:
    """`path`, refused before the work where its file could not be written after it; a `folder` may have to be made.

    Nothing is opened or made: another process may be writing there.
    """
    path = as_path(path)
    place = _behind_links(path) if folder else destination(path).parent
    try:
        while folder and place != place.parent and not place.exists():
            place = place.parent
        mode = place.stat().st_mode
    except OSError as error:
        raise InputError(f"cannot write {path}: {_why(error, place)}") from None
    if not stat.S_ISDIR(mode):
        raise InputError(f"cannot write {path}: {place} is no folder; give a path in one")
    own = [path] if not folder and path.exists() else []
    if not all(os.access(x, os.W_OK) for x in (place, *own)):
        raise InputError(f"cannot write {path}: you may not write there; give a path that you may write to")
    return path


def make_folder(path: str | os.PathLike[str]) -> Path:
    """The folder of that path, made with those above it where it is not there; InputError where it cannot be."""
    folder = as_path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot make the folder {folder}: {error.strerror or error}; give another path"
        ) from None
    return folder


def _why(error: OSError, place: Path) -> str:
    """What keeps a file from being written, and what to do."""
    if isinstance(error, FileNotFoundError) and not place.is_dir():
        return f"the folder {place} is not there; make it first"
    room = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return f"{error.strerror or error}; {'make room' if room else 'give a path that can be written'}"


def write_atomically(path: str | os.PathLike[str], write: Callable[[Path], Any]) -> None:
    """Call `write` with a path beside `path`, then rename: readers see the old file or the new one.

    Symbolic links are followed: the file behind them is replaced, they stay. Who may read a file stays, too.
    """
    target = destination(path)
    short = target.name[:PART_OF_NAME]  # the whole could leave no room for the rest
    temporary = target.with_name(f".{short}.{os.getpid()}.{get_native_id()}.part")
    _clear(target.parent)
    try:
        write(temporary)
        with contextlib.suppress(OSError):  # of no file yet, or where modes mean nothing
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {_why(error, target.parent)}") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@lru_cache
def _clear(folder: Path) -> None:
    """Remove what writers that were killed have left in a folder; once in a process, since folders can be large."""
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            part = PART.fullmatch(entry.name)
            if part and time.time() - entry.stat().st_mtime > FORGOTTEN and not _runs(int(part[1])):
                os.unlink(entry)


def _runs(process: int) -> bool:
    """A process of this machine: a clock that was set makes its part look old. Windows keeps what is open by itself."""
    if os.name != "posix":
        return False
    try:
        os.kill(process, 0)
        return True
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """`write_atomically` of bytes."""
    write_atomically(path, lambda part: part.write_bytes(data))


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """`write_atomically` of a text."""
    write_bytes(path, text.encode())


def kept(path: Path, is_current: Callable[[bytes], bool], make: Callable[[], bytes]) -> bytes:
    """What a file holds where that is current; else what is made now, and kept there if that place may be written."""
    if path.exists() and is_current(found := path.read_bytes()):
        return found
    made = make()
    with contextlib.suppress(OSError, InputError):
        write_bytes(path, made)
    return made


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> None:
    """`write_atomically` of an archive of arrays (.npz)."""

    def write_to(temporary: Path) -> None:
        with open(temporary, "xb") as stream:
            np.savez_compressed(stream, **arrays)  # NumPy before 2.1 would keep allow_pickle as an entry

    write_atomically(path, write_to)


def check_figure(path: str | os.PathLike[str]) -> Path:
    """The file of a figure, .png without a suffix; InputError for a format that matplotlib does not write."""
    path = as_path(path)
    path = path if path.suffix else path.with_name(path.name + ".png")
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        formats = ", ".join(sorted(known))
        raise InputError(f"cannot write the figure {str(path)!r}: its suffix must be of {formats}")
    return path


def write_figure(canvas: Any, path: str | os.PathLike[str], **how: Any) -> None:
    """`write_atomically` of a figure of matplotlib, whose format the suffix says; png without one."""
    path = check_figure(path)
    from matplotlib import rc_context

    try:
        with rc_context({"pdf.fonttype": 42}):  # TrueType: publishers refuse Type 3
            write_atomically(path, lambda part: canvas.savefig(part, format=path.suffix[1:].lower(), **how))
    except (ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot write the figure {str(path)!r}: {error}") from None


def as_path(path: str | os.PathLike[str]) -> Path:
    """A path; numbers, which the operating system takes for open files, are refused."""
    if not isinstance(path, (str, os.PathLike)) or not isinstance(os.fspath(path), str):
        raise InputError(f"path is {path!r} ({type(path).__name__}); the path of a file as text is needed")
    if "\0" in os.fspath(path):
        raise InputError(f"path {path!r} holds a NUL character; no file has such a name")
    return Path(path)


def first_bytes(path: str | os.PathLike[str], count: int = 8, what: str = "") -> bytes:
    """The first bytes of a regular file, all of them with `count` -1; reading a pipe would wait."""
    path = as_path(path)
    named = f"{what} {str(path)!r}" if what else path
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode):
            kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a pipe, a socket or a device"
            raise InputError(f"cannot read {named}: it is no file but {kind}; a file is needed")
        if count < 0 and found.st_size > MAX_BYTES:
            raise InputError(f"cannot read {named}: it holds {found.st_size} bytes, more than {MAX_BYTES}")
        with open(path, "rb") as stream:
            return stream.read(count)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot read {named}: {getattr(error, 'strerror', None) or error}") from None


def whole_file(path: str | os.PathLike[str], what: str) -> bytes:
    """All bytes of a regular file of at most 2 GiB."""
    return first_bytes(path, -1, what)


def framed(magic: bytes, header: Mapping[str, Any]) -> bytes:
    """The beginning of a file: a magic word, the length of a JSON header (8 bytes, little-endian), the header."""
    head = json.dumps(header).encode()
    return magic + len(head).to_bytes(8, "little") + head


def unframed(data: bytes, magic: bytes, most: int) -> tuple[Any, int]:
    """The header of such a file, of at most `most` bytes, and where the rest begins; ValueError where there is none."""
    start = len(magic) + 8
    end = start + int.from_bytes(data[len(magic) : start], "little")
    if not data.startswith(magic) or not start < end <= min(len(data), start + most):
        raise ValueError("header")
    return json.loads(data[start:end]), end


class Budget:
    """Bytes that a file may still make; spent before anything is allocated."""

    def __init__(self, max_bytes: int) -> None:
        self.limit = self.left = check_int("max_bytes", max_bytes, high=None)

    def spend(self, count: int, what: str) -> None:
        """Take `count` bytes off for `what`."""
        self.left -= count
        if self.left < 0:
            raise InputError(
                f"{what} would take {self.limit - self.left} bytes of memory with what comes before, more than "
                f"{self.limit}; pass max_bytes= if the file is meant to be that large"
            )
