"""Write and read files of records (`records.jsonl`), with one JSON object per line.

Lines are appended and flushed as each entry is made: runs, cases, pairs that did not run, and machines. A measurement
that was killed leaves at most one incomplete line, the last one, which is removed before the next line is written. One
process writes a file, under the lock of `lavender.io.stored.lock_output`.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

from lavender.base.errors import InputError
from lavender.io.stored import MAX_BYTES, as_path, lock_output, make_folder, resolve_destination
from lavender.report.records import (
    RECORD_DEFAULTS,
    RECORD_FIELDS,
    Entry,
    Record,
    Records,
    from_json,
    parse_fields,
    to_json,
)

MAX_LINE_BYTES = 2**26  # A longer line is not a record; the longest records have a few thousand bytes.
SYNC_INTERVAL = 1.0  # [s] A power cut loses at most the records of this time, a killed process none.


class Store:
    """Appends entries to a `.jsonl` file, which no other process can write while it is open.

    Raises
    ------
    InputError
        The file cannot be written, another process writes it, or it has other content.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self._real = as_path(path), resolve_destination(path)
        make_folder(self.path.parent)
        with contextlib.ExitStack() as held:
            held.enter_context(lock_output(self.path))
            try:
                self.records = read(self.path) if self.path.exists() else Records()
                _remove_incomplete_last_line(self.path)
                self.file = self.path.open("a", encoding="utf-8")
            except OSError as error:
                raise InputError(
                    f"cannot write {self.path} ({error.strerror or error}): give a folder that you may write to"
                ) from None
            self._lock = held.pop_all()
        self._synced = time.monotonic()

    def add(self, entry: Entry) -> None:
        """Write one entry and flush it to the operating system before returning.

        Raises
        ------
        InputError
            The disk is full (earlier entries are stored), or the file was removed.
        """
        line = json.dumps(to_json(entry), allow_nan=False)
        try:
            self.file.write(line + "\n")
            self.file.flush()
            if time.monotonic() - self._synced > SYNC_INTERVAL:
                os.fsync(self.file.fileno())
                self._synced = time.monotonic()
                if not self._real.exists():
                    raise InputError(
                        f"{self.path} was removed, with its contents, while it was being written: run the "
                        "command again in another folder"
                    )
        except OSError as error:
            raise InputError(
                f"cannot write {self.path} ({error.strerror or error}): free disk space and run the same command "
                "again; it continues after the last record"
            ) from None
        self.records.add(entry)

    def close(self) -> None:
        """Close the file and release its lock. Errors of the disk are ignored here: `add` has raised them."""
        with contextlib.suppress(OSError):
            self.file.close()
        self._lock.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def open_store(store: Store | str | Path | None) -> Iterator[Store | None]:
    """Yield a store, or open the store of a path and close it at the end."""
    if store is None or isinstance(store, Store):
        yield store
        return
    with Store(store) as made:
        yield made


def _remove_incomplete_last_line(path: Path) -> None:
    """Remove a last line without a line end, which an interrupted run leaves."""
    if not path.exists():
        return
    with path.open("rb+") as f:
        whole = sum(len(line) for line in f if line.endswith(b"\n"))
        if whole != f.tell():
            f.truncate(whole)


def read(path: str | Path) -> Records:
    """Read a file `records.jsonl`, or the one in a folder, without an incomplete last line.

    Raises
    ------
    InputError
        The file does not exist, or a line is not a record.
    """
    path = as_path(path)
    if path.is_dir():
        path = path / "records.jsonl"
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is not a file; a records.jsonl is needed")
    records = Records(source=str(path))
    for number, line in enumerate(_read_lines(path), 1):
        if not line.strip():
            continue
        try:
            content = json.loads(line)
            if isinstance(content, dict) and content.get("kind") == "record":
                # No `Record` is created: a file may have a million of them.
                values = RECORD_DEFAULTS | parse_fields(Record, content)
                if missing := [name for name in RECORD_FIELDS if name not in values]:
                    raise ValueError(f"a record has no {missing[0]}")
                if not (values["case"] in records.cases and values["run"] in records.runs):
                    owner = "case" if values["run"] in records.runs else "run"
                    raise ValueError(
                        f"the record belongs to a {owner} that no earlier line describes; a complete records.jsonl is "
                        "needed: copy the whole file"
                    )
                records.add_values(values)
            else:
                records.add(from_json(content))
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path}, line {number}: {error}. Give a records.jsonl that `lavender report` wrote, or "
                "remove this line"
            ) from None
    return records


def _read_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a file without byte order marks, and without an incomplete last line."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(
                f"{path} holds {size} bytes, more than the limit of {MAX_BYTES}; measure fewer cases in one "
                "folder"
            )
        with path.open("rb") as f:
            while line := f.readline(MAX_LINE_BYTES):
                if not line.endswith(b"\n"):
                    if len(line) == MAX_LINE_BYTES:
                        raise InputError(
                            f"{path} has a line of more than {MAX_LINE_BYTES} bytes; a records.jsonl is needed"
                        )
                    return
                yield line[:-1].decode("utf-8", errors="replace").removeprefix("\ufeff")
    except OSError as error:
        raise InputError(
            f"cannot read {path} ({error.strerror or error}); a records.jsonl is needed"
        ) from None
