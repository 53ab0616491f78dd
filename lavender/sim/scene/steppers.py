"""Ways to step by name: what each is and can do, as data.

A stepper owns what happens in a substep between collision and integration. Bodies, shapes, joints, motors, collision,
matching of contacts, snapshots, films, orders and budgets are the engine's. The kernels are `lavender_ext/engine/`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lavender.base.arrays import check_float, check_int
from lavender.base.errors import InputError, UnknownName


@dataclass(frozen=True)
class Option:
    """A number of a stepper: where it stands in the engine's arrays, its default and its range."""

    place: str  # of `setting`, or of `head` for a whole number
    default: float
    low: float
    high: float
    text: str  # meaning and unit

    @property
    def is_whole(self) -> bool:
        """Whether it is a count."""
        return isinstance(self.default, int)


@dataclass(frozen=True)
class StepperSpec:
    """One way to step: its number in the kernels, and what a scene may ask of it."""

    name: str
    number: int  # H_STEPPER of lavender_ext/engine/arrays.pxd
    summary: str
    reference: str
    sweeps: tuple[int, int]  # least and largest `solver_iterations`
    order: str  # default sweep order of a scene
    position_iterations: int  # default; 0: it has no position projection
    solvers: bool = False  # another solver may take the place of its sweeps
    spin: bool = False  # friction of a patch against spinning
    rolling: bool = False  # friction against rolling
    boxes: bool = False  # friction of each tangent by itself, Scene(friction_shape="box")
    restitution: bool = True
    residuals: bool = True  # `observation["solver"]` holds residuals; else NaN
    exact_problem: bool = False  # `constraint_problem()` solved by sequential_impulses gives the step's bits
    options: Mapping[str, Option] = field(default_factory=dict)

    def values(self, given: Mapping[str, Any]) -> dict[str, float]:
        """Every option, as given or by default."""
        for name in given:
            if name not in self.options:
                raise UnknownName(f"option of stepper {self.name!r}", name, self.options)
        found: dict[str, float] = {}
        for name, option in self.options.items():
            x = given.get(name, option.default)
            label = f"{name} of stepper {self.name!r}"
            if option.is_whole:
                found[name] = check_int(label, x, int(option.low), int(option.high))
            else:
                found[name] = check_float(label, x, low=option.low, high=option.high)
        return found

    def check(self, spin: bool, restitution: bool, rolling: bool) -> None:
        """Raise `InputError` where it does not take a scene with these."""
        for asked, has, what, instead in (
            (spin, self.spin, "spin friction; leave patch_radius", "'impulses'"),
            (rolling, self.rolling, "rolling friction; leave rolling_radius", "'impulses'"),
            (restitution, self.restitution, "restitution; leave it", "another stepper"),
        ):
            if asked and not has:
                raise InputError(f"stepper {self.name!r} has no {what} at 0, or take {instead}")


