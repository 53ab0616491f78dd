"""Structures of any size under Coulomb's law: piles, walls, heaps, pyramids, towers, cards, arches, ragdolls, gravel.

`build(name, rows, sliding, spread, seed)` returns a problem of about `rows` rows. Bodies are boxes of 1 m and about
1 kg if a structure does not say otherwise; the step is that of the suite. `TUNED` names the structures on which numbers
of solvers may be fitted; figures are published for all, and `HELD_OUT` ones separately.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import lavender as lv
from lavender.suite.build import FALL_SPEED

FRICTION_COEFFICIENT = 0.6
CORNERS = np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])
UP = (0.0, 0.0, 1.0)


@dataclass
class Scene:
    """Boxes, contact points and ball joints, added one at a time; -1 is the ground."""

    position: list[Any] = field(default_factory=list)  # (3,) m
    half: list[Any] = field(default_factory=list)  # (3,) m, half the edges
    mass: list[float] = field(default_factory=list)  # kg
    pairs: list[tuple[int, int]] = field(default_factory=list)  # bodies a and b of each contact point
    points: list[Any] = field(default_factory=list)  # (3,) m
    normals: list[Any] = field(default_factory=list)  # (3,) unit vector from a to b
    joints: list[tuple[int, int]] = field(default_factory=list)
    anchors: list[Any] = field(default_factory=list)  # (3,) m

    def add_box(self, position: Any, half: Any = (0.5, 0.5, 0.5), mass: float = 1.0) -> int:
        """Add a box and return its number."""
        self.position.append(position)
        self.half.append(half)
        self.mass.append(mass)
        return len(self.position) - 1

    def add_contacts(self, a: int, b: int, points: Any, normal: Any = UP) -> None:
        """Add contact points (k, 3) between bodies a and b with a common normal from a to b."""
        for point in points:
            self.pairs.append((a, b))
            self.points.append(point)
            self.normals.append(normal)

    def add_patch(self, a: int, b: int, centre: Any, half_x: float, half_y: float) -> None:
        """Add the four corners of a horizontal rectangle, with b above a."""
        x, y, z = centre
        self.add_contacts(a, b, [(x + half_x * sx, y + half_y * sy, z) for sx, sy in CORNERS])

    def make_rows(self) -> lv.Rows:
        """Build the rows of the scene after one step of gravity."""
        position, half, mass = np.array(self.position), np.array(self.half), np.array(self.mass)
        edges = (2.0 * half) ** 2
        inertia = mass[:, None] / 12.0 * (edges.sum(1)[:, None] - edges)
        inverse = np.zeros((len(mass), 3, 3))
        inverse[:, [0, 1, 2], [0, 1, 2]] = 1.0 / inertia
        velocity = np.zeros((len(mass), 6))
        velocity[:, 2] = -FALL_SPEED
        body, point, normal = (
            np.array(self.pairs, np.int32),
            np.array(self.points),
            np.array(self.normals, float),
        )
        arm_a, arm_b = (
            np.where(side[:, None] >= 0, point - position[np.maximum(side, 0)], 0.0) for side in body.T
        )
        other = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        tangent = np.cross(normal, other)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        joint_body = np.array(self.joints, np.int32).reshape(-1, 2)
        return lv.Rows(
            1.0 / mass, inverse, velocity, normal=normal, tangent=tangent, arm_a=arm_a, arm_b=arm_b, contact_body=body,
            jac=make_ball_jacobian(position, joint_body, np.array(self.anchors).reshape(-1, 3)),
            joint_ptr=np.arange(0, 3 * len(joint_body) + 1, 3), joint_body=joint_body,
        )  # fmt: skip


def make_ball_jacobian(position: Any, body: Any, anchor: Any) -> Any:
    """Return the Jacobian (3 k, 12) of k ball joints between moving bodies."""
    jac = np.zeros((len(body), 3, 12))
    for side, sign in ((0, -1.0), (1, 1.0)):
        x, y, z = (anchor - position[body[:, side]]).T if len(body) else np.zeros((3, 0))
        jac[:, [0, 1, 2], [6 * side, 6 * side + 1, 6 * side + 2]] = sign
        # omega x arm
        for row, column, value in ((0, 4, z), (0, 5, -y), (1, 3, -z), (1, 5, x), (2, 3, y), (2, 4, -x)):
            jac[:, row, 6 * side + column] = sign * value
    return jac.reshape(-1, 12)


# -- structures: number of rows, generator -> rows ---------------------------------------------------------------------


def read_case_rows(name: str) -> lv.Rows:
    """Return the rows of a case of the suite whose bodies have six velocities."""
    rows = lv.suite.case(name).problem.rows
    assert rows is not None
    return rows


def make_pile(rows: int, rng: np.random.Generator) -> lv.Rows:
    """Make the suite's pile of pebbles in a box."""
    n = max(2, round((rows / 14.4) ** (1 / 3)))
    return read_case_rows(f"granularF(n={n}, seed={rng.integers(1, 1000)})")


