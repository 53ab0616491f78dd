"""The C library as a folder: its one source, its header, and how it is built."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import lavender_ext
from lavender.base.errors import InputError, LavenderError
from lavender.export.amalgamate import ExtractionError, amalgamate, source_hash
from lavender.io.stored import check_writable, load_or_make, make_folder, write_bytes

HERE = Path(__file__).resolve().parent
ROOT = Path(lavender_ext.__file__).resolve().parent.parent  # the folder that holds lavender_ext
HEADER = HERE / "c" / "lavender.h"
TEXTS = (".h", ".c", ".txt", ".in")


def source() -> str:
    """lavender.c: the one that came with the package, or one made of the kernels as they lie here, kept beside it.

    Raises
    ------
    LavenderError
        Neither: the kernels were changed, or come without one, and Cython is not installed.
    """
    wanted = source_hash(ROOT).encode()

    def make() -> bytes:
        try:
            return amalgamate(ROOT, ROOT / "build" / "cython").encode()
        except ExtractionError as error:
            raise LavenderError(
                f"lavender.c does not lie in {HERE / 'c'} and cannot be made: {str(error)[-500:]}; "
                "install a wheel, or Cython"
            ) from None

    return load_or_make(HERE / "c" / "lavender.c", lambda text: wanted in text[:1000], make).decode()


def _files(folder: Path) -> Iterator[Path]:
    return (
        p for p in sorted(folder.rglob("*")) if p.suffix in TEXTS and p.name != "lavender.c" and p.is_file()
    )


def write(out: Path, *, more: Mapping[str, str | bytes] | None = None, replace: bool = False) -> list[Path]:
    """Write the C library into a folder.

    Parameters
    ----------
    out : Path
        A folder; made where it is not there. Files of other names in it stay.
    more : mapping, optional
        Further files by name, without a line in SHA256SUMS.
    replace : bool
        Replace files of ours that are others than what would be written.

    Returns
    -------
    list of Path
        The files written; SHA256SUMS and `more` last.

    Raises
    ------
    InputError
        A file of that name is there and is another; the folder cannot be written.
    LavenderError
        As `source`.
    """
    check_writable(out, folder=True)
    folder = HERE / "c"
    made = {p.relative_to(folder).as_posix(): p.read_text(encoding="utf-8") for p in _files(folder)}
    made["lavender.c"] = source()
    sums = "".join(f"{hashlib.sha256(made[name].encode()).hexdigest()}  {name}\n" for name in sorted(made))
    made["SHA256SUMS"] = sums
    return _put(out, {**made, **(more or {})}, replace)


def _put(out: Path, made: Mapping[str, str | bytes], replace: bool) -> list[Path]:
    """Write files by their names below a folder; none where one of them is there and is another."""
    files = {out / name: x.encode() if isinstance(x, str) else x for name, x in made.items()}
    for path, data in files.items():
        if path.exists() and not replace and path.read_bytes() != data:
            raise InputError(f"{path} is there and is another: give --replace, or another folder")
    for path, data in files.items():
        make_folder(path.parent)
        write_bytes(path, data)
    return list(files)
