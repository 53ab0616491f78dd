"""Problem files: their contents, NumPy archives (.npz), and functions that write files and lock outputs.

Three formats of archives are read: our own, the plain box format, and the format of a benchmark generator. Nothing
in an archive is executed or unpickled. The memory for all entries is computed from their headers before the first
entry is read, and the arrays are checked against each other before a kernel uses them. `docs/formats.md` describes
each entry.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import stat
import struct
import time
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from threading import get_native_id
from tokenize import TokenError
from types import MappingProxyType
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from lavender.base.arrays import FloatArray, as_array, check_bool, check_int
from lavender.base.errors import InputError, require_packages
from lavender.base.lazy_import import issparse
from lavender.base.lazy_import import sparse as sp
from lavender.problem import PRECISIONS, Problem, check_problem
from lavender.problem.cones import Cones, get_block_kinds
from lavender.problem.generalized import Generalized
from lavender.problem.program import recover_program
from lavender.problem.rows import Rows

HDF5 = (".hdf5", ".h5", ".hdf")
SUFFIXES = (".npz", *HDF5)  # Suffixes of problem files.
ENGINE = "engine.jsonl"  # File of the engine's own results, in the folder of recorded problems.
STATES_FOLDER = "states"  # Folder of the states before recorded steps, in the folder of recorded problems.

MAX_BYTES = (
    2**31
)  # Default limit of the memory for the arrays of a file; a file of a megabyte can declare a terabyte.
# The name of a temporary file contains this many characters of the final name; names may have 255 bytes, and a
# character up to four.
TEMPORARY_NAME_CHARACTERS = 40
# Name of the lock file of an output folder. The lock of an output file is FILE.lock.
FOLDER_LOCK = ".lavender.lock"
# Errors with which a file system without locks answers; an output on it is written without a lock.
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)
# [s] An output counts as locked if its lock is not obtained in this time, which allows several attempts.
LOCK_TIMEOUT = 0.2
NUMBER_BYTES = 8  # Bytes of a number in memory: float64, or an index before it is checked.
TEMPORARY_NAME = re.compile(r"\..*\.(\d+)\.\d+\.part(\.\w+)?")  # Names of files that are not complete yet.
# [s] Older temporary files are removed: no write takes this long, so their writer was killed.
MAX_TEMPORARY_AGE = 86400.0

FORMAT_VERSION = 1
MAX_NPY_HEADER_BYTES = 10_000  # [bytes] A longer .npy header is rejected; 100 bytes are usual.
MAX_ARCHIVE_ENTRIES = 1000  # Largest accepted number of entries in an archive; a problem has up to 30.
# Memory that Python objects need per byte of JSON text, at most; nested empty lists need 24.
JSON_BYTES_PER_BYTE = 40
# Compression methods that NumPy writes. Others are rejected: their memory use depends on parameters in the archive.
ACCEPTED_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
CONES = tuple(f"cones_{f.name}" for f in fields(Cones) if f.name != "rolling")
ROWS = tuple(f"rows_{f.name}" for f in fields(Rows) if f.name != "copy")
GENERALIZED = (
    *(f"general_{name}_{part}" for name in ("jac", "mass") for part in ("data", "indices", "indptr")),
    "general_v_free",
)
CSR = ("A_data", "A_indices", "A_indptr", "A_shape")
OPTIONAL = ("cones_rolling", "guess", "key", "impulse")
#: Exceptions that zipfile and NumPy raise for damaged archives.
READ_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    TokenError,
    EOFError,
    OSError,
    RuntimeError,
    NotImplementedError,
    ValueError,
    SyntaxError,
    TypeError,
    OverflowError,
    MemoryError,
    RecursionError,
)


@dataclass(frozen=True, eq=False)
class Stored:
    """A problem from a file, with the stored solution and guesses.

    Parameters
    ----------
    problem : Problem
    format : str
        "lavender", "box", "generated", "fclib_local" or "fclib_global", the last two also with the suffix "_rolling".
    impulse : (m,) N s, optional
        Stored solution.
    slack : (m,) m/s, optional
        Stored slack of that solution.
    compare : str
        Unique quantities of the solution, if the file names them: "l,w", "r,u", "w", "u", "error", "no solution".
    guesses : tuple of (m,) N s
    info : mapping of str to str
        Texts of the file: title, description, ...
    """

    problem: Problem
    format: str
    impulse: FloatArray | None = None
    slack: FloatArray | None = None
    compare: str = ""
    guesses: tuple[FloatArray, ...] = ()
    info: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "info", MappingProxyType(dict(self.info)))

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Stored, **vars(self) | {"info": dict(self.info)}), ()


@contextlib.contextmanager
def lock_step_folder(
    path: str | os.PathLike[str], replace: bool = False, continued: bool = False
) -> Iterator[Path]:
    """Lock a folder for recorded problems, create it if necessary, and return its path until the block ends.

    The folder must not hold problem files, because the steps of two recordings are not one sequence. `replace` removes
    the problem files and the engine's results. With `continued`, the files belong to the present recording and are
    kept. Another recording to this folder raises an error until the block ends.

    Raises
    ------
    InputError
        The folder holds problem files, is locked, or cannot be cleared or written.
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
            raise InputError(
                f"the files in {str(folder)!r} cannot be removed ({error.strerror}); give another folder, "
                "or permit writing to this one"
            ) from None
        yield folder


