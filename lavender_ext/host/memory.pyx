"""What a host without Python needs beside the kernels: layouts, values, room.

Such a host (WebAssembly) allocates every buffer and struct itself, so it must know where things lie. It asks
here instead of counting bytes, and what the compiler answers is compared with what the host expects.

Structs are written as `STRUCTS` lists them; engine/arrays.pyx tells of the engine's arrays in the order of `bind`: the
length of an array is the distance to the next one of the same buffer.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.rows cimport rows_t
from lavender_ext.engine.arrays cimport (CAP_CONTACT, CAP_PAIR, H_NEED_CONTACTS, H_NEED_PAIRS, H_PAIRS_VALID,
                                         N_CACHE_IMPULSE, N_JOINT, N_SIZES, ROWS_PER_CONTACT, S_OUT, bind, engine_t)
from lavender_ext.judge.score cimport score_t


cdef inline int32_t apart(const void* base, const void* field) noexcept nogil:
    return <int32_t>(<const char*>field - <const char*>base)


cdef public void lav_layout(int32_t* out) noexcept nogil:
    """Size of each struct in bytes, then the offsets of its fields; see STRUCTS."""
    cdef blocks_t p
    cdef csr_t a
    cdef rows_t r
    cdef score_t s
    out[0] = <int32_t>sizeof(blocks_t)
    out[1] = apart(&p, &p.n_blocks)
    out[2] = apart(&p, &p.n_rows)
    out[3] = apart(&p, &p.law)
    out[4] = apart(&p, &p.ptr)
    out[5] = apart(&p, &p.kind)
    out[6] = apart(&p, &p.lower)
    out[7] = apart(&p, &p.upper)
    out[8] = apart(&p, &p.mu)
    out[9] = apart(&p, &p.patch_radius)
    out[10] = apart(&p, &p.b)
    out[11] = apart(&p, &p.d)
    out[12] = apart(&p, &p.nu)
    out[13] = apart(&p, &p.step)
    out[14] = apart(&p, &p.rolling)
    out[15] = <int32_t>sizeof(csr_t)
    out[16] = apart(&a, &a.indptr)
    out[17] = apart(&a, &a.indices)
    out[18] = apart(&a, &a.data)
    out[19] = <int32_t>sizeof(rows_t)
    out[20] = apart(&r, &r.n_bodies)
    out[21] = apart(&r, &r.n_joints)
    out[22] = apart(&r, &r.n_contacts)
    out[23] = apart(&r, &r.jac)
    out[24] = apart(&r, &r.minv_jac)
    out[25] = apart(&r, &r.joint_body)
    out[26] = apart(&r, &r.normal)
    out[27] = apart(&r, &r.tangent)
    out[28] = apart(&r, &r.arm_a)
    out[29] = apart(&r, &r.arm_b)
    out[30] = apart(&r, &r.contact_body)
    out[31] = apart(&r, &r.coupling)
    out[32] = apart(&r, &r.swing)
    out[33] = apart(&r, &r.inv_mass)
    out[34] = apart(&r, &r.inv_inertia)
    out[35] = apart(&r, &r.compliance)
    out[36] = <int32_t>sizeof(score_t)
    out[37] = apart(&s, &s.energy)
    out[38] = apart(&s, &s.velocity)
    out[39] = apart(&s, &s.floor_energy)
    out[40] = apart(&s, &s.floor_velocity)
    out[41] = apart(&s, &s.worst)
    out[42] = apart(&s, &s.finite)


cdef public void lav_engine_values(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                   double* out) noexcept nogil:
    """The eight solver values of the last substep (8)."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind(size, real, index, keys, &e, n)
    for k in range(8):
        out[k] = e.setting[S_OUT + k]


cdef inline int32_t quarter_more(int32_t need) noexcept nogil:
    cdef double room = need * 1.25
    return 2147483647 if room > 2147483000.0 else <int32_t>room + 16


