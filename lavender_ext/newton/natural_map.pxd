"""The natural map F = z - Pi(z - s) of every element and its derivative, for Newton steps, and the judge's error from F.

With a proximal weight eps on what is fixed by H alone,

    (I - P + P (theta + eps)) dz + P K dy = r,   dy = K^T dz,   P in the derivative of Pi         (5)

which with E = I - P + P (theta + eps) is (2) of elements.pxd for V = E^-1 P, r -> P^-1 r. For Coulomb friction the
radius of the disk is a_t max(0, z_n - s_n) (Alart and Curnier 1991), P is not symmetric, and N is factored by block
LU.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport CONE, CONTACT_ROLLING, CONTACT_SPIN as SPIN, COULOMB, ROW
from lavender_ext.core.rolling cimport rolling_map
from lavender_ext.newton.elements cimport MAP_AUGMENTED, MAP_CONVEX, elements_t, invert_small


cdef inline void natural_rolling(const elements_t* e, int32_t i, const double* z, const double* s, int32_t law,
                                 int32_t augmented, double* f, double* p) noexcept nogil:
    # F (nr) and P (nr, nr) of one contact that resists rolling; radii as in `natural_coulomb`
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], k
    cdef double rn = z[0] - s[0] if augmented else z[0]
    cdef double y[6]
    cdef double a[3]
    a[0] = e.at[i]
    a[1] = e.as_[i]
    a[2] = e.ar[i]
    for k in range(nr):
        y[k] = z[k] - s[k]
    rolling_map(law, nr, a, y, rn if rn > 0.0 else 0.0, f, p)
    for k in range(nr):
        f[k] = s[k] if f[k] == y[k] else z[k] - f[k]


cdef inline void natural_contact(const elements_t* e, int32_t i, const double* z, const double* s, double* f,
                                 double* p) noexcept nogil:
    # F (nr) and P (nr, nr) of one contact, convex cone: projection in the metric of d.
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], nt, js, k, l
    cdef bint spin = e.kind[i] == SPIN, slide, turn
    cdef double at = e.at[i], as_ = e.as_[i], yn, ys = 0.0, t = 0.0, h, c, norm, kappa
    cdef double y[2]
    cdef double n[4]
    nt = nr - 1 - spin
    js = nr - 1
    for k in range(nr * nr):
        p[k] = 0.0
    yn = z[0] - s[0]
    y[0] = y[1] = 0.0
    for k in range(nt):
        y[k] = z[1 + k] - s[1 + k]
        t += y[k] * y[k]
    t = sqrt(t)
    if spin:
        ys = z[js] - s[js]
    if nt == 0:
        at = 0.0
    if not spin:
        as_ = 0.0
    h = yn if yn > 0.0 else 0.0
    c = (yn + at * t) / (1.0 + at * at)
    h = c if c > h else h
    c = (yn + as_ * fabs(ys)) / (1.0 + as_ * as_)
    h = c if c > h else h
    c = (yn + at * t + as_ * fabs(ys)) / (1.0 + at * at + as_ * as_)
    h = c if c > h else h
    if h <= 0.0:
        for k in range(nr):
            f[k] = z[k]
        return
    slide = nt > 0 and t > at * h
    turn = spin and fabs(ys) > as_ * h
    if not slide and not turn:
        for k in range(nr):
            f[k] = s[k]
            p[k * nr + k] = 1.0
        return
    # The face: one ray n in the normal, sliding and turning directions, and what stays free beside it.
    for k in range(nr):
        n[k] = 0.0
    n[0] = 1.0
    f[0] = z[0] - h
    for k in range(nt):
        if slide:
            n[1 + k] = at * y[k] / t
            f[1 + k] = z[1 + k] - h * n[1 + k]
        else:
            f[1 + k] = s[1 + k]
            p[(1 + k) * nr + 1 + k] = 1.0
    if spin:
        if turn:
            n[js] = as_ if ys > 0.0 else -as_
            f[js] = z[js] - h * n[js]
        else:
            f[js] = s[js]
            p[js * nr + js] = 1.0
    norm = 0.0
    for k in range(nr):
        norm += n[k] * n[k]
    for k in range(nr):
        for l in range(nr):
            p[k * nr + l] += n[k] * n[l] / norm
    if slide and nt == 2:
        kappa = at * h / t
        n[0] = -y[1] / t
        n[1] = y[0] / t
        for k in range(2):
            for l in range(2):
                p[(1 + k) * nr + 1 + l] += kappa * n[k] * n[l]


cdef inline void natural_coulomb(const elements_t* e, int32_t i, const double* z, const double* s, int32_t augmented,
                                 double* f, double* p) noexcept nogil:
    # The same for Coulomb friction; radius a_t y_n with `augmented` (Alart-Curnier), else a_t z_n.
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], nt, js, k, l
    cdef bint spin = e.kind[i] == SPIN
    cdef double yn, rn, radius, t = 0.0, kappa, x
    cdef double y[2]
    cdef double n[2]
    nt = nr - 1 - spin
    js = nr - 1
    for k in range(nr * nr):
        p[k] = 0.0
    yn = z[0] - s[0]
    if yn > 0.0:
        f[0] = s[0]
        p[0] = 1.0
    else:
        f[0] = z[0]
    rn = yn if augmented else z[0]
    rn = rn if rn > 0.0 else 0.0
    radius = e.at[i] * rn
    y[0] = y[1] = 0.0
    for k in range(nt):
        y[k] = z[1 + k] - s[1 + k]
        t += y[k] * y[k]
    t = sqrt(t)
    if t > radius:
        for k in range(nt):
            n[k] = y[k] / t
            f[1 + k] = z[1 + k] - radius * n[k]
            if rn > 0.0:
                p[(1 + k) * nr] = e.at[i] * n[k]
        if nt == 2:
            kappa = radius / t
            x = n[0]
            n[0] = -n[1]
            n[1] = x
            for k in range(2):
                for l in range(2):
                    p[(1 + k) * nr + 1 + l] += kappa * n[k] * n[l]
    else:
        for k in range(nt):
            f[1 + k] = s[1 + k]
            if radius > 0.0 or t < radius:
                p[(1 + k) * nr + 1 + k] = 1.0
            else:
                f[1 + k] = z[1 + k]
    if spin:
        radius = e.as_[i] * rn
        x = z[js] - s[js]
        if fabs(x) > radius or radius <= 0.0:
            f[js] = z[js] - (radius if x > 0.0 else -radius)
            if rn > 0.0:
                p[js * nr] = e.as_[i] if x > 0.0 else -e.as_[i]
        else:
            f[js] = s[js]
            p[js * nr + js] = 1.0


cdef inline double natural(const elements_t* e, const double* z, const double* s, int32_t law, double eps,
                               double* f, double* p, double* einv, double* v) noexcept nogil:
    """F, P, E^-1 and V = E^-1 P of (5) for every element; returns |F|, the judge's energy error.

    law: MAP_CONVEX, MAP_COULOMB or MAP_AUGMENTED. einv, v may be NULL: F and P alone.
    """
    cdef int32_t i, j, k, l, q, nr, piece
    cdef double total = 0.0
    cdef double y, x
    cdef double a[36]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if e.kind[i] == ROW:
            y = z[j] - s[j]
            piece = 1
            if y < e.lower[j]:
                f[j] = z[j] - e.lower[j]
                p[q] = 0.0
                piece = 0
            elif y > e.upper[j]:
                f[j] = z[j] - e.upper[j]
                p[q] = 0.0
                piece = 2
            else:
                f[j] = s[j]
                p[q] = 1.0
            total += f[j] * f[j]
            if v != NULL:
                if piece == 1:
                    einv[q] = 1.0 / (e.theta[j] + eps)
                    v[q] = einv[q]
                else:
                    einv[q] = 1.0
                    v[q] = 0.0
            continue
        if e.kind[i] == CONTACT_ROLLING:
            natural_rolling(e, i, z + j, s + j, CONE if law == MAP_CONVEX else COULOMB, law == MAP_AUGMENTED, f + j, p + q)
        elif law == MAP_CONVEX:
            natural_contact(e, i, z + j, s + j, f + j, p + q)
        else:
            natural_coulomb(e, i, z + j, s + j, law == MAP_AUGMENTED, f + j, p + q)
        for k in range(nr):
            total += f[j + k] * f[j + k]
        if v != NULL:
            for k in range(nr):
                for l in range(nr):
                    x = p[q + k * nr + l]
                    a[k * nr + l] = x * (e.theta[j + l] + eps) - x
                a[k * nr + k] += 1.0
            invert_small(a, einv + q, nr)
            for k in range(nr):
                for l in range(nr):
                    x = 0.0
                    for piece in range(nr):
                        x += einv[q + k * nr + piece] * p[q + piece * nr + l]
                    v[q + k * nr + l] = x
    return sqrt(total)


cdef inline void convex_error(const elements_t* e, const double* z, const double* hz, const double* speed,
                                  double* energy, double* velocity) noexcept nogil:
    """|F| of the convex natural map, and the largest speed |f|, by norm where a contact has two tangents."""
    cdef int32_t i, j, k, nr
    cdef double total = 0.0, worst = 0.0, x
    cdef double s[6]
    cdef double f[6]
    cdef double p[36]
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            x = hz[j] - e.g[j]
            if z[j] - x < e.lower[j]:
                x = z[j] - e.lower[j]
            elif z[j] - x > e.upper[j]:
                x = z[j] - e.upper[j]
            total += x * x
            x = fabs(x) * speed[j]
            worst = x if x > worst else worst
            continue
        nr = e.ptr[i + 1] - j
        for k in range(nr):
            s[k] = hz[j + k] - e.g[j + k]
        if e.kind[i] == CONTACT_ROLLING:
            natural_rolling(e, i, z + j, s, CONE, 0, f, p)
        else:
            natural_contact(e, i, z + j, s, f, p)
        for k in range(nr):
            total += f[k] * f[k]
            x = fabs(f[k]) * speed[j + k]
            if k == 1 and nr - (e.kind[i] == SPIN) == 3:
                x = sqrt(f[1] * f[1] + f[2] * f[2]) * speed[j + 1]
            if e.kind[i] == CONTACT_ROLLING and (k == 1 or k == nr - 2):
                x = sqrt(f[k] * f[k] + f[k + 1] * f[k + 1]) * speed[j + k]
            worst = x if x > worst else worst
    energy[0] = sqrt(total)
    velocity[0] = worst


cdef inline double z_end(const elements_t* e, int32_t j, double y) noexcept nogil:
    # which bound y is beyond: -1, 1 or 0 for none
    return -1.0 if y < e.lower[j] else 1.0 if y > e.upper[j] else 0.0
