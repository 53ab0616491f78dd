"""The plan of Newton's method: which phase follows which.

    law             state                     phase                                               next state if unsolved
    bounded rows    START_ACTIVE_SET          exchanges from a given start                        UNBOUNDED_ACTIVE_SET
                    UNBOUNDED_ACTIVE_SET      refinement and exchanges from H z = g               ROWS_INTERIOR_POINT
                    ROWS_INTERIOR_POINT       interior point, exchanges at each decade            AUGMENTED_INTERIOR_POINT
    cones           FIRST_CONE_WEIGHT         interior point, proximal weight 1e-8                SECOND_CONE_WEIGHT
                    SECOND_CONE_WEIGHT        interior point, proximal weight 1e-10               THIRD_CONE_WEIGHT
                    THIRD_CONE_WEIGHT         interior point, proximal weight 1e-13               AUGMENTED_INTERIOR_POINT
    both            AUGMENTED_INTERIOR_POINT  interior point on the augmented system of bodies,   CONVEX_DAMPED_NEWTON
                                              if joints are rigid
                    CONVEX_DAMPED_NEWTON      proximal damped Newton; its direction may prove     CONVEX_END
                                              that there is no solution
    Coulomb's       START_DAMPED_NEWTON       proximal damped Newton from the start               DE_SAXCE
                    DE_SAXCE                  De Saxce's interior point                           DE_SAXCE_END
                    DE_SAXCE_END              damped Newton from its best point, unless that is   DE_SAXCE_SECOND_END
                                              far from a solution
                    DE_SAXCE_SECOND_END       the same with a smaller weight from the best point  FIRST_FLOW
                    FIRST_FLOW                Euler steps, if this point is near a solution       CONVEX_POINT
                    CONVEX_POINT              interior point of the convex law, judged under      CONVEX_FLOW
                                              Coulomb's law; ends if many contacts slide
                    CONVEX_FLOW               Euler steps from it, if few contacts slide          AUGMENTED_DE_SAXCE
                    AUGMENTED_DE_SAXCE        De Saxce's interior point on the augmented system,  BEGIN_PATH
                                              if joints are rigid and the best point is near
                    BEGIN_PATH                path of smoothed problems, while its residual falls PATH_FLOW
                    PATH_FLOW                 Euler steps from its last point                     CONTINUE_PATH
                    CONTINUE_PATH             the same path from that point, if it has not ended  PATH_FLOW
                                              the path has ended                                  LAST_FLOW
                    LAST_FLOW                 Euler steps from the best point                     COULOMB_DAMPED_NEWTON
                    COULOMB_DAMPED_NEWTON     proximal damped Newton from the best point          COULOMB_END

Each state with a problem that needs it: without the state the problem is lost, or takes this many times as long. `python -m
benchmarks scale --without STATE` measures this. A problem is a structure of benchmarks/scale_structures.py with rows, sliding
[m/s] and spread of log mass, a case of the suite, or a file of the test data.
tol is 1e-6 unless the line names another one.

    START_ACTIVE_SET          granular(n=6) from its solution, b changed by 1 %: 2.4
    UNBOUNDED_ACTIVE_SET      mlcp_Buck2
    ROWS_INTERIOR_POINT       mlcp_deltasigma
    FIRST_CONE_WEIGHT         heap 3000 0.5 1, cone law, to 1e-8: 2.7
    SECOND_CONE_WEIGHT        pyramid(k=30, friction="coulomb"), cone law, to 1e-9
    THIRD_CONE_WEIGHT         pyramid(k=6, mass_ratio=1e6, friction="coulomb", sliding=0.5), cone law, to 1e-8
    AUGMENTED_INTERIOR_POINT, AUGMENTED_DE_SAXCE    Scene("bridge", friction=0.5), step 99, cone and Coulomb's law, to 1e-8
    CONVEX_DAMPED_NEWTON      lcpgen_psd-300, proof that it has no solution
    START_DAMPED_NEWTON       engine/balls_step_0030: 4.6
    DE_SAXCE                  cards 3000 0.1 0: 20
    DE_SAXCE_SECOND_END       cards 3000 0.2 0, seed 183: 10
    FIRST_FLOW                cards 900 0.1 0: 5.0
    CONVEX_POINT              pile 3000 0.5 0
    CONVEX_FLOW               granularF(n=4, sliding=2, seed=10): 9
    BEGIN_PATH                heap 3000 0.1 1, seed 911
    PATH_FLOW                 cards 3000 0.1 0, seed 911: 2.1
    CONTINUE_PATH             pyramid 3000 0.2 1, seed 911
    LAST_FLOW, COULOMB_DAMPED_NEWTON    granularF(n=6, sliding=1, seed=5): no solution, but a smaller residual

Every state ends the solve as soon as the best point is within tol or at the round-off limit, a certificate is proven,
or the budget is spent.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport CERTIFICATE, MORE, REACHED, ROUNDOFF_LIMIT, SPENT, STUCK
from lavender_ext.core.block_types cimport CONE, COULOMB
from lavender_ext.core.start cimport is_zero_impulse
from lavender_ext.judge.score cimport relative_residual
from lavender_ext.newton.cones cimport has_lower_bound, has_upper_bound
from lavender_ext.newton.elements cimport is_row
from lavender_ext.newton.flow cimport begin_flow, step_flow
from lavender_ext.newton.path cimport begin_path, continue_path, step_path
from lavender_ext.newton.active_set cimport begin_active_set, step_active_set
from lavender_ext.newton.damped_newton cimport (begin_damped_newton, begin_damped_newton_stretches,
                                                continue_damped_newton_stretches, push_damped_newton, step_damped_newton)
from lavender_ext.newton.interior_phases cimport (augmented_shift, begin_interior_steps, begin_interior_with_newton,
                                                  compute_sliding_fraction, step_augmented_newton, step_interior_point,
                                                  step_interior_with_newton)
from lavender_ext.newton.run cimport (ACTIVE_SET, AUGMENTED_NEWTON, DAMPED_NEWTON, DAMPED_STRETCHES, FLOW,
                                      INTERIOR_POINT, INTERIOR_WITH_NEWTON, MAX_INNER_STEPS, N_COUNTED, N_REFINEMENTS,
                                      UNLIMITED, PLAN_CONVEX, PLAN_COULOMB, compute_slack, copy_vector, is_at_roundoff,
                                      is_budget_spent, is_finished, is_over, newton_t, pop_phase, push_phase,
                                      judge_and_keep_best_point, write_unknown)
from lavender_ext.newton.steps cimport begin_interior_point, compute_proximal_weight
from lavender_ext.newton.system cimport (BARRIER, BODIES, factor_newton_system, has_passed_after_part, solve_newton_system)


cdef enum:                      # states of PLAN_CONVEX
    START_ACTIVE_SET = 0
    UNBOUNDED_ACTIVE_SET = 1
    ROWS_INTERIOR_POINT = 2
    FIRST_CONE_WEIGHT = 3
    SECOND_CONE_WEIGHT = 4
    THIRD_CONE_WEIGHT = 5
    AUGMENTED_INTERIOR_POINT = 6
    CONVEX_DAMPED_NEWTON = 7
    CONVEX_END = 8

cdef enum:                      # states of PLAN_COULOMB
    START_DAMPED_NEWTON = 0
    DE_SAXCE = 1
    DE_SAXCE_END = 2
    DE_SAXCE_SECOND_END = 3
    FIRST_FLOW = 4
    CONVEX_POINT = 5
    CONVEX_FLOW = 6
    AUGMENTED_DE_SAXCE = 7
    BEGIN_PATH = 8
    PATH_FLOW = 9
    CONTINUE_PATH = 10
    LAST_FLOW = 11
    COULOMB_DAMPED_NEWTON = 12
    COULOMB_END = 13

cdef enum:
    POINT_REFINEMENTS = 3       # Refinements of an interior point's first z with the factor of its weighted system.
    EXACT_POINT_REFINEMENTS = 20    # Refinements of linear rows with a factor of nearly no weight, which is less exact.
    MIN_CONVEX_ROWS = 300      # With fewer rows the paths cost less than the convex point.
    CONVEX_FLOW_FACTORISATIONS = 300  # Budget of Euler steps from the convex point; piles that they solve take up to 240.
    MIN_FLOW_ROWS = 900         # With fewer rows the paths take few factorisations.
    FLOW_PATIENCE = 60          # Euler steps from a near point or a path end if so many factorisations do not halve the residual.
    LAST_FLOW_FACTORISATIONS = 1000     # Budget of the last Euler steps; sliding pyramids that they solve take up to 900.
    LAST_FLOW_PATIENCE = 300    # The last Euler steps end if so many factorisations do not halve the residual.
    FIRST_FLOW_FACTORISATIONS = 200     # Budget of Euler steps; walls and pyramids that they solve take up to 200.
    START_FACTORISATIONS = 8    # First stretch of damped Newton; a start near a solution gains within it.
    END_INNER_STEPS = 10
    END_FACTORISATIONS = 15     # Factorisations of the damped Newton phase after De Saxce's interior point.
    SECOND_END_FACTORISATIONS = 12  # Factorisations and inner steps of the second damped Newton phase after it.
    MAX_AUGMENTED_ROWS = 10000  # With more rows, one factorisation of the augmented system may exceed 0.2 s.


cdef inline double derivative_fraction() noexcept nogil:
    """Return the part of phi's derivative in De Saxce's interior point. Near 1 it ends faster, but passes fewer folds."""
    return 0.95


cdef inline double far_from_end() noexcept nogil:
    """Return the residual of De Saxce's interior point above which no damped Newton phase follows."""
    return 1e-2