def make_pyramid(rows: int, _: np.random.Generator) -> lv.Rows:
    """Make the suite's pyramid of boxes in a plane."""
    return read_case_rows(f"pyramidF(k={max(2, round((rows / 12) ** 0.5))})")


def make_wall(rows: int, _: np.random.Generator) -> lv.Rows:
    """Make a wall in running bond: bricks of 2 m, each on two halves, with contacts at the ends."""
    n = max(2, round((rows / 32) ** 0.5))
    scene = Scene()
    brick = {(r, c): scene.add_box((2.0 * c + r % 2, 0.0, r + 0.5), (1.0, 0.5, 0.5), 2.0)
             for r in range(n) for c in range(n)}  # fmt: skip
    for (r, c), b in brick.items():
        x = 2.0 * c + r % 2
        if r == 0:
            scene.add_patch(-1, b, (x, 0.0, 0.0), 1.0, 0.5)
        for below in () if r == 0 else ((c, c + 1) if r % 2 else (c - 1, c)):
            if (r - 1, below) in brick:
                scene.add_patch(
                    brick[r - 1, below], b, (x + (0.5 if below == c + r % 2 else -0.5), 0.0, r), 0.5, 0.5
                )
        if c > 0:
            end = [(x - 1.0, 0.5 * sy, r + 0.5 + 0.5 * sz) for sy, sz in CORNERS]
            scene.add_contacts(brick[r, c - 1], b, end, (1.0, 0.0, 0.0))
    return scene.make_rows()


def make_towers(rows: int, rng: np.random.Generator) -> lv.Rows:
    """Make towers of ten boxes in pairs under a plank with a load; the loads have 1 to 30 kg."""
    scene = Scene()
    for k in range(max(1, round(rows / 276))):
        feet = []
        for x in (6.0 * k, 6.0 * k + 2.0):
            below = -1
            for level in range(10):
                box = scene.add_box((x, 0.0, level + 0.5))
                scene.add_patch(below, box, (x, 0.0, level), 0.5, 0.5)
                below = box
            feet.append((below, x))
        plank = scene.add_box((6.0 * k + 1.0, 0.0, 10.1), (1.5, 0.5, 0.1), 0.5)
        for foot, x in feet:
            scene.add_patch(foot, plank, (x, 0.0, 10.0), 0.5, 0.5)
        load = scene.add_box((6.0 * k + 1.0, 0.0, 10.7), mass=float(np.exp(rng.uniform(0.0, np.log(30.0)))))
        scene.add_patch(plank, load, (6.0 * k + 1.0, 0.0, 10.2), 0.5, 0.5)
    return scene.make_rows()


