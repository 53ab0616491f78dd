"""What a host without Python needs beside the kernels: layouts, settings, values, copies, room.

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
from lavender_ext.engine.arrays cimport (CAP_CONTACT, CAP_PAIR, H_ITERATIONS, H_NEED_CONTACTS, H_NEED_PAIRS,
                                         H_ORDER, H_PAIRS_VALID, H_POSITION_ITERATIONS, H_SEED, H_WARM_START,
                                         N_BODY, N_CACHE_IMPULSE, N_DYNAMIC, N_EXCLUDED, N_HEAD, N_JOINT,
                                         N_JOINT_REAL, N_JOINT_ROW, N_SETTINGS, N_SIZES, S_BETA, S_BOUNCE,
                                         S_GRAVITY, S_H, S_MARGIN, S_MATCH, S_MAX_PUSH, S_OUT, S_SKIN, S_SLOP,
                                         bind, engine_t)
from lavender_ext.engine.kept cimport copy_ints, copy_keys, copy_reals
from lavender_ext.judge.score cimport score_t


cdef struct settings_t:
    int32_t iterations          # sweeps
    int32_t warm_start          # 0 or 1
    int32_t position_iterations
    int32_t order               # as engine/arrays.pxd numbers them
    int32_t seed
    int32_t unused              # 0
    double h                    # s, substep
    double gravity[3]           # m/s^2
    double slop                 # m
    double margin               # m
    double skin                 # m
    double beta                 # -
    double max_push             # m
    double bounce               # m/s
    double match_distance       # m


cdef inline int32_t apart(const void* base, const void* field) noexcept nogil:
    return <int32_t>(<const char*>field - <const char*>base)


cdef public void lav_layout(int32_t* out) noexcept nogil:
    """Size of each struct in bytes, then the offsets of its fields; see STRUCTS."""
    cdef blocks_t p
    cdef csr_t a
    cdef rows_t r
    cdef score_t s
    cdef settings_t t
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
    out[43] = <int32_t>sizeof(settings_t)
    out[44] = apart(&t, &t.iterations)
    out[45] = apart(&t, &t.warm_start)
    out[46] = apart(&t, &t.position_iterations)
    out[47] = apart(&t, &t.order)
    out[48] = apart(&t, &t.seed)
    out[49] = apart(&t, &t.unused)
    out[50] = apart(&t, &t.h)
    out[51] = apart(&t, &t.gravity)
    out[52] = apart(&t, &t.slop)
    out[53] = apart(&t, &t.margin)
    out[54] = apart(&t, &t.skin)
    out[55] = apart(&t, &t.beta)
    out[56] = apart(&t, &t.max_push)
    out[57] = apart(&t, &t.bounce)
    out[58] = apart(&t, &t.match_distance)


cdef public void lav_engine_read_settings(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                          settings_t* out) noexcept nogil:
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind(size, real, index, keys, &e, n)
    out.iterations = e.head[H_ITERATIONS]
    out.warm_start = e.head[H_WARM_START]
    out.position_iterations = e.head[H_POSITION_ITERATIONS]
    out.order = e.head[H_ORDER]
    out.seed = e.head[H_SEED]
    out.unused = 0
    out.h = e.setting[S_H]
    for k in range(3):
        out.gravity[k] = e.setting[S_GRAVITY + k]
    out.slop = e.setting[S_SLOP]
    out.margin = e.setting[S_MARGIN]
    out.skin = e.setting[S_SKIN]
    out.beta = e.setting[S_BETA]
    out.max_push = e.setting[S_MAX_PUSH]
    out.bounce = e.setting[S_BOUNCE]
    out.match_distance = e.setting[S_MATCH]


cdef public void lav_engine_write_settings(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                           const settings_t* given) noexcept nogil:
    """Settings from the next substep on; the pair list is made anew, since margin and skin are its own."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind(size, real, index, keys, &e, n)
    e.head[H_ITERATIONS] = given.iterations
    e.head[H_WARM_START] = given.warm_start
    e.head[H_POSITION_ITERATIONS] = given.position_iterations
    e.head[H_ORDER] = given.order
    e.head[H_SEED] = given.seed
    if e.setting[S_MARGIN] != given.margin or e.setting[S_SKIN] != given.skin:
        e.head[H_PAIRS_VALID] = 0
    e.setting[S_H] = given.h
    for k in range(3):
        e.setting[S_GRAVITY + k] = given.gravity[k]
    e.setting[S_SLOP] = given.slop
    e.setting[S_MARGIN] = given.margin
    e.setting[S_SKIN] = given.skin
    e.setting[S_BETA] = given.beta
    e.setting[S_MAX_PUSH] = given.max_push
    e.setting[S_BOUNCE] = given.bounce
    e.setting[S_MATCH] = given.match_distance


