"""Block Gauss-Seidel: preparation of the diagonal blocks of A, and sweeps of exact block updates.

The prepared numbers of block i begin at g[start[i]]:

    one row                      nothing: lam <- clip(lam - w / d)
    rows, 2 to 8, all free       1, then W^-1 (n, n); if W is singular, as bounded rows
    rows, 2 to 8, bounded        0, then `prepare_block_newton` of local/block_newton.pxd
    normal, two tangents, disk   `prepare_coulomb_disk` of local/coulomb.pxd, with 1 at ONE_PATTERN if its rows share one pattern
    other contacts               1 if there are three rows and they share one pattern, then `prepare_block_newton`

A sweep solves each block exactly with the others fixed: disks that stick, and sliding disks under Coulomb's law, by
local/coulomb.pxd, all others, and disks that it rejects, by local/block_newton.pxd:

    over A in compressed rows    w = A lam - b on the rows of the block                                  (1)
    over the factored form       w = J v + c lam - b, then v += M^-1 J^T (change)                   (2)
    over J and M                 w = Y u + c lam - b, then u += Y^T (change)                        (3)
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport project_normal_update, project_row_update
from lavender_ext.core.dot cimport dot
from lavender_ext.core.block_types cimport (CONE, blocks_t, is_disk_friction_contact, has_independent_rows, count_tangent_rows,
                                            count_angular_rows, friction_components_t, get_friction_components)
from lavender_ext.core.joint cimport relax_joint_block
from lavender_ext.core.row_forms cimport find_panel, row_form_t, compute_row_slack, set_row_impulse
from lavender_ext.core.rows cimport (apply_joint_impulse, get_block_jacobian, compute_contact_velocity, cross, dot12,
                                     joint_row_velocity, multiply_inverse_mass)
from lavender_ext.core.view cimport csr_t, generalized_t, rows_t, view_t
from lavender_ext.local.block_newton cimport prepare_block_newton, scaled_block_t, solve_block_newton
from lavender_ext.local.coulomb cimport ONE_PATTERN, PREPARED, update_coulomb_disk, update_sticking_disk, prepare_coulomb_disk
from lavender_ext.local.small cimport FAILED, MAX_ROWS, solve_by_elimination


cdef inline int32_t count_prepared_numbers(const blocks_t* p, int32_t i) noexcept nogil:
    """Return the number of prepared doubles of block i."""
    cdef int32_t n = p.ptr[i + 1] - p.ptr[i]
    if is_disk_friction_contact(p, i):
        return PREPARED
    return 0 if n == 1 or n > MAX_ROWS else 1 + n * (n + 2)


cdef inline void prepare_exact_block(const blocks_t* p, int32_t i, double* W, int32_t one_pattern, double* g) noexcept nogil:
    """Compute g from the diagonal block W (n, n) of A, which is overwritten; 1 < n <= MAX_ROWS."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, q, k, free = 1
    cdef double inf = 1.0 / 0.0
    cdef double a[MAX_ROWS * MAX_ROWS]
    cdef double x[MAX_ROWS]
    cdef friction_components_t components
    get_friction_components(p, i, &components)
    # contacts
    if not has_independent_rows(p, i):
        if is_disk_friction_contact(p, i):
            prepare_coulomb_disk(W, g)
            g[ONE_PATTERN] = one_pattern
            if W[0] != p.d[j]:
                g[9] = 0.0
            return
        if W[0] != p.d[j]:                              # d of the normal replaces a W_nn that is too small to divide by.
            W[0] = 0.0
        g[0] = one_pattern and n == 3
        prepare_block_newton(n, W, p.d + j, &components, g + 1)
        return
    # rows
    for q in range(j, p.ptr[i + 1]):
        if p.lower[q] != -inf or p.upper[q] != inf:
            free = 0
    for k in range(n if free else 0):
        for q in range(n * n):
            a[q] = W[q]
        for q in range(n):
            x[q] = 1.0 if q == k else 0.0
        if solve_by_elimination(n, a, x) < n:
            free = 0
            break
        for q in range(n):
            g[1 + n * q + k] = x[q]
    g[0] = free
    if not free:
        prepare_block_newton(n, W, p.d + j, &components, g + 1)


cdef int32_t solve_block_without_closed_form(const blocks_t* p, int32_t i, const double* g, const double* w,
                                             double* lam) noexcept nogil:
    """Solve block i by Newton's method; return 1 if this failed and projected steps were used, otherwise 0."""
    cdef int32_t j = p.ptr[i]
    cdef scaled_block_t x
    x.law, x.n, x.bounded = p.law, p.ptr[i + 1] - j, has_independent_rows(p, i)
    get_friction_components(p, i, &x.components)
    return solve_block_newton(&x, g, w, p.lower + j, p.upper + j, lam) == FAILED


