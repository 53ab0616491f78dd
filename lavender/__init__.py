"""lavender solves the constraint problem of one rigid-body time step with the solver you name, and judges the result.

    problem = lavender.Problem.lcp(A, b)            # A [1/kg], b [m/s]; or contact, linear, from_rows, from_jacobian
    solution = lavender.solve(problem, tol=1e-8)    # by `auto`, or lavender.solve(problem, "pgs", ...)
    solution.impulse, solution.residual.relative    # [N s], [-]

Problems   `Problem`, `Cones` (bounds and friction), `Rows` and `RowBuilder` (bodies), `Generalized` (J and M), `load`
Worlds     `Batch` (many problems in arrays), `solve_many`, `residual_many`
Solving    `solve`, `solve_qp`, `prepare` (for repeated steps), `available`, `known`, `explain` (decision trace
           of `auto`)
Results    `Solution`, `residual` (judge any impulse), `diagnose` (mistakes in the
           data), `motion_error`, `redundancy`, `contact_forces` (in newtons), `explain_slip` (why contacts slide),
           `compare` (why two engines, or an engine and the rigid laws, differ after a step)
Engine     `Scene`, `Simulation`
Measuring  `report`, `suite` (built-in problems), `io` (files and other simulators)

Programs   `qp` (quadratic programs with the calls of qpsolvers)

Submodules and the engine are imported at their first use.
"""

import sys
from typing import TYPE_CHECKING

import lavender.base.check_build  # noqa: F401 - first: it explains why kernels cannot be imported
from lavender._version import __version__
from lavender.base.errors import (
    CapabilityError,
    InputError,
    InUse,
    LavenderError,
    SolveFailed,
    SolverUnavailable,
    UnknownName,
)
from lavender.base.lazy_import import import_module_under_lock
from lavender.judge.residuals import Residual, residual
from lavender.judge.solution import Claim, History, Solution, SolverStage, Status
from lavender.problem import Problem, QPSolution
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
from lavender.problem.generalized import Generalized
from lavender.problem.rows import Rows
from lavender.solvers.registry import SolverSpec, available, get, known, register
from lavender.solving.prepared import prepare
from lavender.solving.solve import solve

if TYPE_CHECKING:
    from lavender import contract as contract
    from lavender import export as export
    from lavender import io, qp, report, suite
    from lavender.audit.slip import SlipExplanation, explain_slip
    from lavender.base import errors as errors
    from lavender.batch.data import Batch
    from lavender.batch.residuals import Residuals, residual_many
    from lavender.batch.solve import Solutions, solve_many
    from lavender.causes.comparison import Comparison, compare
    from lavender.diagnostics import Diagnostic, diagnose
    from lavender.diagnostics.forces import ContactForces, contact_forces
    from lavender.diagnostics.motion_error import MotionError, motion_error
    from lavender.diagnostics.redundancy import Redundancy, redundancy
    from lavender.gradient import Derivative, derivative, derivatives
    from lavender.io import load
    from lavender.problem import cones as cones
    from lavender.problem.row_builder import RowBuilder
    from lavender.programs.quadratic import solve_qp
    from lavender.qp import available_solvers as available_solvers
    from lavender.report.check import CrossCheck, cross_check
    from lavender.sim import engine, scene
    from lavender.sim.engine import SOLVER_FIELDS, Simulation, Snapshot
    from lavender.sim.scene import Scene
    from lavender.solvers import registry as registry
    from lavender.solving.plan import Plan, explain

# Module -> public names in it, imported when a name is first used.
_LAZY_NAMES = {
    "lavender.batch.data": ("Batch",),
    "lavender.batch.residuals": ("Residuals", "residual_many"),
    "lavender.batch.solve": ("Solutions", "solve_many"),
    "lavender.causes.comparison": ("Comparison", "compare"),
    "lavender.gradient": ("Derivative", "derivative", "derivatives"),
    "lavender.io": ("load",),
    "lavender.report.check": ("CrossCheck", "cross_check"),
    "lavender.diagnostics": ("Diagnostic", "diagnose"),
    "lavender.diagnostics.forces": ("ContactForces", "contact_forces"),
    "lavender.diagnostics.redundancy": ("Redundancy", "redundancy"),
    "lavender.diagnostics.motion_error": ("MotionError", "motion_error"),
    "lavender.audit.slip": ("SlipExplanation", "explain_slip"),
    "lavender.problem.row_builder": ("RowBuilder",),
    "lavender.qp": ("available_solvers",),
    "lavender.sim.engine": ("SOLVER_FIELDS", "Simulation", "Snapshot"),
    "lavender.sim.scene": ("Scene",),
    "lavender.solving.plan": ("Plan", "explain"),
    "lavender.programs.quadratic": ("solve_qp",),
}
_MODULE_OF_NAME = {name: module for module, names in _LAZY_NAMES.items() for name in names}

# Public module -> its full name.
_LAZY_MODULES = {
    "cones": "lavender.problem.cones",
    "contract": "lavender.contract",
    "engine": "lavender.sim.engine",
    "errors": "lavender.base.errors",
    "export": "lavender.export",
    "io": "lavender.io",
    "qp": "lavender.qp",
    "registry": "lavender.solvers.registry",
    "report": "lavender.report",
    "scene": "lavender.sim.scene",
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
    "Comparison",
    "Cones",
    "ContactForces",
    "CrossCheck",
    "Derivative",
    "Diagnostic",
    "Generalized",
    "History",
    "InUse",
    "InputError",
    "LavenderError",
    "MotionError",
    "Plan",
    "Problem",
    "QPSolution",
    "Redundancy",
    "Residual",
    "Residuals",
    "RowBuilder",
    "Rows",
    "Scene",
    "Simulation",
    "SlipExplanation",
    "Snapshot",
    "Solution",
    "Solutions",
    "SolveFailed",
    "SolverSpec",
    "SolverStage",
    "SolverUnavailable",
    "Status",
    "UnknownName",
    "__version__",
    "available",
    "available_solvers",
    "compare",
    "contact_forces",
    "cross_check",
    "derivative",
    "derivatives",
    "diagnose",
    "engine",
    "explain",
    "explain_slip",
    "get",
    "io",
    "known",
    "load",
    "motion_error",
    "prepare",
    "qp",
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


if not TYPE_CHECKING:  # Hide `__getattr__` from type checkers, so that they report unknown names.

    def __getattr__(name):
        if name in _LAZY_MODULES:
            value = import_module_under_lock(_LAZY_MODULES[name])
        elif name in _MODULE_OF_NAME:
            value = getattr(import_module_under_lock(_MODULE_OF_NAME[name]), name)
        else:
            module = sys.modules[__name__]
            raise AttributeError(
                f"module 'lavender' has no attribute {name!r}", name=name, obj=module
            )
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(__all__)


# Import `auto` and the solvers that it runs with the package, because the first solve may have a time limit.
for _name in ("auto", "admm", "anderson", "direct", "newton", "nncg"):
    get(_name)
