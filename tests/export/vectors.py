"""Problems and options in the formats of the C library, and test vectors: problems with the bits of their results.

The program `parity/check.c` reads a file of test vectors: a magic word of 8 bytes, the number of vectors, and the
vectors. A vector contains its steps (`Step`), the problem in the order of `lav_problem` (-1 for a null pointer), and
the expected result. Integers have 8 bytes; an array is its size in bytes and its data, padded to 8 bytes. All numbers
are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from header import parse_enum_constants, parse_struct_fields

import lavender as lv
from lavender.base.errors import InputError
from lavender.export import HEADER
from lavender.solvers import registry
from lavender_ext.core.method import OUTCOMES
from lavender_ext.driver.driver import Driver

_HEADER = HEADER.read_text(encoding="utf-8")
#: Arrays of `lav_problem` in the order of the struct, with their types.
ARRAYS: dict[str, Any] = {
    name: np.dtype({"double": "f8", "int32_t": "i4", "uint64_t": "u8"}[kind.split()[1]])
    for kind, name in parse_struct_fields(_HEADER, "lav_problem")
    if "*" in kind
}
#: Solvers by their numbers in the library.
METHODS = {
    name: number
    for name, spec in registry.specs().items()
    if spec.builtin and (number := parse_enum_constants(_HEADER).get(f"LAV_{name.upper()}"))
}
#: Solvers with results in the library that differ in bits from the package: the package uses another factorisation, or
#: the solver is a sequence of solvers.
OTHER_BITS = ("admm", "auto")
ORDERS = {"given": 0, "symmetric": 1, "random": 2, "reverse": 3}
SWEEPS = {None: 0, "pgs": 1, "blocks": 2}
#: Forms of A (1 a matrix, 2 bodies, 3 J and M) that a method supports, for methods that do not support all three.
FORMS = {
    "sequential_impulses": (2,),
    "pgs": (1, 3),
    "direct": (1, 2),
    "lemke": (1, 2),
    "admm": (1, 2),
}
FORMS |= dict.fromkeys(("sor", "gauss_seidel", "jacobi"), (1,))


class NotSupported(InputError):
    """The C library does not support a problem, solver or option; the message names it."""


@dataclass(frozen=True)
class ProblemView:
    """The contents of a `lav_problem`."""

    counts: tuple[
        int, ...
    ]  # Form, law, and numbers of blocks, rows, entries, bodies, joints, velocities, entries of M.
    arrays: dict[str, Any]  # By name; None for a null pointer.


def make_problem_view(problem: lv.Problem) -> ProblemView:
    """Return the contents of the `lav_problem` of a problem; its start is the problem's guess, if there is one."""
    c = problem.cones
    if c.has_ellipse:
        raise NotSupported(
            "the library has no ellipses: give it `problem.disk`, the same problem with scaled tangents"
        )
    arrays: dict[str, Any] = dict.fromkeys(ARRAYS)
    arrays |= {"block_ptr": c.ptr, "kind": c.kind, "lower": c.lower, "upper": c.upper, "mu": c.mu}
    arrays |= {
        "patch_radius": c.patch_radius,
        "b": problem.b,
        "impulse": problem.guess,
        "rolling": c.rolling,
    }
    form, entries, bodies, joints, velocities, mass = 1, 0, 0, 0, 0, 0
    if problem.rows is not None:
        r = problem.rows
        form = 2
        bodies, joints = r.n_bodies, r.n_joints
        arrays |= {f.name: getattr(r, f.name) for f in fields(r) if f.name in ARRAYS}
        arrays |= {"velocity": r.v_free, "compliance": problem.compliance}
    elif problem.generalized is not None:
        g = problem.generalized
        form = 3
        if g.order is not None:
            raise NotSupported(
                "the C library needs M with the pattern of a tree; the factor of this M needed another "
                "order of the velocities: give the problem as a matrix, problem.csr"
            )
        arrays |= zip(("index_ptr", "index", "value"), g.operator.jac, strict=True)
        arrays |= zip(("mass_ptr", "mass_index", "mass_value"), g.operator.mass, strict=True)
        arrays |= {"velocity": g.v_free, "compliance": problem.compliance}
        velocities = g.operator.n
        mass = len(g.operator.mass[1])
    else:
        a = problem.csr
        arrays |= {"index_ptr": a.indptr, "index": a.indices, "value": a.data}
    if arrays["value"] is not None:
        entries = len(arrays["value"])
    for key, values in arrays.items():
        if values is not None:
            arrays[key] = np.ascontiguousarray(values, ARRAYS[key])
    law = int(problem.friction == "cone")
    return ProblemView(
        (form, law, problem.n_blocks, problem.m, entries, bodies, joints, velocities, mass), arrays
    )


