"""A problem for kernels: pointers into arrays that a `Data` keeps alive, and derived numbers."""
from libc.stdint cimport int32_t

from lavender_ext.core.arena cimport arena_t
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.generalized cimport Operator
from lavender_ext.core.block_types cimport blocks_t, islands_t
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t


cdef class Workspace:
    cdef void* at               # memory, freed with the object


cdef Workspace allocate_bytes(Py_ssize_t bytes)


cdef enum:                      # results of `compute_derived_numbers_of_jacobian`
    DERIVED = 0
    NO_MEMORY = 1
    TOO_MANY = 2


cdef struct derived_t:          # derived numbers in generalised coordinates; the owner frees or reuses both arrays
    int32_t* marks              # scratch (2 n), prow, pcol, pval (k + 1 each), empty (m + 1), home (k), cols
    double* numbers             # d, nu, step (m + 1 each), Y
    ssize_t n_marks             # allocated length of marks, 0 at first
    ssize_t n_numbers           # allocated length of numbers, 0 at first
    int32_t* empty              # points into marks
    int32_t n_empty
    int32_t n_panels
    double values               # number of values of Y


cdef int32_t compute_derived_numbers_of_jacobian(blocks_t* p, generalized_t* g, derived_t* out) noexcept nogil


cdef public int32_t lav_compute_csr_diagonal(const blocks_t* p, const csr_t* a, int32_t* empty) noexcept nogil
cdef public int32_t lav_compute_body_diagonal(const blocks_t* p, const rows_t* r, int32_t* empty) noexcept nogil
cdef int32_t derive_row_numbers(blocks_t* p, const csr_t* a, rows_t* r, arena_t* arena) noexcept nogil
cdef int bind_body_arrays(rows_t* r, const blocks_t* p, rows) except -1


cdef class Data:
    cdef blocks_t blocks
    cdef csr_t csr              # valid if A is given or formed
    cdef rows_t rows            # valid if factored
    cdef generalized_t general  # valid if is_general
    cdef readonly bint factored, is_general
    cdef readonly bint ready            # d, nu, step and Y are known
    cdef readonly bint single_rows      # every block is one bounded row
    cdef readonly object empty
    cdef object _numbers
    cdef list _arrays           # d, nu and step, created at first use
    cdef derived_t derived      # valid if is_general and ready
    cdef readonly double reference_energy, reference_velocity, relative_at_zero   # negative if unknown
    cdef islands_t islands_at           # target of blocks.islands, if that is not NULL
    cdef object _weight
    cdef list keep
    cdef Data owner             # owner of all other arrays, if `with_law` made this object; else None

    cdef view_t get_pointers(self) noexcept nogil
    cdef void adopt_derived(self, derived_t* derived)
    cdef void store_reference(self, const islands_t* islands, const double* start)
    cdef object get_derived_array(self, int which)
