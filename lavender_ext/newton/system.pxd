"""The linear systems of Newton's method in each form of the scaled problem: over bodies, or over the rows of A.

    barrier   (H + W) dz = r               V = (W + theta)^-1 in `v`, B^T with V = B B^T in `bt`          (1)
    pair      the same for W^-1 = R^T L    of De Saxce's interior points, not symmetric; L in `pair`      (2)
    natural   (I - P + P (H + eps)) dz = r P is the derivative of the projection in the natural map       (3)

Over bodies the matrix is I + K^T V K (elements.pxd). Over rows it is M = L H R^T + o L + I, or H + W for bounded rows
alone, dense or in compressed rows (coupled.pxd); a dense (3) has the rows with P != 0 only. All three are one `linear_t`
(factor/linear.pxd). The augmented system of the bodies, [I -R K^T; L K I], is factored by the caller (`external_t`).

If a pivot fails, L U replaces a dense L L^T, and the host's factorisation a sparse factor, or L U if there is none. If that
fails too, the step is infinite: an interior point and exchanges end, an inner problem of damped Newton or an Euler step
fails, and a path halves its step. Over bodies the factor stays: the step is 0 in the row of the failed pivot, and is used.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from lavender_ext.core.deadline cimport has_passed
from lavender_ext.core.csr cimport csr_row_dot
from lavender_ext.core.validate cimport all_finite, norm_inf
from lavender_ext.core.dot cimport dot
from lavender_ext.core.block_types cimport CONE
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.linear cimport (CHOLESKY, CHOLESKY_OR_LU, LU, NO_FACTOR, factor_linear_system_matrix,
                                         solve_linear_system, solve_linear_system_checked, linear_t)
from lavender_ext.newton.cones cimport has_lower_bound, has_upper_bound
from lavender_ext.newton.coupled cimport form_coupled_entries, coupled_t
from lavender_ext.newton.elements cimport multiply_by_element_matrices, elements_t, is_row
from lavender_ext.newton.natural_map cimport evaluate_all_natural_maps
from lavender_ext.newton.normal_matrix cimport form_normal_matrix
from lavender_ext.newton.panel cimport multiply_panel, multiply_panel_transpose


cdef enum:                      # forms
    BODIES = 0
    DENSE = 1
    SPARSE = 2

cdef enum:                      # kinds of system: (1), (2), (3) above
    BARRIER = 0
    PAIR = 1
    NATURAL = 2

cdef enum:
    REFINEMENT_STEPS = 2        # Refinements of (3), which remove eps; the next Newton step does the rest.


cdef struct external_t:         # factorisation of the augmented system by the caller
    void* at
    int32_t (*factor)(void* at, int32_t what, double eps) noexcept nogil
    void (*solve)(void* at, double* x) noexcept nogil       # x (m), in place


cdef struct system_t:
    int32_t form
    int32_t symmetric           # A is symmetric
    int32_t augmented           # the augmented system is factored and solved at present
    int32_t factorisations
    int32_t n_free              # number of rows of the last dense matrix; -1: all rows
    int32_t law                 # law of the last natural map
    const elements_t* e
    linear_t* linear            # the matrix of (1), (2) or (3)
    const double* h             # (m, m) DENSE
    csr_t a                     # H in compressed rows, SPARSE
    coupled_t coupled           # H in the pattern of the elements, SPARSE
    const external_t* others    # or NULL
    double* multiplied          # (m, m) DENSE with cones: L H, in the place of L L^T
    int32_t* free               # (m) rows of the last dense matrix
    double* v                   # small matrices of the elements
    double* einv
    double* p
    double* pair
    double* bt                  # or NULL
    double* t                   # (m)
    double* q                   # (m)
    double* y                   # (bodies s) BODIES, (m) SPARSE


cdef inline void multiply_system_matrix(system_t* s, const double* x, double* out) noexcept nogil:
    """Compute out = H x; out must not be x."""
    cdef int32_t j, m = s.e.m
    if s.form == BODIES:
        multiply_panel_transpose(s.e, s.linear.blocks.n, x, s.y)
        multiply_panel(s.e, s.y, out)
        for j in range(m):
            out[j] += s.e.theta[j] * x[j]
    elif s.form == DENSE:
        for j in range(m):
            out[j] = dot(s.h + <int64_t>j * m, x, m)
    else:
        for j in range(m):
            out[j] = csr_row_dot(&s.a, j, x)


# -- dense rows ------------------------------------------------------------------------------------------------


cdef inline void multiply_left_by_element_matrices(const elements_t* e, const double* w, const double* h,
                                                   double* out) noexcept nogil:
    """Compute out = W H with one small matrix W for each element; both are (m, m), row-major."""
    cdef int32_t i, j, k, r, c, nr, m = e.m
    cdef double x
    cdef double *y
    cdef const double *a
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        for r in range(nr):
            y = out + <int64_t>(j + r) * m
            memset(y, 0, m * sizeof(double))
            for c in range(nr):
                x = w[e.wptr[i] + r * nr + c]
                if x == 0.0:
                    continue
                a = h + <int64_t>(j + c) * m
                for k in range(m):
                    y[k] += x * a[k]


cdef inline void form_natural_matrix(system_t* s, double eps) noexcept nogil:
    """Form M of (3) on the elements with P != 0; the other rows of M are those of I, so that dz = r there."""
    cdef int32_t i, j, k, r, c, nr, n = 0
    cdef const elements_t* e = s.e
    cdef double x
    cdef double* y
    cdef const double* p
    cdef const double* h
    s.n_free = 0
    for i in range(e.n):
        nr = e.ptr[i + 1] - e.ptr[i]
        x = 0.0
        for k in range(nr * nr):
            x += fabs(s.p[e.wptr[i] + k])
        if x != 0.0:
            for k in range(e.ptr[i], e.ptr[i + 1]):
                s.free[s.n_free] = k
                s.n_free += 1
    for i in range(e.n):
        j = e.ptr[i]
        if n == s.n_free or s.free[n] != j:
            continue
        nr = e.ptr[i + 1] - j
        for r in range(nr):
            p = s.p + e.wptr[i] + r * nr
            y = s.linear.matrix + <int64_t>(n + r) * s.n_free
            h = s.h + <int64_t>j * e.m
            if nr == 1:
                for k in range(s.n_free):
                    y[k] = p[0] * h[s.free[k]]
            elif nr == 3:
                for k in range(s.n_free):
                    c = s.free[k]
                    y[k] = (p[0] * h[c] + p[1] * h[e.m + c]) + p[2] * h[2 * <int64_t>e.m + c]
            else:
                for k in range(s.n_free):
                    y[k] = 0.0
                    for c in range(nr):
                        y[k] += p[c] * h[<int64_t>c * e.m + s.free[k]]
            for c in range(nr):
                y[n + c] += p[c] * (eps - 1.0)
            y[n + r] += 1.0
        n += nr


cdef inline void form_dense_matrix(system_t* s, int32_t what, double eps) noexcept nogil:
    """Form the dense matrix of a system."""
    cdef int32_t j, m = s.e.m
    cdef const elements_t* e = s.e
    s.n_free = -1
    if what == NATURAL:
        form_natural_matrix(s, eps)
    elif s.bt == NULL:
        memcpy(s.linear.matrix, s.h, <int64_t>m * m * sizeof(double))
        for j in range(m):
            s.linear.matrix[<int64_t>j * (m + 1)] += 1.0 / s.v[j]       # Infinite for a row at its bound: the step then fails.
    else:
        multiply_left_by_element_matrices(e, s.bt if what == BARRIER else s.pair, s.h, s.multiplied)
        for j in range(m):
            multiply_by_element_matrices(e, s.bt, s.multiplied + <int64_t>j * m, s.linear.matrix + <int64_t>j * m, False)
            s.linear.matrix[<int64_t>j * (m + 1)] += 1.0


cdef inline int32_t factor_sparse(system_t* s, int32_t what, double eps) noexcept nogil:
    """Form and factor the sparse matrix of a system; return 0 if that fails."""
    cdef int32_t j
    cdef linear_t* f = s.linear
    if what == NATURAL:
        form_coupled_entries(&s.coupled, s.e, s.p, s.p if s.bt == NULL else NULL, eps - 1.0, f.rows.data)
    elif s.bt != NULL:
        form_coupled_entries(&s.coupled, s.e, s.bt if what == BARRIER else s.pair, s.bt, 0.0, f.rows.data)
    else:
        memcpy(f.rows.data, s.coupled.h, s.coupled.indptr[s.e.m] * sizeof(double))
        for j in range(s.e.m):
            f.rows.data[s.coupled.diagonal[j]] += 1.0 / s.v[j]      # Infinite for a row at its bound: the step then fails.
    f.factored, f.by = NO_FACTOR, LU
    f.d = NULL          # C++ converts no NULL through a temporary.
    if not all_finite(f.rows.data, s.coupled.indptr[s.e.m]):
        return 0
    if s.symmetric and what != PAIR and (s.bt == NULL or what == BARRIER):
        f.by, f.d = CHOLESKY, s.q
        for j in range(s.e.m):
            s.q[j] = f.rows.data[s.coupled.diagonal[j]]         # A pivot is compared with its diagonal entry.
        if factor_linear_system_matrix(f) == 0 or f.fallback != NULL or f.deadline != NULL and f.deadline.passed:
            return f.pivots.small == 0
        f.by = LU
        f.d = NULL
    return factor_linear_system_matrix(f) == 0


cdef inline int32_t factor_dense(system_t* s, int32_t what, double eps) noexcept nogil:
    """Form and factor the dense matrix of a system; return 0 if a pivot fails."""
    form_dense_matrix(s, what, eps)
    s.linear.n = s.e.m if s.n_free < 0 else s.n_free
    s.linear.by = CHOLESKY_OR_LU if s.symmetric and what != PAIR and (s.bt == NULL or what == BARRIER) else LU
    return factor_linear_system_matrix(s.linear) == 0


# -- (1) to (3) ------------------------------------------------------------------------------------------------


cdef inline bint has_passed_after_part(const system_t* s) noexcept nogil:
    """Count a sixth of a step without its factorisation, and return whether the deadline has passed.

    A step takes 306 ns per row: "row" of the rates.
    """
    return has_passed(s.linear.deadline, 51.0 * s.e.m)


cdef inline int32_t factor_newton_system(system_t* s, int32_t what, double eps) noexcept nogil:
    """Factor (1), (2), or (3) with the last `evaluate_system_natural_map`; return 0 if a pivot fails, or after the deadline."""
    if has_passed_after_part(s):
        return 0
    s.factorisations += 1
    if s.augmented:
        return s.others.factor(s.others.at, what, eps)
    if s.form == DENSE:
        return factor_dense(s, what, eps)
    if s.form == SPARSE:
        return factor_sparse(s, what, eps)
    s.linear.by = LU if what == PAIR or (what == NATURAL and s.law != CONE) else CHOLESKY
    form_normal_matrix(s.e, s.v, &s.linear.blocks, s.linear.by == LU)
    return factor_linear_system_matrix(s.linear) == 0


cdef inline void apply_body_inverse(system_t* s, const double* x, double* out) noexcept nogil:
    """Compute out = K N^-1 K^T x."""
    multiply_panel_transpose(s.e, s.linear.blocks.n, x, s.y)
    solve_linear_system(s.linear, s.y)
    multiply_panel(s.e, s.y, out)


cdef inline void solve_over_rows(system_t* s, double* x) noexcept nogil:
    """Solve over the rows of A with the last factor, in place. x is infinite for a singular matrix: the caller rejects it."""
    cdef int32_t j
    if s.augmented:
        s.others.solve(s.others.at, x)
    elif s.form == DENSE and s.n_free < 0:
        solve_linear_system(s.linear, x)
    elif s.form == DENSE:
        for j in range(s.n_free):
            s.q[j] = x[s.free[j]]
        solve_linear_system(s.linear, s.q)
        for j in range(s.n_free):
            x[s.free[j]] = s.q[j]
    else:
        memcpy(s.y, x, s.e.m * sizeof(double))
        if not solve_linear_system_checked(s.linear, s.y, x, s.q):
            for j in range(s.e.m):
                x[j] = 1.0 / 0.0


cdef inline void solve_newton_system(system_t* s, int32_t what, const double* r, double* out) noexcept nogil:
    """Solve (1) or (2) for dz in `out`, which must not be r."""
    cdef int32_t j, m = s.e.m
    cdef const double* left = s.pair if what == PAIR else s.bt
    has_passed_after_part(s)
    if s.form == BODIES and not s.augmented:
        multiply_by_element_matrices(s.e, s.v, r, s.t, False)
        apply_body_inverse(s, s.t, s.q)
        for j in range(m):
            s.q[j] = r[j] - s.q[j]
        if s.bt == NULL:
            multiply_by_element_matrices(s.e, s.v, s.q, out, False)
        else:
            # Apply B and B^T one after the other: in V the small entries of the scaling are lost in the large ones.
            multiply_by_element_matrices(s.e, left, s.q, s.t, False)
            multiply_by_element_matrices(s.e, s.bt, s.t, out, True)
    elif s.bt != NULL:
        multiply_by_element_matrices(s.e, left, r, s.t, False)
        solve_over_rows(s, s.t)
        multiply_by_element_matrices(s.e, s.bt, s.t, out, True)
    elif s.augmented:
        multiply_by_element_matrices(s.e, s.v, r, out, False)
        solve_over_rows(s, out)
    else:
        memcpy(out, r, m * sizeof(double))
        solve_over_rows(s, out)


cdef inline double evaluate_system_natural_map(system_t* s, const double* z, const double* slack, int32_t law, double eps,
                                  double* f) noexcept nogil:
    """Compute F of the natural map of `law` into f, and the small matrices of its derivative; return |F|."""
    s.law = law
    return evaluate_all_natural_maps(s.e, z, slack, law, eps, f, s.p, s.einv, s.v)


cdef inline void solve_natural_map_system(system_t* s, const double* r, double* out) noexcept nogil:
    """Solve (3) for dz in `out`, which must not be r."""
    cdef int32_t j, m = s.e.m
    has_passed_after_part(s)
    if s.form == BODIES and not s.augmented:
        multiply_by_element_matrices(s.e, s.einv, r, s.t, False)
        apply_body_inverse(s, s.t, s.q)
        multiply_by_element_matrices(s.e, s.p, s.q, s.t, False)
        for j in range(m):
            s.t[j] = r[j] - s.t[j]
        multiply_by_element_matrices(s.e, s.einv, s.t, out, False)
        return
    if s.augmented or (s.form == SPARSE and s.bt != NULL):
        memcpy(out, r, m * sizeof(double))
    else:                                               # M_FF dz_F = r_F - P H_FN r_N, and dz_N = r_N for P = 0.
        memcpy(s.t, r, m * sizeof(double))
        if s.form == DENSE:
            for j in range(s.n_free):
                s.t[s.free[j]] = 0.0
        else:
            for j in range(m):
                s.t[j] = r[j] - s.p[j] * r[j]
        multiply_system_matrix(s, s.t, s.q)
        multiply_by_element_matrices(s.e, s.p, s.q, s.t, False)
        for j in range(m):
            out[j] = r[j] - s.t[j]
    solve_over_rows(s, out)


cdef inline void multiply_by_natural_map_derivative(system_t* s, const double* dz, double* out) noexcept nogil:
    """Compute out (m) = (I - P) dz + P H dz, the derivative of the natural map times dz (m)."""
    cdef int32_t j
    multiply_system_matrix(s, dz, s.q)
    for j in range(s.e.m):
        s.q[j] -= dz[j]
    multiply_by_element_matrices(s.e, s.p, s.q, out, False)
    for j in range(s.e.m):
        out[j] += dz[j]


cdef inline void solve_natural_map_system_refined(system_t* s, const double* rhs, double* x, double* r, double* dx) noexcept nogil:
    """Solve (3) with refinement, which removes the effect of eps; r, dx (m) are scratch."""
    cdef int32_t j, _, m = s.e.m
    cdef double left, last = 1.0 / 0.0, size = norm_inf(rhs, m)
    solve_natural_map_system(s, rhs, x)
    for _ in range(REFINEMENT_STEPS):
        multiply_by_natural_map_derivative(s, x, r)
        for j in range(m):
            r[j] = rhs[j] - r[j]
        left = norm_inf(r, m)
        if not left < 0.5 * last or left <= 1e-16 * size:
            return
        last = left
        solve_natural_map_system(s, r, dx)
        for j in range(m):
            x[j] += dx[j]


cdef inline void set_first_weights(system_t* s, double weight, double free_weight) noexcept nogil:
    """Set V of (1) with W = weight on rows with a bound, and `free_weight` on the others."""
    cdef int32_t i, j, k, q, nr
    cdef double x
    cdef const elements_t* e = s.e
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        for k in range(nr * nr):
            s.v[q + k] = 0.0
            if s.bt != NULL:
                s.bt[q + k] = 0.0
        x = free_weight if is_row(e, i) and not has_lower_bound(e, j) and not has_upper_bound(e, j) else weight
        for k in range(nr):
            s.v[q + k * nr + k] = 1.0 / (e.theta[j + k] + x)
            if s.bt != NULL:
                s.bt[q + k * nr + k] = sqrt(s.v[q + k * nr + k])
