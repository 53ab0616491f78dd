"""A method that was started on a problem, for Python: its steps, and what they say."""
import numpy as np

from lavender_ext.core.method cimport (BROKEN, CERTIFICATE, ROUNDOFF_LIMIT, LOST, MORE, REACHED, SPENT, STUCK, options_t, said_t)

OUTCOMES = {"more": MORE, "reached": REACHED, "floor": ROUNDOFF_LIMIT, "stuck": STUCK, "certificate": CERTIFICATE, "spent": SPENT,
            "broken": BROKEN, "lost": LOST}


cdef class Method:
    """What leads the three functions of a method; the judge's start must be known to the data when it is started."""

    cdef void aim(self, double tol, int budget) noexcept:
        """For a start: to a relative residual of tol, by `budget` units of work; nothing is said yet."""
        cdef options_t* o = &self.options
        o.tol, o.budget, o.proven, o.stop = tol, budget, 0, 0
        o.e0, o.v0 = self.data.reference_energy, self.data.reference_velocity
        self.said = said_t(0, 0, 0, 0, 1.0 / 0.0, NULL, NULL)
        self.how = MORE

    def step(self, int work, double[::1] impulse):
        """One of `OUTCOMES` after so many units of work; impulse (m,) is the best, or of J and M where it goes on from."""
        with nogil:
            self.how = self.own.step(&self.view, &self.options, &self.space, work, &impulse[0], &self.said)
        return self.how

    def allow(self, int more):
        """So many units more at most."""
        self.options.budget = min(self.options.budget, self.said.work + more)

    def stop(self):
        """There is no time for more: the next step judges what is there, and ends."""
        self.options.stop = 1

    def prove(self):
        """`direction` is a proof that there is no solution."""
        self.options.proven = 1

    @property
    def relative(self):
        """Of the impulse; inf before a step, -1 where it is not known."""
        return self.said.relative

    @property
    def done(self):
        """Units of work since the start."""
        return self.said.work

    @property
    def counts(self):
        """Work, factorisations, rounds of Coulomb friction, evaluations along a line, since the start."""
        return self.said.work, self.said.factorisations, self.said.rounds, self.said.evaluations

    @property
    def direction(self):
        """(m,) of a certificate, None without one."""
        if self.said.direction == NULL:
            return None
        return np.asarray(<double[:self.view.p.n_rows]><double*>self.said.direction).copy()
