"""Refinement of the judge's pass over J and M, for an M so ill-conditioned that its factor is not accurate enough.

With H = S M S of unit diagonal, S = diag(M)^-1/2, and u = 2^-53, a solve by the factor of M computes x' for x = M^-1 J^T lam with

    |x - x'|_M  <=  n u |H^-1| |x|_M,        |x|_M^2 = x.M x = lam.J x                                        (1)

and the slack of row i, w = J x + c lam - b, has an error of at most sqrt(d_i) |x - x'|_M. Therefore the pass is repeated if

    n u |H^-1| max(1, k / 10)  >  0.1 max(tol, r)                                                             (2)

where k is |x|_M as a relative residual, and r the residual of the first pass. (A bound by k itself is 40 to 2,000 times
too large on random M and on chains of hinges; (2) is 3 to 1,000 times too large.) The correction is x <- x + M^-1 (J^T lam - M x).
Its residual and x are sums of two float64 (Dekker 1971; the halves of a factor are cut off, so that every step is exact, with
and without fused multiply-adds). It is repeated until

    |dx|_M q <= u |x|_M,      q = max(n u |H^-1|, largest ratio of two corrections so far)                     (3)

The floor of row i then also contains |w - w'| + sqrt(2 d_i) |dx|_M q, where w' is the slack of the first pass: a solver that
computes in float64 cannot reduce it. If the corrections do not shrink, twice the last one replaces |dx|_M q. That is 2 |x|_M
if the first correction already fails, so that no small residual is reported.

A pass whose numbers are reported is also repeated if the left side of (2) is above 1e-8, whatever tol is: otherwise a residual
of 1e-13 with a floor of 1e-16 would be reported for an impulse with an error of 1e-8.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, uint64_t
from libc.string cimport memcpy

from lavender_ext.core.dot cimport dot
from lavender_ext.core.condition cimport get_condition
from lavender_ext.core.generalized cimport solve_mass_matrix
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport generalized_t
from lavender_ext.judge.forms cimport score_generalized_slack
from lavender_ext.judge.score cimport relative_residual, score_t, take_smallest_island_reference, unit_roundoff


cdef enum:
    MAX_CORRECTIONS = 16        # Each correction is less than half of the previous one; the last one enters the floor.


cdef inline double min_reported_loss() noexcept nogil:
    """Return the possible error due to the factor of M above which a reported pass is refined, as a relative residual."""
    return 1e-8


# -- sums of two float64 -----------------------------------------------------------------------------


cdef inline double truncate_to_upper_half(double x) noexcept nogil:
    """Return x truncated to its first 26 bits."""
    cdef uint64_t bits
    memcpy(&bits, &x, sizeof(bits))
    bits &= <uint64_t>0xFFFFFFFFF8000000
    memcpy(&x, &bits, sizeof(bits))
    return x


cdef inline void add_product_double_double(double x, double y, double* high, double* low) noexcept nogil:
    """Add x y to high + low."""
    cdef double a = truncate_to_upper_half(x), b = truncate_to_upper_half(y), c = x - a, d = y - b, product = x * y
    cdef double product_error = ((a * b - product) + a * d + c * b) + c * d
    cdef double total = high[0] + product, part = total - high[0]
    low[0] += ((high[0] - (total - part)) + (product - part)) + product_error
    high[0] = total


# -- the pass ----------------------------------------------------------------------------------------


cdef inline double estimate_factor_loss(const blocks_t* p, const generalized_t* g, const double* lam, const double* w, double* x,
                                  double reference_energy, double reference_velocity, double threshold) noexcept nogil:
    """Return the left side of (2), or 0 if it is at most `threshold`.

    w (m) is the slack of the first pass, x (2 n) is scratch.
    """
    cdef int32_t i = 0
    cdef double energy = 0.0, other = 0.0, nu = 0.0, det = 1.0, size
    while i + 2 <= p.n_rows:                            # Two sums halve the latency of the additions.
        energy += lam[i] * (w[i] + (p.b[i] - g.compliance[i] * lam[i]))
        other += lam[i + 1] * (w[i + 1] + (p.b[i + 1] - g.compliance[i + 1] * lam[i + 1]))
        nu = p.nu[i] if p.nu[i] > nu else nu
        nu = p.nu[i + 1] if p.nu[i + 1] > nu else nu
        i += 2
    if i < p.n_rows:
        energy += lam[i] * (w[i] + (p.b[i] - g.compliance[i] * lam[i]))
        nu = p.nu[i] if p.nu[i] > nu else nu
    energy += other
    if g.n == 0 or energy == 0.0:                       # The impulse changes no velocity.
        return 0.0
    energy = sqrt(fabs(energy))                         # `energy` is negative only by rounding.
    take_smallest_island_reference(p, &reference_energy, &reference_velocity)
    size = 0.1 * relative_residual(energy, sqrt(nu) * energy, reference_energy, reference_velocity)
    size = g.n * unit_roundoff() * (size if size > 1.0 else 1.0)
    if g.condition == 0.0:
        # |H^-1| <= e / det H, which follows from trace H = n and is very loose for large n.
        for i in range(g.n):
            det *= g.inv_pivot[i] * g.mval[g.mptr[i + 1] - 1]
        if size * (2.72 * det) <= threshold:
            return 0.0
    size *= get_condition(g, x)
    return size if size > threshold else 0.0


cdef inline double refine_velocity_change(const generalized_t* g, const double* lam, double loss, double* x) noexcept nogil:
    """Compute x + x_low = M^-1 J^T lam by (3) in the first 2 n of x (6 n); return its remaining error in the norm of M.

    loss is n u |H^-1|.
    """
    cdef int32_t i, j, q, n = g.n
    cdef double* x_low = x + n
    cdef double* force = x + 2 * n
    cdef double* force_low = x + 3 * n
    cdef double* r = x + 4 * n
    cdef double* r_low = x + 5 * n
    cdef double norm, last, size, a, total, part, rate = loss if loss < 0.5 else 0.5
    for i in range(n):
        force[i] = force_low[i] = 0.0
    for i in range(g.m):                                # force + force_low = J^T lam
        if lam[i] != 0.0:
            for q in range(g.jptr[i], g.jptr[i + 1]):
                add_product_double_double(g.jval[q], lam[i], force + g.jidx[q], force_low + g.jidx[q])
    for i in range(n):
        x[i] = force[i]
        x_low[i] = 0.0
    solve_mass_matrix(g, x)
    norm = dot(force, x, n)
    norm = last = sqrt(fabs(norm))                    # `norm` is negative only by rounding.
    for _step in range(MAX_CORRECTIONS):
        memcpy(r, force, n * sizeof(double))
        memcpy(r_low, force_low, n * sizeof(double))
        for i in range(n):                              # Subtract M (x + x_low) from r + r_low.
            for q in range(g.mptr[i], g.mptr[i + 1]):
                j = g.midx[q]
                a = -g.mval[q]
                add_product_double_double(a, x[j], r + i, r_low + i)
                r_low[i] += a * x_low[j]
                if j != i:
                    add_product_double_double(a, x[i], r + j, r_low + j)
                    r_low[j] += a * x_low[i]
        for i in range(n):
            r[i] += r_low[i]
            r_low[i] = r[i]
        solve_mass_matrix(g, r_low)                            # Computes the correction.
        size = sqrt(fabs(dot(r, r_low, n)))
        if not size < 0.5 * last:
            return 2.0 * last
        for i in range(n):                              # The rounding error of x + r_low is added to x_low.
            total = x[i] + r_low[i]
            part = total - x[i]
            x_low[i] += (x[i] - (total - part)) + (r_low[i] - part)
            x[i] = total
        if size > rate * last:
            rate = size / last
        last = size
        if size * rate <= unit_roundoff() * norm:
            return size * rate
    return last


cdef inline void refine_generalized_slack(const blocks_t* p, const generalized_t* g, const double* lam, double* w, double* e,
                                          double* scratch, score_t* out) noexcept nogil:
    """Replace w (m) of the first pass by the refined one, with its errors e (m), norms and floor; scratch (6 n + 2 m)."""
    cdef int32_t i, q, n = g.n
    cdef double* extra = scratch
    cdef double* x = scratch + p.n_rows
    cdef double remaining = refine_velocity_change(g, lam, n * unit_roundoff() * get_condition(g, x), x), high, low
    for i in range(p.n_rows):
        high = -p.b[i]
        low = 0.0
        add_product_double_double(g.compliance[i], lam[i], &high, &low)
        for q in range(g.jptr[i], g.jptr[i + 1]):
            add_product_double_double(g.jval[q], x[g.jidx[q]], &high, &low)
            low += g.jval[q] * x[n + g.jidx[q]]
        high += low
        extra[i] = (fabs(high - w[i]) + sqrt(2.0 * p.d[i]) * remaining) / unit_roundoff()
        w[i] = high
    score_generalized_slack(p, g, lam, w, e, x, extra, out)
