"""Gradients of one world by its data: equations (4) and (5) of lavender/gradient/derivative.py, without the interpreter.

A scalar has the gradients y by v+, c by lambda and x by w. With q, s and f = y - J^T s of derivative/linear.pyx (1):

    p = M^-1 f      v' = M^-1 J^T lambda      e = (dPi/de)^T q                                                     (1)

The gradients by all data are products of these arrays (`lavender/gradient/worlds.py`).
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from lavender_ext.batch.task cimport prepare_task
from lavender_ext.core.arena cimport arena_t, has_memory, make_arena, take_doubles
from lavender_ext.core.generalized cimport multiply_jacobian_transpose, solve_mass_matrix
from lavender_ext.core.method cimport workspace_t
from lavender_ext.derivative.linear cimport (bind_derivative_factor, bind_linearised_arrays,
                                             derivative_factor_scratch_size, factor_derivative_system,
                                             judge_and_linearise, lav_adjoint)
from lavender_ext.derivative.natural cimport linearised_t, multiply_block_derivatives
from lavender_ext.judge.measure cimport count_judge_scratch
from lavender_ext.small.task cimport BOUND, MORE, grow_workspace_to_arena, task_t


cdef struct cotangents_t:       # of one world; NULL counts as 0
    const double* velocity      # y (n)
    const double* impulse       # c (m)
    const double* slack         # x (m)


cdef struct adjoint_t:          # results of one world
    double* q                   # (m)
    double* s                   # (m)
    double* e                   # (m)
    double* f                   # (n)
    double* p                   # (n)
    double* change              # (n) v'


cdef inline bint adjoin_task(task_t* j, workspace_t* workspaces, const double* lam, int32_t max_rows,
                             double max_residual, const cotangents_t* y, const adjoint_t* out) noexcept nogil:
    """Compute the results of a task over J and M at the solution lam (m); return whether the derivative exists here.

    The caller differentiates a world by itself if G has more than `max_rows` rows or is singular, or if the relative residual
    of lam is above `max_residual`.
    """
    cdef linearised_t a
    cdef arena_t arena = make_arena(NULL, NULL)
    cdef int32_t m = j.v.p.n_rows, _pass
    cdef double* scratch
    cdef int64_t size
    if not prepare_task(j, workspaces) or j.made.n_empty:
        return False
    memset(&a, 0, sizeof(a))
    a.v, a.n = j.v, j.g.n
    size = m + count_judge_scratch(&j.v)
    for _pass in range(2):                              # The first pass counts the numbers.
        bind_linearised_arrays(&a, &arena)
        scratch = take_doubles(&arena, size)
        if not has_memory(&arena) and not grow_workspace_to_arena(&workspaces[MORE], &arena):
            return False
    judge_and_linearise(&a, lam, j.zero_residual[0], j.zero_residual[1], scratch)
    if not a.relative <= max_residual or a.rows > max_rows:
        return False
    arena = make_arena(NULL, NULL)
    size = derivative_factor_scratch_size(a.rows, &j.v)
    for _pass in range(2):
        bind_derivative_factor(&a, &arena)
        scratch = take_doubles(&arena, size + 1)
        if not has_memory(&arena) and not grow_workspace_to_arena(&workspaces[BOUND], &arena):
            return False
    if not factor_derivative_system(&a, &j.v, 0.0, scratch):
        return False
    lav_adjoint(&a, y.velocity, y.impulse, y.slack, out.q, out.s, out.f)
    multiply_block_derivatives(&a.x, &j.v.p, a.x.edge, out.q, True, out.e)
    memcpy(out.p, out.f, a.n * sizeof(double))
    solve_mass_matrix(&j.g, out.p)
    multiply_jacobian_transpose(&j.g, lam, out.change)
    solve_mass_matrix(&j.g, out.change)
    return True
