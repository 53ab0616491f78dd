"""Copies of islands out of a problem over A or bodies, so that each is solved as a small problem with contiguous arrays."""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcmp, memcpy

from lavender_ext.core.arena cimport arena_t, take_doubles, take_integers
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport get_block_bodies, csr_t, rows_t, view_t
from lavender_ext.small.task cimport task_t


cdef struct island_t:           # an island copied from A or the bodies; its doubles and its integers are contiguous
    task_t s
    double* start               # (m) N s
    double* numbers
    int32_t* integers
    int64_t n_numbers
    int64_t n_integers


cdef struct island_index_t:     # rows, contacts and bodies of an island
    int32_t* row                # (m) rows of the problem
    int32_t* place              # (rows of the problem) row of the island, -1 in no island or in another one
    int32_t* contact            # (contacts of the island) contacts of the problem
    int32_t* body               # (n) bodies of the problem
    int32_t* number             # (bodies of the problem) body of the island, -1 outside of `copy_island_bodies`


cdef inline const double* gather(arena_t* arena, const double* x, int32_t width, const int32_t* index, int32_t n) noexcept nogil:
    """Copy the entries `index` (n) of x, each of `width` numbers, to an arena."""
    cdef double* out = take_doubles(arena, <int64_t>width * n)
    cdef int32_t i
    for i in range(n):
        if width == 1:
            out[i] = x[index[i]]
        else:
            memcpy(out + width * i, x + <int64_t>width * index[i], width * sizeof(double))
    return out


cdef inline void copy_island_bodies(island_t* x, const blocks_t* p, const rows_t* r, const int32_t* block,
                                    const island_index_t* z, arena_t* arena) noexcept nogil:
    """Copy the island's joints, contacts and bodies, which are numbered in the order of appearance."""
    cdef rows_t* y = &x.s.r
    cdef int32_t i, body, n = 0, k = x.s.v.p.n_blocks, m = x.s.v.p.n_rows, kj = x.s.split, mj = x.s.v.p.ptr[kj], c = k - kj
    cdef int32_t* pair = take_integers(arena, 2 * k)
    for i in range(2 * k):
        body = get_block_bodies(r, block[i // 2])[i % 2]
        if body >= 0 and z.number[body] < 0:
            z.number[body], z.body[n] = n, body
            n += 1
        pair[i] = z.number[body] if body >= 0 else -1
    for i in range(n):
        z.number[z.body[i]] = -1                        # Islands may share immovable bodies.
    y.n_bodies, y.n_joints, y.n_contacts, y.joint_body, y.contact_body = n, kj, c, pair, pair + 2 * kj
    y.inv_mass, y.inv_inertia = gather(arena, r.inv_mass, 1, z.body, n), gather(arena, r.inv_inertia, 9, z.body, n)
    y.compliance = gather(arena, r.compliance, 1, z.row, m)
    y.jac, y.minv_jac = gather(arena, r.jac, 12, z.row, mj), gather(arena, r.minv_jac, 12, z.row, mj)
    for i in range(c):
        z.contact[i] = block[kj + i] - r.n_joints
    y.normal, y.tangent = gather(arena, r.normal, 3, z.contact, c), gather(arena, r.tangent, 3, z.contact, c)
    y.arm_a, y.arm_b = gather(arena, r.arm_a, 3, z.contact, c), gather(arena, r.arm_b, 3, z.contact, c)
    y.coupling = gather(arena, r.coupling, 5, z.contact, c)
    for i in range(mj, m):
        z.row[i] -= p.ptr[r.n_joints]
    y.inv_inertia_arm = gather(arena, r.inv_inertia_arm, 6, z.row + mj, m - mj)
    x.s.v.r = y


cdef inline void copy_island(island_t* x, const view_t* v, const double* lam, const int32_t* block, int32_t k,
                             const island_index_t* z, arena_t arena) noexcept nogil:
    """Copy the island of k blocks out of a problem over A or bodies, with its start out of lam, to an arena."""
    cdef const blocks_t* p = &v.p
    cdef blocks_t* own = &x.s.v.p
    cdef const csr_t* a = v.a
    cdef int32_t i, q, m = 0, count = 0
    cdef int32_t* indices
    cdef double* data
    cdef int32_t* ptr = take_integers(&arena, k + 1)
    cdef int32_t* kind = take_integers(&arena, k)
    x.numbers, x.integers = arena.real, arena.index
    x.s.split = 0
    for i in range(k):
        ptr[i], kind[i] = m, p.kind[block[i]]
        x.s.split += v.r != NULL and block[i] < v.r.n_joints
        for q in range(p.ptr[block[i]], p.ptr[block[i] + 1]):
            z.row[m], z.place[q] = q, m
            m += 1
    ptr[k] = m
    own.n_blocks, own.n_rows, own.law, own.ptr, own.kind, own.islands = k, m, p.law, ptr, kind, NULL
    own.mu, own.patch_radius = gather(&arena, p.mu, 1, block, k), gather(&arena, p.patch_radius, 1, block, k)
    own.rolling = gather(&arena, p.rolling, 1, block, k)
    own.lower, own.upper = gather(&arena, p.lower, 1, z.row, m), gather(&arena, p.upper, 1, z.row, m)
    own.b, own.d = gather(&arena, p.b, 1, z.row, m), gather(&arena, p.d, 1, z.row, m)
    own.nu, own.step = gather(&arena, p.nu, 1, z.row, m), gather(&arena, p.step, 1, z.row, m)
    x.start = <double*>gather(&arena, lam, 1, z.row, m)
    x.s.v.a = x.s.v.r = x.s.v.g = NULL
    if v.r != NULL:
        copy_island_bodies(x, p, v.r, block, z, &arena)
    else:                                               # A between the island's rows; other entries are zeros of immovable bodies
        x.s.v.a, ptr = &x.s.a, take_integers(&arena, m + 1)
        indices, data = take_integers(&arena, 0), take_doubles(&arena, 0)
        for i in range(m):
            ptr[i] = count
            for q in range(a.indptr[z.row[i]], a.indptr[z.row[i] + 1]):
                if z.place[a.indices[q]] >= 0:
                    indices[count], data[count] = z.place[a.indices[q]], a.data[q]
                    count += 1
        ptr[m] = count
        x.s.a = csr_t(ptr, take_integers(&arena, count), take_doubles(&arena, count))
    x.n_numbers, x.n_integers = arena.n_real, arena.n_index
    x.s.lam = take_doubles(&arena, m)


cdef inline bint are_islands_identical(const island_t* x, const island_t* y) noexcept nogil:
    """Return whether two islands have bitwise identical data."""
    return (x.n_numbers == y.n_numbers and x.n_integers == y.n_integers
            and memcmp(x.numbers, y.numbers, x.n_numbers * sizeof(double)) == 0
            and memcmp(x.integers, y.integers, x.n_integers * sizeof(int32_t)) == 0)
