"""Hold the runs of a report: an entry for each run while it is measured, and a row of a DataFrame after."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from statistics import median
from typing import TYPE_CHECKING, Any

from lavender.base.errors import InputError, require_packages
from lavender.judge.solution import CLAIM_CHECKS, CONFIRMED
from lavender.report.text import escape_unprintable, format_tolerance

if TYPE_CHECKING:
    from pandas import DataFrame

# Statuses of a run that returned no solution, in addition to the statuses of a solve.
ERROR, KILLED, CRASHED = "ERROR", "KILLED", "CRASHED"


def describe_target(mode: str, tol: float, max_iter: int) -> str:
    """Describe the target of a run: "to 1e-6", or "16 iterations"."""
    return f"{max_iter} iterations" if mode == "budget" else f"to {format_tolerance(tol)}"


def _make_printable(value: Any, lines: bool = False) -> Any:
    """Make all texts in a value printable."""
    if isinstance(value, str):
        return escape_unprintable(value, lines)
    if isinstance(value, Mapping):
        return {_make_printable(k): _make_printable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(_make_printable, value))
    return value


class _PrintableEntry:
    """Base of entries: their texts are made printable; only messages may have several lines."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            kind = type(value)
            if (kind is str and not value.isprintable()) or (kind is not str and kind is not float and value and
                                                             isinstance(value, (str, tuple, Mapping))):  # fmt: skip
                object.__setattr__(self, name, _make_printable(value, name == "message"))


@dataclass(frozen=True)
class Run(_PrintableEntry):
    """One machine, one set of versions and one plan, to which records refer by `run`."""

    run: str  # Identity: equal if machine, versions and plan are equal.
    started: str  # ISO 8601, UTC.
    lavender: str
    python: str
    platform: str
    cpu: str
    cores: int
    threads: int  # Threads of BLAS and OpenMP while times are measured.
    versions: Mapping[str, str]
    plan: Mapping[str, Any]
    # Commit, hash of the kernels, compiler, BLAS, clock.
    build: Mapping[str, str] = field(default_factory=dict)
    load: float | None = None  # Mean number of runnable processes in the minute before the run.
    whole: bool = True  # Whether all measurements of the run were made; False while it runs.


@dataclass(frozen=True)
class CaseInfo(_PrintableEntry):
    """Description of a case for a report, without its problem."""

    run: str
    case: str
    source: str  # Path, or name in the suite.
    sha: str  # Hash of the numbers: a file with changed numbers is another case.
    law: str
    rows: int
    blocks: int
    contacts: int
    bodies: int  # 0 if only a matrix is known.
    nonzeros: int  # Nonzeros of A, or of J if A is not formed.
    mass_ratio: float  # Largest over smallest body mass, or entry of A's diagonal.
    structure: tuple[str, ...]  # "stack", "chain", "pile", "redundant", "friction", "large mass ratio", ...
    symmetric: bool
    reason: str = ""  # Property that the case tests.
    stored: float = math.nan  # Relative residual of the answer stored with the problem, such as an engine's.
    sequence: str = ""  # Sequence of which it is a step.
    step: int = -1
    nothing_to_do: bool = False  # The zero impulse is a solution: the case is not ranked.
    identity: str = ""  # Hash of the numbers of all steps of its sequence.
    stored_verdict: str = ""  # Verdict on a stored answer in float32.
    diagnostics: tuple[str, ...] = ()  # Likely mistakes in its data.
    guess: str = ""  # Kind of the problem's guess, "", "start" or "answer"; no run starts from an "answer".
    islands: int = 0  # Number of islands: sets of blocks connected through moving bodies or entries of A.


@dataclass(frozen=True)
class Skip(_PrintableEntry):
    """A solver that did not run on a case, or, with an empty `solver`, a case that did not load.

    `sequence` is the sequence of a step that did not load.
    """

    run: str
    case: str
    solver: str
    reason: str
    sequence: str = ""