def is_accepted_by_library(problem: lv.Problem, solver: str) -> bool:
    """Return whether the library's method accepts a problem that the package's solver accepts, as `lav_takes` does."""
    form = 2 if problem.rows is not None else 3 if problem.generalized is not None else 1
    c = problem.cones
    if form not in FORMS.get(solver, (1, 2, 3)):
        return False
    if solver in ("direct", "lemke"):
        return not np.any(c.is_contact & (np.diff(c.ptr) > 1))
    return solver != "newton" or form == 3 or not (c.has_round or c.has_rolling)


def encode_options(solver: str, options: Mapping[str, Any]) -> tuple[tuple[int, ...], float]:
    """Encode the options of a solver as five integers (order, memory, sweep, convex, keeps) and omega."""
    remaining = dict(options)
    order = remaining.pop("order", "given")
    sweep = remaining.pop("sweep", None)
    restart = remaining.pop("restart", "growth")
    convex = remaining.pop("convex", None if solver == "anderson" else 0)
    numbers = (
        remaining.pop("memory", 10 if solver == "admm" else 5),
        SWEEPS.get(sweep, -1),
        -1 if convex is None else convex,  # -1 selects them by tests.
        int(restart == "against"),
    )
    omega = remaining.pop("omega", {"sor": 1.5, "gauss_seidel": 1.0}.get(solver)) or 0.0
    if remaining or order not in ORDERS or solver not in METHODS:
        unsupported = ", ".join(remaining) or (
            f"order={order!r}" if order not in ORDERS else solver
        )
        raise NotSupported(
            f"{unsupported} is not in the C library; choose a solver and options that the header lavender.h lists"
        )
    return (ORDERS[order], *numbers), float(omega)


MAGIC = b"LAVVEC3\0"
# Counters of `work` that the library counts as iterations.
ITERATION_COUNTS = ("sweeps", "factorisations", "solves")


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
        return struct.pack(
            "<7qdqd", *self.get_option_integers(), 0, omega, self.iterations, self.tol
        )


def split_into_steps(solution: lv.Solution, step: Step) -> list[Step]:
    """Return the steps of a solve: `step` itself or, for `auto`, one step for each solver that ran.

    The iteration budget of such a step is twice the work of that solver in the solve.
    """
    if step.solver != "auto":
        return [step]
    work: dict[str, int] = {}
    for stage in solution.stages:
        solver = stage.solver.split()[0]
        pivots = solver in ("direct", "lemke")  # Pivoting methods need no iteration limit.
        iterations = (
            0 if pivots else max((stage.work.get(kind, 0) for kind in ITERATION_COUNTS), default=0)
        )
        work[solver] = work.get(solver, 0) + (2 * iterations or registry.specs()[solver].max_iter)
    steps = []
    for name, count in (work or {"anderson": 1}).items():
        steps.append(replace(step, solver=name, iterations=count, options={}))
    return steps


def join_vectors(packed: Sequence[bytes]) -> bytes:
    """Return the content of `vectors.bin` from vectors of `make_test_vector`."""
    return MAGIC + struct.pack("<q", len(packed)) + b"".join(packed)


def make_test_vector(
    problem: Any, solver: str, tol: float, max_iter: int, options: Mapping[str, Any]
) -> tuple[bytes, list[Step]]:
    """Return one test vector and its steps; of methods of `OTHER_BITS` it contains only the residual to reach."""
    max_iter = max_iter or registry.specs()[solver].max_iter
    solution = lv.solve(problem, solver, tol=tol, max_iter=max_iter, **options)
    form = solution.solver.form
    if ", then" in form or (
        problem.matrix is None
        and ("rows of A" in form or (solver == "pgs" and form != "whitened J"))
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
    impulse = solution.impulse
    relative = solution.residual.relative
    if solver == "newton" and (problem.generalized is None or form == "velocity"):
        impulse = run_compiled_newton(problem, tol, max_iter)[0]
        relative = lv.residual(problem, impulse, tol=tol).relative
    is_met = solver in OTHER_BITS
    out = (
        struct.pack("<q", len(steps)) + b"".join(step.to_bytes() for step in steps) + packed_problem
    )
    return out + struct.pack("<qd", is_met, tol if is_met else relative) + (
        b"" if is_met else impulse.tobytes()
    ), steps


def run_compiled_newton(problem: lv.Problem, tol: float, budget: int) -> tuple[np.ndarray, int]:
    """Return the impulse (m,) [N s] and the factorisations of the compiled driver of `newton`, as in the library.

    `lavender.solve` differs: it first tries warm-started sweeps and a solve of the joints, searches for certificates
    between the stages of the driver, and solves J and M of free bodies in the form of bodies.
    """
    # Make the judge compute d, nu and J M^-1 J^T, which the driver reads.
    lv.residual(problem, problem.start())
    impulse = (problem.start() if problem.guess is None else problem.guess).copy()
    driver = Driver(problem.metric)
    outcome = OUTCOMES["more"]
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
