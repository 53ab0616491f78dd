"""Table of the steppers by name, with their capabilities and options.

A stepper computes the part of a substep between collision detection and integration. Bodies, shapes, joints, motors,
collision detection, matching of contacts, snapshots, films, orders and budgets are common to all steppers. The kernels
are in `lavender_ext/engine/`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lavender.base.arrays import check_float, check_int
from lavender.base.errors import InputError, UnknownName


@dataclass(frozen=True)
class Option:
    """Numeric option of a stepper.

    Parameters
    ----------
    slot : str
        Name of the option's entry in the engine's array `setting`, or in `head` for an integer option.
    default, low, high : float
        Default value and range.
    text : str
        Meaning and unit.
    """

    slot: str
    default: float
    low: float
    high: float
    text: str

    @property
    def is_integer(self) -> bool:
        """Whether the option is a count."""
        return isinstance(self.default, int)


@dataclass(frozen=True)
class StepperSpec:
    """Name, number in the kernels and capabilities of a stepper.

    Parameters
    ----------
    name : str
    number : int
        H_STEPPER of lavender_ext/engine/arrays.pxd.
    summary : str
    reference : str
    sweeps : (int, int)
        Smallest and largest `solver_iterations`.
    order : str
        Default sweep order of a scene.
    position_iterations : int
        Default; 0 if the stepper has no position projection.
    solvers : bool
        Whether a registered solver can replace the stepper's sweeps.
    spin : bool
        Whether the stepper supports torsional friction of a contact patch.
    rolling : bool
        Whether the stepper supports rolling friction.
    boxes : bool
        Whether the stepper supports separate friction bounds of each tangent, Scene(friction_shape="box").
    restitution : bool
        Whether the stepper supports restitution.
    residuals : bool
        Whether `observation["solver"]` holds residuals; if false, they are NaN.
    exact_problem : bool
        Whether `constraint_problem()` solved by sequential_impulses gives the impulses of the step bit for bit.
    options : mapping of str to Option
    """

    name: str
    number: int
    summary: str
    reference: str
    sweeps: tuple[int, int]
    order: str
    position_iterations: int
    solvers: bool = False
    spin: bool = False
    rolling: bool = False
    boxes: bool = False
    restitution: bool = True
    residuals: bool = True
    exact_problem: bool = False
    options: Mapping[str, Option] = field(default_factory=dict)

    def complete_options(self, options: Mapping[str, Any]) -> dict[str, float]:
        """Return the values of all options, with defaults for those that `options` does not contain.

        Raises
        ------
        UnknownName
            The stepper has no option of that name.
        InputError
            A value is out of range.
        """
        for name in options:
            if name not in self.options:
                raise UnknownName(f"option of stepper {self.name!r}", name, self.options)
        values: dict[str, float] = {}
        for name, option in self.options.items():
            x = options.get(name, option.default)
            label = f"{name} of stepper {self.name!r}"
            if option.is_integer:
                values[name] = check_int(label, x, int(option.low), int(option.high))
            else:
                values[name] = check_float(label, x, low=option.low, high=option.high)
        return values

    def check_scene_properties(self, spin: bool, restitution: bool, rolling: bool) -> None:
        """Raise `InputError` if the stepper does not support a scene with these properties."""
        for needed, supported, feature, alternative in (
            (spin, self.spin, "spin friction: set patch_radius", "stepper='impulses'"),
            (rolling, self.rolling, "rolling friction: set rolling_radius", "stepper='impulses'"),
            (restitution, self.restitution, "restitution: set it", "another stepper"),
        ):
            if needed and not supported:
                raise InputError(
                    f"stepper {self.name!r} does not support {feature} to 0, or give {alternative}"
                )


#: Velocities are computed by sweeps over speculative contacts. Penetration is corrected by a projection of positions,
#: which adds no velocity.
#:
#:     target_n = -g/h if the gap g is open, except at contacts that carried load in the last substep; joints: target 0
#:     sweeps on A lambda = b, lambda >= 0, disks; then a shift of positions at contacts deeper than the slop
#:
#: See `lavender_ext/engine/contacts.pxd` and `projection.pxd`. Any registered solver can replace the sweeps.
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
#: Contacts and joints are damped springs; a relaxation then removes the velocity that the springs added (Catto, 2024).
#:
#:     omega = 2 pi f,  a1 = 2 zeta + h omega,  a2 = h omega a1
#:     J v + (omega / a1) C + (A_ii / a2) lambda = 0    while C < 0,    v_n >= -C/h while the gap C is open    (1)
#:     after the update of positions: sweeps without the spring; restitution last
#:
#: (1) is the implicit damped spring of frequency f and damping ratio zeta on the effective mass 1/A_ii, derived in
#: `lavender_ext/engine/soft_step.pxd`. Contacts with static bodies and joints have twice the frequency. The period of
#: a spring is at least four substeps. One sweep in each of many substeps is more accurate than many sweeps in one.
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
        "push_speed": Option("push", 3.0, 0.0, 1e6, "largest speed at which overlaps are separated [m/s]"),
        "relaxing_sweeps": Option("relaxing", 1, 0, 64, "sweeps without bias after the others"),
    },
)
#: Positions are corrected constraint by constraint; velocities are computed from positions (Müller et al., 2020).
#:
#:     dlambda = (-C - alpha' lambda)/(w + alpha'),  alpha' = alpha/h^2,  w = sum of 1/m + (r x n).I^-1 (r x n)
#:     v = (x - x0)/h;  friction reduces sliding by up to mu lambda_n; the normal velocity becomes -e v_n(before)
#:
#: Nothing is warm-started, so that one sweep in each of many substeps is more accurate than many sweeps in one. A
#: stack creeps if the sweeps of friction are too few to reach its ends. See `lavender_ext/engine/xpbd.pxd`.
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
#: A 6 x 6 Newton step for body after body on an augmented Lagrangian with warm-started multipliers (2025).
#:
#:     (M/h + sum kappa J^T J) dz = -M (z - y)/h + sum J^T p,   p = lambda - kappa C(z), clipped to its bounds or disk
#:     then lambda <- p, and kappa grows with the remaining error
#:
#: `solver_iterations` counts passes over the bodies. See `lavender_ext/engine/avbd.pxd`.
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
        "keep": Option("hertz", 0.99, 0.0, 1.0, "fraction of an error that remains after a substep [-]"),
        "stiffening": Option(
            "ratio",
            0.03,
            0.0,
            1e3,
            "growth of stiffness, relative to its minimum, for an error of the slop [-]",
        ),
    },
)
STEPPERS = {spec.name: spec for spec in (IMPULSES, SOFT_STEP, XPBD, AVBD)}


def get_stepper(name: str) -> StepperSpec:
    """Return the stepper of that name; raise UnknownName if there is none."""
    spec = STEPPERS.get(name) if isinstance(name, str) else None
    if spec is None:
        raise UnknownName("stepper", name, STEPPERS)
    return spec
