"""Growing workspace, reused for a sequence of small problems: allocating new pages costs more than solving one of them."""
from libc.stdint cimport int32_t, int64_t
from libc.stdlib cimport free, malloc

from lavender_ext.core.arena cimport arena_t, make_arena
from lavender_ext.core.method cimport workspace_t


cdef inline bint grow_workspace_to(workspace_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Grow the workspace to at least these sizes; return False if out of memory. Growing discards the content."""
    if n_index > r.n_index:
        free(r.index)
        r.index = <int32_t*>malloc(2 * n_index * sizeof(int32_t))
        r.n_index = 2 * n_index if r.index != NULL else 0
    if n_real > r.n_real:
        free(r.real)
        r.real = <double*>malloc(2 * n_real * sizeof(double))
        r.n_real = 2 * n_real if r.real != NULL else 0
    return n_index <= r.n_index and n_real <= r.n_real


cdef inline bint fits_workspace(const workspace_t* r, const arena_t* a) noexcept nogil:
    """Return whether the arrays that were taken from an arena are within the workspace in which it began."""
    return a.n_index <= r.n_index and a.n_real <= r.n_real


cdef inline bint grow_workspace_to_arena(workspace_t* r, arena_t* a) noexcept nogil:
    """Grow the workspace to the sizes that an arena has counted, and begin the arena in it; return False if out of memory."""
    if not grow_workspace_to(r, a.n_index, a.n_real):
        return False
    a[0] = make_arena(r.real, r.index)
    return True


cdef inline void free_workspace(workspace_t* r) noexcept nogil:
    """Free both buffers of a workspace."""
    free(r.index)
    free(r.real)
