"""Warm starts of newton/warm_start.pxd on a problem's data."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.problem cimport Data
from lavender_ext.newton.warm_start cimport band_width, lay_out, room_of, warm_solve, warm_t


def from_guess(Data data, double[::1] impulse, double tol):
    """impulse (m,) of a factored problem to tol: (how it ended, sweeps, factorisations); as it came where 0."""
    cdef int32_t m = data.blocks.n_rows, how
    cdef warm_t s
    if m == 0 or not data.factored:
        return 0, 0, 0
    cdef int32_t[::1] index = np.empty(data.rows.n_bodies + 2 * data.rows.n_joints + 1, np.int32)
    s.width = band_width(&data.blocks, &data.rows, &index[0])
    cdef double[::1] real = np.empty(6 * data.rows.n_bodies + room_of(&data.blocks, s.width))
    s.trace = NULL
    lay_out(&s, &real[6 * data.rows.n_bodies], &index[0], &data.blocks, &data.rows)
    with nogil:
        how = warm_solve(&data.blocks, &data.rows, &s, tol, &impulse[0], &real[0], 0)
    return how, s.sweeps, s.factorisations
