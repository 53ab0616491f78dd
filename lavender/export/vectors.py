"""Test vectors: problems of a report, the solver it recommends with its settings, and the bits that come of both.

`vectors.bin` is read by `check.c`, which a build runs: 8 bytes of name, the number of vectors, then each as whole
numbers of 8 bytes and arrays (bytes, data, padded to 8) in the order of `lav_problem`, -1 for null. Little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import lavender as lv
from lavender import bench, registry
from lavender.bench.cases import fingerprint
from lavender.bench.line import c_of
from lavender.bench.store import Records, read
from lavender.errors import InputError
from lavender.export.library import HERE
from lavender.export.view import METHODS, OTHER_BITS, NotTaken, choices, takes, view
from lavender.io.stored import write_bytes
from lavender.report.moved import working
from lavender.report.verdict import verdict
from lavender.solvers.costs import METHODS as METHODS_OF_PLANS

__all__ = ["chosen", "made", "pack", "pack_problem", "write_packed"]

MAGIC = b"LAVVEC1\0"


def made(path: Path, solver: str | None, most: int) -> dict[str, str | bytes]:
    """`vectors.bin`, `check.c` and `chosen.h`, the settings as C, by name: to lie beside the library.

    Parameters
    ----------
    path : Path
        records.jsonl of a report, or its folder.
    solver : str, optional
        One of its records; default: the one that it recommends.
    most : int
        Problems at most.

    Raises
    ------
    InputError
        No such solver, or one that the library does not have, or no problem that can be had again.
    """
    records = working(read(path).latest())  # what the report itself recommends by
    record = chosen(records, solver)
    packed: list[bytes] = []
    left: list[str] = []
    for case, sha in dict.fromkeys(
        (r.case, r.sha) for r in records if r.solver == record.solver and r.success
    ):
        if len(packed) < most:
            try:
                problem = _again(records, case, sha)
                packed.append(pack(problem, record.solver, record.tol, record.max_iter, record.options))
            except (NotTaken, lv.LavenderError) as error:
                left.append(f"{case}: {error}")
    if not packed:
        raise InputError(
            f"no problem of {record.solver} in {path} makes a test vector: {'; '.join(left[:3])}"
        )
    text = (
        f"/* What the report measured: {record.solver}, to a relative residual of {record.tol:g}. */\n"
        '#include "lavender.h"\n\n'
        "static inline void lav_chosen(lav_options *options, lav_budget *budget) {\n"
        + _turns_of(records, record)
        + "".join(f"  {_by_pointer(line)};\n" for line in c_of(record))
        + (
            "  options->turns = turns;\n  options->n_turns = sizeof turns / sizeof *turns / 2;\n"
            if record.solver == "auto"
            else ""
        )
        + "}\n"
    )
    check = (HERE / "front" / "check.c").read_text(encoding="utf-8")
    return {"vectors.bin": _file_of(packed), "check.c": check, "chosen.h": text}


def _again(records: Records, case: str, sha: str) -> lv.Problem:
    """The problem that was measured, from where the report had it; InputError where other numbers stand there now."""
    if case not in records.cases:
        raise InputError("the records do not say where it is from")
    source = records.cases[case].source
    problem = bench.resolve([source])[0].problem
    now = fingerprint(problem)
    if now != sha:
        raise InputError(f"{source} is another problem here, hash {now}; measured was {sha}")
    return problem


def write_packed(out: Path, packed: Sequence[bytes]) -> None:
    """Write `vectors.bin` of what `pack` has made."""
    write_bytes(out / "vectors.bin", _file_of(packed))


def _file_of(packed: Sequence[bytes]) -> bytes:
    return MAGIC + struct.pack("<q", len(packed)) + b"".join(packed)


def _by_pointer(line: str) -> str:
    return line.replace("&", "").replace("options.", "options->").replace("budget.", "budget->")


def _turns_of(records: Records, record: Any) -> str:
    """The plan of `auto` for the record's problem as turns in C; empty for the others."""
    if record.solver != "auto":
        return ""
    plan = lv.explain(_again(records, record.case, record.sha), record.tol)
    return (
        f"  static const int32_t turns[] = {{{', '.join(map(str, turns(plan)))}}}; /* lavender.explain */\n"
    )


def turns(plan: lv.Plan) -> list[int]:
    """`lav_options.turns` of a plan: each candidate's number and expected iterations, the least expected cost first."""
    solvers = [(METHODS[METHODS_OF_PLANS[name][0]], cost) for name, cost in plan.candidates]
    first = {number: max(1, round(cost.count)) for number, cost in reversed(solvers)}
    return [x for number, _ in solvers if number in first for x in (number, first.pop(number))]


def chosen(records: Any, solver: str | None) -> Any:
    """The record whose solver and settings are written."""
    solved = [r for r in records if r.success and r.mode == "tol"]
    mine = [r for r in solved if r.solver in METHODS]
    names = sorted({r.solver for r in mine})
    if solver is None:
        leaders = verdict(records).leaders
        solver = next((name for name in leaders if name in names), None)
    if solver not in names:
        have = ", ".join(names) or "none"
        raise InputError(
            f"{solver or 'what is recommended'} is not in the C library; of these records are: {have} (--solver)"
        )
    return min((r for r in mine if r.solver == solver), key=lambda r: r.tol)


def pack(problem: Any, solver: str, tol: float, max_iter: int, options: Mapping[str, Any]) -> bytes:
    """One vector; NotTaken where the library does not do what the package did."""
    numbers, doubles = choices(solver, options)
    given = pack_problem(problem, solver)
    max_iter = max_iter or registry.specs()[solver].max_iter
    found = lv.solve(problem, solver, tol=tol, max_iter=max_iter, **options)
    form = found.solver.form
    if problem.matrix is None and ("rows of A" in form or (solver == "pgs" and form != "whitened J")):
        raise NotTaken(f"{solver} formed A, which the library does not")
    out = struct.pack("<6q", METHODS[solver], *numbers) + struct.pack("<Q", 0) + struct.pack("<d", doubles)
    steps = turns(lv.explain(problem, tol)) if solver == "auto" else []
    out += struct.pack("<qd", max_iter, tol) + struct.pack(f"<{len(steps) + 1}q", len(steps) // 2, *steps)
    is_met = solver in OTHER_BITS  # by the judge's verdict alone
    relative = tol if is_met else found.residual.relative
    return out + given + struct.pack("<qd", is_met, relative) + (b"" if is_met else found.impulse.tobytes())


def pack_problem(problem: Any, solver: str) -> bytes:
    """The problem itself: counts, then arrays in the order of `lav_problem`; NotTaken where the method refuses it."""
    given = view(problem)
    if not takes(problem, solver):
        raise NotTaken(
            f"{solver} of the library does not take {problem.name or 'this problem'}: see lav_takes"
        )
    out = struct.pack("<9q", *given.counts)
    for values in given.arrays.values():
        data = b"" if values is None else np.ascontiguousarray(values).tobytes()
        out += struct.pack("<q", -1 if values is None else len(data)) + data + bytes(-len(data) % 8)
    return out
