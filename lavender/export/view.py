"""Convert problems, options and simulations to the formats of the C library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from lavender.base.errors import InputError
from lavender.export.header import parse_enum_constants, parse_struct_fields
from lavender.export.library import HEADER
from lavender.problem import Problem
from lavender.sim.engine.simulation import Simulation
from lavender.solvers import registry

_HEADER = HEADER.read_text(encoding="utf-8")
#: Arrays of `lav_problem` in the order of the struct, with their types.
ARRAYS: dict[str, Any] = {
    name: np.dtype({"double": "f8", "int32_t": "i4", "uint64_t": "u8"}[kind.split()[1]])
    for kind, name in parse_struct_fields(_HEADER, "lav_problem")
    if "*" in kind
}
#: Solvers by their numbers in the library.
METHODS = {
    name: parse_enum_constants(_HEADER)[f"LAV_{name.upper()}"]
    for name, spec in registry.specs().items()
    if spec.builtin and not spec.external and not spec.delegates
}
#: Solvers with results in the library that differ in bits from the package: the package uses another factorisation, or
#: the solver is a sequence of solvers.
OTHER_BITS = ("admm", "auto")
ORDERS = {"given": 0, "symmetric": 1, "random": 2, "reverse": 3}
SWEEPS = {None: 0, "pgs": 1, "blocks": 2}
#: Forms of A (1 a matrix, 2 bodies, 3 J and M) that a method supports, for methods that do not support all three.
FORMS = {"sequential_impulses": (2,), "pgs": (1, 3), "direct": (1, 2), "lemke": (1, 2), "admm": (1, 2)}
FORMS |= dict.fromkeys(("sor", "gauss_seidel", "jacobi"), (1,))
MAGIC = b"LAVIMG1\0"  # Magic word of the images that `lav_engine_open` reads and `lav_engine_image` writes.


class NotSupported(InputError):
    """The C library does not support a problem, solver or option; the message names it."""


@dataclass(frozen=True)
class ProblemView:
    """The contents of a `lav_problem`.

    Parameters
    ----------
    counts : tuple of int
        Form, law, and numbers of blocks, rows, entries, bodies, joints, velocities and entries of M.
    arrays : mapping of str to array or None
        Arrays by name; None for a null pointer.
    """

    counts: tuple[int, ...]
    arrays: dict[str, Any]


def make_problem_view(problem: Problem) -> ProblemView:
    """Return the contents of the `lav_problem` of a problem; its start is the problem's guess, if there is one.

    Raises
    ------
    NotSupported
        The problem has ellipses, or its generalised velocities have been reordered.
    """
    c = problem.cones
    if c.has_ellipse:
        raise NotSupported(
            "the library has no ellipses: give it `problem.disk`, the same problem with scaled tangents"
        )
    arrays: dict[str, Any] = dict.fromkeys(ARRAYS)
    arrays |= {"block_ptr": c.ptr, "kind": c.kind, "lower": c.lower, "upper": c.upper, "mu": c.mu}
    arrays |= {"patch_radius": c.patch_radius, "b": problem.b, "impulse": problem.guess, "rolling": c.rolling}
    form, entries, bodies, joints, velocities, mass = 1, 0, 0, 0, 0, 0
    if problem.rows is not None:
        r, form = problem.rows, 2
        bodies, joints = r.n_bodies, r.n_joints
        arrays |= {f.name: getattr(r, f.name) for f in fields(r) if f.name in ARRAYS}
        arrays |= {"velocity": r.v_free, "compliance": problem.compliance}
    elif problem.generalized is not None:
        g, form = problem.generalized, 3
        if g.order is not None:
            raise NotSupported(
                "the C library needs M with the pattern of a tree; the factor of this M needed another "
                "order of the velocities: give the problem as a matrix, problem.csr"
            )
        arrays |= zip(("index_ptr", "index", "value"), g.operator.jac, strict=True)
        arrays |= zip(("mass_ptr", "mass_index", "mass_value"), g.operator.mass, strict=True)
        arrays |= {"velocity": g.v_free, "compliance": problem.compliance}
        velocities, mass = g.operator.n, len(g.operator.mass[1])
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


def is_accepted_by_library(problem: Problem, solver: str) -> bool:
    """Return whether the library's method accepts a problem that the package's solver accepts, as `lav_takes` does."""
    form = 2 if problem.rows is not None else 3 if problem.generalized is not None else 1
    c = problem.cones
    if form not in FORMS.get(solver, (1, 2, 3)):
        return False
    if solver in ("direct", "lemke"):
        return not np.any(c.is_contact & (np.diff(c.ptr) > 1))
    return solver != "newton" or form == 3 or not (c.has_round or c.has_more_components)


def encode_options(solver: str, options: Mapping[str, Any]) -> tuple[tuple[int, ...], float]:
    """Encode the options of a solver as five integers (order, memory, sweep, convex, keeps of `lav_options`) and omega.

    Raises
    ------
    NotSupported
        The library does not have the solver or the option.
    """
    remaining = dict(options)
    order = remaining.pop("order", "given")
    sweep, restart = remaining.pop("sweep", None), remaining.pop("restart", "growth")
    numbers = (
        remaining.pop("memory", 10 if solver == "admm" else 5),
        SWEEPS.get(sweep, -1),
        remaining.pop("convex", 0),
        int(restart == "against"),
    )
    omega = remaining.pop("omega", {"sor": 1.5, "gauss_seidel": 1.0}.get(solver)) or 0.0
    if remaining or order not in ORDERS or solver not in METHODS:
        unsupported = ", ".join(remaining) or (f"order={order!r}" if order not in ORDERS else solver)
        raise NotSupported(
            f"{unsupported} is not in the C library; choose a solver and options that the header lavender.h "
            "lists"
        )
    return (ORDERS[order], *numbers), float(omega)


def engine_image(simulation: Simulation) -> bytes:
    """Return the state of a simulation as an image for `lav_engine_open`.

    The image contains a magic word, a hash, sizes (10) int32, reals, int32 padded to 8 bytes, and keys.

    Parameters
    ----------
    simulation : Simulation
        A simulation of any scene; the image includes its sweeps and order.

    Returns
    -------
    bytes
    """
    state = simulation.snapshot()
    index = state.index.astype("<i4").tobytes()
    body = (
        state.size.astype("<i4").tobytes()
        + state.real.astype("<f8").tobytes()
        + index
        + bytes(-len(index) % 8)
    )
    body += state.keys.astype("<u8").tobytes()
    h, full = 0, 2**64 - 1
    for word in np.frombuffer(body, "<u8").tolist():
        h = ((h ^ word) * 0x9E3779B97F4A7C15) & full
        h ^= h >> 29
    return MAGIC + (h ^ h >> 32).to_bytes(8, "little") + body
