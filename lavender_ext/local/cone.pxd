"""Exact solution of one contact under the cone law: w = W lam + q in K*, lam.w = 0.

The contact is open if q is in K*, and sticks as in local/coulomb.pxd (2). Instead of its (3), a sliding contact satisfies

    (W + beta J) lam = -q,   J = diag(-mu^2, 1, 1)
    v(beta) = -adj(W + beta J) q = det lam,  |v_t| = mu sign(det) v_n                             (1)

W is symmetric positive definite. W + beta J is positive definite for 0 <= beta < beta*, the positive root of
det(W + beta J). The sign of v_n at beta* determines on which side of beta* the root of (1) with lam_n > 0 lies.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport norm2
from lavender_ext.local.coulomb cimport opposes_friction
from lavender_ext.local.small cimport FAILED, OPEN, SLIP, STICK, safeguard_newton_step, is_slack_zero


cdef inline int32_t minimize_energy_on_cone_ray(const double* W, const double* q, double mu, double s0, double s1,
                                                double* lam) noexcept nogil:
    """Minimise the energy on the ray lam = l (1, mu s0, mu s1), l > 0; return FAILED if the result is not a solution.

    At the minimum lam.w = 0.
    """
    cdef double x0 = mu * s0, x1 = mu * s1
    cdef double n = (W[0] + (W[1] + W[3]) * x0 + (W[2] + W[6]) * x1 + W[4] * x0 * x0 + (W[5] + W[7]) * x0 * x1
                     + W[8] * x1 * x1)
    cdef double l = -(q[0] + q[1] * x0 + q[2] * x1) / n
    cdef double y[3]
    if not n > 0.0 or not 0.0 <= l < 1.0 / 0.0:
        return FAILED
    y[0] = l
    y[1] = l * x0
    y[2] = l * x1
    if not opposes_friction(W, q, s0, s1, y):
        return FAILED
    lam[0] = l
    lam[1] = y[1]
    lam[2] = y[2]
    return SLIP


cdef inline int32_t solve_cone_disk(const double* W, const double* q, double mu, double* lam) noexcept nogil:
    """Solve a contact under the cone law for lam (3) [N s]; return FAILED and leave lam unchanged if that fails."""
    cdef double m2 = mu * mu, d1, d2, beta, top, f, df, step, lo, hi, side, P, U, d0
    cdef double v0[3]
    cdef double v1[3]
    cdef double v2[3]
    cdef double v[3]
    cdef int32_t _iteration, k, done = 0
    if q[0] >= mu * norm2(q[1], q[2]):
        lam[0] = lam[1] = lam[2] = 0.0
        return OPEN
    if not W[0] > 0.0:
        return FAILED
    if mu == 0.0:
        lam[0] = -q[0] / W[0]
        lam[1] = lam[2] = 0.0
        return SLIP
    # v(beta) = v0 + beta v1 + beta^2 v2, det(W + beta J) = d0 + d1 beta + d2 beta^2 - mu^2 beta^3
    v0[0] = -((W[4] * W[8] - W[5] * W[7]) * q[0] + (W[2] * W[7] - W[1] * W[8]) * q[1]
              + (W[1] * W[5] - W[2] * W[4]) * q[2])
    v0[1] = -((W[5] * W[6] - W[3] * W[8]) * q[0] + (W[0] * W[8] - W[2] * W[6]) * q[1]
              + (W[2] * W[3] - W[0] * W[5]) * q[2])
    v0[2] = -((W[3] * W[7] - W[4] * W[6]) * q[0] + (W[1] * W[6] - W[0] * W[7]) * q[1]
              + (W[0] * W[4] - W[1] * W[3]) * q[2])
    v1[0] = -((W[4] + W[8]) * q[0] - W[1] * q[1] - W[2] * q[2])
    v1[1] = -(-W[3] * q[0] + (W[0] - m2 * W[8]) * q[1] + m2 * W[5] * q[2])
    v1[2] = -(-W[6] * q[0] + m2 * W[7] * q[1] + (W[0] - m2 * W[4]) * q[2])
    v2[0] = -q[0]
    v2[1] = m2 * q[1]
    v2[2] = m2 * q[2]
    d0 = (W[0] * (W[4] * W[8] - W[5] * W[7]) + W[1] * (W[5] * W[6] - W[3] * W[8]) + W[2] * (W[3] * W[7] - W[4] * W[6]))
    d1 = W[0] * (W[4] + W[8]) - W[1] * W[3] - W[2] * W[6] - m2 * (W[4] * W[8] - W[5] * W[7])
    d2 = W[0] - m2 * (W[4] + W[8])
    if d0 > 0.0 and v0[0] >= 0.0 and norm2(v0[1], v0[2]) <= mu * v0[0]:
        for k in range(3):
            v[k] = v0[k] / d0
        if is_slack_zero(3, W, q, v):
            for k in range(3):
                lam[k] = v[k]
            return STICK
        return FAILED
    # beta*: Newton's method from the right of all roots converges to the largest.
    top = W[0] / m2
    for _iteration in range(60):
        f = d0 + top * (d1 + top * (d2 - m2 * top))
        df = d1 + top * (2.0 * d2 - 3.0 * m2 * top)
        if not f < 0.0 or not df < 0.0:
            break
        step = f / df
        top -= step
        if step <= 1e-15 * top:
            break
    if not top > 0.0:
        return FAILED
    side = 1.0 if v0[0] + top * (v1[0] + top * v2[0]) >= 0.0 else -1.0
    # side 1: |v_t| - mu v_n falls from positive at 0 to negative at beta*; side -1: |v_t| + mu v_n rises
    # from negative at beta* to positive at infinity.
    lo = 0.0 if side > 0.0 else top
    hi = top if side > 0.0 else -1.0
    beta = 0.5 * top if side > 0.0 else 2.0 * top
    for _iteration in range(200):
        for k in range(3):
            v[k] = v0[k] + beta * (v1[k] + beta * v2[k])
        U = norm2(v[1], v[2])
        if done or not U > 0.0:
            break
        P = side * mu * v[0]
        f = U - P
        if f * side > 0.0:
            lo = beta
        else:
            hi = beta
        df = ((v[1] * (v1[1] + 2.0 * beta * v2[1]) + v[2] * (v1[2] + 2.0 * beta * v2[2])) / U
              - side * mu * (v1[0] + 2.0 * beta * v2[0]))
        step = f / df
        done = fabs(f) <= 1e-8 * U and fabs(step) <= 1e-7 * beta
        beta = safeguard_newton_step(beta, step, lo, hi, &done)
    if not U > 0.0 or not done:
        return FAILED
    U = side / U
    return minimize_energy_on_cone_ray(W, q, mu, v[1] * U, v[2] * U, lam)
