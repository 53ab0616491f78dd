"""Rows of convex programs: assembly, scaling, the forms that backends receive, and the equations of a Newton step.

    min 1/2 x.P x + q.x   subject to   (J x)_i = t_i for i < free,   (J x)_i >= t_i for the other rows

P (both triangles) and J are compressed rows with ascending columns; `variable` (m,) is the variable of a row that is a bound,
x_j >= t_i or -x_j >= t_i, and -1 for other rows. A backend receives A x = b (equations), G x <= h (the other general rows,
with signs reversed) and lb <= x <= ub; with `bounds_as_rows`, bounds are rows of A and G. Rows of A and G keep their order.
"""
from libc.math cimport INFINITY, fabs, isfinite
from libc.stdint cimport int32_t
from libc.string cimport memset

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer
from lavender_ext.core.problem cimport Workspace, allocate_bytes
from lavender_ext.program.error cimport csr_t, read_csr

#: A right-hand side or bound of this size or larger counts as infinite, as in other packages.
INFINITE = 1e20
cdef double INFINITE_SIDE = INFINITE
cdef double MAX_CROSSING = 1e-12    # Bounds that cross by less than this multiple of their size count as equal.


# -- assembly ----------------------------------------------------------------------------------------

cdef Py_ssize_t append_rows(const csr_t* a, const double* rhs, double sign, double limit, int32_t* ptr, int32_t* idx, double* val,
                            double* t, Py_ssize_t m) noexcept nogil:
    """Append the rows with rhs < limit, with right-hand sides times `sign`, and return the number of rows m.

    A row with rhs = -inf, which no x satisfies, becomes 0 >= 1.
    """
    cdef Py_ssize_t i, k, at = ptr[m]
    for i in range(a.m):
        if rhs[i] >= limit:
            continue
        t[m] = sign * rhs[i] if rhs[i] > -INFINITY else 1.0
        if rhs[i] > -INFINITY:
            for k in range(a.ptr[i], a.ptr[i + 1]):
                idx[at], val[at] = a.idx[k], a.val[k]
                at += 1
        m += 1
        ptr[m] = <int32_t>at
    return m


def stack_program(int32_t n, a_, b_, g_, h_, lb_, ub_):
    """Stack J = [A; I_f; -G; I_l; -I_u] with its right-hand sides; f are variables with lb = ub, l and u other bounds.

    a_ and g_ are the compressed rows of A and -G, or None; rows with h >= INFINITE are left out.

    Returns
    -------
    jac, target, variable
    n_fixed, n_kept : int
        Numbers of rows of I_f and of G.
    bad : int
        The first variable with lb = inf, ub = -inf or NaN, else -1.
    """
    cdef csr_t a, g
    a.m = g.m = 0
    cdef const double* b = NULL
    cdef const double* h = NULL
    cdef Py_ssize_t i, m = 0, at = 0, entries = 0, n_fixed = 0, n_kept = 0
    cdef int side
    if a_ is not None:
        a, b = read_csr(a_, len(b_), n), as_double_pointer(b_, len(b_))
        entries += a.ptr[a.m]
    if g_ is not None:
        g, h = read_csr(g_, len(h_), n), as_double_pointer(h_, len(h_))
        entries += g.ptr[g.m]
    cdef const double* lb = NULL if lb_ is None else as_double_pointer(lb_, n)
    cdef const double* ub = NULL if lb_ is None else as_double_pointer(ub_, n)
    cdef Workspace workspace = allocate_bytes(3 * n + 1)
    cdef char* has = <char*>workspace.at                # (3, n) whether a variable has a row of I_f, I_l, I_u
    cdef double excess
    memset(has, 0, 3 * n)
    for i in range(n if lb_ is not None else 0):
        if not (lb[i] < INFINITY and ub[i] > -INFINITY):
            return None, None, None, 0, 0, i
        excess = lb[i] - ub[i]
        if excess == 0.0 or (excess > 0.0 and excess <= MAX_CROSSING * max(fabs(lb[i]), fabs(ub[i]))):
            has[i] = 1
        else:
            has[n + i], has[2 * n + i] = lb[i] > -INFINITE_SIDE, ub[i] < INFINITE_SIDE
        n_fixed += has[i]
        at += has[i] + has[n + i] + has[2 * n + i]
    m = a.m + g.m + at
    entries += at
    ptr_, idx_, val_ = np.zeros(m + 1, np.int32), np.empty(entries, np.int32), np.empty(entries)
    t_, variable_ = np.empty(m), np.full(m, -1, np.int32)
    cdef int32_t* ptr = as_int_pointer(ptr_, m + 1)
    cdef int32_t* idx = as_int_pointer(idx_, entries)
    cdef double* val = as_double_pointer(val_, entries)
    cdef double* t = as_double_pointer(t_, m)
    cdef int32_t* variable = as_int_pointer(variable_, m)
    m = append_rows(&a, b, 1.0, INFINITY, ptr, idx, val, t, 0)
    for side in range(3):
        if side == 1:
            n_kept = m
            m = append_rows(&g, h, -1.0, INFINITE_SIDE, ptr, idx, val, t, m)
            n_kept = m - n_kept
        at = ptr[m]
        for i in range(n):
            if has[side * n + i]:
                idx[at], variable[m] = <int32_t>i, <int32_t>i
                val[at], t[m] = -1.0 if side == 2 else 1.0, -ub[i] if side == 2 else lb[i]
                m, at = m + 1, at + 1
                ptr[m] = <int32_t>at
    return (ptr_[:m + 1], idx_[:at], val_[:at]), t_[:m], variable_[:m], n_fixed, n_kept, -1


