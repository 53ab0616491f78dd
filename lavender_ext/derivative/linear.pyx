"""An answer, judged and linearised (`natural.pxd`), with a factor of its equations where these are few; for Python.

With cotangents c of lambda, x of w and y of v (equation (4) of lavender/gradient/__init__.py), of J and M or bodies

    G^T q = D^-1/2 (c + C x + J M^-1 (y + J^T x)),   s = D^-1/2 P^T q - x,   f = y - J^T s                  (1)

with C the compliance, and of a matrix

    G^T q = D^-1/2 (c + A^T x),   s = D^-1/2 P^T q - x                                                      (2)
"""
from cpython.buffer cimport (PyBUF_C_CONTIGUOUS, PyBUF_FORMAT, PyBUF_WRITABLE, PyBuffer_Release,
                             PyObject_GetBuffer)
from libc.math cimport fabs
from libc.stdint cimport int8_t, int32_t, int64_t
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport ndarray as Array
from lavender_ext.core.validate cimport all_finite, first_invalid
from lavender_ext.core.generalized cimport jac_transpose_times, whitened_dot
from lavender_ext.core.block_types cimport blocks_t, is_rows
from lavender_ext.core.problem cimport Data, Workspace, allocate_workspace
from lavender_ext.core.rows cimport rows_times
from lavender_ext.core.velocity cimport rows_wrench, wrenches_to_velocity
from lavender_ext.core.view cimport generalized_t, view_t
from lavender_ext.derivative.natural cimport (CLOSED, FREE, HIGH, LOW, OPEN, SLIDES, STICKS, block_times, linear_t,
                                              natural_all, natural_t, place_rows, scaled_csr, scaled_general, system_rows)
from lavender_ext.factor.dense cimport PANEL, dense_lu, dense_lu_solve, dense_lu_solve_back
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.judge.measure cimport above_floor_of, floor_of, judge_view, relative_of, scratch_of
from lavender_ext.judge.score cimport new_score, score_t

cdef object empty = np.empty, ndarray = np.ndarray
cdef object F8 = np.dtype(np.float64), I4 = np.dtype(np.int32), I1 = np.dtype(np.int8)

cdef double SINGULAR = 1e-12    # least pivot over the largest from which on G counts as singular

#: Cases of rows by the kernels' numbers.
CASES = {"open": OPEN, "closed": CLOSED, "sticks": STICKS, "slides": SLIDES, "free": FREE, "low": LOW, "high": HIGH}


cdef void times_jac_transpose(const view_t* v, const double* lam, double* f) noexcept nogil:
    # f (n) = J^T lam
    if v.g != NULL:
        jac_transpose_times(v.g, lam, f)
    elif v.r != NULL:
        rows_wrench(&v.p, v.r, lam, f)


cdef void pull(const linear_t* a, double* f, double* out) noexcept nogil:
    # out = J M^-1 f on rows of G, of bodies on all; f (n) becomes scratch. With M = L^T D L it is Y D^-1/2 L^-T f
    cdef const generalized_t* g = a.v.g
    cdef int32_t k, q, i, b
    cdef double z
    if a.v.r != NULL:
        wrenches_to_velocity(a.v.r, f)
        rows_times(&a.v.p, a.v.r, f, out)
        return
    for k in range(g.n - 1, -1, -1):
        z = f[k]
        if z != 0.0:
            for q in range(g.lptr[k], g.lptr[k + 1]):
                f[g.lidx[q]] -= g.lval[q] * z
            f[k] = z * g.root[k]
    for b in range(g.n_panels):
        for i in range(g.prow[b], g.prow[b + 1]):
            if a.place[i] >= 0:
                out[i] = whitened_dot(g, b, i, f)


cdef void turned(const view_t* v, const double* x, double* out) noexcept nogil:
    # out (m) = A^T x of a matrix
    cdef int32_t i, k
    for i in range(v.p.n_rows):
        for k in range(v.a.indptr[i], v.a.indptr[i + 1]):
            out[v.a.indices[k]] += v.a.data[k] * x[i]


