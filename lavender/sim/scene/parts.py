"""Bodies, shapes and joints of a scene: plain data, which the engine reads once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float, get_shape
from lavender.base.errors import InputError
from lavender.sim.scene.arithmetic import compute_norm, compute_sine_and_cosine, rotate_vector
from lavender_ext.core.checks import MAX_MAGNITUDE, MIN_MAGNITUDE

# The largest principal moment of inertia may exceed the sum of the other two by this fraction, which is the rounding
# of a flat plate's moments.
PLATE_MOMENT_TOLERANCE = 1e-6
_put = object.__setattr__  # Sets a normalised field of a frozen dataclass.


@dataclass(frozen=True)
class Plane:
    """Half-space of the points x with normal.x <= offset; always static.

    Parameters
    ----------
    normal : (3,)
        In world axes; it is normalised.
    offset : float, m
    """

    normal: tuple[float, float, float]
    offset: float

    def __post_init__(self) -> None:
        _put(self, "normal", tuple(check_unit_vector("normal of a plane", self.normal).tolist()))
        _put(self, "offset", check_float("offset of a plane [m]", self.offset))


@dataclass(frozen=True)
class Sphere:
    """Ball around the body's centre.

    Parameters
    ----------
    radius : float, m
    """

    radius: float

    def __post_init__(self) -> None:
        _put(self, "radius", check_float("radius of a sphere [m]", self.radius, above=0.0))

    def compute_inertia(self, mass: float) -> FloatArray:
        """Return the inertia (3, 3) [kg m^2] of a solid ball of `mass` [kg]."""
        return np.diag(np.full(3, 0.4 * mass * (self.radius * self.radius)))


@dataclass(frozen=True)
class Box:
    """Box around the body's centre, along the body's axes.

    Parameters
    ----------
    size : (3,) m
        Lengths of the edges.
    """

    size: tuple[float, float, float]

    def __post_init__(self) -> None:
        edges = check_numbers("size of a box [m]", self.size, 3)
        if not (edges > 0.0).all():
            raise InputError(
                f"size of a box is {edges.tolist()} m; three positive edges are needed"
            )
        _put(self, "size", tuple(edges.tolist()))

    def compute_inertia(self, mass: float) -> FloatArray:
        """Return the inertia (3, 3) [kg m^2] of a solid box of `mass` [kg]."""
        x, y, z = (s * s for s in self.size)
        return np.diag([y + z, x + z, x + y]) * (mass / 12.0)


@dataclass(frozen=True, eq=False)
class Body:
    """One rigid body.

    Parameters
    ----------
    name : str
    shape : Plane, Sphere, Box or None
    mass : float, kg
        0 for a static body.
    inertia : (3, 3) kg m^2
        In body axes.
    position : (3,) m
    quaternion : (4,)
        Unit quaternion w x y z, body to world.
    velocity : (3,) m/s
    angular_velocity : (3,) rad/s
        In world axes.
    friction, restitution : float, -, optional
        None: the value of the scene.
    patch_radius : float, m, optional
        None: the value of the scene.
    """

    name: str
    shape: Plane | Sphere | Box | None
    mass: float
    inertia: FloatArray = field(repr=False)
    position: FloatArray
    quaternion: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    friction: float | None = None
    restitution: float | None = None
    patch_radius: float | None = None

    @property
    def is_static(self) -> bool:
        """Whether the body never moves."""
        return self.mass == 0.0

    def direction_to_local(self, direction: FloatArray) -> FloatArray:
        """Return a world direction (3,) in the body's frame."""
        return rotate_vector(convert_to_rotation_matrix(self.quaternion).T, direction)


