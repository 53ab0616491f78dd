"""Room, start and step of the methods, for any host; the same from Python for tests."""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.core.block cimport COULOMB, has_friction
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, ROOM, UNFIT, asked_t, room_t, said_t
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.generalized.flow cimport flow_t
from lavender_ext.generalized.islands cimport aim_at, furnish, marks_of, need_t, numbers_of, settle
from lavender_ext.generalized.newton cimport DONE as G_DONE
from lavender_ext.generalized.newton cimport SPENT as G_SPENT
from lavender_ext.generalized.newton cimport descend_all
from lavender_ext.generalized.sparse cimport PER_COLUMN
from lavender_ext.judge.measure cimport judge_nothing, scratch_of
from lavender_ext.newton.bodies cimport (bodies_t, index_room, lay_bodies, lay_pattern, make_pattern, pattern_t,
                                         real_room)
from lavender_ext.newton.plan cimport CERTIFICATE, MORE, REACHED, SPENT, STUCK, newton_start, newton_step
from lavender_ext.newton.run cimport VECTORS, impulse_of, lay_vectors, newton_t
from lavender_ext.newton.scaling cimport (dense_matrix, find_elements, is_known, lay_elements, lay_numbers, scale_elements,
                                          scaled_index, scaled_real, scaled_t)
from lavender_ext.newton.system cimport DENSE, dense_room


cdef struct state_t:            # at the beginning of the caller's float64
    newton_t n
    scaled_t s
    bodies_t w
    flow_t f
    double* rows                # 4 (rows) of the judge, and its scratch
    double* z                   # (rows)
    double* proof               # (rows)


cdef inline int64_t state_room() noexcept nogil:
    return sizeof(state_t) // sizeof(double) + 1


cdef inline int64_t judge_room(const view_t* v) noexcept nogil:
    return 6 * <int64_t>v.p.n_rows + scratch_of(v)


cdef inline void vanish(double* x, int64_t n) noexcept nogil:
    memset(x, 0, n * sizeof(double))


cdef inline void reference(const view_t* v, state_t* s) noexcept nogil:
    """Errors of doing nothing, as the judge has them."""
    cdef double begun[3]
    cdef newton_t* n = &s.n
    cdef int64_t m = v.p.n_rows
    n.problem.p, n.problem.a, n.problem.r, n.problem.g = v.p, v.a, v.r, v.g
    n.lam, n.problem.w, n.problem.error = s.rows, s.rows + m, s.rows + 2 * m
    s.z, s.proof, n.problem.x = s.rows + 3 * m, s.rows + 4 * m, s.rows + 6 * m
    judge_nothing(v, n.lam, n.problem.w, n.problem.error, n.problem.x, False, begun)
    n.problem.e0, n.problem.v0 = begun[0], begun[1]


cdef inline bint grant(room_t* r, int64_t n_index, int64_t n_real) noexcept nogil:
    """Is there as much? Else that is what is needed."""
    cdef bint enough = r.n_index >= n_index and r.n_real >= n_real and (r.real != NULL or n_real == 0)
    if not enough:
        r.n_index, r.n_real = n_index, n_real
    return enough


cdef inline void begin(state_t* s, const asked_t* o, const double* lam, bint coulomb) noexcept nogil:
    cdef int32_t j
    cdef newton_t* n = &s.n
    n.tol, n.budget, n.cold = o.tol, o.budget, o.cold
    n.without = 0
    for j in range(n.s.e.m):
        s.z[j] = lam[n.keep[j] if n.keep != NULL else j] / n.scale[j]
    newton_start(n, s.z, coulomb)


# -- over the rows of A ----------------------------------------------------------------------------------------


cdef inline void rows_need(const view_t* v, room_t* r) noexcept nogil:
    """More than enough: as if every row moved, in contacts of six rows."""
    cdef int64_t m = v.p.n_rows
    cdef bint cones = has_friction(&v.p)
    r.n_index = scaled_index(m) + 3 * m
    r.n_real = (state_room() + judge_room(v) + scaled_real(m) + (VECTORS + 5 * 6) * m + 2 * m * m + dense_room(m, cones)
                + 8)


cdef inline int32_t start_rows(const view_t* v, const asked_t* o, room_t* r, const double* lam) noexcept nogil:
    cdef state_t* s = <state_t*>r.real
    cdef newton_t* n = &s.n
    cdef int64_t m = v.p.n_rows
    cdef int32_t* index = r.index + scaled_index(m)
    cdef double* x = r.real + state_room()
    cdef bint cones
    vanish(r.real, r.n_real)
    s.rows = x
    x += judge_room(v)
    reference(v, s)
    lay_elements(&s.s, m, r.index)
    lay_numbers(&s.s, m, x)
    find_elements(&s.s, &v.p, v.a, NULL)
    scale_elements(&s.s, &v.p, v.a, NULL, NULL, NULL)
    x += scaled_real(m)
    lay_vectors(n, x, m)
    x += VECTORS * m
    n.keep, n.fixed, n.scale, n.speed = s.s.keep, s.s.fixed, s.s.scale, s.s.speed
    cones = s.s.e.n < s.s.e.m
    n.s.e = &s.s.e
    n.s.form, n.s.wide = DENSE, o.wide
    n.s.others = NULL
    n.s.v, n.s.einv, n.s.p, n.s.pair = x, x + s.s.small, x + 2 * s.s.small, x + 3 * s.s.small
    n.s.bt = x + 4 * s.s.small if cones else NULL
    x += 5 * s.s.small
    n.s.h, n.s.whole, n.s.lower = x, x + m * m, x + 2 * m * m
    n.s.swap, n.s.free, n.exchange.side = index, index + m, index + 2 * m
    n.s.symmetric = dense_matrix(&s.s, v.a, <int32_t>m, n.s.swap, x)
    begin(s, o, lam, v.p.law == COULOMB and cones)
    return MORE


