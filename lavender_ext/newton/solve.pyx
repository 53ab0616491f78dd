"""Newton's method over the rows of A, or over bodies, as workspace, start and step (`core/method.pxd`).

The unit of work is a factorisation; a step may do one or two more than requested. After CERTIFICATE, `options_t.proven`
= 1 ends the solve; without it the next step continues.

The method is compiled here once: other modules call the functions of `solve.pxd` by pointer. The classes give Python the
same method, with arrays that `newton_t` points to, and its linear systems for tests.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from types import SimpleNamespace

import numpy as np

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.arrays cimport get_data_pointer, allocate_zeros
from lavender_ext.core.method cimport (CERTIFICATE, MORE, NEEDS_WORKSPACE, UNFIT, info_t, Method, method_t, options_t,
                                       require_workspace, workspace_t)
from lavender_ext.core.block_types cimport CONE
from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport rows_t, view_t
from lavender_ext.factor.factors cimport block_matrix_t, has_wide
from lavender_ext.factor.linear cimport (FALLBACK, PythonCalls, analyse_blocks, bind_block_factor_indices,
                                         bind_block_factor_values, fallback_t)
from lavender_ext.newton.active_set cimport begin_active_set, count_active_bound_changes, exchange_rows
from lavender_ext.newton.bodies cimport (bind_pattern, form_panel, form_velocity_panel, needs_lu, order_bodies, order_elements,
                                         pattern_t, use_panel)
from lavender_ext.newton.interior cimport compute_scaling
from lavender_ext.newton.path cimport path_compliance
from lavender_ext.newton.plan cimport continue_from_better_point, start_newton_solve, step_newton_solve
from lavender_ext.newton.run cimport (N_COUNTED, bind_indices, bind_values, convex_residual, newton_t, scale_problem,
                                      set_problem, set_reference, write_certificate, write_impulse)
from lavender_ext.newton.rows cimport (ANY_FORM, MAX_ALWAYS_DENSE_ROWS, analyse_row_system, bind_row_values,
                                       form_generalized_matrix, form_row_system, has_dense_rows, is_dense_faster)
from lavender_ext.newton.scaling cimport index_unfixed_elements, is_problem_supported
from lavender_ext.newton.steps cimport (begin_interior_point, form_de_saxce_matrices, take_interior_point_step,
                                        multiply_cone_duals, compute_all_normal_shifts)
from lavender_ext.newton.system cimport (BARRIER, DENSE, NATURAL, PAIR, SPARSE, external_t,
                                         multiply_by_natural_map_derivative, solve_natural_map_system,
                                         solve_natural_map_system_refined, factor_newton_system, evaluate_system_natural_map,
                                         determinant_sign, solve_newton_system, multiply_system_matrix)

SYSTEMS = {"barrier": BARRIER, "pair": PAIR, "natural": NATURAL}
#: Up to this many rows, A is stored as a full matrix.
MAX_ROWS_ALWAYS_DENSE = MAX_ALWAYS_DENSE_ROWS
#: Compliance eps of a path of smoothed problems, relative to d.
COMPLIANCE = path_compliance()
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
    "Euler steps",
)


def is_dense_factor_faster(double entries, double rows, bint cones):
    """Return whether a dense factorisation of these rows and entries of A is faster than a supernodal one.

    `cones` states whether the problem has the cone law.
    """
    return is_dense_faster(entries, rows, cones)


def uses_dense_rows(double entries, double rows, bint cones):
    """Return whether H of these rows and entries is stored as a full matrix."""
    return has_dense_rows(entries, rows, cones)


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
    n.budget, n.proven, n.stop, n.linear.deadline = o.budget, o.proven, o.stop, o.deadline
    how = step_newton_solve(n, work)
    if n.best <= n.tol or n.island_best.seen == 0:
        write_impulse(n, n.best_z, lam)
    else:
        memcpy(lam, n.island_best.impulse, v.p.n_rows * sizeof(double))
    info.work = info.factorisations = n.s.factorisations
    info.relative, info.tried = n.best, n.lam
    info.direction = write_certificate(n) if how == CERTIFICATE else NULL
    return how


cdef inline void bind_row_indices(newton_t* n, const view_t* v, arena_t* a) noexcept nogil:
    """Take the integers of the state, then of `form_generalized_matrix`, then of the elements."""
    set_problem(n, &v.p, v.a, NULL, v.g)
    take_integers(a, head())
    take_integers(a, 0 if v.g == NULL else v.g.n)
    bind_indices(n, a)


cdef int32_t rows_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the workspace of a dense A in the largest case; of a sparse A estimate the integers, and `start` finds the rest.

    Of J and M, write the integers.
    """
    cdef newton_t n
    cdef int64_t m = v.p.n_rows
    cdef arena_t a = make_arena(NULL, NULL)
    bind_row_indices(&n, v, &a)
    if v.g != NULL:
        pass
    elif m <= MAX_ALWAYS_DENSE_ROWS:
        bind_values(&n, 6 * m, False, &a)               # No row is fixed, and all contacts have six rows with friction.
        bind_row_values(&n, m, True, &a)
    elif not has_dense_rows(v.a.indptr[m], m, v.p.law == CONE):
        take_integers(&a, 60 * m + 11 * v.a.indptr[m])
    r.n_index, r.n_real = a.n_index, a.n_real
    return is_problem_supported(&v.p)