cdef public void lav_adjoint(const linear_t* a, const double* y, const double* c, const double* x, double* q, double* s,
                             double* f) noexcept nogil:
    """(1) or (2) but for q on rows outside the factor; y (n), c (m) and x (m) may be NULL, for 0."""
    cdef const view_t* v = &a.v
    cdef int32_t i, m = v.p.n_rows
    cdef const double* soft = NULL
    if v.a == NULL:
        soft = v.g.compliance if v.g != NULL else v.r.compliance
    memset(q, 0, m * sizeof(double))
    if v.a != NULL and x != NULL:
        turned(v, x, q)
    elif y != NULL or x != NULL:
        memset(f, 0, a.n * sizeof(double))
        if x != NULL:
            times_jac_transpose(v, x, f)
        if y != NULL:
            for i in range(a.n):
                f[i] += y[i]
        pull(a, f, q)
        if x != NULL:
            for i in range(m):
                q[i] += soft[i] * x[i]
    for i in range(m):
        if a.place[i] >= 0:
            s[a.place[i]] = (q[i] + (c[i] if c != NULL else 0.0)) / a.x.root[i]
    dense_lu_solve_back(a.rows, a.lu, a.swap, s)
    for i in range(m):
        q[i] = s[a.place[i]] if a.place[i] >= 0 else 0.0
    block_times(&a.x, &v.p, a.x.p, q, True, s)
    for i in range(m):
        s[i] = s[i] / a.x.root[i] - (x[i] if x != NULL else 0.0)
    times_jac_transpose(v, s, f)
    for i in range(a.n):
        f[i] = (y[i] if y != NULL else 0.0) - f[i]


cdef bint is_plain(given, Py_ssize_t n, Py_buffer* view, const double** to):
    """Whether it is None, `to` NULL then, or an array (n,) of numbers that lie together, held by `view`."""
    to[0] = NULL
    if given is None:
        return True
    if type(given) is not ndarray:
        return False
    try:
        PyObject_GetBuffer(given, view, PyBUF_FORMAT | PyBUF_C_CONTIGUOUS)
    except ValueError:                                  # dates have no buffer
        return False
    if view.format[0] != 100 or view.format[1] != 0 or view.ndim != 1 or view.shape[0] != n:    # "d"
        return False
    if n:
        to[0] = <const double*>view.buf
    return True


cdef void form(const linear_t* a, const view_t* v, double shift, double* g, double* h) noexcept nogil:
    # G of H + shift, A of J and M or in rows; h (rows, rows + n) is scratch
    cdef int32_t i, n = a.rows
    if v.g != NULL:
        scaled_general(v.g, n, a.place, a.x.root, h + <ssize_t>n * n, h)
    else:
        scaled_csr(v.a, a.v.p.n_rows, n, a.place, a.x.root, h)
    for i in range(n):
        h[<ssize_t>i * n + i] += shift
    system_rows(&a.x, &a.v.p, n, a.place, h, g)


cdef ssize_t values_of(const blocks_t* b) noexcept nogil:
    # of P
    cdef int32_t i, n
    cdef ssize_t size = 0
    for i in range(b.n_blocks):
        n = b.ptr[i + 1] - b.ptr[i]
        size += n if is_rows(b, i) else n * n
    return size


cdef ssize_t room_of(const blocks_t* b, ssize_t values) noexcept nogil:
    # numbers that `linearise` keeps
    return 5 * <ssize_t>b.n_rows + 2 * values + (5 * <ssize_t>b.n_rows + 4 * <ssize_t>b.n_blocks + 11) // 8


cdef void linearise(linear_t* a, const double* lam, double energy, double velocity, double* at, double* scratch) noexcept nogil:
    """An impulse by the data of `a.v`; at (`room_of`), scratch (m + `scratch_of`); energy and velocity of doing nothing."""
    cdef const blocks_t* b = &a.v.p
    cdef int32_t m = b.n_rows
    cdef ssize_t values = values_of(b)
    cdef int32_t* ptr = <int32_t*>(at + 5 * m + 2 * values)
    cdef score_t s = new_score()
    if m == 0:
        a.regular = True
        return
    a.lam, a.w, a.place = at, at + m, ptr + b.n_blocks + 1
    a.x = natural_t(at + 2 * m, at + 3 * m, at + 4 * m, <int8_t*>(a.place + m), ptr, at + 5 * m, at + 5 * m + values)
    memcpy(a.lam, lam, m * sizeof(double))
    judge_view(&a.v, a.lam, a.w, scratch, scratch + m, True, &s)
    natural_all(b, a.lam, a.w, ptr, &a.x)
    a.rows = place_rows(b, &a.x, a.place)
    a.relative = relative_of(&s, a.w, m, energy, velocity)
    a.above_floor = above_floor_of(&s, a.relative, floor_of(&s, energy, velocity))


