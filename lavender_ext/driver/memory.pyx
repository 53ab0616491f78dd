"""Functions for programs without Python that contain the engine: solver values, and growth of the buffers.

Such a program (a web page, a C program) allocates every buffer itself. engine/arrays.pyx returns the offsets of the arrays in
the order of `bind_engine_arrays`: the length of an array is the distance to the next array of the same buffer.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.engine.arrays cimport (CAP_CONTACT, CAP_PAIR, H_NEED_CONTACTS, H_NEED_PAIRS, H_PAIRS_VALID, N_CACHE_IMPULSE,
                                         N_JOINT, N_SIZES, ROWS_PER_CONTACT, S_OUT, bind_engine_arrays, engine_t)


cdef public void lav_engine_values(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                   double* out) noexcept nogil:
    """Write the eight solver values of the last substep to out (8)."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind_engine_arrays(size, real, index, keys, &e, n)
    for k in range(8):
        out[k] = e.setting[S_OUT + k]


cdef inline int32_t add_quarter_capacity(int32_t need) noexcept nogil:
    """Return need * 1.25 + 16, at most 2^31 - 1."""
    cdef double workspace = need * 1.25
    return 2147483647 if workspace > 2147483000.0 else <int32_t>workspace + 16


cdef public void lav_engine_grow_workspace(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                           int32_t* out) noexcept nogil:
    """Write sizes (N_SIZES) of buffers for the pairs and contacts that did not fit in the last substep, and a quarter more."""
    cdef engine_t e
    cdef int64_t n[3]
    cdef int32_t k
    bind_engine_arrays(size, real, index, keys, &e, n)
    for k in range(N_SIZES):
        out[k] = size[k]
    if e.head[H_NEED_PAIRS] > size[CAP_PAIR]:
        out[CAP_PAIR] = add_quarter_capacity(e.head[H_NEED_PAIRS])
    if e.head[H_NEED_CONTACTS] > size[CAP_CONTACT]:
        out[CAP_CONTACT] = add_quarter_capacity(e.head[H_NEED_CONTACTS])


cdef public void lav_engine_move(const int32_t* size, double* real, int32_t* index, uint64_t* keys, const int32_t* to_size,
                                 double* to_real, int32_t* to_index, uint64_t* to_keys) noexcept nogil:
    """Copy the state that is carried between substeps, without scratch, to larger, zero-initialised buffers."""
    cdef engine_t a, b
    cdef int64_t used[3]
    cdef int64_t kj = size[N_JOINT], c = size[CAP_CONTACT]
    bind_engine_arrays(size, real, index, keys, &a, used)
    bind_engine_arrays(to_size, to_real, to_index, to_keys, &b, used)
    # Copy consecutive arrays together if their sizes do not depend on the capacities.
    memcpy(b.setting, a.setting, (a.rot - a.setting) * sizeof(double))
    memcpy(b.fat, a.fat, (a.joint_error - a.fat) * sizeof(double))
    memcpy(b.joint_impulse, a.joint_impulse, (a.v_free - a.joint_impulse) * sizeof(double))
    memcpy(b.cache_impulse, a.cache_impulse, N_CACHE_IMPULSE * c * sizeof(double))
    memcpy(b.cache_local, a.cache_local, 6 * c * sizeof(double))
    memcpy(b.cache_roll, a.cache_roll, (3 * c if size[ROWS_PER_CONTACT] > 4 else 0) * sizeof(double))
    memcpy(b.head, a.head, (a.pair - a.head) * sizeof(int32_t))
    memcpy(b.joint_body, a.joint_body, 2 * kj * sizeof(int32_t))
    memcpy(b.ptr, a.ptr, (kj + c + 1) * sizeof(int32_t))
    memcpy(b.cache_key, a.cache_key, c * sizeof(uint64_t))
    b.head[H_PAIRS_VALID] = 0


def compute_grown_workspace_sizes(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys):
    """Return sizes (10,) with capacity for the pairs and contacts that did not fit in the last substep."""
    cdef int32_t[::1] out = np.empty(N_SIZES, np.int32)
    lav_engine_grow_workspace(&size[0], &real[0], &index[0], &keys[0], &out[0])
    return np.asarray(out)


def move_engine_state(const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys,
                      const int32_t[::1] to_size, double[::1] to_real, int32_t[::1] to_index, uint64_t[::1] to_keys):
    """Copy the state that is carried between substeps to zero-initialised buffers of at least the same sizes."""
    lav_engine_move(&size[0], &real[0], &index[0], &keys[0], &to_size[0], &to_real[0], &to_index[0], &to_keys[0])
