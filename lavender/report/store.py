"""Write and read `records.jsonl`: one JSON object in a line for each machine, case, run, and pair that did not run.

A measurement makes a dictionary, the store appends it as a line, and `read` returns all lines as one DataFrame, which
`select_runs`, `select_cases` and `select_skips` divide. docs/report.md lists the columns of runs with their units.

Lines are appended and flushed as they are made. A measurement that was killed leaves at most one incomplete line, the
last one, which is removed before the next line is written.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from lavender.base.errors import InputError, require_packages
from lavender.base.lazy_import import pandas as pd
from lavender.io.stored import as_path, make_folder, read_bytes
from lavender.judge.solution import CONFIRMED
from lavender.report.text import format_tolerance

Row: TypeAlias = dict[str, Any]  # Content of one line.
KINDS = ("machine", "case", "run", "skip")
ERROR = "ERROR"  # Status of a run whose solver raised an exception; other runs have a status of `Status`.
#: Columns that are equal in two lines about the same measurement; the later line counts.
KEY = ("run", "case", "sha", "solver", "start", "mode", "tol", "max_iter", "time_limit")
#: Columns of runs with their defaults, which are the values of a run without an answer and determine the types.
RUN_COLUMNS: Row = {
    "run": "",
    "case": "",
    "sha": "",
    "solver": "",
    "start": "cold",
    "mode": "tol",
    "tol": math.nan,
    "max_iter": 0,
    "time_limit": math.nan,
    "step": -1,
    "status": "",
    "relative": math.inf,
    "error_energy": math.inf,
    "velocity": math.inf,
    "roundoff_floor": math.nan,
    "energy_change": math.nan,
    "energy_gain": math.nan,
    "motion_error": math.nan,
    "worst_row": -1,
    "worst_name": "",
    "success": False,
    "claims": False,
    "claim_check": CONFIRMED,
    "status_conflict": "",
    "iterations": 0,
    "work": "{}",
    "form": "",
    "message": "",
    "time": math.nan,
    "time_median": math.nan,
    "repetitions": 0,
    "carry_time": math.nan,
    "setup_time": math.nan,
    "solve_time": math.nan,
    "calibration_time": math.nan,
    "load": math.nan,
    "solution_hash": "",
    "times": (),
}
#: Columns of cases with their defaults. The second line of names is not repeated in the rows of runs.
CASE_COLUMNS: Row = {
    "law": "",
    "rows": 0,
    "blocks": 0,
    "islands": 0,
    "contacts": 0,
    "mass_ratio": math.nan,
    "structure": "",
    "symmetric": True,
    "sequence": "",
    "nothing_to_do": False,
    "variables": 0,
}
CASE_DETAILS: Row = {
    "run": "",
    "case": "",
    "sha": "",
    "step": -1,
    "source": "",
    "identity": "",
    "guess": "",
    "stored": math.nan,
    "diagnostics": (),
}
SKIP_COLUMNS: Row = {"run": "", "case": "", "solver": "", "reason": "", "sequence": ""}
MACHINE_COLUMNS = ("started", "cpu", "cores", "threads", "platform", "python", "lavender")


def describe_target(mode: str, tol: float, max_iter: int) -> str:
    """Describe the target of a run: "to 1e-6", or "16 iterations"."""
    return f"{max_iter} iterations" if mode == "budget" else f"to {format_tolerance(tol)}"


def get_key(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the key of a measurement from its row: the values of the columns `KEY`."""
    return tuple(row[name] for name in KEY)