cdef ssize_t room_of_factor(int32_t n) noexcept nogil:
    # numbers that `factorise` keeps
    return <ssize_t>n * n + (n + 1) // 2


cdef ssize_t scratch_of_factor(int32_t n, const view_t* v) noexcept nogil:
    cdef ssize_t most = n + (v.g.n if v.g != NULL else 0)
    return n * (most if most > PANEL else PANEL)


cdef bint factorise(linear_t* a, const view_t* v, double shift, double* at, double* scratch) noexcept nogil:
    """G of H + shift, A of v; at (`room_of_factor`) and scratch (`scratch_of_factor`). Whether it is regular."""
    cdef int32_t i, n = a.rows
    cdef double least = 1.0 / 0.0, most = 0.0, x
    a.tried = a.regular = True
    if n == 0:
        return True
    a.lu, a.swap = at, <int32_t*>(at + <ssize_t>n * n)
    form(a, v, shift, a.lu, scratch)
    if dense_lu(has_wide(), n, a.lu, a.swap, scratch):
        for i in range(n):
            x = fabs(a.lu[<ssize_t>i * n + i])
            least = x if x < least else least
            most = x if x > most else most
    a.regular = least > SINGULAR * most and most > 0.0
    return a.regular


cdef bint is_prepared(Data p):
    # or has too many entries, or A_ii out of reach
    try:
        p.prepare()
    except OverflowError:
        return False
    return first_invalid(p.blocks.d, p.blocks.n_rows) < 0


cdef bint adjoint_into(const linear_t* a, velocity, impulse, slack, double* out):
    """`Linear.adjoint` into out (3 m + n); or not."""
    cdef int32_t m = a.v.p.n_rows, i
    cdef const double* y
    cdef const double* c
    cdef const double* x
    cdef Py_buffer views[3]
    if velocity is None and impulse is None and slack is None:
        return False
    memset(&views[0], 0, 3 * sizeof(Py_buffer))         # what holds nothing is released in vain
    try:
        if not (is_plain(velocity, a.n, &views[0], &y) and is_plain(impulse, m, &views[1], &c)
                and is_plain(slack, m, &views[2], &x)):
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
    finally:
        for i in range(3):
            PyBuffer_Release(&views[i])


cdef object copied(const void* x, Py_ssize_t n, dtype):
    """(n,) numbers that stand there."""
    made = empty(n, dtype)
    if n:
        memcpy((<Array>made).data, x, n * (<Array>made).strides[0])
    return made


