"""Hard cases: each takes one property to its extreme, with a reference that does not depend on a solver.

References are closed forms, exact integers, or stored solutions (`lavender.suite.case.load_references`). If none
is known (sliding at large mass ratios), `reference` is None and only the judge assesses answers. `SET` lists the cases
of `lavender report @hard`.
"""

from __future__ import annotations

import math

import numpy as np

from lavender.base.errors import InputError
from lavender.problem import Problem
from lavender.problem.rows import Rows
from lavender.suite.build import (
    FALL_SPEED,
    Bodies,
    Contacts,
    add_horizontal_velocity,
    build_contact_problem,
    build_joint_problem,
    map_scalar,
    place_corner_contacts,
    place_tower,
)
from lavender.suite.case import Draft, Reference, register_family
from lavender.suite.families import (
    BOX,
    FRICTION_COEFFICIENT,
    SPHERE,
    check_min_sizes,
    check_positive,
    compute_ball_joint_jacobian,
    multiply_in_index_order,
)

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
    # Long paths from the ground to the load.
    "stack(n=10)",
    "stack(n=100)",
    "stack(n=1000)",
    "chain(n=1000)",
    "hang(n=100)",
    "hang(n=1000)",
    "hang(n=10000)",
    # Redundancy.
    *(f"duplicated(k={k})" for k in (2, 3, 8, 64)),
    *(f"slab(n={n})" for n in (2, 5, 10)),
    *(f"slabF(n={n}, sliding=0.5)" for n in (2, 10)),
    "four_bar",
    "ring(n=8)",
    "ring(n=64)",
    # Geometry.
    *(f"near_parallel(angle={a})" for a in ("0.01", "1e-4", "1e-7", "1e-12")),
    *(f"wedge(angle={a})" for a in ("0.1", "1e-4", "1e-8")),
    # Friction.
    *(f"slider(mu={mu})" for mu in ("0", "1e-12", "0.3", "1", "10")),
    *(f"slider(mu={mu}, friction=cone)" for mu in ("0.3", "10")),
    *(f"ramp(angle={a})" for a in ("20", "30")),
    "threshold",
    "threshold(above=1e-9)",
    "threshold(above=-1e-9)",
    *(f"anisotropic(ratio={r}, speed={s})" for r in ("10", "100", "1e6") for s in ("0.1", "3")),
    "painleve",
    "painleve(slide=0.5)",
    "arch",
    "arch(n=25)",
    "card_house",
    "card_house(levels=5)",
    "stackF(n=10, sliding=0.5)",
    "box_stackF(n=10, sliding=0.5)",
    "pyramidF(k=6, sliding=0.5)",
    "pyramidF(k=6, mass_ratio=1e3, sliding=0.5)",
    "pyramidF(k=6, mass_ratio=1e6, sliding=0.5)",
    "granularF(n=4, sliding=0.5)",
    "box_stackF(n=10, mass_ratio=1e6)",
    # Special numbers.
    *(f"diagonal(kind={k})" for k in ("zero", "negative", "negligible")),
    *(
        f"units(kg={k}, m={m}, s={s})"
        for k, m, s in (("1e12", 1, 1), ("1e-12", 1, 1), (1, "1e6", 1), (1, 1, "1e-6"))
    ),
    "least_speeds",
    *(f"degenerate_lcp(n={n})" for n in (8, 40)),
    "degenerate_lcp(n=40, asymmetric=1)",
    *(f"random_spd(n=60, condition={c})" for c in ("100", "1e8", "1e14")),
    "infeasible(kind=squeeze)",
    "infeasible(kind=joints)",
)


# -- mass ratios and redundancy -------------------------------------------------------------------


@register_family(big_boxF={"friction": "coulomb"})
def big_box(mass_ratio: float = 400.0, friction: str = "none", sliding: float = 0.0) -> Draft:
    """A 20 m box on two 1 m boxes, four points each: heavy on light with long levers.

    400 is the ratio of equal density in a plane.
    """
    check_positive(mass_ratio=mass_ratio)
    bodies = Bodies(
        [[-5.0, 0.0, 0.5], [5.0, 0.0, 0.5], [0.0, 0.0, 11.0]], [1.0, 1.0, mass_ratio], BOX
    )
    bodies.inertia[2] *= 400.0
    add_horizontal_velocity(bodies, sliding)
    pairs = [[-1, 0], [-1, 1], [0, 2], [1, 2]]
    centre = [[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0], [-5.0, 0.0, 1.0], [5.0, 0.0, 1.0]]
    problem = build_contact_problem(
        bodies, place_corner_contacts(pairs, centre, 0.5), friction, FRICTION_COEFFICIENT
    )
    return Draft(problem, "heavy on light with levers of ten metres")


