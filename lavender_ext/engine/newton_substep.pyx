"""The velocity solve of a substep by Newton's method on the engine's arrays.

Native builds run its first phase only, WebAssembly all of it. After `prepare` and `solve` without sweeps:

    plan                    bands, elements, elimination order; integers and doubles that the factor needs
    substep                 the first phase of `newton` (newton/warm_start.pxd), then its steps (newton/solve.pyx); the
                            judge decides when to stop

Native builds and WebAssembly run the same code with the same bits. If the residual stays above tol after
`MAX_SUBSTEP_FACTORISATIONS`, the best impulse is kept, and UNDECIDED is returned.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.method cimport CERTIFICATE, MORE, info_t, method_t, options_t, workspace_t
from lavender_ext.core.islands cimport find_islands, island_workspace_integers
from lavender_ext.core.block_types cimport blocks_t, has_independent_rows, islands_t
from lavender_ext.core.view cimport rows_t, view_t
from lavender_ext.core.weights cimport compute_velocity_weights, set_angular_joint_weights
from lavender_ext.engine.arrays cimport S_OUT, bind_engine_arrays, engine_t
from lavender_ext.engine.view cimport bind_substep_problem
from lavender_ext.host cimport analyse_for_method, start_method, step_method
from lavender_ext.judge.measure cimport find_reference, score_given_slack
from lavender_ext.judge.score cimport make_empty_score, score_t
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.newton.solve cimport start_newton_over_bodies, bodies_workspace_size, step_newton_system
from lavender_ext.newton.warm_start cimport (FACTORED, JUDGED, MAX_TRACED_SCORES, UNDECIDED, compute_joint_bandwidth,
                                             bind_warm_start, judge_impulse, measure_as_engine, solve_from_warm_start, warm_t,
                                             zero_impulse_errors)


cdef enum:
    # Number of integers at the beginning of scratch: [0] band width, [1] number of integers of Newton's method, which follow these,
    # [2] needed number of integers in all.
    SCRATCH_HEADER = 4
    SCRATCH_TOO_SMALL = -2      # result of `lav_newton_plan` if scratch has too few integers
    INDEX_LIMIT = 2147483647
    MAX_SUBSTEP_FACTORISATIONS = 200    # maximum number of factorisations of a substep, because an image waits for the substep


cdef struct substep_arrays_t:   # arrays of a substep, besides `warm_t`
    int32_t* header             # (SCRATCH_HEADER)
    int32_t* newton             # integers of Newton's method
    int32_t* islands            # `island_workspace_integers`
    double* nu                  # (m)
    double* reference           # (blocks, 3)


cdef inline void bind_substep_memory(const view_t* v, int64_t newton, warm_t* s, substep_arrays_t* memory,
                                     arena_t* a) noexcept nogil:
    """Take the arrays, with `newton` integers for Newton's method; s.width is set, unless only the integers are used."""
    memory.header, memory.newton = take_integers(a, SCRATCH_HEADER), take_integers(a, newton)
    memory.nu = take_doubles(a, v.p.n_rows)
    bind_warm_start(s, &v.p, v.r, a)
    memory.islands = take_integers(a, island_workspace_integers(v))
    memory.reference = take_doubles(a, 3 * <int64_t>v.p.n_blocks)


cdef inline int32_t provides_memory(workspace_t* memory, int64_t n_index, int64_t n_real) noexcept nogil:
    """Return whether the memory of the substep has these sizes; it does not grow within a call."""
    return n_index <= memory.n_index and n_real <= memory.n_real


