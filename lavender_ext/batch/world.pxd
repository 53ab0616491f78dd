"""One world of many that stand in a few arrays: J and M, dense, in float32 or float64, made what kernels read.

The same numbers as `Generalized` makes of the same arrays: J and the lower triangle of M in compressed rows without
zeros, M = L^T D L in the order given, b = target - J v*. What `Generalized` would put into another order is left to it.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memcpy, memset

from lavender_ext.core.door cimport are_pairs, first_unsized, has_outside, is_definite, is_frame, is_size, largest, least
from lavender_ext.core.generalized cimport jac_row
from lavender_ext.core.tree cimport tree_factor, tree_pattern
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.parts cimport blocks_t, from_block, is_rows
from lavender_ext.core.rows cimport rows_times
from lavender_ext.judge.rounding cimport mass_t
from lavender_ext.small.workspace cimport has_workspace_size
from lavender_ext.batch.thin cimport thin
from lavender_ext.core.view cimport generalized_t, rows_t


cdef enum:                      # what became of a world
    LEFT = 0                    # to the caller
    READY = 1
    BAD = 2                     # numbers that no problem has
    TRIED = 3                   # to the caller, after the same compiled call as of one problem
    LATE = 4                    # its start is judged: there was no time to solve
    STARTED = 5                 # its start is a solution

cdef enum:                      # columns of `at`: how many it has, and where they begin
    ROWS = 0
    VELOCITIES = 1
    BLOCKS = 2
    JAC = 3                     # in the entries of J,
    MASS = 4                    # of M,
    FREE = 5                    # of v*,
    TARGET = 6                  # of the target,
    SOFT = 7                    # of the compliance
    MU = 8                      # and of mu, where it has its own
    BLOCK = 9                   # in the blocks of all worlds,
    CONE_ROW = 10               # in their rows,
    AT_ROW = 11                 # in the impulses
    VELOCITY = 12               # and in the velocities that are the results
    PLACES = 13

cdef enum:                      # arrays that may be in float32
    N_ARRAYS = 6

cdef enum:
    BESIDE = 8                  # numbers behind its entries that `thin` may write
    MESH = 400                  # velocities from which on `Generalized` looks for another order


cdef enum:                      # fields of bodies
    INV_MASS = 0
    INV_INERTIA = 1
    V_FREE = 2
    JOINT_JAC = 3
    NORMAL = 4
    TANGENT = 5
    ARM_A = 6
    ARM_B = 7
    GOAL = 8                    # target,
    SOFTNESS = 9                # compliance,
    RUB = 10                    # mu of the contacts
    FIELDS = 11


cdef struct bodies_t:
    int32_t n, joints, contacts
    const double* field[FIELDS]     # of the first world,
    int64_t step[FIELDS]        # and numbers from one to the next, 0: of all
    const int32_t* pair[2]      # of joints, of contacts
    int64_t pair_step[2]


cdef struct worlds_t:
    int64_t n
    bint general                # J and M;
    bint factored               # bodies; else A in the place of J, b in that of the target
    bodies_t bodies
    const int64_t* at           # (n, PLACES)
    const void* array[N_ARRAYS]     # J, M, v*, target, compliance, mu (NULL: that of the blocks)
    int32_t narrow[N_ARRAYS]    # in float32
    int64_t jac_row             # numbers from one row of J to the next, 0: as many as velocities;
    int64_t mass_row            # of M
    const int32_t* mass_ptr     # (nv + 1) of lower triangles in compressed rows, all of one pattern; NULL: M is dense
    const int32_t* mass_col     # ascending in each row, the diagonal last
    blocks_t blocks             # of all worlds, or of each
    double asymmetry            # of sqrt(M_ii M_jj), that M may have


cdef struct desk_t:             # of one thread
    workspace_t workspace                 # of the world at hand
    workspace_t tree                 # and the pattern of the last M's factor
    int32_t n_tree              # velocities of that, -1: none
    int32_t splits              # L of a shared M has another pattern where entries are 0
    mass_t mass                 # of the world at hand
    double* free


cdef inline void widen(const worlds_t* w, int32_t which, int64_t first, int32_t n, double* out) noexcept nogil:
    cdef int32_t i
    cdef const float* x = <const float*>w.array[which] + first
    if w.narrow[which]:
        for i in range(n):
            out[i] = x[i]
    else:
        memcpy(out, <const double*>w.array[which] + first, n * sizeof(double))


cdef inline const double* widened(const worlds_t* w, int32_t which, int64_t first, int32_t m, int32_t n, int64_t* row,
                                  double* out) noexcept nogil:
    """A matrix (m, n) where it stands, or from float32 into out (m n); row: numbers from one row to the next."""
    cdef int32_t i
    if not row[0]:
        row[0] = n
    if not w.narrow[which]:
        return <const double*>w.array[which] + first
    for i in range(m):
        widen(w, which, first + i * row[0], n, out + <int64_t>i * n)
    row[0] = n
    return out


cdef inline int32_t rows_of(const double* a, int64_t row, int32_t m, int32_t n, int32_t* ptr, int32_t* idx,
                            double* val) noexcept nogil:
    """J in compressed rows; its entries."""
    cdef int32_t i, q = 0
    ptr[0] = 0
    for i in range(m):
        q += thin(n, a, NULL, idx + q, val + q)
        a += row
        ptr[i + 1] = q
    return q


cdef inline bint is_symmetric(const double* a, int64_t row, int32_t n) noexcept nogil:
    """To the last bit but the sign of 0? Without a branch."""
    cdef int32_t i, j, odd = 0
    for i in range(n):
        for j in range(i):
            odd |= a[i * row + j] != a[j * row + i]
    return not odd


cdef inline int32_t triangle_of(const double* a, int64_t row, double allowed, int32_t n, int32_t* ptr, int32_t* idx,
                                double* val) noexcept nogil:
    """The lower triangle of M with its diagonal in compressed rows; its entries, -1 where M is not symmetric."""
    cdef bint whole = is_symmetric(a, row, n)
    cdef const double* own = a
    cdef const double* other
    cdef int32_t i, j, q = 0
    cdef double gap, s
    ptr[0] = 0
    for i in range(n):
        other = a + i
        if whole:
            q += thin(i, own, NULL, idx + q, val + q)
        for j in range(0 if whole else i):
            if own[j] != 0.0 or other[0] != 0.0:
                idx[q] = j
                val[q] = own[j]
                q += 1
                if own[j] != other[0]:
                    gap = fabs(own[j] - other[0])
                    s = own[i] * a[j * (row + 1)]
                    if not (gap / sqrt(s) if s > 0.0 else gap) <= allowed:
                        return -1
            other += row
        idx[q] = i
        val[q] = own[i]
        q += 1
        ptr[i + 1] = q
        own += row
    return q


cdef inline int32_t thinned(const int32_t* given, const int32_t* col, const double* x, int32_t n, int32_t* ptr,
                            int32_t* idx, double* val) noexcept nogil:
    """A lower triangle in compressed rows without zeros left of its diagonal; its entries."""
    cdef int32_t i, k, q = 0
    ptr[0] = 0
    for i in range(n):
        k = given[i]
        q += thin(given[i + 1] - k - 1, x + k, col + k, idx + q, val + q)
        idx[q] = i
        val[q] = x[given[i + 1] - 1]
        q += 1
        ptr[i + 1] = q
    return q


cdef inline void find_tree(int32_t n, int64_t most, const int32_t* ptr, const int32_t* idx, int32_t* t) noexcept nogil:
    """In t (5 n + 1 + most): pointers of L (n + 1), parents (n) and columns (most), behind which all is scratch."""
    cdef int32_t* rest = t + 2 * n + 1 + most
    tree_pattern(n, ptr, idx, <int32_t>most, t, t + 2 * n + 1, t + n + 1, rest, rest + n, rest + 2 * n)


cdef inline void point_at_tree(const int32_t* t, int32_t n, generalized_t* g) noexcept nogil:
    g.lptr, g.parent, g.lidx = t, t + n + 1, t + 2 * n + 1


cdef inline bint tree_of(desk_t* d, int32_t n, const int32_t* ptr, const int32_t* idx, generalized_t* g) noexcept nogil:
    """The pattern of L, that of the world before where M has its entries in the same places; is there workspace for it?"""
    cdef int64_t most = <int64_t>n * (n + 1) // 2
    cdef int32_t* t
    if not has_workspace_size(&d.tree, 6 * <int64_t>n + 2 + 2 * most, 0):
        return False
    point_at_tree(d.tree.index, n, g)
    t = d.tree.index + 5 * n + 1 + most                 # M's
    if d.n_tree == n and memcmp(t, ptr, (n + 1) * sizeof(int32_t)) == 0 \
            and memcmp(t + n + 1, idx, ptr[n] * sizeof(int32_t)) == 0:
        return True
    d.n_tree = n
    memcpy(t, ptr, (n + 1) * sizeof(int32_t))
    memcpy(t + n + 1, idx, ptr[n] * sizeof(int32_t))
    find_tree(n, most, ptr, idx, d.tree.index)
    return True


cdef inline int32_t zeros_of(const double* x, int32_t n, const int64_t* known, int64_t* new) noexcept nogil:
    """Zeros among x (n); new: is one not `known` to be? As wide as the numbers and without a branch, for lanes."""
    cdef int64_t zeros = 0, found = 0, zero
    cdef int32_t k
    for k in range(n):
        zero = x[k] == 0.0
        zeros += zero
        found |= zero & ~known[k]
    new[0] = found
    return <int32_t>zeros


cdef inline int32_t whole_tree(const worlds_t* w, desk_t* d, int32_t n, const double* x, generalized_t* g) noexcept nogil:
    """Entries of a shared M without zeros; -1 where L has not the pattern that it has of the whole M, or there is no workspace.

    That it has with so many zeros it has with fewer: M is read where it stands, and looked at once.
    """
    cdef int64_t most = <int64_t>n * (n + 1) // 2, new
    cdef int32_t k, zeros, count = w.mass_ptr[n]
    cdef int32_t* t
    cdef int32_t* other
    cdef int32_t* ptr
    cdef int64_t* known                                 # places of zeros that L's pattern does without
    if d.splits or not has_workspace_size(&d.tree, 2 * (6 * <int64_t>n + 2 + 2 * most), 2 * <int64_t>count):
        return -1
    t, known = d.tree.index, <int64_t*>d.tree.real
    point_at_tree(t, n, g)
    if d.n_tree != n:
        d.n_tree = n
        find_tree(n, most, w.mass_ptr, w.mass_col, t)
        memset(known, 0, count * sizeof(int64_t))
    zeros = zeros_of(x, count, known, &new)
    if new:
        for k in range(count):
            known[count + k] = known[k] | (x[k] == 0.0)
        other, ptr = t + 5 * n + 1 + most, t + 10 * n + 2 + 2 * most
        places_without(w, n, known + count, ptr, ptr + n + 1)
        find_tree(n, most, ptr, ptr + n + 1, other)
        d.splits = memcmp(t, other, (n + 1) * sizeof(int32_t)) != 0 \
            or memcmp(g.lidx, other + 2 * n + 1, t[n] * sizeof(int32_t)) != 0
        if d.splits:
            d.n_tree = -1
            return -1
        memcpy(known, known + count, count * sizeof(int64_t))
    return count - zeros


cdef inline void places_without(const worlds_t* w, int32_t n, const int64_t* out, int32_t* ptr, int32_t* idx) noexcept nogil:
    """The shared M's pattern without the places of `out`, but with its diagonal."""
    cdef int32_t i, k, q = 0
    ptr[0] = 0
    for i in range(n):
        for k in range(w.mass_ptr[i], w.mass_ptr[i + 1]):
            idx[q] = w.mass_col[k]
            q += not out[k] or w.mass_col[k] == i
        ptr[i + 1] = q


