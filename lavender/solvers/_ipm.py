"""The problem in the scaled unknown z = D^1/2 lambda, its Newton systems, and a cold interior point.

    H z - g = s,   H = D^-1/2 A D^-1/2,   g = D^-1/2 b,   z, s complementary on every block

Two forms of H: `VelocitySystem` never forms it (K K^T + theta with one small dense block for each body,
factored in compiled code), `MatrixSystem` holds it (dense LAPACK, LAPACK's band where one is narrow, else
sparse LU). The equations are in `lavender_ext/newton/`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as ssl
from scipy.linalg.lapack import dgetrf as getrf
from scipy.linalg.lapack import dgetrs as getrs
from scipy.linalg.lapack import dpbtrf as pbtrf
from scipy.linalg.lapack import dpbtrs as pbtrs
from scipy.linalg.lapack import dpotrf as potrf
from scipy.linalg.lapack import dpotrs as potrs

from lavender._arrays import FloatArray, IntArray
from lavender.cones import CONTACT, CONTACT_SPIN, ROW
from lavender.problem import Problem
from lavender_ext.factor import graph, symbolic
from lavender_ext.newton.band import (
    band_free,
    band_scaled,
    band_width,
    element_graph,
    scaled_band,
    scaled_entries,
)
from lavender_ext.newton.elements import Elements, element_product
from lavender_ext.newton.fused_step import Interior
from lavender_ext.newton.normal_matrix import Factor
from lavender_ext.newton.panel import narrow, scaled_jacobian

CONVEX, COULOMB, AUGMENTED = 0, 1, 2  # natural maps, as in the kernel
FEW_BODIES = 1500  # up to here bits hold the neighbours of a body
DENSE_ROWS = 400  # below: dense LAPACK beats sparse bookkeeping
DENSE_FILL = 0.1  # nonzero share of A above which a sparse factor is full anyway
DENSE_LIMIT = 6000  # rows; 288 MB of A
BAND_ROWS = 100  # below: dense LAPACK
BAND_SHARE = 0.25  # of rows that the half bandwidth may have
BAND_FILL = 1000.0  # multiply-adds for each nonzero of A up to which LAPACK's band beats SuperLU

# Weight of the proximal term in an interior point system, relative to d: far below any step that
# matters, far above the rounding of a pivot.
START = 1e-6  # W of the first point: nearly H z = g
DUAL_START = 0.01  # size of the first duals, relative to the first impulses (measured: 0.001 to 1)
MARGIN = 0.1  # distance of a first point from its cones' boundaries, of mean sizes (measured: 0.03 to 1)
DELTA = 1e-10
DAMPING = 0.995  # share of the way to the boundary that a step takes


@dataclass
class Scaled:
    """Rows that move, as elements. Fixed rows (equal bounds, mu = 0 tangents, empty rows) are taken out."""

    problem: Problem
    keep: IntArray  # (mk,) rows that move
    fixed: FloatArray  # (m,) impulse of the fixed rows, 0 elsewhere
    scale: FloatArray  # (mk,) D^-1/2
    g: FloatArray  # (mk,)
    theta: FloatArray  # (mk,)
    ptr: IntArray
    kind: IntArray
    wptr: IntArray
    lower: FloatArray
    upper: FloatArray
    a_t: FloatArray
    a_s: FloatArray
    bodies: IntArray | None = None  # (n, 2) bodies of each element
    whole: bool = True  # every row moves

    @property
    def m(self) -> int:
        return len(self.keep)

    @property
    def has_friction(self) -> bool:
        """Some element has more rows than one: a contact with tangents or spin that move."""
        return len(self.kind) < self.m

    @cached_property
    def speed(self) -> FloatArray:
        """Velocity error (m,) per unit of the natural map."""
        weight = self.problem.data.weight
        return np.asarray((weight if self.whole else weight[self.keep]) * self.scale)

    def impulse(self, z: FloatArray) -> FloatArray:
        """lambda (m,) of z."""
        if self.whole:
            return z * self.scale
        lam = self.fixed.copy()
        lam[self.keep] = z * self.scale
        return lam

    def unknown(self, impulse: FloatArray) -> FloatArray:
        """z of lambda (m,)."""
        return (impulse if self.whole else impulse[self.keep]) / self.scale


def _all_slide(problem: Problem) -> bool:
    """Nothing but contacts with two tangents that all move, the usual friction problem."""
    cones = problem.cones
    return (
        3 * len(cones.kind) == problem.m
        and len(problem.data.empty) == 0
        and bool(np.all(cones.kind == CONTACT))
        and bool(np.all(cones.ptr[1:] - cones.ptr[:-1] == 3))
        and bool(np.all(cones.mu > 0.0))
    )


def _scaled_contacts(problem: Problem) -> Scaled:
    cones, m, n = problem.cones, problem.m, len(problem.cones.kind)
    scale = 1.0 / np.sqrt(problem.d)
    root = 1.0 / scale
    rows, compliance = problem.rows, problem.compliance
    return Scaled(
        problem,
        np.arange(m, dtype=np.int32),
        np.zeros(m),
        scale,
        problem.b * scale,
        np.zeros(m) if compliance is None else compliance * scale * scale,
        np.array(cones.ptr, np.int32),
        np.full(n, CONTACT, np.int32),
        np.arange(0, 9 * n + 1, 9, dtype=np.int32),
        cones.lower / scale,
        cones.upper / scale,
        cones.mu * root[1::3] / root[::3],
        np.zeros(n),
        None if rows is None else np.ascontiguousarray(rows.contact_body, np.int32),
    )


def _all_rows(problem: Problem) -> bool:
    """Nothing but bounded rows that all move."""
    cones = problem.cones
    single = len(cones.kind) == problem.m or cones.is_bounded_rows
    return single and len(problem.data.empty) == 0 and bool((cones.lower < cones.upper).all())


def _scaled_rows(problem: Problem) -> Scaled:
    cones, m = problem.cones, problem.m
    scale = 1.0 / np.sqrt(problem.d)
    rows, compliance = problem.rows, problem.compliance
    index, zero = np.arange(m + 1, dtype=np.int32), np.zeros(m)
    bodies = None
    if rows is not None:
        bodies = np.concatenate([rows.joint_body, rows.contact_body]) if rows.n_joints else rows.contact_body
        if len(bodies) < m:
            bodies = np.repeat(bodies, np.diff(cones.ptr), axis=0)
        bodies = np.ascontiguousarray(bodies, np.int32)
    return Scaled(
        problem,
        index[:-1],
        zero,
        scale,
        problem.b * scale,
        zero if compliance is None else compliance * scale * scale,
        index,
        np.zeros(m, np.int32),
        index,
        cones.lower / scale,
        cones.upper / scale,
        zero,
        zero,
        bodies,
    )


def scaled(problem: Problem) -> Scaled:
    """Scale, and take out what cannot move."""
    if problem.m and _all_slide(problem):
        return _scaled_contacts(problem)
    cones, d, m = problem.cones, problem.d, problem.m
    if _all_rows(problem):
        return _scaled_rows(problem)
    size: IntArray = np.diff(cones.ptr).astype(np.int32)
    single = cones.is_bounded_rows
    fixed = np.zeros(m)
    still = np.asarray(cones.lower == cones.upper)
    if single:
        row = np.repeat(cones.kind == ROW, size)
    else:
        row = np.repeat((cones.kind == ROW) | (size == 1), size)
        mu, radius = np.repeat(cones.mu, size), np.repeat(cones.patch_radius, size)
        position = np.arange(m) - np.repeat(cones.ptr[:-1], size)
        contact = np.repeat(cones.kind != ROW, size)
        spin = contact & np.repeat(cones.kind == CONTACT_SPIN, size) & (position == np.repeat(size, size) - 1)
        still = still | (contact & (position > 0) & ((mu == 0.0) | (spin & (radius == 0.0))))
    fixed[still] = np.where(np.isfinite(cones.lower[still]), cones.lower[still], 0.0)
    for i in problem.data.empty:
        j = problem.block_of(int(i))
        if cones.kind[j] == ROW or size[j] == 1:
            still[i] = True
            bound = cones.upper[i] if problem.b[i] > 0.0 else cones.lower[i] if problem.b[i] < 0.0 else 0.0
            fixed[i] = np.clip(bound if np.isfinite(bound) else 0.0, cones.lower[i], cones.upper[i])
    whole = not still.any()
    keep: IntArray = (np.arange(m) if whole else np.flatnonzero(~still)).astype(np.int32)
    b = problem.b if whole or not fixed.any() else problem.b + _minus_fixed(problem, fixed)
    scale = 1.0 / np.sqrt(d if whole else d[keep])
    mk = len(keep)
    compliance = problem.compliance
    theta = np.zeros(mk) if compliance is None else (compliance[keep] * scale * scale)
    lower, upper = cones.lower[keep] / scale, cones.upper[keep] / scale
    if single:
        ptr, kind = np.arange(mk + 1, dtype=np.int32), np.zeros(mk, np.int32)
        a_t = a_s = np.zeros(mk)
        wptr = ptr
    else:
        block = np.repeat(np.arange(len(size)), size)[keep]
        is_row = row[keep]
        first = np.ones(mk, bool)
        first[1:] = is_row[1:] | (block[1:] != block[:-1])
        start = np.flatnonzero(first)
        ptr = np.append(start, mk).astype(np.int32)
        n_rows = np.diff(ptr)
        kind = np.where(is_row[start] | (n_rows == 1), ROW, CONTACT).astype(np.int32)
        of = block[start]
        with_spin = np.zeros(len(start), bool)
        last = ptr[1:] - 1
        with_spin = spin[keep][last] & (kind != ROW)
        kind[with_spin] = CONTACT_SPIN
        wptr = np.concatenate([[0], np.cumsum(n_rows**2)]).astype(np.int32)
        root = 1.0 / scale
        second = np.minimum(start + 1, max(mk - 1, 0))
        contact_of = kind != ROW
        a_t = np.where(contact_of, cones.mu[of] * root[second] / root[start], 0.0)
        a_s = np.where(with_spin, (cones.mu * cones.patch_radius)[of] * root[last] / root[start], 0.0)
    bodies = None
    if problem.rows is not None:
        rows = problem.rows
        per_block = np.concatenate([rows.joint_body, rows.contact_body])
        element_block = np.repeat(np.arange(len(size)), size)[keep][ptr[:-1]]
        bodies = np.ascontiguousarray(per_block[element_block], np.int32)
    return Scaled(
        problem,
        keep,
        fixed,
        scale,
        b[keep] * scale,
        theta,
        ptr,
        kind,
        wptr,
        lower,
        upper,
        a_t,
        a_s,
        bodies,
        whole,
    )


def _minus_fixed(problem: Problem, fixed: FloatArray) -> FloatArray:
    # -A fixed: slack(fixed) = A fixed - b
    return -(problem.slack(fixed) + problem.b)


class System:
    """H and its Newton systems; the two forms share the elements."""

    form = ""
    factorisations = 0
    law = CONVEX  # of the last natural map
    cost = 0.0  # multiply-adds of one factorisation, roughly

    def __init__(self, sc: Scaled) -> None:
        self.sc = sc
        m = sc.m
        self.v = np.zeros(int(sc.wptr[-1]))
        self.einv = np.zeros_like(self.v)
        self.bt: FloatArray | None = None  # B^T with V = B B^T, where the form needs it
        self.p = np.zeros_like(self.v)
        self.t, self.q = np.zeros(m), np.zeros(m)

    elements: Any

    def _elements(self, node: IntArray, slot: IntArray, panel: FloatArray, s: int) -> Any:
        sc = self.sc
        return Elements(
            sc.ptr, sc.kind, sc.wptr, node, slot, panel, sc.theta, sc.g, sc.lower, sc.upper,
            np.ascontiguousarray(sc.a_t, float), np.ascontiguousarray(sc.a_s, float), s,
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

    def __init__(self, sc: Scaled) -> None:
        super().__init__(sc)
        rows = sc.problem.rows
        assert rows is not None and sc.bodies is not None
        full = np.zeros((sc.problem.m, 12)) if rows.n_bodies == 0 else np.empty((sc.problem.m, 12))
        used = scaled_jacobian(sc.problem.data, rows.inv_inertia, np.sqrt(rows.inv_mass), full)
        columns = [c for c in range(6) if used >> c & 1]
        s = next(k for k in (1, 2, 3, 6) if k >= len(columns))
        columns = sorted((columns + [c for c in range(6) if not used >> c & 1])[:s])
        nptr, nind, node, slot, turned = block_pattern(rows.n_bodies, sc.bodies)
        halves = np.empty((sc.m, 2, s))
        narrow(full, sc.keep, sc.ptr, turned, np.array(columns, np.int32), halves)
        self.s, self.n = s, rows.n_bodies
        self.elements = self._elements(node, slot, halves, s)
        self.structure = (nptr, nind, *symbolic.factor_pattern(nptr, nind))
        self.y = np.zeros(self.n * s + 1)
        of_column = np.diff(self.structure[2]).astype(float)  # blocks of L
        self.cost = s**3 * (0.5 * float(of_column @ of_column) + float(self.structure[2][-1]) + self.n)
        if len(sc.kind) < sc.m and not sc.theta.any():
            self.bt = np.zeros_like(self.v)
        self.factor: Any = None
        self.factor_unsymmetric = False

    @cached_property
    def newton(self) -> Any:
        """Newton steps of bounded rows; None where there are cones."""
        sc = self.sc
        if type(self) is not VelocitySystem or len(sc.kind) < sc.m:
            return None
        u = np.empty(sc.m)
        return Interior(self.elements, self.blocks(False), self.v, None, u, u, sc.speed, DELTA, DAMPING)

    def blocks(self, lu: bool) -> Any:
        """The factor's storage, made when it is first needed."""
        if self.factor is None or (lu and not self.factor_unsymmetric):
            self.factor = Factor(*self.structure, self.s, lu)
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


