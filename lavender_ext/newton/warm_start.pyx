"""First phase of Newton's method from a warm start; `warm_start.pxd` has the equations."""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles
from lavender_ext.core.block cimport compute_row_error
from lavender_ext.core.block_types cimport COULOMB, blocks_t, has_independent_rows
from lavender_ext.core.deadline cimport get_pointer, has_passed
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport dot6
from lavender_ext.core.start cimport is_zero_impulse
from lavender_ext.core.velocity cimport compute_velocity_change
from lavender_ext.core.view cimport rows_t
from lavender_ext.factor.linear cimport analyse_band, factor_linear_system_matrix, solve_linear_system, linear_t
from lavender_ext.judge.bounds cimport project_on_bounds
from lavender_ext.judge.best cimport begin_at_better_point
from lavender_ext.judge.measure cimport score_given_slack
from lavender_ext.judge.score cimport make_empty_score, relative_residual, score_t
from lavender_ext.judge.slack cimport compute_body_slack
from lavender_ext.judge.tally cimport make_empty_tally, add_row_error, tally_t
from lavender_ext.newton.warm_start cimport (FIRST_SWEEP_CHECK, JUDGED, MAX_BAND_WIDTH, MAX_TRACED_SCORES,
                                             MAX_WARM_ROWS, MAX_WARM_SWEEPS, MIN_SWEEPS_TO_GIVE_UP, SOLVED, SWEPT,
                                             UNDECIDED, bind_warm_start, warm_t)
from lavender_ext.sweep.pgs cimport sweep_bodies_in_sequence


cdef int32_t zero_impulse_errors(const blocks_t* p, double* energy, double* velocity) noexcept nogil:
    """Compute the errors E0, V0 of lam = 0, for which w = -b; return 0 if the judge may use another reference."""
    cdef int32_t i, j
    cdef double e, rhs = 0.0, min_diagonal = 1.0 / 0.0, inf = 1.0 / 0.0
    cdef tally_t s = make_empty_tally()
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            if not 0.0 < p.d[j] < inf:
                return 0
            min_diagonal = p.d[j] if p.d[j] < min_diagonal else min_diagonal
            rhs += p.b[j] * p.b[j]
            if has_independent_rows(p, i):
                if not p.lower[j] <= 0.0 <= p.upper[j]:
                    return 0
                e = compute_row_error(0.0, -p.b[j], p.d[j], p.lower[j], p.upper[j])
            elif j == p.ptr[i]:
                e = compute_row_error(0.0, -p.b[j], p.d[j], 0.0, inf)
            else:
                continue                                # The disk of lam_n = 0 has radius 0: e = 0.
            add_row_error(p, j, e, &s)
    energy[0] = sqrt(s.energy)
    velocity[0] = sqrt(s.fast)
    # Below 2^-48 of the norm of b the judge uses another reference.
    return s.energy < inf and s.energy * min_diagonal > 1.3e-29 * rhs


cdef void measure_as_engine(const blocks_t* p, const rows_t* r, const warm_t* s, double* residual,
                         double* violation) noexcept nogil:
    """Compute max |e_n| [N s] and max(0, -w_n) [m/s] over the contacts, as the engine does for its own sweeps."""
    cdef int32_t i, j
    cdef double x, big = 0.0, low = 0.0
    for i in range(r.n_joints, p.n_blocks):
        j = p.ptr[i]
        x = fabs(s.error[j])
        big = x if x > big else big
        low = -s.slack[j] if -s.slack[j] > low else low
    residual[0] = big
    violation[0] = low


cdef inline double score_impulse(const blocks_t* p, const rows_t* r, warm_t* s, const double* lam, const double* v, double e0,
                          double v0) noexcept nogil:
    """Return the judge's relative residual of lam, given v = M^-1 J^T lam; infinite if it is not finite."""
    cdef score_t x = make_empty_score()
    cdef double violation, work = s.sweeps + s.factorisations
    cdef double* out
    x.by_island = s.by_island
    compute_body_slack(p, r, lam, v, s.slack)
    score_given_slack(p, lam, s.slack, s.error, &x)
    # Trace the work, energy and max |e_n| of a judged impulse, in place of an earlier one after the same work.
    if s.trace != NULL and s.n_traced > 0 and s.trace[3 * s.n_traced - 3] == work:
        s.n_traced -= 1
    if s.trace != NULL and s.n_traced < MAX_TRACED_SCORES:
        out = s.trace + 3 * s.n_traced
        out[0] = work
        out[1] = x.energy
        measure_as_engine(p, r, s, &out[2], &violation)
        s.n_traced += 1
    if x.relative >= 0.0:                               # This is the residual of the worst island.
        return x.relative
    return relative_residual(x.energy, x.velocity, e0, v0) if x.finite else 1.0 / 0.0


