"""Test vectors: problems of a report, the solver it recommends with its settings, and the bits that come of both.

`vectors.bin` is read by `check.c`, which a build runs: 8 bytes of name, the number of vectors, then each as whole
numbers of 8 bytes and arrays (bytes, data, padded to 8): its steps, the problem in the order of `lav_problem` (-1 for
null), and what is to come out. Little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import lavender as lv
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.export.library import HERE
from lavender.export.view import METHODS, OTHER_BITS, NotTaken, choices, takes, view
from lavender.lab import bench
from lavender.lab.bench import statistics
from lavender.lab.bench.cases import fingerprint
from lavender.lab.bench.record import Record
from lavender.lab.bench.store import Records, read
from lavender.lab.report.verdict import build_verdict
from lavender.solvers import registry
from lavender.solvers.steps import METHODS as CANDIDATES
from lavender_ext.core.method import OUTCOMES
from lavender_ext.driver.driver import Driver

MAGIC = b"LAVVEC3\0"
COUNTED = ("sweeps", "factorisations", "solves")  # what the library counts as iterations


CHOSEN = """/* What the report measured: {solver}, to a relative residual of {tol:g}, as steps.
 *
 * Each begins where the one before ended; the first that meets its tolerance is the last, and one that does not take a
 * problem (lav_takes) is left out. Iterations are twice what the longest of the measured problems took. */
#ifndef LAVENDER_CHOSEN_H
#define LAVENDER_CHOSEN_H

#include "lavender.h"

typedef struct lav_step {{
  lav_options options;
  lav_budget budget;
}} lav_step;

static const lav_step lav_chosen[{count}] = {{
{lines}
}};

