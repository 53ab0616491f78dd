"""Hard cases of friction, in addition to `lavender.suite.hard`: bodies that slide, stick or hang by friction."""

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
    map_scalar,
    place_corner_contacts,
)
from lavender.suite.case import Draft, Reference, register_family
from lavender.suite.families import BOX, check_min_sizes, check_positive


@register_family()
def slider(
    mu: float = 0.3, speed: float = 0.5, angle: float = 10.0, friction: str = "coulomb"
) -> Draft:
    """A point mass sliding across the slope of a ramp of `angle` [degrees]: one contact, solved by hand.

    Coulomb: lambda_n = m g h cos angle; it sticks if mu lambda_n >= m |v_t|, otherwise friction opposes v_t. The
    convex relaxation lifts off: with v_t along t, w_n = mu w_t.
    """
    if mu < 0.0:
        raise InputError(f"mu is {mu}; 0 or more is needed")
    a = np.deg2rad(angle)
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    bodies.v_free[0, :3] = [speed, -FALL_SPEED * math.sin(a), -FALL_SPEED * math.cos(a)]
    contacts = Contacts([[-1, 0]], np.zeros((1, 3)), [0.0, 0.0, 1.0])
    problem = build_contact_problem(bodies, contacts, friction, mu)

    def closed_form() -> Reference:
        b = problem.b
        size = float(np.hypot(b[1], b[2]))
        if size <= mu * b[0]:
            return Reference(b.copy(), "closed form: sticks")
        direction = b[1:] / size
        if friction == "coulomb":
            n = b[0]
        else:  # A = 1: the nearest point of the cone to b
            n = max(0.0, (b[0] + mu * size) / (1.0 + mu * mu))
        return Reference(np.array([n, *(mu * n * direction)]), "closed form: slides")

    return Draft(problem, "friction coefficients from 0 to 10: sticking and sliding", closed_form)


@register_family()
def ramp(angle: float = 20.0, mu: float = 0.5) -> Draft:
    """A cube on four points of a ramp of `angle` [degrees]; with mu = 0.5 it slides above arctan 0.5 = 26.6 degrees."""
    a = np.deg2rad(angle)
    bodies = Bodies([[0.0, 0.0, 0.5]], 1.0, BOX)
    bodies.v_free[0, :3] = [FALL_SPEED * math.sin(a), 0.0, -FALL_SPEED * math.cos(a)]
    problem = build_contact_problem(
        bodies, place_corner_contacts([[-1, 0]], [[0.0, 0.0, 0.0]], 0.5), "coulomb", mu
    )

    def closed_form() -> Reference:
        n = FALL_SPEED * math.cos(a)
        t = min(FALL_SPEED * math.sin(a), mu * FALL_SPEED * math.cos(a))
        # Friction t at the bottom face tips the cube forwards with the lever 1/2: each front point carries n/4 + t/4.
        rear = 0.25 * n - 0.25 * t
        front = 0.25 * n + 0.25 * t
        normal = np.array([rear, rear, front, front])
        along = problem.rows.tangent @ np.array([1.0, 0.0, 0.0])  # type: ignore[union-attr]
        across = np.cross(problem.rows.normal, problem.rows.tangent) @ np.array([1.0, 0.0, 0.0])  # type: ignore[union-attr]
        friction_per_normal = -t * normal / n
        return Reference(
            np.stack(
                [normal, friction_per_normal * along, friction_per_normal * across], 1
            ).ravel(),
            "closed form",
            "slack",
        )

    return Draft(
        problem, "sticks below tan angle = mu, slides above, on a redundant face", closed_form
    )


@register_family()
def threshold(above: float = 0.0) -> Draft:
    """A point mass pushed with (1 + above) times the friction limit: between sticking and sliding."""
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    push_speed = (1.0 + above) * 0.5 * FALL_SPEED
    bodies.v_free[0, :2] = [0.6 * push_speed, 0.8 * push_speed]
    contacts = Contacts([[-1, 0]], np.zeros((1, 3)), [0.0, 0.0, 1.0])
    problem = build_contact_problem(bodies, contacts, "coulomb", 0.5)

    def closed_form() -> Reference:
        b = problem.b
        size = float(np.hypot(b[1], b[2]))
        scale = min(1.0, 0.5 * b[0] / size)
        return Reference(np.array([b[0], scale * b[1], scale * b[2]]), "closed form")

    return Draft(
        problem, "at the edge of the disk, where the projection is not differentiable", closed_form
    )


