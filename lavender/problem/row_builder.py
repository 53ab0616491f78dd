"""Builder of the constraint rows of a step: joints, motors, limits, springs and contacts in world coordinates.

The notes of `RowBuilder` have the equations of the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from math import inf
from typing import Any

import numpy as np

from lavender.base.arrays import ArrayLike, FloatArray, check_int
from lavender.base.errors import InputError, check_name
from lavender.problem.cones import Cones
from lavender.problem.data import Names
from lavender.problem.friction import check_shape
from lavender.problem.problem import Problem
from lavender.problem.row_assembly import NAMES, PLANAR_VELOCITIES, RowAssembly, name_block
from lavender.problem.rows import Rows


class RowBuilder(RowAssembly):
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
        return self._add("ball", a, b, feature, name, anchor, anchor_b)

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
        """
        return self._add("hinge", a, b, feature, name, anchor, anchor_b, axis, axis_b)

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
        """
        return self._add("weld", a, b, feature, name, anchor, anchor_b, angle_error)

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
        """
        return self._add("slider", a, b, feature, name, anchor, anchor_b, axis, angle_error)

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
            Distance to keep, above 0. Default: the present distance. If the anchors coincide, the rod pushes b away
            from a along y in two dimensions and along z in three.
        """
        return self._add("distance", a, b, feature, name, anchor_a, anchor_b, length)

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
            Length of the spring at rest. If the anchors coincide, the spring acts along y in two dimensions and along
            z in three.
        stiffness : float, N/m
            k; at least one of `stiffness` and `damping` is positive.
        damping : float, N s/m, default 0
            c.
        """
        return self._add("spring", a, b, feature, name, anchor_a, anchor_b, length, stiffness, damping)

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
        """
        return self._add("motor", a, b, feature, name, axis, anchor, speed, max_torque, max_force)

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
        return self._add("limit", a, b, feature, name, axis, anchor, value, lower, upper)

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
        """
        return self._add("gear", a, b, feature, name, axis_a, axis_b, ratio, angle_error)

    # -- contacts ------------------------------------------------------------------------------------------------

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
        """
        values = (point, normal, tangent, gap, mu, restitution, restitution_threshold)
        return self._add("contact", a, b, feature, name, *values)

    # -- arrays of blocks ----------------------------------------------------------------------------------------

    def contacts(
        self, bodies: ArrayLike, points: ArrayLike, normals: ArrayLike, *, gap: ArrayLike = 0.0, mu: ArrayLike = 0.0,
        restitution: ArrayLike = 0.0, restitution_threshold: ArrayLike = 1.0, tangents: ArrayLike | None = None,
        feature: ArrayLike | None = None, names: Sequence[str] | None = None,
    ) -> np.ndarray:  # fmt: skip
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
        self, block_type: str, bodies: ArrayLike, *, feature: ArrayLike | None = None,
        names: Sequence[str] | None = None, **arguments: Any,
    ) -> np.ndarray:  # fmt: skip
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
            `lv.solve(problem, impulse=problem.carry(previous))` starts from the solution of the step before.
        """
        is_box = check_shape("shape", shape) == "box"
        blocks, rows, b, compliance, keys = self._blocks.export(is_box)
        given = dict(self._names)
        return Problem(
            b,
            Cones._from_blocks(blocks),
            rows=Rows(self._inv_mass, self._inv_inertia, self._velocity, **rows, copy=False),
            friction=friction,
            compliance=compliance,
            key=keys,
            names=Names(len(keys), lambda: [given.get(key) or name_block(key) for key in keys.tolist()]),
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
            raise InputError(f"key is {wanted}; a key that a method of this builder returned is needed")
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
            raise InputError(f"problem is {problem!r:.60}; the result of RowBuilder.problem() is needed")
        after = problem.velocity(impulse)
        return np.ascontiguousarray(after[:, PLANAR_VELOCITIES]) if self._is_planar else after
