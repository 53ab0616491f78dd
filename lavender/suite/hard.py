"""Hard cases: each takes one thing to its extreme, with a reference that no solver has to vouch for.

References are closed forms, exact integers, enumerations, or solutions proved in 100 bits
(`lavender.suite.exact`). Where none is known (sliding at large mass ratios), `reference` is None and the
judge alone speaks. `SET` is what `lavender report hard` runs.
"""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np

from lavender._arrays import FloatArray
from lavender.cones import ROW
from lavender.errors import InputError
from lavender.problem import Problem
from lavender.rows import Rows
from lavender.suite.build import FALL, Bodies, Contacts, contact_problem, joint_problem, manifold, sideways
from lavender.suite.case import Draft, Reference, family
from lavender.suite.exact import solve_linear
from lavender.suite.families import BOX, MU, SPHERE, at_least, ball_joints, positive, rest_reference

EXACT = "reaches the floor: newton, direct, auto"
SWEEPS_STALL = "sweeps stall; " + EXACT

SET = (
    # Mass ratios.
    *(f"stack(n=2, mass_ratio={r})" for r in ("100", "1e4", "1e6", "1e8")),
    *(f"stack(n=20, mass_ratio={r})" for r in ("1e4", "1e8")),
    *(f"pyramid(k=6, mass_ratio={r})" for r in ("100", "1e4", "1e6", "1e8")),
    *(f"pyramid(k=6, bottom_ratio={r})" for r in ("1e4", "1e8")),
    *(f"big_box(mass_ratio={r})" for r in ("1", "400", "1e6")),
    *(f"big_boxF(mass_ratio={r}, sliding=0.5)" for r in ("1", "400")),
    *(f"chain(n=33, tip_mass={r})" for r in ("1e4", "1e8")),
    *(f"hang(n=33, tip_mass={r})" for r in ("1", "1e4", "1e8")),
    # Long ways.
    "stack(n=10)", "stack(n=100)", "stack(n=1000)", "chain(n=1000)", "hang(n=100)", "hang(n=1000)", "hang(n=10000)",
    # Redundancy.
    *(f"duplicated(k={k})" for k in (2, 3, 8, 64)),
    *(f"slab(n={n})" for n in (2, 5, 10)),
    *(f"slabF(n={n}, sliding=0.5)" for n in (2, 10)),
    "four_bar", "ring(n=8)", "ring(n=64)",
    # Geometry.
    *(f"near_parallel(angle={a})" for a in ("0.01", "1e-4", "1e-7", "1e-12")),
    *(f"wedge(angle={a})" for a in ("0.1", "1e-4", "1e-8")),
    # Friction.
    *(f"slider(mu={mu})" for mu in ("0", "1e-12", "0.3", "1", "10")),
    *(f"slider(mu={mu}, friction=cone)" for mu in ("0.3", "10")),
    *(f"ramp(angle={a})" for a in ("20", "30")), "threshold", "threshold(above=1e-9)", "threshold(above=-1e-9)",
    *(f"anisotropic(ratio={r}, speed={s})" for r in ("10", "100", "1e6") for s in ("0.1", "3")),
    "painleve", "painleve(slide=0.5)", "arch", "arch(n=25)", "card_house", "card_house(levels=5)",
    "stackF(n=10, sliding=0.5)", "box_stackF(n=10, sliding=0.5)", "pyramidF(k=6, sliding=0.5)",
    "pyramidF(k=6, mass_ratio=1e3, sliding=0.5)", "pyramidF(k=6, mass_ratio=1e6, sliding=0.5)",
    "granularF(n=4, sliding=0.5)", "box_stackF(n=10, mass_ratio=1e6)",
    # Numbers.
    *(f"diagonal(kind={k})" for k in ("zero", "negative", "negligible")),
    *(f"units(kg={k}, m={m}, s={s})" for k, m, s in (("1e12", 1, 1), ("1e-12", 1, 1), (1, "1e6", 1), (1, 1, "1e-6"))),
    "denormals", *(f"degenerate_lcp(n={n})" for n in (8, 40)), "degenerate_lcp(n=40, asymmetric=1)",
    *(f"random_spd(n=60, condition={c})" for c in ("100", "1e8", "1e14")),
    "infeasible(kind=squeeze)", "infeasible(kind=joints)",
)  # fmt: skip


