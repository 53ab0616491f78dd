"""Projection of impulses on their bounds: rows and normals first, then each friction component on its bound."""
from libc.math cimport fabs
from libc.stdint cimport int32_t
from libc.string cimport memcpy

from lavender_ext.core.block cimport clip, euclidean_norm
from lavender_ext.core.block_types cimport (blocks_t, friction_components_t, get_friction_components, has_independent_rows,
                                            is_round_cone_contact)
from lavender_ext.core.validate cimport all_finite
from lavender_ext.judge.score cimport unit_roundoff


cdef inline void project_block_on_bounds(const blocks_t* p, int32_t i, double excess, double* lam) noexcept nogil:
    """Project block i of lam (m) on its bounds; friction is scaled if it exceeds `excess` times its bound."""
    cdef int32_t j = p.ptr[i], g, k
    cdef double size, bound
    cdef friction_components_t q
    if has_independent_rows(p, i):
        for k in range(j, p.ptr[i + 1]):
            lam[k] = clip(lam[k], p.lower[k], p.upper[k])
        return
    lam[j] = max(lam[j], 0.0)
    get_friction_components(p, i, &q)
    for g in range(q.n):
        size, bound = euclidean_norm(lam + j + q.first[g], q.size[g]), q.friction_coefficient[g] * lam[j]
        for k in range(j + q.first[g], j + q.first[g] + q.size[g] if size > excess * bound else 0):
            lam[k] = clip(lam[k], -bound, bound) if q.size[g] == 1 else lam[k] * (bound / size)


cdef inline void project_on_bounds(const blocks_t* p, double* lam) noexcept nogil:
    """Project a finite lam (m) on its bounds. Round cones keep their friction, which has a metric of its own.

    Friction that rounding has left 8 roundings above its bound is not scaled twice.
    """
    cdef int32_t i
    if not all_finite(lam, p.n_rows):
        return
    for i in range(p.n_blocks):
        if is_round_cone_contact(p, i):
            lam[p.ptr[i]] = max(lam[p.ptr[i]], 0.0)
        else:
            project_block_on_bounds(p, i, 1.0 + 8.0 * unit_roundoff(), lam)


cdef inline void project_all_on_bounds(const blocks_t* p, double* lam) noexcept nogil:
    """Project lam (m) on its bounds, round cones too, radially; numbers that are not finite stay."""
    cdef int32_t i
    for i in range(p.n_blocks):
        project_block_on_bounds(p, i, 1.0, lam)


cdef inline bint project_far_excess(const blocks_t* p, double* lam, double* before) noexcept nogil:
    """Project lam (m) on its bounds if a number exceeds them by more than 1e-6 of itself; return whether it was.

    Smaller excesses stay, as in the C library, with the same bits. before (m) receives lam as it came.
    """
    cdef int32_t i
    memcpy(before, lam, p.n_rows * sizeof(double))
    project_on_bounds(p, lam)
    for i in range(p.n_rows):
        if fabs(lam[i] - before[i]) > 1e-6 * fabs(before[i]):
            return True
    memcpy(lam, before, p.n_rows * sizeof(double))
    return False
