"""Newton's method over generalised velocities as workspace, start and step (`core/method.pxd`).

The unit of work is a step of one island; 0 judges what is there. `workspace_t.work` has N of all islands and a factor of each.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport MORE, NEEDS_WORKSPACE, SPENT, UNFIT, require_workspace, options_t, workspace_t, info_t
from lavender_ext.core.view cimport view_t
from lavender_ext.velocity_newton.flow cimport flow_t
from lavender_ext.velocity_newton.islands cimport aim_at, bind_real_workspace, marks_of, need_t, numbers_of, settle
from lavender_ext.velocity_newton.newton cimport descend_all
from lavender_ext.velocity_newton.sparse cimport per_column


cdef struct state_t:            # at the beginning of the workspace's whole numbers
    flow_t f
    need_t need
    int32_t done                # steps


cdef inline int32_t general_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Whole numbers for the least fill; the others are known when the fill is."""
    r.n_index = sizeof(state_t) // sizeof(int32_t) + marks_of(&v.p, v.g, per_column(v.g.n) << r.tries)
    r.n_real = 0
    return 1


cdef inline bint is_past(const options_t* o, const need_t* need, double entries, double n) noexcept nogil:
    """Is a factor of more entries than these in n rows too large, or too much work?

    One of c_i entries in row i takes sum c_i^2 / 2 multiply-adds, at least as many as where all rows have the same.
    """
    cdef double factored = max(entries - need.idle, 0.0)
    return entries > o.most or 0.0 < o.work < 0.5 * factored * factored / n


cdef inline int32_t general_start(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef state_t* s = <state_t*>r.index
    cdef need_t* need = &s.need
    cdef int32_t per
    cdef workspace_t least = r[0]
    while not r.is_bound:
        general_workspace_size(v, o, &least)
        if not require_workspace(r, least.n_index, 0):
            return NEEDS_WORKSPACE
        per = per_column(v.g.n) << r.tries
        settle(&s.f, &v.p, v.g, per, r.index + sizeof(state_t) // sizeof(int32_t), need)
        r.is_bound = not need.crowded
        r.work, r.islands = need.work, s.f.n_islands
        if (need.crowded and is_past(o, need, <double>per * v.g.n, v.g.n)
                or r.is_bound and max(need.values, need.formed) > o.most):
            return UNFIT
        least.tries = r.tries = r.tries + (1 - r.is_bound)  # L has more entries than that in a row
    if not require_workspace(r, r.n_index, numbers_of(&s.f, need)):
        return NEEDS_WORKSPACE
    bind_real_workspace(&s.f, need, r.real)
    s.f.wide = o.wide
    aim_at(&s.f, o.tol, 0, o.e0, o.v0)
    s.done = 0
    return MORE


cdef inline int32_t general_step(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                                 info_t* info) noexcept nogil:
    """All islands, the one that waits first."""
    cdef state_t* s = <state_t*>r.index
    cdef int32_t how = SPENT, left = o.budget - s.done
    info.direction = info.tried = NULL
    info.relative = -1.0
    if left > 0 and not o.stop:
        s.f.steps = work = work if work < left else left
        how = descend_all(&s.f, lam)
        s.done += work - s.f.steps
        if how == MORE and s.done >= o.budget:
            how = SPENT
    info.work, info.factorisations = s.done, s.f.factorisations
    info.rounds, info.evaluations = s.f.rounds, s.f.evaluations
    return how
