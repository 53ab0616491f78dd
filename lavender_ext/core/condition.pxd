"""Estimates and bounds of the condition of M from its factor (`generalized.pxd`)."""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.dot cimport dot
from lavender_ext.core.generalized cimport solve_mass_matrix
from lavender_ext.core.view cimport generalized_t


cdef inline double estimate_condition(const generalized_t* g, double* x) noexcept nogil:
    """Estimate |H^-1| of H = M scaled to a unit diagonal, from two solves with the factor of M.

    The result is a lower bound of |H^-1|, in general within a factor of 3, and at least 1. The first solve has a right-hand
    side of +-1 chosen to make L^-T times it large (Cline, Moler, Stewart and Wilkinson 1979). The second measures by how much
    H^-1 stretches the result of the first. x (2 n) is scratch.
    """
    cdef int32_t i, q, n = g.n
    cdef double* s = x + n                              # S^-1
    cdef double first, second
    for i in range(n):
        s[i] = sqrt(g.mval[g.mptr[i + 1] - 1])
        x[i] = 0.0
    for i in range(n - 1, -1, -1):                      # L^T z = S^-1 (+-1)
        x[i] += s[i] if x[i] >= 0.0 else -s[i]
        for q in range(g.lptr[i], g.lptr[i + 1]):
            x[g.lidx[q]] -= g.lval[q] * x[i]
    for i in range(n):                                  # D, then L x = z
        x[i] *= g.inv_pivot[i]
        for q in range(g.lptr[i], g.lptr[i + 1]):
            x[i] -= g.lval[q] * x[g.lidx[q]]
    for i in range(n):
        x[i] *= s[i]
    first = sqrt(dot(x, x, n))
    if not 0.0 < first < 1.0 / 0.0:
        return 1.0 / 0.0 if n else 1.0
    for i in range(n):
        x[i] = s[i] * (x[i] / first)
    solve_mass_matrix(g, x)
    for i in range(n):
        x[i] *= s[i]
    second = sqrt(dot(x, x, n))
    first = first / sqrt(<double>n)
    if not second > first:
        second = first
    return second if second > 1.0 else 1.0


cdef inline double get_condition(const generalized_t* g, double* x) noexcept nogil:
    """Return the estimate stored with the factor, or a new one; x (2 n) is scratch."""
    return g.condition if g.condition > 0.0 else estimate_condition(g, x)
