"""The judge for other modules: the pass is compiled once, in `measure.pyx`."""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.validate cimport all_finite as is_finite
from lavender_ext.core.block_types cimport blocks_t, islands_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.start cimport clip_zero_to_row_bounds
from lavender_ext.core.view cimport generalized_t, view_t
from lavender_ext.judge.best cimport count_islands
from lavender_ext.judge.score cimport floor_hides_residual, is_at_floor, relative_residual, score_t


cdef inline int64_t count_judge_scratch(const view_t* v) noexcept nogil:
    """Return the number of scratch doubles of `judge_view`, and over J and M of its refinement (judge/refine.pxd)."""
    if v.g != NULL:
        return 6 * <int64_t>v.g.n + 2 * <int64_t>v.p.n_rows
    return (12 * <int64_t>v.r.n_bodies if v.r != NULL else 0) + v.p.n_rows


cdef void judge_view(const view_t* v, const double* lam, double* w, double* e, double* scratch, bint floor,
                     score_t* out) noexcept nogil
cdef bint refine_view(const view_t* v, const double* lam, double* w, double* e, double* scratch, double reference_energy,
                      double reference_velocity, double tol, double relative_, score_t* out) noexcept nogil
cdef bint refine_reported_view(const view_t* v, const double* lam, double* w, double* e, double* scratch, double reference_energy,
                               double reference_velocity, double tol, double relative_, score_t* out) noexcept nogil
cdef void score_given_generalized_slack(const blocks_t* p, const generalized_t* g, const double* lam, const double* w,
                                        double* e, double* x, score_t* out) noexcept nogil
cdef void score_given_slack(const blocks_t* p, const double* lam, const double* w, double* e, score_t* out) noexcept nogil
cdef void find_reference(blocks_t* p, const double* x, const double* w, const double* e, double* out) noexcept nogil
cdef bint judge_zero_impulse(view_t* v, int32_t* index, islands_t* islands, double* reference, const int32_t* empty,
                             const double* free, double* terms, double* x, double* w, double* e, double* scratch,
                             double* out) noexcept nogil


cdef void choose_start(const view_t* v, bint symmetric, const double* zero_residual, double tol, double* lam,
                       double* scratch) noexcept nogil


cdef inline int64_t count_start_scratch(const view_t* v) noexcept nogil:
    """Return the number of scratch doubles of `choose_start`."""
    return 2 * <int64_t>v.p.n_rows + 2 * count_islands(&v.p) + count_judge_scratch(v)


# -- the zero impulse, and a pass over an impulse relative to it -----------------------------------------


cdef inline bint set_zero_impulse(const blocks_t* p, double* x, double* w) noexcept nogil:
    """Write x (m) = Pi(0) and w (m) = -b, the slack of the zero vector; return whether x is nonzero."""
    cdef int32_t i
    cdef bint moves = False
    for i in range(p.n_rows):
        x[i] = clip_zero_to_row_bounds(p, i)
        moves |= x[i] != 0.0
        w[i] = -p.b[i]
    return moves


cdef inline double relative_residual_of_score(const score_t* s, const double* w, int32_t m, double reference_energy,
                                              double reference_velocity) noexcept nogil:
    """Return the relative residual of a pass with slack w (m); inf if a number is not finite.

    If the pass computed a floor of at least 1e-3, the result is at least that floor: the impulse is so large that rounding
    hides a thousandth of the error of the zero impulse, and even a computed slack of 0 is meaningless.
    """
    cdef double now, floor
    if s.relative >= 0.0:
        return s.relative
    # A bound can hide an overflowed slack, which has no meaningful sign.
    if m > 0 and not is_finite(w, m):
        return 1.0 / 0.0
    if not s.finite:
        return relative_residual(1.0 / 0.0, 1.0 / 0.0, reference_energy, reference_velocity)
    now = relative_residual(s.energy, s.velocity, reference_energy, reference_velocity)
    floor = relative_residual(s.floor_energy, s.floor_velocity, reference_energy, reference_velocity)
    return floor if floor_hides_residual(floor) and floor < 1.0 / 0.0 and floor > now else now


cdef inline double relative_floor_of_score(const score_t* s, double reference_energy, double reference_velocity) noexcept nogil:
    """Return the floor of a pass as a relative residual; with islands, the floor of the island with the largest residual."""
    return s.floor if s.relative >= 0.0 else relative_residual(s.floor_energy, s.floor_velocity, reference_energy,
                                                               reference_velocity)


cdef inline double residual_above_floor(const score_t* s, double now, double floor) noexcept nogil:
    """Return the relative residual that rounding does not explain, 0 if it explains all.

    now and floor are the results of `relative_residual_of_score` and `relative_floor_of_score`.
    """
    return s.above_floor if s.relative >= 0.0 else 0.0 if is_at_floor(now, floor) else now


cdef class Judged:
    cdef readonly Data data                             # problem data
    cdef readonly object impulse                        # (m,) N s
    cdef object both                                    # w (m,) m/s, then e (m,) N s
    cdef readonly double energy, velocity               # sqrt J, m/s; inf if e is not finite
    cdef readonly double floor_energy                   # sqrt J, energy error that rounding explains
    cdef readonly double relative, roundoff_floor       # relative residual and its floor, -
    cdef readonly double above_floor                    # relative residual that rounding does not explain, -
    cdef readonly double float64_relative               # relative residual before refinement; NaN if it was not refined
    cdef double known_loss                              # `loss`, negative before it is computed
    cdef readonly int worst                             # row of the largest velocity error, or -1
    cdef readonly int island                            # island with the largest relative residual, or -1

    cdef void set_score(self, Data p, object impulse, object both, const score_t* s, double relative_, double floor,
                        double float64_relative)


cdef Judged make_judged(Data p, object impulse, object both, const score_t* s, double relative_, double floor,
                        double float64_relative=*)
