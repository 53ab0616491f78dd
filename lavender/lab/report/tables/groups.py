"""How records are grouped: by case and solver, by structure, by levels."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

from lavender.lab.bench.record import Record
from lavender.lab.bench.store import Records

SHAPES = ("separate", "chain", "mesh", "stack", "pile", "dense")


def levels_of(records: Records) -> tuple[float, ...]:
    """Levels of the newest run's plan, loosest first; else the tolerances that were asked for."""
    for run in reversed(list(records.runs.values())):
        if run.plan.get("levels"):
            return tuple(sorted(map(float, run.plan["levels"]), reverse=True))
    return tuple(sorted({r.tol for r in records if r.mode == "tol"}, reverse=True)) or (1e-3, 1e-6, 1e-9)


def pairs(records: Iterable[Record]) -> dict[tuple[str, str, str], list[Record]]:
    """Runs in the given order of blocks, by (case, solver, start)."""
    groups: dict[tuple[str, str, str], list[Record]] = defaultdict(list)
    for r in records:
        if r.order == "given" and r.step < 0 and not r.turns:
            groups[r.case, r.solver, r.start].append(r)
    return dict(groups)


def families(records: Records) -> dict[str, list[str]]:
    """Structure -> cases, biggest first. A case is in every family whose word describes it.

    A structure whose cases have several laws is a family for each law: "pile, coulomb". Words that describe the same
    cases are one family: "stack / friction".
    """
    found: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    ran = {r.case for r in records if r.step < 0}
    for name, info in records.cases.items():
        if name in ran:
            for word in info.structure:
                found[word][info.law].append(name)
    order = (*SHAPES, "redundant", "friction", "large mass ratio", "asymmetric")
    names: dict[tuple[str, ...], list[str]] = {}
    for word in sorted(found, key=lambda w: (order.index(w) if w in order else len(order), w)):
        laws = found[word]
        for law in sorted(laws, key=lambda x: (-len(laws[x]), x)):
            names.setdefault(tuple(laws[law]), []).append(word if len(laws) == 1 else f"{word}, {law}")
    return {" / ".join(words): list(cases) for cases, words in names.items()}


def is_campaign(records: Records) -> bool:
    """Times were left out on purpose."""
    return any(run.plan.get("campaign") for run in records.runs.values())


DIED = ("ERROR", "KILLED", "CRASHED")
