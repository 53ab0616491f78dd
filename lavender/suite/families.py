"""Families of problems with parameters: stacks, pyramids, piles, chains, and small problems to examine by hand.

Each function builds a `Case`; equal parameters give equal bits. Names that end in F have friction: `stackF(n=64)` is
`stack(n=64, friction="coulomb")`. `sliding` [m/s] is a horizontal speed that is added to every body in a random
direction. If it is 0, most frictional contacts stick, and Coulomb's law and its convex relaxation have the same
solution.
"""

from __future__ import annotations

import math

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.problem import Problem
from lavender.suite.build import (
    FALL_SPEED,
    Bodies,
    Contacts,
    add_horizontal_velocity,
    build_contact_problem,
    build_joint_problem,
    guess_static_loads,
    map_scalar,
    place_corner_contacts,
    place_tower,
)
from lavender.suite.case import Draft, Reference, register_family

WITH_FRICTION = {"friction": "coulomb"}
FRICTION_COEFFICIENT = 0.5
# Moment of inertia divided by mass of each kind of body [m^2].
SPHERE = 0.1
BOX = 1.0 / 6.0
PEBBLE = 0.1
ROD = 0.1


def check_min_sizes(minimum: int, **sizes: int) -> None:
    """Raise InputError if a size is below `minimum`."""
    for name, value in sizes.items():
        if value < minimum:
            raise InputError(f"{name} is {value}; at least {minimum} is needed")


def check_positive(**values: float) -> None:
    """Raise InputError if a value is not above 0."""
    for name, value in values.items():
        if not value > 0.0:
            raise InputError(f"{name} is {value}; a number above 0 is needed")


# -- stacks ---------------------------------------------------------------------------------------


@register_family(stackF=WITH_FRICTION)
def stack(
    n: int = 64, mass_ratio: float = 1.0, friction: str = "none", sliding: float = 0.0
) -> Draft:
    """n spheres in a column, one contact between neighbours; the top one weighs `mass_ratio` times the others.

    A is tridiagonal with condition number near n^2 (times a factor of mass_ratio). Without friction and after one step
    of gravity, contact i carries the bodies above it: lambda_i = g h sum of masses above.
    """
    check_min_sizes(1, n=n)
    check_positive(mass_ratio=mass_ratio)
    mass = np.ones(n)
    mass[-1] = mass_ratio
    position, pairs, contact_point = place_tower(n)
    bodies = Bodies(position, mass, SPHERE)
    add_horizontal_velocity(bodies, sliding)
    contacts = Contacts(pairs, contact_point, [0.0, 0.0, 1.0])
    problem = build_contact_problem(bodies, contacts, friction, FRICTION_COEFFICIENT)
    reason = "information must travel from the ground to the top: sweeps grow as n^2, a tridiagonal factorisation as n"
    if friction != "none" and sliding != 0.0:
        return Draft(problem, reason)

    def closed_form() -> Reference:
        load = FALL_SPEED * np.cumsum(mass[::-1])[::-1]
        impulse = np.zeros(problem.m)
        impulse[problem.cones.ptr[:-1]] = load
        return Reference(impulse, "closed form: the weight above")

    return Draft(problem, reason, closed_form)


@register_family(box_stackF=WITH_FRICTION)
def box_stack(
    n: int = 10, mass_ratio: float = 1.0, friction: str = "none", sliding: float = 0.0
) -> Draft:
    """n unit cubes on four points each; the top one weighs `mass_ratio` times the others.

    Four normals of one face have rank 3 (twelve rows with friction have rank 6): impulses are not unique,
    velocities are. With friction every body also gets a small random velocity, so that contacts slide and lift.
    """
    bodies, contacts = _build_cube_column(n, mass_ratio)
    problem = _build_box_problem(bodies, contacts, friction, sliding)
    reason = "redundant: four points where three would do, so A is singular; heavy on light makes sweeps stall"
    if friction != "none":
        return Draft(problem, reason)

    def closed_form() -> Reference:
        load = FALL_SPEED * np.cumsum(bodies.mass[::-1])[::-1]
        return Reference(
            np.repeat(0.25 * load, 4),
            "closed form: the weight above, a quarter on each point",
            "slack",
        )

    return Draft(problem, reason, closed_form)


