"""One island's arrays: how many numbers it needs, where they stand, what of the whole is copied into them."""
from libc.stdint cimport int32_t, uint64_t

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.rows cimport rows_t


cdef enum:                      # how A is given
    MATRIX = 0
    BODIES = 1
    GENERAL = 2


cdef struct island_t:
    int32_t first               # place of its first block in `order`
    int32_t row                 # and of its first row in `rows`
    int32_t n_blocks
    int32_t n_rows
    int32_t n_moving            # bodies, velocities
    int32_t n_joints
    int32_t n_joint_rows
    int32_t n_entries           # of A in compressed rows, or of J
    int32_t n_lower             # entries of L left of the diagonal
    int32_t chosen              # it is to be solved here
    int32_t twin                # the island before that has the same bytes, -1
    int32_t end
    int32_t counts[6]
    ssize_t numbers             # where its numbers begin, and how many
    ssize_t n_numbers
    ssize_t marks               # and its int32
    ssize_t n_marks
    double relative             # residual that it ended with


cdef struct view_t:             # one island as the kernels read it
    blocks_t p
    blocks_t q                  # with d, nu and step of A in compressed rows
    csr_t a
    rows_t r
    generalized_t g
    double* lam                 # (m) where it starts


cdef struct plan_t:             # k blocks, m rows, n bodies or velocities in all
    int32_t* order              # (k) blocks by island
    int32_t* rows               # (m) rows by island
    int32_t* place              # (m) of each row in its island
    int32_t* number             # (n) of each body or velocity in its island
    int32_t* of                 # (n) its island, -1 where no row touches it
    int32_t* moving             # (n) bodies or velocities by island
    int32_t* first              # (islands + 1) the first of each island


cdef inline void count_entries(const blocks_t* p, const csr_t* a, const generalized_t* g, int32_t i, int32_t label,
                               island_t* s, plan_t* w) noexcept nogil:
    """Of A, of J in generalised coordinates, or neither, in the rows of block i of an island."""
    cdef int32_t j, q
    for j in range(p.ptr[i], p.ptr[i + 1]):
        if a != NULL:
            s.n_entries += a.indptr[j + 1] - a.indptr[j]
        if g != NULL:
            s.n_entries += g.jptr[j + 1] - g.jptr[j]
            for q in range(g.jptr[j], g.jptr[j + 1]):
                w.of[g.jidx[q]] = label


cdef inline void count_bodies(const blocks_t* p, const rows_t* r, int32_t i, int32_t label, island_t* s,
                              plan_t* w) noexcept nogil:
    """Bodies of block i, joints before contacts."""
    cdef int32_t h, b
    if i < r.n_joints:
        s.n_joints += 1
        s.n_joint_rows += p.ptr[i + 1] - p.ptr[i]
    for h in range(2):
        b = r.joint_body[2 * i + h] if i < r.n_joints else r.contact_body[2 * (i - r.n_joints) + h]
        if b >= 0:
            w.of[b] = label


cdef inline void spread(const generalized_t* g, plan_t* w) noexcept nogil:
    """A tree's velocities are of one island: up to the root, and down to those that no row touches."""
    cdef int32_t i, t
    for i in range(g.n - 1, -1, -1):
        t = g.parent[i]
        if t >= 0 and w.of[i] >= 0:
            w.of[t] = w.of[i]
    for i in range(g.n):
        t = g.parent[i]
        if t >= 0 and w.of[i] < 0:
            w.of[i] = w.of[t]


cdef inline void sizes(island_t* s, int32_t kind, bint also) noexcept nogil:
    """How many numbers and int32 the island needs; `also`: A in compressed rows beside bodies."""
    cdef ssize_t m = s.n_rows, k = s.n_blocks, n = s.n_moving, c = s.n_blocks - s.n_joints, mj = s.n_joint_rows
    s.n_numbers = 4 * m + 2 * k
    s.n_marks = 2 * k + 1
    if kind != GENERAL:
        s.n_numbers += 3 * m
    if kind == BODIES:
        s.n_numbers += 24 * mj + 17 * c + 6 * (m - mj) + 10 * n + m
        s.n_marks += 2 * k
    if kind == MATRIX or also:
        s.n_numbers += s.n_entries + (3 * m if also else 0)
        s.n_marks += m + 1 + s.n_entries
    if kind == GENERAL:
        s.n_numbers += m + s.n_entries + s.n_lower + 2 * n
        s.n_marks += m + 1 + s.n_entries + n + 1 + s.n_lower + n
    s.n_marks += s.n_marks & 1                          # whole words


