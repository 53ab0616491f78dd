"""Block types: a block is a set of bounded rows, or a contact with a normal row and friction components.

    |lam_g| <= a_g lam_n    friction component g: rows after the normal with a common bound; a_g: friction coefficient     (1)

A disk is one component of two rows with mu; a box is two components of one row each, with mu_1 and mu_2. Torsional friction
(spin) is one row with coefficient mu r, rolling friction is two rows with mu_r. A round cone is one component of up to five
rows. It differs from (1): it is bounded in the norm of its own metric, and each group of its rows (two sliding, one spin,
two rolling) has one d.

Kernels that work on a contact use its friction components, not its kind. Only kernels that read or write bodies need the
meaning of the rows in space (`count_tangent_rows`, `count_angular_rows`).
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
    MAX_FRICTION_COMPONENTS = 3


cdef struct islands_t:          # partition of the blocks into islands (core/islands.pxd)
    int32_t n
    const int32_t* label        # (k) island of each block
    const int32_t* ptr          # (n + 1) first index in `order` of each island's blocks
    const int32_t* order        # (k) blocks sorted by island, ascending within each island
    double* reference           # (3 n) E0 [sqrt J] and V0 [m/s] of each island (judge/reference.pxd), then r of its zero impulse
    const double* terms         # NULL, or (m) m/s, the terms of each row, negative on rows that no impulse moves


cdef struct blocks_t:
    int32_t n_blocks            # k
    int32_t n_rows              # m
    int32_t law                 # COULOMB | CONE
    const int32_t* ptr          # (k + 1) first row of each block; ptr[0] = 0, increasing
    const int32_t* kind         # (k) ROW | CONTACT | CONTACT_SPIN | ROUND | CONTACT_BOX | CONTACT_ROLLING
    const double* lower         # (m) N s, read on ROW blocks
    const double* upper         # (m) N s, read on ROW blocks
    const double* mu            # (k) -, >= 0
    const double* patch_radius  # (k) m; for CONTACT_BOX mu_2 / mu_1 [-]; >= 0
    const double* b             # (m) m/s
    const double* d             # (m) 1/kg, > 0, equal on the two rows of a component, and on a group of a round cone
    const double* nu            # (m) 1/kg, > 0: velocity error = sqrt(nu d) |e|
    const double* step          # (m) kg: 1/d; on a component of two rows 1/lambda_max of these rows
    const double* rolling       # (k) m, >= 0: mu_r, read only on CONTACT_ROLLING
    const islands_t* islands    # NULL: one island; the caller passes its reference


cdef struct friction_components_t:      # friction components of one contact
    int32_t n                   # 0 to MAX_FRICTION_COMPONENTS
    int32_t first[MAX_FRICTION_COMPONENTS]      # first row, counted from the normal
    int32_t size[MAX_FRICTION_COMPONENTS]       # 1 or 2 rows; 3 to 5 for a round cone
    double friction_coefficient[MAX_FRICTION_COMPONENTS]    # a_g of (1)


cdef inline bint allows_rows(int32_t kind, int32_t n) noexcept nogil:
    """Return whether a block of this kind may have n rows."""
    if kind == ROW:
        return n > 0
    if kind == CONTACT or kind == CONTACT_SPIN:
        return kind <= n <= kind + 2
    if kind == ROUND:
        return 3 < n <= 6
    return n == 3 if kind == CONTACT_BOX else kind == CONTACT_ROLLING and 5 <= n <= 6


cdef inline void write_contact_bounds(const blocks_t* p) noexcept nogil:
    """Write canonical bounds on the rows of contacts. Kernels do not read them, but equal problems must compare equal."""
    cdef int32_t i, j
    for i in range(p.n_blocks):
        if p.kind[i] != ROW:
            for j in range(p.ptr[i], p.ptr[i + 1]):
                (<double*>p.lower)[j] = 0.0 if j == p.ptr[i] else -1.0 / 0.0
                (<double*>p.upper)[j] = 1.0 / 0.0


cdef inline bint has_independent_rows(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether block i is a set of bounded rows."""
    return p.kind[i] == ROW


