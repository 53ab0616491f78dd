"""Room, start and step of the methods, for any host; the same from Python for tests."""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, ROOM, UNFIT, options_t, room_t, said_t
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.generalized.flow cimport flow_t
from lavender_ext.generalized.islands cimport aim_at, furnish as furnish_flow, marks_of, need_t, numbers_of, settle
from lavender_ext.generalized.newton cimport DONE as G_DONE
from lavender_ext.generalized.newton cimport SPENT as G_SPENT
from lavender_ext.generalized.newton cimport descend_all
from lavender_ext.generalized.sparse cimport per_column
from lavender_ext.judge.measure cimport judge_nothing
from lavender_ext.newton.bodies cimport body_room, furnish_bodies, index_room, lay_bodies, make_pattern, pattern_t
from lavender_ext.newton.plan cimport CERTIFICATE, MORE, REACHED, SPENT, STUCK, newton_start, newton_step
from lavender_ext.newton.run cimport (aim, furnish, impulse_of, judge_room, lay_index, lay_judge, newton_t, own_index,
                                      own_room, proof_of)
from lavender_ext.newton.scaling cimport dense_matrix, find_elements, is_known
from lavender_ext.newton.system cimport DENSE, dense_room


cdef struct state_t:            # at the beginning of the caller's float64
    newton_t n
    flow_t f


cdef inline int64_t begun_room(const view_t* v) noexcept nogil:
    """Doubles before those of a form."""
    return sizeof(state_t) // sizeof(double) + 1 + judge_room(&v.p, v.r, v.g)


