"""The error of quadratic programs in their own terms, and the equilibration of programs by powers of two.

    min 1/2 x.P x + q.x   subject to   (J x)_i = t_i for i < free,   (J x)_i >= t_i for the other rows

with multipliers lambda, P x + q = J^T lambda. P (both triangles) and J are compressed rows. |.| of a sum is the sum of the
absolute terms, u = 2^-53. The error is the largest of

    row i       |J x - t|_i / (|J| |x| + |t|)_i                                                  (Oettli, Prager 1964)     (1)
    column j    |P x + q - J^T lambda|_j / (|P| |x| + |q|)_j,   plus (|J|^T |lambda|)_j if that is rounding                (2)
    gap         (sum |lambda_i (J x - t)_i| + sum |x_j (P x + q - J^T lambda)_j|) / (|x|.|P| |x| + |q|.|x|)                (3)

over equations, active inequalities and violated rows. An inequality is active if the share of its multiplier in its
columns, max_j |J_ij lambda_i| / c_j, exceeds the share of its slack in its row; otherwise, and if lambda_i < 0, lambda_i is
set to 0 (4). A divisor below NOISE of its norm-wise value is rounding and takes that value, and ROUNDING of it are
subtracted from the residuals of rows and columns (Arioli, Demmel, Duff 1989) (5). With x = sigma D x', rows multiplied by E:

    X = max(sigma, max |x_j| / D_j),   norm_i = max_j (|J_ij| D_j) X + |t_i|,   cost_j = max_k (|P_jk| D_k) X + |q_j|
    Y = max(max |lambda_i| / E_i, max_j D_j cost_j),            norm_j = cost_j + max_i (E_i |J_ij|) Y

The strict error compares rows with |t_i| and columns with |q_j| alone, unless these are rounding; such a row is compared
with norm_i for X = sigma, so that large x do not hide rows that contradict each other.
"""
from libc.math cimport INFINITY, exp2, fabs, isfinite, round, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer
from lavender_ext.core.problem cimport Workspace, allocate_bytes

cdef double UNIT = 2.0**-53
cdef double NOISE = 1024.0 * UNIT
cdef double ROUNDING = 16.0 * UNIT
cdef int EQUILIBRATION_STEPS = 8
cdef double EQUILIBRATION_TOLERANCE = 1e-4  # Squared residual of (6) at which its steps end, relative to the first one.
cdef double NEGLIGIBLE_ENTRY = 1e-13        # Entries below this share of their row have no part in (6).
cdef double NEGLIGIBLE_SIDE = 1e-14         # Right-hand sides below this share of the others are rounding.
cdef double PLACEHOLDER = 1e18              # Larger numbers have no part in the size of the variables.
cdef double MAX_SIZE_GROWTH = 1e10          # Largest ratio of x to sigma whose rounding the strict error accepts.
cdef double MAX_SIZE_RATIO = 1e6            # Largest ratio of the size of the variables to the smallest right-hand side.


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


cdef inline double above_noise(double value, double norm) noexcept nogil:
    """Return a divisor, or its norm-wise value if the divisor is rounding (5)."""
    return value if value > NOISE * norm else norm


cdef struct columns_t:
    # Terms of the columns of a point.
    const double* cost          # (n) (|P| |x| + |q|)_j
    const double* cost_norm     # (n) cost_j of (5)
    const double* force_norm    # (n) max_i E_i |J_ij|
    double* force               # (n) (J^T lambda)_j
    double* divisor             # (n) divisor of (2)
    double* norm                # (n) norm_j of (5)


cdef void compute_columns(const csr_t* a, const double* lam, const double* e, double top_cost, columns_t* c) noexcept nogil:
    """Compute forces, divisors and norm-wise values of the columns for the multipliers lambda."""
    cdef Py_ssize_t i, j, k
    cdef double top = top_cost, v
    for j in range(a.n):
        c.force[j], c.divisor[j] = 0.0, c.cost[j]       # The divisor holds |P||x| + |q| + |J|^T |lambda| at first.
    for i in range(a.m):
        if lam[i] == 0.0:
            continue
        top = max(top, fabs(lam[i]) / e[i])
        for k in range(a.ptr[i], a.ptr[i + 1]):
            v = a.val[k] * lam[i]
            c.force[a.idx[k]] += v
            c.divisor[a.idx[k]] += fabs(v)
    for j in range(a.n):
        c.norm[j] = c.cost_norm[j] + c.force_norm[j] * top
        if c.cost[j] > NOISE * c.norm[j]:
            c.divisor[j] = c.cost[j]
        else:
            c.divisor[j] = above_noise(c.divisor[j], c.norm[j])