cdef inline bint is_round_cone_contact(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether block i is a round cone: one component of more than two rows."""
    return p.kind[i] == ROUND


cdef inline bint is_disk_friction_contact(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether block i has one component of two rows: the common case, which loops compile with constant sizes."""
    return p.kind[i] == CONTACT and p.ptr[i + 1] - p.ptr[i] == 3


cdef inline bint is_box_friction_contact(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether block i has two components of one tangent row each."""
    return p.kind[i] == CONTACT_BOX


cdef inline int32_t choose_contact_kind(bint box, bint spins, bint rolls, int32_t tangents) noexcept nogil:
    """Return the kind of a contact with these properties."""
    return CONTACT_BOX if box else ROUND if tangents > 2 else CONTACT_ROLLING if rolls else CONTACT_SPIN if spins else CONTACT


cdef inline void append_friction_component(friction_components_t* q, int32_t size, double friction_coefficient) noexcept nogil:
    """Append a component to q, after the rows of the last one."""
    q.first[q.n] = 1 if q.n == 0 else q.first[q.n - 1] + q.size[q.n - 1]
    q.size[q.n] = size
    q.friction_coefficient[q.n] = friction_coefficient
    q.n += 1


cdef inline void get_friction_components(const blocks_t* p, int32_t i, friction_components_t* q) noexcept nogil:
    """Write the friction components of block i into q, in the order of its rows; none if block i `has_independent_rows`."""
    cdef int32_t kind = p.kind[i], n = p.ptr[i + 1] - p.ptr[i] - 1
    q.n = 0
    if n < 1 or kind == ROW:
        return
    if kind == CONTACT or kind == ROUND:
        append_friction_component(q, n, p.mu[i])
        return
    if kind == CONTACT_ROLLING:
        append_friction_component(q, 2, p.mu[i])
        if n == 5:
            append_friction_component(q, 1, p.mu[i] * p.patch_radius[i])
        append_friction_component(q, 2, p.rolling[i])
        return
    if n > 1:                                           # The last row is spin, or the second side of a box.
        append_friction_component(q, n - 1, p.mu[i])
    append_friction_component(q, 1, p.mu[i] * p.patch_radius[i])


cdef inline void get_disk_component(const blocks_t* p, int32_t i, friction_components_t* q) noexcept nogil:
    """Write the friction component of block i, which `is_disk_friction_contact`, into q."""
    q.n, q.first[0], q.size[0], q.friction_coefficient[0] = 1, 1, 2, p.mu[i]


cdef inline void get_row_groups(const blocks_t* p, int32_t i, friction_components_t* q) noexcept nogil:
    """Write the groups of rows of block i that have one d and are measured by their norm into q.

    The groups are the friction components; for a round cone they are 2 sliding rows, 1 spin row and 1 or 2 rolling rows.
    """
    cdef int32_t n = p.ptr[i + 1] - p.ptr[i] - 1
    if not is_round_cone_contact(p, i):
        get_friction_components(p, i, q)
        return
    q.n = 0
    append_friction_component(q, 2, p.mu[i])
    append_friction_component(q, 1, p.mu[i])
    if n > 3:
        append_friction_component(q, n - 3, p.mu[i])


cdef inline bint has_friction(const blocks_t* p) noexcept nogil:
    """Return whether the bounds of any block depend on its normal impulse; if not, both friction laws are the same."""
    cdef int32_t i, g
    cdef friction_components_t q
    for i in range(p.n_blocks):
        get_friction_components(p, i, &q)
        for g in range(q.n):
            if q.friction_coefficient[g] > 0.0:
                return True
    return False


cdef inline int32_t count_angular_rows(const blocks_t* p, int32_t i) noexcept nogil:
    """Return the number of angular rows of contact i, which follow its tangents.

    The number is also a bit set: bit 0 is one spin row, bit 1 is two rolling rows (1, 2 or 3 rows in all).
    """
    return 1 if p.kind[i] == CONTACT_SPIN else p.ptr[i + 1] - p.ptr[i] - 3 if p.kind[i] == CONTACT_ROLLING else 0


cdef inline int32_t count_tangent_rows(const blocks_t* p, int32_t i) noexcept nogil:
    """Return the number of tangent rows of contact i."""
    return p.ptr[i + 1] - p.ptr[i] - 1 - count_angular_rows(p, i)