cdef inline double* begin(const view_t* v, const options_t* o, room_t* r) noexcept nogil:
    """The problem, what is asked, and errors of doing nothing as the judge has them; what is behind (`begun_room`)."""
    cdef double begun[3]
    cdef newton_t* n = &(<state_t*>r.real).n
    memset(r.real, 0, begun_room(v) * sizeof(double))
    aim(n, &v.p, v.a, v.r, v.g)
    n.tol, n.budget = o.tol, o.budget
    lay_judge(n, r.real + sizeof(state_t) // sizeof(double) + 1)
    judge_nothing(v, n.lam, n.problem.w, n.problem.error, n.problem.x, begun)
    n.problem.e0, n.problem.v0 = begun[0], begun[1]
    return r.real + begun_room(v)


cdef inline bint grant(room_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Is there as much? Else that is what is needed."""
    cdef bint enough = r.n_index >= n_index and r.n_real >= n_real and (r.real != NULL or n_real == 0)
    if not enough:
        r.n_index, r.n_real = n_index, n_real
    return enough


# -- over the rows of A ----------------------------------------------------------------------------------------


cdef inline void rows_need(const view_t* v, room_t* r) noexcept nogil:
    """More than enough, whatever the numbers: as if every row moved, in contacts of six rows that rub."""
    cdef int64_t m = v.p.n_rows
    r.n_index = own_index(m)
    r.n_real = begun_room(v) + own_room(m, 6 * m) + 2 * m * m + dense_room(m, True) + 8


cdef inline int32_t start_rows(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = &(<state_t*>r.real).n
    cdef int64_t m = v.p.n_rows
    cdef double* x = begin(v, o, r)
    lay_index(n, m, r.index)
    find_elements(&n.sc, &v.p, v.a, NULL)
    memset(x, 0, own_room(m, n.sc.small) * sizeof(double))
    x = furnish(n, v.a, NULL, x)
    n.s.form, n.s.wide = DENSE, o.wide
    n.s.h, n.s.whole, n.s.lower = x, x + m * m, x + 2 * m * m
    n.s.symmetric = dense_matrix(&n.sc, v.a, <int32_t>m, n.s.swap, x)
    newton_start(n, lam)
    return MORE


# -- over bodies -----------------------------------------------------------------------------------------------


cdef inline int32_t start_bodies(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = &(<state_t*>r.real).n
    cdef double* x = begin(v, o, r)
    cdef pattern_t a
    lay_bodies(n, &a, r.index, &v.p, v.r)
    find_elements(&n.sc, &v.p, NULL, v.r)
    make_pattern(&n.sc, &a, v.r)
    if not grant(r, index_room(&v.p, v.r), begun_room(v) + body_room(n, &a, &v.p, v.r)):
        return ROOM
    furnish_bodies(n, &a, x, &v.p, v.r)
    newton_start(n, lam)
    return MORE


# -- over J and M ----------------------------------------------------------------------------------------------


cdef inline int32_t start_general(const view_t* v, const options_t* o, room_t* r) noexcept nogil:
    cdef state_t* s = <state_t*>r.real
    cdef double* x = begin(v, o, r)
    cdef need_t need
    cdef int32_t per = per_column(v.g.n)
    while True:
        if not grant(r, marks_of(&v.p, v.g, per), begun_room(v)):
            return ROOM
        settle(&s.f, &v.p, v.g, per, r.index, &need)
        if not need.crowded:
            break
        per *= 2
    if not grant(r, marks_of(&v.p, v.g, per), begun_room(v) + numbers_of(&s.f, &need)):
        return ROOM
    furnish_flow(&s.f, &need, x)
    aim_at(&s.f, o.tol, o.budget, s.n.problem.e0, s.n.problem.v0)
    return MORE


cdef inline int32_t step_general(const options_t* o, state_t* s, int32_t work, double* lam) noexcept nogil:
    """All islands, the one that waits first."""
    cdef int32_t end, left = s.n.budget
    if o.stop or left <= 0:
        return SPENT
    s.f.steps = work if work < left else left
    s.n.budget -= s.f.steps
    end = descend_all(&s.f, lam)
    if end == G_SPENT:
        return MORE if s.n.budget > 0 else SPENT
    return REACHED if end == G_DONE else STUCK


# -- the three -------------------------------------------------------------------------------------------------


cdef public int32_t lav_room(const view_t* v, const options_t* o, room_t* r) noexcept nogil:
    """r.n_index and r.n_real as far as they are known beforehand; 0 where the method does not take the problem."""
    cdef int64_t most = 0
    r.n_index = r.n_real = 0
    r.index = NULL
    r.real = NULL
    if o.method != NEWTON or v.p.n_rows == 0:
        return 0
    if v.g != NULL:
        r.n_index, r.n_real = marks_of(&v.p, v.g, per_column(v.g.n)), begun_room(v)
        return 1
    if not is_known(&v.p):
        return 0
    if v.a != NULL:
        rows_need(v, r)
        return 1
    if v.r != NULL:
        most = index_room(&v.p, v.r)
        r.n_index, r.n_real = most, begun_room(v)
    return most > 0


cdef public int32_t lav_start(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil:
    """From lam (m): MORE, or ROOM with how much is needed."""
    cdef room_t need
    if not lav_room(v, o, &need):
        return UNFIT
    if not grant(r, need.n_index, need.n_real):
        return ROOM
    if v.g != NULL:
        return start_general(v, o, r)
    if v.r != NULL:
        return start_bodies(v, o, r, lam)
    return start_rows(v, o, r, lam)


cdef public int32_t lav_step(const view_t* v, const options_t* o, const room_t* r, int32_t work, double* lam,
                             said_t* said) noexcept nogil:
    """`work` factorisations or a few more; lam (m) is the best so far."""
    cdef state_t* s = <state_t*>r.real
    cdef newton_t* n = &s.n
    cdef int32_t how
    said.direction = NULL
    if v.g != NULL:
        how = step_general(o, s, work, lam)
        said.factorisations = s.f.factorisations
        said.relative = -1.0
        return how
    n.proven, n.stop = o.proven, o.stop
    how = newton_step(n, work)
    impulse_of(n, n.best_z, lam)
    said.factorisations, said.relative = n.s.factorisations, n.best
    if how == CERTIFICATE:
        said.direction = proof_of(n)
    return how


cdef class Driver:
    """A problem's `view_t` and the arrays of a method on it, for Python."""
    cdef view_t v
    cdef options_t o
    cdef room_t r
    cdef object keep

    def __init__(self, Data data, double tol, int budget):
        self.v.p = data.blocks
        self.v.a = NULL
        self.v.r = NULL
        self.v.g = NULL
        if data.is_general:
            self.v.g = &data.general
        elif data.factored:
            self.v.r = &data.rows
        else:
            self.v.a = &data.csr
        self.o = options_t(NEWTON, budget, 0, 0, has_wide(), tol)
        self.keep = [data]

    def start(self, const double[::1] impulse):
        """Room, as often as it is asked for, and the start; False where the method does not take the problem."""
        cdef int32_t how = ROOM
        cdef int64_t n_index, n_real
        if not lav_room(&self.v, &self.o, &self.r):
            return False
        while how == ROOM:
            n_index, n_real = self.r.n_index, self.r.n_real
            index, real = np.zeros(n_index // 2 + 1), np.empty(n_real)
            self.keep = [self.keep[0], index, real]
            self.r.index, self.r.real = <int32_t*>address(index), <double*>address(real)
            how = lav_start(&self.v, &self.o, &self.r, &impulse[0])
        return how == MORE

    def step(self, int work, double[::1] impulse):
        """How it stands after so many factorisations, how many there were, and the residual; impulse is the best."""
        cdef said_t said
        cdef int32_t how
        with nogil:
            how = lav_step(&self.v, &self.o, &self.r, work, &impulse[0], &said)
        proof = np.asarray(<double[:self.v.p.n_rows]><double*>said.direction).copy() if said.direction != NULL else None
        return how, said.factorisations, said.relative, proof

    def prove(self):
        """The proof was found to be one."""
        self.o.proven = 1
