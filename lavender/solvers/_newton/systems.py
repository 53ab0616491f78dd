"""H of the scaled problem and its Newton systems, in two forms.

`VelocitySystem` never forms H (K K^T + theta with one small dense block for each body, factored in compiled
code), `MatrixSystem` holds it (dense LAPACK, or sparse panels). The
equations are in `lavender_ext/newton/`.
"""

from __future__ import annotations

import os
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg.lapack import dgetrf as getrf
from scipy.linalg.lapack import dgetrs as getrs
from scipy.linalg.lapack import dpotrf as potrf
from scipy.linalg.lapack import dpotrs as potrs

from lavender._arrays import FloatArray, IntArray
from lavender._lu import sparse_lu
from lavender.problem import Problem
from lavender.solvers._newton.pattern import block_pattern, dissected, postordered
from lavender.solvers._newton.row_steps import RowSteps
from lavender.solvers._newton.scaled import Scaled, scaled
from lavender.solvers._newton.sparse import Coupled, Panelled
from lavender_ext.factor import symbolic
from lavender_ext.newton.coupled import scaled_entries
from lavender_ext.newton.elements import (
    MAP_AUGMENTED,
    MAP_CONVEX,
    MAP_COULOMB,
    Elements,
    element_product,
)
from lavender_ext.newton.fused_step import Interior
from lavender_ext.newton.normal_matrix import Factor
from lavender_ext.newton.panel import narrow, scaled_jacobian

CONVEX, COULOMB, AUGMENTED = MAP_CONVEX, MAP_COULOMB, MAP_AUGMENTED
DENSE_ROWS = 150  # below: dense LAPACK beats sparse bookkeeping
# Nonzero share s of A above which LAPACK has its factor sooner: of one full block of s^1/2 m rows, whose multiply-adds
# cost a quarter there; and of bounded rows alone, whose free ones panels analyse anew whenever they change.
DENSE_FILL, BOUNDED_FILL = 0.4, 0.25
DENSE_LIMIT = 6000  # rows; 288 MB of A
# Weight of the proximal term in an interior point system, relative to d: far below any step that
# matters, far above the rounding of a pivot.
DELTA = 1e-10
# Multiply-adds of a factor over bodies from which dense panels beat block rows; a panel's columns up to which, and
# share up to which (four times it for so few columns), zeros are held as numbers.
PANELS, FEW_COLUMNS, ZEROS = 2e6, 6, 0.1
WIDE = os.environ.get("LAVENDER_BASELINE", "0") in (
    "",
    "0",
)  # four lanes where the machine has them: the same bits
DAMPING = 0.995  # share of the way to the boundary that a step takes


def is_full(nnz: int, m: int, bounded: bool) -> bool:
    """Whether LAPACK factors Newton's matrix of m rows and nnz entries sooner than panels; `bounded`: no cones."""
    return nnz > (BOUNDED_FILL if bounded else DENSE_FILL) * m * m


def factor_cost(lptr: IntArray, s: int) -> float:
    """Multiply-adds of a factor over bodies of s unknowns each, by its block columns."""
    of_column = np.diff(lptr).astype(float)
    return float(s**3 * (0.5 * float(of_column @ of_column) + float(lptr[-1]) + len(of_column)))


