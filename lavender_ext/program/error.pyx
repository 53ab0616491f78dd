"""The error of quadratic programs in their own terms, and the equilibration of programs by powers of two.

    min 1/2 x.P x + q.x   subject to   (J x)_i = t_i for i < free,   (J x)_i >= t_i for the other rows

with multipliers lambda, P x + q = J^T lambda. P (both triangles) and J are compressed rows. A
component is a set of rows and columns that entries of P and J connect. u = 2^-53, and

    own_i = (|J| |x| + |t|)_i,   cost_j = (|P| |x| + |q|)_j,   full_j = cost_j + (|J|^T |lambda|)_j

are sums of absolute terms. Sums are compensated (Neumaier 1974), so that 16 u of its terms is the
rounding of a residual whatever the number of terms (Skeel 1979):

    excess_i = max(|J x - t|_i - 16 u own_i, 0),   rest_j = max(|P x + q - J^T lambda|_j - 16 u full_j, 0)

The error of a component is the largest of

    row i       excess_i / own_i                                     (Oettli, Prager 1964)          (1)
    column j    rest_j / max(c_j, 2^10 u full_j),   c_j = cost_j, or if that is 0 the smaller one
                of full_j and top / D_j                                                             (2)
    gap         (sum |lambda_i| excess_i + sum |x_j| rest_j) / sum |x_j| cost_j                     (3)

over equations, active inequalities and violated rows; top = max_j D_j cost_j over the component. An
inequality is active if the share of its multiplier in its columns, max_j |J_ij lambda_i| / divisor_j,
exceeds (1); otherwise, and if lambda_i < 0, lambda_i is set to 0 (4). Multipliers are a proof, which
the judge may choose: lambda_i below one of `THRESHOLDS` of the largest of its component, in scaled
units, is 0 if that makes the error of the component smaller (5).

A row of two or more entries whose terms are all rounding of a right-hand side of its component holds:
(1) is multiplied by

    ramp(own_i E_i / (2^7 u max_k min(|t_k|, (|J||x|)_k) E_k)),   ramp(s) = min(max(s - 1, 0), 1)   (6)

(after Arioli, Demmel, Duff 1989). The row still counts in (3).

Multipliers whose rounding is as large as all costs of their component prove nothing: (2) is at least

    ramp(128 u D_j full_j / top) |P x + q - J^T lambda|_j / (cost_j, or if that is 0 top / D_j)     (7)

The strict error compares rows with |t_i| and columns with |q_j| alone, so that large x does not hide
rows that contradict each other, nor a ray. Where these are 0, the terms for |x| up to the largest
right-hand side that x = 0 violates take their place. Rounding is not subtracted from residuals with
terms beyond 1e10 of these.
"""
from libc.math cimport INFINITY, exp2, fabs, isfinite, round, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer
from lavender_ext.core.problem cimport Workspace, allocate_bytes

#: [-] Rounding of a residual as a share of its terms: 16 unit roundoffs.
TERM_ROUNDING = 2.0**-49
#: [-] Largest growth of terms whose rounding the strict error accepts.
MAX_TERM_GROWTH = 1e10
#: [-] A proof of infeasibility is above this multiple of the largest right-hand side that x reaches (4 unit roundoffs).
MIN_PROOF_SHARE = 2.0**-51
cdef double UNIT = 2.0**-53
cdef double NOISE = 1024.0 * UNIT           # Costs below this share of full_j are rounding (2).
cdef double ROUNDING = TERM_ROUNDING
cdef double SIDE_ROUNDING = 128.0 * UNIT    # Rounding of right-hand sides (6).
cdef double MIN_PROOF = MIN_PROOF_SHARE
cdef double EXACT = 1e-12                   # Multipliers of components with larger errors are chosen (5).
cdef enum:
    N_THRESHOLDS = 6
cdef double[N_THRESHOLDS] THRESHOLDS = [2.0**-53, 2.0**-48, 2.0**-43, 2.0**-33, 2.0**-23, 1.0]
cdef double MAX_SIZE_GROWTH = MAX_TERM_GROWTH
cdef int EQUILIBRATION_STEPS = 8
# Squared residual of (8) at which its steps end, relative to the first one.
cdef double EQUILIBRATION_TOLERANCE = 1e-4
cdef double NEGLIGIBLE_ENTRY = 1e-13        # Entries below this share of their row have no part in (8).
cdef double NEGLIGIBLE_SIDE = 1e-14         # Right-hand sides below this share of the others are rounding.
cdef double PLACEHOLDER = 1e18              # Larger numbers have no part in the size of the variables.
# Largest ratio of the size of the variables to the smallest right-hand side.
cdef double MAX_SIZE_RATIO = 1e6


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