cdef int32_t solve_disk_by_newton(const blocks_t* p, int32_t i, const double* g, const double* w, double* lam) noexcept nogil:
    """Solve disk i, which slides or has no closed form, by Newton's method; return 1 if projected steps were used, otherwise 0.

    g has the numbers of `prepare_coulomb_disk`.
    """
    cdef double h[15]
    cdef friction_components_t components
    get_friction_components(p, i, &components)
    prepare_block_newton(3, g, p.d + p.ptr[i], &components, h)
    if not g[9] > 0.0:
        h[0] = 0.0
    return solve_block_without_closed_form(p, i, h, w, lam)


cdef inline int32_t solve_block_exactly(const blocks_t* p, int32_t i, const double* g, const double* w,
                                        double* lam) noexcept nogil:
    """Solve block i exactly from its slack w (n) [m/s] into lam (n) [N s]; return 1 if projected steps were used, otherwise 0."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, t
    cdef double x[MAX_ROWS]
    cdef double s
    # one row
    if n == 1:
        lam[0] = (project_row_update(lam[0], w[0], p.step[j], p.lower[j], p.upper[j]) if has_independent_rows(p, i)
                  else project_normal_update(lam[0], w[0], p.step[j]))
        return 0
    # free rows
    if has_independent_rows(p, i) and g[0] != 0.0:
        for k in range(n):
            s = 0.0
            for t in range(n):
                s += g[1 + n * k + t] * w[t]
            x[k] = s
        for k in range(n):
            lam[k] -= x[k]
        return 0
    if not is_disk_friction_contact(p, i):
        return solve_block_without_closed_form(p, i, g + 1, w, lam)
    # a disk
    if (update_sticking_disk(g, w, p.mu[i], lam) if p.law == CONE else update_coulomb_disk(g, w, p.mu[i], lam) != FAILED):
        return 0
    return solve_disk_by_newton(p, i, g, w, lam)


cdef inline void multiply_three_csr_rows(const csr_t* a, int32_t i, const double* x, double* out) noexcept nogil:
    """Compute rows i, i + 1, i + 2 of A x, which share one pattern."""
    cdef int32_t p, n = a.indptr[i + 1] - a.indptr[i]
    cdef const int32_t* idx = a.indices + a.indptr[i]
    cdef const double* u = a.data + a.indptr[i]
    cdef const double* v = a.data + a.indptr[i + 1]
    cdef const double* w = a.data + a.indptr[i + 2]
    cdef double s0 = 0.0, s1 = 0.0, s2 = 0.0, t0 = 0.0, t1 = 0.0, t2 = 0.0, y
    p = 0
    while p + 2 <= n:
        y = x[idx[p]]
        s0 += u[p] * y
        s1 += v[p] * y
        s2 += w[p] * y
        y = x[idx[p + 1]]
        t0 += u[p + 1] * y
        t1 += v[p + 1] * y
        t2 += w[p + 1] * y
        p += 2
    if p < n:
        y = x[idx[p]]
        s0 += u[p] * y
        s1 += v[p] * y
        s2 += w[p] * y
    out[0] = s0 + t0
    out[1] = s1 + t1
    out[2] = s2 + t2


cdef inline void compute_block_slack(const blocks_t* p, const row_form_t* form, int32_t i, const double* g, const double* lam,
                                     const double* v, double* w) noexcept nogil:
    """Compute the slacks w (n) of block i."""
    cdef int32_t j = p.ptr[i], panel = find_panel(form, i), k
    if row_form_t is csr_t:
        if (p.ptr[i + 1] - j == 3 and not has_independent_rows(p, i)
                and g[ONE_PATTERN if is_disk_friction_contact(p, i) else 0] != 0.0):
            multiply_three_csr_rows(form, j, lam, w)
            w[0] -= p.b[j]
            w[1] -= p.b[j + 1]
            w[2] -= p.b[j + 2]
            return
    for k in range(p.ptr[i + 1] - j):
        w[k] = compute_row_slack(form, p, panel, j + k, lam, v)


cdef inline int32_t solve_rows_block(const blocks_t* p, const row_form_t* form, int32_t i, const double* g, double* lam,
                                     double* v) noexcept nogil:
    """Update block i over A by (1), or over J and M by (3) with v = Y^T lam; return 1 if projected steps were used, otherwise 0."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, panel = find_panel(form, i), k, fallback
    cdef double w[MAX_ROWS]
    cdef double impulse[MAX_ROWS]
    if n > MAX_ROWS:                                    # Update so many bounded rows one by one.
        for k in range(j, j + n):
            w[0] = compute_row_slack(form, p, panel, k, lam, v)
            set_row_impulse(form, panel, k, project_row_update(lam[k], w[0], p.step[k], p.lower[k], p.upper[k]), lam, v)
        return 1
    compute_block_slack(p, form, i, g, lam, v, w)
    for k in range(n):
        impulse[k] = lam[j + k]
    fallback = solve_block_exactly(p, i, g, w, impulse)
    for k in range(n):
        set_row_impulse(form, panel, j + k, impulse[k], lam, v)
    return fallback


