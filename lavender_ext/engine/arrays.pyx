"""The engine's arrays by name: where they lie in the three buffers, their shapes, and the numbers of engine/arrays.pxd."""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.engine.arrays cimport (CAP_CONTACT, CAP_PAIR, N_BODY, N_CACHE_IMPULSE, N_DYNAMIC, N_EXCLUDED, N_FRAME,
                                         N_HEAD, N_INDEX_ARRAYS, N_JOINT, N_JOINT_REAL, N_JOINT_ROW, N_KEY_ARRAYS,
                                         N_REAL_ARRAYS, N_SETTINGS, ROWS_PER_CONTACT, bind, engine_t)


cdef public void lav_engine_lengths(const int32_t* size, int32_t* used) noexcept nogil:
    """Entries (3) of the buffers of doubles, int32 and uint64 for these sizes; -1 where beyond 2^31."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef double real = 0.0
    cdef int32_t index = 0, k
    cdef uint64_t key = 0
    bind(size, &real, &index, &key, &e, n)
    for k in range(3):
        used[k] = <int32_t>n[k] if n[k] < 2147483647 else -1


cdef public void lav_engine_offsets(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                    int32_t* out) noexcept nogil:
    """First entry of each array in its buffer; see SHAPES. The buffers are not read."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind(size, real, index, keys, &e, n)
    cdef double** reals = &e.setting
    cdef int32_t** ints = &e.head
    cdef uint64_t** wide = &e.key
    for k in range(N_REAL_ARRAYS):
        out[k] = <int32_t>(reals[k] - real)
    for k in range(N_INDEX_ARRAYS):
        out[N_REAL_ARRAYS + k] = <int32_t>(ints[k] - index)
    for k in range(N_KEY_ARRAYS):
        out[N_REAL_ARRAYS + N_INDEX_ARRAYS + k] = <int32_t>(wide[k] - keys)


#: Arrays by buffer, in the order of `bind`, with their shapes; None: scratch of a substep.
SHAPES = {
    "real": {
        "setting": "settings", "x": "n 3", "q": "n 4", "v": "n 6", "inv_mass_body": "n", "inertia": "n 3 3",
        "inv_inertia_body": "n 3 3", "shape": "n 4", "friction": "n", "restitution": "n", "patch": "n",
        "rot": "frames 3 3", "fat": "n 6", "joint": "kj joint_reals", "joint_error": "mj", "jac": "mj 12",
        "minv_jac": "mj 12", "joint_impulse": "mj", "inv_mass": "nd", "inv_inertia": "nd 3 3", "v_free": "nd 6",
        "dv": "nd 6", "shift": "nd 6", "point": "c 3", "gap": "c", "normal": "c 3", "tangent": "nt 3",
        "arm_a": "c 3", "arm_b": "c 3", "coupling": "nt 5", "swing": "contact_rows 6", "local": "c 6",
        "cache_impulse": "c cache_reals", "cache_local": "c 6", "push": "pushes", "target": "m", "lower": "mj",
        "upper": "mj", "b": "m", "d": "m", "step": "m", "compliance": "m", "impulse": "m", "mu": "blocks",
        "patch_radius": "blocks", "rolling": "rolling_blocks", "cache_roll": "rolling_contacts 3",
    },
    "index": {
        "head": "heads", "kind_of_shape": "n", "dyn": "n", "uneven": "n", "body_of": "nd", "joint_kind": "kj",
        "joint_motor": "kj", "joint_bodies": "kj 2", "excluded": "excluded 2", "pair": "p 2",
        "pair_scratch": None, "count": None, "bucket": None, "chain": None, "cell": None, "contact_pair": "c 2",
        "joint_body": "kj 2", "contact_body": "c 2", "ptr": "block_ends", "kind": "blocks", "order": None,
        "order_scratch": None,
    },
    "keys": {
        "key": "c", "cache_key": "c", "color_scratch": None,
    },
}


def lengths(const int32_t[::1] size):
    """Entries of the three buffers (doubles, int32, uint64) that these sizes (10,) need; -1: too many."""
    cdef int32_t used[3]
    lav_engine_lengths(&size[0], used)
    return used[0], used[1], used[2]


def offsets(const int32_t[::1] size):
    """Array -> its first entry in its buffer, for these sizes (10,)."""
    cdef double real = 0.0
    cdef int32_t index = 0
    cdef uint64_t key = 0
    cdef int32_t[::1] out = np.empty(N_REAL_ARRAYS + N_INDEX_ARRAYS + N_KEY_ARRAYS, np.int32)
    lav_engine_offsets(&size[0], &real, &index, &key, &out[0])
    return dict(zip((name for names in SHAPES.values() for name in names), np.asarray(out).tolist(), strict=True))


def views(const int32_t[::1] size, real, index, keys):
    """Array -> writable view of one of the buffers, in its shape; without scratch."""
    c, kj, mj = size[CAP_CONTACT], size[N_JOINT], size[N_JOINT_ROW]
    rows, rolls = c * size[ROWS_PER_CONTACT], size[ROWS_PER_CONTACT] > 4
    known = {
        "n": size[N_BODY], "nd": size[N_DYNAMIC], "kj": kj, "mj": mj, "c": c, "p": size[CAP_PAIR],
        "nt": c if size[ROWS_PER_CONTACT] > 1 else 0, "m": mj + rows, "contact_rows": rows, "blocks": kj + c,
        "settings": N_SETTINGS, "heads": N_HEAD, "joint_reals": N_JOINT_REAL, "cache_reals": N_CACHE_IMPULSE,
        "block_ends": kj + c + 1, "pushes": mj + c,
        "rolling_blocks": (kj + c) * rolls, "rolling_contacts": c * rolls, "frames": size[N_FRAME], "excluded": size[N_EXCLUDED],
    }
    first = offsets(size)
    out = {}
    for buffer, shapes in zip((real, index, keys), SHAPES.values(), strict=True):
        for name, text in shapes.items():
            if text is not None:
                shape = tuple(known[word] if word in known else int(word) for word in text.split())
                end = first[name] + int(np.prod(shape, dtype=np.int64))
                out[name] = buffer[first[name] : end].reshape(shape)
    return out
