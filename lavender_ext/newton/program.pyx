"""A quadratic program as an interior point sees it: balanced, its linear system by entries, and the iterate between factors.

    [ P + rho   J^T          ] [  dx      ]   [ -(P x + q - J^T lambda)                ]   [ -dual             ]
    [ J        -(W + delta)  ] [ -dlambda ] = [ -(J x - target - w) - w + mu / lambda  ] = [ -primal - w + ... ]   (1)

    W = w / lambda on one-sided rows; w = W = 0 on the `free` ones, which come first

`lavender/solvers/interior_point.py` has the method, and its sources.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.csr cimport csr_dot, csr_dot_size
from lavender_ext.core.door cimport widest
from lavender_ext.core.view cimport csr_t


cdef double FLOOR = 1e-10       # of what is pushed inside,
cdef double LEAST = 1e-4        # and of w and lambda at the start
cdef double SHORT = 0.99, INSIDE = 1.0 - 1e-10  # of the way to the boundary: at first, and at most


cdef csr_t rows_of(matrix):
    """The arrays (indptr, indices, data) of a matrix, which the caller keeps; entries are looked at only if it has some."""
    cdef const int32_t[::1] indptr = matrix[0], indices = matrix[1]
    cdef const double[::1] data = matrix[2]
    cdef csr_t a
    a.indptr = &indptr[0]
    a.indices = &indices[0] if indices.shape[0] else NULL
    a.data = &data[0] if data.shape[0] else NULL
    return a


def balanced(p, j, int passes, start=None, moves=None):
    """Factors of columns (n,) and rows (m,) with which the largest entry of each in (1) comes near 1 (Ruiz 2001).

    start (n,): of columns, 1 by default; moves (n,) bool: those that are looked for, all by default.
    """
    cdef csr_t a = rows_of(p), b = rows_of(j)
    cdef int32_t i, k, q, n = <int32_t>(len(p[0]) - 1), m = <int32_t>(len(j[0]) - 1)
    columns, rows = np.ones(n) if start is None else start.copy(), np.ones(m)
    cdef const unsigned char[::1] move = np.ones(n, np.uint8) if moves is None else moves.view(np.uint8)
    cdef double[::1] column = columns, row = rows, high = np.empty(n), beside = np.empty(m)
    cdef double x
    for _ in range(passes):
        for i in range(n):
            x = 0.0
            for q in range(a.indptr[i], a.indptr[i + 1]):
                x = widest(x, a.data[q] * column[a.indices[q]])
            high[i] = x
        for i in range(m):
            x = 0.0
            for q in range(b.indptr[i], b.indptr[i + 1]):
                k = b.indices[q]
                x = widest(x, b.data[q] * column[k])
                high[k] = widest(high[k], b.data[q] * row[i])
            beside[i] = x
        for i in range(n):
            if move[i] and column[i] * high[i] > 0.0:
                column[i] /= sqrt(column[i] * high[i])
        for i in range(m):
            if row[i] * beside[i] > 0.0:
                row[i] /= sqrt(row[i] * beside[i])
    return columns, rows


def scaled(matrix, const double[::1] left, const double[::1] right):
    """left_i A_ij right_j of a matrix in compressed rows."""
    cdef csr_t a = rows_of(matrix)
    cdef int32_t i, q
    data = np.empty(len(matrix[1]))
    cdef double[::1] value = data
    for i in range(len(matrix[0]) - 1):
        for q in range(a.indptr[i], a.indptr[i + 1]):
            value[q] = left[i] * a.data[q] * right[a.indices[q]]
    return matrix[0], matrix[1], data


def entries(p, j, jt):
    """(1) by its entries, those of P's diagonal among them; all have a place on the diagonal, the last of its column above.

    Returns
    -------
    upper : (indptr, indices, data)
        The upper triangle by its columns.
    pattern : (indptr, indices)
        Both triangles.
    """
    cdef csr_t a = rows_of(p), b = rows_of(j), c = rows_of(jt)
    cdef int32_t i, q, k = 0, f = 0, n = <int32_t>(len(p[0]) - 1), m = <int32_t>(len(j[0]) - 1)
    cdef Py_ssize_t inside = len(p[1]), beside = len(j[1])
    whole_ptr, whole = np.empty(n + m + 1, np.int32), np.empty(inside + 2 * beside + m, np.int32)
    upper_ptr, upper = np.empty(n + m + 1, np.int32), np.empty((inside + n) // 2 + beside + m, np.int32)
    data = np.empty(len(upper))
    cdef int32_t[::1] wptr = whole_ptr, windex = whole, uptr = upper_ptr, uindex = upper
    cdef double[::1] value = data
    wptr[0] = uptr[0] = 0
    for i in range(n):
        for q in range(a.indptr[i], a.indptr[i + 1]):
            windex[f] = a.indices[q]
            f += 1
            if a.indices[q] <= i:
                uindex[k] = a.indices[q]
                value[k] = a.data[q]
                k += 1
        for q in range(c.indptr[i], c.indptr[i + 1]):
            windex[f] = n + c.indices[q]
            f += 1
        wptr[i + 1] = f
        uptr[i + 1] = k
    for i in range(m):
        for q in range(b.indptr[i], b.indptr[i + 1]):
            windex[f] = uindex[k] = b.indices[q]
            value[k] = b.data[q]
            f += 1
            k += 1
        windex[f] = uindex[k] = n + i
        value[k] = 0.0
        f += 1
        k += 1
        wptr[n + i + 1] = f
        uptr[n + i + 1] = k
    return (upper_ptr, upper, data), (whole_ptr, whole)


cdef class Iterate:
    """x, lambda and w, what they leave, and the right-hand side of (1).

    Parameters
    ----------
    p, j, jt : (indptr, indices, data)
        P (n, n) both triangles, J (m, n) and J^T, in sorted rows; n, m > 0.
    q, target : (n,), (m,)
    free : int

    Attributes
    ----------
    x, lam, w : (n,), (m,), (m,)
    theta : (m,)
        W of (1): 1 on one-sided rows before `begin`.
    right, rest : (n + m,)
        Of (1), before `begin` that of its start; what a solution of it leaves.
    """

    cdef readonly object x, lam, w, theta, right, rest
    cdef object kept
    cdef csr_t p, j, jt
    cdef int32_t n, m, free
    cdef double[::1] _x, _lam, _w, _theta, _right, _rest, _dual, _primal, _cross
    cdef const double[::1] q, target

    def __init__(self, p, j, jt, const double[::1] q, const double[::1] target, int free):
        cdef int32_t i
        self.kept = p, j, jt
        self.p, self.j, self.jt = rows_of(p), rows_of(j), rows_of(jt)
        self.n, self.m, self.free = <int32_t>q.shape[0], <int32_t>target.shape[0], free
        self.q, self.target = q, target
        n, m = self.n, self.m
        self._x = self.x = np.zeros(n)
        self._lam, self._w, self._theta = self.lam, self.w, self.theta = np.zeros(m), np.zeros(m), np.ones(m)
        self._right, self._rest = self.right, self.rest = np.empty(n + m), np.empty(n + m)
        self._dual, self._primal, self._cross = np.empty(n), np.empty(m), np.zeros(m)
        self._theta[:free] = 0.0
        for i in range(self.n):
            self._right[i] = -q[i]
        for i in range(self.m):
            self._right[self.n + i] = target[i]

    def left_of(self, const double[::1] u):
        """max |rest| over max |right|, with `rest` as (1) without rho and delta leaves it of (dx, -dlambda) (n + m,)."""
        cdef double size = 0.0, left = 0.0
        cdef int32_t i, n = self.n
        with nogil:
            for i in range(n):
                self._rest[i] = self._right[i] - (csr_dot(&self.p, i, &u[0]) + csr_dot(&self.jt, i, &u[n]))
            for i in range(self.m):
                self._rest[n + i] = self._right[n + i] - (csr_dot(&self.j, i, &u[0]) - self._theta[i] * u[n + i])
            for i in range(n + self.m):
                size = widest(size, self._right[i])
                left = widest(left, self._rest[i])
        return left / size if size > 0.0 else left

    def begin(self, const double[::1] u):
        """Mehrotra's start from (dx, -dlambda) (n + m,): w and lambda positive, and their products of one size."""
        cdef int32_t i
        cdef double product = 0.0, both_w = 0.0, both_z = 0.0
        for i in range(self.n):
            self._x[i] = u[i]
        for i in range(self.m):
            self._lam[i] = -u[self.n + i]
            self._w[i] = 0.0 if i < self.free else csr_dot(&self.j, i, &self._x[0]) - self.target[i]
        self._push_inside(self._w)
        self._push_inside(self._lam)
        for i in range(self.free, self.m):
            product += 0.5 * self._w[i] * self._lam[i]
            both_w += self._w[i]
            both_z += self._lam[i]
        for i in range(self.free, self.m):
            self._w[i] = max(self._w[i] + product / both_z, LEAST)
            self._lam[i] = max(self._lam[i] + product / both_w, LEAST)

    cdef _push_inside(self, double[::1] x):
        cdef double least = 0.0
        cdef int32_t i
        for i in range(self.free, self.m):
            least = min(least, x[i])
        for i in range(self.free, self.m):
            x[i] += FLOOR - 1.5 * least

    def measure(self):
        """What the iterate leaves, relative; the right-hand side of (1), and W, for a step to mu = 0.

        Returns
        -------
        rows, forces : float
            The largest of min(w, lambda) and of primal, over |J x| and |target|; of dual, over its three terms.
        gap : float
            |x.P x + q.x - target.lambda| over the largest of these.
        left : float
            The largest entry of dual and primal, or the mean of w lambda if that is more; absolute.
        proves : float
            |J^T lambda| over the largest sum of its terms: 0 where lambda proves that no x is feasible; else inf.
        """
        cdef int32_t i, n = self.n, m = self.m
        cdef double force, pull, along, sums, x
        cdef double dual = 0.0, forces = 0.0, primal = 0.0, rows = 0.0, short = 0.0, pulled = 0.0, terms = 0.0
        cdef double curved = 0.0, steep = 0.0, given = 0.0, mean = 0.0, gap
        with nogil:
            for i in range(n):
                force = csr_dot(&self.p, i, &self._x[0])
                pull = csr_dot_size(&self.jt, i, &self._lam[0], &sums)
                x = self._dual[i] = force + self.q[i] - pull
                self._right[i] = -x
                dual = widest(dual, x)
                forces = widest(widest(widest(forces, force), self.q[i]), pull)
                pulled = widest(pulled, pull)
                terms = widest(terms, sums)
                curved += self._x[i] * force
                steep += self._x[i] * self.q[i]
            for i in range(m):
                along = csr_dot(&self.j, i, &self._x[0])
                x = self._primal[i] = along - self.target[i] - self._w[i]
                self._right[n + i] = -x - self._w[i]
                primal = widest(primal, x)
                rows = widest(widest(rows, along), self.target[i])
                given += self.target[i] * self._lam[i]
                if i >= self.free:
                    short = widest(short, min(self._w[i], self._lam[i]))
                    mean += self._w[i] * self._lam[i] / m
                    self._theta[i] = self._w[i] / self._lam[i]
        gap = widest(widest(fabs(curved), steep), given)
        return (
            widest(short, primal) / (rows if rows > 0.0 else 1.0),
            dual / (forces if forces > 0.0 else 1.0),
            fabs(curved + steep - given) / (gap if gap > 0.0 else 1.0),
            widest(widest(dual, primal), mean),
            INFINITY if not given > 0.0 else pulled / terms if terms > 0.0 else 0.0,
        )

    def correct(self, const double[::1] u):
        """How much of mu the step keeps, and its second order, by the step u to mu = 0 (n + m,): into `right`.

            sigma = (mu after u / mu)^3,   W dlambda + dw = -w + (sigma mu - dw dlambda) / lambda
        """
        cdef int32_t i, n = self.n
        cdef double t = 1.0, z, dz, s, ds, mu = 0.0, left = 0.0
        with nogil:
            for i in range(self.free, self.m):
                s, z, dz = self._w[i], self._lam[i], -u[n + i]
                ds = -s - self._theta[i] * dz
                mu += s * z
                if s + t * ds < 0.0:
                    t = -s / ds
                if z + t * dz < 0.0:
                    t = -z / dz
            for i in range(self.free, self.m):
                s, z, dz = self._w[i], self._lam[i], -u[n + i]
                left += (s + t * (-s - self._theta[i] * dz)) * (z + t * dz)
            left /= mu
            mu *= left * left * left / (self.m - self.free)
            for i in range(self.free, self.m):
                s, z, dz = self._w[i], self._lam[i], -u[n + i]
                self._cross[i] = ((-s - self._theta[i] * dz) * dz - mu) / z
                self._right[n + i] -= self._cross[i]

    def step(self, const double[::1] u):
        """x, lambda and w along u (n + m,), w and lambda positive."""
        cdef int32_t i, n = self.n
        cdef double t = INFINITY, mu = 0.0, s, z, ds
        with nogil:
            for i in range(self.free, self.m):
                s, z = self._w[i], self._lam[i]
                mu += s * z
                ds = -s - self._cross[i] + self._theta[i] * u[n + i]
                if ds < 0.0 and -s / ds < t:
                    t = -s / ds
                if u[n + i] > 0.0 and z / u[n + i] < t:
                    t = z / u[n + i]
            if self.m > self.free:
                mu /= self.m - self.free
            t = min(1.0, min(max(SHORT, 1.0 - mu), INSIDE) * t)
            for i in range(self.free, self.m):
                self._w[i] += t * (-self._w[i] - self._cross[i] + self._theta[i] * u[n + i])
            for i in range(n):
                self._x[i] += t * u[i]
            for i in range(self.m):
                self._lam[i] -= t * u[n + i]
