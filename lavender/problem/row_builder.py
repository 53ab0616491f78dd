"""Builder of the constraint rows of a step: joints, motors, limits, springs and contacts in world coordinates.

The notes of `RowBuilder` have the equations of the rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from inspect import signature
from math import dist, hypot, inf
from typing import Any

import numpy as np

from lavender.base.arrays import (
    ArrayLike,
    FloatArray,
    as_array,
    as_names,
    check_float,
    check_int,
    check_nonnegative_magnitudes,
    get_shape,
)
from lavender.base.errors import InputError, check_name
from lavender.problem.cones import Cones
from lavender.problem.data import Names
from lavender.problem.friction import SHAPES
from lavender.problem.problem import Problem
from lavender.problem.rows import Rows, check_and_symmetrise_inertia
from lavender_ext.core.checks import MIN_MAGNITUDE, find_body_fault
from lavender_ext.core.row_blocks import ARGUMENTS, FAULTS, RowBlocks

#: Types of blocks; a key has the number of the type (4 bits), body a + 1 (22), body b + 1 (22), and the feature (16).
BLOCK_TYPES = tuple(ARGUMENTS)
#: Names of the arguments of each type of block in the order of `RowBlocks.add`: vectors, then numbers.
NAMES = {
    block_type: [name.rstrip("?") for name in vectors + numbers]
    for block_type, (vectors, numbers) in ARGUMENTS.items()
}
MAX_KEYED_BODIES = 2**22 - 1  # More bodies do not fit into the 22 bits of a key.
MAX_FEATURE = 2**16 - 1  # Larger features do not fit into the 16 bits of a key.
# Columns of (v_x, v_y, omega_z) in the velocities of a body in three dimensions.
PLANAR_VELOCITIES = (0, 1, 5)
# Axes of rotation, or directions of travel, which two dimensions do not have, or which have two components.
ROTATION_AXES = ("axis?", "axis_a?", "axis_b?")
#: Ranges of numbers that may not be negative.
RANGES = {
    name: {"low": 0.0}
    for name in ("length", "max_torque", "max_force", "stiffness", "damping", "mu")
} | {
    "restitution": {"low": 0.0, "high": 1.0},
    "restitution_threshold": {"low": 0.0},
}
#: Messages of the faults of row_blocks.pyx; `argument` is the one that a fault refers to, `given` its value.
MESSAGES = {
    "axis_given": "{argument} is {given!r:.60}; in two dimensions all rotation is about z: leave it out",
    "axis_missing": "{argument} is None; a vector ({dimensions},) in world coordinates is needed",
    "length": "{argument} has length {size:g}; a direction is needed",
    "anchor_given": "anchor is given with max_torque, which acts everywhere on the body: leave anchor out, or give "
    "max_force",
    "anchor_missing": "anchor is None; a motor with max_force needs the point at which the force acts",
    "rod": "length is {length}, and anchor_a and anchor_b are {span:g} m apart; a positive length is needed, as a rod "
    "of length 0 has no direction: give length, or use ball for two points that coincide",
    "spring": "stiffness is {stiffness:g} N/m and damping is {damping:g} N s/m; at least one must be positive, so that "
    f"dt (damping + dt stiffness) is at least {MIN_MAGNITUDE:g}",
    "motor": "max_torque is {max_torque} and max_force is {max_force}; exactly one of the two is needed: max_torque "
    "for rotation, max_force for travel",
    "limits": "lower is {lower:g} and upper is {upper:g}; lower must not exceed upper, and at least one must be "
    "finite: change one of the two",
    "ratio": "ratio is 0; a nonzero number is needed: 0 would stop a and leave b free",
    "normal": "normal has length {size:g}; a unit vector from a to b is needed",
    "tangent_given": "tangent is {tangent!r:.60}; in two dimensions it follows from the normal: leave it out",
    "parallel": "tangent is {tangent!r:.60}, which is parallel to the normal; another direction is needed, or None",
}


def name_block(key: int) -> str:
    """Return the default name of a block, such as "hinge 0 of world and body 3", from its key."""
    bodies = ((key >> shift & MAX_KEYED_BODIES) - 1 for shift in (38, 16))
    places = " and ".join("world" if body < 0 else f"body {body}" for body in bodies)
    return f"{BLOCK_TYPES[key >> 60]} {key & MAX_FEATURE} of {places}"


def _check_dimensions(
    position: tuple[int, ...], velocity: tuple[int, ...], inertia: tuple[int, ...]
) -> None:
    """Check the shape of `position`; name it if the shapes of the other arguments belong to another dimension."""
    order = "the order is inv_mass, inv_inertia, velocity, dt, position"
    if len(position) == 2 and velocity == (position[0], {3: 2, 6: 3}.get(position[1])):
        raise InputError(
            f"position [m] has shape {position} and velocity {velocity}, so the two seem to be swapped: {order}"
        )
    if len(position) != 2 or position[1] not in (2, 3):
        raise InputError(
            f"position [m] has shape {position}; (n, 2) in two dimensions, (n, 3) in three is needed"
        )
    n = position[0]
    if position[1] == 3 and velocity == (n, 3) and len(inertia) < 2:
        raise InputError(
            f"position [m] has shape {position}, three dimensions, but velocity has shape {velocity} and inv_inertia "
            f"{inertia}, two dimensions: position ({n}, 2), or velocity ({n}, 6) and inv_inertia ({n}, 3, 3) are needed"
        )


def _as_inverses(name: str, value: ArrayLike, n: int, unit: str) -> FloatArray:
    """Convert inverse masses or inertias (n,); the error for infinity names the value of a body that does not move."""
    array = as_array(name, value, (n,), finite=False, unit=unit)
    infinite = np.flatnonzero(np.isposinf(array))
    if len(infinite):
        raise InputError(
            f"{name} [{unit}] of body {infinite[0]} is inf; a finite number, 0 if fixed, is needed"
        )
    check_nonnegative_magnitudes(name, array, unit)
    return array


class RowBuilder:
    """Build the problem of a step from bodies, joints and contacts in world coordinates, in two or three dimensions.

    The methods `hinge`, `ball`, `weld`, `slider`, `distance`, `motor`, `limit`, `spring`, `gear` and `contact` add one
    block each and return its key; `joints` and `contacts` add arrays of blocks. `problem` returns the `Problem`: its
    joints in the order of the calls, followed by its contacts. Bodies are numbered from 0; -1 or None is the static
    world. `a` and `b` are the bodies of a block: a positive impulse along an axis or a normal pushes b forward and a
    backward. Make a new builder in each step.

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
        Fraction of the error of joints and of the penetration of contacts that a step removes (eq. 1 below). 0 removes
        none, so that joints drift apart; 1 removes all of it and turns it into kinetic energy. Bullet and Box2D use
        0.2.
    slop : float, m, default 0
        Penetration of contacts that is not corrected, so that resting contacts stay closed. Box2D uses 0.005. Give
        0.001 or more if a stack is solved with a fixed number of sweeps: with 0, the error that the sweeps leave opens
        and closes the contacts in turn, and the stack rocks. After 5 s, six boxes of 1 m with 10 sweeps in each step of
        1/120 s move at 0.4 m/s with 0, and at 0.0001 m/s with 0.001.
    velocity_before : array-like, m/s and rad/s, optional
        Velocity before the step, without gravity, in the layout of `velocity`: restitution applies to its approach.
        Default: `velocity`. Each bounce then also returns the velocity that gravity adds in the step, so that a ball
        with e = 1 climbs.

    Raises
    ------
    InputError
        An argument is invalid; the message names it. All methods raise InputError, too: for a body that does not
        exist, two static bodies, a vector of the wrong dimension or of length 0, or a number out of range.

    Notes
    -----
    With u = J v the velocity of a row, C its error [m or rad], h = `dt` and beta = `baumgarte`, every row is
    J v+ + compliance lambda = target, within the bounds of its impulse lambda::

        rigid    target = -beta C / h,  compliance = 0                                             (1)
        spring   target = -k C / (c + h k),  compliance = 1 / (h (c + h k))                        (2)
        motor    target = speed,  -h max_torque <= lambda <= h max_torque                          (3)
        limit    target = -g / h if g > 0, else -beta g / h,  lambda >= 0, g the remaining travel  (4)
        contact  as a limit with g the gap, or -e u if u, of `velocity_before`, is an approach     (5)

    (1) is Baumgarte's correction (Baumgarte 1972); beta is the error reduction parameter `ERP` of the ODE manual,
    section 3.7. (2) is a spring of stiffness k with a damper c, integrated by implicit Euler (ODE manual, section 3.8;
    Catto, "Soft Constraints", GDC 2011). (3) to (5) follow Catto, "Understanding Constraints" (GDC 2014): (4) lets a
    joint or contact close its remaining distance within the step, but not more. In (5) a penetration counts from
    `slop` on, g = min(0, gap + slop), and e is the restitution.

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
    >>> again = lv.solve(problem, impulse=solution, tol=1e-10)  # warm start of the next step, by keys
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
        velocity_before: ArrayLike | None = None,
    ) -> None:
        shape = get_shape("position", position)
        _check_dimensions(
            shape, get_shape("velocity", velocity), get_shape("inv_inertia", inv_inertia)
        )
        n, self._dimensions = shape[0], shape[1]
        if n > MAX_KEYED_BODIES:
            raise InputError(
                f"position has {n} bodies; at most {MAX_KEYED_BODIES} are needed for keys"
            )
        self._position = np.zeros((n, 3))
        self._position[:, : shape[1]] = as_array("position", position, (n, shape[1]), unit="m")
        self._inv_mass = _as_inverses("inv_mass", inv_mass, n, "1/kg")
        if self._is_planar:
            self._inv_inertia = np.zeros((n, 3, 3))
            self._inv_inertia[:, 2, 2] = _as_inverses("inv_inertia", inv_inertia, n, "1/(kg m^2)")
        else:
            tensors = as_array("inv_inertia", inv_inertia, (n, 3, 3), unit="1/(kg m^2)")
            none = np.zeros((0, 2), np.int32)
            empty = np.zeros((0, 3))
            if find_body_fault(self._inv_mass, tensors, none, none, empty, empty, True)[0]:
                tensors = check_and_symmetrise_inertia("inv_inertia", tensors)
            self._inv_inertia = tensors
        self._velocity = before = self._as_velocity("velocity", velocity)
        if velocity_before is not None:
            before = self._as_velocity("velocity_before", velocity_before)
        self._dt = check_float("dt", dt, above=0.0)
        self._baumgarte = check_float("baumgarte", baumgarte, low=0.0, high=1.0)
        self._slop = check_float("slop", slop, low=0.0)
        self._blocks = RowBlocks(
            self._position,
            self._velocity,
            before,
            self._dimensions,
            self._dt,
            self._baumgarte,
            self._slop,
        )
        self._names: dict[int, str] = {}  # Names of blocks that were given, by key.

    def _as_velocity(self, name: str, velocity: ArrayLike) -> FloatArray:
        """Check velocities of the bodies, and return them as linear and angular velocities (n, 6)."""
        n = len(self._position)
        if not self._is_planar:
            return as_array(name, velocity, (n, 6), unit="m/s, rad/s")
        out = np.zeros((n, 6))
        out[:, PLANAR_VELOCITIES] = as_array(name, velocity, (n, 3), unit="m/s, rad/s")
        return out

    # -- joints --------------------------------------------------------------------------------------------------

    def ball(
        self,
        a: int | None,
        b: int | None,
        anchor: ArrayLike,
        anchor_b: ArrayLike | None = None,
        *,
        feature: int | None = None,
        name: str = "",
    ) -> int:
        """Add a ball joint: a point of b stays at a point of a; three rows, in two dimensions two.

        Parameters
        ----------
        a, b : int or None
            Bodies; -1 or None is the static world.
        anchor : array-like (2,) or (3,), m
            Point of the joint on a, in world coordinates.
        anchor_b : array-like, m, optional
            Point of the joint on b. Default: `anchor`. The difference is the error C (`RowBuilder`, eq. 1).
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
        return self._add("ball", a, b, feature, name, anchor, anchor_b)

    def hinge(
        self,
        a: int | None,
        b: int | None,
        anchor: ArrayLike,
        axis: ArrayLike | None = None,
        anchor_b: ArrayLike | None = None,
        axis_b: ArrayLike | None = None,
        *,
        feature: int | None = None,
        name: str = "",
    ) -> int:
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
        """
        return self._add("hinge", a, b, feature, name, anchor, anchor_b, axis, axis_b)

    def weld(
        self,
        a: int | None,
        b: int | None,
        anchor: ArrayLike,
        anchor_b: ArrayLike | None = None,
        *,
        angle_error: ArrayLike = 0.0,
        feature: int | None = None,
        name: str = "",
    ) -> int:
        """Add a weld: b does not move relative to a; six rows, in two dimensions three.

        Parameters
        ----------
        a, b, anchor, anchor_b, feature, name
            As in `ball`.
        angle_error : scalar, or array-like (3,), rad, default 0
            Small rotation of b relative to a from the welded orientation: a rotation vector in world axes, in two
            dimensions the angle.
        """
        return self._add("weld", a, b, feature, name, anchor, anchor_b, angle_error)

    def slider(
        self,
        a: int | None,
        b: int | None,
        anchor: ArrayLike,
        axis: ArrayLike,
        anchor_b: ArrayLike | None = None,
        *,
        angle_error: ArrayLike = 0.0,
        feature: int | None = None,
        name: str = "",
    ) -> int:
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
        """
        return self._add("slider", a, b, feature, name, anchor, anchor_b, axis, angle_error)

    def distance(
        self,
        a: int | None,
        b: int | None,
        anchor_a: ArrayLike,
        anchor_b: ArrayLike,
        length: float | None = None,
        *,
        feature: int | None = None,
        name: str = "",
    ) -> int:
        """Add a rod: two points keep their distance; one row.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        anchor_a, anchor_b : array-like (2,) or (3,), m
            Points on a and on b, in world coordinates.
        length : float, m, optional
            Distance to keep, above 0. Default: the present distance. If the anchors coincide, the rod pushes b away
            from a along y in two dimensions and along z in three.
        """
        return self._add("distance", a, b, feature, name, anchor_a, anchor_b, length)

    def spring(
        self,
        a: int | None,
        b: int | None,
        anchor_a: ArrayLike,
        anchor_b: ArrayLike,
        length: float,
        *,
        stiffness: float,
        damping: float = 0.0,
        feature: int | None = None,
        name: str = "",
    ) -> int:
        """Add a spring with a damper between two points, integrated by implicit Euler (`RowBuilder`, eq. 2); one row.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        anchor_a, anchor_b : array-like (2,) or (3,), m
            Points on a and on b, in world coordinates.
        length : float, m
            Length of the spring at rest. If the anchors coincide, the spring acts along y in two dimensions and along
            z in three.
        stiffness : float, N/m
            k; at least one of `stiffness` and `damping` is positive.
        damping : float, N s/m, default 0
            c.
        """
        return self._add(
            "spring", a, b, feature, name, anchor_a, anchor_b, length, stiffness, damping
        )

    def motor(
        self,
        a: int | None,
        b: int | None,
        axis: ArrayLike | None = None,
        *,
        speed: float,
        max_torque: float | None = None,
        max_force: float | None = None,
        anchor: ArrayLike | None = None,
        feature: int | None = None,
        name: str = "",
    ) -> int:
        """Add a motor: it drives to `speed` with a limited torque or force (`RowBuilder`, eq. 3); one row.

        Parameters
        ----------
        a, b, feature, name
            As in `ball`.
        axis : array-like (2,) or (3,)
            Axis of rotation, or direction of travel, in world coordinates. In two dimensions a motor with a torque has
            no axis.
        speed : float, rad/s or m/s
            axis.(omega_b - omega_a), or the velocity of b relative to a along the axis. In two dimensions a positive
            speed turns b counterclockwise relative to a: a wheel b of a vehicle a that rolls to +x has a negative one.
        max_torque : float, N m, optional
            Largest torque of a rotating motor. Give this or `max_force`.
        max_force : float, N, optional
            Largest force of a linear motor, as on a slider; `anchor` is needed with it.
        anchor : array-like (2,) or (3,), m, optional
            Point on b at which the force acts, in world coordinates.
        """
        return self._add("motor", a, b, feature, name, axis, anchor, speed, max_torque, max_force)

    def limit(
        self,
        a: int | None,
        b: int | None,
        axis: ArrayLike | None = None,
        *,
        value: float,
        lower: float = -inf,
        upper: float = inf,
        anchor: ArrayLike | None = None,
        feature: int | None = None,
        name: str = "",
    ) -> int:
        """Add limits of a joint's angle or travel (`RowBuilder`, eq. 4); one row for each finite limit.

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
        return self._add("limit", a, b, feature, name, axis, anchor, value, lower, upper)

    def gear(
        self,
        a: int | None,
        b: int | None,
        axis_a: ArrayLike | None = None,
        axis_b: ArrayLike | None = None,
        *,
        ratio: float,
        angle_error: float = 0.0,
        feature: int | None = None,
        name: str = "",
    ) -> int:
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
        """
        return self._add("gear", a, b, feature, name, axis_a, axis_b, ratio, angle_error)

    # -- contacts ------------------------------------------------------------------------------------------------

    def contact(
        self,
        a: int | None,
        b: int | None,
        point: ArrayLike,
        normal: ArrayLike,
        *,
        gap: float = 0.0,
        mu: float = 0.0,
        restitution: float = 0.0,
        restitution_threshold: float = 1.0,
        tangent: ArrayLike | None = None,
        feature: int | None = None,
        name: str = "",
    ) -> int:
        """Add a contact point (`RowBuilder`, eq. 5): a normal row, and with friction two tangent rows, in 2-D one.

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
            Speed of separation divided by the speed of approach, which is measured on `velocity_before`.
        restitution_threshold : float, m/s, default 1
            Slower approaches do not bounce, so that resting bodies stay at rest. Box2D's default is 1 m/s.
        tangent : array-like (3,), optional
            Direction of the first tangent; only its part normal to `normal` is used. Default: chosen from the normal
            alone. Warm starts need the same tangents in each step. In two dimensions it is the normal rotated by +90
            degrees and is not given.
        feature : int, 0 to 65535, optional
            Number of this point among the contacts of a and b, as from collision detection; part of its key. Default:
            the order of the calls.
        """
        values = (point, normal, tangent, gap, mu, restitution, restitution_threshold)
        return self._add("contact", a, b, feature, name, *values)

    # -- arrays of blocks ----------------------------------------------------------------------------------------

    def contacts(
        self,
        bodies: ArrayLike,
        points: ArrayLike,
        normals: ArrayLike,
        *,
        gap: ArrayLike = 0.0,
        mu: ArrayLike = 0.0,
        restitution: ArrayLike = 0.0,
        restitution_threshold: ArrayLike = 1.0,
        tangents: ArrayLike | None = None,
        feature: ArrayLike | None = None,
        names: Sequence[str] | None = None,
    ) -> np.ndarray:
        """Add n contacts: the same as n calls of `contact`, in less time.

        Parameters
        ----------
        bodies : array-like (n, 2) of int
            Bodies a and b of each contact; -1 is the static world.
        points : array-like (n, 2) or (n, 3), m
            Contact points in world coordinates.
        normals : array-like (n, 2) or (n, 3), or one vector
            Unit vectors from a to b.
        gap, mu, restitution, restitution_threshold : scalar or (n,)
            As in `contact`.
        tangents : array-like (n, 3), or one vector, optional
            As `tangent` of `contact`.
        feature : array-like (n,) of int, optional
            As in `contact`.
        names : sequence of str (n,), optional
            Names of the contacts in reports.

        Returns
        -------
        ndarray (n,) of uint64
            Keys of the contacts.

        Raises
        ------
        InputError
            An argument is invalid; the message has the number of the first invalid contact. No contact is added.
        """
        values = (points, normals, tangents, gap, mu, restitution, restitution_threshold)
        return self._add_many("contact", bodies, feature, names, values)

    def joints(
        self,
        block_type: str,
        bodies: ArrayLike,
        *,
        feature: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        **arguments: Any,
    ) -> np.ndarray:
        """Add n joints of one type: the same as n calls of the method with this name.

        Parameters
        ----------
        block_type : str
            Name of the method: "hinge", "ball", "weld", "slider", "distance", "motor", "limit", "spring" or "gear".
        bodies : array-like (n, 2) of int
            Bodies a and b of each joint; -1 is the static world.
        feature, names
            As in `contacts`.
        **arguments
            Arguments of the method. Vectors are arrays (n, 2) or (n, 3), or one vector for all joints; numbers are (n,)
            or scalars.

        Returns
        -------
        ndarray (n,) of uint64
            Keys of the joints.

        Raises
        ------
        InputError
            An argument is invalid; the message has the number of the first invalid joint. No joint is added.
        TypeError
            The method has no argument of this name, or an argument is missing.
        """
        check_name("block_type", block_type, [name for name in NAMES if name != "contact"])
        bound = signature(getattr(type(self), block_type)).bind(self, None, None, **arguments)
        bound.apply_defaults()
        values = [bound.arguments[name] for name in NAMES[block_type]]
        return self._add_many(block_type, bodies, feature, names, values)

    # -- results -------------------------------------------------------------------------------------------------

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
            `lv.solve(problem, impulse=previous)` starts from the solution of the step before.
        """
        is_box = check_name("shape", shape, SHAPES) == "box"
        blocks, rows, b, compliance, keys = self._blocks.export(is_box)
        given = dict(self._names)
        return Problem(
            b,
            Cones._from_blocks(blocks),
            rows=Rows(self._inv_mass, self._inv_inertia, self._velocity, **rows, copy=False),
            friction=friction,
            compliance=compliance,
            key=keys,
            names=Names(
                len(keys), lambda: [given.get(key) or name_block(key) for key in keys.tolist()]
            ),
            name=name,
            copy=False,
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
        wanted = check_int("key", key, high=2**64 - 1)
        found = self._blocks.find_rows(wanted)
        if found is None:
            raise InputError(
                f"key is {wanted}; a key that a method of this builder returned is needed"
            )
        return slice(found[0], found[0] + found[1])

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
        n = len(self._position)
        if not isinstance(problem, Problem) or problem.rows is None or problem.rows.n_bodies != n:
            raise InputError(
                f"problem is {problem!r:.60}; the result of RowBuilder.problem() is needed"
            )
        after = problem.velocity(impulse)
        return np.ascontiguousarray(after[:, PLANAR_VELOCITIES]) if self._is_planar else after

    # -- arguments -----------------------------------------------------------------------------------------------

    @property
    def _is_planar(self) -> bool:
        return self._dimensions == 2

    def _check_pair(self, a: int | None, b: int | None) -> tuple[int, int]:
        """Return the numbers of two different bodies, at most one of them the static world (-1)."""
        found = []
        n = len(self._position)
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
            raise InputError(
                f"a and b are both {same}; two bodies are needed, at most one of them static"
            )
        return found[0], found[1]

    def _convert_values(self, block_type: str, values: Iterable[Any]) -> tuple[Any, ...]:
        """Return the arguments of one block as lists and floats; raise InputError if one has a wrong type or range."""
        vectors, numbers = ARGUMENTS[block_type]
        converted: list[Any] = []
        for i, (argument, value) in enumerate(zip(vectors + numbers, values, strict=True)):
            name = argument.rstrip("?")
            is_vector, width = self._get_width(block_type, i)
            if value is None and name != argument:
                converted.append(None)
            elif argument in ROTATION_AXES and self._is_planar and get_shape(name, value) != (2,):
                raise InputError(MESSAGES["axis_given"].format(argument=name, given=value))
            elif is_vector:
                if (
                    width == self._dimensions
                    and name != "angle_error"
                    and get_shape(name, value) == ()
                ):
                    raise InputError(f"{name} is {value!r:.60}; a vector ({width},) is needed")
                unit = "m" if name.startswith(("anchor", "point")) else ""
                converted.append(as_array(name, value, (width,), unit=unit).tolist())
            elif isinstance(value, (float, np.floating)) and value == {
                "lower": -inf,
                "upper": inf,
            }.get(name):
                converted.append(float(value))
            else:
                converted.append(check_float(name, value, **RANGES.get(name, {})))
        return tuple(converted)

    def _get_width(self, block_type: str, i: int) -> tuple[bool, int]:
        """Return whether argument i of a type of block is a vector, and its length."""
        vectors, _ = ARGUMENTS[block_type]
        if i < len(vectors) and vectors[i] == "angle_error":
            return not self._is_planar, 3
        return i < len(vectors), self._dimensions

    def _describe_fault(self, block_type: str, values: Sequence[Any]) -> str:
        """Return the message of the last fault of `_blocks`; `values` are the converted arguments of the block."""
        x = dict(zip(NAMES[block_type], values, strict=True))
        i = self._blocks.argument
        more = {
            "argument": NAMES[block_type][i],
            "given": values[i],
            "dimensions": self._dimensions,
        }
        if isinstance(values[i], list):
            more["size"] = hypot(*values[i])
        if block_type == "distance":
            more["span"] = dist(x["anchor_a"], x["anchor_b"])
        return MESSAGES[FAULTS[self._blocks.fault]].format(**x, **more)

    def _check_feature(self, block_type: str, pair: tuple[int, int], feature: int | None) -> int:
        """Return the feature of a new block."""
        key = BLOCK_TYPES.index(block_type) << 60 | pair[0] + 1 << 38 | pair[1] + 1 << 16
        if feature is None:
            number: int = self._blocks.next_feature.get(key, 0)
            if number > MAX_FEATURE:
                raise InputError(
                    f"feature is None; after {number} blocks of a pair of bodies, one is needed"
                )
        else:
            number = check_int("feature", feature, high=MAX_FEATURE)
        if key | number in self._blocks.keys:
            bodies = " and ".join("world" if body < 0 else f"body {body}" for body in pair)
            raise InputError(
                f"feature is {number}, which another {block_type} of {bodies} already has; a number that no "
                f"other {block_type} of them has is needed"
            )
        return number

    # -- blocks --------------------------------------------------------------------------------------------------

    def _add(
        self,
        block_type: str,
        a: int | None,
        b: int | None,
        feature: int | None,
        name: str,
        *values: Any,
    ) -> int:
        """Add a block and return its key; `values` are its ARGUMENTS."""
        if not isinstance(name, str):
            raise InputError(f"name is {name!r:.60}; a text is needed")
        number = BLOCK_TYPES.index(block_type)
        key: int | None = self._blocks.add(number, a, b, feature, values)
        if key is None:  # An argument is invalid, or needs a conversion.
            pair, values = self._check_pair(a, b), self._convert_values(block_type, values)
            key = self._blocks.add(
                number, *pair, self._check_feature(block_type, pair, feature), values
            )
            if key is None:
                raise InputError(self._describe_fault(block_type, values))
        if name:
            self._names[key] = name
        return key

    def _add_many(
        self,
        block_type: str,
        bodies: ArrayLike,
        feature: ArrayLike | None,
        names: Any,
        values: Iterable[Any],
    ) -> np.ndarray:
        """Add n blocks and return their keys (n,); `values` are arrays of their ARGUMENTS."""
        pairs = as_array("bodies", bodies, (None, 2), dtype=np.int32)
        n = len(pairs)
        numbers = None if feature is None else as_array("feature", feature, (n,), dtype=np.int32)
        labels = None if names is None else as_names("names", names, n)
        arrays = [
            None if value is None else self._as_values(block_type, k, value, n)
            for k, value in enumerate(values)
        ]
        keys = np.empty(n, np.uint64)
        i = self._blocks.add_many(
            BLOCK_TYPES.index(block_type), pairs, numbers, tuple(arrays), keys
        )
        if i >= 0:
            try:
                pair = self._check_pair(*pairs[i].tolist())
                single: list[Any] = [x if x is None else x[i].tolist() for x in arrays]
                if self._is_planar and block_type in ("weld", "slider"):
                    single[-1] = single[-1][2]  # The angle of the orientation error.
                single = list(self._convert_values(block_type, single))
                self._check_feature(block_type, pair, None if numbers is None else int(numbers[i]))
            except InputError as error:
                raise InputError(f"{block_type} {i}: {error}") from None
            if FAULTS[self._blocks.fault] != "conversion":
                raise InputError(f"{block_type} {i}: {self._describe_fault(block_type, single)}")
            raise InputError(
                f"{block_type} {i}: an earlier one of the same bodies has its feature, or they are more than "
                f"{MAX_FEATURE + 1}; different features up to {MAX_FEATURE} are needed"
            )
        if labels is not None:
            self._names.update(zip(keys.tolist(), labels, strict=True))
        return keys

    def _as_values(self, block_type: str, k: int, value: ArrayLike, n: int) -> FloatArray:
        """Convert argument k of n blocks to an array; one vector or number is repeated."""
        name = NAMES[block_type][k]
        (is_vector, width) = self._get_width(block_type, k)
        if not is_vector:
            array = as_array(name, value, (n,), finite=name not in ("lower", "upper"))
            return array if width == self._dimensions else np.outer(array, (0.0, 0.0, 1.0))
        shape = get_shape(name, value)
        if shape == () and name != "angle_error":
            raise InputError(
                f"{name} is {value!r:.60}; vectors ({n}, {width}) are needed, or one vector"
            )
        if shape in ((), (width,)):
            return np.tile(as_array(name, value, (width,)), (n, 1))
        return as_array(name, value, (n, width))
