"""Steps of an interior point of the convex law (Mehrotra 1992) or of Coulomb's law, by De Saxce's change of variable.

    s = H z - g,   u = s + phi(s_t) e_n,   phi = sum over components g of a_g |s_g|   (De Saxce, Feng 1998)   (1)
    z in K,  u in K*,  z . u = 0     on every contact                                                   (2)

With phi fixed, (1) and (2) are the convex problem of the "cone" law with its normals lowered by phi, and
phi <- phi(s_t) is Cadoux's fixed point iteration (Cadoux 2009; Acary, Cadoux, Lemarechal, Malick 2011), which takes
dozens of convex problems. Here phi and its derivative follow every step of one interior point. With psi = phi'(s_t) on
the rows after the normal and 0 on it, C = I - e_n psi^T and B = C^-1 = I + e_n psi^T,

    du = -q - W dz,    C du = H dz - r_d,    r_d = u - s - phi e_n,                                      (3)
    (H + C W) dz = r_d - C q = r_d - q + (psi . q) e_n,                                                  (4)

with q and W = G^T T^-2 G of the convex method (interior.pxd), whose functions take every step. phi and psi are computed
from u, which has the tangents of s. W^-1 = L L^T gives (C W)^-1 = L P, P = L^T B, so that

    bodies     N = I + K^T L P K,   N dy = K^T L P r,   dz = L P (r - K dy)                              (5)
    rows       (I + P H L) y = P r,   dz = L y                                                           (6)

Both matrices are not symmetric and are factored by LU. The central path of a problem that is not monotone may turn
back, and steps then become arbitrarily short. With a fraction of psi in B (`derivative_fraction`, a little below 1) the
method is between Newton's method and the fixed point iteration. It passes such folds at a linear rate, and Newton's
method on the Alart-Curnier map then ends it.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.validate cimport all_finite
from lavender_ext.newton.cones cimport add_cone_transpose, has_lower_bound, has_upper_bound, load_cone_dual
from lavender_ext.newton.elements cimport elements_t, is_row
from lavender_ext.newton.interior cimport (compute_scaling, form_combined_rhs, interior_t, limit_affine_step,
                                           place_inside_cones, take_combined_step)
from lavender_ext.newton.natural_map cimport compute_convex_residual
from lavender_ext.newton.run cimport copy_vector, newton_t
from lavender_ext.newton.system cimport (BARRIER, PAIR, set_first_weights, factor_newton_system, solve_newton_system, system_t,
                                         multiply_system_matrix)


cdef inline double compute_proximal_weight() noexcept nogil:
    """Return the proximal weight of an interior point, as a fraction of d.

    A larger weight changes the steps; a smaller one is lost in the rounding of a pivot (2^-53).
    """
    return 1e-10


cdef inline bint has_only_free_rows(const elements_t* e) noexcept nogil:
    """Return whether every element is a row without bounds."""
    cdef int32_t i
    for i in range(e.n):
        if not is_row(e, i) or has_lower_bound(e, e.ptr[i]) or has_upper_bound(e, e.ptr[i]):
            return False
    return True


cdef inline void begin_interior_point(newton_t* n, double delta, double derivative_fraction) noexcept nogil:
    """Compute a first point near H z = g and shift it inside all boundaries; one factorisation.

    If H does not reach g (contacts separate, or rows outnumber velocities), the weight of the first system determines
    nearly all of z. The least-squares solution of H z = g is then used instead.
    """
    cdef system_t* s = &n.s
    cdef interior_t* p = &n.ip
    cdef int32_t j, m = s.e.m
    cdef double reached = 0.0, size = 0.0
    p.delta, p.derivative_fraction = delta, derivative_fraction
    p.gap = p.min_gap = 1.0 / 0.0
    p.max_gap = 0.0
    p.length = 1.0
    memset(p.u1, 0, m * sizeof(double))
    memset(p.u2, 0, m * sizeof(double))
    set_first_weights(s, 1e-6, compute_proximal_weight())
    factor_newton_system(s, BARRIER, 0.0)
    solve_newton_system(s, BARRIER, s.e.g, p.z)
    copy_vector(n, p.unbounded_z, p.z)
    multiply_system_matrix(s, p.z, p.hz)
    if not has_only_free_rows(s.e):
        solve_newton_system(s, BARRIER, p.hz, n.trial)
        for j in range(m):
            size += p.z[j] * p.z[j]
            reached += n.trial[j] * n.trial[j]
        if reached < 0.01 * size:                       # Fractions of 1e-4 to 0.1 take the same steps.
            copy_vector(n, p.z, n.trial)
            multiply_system_matrix(s, p.z, p.hz)
    p.degree = place_inside_cones(s.e, p, 0.01)         # Fractions from 0.001 to 1 take about as many steps.
    multiply_system_matrix(s, p.z, p.hz)


cdef inline void multiply_cone_duals(const elements_t* e, const interior_t* p, double* u) noexcept nogil:
    """Compute u (m) = G^T u of the duals of the interior point p."""
    cdef int32_t i, j, g
    cdef double x[4]
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            u[j] = p.u1[j] - p.u2[j]
            continue
        memset(u + j, 0, (e.ptr[i + 1] - j) * sizeof(double))
        for g in range(e.part[i], e.part[i + 1]):
            load_cone_dual(e, i, g, p.u1, p.u2, x)
            add_cone_transpose(e, i, g, x, u)


cdef inline double compute_contact_normal_shift(const elements_t* e, int32_t i, const double* s, double fraction,
                                                double* psi) noexcept nogil:
    """Return phi for the slack s of one contact; write `fraction` times the derivative of phi to psi."""
    cdef int32_t k, g, first, n
    cdef double t, a, phi = 0.0
    psi[0] = 0.0
    for g in range(e.part[i], e.part[i + 1]):
        n = e.size[g]
        first = e.first[g] - e.ptr[i]
        a = e.reach[g]
        if n == 1:
            phi += a * fabs(s[first])
            psi[first] = fraction * a * (1.0 if s[first] > 0.0 else -1.0 if s[first] < 0.0 else 0.0)
            continue
        t = euclidean_norm(s + first, n)
        for k in range(first, first + n):
            psi[k] = fraction * (a * s[k] / t) if t > 0.0 else 0.0
        phi += a * t
    return phi


cdef inline void compute_all_normal_shifts(const elements_t* e, const double* u, double fraction, double* phi,
                                           double* psi) noexcept nogil:
    """Compute phi (m), which is 0 except on the normals of contacts, and psi (m)."""
    cdef int32_t i, j
    memset(phi, 0, e.m * sizeof(double))
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            psi[j] = 0.0
        else:
            phi[j] = compute_contact_normal_shift(e, i, u + j, fraction, psi + j)


cdef inline void add_normal_products(const elements_t* e, const double* psi, const double* x, double* r) noexcept nogil:
    """Compute r_n += psi . x on every contact."""
    cdef int32_t i, j
    cdef double t
    for i in range(e.n):
        t = 0.0
        for j in range(e.ptr[i], e.ptr[i + 1]):
            t += psi[j] * x[j]
        r[e.ptr[i]] += t


cdef inline void form_de_saxce_matrices(system_t* s, const double* psi) noexcept nogil:
    """Write (theta + C W)^-1 = V (I + e_n c^T) = L P to the system's `v` and P to its `pair`, with V = (W + theta)^-1 = L L^T;
    C = I - e_n psi^T, psi (m) is the derivative of phi (head of the file), and theta is the compliance:

        c = (psi - t) / (1 + t_n),   t = V theta psi                 (c = psi without compliance)
    """
    cdef int32_t i, j, k, l, q, nr
    cdef double x
    cdef double t[6]
    cdef double* v
    cdef const elements_t* e = s.e
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        v = s.v + q
        for k in range(nr):
            t[k] = 0.0
            for l in range(nr):
                t[k] += v[k * nr + l] * e.theta[j + l] * psi[j + l]
        x = 1.0 / (1.0 + t[0])
        for l in range(nr):
            t[l] = (psi[j + l] - t[l]) * x
        for k in range(nr):
            x = v[k * nr]
            for l in range(nr):
                s.pair[q + k * nr + l] = s.bt[q + k * nr + l] + s.bt[q + k * nr] * t[l]
                v[k * nr + l] += x * t[l]


cdef inline bint take_interior_point_step(newton_t* n) noexcept nogil:
    """Take one predictor-corrector step and compute the errors after it; return False if the factorisation or the step fails."""
    cdef system_t* s = &n.s
    cdef interior_t* p = &n.ip
    cdef const elements_t* e = s.e
    cdef int32_t j, what = PAIR if p.derivative_fraction > 0.0 else BARRIER
    cdef double gap, after, sigma = 0.0, mu
    # Scaling and matrix.
    compute_scaling(e, p, s.v, s.bt, &gap)
    if what == PAIR:
        multiply_cone_duals(e, p, n.u)
        compute_all_normal_shifts(e, n.u, p.derivative_fraction, n.c, n.psi)
        form_de_saxce_matrices(s, n.psi)
    if not factor_newton_system(s, what, 0.0) and not gap - gap == 0.0:
        return False
    # Predictor, for which q of (3) is u itself.
    for j in range(e.m):
        n.r[j] = e.g[j] - p.hz[j]
        if what == PAIR:
            n.r[j] -= n.c[j]
    if what == PAIR:
        add_normal_products(e, n.psi, n.u, n.r)
    solve_newton_system(s, what, n.r, n.da)
    if p.degree > 0.0 and gap > 0.0:
        limit_affine_step(e, p, n.da, &after)
        sigma = after / gap
        sigma = 1.0 if sigma > 1.0 else sigma if sigma > 0.0 else 0.0
        sigma = sigma * sigma * sigma
    # Corrector. Its right-hand side is r_d - q with r_d = u - s; q follows by difference.
    mu = gap / (p.degree if p.degree > 1.0 else 1.0)
    form_combined_rhs(e, p, n.da, sigma * mu, n.r)
    if what == PAIR:
        for j in range(e.m):
            n.u[j] -= p.hz[j] - e.g[j] + n.r[j]
            n.r[j] -= n.c[j]
        add_normal_products(e, n.psi, n.u, n.r)
    solve_newton_system(s, what, n.r, n.dz)
    if not all_finite(n.dz, e.m):
        return False
    # Step, just short of the boundary (Mehrotra 1992), and errors.
    p.length = take_combined_step(e, p, n.dz, n.da, sigma * mu, 0.995, n.t1, n.t2)
    p.min_gap = p.gap if p.gap < p.min_gap else p.min_gap
    p.gap = mu
    p.max_gap = mu if mu > p.max_gap else p.max_gap
    multiply_system_matrix(s, p.z, p.hz)
    compute_convex_residual(e, p.z, p.hz, n.sc.speed, &p.energy, &p.velocity)
    return p.length > 0.0