cdef inline double ramp(double s) noexcept nogil:
    """Return s - 1 within 0 and 1."""
    return min(max(s - 1.0, 0.0), 1.0)


cdef inline void add_compensated(double* total, double* lost, double v) noexcept nogil:
    """Add v to a sum, and the rounding of the addition to `lost` (Knuth's two-sum)."""
    cdef double s = total[0] + v
    cdef double part = s - total[0]
    lost[0] += (total[0] - (s - part)) + (v - part)
    total[0] = s


# -- components --------------------------------------------------------------------------------------

cdef inline int32_t find_root(int32_t* parent, int32_t i) noexcept nogil:
    """Return the root of i in a forest, and halve the path to it."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


cdef void unite(int32_t* parent, int32_t i, int32_t j) noexcept nogil:
    """Unite the trees of i and j; the smaller root remains one."""
    i, j = find_root(parent, i), find_root(parent, j)
    parent[max(i, j)] = min(i, j)


def find_components(hessian, jac, Py_ssize_t n, Py_ssize_t m):
    """Return the component of each column and of each row, (n + m,) int32, and the number of components.

    Components are numbered by their first columns; a row without nonzero entries is a component.
    """
    cdef Py_ssize_t i, k
    cdef int32_t count = 0
    cdef csr_t p = read_csr(hessian, n, n)
    cdef csr_t a = read_csr(jac, m, n)
    of_ = np.arange(n + m, dtype=np.int32)
    cdef int32_t* of = as_int_pointer(of_, n + m)
    for i in range(n):
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if p.val[k] != 0.0:
                unite(of, <int32_t>i, p.idx[k])
    for i in range(m):
        for k in range(a.ptr[i], a.ptr[i + 1]):
            if a.val[k] != 0.0:
                unite(of, <int32_t>(n + i), a.idx[k])
    number_ = np.empty(n + m, np.int32)
    cdef int32_t* number = as_int_pointer(number_, n + m)
    for i in range(n + m):                              # Roots have smaller indices than their trees.
        of[i] = of[of[i]]
        if of[i] == i:
            number[i], count = count, count + 1
        else:
            number[i] = number[of[i]]
    return number_, count


# -- errors ------------------------------------------------------------------------------------------

cdef struct point_t:
    # Terms of a point x, which the choice of multipliers does not change, and of its multipliers.
    csr_t a
    int32_t free
    const int32_t* column_part  # (n) component
    const int32_t* row_part     # (m) component
    Py_ssize_t parts            # number of components
    const double* d             # (n)
    const double* e             # (m)
    const double* x             # (n)
    double* gradient            # (n) (P x + q)_j
    double* gradient_lost       # (n) its rounding
    double* cost                # (n) cost_j
    double* reach               # (n) divisor of the strict error, 0 without one
    double* force               # (n) (J^T lambda)_j
    double* force_lost          # (n) its rounding
    double* full                # (n) full_j
    double* divisor             # (n) divisor of (2)
    double* slack               # (m) (J x - t)_i
    double* own                 # (m) own_i
    double* excess              # (m) excess_i
    double* weight              # (m) factor (6)
    double* top                 # (parts) top of (2)
    double* value               # (parts) sum |x_j| cost_j
    double* gap                 # (parts) numerator of (3)
    unsigned char* active       # (m)


cdef struct errors_t:
    double row, column, total


cdef void compute_columns(point_t* p, const double* lam) noexcept nogil:
    """Compute forces, their terms and the divisors of (2) for the multipliers lambda."""
    cdef Py_ssize_t i, j, k
    cdef double v, c
    for j in range(p.a.n):
        p.force[j], p.force_lost[j], p.full[j] = 0.0, 0.0, p.cost[j]
    for i in range(p.a.m):
        if lam[i] == 0.0:
            continue
        for k in range(p.a.ptr[i], p.a.ptr[i + 1]):
            v = p.a.val[k] * lam[i]
            add_compensated(&p.force[p.a.idx[k]], &p.force_lost[p.a.idx[k]], v)
            p.full[p.a.idx[k]] += fabs(v)
    for j in range(p.a.n):
        c = p.cost[j]
        if c == 0.0:
            v = p.top[p.column_part[j]] / p.d[j]
            c = min(p.full[j], v) if v > 0.0 else p.full[j]
        p.divisor[j] = max(c, NOISE * p.full[j])


cdef errors_t judge_multipliers(point_t* p, double* lam, double* part_error) noexcept nogil:
    """Set multipliers to 0 by (4), and compute the errors of all rows, columns and components.

    `part_error` (parts) receives the error of each component.
    """
    cdef Py_ssize_t i, j, k, c
    cdef double v, share, rest
    cdef bint is_changed = False
    cdef errors_t out = errors_t(0.0, 0.0, 0.0)
    compute_columns(p, lam)
    for i in range(p.a.m):
        p.active[i] = i < p.free
        if i >= p.free and lam[i] != 0.0:
            share = 0.0
            for k in range(p.a.ptr[i], p.a.ptr[i + 1]):
                share = max(share, ratio_or_inf(fabs(p.a.val[k] * lam[i]), p.divisor[p.a.idx[k]]))
            p.active[i] = share > p.weight[i] * ratio_or_inf(p.excess[i], p.own[i])
            if not p.active[i]:
                lam[i], is_changed = 0.0, True
    if is_changed:
        compute_columns(p, lam)
    for c in range(p.parts):
        p.gap[c] = part_error[c] = 0.0
    for i in range(p.a.m):
        if p.active[i] or p.slack[i] < 0.0:
            c = p.row_part[i]
            p.gap[c] += fabs(lam[i]) * p.excess[i]
            v = p.weight[i] * ratio_or_inf(p.excess[i], p.own[i])
            part_error[c], out.row = max(part_error[c], v), max(out.row, v)
    for j in range(p.a.n):
        c = p.column_part[j]
        v = fabs((p.gradient[j] - p.force[j]) + (p.gradient_lost[j] - p.force_lost[j]))
        rest = max(v - ROUNDING * p.full[j], 0.0)
        p.gap[c] += fabs(p.x[j]) * rest
        rest = ratio_or_inf(rest, p.divisor[j])
        share = 8.0 * ROUNDING * p.d[j] * p.full[j]
        if share > p.top[c] > 0.0:
            share = ramp(share / p.top[c])
            rest = max(rest, share * v / (p.cost[j] if p.cost[j] > 0.0 else p.top[c] / p.d[j]))
        if not isfinite(v):
            rest = INFINITY
        part_error[c], out.column = max(part_error[c], rest), max(out.column, rest)
    for c in range(p.parts):
        v = ratio_or_inf(p.gap[c], p.value[c])
        part_error[c] = max(part_error[c], v) if isfinite(p.gap[c]) else INFINITY
        out.total = max(out.total, part_error[c])
    return out


cdef errors_t choose_multipliers(point_t* p, double* lam, const double* given, errors_t best, double* part_error,
                                 double* work) noexcept nogil:
    """Replace multipliers by (5) if that makes the error smaller; return the errors.

    Parameters
    ----------
    lam : (m), changed
        Multipliers that were judged, with their errors `best` and those of the components, `part_error` (parts).
    given : (m)
        The same before (4).
    work : (2 m + 3 parts), scratch
    """
    cdef Py_ssize_t i, c, step, m = p.a.m
    cdef bint is_changed, is_better = False
    cdef errors_t errors
    cdef double* trial = work
    cdef double* choice = trial + m
    cdef double* trial_error = choice + m
    cdef double* largest = trial_error + p.parts        # Largest multiplier or cost, in scaled units.
    cdef double* gain = largest + p.parts
    memcpy(largest, p.top, p.parts * sizeof(double))
    memcpy(choice, lam, m * sizeof(double))
    for i in range(m):
        largest[p.row_part[i]] = max(largest[p.row_part[i]], fabs(given[i]) / p.e[i])
    for step in range(N_THRESHOLDS):
        is_changed = False
        for i in range(m):
            c, trial[i] = p.row_part[i], given[i]
            if given[i] != 0.0 and part_error[c] > EXACT and (
                    fabs(given[i]) / p.e[i] <= THRESHOLDS[step] * largest[c]):
                trial[i], is_changed = 0.0, True
        if not is_changed:
            continue
        judge_multipliers(p, trial, trial_error)
        is_changed = False
        for c in range(p.parts):
            gain[c] = part_error[c] - trial_error[c] if trial_error[c] < part_error[c] else 0.0
            if gain[c] > 0.0:
                part_error[c], is_changed = trial_error[c], True
        if is_changed:
            is_better = True
            for i in range(m):
                if gain[p.row_part[i]] > 0.0:
                    choice[i] = trial[i]
    if is_better:
        errors = judge_multipliers(p, choice, trial_error)
        if errors.total < best.total:
            memcpy(lam, choice, m * sizeof(double))
            return errors
    return judge_multipliers(p, lam, trial_error)       # It restores forces and active rows.


def judge_program(hessian, q_, jac, t_, scales, parts_, lam_, x_, int32_t free):
    """Judge x (n,) and lambda (m,) of a program by the formulas of the module.

    `scales` is the result of `equilibrate_program`, `parts_` that of `find_components`.

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
    hidden_error : float
        The strict error of rows with a right-hand side that counts as rounding, relative to it, and of rows
        with a right-hand side of 0, relative to the smallest one of the component in scaled units.
    """
    cdef Py_ssize_t i, j, k, c, n = len(x_), m = len(lam_), parts = parts_[1], count
    cdef const double* x = as_double_pointer(x_, n)
    cdef const double* q = as_double_pointer(q_, n)
    cdef const double* t = as_double_pointer(t_, m)
    cdef csr_t a
    cdef csr_t p = read_csr(hessian, n, n)
    complementary = np.array(lam_)
    active_ = np.zeros(m, bool)
    cdef double* lam = as_double_pointer(complementary, m)
    cdef const unsigned char[::1] active = active_.view(np.uint8)
    cdef Workspace workspace = allocate_bytes((8 * n + 8 * m + 10 * parts + 1) * sizeof(double))
    cdef double* numbers = <double*>workspace.at
    cdef point_t at
    at.a, at.free, at.parts = read_csr(jac, m, n), free, parts
    at.column_part = as_int_pointer(parts_[0], n + m)
    at.row_part = at.column_part + n
    at.d, at.e, at.x = as_double_pointer(scales[0], n), as_double_pointer(scales[1], m), x
    at.gradient, at.gradient_lost, at.cost, at.reach = numbers, numbers + n, numbers + 2 * n, numbers + 3 * n
    numbers += 4 * n
    at.force, at.force_lost, at.full, at.divisor = numbers, numbers + n, numbers + 2 * n, numbers + 3 * n
    numbers += 4 * n
    at.slack, at.own, at.excess, at.weight = numbers, numbers + m, numbers + 2 * m, numbers + 3 * m
    numbers += 4 * m
    cdef double* given = numbers                        # (m) multipliers before (4)
    cdef double* reach = numbers + m                    # (m) divisor of the strict error
    numbers += 2 * m
    at.top, at.value, at.gap = numbers, numbers + parts, numbers + 2 * parts
    cdef double* part_error = numbers + 3 * parts
    cdef double* size = numbers + 4 * parts             # Largest right-hand side that x = 0 violates.
    cdef double* side = numbers + 5 * parts             # Largest right-hand side that x reaches.
    cdef double* least = numbers + 6 * parts            # Smallest right-hand side that is no rounding.
    cdef double* work = numbers + 7 * parts
    at.active = <unsigned char*>&active[0] if m else NULL
    cdef double v, w, lost, strict = 0.0, hidden = 0.0, necessary = 0.0, terms = 0.0
    cdef errors_t errors
    a = at.a
    for j in range(n):
        if not isfinite(x[j]):
            return INFINITY, INFINITY, INFINITY, INFINITY, active_, complementary, INFINITY
    memset(at.top, 0, 6 * parts * sizeof(double))
    for i in range(m):
        c = at.row_part[i]
        if i < free or t[i] > 0.0:
            size[c] = max(size[c], fabs(t[i]) * at.e[i])
    # Columns: gradient of the cost with its terms. `gap` holds whether a component has a cost.
    for j in range(n):
        c = at.column_part[j]
        v, lost, at.cost[j], at.reach[j] = q[j], 0.0, fabs(q[j]), fabs(q[j])
        for k in range(p.ptr[j], p.ptr[j + 1]):
            w = p.val[k] * x[p.idx[k]]
            add_compensated(&v, &lost, w)
            at.cost[j] += fabs(w)
            if q[j] == 0.0:
                w = fabs(p.val[k]) * min(fabs(x[p.idx[k]]), at.d[p.idx[k]] * size[c])
                at.reach[j] += w
            if p.val[k] != 0.0:
                at.gap[c] = 1.0
        at.gradient[j], at.gradient_lost[j] = v, lost
        if q[j] != 0.0:
            at.gap[c] = 1.0
        at.top[c] = max(at.top[c], at.d[j] * at.cost[j])
        at.value[c] += fabs(x[j]) * at.cost[j]
        terms += at.cost[j] + fabs(x[j]) * at.cost[j]
    # Rows: slacks with their terms.
    for i in range(m):
        c = at.row_part[i]
        v, lost, at.own[i], reach[i] = -t[i], 0.0, 0.0, 0.0
        for k in range(a.ptr[i], a.ptr[i + 1]):
            j = a.idx[k]
            w = a.val[k] * x[j]
            add_compensated(&v, &lost, w)
            at.own[i] += fabs(w)
            reach[i] += fabs(a.val[k]) * min(fabs(x[j]), at.d[j] * size[c])
        side[c] = max(side[c], min(fabs(t[i]), at.own[i]) * at.e[i])
        at.own[i] += fabs(t[i])
        at.slack[i] = v + lost
        at.excess[i] = max(fabs(at.slack[i]) - ROUNDING * at.own[i], 0.0)
        terms += at.own[i]
        if not isfinite(lam[i]) or (i >= free and lam[i] < 0.0) or at.gap[c] == 0.0:
            lam[i] = 0.0
        given[i] = lam[i]
    for i in range(m):
        c, count = at.row_part[i], 0
        v = SIDE_ROUNDING * side[c]                     # Rounding of right-hand sides, in scaled units.
        if fabs(t[i]) * at.e[i] > v:
            reach[i] = fabs(t[i])
        elif size[c] == 0.0:
            reach[i] = at.own[i]
        for k in range(a.ptr[i], a.ptr[i + 1]):
            count += a.val[k] != 0.0
        at.weight[i] = ramp(at.own[i] * at.e[i] / v) if count > 1 and v > 0.0 else 1.0
        if i < free or at.slack[i] < 0.0:
            necessary = max(necessary, at.weight[i] * ratio_or_inf(at.excess[i], at.own[i]))
    errors = judge_multipliers(&at, lam, part_error)
    if errors.total > max(EXACT, necessary):
        errors = choose_multipliers(&at, lam, given, errors, part_error, work)
    # Strict and hidden errors.
    for c in range(parts):
        least[c] = INFINITY
    for i in range(m):
        c, v = at.row_part[i], fabs(t[i]) * at.e[i]
        if v > MIN_PROOF * side[c]:
            least[c] = min(least[c], v)
    for i in range(m):
        if at.active[i] or at.slack[i] < 0.0:
            v = fabs(at.slack[i]) if at.own[i] > MAX_SIZE_GROWTH * reach[i] else at.excess[i]
            strict = max(strict, at.weight[i] * ratio_or_inf(v, reach[i]))
            # Right-hand sides below MIN_PROOF are rounding in every proof.
            if reach[i] != fabs(t[i]) and fabs(t[i]) * at.e[i] > MIN_PROOF * side[at.row_part[i]]:
                v = fabs(at.slack[i]) if at.own[i] > MAX_SIZE_GROWTH * fabs(t[i]) else at.excess[i]
                hidden = max(hidden, v / fabs(t[i]))
            elif t[i] == 0.0:
                hidden = max(hidden, at.excess[i] * at.e[i] / least[at.row_part[i]])
    for j in range(n):
        w = at.reach[j] if at.reach[j] > 0.0 else at.divisor[j]
        v = fabs((at.gradient[j] - at.force[j]) + (at.gradient_lost[j] - at.force_lost[j]))
        lost = ROUNDING * at.full[j]
        v = max(v, lost) if at.full[j] > MAX_SIZE_GROWTH * w else max(v - lost, 0.0)
        strict = max(strict, ratio_or_inf(v, w))
    v = errors.total if isfinite(terms) else INFINITY
    return v, max(v, strict), errors.row, errors.column, active_, complementary, hidden


cdef inline double approximate_log2(double x) noexcept nogil:
    """Return log2 of a positive normal number, at most 0.09 too small: its exponent plus its mantissa above 1."""
    cdef int64_t bits
    memcpy(&bits, &x, 8)
    return <double>bits * 2.0**-52 - 1023.0


cdef inline double power_of_two(double x) noexcept nogil:
    """Return the power of two nearest to a positive number in logarithm; 1 for other numbers."""
    return exp2(round(approximate_log2(x))) if 2.0**-1022 < x < INFINITY else 1.0


cdef void apply_normal_matrix(const csr_t* p, const csr_t* a, const double* logs, const double* s, double* out) noexcept nogil:
    """Compute the normal matrix of (8) times s (n + m + 1); entries with a logarithm of inf have no part."""
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
    """Compute logs, right-hand side and diagonal of (8); `top` (n) is workspace."""
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

        sum log2(g |P_jk| D_j D_k)^2 + sum log2(|J_ij| E_i D_j)^2                         (Curtis, Reid 1972)            (8)

    by conjugate gradients; then E is 1 over the largest entry of each row. sigma is the size of x (`choose_size`). c makes
    the largest entry of the scaled P and q equal to 1. variable_ (m,) is the variable of a row that is a bound, -1 for other
    rows; bounds have no part in (8).

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
