"""An answer, judged and linearised (`natural.pxd`), with a factor of its equations where these are few; for Python.

With cotangents c of lambda, x of w and y of v (equation (4) of lavender/gradient/__init__.py), of J and M or bodies

    G^T q = D^-1/2 (c + C x + J M^-1 (y + J^T x)),   s = D^-1/2 P^T q - x,   f = y - J^T s,   p = M^-1 f    (1)

with C the compliance, and of a matrix

    G^T q = D^-1/2 (c + A^T x),   s = D^-1/2 P^T q - x                                                      (2)
"""
from cpython.buffer cimport (PyBUF_C_CONTIGUOUS, PyBUF_FORMAT, PyBUF_WRITABLE, PyBuffer_Release,
                             PyObject_GetBuffer)
from libc.math cimport fabs
from libc.stdint cimport int8_t, int32_t
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.generalized cimport jac_push, jac_row, tree_solve
from lavender_ext.core.parts cimport blocks_t, is_rows
from lavender_ext.core.problem cimport Data, Room, room_for
from lavender_ext.core.rows cimport rows_times
from lavender_ext.core.velocity cimport rows_wrench, wrenches_to_velocity
from lavender_ext.core.view cimport view_t
from lavender_ext.derivative.natural cimport (CLOSED, FREE, HIGH, LOW, OPEN, SLIDES, STICKS, block_times, natural_all,
                                              natural_t, place_rows, scaled_csr, scaled_general, system_rows)
from lavender_ext.factor.dense cimport PANEL, dense_lu, dense_lu_solve, dense_lu_solve_back
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.judge.measure cimport judge_view, relative_of, scratch_of
from lavender_ext.judge.score cimport relative, score_t

cdef object empty = np.empty, ndarray = np.ndarray

cdef double SINGULAR = 1e-12    # least pivot over the largest from which on G counts as singular

#: Cases of rows by the kernels' numbers.
CASES = {"open": OPEN, "closed": CLOSED, "sticks": STICKS, "slides": SLIDES, "free": FREE, "low": LOW, "high": HIGH}


cdef void push(const view_t* v, const double* lam, double* f) noexcept nogil:
    # f (n) = J^T lam
    if v.g != NULL:
        jac_push(v.g, lam, f)
    elif v.r != NULL:
        rows_wrench(&v.p, v.r, lam, f)


cdef void through_mass(const view_t* v, int32_t n, const double* f, double* p) noexcept nogil:
    # p (n) = M^-1 f
    memcpy(p, f, n * sizeof(double))
    if v.g != NULL:
        tree_solve(v.g, p)
    elif v.r != NULL:
        wrenches_to_velocity(v.r, p)


cdef void turned(const view_t* v, const double* x, double* out) noexcept nogil:
    # out (m) = A^T x of a matrix
    cdef int32_t i, k
    memset(out, 0, v.p.n_rows * sizeof(double))
    for i in range(v.p.n_rows):
        for k in range(v.a.indptr[i], v.a.indptr[i + 1]):
            out[v.a.indices[k]] += v.a.data[k] * x[i]


cdef public void lav_adjoint(const view_t* v, const natural_t* a, int32_t rows, const int32_t* place, const double* lu,
                             const int32_t* swap, int32_t n, const double* y, const double* c, const double* x,
                             double* q, double* s, double* f, double* p) noexcept nogil:
    """(1) or (2) but for q on rows outside the factor; y (n), c (m) and x (m) may be NULL, for 0."""
    cdef int32_t i, m = v.p.n_rows
    cdef const double* soft = NULL
    if v.a == NULL and v.g != NULL:
        soft = v.g.compliance
    elif v.a == NULL:
        soft = v.r.compliance
    memset(q, 0, m * sizeof(double))
    if v.a != NULL and x != NULL:
        turned(v, x, q)
    elif y != NULL or x != NULL:
        memset(f, 0, n * sizeof(double))
        if x != NULL:
            push(v, x, f)
        if y != NULL:
            for i in range(n):
                f[i] += y[i]
        through_mass(v, n, f, p)
        if v.r != NULL:
            rows_times(&v.p, v.r, p, q)
        else:
            for i in range(m):
                q[i] = jac_row(v.g, i, p)
        if x != NULL:
            for i in range(m):
                q[i] += soft[i] * x[i]
    for i in range(m):
        if place[i] >= 0:
            s[place[i]] = (q[i] + (c[i] if c != NULL else 0.0)) / a.root[i]
    dense_lu_solve_back(rows, lu, swap, s)
    for i in range(m):
        q[i] = s[place[i]] if place[i] >= 0 else 0.0
    block_times(a, &v.p, a.p, q, True, s)
    for i in range(m):
        s[i] = s[i] / a.root[i] - (x[i] if x != NULL else 0.0)
    push(v, s, f)
    for i in range(n):
        f[i] = (y[i] if y != NULL else 0.0) - f[i]
    through_mass(v, n, f, p)


