"""Block Cholesky of a symmetric positive definite matrix, N = L L^T, up-looking by block rows.

Where a factor has panels, by those (`supernodal.pxd`).
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.factor.blocks cimport factor_t
from lavender_ext.factor.supernodal cimport panels_solve, super_cholesky


cdef inline void sub_transposed(double* wt, const double* yt, const double* lt, const int32_t s) noexcept nogil:
    # w -= y l^T with all three transposed: w^T -= l y^T
    cdef int32_t r, c, t
    cdef double x
    cdef double row[6]
    for c in range(s):
        for r in range(s):
            row[r] = wt[c * s + r]
        for t in range(s):
            x = lt[t * s + c]
            for r in range(s):
                row[r] -= x * yt[t * s + r]
        for r in range(s):
            wt[c * s + r] = row[r]


cdef inline int32_t small_cholesky(double* a, const int32_t s) noexcept nogil:
    # a = l l^T in the lower triangle; the diagonal holds 1 / l_ii. A pivot lost to rounding drops its column.
    cdef int32_t i, j, t, lost = 0
    cdef double x, top
    for j in range(s):
        top = a[j * s + j]
        x = top
        for t in range(j):
            x -= a[j * s + t] * a[j * s + t]
        if not x > 1e-15 * top:
            lost += 1
            x = 0.0
        else:
            x = 1.0 / sqrt(x)
        a[j * s + j] = x
        for i in range(j + 1, s):
            top = a[i * s + j]
            for t in range(j):
                top -= a[i * s + t] * a[j * s + t]
            a[i * s + j] = top * x
    return lost


cdef inline void sub_column_3(const factor_t* f, int32_t start, int32_t end, const double* y) noexcept nogil:
    # w^T -= l y^T for blocks `start` to `end` of a column, 3 x 3 each; y in locals, which no store can change
    cdef double a0 = y[0], a1 = y[1], a2 = y[2], b0 = y[3], b1 = y[4], b2 = y[5], c0 = y[6], c1 = y[7], c2 = y[8]
    cdef double u, v, w
    cdef int32_t p
    cdef double *to
    cdef const double *l = f.lval + 9 * <int64_t>start
    for p in range(start, end):
        to = f.work + 9 * f.lind[p]
        u = l[0]
        v = l[3]
        w = l[6]
        to[0] -= u * a0 + v * b0 + w * c0
        to[1] -= u * a1 + v * b1 + w * c1
        to[2] -= u * a2 + v * b2 + w * c2
        u = l[1]
        v = l[4]
        w = l[7]
        to[3] -= u * a0 + v * b0 + w * c0
        to[4] -= u * a1 + v * b1 + w * c1
        to[5] -= u * a2 + v * b2 + w * c2
        u = l[2]
        v = l[5]
        w = l[8]
        to[6] -= u * a0 + v * b0 + w * c0
        to[7] -= u * a1 + v * b1 + w * c1
        to[8] -= u * a2 + v * b2 + w * c2
        l += 9


cdef inline void solve_right(double* yt, const double* l, const int32_t s) noexcept nogil:
    # y <- y l^-T, held transposed: y^T <- l^-1 y^T, a row of y^T at a time
    cdef int32_t r, c, t
    cdef double x
    cdef double row[6]
    for c in range(s):
        for r in range(s):
            row[r] = yt[c * s + r]
        for t in range(c):
            x = l[c * s + t]
            for r in range(s):
                row[r] -= x * yt[t * s + r]
        x = l[c * s + c]
        for r in range(s):
            yt[c * s + r] = row[r] * x


cdef inline int32_t factor_blocks(const factor_t* f, const int32_t s) noexcept nogil:
    # Row k of N and of L as transposed blocks: every loop inside runs along a row of them.
    cdef int32_t k, q, p, j, c, r, lost = 0
    cdef int64_t b = s * s
    cdef double *y
    cdef double *l
    for k in range(f.n):
        f.next[k] = f.lptr[k]
    for k in range(f.n):
        for q in range(f.nptr[k], f.nptr[k + 1]):
            y = f.work + f.nind[q] * b
            for r in range(s):
                for c in range(s):
                    y[c * s + r] = f.nval[q * b + r * s + c]
        for q in range(f.rptr[k], f.rptr[k + 1]):
            j = f.rind[q]
            y = f.work + j * b
            solve_right(y, f.dval + j * b, s)
            if s == 3:
                sub_column_3(f, f.lptr[j], f.next[j], y)
            else:
                for p in range(f.lptr[j], f.next[j]):
                    sub_transposed(f.work + f.lind[p] * b, y, f.lval + p * b, s)
            sub_transposed(f.work + k * b, y, y, s)
            l = f.lval + f.next[j] * b
            f.next[j] += 1
            for c in range(s * s):
                l[c] = y[c]
                y[c] = 0.0
        y = f.work + k * b
        lost += small_cholesky(y, s)
        for c in range(s * s):
            f.dval[k * b + c] = y[c]
            y[c] = 0.0
    return lost


cdef inline int32_t block_cholesky(const factor_t* f) noexcept nogil:
    """N = L L^T, by panels or up-looking by block rows; returns the number of pivots lost to rounding."""
    if f.super != NULL:
        return super_cholesky(f)
    if f.s == 1:
        return factor_blocks(f, 1)
    if f.s == 2:
        return factor_blocks(f, 2)
    if f.s == 3:
        return factor_blocks(f, 3)
    if f.s == 6:
        return factor_blocks(f, 6)
    return factor_blocks(f, f.s)


cdef inline void solve_blocks(const factor_t* f, double* x, const int32_t s) noexcept nogil:
    cdef int32_t j, p, r, c
    cdef int64_t b = s * s
    cdef double t
    cdef const double *l
    cdef const double *d
    cdef double *y
    for j in range(f.n):
        d = f.dval + j * b
        for r in range(s):
            t = x[j * s + r]
            for c in range(r):
                t -= d[r * s + c] * x[j * s + c]
            x[j * s + r] = t * d[r * s + r]
        for p in range(f.lptr[j], f.lptr[j + 1]):
            l = f.lval + p * b
            y = x + f.lind[p] * s
            for c in range(s):
                t = x[j * s + c]
                for r in range(s):
                    y[r] -= l[c * s + r] * t
    for j in range(f.n - 1, -1, -1):
        for p in range(f.lptr[j], f.lptr[j + 1]):
            l = f.lval + p * b
            y = x + f.lind[p] * s
            for c in range(s):
                t = 0.0
                for r in range(s):
                    t += l[c * s + r] * y[r]
                x[j * s + c] -= t
        d = f.dval + j * b
        for r in range(s - 1, -1, -1):
            t = x[j * s + r]
            for c in range(r + 1, s):
                t -= d[c * s + r] * x[j * s + c]
            x[j * s + r] = t * d[r * s + r]


cdef inline void block_solve(const factor_t* f, double* x) noexcept nogil:
    """x <- N^-1 x after `block_cholesky`, x (n, s)."""
    if f.super != NULL:
        panels_solve(f.super, x, 0)
        return
    if f.s == 1:
        solve_blocks(f, x, 1)
    elif f.s == 3:
        solve_blocks(f, x, 3)
    elif f.s == 6:
        solve_blocks(f, x, 6)
    else:
        solve_blocks(f, x, f.s)
