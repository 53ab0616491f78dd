"""One sweep at a time over the records of sweep/packed.pxd, in an order or backwards, with the bits of one after another.

Where something is done between two sweeps, T of packed.pxd (1) is the number of levels, and there is one stage; joints
come before contacts both ways. Any two blocks that share a body stand in different records, in the order's order: read
from the last record to the first, those of joints and then those of contacts, they are a sweep of the order turned
round. Impulses stay where they are, and a record holds where.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport rows_t
from lavender_ext.sweep.lanes cimport MOST_ROWS, P_CODE, P_OWN, P_WRITE, relax_record, rows_of
from lavender_ext.sweep.packed cimport packed_t
from lavender_ext.sweep.pair cimport LANES, gather, pair_t, scatter


cdef inline void sweep_part(const blocks_t* p, const rows_t* r, const pair_t* first, const pair_t* last,
                            int32_t backwards, double* lam, double* body) noexcept nogil:
    cdef const pair_t* x = last if backwards else first
    cdef const pair_t* end = first if backwards else last
    cdef const int64_t* place
    cdef double* x0
    cdef double* x1
    cdef pair_t y[MOST_ROWS]
    cdef int32_t k, n, kind
    cdef int64_t code
    while True:
        place = <const int64_t*>x
        code = place[P_CODE * LANES]
        kind = code & 255
        n = rows_of(kind)
        x0 = lam + place[P_OWN * LANES]
        x1 = lam + place[P_OWN * LANES + LANES - 1]
        for k in range(n):
            y[k] = gather(x0 + k, x1 + k)
        relax_record(p, r, x, kind, y, body, place + P_WRITE * LANES, lam)
        for k in range(n):
            scatter(x0 + k, x1 + k, y[k])
        if x == end:
            return
        x += -(code >> 32) if backwards else (code >> 8) & 0xffffff


cdef inline void sweep_levels(const blocks_t* p, const rows_t* r, const packed_t* packed, int32_t backwards, double* lam,
                              double* body) noexcept nogil:
    """One sweep over joints, then over contacts; lam (m), body (n_bodies + 2, 6), zeros behind the last."""
    if r.n_joints > 0:
        sweep_part(p, r, packed.record, packed.last_joint, backwards, lam, body)
    if r.n_contacts > 0:
        sweep_part(p, r, packed.contacts, packed.last, backwards, lam, body)