DISTANCE, BALL, HINGE = "distance", "ball", "hinge"


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint between two bodies, or a body and the world.

    Parameters
    ----------
    kind : {"distance", "ball", "hinge"}
    name : str
    a, b : int
        Numbers of the bodies; -1 is the world.
    anchor_a, anchor_b : (3,) m
        In the frames of the bodies.
    axis_a, axis_b : (3,)
        Unit vectors in the frames of the bodies.
    length : float, m
        Length of a distance joint.
    hertz : float, 1/s
        Frequency of a soft joint; 0 is rigid.
    damping : float, -
        Damping ratio of a soft joint.
    motor_speed : float, rad/s, optional
        Speed of b relative to a at a hinge; None: no motor.
    motor_torque : float, N m
        Largest torque of the motor.
    collide : bool
        Whether the two bodies may touch.
    """

    kind: str
    name: str
    a: int
    b: int
    anchor_a: FloatArray
    anchor_b: FloatArray
    axis_a: FloatArray
    axis_b: FloatArray
    length: float = 0.0
    hertz: float = 0.0
    damping: float = 1.0
    motor_speed: float | None = None
    motor_torque: float = 0.0
    collide: bool = False

    @property
    def n_rows(self) -> int:
        """Number of rows that the joint adds to the problem."""
        rows = {DISTANCE: 1, BALL: 3, HINGE: 5}[self.kind]
        return rows + (self.motor_speed is not None)


def convert_to_rotation_matrix(q: FloatArray) -> FloatArray:
    """Return the rotation matrix (3, 3), body to world, of a unit quaternion (4,) w x y z."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def make_quaternion(axis: tuple[float, float, float], angle: float) -> FloatArray:
    """Return the unit quaternion (4,) of a rotation by `angle` [rad] about `axis` (3,)."""
    x = np.asarray(axis, float)
    sine, cosine = compute_sine_and_cosine(angle / 2)
    return np.concatenate([[cosine], sine * (x / compute_norm(x))])


def check_numbers(label: str, value: Any, n: int) -> FloatArray:
    """Return `value` as a new finite array (n,); `label` begins the error messages."""
    if get_shape(label, value) == ():
        raise InputError(f"{label} is {value!r}; {n} numbers are needed")
    return as_array(label, value, (n,)).copy()


def check_unit_vector(label: str, value: object) -> FloatArray:
    """Return `value` as a unit vector (3,); raise InputError if it is zero."""
    x = normalise(check_numbers(label, value, 3))
    if x is None:
        raise InputError(f"{label} is zero; a direction is needed")
    return x


def normalise(x: FloatArray, min_length: float = 0.0) -> FloatArray | None:
    """Return `x` (n,) scaled to length 1, or None if its length does not exceed `min_length`."""
    size = compute_norm(x)
    return x / size if size > min_length else None


def choose_inertia(label: str, inertia: Any, shape: Any, mass: float) -> FloatArray:
    """Return the checked `inertia` as a tensor (3, 3) [kg m^2]; if it is None, the inertia of the solid shape."""
    if inertia is None:
        with np.errstate(all="ignore"):
            x = np.asarray((shape if shape is not None else Sphere(0.1)).compute_inertia(mass))
        quantity = f"inertia of {label}, of mass {mass:g} kg and {shape or 'radius 0.1 m'},"
    else:
        x = _check_inertia_tensor(label, inertia)
        quantity = f"inertia of {label}"
    moments = np.linalg.eigvalsh(x) if np.isfinite(x).all() else x
    if not mass >= MIN_MAGNITUDE or not np.all(
        (moments >= MIN_MAGNITUDE) & (moments <= MAX_MAGNITUDE)
    ):
        raise InputError(
            f"{quantity} is {np.diag(x).tolist()} kg m^2; it and the mass must be from {MIN_MAGNITUDE:g} "
            f"to {MAX_MAGNITUDE:g}: use other units of mass or length"
        )
    return x


def _check_inertia_tensor(label: str, inertia: Any) -> FloatArray:
    """Convert principal moments (3,) or a tensor to a tensor (3, 3) [kg m^2]; reject inertias that no body has."""
    shape = get_shape(f"inertia of {label}", inertia)
    if shape not in ((3,), (3, 3)):
        raise InputError(
            f"inertia of {label} is {inertia!r}; 3 moments or a (3, 3) tensor is needed"
        )
    x = as_array(f"inertia of {label} [kg m^2]", inertia, shape)
    if x.ndim == 1:
        x = np.diag(x)
    if np.abs(x - x.T).max() > 1e-12 * np.abs(x).max():
        raise InputError(
            f"inertia of {label} differs from its transpose by up to {np.abs(x - x.T).max():.3g} kg m^2; a symmetric "
            "tensor is needed: set both entries (i, j) and (j, i), or give 3 principal moments"
        )
    x = 0.5 * x + 0.5 * x.T
    value = np.linalg.eigvalsh(x)
    if not value[0] > 1e-14 * value[-1] or not value[0] > 0.0:
        raise InputError(
            f"inertia of {label} has moments {value.tolist()} kg m^2; all must be positive"
        )
    # Every body satisfies I_3 = sum m (x_1^2 + x_2^2) <= I_1 + I_2.
    if value[2] > (1.0 + PLATE_MOMENT_TOLERANCE) * (value[0] + value[1]):
        raise InputError(
            f"inertia of {label} has moments {value.tolist()} kg m^2; the largest may be at most the sum of the "
            "others (a flat plate has exactly this sum)"
        )
    return x