cdef class Linear:
    """One of `Linears`. `solve` and `adjoint` are of the factor that was found last."""
    cdef linear_t at
    cdef Data judge, data                               # data: with the A of G
    cdef Workspace workspace, factor

    @property
    def rows(self):
        """Of G: those with a place."""
        return self.at.rows

    @property
    def tried(self):
        """Whether a factor was tried for."""
        return self.at.tried

    @property
    def regular(self):
        """Whether one was found, or nothing is to be factored."""
        return self.at.regular

    @property
    def relative(self):
        """The judge's relative residual."""
        return self.at.relative

    @property
    def above_floor(self):
        """What of it rounding does not explain."""
        return self.at.above_floor

    def prepare(self, Data data, double shift=0.0):
        """Factor G of H + shift, A of the data in rows or J and M; whether it is regular."""
        cdef view_t v = data.view()
        cdef Workspace spare = allocate_workspace(scratch_of_factor(self.at.rows, &v) * sizeof(double))
        self.data, self.factor = data, allocate_workspace(room_of_factor(self.at.rows) * sizeof(double))
        with nogil:
            factorise(&self.at, &v, shift, <double*>self.factor.at, <double*>spare.at)
        return self.at.regular

    def adjoint(self, velocity, impulse, slack):
        """(q, s (m), f (n), c (m)) of (1), end to end, of y (n,), c and x, None for 0; of (2) n is 0. With a factor.

        None where y, c or x is no such array or not finite: the long way finds the words.
        """
        cdef Py_buffer view
        cdef bint made
        out = empty(3 * self.at.v.p.n_rows + self.at.n)
        PyObject_GetBuffer(out, &view, PyBUF_WRITABLE)
        made = adjoint_into(&self.at, velocity, impulse, slack, <double*>view.buf)
        PyBuffer_Release(&view)
        return out if made else None

    @property
    def slides(self):
        """Whether some row of G is not that of H: some contact slides, or is without friction."""
        cdef int32_t i, j
        for i in range(self.at.v.p.n_blocks):
            for j in range(self.at.v.p.ptr[i], self.at.v.p.ptr[i + 1]):
                if self.at.place[j] >= 0 and self.at.x.case_[j] == SLIDES:
                    return True
        return False

    def matrix(self):
        """G (n, n) on the rows with a place."""
        out_ = np.empty((self.at.rows, self.at.rows))
        cdef double[:, ::1] out = out_
        cdef view_t v = self.data.view()
        cdef Workspace work
        if self.at.rows:
            work = allocate_workspace(scratch_of_factor(self.at.rows, &v) * sizeof(double))
            form(&self.at, &v, 0.0, &out[0, 0], <double*>work.at)
        return out_

    def solve(self, r, bint back=False):
        """x (n,) with G x = r, of the transpose with `back`."""
        out_ = r.copy()
        cdef double[::1] out = out_
        if self.at.rows and back:
            dense_lu_solve_back(self.at.rows, self.at.lu, self.at.swap, &out[0])
        elif self.at.rows:
            dense_lu_solve(self.at.rows, self.at.lu, self.at.swap, &out[0])
        return out_

    def times(self, v_, bint back=False, bint edge=False):
        """P v (m,), or with `edge` dPi/de v; `back`: of the transpose."""
        cdef const double[::1] v = v_
        out_ = np.empty(self.at.v.p.n_rows)
        cdef double[::1] out = out_
        if self.at.v.p.n_rows:
            block_times(&self.at.x, &self.at.v.p, self.at.x.edge if edge else self.at.x.p, &v[0], back, &out[0])
        return out_

    @property
    def impulse(self):
        """lambda (m,) [N s]."""
        return copied(self.at.lam, self.at.v.p.n_rows, F8)

    @property
    def slack(self):
        """w (m,) [m/s]."""
        return copied(self.at.w, self.at.v.p.n_rows, F8)

    @property
    def root(self):
        """D^1/2 (m,)."""
        return copied(self.at.x.root, self.at.v.p.n_rows, F8)

    @property
    def residual(self):
        """F (m,) of (1) of natural.pxd."""
        return copied(self.at.x.f, self.at.v.p.n_rows, F8)

    @property
    def margin(self):
        """(m,) N s: of each row to the next case."""
        return copied(self.at.x.margin, self.at.v.p.n_rows, F8)

    @property
    def p(self):
        """Values of P, block by block: the diagonal of rows, else row by row."""
        return copied(self.at.x.p, self.at.x.at[self.at.v.p.n_blocks] if self.at.v.p.n_rows else 0, F8)

    @property
    def case(self):
        """(m,) int8, by the numbers of CASES."""
        return copied(self.at.x.case_, self.at.v.p.n_rows, I1)

    @property
    def place(self):
        """(m,) row of G that each row is, -1 without one."""
        return copied(self.at.place, self.at.v.p.n_rows, I4)


