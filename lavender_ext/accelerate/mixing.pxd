"""Anderson mixing of a fixed-point iteration v = T(u), g = v - u, over the last `memory` evaluations.

    u <- v - sum_i gamma_i (v_i+1 - v_i),    gamma = argmin |g - sum_i gamma_i (g_i+1 - g_i)|         (1)

Safeguards: if a mixed u increases |g| by more than a factor of 2, it is undone and the memory is cleared. If sum |gamma_i| is
above a limit of the caller, nothing is mixed and the memory is cleared (bounded coefficients: Toth, Kelley, Convergence
analysis for Anderson acceleration, 2015). If WINDOW evaluations do not reduce the lowest |g| below 0.9 of its previous value,
the same number of evaluations without mixing follows. All sums have a fixed order.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.dot cimport dot


cdef enum:
    MAX_MEMORY = 16
    WINDOW = 200

cdef enum:                      # indices in `control`
    LAST_NORM = 0               # |g| of the last evaluation
    N_DIFFERENCES = 1           # number of differences in memory
    NEXT_SLOT = 2               # index of the difference that the next one replaces, in the ring buffers
    HAS_PREVIOUS = 3            # 1 if v and g of the previous evaluation are stored
    N_UNMIXED = 4               # number of following evaluations without mixing
    LOWEST_NORM = 5             # lowest |g| so far, 0 before any
    WINDOW_NORM = 6             # lowest |g| at the beginning of the window
    WINDOW_STEPS = 7            # evaluations since the beginning of the window
    UNDONE = 8                  # number of mixed u that were undone
    CONTROL = 9                 # length of `control`


cdef struct mixing_t:
    int32_t m
    int32_t memory
    double* control             # (CONTROL), zero at the start
    double* gram                # (MAX_MEMORY, MAX_MEMORY) products of the dg
    double* v                   # (m) v = T(u) of the previous evaluation
    double* g                   # (m) g = v - u of the previous evaluation
    double* dv                  # (memory, m) differences of successive v, a ring buffer
    double* dg                  # (memory, m) differences of successive g


cdef inline int32_t solve_mixing_coefficients(int32_t n, int32_t head, int32_t memory, const double* gram, const double* rhs,
                                              double* gamma) noexcept nogil:
    """Solve the normal equations of (1) over the n newest differences; return the number of columns that were used.

    gamma (memory) receives the coefficient of each slot of the ring buffers. The method is Cholesky's with the newest
    difference first. A column with a pivot of at most 1e-12 of its square is linearly dependent and gets the coefficient 0.
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


cdef inline int32_t mix_anderson_iterates(const mixing_t* c, double* u, double max_weight) noexcept nogil:
    """Replace u (m), which holds the last v, by (1) and return 1, or return 0 if nothing is mixed.

    Nothing is mixed without differences in memory, after a window without progress, or if sum |gamma| exceeds max_weight.
    """
    cdef int32_t n_differences = <int32_t>c.control[N_DIFFERENCES], head = <int32_t>c.control[NEXT_SLOT], i, j, k
    cdef double rhs[MAX_MEMORY]
    cdef double gamma[MAX_MEMORY]
    cdef double a, weight = 0.0
    cdef const double* x
    if n_differences == 0 or c.control[N_UNMIXED] > 0.0:
        return 0
    for k in range(n_differences):
        j = (head - 1 - k + 2 * c.memory) % c.memory
        rhs[j] = dot(c.dg + j * c.m, c.g, c.m)
    if solve_mixing_coefficients(n_differences, head, c.memory, c.gram, rhs, gamma) == 0:
        return 0
    for j in range(c.memory):
        weight += fabs(gamma[j])
    if weight > max_weight:
        clear_mixing_memory(c)
        return 0
    for j in range(c.memory):
        a = gamma[j]
        x = c.dv + j * c.m
        if a != 0.0:
            for i in range(c.m):
                u[i] -= a * x[i]
    return 1


cdef inline void clear_mixing_memory(const mixing_t* c) noexcept nogil:
    """Forget all stored evaluations and differences."""
    c.control[N_DIFFERENCES] = c.control[HAS_PREVIOUS] = 0.0


cdef inline int32_t store_evaluation(const mixing_t* c, int32_t mixed, double* v, const double* g) noexcept nogil:
    """Store the evaluation (v, g) of u and return 1; return 0 if u is undone, with v replaced by the previous one."""
    cdef int32_t n_differences = <int32_t>c.control[N_DIFFERENCES], head = <int32_t>c.control[NEXT_SLOT], i, j, k
    cdef double size = sqrt(dot(g, g, c.m)), x
    cdef double* dv
    cdef double* dg
    if mixed and not size <= 2.0 * c.control[LAST_NORM]:
        for i in range(c.m):
            v[i] = c.v[i]
        clear_mixing_memory(c)
        c.control[UNDONE] += 1.0
        return 0
    c.control[LAST_NORM] = size
    if c.control[LOWEST_NORM] == 0.0 or size < c.control[LOWEST_NORM]:
        c.control[LOWEST_NORM] = size
    if c.control[N_UNMIXED] > 0.0:
        c.control[N_UNMIXED] -= 1.0
    else:
        c.control[WINDOW_STEPS] += 1.0
        if c.control[WINDOW_STEPS] >= WINDOW:
            if c.control[WINDOW_NORM] > 0.0 and c.control[LOWEST_NORM] > 0.9 * c.control[WINDOW_NORM]:
                c.control[N_UNMIXED] = WINDOW
                clear_mixing_memory(c)
                n_differences = 0
            c.control[WINDOW_NORM] = c.control[LOWEST_NORM]
            c.control[WINDOW_STEPS] = 0.0
    if c.control[HAS_PREVIOUS] > 0.0 and c.control[N_UNMIXED] <= 1.0 and c.memory > 0:
        dv = c.dv + head * c.m
        dg = c.dg + head * c.m
        for i in range(c.m):
            dv[i] = v[i] - c.v[i]
            dg[i] = g[i] - c.g[i]
        if n_differences < c.memory:
            n_differences += 1
        for k in range(n_differences):
            j = (head - k + 2 * c.memory) % c.memory
            x = dot(c.dg + j * c.m, dg, c.m)
            c.gram[MAX_MEMORY * head + j] = x
            c.gram[MAX_MEMORY * j + head] = x
        c.control[N_DIFFERENCES] = n_differences
        c.control[NEXT_SLOT] = (head + 1) % c.memory
    for i in range(c.m):
        c.v[i] = v[i]
        c.g[i] = g[i]
    c.control[HAS_PREVIOUS] = 1.0
    return 1
