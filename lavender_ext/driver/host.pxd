"""Start a method in growing memory, and step it: for Python, small calls and batches.

The method reads the deadline of its options. C and WebAssembly call `lav_start` and `lav_step` in memory of theirs. Memory is
reused for a sequence of problems: allocating new pages costs more than solving a small one.
"""
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport free, malloc

from lavender_ext.core.method cimport CERTIFICATE, MORE, NEEDS_WORKSPACE, UNFIT, info_t, options_t, workspace_t
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport lav_start, lav_step, lav_workspace_size


cdef enum:
    MAX_SPARE_NUMBERS = 1 << 20     # Memory grows to twice the requested size, or by this number of spare numbers.


cdef inline bint grow_workspace_to(workspace_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Grow the workspace to at least these sizes; return False if out of memory. Growing discards the content."""
    cdef int64_t size
    if n_index > r.n_index:
        free(r.index)
        size = n_index + min(n_index, MAX_SPARE_NUMBERS)
        r.index = <int32_t*>malloc(size * sizeof(int32_t))
        r.n_index = size if r.index != NULL else 0
    if n_real > r.n_real:
        free(r.real)
        size = n_real + min(n_real, MAX_SPARE_NUMBERS)
        r.real = <double*>malloc(size * sizeof(double))
        r.n_real = size if r.real != NULL else 0
    return n_index <= r.n_index and n_real <= r.n_real


cdef inline void free_workspace(workspace_t* r) noexcept nogil:
    """Free both buffers of a workspace."""
    free(r.index)
    free(r.real)


cdef inline int32_t start_method(const view_t* v, const options_t* o, workspace_t* r, const double* lam, workspace_t* memory,
                                 bint analyses) noexcept nogil:
    """Grow `memory` and start from lam (m) until the method r has its workspace there; return the outcome.

    analyses: begin with the sizes, and end when the structure is known; NEEDS_WORKSPACE then means that a second
    call has to provide the doubles. Without memory, or if the method does not accept the problem, the result is UNFIT.
    """
    cdef int32_t how = NEEDS_WORKSPACE
    cdef int64_t n_index = -1
    if analyses and not lav_workspace_size(v, o, r):
        return UNFIT
    while how == NEEDS_WORKSPACE and not (analyses and (r.is_bound or r.n_index == n_index)):
        n_index = r.n_index
        if not grow_workspace_to(memory, n_index, 0 if analyses else r.n_real):
            return UNFIT
        r.index, r.real = memory.index, NULL if analyses else memory.real
        how = lav_start(v, o, r, lam)
    return how


cdef inline int32_t step_method(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                                info_t* info) noexcept nogil:
    """Do up to `work` units of work, also past a certificate; return the outcome."""
    cdef int32_t how = MORE, last = info.work + work
    while (how == MORE or how == CERTIFICATE) and info.work < last:
        how = lav_step(v, o, r, last - info.work, lam, info)
    return how
