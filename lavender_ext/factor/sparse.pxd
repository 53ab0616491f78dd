"""The supernodal factor of a matrix in compressed rows of a symmetric pattern: L L^T, or L U with exchanges in supernodes.

L U is that of D^-1/2 A D^-1/2: rows that are exchanged have comparable entries, and small pivots are visible. Rows are ordered
by minimum degree (`symbolic.pyx`) and factored by supernodes (`supernodal.pxd`).
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.core.csr cimport transpose_csr
from lavender_ext.factor.factors cimport sparse_t, supernodal_t
from lavender_ext.factor.supernodal cimport (clear_descendant_lists, factor_supernode, rows_below, set_local_rows,
                                             solve_supernodes)


cdef inline void fill_supernode(const sparse_t* s, int32_t i, int32_t lu, const double* d, double shift) noexcept nogil:
    """Copy the entries of A + shift D in the columns of supernode i to its panel; for L U also the entries in its rows."""
    cdef const supernodal_t* f = &s.factor
    cdef int32_t base = f.first[i], after = f.first[i + 1], c, q, p, row
    cdef int64_t own = after - base, beside = rows_below(f, i), ld = own + beside
    cdef double* v = f.values + f.value_offset[i]
    cdef double* u
    cdef double scale
    memset(v, 0, sizeof(double) * ld * own)
    if not lu:
        for c in range(base, after):
            row = f.order[c]
            for q in range(s.indptr[row], s.indptr[row + 1]):
                p = f.position[s.indices[q]]
                if p >= c:
                    v[f.local_row[p]] = s.data[q]
            v[c - base] += shift * (d[row] if d != NULL else 1.0)
            v += ld
        return
    u = f.upper + f.upper_offset[i]
    memset(u, 0, sizeof(double) * beside * own)
    for c in range(base, after):
        row = f.order[c]
        scale = s.scale[c]
        for q in range(s.indptr[row], s.indptr[row + 1]):
            p = f.position[s.indices[q]]
            if p >= after:
                u[f.local_row[p] - own] = scale * s.data[q] * s.scale[p]
        for q in range(s.tptr[row], s.tptr[row + 1]):
            p = f.position[s.tind[q]]
            if p >= base:
                v[f.local_row[p]] = s.scale[p] * s.tdata[q] * scale
        v[c - base] += shift
        v += ld
        u += beside


cdef inline int32_t factor_sparse(const sparse_t* s, int32_t lu, const double* d, double shift, double tiny) noexcept nogil:
    """Factor A + shift D, D = diag(d) > 0, or I if d is NULL; return the number of pivots of at most tiny d."""
    cdef const supernodal_t* f = &s.factor
    cdef int32_t i, k, lost = 0
    cdef double size
    if lu:
        transpose_csr(f.n, f.n, s.indptr, s.indices, s.data, s.tptr, s.tind, s.tdata)
    for k in range(f.n):
        size = d[f.order[k]] if d != NULL else 1.0
        s.scale[k] = 1.0 / sqrt(size) if lu else tiny * size
    clear_descendant_lists(f)
    for i in range(f.supernodes):
        set_local_rows(f, i)
        fill_supernode(s, i, lu, d, shift)
        lost += factor_supernode(f, i, lu, s.scale, tiny)
    return lost


cdef inline void solve_sparse(const sparse_t* s, int32_t lu, double* x) noexcept nogil:
    """Overwrite x (n) with (A + shift D)^-1 x."""
    cdef int32_t k
    cdef const int32_t* order = s.factor.order
    for k in range(s.factor.n):
        s.y[k] = x[order[k]]
        if lu:
            s.y[k] *= s.scale[k]
    solve_supernodes(&s.factor, s.y, lu)
    for k in range(s.factor.n):
        x[order[k]] = s.y[k] * s.scale[k] if lu else s.y[k]