@register_family()
def duplicated(k: int = 8) -> Draft:
    """One sphere on the ground with its contact repeated k times: rank 1.

    Undamped Jacobi has the factor k - 1: it cycles for k = 2 and diverges for k of 3 and more.
    """
    check_min_sizes(1, k=k)
    bodies = Bodies([[0.0, 0.0, 0.5]], 1.0, SPHERE)
    contacts = Contacts(np.tile([-1, 0], (k, 1)), np.zeros((k, 3)), [0.0, 0.0, 1.0])
    problem = build_contact_problem(bodies, contacts)
    return Draft(
        problem,
        "the same row many times: Jacobi diverges unless damped, A has rank 1",
        lambda: Reference(np.full(k, FALL_SPEED / k), "closed form: the weight, shared", "slack"),
    )


@register_family(slabF={"friction": "coulomb"})
def slab(n: int = 5, friction: str = "none", sliding: float = 0.0) -> Draft:
    """A slab of 10 kg on n x n points: rank 3 (6 with friction), however many points."""
    check_min_sizes(2, n=n)
    x = np.linspace(-1.0, 1.0, n)
    point = np.stack([*(g.ravel() for g in np.meshgrid(x, x)), np.zeros(n * n)], 1)
    bodies = Bodies([[0.1, 0.05, 0.2]], 10.0, 0.35)
    add_horizontal_velocity(bodies, sliding)
    problem = build_contact_problem(
        bodies,
        Contacts(np.tile([-1, 0], (n * n, 1)), point, [0.0, 0.0, 1.0]),
        friction,
        FRICTION_COEFFICIENT,
    )
    return Draft(problem, "a body on many points: only three of them are needed")


@register_family()
def four_bar(tilt: float = 0.3) -> Draft:
    """A closed loop: three bars and the ground, four parallel hinges of five rows, in a tilted plane.

    20 rows on 18 degrees of freedom with one remaining degree of freedom: rank 17. Trusting the pivots causes drift.
    """
    anchor = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 1.0], [1.4, 0.0, 1.3], [1.5, 0.0, 0.0]])
    c, s = math.cos(tilt), math.sin(tilt)
    # Rotation about z, then about x.
    rotation = np.array([[c, -s, 0.0], [c * s, c * c, -s], [s * s, s * c, c]])
    anchor = multiply_in_index_order(anchor, rotation.T)
    bodies = Bodies(0.5 * (anchor[1:] + anchor[:-1]), [1.0, 2.0, 1.0], 0.1)
    body = np.array([[-1, 0], [0, 1], [1, 2], [2, -1]])
    ball = compute_ball_joint_jacobian(bodies.position, body, anchor).reshape(4, 3, 12)
    # Perpendicular to the hinge axis y: omega_b - omega_a is zero along these.
    hinge_normals = rotation.T[[0, 2]]
    hinge_rows = np.zeros((4, 2, 12))
    for joint, (a, b) in enumerate(body):
        for row in range(2):
            if a >= 0:
                hinge_rows[joint, row, 3:6] = -hinge_normals[row]
            if b >= 0:
                hinge_rows[joint, row, 9:12] = hinge_normals[row]
    jac = np.concatenate([ball, hinge_rows], axis=1).reshape(-1, 12)
    problem = build_joint_problem(bodies, body, jac, 5, names=[f"hinge {i}" for i in range(4)])
    return Draft(
        problem,
        "a closed loop off the axes: consistent but singular, so a plain factorisation meets a zero pivot",
    )


