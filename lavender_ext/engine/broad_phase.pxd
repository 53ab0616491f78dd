"""The broad phase: a list of body pairs with overlapping boxes, reused while every body stays in its box.

Each body has an axis-aligned box that is larger than its shape by margin + skin. The list holds every pair of overlapping
boxes, sorted by bodies. It is rebuilt when a shape with its margin leaves its box. The narrow phase drops pairs beyond the
margin, so that the contacts depend on the poses alone, never on the age of the list.

With few bodies, every pair is tested. With many bodies, a hash grid has one level for each power of two in size. A body is
stored in the cell of its centre, at the finest level with cells at least as large as its box. It searches the neighbouring
cells of coarser levels and, on its own level, the cells that follow its own. The cost is linear in bodies and pairs for any mix
of sizes; counting sorts put the pairs in order. The search stops when more than MAX_PAIRS boxes overlap.
"""
from libc.math cimport fabs, floor
from libc.stdint cimport int32_t, uint32_t

from lavender_ext.engine.arrays cimport (BOX, CAP_PAIR, H_PAIRS, H_PAIRS_VALID, H_REBUILDS, MAX_PAIRS, N_BODY, N_BUCKET,
                                         N_EXCLUDED, NO_SHAPE, PLANE, SPHERE, S_MARGIN, S_SKIN, PAIR_COUNT_OVERFLOW, engine_t)


cdef inline void compute_half_extents(const engine_t* e, int32_t i, double* half) noexcept nogil:
    """Compute the half extents of the axis-aligned bounding box of body i."""
    cdef const double* s = e.shape + 4 * i
    cdef const double* r
    cdef int32_t k
    if e.kind_of_shape[i] == BOX:
        r = e.rot + 9 * i
        for k in range(3):
            half[k] = fabs(r[3 * k]) * s[0] + fabs(r[3 * k + 1]) * s[1] + fabs(r[3 * k + 2]) * s[2]
    else:
        for k in range(3):
            half[k] = s[0]


cdef inline int32_t is_pair_list_valid(engine_t* e) noexcept nogil:
    """Return whether every moving shape with its margin is inside the box that the list was built from."""
    cdef int32_t i, k
    cdef double half[3]
    cdef double m = e.setting[S_MARGIN], x
    cdef const double* fat
    if not e.head[H_PAIRS_VALID]:
        return 0
    for i in range(e.size[N_BODY]):
        if e.kind_of_shape[i] < SPHERE or e.dyn[i] < 0:
            continue
        fat = e.fat + 6 * i
        compute_half_extents(e, i, half)
        for k in range(3):
            x = e.x[3 * i + k]
            if not (x - half[k] - m >= fat[k] and x + half[k] + m <= fat[3 + k]):
                return 0
    return 1


cdef inline int32_t can_collide(const engine_t* e, int32_t i, int32_t j) noexcept nogil:
    """Return whether two bodies can collide: both have a shape and at least one is dynamic."""
    if e.kind_of_shape[i] == NO_SHAPE or e.kind_of_shape[j] == NO_SHAPE:
        return 0
    return e.dyn[i] >= 0 or e.dyn[j] >= 0


cdef inline int32_t boxes_overlap(const engine_t* e, int32_t i, int32_t j) noexcept nogil:
    """Return whether two bounding boxes overlap, or the lowest corner of a box is below a plane."""
    cdef const double* a = e.fat + 6 * i
    cdef const double* b = e.fat + 6 * j
    cdef const double* n
    cdef double s
    cdef int32_t k
    if e.kind_of_shape[i] == PLANE or e.kind_of_shape[j] == PLANE:
        n = e.shape + 4 * (i if e.kind_of_shape[i] == PLANE else j)
        b = b if e.kind_of_shape[i] == PLANE else a
        s = -n[3]
        for k in range(3):
            s += n[k] * (b[k] if n[k] > 0.0 else b[3 + k])
        return s <= 0.0
    return (a[0] <= b[3] and b[0] <= a[3] and a[1] <= b[4] and b[1] <= a[4] and a[2] <= b[5] and b[2] <= a[5])


cdef inline void append_broad_phase_pair(engine_t* e, int32_t i, int32_t j, int32_t* n) noexcept nogil:
    """Append a pair. Pairs beyond the capacity are only counted, so that the caller gets the needed capacity."""
    if n[0] < e.size[CAP_PAIR]:
        e.pair[2 * n[0]] = i if i < j else j
        e.pair[2 * n[0] + 1] = j if i < j else i
    n[0] += 1