cdef inline bint is_ordered(const generalized_t* g, int32_t entries) noexcept nogil:
    """Would `Generalized` look for an order with less fill? As `_worth_ordering` of lavender/problem/generalized.py."""
    cdef int32_t i, c
    cdef double work = 0.0
    if g.lptr[g.n] <= entries - g.n:
        return False
    for i in range(g.n):
        c = g.lptr[i + 1] - g.lptr[i]
        work += 0.5 * c * (c + 1.0)
    return 40.0 * work > 4e5 + 130.0 * entries


cdef inline int32_t lay_world(const worlds_t* w, int64_t i, desk_t* d, blocks_t* p, generalized_t* g) noexcept nogil:
    """World i on the desk; READY, BAD or LEFT."""
    cdef const int64_t* at = w.at + i * PLACES
    cdef int32_t m = <int32_t>at[ROWS], n = <int32_t>at[VELOCITIES], k = <int32_t>at[BLOCKS], j, entries
    cdef bint whole = True
    cdef int64_t all = <int64_t>m * n, half = <int64_t>n * (n + 1) // 2, row = w.jac_row
    cdef int64_t numbers = all + 2 * half + 4 * n + 2 * m + k + 1 + BESIDE, wide = all if m > n else <int64_t>n * n
    cdef const double* a
    cdef int32_t* ptr
    cdef int32_t* idx
    cdef double* x
    cdef double* b
    if n >= MESH or not has_workspace_size(&d.workspace, m + 1 + all + n + 1 + half + k + 1 + BESIDE, numbers + wide):
        return LEFT
    ptr, x = d.workspace.index, d.workspace.real
    idx = ptr + m + 1
    g.n, g.m, g.jptr, g.jidx, g.jval = n, m, ptr, idx, x
    a = widened(w, 0, at[JAC], m, n, &row, x + numbers)
    entries = rows_of(a, row, m, n, ptr, idx, x)
    if has_outside(x, entries):
        return BAD
    ptr, x = idx + all, x + all
    idx = ptr + n + 1
    if w.mass_ptr != NULL:
        row = entries = w.mass_ptr[n]
        a = widened(w, 1, at[MASS], 1, entries, &row, d.workspace.real + numbers)
        if has_outside(a, entries):
            return BAD
        d.mass.ptr, d.mass.idx, d.mass.val = w.mass_ptr, w.mass_col, a
        entries = whole_tree(w, d, n, a, g)
        if entries < 0:
            d.mass.ptr, d.mass.idx, d.mass.val = ptr, idx, x
            entries = thinned(w.mass_ptr, w.mass_col, a, n, ptr, idx, x)
            whole = False
    else:
        row = w.mass_row
        a = widened(w, 1, at[MASS], n, n, &row, d.workspace.real + numbers)
        entries = triangle_of(a, row, w.asymmetry, n, ptr, idx, x)
        if entries < 0 or has_outside(x, entries):
            return BAD
        d.mass.ptr, d.mass.idx, d.mass.val = ptr, idx, x
        whole = False
    if not whole and not tree_of(d, n, ptr, idx, g):
        return LEFT
    if is_ordered(g, entries):
        return LEFT
    x += half
    g.lval, g.inv_pivot, g.root = x, x + half, x + half + n
    if tree_factor(n, d.mass.ptr, d.mass.idx, d.mass.val, g.lptr, g.lidx, x, <double*>g.root, <double*>g.inv_pivot) >= 0:
        return BAD
    for j in range(n):
        (<double*>g.root)[j] = sqrt(g.inv_pivot[j])
    g.mptr, g.midx, g.mval, g.condition = d.mass.ptr, d.mass.idx, d.mass.val, 0.0
    x += half + 2 * n
    d.free, b, g.compliance = x, x + n, x + n + m
    widen(w, 2, at[FREE], n, d.free)
    widen(w, 3, at[TARGET], m, b)
    widen(w, 4, at[SOFT], m, <double*>g.compliance)
    for j in range(m):
        b[j] -= jac_row(g, j, d.free)
    if first_unsized(g.compliance, m) >= 0 or has_outside(d.free, n) or has_outside(b, m):
        return BAD
    if 0.0 < largest(b, m) < least():
        return BAD
    return lay_blocks(w, at, p, b, idx + half, x + n + 2 * m)


