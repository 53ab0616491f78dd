"""A warm start carried to the judge's tolerance, on the factored form: few sweeps, or one banded solve.

    judge        lam as it came: relative residual max(E/E0, V/V0) <= tol?                      (1)
    contacts     sequential impulses, judged after 4, 8, 16, 32 and 64 sweeps; from 16 on given up
                 where r_s (r_s / r_s/2)^(2 (64 - s)/s), what 64 would leave, is above tol       (2)
    free joints  A lam = b by LDL^T on the band of A, one round of refinement                   (3)
    contacts     after the sweeps, Newton steps of warm/active_set.pxd                                (4)

The arithmetic of a block and of its error is that of core/block.pxd, in the order of judge/measure.pxd: the residual
found here has the judge's bits. What is not decided here (dependent joints, numbers near the ends of the
range, a residual that stays above tol) is left to the caller, with lam as it came.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block cimport (CONTACT_SPIN, COULOMB, ROW, blocks_t, clip, coulomb_error, n_tangents,
                                      row_error)
from lavender_ext.core.rows cimport contact_slack, joint_velocity, relax_rows_block, rows_t
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.factor.band cimport ldl_factor, ldl_solve, pivots_t
from lavender_ext.warm.active_set cimport body_band, newton_step


cpdef enum:
    FIRST_SWEEPS = 4            # of (2); fewer leave a residual just below tol, and the next step begins above it
    PATIENT_SWEEPS = 16         # from here on (2) is given up where it will not do
    MOST_SWEEPS = 64
    MOST_STEPS = 6              # of (4)
    MOST_ROWS = 200000          # so that all of it takes a fraction of a second
    MOST_BAND = 48              # rows between the first and the last of one body's joints, for (3)

cpdef enum:                     # how it ended
    UNDECIDED = 0
    JUDGED = 1                  # met tol as it came
    SWEPT = 2                   # met it after some sweeps
    SOLVED = 3                  # met it after one factorisation
    STEPPED = 4                 # met it after sweeps and Newton steps


cdef struct score_sums_t:
    double energy               # sum d e^2
    double velocity             # max nu d e^2, a pair's together
    double normal               # N s, max |e_n| over the contacts
    double closing              # m/s, max(0, -w_n) over the contacts


cdef struct warm_t:
    double* nu                  # (m)
    double* kept                # (m) lam as it came
    double* band                # (m, width) of (3)
    double* change              # (n_bodies, 6) of Newton steps
    double* slack               # (m)
    int32_t* state              # (c)
    int32_t* last               # (n_bodies) last joint seen on a body
    int32_t* before             # (2 kj) the one before on the same body: 2 joint + side, or -1
    int32_t width               # of the band, 0 where neither (3) nor (4) applies
    int32_t sweeps              # done
    int32_t factorisations      # done
    double relative             # of lam as it is left


cdef inline void joint_weights(const blocks_t* p, const rows_t* r, double* nu) noexcept nogil:
    # nu of every row: d; of a spin row d of its normal; of an angular joint row 1/m_a + 1/m_b
    cdef int32_t i, j, q, t, a, b
    cdef double linear, inv
    for i in range(p.n_blocks):
        j = p.ptr[i]
        for q in range(j, p.ptr[i + 1]):
            nu[q] = p.d[q]
        if p.kind[i] == CONTACT_SPIN:
            nu[p.ptr[i + 1] - 1] = p.d[j]
    for i in range(r.n_joints):
        a = r.joint_body[2 * i]
        b = r.joint_body[2 * i + 1]
        for q in range(p.ptr[i], p.ptr[i + 1]):
            linear = 0.0
            for t in range(3):
                linear += ((r.jac[12 * q + t] if r.jac[12 * q + t] > 0.0 else -r.jac[12 * q + t])
                           + (r.jac[12 * q + 6 + t] if r.jac[12 * q + 6 + t] > 0.0
                              else -r.jac[12 * q + 6 + t]))
            if linear == 0.0:
                inv = 0.0
                if a >= 0:
                    inv += r.inv_mass[a]
                if b >= 0:
                    inv += r.inv_mass[b]
                if inv > 0.0:
                    nu[q] = inv


cdef inline void add_joint(const blocks_t* p, const rows_t* r, const double* nu, int32_t i, const double* lam,
                           const double* v, score_sums_t* s) noexcept nogil:
    cdef int32_t j, a = r.joint_body[2 * i], b = r.joint_body[2 * i + 1]
    cdef double w, e, x, t
    for j in range(p.ptr[i], p.ptr[i + 1]):
        w = joint_velocity(r.jac + 12 * j, v, a, b) + (r.compliance[j] * lam[j] - p.b[j])
        e = row_error(lam[j], w, p.d[j], p.lower[j], p.upper[j])
        x = p.d[j] * e
        s.energy += x * e
        t = x * (nu[j] * e)
        if not t <= s.velocity:
            s.velocity = t


cdef inline void add_contact(const blocks_t* p, const rows_t* r, const double* nu, int32_t i, int32_t nt,
                             int32_t spin, const double* lam, const double* v, score_sums_t* s) noexcept nogil:
    cdef int32_t k, j = p.ptr[i]
    cdef double w[4]
    cdef double e[4]
    cdef double x, t
    contact_slack(r, i - r.n_joints, nt, spin, v, w)
    for k in range(1 + nt + spin):
        w[k] = w[k] + (r.compliance[j + k] * lam[j + k] - p.b[j + k])
    coulomb_error(lam + j, w, p.d + j, p.mu[i], p.patch_radius[i], nt, spin, e)
    x = e[0] if e[0] > 0.0 else -e[0]
    if not x <= s.normal:
        s.normal = x
    if not -w[0] <= s.closing:
        s.closing = -w[0]
    for k in range(1 + nt + spin):
        x = p.d[j + k] * e[k]
        s.energy += x * e[k]
        t = x * (nu[j + k] * e[k])
        if nt == 2 and k == 1:
            t += (p.d[j + 1] * e[2]) * (nu[j + 1] * e[2])
        if not (nt == 2 and k == 2) and not t <= s.velocity:
            s.velocity = t


cdef inline void score(const blocks_t* p, const rows_t* r, const double* nu, const double* lam, const double* v,
                       score_sums_t* s) noexcept nogil:
    """The sums over all rows, v = M^-1 J^T lam; NaN is kept."""
    cdef int32_t i, j, nt
    s.energy = 0.0
    s.velocity = 0.0
    s.normal = 0.0
    s.closing = 0.0
    for i in range(r.n_joints):
        add_joint(p, r, nu, i, lam, v, s)
    for i in range(r.n_joints, p.n_blocks):
        j = p.ptr[i]
        nt = n_tangents(p.kind[i], p.ptr[i + 1] - j)
        # the common kind with its size as constants, so that a compiler unrolls it
        if nt == 2 and p.kind[i] != CONTACT_SPIN:
            add_contact(p, r, nu, i, 2, 0, lam, v, s)
        else:
            add_contact(p, r, nu, i, nt, p.kind[i] == CONTACT_SPIN, lam, v, s)


cdef inline int32_t start_sums(const blocks_t* p, const double* nu, double* energy, double* velocity) noexcept nogil:
    """E0^2, V0^2 of lam = 0, w = -b; 0 where they are not plainly the judge's."""
    cdef int32_t i, j
    cdef double e, x, t, sum = 0.0, big = 0.0, rhs = 0.0, least = 1.0 / 0.0, inf = 1.0 / 0.0
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            if not 0.0 < p.d[j] < inf:
                return 0
            least = p.d[j] if p.d[j] < least else least
            rhs += p.b[j] * p.b[j]
            if p.kind[i] == ROW:
                if not p.lower[j] <= 0.0 <= p.upper[j]:
                    return 0
                e = row_error(0.0, -p.b[j], p.d[j], p.lower[j], p.upper[j])
            elif j == p.ptr[i]:
                e = row_error(0.0, -p.b[j], p.d[j], 0.0, inf)
            else:
                continue                                # a disk of radius 0 holds it: e = 0
            x = p.d[j] * e
            sum += x * e
            t = x * (nu[j] * e)
            if not t <= big:
                big = t
    energy[0] = sum
    velocity[0] = big
    # below 2^-48 of the norm of b the judge measures by that
    return 1e-250 < sum < 1e250 and 1e-250 < big < 1e250 and sum * least > 1.3e-29 * rhs


