"""Interior point steps, part by part (Mehrotra 1992; Nesterov and Todd 1997 for the cones; Vandenberghe 2010, 5 and 7).

u dual to G z, G z and u inside every cone, W = G^T T^-2 G with T u = T^-1 G z = v the scaling,

    affine     (H + W) dz = -(H z - g),                    du = -u - T^-2 G dz                    (3)
    combined   c = v o v + (T^-1 G dz_a) o (T du_a) - sigma mu e,   sigma = (mu_a / mu)^3
               (H + W) dz = -(H z - g - G^T u) - G^T T^-1 (v \\ c),  du = -T^-1 (v \\ c) - T^-2 G dz  (4)
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.newton.cones cimport (KEPT_V, cone_affine, cone_combined, cone_gap, cone_length, cone_parts, cone_size,
                                        cone_step, dual_head, gather, is_high, is_low, kept, load_dual, on_normal,
                                        row_limit, scatter, slack_dual, store_dual)
from lavender_ext.newton.elements cimport elements_t, is_row


cdef inline double ipm_start(const elements_t* e, const double* hz, double dual, double* z, double* u1,
                                 double* u2) noexcept nogil:
    """Puts z and u inside their cones, starting from z with (H + W) z = g for a small W; returns the degree (number of cones).

    Vandenberghe 2010, section 7.3: both are shifted along the cones' axes, by one amount each; u's beyond the
    worst violation is `dual` times z's, because most rows carry load in the end.
    """
    cdef int32_t i, j, g, n
    cdef double worst_z = -1.0 / 0.0, worst_u = -1.0 / 0.0, size = 0.0, x, degree = 0.0, width
    cdef double c[4]
    for j in range(e.m):
        size += z[j] * z[j] + (hz[j] - e.g[j]) * (hz[j] - e.g[j])
    size = sqrt(size / (e.m if e.m > 0 else 1))
    if not size > 0.0:
        size = 1.0
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            u1[j] = 0.0
            u2[j] = 0.0
            if is_low(e, j) and is_high(e, j):
                width = e.upper[j] - e.lower[j]
                x = 0.1 * width
                if z[j] < e.lower[j] + x:
                    z[j] = e.lower[j] + x
                if z[j] > e.upper[j] - x:
                    z[j] = e.upper[j] - x
                x = hz[j] - e.g[j]
                u1[j] = dual * size + (x if x > 0.0 else 0.0)
                u2[j] = dual * size + (-x if x < 0.0 else 0.0)
                degree += 2.0
            elif is_low(e, j):
                x = e.lower[j] - z[j]
                worst_z = x if x > worst_z else worst_z
                u1[j] = hz[j] - e.g[j]
                worst_u = -u1[j] if -u1[j] > worst_u else worst_u
                degree += 1.0
            elif is_high(e, j):
                x = z[j] - e.upper[j]
                worst_z = x if x > worst_z else worst_z
                u2[j] = e.g[j] - hz[j]
                worst_u = -u2[j] if -u2[j] > worst_u else worst_u
                degree += 1.0
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            gather(e, i, g, z, c)
            x = -cone_gap(c, n) / on_normal(e.reach[g])
            worst_z = x if x > worst_z else worst_z
            slack_dual(e, i, g, hz, c)
            x = -cone_gap(c, n)
            worst_u = x if x > worst_u else worst_u
            store_dual(e, i, g, c, u1, u2)
            degree += 1.0
    worst_z = worst_z + size if worst_z > -1e-8 * size else 0.0
    worst_u = worst_u + dual * size if worst_u > -1e-8 * size else 0.0
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if is_low(e, j) and not is_high(e, j):
                z[j] += worst_z
                u1[j] += worst_u
            elif is_high(e, j) and not is_low(e, j):
                z[j] -= worst_z
                u2[j] += worst_u
            continue
        z[j] += worst_z
        for g in range(e.part[i], e.part[i + 1]):
            dual_head(e, i, g, u1, u2)[0] += worst_u
    return degree


cdef inline bint is_soft(const elements_t* e, int32_t i) noexcept nogil:
    """Has a row of element i any compliance?"""
    cdef int32_t j
    for j in range(e.ptr[i], e.ptr[i + 1]):
        if e.theta[j] != 0.0:
            return True
    return False


cdef inline void soften(const elements_t* e, int32_t i, double* v, double* bt) noexcept nogil:
    """V and B^T of the same element with its theta: B <- B L^-T, L L^T = I + B^T theta B, for the V that B has then."""
    cdef int32_t j = e.ptr[i], nr = e.ptr[i + 1] - j, k, l, t
    cdef double x
    cdef double low[36]
    for k in range(nr):
        for l in range(k + 1):
            x = 1.0 if k == l else 0.0
            for t in range(nr):
                x += bt[k * nr + t] * e.theta[j + t] * bt[l * nr + t]
            for t in range(l):
                x -= low[k * nr + t] * low[l * nr + t]
            low[k * nr + l] = sqrt(x) if k == l else x / low[l * nr + l]
    for k in range(nr):
        for l in range(nr):
            x = bt[k * nr + l]
            for t in range(k):
                x -= low[k * nr + t] * bt[t * nr + l]
            bt[k * nr + l] = x / low[k * nr + k]
    for k in range(nr):
        for l in range(nr):
            x = 0.0
            for t in range(nr):
                x += bt[t * nr + k] * bt[t * nr + l]
            v[k * nr + l] = x


cdef inline void ipm_scale(const elements_t* e, const double* z, const double* u1, const double* u2, double delta,
                               double* v, double* bt, double* gap) noexcept nogil:
    """V = (W + theta + delta)^-1 of (3) for each element, B^T with V = B B^T, and the gap G z . u.

    bt may be NULL where no element is a contact.
    """
    cdef int32_t i, j, k, l, n, nr, q, g, first
    cdef bint more
    cdef double x, y, r, total = 0.0
    cdef double s[4]
    cdef double u[4]
    cdef double h[4]
    cdef double c[4]
    cdef double root[4]
    cdef double a[6]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if is_row(e, i):
            x = e.theta[j] + delta
            if is_low(e, j):
                x += u1[j] / (z[j] - e.lower[j])
                total += u1[j] * (z[j] - e.lower[j])
            if is_high(e, j):
                x += u2[j] / (e.upper[j] - z[j])
                total += u2[j] * (e.upper[j] - z[j])
            v[q] = 1.0 / x
            if bt != NULL:
                bt[q] = sqrt(v[q])
            continue
        for k in range(nr * nr):
            v[q + k] = bt[q + k] = 0.0
        x = 0.0
        more = False
        a[0] = 1.0
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            # Cones share the normal: their parallel sum there, each of the others follows it.
            gather(e, i, g, z, s)
            load_dual(e, i, g, u1, u2, u)
            y = 0.0 if more else total
            for k in range(n):
                y += s[k] * u[k]
            total = total + y if more else y
            y = cone_parts(s, u, n, e.reach[g], delta, kept(e, g), h, c, root)
            x = x * (y / (x + y)) if more else y
            more = True
            first = e.first[g] - j
            for k in range(n - 1):
                a[first + k] = h[k]
                for l in range(n - 1):
                    v[q + (first + k) * nr + first + l] = c[k * (n - 1) + l]
                    bt[q + (first + k) * nr + first + l] = root[k * (n - 1) + l]
        for k in range(nr):
            for l in range(nr):
                v[q + k * nr + l] += x * a[k] * a[l]
        r = sqrt(x)
        for k in range(nr):
            bt[q + k] = r * a[k]
        if is_soft(e, i):
            soften(e, i, v + q, bt + q)
    gap[0] = total


cdef inline double ipm_affine(const elements_t* e, const double* z, const double* u1, const double* u2,
                                  const double* dz, double* gap) noexcept nogil:
    """Largest step (at most 1) of the affine direction, and the gap G z . u after it."""
    cdef int32_t i, j, k, g, n
    cdef double best = 1.0, a, b, x, t00 = 0.0, t01 = 0.0, t11 = 0.0
    cdef double y[4]
    cdef double back[4]
    cdef const double *v
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if is_low(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * dz[j]
                best = row_limit(a, dz[j], best)
                best = row_limit(u1[j], x, best)
                t00 += a * u1[j]
                t01 += a * x + u1[j] * dz[j]
                t11 += x * dz[j]
            if is_high(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * dz[j]
                best = row_limit(a, -dz[j], best)
                best = row_limit(u2[j], x, best)
                t00 += a * u2[j]
                t01 += a * x - u2[j] * dz[j]
                t11 -= x * dz[j]
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            v = kept(e, g) + KEPT_V
            if n == 3:
                cone_affine(e, i, g, dz, 3, y, back)
                a = cone_step(v, y, 3)
                b = cone_step(v, back, 3)
            else:
                cone_affine(e, i, g, dz, n, y, back)
                a = cone_step(v, y, n)
                b = cone_step(v, back, n)
            best = a if a < best else best
            best = b if b < best else best
            for k in range(n):
                t00 += v[k] * v[k]
                t01 -= v[k] * v[k]
                t11 += y[k] * back[k]
    gap[0] = t00 + best * (t01 + best * t11)
    return best


cdef inline void ipm_rhs(const elements_t* e, const double* z, const double* u1, const double* u2, const double* hz,
                             const double* da, double sigma_mu, double* rhs) noexcept nogil:
    """Right-hand side of (4)."""
    cdef int32_t i, j, k, g, n
    cdef double a, x
    cdef double u[4]
    cdef double t[4]
    for i in range(e.n):
        for j in range(e.ptr[i], e.ptr[i + 1]):
            rhs[j] = -(hz[j] - e.g[j])
        j = e.ptr[i]
        if is_row(e, i):
            # -(H z - g - u1 + u2) - c1/s1 + c2/s2, c = s u + ds du - sigma mu: the u cancel
            if is_low(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * da[j]
                rhs[j] -= (da[j] * x - sigma_mu) / a
            if is_high(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * da[j]
                rhs[j] += (-da[j] * x - sigma_mu) / a
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            load_dual(e, i, g, u1, u2, u)
            if n == 3:
                cone_combined(e, i, g, da, sigma_mu, 3, t)
            else:
                cone_combined(e, i, g, da, sigma_mu, n, t)
            for k in range(n):
                t[k] = u[k] - t[k]
            scatter(e, i, g, t, rhs)


cdef inline double ipm_update(const elements_t* e, double* z, double* u1, double* u2, const double* dz,
                                  const double* da, double sigma_mu, double damping, double* du1, double* du2) noexcept nogil:
    """Takes the combined step of the last `ipm_rhs` in place; returns its length. du1, du2 (m) are scratch."""
    cdef int32_t i, j, k, g, n
    cdef double best = 1.0 / damping, a, x
    cdef double du[4]
    cdef double u[4]
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if is_low(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * da[j]
                x = -u1[j] - (da[j] * x - sigma_mu) / a - u1[j] / a * dz[j]
                best = row_limit(a, dz[j], best)
                best = row_limit(u1[j], x, best)
                du1[j] = x
            if is_high(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * da[j]
                x = -u2[j] - (-da[j] * x - sigma_mu) / a + u2[j] / a * dz[j]
                best = row_limit(a, -dz[j], best)
                best = row_limit(u2[j], x, best)
                du2[j] = x
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            if n == 3:
                best = cone_length(e, i, g, dz, best, 3, du)
            else:
                best = cone_length(e, i, g, dz, best, n, du)
            store_dual(e, i, g, du, du1, du2)
    best = best * damping
    for j in range(e.m):
        z[j] += best * dz[j]
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if is_low(e, j):
                u1[j] += best * du1[j]
            if is_high(e, j):
                u2[j] += best * du2[j]
            continue
        for g in range(e.part[i], e.part[i + 1]):
            load_dual(e, i, g, u1, u2, du)
            load_dual(e, i, g, du1, du2, u)
            for k in range(cone_size(e, g)):
                du[k] += best * u[k]
            store_dual(e, i, g, du, u1, u2)
    return best