def judge_program(hessian, q_, jac, t_, scales, lam_, x_, int32_t free):
    """Judge x (n,) and lambda (m,) of a program by the formulas of the module.

    `scales` is the result of `equilibrate_program`.

    Returns
    -------
    error, strict_error : float
        inf if a number overflows.
    row_error, column_error : float
        (1) and (2), parts of `error`.
    active : (m,) bool
        Equations, and inequalities that are active.
    lam : (m,)
        Complementary multipliers.
    """
    cdef Py_ssize_t i, j, k, n = len(x_), m = len(lam_)
    cdef const double* x = as_double_pointer(x_, n)
    cdef const double* q = as_double_pointer(q_, n)
    cdef const double* t = as_double_pointer(t_, m)
    cdef const double* d = as_double_pointer(scales[0], n)
    cdef const double* e = as_double_pointer(scales[1], m)
    cdef csr_t p = read_csr(hessian, n, n)
    cdef csr_t a = read_csr(jac, m, n)
    complementary = np.array(lam_)
    active_ = np.zeros(m, bool)
    cdef double* lam = as_double_pointer(complementary, m)
    cdef unsigned char[::1] active = active_.view(np.uint8)
    cdef Workspace workspace = allocate_bytes((7 * n + 4 * m + 1) * sizeof(double))
    cdef double* px = <double*>workspace.at             # (n) P x + q
    cdef double* cost = px + n
    cdef double* cost_norm = cost + n
    cdef double* force_norm = cost_norm + n
    cdef double* force = force_norm + n
    cdef double* divisor = force + n
    cdef double* norm = divisor + n
    cdef double* slack = norm + n                       # (m) J x - t
    cdef double* row = slack + m                        # (m) divisor of (1)
    cdef double* row_norm = row + m                     # (m) norm_i
    cdef double* start_norm = row_norm + m              # (m) norm_i for X = sigma
    cdef columns_t columns = columns_t(cost, cost_norm, force_norm, force, divisor, norm)
    cdef double v, w, share, excess
    cdef double top = scales[2], top_cost = 0.0, top_term = 0.0, terms = 0.0, gap = 0.0
    cdef double row_error = 0.0, column_error = 0.0, strict = 0.0
    cdef bint has_cost = False
    for j in range(n):
        if not isfinite(x[j]):
            return INFINITY, INFINITY, INFINITY, INFINITY, active_, complementary
        top = max(top, fabs(x[j]) / d[j])
    # Columns: gradient of the cost with its terms.
    for j in range(n):
        px[j], cost[j], w, force_norm[j] = q[j], fabs(q[j]), 0.0, 0.0
        for k in range(p.ptr[j], p.ptr[j + 1]):
            v = p.val[k] * x[p.idx[k]]
            px[j] += v
            cost[j] += fabs(v)
            w = max(w, fabs(p.val[k]) * d[p.idx[k]])
        has_cost |= w > 0.0 or q[j] != 0.0
        cost_norm[j] = w * top + fabs(q[j])
        top_cost = max(top_cost, d[j] * cost_norm[j])
        top_term = max(top_term, d[j] * max(w * top, fabs(q[j])))
        terms += fabs(x[j]) * cost[j]
    # Rows: slacks with their terms.
    for i in range(m):
        slack[i], row[i], w = -t[i], fabs(t[i]), 0.0
        for k in range(a.ptr[i], a.ptr[i + 1]):
            j = a.idx[k]
            v = a.val[k] * x[j]
            slack[i] += v
            row[i] += fabs(v)
            w = max(w, fabs(a.val[k]) * d[j])
            force_norm[j] = max(force_norm[j], fabs(a.val[k]) * e[i])
        row_norm[i] = w * top + fabs(t[i])
        start_norm[i] = w * <double>scales[2] + fabs(t[i])
        row[i] = above_noise(row[i], row_norm[i])
        if not isfinite(lam[i]) or (i >= free and lam[i] < 0.0) or not has_cost:
            lam[i] = 0.0
    # Complementarity (4).
    compute_columns(&a, lam, e, top_cost, &columns)
    for i in range(m):
        share = 0.0
        for k in range(a.ptr[i], a.ptr[i + 1]):
            share = max(share, ratio_or_inf(fabs(a.val[k] * lam[i]), divisor[a.idx[k]]))
        active[i] = i < free or share > max(fabs(slack[i]) - ROUNDING * row_norm[i], 0.0) / row[i]
        if not active[i]:
            lam[i] = 0.0
    compute_columns(&a, lam, e, top_cost, &columns)
    # Errors of rows (1), columns (2) and their sum (3).
    for i in range(m):
        if active[i] or slack[i] < 0.0:
            excess = max(fabs(slack[i]) - ROUNDING * row_norm[i], 0.0)
            gap += fabs(lam[i]) * excess
            row_error = max(row_error, ratio_or_inf(excess, row[i]))
            excess = max(fabs(slack[i]) - ROUNDING * min(row_norm[i], MAX_SIZE_GROWTH * start_norm[i]), 0.0)
            strict = max(strict, ratio_or_inf(excess, fabs(t[i]) if fabs(t[i]) > NOISE * row_norm[i] else start_norm[i]))
    for j in range(n):
        excess = max(fabs(px[j] - force[j]) - ROUNDING * norm[j], 0.0)
        gap += fabs(x[j]) * excess
        column_error = max(column_error, ratio_or_inf(excess, divisor[j]))
        strict = max(strict, ratio_or_inf(excess, fabs(q[j]) if fabs(q[j]) > NOISE * norm[j] else divisor[j]))
    v = max(row_error, column_error, ratio_or_inf(gap, above_noise(terms, top * top_term)))
    if not (isfinite(gap) and isfinite(terms) and v == v):
        v = INFINITY
    return v, max(v, strict), row_error, column_error, active_, complementary


