"""Problems of structures unlike those of `wild`, half of them for judging `auto` alone.

    worlds     table (one body under everything), dome, packing (crowded), scattered (nearly empty), loops (closed
               chains on the floor), cloth (point masses), jelly (soft rows), gripper (many contacts on few bodies)
    matrices   obstacle (an M-matrix), network (flow with capacities), lowrank and boxed (dense), skew (asymmetric),
               hand (many contacts on few velocities)

Which structures are for judging was drawn by lot, below, before anything was measured on them: rates and rules are
tuned on the others and on `wild`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from benchmarks.drawn.wild import (
    FORMS,
    LARGEST_DENSE,
    LAWS,
    MASSES,
    Structure,
    World,
    between,
    given_as,
    masses_of,
    on_floor,
    problem_of,
)
from lavender.cones import Cones
from lavender.errors import UnknownName
from lavender.problem import Problem
from lavender.suite.build import Bodies, Contacts, manifold, sideways
from lavender.suite.case import Draft, family
from lavender.suite.families import BOX, ROD, SPHERE, at_least

__all__ = ["JUDGED", "TUNED", "drawn", "foreign"]

PART = ("all", "tuned", "judged")
Matrix = Callable[[np.random.Generator, int], Problem]  # (generator, rows wanted) -> Problem
UP = [0.0, 0.0, 1.0]


# -- bodies ---------------------------------------------------------------------------------------


def table(rng: np.random.Generator, rows: int) -> World:
    """Stacks of boxes on one plate, which stands on three feet."""
    count = max(1, rows // 4)
    tall = int(rng.integers(1, 5))
    k = np.arange(count)
    level = k % tall
    place = (k // tall).astype(float)
    position = np.stack([2.0 * place, np.sin(place), 1.5 + level], 1)
    plate = np.array([[position[:, 0].mean(), 0.0, 0.9]])
    below = np.where(level == 0, count, k - 1)
    world = World(np.concatenate([position, plate]), BOX)
    world.add(manifold(np.stack([below, k], 1), position - [0.0, 0.0, 0.5], 0.4, 0.4))
    feet = plate + np.array(
        [[-2.0 - place.max(), -1.0, -0.9], [2.0 + place.max(), -1.0, -0.9], [0.0, 2.0, -0.9]]
    )
    return world.add(Contacts(np.stack([np.full(3, -1), np.full(3, count)], 1), feet, UP))


def dome(rng: np.random.Generator, rows: int) -> World:
    """Rings of stones, each on those below and between its neighbours; the joints lean inwards."""
    around = max(5, round(np.sqrt(rows / 2.0)))
    rings = max(2, rows // (3 * around))
    ring, k = (x.ravel() for x in np.meshgrid(np.arange(rings), np.arange(around), indexing="ij"))
    up = 0.5 * np.pi * (ring + 0.5) / (rings + 1)
    turn = 2.0 * np.pi * (k + 0.5 * (ring % 2)) / around
    size = around / 6.0
    position = size * np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], 1)
    index = np.arange(rings * around)
    side = np.stack([index, around * ring + (k + 1) % around], 1)
    world = World(position, BOX).add(between(position, side))
    upper = index[around:]
    first = upper - around
    second = around * (ring[upper] - 1) + (k[upper] + np.where(ring[upper] % 2 == 1, 1, -1)) % around
    lean = np.concatenate([np.stack([first, upper], 1), np.stack([second, upper], 1)])
    world.add(between(position, lean))
    foot = np.stack([np.full(around, -1), index[:around]], 1)
    return world.add(Contacts(foot, position[:around] - [0.0, 0.0, 0.4], UP))


def packing(rng: np.random.Generator, rows: int) -> World:
    """Balls pressed together: eight neighbours and more for each, most of what they touch has nothing to carry."""
    n = max(4, rows // 6)
    side = n ** (1 / 3)
    position = rng.uniform(0.0, side, (n, 3))
    position += 0.3 * (np.round(position) - position)
    near = cKDTree(position).query(position, k=min(n, int(rng.integers(6, 11))))[1][:, 1:]
    pairs = np.sort(np.stack([np.repeat(np.arange(n), near.shape[1]), near.ravel()], 1), axis=1)
    low = position[:, 2] <= np.quantile(position[:, 2], 0.15)
    return (
        World(position, SPHERE).add(between(position, np.unique(pairs, axis=0))).add(on_floor(position, low))
    )


def scattered(rng: np.random.Generator, rows: int) -> World:
    """Single bodies, pairs and threes far from each other, most of them one touch from the ground."""
    size = rng.choice([1, 1, 1, 2, 3], max(1, rows // 2))
    first = np.repeat(np.cumsum(size) - size, size)
    k = np.arange(int(size.sum()))
    level = k - first
    position = np.stack([5.0 * np.repeat(np.arange(len(size)), size), 0.2 * level, 0.5 + level], 1)
    pairs = np.stack([np.where(level == 0, -1, k - 1), k], 1)
    return World(position, SPHERE).add(Contacts(pairs, position - [0.0, 0.0, 0.5], UP))


def loops(rng: np.random.Generator, rows: int) -> World:
    """Closed chains of four to nine rods, most of whose joints rest on the floor or on the next chain."""
    size = int(rng.integers(4, 10))
    count = max(1, rows // (3 * size + size // 2 + 1))
    k = np.arange(count * size)
    turn = 2.0 * np.pi * (k % size) / size
    centre = 2.2 * (k // size)
    position = np.stack([centre + np.cos(turn), np.sin(turn), 0.5 + 0.3 * (k // size % 2)], 1)
    joint = np.stack([k, size * (k // size) + (k + 1) % size], 1)
    world = World(position, ROD, joint=joint, anchor=0.5 * (position[joint[:, 0]] + position[joint[:, 1]]))
    world.add(on_floor(position, rng.random(len(k)) < 0.4))
    if count > 1:
        a = np.arange(count - 1) * size
        world.add(between(position, np.stack([a, a + size + size // 2], 1)))
    return world


def cloth(rng: np.random.Generator, rows: int) -> World:
    """Point masses on a square, each held by threads to its neighbours, sunk onto points of a ball under it."""
    side = max(3, round(np.sqrt(rows / 3.0)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2)
    off = (grid - 0.5 * (side - 1)) / (0.5 * side)
    height = 2.0 - (off**2).sum(axis=1)
    position = np.stack([grid[:, 0], grid[:, 1], height], 1) + 0.01 * rng.standard_normal((side * side, 3))
    pairs = cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    world = World(position, 0.0).add(between(position, pairs))
    under = np.flatnonzero((off**2).sum(axis=1) < 0.6)
    normal = np.stack([0.4 * off[under, 0], 0.4 * off[under, 1], np.ones(len(under))], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return world.add(Contacts(np.stack([np.full(len(under), -1), under], 1), position[under], normal))


def jelly(rng: np.random.Generator, rows: int) -> World:
    """A block of points joined to their neighbours, half of the lowest on the floor; `foreign` softens its rows."""
    side = max(2, round((rows / 9.0) ** (1 / 3)))
    grid = np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"), -1).reshape(-1, 3)
    position = grid + 0.05 * rng.standard_normal(grid.shape)
    pairs = cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    anchor = 0.5 * (position[pairs[:, 0]] + position[pairs[:, 1]])
    world = World(position, SPHERE, joint=pairs, anchor=anchor)
    return world.add(on_floor(position, (grid[:, 2] == 0) & (rng.random(len(grid)) < 0.5)))


def gripper(rng: np.random.Generator, rows: int) -> World:
    """Three to nine bodies that touch each other and the floor in so many points that few of them are needed."""
    n = int(rng.integers(3, 10))
    position = np.stack([np.arange(n), 0.3 * np.arange(n) % 2, np.full(n, 0.5)], 1)
    a = rng.integers(-1, n - 1, max(n, rows))
    b = np.where(a < 0, rng.integers(0, n, len(a)), a + 1)
    normal = np.where(a[:, None] < 0, UP, [1.0, 0.0, 0.2]) + 0.2 * rng.standard_normal((len(a), 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = position[b] + 0.4 * rng.uniform(-1.0, 1.0, (len(a), 3)) - 0.5 * normal
    return World(position, BOX).add(Contacts(np.stack([a, b], 1), point, normal))


# -- matrices -------------------------------------------------------------------------------------


def obstacle(rng: np.random.Generator, rows: int) -> Problem:
    """A membrane on a grid that hangs onto an obstacle: the five-point matrix, an M-matrix."""
    side = max(2, round(np.sqrt(rows)))
    line = sp.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(side, side))
    eye = sp.eye_array(side)
    a = sp.csr_array(
        sp.kron(line, eye) + sp.kron(eye, line) + 10.0 ** rng.uniform(-6, -1) * sp.eye_array(side * side)
    )
    x, y = (v.ravel() / side for v in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    force = rng.standard_normal() + 3.0 * np.sin(2.0 * np.pi * x * rng.integers(1, 4)) * np.cos(
        3.0 * np.pi * y
    )
    return Problem.lcp(a, force / side)


def network(rng: np.random.Generator, rows: int) -> Problem:
    """Flow along the edges of a random graph between capacities: rows are edges, coupled where they meet."""
    n = max(3, rows // 3)
    tail, head = rng.integers(0, n, rows), rng.integers(1, n, rows)
    head = (tail + head) % n
    k = np.arange(rows)
    ends = (
        np.concatenate([np.ones(rows), -np.ones(rows)]),
        (np.concatenate([k, k]), np.concatenate([tail, head])),
    )
    incidence = sp.csr_array(ends, shape=(rows, n))
    a = sp.csr_array(incidence @ incidence.T + sp.diags_array(10.0 ** rng.uniform(-4, 0, rows)))
    room = rng.exponential(1.0, rows)
    return Problem.lcp(a, incidence @ rng.standard_normal(n), -room * (rng.random(rows) < 0.5), room)


def lowrank(rng: np.random.Generator, rows: int) -> Problem:
    """A diagonal and a few dense columns, as factor models have: full, with few large eigenvalues."""
    m = min(rows, LARGEST_DENSE)
    u = rng.standard_normal((m, int(rng.integers(2, max(3, m // 8) + 1))))
    a = u @ u.T + np.diag(10.0 ** rng.uniform(-3, 1, m))
    return Problem.lcp(a, rng.standard_normal(m), 0.0, rng.choice([np.inf, 1.0]))


def boxed(rng: np.random.Generator, rows: int) -> Problem:
    """A dense matrix of given condition between bounds on both sides; some rows are free."""
    m = min(rows, LARGEST_DENSE // 2)
    q = np.linalg.qr(rng.standard_normal((m, m)))[0]
    a = (q * 10.0 ** np.linspace(0.0, rng.uniform(1, 7), m)) @ q.T
    width = rng.exponential(1.0, m)
    free = rng.random(m) < 0.1
    b = a @ rng.standard_normal(m)
    return Problem.lcp(0.5 * (a + a.T), b, np.where(free, -np.inf, -width), np.where(free, np.inf, width))


def skew(rng: np.random.Generator, rows: int) -> Problem:
    """A monotone matrix with a skew part as large as the rest: saddle points of games; dense or with few entries."""
    m = max(4, rows // 2 * 2)
    share = 1.0 if m < 200 and rng.random() < 0.5 else min(1.0, 6.0 / m)
    k = sp.random_array((m, m), density=share, rng=rng, data_sampler=lambda size: rng.standard_normal(size))
    own = 10.0 ** rng.uniform(-2.0, 0.5)
    g = sp.random_array((m, m), density=share, rng=rng, data_sampler=lambda size: rng.standard_normal(size))
    a = sp.csr_array(
        g @ g.T / max(1.0, share * m) + own * sp.eye_array(m) + (k - k.T) * rng.uniform(0.1, 1.0)
    )
    return Problem.lcp(a if share < 1.0 else a.toarray(), rng.standard_normal(m))


def hand(rng: np.random.Generator, rows: int) -> Problem:
    """Contacts of a hand with an object: each moves along a few of 6 to 30 velocities, whose masses differ."""
    nv = int(rng.integers(6, 31))
    friction = str(rng.choice(["coulomb", "cone", "none"]))
    count = max(1, rows // (1 if friction == "none" else 3))
    size = 1 if friction == "none" else 3
    keep = rng.random((count, 1, nv)) < rng.uniform(0.2, 0.8)
    jac = (keep * rng.standard_normal((count, size, nv))).reshape(-1, nv)
    root = rng.standard_normal((nv, nv)) / np.sqrt(nv)
    scale = 10.0 ** rng.uniform(-1.5, 1.5, nv)
    mass = scale[:, None] * (root @ root.T + 0.1 * np.eye(nv)) * scale
    v_free = rng.standard_normal(nv) / scale
    soft = float(rng.choice([0.0, 1e-4])) * np.einsum("ij,ij->i", jac, np.linalg.solve(mass, jac.T).T).mean()
    if friction == "none":
        cones = Cones.bounded(np.zeros(count), np.full(count, np.inf))
    else:
        cones = Cones.contacts(rng.uniform(0.2, 1.0, count))
    law = "cone" if friction == "cone" else "coulomb"
    return Problem.from_jacobian(
        jac, mass, v_free, cones=cones, compliance=np.full(len(jac), soft), friction=law
    )


WORLDS: dict[str, Structure] = {
    f.__name__: f for f in (table, dome, packing, scattered, loops, cloth, jelly, gripper)
}
MATRICES: dict[str, Matrix] = {f.__name__: f for f in (obstacle, network, lowrank, boxed, skew, hand)}
STRUCTURES = (*WORLDS, *MATRICES)
# The lot: half of the worlds and half of the matrices, by a generator whose seed is the day of the drawing.
_LOT = np.random.default_rng(20261121)
JUDGED = frozenset(
    [*map(str, _LOT.permutation(list(WORLDS))[:4]), *map(str, _LOT.permutation(list(MATRICES))[:3])]
)
TUNED = frozenset(STRUCTURES) - JUDGED


@family(foreign_tuned={"part": "tuned"}, foreign_judged={"part": "judged"})
def foreign(seed: int = 0, rows: int = 3000, part: str = "all") -> Draft:
    """A problem drawn by `seed` of a structure that `wild` has not; `part`: all, tuned or judged structures."""
    at_least(8, rows=rows)
    if part not in PART:
        raise UnknownName("part", part, PART)
    rng = np.random.default_rng([seed, 0x666F7265])
    return drawn(
        rng, seed, rows, [n for n in STRUCTURES if part == "all" or (n in JUDGED) == (part == "judged")]
    )


def drawn(
    rng: np.random.Generator,
    seed: int,
    rows: int,
    names: list[str],
    worlds: Mapping[str, Structure] = WORLDS,
    matrices: Mapping[str, Matrix] = MATRICES,
) -> Draft:
    """A problem of one of these structures, of some 8 to `rows` rows, even in the logarithm."""
    name = str(rng.choice(names))
    wanted = 8.0 * (rows / 8.0) ** rng.random()
    if name in matrices:
        problem = matrices[name](rng, max(4, round(wanted)))
        return Draft(problem, f"{name}, {problem.law}, given as {problem.operator}: drawn, not chosen")
    law, masses, form = (str(rng.choice(words)) for words in (LAWS, MASSES, FORMS))
    world = worlds[name](rng, max(2, round(wanted / (1 if law == "none" else 3))))
    bodies = Bodies(world.position, masses_of(rng, masses, len(world.position)), world.inertia)
    bodies.v_free += rng.choice([0.0, 1e-3, 0.05]) * rng.standard_normal(bodies.v_free.shape)
    sideways(bodies, float(rng.choice([0.0, 0.0, 0.2, 1.0])), seed=seed)
    soft: float | None = None
    if name == "jelly":
        soft = 10.0 ** rng.uniform(-4.0, 1.0)
    problem, form = given_as(rng, problem_of(rng, world, bodies, law, soft), form)
    return Draft(problem, f"{name}, masses {masses}, friction {law}, given as {form}: drawn, not chosen")
