"""Growing workspace with arrays taken from an arena: first to count them, then with memory."""
from lavender_ext.core.arena cimport arena_t, make_arena
from lavender_ext.core.method cimport workspace_t
from lavender_ext.host cimport grow_workspace_to


cdef inline bint fits_workspace(const workspace_t* r, const arena_t* a) noexcept nogil:
    """Return whether the arrays that were taken from an arena are within the workspace in which it began."""
    return a.n_index <= r.n_index and a.n_real <= r.n_real


cdef inline bint grow_workspace_to_arena(workspace_t* r, arena_t* a) noexcept nogil:
    """Grow the workspace to the sizes that an arena has counted, and begin the arena in it; return False if out of memory."""
    if not grow_workspace_to(r, a.n_index, a.n_real):
        return False
    a[0] = make_arena(r.real, r.index)
    return True