cdef inline double start_alpha() noexcept nogil:
    """Return the first proximal weight of damped Newton from the start, relative to d.

    With weights from 1e-4 to 1e-7, 68 test problems take 2,030 to 2,530 factorisations in all.
    """
    return 1e-5


# -- first points of bounded rows --------------------------------------------------------------------------------------


cdef inline void refine_point(newton_t* n, double* z, int32_t max_refinements, double contraction) noexcept nogil:
    """Refine z <- z + (H + W)^-1 (g - H z) with the last factor while |g - H z| contracts; score it if it is within tol."""
    cdef int32_t j, _, m = n.s.e.m
    cdef double size = 0.0, before, residual = 1.0 / 0.0, velocity, x
    compute_slack(n, z, n.r)
    for j in range(m):
        size += n.r[j] * n.r[j]
    size = sqrt(size)
    for _ in range(max_refinements):
        solve_newton_system(&n.s, BARRIER, n.r, n.dz)
        for j in range(m):
            z[j] -= n.dz[j]
        n.counts[N_REFINEMENTS] += 1
        compute_slack(n, z, n.r)
        before = size
        size = velocity = 0.0
        for j in range(m):
            size += n.r[j] * n.r[j]
            x = n.sc.speed[j] * (n.r[j] if n.r[j] > 0.0 else -n.r[j])
            velocity = x if x > velocity else velocity
        size = sqrt(size)                               # |F| if all rows stay inside their bounds.
        residual = relative_residual(size, velocity, n.problem.e0, n.problem.v0)
        if not size < contraction * before or residual <= 1e-3 * n.tol:
            break
    if residual <= n.tol:
        judge_and_keep_best_point(n, z)