# -- scaling -----------------------------------------------------------------------------------------

def scale_program(hessian, q_, jac, t_, scales):
    """Return P, q, J and t of the program in the scales (D, E, sigma, c) of `equilibrate_program`.

    x = sigma D x', rows are multiplied by E, the cost by c.
    """
    cdef Py_ssize_t i, k, n = len(q_), m = len(t_)
    cdef double sigma = scales[2], c = scales[3], w
    cdef csr_t p = read_csr(hessian, n, n)
    cdef csr_t a = read_csr(jac, m, n)
    cdef const double* d = as_double_pointer(scales[0], n)
    cdef const double* e = as_double_pointer(scales[1], m)
    cdef const double* q = as_double_pointer(q_, n)
    cdef const double* t = as_double_pointer(t_, m)
    p_, a_, side_, cost_ = np.empty(p.ptr[n]), np.empty(a.ptr[m]), np.empty(m), np.empty(n)
    cdef double* pv = as_double_pointer(p_, p.ptr[n])
    cdef double* av = as_double_pointer(a_, a.ptr[m])
    cdef double* side = as_double_pointer(side_, m)
    cdef double* cost = as_double_pointer(cost_, n)
    for i in range(n):
        w = c * sigma * d[i]
        cost[i] = w * q[i]
        w *= sigma
        for k in range(p.ptr[i], p.ptr[i + 1]):
            pv[k] = p.val[k] * w * d[p.idx[k]]
    for i in range(m):
        side[i] = e[i] * t[i] / sigma
        for k in range(a.ptr[i], a.ptr[i + 1]):
            av[k] = a.val[k] * e[i] * d[a.idx[k]]
    hessian, jac = ((np.array(x[0]), np.array(x[1]), v) for x, v in ((hessian, p_), (jac, a_)))
    return hessian, cost_, jac, side_                   # The indices are copies, because backends may reject read-only arrays.


def is_below(double limit, *arrays):
    """Return whether all numbers of these arrays of float64 are below a limit in absolute value."""
    cdef const double* x
    cdef Py_ssize_t i
    for array in arrays:
        x = as_double_pointer(array, len(array))
        for i in range(len(array)):
            if not fabs(x[i]) < limit:
                return False
    return True


