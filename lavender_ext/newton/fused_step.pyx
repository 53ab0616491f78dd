"""Whole interior point and Newton steps of the velocity form for Python."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.factor.blocks cimport factor_t
from lavender_ext.newton.elements cimport Elements, elements_t
from lavender_ext.newton.fused_step cimport (interior_first, interior_newton, interior_step, interior_t,
                                             times_h)
from lavender_ext.newton.interior cimport ipm_start, ipm_start_apart
from lavender_ext.newton.natural_map cimport convex_error
from lavender_ext.newton.normal_matrix cimport Factor


cdef public void lav_convex_error(const elements_t* e, const double* z, const double* hz, const double* speed,
                                  double* energy, double* velocity) noexcept nogil:
    convex_error(e, z, hz, speed, energy, velocity)


cdef public void lav_interior_first(const elements_t* e, const factor_t* f, interior_t* p, double weight,
                                    double free_weight) noexcept nogil:
    interior_first(e, f, p, weight, free_weight)


cdef public int32_t lav_interior_newton(const elements_t* e, const factor_t* f, interior_t* p, double eps,
                                        int32_t rounds) noexcept nogil:
    return interior_newton(e, f, p, eps, rounds)


cdef public int32_t lav_interior_step(const elements_t* e, const factor_t* f, interior_t* p) noexcept nogil:
    return interior_step(e, f, p)


cdef class Interior:
    """An interior point of the velocity form: `first`, then `step` after `step`."""
    def __init__(self, Elements e, Factor f, v, bt, u1, u2, speed, double delta, double damping):
        buffer = np.empty((8, e.m + 1))
        y, side = np.empty(f.n * f.s + 1), np.zeros(e.m + 1, np.int32)
        self.e, self.f = e, f
        self.keep = [v, bt, u1, u2, speed, buffer, y, side]
        self.z, self.hz = buffer[0, : e.m], buffer[1, : e.m]
        cdef double[:, ::1] b = buffer
        cdef double* root = NULL
        if bt is not None:
            root = <double*>address(bt)
        self.p = interior_t(
            delta, damping, 0.0, &b[0, 0], <double*>address(u1), <double*>address(u2), &b[1, 0], <double*>address(v),
            root, &b[2, 0], &b[3, 0], &b[4, 0], &b[5, 0], &b[6, 0],
            <double*>address(y), <double*>address(speed), <int32_t*>address(side), 0, 0.0, 0.0, 0.0, 0.0)

    def first(self, double weight, double free_weight):
        """z with (H + weight) z = g, hz = H z."""
        self.f.lu = False
        with nogil:
            lav_interior_first(&self.e.e, &self.f.f, &self.p, weight, free_weight)

    def place(self, const double[::1] z):
        """z as the point of `newton`: (|F|, velocity error)."""
        cdef int32_t j
        for j in range(self.e.m):
            self.p.z[j] = z[j]
        times_h(&self.e.e, self.f.n, self.p.z, self.p.y, self.p.hz)
        return self.error()

    def error(self):
        """(|F|, velocity error) of z, hz."""
        lav_convex_error(&self.e.e, self.p.z, self.p.hz, self.p.speed, &self.p.energy, &self.p.velocity)
        return self.p.energy, self.p.velocity

    @property
    def changed(self):
        """Rows that took another side in the last step."""
        return self.p.changed

    def newton(self, double eps, int rounds):
        """One Newton step of bounded rows: (whether it is finite, |F|, velocity error)."""
        cdef int32_t ok
        self.f.lu = False
        with nogil:
            ok = lav_interior_newton(&self.e.e, &self.f.f, &self.p, eps, rounds)
        return bool(ok), self.p.energy, self.p.velocity

    def begin(self, double size, bint apart):
        """z, u1, u2 inside their cones, one shift for all of them or each `apart`; returns the degree."""
        if apart:
            self.p.degree = ipm_start_apart(&self.e.e, self.p.hz, size, self.p.z, self.p.u1, self.p.u2)
        else:
            self.p.degree = ipm_start(&self.e.e, self.p.hz, size, self.p.z, self.p.u1, self.p.u2)
        times_h(&self.e.e, self.f.n, self.p.z, self.p.y, self.p.hz)
        return self.p.degree

    def step(self):
        """One predictor-corrector step.

        Returns whether it went, its length, gap / degree before it, |F| and velocity error.
        """
        cdef int32_t ok
        self.f.lu = False
        with nogil:
            ok = lav_interior_step(&self.e.e, &self.f.f, &self.p)
        return bool(ok), self.p.length, self.p.gap, self.p.energy, self.p.velocity
