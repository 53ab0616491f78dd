"""The problems on which a solver is checked.

A solver has to solve each of the first that it accepts: one for each law, form and kind of block, and four larger ones.
Others have no solution, islands without a solution next to others, or an ill-conditioned mass matrix.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import sparse as sp
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.generalized import Generalized
from lavender.problem.row_builder import RowBuilder

INFEASIBLE = "a row that no impulse can satisfy"  # Name of the problem without a solution.
EMPTY = "no rows"
#: Number of contacts and of bounded rows of the larger problems.
LARGE_CONTACTS, LARGE_ROWS = 20, 60
BALLS = 10  # Islands of a jammed problem that have a solution: its first ones.
N_OPPOSED = 6  # Number of drawn problems with opposed limits, in each form.


def make_bodies(joints: bool, friction: str = "coulomb", mu: float = 0.0) -> Problem:
    """Return three moving bodies of 1 kg, 8 kg and 1 kg, joined in a chain or stacked as boxes, with compliance."""
    velocity = np.outer([1.0, -2.0, 1.5], [0.3, 0.1, -0.4, 0.2, 0.1, -0.1])
    height = np.outer([0.5, 1.5, 2.5], [0.0, 0.0, 1.0])
    inertia = np.multiply.outer([6.0, 0.75, 6.0], np.eye(3))
    builder = RowBuilder([1.0, 0.125, 1.0], inertia, velocity, 0.01, height)
    for body, corner in itertools.product(range(3), itertools.product((-0.5, 0.5), repeat=2)):
        if not joints:
            builder.contact(body - 1, body, (*corner, float(body)), (0.0, 0.0, 1.0), mu=mu)
        elif corner == (0.5, 0.5):
            builder.ball(body - 1, body, (*corner, float(body)))
    problem = builder.problem(friction)
    return replace(problem, compliance=np.full(problem.m, 0.3))


def make_matrix(rng: np.random.Generator, m: int) -> FloatArray:
    """Draw a symmetric positive definite matrix (m, m) [1/kg]."""
    g = rng.normal(size=(m, m + 2))
    return g @ g.T / m + 0.5 * np.eye(m)


def make_contacts(
    rng: np.random.Generator, size: int, friction: str = "coulomb", count: int = 4, **options: Any
) -> Problem:
    """Draw contacts of `size` rows in a matrix: most are pressed on and slide, with coefficients below and above 1."""
    b = 6.0 * rng.normal(size=(count, size))
    b[:, 0] = np.where(np.arange(count) % 4 == 3, -1.0, 1.0) * rng.uniform(4.0, 9.0, count)
    mu = np.resize([0.3, 1.7, 0.6, 0.9], count)
    return Problem.contact(
        make_matrix(rng, count * size), b.ravel(), mu, friction=friction, **options
    )


def make_kinds_of_blocks() -> dict[str, Problem]:
    """Return a problem for each kind of block under each law that has it."""
    rng = np.random.default_rng(2)
    lower = [0.5, -2.0, 0.3, -np.inf, -1.0, 0.4]
    upper = [np.inf, -0.5, 0.8, 0.2, np.inf, 0.4]
    problems = {
        "bounds that exclude zero": Problem.lcp(
            make_matrix(rng, 6), 2.0 * rng.normal(size=6), lower, upper
        ),
    }
    patch = [0.2, 0.5, 0.1, 0.3]
    rolling = [0.1, 0.05, 0.3, 0.1]
    four = np.array([0.3, 1.7, 0.6, 0.9])
    for law in ("coulomb", "cone"):
        kinds = {
            "planar contacts": make_contacts(rng, 2, law, tangents=1),
            "contacts with two tangents": make_contacts(rng, 3, law),
            "contacts that turn": make_contacts(rng, 4, law, patch_radius=patch),
            "contacts that roll": make_contacts(rng, 5, law, rolling=rolling),
            "contacts that turn and roll": make_contacts(
                rng, 6, law, patch_radius=patch, rolling=rolling
            ),
        }
        plain = make_contacts(rng, 3, law)
        shapes = {
            "contacts with friction boxes": Cones.contacts(
                np.stack([four, 0.4 * four], 1), shape="box"
            ),
            "contacts with friction ellipses": Cones.contacts(np.stack([four, 0.4 * four], 1)),
            "a contact without friction and a free row": Cones.contacts([0.0, 0.5, 1.2])
            + Cones.free(1)
            + Cones.bounded([-0.1, 0.0], [0.1, np.inf]),
        }
        kinds |= {name: replace(plain, cones=cones) for name, cones in shapes.items()}
        problems |= {f"{name}, law {law}": problem for name, problem in kinds.items()}
    jac = rng.normal(size=(20, 12))
    mass = make_matrix(rng, 12)
    cones = Cones.contacts(four, tangents=4)
    problems["round cones of four tangents, law cone"] = Problem.from_jacobian(
        jac, mass, -2.0 * rng.random(12), cones=cones, friction="cone", compliance=np.full(20, 0.3)
    )
    problems["contacts and bounded rows of J and M, law coulomb"] = Problem.from_jacobian(
        jac[:12],
        mass,
        3.0 * rng.normal(size=12),
        cones=Cones.bounded(lower, upper) + Cones.contacts([0.5, 1.5]),
        compliance=np.full(12, 0.2),
    )
    bodies = make_bodies(joints=False, mu=0.5).rows
    assert bodies is not None
    for name, options in (
        ("turn and roll", {"patch_radius": 0.1, "rolling": 0.05}),
        ("have friction boxes", {"shape": "box"}),
    ):
        stack = Problem.from_rows(bodies, 0.0, mu=0.5, compliance=0.3, **options)
        problems[f"contacts of bodies that {name}, law coulomb"] = stack
    sparse = sp.csr_array(
        np.kron(np.eye(3), make_matrix(rng, 4)) + 0.2 * (np.eye(12, k=4) + np.eye(12, k=-4))
    )
    problems["a sparse A"] = Problem.lcp(sparse, 3.0 * rng.normal(size=12), -1.0, 1.0)
    problems["a singular quadratic program"] = Problem.from_qp(
        np.diag([1.0, 0.0]),
        [-1.0, 1.0],
        np.array([[1.0, 1.0]]),
        [2.0],
        lb=[0.0, 0.0],
        ub=[3.0, 3.0],
    )
    return problems


def make_large_problems() -> dict[str, Problem]:
    """Return a larger problem of each law, for claims at several tolerances."""
    rng = np.random.default_rng(3)
    a = make_matrix(rng, LARGE_ROWS)
    b = rng.normal(size=LARGE_ROWS)
    return {
        f"{LARGE_ROWS} free rows": Problem.linear(a, b),
        f"{LARGE_ROWS} bounded rows": Problem.lcp(
            a, b, -0.5, np.where(np.arange(LARGE_ROWS) % 2, 0.5, np.inf)
        ),
        f"{LARGE_CONTACTS} contacts, law coulomb": make_contacts(rng, 3, "coulomb", LARGE_CONTACTS),
        f"{LARGE_CONTACTS} contacts, law cone": make_contacts(rng, 3, "cone", LARGE_CONTACTS),
    }


def make_unsolvable_problems() -> dict[str, Problem]:
    """Return problems without a solution: opposed limits, a b outside the range of A, and contacts along one ray."""
    problems: dict[str, Problem] = {}
    for seed in range(N_OPPOSED):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 5))
        limit = rng.normal(size=(1, n))
        jac = np.vstack([rng.normal(size=(2, n)), limit, -limit])
        target = [0.0, 0.0, 5.0, 5.0]
        cones = Cones.bounded(np.zeros(4), np.full(4, np.inf))
        general = Problem.from_jacobian(
            jac, np.eye(n), rng.normal(size=n), target=target, cones=cones
        )
        problems[f"opposed limits {seed}, of J and M"] = general
        problems[f"opposed limits {seed}, in a matrix"] = Problem.lcp(jac @ jac.T, general.b)
    problems["b outside the range of A"] = Problem.lcp(
        [[1.0, -3.0], [-3.0, 9.0]], [1.0, 0.0], [-2.0, -np.inf]
    )
    pulls = {
        "sweeps whose impulses grow": ([-0.1, 2.6, 0.7, 1.4], [1.5, 0.0, -1.6, -0.1], [0.8, 0.5]),
        "rows that all pull": ([-0.2, -0.7, 0.6, 2.0], [0.2, -1.1, 1.4, -1.9], [0.3, 0.6]),
    }
    for name, (ray, b, mu) in pulls.items():
        problems[name] = Problem.contact(np.outer(ray, ray), b, mu)
    return problems


def make_jammed_problems() -> dict[str, Problem]:
    """Return `BALLS` islands with a solution, and next to them bodies with two rows that contradict each other."""
    free = Cones.free(2)
    limits = Cones.bounded([0.0, 0.0], [np.inf, np.inf])
    jams = {
        "motors": ([1.0, 1.0], [1.0, -1.0], free, 5),
        "limits": ([1.0, -1.0], [1.0, 1.0], limits, 1),
        "nearly equal rows": ([1.0, 1.0 + 1e-9], [1.0, -1.0], free, 1),
        "an empty row": ([1.0, 0.0], [1.0, 1.0], free, 1),
    }
    kinds: dict[str, tuple[Cones, list[float], str]] = {
        "free rows": (Cones.free(1), [-0.1635], "coulomb"),
        "limits": (Cones.bounded([0.0], [np.inf]), [-0.1635], "coulomb"),
        "contacts, law coulomb": (Cones.contacts(0.5, count=1), [-0.1635, 0.3, 0.0], "coulomb"),
        "contacts, law cone": (Cones.contacts(0.5, count=1), [-0.1635, 0.3, 0.0], "cone"),
    }
    problems: dict[str, Problem] = {}
    for (kind, (ball, velocity, friction)), (
        name,
        (rows, target, pair, count),
    ) in itertools.product(kinds.items(), jams.items()):
        m = n = len(velocity) * BALLS
        jac = np.zeros((m + 2 * count, n + count))
        jac[:m, :n] = np.eye(n)
        cones = ball
        for _ in range(BALLS - 1):
            cones = cones + ball
        for k in range(count):
            jac[m + 2 * k : m + 2 * k + 2, n + k] = rows
            cones = cones + pair
        v_free = np.r_[np.tile(velocity, BALLS), np.zeros(count)]
        targets = [0.0] * m + target * count
        general = Problem.from_jacobian(
            jac, np.eye(n + count), v_free, target=targets, cones=cones, friction=friction
        )
        problems[f"{BALLS} {kind} next to jammed {name}, of J and M"] = general
        matrix = Problem(general.b, cones, jac @ jac.T, friction=friction)
        problems[f"{BALLS} {kind} next to jammed {name}, in a matrix"] = matrix
    return problems


def make_ill_conditioned_problems() -> dict[str, Problem]:
    """Return problems of J and an M of condition 1e10, whose residual float64 loses above a tolerance of 1e-9."""
    problems: dict[str, Problem] = {}
    kinds = {
        "free rows": (Cones.free(4), "coulomb"),
        "limits": (Cones.bounded(np.zeros(5), np.full(5, np.inf)), "coulomb"),
        "contacts, law coulomb": (Cones.contacts([0.3, 0.7], 2), "coulomb"),
        "contacts, law cone": (Cones.contacts([0.3, 0.7], 2), "cone"),
    }
    for kind, (cones, friction) in kinds.items():
        rng = np.random.default_rng(1)
        basis, _ = np.linalg.qr(rng.normal(size=(8, 8)))
        mass = basis @ np.diag(np.geomspace(1.0, 1e10, 8)) @ basis.T
        jac = rng.normal(size=(cones.n_rows, 8))
        problems[f"{kind} of an ill-conditioned mass matrix"] = Problem.from_jacobian(
            jac, 0.5 * (mass + mass.T), rng.normal(size=8), cones=cones, friction=friction
        )
    return problems


#: Problems that not all checks use, by the word of `Check.problems`.
GROUPS = {
    "large": make_large_problems,
    "unsolvable": make_unsolvable_problems,
    "jammed": make_jammed_problems,
    "ill-conditioned": make_ill_conditioned_problems,
}


def change_numbers(problem: Problem) -> Problem:
    """Return a problem of the same structure with another A, b, bounds and coefficients."""
    cones, m = problem.cones, problem.m
    scale = 1.0 + 0.3 * np.sin(np.arange(1.0, m + 1.0))
    is_ratio = cones.is_box | (cones.has_ellipse & (cones.spin_rows < 0))
    cones = replace(
        cones,
        lower=1.5 * cones.lower,
        upper=1.5 * cones.upper,
        mu=0.7 * cones.mu,
        rolling=0.7 * cones.rolling,
        patch_radius=np.where(is_ratio, 1.0, 0.7) * cones.patch_radius,
    )
    more: dict[str, Any] = {"cones": cones, "b": 1.25 * problem.b + 0.01 * (problem.m > 0)}
    if problem.generalized is not None:
        general = problem.generalized
        rows = sp.diags_array(scale) @ general.jac
        more["generalized"] = Generalized(rows, 1.5 * general.mass, general.v_free, general.names)
    elif problem.rows is not None:
        bodies = problem.rows
        weight = 1.0 + 0.3 * np.sin(np.arange(1.0, bodies.n_bodies + 1.0))
        inertia = weight[:, None, None] * bodies.inv_inertia
        more["rows"] = replace(bodies, inv_mass=1.5 * weight * bodies.inv_mass, inv_inertia=inertia)
    else:
        matrix = problem.csr
        data = matrix.data * np.repeat(scale, np.diff(matrix.indptr)) * scale[matrix.indices]
        changed = sp.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)
        more["matrix"] = changed if isinstance(problem.matrix, sp.csr_array) else changed.toarray()
    return replace(problem, qp=None, **more)


@functools.cache
def make_problems() -> dict[str, Problem]:
    """Return all problems by their description."""
    rng = np.random.default_rng(1)
    roots = (rng.normal(size=(m, m + 2)) for m in (6, 9))
    six, nine = (g @ g.T / len(g) + 0.5 * np.eye(len(g)) for g in roots)  # definite
    islands = np.zeros((12, 12))
    islands[:6, :6] = six
    islands[6:, 6:] = 2.0 * np.eye(6)  # Sweeps solve the second one at once.
    skew = np.triu(rng.normal(size=(6, 6)), 1)
    b = rng.normal(size=6)
    # Eigenvalues near 4 (1 +- 0.9 i): the error of Gauss-Seidel shrinks by 0.81; solvers for a symmetric A fail.
    turning = 4.0 * np.kron(np.eye(3), [[1.0, 0.9], [-0.9, 1.0]]) + 0.1 * (skew - 0.5 * skew.T)
    ends = np.array([1.0, -1.0, 0.0, 0.0, 1.0, -1.0])  # N s: four rows end at a bound.
    robot = Problem.from_jacobian(
        rng.normal(size=(11, 9)),
        nine,
        rng.normal(size=9),
        target=rng.normal(size=11),
        compliance=np.full(11, 0.2),
        cones=Cones.bounded([0.0, -0.2], [np.inf, 0.2]) + Cones.contacts([0.2, 0.5, 0.9]),
        friction="cone",
    )
    return {
        "free rows of a chain of bodies": make_bodies(joints=True),
        "a stack of boxes without friction": make_bodies(joints=False),
        "rows with both bounds active": Problem.lcp(
            six, six @ (ends + 0.3 * (ends == 0.0)) + ends, -1.0, 1.0
        ),
        "two islands whose b differ by 1e6": Problem.lcp(islands, np.concatenate([b, 1e6 * b])),
        "a diagonal A": Problem.lcp(np.diag([1.0, 2.0, 4.0]), [1.0, -1.0, 3.0]),
        "an asymmetric A": Problem.lcp(turning, 4.0 * b, -0.5, 2.0),
        "contacts in a matrix, law coulomb": Problem.contact(
            nine, rng.normal(size=9), [0.3, 0.6, 1.2]
        ),
        "a stack of boxes, law coulomb": make_bodies(joints=False, mu=0.5),
        "a stack of boxes, law cone": make_bodies(joints=False, friction="cone", mu=0.5),
        "J and M of a robot, law cone": robot,
        **make_kinds_of_blocks(),
        EMPTY: Problem.lcp(np.zeros((0, 0)), []),
        INFEASIBLE: Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0], name=INFEASIBLE),
        **{name: problem for make in GROUPS.values() for name, problem in make().items()},
    }
