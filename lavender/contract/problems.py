"""The twelve problems on which a solver is checked. A solver has to solve each of them that it accepts."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace

import numpy as np

from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.problem.row_builder import RowBuilder

INFEASIBLE = "a row that no impulse can satisfy"  # Name of the problem without a solution.
SOLVABLE = 10  # The first ten problems have rows and a solution.


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


@functools.cache
def make_problems() -> dict[str, Problem]:
    """Return the twelve problems by their description."""
    rng = np.random.default_rng(1)
    roots = (rng.normal(size=(m, m + 2)) for m in (6, 9))
    six, nine = (g @ g.T / len(g) + 0.5 * np.eye(len(g)) for g in roots)  # definite
    islands = np.zeros((12, 12))
    islands[:6, :6], islands[6:, 6:] = six, 2.0 * np.eye(6)  # Sweeps solve the second one at once.
    skew, b = np.triu(rng.normal(size=(6, 6)), 1), rng.normal(size=6)
    # Eigenvalues near 4 (1 +- 0.9 i): the error of Gauss-Seidel shrinks by 0.81; solvers for a symmetric A fail.
    turning = 4.0 * np.kron(np.eye(3), [[1.0, 0.9], [-0.9, 1.0]]) + 0.1 * (skew - 0.5 * skew.T)
    ends = np.array([1.0, -1.0, 0.0, 0.0, 1.0, -1.0])  # N s: four rows end at a bound.
    robot = Problem.from_jacobian(
        rng.normal(size=(11, 9)), nine, rng.normal(size=9), target=rng.normal(size=11), compliance=np.full(11, 0.2),
        cones=Cones.bounded([0.0, -0.2], [np.inf, 0.2]) + Cones.contacts([0.2, 0.5, 0.9]), friction="cone",
    )  # fmt: skip
    return {
        "free rows of a chain of bodies": make_bodies(joints=True),
        "a stack of boxes without friction": make_bodies(joints=False),
        "rows with both bounds active": Problem.lcp(
            six, six @ (ends + 0.3 * (ends == 0.0)) + ends, -1.0, 1.0
        ),
        "two islands whose b differ by 1e6": Problem.lcp(islands, np.concatenate([b, 1e6 * b])),
        "a diagonal A": Problem.lcp(np.diag([1.0, 2.0, 4.0]), [1.0, -1.0, 3.0]),
        "an asymmetric A": Problem.lcp(turning, 4.0 * b, -0.5, 2.0),
        "contacts in a matrix, law coulomb": Problem.contact(nine, rng.normal(size=9), [0.3, 0.6, 1.2]),
        "a stack of boxes, law coulomb": make_bodies(joints=False, mu=0.5),
        "a stack of boxes, law cone": make_bodies(joints=False, friction="cone", mu=0.5),
        "J and M of a robot, law cone": robot,
        "no rows": Problem.lcp(np.zeros((0, 0)), []),
        INFEASIBLE: Problem.lcp(np.diag([1.0, 0.0]), [1.0, 1.0], name=INFEASIBLE),
    }
