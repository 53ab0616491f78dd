"""Random problems for tests of solvers: joints and contacts of every kind, in every form of A.

The same seed gives the same problem on every machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.problem import Problem
from lavender.problem.cones import CONTACT_BOX, CONTACT_ELLIPSE, ROW, Cones
from lavender.problem.rows import Rows

__all__ = [
    "CONTACTS",
    "FORMS",
    "as_generalized",
    "as_matrix",
    "list_ancestors",
    "make_problem_with_other_numbers",
    "make_touching_bodies",
    "random_bodies_and_contacts",
    "random_box_friction_contacts",
    "random_contact_problem",
    "random_ellipse_friction_contacts",
    "random_generalized_problem",
    "random_lcp",
    "random_tree_mass",
    "random_tree_parents",
    "random_unit_vector",
    "rotation_matrix",
]


def rotation_matrix(q: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from body to world of a unit quaternion w, x, y, z."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def random_unit_vector(rng: np.random.Generator, n: int = 3) -> FloatArray:
    """Draw a unit vector (n,) with a uniformly distributed direction."""
    x = rng.normal(size=n)
    return x / np.linalg.norm(x)


def random_bodies_and_contacts(
    rng: np.random.Generator, bodies: int = 5, joints: int = 3, contacts: int = 8
) -> Rows:
    """Draw bodies of different masses, joints of 1 to 3 rows (some angular), and contacts; some touch the ground."""
    mass = rng.uniform(0.5, 3.0, bodies)
    inertia = [
        r @ np.diag(rng.uniform(5.0, 12.0, 3)) @ r.T / m
        for m, r in zip(mass, (rotation_matrix(random_unit_vector(rng, 4)) for _ in mass), strict=True)
    ]

    def draw_pair() -> tuple[int, int]:
        a, b = rng.choice(bodies, 2, replace=False)
        return (-1, b) if rng.random() < 0.4 else (a, b)

    sizes = rng.integers(1, 4, joints)
    ptr = np.concatenate([[0], np.cumsum(sizes)])
    joint_body = np.array([draw_pair() for _ in range(joints)], np.int32).reshape(-1, 2)
    jac = rng.normal(size=(ptr[-1], 12))
    if joints:
        # Make the first row of every other joint angular, by removing its linear part.
        jac[ptr[:-1][::2], :3] = jac[ptr[:-1][::2], 6:9] = 0.0
    jac[np.repeat(joint_body[:, 0], sizes) < 0, :6] = 0.0
    normal = np.array([random_unit_vector(rng) for _ in range(contacts)]).reshape(-1, 3)
    tangent = np.array([np.cross(n, random_unit_vector(rng)) for n in normal]).reshape(-1, 3)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return Rows(
        inv_mass=1.0 / mass,
        inv_inertia=np.array(inertia),
        v_free=rng.normal(size=(bodies, 6)),
        jac=jac,
        joint_ptr=ptr,
        joint_body=joint_body,
        normal=normal,
        tangent=tangent,
        arm_a=rng.normal(size=(contacts, 3)) * 0.5,
        arm_b=rng.normal(size=(contacts, 3)) * 0.5,
        contact_body=np.array([draw_pair() for _ in range(contacts)], np.int32).reshape(-1, 2),
    )


def make_touching_bodies(contact_body: Any, **fields: Any) -> Rows:
    """Build bodies at rest of 1 kg and 1 kg m^2 that touch at their centres along z.

    `fields` replaces fields of the resulting `Rows`.
    """
    body = np.reshape(contact_body, (-1, 2)).astype(np.int32)
    c, n = len(body), len(fields.get("inv_mass", range(body.max(initial=-1) + 1)))
    defaults = {
        "inv_mass": np.ones(n), "inv_inertia": np.tile(np.eye(3), (n, 1, 1)), "v_free": np.zeros((n, 6)),
        "normal": np.tile([0.0, 0.0, 1.0], (c, 1)), "tangent": np.tile([1.0, 0.0, 0.0], (c, 1)),
        "arm_a": np.zeros((c, 3)), "arm_b": np.zeros((c, 3)), "contact_body": body,
    }  # fmt: skip
    return Rows(**defaults | fields)


def random_contact_problem(
    seed: int,
    friction: str = "coulomb",
    tangents: int | None = None,
    spin: bool = True,
    rolling: bool = False,
    **sizes: int,
) -> Problem:
    """Draw a problem of bodies with free and bounded joint rows, and contacts.

    `tangents` is the number of tangents of each contact; None mixes 0, 1 and 2. `sizes` are the numbers of bodies,
    joints and contacts, as for `random_bodies_and_contacts`.
    """
    rng = np.random.default_rng(seed)
    rows = random_bodies_and_contacts(rng, **sizes)
    count: Any = 2 if rolling else tangents
    c, mj = rows.n_contacts, len(rows.jac)
    if count is None:
        count = rng.integers(0, 3, c)
    bounded = rng.random(mj) < 0.4
    high = np.where(bounded, rng.uniform(0.0, 0.5, mj), np.inf)
    m = mj + int(np.sum(np.broadcast_to(count, c))) + c * (1 + spin + 2 * rolling)
    return Problem.from_rows(
        rows,
        target=rng.normal(size=m) * 0.1,
        lower=-high,
        upper=high,
        mu=rng.uniform(0.0, 1.2, c) * (np.broadcast_to(count, c) > 0 if not spin else 1.0),
        tangents=count,
        patch_radius=rng.uniform(0.0, 0.4, c) if spin else None,
        rolling=rng.uniform(0.0, 0.3, c) * (rng.random(c) < 0.8) if rolling else None,
        friction=friction,
        compliance=rng.uniform(0.0, 0.2, m) * (rng.random(m) < 0.5),
        name=f"random {seed}",
    )


def as_matrix(problem: Problem) -> Problem:
    """Return the same problem with A as a sparse matrix."""
    return Problem(
        problem.b,
        problem.cones,
        problem.delassus(),
        friction=problem.friction,
        guess=problem.guess,
        name=problem.name,
    )


def as_generalized(problem: Problem) -> Problem:
    """Return the same problem of bodies as J and M."""
    assert problem.rows is not None
    minv, free = problem.rows.inverse_mass_matrix().toarray(), problem.rows.v_free.ravel()
    return Problem.from_jacobian(
        problem.jacobian, np.linalg.inv(minv), free, target=problem.b + problem.jacobian @ free,
        cones=problem.cones, compliance=problem.compliance, friction=problem.friction,
    )  # fmt: skip


def random_box_friction_contacts(seed: int, friction: str = "coulomb", **sizes: Any) -> Problem:
    """Draw joints, and contacts that bound each tangent separately; most have two coefficients."""
    base = random_contact_problem(seed, friction, tangents=2, spin=False, **sizes)
    c, rng = base.cones.shaped("box"), np.random.default_rng(seed + 7)
    radius = np.where(c.kind == CONTACT_BOX, rng.uniform(0.2, 3.0, c.n_blocks), 0.0)
    return replace(base, cones=replace(c, patch_radius=radius))


def random_ellipse_friction_contacts(seed: int, friction: str = "coulomb", **sizes: Any) -> Problem:
    """Draw the problem of `random_box_friction_contacts` with an ellipse instead of each box."""
    base = random_box_friction_contacts(seed, friction, **sizes)
    c = base.cones
    return replace(base, cones=replace(c, kind=np.where(c.kind == CONTACT_BOX, CONTACT_ELLIPSE, c.kind)))


#: Name of each form of A -> function that converts a problem of bodies to this form.
FORMS: dict[str, Callable[[Problem], Problem]] = {
    "rows": lambda problem: problem,
    "matrix": as_matrix,
    "J and M": as_generalized,
}
#: Kind of contact -> function (seed, friction, **sizes) that draws a problem of bodies with such contacts.
CONTACTS: dict[str, Callable[..., Problem]] = {
    "disks": partial(random_contact_problem, tangents=2, spin=False),
    "spin": random_contact_problem,
    "rolling": partial(random_contact_problem, spin=False, rolling=True),
    "rolling and spin": partial(random_contact_problem, rolling=True),
    "boxes": random_box_friction_contacts,
    "ellipses": random_ellipse_friction_contacts,
}


def make_problem_with_other_numbers(problem: Problem) -> Problem:
    """Return a problem of the same structure with other numbers, bounds and coefficients."""
    cones = problem.cones
    fixed = (np.arange(problem.m) % 3 == 0) & (np.repeat(cones.kind, np.diff(cones.ptr)) == ROW)
    mu = np.where(np.arange(problem.n_blocks) % 3 == 0, 0.0, cones.mu)
    lower, upper = (np.where(fixed, 0.0, x) for x in (cones.lower, cones.upper))
    other = replace(problem, b=problem.b * 1.25 + 0.01)
    changed = replace(other, cones=replace(cones, lower=lower, upper=upper, mu=mu))
    return changed if changed.law == problem.law and not cones.has_ellipse else other


def random_lcp(seed: int, m: int = 12, rank: int | None = None, boxed: bool = True) -> Problem:
    """Draw a bounded problem of m rows that has a solution, also if `rank` makes A singular."""
    rng = np.random.default_rng(seed)
    g = rng.normal(size=(m, rank or m + 2))
    high: Any = np.where(rng.random(m) < 0.5, rng.uniform(0.1, 1.0, m), np.inf) if boxed else np.inf
    # Choose b as a vector in the range of A minus a non-negative vector: the problem then has a solution even if A is
    # singular.
    a = g @ g.T
    return Problem.lcp(a, a @ rng.normal(size=m) - rng.uniform(0.0, 1.0, m), upper=high, name=f"lcp {seed}")


# -- generalized coordinates: kinematic trees, their mass matrices, rows on chains ------------------------


def random_tree_parents(rng: np.random.Generator, n: int) -> list[int]:
    """Draw the parents of n velocities that form about three trees; a root has -1, a parent precedes its children."""
    return [-1 if i == 0 or rng.random() < 3.0 / n else int(rng.integers(0, i)) for i in range(n)]


def random_tree_mass(rng: np.random.Generator, parent: Sequence[int]) -> FloatArray:
    """Draw a mass matrix (n, n) with a condition number near 1e2 that couples each velocity only to its ancestors."""
    n = len(parent)
    lower = np.eye(n)
    for i in range(n):
        a = parent[i]
        while a >= 0:
            lower[i, a] = rng.normal() * 0.4
            a = parent[a]
    return lower.T @ np.diag(rng.uniform(0.2, 3.0, n)) @ lower


def list_ancestors(parent: Sequence[int], i: int) -> list[int]:
    """Return the indices of velocity i and of all its ancestors, from i to the root."""
    chain = []
    while i >= 0:
        chain.append(i)
        i = parent[i]
    return chain


def random_generalized_problem(
    seed: int,
    friction: str = "cone",
    n: int = 14,
    compliance: bool = True,
    contacts: int = 5,
    tangents: int = 2,
    spin: bool = False,
) -> Problem:
    """Draw J and M of a random forest with free and bounded rows and contacts, each row on one or two chains."""
    rng = np.random.default_rng(seed)
    parent = random_tree_parents(rng, n)
    cones = Cones.free(2) + Cones.bounded(np.array([0.0, -0.3]), np.array([np.inf, 0.3]))
    radius: dict[str, Any] = {"patch_radius": rng.uniform(0.0, 0.4, contacts)} if spin else {}
    if contacts:
        cones = cones + Cones.contacts(rng.uniform(0.0, 1.2, contacts), tangents, **radius)
    jac = np.zeros((cones.n_rows, n))
    for first, last in zip(cones.ptr[:-1], cones.ptr[1:], strict=True):
        on = list_ancestors(parent, int(rng.integers(0, n))) + (
            list_ancestors(parent, int(rng.integers(0, n))) * (rng.random() < 0.5)
        )
        jac[first:last, sorted(set(on))] = rng.normal(size=(last - first, len(set(on))))
    m = cones.n_rows
    soft = rng.uniform(0.01, 0.3, m) if compliance else np.zeros(m)
    # Choose targets that some velocity exceeds by a margin, so that the problem without compliance has a solution.
    margin = np.zeros(m)
    margin[2:][cones.lower[2:] == 0.0] = 0.5
    return Problem.from_jacobian(
        jac, random_tree_mass(rng, parent), rng.normal(size=n), target=jac @ rng.normal(size=n) - margin, cones=cones,
        compliance=soft, friction=friction, name=f"general {seed}",
    )  # fmt: skip
