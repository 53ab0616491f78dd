"""What a block is: bounded rows, or a normal and its parts. Kinds of contacts are told apart here; what works on one asks for
its parts.

    |lam_g| <= a_g lam_n    of part g, rows behind the normal that one bound holds together; a_g is its reach       (1)

A disk is one part of two rows with mu, a box two parts of one row with mu_1 and mu_2. What spins is one row with mu r, what
rolls two rows with mu_r. A round cone is one part of up to five rows, but for (1): it is bounded in the norm of its own
metric, and groups of its rows (two that slide, one that spins, two that roll) have one d each.

Of what a row is in space (`n_directions`, `n_turns`) only those know who read or write bodies.
"""
from libc.stdint cimport int32_t


cdef enum:                      # kinds of blocks
    ROW = 0
    CONTACT = 1
    CONTACT_SPIN = 2
    ROUND = 3
    CONTACT_BOX = 4
    CONTACT_ROLLING = 5

cdef enum:
    COULOMB = 0
    CONE = 1

cdef enum:
    PARTS = 3                   # most of a contact


cdef struct islands_t:          # sets of blocks that no other block can influence (core/islands.pxd)
    int32_t n
    const int32_t* label        # (k) island of each block
    const int32_t* ptr          # (n + 1) places in `order` of each island's blocks
    const int32_t* order        # (k) blocks by island, ascending in each
    double* reference           # (2 n) E0 [sqrt J] and V0 [m/s] of each island (judge/reference.pxd)
    double energy               # E0 of all rows, sqrt J: for rows without a scale of their own


cdef struct blocks_t:
    int32_t n_blocks            # k
    int32_t n_rows              # m
    int32_t law                 # COULOMB | CONE
    const int32_t* ptr          # (k + 1) first row of each block; ptr[0] = 0, increasing
    const int32_t* kind         # (k) ROW | CONTACT | CONTACT_SPIN | ROUND | CONTACT_BOX | CONTACT_ROLLING
    const double* lower         # (m) N s, read on ROW blocks
    const double* upper         # (m) N s, read on ROW blocks
    const double* mu            # (k) -, >= 0
    const double* patch_radius  # (k) m, of CONTACT_BOX mu_2 / mu_1 [-]; >= 0
    const double* b             # (m) m/s
    const double* d             # (m) 1/kg, > 0, equal on the two rows of a part, and of a group of a round cone
    const double* nu            # (m) 1/kg, > 0: velocity error = sqrt(nu d) |e|
    const double* step          # (m) kg: 1/d, on two rows of a part 1/lambda_max of these two
    const double* rolling       # (k) m, >= 0: mu_r, read on CONTACT_ROLLING alone
    const islands_t* islands    # NULL: one island, whose reference the caller passes


cdef struct parts_t:            # of one contact
    int32_t n                   # 0 to PARTS
    int32_t first[PARTS]        # rows behind the normal
    int32_t size[PARTS]         # 1 or 2 rows; of a round cone 3 to 5
    double reach[PARTS]         # a_g of (1)


cdef enum:
    FRICTIONS = 3               # numbers of a block: mu, patch_radius, rolling


cdef inline void lay_frictions(blocks_t* p, const double* x, Py_ssize_t stride) noexcept nogil:
    """x: mu of all blocks, then, from each stride on, their other numbers."""
    p.mu, p.patch_radius, p.rolling = x, x + stride, x + 2 * stride


cdef inline void frictions_of(const blocks_t* p, const double** x) noexcept nogil:
    """Where each of the FRICTIONS begins."""
    x[0], x[1], x[2] = p.mu, p.patch_radius, p.rolling


cdef inline void from_block(blocks_t* p, const blocks_t* all, int32_t i) noexcept nogil:
    """What has one number in each block, from block i on."""
    p.kind, p.mu, p.patch_radius, p.rolling = all.kind + i, all.mu + i, all.patch_radius + i, all.rolling + i


cdef inline bint fits(int32_t kind, int32_t n) noexcept nogil:
    """Whether a block of that kind may have n rows."""
    if kind == ROW:
        return n > 0
    if kind == CONTACT or kind == CONTACT_SPIN:
        return kind <= n <= kind + 2
    if kind == ROUND:
        return 3 < n <= 6
    return n == 3 if kind == CONTACT_BOX else kind == CONTACT_ROLLING and 5 <= n <= 6