# -- mass ratios and redundancy -------------------------------------------------------------------


@family(big_boxF={"friction": "coulomb"})
def big_box(mass_ratio: float = 400.0, friction: str = "none", sliding: float = 0.0) -> Draft:
    """A 20 m box on two 1 m boxes, four points each: heavy on light with long levers.

    400 is the ratio of equal density in a plane.
    """
    positive(mass_ratio=mass_ratio)
    bodies = Bodies([[-5.0, 0.0, 0.5], [5.0, 0.0, 0.5], [0.0, 0.0, 11.0]], [1.0, 1.0, mass_ratio], BOX)
    bodies.inertia[2] *= 400.0
    sideways(bodies, sliding)
    pairs = [[-1, 0], [-1, 1], [0, 2], [1, 2]]
    centre = [[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0], [-5.0, 0.0, 1.0], [5.0, 0.0, 1.0]]
    problem = contact_problem(bodies, manifold(pairs, centre, 0.5), friction, MU)
    rest = rest_reference(problem) if friction == "none" or sliding == 0.0 else None
    return Draft(problem, "heavy on light with levers of ten metres", rest, SWEEPS_STALL)


@family()
def duplicated(k: int = 8) -> Draft:
    """One sphere on the ground with its contact repeated k times: rank 1.

    Undamped Jacobi has the factor k - 1: it cycles for k = 2 and diverges for k of 3 and more.
    """
    at_least(1, k=k)
    bodies = Bodies([[0.0, 0.0, 0.5]], 1.0, SPHERE)
    contacts = Contacts(np.tile([-1, 0], (k, 1)), np.zeros((k, 3)), [0.0, 0.0, 1.0])
    problem = contact_problem(bodies, contacts)

    def closed_form() -> Reference:
        return Reference(np.full(k, FALL / k), "closed form: the weight, shared", "slack")

    return Draft(problem, "the same row many times: Jacobi diverges unless damped, A has rank 1", closed_form)


@family(slabF={"friction": "coulomb"})
def slab(n: int = 5, friction: str = "none", sliding: float = 0.0) -> Draft:
    """A slab of 10 kg on n x n points: rank 3 (6 with friction), however many points."""
    at_least(2, n=n)
    x = np.linspace(-1.0, 1.0, n)
    point = np.stack([*(g.ravel() for g in np.meshgrid(x, x)), np.zeros(n * n)], 1)
    bodies = Bodies([[0.1, 0.05, 0.2]], 10.0, 0.35)
    sideways(bodies, sliding)
    problem = contact_problem(
        bodies, Contacts(np.tile([-1, 0], (n * n, 1)), point, [0.0, 0.0, 1.0]), friction, MU
    )
    rest = rest_reference(problem) if friction == "none" or sliding == 0.0 else None
    return Draft(problem, "a body on many points: only three of them are needed", rest)


@family()
def four_bar(tilt: float = 0.3) -> Draft:
    """A closed loop: three bars and the ground, four parallel hinges of five rows, in a tilted plane.

    20 rows on 18 degrees of freedom that still move in one: rank 17. An engine that trusts its pivots drifts.
    """
    anchor = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 1.0], [1.4, 0.0, 1.3], [1.5, 0.0, 0.0]])
    c, s = np.cos(tilt), np.sin(tilt)
    turn = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    anchor, axis = anchor @ turn.T, turn @ np.array([0.0, 1.0, 0.0])
    bodies = Bodies(0.5 * (anchor[1:] + anchor[:-1]), [1.0, 2.0, 1.0], 0.1)
    body = np.array([[-1, 0], [0, 1], [1, 2], [2, -1]])
    ball = ball_joints(bodies.position, body, anchor).reshape(4, 3, 12)
    # Two axes across the hinge: omega_b - omega_a has no part there.
    across = np.linalg.svd(axis[None])[2][1:]
    turning = np.zeros((4, 2, 12))
    for joint, (a, b) in enumerate(body):
        for row in range(2):
            if a >= 0:
                turning[joint, row, 3:6] = -across[row]
            if b >= 0:
                turning[joint, row, 9:12] = across[row]
    jac = np.concatenate([ball, turning], axis=1).reshape(-1, 12)
    problem = joint_problem(bodies, body, jac, 5, names=[f"hinge {i}" for i in range(4)])
    return Draft(
        problem,
        "a closed loop off the axes: consistent but singular, so a plain factorisation meets a zero pivot",
        lambda: Reference(solve_linear(problem), "refined in 100 bits on the range of A", "slack"),
        "direct says that A is singular and still solves it",
    )


