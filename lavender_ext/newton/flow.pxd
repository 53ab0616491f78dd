"""Coulomb's law by implicit Euler steps of the proximal flow: each step is a proximal point with De Saxce's shift inside.

    F(z) = z - Pi_K(u) = 0,   u = c - (s + phi(s)) / eps,   s = H z - g,   Pi_K of the convex law         (1)

phi is the shift of steps.pxd (1) and c the solution of the last step; 1 / eps is the length of the step (pseudo-transient
continuation, Kelley, Keyes 1998). If c = Pi_K(u), c solves Coulomb's law. With D = Pi_K'(u) / eps and psi = phi',

    (I + D (I + e_n psi^T) H) dz = -F                                                                     (2)

is a Newton step, factored by L U over bodies. F is measured as slack, |H F + eps F|, since impulses in the null space of H,
such as those of four contacts of one face, hide the errors of others. A step is solved, and c moves to Pi_K(u), if

    |H F + eps F| <= 0.3 eps |Pi_K(u) - c|                                                                (3)

eps falls by a fixed factor after a step of few factorisations, and rises after a step that is not solved.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t
from libc.string cimport memset

from lavender_ext.core.block_types cimport CONE, COULOMB
from lavender_ext.core.validate cimport all_finite
from lavender_ext.newton.damped_newton cimport begin_damped_newton, push_damped_newton
from lavender_ext.newton.elements cimport elements_t, invert_and_multiply
from lavender_ext.newton.natural_map cimport evaluate_all_natural_maps
from lavender_ext.newton.run cimport (DAMPED_NEWTON, FLOW, N_FLOW, copy_vector, flow_t, is_finished,
                                      judge_and_keep_best_point, newton_t, pop_phase, push_phase)
from lavender_ext.newton.steps cimport compute_all_normal_shifts
from lavender_ext.newton.system cimport NATURAL, factor_newton_system, multiply_system_matrix, solve_natural_map_system


cdef enum:
    MAX_FLOW_STEPS = 10         # Newton steps (2) of one Euler step; one that is not solved by them fails.
    FEW_FLOW_STEPS = 3          # eps falls if an Euler step takes at most this many.
    MANY_FLOW_STEPS = 8         # eps rises if it takes at least this many.
    MAX_FLOW_HALVINGS = 5       # Halvings of a Newton step.
    FLOW_TRIAL_FACTORISATIONS = 4   # Budget of damped Newton under Coulomb's law, at each decade of the residual.


cdef inline double flow_weight_fall() noexcept nogil:
    """Return the factor by which eps falls; with 0.5, some heaps are not solved."""
    return 0.8


cdef inline void begin_flow(newton_t* n, const double* z, int32_t limit, int32_t patience) noexcept nogil:
    """Begin at z, in place of an earlier flow or damped Newton.

    The phase ends after `limit` factorisations, or if `patience` of them do not halve the residual.
    """
    cdef flow_t* x = &n.flow
    cdef int32_t i, j
    for i in range(n.depth):
        if n.stack[i] == FLOW or n.stack[i] == DAMPED_NEWTON:   # Damped Newton has one state, which trials overwrite.
            n.depth = i
            break
    copy_vector(n, x.z, z)
    copy_vector(n, x.saved_z, z)
    multiply_system_matrix(&n.s, x.z, x.hz)
    memset(n.slack, 0, n.s.e.m * sizeof(double))
    evaluate_all_natural_maps(n.s.e, z, n.slack, CONE, 0.0, n.f, n.s.p, n.s.einv, NULL)
    for j in range(n.s.e.m):
        x.centre[j] = z[j] - n.f[j]
    x.eps = 3e-3                # relative to d; 1e-2 takes a tenth more factorisations on twelve walls, pyramids and heaps
    x.trial_residual = 1e-3
    x.inner_steps = 0
    x.lowest, x.patience = 1.0 / 0.0, patience
    x.since, x.last = n.s.factorisations, n.s.factorisations + limit
    push_phase(n, FLOW)


cdef inline double evaluate_flow_map(newton_t* n, double t) noexcept nogil:
    """Compute F of (1) at z + t dz into n.r and Pi_K(u) into n.t1; return |H F + eps F|, and eps |Pi_K(u) - c| in `move`."""
    cdef flow_t* x = &n.flow
    cdef const elements_t* e = n.s.e
    cdef int32_t j
    cdef double total = 0.0, move = 0.0, y
    for j in range(e.m):
        n.slack[j] = x.hz[j] + (t * n.hdz[j] if t != 0.0 else 0.0) - e.g[j]
    compute_all_normal_shifts(e, n.slack, 1.0, n.t2, n.psi)
    for j in range(e.m):
        n.trial[j] = x.centre[j] - (n.slack[j] + n.t2[j]) / x.eps
    memset(n.slack, 0, e.m * sizeof(double))
    evaluate_all_natural_maps(e, n.trial, n.slack, CONE, 0.0, n.f, n.s.p, n.s.einv, NULL)
    for j in range(e.m):
        n.t1[j] = n.trial[j] - n.f[j]
        n.r[j] = x.z[j] + (t * n.dz[j] if t != 0.0 else 0.0) - n.t1[j]
        y = n.t1[j] - x.centre[j]
        move += y * y
    multiply_system_matrix(&n.s, n.r, n.t2)
    for j in range(e.m):
        y = n.t2[j] + x.eps * n.r[j]
        total += y * y
    x.move = x.eps * sqrt(move)
    return sqrt(total)


cdef inline void form_flow_matrices(newton_t* n) noexcept nogil:
    """Replace P of the last `evaluate_flow_map` by D (I + e_n psi^T) of (2), and compute the other small matrices."""
    cdef const elements_t* e = n.s.e
    cdef int32_t i, j, k, l, q, nr
    cdef double first
    cdef double a[36]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        for k in range(nr):
            first = n.s.p[q + k * nr]
            for l in range(nr):
                n.s.p[q + k * nr + l] = (n.s.p[q + k * nr + l] + first * n.psi[j + l]) / n.flow.eps
                a[k * nr + l] = n.s.p[q + k * nr + l] * e.theta[j + l]
            a[k * nr + k] += 1.0
        invert_and_multiply(a, n.s.p + q, n.s.einv + q, n.s.v + q, nr)


cdef inline void move_flow_centre(newton_t* n) noexcept nogil:
    """Move the centre to Pi_K(u) of the last `evaluate_flow_map`, and save z."""
    copy_vector(n, n.flow.centre, n.t1)
    copy_vector(n, n.flow.saved_z, n.flow.z)


cdef inline void fail_flow_step(newton_t* n, double size) noexcept nogil:
    """Raise eps after an Euler step that is not solved; return to the last solved one if |F| `size` is large."""
    cdef flow_t* x = &n.flow
    x.eps = min(3.0 * x.eps, 1.0)
    x.inner_steps = 0
    if size <= 2.0 * x.move:
        move_flow_centre(n)
    else:
        copy_vector(n, x.z, x.saved_z)
        multiply_system_matrix(&n.s, x.z, x.hz)


cdef inline void step_flow(newton_t* n) noexcept nogil:
    """Take a Newton step (2), and end the Euler step if it is solved or takes too many."""
    cdef flow_t* x = &n.flow
    cdef int32_t j, _, m = n.s.e.m
    cdef double size, residual, value = 1.0 / 0.0, t = 1.0
    if is_finished(n) or n.s.factorisations >= x.last or n.s.factorisations - x.since > x.patience:
        pop_phase(n)
        return
    # Newton direction.
    size = evaluate_flow_map(n, 0.0)
    form_flow_matrices(n)
    n.s.law = COULOMB
    factor_newton_system(&n.s, NATURAL, 1.0)
    n.counts[N_FLOW] += 1
    x.inner_steps += 1
    for j in range(m):
        n.r[j] = -n.r[j]
    solve_natural_map_system(&n.s, n.r, n.dz)
    if not all_finite(n.dz, m):
        fail_flow_step(n, value)
        return
    multiply_system_matrix(&n.s, n.dz, n.hdz)
    # Line search.
    for _ in range(MAX_FLOW_HALVINGS):
        value = evaluate_flow_map(n, t)
        if value < (1.0 - 0.1 * t) * size:
            break
        t *= 0.5
    else:
        value = evaluate_flow_map(n, t)
    for j in range(m):
        x.z[j] += t * n.dz[j]
        x.hz[j] += t * n.hdz[j]
    if value <= 0.3 * x.move or value < 1e-14:          # The Euler step is solved.
        residual = judge_and_keep_best_point(n, n.t1)
        move_flow_centre(n)
        if residual < 0.5 * x.lowest:
            x.lowest, x.since = residual, n.s.factorisations
        if x.inner_steps <= FEW_FLOW_STEPS:
            x.eps = max(flow_weight_fall() * x.eps, 1e-6)
        elif x.inner_steps >= MANY_FLOW_STEPS:
            x.eps = min(x.eps / flow_weight_fall(), 1.0)
        x.inner_steps = 0
        if residual < x.trial_residual and not is_finished(n):      # Near a solution of Coulomb's law, damped Newton is tried.
            x.trial_residual = 0.1 * residual
            begin_damped_newton(n, n.t1, COULOMB, 1e-7, FLOW_TRIAL_FACTORISATIONS)
            push_damped_newton(n, FLOW_TRIAL_FACTORISATIONS)
    elif x.inner_steps >= MAX_FLOW_STEPS:
        fail_flow_step(n, value)
