"""Anderson mixing of a fixed-point iteration v = T(u), g = v - u, over the last `memory` evaluations.

    u <- v - sum_i gamma_i (v_i+1 - v_i),    gamma = argmin |g - sum_i gamma_i (g_i+1 - g_i)|         (1)

Safeguards: where a mixed u multiplied |g| by more than 2 it is undone and the memory cleared. Where sum |gamma_i| is
above a limit of the caller's nothing is mixed and the memory cleared (bounded coefficients: Toth, Kelley, Convergence
analysis for Anderson acceleration, 2015). Where WINDOW evaluations have not brought the
least |g| below 0.9 of what it was, as many plain ones follow.
All sums run in a fixed order.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.dot cimport dot


cdef enum:
    MAX_MEMORY = 16
    WINDOW = 200

cdef enum:                      # places in control
    LAST = 0                    # |g| of the last evaluation
    KEPT = 1                    # differences in memory
    HEAD = 2                    # slot of the next one
    FRESH = 3                   # v and g of the evaluation before are there
    REST = 4                    # plain evaluations to come
    LEAST = 5                   # least |g| so far, 0 before any
    AGO = 6                     # the same when the window began
    STEPS = 7                   # evaluations since then
    UNDONE = 8                  # mixed u that were undone
    CONTROL = 9


cdef struct mixing_t:
    int32_t m
    int32_t memory
    double* control             # (CONTROL), zero at the start
    double* gram                # (MAX_MEMORY, MAX_MEMORY) of the dg
    double* v                   # (m) of the evaluation before
    double* g                   # (m)
    double* dv                  # (memory, m) differences, a ring
    double* dg                  # (memory, m)


cdef inline int32_t least_squares(int32_t n, int32_t head, int32_t memory, const double* gram, const double* rhs,
                                  double* gamma) noexcept nogil:
    """gamma (memory), by slot, of the normal equations over the n newest differences; how many took part.

    Cholesky, newest first: a column whose pivot is below 1e-12 of its square says nothing new and is left out.
    """
    cdef double l[MAX_MEMORY * MAX_MEMORY]
    cdef double y[MAX_MEMORY]
    cdef int32_t slot[MAX_MEMORY]
    cdef int32_t i, j, k, t, used = 0
    cdef double x, a
    for i in range(memory):
        gamma[i] = 0.0
    for i in range(n):
        k = (head - 1 - i + 2 * memory) % memory
        a = gram[MAX_MEMORY * k + k]
        x = a
        for j in range(used):
            l[MAX_MEMORY * used + j] = gram[MAX_MEMORY * k + slot[j]]
        for j in range(used):
            for t in range(j):
                l[MAX_MEMORY * used + j] -= l[MAX_MEMORY * used + t] * l[MAX_MEMORY * j + t]
            l[MAX_MEMORY * used + j] /= l[MAX_MEMORY * j + j]
            x -= l[MAX_MEMORY * used + j] * l[MAX_MEMORY * used + j]
        if not x > 1e-12 * a:
            continue
        l[MAX_MEMORY * used + used] = sqrt(x)
        slot[used] = k
        used += 1
    for i in range(used):
        x = rhs[slot[i]]
        for j in range(i):
            x -= l[MAX_MEMORY * i + j] * y[j]
        y[i] = x / l[MAX_MEMORY * i + i]
    i = used - 1
    while i >= 0:
        x = y[i]
        for j in range(i + 1, used):
            x -= l[MAX_MEMORY * j + i] * y[j]
        y[i] = x / l[MAX_MEMORY * i + i]
        gamma[slot[i]] = y[i]
        i -= 1
    return used


cdef inline int32_t mix(const mixing_t* c, double* u, double most) noexcept nogil:
    """u holds the last v on entry, (1) on return; 1 where something was mixed. `most`: sum of |gamma| up to which it is."""
    cdef int32_t kept = <int32_t>c.control[KEPT], head = <int32_t>c.control[HEAD], i, j, k
    cdef double rhs[MAX_MEMORY]
    cdef double gamma[MAX_MEMORY]
    cdef double a, weight = 0.0
    cdef const double* x
    if kept == 0 or c.control[REST] > 0.0:
        return 0
    for k in range(kept):
        j = (head - 1 - k + 2 * c.memory) % c.memory
        rhs[j] = dot(c.dg + j * c.m, c.g, c.m)
    if least_squares(kept, head, c.memory, c.gram, rhs, gamma) == 0:
        return 0
    for j in range(c.memory):
        weight += fabs(gamma[j])
    if weight > most:
        forget(c)
        return 0
    for j in range(c.memory):
        a = gamma[j]
        x = c.dv + j * c.m
        if a != 0.0:
            for i in range(c.m):
                u[i] -= a * x[i]
    return 1


cdef inline void forget(const mixing_t* c) noexcept nogil:
    c.control[KEPT] = 0.0
    c.control[FRESH] = 0.0


cdef inline int32_t take(const mixing_t* c, int32_t mixed, double* v, const double* g) noexcept nogil:
    """Remember the evaluation (v, g) of a u; 0 where that u is undone, v then being the one before."""
    cdef int32_t kept = <int32_t>c.control[KEPT], head = <int32_t>c.control[HEAD], i, j, k
    cdef double size = sqrt(dot(g, g, c.m)), x
    cdef double* dv
    cdef double* dg
    if mixed and not size <= 2.0 * c.control[LAST]:
        for i in range(c.m):
            v[i] = c.v[i]
        forget(c)
        c.control[UNDONE] += 1.0
        return 0
    c.control[LAST] = size
    if c.control[LEAST] == 0.0 or size < c.control[LEAST]:
        c.control[LEAST] = size
    if c.control[REST] > 0.0:
        c.control[REST] -= 1.0
    else:
        c.control[STEPS] += 1.0
        if c.control[STEPS] >= WINDOW:
            if c.control[AGO] > 0.0 and c.control[LEAST] > 0.9 * c.control[AGO]:
                c.control[REST] = WINDOW
                forget(c)
                kept = 0
            c.control[AGO] = c.control[LEAST]
            c.control[STEPS] = 0.0
    if c.control[FRESH] > 0.0 and c.control[REST] <= 1.0 and c.memory > 0:
        dv = c.dv + head * c.m
        dg = c.dg + head * c.m
        for i in range(c.m):
            dv[i] = v[i] - c.v[i]
            dg[i] = g[i] - c.g[i]
        if kept < c.memory:
            kept += 1
        for k in range(kept):
            j = (head - k + 2 * c.memory) % c.memory
            x = dot(c.dg + j * c.m, dg, c.m)
            c.gram[MAX_MEMORY * head + j] = x
            c.gram[MAX_MEMORY * j + head] = x
        c.control[KEPT] = kept
        c.control[HEAD] = (head + 1) % c.memory
    for i in range(c.m):
        c.v[i] = v[i]
        c.g[i] = g[i]
    c.control[FRESH] = 1.0
    return 1
