"""One sweep at a time over the pairs of sweep/packed.pxd, in an order or backwards, with the bits of one after another.

Where something is done between two sweeps, T of packed.pxd (1) is the number of levels, and there is one stage. Any two
contacts that share a body stand in different records, in the order's order: read from the last record to the first,
they are a sweep of the order turned round. Impulses stay where they are, and a record holds where, in the place of its
stage: a contact that stands alone beside those of nobody, behind the last row.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.rows cimport relax_joint, rows_t
from lavender_ext.sweep.packed cimport R_PLACE, RECORD, pack_order, packed_t, relax_pair
from lavender_ext.sweep.pair cimport LANES, gather, pair_t, scatter


cdef enum:
    BEHIND = 3                  # entries of lam behind the last row


cdef inline int32_t pack_levels(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t least, double* room,
                                const double* lam, packed_t* out) noexcept nogil:
    """Records of the contacts of order (k), joints first, as `pack_order`; 0 where levels are shorter than `least`."""
    cdef int32_t i, k
    cdef int64_t* place
    if not pack_order(p, r, order, 1, least, room, lam, out):
        return 0
    for i in range(out.pairs):
        place = <int64_t*>(out.record + <int64_t>i * RECORD + R_PLACE) + 4 * LANES
        for k in range(LANES):
            place[k] = p.n_rows
    for i in range(r.n_contacts):
        k = out.lane[i]
        place = <int64_t*>(out.record + <int64_t>(k // LANES) * RECORD + R_PLACE) + 4 * LANES
        place[k % LANES] = p.ptr[order[r.n_joints + i]]
    return 1


cdef inline void set_behind(double* lam, int32_t m) noexcept nogil:
    """Impulses of nobody: they stick well inside their disk."""
    cdef int32_t k
    for k in range(BEHIND):
        lam[m + k] = 1.0 - 0.5 * k


cdef inline void sweep_levels(const blocks_t* p, const rows_t* r, const int32_t* order, const packed_t* packed,
                              int32_t backwards, double* lam, double* body) noexcept nogil:
    """One sweep over joints, then over records; lam (m + BEHIND), body (n_bodies + 2, 6), zeros behind the last."""
    cdef int32_t i, k, _i
    cdef int64_t step = -RECORD if backwards else RECORD
    cdef pair_t* x = packed.record + (<int64_t>(packed.pairs - 1) * RECORD if backwards else 0)
    cdef const int64_t* place
    cdef double* x0
    cdef double* x1
    cdef pair_t y[BEHIND]
    for i in range(r.n_joints):
        relax_joint(p, r, order[i], lam, body)
    for _i in range(packed.pairs):
        place = <const int64_t*>(x + R_PLACE)
        x0 = lam + place[4 * LANES]
        x1 = lam + place[5 * LANES - 1]
        for k in range(BEHIND):
            y[k] = gather(x0 + k, x1 + k)
        relax_pair(x, y, body, place + 2 * LANES, place + 3 * LANES)
        for k in range(BEHIND):
            scatter(x0 + k, x1 + k, y[k])
        x += step