@family()
def ring(n: int = 8) -> Draft:
    """A closed ring of n rods in a tilted circle, ball joints, hung at one point: a cycle of 3 n + 3 rows."""
    at_least(3, n=n)
    angle = 2.0 * np.pi * np.arange(n + 1) / n
    anchor = np.stack([np.sin(angle), 0.2 * np.cos(angle), -1.0 + np.cos(angle)], 1)
    bodies = Bodies(0.5 * (anchor[1:] + anchor[:-1]), 1.0, 0.1)
    body = np.stack([np.arange(n) - 1, np.arange(n)], 1)
    body[0, 0] = n - 1
    body = np.concatenate([body, [[-1, 0]]])
    at = np.concatenate([anchor[:-1], [anchor[0]]])
    problem = joint_problem(bodies, body, ball_joints(bodies.position, body, at), 3)
    return Draft(
        problem,
        "a loop of joints: the band of the chain closes on itself",
        lambda: Reference(solve_linear(problem), "factorised in float64, refined in 100 bits"),
    )


# -- geometry -------------------------------------------------------------------------------------


@family()
def near_parallel(angle: float = 1e-4) -> Draft:
    """A point mass on two planes whose normals differ by 2 x `angle` [rad]: A = [[1, c], [c, 1]], c = cos 2 angle."""
    positive(angle=angle)
    problem = _on_two_planes(np.sin(angle), np.cos(angle))
    unique = (
        "impulse" if angle > 1e-3 else "slack"
    )  # 1 - c^2 = 4 angle^2 amplifies the rounding of the normals

    def closed_form() -> Reference:
        return Reference(np.full(2, 0.5 * FALL / np.cos(angle)), "closed form: symmetric", unique)

    return Draft(
        problem, "two contacts that are almost one: A is singular to float64 below 1e-8", closed_form
    )


@family()
def wedge(angle: float = 1e-4) -> Draft:
    """A point mass falls into a slot whose two walls are `angle` [rad] from vertical: impulses 1 / (2 sin angle)."""
    positive(angle=angle)
    problem = _on_two_planes(np.cos(angle), np.sin(angle))

    def closed_form() -> Reference:
        impulse = 0.5 * FALL / problem.rows.normal[:, 2]  # type: ignore[union-attr]
        return Reference(impulse, "closed form: symmetric")

    return Draft(
        problem, "opposed walls: impulses a million times the weight, A nearly singular", closed_form
    )


def _on_two_planes(x: float, z: float) -> Problem:
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    contacts = Contacts([[-1, 0], [-1, 0]], np.zeros((2, 3)), [[x, 0.0, z], [-x, 0.0, z]])
    return contact_problem(bodies, contacts)


# -- friction -------------------------------------------------------------------------------------


@family()
def slider(mu: float = 0.3, speed: float = 0.5, angle: float = 10.0, friction: str = "coulomb") -> Draft:
    """A point mass sliding across the slope of a ramp of `angle` [degrees]: one contact, solved by hand.

    Coulomb: lambda_n = m g h cos angle; it sticks where mu lambda_n >= m |v_t|, else friction opposes v_t. The convex
    relaxation lifts off: with v_t along t, w_n = mu w_t.
    """
    if mu < 0.0:
        raise InputError(f"mu is {mu}; 0 or more is needed")
    a = np.deg2rad(angle)
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    bodies.v_free[0, :3] = [speed, -FALL * np.sin(a), -FALL * np.cos(a)]
    contacts = Contacts([[-1, 0]], np.zeros((1, 3)), [0.0, 0.0, 1.0])
    problem = contact_problem(bodies, contacts, friction, mu)

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

    return Draft(problem, "every friction coefficient: stick, slip, none, sand paper", closed_form)


