"""Files: paths, locks of outputs, atomic writing, and reading of NumPy archives (.npz).

Nothing in an archive is executed or unpickled. The memory for all entries is computed from their headers before the
first entry is read.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from threading import get_native_id
from tokenize import TokenError
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy

from lavender.base.arrays import check_bool, check_int
from lavender.base.errors import InputError, require_packages

HDF5 = (".hdf5", ".h5", ".hdf")
SUFFIXES = (".npz", *HDF5)  # Suffixes of problem files.
ENGINE = "engine.jsonl"  # File of the engine's own results, in the folder of recorded problems.
STATES_FOLDER = "states"  # Folder of the states before recorded steps, in the folder of recorded problems.

# Default limit of the memory for the arrays of a file; a file of a megabyte can declare a terabyte.
MAX_BYTES = 2**31
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

MAX_NPY_HEADER_BYTES = 10_000  # [bytes] A longer .npy header is rejected; 100 bytes are usual.
MAX_ARCHIVE_ENTRIES = 1000  # Largest accepted number of entries in an archive; a problem has up to 30.
# Memory that Python objects need per byte of JSON text, at most; nested empty lists need 24.
JSON_BYTES_PER_BYTE = 40
# Compression methods that NumPy writes. Others are rejected: their memory use depends on parameters in the archive.
ACCEPTED_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
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
    # All names of an output share one lock.
    target = _resolve_symlinks(path) if folder else resolve_destination(path)
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


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write bytes to a file with `write_atomically`."""
    write_atomically(path, lambda part: part.write_bytes(data))


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text to a file with `write_atomically`, in UTF-8."""
    write_bytes(path, text.encode())


def format_json(value: Any, indent: int | None = None) -> str:
    """Return JSON of numbers, texts, NumPy arrays and containers; numbers that are not finite become null."""

    def convert(x: Any) -> Any:
        """Convert a value to types that JSON has."""
        if isinstance(x, Mapping):
            return {str(name): convert(entry) for name, entry in x.items()}
        x = x.tolist() if isinstance(x, (np.ndarray, np.generic)) else x
        if isinstance(x, (list, tuple)):
            return [convert(entry) for entry in x]
        return None if isinstance(x, float) and not math.isfinite(x) else x

    return json.dumps(convert(value), indent=indent, allow_nan=False)


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


class _Header(NamedTuple):
    """Header of a .npy entry, and the stream of its data."""

    stream: IO[bytes]
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran: bool


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
            budget.reserve_bytes(math.prod(header.shape) * width, f"{self.path}: entry {name!r}")

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._headers:
            has = ", ".join(self._headers) or "nothing"
            raise InputError(f"{self.path} has no entry {name!r}; it has {has}")
        if name not in self._arrays:
            stream, dtype, shape, fortran = self._headers[name]
            size = math.prod(shape) * dtype.itemsize
            try:
                with stream:
                    raw = stream.read(size)
                    if len(raw) != size or stream.read(1):
                        raise EOFError(
                            f"it holds {len(raw)} of {size} bytes: the file is damaged, save it again"
                        )
                self._arrays[name] = np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C")
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
