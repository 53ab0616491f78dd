"""What one substep leaves to the next: copied before a step that may be stopped inside, and put back after it.

    bodies      x, q, v
    joints      the impulses of their rows
    cache       keys, impulses and arms of the contacts in it
    counters    head and setting

All else is given by the scene or made anew by `prepare`. The pair list is not copied: after a step back it
is made anew, which changes no contact.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

from lavender_ext.engine.arrays cimport (H_CACHED, H_PAIRS_VALID, H_SOLVED, N_BODY, N_CACHE_IMPULSE,
                                         N_HEAD, N_JOINT_ROW, N_SETTINGS, ROWS_PER_CONTACT, engine_t)


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


cdef inline int64_t rolling_reals(const int32_t* size) noexcept nogil:
    """Doubles of a contact in the cache that resist rolling."""
    return 3 if size[ROWS_PER_CONTACT] > 4 else 0


cdef inline int64_t kept_reals(const int32_t* size, int64_t cached) noexcept nogil:
    """Doubles that a copy needs, with `cached` contacts in the cache."""
    cdef int64_t each = N_CACHE_IMPULSE + 6 + rolling_reals(size)
    return N_SETTINGS + 13 * <int64_t>size[N_BODY] + size[N_JOINT_ROW] + each * cached


cdef inline void keep(const engine_t* e, double* real, int32_t* index, uint64_t* keys) noexcept nogil:
    """real (kept_reals), index (N_HEAD), keys (contacts in the cache)."""
    cdef int64_t n = e.size[N_BODY], mj = e.size[N_JOINT_ROW], c = e.head[H_CACHED]
    copy_ints(e.head, index, N_HEAD)
    copy_reals(e.setting, real, N_SETTINGS)
    real += N_SETTINGS
    copy_reals(e.x, real, 13 * n)                       # x, q and v lie side by side
    real += 13 * n
    copy_reals(e.joint_impulse, real, mj)
    real += mj
    copy_reals(e.cache_impulse, real, N_CACHE_IMPULSE * c)
    copy_reals(e.cache_local, real + N_CACHE_IMPULSE * c, 6 * c)
    copy_reals(e.cache_roll, real + (N_CACHE_IMPULSE + 6) * c, rolling_reals(e.size) * c)
    copy_keys(e.cache_key, keys, c)


cdef inline void put_back(engine_t* e, const double* real, const int32_t* index, const uint64_t* keys) noexcept nogil:
    """What `keep` took; the arrays of the velocity problem hold nothing to be judged afterwards."""
    cdef int64_t n = e.size[N_BODY], mj = e.size[N_JOINT_ROW], c
    copy_ints(index, e.head, N_HEAD)
    c = e.head[H_CACHED]
    copy_reals(real, e.setting, N_SETTINGS)
    real += N_SETTINGS
    copy_reals(real, e.x, 13 * n)
    real += 13 * n
    copy_reals(real, e.joint_impulse, mj)
    real += mj
    copy_reals(real, e.cache_impulse, N_CACHE_IMPULSE * c)
    copy_reals(real + N_CACHE_IMPULSE * c, e.cache_local, 6 * c)
    copy_reals(real + (N_CACHE_IMPULSE + 6) * c, e.cache_roll, rolling_reals(e.size) * c)
    copy_keys(keys, e.cache_key, c)
    e.head[H_PAIRS_VALID] = 0
    e.head[H_SOLVED] = 0
