"""One step of an engine as a record: everything that determines the velocity after the step.

With the mass matrix M, the matrix H that the integrator adds to it, the force f without constraints, the Jacobian J of
the constraint rows and their forces F, an engine's step of length h is

    v+ = v + (M + H)^-1 (h f + J^T lambda)       lambda = h F                                                   (1)

and lambda solves the constraint problem of J, of the reference accelerations and of the compliances of the rows over

    M + H if the integrator's matrix stands in the problem (`in_problem`), else over M                            (2)

The record contains what the user of an engine sets, and not the numbers that an engine derives from it: a reference
acceleration and a compliance R depend on the mass, on the position of the row and on its friction, so they are computed
in `lavender.causes.mixture` from `Softness`, `ConstraintBlock.weight`, `gap` and `friction`. The force is the sum

    f = -coriolis + gravity_map gravity + force + damping_force + fluid_force + actuator_force
        + integrator_force                                                                                       (3)
    H = h (damping_matrix + fluid_matrix + actuator_matrix + coriolis_matrix) + h^2 stiffness_matrix
        + integrator_matrix                                                                                      (4)

where coriolis, coriolis_matrix and gravity_map belong to the masses, the terms of damping and fluid to the dampings of
joints, tendons and fluids, actuator_force and actuator_matrix to the actuators, and integrator_force to the integrator.
The terms of a fluid belong to the masses, too, as they follow from inertias: with equal `fluid` of two records, they
are those of the source of the masses. An integrator uses some of the first five terms of H. If it uses the springs'
stiffness, f has also -h stiffness_matrix v.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, as_array
from lavender.base.errors import InputError
from lavender.io.stored import as_path, write_arrays

SMALLEST_MIX = 1e-15  # Smaller weights of a geom's softness count as 0, as in MuJoCo.
FORMAT = "lavender step record 1"


@dataclass(frozen=True, eq=False)
class Softness:
    """How an engine makes reference acceleration and compliance of the rows of one constraint.

    The rule "impedance" is MuJoCo's, which Genesis, MJX and MuJoCo Warp share: with d the impedance of `solimp` at the
    gap r, K and B of `solref`,

        a_ref = -B (J v - surface) - K d r        R = (1 - d) / d weight                                         (5)

    The rule "rigid" is a velocity of 0 relative to the surface after the step, or of -r / h if the gap r is open, and
    a compliance of `compliance`. The rule "rates" gives B, K d and R as numbers, for an engine with another rule.

    Parameters
    ----------
    rule : {"impedance", "rates", "rigid"}
    solref, solref_friction : (2,)
        Time constant [s] and damping ratio [-], or minus stiffness and damping. `solref_friction` is used on the
        friction rows of an elliptic contact, if it is not 0.
    solimp : (5,)
        Impedance at a gap of 0 and at the width, width [m, rad], midpoint and power.
    impratio : float, -
        Ratio of the impedances of friction and normal rows.
    shortest_time : float, s
        Time constants below it are replaced by it: MuJoCo's "refsafe".
    rate, stiffness, compliance : (k,)
        B [1/s], K d [1/s^2] and R [1/kg] of the rows, for the rules "rates" and "rigid".
    """

    rule: str = "impedance"
    solref: FloatArray = field(default_factory=lambda: np.array([0.02, 1.0]))
    solref_friction: FloatArray = field(default_factory=lambda: np.zeros(2))
    solimp: FloatArray = field(default_factory=lambda: np.array([0.9, 0.95, 0.001, 0.5, 2.0]))
    impratio: float = 1.0
    shortest_time: float = 0.0
    rate: FloatArray = field(default_factory=lambda: np.zeros(0))
    stiffness: FloatArray = field(default_factory=lambda: np.zeros(0))
    compliance: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class GeomSettings:
    """The contact settings of a geom, from which MuJoCo makes the ones of a contact that a step does not have."""

    condim: int
    priority: int
    mix: float
    friction: FloatArray  # (5,): both tangents, spin, both rolling axes.
    softness: Softness

    def combine(self, other: GeomSettings) -> tuple[int, FloatArray, Softness]:
        """Return condim, coefficients (5,) and softness of a contact of two geoms, by MuJoCo's rule."""
        if self.priority != other.priority:
            chosen = self if self.priority > other.priority else other
            return chosen.condim, chosen.friction, chosen.softness
        friction = np.maximum(self.friction, other.friction)
        total = self.mix + other.mix
        share = self.mix / total if total >= SMALLEST_MIX else 0.5
        if total >= SMALLEST_MIX and min(self.mix, other.mix) < SMALLEST_MIX:
            share = float(self.mix >= SMALLEST_MIX)
        x, y = self.softness, other.softness
        both_standard = x.solref[0] > 0.0 and y.solref[0] > 0.0
        mixed = share * x.solref + (1.0 - share) * y.solref
        solref = mixed if both_standard else np.minimum(x.solref, y.solref)
        solimp = share * x.solimp + (1.0 - share) * y.solimp
        return max(self.condim, other.condim), friction, replace(x, solref=solref, solimp=solimp)