@register_family()
def ring(n: int = 8) -> Draft:
    """A closed ring of n rods in a tilted circle, ball joints, hung at one point: a cycle of 3 n + 3 rows."""
    check_min_sizes(3, n=n)
    angle = 2.0 * np.pi * np.arange(n + 1) / n
    along = map_scalar(math.cos, angle)
    anchor = np.stack([map_scalar(math.sin, angle), 0.2 * along, -1.0 + along], 1)
    bodies = Bodies(0.5 * (anchor[1:] + anchor[:-1]), 1.0, 0.1)
    body = np.stack([np.arange(n) - 1, np.arange(n)], 1)
    body[0, 0] = n - 1
    body = np.concatenate([body, [[-1, 0]]])
    at = np.concatenate([anchor[:-1], [anchor[0]]])
    problem = build_joint_problem(
        bodies, body, compute_ball_joint_jacobian(bodies.position, body, at), 3
    )
    return Draft(problem, "a loop of joints: the band of the chain closes on itself")


# -- geometry -------------------------------------------------------------------------------------


@register_family()
def near_parallel(angle: float = 1e-4) -> Draft:
    """A point mass on two planes, normals 2 x `angle` [rad] apart: A = [[1, c], [c, 1]], c = cos 2 angle."""
    check_positive(angle=angle)
    problem = _build_mass_on_two_planes(math.sin(angle), math.cos(angle))
    # 1 - c^2 = 4 angle^2 amplifies the rounding of the normals.
    unique = "impulse" if angle > 1e-3 else "slack"
    load = np.full(2, 0.5 * FALL_SPEED / math.cos(angle))
    return Draft(
        problem,
        "two contacts that are almost one: A is singular to float64 below 1e-8",
        lambda: Reference(load, "closed form: symmetric", unique),
    )


@register_family()
def wedge(angle: float = 1e-4) -> Draft:
    """A point mass falls into a slot with two walls at `angle` [rad] from vertical: impulses 1 / (2 sin angle)."""
    check_positive(angle=angle)
    problem = _build_mass_on_two_planes(math.cos(angle), math.sin(angle))

    def closed_form() -> Reference:
        impulse = 0.5 * FALL_SPEED / problem.rows.normal[:, 2]  # type: ignore[union-attr]
        return Reference(impulse, "closed form: symmetric")

    return Draft(
        problem,
        "opposed walls: impulses a million times the weight, A nearly singular",
        closed_form,
    )


def _build_mass_on_two_planes(x: float, z: float) -> Problem:
    """Build a point mass on two planes with normals (x, 0, z) and (-x, 0, z)."""
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    contacts = Contacts([[-1, 0], [-1, 0]], np.zeros((2, 3)), [[x, 0.0, z], [-x, 0.0, z]])
    return build_contact_problem(bodies, contacts)


# -- numbers --------------------------------------------------------------------------------------


@register_family()
def diagonal(kind: str = "zero", n: int = 12) -> Draft:
    """An LCP with zero, negative or negligible diagonal entries, built from its solution in small integers.

    Sweeps divide by the largest entry of the row instead and need not converge; pivoting is not affected.
    """
    check_min_sizes(2, n=n)
    value = {"zero": 0.0, "negative": -1.0, "negligible": 2.0**-60}.get(kind)
    if value is None:
        raise InputError(f"kind is {kind!r}; zero, negative or negligible is needed")
    rng = np.random.default_rng(2)
    a = rng.integers(-3, 4, (n, n)).astype(float)
    # The off-diagonal part is skew: A is monotone except for the diagonal.
    a = np.triu(a, 1) - np.triu(a, 1).T + np.diag(np.full(n, 4.0))
    a[np.arange(0, n, 3), np.arange(0, n, 3)] = value
    active = np.arange(n) % 2 == 0
    impulse = np.where(active, rng.integers(1, 5, n), 0).astype(float)
    if kind == "negligible":
        impulse[::3] = 0.0  # 2^-60 times an integer would not be exact in b
        active[::3] = False
    slack = np.where(active, 0, rng.integers(1, 5, n)).astype(float)
    problem = Problem.lcp(
        a, a @ impulse - slack
    )  # The product is exact: the numbers are small integers.
    return Draft(
        problem,
        f"{kind} diagonal entries: legal, but a sweep cannot divide by them",
        lambda: Reference(impulse, "built from it, in integers", "error"),
    )