@family()
def ramp(angle: float = 20.0, mu: float = 0.5) -> Draft:
    """A cube on four points of a ramp of `angle` [degrees]; tan 26.6 = 0.5 is where it begins to slide."""
    a = np.deg2rad(angle)
    bodies = Bodies([[0.0, 0.0, 0.5]], 1.0, BOX)
    bodies.v_free[0, :3] = [FALL * np.sin(a), 0.0, -FALL * np.cos(a)]
    problem = contact_problem(bodies, manifold([[-1, 0]], [[0.0, 0.0, 0.0]], 0.5), "coulomb", mu)

    def closed_form() -> Reference:
        n, t = FALL * np.cos(a), min(FALL * np.sin(a), mu * FALL * np.cos(a))
        # Friction at the foot tips the cube forwards: the front pair carries t/2 more than half, of lever 1/2.
        rear, front = 0.25 * n - 0.25 * t, 0.25 * n + 0.25 * t
        normal = np.array([rear, rear, front, front])
        along = problem.rows.tangent @ np.array([1.0, 0.0, 0.0])  # type: ignore[union-attr]
        across = np.cross(problem.rows.normal, problem.rows.tangent) @ np.array([1.0, 0.0, 0.0])  # type: ignore[union-attr]
        share = -t * normal / n
        return Reference(np.stack([normal, share * along, share * across], 1).ravel(), "closed form", "slack")

    return Draft(
        problem,
        "sticks below tan angle = mu, slides above, on a redundant face",
        closed_form,
    )


@family()
def threshold(above: float = 0.0) -> Draft:
    """A point mass pushed with (1 + above) times what friction can hold: between stick and slip."""
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    push = (1.0 + above) * 0.5 * FALL
    bodies.v_free[0, :2] = [0.6 * push, 0.8 * push]
    contacts = Contacts([[-1, 0]], np.zeros((1, 3)), [0.0, 0.0, 1.0])
    problem = contact_problem(bodies, contacts, "coulomb", 0.5)

    def closed_form() -> Reference:
        b = problem.b
        size = float(np.hypot(b[1], b[2]))
        scale = min(1.0, 0.5 * b[0] / size)
        return Reference(np.array([b[0], scale * b[1], scale * b[2]]), "closed form")

    return Draft(
        problem,
        "at the edge of the disk, where the projection has a kink",
        closed_form,
    )


@family()
def anisotropic(ratio: float = 10.0, speed: float = 3.0) -> Draft:
    """One contact with A = diag(1, 1, ratio), mu = 0.5, pushed along (1, 1) with `speed`: sticks at 0.1, slides at 3.

    Sliding, lambda_t = (A_tt + s)^-1 b_t with s >= 0 such that |lambda_t| = mu lambda_n: one unknown. A step 1/A_ii per
    tangent followed by the radial projection stops at a wrong point; a step 1/min(A_ii) cycles.
    """
    positive(ratio=ratio)
    b = np.array([1.0, speed, speed * ratio**0.5])
    problem = Problem.contact(np.diag([1.0, 1.0, ratio]), b, [0.5])

    def secular() -> Reference:
        return Reference(_secular(b, ratio), "secular equation in 60 digits")

    return Draft(
        problem, "tangents of unequal mass: where the usual disk projections are wrong or cycle", secular
    )


def _secular(b: FloatArray, ratio: float) -> FloatArray:
    with localcontext() as context:
        context.prec = 60
        n, b1, b2, r = (Decimal(float(x)) for x in (*b, ratio))
        radius = n / 2
        if b1**2 + (b2 / r) ** 2 <= radius**2:
            return np.array([float(n), float(b1), float(b2 / r)])
        low, high = Decimal(0), (b1**2 + b2**2).sqrt() / radius
        for _ in range(250):  # |lambda_t| decreases in s
            s = (low + high) / 2
            if (b1 / (1 + s)) ** 2 + (b2 / (r + s)) ** 2 > radius**2:
                low = s
            else:
                high = s
        return np.array([float(n), float(b1 / (1 + high)), float(b2 / (r + high))])


