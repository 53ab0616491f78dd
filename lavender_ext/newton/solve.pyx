"""Newton's method over the rows of a dense A, or over bodies, as workspace, start and step (`core/method.pxd`).

The unit of work is a factorisation; a step may do one or two more than requested. After CERTIFICATE, `options_t.proven`
= 1 ends the solve; without it the next step continues.

The method is compiled here once: other modules call the functions of `solve.pxd` by pointer. The classes give Python the
same method, with arrays that `newton_t` points to, and its linear systems for tests.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport get_data_pointer, allocate_zeros
from lavender_ext.core.method cimport (CERTIFICATE, MORE, NEEDS_WORKSPACE, UNFIT, info_t, Method, method_t, options_t,
                                       require_workspace, workspace_t)
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport rows_t, view_t
from lavender_ext.factor.factors cimport block_matrix_t, has_wide
from lavender_ext.factor.linear cimport (NO_FACTOR, LinearSystem, PythonCalls, analyse_blocks, analyse_dense,
                                         block_factor_index_size, block_factor_size, block_pattern_index_size)
from lavender_ext.newton.bodies cimport (bind_bodies, bind_body_workspace, bind_panel_and_factor, bind_pattern_workspace,
                                         body_workspace_size, factor_index_size, form_panel, form_velocity_panel,
                                         index_workspace_size, order_bodies, order_elements,
                                         order_index_size, pattern_t)
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.interior cimport compute_scaling
from lavender_ext.newton.path cimport path_compliance
from lavender_ext.newton.phases cimport begin_active_set, count_active_bound_changes, exchange_rows
from lavender_ext.newton.plan cimport start_newton_solve, step_newton_solve
from lavender_ext.newton.run cimport (N_COUNTED, bind_index_workspace, bind_judge_workspace, bind_real_workspace,
                                      convex_residual, judge_workspace_size,
                                      method_index_size, method_real_size, newton_t, set_problem, set_reference,
                                      write_certificate, write_impulse)
from lavender_ext.newton.scaling cimport index_unfixed_elements, form_scaled_matrix, is_problem_supported
from lavender_ext.newton.steps cimport (begin_interior_point, form_de_saxce_matrices, take_interior_point_step,
                                        multiply_cone_duals, compute_all_normal_shifts)
from lavender_ext.newton.system cimport (BARRIER, DENSE, NATURAL, PAIR, SPARSE, dense_workspace_size, external_t,
                                         multiply_by_natural_map_derivative, solve_natural_map_system,
                                         solve_natural_map_system_refined, factor_newton_system, evaluate_system_natural_map,
                                         determinant_sign, solve_newton_system, multiply_system_matrix)

SYSTEMS = {"barrier": BARRIER, "pair": PAIR, "natural": NATURAL}
#: Compliance eps of a path of smoothed problems, relative to d.
COMPLIANCE = path_compliance()
cdef double PIVOT_TOLERANCE = 1e-13     # A pivot of a sparse matrix is lost up to this multiple of its diagonal entry.
#: Names of the counts of `Solve.counts` in the message of a solution.
COUNTED = (
    "exchanges",
    "refinements",
    "interior point steps",
    "proximal iterations",
    "De Saxce steps",
    "augmented interior point steps",
    "augmented De Saxce steps",
    "augmented steps",
    "path steps",
    "shifted Newton steps",
)


# -- the method on plain structs --------------------------------------------------------------------------------


cdef struct state_t:            # at the beginning of the integer workspace
    newton_t n
    pattern_t a


cdef inline int64_t head() noexcept nogil:
    """Return the size of `state_t`, as a number of int32."""
    return sizeof(state_t) // sizeof(int32_t)


cdef inline newton_t* state_of(const workspace_t* r) noexcept nogil:
    return &(<state_t*>r.index).n


cdef inline int32_t begin(newton_t* n, const options_t* o, const double* lam) noexcept nogil:
    """Start from lam (m). The workspace must be bound before."""
    n.tol, n.budget = o.tol, o.budget
    set_reference(&n.problem, o.e0, o.v0)
    start_newton_solve(n, lam)
    return MORE


cdef int32_t step_newton_system(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                                info_t* info) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef int32_t how
    n.budget, n.proven, n.stop = o.budget, o.proven, o.stop
    how = step_newton_solve(n, work)
    if n.best <= n.tol or n.island_best.seen == 0:
        write_impulse(n, n.best_z, lam)
    else:
        memcpy(lam, n.island_best.impulse, v.p.n_rows * sizeof(double))
    info.work = info.factorisations = n.s.factorisations
    info.relative, info.tried = n.best, n.lam
    info.direction = write_certificate(n) if how == CERTIFICATE else NULL
    return how


cdef int32_t rows_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the workspace sizes for the largest case: no row is fixed, and all contacts have six rows with friction."""
    cdef int64_t m = v.p.n_rows
    r.n_index = head() + method_index_size(m)
    r.n_real = judge_workspace_size(&v.p, NULL, NULL) + method_real_size(m, 6 * m) + 2 * m * m + dense_workspace_size(m, True) + 8
    return is_problem_supported(&v.p)


