"""The Newton systems of a scaled problem, for whichever of its forms: over bodies, or over rows of A.

    barrier   (H + W) dz = r               V = (W + theta)^-1 in `v`, B^T with V = B B^T in `bt`          (1)
    pair      the same for W^-1 = R^T L    of De Saxce's interior points, not symmetric; L in `pair`      (2)
    natural   (I - P + P (H + eps)) dz = r P in the derivative of the natural map                         (3)

Bodies factor I + K^T V K (elements.pxd). Rows factor M = L H R^T + o L + I, for bounded rows H + W: dense ones here
(factor/dense.pxd), in (3) the rows alone where P is not 0; sparse ones by whom the caller names. The augmented system of the
bodies, [I -R K^T; L K I], is the caller's too: without one these stages are left out.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

from lavender_ext.core.csr cimport csr_dot
from lavender_ext.core.validate cimport norm_inf
from lavender_ext.core.dot cimport dot
from lavender_ext.core.block_types cimport CONE
from lavender_ext.core.view cimport csr_t
from lavender_ext.factor.blocks cimport block_matrix_t, factor_blocks
from lavender_ext.factor.dense cimport (cholesky_workspace_size, dense_cholesky, dense_cholesky_solve, dense_lu, dense_lu_sign,
                                        dense_lu_solve)
from lavender_ext.factor.supernodal cimport solve_supernodes, supernodal_lu_sign
from lavender_ext.newton.cones cimport is_high, is_low
from lavender_ext.newton.elements cimport element_times, elements_t, is_row
from lavender_ext.newton.natural_map cimport natural
from lavender_ext.newton.normal_matrix cimport normal_matrix
from lavender_ext.newton.panel cimport to_bodies, to_rows


cdef enum:                      # forms
    BODIES = 0
    DENSE = 1
    SPARSE = 2

cdef enum:                      # what is factored: (1), (2), (3)
    OF_BARRIER = 0
    OF_PAIR = 1
    OF_NATURAL = 2

cdef enum:                      # by what
    BY_NONE = 0
    BY_CHOLESKY = 1
    BY_LU = 2

cdef enum:
    ROUNDS = 2                  # of refinement


cdef struct others_t:           # factors that the caller makes
    void* at
    int32_t (*factor)(void* at, int32_t augmented, int32_t what, double eps) noexcept nogil
    void (*solve)(void* at, int32_t augmented, double* x) noexcept nogil       # (m), in place


cdef struct system_t:
    int32_t form
    int32_t symmetric           # A is
    int32_t augmented           # now: factors are those of the augmented system
    int32_t wide                # four lanes are one instruction
    int32_t factorisations
    int32_t by                  # the last dense factor
    int32_t n_free              # of it: rows that are solved for, -1 for all
    int32_t law                 # of the last natural map
    const elements_t* e
    const block_matrix_t* f           # BODIES
    const double* h             # (m, m) DENSE
    csr_t a                     # H, SPARSE
    const others_t* others      # or NULL
    double* whole               # (m, m) DENSE: the matrix, or L U
    double* lower               # (`dense_workspace_size`) L L^T, or scratch
    int32_t* swap               # (m)
    int32_t* free               # (m)
    double* v                   # small matrices
    double* einv
    double* p
    double* pair
    double* bt                  # or NULL
    double* t                   # (m)
    double* q                   # (m)
    double* y                   # (bodies s)


cdef inline int64_t dense_workspace_size(int64_t m, int32_t cones) noexcept nogil:
    """Values of `lower`; with cones it holds L H as well."""
    return m * m if cones else cholesky_workspace_size(<int32_t>m)


cdef inline void system_times(system_t* s, const double* x, double* out) noexcept nogil:
    """H x; x is not out."""
    cdef int32_t j, m = s.e.m
    if s.form == BODIES:
        to_bodies(s.e, s.f.n, x, s.y)
        to_rows(s.e, s.y, out)
        for j in range(m):
            out[j] += s.e.theta[j] * x[j]
    elif s.form == DENSE:
        for j in range(m):
            out[j] = dot(s.h + <int64_t>j * m, x, m)
    else:
        for j in range(m):
            out[j] = csr_dot(&s.a, j, x)


# -- dense rows ------------------------------------------------------------------------------------------------


cdef inline void times_left(const elements_t* e, const double* w, const double* h, double* out) noexcept nogil:
    """out = W H, both (m, m) row-major."""
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


cdef inline void form_natural(system_t* s, double eps) noexcept nogil:
    """M of (3) on the rows of elements that move: where P = 0 a row is that of I, and its dz = r."""
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
            y = s.whole + <int64_t>(n + r) * s.n_free
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


cdef inline void form_dense(system_t* s, int32_t what, double eps) noexcept nogil:
    cdef int32_t j, m = s.e.m
    cdef const elements_t* e = s.e
    s.n_free = -1
    if what == OF_NATURAL:
        form_natural(s, eps)
    elif s.bt == NULL:
        memcpy(s.whole, s.h, <int64_t>m * m * sizeof(double))
        for j in range(m):
            s.whole[<int64_t>j * (m + 1)] += 1.0 / s.v[j]       # inf for a row that no longer moves: the step fails
    else:
        times_left(e, s.bt if what == OF_BARRIER else s.pair, s.h, s.lower)
        for j in range(m):
            element_times(e, s.bt, s.lower + <int64_t>j * m, s.whole + <int64_t>j * m, False)
            s.whole[<int64_t>j * (m + 1)] += 1.0


cdef inline int32_t factor_dense(system_t* s, int32_t what, double eps) noexcept nogil:
    cdef int32_t n = s.e.m, symmetric = s.symmetric and what != OF_PAIR and (s.bt == NULL or what == OF_BARRIER)
    form_dense(s, what, eps)
    if s.n_free >= 0:
        n = s.n_free
    s.by = BY_NONE
    if symmetric and dense_cholesky(s.wide, n, s.whole, NULL, s.lower) == 0:
        s.by = BY_CHOLESKY
    elif dense_lu(s.wide, n, s.whole, s.swap, 0.0) == 0:
        s.by = BY_LU
    return s.by != BY_NONE


cdef inline void solve_dense(system_t* s, double* x) noexcept nogil:
    cdef int32_t j, n = s.e.m
    cdef double* y = x
    if s.n_free >= 0:
        n = s.n_free
        y = s.q
        for j in range(n):
            y[j] = x[s.free[j]]
    if s.by == BY_CHOLESKY:
        dense_cholesky_solve(n, s.lower, y)
    elif s.by == BY_LU:
        dense_lu_solve(n, s.whole, s.swap, y)
    else:
        for j in range(n):
            y[j] = 1.0 / 0.0                          # of a singular matrix: no number
    if s.n_free >= 0:
        for j in range(n):
            x[s.free[j]] = y[j]


# -- (1) to (3) ------------------------------------------------------------------------------------------------


cdef inline int32_t system_factor(system_t* s, int32_t what, double eps) noexcept nogil:
    """Factor (1), (2), or (3) of the last `system_natural`; 0 where a pivot was lost."""
    cdef int32_t lu
    s.factorisations += 1
    if s.augmented or s.form == SPARSE:
        return s.others.factor(s.others.at, s.augmented, what, eps)
    if s.form == DENSE:
        return factor_dense(s, what, eps)
    lu = what == OF_PAIR or (what == OF_NATURAL and s.law != CONE)
    normal_matrix(s.e, s.v, s.f, lu)
    s.by = BY_LU if lu else BY_CHOLESKY
    return factor_blocks(s.f, lu) == 0


cdef inline int32_t system_sign(const system_t* s) noexcept nogil:
    """Sign of the determinant of the last (3); 0 where the caller factors, who does not tell it."""
    if s.augmented or s.form == SPARSE:
        return 0
    if s.by != BY_LU:
        return s.by == BY_CHOLESKY
    if s.form == DENSE:
        return dense_lu_sign(s.e.m if s.n_free < 0 else s.n_free, s.whole, s.swap)
    return supernodal_lu_sign(&s.f.factor)


cdef inline void over_bodies(system_t* s, const double* x, double* out) noexcept nogil:
    # K N^-1 K^T x
    to_bodies(s.e, s.f.n, x, s.y)
    solve_supernodes(&s.f.factor, s.y, s.by == BY_LU)
    to_rows(s.e, s.y, out)


cdef inline void over_rows(system_t* s, double* x) noexcept nogil:
    if s.augmented or s.form == SPARSE:
        s.others.solve(s.others.at, s.augmented, x)
    else:
        solve_dense(s, x)


cdef inline void system_solve(system_t* s, int32_t what, const double* r, double* out) noexcept nogil:
    """dz of (1) or (2); r is not out."""
    cdef int32_t j, m = s.e.m
    cdef const double* left = s.pair if what == OF_PAIR else s.bt
    if s.form == BODIES and not s.augmented:
        element_times(s.e, s.v, r, s.t, False)
        over_bodies(s, s.t, s.q)
        for j in range(m):
            s.q[j] = r[j] - s.q[j]
        if s.bt == NULL:
            element_times(s.e, s.v, s.q, out, False)
        else:
            # B (B^T ...): V itself has lost the small end of its scaling to the large one.
            element_times(s.e, left, s.q, s.t, False)
            element_times(s.e, s.bt, s.t, out, True)
    elif s.bt != NULL:
        element_times(s.e, left, r, s.t, False)
        over_rows(s, s.t)
        element_times(s.e, s.bt, s.t, out, True)
    elif s.augmented:
        element_times(s.e, s.v, r, out, False)
        over_rows(s, out)
    else:
        memcpy(out, r, m * sizeof(double))
        over_rows(s, out)


cdef inline double system_natural(system_t* s, const double* z, const double* rest, int32_t law, double eps,
                                  double* f) noexcept nogil:
    """F of the map `law` into f, and the small matrices of its derivative; |F|."""
    s.law = law
    return natural(s.e, z, rest, law, eps, f, s.p, s.einv, s.v)


cdef inline void solve_natural(system_t* s, const double* r, double* out) noexcept nogil:
    """dz of (3); r is not out."""
    cdef int32_t j, m = s.e.m
    if s.form == BODIES and not s.augmented:
        element_times(s.e, s.einv, r, s.t, False)
        over_bodies(s, s.t, s.q)
        element_times(s.e, s.p, s.q, s.t, False)
        for j in range(m):
            s.t[j] = r[j] - s.t[j]
        element_times(s.e, s.einv, s.t, out, False)
        return
    if s.augmented or (s.form == SPARSE and s.bt != NULL):
        memcpy(out, r, m * sizeof(double))
    else:                                               # M_FF dz_F = r_F - P H_FN r_N, dz_N = r_N where P = 0
        memcpy(s.t, r, m * sizeof(double))
        if s.form == DENSE:
            for j in range(s.n_free):
                s.t[s.free[j]] = 0.0
        else:
            for j in range(m):
                s.t[j] = r[j] - s.p[j] * r[j]
        system_times(s, s.t, s.q)
        element_times(s.e, s.p, s.q, s.t, False)
        for j in range(m):
            out[j] = r[j] - s.t[j]
    over_rows(s, out)


cdef inline void natural_times(system_t* s, const double* dz, double* out) noexcept nogil:
    """(I - P) dz + P H dz"""
    cdef int32_t j
    system_times(s, dz, s.q)
    for j in range(s.e.m):
        s.q[j] -= dz[j]
    element_times(s.e, s.p, s.q, out, False)
    for j in range(s.e.m):
        out[j] += dz[j]


cdef inline void solve_refined(system_t* s, const double* rhs, double* x, double* r, double* dx) noexcept nogil:
    """(3) with its eps mostly refined away; the next Newton step does the rest. r, dx (m) are scratch."""
    cdef int32_t j, _, m = s.e.m
    cdef double left, last = 1.0 / 0.0, size = norm_inf(rhs, m)
    solve_natural(s, rhs, x)
    for _ in range(ROUNDS):
        natural_times(s, x, r)
        for j in range(m):
            r[j] = rhs[j] - r[j]
        left = norm_inf(r, m)
        if not left < 0.5 * last or left <= 1e-16 * size:
            return
        last = left
        solve_natural(s, r, dx)
        for j in range(m):
            x[j] += dx[j]


cdef inline void first_weights(system_t* s, double weight, double free_weight) noexcept nogil:
    """V of (1) for W = weight on rows that have a bound, `free_weight` on others."""
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
        x = free_weight if is_row(e, i) and not is_low(e, j) and not is_high(e, j) else weight
        for k in range(nr):
            s.v[q + k * nr + k] = 1.0 / (e.theta[j + k] + x)
            if s.bt != NULL:
                s.bt[q + k * nr + k] = sqrt(s.v[q + k * nr + k])
