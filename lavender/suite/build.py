"""Build problem rows from bodies and contact points. Units: kg, m, s; one time step."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray
from lavender.base.errors import InputError
from lavender.problem import Problem
from lavender.problem.rows import Rows

GRAVITY = 9.81  # [m/s^2] Acceleration along -z.
STEP_SIZE = 0.01  # [s] Time step of all problems of the suite.
FALL_SPEED = GRAVITY * STEP_SIZE  # [m/s] Speed that gravity adds in one step.

CONTACT_FRICTION_LAWS = ("none", "coulomb", "cone")


def map_scalar(function: Callable[[float], float], x: Any) -> FloatArray:
    """Apply a function of `math` to every number; unlike NumPy's functions, it has equal bits on all processors."""
    return np.array([function(value) for value in x.ravel().tolist()]).reshape(x.shape)


class Bodies:
    """Bodies with isotropic inertia or 3 principal moments; v_free is the velocity after a step of gravity."""

    def __init__(self, position: Any, mass: Any, inertia_per_mass: Any) -> None:
        self.position = np.asarray(position, float).reshape(-1, 3)  # (n, 3) m
        self.mass = np.broadcast_to(
            np.asarray(mass, float), (len(self.position),)
        ).copy()  # (n,) kg
        self.inertia = np.multiply.outer(self.mass, inertia_per_mass)  # (n,) or (n, 3) kg m^2
        self.v_free = np.zeros((len(self.mass), 6))  # (n, 6) m/s, rad/s
        self.v_free[:, 2] = -FALL_SPEED

    def make_rows(self, contacts: Contacts | None = None, **more: Any) -> Rows:
        """Build the rows of these bodies with joints or contacts; point masses (no inertia) do not rotate."""
        if contacts is not None:
            more |= dict(zip(("arm_a", "arm_b"), contacts.compute_arms(self.position), strict=True))
            more |= {
                "normal": contacts.normal,
                "tangent": contacts.compute_tangents(),
                "contact_body": contacts.body,
            }
        inv_inertia = np.zeros((len(self.mass), 3, 3))
        if np.all(self.inertia > 0.0):
            inv_inertia[:, [0, 1, 2], [0, 1, 2]] = (1.0 / self.inertia).reshape(len(self.mass), -1)
        return Rows(1.0 / self.mass, inv_inertia, self.v_free, copy=False, **more)


class Contacts:
    """Contact points: `body` (c, 2) holds bodies a and b, -1 for the ground; normals (c, 3) point from a to b."""

    def __init__(self, body: Any, point: Any, normal: Any) -> None:
        self.body: IntArray = np.asarray(body, np.int32).reshape(-1, 2)
        self.point: FloatArray = np.asarray(point, float).reshape(-1, 3)
        self.normal: FloatArray = np.broadcast_to(
            np.asarray(normal, float), self.point.shape
        ).copy()

    def compute_arms(self, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the arms from the centres of a and b to the points, (c, 3) each [m]; zero for the ground."""
        a, b = (
            np.where(side[:, None] >= 0, self.point - position[np.maximum(side, 0)], 0.0)
            for side in (self.body[:, 0], self.body[:, 1])
        )
        return a, b

    def compute_tangents(self) -> FloatArray:
        """Compute unit tangents (c, 3): n x e_x, or n x e_y if n is close to e_x."""
        other = np.where(np.abs(self.normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        t = np.cross(self.normal, other)
        return t / np.linalg.norm(t, axis=1, keepdims=True)


def build_contact_problem(
    bodies: Bodies,
    contacts: Contacts,
    friction: str = "none",
    mu: Any = 0.5,
    target: Any = 0.0,
    **more: Any,
) -> Problem:
    """Build a problem of contacts without friction, or with two tangents under the law "coulomb" or "cone"."""
    if friction not in CONTACT_FRICTION_LAWS:
        raise InputError(
            f"friction is {friction!r}; {' or '.join(CONTACT_FRICTION_LAWS)} is needed"
        )
    rows = bodies.make_rows(contacts)
    if friction == "none":
        return Problem.from_rows(rows, target, **more)
    return Problem.from_rows(rows, target, mu=mu, tangents=2, friction=friction, **more)


def build_joint_problem(
    bodies: Bodies, body: Any, jac: Any, size: int, target: Any = 0.0, **more: Any
) -> Problem:
    """Build a problem of joints of `size` rows each: jac (k size, 12), body (k, 2)."""
    ptr = np.arange(0, len(jac) + 1, size, dtype=np.int32)
    rows = bodies.make_rows(
        jac=np.asarray(jac, float), joint_ptr=ptr, joint_body=np.asarray(body, np.int32)
    )
    return Problem.from_rows(rows, target, **more)


def place_corner_contacts(body: Any, centre: Any, half_x: Any) -> Contacts:
    """Place contacts at the four corners of k horizontal rectangles, with normals up.

    `body` (k, 2) holds the pair of bodies of each rectangle, `centre` (k, 3) [m] its centre, and `half_x` [m] half its
    length along x; its length along y is 1 m.
    """
    sign = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]], float)
    half = np.broadcast_to(np.asarray(half_x, float), (len(body),))
    point = np.repeat(np.asarray(centre, float), 4, axis=0)
    point[:, 0] += (half[:, None] * sign[:, 0]).ravel()
    point[:, 1] += np.tile(0.5 * sign[:, 1], len(body))
    return Contacts(np.repeat(np.asarray(body), 4, axis=0), point, [0.0, 0.0, 1.0])


def place_tower(n: int) -> tuple[FloatArray, IntArray, FloatArray]:
    """Place n bodies of height 1 m on each other.

    Return positions (n, 3) [m], body pairs (n, 2) from the ground up, and contact points (n, 3) [m].
    """
    k = np.arange(n)
    contact_point = np.stack([0.0 * k, 0.0 * k, k], 1)
    return contact_point + np.array([0.0, 0.0, 0.5]), np.stack([k - 1, k], 1), contact_point  # pyright: ignore[reportReturnType]


def add_horizontal_velocity(bodies: Bodies, speed: float, seed: int = 5) -> None:
    """Add a horizontal velocity of `speed` [m/s] to every body, each in its own random direction."""
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(bodies.mass))
    bodies.v_free[:, 0] += speed * map_scalar(math.cos, angle)
    bodies.v_free[:, 1] += speed * map_scalar(math.sin, angle)


def guess_static_loads(bodies: Bodies, contacts: Contacts) -> FloatArray:
    """Guess the normal impulses (c,) [N s]: the contacts below a body carry equal parts of its load."""
    z = np.append(bodies.position[:, 2], -np.inf)  # The ground has the index -1.
    a, b = contacts.body.T
    upper = np.where(z[b] > z[a], b, a)
    lower = np.where(z[b] > z[a], a, b)
    order = np.argsort(upper, kind="stable")
    first = np.searchsorted(upper[order], np.arange(len(bodies.mass) + 1))
    load = np.append(bodies.mass * FALL_SPEED, 0.0)
    impulse = np.zeros(len(upper))
    for k in np.argsort(-bodies.position[:, 2], kind="stable"):
        below = order[first[k] : first[k + 1]]
        if len(below):
            load_per_contact = load[k] / len(below)
            impulse[below] = load_per_contact
            np.add.at(load, lower[below], load_per_contact)
    return impulse
