"""The functions of `driver.pxd`, which call the method for a problem's form, and the class `Driver` for Python."""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t

from lavender_ext.core.method cimport NEEDS_WORKSPACE, UNFIT, Method, grow_t, info_t, method_t, options_t, workspace_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.host cimport analyse_for_method, start_method, step_method
from lavender_ext.velocity_newton.method cimport islands_workspace_size, keep_island_matrix, start_islands, advance_islands
from lavender_ext.newton.rows cimport are_generalized_rows_faster
from lavender_ext.newton.solve cimport (bodies_workspace_size, keep_row_matrix, start_newton_over_bodies, rows_workspace_size,
                                        start_newton_over_rows, step_newton_system)
from lavender_ext.velocity_newton.soft cimport needs_no_proximal_terms


cdef inline method_t find_method_functions(const view_t* v) noexcept nogil:
    """Return the functions of the method for the form of the problem."""
    if v.g != NULL and not are_generalized_rows_faster(v):
        return method_t(islands_workspace_size, start_islands, advance_islands)
    if v.r != NULL:
        return method_t(bodies_workspace_size, start_newton_over_bodies, step_newton_system)
    return method_t(rows_workspace_size, start_newton_over_rows, step_newton_system)


cdef public int32_t lav_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write first estimates of r.n_index and r.n_real; return 0 if the method does not accept the problem."""
    r[0] = workspace_t(0, 0, NULL, NULL, 0, 0, 0, 0.0)
    if o.method != NEWTON or v.p.n_rows == 0:
        return 0
    return find_method_functions(v).workspace(v, o, r)


cdef public int32_t lav_analyse(const view_t* v, const options_t* o, workspace_t* r, workspace_t* memory,
                                grow_t grow) noexcept nogil:
    """Analyse the structure (`analyse_for_method`); return NEEDS_WORKSPACE or UNFIT."""
    cdef method_t f = find_method_functions(v)
    return analyse_for_method(&f, v, o, r, memory, grow) if v.p.n_rows > 0 else UNFIT


cdef public int32_t lav_start(const view_t* v, const options_t* o, workspace_t* r, const double* lam, workspace_t* memory,
                              grow_t grow) noexcept nogil:
    """Start from lam (m), if r has the sizes (`start_method`); return MORE or another outcome."""
    cdef method_t f = find_method_functions(v)
    return start_method(&f, v, o, r, lam, memory, grow)


cdef public int32_t lav_step(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                             info_t* info) noexcept nogil:
    """Do up to `work` units of work, also past a certificate; lam (m) receives the best impulse so far."""
    cdef method_t f = find_method_functions(v)
    return step_method(&f, v, o, r, work, lam, info)


cdef class Driver(Method):
    """Run the method of the driver on a problem.

    Parameters
    ----------
    data : Data
        The problem.
    max_values : float
        Maximum number of values of the matrix N of an island over J and M. A larger island is not accepted.
    work : float
        Number of multiply-adds of a factorisation above which an island may be rejected without analysis.
    """
    cdef readonly bint fits     # whether the method accepts the problem

    def __init__(self, Data data, double max_values=INFINITY, double work=INFINITY):
        self.data, self.view = data, data.get_pointers()
        self.options.method, self.options.wide, self.options.most = NEWTON, has_wide(), max_values
        self.options.work = work
        self.own = find_method_functions(&self.view)
        self.fits = data.blocks.n_rows > 0 and self.analyse() == NEEDS_WORKSPACE

    def keep_matrix(self):
        """Let later starts keep a dense H that is formed; only `use_rhs` may change the data then."""
        if self.own.start == start_newton_over_rows:
            keep_row_matrix(&self.space)
        elif self.own.start == start_islands:
            keep_island_matrix(&self.space)

    @property
    def islands(self):
        """Return the number of islands, which are independent problems without common velocities."""
        return self.space.islands

    @property
    def soft(self):
        """Whether no row needs a proximal term; False unless the problem is given by J and M."""
        return self.view.g != NULL and needs_no_proximal_terms(&self.view.p, self.view.g)