cdef public void lav_engine_values(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                   double* out) noexcept nogil:
    """The eight solver values of the last substep (8)."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind(size, real, index, keys, &e, n)
    for k in range(8):
        out[k] = e.setting[S_OUT + k]


cdef public void lav_engine_copy(const int32_t* size, const double* real, const int32_t* index, const uint64_t* keys,
                                 double* to_real, int32_t* to_index, uint64_t* to_keys) noexcept nogil:
    """All three buffers: a snapshot is a copy, and restoring one is a copy back."""
    cdef engine_t e
    cdef int64_t n[3]
    bind(size, to_real, to_index, to_keys, &e, n)
    copy_reals(real, to_real, n[0])
    copy_ints(index, to_index, n[1])
    copy_keys(keys, to_keys, n[2])


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


cdef public void lav_engine_move(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                 const int32_t* to_size, double* to_real, int32_t* to_index,
                                 uint64_t* to_keys) noexcept nogil:
    """Into zeroed buffers with more room: what is carried from one substep to the next; scratch stays behind."""
    cdef engine_t a, b
    cdef int64_t used[3]
    cdef int64_t n = size[N_BODY], nd = size[N_DYNAMIC], kj = size[N_JOINT], mj = size[N_JOINT_ROW]
    cdef int64_t c = size[CAP_CONTACT]
    bind(size, real, index, keys, &a, used)
    bind(to_size, to_real, to_index, to_keys, &b, used)
    copy_reals(a.setting, b.setting, N_SETTINGS)
    copy_reals(a.x, b.x, 3 * n)
    copy_reals(a.q, b.q, 4 * n)
    copy_reals(a.v, b.v, 6 * n)
    copy_reals(a.inv_mass_body, b.inv_mass_body, n)
    copy_reals(a.inertia, b.inertia, 9 * n)
    copy_reals(a.inv_inertia_body, b.inv_inertia_body, 9 * n)
    copy_reals(a.shape, b.shape, 4 * n)
    copy_reals(a.friction, b.friction, n)
    copy_reals(a.restitution, b.restitution, n)
    copy_reals(a.patch, b.patch, n)
    copy_reals(a.fat, b.fat, 6 * n)
    copy_reals(a.joint, b.joint, N_JOINT_REAL * kj)
    copy_reals(a.joint_impulse, b.joint_impulse, mj)
    copy_reals(a.inv_mass, b.inv_mass, nd)
    copy_reals(a.inv_inertia, b.inv_inertia, 9 * nd)
    copy_reals(a.cache_impulse, b.cache_impulse, N_CACHE_IMPULSE * c)
    copy_reals(a.cache_local, b.cache_local, 6 * c)
    copy_ints(a.head, b.head, N_HEAD)
    copy_ints(a.kind_of_shape, b.kind_of_shape, n)
    copy_ints(a.dyn, b.dyn, n)
    copy_ints(a.uneven, b.uneven, n)
    copy_ints(a.body_of, b.body_of, nd)
    copy_ints(a.joint_kind, b.joint_kind, kj)
    copy_ints(a.joint_motor, b.joint_motor, kj)
    copy_ints(a.joint_bodies, b.joint_bodies, 2 * kj)
    copy_ints(a.joint_body, b.joint_body, 2 * kj)
    copy_ints(a.excluded, b.excluded, 2 * size[N_EXCLUDED])
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
    "settings_t": {
        "iterations": "i4", "warm_start": "i4", "position_iterations": "i4", "order": "i4", "seed": "i4",
        "unused": "i4", "h": "f8", "gravity": "3f8", "slop": "f8", "margin": "f8", "skin": "f8", "beta": "f8",
        "max_push": "f8", "bounce": "f8", "match_distance": "f8",
    },
}


def layout():
    """Struct -> (size in bytes, field -> offset in bytes), as this build has them."""
    cdef int32_t[::1] out = np.empty(sum(1 + len(fields) for fields in STRUCTS.values()), np.int32)
    lav_layout(&out[0])
    numbers = iter(np.asarray(out).tolist())
    return {name: (next(numbers), {field: next(numbers) for field in fields}) for name, fields in STRUCTS.items()}


def read_settings(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys):
    """The bytes of settings_t."""
    cdef settings_t out
    lav_engine_read_settings(&size[0], &real[0], &index[0], &keys[0], &out)
    return (<char*>&out)[:sizeof(settings_t)]


def write_settings(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys,
                   const settings_t[::1] given):
    """From one settings_t, a structured array (1,)."""
    lav_engine_write_settings(&size[0], &real[0], &index[0], &keys[0], &given[0])


def more_room(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys):
    """Sizes (10,) with room for what the last substep found missing."""
    cdef int32_t[::1] out = np.empty(N_SIZES, np.int32)
    lav_engine_more_room(&size[0], &real[0], &index[0], &keys[0], &out[0])
    return np.asarray(out)


def move(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys,
         const int32_t[::1] to_size, double[::1] to_real, int32_t[::1] to_index, uint64_t[::1] to_keys):
    """What lasts, into zeroed buffers of sizes at least as large."""
    lav_engine_move(&size[0], &real[0], &index[0], &keys[0], &to_size[0], &to_real[0], &to_index[0], &to_keys[0])
