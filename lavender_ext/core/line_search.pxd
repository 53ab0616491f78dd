"""The length t of a Newton step, for `newton` and `velocity_newton`.

    convex function       |f'(t)| <= |f'(0)| / 10                      doubling, then regula falsi               (1)
    any other system      |F(t)| <= (1 - 1e-4 t) max |F| of the last steps      halving                          (2)

(1) descends on the convex functions of `velocity_newton/newton.pxd`. (2), a non-monotone line search (Grippo, Lampariello,
Lucidi 1986), serves damped Newton (`newton/damped_newton.pxd`) and Coulomb's law over velocities. Elsewhere interior points
keep a fraction of the distance to the boundary (newton/interior.pxd), Euler steps halve t until |F| falls (newton/flow.pxd),
a path halves its predictor (newton/path.pxd), and exchanges take t = 1 (newton/active_set.pxd). The caller of (1) evaluates f':

    begin_line_search(&x, slope)
    while not narrow_line_search(&x, f'(x.t)): pass             x.t is the length, 0 if f' is not a number
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t


cdef enum:
    MAX_LINE_EVALUATIONS = 24   # Largest number of evaluations in one line search (1).


cdef struct line_t:
    double t                    # the length to evaluate next, or the result
    double enough               # a slope of at most this size ends the search
    double low                  # bracket of the minimum, if `is_bracketed`
    double high
    double at_low               # slopes at its ends
    double at_high
    int32_t side                # end that the last evaluation replaced: -1 low, 1 high
    int32_t is_bracketed
    int32_t evaluations


cdef inline void begin_line_search(line_t* x, double slope) noexcept nogil:
    """Begin (1) at t = 1; slope < 0 is f'(0)."""
    x.t, x.enough, x.low, x.at_low = 1.0, -0.1 * slope, 0.0, slope
    x.side = x.is_bracketed = x.evaluations = 0


cdef inline bint narrow_line_search(line_t* x, double slope) noexcept nogil:
    """Use f' at x.t; return whether x.t is the result, else it is the next length to evaluate."""
    x.evaluations += 1
    if not x.is_bracketed:
        if slope < -x.enough and x.evaluations < MAX_LINE_EVALUATIONS // 2:     # The minimum is at a larger t.
            x.low, x.at_low, x.t = x.t, slope, 2.0 * x.t
            return False
        if fabs(slope) <= x.enough or slope < 0.0 or slope != slope:
            x.t = x.t if slope == slope else 0.0
            return True
        x.is_bracketed, x.high, x.at_high = 1, x.t, slope
    elif fabs(slope) <= x.enough:
        return True
    elif slope < 0.0:
        x.low, x.at_low = x.t, slope
        x.at_high *= 0.5 if x.side < 0 else 1.0
        x.side = -1
    else:
        x.high, x.at_high = x.t, slope
        x.at_low *= 0.5 if x.side > 0 else 1.0
        x.side = 1
    if x.evaluations >= MAX_LINE_EVALUATIONS:
        return True
    x.t = x.low - x.at_low * (x.high - x.low) / (x.at_high - x.at_low)     # Illinois variant (Dowell, Jarratt 1971)
    if not x.low < x.t < x.high:
        x.t = 0.5 * (x.low + x.high)
    return False


cdef inline bint is_reduction_sufficient(double size, double t, double bound) noexcept nogil:
    """Return whether |F| = `size` at t satisfies (2); `bound` is the largest |F| of the last steps."""
    return size <= (1.0 - 1e-4 * t) * bound
