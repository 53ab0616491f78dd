"""Bodies, shapes and joints: what a scene is made of. Plain data; the engine reads it once."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float, shape_of
from lavender.base.errors import InputError
from lavender.sim.scene.arithmetic import norm, sine_cosine, turned_back
from lavender_ext.core.checks import LEAST, MOST

FLAT = 1e-6  # that rounded moments of a plate may be over
_put = object.__setattr__  # of a frozen shape, what was given as it is kept


@dataclass(frozen=True)
class Plane:
    """All points x with normal.x <= offset are inside; always static."""

    normal: tuple[float, float, float]  # world; made a unit vector
    offset: float  # m

    def __post_init__(self) -> None:
        _put(self, "normal", tuple(unit("normal of a plane", self.normal).tolist()))
        _put(self, "offset", check_float("offset of a plane [m]", self.offset))


@dataclass(frozen=True)
class Sphere:
    """A ball round the body's centre."""

    radius: float  # m

    def __post_init__(self) -> None:
        _put(self, "radius", check_float("radius of a sphere [m]", self.radius, above=0.0))

    def inertia(self, mass: float) -> FloatArray:
        """Inertia (3, 3) [kg m^2] of a solid ball."""
        return np.diag(np.full(3, 0.4 * mass * (self.radius * self.radius)))


@dataclass(frozen=True)
class Box:
    """A box round the body's centre, along the body's axes."""

    size: tuple[float, float, float]  # m, whole edges

    def __post_init__(self) -> None:
        edges = numbers("size of a box [m]", self.size, 3)
        if not (edges > 0.0).all():
            raise InputError(f"size of a box is {edges.tolist()} m; three positive edges are needed")
        _put(self, "size", tuple(edges.tolist()))

    def inertia(self, mass: float) -> FloatArray:
        """Inertia (3, 3) [kg m^2] of a solid box."""
        x, y, z = (s * s for s in self.size)
        return np.diag([y + z, x + z, x + y]) * (mass / 12.0)


@dataclass(frozen=True, eq=False)
class Body:
    """One rigid body; `mass` 0 means static."""

    name: str
    shape: Plane | Sphere | Box | None
    mass: float  # kg
    inertia: FloatArray = field(repr=False)  # (3, 3) kg m^2, body axes
    position: FloatArray  # (3,) m
    quaternion: FloatArray  # (4,) unit, w x y z, body to world
    velocity: FloatArray  # (3,) m/s
    angular_velocity: FloatArray  # (3,) rad/s, world
    friction: float | None = None  # -, None: the scene's
    restitution: float | None = None  # -, None: the scene's
    patch_radius: float | None = None  # m, None: the scene's

    @property
    def is_static(self) -> bool:
        """Whether nothing moves it."""
        return self.mass == 0.0

    def to_local(self, point: FloatArray) -> FloatArray:
        """World point (3,) [m] in the body's frame."""
        return turned_back(rotation(self.quaternion), point - self.position)

    def direction_to_local(self, direction: FloatArray) -> FloatArray:
        """World direction (3,) in the body's frame."""
        return turned_back(rotation(self.quaternion), direction)


DISTANCE, BALL, HINGE = "distance", "ball", "hinge"


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint between bodies a and b (-1: the world); anchors and axes in the bodies' frames."""

    kind: str
    name: str
    a: int
    b: int
    anchor_a: FloatArray  # (3,) m
    anchor_b: FloatArray  # (3,) m
    axis_a: FloatArray  # (3,) unit
    axis_b: FloatArray  # (3,) unit
    length: float = 0.0  # m, distance joints
    hertz: float = 0.0  # 1/s, 0: rigid
    damping: float = 1.0  # -, damping ratio of a soft joint
    motor_speed: float | None = None  # rad/s of b against a, hinges; None: no motor
    motor_torque: float = 0.0  # N m, largest
    collide: bool = False  # whether the two bodies may touch

    @property
    def n_rows(self) -> int:
        """Rows that it brings to the problem."""
        rows = {DISTANCE: 1, BALL: 3, HINGE: 5}[self.kind]
        return rows + (self.motor_speed is not None)


def rotation(q: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3), body to world, of a unit quaternion (4,) w x y z."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(axis: tuple[float, float, float], angle: float) -> FloatArray:
    """Unit quaternion (4,) of a turn by `angle` [rad] round `axis`."""
    x = np.asarray(axis, float)
    sine, cosine = sine_cosine(angle / 2)
    return np.concatenate([[cosine], sine * (x / norm(x))])


def numbers(what: str, value: Any, n: int) -> FloatArray:
    """`value` as a new finite array (n,)."""
    if shape_of(what, value) == ():
        raise InputError(f"{what} is {value!r}; {n} numbers are needed")
    return as_array(what, value, (n,)).copy()


def unit(what: str, value: object) -> FloatArray:
    """`value` as a unit vector (3,)."""
    x = normalised(numbers(what, value, 3))
    if x is None:
        raise InputError(f"{what} is zero; a direction is needed")
    return x


def normalised(x: FloatArray, least: float = 0.0) -> FloatArray | None:
    """`x` (n,) at length 1; None where its length is at most `least`."""
    size = norm(x)
    return x / size if size > least else None


def inertia_of(label: str, given: Any, shape: Any, mass: float) -> FloatArray:
    """(3, 3) kg m^2: as given, checked, or of the shape with that mass."""
    if given is None:
        with np.errstate(all="ignore"):
            x = np.asarray((shape if shape is not None else Sphere(0.1)).inertia(mass))
        what = f"inertia of {label}, of mass {mass:g} kg and {shape or 'radius 0.1 m'},"
    else:
        x, what = _tensor(label, given), f"inertia of {label}"
    moments = np.linalg.eigvalsh(x) if np.isfinite(x).all() else x
    if not mass >= LEAST or not np.all((moments >= LEAST) & (moments <= MOST)):
        raise InputError(
            f"{what} is {np.diag(x).tolist()} kg m^2; it and the mass must be from {LEAST:g} to {MOST:g}: use other "
            "units of mass or length"
        )
    return x


def _tensor(label: str, given: Any) -> FloatArray:
    shape = shape_of(f"inertia of {label}", given)
    if shape not in ((3,), (3, 3)):
        raise InputError(f"inertia of {label} is {given!r}; 3 moments or a (3, 3) tensor is needed")
    x = as_array(f"inertia of {label} [kg m^2]", given, shape)
    if x.ndim == 1:
        x = np.diag(x)
    if np.abs(x - x.T).max() > 1e-12 * np.abs(x).max():
        raise InputError(f"inertia of {label} is not symmetric")
    x = 0.5 * x + 0.5 * x.T
    value = np.linalg.eigvalsh(x)
    if not value[0] > 1e-14 * value[-1] or not value[0] > 0.0:
        raise InputError(f"inertia of {label} has moments {value.tolist()} kg m^2; all must be positive")
    if value[2] > (1.0 + FLAT) * (value[0] + value[1]):  # I_3 = sum m (x_1^2 + x_2^2) <= I_1 + I_2
        raise InputError(
            f"inertia of {label} has moments {value.tolist()} kg m^2; the largest is at most the sum of the others, as "
            "of a flat plate: no body has more"
        )
    return x