cdef inline double relative_of(const score_sums_t* s, double e0, double v0) noexcept nogil:
    # e0, v0 are E0, V0; infinite where the sums leave the plain range
    cdef double x, y
    if s.energy == 0.0 and s.velocity == 0.0:
        return 0.0
    if not (1e-250 < s.energy < 1e250 and 1e-250 < s.velocity < 1e250):
        return 1.0 / 0.0
    x = sqrt(s.energy) / e0
    y = sqrt(s.velocity) / v0
    return x if x > y else y


cdef inline int32_t band_width(const blocks_t* p, const rows_t* r, int32_t* last) noexcept nogil:
    """Width of the band of A in the given order, joints alone and all free, or of N; 0 where none applies."""
    cdef int32_t i, j, h, b, width = 1
    if r.n_contacts > 0:
        return body_band(p, r)
    if r.n_joints == 0:
        return 0
    for b in range(r.n_bodies):
        last[b] = -1
    for i in range(r.n_joints):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            if p.lower[j] > -1.7976931348623157e308 or p.upper[j] < 1.7976931348623157e308:
                return 0
        if p.ptr[i + 1] - p.ptr[i] > width:
            width = p.ptr[i + 1] - p.ptr[i]
        for h in range(2):
            b = r.joint_body[2 * i + h]
            if b < 0:
                continue
            if last[b] < 0:
                last[b] = p.ptr[i]
            elif p.ptr[i + 1] - last[b] > width:
                width = p.ptr[i + 1] - last[b]
    return width if width <= MOST_BAND else 0


