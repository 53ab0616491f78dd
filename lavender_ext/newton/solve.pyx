"""Newton's method over the rows of A, or over bodies, as workspace, start and step (`core/method.pxd`).

The unit of work is a factorisation; a step may do one or two more than requested. After CERTIFICATE, `options_t.proven`
= 1 ends the solve; without it the next step continues.

The method is compiled here once: other modules call the functions of `solve.pxd` by pointer. `Solve` gives Python the same
functions, with factorisations of its own (`host_t`), and single operations for tests.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from types import SimpleNamespace

import numpy as np

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.arrays cimport get_data_pointer
from lavender_ext.core.method cimport (CERTIFICATE, MORE, NEEDS_WORKSPACE, SPENT, UNFIT, info_t, Method, method_t, options_t,
                                       require_workspace, workspace_t)
from lavender_ext.core.block_types cimport CONE, COULOMB
from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport get_block_bodies, rows_t, view_t
from lavender_ext.factor.factors cimport block_matrix_t, has_wide, interrupt_t
from lavender_ext.factor.linear cimport (FALLBACK, PythonCalls, analyse_blocks, bind_block_factor_indices,
                                         bind_block_factor_values, fallback_t)
from lavender_ext.judge.score cimport take_smallest_island_reference
from lavender_ext.newton.bodies cimport bind_pattern, form_panel, form_velocity_panel, order_bodies, pattern_t, use_panel
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.interior cimport compute_scaling
from lavender_ext.newton.interior_phases cimport compute_fraction_near_sliding
from lavender_ext.newton.path cimport path_compliance
from lavender_ext.newton.plan cimport start_newton_solve, step_newton_solve
from lavender_ext.newton.run cimport N_COUNTED, bind_indices, bind_values, newton_t, scale_problem, write_impulse
from lavender_ext.newton.rows cimport (ANY_FORM, MAX_ALWAYS_DENSE_ROWS, analyse_row_system, bind_row_values,
                                       form_generalized_matrix, form_row_system, has_dense_rows, is_dense_faster)
from lavender_ext.newton.scaling cimport bind_element_indices, index_unfixed_elements, is_problem_supported
from lavender_ext.newton.steps cimport (begin_interior_point, form_de_saxce_matrices, take_interior_point_step,
                                        multiply_cone_duals, compute_all_normal_shifts)
from lavender_ext.newton.system cimport (BARRIER, DENSE, NATURAL, PAIR, SPARSE, external_t,
                                         multiply_by_natural_map_derivative, solve_natural_map_system,
                                         factor_newton_system, evaluate_system_natural_map, solve_newton_system,
                                         multiply_system_matrix)

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


cdef struct host_t:             # `options_t.host` of Python
    int32_t form                # of H over rows: ANY_FORM or SPARSE
    int32_t symmetric           # A is symmetric
    int32_t lu                  # N may lack symmetry
    fallback_t fallback         # replaces the factor of a sparse H that loses pivots
    external_t others           # factors the augmented system of bodies
    interrupt_t* interrupt
    pattern_t pattern           # elimination order of the bodies
    block_matrix_t blocks
    const double* panel         # (rows, 12) K of the bodies
    const int32_t* columns      # (s) columns of each body
    int32_t s


cdef inline int64_t head() noexcept nogil:
    """Return the size of `state_t`, as a number of int32."""
    return sizeof(state_t) // sizeof(int32_t)


cdef inline newton_t* state_of(const workspace_t* r) noexcept nogil:
    return &(<state_t*>r.index).n


cdef inline void set_judged_problem(newton_t* n, const view_t* v) noexcept nogil:
    """Set the problem that is judged: bodies, or J and M, if H is formed from their A."""
    n.problem.p, n.problem.a, n.problem.r, n.problem.g = v.p, v.a, v.r, v.g
    if v.r != NULL or v.g != NULL:
        n.problem.a = NULL


cdef inline int32_t begin(newton_t* n, const options_t* o, const double* lam) noexcept nogil:
    """Start from lam (m). The workspace must be bound before."""
    n.tol, n.budget = o.tol, o.budget
    n.problem.e0, n.problem.v0 = o.e0, o.v0
    take_smallest_island_reference(&n.problem.p, &n.problem.e0, &n.problem.v0)
    n.island_best.reference_energy = o.e0
    start_newton_solve(n, lam)
    return MORE


cdef int32_t step_newton_system(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                                info_t* info) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef int32_t how, j
    n.budget, n.proven, n.stop, n.linear.deadline = o.budget, o.proven, o.stop, o.deadline
    how = step_newton_solve(n, work)
    if n.best <= n.tol or n.island_best.seen == 0:
        write_impulse(n, n.best_z, lam)
    else:
        memcpy(lam, n.island_best.impulse, v.p.n_rows * sizeof(double))
    info.work = info.factorisations = n.s.factorisations
    info.relative, info.tried = n.best, n.lam
    info.direction = NULL
    if how == CERTIFICATE:                              # The direction is written as an impulse (rows).
        memset(n.certificate, 0, v.p.n_rows * sizeof(double))
        for j in range(n.s.e.m):
            n.certificate[n.sc.keep[j]] = n.direction[j] * n.sc.scale[j]
        info.direction = n.certificate
    return how


cdef inline view_t make_view_of_rows(const view_t* v) noexcept nogil:
    """Return the view from which H over rows is formed: A if it is given, else J and M."""
    cdef view_t matrix = view_t(v.p, v.a, NULL, v.g)
    if v.a != NULL:
        matrix.g = NULL
    return matrix


cdef inline void bind_row_indices(newton_t* n, const view_t* v, arena_t* a) noexcept nogil:
    """Take the integers of the state, then of `form_generalized_matrix`, then of the elements."""
    set_judged_problem(n, v)
    take_integers(a, head())
    take_integers(a, 0 if v.a != NULL else v.g.n)
    bind_indices(n, a)


cdef int32_t rows_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the workspace of a dense A in the largest case; of a sparse A estimate the integers, and `start` finds the rest.

    Of J and M, write the integers.
    """
    cdef newton_t n
    cdef int64_t m = v.p.n_rows
    cdef arena_t a = make_arena(NULL, NULL)
    bind_row_indices(&n, v, &a)
    if v.a == NULL:
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
    cdef const host_t* host = <const host_t*>o.host
    cdef arena_t a = make_arena(NULL, r.index)
    cdef view_t matrix = make_view_of_rows(v)
    cdef workspace_t need
    cdef int32_t outcome, form = ANY_FORM if host == NULL else host.form
    cdef int32_t bands[2]
    rows_workspace_size(v, o, &need)
    if not require_workspace(r, need.n_index, 0):
        r.n_real = need.n_real
        return NEEDS_WORKSPACE
    memset(n, 0, sizeof(newton_t))
    bind_row_indices(n, v, &a)
    index_unfixed_elements(&n.sc, &matrix)
    if v.a == NULL:
        form, n.linear.cost = DENSE, <double>n.sc.e.m * n.sc.e.m * n.sc.e.m / 3.0
        r.islands = 1 if v.p.islands == NULL else v.p.islands.n
    elif (host == NULL and v.p.n_rows > MAX_ALWAYS_DENSE_ROWS
            and measure_asymmetry_and_bandwidth(v.a, v.p.d, v.p.n_rows, n.linear.swap, bands) > 1e-14):
        form = DENSE                                    # Factors of a sparse A without symmetry may lose pivots.
    outcome = analyse_row_system(n, v.a, form, r.n_index, &a)
    if outcome == 0:
        r.n_index = a.n_index + v.a.indptr[v.p.n_rows]
        return NEEDS_WORKSPACE
    r.work = n.linear.cost
    r.is_bound = outcome > 0 and (v.a != NULL or <double>n.sc.e.m * n.sc.e.m <= o.most and not 0.0 < o.work < r.work)
    return MORE if r.is_bound else UNFIT