def make_heap(rows: int, rng: np.random.Generator) -> lv.Rows:
    """Make a heap of boxes: each rests on up to four boxes of the layer below, by four points on a tilted face each."""
    n = max(2, round((rows / 24) ** (1 / 3)))
    scene = Scene()
    site = {}
    for z, x, y in np.ndindex(n, n, n):
        shift = 0.5 * (z % 2)
        position = np.array([x + shift, y + shift, 0.9 * z + 0.5]) + rng.uniform(-0.05, 0.05, 3)
        box = site[x, y, z] = scene.add_box(position, mass=float(rng.uniform(0.5, 2.0)))
        if z == 0:
            scene.add_patch(-1, box, (position[0], position[1], 0.0), 0.4, 0.4)
            continue
        offset = (0, 1) if z % 2 else (-1, 0)
        below = [site[x + i, y + j, z - 1] for i in offset for j in offset if (x + i, y + j, z - 1) in site]
        for a in below if len(below) < 3 else rng.permutation(below)[:3].tolist():
            apart = position - scene.position[a]
            normal = apart * (0.4, 0.4, 1.0)  # Leaning less than the line between the centres
            normal /= np.linalg.norm(normal)
            along = np.cross(normal, rng.normal(size=3))
            along /= np.linalg.norm(along)
            across = np.cross(normal, along)
            middle = scene.position[a] + 0.5 * apart
            scene.add_contacts(a, box, [middle + 0.2 * (i * along + j * across) for i, j in CORNERS], normal)
    return scene.make_rows()


def make_cards(rows: int, _: np.random.Generator) -> lv.Rows:
    """Make a row of houses of cards of six levels that do not touch."""
    return repeat_rows(read_case_rows("card_house(levels=6)"), rows)


def make_arches(rows: int, _: np.random.Generator) -> lv.Rows:
    """Make a row of arches of 25 voussoirs that do not touch."""
    return repeat_rows(read_case_rows("arch(n=25)"), rows)