@register_family()
def anisotropic(ratio: float = 10.0, speed: float = 3.0) -> Draft:
    """One contact with A = diag(1, 1, ratio), mu = 0.5, pushed along (1, 1) with `speed`: sticks at 0.1, slides at 3.

    If it slides, lambda_t = (A_tt + s)^-1 b_t with s >= 0 such that |lambda_t| = mu lambda_n: one unknown. A step
    1/A_ii per tangent followed by the radial projection stops at a wrong point; a step 1/min(A_ii) cycles.
    """
    check_positive(ratio=ratio)
    b = np.array([1.0, speed, speed * ratio**0.5])
    problem = Problem.contact(np.diag([1.0, 1.0, ratio]), b, [0.5])
    return Draft(
        problem,
        "tangents of unequal mass, for which common disk projections are wrong or cycle",
        lambda: Reference(_solve_secular_equation(b, ratio), "secular equation"),
    )


def _solve_secular_equation(b: FloatArray, ratio: float) -> FloatArray:
    """Return the impulse (3,) [N s] of a contact with A = diag(1, 1, ratio), right-hand side b (3,) and mu = 0.5.

    It is A^-1 b if the contact sticks, else b_t / (A_tt + s), with the root s of |lambda_t(s)| = mu lambda_n.
    """
    from scipy.optimize import brentq

    radius = 0.5 * b[0]
    mass = np.array([1.0, ratio])
    if np.hypot(*(b[1:] / mass)) <= radius:
        return np.append(b[0], b[1:] / mass)
    upper_limit = float(np.hypot(*b[1:])) / radius
    s = brentq(
        lambda s: np.hypot(*(b[1:] / (mass + s))) - radius,
        0.0,
        upper_limit,
        xtol=1e-300,
        rtol=2.0**-50,
    )
    return np.append(b[0], b[1:] / (mass + s))


@register_family()
def painleve(slide: float = 3.0, lift: float = 0.1) -> Draft:
    """A rod sliding on its tip, mu = 2: A_nn - mu A_nt < 0, so that sliding presses the rod into the ground.

    Length 2, mass 1, inclined by 1.2 rad, one tangent: A = [[1 + 3 c^2, 3 c s], [3 c s, 1 + 3 s^2]], c, s of 1.2.
    Without contact it would lift off with `lift` and slide with `slide` [m/s]. Open (lambda = 0) is a solution;
    sticking and sliding may be solutions, too (`examples/two_motions.py` has them in closed form).
    """
    check_positive(lift=lift)
    c, s = math.cos(1.2), math.sin(1.2)
    a = np.array([[1.0 + 3.0 * c * c, 3.0 * c * s], [3.0 * c * s, 1.0 + 3.0 * s * s]])
    problem = Problem.contact(a, [-lift, -slide], [2.0])
    return Draft(
        problem,
        "Painleve: several solutions, all correct",
        lambda: Reference(np.zeros(2), "open: nothing approaches", "error"),
    )


@register_family()
def arch(n: int = 9, mu: float = 0.6) -> Draft:
    """n voussoirs of a half circle (radius 5 m, 1 m thick), four points between neighbours."""
    check_min_sizes(3, n=n)
    angle = np.pi * np.arange(n + 1) / n
    middle = 0.5 * (angle[1:] + angle[:-1])
    position = np.stack(
        [-5.0 * map_scalar(math.cos, middle), 0.0 * middle, 5.0 * map_scalar(math.sin, middle)], 1
    )
    bodies = Bodies(position, 1.0, 0.3)
    k = np.arange(n + 1)
    pairs = np.stack([np.where(k == 0, -1, k - 1), np.where(k == n, -1, k)], 1)
    # Joint k has its normal along the arch; its corner points are at radii 4.5 and 5.5 m and y = -0.5 and 0.5 m.
    radius, side = (g.ravel() for g in np.meshgrid([4.5, 5.5], [-0.5, 0.5], indexing="ij"))
    along, up = map_scalar(math.cos, angle), map_scalar(math.sin, angle)
    point = np.stack(
        [(-along[:, None] * radius).ravel(), np.tile(side, n + 1), (up[:, None] * radius).ravel()],
        1,
    )
    normal = np.repeat(np.stack([up, 0.0 * angle, along], 1), 4, axis=0)
    problem = build_contact_problem(
        bodies, Contacts(np.repeat(pairs, 4, axis=0), point, normal), "coulomb", mu
    )
    return Draft(problem, "held by friction and thrust alone: errors appear as a sag")


