"""Write the C library as a folder: its single source file, its header, and the files of its build."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import lavender_ext
from lavender.base.errors import InputError, LavenderError
from lavender.export.amalgamate import ExtractionError, amalgamate, hash_sources
from lavender.io.stored import check_writable, load_or_make_file, make_folder, write_bytes

HERE = Path(__file__).resolve().parent
ROOT = Path(lavender_ext.__file__).resolve().parent.parent  # The folder that contains lavender_ext.
HEADER = HERE / "c" / "lavender.h"
TEXTS = (".h", ".hpp", ".c", ".txt", ".in")


def source() -> str:
    """Return the text of lavender.c.

    It is read from the file in the package if that was built from the present kernels. Otherwise it is built, and
    stored in the package if possible.

    Raises
    ------
    LavenderError
        There is no current file, and it cannot be built, for example because Cython is not installed.
    """
    current_hash = hash_sources(ROOT).encode()

    def make() -> bytes:
        try:
            return amalgamate(ROOT, ROOT / "build" / "cython").encode()
        except ExtractionError as error:
            raise LavenderError(
                f"lavender.c is not in {HERE / 'c'} and cannot be built: {str(error)[-500:]}; "
                "install a wheel, or Cython"
            ) from None

    return load_or_make_file(
        HERE / "c" / "lavender.c", lambda text: current_hash in text[:1000], make
    ).decode()


def write(out: str | os.PathLike[str], *, replace: bool = False) -> list[Path]:
    """Write the C library into a folder.

    Parameters
    ----------
    out : str or os.PathLike
        Folder, which is created if it does not exist. Files with other names in it are kept.
    replace : bool
        Whether to replace existing files with other contents.

    Returns
    -------
    list of Path
        The written files; SHA256SUMS is the last one.

    Raises
    ------
    InputError
        A file exists with other contents and `replace` is false, or the folder cannot be written.
    LavenderError
        `source` raises it.
    """
    out = check_writable(out, folder=True)
    folder = HERE / "c"
    contents = {
        p.relative_to(folder).as_posix(): p.read_text(encoding="utf-8")
        for p in sorted(folder.rglob("*"))
        if p.suffix in TEXTS and p.name != "lavender.c" and p.is_file()
    }
    contents["lavender.c"] = source()
    sums = "".join(
        f"{hashlib.sha256(contents[name].encode()).hexdigest()}  {name}\n"
        for name in sorted(contents)
    )
    contents["SHA256SUMS"] = sums
    files = {out / name: text.encode() for name, text in contents.items()}
    for path, data in files.items():
        if path.exists() and not replace and path.read_bytes() != data:
            raise InputError(
                f"{path} exists with other contents: give --replace, or another folder"
            )
    for path, data in files.items():
        make_folder(path.parent)
        write_bytes(path, data)
    return list(files)
