"""The operations of an interior point step (Mehrotra 1992; Nesterov and Todd 1997 for cones; Vandenberghe 2010, 5 and 7).

u is dual to G z, both are inside every cone, and W = G^T T^-2 G with the scaling T u = T^-1 G z = v:

    affine     (H + W) dz = -(H z - g),                    du = -u - T^-2 G dz                    (3)
    combined   c = v o v + (T^-1 G dz_a) o (T du_a) - sigma mu e,   sigma = (mu_a / mu)^3
               (H + W) dz = -(H z - g - G^T u) - G^T T^-1 (v \\ c),  du = -T^-1 (v \\ c) - T^-2 G dz  (4)
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.newton.cones cimport (SCALING_V, add_cone_transpose, compute_combined_cone_rhs, cone_gap, cone_size,
                                        cone_weight_t, distance_to_boundary, dual_normal, has_lower_bound,
                                        has_upper_bound, limit_cone_step, limit_step_to_nonnegative, load_cone_variable,
                                        load_cone_dual, normal_factor, compute_cone_scaling, scaling_of,
                                        compute_affine_cone_step, store_cone_dual, tangent_factor)
from lavender_ext.newton.elements cimport elements_t, is_row


cdef struct interior_t:         # an interior point; vectors have m entries
    double* z
    double* u1                  # duals, stored as in cones.pxd
    double* u2
    double* hz                  # H z
    double* unbounded_z         # nearly the solution of H z = g, ignoring all bounds
    double delta                # proximal weight
    double derivative_fraction  # of De Saxce's term, in B of steps.pxd; 0: the convex law
    double degree               # number of cones and bounds
    double gap                  # gap G z . u / degree before the last step
    double min_gap              # smallest gap before the last step
    double max_gap              # largest gap so far
    double length               # length of the last step
    double energy               # |F| after the last step: the judge's energy error (convex law)
    double velocity             # the judge's velocity error after the last step


cdef inline double place_inside_cones(const elements_t* e, const interior_t* p, double dual) noexcept nogil:
    """Move z and u inside their cones, starting from z with (H + W) z = g for a small W; return the number of cones.

    All z are shifted along the axes of their cones by one amount, and all u by another (Vandenberghe 2010, section
    7.3). The shift of u beyond its worst violation is `dual` times that of z, since most rows carry load at the solution.
    """
    cdef int32_t i, j, k, q, g, n
    cdef const double* hz = p.hz
    cdef double* z = p.z
    cdef double* u1 = p.u1
    cdef double* u2 = p.u2
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
            if has_lower_bound(e, j) and has_upper_bound(e, j):
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
            elif has_lower_bound(e, j):
                x = e.lower[j] - z[j]
                worst_z = x if x > worst_z else worst_z
                u1[j] = hz[j] - e.g[j]
                worst_u = -u1[j] if -u1[j] > worst_u else worst_u
                degree += 1.0
            elif has_upper_bound(e, j):
                x = z[j] - e.upper[j]
                worst_z = x if x > worst_z else worst_z
                u2[j] = e.g[j] - hz[j]
                worst_u = -u2[j] if -u2[j] > worst_u else worst_u
                degree += 1.0
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            load_cone_variable(e, i, g, z, c)
            x = -cone_gap(c, n) / normal_factor(e.reach[g])
            worst_z = x if x > worst_z else worst_z
            q = e.first[g] - 1
            c[0] = (hz[j] - e.g[j]) / normal_factor(e.reach[g])     # u with G^T u = H z - g on a contact with one cone
            for k in range(1, n):
                c[k] = (hz[q + k] - e.g[q + k]) / tangent_factor(e.reach[g])
            x = -cone_gap(c, n)
            worst_u = x if x > worst_u else worst_u
            store_cone_dual(e, i, g, c, u1, u2)
            degree += 1.0
    worst_z = worst_z + size if worst_z > -1e-8 * size else 0.0
    worst_u = worst_u + dual * size if worst_u > -1e-8 * size else 0.0
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if has_lower_bound(e, j) and not has_upper_bound(e, j):
                z[j] += worst_z
                u1[j] += worst_u
            elif has_upper_bound(e, j) and not has_lower_bound(e, j):
                z[j] -= worst_z
                u2[j] += worst_u
            continue
        z[j] += worst_z
        for g in range(e.part[i], e.part[i + 1]):
            dual_normal(e, i, g, u1, u2)[0] += worst_u
    return degree


cdef inline void add_compliance(const elements_t* e, int32_t i, double* v, double* bt) noexcept nogil:
    """Add theta to the weights of element i: B <- B L^-T with L L^T = I + B^T theta B, and V = B B^T."""
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


cdef inline void compute_scaling(const elements_t* e, const interior_t* p, double* v, double* bt, double* gap) noexcept nogil:
    """Compute V = (W + theta + delta)^-1 of (3) for each element, B^T with V = B B^T, and the gap G z . u.

    bt may be NULL if no element is a contact.
    """
    cdef int32_t i, j, k, l, n, nr, q, g, first
    cdef const double* z = p.z
    cdef const double* u1 = p.u1
    cdef const double* u2 = p.u2
    cdef double delta = p.delta
    cdef bint more, is_soft
    cdef double x, y, r, total = 0.0
    cdef double s[4]
    cdef double u[4]
    cdef double a[6]
    cdef cone_weight_t cone
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if is_row(e, i):
            x = e.theta[j] + delta
            if has_lower_bound(e, j):
                x += u1[j] / (z[j] - e.lower[j])
                total += u1[j] * (z[j] - e.lower[j])
            if has_upper_bound(e, j):
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
            # The cones of a contact have its normal in common; their weights on it are added.
            load_cone_variable(e, i, g, z, s)
            load_cone_dual(e, i, g, u1, u2, u)
            y = 0.0 if more else total
            for k in range(n):
                y += s[k] * u[k]
            total = total + y if more else y
            compute_cone_scaling(s, u, n, e.reach[g], delta, scaling_of(e, g), &cone)
            x = x * (cone.x / (x + cone.x)) if more else cone.x
            more = True
            first = e.first[g] - j
            for k in range(n - 1):
                a[first + k] = cone.h[k]
                for l in range(n - 1):
                    v[q + (first + k) * nr + first + l] = cone.c[k * (n - 1) + l]
                    bt[q + (first + k) * nr + first + l] = cone.root[k * (n - 1) + l]
        for k in range(nr):
            for l in range(nr):
                v[q + k * nr + l] += x * a[k] * a[l]
        r = sqrt(x)
        is_soft = False
        for k in range(nr):
            bt[q + k] = r * a[k]
            is_soft |= e.theta[j + k] != 0.0
        if is_soft:
            add_compliance(e, i, v + q, bt + q)
    gap[0] = total


cdef inline double limit_affine_step(const elements_t* e, const interior_t* p, const double* dz, double* gap) noexcept nogil:
    """Return the largest step, at most 1, along the affine direction; write the gap G z . u after it."""
    cdef int32_t i, j, k, g, n
    cdef const double* z = p.z
    cdef const double* u1 = p.u1
    cdef const double* u2 = p.u2
    cdef double best = 1.0, a, b, x, t00 = 0.0, t01 = 0.0, t11 = 0.0
    cdef double y[4]
    cdef double back[4]
    cdef const double *v
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if has_lower_bound(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * dz[j]
                best = limit_step_to_nonnegative(a, dz[j], best)
                best = limit_step_to_nonnegative(u1[j], x, best)
                t00 += a * u1[j]
                t01 += a * x + u1[j] * dz[j]
                t11 += x * dz[j]
            if has_upper_bound(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * dz[j]
                best = limit_step_to_nonnegative(a, -dz[j], best)
                best = limit_step_to_nonnegative(u2[j], x, best)
                t00 += a * u2[j]
                t01 += a * x - u2[j] * dz[j]
                t11 -= x * dz[j]
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            v = scaling_of(e, g) + SCALING_V
            if n == 3:
                compute_affine_cone_step(e, i, g, dz, 3, y, back)
                a = distance_to_boundary(v, y, 3)
                b = distance_to_boundary(v, back, 3)
            else:
                compute_affine_cone_step(e, i, g, dz, n, y, back)
                a = distance_to_boundary(v, y, n)
                b = distance_to_boundary(v, back, n)
            best = a if a < best else best
            best = b if b < best else best
            for k in range(n):
                t00 += v[k] * v[k]
                t01 -= v[k] * v[k]
                t11 += y[k] * back[k]
    gap[0] = t00 + best * (t01 + best * t11)
    return best


cdef inline void form_combined_rhs(const elements_t* e, const interior_t* p, const double* da, double sigma_mu,
                                   double* rhs) noexcept nogil:
    """Write the right-hand side of the combined step (4) to rhs (m), from the affine step da (m)."""
    cdef int32_t i, j, k, g, n
    cdef const double* z = p.z
    cdef const double* u1 = p.u1
    cdef const double* u2 = p.u2
    cdef const double* hz = p.hz
    cdef double a, x
    cdef double u[4]
    cdef double t[4]
    for i in range(e.n):
        for j in range(e.ptr[i], e.ptr[i + 1]):
            rhs[j] = -(hz[j] - e.g[j])
        j = e.ptr[i]
        if is_row(e, i):
            # -(H z - g - u1 + u2) - c1/s1 + c2/s2 with c = s u + ds du - sigma mu: u1 and u2 cancel.
            if has_lower_bound(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * da[j]
                rhs[j] -= (da[j] * x - sigma_mu) / a
            if has_upper_bound(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * da[j]
                rhs[j] += (-da[j] * x - sigma_mu) / a
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            load_cone_dual(e, i, g, u1, u2, u)
            if n == 3:
                compute_combined_cone_rhs(e, i, g, da, sigma_mu, 3, t)
            else:
                compute_combined_cone_rhs(e, i, g, da, sigma_mu, n, t)
            for k in range(n):
                t[k] = u[k] - t[k]
            add_cone_transpose(e, i, g, t, rhs)


cdef inline double take_combined_step(const elements_t* e, const interior_t* p, const double* dz, const double* da,
                                      double sigma_mu, double damping, double* du1, double* du2) noexcept nogil:
    """Take the combined step of the last `form_combined_rhs` in place; return its length. du1, du2 (m) are scratch."""
    cdef int32_t i, j, k, g, n
    cdef double* z = p.z
    cdef double* u1 = p.u1
    cdef double* u2 = p.u2
    cdef double best = 1.0 / damping, a, x
    cdef double du[4]
    cdef double u[4]
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if has_lower_bound(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * da[j]
                x = -u1[j] - (da[j] * x - sigma_mu) / a - u1[j] / a * dz[j]
                best = limit_step_to_nonnegative(a, dz[j], best)
                best = limit_step_to_nonnegative(u1[j], x, best)
                du1[j] = x
            if has_upper_bound(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * da[j]
                x = -u2[j] - (-da[j] * x - sigma_mu) / a + u2[j] / a * dz[j]
                best = limit_step_to_nonnegative(a, -dz[j], best)
                best = limit_step_to_nonnegative(u2[j], x, best)
                du2[j] = x
            continue
        for g in range(e.part[i], e.part[i + 1]):
            n = cone_size(e, g)
            if n == 3:
                best = limit_cone_step(e, i, g, dz, best, 3, du)
            else:
                best = limit_cone_step(e, i, g, dz, best, n, du)
            store_cone_dual(e, i, g, du, du1, du2)
    best = best * damping
    for j in range(e.m):
        z[j] += best * dz[j]
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            if has_lower_bound(e, j):
                u1[j] += best * du1[j]
            if has_upper_bound(e, j):
                u2[j] += best * du2[j]
            continue
        for g in range(e.part[i], e.part[i + 1]):
            load_cone_dual(e, i, g, u1, u2, du)
            load_cone_dual(e, i, g, du1, du2, u)
            for k in range(cone_size(e, g)):
                du[k] += best * u[k]
            store_cone_dual(e, i, g, du, u1, u2)
    return best
