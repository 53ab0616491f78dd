"""Results of somebody else, verified anew: verdicts must agree, times stay with the machine that took them.

A submission is the `records.jsonl` of a report. Every measurement of its last run that does not hang on the clock is
made again here, once, on problems whose numbers have the same hash; nothing is written into the file.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from statistics import median
from typing import Any

from lavender.base.errors import InputError, LavenderError
from lavender.lab.bench.cases import Item, Source, fingerprint, resolve
from lavender.lab.bench.machine import cpu_name
from lavender.lab.bench.record import CaseInfo, Record, Run
from lavender.lab.bench.running.plan import Plan
from lavender.lab.bench.running.runner import run
from lavender.lab.bench.store import Records
from lavender.solvers.registry import known

SAME = 2.0  # residuals of a budget: other BLAS kernels change their last digits, another method changes much more
ROUNDED = 10.0  # floors, below which two residuals are rounding both


@dataclass(frozen=True)
class Verified:
    """One measurement of a submission."""

    record: Record  # as submitted
    here: Record | None  # the same made here
    agrees: bool | None  # None: not verified, `note` says why
    note: str = ""


@dataclass(frozen=True)
class Submission:
    """What became of each measurement; `str()` is a table."""

    run: Run  # the machine and versions of those who submit
    lines: tuple[Verified, ...]
    others: tuple[str, ...]  # cases whose problem is another one here, or none
    missing: tuple[Record, ...] = ()  # made here by the plan of the submission, which does not hold them

    @property
    def disagreements(self) -> tuple[Verified, ...]:
        """Measurements whose verdict is another one here."""
        return tuple(v for v in self.lines if v.agrees is False)

    @property
    def unverified(self) -> tuple[str, ...]:
        """Solvers of which no measurement was verified."""
        verified = {v.record.solver for v in self.lines if v.agrees is not None}
        return tuple(dict.fromkeys(v.record.solver for v in self.lines if v.record.solver not in verified))

    @property
    def ok(self) -> bool:
        """Something of each solver was verified, all of that agrees, nothing is missing, every problem is the same."""
        return bool(self.lines) and not (self.disagreements or self.missing or self.others or self.unverified)

    def __str__(self) -> str:
        theirs = f"{self.run.cpu}, lavender {self.run.lavender}"
        out = [f"submitted: {theirs}; verified here: {cpu_name()}"]
        out.append("solver | agree | disagree | not verified | median time there [s] | here [s]")
        for solver in dict.fromkeys(v.record.solver for v in self.lines):
            mine = [v for v in self.lines if v.record.solver == solver]
            both = [
                (v.record.time_median, v.here.time_median) for v in mine if v.agrees and v.here is not None
            ]
            times = [f"{median(t):.2e}" for t in zip(*both, strict=True)] or ["-", "-"]
            numbers = [sum(v.agrees is said for v in mine) for said in (True, False, None)]
            out.append(" | ".join([solver, *map(str, numbers), *times]))
        for v in self.disagreements:
            out.append(f"DISAGREES: {v.record.solver} on {v.record.case}, {v.record.asked}: {v.note}")
        out += [f"MISSING: {r.solver} on {r.case}, {r.asked}: {verdict_of(r)} here" for r in self.missing]
        out += [f"NOT VERIFIED: {text}" for text in (*self.others, *self.unverified)]
        notes = [v.note for v in self.lines if v.agrees is None]
        out += [f"not verified, {notes.count(note)}: {note}" for note in dict.fromkeys(notes)]
        return "\n".join(out)


def verdict_of(record: Record) -> str:
    """What the judge says of a run to a tolerance, or of its claim."""
    if record.status_conflict:
        return "claim contradicted"
    if record.success:
        return "solved"
    return record.status if record.status in ("FLOOR", "INFEASIBLE") else "not solved"


def verify(
    records: Records,
    cases: Iterable[Source] = (),
    solvers: Sequence[str] | None = None,
    **more: Any,
) -> Submission:
    """Make the measurements of a submission again, and compare the verdicts.

    Parameters
    ----------
    records : Records
        As `read` returns them; of several runs the last one counts.
    cases : files, folders, names of the suite
        Where the problems are; default: where the submission says.
    solvers : names, optional
        Of those submitted; default: all of them that are installed here.
    **more
        To `run`: isolate, memory, watch.

    Raises
    ------
    InputError
        No measurement in it; a plan that no report has; solvers that it does not hold.
    """
    described, records = records.cases, records.latest()
    if not records.records:
        raise InputError(f"{records.source or 'the records'}: no measurement to verify")
    theirs = records.runs[records.records[-1].run]
    described = {name: info for name, info in described.items() if info.run == theirs.run}
    plan = _plan(theirs)
    held = list(dict.fromkeys(r.solver for r in records))
    missing = [name for name in solvers or () if name not in held]
    if missing:
        raise InputError(f"the submission has no records of {', '.join(missing)}; it has {', '.join(held)}")
    # A file of those who submit need not be here; a name of the suite is one everywhere.
    sources = (Path(info.source) if Path(info.source).suffix else info.source for info in described.values())
    words = list(cases) or list(dict.fromkeys(sources))
    items, others = _same(described, words)
    asked = [r for r in records if solvers is None or r.solver in solvers]
    names = [name for name in held if solvers is None or name in solvers]
    installed = known()
    reasons = {name: installed.get(name, "not registered here") for name in names}
    names = [name for name in names if reasons[name] is None]
    own = run(items, names, plan, **more) if items and names else Records()
    found = {r.key: r for r in own}
    lines = tuple(_compared(r, found, reasons, {item.name for item in items}) for r in asked)
    return Submission(theirs, lines, tuple(others), _missing(asked, own))


def _missing(asked: Sequence[Record], own: Records) -> tuple[Record, ...]:
    """What was made here and left out there; after a level that was missed tighter ones are not asked."""
    keys = {r.key for r in asked}
    short = {(r.case, r.solver, r.start) for r in asked if r.mode == "tol" and not r.success}
    return tuple(
        r
        for r in own
        if r.key not in keys and r.step < 0 and (r.mode != "tol" or (r.case, r.solver, r.start) not in short)
    )


def _same(described: dict[str, CaseInfo], words: Sequence[Source]) -> tuple[list[Item], list[str]]:
    """Items whose problems have the submitted numbers, and what is to be told of the others."""
    found: dict[str, Item] = {}
    others: list[str] = []
    for word in words:
        try:
            found |= {item.name: item for item in resolve([word])}
        except LavenderError as error:
            others.append(str(error))
    same = []
    for name, info in described.items():
        item = found.get(name)
        if item is None:
            others.append(f"{name}: no such problem here; name its file, folder or case of the suite")
            continue
        try:
            sha = fingerprint(item.problem)
        except LavenderError as error:
            others.append(f"{name}: {error}")
            continue
        if sha == info.sha:
            same.append(item)
        else:
            others.append(f"{name}: another problem here, hash {sha}; submitted was {info.sha}")
            item.forget()
    return same, others


def _plan(theirs: Run) -> Plan:
    """The plan of the submission, each measurement once."""
    own = {f.name for f in fields(Plan)} - {"repeats", "motion", "prove", "speed_levels"}
    values = {name: value for name, value in theirs.plan.items() if name in own}
    try:
        return Plan(**values, repeats=1)
    except (TypeError, ValueError) as error:
        raise InputError(f"the plan of the submission is none of a report ({error})") from None


def _compared(
    r: Record, found: dict[tuple[Any, ...], Record], reasons: dict[str, str | None], cases: set[str]
) -> Verified:
    if r.mode == "time" or r.turns:
        return Verified(r, None, None, "time alone, or ended by the clock")
    if reasons[r.solver] is not None:
        return Verified(r, None, None, f"{r.solver}: {reasons[r.solver]}")
    if r.case not in cases:
        return Verified(r, None, None, "its problem is another one here, or none")
    here = found.get(r.key)
    if here is None:
        return Verified(
            r, None, None, "not asked here: a looser level was missed before, or the versions differ"
        )
    if "TIME_LIMIT" in (r.status, here.status) and verdict_of(r) != verdict_of(here):
        return Verified(r, here, None, "time alone, or ended by the clock")
    if r.mode == "budget":
        low, high = sorted((r.relative, here.relative))
        agrees = high <= max(SAME * low, ROUNDED * max(r.floor, here.floor)) or high == low
        return Verified(
            r, here, agrees, "" if agrees else f"residual {r.relative:.2e} there, {here.relative:.2e} here"
        )
    one, two = verdict_of(r), verdict_of(here)
    # Just above a tolerance that rounding decides, both are right; so is another word for what neither has solved.
    near = math.isclose(r.relative, here.relative, rel_tol=1e-3) and "contradicted" not in one + two
    near = near and ("solved" not in (one, two) or math.isclose(here.relative, here.tol, rel_tol=1e-2))
    agrees = one == two or near
    return Verified(r, here, agrees, "" if agrees else f"{one} there, {two} here")
