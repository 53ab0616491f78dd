"""Detect stalled runs of sweeps from the residuals r of the checks and the motion of the impulses.

A run of t sweeps has stalled unless its residual has risen sharply (f > 3/2) or one of two events is predicted within 64 t
further sweeps:

    The residual halves. With the lower envelope f = min r in (t/2, t] / min r in (t/4, t/2], with minima that are k sweeps
    apart, r f^(n/k) <= best / 2 after n sweeps                                                 (1)
    A plateau ends. A row with an impulse that moved in one direction over the last three checks reaches a bound or the boundary
    of its cone at the slower of its two speeds                                                 (2)

A residual that oscillates while it falls has a falling envelope. On a plateau the residual is constant while an impulse
moves to its bound, and falls afterwards. In a cycle no row keeps its direction, and infeasible rows approach no bound.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t
from libc.string cimport memcpy

from lavender_ext.core.block cimport norm2
from lavender_ext.core.block_types cimport blocks_t, has_independent_rows, get_friction_components, friction_components_t


cdef enum:
    N_STORED_CHECKS = 32        # Eight to sixteen of these checks lie in (t/4, t].
    HORIZON_RATIO = 64          # Events are predicted for this multiple of the sweeps done.


cdef struct progress_t:
    int32_t n                   # number of checks; check k has index k % N_STORED_CHECKS
    int32_t at[N_STORED_CHECKS]     # sweeps at each check
    double r[N_STORED_CHECKS]       # relative residual at each check
    int32_t last_at             # sweeps at which `last` was stored, -1 if it was not
    int32_t before_at           # sweeps at which `before` was stored, -1 if it was not
    double* last                # (m) N s, impulse of the last check
    double* before              # (m) N s, impulse of the check before


cdef inline void record_impulse(progress_t* s, int32_t at, const double* lam, int32_t m) noexcept nogil:
    """Store the impulse lam (m) of a check after `at` sweeps."""
    cdef double* x = s.before
    s.before = s.last
    s.before_at = s.last_at
    s.last = x
    s.last_at = at
    memcpy(x, lam, m * sizeof(double))


cdef inline int32_t residual_envelope_slope(const progress_t* s, double* fall, double* low) noexcept nogil:
    """Return k of (1) at the last check, or 0 if there are too few checks; write f to `fall` and the later minimum to `low`."""
    cdef int32_t i = s.n - 1, first = s.n - N_STORED_CHECKS if s.n > N_STORED_CHECKS else 0, t, at, late_at = 0, early_at = 0
    cdef double late = 1.0 / 0.0, early = 1.0 / 0.0, r
    t = s.at[i % N_STORED_CHECKS] if i >= 0 else 0
    while i >= first and s.at[i % N_STORED_CHECKS] > t // 4:
        at = s.at[i % N_STORED_CHECKS]
        r = s.r[i % N_STORED_CHECKS]
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


cdef inline bint residual_reaches_target(const progress_t* s, double target, double max_sweeps) noexcept nogil:
    """Return whether the envelope reaches `target` within `max_sweeps` sweeps (1), or has risen sharply."""
    cdef double fall, r, n = 0.0
    cdef int32_t k = residual_envelope_slope(s, &fall, &r)
    if k == 0 or not fall < 1.0:
        return k > 0 and fall > 1.5
    while r > target and n <= max_sweeps:
        r *= fall
        n += k
    return n <= max_sweeps


cdef inline double compute_row_speed(const progress_t* s, const double* lam, int32_t now, int32_t i) noexcept nogil:
    """Return the slower of the last two speeds of row i [N s per sweep], 0 if its direction changed."""
    cdef double x = (lam[i] - s.last[i]) / (now - s.last_at), y = (s.last[i] - s.before[i]) / (s.last_at - s.before_at)
    if not x * y > 0.0:
        return 0.0
    return x if fabs(x) < fabs(y) else y


cdef inline bint closes_gap_within(double gap, double closing_speed, double max_sweeps) noexcept nogil:
    """Return whether a positive gap [N s] closes within `max_sweeps` sweeps."""
    return gap > 0.0 and closing_speed > 0.0 and gap <= max_sweeps * closing_speed


cdef inline bint any_row_reaches_bound(const progress_t* s, const blocks_t* p, const double* lam, int32_t now,
                                       double max_sweeps) noexcept nogil:
    """Return whether (2) holds for a row within `max_sweeps` sweeps."""
    cdef int32_t i, j, k, g
    cdef double v, rate, size, along, slope
    cdef friction_components_t q
    if not now > s.last_at > s.before_at >= 0:
        return False
    for i in range(p.n_blocks):
        j = p.ptr[i]
        if has_independent_rows(p, i):
            for k in range(j, p.ptr[i + 1]):
                v = compute_row_speed(s, lam, now, k)
                if closes_gap_within(lam[k] - p.lower[k], -v, max_sweeps) or closes_gap_within(p.upper[k] - lam[k], v, max_sweeps):
                    return True
            continue
        if not lam[j] > 0.0:
            continue
        rate = compute_row_speed(s, lam, now, j)
        if closes_gap_within(lam[j], -rate, max_sweeps):
            return True
        get_friction_components(p, i, &q)
        for g in range(q.n):                            # Does the norm of these rows reach its bound, slope times the normal?
            size = along = v = 0.0
            for k in range(j + q.first[g], j + q.first[g] + q.size[g]):
                size = norm2(size, lam[k])
                along += lam[k] * compute_row_speed(s, lam, now, k)
                v = norm2(v, compute_row_speed(s, lam, now, k))
            slope = q.friction_coefficient[g]
            if closes_gap_within(slope * lam[j] - size, (along / size if size > 0.0 else v) - slope * rate, max_sweeps):
                return True
    return False


cdef inline bint has_stalled(const progress_t* s, const blocks_t* p, const double* lam, int32_t now,
                             double best) noexcept nogil:
    """Return whether neither (1) nor (2) is predicted after `now` sweeps with the impulse lam (m)."""
    cdef double max_sweeps = HORIZON_RATIO * <double>now
    return not (residual_reaches_target(s, 0.5 * best, max_sweeps) or any_row_reaches_bound(s, p, lam, now, max_sweeps))
