"""Functions for programs without Python that contain the engine: solver values, and growth of the buffers.

Such a program (a web page, a C program) allocates every buffer itself. engine/arrays.pyx returns the offsets of the arrays in
the order of `bind_engine_arrays`: the length of an array is the distance to the next array of the same buffer.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.engine.arrays cimport (CAP_CONTACT, CAP_PAIR, H_NEED_CONTACTS, H_NEED_PAIRS, H_PAIRS_VALID, N_INDEX_ARRAYS,
                                         N_KEY_ARRAYS, N_REAL_ARRAYS, N_SIZES, S_OUT, bind_engine_arrays, engine_t)


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
    """Copy the state to larger, zero-initialised buffers; the list of pairs is built again."""
    cdef engine_t a, b
    cdef int64_t used[3]
    cdef double** real_of = &a.setting
    cdef double** to_real_of = &b.setting
    cdef int32_t** index_of = &a.head
    cdef int32_t** to_index_of = &b.head
    cdef uint64_t** keys_of = &a.key
    cdef uint64_t** to_keys_of = &b.key
    cdef int32_t k
    bind_engine_arrays(to_size, to_real, to_index, to_keys, &b, used)
    bind_engine_arrays(size, real, index, keys, &a, used)
    # An array ends where the next one begins.
    for k in range(N_REAL_ARRAYS):
        memcpy(to_real_of[k], real_of[k],
               ((real_of[k + 1] if k + 1 < N_REAL_ARRAYS else real + used[0]) - real_of[k]) * sizeof(double))
    for k in range(N_INDEX_ARRAYS):
        memcpy(to_index_of[k], index_of[k],
               ((index_of[k + 1] if k + 1 < N_INDEX_ARRAYS else index + used[1]) - index_of[k]) * sizeof(int32_t))
    for k in range(N_KEY_ARRAYS):
        memcpy(to_keys_of[k], keys_of[k],
               ((keys_of[k + 1] if k + 1 < N_KEY_ARRAYS else keys + used[2]) - keys_of[k]) * sizeof(uint64_t))
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