def make_ragdolls(rows: int, rng: np.random.Generator) -> lv.Rows:
    """Make ragdolls that lie on each other: eleven bodies, ten ball joints, two contacts below each body."""
    # Centre of each part [m] and the part that it hangs on; a doll lies along x.
    parts = [
        ((0.0, 0.0), -1), ((0.5, 0.0), 0), ((0.9, 0.0), 1), ((0.6, 0.3), 1), ((0.6, 0.6), 3), ((0.6, -0.3), 1),
        ((0.6, -0.6), 5), ((-0.4, 0.15), 0), ((-0.8, 0.15), 7), ((-0.4, -0.15), 0), ((-0.8, -0.15), 9),
    ]  # fmt: skip
    layers = 5
    per_layer = max(1, round(rows / 96 / layers))
    width = max(1, round(per_layer**0.5))
    scene = Scene()
    previous: list[list[int]] = []
    for layer in range(layers):
        dolls = []
        for k in range(per_layer):
            corner = np.array([2.0 * (k // width), 1.5 * (k % width)])
            doll: list[int] = []
            for (x, y), parent in parts:
                place = np.add(corner, (x, y)) + rng.uniform(-0.05, 0.05, 2)
                part = scene.add_box(
                    (*place, 0.2 * layer + 0.1), (0.15, 0.1, 0.1), float(rng.uniform(0.5, 8.0))
                )
                doll.append(part)
                if parent >= 0:
                    a = doll[parent]
                    scene.joints.append((a, part))
                    scene.anchors.append(0.5 * (np.array(scene.position[a]) + scene.position[part]))
                below = -1 if layer == 0 else previous[k][int(rng.integers(len(parts)))]
                if layer > 0 and rng.random() < 0.7:
                    below = previous[k][len(doll) - 1]
                if below >= 0 and np.linalg.norm(place - scene.position[below][:2]) > 0.3:
                    below = previous[k][len(doll) - 1]
                scene.add_contacts(below, part, [(place[0] + d, place[1], 0.2 * layer) for d in (-0.1, 0.1)])
            dolls.append(doll)
            if k % width and rng.random() < 0.5:  # The arms of neighbours touch.
                a, b = dolls[k - 1][4], doll[6]
                scene.add_contacts(
                    a, b, [0.5 * (np.array(scene.position[a]) + scene.position[b])], (0.0, 1.0, 0.0)
                )
        previous = dolls
    return scene.make_rows()


def make_gravel(rows: int, rng: np.random.Generator) -> lv.Rows:
    """Make the suite's pile on a plate that rests on the ground: one body has a contact with the whole bottom layer."""
    n = max(2, round((rows / 14.4) ** (1 / 3)))
    pile = read_case_rows(f"granularF(n={n}, seed={rng.integers(1, 1000)})")
    plate, size = len(pile.inv_mass), float(n)
    mass = 0.2 * size**2  # 0.2 kg for each m^2: lighter than the gravel above it.
    on_floor = (pile.contact_body[:, 0] < 0) & (pile.normal[:, 2] > 0.99)
    body, arm_a = pile.contact_body.copy(), pile.arm_a.copy()
    body[on_floor, 0] = plate
    lattice = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    centre = np.array([0.5 * (n - 1), 0.5 * (n - 1), -0.6])
    arm_a[on_floor] = lattice[body[on_floor, 1]] + pile.arm_b[on_floor] - centre
    corners = np.array([(0.5 * size * sx, 0.5 * size * sy, -0.05) for sx, sy in CORNERS])
    inertia = mass / 12.0 * np.array([size**2, size**2, 2.0 * size**2])
    return lv.Rows(
        np.append(pile.inv_mass, 1.0 / mass),
        np.concatenate([pile.inv_inertia, np.diag(1.0 / inertia)[None]]),
        np.concatenate([pile.v_free, [[0.0, 0.0, -FALL_SPEED, 0.0, 0.0, 0.0]]]),
        normal=np.concatenate([pile.normal, np.tile(UP, (4, 1))]),
        tangent=np.concatenate([pile.tangent, np.tile((1.0, 0.0, 0.0), (4, 1))]),
        arm_a=np.concatenate([arm_a, np.zeros((4, 3))]), arm_b=np.concatenate([pile.arm_b, corners]),
        contact_body=np.concatenate([body, np.tile((-1, plate), (4, 1))]),
    )  # fmt: skip


def repeat_rows(one: lv.Rows, rows: int) -> lv.Rows:
    """Return copies of rows of contacts, of about `rows` rows in all, which share no body."""
    count, bodies = max(1, round(rows / (3 * len(one.normal)))), len(one.inv_mass)
    shift = np.repeat(np.arange(count) * bodies, len(one.normal))[:, None]
    body = np.tile(one.contact_body, (count, 1))
    names = ("inv_mass", "inv_inertia", "v_free", "normal", "tangent", "arm_a", "arm_b")
    arrays = {name: np.concatenate([getattr(one, name)] * count) for name in names}
    return lv.Rows(**arrays, contact_body=np.where(body >= 0, body + shift, -1))


TUNED: dict[str, Callable[[int, np.random.Generator], lv.Rows]] = {
    "pile": make_pile, "wall": make_wall, "pyramid": make_pyramid, "towers": make_towers,
}  # fmt: skip
HELD_OUT: dict[str, Callable[[int, np.random.Generator], lv.Rows]] = {
    "heap": make_heap, "cards": make_cards, "arches": make_arches, "ragdolls": make_ragdolls, "gravel": make_gravel,
}  # fmt: skip
STRUCTURES = TUNED | HELD_OUT


def build(name: str, rows: int, sliding: float = 0.0, spread: float = 0.0, seed: int = 7) -> lv.Problem:
    """Build a structure under Coulomb's law.

    Parameters
    ----------
    name : str
        A name of `STRUCTURES`.
    rows : int
        Approximate number of rows.
    sliding : float, m/s
        Horizontal speed of every body, each in its own random direction.
    spread : float
        Standard deviation of the logarithm of the factors by which masses are multiplied.
    seed : int
    """
    rng = np.random.default_rng(seed)
    made = STRUCTURES[name](rows, rng)
    factor = np.exp(spread * rng.standard_normal(len(made.inv_mass)))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(factor))
    velocity = made.v_free.copy()
    velocity[:, 0] += sliding * np.cos(angle)
    velocity[:, 1] += sliding * np.sin(angle)
    arrays = {name: getattr(made, name) for name in (
        "jac", "joint_ptr", "joint_body", "normal", "tangent", "arm_a", "arm_b", "contact_body")}  # fmt: skip
    scaled = lv.Rows(made.inv_mass / factor, made.inv_inertia / factor[:, None, None], velocity, **arrays)
    text = f"{name}(rows={rows}, sliding={sliding:g}, spread={spread:g}, seed={seed})"
    return lv.Problem.from_rows(scaled, mu=FRICTION_COEFFICIENT, tangents=2, name=text)
