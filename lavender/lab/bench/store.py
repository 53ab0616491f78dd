"""Records on disk: one JSON object a line, appended and flushed as each is made; CSV and JSON on request.

A line is whole or it is not there: a run that was killed leaves at most a torn last line, which is cut
off before the next one is written.

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

from lavender.base.arrays import table_of
from lavender.base.errors import InputError
from lavender.io.stored import (
    MAX_BYTES,
    as_path,
    destination,
    lock_output,
    make_folder,
    write_atomically,
    write_text,
)
from lavender.lab.bench.record import (
    CaseInfo,
    Done,
    Entry,
    Record,
    Run,
    Skip,
    from_json,
    plain,
    to_json,
)

MOST_LINE = 2**26  # bytes of a record; the longest of ours hold a few thousand
SYNC = 1.0  # s, at most, of records that a power cut could take; a killed process takes none


@dataclass(repr=False)
class Records:
    """Everything that one or more runs wrote."""

    runs: dict[str, Run] = field(default_factory=dict)
    cases: dict[str, CaseInfo] = field(default_factory=dict)  # the latest description of each
    records: list[Record] = field(default_factory=list)
    source: str = ""
    done: dict[tuple[str, str, str], Done] = field(default_factory=dict)  # pairs of a campaign, complete
    _skips: dict[tuple[str, str, str], Skip] = field(default_factory=dict, repr=False)
    # the identity of each, as described last
    _sequences: dict[str, str] = field(default_factory=dict, repr=False)

    @property
    def skips(self) -> list[Skip]:
        """Pairs that did not run, and cases that did not load."""
        return list(self._skips.values())

    @property
    def left_out(self) -> dict[str, list[Skip]]:
        """Cases that did not load, by sequence ("" of none): no number holds them, and each has to say so."""
        found: dict[str, list[Skip]] = {}
        for skip in self._skips.values():
            if not skip.solver:
                found.setdefault(skip.sequence, []).append(skip)
        return found

    def add(self, entry: Entry) -> None:
        """Take one entry; a description, note or run given again replaces the earlier one."""
        if isinstance(entry, Run):
            self.runs.pop(entry.run, None)  # the newest stands last
            self.runs[entry.run] = entry
        elif isinstance(entry, CaseInfo):
            if (
                entry.sequence
                and self._sequences.setdefault(entry.sequence, entry.identity) != entry.identity
            ):
                # Another sequence under a name that was used: the steps of the earlier one are none of it.
                self.cases = {n: i for n, i in self.cases.items() if i.sequence != entry.sequence}
                self._sequences[entry.sequence] = entry.identity
            self.cases[entry.case] = entry
            self._skips.pop((entry.run, entry.case, ""), None)  # it loads now
        elif isinstance(entry, Skip):
            self._skips[entry.run, entry.case, entry.solver] = entry
        elif isinstance(entry, Done):
            self.done[entry.run, entry.case, entry.solver] = entry
        else:
            self.records.append(entry)

    def __iter__(self) -> Iterator[Record]:
        return iter(self.records)

    def __len__(self) -> int:
        return len(self.records)

    def latest(self) -> Records:
        """Only the run that wrote last, and what it says of cases as they are now.

        Ratios of times make sense within one run alone, and a file that changed is another problem.
        """
        if not self.runs:
            return self
        run = list(self.runs)[-1]
        now = {name: info.sha for name, info in self.cases.items()}
        mine = [
            r for r in self.records if r.run == run and r.sha == now.get(r.case, "" if r.step >= 0 else r.sha)
        ]
        # lines that took turns with each other
        newest = next((r.turns for r in reversed(mine) if r.turns), "")
        mine = [r for r in mine if r.turns in ("", newest)]
        cases = {r.case for r in mine}
        return self.having(mine, lambda e: e.run == run or (isinstance(e, CaseInfo) and e.case in cases))

    def having(
        self, records: Iterable[Record], keep: Callable[[Entry], bool] = lambda entry: True
    ) -> Records:
        """Other records of the same runs, with the descriptions and notes that `keep` leaves."""
        found = Records(source=self.source)
        entries: list[Entry] = [*self.runs.values(), *self.cases.values(), *self.skips, *self.done.values()]
        for entry in (*filter(keep, entries), *records):
            found.add(entry)
        return found

    def success(self, record: Record) -> bool | None:
        """What the judge said of a run; None where doing nothing is right: neither solved nor failed."""
        info = self.cases.get(record.case)
        return None if info is not None and info.nothing_to_do else record.success

    def rows(self) -> list[dict[str, Any]]:
        """Plain rows, one for each record, with its case and machine: the columns of `records.csv`."""
        out = []
        for r in self.records:
            run, info = self.runs.get(r.run), self.cases.get(r.case)
            row = {f.name: getattr(r, f.name) for f in fields(r) if f.name != "sha"}
            row |= {
                "success": self.success(r),
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
        """For notebooks: how much there is."""
        solvers = sorted({r.solver for r in self.records})
        facts = {"runs": len(self.records), "cases": len(self.cases), "solvers": ", ".join(solvers)}
        return table_of(facts, self.source or "Records")

    def frame(self) -> Any:
        """`rows()` as a pandas frame.

        Raises
        ------
        ImportError
            pandas is not installed.
        """
        import pandas

        return pandas.DataFrame(self.rows())


# -- writing ----------------------------------------------------------------------------------------------


class Store:
    """Appends entries to a `.jsonl` file, which nobody else writes as long as it is open.

    Raises
    ------
    InputError
        The file cannot be written, another process writes it, or it holds something else; known before
        anything is solved.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self._real = as_path(path), destination(path)
        make_folder(self.path.parent)
        with contextlib.ExitStack() as held:
            held.enter_context(lock_output(self.path))
            try:
                self.records = read(self.path) if self.path.exists() else Records()
                _cut_torn_line(self.path)
                self.file = self.path.open("a", encoding="utf-8")
            except OSError as error:
                raise InputError(
                    f"cannot write {self.path} ({error.strerror or error}): give a folder that you may write to"
                ) from None
            self._lock = held.pop_all()
        self._synced = time.monotonic()

    def add(self, entry: Entry) -> None:
        """Write one entry and hand it to the operating system before anything else happens.

        Raises
        ------
        InputError
            No room: what was written before is there. Or the file is gone, which nobody else would tell.
        """
        line = json.dumps(to_json(entry), allow_nan=False)
        try:
            self.file.write(line + "\n")
            self.file.flush()
            if time.monotonic() - self._synced > SYNC:
                os.fsync(self.file.fileno())
                self._synced = time.monotonic()
                if not self._real.exists():
                    raise InputError(
                        f"{self.path} was removed while it was being written, with what it held: run the command "
                        "again, in a folder that stays"
                    )
        except OSError as error:
            raise InputError(
                f"cannot write {self.path} ({error.strerror or error}): make room and run the same command again; "
                "it goes on from the last record"
            ) from None
        self.records.add(entry)

    def close(self) -> None:
        """Close the file and let others write it; what the disk had no room for was reported when it was written."""
        with contextlib.suppress(OSError):
            self.file.close()
        self._lock.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def opened(store: Store | str | Path | None) -> Iterator[Store | None]:
    """A store as it is; of a path, one that is closed at the end."""
    if store is None or isinstance(store, Store):
        yield store
        return
    with Store(store) as made:
        yield made