cdef int32_t compute_joint_bandwidth(const blocks_t* p, const rows_t* r, int32_t* last) noexcept nogil:
    """Return the width of the band of A in the given order; 0 unless all rows are joints without bounds."""
    cdef int32_t i, j, h, b, width = 1
    if r.n_contacts > 0 or r.n_joints == 0:
        return 0
    for b in range(r.n_bodies):
        last[b] = -1
    for i in range(r.n_joints):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            if p.lower[j] > -1.0 / 0.0 or p.upper[j] < 1.0 / 0.0:
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
    return width if width <= MAX_BAND_WIDTH else 0


cdef inline void form_joint_band(const blocks_t* p, const rows_t* r, warm_t* s) noexcept nogil:
    """Compute band[i width + t] = A[i + t, i] from the joints of each body."""
    cdef int32_t i, k, q, j, h, g, b, at
    for b in range(r.n_bodies):
        s.last_joint[b] = -1
    for i in range(p.n_rows * s.width):
        s.band[i] = 0.0
    for i in range(r.n_joints):
        for h in range(2):
            b = r.joint_body[2 * i + h]
            if b < 0:
                continue
            s.previous_joint[2 * i + h] = s.last_joint[b]
            s.last_joint[b] = 2 * i + h
            at = s.last_joint[b]
            while at >= 0:
                k = at >> 1
                g = at & 1
                for j in range(p.ptr[i], p.ptr[i + 1]):
                    for q in range(p.ptr[k], p.ptr[k + 1]):
                        if q <= j:
                            s.band[<int64_t>q * s.width + (j - q)] += dot6(r.jac + 12 * j + 6 * h,
                                                                           r.minv_jac + 12 * q + 6 * g)
                at = s.previous_joint[at]
    for j in range(p.n_rows):
        s.band[<int64_t>j * s.width] += r.compliance[j]


cdef double judge_impulse(const blocks_t* p, const rows_t* r, warm_t* s, const double* lam, double* v, double e0,
                          double v0) noexcept nogil:
    """Compute v = M^-1 J^T lam and return the judge's relative residual of lam (m) [N s]."""
    compute_velocity_change(p, r, lam, v)
    return score_impulse(p, r, s, lam, v, e0, v0)


cdef inline int32_t solve_joints(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double e0, double v0,
                                 double* lam, double* v) noexcept nogil:
    """Solve joints without bounds by (3) into lam (m) [N s]; return the result code."""
    cdef linear_t band
    cdef int32_t j, attempt
    form_joint_band(p, r, s)
    s.factorisations = 1
    analyse_band(&band, p.n_rows, s.width)
    band.matrix, band.d, band.tiny, band.shift = s.band, p.d, 1e-13, 0.0
    band.ahead, band.deadline = NULL, s.deadline
    if factor_linear_system_matrix(&band) or band.pivots.negative:
        return UNDECIDED
    for j in range(p.n_rows):
        lam[j] = p.b[j]
    solve_linear_system(&band, lam)
    for attempt in range(2):
        s.relative = judge_impulse(p, r, s, lam, v, e0, v0)
        if s.relative <= tol:
            return SOLVED
        if attempt == 0:                                   # Refine: lam <- lam - A^-1 w.
            solve_linear_system(&band, s.slack)
            for j in range(p.n_rows):
                lam[j] -= s.slack[j]
    return UNDECIDED


