"""One line of a report: what was asked, what came back, what it cost, on which machine."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from lavender.judge.residuals import VERDICTS_OF_OLD
from lavender.judge.solution import CLAIM_CHECKS, CONFIRMED, CONTRADICTED, NOT_PROVEN

# Beside the statuses of a solve: what can happen to a run that brings no solution back.
ERROR, KILLED, CRASHED = "ERROR", "KILLED", "CRASHED"


def format_tolerance(tolerance: float) -> str:
    """Return a tolerance with the exponent's leading zeros removed: 1e-3, not 1e-03."""
    mantissa, _, exponent = f"{tolerance:.3e}".partition("e")
    mantissa = mantissa.rstrip("0").rstrip(".")
    return f"{mantissa}e{int(exponent)}"


def asked_of(mode: str, tol: float, max_iter: int) -> str:
    """What a run is asked for, in words: to 1e-6, or 16 iterations."""
    return f"{max_iter} iterations" if mode == "budget" else f"to {format_tolerance(tol)}"


LONGEST_NAME = 120  # characters of a file's name: file systems take 255 bytes, with a suffix


def file_name(name: str) -> str:
    """A name that every file system, and the address of a part of a page, takes; long ones keep their difference."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("_.") or "figure"
    if len(plain) <= LONGEST_NAME:
        return plain
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:12]
    return f"{plain[: LONGEST_NAME - 13]}-{digest}"


#: What no text of a report holds: controls, lone surrogates, marks that end a line or turn the writing round.
_UNPRINTABLE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)
_NAMED = {"\n": "\\n", "\t": "\\t", "\r": "\\r"}


def printable(text: str, lines: bool = False) -> str:
    """Text that any terminal, file and page can show: what cannot be shown is written as its code.

    A byte of a file name that is no UTF-8 (a lone surrogate in Python's text) is written as that byte. With `lines`
    ends of lines and tabs are kept, as messages have them; a name stands on one line.
    """
    if text.isprintable():
        return text

    def escape(found: re.Match[str]) -> str:
        if lines and found[0] in "\n\t":
            return found[0]
        code = ord(found[0])
        if 0xDC80 <= code <= 0xDCFF:
            code -= 0xDC00
        return _NAMED.get(found[0]) or (f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}")

    return _UNPRINTABLE.sub(escape, text)


def _clean(value: Any, lines: bool = False) -> Any:
    if isinstance(value, str):
        return printable(value, lines)
    if isinstance(value, Mapping):
        return {_clean(k): _clean(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(_clean, value))
    return value


class _Texts:
    """An entry whose texts can be printed, wherever they came from; messages alone have several lines."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, (str, tuple, Mapping)):
                object.__setattr__(self, name, _clean(value, name == "message"))


@dataclass(frozen=True)
class Run(_Texts):
    """One machine, one set of versions, one plan; records refer to it by `run`."""

    run: str  # identity: equal where machine, versions and plan are equal
    started: str  # ISO 8601, UTC
    lavender: str
    python: str
    platform: str
    cpu: str
    cores: int
    threads: int  # of BLAS and OpenMP while timing
    versions: Mapping[str, str]
    plan: Mapping[str, Any]
    # commit, hash of the kernels, compiler, BLAS, clock
    build: Mapping[str, str] = field(default_factory=dict)
    load: float | None = None  # processes that wanted the processor, mean of the minute before
    whole: bool = True  # False from its start until all that was asked for is measured


@dataclass(frozen=True)
class CaseInfo(_Texts):
    """What a report says of a problem without holding it."""

    run: str
    case: str
    source: str  # path, or the name in the suite
    sha: str  # of the numbers, so that a changed file is another case
    law: str
    rows: int
    blocks: int
    contacts: int
    bodies: int  # 0 where only a matrix is known
    nonzeros: int  # of A; of J where A is not formed
    mass_ratio: float  # largest over smallest: body masses, or the diagonal of A
    structure: tuple[str, ...]  # stack, chain, pile, redundant, friction, large mass ratio, ...
    symmetric: bool
    reason: str = ""  # why the case is in the suite
    stored: float = math.nan  # - relative residual of the answer stored beside the problem, an engine's own
    sequence: str = ""  # name of the sequence that this is a step of
    step: int = -1
    nothing_to_do: bool = False  # doing nothing is a solution: the case is not ranked
    identity: str = ""  # of the sequence, from the numbers of all its steps: steps of two are never one
    # of a stored answer in float32: at its floor, stopped before convergence (by how much) or wrong
    stored_verdict: str = ""
    diagnostics: tuple[str, ...] = ()  # what looks like a mistake in its data
    guess: str = ""  # to begin at: a "start"; an "answer", from which nothing is measured; or nothing
    # of A, scaled to a diagonal of 1, over its range; None where it was not computed
    condition: float | None = None
    # how near an exact solution is enclosed, or why none is; empty where it was not asked for
    proof: str = ""


@dataclass(frozen=True)
class Skip(_Texts):
    """A solver that did not run on a case, or a case that did not load (then `solver` is empty)."""

    run: str
    case: str
    solver: str
    reason: str
    sequence: str = ""  # that a case which did not load is a step of


@dataclass(frozen=True)
class Record(_Texts):
    """One solver on one case with one budget or tolerance. Times are seconds."""

    run: str
    case: str
    sha: str  # of the case's numbers
    solver: str
    options: Mapping[str, Any]
    # "cold" from doing nothing, "warm" from the guess of the problem, "carried" from the step before
    start: str
    # "tol": to that residual; "budget": exactly max_iter iterations; "time": to tol, but stopped at time_limit
    mode: str
    tol: float
    max_iter: int
    time_limit: float  # s
    order: str
    seed: int
    status: str  # a Status name, ERROR, KILLED or CRASHED
    relative: float = math.inf  # -
    energy: float = math.inf  # sqrt J
    velocity: float = math.inf  # m/s
    roundoff_floor: float = math.nan  # -
    motion_error: float | None = None  # -, relative motion error; None if not requested or not available
    motion_speed: float | None = None  # m/s, of the body that is furthest off (row, without bodies)
    bound: float | None = None  # sqrt J, proved bound of the motion error
    boundary_fraction: float | None = None  # -, share of blocks at a boundary; None if no error has a bound
    solution_hash: str = ""  # hash of the impulses: equal if they are bit-identical
    worst_row: int = -1
    worst_name: str = ""
    success: bool = False  # the judge: relative <= tol (a budget: false)
    claim_check: str = CONFIRMED  # "confirmed", "not proven" or "contradicted", as in a Solution
    status_conflict: str = ""  # why the judge's figures exclude what the status claims; empty if they do not
    claims: bool = False  # the solver claims a solution: CONVERGED, ROUNDOFF_LIMIT or INFEASIBLE
    iterations: int = 0
    work: Mapping[str, int] = field(default_factory=dict)
    form: str = ""
    message: str = ""
    repeats: int = 0
    setup_min: float = math.nan
    setup_median: float = math.nan
    solve_min: float = math.nan
    solve_median: float = math.nan
    # of one repeat: of the line where `timing_mode` says one, else set-up and solve together
    time_min: float = math.nan
    time_median: float = math.nan
    threads: int = 1
    step: int = -1  # of a sequence
    # "call": one `lv.solve` on a new problem. "steps": the same in a loop that carries impulses. "batch": the time of
    # one `lv.solve_many`, divided by its problems. "": prepare and solve, without the judge and the input validation.
    timing_mode: str = ""
    # identifies the calls that were timed alternately with this one; "": its repeats came one after the other
    interleave_group: str = ""
    times: tuple[float, ...] = ()  # s, of each repeat
    residual_per_repeat: tuple[float, ...] = ()  # relative residual of each repeat, in mode "time"
    calibration_time: float | None = None  # s, of a loop of fixed work that ran with the repeats
    load: float | None = None  # processes that wanted a processor when it was made, this one among them
    # s, in the own interface of a third-party backend, on converted data
    backend_time_min: float | None = None

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes two records the same measurement."""
        return measurement_key(self)

    @property
    def asked(self) -> str:
        """The budget or the tolerance, and the order of sweeps where it is another."""
        order = "" if self.order == "given" else f", order {self.order}"
        return asked_of(self.mode, self.tol, self.max_iter) + order

    @property
    def usable(self) -> bool:
        """It brought back a finite residual and a time."""
        return math.isfinite(self.relative) and math.isfinite(self.time_min)


def measurement_key(what: Any) -> tuple[Any, ...]:
    """The identity of a measurement, of its `Task` as of its `Record`."""
    options = repr(sorted(plain(what.options).items()))
    asked = (
        what.start,
        what.mode,
        what.tol,
        what.max_iter,
        what.time_limit,
        what.timing_mode,
        what.interleave_group,
    )
    return (what.case, what.sha, what.solver, options, *asked)


Entry = Run | CaseInfo | Skip | Record
#: Present name of each field that earlier versions wrote under another name; "plan." marks fields of a run's plan.
RENAMED_FIELDS = {
    "floor": "roundoff_floor",
    "suspicions": "diagnostics",
    "contradicted": "status_conflict",
    "way": "timing_mode",
    "pace": "calibration_time",
    "own_min": "backend_time_min",
    "reached": "residual_per_repeat",
    "motion": "motion_error",
    "bits": "solution_hash",
    "degenerate": "boundary_fraction",
    "turns": "interleave_group",
    "plan.levels": "tolerances",
    "plan.speed_levels": "velocity_tolerances",
    "plan.pass_limit": "sequence_time_limit",
}
REMOVED_KINDS = ("done",)  # Earlier versions marked complete pairs of a campaign; such lines are ignored.
RENAMED_STATUSES = {"FLOOR": "ROUNDOFF_LIMIT", "REFUSED": "INVALID_PROBLEM"}
KINDS: dict[str, type] = {"run": Run, "case": CaseInfo, "skip": Skip, "record": Record}


def to_json(entry: Entry) -> dict[str, Any]:
    """A dictionary that JSON can hold: inf and nan become words."""
    kind = next(name for name, cls in KINDS.items() if isinstance(entry, cls))
    return {"kind": kind, **{f.name: plain(getattr(entry, f.name)) for f in fields(entry)}}


def from_json(line: Any) -> Entry:
    """Back again; fields that this version does not know are left out.

    Raises
    ------
    ValueError
        Not an entry of a records file: a field that is missing, of another type or out of its range.
    """
    if not isinstance(line, Mapping) or not isinstance(line.get("kind"), str) or line["kind"] not in KINDS:
        raise ValueError("not an entry of a records file")
    cls = KINDS[line["kind"]]
    line = _with_new_names(line)
    try:
        values = values_in(cls, line)
        word, comma, rest = str(values.get("stored_verdict", "")).partition(",")
        if word in VERDICTS_OF_OLD:
            values["stored_verdict"] = VERDICTS_OF_OLD[word] + comma + rest
        return cls(**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"not an entry of a records file ({error})") from None


def _with_new_names(line: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a line of an earlier version with the fields' names of this one."""
    renamed = {RENAMED_FIELDS.get(name, name): value for name, value in line.items()}
    status = renamed.get("status")
    if isinstance(status, str):
        renamed["status"] = RENAMED_STATUSES.get(status, status)
    if isinstance(plan := renamed.get("plan"), Mapping):
        renamed["plan"] = {RENAMED_FIELDS.get(f"plan.{name}", name): value for name, value in plan.items()}
    conflict = line.get("contradicted")
    if not conflict or "claim_check" in line:
        return renamed
    # Earlier versions called a claim of INFEASIBLE contradicted if no certificate proved it.
    if renamed.get("status") == "INFEASIBLE":
        return renamed | {"claim_check": NOT_PROVEN, "status_conflict": ""}
    return renamed | {"claim_check": CONTRADICTED}


def values_in(cls: Any, line: Mapping[str, Any]) -> dict[str, Any]:
    """Those fields of a data class that JSON can hold, as far as a line has them.

    Raises
    ------
    ValueError
        One is of another type than declared, or out of its range.
    """
    values = {}
    for f in fields(cls):
        kind = str(f.type)
        if f.name not in line or kind not in _TYPES:
            continue
        value = line[f.name]
        if kind.startswith("float") and (
            _is_whole(value) or (_is_word(value) and value in ("inf", "-inf", "nan"))
        ):
            value = float(value)
        elif kind.startswith("tuple") and isinstance(value, list):
            value = tuple(map(_number, value) if "float" in kind else value)
        wanted, holds = _TYPES[kind]
        if not holds(value):
            raise ValueError(f"{f.name} is not {wanted}")
        rule = _RANGES.get((cls.__name__, f.name)) or (_RANGES[""] if isinstance(value, float) else None)
        if rule and not rule[1](value):
            raise ValueError(f"{f.name} is not {rule[0]}")
        values[f.name] = value
    return values


def _number(value: Any) -> Any:
    return float(value) if _is_whole(value) or value in ("inf", "nan") else value


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63


def _is_flat(value: Any) -> bool:
    """A number, a word, nothing, or a list of such: what options and plans hold."""
    if isinstance(value, list):
        return all(_is_flat(v) and not isinstance(v, list) for v in value)
    return value is None or isinstance(value, (bool, str, float)) or _is_whole(value)


def _is_mapping(value: Any, holds: Callable[[Any], bool]) -> bool:
    return isinstance(value, Mapping) and all(isinstance(k, str) and holds(v) for k, v in value.items())


def _is_word(value: Any) -> bool:
    return isinstance(value, str)


def _is_positive(value: Any) -> bool:
    return (_is_whole(value) or isinstance(value, float)) and math.isfinite(value) and value > 0


def _is_plan(plan: Mapping[str, Any]) -> bool:
    tolerances = plan.get("tolerances", [])
    return _is_mapping(plan, _is_flat) and isinstance(tolerances, list) and all(map(_is_positive, tolerances))


_Rule = tuple[str, Callable[[Any], bool]]
#: What a field of each declared type holds in a file.
_TYPES: dict[str, _Rule] = {
    "str": ("a text", _is_word),
    "int": ("a whole number", _is_whole),
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
    "tuple[str, ...]": ("a list of words", lambda v: isinstance(v, tuple) and all(map(_is_word, v))),
    "Mapping[str, Any]": (
        "a table of numbers and words",
        lambda v: _is_mapping(v, _is_flat),
    ),
    "Mapping[str, str]": ("a table of words", lambda v: _is_mapping(v, _is_word)),
    "Mapping[str, int]": ("a table of whole numbers", lambda v: _is_mapping(v, _is_whole)),
}
#: What their values are limited to; "" is the rule of every other number with a fraction.
_RANGES: dict[Any, _Rule] = {
    "": ("0 or more", lambda v: not v < 0.0),
    ("Run", "plan"): ("a plan with positive tolerances", _is_plan),
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


def plain(value: Any) -> Any:
    """What JSON can hold of a value: inf and nan become words."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return str(value)