def to_jsonable(value: Any) -> Any:
    """Convert a value to one that JSON can hold: inf and nan become strings."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if value is None or isinstance(value, (int, str)):
        return value
    if isinstance(value, Mapping):
        return {str(k): to_jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return list(map(to_jsonable, value))
    return to_jsonable(value.tolist()) if hasattr(value, "tolist") else str(value)


# -- lines -------------------------------------------------------------------------------------------------


class Store:
    """Appends rows to a `.jsonl` file.

    `lines` is the DataFrame of the lines that the file had when it was opened.

    Raises
    ------
    InputError
        The file cannot be written, or it has other content.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = as_path(path)
        make_folder(self.path.parent)
        try:
            self.lines = read(self.path) if self.path.exists() else make_lines([])
            if self.lines.attrs.get("dropped"):
                with self.path.open("rb+") as f:
                    f.truncate(f.read().rfind(b"\n") + 1)
            self.file = self.path.open("a", encoding="utf-8")
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror or error}") from None

    def add(self, row: Row) -> None:
        """Write one row and flush it to the operating system before returning.

        Raises
        ------
        InputError
            The disk is full; earlier rows are stored.
        """
        line = json.dumps(to_jsonable(row), allow_nan=False)
        try:
            self.file.write(line + "\n")
            self.file.flush()
        except OSError as error:
            raise InputError(
                f"cannot write {self.path} ({error.strerror or error}): free disk space and run the same command "
                "again; it continues after the last record"
            ) from None

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):  # `add` has raised errors of the disk.
            self.file.close()


def make_lines(rows: Iterable[Row], source: str = "", dropped: int = 0) -> pd.DataFrame:
    """Return a DataFrame with a row for each of `rows`, as `read` does.

    Its `attrs` have `source` and the number of incomplete lines that were `dropped`.
    """
    require_packages("a table of runs", "pandas")
    lines = pd.DataFrame(list(rows))
    lines = lines if "kind" in lines else pd.DataFrame({"kind": pd.Series(dtype=object)})
    lines.attrs = {"source": source, "dropped": dropped}
    return lines


def read(path: str | Path) -> pd.DataFrame:
    """Read a file `records.jsonl`, or the one in a folder, as a DataFrame with a row for each line.

    An incomplete last line, which a killed measurement leaves, is dropped and counted in `attrs["dropped"]`.

    Raises
    ------
    InputError
        The file does not exist, or a line is not a record.
    """
    require_packages("a table of runs", "pandas")
    path = as_path(path)
    path = path / "records.jsonl" if path.is_dir() else path
    content = read_bytes(path, "records")
    dropped = len(content) - content.rfind(b"\n") - 1
    # Editors of some systems begin a file, and so each part of joined files, with a byte order mark.
    whole = content[: content.rfind(b"\n") + 1].replace(b"\xef\xbb\xbf", b"")
    try:
        with (
            warnings.catch_warnings()
        ):  # Recent versions of pandas need and know no `convert_dates`.
            warnings.simplefilter("ignore")
            lines = pd.read_json(
                io.BytesIO(whole),
                lines=True,
                dtype=False,
                convert_dates=False,
                precise_float=True,
                encoding_errors="replace",
            )
        if len(lines) and not ("kind" in lines and lines["kind"].isin(KINDS).all()):
            raise ValueError(f"each line needs a kind, one of {', '.join(KINDS)}")
        lines = lines if len(lines) else make_lines([])
        lines.attrs = {"source": str(path), "dropped": int(dropped > 0)}
        select_runs(lines)  # Raises an error if a column has values of another type.
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(
            f"{path} is not a records.jsonl that `lavender report` wrote: {error}"
        ) from None
    return lines


# -- parts -------------------------------------------------------------------------------------------------


def convert_columns(lines: pd.DataFrame, kind: str, columns: Row) -> pd.DataFrame:
    """Return the lines of one kind with these columns, in the types of the defaults, which replace missing values."""
    some = lines[lines["kind"] == kind]
    converted = {}
    for name, default in columns.items():
        values = some[name] if name in some else pd.Series(None, index=some.index, dtype=object)
        if not (known := values.notna()).all():
            values = (
                values.astype(object)
                .where(known, None)
                .map(lambda x, y=default: y if x is None else x)
            )
        if isinstance(default, tuple):
            values = values.map(list)
        elif isinstance(default, str):
            values = values.astype(str).astype("category")
        else:
            values = values.astype("int64" if type(default) is int else type(default))
        converted[name] = values
    return pd.DataFrame(converted, index=some.index)


