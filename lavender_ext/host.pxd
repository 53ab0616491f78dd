"""Start a method in memory of its caller, and step it: for Python, batches, small calls, the engine and the C library.

Callers that may allocate use `grow_workspace_to`, and reuse their memory: new pages cost more than solving a small problem.
"""
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport free, malloc

from lavender_ext.core.method cimport (CERTIFICATE, MORE, NEEDS_WORKSPACE, UNFIT, grow_t, info_t, method_t, options_t,
                                       workspace_t)
from lavender_ext.core.view cimport view_t


cdef enum:
    MAX_SPARE_NUMBERS = 1 << 20     # Memory that grows again doubles, with at most so many spare numbers.


cdef inline int32_t grow_workspace_to(workspace_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Grow the workspace to at least these sizes; return 0 if out of memory. Growing discards the content."""
    cdef int64_t size
    if n_index > r.n_index:
        free(r.index)
        size = max(n_index, min(2 * r.n_index, n_index + MAX_SPARE_NUMBERS))
        r.index = <int32_t*>malloc(size * sizeof(int32_t))
        r.n_index = size if r.index != NULL else 0
    if n_real > r.n_real:
        free(r.real)
        size = max(n_real, min(2 * r.n_real, n_real + MAX_SPARE_NUMBERS))
        r.real = <double*>malloc(size * sizeof(double))
        r.n_real = size if r.real != NULL else 0
    return n_index <= r.n_index and n_real <= r.n_real


cdef inline void free_workspace(workspace_t* r) noexcept nogil:
    """Free both buffers of a workspace."""
    free(r.index)
    free(r.real)


cdef inline int32_t analyse_for_method(const method_t* f, const view_t* v, const options_t* o, workspace_t* r,
                                       workspace_t* memory, grow_t grow) noexcept nogil:
    """Analyse the structure in integers of `memory`; return NEEDS_WORKSPACE with the sizes in r, or UNFIT, also without memory."""
    cdef int32_t outcome = NEEDS_WORKSPACE
    cdef int64_t n_index = -1
    r[0] = workspace_t(0, 0, NULL, NULL, 0, 0, 0, 0.0)
    if not f.workspace(v, o, r):
        return UNFIT
    while outcome == NEEDS_WORKSPACE and not r.is_bound and r.n_index != n_index:
        n_index = r.n_index
        if not grow(memory, n_index, 0):
            return UNFIT
        r.index, r.real = memory.index, NULL
        outcome = f.start(v, o, r, NULL)
    return outcome


cdef inline int32_t start_method(const method_t* f, const view_t* v, const options_t* o, workspace_t* r, const double* lam,
                                 workspace_t* memory, grow_t grow) noexcept nogil:
    """Start from lam (m), if r has the sizes; return MORE or another outcome, UNFIT if the memory does not suffice."""
    cdef int32_t outcome = NEEDS_WORKSPACE
    while outcome == NEEDS_WORKSPACE:
        if not grow(memory, r.n_index, r.n_real):
            return UNFIT
        r.index, r.real = memory.index, memory.real
        outcome = f.start(v, o, r, lam)
    return outcome


cdef inline int32_t step_method(const method_t* f, const view_t* v, const options_t* o, const workspace_t* r, int32_t work,
                                double* lam, info_t* info) noexcept nogil:
    """Do up to `work` units of work, also past a certificate; return the outcome."""
    cdef int32_t outcome = MORE, last = info.work + work
    while (outcome == MORE or outcome == CERTIFICATE) and info.work < last:
        outcome = f.step(v, o, r, last - info.work, lam, info)
    return outcome