cdef inline double approximate_log2(double x) noexcept nogil:
    """Return log2 of a positive normal number, at most 0.09 too small: its exponent plus its mantissa above 1."""
    cdef int64_t bits
    memcpy(&bits, &x, 8)
    return <double>bits * 2.0**-52 - 1023.0


cdef inline double power_of_two(double x) noexcept nogil:
    """Return the power of two nearest to a positive number in logarithm; 1 for other numbers."""
    return exp2(round(approximate_log2(x))) if 2.0**-1022 < x < INFINITY else 1.0


cdef void apply_normal_matrix(const csr_t* p, const csr_t* a, const double* logs, const double* s, double* out) noexcept nogil:
    """Compute the normal matrix of (6) times s (n + m + 1); entries with a logarithm of inf have no part."""
    cdef Py_ssize_t i, j, k, n = p.n, at = 0
    cdef double v, total, of_cost = s[n + a.m]
    memset(out, 0, (n + a.m + 1) * sizeof(double))
    for j in range(n):
        total = 0.0
        for k in range(p.ptr[j], p.ptr[j + 1]):
            if logs[at] < INFINITY:
                total += s[j] + s[p.idx[k]] + of_cost
            at += 1
        out[j] += 2.0 * total                           # P is symmetric: each entry also is one of column j.
        out[n + a.m] += total
    for i in range(a.m):
        total = 0.0
        for k in range(a.ptr[i], a.ptr[i + 1]):
            if logs[at] < INFINITY:
                v = s[n + i] + s[a.idx[k]]
                total += v
                out[a.idx[k]] += v
            at += 1
        out[n + i] = total


cdef void compute_logarithms(const csr_t* p, const csr_t* a, const int32_t* variable, double* top, double* logs, double* rhs,
                             double* diagonal) noexcept nogil:
    """Compute logs, right-hand side and diagonal of (6); `top` (n) is workspace."""
    cdef Py_ssize_t i, j, k, n = p.n, at = 0
    cdef double v, w
    for j in range(n):
        w = 0.0
        for k in range(p.ptr[j], p.ptr[j + 1]):
            w = max(w, fabs(p.val[k]))
        top[j] = sqrt(w)
    for j in range(n):
        for k in range(p.ptr[j], p.ptr[j + 1]):
            v = fabs(p.val[k])
            logs[at] = INFINITY
            if v > NEGLIGIBLE_ENTRY * top[j] * top[p.idx[k]] and v < INFINITY:
                logs[at] = w = approximate_log2(v)
                rhs[j] -= 2.0 * w
                rhs[n + a.m] -= w
                diagonal[j] += 4.0 if p.idx[k] == j else 2.0
                diagonal[n + a.m] += 1.0
            at += 1
    for i in range(a.m):
        w = 0.0
        for k in range(a.ptr[i], a.ptr[i + 1]):
            w = max(w, fabs(a.val[k]))
        for k in range(a.ptr[i], a.ptr[i + 1]):
            v = fabs(a.val[k])
            logs[at] = INFINITY
            if variable[i] < 0 and v > NEGLIGIBLE_ENTRY * w and v < INFINITY:
                logs[at] = v = approximate_log2(v)
                rhs[n + i] -= v
                rhs[a.idx[k]] -= v
                diagonal[n + i] += 1.0
                diagonal[a.idx[k]] += 1.0
            at += 1


