"""Effect of rounding to float32 on a slack in generalised coordinates: squared changes of each entry.

With z_i = M^-1 J_i^T, A_ij = J_j . z_i + theta_i (i = j), x = M^-1 J^T lambda, f = M^2 x^2 + J^T^2 lambda^2, every matrix
squared entry by entry, and u = 2^-24 (the formulas of lavender/judge/residuals.py):

    impulse     u^2 A^2 lambda^2                                                                          (1)
    data        u^2 (J^2 x^2 + z^2 f + theta^2 lambda^2 + target^2 + 2 J^2 v*^2),  target = b + J v*      (4)
    velocities  u^2 A^2 ((J^2 x^2 + b^2 + theta^2 lambda^2) / theta^2 on rows that act), 0 if one of them is rigid     (5)
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.generalized cimport (multiply_jacobian_transpose, multiply_jacobian_row, solve_mass_matrix,
                                            add_scaled_whitened_row)
from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport generalized_t
from lavender_ext.judge.score cimport relative_residual, score_t
from lavender_ext.judge.tally cimport get_block_in_order


cdef struct mass_t:             # the lower triangle of M with its diagonal, columns ascending
    const int32_t* ptr          # (n + 1)
    const int32_t* idx
    const double* val


cdef inline double multiply_squared_row(const generalized_t* g, int32_t i, const double* x) noexcept nogil:
    """Return (J_i)^2 x, with squared entries of row i."""
    cdef int32_t q
    cdef double s = 0.0
    for q in range(g.jptr[i], g.jptr[i + 1]):
        s += g.jval[q] * g.jval[q] * x[g.jidx[q]]
    return s


cdef inline void compute_squared_float32_rounding(const blocks_t* p, const generalized_t* g, const mass_t* mass,
                                                  const double* free, const double* lam, double* impulse, double* data,
                                                  double* velocities, double* work) noexcept nogil:
    """Compute (1), (4) and (5), (m) [m2/s2] each; free (n) is v*, work (4 n + m) is scratch."""
    cdef int32_t i, j, q, k, m = p.n_rows, n = g.n, panel = 0
    cdef double* x = work
    cdef double* xx = x + n
    cdef double* f = xx + n
    cdef double* z = f + n
    cdef double* off = z + n
    cdef double unit = 5.9604644775390625e-08 * 5.9604644775390625e-08, s, row_square, soft, target
    cdef bint rigid = False
    multiply_jacobian_transpose(g, lam, x)
    solve_mass_matrix(g, x)
    for k in range(n):
        xx[k] = x[k] * x[k]
        f[k] = 0.0
    for i in range(m):
        s = lam[i] * lam[i]
        for q in range(g.jptr[i], g.jptr[i + 1]):
            f[g.jidx[q]] += g.jval[q] * g.jval[q] * s
    for k in range(n):
        for q in range(mass.ptr[k], mass.ptr[k + 1]):
            if mass.val[q] == 0.0:                      # Skip zeros: 0 times an infinite velocity is NaN.
                continue
            s = mass.val[q] * mass.val[q]
            f[k] += s * xx[mass.idx[q]]
            if mass.idx[q] != k:
                f[mass.idx[q]] += s * xx[k]
    for i in range(m):
        row_square = multiply_squared_row(g, i, xx)
        soft = g.compliance[i] * lam[i]
        off[i] = 0.0
        if lam[i] != 0.0 and lam[i] != p.lower[i] and lam[i] != p.upper[i]:
            rigid |= g.compliance[i] == 0.0
            off[i] = (row_square + p.b[i] * p.b[i] + soft * soft) / (g.compliance[i] * g.compliance[i])
        target = p.b[i] + multiply_jacobian_row(g, i, free)
        data[i] = row_square + soft * soft + target * target
    for k in range(n):
        xx[k] = free[k] * free[k]
    for i in range(m):
        while g.prow[panel + 1] <= i:
            panel += 1
        # z = M^-1 J_i^T = L^-1 D^-1/2 Y_i^T, half of a solve with the factor of M
        for k in range(n):
            z[k] = 0.0
        add_scaled_whitened_row(g, panel, i, 1.0, z)
        for k in range(n):
            s = z[k] * g.root[k]
            for q in range(g.lptr[k], g.lptr[k + 1]):
                s -= g.lval[q] * z[g.lidx[q]]
            z[k] = s
        data[i] += 2.0 * multiply_squared_row(g, i, xx)
        for k in range(n):
            data[i] += z[k] * z[k] * f[k]
        data[i] *= unit
        impulse[i] = velocities[i] = 0.0
        # A is symmetric, and A_ij is not needed for two rows without an impulse.
        for j in range(i + 1):
            if lam[i] == 0.0 and lam[j] == 0.0:
                continue
            s = multiply_jacobian_row(g, j, z) + (g.compliance[i] if i == j else 0.0)
            s *= unit * s
            impulse[i] += s * (lam[j] * lam[j])
            velocities[i] += 0.0 if rigid else s * off[j]
            if i != j:
                impulse[j] += s * (lam[i] * lam[i])
                velocities[j] += 0.0 if rigid else s * off[i]


cdef inline double relative_size_of_change(const blocks_t* p, int32_t island, const double* square, double e0,
                                           double v0) noexcept nogil:
    """Return the size of changes of w over an island relative to E0 and V0, from their squares (m); island -1 is all rows."""
    cdef int32_t a, i, k, first = 0, end = p.n_blocks
    cdef const int32_t* order = NULL
    cdef double energy = 0.0, velocity = 0.0, v, own = 0.0
    if island >= 0:
        order, first, end = p.islands.order, p.islands.ptr[island], p.islands.ptr[island + 1]
    for a in range(first, end):
        i = get_block_in_order(order, a)
        for k in range(p.ptr[i], p.ptr[i + 1]):
            energy += square[k] / p.d[k]
            v = sqrt(p.nu[k]) * sqrt(p.d[k]) * sqrt(square[k]) / p.d[k]
            if not v <= velocity:
                velocity = v
            v = sqrt(square[k])
            if v > own * fabs(p.b[k]):                  # The change is compared with the row's own terms.
                own = v / fabs(p.b[k]) if p.b[k] != 0.0 else 1.0 / 0.0
    return own if island >= 0 and e0 < 0.0 else relative_residual(sqrt(energy), velocity, e0, v0)


cdef inline bint is_float32_rounding(double residual, double floor) noexcept nogil:
    """Return whether rounding to float32 explains a relative residual: at most four times the root-mean-square floor."""
    return residual <= 4.0 * floor < 1.0 / 0.0 and residual < 1.0


cdef inline double float32_floor_of_score(const blocks_t* p, const double* square, const score_t* s, double now, double e0,
                                          double v0, double* above) noexcept nogil:
    """Return the float32 floor of a pass; with islands, the floor of the island with the largest residual.

    `above` receives the relative residual that float32 rounding does not explain.
    With islands, s.by_island must hold the relative residuals.
    """
    cdef int32_t i
    cdef double floor, worst = 0.0, own
    if p.islands == NULL:
        floor = relative_size_of_change(p, -1, square, e0, v0)
        above[0] = 0.0 if is_float32_rounding(now, floor) else now
        return floor
    above[0] = 0.0
    for i in range(p.islands.n):
        floor = relative_size_of_change(p, i, square, p.islands.reference[2 * i], p.islands.reference[2 * i + 1])
        own = s.by_island[2 * i]
        if not is_float32_rounding(own, floor) and own > above[0]:
            above[0] = own
        if i == s.island:
            worst = floor
    return worst