def _cut_torn_line(path: Path) -> None:
    if not path.exists():
        return
    with path.open("rb+") as f:
        whole = sum(len(line) for line in f if line.endswith(b"\n"))
        if whole != f.tell():
            f.truncate(whole)


def read(path: str | Path) -> Records:
    """Read a `records.jsonl` (or the folder that holds one). A torn last line is left out.

    Raises
    ------
    InputError
        No such file, or a line that is not a record.
    """
    path = as_path(path)
    if path.is_dir():
        path = path / "records.jsonl"
    if path.exists() and not path.is_file():
        raise InputError(f"{path} is no file; a records.jsonl is needed")
    found = Records(source=str(path))
    for number, line in enumerate(_lines(path), 1):
        if not line.strip():
            continue
        try:
            entry = from_json(json.loads(line))
        except (ValueError, RecursionError) as error:
            raise InputError(f"{path}, line {number}: {error}; a records.jsonl is needed") from None
        if isinstance(entry, Record) and not (entry.case in found.cases and entry.run in found.runs):
            what = "case" if entry.run in found.runs else "run"
            raise InputError(
                f"{path}, line {number}: a record of a {what} that no line before it describes; "
                "a records.jsonl is needed, whole"
            )
        found.add(entry)
    # A measurement that was made again stands for the earlier one, in its place.
    newest = {(r.run, r.key): r for r in found.records}
    found.records = list(newest.values())
    return found


def _lines(path: Path) -> Iterator[str]:
    """Lines of a file without the mark that some editors put in front of UTF-8; the last is left out if it is torn."""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(
                f"{path} holds {size} bytes, more than {MAX_BYTES}; a records.jsonl is needed, of fewer cases"
            )
        with path.open("rb") as f:
            while line := f.readline(MOST_LINE):
                if not line.endswith(b"\n"):
                    if len(line) == MOST_LINE:
                        raise InputError(
                            f"{path} has a line of more than {MOST_LINE} bytes; a records.jsonl is needed"
                        )
                    return
                yield line[:-1].decode("utf-8", errors="replace").removeprefix("\ufeff")
    except OSError as error:
        raise InputError(
            f"cannot read {path} ({error.strerror or error}); a records.jsonl is needed"
        ) from None


def write_csv(records: Records, path: str | Path) -> None:
    """One row for each record; `work`, `options`, `versions`, `times` and `reached` are JSON in their cells."""
    rows = records.rows()
    columns = list(rows[0]) if rows else [f.name for f in fields(Record)]

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as f:
            writer = csv.DictWriter(f, columns)
            writer.writeheader()
            for row in rows:
                writer.writerow(
                    {k: json.dumps(plain(v)) if isinstance(v, (dict, tuple)) else v for k, v in row.items()}
                )

    write_atomically(path, write)


def write_json(records: Records, path: str | Path) -> None:
    """{"runs": [...], "cases": [...], "skips": [...], "records": [...]}; inf and nan are words."""

    def told(entries: Iterable[Any]) -> list[dict[str, Any]]:
        return [{k: v for k, v in to_json(e).items() if k != "kind"} for e in entries]

    content = {
        "runs": told(records.runs.values()),
        "cases": told(records.cases.values()),
        "skips": told(records.skips),
        "records": [
            {**entry, "success": records.success(r)}
            for entry, r in zip(told(records.records), records.records, strict=True)
        ],
    }
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")
