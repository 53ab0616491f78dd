"""One line of a report: what was asked, what came back, what it cost, on which machine."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

__all__ = [
    "CaseInfo",
    "Done",
    "Entry",
    "Record",
    "Run",
    "Skip",
    "file_name",
    "from_json",
    "level_name",
    "to_json",
]

# Beside the statuses of a solve: what can happen to a run that brings no solution back.
ERROR, KILLED, CRASHED = "ERROR", "KILLED", "CRASHED"


def level_name(level: float) -> str:
    """A level as people write it: 1e-3, not 1e-03."""
    mantissa, _, exponent = f"{level:.3e}".partition("e")
    mantissa = mantissa.rstrip("0").rstrip(".")
    return f"{mantissa}e{int(exponent)}"


def file_name(name: str) -> str:
    """A name that every file system, and the address of a part of a page, takes."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("_.")[:120] or "figure"


@dataclass(frozen=True)
class Run:
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


@dataclass(frozen=True)
class CaseInfo:
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
    sequence: str = ""  # name of the sequence that this is a step of
    step: int = -1
    nothing_to_do: bool = False  # doing nothing is right: nobody solves it, nobody fails


@dataclass(frozen=True)
class Skip:
    """A solver that did not run on a case, or a case that did not load (then `solver` is empty)."""

    run: str
    case: str
    solver: str
    reason: str


@dataclass(frozen=True)
class Done:
    """Closes one pair of a campaign: every entry of it stands before this one."""

    run: str
    case: str
    solver: str


@dataclass(frozen=True)
class Record:
    """One solver on one case with one budget or tolerance. Times are seconds."""

    run: str
    case: str
    sha: str  # of the case's numbers
    solver: str
    options: Mapping[str, Any]
    start: (
        str  # "cold" from doing nothing, "warm" from the guess of the problem, "carried" from the step before
    )
    mode: str  # "tol": to that residual; "budget": exactly max_iter iterations
    tol: float
    max_iter: int
    time_limit: float  # s
    order: str
    seed: int
    status: str  # a Status name, ERROR, KILLED or CRASHED
    relative: float = math.inf  # -
    energy: float = math.inf  # sqrt J
    velocity: float = math.inf  # m/s
    floor: float = math.nan  # -
    motion: float | None = None  # -, relative motion error; None where nobody asked, or where there is none
    motion_speed: float | None = None  # m/s, of the body that is furthest off (row, without bodies)
    bound: float | None = None  # sqrt J, proved bound of the motion error
    worst_row: int = -1
    worst_name: str = ""
    success: bool = False  # the judge: relative <= tol (a budget: false)
    contradicted: str = ""  # why the judge disagrees with the claim
    claims: bool = False  # the solver claims a solution: CONVERGED, FLOOR or INFEASIBLE
    iterations: int = 0
    work: Mapping[str, int] = field(default_factory=dict)
    form: str = ""
    message: str = ""
    repeats: int = 0
    setup_min: float = math.nan
    setup_median: float = math.nan
    solve_min: float = math.nan
    solve_median: float = math.nan
    time_min: float = math.nan  # set-up and solve of one repeat together
    time_median: float = math.nan
    threads: int = 1
    step: int = -1  # of a sequence

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes two records the same measurement."""
        return measurement_key(self)

    @property
    def usable(self) -> bool:
        """It brought back a finite residual and a time."""
        return math.isfinite(self.relative) and math.isfinite(self.time_min)


def measurement_key(what: Any) -> tuple[Any, ...]:
    """The identity of a measurement, of its `Task` as of its `Record`."""
    options = repr(sorted(_plain(what.options).items()))
    asked = (what.start, what.mode, what.tol, what.max_iter, what.time_limit)
    return (what.case, what.sha, what.solver, options, *asked)


Entry = Run | CaseInfo | Skip | Done | Record
_KINDS: dict[str, type] = {"run": Run, "case": CaseInfo, "skip": Skip, "done": Done, "record": Record}


def to_json(entry: Entry) -> dict[str, Any]:
    """A dictionary that JSON can hold: inf and nan become words."""
    kind = next(name for name, cls in _KINDS.items() if isinstance(entry, cls))
    return {"kind": kind, **{name: _plain(value) for name, value in asdict(entry).items()}}


def from_json(line: Mapping[str, Any]) -> Entry:
    """Back again; fields that this version does not know are left out.

    Raises
    ------
    ValueError
        Not an entry of a records file.
    """
    if not isinstance(line, Mapping) or line.get("kind") not in _KINDS:
        raise ValueError("not an entry of a records file")
    cls = _KINDS[line["kind"]]
    values = {}
    for f in fields(cls):
        if f.name not in line:
            continue
        value = line[f.name]
        if f.type in ("float", "float | None") and isinstance(value, str):
            value = float(value)
        elif f.name == "structure":
            value = tuple(value)
        values[f.name] = value
    try:
        return cls(**values)
    except TypeError as error:
        raise ValueError(f"not an entry of a records file ({error})") from None


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    return str(value)