#endif
"""


@dataclass(frozen=True)
class Step:
    """One method of the library and its work; it begins where the step before has ended."""

    solver: str
    iterations: int
    tol: float
    options: Mapping[str, Any] = field(default_factory=dict)

    def whole(self) -> tuple[int, ...]:
        """Whole numbers of `lav_options` but its seed: method, order, memory, sweep, convex, keeps."""
        return (METHODS[self.solver], *choices(self.solver, self.options)[0])

    def packed(self) -> bytes:
        """As check.c reads it."""
        omega = choices(self.solver, self.options)[1]
        return struct.pack("<7qdqd", *self.whole(), 0, omega, self.iterations, self.tol)

    def text(self) -> str:
        """As C has it: options, budget."""
        whole, omega = ", ".join(map(str, self.whole()[1:])), choices(self.solver, self.options)[1]
        options = f"sizeof(lav_options), LAV_{self.solver.upper()}, {whole}, 0, {omega!r}"
        budget = f"sizeof(lav_budget), {self.iterations}, {self.tol!r}, 0.0, 0, 0"
        return f"{{{{{options}}}, {{{budget}}}}}"


def steps_of(found: lv.Solution, step: Step) -> list[Step]:
    """What a solve did: the step itself, or the turns of `auto`, each solver once with twice all of its work."""
    if step.solver != "auto":
        return [step]
    done: dict[str, int] = {}
    for stage in found.stages:
        name, _, _ = stage.solver.partition(" on ")
        solver = CANDIDATES.get(name, (name, {}))[0]
        pivots = solver in ("direct", "lemke")  # which end by themselves
        counted = 0 if pivots else max((stage.work.get(kind, 0) for kind in COUNTED), default=0)
        done[name] = done.get(name, 0) + (2 * counted or registry.specs()[solver].max_iter)
    steps = []
    for name, count in (done or {"anderson": 1}).items():
        solver, options = CANDIDATES.get(name, (name, {}))
        steps.append(replace(step, solver=solver, iterations=count, options=options))
    return steps


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
    records = statistics.drop_idle_cases(read(path).latest())  # what the report itself recommends by
    measured = _chosen(records, solver)
    packed: list[bytes] = []
    left: list[str] = []
    steps: dict[tuple[int, ...], Step] = {}
    longest = 2 * max(r.iterations for r in measured)
    for record in {(r.case, r.sha): r for r in measured}.values():
        if len(packed) >= most and record.solver != "auto":
            break
        try:
            problem = _again(records, record)
            vector, ran = pack(problem, record.solver, record.tol, record.max_iter, record.options)
        except (NotTaken, lv.LavenderError) as error:
            left.append(f"{record.case}: {error}")
            continue
        packed.append(vector)
        for step in ran:
            key = step.whole()
            count = step.iterations if record.solver == "auto" else min(step.iterations, longest)
            steps[key] = replace(step, iterations=max(count, steps[key].iterations if key in steps else 1))
    if not packed:
        raise InputError(
            f"no problem of {measured[0].solver} in {path} makes a test vector: {'; '.join(left[:3])}"
        )
    check = (HERE / "capi" / "check.c").read_text(encoding="utf-8")
    lines = ",\n".join(f"  {step.text()}" for step in steps.values())
    header = CHOSEN.format(solver=measured[0].solver, tol=measured[0].tol, count=len(steps), lines=lines)
    return {"vectors.bin": file_of(packed[:most]), "check.c": check, "chosen.h": header}


def _chosen(records: Records, solver: str | None) -> list[Record]:
    """Runs of the solver that is written, to the tolerance that the report recommends by, or else its tightest."""
    solved = [r for r in records if r.success and r.mode == "tol" and r.timing_mode in ("call", "steps")]
    names = sorted({r.solver for r in solved if r.solver in METHODS or r.solver == "auto"})
    if solver is None:
        leaders = build_verdict(records).leaders
        solver = next((name for name in leaders if name in names), None)
    if solver not in names:
        have = ", ".join(names) or "none"
        raise InputError(
            f"{solver or 'what is recommended'} is not in the C library or reached no tolerance in these records; "
            f"of both are: {have} (--solver)"
        )
    mine, tolerances = [r for r in solved if r.solver == solver], statistics.get_tolerances(records)
    tolerance = tolerances[len(tolerances) // 2]
    tol = tolerance if any(r.tol == tolerance for r in mine) else min(r.tol for r in mine)
    return [r for r in mine if r.tol == tol and r.options == mine[0].options]


def _again(records: Records, record: Record) -> lv.Problem:
    """The problem that was measured, from where the report had it; InputError where other numbers stand there now."""
    if record.case not in records.cases:
        raise InputError("the records do not say where it is from")
    source = records.cases[record.case].source
    problem = bench.resolve([source])[0].problem
    now = fingerprint(problem)
    if now != record.sha:
        raise InputError(f"{source} is another problem here, hash {now}; measured was {record.sha}")
    return problem


def file_of(packed: Sequence[bytes]) -> bytes:
    """`vectors.bin` of what `pack` has made."""
    return MAGIC + struct.pack("<q", len(packed)) + b"".join(packed)


def pack(
    problem: Any, solver: str, tol: float, max_iter: int, options: Mapping[str, Any]
) -> tuple[bytes, list[Step]]:
    """One vector and its steps: bits of the package, or by the judge's verdict alone where these are others.

    Raises
    ------
    NotTaken
        The library does not do what the package did.
    """
    max_iter = max_iter or registry.specs()[solver].max_iter
    found = lv.solve(problem, solver, tol=tol, max_iter=max_iter, **options)
    form = found.solver.form
    if ", then" in form or (
        problem.matrix is None and ("rows of A" in form or (solver == "pgs" and form != "whitened J"))
    ):
        raise NotTaken(f"{solver} formed A, which the library does not: give it the matrix, problem.csr")
    steps = [s for s in steps_of(found, Step(solver, max_iter, tol, options)) if takes(problem, s.solver)]
    given = pack_problem(problem)
    if not steps:
        raise NotTaken(
            f"{solver} of the library does not take {problem.name or 'this problem'}: see lav_takes"
        )
    impulse, relative = found.impulse, found.residual.relative
    if solver == "newton" and (problem.generalized is None or form == "velocity"):
        impulse = driven(problem, tol, max_iter)[0]
        relative = lv.residual(problem, impulse, tol=tol).relative
    is_met = solver in OTHER_BITS
    out = struct.pack("<q", len(steps)) + b"".join(step.packed() for step in steps) + given
    return out + struct.pack("<qd", is_met, tol if is_met else relative) + (
        b"" if is_met else impulse.tobytes()
    ), steps


def driven(problem: lv.Problem, tol: float, budget: int) -> tuple[FloatArray, int]:
    """Impulse and factorisations of `newton` by the compiled driver, which the library has.

    `lavender.solve` tries warm sweeps and joints alone before it, looks for certificates between its turns, and solves
    J and M of free bodies as bodies.

    Raises
    ------
    NotTaken
        The driver does not take the problem.
    """
    lv.residual(problem, problem.start())  # d, nu and J M^-1 J^T of a problem are known once it is judged
    impulse = (problem.start() if problem.guess is None else problem.guess).copy()
    driver, how = Driver(problem.metric), OUTCOMES["more"]
    if not driver.fits:
        raise NotTaken("the compiled driver of newton does not take this problem")
    driver.start(impulse, tol, budget)
    while how in (OUTCOMES["more"], OUTCOMES["certificate"]):
        how = driver.step(10**6, impulse)
    return impulse, driver.counts[1]


def pack_problem(problem: Any) -> bytes:
    """The problem itself: counts, then arrays in the order of `lav_problem`."""
    given = view(problem)
    out = struct.pack("<9q", *given.counts)
    for values in given.arrays.values():
        data = b"" if values is None else np.ascontiguousarray(values).tobytes()
        out += struct.pack("<q", -1 if values is None else len(data)) + data + bytes(-len(data) % 8)
    return out
