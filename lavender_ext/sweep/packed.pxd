"""Declarations of `packed.pyx`: sweeps over blocks that are packed in pairs."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.pair cimport pair_t
from lavender_ext.core.view cimport rows_t


cdef enum:
    MAX_PACKED_BLOCKS = 32767   # Larger problems are not packed: their records exceed the caches, and little time is gained.


cdef struct packed_t:           # the records of an order; all pointers are into the workspace
    int32_t n_records
    int32_t n_stages
    bint single                 # The records are for one sweep at a time, and impulses remain outside of them.
    int32_t* lane               # (k) LANES * (offset of the record in pairs) + lane of each block, in the sequence of the order
    pair_t* first               # first record
    pair_t* last                # last record
    pair_t* last_joint          # if `single`: last record of joints
    pair_t* first_contact       # if `single`: first record of contacts
    double* end                 # the place after the records


cdef int64_t packed_workspace_size(int64_t joints, int64_t joint_rows, int64_t contacts, int64_t contact_rows,
                                   int64_t bodies) noexcept nogil
cdef int64_t packed_workspace_size_of_blocks(const blocks_t* p, const rows_t* r) noexcept nogil
cdef int32_t pack_blocks_in_order(const blocks_t* p, const rows_t* r, const int32_t* order, bint single, double* workspace,
                                  const double* lam, packed_t* out) noexcept nogil
cdef void copy_packed_impulses(const blocks_t* p, const int32_t* order, const packed_t* packed, bint into,
                               double* lam) noexcept nogil
cdef void sweep_records(const blocks_t* p, const rows_t* r, const packed_t* packed, int32_t sweeps, bint backwards,
                        double* lam, double* v) noexcept nogil
cdef void refresh_packed_contacts(const blocks_t* p, const int32_t* order, const packed_t* packed,
                                  const double* lam) noexcept nogil
cdef void sweep_packed(const blocks_t* p, const rows_t* r, const int32_t* order, const packed_t* packed, int32_t sweeps,
                       double* lam, double* v) noexcept nogil
