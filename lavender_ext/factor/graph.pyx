"""Quantities of a problem's structure: bodies of generalised velocities, an elimination order (graph.pxd)."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport generalized_t
from lavender_ext.factor.graph cimport order_graph, order_workspace_size


def order_for_elimination(const int32_t[::1] ptr, const int32_t[::1] near):
    """Return the vertices (n,) in an elimination order. near[ptr[i]:ptr[i + 1]] are the neighbours of i, without i itself."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1, all_ = <int32_t>near.shape[0]
    cdef double[::1] scratch = np.empty(order_workspace_size(n, all_) // 2 + 1)
    order_array = np.empty(n, np.int32)
    cdef int32_t[::1] order = order_array, index = np.empty(4 * n + all_ // 2 + 4, np.int32)
    cdef const int32_t* entries = &near[0] if all_ else NULL
    if n:
        with nogil:
            order_graph(n, &ptr[0], entries, <int32_t*>&scratch[0], &order[0], &index[0], &index[n], &index[3 * n + 1],
                        &index[2 * n + 1])
    return order_array


cdef enum:
    MAX_BODY_VELOCITIES = 6     # A body has at most six velocities.


def find_bodies_of_velocities(Data p, order):
    """Group the velocities of J and M to bodies, such that each block acts on at most two bodies.

    A body is at most six velocities that follow each other in the original order. Successive velocities belong to one body if
    they are mostly in the same panels of Y.

    Parameters
    ----------
    p : Data
    order : (nv,) int32 or None
        Velocity of each row of the factor of M, as `Generalized.order`; None for the original order.

    Returns
    -------
    body (k, 2), n, column (nv,), or None
        Bodies of each block, -1 for a missing body; number of bodies; 6 times the body of each velocity plus its index in the
        body. None if a block acts on more than two bodies.
    """
    p.compute_derived_numbers()
    cdef const generalized_t* g = &p.general
    cdef int32_t i, b, c, q, t, last = -1, size = 0, n = 0, k = p.blocks.n_blocks
    cdef int32_t[::1] given = np.arange(g.n, dtype=np.int32) if order is None else np.argsort(order).astype(np.int32)
    cdef int32_t[:, ::1] marks = np.full((4, g.n + 1), -1, np.int32)
    cdef int32_t* before = &marks[0, 0]                 # (nv) velocity that precedes each velocity in the order, or -1
    cdef int32_t* on = &marks[1, 0]                     # (nv) number of panels that contain each velocity
    cdef int32_t* both = &marks[2, 0]                   # (nv) number of panels that contain both the velocity and the preceding one
    cdef int32_t* seen = &marks[3, 0]
    body_array, column_array = np.full((k, 2), -1, np.int32), np.empty(g.n, np.int32)
    cdef int32_t[:, ::1] body = body_array
    cdef int32_t[::1] column = column_array
    for i in range(g.n):
        c = given[i]
        before[c], last = last, c
        on[c] = both[c] = 0
    for b in range(g.n_panels):
        for q in range(g.pcol[b], g.pcol[b + 1]):
            seen[g.cols[q]] = b
        for q in range(g.pcol[b], g.pcol[b + 1]):
            c = g.cols[q]
            on[c] += 1
            both[c] += before[c] >= 0 and seen[before[c]] == b
    for i in range(g.n):
        c = given[i]
        if i > 0 and size < MAX_BODY_VELOCITIES and 2 * both[c] >= max(on[c], on[before[c]]):
            size += 1
        else:
            n, size = n + 1, 1
        column[c] = MAX_BODY_VELOCITIES * (n - 1) + size - 1
    for i in range(k):
        b = g.home[i]
        for q in range(g.pcol[b], g.pcol[b + 1]):
            t = column[g.cols[q]] // MAX_BODY_VELOCITIES
            if body[i, 0] < 0:
                body[i, 0] = t
            elif t != body[i, 0] and t != body[i, 1]:
                if body[i, 1] >= 0:
                    return None
                body[i, 1] = t
    return (body_array, n, column_array) if n else None
