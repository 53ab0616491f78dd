"""A third lot of structures unlike those of `wild` and of both foreign lots, half of them for judging `auto` alone.

    worlds     bridge (planks on paired joints, loads on them), carousel (arms of one hub that drag on the floor),
               pegs (balls held between fixed points), cards (pairs that lean on each other), books (pressed from the
               sides, held by friction), mattress (slabs on soft columns)
    matrices   beam (fourth differences on an obstacle), cavitation (a film of uneven height, strongly directed),
               deblur (a convolution, nearly singular), market (prices and flows, asymmetric), limits (stops and dry
               friction of robots with feet), gravel (balls that roll)

Which are for judging was drawn by lot, below, before anything was measured on any of them.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

import benchmarks.drawn.foreign as other
import benchmarks.drawn.foreign_new as newer
from benchmarks.drawn.foreign import PART, UP, Matrix
from benchmarks.drawn.foreign import drawn as draw
from benchmarks.drawn.wild import (
    LARGEST_DENSE,
    MASSES,
    Structure,
    World,
    between,
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

__all__ = ["JUDGED", "TUNED", "drawn"]


# -- bodies ---------------------------------------------------------------------------------------


def bridge(rng: np.random.Generator, rows: int) -> World:
    """Planks in a row, each joined to the next at two points and the last to the banks; some carry boxes."""
    n = max(2, rows // 8)
    k = np.arange(n)
    position = np.stack([1.0 * k, 0.0 * k, 1.0 - 0.5 * np.sin(np.pi * (k + 0.5) / n)], 1)
    first, second = np.concatenate([[-1], k]), np.concatenate([k, [-1]])
    at = np.concatenate([position[:1] - [0.5, 0.0, 0.0], position + np.array([0.5, 0.0, 0.0])])
    joint = np.repeat(np.stack([first, second], 1), 2, axis=0)
    anchor = np.repeat(at, 2, axis=0)
    anchor[:, 1] += np.tile([-0.5, 0.5], n + 1)
    joint[joint[:, 1] < 0] = joint[joint[:, 1] < 0][:, ::-1]  # the ground is the first of a pair
    loaded = np.flatnonzero(rng.random(n) < rng.uniform(0.2, 0.8))
    boxes = position[loaded] + [0.0, 0.0, 0.6]
    world = World(np.concatenate([position, boxes]), BOX, joint=joint, anchor=anchor)
    if not len(loaded):
        return world
    pair = np.stack([loaded, n + np.arange(len(loaded))], 1)
    return world.add(manifold(pair, position[loaded] + [0.0, 0.0, 0.1], 0.3, 0.3))


def carousel(rng: np.random.Generator, rows: int) -> World:
    """One hub with arms of one to six rods on ball joints around it; most rods drag on the floor."""
    length = int(rng.integers(1, 7))
    arms = max(2, rows // (4 * length))
    k = np.arange(arms * length)
    arm, place = k // length, k % length
    turn = 2.0 * np.pi * arm / arms
    along = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], 1)
    wide = arms / 6.0
    position = along * (wide + place + 0.5)[:, None] + [0.0, 0.0, 0.5]
    hub = len(k)
    joint = np.stack([np.where(place == 0, hub, k - 1), k], 1)
    world = World(
        np.concatenate([position, [[0.0, 0.0, 0.5]]]), ROD, joint=joint, anchor=position - 0.5 * along
    )
    return world.add(on_floor(world.position, np.append(rng.random(len(k)) < 0.8, True)))


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
    held = Contacts(np.stack([np.full(len(ball), -1), ball], 1), position[ball] - 0.5 * normal, normal)
    pairs = cKDTree(position).query_pairs(1.2, output_type="ndarray")
    some = pairs[np.lexsort(pairs.T[::-1])][: n // 2] if len(pairs) else pairs
    return World(position, SPHERE).add(held).add(between(position, some))


def cards(rng: np.random.Generator, rows: int) -> World:
    """A house of cards: pairs that lean on each other, each floor on a layer of flat ones."""
    high = max(1, round(np.sqrt(rows / 9.0)))
    place: list[list[float]] = []
    touch: list[list[int]] = []
    point: list[list[float]] = []
    normal: list[list[float]] = []
    steep = float(rng.uniform(0.3, 0.9))
    flat: dict[tuple[int, int], int] = {}
    lean = [np.cos(steep), 0.0, np.sin(steep)]
    for level in range(high):
        for i in range(high - level):
            x, z = i + 0.5 * level, float(level)
            left, right = len(place), len(place) + 1
            place += [[x - 0.2, 0.0, z + 0.4], [x + 0.2, 0.0, z + 0.4]]
            for y in (-0.3, 0.3):
                touch.append([left, right])
                point.append([x, y, z + 0.8])
                normal.append([lean[0], 0.0, 0.2])
                for body, off in ((left, -0.4), (right, 0.4)):
                    under = -1
                    if level:
                        under = flat.get((level, i if off < 0.0 else i + 1), flat[level, i])
                    touch.append([under, body])
                    point.append([x + off, y, z])
                    normal.append([0.0, 0.0, 1.0])
        for i in range(high - level if level + 1 < high else 0):
            on = len(place)
            flat[level + 1, i] = on
            place.append([i + 0.5 * level, 0.0, level + 0.9])
            below = [b for b in range(len(place)) if place[b][2] == level + 0.4 and b < on]
            near = sorted(below, key=lambda b: abs(place[b][0] - place[on][0]))[:2]
            for body in near:
                for y in (-0.3, 0.3):
                    touch.append([body, on])
                    point.append([place[on][0], y, level + 0.85])
                    normal.append([0.0, 0.0, 1.0])
    away = np.array(normal)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return World(np.array(place), BOX).add(Contacts(touch, point, away))


def books(rng: np.random.Generator, rows: int) -> World:
    """Books in a row between two fixed ends, four points a pair; only some stand on the shelf."""
    n = max(2, rows // 5)
    k = np.arange(n)
    position = np.stack([0.3 * k, 0.02 * rng.standard_normal(n), np.full(n, 1.0)], 1)
    world = World(position, BOX)
    for y in (-0.4, 0.4):
        for z in (-0.6, 0.6):
            face = position + np.array([-0.15, y, z])
            world.add(Contacts(np.stack([k - 1, k], 1), face, [1.0, 0.0, 0.0]))
            end = position[-1:] + np.array([0.15, y, z])
            world.add(Contacts([[-1, n - 1]], end, [-1.0, 0.0, 0.0]))
    stands = np.flatnonzero(rng.random(n) < rng.uniform(0.1, 0.9))
    foot = position[stands] - [0.0, 0.0, 1.0]
    return (
        world.add(Contacts(np.stack([np.full(len(stands), -1), stands], 1), foot, UP))
        if len(stands)
        else world
    )


def mattress(rng: np.random.Generator, rows: int) -> World:
    """Slabs side by side on columns of balls, one to eight high, which touch the columns beside them."""
    high = int(rng.integers(1, 9))
    side = max(2, round(np.sqrt(rows / (3.0 * high))))
    grid = np.stack(np.meshgrid(*map(np.arange, (high, side, side)), indexing="ij"), -1).reshape(-1, 3)[
        :, ::-1
    ]
    position = grid + [0.0, 0.0, 0.5] + 0.03 * rng.standard_normal(grid.shape)
    pairs = cKDTree(grid).query_pairs(1.01, output_type="ndarray")
    world_position = [position]
    slabs = int(rng.integers(1, 4))
    top = np.flatnonzero(grid[:, 2] == high - 1)
    of = len(position) + np.minimum(grid[top, 0] * slabs // side, slabs - 1)
    middle = (np.arange(slabs) + 0.5) * side / slabs
    world_position.append(np.stack([middle, np.full(slabs, 0.5 * side), np.full(slabs, high + 0.5)], 1))
    world = World(np.concatenate(world_position), SPHERE)
    world.add(between(position, pairs[np.lexsort(pairs.T[::-1])])).add(
        on_floor(world.position, np.append(grid[:, 2] == 0, np.zeros(slabs, bool)))
    )
    return world.add(Contacts(np.stack([top, of], 1), position[top] + [0.0, 0.0, 0.5], UP))


# -- matrices -------------------------------------------------------------------------------------


def beam(rng: np.random.Generator, rows: int) -> Problem:
    """A bent beam over an obstacle: fourth differences, which are no M-matrix and badly conditioned."""
    m = max(4, rows)
    second = sp.diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(m, m))
    stiff = 10.0 ** (rng.uniform(0.0, 1.0) * rng.standard_normal(m))
    a = sp.csr_array(
        second.T @ sp.diags_array(stiff) @ second + 10.0 ** rng.uniform(-6, -1) * sp.eye_array(m)
    )
    x = (np.arange(m) + 0.5) / m
    load = -1.0 + 3.0 * np.sin(2.0 * np.pi * x * rng.integers(1, 5)) + 0.3 * rng.standard_normal(m)
    return Problem.lcp(0.5 * (a + a.T), load / m, 0.0, rng.choice([np.inf, 2.0]))


def cavitation(rng: np.random.Generator, rows: int) -> Problem:
    """Pressure of a film between a shaft and its bearing: diffusion with the cube of the gap, far stronger one way."""
    around = max(4, round(np.sqrt(rows * 10.0 ** rng.uniform(0.0, 1.0))))
    across = max(2, rows // around)
    gap = 1.0 + rng.uniform(0.3, 0.98) * np.cos(2.0 * np.pi * np.arange(around + 1) / around)
    stretch = 10.0 ** rng.uniform(-2.0, 2.0)
    k = np.arange(around * across).reshape(across, around)
    mid = 0.5 * (gap[:-1] + gap[1:]) ** 3
    one = np.concatenate([k.ravel(), k[:-1].ravel()])
    two = np.concatenate([np.roll(k, -1, axis=1).ravel(), k[1:].ravel()])
    weight = np.concatenate([np.tile(mid, across), stretch * np.tile(gap[:-1] ** 3, across - 1)])
    link = sp.csr_array((weight, (one, two)), shape=(k.size, k.size))
    link = link + link.T
    edge = np.zeros(k.shape)
    edge[[0, -1]] += stretch * gap[:-1] ** 3
    a = sp.diags_array(np.asarray(link.sum(axis=1)).ravel() + edge.ravel() + 1e-6) - link
    return Problem.lcp(sp.csr_array(a), np.tile(np.diff(gap), across))


def deblur(rng: np.random.Generator, rows: int) -> Problem:
    """A signal without negative values, seen through a blur of some width: K^T K, nearly singular."""
    m = min(max(8, rows), LARGEST_DENSE)
    wide = int(rng.integers(1, max(2, min(20, m // 4)) + 1))
    weight = np.exp(-0.5 * (np.arange(-2 * wide, 2 * wide + 1) / wide) ** 2)
    k = sp.diags_array(
        list(weight / weight.sum()), offsets=list(range(-2 * wide, 2 * wide + 1)), shape=(m, m)
    )
    k = sp.csr_array(k)
    truth = np.where(rng.random(m) < 0.2, rng.exponential(1.0, m), 0.0)
    seen = k @ truth + 0.01 * rng.standard_normal(m)
    a = sp.csr_array(k.T @ k + 10.0 ** rng.uniform(-6, -2) * sp.eye_array(m))
    return Problem.lcp(a, -(k.T @ seen), 0.0, rng.choice([np.inf, 1.0]))


def market(rng: np.random.Generator, rows: int) -> Problem:
    """Flows along routes between markets and the prices there: [[D, -E], [E^T, S]], monotone and asymmetric."""
    places = max(2, rows // 4)
    routes = max(2, rows - places)
    tail = rng.integers(0, places, routes)
    head = (tail + rng.integers(1, places, routes)) % places
    k = np.arange(routes)
    e = sp.csr_array(
        (np.repeat([1.0, -1.0], routes), (np.tile(k, 2), np.concatenate([tail, head]))),
        shape=(routes, places),
    )
    cost = 10.0 ** rng.uniform(-2.0, 0.5, routes)
    slope = 10.0 ** rng.uniform(-1.0, 1.0, places)
    a = sp.block_array([[sp.diags_array(cost), e], [-e.T, sp.diags_array(slope)]], format="csr")
    b = np.concatenate([rng.uniform(0.1, 1.0, routes), rng.uniform(-10.0, 0.0, places)])
    return Problem.lcp(sp.csr_array(a), b)


def limits(rng: np.random.Generator, rows: int) -> Problem:
    """Robots of 12 to 40 velocities: dry friction and stops of their joints, and some feet without friction."""
    nv = int(rng.integers(12, 41))
    dry, stops, feet = int(rng.integers(0, nv - 5)), int(rng.integers(1, 5)), int(rng.integers(0, 5))
    each = dry + stops + feet
    count = max(1, round(rows / each))
    parts, mass = [], []
    for _ in range(count):
        jac = np.zeros((each, nv))
        at = 6 + rng.permutation(nv - 6)
        jac[np.arange(dry), at[:dry]] = 1.0
        jac[dry + np.arange(stops), at[rng.integers(0, nv - 6, stops)]] = rng.choice([-1.0, 1.0], stops)
        jac[dry + stops :] = rng.standard_normal((feet, nv)) * (rng.random((feet, nv)) < 0.5)
        jac[dry + stops :, 2] = 1.0
        parts.append(jac)
        root = rng.standard_normal((nv, nv)) / np.sqrt(nv)
        scale = 10.0 ** rng.uniform(-1.0, 1.0, nv)
        mass.append(scale[:, None] * (root @ root.T + 0.1 * np.eye(nv)) * scale)
    torque = 10.0 ** rng.uniform(-2.0, 1.0, dry)
    lower = np.tile(np.concatenate([-torque, np.zeros(stops + feet)]), count)
    upper = np.tile(np.concatenate([torque, np.full(stops + feet, np.inf)]), count)
    soft = np.full(count * each, float(rng.choice([0.0, 1e-4])))
    return Problem.from_jacobian(
        sp.csr_array(sp.block_diag(parts)),
        mass,
        rng.standard_normal(nv * count),
        cones=Cones.bounded(lower, upper),
        compliance=soft,
    )


def gravel(rng: np.random.Generator, rows: int) -> Problem:
    """Balls in a bowl of uneven ground that resist rolling, and perhaps spin: five or six rows a contact."""
    n = max(2, rows // 15)
    side = max(1.0, n ** (1 / 3))
    position = rng.uniform(0.0, side, (n, 3))
    pairs = cKDTree(position).query_pairs(side * (9.0 / (5.0 * n)) ** (1 / 3), output_type="ndarray")
    world = World(position, SPHERE)
    world.add(between(position, pairs[np.lexsort(pairs.T[::-1])] if len(pairs) else pairs))
    world.add(on_floor(position, position[:, 2] <= np.partition(position[:, 2], n // 4)[n // 4]))
    world.normal = world.normal + 0.1 * rng.standard_normal(world.normal.shape)
    world.normal /= np.linalg.norm(world.normal, axis=1, keepdims=True)
    bodies = Bodies(position, rng.uniform(0.5, 2.0, n), SPHERE)
    sideways(bodies, float(rng.choice([0.0, 0.2, 1.0])), seed=int(rng.integers(100)))
    contacts = Contacts(world.touch, world.point, world.normal)
    arm_a, arm_b = contacts.arms(position)
    made = bodies.rows(
        normal=contacts.normal,
        tangent=contacts.tangent(),
        arm_a=arm_a,
        arm_b=arm_b,
        contact_body=contacts.body,
    )
    spin = {"patch_radius": 0.02} if rng.random() < 0.5 else {}
    arm = 10.0 ** rng.uniform(-3.0, -1.0)
    return Problem.from_rows(
        made,
        mu=rng.uniform(0.2, 0.9),
        tangents=2,
        rolling=arm,
        friction=str(rng.choice(["coulomb", "cone"])),
        **spin,
    )


WORLDS: dict[str, Structure] = {f.__name__: f for f in (bridge, carousel, pegs, cards, books, mattress)}
MATRICES: dict[str, Matrix] = {f.__name__: f for f in (beam, cavitation, deblur, market, limits, gravel)}
STRUCTURES = (*WORLDS, *MATRICES)
# The lot: half of the worlds and half of the matrices.
_LOT = np.random.default_rng(20261123)
JUDGED = frozenset(
    [*map(str, _LOT.permutation(list(WORLDS))[:3]), *map(str, _LOT.permutation(list(MATRICES))[:3])]
)
TUNED = frozenset(STRUCTURES) - JUDGED


@family(drawn_tuned={"part": "tuned"}, drawn_judged={"part": "judged"})
def drawn(seed: int = 0, rows: int = 3000, part: str = "all") -> Draft:
    """A problem drawn by `seed` of a third lot of structures; `part`: all, tuned or judged."""
    at_least(8, rows=rows)
    if part not in PART:
        raise UnknownName("part", part, PART)
    rng = np.random.default_rng([seed, 0x647261])
    names = [n for n in STRUCTURES if part == "all" or (n in JUDGED) == (part == "judged")]
    return draw(rng, seed, rows, names, WORLDS, MATRICES)


@family(drawn_rolling={})
def rolling(seed: int = 0, rows: int = 3000) -> Draft:
    """Bodies of a structure to tune on, of any lot but `wild`'s, whose contacts resist rolling, and perhaps spin."""
    at_least(8, rows=rows)
    rng = np.random.default_rng([seed, 0x726F6C])
    worlds = {
        name: world
        for lot, tuned in ((WORLDS, TUNED), (other.WORLDS, other.TUNED), (newer.WORLDS, newer.TUNED))
        for name, world in lot.items()
        if name in tuned
    }
    name, masses = str(rng.choice(list(worlds))), str(rng.choice(MASSES))
    world = worlds[name](rng, max(2, round(8.0 * (rows / 8.0) ** rng.random() / 5.0)))
    bodies = Bodies(world.position, masses_of(rng, masses, len(world.position)), world.inertia)
    sideways(bodies, float(rng.choice([0.0, 0.2, 1.0])), seed=seed)
    made = problem_of(rng, world, bodies, "coulomb").rows
    assert made is not None
    spin = {"patch_radius": 0.02} if rng.random() < 0.5 else {}
    problem = Problem.from_rows(
        made,
        mu=rng.uniform(0.2, 0.9),
        tangents=2,
        rolling=10.0 ** rng.uniform(-3.0, -1.0),
        friction=str(rng.choice(["coulomb", "cone"])),
        **spin,
    )
    return Draft(problem, f"{name}, masses {masses}, {problem.law} that resists rolling: drawn, not chosen")