cdef public int32_t lav_newton_plan(const int32_t* size, double* real, int32_t* index, uint64_t* keys, int32_t all_stages,
                                    int32_t available, int32_t* scratch) noexcept nogil:
    """Fill scratch (8-byte aligned); return the number of doubles that the solve needs, -1 if too many for int32.

    `available` is the number of integers of scratch, at least SCRATCH_HEADER. If it is too small, the result is
    SCRATCH_TOO_SMALL: the host allocates scratch[2] integers and calls again. With all_stages = 0 only the first phase is planned.
    """
    cdef engine_t e
    cdef int64_t used[3]
    cdef int64_t needed = 0, own
    cdef blocks_t p
    cdef rows_t r
    cdef view_t v
    cdef options_t o = options_t(0, 0, 0, 0, 0, 0.0, 1.0, 1.0, 1.0 / 0.0, 0.0, NULL, NULL)
    cdef workspace_t n, space
    cdef method_t f = method_t(bodies_workspace_size, start_newton_over_bodies, step_newton_system)
    cdef warm_t s
    cdef substep_arrays_t memory
    cdef arena_t a = make_arena(NULL, NULL)
    bind_engine_arrays(size, real, index, keys, &e, used)
    bind_substep_problem(&e, &p, &r)
    v = view_t(p, NULL, &r, NULL)
    s.width = 0
    bind_substep_memory(&v, 0, &s, &memory, &a)
    own, scratch[1] = a.n_index, 0
    if own >= INDEX_LIMIT:
        return -1
    if own > available:
        scratch[2] = <int32_t>own
        return SCRATCH_TOO_SMALL
    if all_stages:                                      # Pattern, and size of the other workspace
        scratch[1] = <int32_t>(available - own)
        space = workspace_t(scratch[1], 0, scratch + SCRATCH_HEADER, NULL, 0, 0, 0, 0.0)
        analyse_for_method(&f, &v, &o, &n, &space, provides_memory)
        if n.is_bound:
            needed = n.n_real
        elif scratch[1] < n.n_index < INDEX_LIMIT - own:
            scratch[2] = <int32_t>(n.n_index + own)
            return SCRATCH_TOO_SMALL
        else:
            scratch[1] = 0                              # The factor has too many entries: only the first phase runs.
    a = make_arena(NULL, scratch)
    bind_substep_memory(&v, scratch[1], &s, &memory, &a)
    scratch[0] = compute_joint_bandwidth(&p, &r, s.last_joint)
    needed += a.n_real + <int64_t>scratch[0] * p.n_rows
    return <int32_t>needed if needed < INDEX_LIMIT else -1


cdef inline int32_t solve_newton_substep(const blocks_t* p, const rows_t* r, warm_t* s, double tol, int32_t all_stages,
                                         const substep_arrays_t* memory, double* workspace, double* lam, double* v) noexcept nogil:
    """Run the first phase, then with `all_stages` Newton's method, also from lam = 0; return the result code.

    If it is UNDECIDED after all stages, lam is the best impulse.
    """
    cdef int32_t j, result = solve_from_warm_start(p, r, s, tol, lam, v, 1)
    cdef double e0 = 1.0, v0 = 1.0
    cdef view_t problem
    cdef options_t o
    cdef info_t info = info_t(0, 0, 0, 0, 1.0 / 0.0, NULL, NULL)
    cdef workspace_t space = workspace_t(memory.header[1], INDEX_LIMIT, memory.newton, workspace, 1, 0, 0, 0.0), n = space
    cdef method_t f = method_t(bodies_workspace_size, start_newton_over_bodies, step_newton_system)
    if result != UNDECIDED or p.n_rows == 0 or not all_stages:
        return result
    s.relative = 1.0 / 0.0
    if not zero_impulse_errors(p, &e0, &v0):
        if e0 == 0.0 and v0 == 0.0:                     # The solution is lam = 0.
            for j in range(p.n_rows):
                lam[j] = 0.0
            judge_impulse(p, r, s, lam, v, 1.0, 1.0)
            s.relative = 0.0
            return JUDGED
        return UNDECIDED
    if not memory.header[1]:
        return UNDECIDED
    problem = view_t(p[0], NULL, r, NULL)
    o = options_t(0, MAX_SUBSTEP_FACTORISATIONS, 0, 0, has_wide(), tol, e0, v0, 1.0 / 0.0, 0.0, NULL, NULL)
    result = start_method(&f, &problem, &o, &n, lam, &space, provides_memory)   # `lav_newton_plan` computed the pattern.
    while result == MORE or result == CERTIFICATE:
        result = step_method(&f, &problem, &o, &n, 1 if s.trace != NULL else MAX_SUBSTEP_FACTORISATIONS, lam, &info)
        s.factorisations = info.factorisations
        if s.trace != NULL:
            judge_impulse(p, r, s, info.tried, v, e0, v0)
    s.relative = judge_impulse(p, r, s, lam, v, e0, v0)
    return FACTORED if info.relative <= tol else UNDECIDED