@dataclass
class _Band:
    """H in an order of its elements that makes it narrow."""

    h: FloatArray  # (m, width), h[j, t] = H[j + t, j]
    order: IntArray  # (m,) row at each place
    place: IntArray  # (m,) place of each row
    elements: IntArray  # (n,) element at each place
    work: FloatArray  # (m, width) the last factor


def _band(sc: Scaled, a: Any) -> _Band | None:
    """Where a band costs less than a sparse factor, and far less than a dense one."""
    m, n = sc.m, len(sc.kind)
    if m < BAND_ROWS or a.nnz == 0 or a.nnz > 0.5 * BAND_SHARE * m * m:
        return None  # a mean row of more nonzeros than that has no narrow band
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    if n == m:
        elements = order = reverse_cuthill_mckee(a, symmetric_mode=True).astype(np.int32)
    else:
        of = np.repeat(np.arange(n, dtype=np.int32), np.diff(sc.ptr))
        to, other = element_graph(sc.ptr, of, a.indptr, a.indices)
        graph = sp.csr_array((np.ones(len(other), np.int8), other, to), shape=(n, n))
        elements = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int32)
        size = np.diff(sc.ptr)[elements]
        ends = np.cumsum(size)
        order = (np.arange(m) + np.repeat(sc.ptr[:-1][elements] - (ends - size), size)).astype(np.int32)
    place = np.empty(m, np.int32)
    place[order] = np.arange(m, dtype=np.int32)
    width = band_width(a.indptr, a.indices, place) + 1
    if width > BAND_SHARE * m or m * width**2 > BAND_FILL * a.nnz:
        return None
    h = np.empty((m, width))
    scaled_band(a.indptr, a.indices, a.data, place, sc.scale, h)
    return _Band(h, order, place, elements, np.empty_like(h))