def compute_slacks(jac, t_, scales, x_):
    """Return J x' - t and |J||x'| + |t| (m,) of a scaled program at the unscaled point x, and the largest |x'|."""
    cdef Py_ssize_t i, k, n = len(x_), m = len(t_)
    cdef csr_t a = read_csr(jac, m, n)
    cdef const double* t = as_double_pointer(t_, m)
    cdef const double* x = as_double_pointer(x_, n)
    cdef const double* d = as_double_pointer(scales[0], n)
    cdef double inverse = 1.0 / <double>scales[2], v, top = 0.0
    slack_, terms_ = np.empty(m), np.empty(m)
    cdef double* slack = as_double_pointer(slack_, m)
    cdef double* terms = as_double_pointer(terms_, m)
    for i in range(n):
        top = max(top, fabs(x[i] / d[i]) * inverse)
    for i in range(m):
        slack[i], terms[i] = -t[i], fabs(t[i])
        for k in range(a.ptr[i], a.ptr[i + 1]):
            v = a.val[k] * (x[a.idx[k]] / d[a.idx[k]] * inverse)
            slack[i] += v
            terms[i] += fabs(v)
    return slack_, terms_, top


# -- forms of backends -------------------------------------------------------------------------------

cdef struct row_t:
    # Rows of a program in turn, as a backend receives them. The arrays are the caller's.
    csr_t a
    const int32_t* variable
    const unsigned char* kept   # (m) rows that count, or NULL
    int32_t free
    bint bounds_as_rows
    Py_ssize_t i                # row
    Py_ssize_t n_a, n_g         # numbers of rows of A and of G up to this one
    bint is_equation, is_general
    int32_t bound               # variable of a bound, else -1
    double sign                 # coefficient of a bound


cdef row_t start_rows(jac, variable_, kept, Py_ssize_t n, int32_t free, bint bounds_as_rows=False) except *:
    """Return the iterator before the first row; `kept` (m,) bool, or None, has the rows that count."""
    cdef row_t r
    cdef Py_ssize_t m = len(variable_)
    cdef const unsigned char[::1] mask
    r.a, r.variable, r.kept = read_csr(jac, m, n), as_int_pointer(variable_, m), NULL
    if kept is not None and m:
        mask = kept.view(np.uint8)
        r.kept = &mask[0]
    r.free, r.bounds_as_rows = free, bounds_as_rows
    r.i, r.n_a, r.n_g = -1, 0, 0
    return r


cdef bint advance(row_t* r) noexcept nogil:
    """Go to the next row that counts; return whether there is one."""
    r.i += 1
    while r.i < r.a.m and r.kept != NULL and not r.kept[r.i]:
        r.i += 1
    if r.i == r.a.m:
        return False
    r.is_equation, r.bound = r.i < r.free, r.variable[r.i]
    r.is_general = r.bound < 0 or r.bounds_as_rows
    if r.bound >= 0:
        r.sign = r.a.val[r.a.ptr[r.i]]
    if r.is_general and r.is_equation:
        r.n_a += 1
    elif r.is_general:
        r.n_g += 1
    return True


def split_rows(jac, t_, variable, kept, Py_ssize_t n, int32_t free, bint bounds_as_rows=False):
    """Return the rows of A and of G, and lb and ub (n,), None without bounds.

    kept : (m,) bool, or None
        Rows that count.
    """
    cdef row_t r = start_rows(jac, variable, kept, n, free, bounds_as_rows)
    cdef const double* t = as_double_pointer(t_, r.a.m)
    a_, g_, low_, high_ = np.empty(r.a.m, np.int32), np.empty(r.a.m, np.int32), None, None
    cdef int32_t* equations = as_int_pointer(a_, r.a.m)
    cdef int32_t* inequalities = as_int_pointer(g_, r.a.m)
    cdef double* low = NULL
    cdef double* high = NULL
    while advance(&r):
        if r.is_general and r.is_equation:
            equations[r.n_a - 1] = <int32_t>r.i
        elif r.is_general:
            inequalities[r.n_g - 1] = <int32_t>r.i
        else:
            if low == NULL:
                low_, high_ = np.full(n, -np.inf), np.full(n, np.inf)
                low, high = as_double_pointer(low_, n), as_double_pointer(high_, n)
            if r.sign > 0.0 or r.is_equation:
                low[r.bound] = t[r.i] / r.sign
            if r.sign < 0.0 or r.is_equation:
                high[r.bound] = t[r.i] / r.sign
    return a_[:r.n_a], g_[:r.n_g], low_, high_