@contextlib.contextmanager
def lock_output(path: str | os.PathLike[str], folder: bool = False) -> Iterator[Path]:
    """Hold the lock of an output, a file or a folder, until the block ends, and return its path.

    The operating system releases the lock of a process that dies. A folder is created if it does not exist, and
    removed at the end if it is still empty.

    Raises
    ------
    InputError
        Another command or another thread holds the lock, or the output cannot be written.
    """
    require_packages("an output folder", "filelock")
    from filelock import FileLock, Timeout  # The import takes 30 ms; commands that write nothing skip it.

    path = check_writable(path, folder)
    target = (
        _resolve_symlinks(path) if folder else resolve_destination(path)
    )  # All names of an output share one lock.
    is_new = folder and not target.exists()
    if folder:
        make_folder(target)
    lock = FileLock(target / FOLDER_LOCK if folder else f"{target}.lock", thread_local=False)
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
            # Remove the lock file before releasing the lock; a process that waits for it detects that the file was
            # removed. On Windows, where an open file cannot be removed, the file remains.
            with contextlib.suppress(OSError):
                os.unlink(lock.lock_file)
            lock.release()
        if is_new:
            with contextlib.suppress(OSError):
                target.rmdir()


def _resolve_symlinks(path: Path) -> Path:
    """Return the path without symbolic links; raise InputError if it cannot be resolved."""
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError) as error:
        reason = "the working directory no longer exists" if isinstance(error, FileNotFoundError) else error
        raise InputError(f"cannot write {path}: {reason}; give a path that can be written") from None


def resolve_destination(path: str | os.PathLike[str]) -> Path:
    """Return the path at which a file is written: the target of symbolic links, a regular file or a new one.

    Raises
    ------
    InputError
        The path is a folder, a pipe, a socket or a device, which are never replaced, or its links form a cycle.
    """
    path = as_path(path)
    target = _resolve_symlinks(path)
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        if isinstance(error, FileNotFoundError):
            return target
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"cannot write {path}: {reason}; give a path that can be written") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, a socket or a device"
    elif target.exists() and os.path.samestat(status, target.stat()):
        return target
    else:
        kind = "a file that has lost its name"  # The path names an open file descriptor, as /dev/fd/3.
    raise InputError(f"cannot write {path}: it is {kind}, which is not replaced; give the name of a file")


def check_writable(path: str | os.PathLike[str], folder: bool = False) -> Path:
    """Return `path` if its file (or `folder`, with its parents) can be written later; nothing is opened or created.

    Raises
    ------
    InputError
        The file or folder cannot be written.
    """
    path = as_path(path)
    parent = _resolve_symlinks(path) if folder else resolve_destination(path).parent
    try:
        while folder and parent != parent.parent and not parent.exists():
            parent = parent.parent
        mode = parent.stat().st_mode
    except OSError as error:
        raise InputError(f"cannot write {path}: {_explain_write_failure(error, parent)}") from None
    if not stat.S_ISDIR(mode):
        raise InputError(f"cannot write {path}: {parent} is not a folder; give a path in a folder")
    existing = [path] if not folder and path.exists() else []
    if not all(os.access(x, os.W_OK) for x in (parent, *existing)):
        raise InputError(f"cannot write {path}: you have no permission to write there; give another path")
    return path


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Create a folder and its parents if they do not exist, and return its path; InputError if that fails."""
    folder = as_path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot create the folder {folder}: {error.strerror or error}; give another path"
        ) from None
    return folder


def _explain_write_failure(error: OSError, folder: Path) -> str:
    """Return the reason why a file could not be written, and advice."""
    if isinstance(error, FileNotFoundError) and not folder.is_dir():
        return f"the folder {folder} does not exist; create it first"
    disk_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return (
        f"{error.strerror or error}; {'free disk space' if disk_full else 'give a path that can be written'}"
    )


def write_atomically(path: str | os.PathLike[str], write: Callable[[Path], Any]) -> None:
    """Write a file atomically, so that readers see the old file or the complete new file.

    `write` is called with a temporary path in the folder of the file, which is then renamed. If `path` is a symbolic
    link, the target of the link is replaced. The permissions of an existing file are kept.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    target = resolve_destination(path)
    short = target.name[:TEMPORARY_NAME_CHARACTERS]
    temporary = target.with_name(f".{short}.{os.getpid()}.{get_native_id()}.part")
    _remove_old_temporaries(target.parent)
    try:
        write(temporary)
        # A new file has no permissions to keep, and some file systems have none.
        with contextlib.suppress(OSError):
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {_explain_write_failure(error, target.parent)}") from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


