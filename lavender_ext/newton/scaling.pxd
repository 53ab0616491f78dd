"""Build the scaled problem of Newton's method, without its fixed rows, from the problem's own arrays.

    z = D^1/2 lambda,   H = D^-1/2 A D^-1/2,   g = D^-1/2 (b - A fixed)

An element is a bounded row, or a contact with its free friction components. Rows with equal bounds, components without
friction and empty rows of A are fixed and left out. The integers come first (`index_unfixed_elements`), since the workspace of a
factor over bodies depends on them, then the values (`scale_elements`).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.core.arena cimport arena_t, take_integers
from lavender_ext.core.block_types cimport (
    blocks_t, friction_components_t, get_friction_components, is_round_cone_contact, has_independent_rows,
)
from lavender_ext.core.velocity cimport compute_velocity_change
from lavender_ext.core.view cimport csr_t, rows_t, view_t
from lavender_ext.judge.slack cimport compute_generalized_slack, compute_body_slack
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.velocity_newton.soft cimport has_bounded_rows_only


cdef struct scaled_t:
    elements_t e
    int32_t* keep               # (m) rows of the problem that are not fixed
    int32_t* block              # (n) block of each element
    double* fixed               # (rows) impulse of the fixed rows
    double* scale               # (m) D^-1/2
    double* speed               # (m) velocity error per unit of the natural map
    int32_t small               # total number of entries of the square matrices of all elements
    int32_t whole               # whether no row is fixed


cdef inline bint is_problem_supported(const blocks_t* p) noexcept nogil:
    """Return whether the method accepts the problem: no round cones of more than two tangents."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if is_round_cone_contact(p, i):
            return False
    return True


cdef inline double lower_bound(const blocks_t* p, int32_t i, int32_t j) noexcept nogil:
    """Return the lower bound of row j of block i; 0 for rows of a contact."""
    return p.lower[j] if has_independent_rows(p, i) else 0.0


cdef inline double upper_bound(const blocks_t* p, int32_t i, int32_t j) noexcept nogil:
    """Return the upper bound of row j of block i; infinity for rows of a contact."""
    return p.upper[j] if has_independent_rows(p, i) else 1.0 / 0.0


cdef inline double get_component_coefficient(const blocks_t* p, int32_t i, int32_t j) noexcept nogil:
    """Return the friction coefficient of the component of row j (not the normal) of contact i."""
    cdef friction_components_t q
    cdef int32_t g = 0
    get_friction_components(p, i, &q)
    while g + 1 < q.n and j - p.ptr[i] >= q.first[g + 1]:
        g += 1
    return q.friction_coefficient[g]


cdef inline double row_compliance(const view_t* v, int32_t j) noexcept nogil:
    """Return the compliance of row j; 0 for a given A, whose diagonal includes it."""
    return v.r.compliance[j] if v.r != NULL else v.g.compliance[j] if v.g != NULL else 0.0


cdef inline bint is_empty_row(const view_t* v, int32_t i, int32_t j) noexcept nogil:
    """Return whether row j of A, which belongs to block i, has no non-zero entry."""
    cdef const rows_t* r = v.r
    cdef int32_t q, b
    cdef double x = fabs(row_compliance(v, j))
    if v.a != NULL:
        for q in range(v.a.indptr[j], v.a.indptr[j + 1]):
            x += fabs(v.a.data[q])
    elif v.g != NULL:
        for q in range(v.g.jptr[j], v.g.jptr[j + 1]):
            x += fabs(v.g.jval[q])
    elif i < r.n_joints:
        for q in range(12 * j, 12 * j + 12):
            x += fabs(r.minv_jac[q])
    else:
        for q in range(2):
            b = r.contact_body[2 * (i - r.n_joints) + q]
            if b >= 0:
                x += r.inv_mass[b]
        for q in range(6 * (j - v.p.ptr[r.n_joints]), 6 * (j - v.p.ptr[r.n_joints]) + 6):
            x += fabs(r.inv_inertia_arm[q])
    return x == 0.0


cdef inline bint is_fixed(const view_t* v, int32_t i, int32_t j, double* at) noexcept nogil:
    """Return whether row j of block i is fixed, and write its impulse to `at`."""
    cdef const blocks_t* p = &v.p
    cdef double x, low, high
    at[0] = 0.0
    if not has_bounded_rows_only(p, i):
        return j > p.ptr[i] and get_component_coefficient(p, i, j) == 0.0
    low, high = lower_bound(p, i, j), upper_bound(p, i, j)
    if low == high:
        at[0] = low
        return True
    if not is_empty_row(v, i, j):
        return False
    x = high if p.b[j] > 0.0 else low if p.b[j] < 0.0 else 0.0
    x = x if fabs(x) < 1.0 / 0.0 else 0.0
    at[0] = low if x < low else high if x > high else x
    return True


cdef inline void bind_element_indices(scaled_t* s, int64_t m, arena_t* a) noexcept nogil:
    """Take the integer arrays for up to m rows."""
    s.keep, s.block = take_integers(a, m), take_integers(a, m)
    s.e.ptr, s.e.wptr, s.e.part = take_integers(a, m + 1), take_integers(a, m + 1), take_integers(a, m + 1)
    s.e.first, s.e.size = take_integers(a, m), take_integers(a, m)
    s.e.node = s.e.slot = s.e.group = NULL              # Only over bodies.
    s.e.n_groups = 0
    s.e.panel = NULL
    s.e.s = 1