@dataclass(frozen=True, eq=False)
class ConstraintBlock:
    """A contact, a limit, a joint's dry friction or an equality: rows that an engine makes together.

    Parameters
    ----------
    key : str
        Name of the partner in another engine's record: "contact of BODY and BODY", "limit of joint NAME", ...
    role : {"contact", "limit", "equality", "friction", "bounds"}
    jacobian : (k, nv)
        Rows of velocities without coefficients. A contact has its normal, two tangents, spin, and two rolling axes; or
        the first of them that are known.
    gap : (k,), m, rad
        Position of each row minus its margin. Only the normal of a contact has one.
    margin : float, m, rad
        The margin, which is subtracted in `gap`.
    weight : (k,), 1/kg, 1/(kg m^2)
        The engine's own inverse mass of each row, from which it makes R. One number for a contact.
    softness : Softness
    cone : {"", "pyramid", "ellipse", "box", "own"}
        Of a contact with friction. A box bounds each tangent.
    condim : int
        Number of rows of the contact that the engine uses.
    friction : (5,) or fewer, -, m
        Coefficients of both tangents, spin, and both rolling axes.
    loss : float, N, N m
        Bound of dry friction.
    surface_velocity : (k,), m/s, rad/s
        Velocity of the surface along each row.
    bias : (k,), m/s^2, rad/s^2
        Acceleration that the engine adds to the reference, such as -dJ/dt v of a weld.
    force : (k,), N, N m
        The engine's own answer along the rows of `jacobian`.
    geoms : tuple of str
        Geoms of a contact; numbers of those without a name.
    geom_keys : tuple of str
        The same for matching: geoms without a name have their place in their body. Default `geoms`.
    bodies : tuple of str
        Bodies of a contact, which name its weights in `StepRecord.weights`.
    position : (3,), m
    bounds : (2, k), N, N m, optional
        Lower and upper bounds of forces, of the role "bounds".
    own_cones : Cones, optional
        Of the cone "own", which no exchange changes.
    """

    key: str
    role: str
    jacobian: FloatArray
    gap: FloatArray
    weight: FloatArray
    softness: Softness
    margin: float = 0.0
    cone: str = ""
    condim: int = 1
    friction: FloatArray = field(default_factory=lambda: np.zeros(0))
    loss: float = 0.0
    surface_velocity: FloatArray | None = None
    bias: FloatArray | None = None
    force: FloatArray | None = None
    geoms: tuple[str, ...] = ()
    geom_keys: tuple[str, ...] = ()
    bodies: tuple[str, ...] = ()
    position: FloatArray = field(default_factory=lambda: np.zeros(3))
    bounds: FloatArray | None = None
    own_cones: Any = None

    @property
    def has_friction(self) -> bool:
        """Whether the block is a contact with friction."""
        return self.role == "contact" and self.condim > 1