@lru_cache
def _remove_old_temporaries(folder: Path) -> None:
    """Remove temporary files of killed writers from a folder; once per process, since folders can be large."""
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            part = TEMPORARY_NAME.fullmatch(entry.name)
            if (
                part
                and time.time() - entry.stat().st_mtime > MAX_TEMPORARY_AGE
                and not _is_process_running(int(part[1]))
            ):
                os.unlink(entry)


def _is_process_running(process: int) -> bool:
    """Return whether a process of this machine is running, so that its temporary files are not removed.

    A temporary file of a running process may look old if the clock was changed. On Windows, which does not remove open
    files, the result is False.
    """
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
    """Write bytes to a file with `write_atomically`."""
    write_atomically(path, lambda part: part.write_bytes(data))


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text to a file with `write_atomically`, in UTF-8."""
    write_bytes(path, text.encode())


def load_or_make_file(path: Path, is_current: Callable[[bytes], bool], make: Callable[[], bytes]) -> bytes:
    """Return the content of a file if `is_current` accepts it; else return the result of `make` and try to store it."""
    if path.exists() and is_current(content := path.read_bytes()):
        return content
    content = make()
    with contextlib.suppress(OSError, InputError):
        write_bytes(path, content)
    return content


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write an archive of arrays (.npz) with `write_atomically`; their names may equal names of arguments of NumPy."""

    def write_to(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "x", zipfile.ZIP_DEFLATED) as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)

    write_atomically(path, write_to)


def check_figure_path(path: str | os.PathLike[str]) -> Path:
    """Return the path of a figure, with .png if it has no suffix; InputError if matplotlib cannot write the format."""
    path = as_path(path)
    path = path if path.suffix else path.with_name(path.name + ".png")
    from matplotlib.backend_bases import FigureCanvasBase

    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        formats = ", ".join(sorted(known))
        raise InputError(f"cannot write the figure {str(path)!r}: its suffix must be of {formats}")
    return path


def write_figure(canvas: Any, path: str | os.PathLike[str], **options: Any) -> None:
    """Write a figure of matplotlib with `write_atomically`; the suffix selects the format (default: png).

    Raises
    ------
    InputError
        matplotlib cannot write the format, or the file cannot be written.
    """
    path = check_figure_path(path)
    from matplotlib import rc_context

    try:
        with rc_context({"pdf.fonttype": 42}):  # Embed TrueType fonts, since publishers reject Type 3 fonts.
            write_atomically(
                path, lambda part: canvas.savefig(part, format=path.suffix[1:].lower(), **options)
            )
    except (ValueError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot write the figure {str(path)!r}: {error}") from None


def as_path(path: str | os.PathLike[str]) -> Path:
    """Return a Path; raise InputError for numbers, which the operating system would treat as open files."""
    if not isinstance(path, (str, os.PathLike)) or not isinstance(os.fspath(path), str):
        raise InputError(f"path is {path!r} ({type(path).__name__}); the path of a file as text is needed")
    if "\0" in os.fspath(path):
        raise InputError(f"path {path!r} has a NUL character, which no file name may have")
    return Path(path)


def read_first_bytes(path: str | os.PathLike[str], count: int = 8, role: str = "") -> bytes:
    """Return the first `count` bytes of a regular file, or all bytes if `count` is -1.

    Parameters
    ----------
    path : path
    count : int
    role : str
        Name of the file's role for error messages.

    Raises
    ------
    InputError
        The file is not a regular file (reading a pipe would block), is larger than 2 GiB, or cannot be read.
    """
    path = as_path(path)
    named = f"{role} {str(path)!r}" if role else path
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe, a socket or a device"
            raise InputError(f"cannot read {named}: it is {kind}; a regular file is needed")
        if count < 0 and status.st_size > MAX_BYTES:
            raise InputError(f"cannot read {named}: it holds {status.st_size} bytes, more than {MAX_BYTES}")
        with open(path, "rb") as stream:
            return stream.read(count)
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"cannot read {named}: {getattr(error, 'strerror', None) or error}") from None


