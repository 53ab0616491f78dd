"""K = D^-1/2 J M^-1/2 of a factored problem, row by row: two bodies' columns each."""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.block cimport CONTACT_SPIN as SPIN, blocks_t, n_tangents
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport contact_jacobian, rows_t


cdef public int32_t lav_inertia_root(int32_t n, const double* inv_inertia, double* root) noexcept nogil:
    """Lower L with L L^T = I^-1 for each body, (n, 9); a pivot at rounding is a pinned axis, zero."""
    cdef int32_t i, c, r, t
    cdef double x, top
    cdef const double *a
    cdef double *l
    for i in range(n):
        a = inv_inertia + 9 * i
        l = root + 9 * i
        for c in range(9):
            l[c] = 0.0
        for c in range(3):
            x = a[4 * c]
            for t in range(c):
                x -= l[3 * c + t] * l[3 * c + t]
            if not x > 1e-14 * a[4 * c]:
                continue
            x = sqrt(x)
            l[4 * c] = x
            for r in range(c + 1, 3):
                top = 0.5 * (a[3 * r + c] + a[3 * c + r])
                for t in range(c):
                    top -= l[3 * r + t] * l[3 * c + t]
                l[3 * r + c] = top / x
    return 0


cdef public void lav_panel(const blocks_t* p, const rows_t* r, const double* root, const double* root_mass,
                           double* panel) noexcept nogil:
    """K (m, 12): D^-1/2 J M^-1/2, columns of body a then b."""
    cdef int32_t i, j, q, c, k, h, a, b, body
    cdef double jac[48]
    cdef double x
    cdef const double *row
    cdef const double *l
    cdef double *out
    for i in range(p.n_blocks):
        j = p.ptr[i]
        c = i - r.n_joints
        if c < 0:
            a = r.joint_body[2 * i]
            b = r.joint_body[2 * i + 1]
            row = r.jac + 12 * j
        else:
            a = r.contact_body[2 * c]
            b = r.contact_body[2 * c + 1]
            contact_jacobian(r, c, n_tangents(p.kind[i], p.ptr[i + 1] - j), p.kind[i] == SPIN, jac)
            row = jac
        for q in range(j, p.ptr[i + 1]):
            out = panel + 12 * <int64_t>q
            x = 1.0 / sqrt(p.d[q])
            for h in range(2):
                body = a if h == 0 else b
                for k in range(6):
                    out[6 * h + k] = 0.0
                if body >= 0:
                    l = root + 9 * body
                    for k in range(3):
                        out[6 * h + k] = x * row[6 * h + k] * root_mass[body]
                        out[6 * h + 3 + k] = x * (row[6 * h + 3] * l[k] + row[6 * h + 4] * l[3 + k] + row[6 * h + 5] * l[6 + k])
            row += 12


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
