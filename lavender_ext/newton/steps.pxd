"""Interior points of the convex law (Mehrotra 1992) and of Coulomb's, by De Saxce's change of variable, over any system.

    s = H z - g,   u = s + phi(s_t) e_n,   phi = sum over parts of a_p |s_p|          (De Saxce, Feng 1998)   (1)
    z in K,  u in K*,  z . u = 0     on every contact                                                   (2)

With phi frozen, (1) and (2) are the convex problem of the "cone" law with its normals lowered by phi, and
phi <- phi(s_t) is Cadoux's fixed point (Cadoux 2009; Acary, Cadoux, Lemarechal, Malick 2011): dozens of
convex problems. Here phi moves with every step of one interior point, and so does its derivative: with
psi = phi'(s_t) behind the normal, 0 on it, C = I - e_n psi^T and B = C^-1 = I + e_n psi^T,

    du = -q - W dz,    C du = H dz - r_d,    r_d = u - s - phi e_n,                                      (3)
    (H + C W) dz = r_d - C q = r_d - q + (psi . q) e_n,                                                  (4)

q and W = G^T T^-2 G as in the convex method (interior.pxd), whose kernels take every step; phi and psi are read off u,
which shares its tangents with s. W^-1 = L L^T gives (C W)^-1 = L P, P = L^T B, so

    bodies     N = I + K^T L P K,   N dy = K^T L P r,   dz = L P (r - K dy)                              (5)
    rows       (I + P H L) y = P r,   dz = L y                                                           (6)

Both matrices lack symmetry and are factored by LU. The central path of a problem that is not monotone may
turn back: steps then shrink to nothing. With `share` psi for psi in B, share a little below 1, the method is
between Newton's and the fixed point and passes such folds, at a linear rate, after which Newton's method on
the Alart-Curnier map ends it.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.block cimport length
from lavender_ext.core.validate cimport all_finite
from lavender_ext.newton.cones cimport is_high, is_low, load_dual, scatter
from lavender_ext.newton.elements cimport elements_t, is_row
from lavender_ext.newton.interior cimport ipm_affine, ipm_rhs, ipm_scale, ipm_start, ipm_update
from lavender_ext.newton.natural_map cimport convex_error
from lavender_ext.newton.run cimport newton_t, interior_t, take
from lavender_ext.newton.system cimport (OF_BARRIER, OF_PAIR, first_weights, system_factor, system_solve,
                                         system_t, system_times)


cdef inline double delta_of() noexcept nogil:
    """Weight of the proximal term: far below any step that matters, far above the rounding of a pivot."""
    return 1e-10


cdef inline double out_of_reach() noexcept nogil:
    """Share of |z|^2 that H z takes to (1e-4 to 0.1 measured: the same steps)."""
    return 0.01


cdef inline bint all_free(const elements_t* e) noexcept nogil:
    cdef int32_t i
    for i in range(e.n):
        if not is_row(e, i) or is_low(e, e.ptr[i]) or is_high(e, e.ptr[i]):
            return False
    return True


cdef inline bint has_free_rows(const newton_t* n) noexcept nogil:
    cdef int32_t i
    for i in range(n.s.e.n):
        if is_row(n.s.e, i) and not is_low(n.s.e, n.s.e.ptr[i]) and not is_high(n.s.e, n.s.e.ptr[i]):
            return True
    return False


cdef inline void begin_interior(newton_t* n, double delta, double share) noexcept nogil:
    """A first point near H z = g, all boundaries left by what the worst of them needs; one factor.

    Of a g that H does not reach, as where contacts part or rows outnumber velocities, a small weight makes nearly the
    whole of z: z then meets H z = g as far as it can.
    """
    cdef system_t* s = &n.s
    cdef interior_t* p = &n.ip
    cdef int32_t j, m = s.e.m
    cdef double reached = 0.0, whole = 0.0
    p.delta, p.share = delta, share
    p.gap = p.lowest_gap = 1.0 / 0.0
    p.first_gap = 0.0
    p.length = 1.0
    memset(p.u1, 0, m * sizeof(double))
    memset(p.u2, 0, m * sizeof(double))
    first_weights(s, 1e-6, delta_of())
    system_factor(s, OF_BARRIER, 0.0)
    system_solve(s, OF_BARRIER, s.e.g, p.z)
    take(n, p.everything, p.z)                          # where all rows hold, the answer
    system_times(s, p.z, p.hz)
    if not all_free(s.e):
        system_solve(s, OF_BARRIER, p.hz, n.trial)
        for j in range(m):
            whole += p.z[j] * p.z[j]
            reached += n.trial[j] * n.trial[j]
        if reached < out_of_reach() * whole:
            take(n, p.z, n.trial)
            system_times(s, p.z, p.hz)
    p.degree = ipm_start(s.e, p.hz, 0.01, p.z, p.u1, p.u2)      # of the first impulses (measured: 0.001 to 1)
    system_times(s, p.z, p.hz)


cdef inline void duals(const elements_t* e, const interior_t* p, double* u) noexcept nogil:
    """G^T u on every row."""
    cdef int32_t i, j, g
    cdef double x[4]
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            u[j] = p.u1[j] - p.u2[j]
            continue
        memset(u + j, 0, (e.ptr[i + 1] - j) * sizeof(double))
        for g in range(e.part[i], e.part[i + 1]):
            load_dual(e, i, g, p.u1, p.u2, x)
            scatter(e, i, g, x, u)


cdef inline double slip(const elements_t* e, int32_t i, const double* s, double share, double* psi) noexcept nogil:
    """phi of one contact's s; share of its derivative into psi."""
    cdef int32_t k, g, first, n
    cdef double t, a, phi = 0.0
    psi[0] = 0.0
    for g in range(e.part[i], e.part[i + 1]):
        n = e.size[g]
        first = e.first[g] - e.ptr[i]
        a = e.reach[g]
        if n == 1:
            phi += a * fabs(s[first])
            psi[first] = share * a * (1.0 if s[first] > 0.0 else -1.0 if s[first] < 0.0 else 0.0)
            continue
        t = length(s + first, n)
        for k in range(first, first + n):
            psi[k] = share * (a * s[k] / t) if t > 0.0 else 0.0
        phi += a * t
    return phi


