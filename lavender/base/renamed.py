"""Names that users try, and the names to use: earlier names of this package, and names of similar packages."""

from __future__ import annotations

from collections.abc import Collection

#: Owner -> {name that does not exist: name to use}.
INSTEAD = {
    "Cones": {
        "apart_rows": "separate_rows",
        "disks": "ellipses_replaced_by_disks",
        "has_more_parts": "has_more_components",
        "parts": "friction_components",
        "reach": "friction_coefficient",
        "take": "select",
    },
    "lavender": {
        "Motions": "SolutionSet",
        "Suspicion": "Diagnostic",
        "Turn": "SolverStage",
        "motions": "find_solutions",
        "solvers": "available or known",
        **dict.fromkeys(("Builder", "rowbuilder"), "RowBuilder"),
    },
    "Solution": {
        "carry": "carry of the next problem: next_problem.carry(solution)",
        "contradicted": "status_conflict",
        "error": "residual",
        "force": "impulse divided by dt",
        "forces": "impulse divided by dt",
        "impulses": "impulse",
        "converged": "success",
        "iters": "iterations",
        "lam": "impulse",
        "lambda_": "impulse",
        "turns": "stages",
        "velocity": "residual.velocity (error of a row), or RowBuilder.velocity_after (velocities of bodies)",
        "x": "impulse",
    },
    "RowBuilder": dict.fromkeys(("contacts", "add_contact"), "contact")
    | dict.fromkeys(("hinges", "add_hinge", "joint", "revolute"), "hinge")
    | dict.fromkeys(("build", "solve"), "problem")
    | {"fixed": "weld", "prismatic": "slider", "rod": "distance", "spherical": "ball"},
    "Residual": {
        "energy_start": "energy_at_zero",
        "floor": "roundoff_floor",
        "rel": "relative",
        "velocity_start": "velocity_at_zero",
    },
}

#: Keyword argument of other packages -> arguments here with that meaning; the first that the function has is
#: suggested.
ARGUMENT_HINTS = {
    **dict.fromkeys(("hi", "high", "u", "ub", "upper_bound"), ("upper", "ub")),
    **dict.fromkeys(("l", "lb", "lo", "low", "lower_bound"), ("lower", "lb")),
    "lower": ("lb",),
    "upper": ("ub",),
    **dict.fromkeys(
        ("guess", "initial_guess", "initvals", "lam0", "warm_start", "warmstart", "x0"), ("impulse", "guess")
    ),
    **dict.fromkeys(
        ("iterations", "iters", "max_iterations", "maxit", "maxiter", "n_iter", "niter", "num_iterations"),
        ("max_iter",),
    ),
    **dict.fromkeys(("max_sweeps", "n_sweeps", "num_sweeps", "sweeps"), ("max_iter",)),
    **dict.fromkeys(("accuracy", "eps", "rtol", "tolerance"), ("tol",)),
    **dict.fromkeys(("time_budget", "timeout"), ("time_limit",)),
    **dict.fromkeys(("algorithm", "method", "name"), ("solver",)),
    **dict.fromkeys(("coefficient", "friction", "friction_coefficient"), ("mu",)),
    **dict.fromkeys(("depth", "distance_to_surface", "penetration", "separation"), ("gap",)),
    **dict.fromkeys(("max_motor_torque", "torque"), ("max_torque",)),
    **dict.fromkeys(("force", "max_motor_force"), ("max_force",)),
    **dict.fromkeys(("pivot", "pos", "position"), ("anchor", "point", "anchor_a", "position")),
    **dict.fromkeys(("location", "point"), ("anchor", "anchor_a", "position")),
    **dict.fromkeys(("body_a", "body1"), ("a",)),
    **dict.fromkeys(("body_b", "body2"), ("b",)),
    **dict.fromkeys(("beta", "erp"), ("baumgarte",)),
    **dict.fromkeys(("inv_masses", "mass", "masses"), ("inv_mass",)),
    **dict.fromkeys(("inertia", "inertias", "inv_inertias"), ("inv_inertia",)),
    **dict.fromkeys(("positions", "x"), ("position",)),
    **dict.fromkeys(("v", "velocities"), ("velocity", "speed")),
    **dict.fromkeys(("h", "timestep", "time_step"), ("dt",)),
    **dict.fromkeys(("c", "damper"), ("damping",)),
    **dict.fromkeys(("k", "spring_constant"), ("stiffness",)),
    **dict.fromkeys(("rest_length", "l0"), ("length",)),
    **dict.fromkeys(("motor_speed", "target_velocity", "velocity"), ("speed",)),
}

#: Argument that users try -> remark after the suggested argument, if that has another meaning.
ARGUMENT_NOTES = {
    **dict.fromkeys(("depth", "penetration"), ", which is negative for penetration"),
    **dict.fromkeys(("mass", "masses"), ", which is 1 / mass [1/kg]"),
    **dict.fromkeys(("inertia", "inertias"), ", which is the inverse [1/(kg m^2)]"),
}

#: Solver name that users try -> name to suggest. For other unknown names, the most similar names are suggested.
SOLVER_HINTS = {"lcp": "lemke", "none": "auto", "qp": "osqp"}


def suggest_argument_name(name: str, valid: Collection[str]) -> str:
    """Return the argument of `valid` that has the meaning of the unknown argument `name`, or an empty string."""
    return next((word for word in ARGUMENT_HINTS.get(name.lower(), ()) if word in valid), "")


def build_attribute_error(owner: str, subject: str, name: str) -> AttributeError:
    """Build the error for a missing attribute `name` of `subject`, with the name to use if `INSTEAD[owner]` has one."""
    instead = INSTEAD[owner].get(name)
    hint = f"; use {instead}" if instead else ""
    return AttributeError(f"{subject} has no attribute {name!r}{hint}")
