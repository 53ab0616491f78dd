"""N = I + K^T V K for Python: formed, factored and solved with."""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.factor.blocks cimport factor_t, sparse_t
from lavender_ext.factor.cholesky cimport block_cholesky, block_solve
from lavender_ext.factor.lu cimport block_lu, block_lu_solve
from lavender_ext.factor.sparse cimport SparsePanels
from lavender_ext.newton.elements cimport Elements, elements_t
from lavender_ext.newton.normal_matrix cimport normal_matrix
from lavender_ext.newton.panel cimport to_bodies, to_rows


cdef public int32_t lav_block_cholesky(const factor_t* f) noexcept nogil:
    return block_cholesky(f)


cdef public void lav_block_solve(const factor_t* f, double* x) noexcept nogil:
    block_solve(f, x)


cdef public int32_t lav_block_lu(const factor_t* f) noexcept nogil:
    return block_lu(f)


cdef public void lav_block_lu_solve(const factor_t* f, double* x) noexcept nogil:
    block_lu_solve(f, x)


cdef public void lav_normal_matrix(const elements_t* e, const double* v, const factor_t* f, int32_t lu) noexcept nogil:
    normal_matrix(e, v, f, lu)


cdef public void lav_to_bodies(const elements_t* e, int32_t n, const double* x, double* y) noexcept nogil:
    to_bodies(e, n, x, y)


cdef public void lav_to_rows(const elements_t* e, const double* y, double* x) noexcept nogil:
    to_rows(e, y, x)


cdef class Factor:
    """N = I + K^T V K and its block factor; arrays as in `factor_t`, the pattern from `factor_pattern`.

    `panels`: what `symbolic.block_panels` gives, for a factor by dense panels; L U has none.
    """
    def __init__(self, nptr, nind, lptr, lind, rptr, rind, int s, bint unsymmetric, panels=None, bint wide=True):
        n = len(nptr) - 1
        blocks = s * s
        def zeros(count):
            return np.zeros(max(1, count))
        panels = None if unsymmetric else panels
        held = int(lptr[n]) if panels is None else 0
        nval, lval = zeros(len(nind) * blocks), zeros(held * blocks)
        mval = zeros(len(nind) * blocks) if unsymmetric else zeros(0)
        uval = zeros(int(lptr[n]) * blocks) if unsymmetric else zeros(0)
        dval, work, work2 = zeros(n * blocks), zeros(n * blocks), zeros(n * blocks if unsymmetric else 0)
        pivot, nxt = np.zeros(n * s + 1, np.int32), np.zeros(n + 1, np.int32)
        cdef sparse_t* none = NULL
        self.keep = [nptr, nind, lptr, lind, rptr, rind, nval, lval, mval, uval, dval, work, work2, pivot, nxt]
        self.n, self.s, self.unsymmetric, self.lu = n, s, unsymmetric, False
        self.f = factor_t(
            n, s, <int32_t*>address(nptr), <int32_t*>address(nind), <int32_t*>address(rptr), <int32_t*>address(rind),
            <int32_t*>address(lptr), <int32_t*>address(lind), <double*>address(nval), <double*>address(mval),
            <double*>address(lval), <double*>address(uval), <double*>address(dval), <double*>address(work),
            <double*>address(work2), <int32_t*>address(pivot), <int32_t*>address(nxt), none, NULL)
        cdef SparsePanels held_panels
        cdef const int64_t[::1] spot
        if panels is not None:
            held_panels = SparsePanels.of_blocks(panels[1:], self.n * s, wide)
            spot = panels[0]
            self.keep += [held_panels, panels[0]]
            self.f.super = &held_panels.f
            self.f.spot = &spot[0]

    def factor(self, Elements e, const double[::1] v, bint lu=False):
        """Forms N of V and factors it; returns the number of pivots lost to rounding."""
        cdef int32_t lost
        self.lu = lu
        with nogil:
            lav_normal_matrix(&e.e, &v[0], &self.f, lu)
            lost = lav_block_lu(&self.f) if lu else lav_block_cholesky(&self.f)
        return lost

    def solve(self, Elements e, const double[::1] x, double[::1] y, double[::1] out):
        """y <- N^-1 K^T x, out <- K y."""
        with nogil:
            lav_to_bodies(&e.e, self.n, &x[0], &y[0])
            if self.lu:
                lav_block_lu_solve(&self.f, &y[0])
            else:
                lav_block_solve(&self.f, &y[0])
            lav_to_rows(&e.e, &y[0], &out[0])

    def gram(self, Elements e, const double[::1] x, double[::1] y, double[::1] out):
        """out <- K K^T x, y <- K^T x."""
        with nogil:
            lav_to_bodies(&e.e, self.n, &x[0], &y[0])
            lav_to_rows(&e.e, &y[0], &out[0])