@family()
def painleve(slide: float = 3.0, lift: float = 0.1) -> Draft:
    """A rod sliding on its tip, mu = 2: A_nn - mu A_nt < 0, so that sliding presses the rod into the ground.

    Length 2, mass 1, inclined by 1.2 rad, one tangent: A = [[1 + 3 c^2, 3 c s], [3 c s, 1 + 3 s^2]], c, s of 1.2.
    Free it would lift off with `lift` and slide with `slide` [m/s]. Open (lambda = 0) is a solution; so may be
    stick and slip: `painleve_solutions` finds all of them by trying each.
    """
    problem = _painleve(slide, lift)

    def enumerated() -> Reference:
        states = painleve_solutions(problem)
        text = ", ".join(states)
        return Reference(states["open"], f"each state tried in closed form: {text}", "error")

    return Draft(problem, "Painleve: several solutions, all right; which one was found is named", enumerated)


def _painleve(slide: float, lift: float) -> Problem:
    positive(lift=lift)
    c, s = np.cos(1.2), np.sin(1.2)
    a = np.array([[1.0 + 3.0 * c * c, 3.0 * c * s], [3.0 * c * s, 1.0 + 3.0 * s * s]])
    return Problem.contact(a, [-lift, -slide], [2.0])


def painleve_solutions(problem: Problem) -> dict[str, FloatArray]:
    """Every solution of a single contact with one tangent, by state: open, stick, slip +, slip -."""
    a, b, mu = problem.dense(), problem.b, float(problem.cones.mu[0])
    found: dict[str, FloatArray] = {}
    if -b[0] >= 0.0:
        found["open"] = np.zeros(2)
    stick = np.linalg.solve(a, b)
    if stick[0] >= 0.0 and abs(stick[1]) <= mu * stick[0]:
        found["stick"] = np.asarray(stick, float)
    for sign, name in ((1.0, "slip +"), (-1.0, "slip -")):  # sign of w_t
        press = a[0, 0] - sign * mu * a[0, 1]
        n = b[0] / press if press != 0.0 else -1.0
        lam = np.array([n, -sign * mu * n])
        if n > 0.0 and sign * (a[1] @ lam - b[1]) > 0.0:
            found[name] = lam
    return found


def contact_states(problem: Problem, impulse: FloatArray, tol: float = 1e-9) -> list[str]:
    """Each contact's state at an impulse (m,) [N s]: "open", "stick" or "slip"."""
    c = problem.cones
    lam = np.asarray(impulse, float)
    size = max(float(np.abs(lam).max(initial=0.0)), 1e-300)
    out = []
    for i in np.flatnonzero(c.kind != ROW):
        part = lam[c.ptr[i] : c.ptr[i + 1]][: 1 + int(c.n_tangents[i])]
        if part[0] <= tol * size:
            out.append("open")
        else:
            edge = np.linalg.norm(part[1:]) >= (1.0 - tol) * c.mu[i] * part[0]
            out.append("slip" if len(part) > 1 and edge else "stick")
    return out


@family()
def arch(n: int = 9, mu: float = 0.6) -> Draft:
    """n voussoirs of a half circle (radius 5 m, 1 m thick), four points between neighbours."""
    at_least(3, n=n)
    angle = np.pi * np.arange(n + 1) / n
    middle = 0.5 * (angle[1:] + angle[:-1])
    position = np.stack([-5.0 * np.cos(middle), 0.0 * middle, 5.0 * np.sin(middle)], 1)
    bodies = Bodies(position, 1.0, 0.3)
    k = np.arange(n + 1)
    pairs = np.stack([np.where(k == 0, -1, k - 1), np.where(k == n, -1, k)], 1)
    # Joint k looks along the arch; the corner points are at radii 4.5 and 5.5, half a metre either side.
    radius, side = (g.ravel() for g in np.meshgrid([4.5, 5.5], [-0.5, 0.5], indexing="ij"))
    point = np.stack([
        (-np.cos(angle)[:, None] * radius).ravel(), np.tile(side, n + 1), (np.sin(angle)[:, None] * radius).ravel()
    ], 1)  # fmt: skip
    normal = np.repeat(np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], 1), 4, axis=0)
    problem = contact_problem(bodies, Contacts(np.repeat(pairs, 4, axis=0), point, normal), "coulomb", mu)
    return Draft(
        problem, "held up by friction and thrust alone: errors show as a sag", rest_reference(problem), EXACT
    )