def _build_cube_column(n: int, mass_ratio: float) -> tuple[Bodies, Contacts]:
    """Build the bodies and contacts of a column of unit cubes."""
    check_min_sizes(1, n=n)
    check_positive(mass_ratio=mass_ratio)
    mass = np.ones(n)
    mass[-1] = mass_ratio
    position, pairs, contact_point = place_tower(n)
    return Bodies(position, mass, BOX), place_corner_contacts(pairs, contact_point, 0.5)


@register_family(pyramidF=WITH_FRICTION)
def pyramid(
    k: int = 10,
    mass_ratio: float = 1.0,
    friction: str = "none",
    sliding: float = 0.0,
    bottom_ratio: float = 1.0,
) -> Draft:
    """k rows of unit cubes, each on two cubes below, four points per pair; the top one weighs `mass_ratio`.

    4 k^2 contacts on 3 k (k + 1) degrees of freedom: redundant. `bottom_ratio` makes the lowest row heavy.
    """
    bodies, contacts = _build_cube_pyramid(k, mass_ratio, bottom_ratio)
    problem = _build_box_problem(bodies, contacts, friction, sliding)
    reason = "more contacts than degrees of freedom, loads that spread sideways, heavy on light"
    return Draft(problem, reason)


def _build_cube_pyramid(
    k: int, mass_ratio: float, bottom_ratio: float = 1.0
) -> tuple[Bodies, Contacts]:
    """Build the bodies and contacts of a pyramid of unit cubes."""
    check_min_sizes(1, k=k)
    check_positive(mass_ratio=mass_ratio, bottom_ratio=bottom_ratio)
    row = np.repeat(np.arange(k), k - np.arange(k))
    first = np.concatenate([[0], np.cumsum(k - np.arange(k))])  # First box of each row.
    column = np.arange(len(row)) - first[row]
    x = 1.1 * (column + 0.5 * row)
    mass = np.ones(len(row))
    mass[row == 0] = bottom_ratio
    mass[-1] = mass_ratio
    bodies = Bodies(np.stack([x, 0.0 * x, 0.5 + row], 1), mass, BOX)
    above = np.flatnonzero(row > 0)
    left = first[row[above] - 1] + column[above]
    # First the ground contacts, then for every other box its left and its right support.
    pairs = np.concatenate(
        [
            np.stack([np.full(k, -1), np.arange(k)], 1),
            np.stack([np.stack([left, left + 1], 1).ravel(), np.repeat(above, 2)], 1),
        ]
    )
    a, b = pairs.T
    low = np.where(a < 0, x[b], np.maximum(x[np.maximum(a, 0)], x[b])) - 0.5
    high = np.where(a < 0, x[b], np.minimum(x[np.maximum(a, 0)], x[b])) + 0.5
    centre = np.stack([0.5 * (low + high), 0.0 * low, row[b].astype(float)], 1)
    return bodies, place_corner_contacts(pairs, centre, 0.5 * (high - low))


def _build_box_problem(
    bodies: Bodies, contacts: Contacts, friction: str, sliding: float
) -> Problem:
    """Build a problem of boxes; with friction, some contacts slide and some lift."""
    if friction != "none":
        _add_random_velocity(bodies)
    add_horizontal_velocity(bodies, sliding)
    return build_contact_problem(bodies, contacts, friction, FRICTION_COEFFICIENT)


def _add_random_velocity(bodies: Bodies) -> None:
    """Add a small random velocity to every body."""
    bodies.v_free += 0.05 * np.random.default_rng(3).standard_normal(bodies.v_free.size).reshape(
        -1, 6
    )


