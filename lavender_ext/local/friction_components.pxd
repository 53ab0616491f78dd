"""Solution of one contact with any friction components and the other blocks fixed: with z = sqrt(d) lam, y = z - (H z - g),

    z = Pi(y),   (I - P + P H) dz = -(z - Pi(y)),   P in the derivative of Pi                    (1)

by Newton's method (Coulomb: Alart and Curnier 1991), each step halved while |z - Pi(y)| does not fall.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.contact_map cimport contact_map
from lavender_ext.core.block_types cimport friction_components_t
from lavender_ext.local.small cimport FAILED, MAX_ROWS, OPEN, STICK, eliminate


cdef enum:
    MAX_NEWTON_STEPS = 40
    MAX_STEP_HALVINGS = 6       # After so many halvings the step is used even if the residual does not fall.
    # Newton's method stops after this many steps that reduce the residual by less than 10 %; all 40 steps cost as much as a
    # hundred updates of the block.
    MAX_SLOW_STEPS = 4


cdef inline double natural_residual(int32_t law, int32_t n, const double* H, const double* g, const friction_components_t* part,
                           const double* z, double* out, double* p, double* size) noexcept nogil:
    """Return |z - Pi(y)| with Pi(y) in `out` and P in `p`; `size` is the largest sum of absolute terms of a row."""
    cdef double y[MAX_ROWS]
    cdef double total = 0.0, s, x
    cdef int32_t i, j
    size[0] = 0.0
    for i in range(n):
        s = -g[i]
        x = fabs(g[i]) + fabs(z[i])
        for j in range(n):
            s += H[n * i + j] * z[j]
            x += fabs(H[n * i + j] * z[j])
        y[i] = z[i] - s
        size[0] = x if x > size[0] else size[0]
    contact_map(law, part, y, out, p)
    for i in range(n):
        total += (z[i] - out[i]) * (z[i] - out[i])
    return sqrt(total)


cdef inline int32_t solve_contact_newton(int32_t law, int32_t n, const double* W, const double* q, const double* d,
                                     const friction_components_t* part, double* lam) noexcept nogil:
    """Solve for lam (n), starting from the present lam; FAILED, lam unchanged, if Newton's method does not converge."""
    cdef double H[MAX_ROWS * MAX_ROWS]
    cdef double P[MAX_ROWS * MAX_ROWS]
    cdef double A[MAX_ROWS * MAX_ROWS]
    cdef double g[MAX_ROWS]
    cdef double z[MAX_ROWS]
    cdef double f[MAX_ROWS]
    cdef double to[MAX_ROWS]
    cdef double out[MAX_ROWS]
    cdef double root[MAX_ROWS]
    cdef friction_components_t a = part[0]              # friction coefficients in the metric of d
    cdef double now, next_, size, x
    cdef int32_t i, j, k, _step, _halving, start, slow
    if not W[0] > 0.0:
        return FAILED
    for i in range(n):
        root[i] = sqrt(d[i])
    for i in range(n):
        g[i] = -q[i] / root[i]
        for j in range(n):
            H[n * i + j] = W[n * i + j] / (root[i] * root[j])
    for i in range(a.n):
        a.friction_coefficient[i] = a.friction_coefficient[i] * root[a.first[i]] / root[0]
    for start in range(2):                              # from the present impulse, then from the sticking solution
        for i in range(n):
            z[i] = root[i] * lam[i] if start == 0 else g[i]
        if start == 1:
            for i in range(n * n):
                A[i] = H[i]
            eliminate(n, A, z)
        slow = 0
        now = natural_residual(law, n, H, g, &a, z, out, P, &size)
        for _step in range(MAX_NEWTON_STEPS):
            if not now > 1e-15 * size:
                break
            for i in range(n):
                f[i] = out[i] - z[i]
                for j in range(n):
                    x = (1.0 if i == j else 0.0) - P[n * i + j]
                    for k in range(n):
                        x += P[n * i + k] * H[n * k + j]
                    A[n * i + j] = x
            eliminate(n, A, f)
            x = 1.0
            for _halving in range(MAX_STEP_HALVINGS):
                for i in range(n):
                    to[i] = z[i] + x * f[i]
                next_ = natural_residual(law, n, H, g, &a, to, out, P, &size)
                if next_ < now:
                    break
                x = 0.5 * x
            if not next_ < now and now <= 1e-13 * size:
                natural_residual(law, n, H, g, &a, z, out, P, &size)
                break
            slow += not next_ < 0.9 * now
            if slow > MAX_SLOW_STEPS:
                break
            for i in range(n):
                z[i] = to[i]
            now = next_
        if now <= 1e-13 * size:
            for i in range(n):
                lam[i] = out[i] / root[i]
            return STICK if lam[0] > 0.0 else OPEN
    return FAILED
