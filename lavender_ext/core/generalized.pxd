"""Generalised coordinates: J (m, nv) and M (nv, nv), represented by the factor of M and the whitened Jacobian Y.

    M = L^T D L, the factor of `core/tree.pxd`                                                              (1)
    Y = J L^-1 D^-1/2,   J M^-1 J^T = Y Y^T                                                                 (2)
    w = J x + compliance lambda - b,   M x = J^T lambda                                                     (3)

A row of Y has entries in the columns of its row of J and in their ancestors in the elimination tree of (1). Consecutive rows
with the same columns form a panel: one list of columns, values stored row by row. `whiten.pxd` computes Y.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.tree_solve cimport solve_tree_factor
from lavender_ext.core.view cimport generalized_t


cdef enum:
    MAX_INDEX = 2147483647      # largest number of entries of L with 32-bit indices
    # The entries of x on the columns of a panel are copied to a contiguous array if the panel has at most this many columns
    # and more than two rows.
    MAX_GATHERED_COLUMNS = 64


cdef inline void solve_mass_matrix(const generalized_t* g, double* x) noexcept nogil:
    """Overwrite x (n) with M^-1 x."""
    solve_tree_factor(g.n, g.lptr, g.lidx, g.lval, g.inv_pivot, x)


# -- J ---------------------------------------------------------------------------------------------------


cdef inline void multiply_jacobian_transpose(const generalized_t* g, const double* lam, double* x) noexcept nogil:
    """Compute x (n) = J^T lam."""
    cdef int32_t i, q, first, end, m = g.m
    cdef const int32_t* jptr = g.jptr
    cdef const int32_t* jidx = g.jidx
    cdef const double* jval = g.jval
    cdef double s
    for i in range(g.n):
        x[i] = 0.0
    for i in range(m):
        s = lam[i]
        if s != 0.0:
            first = jptr[i]
            end = jptr[i + 1]
            for q in range(first, end):
                x[jidx[q]] += jval[q] * s


cdef inline double multiply_jacobian_row(const generalized_t* g, int32_t i, const double* x) noexcept nogil:
    """Return row i of J times x."""
    cdef int32_t q, first = g.jptr[i], end = g.jptr[i + 1]
    cdef const int32_t* jidx = g.jidx
    cdef const double* jval = g.jval
    cdef double s = 0.0
    for q in range(first, end):
        s += jval[q] * x[jidx[q]]
    return s


# -- Y ---------------------------------------------------------------------------------------------------


cdef inline double indexed_dot(const double* y, const int32_t* cols, const double* x, int32_t n) noexcept nogil:
    """Return sum_a y_a x[cols_a] in two running sums, with the bits of `contiguous_dot`."""
    cdef int32_t a = 0
    cdef double s0 = 0.0, s1 = 0.0
    while a + 2 <= n:
        s0 += y[a] * x[cols[a]]
        s1 += y[a + 1] * x[cols[a + 1]]
        a += 2
    if a < n:
        s0 += y[a] * x[cols[a]]
    return s0 + s1


cdef inline double contiguous_dot(const double* y, const double* x, int32_t n) noexcept nogil:
    """Return y^T x of contiguous vectors, with the bits of `indexed_dot`."""
    cdef int32_t a = 0
    cdef double s0 = 0.0, s1 = 0.0
    while a + 2 <= n:
        s0 += y[a] * x[a]
        s1 += y[a + 1] * x[a + 1]
        a += 2
    if a < n:
        s0 += y[a] * x[a]
    return s0 + s1


cdef inline void multiply_whitened_panel(const generalized_t* g, int32_t panel, const double* x, double* out) noexcept nogil:
    """Compute out (m) = Y x on the rows of a panel."""
    cdef int32_t i, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    cdef double gathered[MAX_GATHERED_COLUMNS]
    if end - first > 2 and nc <= MAX_GATHERED_COLUMNS:
        for i in range(nc):
            gathered[i] = x[cols[i]]
        for i in range(first, end):
            out[i] = contiguous_dot(y, gathered, nc)
            y += nc
        return
    for i in range(first, end):
        out[i] = indexed_dot(y, cols, x, nc)
        y += nc


cdef inline double whitened_row_dot(const generalized_t* g, int32_t panel, int32_t row, const double* x) noexcept nogil:
    """Return Y_row x, with the bits of `multiply_whitened_panel`."""
    cdef int32_t nc = g.pcol[panel + 1] - g.pcol[panel]
    return indexed_dot(g.y + g.pval[panel] + <ssize_t>(row - g.prow[panel]) * nc, g.cols + g.pcol[panel], x, nc)


cdef inline void add_scaled_whitened_row(const generalized_t* g, int32_t panel, int32_t row, double change,
                                         double* x) noexcept nogil:
    """Add Y_row^T change to x (n)."""
    cdef int32_t a, nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel] + <ssize_t>(row - g.prow[panel]) * nc
    if change != 0.0:
        for a in range(nc):
            x[cols[a]] += y[a] * change


cdef inline void multiply_whitened_transpose(const generalized_t* g, const double* lam, double* x) noexcept nogil:
    """Compute x (n) = Y^T lam."""
    cdef int32_t a
    for a in range(g.n):
        x[a] = 0.0
    for a in range(g.n_panels):
        add_panel_transpose_product(g, a, lam, x)


cdef inline void add_panel_transpose_product(const generalized_t* g, int32_t panel, const double* lam, double* x) noexcept nogil:
    """Add Y^T lam of the rows of a panel to x (n)."""
    cdef int32_t i, a, first = g.prow[panel], end = g.prow[panel + 1], nc = g.pcol[panel + 1] - g.pcol[panel]
    cdef const int32_t* cols = g.cols + g.pcol[panel]
    cdef const double* y = g.y + g.pval[panel]
    cdef double gathered[MAX_GATHERED_COLUMNS]
    if end - first > 2 and nc <= MAX_GATHERED_COLUMNS:
        while first < end and lam[first] == 0.0:
            first += 1
            y += nc
        if first == end:
            return
        for a in range(nc):
            gathered[a] = x[cols[a]]
        for i in range(first, end):
            if lam[i] != 0.0:
                for a in range(nc):
                    gathered[a] += y[a] * lam[i]
            y += nc
        for a in range(nc):
            x[cols[a]] = gathered[a]
        return
    for i in range(first, end):
        if lam[i] != 0.0:
            for a in range(nc):
                x[cols[a]] += y[a] * lam[i]
        y += nc


cdef class Operator:
    cdef generalized_t g                # without panels and compliance
    cdef readonly int failed            # the row of M with a pivot that is not positive, or -1
    cdef readonly tuple jac, mass       # arrays (indptr, indices, data) of J, and of the lower triangle of M
    cdef list keep

    cpdef bint has_entry_above(self, double bound)
    cdef bint has_pattern(self, int32_t n, const int32_t* mptr, const int32_t* midx)
