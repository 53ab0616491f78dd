"""A problem as kernels read it: its blocks, and one of A, bodies, J and M."""
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.parts cimport blocks_t
from lavender_ext.core.rows cimport rows_t


cdef struct view_t:
    blocks_t p
    const csr_t* a              # one of these three, the others NULL
    const rows_t* r
    const generalized_t* g      # with its panels