cdef inline double dot6(const double* x, const double* y) noexcept nogil:
    return ((x[0] * y[0] + x[1] * y[1]) + (x[2] * y[2] + x[3] * y[3])) + (x[4] * y[4] + x[5] * y[5])


cdef inline void fill_band(const blocks_t* p, const rows_t* r, warm_t* s) noexcept nogil:
    # band[i width + t] = A[i + t, i], over the joints of each body
    cdef int32_t i, k, q, j, h, g, b, at
    for b in range(r.n_bodies):
        s.last[b] = -1
    for i in range(p.n_rows * s.width):
        s.band[i] = 0.0
    for i in range(r.n_joints):
        for h in range(2):
            b = r.joint_body[2 * i + h]
            if b < 0:
                continue
            s.before[2 * i + h] = s.last[b]
            s.last[b] = 2 * i + h
            at = s.last[b]
            while at >= 0:
                k = at >> 1
                g = at & 1
                for j in range(p.ptr[i], p.ptr[i + 1]):
                    for q in range(p.ptr[k], p.ptr[k + 1]):
                        if q <= j:
                            s.band[<int64_t>q * s.width + (j - q)] += dot6(r.jac + 12 * j + 6 * h,
                                                                           r.minv_jac + 12 * q + 6 * g)
                at = s.before[at]
    for j in range(p.n_rows):
        s.band[<int64_t>j * s.width] += r.compliance[j]


cdef inline double judged(const blocks_t* p, const rows_t* r, warm_t* s, const double* lam, double* v, double e0,
                          double v0, score_sums_t* out) noexcept nogil:
    # with v formed anew, as the judge does
    rows_velocity(p, r, lam, v)
    score(p, r, s.nu, lam, v, out)
    return relative_of(out, e0, v0)


cdef inline int32_t solve_joints(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double e0, double v0,
                                 double* lam, double* v, score_sums_t* out) noexcept nogil:
    """(3)"""
    cdef pivots_t pivot
    cdef int32_t i, j, turn
    fill_band(p, r, s)
    s.factorisations = 1
    ldl_factor(p.n_rows, s.width, s.band, p.d, 1e-13, NULL, &pivot)
    if pivot.small or pivot.negative:
        return UNDECIDED
    for j in range(p.n_rows):
        lam[j] = p.b[j]
    ldl_solve(p.n_rows, s.width, s.band, lam)
    for turn in range(2):
        s.relative = judged(p, r, s, lam, v, e0, v0, out)
        if s.relative <= tol:
            return SOLVED
        if turn == 0:                                   # lam <- lam - A^-1 w
            for i in range(r.n_joints):
                for j in range(p.ptr[i], p.ptr[i + 1]):
                    s.nu[j] = (joint_velocity(r.jac + 12 * j, v, r.joint_body[2 * i], r.joint_body[2 * i + 1])
                               + (r.compliance[j] * lam[j] - p.b[j]))
            ldl_solve(p.n_rows, s.width, s.band, s.nu)
            for j in range(p.n_rows):
                lam[j] -= s.nu[j]
            joint_weights(p, r, s.nu)
    return UNDECIDED