cdef inline int32_t analyse_rows_in_workspace(newton_t* n, const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Find the elements, choose the form of A and analyse a sparse one; return MORE, NEEDS_WORKSPACE or UNFIT."""
    cdef arena_t a = make_arena(NULL, r.index)
    cdef workspace_t need
    cdef int32_t outcome, form = ANY_FORM
    cdef int32_t bands[2]
    rows_workspace_size(v, NULL, &need)
    if not require_workspace(r, need.n_index, need.n_real):
        return NEEDS_WORKSPACE
    memset(n, 0, sizeof(newton_t))
    bind_row_indices(n, v, &a)
    index_unfixed_elements(&n.sc, v)
    if v.g != NULL:
        form, n.linear.cost = DENSE, <double>n.sc.e.m * n.sc.e.m * n.sc.e.m / 3.0
        r.islands = 1 if v.p.islands == NULL else v.p.islands.n
    elif (v.p.n_rows > MAX_ALWAYS_DENSE_ROWS
            and measure_asymmetry_and_bandwidth(v.a, v.p.d, v.p.n_rows, n.linear.swap, bands) > 1e-14):
        form = DENSE                                    # Factors of a sparse A without symmetry may lose pivots.
    outcome = analyse_row_system(n, v.a, form, r.n_index, &a)
    if outcome == 0:
        r.n_index = a.n_index + v.a.indptr[v.p.n_rows]
        return NEEDS_WORKSPACE
    r.work = n.linear.cost
    r.is_bound = outcome > 0 and (v.g == NULL or <double>n.sc.e.m * n.sc.e.m <= o.most and not 0.0 < o.work < r.work)
    return MORE if r.is_bound else UNFIT


cdef int32_t start_newton_over_rows(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef arena_t counted = make_arena(NULL, NULL), a = make_arena(r.real, NULL)
    cdef int32_t how = MORE if r.is_bound else analyse_rows_in_workspace(n, v, o, r)
    cdef int64_t scratch
    if how != MORE:
        return how
    set_problem(n, &v.p, v.a, NULL, v.g)
    scratch = 0 if v.g == NULL else <int64_t>v.g.n * (n.sc.e.m + 4)
    bind_values(n, n.sc.small, False, &counted)
    bind_row_values(n, n.sc.e.m, n.s.form == DENSE, &counted)
    take_doubles(&counted, scratch)
    if not require_workspace(r, r.n_index, counted.n_real):
        return NEEDS_WORKSPACE
    bind_values(n, n.sc.small, True, &a)
    scale_problem(n, v)
    bind_row_values(n, n.sc.e.m, n.s.form == DENSE, &a)
    if v.g != NULL:
        form_generalized_matrix(n, o.wide, take_doubles(&a, scratch), r.index + head())
    else:
        form_row_system(n, v.a, o.wide)
    return begin(n, o, lam)


cdef inline void bind_body_indices(state_t* s, const view_t* v, arena_t* a) noexcept nogil:
    """Take the state, and the integers of the elimination order if every row were an element."""
    take_integers(a, head())
    set_problem(&s.n, &v.p, NULL, v.r, NULL)
    bind_pattern(&s.a, v.r.n_bodies, v.p.n_rows, a)
    bind_indices(&s.n, a)


cdef int32_t bodies_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the integers of the elimination order; `start` computes the sizes for the factor."""
    cdef state_t s
    cdef arena_t a = make_arena(NULL, NULL)
    if v.p.n_rows > 0 and v.r.n_bodies > 0 and is_problem_supported(&v.p):
        bind_body_indices(&s, v, &a)
    r.n_index, r.n_real = a.n_index, 0
    return a.n_index > 0


cdef inline void bind_body_values(newton_t* n, const view_t* v, int32_t wide, double** panel, double** y, double** root,
                                  arena_t* a) noexcept nogil:
    """Take all values after the analysis: the panel (rows, 12), y (6 n_bodies) and root (10 n_bodies), and the factor."""
    bind_values(n, n.sc.small, a.real != NULL, a)
    panel[0], root[0] = take_doubles(a, 12 * <int64_t>v.p.n_rows), take_doubles(a, 10 * <int64_t>v.r.n_bodies)
    y[0] = take_doubles(a, 6 * <int64_t>v.r.n_bodies)
    bind_block_factor_values(&n.linear.blocks, needs_lu(n, &v.p), wide, a)


cdef inline int32_t analyse_bodies(state_t* s, const view_t* v, workspace_t* r) noexcept nogil:
    """Order the bodies and analyse the pattern of the factor; return MORE, NEEDS_WORKSPACE or UNFIT."""
    cdef pattern_t* p = &s.a
    cdef newton_t* n = &s.n
    cdef arena_t a = make_arena(NULL, r.index), counted
    cdef workspace_t need
    bodies_workspace_size(v, NULL, &need)
    if not require_workspace(r, need.n_index, 0):
        return NEEDS_WORKSPACE
    memset(n, 0, sizeof(newton_t))
    bind_body_indices(s, v, &a)
    index_unfixed_elements(&n.sc, v)
    if 6 * order_elements(&n.sc, p, v.r) > 2147483647:
        return UNFIT
    counted = arena_t(NULL, NULL, 0, a.n_index)
    n.linear.blocks.n, n.linear.blocks.factor.n = p.n, 6 * p.n
    analyse_blocks(&n.linear.blocks, p.n, 6, p.nptr, p.nind, p.parent, p.lptr, &counted)
    bind_block_factor_indices(&n.linear.blocks, &counted)
    if not require_workspace(r, counted.n_index, 0):
        return NEEDS_WORKSPACE
    r.work = n.linear.cost = analyse_blocks(&n.linear.blocks, p.n, 6, p.nptr, p.nind, p.parent, p.lptr, &a)
    bind_block_factor_indices(&n.linear.blocks, &a)
    r.is_bound = 1
    return MORE


cdef int32_t start_newton_over_bodies(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef state_t* s = <state_t*>r.index
    cdef newton_t* n = &s.n
    cdef arena_t counted = make_arena(NULL, NULL), a = make_arena(r.real, r.index)
    cdef int32_t i, how = MORE if r.is_bound else analyse_bodies(s, v, r)
    cdef int32_t column[6]
    cdef double* panel
    cdef double* root
    cdef double* y
    if how != MORE:
        return how
    set_problem(n, &v.p, NULL, v.r, NULL)
    bind_body_values(n, v, 0, &panel, &y, &root, &counted)
    if not require_workspace(r, r.n_index, counted.n_real):
        return NEEDS_WORKSPACE
    bind_body_values(n, v, o.wide, &panel, &y, &root, &a)
    scale_problem(n, v)
    for i in range(6):
        column[i] = i
    form_panel(&v.p, v.r, root, panel)
    use_panel(n, &s.a, panel, column, 6, y)
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
    solve_by_object(self.others, self.python, x, self.m)


cdef int32_t call_sparse_fallback(void* at) noexcept with gil:
    cdef Solve self = <Solve>at
    if self.python.error is not None:                   # The caller is about to raise it.
        return 0
    try:
        self.factored = self.splu(self.sparse)
        return 1
    except RuntimeError:                                # The matrix is singular.
        return 0
    except BaseException as error:
        self.python.store_error(error)
        return 0


cdef void solve_by_sparse_fallback(void* at, double* x) noexcept with gil:
    cdef Solve self = <Solve>at
    solve_by_object(self.factored, self.python, x, self.m)


cdef inline void solve_by_object(object factored, PythonCalls python, double* x, int32_t m) noexcept:
    """Overwrite x (m) with the solution by a Python object; an exception is stored and leaves NaN."""
    cdef double[::1] view = <double[:m]>x
    cdef const double[::1] solution
    try:
        solution = factored.solve(np.array(view))
        view[:] = solution
    except BaseException as error:                      # The step ends, and its caller raises the error, also for Ctrl-C.
        python.store_error(error)
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
        cdef arena_t counted = make_arena(NULL, NULL), arena
        bind_pattern(a, n, k, &counted)
        self.index = np.empty(counted.n_index + 2, np.int32)
        arena = make_arena(NULL, <int32_t*>get_data_pointer(self.index))
        bind_pattern(a, n, k, &arena)
        if k:
            memcpy(a.body, &body[0, 0], 2 * k * sizeof(int32_t))
        with nogil:
            below = order_bodies(a)
        if s * below >= 2**31:
            raise OverflowError("the factor has 2^31 rows of blocks or more")
        counted = make_arena(NULL, NULL)
        analyse_blocks(&self.blocks, n, s, a.nptr, a.nind, a.parent, a.lptr, &counted)
        self.pattern = np.empty(counted.n_index, np.int32)
        arena = make_arena(NULL, <int32_t*>get_data_pointer(self.pattern))
        analyse_blocks(&self.blocks, n, s, a.nptr, a.nind, a.parent, a.lptr, &arena)
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
    cdef state_t state
    cdef newton_t* n
    cdef external_t calls
    cdef PythonCalls python
    cdef list held
    cdef object others, real, index
    cdef fallback_t fallback
    cdef object splu, sparse, factored                  # of a sparse H
    cdef readonly object keep, block, ptr, part, wptr, fixed, scale, theta, g, lower, upper, reach
    cdef readonly object v, einv, p, pair, bt           # small matrices of all elements
    cdef readonly int m

    def __init__(self, Data data, Data matrix=None):
        cdef newton_t* n
        cdef view_t v = data.get_pointers() if matrix is None else view_t(data.blocks, &matrix.csr, NULL, NULL)
        cdef int64_t rows = data.blocks.n_rows, k
        cdef arena_t a = make_arena(NULL, NULL)
        self.data, self.view, self.own = data, data.get_pointers(), method_t(NULL, NULL, step_newton_system)
        n = self.n = &self.state.n
        self.space.index = <int32_t*>&self.state
        set_problem(n, &self.view.p, self.view.a, self.view.r, self.view.g)
        set_reference(&n.problem, data.reference_energy, data.reference_velocity)
        bind_indices(n, &a)
        self.index = np.zeros(a.n_index, np.int32)
        a = make_arena(NULL, <int32_t*>get_data_pointer(self.index))
        bind_indices(n, &a)
        index_unfixed_elements(&n.sc, &v)
        bind_values(n, n.sc.small, False, &a)
        self.held, self.real = [matrix], allocate_zeros(a.n_real)
        a = make_arena(<double*>get_data_pointer(self.real), NULL)
        bind_values(n, n.sc.small, False, &a)
        scale_problem(n, &v)
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

    def use_rows(self, Data matrix, bint symmetric, bint wide, splu, bint may_be_dense=True):
        """Use H over the rows of `matrix`, dense or in compressed rows; `splu` factors the latter if pivots are lost.

        `splu` is called with an object with data, indices and indptr, and returns one with `solve(r)`, or raises RuntimeError.
        """
        cdef newton_t* n = self.n
        cdef int64_t rows = self.data.blocks.n_rows, entries = matrix.csr.indptr[rows], capacity = 60 * rows + 11 * entries
        cdef int32_t outcome = 0
        cdef arena_t a
        while outcome == 0:
            index = np.empty(capacity + 2, np.int32)
            a = make_arena(NULL, <int32_t*>get_data_pointer(index))
            outcome = analyse_row_system(n, &matrix.csr, ANY_FORM if may_be_dense else SPARSE, capacity, &a)
            capacity = a.n_index + entries
        if outcome < 0:
            raise OverflowError("the factor has 2^31 entries or more")
        a = make_arena(NULL, NULL)
        bind_row_values(n, n.sc.e.m, n.s.form == DENSE, &a)
        real = np.empty(a.n_real + 1)
        a = make_arena(<double*>get_data_pointer(real), NULL)
        bind_row_values(n, n.sc.e.m, n.s.form == DENSE, &a)
        with nogil:
            form_row_system(n, &matrix.csr, has_wide() if wide else 0)
        n.s.symmetric = symmetric
        self.held += [matrix, index, real]
        if n.s.form == SPARSE:
            entries = n.s.coupled.indptr[self.m]
            self.sparse = SimpleNamespace(data=part(real, n.linear.rows.data, entries),
                                          indices=part(index, n.s.coupled.indices, entries),
                                          indptr=part(index, n.s.coupled.indptr, self.m + 1))
            self.splu, self.fallback = splu, fallback_t(<void*>self, call_sparse_fallback, solve_by_sparse_fallback)
            n.linear.fallback, n.linear.rows.factor.interrupt = &self.fallback, &self.python.interrupt

    @property
    def is_dense(self):
        """Whether H is stored as a full matrix."""
        return self.n.s.form == DENSE

    @property
    def uses_fallback(self):
        """Whether `splu` computed the last factor."""
        return self.n.linear.factored == FALLBACK

    @property
    def cost(self):
        """Multiply-adds of a factor L L^T over rows."""
        return self.n.linear.cost

    @property
    def entries(self):
        """Number of entries of a sparse H."""
        return self.n.s.a.indptr[self.m]

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
        cdef arena_t memory = make_arena(NULL, NULL)
        f[0] = layout.blocks
        bind_block_factor_indices(f, &memory)
        bind_block_factor_values(f, lu, 0, &memory)
        own, y = np.empty(memory.n_index + len(self.ptr) + 1, np.int32), np.empty(a.n * layout.s + 1)
        values = np.empty(memory.n_real + 1)
        self.held += [panel, layout, own, y, values]
        memory = make_arena(<double*>get_data_pointer(values), <int32_t*>get_data_pointer(own))
        bind_block_factor_indices(f, &memory)
        bind_block_factor_values(f, lu, has_wide() if wide else 0, &memory)
        a.group = take_integers(&memory, 0)
        use_panel(self.n, &a, <double*>get_data_pointer(panel), &columns[0], layout.s, <double*>get_data_pointer(y))
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
        self.python.raise_error()
        return self.how

    def continue_from_better_point(self, const double[::1] impulse, int limit):
        """Begin Euler steps from impulse (rows,), for at most `limit` factorisations; the present phase continues after them."""
        continue_from_better_point(self.n, &impulse[0], limit)

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