cdef inline void apply_contact_changes(double* v, double inv_mass, const double* inv_inertia_arm, const double* impulse,
                                       const double* change, int32_t n, double sign) noexcept nogil:
    """Apply the changes (n) of a contact's rows, with the linear `impulse`, to the velocity v (6) of one body; sign -1 for a."""
    cdef int32_t axis, k
    cdef double angular
    for axis in range(3):
        angular = change[0] * inv_inertia_arm[axis]
        for k in range(1, n):
            angular += change[k] * inv_inertia_arm[6 * k + axis]
        v[axis] += sign * (inv_mass * impulse[axis])
        v[3 + axis] += sign * angular


cdef inline int32_t solve_contact_block(const blocks_t* p, const rows_t* r, int32_t i, const double* g, double* lam, double* v,
                                        int32_t nt, int32_t n_angular) noexcept nogil:
    """Update contact i, with nt tangents, over bodies by (2); lam (n) are its impulses."""
    cdef int32_t j = p.ptr[i], c = i - r.n_joints, a = r.contact_body[2 * c], b = r.contact_body[2 * c + 1]
    cdef int32_t n = 1 + nt + (n_angular & 1) + (n_angular & 2), k, fallbacks
    cdef double w[6]
    cdef double change[6]
    cdef double t2[3]
    cdef double impulse[3]
    cdef const double* normal = r.normal + 3 * c
    cdef const double* t1 = r.tangent + 3 * c
    cdef const double* inv_inertia_arm = r.inv_inertia_arm + 6 * (j - p.ptr[r.n_joints])
    compute_contact_velocity(r, c, nt, n_angular, v, w)
    for k in range(n):
        w[k] += r.compliance[j + k] * lam[k] - p.b[j + k]
        change[k] = lam[k]
    fallbacks = solve_block_exactly(p, i, g, w, lam)
    for k in range(n):
        change[k] = lam[k] - change[k]
    if nt > 1:
        cross(normal, t1, t2)
    for k in range(3):
        impulse[k] = change[0] * normal[k] + (change[1] * t1[k] if nt > 0 else 0.0) + (change[2] * t2[k] if nt > 1 else 0.0)
    if a >= 0:
        apply_contact_changes(v + 6 * a, r.inv_mass[a], inv_inertia_arm, impulse, change, n, -1.0)
    if b >= 0:
        apply_contact_changes(v + 6 * b, r.inv_mass[b], inv_inertia_arm + 3, impulse, change, n, 1.0)
    return fallbacks


cdef inline int32_t solve_bodies_block(const blocks_t* p, const rows_t* r, int32_t i, const double* g, double* lam,
                                       double* v) noexcept nogil:
    """Update block i over bodies by (2); return 1 if projected steps were used, otherwise 0."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, a, b, fallbacks
    cdef double w[MAX_ROWS]
    cdef double previous[MAX_ROWS]
    if i >= r.n_joints:
        if is_disk_friction_contact(p, i):
            return solve_contact_block(p, r, i, g, lam + j, v, 2, 0)        # compiled with constant sizes
        return solve_contact_block(p, r, i, g, lam + j, v, count_tangent_rows(p, i), count_angular_rows(p, i))
    if n > MAX_ROWS:
        relax_joint_block(p, r, i, lam, v)
        return 1
    a, b = r.joint_body[2 * i], r.joint_body[2 * i + 1]
    for k in range(n):
        w[k] = joint_row_velocity(r.jac + 12 * (j + k), v, a, b) + r.compliance[j + k] * lam[j + k] - p.b[j + k]
        previous[k] = lam[j + k]
    fallbacks = solve_block_exactly(p, i, g, w, lam + j)
    for k in range(n):
        apply_joint_impulse(r.minv_jac + 12 * (j + k), lam[j + k] - previous[k], v, a, b)
    return fallbacks


cdef double index_prepared_numbers(const blocks_t* p, int32_t* start) noexcept nogil:
    """Write the first index of the prepared numbers of each block to start (k); return the total number."""
    cdef int32_t i
    cdef double n = 0
    for i in range(p.n_blocks):
        start[i] = <int32_t>n
        n += count_prepared_numbers(p, i)
    return n


cdef inline bint form_csr_diagonal_block(const blocks_t* p, const csr_t* a, int32_t i, double* W) noexcept nogil:
    """Extract the diagonal block W (n, n) of block i from A; return whether its rows share one pattern."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, q
    cdef bint one = True
    for k in range(n):
        for q in range(n):
            W[n * k + q] = 0.0
        if a.indptr[j + k + 1] - a.indptr[j + k] != a.indptr[j + 1] - a.indptr[j]:
            one = False
        for q in range(a.indptr[j + k], a.indptr[j + k + 1]):
            if j <= a.indices[q] < j + n:
                W[n * k + a.indices[q] - j] += a.data[q]
            if one and a.indices[q] != a.indices[q - a.indptr[j + k] + a.indptr[j]]:
                one = False
    return one