cdef inline uint32_t hash_grid_cell(const int32_t* c, int32_t mask) noexcept nogil:
    """Return the bucket of a cell (x, y, z, level)."""
    cdef uint32_t h = (<uint32_t>c[0]) * <uint32_t>0x9E3779B1U
    h = (h ^ (h >> 15)) + (<uint32_t>c[1]) * <uint32_t>0x85EBCA77U
    h = (h ^ (h >> 13)) + (<uint32_t>c[2]) * <uint32_t>0xC2B2AE3DU
    h = (h ^ (h >> 16)) + (<uint32_t>c[3]) * <uint32_t>0x27D4EB2FU
    return (h ^ (h >> 15)) & <uint32_t>mask


cdef inline int32_t cell_index_of_coordinate(double x, double size) noexcept nogil:
    """Return the cell index of a coordinate, clamped to 1e9 so that far cells merge and neighbours stay neighbours."""
    cdef double c = floor(x / size)
    return <int32_t>(-1e9 if not c > -1e9 else (1e9 if c > 1e9 else c))


cdef inline double longest_side_of_bounding_box(const engine_t* e, int32_t i) noexcept nogil:
    """Return the longest side [m] of a body's bounding box."""
    cdef const double* f = e.fat + 6 * i
    cdef double extent = 0.0
    cdef int32_t k
    for k in range(3):
        if f[3 + k] - f[k] > extent:
            extent = f[3 + k] - f[k]
    return extent


cdef inline void find_pairs_by_grid(engine_t* e, int32_t* n_pairs) noexcept nogil:
    """Find the overlapping boxes by the hash grid, then test planes against every body."""
    cdef int32_t n = e.size[N_BODY], mask = e.size[N_BUCKET] - 1, i, j, k, level, x, y, z
    cdef uint32_t used = 0, slot
    cdef double extent, min_extent = 0.0, max_extent = 0.0, base, size, half
    cdef int32_t c[4]
    cdef int32_t low[3]
    cdef int32_t high[3]
    cdef const double* f
    cdef const int32_t* own
    # finest cell size: the smallest box; the hierarchy has at most 32 levels, smaller bodies share the finest level
    for i in range(n):
        if e.kind_of_shape[i] < SPHERE:
            continue
        extent = longest_side_of_bounding_box(e, i)
        if extent > max_extent:
            max_extent = extent
        if min_extent == 0.0 or extent < min_extent:
            min_extent = extent
    base = min_extent if min_extent > max_extent * 1e-9 else max_extent * 1e-9
    if not base > 0.0:
        base = 1.0
    # insert every body into its cell, in reverse order, so that chains are in increasing order
    for i in range(mask + 1):
        e.bucket[i] = -1
    i = n - 1
    while i >= 0:
        if e.kind_of_shape[i] >= SPHERE:
            f = e.fat + 6 * i
            extent = longest_side_of_bounding_box(e, i)
            size = base
            level = 0
            while size < extent and level < 31:
                size *= 2.0
                level += 1
            used |= (<uint32_t>1) << level
            for k in range(3):
                e.cell[4 * i + k] = cell_index_of_coordinate(0.5 * (f[k] + f[3 + k]), size)
            e.cell[4 * i + 3] = level
            slot = hash_grid_cell(e.cell + 4 * i, mask)
            e.chain[i] = e.bucket[slot]
            e.bucket[slot] = i
        i -= 1
    # search the cells around every body, on its own and all coarser levels in use
    for i in range(n):
        if e.kind_of_shape[i] < SPHERE:
            continue
        f = e.fat + 6 * i
        size = base
        for level in range(32):
            if level >= e.cell[4 * i + 3] and (used >> level) & 1:
                half = 0.5 * size
                for k in range(3):
                    low[k] = cell_index_of_coordinate(f[k] - half, size)
                    high[k] = cell_index_of_coordinate(f[3 + k] + half, size)
                c[3] = level
                # on its own level a body searches only the following cells: bodies of preceding cells search its cell
                own = e.cell + 4 * i if level == e.cell[4 * i + 3] else NULL
                if own != NULL:
                    low[0] = own[0]
                for x in range(low[0], high[0] + 1):
                    c[0] = x
                    for y in range(own[1] if own != NULL and x == own[0] else low[1], high[1] + 1):
                        c[1] = y
                        for z in range(low[2], high[2] + 1):
                            if own != NULL and x == own[0] and y == own[1] and z < own[2]:
                                continue
                            c[2] = z
                            j = e.bucket[hash_grid_cell(c, mask)]
                            while j >= 0:
                                if (e.cell[4 * j] == x and e.cell[4 * j + 1] == y and e.cell[4 * j + 2] == z
                                        and e.cell[4 * j + 3] == level
                                        and (j < i or own == NULL or x != own[0] or y != own[1]
                                             or z != own[2])
                                        and can_collide(e, i, j) and boxes_overlap(e, i, j)):
                                    append_broad_phase_pair(e, i, j, n_pairs)
                                    if n_pairs[0] > MAX_PAIRS:
                                        return
                                j = e.chain[j]
            size *= 2.0
    # planes have no cell
    for i in range(n):
        if e.kind_of_shape[i] == PLANE:
            for j in range(n):
                if e.kind_of_shape[j] >= SPHERE and can_collide(e, i, j) and boxes_overlap(e, i, j):
                    append_broad_phase_pair(e, i, j, n_pairs)
                    if n_pairs[0] > MAX_PAIRS:
                        return