@dataclass(frozen=True, eq=False)
class StepRecord:
    """One step of an engine; see the module for the equations.

    Parameters
    ----------
    engine : str
        Name and version of the engine.
    dt : float, s
    velocity : (nv,), m/s, rad/s
        Before the step.
    velocity_after : (nv,), m/s, rad/s
        The engine's own velocity after the step.
    mass : (nv, nv)
    coriolis : (nv,), N, N m
    gravity_map : (nv, 3), kg, kg m
        Force per gravitational acceleration.
    gravity : (3,), m/s^2
    force : (nv,), N, N m
        Springs, applied forces and all others.
    damping_matrix, actuator_matrix : (nv, nv)
        Minus the derivative of the damping and actuator forces by the velocity [N s/m, N m s].
    damping_force, actuator_force : (nv,), N, N m
    stiffness_matrix : (nv, nv), N/m, N m
        Of the springs in `force`.
    uses_damping, uses_actuators, uses_stiffness : bool
        Whether the integrator is implicit in the dampings, the actuators and the springs, equation (4).
    integrator_matrix : (nv, nv)
        Remaining part of H.
    integrator_force : (nv,), N, N m
    in_problem : bool
        Whether the constraint problem contains H.
    implicit_rows : bool
        Whether the springs and dampers of the rows are integrated implicitly, as by MuJoCo's "discrete".
    blocks : tuple of ConstraintBlock
    law : {"cone", "coulomb"}
        Law of elliptic contacts.
    names : tuple of str
        Of the velocities.
    angular : (nv,) bool
        Velocities in rad/s.
    position : (nq,), optional
        Positions before the step, if the engine's coordinates are the ones of the file.
    position_owner : (nq,) int, optional
        First velocity of the joint of each position. A joint with seven positions, or four, ends with a quaternion.
    acceleration : (nv,), m/s^2, rad/s^2, optional
        The engine's own acceleration in the constraint problem.
    moved_by : {"forces", "acceleration"}
        The part of the engine's answer that its integrator uses.
    fluid : (k,), optional
        Numbers that a user gives a fluid: density, viscosity, wind and shapes.
    fluid_force : (nv,), optional, N, N m
    fluid_matrix : (nv, nv), optional
        Minus the derivative of the fluid's forces by the velocity [N s/m, N m s].
    coriolis_matrix : (nv, nv), optional
        Derivative of `coriolis` by the velocity [N s/m, N m s].
    uses_fluid : bool
        Whether the integrator is implicit in the fluid's forces.
    uses_coriolis : (nv, nv) bool, optional
        Entries of `coriolis_matrix` that the integrator uses: of free bodies, or all. None: none of them.
    velocity_change : (nv,), m/s, rad/s, optional
        Added by the integrator to the velocity of equation (1), such as by an implicit midpoint rule.
    reference_position : (nq,), optional
        Positions at which the joints are in the model's initial pose.
    before_noslip : tuple of arrays, optional
        Forces of the blocks before the engine's pass against slip, if it has one.
    weights : dict
        Inverse masses of bodies and of other constraints, by body or key; of equalities with all their rows.
    softnesses : dict
        Softness by the key of constraints that are not active in this step.
    geom_settings : dict
        Contact settings by the name of the geom.
    settings : dict
        Name and value of the engine's settings, for sentences.
    precision : {"float64", "float32"}
    """

    engine: str
    dt: float
    velocity: FloatArray
    velocity_after: FloatArray
    mass: FloatArray
    coriolis: FloatArray
    gravity_map: FloatArray
    gravity: FloatArray
    force: FloatArray
    damping_matrix: FloatArray
    damping_force: FloatArray
    actuator_matrix: FloatArray
    actuator_force: FloatArray
    integrator_matrix: FloatArray
    integrator_force: FloatArray
    stiffness_matrix: FloatArray
    uses_damping: bool
    uses_actuators: bool
    uses_stiffness: bool
    in_problem: bool
    implicit_rows: bool
    blocks: tuple[ConstraintBlock, ...]
    law: str
    names: tuple[str, ...]
    angular: np.ndarray
    position: FloatArray | None = None
    position_owner: IntArray | None = None
    acceleration: FloatArray | None = None
    moved_by: str = "forces"
    before_noslip: tuple[FloatArray, ...] | None = None
    fluid: FloatArray | None = None
    fluid_force: FloatArray | None = None
    fluid_matrix: FloatArray | None = None
    coriolis_matrix: FloatArray | None = None
    uses_fluid: bool = False
    uses_coriolis: np.ndarray | None = None
    velocity_change: FloatArray | None = None
    reference_position: FloatArray | None = None
    weights: Mapping[str, float | FloatArray] = field(default_factory=dict)
    softnesses: Mapping[str, Softness] = field(default_factory=dict)
    geom_settings: Mapping[str, GeomSettings] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    precision: str = "float64"

    @property
    def added_matrix(self) -> FloatArray:
        """H (nv, nv), the matrix that the integrator adds to M, equation (4)."""
        return add_matrix(self, self, self, self, self)

    @property
    def smooth_force(self) -> FloatArray:
        """Force without constraints f (nv,) [N, N m], equation (3)."""
        return add_forces(self, self, self, self, self)

    @property
    def n_rows(self) -> int:
        """Number of constraint rows that the engine solves."""
        return sum(count_rows(block) for block in self.blocks)

    def velocity_of(self, forces: Any) -> FloatArray:
        """Return the velocity after the step (nv,) [m/s, rad/s] for forces of the blocks, equation (1)."""
        push = np.zeros(len(self.velocity))
        for block, force in zip(self.blocks, forces, strict=True):
            push += block.jacobian[: len(force)].T @ force
        matrix = self.mass + self.added_matrix
        change = self.dt * np.linalg.solve(matrix, self.smooth_force + push)
        return self.start_velocity + change

    @property
    def start_velocity(self) -> FloatArray:
        """Velocity before the step with the change that the integrator adds (nv,) [m/s, rad/s]."""
        return (
            self.velocity if self.velocity_change is None else self.velocity + self.velocity_change
        )

    @property
    def own_velocity(self) -> FloatArray:
        """Velocity after the step (nv,) [m/s, rad/s] that the engine's own answer predicts."""
        if self.moved_by == "acceleration" and self.acceleration is not None:
            return self.velocity_from_acceleration
        return self.velocity_of([get_force(block) for block in self.blocks])

    @property
    def velocity_from_acceleration(self) -> FloatArray:
        """Velocity after the step (nv,) [m/s, rad/s] that the engine's acceleration predicts."""
        assert self.acceleration is not None
        added = self.added_matrix
        if self.in_problem or not added.any():
            return self.start_velocity + self.dt * self.acceleration
        momentum = self.dt * self.mass @ self.acceleration
        return self.start_velocity + np.linalg.solve(self.mass + added, momentum)