# -- piles ----------------------------------------------------------------------------------------


@register_family(granularF=WITH_FRICTION)
def granular(n: int = 4, friction: str = "none", sliding: float = 0.0, seed: int = 7) -> Draft:
    """n^3 pebbles on a jittered lattice in a box, contacts with neighbours, floor and four walls.

    n = 4, 9, 18 give 299, 3,402 and 27,570 contacts (seed 7). Well conditioned and three-dimensional: sparse
    factorisations fill in, sweeps converge fast.
    """
    check_min_sizes(1, n=n)
    bodies, contacts = _build_pile(n, seed)
    add_horizontal_velocity(bodies, sliding)
    problem = build_contact_problem(bodies, contacts, friction, FRICTION_COEFFICIENT)
    reason = "a large well-conditioned pile: sweeps converge fast, factorisations fill in"
    return Draft(problem, reason)


def _build_pile(n: int, seed: int) -> tuple[Bodies, Contacts]:
    """Build a pile of pebbles on a lattice of n^3 sites.

    Each pebble has contacts with its neighbours across faces, with 30 % of its neighbours across edges, and with
    walls. Sites are visited with x slowest, which fixes the order of the random numbers.
    """
    rng = np.random.default_rng(seed)
    count = n**3
    grid = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    position = grid + rng.uniform(-0.15, 0.15, (count, 3))
    mass = rng.uniform(0.5, 2.0, count)
    faces = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    edges = ((1, 1, 0), (1, 0, 1), (0, 1, 1), (1, -1, 0), (1, 0, -1), (0, 1, -1))
    step = np.array([n * n, n, 1])

    def neighbours(offsets: tuple[tuple[int, int, int], ...]) -> list[list[int]]:
        """Return the bodies at the given offsets from each site (count, len(offsets)); -1 outside the lattice."""
        to = grid[:, None, :] + np.array(offsets)
        ok = np.all((to >= 0) & (to < n), axis=2)
        return np.where(ok, to @ step, -1).tolist()

    ground = np.stack(
        [
            grid[:, 0] == 0,
            grid[:, 0] == n - 1,
            grid[:, 1] == 0,
            grid[:, 1] == n - 1,
            grid[:, 2] == 0,
        ],
        1,
    )
    # A site that touches both of two opposite walls (n = 1) has one contact along that axis.
    ground[:, 1] &= ~ground[:, 0]
    ground[:, 3] &= ~ground[:, 2]
    axes = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0]])
    body: list[tuple[int, int]] = []
    wall: list[int] = []  # Index of the wall, -1 between pebbles.
    draws: list[FloatArray] = []  # 6 random numbers between pebbles, 3 at a wall.
    walls_of = [np.flatnonzero(g).tolist() for g in ground]
    random, normal = rng.random, rng.standard_normal
    for a, (face, edge) in enumerate(zip(neighbours(faces), neighbours(edges), strict=True)):
        near = [b for b in face if b >= 0]
        if near:
            draws.append(normal(6 * len(near)))
            body += [(a, b) for b in near]
        for b in edge:
            if b >= 0 and random() < 0.3:
                draws.append(normal(6))
                body.append((a, b))
        wall += [-1] * (len(body) - len(wall))
        walls = walls_of[a]
        if walls:
            draws.append(normal(3 * len(walls)))
            body += [(-1, a)] * len(walls)
            wall += walls
    flat = np.concatenate(draws) if draws else np.zeros(0)
    pair = np.array(body, np.int32).reshape(-1, 2)
    side = np.array(wall, np.int32)
    between = side < 0
    start = np.concatenate([[0], np.cumsum(np.where(between, 6, 3))])[:-1]
    jitter = flat[start[:, None] + np.arange(3)]
    second = flat[np.minimum(start[:, None] + 3, len(flat) - 3) + np.arange(3)]
    first_body = np.maximum(pair[:, 0], 0)
    second_body = pair[:, 1]
    separation = position[second_body] - position[first_body]
    separation /= np.where(between, np.linalg.norm(separation, axis=1), 1.0)[:, None]
    separation += 0.25 * jitter
    separation /= np.linalg.norm(separation, axis=1, keepdims=True)
    flat_wall = axes[np.maximum(side, 0)]
    point = np.where(
        between[:, None],
        0.5 * (position[first_body] + position[second_body]) + 0.08 * second,
        position[second_body] - 0.5 * flat_wall + 0.05 * jitter,
    )
    bodies = Bodies(position, mass, PEBBLE)
    bodies.v_free = 0.05 * normal(6 * count).reshape(-1, 6)
    bodies.v_free[:, 2] -= FALL_SPEED
    return bodies, Contacts(pair, point, np.where(between[:, None], separation, flat_wall))


