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


cdef inline void sub_columns(double* to, int32_t length, const double* c0, const double* c1, const double* c2,
                             const double* c3, const double* c4, const double* c5, const double* l) noexcept nogil:
    # to -= sum of l times columns
    cdef double l0 = l[0], l1 = l[1], l2 = l[2], l3 = l[3], l4 = l[4], l5 = l[5]
    cdef int32_t t
    if l0 == 0.0 and l1 == 0.0 and l2 == 0.0 and l3 == 0.0 and l4 == 0.0 and l5 == 0.0:
        return                                          # bodies that do not touch, and no fill
    for t in range(length):
        to[t] -= ((l0 * c0[t] + l1 * c1[t]) + (l2 * c2[t] + l3 * c3[t])) + (l4 * c4[t] + l5 * c5[t])


cdef inline int32_t factor_band(int32_t n, int32_t width, double* band, const double* size) noexcept nogil:
    """N = L D L^T, six columns of a body at once; 0 where a pivot is lost. size (n) is the diagonal.

    band[i width] is 1 / D_i after it, and the rest of a column what it was before its division. Column j of a
    body ends where its body's others end: six columns reach down to the same row.
    """
    cdef int32_t i, j, k, q, first, end
    cdef double p
    cdef double x[6]
    cdef double l[6]
    cdef const double* c[6]
    for first in range(0, n, 6):
        end = first + width if first + width < n else n
        for j in range(6):
            i = first + j
            for q in range(6):
                # what row i has in the columns before it; the others take no part
                k = q if q < j else 0
                c[q] = band + <int64_t>(first + k) * width + (j - k)
                l[q] = c[q][0] * x[q] if q < j else 0.0
            sub_columns(band + <int64_t>i * width, end - i, c[0], c[1], c[2], c[3], c[4], c[5], l)
            p = band[<int64_t>i * width]
            if not p > 1e-15 * size[i]:
                return 0
            x[j] = 1.0 / p
            # the diagonal is read as a row of column j no more
            band[<int64_t>i * width] = x[j]
        for k in range(first + 6, end):
            for q in range(6):
                c[q] = band + <int64_t>(first + q) * width + (k - first - q)
                l[q] = c[q][0] * x[q]
            sub_columns(band + <int64_t>k * width, end - k, c[0], c[1], c[2], c[3], c[4], c[5], l)
    return 1


cdef inline void solve_band(int32_t n, int32_t width, const double* band, double* u) noexcept nogil:
    """u (n) <- N^-1 u after `factor_band`."""
    cdef int32_t i, j, q, t, first, end, below
    cdef double s0, s1, s2, s3, s4, s5, y
    cdef double l[6]
    cdef const double* c[6]
    for first in range(0, n, 6):
        end = first + width if first + width < n else n
        for j in range(6):
            i = first + j
            c[j] = band + <int64_t>i * width
            l[j] = u[i] * c[j][0]
            for q in range(1, 6 - j):
                u[i + q] -= c[j][q] * l[j]
            c[j] += 6 - j
        sub_columns(u + first + 6, end - first - 6, c[0], c[1], c[2], c[3], c[4], c[5], l)
    for first in range(n - 6, -1, -6):
        end = first + width if first + width < n else n
        below = first + 6
        for j in range(6):
            c[j] = band + <int64_t>(first + j) * width + (6 - j)
        s0 = s1 = s2 = s3 = s4 = s5 = 0.0
        for t in range(end - below):
            y = u[below + t]
            s0 += c[0][t] * y
            s1 += c[1][t] * y
            s2 += c[2][t] * y
            s3 += c[3][t] * y
            s4 += c[4][t] * y
            s5 += c[5][t] * y
        l[0] = s0
        l[1] = s1
        l[2] = s2
        l[3] = s3
        l[4] = s4
        l[5] = s5
        for j in range(5, -1, -1):
            y = u[first + j] - l[j]
            for q in range(1, 6 - j):
                y -= c[j][q - (6 - j)] * u[first + j + q]
            u[first + j] = y * band[<int64_t>(first + j) * width]


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
    solve_band(6 * r.n_bodies, width, band, u)
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
    if not factor_band(<int32_t>n, width, band, u):
        return 0
    for _k in range(REPEATS):
        if not solve_set(p, r, state, width, band, eps, energy, velocity, lam, v, u, x, &left):
            break
    return 1
