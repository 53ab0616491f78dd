"""K = D^-1/2 J M^-1/2 of a factored problem, row by row: two bodies' columns each."""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport rows_t
from lavender_ext.newton.panel cimport fill_panel, inertia_root


cdef public int32_t lav_inertia_root(int32_t n, const double* inv_inertia, double* root) noexcept nogil:
    """Lower L with L L^T = I^-1 for each body, (n, 9); a pivot at rounding is a pinned axis, zero."""
    inertia_root(n, inv_inertia, root)
    return 0


cdef public void lav_panel(const blocks_t* p, const rows_t* r, const double* root, const double* root_mass,
                           double* panel) noexcept nogil:
    """K (m, 12): D^-1/2 J M^-1/2, columns of body a then b."""
    fill_panel(p, r, root, root_mass, panel)


def scaled_jacobian(Data p, const double[:, :, ::1] inv_inertia, const double[::1] root_mass, double[:, ::1] out):
    """K = D^-1/2 J M^-1/2 (m, 12) of a factored problem; root_mass (n,) = sqrt(inv_mass).

    Returns the columns that hold anything, of a body's six, as bits. What is at most 1e-9 (spheres turned by the rounding
    of their arms) is nothing: H = K K^T + theta has a unit diagonal, and feels 1e-18 of it.
    """
    cdef int32_t n = <int32_t>root_mass.shape[0], used = 0, c
    cdef int64_t i
    cdef double[::1] root = np.empty(9 * n + 1)
    if out.shape[0] == 0 or n == 0:
        return 0
    with nogil:
        lav_inertia_root(n, &inv_inertia[0, 0, 0], &root[0])
        lav_panel(&p.blocks, &p.rows, &root[0], &root_mass[0], &out[0, 0])
        for i in range(out.shape[0]):
            for c in range(12):
                if not -1e-9 <= out[i, c] <= 1e-9:
                    used = used | (1 << (c if c < 6 else c - 6))
            if used == 63:
                break
    return used


def narrow(const double[:, ::1] panel, const int32_t[::1] keep, const int32_t[::1] ptr, const int32_t[::1] turned,
           const int32_t[::1] columns, double[:, :, ::1] out):
    """Rows `keep` and `columns` of a panel (m, 12) into out (mk, 2, s), bodies changed over where `turned` (n,)."""
    cdef int32_t i, j, c, s = <int32_t>columns.shape[0], h
    with nogil:
        for i in range(turned.shape[0]):
            h = 1 if turned[i] else 0
            for j in range(ptr[i], ptr[i + 1]):
                for c in range(s):
                    out[j, h, c] = panel[keep[j], columns[c]]
                    out[j, 1 - h, c] = panel[keep[j], 6 + columns[c]]