cdef inline void point(const island_t* s, int32_t kind, bint also, int32_t law, double* x, int32_t* w,
                       view_t* v) noexcept nogil:
    cdef ssize_t m = s.n_rows, k = s.n_blocks, n = s.n_moving, c = s.n_blocks - s.n_joints, mj = s.n_joint_rows
    cdef blocks_t* p = &v.p
    cdef rows_t* r = &v.r
    cdef generalized_t* g = &v.g
    p.n_blocks = s.n_blocks
    p.n_rows = s.n_rows
    p.law = law
    v.lam = x
    p.b = x + m
    p.lower = x + 2 * m
    p.upper = x + 3 * m
    p.mu = x + 4 * m
    p.patch_radius = p.mu + k
    x += 4 * m + 2 * k
    p.ptr = w
    p.kind = w + k + 1
    w += 2 * k + 1
    p.d = p.nu = p.step = NULL
    if kind != GENERAL:
        p.d = x
        p.nu = x + m
        p.step = x + 2 * m
        x += 3 * m
    if kind == BODIES:
        r.n_bodies = s.n_moving
        r.n_joints = s.n_joints
        r.n_contacts = <int32_t>c
        r.jac = x
        r.minv_jac = x + 12 * mj
        x += 24 * mj
        r.normal = x
        r.tangent = x + 3 * c
        r.arm_a = x + 6 * c
        r.arm_b = x + 9 * c
        r.coupling = x + 12 * c
        x += 17 * c
        r.swing = x
        x += 6 * (m - mj)
        r.inv_mass = x
        r.inv_inertia = x + n
        x += 10 * n
        r.compliance = x
        x += m
        r.joint_body = w
        r.contact_body = w + 2 * s.n_joints
        w += 2 * k
    v.q = p[0]
    if kind == MATRIX or also:
        v.a.data = x
        x += s.n_entries
        v.a.indptr = w
        v.a.indices = w + m + 1
        w += m + 1 + s.n_entries
        if also:
            v.q.d = x
            v.q.nu = x + m
            v.q.step = x + 2 * m
    if kind == GENERAL:
        g.n = s.n_moving
        g.m = s.n_rows
        g.compliance = x
        g.jval = x + m
        x += m + s.n_entries
        g.lval = x
        x += s.n_lower
        g.inv_pivot = x
        g.root = x + n
        g.jptr = w
        g.jidx = w + m + 1
        w += m + 1 + s.n_entries
        g.lptr = w
        g.lidx = w + n + 1
        g.parent = w + n + 1 + s.n_lower


cdef inline void take(const double* x, int32_t n, const double* out) noexcept nogil:
    # into an array of this module's that the kernels only read
    cdef double* to = <double*>out
    cdef int32_t i
    for i in range(n):
        to[i] = x[i]


cdef inline void fill_csr(const blocks_t* p, const csr_t* a, const island_t* s, const int32_t* order, const int32_t* place,
                          view_t* v) noexcept nogil:
    cdef int32_t q, i, j, t, row = 0, at = 0
    cdef int32_t* indptr = <int32_t*>v.a.indptr
    cdef int32_t* indices = <int32_t*>v.a.indices
    cdef double* data = <double*>v.a.data
    indptr[0] = 0
    for q in range(s.first, s.first + s.n_blocks):
        i = order[q]
        for j in range(p.ptr[i], p.ptr[i + 1]):
            for t in range(a.indptr[j], a.indptr[j + 1]):
                indices[at] = place[a.indices[t]]
                data[at] = a.data[t]
                at += 1
            row += 1
            indptr[row] = at


cdef inline void fill_bodies(const blocks_t* p, const rows_t* r, const island_t* s, const int32_t* order,
                             const int32_t* number, const int32_t* moving, view_t* v) noexcept nogil:
    """`moving` (n_moving): the island's bodies; `number` of each body in its island."""
    cdef int32_t q, i, c, n, h, b, at, row = 0, mj = s.n_joint_rows, first = p.ptr[r.n_joints]
    cdef int32_t* joint_body = <int32_t*>v.r.joint_body
    cdef int32_t* contact_body = <int32_t*>v.r.contact_body
    for q in range(s.n_blocks):
        i = order[s.first + q]
        n = p.ptr[i + 1] - p.ptr[i]
        take(r.compliance + p.ptr[i], n, v.r.compliance + row)
        if i < r.n_joints:
            take(r.jac + 12 * p.ptr[i], 12 * n, v.r.jac + 12 * row)
            take(r.minv_jac + 12 * p.ptr[i], 12 * n, v.r.minv_jac + 12 * row)
            for h in range(2):
                b = r.joint_body[2 * i + h]
                joint_body[2 * q + h] = number[b] if b >= 0 else -1
        else:
            c = i - r.n_joints
            at = q - s.n_joints
            take(r.normal + 3 * c, 3, v.r.normal + 3 * at)
            take(r.tangent + 3 * c, 3, v.r.tangent + 3 * at)
            take(r.arm_a + 3 * c, 3, v.r.arm_a + 3 * at)
            take(r.arm_b + 3 * c, 3, v.r.arm_b + 3 * at)
            take(r.coupling + 5 * c, 5, v.r.coupling + 5 * at)
            take(r.swing + 6 * (p.ptr[i] - first), 6 * n, v.r.swing + 6 * (row - mj))
            for h in range(2):
                b = r.contact_body[2 * c + h]
                contact_body[2 * at + h] = number[b] if b >= 0 else -1
        row += n
    for q in range(s.n_moving):
        take(r.inv_mass + moving[q], 1, v.r.inv_mass + q)
        take(r.inv_inertia + 9 * <ssize_t>moving[q], 9, v.r.inv_inertia + 9 * q)


