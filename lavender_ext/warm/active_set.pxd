"""Newton steps of a warm start over the bodies: the active set of contacts, one banded factorisation each.

With y = lam - w / d a contact is open (y_n <= 0: lam = 0), sticks (|y_t| <= mu y_n: w = 0 on its rows) or
slides (w_n = 0, lam_t = mu lam_n along y_t as it stands). On the rows S that stick, E = eps d + compliance,

    N u = J^T E^-1 r,   N = M + J^T E^-1 J,   r = -w,   lam += E^-1 (r - J u),   v += u          (1)

is (A_SS + E)^-1 r, u the change of velocity; repeated with the same N it takes eps away. N has a band of
6 (k + 1) entries where bodies that touch are at most k numbers apart, and is factored in that order.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block cimport CONTACT, ROW, blocks_t, n_tangents, norm2
from lavender_ext.core.rows cimport contact_jacobian, contact_slack, cross, dot3, rows_t
from lavender_ext.core.velocity cimport contact_wrench, wrenches_to_velocity
from lavender_ext.factor.band_6 cimport ldl_factor_6, ldl_solve_6


cdef enum:
    OPEN = 0
    STICKS = 1
    SLIDES = 2
    WIDEST = 192                # entries of a row of the band: 31 bodies apart
    REPEATS = 4                 # solves with one factorisation
    MOST_WORK = 100000000       # multiply-adds of one factorisation, twice

cdef inline int32_t body_band(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Width of the band of N; 0 where there are joints, other contacts than with two tangents, or it is wide."""
    cdef int32_t c, a, b, k, far = 0
    if r.n_joints > 0 or r.n_contacts == 0 or r.n_bodies == 0:
        return 0
    for c in range(r.n_contacts):
        if p.kind[c] != CONTACT or p.ptr[c + 1] - p.ptr[c] != 3:
            return 0
        a = r.contact_body[2 * c]
        b = r.contact_body[2 * c + 1]
        if a >= 0 and b >= 0:
            k = a - b if a > b else b - a
            far = k if k > far else far
    k = 6 * (far + 1)
    if k > WIDEST or <double>k * k * 6.0 * r.n_bodies > MOST_WORK:
        return 0
    return k


cdef inline int32_t add_mass(const rows_t* r, int32_t width, double* band, double* size) noexcept nogil:
    # N = M, and its diagonal; 0 where an inverse inertia has no inverse
    cdef int32_t i, k, q
    cdef const double* a
    cdef double* x
    cdef double m[9]
    cdef double det
    for i in range(r.n_bodies):
        a = r.inv_inertia + 9 * i
        cross(a + 3, a + 6, m)
        cross(a + 6, a, m + 3)
        cross(a, a + 3, m + 6)
        det = dot3(a, m)
        if not (r.inv_mass[i] > 0.0 and fabs(det) > 1e-12 * fabs(a[0] * a[4] * a[8])):
            return 0
        for k in range(3):
            x = band + <int64_t>(6 * i + k) * width
            x[0] = 1.0 / r.inv_mass[i]
            x = band + <int64_t>(6 * i + 3 + k) * width
            for q in range(k, 3):
                x[q - k] = m[3 * k + q] / det
    return 1


cdef inline void add_block(double* band, int32_t width, int32_t a, int32_t b, const double* x, const double* y,
                           int32_t rows) noexcept nogil:
    # lower half of N += x^T y, bodies a >= b; x, y (rows) of 12 apart
    cdef int32_t i, j, k
    cdef double t
    cdef double* out
    for j in range(6):
        out = band + <int64_t>(6 * b + j) * width + (6 * (a - b) - j)
        for i in range(j if a == b else 0, 6):
            t = 0.0
            for k in range(rows):
                t += x[12 * k + i] * y[12 * k + j]
            out[i] += t


cdef inline void add_rows(const rows_t* r, int32_t c, const double* weight, int32_t rows, int32_t width,
                          double* band) noexcept nogil:
    # N += J^T diag(weight) J of the first rows of contact c
    cdef double jac[36]
    cdef double scaled[36]
    cdef int32_t a = r.contact_body[2 * c], b = r.contact_body[2 * c + 1], k, q
    contact_jacobian(r, c, 2, 0, jac)
    for k in range(rows):
        for q in range(12):
            scaled[12 * k + q] = weight[k] * jac[12 * k + q]
    if a >= 0:
        add_block(band, width, a, a, scaled, jac, rows)
    if b >= 0:
        add_block(band, width, b, b, scaled + 6, jac + 6, rows)
    if a >= 0 and b >= 0:
        if a > b:
            add_block(band, width, a, b, scaled, jac + 6, rows)
        else:
            add_block(band, width, b, a, scaled + 6, jac, rows)