class System:
    """H and its Newton systems; the two forms share the elements."""

    form = ""
    factorisations = 0
    newton: Any = None  # Newton steps of bounded rows, where there are such
    law = CONVEX  # of the last natural map
    cost = 0.0  # multiply-adds of one factorisation, roughly
    pace = 1e-9  # s for each of them at most, on any machine of the last ten years

    def __init__(self, sc: Scaled) -> None:
        self.sc = sc
        m = sc.m
        self.v = np.zeros(int(sc.wptr[-1]))
        self.einv = np.zeros_like(self.v)
        self.bt: FloatArray | None = None  # B^T with V = B B^T, where the form needs it
        self.p = np.zeros_like(self.v)
        self.t, self.q = np.zeros(m), np.zeros(m)

    elements: Any

    def took(self, start: float) -> None:
        """The pace of a factor that was begun at `start` (of `perf_counter`): the next one is refused by it."""
        if self.cost > 0.0:
            self.pace = (perf_counter() - start) / self.cost

    @property
    def seconds(self) -> float:
        """What the next factor takes, at that pace."""
        return self.pace * self.cost

    def interior(self, u1: FloatArray, u2: FloatArray, delta: float) -> Any:
        """Interior point steps in compiled code on the duals u1, u2 (m,), or None where there are none."""
        return None

    def factor_pair(self, left: FloatArray, right: FloatArray | None) -> bool:
        """Factor (H + W)  for W^-1 = R^T Q that is not symmetric; Q, R are small matrices, None is I."""
        raise NotImplementedError

    def solve_pair(self, r: FloatArray) -> FloatArray:
        """(H + W)^-1 r of the last `factor_pair`."""
        raise NotImplementedError

    def _elements(self, node: IntArray, slot: IntArray, panel: FloatArray, s: int) -> Any:
        sc = self.sc
        return Elements(
            sc.ptr, sc.kind, sc.wptr, node, slot, panel, sc.theta, sc.g, sc.lower, sc.upper,
            np.ascontiguousarray(sc.a_t, float), np.ascontiguousarray(sc.a_s, float), s, sc.a_r,
        )  # fmt: skip

    def times(self, z: FloatArray) -> FloatArray:
        raise NotImplementedError

    def factor_barrier(self) -> bool:
        """Factor H + W, with V = (W + theta + delta)^-1 in `v`."""
        raise NotImplementedError

    def solve_barrier(self, r: FloatArray) -> FloatArray:
        raise NotImplementedError

    def natural(self, z: FloatArray, s: FloatArray, law: int, eps: float, f: FloatArray) -> float:
        """F of the map `law` into f, and the small matrices of its derivative; |F|."""
        self.law = law
        return self.elements.natural(z, s, law, eps, f, self.p, self.einv, self.v)

    def natural_size(self, z: FloatArray, s: FloatArray, law: int, f: FloatArray) -> float:
        """F into f; |F|, the judge's energy error [sqrt J]."""
        return self.elements.natural(z, s, law, 0.0, f, self.p)

    def factor_natural(self, eps: float) -> bool:
        """Factor (I - P) + P (H + eps) of the last `natural`."""
        raise NotImplementedError

    def solve_natural(self, r: FloatArray) -> FloatArray:
        raise NotImplementedError

    def natural_times(self, dz: FloatArray) -> FloatArray:
        """(I - P) dz + P H dz."""
        out = np.empty_like(dz)
        self.elements.times(self.p, self.times(dz) - dz, out)
        return out + dz