# -- over bodies -----------------------------------------------------------------------------------------------


cdef inline int32_t start_bodies(const view_t* v, const asked_t* o, room_t* r, const double* lam) noexcept nogil:
    cdef state_t* s = <state_t*>r.real
    cdef pattern_t a
    cdef int64_t own = state_room() + judge_room(v)
    lay_pattern(&a, r.index, &v.p, v.r)
    make_pattern(&a, &v.p, v.r)
    if not grant(r, index_room(&v.p, v.r), own + real_room(&a, &v.p, v.r)):
        return ROOM
    vanish(r.real, r.n_real)
    s.rows = r.real + state_room()
    reference(v, s)
    lay_bodies(&s.n, &s.w, &a, r.real + own, &v.p, v.r)
    begin(s, o, lam, v.p.law == COULOMB and s.w.s.e.n < s.w.s.e.m)
    return MORE


# -- over J and M ----------------------------------------------------------------------------------------------


cdef inline int32_t start_general(const view_t* v, const asked_t* o, room_t* r) noexcept nogil:
    cdef state_t* s = <state_t*>r.real
    cdef need_t need
    cdef flow_t f
    cdef int32_t per = PER_COLUMN
    cdef int64_t own
    while True:
        if not grant(r, marks_of(&v.p, v.g, per), state_room() + judge_room(v)):
            return ROOM
        settle(&f, &v.p, v.g, per, r.index, &need)
        if not need.crowded or 4 * per > v.g.n:
            break
        per *= 2
    own = state_room() + judge_room(v)
    if not grant(r, marks_of(&v.p, v.g, per), own + numbers_of(&f, &need)):
        return ROOM
    vanish(r.real, own)
    s.f = f
    s.rows = r.real + state_room()
    reference(v, s)
    furnish(&s.f, &need, r.real + own)
    aim_at(&s.f, o.tol, o.budget, s.n.problem.e0, s.n.problem.v0)
    s.n.budget = o.budget
    return MORE


cdef inline int32_t step_general(const asked_t* o, state_t* s, int32_t work, double* lam) noexcept nogil:
    """All islands, the one that waits first."""
    cdef int32_t end, left = s.n.budget
    if o.stop or left <= 0:
        return SPENT
    s.f.steps = work if work < left else left
    s.n.budget -= s.f.steps
    end = descend_all(&s.f, lam, o.cold)
    if end == G_SPENT:
        return MORE if s.n.budget > 0 else SPENT
    return REACHED if end == G_DONE else STUCK


# -- the three -------------------------------------------------------------------------------------------------


cdef public int32_t lav_room(const view_t* v, const asked_t* o, room_t* r) noexcept nogil:
    """r.n_index and r.n_real as far as they are known beforehand; 0 where the method does not take the problem."""
    cdef int64_t most = 0
    r.n_index = r.n_real = 0
    r.index = NULL
    r.real = NULL
    if o.method != NEWTON or v.p.n_rows == 0:
        return 0
    if v.g != NULL:
        r.n_index, r.n_real = marks_of(&v.p, v.g, PER_COLUMN), state_room() + judge_room(v)
        return 1
    if not is_known(&v.p):
        return 0
    if v.a != NULL:
        rows_need(v, r)
        return 1
    if v.r != NULL:
        most = index_room(&v.p, v.r)
        r.n_index, r.n_real = most, state_room() + judge_room(v)
    return most > 0


cdef public int32_t lav_start(const view_t* v, const asked_t* o, room_t* r, const double* lam) noexcept nogil:
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


cdef public int32_t lav_step(const view_t* v, const asked_t* o, const room_t* r, int32_t work, double* lam,
                             said_t* said) noexcept nogil:
    """`work` factorisations or a few more; lam (m) is the best so far."""
    cdef state_t* s = <state_t*>r.real
    cdef newton_t* n = &s.n
    cdef int32_t how, j
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
        vanish(s.proof, v.p.n_rows)
        for j in range(n.s.e.m):
            s.proof[n.keep[j] if n.keep != NULL else j] = n.direction[j] * n.scale[j]
        said.direction = s.proof
    return how


cdef class Driver:
    """A problem's `view_t` and the arrays of a method on it, for Python."""
    cdef view_t v
    cdef asked_t o
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
        self.o = asked_t(NEWTON, budget, 0, 0, 0, has_wide(), tol)
        self.keep = [data]

    def start(self, const double[::1] impulse, bint cold):
        """Room, as often as it is asked for, and the start; False where the method does not take the problem."""
        cdef int32_t how = ROOM
        cdef int64_t n_index, n_real
        self.o.cold = cold
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
