"""Declarations of `assemble.pyx`: the assembly of A from bodies."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport rows_t


cdef public void lav_list_blocks_of_bodies(const blocks_t* p, const rows_t* r, int32_t* start, int32_t* blocks,
                                           int64_t* bound) noexcept nogil
cdef public void lav_form_delassus_matrix(const blocks_t* p, const rows_t* r, const int32_t* start, const int32_t* blocks,
                                          double* jac, int32_t* scratch, int32_t* indptr, int32_t* indices,
                                          double* data) noexcept nogil