@dataclass(frozen=True)
class Record(_PrintableEntry):
    """One run: one solver on one case with one budget or tolerance. Its fields are columns of `Records.frame`."""

    run: str
    case: str
    sha: str  # Hash of the case's numbers.
    solver: str
    start: str  # "cold": from the zero impulse; "warm": the problem's guess; "carried": the step before.
    mode: str  # "tol": to the residual `tol`; "budget": exactly `max_iter` iterations.
    tol: float
    max_iter: int
    time_limit: float  # [s]
    order: str = "given"  # Sweep order; "random:3" is random with seed 3.
    step: int = -1  # Step of a sequence; -1 for a single case.
    status: str = ""  # Name of a Status, ERROR, KILLED or CRASHED.
    relative: float = math.inf  # Relative residual by the judge, as the next three fields are.
    energy: float = math.inf  # [sqrt J] Residual in the energy norm.
    velocity: float = math.inf  # [m/s] Largest velocity error of a row.
    roundoff_floor: float = math.nan  # Relative residual that rounding alone can cause.
    worst_row: int = -1
    worst_name: str = ""
    success: bool = False  # By the judge, relative <= tol; False for a budget.
    claims: bool = False  # The solver claims a solution: CONVERGED, ROUNDOFF_LIMIT or INFEASIBLE.
    claim_check: str = CONFIRMED  # "confirmed", "not proven" or "contradicted", as in a Solution.
    status_conflict: str = ""  # Reason why the judge contradicts the status; empty if it does not.
    iterations: int = 0
    work: Mapping[str, int] = field(default_factory=dict)
    form: str = ""
    message: str = ""
    times: tuple[float, ...] = ()  # [s] Time of each repetition of the call; empty if no times are measured.
    # [s] Of the last repetition, without judge and checks, as the next field is.
    setup_time: float = math.nan
    solve_time: float = math.nan
    # [s] Time of a loop of fixed work, which measures the machine's speed.
    calibration_time: float | None = None
    load: float | None = None  # Number of runnable processes when the record was made, including this one.
    solution_hash: str = ""  # Hash of the answer: equal for answers with equal bits.

    @property
    def key(self) -> tuple[Any, ...]:
        """Key that is equal for records of the same measurement."""
        return make_measurement_key(self)

    @property
    def time(self) -> float:
        """Smallest time of a repetition [s]; nan without times."""
        return min(self.times, default=math.nan)


def make_measurement_key(m: Any) -> tuple[Any, ...]:
    """Return the key of a measurement from its `Task` or its `Record`."""
    return tuple(getattr(m, name) for name in _KEY_NAMES[1:])


Entry = Run | CaseInfo | Skip | Record
KINDS: dict[str, type] = {"run": Run, "case": CaseInfo, "skip": Skip, "record": Record}
RECORD_FIELDS = [f.name for f in fields(Record)]
_WORK_PLACE, _MESSAGE_PLACE = map(RECORD_FIELDS.index, ("work", "message"))
_KEY_NAMES = ("run", "case", "sha", "solver", "start", "mode", "tol", "max_iter", "time_limit", "order")
RECORD_DEFAULTS = {
    f.name: f.default if f.default_factory is MISSING else f.default_factory()
    for f in fields(Record)
    if f.default is not MISSING or f.default_factory is not MISSING
}
#: Columns of a case and of a machine in a frame.
CASE_COLUMNS = (
    "law", "rows", "blocks", "islands", "contacts", "mass_ratio", "sequence", "nothing_to_do", "symmetric"
)  # fmt: skip
RUN_COLUMNS = ("started", "cpu", "cores", "threads", "platform", "python", "lavender")


def to_json(entry: Entry) -> dict[str, Any]:
    """Convert an entry to a dictionary that JSON can hold: inf and nan become strings."""
    kind = next(name for name, cls in KINDS.items() if isinstance(entry, cls))
    return {"kind": kind, **{f.name: to_jsonable(getattr(entry, f.name)) for f in fields(entry)}}