cdef inline int32_t sweep_contacts(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double e0, double v0,
                                   double* lam, double* v) noexcept nogil:
    """Sweep over the contacts by (2), lam (m) [N s] in place; return the result code."""
    cdef int32_t i, n = 0, last = 0, next_ = FIRST_SWEEP_CHECK
    cdef double before, now = s.relative, predicted
    while n < MAX_WARM_SWEEPS:
        while n < next_:
            sweep_bodies_in_sequence(p, r, lam, v)
            n += 1
            # [ns] per row: "sweep row" and 24 times "sweep body cone" of the rates
            if has_passed(s.deadline, 58.0 * p.n_rows):
                return UNDECIDED
        s.sweeps = n
        before = now
        now = score_impulse(p, r, s, lam, v, e0, v0)
        if now <= tol:
            s.relative = judge_impulse(p, r, s, lam, v, e0, v0)
            if s.relative <= tol:
                return SWEPT
        if n >= MIN_SWEEPS_TO_GIVE_UP:
            predicted = now
            i = n
            while i < MAX_WARM_SWEEPS:
                predicted = predicted * (now / before)
                i += n - last
            if not predicted <= tol:
                return UNDECIDED
        last = n
        next_ = 2 * n
    return UNDECIDED


cdef int32_t solve_from_warm_start(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double* lam, double* v,
                               int32_t has_velocity) noexcept nogil:
    """Solve in place from lam (m) [N s], which is not zero, to the relative residual tol; return the result code.

    The start is projected on its bounds, and islands may begin at the zero impulse instead (judge/best.pxd).

    v (n_bodies, 6) receives M^-1 J^T lam; with has_velocity it holds this product of the start on entry.
    """
    cdef double e0, v0
    cdef int32_t j, result
    s.sweeps = 0
    s.factorisations = 0
    s.n_traced = 0
    if is_zero_impulse(p, lam) or p.n_rows > MAX_WARM_ROWS or p.law != COULOMB or not zero_impulse_errors(p, &e0, &v0):
        return UNDECIDED
    memcpy(s.given, lam, p.n_rows * sizeof(double))
    project_on_bounds(p, lam)
    for j in range(p.n_rows):
        has_velocity = has_velocity and s.given[j] == lam[j]
    if not has_velocity:
        compute_velocity_change(p, r, lam, v)
    s.relative = score_impulse(p, r, s, lam, v, e0, v0)
    if s.relative <= tol:
        return JUDGED
    if p.islands == NULL:
        s.by_island[0] = s.relative
    if begin_at_better_point(p, s.by_island, 1.0, s.slack, True, tol, lam):
        compute_velocity_change(p, r, lam, v)
        s.relative = score_impulse(p, r, s, lam, v, e0, v0)
        if s.relative <= tol:
            return JUDGED
    for j in range(p.n_rows):
        s.start[j] = lam[j]
    result = UNDECIDED
    if r.n_contacts > 0 and not is_zero_impulse(p, lam):
        result = sweep_contacts(p, r, s, tol, e0, v0, lam, v)
    elif s.width > 0 and not is_zero_impulse(p, lam):
        result = solve_joints(p, r, s, tol, e0, v0, lam, v)
    if result == UNDECIDED:
        for j in range(p.n_rows):
            lam[j] = s.given[j] if s.keeps_start else s.start[j]
        compute_velocity_change(p, r, lam, v)
    return result


def solve_from_guess(Data data, double[::1] impulse, double tol, deadline=None):
    """Solve a problem over bodies in place from `impulse` (m,) [N s] to the relative residual tol, before the deadline.

    Return (result code, sweeps, factorisations); with the result code 0 the impulse is unchanged.
    """
    cdef int32_t m = data.blocks.n_rows, result
    cdef warm_t s
    cdef arena_t a = make_arena(NULL, NULL)
    cdef double* v
    if m == 0 or not data.factored:
        return 0, 0, 0
    s.width = 0
    bind_warm_start(&s, &data.blocks, &data.rows, &a)
    cdef int32_t[::1] index = np.empty(a.n_index + 1, np.int32)
    s.width = compute_joint_bandwidth(&data.blocks, &data.rows, &index[0])
    cdef double[::1] real = np.empty(a.n_real + <int64_t>s.width * m + 6 * data.rows.n_bodies)
    a = make_arena(&real[0], &index[0])
    bind_warm_start(&s, &data.blocks, &data.rows, &a)
    v = take_doubles(&a, 6 * <int64_t>data.rows.n_bodies)
    s.trace, s.deadline = NULL, get_pointer(deadline)
    s.keeps_start = 0
    with nogil:
        result = solve_from_warm_start(&data.blocks, &data.rows, &s, tol, &impulse[0], v, 0)
    return result, s.sweeps, s.factorisations