def read_whole_file(path: str | os.PathLike[str], role: str) -> bytes:
    """Return all bytes of a regular file of up to 2 GiB; it raises the errors of `read_first_bytes`."""
    return read_first_bytes(path, -1, role)


def pack_header(magic: bytes, header: Mapping[str, Any]) -> bytes:
    """Return the beginning of a file: magic word, length of the JSON header (8 bytes, little-endian), header."""
    head = json.dumps(header).encode()
    return magic + len(head).to_bytes(8, "little") + head


def unpack_header(data: bytes, magic: bytes, max_bytes: int) -> tuple[Any, int]:
    """Return the header of a file that `pack_header` began, and the position behind it.

    Raises
    ------
    ValueError
        The file has another magic word, or the header is incomplete or longer than `max_bytes`.
    """
    start = len(magic) + 8
    end = start + int.from_bytes(data[len(magic) : start], "little")
    if not data.startswith(magic) or not start < end <= min(len(data), start + max_bytes):
        raise ValueError("header")
    return json.loads(data[start:end]), end


class Budget:
    """Memory [bytes] that reading a file may still use; it is subtracted before anything is allocated."""

    def __init__(self, max_bytes: int) -> None:
        self.limit = self.remaining = check_int("max_bytes", max_bytes, high=None)

    def reserve_bytes(self, count: int, name: str) -> None:
        """Subtract `count` bytes for the object `name`; raise InputError if the limit is exceeded."""
        self.remaining -= count
        if self.remaining < 0:
            raise InputError(
                f"{name} and the entries before it need {self.limit - self.remaining} bytes of memory, more "
                f"than the limit of {self.limit}; pass max_bytes= if the file is meant to be that large"
            )