cdef inline void sort_broad_phase_pairs(engine_t* e, int32_t n_pairs) noexcept nogil:
    """Sort the pairs by two stable counting sorts, by the second body, then by the first."""
    cdef int32_t n = e.size[N_BODY], i, t, s, word
    cdef int32_t* source = e.pair
    cdef int32_t* goal = e.pair_scratch
    for word in range(2):
        for i in range(n + 1):
            e.count[i] = 0
        for i in range(n_pairs):
            e.count[source[2 * i + 1 - word]] += 1
        s = 0
        for i in range(n):
            t = e.count[i]
            e.count[i] = s
            s += t
        for i in range(n_pairs):
            t = e.count[source[2 * i + 1 - word]]
            e.count[source[2 * i + 1 - word]] += 1
            goal[2 * t] = source[2 * i]
            goal[2 * t + 1] = source[2 * i + 1]
        source = e.pair_scratch
        goal = e.pair


cdef inline int32_t update_pair_list(engine_t* e) noexcept nogil:
    """Rebuild the pair list if a body has left its box; return the number of pairs, for which CAP_PAIR must have places."""
    cdef int32_t n = e.size[N_BODY], i, j, k, a, b, n_pairs = 0
    cdef double half[3]
    cdef double enlargement = e.setting[S_MARGIN] + e.setting[S_SKIN]
    if is_pair_list_valid(e):
        return e.head[H_PAIRS]
    e.head[H_PAIRS_VALID] = 0
    for i in range(n):
        if e.kind_of_shape[i] < SPHERE:
            continue
        compute_half_extents(e, i, half)
        for k in range(3):
            e.fat[6 * i + k] = e.x[3 * i + k] - half[k] - enlargement
            e.fat[6 * i + 3 + k] = e.x[3 * i + k] + half[k] + enlargement
    if e.size[N_BUCKET] > 0:
        find_pairs_by_grid(e, &n_pairs)
        if n_pairs > MAX_PAIRS:
            return PAIR_COUNT_OVERFLOW
        if n_pairs > e.size[CAP_PAIR]:
            return n_pairs
        sort_broad_phase_pairs(e, n_pairs)
    else:
        for i in range(n):
            for j in range(i + 1, n):
                if can_collide(e, i, j) and boxes_overlap(e, i, j):
                    if e.kind_of_shape[i] != PLANE or e.kind_of_shape[j] != PLANE:
                        append_broad_phase_pair(e, i, j, &n_pairs)
        if n_pairs > e.size[CAP_PAIR]:
            return n_pairs
    j = k = 0
    for i in range(n_pairs):                            # Remove the excluded pairs: both lists are sorted.
        a, b = e.pair[2 * i], e.pair[2 * i + 1]
        while j < e.size[N_EXCLUDED] and (e.excluded[2 * j] < a or (e.excluded[2 * j] == a and e.excluded[2 * j + 1] < b)):
            j += 1
        if j < e.size[N_EXCLUDED] and e.excluded[2 * j] == a and e.excluded[2 * j + 1] == b:
            continue
        e.pair[2 * k], e.pair[2 * k + 1] = a, b
        k += 1
    e.head[H_PAIRS] = k
    e.head[H_PAIRS_VALID] = 1
    e.head[H_REBUILDS] = 0 if e.head[H_REBUILDS] == 2147483647 else e.head[H_REBUILDS] + 1
    return e.head[H_PAIRS]
