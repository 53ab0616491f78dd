"""lavender solves the constraint problem of one rigid-body time step with the solver you name, and judges the result.

    problem = lavender.Problem.lcp(A, b)            # A [1/kg], b [m/s]; or contact, linear, from_rows, from_jacobian
    solution = lavender.solve(problem, tol=1e-8)    # by `auto`, or lavender.solve(problem, "pgs", ...)
    solution.impulse, solution.residual.relative    # [N s], [-]

Problems   `Problem`, `Cones` (bounds and friction), `Rows` (bodies), `Generalized` (J and M), `load`
Solving    `solve`, `solve_many`, `prepare` (for repeated steps), `available`, `known`, `explain` (the plan of `auto`)
Results    `Solution`, `residual` (judge any impulse), `diagnose` (mistakes in the data), `motion_error`, `redundancy`
Engine     `Scene`, `Simulation`
Measuring  `bench`, `report`, `suite` (built-in problems), `io` (files and other simulators)

Submodules and the engine are imported at their first use.
"""

import lavender._starting  # noqa: I001 - first: Ctrl-C from here on

from importlib import import_module
from typing import TYPE_CHECKING, Any

import lavender._built
from lavender._version import __version__
from lavender.cones import (
    CONTACT,
    CONTACT_BOX,
    CONTACT_ELLIPSE,
    CONTACT_ROLLING,
    CONTACT_SPIN,
    ROUND,
    ROW,
    Cones,
)
from lavender.errors import (
    CapabilityError,
    InputError,
    InUse,
    LavenderError,
    SolveFailed,
    SolverUnavailable,
    UnknownName,
)
from lavender.generalized import Generalized
from lavender.problem import Problem
from lavender.redundancy import Redundancy, redundancy
from lavender.registry import TABLES, SolverSpec, available, get, known, load_table, register
from lavender.residuals import Residual, residual
from lavender.rows import Rows
from lavender.solution import Claim, Solution, Status, Turn
from lavender.solve import prepare, solve

if TYPE_CHECKING:
    from lavender import bench, engine, io, motion, phenomena, report, scene, suite
    from lavender.check import CrossCheck, cross_check
    from lavender.engine import SOLVER_FIELDS, Simulation, Snapshot
    from lavender.gradient import Derivative, derivative, derivatives
    from lavender.io import load
    from lavender.many import solve_many
    from lavender.motion import MotionError, Motions, motion_error, motions
    from lavender.plan import Plan, explain
    from lavender.scene import Scene
    from lavender.suspicions import Suspicion, diagnose

# Public name -> module that holds it; the module itself where both are the same.
_LATER = {
    "CrossCheck": "lavender.check",
    "Derivative": "lavender.gradient",
    "MotionError": "lavender.motion",
    "Motions": "lavender.motion",
    "Plan": "lavender.plan",
    "SOLVER_FIELDS": "lavender.engine",
    "Scene": "lavender.scene",
    "Simulation": "lavender.engine",
    "Snapshot": "lavender.engine",
    "Suspicion": "lavender.suspicions",
    "bench": "lavender.bench",
    "cross_check": "lavender.check",
    "derivative": "lavender.gradient",
    "derivatives": "lavender.gradient",
    "diagnose": "lavender.suspicions",
    "engine": "lavender.engine",
    "explain": "lavender.plan",
    "io": "lavender.io",
    "load": "lavender.io",
    "motion": "lavender.motion",
    "motion_error": "lavender.motion",
    "motions": "lavender.motion",
    "phenomena": "lavender.phenomena",
    "report": "lavender.report",
    "scene": "lavender.scene",
    "solve_many": "lavender.many",
    "suite": "lavender.suite",
}

__all__ = [
    "CONTACT",
    "CONTACT_BOX",
    "CONTACT_ELLIPSE",
    "CONTACT_ROLLING",
    "CONTACT_SPIN",
    "ROUND",
    "ROW",
    "SOLVER_FIELDS",
    "CapabilityError",
    "Claim",
    "Cones",
    "CrossCheck",
    "Derivative",
    "Generalized",
    "InUse",
    "InputError",
    "LavenderError",
    "MotionError",
    "Motions",
    "Plan",
    "Problem",
    "Redundancy",
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
    "Suspicion",
    "Turn",
    "UnknownName",
    "__version__",
    "available",
    "bench",
    "cross_check",
    "derivative",
    "derivatives",
    "diagnose",
    "engine",
    "explain",
    "get",
    "io",
    "known",
    "load",
    "motion",
    "motion_error",
    "motions",
    "phenomena",
    "prepare",
    "redundancy",
    "register",
    "report",
    "residual",
    "scene",
    "solve",
    "solve_many",
    "suite",
]


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module 'lavender' has no attribute {name!r}")
    module = import_module(_LATER[name])
    value = module if _LATER[name] == f"lavender.{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


load_table(TABLES[0])  # with the package: the first solve may have a time limit
lavender._starting.end()