# -- NumPy archives ------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Header:
    """Header of a .npy entry, and the stream of its data."""

    stream: IO[bytes]
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran: bool

    @property
    def n_elements(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def read_array(self) -> np.ndarray:
        """Read the array; raise EOFError if the stream is too short or too long."""
        size = self.n_elements * self.dtype.itemsize
        raw = self.stream.read(size)
        if len(raw) != size or self.stream.read(1):
            raise EOFError(f"the entry holds {len(raw)} of {size} bytes: the file is damaged, save it again")
        return np.frombuffer(raw, self.dtype).reshape(self.shape, order="F" if self.fortran else "C")


class Archive(Mapping[str, np.ndarray]):
    """Arrays of an .npz by name; each is read once, at its first access."""

    def __init__(self, path: str | os.PathLike[str], max_bytes: int = MAX_BYTES) -> None:
        self.path = path
        self._arrays: dict[str, np.ndarray] = {}
        self._headers: dict[str, _Header] = {}
        budget = Budget(max_bytes)
        try:
            self._zip = zipfile.ZipFile(path)
        except READ_ERRORS as error:
            raise InputError(f"{path} is not a complete .npz archive ({error}); save it again") from None
        try:
            self._open_entries(budget)
        except BaseException:
            self.close()
            raise

    def _open_entries(self, budget: Budget) -> None:
        """Read the headers of all entries and subtract their sizes in memory from the budget."""
        entries = self._zip.infolist()
        if len(entries) > MAX_ARCHIVE_ENTRIES:
            raise InputError(
                f"{self.path} holds {len(entries)} entries; at most {MAX_ARCHIVE_ENTRIES} are accepted, and "
                "a problem needs far fewer: give the file of one problem"
            )
        for entry in entries:
            name = entry.filename.removesuffix(".npy")
            if name == entry.filename or name in self._headers:
                raise InputError(
                    f"{self.path} holds {entry.filename!r}; an .npz must hold files NAME.npy with different "
                    "names: save it again with lavender.io.save or numpy.savez"
                )
            try:
                if entry.compress_type not in ACCEPTED_COMPRESSION:
                    raise ValueError(
                        f"the entry is compressed by method {entry.compress_type} of zip files; deflate (8) "
                        "or no compression (0) is needed: use numpy.savez"
                    )
                self._headers[name] = _read_npy_header(self._zip.open(entry), entry.file_size)
            except READ_ERRORS as error:
                raise InputError(f"{self.path}: entry {name!r} cannot be read: {error}") from None
        for name, header in self._headers.items():
            width = header.dtype.itemsize
            if header.dtype.kind in "buif":
                width = JSON_BYTES_PER_BYTE if name == "meta" else max(width, NUMBER_BYTES)
            budget.reserve_bytes(header.n_elements * width, f"{self.path}: entry {name!r}")

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._arrays:
            try:
                header = self._headers[name]
            except KeyError:
                has = ", ".join(self._headers) or "nothing"
                raise InputError(f"{self.path} has no entry {name!r}; it has {has}") from None
            try:
                with header.stream:
                    self._arrays[name] = header.read_array()
            except READ_ERRORS as error:
                raise InputError(f"{self.path}: entry {name!r} cannot be read: {error}") from None
        return self._arrays[name]

    def __contains__(self, name: object) -> bool:
        return name in self._headers

    def __iter__(self) -> Any:
        return iter(self._headers)

    def __len__(self) -> int:
        return len(self._headers)

    def close(self) -> None:
        """Close the archive; no entry can be read afterwards."""
        for header in self._headers.values():
            header.stream.close()
        self._zip.close()

    def read_scalar(self, name: str) -> Any:
        """Return the single value of an entry."""
        value = self[name]
        if value.size != 1:
            raise InputError(f"{self.path}: entry {name!r} has shape {value.shape}; one value is needed")
        return value.reshape(()).item()


def _read_npy_header(stream: IO[bytes], size: int) -> _Header:
    """Read the header of an array of numbers or text; `size` [bytes] is the declared size of header and data."""
    if npy.read_magic(stream) != (1, 0):  # Later versions of the .npy format are only for long headers.
        raise ValueError(
            "the entry is not a plain array (.npy, version 1.0), but a record array or other data; a plain "
            "array of numbers is needed"
        )
    shape, fortran, dtype = npy.read_array_header_1_0(stream, max_header_size=MAX_NPY_HEADER_BYTES)
    if dtype.kind not in "buifUS":
        raise ValueError(
            f"the entry has dtype {dtype}; objects are never read from a file, and plain numbers are needed"
        )
    data = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or data + stream.tell() != size:
        raise ValueError(
            f"its shape {shape} needs {data} bytes, but the archive declares {size} bytes with the header: "
            "the file is damaged, save it again"
        )
    return _Header(stream, dtype, shape, fortran)


def read_npz(path: str | os.PathLike[str], *, max_bytes: int = MAX_BYTES) -> Stored:
    """Read a problem from an .npz archive of any layout that `docs/formats.md` lists.

    Raises
    ------
    InputError
        The archive is damaged, of another layout, or larger than `max_bytes` in memory.
    """
    archive = Archive(path, max_bytes)
    try:
        if "lavender_format" in archive:
            return _read_own_format(archive)
        if {"kind", "J_data", "minv"} <= set(archive):
            return _read_generated_format(archive)
        if {"b", "lo", "hi"} <= set(archive):
            return _read_box_format(archive)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(str(path)) else f"{path}: {text}") from None
    finally:
        archive.close()
    has = ", ".join(archive) or "nothing"
    raise InputError(
        f"{path} holds the entries {has}; a problem has lavender_format (written by lavender.io.save), or "
        "b, lo, hi and A"
    )


# -- our own format -------------------------------------------------------------------------------


