"""Problems of structures that `wild` has not, half of them for judging `auto` alone.

    worlds     dome, packing (crowded), scattered (nearly empty), cloth (point masses), jelly (soft rows), gripper (many
               contacts on few bodies), pegs (balls held between fixed points), silo (walls on every side)
    matrices   obstacle (an M-matrix), network (flow with capacities), boxed (dense), skew (asymmetric), hand (many
               contacts on few velocities), option (convection and diffusion), kernel (dual of a classifier),
               deblur (a convolution, nearly singular), beam (fourth differences)

Which structures are for judging was drawn by lot, below: rates and lines of the tree are tuned on the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import spatial

from benchmarks.random_families.wild import (
    FORMS,
    LARGEST_DENSE,
    LAWS,
    MASSES,
    Structure,
    World,
    between,
    bodies_of,
    given_as,
    make_draft,
    on_floor,
    problem_of,
    tenfold,
)
from lavender.base.errors import check_name
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.suite.build import Contacts, map_scalar
from lavender.suite.case import Draft
from lavender.suite.families import BOX, SPHERE, check_min_sizes

__all__ = ["JUDGED", "TUNED", "drawn"]

PART = ("all", "tuned", "judged", "rolling")
Matrix = Callable[[np.random.Generator, int], Problem]  # (generator, rows wanted) -> Problem
UP = [0.0, 0.0, 1.0]


def dome(rng: np.random.Generator, rows: int) -> World:
    """Rings of stones, each on those below and between its neighbours; the joints lean inwards."""
    around = max(5, round(np.sqrt(rows / 2.0)))
    rings = max(2, rows // (3 * around))
    ring, k = (x.ravel() for x in np.meshgrid(np.arange(rings), np.arange(around), indexing="ij"))
    up = 0.5 * np.pi * (ring + 0.5) / (rings + 1)
    turn = 2.0 * np.pi * (k + 0.5 * (ring % 2)) / around
    size = around / 6.0
    high, far = map_scalar(math.sin, up), map_scalar(math.cos, up)
    position = size * np.stack(
        [far * map_scalar(math.cos, turn), far * map_scalar(math.sin, turn), high], 1
    )
    index = np.arange(rings * around)
    side = np.stack([index, around * ring + (k + 1) % around], 1)
    world = World(position, BOX).add(between(position, side))
    upper = index[around:]
    first = upper - around
    second = (
        around * (ring[upper] - 1) + (k[upper] + np.where(ring[upper] % 2 == 1, 1, -1)) % around
    )
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
    near = spatial.cKDTree(position).query(position, k=min(n, int(rng.integers(6, 11))))[1][:, 1:]
    pairs = np.sort(np.stack([np.repeat(np.arange(n), near.shape[1]), near.ravel()], 1), axis=1)
    low = position[:, 2] <= np.quantile(position[:, 2], 0.15)
    return (
        World(position, SPHERE)
        .add(between(position, np.unique(pairs, axis=0)))
        .add(on_floor(position, low))
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


def cloth(rng: np.random.Generator, rows: int) -> World:
    """Point masses on a square, each held by threads to its neighbours, sunk onto points of a ball under it."""
    side = max(3, round(np.sqrt(rows / 3.0)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2)
    off = (grid - 0.5 * (side - 1)) / (0.5 * side)
    height = 2.0 - (off**2).sum(axis=1)
    position = np.stack([grid[:, 0], grid[:, 1], height], 1) + 0.01 * rng.standard_normal(
        (side * side, 3)
    )
    pairs = spatial.cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    world = World(position, 0.0).add(between(position, pairs))
    under = np.flatnonzero((off**2).sum(axis=1) < 0.6)
    normal = np.stack([0.4 * off[under, 0], 0.4 * off[under, 1], np.ones(len(under))], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return world.add(
        Contacts(np.stack([np.full(len(under), -1), under], 1), position[under], normal)
    )


def jelly(rng: np.random.Generator, rows: int) -> World:
    """Draw a block of joined points, half of the lowest on the floor; `foreign` softens its rows."""
    side = max(2, round((rows / 9.0) ** (1 / 3)))
    grid = np.stack(np.meshgrid(*3 * [np.arange(side)], indexing="ij"), -1).reshape(-1, 3)
    position = grid + 0.05 * rng.standard_normal(grid.shape)
    pairs = spatial.cKDTree(grid).query_pairs(1.01, output_type="ndarray")
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


def pegs(rng: np.random.Generator, rows: int) -> World:
    """Balls between fixed pegs, two to five touching each from any side, the next ball here and there."""
    n = max(2, rows // 4)
    side = max(1, round(np.sqrt(n)))
    k = np.arange(n)
    position = np.stack([1.1 * (k % side), 0.0 * k, 1.1 * (k // side) + 0.5], 1)
    count = rng.integers(2, 6, n)
    ball = np.repeat(k, count)
    normal = rng.standard_normal((len(ball), 3))
    normal[:, 2] = np.abs(normal[:, 2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    held = Contacts(
        np.stack([np.full(len(ball), -1), ball], 1), position[ball] - 0.5 * normal, normal
    )
    pairs = spatial.cKDTree(position).query_pairs(1.2, output_type="ndarray")
    some = pairs[np.lexsort(pairs.T[::-1])][: n // 2] if len(pairs) else pairs
    return World(position, SPHERE).add(held).add(between(position, some))


def silo(rng: np.random.Generator, rows: int) -> World:
    """Draw a narrow column of balls between upright walls, two to five wide: walls carry what friction gives them."""
    wide = int(rng.integers(2, 6))
    high = max(1, round(rows / (4.0 * wide * wide)))
    grid = np.stack(np.meshgrid(*map(np.arange, (high, wide, wide)), indexing="ij"), -1).reshape(
        -1, 3
    )[:, ::-1]
    position = grid + [0.0, 0.0, 0.5] + 0.05 * rng.standard_normal(grid.shape)
    pairs = spatial.cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    world = World(position, SPHERE).add(between(position, pairs[np.lexsort(pairs.T[::-1])]))
    world.add(on_floor(position, grid[:, 2] == 0))
    for axis in (0, 1):
        for side, inwards in ((0, 1.0), (wide - 1, -1.0)):
            at = np.flatnonzero(grid[:, axis] == side)
            normal = inwards * np.eye(3)[axis]
            world.add(
                Contacts(
                    np.stack([np.full(len(at), -1), at], 1), position[at] - 0.5 * normal, normal
                )
            )
    return world


def obstacle(rng: np.random.Generator, rows: int) -> Problem:
    """Draw a membrane on a grid that hangs onto an obstacle: the five-point matrix, an M-matrix."""
    side = max(2, round(np.sqrt(rows)))
    line = sp.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(side, side))
    eye = sp.eye_array(side)
    a = sp.csr_array(
        sp.kron(line, eye)
        + sp.kron(eye, line)
        + 10.0 ** rng.uniform(-6, -1) * sp.eye_array(side * side)
    )
    x, y = (v.ravel() / side for v in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    force = rng.standard_normal() + 3.0 * map_scalar(
        math.sin, 2.0 * np.pi * x * rng.integers(1, 4)
    ) * map_scalar(math.cos, 3.0 * np.pi * y)
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
    a = sp.csr_array(incidence @ incidence.T + sp.diags_array(tenfold(rng.uniform(-4, 0, rows))))
    room = rng.exponential(1.0, rows)
    return Problem.lcp(
        a, incidence @ rng.standard_normal(n), -room * (rng.random(rows) < 0.5), room
    )


def boxed(rng: np.random.Generator, rows: int) -> Problem:
    """Draw a dense matrix of given condition between bounds on both sides; some rows are free."""
    m = min(rows, LARGEST_DENSE // 2)
    q = np.linalg.qr(rng.standard_normal((m, m)))[0]
    a = (q * tenfold(np.linspace(0.0, rng.uniform(1, 7), m))) @ q.T
    width = rng.exponential(1.0, m)
    free = rng.random(m) < 0.1
    b = a @ rng.standard_normal(m)
    return Problem.lcp(
        0.5 * (a + a.T), b, np.where(free, -np.inf, -width), np.where(free, np.inf, width)
    )


def skew(rng: np.random.Generator, rows: int) -> Problem:
    """Draw a monotone matrix with a skew part as large as the rest (saddle points of games), dense or sparse."""
    m = max(4, rows // 2 * 2)
    share = 1.0 if m < 200 and rng.random() < 0.5 else min(1.0, 6.0 / m)
    k = sp.random_array(
        (m, m), density=share, rng=rng, data_sampler=lambda size: rng.standard_normal(size)
    )
    own = 10.0 ** rng.uniform(-2.0, 0.5)
    g = sp.random_array(
        (m, m), density=share, rng=rng, data_sampler=lambda size: rng.standard_normal(size)
    )
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
    scale = tenfold(rng.uniform(-1.5, 1.5, nv))
    mass = scale[:, None] * (root @ root.T + 0.1 * np.eye(nv)) * scale
    v_free = rng.standard_normal(nv) / scale
    soft = (
        float(rng.choice([0.0, 1e-4]))
        * np.einsum("ij,ij->i", jac, np.linalg.solve(mass, jac.T).T).mean()
    )
    if friction == "none":
        cones = Cones.bounded(np.zeros(count), np.full(count, np.inf))
    else:
        cones = Cones.contacts(rng.uniform(0.2, 1.0, count))
    law = "cone" if friction == "cone" else "coulomb"
    return Problem.from_jacobian(
        jac, mass, v_free, cones=cones, compliance=np.full(len(jac), soft), friction=law
    )


def option(rng: np.random.Generator, rows: int) -> Problem:
    """One implicit step of an American option: diffusion that grows with the price, and drift; an M-matrix."""
    m = max(4, rows)
    k = np.arange(1, m + 1)
    step = 10.0 ** rng.uniform(-3.0, 0.0)
    sigma = rng.uniform(0.1, 0.5)
    rate = rng.uniform(0.0, 0.1)
    wide = 0.5 * (sigma * k) ** 2
    drift = rate * k
    a = sp.diags_array(
        [-step * wide[1:], 1.0 + step * (2.0 * wide + drift + rate), -step * (wide + drift)[:-1]],
        offsets=[-1, 0, 1],
    )
    payoff = np.maximum(0.0, rng.uniform(0.2, 0.8) - k / m)
    held = payoff + 0.1 * map_scalar(math.exp, -(((k / m - 0.5) / 0.2) ** 2))
    return Problem.lcp(sp.csr_array(a), held - a @ payoff)


def kernel(rng: np.random.Generator, rows: int) -> Problem:
    """Dual of a classifier of points in a few dimensions, each of a weight: nearly singular, 0 <= x <= c."""
    m = min(max(4, rows), LARGEST_DENSE)
    x = rng.standard_normal((m, int(rng.integers(1, 6))))
    label = np.where(x.sum(axis=1) + 0.5 * rng.standard_normal(m) > 0.0, 1.0, -1.0)
    square = ((x[:, None] - x[None]) ** 2).sum(axis=2)
    a = label[:, None] * map_scalar(math.exp, -square * 10.0 ** rng.uniform(-1.0, 1.0)) * label
    a[np.arange(m), np.arange(m)] += 10.0 ** rng.uniform(-6.0, -1.0)
    return Problem.lcp(a, rng.uniform(0.5, 1.5, m), 0.0, 10.0 ** rng.uniform(-1.0, 2.0))


def deblur(rng: np.random.Generator, rows: int) -> Problem:
    """Draw a signal without negative values, seen through a blur of some width: K^T K, nearly singular."""
    m = min(max(8, rows), LARGEST_DENSE)
    wide = int(rng.integers(1, max(2, min(20, m // 4)) + 1))
    weight = map_scalar(math.exp, -0.5 * (np.arange(-2 * wide, 2 * wide + 1) / wide) ** 2)
    k = sp.diags_array(
        list(weight / weight.sum()), offsets=list(range(-2 * wide, 2 * wide + 1)), shape=(m, m)
    )
    k = sp.csr_array(k)
    truth = np.where(rng.random(m) < 0.2, rng.exponential(1.0, m), 0.0)
    seen = k @ truth + 0.01 * rng.standard_normal(m)
    a = sp.csr_array(k.T @ k + 10.0 ** rng.uniform(-6, -2) * sp.eye_array(m))
    return Problem.lcp(a, -(k.T @ seen), 0.0, rng.choice([np.inf, 1.0]))


def beam(rng: np.random.Generator, rows: int) -> Problem:
    """Draw a bent beam over an obstacle: fourth differences, which are no M-matrix and badly conditioned."""
    m = max(4, rows)
    second = sp.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(m, m))
    stiff = tenfold(rng.uniform(0.0, 1.0) * rng.standard_normal(m))
    a = sp.csr_array(
        second.T @ sp.diags_array(stiff) @ second + 10.0 ** rng.uniform(-6, -1) * sp.eye_array(m)
    )
    x = (np.arange(m) + 0.5) / m
    load = (
        -1.0
        + 3.0 * map_scalar(math.sin, 2.0 * np.pi * x * rng.integers(1, 5))
        + 0.3 * rng.standard_normal(m)
    )
    return Problem.lcp(0.5 * (a + a.T), load / m, 0.0, rng.choice([np.inf, 2.0]))


WORLDS: dict[str, Structure] = {
    f.__name__: f for f in (dome, packing, scattered, cloth, jelly, gripper, pegs, silo)
}
MATRICES: dict[str, Matrix] = {
    f.__name__: f for f in (obstacle, network, boxed, skew, hand, option, kernel, deblur, beam)
}
STRUCTURES = (*WORLDS, *MATRICES)
# The lot: half of the worlds and half of the matrices, by a generator whose seed is the day of the drawing.
_LOT = np.random.default_rng(20261123)
JUDGED = frozenset(
    [*map(str, _LOT.permutation(list(WORLDS))[:4]), *map(str, _LOT.permutation(list(MATRICES))[:4])]
)
TUNED = frozenset(STRUCTURES) - JUDGED


def drawn(seed: int = 0, rows: int = 3000, part: str = "all") -> Draft:
    """Draw a problem by `seed` of some 8 to `rows` rows; `part`: all, tuned or judged structures.

    Or "rolling": worlds to tune on whose contacts resist rolling, and perhaps spin.
    """
    check_min_sizes(8, rows=rows)
    check_name("part", part, PART)
    title = f"drawn(seed={seed}, rows={rows}, part={part})"
    rng = np.random.default_rng([seed, 0x647261, PART.index(part)])
    rolls = part == "rolling"
    lot = {"all": frozenset(STRUCTURES), "judged": JUDGED}.get(part, TUNED)
    name = str(rng.choice([n for n in (WORLDS if rolls else STRUCTURES) if n in lot]))
    wanted = 8.0 * (rows / 8.0) ** rng.random()
    if name in MATRICES:
        problem = MATRICES[name](rng, max(4, round(wanted)))
        return make_draft(problem, title, f"{name}, {problem.law}", problem.operator)
    law, masses, form = (str(rng.choice(words)) for words in (LAWS, MASSES, FORMS))
    world = WORLDS[name](rng, max(2, round(wanted / (5 if rolls else 1 if law == "none" else 3))))
    bodies = bodies_of(rng, world, masses, seed)
    soft = 10.0 ** rng.uniform(-4.0, 1.0) if name == "jelly" else None
    if rolls:
        law = str(rng.choice(LAWS[1:3]))
        form = "rows"
        made = problem_of(rng, world, bodies, law).rows
        assert made is not None
        more: dict[str, Any] = {
            "tangents": 2,
            "rolling": 10.0 ** rng.uniform(-3.0, -1.0),
            "friction": law,
        }
        more |= {"patch_radius": 0.02} if rng.random() < 0.5 else {}
        problem = Problem.from_rows(made, mu=rng.uniform(0.2, 0.9), **more)
    else:
        problem, form = given_as(rng, problem_of(rng, world, bodies, law, soft), form)
    return make_draft(problem, title, f"{name}, masses {masses}, friction {law}", form)
