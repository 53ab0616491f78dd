"""Newton's method over the velocities of generalised coordinates, island by island (linear systems: `normal.pxd`).

With the whitened unknown y = D^1/2 L (v - v*), s = Y y - b, and the impulses lambda(s) of softened blocks (`flow.pxd`):

    G(y) = y - Y^T lambda(s),    N = I + Y^T V Y,    N p = -G,    y <- y + t p                            (1)
    theta' = theta + rho,        z = (rho c - s) / theta'                                                 (2)
    s_n <- s_n + phi                                                                                      (3)

Convex laws. G is the gradient of a convex function with kinks in its second derivative, N is symmetric, and t is the
zero of the derivative along p (Todorov 2014; Castro et al. 2022), which takes a few evaluations.

Proximal term. rho in (2) is 0 if the problem's own theta is at least 1e-6 d, or on contacts, where kinks are sharper,
1e-4 d under the cone law and 1e-3 d under Coulomb's law. Below that, and between tangents with different theta, rho
is a proximal term about the centre c. The centre follows lambda (Rockafellar 1976), and the limit solves the given
problem. rho starts at 1e-4 d without friction, at 3e-3 d under the cone law and at 3e-2 d under Coulomb's law: the
less reliable the steps, the larger it is.

Coulomb's law has no such function. A round has two stages:

    stage           steps                                                 event                    next
    CONVEX_STAGE    descent under the cone law                            solved or stuck          COULOMB_STAGE
    COULOMB_STAGE   Newton's method with the derivative of Coulomb's      |G| no longer falls, a   CONVEX_STAGE of a new round
                    law, which is not symmetric                           pivot is lost
    any                                                                   error within tol         REACHED
    CONVEX_STAGE                                                          not finite, lost pivot   LOST, BROKEN

After the second stage the normals are lowered by phi = sum of a_g |w_g| over the friction components (3) for the next
convex problem (De Saxce, Feng 1998; Cadoux 2009). A run that was given a start begins with the second stage.

The stopping test uses the judge's error of lambda itself: w = Y (Y^T lambda) - b + theta lambda, error e of every
block, unless |G| bounds it (`bounds_errors`). N and its factor are reused if no block has changed its V, and in the first
step after the centre has moved: lambda changes there along the law that it has settled on, and so does V. If few entries of
V have changed, Y^T dV Y is added to N.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.deadline cimport has_passed
from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.dot cimport dot
from lavender_ext.core.method cimport BROKEN, LOST, MORE, REACHED, STUCK
from lavender_ext.core.block_types cimport CONE, COULOMB, get_friction_components, friction_components_t
from lavender_ext.core.start cimport is_zero_impulse, clip_zero_to_row_bounds
from lavender_ext.core.line_search cimport begin_line_search, is_reduction_sufficient, line_t, narrow_line_search
from lavender_ext.velocity_newton.flow cimport (UNFORMED, form_column_of_a, multiply_y_transpose, end_block_of_run,
                                                first_block_of_run, clear_rows, compute_island_impulses, copy_rows, descent_t,
                                                flow_t, measure_impulse_errors, paused_t, recompute_slack, end_row_of_run,
                                                first_row_of_run)
from lavender_ext.velocity_newton.normal cimport (FEW_CHANGES, MANY_CHANGES, SAME_V, compare_v, factor_normal_matrix,
                                                 form_normal_matrix, has_nonzero_v, solve_step)
from lavender_ext.velocity_newton.soft cimport has_bounded_rows_only, min_relative_compliance


cdef enum:                      # stages of a round of Coulomb friction
    NEXT_ROUND = 0
    CONVEX_STAGE = 1
    COULOMB_STAGE = 2

cdef enum:
    MAX_IDLE_STEPS = 30         # An island is stuck if this many consecutive steps do not lower its lowest error by a tenth.
    FAR_GRADIENT = 100          # Errors are not measured above this multiple of the limit: on 217 steps none was a solution there.
    MAX_COULOMB_ROUNDS = 12     # Problems that need more rounds are solved faster by other methods.


cdef inline double smallest_tol() noexcept nogil:
    """Return the tol to which errors are compared if it is 0: no product with E0 or V0 underflows, and no rounding reaches it."""
    return 1e-200


# -- line searches ----------------------------------------------------------------------------------------------


cdef inline void evaluate_on_line(const flow_t* f, int32_t island, double t) noexcept nogil:
    """Evaluate w = s + t q, lambda (in `trial`) and V at y + t p."""
    cdef int32_t a, k
    cdef double* w = f.w
    cdef const double* s = f.s
    cdef const double* q = f.q
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            w[k] = s[k] + t * q[k]
    compute_island_impulses(f, island, w, f.trial)


cdef inline double search_line(flow_t* f, int32_t island) noexcept nogil:
    """Return t of line_search.pxd (1); 0 if p is not a descent direction."""
    cdef int32_t a, c
    cdef double py = 0.0, pp = 0.0, pg = 0.0, slope
    cdef line_t line
    cdef const int32_t* own = f.unknowns
    cdef const double* y = f.y
    cdef const double* grad = f.grad
    cdef const double* step = f.step
    cdef const double* p = f.q if f.is_over_rows else f.step
    for a in range(f.n_unknowns):
        c = own[a]
        py += p[c] * y[c]
        pp += p[c] * step[c]
        pg += step[c] * grad[c]
    if not pg < 0.0:
        return 0.0
    begin_line_search(&line, pg)
    while True:
        f.evaluations += 1
        evaluate_on_line(f, island, line.t)
        slope = py + line.t * pp                        # derivative of the convex function along p at y + t p
        for a in range(f.iptr[island], f.iptr[island + 1]):
            c = first_row_of_run(f, a)
            slope -= dot(f.q + c, f.trial + c, end_row_of_run(f, a) - c)
        if narrow_line_search(&line, slope):
            return line.t


cdef inline double halve_step_until_residual_falls(flow_t* f, int32_t island, double bound) noexcept nogil:
    """Halve t until |G| is below `bound` (Coulomb's law); return 0 if that fails."""
    cdef int32_t a, c, _n
    cdef double t = 1.0, size
    for _n in range(8):
        f.evaluations += 1
        evaluate_on_line(f, island, t)
        multiply_y_transpose(f, island, f.trial, f.u)
        size = 0.0
        for a in range(f.cptr[island], f.cptr[island + 1]):
            c = f.icols[a]
            size += (f.y[c] + t * f.step[c] - f.u[c]) * (f.y[c] + t * f.step[c] - f.u[c])
        if is_reduction_sufficient(sqrt(size), t, bound):
            return t
        t *= 0.5
    return 0.0


# -- one island --------------------------------------------------------------------------------------------------


cdef inline void set_proximal_terms(flow_t* f, int32_t island, double softness) noexcept nogil:
    """Compute theta' of (2) with rho = softness d on rows whose own compliance is below `min_relative_compliance` d.

    All rows of one friction component get the largest theta' among them.
    """
    cdef int32_t a, i, j, k, g, end, last, first
    cdef friction_components_t q
    cdef const double* compliance = f.g.compliance
    cdef const double* d = f.p.d
    cdef double* theta = f.theta
    cdef double* rho = f.rho
    cdef double* soft = f.inv_theta
    cdef double x, low
    cdef bint is_stiff = False, is_rigid = False
    for a in range(f.iptr[island], f.iptr[island + 1]):
        last = end_block_of_run(f, a)
        for i in range(first_block_of_run(f, a), last):
            j = f.p.ptr[i]
            # All blocks of a run of bounded rows have the same limit.
            end = f.p.ptr[last] if f.bounded_rows_only else f.p.ptr[i + 1]
            low = min_relative_compliance(&f.p, f.law, i)
            if softness < low:
                low = softness
            for k in range(j, end):
                x = compliance[k]
                theta[k] = x if x >= low * d[k] else x + softness * d[k]
            if f.bounded_rows_only:
                break
            if not has_bounded_rows_only(&f.p, i):
                get_friction_components(&f.p, i, &q)
                for g in range(q.n):
                    if q.size[g] > 1:
                        first, x = j + q.first[g], 0.0
                        for k in range(first, first + q.size[g]):
                            x = max(x, theta[k])
                        for k in range(first, first + q.size[g]):
                            theta[k] = x
                for k in range(j, end):
                    f.sqrt_theta[k] = sqrt(theta[k])
        end = end_row_of_run(f, a)
        for k in range(first_row_of_run(f, a), end):
            rho[k] = theta[k] - compliance[k]
            soft[k] = 1.0 / theta[k]
            # If a row with V = 1 / theta becomes fixed, its part of N cancels, up to rounding of 2^-53 d / theta relative to I.
            is_stiff |= theta[k] < 1e-7 * d[k]
            is_rigid |= rho[k] > 1e-13 * theta[k]
    f.descent.is_stiff, f.descent.is_rigid = is_stiff, is_rigid


cdef inline double compute_proximal_energy_error(const flow_t* f, int32_t island) noexcept nogil:
    """Return the energy error due to the proximal terms, rho (lambda - c)."""
    cdef int32_t a, k
    cdef double x, out = 0.0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            x = f.rho[k] * (f.lam[k] - f.center[k])
            out += x * x / f.p.d[k]
    return sqrt(out)


cdef inline double compute_error_over_limits(const flow_t* f, double energy, double velocity) noexcept nogil:
    """Return the error as a multiple of its limits: at most 1 if it is within tol, NaN if it is not finite."""
    cdef double x = 0.0, v = 0.0
    if energy != energy or velocity != velocity:
        return energy + velocity
    if energy > 0.0:
        x = energy / f.energy_limit if f.energy_limit > 0.0 else 1.0 / 0.0
    if velocity > 0.0:
        v = velocity / f.velocity_limit if f.velocity_limit > 0.0 else 1.0 / 0.0
    return x if x > v else v


cdef inline void begin_descent(flow_t* f, int32_t island, int32_t law, double error) noexcept nogil:
    """Begin Newton steps under the given law from y. `error` is the error of `best`, or infinity."""
    cdef descent_t* x = &f.descent
    f.p.law = law
    x.idle_steps = x.steps = x.response_is_known = x.center_moved = 0
    x.slack_is_fresh = x.needs_matrix = 1
    x.softness = f.softness
    x.best_error = error
    x.lowest_error = 1.0 / 0.0
    x.error_at_last_center = x.sizes[0] = x.sizes[1] = x.sizes[2] = -1.0
    set_proximal_terms(f, island, x.softness)
    recompute_slack(f, island)


cdef inline double store_iterate_if_best(flow_t* f, int32_t island, bint moves, double* energy) noexcept nogil:
    """Return the error of lambda over its limits (`u` as in `measure_impulse_errors`), and keep lambda in `best` if it is lower."""
    cdef descent_t* x = &f.descent
    cdef double velocity, over
    energy[0] = measure_impulse_errors(f, island, f.lam, moves, &velocity)
    over = compute_error_over_limits(f, energy[0], velocity)
    if over < x.lowest_error:
        x.idle_steps = x.idle_steps if over > 0.9 * x.lowest_error else 0
        x.lowest_error = over
    if over < x.best_error:
        x.best_error = over
        copy_rows(f, island, f.lam, f.best)
    return over


cdef inline double compute_gradient(flow_t* f) noexcept nogil:
    """Compute G into `grad` and return |G|. If the island is over rows, do so with h of `normal.pxd` (1)."""
    cdef int32_t a, c
    cdef double size = 0.0
    cdef const int32_t* own = f.unknowns
    cdef const double* y = f.y
    cdef const double* u = f.u
    cdef double* grad = f.grad
    if f.is_over_rows:
        for a in range(f.n_unknowns):
            c = own[a]
            grad[c] = (f.s[c] + f.p.b[c]) - u[c]
            size += (y[c] - f.lam[c]) * grad[c]
    else:
        for a in range(f.n_unknowns):
            c = own[a]
            grad[c] = y[c] - u[c]
            size += grad[c] * grad[c]
    return sqrt(size) if size > 0.0 else size * 0.0     # Rounding may make h's square negative; NaN stays NaN.


cdef inline bint bounds_errors(const flow_t* f, int32_t island, double size) noexcept nogil:
    """Return whether |G| = size bounds the errors of lambda(s) by their limits, without proximal terms.

    lambda(s) has no error with the slack s + theta lambda, and the error of a row changes by at most |Y_k G| / d_k
    <= |G| d_k^-1/2 with its own slack. Below a tol of 1e-9, rounding of s could exceed the limits.
    """
    cdef int32_t a, k, rows = 0
    cdef double nu = 0.0
    if f.tol < 1e-9:
        return False
    for a in range(f.iptr[island], f.iptr[island + 1]):
        rows += end_row_of_run(f, a) - first_row_of_run(f, a)
    size *= sqrt(<double>rows)
    if not size <= f.energy_limit:
        return False
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            nu = f.p.nu[k] if f.p.nu[k] > nu else nu
    return size * sqrt(nu) <= f.velocity_limit


cdef inline int32_t end_descent(flow_t* f, int32_t island, bint moves, bint is_far, int32_t outcome) noexcept nogil:
    """Keep the last iterate in `best` if its error, which is not measured if it `is_far`, is lower; return `outcome`."""
    cdef double energy
    if is_far:
        store_iterate_if_best(f, island, moves, &energy)
    return outcome


cdef inline bint has_passed_after_part(flow_t* f, int32_t island) noexcept nogil:
    """Count a fifth of a step without N, and return whether the deadline has passed.

    A step takes 274 ns per row of a contact: "velocity contact row" of the rates.
    """
    cdef int32_t a, rows = 0
    if f.deadline == NULL:
        return False
    for a in range(f.iptr[island], f.iptr[island + 1]):
        rows += end_row_of_run(f, a) - first_row_of_run(f, a)
    return has_passed(f.deadline, 55.0 * rows)


cdef inline int32_t descend_island(flow_t* f, int32_t island, double goal) noexcept nogil:
    """Take Newton steps until the error is `goal` times its limits or no step succeeds; MORE: call again to continue.

    The measured iterate with the lowest error is in `best`. Without proximal terms, errors are measured if |G| is at most
    FAR_GRADIENT times the limit or V = 0, and at the end: on rows with V != 0, Y G is the slack error (`flow.pxd` (1)).
    The softness falls if an inner problem lowers the error by less than 0.7. A step is idle if it does not lower the lowest
    error of this descent: the first step often raises the error of the start.
    """
    cdef descent_t* x = &f.descent
    cdef int32_t a, c, change
    cdef bint square = f.p.law == COULOMB, rigid = x.is_rigid, moves, is_far
    cdef double energy = 0.0, t, size, bound, over
    while True:
        if not x.response_is_known:
            compute_island_impulses(f, island, f.s, f.lam)
        x.response_is_known = 0
        moves = multiply_y_transpose(f, island, f.lam, f.u)
        if f.deadline != NULL and f.deadline.passed:
            x.response_is_known = 1
            return MORE
        size = compute_gradient(f)
        if not rigid and f.law != COULOMB and x.steps > 0 and bounds_errors(f, island, size):
            copy_rows(f, island, f.lam, f.best)
            return REACHED
        is_far = (not rigid and not square and f.steps > 0 and size > FAR_GRADIENT * goal * f.energy_limit > 0.0
                  and has_nonzero_v(f, island))
        over = size / f.energy_limit if is_far else store_iterate_if_best(f, island, moves, &energy)
        if over != over:
            return LOST
        if over <= goal:
            return REACHED
        if f.steps <= 0 or has_passed_after_part(f, island):
            x.response_is_known = 1                     # N, s and lambda are reused by the next call.
            return MORE
        x.idle_steps += 1
        x.steps += 1
        if x.idle_steps > MAX_IDLE_STEPS:
            return end_descent(f, island, moves, is_far, STUCK)
        if rigid and (size <= 0.1 * energy and size <= 0.1 * compute_proximal_energy_error(f, island) or size == 0.0):
            # The softened problem is solved well enough: move its centre.
            copy_rows(f, island, f.lam, f.center)
            x.center_moved = 1
            if x.error_at_last_center >= 0.0 and energy > 0.3 * x.error_at_last_center and x.softness > 1e-9:
                x.softness = 0.1 * x.softness
                set_proximal_terms(f, island, x.softness)
                x.needs_matrix = 1
            x.error_at_last_center = energy
            f.steps -= 1
            x.sizes[0] = x.sizes[1] = x.sizes[2] = -1.0
            continue
        f.steps -= 1
        change = MANY_CHANGES if x.needs_matrix else SAME_V if x.center_moved else compare_v(f, island)
        if change != SAME_V:
            form_normal_matrix(f, island, square, change == FEW_CHANGES and not x.is_stiff)
            has_passed_after_part(f, island)
            if not factor_normal_matrix(f, island, square):
                return MORE if f.deadline != NULL and f.deadline.passed else end_descent(f, island, moves, is_far, BROKEN)
        x.needs_matrix = x.center_moved = 0
        solve_step(f, island, square)
        has_passed_after_part(f, island)
        if square:
            bound = size
            for a in range(3):
                if x.sizes[a] > bound:
                    bound = x.sizes[a]
            x.sizes[x.steps % 3] = size
            t = halve_step_until_residual_falls(f, island, bound)
        else:
            t = search_line(f, island)
        has_passed_after_part(f, island)
        if t == 0.0:
            if x.slack_is_fresh:
                return end_descent(f, island, moves, is_far, STUCK)
            x.slack_is_fresh = x.needs_matrix = 1       # Recompute s once: its rounding may have caused the failure.
            recompute_slack(f, island)
            continue
        for a in range(f.n_unknowns):
            c = f.unknowns[a]
            f.y[c] += t * f.step[c]
        f.is_zero = False
        x.slack_is_fresh = 0
        f.s, f.w, f.lam, f.trial = f.w, f.s, f.trial, f.lam     # Both searches evaluated the accepted point last.
        x.response_is_known = 1


cdef inline void compute_normal_shifts(const flow_t* f, int32_t island, const double* lam) noexcept nogil:
    """Compute phi (3) from the slack of lam. phi must be 0 before the call."""
    cdef int32_t a, i, j, g
    cdef double velocity
    cdef friction_components_t q
    measure_impulse_errors(f, island, lam, multiply_y_transpose(f, island, lam, f.u), &velocity)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for i in range(first_block_of_run(f, a), end_block_of_run(f, a)):
            if not has_bounded_rows_only(&f.p, i):
                j = f.p.ptr[i]
                get_friction_components(&f.p, i, &q)
                for g in range(q.n):
                    f.phi[j] += q.friction_coefficient[g] * euclidean_norm(f.w + j + q.first[g], q.size[g])


cdef inline void restart_island_from_impulse(flow_t* f, int32_t island, const double* lam) noexcept nogil:
    """Set y = Y^T lam, and the centre and the best impulse to lam."""
    cdef int32_t a, c
    copy_rows(f, island, lam, f.lam)
    copy_rows(f, island, lam, f.best)                   # `best` must contain an impulse even if all later errors overflow.
    copy_rows(f, island, lam, f.center)
    f.is_zero = not multiply_y_transpose(f, island, lam, f.u)
    for a in range(f.n_unknowns):
        c = f.unknowns[a]
        f.y[c] = lam[c] if f.is_over_rows else f.u[c]


cdef inline bint keep_impulse_if_better(flow_t* f, int32_t island, const double* lam, bint moves, double* impulse) noexcept nogil:
    """Copy lam to `impulse` if its error under the problem's own law is the lowest so far; phi must be 0.

    Return whether the error is lower than that of the points at which no call ended.
    """
    cdef double energy, velocity, over
    f.p.law = f.law
    energy = measure_impulse_errors(f, island, lam, moves, &velocity)
    over = compute_error_over_limits(f, energy, velocity)
    if over < f.paused.island_error:
        f.paused.island_error = over
        copy_rows(f, island, lam, impulse)
    if over < f.paused.best_error:
        f.paused.best_error = over
        return True
    return False


cdef inline int32_t solve_coulomb(flow_t* f, int32_t island, double* impulse) noexcept nogil:
    """Run the rounds of Coulomb's law (file header) into `impulse`; a call continues where the last one ended."""
    cdef paused_t* x = &f.paused
    cdef int32_t n
    cdef double least
    cdef bint moves, is_lower
    if x.stage == CONVEX_STAGE:
        copy_rows(f, island, f.start, f.phi)
    while x.rounds < MAX_COULOMB_ROUNDS:
        least = x.best_error
        if x.stage == NEXT_ROUND:
            f.rounds += 1
            x.stage = CONVEX_STAGE if x.rounds > 0 or x.cold else COULOMB_STAGE
            begin_descent(f, island, CONE if x.stage == CONVEX_STAGE else COULOMB, 1.0 / 0.0)
        f.p.law = CONE if x.stage == CONVEX_STAGE else COULOMB
        n = descend_island(f, island, 0.1 * least if x.stage == CONVEX_STAGE and least > 1e2 else 1.0)
        if x.stage == CONVEX_STAGE:
            if n == LOST or n == BROKEN:
                return n
            copy_rows(f, island, f.phi if n == MORE else f.best, f.start)
            clear_rows(f, island, f.phi)
        moves = multiply_y_transpose(f, island, f.best, f.u)
        is_lower = n != LOST and keep_impulse_if_better(f, island, f.best, moves, impulse)
        if x.stage == COULOMB_STAGE and is_lower and n != MORE:
            copy_rows(f, island, f.best, f.start)
        if x.best_error <= 1.0:
            return REACHED
        if n == MORE:
            x.best_error = least                        # An impulse at which a call ends must not change the path.
            return MORE
        if x.stage == COULOMB_STAGE:
            compute_normal_shifts(f, island, f.start)
            x.rounds += 1
        restart_island_from_impulse(f, island, f.start)
        x.stage = COULOMB_STAGE if x.stage == CONVEX_STAGE else NEXT_ROUND
        if x.stage == COULOMB_STAGE:
            begin_descent(f, island, COULOMB, 1.0 / 0.0)
    return STUCK


cdef inline void choose_island_unknowns(flow_t* f, int32_t island) noexcept nogil:
    """Set the limits of an island's errors, and choose its unknowns, velocities or rows; no column of A is formed yet.

    Both limits are 0 if the rows of the island are compared with their own terms.
    """
    cdef int32_t a, k
    cdef const double* own
    cdef double energy = f.reference_energy, velocity = f.reference_velocity
    if f.p.islands != NULL:
        own = f.p.islands.reference + 2 * f.p.islands.label[first_block_of_run(f, f.iptr[island])]
        energy, velocity = max(own[0], 0.0), max(own[1], 0.0)
    # With tol = 0 errors are compared, too, so that the best iterate is known.
    f.energy_limit, f.velocity_limit = max(f.tol, smallest_tol()) * energy, max(f.tol, smallest_tol()) * velocity
    f.is_over_rows = f.over_rows[island]
    f.unknowns, f.n_unknowns = f.icols + f.cptr[island], f.cptr[island + 1] - f.cptr[island]
    if not f.is_over_rows:
        return
    f.unknowns, f.n_unknowns, f.rows = f.row_list, 0, f.n_unknowns      # `rows`: the columns of Y^T, until the end.
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            f.row_list[f.n_unknowns] = k
            f.n_unknowns += 1
    k, f.rows = f.rows, f.n_unknowns + 3 & ~3
    f.a = f.y_transpose + k * f.rows
    if not f.has_matrix:
        f.panel_of_column[0] = UNFORMED


cdef inline void form_kept_matrix(flow_t* f) noexcept nogil:
    """Form every column of A, if the problem has a single island, over rows, and these columns may stay."""
    cdef int32_t a
    if not f.keeps_matrix or f.has_matrix or f.n_islands != 1 or not f.over_rows[0]:
        return
    f.island = 0
    choose_island_unknowns(f, 0)
    for a in range(f.n_unknowns):
        form_column_of_a(f, a)
    f.has_matrix = f.deadline == NULL or not f.deadline.passed


cdef inline bint is_zero_island_impulse(const flow_t* f, int32_t island) noexcept nogil:
    """Return whether the island's impulse `lam` is the zero impulse, which is 0 within all bounds."""
    cdef int32_t a, k
    if not f.is_zero:
        return False
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            if clip_zero_to_row_bounds(&f.p, k) != 0.0:
                return False
    return True


cdef inline int32_t solve_island(flow_t* f, int32_t island, double* impulse) noexcept nogil:
    """Solve one island from `impulse`, or continue a paused island, into `impulse`; return the outcome."""
    cdef int32_t end, a, k
    cdef bint waits = f.paused.island == island
    f.island = island
    if not waits:
        choose_island_unknowns(f, island)
        a = f.p.islands.label[first_block_of_run(f, f.iptr[island])] if f.p.islands != NULL else -1
        if a >= 0 and not f.p.islands.reference[2 * a] >= 0.0:
            for a in range(f.iptr[island], f.iptr[island + 1]):         # No row acts: the zero impulse is the solution.
                for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
                    impulse[k] = clip_zero_to_row_bounds(&f.p, k)
            return REACHED
        restart_island_from_impulse(f, island, impulse)
        copy_rows(f, island, impulse, f.start)
        clear_rows(f, island, f.phi)
        f.paused.stage, f.paused.rounds = NEXT_ROUND, 0
        f.paused.best_error = f.paused.island_error = 1.0 / 0.0
        if f.law != COULOMB and f.tol > 0.0 and f.energy_limit > 0.0 and is_zero_island_impulse(f, island):
            f.paused.best_error = 1.0 / f.tol           # the error that the limits refer to
        elif not keep_impulse_if_better(f, island, f.start, not f.is_zero, impulse):
            return LOST
        if f.paused.best_error <= 1.0:
            return REACHED
    if f.law == COULOMB:
        end = solve_coulomb(f, island, impulse)
    else:
        if not waits:
            begin_descent(f, island, f.law, f.paused.best_error)
        end = descend_island(f, island, 1.0)
        copy_rows(f, island, f.best, impulse)
    f.paused.island = island if end == MORE else -1
    return end


cdef inline int32_t solve_islands(flow_t* f, double* impulse) noexcept nogil:
    """Solve all islands from `impulse` (m), beginning with a paused one; return REACHED or the worst outcome."""
    cdef int32_t i, end, first = f.paused.island
    if first < 0:
        first = 0
        f.paused.worst, f.paused.cold = REACHED, f.law == COULOMB and is_zero_impulse(&f.p, impulse)
    for i in range(first, f.n_islands):
        end = solve_island(f, i, impulse)
        if end == MORE:                                 # N and the arrays still belong to the paused island.
            return MORE
        if end > f.paused.worst:
            f.paused.worst = end
    return f.paused.worst