cdef inline void choose_set(const blocks_t* p, const rows_t* r, double* lam, const double* v,
                            int32_t* state) noexcept nogil:
    """State of every contact from lam and v = M^-1 J^T lam; what a state fixes is written into lam."""
    cdef int32_t c, j
    cdef double w[3]
    cdef double x, y, z, rim, length
    for c in range(r.n_contacts):
        j = p.ptr[c]
        contact_slack(r, c, 2, 0, v, w)
        x = lam[j] - (w[0] + (r.compliance[j] * lam[j] - p.b[j])) / p.d[j]
        if not x > 0.0:
            state[c] = OPEN
            lam[j] = 0.0
            lam[j + 1] = 0.0
            lam[j + 2] = 0.0
            continue
        y = lam[j + 1] - (w[1] + (r.compliance[j + 1] * lam[j + 1] - p.b[j + 1])) / p.d[j + 1]
        z = lam[j + 2] - (w[2] + (r.compliance[j + 2] * lam[j + 2] - p.b[j + 2])) / p.d[j + 2]
        rim = p.mu[c] * x
        length = norm2(y, z)
        state[c] = STICKS
        if length > rim:
            state[c] = SLIDES
            lam[j + 1] = y * (rim / length)
            lam[j + 2] = z * (rim / length)


cdef inline int32_t solve_set(const blocks_t* p, const rows_t* r, const int32_t* state, int32_t width,
                              const double* band, double eps, double energy, double velocity, double* lam, double* v, double* u,
                              double* x, double* left) noexcept nogil:
    """One application of (1), unless w is within `energy` [sqrt J] and `velocity` [m/s] on every row, or has not
    halved; u (n_bodies, 6), x (3 c) are scratch. Returns whether there was one; left: max |w| d^-1/2 before it."""
    cdef int32_t c, j, k, rows
    cdef double w[3]
    cdef double big = 0.0, fast = 0.0, t
    for k in range(6 * r.n_bodies):
        u[k] = 0.0
    for c in range(r.n_contacts):
        if state[c] == OPEN:
            continue
        j = p.ptr[c]
        rows = 3 if state[c] == STICKS else 1
        contact_slack(r, c, 2, 0, v, w)
        for k in range(3):
            if k < rows:
                t = p.b[j + k] - w[k] - r.compliance[j + k] * lam[j + k]
                x[3 * c + k] = t
                fast = t * t if t * t > fast else fast
                t = t * t / p.d[j + k]
                big = t if t > big else big
                w[k] = x[3 * c + k] / (eps * p.d[j + k] + r.compliance[j + k])
            else:
                w[k] = 0.0
        contact_wrench(r, c, 2, 0, w, u)
    t = sqrt(big)
    if (t <= energy and fast <= velocity * velocity) or not t < 0.5 * left[0]:
        return 0
    left[0] = t
    ldl_solve_6(6 * r.n_bodies, width, band, u)
    for c in range(r.n_contacts):
        if state[c] == OPEN:
            continue
        j = p.ptr[c]
        contact_slack(r, c, 2, 0, u, w)
        for k in range(3 if state[c] == STICKS else 1):
            lam[j + k] += (x[3 * c + k] - w[k]) / (eps * p.d[j + k] + r.compliance[j + k])
    for k in range(6 * r.n_bodies):
        v[k] += u[k]
    return 1


cdef inline int32_t newton_step(const blocks_t* p, const rows_t* r, int32_t* state, int32_t width, double* band,
                                double eps, double energy, double velocity, double* lam, double* v, double* u,
                                double* x) noexcept nogil:
    """lam (m) by the active set and (1), `REPEATS` times at most or until every row of it is within `energy`
    [sqrt J] and `velocity` [m/s]; 0 where N could not be factored.

    v is M^-1 J^T lam on entry; on return it is not any more.
    """
    cdef int32_t c, j, k, rows
    cdef double weight[3]
    cdef double left = 1.0 / 0.0
    cdef int64_t i, n = 6 * <int64_t>r.n_bodies
    choose_set(p, r, lam, v, state)
    for i in range(n):
        v[i] = 0.0
    for c in range(r.n_contacts):
        if state[c] != OPEN:
            contact_wrench(r, c, 2, 0, lam + p.ptr[c], v)
    wrenches_to_velocity(r, v)
    for i in range(n * width):
        band[i] = 0.0
    if not add_mass(r, width, band, u):
        return 0
    for c in range(r.n_contacts):
        if state[c] == OPEN:
            continue
        j = p.ptr[c]
        rows = 3 if state[c] == STICKS else 1
        for k in range(rows):
            weight[k] = 1.0 / (eps * p.d[j + k] + r.compliance[j + k])
        add_rows(r, c, weight, rows, width, band)
    for i in range(n):
        u[i] = band[i * width]
    if not ldl_factor_6(<int32_t>n, width, band, u):
        return 0
    for _k in range(REPEATS):
        if not solve_set(p, r, state, width, band, eps, energy, velocity, lam, v, u, x, &left):
            break
    return 1
