"""The class `Method`: steps and statistics of a method of core/method.pxd for Python."""
import numpy as np

from libc.stdint cimport int32_t

from lavender_ext.core.deadline cimport get_pointer
from lavender_ext.core.method cimport (BROKEN, CERTIFICATE, ROUNDOFF_LIMIT, LOST, MORE, REACHED, SPENT, STUCK, UNFIT, info_t,
                                       options_t)
from lavender_ext.core.view cimport csr_t
from lavender_ext.host cimport analyse_for_method, free_workspace, grow_workspace_to, start_method

OUTCOMES = {"more": MORE, "reached": REACHED, "floor": ROUNDOFF_LIMIT, "stuck": STUCK, "certificate": CERTIFICATE, "spent": SPENT,
            "broken": BROKEN, "lost": LOST}


cdef class Method:
    """Base class of methods on a problem, with workspace that is allocated when its size is known.

    A subclass sets the functions, the view and the options, and calls `analyse`. `start` may be called repeatedly. The data
    must know the judge's reference (the residual of the zero impulse) before a method starts.
    """

    def __dealloc__(self):
        free_workspace(&self.memory)

    cdef int32_t analyse(self):
        """Analyse the structure of the problem; return NEEDS_WORKSPACE or, if the method does not accept it, UNFIT."""
        with nogil:
            self.how = analyse_for_method(&self.own, &self.view, &self.options, &self.space, &self.memory, grow_workspace_to)
        return self.how

    def start(self, const double[::1] impulse, double tol, int budget):
        """Start from impulse (m,) [N s], to a relative residual of `tol`, with `budget` units of work."""
        cdef options_t* o = &self.options
        o.tol, o.budget, o.proven, o.stop = tol, budget, 0, 0
        o.e0, o.v0 = self.data.reference_energy, self.data.reference_velocity
        self.info = info_t(0, 0, 0, 0, 1.0 / 0.0, NULL, NULL)
        with nogil:
            self.how = start_method(&self.own, &self.view, o, &self.space, &impulse[0], &self.memory, grow_workspace_to)
        if self.how == UNFIT:
            raise MemoryError(f"{self.space.n_real} numbers")

    def use_rhs(self, Data data):
        """Solve data of the same operator and law with another b from the next `start` on."""
        cdef const csr_t* a = self.view.a
        self.data, self.view = data, data.get_pointers()
        if a != NULL:
            self.view.a = a

    def step(self, int work, double[::1] impulse):
        """Do `work` units of work and return one of `OUTCOMES`.

        impulse (m,) [N s] receives the best impulse so far, or over J and M the impulse from which the method continues.
        """
        with nogil:
            self.how = self.own.step(&self.view, &self.options, &self.space, work, &impulse[0], &self.info)
        return self.how

    def set_deadline(self, deadline):
        """Set the time at which a step ends with the present result; None or a deadline without a limit: no end."""
        self.deadline, self.options.deadline = deadline, get_pointer(deadline)

    def limit_work(self, int units):
        """Limit the remaining work to at most `units` units."""
        self.options.budget = min(self.options.budget, self.info.work + units)

    def request_stop(self):
        """Make the next step judge the present impulse and end."""
        self.options.stop = 1

    def confirm_certificate(self):
        """Confirm to the method that `direction` proves that no solution exists."""
        self.options.proven = 1

    @property
    def work(self):
        """Multiply-adds of one factorisation; over J and M, of forming and factoring N of every island."""
        return self.space.work

    @property
    def relative(self):
        """Relative residual of the impulse; inf before the first step, -1 if unknown."""
        return self.info.relative

    @property
    def done(self):
        """Units of work since the start."""
        return self.info.work

    @property
    def counts(self):
        """Work, factorisations, friction updates and line search evaluations since the start."""
        return self.info.work, self.info.factorisations, self.info.rounds, self.info.evaluations

    @property
    def direction(self):
        """Direction (m,) [N s] of a certificate, None without one."""
        if self.info.direction == NULL:
            return None
        return np.asarray(<double[:self.view.p.n_rows]><double*>self.info.direction).copy()