cdef double choose_size(const double* t, const double* e, Py_ssize_t m, int32_t free, double median) noexcept nogil:
    """Return sigma: the largest right-hand side that x = 0 violates in scaled units, unless it is rounding of the others.

    Otherwise sigma is `median`, the median of |q_j| / P_jj, up to the largest right-hand side.
    """
    cdef Py_ssize_t i
    cdef double v, violated = 0.0, largest = 0.0, smallest = INFINITY
    for i in range(m):
        v = fabs(t[i]) * e[i]
        if v < PLACEHOLDER:
            largest = max(largest, v)
            if i < free or t[i] > 0.0:
                violated = max(violated, v)
    if violated > NEGLIGIBLE_SIDE * min(1e3 * median, largest):
        return power_of_two(violated)
    for i in range(m):
        v = fabs(t[i]) * e[i]
        if NEGLIGIBLE_SIDE * largest < v < PLACEHOLDER:
            smallest = min(smallest, v)
    if median < INFINITY:
        smallest = min(median, min(largest if largest > 0.0 else INFINITY, MAX_SIZE_RATIO * smallest))
    return power_of_two(smallest)


def equilibrate_program(hessian, q_, jac, t_, variable_, int32_t free):
    """Return the scales (D, E, sigma, c) of a program, all powers of two.

    x = sigma D x', rows are multiplied by E, the cost by c. D, E and g are the least-squares solution of

        sum log2(g |P_jk| D_j D_k)^2 + sum log2(|J_ij| E_i D_j)^2                         (Curtis, Reid 1972)            (6)

    by conjugate gradients; then E is 1 over the largest entry of each row. sigma is the size of x (`choose_size`). c makes
    the largest entry of the scaled P and q equal to 1. variable_ (m,) is the variable of a row that is a bound, -1 for other
    rows; bounds have no part in (6).

    Returns
    -------
    D : (n,)
    E : (m,)
    sigma, c : float
    """
    cdef Py_ssize_t i, j, k, _step, n = len(q_), m = len(t_), size = n + m + 1
    cdef const double* q = as_double_pointer(q_, n)
    cdef const double* t = as_double_pointer(t_, m)
    cdef const int32_t* variable = as_int_pointer(variable_, m)
    cdef csr_t p = read_csr(hessian, n, n)
    cdef csr_t a = read_csr(jac, m, n)
    d_, e_, curvature_ = np.ones(n), np.ones(m), np.zeros(n)
    cdef double* d = as_double_pointer(d_, n)
    cdef double* e = as_double_pointer(e_, m)
    cdef double* curvature = as_double_pointer(curvature_, n)
    cdef Workspace workspace = allocate_bytes((5 * size + p.ptr[n] + a.ptr[m] + 1) * sizeof(double))
    cdef double* s = <double*>workspace.at
    cdef double* residual = s + size
    cdef double* diagonal = residual + size
    cdef double* direction = diagonal + size
    cdef double* image = direction + size
    cdef double* logs = image + size
    cdef double v, length, largest = 0.0, rz = 0.0, next_rz, goal, sigma
    memset(s, 0, 5 * size * sizeof(double))
    compute_logarithms(&p, &a, variable, image, logs, residual, diagonal)
    for i in range(size):
        diagonal[i] = max(diagonal[i], 1.0)
        direction[i] = residual[i] / diagonal[i]
        rz += residual[i] * direction[i]
    goal = EQUILIBRATION_TOLERANCE * rz
    for _step in range(EQUILIBRATION_STEPS):
        if not rz > goal:
            break
        apply_normal_matrix(&p, &a, logs, direction, image)
        v = 0.0
        for i in range(size):
            v += direction[i] * image[i]
        length, next_rz = rz / v, 0.0
        for i in range(size):
            s[i] += length * direction[i]
            residual[i] -= length * image[i]
            next_rz += residual[i] * residual[i] / diagonal[i]
        for i in range(size):
            direction[i] = residual[i] / diagonal[i] + next_rz / rz * direction[i]
        rz = next_rz
    for j in range(n):
        d[j] = exp2(round(s[j]))
    for i in range(m):
        v = 0.0
        for k in range(a.ptr[i], a.ptr[i + 1]):
            v = max(v, fabs(a.val[k]) * d[a.idx[k]])
        e[i] = 1.0 / power_of_two(v)
    # Sizes |q_j| / P_jj of the variables in scaled units.
    for j in range(n):
        for k in range(p.ptr[j], p.ptr[j + 1]):
            if p.idx[k] == j and p.val[k] > 0.0:
                curvature[j] = fabs(q[j]) / (p.val[k] * d[j])
    positive = curvature_[curvature_ > 0.0]
    sigma = choose_size(t, e, m, free, float(np.sort(positive)[len(positive) // 2]) if len(positive) else INFINITY)
    for j in range(n):
        for k in range(p.ptr[j], p.ptr[j + 1]):
            largest = max(largest, fabs(p.val[k]) * d[j] * d[p.idx[k]] * sigma * sigma)
        largest = max(largest, fabs(q[j]) * d[j] * sigma)
    return d_, e_, sigma, 1.0 / power_of_two(largest)
