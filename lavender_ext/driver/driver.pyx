"""Room, start and step of the methods, for any host; the same from Python."""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.method cimport (BROKEN, CERTIFICATE, FLOOR, LOST, MORE, REACHED, ROOM, SPENT, STUCK, options_t, room_t,
                                       said_t)
from lavender_ext.core.problem cimport Data, Room, room_for
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, method_t
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.generalized.method cimport general_room, general_start, general_step
from lavender_ext.generalized.newton cimport is_soft
from lavender_ext.newton.method cimport bodies_room, bodies_start, rows_room, rows_start, system_step

OUTCOMES = {"more": MORE, "reached": REACHED, "floor": FLOOR, "stuck": STUCK, "certificate": CERTIFICATE, "spent": SPENT,
            "broken": BROKEN, "lost": LOST}


cdef inline method_t row_of(const view_t* v, const options_t* o) noexcept nogil:
    """The table: a method over the form that the problem has."""
    if v.g != NULL:
        return method_t(general_room, general_start, general_step)
    if v.r != NULL:
        return method_t(bodies_room, bodies_start, system_step)
    return method_t(rows_room, rows_start, system_step)


cdef public int32_t lav_room(const view_t* v, const options_t* o, room_t* r) noexcept nogil:
    """r.n_index and r.n_real as far as they are known beforehand; 0 where the method does not take the problem."""
    r[0] = room_t(0, 0, NULL, NULL, 0, 0, 0, 0.0)
    if o.method != NEWTON or v.p.n_rows == 0:
        return 0
    return row_of(v, o).room(v, o, r)


cdef public int32_t lav_start(const view_t* v, const options_t* o, room_t* r, const double* lam) noexcept nogil:
    """From lam (m): MORE, or ROOM with how much is needed."""
    return row_of(v, o).start(v, o, r, lam)


cdef public int32_t lav_step(const view_t* v, const options_t* o, const room_t* r, int32_t work, double* lam,
                             said_t* said) noexcept nogil:
    """`work` units or a few more; lam (m) is the best so far."""
    return row_of(v, o).step(v, o, r, work, lam, said)


cdef class Driver:
    """A method on a problem in arrays that are made when they are known; `start` as often as wanted, then `step` by `step`.

    `fits`: it takes the problem. Of J and M `work` are multiply-adds of N and a factor of each of the `islands`, `soft`
    says that no row needs a proximal term, and an island whose N has more than `most` values does not fit.
    """
    cdef view_t v
    cdef options_t o
    cdef room_t r
    cdef said_t said
    cdef int32_t how
    cdef Data data
    cdef Room index, real
    cdef readonly bint fits

    def __init__(self, Data data, double most=INFINITY):
        self.data, self.v = data, data.view()
        self.o.method, self.o.wide, self.o.most = NEWTON, has_wide(), most
        self.fits = lav_room(&self.v, &self.o, &self.r) and self.lay(NULL) == ROOM

    cdef int32_t lay(self, const double* lam) except -1:
        """A start; before there are numbers as far as whole numbers lead."""
        cdef int32_t how = ROOM
        cdef int64_t had = -1
        while how == ROOM and self.r.n_index > had:
            had = self.r.n_index
            self.index = room_for(had * sizeof(int32_t))
            self.r.index = <int32_t*>self.index.at
            with nogil:
                how = lav_start(&self.v, &self.o, &self.r, lam)
        return how

    @property
    def work(self):
        """Multiply-adds."""
        return self.r.work

    @property
    def islands(self):
        """Problems that share no velocity."""
        return self.r.islands

    @property
    def soft(self):
        """No row of J and M needs a proximal term."""
        return self.v.g != NULL and is_soft(&self.v.p, self.v.g)

    def start(self, const double[::1] impulse, double tol, int budget):
        """From impulse (m,), to a relative residual of tol; the judge's start must be known to the data."""
        self.o.tol, self.o.budget, self.o.proven = tol, budget, 0
        self.o.e0, self.o.v0 = self.data.start_energy, self.data.start_velocity
        if self.real is None:
            self.real = room_for(self.r.n_real * sizeof(double))
            self.r.real = <double*>self.real.at
        self.said = said_t(0, 0, 0, 0, -1.0, NULL, NULL)
        with nogil:
            lav_start(&self.v, &self.o, &self.r, &impulse[0])

    def step(self, int work, double[::1] impulse):
        """One of `OUTCOMES` after so many units of work; impulse (m,) is the best, or of J and M where it goes on from."""
        with nogil:
            self.how = lav_step(&self.v, &self.o, &self.r, work, &impulse[0], &self.said)
        return self.how

    def prove(self):
        """`direction` is a proof that there is no solution."""
        self.o.proven = 1

    @property
    def waits(self):
        """The last step left something to do: the next goes on from there."""
        return self.how == MORE

    @property
    def relative(self):
        """Of the impulse; -1 where it is not known."""
        return self.said.relative

    @property
    def counts(self):
        """Work, factorisations, rounds of Coulomb friction, evaluations along a line, since the start."""
        return self.said.work, self.said.factorisations, self.said.rounds, self.said.evaluations

    @property
    def direction(self):
        """(m,) of a certificate, None without one."""
        if self.said.direction == NULL:
            return None
        return np.asarray(<double[:self.v.p.n_rows]><double*>self.said.direction).copy()