# -- joints ---------------------------------------------------------------------------------------


@register_family()
def chain(n: int = 33, tip_mass: float = 1.0) -> Draft:
    """n rods in a slack zig-zag arm from a fixed point, ball joints of 3 rows, the last rod weighs `tip_mass`.

    Half-bandwidth 5. The tension is small: the easy chain.
    """
    check_min_sizes(1, n=n)
    check_positive(tip_mass=tip_mass)
    k = np.arange(n)
    link = np.stack(
        [0.8 + 0.0 * k, 0.3 * map_scalar(math.cos, k), -0.5 + 0.3 * map_scalar(math.sin, 1.7 * k)],
        1,
    )
    problem = _build_chain(link, tip_mass, 0.02)  # pyright: ignore[reportArgumentType]
    return Draft(
        problem,
        "bilateral and banded with little tension: easy for every solver that uses the band",
    )


@register_family()
def hang(n: int = 33, tip_mass: float = 1.0) -> Draft:
    """n rods hanging almost straight down under their weight; the last one weighs `tip_mass`.

    Half-bandwidth 5; the condition number grows as n^2 and with tip_mass: the hard chain.
    """
    check_min_sizes(1, n=n)
    check_positive(tip_mass=tip_mass)
    k = np.arange(n)
    link = np.stack(
        [1e-4 * map_scalar(math.cos, k), 1e-4 * map_scalar(math.sin, 1.7 * k), -1.0 + 0.0 * k], 1
    )
    problem = _build_chain(link, tip_mass, 1e-4)  # pyright: ignore[reportArgumentType]
    return Draft(
        problem,
        "tension through the whole chain: sweeps need n^2 times tip_mass, a band factorisation n",
    )


def _build_chain(link: FloatArray, tip_mass: float, jitter: float) -> Problem:
    """Build a chain of rods along `link` (n, 3) with ball joints."""
    n = len(link)
    link = link / np.linalg.norm(link, axis=1, keepdims=True)
    anchor = np.concatenate([np.zeros((1, 3)), np.cumsum(link, axis=0)])
    mass = np.ones(n)
    mass[-1] = tip_mass
    bodies = Bodies(0.5 * (anchor[1:] + anchor[:-1]), mass, ROD)
    bodies.v_free = jitter * np.random.default_rng(11).standard_normal(6 * n).reshape(-1, 6)
    bodies.v_free[:, 2] -= FALL_SPEED
    body = np.stack([np.arange(n) - 1, np.arange(n)], 1)
    return build_joint_problem(
        bodies, body, compute_ball_joint_jacobian(bodies.position, body, anchor[:-1]), 3
    )


def compute_ball_joint_jacobian(
    position: FloatArray, body: np.ndarray, anchor: FloatArray
) -> FloatArray:
    """Compute the Jacobian (3 k, 12) of ball joints: the anchors on bodies a and b have the same velocity."""
    k = len(body)
    jac = np.zeros((k, 3, 12))
    for side, (sign, at) in enumerate(((-1.0, 0), (1.0, 6))):
        moving = body[:, side] >= 0
        arm = anchor[moving] - position[body[moving, side]]
        for axis in range(3):
            e = np.zeros(3)
            e[axis] = 1.0
            jac[moving, axis, at + axis] = sign
            jac[moving, axis, at + 3 : at + 6] = sign * np.cross(arm, e)
    return jac.reshape(-1, 12)


