"""One world of a batch that is stored in a few arrays, float32 or float64, converted to the structs that kernels read.

The results are the numbers of `Generalized` from the same arrays: J and the lower triangle of M in compressed rows without
zeros, M = L^T D L in the given order, b = target - J v*. A world that `Generalized` would reorder is deferred to the caller.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memcpy

from lavender_ext.core.faults cimport NO_FAULT, find_friction_fault, is_valid_rhs
from lavender_ext.core.validate cimport find_invalid_magnitude, has_invalid_number
from lavender_ext.core.generalized cimport multiply_jacobian_row
from lavender_ext.core.mass cimport THIN_PADDING, compress_lower_triangle, compress_dense_rows, factor_mass, ordering_pays_off
from lavender_ext.core.tree cimport find_tree_factor_pattern
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.judge.rounding cimport mass_t
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.core.thin cimport thin
from lavender_ext.core.view cimport generalized_t


cdef enum:                      # status of a world
    LEFT = 0                    # deferred: the caller solves it
    READY = 1
    BAD = 2                     # invalid numbers
    TRIED = 3                   # deferred after the compiled call of a single problem failed
    LATE = 4                    # no time to solve: the start was judged
    STARTED = 5                 # the start is a solution

cdef enum:                      # columns of `at`: sizes of a world, then offsets of its data in the arrays of all worlds
    ROWS = 0                    # number of rows
    VELOCITIES = 1              # number of velocities
    BLOCKS = 2                  # number of blocks
    JAC = 3                     # offset in J
    MASS = 4                    # offset in M
    FREE = 5                    # offset in v*
    TARGET = 6                  # offset in the targets
    SOFT = 7                    # offset in the compliances
    MU = 8                      # offset in mu, if given per world
    BLOCK = 9                   # offset in the blocks
    CONE_ROW = 10               # offset in the rows of the blocks
    AT_ROW = 11                 # offset in the impulses
    VELOCITY = 12               # offset in the resulting velocities
    PLACES = 13

cdef enum:                      # arrays that may be in float32
    N_ARRAYS = 6

cdef enum:
    MIN_REORDERED_VELOCITIES = 400                  # `Generalized` searches another order from this number of velocities on


cdef struct worlds_t:
    int64_t n
    const int64_t* at           # (n, PLACES)
    const void* array[N_ARRAYS]     # J, M, v*, target, compliance, mu (NULL: mu of the blocks)
    int32_t narrow[N_ARRAYS]    # 1 for float32
    int64_t jac_row_stride      # stride of the rows of J; 0: number of velocities
    int64_t mass_row            # stride of the rows of M
    const int32_t* mass_ptr     # (nv + 1) row pointers of lower triangles with one shared pattern; NULL: M is dense
    const int32_t* mass_col     # columns, ascending in each row, the diagonal last
    blocks_t blocks             # blocks of all worlds, or blocks shared by every world
    double asymmetry            # permitted asymmetry of M_ij relative to sqrt(M_ii M_jj)


cdef struct worker_scratch_t:   # of one thread
    workspace_t workspace       # data of the current world
    workspace_t tree            # pattern of the last world's factor of M
    int32_t n_tree              # number of velocities of that pattern; -1: none
    mass_t mass                 # M of the current world
    double* free                # v* of the current world


cdef inline void convert_entries_to_float64(const worlds_t* w, int32_t which, int64_t first, int32_t n, double* out) noexcept nogil:
    """Copy n entries of an array to float64."""
    cdef int32_t i
    cdef const float* x = <const float*>w.array[which] + first
    if w.narrow[which]:
        for i in range(n):
            out[i] = x[i]
    else:
        memcpy(out, <const double*>w.array[which] + first, n * sizeof(double))


cdef inline const double* convert_matrix_to_float64(const worlds_t* w, int32_t which, int64_t first, int32_t m, int32_t n,
                                                    int64_t* row, double* out) noexcept nogil:
    """Return a matrix (m, n) in place, or converted from float32 in out (m n); row: stride of its rows."""
    cdef int32_t i
    if not row[0]:
        row[0] = n
    if not w.narrow[which]:
        return <const double*>w.array[which] + first
    for i in range(m):
        convert_entries_to_float64(w, which, first + i * row[0], n, out + <int64_t>i * n)
    row[0] = n
    return out


cdef inline bint find_factor_pattern(worker_scratch_t* d, int32_t n, const int32_t* ptr, const int32_t* idx,
                                     generalized_t* g) noexcept nogil:
    """Bind the pattern of L, reusing the previous world's if M has the same pattern; return False without memory."""
    cdef int64_t capacity = <int64_t>n * (n + 1) // 2
    cdef int32_t* t
    cdef int32_t* scratch
    if not grow_workspace_to(&d.tree, 6 * <int64_t>n + 2 + 2 * capacity, 0):
        return False
    t = d.tree.index
    g.lptr, g.parent, g.lidx = t, t + n + 1, t + 2 * n + 1
    scratch = t + 2 * n + 1 + capacity
    t = scratch + 3 * n                                     # pattern of M
    if d.n_tree == n and memcmp(t, ptr, (n + 1) * sizeof(int32_t)) == 0 \
            and memcmp(t + n + 1, idx, ptr[n] * sizeof(int32_t)) == 0:
        return True
    d.n_tree = n
    memcpy(t, ptr, (n + 1) * sizeof(int32_t))
    memcpy(t + n + 1, idx, ptr[n] * sizeof(int32_t))
    find_tree_factor_pattern(n, ptr, idx, <int32_t>capacity, <int32_t*>g.lptr, <int32_t*>g.lidx, <int32_t*>g.parent, scratch,
                             scratch + n, scratch + 2 * n)
    return True


