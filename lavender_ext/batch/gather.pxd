"""Problems of a list beside each other, as worlds of one group of lanes.

Their b is the target of worlds with v* = 0: target - J v* is then b to the bit. Of M only the lower triangle is copied, as
entries if the pattern is shared.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memcpy, memset

from lavender_ext.batch.world cimport (AT_ROW, BLOCK, BLOCKS, CONE_ROW, FREE, JAC, MASS, PLACES, ROWS, SOFT, TARGET, VELOCITIES,
                                       worlds_t)
from lavender_ext.core.arena cimport arena_t, has_memory, make_arena, take_doubles, take_integers
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.view cimport generalized_t
from lavender_ext.small.task cimport grow_workspace_to_arena, task_t


cdef inline void set_places_of_task(const task_t* j, int64_t* at) noexcept nogil:
    """Write the sizes of a problem to the columns of `at` (PLACES) that describe a world."""
    at[ROWS], at[VELOCITIES], at[BLOCKS] = j.v.p.n_rows, j.g.n, j.v.p.n_blocks


cdef inline bint gather_tasks(const task_t* tasks, const int64_t* of, int32_t n, const int64_t* places, workspace_t* memory,
                              int64_t* at, worlds_t* w) noexcept nogil:
    """Copy the tasks of[0] ... of[n - 1], over J and M with equal numbers of velocities, to worlds in `memory`.

    at (n, PLACES) receives their places, the offsets of their impulses from `places`. Returns False without memory.
    """
    cdef const task_t* j
    cdef const blocks_t* p
    cdef const generalized_t* g
    cdef int64_t* own
    cdef int64_t rows = 0, blocks = 0, nv = tasks[of[0]].g.n, entries = tasks[of[0]].g.mptr[nv]
    cdef int32_t _pass, i, k, q
    cdef int32_t *ptr, *kind
    cdef double *jac, *mass, *free, *target, *soft, *lower, *upper, *mu, *patch_radius, *rolling
    cdef arena_t arena = make_arena(NULL, NULL)
    memset(w, 0, sizeof(worlds_t))
    w.mass_ptr, w.mass_col = tasks[of[0]].g.mptr, tasks[of[0]].g.midx
    for i in range(1, n):
        g = &tasks[of[i]].g
        if (g.mptr != w.mass_ptr and memcmp(g.mptr, w.mass_ptr, (nv + 1) * sizeof(int32_t))) \
                or (g.midx != w.mass_col and memcmp(g.midx, w.mass_col, entries * sizeof(int32_t))):
            w.mass_ptr, entries = NULL, nv * nv
            break
    for i in range(n):
        j, own = &tasks[of[i]], at + PLACES * i
        set_places_of_task(j, own)
        own[TARGET] = own[SOFT] = own[CONE_ROW] = rows
        own[JAC], own[MASS], own[FREE], own[BLOCK] = rows * nv, i * entries, 0, blocks
        own[AT_ROW] = places[PLACES * of[i] + AT_ROW]
        rows, blocks = rows + own[ROWS], blocks + own[BLOCKS]
    for _pass in range(2):                              # The first pass counts the numbers.
        ptr, kind = take_integers(&arena, blocks + 1), take_integers(&arena, blocks)
        jac, mass, free = take_doubles(&arena, rows * nv), take_doubles(&arena, n * entries), take_doubles(&arena, nv)
        target, soft = take_doubles(&arena, rows), take_doubles(&arena, rows)
        lower, upper = take_doubles(&arena, rows), take_doubles(&arena, rows)
        mu, patch_radius, rolling = take_doubles(&arena, blocks), take_doubles(&arena, blocks), take_doubles(&arena, blocks)
        if not has_memory(&arena) and not grow_workspace_to_arena(memory, &arena):
            return False
    memset(jac, 0, (rows * nv + n * entries + nv) * sizeof(double))     # J, M and v* follow one another.
    for i in range(n):
        j, own = &tasks[of[i]], at + PLACES * i
        p, g = &j.v.p, &j.g
        for k in range(g.m):
            for q in range(g.jptr[k], g.jptr[k + 1]):
                jac[own[JAC] + k * nv + g.jidx[q]] = g.jval[q]
        if w.mass_ptr != NULL:
            memcpy(mass + own[MASS], g.mval, entries * sizeof(double))
        for k in range(g.n if w.mass_ptr == NULL else 0):
            for q in range(g.mptr[k], g.mptr[k + 1]):
                mass[own[MASS] + k * nv + g.midx[q]] = g.mval[q]
        for k in range(p.n_blocks + 1):
            ptr[own[BLOCK] + k] = <int32_t>own[CONE_ROW] + p.ptr[k]
        memcpy(kind + own[BLOCK], p.kind, p.n_blocks * sizeof(int32_t))
        memcpy(target + own[TARGET], p.b, p.n_rows * sizeof(double))
        memcpy(soft + own[SOFT], g.compliance, p.n_rows * sizeof(double))
        memcpy(lower + own[CONE_ROW], p.lower, p.n_rows * sizeof(double))
        memcpy(upper + own[CONE_ROW], p.upper, p.n_rows * sizeof(double))
        memcpy(mu + own[BLOCK], p.mu, p.n_blocks * sizeof(double))
        memcpy(patch_radius + own[BLOCK], p.patch_radius, p.n_blocks * sizeof(double))
        memcpy(rolling + own[BLOCK], p.rolling, p.n_blocks * sizeof(double))
    w.n, w.at, w.asymmetry = n, at, -1.0
    w.array[0], w.array[1], w.array[2], w.array[3], w.array[4] = jac, mass, free, target, soft
    w.blocks = tasks[of[0]].v.p
    w.blocks.ptr, w.blocks.kind, w.blocks.lower, w.blocks.upper = ptr, kind, lower, upper
    w.blocks.mu, w.blocks.patch_radius, w.blocks.rolling = mu, patch_radius, rolling
    return True