@family()
def card_house(levels: int = 3, mu: float = 0.7) -> Draft:
    """A house of cards: leaning pairs, cards across their tops, the next level on those; two points per edge."""
    at_least(1, levels=levels)
    lean = np.deg2rad(20.0)
    d, h = np.sin(lean), np.cos(lean)
    half = 0.02  # m, between the edges at a top
    position: list[list[float]] = []
    contacts: list[tuple[int, int, list[float], list[float]]] = []

    def add(x: float, z: float) -> int:
        position.append([x, 0.0, z])
        return len(position) - 1

    def edge(a: int, b: int, x: float, z: float, normal: list[float]) -> None:
        contacts.extend((a, b, [x, y, z], normal) for y in (-0.4, 0.4))

    up, right = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    floor: dict[int, int] = {}  # card under the pair
    spacing = 2.0 * (d + half)
    for level in range(levels):
        z = level * h
        pairs = levels - level
        cards = []
        for j in range(pairs):
            x = spacing * (j + 0.5 * level)
            left, other = add(x - half - 0.5 * d, z + 0.5 * h), add(x + half + 0.5 * d, z + 0.5 * h)
            base = floor.get(j, -1)
            edge(base, left, x - half - d, z, up)
            edge(base, other, x + half + d, z, up)
            edge(left, other, x, z + h, right)
            cards.append((x, left, other))
        floor = {}
        for j in range(pairs - 1):
            (x, _, one), (y, two, _) = cards[j], cards[j + 1]
            across = add(0.5 * (x + y), z + h)
            edge(one, across, x + half, z + h, up)
            edge(two, across, y - half, z + h, up)
            floor[j] = across
    bodies = Bodies(position, 1.0, 0.1)
    a, b, point, normal = zip(*contacts, strict=True)
    problem = contact_problem(bodies, Contacts(np.stack([a, b], 1), point, normal), "coulomb", mu)
    return Draft(problem, "stands by friction only, over several levels", rest_reference(problem), EXACT)


# -- numbers --------------------------------------------------------------------------------------


@family()
def diagonal(kind: str = "zero", n: int = 12) -> Draft:
    """An LCP with zero, negative or negligible diagonal entries, made from its solution in small integers.

    Sweeps divide by the largest entry of the row instead and need not converge; pivoting does not care.
    """
    at_least(2, n=n)
    value = {"zero": 0.0, "negative": -1.0, "negligible": 2.0**-60}.get(kind)
    if value is None:
        raise InputError(f"kind is {kind!r}; zero, negative, negligible are known")
    rng = np.random.default_rng(2)
    a = rng.integers(-3, 4, (n, n)).astype(float)
    a = (
        np.triu(a, 1) - np.triu(a, 1).T + np.diag(np.full(n, 4.0))
    )  # skew part: monotone apart from the diagonal
    a[np.arange(0, n, 3), np.arange(0, n, 3)] = value
    active = np.arange(n) % 2 == 0
    impulse = np.where(active, rng.integers(1, 5, n), 0).astype(float)
    if kind == "negligible":
        impulse[::3] = 0.0  # 2^-60 times an integer would not be exact in b
        active[::3] = False
    slack = np.where(active, 0, rng.integers(1, 5, n)).astype(float)
    problem = Problem.lcp(a, a @ impulse - slack)  # exact: small integers
    return Draft(
        problem,
        f"{kind} diagonal entries: legal, and a sweep has nothing to divide by",
        lambda: Reference(impulse, "made from it, in integers", "error"),
        "solvers that cannot take it refuse, or say that they did not converge",
    )


