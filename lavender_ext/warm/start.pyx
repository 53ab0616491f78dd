"""Warm starts of warm/start.pxd: on a problem's data, and on the engine's arrays in place."""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport rows_t
from lavender_ext.core.weights cimport block_weights, joint_weights
from lavender_ext.engine.arrays cimport N_DYNAMIC, N_JOINT, S_OUT, bind, engine_t
from lavender_ext.engine.view cimport view
from lavender_ext.warm.start cimport band_width, lay_out, observe, room_of, warm_solve, warm_t


cdef public int32_t lav_warm_band(const blocks_t* p, const rows_t* r, int32_t* last) noexcept nogil:
    """Entries of the band that joints alone need in the given order, each row; last (n_bodies) is scratch."""
    return band_width(p, r, last)


cdef public int32_t lav_warm_solve(const blocks_t* p, const rows_t* r, warm_t* s, double tol, double* lam,
                                   double* v, int32_t has_velocity) noexcept nogil:
    """lam (m) to tol where a few sweeps or one banded factorisation do; how it ended."""
    return warm_solve(p, r, s, tol, lam, v, has_velocity)


def from_guess(Data data, double[::1] impulse, double tol):
    """impulse (m,) of a factored problem to tol: (how it ended, sweeps, factorisations); as it came where 0."""
    cdef int32_t m = data.blocks.n_rows, how
    cdef warm_t s
    if m == 0 or not data.factored:
        return 0, 0, 0
    cdef int32_t[::1] index = np.empty(data.rows.n_bodies + 2 * data.rows.n_joints + 1, np.int32)
    s.width = lav_warm_band(&data.blocks, &data.rows, &index[0])
    cdef double[::1] real = np.empty(6 * data.rows.n_bodies + room_of(&data.blocks, &data.rows, s.width))
    s.trace = NULL
    lay_out(&s, &real[6 * data.rows.n_bodies], &index[0], &data.blocks, &data.rows)
    with nogil:
        how = lav_warm_solve(&data.blocks, &data.rows, &s, tol, &impulse[0], &real[0], 0)
    return how, s.sweeps, s.factorisations


cdef class Warm:
    """Scratch beside an engine's three buffers; `solve` carries the prepared substep's guess to tol in place."""
    cdef const int32_t[::1] size
    cdef double[::1] real
    cdef int32_t[::1] index
    cdef uint64_t[::1] keys
    cdef double[::1] scratch
    cdef int32_t[::1] scratch_index

    def __init__(self, const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys):
        self.size = size
        self.real = real
        self.index = index
        self.keys = keys
        self.scratch = np.empty(1)
        self.scratch_index = np.empty(size[N_DYNAMIC] + 2 * size[N_JOINT] + 1, np.int32)

    def solve(self, double tol):
        """After `prepare` and `solve(False)`: (how it ended, sweeps, factorisations); 0: nothing has changed.

        Else impulses, dv and the solver values of the observation are those of the answer.
        """
        cdef engine_t e
        cdef int64_t used[3]
        cdef blocks_t p
        cdef rows_t r
        cdef warm_t s
        cdef double* nu
        cdef int32_t how
        cdef int64_t room
        bind(&self.size[0], &self.real[0], &self.index[0], &self.keys[0], &e, used)
        view(&e, &p, &r)
        s.width = lav_warm_band(&p, &r, &self.scratch_index[0])
        room = room_of(&p, &r, s.width) + p.n_rows
        if self.scratch.shape[0] < room:
            self.scratch = np.empty(room + room // 4)
        nu = &self.scratch[0]
        s.trace = NULL
        lay_out(&s, nu + p.n_rows, &self.scratch_index[0], &p, &r)
        with nogil:
            block_weights(&p, p.d, nu)
            joint_weights(&p, &r, nu)
            p.nu = nu
            how = lav_warm_solve(&p, &r, &s, tol, e.impulse, e.dv, 1)
            if how != 0:
                observe(&p, &r, &s, e.setting + S_OUT + 5, e.setting + S_OUT + 7)
        return how, s.sweeps, s.factorisations