cdef inline void find_substep_islands(blocks_t* p, const rows_t* r, warm_t* s, int32_t* index, double* reference,
                                      islands_t* islands) noexcept nogil:
    """Find the islands of the substep and their reference errors, if there are several and all bounds contain 0.

    The arrays of s are scratch. Bounds of contact rows are not read.
    """
    cdef view_t v = view_t(p[0], NULL, r, NULL)
    cdef score_t score = make_empty_score()
    cdef double start[3]
    cdef int32_t i, j
    if p.n_rows == 0 or find_islands(&v, index, islands) == 1:
        return
    for i in range(p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            s.start[j], s.slack[j] = 0.0, -p.b[j]
            if has_independent_rows(p, i) and not p.lower[j] <= 0.0 <= p.upper[j]:
                return
    score_given_slack(p, s.start, s.slack, s.error, &score)
    islands.reference = reference
    p.islands = islands
    find_reference(p, s.start, s.slack, s.error, start)


cdef public int32_t lav_newton_substep(const int32_t* size, double* real, int32_t* index, uint64_t* keys, double tol,
                                       int32_t all_stages, int32_t* scratch, double* workspace, double* trace,
                                       double* said) noexcept nogil:
    """Compute impulses, dv and statistics of the prepared substep; return the result code, UNDECIDED if above tol.

    With the first phase only (all_stages = 0), UNDECIDED leaves the arrays unchanged. scratch and workspace belong to
    `lav_newton_plan`. trace (MOST_TRACED, 3) or NULL receives work, E [sqrt J] and max |e_n| [N s] of each evaluation;
    said (4) receives sweeps, factorisations, relative residual and the number of traced evaluations.
    """
    cdef engine_t e
    cdef int64_t used[3]
    cdef blocks_t p
    cdef rows_t r
    cdef warm_t s
    cdef islands_t islands
    cdef substep_arrays_t memory
    cdef arena_t a = make_arena(workspace, scratch)
    cdef int32_t result
    cdef view_t v
    bind_engine_arrays(size, real, index, keys, &e, used)
    bind_substep_problem(&e, &p, &r)
    v = view_t(p, NULL, &r, NULL)
    s.width = scratch[0]
    bind_substep_memory(&v, scratch[1], &s, &memory, &a)
    compute_velocity_weights(&p, p.d, memory.nu)
    set_angular_joint_weights(&p, &r, memory.nu)
    p.nu = memory.nu
    s.keeps_start = not all_stages                      # Sweeps follow, which begin from the start.
    s.trace, s.deadline = trace, NULL
    s.relative = 0.0
    find_substep_islands(&p, &r, &s, memory.islands, memory.reference, &islands)
    result = solve_newton_substep(&p, &r, &s, tol, all_stages, &memory, take_doubles(&a, 0), e.impulse, e.dv)
    if p.n_rows > 0 and (all_stages or result != UNDECIDED):
        measure_as_engine(&p, &r, &s, e.setting + S_OUT + 5, e.setting + S_OUT + 7)
    said[0] = s.sweeps
    said[1] = s.factorisations
    said[2] = s.relative
    said[3] = s.n_traced
    return result


cdef class Substep:
    """Newton substep on an engine's buffers, for Python; `all_stages`: continue after the first phase and trace evaluations."""
    cdef const int32_t[::1] size
    cdef double[::1] real
    cdef int32_t[::1] index
    cdef uint64_t[::1] keys
    cdef double[::1] scratch, workspace
    cdef double[:, ::1] noted
    cdef double[4] said
    cdef int32_t all_stages

    def __init__(self, const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys, bint all_stages):
        self.size, self.real, self.index, self.keys, self.all_stages = size, real, index, keys, all_stages
        self.scratch, self.workspace = np.empty(SCRATCH_HEADER // 2), np.empty(1)
        self.noted = np.zeros((MAX_TRACED_SCORES if all_stages else 0, 3))

    cdef int32_t _plan(self) noexcept:
        return lav_newton_plan(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], self.all_stages,
                               <int32_t>min(2 * self.scratch.shape[0], INDEX_LIMIT), <int32_t*>&self.scratch[0])

    def solve(self, double tol):
        """Solve after `prepare` and `solve(False)`; return (result code, sweeps, factorisations, relative residual)."""
        cdef int32_t result, n
        cdef double* trace = NULL
        if self.all_stages:
            trace = &self.noted[0, 0]
        n = self._plan()
        while n == SCRATCH_TOO_SMALL:
            n = (<int32_t*>&self.scratch[0])[2]
            self.scratch = np.empty(n // 2 + n // 8 + 1)
            n = self._plan()
        if n < 0:
            raise MemoryError("the substep needs more than 2^31 numbers of scratch")
        if self.workspace.shape[0] < n:
            self.workspace = np.empty(n + n // 4)
        with nogil:
            result = lav_newton_substep(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], tol, self.all_stages,
                                     <int32_t*>&self.scratch[0], &self.workspace[0], trace, self.said)
        return result, <int>self.said[0], <int>self.said[1], self.said[2]

    @property
    def trace(self):
        """Trace of the last solve (n, 3): sweeps and factorisations so far, E [sqrt J], max |e_n| [N s], a row per evaluation."""
        return np.asarray(self.noted)[: <int>self.said[3]].copy()
