"""Scaled problems for Python: what `scaling.pxd` makes of one, as arrays."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport rows_t
from lavender_ext.newton.cones cimport PARTS
from lavender_ext.newton.scaling cimport (find_elements, lay_elements, lay_numbers, scale_elements, scaled_index,
                                          scaled_real, scaled_t)


cdef class Scaled:
    """Rows that move, as elements. Fixed rows (equal bounds, mu = 0 tangents, empty rows) are taken out.

    keep (m,) are the rows that move, block (n,) that of each element, fixed (rows,) the impulse of the others; scale (m,)
    is D^-1/2, speed (m,) the velocity error per unit of the natural map; ptr, kind, wptr, lower, upper, theta, g, a_t, a_s
    and a_r (None without rolling) are those of `elements_t`. `whole`: every row moves.

    Parameters
    ----------
    data : Data
        With d and nu.
    matrix : Data or None
        Of A in compressed rows; None: over the bodies of `data`.
    """
    cdef scaled_t s
    cdef list held
    cdef readonly int m
    cdef readonly bint whole
    cdef readonly object keep, block, fixed, scale, speed, ptr, kind, wptr, lower, upper, theta, g, a_t, a_s, a_r

    def __init__(self, Data data, Data matrix=None):
        cdef int32_t rows = data.blocks.n_rows, n
        cdef const csr_t* a = NULL
        cdef const rows_t* r = NULL
        if matrix is not None:
            a = &matrix.csr
        else:
            r = &data.rows
        cdef double[::1] scratch = np.empty(rows + 6 * <int>data.rows.n_bodies * data.factored + 1)
        whole, numbers = np.empty(scaled_index(rows), np.int32), np.empty(scaled_real(rows) + 1)
        self.held = [data, matrix, whole, numbers]
        lay_elements(&self.s, rows, <int32_t*>address(whole))
        lay_numbers(&self.s, rows, <double*>address(numbers))
        with nogil:
            find_elements(&self.s, &data.blocks, a, r)
            scale_elements(&self.s, &data.blocks, a, r, &scratch[0], &scratch[rows])
        m = self.m = self.s.e.m
        n = self.s.e.n
        self.whole = self.s.whole
        self.keep, self.block = whole[:m], whole[rows:rows + n]
        self.ptr, self.kind = whole[2 * rows:2 * rows + n + 1], whole[3 * rows + 1:3 * rows + 1 + n]
        self.wptr = whole[4 * rows + 1:4 * rows + 2 + n]
        self.fixed, self.scale, self.speed, self.theta, self.g, self.lower, self.upper = (
            numbers[i * rows:i * rows + (m if i else rows)] for i in range(7))
        self.a_t, self.a_s, self.a_r = (numbers[i * rows:i * rows + n] for i in range(7, 10))
        if self.s.e.parts < PARTS:
            self.a_r = None

    @property
    def has_friction(self):
        """Some element has more rows than one: a contact with tangents or spin that move."""
        return self.s.e.n < self.s.e.m

    def impulse(self, z):
        """lambda (rows,) of z (m,)."""
        if self.whole:
            return z * self.scale
        lam = self.fixed.copy()
        lam[self.keep] = z * self.scale
        return lam

    def unknown(self, impulse):
        """z (m,) of lambda (rows,)."""
        return (impulse if self.whole else impulse[self.keep]) / self.scale
