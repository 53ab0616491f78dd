"""The matrix H = D^-1/2 A D^-1/2 of the scaled problem and its Newton systems, in two forms.

`VelocitySystem` keeps H = K K^T + theta as K, without forming H, and factors over the bodies. `MatrixSystem` stores H,
dense or in compressed rows. The equations and the methods that use them are in `lavender_ext/newton/`.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

from lavender.base.arrays import IntArray
from lavender.base.lu import splu
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.solvers.factors import USE_WIDE_LANES
from lavender.solvers.newton_systems.augmented import AugmentedSystem
from lavender_ext.factor import graph
from lavender_ext.newton.solve import Layout, Solve, compute_body_jacobian, list_element_blocks


class Bodies(NamedTuple):
    """The bodies of a problem.

    Parameters
    ----------
    pair : (n_blocks, 2) int32
        Bodies of each block; -1 for a static or missing body.
    n : int
        Number of bodies.
    column : (nv,) int32, optional
        For J and M: 6 times the body of each velocity, plus its index in the body.
    """

    pair: IntArray
    n: int
    column: IntArray | None = None


def find_bodies(problem: Problem) -> Bodies | None:
    """Return the bodies of a problem, or None if it has no bodies.

    For J and M these are free rigid bodies, of which every block must couple at most two.
    """
    if problem.rows is not None:
        return (
            Bodies(problem.rows.moving_block_bodies, problem.rows.n_bodies) if problem.rows.n_bodies else None
        )
    if problem.generalized is None or problem.cones._blocks.has_round:
        return None
    parts = graph.find_bodies_of_velocities(problem.metric, problem.generalized.order)
    return None if parts is None else Bodies(*parts)


class System:
    """H of a scaled problem, and the compiled Newton method on it."""

    form = ""
    work = 0.0  # Multiply-adds of one factorisation.
    factor_seconds = 0.0  # Upper bound of the time of a factorisation [s], on machines of the last ten years.
    dense = False  # Whether A is stored as a full matrix.
    entries = 0.0  # Number of entries of A.
    solve: Solve


class VelocitySystem(System):
    """H = K K^T + theta over the bodies, with one block column of s unknowns for each body."""

    form = "velocity"

    def __init__(self, problem: Problem, bodies: Bodies, like: System | None = None) -> None:
        """Build the system; the layout of an earlier system `like` between the same bodies is reused."""
        data = problem.metric
        panel, columns = compute_body_jacobian(data, bodies.pair, bodies.column)
        structure = bodies.pair[list_element_blocks(data)], bodies.n, len(columns)
        reused = like.layout if isinstance(like, VelocitySystem) and like.layout.serves(*structure) else None
        self.layout: Layout = reused or Layout(*structure)
        self.work = self.layout.work
        self.factor_seconds = 0.5e-9 * self.work
        augmented = partial(AugmentedSystem, problem, self.layout, bodies)
        self.solve = Solve.over_bodies(
            data, panel, columns, self.layout, problem.law == "coulomb", USE_WIDE_LANES, augmented
        )


class MatrixSystem(System):
    """H stored as a matrix, dense or in compressed rows."""

    form = "impulse"

    def __init__(self, problem: Problem, may_be_dense: bool = True) -> None:
        matrix, symmetric = problem.csr_data, problem.is_symmetric
        solve = self.solve = Solve.over_rows(
            problem.metric, matrix, symmetric, USE_WIDE_LANES, splu, may_be_dense
        )
        self.dense = solve.is_dense
        if self.dense:
            self.work = solve.m**3 / 3.0  # As `costs.count_dense_work`.
        else:
            self.work = (1.0 if symmetric else 2.0) * solve.work
            self.entries = float(solve.entries)
        self.factor_seconds = (0.3e-9 if self.dense else 1e-9) * self.work


def make_system(
    problem: Problem, form: str, like: System | None = None, bodies: Bodies | None = None
) -> System:
    """Build the Newton system of a problem.

    Parameters
    ----------
    problem : Problem
    form : {"velocity", "impulse"}
        Over the bodies, or over the rows of A.
    like : System, optional
        System of a problem of the same structure, whose layout may be reused.
    bodies : Bodies, optional
        Default: `find_bodies`.
    """
    if problem.metric.reference_energy < 0.0:
        get_zero_impulse_reference(problem)
    if form == "impulse":
        return MatrixSystem(problem)
    bodies = bodies or find_bodies(problem)
    assert bodies is not None
    return VelocitySystem(problem, bodies, like)