cdef inline int32_t convert_generalized_world(const worlds_t* w, int64_t i, worker_scratch_t* d, blocks_t* p,
                                              generalized_t* g) noexcept nogil:
    """Convert world i of J and M to p and g, in the worker's scratch d; return READY, BAD or LEFT."""
    cdef const int64_t* at = w.at + i * PLACES
    cdef const blocks_t* all = &w.blocks
    cdef int32_t m = <int32_t>at[ROWS], n = <int32_t>at[VELOCITIES], k = <int32_t>at[BLOCKS], j, entries, q
    cdef int32_t first = <int32_t>at[CONE_ROW], block = <int32_t>at[BLOCK]
    cdef int64_t full = <int64_t>m * n, half = <int64_t>n * (n + 1) // 2, row = w.jac_row_stride
    cdef int64_t numbers = full + 2 * half + 4 * n + 2 * m + k + 1 + THIN_PADDING, wide = full if m > n else <int64_t>n * n
    cdef const double* a
    cdef int32_t* ptr
    cdef int32_t* idx
    cdef double* x
    cdef double* b
    if (n >= MIN_REORDERED_VELOCITIES
            or not grow_workspace_to(&d.workspace, m + 1 + full + n + 1 + half + k + 1 + THIN_PADDING, numbers + wide)):
        return LEFT
    # J in compressed rows
    ptr, x = d.workspace.index, d.workspace.real
    idx = ptr + m + 1
    g.n, g.m, g.jptr, g.jidx, g.jval = n, m, ptr, idx, x
    a = convert_matrix_to_float64(w, 0, at[JAC], m, n, &row, x + numbers)
    entries = compress_dense_rows(a, row, m, n, ptr, idx, x)
    if has_invalid_number(x, entries):
        return BAD
    # lower triangle of M in compressed rows
    ptr, x = idx + full, x + full
    idx = ptr + n + 1
    if w.mass_ptr != NULL:
        row = entries = w.mass_ptr[n]
        a = convert_matrix_to_float64(w, 1, at[MASS], 1, entries, &row, d.workspace.real + numbers)
        if has_invalid_number(a, entries):
            return BAD
        ptr[0] = entries = 0
        for j in range(n):                              # without zeros off the diagonal
            q = w.mass_ptr[j]
            entries += thin(w.mass_ptr[j + 1] - q - 1, a + q, w.mass_col + q, idx + entries, x + entries)
            idx[entries], x[entries] = j, a[w.mass_ptr[j + 1] - 1]
            entries += 1
            ptr[j + 1] = entries
    else:
        row = w.mass_row
        a = convert_matrix_to_float64(w, 1, at[MASS], n, n, &row, d.workspace.real + numbers)
        entries = compress_lower_triangle(a, row, w.asymmetry, n, ptr, idx, x)
        if entries < 0 or has_invalid_number(x, entries):
            return BAD
    d.mass.ptr, d.mass.idx, d.mass.val = ptr, idx, x
    if not find_factor_pattern(d, n, ptr, idx, g):
        return LEFT
    if ordering_pays_off(g, entries):
        return LEFT
    # M = L^T D L
    x += half
    g.mptr, g.midx, g.mval, g.condition = d.mass.ptr, d.mass.idx, d.mass.val, 0.0
    if factor_mass(g, x, x + half, x + half + n) >= 0:
        return BAD
    # b = target - J v*
    x += half + 2 * n
    d.free, b, g.compliance = x, x + n, x + n + m
    convert_entries_to_float64(w, 2, at[FREE], n, d.free)
    convert_entries_to_float64(w, 3, at[TARGET], m, b)
    convert_entries_to_float64(w, 4, at[SOFT], m, <double*>g.compliance)
    for j in range(m):
        b[j] -= multiply_jacobian_row(g, j, d.free)
    if find_invalid_magnitude(g.compliance, m) >= 0 or has_invalid_number(d.free, n) or not is_valid_rhs(b, m):
        return BAD
    # blocks, with rows numbered from 0; a mu that is given per world replaces that of the blocks
    ptr, x = idx + half, x + n + 2 * m
    p[0] = all[0]
    p.n_rows, p.n_blocks = m, k
    for j in range(k + 1):
        ptr[j] = all.ptr[block + j] - first
    p.b, p.ptr, p.lower, p.upper = b, ptr, all.lower + first, all.upper + first
    p.kind, p.mu = all.kind + block, all.mu + block
    p.patch_radius, p.rolling = all.patch_radius + block, all.rolling + block
    if w.array[5] != NULL:
        convert_entries_to_float64(w, 5, at[MU], k, x)
        p.mu = x
    for j in range(k):
        if find_friction_fault(p, p.kind[j], j) != NO_FAULT:
            return BAD
    return READY