cdef inline void fill_trees(const blocks_t* p, const generalized_t* g, const island_t* s, const int32_t* order,
                            const int32_t* number, const int32_t* moving, view_t* v) noexcept nogil:
    cdef int32_t q, i, j, t, row = 0, at = 0
    cdef int32_t* jptr = <int32_t*>v.g.jptr
    cdef int32_t* jidx = <int32_t*>v.g.jidx
    cdef int32_t* lptr = <int32_t*>v.g.lptr
    cdef int32_t* lidx = <int32_t*>v.g.lidx
    cdef int32_t* parent = <int32_t*>v.g.parent
    cdef double* jval = <double*>v.g.jval
    cdef double* lval = <double*>v.g.lval
    jptr[0] = 0
    for q in range(s.first, s.first + s.n_blocks):
        i = order[q]
        take(g.compliance + p.ptr[i], p.ptr[i + 1] - p.ptr[i], v.g.compliance + row)
        for j in range(p.ptr[i], p.ptr[i + 1]):
            for t in range(g.jptr[j], g.jptr[j + 1]):
                jidx[at] = number[g.jidx[t]]
                jval[at] = g.jval[t]
                at += 1
            row += 1
            jptr[row] = at
    lptr[0] = 0
    at = 0
    for q in range(s.n_moving):
        i = moving[q]
        for t in range(g.lptr[i], g.lptr[i + 1]):
            lidx[at] = number[g.lidx[t]]
            lval[at] = g.lval[t]
            at += 1
        lptr[q + 1] = at
        parent[q] = number[g.parent[i]] if g.parent[i] >= 0 else -1
        take(g.inv_pivot + i, 1, v.g.inv_pivot + q)
        take(g.root + i, 1, v.g.root + q)


cdef inline void fill_blocks(const blocks_t* p, const blocks_t* of_matrix, const double* start, const island_t* s,
                             const int32_t* order, view_t* v) noexcept nogil:
    cdef int32_t q, i, j, n, row = 0
    cdef int32_t* ptr = <int32_t*>v.p.ptr
    cdef int32_t* kind = <int32_t*>v.p.kind
    ptr[0] = 0
    for q in range(s.n_blocks):
        i = order[s.first + q]
        j = p.ptr[i]
        n = p.ptr[i + 1] - j
        kind[q] = p.kind[i]
        take(p.mu + i, 1, v.p.mu + q)
        take(p.patch_radius + i, 1, v.p.patch_radius + q)
        take(start + j, n, v.lam + row)
        take(p.b + j, n, v.p.b + row)
        take(p.lower + j, n, v.p.lower + row)
        take(p.upper + j, n, v.p.upper + row)
        if v.p.d != NULL:
            take(p.d + j, n, v.p.d + row)
            take(p.nu + j, n, v.p.nu + row)
            take(p.step + j, n, v.p.step + row)
        if of_matrix != NULL:
            take(of_matrix.d + j, n, v.q.d + row)
            take(of_matrix.nu + j, n, v.q.nu + row)
            take(of_matrix.step + j, n, v.q.step + row)
        row += n
        ptr[q + 1] = row


cdef inline uint64_t hashed(const void* x, ssize_t words, uint64_t seed) noexcept nogil:
    """Four running products over 64-bit words."""
    cdef const uint64_t* w = <const uint64_t*>x
    cdef uint64_t a = seed, b = seed + 1, c = seed + 2, d = seed + 3, prime = <uint64_t>0x9E3779B97F4A7C15ULL
    cdef ssize_t i = 0
    while i + 4 <= words:
        a = (((a << 5) | (a >> 59)) ^ w[i]) * prime
        b = (((b << 5) | (b >> 59)) ^ w[i + 1]) * prime
        c = (((c << 5) | (c >> 59)) ^ w[i + 2]) * prime
        d = (((d << 5) | (d >> 59)) ^ w[i + 3]) * prime
        i += 4
    while i < words:
        a = (((a << 5) | (a >> 59)) ^ w[i]) * prime
        i += 1
    a = (a ^ (b >> 17)) * prime
    a = (a ^ (c >> 23)) * prime
    a = (a ^ (d >> 29)) * prime
    return a ^ (a >> 32)