cdef void keep_row_matrix(workspace_t* r) noexcept nogil:
    """Let later starts over rows, with the same A, keep a dense H that is formed."""
    state_of(r).keeps_matrix = True


cdef int32_t start_newton_over_rows(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef const host_t* host = <const host_t*>o.host
    cdef arena_t counted = make_arena(NULL, NULL), a = make_arena(r.real, NULL)
    cdef int32_t how = MORE if r.is_bound else analyse_rows_in_workspace(n, v, o, r)
    cdef view_t matrix = make_view_of_rows(v)
    cdef int64_t scratch
    if how != MORE:
        return how
    set_judged_problem(n, v)
    scratch = 0 if v.a != NULL else <int64_t>v.g.n * (n.sc.e.m + 4)
    bind_values(n, n.sc.small, False, &counted)
    bind_row_values(n, n.sc.e.m, n.s.form == DENSE, &counted)
    take_doubles(&counted, scratch)
    if not require_workspace(r, r.n_index, counted.n_real):
        return NEEDS_WORKSPACE
    bind_values(n, n.sc.small, True, &a)
    scale_problem(n, &matrix)
    bind_row_values(n, n.sc.e.m, n.s.form == DENSE, &a)
    if v.a == NULL:
        if not form_generalized_matrix(n, o.wide, take_doubles(&a, scratch), r.index + head(), o.deadline):
            return SPENT
    else:
        form_row_system(n, v.a, o.wide)
    if host != NULL:
        n.s.symmetric = host.symmetric
        if n.s.form == SPARSE:
            n.linear.fallback, n.linear.rows.factor.interrupt = &host.fallback, host.interrupt
    return begin(n, o, lam)


cdef inline void bind_body_indices(state_t* s, const view_t* v, const host_t* host, arena_t* a) noexcept nogil:
    """Take the state, and the integers of the elimination order if every row were an element."""
    take_integers(a, head())
    set_judged_problem(&s.n, v)
    if host == NULL:
        bind_pattern(&s.a, v.r.n_bodies, v.p.n_rows, a)
    else:
        s.a, s.n.linear.blocks = host.pattern, host.blocks
        bind_block_factor_indices(&s.n.linear.blocks, a)
        s.a.group = take_integers(a, v.p.n_rows + 1)
    bind_indices(&s.n, a)


cdef int32_t bodies_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the integers of the elimination order; `start` computes the sizes for the factor."""
    cdef const host_t* host = <const host_t*>o.host
    cdef state_t s
    cdef arena_t a = make_arena(NULL, NULL)
    if v.p.n_rows > 0 and (host != NULL or v.r.n_bodies > 0) and is_problem_supported(&v.p):
        bind_body_indices(&s, v, host, &a)
    r.n_index, r.n_real = a.n_index, 0
    return a.n_index > 0


cdef inline void bind_body_values(state_t* s, const view_t* v, const options_t* o, double** panel, double** y, double** root,
                                  arena_t* a) noexcept nogil:
    """Take all values after the analysis: the panel (rows, 12), y (6 n_bodies) and root (10 n_bodies), and the factor."""
    cdef newton_t* n = &s.n
    cdef const host_t* host = <const host_t*>o.host
    cdef bint lu = host.lu if host != NULL else v.p.law == COULOMB and n.sc.e.n < n.sc.e.m    # N may lack symmetry.
    bind_values(n, n.sc.small, a.real != NULL, a)
    panel[0], root[0] = take_doubles(a, 12 * <int64_t>v.p.n_rows), take_doubles(a, 10 * <int64_t>s.a.n if host == NULL else 0)
    y[0] = take_doubles(a, 6 * <int64_t>s.a.n)
    bind_block_factor_values(&n.linear.blocks, lu, o.wide if a.real != NULL else 0, a)


cdef inline int32_t analyse_bodies(state_t* s, const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Order the bodies and analyse the pattern of the factor; return MORE, NEEDS_WORKSPACE or UNFIT."""
    cdef pattern_t* p = &s.a
    cdef newton_t* n = &s.n
    cdef const host_t* host = <const host_t*>o.host
    cdef arena_t a = make_arena(NULL, r.index), counted
    cdef workspace_t need
    cdef int32_t i
    bodies_workspace_size(v, o, &need)
    if not require_workspace(r, need.n_index, 0):
        return NEEDS_WORKSPACE
    memset(n, 0, sizeof(newton_t))
    bind_body_indices(s, v, host, &a)
    index_unfixed_elements(&n.sc, v)
    if host == NULL:
        p.k = n.sc.e.n
        for i in range(p.k):                            # Order the bodies of the elements.
            p.body[2 * i], p.body[2 * i + 1] = get_block_bodies(v.r, n.sc.block[i])[0], get_block_bodies(v.r, n.sc.block[i])[1]
        if 6 * order_bodies(p) > 2147483647:
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
    cdef const host_t* host = <const host_t*>o.host
    cdef arena_t counted = make_arena(NULL, NULL), a = make_arena(r.real, r.index)
    cdef int32_t i, how = MORE if r.is_bound else analyse_bodies(s, v, o, r)
    cdef int32_t column[6]
    cdef double* panel
    cdef double* root
    cdef double* y
    if how != MORE:
        return how
    set_judged_problem(n, v)
    bind_body_values(s, v, o, &panel, &y, &root, &counted)
    if not require_workspace(r, r.n_index, counted.n_real):
        return NEEDS_WORKSPACE
    bind_body_values(s, v, o, &panel, &y, &root, &a)
    scale_problem(n, v)
    if host != NULL:
        memcpy(panel, host.panel, 12 * <int64_t>v.p.n_rows * sizeof(double))
        use_panel(n, &s.a, panel, host.columns, host.s, y)
        n.s.others, n.linear.blocks.factor.interrupt = &host.others, host.interrupt
        return begin(n, o, lam)
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
    solve_by_object(self.others, self.python, x, state_of(&self.space).s.e.m)


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
    solve_by_object(self.factored, self.python, x, state_of(&self.space).s.e.m)


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


cdef inline object view_doubles(const double* x, Py_ssize_t n):
    """Return a view (n,) of memory of a `Solve`."""
    return np.asarray(<double[:n]><double*>x) if n else np.empty(0)


cdef inline object view_integers(const int32_t* x, Py_ssize_t n):
    """Return a view (n,) of memory of a `Solve`."""
    return np.asarray(<int32_t[:n]><int32_t*>x) if n else np.empty(0, np.int32)


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

    def serves(self, body, int n, int s):
        """Return whether the layout is that of n bodies with s unknowns each and these elements (k, 2)."""
        return self.n == n and self.s == s and np.array_equal(self.body, body)


def list_element_blocks(Data data):
    """Return the block (n,) of each element: of each block that has rows which are not fixed, or of each such row of several."""
    cdef newton_t n
    cdef view_t v = data.get_pointers()
    cdef arena_t a = make_arena(NULL, NULL)
    bind_element_indices(&n.sc, v.p.n_rows, &a)
    index = np.empty(a.n_index + 1, np.int32)
    a = make_arena(NULL, <int32_t*>get_data_pointer(index))
    bind_element_indices(&n.sc, v.p.n_rows, &a)
    index_unfixed_elements(&n.sc, &v)
    return part(index, n.sc.block, n.sc.e.n).copy()


def compute_body_jacobian(Data data, const int32_t[:, ::1] pair, const int32_t[::1] column=None):
    """Return K = D^-1/2 J M^-1/2 (rows, 12) of the bodies and the used columns of a body: 1, 2, 3 or all 6.

    pair (blocks, 2) are the bodies of each block; with J and M also column (nv,), from `find_bodies_of_velocities`. A
    column with entries up to 1e-9 (spheres turned by the rounding of their arms) is dropped: H = K K^T + theta has a unit
    diagonal and changes by 1e-18.
    """
    cdef const rows_t* r = &data.rows
    cdef int64_t i, rows = data.blocks.n_rows
    cdef int32_t used = 0
    panel = np.zeros((rows, 12))
    cdef double* k = <double*>get_data_pointer(panel)
    cdef double[::1] root = np.empty(10 * r.n_bodies + 1)
    with nogil:
        if column is not None:
            form_velocity_panel(&data.blocks, &data.general, &pair[0, 0], &column[0], k)
        elif r.n_bodies:
            form_panel(&data.blocks, r, &root[0], k)
        for i in range(12 * rows):
            if not -1e-9 <= k[i] <= 1e-9:
                used = used | (1 << (i % 6))
                if used == 63:
                    break
    columns = [c for c in range(6) if used >> c & 1] or [0]
    return panel, np.array(columns if len(columns) <= 3 else range(6), np.int32)


cdef class Solve(Method):
    """Newton's method on a problem over the rows of A or over bodies: call `start`, then `step` repeatedly.

    Parameters
    ----------
    data : Data
        The problem, with d, nu and the residual of the zero impulse.
    wide : bool
        Whether to use instructions for four doubles, if the processor has them.
    """
    cdef host_t host
    cdef PythonCalls python
    cdef readonly object others                         # factors the augmented system
    cdef object splu, sparse, factored                  # of a sparse H
    cdef list held

    def __init__(self, Data data, bint wide):
        self.data, self.view, self.python = data, data.get_pointers(), PythonCalls()
        self.options.wide, self.options.host = has_wide() if wide else 0, &self.host
        self.host.interrupt = &self.python.interrupt

    cdef int prepare_workspace(self) except -1:
        """Analyse the problem and bind the integers."""
        if self.analyse() != NEEDS_WORKSPACE:
            raise OverflowError("the factor has 2^31 entries or more, or the memory does not suffice")
        self.python.stop = &self.get_state().stop
        return 0

    cdef newton_t* get_state(self) noexcept:
        return state_of(&self.space)

    @staticmethod
    def over_rows(Data data, Data matrix, bint symmetric, bint wide, splu, bint may_be_dense=True):
        """Return the method over the rows of `matrix`, dense or in compressed rows; `splu` factors these if pivots are lost.

        `splu` is called with an object with data, indices and indptr, and returns one with `solve(r)`, or raises RuntimeError.
        """
        cdef Solve self = Solve(data, wide)
        self.view.a, self.own = &matrix.csr, method_t(rows_workspace_size, start_newton_over_rows, step_newton_system)
        self.host.form, self.host.symmetric = ANY_FORM if may_be_dense else SPARSE, symmetric
        self.splu, self.host.fallback = splu, fallback_t(<void*>self, call_sparse_fallback, solve_by_sparse_fallback)
        self.held = [matrix]
        self.prepare_workspace()
        return self

    @staticmethod
    def over_bodies(Data data, panel, const int32_t[::1] columns, Layout layout, bint lu, bint wide, others=None):
        """Return the method with K of `compute_body_jacobian` and these columns; lu: N may have to be factored as L U.

        `others`, unless None, is a function that takes the method and returns the object that factors the augmented system.
        """
        cdef Solve self = Solve(data, wide)
        self.own = method_t(bodies_workspace_size, start_newton_over_bodies, step_newton_system)
        self.host.pattern, self.host.blocks, self.host.lu = layout.a, layout.blocks, lu
        self.host.panel, self.host.columns, self.host.s = <double*>get_data_pointer(panel), &columns[0], layout.s
        self.held = [panel, columns, layout]
        if others is not None:
            self.others = others(self)
            self.host.others = external_t(<void*>self, call_linear_factor, call_linear_solve)
        self.prepare_workspace()
        return self

    def keep_matrix(self):
        """Let later starts keep a dense H that is formed; only `use_rhs` may change the data then."""
        if self.own.start == start_newton_over_rows:
            keep_row_matrix(&self.space)

    def start(self, const double[::1] impulse, double tol, int budget):
        """Start from impulse (rows,), to a relative residual of tol, with `budget` factorisations."""
        cdef newton_t* n = self.get_state()
        Method.start(self, impulse, tol, budget)
        if self.splu is not None and n.s.form == SPARSE:
            self.sparse = SimpleNamespace(data=view_doubles(n.linear.rows.data, n.s.coupled.indptr[n.sc.e.m]),
                                          indices=view_integers(n.s.coupled.indices, n.s.coupled.indptr[n.sc.e.m]),
                                          indptr=view_integers(n.s.coupled.indptr, n.sc.e.m + 1))

    def step(self, int work, double[::1] impulse):
        """Do `work` factorisations or a few more. Write the best impulse (rows,) to `impulse`; return the outcome."""
        Method.step(self, work, impulse)
        self.python.raise_error()
        return self.how

    def write_interior_impulse(self, double[::1] impulse):
        """Write the impulse (rows,) [N s] of the last interior point."""
        write_impulse(self.get_state(), self.get_state().ip.z, &impulse[0])

    @property
    def fraction_near_sliding(self):
        """Fraction of the loaded contacts with at least 0.95 of their friction bound at the last interior point."""
        return compute_fraction_near_sliding(self.get_state().s.e, self.get_state().ip.z)

    @property
    def counts(self):
        """Counts in the order of `COUNTED`."""
        return [self.get_state().counts[i] for i in range(N_COUNTED)]

    @property
    def m(self):
        """Number of rows that are not fixed."""
        return self.get_state().sc.e.m

    @property
    def is_dense(self):
        """Whether H is stored as a full matrix."""
        return self.get_state().s.form == DENSE

    @property
    def entries(self):
        """Number of entries of a sparse H."""
        return self.get_state().s.a.indptr[self.m]

    def view_arrays(self):
        """Return views of the arrays of `scaled_t` and `elements_t`, and of the elements' small matrices v, p, pair and bt.

        Fixed rows (equal bounds, tangents with mu = 0, empty rows) are left out: keep (m,) are the other rows, fixed (rows,) the
        impulse of the fixed rows. The arrays exist after `start`, and as long as this object.
        """
        cdef newton_t* n = self.get_state()
        cdef const elements_t* e = &n.sc.e
        cdef Py_ssize_t k = e.n, m = e.m, small = n.sc.small
        return SimpleNamespace(
            m=m, keep=view_integers(n.sc.keep, m), ptr=view_integers(e.ptr, k + 1), wptr=view_integers(e.wptr, k + 1),
            part=view_integers(e.part, k + 1), fixed=view_doubles(n.sc.fixed, self.view.p.n_rows), g=view_doubles(e.g, m),
            theta=view_doubles(e.theta, m), reach=view_doubles(e.reach, e.part[k]), v=view_doubles(n.s.v, small),
            p=view_doubles(n.s.p, small), pair=view_doubles(n.s.pair, small),
            bt=None if n.s.bt == NULL else view_doubles(n.s.bt, small))

    # -- single operations, for tests: after `start` ----------------------------------------------

    def multiply_matrix(self, const double[::1] x):
        """Return H x (m,) for x (m,)."""
        cdef double[::1] out = np.empty(self.m)
        multiply_system_matrix(&self.get_state().s, &x[0], &out[0])
        return np.asarray(out)

    def evaluate_natural_map(self, const double[::1] z, const double[::1] s, int law, double eps):
        """Return F (m,) of the natural map of `law`; the small matrices of its derivative go to p, einv and v."""
        cdef double[::1] f = np.empty(self.m)
        evaluate_system_natural_map(&self.get_state().s, &z[0], &s[0], law, eps, &f[0])
        return np.asarray(f)

    def multiply_by_natural_map_derivative(self, const double[::1] dz):
        """Return (I - P) dz + P H dz."""
        cdef double[::1] out = np.empty(self.m)
        multiply_by_natural_map_derivative(&self.get_state().s, &dz[0], &out[0])
        return np.asarray(out)

    def factor(self, str what, double eps=0.0, bint augmented=False):
        """Factor the system "barrier", "pair" or "natural"; return whether no pivot failed."""
        self.get_state().s.augmented = augmented
        return bool(factor_newton_system(&self.get_state().s, SYSTEMS[what], eps))

    @property
    def uses_fallback(self):
        """Whether `splu` computed the last factor."""
        return self.get_state().linear.factored == FALLBACK

    def solve(self, str what, const double[::1] r):
        """Return the solution dz (m,) for the right-hand side r (m,) of the system `what`, with its last factor."""
        cdef double[::1] out = np.empty(self.m)
        if what == "natural":
            solve_natural_map_system(&self.get_state().s, &r[0], &out[0])
        else:
            solve_newton_system(&self.get_state().s, SYSTEMS[what], &r[0], &out[0])
        return np.asarray(out)

    def begin_interior(self, double delta, double fraction=0.0):
        """Compute the first point of an interior point with proximal weight `delta` and this fraction of De Saxce's term."""
        begin_interior_point(self.get_state(), delta, fraction)

    def step_interior(self):
        """Take an interior point step; return whether it succeeded."""
        return take_interior_point_step(self.get_state())

    def scale_interior(self, double delta):
        """Compute V = (W + theta + delta)^-1 and B, V = B B^T, of the interior point into v and bt."""
        cdef newton_t* n = self.get_state()
        cdef double gap
        n.ip.delta = delta
        compute_scaling(n.s.e, &n.ip, n.s.v, n.s.bt, &gap)

    def normal_shift(self, const double[::1] s, double fraction=1.0):
        """Return phi (on normals) and psi (m,) of s (m,)."""
        cdef double[::1] phi = np.empty(self.m), psi = np.empty(self.m)
        compute_all_normal_shifts(self.get_state().s.e, &s[0], fraction, &phi[0], &psi[0])
        return np.asarray(phi), np.asarray(psi)

    def form_de_saxce_matrices(self, double fraction):
        """Compute the small matrices of De Saxce's form at the interior point, into pair or v; return psi (m,)."""
        cdef newton_t* n = self.get_state()
        multiply_cone_duals(n.s.e, &n.ip, n.u)
        compute_all_normal_shifts(n.s.e, n.u, fraction, n.c, n.psi)
        form_de_saxce_matrices(&n.s, n.psi)
        return view_doubles(n.psi, self.m).copy()
