"""Newton's method over generalised velocities as workspace, start and step (`core/method.pxd`).

The unit of work is a step of one island; with 0 units the present impulse is judged. `workspace_t.work` counts the
multiply-adds of N and of its factor, of all islands.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.arena cimport arena_t, make_arena, take_integers
from lavender_ext.core.method cimport MORE, NEEDS_WORKSPACE, SPENT, UNFIT, require_workspace, options_t, workspace_t, info_t
from lavender_ext.core.view cimport view_t
from lavender_ext.velocity_newton.flow cimport flow_t
from lavender_ext.velocity_newton.islands cimport (bind_iterate, bind_structure, find_islands_and_factor_patterns, requirements_t,
                                                   structure_t)
from lavender_ext.velocity_newton.newton cimport form_kept_matrix, solve_islands
from lavender_ext.velocity_newton.sparse cimport initial_entries_per_row


cdef struct state_t:            # at the beginning of the integer workspace
    flow_t f
    requirements_t need
    int32_t done                # steps so far


cdef inline void bind_analysis(state_t* s, const view_t* v, int32_t tries, structure_t* memory, arena_t* a) noexcept nogil:
    """Take the state, and the integers for a pattern of L that doubles with each of `tries`."""
    take_integers(a, sizeof(state_t) // sizeof(int32_t))
    bind_structure(&s.f, &v.p, v.g, initial_entries_per_row(v.g.n) << tries, memory, a)


cdef inline int32_t islands_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the size of the integer workspace for the smallest pattern; the real size follows from the pattern."""
    cdef state_t s
    cdef structure_t memory
    cdef arena_t a = make_arena(NULL, NULL)
    bind_analysis(&s, v, r.tries, &memory, &a)
    r.n_index, r.n_real = a.n_index, 0
    return 1


cdef inline void keep_island_matrix(workspace_t* r) noexcept nogil:
    """Let later starts, with the same J and M, keep the columns of A of a single island."""
    (<state_t*>r.index).f.keeps_matrix = True


cdef inline int32_t start_islands(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    """Find the structure, then bind the workspace; NEEDS_WORKSPACE, UNFIT or MORE."""
    cdef state_t* s = <state_t*>r.index
    cdef requirements_t* need = &s.need
    cdef int32_t per
    cdef double entries, factored
    cdef workspace_t smallest = r[0]
    cdef structure_t memory
    cdef arena_t a, counted = make_arena(NULL, NULL)
    while not r.is_bound:
        islands_workspace_size(v, o, &smallest)
        if not require_workspace(r, smallest.n_index, 0):
            return NEEDS_WORKSPACE
        per = initial_entries_per_row(v.g.n) << r.tries
        a = make_arena(NULL, r.index)
        bind_analysis(s, v, r.tries, &memory, &a)
        find_islands_and_factor_patterns(&s.f, &v.p, v.g, per, &memory, need)
        r.is_bound = not need.exceeds_pattern
        r.work, r.islands = need.work, s.f.n_islands
        # A factor with c_i entries in row i takes sum c_i^2 / 2 multiply-adds, which is smallest if all c_i are equal.
        entries = <double>per * v.g.n
        factored = max(entries - need.unused_entries, 0.0)
        if (need.exceeds_pattern and (entries > o.most or 0.0 < o.work < 0.5 * factored * factored / v.g.n)
                or r.is_bound and max(need.values, need.row_matrix_values) > o.most):
            return UNFIT
        smallest.tries = r.tries = r.tries + (1 - r.is_bound)  # Retry with twice the entries per row.
    bind_iterate(&s.f, need, &counted)
    if not require_workspace(r, r.n_index, counted.n_real):
        return NEEDS_WORKSPACE
    a = make_arena(r.real, NULL)
    bind_iterate(&s.f, need, &a)
    s.f.wide, s.f.deadline = o.wide, o.deadline
    s.f.p.b, s.f.p.islands, s.f.g = v.p.b, v.p.islands, v.g      # Another b may have been given since the analysis.
    form_kept_matrix(&s.f)
    s.f.tol, s.f.reference_energy, s.f.reference_velocity = o.tol, o.e0, o.v0       # The reference is that of one island.
    s.f.paused.island = -1
    s.done = s.f.steps = s.f.factorisations = s.f.rounds = s.f.evaluations = 0
    return MORE


cdef inline int32_t advance_islands(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                                 info_t* info) noexcept nogil:
    """Take steps on the islands, beginning with a paused island."""
    cdef state_t* s = <state_t*>r.index
    cdef int32_t how = SPENT, left = o.budget - s.done
    info.direction = info.tried = NULL
    info.relative = -1.0
    if left > 0 and not o.stop:
        s.f.steps = work = work if work < left else left
        s.f.deadline = o.deadline
        how = solve_islands(&s.f, lam)
        s.done += work - s.f.steps
        if how == MORE and (s.done >= o.budget or o.deadline != NULL and o.deadline.passed):
            how = SPENT
    info.work, info.factorisations = s.done, s.f.factorisations
    info.rounds, info.evaluations = s.f.rounds, s.f.evaluations
    return how
