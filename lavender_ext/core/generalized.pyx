"""J and M of generalised coordinates for Python, with the factor of M for the judge and the solvers."""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memset

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer, get_plain_matrix, ndarray
from lavender_ext.core.validate cimport any_magnitude_above
from lavender_ext.core.condition cimport estimate_condition
from lavender_ext.core.generalized cimport multiply_jacobian_transpose, multiply_jacobian_row, solve_mass_matrix
from lavender_ext.core.mass cimport (THIN_PADDING, relative_entry_asymmetry, compress_lower_triangle, factor_mass,
                                     count_mass_factor_work, ordering_pays_off)
from lavender_ext.core.tree cimport find_tree_factor_pattern

cdef object new = np.empty, I4 = np.dtype(np.int32)


cdef object allocate_factor_pattern(int32_t n, const int32_t* mptr, const int32_t* midx, int64_t max_entries=MAX_INDEX):
    """Return an array with the pattern of L: lptr (n + 1), parent (n), 3 n integers of scratch, then lidx; int32."""
    cdef int64_t workspace = mptr[n] + 1
    cdef int32_t count = -1
    cdef int32_t[::1] whole
    max_entries = min(<int64_t>n * n // 2 + 1, max_entries)
    # Repeat with more memory if the pattern of M is not a tree, because L then has more entries than M.
    while True:
        marks = new(5 * <int64_t>n + 1 + workspace, I4)
        whole = marks
        count = find_tree_factor_pattern(n, mptr, midx, <int32_t>workspace, &whole[0], &whole[5 * n + 1], &whole[n + 1],
                             &whole[2 * n + 1], &whole[3 * n + 1], &whole[4 * n + 1])
        if count >= 0:
            return marks
        if workspace >= max_entries:
            raise MemoryError(f"the factor of M ({n}, {n}) has more than {max_entries} entries")
        workspace = min(2 * workspace, max_entries)


cdef class Operator:
    """J in compressed rows and M as its lower triangle with diagonal, with the factor M = L^T D L.

    Parameters
    ----------
    jptr_, jidx_, jval_ : ndarray
        J (m, nv) in compressed rows: int32 indices, ascending in each row, and float64 values. Already validated; the
        arrays are kept alive.
    mptr_, midx_, mval_ : ndarray
        Lower triangle of M (nv, nv) in the same form.
    like : Operator, optional
        Operator from which the pattern of L is taken if its M has the same pattern.
    max_entries : int
        MemoryError is raised if L has more entries.

    Notes
    -----
    L has no values before `factor` is called, which sets `failed` to the row of M without a positive pivot, or to -1 if M
    is positive definite.
    """

    def __init__(self, jptr_, jidx_, jval_, mptr_, midx_, mval_, Operator like=None, int64_t max_entries=MAX_INDEX):
        cdef int32_t m = <int32_t>len(jptr_) - 1, n = <int32_t>len(mptr_) - 1
        cdef const int32_t* mptr = as_int_pointer(mptr_, n + 1)
        cdef const int32_t* midx = as_int_pointer(midx_, len(midx_))
        self.jac = (jptr_, jidx_, jval_)
        self.mass = (mptr_, midx_, mval_)
        self.g.mptr, self.g.midx, self.g.mval = mptr, midx, as_double_pointer(mval_, len(mval_))
        self.g.n = n
        self.g.m = m
        self.g.jptr = as_int_pointer(jptr_, m + 1)
        self.g.jidx = as_int_pointer(jidx_, len(jidx_))
        self.g.jval = as_double_pointer(jval_, len(jval_))
        if like is not None and like.has_pattern(n, mptr, midx):
            marks = like.keep[0]
            self.g.lptr = like.g.lptr
            self.g.lidx = like.g.lidx
            self.g.parent = like.g.parent
        else:
            marks = allocate_factor_pattern(n, mptr, midx, max_entries)
            self.g.lptr = as_int_pointer(marks, len(marks))
            self.g.parent = self.g.lptr + n + 1
            self.g.lidx = self.g.parent + 4 * n
        self.keep, self.failed = [marks], -1

    def factor(self):
        """Compute L and D, and estimate the condition of M; return `failed`."""
        cdef int32_t n = self.g.n
        factor = new(4 * <int64_t>n + self.g.lptr[n] + 1)
        cdef double* numbers = <double*>(<ndarray>factor).data
        self.keep.append(factor)
        self.failed = factor_mass(&self.g, numbers + 2 * n, numbers, numbers + n)
        if self.failed < 0:
            self.g.condition = estimate_condition(&self.g, numbers + 2 * n + self.g.lptr[n] + 1)
        return self.failed

    def share_factor(self, Operator other):
        """Share L and D of another, factored operator with the same M."""
        self.keep.append(other.keep[1])
        self.g.lval, self.g.inv_pivot, self.g.root = other.g.lval, other.g.inv_pivot, other.g.root
        self.failed = other.failed

    cdef bint has_pattern(self, int32_t n, const int32_t* mptr, const int32_t* midx):
        """Return whether the lower triangle of M has n rows and this pattern in compressed rows."""
        return self.g.n == n and (self.g.mptr == mptr or memcmp(self.g.mptr, mptr, (n + 1) * sizeof(int32_t)) == 0) and (
            self.g.midx == midx or memcmp(self.g.midx, midx, mptr[n] * sizeof(int32_t)) == 0)

    @property
    def n(self):
        """Number of velocities, nv."""
        return self.g.n

    @property
    def m(self):
        """Number of rows of J."""
        return self.g.m

    @property
    def fill(self):
        """Number of entries of L left of the diagonal that M does not have."""
        return self.g.lptr[self.g.n] - (self.g.mptr[self.g.n] - self.g.n)

    @property
    def condition(self):
        """Estimate of |H^-1|, where H is M scaled to a unit diagonal."""
        return self.g.condition

    @property
    def least_pivot(self):
        """Smallest ratio of a pivot of M to its diagonal entry; 1 if M is diagonal."""
        cdef const int32_t[::1] mptr = self.mass[0]
        cdef const double[::1] mval = self.mass[2]
        cdef double smallest = 1.0
        cdef int32_t i
        for i in range(self.g.n):
            smallest = min(smallest, 1.0 / (self.g.inv_pivot[i] * mval[mptr[i + 1] - 1]))
        return smallest

    cpdef bint has_entry_above(self, double bound):
        """Return whether any |J_ij|, |M_ij|, |L_ij| or 1 / D_i is above `bound` or NaN."""
        return (any_magnitude_above(self.g.jval, self.g.jptr[self.g.m], bound)
                or any_magnitude_above(self.g.mval, self.g.mptr[self.g.n], bound)
                or any_magnitude_above(self.g.inv_pivot, self.g.n, bound)
                or any_magnitude_above(self.g.lval, self.g.lptr[self.g.n], bound))

    @property
    def work(self):
        """Multiply-adds of the factorisation of M."""
        return count_mass_factor_work(&self.g)

    @property
    def is_worth_ordering(self):
        """Whether the search of an order with less fill-in takes less time than it saves (core/mass.pxd)."""
        return ordering_pays_off(&self.g, self.g.mptr[self.g.n])

    @property
    def parents(self):
        """Parent of each velocity (n,) in the elimination tree of M, -1 at a root; a new array."""
        cdef int32_t i
        cdef int32_t[::1] out = np.empty(self.g.n, np.int32)
        for i in range(self.g.n):
            out[i] = self.g.parent[i]
        return out.base

    def solve(self, x):
        """Overwrite x (n,) with M^-1 x."""
        if self.g.n:
            solve_mass_matrix(&self.g, as_double_pointer(x, self.g.n))

    def multiply_jacobian_transpose(self, lam):
        """Return J^T lam (n,), a new array."""
        cdef const double* at = as_double_pointer(lam, self.g.m)
        cdef double* x
        result = new(self.g.n)
        x = as_double_pointer(result, self.g.n)
        memset(x, 0, self.g.n * sizeof(double))
        if self.g.n and self.g.m:
            multiply_jacobian_transpose(&self.g, at, x)
        return result

    def multiply_mass(self, velocity):
        """Return M v (n,), a new array."""
        cdef const int32_t* mptr = self.g.mptr
        cdef const int32_t* midx = self.g.midx
        cdef const double* mval = self.g.mval
        cdef const double* v = as_double_pointer(velocity, self.g.n)
        cdef int32_t i, p
        cdef double* x
        result = new(self.g.n)
        x = as_double_pointer(result, self.g.n)
        for i in range(self.g.n):
            p = mptr[i + 1] - 1
            x[i] = mval[p] * v[i]
            for p in range(mptr[i], p):
                x[i] += mval[p] * v[midx[p]]
                x[midx[p]] += mval[p] * v[i]
        return result

    def multiply_jacobian(self, velocity):
        """Return J v (m,), a new array."""
        cdef const double* x = as_double_pointer(velocity, self.g.n)
        cdef int32_t i
        cdef double* out
        result = new(self.g.m)
        out = as_double_pointer(result, self.g.m)
        for i in range(self.g.m):
            out[i] = multiply_jacobian_row(&self.g, i, x) if self.g.n else 0.0
        return result


def lower_triangle_of_dense(a, double max_asymmetry):
    """Return (indptr, indices, data) of the lower triangle with diagonal, and the largest asymmetry.

    The asymmetry is (i, j, `relative_entry_asymmetry` of core/mass.pxd) of the pair with the largest value, (0, 0, 0) unless a
    value is above `max_asymmetry`. None is returned unless a is a square, C-contiguous float64 array with valid numbers.
    """
    cdef Py_ssize_t rows = 0, columns = 0, nonzeros = 0
    cdef const double* entries = get_plain_matrix(a, &rows, &columns, &nonzeros)
    if entries == NULL or rows != columns:
        return None
    cdef int32_t n = <int32_t>rows, i, j, nnz, at_i = 0, at_j = 0
    cdef double worst = 0.0, x
    cdef Py_ssize_t size = min(rows * (rows + 1) // 2, rows + nonzeros)
    whole, values = new(n + 1 + size + THIN_PADDING, I4), new(size + THIN_PADDING)
    cdef int32_t* marks = <int32_t*>(<ndarray>whole).data
    nnz = compress_lower_triangle(entries, n, max_asymmetry, n, marks, marks + n + 1, <double*>(<ndarray>values).data)
    if nnz < 0:
        for i in range(n):
            for j in range(i):
                x = relative_entry_asymmetry(entries, n, i, j)
                if x > worst:
                    worst, at_i, at_j = x, i, j
        nnz = 0
    return (whole[:n + 1], whole[n + 1:n + 1 + nnz], values[:nnz]), (at_i, at_j, worst)


def lower_triangle_of_csr(const int32_t[::1] ptr, const int32_t[::1] idx, const double[::1] val):
    """Return the result of `lower_triangle_of_dense` for a matrix in compressed rows with ascending columns.

    A mirror image that is not stored counts as 0.
    """
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


def count_fill_in(const int32_t[::1] mptr, const int32_t[::1] midx):
    """Return the number of entries of L that a matrix with this lower triangle does not have."""
    cdef int32_t n = <int32_t>mptr.shape[0] - 1
    return int(allocate_factor_pattern(n, &mptr[0], &midx[0] if midx.shape[0] else NULL)[n]) - (midx.shape[0] - n)