def select_runs(lines: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each run, with facts about its case and its machine; docs/report.md lists the columns.

    Raises
    ------
    InputError
        No line describes the case or the machine of a run.
    """
    runs = (
        convert_columns(lines, "run", RUN_COLUMNS)
        .drop(columns="times")
        .drop_duplicates(KEY, keep="last")
    )
    cases, machines = select_cases(lines), select_machines(lines)
    described = convert_columns(lines, "case", {"case": ""})["case"].unique()
    for name, known in (("case", described), ("run", machines)):
        if not runs[name].isin(list(known)).all():
            raise InputError(
                f"{lines.attrs.get('source') or 'lines'}: a record belongs to a {name} that no line describes; a "
                "complete records.jsonl is needed: copy the whole file"
            )
    case, run = runs["case"].astype(object), runs["run"].astype(object)
    facts = {name: case.map(cases[name].to_dict()) for name in CASE_COLUMNS}
    for name in (*MACHINE_COLUMNS, "versions"):
        facts[name] = run.map({r: machine.get(name) for r, machine in machines.items()})
    facts["versions"] = run.map(
        {
            r: ", ".join(f"{name} {v}" for name, v in machine["versions"].items())
            for r, machine in machines.items()
        }
    )
    runs = runs.assign(**facts).reset_index(drop=True)
    runs.loc[runs["law"] == "program", ["velocity", "error_energy"]] = math.nan
    texts = [name for name in facts if runs[name].dtype.kind not in "biuf"]
    return runs.astype(dict.fromkeys(texts, "category"))


def select_cases(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the last description of each case, by its name; of two sequences with one name, the steps of the last."""
    cases = convert_columns(lines, "case", CASE_DETAILS | CASE_COLUMNS).drop_duplicates(
        "case", keep="last"
    )
    cases = cases.astype(
        dict.fromkeys(("case", "sequence", "identity", "source", "structure"), object)
    )
    latest = cases.groupby("sequence")["identity"].last()
    cases = cases[(cases["identity"] == cases["sequence"].map(latest)) | (cases["sequence"] == "")]
    return cases.set_index("case", drop=False)


def select_skips(lines: pd.DataFrame) -> pd.DataFrame:
    """Return the pairs that did not run, and with an empty `solver` the cases that did not load and never loaded later.

    `sequence` is the sequence of a step that did not load.
    """
    skips = convert_columns(lines, "skip", SKIP_COLUMNS)
    skips = skips.drop_duplicates(["run", "case", "solver"], keep="last")
    loaded = convert_columns(lines, "case", {"run": "", "case": ""})
    last = dict(zip(zip(loaded["run"], loaded["case"], strict=True), loaded.index, strict=True))
    is_open = [
        bool(r.solver) or last.get((r.run, r.case), -1) < r.Index for r in skips.itertuples()
    ]
    return skips.loc[skips.index[np.array(is_open, bool)]].astype(object)


def select_machines(lines: pd.DataFrame) -> dict[str, Row]:
    """Return the last description of each machine with its versions and plan, by its run, in order of time."""
    machines: dict[str, Row] = {}
    defaults = {
        "run": "",
        "started": "",
        "lavender": "",
        "python": "",
        "platform": "",
        "cpu": "",
        "cores": 1,
        "threads": 1,
        "load": math.nan,
        "whole": True,
    }
    texts = convert_columns(lines, "machine", defaults).astype(
        dict.fromkeys(("run", "cpu"), object)
    )
    for i, row in zip(texts.index, texts.to_dict("records"), strict=True):
        parts = {
            name: lines[name].get(i) if name in lines else {}
            for name in ("versions", "plan", "build")
        }
        machines.pop(row["run"], None)
        machines[row["run"]] = {**row, **parts}
    return machines


def select_solvers(lines: pd.DataFrame, names: Iterable[str]) -> pd.DataFrame:
    """Return the lines about some solvers, and the lines about machines and cases."""
    own = lines["solver"] if "solver" in lines else lines["kind"].map({})
    known = sorted({str(name) for name in own.dropna()} - {""})
    names = list(names)
    for name in names:
        if name not in known:
            raise InputError(
                f"no records of solver {name!r}; there are records of {', '.join(known)}"
            )
    return lines[own.isna() | own.isin(["", *names])]
