"""Test vectors of the C library: problems of a report, settings of the recommended solver, bits of the results.

The program `check.c`, which a build of the library runs, reads `vectors.bin`. The file consists of a magic word of 8
bytes, the number of vectors, and the vectors. A vector contains its steps (`Step`), the problem in the order of
`lav_problem` (-1 for a null pointer), and the expected result. Integers have 8 bytes; an array is its size in bytes
and its data, padded to 8 bytes. All numbers are little-endian.
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
from lavender.export.view import (
    METHODS,
    OTHER_BITS,
    NotSupported,
    encode_options,
    is_accepted_by_library,
    make_problem_view,
)
from lavender.lab import bench
from lavender.lab.bench import statistics
from lavender.lab.bench.cases import hash_problem
from lavender.lab.bench.record import Record
from lavender.lab.bench.store import Records, read_records
from lavender.lab.report.verdict import build_verdict
from lavender.solvers import registry
from lavender.solvers.steps import METHODS as CANDIDATES
from lavender_ext.core.method import OUTCOMES
from lavender_ext.driver.driver import Driver

MAGIC = b"LAVVEC3\0"
ITERATION_COUNTS = (
    "sweeps",
    "factorisations",
    "solves",
)  # Counters of `work` that the library counts as iterations.


CHOSEN_TEMPLATE = """/* Settings measured by the report: {solver}, to a relative residual of {tol:g}, as steps.
 *
 * Each step starts from the result of the step before. The sequence ends with the first step that meets its tolerance.
 * A step that does not support a problem (lav_takes) is skipped. The number of iterations is twice the largest number
 * that a measured problem needed. */
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
    """One call of a method of the library, with options and budget; it starts from the previous step's result."""

    solver: str
    iterations: int
    tol: float
    options: Mapping[str, Any] = field(default_factory=dict)

    def get_option_integers(self) -> tuple[int, ...]:
        """Return the integers of `lav_options` without the seed: method, order, memory, sweep, convex, keeps."""
        return (METHODS[self.solver], *encode_options(self.solver, self.options)[0])

    def to_bytes(self) -> bytes:
        """Return the step in the format of check.c."""
        omega = encode_options(self.solver, self.options)[1]
        return struct.pack("<7qdqd", *self.get_option_integers(), 0, omega, self.iterations, self.tol)

    def as_c_initialiser(self) -> str:
        """Return options and budget as a C initialiser."""
        integers, omega = (
            ", ".join(map(str, self.get_option_integers()[1:])),
            encode_options(self.solver, self.options)[1],
        )
        options = f"sizeof(lav_options), LAV_{self.solver.upper()}, {integers}, 0, {omega!r}"
        budget = f"sizeof(lav_budget), {self.iterations}, {self.tol!r}, 0.0, 0, 0, 0.0"
        return f"{{{{{options}}}, {{{budget}}}}}"


def split_into_steps(solution: lv.Solution, step: Step) -> list[Step]:
    """Return the steps of a solve: `step` itself or, for `auto`, one step for each solver that ran.

    The iteration budget of such a step is twice the work of that solver in the solve.
    """
    if step.solver != "auto":
        return [step]
    work: dict[str, int] = {}
    for stage in solution.stages:
        name, _, _ = stage.solver.partition(" on ")
        solver = CANDIDATES.get(name, (name, {}))[0]
        pivots = solver in ("direct", "lemke")  # Pivoting methods need no iteration limit.
        iterations = 0 if pivots else max((stage.work.get(kind, 0) for kind in ITERATION_COUNTS), default=0)
        work[name] = work.get(name, 0) + (2 * iterations or registry.specs()[solver].max_iter)
    steps = []
    for name, count in (work or {"anderson": 1}).items():
        solver, options = CANDIDATES.get(name, (name, {}))
        steps.append(replace(step, solver=solver, iterations=count, options=options))
    return steps


def make_export_files(path: Path, solver: str | None, max_problems: int) -> dict[str, str | bytes]:
    """Return {name: content} of the files `vectors.bin`, `check.c` and `chosen.h`, which has the settings in C.

    Parameters
    ----------
    path : Path
        records.jsonl of a report, or its folder.
    solver : str, optional
        A solver of its records; default: the recommended one.
    max_problems : int
        Largest number of test vectors.

    Raises
    ------
    InputError
        The records or the library do not have the solver, or none of the problems can be loaded.
    """
    records = statistics.drop_cases_solved_at_zero(
        read_records(path).select_latest_run()
    )  # Select the records on which the report bases its recommendation.
    measured = _select_records(records, solver)
    packed: list[bytes] = []
    failures: list[str] = []
    steps: dict[tuple[int, ...], Step] = {}
    longest = 2 * max(r.iterations for r in measured)
    for record in {(r.case, r.sha): r for r in measured}.values():
        if len(packed) >= max_problems and record.solver != "auto":
            break
        try:
            problem = _load_problem(records, record)
            vector, ran = make_test_vector(
                problem, record.solver, record.tol, record.max_iter, record.options
            )
        except (NotSupported, lv.LavenderError) as error:
            failures.append(f"{record.case}: {error}")
            continue
        packed.append(vector)
        for step in ran:
            key = step.get_option_integers()
            count = step.iterations if record.solver == "auto" else min(step.iterations, longest)
            steps[key] = replace(step, iterations=max(count, steps[key].iterations if key in steps else 1))
    if not packed:
        raise InputError(
            f"{path} has no run of {measured[0].solver} whose result the C library can reproduce: "
            f"{'; '.join(failures[:3])}. Give records of other problems, or another --solver"
        )
    check = (HERE / "capi" / "check.c").read_text(encoding="utf-8")
    lines = ",\n".join(f"  {step.as_c_initialiser()}" for step in steps.values())
    header = CHOSEN_TEMPLATE.format(
        solver=measured[0].solver, tol=measured[0].tol, count=len(steps), lines=lines
    )
    return {"vectors.bin": join_vectors(packed[:max_problems]), "check.c": check, "chosen.h": header}


