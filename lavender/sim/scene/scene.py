"""A scene: bodies, shapes, joints and parameters."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from lavender.base.arrays import (
    FloatArray,
    check_bool,
    check_float,
    check_int,
    check_nonnegative_magnitudes,
)
from lavender.base.errors import InputError, UnknownName, check_name
from lavender.sim.scene import arithmetic
from lavender.sim.scene.parameters import COMMON_PARAMETERS, Parameters
from lavender.sim.scene.parts import (
    BALL,
    DISTANCE,
    HINGE,
    Body,
    Box,
    Joint,
    Plane,
    Sphere,
    check_numbers,
    check_unit_vector,
    choose_inertia,
    normalise,
)

MAX_BODIES = 2**24 - 1  # The key of a contact has 24 bits for each body.

Builder = Callable[..., None]
#: Builders of the named scenes. Importing the gallery adds its builders.
SCENES: dict[str, Builder] = {}
#: Defaults of a named scene that differ from the defaults of `Parameters`.
DEFAULTS: dict[str, dict[str, Any]] = {}


def named_scene(**defaults: Any) -> Callable[[Builder], Builder]:
    """Register the decorated builder as a scene under the name of the function.

    Parameters
    ----------
    **defaults
        Defaults of the scene for the parameters that every scene has, if they differ from the defaults of `Parameters`.

    Returns
    -------
    callable
        Decorator of a function (scene, ...) that adds bodies and joints to the scene. Its further parameters are the
        scene's own and need defaults.

    Raises
    ------
    InputError
        The name is in use, or a parameter of the builder has the name of a common parameter or no default.
    UnknownName
        A default has the name of no parameter.

    Examples
    --------
    >>> import lavender as lv
    >>> @lv.scene.named_scene(friction=0.2)
    ... def slab(scene, size=2.0):
    ...     scene.add_plane()
    ...     scene.add_box((size, size, 0.1), position=(0, 0, 0.05))
    >>> lv.Scene("slab", size=3.0).n_bodies
    2
    """
    for key in defaults:
        if key not in COMMON_PARAMETERS:
            raise UnknownName("scene parameter", key, COMMON_PARAMETERS)

    def register(build: Builder) -> Builder:
        name = build.__name__
        first, *own = inspect.signature(build).parameters.values()
        if name in SCENES:
            raise InputError(
                f"a scene {name!r} is registered already; give the builder another name"
            )
        for p in own:
            if p.name in COMMON_PARAMETERS or p.default is p.empty or p.kind is p.VAR_KEYWORD:
                raise InputError(
                    f"parameter {p.name!r} of the scene builder {name!r} has no default, or the name of a parameter "
                    f"of all scenes; parameters after {first.name!r} need a default and another name"
                )
        SCENES[name], DEFAULTS[name] = build, defaults
        return build

    return register


class Scene:
    """Bodies, joints and parameters of a simulation: a named scene of the gallery, or an empty one to fill.

    Parameters
    ----------
    name : str, optional
        Name of a scene of the gallery, or of a scene that `named_scene` registered. None: an empty scene.
    **parameters
        The fields of `Parameters`, and the named scene's own (sizes, numbers, angles; see its docstring).

    Raises
    ------
    UnknownName
        The scene or parameter does not exist; the message suggests the nearest name.
    InputError
        A value is not valid.

    Examples
    --------
    >>> import lavender as lv
    >>> scene = lv.Scene(dt=0.01)
    >>> ground = scene.add_plane()
    >>> box = scene.add_box((1, 1, 1), mass=2.0, position=(0, 0, 0.5))
    >>> scene.n_bodies
    2
    """

    def __init__(self, name: str | None = None, **parameters: Any) -> None:
        if name is not None and not (isinstance(name, str) and name in SCENES):
            raise UnknownName("scene", name, SCENES)
        own = list(inspect.signature(SCENES[name]).parameters)[1:] if name is not None else []
        for key in parameters:
            if key not in COMMON_PARAMETERS and key not in own:
                kind = f"parameter of scene {name!r}" if name else "scene parameter"
                raise UnknownName(kind, key, [*COMMON_PARAMETERS, *own])
        self.name = name or ""
        common = {k: v for k, v in parameters.items() if k in COMMON_PARAMETERS}
        if name is not None:
            common = {**DEFAULTS[name], **common}
        self.parameters = Parameters(**common)
        self._common_parameters = common
        self.own = {k: v for k, v in parameters.items() if k in own}
        self.bodies: list[Body] = []
        self.joints: list[Joint] = []
        if name is not None:
            SCENES[name](self, **self.own)
        # Numbers that the gallery built; further ones are added by hand.
        self._built = self.n_bodies, self.n_joints

    @property
    def n_bodies(self) -> int:
        """Number of bodies, static ones included."""
        return len(self.bodies)

    @property
    def n_joints(self) -> int:
        """Number of joints."""
        return len(self.joints)

    def with_parameters(self, **changes: Any) -> Scene:
        """Return the same scene with other parameters.

        A scene of the gallery is built again, and bodies and joints that were added by hand are added again. Defaults
        are computed again: `substeps` from the new `dt`, `order` from the new `solver`.

        Raises
        ------
        UnknownName
            A parameter does not exist. A scene that was built by hand has only the parameters of `Parameters`.
        InputError
            The gallery would build another number of bodies, and joints were added by body numbers.
        """
        scene = Scene(self.name or None, **{**self._common_parameters, **self.own, **changes})
        bodies, joints = self._built
        if scene._built != self._built and self.n_joints > joints:
            raise InputError(
                f"scene {self.name!r} would have {scene.n_bodies} bodies instead of {bodies}, and joints that were "
                "added to it refer to bodies by number: set the parameters first, then add the joints"
            )
        scene.bodies += self.bodies[bodies:]
        scene.joints += self.joints[joints:]
        return scene

    def __copy__(self) -> Scene:
        """Return a copy with its own lists of bodies and joints."""
        twin = object.__new__(Scene)
        vars(twin).update(vars(self), bodies=list(self.bodies), joints=list(self.joints))
        return twin

    # -- bodies ---------------------------------------------------------------------------------

    def add_body(
        self,
        mass: float = 1.0,
        inertia: Any = None,
        *,
        position: Any = (0.0, 0.0, 0.0),
        quaternion: Any = (1.0, 0.0, 0.0, 0.0),
        velocity: Any = (0.0, 0.0, 0.0),
        angular_velocity: Any = (0.0, 0.0, 0.0),
        static: bool = False,
        name: str | None = None,
        friction: float | None = None,
        restitution: float | None = None,
        patch_radius: float | None = None,
        shape: Plane | Sphere | Box | None = None,
    ) -> int:
        """Add a body and return its number.

        Parameters
        ----------
        mass : float, kg
            Positive; not read for a static body.
        inertia : (3,) or (3, 3) kg m^2, optional
            Principal moments or the tensor in the body's axes, positive definite. Default: the inertia of the solid
            shape, or of a ball of radius 0.1 m for a body without a shape.
        position : (3,) m
        quaternion : (4,) w x y z
            Body to world; it is normalised.
        velocity, angular_velocity : (3,) m/s, rad/s
        static : bool
            The body never moves. A mass of 0 is not accepted instead.
        name : str, optional
            Default: shape and number, as "box 3".
        friction, restitution, patch_radius : float, optional
            Default: the value of the scene.
        shape : Plane, Sphere or Box, optional
            None: the body has no contacts.

        Raises
        ------
        InputError
            A value is not valid. The scene is unchanged.
        """
        number = self.n_bodies
        label = name or f"{'body' if shape is None else type(shape).__name__.lower()} {number}"
        if number >= MAX_BODIES:
            raise InputError(
                f"the scene would have more than {MAX_BODIES} bodies; at most {MAX_BODIES} are possible: "
                "use fewer bodies"
            )
        if not isinstance(label, str):
            raise InputError(f"name is {name!r}; a string is needed")
        if shape is not None and not isinstance(shape, (Plane, Sphere, Box)):
            raise InputError(f"shape of {label} is {shape!r}; a Plane, Sphere or Box is needed")
        static = check_bool(f"static of {label}", static) or isinstance(shape, Plane)
        mass = 0.0 if static else check_float(f"mass of {label} [kg]", mass)
        if mass < 0.0 or (mass == 0.0 and not static):
            raise InputError(
                f"mass of {label} is {mass:g} kg; a positive mass is needed, or static=True"
            )
        q = check_numbers(f"quaternion of {label}", quaternion, 4)
        unit_q = normalise(q, 1e-12)
        if unit_q is None:
            raise InputError(
                f"quaternion of {label} is {q.tolist()}; a nonzero quaternion is needed"
            )
        v = check_numbers(f"velocity of {label} [m/s]", velocity, 3)
        omega = check_numbers(f"angular_velocity of {label} [rad/s]", angular_velocity, 3)
        if static and (v.any() or omega.any()):
            raise InputError(f"{label} is static; it has no velocity")
        body = Body(
            name=label,
            shape=shape,
            mass=mass,
            inertia=np.zeros((3, 3)) if static else choose_inertia(label, inertia, shape, mass),
            position=check_numbers(f"position of {label} [m]", position, 3),
            quaternion=unit_q,
            velocity=v,
            angular_velocity=omega,
            friction=_check_optional_number(f"friction of {label}", friction, low=0.0),
            restitution=_check_optional_number(
                f"restitution of {label}", restitution, low=0.0, high=1.0
            ),
            patch_radius=_check_optional_number(
                f"patch_radius of {label} [m]", patch_radius, low=0.0
            ),
        )
        for name in ("friction", "patch_radius"):
            check_nonnegative_magnitudes(
                f"{name} of {label}", np.array([getattr(body, name) or 0.0])
            )
        self.bodies.append(body)
        return number

    def add_box(self, size: Any = (1.0, 1.0, 1.0), mass: float = 1.0, **options: Any) -> int:
        """Add a box with edges of lengths `size` (3,) [m] and return its number; `options` as in `add_body`."""
        return self.add_body(mass, shape=Box(size), **options)

    def add_sphere(self, radius: float = 0.5, mass: float = 1.0, **options: Any) -> int:
        """Add a sphere of `radius` [m] and return its number; `options` as in `add_body`."""
        return self.add_body(mass, shape=Sphere(radius), **options)

    def add_plane(self, normal: Any = (0.0, 0.0, 1.0), offset: float = 0.0, **options: Any) -> int:
        """Add a static half-space normal.x <= offset [m] and return its number.

        `options` are name, friction, restitution and patch_radius as in `add_body`.
        """
        plane = Plane(normal, offset)
        for key in ("position", "quaternion", "velocity", "angular_velocity", "inertia", "mass"):
            if key in options:
                raise InputError(f"a plane is static and has no {key}; give normal and offset")
        position = plane.offset * np.array(plane.normal)
        return self.add_body(0.0, static=True, shape=plane, position=position, **options)

    # -- joints ---------------------------------------------------------------------------------

    def add_joint(
        self,
        kind: str,
        a: int,
        b: int,
        *,
        anchor: Any = None,
        anchor_a: Any = None,
        anchor_b: Any = None,
        axis: Any = None,
        length: float | None = None,
        hertz: float = 0.0,
        damping: float = 1.0,
        motor_speed: float | None = None,
        motor_torque: float | None = None,
        collide: bool = False,
        name: str | None = None,
    ) -> int:
        """Add a joint between bodies a and b in their present poses and return its number.

        Parameters
        ----------
        kind : {"distance", "ball", "hinge"}
        a, b : int
            Body numbers; -1 is the world.
        anchor : (3,) m, world
            Common point of a ball or hinge.
        anchor_a, anchor_b : (3,) m, world
            Ends of a distance joint; default: the bodies' centres.
        axis : (3,), world
            Axis of a hinge.
        length : float, m
            Length of a distance joint; default: the present distance of the anchors.
        hertz, damping : float, 1/s and -
            Frequency and damping ratio of a soft joint; 0 Hz is rigid.
        motor_speed, motor_torque : float, rad/s and N m
            Motor of a hinge: speed of b relative to a about the axis, and the largest torque.
        collide : bool
            Whether the two bodies may touch; by default they do not.

        Raises
        ------
        InputError
            A body does not exist, both bodies are static, or an anchor or axis is missing or superfluous. The scene is
            unchanged.
        """
        check_name("joint", kind, (DISTANCE, BALL, HINGE))
        label = name or f"{kind} {len(self.joints)}"
        a, b = (
            check_int(f"body of {label} (-1: the world)", body, -1, self.n_bodies - 1)
            for body in (a, b)
        )
        if a == b or all(i < 0 or self.bodies[i].is_static for i in (a, b)):
            raise InputError(
                f"{label} joins {a} and {b}; two bodies, at least one of them dynamic, are needed"
            )
        if kind == DISTANCE:
            ends = anchor, anchor_a, anchor_b, length, axis
            pa, pb, length = self._check_distance_ends(label, (a, b), *ends)
        elif anchor is None or anchor_a is not None or anchor_b is not None or length is not None:
            raise InputError(
                f"{label} connects the bodies at one point; anchor= is needed, a point (3,) in world "
                "coordinates [m], and anchor_a, anchor_b and length must be left out"
            )
        else:
            pa = pb = check_numbers(f"anchor of {label} [m]", anchor, 3)
            length = 0.0
        if (axis is None) == (kind == HINGE):
            raise InputError(f"{label}: axis= is needed for a hinge, and only for a hinge")
        world_axis = (
            check_unit_vector(f"axis of {label}", axis)
            if kind == HINGE
            else np.array([0.0, 0.0, 1.0])
        )
        motor = motor_speed is not None, motor_torque is not None
        if any(motor) and not (all(motor) and kind == HINGE):
            raise InputError(
                f"{label}: motor_speed and motor_torque need each other, and a hinge: give both or none"
            )
        joint = Joint(
            kind=kind,
            name=label,
            a=a,
            b=b,
            anchor_a=self._convert_to_local(label, a, pa),
            anchor_b=self._convert_to_local(label, b, pb),
            axis_a=world_axis if a < 0 else self.bodies[a].direction_to_local(world_axis),
            axis_b=world_axis if b < 0 else self.bodies[b].direction_to_local(world_axis),
            length=length,
            hertz=check_float(f"hertz of {label}", hertz, low=0.0),
            damping=check_float(f"damping of {label}", damping, low=0.0),
            motor_speed=_check_optional_number(f"motor_speed of {label} [rad/s]", motor_speed),
            motor_torque=_check_optional_number(
                f"motor_torque of {label} [N m]", motor_torque, low=0.0
            )
            or 0.0,
            collide=check_bool(f"collide of {label}", collide),
        )
        self.joints.append(joint)
        return len(self.joints) - 1

    def _check_distance_ends(
        self,
        label: str,
        bodies: tuple[int, int],
        anchor: Any,
        a: Any,
        b: Any,
        length: Any,
        axis: Any,
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return the anchors (3,) [m] and the length [m] of a distance joint."""
        if anchor is not None or axis is not None:
            raise InputError(f"{label} takes anchor_a and anchor_b; leave anchor and axis out")
        ends = []
        for side, body, point in zip("ab", bodies, (a, b), strict=True):
            if point is None and body < 0:
                raise InputError(
                    f"{label}: anchor_{side} is missing, and body {side} is the world, which has no centre; give "
                    f"anchor_{side} in world coordinates [m]"
                )
            centre = self.bodies[body].position if point is None else point
            ends.append(check_numbers(f"anchor_{side} of {label} [m]", centre, 3))
        pa, pb = ends
        with np.errstate(over="ignore"):
            distance = arithmetic.compute_norm(pb - pa)
        length = check_float(
            f"length of {label} [m]", distance if length is None else length, low=0.0
        )
        if length == 0.0:
            raise InputError(
                f"{label} has length 0, given or because its anchors coincide; a positive length is needed: "
                "use a ball joint instead"
            )
        return pa, pb, length

    def _convert_to_local(self, label: str, body: int, point: FloatArray) -> FloatArray:
        """Return a world point (3,) [m] in the frame of the body."""
        if body < 0:
            return point
        own = self.bodies[body]
        with np.errstate(over="ignore", invalid="ignore"):
            local = own.direction_to_local(point - own.position)
            return check_numbers(f"anchor of {label}, seen from its body [m]", local, 3)

    # -- identity -------------------------------------------------------------------------------

    def fingerprint(self) -> str:
        """Return a hash of everything that cannot change while the scene runs.

        It contains bodies, joints and parameters, without the initial state, the sweep budget and the warm-start mode.
        """
        free = ("solver_iterations", "warm_start")
        head = {
            f.name: getattr(self.parameters, f.name)
            for f in fields(Parameters)
            if f.name not in free
        }
        parts: list[Any] = [head]
        for b in self.bodies:
            shape = None if b.shape is None else [type(b.shape).__name__, repr(b.shape)]
            parts.append(
                [b.name, shape, b.mass, b.inertia, b.friction, b.restitution, b.patch_radius]
            )
        parts += [[getattr(j, f.name) for f in fields(Joint)] for j in self.joints]
        text = json.dumps(
            parts, default=lambda x: x.tolist() if isinstance(x, np.ndarray) else repr(x)
        )
        return hashlib.sha256(text.encode()).hexdigest()

    def __repr__(self) -> str:
        return f"<Scene {self.name or 'by hand'!r}: {self.n_bodies} bodies, {self.n_joints} joints>"


def _check_optional_number(label: str, value: Any, **allowed: float) -> float | None:
    return None if value is None else check_float(label, value, **allowed)