def join_multipliers(jac, variable, kept, Py_ssize_t n, int32_t free, y_, z_, box_, bint bounds_as_rows=False):
    """Return lambda (m,) of multipliers with the signs of qpsolvers, P x + q + A^T y + G^T z + box = 0.

    Missing multipliers (None, or too few) count as 0. Opposite bounds have one multiplier.
    """
    cdef row_t r = start_rows(jac, variable, kept, n, free, bounds_as_rows)
    y_, z_ = (np.zeros(0) if v is None else np.ascontiguousarray(v, float).ravel() for v in (y_, z_))
    cdef bint has_box = box_ is not None and np.size(box_) == n
    box_ = np.array(box_, float).ravel() if has_box else np.zeros(n)
    lam_ = np.zeros(r.a.m)
    cdef Py_ssize_t n_y = len(y_), n_z = len(z_)
    cdef const double* y = as_double_pointer(y_, n_y)
    cdef const double* z = as_double_pointer(z_, n_z)
    cdef double* box = as_double_pointer(box_, n)
    cdef double* lam = as_double_pointer(lam_, r.a.m)
    while advance(&r):
        if r.is_general and r.is_equation:
            lam[r.i] = -y[r.n_a - 1] if r.n_a <= n_y else 0.0
        elif r.is_general:
            lam[r.i] = z[r.n_g - 1] if r.n_g <= n_z else 0.0
            if r.bound >= 0:
                box[r.bound] += -lam[r.i] if r.sign > 0.0 else lam[r.i]
    r.i = -1
    while advance(&r):
        if r.bound >= 0 and not r.is_equation:
            lam[r.i] = max(-box[r.bound] if r.sign > 0.0 else box[r.bound], 0.0)
        elif not r.is_general:
            lam[r.i] = -box[r.bound]
    return lam_


def split_multipliers(jac, variable, kept, Py_ssize_t n, int32_t free, lam_):
    """Return y, z and box (n,) of multipliers lambda (m,), with the signs of qpsolvers."""
    cdef row_t r = start_rows(jac, variable, kept, n, free)
    cdef const double* lam = as_double_pointer(lam_, r.a.m)
    y_, z_, box_ = np.empty(r.a.m), np.empty(r.a.m), np.zeros(n)
    cdef double* y = as_double_pointer(y_, r.a.m)
    cdef double* z = as_double_pointer(z_, r.a.m)
    cdef double* box = as_double_pointer(box_, n)
    while advance(&r):
        if not r.is_general:
            box[r.bound] += lam[r.i] if r.sign < 0.0 else -lam[r.i]
        elif r.is_equation:
            y[r.n_a - 1] = -lam[r.i]
        else:
            z[r.n_g - 1] = lam[r.i]
    return y_[:r.n_a], z_[:r.n_g], box_


def make_dense(rows, Py_ssize_t n, selected_=None, double sign=1.0):
    """Return the selected compressed rows of n columns (default: all) times a sign as a new dense matrix."""
    cdef Py_ssize_t i, k, r, count = len(rows[0]) - 1
    cdef csr_t a = read_csr(rows, count, n)
    cdef const int32_t* selected = NULL
    if selected_ is not None:
        count = len(selected_)
        selected = as_int_pointer(selected_, count)
    matrix = np.zeros((count, n))
    cdef double* out = as_double_pointer(matrix, count * n)
    for i in range(count):
        r = i if selected == NULL else selected[i]
        for k in range(a.ptr[r], a.ptr[r + 1]):
            out[i * n + a.idx[k]] = sign * a.val[k]
    return matrix