cdef inline int32_t sweep_contacts(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double e0, double v0,
                                   double* lam, double* v, score_sums_t* out) noexcept nogil:
    """(2)"""
    cdef int32_t i, n = 0, last = 0, next_ = FIRST_SWEEPS, most = MOST_SWEEPS, patient = PATIENT_SWEEPS
    cdef double before, now = s.relative, ahead
    if s.width > 0:                                     # (4) costs less than many sweeps
        most = PATIENT_SWEEPS
        patient = FIRST_SWEEPS
    while n < most:
        while n < next_:
            for i in range(p.n_blocks):
                relax_rows_block(p, r, i, lam, v)
            n += 1
        s.sweeps = n
        before = now
        score(p, r, s.nu, lam, v, out)
        now = relative_of(out, e0, v0)
        if now <= tol:
            s.relative = judged(p, r, s, lam, v, e0, v0, out)
            if s.relative <= tol:
                return SWEPT
        if n >= patient:
            ahead = now
            i = n
            while i < most:
                ahead = ahead * (now / before)
                i += n - last
            if not ahead <= tol:
                return UNDECIDED
        last = n
        next_ = 2 * n
    return UNDECIDED


cdef inline int32_t step_contacts(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double e0, double v0,
                                  double* lam, double* v, score_sums_t* out) noexcept nogil:
    """(4)"""
    cdef double before = s.relative, eps
    while s.factorisations < MOST_STEPS:
        s.factorisations += 1
        # what no impulse of the set can meet moves lam by w / (eps d): a tenth of b / d
        eps = clip(10.0 * s.relative, 1e-8, 1e-4)
        if not newton_step(p, r, s.state, s.width, s.band, eps, 0.3 * tol * e0 / sqrt(p.n_rows), 0.3 * tol * v0, lam, v,
                           s.change, s.slack):
            return UNDECIDED
        s.relative = judged(p, r, s, lam, v, e0, v0, out)
        if s.relative <= tol:
            return STEPPED
        if not s.relative < 1e3 * before:
            return UNDECIDED
    return UNDECIDED


cdef inline int32_t warm_solve(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double* lam, double* v,
                               int32_t has_velocity, score_sums_t* first, score_sums_t* last) noexcept nogil:
    """lam (m), not all zero, to tol; v (n_bodies, 6) is left M^-1 J^T lam, given so with `has_velocity`.

    first, last: sums of lam as it came and as it is left; written where this is decided.
    """
    cdef double e0, v0
    cdef int32_t j, found, cold = 1
    s.sweeps = 0
    s.factorisations = 0
    for j in range(p.n_rows):
        if lam[j] != 0.0:
            cold = 0
            break
    if cold or p.n_rows > MOST_ROWS:
        return UNDECIDED
    joint_weights(p, r, s.nu)
    if not has_velocity:
        rows_velocity(p, r, lam, v)
    score(p, r, s.nu, lam, v, first)
    last[0] = first[0]
    if p.law != COULOMB or not start_sums(p, s.nu, &e0, &v0):
        return UNDECIDED
    e0 = sqrt(e0)
    v0 = sqrt(v0)
    s.relative = relative_of(first, e0, v0)
    if s.relative <= tol:
        return JUDGED
    for j in range(p.n_rows):
        s.kept[j] = lam[j]
    found = UNDECIDED
    if r.n_contacts > 0:
        found = sweep_contacts(p, r, s, tol, e0, v0, lam, v, last)
        if found == UNDECIDED and s.width > 0:
            rows_velocity(p, r, lam, v)
            found = step_contacts(p, r, s, tol, e0, v0, lam, v, last)
    elif s.width > 0:
        found = solve_joints(p, r, s, tol, e0, v0, lam, v, last)
    if found == UNDECIDED:
        for j in range(p.n_rows):
            lam[j] = s.kept[j]
        rows_velocity(p, r, lam, v)
        last[0] = first[0]
    return found
