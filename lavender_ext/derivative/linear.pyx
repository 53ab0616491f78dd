"""Judged and linearised solutions (`natural.pxd`) for Python, with a factor of the linear equations if there are few.

With cotangents c of lambda, x of w and y of v (equation (4) of lavender/gradient/__init__.py), for J and M or bodies

    G^T q = D^-1/2 (c + C x + J M^-1 (y + J^T x)),   s = D^-1/2 P^T q - x,   f = y - J^T s                  (1)

with C the compliance, and for a matrix

    G^T q = D^-1/2 (c + A^T x),   s = D^-1/2 P^T q - x                                                      (2)
"""
from libc.math cimport fabs
from libc.stdint cimport int8_t, int32_t, int64_t
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.arena cimport arena_t, make_arena, take_doubles, take_integers
from lavender_ext.core.arrays cimport C_CONTIGUOUS, DOUBLE, as_double_pointer, has_element_type, ndarray
from lavender_ext.core.validate cimport all_finite, find_invalid_number
from lavender_ext.core.generalized cimport multiply_jacobian_transpose, whitened_row_dot
from lavender_ext.core.block_types cimport blocks_t, has_independent_rows
from lavender_ext.core.problem cimport Data, Workspace, allocate_bytes
from lavender_ext.core.rows cimport multiply_jacobian
from lavender_ext.core.velocity cimport compute_body_wrenches, apply_body_inverse_mass
from lavender_ext.core.view cimport generalized_t, view_t
from lavender_ext.derivative.natural cimport (CLOSED, FREE, HIGH, LOW, OPEN, SLIDES, STICKS, form_scaled_csr,
                                              form_scaled_generalized, form_reduced_system, linearised_t, linearise_all_projections,
                                              multiply_block_derivatives, number_system_rows)
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.factor.linear cimport (LU, analyse_dense, factor_linear_system_matrix, solve_linear_system,
                                         solve_transposed_linear_system)
from lavender_ext.judge.measure cimport (residual_above_floor, relative_floor_of_score, judge_view, relative_residual_of_score,
                                         count_judge_scratch)
from lavender_ext.judge.score cimport make_empty_score, score_t

cdef object empty = np.empty
cdef object F8 = np.dtype(np.float64), I4 = np.dtype(np.int32), I1 = np.dtype(np.int8)

# G counts as singular if the ratio of its smallest to its largest pivot is at most this.
cdef double MIN_PIVOT_RATIO = 1e-12

#: Kernel numbers of the cases of rows.
CASES = {"open": OPEN, "closed": CLOSED, "sticks": STICKS, "slides": SLIDES, "free": FREE, "low": LOW, "high": HIGH}


cdef void multiply_jacobian_transpose_of_view(const view_t* v, const double* lam, double* f) noexcept nogil:
    """Compute f (n) = J^T lam over J and M or bodies."""
    if v.g != NULL:
        multiply_jacobian_transpose(v.g, lam, f)
    elif v.r != NULL:
        compute_body_wrenches(&v.p, v.r, lam, f)


cdef void multiply_jacobian_inverse_mass(const linearised_t* a, double* f, double* out) noexcept nogil:
    """Compute out = J M^-1 f on the rows of G (with bodies: on all rows); f (n) is overwritten.

    With M = L^T D L the result is Y D^-1/2 L^-T f.
    """
    cdef const generalized_t* g = a.v.g
    cdef int32_t k, q, i, b
    cdef double z
    if a.v.r != NULL:
        apply_body_inverse_mass(a.v.r, f)
        multiply_jacobian(&a.v.p, a.v.r, f, out)
        return
    for k in range(g.n - 1, -1, -1):
        z = f[k]
        if z != 0.0:
            for q in range(g.lptr[k], g.lptr[k + 1]):
                f[g.lidx[q]] -= g.lval[q] * z
            f[k] = z * g.root[k]
    for b in range(g.n_panels):
        for i in range(g.prow[b], g.prow[b + 1]):
            if a.system_row[i] >= 0:
                out[i] = whitened_row_dot(g, b, i, f)


