"""Exact solution of one contact under Coulomb's law with a separate bound on each tangent: w = W lam + q.

With a, h, S, r of local/coulomb.pxd, lam_n = a - h.t and w_t = S t + r after eliminating w_n = 0:

    open    q_n >= 0: lam = 0                                                                     (1)
    stick   S t = -r, |t_i| <= c_i lam_n on both tangents                                         (2)
    slip    t_i = s_i c_i lam_n, s_i = +-1, s_i w_i <= 0 on one or both tangents, the other as (2)  (3)

There are nine cases, each a system of at most three rows. The case that the solution of (2) violates is tried first.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.local.small cimport FAILED, OPEN, SLIP, STICK


cdef inline bint opposes_sliding(double s, double x, double y, double r, double w) noexcept nogil:
    """Return whether s w <= 0 within rounding, w = x + y + r; at equality both cases have the same solution."""
    return s * w <= 1e-14 * (fabs(x) + fabs(y) + fabs(r))


cdef inline bint slip_box(const double* g, double a, double h0, double h1, double r0, double r1, double c0, double c1,
                          double s0, double s1, double* lam) noexcept nogil:
    """Solve (3) for signs s (0: the tangent sticks), with g from `prepare3`; return False, lam unchanged, if it is violated."""
    cdef double u = s0 * c0, v = s1 * c1, n, x, y, det = 1.0 + h0 * u + h1 * v, b = a
    if s1 == 0.0:
        if not g[13] > 0.0:
            return False
        det -= h1 * g[12] / g[13] * u
        b += h1 * r1 / g[13]
    elif s0 == 0.0:
        if not g[10] > 0.0:
            return False
        det -= h0 * g[11] / g[10] * v
        b += h0 * r0 / g[10]
    if not det > 0.0:
        return False
    n = b / det
    if not 0.0 <= n < 1.0 / 0.0:
        return False
    x = u * n if s0 != 0.0 else -(r0 + g[11] * (v * n)) / g[10]
    y = v * n if s1 != 0.0 else -(r1 + g[12] * (u * n)) / g[13]
    if s0 == 0.0:
        if fabs(x) > c0 * n:
            return False
    elif not opposes_sliding(s0, g[10] * x, g[11] * y, r0, g[10] * x + g[11] * y + r0):
        return False
    if s1 == 0.0:
        if fabs(y) > c1 * n:
            return False
    elif not opposes_sliding(s1, g[12] * x, g[13] * y, r1, g[12] * x + g[13] * y + r1):
        return False
    lam[0] = n
    lam[1] = x
    lam[2] = y
    return True


cdef inline double side(double x, double bound) noexcept nogil:
    """Return 1 above `bound`, -1 below -`bound`, otherwise 0."""
    return 1.0 if x > bound else (-1.0 if x < -bound else 0.0)


cdef inline int32_t box3_from(const double* g, const double* w, double c0, double c1, double* lam) noexcept nogil:
    """Solve (1)-(3) for lam (3) from the slack w (3) of the present lam, with g from `prepare3`; FAILED keeps lam."""
    cdef double q0, q1, q2, n, x, y, a, h0, h1, r0, r1, s0, s1, first0, first1
    cdef int32_t i
    # open
    q0 = w[0] - (g[0] * lam[0] + g[1] * lam[1] + g[2] * lam[2])
    if q0 >= 0.0:
        lam[0] = 0.0
        lam[1] = 0.0
        lam[2] = 0.0
        return OPEN
    if not g[9] > 0.0 or not g[14] > 0.0 or not q0 < 0.0:
        return FAILED
    # sticking: w = 0 at lam - W^-1 w
    n = lam[0] - (g[16] * w[0] + g[17] * w[1] + g[18] * w[2])
    x = lam[1] - (g[19] * w[0] + g[20] * w[1] + g[21] * w[2])
    y = lam[2] - (g[22] * w[0] + g[23] * w[1] + g[24] * w[2])
    if n >= 0.0:
        first0 = side(x, c0 * n)
        first1 = side(y, c1 * n)
        if first0 == 0.0 and first1 == 0.0:
            lam[0] = n
            lam[1] = x
            lam[2] = y
            return STICK
    else:
        first0 = side(x, 0.0)
        first1 = side(y, 0.0)
    # sliding: the most likely case, then all others
    q1 = w[1] - (g[3] * lam[0] + g[4] * lam[1] + g[5] * lam[2])
    q2 = w[2] - (g[6] * lam[0] + g[7] * lam[1] + g[8] * lam[2])
    a = -q0 * g[9]
    h0 = g[1] * g[9]
    h1 = g[2] * g[9]
    r0 = q1 + g[3] * a
    r1 = q2 + g[6] * a
    if (first0 != 0.0 or first1 != 0.0) and slip_box(g, a, h0, h1, r0, r1, c0, c1, first0, first1, lam):
        return SLIP
    for i in range(9):
        s0 = i // 3 - 1
        s1 = i % 3 - 1
        if i != 4 and (s0 != first0 or s1 != first1) and slip_box(g, a, h0, h1, r0, r1, c0, c1, s0, s1, lam):
            return SLIP
    return FAILED