@register_family()
def units(kg: float = 1e12, m: float = 1.0, s: float = 1.0, n: int = 5) -> Draft:
    """The box stack in other units, masses times kg, lengths times m, times times s: relative errors stay."""
    check_positive(kg=kg, m=m, s=s)
    check_min_sizes(1, n=n)
    position, pairs, contact_point = place_tower(n)
    bodies = Bodies(position, 1.0, BOX)
    contacts = place_corner_contacts(pairs, contact_point, 0.5)
    arm_a, arm_b = contacts.compute_arms(bodies.position)
    speed = np.repeat([m / s, 1.0 / s], 3)
    rows = Rows(
        1.0 / (bodies.mass * kg),
        np.eye(3) / (BOX * kg * m * m) * np.ones((n, 1, 1)),
        bodies.v_free * speed,
        normal=contacts.normal,
        tangent=contacts.compute_tangents(),
        arm_a=arm_a * m,
        arm_b=arm_b * m,
        contact_body=contacts.body,
    )
    problem = Problem.from_rows(rows)

    def closed_form() -> Reference:
        load = FALL_SPEED * kg * m / s * (n - np.arange(n))
        return Reference(np.repeat(0.25 * load, 4), "closed form: the weight above", "slack")  # pyright: ignore[reportArgumentType]

    return Draft(problem, "reveals tolerances with a hidden unit", closed_form)


@register_family()
def least_speeds(n: int = 8) -> Draft:
    """A stack with the smallest speeds that a problem may have: lambda_i = (n - i) 2^-199, exactly."""
    check_min_sizes(1, n=n)
    a = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    a[0, 0] = 1.0
    b = np.zeros(n)
    b[0] = 2.0**-199
    problem = Problem.lcp(a, b)
    return Draft(
        problem,
        "below every tolerance with a unit, so that an absolute norm accepts any answer",
        lambda: Reference(np.arange(n, 0, -1.0) * 2.0**-199, "exact"),
    )


@register_family()
def degenerate_lcp(n: int = 40, seed: int = 0, asymmetric: int = 0) -> Draft:
    """A random P-matrix LCP in small integers, hence exact; a third of its rows have lambda = w = 0."""
    check_min_sizes(1, n=n)
    rng = np.random.default_rng(seed)
    g = rng.integers(-2, 3, (n, n + 2)).astype(float)
    a = g @ g.T + np.eye(n)
    if asymmetric:
        skew = np.triu(rng.integers(-3, 4, (n, n)), 1).astype(float)
        a += skew - skew.T
    state = rng.integers(
        0, 3, n
    )  # 0: with an impulse, 1: separating, 2: touching without an impulse.
    impulse = np.where(state == 0, rng.integers(1, 9, n), 0).astype(float)
    slack = np.where(state == 1, rng.integers(1, 9, n), 0).astype(float)
    problem = Problem.lcp(a, a @ impulse - slack)
    return Draft(
        problem,
        "rows that touch without an impulse: active sets change often, strict complementarity fails",
        lambda: Reference(impulse, "built from it, in integers"),
    )


@register_family()
def infeasible(kind: str = "squeeze") -> Draft:
    """No solution: "squeeze" moves floor and ceiling through a body; "joints" prescribes two speeds for one row.

    y with A y = 0 and b.y > 0 proves it: the two rows pull the body apart without moving it.
    """
    bodies = Bodies([[0.0, 0.0, 0.0]], 1.0, 0.0)
    if kind == "squeeze":
        contacts = Contacts(
            [[-1, 0], [-1, 0]], np.zeros((2, 3)), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
        )
        problem = build_contact_problem(bodies, contacts, target=0.1)
        proof = np.array([1.0, 1.0])
    elif kind == "joints":
        jac = np.zeros((2, 12))
        jac[:, 8] = 1.0
        problem = build_joint_problem(
            bodies, [[-1, 0], [-1, 0]], jac, 1, target=[0.2, -0.2], names=["lift", "lower"]
        )
        proof = np.array([1.0, -1.0])
    else:
        raise InputError(f"kind is {kind!r}; squeeze or joints is needed")
    return Draft(
        problem,
        "no impulse satisfies it: CONVERGED would be wrong, INFEASIBLE needs a proof",
        lambda: Reference(None, "A y = 0, b.y > 0", "nothing", certificate=proof),
    )
