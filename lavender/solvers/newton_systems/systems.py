"""H of the scaled problem and its Newton systems, in two forms.

`VelocitySystem` never forms H (K K^T + theta with one small dense block for each body), `MatrixSystem` holds it (dense,
or sparse panels). The equations, and all that is solved with them, are in `lavender_ext/newton/`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from lavender.base.arrays import IntArray
from lavender.base.deadline import Deadline
from lavender.base.lazy_import import sparse as sp
from lavender.judge.residuals import get_reference
from lavender.problem import Problem
from lavender.solvers.factors import DENSE_LIMIT, WIDE
from lavender.solvers.newton_systems.augmented import Augmented
from lavender.solvers.newton_systems.sparse import SparseRows
from lavender.solvers.setup_times import dense_work
from lavender_ext.factor import graph
from lavender_ext.newton.coupled import scaled_entries
from lavender_ext.newton.solve import Layout, Solve

DENSE_ROWS = 150  # below: a dense factor beats sparse bookkeeping
# Nonzero share s of A above which a dense factor is there sooner: of one full block of s^1/2 m rows, whose
# multiply-adds cost a quarter there; and of bounded rows, of which dense factors take the free ones, and under
# Coulomb's law, whose factors lack symmetry and lose pivots by panels.
DENSE_FILL, EARLY_FILL = 0.4, 0.25
# Multiply-adds of a factor over bodies from which dense panels beat block rows; a panel's columns up to which, and
# share up to which (four times it for so few columns), zeros are held as numbers.
PANELS, FEW_COLUMNS, ZEROS = 2e6, 6, 0.1


def is_full(nnz: float, m: int, cones: bool) -> bool:
    """Whether a dense factor of m rows and nnz entries is there sooner than panels; `cones`: of the cone law."""
    return nnz > (DENSE_FILL if cones else EARLY_FILL) * m * m


def is_dense(nnz: float, m: int, cones: bool) -> bool:
    """Whether H of m rows and nnz entries is held as a full matrix."""
    return m <= DENSE_ROWS or (is_full(nnz, m, cones) and m <= DENSE_LIMIT)


class Bodies(NamedTuple):
    """Between which bodies blocks stand; of J and M, which velocities are those of a body."""

    pair: IntArray  # (n_blocks, 2), -1 where there is none
    n: int
    column: IntArray | None = None  # (nv,) six times the body of each velocity, and its place there


def bodies_of(problem: Problem) -> Bodies | None:
    """Bodies of a problem's rows, or those that velocities of J and M stand for, if two at most meet in every block."""
    if problem.rows is not None:
        return Bodies(problem.rows.block_bodies, problem.rows.n_bodies) if problem.rows.n_bodies else None
    if problem.generalized is None or problem.cones.has_round:
        return None
    found = graph.bodies_in(problem.metric, problem.generalized.order)
    return None if found is None else Bodies(*found)


class System:
    """H of a scaled problem, and Newton's method on it."""

    form = ""
    work = 0.0  # multiply-adds of one factor
    pace = 1e-9  # s for each of them at most, on any machine of the last ten years
    dense = False  # A as a full matrix
    entries = 0.0  # of A

    def __init__(self, problem: Problem, solve: Solve) -> None:
        self.problem, self.solve = problem, solve

    @property
    def seconds(self) -> float:
        """What the next factor takes, at that pace."""
        return self.pace * self.work

    def set_deadline(self, deadline: Deadline) -> None:
        """Let no factor by Python begin that is expected to end after `deadline`."""

    def took(self, seconds: float) -> None:
        """So long did the last factor take, with the steps around it: the next one is refused by that pace."""
        if self.work > 0.0:
            self.pace = seconds / self.work


class VelocitySystem(System):
    """K K^T + theta, one block column of s unknowns for each body."""

    form = "velocity"
    pace = 0.5e-9

    def __init__(self, problem: Problem, bodies: Bodies, like: System | None = None) -> None:
        """`like`: an earlier system, whose layout serves again between the same bodies."""
        super().__init__(problem, Solve(problem.metric))
        solve = self.solve
        panel, columns = solve.jacobian(bodies.pair, bodies.column)
        of = bodies.pair[solve.block], bodies.n, len(columns)
        kept = like.layout if isinstance(like, VelocitySystem) and like.layout.serves(*of) else None
        self.layout: Layout = kept or Layout(*of, PANELS, FEW_COLUMNS, ZEROS)
        self.work = self.layout.work
        solve.over_bodies(panel, columns, self.layout, solve.has_friction and problem.law == "coulomb", WIDE)
        self.augmented = Augmented(solve, self.layout, bodies)
        solve.ask(self.augmented)

    def set_deadline(self, deadline: Deadline) -> None:
        self.augmented.deadline = deadline


class MatrixSystem(System):
    """H as a matrix: dense, or sparse panels."""

    form = "impulse"
    sparse: SparseRows  # who factors an H of few entries

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem, Solve(problem.metric, problem.csr_data))
        solve = self.solve
        m, a = solve.m, problem.csr
        if not solve.whole:
            a = a[solve.keep][:, solve.keep]
        self.symmetric = problem.is_symmetric
        self.dense = is_dense(a.nnz, m, solve.has_friction and problem.law == "cone")
        self.entries = float(a.nnz)
        self.pace = 0.3e-9 if self.dense else 1e-9
        self.h: Any
        if self.dense:
            self.h = a.toarray()
            self.h *= solve.scale[:, None]
            self.h *= solve.scale
            solve.over_rows(self.h, self.symmetric, WIDE)
            self.work = dense_work(m)
        else:
            values = scaled_entries(a.indptr, a.indices, a.data, solve.scale)
            self.h = sp.csr_array((values, a.indices, a.indptr), shape=(m, m))
            solve.over_entries(a.indptr, a.indices, values, self.symmetric)
            self.sparse = SparseRows(solve, self.h, self.symmetric)
            solve.ask(self.sparse)
            self.work = (1.0 if self.symmetric else 2.0) * self.sparse.panels.work()


def make_system(
    problem: Problem, form: str, like: System | None = None, bodies: Bodies | None = None
) -> System:
    """The system of a problem; form "velocity", of its `bodies`, or "impulse". `like`: one of the same structure."""
    get_reference(problem)
    if form == "impulse":
        return MatrixSystem(problem)
    bodies = bodies or bodies_of(problem)
    assert bodies is not None
    return VelocitySystem(problem, bodies, like)
