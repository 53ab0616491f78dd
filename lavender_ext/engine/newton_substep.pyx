"""The velocity solve of a substep by Newton's method on the engine's arrays: natively its first phase, in a browser whole.

After `prepare` and `solve` without sweeps:

    index_workspace_size      whole numbers that the next call needs
    plan            bands, elements, elimination order; doubles that the next call needs
    solve           the first phase of `newton` (newton/warm_start.pxd), then its steps (newton/solve.pyx); the judge decides

Natively and in WebAssembly the same lines, the same bits. What asks for another library, the augmented system, is left out;
where that or `BUDGET` leaves the residual above tol, the best impulse found stays, and is told as such.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.method cimport CERTIFICATE, MORE, options_t, workspace_t, said_t
from lavender_ext.core.islands cimport find_islands, islands_index
from lavender_ext.core.parts cimport blocks_t, is_rows, islands_t
from lavender_ext.core.view cimport rows_t, view_t
from lavender_ext.core.weights cimport block_weights, joint_weights
from lavender_ext.engine.arrays cimport S_OUT, bind, engine_t
from lavender_ext.engine.view cimport view
from lavender_ext.judge.measure cimport find_reference, score_slack
from lavender_ext.judge.score cimport new_score, score_t
from lavender_ext.newton.solve cimport bodies_workspace_size, bodies_start, system_step
from lavender_ext.newton.warm_start cimport (FACTORED, JUDGED, MOST_TRACED, UNDECIDED, band_width, judged, lay_out,
                                      observe, room_of, start_errors, warm_solve, warm_t)


cdef enum:
    HEAD = 4                    # whole numbers before those of the method: width of the band, how many these are
    MOST = 2147483647
    BUDGET = 200                # factorisations: a picture waits for them


cdef inline workspace_t method_workspace_size(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Whole numbers of Newton's method, 0 where it does not take the problem."""
    cdef view_t v = view_t(p[0], NULL, r, NULL)
    cdef workspace_t workspace = workspace_t(0, 0, NULL, NULL, 0, 0, 0, 0.0)
    if not bodies_workspace_size(&v, NULL, &workspace):
        workspace.n_index = 0
    return workspace


cdef public int32_t lav_newton_index_workspace_size(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                          int32_t turns) noexcept nogil:
    """Whole numbers of scratch for the prepared substep, -1 for 2^31 and more; turns 0: the first phase alone."""
    cdef engine_t e
    cdef int64_t used[3]
    cdef int64_t workspace
    cdef blocks_t p
    cdef rows_t r
    cdef view_t v
    bind(size, real, index, keys, &e, used)
    view(&e, &p, &r)
    v = view_t(p, NULL, &r, NULL)
    workspace = HEAD + r.n_bodies + 2 * <int64_t>r.n_joints + 1 + islands_index(&v)
    if turns:
        workspace += method_workspace_size(&p, &r).n_index
    return <int32_t>workspace if workspace < MOST else -1


cdef public int32_t lav_newton_plan(const int32_t* size, double* real, int32_t* index, uint64_t* keys, int32_t turns,
                                    int32_t* scratch) noexcept nogil:
    """Fills scratch, which begins at a multiple of 8 bytes; doubles that the solve needs, -1 for 2^31 and more."""
    cdef engine_t e
    cdef int64_t used[3]
    cdef int64_t workspace
    cdef blocks_t p
    cdef rows_t r
    cdef view_t v
    cdef workspace_t n
    bind(size, real, index, keys, &e, used)
    view(&e, &p, &r)
    n = method_workspace_size(&p, &r)
    scratch[1] = <int32_t>n.n_index if turns else 0
    scratch[0] = band_width(&p, &r, scratch + HEAD + scratch[1])
    workspace = room_of(&p, scratch[0]) + p.n_rows + 2 * <int64_t>p.n_blocks
    if scratch[1] > 0:
        v = view_t(p, NULL, &r, NULL)
        n.index = scratch + HEAD
        bodies_start(&v, NULL, &n, NULL)                # finds the pattern, and how much more workspace it needs
        workspace += n.n_real
    return <int32_t>workspace if workspace < MOST else -1


cdef inline int32_t solve_in_turns(const view_t* problem, const options_t* o, workspace_t* workspace, warm_t* s, double* lam,
                                   double* v) noexcept nogil:
    """What `warm_solve` has left undecided, also from lam = 0; UNDECIDED short of tol: lam is then the best that was scored."""
    cdef said_t said
    cdef int32_t how = bodies_start(problem, o, workspace, lam)
    while how == MORE or how == CERTIFICATE:
        how = system_step(problem, o, workspace, 1, lam, &said)
        s.factorisations = said.factorisations
        if s.trace != NULL:
            judged(&problem.p, problem.r, s, said.tried, v, o.e0, o.v0)
    s.relative = judged(&problem.p, problem.r, s, lam, v, o.e0, o.v0)
    return FACTORED if said.relative <= o.tol else UNDECIDED