class VelocitySystem(System):
    """K K^T + theta, one block column of s unknowns for each body."""

    form = "velocity"
    pace = 0.5e-9
    panels: tuple[Any, ...] | None = None  # of a large factor
    structure: tuple[Any, ...]
    pattern: tuple[IntArray, ...]  # the elements' bodies (k, 2), their places, slots, and which were turned

    def __init__(self, sc: Scaled, like: System | None = None) -> None:
        """`like`: an earlier system, whose order of elimination and pattern serve again between the same bodies."""
        super().__init__(sc)
        rows = sc.problem.rows
        assert rows is not None and sc.bodies is not None
        full = np.zeros((sc.problem.m, 12)) if rows.n_bodies == 0 else np.empty((sc.problem.m, 12))
        used = scaled_jacobian(sc.problem.data, rows.inv_inertia, np.sqrt(rows.inv_mass), full)
        columns = [c for c in range(6) if used >> c & 1]
        s = next(k for k in (1, 2, 3, 6) if k >= len(columns))
        columns = sorted((columns + [c for c in range(6) if not used >> c & 1])[:s])
        self.s, self.n = s, rows.n_bodies
        if isinstance(like, VelocitySystem) and like.serves(s, rows.n_bodies, sc.bodies):
            self.cost, self.panels = like.cost, like.panels
            self.pattern, self.structure = like.pattern, like.structure
        else:
            self._analyse(rows.n_bodies, sc.bodies)
        _, node, slot, turned = self.pattern
        halves = np.empty((sc.m, 2, s))
        narrow(full, sc.keep, sc.ptr, turned, np.array(columns, np.int32), halves)
        self.elements = self._elements(node, slot, halves, s)
        self.y = np.zeros(self.n * s + 1)
        if len(sc.kind) < sc.m and not sc.theta.any():
            self.bt = np.zeros_like(self.v)
        self.factor: Any = None
        self.factor_unsymmetric = False
        self.pair: tuple[FloatArray, FloatArray | None]

    def serves(self, s: int, n: int, bodies: IntArray) -> bool:
        """Whether the analysis of this system is that of n bodies of s unknowns with these elements (k, 2)."""
        return self.s == s and self.n == n and np.array_equal(self.pattern[0], bodies)

    def _analyse(self, n: int, bodies: IntArray) -> None:
        """Order of elimination and pattern of the factor."""
        s = self.s
        nptr, nind, node, slot, turned = block_pattern(n, bodies)
        structure = symbolic.factor_pattern(nptr, nind)
        self.cost = factor_cost(structure[0], s)
        if self.cost >= PANELS:
            other = dissected(n, node, nptr, nind)
            fill = symbolic.factor_pattern(*other[:2])
            if factor_cost(fill[0], s) < self.cost:
                nptr, nind, node, slot, again = other
                turned, structure, self.cost = (
                    (turned != again).astype(np.int32),
                    fill,
                    factor_cost(fill[0], s),
                )
            nptr, nind, node, slot, again = postordered(n, node, nptr, nind)
            turned = (turned != again).astype(np.int32)
            structure = symbolic.factor_pattern(nptr, nind)
            self.panels = symbolic.supernodes(nptr, nind, *structure[:2], s, FEW_COLUMNS, ZEROS)
        self.structure = (nptr, nind, *structure)
        self.pattern = (bodies, node, slot, turned)

    @cached_property
    def newton(self) -> Any:
        """Newton steps of bounded rows; None where there are cones."""
        sc = self.sc
        if len(sc.kind) < sc.m:
            return None
        u = np.empty(sc.m)
        return Interior(self.elements, self.blocks(False), self.v, None, u, u, sc.speed, DELTA, DAMPING)

    def interior(self, u1: FloatArray, u2: FloatArray, delta: float) -> Any:
        return Interior(
            self.elements, self.blocks(False), self.v, self.bt, u1, u2, self.sc.speed, delta, DAMPING
        )

    def blocks(self, lu: bool) -> Any:
        """The factor's storage, made when it is first needed."""
        if self.factor is None or (lu and not self.factor_unsymmetric):
            self.factor = Factor(*self.structure, self.s, lu, self.panels, WIDE)
            self.factor_unsymmetric = lu
        return self.factor

    def _factor(self, lu: bool) -> bool:
        self.factorisations += 1
        return self.blocks(lu).factor(self.elements, self.v, lu) == 0

    def times(self, z: FloatArray) -> FloatArray:
        out = np.empty_like(z)
        self.blocks(False).gram(self.elements, z, self.y, out)
        return out + self.sc.theta * z

    def factor_barrier(self) -> bool:
        return self._factor(False)

    def solve_barrier(self, r: FloatArray) -> FloatArray:
        t, q = self.t, self.q
        self.elements.times(self.v, r, t)
        self.factor.solve(self.elements, t, self.y, q)
        out = np.empty_like(r)
        if self.bt is None:
            self.elements.times(self.v, r - q, out)
        else:
            # B (B^T ...): V itself has lost the small end of its scaling to the large one.
            self.elements.times(self.bt, r - q, t)
            self.elements.times_transposed(self.bt, t, out)
        return out

    def factor_pair(self, left: FloatArray, right: FloatArray | None) -> bool:
        """I + K^T R^T Q K over the bodies, R^T Q in `v`."""
        self.pair = left, right
        return self._factor(True)

    def solve_pair(self, r: FloatArray) -> FloatArray:
        left, right = self.pair
        t, q, out = self.t, self.q, np.empty_like(r)
        self.elements.times(self.v, r, t)
        self.factor.solve(self.elements, t, self.y, q)
        r = r - q
        if right is None:
            self.elements.times(self.v, r, out)
            return out
        self.elements.times(left, r, t)
        self.elements.times_transposed(right, t, out)
        return out

    def factor_natural(self, eps: float) -> bool:
        return self._factor(self.law != CONVEX)

    def solve_natural(self, r: FloatArray) -> FloatArray:
        t, q = self.t, self.q
        self.elements.times(self.einv, r, t)
        self.factor.solve(self.elements, t, self.y, q)
        self.elements.times(self.p, q, t)
        out = np.empty_like(r)
        self.elements.times(self.einv, r - t, out)
        return out