cdef public void lav_adjoint(const linearised_t* a, const double* y, const double* c, const double* x, double* q, double* s,
                             double* f) noexcept nogil:
    """Compute q, s and f of (1) or (2), with q = 0 on rows outside G; y (n), c (m) and x (m) may be NULL, for 0."""
    cdef const view_t* v = &a.v
    cdef int32_t i, k, m = v.p.n_rows
    cdef const double* soft = NULL
    if v.a == NULL:
        soft = v.g.compliance if v.g != NULL else v.r.compliance
    memset(q, 0, m * sizeof(double))
    if v.a != NULL and x != NULL:
        for i in range(m):                              # A^T x of a matrix
            for k in range(v.a.indptr[i], v.a.indptr[i + 1]):
                q[v.a.indices[k]] += v.a.data[k] * x[i]
    elif y != NULL or x != NULL:
        memset(f, 0, a.n * sizeof(double))
        if x != NULL:
            multiply_jacobian_transpose_of_view(v, x, f)
        if y != NULL:
            for i in range(a.n):
                f[i] += y[i]
        multiply_jacobian_inverse_mass(a, f, q)
        if x != NULL:
            for i in range(m):
                q[i] += soft[i] * x[i]
    for i in range(m):
        if a.system_row[i] >= 0:
            s[a.system_row[i]] = (q[i] + (c[i] if c != NULL else 0.0)) / a.x.root[i]
    solve_transposed_linear_system(&a.g, s)
    for i in range(m):
        q[i] = s[a.system_row[i]] if a.system_row[i] >= 0 else 0.0
    multiply_block_derivatives(&a.x, &v.p, a.x.p, q, True, s)
    for i in range(m):
        s[i] = s[i] / a.x.root[i] - (x[i] if x != NULL else 0.0)
    multiply_jacobian_transpose_of_view(v, s, f)
    for i in range(a.n):
        f[i] = (y[i] if y != NULL else 0.0) - f[i]


cdef bint get_array_data(array, Py_ssize_t n, const double** to):
    """Write the address of a contiguous float64 array (n,) to `to`, or NULL if it is None; return whether the array is valid.

    The caller must keep the array alive.
    """
    cdef ndarray x
    to[0] = NULL
    if array is None:
        return True
    if type(array) is not ndarray:
        return False
    x = <ndarray>array
    if x.nd != 1 or x.dimensions[0] != n or not (x.flags & C_CONTIGUOUS and has_element_type(x, DOUBLE)):
        return False
    if n:
        to[0] = <const double*>x.data
    return True


cdef void form_derivative_system(const linearised_t* a, const view_t* v, double shift, double* g, double* h) noexcept nogil:
    """Compute g (rows, rows) = G of H + shift, for A from J and M or in compressed rows; h (rows, rows + n) is scratch."""
    cdef int32_t i, n = a.rows
    if v.g != NULL:
        form_scaled_generalized(v.g, n, a.system_row, a.x.root, h + <ssize_t>n * n, h)
    else:
        form_scaled_csr(v.a, a.v.p.n_rows, n, a.system_row, a.x.root, h)
    for i in range(n):
        h[<ssize_t>i * n + i] += shift
    form_reduced_system(&a.x, &a.v.p, n, a.system_row, h, g)