cdef inline int32_t newton_substep(const blocks_t* p, const rows_t* r, warm_t* s, double tol, int32_t turns,
                                   int32_t* scratch, double* workspace, double* lam, double* v) noexcept nogil:
    cdef int32_t j, how = warm_solve(p, r, s, tol, lam, v, 1)
    cdef double e0 = 1.0, v0 = 1.0
    cdef view_t problem
    cdef options_t o
    cdef workspace_t n
    if how != UNDECIDED or p.n_rows == 0 or not turns:
        return how
    s.relative = 1.0 / 0.0
    if not start_errors(p, &e0, &v0):
        if e0 == 0.0 and v0 == 0.0:                     # nothing to do
            for j in range(p.n_rows):
                lam[j] = 0.0
            judged(p, r, s, lam, v, 1.0, 1.0)
            s.relative = 0.0
            return JUDGED
        return UNDECIDED
    if not scratch[1]:
        return UNDECIDED
    problem = view_t(p[0], NULL, r, NULL)
    o = options_t(0, BUDGET, 0, 0, 0, tol, e0, v0, 1.0 / 0.0, 0.0)
    n = workspace_t(scratch[1], MOST, scratch + HEAD, workspace, 1, 0, 0, 0.0)    # the pattern stands from `lav_newton_plan`
    return solve_in_turns(&problem, &o, &n, s, lam, v)


cdef inline void bind_islands(blocks_t* p, const rows_t* r, warm_t* s, int32_t* index, double* reference,
                              islands_t* islands) noexcept nogil:
    """Islands of the substep with their references, if there are several and all bounds hold 0; arrays of s are scratch.

    Engine contacts have no bounds to be read.
    """
    cdef view_t v = view_t(p[0], NULL, r, NULL)
    cdef score_t score = new_score()
    cdef double start[3]
    cdef int32_t i, j
    if p.n_rows == 0 or find_islands(&v, index, islands) == 1:
        return
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            s.kept[j], s.slack[j] = 0.0, -p.b[j]
            if is_rows(p, i) and not p.lower[j] <= 0.0 <= p.upper[j]:
                return
    score_slack(p, s.kept, s.slack, s.error, &score)
    islands.reference = reference
    p.islands = islands
    find_reference(p, s.kept, s.slack, s.error, start)


cdef public int32_t lav_newton_substep(const int32_t* size, double* real, int32_t* index, uint64_t* keys, double tol,
                                       int32_t turns, int32_t* scratch, double* workspace, double* trace,
                                       double* said) noexcept nogil:
    """Impulses, dv and the solver values of the prepared substep; how it ended, UNDECIDED where short of tol.

    Of the first phase alone (turns 0) UNDECIDED leaves all of it as it was. scratch and workspace as `lav_newton_plan` has them;
    trace (MOST_TRACED, 3) or NULL takes work, E [sqrt J] and max |e_n| [N s] of each score; said (4) takes sweeps,
    factorisations, relative residual and scores noted.
    """
    cdef engine_t e
    cdef int64_t used[3]
    cdef blocks_t p
    cdef rows_t r
    cdef warm_t s
    cdef islands_t islands
    cdef int64_t own
    cdef int32_t how, marks
    bind(size, real, index, keys, &e, used)
    view(&e, &p, &r)
    block_weights(&p, p.d, workspace)
    joint_weights(&p, &r, workspace)
    p.nu = workspace
    s.width = scratch[0]
    s.trace = trace
    s.relative = 0.0
    own = room_of(&p, s.width) + p.n_rows
    marks = HEAD + scratch[1]
    lay_out(&s, workspace + p.n_rows, scratch + marks, &p, &r)
    bind_islands(&p, &r, &s, scratch + marks + r.n_bodies + 2 * r.n_joints + 1, workspace + own, &islands)
    own += 2 * <int64_t>p.n_blocks
    how = newton_substep(&p, &r, &s, tol, turns, scratch, workspace + own, e.impulse, e.dv)
    if p.n_rows > 0 and (turns or how != UNDECIDED):
        observe(&p, &r, &s, e.setting + S_OUT + 5, e.setting + S_OUT + 7)
    said[0] = s.sweeps
    said[1] = s.factorisations
    said[2] = s.relative
    said[3] = s.traced
    return how


cdef class Substep:
    """The same for Python, beside an engine's three buffers; `stages`: after the first phase, noting each score."""
    cdef const int32_t[::1] size
    cdef double[::1] real
    cdef int32_t[::1] index
    cdef uint64_t[::1] keys
    cdef double[::1] scratch, workspace
    cdef double[:, ::1] noted
    cdef double[4] said
    cdef int32_t turns

    def __init__(self, const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys, bint turns):
        self.size, self.real, self.index, self.keys, self.turns = size, real, index, keys, turns
        self.scratch, self.workspace = np.empty(1), np.empty(1)
        self.noted = np.zeros((MOST_TRACED if turns else 0, 3))

    cdef int _make_scratch(self) except -1:
        cdef int32_t n = lav_newton_index_workspace_size(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], self.turns)
        if n < 0:
            raise MemoryError("the substep needs more than 2^31 numbers of scratch")
        if 2 * self.scratch.shape[0] < n:
            self.scratch = np.empty(n)
        return 0

    def solve(self, double tol):
        """After `prepare` and `solve(False)`: (how it ended, sweeps, factorisations, relative residual)."""
        cdef int32_t how, n
        cdef double* trace = NULL
        self._make_scratch()
        if self.turns:
            trace = &self.noted[0, 0]
        n = lav_newton_plan(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], self.turns,
                            <int32_t*>&self.scratch[0])
        if n < 0:
            raise MemoryError("the substep needs more than 2^31 numbers of scratch")
        if self.workspace.shape[0] < n:
            self.workspace = np.empty(n + n // 4)
        with nogil:
            how = lav_newton_substep(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], tol, self.turns,
                                     <int32_t*>&self.scratch[0], &self.workspace[0], trace, self.said)
        return how, <int>self.said[0], <int>self.said[1], self.said[2]

    @property
    def trace(self):
        """Of the last solve: sweeps and factorisations so far, E [sqrt J], max |e_n| [N s], a line for each score."""
        return np.asarray(self.noted)[: <int>self.said[3]].copy()