def from_json(line: Any) -> Entry:
    """Convert a dictionary back to an entry; unknown fields are ignored.

    Raises
    ------
    ValueError
        It is not an entry of a records file: a field is missing, has another type or is out of its range.
    """
    if not isinstance(line, Mapping) or not isinstance(line.get("kind"), str) or line["kind"] not in KINDS:
        raise ValueError(
            f"not an entry of a records file; a JSON object with a kind is needed, one of {', '.join(KINDS)}"
        )
    cls = KINDS[line["kind"]]
    try:
        return cls(**parse_fields(cls, line))
    except (TypeError, ValueError) as error:
        raise ValueError(f"the line is not a valid entry of kind {line['kind']!r}: {error}") from None


def parse_fields(cls: Any, line: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a data class that a line of JSON contains, converted and checked.

    Raises
    ------
    ValueError
        A field has another type than declared, or is out of its range.
    """
    values = {}
    for name, declared, (needed, is_valid) in _list_rules(cls):
        if name not in line:
            continue
        value = line[name]
        if declared == "str":
            if type(value) is not str:
                raise ValueError(f"{name} is {value!r:.60}; a text is needed")
        elif declared[0] == "f" and type(value) is not float:
            value = _to_float(value)
        elif isinstance(value, list) and declared[0] == "t":
            value = tuple(map(_to_float, value) if "float" in declared else value)
        if not is_valid(value):
            raise ValueError(f"{name} is {value!r:.60}; {needed} is needed")
        values[name] = value
    return values


@cache
def _list_rules(cls: Any) -> list[tuple[str, str, _Rule]]:
    """Return (name, declared type, rule) for each field of a data class."""
    declared = {f.name: str(f.type) for f in fields(cls) if str(f.type) in _RULES}
    return [(name, kind, _RANGES.get((cls.__name__, name), _RULES[kind])) for name, kind in declared.items()]


def _to_float(value: Any) -> Any:
    """Convert an integer, or "inf" or "nan", to float; return other values unchanged."""
    is_word = isinstance(value, str) and value in ("inf", "-inf", "nan")
    return float(value) if is_word or _is_integer(value) else value


def _is_integer(value: Any, low: int = -(2**63)) -> bool:
    """Whether a value is a 64-bit integer of at least `low`."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value < 2**63


def _is_size(value: Any) -> bool:
    """Whether a value is a float that is not negative; nan is accepted."""
    return isinstance(value, float) and not value < 0.0


def _is_flat(value: Any) -> bool:
    """Whether a value is a number, a string, None or a list of these, as plans hold."""
    if isinstance(value, list):
        return all(_is_flat(v) and not isinstance(v, list) for v in value)
    return value is None or isinstance(value, (bool, str, float)) or _is_integer(value)


def _is_mapping(value: Any, is_valid: Callable[[Any], bool]) -> bool:
    """Whether a value is a mapping from strings to values that `is_valid` accepts."""
    return isinstance(value, Mapping) and all(isinstance(k, str) and is_valid(v) for k, v in value.items())


def _is_positive(value: Any) -> bool:
    """Whether a value is a finite positive number."""
    return (_is_integer(value) or isinstance(value, float)) and math.isfinite(value) and value > 0


def _is_valid_plan(plan: Any) -> bool:
    """Whether a value is a plan with positive tolerances."""
    tolerances = plan.get("tolerances", []) if isinstance(plan, Mapping) else None
    return _is_mapping(plan, _is_flat) and isinstance(tolerances, list) and all(map(_is_positive, tolerances))


_Rule = tuple[str, Callable[[Any], bool]]
_COUNT: _Rule = ("a whole number of 0 or more", lambda v: _is_integer(v, 0))
#: Description and test of the values of each declared type in a file.
_RULES: dict[str, _Rule] = {
    "str": ("a text", lambda v: isinstance(v, str)),
    "int": ("a whole number", _is_integer),
    "float": ("a number of 0 or more", _is_size),
    "float | None": ("a number of 0 or more, or nothing", lambda v: v is None or _is_size(v)),
    "bool": ("true or false", lambda v: isinstance(v, bool)),
    "tuple[float, ...]": ("a list of numbers of 0 or more", lambda v: isinstance(v, tuple) and all(map(_is_size, v))),
    "tuple[str, ...]": ("a list of words", lambda v: isinstance(v, tuple) and all(isinstance(x, str) for x in v)),
    "Mapping[str, Any]": ("a table of numbers and words", lambda v: _is_mapping(v, _is_flat)),
    "Mapping[str, str]": ("a table of words", lambda v: _is_mapping(v, lambda x: isinstance(x, str))),
    "Mapping[str, int]": ("a table of whole numbers", lambda v: _is_mapping(v, _COUNT[1])),
}  # fmt: skip
#: Description and test of the range of a field.
_RANGES: dict[tuple[str, str], _Rule] = {
    ("Run", "plan"): ("a plan with positive tolerances", _is_valid_plan),
    ("Record", "start"): ("cold, warm or carried", lambda v: v in ("cold", "warm", "carried")),
    ("Record", "mode"): ("tol or budget", lambda v: v in ("tol", "budget")),
    ("Record", "claim_check"): ("confirmed, not proven or contradicted", lambda v: v in CLAIM_CHECKS),
    ("Record", "tol"): ("a finite number of 0 or more", lambda v: _is_size(v) and v < math.inf),
    ("Record", "time_limit"): ("a positive number of seconds", _is_positive),
    **{(kind, name): _COUNT for kind in ("Record", "Outcome") for name in ("max_iter", "iterations")},
}


def to_jsonable(value: Any) -> Any:
    """Convert a value to one that JSON can hold: inf and nan become strings."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return {str(k): to_jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_jsonable(v) for v in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    return to_jsonable(value.tolist()) if hasattr(value, "tolist") else str(value)


class Records:
    """Runs of one or more measurements, with their machines, cases and pairs that did not run.

    Iteration gives a `Record` for each run, `frame` a DataFrame with one row for each run.
    """

    def __init__(self, source: str = "") -> None:
        self.source = source
        self.runs: dict[str, Run] = {}
        self.cases: dict[str, CaseInfo] = {}  # The latest description of each case.
        self._skips: dict[tuple[str, str, str], Skip] = {}
        self._sequences: dict[str, str] = {}  # The identity of each sequence in its latest description.
        self._columns: dict[str, list[Any]] = {name: [] for name in RECORD_FIELDS}
        self._places: dict[tuple[Any, ...], int] = {}  # Place of each measurement in the columns.
        self._texts: dict[str, str] = {}
        self._frame: DataFrame | None = None

    @property
    def skips(self) -> list[Skip]:
        """Pairs that did not run, and cases that did not load."""
        return list(self._skips.values())

    @property
    def left_out(self) -> dict[str, list[Skip]]:
        """Cases that did not load, by sequence ("" for single cases). No number of a report counts them."""
        skips: dict[str, list[Skip]] = {}
        for skip in self._skips.values():
            if not skip.solver:
                skips.setdefault(skip.sequence, []).append(skip)
        return skips

    def add(self, entry: Entry) -> None:
        """Add one entry. It replaces an earlier entry on the same machine, case, pair or measurement."""
        self._frame = None
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
            self.add_values(vars(entry))

    def add_values(self, values: Mapping[str, Any]) -> None:
        """Add a record by the values of its fields, which `parse_fields` accepts."""
        self._frame = None
        key = tuple(values[name] for name in _KEY_NAMES)
        row = [self._add_text(v) if type(v) is str else v for v in map(values.__getitem__, RECORD_FIELDS)]
        row[_WORK_PLACE] = self._add_text(json.dumps(dict(values["work"])))
        row[_MESSAGE_PLACE] = escape_unprintable(values["message"], lines=True)
        place = self._places.setdefault(key, len(self))
        is_new = place == len(self)
        for column, value in zip(self._columns.values(), row, strict=True):
            if is_new:
                column.append(value)
            else:
                column[place] = value

    def _add_text(self, text: str) -> str:
        """Return a text in printable form; equal texts, of which most occur many times, are one object."""
        known = self._texts.get(text)
        if known is None:
            known = self._texts[text] = escape_unprintable(text)
        return known

    def __len__(self) -> int:
        return len(self._columns["run"])

    def __iter__(self) -> Iterator[Record]:
        for values in zip(*self._columns.values(), strict=True):
            found = dict(zip(RECORD_FIELDS, values, strict=True))
            yield Record(**{**found, "work": json.loads(found["work"])})

    @property
    def frame(self) -> DataFrame:
        """One row for each run: fields of `Record`, its case and its machine; docs/report.md lists the columns."""
        if self._frame is None:
            require_packages("a table of runs", "pandas")
            import pandas as pd

            columns: dict[str, Any] = dict(self._columns)
            times = columns.pop("times")
            columns["time"] = [min(t, default=math.nan) for t in times]
            columns["time_median"] = [median(t) if t else math.nan for t in times]
            columns["repetitions"] = list(map(len, times))
            frame = pd.DataFrame(columns)
            for name in ("relative", "energy", "velocity", "calibration_time", "load"):
                frame[name] = frame[name].astype(float)
            cases = {n: {c: getattr(i, c) for c in CASE_COLUMNS} for n, i in self.cases.items()}
            for n, info in self.cases.items():
                cases[n]["structure"] = ", ".join(info.structure)
            runs = {n: {c: getattr(r, c) for c in RUN_COLUMNS} for n, r in self.runs.items()}
            for n, run in self.runs.items():
                runs[n]["versions"] = ", ".join(f"{name} {v}" for name, v in run.versions.items())
            for key, table, names in (
                ("case", cases, (*CASE_COLUMNS, "structure")),
                ("run", runs, (*RUN_COLUMNS, "versions")),
            ):
                for name in names:
                    values = {k: entry[name] for k, entry in table.items()}
                    frame[name] = frame[key].map(values)
            for name in _TEXT_COLUMNS & set(frame):
                frame[name] = frame[name].astype("category")
            self._frame = frame
        return self._frame

    @property
    def latest_frame(self) -> DataFrame:
        """The rows of the run that wrote last, of cases with unchanged numbers.

        Times are compared only within one run, and a file that has changed is another problem.
        """
        frame = self.frame
        if not len(frame) or not self.runs:
            return frame
        numbers = frame["case"].map({name: info.sha for name, info in self.cases.items()}).astype(str)
        same = (frame["sha"].astype(str) == numbers) & frame["case"].isin(list(self.cases))
        return frame[same & (frame["run"] == list(self.runs)[-1])]

    def select_solvers(self, names: Iterable[str]) -> Records:
        """Return the records of some solvers, with the notes about them and all cases.

        Raises
        ------
        InputError
            There are no records of a solver.
        """
        wanted = list(names)
        known = sorted({*self._columns["solver"], *(s.solver for s in self.skips if s.solver)})
        for name in wanted:
            if name not in known:
                raise InputError(f"no records of solver {name!r}; there are records of {', '.join(known)}")
        selection = Records(self.source)
        for entry in (*self.runs.values(), *self.cases.values(), *self.skips, *self):
            if getattr(entry, "solver", "") in ("", *wanted):
                selection.add(entry)
        return selection


#: Columns of texts that occur many times.
_TEXT_COLUMNS = {
    "run", "case", "sha", "solver", "start", "mode", "order", "status", "worst_name", "claim_check", "status_conflict",
    "work", "form", "message", "law", "sequence", "structure", "started", "cpu", "platform", "python", "lavender",
    "versions",
}  # fmt: skip
