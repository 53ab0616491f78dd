"""Problems that nobody drew by hand: `wild(seed)` draws structure, size, masses, law and form.

For judging choices that were made on other problems: tune on some seeds, publish on others. Each draw is of one
step of gravity on bodies of one structure,

    structure  lattice, heap, towers, wall, tree, net, ragdolls, snake, anvil
    masses     equal, uniform in [0.5, 2], log-uniform over 1e2 ... 1e8, two classes, one heavy body
    law        none, coulomb, cone, box (friction in bounds of fixed size), with joints wherever the structure has them
    form       rows, matrix as CSR, dense, CSR with asymmetric errors as recorded problems have (1e-5 to 2e-3), or
               J and M (`Problem.from_jacobian`)

and every problem of symmetric form has a solution: bodies at rest meet all its targets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy import spatial

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem
from lavender.suite.build import (
    Bodies,
    Contacts,
    add_horizontal_velocity,
    guess_static_loads,
    map_scalar,
    place_corner_contacts,
)
from lavender.suite.case import Draft
from lavender.suite.families import BOX, ROD, SPHERE, check_min_sizes, compute_ball_joint_jacobian

__all__ = ["STRUCTURES", "wild"]

MASSES = ("equal", "uniform", "spectrum", "two classes", "one heavy")
LAWS = ("none", "coulomb", "cone", "box")
FORMS = ("rows", "csr", "dense", "asymmetric", "generalized")
LARGEST_DENSE = 1_500  # rows of a dense matrix: 18 MB


def tenfold(exponent: FloatArray) -> FloatArray:
    """Return 10 to the power of every number, with the same bits on every processor."""
    return map_scalar(partial(pow, 10.0), exponent)


@dataclass
class World:
    """Bodies at `position` (n, 3) [m], what they touch, and what joins them; -1 is the ground."""

    position: FloatArray
    inertia: float  # of a unit mass [m^2]
    touch: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int32))  # (c, 2)
    point: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (c, 3) m
    normal: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (c, 3)
    joint: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int32))  # (k, 2)
    anchor: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))  # (k, 3) m

    def add(self, contacts: Contacts) -> World:
        """With these contacts besides."""
        self.touch = np.concatenate([self.touch, contacts.body])
        self.point = np.concatenate([self.point, contacts.point])
        self.normal = np.concatenate([self.normal, contacts.normal])
        return self


Structure = Callable[
    [np.random.Generator, int], World
]  # (generator, rows wanted without friction) -> World


def lattice(rng: np.random.Generator, rows: int) -> World:
    """Spheres on a square or cubic lattice, each touching its neighbours and the floor; perhaps some left out."""
    flat = bool(rng.random() < 0.4)
    per_body = 2.0 if flat else 3.0
    side = max(2, round((rows / per_body) ** (1 / 2 if flat else 1 / 3)))
    shape = (side, 1, side) if flat else (side, side, side)
    grid = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    if rng.random() < 0.5:
        grid = grid[rng.random(len(grid)) < 0.9]
    position = (
        grid + np.array([0.0, 0.0, 0.5]) + rng.choice([0.0, 0.02]) * rng.standard_normal(grid.shape)
    )
    pairs = spatial.cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    return (
        World(position, SPHERE)
        .add(between(position, pairs))
        .add(on_floor(position, grid[:, 2] == 0))
    )


def heap(rng: np.random.Generator, rows: int) -> World:
    """Points thrown into a box, each touching those within reach; normals a little off the line of centres."""
    n = max(2, rows // 4)
    side = max(1.0, n ** (1 / 3))
    position = rng.uniform(0.0, side, (n, 3))
    reach = side * (9.0 / (4.0 * n)) ** (1 / 3)  # some five neighbours
    pairs = spatial.cKDTree(position).query_pairs(reach, output_type="ndarray")
    contacts = between(position, pairs[np.lexsort(pairs.T[::-1])] if len(pairs) else pairs)
    contacts.normal += 0.2 * rng.standard_normal(contacts.normal.shape)
    contacts.normal /= np.linalg.norm(contacts.normal, axis=1, keepdims=True)
    low = position[:, 2] <= np.partition(position[:, 2], n // 5)[n // 5]
    return World(position, SPHERE).add(contacts).add(on_floor(position, low))


def towers(rng: np.random.Generator, rows: int) -> World:
    """Towers of unequal height, of spheres or of boxes on four points."""
    boxes = bool(rng.random() < 0.6)
    total = max(1, rows // (4 if boxes else 1))
    tall = int(rng.integers(1, max(2, min(total, 60)) + 1))
    height = np.minimum(rng.integers(max(1, tall // 2), tall + 1, max(1, total // tall)), tall)
    tower = np.repeat(np.arange(len(height)), height)
    first = np.concatenate([[0], np.cumsum(height)])[:-1]
    level = np.arange(len(tower)) - first[tower]
    position = np.stack([3.0 * tower, 0.0 * tower, 0.5 + level], 1)
    k = np.arange(len(tower))
    pairs = np.stack([np.where(level == 0, -1, k - 1), k], 1)
    foot = position - np.array([0.0, 0.0, 0.5])
    if boxes:
        return World(position, BOX).add(place_corner_contacts(pairs, foot, 0.5))
    return World(position, SPHERE).add(Contacts(pairs, foot, [0.0, 0.0, 1.0]))


def wall(rng: np.random.Generator, rows: int) -> World:
    """Draw a running bond: each brick on two below, four points a pair; ends overhang."""
    high = max(2, round(np.sqrt(rows / 16)))
    wide = max(2, rows // (8 * high))
    row, column = (x.ravel() for x in np.meshgrid(np.arange(high), np.arange(wide), indexing="ij"))
    x = 1.05 * column + 0.5 * (row % 2)
    position = np.stack([x, 0.0 * x, 0.5 + row], 1)
    index = np.arange(high * wide)
    pairs = [np.stack([np.full(wide, -1), index[:wide]], 1)]
    centre = [position[:wide] - [0.0, 0.0, 0.5]]
    half = [np.full(wide, 0.5)]
    upper = index[wide:]
    for shift in (-1, 1):
        below = (
            upper
            - wide
            + np.where((row[upper] % 2 == 1) == (shift == 1), max(0, shift), min(0, shift))
        )
        at = column[upper] + below - (upper - wide)
        ok = (at >= 0) & (at < wide)
        a, b = below[ok], upper[ok]
        gap = np.abs(x[a] - x[b])
        ok2 = gap < 0.95
        a, b, gap = a[ok2], b[ok2], gap[ok2]
        pairs.append(np.stack([a, b], 1))
        centre.append(np.stack([0.5 * (x[a] + x[b]), 0.0 * gap, row[b].astype(float)], 1))
        half.append(0.5 * (1.0 - gap))
    pair, where = np.unique(np.concatenate(pairs), axis=0, return_index=True)
    return World(position, BOX).add(
        place_corner_contacts(pair, np.concatenate(centre)[where], np.concatenate(half)[where])
    )


def tree(rng: np.random.Generator, rows: int) -> World:
    """Draw a random tree of ball joints hung from the ceiling; perhaps some of its bodies lie on the floor."""
    n = max(2, rows // 3)
    parent = np.array(
        [-1, *(int(rng.integers(max(0, i - int(rng.integers(1, 9))), i)) for i in range(1, n))]
    )
    world = _joined(rng, parent, BOX)
    return world.add(on_floor(world.position, rng.random(n) < 0.3)) if rng.random() < 0.5 else world


def net(rng: np.random.Generator, rows: int) -> World:
    """Draw a net of ball joints, held at its corners: loops, so rows that depend on each other."""
    side = max(2, round(np.sqrt(rows / 6)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2)
    sag = 0.3 * map_scalar(math.sin, np.pi * grid / (side - 1)).prod(axis=1)
    position = np.stack([grid[:, 0], grid[:, 1], 1.0 - sag], 1) + 1e-3 * rng.standard_normal(
        (side * side, 3)
    )
    pairs = spatial.cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    corner = np.array([0, side - 1, side * (side - 1), side * side - 1])
    joint = np.concatenate([np.stack([np.full(4, -1), corner], 1), pairs])
    anchor = np.concatenate(
        [position[corner], 0.5 * (position[pairs[:, 0]] + position[pairs[:, 1]])]
    )
    return World(position, BOX, joint=joint, anchor=anchor)


def ragdolls(rng: np.random.Generator, rows: int) -> World:
    """Draw a crowd of small trees of ball joints, some limbs on the floor, some touching the next one's."""
    size = int(rng.integers(5, 16))
    count = max(1, rows // (3 * size + size // 2))
    body = np.array([-1, *(int(rng.integers(max(0, i - 4), i)) for i in range(1, size))])
    parent = np.concatenate([np.where(body < 0, -2, body + size * i) for i in range(count)])
    world = _joined(rng, parent, BOX)
    world.position[:, 0] += 2.0 * np.repeat(np.arange(count), size)
    world.anchor[:, 0] += 2.0 * (world.joint[:, 1] // size)
    n = len(parent)
    world.add(on_floor(world.position, rng.random(n) < 0.4))
    if count > 1:
        a = np.arange(count - 1) * size + rng.integers(0, size, count - 1)
        b = np.arange(1, count) * size + rng.integers(0, size, count - 1)
        world.add(between(world.position, np.stack([a, b], 1)))
    return world


def snake(rng: np.random.Generator, rows: int) -> World:
    """Draw a chain of rods along the floor, each end of it on the floor or not."""
    n = max(2, rows // 4)
    k = np.arange(n)
    position = np.stack(
        [1.0 * k, 0.3 * map_scalar(math.sin, 0.3 * k), np.full(n, 0.1)], 1
    ) + 0.01 * rng.standard_normal((n, 3))
    joint = np.stack([k[:-1], k[1:]], 1)
    world = World(position, ROD, joint=joint, anchor=0.5 * (position[:-1] + position[1:]))
    return world.add(on_floor(position, rng.random(n) < 0.8))


def anvil(rng: np.random.Generator, rows: int) -> World:
    """One body on many small ones, which stand on the floor: the load spreads at once."""
    n = max(1, rows // 2)
    foot = np.concatenate([rng.uniform(-1.0, 1.0, (n, 2)) * np.sqrt(n), np.full((n, 1), 0.5)], 1)
    position = np.concatenate([foot, [[0.0, 0.0, 2.0]]])
    k = np.arange(n)
    top = Contacts(
        np.stack([k, np.full(n, n)], 1), foot + np.array([0.0, 0.0, 0.5]), [0.0, 0.0, 1.0]
    )
    return World(position, SPHERE).add(on_floor(position, np.arange(n + 1) < n)).add(top)


STRUCTURES: dict[str, Structure] = {
    f.__name__: f for f in (lattice, heap, towers, wall, tree, net, ragdolls, snake, anvil)
}


def wild(seed: int = 0, rows: int = 3000) -> Draft:
    """Draw a problem by `seed`: structure, masses, law and form, of some 8 to `rows` rows, even in the logarithm."""
    check_min_sizes(8, rows=rows)
    rng = np.random.default_rng([seed, 0x77696C64])
    name = str(rng.choice(list(STRUCTURES)))
    law, masses, form = (str(rng.choice(words)) for words in (LAWS, MASSES, FORMS))
    wanted = 8.0 * (rows / 8.0) ** rng.random()
    world = STRUCTURES[name](rng, max(2, round(wanted / (1 if law == "none" else 3))))
    bodies = bodies_of(rng, world, masses, seed)
    problem, form = given_as(rng, problem_of(rng, world, bodies, law), form)
    title = f"wild(seed={seed}, rows={rows})"
    return make_draft(problem, title, f"{name}, masses {masses}, friction {law}", form)


def bodies_of(rng: np.random.Generator, world: World, masses: str, seed: int) -> Bodies:
    """Draw the masses and velocities of a world's bodies."""
    bodies = Bodies(world.position, masses_of(rng, masses, len(world.position)), world.inertia)
    bodies.v_free += rng.choice([0.0, 1e-3, 0.05]) * rng.standard_normal(bodies.v_free.shape)
    add_horizontal_velocity(bodies, float(rng.choice([0.0, 0.0, 0.2, 1.0])), seed=seed)
    return bodies


def make_draft(problem: Problem, title: str, what: str, form: str) -> Draft:
    """Name a drawn problem and describe it."""
    problem = replace(problem, name=title, copy=False)
    return Draft(problem, f"{what}, given as {form}: drawn, not chosen")


def given_as(rng: np.random.Generator, problem: Problem, form: str) -> tuple[Problem, str]:
    """Return the problem in that form, or the one nearest to it that it can have; and which that is."""
    if form == "dense" and problem.m > LARGEST_DENSE:
        form = "csr"
    if form == "generalized" and problem.rows is None:
        form = "csr"  # friction in a box was given as a matrix
    if form == "generalized":
        return _as_generalized(problem), form
    return (problem if form == "rows" else _as_matrix(rng, problem, form)), form


def problem_of(
    rng: np.random.Generator, world: World, bodies: Bodies, law: str, soft: float | None = None
) -> Problem:
    """Contacts and joints of a world under a law; `soft`: compliance beside 1/mass, one problem of five has one."""
    contacts = Contacts(world.touch, world.point, world.normal)
    joints = len(world.joint)
    made = bodies.make_rows(
        contacts,
        jac=compute_ball_joint_jacobian(bodies.position, world.joint, world.anchor),
        joint_ptr=np.arange(0, 3 * joints + 1, 3, dtype=np.int32),
        joint_body=np.asarray(world.joint, np.int32),
    )
    compliance = 0.0 if soft is None else soft / float(np.median(bodies.mass))
    if soft is None and rng.random() < 0.2:
        compliance = 10.0 ** rng.uniform(-6.0, -2.0) / float(np.median(bodies.mass))
    if law == "none":
        m = 3 * joints + len(contacts.body)
        return Problem.from_rows(made, compliance=np.full(m, compliance))
    count = len(contacts.body)
    mu = (
        np.full(count, rng.uniform(0.05, 1.2))
        if rng.random() < 0.5
        else rng.uniform(0.0, 1.0, count)
    )
    friction = "cone" if law == "cone" else "coulomb"
    m = 3 * (joints + count)
    problem = Problem.from_rows(
        made, mu=mu, tangents=2, friction=friction, compliance=np.full(m, compliance)
    )
    if law != "box" or not count:
        return problem
    return problem.boxed(guess_static_loads(bodies, contacts))


def _as_matrix(rng: np.random.Generator, problem: Problem, form: str) -> Problem:
    a = sp.csr_array(problem.delassus())
    if form == "asymmetric":
        a = a.copy()
        off = np.repeat(np.arange(a.shape[0]), np.diff(a.indptr)) != a.indices
        size = 10.0 ** rng.uniform(-5.0, math.log10(2e-3))
        a.data[off] *= 1.0 + size * rng.uniform(-1.0, 1.0, int(off.sum()))
    matrix = a.toarray() if form == "dense" else a
    return Problem(problem.b, problem.cones, matrix=matrix, friction=problem.friction)


def _as_generalized(problem: Problem) -> Problem:
    """J and M, one block of six velocities for each body; of three for point masses, which do not turn."""
    rows = problem.rows
    assert rows is not None
    size = 6 if rows.inv_inertia.any() else 3
    mass = np.zeros((rows.n_bodies, size, size))
    mass[:, [0, 1, 2], [0, 1, 2]] = (1.0 / rows.inv_mass)[:, None]
    jac = rows.jacobian(problem.cones)
    v_free = rows.v_free
    if size == 6:
        mass[:, 3:, 3:] = np.linalg.inv(rows.inv_inertia)
    else:
        jac = jac[:, (6 * np.arange(rows.n_bodies)[:, None] + np.arange(3)).ravel()]
        v_free = np.ascontiguousarray(v_free[:, :3])
    return Problem.from_jacobian(
        jac,
        list(mass),
        v_free.ravel(),
        cones=problem.cones,
        compliance=problem.compliance,
        friction=problem.friction,
    )


def masses_of(rng: np.random.Generator, word: str, n: int) -> FloatArray:
    if word == "uniform":
        return rng.uniform(0.5, 2.0, n)
    if word == "spectrum":
        return tenfold(rng.uniform(-0.5, 0.5, n) * rng.uniform(2.0, 8.0))
    if word == "two classes":
        return np.where(rng.random(n) < rng.uniform(0.1, 0.9), 1.0, 10.0 ** rng.uniform(1.0, 5.0))
    mass = np.ones(n)
    if word == "one heavy":
        mass[-1] = 10.0 ** rng.uniform(2.0, 8.0)
    return mass


def between(position: FloatArray, pairs: np.ndarray) -> Contacts:
    """Contacts half way between bodies, along the line of their centres, upwards where that has a meaning."""
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    a, b = pairs.T
    swap = position[a, 2] > position[b, 2]
    a, b = np.where(swap, b, a), np.where(swap, a, b)
    away = position[b] - position[a]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return Contacts(np.stack([a, b], 1), 0.5 * (position[a] + position[b]), away)


def on_floor(position: FloatArray, which: np.ndarray) -> Contacts:
    """One contact with the floor right below each of those bodies."""
    k = np.flatnonzero(which)
    return Contacts(
        np.stack([np.full(len(k), -1), k], 1), position[k] - [0.0, 0.0, 0.5], [0.0, 0.0, 1.0]
    )


def _joined(rng: np.random.Generator, parent: np.ndarray, inertia: float) -> World:
    """Bodies joined to their parents by ball joints; parent -1 is the ceiling, -2 nothing."""
    position = np.zeros((len(parent), 3))
    step = rng.standard_normal((len(parent), 3))
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    for i, p in enumerate(parent):
        position[i] = (position[p] if p >= 0 else np.zeros(3)) + step[i]
    held = parent >= -1
    joint = np.stack([parent[held], np.flatnonzero(held)], 1)
    return World(position, inertia, joint=joint, anchor=position[held] - 0.5 * step[held])
