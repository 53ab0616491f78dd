"""Elements for Python: bounds and cones of a scaled problem."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.newton.cones cimport KEPT, PARTS
from lavender_ext.newton.interior cimport ipm_scale


cdef class Elements:
    """Bounds and cones of the scaled problem, with the small matrices of every element.

    Every array is C-contiguous, float64 or int32, of the length that the structs above give, checked by
    the caller.
    """
    def __init__(self, ptr, kind, wptr, node, slot, panel, theta, g, lower, upper, at, as_, int s, ar=None):
        cdef int32_t parts = 2 if ar is None else PARTS
        scaling = np.empty(parts * KEPT * len(kind) if len(kind) < len(g) else 0)
        cdef const int32_t[:, ::1] of = node
        cdef int32_t i, k = 0
        group_array = np.empty(len(kind) + 1, np.int32)
        cdef int32_t[::1] group = group_array
        for i in range(of.shape[0]):
            if i == 0 or of[i, 0] != of[i - 1, 0] or of[i, 1] != of[i - 1, 1]:
                group[k] = i
                k += 1
        group[k] = <int32_t>of.shape[0]
        self.keep = [ptr, kind, wptr, node, slot, panel, theta, g, lower, upper, at, as_, scaling, group_array, ar]
        self.n = len(kind)
        self.m = len(g)
        self.n_small = int(wptr[len(kind)])
        self.e = elements_t(
            self.n, self.m, s, <int32_t*>address(ptr), <int32_t*>address(kind), <int32_t*>address(wptr),
            <int32_t*>address(node), <int32_t*>address(slot), k, &group[0], <double*>address(panel), <double*>address(theta),
            <double*>address(g), <double*>address(lower), <double*>address(upper), <double*>address(at),
            <double*>address(as_), <double*>address(scaling), parts, NULL)
        if ar is not None:
            self.e.ar = <double*>address(ar)

    def scale(self, const double[::1] z, const double[::1] u1, const double[::1] u2, double delta, double[::1] v,
              double[::1] bt=None):
        """V = (W + theta + delta)^-1 into v, B^T with V = B B^T (theta = 0) into bt; returns the gap."""
        cdef double gap
        cdef double* x = NULL
        if bt is not None:
            x = &bt[0]
        ipm_scale(&self.e, &z[0], &u1[0], &u2[0], delta, &v[0], x, &gap)
        return gap