cdef inline void bind_dense_system(newton_t* n, int32_t wide, const double* h, double* matrix, double* lower) noexcept nogil:
    """Bind H and the matrix (m, m), and L L^T (`dense_workspace_size`)."""
    analyse_dense(&n.linear, n.sc.e.m)
    n.linear.wide, n.linear.matrix, n.linear.lower = wide, matrix, lower
    n.linear.factored = NO_FACTOR
    n.s.form, n.s.h, n.s.multiplied = DENSE, h, lower


cdef int32_t start_newton_over_rows(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef int64_t m = v.p.n_rows
    cdef workspace_t need
    cdef double* x
    rows_workspace_size(v, o, &need)
    if not require_workspace(r, need.n_index, need.n_real):
        return NEEDS_WORKSPACE
    memset(n, 0, sizeof(newton_t))
    set_problem(n, &v.p, v.a, NULL, NULL)
    x = bind_judge_workspace(n, r.real)
    bind_index_workspace(n, m, r.index + head())
    index_unfixed_elements(&n.sc, v)
    memset(x, 0, method_real_size(m, n.sc.small) * sizeof(double))
    x = bind_real_workspace(n, v, x)
    bind_dense_system(n, o.wide, x, x + m * m, x + 2 * m * m)
    n.s.symmetric = form_scaled_matrix(&n.sc, v.a, <int32_t>m, n.linear.swap, x)
    return begin(n, o, lam)


cdef int32_t bodies_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the integers of the elimination order; `start` computes the sizes for the factor."""
    cdef int64_t size = index_workspace_size(&v.p, v.r)
    r.n_index, r.n_real = head() + size, 0
    return size > 0


cdef int32_t start_newton_over_bodies(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef pattern_t* a = &(<state_t*>r.index).a
    cdef int64_t below, first = head() + index_workspace_size(&v.p, v.r), needed
    cdef int32_t* index = r.index + first + first % 2       # a multiple of 8 bytes
    if not r.is_bound:
        if not require_workspace(r, first, 0):
            return NEEDS_WORKSPACE
        memset(n, 0, sizeof(newton_t))
        bind_bodies(n, a, r.index + head(), &v.p, v.r)
        index_unfixed_elements(&n.sc, v)
        below = order_elements(&n.sc, a, v.r)
        if 6 * below > 2147483647:
            return UNFIT
        needed = first + 1 + factor_index_size(a.n, a.nptr[a.n], below)
        if not require_workspace(r, needed, 0):
            return NEEDS_WORKSPACE
        r.work = n.linear.cost = analyse_blocks(&n.linear.blocks, a.n, 6, a.nptr, a.nind, a.parent, a.lptr, index)
        r.is_bound = 1
    if not require_workspace(r, r.n_index, judge_workspace_size(&v.p, v.r, NULL) + body_workspace_size(n, &v.p, v.r)):
        return NEEDS_WORKSPACE
    set_problem(n, &v.p, NULL, v.r, NULL)
    index += block_pattern_index_size(a.n, 6, a.nptr[a.n], a.lptr[a.n])
    bind_body_workspace(n, a, bind_judge_workspace(n, r.real), v, o.wide, index)
    return begin(n, o, lam)


# -- for Python ------------------------------------------------------------------------------------------------


cdef class Solve(Method)        # The class is defined below.


cdef int32_t call_linear_factor(void* at, int32_t what, double eps) noexcept with gil:
    cdef Solve self = <Solve>at
    try:
        return bool(self.others.factor(what, eps))
    except BaseException as error:                      # The step ends, and its caller raises the error, also for Ctrl-C.
        self.python.store_error(error)
        return 0


cdef void call_linear_solve(void* at, double* x) noexcept with gil:
    cdef Solve self = <Solve>at
    cdef double[::1] view = <double[:self.m]>x
    cdef const double[::1] solution
    try:
        solution = self.others.solve(np.asarray(view))
        view[:] = solution
    except BaseException as error:
        self.python.store_error(error)
        view[:] = np.nan


cdef inline object part(object array, const void* at, Py_ssize_t n):
    cdef Py_ssize_t i = (<const char*>at - <const char*>get_data_pointer(array)) // <Py_ssize_t>array.itemsize
    return array[i:i + n]


cdef class Layout:
    """Elimination order of n bodies with s unknowns each, and the pattern of a factor; it may be reused between problems.

    body (k, 2) are the bodies of each element, -1 static.
    """
    cdef pattern_t a
    cdef block_matrix_t blocks
    cdef object index, pattern
    cdef readonly object body, node                     # (k, 2) bodies and block columns of each element
    cdef readonly object swapped                        # (k,) whether an element's bodies are exchanged
    cdef readonly object nptr, lptr                     # (n + 1) blocks of N by rows, and of L by columns
    cdef readonly int n, s, supernodes
    cdef readonly double work                           # multiply-adds of a factor, without stored zeros

    def __init__(self, const int32_t[:, ::1] body, int n, int s):
        cdef pattern_t* a = &self.a
        cdef int64_t k = body.shape[0], below
        cdef int32_t i
        self.index = np.empty(order_index_size(n, k) + 2, np.int32)
        bind_pattern_workspace(a, <int32_t*>get_data_pointer(self.index), n, k)
        if k:
            memcpy(a.body, &body[0, 0], 2 * k * sizeof(int32_t))
        with nogil:
            below = order_bodies(a)
        if s * below >= 2**31:
            raise OverflowError("the factor has 2^31 rows of blocks or more")
        self.pattern = np.empty(block_pattern_index_size(n, s, a.nptr[n], below), np.int32)
        analyse_blocks(&self.blocks, n, s, a.nptr, a.nind, a.parent, a.lptr, <int32_t*>get_data_pointer(self.pattern))
        self.n, self.s, self.supernodes = n, s, self.blocks.factor.supernodes
        for i in range(n):
            self.work += 0.5 * <double>(a.lptr[i + 1] - a.lptr[i]) * (a.lptr[i + 1] - a.lptr[i])
        self.work = s**3 * (self.work + below + n)
        self.body, self.node = part(self.index, a.body, 2 * k).reshape(k, 2), part(self.index, a.node, 2 * k).reshape(k, 2)
        self.swapped = part(self.index, a.swapped, k)
        self.nptr, self.lptr = part(self.index, a.nptr, n + 1), part(self.index, a.lptr, n + 1)

    def serves(self, body, int n, int s):
        """Return whether the layout is that of n bodies with s unknowns each and these elements (k, 2)."""
        return self.n == n and self.s == s and np.array_equal(self.body, body)


cdef class Solve(Method):
    """Newton's method on a problem: choose the form by one of `over_...`, call `start`, then `step` repeatedly.

    Fixed rows (equal bounds, tangents with mu = 0, empty rows) are left out: keep (m,) are the other rows, block (n,) the
    block of each element, fixed (rows,) the impulse of the fixed rows, scale (m,) is D^-1/2. ptr, part, wptr, lower,
    upper, theta, g, reach are the arrays of `elements_t`; v, einv, p, pair and bt are the elements' small matrices.

    Parameters
    ----------
    data : Data
        The problem, with d, nu and the residual of the zero impulse.
    matrix : Data or None
        A in compressed rows; None: over the bodies of `data`, or over the bodies that `graph.find_bodies_of_velocities` finds.
    """
    cdef newton_t* n
    cdef external_t calls
    cdef PythonCalls python
    cdef list held
    cdef object others, real, index
    cdef LinearSystem linear                            # of a sparse H
    cdef readonly object keep, block, ptr, part, wptr, fixed, scale, theta, g, lower, upper, reach
    cdef readonly object v, einv, p, pair, bt           # small matrices of all elements
    cdef readonly int m

    def __init__(self, Data data, Data matrix=None):
        cdef newton_t* n
        cdef view_t v = data.get_pointers() if matrix is None else view_t(data.blocks, &matrix.csr, NULL, NULL)
        cdef int64_t rows = data.blocks.n_rows, k
        self.data, self.view, self.own = data, data.get_pointers(), method_t(NULL, NULL, step_newton_system)
        self.index = np.zeros(head() + method_index_size(rows) + 1, np.int32)
        self.space.index = <int32_t*>get_data_pointer(self.index)
        n = self.n = state_of(&self.space)
        set_problem(n, &self.view.p, self.view.a, self.view.r, self.view.g)
        set_reference(&n.problem, data.reference_energy, data.reference_velocity)
        judge = allocate_zeros(judge_workspace_size(&n.problem.p, n.problem.r, n.problem.g))
        self.held = [matrix, judge]
        bind_judge_workspace(n, <double*>get_data_pointer(judge))
        bind_index_workspace(n, rows, self.space.index + head())
        index_unfixed_elements(&n.sc, &v)
        self.real = allocate_zeros(method_real_size(rows, n.sc.small))
        bind_real_workspace(n, &v, <double*>get_data_pointer(self.real))
        m = self.m = n.sc.e.m
        k = n.sc.e.n
        self.keep, self.block = part(self.index, n.sc.keep, m), part(self.index, n.sc.block, k)
        self.ptr = part(self.index, n.sc.e.ptr, k + 1)
        self.wptr, self.part = part(self.index, n.sc.e.wptr, k + 1), part(self.index, n.sc.e.part, k + 1)
        self.fixed, self.scale = part(self.real, n.sc.fixed, rows), part(self.real, n.sc.scale, m)
        self.theta, self.g = part(self.real, n.sc.e.theta, m), part(self.real, n.sc.e.g, m)
        self.lower, self.upper = part(self.real, n.sc.e.lower, m), part(self.real, n.sc.e.upper, m)
        self.reach = part(self.real, n.sc.e.reach, int(self.part[k]))
        self.v, self.einv = part(self.real, n.s.v, n.sc.small), part(self.real, n.s.einv, n.sc.small)
        self.p, self.pair = part(self.real, n.s.p, n.sc.small), part(self.real, n.s.pair, n.sc.small)
        self.bt = part(self.real, n.s.bt, n.sc.small) if n.s.bt != NULL else None
        self.calls = external_t(<void*>self, call_linear_factor, call_linear_solve)
        self.python = PythonCalls()
        self.python.stop = &n.stop

    @property
    def whole(self):
        """Whether no row is fixed."""
        return bool(self.n.sc.whole)

    @property
    def has_friction(self):
        """Whether some contact has a free friction component."""
        return self.n.sc.e.n < self.n.sc.e.m

    # -- forms -------------------------------------------------------------------------------------

    def set_external(self, others):
        """Set the object that factors the augmented system."""
        self.others, self.n.s.others = others, &self.calls

    def use_dense_matrix(self, double[:, ::1] h, bint symmetric, bint wide):
        """Use the dense matrix h (m, m) = H."""
        cdef double[::1] whole = np.empty(self.m * self.m + 1)
        cdef double[::1] lower = np.empty(dense_workspace_size(self.m, self.has_friction) + 1)
        self.held += [h, whole, lower]
        self.n.s.symmetric = symmetric
        bind_dense_system(self.n, has_wide() if wide else 0, &h[0, 0] if self.m else NULL, &whole[0], &lower[0])

    def use_sparse_matrix(self, indptr, indices, values, LinearSystem linear, to, other, h, diagonal, bint symmetric):
        """Use H in compressed rows. Its linear system `linear` has the pattern of the graph (to, other) of elements.

        h has the entries of H in these rows, diagonal (m,) those on the diagonal.
        """
        cdef double[::1] matrix = np.empty(len(h) + 1), y = np.empty(self.m)
        self.held += [indptr, indices, values, to, other, h, diagonal, matrix, y]
        self.n.s.form, self.n.s.symmetric, self.n.s.y = SPARSE, symmetric, &y[0]
        self.n.s.a.indptr, self.n.s.a.indices = <int32_t*>get_data_pointer(indptr), <int32_t*>get_data_pointer(indices)
        self.n.s.a.data = <double*>get_data_pointer(values)
        self.n.s.coupled.to, self.n.s.coupled.other = <int32_t*>get_data_pointer(to), <int32_t*>get_data_pointer(other)
        self.n.s.coupled.diagonal, self.n.s.coupled.h = <int32_t*>get_data_pointer(diagonal), <double*>get_data_pointer(h)
        linear.factor_rows_of_kernel(np.asarray(matrix)[:len(h)], PIVOT_TOLERANCE)
        self.n.s.coupled.indptr = linear.f.rows.indptr
        self.linear, self.n.s.linear = linear, &linear.f

    def jacobian(self, const int32_t[:, ::1] pair, const int32_t[::1] column=None):
        """Return K = D^-1/2 J M^-1/2 (rows, 12) of the bodies and the used columns of a body: 1, 2, 3 or all 6.

        pair (blocks, 2) are the bodies of each block; with J and M also column (nv,), from `find_bodies_of_velocities`. A
        column with entries up to 1e-9 (spheres turned by the rounding of their arms) is dropped: H = K K^T + theta has a unit
        diagonal and changes by 1e-18.
        """
        cdef const rows_t* r = &self.data.rows
        cdef int64_t i, rows = self.data.blocks.n_rows
        cdef int32_t used = 0
        panel = np.zeros((rows, 12))
        cdef double* k = <double*>get_data_pointer(panel)
        cdef double[::1] root = np.empty(10 * r.n_bodies + 1)
        with nogil:
            if column is not None:
                form_velocity_panel(&self.data.blocks, &self.data.general, &pair[0, 0], &column[0], k)
            elif r.n_bodies:
                form_panel(&self.data.blocks, r, &root[0], k)
            for i in range(12 * rows):
                if not -1e-9 <= k[i] <= 1e-9:
                    used = used | (1 << (i % 6))
                    if used == 63:
                        break
        columns = [c for c in range(6) if used >> c & 1] or [0]
        return panel, np.array(columns if len(columns) <= 3 else range(6), np.int32)

    def use_bodies(self, panel, const int32_t[::1] columns, Layout layout, bint lu, bint wide):
        """Use K of `jacobian`, which is overwritten, with these columns of each body; lu: N may have to be factored as L U."""
        cdef block_matrix_t* f = &self.n.linear.blocks
        cdef pattern_t a = layout.a
        cdef int32_t factored = a.n * layout.s
        f[0] = layout.blocks
        own = np.empty(block_factor_index_size(a.n, layout.s) + len(self.ptr) + 1, np.int32)
        a.group = <int32_t*>get_data_pointer(own) + block_factor_index_size(a.n, layout.s)
        values = np.empty(factored + block_factor_size(f, lu) + 1)
        self.held += [panel, layout, own, values]
        bind_panel_and_factor(self.n, &a, <double*>get_data_pointer(panel), &columns[0], layout.s, lu, has_wide() if wide else 0,
                    <int32_t*>get_data_pointer(own), <double*>get_data_pointer(values),
                    <double*>get_data_pointer(values) + factored)
        f.factor.interrupt = &self.python.interrupt

    # -- start and step ----------------------------------------------------------------------------

    def start(self, const double[::1] impulse, double tol, int budget):
        """Start from impulse (rows,), to a relative residual of tol, with `budget` factorisations."""
        self.set_target_and_clear_statistics(tol, budget)
        with nogil:
            begin(self.n, &self.options, &impulse[0])

    def step(self, int work, double[::1] impulse):
        """Do `work` factorisations or a few more. Write the best impulse (rows,) to `impulse`; return the outcome."""
        Method.step(self, work, impulse)
        if self.linear is not None:
            self.linear.python.raise_error()
        self.python.raise_error()
        return self.how

    def write_interior_impulse(self, double[::1] impulse):
        """Write the impulse (rows,) [N s] of the last interior point."""
        write_impulse(self.n, self.n.ip.z, &impulse[0])

    @property
    def counts(self):
        """Counts in the order of `COUNTED`."""
        return [self.n.counts[i] for i in range(N_COUNTED)]

    # -- single operations, for tests --------------------------------------------------------------

    def multiply_matrix(self, const double[::1] x):
        """Return H x (m,) for x (m,)."""
        out_array = np.empty(self.m)
        cdef double[::1] out = out_array
        multiply_system_matrix(&self.n.s, &x[0], &out[0])
        return out_array

    def evaluate_natural_map(self, const double[::1] z, const double[::1] s, int law, double eps):
        """Return F (m,) of the natural map of `law`; the small matrices of its derivative go to p, einv and v."""
        f_array = np.empty(self.m)
        cdef double[::1] f = f_array
        evaluate_system_natural_map(&self.n.s, &z[0], &s[0], law, eps, &f[0])
        return f_array

    def multiply_by_natural_map_derivative(self, const double[::1] dz):
        """Return (I - P) dz + P H dz."""
        out_array = np.empty(self.m)
        cdef double[::1] out = out_array
        multiply_by_natural_map_derivative(&self.n.s, &dz[0], &out[0])
        return out_array

    def factor(self, str what, double eps=0.0, bint augmented=False):
        """Factor the system "barrier", "pair" or "natural"; return whether no pivot failed."""
        self.n.s.augmented = augmented
        return bool(factor_newton_system(&self.n.s, SYSTEMS[what], eps))

    @property
    def sign(self):
        """Sign of the determinant of the last "natural" factor; 0 for a sparse or the augmented system."""
        return determinant_sign(&self.n.s)

    def solve(self, str what, const double[::1] r, bint refined=False):
        """Return the solution dz (m,) for the right-hand side r (m,) of the system `what`, with its last factor."""
        out_array = np.empty(self.m)
        cdef double[::1] out = out_array
        if what != "natural":
            solve_newton_system(&self.n.s, SYSTEMS[what], &r[0], &out[0])
        elif refined:
            solve_natural_map_system_refined(&self.n.s, &r[0], &out[0], self.n.r, self.n.da)
        else:
            solve_natural_map_system(&self.n.s, &r[0], &out[0])
        return out_array

    def exchange_rows(self, const double[::1] z):
        """Make one exchange from z (m,); return (is finite, z after it, relative residual, rows that changed)."""
        cdef newton_t* n = self.n
        n.depth = 0
        begin_active_set(n, &z[0])
        n.depth = 0
        finite = exchange_rows(n)
        z_array = np.asarray(<double[:self.m]>n.active.z).copy()
        residual = convex_residual(n, n.active.z, n.active.hz)
        changed = count_active_bound_changes(n.s.e, n.active.z, n.active.hz, n.active.bound)
        return finite, z_array, residual, changed

    def begin_interior(self, double delta, double fraction=0.0):
        """Compute the first point of an interior point with proximal weight `delta` and this fraction of De Saxce's term."""
        begin_interior_point(self.n, delta, fraction)

    def step_interior(self):
        """Take an interior point step; return (succeeded, length, gap before, |F| and velocity error after it)."""
        went = take_interior_point_step(self.n)
        return went, self.n.ip.length, self.n.ip.gap, self.n.ip.energy, self.n.ip.velocity

    @property
    def point(self):
        """z, u1, u2 (m,) of the interior point."""
        cdef newton_t* n = self.n
        return tuple(np.asarray(x).copy() for x in (
            <double[:self.m]>n.ip.z, <double[:self.m]>n.ip.u1, <double[:self.m]>n.ip.u2))

    def scale_interior(self, double delta):
        """Compute V = (W + theta + delta)^-1 and B, V = B B^T, of the interior point into v and bt; return the gap."""
        cdef newton_t* n = self.n
        cdef double gap
        n.ip.delta = delta
        compute_scaling(n.s.e, &n.ip, n.s.v, n.s.bt, &gap)
        return gap

    def normal_shift(self, const double[::1] s, double fraction=1.0):
        """Return phi (on normals) and psi (m,) of s (m,)."""
        phi_array, psi_array = np.empty(self.m), np.empty(self.m)
        cdef double[::1] phi = phi_array, psi = psi_array
        compute_all_normal_shifts(self.n.s.e, &s[0], fraction, &phi[0], &psi[0])
        return phi_array, psi_array

    def form_de_saxce_matrices(self, double fraction):
        """Compute the small matrices of De Saxce's form at the interior point, into pair or v; return psi (m,)."""
        multiply_cone_duals(self.n.s.e, &self.n.ip, self.n.u)
        compute_all_normal_shifts(self.n.s.e, self.n.u, fraction, self.n.c, self.n.psi)
        form_de_saxce_matrices(&self.n.s, self.n.psi)
        return np.asarray(<double[:self.m]>self.n.psi).copy()


cdef const elements_t* elements_of(object solve) except NULL:
    """Return the elements of a `Solve`."""
    return &(<Solve?>solve).n.sc.e
