"""The judge of quadratic programs in their own terms, and the equilibration of programs by powers of two.

    min 1/2 x.P x + q.x   subject to   (J x)_i = t_i for i < free,   (J x)_i >= t_i for the other rows

with multipliers lambda, P x + q = J^T lambda. P (both triangles) and J are compressed rows.

Error of a row and of a column, each relative to its own terms; |.| of a sum of terms is the largest term:

    row i       |J x - t|_i / tau_i          tau_i = |t_i|, or if t_i = 0:  max(|J_ij x_j|, FLOOR |J_ij| s_j)
    column j    |P x + q - J^T lambda|_j / c_j
                c_j = |q_j|, or if q_j = 0:  max(|P_jk x_k|, FLOOR P_jj s_j, |J_ij| clip(|lambda_i|, FLOOR Y_i, Y_i / FLOOR))

    s_j   size of variable j: max(|x_j|, |q_j| / P_jj, |P_jk x_k| / P_jj, r_j)
    r_j   size by rows, with own_i = max(|t_i|, |J_ij x_j|): the smallest own_i / |J_ij| over the rows near their bound with
          t_i != 0. Without one, the largest over such rows with t_i = 0, or if that is more, FAR_SHARE of the smallest over the
          rows far from their bound with t_i != 0
    Y_i   size of multiplier i: the smallest nonzero f_j / |J_ij| of its row, f_j = max(|q_j|, P_jj s_j). Of a row without one,
          f_j is the largest |J_kj| Y_k of the other rows

Complementarity is exact. An inequality is active if the share of its multiplier, max_j |J_ij lambda_i| / c_j, exceeds the share
of its slack, |J x - t|_i / max(own_i, tau_i), both with FAR_SHARE = 1. Then its slack counts like that of an equation.
Otherwise, and if lambda_i < 0, lambda_i is set to 0, and the columns contain the effect. Of an inequality that is not active,
only a violation counts. Up to ROUNDING roundings of the sum of a row's or column's terms count as 0. So (x, lambda) solves a
program exactly in which each t_i and q_j differs by at most `error` of itself (of its floor if it is 0). The error does not
change with units of the cost, of a row or of a variable.
"""
from libc.math cimport INFINITY, exp, exp2, fabs, isfinite, log, log2, round, sqrt
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer
from lavender_ext.core.problem cimport Workspace, allocate_bytes

# Share of the size of a variable (multiplier) at which the scale of a row (column) without terms of its own ends.
cdef double FLOOR = 1e-3
cdef double ROUNDING = 64.0 * 2.0**-53
# A row is near its bound if its slack is at most this share of its terms.
cdef double NEAR_BOUND = 1e-3
# With FLOOR, a placeholder bound of 1e9 gives a variable without other terms the scale 1.
cdef double FAR_SHARE = 1e-6
cdef int EQUILIBRATION_SWEEPS = 4
cdef double PLACEHOLDER = 1e18  # Larger numbers have no part in the size of the variables.


cdef struct csr_t:
    Py_ssize_t m, n
    const int32_t* ptr
    const int32_t* idx
    const double* val


cdef csr_t read_csr(object arrays, Py_ssize_t m, Py_ssize_t n) except *:
    """Return the addresses of compressed rows (indptr, indices, data)."""
    cdef csr_t a
    a.m, a.n = m, n
    a.ptr = as_int_pointer(arrays[0], m + 1)
    a.idx = as_int_pointer(arrays[1], len(arrays[1]))
    a.val = as_double_pointer(arrays[2], len(arrays[2]))
    return a


cdef inline double ratio_or_inf(double x, double scale) noexcept nogil:
    """Return x / scale; if scale is 0, inf for positive x, otherwise 0."""
    return x / scale if scale > 0.0 else INFINITY if x > 0.0 else 0.0


