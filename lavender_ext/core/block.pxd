"""The arithmetic of one block: the update of a sweep and the error of the judge.

A block is a set of bounded rows, or a contact: a normal and friction components g, each with |lam_g| <= a_g lam_n
(core/block_types.pxd). A round cone has one bound over all rows after its normal (law CONE only).
With w = A lam - b [m/s] and d = diag(A) [1/kg]:

    update   row      lam  <- clip(lam - w / d, lower, upper)                                  (1)
             normal   lam_n <- max(0, lam_n - w_n / d_n)                                       (2)
             friction lam_g <- radial projection on a_g lam_n of lam_g - w_g / lambda_max(A_gg) (3)
    error    row      e = lam - clip(lam - w / d, lower, upper), w / d where free              (5)
             coulomb  (5) for the normal; e_g = lam_g - Pi_disk(a_g lam_n+)(lam_g - w_g / d_g),
                      lam_n+ = max(0, lam_n)                                                   (6)
             cone     e = lam - Pi(lam - w / d) in the metric of d                             (7)

Every function in this file is inline, allocates nothing and calls no library function except sqrt. The sweeps, the judge,
the engine and the WebAssembly build all use these functions.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport (CONE, MAX_FRICTION_COMPONENTS, blocks_t, get_disk_component, is_disk_friction_contact,
                                            is_round_cone_contact, has_independent_rows,
                                            get_friction_components, friction_components_t)


cdef inline double clip(double x, double low, double high) noexcept nogil:
    """Clip x to [low, high]; a NaN is returned unchanged, so that a diverged iterate is detected."""
    return low if x < low else (high if x > high else x)


cdef inline double norm2(double x, double y) noexcept nogil:
    return sqrt(x * x + y * y)


cdef inline double euclidean_norm(const double* x, int32_t n) noexcept nogil:
    """Return the Euclidean norm of x (n)."""
    cdef int32_t i
    cdef double s = 0.0
    for i in range(n):
        s += x[i] * x[i]
    return sqrt(s)


cdef inline double project_row_update(double lam, double w, double step, double low, double high) noexcept nogil:
    return clip(lam - w * step, low, high)              # (1)


cdef inline double project_normal_update(double lam, double w, double step) noexcept nogil:
    cdef double y = lam - w * step                      # (2)
    return 0.0 if y < 0.0 else y


cdef inline void project_to_disk(double* x, double* y, double radius) noexcept nogil:
    """Project (x, y) radially to the disk; squares are compared, so that a sticking contact needs no square root."""
    cdef double square = x[0] * x[0] + y[0] * y[0], scale
    if square > radius * radius:
        scale = radius / sqrt(square)
        x[0] = x[0] * scale
        y[0] = y[0] * scale


cdef inline void project_tangent_update(double* lam, const double* w, double step, double friction_bound, int32_t n) noexcept nogil:
    """Update the impulses lam of n = 1 or 2 tangent rows with slacks w by (3); both rows have the step 1 / lambda_max."""
    lam[0] = lam[0] - w[0] * step
    if n == 1:
        lam[0] = clip(lam[0], -friction_bound, friction_bound)
        return
    lam[1] = lam[1] - w[1] * step
    project_to_disk(lam, lam + 1, friction_bound)


cdef inline double compute_row_error(double lam, double w, double d, double low, double high) noexcept nogil:
    """Return the error (5) of one row, computed as clip(w / d, lam - high, lam - low).

    The form lam - clip(lam - w / d) loses digits if no bound is active, and misses a bound that is much larger than w / d.
    """
    return clip(w / d, lam - high, lam - low)


cdef inline void compute_tangent_error(const double* lam, const double* w, double d, double radius, int32_t n,
                                       double* e) noexcept nogil:
    """Compute the error of n tangent rows on the disk of this radius by (6)."""
    cdef double x, y, r
    if n == 1:
        e[0] = compute_row_error(lam[0], w[0], d, -radius, radius)
    elif n == 2:
        e[0] = w[0] / d
        e[1] = w[1] / d
        x = lam[0] - e[0]
        y = lam[1] - e[1]
        r = norm2(x, y)
        if r > radius:
            r = radius / r
            e[0] = lam[0] - r * x
            e[1] = lam[1] - r * y


cdef inline double scale_projection_argument(double lam, double w, double d, double r) noexcept nogil:
    """Return r (lam - w / d) with r = sqrt(d), one entry of the vector that (7) projects."""
    return r * (lam - w / d)


cdef inline double project_cone_normal(const int32_t n, const double* a, const double* t, double yn) noexcept nogil:
    """Return the normal s of the projection (7) onto the cone |y_g| <= a_g s of n components, |y_g| = t_g.

    s is the largest of the candidates (y_n + sum a_g t_g) / (1 + sum a_g^2) over the subsets of the components, which are
    the minimisers of the pieces of a convex piecewise quadratic function of s.
    """
    cdef double s = yn if yn > 0.0 else 0.0, numerator, denominator
    cdef int32_t g, subset
    for subset in range(1, 1 << n):
        numerator = yn
        denominator = 1.0
        for g in range(n):
            if subset >> g & 1:
                numerator += a[g] * t[g]
                denominator += a[g] * a[g]
        numerator = numerator / denominator
        if numerator > s:
            s = numerator
    return s


cdef inline void compute_cone_error(const double* lam, const double* w, const double* d, const friction_components_t* q,
                                    double* e) noexcept nogil:
    """Compute the error e of a contact's rows under the cone law by (7).

    The projection is computed for y = sqrt(d) (lam - w / d), in which the metric of d is the Euclidean one.
    """
    cdef double t[MAX_FRICTION_COMPONENTS]
    cdef double a[MAX_FRICTION_COMPONENTS]
    cdef double y[6]
    cdef double rn = sqrt(d[0]), yn = scale_projection_argument(lam[0], w[0], d[0], rn), total = yn, s, r, f
    cdef int32_t g, i, j, end
    for g in range(q.n):
        j, end = q.first[g], q.first[g] + q.size[g]
        r = sqrt(d[j])
        a[g] = q.friction_coefficient[g] * r / rn
        for i in range(j, end):
            y[i] = scale_projection_argument(lam[i], w[i], d[i], r)
        t[g] = euclidean_norm(y + j, q.size[g])
        total += t[g]
    s = project_cone_normal(q.n, a, t, yn)
    # e = lam - Pi, which is w / d for rows that the projection does not change
    e[0] = w[0] / d[0] if s == yn else lam[0] - s / rn
    for g in range(q.n):
        j, end = q.first[g], q.first[g] + q.size[g]
        r = t[g] * sqrt(d[j])
        f = a[g] * s / r if r > 0.0 else 0.0            # Its size may underflow to 0.
        for i in range(j, end):
            e[i] = lam[i] - f * y[i] if t[g] > a[g] * s else w[i] / d[i]
    if total != total:
        e[0] = total                                    # Return NaN, which the comparisons above would hide.


cdef inline int32_t index_of_row_group(int32_t tangent) noexcept nogil:
    """Return the group of tangent row 1 to 5: 0 sliding (rows 1, 2), 1 spin (row 3), 2 rolling (rows 4, 5)."""
    return 0 if tangent < 3 else (1 if tangent == 3 else 2)


cdef inline double compute_round_denominator_offset(double a, double yn) noexcept nogil:
    """Return q_g of (8) at r = 0."""
    return a * a * yn if yn > 0.0 else -yn


cdef inline int32_t classify_in_round_cone(const double* t, const double* a, double yn, double* rise, double* size) noexcept nogil:
    """Classify y by T_g in t (3) and a_g in a (3): return -1 in the polar cone, 1 in the cone, else 0 with r of (8) in `rise`.

    `size` receives the norm of T_g / a_g, which is NaN if y is.

        s = max(0, y_n) + r,     q_g = (1 + a_g^2) s - y_n = (1 + a_g^2) r + (a_g^2 y_n if y_n > 0 else -y_n)
        sum (a_g T_g)^2 / q_g^2 = 1,     Pi_n = s,     Pi_g = y_g a_g^2 s / q_g                            (8)
    (8) is solved by Newton's method from below, where its left side is decreasing and convex. The unknown is r because in a
    narrow cone s - y_n loses the digits of q.
    """
    cdef double r = 0.0, f, h, slope, q, inside = 0.0, polar = 0.0
    cdef int32_t g, _step
    for g in range(3):
        if t[g] > 0.0:
            inside = norm2(inside, t[g] / a[g])         # infinite if a_g = 0
            polar = norm2(polar, a[g] * t[g])
            f = a[g] * (t[g] - a[g] * yn) if yn > 0.0 else yn + a[g] * t[g]
            f = f / (1.0 + a[g] * a[g])
            if f > r:
                r = f
    size[0] = inside
    if inside <= yn:
        return 1
    if yn + polar <= 0.0:
        return -1
    if polar > 0.0:
        for _step in range(64):
            h = -1.0
            slope = 0.0
            for g in range(3):
                if t[g] > 0.0:
                    q = (1.0 + a[g] * a[g]) * r + compute_round_denominator_offset(a[g], yn)
                    f = a[g] * t[g] / q
                    h += f * f
                    slope += 2.0 * f * f * (1.0 + a[g] * a[g]) / q
            if not h > 0.0:
                break
            f = r + h / slope
            if not f > r:
                break
            r = f
    rise[0] = r
    return 0


cdef inline double compute_round_cone_scale(double a, double rise, double yn) noexcept nogil:
    """Return Pi_g / y_g of (8)."""
    cdef double q = (1.0 + a * a) * rise + compute_round_denominator_offset(a, yn)
    return a * (a * ((yn if yn > 0.0 else 0.0) + rise) / q) if q > 0.0 else 0.0


cdef inline double compute_round_cone_scale_complement(double a, double rise, double yn) noexcept nogil:
    """Return 1 - Pi_g / y_g of (8) without cancellation."""
    cdef double q = (1.0 + a * a) * rise + compute_round_denominator_offset(a, yn)
    return (rise if yn > 0.0 else rise - yn) / q if q > 0.0 else 1.0


cdef inline void compute_round_cone_error(const double* lam, const double* w, const double* d, double mu, int32_t nt,
                                          double* e) noexcept nogil:
    """Compute the error (7) of a ROUND contact, |lam_T| <= mu lam_n over all its tangents together.

    Each group g (sliding, spin, rolling) has one d: (8) with y = sqrt(d) (lam - w / d), T_g = |y_g|, a_g = mu sqrt(d_g / d_n).
    """
    cdef double t[3]
    cdef double a[3]
    cdef double rn = sqrt(d[0]), yn = scale_projection_argument(lam[0], w[0], d[0], rn), y, r = 0.0, f, inside = 0.0
    cdef int32_t i, g, zone
    t[0] = t[1] = t[2] = 0.0
    a[0] = a[1] = a[2] = 0.0
    for i in range(1, 1 + nt):
        g = index_of_row_group(i)
        t[g] = norm2(t[g], scale_projection_argument(lam[i], w[i], d[i], sqrt(d[i])))
        a[g] = mu * sqrt(d[i]) / rn
    zone = classify_in_round_cone(t, a, yn, &r, &inside)
    for i in range(1 + nt):
        e[i] = lam[i] if zone < 0 else w[i] / d[i]
    if zone == 0:
        # If the projection changes a row little, lam - Pi is w / d plus that change; this avoids cancellation.
        e[0] = (e[0] if yn > 0.0 else lam[0]) - r / rn
        for i in range(1, 1 + nt):
            f = compute_round_cone_scale(a[index_of_row_group(i)], r, yn)
            y = lam[i] - e[i]
            e[i] = e[i] + compute_round_cone_scale_complement(a[index_of_row_group(i)], r, yn) * y if f > 0.5 else lam[i] - f * y
    if not (yn == yn and inside == inside):
        e[0] = yn + inside                              # Return NaN, which the comparisons above would hide.


cdef inline void compute_contact_error(int32_t law, const double* lam, const double* w, const double* d,
                                       const friction_components_t* q, double* e) noexcept nogil:
    """Compute the error e of one contact with friction components q, under `law` by (6) or (7)."""
    cdef double normal_impulse = lam[0] if lam[0] > 0.0 else 0.0
    cdef int32_t g, j
    if law == CONE:
        compute_cone_error(lam, w, d, q, e)
        return
    e[0] = compute_row_error(lam[0], w[0], d[0], 0.0, 1.0 / 0.0)
    for g in range(q.n):
        j = q.first[g]
        compute_tangent_error(lam + j, w + j, d[j], q.friction_coefficient[g] * normal_impulse, q.size[g], e + j)


cdef inline void compute_block_error(const blocks_t* p, int32_t i, const double* lam, const double* w,
                                     double* e) noexcept nogil:
    """Compute the error e [N s] of block i; lam, w, e are vectors of all rows (m)."""
    cdef int32_t j = p.ptr[i], end = p.ptr[i + 1]
    cdef friction_components_t q
    if has_independent_rows(p, i):
        while j < end:
            e[j] = compute_row_error(lam[j], w[j], p.d[j], p.lower[j], p.upper[j])
            j += 1
    elif is_disk_friction_contact(p, i):                                 # This common case is compiled with constant sizes.
        get_disk_component(p, i, &q)
        compute_contact_error(p.law, lam + j, w + j, p.d + j, &q, e + j)
    elif is_round_cone_contact(p, i):
        compute_round_cone_error(lam + j, w + j, p.d + j, p.mu[i], end - j - 1, e + j)
    else:
        get_friction_components(p, i, &q)
        compute_contact_error(p.law, lam + j, w + j, p.d + j, &q, e + j)