def make_columns(rows, Py_ssize_t n, selected_=None, double sign=1.0, bint upper=False):
    """Return the selected rows (default: all) times a sign as compressed columns (data, indices, indptr).

    upper : bool
        Leave out the entries below the diagonal.
    """
    cdef Py_ssize_t i, k, r, at, count = len(rows[0]) - 1
    cdef csr_t a = read_csr(rows, count, n)
    cdef const int32_t* selected = NULL
    if selected_ is not None:
        count = len(selected_)
        selected = as_int_pointer(selected_, count)
    ptr_ = np.zeros(n + 2, np.int32)
    cdef int32_t* ptr = as_int_pointer(ptr_, n + 2)     # One extra entry: filling moves each pointer to the end of its column.
    for i in range(count):
        r = i if selected == NULL else selected[i]
        for k in range(a.ptr[r], a.ptr[r + 1]):
            if not upper or a.idx[k] >= r:
                ptr[a.idx[k] + 2] += 1
    for i in range(n):
        ptr[i + 2] += ptr[i + 1]
    idx_, val_ = np.empty(ptr[n + 1], np.int32), np.empty(ptr[n + 1])
    cdef int32_t* idx = as_int_pointer(idx_, ptr[n + 1])
    cdef double* val = as_double_pointer(val_, ptr[n + 1])
    for i in range(count):
        r = i if selected == NULL else selected[i]
        for k in range(a.ptr[r], a.ptr[r + 1]):
            if not upper or a.idx[k] >= r:
                at = ptr[a.idx[k] + 1]
                idx[at], val[at], ptr[a.idx[k] + 1] = <int32_t>i, sign * a.val[k], <int32_t>(at + 1)
    return val_, idx_, ptr_[:n + 1]


# -- Newton step -------------------------------------------------------------------------------------