cdef void bind_linearised_arrays(linearised_t* a, arena_t* arena) noexcept nogil:
    """Take the arrays of the linearisation of a.v from an arena; P has n values for n bounded rows, n^2 for a contact."""
    cdef const blocks_t* b = &a.v.p
    cdef int64_t m = b.n_rows, n, values = 0
    cdef int32_t i
    for i in range(b.n_blocks):
        n = b.ptr[i + 1] - b.ptr[i]
        values += n if has_independent_rows(b, i) else n * n
    a.lam, a.w = take_doubles(arena, m), take_doubles(arena, m)
    a.x.root, a.x.f, a.x.margin = take_doubles(arena, m), take_doubles(arena, m), take_doubles(arena, m)
    a.x.p, a.x.edge = take_doubles(arena, values), take_doubles(arena, values)
    a.system_row, a.x.value_ptr = take_integers(arena, m), take_integers(arena, b.n_blocks + 1)
    a.x.case_ = <int8_t*>take_integers(arena, (m + 3) // 4)


cdef void judge_and_linearise(linearised_t* a, const double* lam, double energy, double velocity, double* scratch) noexcept nogil:
    """Judge and linearise the impulse lam (m) of a.v; energy and velocity are the references of the zero impulse.

    scratch (m + `count_judge_scratch`) is free afterwards.
    """
    cdef const blocks_t* b = &a.v.p
    cdef int32_t m = b.n_rows
    cdef score_t s = make_empty_score()
    if m == 0:
        a.regular = True
        return
    memcpy(a.lam, lam, m * sizeof(double))
    judge_view(&a.v, a.lam, a.w, scratch, scratch + m, True, &s)
    linearise_all_projections(b, a.lam, a.w, <int32_t*>a.x.value_ptr, &a.x)
    a.rows = number_system_rows(b, &a.x, a.system_row)
    a.relative = relative_residual_of_score(&s, a.w, m, energy, velocity)
    a.above_floor = residual_above_floor(&s, a.relative, relative_floor_of_score(&s, energy, velocity))


cdef ssize_t derivative_factor_scratch_size(int32_t n, const view_t* v) noexcept nogil:
    """Return the number of scratch doubles of `factor_derivative_system`."""
    cdef ssize_t width = n + (v.g.n if v.g != NULL else 0)
    return n * width


cdef void bind_derivative_factor(linearised_t* a, arena_t* arena) noexcept nogil:
    """Take the arrays of the factor of G from an arena."""
    a.g.matrix, a.g.swap = take_doubles(arena, <int64_t>a.rows * a.rows), take_integers(arena, a.rows)


cdef bint factor_derivative_system(linearised_t* a, const view_t* v, double shift, double* scratch) noexcept nogil:
    """Factor G of H + shift, with A of v, in the arrays of `bind_derivative_factor`; return whether it is regular.

    scratch (`derivative_factor_scratch_size`) is free afterwards.
    """
    cdef int32_t i, n = a.rows
    cdef double smallest = 1.0 / 0.0, norm_inf = 0.0, x
    a.tried = a.regular = True
    if n == 0:
        return True
    analyse_dense(&a.g, n)
    a.g.by, a.g.wide = LU, has_wide()
    form_derivative_system(a, v, shift, a.g.matrix, scratch)
    if factor_linear_system_matrix(&a.g) == 0:
        for i in range(n):
            x = 1.0 / fabs(a.g.matrix[<ssize_t>i * n + i])    # The factor contains 1 / U_ii.
            smallest = x if x < smallest else smallest
            norm_inf = x if x > norm_inf else norm_inf
    a.regular = smallest > MIN_PIVOT_RATIO * norm_inf and norm_inf > 0.0
    return a.regular


cdef tuple allocate_arena(arena_t* arena):
    """Allocate what an arena has counted, and begin the arena there; return both buffers, which the caller keeps."""
    cdef Workspace real = allocate_bytes(arena.n_real * sizeof(double)), index = allocate_bytes(arena.n_index * sizeof(int32_t))
    arena[0] = make_arena(<double*>real.at, <int32_t*>index.at)
    return real, index


cdef bint prepare_problem_data(Data p):
    """Compute the derived numbers of p; return False if it has too many entries, or a d outside the valid range."""
    try:
        p.compute_derived_numbers()
    except OverflowError:
        return False
    return find_invalid_number(p.blocks.d, p.blocks.n_rows) < 0


cdef bint write_adjoint(const linearised_t* a, velocity, impulse, slack, double* out):
    """Write `Linear.adjoint` to out (3 m + n); return False if an argument is invalid or all are None."""
    cdef int32_t m = a.v.p.n_rows
    cdef const double* y
    cdef const double* c
    cdef const double* x
    if velocity is None and impulse is None and slack is None:
        return False
    if not (get_array_data(velocity, a.n, &y) and get_array_data(impulse, m, &c) and get_array_data(slack, m, &x)):
        return False
    if not (all_finite(y, 0 if y == NULL else a.n) and all_finite(c, 0 if c == NULL else m)
            and all_finite(x, 0 if x == NULL else m)):
        return False
    with nogil:
        lav_adjoint(a, y, c, x, out, out + m, out + 2 * m)
        if c != NULL:
            memcpy(out + 2 * m + a.n, c, m * sizeof(double))
        else:
            memset(out + 2 * m + a.n, 0, m * sizeof(double))
    return True


cdef object copy_to_array(const void* x, Py_ssize_t n, dtype):
    """Return a new array (n,) with the numbers at x."""
    array = empty(n, dtype)
    if n:
        memcpy((<ndarray>array).data, x, n * (<ndarray>array).strides[0])
    return array


cdef class Linear:
    """One linearised solution of `Linears`. `solve` and `adjoint` use the factor that `prepare` computed last."""
    cdef linearised_t at
    cdef Data judge, data                               # the problem for the judge, and the problem with the A that is in G
    cdef Workspace numbers, integers, factor, swap
    cdef readonly int rows                              # number of rows of G
    cdef readonly bint tried                            # whether a factorisation was attempted
    cdef readonly bint regular                          # whether G is regular or empty
    cdef readonly double relative                       # relative residual of the judge
    cdef readonly double above_floor                    # relative residual that rounding does not explain

    def prepare(self, Data data, double shift=0.0):
        """Factor G of H + shift, with A of `data` (compressed rows, or J and M); return whether it is regular."""
        cdef view_t v = data.get_pointers()
        cdef arena_t arena = make_arena(NULL, NULL)
        cdef Workspace spare = allocate_bytes(derivative_factor_scratch_size(self.at.rows, &v) * sizeof(double))
        self.data = data
        bind_derivative_factor(&self.at, &arena)
        self.factor, self.swap = allocate_arena(&arena)
        bind_derivative_factor(&self.at, &arena)
        with nogil:
            factor_derivative_system(&self.at, &v, shift, <double*>spare.at)
        self.tried, self.regular = self.at.tried, self.at.regular
        return self.regular

    def adjoint(self, velocity, impulse, slack):
        """Return (q (m), s (m), f (n), c (m)) of (1), concatenated, from velocity y (n,), impulse c (m,), slack x (m,).

        An argument that is None counts as 0.

        A factor is required; n is 0 for (2). None is returned if all three are None, or if one is not such an array or not
        finite; the caller then validates in detail.
        """
        cdef Py_ssize_t n = 3 * self.at.v.p.n_rows + self.at.n
        out = empty(n)
        return out if write_adjoint(&self.at, velocity, impulse, slack, as_double_pointer(out, n)) else None

    @property
    def has_sliding_contact(self):
        """Whether any contact slides or has no friction, so that its rows of G are not those of H."""
        cdef int32_t i, j
        for i in range(self.at.v.p.n_blocks):
            for j in range(self.at.v.p.ptr[i], self.at.v.p.ptr[i + 1]):
                if self.at.system_row[j] >= 0 and self.at.x.case_[j] == SLIDES:
                    return True
        return False

    def matrix(self):
        """Return G (n, n)."""
        out_ = np.empty((self.at.rows, self.at.rows))
        cdef double[:, ::1] out = out_
        cdef view_t v = self.data.get_pointers()
        cdef Workspace work
        if self.at.rows:
            work = allocate_bytes(derivative_factor_scratch_size(self.at.rows, &v) * sizeof(double))
            form_derivative_system(&self.at, &v, 0.0, &out[0, 0], <double*>work.at)
        return out_

    def solve(self, r, bint transpose=False):
        """Return x (n,) with G x = r, or G^T x = r."""
        out_ = r.copy()
        cdef double[::1] out = out_
        if self.at.rows and transpose:
            solve_transposed_linear_system(&self.at.g, &out[0])
        elif self.at.rows:
            solve_linear_system(&self.at.g, &out[0])
        return out_

    def multiply_projection_derivative(self, v_, bint transpose=False, bint edge=False):
        """Return P v (m,), or dPi/de v with `edge`; with `transpose` the product with the transpose."""
        cdef const double[::1] v = v_
        out_ = np.empty(self.at.v.p.n_rows)
        cdef double[::1] out = out_
        if self.at.v.p.n_rows:
            multiply_block_derivatives(&self.at.x, &self.at.v.p, self.at.x.edge if edge else self.at.x.p, &v[0], transpose, &out[0])
        return out_

    @property
    def impulse(self):
        """Impulse lambda (m,) [N s]."""
        return copy_to_array(self.at.lam, self.at.v.p.n_rows, F8)

    @property
    def slack(self):
        """Slack w (m,) [m/s]."""
        return copy_to_array(self.at.w, self.at.v.p.n_rows, F8)

    @property
    def root(self):
        """Scale D^1/2 (m,)."""
        return copy_to_array(self.at.x.root, self.at.v.p.n_rows, F8)

    @property
    def residual(self):
        """Residual F (m,) of natural.pxd (1)."""
        return copy_to_array(self.at.x.f, self.at.v.p.n_rows, F8)

    @property
    def margin(self):
        """Distance of each row to the next case (m,) [N s]."""
        return copy_to_array(self.at.x.margin, self.at.v.p.n_rows, F8)

    @property
    def p(self):
        """Values of P, block by block: the diagonal for bounded rows, otherwise row by row."""
        return copy_to_array(self.at.x.p, self.at.x.value_ptr[self.at.v.p.n_blocks] if self.at.v.p.n_rows else 0, F8)

    @property
    def case(self):
        """Case of each row (m,), int8, by the numbers of CASES."""
        return copy_to_array(self.at.x.case_, self.at.v.p.n_rows, I1)

    @property
    def system_row(self):
        """Row of G of each row (m,), -1 if it has none."""
        return copy_to_array(self.at.system_row, self.at.v.p.n_rows, I4)


cdef class Linears:
    """Judge and linearise several impulses (m,) [N s] at once.

    The references of the zero impulse must be set in the data. impulses is a list, or the arrays (all impulses, first index of
    each, number of rows of each). G is factored if A is given by J and M and G has at most `max_rows` rows. An item is skipped,
    and `item` returns None for it, if its data are None, its impulse is not an array of its rows, or d is outside the valid range.
    """
    cdef Workspace table, numbers, integers, factors, swaps
    cdef list data
    cdef linearised_t* at
    cdef readonly Py_ssize_t n, size                    # number of impulses; length of the result of `adjoint`

    def __init__(self, list data, impulses, int32_t max_rows=0):
        cdef Py_ssize_t i, n = len(data), scratch = 1
        cdef arena_t arena = make_arena(NULL, NULL)
        cdef Data p
        cdef linearised_t* a
        cdef const double* lam
        cdef Workspace spare
        cdef list each = impulses if type(impulses) is list else None
        cdef const double[::1] flat
        cdef const int64_t[:] first, sizes
        if each is None:
            flat, first, sizes = impulses
        self.data, self.n = data, n
        self.table = allocate_bytes(n * sizeof(linearised_t))
        self.at = <linearised_t*>self.table.at
        memset(self.at, 0, n * sizeof(linearised_t))
        for i in range(n):
            p = data[i]
            a = self.at + i
            if p is None or not prepare_problem_data(p):
                continue
            a.valid, a.v = True, p.get_pointers()
            a.n = a.v.g.n if a.v.g != NULL else 6 * a.v.r.n_bodies if a.v.r != NULL else 0
            bind_linearised_arrays(a, &arena)
            scratch = max(scratch, a.v.p.n_rows + count_judge_scratch(&a.v))
        self.numbers, self.integers = allocate_arena(&arena)
        spare = allocate_bytes(scratch * sizeof(double))
        for i in range(n):
            a = self.at + i
            if not a.valid:
                continue
            p = data[i]
            bind_linearised_arrays(a, &arena)
            if each is None:
                a.valid = sizes[i] == a.v.p.n_rows
                lam = &flat[0] + first[i] if a.v.p.n_rows else NULL
            else:
                impulse = each[i]
                a.valid = impulse is not None and get_array_data(impulse, a.v.p.n_rows, &lam)
            if not a.valid:
                continue
            with nogil:
                judge_and_linearise(a, lam, p.reference_energy, p.reference_velocity, <double*>spare.at)
        arena = make_arena(NULL, NULL)
        for i in range(n):
            a = self.at + i
            if a.valid and a.v.g != NULL and a.rows <= max_rows:
                bind_derivative_factor(a, &arena)
                scratch = max(scratch, derivative_factor_scratch_size(a.rows, &a.v))
        self.factors, self.swaps = allocate_arena(&arena)
        spare = allocate_bytes(scratch * sizeof(double))
        with nogil:
            for i in range(n):
                a = self.at + i
                if a.valid and a.v.g != NULL and a.rows <= max_rows:
                    bind_derivative_factor(a, &arena)
                    factor_derivative_system(a, &a.v, 0.0, <double*>spare.at)

    def item(self, Py_ssize_t i):
        """Return item i as a `Linear`, or None if it was skipped."""
        cdef Linear item
        if not self.at[i].valid:
            return None
        item = Linear.__new__(Linear)
        item.at, item.judge, item.data = self.at[i], self.data[i], self.data[i]
        item.numbers, item.integers, item.factor, item.swap = self.numbers, self.integers, self.factors, self.swaps
        item.rows, item.tried, item.regular = item.at.rows, item.at.tried, item.at.regular
        item.relative, item.above_floor = item.at.relative, item.at.above_floor
        return item

    def skip_unsolvable(self, double max_residual):
        """Skip items without a regular factor or with a residual above max_residual; return the indices of all skipped items."""
        cdef Py_ssize_t i
        cdef linearised_t* a
        cdef list skipped = []
        self.size = 0
        for i in range(self.n):
            a = self.at + i
            a.valid = a.valid and a.tried and a.regular and a.relative <= max_residual
            a.first = self.size
            if a.valid:
                self.size += 3 * a.v.p.n_rows + a.n
            else:
                skipped.append(i)
        return skipped

    def adjoint(self, list velocities, list impulses, list slacks):
        """Return the concatenated `Linear.adjoint` of all items that are not skipped, and the indices of items that failed."""
        cdef Py_ssize_t i
        cdef list failed = []
        numbers = empty(self.size)
        cdef double* out = as_double_pointer(numbers, self.size)
        for i in range(self.n):
            if self.at[i].valid and not write_adjoint(self.at + i, velocities[i], impulses[i], slacks[i], out + self.at[i].first):
                failed.append(i)
        return numbers, failed

    def result_slice(self, Py_ssize_t i):
        """Return the slice of item i in the result of `adjoint`."""
        cdef linearised_t* a = self.at + i
        return slice(a.first, a.first + 3 * a.v.p.n_rows + a.n)

    def result_indices(self, bint velocities):
        """Return the indices of every s (sum m,), or of every f (sum n,), in the result of `adjoint`."""
        cdef Py_ssize_t i, j, k = 0
        cdef int32_t m, n
        out_ = np.empty(self.size, np.intp)
        cdef Py_ssize_t[::1] out = out_
        for i in range(self.n):
            m, n = self.at[i].v.p.n_rows, self.at[i].n
            if self.at[i].valid:
                for j in range(n if velocities else m):
                    out[k] = self.at[i].first + (2 * m if velocities else m) + j
                    k += 1
        return out_[:k]


def write_body_wrenches(Data p, const double[::1] lam, double[:, ::1] f):
    """Write J^T lam (n, 6) of bodies to f."""
    if p.blocks.n_rows and p.rows.n_bodies:
        compute_body_wrenches(&p.blocks, &p.rows, &lam[0], &f[0, 0])
    else:
        f[:, :] = 0.0