cdef inline bint is_inside_bounds(newton_t* n, const double* z, bint require_free) noexcept nogil:
    """Return whether z is inside all bounds, and with `require_free` whether there are none."""
    cdef int32_t j
    for j in range(n.s.e.m):
        if require_free and (has_lower_bound(n.s.e, j) or has_upper_bound(n.s.e, j)):
            return False
        if not n.s.e.lower[j] <= z[j] <= n.s.e.upper[j]:
            return False
    return True


cdef inline void begin_unbounded_point(newton_t* n) noexcept nogil:
    """Compute the first point of an interior point; refine the solution of H z = g if it is inside all bounds."""
    cdef int32_t j
    cdef double* z = n.ip.unbounded_z
    cdef bint is_linear
    begin_interior_point(n, compute_proximal_weight(), 0.0)
    is_linear = is_inside_bounds(n, z, True)
    if not is_linear and (n.s.form == BODIES or not is_inside_bounds(n, z, False)):
        return
    # Refinement with the existing factor removes the effect of the first point's weight.
    copy_vector(n, n.trial, z)
    refine_point(n, n.trial, POINT_REFINEMENTS, 0.1)
    if is_linear and not is_finished(n):
        # The weight changes z on nearly dependent rows. A factor with nearly no weight is less exact, which refinement corrects.
        for j in range(n.s.e.m):
            n.s.v[j] = 1.0 / (n.s.e.theta[j] + 1e-12)
        factor_newton_system(&n.s, BARRIER, 0.0)
        solve_newton_system(&n.s, BARRIER, n.s.e.g, n.trial)
        refine_point(n, n.trial, EXACT_POINT_REFINEMENTS, 1.0)


