"""Workspace, start and step of the methods, for any host; the same from Python."""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.method cimport NEEDS_WORKSPACE, Method, method_t, options_t, workspace_t, info_t
from lavender_ext.core.problem cimport Data, Workspace, allocate_workspace
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.velocity_newton.method cimport general_workspace_size, general_start, general_step
from lavender_ext.newton.solve cimport bodies_workspace_size, bodies_start, rows_workspace_size, rows_start, system_step
from lavender_ext.velocity_newton.soft cimport is_soft


cdef inline method_t row_of(const view_t* v) noexcept nogil:
    """The table: a method over the form that the problem has."""
    if v.g != NULL:
        return method_t(general_workspace_size, general_start, general_step)
    if v.r != NULL:
        return method_t(bodies_workspace_size, bodies_start, system_step)
    return method_t(rows_workspace_size, rows_start, system_step)


cdef public int32_t lav_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """r.n_index and r.n_real as far as they are known beforehand; 0 where the method does not take the problem."""
    r[0] = workspace_t(0, 0, NULL, NULL, 0, 0, 0, 0.0)
    if o.method != NEWTON or v.p.n_rows == 0:
        return 0
    return row_of(v).workspace(v, o, r)


cdef public int32_t lav_start(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    """From lam (m): MORE, or NEEDS_WORKSPACE with how much is needed."""
    return row_of(v).start(v, o, r, lam)


cdef public int32_t lav_step(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                             info_t* info) noexcept nogil:
    """`work` units or a few more; lam (m) is the best so far."""
    return row_of(v).step(v, o, r, work, lam, info)


cdef class Driver(Method):
    """A method of the table on a problem, in arrays that are made when they are known; `start` as often as wanted.

    `fits`: it takes the problem. Of J and M `work` are multiply-adds of N and a factor of each of the `islands`, `soft`
    says that no row needs a proximal term. An island whose N has more than `most` values does not fit, and need not where
    its factor takes more than `work`.
    """
    cdef Workspace index, real
    cdef readonly bint fits

    def __init__(self, Data data, double most=INFINITY, double work=INFINITY):
        self.data, self.view = data, data.view()
        self.options.method, self.options.wide, self.options.most = NEWTON, has_wide(), most
        self.options.work = work
        self.own = row_of(&self.view)
        self.fits = lav_workspace_size(&self.view, &self.options, &self.space) and self.lay() == NEEDS_WORKSPACE

    cdef int32_t lay(self) except -1:
        """A start, as far as whole numbers lead."""
        cdef int32_t how = NEEDS_WORKSPACE
        cdef int64_t had = -1
        while how == NEEDS_WORKSPACE and self.space.n_index > had:
            had = self.space.n_index
            self.index = allocate_workspace(had * sizeof(int32_t))
            self.space.index = <int32_t*>self.index.at
            with nogil:
                how = lav_start(&self.view, &self.options, &self.space, NULL)
        return how

    def start(self, const double[::1] impulse, double tol, int budget):
        """From impulse (m,), to a relative residual of tol, by so many units of work."""
        self.aim(tol, budget)
        if self.real is None:
            self.real = allocate_workspace(self.space.n_real * sizeof(double))
            self.space.real = <double*>self.real.at
        with nogil:
            lav_start(&self.view, &self.options, &self.space, &impulse[0])

    @property
    def work(self):
        """Multiply-adds."""
        return self.space.work

    @property
    def islands(self):
        """Problems that share no velocity."""
        return self.space.islands

    @property
    def soft(self):
        """No row of J and M needs a proximal term."""
        return self.view.g != NULL and is_soft(&self.view.p, self.view.g)
