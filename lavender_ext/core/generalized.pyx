"""J and M of generalised coordinates for Python: M's factor, kept, and what the judge and the solvers read of it."""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memset

import numpy as np

from lavender_ext.core.arrays cimport doubles, ints
from lavender_ext.core.door cimport is_beyond
from lavender_ext.core.generalized cimport estimate_condition, jac_push, jac_row, tree_solve
from lavender_ext.core.tree cimport tree_factor, tree_pattern

cdef object new = np.empty, I4 = np.dtype(np.int32)

cdef int64_t MOST = 2**31 - 1   # entries of L that 32-bit indices reach


cdef object pattern_of(int32_t n, const int32_t* mptr, const int32_t* midx, int64_t most=MOST):
    """L's columns by the elimination of M, in one array: lptr (n + 1), parent (n), scratch (3 n), then lidx."""
    cdef int64_t workspace = mptr[n] + 1
    cdef int32_t count = -1
    cdef int32_t[::1] whole
    most = min(<int64_t>n * n // 2 + 1, most)
    while True:                                         # again where M's pattern is no tree's: L has more entries
        marks = new(5 * <int64_t>n + 1 + workspace, I4)
        whole = marks
        count = tree_pattern(n, mptr, midx, <int32_t>workspace, &whole[0], &whole[5 * n + 1], &whole[n + 1],
                             &whole[2 * n + 1], &whole[3 * n + 1], &whole[4 * n + 1])
        if count >= 0:
            return marks
        if workspace >= most:
            raise MemoryError(f"the factor of M ({n}, {n}) has more than {most} entries")
        workspace = min(2 * workspace, most)


cdef class Operator:
    """J in compressed rows and M by its lower triangle, diagonal included, with M = L^T D L.

    The caller passes checked int32 and float64 arrays with ascending columns; they are kept alive here. `like` is another
    operator, whose pattern of L is shared where its M has entries in the same places; MemoryError, if L has more than
    `most`. L has no numbers before `factor`, which finds in `failed` the row of M whose pivot is not positive, -1 where M
    is positive definite.
    """

    def __init__(self, jptr_, jidx_, jval_, mptr_, midx_, mval_, Operator like=None, int64_t most=MOST):
        cdef int32_t m = <int32_t>len(jptr_) - 1, n = <int32_t>len(mptr_) - 1
        cdef const int32_t* mptr = ints(mptr_, n + 1)
        cdef const int32_t* midx = ints(midx_, len(midx_))
        self.jac = (jptr_, jidx_, jval_)
        self.mass = (mptr_, midx_, mval_)
        self.g.mptr, self.g.midx, self.g.mval = mptr, midx, doubles(mval_, len(mval_))
        self.g.n = n
        self.g.m = m
        self.g.jptr = ints(jptr_, m + 1)
        self.g.jidx = ints(jidx_, len(jidx_))
        self.g.jval = doubles(jval_, len(jval_))
        if like is not None and like.has_pattern(n, mptr, midx):
            marks = like.keep[0]
            self.g.lptr = like.g.lptr
            self.g.lidx = like.g.lidx
            self.g.parent = like.g.parent
        else:
            marks = pattern_of(n, mptr, midx, most)
            self.g.lptr = ints(marks, len(marks))
            self.g.parent = self.g.lptr + n + 1
            self.g.lidx = self.g.parent + 4 * n
        self.keep, self.failed = [marks], -1

    def factor(self):
        """L and D, and the condition of M."""
        cdef int32_t n = self.g.n, i
        cdef int64_t used = 2 * <int64_t>n + self.g.lptr[n] + 1, size = used + 2 * <int64_t>n
        cdef double* numbers
        factor = new(size)
        numbers = doubles(factor, size)
        self.keep.append(factor)
        self.g.lval = numbers + 2 * n
        self.g.inv_pivot = numbers
        self.g.root = numbers + n                       # the factor's pivots, until it is there
        if n:
            self.failed = tree_factor(n, self.g.mptr, self.g.midx, self.g.mval, self.g.lptr, self.g.lidx, numbers + 2 * n,
                                      numbers + n, numbers)
        for i in range(n):
            numbers[n + i] = sqrt(numbers[i])
        if self.failed < 0:
            self.g.condition = estimate_condition(&self.g, numbers + used)

    def share_factor(self, Operator other):
        """Take L and D of another operator, whose M is the same and whose factor is known."""
        self.keep.append(other.keep[1])
        self.g.lval, self.g.inv_pivot, self.g.root = other.g.lval, other.g.inv_pivot, other.g.root
        self.failed = other.failed

    cdef bint has_pattern(self, int32_t n, const int32_t* mptr, const int32_t* midx):
        return self.g.n == n and (self.g.mptr == mptr or memcmp(self.g.mptr, mptr, (n + 1) * sizeof(int32_t)) == 0) and (
            self.g.midx == midx or memcmp(self.g.midx, midx, mptr[n] * sizeof(int32_t)) == 0)

    @property
    def n(self):
        """Velocities, nv."""
        return self.g.n

    @property
    def m(self):
        """Rows of J."""
        return self.g.m

    @property
    def fill(self):
        """Entries of L left of the diagonal that M does not have."""
        return self.g.lptr[self.g.n] - (self.g.mptr[self.g.n] - self.g.n)

    @property
    def condition(self):
        """Estimate of |H^-1|, H = M scaled to a diagonal of ones."""
        return self.g.condition

    @property
    def least_pivot(self):
        """The least pivot of M over its diagonal entry; 1 of a diagonal M."""
        cdef const int32_t[::1] mptr = self.mass[0]
        cdef const double[::1] mval = self.mass[2]
        cdef double least = 1.0
        cdef int32_t i
        for i in range(self.g.n):
            least = min(least, 1.0 / (self.g.inv_pivot[i] * mval[mptr[i + 1] - 1]))
        return least

    def is_beyond(self, double bound):
        """Whether any |J_ij|, |L_ij| or 1 / D_i is larger."""
        return (is_beyond(self.g.jval, self.g.jptr[self.g.m], bound) or is_beyond(self.g.inv_pivot, self.g.n, bound)
                or is_beyond(self.g.lval, self.g.lptr[self.g.n], bound))

    @property
    def work(self):
        """Multiply-adds of the factor: of a row with c entries left of the diagonal c (c + 1) / 2."""
        cdef int32_t i, c
        cdef double out = 0.0
        for i in range(self.g.n):
            c = self.g.lptr[i + 1] - self.g.lptr[i]
            out += 0.5 * c * (c + 1.0)
        return out

    @property
    def parents(self):
        """Parent of each velocity in the tree of M's factor (n,), -1 at a root; a new array."""
        cdef int32_t i
        cdef int32_t[::1] out = np.empty(self.g.n, np.int32)
        for i in range(self.g.n):
            out[i] = self.g.parent[i]
        return out.base

    def solve(self, x):
        """x <- M^-1 x (n,)."""
        if self.g.n:
            tree_solve(&self.g, doubles(x, self.g.n))

    def force(self, lam):
        """J^T lam (n,), a new array."""
        cdef const double* at = doubles(lam, self.g.m)
        cdef double* x
        made = new(self.g.n)
        x = doubles(made, self.g.n)
        memset(x, 0, self.g.n * sizeof(double))
        if self.g.n and self.g.m:
            jac_push(&self.g, at, x)
        return made

    def momentum(self, given):
        """M v (n,), a new array."""
        cdef const int32_t* mptr = self.g.mptr
        cdef const int32_t* midx = self.g.midx
        cdef const double* mval = self.g.mval
        cdef const double* v = doubles(given, self.g.n)
        cdef int32_t i, p
        cdef double* x
        made = new(self.g.n)
        x = doubles(made, self.g.n)
        for i in range(self.g.n):
            p = mptr[i + 1] - 1
            x[i] = mval[p] * v[i]
            for p in range(mptr[i], p):
                x[i] += mval[p] * v[midx[p]]
                x[midx[p]] += mval[p] * v[i]
        return made

    def times(self, given):
        """J x (m,), a new array."""
        cdef const double* x = doubles(given, self.g.n)
        cdef int32_t i
        cdef double* out
        made = new(self.g.m)
        out = doubles(made, self.g.m)
        for i in range(self.g.m):
            out[i] = jac_row(&self.g, i, x) if self.g.n else 0.0
        return made

    def bias(self, given, target):
        """b = target - J v (m,), a new array; what leaves the door's range is left to whoever reads it."""
        cdef const double* v = doubles(given, self.g.n)
        cdef const double* t = doubles(target, self.g.m)
        cdef int32_t i
        cdef double* out
        made = new(self.g.m)
        out = doubles(made, self.g.m)
        for i in range(self.g.m):
            out[i] = t[i] - (jac_row(&self.g, i, v) if self.g.n else 0.0)
        return made


def lower_of_dense(const double[:, ::1] a):
    """(indptr, indices, data) of the lower triangle with its diagonal, and the worst asymmetry.

    The asymmetry is (i, j, |a_ij - a_ji| / sqrt(a_ii a_jj)), the largest; rows whose diagonal is not positive count
    with 1 there.
    """
    cdef int32_t n = <int32_t>a.shape[0], i, j, nnz = 0, at_i = 0, at_j = 0
    cdef double worst = 0.0, x, s
    for i in range(n):
        for j in range(i):
            nnz += a[i, j] != 0.0 or a[j, i] != 0.0
    whole = new(n + 1 + nnz + n, I4)
    values = new(nnz + n)
    cdef int32_t[::1] k = whole
    cdef double[::1] v = values
    nnz = 0
    k[0] = 0
    for i in range(n):
        for j in range(i):
            if a[i, j] != 0.0 or a[j, i] != 0.0:
                k[n + 1 + nnz] = j
                v[nnz] = a[i, j]
                nnz += 1
                x = fabs(a[i, j] - a[j, i])
                if x > 0.0:
                    s = a[i, i] * a[j, j]
                    x = x / sqrt(s) if s > 0.0 else x
                    if x > worst:
                        worst = x
                        at_i = i
                        at_j = j
        k[n + 1 + nnz] = i
        v[nnz] = a[i, i]
        nnz += 1
        k[i + 1] = nnz
    return (whole[:n + 1], whole[n + 1:], values), (at_i, at_j, worst)


def lower_of_rows(const int32_t[::1] ptr, const int32_t[::1] idx, const double[::1] val):
    """The same of compressed rows with ascending columns; an entry across the diagonal that is not stored is 0."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1, i, p, q, low, high, nnz = 0, at_i = 0, at_j = 0
    cdef double worst = 0.0, x, s
    diagonal, whole, values = np.zeros(n), new(2 * n + 1 + idx.shape[0], I4), new(n + idx.shape[0])
    cdef double[::1] d = diagonal, v = values
    cdef int32_t[::1] k = whole
    k[0] = 0
    for i in range(n):
        for p in range(ptr[i], ptr[i + 1]):
            if idx[p] == i:
                d[i] = val[p]
    for i in range(n):
        for p in range(ptr[i], ptr[i + 1]):
            if idx[p] == i:
                continue
            low, high = ptr[idx[p]], ptr[idx[p] + 1]
            while low < high:
                q = low + (high - low) // 2
                if idx[q] < i:
                    low = q + 1
                else:
                    high = q
            x = fabs(val[p] - (val[low] if low < ptr[idx[p] + 1] and idx[low] == i else 0.0))
            if x > 0.0:
                s = d[i] * d[idx[p]]
                x = x / sqrt(s) if s > 0.0 else x
                if x > worst:
                    worst, at_i, at_j = x, i, idx[p]
            if idx[p] < i:
                k[n + 1 + nnz] = idx[p]
                v[nnz] = val[p]
                nnz += 1
        k[n + 1 + nnz] = i
        v[nnz] = d[i]
        nnz += 1
        k[i + 1] = nnz
    return (whole[:n + 1], whole[n + 1:n + 1 + nnz], values[:nnz]), (at_i, at_j, worst)


def pattern_fill(const int32_t[::1] mptr, const int32_t[::1] midx):
    """Entries that the factor of a matrix with this lower triangle has beyond it."""
    cdef int32_t n = <int32_t>mptr.shape[0] - 1
    return int(pattern_of(n, &mptr[0], &midx[0] if midx.shape[0] else NULL)[n]) - (midx.shape[0] - n)
