"""The panel K = D^-1/2 J M^-1/2 of a factored problem over bodies, and products with K and K^T."""
from libc.math cimport sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t, count_angular_rows, count_tangent_rows
from lavender_ext.core.rows cimport form_contact_jacobian
from lavender_ext.core.view cimport get_block_bodies, rows_t
from lavender_ext.newton.elements cimport elements_t


cdef extern from *:
    """
    #ifdef __GNUC__
    #define LAVENDER_FOR_EACH_SIZE __attribute__((always_inline)) void
    #else
    #define LAVENDER_FOR_EACH_SIZE void
    #endif
    """
    # Return type of a function that is inlined for each constant size, whatever the size of the module.
    ctypedef void for_each_size "LAVENDER_FOR_EACH_SIZE"


cdef inline for_each_size multiply_panel_transpose_of_size(const elements_t* e, int32_t n, const double* x, double* y,
                                            const int32_t s) noexcept nogil:
    cdef int32_t h, i, j, c, first, second
    cdef const double *p
    cdef double u
    cdef double sum[12]
    for i in range(n * s):
        y[i] = 0.0
    for h in range(e.n_groups):
        i = e.group[h]
        first = e.node[2 * i]
        second = e.node[2 * i + 1]
        if first < 0:
            continue
        for c in range(2 * s):
            sum[c] = 0.0
        for j in range(e.ptr[i], e.ptr[e.group[h + 1]]):
            p = e.panel + <int64_t>j * 2 * s
            u = x[j]
            for c in range(2 * s):
                sum[c] += p[c] * u
        for c in range(s):
            y[first * s + c] += sum[c]
        if second >= 0:
            for c in range(s):
                y[second * s + c] += sum[s + c]


cdef inline for_each_size multiply_panel_of_size(const elements_t* e, const double* y, double* x, const int32_t s) noexcept nogil:
    cdef int32_t h, i, j, c, first, second
    cdef const double *p
    cdef double t, u
    cdef double of[12]
    for h in range(e.n_groups):
        i = e.group[h]
        first = e.node[2 * i]
        second = e.node[2 * i + 1]
        for c in range(s):
            of[c] = y[first * s + c] if first >= 0 else 0.0
            of[s + c] = y[second * s + c] if second >= 0 else 0.0
        for j in range(e.ptr[i], e.ptr[e.group[h + 1]]):
            p = e.panel + <int64_t>j * 2 * s
            t = u = 0.0
            for c in range(s):
                t += p[2 * c] * of[2 * c]
                u += p[2 * c + 1] * of[2 * c + 1]
            x[j] = t + u


cdef inline void multiply_panel_transpose(const elements_t* e, int32_t n, const double* x, double* y) noexcept nogil:
    """Compute y = K^T x (n, s)."""
    if e.s == 1:
        multiply_panel_transpose_of_size(e, n, x, y, 1)
    elif e.s == 3:
        multiply_panel_transpose_of_size(e, n, x, y, 3)
    elif e.s == 6:
        multiply_panel_transpose_of_size(e, n, x, y, 6)
    else:
        multiply_panel_transpose_of_size(e, n, x, y, e.s)


cdef inline void multiply_panel(const elements_t* e, const double* y, double* x) noexcept nogil:
    """Compute x = K y (m)."""
    if e.s == 1:
        multiply_panel_of_size(e, y, x, 1)
    elif e.s == 3:
        multiply_panel_of_size(e, y, x, 3)
    elif e.s == 6:
        multiply_panel_of_size(e, y, x, 6)
    else:
        multiply_panel_of_size(e, y, x, e.s)


cdef inline void factor_inertia(int32_t n, const double* inv_inertia, double* root) noexcept nogil:
    """Factor the inverse inertia of each body as L L^T (n, 9); a pivot within rounding of 0 is a fixed axis and set to 0."""
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


cdef inline void compute_panel(const blocks_t* p, const rows_t* r, const double* root, const double* root_mass,
                            double* panel) noexcept nogil:
    """Compute K (m, 12), with the columns of body a before those of body b."""
    cdef int32_t i, j, q, c, k, h, body
    cdef double jac[72]
    cdef double x
    cdef const double *row
    cdef const double *l
    cdef double *out
    for i in range(p.n_blocks):
        j = p.ptr[i]
        c = i - r.n_joints
        if c < 0:
            row = r.jac + 12 * j
        else:
            form_contact_jacobian(r, c, count_tangent_rows(p, i), count_angular_rows(p, i), jac)
            row = jac
        for q in range(j, p.ptr[i + 1]):
            out = panel + 12 * <int64_t>q
            x = 1.0 / sqrt(p.d[q])
            for h in range(2):
                body = get_block_bodies(r, i)[h]
                for k in range(6):
                    out[6 * h + k] = 0.0
                if body >= 0:
                    l = root + 9 * body
                    for k in range(3):
                        out[6 * h + k] = x * row[6 * h + k] * root_mass[body]
                        out[6 * h + 3 + k] = x * (row[6 * h + 3] * l[k] + row[6 * h + 4] * l[3 + k] + row[6 * h + 5] * l[6 + k])
            row += 12
