"""Helpers of the exact block solvers: dense elimination, and states of contacts.

W is the diagonal block of A, 1x1 to 8x8, not necessarily symmetric; w = W lam + q.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t


cdef enum:
    OPEN = 0
    STICK = 1
    SLIP = 2
    FAILED = -1

cdef enum:
    MAX_ROWS = 8                # Blocks of more rows are not solved exactly.


cdef inline bint solve_three(const double* a, double* x) noexcept nogil:
    """Overwrite x (3) with a^-1 x by cofactors; return False, without a change, if a is nearly singular."""
    cdef double c0 = a[4] * a[8] - a[5] * a[7], c1 = a[5] * a[6] - a[3] * a[8], c2 = a[3] * a[7] - a[4] * a[6]
    cdef double x0 = x[0], x1 = x[1], x2 = x[2], det = a[0] * c0 + a[1] * c1 + a[2] * c2
    if not fabs(det) > 1e-6 * ((fabs(a[0]) + fabs(a[1]) + fabs(a[2])) * (fabs(a[3]) + fabs(a[4]) + fabs(a[5]))
                               * (fabs(a[6]) + fabs(a[7]) + fabs(a[8]))):
        return False
    det = 1.0 / det
    x[0] = (c0 * x0 + (a[2] * a[7] - a[1] * a[8]) * x1 + (a[1] * a[5] - a[2] * a[4]) * x2) * det
    x[1] = (c1 * x0 + (a[0] * a[8] - a[2] * a[6]) * x1 + (a[2] * a[3] - a[0] * a[5]) * x2) * det
    x[2] = (c2 * x0 + (a[1] * a[6] - a[0] * a[7]) * x1 + (a[0] * a[4] - a[1] * a[3]) * x2) * det
    return True


cdef inline int32_t solve_by_elimination(int32_t n, double* a, double* x) noexcept nogil:
    """Overwrite x (n) with a^-1 x by elimination with row exchanges; return the rank of a (n, n), which is overwritten.

    If columns of a depend linearly on others, their entries of x are 0.
    """
    cdef int32_t col[MAX_ROWS]
    cdef int32_t i, j, k, p, rank = 0
    cdef double big, f, size = 0.0
    for i in range(n * n):
        if fabs(a[i]) > size:
            size = fabs(a[i])
    for k in range(n):
        col[k] = -1
    for k in range(n):
        p = -1
        big = 1e-13 * size
        for i in range(rank, n):
            if fabs(a[n * i + k]) > big:
                big = fabs(a[n * i + k])
                p = i
        if p < 0:
            continue
        if p != rank:
            for j in range(n):
                f = a[n * p + j]
                a[n * p + j] = a[n * rank + j]
                a[n * rank + j] = f
            f = x[p]
            x[p] = x[rank]
            x[rank] = f
        f = 1.0 / a[n * rank + k]
        for j in range(k, n):
            a[n * rank + j] *= f
        x[rank] *= f
        for i in range(n):
            if i != rank and a[n * i + k] != 0.0:
                f = a[n * i + k]
                for j in range(k, n):
                    a[n * i + j] -= f * a[n * rank + j]
                x[i] -= f * x[rank]
        col[rank] = k
        rank += 1
    if rank == n:
        return n                                        # The rank is complete, so the entries of x are in their places.
    k = n - 1
    p = rank - 1
    while k >= 0:                                       # scatter to the columns, from the end to avoid overwriting
        if p >= 0 and col[p] == k:
            x[k] = x[p]
            p -= 1
        else:
            x[k] = 0.0
        k -= 1
    return rank
