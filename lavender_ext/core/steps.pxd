"""The end of the metric of a block: the common d of two rows, and the steps of a sweep.

`finish_metric` computes both for A, bodies, and J and M (`problem.pyx`); the engine calls `finish_pair` for its contacts.

    d_i     = the mean of both d on two tangents and on two rolling rows                                           (1)
    step_i  = 1/d_i; on two tangents 1/lambda_max of the symmetric part of A_tt, 1/d_t if lambda_max is not positive;
              likewise on two rolling rows                                                                         (3)
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t, friction_components_t, get_row_groups, is_round_cone_contact
from lavender_ext.core.rows cimport reciprocal_or_zero


cdef inline void finish_pair(double eigenvalue, double* d, double* step) noexcept nogil:
    """Compute d (1) and step (3) of two rows with a common bound, d (2), step (2); `eigenvalue` is lambda_max, or <= 0."""
    d[0] = 0.5 * (d[0] + d[1])
    d[1] = d[0]
    step[0] = step[1] = reciprocal_or_zero(eigenvalue if eigenvalue > 0.0 else d[0])


cdef inline void finish_metric(const blocks_t* p, int32_t i, const double* eigenvalue, double* d, double* step) noexcept nogil:
    """Compute d (1) and the steps (3) of block i from its diagonal in d (m).

    eigenvalue[g] is lambda_max of friction component g if it has two rows; other entries are not read.
    """
    cdef friction_components_t part
    cdef int32_t g, k
    for k in range(p.ptr[i], p.ptr[i + 1]):
        step[k] = reciprocal_or_zero(d[k])
    get_row_groups(p, i, &part)                         # The friction components, except in a round cone.
    for g in range(part.n):
        if part.size[g] == 2:
            k = p.ptr[i] + part.first[g]                # No sweep updates a round cone, so it needs no lambda_max.
            finish_pair(0.0 if is_round_cone_contact(p, i) else eigenvalue[g], d + k, step + k)
