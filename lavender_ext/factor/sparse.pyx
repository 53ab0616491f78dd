"""Factorisation of a sparse matrix in compressed rows: L L^T, or L U with row exchanges inside supernodes; and of a full one.

The pattern must be symmetric. Rows are ordered by minimum degree (`symbolic.pyx`) and factored by supernodes
(`supernodal.pxd`). L U is that of D^-1/2 A D^-1/2: rows that are exchanged have comparable entries, and small pivots are
visible.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

import numpy as np

from lavender_ext.factor.symbolic import analyse

from lavender_ext.core.csr cimport transpose_csr, scan_entries
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.dense cimport cholesky_workspace_size, dense_cholesky, dense_cholesky_solve
from lavender_ext.factor.sparse cimport sparse_solve, sparse_t
from lavender_ext.factor.supernodal cimport (begin_supernodes, factor_supernode, panel_width, rows_below, set_local_rows,
                                             supernodal_scratch_size, supernodal_t)
from lavender_ext.factor.tiles cimport has_wide


cdef inline void fill_supernode(const sparse_t* s, int32_t i, const int32_t* indptr, const int32_t* indices,
                                const double* data, const int32_t* tptr, const int32_t* tind, const double* tdata,
                                const double* d, double shift) noexcept nogil:
    """Copy the entries of A + shift D in the columns of supernode i to its panel, and for L U those of its rows."""
    cdef const supernodal_t* f = &s.factor
    cdef int32_t base = f.first[i], after = f.first[i + 1], c, q, p, row
    cdef int64_t own = after - base, beside = rows_below(f, i), ld = own + beside
    cdef double* v = f.values + f.value_offset[i]
    cdef double* u
    cdef double scale
    memset(v, 0, sizeof(double) * ld * own)
    if not s.lu:
        for c in range(base, after):
            row = f.order[c]
            for q in range(indptr[row], indptr[row + 1]):
                p = f.position[indices[q]]
                if p >= c:
                    v[f.local_row[p]] = data[q]
            v[c - base] += shift * d[row]
            v += ld
        return
    u = f.upper + f.upper_offset[i]
    memset(u, 0, sizeof(double) * beside * own)
    for c in range(base, after):
        row = f.order[c]
        scale = s.scale[c]
        for q in range(indptr[row], indptr[row + 1]):
            p = f.position[indices[q]]
            if p >= after:
                u[f.local_row[p] - own] = scale * data[q] * s.scale[p]
        for q in range(tptr[row], tptr[row + 1]):
            p = f.position[tind[q]]
            if p >= base:
                v[f.local_row[p]] = s.scale[p] * tdata[q] * scale
        v[c - base] += shift
        v += ld
        u += beside


cdef public int32_t lav_sparse_factor(const sparse_t* s, const int32_t* indptr, const int32_t* indices,
                                      const double* data, const int32_t* tptr, const int32_t* tind, const double* tdata,
                                      const double* d, double shift, double tiny) noexcept nogil:
    """Factor A + shift D, D = diag(d) > 0; L U also reads A^T. Return the number of pivots of at most tiny d."""
    cdef const supernodal_t* f = &s.factor
    cdef int32_t i, k, lost = 0
    for k in range(f.n):
        s.scale[k] = 1.0 / sqrt(d[f.order[k]]) if s.lu else tiny * d[f.order[k]]
    begin_supernodes(f)
    for i in range(f.supernodes):
        set_local_rows(f, i)
        fill_supernode(s, i, indptr, indices, data, tptr, tind, tdata, d, shift)
        lost += factor_supernode(f, i, s.lu, s.scale, tiny)
    return lost


def bandwidth(const int32_t[::1] indptr, const int32_t[::1] indices):
    """Return the (lower, upper) bandwidth of a canonical CSR matrix, from the ends of its rows."""
    cdef Py_ssize_t i, n = indptr.shape[0] - 1
    cdef int32_t lower = 0, upper = 0
    for i in range(n):
        if indptr[i] < indptr[i + 1]:
            lower = max(lower, <int32_t>i - indices[indptr[i]])
            upper = max(upper, indices[indptr[i + 1] - 1] - <int32_t>i)
    return lower, upper


def scan(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data, const double[::1] d):
    """Return (lower bandwidth, upper bandwidth, asymmetry) of a canonical CSR matrix with the metric d (n,)."""
    cdef int32_t n = <int32_t>indptr.shape[0] - 1
    cdef int32_t band[2]
    cdef double asymmetry
    cdef csr_t a
    cdef int32_t[::1] cursor
    if n <= 0 or data.shape[0] == 0:
        return 0, 0, 0.0
    a.indptr = &indptr[0]
    a.indices = &indices[0]
    a.data = &data[0]
    cursor = np.empty(n, np.int32)
    with nogil:
        asymmetry = scan_entries(&a, &d[0], n, &cursor[0], band)
    return band[0], band[1], asymmetry


def is_mirrored(const int32_t[::1] indptr, const int32_t[::1] indices):
    """Return whether the pattern of a canonical CSR matrix is symmetric."""
    cdef int32_t[::1] cursor = np.array(indptr)
    cdef int32_t i, j, q
    for i in range(indptr.shape[0] - 1):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q]
            if cursor[j] == indptr[j + 1] or indices[cursor[j]] != i:
                return False                            # Rows are visited in order, so that entry i of row j is next.
            cursor[j] += 1
    return True


def free_part(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] data,
              const int32_t[::1] place, int n_free):
    """Return (indptr, indices, data) of the rows and columns with place >= 0, numbered in the order of the rows."""
    cdef int32_t i, q, k = 0, n = <int32_t>indptr.shape[0] - 1
    ptr_array = np.zeros(n_free + 1, np.int32)
    cdef int32_t[::1] ptr = ptr_array, idx
    cdef double[::1] val
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                k += place[indices[q]] >= 0
            ptr[place[i] + 1] = k
    idx_array, val_array = np.empty(k, np.int32), np.empty(k)
    idx, val = idx_array, val_array
    k = 0
    for i in range(n):
        if place[i] >= 0:
            for q in range(indptr[i], indptr[i + 1]):
                if place[indices[q]] >= 0:
                    idx[k] = place[indices[q]]
                    val[k] = data[q]
                    k += 1
    return ptr_array, idx_array, val_array


cdef class SparsePanels:
    """The factor of a matrix in canonical compressed rows (n, n), whose pattern is symmetric; n > 0.

    Parameters
    ----------
    indptr, indices : (n + 1,), (nnz,) int32
    lu : bool
        L U; otherwise L L^T of a symmetric matrix, of which the entries at and after the diagonal in the order are read.
    wide : bool
        Use four lanes if the processor has them; the bits are the same.
    like : SparsePanels, optional
        A factor of the same pattern, whose analysis is reused.
    """

    def __init__(self, indptr, indices, bint lu, bint wide=True, SparsePanels like=None):
        cdef int32_t n = <int32_t>len(indptr) - 1, k
        cdef int32_t[::1] integers
        cdef int64_t[::1] offsets
        cdef supernodal_t* f = &self.f.factor
        cdef int32_t* p
        if n < 1:
            raise ValueError("a matrix of one row or more")
        if like is None:
            self.analysis = analyse(indptr, indices)
        elif like.f.factor.n == n and like.indices.shape[0] == len(indices):
            self.analysis = like.analysis[0].copy(), *like.analysis[1:]
        else:
            raise ValueError("panels of another matrix")
        self.indptr, self.indices = indptr, indices
        integers, offsets, self.cholesky_work = self.analysis
        k = <int32_t>(offsets.shape[0] // 2 - 1)
        p = &integers[0]                                # The layout is that of `analyse`.
        f.order, f.position, f.supernode_of, f.swap, f.local_row = p, p + n, p + 2 * n, p + 3 * n, p + 4 * n
        f.first, f.row_ptr = p + 5 * n, p + 5 * n + k + 1
        f.head = p + 5 * n + 2 * (k + 1)
        f.link, f.next_row, f.row_indices = f.head + k, f.head + 2 * k, f.head + 3 * k
        f.value_offset, f.upper_offset = &offsets[0], &offsets[0] + k + 1
        f.n, f.supernodes, f.wide, self.f.lu = n, k, wide and has_wide(), lu
        self.work = 2.0 * self.cholesky_work if lu else self.cholesky_work
        self.entries = f.value_offset[k] + (f.upper_offset[k] if lu else 0)

    cdef _allocate(self):
        # An analysis without a factor has no values.
        cdef supernodal_t* f = &self.f.factor
        cdef int64_t scratch = supernodal_scratch_size(f, self.f.lu)
        cdef double[::1] numbers
        numbers = self.numbers = np.empty(self.entries + scratch + 2 * f.n + 1)
        f.values = &numbers[0]
        f.upper = f.values + f.value_offset[f.supernodes]
        f.scratch = f.values + self.entries
        self.f.scale = f.scratch + scratch
        self.f.y = self.f.scale + f.n

    def factor(self, const double[::1] data, const double[::1] d, double shift, double tiny):
        """Factor the matrix with these entries plus shift D, d (n,) > 0; return how many pivots do not exceed tiny d."""
        cdef const int32_t[::1] ptr = self.indptr, ind = self.indices
        cdef int32_t[::1] tptr, tind
        cdef double[::1] tdata
        cdef int32_t lost, n = self.f.factor.n
        if data.shape[0] != ind.shape[0] or d.shape[0] != n:
            raise ValueError("entries of another matrix")
        if data.shape[0] == 0:
            return n
        if self.numbers is None:
            self._allocate()
        tptr, tind, tdata = np.empty(1, np.int32), np.empty(1, np.int32), np.empty(1)
        if self.f.lu:
            tptr = np.empty(n + 2, np.int32)
            tind, tdata = np.empty(data.shape[0], np.int32), np.empty(data.shape[0])
        with nogil:
            if self.f.lu:
                transpose_csr(n, n, &ptr[0], &ind[0], &data[0], &tptr[0], &tind[0], &tdata[0])
            lost = lav_sparse_factor(&self.f, &ptr[0], &ind[0], &data[0], &tptr[0], &tind[0], &tdata[0], &d[0], shift, tiny)
        return lost

    def solve(self, const double[::1] b):
        """Solve with the last factor; return a new array (n,)."""
        out = np.empty(self.f.factor.n)
        cdef double[::1] x = out
        if b.shape[0] != self.f.factor.n or self.numbers is None:
            raise ValueError("of another size, or before a factor")
        with nogil:
            sparse_solve(&self.f, &b[0], &x[0])
        return out

    @property
    def order(self):
        """(n,) row eliminated first, second, ..."""
        return self.analysis[0][:self.f.factor.n]

    def lost_rows(self):
        """Return the rows whose pivots the last factor rejected, ascending; their columns of L are 0."""
        cdef const supernodal_t* f = &self.f.factor
        cdef int32_t i, k
        cdef int64_t ld
        if self.numbers is None:
            raise ValueError("before a factor")
        rows = []
        for i in range(f.supernodes):
            ld = panel_width(f, i) + rows_below(f, i)
            for k in range(panel_width(f, i)):
                if f.values[f.value_offset[i] + k * (ld + 1)] == 0.0:
                    rows.append(f.order[f.first[i] + k])
        return np.sort(np.array(rows, np.intp))


cdef class FullCholesky:
    """The factor L L^T of a full symmetric matrix (`dense.pxd`).

    Parameters
    ----------
    a : (n, n) float64
        The entries at and after the diagonal of each row are read.
    min_pivot : (n,) float64
        Each pivot must exceed this.
    wide : bool
        Use four lanes if the processor has them; the bits are the same.
    """

    cdef double[::1] lower
    cdef int32_t n
    cdef readonly int lost      # number of pivots that do not

    def __init__(self, const double[:, ::1] a, const double[::1] min_pivot, bint wide=True):
        cdef int32_t n = <int32_t>a.shape[0]
        if n < 1 or a.shape[1] != n or min_pivot.shape[0] != n:
            raise ValueError("a square matrix of one row or more, and what each of its pivots must be above")
        self.n, self.lower = n, np.empty(cholesky_workspace_size(n))
        with nogil:
            self.lost = dense_cholesky(wide and has_wide(), n, &a[0, 0], &min_pivot[0], &self.lower[0])

    def solve(self, const double[::1] b):
        """Solve with the factor; return a new array (n,)."""
        out = np.array(b)
        cdef double[::1] x = out
        if b.shape[0] != self.n:
            raise ValueError("of another size")
        with nogil:
            dense_cholesky_solve(self.n, &self.lower[0], &x[0])
        return out