cdef inline void index_unfixed_elements(scaled_t* s, const view_t* v) noexcept nogil:
    """Find the rows that are not fixed and their elements; the arrays are bound by `bind_element_indices`."""
    cdef const blocks_t* p = &v.p
    cdef int32_t i, j, g, q, n = 0, m = 0, parts = 0, normal
    cdef int32_t* ptr = <int32_t*>s.e.ptr
    cdef int32_t* part = <int32_t*>s.e.part
    cdef int32_t* first = <int32_t*>s.e.first
    cdef int32_t* size = <int32_t*>s.e.size
    cdef int32_t* wptr = <int32_t*>s.e.wptr
    cdef double x
    cdef friction_components_t own
    part[0] = 0
    for i in range(p.n_blocks):
        normal = m
        for j in range(p.ptr[i], p.ptr[i + 1]):
            if is_fixed(v, i, j, &x):
                continue
            s.keep[m] = j
            m += 1
            if has_bounded_rows_only(p, i) or m == normal + 1:
                ptr[n] = m - 1
                s.block[n] = i
                n += 1
                part[n] = parts
        if has_bounded_rows_only(p, i):
            continue
        get_friction_components(p, i, &own)
        normal += 1
        for g in range(own.n):
            if own.friction_coefficient[g] > 0.0:
                first[parts], size[parts] = normal, own.size[g]
                normal += own.size[g]
                parts += 1
        part[n] = parts
    ptr[n] = m
    wptr[0] = 0
    for i in range(n):
        q = ptr[i + 1] - ptr[i]
        wptr[i + 1] = wptr[i] + q * q
    s.small = wptr[n]
    s.e.n, s.e.m = n, m
    s.whole = m == p.n_rows


cdef inline void scale_elements(scaled_t* s, const view_t* v, double* w, double* scratch) noexcept nogil:
    """Compute the values of the elements; w (rows) and scratch (velocities) are lost."""
    cdef const blocks_t* p = &v.p
    cdef int32_t i, j, q, h, g
    cdef double x
    cdef bint any_fixed_impulse = False
    # the impulses of the fixed rows
    memset(s.fixed, 0, p.n_rows * sizeof(double))
    for i in range(0 if s.whole else p.n_blocks):
        for j in range(p.ptr[i], p.ptr[i + 1]):
            if is_fixed(v, i, j, &x):
                s.fixed[j] = x
                any_fixed_impulse = any_fixed_impulse or x != 0.0
    if any_fixed_impulse and v.r != NULL:
        compute_velocity_change(p, v.r, s.fixed, scratch)
        compute_body_slack(p, v.r, s.fixed, scratch, w)
    elif any_fixed_impulse and v.g != NULL:
        compute_generalized_slack(p, v.g, s.fixed, scratch, w)
    for i in range(s.e.n):
        for q in range(s.e.ptr[i], s.e.ptr[i + 1]):
            j = s.keep[q]
            s.scale[q] = 1.0 / sqrt(p.d[j])
            s.speed[q] = sqrt(p.nu[j]) * sqrt(p.d[j]) * s.scale[q]
            (<double*>s.e.lower)[q] = lower_bound(p, s.block[i], j) / s.scale[q]
            (<double*>s.e.upper)[q] = upper_bound(p, s.block[i], j) / s.scale[q]
            (<double*>s.e.theta)[q] = row_compliance(v, j) * s.scale[q] * s.scale[q]
            x = 0.0                                     # (A fixed)_j
            if any_fixed_impulse and v.a == NULL:
                x = w[j] + p.b[j]
            elif any_fixed_impulse:
                for h in range(v.a.indptr[j], v.a.indptr[j + 1]):
                    x += v.a.data[h] * s.fixed[v.a.indices[h]]
            (<double*>s.e.g)[q] = (p.b[j] - x) * s.scale[q]
    for i in range(s.e.n):
        for g in range(s.e.part[i], s.e.part[i + 1]):
            q = s.e.first[g]
            x = get_component_coefficient(p, s.block[i], s.keep[q])
            (<double*>s.e.reach)[g] = x * (1.0 / s.scale[q]) / (1.0 / s.scale[s.e.ptr[i]])


cdef inline bint form_scaled_matrix(const scaled_t* s, const csr_t* a, int32_t rows, int32_t* place, double* h) noexcept nogil:
    """Form H (m, m) and return whether it is symmetric; place (rows) is scratch."""
    cdef int32_t i, j, q, m = s.e.m
    cdef double x
    cdef bint same = True
    for j in range(rows):
        place[j] = -1
    for i in range(m):
        place[s.keep[i]] = i
    memset(h, 0, <int64_t>m * m * sizeof(double))
    for i in range(m):
        for q in range(a.indptr[s.keep[i]], a.indptr[s.keep[i] + 1]):
            j = place[a.indices[q]]
            if j >= 0:
                h[<int64_t>i * m + j] = a.data[q] * s.scale[i] * s.scale[j]
    for i in range(m):
        for j in range(i):
            x = h[<int64_t>i * m + j] - h[<int64_t>j * m + i]
            same = same and fabs(x) <= 1e-14
    return same