@family()
def units(kg: float = 1e12, m: float = 1.0, s: float = 1.0, n: int = 5) -> Draft:
    """The box stack in other units: masses times kg, lengths times m, times times s. No relative error may move."""
    positive(kg=kg, m=m, s=s)
    at_least(1, n=n)
    k = np.arange(n)
    bodies = Bodies(np.stack([0.0 * k, 0.0 * k, 0.5 + k], 1), 1.0, BOX)
    contacts = manifold(np.stack([k - 1, k], 1), np.stack([0.0 * k, 0.0 * k, k], 1), 0.5)
    arm_a, arm_b = contacts.arms(bodies.position)
    speed = np.repeat([m / s, 1.0 / s], 3)
    rows = Rows(
        1.0 / (bodies.mass * kg),
        np.eye(3) / (BOX * kg * m * m) * np.ones((n, 1, 1)),
        bodies.v_free * speed,
        normal=contacts.normal,
        tangent=contacts.tangent(),
        arm_a=arm_a * m,
        arm_b=arm_b * m,
        contact_body=contacts.body,
    )
    problem = Problem.from_rows(rows)

    def closed_form() -> Reference:
        load = FALL * kg * m / s * (n - k)
        return Reference(np.repeat(0.25 * load, 4), "closed form: the weight above", "slack")

    return Draft(problem, "tolerances with a hidden unit show", closed_form)


@family()
def denormals(n: int = 8) -> Draft:
    """A stack whose speeds are denormal numbers: lambda_i = (n - i) 2^-1060, exactly."""
    at_least(1, n=n)
    a = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    a[0, 0] = 1.0
    b = np.zeros(n)
    b[0] = 2.0**-1060
    problem = Problem.lcp(a, b)
    return Draft(
        problem,
        "squares underflow to zero, so a careless norm calls anything a solution",
        lambda: Reference(np.arange(n, 0, -1.0) * 2.0**-1060, "exact"),
    )


@family()
def degenerate_lcp(n: int = 40, seed: int = 0, asymmetric: int = 0) -> Draft:
    """A random P-matrix LCP, a third of whose rows have lambda = w = 0; in small integers, so exact."""
    at_least(1, n=n)
    rng = np.random.default_rng(seed)
    g = rng.integers(-2, 3, (n, n + 2)).astype(float)
    a = g @ g.T + np.eye(n)
    if asymmetric:
        skew = np.triu(rng.integers(-3, 4, (n, n)), 1).astype(float)
        a += skew - skew.T
    state = rng.integers(0, 3, n)  # 0 carries, 1 separates, 2 touches
    impulse = np.where(state == 0, rng.integers(1, 9, n), 0).astype(float)
    slack = np.where(state == 1, rng.integers(1, 9, n), 0).astype(float)
    problem = Problem.lcp(a, a @ impulse - slack)
    return Draft(
        problem,
        "rows that touch without pressing: active sets flicker, strict complementarity fails",
        lambda: Reference(impulse, "made from it, in integers"),
    )


@family()
def infeasible(kind: str = "squeeze") -> Draft:
    """No solution: "squeeze" drives floor and ceiling through a body; "joints" holds one row at two speeds.

    y with A y = 0 and b.y > 0 proves it: the two rows pull the body apart without moving it.
    """
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    if kind == "squeeze":
        contacts = Contacts([[-1, 0], [-1, 0]], np.zeros((2, 3)), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
        problem = contact_problem(bodies, contacts, target=0.1)
        proof = np.array([1.0, 1.0])
    elif kind == "joints":
        jac = np.zeros((2, 12))
        jac[:, 8] = 1.0
        problem = joint_problem(
            bodies, [[-1, 0], [-1, 0]], jac, 1, target=[0.2, -0.2], names=["lift", "lower"]
        )
        proof = np.array([1.0, -1.0])
    else:
        raise InputError(f"kind is {kind!r}; squeeze, joints are known")
    return Draft(
        problem,
        "no impulse does it: CONVERGED would be a lie, INFEASIBLE needs a proof",
        lambda: Reference(None, "A y = 0, b.y > 0", "nothing", certificate=proof),
        "INFEASIBLE with a certificate, or any honest status but CONVERGED",
    )


__all__ = [
    "SET",
    "anisotropic",
    "arch",
    "big_box",
    "card_house",
    "contact_states",
    "degenerate_lcp",
    "denormals",
    "diagonal",
    "duplicated",
    "four_bar",
    "infeasible",
    "near_parallel",
    "painleve",
    "painleve_solutions",
    "ramp",
    "ring",
    "slab",
    "slider",
    "threshold",
    "units",
    "wedge",
]