def write_npz(problem: Problem, path: str | os.PathLike[str], *, impulse: Any = None) -> None:
    """Write a problem in our own format, optionally with an impulse (m,) [N s], for example its solution.

    `read_npz(path).problem == problem`, bit for bit.
    """
    check_problem(problem)
    arrays: dict[str, Any] = {"lavender_format": np.int64(FORMAT_VERSION), "b": problem.b}
    for name in CONES:
        arrays[name] = getattr(problem.cones, name.removeprefix("cones_"))
    if problem.cones.has_rolling:
        arrays["cones_rolling"] = problem.cones.rolling
    if problem.rows is not None:
        for name in ROWS:
            arrays[name] = getattr(problem.rows, name.removeprefix("rows_"))
        arrays["compliance"] = problem.compliance
        operator = "rows"
    elif problem.generalized is not None:
        general = problem.generalized
        for name, x in (("jac", general.jac), ("mass", general.mass)):
            for part in ("data", "indices", "indptr"):
                arrays[f"general_{name}_{part}"] = getattr(x, part)
        arrays["general_v_free"] = general.v_free
        arrays["compliance"] = problem.compliance
        operator = "generalized"
    elif issparse(problem.matrix):
        a = problem.matrix
        arrays |= dict(zip(CSR, (a.data, a.indices, a.indptr, np.array(a.shape, np.int64)), strict=True))
        operator = "csr"
    else:
        arrays["A"] = problem.matrix
        operator = "dense"
    if problem.guess is not None:
        arrays["guess"] = problem.guess
    if problem.key is not None:
        arrays["key"] = problem.key
    if impulse is not None:
        arrays["impulse"] = problem.impulse_array(impulse)
    names = None if problem.names is None else list(problem.names)
    meta: dict[str, Any] = {
        "operator": operator,
        "friction": problem.friction,
        "name": problem.name,
        "names": names,
    }
    if problem.precision != "float64":
        meta["precision"] = problem.precision
    if problem.generalized is not None:
        meta["dof_names"] = problem.generalized.names
    if problem.has_singular_program:
        meta["program"] = len(problem.qp.q)
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode("ascii"), np.uint8)
    write_arrays(path, arrays)


def _read_own_format(archive: Archive) -> Stored:
    """Read a problem in our own format."""
    version = archive.read_scalar("lavender_format")
    if version != FORMAT_VERSION or isinstance(version, bool):
        raise InputError(
            f"lavender_format is {version!r}; this lavender reads {FORMAT_VERSION}: update it, or save again"
        )
    meta = _read_meta(archive)
    operator = {
        "dense": ("A",),
        "csr": CSR,
        "rows": (*ROWS, "compliance"),
        "generalized": (*GENERALIZED, "compliance"),
    }[meta["operator"]]
    needed = ("lavender_format", "meta", "b", *CONES, *operator)
    _check_entries(archive, needed, OPTIONAL)
    for name in archive:
        if archive[name].dtype.kind not in "iuf":
            raise InputError(f"entry {name!r} has dtype {archive[name].dtype}; numbers are needed")
    b, ptr = archive["b"], archive["cones_ptr"]
    if b.ndim != 1:
        raise InputError(f"b has shape {b.shape}; one dimension is needed")
    # Check the number of rows before bounds of that length are allocated.
    if ptr.ndim != 1 or len(ptr) == 0 or ptr[-1] != len(b):
        raise InputError(f"b has shape {b.shape}; cones.ptr must end with the number of its rows")
    optional_parts: dict[str, Any] = {name: archive[name] for name in ("guess", "key") if name in archive}
    optional_parts["precision"] = meta.get("precision", "float64")
    if meta["operator"] == "rows":
        parts: dict[str, Any] = {name.removeprefix("rows_"): archive[name] for name in ROWS}
        optional_parts["rows"] = Rows(**parts)
        optional_parts["compliance"] = archive["compliance"]
    elif meta["operator"] == "generalized":
        optional_parts["generalized"] = _build_generalized(archive, meta["dof_names"])
        optional_parts["compliance"] = archive["compliance"]
    else:
        optional_parts["matrix"] = _read_matrix(archive)
    entries = [*CONES, *(["cones_rolling"] if "cones_rolling" in archive else [])]
    cones = Cones(**{name.removeprefix("cones_"): archive[name] for name in entries})
    problem = Problem(
        b, cones, friction=meta["friction"], names=meta["names"], name=meta["name"], **optional_parts
    )
    if "program" in meta:
        n = check_int("program", meta["program"], high=problem.m)
        problem = replace(problem, qp=recover_program(problem.csr, problem.b, problem.cones, n), copy=False)
    return Stored(problem, "lavender", impulse=_read_vector(archive, "impulse", problem))