cdef inline bint may_need_augmented_system(const newton_t* n) noexcept nogil:
    """Return whether nearly dependent rows, as in loops of rigid joints, may prevent progress from a near point."""
    cdef int32_t i
    if not (n.best < 1e-3 and n.has_augmented and n.s.form == BODIES and n.s.e.m <= MAX_AUGMENTED_ROWS):
        return False
    for i in range(n.s.e.n):                            # A row without bounds belongs to a joint.
        if is_row(n.s.e, i) and not has_lower_bound(n.s.e, n.s.e.ptr[i]) and not has_upper_bound(n.s.e, n.s.e.ptr[i]):
            return True
    return False


# -- bounded rows and cones --------------------------------------------------------------------------------------------


cdef inline void begin_augmented_interior_point(newton_t* n, double derivative_fraction) noexcept nogil:
    """Begin an interior point on the augmented system of bodies, with attempts to finish by Newton steps."""
    n.s.augmented = 1
    begin_interior_point(n, augmented_shift(), derivative_fraction)
    n.s.augmented = 0
    begin_interior_with_newton(n, 1)


cdef inline void enter_next_convex_state(newton_t* n) noexcept nogil:
    """Enter the next state of the convex laws."""
    cdef int32_t state = n.stage
    cdef double* z
    n.stage = AUGMENTED_INTERIOR_POINT if state == ROWS_INTERIOR_POINT else state + 1
    if state != START_ACTIVE_SET and state != FIRST_CONE_WEIGHT and is_over(n):
        state = CONVEX_END
    if state == START_ACTIVE_SET:
        if not n.is_cold:
            begin_active_set(n, n.best_z)
    elif state == UNBOUNDED_ACTIVE_SET:
        begin_unbounded_point(n)
        if not is_finished(n):
            begin_active_set(n, n.ip.unbounded_z)
    elif state == ROWS_INTERIOR_POINT:
        begin_interior_steps(n, True)
    elif state == FIRST_CONE_WEIGHT:
        # The weight, a fraction of d, is larger than on rows: the scaling matrices of cones have a wider range of eigenvalues,
        # and N loses 2^-53 / weight to rounding. Newton's method on a pyramid of redundant contacts ends at a
        # residual of 3e-8 with the weight 1e-10, and at 4e-10 with 1e-8; it takes one more step with 1e-6.
        begin_interior_point(n, 1e-8, 0.0)
        begin_interior_steps(n, False)
    elif state == SECOND_CONE_WEIGHT:
        begin_interior_point(n, compute_proximal_weight(), 0.0)
        begin_interior_steps(n, False)
    elif state == THIRD_CONE_WEIGHT:
        # This weight is for masses that differ by factors of 1e5 and more. Of six pyramids under the cone law (5 to 7 layers,
        # mass ratios of 1e5 to 1e7), damped Newton solves five from its point to 1e-8 and the sixth to its round-off limit.
        # From the point of the second weight it solves none.
        begin_interior_point(n, 1e-13, 0.0)
        begin_interior_steps(n, False)
    elif state == AUGMENTED_INTERIOR_POINT:
        if may_need_augmented_system(n):
            begin_augmented_interior_point(n, 0.0)
    elif state == CONVEX_DAMPED_NEWTON:
        # Of cones, the last interior point is nearer to a solution than the point with the lowest residual, unless its
        # steps failed at once, as with inactive rows of b = 1e60.
        z = n.best_z if n.s.bt == NULL or n.progress.steps < 2 else n.progress.best_z
        begin_damped_newton(n, z, CONE, 1e-3, MAX_INNER_STEPS)
        push_damped_newton(n, UNLIMITED)
    else:
        pop_phase(n)