cdef struct scales_t:
    # Terms of a point, and the scales of its rows and columns.
    const double* q
    const double* t
    const double* lam
    const double* p_terms       # (n) largest |P_jk x_k|
    const double* diagonal      # (n) P_jj
    const double* own           # (m)
    double* size                # (n) s
    double* f                   # (n)
    double* c                   # (n)
    double* tau                 # (m)
    double* y                   # (m) Y; inf without one


cdef void compute_scales(const csr_t* a, scales_t* s) noexcept nogil:
    """Compute c and tau from the sizes of the variables, without the strict scales |q_j| and |t_i|."""
    cdef Py_ssize_t i, j, k
    cdef double v, term
    cdef bint has_zero = False
    for j in range(a.n):
        s.c[j] = max(fabs(s.q[j]), s.p_terms[j])
        has_zero |= s.q[j] == 0.0
    for i in range(a.m):
        s.tau[i] = s.own[i]
        has_zero |= s.t[i] == 0.0
    if not has_zero:                                    # The sizes have no effect.
        return
    for j in range(a.n):
        s.f[j] = max(fabs(s.q[j]), s.diagonal[j] * s.size[j])
        if s.q[j] == 0.0:
            s.c[j] = max(s.c[j], FLOOR * s.diagonal[j] * s.size[j])
    for i in range(a.m):
        v, s.y[i] = 0.0, INFINITY
        for k in range(a.ptr[i], a.ptr[i + 1]):
            term = fabs(a.val[k])
            v = max(v, term * s.size[a.idx[k]])
            if term > 0.0 and s.f[a.idx[k]] > 0.0:
                s.y[i] = min(s.y[i], s.f[a.idx[k]] / term)
        if s.t[i] == 0.0:
            s.tau[i] = max(s.tau[i], FLOOR * v)
    # Rows of variables without a cost: their multipliers balance the multipliers of other rows.
    for j in range(a.n):
        s.f[j] = 0.0
    for i in range(a.m):
        if s.y[i] < INFINITY:
            for k in range(a.ptr[i], a.ptr[i + 1]):
                s.f[a.idx[k]] = max(s.f[a.idx[k]], fabs(a.val[k]) * s.y[i])
    for i in range(a.m):
        if s.y[i] == INFINITY:
            for k in range(a.ptr[i], a.ptr[i + 1]):
                if a.val[k] != 0.0 and s.f[a.idx[k]] > 0.0:
                    s.y[i] = min(s.y[i], s.f[a.idx[k]] / fabs(a.val[k]))
        v = fabs(s.lam[i])
        if s.y[i] < INFINITY:
            v = min(max(v, FLOOR * s.y[i]), s.y[i] / FLOOR)
        for k in range(a.ptr[i], a.ptr[i + 1]):
            if s.q[a.idx[k]] == 0.0:
                s.c[a.idx[k]] = max(s.c[a.idx[k]], fabs(a.val[k]) * v)


