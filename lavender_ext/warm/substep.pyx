"""The velocity solve of a substep by Newton's method, whole, on the engine's arrays: what a browser has of `newton`.

After `prepare` and `solve` without sweeps:

    index_room      whole numbers that the next call needs
    plan            bands, elements, elimination order; doubles that the next call needs
    solve           the first phase of `newton` (start.pxd), then proximal rounds (newton/phases.pxd) and sweeps; the
                    judge's residual decides

Natively and in WebAssembly the same lines, the same bits. `newton` itself goes on to interior points where walks end
short of tol; here the best impulse found stays, and is told as such.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.block cimport COULOMB, blocks_t
from lavender_ext.core.rows cimport relax_rows_block, rows_t
from lavender_ext.core.velocity cimport rows_velocity
from lavender_ext.core.weights cimport block_weights, joint_weights
from lavender_ext.engine.arrays cimport S_OUT, bind, engine_t
from lavender_ext.engine.view cimport view
from lavender_ext.newton.bodies cimport body_room, furnish_bodies, index_room, lay_pattern, make_pattern, pattern_t
from lavender_ext.newton.phases cimport LIMITLESS, begin_rounds, enter_rounds, go_rounds
from lavender_ext.newton.scaling cimport find_elements
from lavender_ext.newton.run cimport INNER, N_ROUNDS, aim, impulse_of, judge_room, lay_judge, newton_t, unknown_of
from lavender_ext.warm.start cimport (JUDGED, MOST_SWEEPS, MOST_TRACED, UNDECIDED, WALKED, band_width, judged, lay_out,
                                      observe, room_of, scored, start_errors, warm_solve, warm_t)


cdef enum:
    HEAD = 4                    # whole numbers before the pattern: width of the band, whether walks apply
    MOST = 2147483647
    FIRST_STEPS = 20            # factorisations of the first walk
    NEXT_STEPS = 40             # of each that follows
    TURNS = 4
    SMALL = 64                  # rows up to which the first weight is smaller, from `LARGE` on it is larger
    LARGE = 1000


cdef inline int64_t warm_indices(const rows_t* r) noexcept nogil:
    return <int64_t>r.n_bodies + 2 * r.n_joints


cdef public int32_t lav_newton_index_room(const int32_t* size, double* real, int32_t* index,
                                          uint64_t* keys) noexcept nogil:
    """Whole numbers of scratch for the prepared substep, -1 for 2^31 and more."""
    cdef engine_t e
    cdef int64_t used[3]
    cdef int64_t room
    cdef blocks_t p
    cdef rows_t r
    bind(size, real, index, keys, &e, used)
    view(&e, &p, &r)
    room = HEAD + index_room(&p, &r) + warm_indices(&r) + 1
    return <int32_t>room if room < MOST else -1


cdef public int32_t lav_newton_plan(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                    int32_t* scratch) noexcept nogil:
    """Fills scratch, which begins at a multiple of 8 bytes; doubles that the solve needs, -1 for 2^31 and more."""
    cdef engine_t e
    cdef int64_t used[3]
    cdef int64_t room, walks
    cdef blocks_t p
    cdef rows_t r
    cdef newton_t n
    cdef pattern_t a
    bind(size, real, index, keys, &e, used)
    view(&e, &p, &r)
    walks = index_room(&p, &r)
    scratch[0] = band_width(&p, &r, scratch + HEAD + walks)
    scratch[1] = walks > 0
    room = room_of(&p, &r, scratch[0]) + p.n_rows
    if walks > 0:
        lay_pattern(&n, &a, scratch + HEAD, &p, &r)
        find_elements(&n.sc, &p, NULL, &r)
        make_pattern(&n.sc, &a, &r)
        room += judge_room(&p, &r, NULL) + body_room(&n, &a, &p, &r)
    return <int32_t>room if room < MOST else -1


cdef inline void take_best(const rows_t* r, const blocks_t* p, const newton_t* n, double* lam, double* v) noexcept nogil:
    impulse_of(n, n.best_z, lam)
    rows_velocity(p, r, lam, v)


cdef inline void walk(const blocks_t* p, const rows_t* r, warm_t* s, newton_t* n, double alpha, int32_t limit,
                      double* lam, double* v) noexcept nogil:
    """Proximal rounds from lam until the judge is content, `limit` factorisations are spent, or nothing moves."""
    unknown_of(n, lam, n.trial)
    begin_rounds(n, 0, n.trial, COULOMB, alpha, INNER)
    enter_rounds(n, 0, limit)
    while n.depth > 0:
        go_rounds(n, 0)
        s.factorisations = n.s.factorisations
        if s.trace != NULL:
            judged(p, r, s, n.lam, v, n.problem.e0, n.problem.v0)


cdef inline int32_t solve_with_walks(const blocks_t* p, const rows_t* r, warm_t* s, newton_t* n, double tol, double* lam,
                                     double* v) noexcept nogil:
    """What `warm_solve` has left undecided, also from lam = 0: walks, 64 sweeps from the best between them.

    UNDECIDED where none met tol: lam is then the best that was scored.
    """
    cdef int32_t i, k, _
    cdef double alpha = 1e-5 if p.n_rows <= SMALL else 1e-3 if p.n_rows < LARGE else 1e-2
    n.tol, n.budget = tol, LIMITLESS
    n.stop = n.asked = n.proven = n.depth = n.counts[N_ROUNDS] = 0
    n.best = 1.0 / 0.0
    for k in range(TURNS):
        if k > 0:
            take_best(r, p, n, lam, v)
            for _ in range(MOST_SWEEPS):
                for i in range(p.n_blocks):
                    relax_rows_block(p, r, i, lam, v)
            s.sweeps += MOST_SWEEPS
            alpha = 1e-3 if k == 1 else 10.0 * alpha
        walk(p, r, s, n, alpha, FIRST_STEPS if k == 0 else NEXT_STEPS, lam, v)
        if n.best <= tol:
            break
    take_best(r, p, n, lam, v)
    s.relative = scored(p, r, s, lam, v, n.problem.e0, n.problem.v0)
    return WALKED if n.best <= tol else UNDECIDED


cdef inline int32_t newton_substep(const blocks_t* p, const rows_t* r, warm_t* s, double tol, int32_t* scratch,
                                   double* room, double* lam, double* v) noexcept nogil:
    cdef int32_t j, how = warm_solve(p, r, s, tol, lam, v, 1)
    cdef double e0 = 1.0, v0 = 1.0
    cdef newton_t n
    cdef pattern_t a
    if how != UNDECIDED or p.n_rows == 0:
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
    lay_pattern(&n, &a, scratch + HEAD, p, r)
    find_elements(&n.sc, p, NULL, r)                    # the pattern stands from `lav_newton_plan`
    aim(&n, p, NULL, r, NULL)
    furnish_bodies(&n, &a, lay_judge(&n, room), p, r)
    n.problem.e0, n.problem.v0 = e0, v0
    return solve_with_walks(p, r, s, &n, tol, lam, v)


cdef public int32_t lav_newton_substep(const int32_t* size, double* real, int32_t* index, uint64_t* keys, double tol,
                                       int32_t* scratch, double* room, double* trace, double* said) noexcept nogil:
    """Impulses, dv and the solver values of the prepared substep; how it ended, UNDECIDED where short of tol.

    scratch and room as `lav_newton_plan` has them; trace (MOST_TRACED, 3) or NULL takes work, E [sqrt J] and max |e_n|
    [N s] of each score; said (4) takes sweeps, factorisations, relative residual and scores noted.
    """
    cdef engine_t e
    cdef int64_t used[3]
    cdef blocks_t p
    cdef rows_t r
    cdef warm_t s
    cdef int64_t own
    cdef int32_t how
    bind(size, real, index, keys, &e, used)
    view(&e, &p, &r)
    block_weights(&p, p.d, room)
    joint_weights(&p, &r, room)
    p.nu = room
    s.width = scratch[0]
    s.trace = trace
    s.sweeps = 0
    s.factorisations = 0
    s.traced = 0
    s.relative = 0.0
    own = room_of(&p, &r, s.width) + p.n_rows
    lay_out(&s, room + p.n_rows, scratch + HEAD + index_room(&p, &r), &p, &r)
    how = newton_substep(&p, &r, &s, tol, scratch, room + own, e.impulse, e.dv)
    if p.n_rows > 0:
        observe(&p, &r, &s, e.setting + S_OUT + 5, e.setting + S_OUT + 7)
    said[0] = s.sweeps
    said[1] = s.factorisations
    said[2] = s.relative
    said[3] = s.traced
    return how


cdef class Substep:
    """The same for Python, beside an engine's three buffers."""
    cdef const int32_t[::1] size
    cdef double[::1] real
    cdef int32_t[::1] index
    cdef uint64_t[::1] keys
    cdef double[:, ::1] noted
    cdef double[4] said

    def __init__(self, const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys):
        self.size = size
        self.real = real
        self.index = index
        self.keys = keys
        self.noted = np.zeros((MOST_TRACED, 3))

    def solve(self, double tol):
        """After `prepare` and `solve(False)`: (how it ended, sweeps, factorisations, relative residual)."""
        cdef int32_t how, n
        cdef double[::1] room, scratch
        n = lav_newton_index_room(&self.size[0], &self.real[0], &self.index[0], &self.keys[0])
        if n < 0:
            raise MemoryError("the substep needs more than 2^31 numbers of scratch")
        scratch = np.zeros(n // 2 + 1)
        n = lav_newton_plan(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], <int32_t*>&scratch[0])
        if n < 0:
            raise MemoryError("the substep needs more than 2^31 numbers of scratch")
        room = np.zeros(n + 1)
        with nogil:
            how = lav_newton_substep(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], tol,
                                     <int32_t*>&scratch[0], &room[0], &self.noted[0, 0], self.said)
        return how, <int>self.said[0], <int>self.said[1], self.said[2]

    @property
    def trace(self):
        """Of the last solve: sweeps and factorisations so far, E [sqrt J], max |e_n| [N s], a line for each score."""
        return np.asarray(self.noted)[: <int>self.said[3]].copy()
