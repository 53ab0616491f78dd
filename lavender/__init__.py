"""lavender: the constraint problem of one rigid-body step, solved by the solver you name, and judged."""

from lavender._version import __version__
from lavender.check import CrossCheck, cross_check
from lavender.cones import CONTACT, CONTACT_SPIN, ROW, Cones
from lavender.engine import SOLVER_FIELDS, Simulation, Snapshot
from lavender.errors import (
    CapabilityError,
    InputError,
    LavenderError,
    SolveFailed,
    SolverUnavailable,
    UnknownName,
)
from lavender.problem import Problem, Rows
from lavender.registry import SolverSpec, available, get, known, register
from lavender.residuals import Residual, residual
from lavender.scene import Scene
from lavender.solution import Claim, Solution, Status
from lavender.solve import prepare, solve

__all__ = [
    "CONTACT",
    "CONTACT_SPIN",
    "ROW",
    "SOLVER_FIELDS",
    "CapabilityError",
    "Claim",
    "Cones",
    "CrossCheck",
    "InputError",
    "LavenderError",
    "Problem",
    "Residual",
    "Rows",
    "Scene",
    "Simulation",
    "Snapshot",
    "Solution",
    "SolveFailed",
    "SolverSpec",
    "SolverUnavailable",
    "Status",
    "UnknownName",
    "__version__",
    "available",
    "cross_check",
    "get",
    "known",
    "prepare",
    "register",
    "residual",
    "solve",
]
