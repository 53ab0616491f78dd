"""Store records on disk: one JSON object per line, appended and flushed as each is made; CSV and JSON on request.

A run that was killed leaves at most one incomplete line, the last one, which is removed before the next is written.
One process writes a file, under the lock of `lavender.io.stored.lock_output`.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from lavender.base.arrays import format_html_table
from lavender.base.errors import InputError
from lavender.io.stored import (
    MAX_BYTES,
    as_path,
    lock_output,
    make_folder,
    resolve_destination,
    write_atomically,
    write_text,
)
from lavender.report.bench.record import (
    CaseInfo,
    Entry,
    Record,
    Run,
    Skip,
    from_json,
    to_json,
    to_jsonable,
)

MAX_LINE_BYTES = 2**26  # A longer line is not a record; the longest records have a few thousand bytes.
SYNC_INTERVAL = 1.0  # [s] A power cut loses at most the records of this time, a killed process none.


@dataclass(repr=False)
class Records:
    """Entries of one or more runs."""

    runs: dict[str, Run] = field(default_factory=dict)
    cases: dict[str, CaseInfo] = field(default_factory=dict)  # The latest description of each case.
    records: list[Record] = field(default_factory=list)
    source: str = ""
    # If `of_solvers` selected these records: all solvers before the selection.
    selected_from: tuple[str, ...] = ()
    _skips: dict[tuple[str, str, str], Skip] = field(default_factory=dict, repr=False)
    # The identity of each sequence in its latest description.
    _sequences: dict[str, str] = field(default_factory=dict, repr=False)

    @property
    def skips(self) -> list[Skip]:
        """Pairs that did not run, and cases that did not load."""
        return list(self._skips.values())

    @property
    def left_out(self) -> dict[str, list[Skip]]:
        """Cases that did not load, by sequence ("" for single cases). No number of a report counts them."""
        found: dict[str, list[Skip]] = {}
        for skip in self._skips.values():
            if not skip.solver:
                found.setdefault(skip.sequence, []).append(skip)
        return found

    def add(self, entry: Entry) -> None:
        """Add one entry. A description, note or run replaces the earlier one."""
        if isinstance(entry, Run):
            self.runs.pop(entry.run, None)  # Insert the run again at the end, where the newest run is.
            self.runs[entry.run] = entry
        elif isinstance(entry, CaseInfo):
            if (
                entry.sequence
                and self._sequences.setdefault(entry.sequence, entry.identity) != entry.identity
            ):
                # Another sequence of the same name: remove the steps of the earlier one.
                self.cases = {n: i for n, i in self.cases.items() if i.sequence != entry.sequence}
                self._sequences[entry.sequence] = entry.identity
            self.cases[entry.case] = entry
            # Remove an earlier note that the case does not load.
            self._skips.pop((entry.run, entry.case, ""), None)
        elif isinstance(entry, Skip):
            self._skips[entry.run, entry.case, entry.solver] = entry
        else:
            self.records.append(entry)

    def __iter__(self) -> Iterator[Record]:
        return iter(self.records)

    def __len__(self) -> int:
        return len(self.records)

    def select_latest_run(self) -> Records:
        """Return the records of the run that wrote last, of cases with unchanged numbers.

        Times are compared only within one run, and a file that has changed is another problem.
        """
        if not self.runs:
            return self
        run = list(self.runs)[-1]
        now = {name: info.sha for name, info in self.cases.items()}
        mine = [
            r for r in self.records if r.run == run and r.sha == now.get(r.case, "" if r.step >= 0 else r.sha)
        ]
        # Keep only the newest group of calls that were timed alternately.
        newest = next((r.interleave_group for r in reversed(mine) if r.interleave_group), "")
        mine = [r for r in mine if r.interleave_group in ("", newest)]
        cases = {r.case for r in mine}
        return self.with_records(
            mine, lambda e: e.run == run or (isinstance(e, CaseInfo) and e.case in cases)
        )

    def with_records(
        self, records: Iterable[Record], keep: Callable[[Entry], bool] = lambda entry: True
    ) -> Records:
        """Return a copy that holds `records`, and the runs, case descriptions and notes that `keep` accepts."""
        found = Records(source=self.source, selected_from=self.selected_from)
        entries: list[Entry] = [*self.runs.values(), *self.cases.values(), *self.skips]
        for entry in (*filter(keep, entries), *records):
            found.add(entry)
        return found

    def of_solvers(self, names: Iterable[str]) -> Records:
        """Return the records of some solvers, with the notes about them and all cases.

        Raises
        ------
        InputError
            There are no records of a solver.
        """
        wanted = list(names)
        known = sorted({r.solver for r in self.records} | {s.solver for s in self.skips if s.solver})
        for name in wanted:
            if name not in known:
                raise InputError(f"no records of solver {name!r}; there are records of {', '.join(known)}")
        selection = self.with_records(
            (r for r in self.records if r.solver in wanted),
            lambda e: not isinstance(e, Skip) or e.solver in ("", *wanted),
        )
        selection.selected_from = tuple(sorted(self.solvers))
        return selection

    @property
    def solvers(self) -> set[str]:
        """The solvers with records, and the solvers that `of_solvers` removed."""
        return {*self.selected_from, *(r.solver for r in self.records)}

    def is_successful(self, record: Record) -> bool | None:
        """Return whether a run succeeded, or None if the zero impulse solves the case."""
        info = self.cases.get(record.case)
        return None if info is not None and info.nothing_to_do else record.success

    def rows(self) -> list[dict[str, Any]]:
        """Return one row for each record, with its case and machine: the columns of `records.csv`."""
        out = []
        for r in self.records:
            run, info = self.runs.get(r.run), self.cases.get(r.case)
            row = {f.name: getattr(r, f.name) for f in fields(r) if f.name != "sha"}
            row |= {
                "success": self.is_successful(r),
                "nothing_to_do": bool(info and info.nothing_to_do),
                "law": info.law if info else "",
                "rows": info.rows if info else 0,
                "structure": ", ".join(info.structure) if info else "",
                "lavender": run.lavender if run else "",
                "python": run.python if run else "",
                "platform": run.platform if run else "",
                "cpu": run.cpu if run else "",
                "cores": run.cores if run else 0,
                "versions": dict(run.versions) if run else {},
                "started": run.started if run else "",
            }
            out.append(row)
        return out

    def __repr__(self) -> str:
        return f"<Records: {len(self.records)} runs of {len(self.cases)} cases, {self.source or 'in memory'}>"

    def _repr_html_(self) -> str:
        """Return a table of the numbers of runs and cases, for notebooks."""
        solvers = sorted({r.solver for r in self.records})
        facts = {"runs": len(self.records), "cases": len(self.cases), "solvers": ", ".join(solvers)}
        return format_html_table(facts, self.source or "Records")

    def frame(self) -> Any:
        """Return `rows()` as a pandas frame.

        Raises
        ------
        ImportError
            pandas is not installed.
        """
        import pandas

        return pandas.DataFrame(self.rows())


# -- writing ----------------------------------------------------------------------------------------------


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
                self.records = read_records(self.path) if self.path.exists() else Records()
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


def read_records(path: str | Path) -> Records:
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
    found = Records(source=str(path))
    for number, line in enumerate(_read_lines(path), 1):
        if not line.strip():
            continue
        try:
            entry = from_json(json.loads(line))
        except (ValueError, RecursionError) as error:
            raise InputError(
                f"{path}, line {number}: {error}. Give a records.jsonl that `lavender report` wrote, or "
                "remove this line"
            ) from None
        if isinstance(entry, Record) and not (entry.case in found.cases and entry.run in found.runs):
            what = "case" if entry.run in found.runs else "run"
            raise InputError(
                f"{path}, line {number}: the record belongs to a {what} that no earlier line describes; a "
                "complete records.jsonl is needed: copy the whole file"
            )
        found.add(entry)
    # A repeated measurement takes the place of the earlier one in the list.
    newest = {(r.run, r.key): r for r in found.records}
    found.records = list(newest.values())
    return found


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


def write_csv(records: Records, path: str | Path) -> None:
    """Write one row for each record. Cells that hold mappings and lists (`work`, `options`, `times`, ...) are JSON."""
    rows = records.rows()
    columns = list(rows[0]) if rows else [f.name for f in fields(Record)]

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as f:
            writer = csv.DictWriter(f, columns)
            writer.writeheader()
            for row in rows:
                writer.writerow(
                    {
                        k: json.dumps(to_jsonable(v)) if isinstance(v, (dict, tuple)) else v
                        for k, v in row.items()
                    }
                )

    write_atomically(path, write)


def write_json(records: Records, path: str | Path) -> None:
    """Write {"runs": [...], "cases": [...], "skips": [...], "records": [...]}; inf and nan are strings."""

    def as_dicts(entries: Iterable[Any]) -> list[dict[str, Any]]:
        return [{k: v for k, v in to_json(e).items() if k != "kind"} for e in entries]

    content = {
        "runs": as_dicts(records.runs.values()),
        "cases": as_dicts(records.cases.values()),
        "skips": as_dicts(records.skips),
        "records": [
            {**entry, "success": records.is_successful(r)}
            for entry, r in zip(as_dicts(records.records), records.records, strict=True)
        ],
    }
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
