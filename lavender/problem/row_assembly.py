"""Bodies, checked arguments, keys and rows that `RowBuilder` adds joints and contacts with."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from inspect import Parameter, signature
from math import hypot, inf
from typing import Any, NamedTuple, NoReturn, ParamSpec, TypeVar

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    as_array,
    check_float,
    check_int,
    check_nonnegative_magnitudes,
    get_shape,
)
from lavender.base.errors import InputError
from lavender.problem.rows import check_and_symmetrise_inertia
from lavender.problem.vectors import (
    X_AXIS,
    Y_AXIS,
    Z_AXIS,
    ZERO,
    Vector,
    complete_orthonormal_frame,
    cross,
    dot,
    normalise,
    scale,
    subtract,
)
from lavender_ext.core.checks import MIN_MAGNITUDE

#: Order of the bits of a key, highest first: block type (4), body a + 1 (22), body b + 1 (22), feature (16).
BLOCK_TYPES = (
    "hinge", "ball", "weld", "slider", "distance", "motor", "limit", "spring", "gear", "contact",
)  # fmt: skip
MAX_KEYED_BODIES = 2**22 - 1  # More bodies do not fit into the 22 bits of a key.
MAX_FEATURE = 2**16 - 1  # Larger features do not fit into the 16 bits of a key.
# [-] A normal is rejected if its length differs from 1 by more; float32 causes 1e-7.
NORMAL_LENGTH_TOLERANCE = 1e-5
# Columns of (v_x, v_y, omega_z) in the velocities of a body in three dimensions.
PLANAR_VELOCITIES = (
    0,
    1,
    5,
)


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def check_arguments(method: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a method of `RowBuilder` so that unknown, missing and surplus arguments raise a helpful InputError."""

    @wraps(method)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        try:
            return method(*args, **kwargs)
        except TypeError:
            try:
                signature(method).bind(*args, **kwargs)
            except TypeError:
                reject_call(method, args, kwargs)
            raise

    return call


