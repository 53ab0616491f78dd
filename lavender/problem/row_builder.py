"""Builder of the constraint rows of a step: joints, motors, limits, springs and contacts in world coordinates.

The notes of `RowBuilder` have the equations of the rows.
"""

from __future__ import annotations

from math import hypot, inf
from typing import Any

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, check_float, check_int
from lavender.base.errors import InputError
from lavender.problem.problem import Problem
from lavender.problem.row_assembly import (
    NORMAL_LENGTH_TOLERANCE,
    PLANAR_VELOCITIES,
    Block,
    Contact,
    RowAssembly,
    check_arguments,
)
from lavender.problem.rows import Rows
from lavender.problem.vectors import Z_AXIS, complete_orthonormal_frame, cross, dot, scale, subtract
from lavender_ext.core.checks import MIN_MAGNITUDE


class RowBuilder(RowAssembly):
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
        Fraction of the error of joints and of the penetration of contacts that a step removes (eq. 1 below). 0 removes
        none, so that joints drift apart; 1 removes all of it and turns it into kinetic energy. Bullet and Box2D use
        0.2.
    slop : float, m, default 0
        Penetration of contacts that is not corrected, so that resting contacts stay closed. Box2D uses 0.005. Give
        0.001 or more if a stack is solved with a fixed number of sweeps: with 0, the error that the sweeps leave opens
        and closes the contacts in turn, and the stack rocks. After 5 s, six boxes of 1 m with 10 sweeps in each step of
        1/120 s move at 0.4 m/s with 0, and at 0.0001 m/s with 0.001.

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
        contact  as a limit with g the gap, or -e u if the bodies approach at speed -u             (5)

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
    >>> again = lv.solve(problem, impulse=problem.carry(solution), tol=1e-10)  # warm start of the next step, by keys
    >>> again.success
    True
    """

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
            error = cross(axis_on_a, axis_on_b)
            for side in complete_orthonormal_frame(axis_on_a):
                rows.append(self._make_angular_row(pair, side, side, dot(side, error)))
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
        direction, offset = self._check_direction("axis", axis), subtract(point_b, point_a)
        sides = [cross(Z_AXIS, direction)] if self._is_planar else complete_orthonormal_frame(direction)
        # The line is fixed to a: use the velocity of the point of a that coincides with point_b.
        rows = [self._make_linear_row(pair, side, point_b, point_b, dot(side, offset)) for side in sides]
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
        """Add a spring with a damper between two points, integrated by implicit Euler (`RowBuilder`, eq. 2); one row.

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

        Returns
        -------
        int
            Key of the block.
        """
        pair = self._check_pair(a, b)
        wanted = check_float("speed", speed)
        if (max_torque is None) == (max_force is None):
            state = "neither is given" if max_torque is None else "both are given"
            raise InputError(
                f"of max_torque and max_force {state}; exactly one of the two is needed: max_torque for "
                "rotation, max_force for travel"
            )
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
        pair, present = self._check_pair(a, b), check_float("value", value)
        low = -inf if _is_float(lower) and lower == -inf else check_float("lower", lower)
        high = inf if _is_float(upper) and upper == inf else check_float("upper", upper)
        if low > high or (low == -inf and high == inf):
            wanted = "lower must not exceed upper" if low > high else "at least one must be finite"
            raise InputError(f"lower is {low:g} and upper is {high:g}; {wanted}: change one of the two")
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
        row = self._make_angular_row(pair, scale(-1.0, on_a), scale(factor, on_b), error)
        return self._add_joint("gear", pair, [row], feature, name)

    # -- contacts ------------------------------------------------------------------------------------------------

    @check_arguments
    def contact(
        self, a: int | None, b: int | None, point: ArrayLike, normal: ArrayLike, *, gap: float = 0.0, mu: float = 0.0,
        restitution: float = 0.0, restitution_threshold: float = 1.0, tangent: ArrayLike | None = None,
        feature: int | None = None, name: str = "",
    ) -> int:  # fmt: skip
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
        along = scale(1.0 / size, along)
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

    @check_arguments
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


def _is_float(value: Any) -> bool:
    return isinstance(value, (float, np.floating))