class MatrixSystem(System):
    """H as a matrix: dense LAPACK, or sparse LU."""

    form = "impulse"

    def __init__(self, sc: Scaled) -> None:
        super().__init__(sc)
        m = sc.m
        a = sc.problem.csr
        if not sc.whole:
            a = a[sc.keep][:, sc.keep]
        self.symmetric = sc.problem.is_symmetric
        self.band: _Band | None = _band(sc, a) if self.symmetric else None
        self.dense = self.band is None and (
            m <= DENSE_ROWS or (a.nnz > DENSE_FILL * m * m and m <= DENSE_LIMIT)
        )
        self.cost = m**3 / 3.0 if self.dense else 50.0 * a.nnz
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
        self.free: FloatArray | None = None  # rows that the band of the last `factor_natural` holds

    @cached_property
    def places(self) -> tuple[IntArray, IntArray]:
        """Rows and columns of the elements' small matrices, row by row of each."""
        sc, size = self.sc, np.diff(self.sc.ptr)
        nr = np.repeat(size, size**2)
        inner = np.arange(int(sc.wptr[-1])) - np.repeat(sc.wptr[:-1], size**2)
        base = np.repeat(sc.ptr[:-1], size**2)
        return base + inner // nr, base + inner % nr

    def small(self, values: FloatArray) -> sp.csr_array:
        m = self.sc.m
        return sp.csr_array((values, self.places), shape=(m, m))

    def times(self, z: FloatArray) -> FloatArray:
        return self.h @ z

    def _dense_lu(self, transposed: FloatArray) -> bool:
        # Row-major for the kernel is the transpose for LAPACK.
        self.factorisations += 1
        lu, pivot, info = getrf(transposed.T, overwrite_a=True)
        self.solver = lambda r: getrs(lu, pivot, r, trans=1)[0]
        return info == 0

    def _product(self, w: FloatArray, h: FloatArray, eps: float, own: float, one: float) -> FloatArray:
        out = np.empty_like(self.h)
        element_product(self.elements, w, h, eps, own, one, out)
        return out

    def _sparse_lu(self, matrix: Any) -> bool:
        self.factorisations += 1
        self.solver = lambda r: np.full_like(r, np.nan)
        if not np.isfinite(matrix.data).all():
            return False
        try:
            factor = ssl.splu(sp.csc_array(matrix), permc_spec="COLAMD")
        except RuntimeError:
            return False
        self.solver = factor.solve
        return True

    def factor_barrier(self) -> bool:
        # H + V^-1, or with cones I + B^T H B and dz = B (...): V^-1 would lose the small eigenvalues of V.
        if self.band is not None and self._factor_band(self.band):
            return True
        if self.bt is None:
            with np.errstate(divide="ignore", over="ignore"):
                w = 1.0 / self.v  # inf for a row that no longer moves, and the step fails
            if not self.dense:
                return self._sparse_lu(self.h + sp.diags_array(w))
            matrix = self.h.copy()
            matrix.flat[:: len(matrix) + 1] += w
            if self.symmetric and self._cholesky(matrix):
                return True
            if self.symmetric:
                matrix = self.h.copy()
                matrix.flat[:: len(matrix) + 1] += w
            return self._dense_lu(matrix)
        if not self.dense:
            bt = self.small(self.bt)
            return self._sparse_lu(bt @ self.h @ bt.T + sp.eye_array(self.sc.m))
        left = np.ascontiguousarray(self._product(self.bt, self.h, 0.0, 0.0, 0.0).T)
        matrix = self._product(self.bt, left, 0.0, 0.0, 1.0)
        if self.symmetric and self._cholesky(matrix.copy()):
            return True
        return self._dense_lu(np.ascontiguousarray(matrix.T))

    def _factor_band(self, band: _Band) -> bool:
        if self.bt is None:
            matrix = band.work
            matrix[:] = band.h
            matrix[:, 0] += (1.0 / self.v)[band.order]
        else:
            band_scaled(self.elements, band.elements, band.place, band.h, self.bt, band.work)
        return self._cholesky_band(band)

    def _cholesky_band(self, band: _Band) -> bool:
        self.factorisations += 1
        c, info = pbtrf(band.work.T, lower=1, overwrite_ab=True)
        self.solver = lambda r: pbtrs(c, r[band.order], lower=1, overwrite_b=True)[0][band.place]
        return info == 0

    def _cholesky(self, matrix: FloatArray) -> bool:
        c, info = potrf(matrix.T, lower=1, clean=0, overwrite_a=True)
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

    def factor_natural(self, eps: float) -> bool:
        self.free = None
        if self.band is not None and self.bt is None:
            band_free(self.band.h, self.p[self.band.order], eps, self.band.work)
            if self._cholesky_band(self.band):
                self.free = self.p
                return True
        if self.dense:
            return self._dense_lu(self._product(self.p, self.h, eps, 1.0, 1.0))
        p = self.small(self.p)
        return self._sparse_lu(p @ self.h + (eps - 1.0) * p + sp.eye_array(self.sc.m))

    def solve_natural(self, r: FloatArray) -> FloatArray:
        if self.free is not None:
            # H_FF dz_F = r_F - H_FN r_N, dz_N = r_N
            r = r - self.free * (self.h @ (r - self.free * r))
        return self.solver(r)


