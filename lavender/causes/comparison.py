"""Why two engines make different velocities in one step: parts of the difference by their causes.

    a = lavender.io.step_from_mujoco(model, data)
    b = lavender.io.load_step("step.npz")           # of another version or engine
    print(lavender.compare(a, b))
    print(lavender.compare(a))                      # against the rigid laws

The step has six ingredients: the masses with their gravity, the forces, the integrator with dampings and actuators, the
rows, their softness, and friction. All mixtures of the ingredients of both engines are solved
(`lavender.causes.mixture`). The part of an ingredient is the mean, over all orders in which the ingredients can be
exchanged one after another, of the change of velocity by its exchange (Shapley 1953); the interval contains the changes
of all orders. Parts within an ingredient are means over the orders within it (Owen 1977). The parts, and what the
solvers leave, sum to the difference:

    v_b - v_a = sum of parts + state + solver + lost digits + noslip + rest
    state = effect of rounding of the velocities before the step
    solver = (own answer - exact answer) of b, minus the same of a
    lost digits = the same, if the engine's acceleration is exact and its forces, which its integrator uses, are not
    noslip = change of b's answer by its pass against slip, minus the same of a
    rest = (v_b - velocity predicted from b's answer), minus the same of a
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import CapabilityError, InputError
from lavender.causes.difference import LEFT_OVER, ROUNDING, Difference, Part
from lavender.causes.exchange import Mixtures, expand
from lavender.causes.facts import Fact, Proposal, list_facts, list_proposals
from lavender.causes.ideal import make_ideal_twin
from lavender.causes.matching import Pairing
from lavender.causes.mixture import INGREDIENTS, PARTS
from lavender.causes.smaller_steps import measure_time_step
from lavender.causes.text import describe
from lavender.io.step_record import StepRecord, get_force

# [-] Largest difference of the velocities before the step, relative to the largest velocity and to 1 m/s: rounding of
# float32 and of conversions of coordinates.
MAX_START_DIFFERENCE = 1e-4
# [-] Largest difference of a position before the step, relative to itself and to 1 m or rad: some roundings of float32.
MAX_POSITION_DIFFERENCE = 1e-6
MAX_TIME_STEP_DIFFERENCE = 1e-6  # [-]
# [-] An acceleration that is exact to rounding, and has at most this part of the forces' error, is right: the forces
# have lost their digits.
MAX_ACCELERATION_ERROR = 0.1
RAISED_ROUNDING = (
    1e-7  # [-] Of exact velocities with raised compliances (`lavender.io.stiff_rows`).
)


class Comparison(Difference):
    """Difference of the velocities of two engines after one step, and its parts; `str()` explains it."""

    @property
    def facts(self) -> list[Fact]:
        """What differs between the two steps, with the numbers that a user can change."""
        return [] if self.is_ideal else list_facts(self)

    @property
    def proposals(self) -> list[Proposal]:
        """Changes of the second engine that reduce the largest difference; each one is solved."""
        return list_proposals(self)

    def __str__(self) -> str:
        return describe(self)


def compare(
    a: StepRecord, b: StepRecord | None = None, *, simulation: tuple[Any, Any] | None = None
) -> Comparison:
    """Explain the difference of the velocities of two engines after one step.

    Parameters
    ----------
    a, b : StepRecord
        The same step of two engines, two versions, two models or two sets of options, from
        `lavender.io.step_from_mujoco` and its siblings or from a file of `lavender.io.save_step`. Without `b`, `a` is
        compared with the rigid laws: the first record of the result is the ideal twin of `a`.
    simulation : (mujoco.MjModel, mujoco.MjData), optional
        The model, and the state before the step of `a`; they are not changed. The rigid laws are then those of smaller
        steps (`lavender.causes.smaller_steps`), and the difference has a part "time step".

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        The steps differ in their length, in the number of velocities, or in the velocities before the step; or
        `simulation` is given for two records, or has another state.
    CapabilityError
        An exact solution of one of the steps is not found.

    Notes
    -----
    Source of the parts: Shapley, "A Value for n-Person Games", 1953, and Owen, "Values of Games with a Priori Unions",
    1977.
    """
    for name, record in (("a", a), ("b", b)):
        if not isinstance(record, StepRecord) and not (name == "b" and record is None):
            raise InputError(
                f"{name} is a {type(record).__name__}; a StepRecord of lavender.io.step_from_mujoco, "
                "step_from_newton_mujoco or load_step is needed"
            )
    is_ideal = b is None
    if simulation is not None and not is_ideal:
        raise InputError(
            "simulation is given for two records; it is for one against the rigid laws"
        )
    if b is None:
        a, b = make_ideal_twin(a), a
    _check_steps(a, b)
    if a.engine == b.engine:
        a, b = replace(a, engine=f"first {a.engine}"), replace(b, engine=f"second {b.engine}")
    pairing = Pairing.of_records(a, b)
    solved = Mixtures(a, b, pairing)
    exact_a, whole = solved.solve({}), solved.solve(dict.fromkeys(PARTS, True))
    if not (exact_a.is_solved and whole.is_solved):
        worst = max(exact_a.relative, whole.relative)
        raise CapabilityError(
            f"an exact solution of these steps is not found (relative residual {worst:.1e}), so their difference has "
            "no parts"
        )
    active = tuple(
        name for name, parts in INGREDIENTS.items() if any(p in solved.different for p in parts)
    )
    own = {name: solved.divide(name, active) for name in active}
    has_same_start = np.array_equal(a.velocity, b.velocity)
    exact_b = whole.velocity if has_same_start else solved.solve_with_own_start().velocity
    leaves = _measure_left_over(
        a, b, exact_a.velocity, exact_b, whole.velocity, exact_a.is_raised or whole.is_raised
    )
    own |= leaves
    warnings = list(solved.warnings)
    if simulation is not None:
        try:
            velocity, own["time step"] = measure_time_step(b, a, *simulation)
            a = replace(a, velocity_after=velocity)
        except CapabilityError as error:
            warnings.append(f"the part of the time step is not known: in a smaller step, {error}")
    corners = {
        bits: solved.solve(expand(dict(zip(active, bits, strict=True))))
        for bits in itertools.product((False, True), repeat=len(active))
    }
    result = Comparison(
        a, b, own, exact_a.velocity, exact_b, pairing, corners, active, is_ideal,
        tuple(warnings),
    )  # fmt: skip
    return result


def _check_steps(a: StepRecord, b: StepRecord) -> None:
    """Raise InputError unless both records describe the same step."""
    if len(a.velocity) != len(b.velocity):
        raise InputError(
            f"a has {len(a.velocity)} velocities and b {len(b.velocity)}: both must be the same model, with the same "
            "joints"
        )
    if abs(a.dt - b.dt) > MAX_TIME_STEP_DIFFERENCE * a.dt:
        raise InputError(f"a has a time step of {a.dt:g} s and b of {b.dt:g} s: give both the same")
    unlike = [f"{x} and {y}" for x, y in zip(a.names, b.names, strict=True) if x != y]
    if unlike:
        raise InputError(
            f"{len(unlike)} velocities have different names, first {unlike[0]}: give b the order of a "
            "(lavender.io.permute_velocities)"
        )
    size = max(1.0, float(np.abs(a.velocity).max(initial=0.0)))
    gap = np.abs(a.velocity - b.velocity)
    if gap.max(initial=0.0) > MAX_START_DIFFERENCE * size:
        i = int(np.argmax(gap))
        raise InputError(
            f"{a.names[i]} has velocity {a.velocity[i]:.6g} in a and {b.velocity[i]:.6g} in b before the step: both "
            "must start from the same state, with free bodies rotated alike"
        )
    _check_references(a, b)
    if a.position is not None and b.position is not None and len(a.position) == len(b.position):
        theirs = _turn_quaternions(a, b)
        sizes = np.maximum(1.0, np.maximum(np.abs(a.position), np.abs(theirs)))
        apart = np.abs(a.position - theirs) / sizes
        if apart.max(initial=0.0) > MAX_POSITION_DIFFERENCE:
            i = int(np.argmax(apart))
            raise InputError(
                f"position {i} is {a.position[i]:.9g} in a and {theirs[i]:.9g} in b before the step: both must "
                "start from the same state"
            )


def _check_references(a: StepRecord, b: StepRecord) -> None:
    """Raise InputError if a hinge or slide has another `ref`: the same position is then another pose."""
    x, y, owner = a.reference_position, b.reference_position, a.position_owner
    if x is None or y is None or owner is None or len(x) != len(y):
        return
    alone = np.bincount(owner, minlength=len(a.names))[owner] == 1
    moved = np.flatnonzero(alone & (np.abs(x - y) > MAX_POSITION_DIFFERENCE))
    if len(moved):
        i = int(moved[0])
        raise InputError(
            f"ref of {a.names[owner[i]]} is {x[i]:.6g} in a and {y[i]:.6g} in b, so that the same position is another "
            "pose: give both models the same ref"
        )


def _turn_quaternions(a: StepRecord, b: StepRecord) -> FloatArray:
    """Return the positions of b, with -q instead of its quaternions q where that is nearer to a."""
    assert a.position is not None and b.position is not None
    turned = b.position.copy()
    owner = a.position_owner if b.position_owner is None else b.position_owner
    if owner is None:
        return turned
    for joint in np.unique(owner):
        places = np.flatnonzero(owner == joint)[-4:]
        if len(places) == 4 and a.position[places] @ turned[places] < 0.0:
            turned[places] *= -1.0
    return turned


def _measure_left_over(
    a: StepRecord,
    b: StepRecord,
    exact_a: FloatArray,
    exact_b: FloatArray,
    exchanged: FloatArray,
    is_raised: bool,
) -> dict[str, Part]:
    """Return the parts that no mixture has: state, solver, noslip and rest."""
    total = {name: np.zeros_like(exact_a) for name in LEFT_OVER}
    for sign, record, exact in ((-1.0, a, exact_a), (1.0, b, exact_b)):
        own = record.own_velocity
        solved = own
        if record.before_noslip is not None:
            slipping = [get_force(x) for x in record.blocks]
            change = record.velocity_of(slipping) - record.velocity_of(record.before_noslip)
            solved = own - change
        cause, error, rest = "solver", solved - exact, record.velocity_after - own
        if record.moved_by == "forces" and record.acceleration is not None and solved is own:
            by_acceleration = np.abs(record.velocity_from_acceleration - exact).max(initial=0.0)
            # An acceleration that is not exact to rounding comes from a solver that stopped early.
            rounding = ROUNDING[record.precision]
            rounding = max(rounding, RAISED_ROUNDING) if is_raised else rounding
            limit = rounding * max(1.0, float(np.abs(exact).max(initial=0.0)))
            # Such forces lose digits in the engine's sum of them, too.
            whole = error + rest
            if by_acceleration < min(limit, MAX_ACCELERATION_ERROR * np.abs(whole).max(initial=0)):
                cause, error, rest = "lost digits", whole, np.zeros_like(rest)
        total[cause] += sign * error
        total["noslip"] += sign * (own - solved)
        total["rest"] += sign * rest
    total["state"] = exact_b - exchanged
    return {n: Part(n, v, v[None], v, v) for n, v in total.items()}
