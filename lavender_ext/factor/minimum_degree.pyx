"""The order of minimum_degree.pxd for Python."""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.factor.minimum_degree cimport degree_order


cdef public void lav_minimum_degree(int32_t n, const int32_t* size, int32_t room, int32_t* list, int32_t* whole,
                                    int64_t* left, int32_t* head, int32_t* order) noexcept nogil:
    """As `degree_order`."""
    degree_order(n, size, room, list, whole, left, head, order)


def minimum_degree(const int32_t[::1] ptr, const int32_t[::1] near, const int32_t[::1] size):
    """(n,) vertices in their order of elimination; near[ptr[i]:ptr[i + 1]] are the neighbours of i, without i."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1, count = <int32_t>near.shape[0], i, total = 0
    out = np.empty(n, np.int32)
    cdef int32_t[::1] order = out, list_ = np.empty(count + count // 4 + n + 1, np.int32)
    cdef int32_t[::1] whole = np.empty(8 * n + 1, np.int32), head
    cdef int64_t[::1] left = np.empty(n + 1, np.int64)
    if n:
        for i in range(n):
            whole[i] = ptr[i]
            total += size[i]
        whole[n] = ptr[n]
        list_[:count] = near
        head = np.empty(total + 1, np.int32)
        with nogil:
            lav_minimum_degree(n, &size[0], <int32_t>list_.shape[0], &list_[0], &whole[0], &left[0], &head[0], &order[0])
    return out
