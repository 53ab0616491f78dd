"""Whether a run of sweeps still gets anywhere: by the residuals r of its checks, and by where its impulses go.

A run of t sweeps rests where its residual has not leapt up (f > 3/2) and neither of these comes within 64 t more:

    half of the best, by the lower envelope: f = least r in (t/2, t] / least r in (t/4, t/2], k sweeps apart,
    r f^(n/k) <= best / 2 after n                                                               (1)
    the end of a plateau: a row that moved one way from check to check, by the last three, at the slower of both
    speeds, meets a bound or leaves its cone                                                    (2)

A residual that swings as it falls has a falling envelope. On a plateau it stands still while some impulse is carried
to its bound, and falls behind that. In a cycle no row keeps its way, and infeasible rows have no bound in sight.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t
from libc.string cimport memcpy

from lavender_ext.core.block cimport norm2
from lavender_ext.core.block_types cimport blocks_t, is_rows, get_friction_components, friction_components_t


cdef enum:
    CHECKS = 32                 # kept: eight to sixteen lie in (t/4, t]
    HORIZON = 64                # sweeps that are looked ahead, for each one done


cdef struct progress_t:
    int32_t n                   # checks so far; check k stands in place k % CHECKS
    int32_t at[CHECKS]          # sweeps
    double r[CHECKS]            # relative residual
    int32_t last_at             # sweeps at which `last`
    int32_t before_at           # and `before` were kept; -1: they were not
    double* last                # (m) N s, of the last check
    double* before              # (m) N s, of the one before


cdef inline void open_progress(progress_t* s, double* workspace, int32_t m) noexcept nogil:
    """Before the first check; workspace (2 m)."""
    s.n = 0
    s.last_at = s.before_at = -1
    s.last = workspace
    s.before = workspace + m


cdef inline void see(progress_t* s, int32_t at, double r) noexcept nogil:
    s.at[s.n % CHECKS] = at
    s.r[s.n % CHECKS] = r
    s.n += 1


cdef inline void keep(progress_t* s, int32_t at, const double* lam, int32_t m) noexcept nogil:
    cdef double* x = s.before
    s.before = s.last
    s.before_at = s.last_at
    s.last = x
    s.last_at = at
    memcpy(x, lam, m * sizeof(double))


cdef inline int32_t envelope(const progress_t* s, double* fall, double* low) noexcept nogil:
    """k, f and the later of the two minima, at the last check; k = 0 where there are too few checks."""
    cdef int32_t i = s.n - 1, first = s.n - CHECKS if s.n > CHECKS else 0, t, at, late_at = 0, early_at = 0
    cdef double late = 1.0 / 0.0, early = 1.0 / 0.0, r
    t = s.at[i % CHECKS] if i >= 0 else 0
    while i >= first and s.at[i % CHECKS] > t // 4:
        at = s.at[i % CHECKS]
        r = s.r[i % CHECKS]
        if at > t // 2:
            if r < late:
                late = r
                late_at = at
        elif r < early:
            early = r
            early_at = at
        i -= 1
    low[0] = late
    fall[0] = late / early
    return late_at - early_at if late < 1.0 / 0.0 and early < 1.0 / 0.0 else 0


cdef inline bint moves(const progress_t* s, double aim, double most) noexcept nogil:
    """(1): whether the envelope meets `aim` within `most` sweeps, or has leapt up: then it has not come to rest yet."""
    cdef double fall, r, n = 0.0
    cdef int32_t k = envelope(s, &fall, &r)
    if k == 0 or not fall < 1.0:
        return k > 0 and fall > 1.5
    while r > aim and n <= most:
        r *= fall
        n += k
    return n <= most


cdef inline double speed(const progress_t* s, const double* lam, int32_t now, int32_t i) noexcept nogil:
    """N s a sweep of row i, the slower of its last two; 0 where it turned."""
    cdef double x = (lam[i] - s.last[i]) / (now - s.last_at), y = (s.last[i] - s.before[i]) / (s.last_at - s.before_at)
    if not x * y > 0.0:
        return 0.0
    return x if fabs(x) < fabs(y) else y


cdef inline bint meets(double gap, double closing, double most) noexcept nogil:
    return gap > 0.0 and closing > 0.0 and gap <= most * closing


cdef inline bint meets_disk(const progress_t* s, const double* lam, int32_t now, int32_t first, int32_t end, double slope,
                            double normal, double rate, double most) noexcept nogil:
    # rows first to end, whose norm is at most slope times the normal
    cdef double size = 0.0, along = 0.0, v = 0.0
    cdef int32_t k
    for k in range(first, end):
        size = norm2(size, lam[k])
        along += lam[k] * speed(s, lam, now, k)
        v = norm2(v, speed(s, lam, now, k))
    return meets(slope * normal - size, (along / size if size > 0.0 else v) - slope * rate, most)


cdef inline bint meets_bound(const progress_t* s, const blocks_t* p, const double* lam, int32_t now,
                             double most) noexcept nogil:
    """(2): whether a row does within `most` sweeps."""
    cdef int32_t i, j, k, g
    cdef double v, rate
    cdef friction_components_t q
    if not now > s.last_at > s.before_at >= 0:
        return False
    for i in range(p.n_blocks):
        j = p.ptr[i]
        if is_rows(p, i):
            for k in range(j, p.ptr[i + 1]):
                v = speed(s, lam, now, k)
                if meets(lam[k] - p.lower[k], -v, most) or meets(p.upper[k] - lam[k], v, most):
                    return True
            continue
        if not lam[j] > 0.0:
            continue
        rate = speed(s, lam, now, j)
        if meets(lam[j], -rate, most):
            return True
        get_friction_components(p, i, &q)
        for g in range(q.n):
            k = j + q.first[g]
            if meets_disk(s, lam, now, k, k + q.size[g], q.friction_coefficient[g], lam[j], rate, most):
                return True
    return False


cdef inline bint rests(const progress_t* s, const blocks_t* p, const double* lam, int32_t now,
                       double best) noexcept nogil:
    """Nothing is in sight of what was last seen, at sweep `now` with the impulse lam (m)."""
    cdef double most = HORIZON * <double>now
    return not (moves(s, 0.5 * best, most) or meets_bound(s, p, lam, now, most))