def _select_records(records: Records, solver: str | None) -> list[Record]:
    """Return the runs of the solver to export, at the recommendation's tolerance, else at the smallest tolerance."""
    solved = [r for r in records if r.success and r.mode == "tol" and r.timing_mode in ("call", "steps")]
    names = sorted({r.solver for r in solved if r.solver in METHODS or r.solver == "auto"})
    if solver is None:
        leaders = build_verdict(records).leaders
        solver = next((name for name in leaders if name in names), None)
    if solver not in names:
        have = ", ".join(names) or "none"
        raise InputError(
            f"{solver or 'the recommended solver'} is not in the C library, or reached no tolerance in "
            f"these records; give --solver with one of: {have}"
        )
    own_runs, tolerances = [r for r in solved if r.solver == solver], statistics.get_tolerances(records)
    usual = tolerances[len(tolerances) // 2]
    tol = usual if any(r.tol == usual for r in own_runs) else min(r.tol for r in own_runs)
    return [r for r in own_runs if r.tol == tol and r.options == own_runs[0].options]


def _load_problem(records: Records, record: Record) -> lv.Problem:
    """Load the measured problem again from the source in the records.

    Raises
    ------
    InputError
        The records have no source, or the source has changed.
    """
    if record.case not in records.cases:
        raise InputError(
            f"the records do not name the source of {record.case!r}: write them anew with `lavender report`"
        )
    source = records.cases[record.case].source
    problem = bench.resolve_sources([source])[0].problem
    present_hash = hash_problem(problem)
    if present_hash != record.sha:
        raise InputError(
            f"{source} now holds another problem (hash {present_hash}) than the measured one (hash "
            f"{record.sha}): restore the file, or measure it again with `lavender report`"
        )
    return problem


def join_vectors(packed: Sequence[bytes]) -> bytes:
    """Return the content of `vectors.bin` from vectors of `make_test_vector`."""
    return MAGIC + struct.pack("<q", len(packed)) + b"".join(packed)


def make_test_vector(
    problem: Any, solver: str, tol: float, max_iter: int, options: Mapping[str, Any]
) -> tuple[bytes, list[Step]]:
    """Return one test vector and its steps.

    The vector contains the impulse of the package bit for bit, or only the residual to reach for methods whose bits
    differ in the library (`OTHER_BITS`).

    Raises
    ------
    NotSupported
        The library does not have the method, option or formulation that the package used.
    """
    max_iter = max_iter or registry.specs()[solver].max_iter
    solution = lv.solve(problem, solver, tol=tol, max_iter=max_iter, **options)
    form = solution.solver.form
    if ", then" in form or (
        problem.matrix is None and ("rows of A" in form or (solver == "pgs" and form != "whitened J"))
    ):
        raise NotSupported(
            f"{solver} formed A of J and M, which the C library does not do: export the problem with its "
            "matrix, problem.csr"
        )
    steps = [
        s
        for s in split_into_steps(solution, Step(solver, max_iter, tol, options))
        if is_accepted_by_library(problem, s.solver)
    ]
    packed_problem = pack_problem(problem)
    if not steps:
        raise NotSupported(
            f"the C library's {solver} does not accept {problem.name or 'this problem'}: choose another "
            "solver; the function lav_takes tests whether a solver accepts a problem"
        )
    impulse, relative = solution.impulse, solution.residual.relative
    if solver == "newton" and (problem.generalized is None or form == "velocity"):
        impulse = run_compiled_newton(problem, tol, max_iter)[0]
        relative = lv.residual(problem, impulse, tol=tol).relative
    is_met = solver in OTHER_BITS
    out = struct.pack("<q", len(steps)) + b"".join(step.to_bytes() for step in steps) + packed_problem
    return out + struct.pack("<qd", is_met, tol if is_met else relative) + (
        b"" if is_met else impulse.tobytes()
    ), steps


def run_compiled_newton(problem: lv.Problem, tol: float, budget: int) -> tuple[FloatArray, int]:
    """Return the impulse (m,) [N s] and the factorisations of the compiled driver of `newton`, as in the library.

    `lavender.solve` differs: it first tries warm-started sweeps and a solve of the joints, searches for certificates
    between the stages of the driver, and solves J and M of free bodies in the form of bodies.

    Raises
    ------
    NotSupported
        The driver does not support the problem.
    """
    # Make the judge compute d, nu and J M^-1 J^T, which the driver reads.
    lv.residual(problem, problem.start())
    impulse = (problem.start() if problem.guess is None else problem.guess).copy()
    driver, outcome = Driver(problem.metric), OUTCOMES["more"]
    if not driver.fits:
        raise NotSupported(
            "the C library's newton does not accept this problem; choose another solver (--solver)"
        )
    driver.start(impulse, tol, budget)
    while outcome in (OUTCOMES["more"], OUTCOMES["certificate"]):
        outcome = driver.step(10**6, impulse)
    return impulse, driver.counts[1]


def pack_problem(problem: Any) -> bytes:
    """Return the bytes of a problem: counts, then arrays in the order of `lav_problem`."""
    fields = make_problem_view(problem)
    out = struct.pack("<9q", *fields.counts)
    for values in fields.arrays.values():
        data = b"" if values is None else np.ascontiguousarray(values).tobytes()
        out += struct.pack("<q", -1 if values is None else len(data)) + data + bytes(-len(data) % 8)
    return out
