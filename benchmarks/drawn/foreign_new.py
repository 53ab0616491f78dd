"""A second lot of structures unlike those of `wild` and `foreign`, half of them for judging `auto` alone.

    worlds     bearing (two bodies share all balls), silo (walls on every side), mikado (long rods across each other),
               dominoes (each leans on the next)
    matrices   halfspace (elastic contact, dense, 1/r), option (convection and diffusion, asymmetric), kernel (dual of a
               classifier, bounds on both sides), control (inputs over a horizon), smallworld (a graph with
               shortcuts, which fill a factor), crowd (many small robots that touch)

Which are for judging was drawn by lot, below, before anything was measured on any of them.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from benchmarks.drawn.foreign import PART, UP, Matrix, drawn
from benchmarks.drawn.wild import LARGEST_DENSE, Structure, World, between, on_floor
from lavender.cones import Cones
from lavender.errors import UnknownName
from lavender.problem import Problem
from lavender.suite.build import Contacts
from lavender.suite.case import Draft, family
from lavender.suite.families import BOX, ROD, SPHERE, at_least

__all__ = ["foreign_new"]


# -- bodies ---------------------------------------------------------------------------------------


def bearing(rng: np.random.Generator, rows: int) -> World:
    """Balls between two rings of one body each; some touch the next ball, the outer ring stands on two feet."""
    n = max(3, rows // 3)
    turn = 2.0 * np.pi * np.arange(n) / n
    out = np.stack([np.cos(turn), 0.0 * turn, np.sin(turn)], 1)
    size = n / np.pi
    position = np.concatenate([size * out, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    inner, outer, k = np.full(n, n), np.full(n, n + 1), np.arange(n)
    world = World(position, BOX).add(Contacts(np.stack([inner, k], 1), (size - 0.5) * out, out))
    world.add(Contacts(np.stack([k, outer], 1), (size + 0.5) * out, out))
    some = np.flatnonzero(rng.random(n) < 0.5)
    world.add(between(position, np.stack([some, (some + 1) % n], 1)))
    feet = np.array([[-0.5 * size, 0.0, -size - 1.0], [0.5 * size, 0.0, -size - 1.0]])
    return world.add(Contacts([[-1, n + 1], [-1, n + 1]], feet, UP))


def silo(rng: np.random.Generator, rows: int) -> World:
    """A narrow column of balls between upright walls, two to five wide: walls carry what friction gives them."""
    wide = int(rng.integers(2, 6))
    high = max(1, round(rows / (4.0 * wide * wide)))
    grid = np.stack(np.meshgrid(*map(np.arange, (high, wide, wide)), indexing="ij"), -1).reshape(-1, 3)[
        :, ::-1
    ]
    position = grid + [0.0, 0.0, 0.5] + 0.05 * rng.standard_normal(grid.shape)
    pairs = cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    world = World(position, SPHERE).add(between(position, pairs[np.lexsort(pairs.T[::-1])]))
    world.add(on_floor(position, grid[:, 2] == 0))
    for axis in (0, 1):
        for side, inwards in ((0, 1.0), (wide - 1, -1.0)):
            at = np.flatnonzero(grid[:, axis] == side)
            normal = inwards * np.eye(3)[axis]
            world.add(Contacts(np.stack([np.full(len(at), -1), at], 1), position[at] - 0.5 * normal, normal))
    return world


def mikado(rng: np.random.Generator, rows: int) -> World:
    """Long rods dropped one after the other, each on the last three that it crosses, or with its ends on the floor."""
    n = max(3, rows // 3)
    centre = rng.uniform(0.0, 1.1 * np.sqrt(n), (n, 2))
    turn = rng.uniform(0.0, np.pi, n)
    along = np.stack([np.cos(turn), np.sin(turn)], 1)
    a, b = cKDTree(centre).query_pairs(3.0, output_type="ndarray").T
    a, b = np.minimum(a, b), np.maximum(a, b)
    cross = along[a, 0] * along[b, 1] - along[a, 1] * along[b, 0]
    apart = centre[b] - centre[a]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (apart[:, 0] * along[b, 1] - apart[:, 1] * along[b, 0]) / cross
        t = (apart[:, 0] * along[a, 1] - apart[:, 1] * along[a, 0]) / cross
    hit = (np.abs(cross) > 0.1) & (np.abs(s) < 1.5) & (np.abs(t) < 1.5)
    order = np.flatnonzero(hit)[np.lexsort((-a[hit], b[hit]))]
    first = np.r_[True, b[order][1:] != b[order][:-1]]
    start = np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    kept = order[np.arange(len(order)) - start < 3]
    height = np.zeros(n)
    for i in kept[::-1][np.argsort(b[kept[::-1]], kind="stable")]:
        height[b[i]] = max(height[b[i]], height[a[i]] + 0.1)
    position = np.concatenate([centre, height[:, None] + 0.5], 1)
    point = np.concatenate(
        [
            centre[a[kept]] + s[kept, None] * along[a[kept]],
            0.5 * (position[a[kept], 2:] + position[b[kept], 2:]),
        ],
        1,
    )
    normal = np.array(UP) + 0.05 * rng.standard_normal((len(kept), 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    world = World(position, ROD).add(Contacts(np.stack([a[kept], b[kept]], 1), point, normal))
    low = np.flatnonzero(np.bincount(b[kept], minlength=n) < 2)
    for end in (-1.5, 1.5):
        foot = position[low] + np.concatenate([end * along[low], np.full((len(low), 1), -0.5)], 1)
        world.add(Contacts(np.stack([np.full(len(low), -1), low], 1), foot, UP))
    return world


def dominoes(rng: np.random.Generator, rows: int) -> World:
    """Thin upright boxes that lean on the next, two points above and two on the floor."""
    n = max(2, rows // 4)
    k = np.arange(n)
    lean = float(rng.uniform(0.1, 1.0))
    position = np.stack([lean * k, 0.2 * np.sin(0.1 * k), np.full(n, 1.0)], 1)
    up = np.array([np.cos(0.3 * lean), 0.0, np.sin(0.3 * lean)])
    world = World(position, BOX)
    for side in (-0.5, 0.5):
        world.add(Contacts(np.stack([np.full(n, -1), k], 1), position + np.array([-0.3, side, -1.0]), UP))
        edge = position[:-1] + np.array([0.5 * lean, side, 0.8])
        world.add(Contacts(np.stack([k[:-1], k[1:]], 1), edge, up))
    return world


# -- matrices -------------------------------------------------------------------------------------


def halfspace(rng: np.random.Generator, rows: int) -> Problem:
    """A ball pressed into an elastic half-space: displacement falls as 1/r; with friction or without."""
    size = int(rng.choice([1, 3]))
    side = max(2, round(np.sqrt(min(rows, LARGEST_DENSE) / size)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2)
    off = (grid - 0.5 * (side - 1)) / side
    r = np.linalg.norm(grid[:, None] - grid[None], axis=2)
    g = 1.0 / (r + np.eye(len(grid)) / 3.525)  # of a square on itself: 4 ln(1 + sqrt 2)
    deep = rng.uniform(0.02, 0.3) - (off**2).sum(axis=1)
    if size == 1:
        return Problem.lcp(g, deep)
    a = np.kron(g, np.diag([1.0, 0.9, 0.9]))
    drag = rng.choice([0.0, 0.02, 0.5]) * rng.standard_normal(2)
    b = np.concatenate([deep[:, None], np.broadcast_to(drag, off.shape) - 0.02 * off], 1).ravel()
    return Problem(
        b,
        Cones.contacts(np.full(len(deep), rng.uniform(0.1, 0.9))),
        a,
        friction=str(rng.choice(["coulomb", "cone"])),
    )


def option(rng: np.random.Generator, rows: int) -> Problem:
    """One implicit step of an American option: diffusion that grows with the price, and drift; an M-matrix."""
    m = max(4, rows)
    k = np.arange(1, m + 1)
    step, sigma, rate = 10.0 ** rng.uniform(-3.0, 0.0), rng.uniform(0.1, 0.5), rng.uniform(0.0, 0.1)
    wide, drift = 0.5 * (sigma * k) ** 2, rate * k
    a = sp.diags_array(
        [-step * wide[1:], 1.0 + step * (2.0 * wide + drift + rate), -step * (wide + drift)[:-1]],
        offsets=[-1, 0, 1],
    )
    payoff = np.maximum(0.0, rng.uniform(0.2, 0.8) - k / m)
    held = payoff + 0.1 * np.exp(-(((k / m - 0.5) / 0.2) ** 2))
    return Problem.lcp(sp.csr_array(a), held - a @ payoff)


def kernel(rng: np.random.Generator, rows: int) -> Problem:
    """Dual of a classifier of points in a few dimensions, each of a weight: nearly singular, 0 <= x <= c."""
    m = min(max(4, rows), LARGEST_DENSE)
    x = rng.standard_normal((m, int(rng.integers(1, 6))))
    label = np.where(x.sum(axis=1) + 0.5 * rng.standard_normal(m) > 0.0, 1.0, -1.0)
    square = ((x[:, None] - x[None]) ** 2).sum(axis=2)
    a = label[:, None] * np.exp(-square * 10.0 ** rng.uniform(-1.0, 1.0)) * label
    a[np.arange(m), np.arange(m)] += 10.0 ** rng.uniform(-6.0, -1.0)
    return Problem.lcp(a, rng.uniform(0.5, 1.5, m), 0.0, 10.0 ** rng.uniform(-1.0, 2.0))


def control(rng: np.random.Generator, rows: int) -> Problem:
    """Inputs of a linear system over a horizon, between bounds: the condensed matrix of predictive control."""
    inputs = int(rng.integers(1, 5))
    states = int(rng.integers(2, 9))
    horizon = max(2, min(rows, LARGEST_DENSE) // inputs)
    a = rng.standard_normal((states, states))
    a *= rng.uniform(0.7, 1.02) / np.abs(np.linalg.eigvals(a)).max()
    b = rng.standard_normal((states, inputs))
    answer = [b]  # of the states, to an input so many steps before
    for _ in range(horizon - 1):
        answer.append(a @ answer[-1])
    blocks = np.zeros((horizon, states, horizon, inputs))
    for i in range(horizon):
        for j in range(i + 1):
            blocks[i, :, j] = answer[i - j]
    g = blocks.reshape(horizon * states, horizon * inputs)
    h = g.T @ g + 10.0 ** rng.uniform(-3.0, 1.0) * np.eye(horizon * inputs)
    start, free = rng.standard_normal(states) * 5.0, []
    for _ in range(horizon):
        start = a @ start
        free.append(start)
    return Problem.lcp(0.5 * (h + h.T), g.T @ np.concatenate(free), -1.0, 1.0)


def smallworld(rng: np.random.Generator, rows: int) -> Problem:
    """The Laplacian of a ring of neighbours with shortcuts across: no order keeps its factor sparse."""
    m = max(6, rows)
    k = np.arange(m)
    far = np.flatnonzero(rng.random(m) < rng.uniform(0.05, 0.5))
    one = np.concatenate([k, k, far])
    two = np.concatenate([(k + 1) % m, (k + 2) % m, (far + rng.integers(3, m - 2, len(far))) % m])
    weight = 10.0 ** (rng.uniform(0.0, 1.5) * rng.standard_normal(len(one)))
    link = sp.csr_array((weight, (one, two)), shape=(m, m))
    link = link + link.T
    own = np.asarray(link.sum(axis=1)).ravel() + 10.0 ** rng.uniform(-5, -1)
    a = sp.csr_array(sp.diags_array(own) - link)
    upper = rng.choice([np.inf, 1.0])
    return Problem.lcp(a, rng.standard_normal(m), 0.0, upper)


def crowd(rng: np.random.Generator, rows: int) -> Problem:
    """Robots of 6 to 14 velocities on four feet each, some of them in touch with the next."""
    law = str(rng.choice(["coulomb", "cone", "none"]))
    size = 1 if law == "none" else 3
    nv = int(rng.integers(6, 15))
    count = max(1, round(rows / (4.5 * size)))
    touching = np.flatnonzero(rng.random(count - 1) < 0.5) if count > 1 else np.zeros(0, int)
    first = np.concatenate([np.repeat(np.arange(count), 4), touching])
    second = np.concatenate([np.full(4 * count, -1), touching + 1])
    row = np.arange(size * len(first)).reshape(-1, size)
    entries = []
    for robot in (first, second):
        at = np.flatnonzero(robot >= 0)
        col = nv * robot[at, None, None] + np.arange(nv)
        value = rng.standard_normal((len(at), size, nv)) * (rng.random((len(at), 1, nv)) < 0.6)
        where = np.broadcast_to(row[at][:, :, None], value.shape)
        entries.append((value.ravel(), where.ravel(), np.broadcast_to(col, value.shape).ravel()))
    value, where, col = (np.concatenate(part) for part in zip(*entries, strict=True))
    jac = sp.csr_array((value, (where, col)), shape=(row.size, nv * count))
    jac.eliminate_zeros()
    mass = []
    for _ in range(count):
        root = rng.standard_normal((nv, nv)) / np.sqrt(nv)
        scale = 10.0 ** rng.uniform(-1.0, 1.0, nv)
        mass.append(scale[:, None] * (root @ root.T + 0.1 * np.eye(nv)) * scale)
    bounded = Cones.bounded(np.zeros(len(first)), np.full(len(first), np.inf))
    cones = bounded if law == "none" else Cones.contacts(rng.uniform(0.2, 1.0, len(first)))
    soft = np.full(row.size, float(rng.choice([0.0, 1e-5])))
    return Problem.from_jacobian(
        jac, mass, rng.standard_normal(nv * count), cones=cones, compliance=soft,
        friction="cone" if law == "cone" else "coulomb",
    )  # fmt: skip


WORLDS: dict[str, Structure] = {f.__name__: f for f in (bearing, silo, mikado, dominoes)}
MATRICES: dict[str, Matrix] = {f.__name__: f for f in (halfspace, option, kernel, control, smallworld, crowd)}
STRUCTURES = (*WORLDS, *MATRICES)
# The lot, as in `foreign`.
_LOT = np.random.default_rng(20261122)
JUDGED = frozenset(
    [*map(str, _LOT.permutation(list(WORLDS))[:2]), *map(str, _LOT.permutation(list(MATRICES))[:3])]
)
TUNED = frozenset(STRUCTURES) - JUDGED


@family(foreign_new_tuned={"part": "tuned"}, foreign_new_judged={"part": "judged"})
def foreign_new(seed: int = 0, rows: int = 3000, part: str = "all") -> Draft:
    """A problem drawn by `seed` of a second lot of structures that `wild` has not; `part`: all, tuned or judged."""
    at_least(8, rows=rows)
    if part not in PART:
        raise UnknownName("part", part, PART)
    rng = np.random.default_rng([seed, 0x6E657766])
    names = [n for n in STRUCTURES if part == "all" or (n in JUDGED) == (part == "judged")]
    return drawn(rng, seed, rows, names, WORLDS, MATRICES)