cdef inline int32_t lay_matrix(const worlds_t* w, int64_t i, desk_t* d, blocks_t* p, const double** a, int64_t* row) noexcept nogil:
    """World i of A (m, m), `row` numbers from one row to the next, on the desk; READY, BAD or LEFT."""
    cdef const int64_t* at = w.at + i * PLACES
    cdef int32_t m = <int32_t>at[ROWS], k = <int32_t>at[BLOCKS], j
    cdef double* b
    if not has_workspace_size(&d.workspace, k + 1, m + k + <int64_t>m * m):
        return LEFT
    b, row[0] = d.workspace.real, w.jac_row
    a[0] = widened(w, 0, at[JAC], m, m, row, b + m + k)
    for j in range(m):
        if has_outside(a[0] + j * row[0], m):
            return BAD
    widen(w, 3, at[TARGET], m, b)
    if has_outside(b, m) or 0.0 < largest(b, m) < least():
        return BAD
    return lay_blocks(w, at, p, b, d.workspace.index, b + m)


cdef inline int32_t lay_bodies(const worlds_t* w, int64_t i, desk_t* d, blocks_t* p, rows_t* r) noexcept nogil:
    """World i of bodies; READY, or LEFT: `Rows` makes whole what is a little off, and has words for the rest."""
    cdef const int64_t* at = w.at + i * PLACES
    cdef const bodies_t* o = &w.bodies
    cdef const double* x[FIELDS]
    cdef int32_t m = <int32_t>at[ROWS], kj = o.joints, c = o.contacts, k
    cdef int32_t size[FIELDS]
    cdef double* b
    cdef double* mu
    size[:] = [o.n, 9 * o.n, 6 * o.n, 12 * w.blocks.ptr[kj], 3 * c, 3 * c, 3 * c, 3 * c, m, m, c]
    if not has_workspace_size(&d.workspace, kj + c + 1, m + kj + c):
        return LEFT
    for k in range(FIELDS):
        x[k] = o.field[k] + i * o.step[k]
        if has_outside(x[k], size[k]):
            return LEFT
    r.n_bodies, r.n_joints, r.n_contacts = o.n, kj, c
    r.joint_body, r.contact_body = o.pair[0] + i * o.pair_step[0], o.pair[1] + i * o.pair_step[1]
    r.inv_mass, r.inv_inertia, r.jac, r.compliance = x[INV_MASS], x[INV_INERTIA], x[JOINT_JAC], x[SOFTNESS]
    r.normal, r.tangent, r.arm_a, r.arm_b = x[NORMAL], x[TANGENT], x[ARM_A], x[ARM_B]
    if not are_pairs(r.joint_body, kj, o.n, False) or not are_pairs(r.contact_body, c, o.n, True):
        return LEFT
    if first_unsized(r.inv_mass, o.n) >= 0 or first_unsized(r.compliance, m) >= 0:
        return LEFT
    for k in range(o.n):
        if not is_size(largest(r.inv_inertia + 9 * k, 9)) or not is_definite(r.inv_inertia + 9 * k, 5e-10, 0.0, 1e-6):
            return LEFT
    for k in range(c):
        if not is_frame(r.normal + 3 * k, r.tangent + 3 * k, 5e-10):
            return LEFT
    b, mu = d.workspace.real, d.workspace.real + m
    memset(mu, 0, kj * sizeof(double))
    memcpy(mu + kj, x[RUB], c * sizeof(double))
    if lay_blocks(w, at, p, b, d.workspace.index, mu, True) != READY:
        return LEFT
    d.free = <double*>x[V_FREE]
    rows_times(p, r, d.free, b)
    for k in range(m):
        b[k] = x[GOAL][k] - b[k]
    return LEFT if has_outside(b, m) or 0.0 < largest(b, m) < least() else READY


cdef inline int32_t lay_blocks(const worlds_t* w, const int64_t* at, blocks_t* p, const double* b, int32_t* ptr,
                               double* mu, bint has_mu=False) noexcept nogil:
    """Its blocks, whose rows count from 0, with its own mu where it has one (`has_mu`: there already); READY or BAD."""
    cdef const blocks_t* all = &w.blocks
    cdef int32_t k, first = <int32_t>at[CONE_ROW], block = <int32_t>at[BLOCK]
    p[0] = all[0]
    p.n_rows, p.n_blocks = <int32_t>at[ROWS], <int32_t>at[BLOCKS]
    for k in range(p.n_blocks + 1):
        ptr[k] = all.ptr[block + k] - first
    p.b, p.ptr, p.lower, p.upper = b, ptr, all.lower + first, all.upper + first
    from_block(p, all, block)
    if has_mu:
        p.mu = mu
    elif w.array[5] != NULL:
        widen(w, 5, at[MU], p.n_blocks, mu)
        p.mu = mu
    for k in range(p.n_blocks):
        if not is_size(p.mu[k]) or (not is_rows(p, k) and not is_size(p.mu[k] * p.patch_radius[k])):
            return BAD
    return READY
