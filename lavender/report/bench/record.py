"""Entries of a report: a run, a case, a solver that did not run, and a measurement; their JSON form."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from lavender.judge.solution import CLAIM_CHECKS, CONFIRMED

# Statuses of a run that returned no solution, in addition to the statuses of a solve.
ERROR, KILLED, CRASHED = "ERROR", "KILLED", "CRASHED"


def format_tolerance(tolerance: float) -> str:
    """Format a tolerance without leading zeros in its exponent: 1e-3, not 1e-03."""
    mantissa, _, exponent = f"{tolerance:.3e}".partition("e")
    mantissa = mantissa.rstrip("0").rstrip(".")
    return f"{mantissa}e{int(exponent)}"


def describe_target(mode: str, tol: float, max_iter: int) -> str:
    """Describe the target of a run: "to 1e-6", or "16 iterations"."""
    return f"{max_iter} iterations" if mode == "budget" else f"to {format_tolerance(tol)}"


MAX_FILE_NAME_LENGTH = 120  # [characters] File systems accept 255 bytes, including a suffix.


def make_file_name(name: str) -> str:
    """Convert a name to one that every file system and URL fragment accepts; a hash keeps long names distinct."""
    short = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("_.") or "figure"
    if len(short) <= MAX_FILE_NAME_LENGTH:
        return short
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:12]
    return f"{short[: MAX_FILE_NAME_LENGTH - 13]}-{digest}"


#: Characters that no text of a report contains: controls, lone surrogates, line ends, marks of writing direction.
_UNPRINTABLE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
_ESCAPE_SEQUENCES = {"\n": "\\n", "\t": "\\t", "\r": "\\r"}


def escape_unprintable(text: str, lines: bool = False) -> str:
    """Replace characters that a terminal, file or page cannot show by their codes.

    A byte of a file name that is not UTF-8 (a lone surrogate in Python's string) is written as this byte. With
    `lines`, line ends and tabs are kept, as in messages; without, the result is one line.
    """
    if text.isprintable():
        return text

    def escape(match: re.Match[str]) -> str:
        if lines and match[0] in "\n\t":
            return match[0]
        code = ord(match[0])
        if 0xDC80 <= code <= 0xDCFF:
            code -= 0xDC00
        return _ESCAPE_SEQUENCES.get(match[0]) or (f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}")

    return _UNPRINTABLE.sub(escape, text)


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
            if isinstance(value, (str, tuple, Mapping)):
                object.__setattr__(self, name, _make_printable(value, name == "message"))


@dataclass(frozen=True)
class Run(_PrintableEntry):
    """One machine, one set of versions and one plan, to which records refer by `run`.

    Parameters
    ----------
    run : str
        Identity: equal if machine, versions and plan are equal.
    started : str
        ISO 8601, UTC.
    lavender, python, platform, cpu : str
    cores : int
    threads : int
        Threads of BLAS and OpenMP while times are measured.
    versions : mapping
    plan : mapping
    build : mapping
        Commit, hash of the kernels, compiler, BLAS, clock.
    load : float or None
        Mean number of runnable processes in the minute before the run.
    whole : bool
        Whether all measurements of the run were made; False while it runs.
    """

    run: str
    started: str
    lavender: str
    python: str
    platform: str
    cpu: str
    cores: int
    threads: int
    versions: Mapping[str, str]
    plan: Mapping[str, Any]
    build: Mapping[str, str] = field(default_factory=dict)
    load: float | None = None
    whole: bool = True


@dataclass(frozen=True)
class CaseInfo(_PrintableEntry):
    """Description of a case for a report, without its problem.

    Parameters
    ----------
    run, case : str
    source : str
        Path, or name in the suite.
    sha : str
        Hash of the numbers: a file with changed numbers is another case.
    law : str
    rows, blocks, contacts : int
    bodies : int
        0 if only a matrix is known.
    nonzeros : int
        Number of nonzeros of A, or of J if A is not formed.
    mass_ratio : float
        Largest over smallest body mass, or entry of A's diagonal.
    structure : tuple of str
        "stack", "chain", "pile", "redundant", "friction", "large mass ratio", ...
    symmetric : bool
    reason : str
        Property that the case tests.
    stored : float
        Relative residual of the answer stored with the problem, such as an engine's.
    sequence : str
        Sequence of which it is a step.
    step : int
    nothing_to_do : bool
        The zero impulse is a solution: the case is not ranked.
    identity : str
        Hash of the numbers of all steps of its sequence: equal only for steps of the same sequence.
    stored_verdict : str
        Verdict on a stored answer in float32: at its floor, stopped before convergence (by how much), or wrong.
    diagnostics : tuple of str
        Likely mistakes in its data.
    guess : {"", "start", "answer"}
        Kind of the problem's guess; no run starts from an "answer".
    condition : float or None
        Condition number of A on its range, scaled to a unit diagonal; None if it was not computed.
    """

    run: str
    case: str
    source: str
    sha: str
    law: str
    rows: int
    blocks: int
    contacts: int
    bodies: int
    nonzeros: int
    mass_ratio: float
    structure: tuple[str, ...]
    symmetric: bool
    reason: str = ""
    stored: float = math.nan
    sequence: str = ""
    step: int = -1
    nothing_to_do: bool = False
    identity: str = ""
    stored_verdict: str = ""
    diagnostics: tuple[str, ...] = ()
    guess: str = ""
    condition: float | None = None


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
    """One solver on one case with one budget, tolerance or time limit.

    Parameters
    ----------
    run, case : str
    sha : str
        Hash of the case's numbers.
    solver : str
    options : mapping
    start : {"cold", "warm", "carried"}
        From the zero impulse, from the problem's guess, or from the impulses of the step before.
    mode : {"tol", "budget", "time"}
        "tol": to the residual `tol`; "budget": exactly `max_iter` iterations; "time": to `tol`, until `time_limit`.
    tol : float
    max_iter : int
    time_limit : float, s
    order : str
    seed : int
    status : str
        Name of a Status, ERROR, KILLED or CRASHED.
    relative : float
        Relative residual, computed by the judge, as `energy`, `velocity` and `roundoff_floor` are.
    energy : float, sqrt J
        Residual in the energy norm.
    velocity : float, m/s
        Largest velocity error of a row.
    roundoff_floor : float
        Relative residual that rounding alone can cause.
    solution_hash : str
        Hash of the answer: equal for answers with equal bits.
    worst_row : int
    worst_name : str
    success : bool
        By the judge, relative <= tol; False for a budget.
    claim_check : {"confirmed", "not proven", "contradicted"}
        As in a Solution.
    status_conflict : str
        Reason why the judge contradicts the status; empty if it does not.
    claims : bool
        The solver claims a solution: CONVERGED, ROUNDOFF_LIMIT or INFEASIBLE.
    iterations : int
    work : mapping
    form, message : str
    repeats : int
    setup_min, setup_median, solve_min, solve_median : float, s
    time_min, time_median : float, s
        Time of one repeat: of the call that `timing_mode` names, or else of set-up and solve together.
    threads : int
    step : int
        Step of a sequence; -1 for a single case.
    timing_mode : {"", "call", "steps", "batch"}
        Timed call. "call": one `lv.solve` on a new problem; "steps": the same in a loop that carries impulses;
        "batch": a problem's share of one `lv.solve_many`; "": prepare and solve, without judge and input validation.
    interleave_group : str
        Identifies the calls and cases that alternated with this one; "" if its repeats were consecutive.
    times : tuple of float, s
        Time of each repeat.
    residual_per_repeat : tuple of float
        Relative residual of each repeat, if they differ (mode "time").
    calibration_time : float or None, s
        Time of a loop of fixed work next to the repeats, which measures the machine's speed.
    load : float or None
        Number of runnable processes when the record was made, including this one.
    backend_time_min : float or None, s
        Minimum time of a third-party backend's own solve, on data that it already held.
    """

    run: str
    case: str
    sha: str
    solver: str
    options: Mapping[str, Any]
    start: str
    mode: str
    tol: float
    max_iter: int
    time_limit: float
    order: str
    seed: int
    status: str
    relative: float = math.inf
    energy: float = math.inf
    velocity: float = math.inf
    roundoff_floor: float = math.nan
    solution_hash: str = ""
    worst_row: int = -1
    worst_name: str = ""
    success: bool = False
    claim_check: str = CONFIRMED
    status_conflict: str = ""
    claims: bool = False
    iterations: int = 0
    work: Mapping[str, int] = field(default_factory=dict)
    form: str = ""
    message: str = ""
    repeats: int = 0
    setup_min: float = math.nan
    setup_median: float = math.nan
    solve_min: float = math.nan
    solve_median: float = math.nan
    time_min: float = math.nan
    time_median: float = math.nan
    threads: int = 1
    step: int = -1
    timing_mode: str = ""
    interleave_group: str = ""
    times: tuple[float, ...] = ()
    residual_per_repeat: tuple[float, ...] = ()
    calibration_time: float | None = None
    load: float | None = None
    backend_time_min: float | None = None

    @property
    def key(self) -> tuple[Any, ...]:
        """Key that is equal for records of the same measurement."""
        return make_measurement_key(self)

    @property
    def target(self) -> str:
        """Budget or tolerance, and the sweep order if it is not "given"."""
        order = "" if self.order == "given" else f", order {self.order}"
        return describe_target(self.mode, self.tol, self.max_iter) + order

    @property
    def is_usable(self) -> bool:
        """Whether the run returned a finite residual and a time."""
        return math.isfinite(self.relative) and math.isfinite(self.time_min)


def make_measurement_key(measurement: Any) -> tuple[Any, ...]:
    """Return the key of a measurement from its `Task` or its `Record`."""
    m = measurement
    options = repr(sorted(to_jsonable(m.options).items()))
    request = (m.start, m.mode, m.tol, m.max_iter, m.time_limit, m.timing_mode, m.interleave_group)
    return (m.case, m.sha, m.solver, options, *request)


Entry = Run | CaseInfo | Skip | Record
KINDS: dict[str, type] = {"run": Run, "case": CaseInfo, "skip": Skip, "record": Record}


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
    for f in fields(cls):
        kind = str(f.type)
        if f.name not in line or kind not in _TYPES:
            continue
        value = line[f.name]
        if kind.startswith("float") and (
            _is_integer(value) or (_is_string(value) and value in ("inf", "-inf", "nan"))
        ):
            value = float(value)
        elif kind.startswith("tuple") and isinstance(value, list):
            value = tuple(map(_to_float, value) if "float" in kind else value)
        expected, is_valid = _TYPES[kind]
        if not is_valid(value):
            raise ValueError(f"{f.name} is {value!r:.60}; {expected} is needed")
        rule = _RANGES.get((cls.__name__, f.name)) or (_RANGES[""] if isinstance(value, float) else None)
        if rule and not rule[1](value):
            raise ValueError(f"{f.name} is {value!r:.60}; {rule[0]} is needed")
        values[f.name] = value
    return values


def _to_float(value: Any) -> Any:
    """Convert an integer, or "inf" or "nan", to float; return other values unchanged."""
    return float(value) if _is_integer(value) or value in ("inf", "nan") else value


def _is_integer(value: Any) -> bool:
    """Whether a value is a 64-bit integer."""
    return isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63


def _is_flat(value: Any) -> bool:
    """Whether a value is a number, a string, None or a list of these, as options and plans hold."""
    if isinstance(value, list):
        return all(_is_flat(v) and not isinstance(v, list) for v in value)
    return value is None or isinstance(value, (bool, str, float)) or _is_integer(value)


def _is_mapping(value: Any, is_valid: Callable[[Any], bool]) -> bool:
    """Whether a value is a mapping from strings to values that `is_valid` accepts."""
    return isinstance(value, Mapping) and all(isinstance(k, str) and is_valid(v) for k, v in value.items())


def _is_string(value: Any) -> bool:
    """Whether a value is a string."""
    return isinstance(value, str)


def _is_positive(value: Any) -> bool:
    """Whether a value is a finite positive number."""
    return (_is_integer(value) or isinstance(value, float)) and math.isfinite(value) and value > 0


def _is_valid_plan(plan: Mapping[str, Any]) -> bool:
    """Whether a mapping is a plan with positive tolerances."""
    tolerances = plan.get("tolerances", [])
    return _is_mapping(plan, _is_flat) and isinstance(tolerances, list) and all(map(_is_positive, tolerances))


_Rule = tuple[str, Callable[[Any], bool]]
#: Description and test of the values of each declared type in a file.
_TYPES: dict[str, _Rule] = {
    "str": ("a text", _is_string),
    "int": ("a whole number", _is_integer),
    "float": ("a number", lambda v: isinstance(v, float)),
    "float | None": (
        "a number of 0 or more, or nothing",
        lambda v: v is None or (isinstance(v, float) and not v < 0.0),
    ),
    "bool": ("true or false", lambda v: isinstance(v, bool)),
    "tuple[float, ...]": (
        "a list of numbers of 0 or more",
        lambda v: isinstance(v, tuple) and all(isinstance(x, float) and not x < 0.0 for x in v),
    ),
    "tuple[str, ...]": ("a list of words", lambda v: isinstance(v, tuple) and all(map(_is_string, v))),
    "Mapping[str, Any]": (
        "a table of numbers and words",
        lambda v: _is_mapping(v, _is_flat),
    ),
    "Mapping[str, str]": ("a table of words", lambda v: _is_mapping(v, _is_string)),
    "Mapping[str, int]": ("a table of whole numbers", lambda v: _is_mapping(v, _is_integer)),
}
#: Description and test of the range of a field; "" applies to all other floats.
_RANGES: dict[Any, _Rule] = {
    "": ("0 or more", lambda v: not v < 0.0),
    ("Run", "plan"): ("a plan with positive tolerances", _is_valid_plan),
    ("Record", "start"): ("cold, warm or carried", lambda v: v in ("cold", "warm", "carried")),
    ("Record", "mode"): ("tol, budget or time", lambda v: v in ("tol", "budget", "time")),
    ("Record", "timing_mode"): (
        "call, steps, batch or nothing",
        lambda v: v in ("", "call", "steps", "batch"),
    ),
    ("Record", "claim_check"): ("confirmed, not proven or contradicted", lambda v: v in CLAIM_CHECKS),
    ("Record", "tol"): ("a finite number of 0 or more", lambda v: 0.0 <= v < math.inf),
    ("Record", "time_limit"): ("a positive number of seconds", _is_positive),
    ("Record", "max_iter"): ("0 or more", lambda v: v >= 0),
    ("Record", "repeats"): ("0 or more", lambda v: v >= 0),
    ("Record", "iterations"): ("0 or more", lambda v: v >= 0),
    ("Outcome", "iterations"): ("0 or more", lambda v: v >= 0),
    ("Outcome", "work"): ("0 or more", lambda v: all(n >= 0 for n in v.values())),
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
    if hasattr(value, "tolist"):
        return to_jsonable(value.tolist())
    return str(value)