def judge_program(hessian, q_, jac, t_, lam_, x_, int32_t free):
    """Judge x (n,) and lambda (m,) of a program by the formulas of the module.

    Returns
    -------
    error : float
    raw : float
        The error without the allowance for rounding.
    row_error, column_error : float
        Parts of `error`.
    active : (m,) bool
        Equations, and inequalities that are active.
    lam : (m,)
        Complementary multipliers.
    primal, dual, gap : float
        Residuals of the given multipliers in the units of the program: the largest violation of a row; the largest
        |P x + q - J^T lambda| and -lambda of an inequality; |x.(P x + q) - t.lambda|.
    """
    cdef Py_ssize_t i, j, k, n = len(x_), m = len(lam_)
    cdef const double* x = as_double_pointer(x_, n)
    cdef const double* q = as_double_pointer(q_, n)
    cdef const double* t = as_double_pointer(t_, m)
    cdef csr_t p = read_csr(hessian, n, n)
    cdef csr_t a = read_csr(jac, m, n)
    complementary = np.array(lam_)
    active_ = np.zeros(m, bool)
    cdef double* lam = as_double_pointer(complementary, m)
    cdef unsigned char[::1] active = active_.view(np.uint8)
    cdef Workspace workspace = allocate_bytes((11 * n + 6 * m + 1) * sizeof(double))
    cdef double* px = <double*>workspace.at             # (n) P x
    cdef double* p_terms = px + n                       # (n) largest |P_jk x_k|
    cdef double* p_sum = p_terms + n                    # (n) |P| |x| + |q|
    cdef double* diagonal = p_sum + n
    cdef double* size = diagonal + n                    # (n) s
    cdef double* near_size = size + n                   # (n) own_i / |J_ij| of rows near their bound with t_i != 0
    cdef double* zero_size = near_size + n              # (n) the same with t_i = 0
    cdef double* far_size = zero_size + n               # (n) the same of rows far from their bound with t_i != 0
    cdef double* c = far_size + n
    cdef double* force = c + n                          # (n) J^T lambda
    cdef double* force_sum = force + n                  # (n) |J|^T |lambda|
    cdef double* gap = force_sum + n                    # (m) J x - t
    cdef double* own = gap + m
    cdef double* row_sum = own + m                      # (m) |J| |x| + |t|
    cdef double* tau = row_sum + m
    cdef double* y = tau + m                            # (m) Y
    cdef double* given = y + m                          # (m) lambda as given
    cdef scales_t scales = scales_t(q, t, lam, p_terms, diagonal, own, size, force, c, tau, y)
    cdef double v, share, rounding, excess, scale
    cdef double row_error = 0.0, column_error = 0.0, raw = 0.0, primal = 0.0, dual = 0.0, total = 0.0
    cdef bint has_cost = False, at_bound
    for j in range(n):
        if not isfinite(x[j]):
            return INFINITY, INFINITY, INFINITY, INFINITY, active_, complementary, INFINITY, INFINITY, INFINITY
    # Columns: P x with its terms, and sizes of the variables by themselves and by curvature.
    for j in range(n):
        px[j] = p_terms[j] = diagonal[j] = force[j] = force_sum[j] = 0.0
        p_sum[j] = fabs(q[j])
        near_size[j] = far_size[j] = INFINITY
        zero_size[j] = 0.0
        for k in range(p.ptr[j], p.ptr[j + 1]):
            v = p.val[k] * x[p.idx[k]]
            px[j] += v
            p_sum[j] += fabs(v)
            p_terms[j] = max(p_terms[j], fabs(v))
            has_cost |= p.val[k] != 0.0
            if p.idx[k] == j:
                diagonal[j] = p.val[k]
        has_cost |= q[j] != 0.0
        size[j] = fabs(x[j])
        if diagonal[j] > 0.0:
            size[j] = max(size[j], max(fabs(q[j]), p_terms[j]) / diagonal[j])
    # Rows: J x - t with its terms, and sizes of the variables by rows.
    for i in range(m):
        gap[i], own[i], row_sum[i] = -t[i], fabs(t[i]), fabs(t[i])
        for k in range(a.ptr[i], a.ptr[i + 1]):
            v = a.val[k] * x[a.idx[k]]
            gap[i] += v
            row_sum[i] += fabs(v)
            own[i] = max(own[i], fabs(v))
        at_bound = i < free or gap[i] <= NEAR_BOUND * own[i]
        for k in range(a.ptr[i], a.ptr[i + 1]):
            if a.val[k] == 0.0 or own[i] == 0.0:
                continue
            j, v = a.idx[k], own[i] / fabs(a.val[k])
            if at_bound and t[i] != 0.0:
                near_size[j] = min(near_size[j], v)
            elif at_bound:
                zero_size[j] = max(zero_size[j], v)
            elif t[i] != 0.0:
                far_size[j] = min(far_size[j], v)
        given[i] = lam[i]
        if not isfinite(lam[i]) or (i >= free and lam[i] < 0.0) or not has_cost:
            lam[i] = 0.0
    for j in range(n):
        if near_size[j] < INFINITY:
            size[j] = max(size[j], near_size[j])
            far_size[j] = 0.0
        else:
            size[j] = max(size[j], zero_size[j])
            far_size[j] = far_size[j] if far_size[j] < INFINITY else 0.0
        zero_size[j] = size[j]
        size[j] = max(size[j], far_size[j])
    # Complementarity, with the larger sizes of the variables.
    compute_scales(&a, &scales)
    for i in range(m):
        share = 0.0
        for k in range(a.ptr[i], a.ptr[i + 1]):
            if c[a.idx[k]] > 0.0:
                share = max(share, fabs(lam[i] * a.val[k]) / c[a.idx[k]])
        active[i] = i < free or share > ratio_or_inf(fabs(gap[i]), tau[i])
    for i in range(m):
        if not active[i]:
            lam[i] = 0.0
    for j in range(n):
        size[j] = max(zero_size[j], FAR_SHARE * far_size[j])
    compute_scales(&a, &scales)
    for j in range(n):
        force[j] = 0.0
    # Errors of rows.
    for i in range(m):
        for k in range(a.ptr[i], a.ptr[i + 1]):
            force[a.idx[k]] += a.val[k] * lam[i]
            force_sum[a.idx[k]] += fabs(a.val[k] * lam[i])
        if i < free or gap[i] < 0.0:
            primal = max(primal, fabs(gap[i]))
        if active[i] or gap[i] < 0.0:
            scale = tau[i] if t[i] == 0.0 else fabs(t[i])
            excess = max(fabs(gap[i]) - ROUNDING * row_sum[i], 0.0)
            row_error = max(row_error, ratio_or_inf(excess, scale))
            raw = max(raw, ratio_or_inf(fabs(gap[i]), scale))
    # Errors of columns.
    for j in range(n):
        v = fabs(px[j] + q[j] - force[j])
        scale = c[j] if q[j] == 0.0 else fabs(q[j])
        rounding = ROUNDING * (p_sum[j] + force_sum[j])
        column_error = max(column_error, ratio_or_inf(max(v - rounding, 0.0), scale))
        raw = max(raw, ratio_or_inf(v, scale))
        total += x[j] * (px[j] + q[j])
        force[j] = 0.0
    # Residuals of the multipliers as given.
    for i in range(m):
        total -= t[i] * given[i]
        if i >= free:
            dual = max(dual, -given[i])
        for k in range(a.ptr[i], a.ptr[i + 1]):
            force[a.idx[k]] += a.val[k] * given[i]
    for j in range(n):
        dual = max(dual, fabs(px[j] + q[j] - force[j]))
    v = max(row_error, column_error)
    if not (v == v and total == total):
        v = raw = INFINITY
    return v, raw, row_error, column_error, active_, complementary, primal, dual, fabs(total)