cdef class Linears:
    """Many impulses (m,) [N s], judged by the data that the judge reads, their reference known, and linearised, at once.

    impulses: a list, or (all of them, where each begins, how many rows each has) of arrays. With a factor where A is of J
    and M and G has at most `most` rows. Left to the caller are data that are None, an impulse that is no array of its rows,
    A_ii out of reach: `one` is None.
    """
    cdef Workspace table, workspace, factors
    cdef list data
    cdef linear_t* at
    cdef readonly Py_ssize_t n, size                    # how many impulses; numbers of `adjoint`

    def __init__(self, list data, impulses, int32_t most=0):
        cdef Py_ssize_t i, n = len(data), size = 0, scratch = 1, more = 0
        cdef Data p
        cdef linear_t* a
        cdef const double* lam
        cdef Py_buffer held
        cdef double* to
        cdef double* work
        cdef Workspace spare
        cdef list each = impulses if type(impulses) is list else None
        cdef const double[::1] flat
        cdef const int64_t[:] first, sizes
        if each is None:
            flat, first, sizes = impulses
        self.data, self.n = data, n
        self.table = allocate_workspace(n * sizeof(linear_t))
        self.at = <linear_t*>self.table.at
        memset(self.at, 0, n * sizeof(linear_t))
        for i in range(n):
            p = data[i]
            a = self.at + i
            if p is None or not is_prepared(p):
                continue
            a.known, a.v = True, p.view()
            a.n = a.v.g.n if a.v.g != NULL else 6 * a.v.r.n_bodies if a.v.r != NULL else 0
            size += room_of(&a.v.p, values_of(&a.v.p))
            scratch = max(scratch, a.v.p.n_rows + scratch_of(&a.v))
        self.workspace, spare = allocate_workspace(size * sizeof(double)), allocate_workspace(scratch * sizeof(double))
        to = <double*>self.workspace.at
        for i in range(n):
            a = self.at + i
            if not a.known:
                continue
            p = data[i]
            memset(&held, 0, sizeof(Py_buffer))
            try:
                if each is None:
                    a.known = sizes[i] == a.v.p.n_rows
                    lam = &flat[0] + first[i] if a.v.p.n_rows else NULL
                else:
                    a.known = each[i] is not None and is_plain(each[i], a.v.p.n_rows, &held, &lam)
                if not a.known:
                    continue
                with nogil:
                    linearise(a, lam, p.reference_energy, p.reference_velocity, to, <double*>spare.at)
            finally:
                PyBuffer_Release(&held)
            to += room_of(&a.v.p, values_of(&a.v.p))
            if a.v.g != NULL and a.rows <= most:
                more += room_of_factor(a.rows)
                scratch = max(scratch, scratch_of_factor(a.rows, &a.v))
        self.factors, spare = allocate_workspace(more * sizeof(double)), allocate_workspace(scratch * sizeof(double))
        to, work = <double*>self.factors.at, <double*>spare.at
        with nogil:
            for i in range(n):
                a = self.at + i
                if a.known and a.v.g != NULL and a.rows <= most:
                    factorise(a, &a.v, 0.0, to, work)
                    to += room_of_factor(a.rows)

    def one(self, Py_ssize_t i):
        """The `Linear` of one of them, or None."""
        cdef Linear made
        if not self.at[i].known:
            return None
        made = Linear.__new__(Linear)
        made.at, made.judge, made.data = self.at[i], self.data[i], self.data[i]
        made.workspace, made.factor = self.workspace, self.factors
        return made

    def leave(self, double accepted):
        """Leave also those without a regular factor, and with a residual above `accepted`: a list of all that are left."""
        cdef Py_ssize_t i
        cdef linear_t* a
        cdef list left = []
        self.size = 0
        for i in range(self.n):
            a = self.at + i
            a.known = a.known and a.tried and a.regular and a.relative <= accepted
            a.first = self.size
            if a.known:
                self.size += 3 * a.v.p.n_rows + a.n
            else:
                left.append(i)
        return left

    def adjoint(self, list velocities, list impulses, list slacks):
        """`Linear.adjoint` of all that are not left, end to end; and a list of those that it had to leave."""
        cdef Py_ssize_t i
        cdef Py_buffer view
        cdef list left = []
        numbers = empty(self.size)
        PyObject_GetBuffer(numbers, &view, PyBUF_WRITABLE)
        for i in range(self.n):
            if self.at[i].known and not adjoint_into(self.at + i, velocities[i], impulses[i], slacks[i],
                                                     <double*>view.buf + self.at[i].first):
                left.append(i)
        PyBuffer_Release(&view)
        return numbers, left

    def place(self, Py_ssize_t i):
        """The slice of one of them in what `adjoint` finds."""
        cdef linear_t* a = self.at + i
        return slice(a.first, a.first + 3 * a.v.p.n_rows + a.n)

    def places(self, bint velocities):
        """The places there of every s (sum m,), or of every f (sum n,)."""
        cdef Py_ssize_t i, j, k = 0
        cdef int32_t m, n
        out_ = np.empty(self.size, np.intp)
        cdef Py_ssize_t[::1] out = out_
        for i in range(self.n):
            m, n = self.at[i].v.p.n_rows, self.at[i].n
            if self.at[i].known:
                for j in range(n if velocities else m):
                    out[k] = self.at[i].first + (2 * m if velocities else m) + j
                    k += 1
        return out_[:k]


def wrench(Data p, const double[::1] lam, double[:, ::1] f):
    """f (n, 6) = J^T lam of bodies."""
    if p.blocks.n_rows and p.rows.n_bodies:
        rows_wrench(&p.blocks, &p.rows, &lam[0], &f[0, 0])
    else:
        f[:, :] = 0.0
