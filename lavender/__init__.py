"""lavender solves the constraint problem of one rigid-body time step with the solver you name, and judges the result.

    problem = lavender.Problem.lcp(A, b)            # A [1/kg], b [m/s]; or contact, linear, from_rows, from_jacobian
    solution = lavender.solve(problem, tol=1e-8)    # by `auto`, or lavender.solve(problem, "pgs", ...)
    solution.impulse, solution.residual.relative    # [N s], [-]

Problems   `Problem`, `Cones` (bounds and friction), `Rows` (bodies), `Generalized` (J and M), `load`
Worlds     `Batch` (many problems in arrays), `solve_many`, `residual_many`
Solving    `solve`, `solve_qp`, `prepare` (for repeated steps), `available`, `known`, `explain` (the way of `auto`)
Results    `Solution`, `residual` (judge any impulse), `prove` (an exact solution near by), `diagnose` (mistakes in the
           data), `motion_error`, `redundancy`
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
from lavender.problem import Problem, QPSolution
from lavender.redundancy import Redundancy, redundancy
from lavender.registry import SolverSpec, available, get, known, register
from lavender.residuals import Residual, residual
from lavender.rows import Rows
from lavender.solution import Claim, Solution, Status, Turn
from lavender.solve import prepare, solve

if TYPE_CHECKING:
    from lavender import bench, engine, io, motion, phenomena, report, scene, suite
    from lavender.batch import Batch
    from lavender.check import CrossCheck, cross_check
    from lavender.engine import SOLVER_FIELDS, Simulation, Snapshot
    from lavender.gradient import Derivative, derivative, derivatives
    from lavender.io import load
    from lavender.many import Residuals, Solutions, residual_many, solve_many
    from lavender.motion import MotionError, Motions, motion_error, motions
    from lavender.plan import Plan, explain
    from lavender.proof import Enclosure, prove
    from lavender.quadratic import solve_qp
    from lavender.scene import Scene
    from lavender.suspicions import Suspicion, diagnose

# Public name -> module that holds it; the module itself where both are the same.
_LATER = {
    "Batch": "lavender.batch",
    "CrossCheck": "lavender.check",
    "Derivative": "lavender.gradient",
    "MotionError": "lavender.motion",
    "Motions": "lavender.motion",
    "Plan": "lavender.plan",
    "Residuals": "lavender.many",
    "SOLVER_FIELDS": "lavender.engine",
    "Scene": "lavender.scene",
    "Simulation": "lavender.engine",
    "Snapshot": "lavender.engine",
    "Solutions": "lavender.many",
    "Suspicion": "lavender.suspicions",
    "bench": "lavender.bench",
    "cross_check": "lavender.check",
    "Enclosure": "lavender.proof",
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
    "prove": "lavender.proof",
    "report": "lavender.report",
    "scene": "lavender.scene",
    "residual_many": "lavender.many",
    "solve_many": "lavender.many",
    "solve_qp": "lavender.quadratic",
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
    "Batch",
    "CapabilityError",
    "Claim",
    "Cones",
    "CrossCheck",
    "Derivative",
    "Enclosure",
    "Generalized",
    "InUse",
    "InputError",
    "LavenderError",
    "MotionError",
    "Motions",
    "Plan",
    "Problem",
    "QPSolution",
    "Redundancy",
    "Residual",
    "Residuals",
    "Rows",
    "Scene",
    "Simulation",
    "Snapshot",
    "Solution",
    "Solutions",
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
    "prove",
    "redundancy",
    "register",
    "report",
    "residual",
    "residual_many",
    "scene",
    "solve",
    "solve_many",
    "solve_qp",
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


for _name in ("auto", "anderson", "direct", "newton", "nncg"):  # and whom `auto` asks
    get(_name)  # with the package: the first solve may have a time limit
lavender._starting.end()