cdef class NewtonStep:
    """Equations of one Newton step on active rows, in scaled units; variables at active bounds are eliminated.

        [ w P   J_a^T ] [ dx        ]   [ -w (P x + q - J_a^T lambda) ]
        [ J_a   0     ] [ -w dlambda ] = [ t_a - J_a x                 ]

    w makes the largest entry of w P equal to 1. The arrays are those of the scaled program; x and lambda those of the program.
    """
    cdef csr_t p, a
    cdef const double* q
    cdef const double* t
    cdef const double* d
    cdef const double* e
    cdef double sigma, c, weight
    cdef Py_ssize_t n_free, n_rows
    cdef double* x              # (n)
    cdef double* lam            # (m)
    cdef double* gradient       # (n) P x + q - J^T lambda
    cdef int32_t* free          # (n) free variables
    cdef int32_t* rows          # (m) active general rows
    cdef int32_t* place         # (n) position of a variable among the free ones, or -1
    cdef int32_t* bound         # (n) active bound of a variable, or -1
    cdef Workspace numbers, marks
    cdef object owned

    def __init__(self, hessian, q, jac, t, variable_, scales, active_, x_, lam_):
        cdef Py_ssize_t i, j, n = len(q), m = len(t)
        cdef const int32_t* variable = as_int_pointer(variable_, m)
        cdef const unsigned char[::1] active = active_.view(np.uint8)
        cdef const double* x = as_double_pointer(x_, n)
        cdef const double* lam = as_double_pointer(lam_, m)
        cdef double largest = 0.0
        self.owned = hessian, q, jac, t, scales
        self.p, self.a = read_csr(hessian, n, n), read_csr(jac, m, n)
        self.q, self.t = as_double_pointer(q, n), as_double_pointer(t, m)
        self.d, self.e = as_double_pointer(scales[0], n), as_double_pointer(scales[1], m)
        self.sigma, self.c = scales[2], scales[3]
        self.numbers, self.marks = allocate_bytes((2 * n + m) * sizeof(double)), allocate_bytes((3 * n + m) * sizeof(int32_t))
        self.x = <double*>self.numbers.at
        self.lam, self.gradient = self.x + n, self.x + n + m
        self.free = <int32_t*>self.marks.at
        self.rows, self.place, self.bound = self.free + n, self.free + n + m, self.free + 2 * n + m
        for i in range(self.p.ptr[n]):
            largest = max(largest, fabs(self.p.val[i]))
        self.weight = 1.0 / largest if 0.0 < largest < INFINITY else 1.0
        for j in range(n):
            self.x[j], self.place[j], self.bound[j] = x[j] / (self.sigma * self.d[j]), -1, -1
        for i in range(m):
            self.lam[i] = 0.0
            if not active[i]:
                continue
            j = variable[i]
            if j < 0:
                self.lam[i] = lam[i] * (self.c * self.sigma) / self.e[i]
                self.rows[self.n_rows], self.n_rows = <int32_t>i, self.n_rows + 1
            elif self.bound[j] < 0:
                self.bound[j], self.x[j] = <int32_t>i, self.t[i] / self.a.val[self.a.ptr[i]]
        for j in range(n):
            if self.bound[j] < 0:
                self.place[j], self.free[self.n_free], self.n_free = <int32_t>self.n_free, <int32_t>j, self.n_free + 1

    @property
    def size(self):
        """Return the number of equations."""
        return self.n_free + self.n_rows

    def count_entries(self):
        """Return the number of entries of the matrix."""
        cdef Py_ssize_t i, k, count = 0
        for i in range(self.n_free):
            for k in range(self.p.ptr[self.free[i]], self.p.ptr[self.free[i] + 1]):
                count += self.place[self.p.idx[k]] >= 0
        for i in range(self.n_rows):
            for k in range(self.a.ptr[self.rows[i]], self.a.ptr[self.rows[i] + 1]):
                count += 2 * (self.place[self.a.idx[k]] >= 0)
        return count

    def make_dense(self, double shift):
        """Return the matrix of the step, in Fortran order, with +-shift on the diagonal."""
        cdef Py_ssize_t i, k, j, n = self.n_free, size = self.n_free + self.n_rows
        matrix = np.zeros((size, size))
        cdef double* out = as_double_pointer(matrix, size * size)
        for i in range(n):
            for k in range(self.p.ptr[self.free[i]], self.p.ptr[self.free[i] + 1]):
                j = self.place[self.p.idx[k]]
                if j >= 0:
                    out[i * size + j] = self.weight * self.p.val[k]
            out[i * size + i] += shift
        for i in range(self.n_rows):
            for k in range(self.a.ptr[self.rows[i]], self.a.ptr[self.rows[i] + 1]):
                j = self.place[self.a.idx[k]]
                if j >= 0:
                    out[(n + i) * size + j] = out[j * size + n + i] = self.a.val[k]
            out[(n + i) * size + n + i] = -shift
        return matrix.T                                 # The matrix is symmetric.

    def make_columns(self, double shift):
        """Return the matrix of the step as compressed columns (data, indices, indptr), with +-shift on the diagonal."""
        cdef Py_ssize_t i, k, j, at = 0, n = self.n_free, size = self.n_free + self.n_rows
        ptr_ = np.zeros(size + 2, np.int32)
        cdef int32_t* ptr = as_int_pointer(ptr_, size + 2)
        cdef bint has_diagonal
        for i in range(n):
            ptr[i + 2] += 1
            for k in range(self.p.ptr[self.free[i]], self.p.ptr[self.free[i] + 1]):
                ptr[i + 2] += self.place[self.p.idx[k]] >= 0 and self.p.idx[k] != self.free[i]
        for i in range(self.n_rows):
            ptr[n + i + 2] += 1
            for k in range(self.a.ptr[self.rows[i]], self.a.ptr[self.rows[i] + 1]):
                j = self.place[self.a.idx[k]]
                if j >= 0:
                    ptr[n + i + 2] += 1
                    ptr[j + 2] += 1
        for i in range(size):
            ptr[i + 2] += ptr[i + 1]
        idx_, val_ = np.empty(ptr[size + 1], np.int32), np.empty(ptr[size + 1])
        cdef int32_t* idx = as_int_pointer(idx_, ptr[size + 1])
        cdef double* val = as_double_pointer(val_, ptr[size + 1])
        for i in range(n):
            at, has_diagonal = ptr[i + 1], False
            for k in range(self.p.ptr[self.free[i]], self.p.ptr[self.free[i] + 1]):
                j = self.place[self.p.idx[k]]
                if j > i and not has_diagonal:
                    idx[at], val[at], at, has_diagonal = <int32_t>i, shift, at + 1, True
                if j >= 0:
                    idx[at], val[at] = <int32_t>j, self.weight * self.p.val[k]
                    if j == i:
                        val[at], has_diagonal = val[at] + shift, True
                    at += 1
            if not has_diagonal:
                idx[at], val[at], at = <int32_t>i, shift, at + 1
            ptr[i + 1] = <int32_t>at
        for i in range(self.n_rows):
            at = ptr[n + i + 1]
            for k in range(self.a.ptr[self.rows[i]], self.a.ptr[self.rows[i] + 1]):
                j = self.place[self.a.idx[k]]
                if j >= 0:
                    idx[at], val[at], at = <int32_t>j, self.a.val[k], at + 1
                    idx[ptr[j + 1]], val[ptr[j + 1]], ptr[j + 1] = <int32_t>(n + i), self.a.val[k], ptr[j + 1] + 1
            idx[at], val[at], ptr[n + i + 1] = <int32_t>(n + i), -shift, <int32_t>(at + 1)
        return val_, idx_, ptr_[:size + 1]

    cdef void compute_gradient(self) noexcept:
        """Compute P x + q - J^T lambda."""
        cdef Py_ssize_t i, k
        for i in range(self.p.n):
            self.gradient[i] = self.q[i]
            for k in range(self.p.ptr[i], self.p.ptr[i + 1]):
                self.gradient[i] += self.p.val[k] * self.x[self.p.idx[k]]
        for i in range(self.n_rows):
            for k in range(self.a.ptr[self.rows[i]], self.a.ptr[self.rows[i] + 1]):
                self.gradient[self.a.idx[k]] -= self.a.val[k] * self.lam[self.rows[i]]

    def compute_residual(self):
        """Return the right-hand side of the equations at the present point."""
        cdef Py_ssize_t i, k, r
        out_ = np.empty(self.n_free + self.n_rows)
        cdef double* out = as_double_pointer(out_, self.n_free + self.n_rows)
        self.compute_gradient()
        for i in range(self.n_free):
            out[i] = -self.weight * self.gradient[self.free[i]]
        for i in range(self.n_rows):
            r = self.rows[i]
            out[self.n_free + i] = self.t[r]
            for k in range(self.a.ptr[r], self.a.ptr[r + 1]):
                out[self.n_free + i] -= self.a.val[k] * self.x[self.a.idx[k]]
        return out_

    def move(self, step_):
        """Add a solution of the equations to the point."""
        cdef Py_ssize_t i
        cdef const double* step = as_double_pointer(step_, self.n_free + self.n_rows)
        for i in range(self.n_free):
            self.x[self.free[i]] += step[i]
        for i in range(self.n_rows):
            self.lam[self.rows[i]] -= step[self.n_free + i] / self.weight

    def finish(self):
        """Return x (n,) and lambda (m,) of the program; None if x is not finite."""
        cdef Py_ssize_t i, n = self.p.n, m = self.a.m
        x_, lam_ = np.empty(n), np.empty(m)
        cdef double* x = as_double_pointer(x_, n)
        cdef double* lam = as_double_pointer(lam_, m)
        self.compute_gradient()
        for i in range(n):
            if self.bound[i] >= 0:
                self.lam[self.bound[i]] = self.gradient[i] / self.a.val[self.a.ptr[self.bound[i]]]
            x[i] = self.x[i] * (self.sigma * self.d[i])
            if not isfinite(self.x[i]):
                return None
        for i in range(m):
            lam[i] = self.lam[i] * self.e[i] / (self.c * self.sigma)
        return x_, lam_
