"""Sweeps of block Gauss-Seidel: each block solved exactly with the others held still (local/exact.pxd).

    over A in compressed rows    w = A lam - b of the block's rows                                  (1)
    over the factored form       w = J v + c lam - b, then v += M^-1 J^T (change)                   (2)
    over J and M                 w = Y u + c lam - b, then u += Y^T (change)                        (3)
"""
from libc.stdint cimport int32_t

from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.generalized cimport dot, generalized_t
from lavender_ext.core.parts cimport blocks_t, n_directions, n_turns
from lavender_ext.core.rows cimport contact_jacobian, dot12, minv_times, rows_t
from lavender_ext.core.view cimport view_t
from lavender_ext.local.small cimport MAX_ROWS
from lavender_ext.local.gauss_seidel cimport (prepare_block, prepared_size, solve_csr_block, solve_general_block,
                                              solve_rows_block)


cdef double prepared_sizes(const blocks_t* p, int32_t* start) noexcept nogil:
    """First place of each block's prepared numbers, start (k); returns their number."""
    cdef int32_t i
    cdef double n = 0
    for i in range(p.n_blocks):
        start[i] = <int32_t>n
        n += prepared_size(p, i)
    return n


cdef inline bint part_of_csr(const blocks_t* p, const csr_t* a, int32_t i, double* W) noexcept nogil:
    """The part W (n, n) of A that is block i's own; whether its rows share one pattern."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, q
    cdef bint one = True
    for k in range(n):
        for q in range(n):
            W[n * k + q] = 0.0
        if a.indptr[j + k + 1] - a.indptr[j + k] != a.indptr[j + 1] - a.indptr[j]:
            one = False
        for q in range(a.indptr[j + k], a.indptr[j + k + 1]):
            if j <= a.indices[q] < j + n:
                W[n * k + a.indices[q] - j] += a.data[q]
            if one and a.indices[q] != a.indices[q - a.indptr[j + k] + a.indptr[j]]:
                one = False
    return one


cdef inline void part_of_rows(const blocks_t* p, const rows_t* r, int32_t i, double* W) noexcept nogil:
    """The same from J and M^-1: the slack that each row's unit impulse makes on the block."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, q, c = i - r.n_joints
    cdef double jac[72]
    cdef double push[12]
    cdef const double* row = r.jac + 12 * j
    cdef const double* change
    if c >= 0:
        contact_jacobian(r, c, n_directions(p, i), n_turns(p, i), jac)
        row = jac
    for k in range(n):
        change = r.minv_jac + 12 * (j + k)
        if c >= 0:
            minv_times(row + 12 * k, r.inv_mass, r.inv_inertia, r.contact_body[2 * c], r.contact_body[2 * c + 1], push)
            change = push
        for q in range(n):
            W[n * q + k] = dot12(row + 12 * q, change)
    for k in range(n):
        W[(n + 1) * k] += r.compliance[j + k]
    if c >= 0 and W[0] > 0.0:
        W[0] = p.d[j]                                   # the same number summed in another order


cdef inline void part_of_general(const blocks_t* p, const generalized_t* o, int32_t i, double* W) noexcept nogil:
    """The same from the rows of Y."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, q, b = o.home[i], nc = o.pcol[b + 1] - o.pcol[b]
    cdef const double* y = o.y + o.pval[b] + <ssize_t>(j - o.prow[b]) * nc
    for k in range(n):
        for q in range(n):
            W[n * k + q] = dot(y + k * nc, y + q * nc, nc)
    for k in range(n):
        W[(n + 1) * k] += o.compliance[j + k]


cdef void prepare_blocks(const view_t* v, const int32_t* start, double* g) noexcept nogil:
    """Each block's own part of A into g (`prepared_sizes`, zeroed)."""
    cdef int32_t i
    cdef bint one
    cdef double W[MAX_ROWS * MAX_ROWS]
    for i in range(v.p.n_blocks):
        if prepared_size(&v.p, i) == 0:
            continue
        one = False
        if v.g != NULL:
            part_of_general(&v.p, v.g, i, W)
        elif v.r != NULL:
            part_of_rows(&v.p, v.r, i, W)
        else:
            one = part_of_csr(&v.p, v.a, i, W)
        prepare_block(&v.p, i, W, one, g + start[i])


cdef int32_t solve_blocks(const blocks_t* p, const csr_t* a, const rows_t* r, const generalized_t* o, const int32_t* start,
                          const double* g, const int32_t* order, double* lam, double* v) noexcept nogil:
    """One sweep over A, or over J and M (`o`), or over bodies (`r`), whose velocities v keeps; counts what fell back."""
    cdef int32_t q, i, fallbacks = 0
    if o != NULL:
        for q in range(p.n_blocks):
            i = order[q]
            fallbacks += solve_general_block(p, o, i, g + start[i], lam, v)
    elif a != NULL:
        for q in range(p.n_blocks):
            i = order[q]
            fallbacks += solve_csr_block(p, a, i, g + start[i], lam)
    else:
        for q in range(p.n_blocks):
            i = order[q]
            fallbacks += solve_rows_block(p, r, i, g + start[i], lam, v)
    return fallbacks
