"""Elements for Python: bounds and cones, their natural maps, and interior point steps part by part."""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.newton.cones cimport KEPT, PARTS
from lavender_ext.newton.elements cimport element_times, element_times_transposed, elements_t
from lavender_ext.newton.interior cimport (ipm_affine, ipm_rhs, ipm_scale, ipm_start, ipm_start_apart,
                                           ipm_update)
from lavender_ext.newton.natural_map cimport natural


cdef public double lav_ipm_start(const elements_t* e, const double* hz, double dual, double* z, double* u1,
                                 double* u2) noexcept nogil:
    return ipm_start(e, hz, dual, z, u1, u2)


cdef public double lav_ipm_start_apart(const elements_t* e, const double* hz, double margin, double* z, double* u1,
                                       double* u2) noexcept nogil:
    return ipm_start_apart(e, hz, margin, z, u1, u2)


cdef public void lav_ipm_scale(const elements_t* e, const double* z, const double* u1, const double* u2, double delta,
                               double* v, double* bt, double* gap) noexcept nogil:
    ipm_scale(e, z, u1, u2, delta, v, bt, gap)


cdef public double lav_ipm_affine(const elements_t* e, const double* z, const double* u1, const double* u2,
                                  const double* dz, double* gap) noexcept nogil:
    return ipm_affine(e, z, u1, u2, dz, gap)


cdef public void lav_ipm_rhs(const elements_t* e, const double* z, const double* u1, const double* u2, const double* hz,
                             const double* da, double sigma_mu, double* rhs) noexcept nogil:
    ipm_rhs(e, z, u1, u2, hz, da, sigma_mu, rhs)


cdef public double lav_ipm_update(const elements_t* e, double* z, double* u1, double* u2, const double* dz,
                                  const double* da, double sigma_mu, double damping, double* du1, double* du2) noexcept nogil:
    return ipm_update(e, z, u1, u2, dz, da, sigma_mu, damping, du1, du2)


cdef public double lav_natural(const elements_t* e, const double* z, const double* s, int32_t law, double eps,
                               double* f, double* p, double* einv, double* v) noexcept nogil:
    return natural(e, z, s, law, eps, f, p, einv, v)


cdef public void lav_element_product(const elements_t* e, const double* w, const double* h, double eps, double own,
                                     double one, double* out) noexcept nogil:
    """out = W (H + eps) + one I - own W, all (m, m) row-major, W one small matrix for each element."""
    cdef int32_t i, j, k, r, c, nr, m = e.m
    cdef double x
    cdef double *y
    cdef const double *a
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        for r in range(nr):
            y = out + <int64_t>(j + r) * m
            for k in range(m):
                y[k] = 0.0
            for c in range(nr):
                x = w[e.wptr[i] + r * nr + c]
                if x == 0.0:
                    continue
                a = h + <int64_t>(j + c) * m
                for k in range(m):
                    y[k] += x * a[k]
                y[j + c] += x * (eps - own)
            y[j + r] += one


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

    def start(self, const double[::1] hz, double size, double[::1] z, double[::1] u1, double[::1] u2, bint apart):
        """z, u inside their cones, one shift for all of them or each `apart`; returns the degree."""
        if apart:
            return lav_ipm_start_apart(&self.e, &hz[0], size, &z[0], &u1[0], &u2[0])
        return lav_ipm_start(&self.e, &hz[0], size, &z[0], &u1[0], &u2[0])

    def scale(self, const double[::1] z, const double[::1] u1, const double[::1] u2, double delta, double[::1] v,
              double[::1] bt=None):
        """V = (W + theta + delta)^-1 into v, B^T with V = B B^T (theta = 0) into bt; returns the gap."""
        cdef double gap
        cdef double* x = NULL
        if bt is not None:
            x = &bt[0]
        with nogil:
            lav_ipm_scale(&self.e, &z[0], &u1[0], &u2[0], delta, &v[0], x, &gap)
        return gap

    def affine(self, const double[::1] z, const double[::1] u1, const double[::1] u2, const double[::1] dz):
        """(step, gap after it)."""
        cdef double gap, step
        with nogil:
            step = lav_ipm_affine(&self.e, &z[0], &u1[0], &u2[0], &dz[0], &gap)
        return step, gap

    def rhs(self, const double[::1] z, const double[::1] u1, const double[::1] u2, const double[::1] hz,
            const double[::1] da, double sigma_mu, double[::1] out):
        with nogil:
            lav_ipm_rhs(&self.e, &z[0], &u1[0], &u2[0], &hz[0], &da[0], sigma_mu, &out[0])

    def step(self, double[::1] z, double[::1] u1, double[::1] u2, const double[::1] dz, const double[::1] da,
             double sigma_mu, double damping, double[::1] t1, double[::1] t2):
        """The combined step in place; returns its length."""
        cdef double length
        with nogil:
            length = lav_ipm_update(&self.e, &z[0], &u1[0], &u2[0], &dz[0], &da[0], sigma_mu, damping, &t1[0], &t2[0])
        return length

    def natural(self, const double[::1] z, const double[::1] s, int law, double eps, double[::1] f, double[::1] p,
                double[::1] einv=None, double[::1] v=None):
        """F, P and, where given, E^-1 and V; returns |F|."""
        cdef double size
        cdef double* x = NULL
        cdef double* y = NULL
        if einv is not None:
            x = &einv[0]
            y = &v[0]
        with nogil:
            size = lav_natural(&self.e, &z[0], &s[0], law, eps, &f[0], &p[0], x, y)
        return size

    def times_transposed(self, const double[::1] w, const double[::1] x, double[::1] out):
        """out = W^T x."""
        with nogil:
            element_times_transposed(&self.e, &w[0], &x[0], &out[0])

    def times(self, const double[::1] w, const double[::1] x, double[::1] out):
        """out = W x, one small matrix for each element."""
        with nogil:
            element_times(&self.e, &w[0], &x[0], &out[0])


def element_product(Elements e, const double[::1] w, const double[:, ::1] h, double eps, double own, double one,
                    double[:, ::1] out):
    """out = W (H + eps) + one I - own W."""
    if e.m:
        with nogil:
            lav_element_product(&e.e, &w[0], &h[0, 0], eps, own, one, &out[0, 0])