def reject_call(method: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> NoReturn:
    """Raise InputError for arguments that a method of `RowBuilder` does not have, or that it needs."""
    call = "RowBuilder" if method.__name__ == "__init__" else f"RowBuilder.{method.__name__}"
    valid = dict(list(signature(method).parameters.items())[1:])  # Without `self`.
    for name in kwargs:
        if name not in valid:
            raise InputError(f"{call} has no argument {name}=; it takes {_list(valid)}") from None
    positional = [name for name, x in valid.items() if x.kind is Parameter.POSITIONAL_OR_KEYWORD]
    given = len(args) - 1
    if given > len(positional):
        others = [name for name in valid if name not in positional]
        named = f"; give all others by name: {_list(others)}" if others else ""
        raise InputError(
            f"{call} takes {len(positional)} positional arguments, {', '.join(positional)}; {given} were given{named}"
        ) from None
    for name in positional[:given]:
        if name in kwargs:
            raise InputError(f"{call} has {name} twice, by position and by name: leave one out") from None
    missing = [
        name for name, x in valid.items()
        if x.default is Parameter.empty and name not in positional[:given] and name not in kwargs
    ]  # fmt: skip
    usage = (
        ": builder.velocity_after(problem, solution.impulse)" if method.__name__ == "velocity_after" else ""
    )
    raise InputError(f"{call} lacks {_list(missing)}{usage}") from None


def _list(names: Iterable[str]) -> str:
    return ", ".join(f"{name}=" for name in names)


class Row(NamedTuple):
    """One row of a joint: Jacobian (12,), target [m/s or rad/s], bounds [N s or N m s], compliance."""

    jac: list[float]
    target: float
    lower: float = -inf
    upper: float = inf
    compliance: float = 0.0


class Block(NamedTuple):
    """A joint with its rows."""

    name: str
    key: int
    bodies: tuple[int, int]
    rows: list[Row]


class Contact(NamedTuple):
    """A contact with its frame, arms, coefficients and the target of its normal row without restitution [m/s]."""

    name: str
    key: int
    bodies: tuple[int, int]
    normal: Vector
    tangent: Vector
    arm_a: Vector
    arm_b: Vector
    mu: float
    target: float
    restitution: float
    threshold: float


def _check_dimensions(position: tuple[int, ...], velocity: tuple[int, ...], inertia: tuple[int, ...]) -> None:
    """Check the shape of `position`; name it if the shapes of the other arguments belong to another dimension."""
    order = "the order is inv_mass, inv_inertia, velocity, dt, position"
    if len(position) == 2 and velocity == (position[0], {3: 2, 6: 3}.get(position[1])):
        raise InputError(
            f"position [m] has shape {position} and velocity {velocity}, so the two seem to be swapped: {order}"
        )
    if len(position) != 2 or position[1] not in (2, 3):
        raise InputError(
            f"position [m] has shape {position}; (n, 2) is needed in two dimensions, (n, 3) in three"
        )
    n = position[0]
    if position[1] == 3 and velocity == (n, 3) and len(inertia) < 2:
        raise InputError(
            f"position [m] has shape {position}, three dimensions, but velocity has shape {velocity} and inv_inertia "
            f"{inertia}, two dimensions: position ({n}, 2) is needed, without the angle; in three dimensions velocity "
            f"({n}, 6) and inv_inertia ({n}, 3, 3)"
        )


def _as_inverses(name: str, value: ArrayLike, n: int, unit: str) -> FloatArray:
    """Convert inverse masses or inertias (n,); the error for infinity names the value of a body that does not move."""
    array = as_array(name, value, (n,), finite=False, unit=unit)
    infinite = np.flatnonzero(np.isposinf(array))
    if len(infinite):
        raise InputError(
            f"{name} [{unit}] of body {infinite[0]} is inf, and a finite number is needed; it is 0 for a body that "
            "impulses do not move"
        )
    check_nonnegative_magnitudes(name, array, unit)
    return array


class RowAssembly:
    """Bodies, blocks and keys of a step; the notes of `RowBuilder` define equations (1) to (5).

    `RowBuilder` describes the arguments.
    """

    @check_arguments
    def __init__(
        self,
        inv_mass: ArrayLike,
        inv_inertia: ArrayLike,
        velocity: ArrayLike,
        dt: float,
        position: ArrayLike,
        *,
        baumgarte: float = 0.2,
        slop: float = 0.0,
    ) -> None:
        shape = get_shape("position", position)
        _check_dimensions(shape, get_shape("velocity", velocity), get_shape("inv_inertia", inv_inertia))
        n, self._dimensions = shape[0], shape[1]
        if n > MAX_KEYED_BODIES:
            raise InputError(f"position has {n} bodies; at most {MAX_KEYED_BODIES} are needed for keys")
        self._position = np.zeros((n, 3))
        self._position[:, : shape[1]] = as_array("position", position, (n, shape[1]), unit="m")
        self._centres: list[Vector] = [(x, y, z) for x, y, z in self._position.tolist()]
        self._inv_mass = _as_inverses("inv_mass", inv_mass, n, "1/kg")
        if self._is_planar:
            self._inv_inertia = np.zeros((n, 3, 3))
            self._inv_inertia[:, 2, 2] = _as_inverses("inv_inertia", inv_inertia, n, "1/(kg m^2)")
            self._velocity = np.zeros((n, 6))
            self._velocity[:, PLANAR_VELOCITIES] = as_array("velocity", velocity, (n, 3), unit="m/s, rad/s")
        else:
            tensors = as_array("inv_inertia", inv_inertia, (n, 3, 3), unit="1/(kg m^2)")
            self._inv_inertia = check_and_symmetrise_inertia("inv_inertia", tensors)
            self._velocity = as_array("velocity", velocity, (n, 6), unit="m/s, rad/s")
        self._dt = check_float("dt", dt, above=0.0)
        self._baumgarte = check_float("baumgarte", baumgarte, low=0.0, high=1.0)
        self._slop = check_float("slop", slop, low=0.0)
        self._joint_blocks: list[Block] = []
        self._contact_blocks: list[Contact] = []
        self._keys: set[int] = set()
        self._next_feature: dict[tuple[str, int, int], int] = {}

    # -- arguments -----------------------------------------------------------------------------------------------

    @property
    def _is_planar(self) -> bool:
        return self._dimensions == 2

    def _check_pair(self, a: int | None, b: int | None) -> tuple[int, int]:
        """Return the numbers of two different bodies, at most one of them the static world (-1)."""
        found, n = [], len(self._centres)
        for name, body in (("a", a), ("b", b)):
            try:
                found.append(-1 if body is None else check_int(name, body, -1, n - 1))
            except InputError:
                raise InputError(
                    f"{name} is {body!r:.60}; the number of one of the {n} bodies is needed, counted from 0, or -1 or "
                    "None for the static world"
                ) from None
        if found[0] == found[1]:
            same = "the static world" if found[0] < 0 else f"body {found[0]}"
            raise InputError(f"a and b are both {same}; two bodies are needed, at most one of them static")
        return found[0], found[1]

    def _check_vector(self, name: str, value: ArrayLike, unit: str = "") -> Vector:
        """Return a vector of the builder's dimension with three components."""
        if get_shape(name, value) == ():  # Reject a scalar here, as `as_array` would repeat it.
            raise InputError(f"{name} is {value!r:.60}; a vector ({self._dimensions},) is needed")
        x = as_array(name, value, (self._dimensions,), unit=unit).tolist()
        return x[0], x[1], x[2] if len(x) == 3 else 0.0

    def _check_direction(self, name: str, value: ArrayLike) -> Vector:
        """Return a vector divided by its length."""
        return normalise(name, self._check_vector(name, value))

    def _check_rotation_axis(self, name: str, value: ArrayLike | None) -> Vector:
        """Return the unit vector of an axis of rotation: z in two dimensions, which need no axis."""
        if self._is_planar:
            if value is not None:
                raise InputError(
                    f"{name} is {value!r:.60}; in two dimensions all rotation is about z: leave it out"
                )
            return Z_AXIS
        if value is None:
            raise InputError(
                f"{name} is None; a vector (3,) in world coordinates is needed in three dimensions"
            )
        return self._check_direction(name, value)

    def _get_anchors(self, anchor: ArrayLike, anchor_b: ArrayLike | None) -> tuple[Vector, Vector]:
        """Return the anchor points on a and on b."""
        point = self._check_vector("anchor", anchor, "m")
        return point, point if anchor_b is None else self._check_vector("anchor_b", anchor_b, "m")

    def _compute_line_between_anchors(
        self, anchor_a: ArrayLike, anchor_b: ArrayLike
    ) -> tuple[Vector, float, Vector, Vector]:
        """Return unit vector, distance and both ends of the line between two anchors."""
        point_a, point_b = (
            self._check_vector("anchor_a", anchor_a, "m"),
            self._check_vector("anchor_b", anchor_b, "m"),
        )
        offset = subtract(point_b, point_a)
        size = hypot(*offset)
        if size > MIN_MAGNITUDE:
            return scale(1.0 / size, offset), size, point_a, point_b
        return (Y_AXIS if self._is_planar else Z_AXIS), size, point_a, point_b

    def _choose_tangent(self, normal: Vector, tangent: ArrayLike | None) -> Vector:
        """Return the unit vector of the first tangent."""
        if self._is_planar:
            if tangent is not None:
                raise InputError(
                    f"tangent is {tangent!r:.60}; in two dimensions it follows from the normal: leave it out"
                )
            return cross(Z_AXIS, normal)
        if tangent is None:
            return complete_orthonormal_frame(normal)[0]
        along = self._check_direction("tangent", tangent)
        across = subtract(along, scale(dot(along, normal), normal))
        if hypot(*across) < NORMAL_LENGTH_TOLERANCE:
            raise InputError(
                f"tangent is {tangent!r:.60}, which is parallel to the normal; another direction is needed, "
                "or None"
            )
        return normalise("tangent", across)

    def _reserve_key(
        self, block_type: str, pair: tuple[int, int], feature: int | None, name: str
    ) -> tuple[int, str]:
        """Return the key and the name of a new block, and reserve the key."""
        if not isinstance(name, str):
            raise InputError(f"name is {name!r:.60}; a text is needed")
        if feature is None:
            number = self._next_feature.get((block_type, *pair), 0)
            if number > MAX_FEATURE:
                raise InputError(
                    f"feature is None; after {number} blocks of one pair of bodies it must be given"
                )
        else:
            number = check_int("feature", feature, high=MAX_FEATURE)
        key = BLOCK_TYPES.index(block_type) << 60 | pair[0] + 1 << 38 | pair[1] + 1 << 16 | number
        bodies = " and ".join("world" if body < 0 else f"body {body}" for body in pair)
        if key in self._keys:
            raise InputError(
                f"feature is {number}, which another {block_type} of {bodies} already has; a number that no "
                f"other {block_type} of them has is needed"
            )
        self._keys.add(key)
        self._next_feature[(block_type, *pair)] = number + 1
        return key, name or f"{block_type} {number} of {bodies}"

    def _add_joint(
        self, block_type: str, pair: tuple[int, int], rows: list[Row], feature: int | None, name: str
    ) -> int:
        """Add a joint and return its key."""
        key, label = self._reserve_key(block_type, pair, feature, name)
        self._joint_blocks.append(Block(label, key, pair, rows))
        return key

    # -- rows ----------------------------------------------------------------------------------------------------

    def _compute_arm(self, body: int, point: Vector) -> Vector:
        """Return a point minus the centre of a body; 0 for the static world."""
        return ZERO if body < 0 else subtract(point, self._centres[body])

    def _make_rigid_row(
        self, pair: tuple[int, int], on_a: tuple[float, ...], on_b: tuple[float, ...], error: float
    ) -> Row:
        """Return a rigid row (eq. 1) from its Jacobian on a and on b; columns of the static world are 0."""
        jac = [0.0] * 12
        if pair[0] >= 0:
            jac[:6] = on_a
        if pair[1] >= 0:
            jac[6:] = on_b
        return Row(jac, -self._baumgarte * error / self._dt)

    def _make_linear_row(
        self, pair: tuple[int, int], axis: Vector, point_a: Vector, point_b: Vector, error: float
    ) -> Row:
        """Return the row axis.(v_b + omega_b x arm_b - v_a - omega_a x arm_a); its error is a distance [m]."""
        moment_a = cross(self._compute_arm(pair[0], point_a), axis)
        moment_b = cross(self._compute_arm(pair[1], point_b), axis)
        return self._make_rigid_row(pair, scale(-1.0, axis) + scale(-1.0, moment_a), axis + moment_b, error)

    def _make_angular_row(self, pair: tuple[int, int], axis_a: Vector, axis_b: Vector, error: float) -> Row:
        """Return the row axis_b.omega_b - axis_a.omega_a; its error is an angle [rad]."""
        return self._make_rigid_row(pair, ZERO + scale(-1.0, axis_a), ZERO + axis_b, error)

    def _make_point_rows(self, pair: tuple[int, int], point_a: Vector, point_b: Vector) -> list[Row]:
        """Return the rows of a ball joint (two in 2-D), which hold a point of body b at a point of body a."""
        offset = subtract(point_b, point_a)
        return [
            self._make_linear_row(pair, axis, point_a, point_b, offset[i])
            for i, axis in enumerate((X_AXIS, Y_AXIS, Z_AXIS)[: self._dimensions])
        ]

    def _make_orientation_rows(self, pair: tuple[int, int], angle_error: ArrayLike) -> list[Row]:
        """Return the rows that hold the relative orientation."""
        if self._is_planar:
            error: list[float] = [check_float("angle_error", angle_error)]
            axes: tuple[Vector, ...] = (Z_AXIS,)
        else:
            error = as_array("angle_error", angle_error, (3,), unit="rad").tolist()
            axes = (X_AXIS, Y_AXIS, Z_AXIS)
        return [self._make_angular_row(pair, axis, axis, x) for axis, x in zip(axes, error, strict=True)]

    def _make_motor_or_limit_row(
        self, pair: tuple[int, int], axis: ArrayLike | None, anchor: ArrayLike | None, is_linear: bool
    ) -> Row:
        """Return the row of a motor or limit: of travel at the anchor, or of rotation."""
        if not is_linear:
            if anchor is not None:
                raise InputError(
                    "anchor is given with max_torque, which acts everywhere on the body: leave anchor out, "
                    "or give max_force"
                )
            direction = self._check_rotation_axis("axis", axis)
            return self._make_angular_row(pair, direction, direction, 0.0)
        if anchor is None:
            raise InputError("anchor is None; a motor with max_force needs the point at which the force acts")
        if axis is None:
            raise InputError(f"axis is None; the direction of travel ({self._dimensions},) is needed")
        point = self._check_vector("anchor", anchor, "m")
        return self._make_linear_row(pair, self._check_direction("axis", axis), point, point, 0.0)

    def _compute_stop_velocity(self, travel: float) -> float:
        """Return the smallest velocity away from a limit [m/s or rad/s] if `travel` remains up to it (eq. 4)."""
        return (-travel if travel > 0.0 else -self._baumgarte * travel) / self._dt

    def _compute_normal_target(self, contact: Contact) -> float:
        """Return the target of a contact's normal row, with restitution if the bodies approach fast enough (eq. 5)."""
        approach = 0.0
        for sign, body, arm in (
            (-1.0, contact.bodies[0], contact.arm_a),
            (1.0, contact.bodies[1], contact.arm_b),
        ):
            if body >= 0 and contact.restitution > 0.0:
                v = self._velocity[body].tolist()
                moment = cross(arm, contact.normal)
                approach += sign * (dot(v[:3], contact.normal) + dot(v[3:], moment))
        # The contact bounces only if the bodies touch within the step.
        reaches = contact.target >= 0.0 or approach < contact.target
        if approach < -contact.threshold and reaches:
            return max(contact.target, -contact.restitution * approach)
        return contact.target