def _nothing(r: FloatArray) -> FloatArray:
    """The solution of a singular system."""
    return np.full_like(r, np.nan)


class MatrixSystem(System):
    """H as a matrix: dense LAPACK, or sparse panels."""

    form = "impulse"

    def __init__(self, sc: Scaled) -> None:
        super().__init__(sc)
        m = sc.m
        a = sc.problem.csr
        if not sc.whole:
            a = a[sc.keep][:, sc.keep]
        self.symmetric = sc.problem.is_symmetric
        self.dense = m <= DENSE_ROWS or (is_full(a.nnz, m, len(sc.kind) == m) and m <= DENSE_LIMIT)
        # Of a sparse factor by its fill, which grows with the size: nanoseconds, as `_rates.py` has them.
        self.cost = m**3 / 3.0 if self.dense else 100.0 * a.nnz * (1.0 + m / 1000.0)
        self.pace = 0.15e-9 if self.dense else 1e-9
        self.fill = 0  # entries of the last sparse factor, 0 before the first
        self.h: Any
        if self.dense:
            self.h = a.toarray()
            self.h *= sc.scale[:, None]
            self.h *= sc.scale
        else:
            values = scaled_entries(a.indptr, a.indices, a.data, sc.scale)
            self.h = sp.csr_array((values, a.indices, a.indptr), shape=(m, m))
        if len(sc.kind) < m:
            self.bt = np.zeros_like(self.v)
        # theta is on the diagonal of A already.
        sc.theta = np.zeros(m)
        n = len(sc.kind)
        self.elements = self._elements(
            np.full((n, 2), -1, np.int32), np.zeros((n, 3), np.int32), np.zeros((m, 2)), 1
        )
        self.solver: Any = None
        self.pair: tuple[FloatArray, FloatArray]
        self.free: FloatArray | None = None  # 1 on the bounded rows that the last `factor_natural` solves for

    @cached_property
    def newton(self) -> Any:
        """Newton steps of bounded rows; None where there are cones."""
        return None if len(self.sc.kind) < self.sc.m else RowSteps(self, CONVEX)

    @cached_property
    def sparse(self) -> Coupled:
        """The pattern of its factors, where there are few entries."""
        return Coupled(self.sc, self.h, self.elements)

    @property
    def seconds(self) -> float:
        """As of all systems; fill is counted before the first number."""
        if not self.dense:
            self.cost = self.sparse.work if self.symmetric else 2.0 * self.sparse.work
        return self.pace * self.cost

    def times(self, z: FloatArray) -> FloatArray:
        return self.h @ z

    def _dense_lu(self, transposed: FloatArray) -> bool:
        # Row-major for the kernel is the transpose for LAPACK.
        self.factorisations += 1
        start = perf_counter()
        lu, pivot, info = getrf(transposed.T, overwrite_a=True)
        self.took(start)
        self.solver = lambda r: getrs(lu, pivot, r, trans=1)[0]
        return info == 0

    def _product(self, w: FloatArray, h: FloatArray, eps: float, own: float, one: float) -> FloatArray:
        out = np.empty_like(self.h)
        element_product(self.elements, w, h, eps, own, one, out)
        return out

    def _by_panels(self, made: Panelled) -> bool:
        """SuperLU where a pivot is lost, and where a solution is not exact."""
        self.solver = _nothing
        self.factorisations += 1  # one, by whichever: it is a step of the budget
        if not np.isfinite(made.values).all():
            return False
        start = perf_counter()
        done = made.factor()
        self.cost = made.panels.work
        self.took(start)
        if not done:
            self.solver = self._superlu(made)
            return self.solver is not _nothing
        instead: Any = None

        def solve(r: FloatArray) -> FloatArray:
            nonlocal instead
            if instead is None:
                x = made.solve(r)
                if x is not None:
                    return x
                instead = self._superlu(made)
            found: FloatArray = instead(r)
            return found

        self.solver = solve
        return True

    def _superlu(self, made: Panelled) -> Any:
        start = perf_counter()
        try:
            factor = sparse_lu(made.matrix(), permc_spec="COLAMD")
        except RuntimeError:
            return _nothing
        self.took(start)
        return factor.solve

    def factor_barrier(self) -> bool:
        # H + V^-1, or with cones I + B^T H B and dz = B (...): V^-1 would lose the small eigenvalues of V.
        if self.bt is None:
            with np.errstate(divide="ignore", over="ignore"):
                w = 1.0 / self.v  # inf for a row that no longer moves, and the step fails
            if not self.dense:
                return self._by_panels(self.sparse.barrier(w, not self.symmetric))
            matrix = self.h.copy()
            matrix.flat[:: len(matrix) + 1] += w
            if self.symmetric and self._cholesky(matrix):
                return True
            if self.symmetric:
                matrix = self.h.copy()
                matrix.flat[:: len(matrix) + 1] += w
            return self._dense_lu(matrix)
        if not self.dense:
            return self._by_panels(self.sparse.small(self.bt, self.bt, 0.0, not self.symmetric))
        left = np.ascontiguousarray(self._product(self.bt, self.h, 0.0, 0.0, 0.0).T)
        matrix = self._product(self.bt, left, 0.0, 0.0, 1.0)
        if self.symmetric and self._cholesky(matrix.copy()):
            return True
        return self._dense_lu(np.ascontiguousarray(matrix.T))

    def _cholesky(self, matrix: FloatArray) -> bool:
        start = perf_counter()
        c, info = potrf(matrix.T, lower=1, clean=0, overwrite_a=True)
        self.took(start)
        if info != 0:
            return False
        self.factorisations += 1
        self.solver = lambda r: potrs(c, r, lower=1)[0]
        return True

    def solve_barrier(self, r: FloatArray) -> FloatArray:
        if self.bt is None:
            return self.solver(r)
        t, out = np.empty_like(r), np.empty_like(r)
        self.elements.times(self.bt, r, t)
        self.elements.times_transposed(self.bt, self.solver(t), out)
        return out

    def factor_pair(self, left: FloatArray, right: FloatArray | None) -> bool:
        """I + Q H R^T."""
        assert right is not None
        self.pair = left, right
        if self.dense:
            product = np.ascontiguousarray(self._product(left, self.h, 0.0, 0.0, 0.0).T)
            return self._dense_lu(np.ascontiguousarray(self._product(right, product, 0.0, 0.0, 1.0).T))
        return self._by_panels(self.sparse.small(left, right, 0.0, True))

    def solve_pair(self, r: FloatArray) -> FloatArray:
        left, right = self.pair
        out = np.empty_like(r)
        self.elements.times(left, r, self.t)
        self.elements.times_transposed(right, self.solver(self.t), out)
        return out

    def factor_natural(self, eps: float) -> bool:
        self.free = None
        if self.bt is None:
            return self._factor_free(eps)
        if self.dense:
            return self._dense_lu(self._product(self.p, self.h, eps, 1.0, 1.0))
        return self._by_panels(self.sparse.small(self.p, None, eps - 1.0, True))

    def _factor_free(self, eps: float) -> bool:
        """H_FF + eps of bounded rows, the rows that the last `natural` found inside their bounds."""
        self.free = self.p
        free = np.flatnonzero(self.p).astype(np.int32)
        if len(free) == 0:
            self.solver = np.copy
            return True
        if not self.dense:
            return self._by_panels(self.sparse.small(self.p, self.p, eps - 1.0, not self.symmetric))
        matrix = self.h[np.ix_(free, free)]
        matrix.flat[:: len(free) + 1] += eps
        done = (self.symmetric and self._cholesky(matrix.copy())) or self._dense_lu(matrix)
        inside = self.solver

        def solve(r: FloatArray) -> FloatArray:
            out = r.copy()
            out[free] = inside(r[free])
            return out

        self.solver = solve
        return done

    def solve_natural(self, r: FloatArray) -> FloatArray:
        if self.free is not None:
            # H_FF dz_F = r_F - H_FN r_N, dz_N = r_N
            r = r - self.free * (self.h @ (r - self.free * r))
        return self.solver(r)


def make_system(problem: Problem, form: str, like: System | None = None) -> System:
    """The system of a problem; form "velocity" or "impulse". `like`: one of the same structure."""
    sc = scaled(problem)
    return VelocitySystem(sc, like) if form == "velocity" else MatrixSystem(sc)
