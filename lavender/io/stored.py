"""Files: paths, atomic writing, and reading of NumPy archives (.npz) without pickle."""

from __future__ import annotations

import contextlib
import json
import math
import os
import stat
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import get_native_id
from typing import Any

import numpy as np

from lavender.base.arrays import check_bool
from lavender.base.errors import InputError

HDF5 = (".hdf5", ".h5", ".hdf")
SUFFIXES = (".npz", *HDF5)  # Suffixes of problem files.
ENGINE = "engine.jsonl"  # File of the engine's own results, in the folder of recorded problems.
STATES_FOLDER = (
    "states"  # Folder of the states before recorded steps, in the folder of recorded problems.
)


def prepare_step_folder(
    path: str | os.PathLike[str], replace: bool = False, continued: bool = False
) -> Path:
    """Create a folder for recorded problems if necessary, and return its path.

    The folder must not hold problem files, because the steps of two recordings are not one sequence. `replace` removes
    the problem files and the engine's results. With `continued`, the files belong to the present recording and are
    kept.
    """
    replace = check_bool("replace", replace)
    folder = make_folder(check_writable(path, folder=True))
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
            f"the files in {str(folder)!r} cannot be removed ({error.strerror})"
        ) from None
    return folder


def resolve_destination(path: str | os.PathLike[str]) -> Path:
    """Return the path at which a file is written: the target of symbolic links, a regular file or a new one."""
    target = os.path.realpath(as_path(path))
    if os.path.exists(target) and not os.path.isfile(target):
        raise InputError(
            f"cannot write {path}: it is not a regular file; the name of a file is needed"
        )
    return Path(target)


def check_writable(path: str | os.PathLike[str], folder: bool = False) -> Path:
    """Return `path` if its file (or `folder`, with its parents) can be written later; nothing is opened or created."""
    path = as_path(path)
    parent = Path(os.path.realpath(path)) if folder else resolve_destination(path).parent
    while folder and parent != parent.parent and not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise InputError(f"cannot write {path}: {parent} is not a folder")
    if not os.access(parent, os.W_OK) or (
        not folder and os.path.exists(path) and not os.access(path, os.W_OK)
    ):
        raise InputError(f"cannot write {path}: you have no permission to write there")
    return path


def make_folder(path: str | os.PathLike[str]) -> Path:
    """Create a folder and its parents if they do not exist, and return its path; InputError if that fails."""
    folder = as_path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot create the folder {folder}: {error.strerror or error}") from None
    return folder


def write_atomically(path: str | os.PathLike[str], write: Callable[[Path], Any]) -> None:
    """Write a file atomically, so that readers get the old file or the complete new file.

    `write` is called with a temporary path in the folder of the file, which is then renamed. If `path` is a symbolic
    link, the target of the link is replaced. The permissions of an existing file are kept.
    """
    target = resolve_destination(path)
    temporary = target.with_name(f".{os.getpid()}.{get_native_id()}.part")
    try:
        write(temporary)
        # A new file has no permissions to keep, and some file systems have none.
        with contextlib.suppress(OSError):
            temporary.chmod(stat.S_IMODE(target.stat().st_mode))
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None
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


def load_or_make_file(
    path: Path, is_current: Callable[[bytes], bool], make: Callable[[], bytes]
) -> bytes:
    """Return the content of a file if `is_current` accepts it; else return the result of `make` and try to store it."""
    if path.exists() and is_current(content := path.read_bytes()):
        return content
    content = make()
    with contextlib.suppress(OSError, InputError):
        write_bytes(path, content)
    return content


def write_arrays(path: str | os.PathLike[str], arrays: Mapping[str, Any]) -> None:
    """Write an archive of arrays (.npz) with `write_atomically`; their names may equal names of arguments of NumPy."""

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "x", zipfile.ZIP_DEFLATED) as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                    np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)

    write_atomically(path, write)


class Arrays(dict[str, np.ndarray]):
    """Arrays of an .npz by name."""

    def __missing__(self, name: str) -> np.ndarray:
        raise InputError(f"it has no entry {name!r}; it has {', '.join(self) or 'nothing'}")


def read_arrays(path: str | os.PathLike[str]) -> Arrays:
    """Read all arrays of an archive (.npz); nothing is unpickled."""
    name = ""
    arrays = Arrays()
    try:
        with as_path(path).open("rb") as stream:  # NumPy leaves a damaged file open.
            archive = np.load(stream, allow_pickle=False)
            if isinstance(archive, np.ndarray):
                raise ValueError("it is a single array")
            for name in archive:
                arrays[name] = archive[name]
                if not isinstance(arrays[name], np.ndarray):
                    raise ValueError("it is not an array")
    except (
        Exception
    ) as error:  # Damaged archives raise exceptions of zipfile, zlib, tokenize and others.
        entry = f"entry {name!r} of {path}" if name else f"{path}"
        raise InputError(
            f"{entry} cannot be read: {error}; an .npz archive of arrays is needed"
        ) from None
    return arrays


def as_path(path: str | os.PathLike[str]) -> Path:
    """Return a Path; raise InputError for numbers, which the operating system would treat as open files."""
    if not isinstance(path, (str, os.PathLike)) or not isinstance(os.fspath(path), str):
        raise InputError(
            f"path is {path!r} ({type(path).__name__}); the path of a file as text is needed"
        )
    if "\0" in os.fspath(path):
        raise InputError(f"path {path!r} has a NUL character, which no file name may have")
    return Path(path)


def read_bytes(path: str | os.PathLike[str], role: str = "", count: int = -1) -> bytes:
    """Return the first `count` bytes of a file, or all of them; messages name the file by its `role`."""
    path = as_path(path)
    try:
        with open(path, "rb") as stream:
            return stream.read(count)
    except (OSError, ValueError) as error:
        named = f"{role} {str(path)!r}" if role else path
        raise InputError(
            f"cannot read {named}: {getattr(error, 'strerror', None) or error}"
        ) from None
