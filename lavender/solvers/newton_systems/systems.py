"""The matrix H = D^-1/2 A D^-1/2 of the scaled problem and its Newton systems, in two forms.

`VelocitySystem` keeps H = K K^T + theta as K, without forming H, and factors over the bodies. `MatrixSystem` stores H,
dense or in compressed rows. The equations and the methods that use them are in `lavender_ext/newton/`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lavender.base.arrays import IntArray
from lavender.base.deadline import Deadline
from lavender.base.lazy_import import sparse as sp
from lavender.base.lu import splu
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.solvers.factors import MAX_DENSE_ROWS, USE_WIDE_LANES
from lavender.solvers.newton_systems.augmented import AugmentedSystem
from lavender_ext.factor import graph
from lavender_ext.factor.linear import LinearSystem
from lavender_ext.factor.sparse import has_symmetric_pattern
from lavender_ext.newton.coupled import (
    copy_coupled_entries,
    find_element_graph,
    list_coupled_rows,
    scale_matrix_entries,
)
from lavender_ext.newton.solve import Layout, Solve

MAX_ALWAYS_DENSE_ROWS = 150  # Up to this many rows, a dense factor is faster than a sparse factor.
# If the fraction of nonzeros of A is larger, a dense factor is faster. For the cone law: a full block of s^1/2 m rows
# has the fraction s, and a multiply-add of a dense factor costs a quarter of a sparse one. The fraction is smaller for
# bounded rows, because dense factors contain only the free rows, and for Coulomb's law, because supernodal factors of
# its asymmetric matrices may lose pivots.
CONE_DENSE_FRACTION, OTHER_DENSE_FRACTION = 0.4, 0.25


def is_dense_faster(nnz: float, m: int, cones: bool) -> bool:
    """Return whether a dense factorisation of m rows and nnz entries is faster than a supernodal one.

    `cones` states whether the problem has the cone law.
    """
    return nnz > (CONE_DENSE_FRACTION if cones else OTHER_DENSE_FRACTION) * m * m


def use_dense_matrix(nnz: float, m: int, cones: bool) -> bool:
    """Return whether H of m rows and nnz entries is stored as a full matrix."""
    return m <= MAX_ALWAYS_DENSE_ROWS or (is_dense_faster(nnz, m, cones) and m <= MAX_DENSE_ROWS)


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
    expected_factor_seconds = 0.0  # Estimated time of the next factor [s].
    # Factorisations by Python that are expected to end after this deadline are not started.
    deadline: Deadline | None = None
    dense = False  # Whether A is stored as a full matrix.
    entries = 0.0  # Number of entries of A.

    def __init__(self, problem: Problem, solve: Solve) -> None:
        self.problem, self.solve = problem, solve

    def record_factor_time(self, seconds: float) -> None:
        """Record the time of the last factorisation with the steps around it [s], to estimate the next time."""
        if self.work > 0.0:
            self.expected_factor_seconds = seconds


class VelocitySystem(System):
    """H = K K^T + theta over the bodies, with one block column of s unknowns for each body."""

    form = "velocity"

    def __init__(self, problem: Problem, bodies: Bodies, like: System | None = None) -> None:
        """Build the system; the layout of an earlier system `like` between the same bodies is reused."""
        super().__init__(problem, Solve(problem.metric))
        solve = self.solve
        panel, columns = solve.jacobian(bodies.pair, bodies.column)
        structure = bodies.pair[solve.block], bodies.n, len(columns)
        reused = like.layout if isinstance(like, VelocitySystem) and like.layout.serves(*structure) else None
        self.layout: Layout = reused or Layout(*structure)
        self.work = self.layout.work
        self.expected_factor_seconds = 0.5e-9 * self.work
        solve.use_bodies(
            panel, columns, self.layout, solve.has_friction and problem.law == "coulomb", USE_WIDE_LANES
        )
        self.augmented = AugmentedSystem(self, bodies)
        solve.set_external(self.augmented)


class MatrixSystem(System):
    """H stored as a matrix, dense or in compressed rows."""

    form = "impulse"
    sparse: LinearSystem  # System of a sparse H in the pattern of its elements.

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem, Solve(problem.metric, problem.csr_data))
        solve = self.solve
        m, a = solve.m, None
        nnz = len(problem._compressed[1])
        if not solve.whole:
            a = problem.csr[solve.keep][:, solve.keep]
            nnz = a.nnz
        self.symmetric = problem.is_symmetric
        self.dense = use_dense_matrix(nnz, m, solve.has_friction and problem.law == "cone")
        self.entries = float(nnz)
        self.h: Any
        if self.dense:
            self.h = problem.dense() if a is None else a.toarray()
            with np.errstate(all="ignore"):  # Results that overflow are judged.
                self.h *= solve.scale[:, None]
                self.h *= solve.scale
            solve.use_dense_matrix(self.h, self.symmetric, USE_WIDE_LANES)
            self.work = m**3 / 3.0  # As `costs.count_dense_work`.
        else:
            a = problem.csr if a is None else a
            values = scale_matrix_entries(a.indptr, a.indices, a.data, solve.scale)
            self.h = sp.csr_array((values, a.indices, a.indptr), shape=(m, m))
            self._bind_rows()
            self.work = (1.0 if self.symmetric else 2.0) * self.sparse.cost
        # Upper bounds of the time per multiply-add, on machines of the last ten years.
        self.expected_factor_seconds = (0.3e-9 if self.dense else 1e-9) * self.work

    def _bind_rows(self) -> None:
        """Pass H to the kernel in compressed rows, and in the pattern of its elements."""
        solve, h = self.solve, self.h
        to, other, indptr, indices, entries = h.indptr, h.indices, h.indptr, h.indices, h.data
        if solve.has_friction or not (has_symmetric_pattern(to, other) and h.diagonal().all()):
            to, other = _find_element_graph(solve, h)
            indptr, indices = list_coupled_rows(solve.ptr, to, other)
            entries = copy_coupled_entries(h.indptr, h.indices, h.data, indptr, indices)
        row = np.repeat(np.arange(solve.m, dtype=np.int32), np.diff(indptr))
        diagonal = np.flatnonzero(row == indices).astype(np.int32)
        self.sparse = LinearSystem((indptr, indices), USE_WIDE_LANES, splu)
        solve.use_sparse_matrix(
            h.indptr, h.indices, h.data, self.sparse, to, other, entries, diagonal, self.symmetric
        )


def _find_element_graph(solve: Solve, a: sp.csr_array) -> tuple[IntArray, IntArray]:
    """Return (indptr, indices) of the symmetric graph of the elements that A couples, with all diagonal entries."""
    n = len(solve.ptr) - 1
    element = np.repeat(np.arange(n, dtype=np.int32), np.diff(solve.ptr))
    to, other = find_element_graph(solve.ptr, element, a.indptr, a.indices)
    graph = sp.csr_array((np.ones(len(other), bool), other, to), shape=(n, n))
    graph.sort_indices()
    if not (has_symmetric_pattern(graph.indptr, graph.indices) and graph.diagonal().all()):
        graph = sp.csr_array(graph + graph.T + sp.eye_array(n, dtype=bool))
        graph.sort_indices()
    return graph.indptr.astype(np.int32), graph.indices.astype(np.int32)


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