def _choose_fluid(mass: StepRecord, damping: StepRecord) -> StepRecord:
    """Return the record that has the terms of a fluid: it makes them from inertias and from what a user sets."""
    x, y = mass.fluid, damping.fluid
    return mass if x is not None and y is not None and np.array_equal(x, y) else damping


def add_matrix(
    mass: StepRecord,
    force: StepRecord,
    damping: StepRecord,
    actuators: StepRecord,
    method: StepRecord,
) -> FloatArray:
    """Return H (nv, nv) of an integrator with terms of other records, equation (4)."""
    dt = method.dt
    added = method.integrator_matrix
    if method.uses_damping:
        added = added + dt * damping.damping_matrix
    fluid = _choose_fluid(mass, damping).fluid_matrix
    if method.uses_fluid and fluid is not None:
        added = added + dt * fluid
    turning = method.coriolis_matrix if mass.coriolis_matrix is None else mass.coriolis_matrix
    if method.uses_coriolis is not None and turning is not None:
        added = added + dt * np.where(method.uses_coriolis, turning, 0.0)
    if method.uses_actuators:
        added = added + dt * actuators.actuator_matrix
    return added + dt**2 * force.stiffness_matrix if method.uses_stiffness else added


def add_forces(
    mass: StepRecord,
    force: StepRecord,
    damping: StepRecord,
    actuators: StepRecord,
    method: StepRecord,
) -> FloatArray:
    """Return the force without constraints (nv,) [N, N m] with terms of other records, equation (3)."""
    smooth = mass.gravity_map @ force.gravity - mass.coriolis + force.force
    fluid = _choose_fluid(mass, damping).fluid_force
    if fluid is not None:
        smooth = smooth + fluid
    smooth = smooth + damping.damping_force + actuators.actuator_force + method.integrator_force
    if method.uses_stiffness:
        smooth = smooth - method.dt * force.stiffness_matrix @ method.velocity
    return smooth


def get_force(block: ConstraintBlock) -> FloatArray:
    """Return the engine's own forces (k,) [N, N m] of a block; zeros if they are not known."""
    return np.zeros(len(block.jacobian)) if block.force is None else block.force


def count_rows(block: ConstraintBlock) -> int:
    """Return the number of rows that the engine solves for a block."""
    if block.has_friction and block.cone == "pyramid":
        return 2 * (block.condim - 1)
    return block.condim if block.role == "contact" else len(block.jacobian)


def save_step(record: StepRecord, path: str | os.PathLike[str]) -> None:
    """Write a record to an .npz file, such as for the comparison of two versions of an engine.

    Parameters
    ----------
    record : StepRecord
    path : path
        Ends with .npz. An existing file is replaced.
    """
    target = as_path(path)
    if not isinstance(record, StepRecord):
        raise InputError(f"record is a {type(record).__name__}; a StepRecord is needed")
    if target.suffix.lower() != ".npz":
        raise InputError(f"{path} ends with {target.suffix!r}; .npz is needed")
    arrays: dict[str, Any] = {}
    tree = _flatten(record, arrays)
    text = json.dumps({"format": FORMAT, "record": tree})
    arrays["meta"] = np.frombuffer(text.encode("ascii"), np.uint8)
    write_arrays(target, arrays)


