"""Builder of the constraint rows of a step: joints, motors, limits, springs and contacts in world coordinates.

With u = J v the velocity of a row, C its error [m or rad], h the step [s] and beta the `baumgarte` factor, every row
is J v+ + compliance lambda = target, within the bounds of its impulse lambda:

    rigid    target = -beta C / h,  compliance = 0                                             (1)
    spring   target = -k C / (c + h k),  compliance = 1 / (h (c + h k))                        (2)
    motor    target = speed,  |lambda| <= h max_torque                                         (3)
    limit    target = -g / h if g > 0, else -beta g / h,  lambda >= 0, g the remaining travel  (4)
    contact  as a limit with g the gap, or -e u if the bodies approach at speed -u             (5)

(1) is Baumgarte's correction (Baumgarte 1972); beta is the error reduction parameter `ERP` of the ODE manual, section
3.7. (2) is a spring of stiffness k with a damper c, integrated by implicit Euler (ODE manual, section 3.8; Catto,
"Soft Constraints", GDC 2011). (3) to (5) follow Catto, "Understanding Constraints" (GDC 2014): (4) lets a joint or
contact close its remaining distance within the step, but not more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from math import hypot, inf
from typing import TYPE_CHECKING, Any, NamedTuple, ParamSpec, TypeVar

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
from lavender.base.renamed import build_attribute_error, suggest_argument_name
from lavender.problem.problem import Problem
from lavender.problem.rows import Rows, check_and_symmetrise_inertia
from lavender_ext.core.checks import MIN_MAGNITUDE

Vector = tuple[float, float, float]

X_AXIS, Y_AXIS, Z_AXIS = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ZERO = (0.0, 0.0, 0.0)
#: Order of the bits of a key, highest first: block type (4), body a + 1 (22), body b + 1 (22), feature (16).
BLOCK_TYPES = (
    "hinge", "ball", "weld", "slider", "distance", "motor", "limit", "spring", "gear", "contact",
)  # fmt: skip
MAX_KEYED_BODIES = 2**22 - 1  # More bodies do not fit into the 22 bits of a key.
MAX_FEATURE = 2**16 - 1  # Larger features do not fit into the 16 bits of a key.
# [-] A normal is rejected if its length differs from 1 by more; float32 causes 1e-7.
NORMAL_LENGTH_TOLERANCE = 1e-5
PLANAR_VELOCITIES = (
    0,
    1,
    5,
)  # Columns of (v_x, v_y, omega_z) in the velocities of a body in three dimensions.


Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def check_arguments(method: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a method so that an unknown argument name raises an InputError that suggests a valid name."""
    code = method.__code__
    valid = code.co_varnames[1 : code.co_argcount + code.co_kwonlyargcount]

    @wraps(method)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        for name in kwargs:
            if name not in valid:
                successor = suggest_argument_name(name, valid)
                words = f"use {successor}=" if successor else f"it takes {', '.join(f'{v}=' for v in valid)}"
                raise InputError(f"RowBuilder.{method.__name__} has no argument {name}=; {words}")
        return method(*args, **kwargs)

    return call


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