#: Velocities by sweeps over speculative contacts, penetration by a projection of positions that adds no velocity.
#:
#:     target_n = -g/h where the gap g is open, unless the cache says that the contact bears; rows of joints: target 0
#:     sweeps on A lambda = b, lambda >= 0, disks; then a shift of positions for what is deeper than the slop
#:
#: `lavender_ext/engine/contacts.pxd`, `projection.pxd`. Any registered solver may take the place of the sweeps.
IMPULSES = StepperSpec(
    name="impulses",
    number=0,
    summary="speculative contacts, warm-started sweeps over velocities, position projection",
    reference="Catto, Iterative Dynamics with Temporal Coherence, 2005; Guendelman, Bridson, Fedkiw, 2003",
    boxes=True,
    sweeps=(4, 64),
    order="alternating",
    position_iterations=2,
    solvers=True,
    spin=True,
    rolling=True,
    exact_problem=True,
)
#: Contacts and joints as damped springs, then a relaxation that takes away the velocity that pushed (Catto, 2024).
#:
#:     omega = 2 pi f,  a1 = 2 zeta + h omega,  a2 = h omega a1
#:     J v + (omega / a1) C + (A_ii / a2) lambda = 0    while C < 0,    v_n >= -C/h while the gap C is open    (1)
#:     after positions have moved: sweeps without the spring; restitution last
#:
#: (1) is the implicit damped spring of frequency f and damping ratio zeta on the effective mass 1/A_ii; its derivation
#: stands in `lavender_ext/engine/soft_step.pxd`. Contacts with what never moves, and joints, are twice as stiff; no
#: spring swings faster than four substeps can follow. One sweep in each of many substeps goes furthest.
SOFT_STEP = StepperSpec(
    name="soft_step",
    number=1,
    summary="soft contacts and joints by sweeps with bias, then relaxing sweeps without",
    reference="Catto, Solver2D, 2024",
    boxes=True,
    sweeps=(1, 64),
    order="given",
    position_iterations=0,
    spin=True,
    options={
        "hertz": Option("hertz", 60.0, 1e-3, 1e6, "frequency of contacts [1/s]; at most a quarter of 1/h"),
        "damping_ratio": Option("ratio", 2.0, 0.0, 1e6, "of contacts [-]"),
        "push_speed": Option("push", 3.0, 0.0, 1e6, "largest speed at which overlaps are pushed apart [m/s]"),
        "relaxing_sweeps": Option("relaxing", 1, 0, 64, "sweeps without bias after the others"),
    },
)
#: Positions corrected constraint by constraint, velocities from positions (Müller et al., 2020).
#:
#:     dlambda = (-C - alpha' lambda)/(w + alpha'),  alpha' = alpha/h^2,  w = sum of 1/m + (r x n).I^-1 (r x n)
#:     v = (x - x0)/h;  what slides is braked by at most mu lambda_n, what parts or closes goes to -e v_n(before)
#:
#: Nothing is warm-started, so that one sweep in each of many substeps goes further than many in one; a stack creeps
#: where sweeps of friction do not reach its ends. `lavender_ext/engine/xpbd.pxd`.
XPBD = StepperSpec(
    name="xpbd",
    number=2,
    summary="position corrections with compliance, velocities from positions, friction and restitution after",
    reference="Müller, Macklin, Chentanez, Jeschke, Kim, Detailed Rigid Body Simulation with XPBD, 2020",
    sweeps=(1, 64),
    order="given",
    position_iterations=0,
    residuals=False,
)
#: A Newton step of 6 x 6 for body after body on an augmented Lagrangian, whose multipliers are warm-started (2025).
#:
#:     (M/h + sum kappa J^T J) dz = -M (z - y)/h + sum J^T p,   p = lambda - kappa C(z), clipped to its bounds or disk
#:     then lambda <- p, and kappa grows with the error that is left
#:
#: `solver_iterations` counts passes over the bodies. `lavender_ext/engine/avbd.pxd`.
AVBD = StepperSpec(
    name="avbd",
    number=3,
    summary="block descent over bodies, augmented Lagrangian with warm-started multipliers and stiffness",
    reference="Giles, Diaz, Yuksel, Augmented Vertex Block Descent, SIGGRAPH 2025",
    sweeps=(1, 64),
    order="given",
    position_iterations=0,
    restitution=False,
    residuals=False,
    options={
        "keep": Option("hertz", 0.99, 0.0, 1.0, "share of an error that a substep leaves [-]"),
        "stiffening": Option(
            "ratio", 0.03, 0.0, 1e3, "growth of stiffness, of its least for an error of the slop [-]"
        ),
    },
)
STEPPERS = {spec.name: spec for spec in (IMPULSES, SOFT_STEP, XPBD, AVBD)}


def get_stepper(name: str) -> StepperSpec:
    """The stepper of that name."""
    spec = STEPPERS.get(name) if isinstance(name, str) else None
    if spec is None:
        raise UnknownName("stepper", name, STEPPERS)
    return spec