cdef inline void spell_bounds(const blocks_t* p) noexcept nogil:
    """One spelling for bounds of contacts, which nobody reads, so that equal problems compare equal."""
    cdef int32_t i, j
    for i in range(p.n_blocks):
        if p.kind[i] != ROW:
            for j in range(p.ptr[i], p.ptr[i + 1]):
                (<double*>p.lower)[j] = 0.0 if j == p.ptr[i] else -1.0 / 0.0
                (<double*>p.upper)[j] = 1.0 / 0.0


cdef inline bint is_rows(const blocks_t* p, int32_t i) noexcept nogil:
    """Bounded rows, without a normal."""
    return p.kind[i] == ROW


cdef inline bint is_round(const blocks_t* p, int32_t i) noexcept nogil:
    """More than two rows behind the normal in one cone."""
    return p.kind[i] == ROUND


cdef inline bint is_disk(const blocks_t* p, int32_t i) noexcept nogil:
    """One part of two rows: the common case, for loops that compile it apart."""
    return p.kind[i] == CONTACT and p.ptr[i + 1] - p.ptr[i] == 3


cdef inline bint is_box(const blocks_t* p, int32_t i) noexcept nogil:
    """Two tangents, each a part."""
    return p.kind[i] == CONTACT_BOX


cdef inline int32_t contact_kind(bint box, bint spins, bint rolls, int32_t tangents) noexcept nogil:
    """The kind of a contact that has these."""
    return CONTACT_BOX if box else ROUND if tangents > 2 else CONTACT_ROLLING if rolls else CONTACT_SPIN if spins else CONTACT


cdef inline void add_part(parts_t* q, int32_t size, double reach) noexcept nogil:
    q.first[q.n] = 1 if q.n == 0 else q.first[q.n - 1] + q.size[q.n - 1]
    q.size[q.n] = size
    q.reach[q.n] = reach
    q.n += 1


cdef inline void parts_of(const blocks_t* p, int32_t i, parts_t* q) noexcept nogil:
    """The parts of block i in the order of its rows; none where it `is_rows`."""
    cdef int32_t kind = p.kind[i], n = p.ptr[i + 1] - p.ptr[i] - 1
    q.n = 0
    if n < 1 or kind == ROW:
        return
    if kind == CONTACT or kind == ROUND:
        add_part(q, n, p.mu[i])
        return
    if kind == CONTACT_ROLLING:
        add_part(q, 2, p.mu[i])
        if n == 5:
            add_part(q, 1, p.mu[i] * p.patch_radius[i])
        add_part(q, 2, p.rolling[i])
        return
    if n > 1:                                           # spin, or the second side of a box
        add_part(q, n - 1, p.mu[i])
    add_part(q, 1, p.mu[i] * p.patch_radius[i])


cdef inline void disk_of(const blocks_t* p, int32_t i, parts_t* q) noexcept nogil:
    """`parts_of` where it `is_disk`."""
    q.n, q.first[0], q.size[0], q.reach[0] = 1, 1, 2, p.mu[i]


cdef inline void groups_of(const blocks_t* p, int32_t i, parts_t* q) noexcept nogil:
    """Rows of block i that count by their norm and have one d: its parts, but of a round cone 2, 1 and 1 or 2 rows."""
    cdef int32_t n = p.ptr[i + 1] - p.ptr[i] - 1
    if not is_round(p, i):
        parts_of(p, i, q)
        return
    q.n = 0
    add_part(q, 2, p.mu[i])
    add_part(q, 1, p.mu[i])
    if n > 3:
        add_part(q, n - 3, p.mu[i])


cdef inline bint has_friction(const blocks_t* p) noexcept nogil:
    """A block whose bounds depend on its own normal: else both laws are the same."""
    cdef int32_t i, g
    cdef parts_t q
    for i in range(p.n_blocks):
        parts_of(p, i, &q)
        for g in range(q.n):
            if q.reach[g] > 0.0:
                return True
    return False


cdef inline int32_t n_turns(const blocks_t* p, int32_t i) noexcept nogil:
    """Rows of contact i behind its tangents, as bits and as their number: 1 spins, 2 roll, 3 is one that spins and two."""
    return 1 if p.kind[i] == CONTACT_SPIN else p.ptr[i + 1] - p.ptr[i] - 3 if p.kind[i] == CONTACT_ROLLING else 0


cdef inline int32_t n_directions(const blocks_t* p, int32_t i) noexcept nogil:
    """Tangent rows of contact i, as directions in space."""
    return p.ptr[i + 1] - p.ptr[i] - 1 - n_turns(p, i)
