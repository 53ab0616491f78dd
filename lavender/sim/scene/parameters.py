"""Parameters of stepping that every scene has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from lavender.base.arrays import (
    check_bool,
    check_float,
    check_int,
    check_nonnegative_magnitudes,
    get_shape,
)
from lavender.base.errors import InputError, check_name
from lavender.problem.friction import SHAPES
from lavender.problem.ordering import ENGINE_ORDERS
from lavender.sim.scene.parts import check_numbers
from lavender.solvers.registry import get

# "alternating" and "colored_pairs" reverse the order of contacts in every other substep.
SCENE_ORDERS = (*ENGINE_ORDERS, "alternating", "colored_pairs")
ON_FAILURE = ("use", "keep", "damp", "raise")
#: Ranges of the numeric parameters.
PARAMETER_RANGES: dict[str, dict[str, float]] = {
    "dt": {"above": 0.0},
    "restitution": {"low": 0.0, "high": 1.0},
    **{
        key: {"low": 0.0}
        for key in ("friction", "patch_radius", "rolling_radius", "slop", "margin", "recycle")
    },
    "restitution_threshold": {"low": 0.0},
}
# Largest number of substeps that is computed from `max_substep`; more must be given as `substeps`.
MAX_DEFAULT_SUBSTEPS = 10_000
MIN_SWEEPS, MAX_SWEEPS = 4, 64  # Range of `solver_iterations` of sequential impulses.
# Default of `max_substep` for sequential impulses [s]: four warm-started sweeps keep a stack stable up to it.
DEFAULT_MAX_SUBSTEP = 1.0 / 240.0


@dataclass(frozen=True)
class Parameters:
    """Parameters that every scene has.

    Parameters
    ----------
    dt : float, s
        Time step.
    substeps : int, optional
        Default: the smallest number for which a substep is not longer than `max_substep`.
    max_substep : float, s, optional
        Default: 1/240 for sequential impulses, `dt` for other solvers.
    gravity : (3,) m/s^2
        A number points downwards.
    solver : str
        "sequential_impulses", or the name of a registered solver.
    solver_options : mapping
        Options of a registered solver, and `tol` or `velocity_tol` [m/s] of `lavender.solve`.
    solver_iterations : int, optional
        Default: 16 sweeps, or the default of the registered solver.
    warm_start : bool
        Start the solver from the impulses of the contact cache.
    order : str, optional
        Sweep order. Default: "alternating" for sequential impulses, "given" for other solvers.
    friction, restitution : float, -
        Values for bodies that have none of their own.
    patch_radius : float, m
        Value for bodies that have none of their own; 0: no torsional friction.
    rolling_radius : float, m
        mu_r of every contact with friction: the rolling moment does not exceed mu_r lambda_n; 0: no rolling friction.
    friction_shape : {"disk", "box"}
        With "box", each tangent has its own bound, as in many engines; there is then no torsional friction.
    position_iterations : int
        Sweeps of the position projection in a substep, 0 for no projection. With `slop` 0, up to 1000 sweeps follow
        while the largest error of a contact would be larger after them than before.
    seed : int
    on_failure : {"use", "keep", "damp", "raise"}
        Treatment of a failed solve: use its impulses, keep the warm start, use the mean of both, or raise SolveFailed.
    slop : float, m
        Depth that is not corrected.
    margin : float, m
        Gap below which contacts are created.
    recycle : float, m
        Contacts are kept over steps while no body of theirs has moved farther since they were built, along its path and
        with its radius times its rotation; their gaps follow. At most half of `margin`; 0: built anew in every step.
    restitution_threshold : float, m/s
        Contacts with a smaller closing speed do not bounce.
    """

    dt: float = 1.0 / 120.0
    substeps: int = None  # type: ignore[assignment]
    max_substep: float = None  # type: ignore[assignment]
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    solver: str = "sequential_impulses"
    solver_options: Mapping[str, Any] = field(default_factory=dict)
    solver_iterations: int | None = None
    warm_start: bool = True
    order: str = None  # type: ignore[assignment]
    friction: float = 0.5
    restitution: float = 0.0
    patch_radius: float = 0.0
    rolling_radius: float = 0.0
    friction_shape: str = "disk"
    position_iterations: int = 2
    seed: int = 0
    on_failure: str = "use"
    slop: float = 1e-3
    margin: float = 1e-2
    recycle: float = 0.0
    restitution_threshold: float = 0.5

    def __post_init__(self) -> None:
        put = object.__setattr__
        for name, allowed in PARAMETER_RANGES.items():
            put(self, name, check_float(name, getattr(self, name), **allowed))
        for name in ("friction", "patch_radius", "rolling_radius"):
            check_nonnegative_magnitudes(name, np.array([getattr(self, name)]))
        if self.recycle > 0.5 * self.margin:
            raise InputError(
                f"recycle is {self.recycle:g} m; at most half of margin, {0.5 * self.margin:g} m, is possible, because "
                "contacts are built only for gaps below margin"
            )
        gravity: Any = self.gravity
        if get_shape("gravity", gravity) == ():
            size = check_float("gravity", gravity)
            # A negative number probably is the z component of gravity; bodies would fall upwards.
            if size < 0.0:
                raise InputError(
                    f"gravity is {size:g}; one number is the downward acceleration, and at least 0 is "
                    f"needed: give {-size:g}, or a vector, (0, 0, {size:g}) m/s^2"
                )
            gravity = (0.0, 0.0, -size)
        put(self, "gravity", tuple(check_numbers("gravity", gravity, 3).tolist()))
        if not isinstance(self.solver_options, Mapping):
            raise InputError(f"solver_options is {self.solver_options!r}; a mapping is needed")
        put(self, "solver_options", dict(self.solver_options))
        own = self.solver == "sequential_impulses"
        spec = get(self.solver)
        sweeps = self.solver_iterations
        if own and self.solver_options:
            raise InputError(
                f"solver_options are {sorted(self.solver_options)}, but the solver is sequential_impulses, "
                "which has no options: give order= and seed= of the scene, or another solver="
            )
        if sweeps is None:
            sweeps = 16 if own else spec.max_iter
        sweeps = check_int(
            "solver_iterations", sweeps, *((MIN_SWEEPS, MAX_SWEEPS) if own else (1,))
        )
        put(self, "solver_iterations", sweeps)
        max_substep: Any = self.max_substep
        if max_substep is None:
            max_substep = DEFAULT_MAX_SUBSTEP if own else self.dt
        put(self, "max_substep", check_float("max_substep", max_substep, above=0.0))
        substeps: Any = self.substeps
        if substeps is None:  # Choose the smallest number that respects `max_substep`.
            ratio = (
                self.dt / self.max_substep - 1e-9
            )  # Rounding of an integer ratio must not add a substep.
            if ratio > MAX_DEFAULT_SUBSTEPS:
                raise InputError(
                    f"dt is {self.dt:g} s, more than {MAX_DEFAULT_SUBSTEPS} substeps of max_substep = "
                    f"{self.max_substep:g} s; give a shorter dt, a longer max_substep, or substeps="
                )
            substeps = max(1, math.ceil(ratio))
        put(self, "substeps", check_int("substeps", substeps, 1))
        put(self, "warm_start", check_bool("warm_start", self.warm_start))
        order: Any = self.order
        put(self, "order", ("alternating" if own else "given") if order is None else order)
        check_name("order", self.order, SCENE_ORDERS)
        if self.order != "given" and not own:
            raise InputError(
                f"order={self.order!r} is used only by sequential_impulses, and the solver is "
                f"{self.solver!r}: leave order out, or give solver_options of {self.solver!r}"
            )
        if self.recycle > 0.0 and self.order == "alternating" and self.substeps % 2:
            raise InputError(
                f"recycle is {self.recycle:g} m, and a step has {self.substeps} substeps; the order 'alternating' "
                "needs an even number, so that all steps begin with the same order: give substeps, or order='given'"
            )
        check_name("friction_shape", self.friction_shape, SHAPES)
        put(
            self,
            "position_iterations",
            check_int("position_iterations", self.position_iterations, 0, 1000),
        )
        put(self, "seed", check_int("seed", self.seed))
        check_name("on_failure", self.on_failure, ON_FAILURE)


COMMON_PARAMETERS = tuple(f.name for f in fields(Parameters))