class RowBuilder:
    """Build the problem of a step from bodies, joints and contacts in world coordinates, in two or three dimensions.

    The methods `hinge`, `ball`, `weld`, `slider`, `distance`, `motor`, `limit`, `spring`, `gear` and `contact` add one
    block each and return its key. `problem` returns the `Problem`: its joints in the order of the calls, followed by
    its contacts. Bodies are numbered from 0; -1 or None is the static world. `a` and `b` are the bodies of a block: a
    positive impulse along an axis or a normal pushes b forward and a backward. Make a new builder in each step.

    In two dimensions bodies move in the xy plane and rotate about z: vectors have two components, there are no axes of
    rotation, and a contact with friction has one tangent (`tangents=1`).

    Parameters
    ----------
    inv_mass : array-like (n,), 1/kg
        0: a kinematic body, which moves with `velocity` whatever the impulses.
    inv_inertia : array-like (n,) or (n, 3, 3), 1/(kg m^2)
        Two dimensions: about z. Three dimensions: inverse inertia tensors in world axes.
    velocity : array-like (n, 3) or (n, 6), m/s and rad/s
        Velocity at the end of the step without constraint impulses: the present velocity, plus `dt` times gravity and
        other accelerations. Two dimensions: (v_x, v_y, omega). Three dimensions: linear, then angular.
    dt : float, s
        Time step.
    position : array-like (n, 2) or (n, 3), m
        Centres of mass in world coordinates. The number of columns is the number of dimensions.
    baumgarte : float, 0 to 1, default 0.2
        Fraction of the error of joints and of the penetration of contacts that a step removes (eq. 1). 0 removes none,
        so that joints drift apart; 1 removes all of it and turns it into kinetic energy. Bullet and Box2D use 0.2.
    slop : float, m, default 0
        Penetration of contacts that is not corrected, so that resting contacts stay closed. Box2D uses 0.005.

    Raises
    ------
    InputError
        An argument is invalid; the message names it. All methods raise InputError, too: for a body that does not
        exist, two static bodies, a vector of the wrong dimension or of length 0, or a number out of range.

    Examples
    --------
    A pendulum of 1 kg, 1 m to the right of its hinge on the static world, and a box of 2 kg on the ground:

    >>> import numpy as np
    >>> import lavender as lv
    >>> dt = 1 / 60  # s
    >>> velocity = np.tile([0.0, -9.81 * dt, 0.0], (2, 1))  # at rest, after gravity
    >>> builder = lv.RowBuilder([1.0, 0.5], [10.0, 3.0], velocity, dt, position=[(1.0, 2.0), (5.0, 0.5)])
    >>> hinge = builder.hinge(-1, 0, anchor=(0.0, 2.0))
    >>> corners = [builder.contact(-1, 1, (x, 0.0), normal=(0.0, 1.0), mu=0.5) for x in (4.5, 5.5)]
    >>> problem = builder.problem()
    >>> solution = lv.solve(problem, tol=1e-10)
    >>> normal, tangent = solution.impulse[builder.rows_of(corners[0])] / dt  # N
    >>> round(float(normal), 3)  # half of the weight of the box
    9.81
    >>> after = builder.velocity_after(problem, solution.impulse)  # (n, 3): v_x, v_y, omega
    >>> bool(abs(after[0, 1] - after[0, 2]) < 1e-8)  # the pendulum rotates about its hinge: v_y = omega x 1 m
    True
    >>> again = lv.solve(problem, impulse=problem.carry(solution), tol=1e-10)  # warm start of the next step, by keys
    >>> again.success
    True
    """

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
        if len(shape) != 2 or shape[1] not in (2, 3):
            raise InputError(
                f"position [m] has shape {shape}; (n, 2) is needed in two dimensions, (n, 3) in three"
            )
        n, self._dimensions = shape[0], shape[1]
        if n > MAX_KEYED_BODIES:
            raise InputError(f"position has {n} bodies; at most {MAX_KEYED_BODIES} are needed for keys")
        self._position = np.zeros((n, 3))
        self._position[:, : shape[1]] = as_array("position", position, (n, shape[1]), unit="m")
        self._centres: list[Vector] = [(x, y, z) for x, y, z in self._position.tolist()]
        self._inv_mass = as_array("inv_mass", inv_mass, (n,), unit="1/kg")
        check_nonnegative_magnitudes("inv_mass", self._inv_mass, "1/kg")
        if self._is_planar:
            about_z = as_array("inv_inertia", inv_inertia, (n,), unit="1/(kg m^2)")
            check_nonnegative_magnitudes("inv_inertia", about_z, "1/(kg m^2)")
            self._inv_inertia = np.zeros((n, 3, 3))
            self._inv_inertia[:, 2, 2] = about_z
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

    if not TYPE_CHECKING:  # Hide `__getattr__` from type checkers, so that they report unknown names.

        def __getattr__(self, name: str) -> Any:
            raise build_attribute_error("RowBuilder", "'RowBuilder'", name)

    # -- joints --------------------------------------------------------------------------------------------------

    @check_arguments
    def ball(
        self, a: int | None, b: int | None, anchor: ArrayLike, anchor_b: ArrayLike | None = None,
        *, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a ball joint: a point of b stays at a point of a; three rows, in two dimensions two.

        Parameters
        ----------
        a, b : int or None
            Bodies; -1 or None is the static world.
        anchor : array-like (2,) or (3,), m
            Point of the joint on a, in world coordinates.
        anchor_b : array-like, m, optional
            Point of the joint on b. Default: `anchor`. The difference is the error of the joint (eq. 1).
        feature : int, 0 to 65535, optional
            Number of this block among the blocks of the same method and bodies; part of its key. Default: the order of
            the calls. Give it if blocks of a pair of bodies appear and disappear.
        name : str, optional
            Name of the block in reports. Default: method and bodies.

        Returns
        -------
        int
            Key of the block: the same in every step with the same method, bodies and feature.
        """
        pair = self._check_pair(a, b)
        rows = self._make_point_rows(pair, *self._get_anchors(anchor, anchor_b))
        return self._add_joint("ball", pair, rows, feature, name)

    @check_arguments
    def hinge(
        self, a: int | None, b: int | None, anchor: ArrayLike, axis: ArrayLike | None = None,
        anchor_b: ArrayLike | None = None, axis_b: ArrayLike | None = None,
        *, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a hinge: b rotates about an axis of a; five rows. In two dimensions a ball joint, without an axis.

        The angular rows are side.(omega_b - omega_a) for two unit vectors normal to the axis, with the errors
        side.(axis x axis_b). Add `motor` and `limit` for the same bodies to drive and stop the hinge.

        Parameters
        ----------
        a, b, anchor, anchor_b, feature, name
            As in `ball`.
        axis : array-like (3,)
            Hinge axis that is fixed to a, in world coordinates. Its length does not matter.
        axis_b : array-like (3,), optional
            Hinge axis that is fixed to b, in world coordinates. Default: `axis`.

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        rows = self._make_point_rows(pair, *self._get_anchors(anchor, anchor_b))
        axis_on_a = self._check_rotation_axis("axis", axis)
        axis_on_b = axis_on_a if axis_b is None else self._check_rotation_axis("axis_b", axis_b)
        if not self._is_planar:
            error = _cross(axis_on_a, axis_on_b)
            for side in _complete_orthonormal_frame(axis_on_a):
                rows.append(self._make_angular_row(pair, side, side, _dot(side, error)))
        return self._add_joint("hinge", pair, rows, feature, name)

    @check_arguments
    def weld(
        self, a: int | None, b: int | None, anchor: ArrayLike, anchor_b: ArrayLike | None = None,
        *, angle_error: ArrayLike = 0.0, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a weld: b does not move relative to a; six rows, in two dimensions three.

        Parameters
        ----------
        a, b, anchor, anchor_b, feature, name
            As in `ball`.
        angle_error : scalar, or array-like (3,), rad, default 0
            Small rotation of b relative to a from the welded orientation: a rotation vector in world axes, in two
            dimensions the angle.

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        rows = self._make_point_rows(
            pair, *self._get_anchors(anchor, anchor_b)
        ) + self._make_orientation_rows(pair, angle_error)
        return self._add_joint("weld", pair, rows, feature, name)

    @check_arguments
    def slider(
        self, a: int | None, b: int | None, anchor: ArrayLike, axis: ArrayLike, anchor_b: ArrayLike | None = None,
        *, angle_error: ArrayLike = 0.0, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a slider: b moves along an axis of a without rotating; five rows, in two dimensions two.

        Parameters
        ----------
        a, b, anchor, feature, name
            As in `ball`.
        axis : array-like (2,) or (3,)
            Direction of travel in world coordinates, fixed to a. Its length does not matter.
        anchor_b : array-like, m, optional
            Point of b that travels along the line through `anchor`. Default: `anchor`. Its distance from the line is
            the error of the joint.
        angle_error : scalar, or array-like (3,), rad, default 0
            As in `weld`.

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        point_a, point_b = self._get_anchors(anchor, anchor_b)
        direction, offset = self._check_direction("axis", axis), _subtract(point_b, point_a)
        sides = [_cross(Z_AXIS, direction)] if self._is_planar else _complete_orthonormal_frame(direction)
        # The line is fixed to a: use the velocity of the point of a that coincides with point_b.
        rows = [self._make_linear_row(pair, side, point_b, point_b, _dot(side, offset)) for side in sides]
        return self._add_joint(
            "slider", pair, rows + self._make_orientation_rows(pair, angle_error), feature, name
        )

    @check_arguments
    def distance(
        self, a: int | None, b: int | None, anchor_a: ArrayLike, anchor_b: ArrayLike, length: float | None = None,
        *, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a rod: two points keep their distance; one row.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        anchor_a, anchor_b : array-like (2,) or (3,), m
            Points on a and on b, in world coordinates.
        length : float, m, optional
            Distance to keep. Default: the present distance.

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        direction, present, point_a, point_b = self._compute_line_between_anchors(anchor_a, anchor_b)
        wanted = present if length is None else check_float("length", length, low=0.0)
        row = self._make_linear_row(pair, direction, point_a, point_b, present - wanted)
        return self._add_joint("distance", pair, [row], feature, name)

    @check_arguments
    def spring(
        self, a: int | None, b: int | None, anchor_a: ArrayLike, anchor_b: ArrayLike, length: float,
        *, stiffness: float, damping: float = 0.0, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a spring with a damper between two points, integrated by implicit Euler (eq. 2); one row.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        anchor_a, anchor_b : array-like (2,) or (3,), m
            Points on a and on b, in world coordinates.
        length : float, m
            Length of the spring at rest.
        stiffness : float, N/m
            k; at least one of `stiffness` and `damping` is positive.
        damping : float, N s/m, default 0
            c.

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        direction, present, point_a, point_b = self._compute_line_between_anchors(anchor_a, anchor_b)
        rest = check_float("length", length, low=0.0)
        k, c = check_float("stiffness", stiffness, low=0.0), check_float("damping", damping, low=0.0)
        resistance = c + self._dt * k
        if self._dt * resistance < MIN_MAGNITUDE:
            raise InputError(
                f"stiffness is {k:g} N/m and damping is {c:g} N s/m; at least one must be positive, so that "
                f"dt (damping + dt stiffness) is at least {MIN_MAGNITUDE:g}"
            )
        row = self._make_linear_row(pair, direction, point_a, point_b, 0.0)._replace(
            target=-k * (present - rest) / resistance, compliance=1.0 / (self._dt * resistance)
        )
        return self._add_joint("spring", pair, [row], feature, name)

    @check_arguments
    def motor(
        self, a: int | None, b: int | None, axis: ArrayLike | None = None, *, speed: float,
        max_torque: float | None = None, max_force: float | None = None, anchor: ArrayLike | None = None,
        feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a motor: it drives the relative velocity to `speed` with a limited torque or force (eq. 3); one row.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        axis : array-like (2,) or (3,)
            Axis of rotation, or direction of travel, in world coordinates. In two dimensions a motor with a torque has
            no axis.
        speed : float, rad/s or m/s
            axis.(omega_b - omega_a), or the velocity of b relative to a along the axis.
        max_torque : float, N m, optional
            Largest torque of a rotating motor. Give this or `max_force`.
        max_force : float, N, optional
            Largest force of a linear motor, as on a slider; `anchor` is needed with it.
        anchor : array-like (2,) or (3,), m, optional
            Point on b at which the force acts, in world coordinates.

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        wanted = check_float("speed", speed)
        if (max_torque is None) == (max_force is None):
            state = "neither is given" if max_torque is None else "both are given"
            raise InputError(f"max_torque and max_force: {state}; one of the two is needed")
        if max_force is None:
            bound = self._dt * check_float("max_torque", max_torque, low=0.0)
        else:
            bound = self._dt * check_float("max_force", max_force, low=0.0)
        row = self._make_motor_or_limit_row(pair, axis, anchor, max_force is not None)
        row = row._replace(target=wanted, lower=-bound, upper=bound)
        return self._add_joint("motor", pair, [row], feature, name)

    @check_arguments
    def limit(
        self, a: int | None, b: int | None, axis: ArrayLike | None = None, *, value: float, lower: float = -inf,
        upper: float = inf, anchor: ArrayLike | None = None, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add limits of a joint's angle or travel (eq. 4); one row for each finite limit.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        axis : array-like (2,) or (3,)
            Axis of rotation, or direction of travel, in world coordinates. In two dimensions limits of an angle have
            no axis.
        value : float, rad or m
            Present angle of b relative to a about the axis, or travel of b along it.
        lower, upper : float, rad or m
            Limits of `value`; at least one is finite.
        anchor : array-like (2,) or (3,), m, optional
            For limits of travel: point on b, in world coordinates. Without it the angle is limited.

        Returns
        -------
        int
            Key of the block. Both rows have impulses of at least 0: first the lower limit, then the upper.
        """
        pair, present = self._check_pair(a, b), check_float("value", value)
        low = -inf if _is_float(lower) and lower == -inf else check_float("lower", lower)
        high = inf if _is_float(upper) and upper == inf else check_float("upper", upper)
        if low > high or (low == -inf and high == inf):
            wanted = "lower must not exceed upper" if low > high else "at least one must be finite"
            raise InputError(f"lower is {low:g} and upper is {high:g}; {wanted}")
        row, rows = self._make_motor_or_limit_row(pair, axis, anchor, anchor is not None), []
        if low > -inf:
            rows.append(row._replace(target=self._compute_stop_velocity(present - low), lower=0.0))
        if high < inf:
            opposite = [-x for x in row.jac]
            rows.append(
                row._replace(jac=opposite, target=self._compute_stop_velocity(high - present), lower=0.0)
            )
        return self._add_joint("limit", pair, rows, feature, name)

    @check_arguments
    def gear(
        self, a: int | None, b: int | None, axis_a: ArrayLike | None = None, axis_b: ArrayLike | None = None,
        *, ratio: float, angle_error: float = 0.0, feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a gear: axis_a.omega_a + ratio axis_b.omega_b = 0, for bodies on hinges of the static world; one row.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        axis_a, axis_b : array-like (3,)
            Axes of rotation in world coordinates; none in two dimensions. `axis_b` defaults to `axis_a`.
        ratio : float
            Radius of b divided by the radius of a, as Box2D's: positive for gears that mesh outside, negative for a
            belt.
        angle_error : float, rad, default 0
            Present angle_a + ratio angle_b, minus its value when the gears were joined.

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        on_a = self._check_rotation_axis("axis_a", axis_a)
        on_b = on_a if axis_b is None else self._check_rotation_axis("axis_b", axis_b)
        factor = check_float("ratio", ratio)
        if factor == 0.0:
            raise InputError("ratio is 0; a nonzero number is needed: 0 would stop a and leave b free")
        error = check_float("angle_error", angle_error)
        row = self._make_angular_row(pair, _scale(-1.0, on_a), _scale(factor, on_b), error)
        return self._add_joint("gear", pair, [row], feature, name)

    # -- contacts ------------------------------------------------------------------------------------------------

    @check_arguments
    def contact(
        self, a: int | None, b: int | None, point: ArrayLike, normal: ArrayLike, *, gap: float = 0.0, mu: float = 0.0,
        restitution: float = 0.0, restitution_threshold: float = 1.0, tangent: ArrayLike | None = None,
        feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
        """Add a contact point (eq. 5): a normal row, and with friction two tangent rows, in two dimensions one.

        Parameters
        ----------
        a, b, name
            As in `ball`.
        point : array-like (2,) or (3,), m
            Contact point in world coordinates.
        normal : array-like (2,) or (3,)
            Unit vector from a to b.
        gap : float, m, default 0
            Distance between the surfaces; negative for penetration. Over a positive gap the bodies may approach until
            they touch at the end of the step.
        mu : float, default 0
            Coefficient of friction. Without friction the contact has a normal row only.
        restitution : float, 0 to 1, default 0
            Speed of separation divided by the speed of approach, which is measured on `velocity`.
        restitution_threshold : float, m/s, default 1
            Slower approaches do not bounce, so that resting bodies stay at rest. Box2D's default is 1 m/s.
        tangent : array-like (3,), optional
            Direction of the first tangent; only its part normal to `normal` is used. Default: chosen from the normal
            alone. Warm starts need the same tangents in each step. In two dimensions it is the normal rotated by +90
            degrees and is not given.
        feature : int, 0 to 65535, optional
            Number of this point among the contacts of a and b, as from collision detection; part of its key. Default:
            the order of the calls.

        Returns
        -------
        int
            Key of the block.
        """
        pair, at = self._check_pair(a, b), self._check_vector("point", point, "m")
        along, size = self._check_vector("normal", normal), hypot(*self._check_vector("normal", normal))
        if abs(size - 1.0) > NORMAL_LENGTH_TOLERANCE:
            raise InputError(f"normal has length {size:g}; a unit vector from a to b is needed")
        along = _scale(1.0 / size, along)
        distance, friction = check_float("gap", gap), check_float("mu", mu, low=0.0)
        bounce = check_float("restitution", restitution, low=0.0, high=1.0)
        threshold = check_float("restitution_threshold", restitution_threshold, low=0.0)
        if distance > 0.0:
            target = -distance / self._dt
        else:
            target = self._baumgarte * max(0.0, -distance - self._slop) / self._dt
        side = self._choose_tangent(along, tangent)
        arm_a, arm_b = self._compute_arm(pair[0], at), self._compute_arm(pair[1], at)
        key, label = self._reserve_key("contact", pair, feature, name)
        self._contact_blocks.append(
            Contact(
                name=label,
                key=key,
                bodies=pair,
                normal=along,
                tangent=side,
                arm_a=arm_a,
                arm_b=arm_b,
                mu=friction,
                target=target,
                restitution=bounce,
                threshold=threshold,
            )
        )
        return key

    # -- results -------------------------------------------------------------------------------------------------

    @check_arguments
    def problem(self, friction: str = "coulomb", *, shape: str = "disk", name: str = "") -> Problem:
        """Return the problem of the blocks added so far, with keys for warm starts and names for reports.

        Parameters
        ----------
        friction : {"coulomb", "cone"}
            Law of friction, as in `Problem`.
        shape : {"disk", "box"}
            Bound of two tangents, as in `Cones.contacts`.
        name : str, optional
            Name of the problem.

        Returns
        -------
        Problem
            `lv.solve(problem, impulse=problem.carry(previous))` starts from the solution of the step before.
        """
        joints, contacts = self._joint_blocks, self._contact_blocks
        rows = [row for block in joints for row in block.rows]
        tangents = np.array([self._dimensions - 1 if x.mu > 0.0 else 0 for x in contacts], np.int32)
        data = Rows(
            inv_mass=self._inv_mass,
            inv_inertia=self._inv_inertia,
            v_free=self._velocity,
            jac=[row.jac for row in rows],
            joint_ptr=np.cumsum([0, *(len(block.rows) for block in joints)]),
            joint_body=[block.bodies for block in joints],
            normal=[x.normal for x in contacts],
            tangent=[x.tangent for x in contacts],
            arm_a=[x.arm_a for x in contacts],
            arm_b=[x.arm_b for x in contacts],
            contact_body=[x.bodies for x in contacts],
        )
        first = len(rows) + np.cumsum([0, *(1 + tangents)])
        target, compliance = np.zeros(first[-1]), np.zeros(first[-1])
        target[: len(rows)] = [row.target for row in rows]
        compliance[: len(rows)] = [row.compliance for row in rows]
        target[first[:-1]] = [self._compute_normal_target(x) for x in contacts]
        blocks: list[Block | Contact] = [*joints, *contacts]
        return Problem.from_rows(
            data,
            target,
            lower=[row.lower for row in rows],
            upper=[row.upper for row in rows],
            mu=[x.mu for x in contacts],
            tangents=tangents,
            shape=shape,
            friction=friction,
            compliance=compliance,
            key=np.array([block.key for block in blocks], np.uint64),
            names=[block.name for block in blocks],
            name=name,
        )

    def rows_of(self, key: int) -> slice:
        """Return the rows of a block in the problem's impulses and slacks, by the key that its method returned.

        Parameters
        ----------
        key : int

        Returns
        -------
        slice
            `solution.impulse[builder.rows_of(key)]` are the impulses of the block [N s]; in a contact the normal
            impulse is followed by the tangential ones. Call it after all blocks were added: contacts follow joints.
        """
        wanted, start = check_int("key", key, high=2**64 - 1), 0
        for joint in self._joint_blocks:
            if joint.key == wanted:
                return slice(start, start + len(joint.rows))
            start += len(joint.rows)
        for contact in self._contact_blocks:
            size = self._dimensions if contact.mu > 0.0 else 1
            if contact.key == wanted:
                return slice(start, start + size)
            start += size
        raise InputError(f"key is {wanted}; a key that a method of this builder returned is needed")

    def velocity_after(self, problem: Problem, impulse: ArrayLike) -> FloatArray:
        """Return the velocities of the bodies after the step, v + M^-1 J^T impulse.

        Parameters
        ----------
        problem : Problem
            The result of `problem`.
        impulse : array-like (m,), N s
            The impulses of its solution.

        Returns
        -------
        ndarray (n, 3) or (n, 6), m/s and rad/s
            In the layout of `velocity`.
        """
        n = len(self._centres)
        if not isinstance(problem, Problem) or problem.rows is None or problem.rows.n_bodies != n:
            raise InputError(f"problem is {problem!r:.60}; the result of RowBuilder.problem() is needed")
        after = problem.velocity(impulse)
        return np.ascontiguousarray(after[:, PLANAR_VELOCITIES]) if self._is_planar else after

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
        return _normalise(name, self._check_vector(name, value))

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
        offset = _subtract(point_b, point_a)
        size = hypot(*offset)
        if size > MIN_MAGNITUDE:
            return _scale(1.0 / size, offset), size, point_a, point_b
        return (Y_AXIS if self._is_planar else Z_AXIS), size, point_a, point_b

    def _choose_tangent(self, normal: Vector, tangent: ArrayLike | None) -> Vector:
        """Return the unit vector of the first tangent."""
        if self._is_planar:
            if tangent is not None:
                raise InputError(
                    f"tangent is {tangent!r:.60}; in two dimensions it follows from the normal: leave it out"
                )
            return _cross(Z_AXIS, normal)
        if tangent is None:
            return _complete_orthonormal_frame(normal)[0]
        along = self._check_direction("tangent", tangent)
        across = _subtract(along, _scale(_dot(along, normal), normal))
        if hypot(*across) < NORMAL_LENGTH_TOLERANCE:
            raise InputError("tangent is parallel to normal; another direction is needed")
        return _normalise("tangent", across)

    def _reserve_key(
        self, block_type: str, pair: tuple[int, int], feature: int | None, name: str
    ) -> tuple[int, str]:
        """Return the key and the name of a new block, and reserve the key."""
        if not isinstance(name, str):
            raise InputError(f"name is {name!r:.60}; a str is needed")
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
                f"feature is {number}, as of another {block_type} of {bodies}; a different number is needed"
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
        return ZERO if body < 0 else _subtract(point, self._centres[body])

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
        moment_a = _cross(self._compute_arm(pair[0], point_a), axis)
        moment_b = _cross(self._compute_arm(pair[1], point_b), axis)
        return self._make_rigid_row(pair, _scale(-1.0, axis) + _scale(-1.0, moment_a), axis + moment_b, error)

    def _make_angular_row(self, pair: tuple[int, int], axis_a: Vector, axis_b: Vector, error: float) -> Row:
        """Return the row axis_b.omega_b - axis_a.omega_a; its error is an angle [rad]."""
        return self._make_rigid_row(pair, ZERO + _scale(-1.0, axis_a), ZERO + axis_b, error)

    def _make_point_rows(self, pair: tuple[int, int], point_a: Vector, point_b: Vector) -> list[Row]:
        """Return the rows of a ball joint (two in 2-D), which hold a point of body b at a point of body a."""
        offset = _subtract(point_b, point_a)
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
                raise InputError("anchor is given with max_torque; leave it out, or give max_force")
            direction = self._check_rotation_axis("axis", axis)
            return self._make_angular_row(pair, direction, direction, 0.0)
        if anchor is None:
            raise InputError("anchor is None; with max_force the point at which the force acts is needed")
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
                moment = _cross(arm, contact.normal)
                approach += sign * (_dot(v[:3], contact.normal) + _dot(v[3:], moment))
        # The contact bounces only if the bodies touch within the step.
        reaches = contact.target >= 0.0 or approach < contact.target
        if approach < -contact.threshold and reaches:
            return max(contact.target, -contact.restitution * approach)
        return contact.target


def _is_float(value: Any) -> bool:
    return isinstance(value, (float, np.floating))


def _dot(x: Any, y: Any) -> float:
    return float(x[0] * y[0] + x[1] * y[1] + x[2] * y[2])


def _cross(x: Vector, y: Vector) -> Vector:
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


def _subtract(x: Vector, y: Vector) -> Vector:
    return x[0] - y[0], x[1] - y[1], x[2] - y[2]


def _scale(factor: float, x: Vector) -> Vector:
    return factor * x[0], factor * x[1], factor * x[2]


def _normalise(name: str, x: Vector) -> Vector:
    """Return a vector divided by its length; raise InputError if that is 0."""
    size = hypot(*x)
    if size < MIN_MAGNITUDE:
        raise InputError(f"{name} has length {size:g}; a direction is needed")
    return x[0] / size, x[1] / size, x[2] / size


def _complete_orthonormal_frame(axis: Vector) -> list[Vector]:
    """Return two unit vectors that form a right-handed frame with a unit vector: side, axis x side."""
    smallest = min(range(3), key=lambda i: abs(axis[i]))
    side = _normalise("axis", _cross(axis, (X_AXIS, Y_AXIS, Z_AXIS)[smallest]))
    return [side, _cross(axis, side)]