cdef bint is_plain(given, Py_ssize_t n, Py_buffer* view, const double** to):
    """Whether it is None, `to` NULL then, or an array (n,) of finite numbers that lie together, held by `view`."""
    cdef double nought = 0.0                            # or becomes NaN
    cdef Py_ssize_t i
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
    for i in range(n):
        nought += 0.0 * to[0][i]
    return nought == 0.0


cdef class Linear:
    """An impulse (m,) [N s], judged by the data that the judge reads, and linearised.

    `impulse` is kept as it is. The judge's reference must be known to the data. `solve` and `adjoint` are of the factor
    that `prepare` found.
    """
    cdef blocks_t b
    cdef natural_t x
    cdef Data judge, data
    cdef Room room, factor
    cdef double* w
    cdef double* e
    cdef double* lu
    cdef int32_t* place_
    cdef int32_t* swap
    cdef readonly object impulse
    cdef readonly int rows                              # of G: those with a place
    cdef readonly bint regular
    cdef readonly double relative, floor                # of the judge

    def __init__(self, Data judge, impulse):
        cdef const double[::1] lam = impulse
        cdef int32_t m = judge.blocks.n_rows, k = judge.blocks.n_blocks, i, n, size = 0
        cdef view_t v = judge.view()
        cdef score_t s = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
        cdef double* at
        cdef double* scratch
        cdef int32_t* ptr
        self.judge, self.impulse, self.b = judge, impulse, judge.blocks
        if m == 0:
            self.regular = True
            return
        for i in range(k):
            n = self.b.ptr[i + 1] - self.b.ptr[i]
            size += n if is_rows(&self.b, i) else n * n
        self.room = room_for((5 * <Py_ssize_t>m + 2 * size) * sizeof(double) + (m + k + 1) * sizeof(int32_t) + m)
        at = <double*>self.room.at
        self.w, self.e = at, at + m
        ptr = <int32_t*>(at + 5 * m + 2 * size)
        self.place_ = ptr + k + 1
        self.x = natural_t(at + 2 * m, at + 3 * m, at + 4 * m, <int8_t*>(ptr + k + 1 + m), ptr, at + 5 * m,
                           at + 5 * m + size)
        scratch_room = room_for(scratch_of(&v) * sizeof(double))
        scratch = <double*>(<Room>scratch_room).at
        with nogil:
            judge_view(&v, &lam[0], self.w, self.e, scratch, True, &s)
            natural_all(&self.b, &lam[0], self.w, ptr, &self.x)
            self.rows = place_rows(&self.b, &self.x, self.place_)
        self.relative = relative_of(&s, self.w, m, judge.start_energy, judge.start_velocity)
        self.floor = relative(s.floor_energy, s.floor_velocity, judge.start_energy, judge.start_velocity)

    def prepare(self, Data data, double shift=0.0):
        """Factor G of H + shift, A of the data in rows or J and M; whether there is a factor."""
        cdef int32_t i, n = self.rows
        cdef double least = 1.0 / 0.0, most = 0.0, x
        cdef Room room
        self.data = data
        if n == 0:
            self.regular = True
            return True
        self.factor = room_for((<Py_ssize_t>n * n) * sizeof(double) + n * sizeof(int32_t))
        room = room_for(<Py_ssize_t>n * PANEL * sizeof(double))
        self.lu = <double*>self.factor.at
        self.swap = <int32_t*>(self.lu + <Py_ssize_t>n * n)
        self.form(self.lu, shift)
        with nogil:
            if dense_lu(has_wide(), n, self.lu, self.swap, <double*>room.at):
                for i in range(n):
                    x = fabs(self.lu[<Py_ssize_t>i * n + i])
                    least = x if x < least else least
                    most = x if x > most else most
        self.regular = least > SINGULAR * most and most > 0.0
        return self.regular

    @property
    def slides(self):
        """Whether some row of G is not that of H: some contact slides, or is without friction."""
        cdef int32_t i, j
        for i in range(self.b.n_blocks):
            for j in range(self.b.ptr[i], self.b.ptr[i + 1]):
                if self.place_[j] >= 0 and self.x.case_[j] == SLIDES:
                    return True
        return False

    cdef void form(self, double* g, double shift):
        cdef int32_t n = self.rows, i
        cdef Room room = room_for(<Py_ssize_t>n * (n + self.data.general.n) * sizeof(double))
        cdef double* h = <double*>room.at
        with nogil:
            if self.data.is_general:
                scaled_general(&self.data.general, n, self.place_, self.x.root, h + <Py_ssize_t>n * n, h)
            else:
                scaled_csr(&self.data.csr, self.b.n_rows, n, self.place_, self.x.root, h)
            for i in range(n):
                h[<Py_ssize_t>i * n + i] += shift
            system_rows(&self.x, &self.b, n, self.place_, h, g)

    def matrix(self):
        """G (n, n) on the rows with a place."""
        out_ = np.empty((self.rows, self.rows))
        cdef double[:, ::1] out = out_
        if self.rows:
            self.form(&out[0, 0], 0.0)
        return out_

    def solve(self, r, bint back=False):
        """x (n,) with G x = r, of the transpose with `back`."""
        out_ = r.copy()
        cdef double[::1] out = out_
        if self.rows and back:
            dense_lu_solve_back(self.rows, self.lu, self.swap, &out[0])
        elif self.rows:
            dense_lu_solve(self.rows, self.lu, self.swap, &out[0])
        return out_

    def adjoint(self, velocity, impulse, slack):
        """(q, s (m), f, p (n), c (m)) of (1), end to end, of y (n,), c and x, None for 0; of (2) n is 0. With a factor.

        None where y, c or x is no such array or not finite: the long way finds the words.
        """
        cdef view_t v = self.judge.view()
        cdef int32_t m = self.b.n_rows, n = v.g.n if v.g != NULL else 6 * v.r.n_bodies if v.r != NULL else 0
        cdef const double* given[3]                     # y, c, x
        cdef Py_buffer views[4]
        cdef double* out
        cdef int i
        memset(&views[0], 0, 4 * sizeof(Py_buffer))     # what holds nothing is released in vain
        for i in range(3):
            given[i] = NULL
        try:
            if not (is_plain(velocity, n, &views[0], &given[0]) and is_plain(impulse, m, &views[1], &given[1])
                    and is_plain(slack, m, &views[2], &given[2])):
                return None
            made = empty(3 * m + 2 * n)
            PyObject_GetBuffer(made, &views[3], PyBUF_WRITABLE)
            out = <double*>views[3].buf
            with nogil:
                lav_adjoint(&v, &self.x, self.rows, self.place_, self.lu, self.swap, n, given[0], given[1], given[2],
                            out, out + m, out + 2 * m, out + 2 * m + n)
                if given[1] != NULL:
                    memcpy(out + 2 * (m + n), given[1], m * sizeof(double))
                else:
                    memset(out + 2 * (m + n), 0, m * sizeof(double))
            return made
        finally:
            for i in range(4):
                PyBuffer_Release(&views[i])

    def times(self, v_, bint back=False, bint edge=False):
        """P v (m,), or with `edge` dPi/de v; `back`: of the transpose."""
        cdef const double[::1] v = v_
        out_ = np.empty(self.b.n_rows)
        cdef double[::1] out = out_
        if self.b.n_rows:
            block_times(&self.x, &self.b, self.x.edge if edge else self.x.p, &v[0], back, &out[0])
        return out_

    cdef object numbers(self, const double* x):
        cdef int32_t m = self.b.n_rows
        out_ = np.empty(m)
        cdef double[::1] out = out_
        if m:
            memcpy(&out[0], x, m * sizeof(double))
        return out_

    @property
    def slack(self):
        """w (m,) [m/s]."""
        return self.numbers(self.w)

    @property
    def root(self):
        """D^1/2 (m,)."""
        return self.numbers(self.x.root)

    @property
    def residual(self):
        """F (m,) of (1) of natural.pxd."""
        return self.numbers(self.x.f)

    @property
    def margin(self):
        """(m,) N s: of each row to the next case."""
        return self.numbers(self.x.margin)

    @property
    def p(self):
        """Values of P, block by block: the diagonal of rows, else row by row."""
        cdef int32_t n = self.x.at[self.b.n_blocks] if self.b.n_rows else 0
        out_ = np.empty(n)
        cdef double[::1] out = out_
        if n:
            memcpy(&out[0], self.x.p, n * sizeof(double))
        return out_

    @property
    def case(self):
        """(m,) int8, by the numbers of CASES."""
        cdef int32_t i
        out_ = np.empty(self.b.n_rows, np.int8)
        cdef int8_t[::1] out = out_
        for i in range(self.b.n_rows):
            out[i] = self.x.case_[i]
        return out_

    @property
    def place(self):
        """(m,) row of G that each row is, -1 without one."""
        cdef int32_t i
        out_ = np.empty(self.b.n_rows, np.int32)
        cdef int32_t[::1] out = out_
        for i in range(self.b.n_rows):
            out[i] = self.place_[i]
        return out_


def wrench(Data p, const double[::1] lam, double[:, ::1] f):
    """f (n, 6) = J^T lam of bodies."""
    if p.blocks.n_rows and p.rows.n_bodies:
        rows_wrench(&p.blocks, &p.rows, &lam[0], &f[0, 0])
    else:
        f[:, :] = 0.0
