"""The engine's arrays by name: their offsets in the three buffers, their shapes, and the constants of engine/arrays.pxd."""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.engine.arrays cimport (N_CACHE_IMPULSE, N_INDEX_ARRAYS, N_JOINT_REAL, N_KEY_ARRAYS, N_REAL_ARRAYS,
                                         bind_engine_arrays, engine_t)


cdef public void lav_engine_lengths(const int32_t* size, int32_t* used) noexcept nogil:
    """Compute the lengths (3) of the buffers of doubles, int32 and uint64 for these sizes; -1 if a length exceeds int32."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef double real = 0.0
    cdef int32_t index = 0, k
    cdef uint64_t key = 0
    bind_engine_arrays(size, &real, &index, &key, &e, n)
    for k in range(3):
        used[k] = <int32_t>n[k] if n[k] < 2147483647 else -1


cdef public void lav_engine_offsets(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                    int32_t* out) noexcept nogil:
    """Compute the offset of each array in its buffer, in the order of SHAPES. The buffers are not read."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind_engine_arrays(size, real, index, keys, &e, n)
    cdef double** reals = &e.setting
    cdef int32_t** ints = &e.head
    cdef uint64_t** wide = &e.key
    for k in range(N_REAL_ARRAYS):
        out[k] = <int32_t>(reals[k] - real)
    for k in range(N_INDEX_ARRAYS):
        out[N_REAL_ARRAYS + k] = <int32_t>(ints[k] - index)
    for k in range(N_KEY_ARRAYS):
        out[N_REAL_ARRAYS + N_INDEX_ARRAYS + k] = <int32_t>(wide[k] - keys)


#: Arrays of each buffer, in the order of `bind_engine_arrays`: the shape of one entry, or None for scratch arrays of a substep.
SHAPES = {
    "real": {
        "setting": (), "x": (3,), "q": (4,), "v": (6,), "inv_mass_body": (), "inertia": (3, 3), "inv_inertia_body": (3, 3),
        "shape": (4,), "friction": (), "restitution": (), "patch": (), "rot": (3, 3), "fat": (6,), "joint": (N_JOINT_REAL,),
        "joint_error": (), "jac": (12,), "minv_jac": (12,), "joint_impulse": (), "inv_mass": (), "inv_inertia": (3, 3),
        "v_free": (6,), "dv": (6,), "shift": (6,), "point": (3,), "gap": (), "normal": (3,), "tangent": (3,), "arm_a": (3,),
        "arm_b": (3,), "coupling": (5,), "inv_inertia_arm": (6,), "local": (6,), "cache_impulse": (N_CACHE_IMPULSE,),
        "cache_local": (6,), "push": (), "target": (), "lower": (), "upper": (), "b": (), "d": (), "step": (),
        "compliance": (), "impulse": (), "mu": (), "patch_radius": (), "rolling": (), "cache_roll": (3,), "moved": (),
    },
    "index": {
        "head": (), "kind_of_shape": (), "dyn": (), "uneven": (), "body_of": (), "joint_kind": (), "joint_motor": (),
        "joint_bodies": (2,), "excluded": (2,), "pair": (2,), "pair_scratch": None, "count": None, "bucket": None,
        "chain": None, "cell": None, "contact_pair": (2,), "joint_body": (2,), "contact_body": (2,), "ptr": (), "kind": (),
        "order": None, "order_scratch": None, "due": (),
    },
    "keys": {"key": (), "cache_key": (), "color_scratch": None},
}


def compute_buffer_lengths(const int32_t[::1] size):
    """Return the lengths of the three buffers (doubles, int32, uint64) for these sizes (10,); -1 if a length exceeds int32."""
    cdef int32_t used[3]
    lav_engine_lengths(&size[0], used)
    return used[0], used[1], used[2]


def compute_array_offsets(const int32_t[::1] size):
    """Return {array name: offset in its buffer} for these sizes (10,)."""
    cdef double real = 0.0
    cdef int32_t index = 0
    cdef uint64_t key = 0
    cdef int32_t[::1] out = np.empty(N_REAL_ARRAYS + N_INDEX_ARRAYS + N_KEY_ARRAYS, np.int32)
    lav_engine_offsets(&size[0], &real, &index, &key, &out[0])
    return dict(zip((name for names in SHAPES.values() for name in names), np.asarray(out).tolist(), strict=True))


def make_array_views(const int32_t[::1] size, real, index, keys):
    """Return {array name: writable view into its buffer, in its shape}, without scratch arrays."""
    first = compute_array_offsets(size)
    out = {}
    for buffer, end, shapes in zip((real, index, keys), compute_buffer_lengths(size), SHAPES.values(), strict=True):
        starts = [first[name] for name in shapes]
        for (name, shape), start, stop in zip(shapes.items(), starts, [*starts[1:], end], strict=True):
            if shape is not None:
                out[name] = buffer[start:stop].reshape(-1, *shape)
    return out