# -- Coulomb's law -----------------------------------------------------------------------------------------------------


cdef inline bint has_convex_law(const newton_t* n) noexcept nogil:
    """Return whether the convex point may be computed: H is symmetric, and the problem is large."""
    return n.s.symmetric and n.s.e.m >= MIN_CONVEX_ROWS


cdef inline void enter_next_coulomb_state(newton_t* n) noexcept nogil:
    """Enter the next state of Coulomb's law."""
    cdef int32_t state = n.stage
    cdef double* z
    n.stage = state + 1
    if is_over(n):
        state = COULOMB_END
    if state == START_DAMPED_NEWTON:
        # On large problems this gains nothing above a residual of 1e-4: relaxed points of resting heaps have 1e-3 to 5e-3. A
        # pyramid of unequal masses at rest takes 47 factorisations from 5e-5 where the other states take 88.
        if n.s.e.m < MIN_FLOW_ROWS or n.best < 1e-4:
            begin_damped_newton(n, n.best_z, COULOMB, start_alpha(), START_FACTORISATIONS)
            # An interior point follows if the first stretch leaves more than 0.9 of the residual.
            begin_damped_newton_stretches(n, START_FACTORISATIONS, 2.0 * 0.9 * n.best)
    elif state == DE_SAXCE:
        begin_interior_point(n, compute_proximal_weight(), derivative_fraction())
        begin_interior_with_newton(n, 0)
    elif state == DE_SAXCE_END:
        if n.progress.lowest <= far_from_end():
            begin_damped_newton(n, n.progress.best_z, COULOMB, min(n.progress.lowest, 1e-3), END_INNER_STEPS)
            begin_damped_newton_stretches(n, END_FACTORISATIONS, 0.0)
    elif state == DE_SAXCE_SECOND_END:
        if n.progress.lowest <= far_from_end():
            begin_damped_newton(n, n.best_z, COULOMB, min(n.best, 1e-7), SECOND_END_FACTORISATIONS)
            begin_damped_newton_stretches(n, SECOND_END_FACTORISATIONS, 0.0)
    elif state == FIRST_FLOW:
        if n.s.e.m >= MIN_FLOW_ROWS and n.best < 1e-3:  # Further away, as on heaps, the paths come first.
            begin_flow(n, n.best_z, FIRST_FLOW_FACTORISATIONS, FLOW_PATIENCE)
    elif state == CONVEX_POINT:
        if has_convex_law(n):
            begin_interior_point(n, compute_proximal_weight(), 0.0)
            begin_interior_steps(n, False)
    elif state == CONVEX_FLOW:
        z = n.progress.best_z
        # Of piles of balls that this solves up to 4 % slide at the convex point; of towers, walls and pyramids 7 % to 80 %.
        if has_convex_law(n) and not n.mostly_slides and compute_sliding_fraction(n, z, 1e-6) <= 0.05:
            begin_flow(n, z, CONVEX_FLOW_FACTORISATIONS, CONVEX_FLOW_FACTORISATIONS)
    elif state == AUGMENTED_DE_SAXCE:
        if may_need_augmented_system(n):
            begin_augmented_interior_point(n, 0.7)      # less of phi's derivative, after a failure of `derivative_fraction`
    elif state == BEGIN_PATH:
        begin_path(n)
    elif state == PATH_FLOW:
        begin_flow(n, n.path.z, LAST_FLOW_FACTORISATIONS, FLOW_PATIENCE)
    elif state == CONTINUE_PATH:
        if continue_path(n):
            n.stage = PATH_FLOW
    elif state == LAST_FLOW:
        begin_flow(n, n.best_z, LAST_FLOW_FACTORISATIONS, LAST_FLOW_PATIENCE)
    elif state == COULOMB_DAMPED_NEWTON:
        begin_damped_newton(n, n.best_z, COULOMB, start_alpha(), MAX_INNER_STEPS)
        push_damped_newton(n, UNLIMITED)
    else:
        pop_phase(n)