def _read_meta(archive: Archive) -> dict[str, Any]:
    """Read and check the entry 'meta', a JSON object."""
    try:
        meta = json.loads(archive["meta"].astype(np.uint8, casting="safe").tobytes())
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"entry 'meta' cannot be read as JSON ({error}); JSON text in bytes is needed, as "
            "lavender.io.save writes it: save the problem again"
        ) from None
    if not isinstance(meta, dict):
        raise InputError(f"entry 'meta' holds a {type(meta).__name__}; a JSON object is needed")
    needed = ("operator", "friction", "name", "names")
    for name in needed:
        if name not in meta:
            raise InputError(f"entry 'meta' has no {name!r}; {', '.join(needed)} are needed")
    unknown = sorted(set(meta) - {*needed, "dof_names", "precision", "program"})
    if unknown:
        raise InputError(f"entry 'meta' has the unknown names {', '.join(unknown)}: remove them")
    operators = ("dense", "csr", "rows", "generalized")
    for name, is_valid, requirement in (
        ("operator", meta["operator"] in operators, " or ".join(operators)),
        ("dof_names", ("dof_names" in meta) == (meta["operator"] == "generalized"),
         "a list of names or null with the operator generalized, and nothing with other operators,"),
        ("dof_names", _is_name_list(meta.get("dof_names")), "a list of names, or null,"),
        ("name", isinstance(meta["name"], str), "a text"),
        ("friction", isinstance(meta["friction"], str), "a text"),
        ("names", _is_name_list(meta["names"]), "a list of names, or null,"),
        ("precision", meta.get("precision", "float64") in PRECISIONS, " or ".join(PRECISIONS)),
        ("program", type(meta.get("program", 0)) is int and ("program" not in meta or meta["operator"] == "csr"),
         "a number of variables, with the operator csr,"),
    ):  # fmt: skip
        if not is_valid:
            raise InputError(f"entry 'meta': {name} is {meta.get(name)!r:.60}; {requirement} is needed")
    return meta


def _build_generalized(archive: Archive, names: list[str] | None) -> Generalized:
    """Build the generalised form from its entries."""
    v_free = archive["general_v_free"]
    n, m = v_free.size, archive["b"].size
    jac, mass = (
        build_checked_csr(
            archive[f"general_{name}_indptr"],
            archive[f"general_{name}_indices"],
            archive[f"general_{name}_data"],
            rows,
            n,
        )
        for name, rows in (("jac", m), ("mass", n))
    )
    return Generalized(jac, mass, v_free, names)


def _is_name_list(value: Any) -> bool:
    return value is None or (isinstance(value, list) and all(isinstance(name, str) for name in value))


def _check_entries(archive: Archive, needed: Collection[str], optional: Collection[str]) -> None:
    """Raise InputError if entries are missing or unknown."""
    missing = [name for name in needed if name not in archive]
    if missing:
        raise InputError(
            f"the entries {', '.join(missing)} are missing; all entries of the format are needed: save the "
            "problem again with lavender.io.save"
        )
    unknown = [name for name in archive if name not in needed and name not in optional]
    if unknown:
        raise InputError(
            f"the entries {', '.join(unknown)} do not belong to format {FORMAT_VERSION} of this lavender: "
            "remove them, or install the version that wrote the file"
        )


# -- plain box format and format of a benchmark generator ------------------------------------------


def _read_box_format(archive: Archive) -> Stored:
    """Read the box format: w = A l - b, lo <= l <= hi complementary to w; friction cones become contacts."""
    b = archive["b"]
    if b.ndim != 1:
        raise InputError(f"b has shape {b.shape}; one dimension is needed")
    cones = _build_box_cones(archive, len(b))
    problem = Problem(b, cones, _read_matrix(archive), name=Path(archive.path).stem)
    compare = archive.read_scalar("compare") if "compare" in archive else ""
    return Stored(
        problem,
        "box",
        impulse=_read_vector(archive, "l_ref", problem),
        slack=_read_vector(archive, "w_ref", problem),
        compare=str(compare),
    )


