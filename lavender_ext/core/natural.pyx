"""The linearised natural map of a problem for Python: cases, margins, P, and the dense system (`natural.pxd`)."""
from libc.math cimport sqrt
from libc.stdint cimport int8_t, int32_t

import numpy as np

from lavender_ext.core.block cimport ROW, blocks_t
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.natural cimport (CLOSED, FREE, HIGH, LOW, OPEN, SLIDES, STICKS, block_times, natural_contact,
                                        natural_row, natural_t, scaled_csr, scaled_general, system_rows)
from lavender_ext.core.problem cimport Data, Room, room_for

#: Cases of rows by the kernels' numbers.
CASES = {"open": OPEN, "closed": CLOSED, "sticks": STICKS, "slides": SLIDES, "free": FREE, "low": LOW, "high": HIGH}


cdef public void lav_natural(const blocks_t* b, const double* lam, const double* w,
                             const natural_t* out) noexcept nogil:
    """(1) and (2) of natural.pxd for every block."""
    cdef int32_t i, j, k
    for i in range(b.n_blocks):
        j = b.ptr[i]
        if b.kind[i] != ROW:
            natural_contact(b, i, lam, w, out)
            continue
        for k in range(b.ptr[i + 1] - j):
            out.root[j + k] = sqrt(b.d[j + k])
            natural_row(lam[j + k], w[j + k], b.lower[j + k], b.upper[j + k], out.root[j + k], out.f + j + k,
                        out.margin + j + k, out.case_ + j + k, out.p + out.at[i] + k)
            out.edge[out.at[i] + k] = 0.0


cdef class Natural:
    """Blocks at an answer lam (m,) [N s] with slack w (m,) [m/s], in the metric d (m,) [1/kg] > 0; arrays are kept."""
    cdef blocks_t b
    cdef natural_t x
    cdef list keep
    cdef readonly int rows                              # that have a place in the system
    cdef readonly object root, residual, margin, case, at, p, edge, place

    def __init__(self, Blocks blocks, int law, d_, lam_, w_):
        cdef const double[::1] d = d_, lam = lam_, w = w_
        cdef int32_t m = blocks.at.n_rows, k = blocks.at.n_blocks, i, n, j
        self.b = blocks.at
        self.b.law = law
        self.root, self.residual, self.margin = np.empty(m), np.empty(m), np.empty(m)
        self.case, self.at, self.place = np.empty(m, np.int8), np.zeros(k + 1, np.int32), np.empty(m, np.int32)
        cdef int32_t[::1] at = self.at, place = self.place
        for i in range(k):
            n = self.b.ptr[i + 1] - self.b.ptr[i]
            at[i + 1] = at[i] + (n if self.b.kind[i] == ROW else n * n)
        self.p, self.edge = np.empty(at[k]), np.empty(at[k])
        self.keep = [blocks, d_]
        if m == 0:
            return
        cdef double[::1] root = self.root, f = self.residual, margin = self.margin, p = self.p, edge = self.edge
        cdef int8_t[::1] case_ = self.case
        self.b.d = &d[0]
        self.x = natural_t(&root[0], &f[0], &margin[0], &case_[0], &at[0], &p[0], &edge[0])
        with nogil:
            lav_natural(&self.b, &lam[0], &w[0], &self.x)
            n = 0
            for i in range(k):
                for j in range(self.b.ptr[i], self.b.ptr[i + 1]):
                    place[j] = -1
                    if case_[self.b.ptr[i]] == OPEN or case_[j] == LOW or case_[j] == HIGH:
                        continue
                    place[j] = n
                    n += 1
        self.rows = n

    def times(self, v_, bint back=False, bint edge=False):
        """P v (m,), or with `edge` dPi/de v; `back`: of the transpose."""
        cdef const double[::1] v = v_
        out_ = np.empty(self.b.n_rows)
        cdef double[::1] out = out_
        if self.b.n_rows:
            with nogil:
                block_times(&self.x, &self.b, self.x.edge if edge else self.x.p, &v[0], back, &out[0])
        return out_

    def system(self, Data data, root_):
        """G (n, n) of (3) on the rows with a place, of the data of A in rows or of J and M; root (m,) is D^1/2."""
        cdef const double[::1] root = root_
        cdef const int32_t[::1] place = self.place
        cdef int32_t n = self.rows
        cdef Room room
        cdef double* h
        out_ = np.empty((n, n))
        cdef double[:, ::1] out = out_
        if n == 0:
            return out_
        room = room_for((<Py_ssize_t>n * (n + data.general.n)) * sizeof(double))
        h = <double*>room.at
        with nogil:
            if data.is_general:
                scaled_general(&data.general, n, &place[0], &root[0], h + <Py_ssize_t>n * n, h)
            else:
                scaled_csr(&data.csr, self.b.n_rows, n, &place[0], &root[0], h)
            system_rows(&self.x, &self.b, n, &place[0], h, &out[0, 0])
        return out_