def block_pattern(n: int, body: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Lower block rows (nptr, nind); places (larger first) and slots of each element; which ones were turned."""
    if n <= FEW_BODIES:
        nptr, nind, node, slot, turned = graph.body_pattern(body, n)
        return nptr, nind, node, slot, turned
    chain = symbolic.chain_pattern(body, n)
    if chain is not None:
        return chain
    a, b = body[:, 0].astype(np.int64), body[:, 1].astype(np.int64)
    both = (a >= 0) & (b >= 0)
    code = np.unique(np.minimum(a, b)[both] * n + np.maximum(a, b)[both])
    low, high = code // n, code % n
    rank = _fill_reducing(n, low, high)
    r_low, r_high = rank[low], rank[high]
    row, column = np.maximum(r_low, r_high), np.minimum(r_low, r_high)
    row, column = np.concatenate([row, np.arange(n)]), np.concatenate([column, np.arange(n)])
    key = np.sort(row * n + column)
    nptr = np.concatenate([[0], np.cumsum(np.bincount(key // n, minlength=n))]).astype(np.int32)
    nind = (key % n).astype(np.int32)
    node = np.where(body >= 0, rank[np.maximum(body, 0)], -1).astype(np.int32)
    turned = node[:, 0] < node[:, 1]
    node[turned] = node[turned][:, ::-1]
    node = np.ascontiguousarray(node)
    first, second = node[:, 0].astype(np.int64), node[:, 1].astype(np.int64)
    slot = np.zeros((len(body), 3), np.int32)
    slot[:, 0] = nptr[np.maximum(first, 0) + 1] - 1
    slot[:, 1] = nptr[np.maximum(second, 0) + 1] - 1
    slot[both, 2] = np.searchsorted(key, first[both] * n + second[both])
    return nptr, nind, node, slot, turned.astype(np.int32)


def _fill_reducing(n: int, low: Any, high: Any) -> Any:
    # Minimum degree (through qdldl) on the graph of bodies; a band of width 1 is left as it is.
    if len(low) == 0 or int((high - low).max()) <= 1:
        return np.arange(n)
    degree = np.bincount(low, minlength=n) + np.bincount(high, minlength=n) + 1.0
    index = np.concatenate([low, np.arange(n)])
    other = np.concatenate([high, np.arange(n)])
    value = np.concatenate([np.full(len(low), -1.0), degree])
    graph = sp.csc_matrix((value, (index, other)), shape=(n, n))
    import qdldl

    order = np.asarray(qdldl.Solver(graph, upper=True).factors()[2], np.int64)
    rank = np.empty(n, np.int64)
    rank[order] = np.arange(n)
    return rank


def make_system(problem: Problem, form: str) -> System:
    """The system of a problem; form "velocity" or "impulse"."""
    sc = scaled(problem)
    return VelocitySystem(sc) if form == "velocity" else MatrixSystem(sc)


@dataclass
class InteriorPoint:
    """Iterates of a Mehrotra predictor-corrector; `step()` takes one, `z` is the current point."""

    system: System
    delta: float = DELTA
    apart: bool = False  # the first point leaves each boundary by what that one needs, not all by the worst
    z: FloatArray = field(init=False)
    everything: FloatArray = field(init=False)
    gap: float = field(init=False, default=np.inf)  # G z . u / degree
    lowest_gap: float = field(init=False, default=np.inf)  # before this step
    first_gap: float = field(init=False, default=0.0)
    length: float = field(init=False, default=1.0)
    error: tuple[float, float] | None = field(init=False, default=None)  # of z, where a step has it anyway
    changed: int | None = field(init=False, default=None)  # rows that changed their side, likewise

    def __post_init__(self) -> None:
        sy, sc = self.system, self.system.sc
        m = sc.m
        self.u1, self.u2 = np.zeros(m), np.zeros(m)
        self.inner: Any = None
        if type(sy) is VelocitySystem and type(self) is InteriorPoint:
            self.inner = Interior(
                sy.elements, sy.blocks(False), sy.v, sy.bt, self.u1, self.u2, sc.speed, self.delta, DAMPING
            )
            sy.factorisations += 1
            self.inner.first(START, DELTA)
            self.z = self.inner.z
            self.everything = self.z.copy()
            self.degree = self.inner.begin(MARGIN if self.apart else DUAL_START, self.apart)
            return
        size = np.diff(sc.ptr)
        free = (
            (sc.kind == ROW) & np.isinf(sc.lower[sc.ptr[:-1]]) & np.isinf(sc.upper[sc.ptr[:-1]])
            if m
            else np.zeros(0, bool)
        )
        diagonal = np.repeat(sc.wptr[:-1], size) + (np.arange(m) - np.repeat(sc.ptr[:-1], size)) * (
            np.repeat(size, size) + 1
        )
        sy.v[:] = 0.0
        sy.v[diagonal] = 1.0 / (sc.theta + np.where(np.repeat(free, size), DELTA, START))
        if sy.bt is not None:
            sy.bt[:] = np.sqrt(sy.v)
        self.t1, self.t2, self.r = np.zeros(m), np.zeros(m), np.zeros(m)
        sy.factor_barrier()
        self.z = sy.solve_barrier(sc.g)
        self.everything = self.z.copy()  # nearly H z = g on every row: where all of them hold, the answer
        shift = MARGIN if self.apart else DUAL_START
        self.degree = sy.elements.start(sy.times(self.z), shift, self.z, self.u1, self.u2, self.apart)

    def step(self) -> bool:
        """One predictor-corrector step; False where the factorisation or the step fails."""
        sy, sc, e = self.system, self.system.sc, self.system.elements
        if self.inner is not None:
            sy.factorisations += 1
            went, self.length, mu, energy, velocity, self.changed = self.inner.step()
            self.error = energy, velocity
            self.lowest_gap = min(self.lowest_gap, self.gap)
            self.gap = mu
            self.first_gap = max(self.first_gap, mu)
            return went
        z, u1, u2 = self.z, self.u1, self.u2
        hz = sy.times(z)
        gap = e.scale(z, u1, u2, self.delta, sy.v, sy.bt)
        if not sy.factor_barrier() and not np.isfinite(gap):
            return False
        da = sy.solve_barrier(sc.g - hz)
        mu = gap / max(self.degree, 1.0)
        if self.degree > 0:
            _, after = e.affine(z, u1, u2, da)
            sigma = min(1.0, max(after / gap, 0.0)) ** 3 if gap > 0 else 0.0
        else:
            sigma = 0.0
        e.rhs(z, u1, u2, hz, da, sigma * mu, self.r)
        dz = sy.solve_barrier(self.r)
        if not np.isfinite(dz).all():
            return False
        self.length = e.step(z, u1, u2, dz, da, sigma * mu, DAMPING, self.t1, self.t2)
        self.lowest_gap = min(self.lowest_gap, self.gap)
        self.gap = mu
        self.first_gap = max(self.first_gap, mu)
        return self.length > 0.0
