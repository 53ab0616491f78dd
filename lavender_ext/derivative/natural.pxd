"""The linearised natural map of the blocks at a solution, the case of each row, and its distance to the next case.

With z = D^1/2 lambda, s = D^-1/2 w, y = z - s, Pi and P = dPi/dy of core/block_projection.pxd, H = D^-1/2 A D^-1/2,

    F = z - Pi(y) = 0                                                                                       (1)
    (I - P) dz + P ds = (dPi/da) da + dl,   ds = H dz + ...                                                 (2)
    G = I - P + P H,   the identity on rows with P = 0: open contacts, rows at a bound                      (3)

Any metric D is valid at a solution, so a round cone has one d for all its tangents. The margin of a row is the distance of y to
the next case, in N s: the distance of y to the bound of a row; -y_n of an open contact, -(y_n + sum a |y|) under the cone law;
the normal s_n of Pi(y) of a closed contact, and ||y_g| - a_g s_n| of each of its friction components.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int8_t, int32_t

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.block_projection cimport classify_active_bound, differentiate_by_coefficients, evaluate_natural_map
from lavender_ext.core.dot cimport dot
from lavender_ext.core.block_types cimport CONE, blocks_t, has_independent_rows, get_friction_components, friction_components_t
from lavender_ext.core.view cimport csr_t, generalized_t, view_t
from lavender_ext.factor.linear cimport linear_t


cdef enum:                      # case of a row
    OPEN = 0                    # row of a contact without an impulse
    CLOSED = 1                  # normal with a positive impulse
    STICKS = 2
    SLIDES = 3
    FREE = 4                    # between its bounds
    LOW = 5                     # at the lower bound
    HIGH = 6                    # at the upper bound


cdef struct natural_t:          # natural map of all blocks
    double* root                # (m) D^1/2
    double* f                   # (m) F
    double* margin              # (m) N s
    int8_t* case_               # (m)
    const int32_t* value_ptr    # (k + 1) first value of each block in p and edge: a diagonal for bounded rows, otherwise a square
    double* p                   # P
    double* edge                # dPi/de, e_g the friction coefficient of component g, in the first column of g


cdef struct linearised_t:           # a judged and linearised solution
    view_t v                    # problem for the judge
    natural_t x
    int32_t n                   # number of velocities, 0 for a matrix
    int32_t rows                # order of G
    bint valid                  # the problem is supported and linearised
    bint tried                  # a factorisation was attempted
    bint regular                # G was factored and is regular
    double* lam                 # (m) N s
    double* w                   # (m) m/s
    int32_t* system_row         # (m) row of G of each row, -1 without one
    linear_t g                  # G, factored
    double relative, above_floor        # results of the judge
    ssize_t first               # first index of the item in the results of `Linears.adjoint`


cdef inline void linearise_row_projection(double lam, double w, double low, double high, double root, double* f, double* margin,
                                          int8_t* case_, double* p) noexcept nogil:
    """Compute (1), P, case and margin of one bounded row."""
    cdef double y = lam - w / (root * root)
    cdef int32_t side = classify_active_bound(y, low, high)
    p[0] = 1.0 if side == 0 else 0.0
    if side == 0:
        case_[0] = FREE
        f[0] = w / root
        margin[0] = y - low if y - low < high - y else high - y
    elif side < 0:
        case_[0] = LOW
        f[0] = root * (lam - low)
        margin[0] = fabs(y - low)
    else:
        case_[0] = HIGH
        f[0] = root * (lam - high)
        margin[0] = fabs(high - y)
    if low == high:
        margin[0] = INFINITY


cdef inline void linearise_contact_projection(const blocks_t* b, int32_t i, const double* lam, const double* w,
                                              const natural_t* out) noexcept nogil:
    """Compute (1), P, dPi/de, cases and margins of contact i."""
    cdef int32_t j = b.ptr[i], n = b.ptr[i + 1] - j, k, g, first, size
    cdef double* root = out.root + j
    cdef double* margin = out.margin + j
    cdef double* edge = out.edge + out.value_ptr[i]
    cdef double z[6]
    cdef double s[6]
    cdef double y[6]
    cdef double projected[6]
    cdef friction_components_t q
    cdef double excess, gap, normal
    get_friction_components(b, i, &q)
    # the metric: one d for the rows of a component
    root[0] = sqrt(b.d[j])
    for g in range(q.n):
        for k in range(q.first[g], q.first[g] + q.size[g]):
            root[k] = sqrt(b.d[j + q.first[g]])
        q.friction_coefficient[g] = q.friction_coefficient[g] * root[q.first[g]] / root[0]
    for k in range(n):
        z[k] = root[k] * lam[j + k]
        s[k] = w[j + k] / root[k]
        y[k] = z[k] - s[k]
        margin[k] = INFINITY
    evaluate_natural_map(b.law, &q, n, z, s, projected, out.f + j, out.p + out.value_ptr[i])
    normal = projected[0]
    # dPi/de with a_g = e_g root_g / root_n
    differentiate_by_coefficients(b.law, &q, n, y, normal, edge)
    for g in range(q.n):
        for k in range(n):
            edge[k * n + q.first[g]] *= root[q.first[g]] / root[0]
    # cases and margins
    gap = -y[0]
    for g in range(q.n):
        first, size = q.first[g], q.size[g]
        excess = euclidean_norm(y + first, size)
        gap -= q.friction_coefficient[g] * excess
        excess -= q.friction_coefficient[g] * normal
        for k in range(first, first + size):
            out.case_[j + k] = (OPEN if not normal > 0.0
                                else STICKS if excess <= 0.0 and q.friction_coefficient[g] > 0.0 else SLIDES)
        if normal > 0.0 and q.friction_coefficient[g] > 0.0:
            margin[first] = fabs(excess) / root[first]
    out.case_[j] = CLOSED if normal > 0.0 else OPEN
    margin[0] = (normal if normal > 0.0 else gap if b.law == CONE else -y[0]) / root[0]


cdef inline void linearise_all_projections(const blocks_t* b, const double* lam, const double* w, int32_t* value_ptr,
                                           const natural_t* out) noexcept nogil:
    """Compute (1) and (2) of all blocks; `value_ptr` (k + 1) is the array of `out`."""
    cdef int32_t i, j, k, n
    value_ptr[0] = 0
    for i in range(b.n_blocks):
        j = b.ptr[i]
        n = b.ptr[i + 1] - j
        value_ptr[i + 1] = value_ptr[i] + (n if has_independent_rows(b, i) else n * n)
        if not has_independent_rows(b, i):
            linearise_contact_projection(b, i, lam, w, out)
            continue
        for k in range(n):
            out.root[j + k] = sqrt(b.d[j + k])
            linearise_row_projection(lam[j + k], w[j + k], b.lower[j + k], b.upper[j + k], out.root[j + k], out.f + j + k,
                          out.margin + j + k, out.case_ + j + k, out.p + value_ptr[i] + k)
            out.edge[value_ptr[i] + k] = 0.0


cdef inline int32_t number_system_rows(const blocks_t* b, const natural_t* x, int32_t* system_row) noexcept nogil:
    """Assign a row of G to each row that is not trivial in (3): closed contacts, rows between bounds. Return their number."""
    cdef int32_t i, j, n = 0
    for i in range(b.n_blocks):
        for j in range(b.ptr[i], b.ptr[i + 1]):
            system_row[j] = -1
            if x.case_[b.ptr[i]] != OPEN and x.case_[j] != LOW and x.case_[j] != HIGH:
                system_row[j] = n
                n += 1
    return n


cdef inline void multiply_block_derivatives(const natural_t* x, const blocks_t* b, const double* values, const double* v,
                                            bint transpose, double* out) noexcept nogil:
    """Compute out (m), the products of the blocks in `values`, or of their transposes, with v."""
    cdef int32_t i, j, k, l, n
    cdef const double* a
    cdef double s
    for i in range(b.n_blocks):
        j = b.ptr[i]
        n = b.ptr[i + 1] - j
        a = values + x.value_ptr[i]
        for k in range(n):
            if has_independent_rows(b, i):
                out[j + k] = a[k] * v[j + k]
                continue
            s = 0.0
            if x.case_[j] == OPEN:                      # The block of an open contact is 0.
                out[j + k] = s
                continue
            for l in range(n):
                s += a[l * n + k if transpose else k * n + l] * v[j + l]
            out[j + k] = s


cdef inline void form_scaled_csr(const csr_t* a, int32_t m, int32_t count, const int32_t* system_row, const double* root,
                                 double* h) noexcept nogil:
    """Compute H (count, count) of a matrix on the rows of G."""
    cdef int32_t i, q, c
    cdef double* row
    for i in range(m):
        if system_row[i] < 0:
            continue
        row = h + <ssize_t>system_row[i] * count
        for c in range(count):
            row[c] = 0.0
        for q in range(a.indptr[i], a.indptr[i + 1]):
            c = system_row[a.indices[q]]
            if c >= 0:
                row[c] += a.data[q] / (root[i] * root[a.indices[q]])


cdef inline void form_scaled_generalized(const generalized_t* g, int32_t count, const int32_t* system_row, const double* root,
                                         double* y, double* h) noexcept nogil:
    """Compute H (count, count) of J and M on the rows of G; y (count, nv) is scratch."""
    cdef int32_t i, k, c, b, nc, n = g.n
    cdef const double* from_
    cdef double* row
    cdef double x
    for c in range(count):
        for k in range(n):
            y[<ssize_t>c * n + k] = 0.0
    for b in range(g.n_panels):
        nc = g.pcol[b + 1] - g.pcol[b]
        from_ = g.y + g.pval[b]
        for i in range(g.prow[b], g.prow[b + 1]):
            if system_row[i] >= 0:
                row = y + <ssize_t>system_row[i] * n
                for k in range(nc):
                    row[g.cols[g.pcol[b] + k]] = from_[k] / root[i]
            from_ += nc
    for i in range(count):
        for c in range(i + 1):
            x = dot(y + <ssize_t>i * n, y + <ssize_t>c * n, n)
            h[<ssize_t>i * count + c] = x
            h[<ssize_t>c * count + i] = x
    for i in range(g.m):
        if system_row[i] >= 0:
            h[<ssize_t>system_row[i] * count + system_row[i]] += g.compliance[i] / (root[i] * root[i])


cdef inline void form_reduced_system(const natural_t* x, const blocks_t* b, int32_t count, const int32_t* system_row,
                                     const double* h, double* g) noexcept nogil:
    """Compute G (count, count) of (3) from H; system_row (m) is the row of G of each row, or -1."""
    cdef int32_t i, j, k, l, n, c
    cdef const double* p
    cdef double* row
    cdef const double* from_
    for i in range(b.n_blocks):
        j = b.ptr[i]
        n = b.ptr[i + 1] - j
        p = x.p + x.value_ptr[i]
        for k in range(n):
            if system_row[j + k] < 0:
                continue
            row = g + <ssize_t>system_row[j + k] * count
            if has_independent_rows(b, i):
                from_ = h + <ssize_t>system_row[j + k] * count
                for c in range(count):
                    row[c] = from_[c]
                continue
            for c in range(count):
                row[c] = 0.0
            for l in range(n):
                if p[k * n + l] != 0.0:
                    from_ = h + <ssize_t>system_row[j + l] * count
                    for c in range(count):
                        row[c] += p[k * n + l] * from_[c]
            for l in range(n):
                row[system_row[j + l]] -= p[k * n + l]
            row[system_row[j + k]] += 1.0