@register_family()
def card_house(levels: int = 3, mu: float = 0.7) -> Draft:
    """A house of cards: leaning pairs, cards across their tops, the next level on those; two points per edge."""
    check_min_sizes(1, levels=levels)
    lean = np.deg2rad(20.0)
    d, h = math.sin(lean), math.cos(lean)
    half = 0.02  # [m] Half the distance between the edges at a top.
    position: list[list[float]] = []
    contacts: list[tuple[int, int, list[float], list[float]]] = []

    def add(x: float, z: float) -> int:
        position.append([x, 0.0, z])
        return len(position) - 1

    def edge(a: int, b: int, x: float, z: float, normal: list[float]) -> None:
        contacts.extend((a, b, [x, y, z], normal) for y in (-0.4, 0.4))

    up, right = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    cards_below: dict[int, int] = {}  # Pair of cards -> card on which it stands.
    spacing = 2.0 * (d + half)
    for level in range(levels):
        z = level * h
        pairs = levels - level
        cards = []
        for j in range(pairs):
            x = spacing * (j + 0.5 * level)
            left = add(x - half - 0.5 * d, z + 0.5 * h)
            other = add(x + half + 0.5 * d, z + 0.5 * h)
            base = cards_below.get(j, -1)
            edge(base, left, x - half - d, z, up)
            edge(base, other, x + half + d, z, up)
            edge(left, other, x, z + h, right)
            cards.append((x, left, other))
        cards_below = {}
        for j in range(pairs - 1):
            (x, _, left_card), (y, right_card, _) = cards[j], cards[j + 1]
            across = add(0.5 * (x + y), z + h)
            edge(left_card, across, x + half, z + h, up)
            edge(right_card, across, y - half, z + h, up)
            cards_below[j] = across
    bodies = Bodies(position, 1.0, 0.1)
    a, b, point, normal = zip(*contacts, strict=True)
    problem = build_contact_problem(
        bodies, Contacts(np.stack([a, b], 1), point, normal), "coulomb", mu
    )
    return Draft(problem, "held by friction only, over several levels")


@register_family()
def wall(n: int = 10, sliding: float = 0.0, mu: float = 0.6) -> Draft:
    """n courses of n bricks (2 m x 1 m x 1 m, 2 kg) in running bond: four points on each half and between the ends.

    n = 10 and 25 have 3,252 and 21,612 rows.
    """
    check_min_sizes(1, n=n)
    signs = ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0))
    position: list[list[float]] = []
    contacts: list[tuple[int, int, list[float], list[float]]] = []

    def add_face_contacts(below: int, brick: int, x: float, z: float, half: float) -> None:
        contacts.extend(
            (below, brick, [x + half * s, 0.5 * t, z], [0.0, 0.0, 1.0]) for s, t in signs
        )

    for course in range(n):
        shift = course % 2
        first = (course - 1) * n  # Number of the first brick below
        for k in range(n):
            x = 2.0 * k + shift
            z = float(course)
            brick = course * n + k
            position.append([x, 0.0, z + 0.5])
            if course == 0:
                add_face_contacts(-1, brick, x, z, 1.0)
            else:
                for below in (k - 1 + shift, k + shift):
                    if 0 <= below < n:
                        add_face_contacts(first + below, brick, x + below - k + 0.5 - shift, z, 0.5)
            if k > 0:
                contacts.extend(
                    (brick - 1, brick, [x - 1.0, 0.5 * s, z + 0.5 + 0.5 * t], [1.0, 0.0, 0.0])
                    for s, t in signs
                )
    bodies = Bodies(position, 2.0, np.array([2.0, 5.0, 5.0]) / 12.0)
    add_horizontal_velocity(bodies, sliding)
    a, b, point, normal = zip(*contacts, strict=True)
    problem = build_contact_problem(
        bodies, Contacts(np.stack([a, b], 1), point, normal), "coulomb", mu
    )
    return Draft(problem, "many redundant contacts in two directions, of any size")