def _build_box_cones(archive: Archive, m: int) -> Cones:
    """Build the cones of the box format from bounds and, if given, contacts of 1 to 3 rows."""
    lower, upper = (as_array(f"entry {name!r}", archive[name], (m,), finite=False) for name in ("lo", "hi"))
    if "cone_start" not in archive or archive["cone_start"].size == 0:
        return Cones.bounded(lower, upper)
    integers = {name: archive[name] for name in ("cone_start", "cone_dim")}
    count = integers["cone_start"].size
    start, size = (
        as_array(f"entry {name!r}", x, (count,), dtype=np.int32).astype(np.int64)
        for name, x in integers.items()
    )
    mu = as_array("entry 'cone_mu'", archive["cone_mu"], (count,))
    order = np.argsort(start)
    start, size, mu = start[order], size[order], mu[order]
    end = start + size
    if size.min() < 1 or size.max() > 3 or start.min() < 0 or end.max() > m or np.any(end[:-1] > start[1:]):
        raise InputError(
            "cone_start and cone_dim must describe cones of 1 to 3 rows that do not overlap, within rows 0 "
            f"to {m - 1}; they have sizes {size.min()} to {size.max()}, from row {start.min()} to "
            f"{end.max() - 1}"
        )
    inside = np.zeros(m, bool)  # Whether a row belongs to the block of the row before it.
    for s, e in zip(start, end, strict=True):
        inside[s + 1 : e] = True
    first = np.flatnonzero(~inside)
    contact, friction = np.zeros(len(first), bool), np.zeros(len(first))
    at = np.searchsorted(first, start)
    contact[at], friction[at] = True, mu
    return Cones(
        ptr=np.append(first, m),
        kind=get_block_kinds(contact),
        lower=lower,
        upper=upper,
        mu=friction,
        patch_radius=np.zeros(len(first)),
    )


def _read_generated_format(archive: Archive) -> Stored:
    """Read the layout of a benchmark generator: A, b, and `kind` lcp (l >= 0), free, or cone (3 rows per contact)."""
    kind = archive.read_scalar("kind")
    b = archive["b"]
    name = Path(archive.path).stem
    if b.ndim != 1:
        raise InputError(f"b has shape {b.shape}; one dimension is needed")
    if kind == "lcp":
        problem = Problem.lcp(_read_matrix(archive), b, name=name)
    elif kind == "free":
        problem = Problem.linear(_read_matrix(archive), b, name=name)
    elif kind == "cone":
        problem = Problem.contact(_read_matrix(archive), b, archive["mu"], friction="cone", name=name)
    else:
        raise InputError(f"entry 'kind' is {kind!r}; 'lcp', 'free' or 'cone' is needed")
    return Stored(problem, "generated")


def _read_vector(archive: Archive, name: str, problem: Problem) -> FloatArray | None:
    return problem.impulse_array(archive[name], f"entry {name!r}") if name in archive else None


def _read_matrix(archive: Archive) -> Any:
    """Return the matrix A of an archive: the dense entry `A`, or a CSR matrix from entries with checked indices."""
    if "A" in archive:
        return archive["A"]
    m = archive["b"].size
    shape = tuple(archive["A_shape"].ravel().tolist())
    if shape != (m, m):
        raise InputError(f"A_shape is {shape}; ({m}, {m}) is needed, as b has {m} rows")
    return build_checked_csr(archive["A_indptr"], archive["A_indices"], archive["A_data"], m, m)


def build_checked_csr(
    indptr: np.ndarray, indices: np.ndarray, data: np.ndarray, m: int, n: int
) -> sp.csr_array:
    """Build a CSR matrix (m, n) from arrays of a file, with checked indices; `data` may be longer than needed.

    Raises
    ------
    InputError
        An array has the wrong type or length, or an index is out of range.
    """
    for name, x, kinds in (("pointers", indptr, "iu"), ("indices", indices, "iu"), ("values", data, "buif")):
        if x.ndim != 1 or x.dtype.kind not in kinds:
            raise InputError(
                f"the {name} of a compressed matrix have dtype {x.dtype} and shape {x.shape}; "
                f"one dimension of {'whole ' if kinds == 'iu' else ''}numbers is needed"
            )
    if len(indptr) != m + 1 or indptr[0] != 0 or np.any(indptr[1:] < indptr[:-1]):
        raise InputError(
            f"the pointers of a compressed matrix are {indptr.tolist()!s:.60}; {m + 1} numbers that start with 0 and "
            f"do not decrease are needed: the first entry of each of its {m} rows, and the number of entries"
        )
    used = int(indptr[-1])
    if used > len(indices) or used > len(data):
        raise InputError(
            f"the pointers of a compressed matrix announce {used} entries, but there are {len(indices)} "
            f"indices and {len(data)} values; equal numbers are needed"
        )
    if used and (indices[:used].min() < 0 or indices[:used].max() >= n):
        raise InputError(
            f"a compressed matrix has column indices from {indices[:used].min()} to {indices[:used].max()}; "
            f"0 to {n - 1} is needed, because it has {n} columns"
        )
    parts = (data[:used].astype(np.float64), indices[:used].astype(np.int64), indptr.astype(np.int64))
    return sp.csr_array(parts, shape=(m, n))