def load_step(path: str | os.PathLike[str]) -> StepRecord:
    """Read a record that `save_step` wrote.

    Raises
    ------
    InputError
        The file is not a record.
    """
    try:
        with np.load(os.fspath(path), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        meta = json.loads(arrays["meta"].astype(np.uint8).tobytes())
        if meta["format"] != FORMAT:
            raise ValueError(meta["format"])
        result = _unflatten(meta["record"], arrays)
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(
            f"{os.fspath(path)} is not a step record ({type(error).__name__}: {error}); a file of "
            "lavender.io.save_step is needed"
        ) from None
    if not isinstance(result, StepRecord):
        raise InputError(f"{os.fspath(path)} does not contain a step record")
    return result


_CLASSES = {
    "StepRecord": StepRecord,
    "ConstraintBlock": ConstraintBlock,
    "Softness": Softness,
    "GeomSettings": GeomSettings,
}


def _flatten(value: Any, arrays: dict[str, Any]) -> Any:
    """Return a value as JSON; its arrays are added to `arrays` and named by their number."""
    if type(value).__name__ in _CLASSES:
        named = {f.name: _flatten(getattr(value, f.name), arrays) for f in fields(value)}
        return {"class": type(value).__name__, "fields": named}
    if isinstance(value, np.ndarray):
        arrays[f"a{len(arrays)}"] = value
        return {"array": f"a{len(arrays) - 1}"}
    if isinstance(value, tuple):
        return {"tuple": [_flatten(x, arrays) for x in value]}
    if isinstance(value, Mapping):
        return {"dict": [[str(k), _flatten(x, arrays)] for k, x in value.items()]}
    return value.item() if isinstance(value, np.generic) else value


def _unflatten(tree: Any, arrays: Mapping[str, Any]) -> Any:
    """Return the value of JSON that `_flatten` made."""
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return arrays[tree["array"]]
    if "tuple" in tree:
        return tuple(_unflatten(x, arrays) for x in tree["tuple"])
    if "dict" in tree:
        return {k: _unflatten(x, arrays) for k, x in tree["dict"]}
    return _CLASSES[tree["class"]](**{k: _unflatten(x, arrays) for k, x in tree["fields"].items()})


def permute_velocities(record: StepRecord, order: Any, names: tuple[str, ...]) -> StepRecord:
    """Return the record with its velocities in another order, so that two engines share one.

    Parameters
    ----------
    record : StepRecord
    order : (nv,) int
        Index in this record of each velocity of the result.
    names : tuple of str
        Names of the velocities of the result.

    Notes
    -----
    Positions follow the first velocity of their joint. A record that does not know it (`position_owner`), such as an
    older file, loses its positions, so that `lavender.compare` checks velocities only.
    """
    if not isinstance(record, StepRecord):
        raise InputError(f"record is a {type(record).__name__}; a StepRecord is needed")
    n = len(record.names)
    places = as_array("order", order, (n,))
    if sorted(places.tolist()) != list(range(n)) or len(names) != n:
        raise InputError(f"order and names must name each of the {n} velocities of the record once")
    order = places.astype(int)
    changed: dict[str, Any] = {}
    for name in ("velocity", "velocity_after", "coriolis", "force", "damping_force", "angular",
                 "actuator_force", "integrator_force", "acceleration", "gravity_map", "velocity_change",
                 "fluid_force"):  # fmt: skip
        value = getattr(record, name)
        changed[name] = None if value is None else value[order]
    for name in (
        "mass",
        "damping_matrix",
        "actuator_matrix",
        "stiffness_matrix",
        "integrator_matrix",
        "fluid_matrix",
        "coriolis_matrix",
        "uses_coriolis",
    ):
        value = getattr(record, name)
        changed[name] = None if value is None else value[np.ix_(order, order)]
    blocks = tuple(replace(b, jacobian=b.jacobian[:, order]) for b in record.blocks)
    if record.position is not None and record.position_owner is not None:
        owner = np.argsort(order)[record.position_owner]
        places = np.argsort(owner, kind="stable")
        at_rest = record.reference_position
        changed |= {
            "position": record.position[places],
            "position_owner": owner[places],
            "reference_position": None if at_rest is None else at_rest[places],
        }
    elif (order != np.arange(n)).any():
        changed |= {"position": None, "reference_position": None}
    return replace(record, **changed, blocks=blocks, names=names)
