"""Newton's method over the rows of A, dense, or over up to 1,500 bodies, as room, start and step (`core/method.pxd`).

The unit of work is a factorisation; a step may do one or two more than it was asked for. After CERTIFICATE `options_t.proven`
= 1 ends it; without, the next step goes on.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from lavender_ext.core.method cimport CERTIFICATE, MORE, ROOM, grant, options_t, room_t, said_t
from lavender_ext.core.view cimport view_t
from lavender_ext.newton.bodies cimport body_room, furnish_bodies, index_room, lay_bodies, make_pattern, pattern_t
from lavender_ext.newton.plan cimport newton_start, newton_step
from lavender_ext.newton.run cimport (aim, furnish, impulse_of, judge_room, lay_index, lay_judge, newton_t, own_index,
                                      own_room, proof_of, set_reference)
from lavender_ext.newton.scaling cimport dense_matrix, find_elements, is_known
from lavender_ext.newton.system cimport DENSE, dense_room


cdef struct state_t:            # at the beginning of the room's whole numbers
    newton_t n
    pattern_t a


cdef inline int64_t head() noexcept nogil:
    """Whole numbers of it."""
    return sizeof(state_t) // sizeof(int32_t)


cdef inline newton_t* state_of(const room_t* r) noexcept nogil:
    return &(<state_t*>r.index).n


cdef inline int32_t begin(newton_t* n, const options_t* o, const double* lam) noexcept nogil:
    """From lam (m), furnished."""
    n.tol, n.budget = o.tol, o.budget
    set_reference(&n.problem, o.e0, o.v0)
    newton_start(n, lam)
    return MORE


cdef inline int32_t system_step(const view_t* v, const options_t* o, const room_t* r, int32_t work, double* lam,
                                said_t* said) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef int32_t how
    n.budget, n.proven, n.stop = o.budget, o.proven, o.stop
    how = newton_step(n, work)
    if n.best <= n.tol or n.kept.seen == 0:
        impulse_of(n, n.best_z, lam)
    else:
        memcpy(lam, n.kept.impulse, v.p.n_rows * sizeof(double))
    said.work = said.factorisations = n.s.factorisations
    said.relative, said.tried = n.best, n.lam
    said.direction = proof_of(n) if how == CERTIFICATE else NULL
    return how


cdef inline int32_t rows_room(const view_t* v, const options_t* o, room_t* r) noexcept nogil:
    """More than enough, whatever the numbers: as if every row moved, in contacts of six rows that rub."""
    cdef int64_t m = v.p.n_rows
    r.n_index = head() + own_index(m)
    r.n_real = judge_room(&v.p, NULL, NULL) + own_room(m, 6 * m) + 2 * m * m + dense_room(m, True) + 8
    return is_known(&v.p)


cdef inline int32_t rows_start(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef int64_t m = v.p.n_rows
    cdef room_t need
    cdef double* x
    rows_room(v, o, &need)
    if not grant(r, need.n_index, need.n_real):
        return ROOM
    memset(n, 0, sizeof(newton_t))
    aim(n, &v.p, v.a, NULL, NULL)
    x = lay_judge(n, r.real)
    lay_index(n, m, r.index + head())
    find_elements(&n.sc, v)
    memset(x, 0, own_room(m, n.sc.small) * sizeof(double))
    x = furnish(n, v, x)
    n.s.form, n.s.wide = DENSE, o.wide
    n.s.h, n.s.whole, n.s.lower = x, x + m * m, x + 2 * m * m
    n.s.symmetric = dense_matrix(&n.sc, v.a, <int32_t>m, n.s.swap, x)
    return begin(n, o, lam)


cdef inline int32_t bodies_room(const view_t* v, const options_t* o, room_t* r) noexcept nogil:
    """Whole numbers; the others are known when the pattern of the factor is."""
    cdef int64_t most = index_room(&v.p, v.r)
    r.n_index, r.n_real = head() + most, 0
    return most > 0


cdef inline int32_t bodies_start(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef pattern_t* a = &(<state_t*>r.index).a
    if not r.laid:
        if not grant(r, head() + index_room(&v.p, v.r), 0):
            return ROOM
        memset(n, 0, sizeof(newton_t))
        lay_bodies(n, a, r.index + head(), &v.p, v.r)
        find_elements(&n.sc, v)
        make_pattern(&n.sc, a, v.r)
        r.laid = 1
    if not grant(r, r.n_index, judge_room(&v.p, v.r, NULL) + body_room(n, a, &v.p, v.r)):
        return ROOM
    aim(n, &v.p, NULL, v.r, NULL)
    furnish_bodies(n, a, lay_judge(n, r.real), v)
    return begin(n, o, lam)