cdef public void lav_engine_more_room(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                      int32_t* out) noexcept nogil:
    """Sizes (N_SIZES) with room for what the last substep found missing, and a quarter more."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind(size, real, index, keys, &e, n)
    for k in range(N_SIZES):
        out[k] = size[k]
    if e.head[H_NEED_PAIRS] > size[CAP_PAIR]:
        out[CAP_PAIR] = quarter_more(e.head[H_NEED_PAIRS])
    if e.head[H_NEED_CONTACTS] > size[CAP_CONTACT]:
        out[CAP_CONTACT] = quarter_more(e.head[H_NEED_CONTACTS])


cdef inline void copy_reals(const double* source, double* goal, int64_t n) noexcept nogil:
    cdef int64_t k
    for k in range(n):
        goal[k] = source[k]


cdef inline void copy_ints(const int32_t* source, int32_t* goal, int64_t n) noexcept nogil:
    cdef int64_t k
    for k in range(n):
        goal[k] = source[k]


cdef inline void copy_keys(const uint64_t* source, uint64_t* goal, int64_t n) noexcept nogil:
    cdef int64_t k
    for k in range(n):
        goal[k] = source[k]


cdef public void lav_engine_move(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                 const int32_t* to_size, double* to_real, int32_t* to_index,
                                 uint64_t* to_keys) noexcept nogil:
    """Into zeroed buffers with more room: what is carried from one substep to the next; scratch stays behind."""
    cdef engine_t a, b
    cdef int64_t used[3]
    cdef int64_t kj = size[N_JOINT], c = size[CAP_CONTACT]
    bind(size, real, index, keys, &a, used)
    bind(to_size, to_real, to_index, to_keys, &b, used)
    # What lies side by side and does not depend on the room at once.
    copy_reals(a.setting, b.setting, a.rot - a.setting)
    copy_reals(a.fat, b.fat, a.joint_error - a.fat)
    copy_reals(a.joint_impulse, b.joint_impulse, a.v_free - a.joint_impulse)
    copy_reals(a.cache_impulse, b.cache_impulse, N_CACHE_IMPULSE * c)
    copy_reals(a.cache_local, b.cache_local, 6 * c)
    copy_reals(a.cache_roll, b.cache_roll, 3 * c if size[ROWS_PER_CONTACT] > 4 else 0)
    copy_ints(a.head, b.head, a.pair - a.head)
    copy_ints(a.joint_body, b.joint_body, 2 * kj)
    copy_ints(a.ptr, b.ptr, kj + c + 1)
    copy_keys(a.cache_key, b.cache_key, c)
    b.head[H_PAIRS_VALID] = 0


#: Structs that cross the border: fields with their types, "p" for a pointer.
STRUCTS = {
    "blocks_t": {
        "n_blocks": "i4", "n_rows": "i4", "law": "i4", "ptr": "p", "kind": "p", "lower": "p", "upper": "p", "mu": "p",
        "patch_radius": "p", "b": "p", "d": "p", "nu": "p", "step": "p", "rolling": "p",
    },
    "csr_t": {"indptr": "p", "indices": "p", "data": "p"},
    "rows_t": {
        "n_bodies": "i4", "n_joints": "i4", "n_contacts": "i4", "jac": "p", "minv_jac": "p", "joint_body": "p",
        "normal": "p", "tangent": "p", "arm_a": "p", "arm_b": "p", "contact_body": "p", "coupling": "p", "swing": "p",
        "inv_mass": "p", "inv_inertia": "p", "compliance": "p",
    },
    "score_t": {
        "energy": "f8", "velocity": "f8", "floor_energy": "f8", "floor_velocity": "f8", "worst": "i4", "finite": "i4",
    },
}


def layout():
    """Struct -> (size in bytes, field -> offset in bytes), as this build has them."""
    cdef int32_t[::1] out = np.empty(sum(1 + len(fields) for fields in STRUCTS.values()), np.int32)
    lav_layout(&out[0])
    numbers = iter(np.asarray(out).tolist())
    return {name: (next(numbers), {field: next(numbers) for field in fields}) for name, fields in STRUCTS.items()}


def more_room(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys):
    """Sizes (10,) with room for what the last substep found missing."""
    cdef int32_t[::1] out = np.empty(N_SIZES, np.int32)
    lav_engine_more_room(&size[0], &real[0], &index[0], &keys[0], &out[0])
    return np.asarray(out)


def move(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys,
         const int32_t[::1] to_size, double[::1] to_real, int32_t[::1] to_index, uint64_t[::1] to_keys):
    """What lasts, into zeroed buffers of sizes at least as large."""
    lav_engine_move(&size[0], &real[0], &index[0], &keys[0], &to_size[0], &to_real[0], &to_index[0], &to_keys[0])