cdef inline void slips(const elements_t* e, const double* u, double share, double* phi, double* psi) noexcept nogil:
    """phi (m) on the normals of contacts, nothing elsewhere, and psi (m)."""
    cdef int32_t i, j
    memset(phi, 0, e.m * sizeof(double))
    for i in range(e.n):
        j = e.ptr[i]
        if is_row(e, i):
            psi[j] = 0.0
        else:
            phi[j] = slip(e, i, u + j, share, psi + j)


cdef inline void add_along(const elements_t* e, const double* psi, const double* x, double* r) noexcept nogil:
    """r_n += psi . x"""
    cdef int32_t i, j
    cdef double t
    for i in range(e.n):
        t = 0.0
        for j in range(e.ptr[i], e.ptr[i + 1]):
            t += psi[j] * x[j]
        r[e.ptr[i]] += t


cdef inline void turn(system_t* s, const double* psi) noexcept nogil:
    """(theta + C W)^-1 = V (I + e_n c^T) = L P into `v` and P into `pair`, V = (W + theta)^-1 = L L^T,

        c = (psi - t) / (1 + t_n),   t = V theta psi                 (c = psi without a compliance)
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


cdef inline bint interior_step(newton_t* n) noexcept nogil:
    """One predictor-corrector step, |F| and velocity error after it; False where the factorisation or the step fails."""
    cdef system_t* s = &n.s
    cdef interior_t* p = &n.ip
    cdef const elements_t* e = s.e
    cdef int32_t j, what = OF_PAIR if p.share > 0.0 else OF_BARRIER
    cdef double gap, after, sigma = 0.0, mu
    ipm_scale(e, p.z, p.u1, p.u2, p.delta, s.v, s.bt, &gap)
    if what == OF_PAIR:
        duals(e, p, n.u)
        slips(e, n.u, p.share, n.c, n.psi)
        turn(s, n.psi)
    if not system_factor(s, what, 0.0) and not gap - gap == 0.0:
        return False
    for j in range(e.m):
        n.r[j] = e.g[j] - p.hz[j]
        if what == OF_PAIR:
            n.r[j] -= n.c[j]
    if what == OF_PAIR:                                 # the predictor's q is u itself
        add_along(e, n.psi, n.u, n.r)
    system_solve(s, what, n.r, n.da)
    if p.degree > 0.0 and gap > 0.0:
        ipm_affine(e, p.z, p.u1, p.u2, n.da, &after)
        sigma = after / gap
        sigma = 1.0 if sigma > 1.0 else sigma if sigma > 0.0 else 0.0
        sigma = sigma * sigma * sigma
    mu = gap / (p.degree if p.degree > 1.0 else 1.0)
    ipm_rhs(e, p.z, p.u1, p.u2, p.hz, n.da, sigma * mu, n.r)
    if what == OF_PAIR:                                 # that is r_d - q for u - s alone; q comes back by difference
        for j in range(e.m):
            n.u[j] -= p.hz[j] - e.g[j] + n.r[j]
            n.r[j] -= n.c[j]
        add_along(e, n.psi, n.u, n.r)
    system_solve(s, what, n.r, n.dz)
    if not all_finite(n.dz, e.m):
        return False
    p.length = ipm_update(e, p.z, p.u1, p.u2, n.dz, n.da, sigma * mu, 0.995, n.t1, n.t2)
    p.lowest_gap = p.gap if p.gap < p.lowest_gap else p.lowest_gap
    p.gap = mu
    p.first_gap = mu if mu > p.first_gap else p.first_gap
    system_times(s, p.z, p.hz)
    convex_error(e, p.z, p.hz, n.sc.speed, &p.energy, &p.velocity)
    return p.length > 0.0
