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

import lavender.base.starting  # noqa: I001 - first: Ctrl-C from here on

from typing import TYPE_CHECKING, Any

import lavender.base.built
from lavender.base.later import imported
from lavender._version import __version__
from lavender.problem.cones import (
    CONTACT,
    CONTACT_BOX,
    CONTACT_ELLIPSE,
    CONTACT_ROLLING,
    CONTACT_SPIN,
    ROUND,
    ROW,
    Cones,
)
from lavender.base.errors import (
    CapabilityError,
    InputError,
    InUse,
    LavenderError,
    SolveFailed,
    SolverUnavailable,
    UnknownName,
)
from lavender.problem.generalized import Generalized
from lavender.problem import Problem, QPSolution
from lavender.solvers.registry import SolverSpec, available, get, known, register
from lavender.judge.residuals import Residual, residual
from lavender.problem.rows import Rows
from lavender.judge.solution import Claim, Solution, Status, Turn
from lavender.solving.solve import prepare, solve

if TYPE_CHECKING:
    from lavender import io
    from lavender.batch.data import Batch
    from lavender.batch.residuals import Residuals, residual_many
    from lavender.batch.solve import Solutions, solve_many
    from lavender.gradient import Derivative, derivative, derivatives
    from lavender.io import load
    from lavender.lab import bench, motion, phenomena, report, suite
    from lavender.lab.check import CrossCheck, cross_check
    from lavender.lab.diagnostics import Suspicion, diagnose
    from lavender.lab.diagnostics.redundancy import Redundancy, redundancy
    from lavender.lab.motion import MotionError, Motions, motion_error, motions
    from lavender.lab.proof import Enclosure, prove
    from lavender.sim import engine, scene
    from lavender.sim.engine import SOLVER_FIELDS, Simulation, Snapshot
    from lavender.sim.scene import Scene
    from lavender.solving.plan import Plan, explain
    from lavender.solving.quadratic import solve_qp

# Public name -> module that holds it, imported at the first use of the name.
_LATER = {
    "Batch": "lavender.batch.data",
    "CrossCheck": "lavender.lab.check",
    "Derivative": "lavender.gradient",
    "Enclosure": "lavender.lab.proof",
    "MotionError": "lavender.lab.motion",
    "Motions": "lavender.lab.motion",
    "Plan": "lavender.solving.plan",
    "Redundancy": "lavender.lab.diagnostics.redundancy",
    "Residuals": "lavender.batch.residuals",
    "SOLVER_FIELDS": "lavender.sim.engine",
    "Scene": "lavender.sim.scene",
    "Simulation": "lavender.sim.engine",
    "Snapshot": "lavender.sim.engine",
    "Solutions": "lavender.batch.solve",
    "Suspicion": "lavender.lab.diagnostics",
    "cross_check": "lavender.lab.check",
    "derivative": "lavender.gradient",
    "derivatives": "lavender.gradient",
    "diagnose": "lavender.lab.diagnostics",
    "explain": "lavender.solving.plan",
    "load": "lavender.io",
    "motion_error": "lavender.lab.motion",
    "motions": "lavender.lab.motion",
    "prove": "lavender.lab.proof",
    "redundancy": "lavender.lab.diagnostics.redundancy",
    "residual_many": "lavender.batch.residuals",
    "solve_many": "lavender.batch.solve",
    "solve_qp": "lavender.solving.quadratic",
}

# Public module -> where it stands.
_MODULES = {
    "bench": "lavender.lab.bench",
    "cones": "lavender.problem.cones",
    "engine": "lavender.sim.engine",
    "errors": "lavender.base.errors",
    "export": "lavender.export",
    "io": "lavender.io",
    "motion": "lavender.lab.motion",
    "phenomena": "lavender.lab.phenomena",
    "registry": "lavender.solvers.registry",
    "report": "lavender.lab.report",
    "scene": "lavender.sim.scene",
    "suite": "lavender.lab.suite",
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
    if name in _MODULES:
        value = imported(_MODULES[name])
    elif name in _LATER:
        value = getattr(imported(_LATER[name]), name)
    else:
        raise AttributeError(f"module 'lavender' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)


for _name in ("auto", "admm", "anderson", "direct", "newton", "nncg"):  # and whom `auto` asks
    get(_name)  # with the package: the first solve may have a time limit
lavender.base.starting.end()