cdef inline void form_rows_diagonal_block(const blocks_t* p, const rows_t* r, int32_t i, double* W) noexcept nogil:
    """Compute the diagonal block W (n, n) of block i from J and M^-1."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, q, c = i - r.n_joints
    cdef double jac[72]
    cdef double minv_jac_row[12]
    cdef const double* row = get_block_jacobian(p, r, i, jac)
    cdef const double* change
    for k in range(n):
        change = r.minv_jac + 12 * (j + k)
        if c >= 0:
            multiply_inverse_mass(row + 12 * k, r.inv_mass, r.inv_inertia, r.contact_body[2 * c], r.contact_body[2 * c + 1],
                                  minv_jac_row)
            change = minv_jac_row
        for q in range(n):
            W[n * q + k] = dot12(row + 12 * q, change)
    for k in range(n):
        W[(n + 1) * k] += r.compliance[j + k]
    if c >= 0 and W[0] > 0.0:
        W[0] = p.d[j]                                   # W_nn has the bits of d, which is summed in another order.


cdef inline void form_generalized_diagonal_block(const blocks_t* p, const generalized_t* o, int32_t i, double* W) noexcept nogil:
    """Compute the diagonal block W (n, n) of block i from the rows of Y."""
    cdef int32_t j = p.ptr[i], n = p.ptr[i + 1] - j, k, q, b = o.home[i], nc = o.pcol[b + 1] - o.pcol[b]
    cdef const double* y = o.y + o.pval[b] + <ssize_t>(j - o.prow[b]) * nc
    for k in range(n):
        for q in range(n):
            W[n * k + q] = dot(y + k * nc, y + q * nc, nc)
    for k in range(n):
        W[(n + 1) * k] += o.compliance[j + k]


cdef void prepare_exact_blocks(const view_t* v, const int32_t* start, double* g) noexcept nogil:
    """Prepare the diagonal blocks of A in g (`index_prepared_numbers`, zero-initialised)."""
    cdef int32_t i
    cdef bint one
    cdef double W[MAX_ROWS * MAX_ROWS]
    for i in range(v.p.n_blocks):
        if count_prepared_numbers(&v.p, i) == 0:
            continue
        one = False
        if v.g != NULL:
            form_generalized_diagonal_block(&v.p, v.g, i, W)
        elif v.r != NULL:
            form_rows_diagonal_block(&v.p, v.r, i, W)
        else:
            one = form_csr_diagonal_block(&v.p, v.a, i, W)
        prepare_exact_block(&v.p, i, W, one, g + start[i])


ctypedef fused exact_form_t:
    csr_t
    generalized_t
    rows_t


cdef inline int32_t sweep_exact_blocks_of_form(const blocks_t* p, const exact_form_t* form, const int32_t* start,
                                               const double* g, const int32_t* order, double* lam, double* v) noexcept nogil:
    """Sweep once over one form of A; return the number of blocks for which projected steps were used."""
    cdef int32_t k, i, fallbacks = 0
    for k in range(p.n_blocks):
        i = order[k]
        if exact_form_t is rows_t:
            fallbacks += solve_bodies_block(p, form, i, g + start[i], lam, v)
        else:
            fallbacks += solve_rows_block(p, form, i, g + start[i], lam, v)
    return fallbacks


cdef int32_t sweep_exact_blocks(const blocks_t* p, const csr_t* a, const rows_t* r, const generalized_t* o, const int32_t* start,
                          const double* g, const int32_t* order, double* lam, double* v) noexcept nogil:
    """Sweep once over A (`a`), J and M (`o`) or bodies (`r`), with velocities v, in `order` (k).

    Return the number of blocks for which projected steps were used instead of an exact solution.
    """
    if o != NULL:
        return sweep_exact_blocks_of_form(p, o, start, g, order, lam, v)
    if a != NULL:
        return sweep_exact_blocks_of_form(p, a, start, g, order, lam, v)
    return sweep_exact_blocks_of_form(p, r, start, g, order, lam, v)