def multiply_in_index_order(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute a @ b, summed in the order of the index: unlike BLAS, it has the same bits on every processor."""
    return np.asarray(
        sum(np.multiply.outer(column, row) for column, row in zip(a.T, b, strict=True))
    )


@register_family()
def two_particles(m1: float = 1.0, m2: float = 2.0, drift: float = 0.01) -> Draft:
    """Two particles joined by one distance row: the smallest problem, A derived here.

    C = |x2 - x1| - L must stay 0. With n = (x2 - x1) / |x2 - x1|,

        dC/dt = n . (v2 - v1) = J v,        J = [-n^T, n^T]
        A = J M^-1 J^T = n.n / m1 + n.n / m2 = 1/m1 + 1/m2      [1/kg]
        b = target - J v*,   target = -drift / h               [m/s]: closes the error C = drift in one step
        lambda = b / A                                         [N s], along n on 2, against n on 1

    The reduced mass 1/A determines the result: the impulse of a rod is its closing speed times m1 m2 / (m1 + m2).
    """
    check_positive(m1=m1, m2=m2)
    x = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
    bodies = Bodies(x, [m1, m2], 0.0)
    bodies.v_free[0, :3], bodies.v_free[1, :3] = [0.3, 0.0, -FALL_SPEED], [0.0, 0.1, -FALL_SPEED]
    n = x[1] - x[0]  # Its length is 1: 0.36 + 0.64 = 1.
    jac = np.concatenate([-n, np.zeros(3), n, np.zeros(3)])[None]
    problem = build_joint_problem(bodies, [[0, 1]], jac, 1, target=-drift / 0.01, names=["rod"])
    closing = -drift / 0.01 - n @ (bodies.v_free[1, :3] - bodies.v_free[0, :3])
    return Draft(
        problem,
        "one row, one number: everything can be computed by hand",
        lambda: Reference(
            np.array([closing / (1.0 / m1 + 1.0 / m2)]), "closed form: b / (1/m1 + 1/m2)"
        ),
    )


# -- small problems -------------------------------------------------------------------------------


@register_family()
def toy_stack(kick: float = 1.0, friction: str = "none") -> Draft:
    """Eight unit spheres in a column, eight contacts; the fifth is kicked upwards by `kick` [m/s].

    A is tridiagonal (2, -1; first entry 1). The kick opens the contact below the fifth sphere and presses those
    above: solving A lambda = b and clamping the negative impulse once leaves an error that the LCP does not have.
    "box" puts friction bounds of fixed size on two tangents per contact.
    """
    n = 8
    if kick < 0.0:
        raise InputError(f"kick is {kick}; 0 (no kick) or more (upwards) is needed")
    if friction not in ("none", "box"):
        raise InputError(f"friction is {friction!r}; 'none' or 'box' is needed")
    position, pairs, contact_point = place_tower(n)
    bodies = Bodies(position, 1.0, SPHERE)
    bodies.v_free[4, 2] += kick
    contacts = Contacts(pairs, contact_point, [0.0, 0.0, 1.0])
    reason = "eight contacts that fit on a page, one of which must open"
    if friction == "none":
        problem = build_contact_problem(bodies, contacts)
        return Draft(problem, reason)
    bodies.v_free[:, 0] = 0.05 * np.arange(1, n + 1)
    problem = _build_boxed_friction_problem(bodies, contacts)
    return Draft(problem, reason + ", with friction bounded by fixed loads")


@register_family()
def random_spd(n: int = 100, condition: float = 1e6, seed: int = 0) -> Draft:
    """A dense symmetric positive definite linear system: eigenvalues from 1/condition to 1, evenly in the logarithm.

    b = A x with x of standard normal entries, so that every eigenvector matters.
    """
    check_min_sizes(1, n=n)
    if not condition >= 1.0:
        raise InputError(f"condition is {condition}; 1 or more is needed")
    rng = np.random.default_rng(seed)
    # Round each eigenvalue to twelve digits, so that the last bits of the C library's pow do not matter.
    a = np.zeros(
        (n, n)
    )  # Allocated before the eigenvalues are computed, because it may not fit into memory.
    np.fill_diagonal(a, [float(f"{condition**power:.12g}") for power in np.linspace(-1.0, 0.0, n)])
    # Rotate in random planes until every vector has a component along every other.
    for _ in range(4 * n.bit_length()):
        i, j = rng.permutation(n)[: n - n % 2].reshape(2, -1)
        t = rng.uniform(-1.0, 1.0, (len(i), 1))
        c = (1.0 - t * t) / (1.0 + t * t)
        s = 2.0 * t / (1.0 + t * t)
        for view in (a, a.T):
            view[i], view[j] = c * view[i] - s * view[j], s * view[i] + c * view[j]
    a = 0.5 * (a + a.T)
    problem = Problem.linear(a, multiply_in_index_order(a, rng.standard_normal(n)))
    return Draft(
        problem,
        "no structure, only a condition number, which separates direct from iterative solvers",
    )


@register_family()
def boxed_friction(
    n: int = 4, scene: str = "box_stack", mass_ratio: float = 1.0, sliding: float = 0.5
) -> Draft:
    """Contacts with tangents bounded by mu times an estimated load: a square, so a boxed LCP.

    Every QP solver accepts it, and the exact solution has unique velocities. Scenes: box_stack, pyramid, granular, of
    size n.
    """
    if scene == "box_stack":
        bodies, contacts = _build_cube_column(n, mass_ratio)
        _add_random_velocity(bodies)
    elif scene == "pyramid":
        bodies, contacts = _build_cube_pyramid(n, mass_ratio)
        _add_random_velocity(bodies)
    elif scene == "granular":
        check_min_sizes(1, n=n)
        bodies, contacts = _build_pile(n, 7)
    else:
        raise InputError(f"scene is {scene!r}; box_stack, pyramid or granular is needed")
    add_horizontal_velocity(bodies, sliding)
    problem = _build_boxed_friction_problem(bodies, contacts)
    return Draft(problem, "friction that every QP solver accepts: a boxed LCP with finite bounds")


def _build_boxed_friction_problem(bodies: Bodies, contacts: Contacts) -> Problem:
    """Build a block of bounded rows n, t1, t2 for each contact; the tangents' bounds are mu times the static load."""
    arm_a, arm_b = contacts.compute_arms(bodies.position)
    n = contacts.normal
    t = contacts.compute_tangents()
    axes = np.stack([n, t, np.cross(n, t)], 1)  # Shape (c, 3, 3).
    moving = (contacts.body >= 0).astype(float)[:, :, None, None]
    jac = np.concatenate(
        [
            -axes * moving[:, 0],
            -np.cross(arm_a[:, None], axes) * moving[:, 0],
            axes * moving[:, 1],
            np.cross(arm_b[:, None], axes) * moving[:, 1],
        ],
        axis=2,
    )
    bound = FRICTION_COEFFICIENT * guess_static_loads(bodies, contacts)
    high = np.stack([np.full(len(n), np.inf), bound, bound], 1)
    low = np.stack([np.zeros(len(n)), -bound, -bound], 1)
    names = [f"contact {i}" for i in range(len(n))]
    return build_joint_problem(
        bodies,
        contacts.body,
        jac.reshape(-1, 12),
        3,
        lower=low.ravel(),
        upper=high.ravel(),
        names=names,
    )