def scale_rows(rows, row_scale_, column_scale_):
    """Return compressed rows with new arrays, entry (i, j) multiplied by row_scale_[i] column_scale_[j]."""
    cdef Py_ssize_t i, k, m = len(row_scale_)
    cdef csr_t a = read_csr(rows, m, len(column_scale_))
    cdef const double* e = as_double_pointer(row_scale_, m)
    cdef const double* d = as_double_pointer(column_scale_, len(column_scale_))
    value_ = np.empty(len(rows[2]))
    cdef double* value = as_double_pointer(value_, len(value_))
    for i in range(m):
        for k in range(a.ptr[i], a.ptr[i + 1]):
            value[k] = a.val[k] * e[i] * d[a.idx[k]]
    return np.array(rows[0]), np.array(rows[1]), value_     # Copies, because SciPy sorts indices in place.


cdef inline double power_of_two(double x) noexcept nogil:
    """Return the power of two nearest to a positive number in logarithm; 1 for other numbers."""
    return exp2(round(log2(x))) if 0.0 < x < INFINITY else 1.0


def equilibrate_program(hessian, q_, jac, t_, variable_, int32_t free):
    """Return the scales (D, E, sigma, c) of a program, all powers of two.

    x = sigma D x', rows are multiplied by E, the cost by c. D and E are found by sweeps of Ruiz on [g P, J^T; J, 0], with g so
    that the median column of the scaled P has size 1, and then E from the largest entry of each row. sigma is the geometric
    mean of |q_j| / P_jj and of the right-hand sides that x = 0 violates, in scaled units. c makes the largest entry of the
    scaled P and q equal to 1. variable_ (m,) is the variable of a row that is a bound, -1 for other rows; E = 1 / D on bounds.

    Returns
    -------
    D : (n,)
    E : (m,)
    sigma, c : float
    """
    cdef Py_ssize_t i, j, k, _sweep, count = 0, n = len(q_), m = len(t_)
    cdef const double* q = as_double_pointer(q_, n)
    cdef const double* t = as_double_pointer(t_, m)
    cdef const int32_t* variable = as_int_pointer(variable_, m)
    cdef csr_t p = read_csr(hessian, n, n)
    cdef csr_t a = read_csr(jac, m, n)
    d_, e_ = np.ones(n), np.ones(m)
    cdef double* d = as_double_pointer(d_, n)
    cdef double* e = as_double_pointer(e_, m)
    column_, curvature_ = np.empty(n), np.empty(n)
    cdef double* column = as_double_pointer(column_, n)
    cdef double* curvature = as_double_pointer(curvature_, n)
    cdef double v, gamma = 1.0, logarithms = 0.0, largest = 0.0, sigma = 1.0, fallback = 0.0
    cdef Py_ssize_t n_fallback = 0
    for _sweep in range(-1, EQUILIBRATION_SWEEPS):
        for j in range(n):
            v = 0.0
            for k in range(p.ptr[j], p.ptr[j + 1]):
                v = max(v, fabs(p.val[k]) * d[p.idx[k]])
            curvature[j] = v * d[j]
        positive = curvature_[curvature_ > 0.0]
        if len(positive):
            gamma = 1.0 / float(np.sort(positive)[len(positive) // 2])
        for j in range(n):
            column[j] = gamma * curvature[j]
        for i in range(m):
            if variable[i] >= 0:
                continue
            v = 0.0
            for k in range(a.ptr[i], a.ptr[i + 1]):
                j = a.idx[k]
                column[j] = max(column[j], fabs(a.val[k]) * e[i] * d[j])
                v = max(v, fabs(a.val[k]) * d[j])
            if v > 0.0:                                 # first to 1, so that the units of rows have no effect
                e[i] = 1.0 / v if _sweep < 0 else e[i] / sqrt(v * e[i])
        for j in range(n):
            if column[j] > 0.0 and _sweep >= 0:
                d[j] /= sqrt(column[j])
    for j in range(n):
        d[j] = power_of_two(d[j])
    for i in range(m):
        v = 0.0
        if variable[i] >= 0:
            v = d[variable[i]]
        else:
            for k in range(a.ptr[i], a.ptr[i + 1]):
                v = max(v, fabs(a.val[k]) * d[a.idx[k]])
        e[i] = 1.0 / power_of_two(v)
        v = fabs(t[i]) * e[i]
        if 0.0 < v < PLACEHOLDER:
            if i < free or t[i] > 0.0:
                logarithms += log(v)
                count += 1
            else:
                fallback += log(v)
                n_fallback += 1
    for j in range(n):
        v = 0.0
        for k in range(p.ptr[j], p.ptr[j + 1]):
            largest = max(largest, fabs(p.val[k]) * d[j] * d[p.idx[k]])
            if p.idx[k] == j:
                v = p.val[k] * d[j]
        if v > 0.0 and 0.0 < fabs(q[j]) < PLACEHOLDER * v:
            logarithms += log(fabs(q[j]) / v)
            count += 1
    if count:
        sigma = power_of_two(exp(logarithms / count))
    elif n_fallback:
        sigma = power_of_two(exp(fallback / n_fallback))
    largest *= sigma * sigma
    for j in range(n):
        largest = max(largest, fabs(q[j]) * d[j] * sigma)
    return d_, e_, sigma, 1.0 / power_of_two(largest)
