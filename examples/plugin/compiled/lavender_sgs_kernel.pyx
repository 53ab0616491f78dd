# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Sweeps of symmetric Gauss-Seidel over A in compressed rows: forwards, then backwards, in turn.

The update of a block is (1) to (3) of lavender_ext/core/block.pxd. The friction components of a contact, of whatever kind, are
those of lavender_ext/core/block_types.pxd.
"""
from libc.math cimport fmax, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport project_normal_update, project_row_update, project_tangent_update
from lavender_ext.core.block_types cimport blocks_t, friction_components_t, get_friction_components, has_independent_rows


cdef struct matrix_t:       # A in compressed rows
    const int32_t* ptr      # (m + 1)
    const int32_t* column   # (nnz)
    const double* value     # (nnz) 1/kg


cdef double get_entry(const matrix_t* a, int32_t i, int32_t j) noexcept nogil:
    """Return A_ij [1/kg]."""
    cdef int32_t k
    for k in range(a.ptr[i], a.ptr[i + 1]):
        if a.column[k] == j:
            return a.value[k]
    return 0.0


cdef double compute_slack(const matrix_t* a, const double* b, int32_t i, const double* lam) noexcept nogil:
    """Return w_i = sum_j A_ij lam_j - b_i [m/s]."""
    cdef double w = -b[i]
    cdef int32_t k
    for k in range(a.ptr[i], a.ptr[i + 1]):
        w += a.value[k] * lam[a.column[k]]
    return w


cdef void relax_block(const blocks_t* p, const matrix_t* a, int32_t i, double* lam) noexcept nogil:
    """Update block i."""
    cdef friction_components_t q
    cdef double w[2]
    cdef double half, apart
    cdef int32_t first = p.ptr[i], row, g, k
    # bounded rows
    if has_independent_rows(p, i):
        for row in range(first, p.ptr[i + 1]):
            lam[row] = project_row_update(lam[row], compute_slack(a, p.b, row, lam), 1.0 / p.d[row], p.lower[row], p.upper[row])
        return
    # normal
    lam[first] = project_normal_update(lam[first], compute_slack(a, p.b, first, lam), 1.0 / p.d[first])
    # friction components, with the step 1 / lambda_max of their part of A; its diagonal may be 0
    get_friction_components(p, i, &q)
    for g in range(q.n):
        row = first + q.first[g]
        half, apart = p.d[row], 0.0
        if q.size[g] == 2:
            half = 0.5 * (get_entry(a, row, row) + get_entry(a, row + 1, row + 1))
            apart = 0.5 * (get_entry(a, row, row) - get_entry(a, row + 1, row + 1))
            apart = sqrt(apart * apart + get_entry(a, row, row + 1) * get_entry(a, row + 1, row))
        for k in range(q.size[g]):
            w[k] = compute_slack(a, p.b, row + k, lam)
        project_tangent_update(lam + row, w, 1.0 / fmax(half + apart, p.d[row]), q.friction_coefficient[g] * lam[first], q.size[g])


def sweep(const int32_t[::1] row_ptr, const int32_t[::1] column, const double[::1] value, const double[::1] b, const double[::1] d,
          cones, double[::1] impulse, int first, int n):
    """Run the sweeps first to first + n - 1 on `impulse` (m) [N s] in place; sweeps with an odd number run backwards."""
    cdef const int32_t[::1] ptr = cones.ptr, kind = cones.kind
    cdef const double[::1] lower = cones.lower, upper = cones.upper
    cdef const double[::1] mu = cones.mu, patch_radius = cones.patch_radius, rolling = cones.rolling
    cdef matrix_t a
    cdef blocks_t p
    cdef int32_t s, k
    if not impulse.shape[0] or not column.shape[0]:
        return
    a.ptr, a.column, a.value = &row_ptr[0], &column[0], &value[0]
    p.n_blocks, p.ptr, p.kind, p.lower, p.upper = kind.shape[0], &ptr[0], &kind[0], &lower[0], &upper[0]
    p.mu, p.patch_radius, p.rolling, p.b, p.d = &mu[0], &patch_radius[0], &rolling[0], &b[0], &d[0]
    with nogil:
        for s in range(first, first + n):
            for k in range(p.n_blocks):
                relax_block(&p, &a, p.n_blocks - 1 - k if s % 2 else k, &impulse[0])