# -- start and step ----------------------------------------------------------------------------------------------------


cdef inline void step_phase(newton_t* n) noexcept nogil:
    """Do at most one factorisation of the phase on top of the stack, or end it."""
    cdef int32_t phase = n.stack[n.depth - 1]
    if phase == PLAN_CONVEX:
        enter_next_convex_state(n)
    elif phase == PLAN_COULOMB:
        enter_next_coulomb_state(n)
    elif phase == ACTIVE_SET:
        step_active_set(n)
    elif phase == INTERIOR_POINT:
        step_interior_point(n)
    elif phase == INTERIOR_WITH_NEWTON:
        step_interior_with_newton(n)
    elif phase == AUGMENTED_NEWTON:
        step_augmented_newton(n)
    elif phase == DAMPED_NEWTON:
        step_damped_newton(n)
    elif phase == FLOW:
        step_flow(n)
    elif phase == DAMPED_STRETCHES:
        continue_damped_newton_stretches(n)
    else:
        step_path(n)


cdef inline void start_newton_solve(newton_t* n, const double* lam) noexcept nogil:
    """Start from lam (rows); problem, system, tol and budget are set."""
    cdef int32_t i
    cdef bint has_cones = n.s.e.n < n.s.e.m
    n.stop = n.needs_check = n.proven = n.depth = 0
    n.mostly_slides = 0
    n.s.augmented = n.s.factorisations = 0
    for i in range(N_COUNTED):
        n.counts[i] = 0
    n.best = 1.0 / 0.0
    n.above_floor = 1.0 / 0.0
    n.island_best.seen = 0
    n.has_augmented = n.s.others != NULL
    n.is_cold = is_zero_impulse(&n.problem.p, lam)
    n.stage = FIRST_CONE_WEIGHT if has_cones and n.problem.p.law != COULOMB else 0
    write_unknown(n, lam, n.trial)
    copy_vector(n, n.best_z, n.trial)
    judge_and_keep_best_point(n, n.trial)
    if not is_finished(n):
        push_phase(n, PLAN_COULOMB if n.problem.p.law == COULOMB and has_cones else PLAN_CONVEX)


cdef inline int32_t step_newton_solve(newton_t* n, int32_t work) noexcept nogil:
    """Do at least `work` factorisations, unless the solve or the deadline ends before; return the outcome so far."""
    cdef int32_t last = n.s.factorisations + work
    n.needs_check = 0
    while n.depth > 0 and not n.needs_check and (n.stop or n.s.factorisations < last):
        step_phase(n)
        if has_passed_after_part(&n.s):
            n.stop = 1
    if n.needs_check:
        return CERTIFICATE
    if n.depth > 0:
        return MORE
    if n.best <= n.tol:
        return REACHED
    if is_at_roundoff(n):
        return ROUNDOFF_LIMIT
    return SPENT if is_budget_spent(n) else STUCK
