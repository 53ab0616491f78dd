"""Newton systems of the whole problem: block Cholesky, interior point steps, natural map of every block.

Scaled by d = diag(A): z = D^1/2 lambda [sqrt J], g = D^-1/2 b, s = H z - g,

    H = D^-1/2 A D^-1/2 = K K^T + diag(theta),   K = D^-1/2 J M^-1/2                              (1)

Elements: a bounded row, or a contact (normal, tangents, spin) whose cones in z are |z_t| <= a_t z_n and
|z_s| <= a_s z_n. Both methods below ask for (H + W) dz = r with one small W for each element; in the
velocity form, with V = (theta + W)^-1 per element,

    N = I + K^T V K,   N dy = K^T V r,   dz = V (r - K dy)                                        (2)

and N, one block of `s` columns for each body, is factored by block Cholesky in a fixed order. Nothing
here squares J twice, and rows that depend on each other cost nothing.

Interior point (Mehrotra 1992; Nesterov and Todd 1997 for the cones; Vandenberghe 2010, section 5 and 7):
u dual to G z, G z and u inside every cone, W = G^T T^-2 G with T u = T^-1 G z = v the scaling,

    affine     (H + W) dz = -(H z - g),                    du = -u - T^-2 G dz                    (3)
    combined   c = v o v + (T^-1 G dz_a) o (T du_a) - sigma mu e,   sigma = (mu_a / mu)^3
               (H + W) dz = -(H z - g - G^T u) - G^T T^-1 (v \\ c),  du = -T^-1 (v \\ c) - T^-2 G dz  (4)

Natural map F = z - Pi(z - s), Newton step with a proximal weight eps on what is fixed by H alone:

    (I - P + P (theta + eps)) dz + P K dy = r,   dy = K^T dz,   P in the derivative of Pi         (5)

with E = I - P + P (theta + eps) the same as (2) for V = E^-1 P, r -> P^-1 r. For Coulomb friction the
radius of the disk is a_t max(0, z_n - s_n) (Alart and Curnier 1991), P is not symmetric, and N is
factored by block LU.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.block cimport CONTACT, CONTACT_SPIN as SPIN, ROW, blocks_t, n_tangents
from lavender_ext.core.problem cimport Data
from lavender_ext.core.rows cimport contact_jacobian, rows_t

cdef enum:                      # which natural map
    CONVEX = 0
    COULOMB = 1                 # radius a_t z_n; P is then the derivative for fixed radius alone
    AUGMENTED = 2               # radius a_t (z_n - s_n), Alart-Curnier

cdef enum:                      # what is kept of a cone: w (4), eta, 1 / eta, 1 / (1 + w_0), and
    CONE = 16
    V = 8                       # v (3)
    C = 12                      # v \\ c of the combined step (3)

cdef struct factor_t:
    int32_t n                   # block columns
    int32_t s                   # rows of a block, 1 to 6
    const int32_t* nptr         # (n + 1) blocks of row k of N, columns <= k ascending, the diagonal last
    const int32_t* nind
    const int32_t* rptr         # (n + 1) pattern of row k of L, columns < k ascending
    const int32_t* rind
    const int32_t* lptr         # (n + 1) column of L, rows > j ascending
    const int32_t* lind
    double* nval                # lower blocks of N, row-major
    double* mval                # their mirror (upper blocks, transposed), unsymmetric only
    double* lval                # blocks of L, each transposed
    double* uval                # blocks of U, unsymmetric only
    double* dval                # (n) factored diagonal blocks
    double* work                # (n) blocks, zero between calls
    double* work2
    int32_t* pivot              # (n s), unsymmetric only
    int32_t* next               # (n)

cdef struct elements_t:
    int32_t n                   # elements
    int32_t m                   # rows
    int32_t s                   # columns of a body in the panel
    const int32_t* ptr          # (n + 1) first row
    const int32_t* kind         # (n) ROW (one row each) | CONTACT | SPIN
    const int32_t* wptr         # (n + 1) first entry of the element's small square matrices
    const int32_t* node         # (n, 2) block columns, the first the larger, -1 where static
    const int32_t* slot         # (n, 3) blocks of N: first-first, second-second, first-second
    int32_t n_groups            # runs of elements between the same bodies: one manifold each, usually
    const int32_t* group        # (n_groups + 1) first element
    const double* panel         # (m, 2 s) K
    const double* theta         # (m)
    const double* g             # (m)
    const double* lower         # (m) scaled, read on ROW
    const double* upper         # (m)
    const double* at            # (n) a_t
    const double* as_           # (n) a_s
    double* scaling             # (n, 2, CONE) of the element's cones, once lav_ipm_scale has run


cdef struct interior_t:         # an interior point of the velocity form and its scratch
    double delta                # proximal weight
    double damping              # share of the step to the boundary
    double degree               # cones
    double* z                   # (m)
    double* u1                  # (m) duals
    double* u2                  # (m)
    double* hz                  # (m) H z
    double* v                   # V of every element
    double* bt                  # B^T with V = B B^T, or NULL
    double* da                  # (m) affine direction
    double* dz                  # (m)
    double* r                   # (m)
    double* t                   # (m)
    double* q                   # (m)
    double* y                   # (n s)
    const double* speed         # (m) velocity error per unit of f
    int32_t* side               # (n) bound that a row rests on by its natural map, after the last step
    int32_t changed             # rows that took another side in it
    double length               # of the last step
    double gap                  # G z . u / degree before it
    double energy               # |F| after it, the judge's energy error
    double velocity             # the judge's velocity error

# -- small dense blocks ---------------------------------------------------------------------------


cdef inline void sub_product(double* w, const double* y, const double* lt, const int32_t s) noexcept nogil:
    # w -= y l^T, l given transposed; one row of w at a time in registers
    cdef int32_t r, c, t
    cdef double x
    cdef double row[6]
    for r in range(s):
        for c in range(s):
            row[c] = w[r * s + c]
        for t in range(s):
            x = y[r * s + t]
            for c in range(s):
                row[c] -= x * lt[t * s + c]
        for c in range(s):
            w[r * s + c] = row[c]


cdef inline void sub_transposed(double* wt, const double* yt, const double* lt, const int32_t s) noexcept nogil:
    # w -= y l^T with all three transposed: w^T -= l y^T
    cdef int32_t r, c, t
    cdef double x
    cdef double row[6]
    for c in range(s):
        for r in range(s):
            row[r] = wt[c * s + r]
        for t in range(s):
            x = lt[t * s + c]
            for r in range(s):
                row[r] -= x * yt[t * s + r]
        for r in range(s):
            wt[c * s + r] = row[r]


cdef inline int32_t small_cholesky(double* a, const int32_t s) noexcept nogil:
    # a = l l^T in the lower triangle; the diagonal holds 1 / l_ii. A pivot lost to rounding drops its column.
    cdef int32_t i, j, t, lost = 0
    cdef double x, top
    for j in range(s):
        top = a[j * s + j]
        x = top
        for t in range(j):
            x -= a[j * s + t] * a[j * s + t]
        if not x > 1e-15 * top:
            lost += 1
            x = 0.0
        else:
            x = 1.0 / sqrt(x)
        a[j * s + j] = x
        for i in range(j + 1, s):
            top = a[i * s + j]
            for t in range(j):
                top -= a[i * s + t] * a[j * s + t]
            a[i * s + j] = top * x
    return lost


cdef inline void sub_column_3(const factor_t* f, int32_t start, int32_t end, const double* y) noexcept nogil:
    # w^T -= l y^T for blocks `start` to `end` of a column, 3 x 3 each; y in locals, which no store can change
    cdef double a0 = y[0], a1 = y[1], a2 = y[2], b0 = y[3], b1 = y[4], b2 = y[5], c0 = y[6], c1 = y[7], c2 = y[8]
    cdef double u, v, w
    cdef int32_t p
    cdef double *to
    cdef const double *l = f.lval + 9 * <int64_t>start
    for p in range(start, end):
        to = f.work + 9 * f.lind[p]
        u = l[0]
        v = l[3]
        w = l[6]
        to[0] -= u * a0 + v * b0 + w * c0
        to[1] -= u * a1 + v * b1 + w * c1
        to[2] -= u * a2 + v * b2 + w * c2
        u = l[1]
        v = l[4]
        w = l[7]
        to[3] -= u * a0 + v * b0 + w * c0
        to[4] -= u * a1 + v * b1 + w * c1
        to[5] -= u * a2 + v * b2 + w * c2
        u = l[2]
        v = l[5]
        w = l[8]
        to[6] -= u * a0 + v * b0 + w * c0
        to[7] -= u * a1 + v * b1 + w * c1
        to[8] -= u * a2 + v * b2 + w * c2
        l += 9


cdef inline void solve_right(double* yt, const double* l, const int32_t s) noexcept nogil:
    # y <- y l^-T, held transposed: y^T <- l^-1 y^T, a row of y^T at a time
    cdef int32_t r, c, t
    cdef double x
    cdef double row[6]
    for c in range(s):
        for r in range(s):
            row[r] = yt[c * s + r]
        for t in range(c):
            x = l[c * s + t]
            for r in range(s):
                row[r] -= x * yt[t * s + r]
        x = l[c * s + c]
        for r in range(s):
            yt[c * s + r] = row[r] * x


cdef inline int32_t factor_blocks(const factor_t* f, const int32_t s) noexcept nogil:
    # Row k of N and of L as transposed blocks: every loop inside runs along a row of them.
    cdef int32_t k, q, p, j, c, r, lost = 0
    cdef int64_t b = s * s
    cdef double *y
    cdef double *l
    for k in range(f.n):
        f.next[k] = f.lptr[k]
    for k in range(f.n):
        for q in range(f.nptr[k], f.nptr[k + 1]):
            y = f.work + f.nind[q] * b
            for r in range(s):
                for c in range(s):
                    y[c * s + r] = f.nval[q * b + r * s + c]
        for q in range(f.rptr[k], f.rptr[k + 1]):
            j = f.rind[q]
            y = f.work + j * b
            solve_right(y, f.dval + j * b, s)
            if s == 3:
                sub_column_3(f, f.lptr[j], f.next[j], y)
            else:
                for p in range(f.lptr[j], f.next[j]):
                    sub_transposed(f.work + f.lind[p] * b, y, f.lval + p * b, s)
            sub_transposed(f.work + k * b, y, y, s)
            l = f.lval + f.next[j] * b
            f.next[j] += 1
            for c in range(s * s):
                l[c] = y[c]
                y[c] = 0.0
        y = f.work + k * b
        lost += small_cholesky(y, s)
        for c in range(s * s):
            f.dval[k * b + c] = y[c]
            y[c] = 0.0
    return lost


cdef public int32_t lav_block_cholesky(const factor_t* f) noexcept nogil:
    """N = L L^T, up-looking by block rows; returns the number of pivots lost to rounding."""
    if f.s == 1:
        return factor_blocks(f, 1)
    if f.s == 2:
        return factor_blocks(f, 2)
    if f.s == 3:
        return factor_blocks(f, 3)
    if f.s == 6:
        return factor_blocks(f, 6)
    return factor_blocks(f, f.s)


cdef inline void solve_blocks(const factor_t* f, double* x, const int32_t s) noexcept nogil:
    cdef int32_t j, p, r, c
    cdef int64_t b = s * s
    cdef double t
    cdef const double *l
    cdef const double *d
    cdef double *y
    for j in range(f.n):
        d = f.dval + j * b
        for r in range(s):
            t = x[j * s + r]
            for c in range(r):
                t -= d[r * s + c] * x[j * s + c]
            x[j * s + r] = t * d[r * s + r]
        for p in range(f.lptr[j], f.lptr[j + 1]):
            l = f.lval + p * b
            y = x + f.lind[p] * s
            for c in range(s):
                t = x[j * s + c]
                for r in range(s):
                    y[r] -= l[c * s + r] * t
    for j in range(f.n - 1, -1, -1):
        for p in range(f.lptr[j], f.lptr[j + 1]):
            l = f.lval + p * b
            y = x + f.lind[p] * s
            for c in range(s):
                t = 0.0
                for r in range(s):
                    t += l[c * s + r] * y[r]
                x[j * s + c] -= t
        d = f.dval + j * b
        for r in range(s - 1, -1, -1):
            t = x[j * s + r]
            for c in range(r + 1, s):
                t -= d[c * s + r] * x[j * s + c]
            x[j * s + r] = t * d[r * s + r]


cdef public void lav_block_solve(const factor_t* f, double* x) noexcept nogil:
    """x <- N^-1 x after `lav_block_cholesky`, x (n, s)."""
    if f.s == 1:
        solve_blocks(f, x, 1)
    elif f.s == 3:
        solve_blocks(f, x, 3)
    elif f.s == 6:
        solve_blocks(f, x, 6)
    else:
        solve_blocks(f, x, f.s)


# -- unsymmetric: block LU with pivots inside the diagonal blocks ------------------------------------


cdef inline int32_t small_lu(double* a, int32_t* pivot, const int32_t s) noexcept nogil:
    cdef int32_t i, j, k, best, lost = 0
    cdef double x, top
    for j in range(s):
        best = j
        top = fabs(a[j * s + j])
        for i in range(j + 1, s):
            if fabs(a[i * s + j]) > top:
                top = fabs(a[i * s + j])
                best = i
        pivot[j] = best
        if best != j:
            for k in range(s):
                x = a[j * s + k]
                a[j * s + k] = a[best * s + k]
                a[best * s + k] = x
        if not top > 1e-300:
            lost += 1
            a[j * s + j] = 0.0
            x = 0.0
        else:
            x = 1.0 / a[j * s + j]
            a[j * s + j] = x                            # kept as reciprocal
        for i in range(j + 1, s):
            a[i * s + j] = a[i * s + j] * x
            for k in range(j + 1, s):
                a[i * s + k] -= a[i * s + j] * a[j * s + k]
    return lost


cdef inline void small_solve(const double* a, const int32_t* pivot, double* x, const int32_t s,
                             const int32_t step) noexcept nogil:
    # x <- a^-1 x, entries `step` apart
    cdef int32_t i, j
    cdef double t
    for j in range(s):
        if pivot[j] != j:
            t = x[j * step]
            x[j * step] = x[pivot[j] * step]
            x[pivot[j] * step] = t
    for i in range(1, s):
        for j in range(i):
            x[i * step] -= a[i * s + j] * x[j * step]
    for i in range(s - 1, -1, -1):
        for j in range(i + 1, s):
            x[i * step] -= a[i * s + j] * x[j * step]
        x[i * step] *= a[i * s + i]


cdef inline int32_t lu_blocks(const factor_t* f, const int32_t s) noexcept nogil:
    # L unit, D blocks, U = D times what is kept: N_kj = sum L_kq N_qj. With Y = row k of N after
    # elimination, L_kj = Y_kj D_j^-1; uval holds D_j^-1 U_jk, lval holds Y_kj (transposed).
    cdef int32_t k, q, p, j, i, c, r, lost = 0
    cdef int64_t b = s * s
    cdef double *y
    cdef double *z
    cdef double *l
    cdef double *u
    for k in range(f.n):
        f.next[k] = f.lptr[k]
    for k in range(f.n):
        for q in range(f.nptr[k], f.nptr[k + 1]):
            y = f.work + f.nind[q] * b
            z = f.work2 + f.nind[q] * b                 # transposed: column k of N, as rows
            for c in range(s * s):
                y[c] = f.nval[q * b + c]
                z[c] = f.mval[q * b + c]
        for q in range(f.rptr[k], f.rptr[k + 1]):
            j = f.rind[q]
            y = f.work + j * b                          # Y_kj
            z = f.work2 + j * b                         # (U_jk)^T
            # z <- (D_j^-1 U_jk)^T: each row of z is a column of U_jk
            for r in range(s):
                small_solve(f.dval + j * b, f.pivot + j * s, z + r * s, s, 1)
            for p in range(f.lptr[j], f.next[j]):
                i = f.lind[p]
                # N_ki -= Y_kj (D_j^-1 U_ji);  N_ik -= Y_ij (D_j^-1 U_jk), held transposed
                sub_product(f.work + i * b, y, f.uval + p * b, s)
                sub_product(f.work2 + i * b, z, f.lval + p * b, s)
            l = f.lval + f.next[j] * b
            u = f.uval + f.next[j] * b
            f.next[j] += 1
            for r in range(s):
                for c in range(s):
                    l[c * s + r] = y[r * s + c]
                    u[c * s + r] = z[r * s + c]
            sub_product(f.work + k * b, y, u, s)        # D_k -= Y_kj (D_j^-1 U_jk)
            for c in range(s * s):
                y[c] = 0.0
                z[c] = 0.0
        y = f.work + k * b
        lost += small_lu(y, f.pivot + k * s, s)
        for c in range(s * s):
            f.dval[k * b + c] = y[c]
            y[c] = 0.0
            f.work2[k * b + c] = 0.0
    return lost


cdef public int32_t lav_block_lu(const factor_t* f) noexcept nogil:
    """N = L U with the pattern of the symmetric factor; returns the number of zero pivots."""
    if f.s == 3:
        return lu_blocks(f, 3)
    if f.s == 6:
        return lu_blocks(f, 6)
    return lu_blocks(f, f.s)


cdef public void lav_block_lu_solve(const factor_t* f, double* x) noexcept nogil:
    """x <- N^-1 x after `lav_block_lu`."""
    cdef int32_t j, p, r, c, s = f.s
    cdef int64_t b = s * s
    cdef double t
    cdef double *y
    cdef const double *l
    for j in range(f.n):                                # x_j <- D_j^-1 x_j, x_i -= Y_ij x_j
        small_solve(f.dval + j * b, f.pivot + j * s, x + j * s, s, 1)
        for p in range(f.lptr[j], f.lptr[j + 1]):
            l = f.lval + p * b
            y = x + f.lind[p] * s
            for c in range(s):
                t = x[j * s + c]
                for r in range(s):
                    y[r] -= l[c * s + r] * t
    for j in range(f.n - 1, -1, -1):                    # x_j -= (D_j^-1 U_ji) x_i
        for p in range(f.lptr[j], f.lptr[j + 1]):
            l = f.uval + p * b
            y = x + f.lind[p] * s
            for r in range(s):
                t = 0.0
                for c in range(s):
                    t += l[r * s + c] * y[c]
                x[j * s + r] -= t


# -- K ----------------------------------------------------------------------------------------------


cdef public int32_t lav_inertia_root(int32_t n, const double* inv_inertia, double* root) noexcept nogil:
    """Lower L with L L^T = I^-1 for each body, (n, 9); a pivot at rounding is a pinned axis, zero."""
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
    return 0


cdef public void lav_panel(const blocks_t* p, const rows_t* r, const double* root, const double* root_mass,
                           double* panel) noexcept nogil:
    """K (m, 12): D^-1/2 J M^-1/2, columns of body a then b."""
    cdef int32_t i, j, q, c, k, h, a, b, body
    cdef double jac[48]
    cdef double x
    cdef const double *row
    cdef const double *l
    cdef double *out
    for i in range(p.n_blocks):
        j = p.ptr[i]
        c = i - r.n_joints
        if c < 0:
            a = r.joint_body[2 * i]
            b = r.joint_body[2 * i + 1]
            row = r.jac + 12 * j
        else:
            a = r.contact_body[2 * c]
            b = r.contact_body[2 * c + 1]
            contact_jacobian(r, c, n_tangents(p.kind[i], p.ptr[i + 1] - j), p.kind[i] == SPIN, jac)
            row = jac
        for q in range(j, p.ptr[i + 1]):
            out = panel + 12 * <int64_t>q
            x = 1.0 / sqrt(p.d[q])
            for h in range(2):
                body = a if h == 0 else b
                for k in range(6):
                    out[6 * h + k] = 0.0
                if body >= 0:
                    l = root + 9 * body
                    for k in range(3):
                        out[6 * h + k] = x * row[6 * h + k] * root_mass[body]
                        out[6 * h + 3 + k] = x * (row[6 * h + 3] * l[k] + row[6 * h + 4] * l[3 + k] + row[6 * h + 5] * l[6 + k])
            row += 12


# -- symbolic ---------------------------------------------------------------------------------------


cdef public void lav_block_tree(int32_t n, const int32_t* nptr, const int32_t* nind, int32_t* parent,
                                int32_t* mark, int32_t* row_count, int32_t* column_count) noexcept nogil:
    """Elimination tree of the lower pattern, and how many blocks each row and column of L holds."""
    cdef int32_t k, q, j
    for k in range(n):
        parent[k] = -1
        mark[k] = k
        row_count[k] = 0
        column_count[k] = 0
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                if parent[j] < 0:
                    parent[j] = k
                mark[j] = k
                row_count[k] += 1
                column_count[j] += 1
                j = parent[j]


cdef public void lav_block_pattern(int32_t n, const int32_t* nptr, const int32_t* nind, const int32_t* parent,
                                   int32_t* mark, const int32_t* lptr, const int32_t* rptr, int32_t* next,
                                   int32_t* lind, int32_t* rind) noexcept nogil:
    """Rows of every column of L, and columns of every row, both ascending."""
    cdef int32_t k, q, j, p
    for k in range(n):
        mark[k] = k
        next[k] = lptr[k]
        for q in range(nptr[k], nptr[k + 1]):
            j = nind[q]
            while j < k and mark[j] != k:
                mark[j] = k
                lind[next[j]] = k
                next[j] += 1
                j = parent[j]
    for k in range(n):
        next[k] = rptr[k]
    for j in range(n):
        for p in range(lptr[j], lptr[j + 1]):
            k = lind[p]
            rind[next[k]] = j
            next[k] += 1


# -- the normal matrix ------------------------------------------------------------------------------


cdef inline void add_product(double* out, const double* left, const double* right, int32_t nr,
                             const int32_t s) noexcept nogil:
    # out += left^T right, (nr, 2 s) rows of which s columns are read
    cdef int32_t i, j, r
    cdef double x
    cdef double row[6]
    for i in range(s):
        for j in range(s):
            row[j] = out[i * s + j]
        for r in range(nr):
            x = left[r * 2 * s + i]
            for j in range(s):
                row[j] += x * right[r * 2 * s + j]
        for j in range(s):
            out[i * s + j] = row[j]


cdef inline void weigh(const double* v, const double* rows, double* t, int32_t nr, const int32_t s) noexcept nogil:
    # t = V rows, (nr, 2 s)
    cdef int32_t r, k, c
    cdef double x
    cdef double row[12]
    for r in range(nr):
        x = v[r * nr]
        for c in range(2 * s):
            row[c] = x * rows[c]
        for k in range(1, nr):
            x = v[r * nr + k]
            for c in range(2 * s):
                row[c] += x * rows[k * 2 * s + c]
        for c in range(2 * s):
            t[r * 2 * s + c] = row[c]


cdef inline void add_elements(const elements_t* e, const double* v, const factor_t* f, int32_t lu, const int32_t s) noexcept nogil:
    cdef int32_t h, i, j, r, c, nr, first, second, n_blocks = f.nptr[f.n], done
    cdef int64_t b = s * s, q
    cdef double t[192]                                  # V K of up to 16 rows between two bodies, (16, 2 s)
    cdef const double *pr
    cdef const int32_t *slot
    for q in range(n_blocks * b):
        f.nval[q] = 0.0
    if lu:
        for q in range(n_blocks * b):
            f.mval[q] = 0.0
    for i in range(f.n):
        q = (f.nptr[i + 1] - 1) * b
        for c in range(s):
            f.nval[q + c * s + c] = 1.0
            if lu:
                f.mval[q + c * s + c] = 1.0
    for h in range(e.n_groups):
        i = e.group[h]
        first = e.node[2 * i]
        second = e.node[2 * i + 1]
        slot = e.slot + 3 * i
        if first < 0:
            continue
        while i < e.group[h + 1]:
            j = e.ptr[i]
            pr = e.panel + <int64_t>j * 2 * s
            done = 0
            while i < e.group[h + 1] and done <= 12:
                nr = e.ptr[i + 1] - e.ptr[i]
                if nr == 1:
                    weigh(v + e.wptr[i], pr + done * 2 * s, t + done * 2 * s, 1, s)
                elif nr == 3:
                    weigh(v + e.wptr[i], pr + done * 2 * s, t + done * 2 * s, 3, s)
                else:
                    weigh(v + e.wptr[i], pr + done * 2 * s, t + done * 2 * s, nr, s)
                done += nr
                i += 1
            add_product(f.nval + slot[0] * b, pr, t, done, s)
            if second >= 0:
                add_product(f.nval + slot[1] * b, pr + s, t + s, done, s)
                add_product(f.nval + slot[2] * b, pr, t + s, done, s)
                if lu:
                    # block (second, first) of K^T V K, transposed: (V K_first)^T K_second
                    add_product(f.mval + slot[2] * b, t, pr + s, done, s)
    if lu:
        # The mirror of a diagonal block is its transpose; only off-diagonal blocks are read there.
        for i in range(f.n):
            q = (f.nptr[i + 1] - 1) * b
            for r in range(s):
                for c in range(s):
                    f.mval[q + c * s + r] = f.nval[q + r * s + c]


cdef public void lav_normal_matrix(const elements_t* e, const double* v, const factor_t* f, int32_t lu) noexcept nogil:
    """N = I + K^T V K of (2) into the blocks of `f`; with `lu` the upper blocks too."""
    if f.s == 1:
        add_elements(e, v, f, lu, 1)
    elif f.s == 3:
        add_elements(e, v, f, lu, 3)
    elif f.s == 6:
        add_elements(e, v, f, lu, 6)
    else:
        add_elements(e, v, f, lu, f.s)


cdef inline void to_bodies(const elements_t* e, int32_t n, const double* x, double* y, const int32_t s) noexcept nogil:
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


cdef inline void to_rows(const elements_t* e, const double* y, double* x, const int32_t s) noexcept nogil:
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


cdef public void lav_to_bodies(const elements_t* e, int32_t n, const double* x, double* y) noexcept nogil:
    """y = K^T x, (n, s)."""
    if e.s == 1:
        to_bodies(e, n, x, y, 1)
    elif e.s == 3:
        to_bodies(e, n, x, y, 3)
    elif e.s == 6:
        to_bodies(e, n, x, y, 6)
    else:
        to_bodies(e, n, x, y, e.s)


cdef public void lav_to_rows(const elements_t* e, const double* y, double* x) noexcept nogil:
    """x = K y, (m)."""
    if e.s == 1:
        to_rows(e, y, x, 1)
    elif e.s == 3:
        to_rows(e, y, x, 3)
    elif e.s == 6:
        to_rows(e, y, x, 6)
    else:
        to_rows(e, y, x, e.s)


# -- small square matrices of an element, at most 4 x 4 ------------------------------------------------


cdef inline void invert_small(double* a, double* inv, int32_t n) noexcept nogil:
    # Gauss-Jordan with row pivots; a is lost. A zero pivot leaves zeros in its column.
    cdef int32_t i, j, k, best
    cdef double x
    for i in range(n * n):
        inv[i] = 0.0
    for i in range(n):
        inv[i * n + i] = 1.0
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if fabs(a[i * n + k]) > fabs(a[best * n + k]):
                best = i
        if best != k:
            for j in range(n):
                x = a[k * n + j]
                a[k * n + j] = a[best * n + j]
                a[best * n + j] = x
                x = inv[k * n + j]
                inv[k * n + j] = inv[best * n + j]
                inv[best * n + j] = x
        x = a[k * n + k]
        x = 1.0 / x if fabs(x) > 1e-300 else 0.0
        for j in range(n):
            a[k * n + j] *= x
            inv[k * n + j] *= x
        for i in range(n):
            if i != k:
                x = a[i * n + k]
                if x != 0.0:
                    for j in range(n):
                        a[i * n + j] -= x * a[k * n + j]
                        inv[i * n + j] -= x * inv[k * n + j]


cdef inline void element_times(const elements_t* e, const double* w, const double* x, double* out) noexcept nogil:
    cdef int32_t i, j, r, c, nr
    cdef double t
    if e.n == e.m:
        for i in range(e.m):
            out[i] = w[i] * x[i]
        return
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        for r in range(nr):
            t = 0.0
            for c in range(nr):
                t += w[e.wptr[i] + r * nr + c] * x[j + c]
            out[j + r] = t


cdef inline void element_times_transposed(const elements_t* e, const double* w, const double* x, double* out) noexcept nogil:
    cdef int32_t i, j, r, c, nr
    cdef double t
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        for r in range(nr):
            t = 0.0
            for c in range(nr):
                t += w[e.wptr[i] + c * nr + r] * x[j + c]
            out[j + r] = t


cdef public void lav_element_product(const elements_t* e, const double* w, const double* h, double eps, double own,
                                     double one, double* out) noexcept nogil:
    """out = W (H + eps) + one I - own W, all (m, m) row-major, W one small matrix for each element."""
    cdef int32_t i, j, k, r, c, nr, m = e.m
    cdef double x
    cdef double *y
    cdef const double *a
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        for r in range(nr):
            y = out + <int64_t>(j + r) * m
            for k in range(m):
                y[k] = 0.0
            for c in range(nr):
                x = w[e.wptr[i] + r * nr + c]
                if x == 0.0:
                    continue
                a = h + <int64_t>(j + c) * m
                for k in range(m):
                    y[k] += x * a[k]
                y[j + c] += x * (eps - own)
            y[j + r] += one


# -- H as a band: c[j width + t] = H[j + t, j] of rows in another order, elements whole ---------------------


cdef public void lav_band(int32_t m, const int32_t* indptr, const int32_t* indices, const double* a,
                          const int32_t* place, const double* scale, int32_t width, double* c) noexcept nogil:
    """Lower half of diag(scale) A diag(scale), its row i at place[i]; scale (m) in A's order."""
    cdef int32_t i, j, q
    cdef int64_t n
    for n in range(<int64_t>m * width):
        c[n] = 0.0
    for i in range(m):
        for q in range(indptr[i], indptr[i + 1]):
            j = indices[q]
            if place[i] >= place[j]:
                c[<int64_t>place[j] * width + place[i] - place[j]] = scale[i] * scale[j] * a[q]


cdef public int32_t lav_band_width(int32_t m, const int32_t* indptr, const int32_t* indices,
                                   const int32_t* place) noexcept nogil:
    """Half bandwidth of A with row i at place[i]."""
    cdef int32_t i, q, x, widest = 0
    for i in range(m):
        for q in range(indptr[i], indptr[i + 1]):
            x = place[i] - place[indices[q]]
            widest = x if x > widest else widest
    return widest


cdef public int32_t lav_element_graph(int32_t n, const int32_t* ptr, const int32_t* element, const int32_t* indptr,
                                      const int32_t* indices, int32_t* mark, int32_t* to, int32_t* other) noexcept nogil:
    """Which elements an element's rows of A reach: (to, other) as compressed rows, other as long as A's indices."""
    cdef int32_t i, j, q, k, count = 0
    for i in range(n):
        mark[i] = -1
    for i in range(n):
        to[i] = count
        for j in range(ptr[i], ptr[i + 1]):
            for q in range(indptr[j], indptr[j + 1]):
                k = element[indices[q]]
                if mark[k] != i:
                    mark[k] = i
                    other[count] = k
                    count += 1
    to[n] = count
    return count


cdef public void lav_band_free(int32_t m, int32_t width, const double* c, const double* free, double eps,
                               double* out) noexcept nogil:
    """H + eps where free (m), in the band's order, is not 0; the identity elsewhere."""
    cdef int32_t j, t
    cdef int64_t q
    for j in range(m):
        q = <int64_t>j * width
        if free[j] == 0.0:
            for t in range(width):
                out[q + t] = 0.0
            out[q] = 1.0
            continue
        for t in range(width):
            out[q + t] = c[q + t] if j + t < m and free[j + t] != 0.0 else 0.0
        out[q] += eps


cdef inline void band_block(const double* c, double* out, int32_t p, int32_t q, int32_t width, const double* left,
                            const double* right, bint diagonal, const int32_t ni, const int32_t nj) noexcept nogil:
    # out_ij = left H_ij right^T (+ I) of the block whose first row is p and first column q
    cdef int32_t k, l, t, r
    cdef bint some = False
    cdef double x
    cdef double block[16]
    cdef double half[16]
    for k in range(ni):
        for l in range(nj):
            r = p + k - q - l
            if r < 0:                                   # above the diagonal, of a diagonal block alone
                x = c[<int64_t>(p + k) * width - r]
            else:
                x = c[<int64_t>(q + l) * width + r] if r < width else 0.0
            block[k * nj + l] = x
            some = some or x != 0.0
    if not some and not diagonal:
        return
    for k in range(ni):
        for l in range(nj):
            x = 0.0
            for t in range(ni):
                x += left[k * ni + t] * block[t * nj + l]
            half[k * nj + l] = x
    for k in range(ni):
        for l in range(nj):
            r = p + k - q - l
            if 0 <= r < width:
                x = 1.0 if r == 0 else 0.0
                for t in range(nj):
                    x += half[k * nj + t] * right[l * nj + t]
                out[<int64_t>(q + l) * width + r] = x


cdef public void lav_band_scaled(const elements_t* e, const int32_t* order, const int32_t* place, int32_t width,
                                 const double* c, const double* bt, double* out) noexcept nogil:
    """I + B^T H B; elements in the band's order (n), place (m) of each row."""
    cdef int32_t h, g, i, j, p, q, ni, nj
    cdef int64_t n
    for n in range(<int64_t>e.m * width):
        out[n] = 0.0
    for h in range(e.n):
        j = order[h]
        nj = e.ptr[j + 1] - e.ptr[j]
        q = place[e.ptr[j]]
        for g in range(h, e.n):
            i = order[g]
            ni = e.ptr[i + 1] - e.ptr[i]
            p = place[e.ptr[i]]
            if p - q >= width + nj:
                break
            if ni == 3 and nj == 3:
                band_block(c, out, p, q, width, bt + e.wptr[i], bt + e.wptr[j], g == h, 3, 3)
            else:
                band_block(c, out, p, q, width, bt + e.wptr[i], bt + e.wptr[j], g == h, ni, nj)


# -- interior point ---------------------------------------------------------------------------------


cdef inline double cone_gap(const double* x, int32_t n) noexcept nogil:
    # x_0 - |x_1..|
    cdef double t = 0.0
    cdef int32_t i
    for i in range(1, n):
        t += x[i] * x[i]
    return x[0] - sqrt(t)


cdef inline double cone_det(const double* x, int32_t n) noexcept nogil:
    cdef double t = 0.0
    cdef int32_t i
    for i in range(1, n):
        t += x[i] * x[i]
    t = sqrt(t)
    return (x[0] - t) * (x[0] + t)


cdef inline double cone_step(const double* x, const double* dx, int32_t n) noexcept nogil:
    # largest step to the boundary of the second-order cone; 1e30 where there is none
    cdef double a = dx[0] * dx[0], b = x[0] * dx[0], c = cone_det(x, n), disc, q
    cdef int32_t i
    for i in range(1, n):
        a -= dx[i] * dx[i]
        b -= x[i] * dx[i]
    if c <= 0.0:
        return 0.0
    disc = b * b - a * c
    if disc < 0.0:
        return 1e30
    q = -b + sqrt(disc)
    if q <= 0.0:
        return 1e30
    return c / q


# One cone of a contact in its own coordinates: x_0 = a z_n, then the tangents (which = 0) or the spin (1).
cdef inline int32_t cone_size(const elements_t* e, int32_t i, int32_t which) noexcept nogil:
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i]
    if which == 0:
        return nr - 1 if e.kind[i] == SPIN else nr
    return 2 if e.kind[i] == SPIN else 0


cdef inline double on_normal(double a) noexcept nogil:
    return a if a > 1.0 else 1.0


cdef inline double on_tangent(double a) noexcept nogil:
    return 1.0 / a if a < 1.0 else 1.0


cdef inline void gather(const elements_t* e, int32_t i, int32_t which, const double* z, double* x) noexcept nogil:
    # x = G z, G = diag(1, 1/a) or diag(a, 1): no entry below 1, so that G never blows a proximal term up
    cdef int32_t j = e.ptr[i], n, k
    cdef double a = e.at[i] if which == 0 else e.as_[i]
    x[0] = on_normal(a) * z[j]
    if which == 0:
        n = cone_size(e, i, 0)
        for k in range(1, n):
            x[k] = on_tangent(a) * z[j + k]
    else:
        x[1] = on_tangent(a) * z[e.ptr[i + 1] - 1]


cdef inline void scatter(const elements_t* e, int32_t i, int32_t which, const double* x, double* z) noexcept nogil:
    # z += G^T x
    cdef int32_t j = e.ptr[i], n, k
    cdef double a = e.at[i] if which == 0 else e.as_[i]
    z[j] += on_normal(a) * x[0]
    if which == 0:
        n = cone_size(e, i, 0)
        for k in range(1, n):
            z[j + k] += on_tangent(a) * x[k]
    else:
        z[e.ptr[i + 1] - 1] += on_tangent(a) * x[1]


# u1 (m): dual of the lower bound, or of the tangent cone. u2 (m): of the upper bound, or of the spin cone
# (its two entries on the normal and the spin row).
cdef inline void load_dual(const elements_t* e, int32_t i, int32_t which, const double* u1, const double* u2,
                           double* x) noexcept nogil:
    cdef int32_t j = e.ptr[i], k
    if which == 0:
        for k in range(cone_size(e, i, 0)):
            x[k] = u1[j + k]
    else:
        x[0] = u2[j]
        x[1] = u2[e.ptr[i + 1] - 1]


cdef inline void store_dual(const elements_t* e, int32_t i, int32_t which, const double* x, double* u1,
                            double* u2) noexcept nogil:
    cdef int32_t j = e.ptr[i], k
    if which == 0:
        for k in range(cone_size(e, i, 0)):
            u1[j + k] = x[k]
    else:
        u2[j] = x[0]
        u2[e.ptr[i + 1] - 1] = x[1]


cdef inline bint has_cone(const elements_t* e, int32_t i, int32_t which) noexcept nogil:
    # a contact without tangents is a plain normal: its cone is the half-line, a = 1
    return which == 0 and (cone_size(e, i, 0) > 1 or e.kind[i] != SPIN) or which == 1 and e.kind[i] == SPIN


cdef inline void nt_scaling(const double* s, const double* u, int32_t n, double* w, double* eta) noexcept nogil:
    # T = eta [w0 w1'; w1 I + w1 w1'/(1 + w0)], T u = T^-1 s
    cdef double ds = sqrt(cone_det(s, n)), du = sqrt(cone_det(u, n)), dot = 0.0, gamma
    cdef int32_t k
    for k in range(n):
        dot += s[k] * u[k]
    gamma = sqrt(0.5 * (1.0 + dot / (ds * du)))
    w[0] = (s[0] / ds + u[0] / du) / (2.0 * gamma)
    for k in range(1, n):
        w[k] = (s[k] / ds - u[k] / du) / (2.0 * gamma)
    dot = 1.0
    for k in range(1, n):
        dot += w[k] * w[k]
    w[0] = sqrt(dot)                                    # w0^2 - |w1|^2 = 1 again after rounding
    eta[0] = sqrt(ds / du)


cdef inline void scale_times(const double* w, int32_t n, const double* x, double* out) noexcept nogil:
    # T x
    cdef double t = 0.0
    cdef int32_t k
    for k in range(1, n):
        t += w[k] * x[k]
    out[0] = w[4] * (w[0] * x[0] + t)
    t = x[0] + t * w[6]
    for k in range(1, n):
        out[k] = w[4] * (x[k] + w[k] * t)


cdef inline void scale_back(const double* w, int32_t n, const double* x, double* out) noexcept nogil:
    # T^-1 x
    cdef double t = 0.0
    cdef int32_t k
    for k in range(1, n):
        t += w[k] * x[k]
    out[0] = w[5] * (w[0] * x[0] - t)
    t = t * w[6] - x[0]
    for k in range(1, n):
        out[k] = w[5] * (x[k] + w[k] * t)


cdef inline void cone_divide(const double* v, const double* c, int32_t n, double* out) noexcept nogil:
    # v o out = c
    cdef double det = cone_det(v, n), dot = 0.0
    cdef int32_t k
    for k in range(1, n):
        dot += v[k] * c[k]
    out[0] = (v[0] * c[0] - dot) / det
    for k in range(1, n):
        out[k] = (c[k] - out[0] * v[k]) / v[0]


cdef inline bint is_low(const elements_t* e, int32_t j) noexcept nogil:
    return e.lower[j] > -1.7976931348623157e308


cdef inline bint is_high(const elements_t* e, int32_t j) noexcept nogil:
    return e.upper[j] < 1.7976931348623157e308


cdef inline void slack_dual(const elements_t* e, int32_t i, int32_t which, const double* hz, double* c) noexcept nogil:
    # u with G^T u = H z - g where the contact has one cone
    cdef int32_t j = e.ptr[i], k
    cdef double a = e.at[i] if which == 0 else e.as_[i]
    c[0] = (hz[j] - e.g[j]) / on_normal(a)
    if which == 0:
        for k in range(1, cone_size(e, i, 0)):
            c[k] = (hz[j + k] - e.g[j + k]) / on_tangent(a)
    else:
        k = e.ptr[i + 1] - 1
        c[1] = (hz[k] - e.g[k]) / on_tangent(a)


cdef public double lav_ipm_start(const elements_t* e, const double* hz, double dual, double* z, double* u1,
                                 double* u2) noexcept nogil:
    """Puts z and u inside their cones, starting from z with (H + I) z = g; returns the degree (number of cones).

    Vandenberghe 2010, section 7.3: both are shifted along the cones' axes, by one amount each; u's beyond the
    worst violation is `dual` times z's, because most rows carry load in the end.
    """
    cdef int32_t i, j, which, n
    cdef double worst_z = -1e300, worst_u = -1e300, size = 0.0, x, degree = 0.0, width
    cdef double c[4]
    for j in range(e.m):
        size += z[j] * z[j] + (hz[j] - e.g[j]) * (hz[j] - e.g[j])
    size = sqrt(size / (e.m if e.m > 0 else 1))
    if not size > 0.0:
        size = 1.0
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            u1[j] = 0.0
            u2[j] = 0.0
            if is_low(e, j) and is_high(e, j):
                width = e.upper[j] - e.lower[j]
                x = 0.1 * width
                if z[j] < e.lower[j] + x:
                    z[j] = e.lower[j] + x
                if z[j] > e.upper[j] - x:
                    z[j] = e.upper[j] - x
                x = hz[j] - e.g[j]
                u1[j] = dual * size + (x if x > 0.0 else 0.0)
                u2[j] = dual * size + (-x if x < 0.0 else 0.0)
                degree += 2.0
            elif is_low(e, j):
                x = e.lower[j] - z[j]
                worst_z = x if x > worst_z else worst_z
                u1[j] = hz[j] - e.g[j]
                worst_u = -u1[j] if -u1[j] > worst_u else worst_u
                degree += 1.0
            elif is_high(e, j):
                x = z[j] - e.upper[j]
                worst_z = x if x > worst_z else worst_z
                u2[j] = e.g[j] - hz[j]
                worst_u = -u2[j] if -u2[j] > worst_u else worst_u
                degree += 1.0
            continue
        for which in range(2):
            if not has_cone(e, i, which):
                continue
            n = cone_size(e, i, which)
            gather(e, i, which, z, c)
            x = -cone_gap(c, n) / on_normal(e.at[i] if which == 0 else e.as_[i])
            worst_z = x if x > worst_z else worst_z
            slack_dual(e, i, which, hz, c)
            x = -cone_gap(c, n)
            worst_u = x if x > worst_u else worst_u
            store_dual(e, i, which, c, u1, u2)
            degree += 1.0
    worst_z = worst_z + size if worst_z > -1e-8 * size else 0.0
    worst_u = worst_u + dual * size if worst_u > -1e-8 * size else 0.0
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            if is_low(e, j) and not is_high(e, j):
                z[j] += worst_z
                u1[j] += worst_u
            elif is_high(e, j) and not is_low(e, j):
                z[j] -= worst_z
                u2[j] += worst_u
            continue
        z[j] += worst_z
        for which in range(2):
            if has_cone(e, i, which):
                if which == 0:
                    u1[j] += worst_u
                else:
                    u2[j] += worst_u
    return degree


cdef public double lav_ipm_start_apart(const elements_t* e, const double* hz, double margin, double* z, double* u1,
                                       double* u2) noexcept nogil:
    """Puts z and u inside their cones, starting from z with (H + I) z = g; returns the degree (number of cones).

    Each cone apart, by no more than it needs: z and u keep at least `margin` times the mean |z| and the mean |g|
    from the boundary.
    """
    cdef int32_t i, j, which, n
    cdef double size_z = 0.0, size_u = 0.0, x, degree = 0.0, width
    cdef double c[4]
    for j in range(e.m):
        size_z += fabs(z[j])
        size_u += fabs(e.g[j])
    size_z = margin * size_z / (e.m if e.m > 0 else 1)
    size_u = margin * size_u / (e.m if e.m > 0 else 1)
    if not size_z > 0.0:
        size_z = 1.0
    if not size_u > 0.0:
        size_u = 1.0
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            u1[j] = 0.0
            u2[j] = 0.0
            x = hz[j] - e.g[j]
            if is_low(e, j) and is_high(e, j):
                width = 0.1 * (e.upper[j] - e.lower[j])
                if z[j] < e.lower[j] + width:
                    z[j] = e.lower[j] + width
                if z[j] > e.upper[j] - width:
                    z[j] = e.upper[j] - width
                u1[j] = x if x > size_u else size_u
                u2[j] = -x if -x > size_u else size_u
                degree += 2.0
            elif is_low(e, j):
                if z[j] < e.lower[j] + size_z:
                    z[j] = e.lower[j] + size_z
                u1[j] = x if x > size_u else size_u
                degree += 1.0
            elif is_high(e, j):
                if z[j] > e.upper[j] - size_z:
                    z[j] = e.upper[j] - size_z
                u2[j] = -x if -x > size_u else size_u
                degree += 1.0
            continue
        for which in range(2):
            if not has_cone(e, i, which):
                continue
            n = cone_size(e, i, which)
            slack_dual(e, i, which, hz, c)
            x = size_u - cone_gap(c, n)
            if x > 0.0:
                c[0] += x
            store_dual(e, i, which, c, u1, u2)
            gather(e, i, which, z, c)
            x = (size_z - cone_gap(c, n)) / on_normal(e.at[i] if which == 0 else e.as_[i])
            if x > 0.0:
                z[j] += x
            degree += 1.0
    return degree


cdef inline double cone_parts(const double* s, const double* u, int32_t n, double a, double delta, double* w,
                              double* h, double* c, double* root) noexcept nogil:
    # (T^-2 + delta)^-1 between G^-1 and G^-T as x [1 h][1 h]^T + [0 0; 0 c]: returns x, the normal's own entry.
    # Through the eigenvalues of T^2, eta^2 (w0 +- |w1|)^2 along (1, +-w1/|w1|) and eta^2 across: as a matrix
    # T^-2 would lose the small ones. c and its square root are (n - 1, n - 1).
    # w (CONE) keeps the scaling, and v.
    cdef double d[4]
    cdef double eta, size = 0.0, grow, shrink, across, along, x, gn = on_normal(a), gt = on_tangent(a)
    cdef int32_t k, l, nt = n - 1
    nt_scaling(s, u, n, w, &eta)
    w[4] = eta
    w[5] = 1.0 / eta
    w[6] = 1.0 / (1.0 + w[0])
    scale_times(w, n, u, w + V)
    for k in range(1, n):
        size += w[k] * w[k]
    size = sqrt(size)
    grow = eta * (w[0] + size)
    shrink = eta / (w[0] + size)
    grow = grow * grow
    shrink = shrink * shrink
    across = eta * eta
    grow = grow / (1.0 + delta * grow)
    shrink = shrink / (1.0 + delta * shrink)
    across = across / (1.0 + delta * across)
    along = 2.0 * shrink * (grow / (grow + shrink)) / (gt * gt)
    across = across / (gt * gt)
    for k in range(nt):
        d[k] = w[1 + k] / size if size > 0.0 else (1.0 if k == 0 else 0.0)
        h[k] = (grow - shrink) / (grow + shrink) * (gn / gt) * d[k]
    for k in range(nt):
        for l in range(nt):
            x = 1.0 if k == l else 0.0
            c[k * nt + l] = across * x + (along - across) * d[k] * d[l]
            root[k * nt + l] = sqrt(across) * x + (sqrt(along) - sqrt(across)) * d[k] * d[l]
    return 0.5 * (grow + shrink) / (gn * gn)


cdef public void lav_ipm_scale(const elements_t* e, const double* z, const double* u1, const double* u2, double delta,
                               double* v, double* bt, double* gap) noexcept nogil:
    """V = (W + theta + delta)^-1 of (3) for each element, B^T with V = B B^T where theta = 0, and the gap G z . u.

    bt may be NULL.
    """
    cdef int32_t i, j, k, l, n, nr, q, t
    cdef double x, y, r, total = 0.0
    cdef double s[4]
    cdef double u[4]
    cdef double h[4]
    cdef double c[4]
    cdef double root[4]
    cdef double hs[1]
    cdef double cs[1]
    cdef double rs[1]
    cdef double a[16]
    cdef double b[16]
    hs[0] = cs[0] = rs[0] = 0.0
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if e.kind[i] == ROW:
            x = e.theta[j] + delta
            if is_low(e, j):
                x += u1[j] / (z[j] - e.lower[j])
                total += u1[j] * (z[j] - e.lower[j])
            if is_high(e, j):
                x += u2[j] / (e.upper[j] - z[j])
                total += u2[j] * (e.upper[j] - z[j])
            v[q] = 1.0 / x
            if bt != NULL:
                bt[q] = sqrt(v[q])
            continue
        n = nr if e.kind[i] == CONTACT else nr - 1
        x = 0.0
        if n > 1:
            gather(e, i, 0, z, s)
            load_dual(e, i, 0, u1, u2, u)
            for k in range(n):
                total += s[k] * u[k]
            x = cone_parts(s, u, n, e.at[i], delta, e.scaling + 2 * CONE * i, h, c, root)
        if e.kind[i] == SPIN:
            # Two cones share the normal: their parallel sum there, each of the others follows it.
            gather(e, i, 1, z, s)
            load_dual(e, i, 1, u1, u2, u)
            total += s[0] * u[0] + s[1] * u[1]
            y = cone_parts(s, u, 2, e.as_[i], delta, e.scaling + 2 * CONE * i + CONE, hs, cs, rs)
            x = x * (y / (x + y)) if n > 1 else y
        for k in range(nr * nr):
            v[q + k] = 0.0
        a[0] = 1.0
        for k in range(1, n):
            a[k] = h[k - 1]
            for l in range(1, n):
                v[q + k * nr + l] = c[(k - 1) * (n - 1) + l - 1]
        if e.kind[i] == SPIN:
            a[nr - 1] = hs[0]
            v[q + nr * nr - 1] = cs[0]
        for k in range(nr):
            for l in range(nr):
                v[q + k * nr + l] += x * a[k] * a[l]
        if bt != NULL:
            r = sqrt(x)
            for k in range(nr * nr):
                bt[q + k] = 0.0
            for k in range(nr):
                bt[q + k] = r * a[k]
            for k in range(1, n):
                for l in range(1, n):
                    bt[q + k * nr + l] = root[(k - 1) * (n - 1) + l - 1]
            if e.kind[i] == SPIN:
                bt[q + nr * nr - 1] = rs[0]
        y = 0.0
        for k in range(nr):
            y += e.theta[j + k]
        if y > 0.0:                                     # V <- (I + V theta)^-1 V
            for k in range(nr):
                for l in range(nr):
                    a[k * nr + l] = v[q + k * nr + l] * e.theta[j + l] + (1.0 if k == l else 0.0)
            invert_small(a, b, nr)
            for k in range(nr):
                for l in range(nr):
                    a[k * nr + l] = 0.0
                    for t in range(nr):
                        a[k * nr + l] += b[k * nr + t] * v[q + t * nr + l]
            for k in range(nr * nr):
                v[q + k] = a[k]
    gap[0] = total


cdef inline double row_limit(double x, double dx, double best) noexcept nogil:
    if dx < 0.0 and -x / dx < best:
        return -x / dx
    return best


# Steps of a cone are taken in the scaled coordinates, where T^-1 s = T u = v: with y = T^-1 G dz, T du = -v - y for
# the affine step and -(v \\ c) - y for the combined one. T maps the cone onto itself, so lengths are the same.
cdef inline void cone_affine(const elements_t* e, int32_t i, int32_t which, const double* da, const int32_t n,
                             double* y, double* back) noexcept nogil:
    # y = T^-1 G dz_a, back = T du_a
    cdef const double *w = e.scaling + 2 * CONE * i + CONE * which
    cdef double x[4]
    cdef int32_t k
    gather(e, i, which, da, x)
    scale_back(w, n, x, y)
    for k in range(n):
        back[k] = -w[V + k] - y[k]


cdef inline void cone_combined(const elements_t* e, int32_t i, int32_t which, const double* da, double sigma_mu,
                               const int32_t n, double* rhs) noexcept nogil:
    # v \\ c of (4) into the cone's store; rhs = T^-1 (v \\ c)
    cdef double *w = e.scaling + 2 * CONE * i + CONE * which
    cdef const double *v = w + V
    cdef double x[4]
    cdef double y[4]
    cdef double back[4]
    cdef int32_t k
    cone_affine(e, i, which, da, n, y, back)
    x[0] = -sigma_mu
    for k in range(n):
        x[0] += v[k] * v[k] + y[k] * back[k]
    for k in range(1, n):
        x[k] = 2.0 * v[0] * v[k] + y[0] * back[k] + back[0] * y[k]
    cone_divide(v, x, n, w + C)
    scale_back(w, n, w + C, rhs)


cdef inline double cone_length(const elements_t* e, int32_t i, int32_t which, const double* dz, double best,
                               const int32_t n, double* du) noexcept nogil:
    # the combined step's length, at most `best`; du
    cdef const double *w = e.scaling + 2 * CONE * i + CONE * which
    cdef double x[4]
    cdef double y[4]
    cdef double a
    cdef int32_t k
    gather(e, i, which, dz, x)
    scale_back(w, n, x, y)
    a = cone_step(w + V, y, n)
    best = a if a < best else best
    for k in range(n):
        y[k] = -w[C + k] - y[k]
    a = cone_step(w + V, y, n)
    scale_back(w, n, y, du)
    return a if a < best else best


cdef public double lav_ipm_affine(const elements_t* e, const double* z, const double* u1, const double* u2,
                                  const double* dz, double* gap) noexcept nogil:
    """Largest step (at most 1) of the affine direction, and the gap G z . u after it."""
    cdef int32_t i, j, k, which, n
    cdef double best = 1.0, a, b, x, t00 = 0.0, t01 = 0.0, t11 = 0.0
    cdef double y[4]
    cdef double back[4]
    cdef const double *v
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            if is_low(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * dz[j]
                best = row_limit(a, dz[j], best)
                best = row_limit(u1[j], x, best)
                t00 += a * u1[j]
                t01 += a * x + u1[j] * dz[j]
                t11 += x * dz[j]
            if is_high(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * dz[j]
                best = row_limit(a, -dz[j], best)
                best = row_limit(u2[j], x, best)
                t00 += a * u2[j]
                t01 += a * x - u2[j] * dz[j]
                t11 -= x * dz[j]
            continue
        for which in range(2):
            if not has_cone(e, i, which):
                continue
            n = cone_size(e, i, which)
            v = e.scaling + 2 * CONE * i + CONE * which + V
            if n == 3:
                cone_affine(e, i, which, dz, 3, y, back)
                a = cone_step(v, y, 3)
                b = cone_step(v, back, 3)
            else:
                cone_affine(e, i, which, dz, n, y, back)
                a = cone_step(v, y, n)
                b = cone_step(v, back, n)
            best = a if a < best else best
            best = b if b < best else best
            for k in range(n):
                t00 += v[k] * v[k]
                t01 -= v[k] * v[k]
                t11 += y[k] * back[k]
    gap[0] = t00 + best * (t01 + best * t11)
    return best


cdef public void lav_ipm_rhs(const elements_t* e, const double* z, const double* u1, const double* u2, const double* hz,
                             const double* da, double sigma_mu, double* rhs) noexcept nogil:
    """Right-hand side of (4)."""
    cdef int32_t i, j, k, which, n
    cdef double a, x
    cdef double u[4]
    cdef double t[4]
    for i in range(e.n):
        for j in range(e.ptr[i], e.ptr[i + 1]):
            rhs[j] = -(hz[j] - e.g[j])
        j = e.ptr[i]
        if e.kind[i] == ROW:
            # -(H z - g - u1 + u2) - c1/s1 + c2/s2, c = s u + ds du - sigma mu: the u cancel
            if is_low(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * da[j]
                rhs[j] -= (da[j] * x - sigma_mu) / a
            if is_high(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * da[j]
                rhs[j] += (-da[j] * x - sigma_mu) / a
            continue
        for which in range(2):
            if not has_cone(e, i, which):
                continue
            n = cone_size(e, i, which)
            load_dual(e, i, which, u1, u2, u)
            if n == 3:
                cone_combined(e, i, which, da, sigma_mu, 3, t)
            else:
                cone_combined(e, i, which, da, sigma_mu, n, t)
            for k in range(n):
                t[k] = u[k] - t[k]
            scatter(e, i, which, t, rhs)


cdef public double lav_ipm_update(const elements_t* e, double* z, double* u1, double* u2, const double* dz,
                                  const double* da, double sigma_mu, double damping, double* du1, double* du2) noexcept nogil:
    """Takes the combined step of the last `lav_ipm_rhs` in place; returns its length. du1, du2 (m) are scratch."""
    cdef int32_t i, j, k, which, n
    cdef double best = 1.0 / damping, a, x
    cdef double du[4]
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            if is_low(e, j):
                a = z[j] - e.lower[j]
                x = -u1[j] - u1[j] / a * da[j]
                x = -u1[j] - (da[j] * x - sigma_mu) / a - u1[j] / a * dz[j]
                best = row_limit(a, dz[j], best)
                best = row_limit(u1[j], x, best)
                du1[j] = x
            if is_high(e, j):
                a = e.upper[j] - z[j]
                x = -u2[j] + u2[j] / a * da[j]
                x = -u2[j] - (-da[j] * x - sigma_mu) / a + u2[j] / a * dz[j]
                best = row_limit(a, -dz[j], best)
                best = row_limit(u2[j], x, best)
                du2[j] = x
            continue
        for which in range(2):
            if not has_cone(e, i, which):
                continue
            n = cone_size(e, i, which)
            if n == 3:
                best = cone_length(e, i, which, dz, best, 3, du)
            else:
                best = cone_length(e, i, which, dz, best, n, du)
            store_dual(e, i, which, du, du1, du2)
    best = best * damping
    for j in range(e.m):
        z[j] += best * dz[j]
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            if is_low(e, j):
                u1[j] += best * du1[j]
            if is_high(e, j):
                u2[j] += best * du2[j]
            continue
        for k in range(j, e.ptr[i + 1]):
            if has_cone(e, i, 0) and k - j < cone_size(e, i, 0):
                u1[k] += best * du1[k]
        if has_cone(e, i, 1):
            u2[j] += best * du2[j]
            u2[e.ptr[i + 1] - 1] += best * du2[e.ptr[i + 1] - 1]
    return best


# -- natural map ------------------------------------------------------------------------------------


cdef inline void natural_contact(const elements_t* e, int32_t i, const double* z, const double* s, double* f,
                                 double* p) noexcept nogil:
    # F (nr) and P (nr, nr) of one contact, convex cone: projection in the metric of d.
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], nt, js, k, l
    cdef bint spin = e.kind[i] == SPIN, slide, turn
    cdef double at = e.at[i], as_ = e.as_[i], yn, ys = 0.0, t = 0.0, h, c, norm, kappa
    cdef double y[2]
    cdef double n[4]
    nt = nr - 1 - spin
    js = nr - 1
    for k in range(nr * nr):
        p[k] = 0.0
    yn = z[0] - s[0]
    y[0] = y[1] = 0.0
    for k in range(nt):
        y[k] = z[1 + k] - s[1 + k]
        t += y[k] * y[k]
    t = sqrt(t)
    if spin:
        ys = z[js] - s[js]
    if nt == 0:
        at = 0.0
    if not spin:
        as_ = 0.0
    h = yn if yn > 0.0 else 0.0
    c = (yn + at * t) / (1.0 + at * at)
    h = c if c > h else h
    c = (yn + as_ * fabs(ys)) / (1.0 + as_ * as_)
    h = c if c > h else h
    c = (yn + at * t + as_ * fabs(ys)) / (1.0 + at * at + as_ * as_)
    h = c if c > h else h
    if h <= 0.0:
        for k in range(nr):
            f[k] = z[k]
        return
    slide = nt > 0 and t > at * h
    turn = spin and fabs(ys) > as_ * h
    if not slide and not turn:
        for k in range(nr):
            f[k] = s[k]
            p[k * nr + k] = 1.0
        return
    # The face: one ray n in the normal, sliding and turning directions, and what stays free beside it.
    for k in range(nr):
        n[k] = 0.0
    n[0] = 1.0
    f[0] = z[0] - h
    for k in range(nt):
        if slide:
            n[1 + k] = at * y[k] / t
            f[1 + k] = z[1 + k] - h * n[1 + k]
        else:
            f[1 + k] = s[1 + k]
            p[(1 + k) * nr + 1 + k] = 1.0
    if spin:
        if turn:
            n[js] = as_ if ys > 0.0 else -as_
            f[js] = z[js] - h * n[js]
        else:
            f[js] = s[js]
            p[js * nr + js] = 1.0
    norm = 0.0
    for k in range(nr):
        norm += n[k] * n[k]
    for k in range(nr):
        for l in range(nr):
            p[k * nr + l] += n[k] * n[l] / norm
    if slide and nt == 2:
        kappa = at * h / t
        n[0] = -y[1] / t
        n[1] = y[0] / t
        for k in range(2):
            for l in range(2):
                p[(1 + k) * nr + 1 + l] += kappa * n[k] * n[l]


cdef inline void natural_coulomb(const elements_t* e, int32_t i, const double* z, const double* s, int32_t augmented,
                                 double* f, double* p) noexcept nogil:
    # The same for Coulomb friction; radius a_t y_n with `augmented` (Alart-Curnier), else a_t z_n.
    cdef int32_t nr = e.ptr[i + 1] - e.ptr[i], nt, js, k, l
    cdef bint spin = e.kind[i] == SPIN
    cdef double yn, rn, radius, t = 0.0, kappa, x
    cdef double y[2]
    cdef double n[2]
    nt = nr - 1 - spin
    js = nr - 1
    for k in range(nr * nr):
        p[k] = 0.0
    yn = z[0] - s[0]
    if yn > 0.0:
        f[0] = s[0]
        p[0] = 1.0
    else:
        f[0] = z[0]
    rn = yn if augmented else z[0]
    rn = rn if rn > 0.0 else 0.0
    radius = e.at[i] * rn
    y[0] = y[1] = 0.0
    for k in range(nt):
        y[k] = z[1 + k] - s[1 + k]
        t += y[k] * y[k]
    t = sqrt(t)
    if t > radius:
        for k in range(nt):
            n[k] = y[k] / t
            f[1 + k] = z[1 + k] - radius * n[k]
            if rn > 0.0:
                p[(1 + k) * nr] = e.at[i] * n[k]
        if nt == 2:
            kappa = radius / t
            x = n[0]
            n[0] = -n[1]
            n[1] = x
            for k in range(2):
                for l in range(2):
                    p[(1 + k) * nr + 1 + l] += kappa * n[k] * n[l]
    else:
        for k in range(nt):
            f[1 + k] = s[1 + k]
            if radius > 0.0 or t < radius:
                p[(1 + k) * nr + 1 + k] = 1.0
            else:
                f[1 + k] = z[1 + k]
    if spin:
        radius = e.as_[i] * rn
        x = z[js] - s[js]
        if fabs(x) > radius or radius <= 0.0:
            f[js] = z[js] - (radius if x > 0.0 else -radius)
            if rn > 0.0:
                p[js * nr] = e.as_[i] if x > 0.0 else -e.as_[i]
        else:
            f[js] = s[js]
            p[js * nr + js] = 1.0


cdef public double lav_natural(const elements_t* e, const double* z, const double* s, int32_t law, double eps,
                               double* f, double* p, double* einv, double* v) noexcept nogil:
    """F, P, E^-1 and V = E^-1 P of (5) for every element; returns |F|, the judge's energy error.

    law: CONVEX, COULOMB or AUGMENTED. einv, v may be NULL: F and P alone.
    """
    cdef int32_t i, j, k, l, q, nr, piece
    cdef double total = 0.0
    cdef double y, x
    cdef double a[16]
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        if e.kind[i] == ROW:
            y = z[j] - s[j]
            piece = 1
            if y < e.lower[j]:
                f[j] = z[j] - e.lower[j]
                p[q] = 0.0
                piece = 0
            elif y > e.upper[j]:
                f[j] = z[j] - e.upper[j]
                p[q] = 0.0
                piece = 2
            else:
                f[j] = s[j]
                p[q] = 1.0
            total += f[j] * f[j]
            if v != NULL:
                if piece == 1:
                    einv[q] = 1.0 / (e.theta[j] + eps)
                    v[q] = einv[q]
                else:
                    einv[q] = 1.0
                    v[q] = 0.0
            continue
        if law == CONVEX:
            natural_contact(e, i, z + j, s + j, f + j, p + q)
        else:
            natural_coulomb(e, i, z + j, s + j, law == AUGMENTED, f + j, p + q)
        for k in range(nr):
            total += f[j + k] * f[j + k]
        if v != NULL:
            for k in range(nr):
                for l in range(nr):
                    x = p[q + k * nr + l]
                    a[k * nr + l] = x * (e.theta[j + l] + eps) - x
                a[k * nr + k] += 1.0
            invert_small(a, einv + q, nr)
            for k in range(nr):
                for l in range(nr):
                    x = 0.0
                    for piece in range(nr):
                        x += einv[q + k * nr + piece] * p[q + piece * nr + l]
                    v[q + k * nr + l] = x
    return sqrt(total)


# -- a whole interior point step, velocity form ---------------------------------------------------------


cdef public void lav_convex_error(const elements_t* e, const double* z, const double* hz, const double* speed,
                                  double* energy, double* velocity) noexcept nogil:
    """|F| of the convex natural map, and the largest speed |f|, by norm where a contact has two tangents."""
    cdef int32_t i, j, k, nr
    cdef double total = 0.0, worst = 0.0, x
    cdef double s[4]
    cdef double f[4]
    cdef double p[16]
    for i in range(e.n):
        j = e.ptr[i]
        if e.kind[i] == ROW:
            x = hz[j] - e.g[j]
            if z[j] - x < e.lower[j]:
                x = z[j] - e.lower[j]
            elif z[j] - x > e.upper[j]:
                x = z[j] - e.upper[j]
            total += x * x
            x = fabs(x) * speed[j]
            worst = x if x > worst else worst
            continue
        nr = e.ptr[i + 1] - j
        for k in range(nr):
            s[k] = hz[j + k] - e.g[j + k]
        natural_contact(e, i, z + j, s, f, p)
        for k in range(nr):
            total += f[k] * f[k]
            x = fabs(f[k]) * speed[j + k]
            if k == 1 and nr - (e.kind[i] == SPIN) == 3:
                x = sqrt(f[1] * f[1] + f[2] * f[2]) * speed[j + 1]
            worst = x if x > worst else worst
    energy[0] = sqrt(total)
    velocity[0] = worst


cdef inline double z_end(const elements_t* e, int32_t j, double y) noexcept nogil:
    # which bound y is beyond: -1, 1 or 0 for none
    return -1.0 if y < e.lower[j] else 1.0 if y > e.upper[j] else 0.0


cdef inline void times_h(const elements_t* e, int32_t n, const double* z, double* y, double* hz) noexcept nogil:
    cdef int32_t j
    lav_to_bodies(e, n, z, y)
    lav_to_rows(e, y, hz)
    for j in range(e.m):
        hz[j] += e.theta[j] * z[j]


cdef inline void solve_barrier(const elements_t* e, const factor_t* f, const interior_t* p, const double* r,
                               double* out) noexcept nogil:
    # (2) for the V of `p`
    cdef int32_t j
    element_times(e, p.v, r, p.t)
    lav_to_bodies(e, f.n, p.t, p.y)
    lav_block_solve(f, p.y)
    lav_to_rows(e, p.y, p.q)
    for j in range(e.m):
        p.q[j] = r[j] - p.q[j]
    if p.bt == NULL:
        element_times(e, p.v, p.q, out)
    else:
        # B (B^T ...): V itself has lost the small end of its scaling to the large one.
        element_times(e, p.bt, p.q, p.t)
        element_times_transposed(e, p.bt, p.t, out)


cdef public void lav_interior_first(const elements_t* e, const factor_t* f, interior_t* p, double weight,
                                    double free_weight) noexcept nogil:
    """z with (H + weight) z = g on rows that have a bound, `free_weight` on others."""
    cdef int32_t i, j, k, q, nr
    cdef double x
    for i in range(e.n):
        j = e.ptr[i]
        nr = e.ptr[i + 1] - j
        q = e.wptr[i]
        for k in range(nr * nr):
            p.v[q + k] = 0.0
            if p.bt != NULL:
                p.bt[q + k] = 0.0
        x = free_weight if e.kind[i] == ROW and not is_low(e, j) and not is_high(e, j) else weight
        for k in range(nr):
            p.v[q + k * nr + k] = 1.0 / (e.theta[j + k] + x)
            if p.bt != NULL:
                p.bt[q + k * nr + k] = sqrt(p.v[q + k * nr + k])
    lav_normal_matrix(e, p.v, f, 0)
    lav_block_cholesky(f)
    solve_barrier(e, f, p, e.g, p.z)
    times_h(e, f.n, p.z, p.y, p.hz)


cdef public void lav_interior_refine(const elements_t* e, const factor_t* f, interior_t* p) noexcept nogil:
    """z <- z + (H + W)^-1 (g - H z) with the factor of the last W: the weight of the first point goes away."""
    cdef int32_t j
    for j in range(e.m):
        p.r[j] = e.g[j] - p.hz[j]
    solve_barrier(e, f, p, p.r, p.dz)
    for j in range(e.m):
        p.z[j] += p.dz[j]
    times_h(e, f.n, p.z, p.y, p.hz)


cdef inline void solve_free(const elements_t* e, const factor_t* f, const interior_t* p, const double* r,
                            double* out) noexcept nogil:
    # (5) on bounded rows, V = 0 where a row rests on its bound
    cdef int32_t j
    for j in range(e.m):
        p.t[j] = p.v[j] * r[j] if p.v[j] > 0.0 else r[j]
    lav_to_bodies(e, f.n, p.t, p.y)
    lav_block_solve(f, p.y)
    lav_to_rows(e, p.y, p.q)
    for j in range(e.m):
        out[j] = p.v[j] * (r[j] - p.q[j]) if p.v[j] > 0.0 else r[j]


cdef public int32_t lav_interior_newton(const elements_t* e, const factor_t* f, interior_t* p, double eps,
                                        int32_t rounds) noexcept nogil:
    """One Newton step (5) of bounded rows from z and hz = H z, in which refinement takes eps away again.

    Returns 0 where the step is not finite; z is then as it was.
    """
    cdef int32_t j, _
    cdef double x, left, last = 1.7976931348623157e308, size = 0.0
    for j in range(e.m):
        x = z_end(e, j, p.z[j] - p.hz[j] + e.g[j])
        p.v[j] = 0.0 if x != 0.0 else 1.0 / (e.theta[j] + eps)
        p.r[j] = -(p.hz[j] - e.g[j]) if x == 0.0 else -(p.z[j] - (e.lower[j] if x < 0.0 else e.upper[j]))
        size = fabs(p.r[j]) if fabs(p.r[j]) > size else size
    lav_normal_matrix(e, p.v, f, 0)
    lav_block_cholesky(f)
    solve_free(e, f, p, p.r, p.dz)
    for _ in range(rounds):
        times_h(e, f.n, p.dz, p.y, p.q)
        left = 0.0
        for j in range(e.m):                            # what the step leaves of -F
            x = p.r[j] - (p.q[j] if p.v[j] > 0.0 else p.dz[j])
            p.hz[j] = x
            left = fabs(x) if fabs(x) > left else left
        if not left < 0.5 * last or left <= 1e-16 * size:
            break
        last = left
        solve_free(e, f, p, p.hz, p.da)
        for j in range(e.m):
            p.dz[j] += p.da[j]
    x = 0.0
    for j in range(e.m):
        x += p.dz[j] * 0.0
    if x == 0.0:
        for j in range(e.m):
            p.z[j] += p.dz[j]
    times_h(e, f.n, p.z, p.y, p.hz)
    lav_convex_error(e, p.z, p.hz, p.speed, &p.energy, &p.velocity)
    return x == 0.0


cdef public int32_t lav_interior_step(const elements_t* e, const factor_t* f, interior_t* p) noexcept nogil:
    """(3) and (4) from z, u1, u2 and hz = H z; returns 0 where the factorisation or the step fails.

    The elements' bounds are read at every step, so e may not change between steps.
    """
    cdef int32_t i, j, lost, side
    cdef double gap, after, sigma = 0.0, x
    lav_ipm_scale(e, p.z, p.u1, p.u2, p.delta, p.v, p.bt, &gap)
    lav_normal_matrix(e, p.v, f, 0)
    lost = lav_block_cholesky(f)
    if lost > 0 and gap - gap != 0.0:
        return 0
    for j in range(e.m):
        p.r[j] = e.g[j] - p.hz[j]
    solve_barrier(e, f, p, p.r, p.da)
    if p.degree > 0.0 and gap > 0.0:
        lav_ipm_affine(e, p.z, p.u1, p.u2, p.da, &after)
        x = after / gap
        x = 1.0 if x > 1.0 else x if x > 0.0 else 0.0
        sigma = x * x * x
    x = sigma * gap / (p.degree if p.degree > 1.0 else 1.0)
    lav_ipm_rhs(e, p.z, p.u1, p.u2, p.hz, p.da, x, p.r)
    solve_barrier(e, f, p, p.r, p.dz)
    after = 0.0
    for j in range(e.m):
        after += p.dz[j] * 0.0
    if after != 0.0:
        return 0
    p.length = lav_ipm_update(e, p.z, p.u1, p.u2, p.dz, p.da, x, p.damping, p.t, p.q)
    p.gap = gap / (p.degree if p.degree > 1.0 else 1.0)
    times_h(e, f.n, p.z, p.y, p.hz)
    lav_convex_error(e, p.z, p.hz, p.speed, &p.energy, &p.velocity)
    p.changed = 0
    for i in range(e.n):
        if e.kind[i] == ROW:
            j = e.ptr[i]
            side = <int32_t>z_end(e, j, p.z[j] - p.hz[j] + e.g[j])
            p.changed += side != p.side[i]
            p.side[i] = side
    return p.length > 0.0


# -- Python entry -----------------------------------------------------------------------------------


cdef void* address(object array):
    cdef const double[::1] x
    cdef const int32_t[::1] y
    if array.ndim > 1:
        array = array.ravel()
    if len(array) == 0:
        return NULL
    if array.itemsize == 4:
        y = array
        return <void*>&y[0]
    x = array
    return <void*>&x[0]


cdef class Elements:
    """Bounds and cones of the scaled problem, with the small matrices of every element.

    Every array is C-contiguous, float64 or int32, of the length that the structs above give, checked by
    the caller.
    """
    cdef elements_t e
    cdef list keep
    cdef readonly int m, n, n_small

    def __init__(self, ptr, kind, wptr, node, slot, panel, theta, g, lower, upper, at, as_, int s):
        scaling = np.empty(2 * CONE * len(kind) if len(kind) < len(g) else 0)
        cdef const int32_t[:, ::1] of = node
        cdef int32_t i, k = 0
        group_array = np.empty(len(kind) + 1, np.int32)
        cdef int32_t[::1] group = group_array
        for i in range(of.shape[0]):
            if i == 0 or of[i, 0] != of[i - 1, 0] or of[i, 1] != of[i - 1, 1]:
                group[k] = i
                k += 1
        group[k] = <int32_t>of.shape[0]
        self.keep = [ptr, kind, wptr, node, slot, panel, theta, g, lower, upper, at, as_, scaling, group_array]
        self.n = len(kind)
        self.m = len(g)
        self.n_small = int(wptr[len(kind)])
        self.e = elements_t(
            self.n, self.m, s, <int32_t*>address(ptr), <int32_t*>address(kind), <int32_t*>address(wptr),
            <int32_t*>address(node), <int32_t*>address(slot), k, &group[0], <double*>address(panel), <double*>address(theta),
            <double*>address(g), <double*>address(lower), <double*>address(upper), <double*>address(at),
            <double*>address(as_), <double*>address(scaling))

    def start(self, const double[::1] hz, double size, double[::1] z, double[::1] u1, double[::1] u2, bint apart):
        """z, u inside their cones, one shift for all of them or each `apart`; returns the degree."""
        if apart:
            return lav_ipm_start_apart(&self.e, &hz[0], size, &z[0], &u1[0], &u2[0])
        return lav_ipm_start(&self.e, &hz[0], size, &z[0], &u1[0], &u2[0])

    def scale(self, const double[::1] z, const double[::1] u1, const double[::1] u2, double delta, double[::1] v,
              double[::1] bt=None):
        """V = (W + theta + delta)^-1 into v, B^T with V = B B^T (theta = 0) into bt; returns the gap."""
        cdef double gap
        cdef double* x = NULL
        if bt is not None:
            x = &bt[0]
        with nogil:
            lav_ipm_scale(&self.e, &z[0], &u1[0], &u2[0], delta, &v[0], x, &gap)
        return gap

    def affine(self, const double[::1] z, const double[::1] u1, const double[::1] u2, const double[::1] dz):
        """(step, gap after it)."""
        cdef double gap, step
        with nogil:
            step = lav_ipm_affine(&self.e, &z[0], &u1[0], &u2[0], &dz[0], &gap)
        return step, gap

    def rhs(self, const double[::1] z, const double[::1] u1, const double[::1] u2, const double[::1] hz,
            const double[::1] da, double sigma_mu, double[::1] out):
        with nogil:
            lav_ipm_rhs(&self.e, &z[0], &u1[0], &u2[0], &hz[0], &da[0], sigma_mu, &out[0])

    def step(self, double[::1] z, double[::1] u1, double[::1] u2, const double[::1] dz, const double[::1] da,
             double sigma_mu, double damping, double[::1] t1, double[::1] t2):
        """The combined step in place; returns its length."""
        cdef double length
        with nogil:
            length = lav_ipm_update(&self.e, &z[0], &u1[0], &u2[0], &dz[0], &da[0], sigma_mu, damping, &t1[0], &t2[0])
        return length

    def natural(self, const double[::1] z, const double[::1] s, int law, double eps, double[::1] f, double[::1] p,
                double[::1] einv=None, double[::1] v=None):
        """F, P and, where given, E^-1 and V; returns |F|."""
        cdef double size
        cdef double* x = NULL
        cdef double* y = NULL
        if einv is not None:
            x = &einv[0]
            y = &v[0]
        with nogil:
            size = lav_natural(&self.e, &z[0], &s[0], law, eps, &f[0], &p[0], x, y)
        return size

    def times_transposed(self, const double[::1] w, const double[::1] x, double[::1] out):
        """out = W^T x."""
        with nogil:
            element_times_transposed(&self.e, &w[0], &x[0], &out[0])

    def times(self, const double[::1] w, const double[::1] x, double[::1] out):
        """out = W x, one small matrix for each element."""
        with nogil:
            element_times(&self.e, &w[0], &x[0], &out[0])


def band(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] a, const int32_t[::1] place,
         const double[::1] scale, double[:, ::1] out):
    """diag(scale) A diag(scale) into a band (m, width), row i at place[i]."""
    if out.shape[0] and a.shape[0]:
        with nogil:
            lav_band(<int32_t>out.shape[0], &indptr[0], &indices[0], &a[0], &place[0], &scale[0],
                     <int32_t>out.shape[1], &out[0, 0])


def band_width(const int32_t[::1] indptr, const int32_t[::1] indices, const int32_t[::1] place):
    """Half bandwidth of A with row i at place[i]; A not empty, its pattern symmetric."""
    cdef int32_t width
    with nogil:
        width = lav_band_width(<int32_t>place.shape[0], &indptr[0], &indices[0], &place[0])
    return width


def element_graph(const int32_t[::1] ptr, const int32_t[::1] element, const int32_t[::1] indptr,
                  const int32_t[::1] indices):
    """(indptr, indices) of the graph of elements that A couples; A not empty."""
    cdef int32_t n = <int32_t>ptr.shape[0] - 1, count
    to_array, other_array = np.empty(n + 1, np.int32), np.empty(indices.shape[0] + 1, np.int32)
    cdef int32_t[::1] mark = np.empty(n + 1, np.int32), to = to_array, other = other_array
    with nogil:
        count = lav_element_graph(n, &ptr[0], &element[0], &indptr[0], &indices[0], &mark[0], &to[0], &other[0])
    return to_array, other_array[:count].copy()


def scaled_entries(const int32_t[::1] indptr, const int32_t[::1] indices, const double[::1] a, const double[::1] scale):
    """Entries of diag(scale) A diag(scale)."""
    out_array = np.empty(a.shape[0])
    cdef double[::1] out = out_array
    cdef int32_t i, q
    with nogil:
        for i in range(indptr.shape[0] - 1):
            for q in range(indptr[i], indptr[i + 1]):
                out[q] = scale[i] * a[q] * scale[indices[q]]
    return out_array


def band_free(const double[:, ::1] c, const double[::1] free, double eps, double[:, ::1] out):
    """H + eps on free rows, the identity elsewhere."""
    with nogil:
        lav_band_free(<int32_t>c.shape[0], <int32_t>c.shape[1], &c[0, 0], &free[0], eps, &out[0, 0])


def band_scaled(Elements e, const int32_t[::1] order, const int32_t[::1] place, const double[:, ::1] c,
                const double[::1] bt, double[:, ::1] out):
    """I + B^T H B."""
    with nogil:
        lav_band_scaled(&e.e, &order[0], &place[0], <int32_t>c.shape[1], &c[0, 0], &bt[0], &out[0, 0])


def element_product(Elements e, const double[::1] w, const double[:, ::1] h, double eps, double own, double one,
                    double[:, ::1] out):
    """out = W (H + eps) + one I - own W."""
    if e.m:
        with nogil:
            lav_element_product(&e.e, &w[0], &h[0, 0], eps, own, one, &out[0, 0])


def panel(Data p, const double[:, :, ::1] inv_inertia, const double[::1] root_mass, double[:, ::1] out):
    """K = D^-1/2 J M^-1/2 (m, 12) of a factored problem; root_mass (n,) = sqrt(inv_mass).

    Returns the columns that hold anything, of a body's six, as bits.
    """
    cdef int32_t n = <int32_t>root_mass.shape[0], used = 0, c
    cdef int64_t i
    cdef double[::1] root = np.empty(9 * n + 1)
    if out.shape[0] == 0 or n == 0:
        return 0
    with nogil:
        lav_inertia_root(n, &inv_inertia[0, 0, 0], &root[0])
        lav_panel(&p.blocks, &p.rows, &root[0], &root_mass[0], &out[0, 0])
        for i in range(out.shape[0]):
            for c in range(12):
                if out[i, c] != 0.0:
                    used = used | (1 << (c if c < 6 else c - 6))
            if used == 63:
                break
    return used


def narrow(const double[:, ::1] panel, const int32_t[::1] keep, const int32_t[::1] ptr, const int32_t[::1] turned,
           const int32_t[::1] columns, double[:, :, ::1] out):
    """Rows `keep` and `columns` of a panel (m, 12) into out (mk, 2, s), bodies changed over where `turned` (n,)."""
    cdef int32_t i, j, c, s = <int32_t>columns.shape[0], h
    with nogil:
        for i in range(turned.shape[0]):
            h = 1 if turned[i] else 0
            for j in range(ptr[i], ptr[i + 1]):
                for c in range(s):
                    out[j, h, c] = panel[keep[j], columns[c]]
                    out[j, 1 - h, c] = panel[keep[j], 6 + columns[c]]


def symbolic(const int32_t[::1] nptr, const int32_t[::1] nind):
    """(lptr, lind, rptr, rind) of the factor of a lower block pattern; nptr (n + 1), diagonal last in each row."""
    cdef int32_t n = <int32_t>nptr.shape[0] - 1
    cdef int32_t[::1] parent = np.empty(n + 1, np.int32), mark = np.empty(n + 1, np.int32)
    cdef int32_t[::1] row_count = np.empty(n + 1, np.int32), column_count = np.empty(n + 1, np.int32)
    lptr_array, rptr_array = np.empty(n + 1, np.int32), np.empty(n + 1, np.int32)
    cdef int32_t[::1] lptr = lptr_array, rptr = rptr_array
    cdef int64_t total = 0
    cdef int32_t i
    lav_block_tree(n, &nptr[0], &nind[0], &parent[0], &mark[0], &row_count[0], &column_count[0])
    for i in range(n):
        total += column_count[i]
    if total >= 2**31:
        raise OverflowError("the factor has 2^31 blocks or more")
    lptr[0] = rptr[0] = 0
    for i in range(n):
        lptr[i + 1] = lptr[i] + column_count[i]
        rptr[i + 1] = rptr[i] + row_count[i]
    lind_array, rind_array = np.empty(lptr[n] + 1, np.int32), np.empty(lptr[n] + 1, np.int32)
    cdef int32_t[::1] lind = lind_array, rind = rind_array
    lav_block_pattern(n, &nptr[0], &nind[0], &parent[0], &mark[0], &lptr[0], &rptr[0], &row_count[0], &lind[0], &rind[0])
    return lptr_array, lind_array, rptr_array, rind_array


def chain_pattern(const int32_t[:, ::1] body, int n):
    """As `lavender_ext.factor.graph.body_pattern`, bodies in their own order, where each meets its neighbours alone; or None."""
    cdef int32_t k = <int32_t>body.shape[0], i, a, b
    for i in range(k):
        a = body[i, 0]
        b = body[i, 1]
        if a >= 0 and b >= 0 and (a - b > 1 or b - a > 1):
            return None
    nptr_array, nind_array = np.empty(n + 1, np.int32), np.empty(2 * n + 1, np.int32)
    node_array, slot_array, turned_array = np.empty((k, 2), np.int32), np.zeros((k, 3), np.int32), np.empty(k, np.int32)
    cdef int32_t[::1] meets = np.zeros(n + 1, np.int32), nptr = nptr_array, nind = nind_array, turned = turned_array
    cdef int32_t[:, ::1] node = node_array, slot = slot_array
    for i in range(k):
        a = body[i, 0]
        b = body[i, 1]
        turned[i] = a < b
        node[i, 0] = b if a < b else a
        node[i, 1] = a if a < b else b
        if node[i, 1] >= 0:
            meets[node[i, 0]] = 1
    nptr[0] = 0
    for i in range(n):
        nptr[i + 1] = nptr[i] + 1 + meets[i]
        if meets[i]:
            nind[nptr[i]] = i - 1
        nind[nptr[i + 1] - 1] = i
    for i in range(k):
        a = node[i, 0]
        b = node[i, 1]
        if a >= 0:
            slot[i, 0] = nptr[a + 1] - 1
        if b >= 0:
            slot[i, 1] = nptr[b + 1] - 1
            slot[i, 2] = nptr[a]
    return nptr_array, nind_array[:nptr_array[n]].copy(), node_array, slot_array, turned_array


cdef class Factor:
    """N = I + K^T V K and its block factor; arrays as in `factor_t`, the pattern from `symbolic`."""
    cdef factor_t f
    cdef list keep
    cdef readonly int n, s
    cdef bint lu, unsymmetric

    def __init__(self, nptr, nind, lptr, lind, rptr, rind, int s, bint unsymmetric):
        n = len(nptr) - 1
        blocks = s * s
        def zeros(count):
            return np.zeros(max(1, count))
        nval, lval = zeros(len(nind) * blocks), zeros(int(lptr[n]) * blocks)
        mval = zeros(len(nind) * blocks) if unsymmetric else zeros(0)
        uval = zeros(int(lptr[n]) * blocks) if unsymmetric else zeros(0)
        dval, work, work2 = zeros(n * blocks), zeros(n * blocks), zeros(n * blocks if unsymmetric else 0)
        pivot, nxt = np.zeros(n * s + 1, np.int32), np.zeros(n + 1, np.int32)
        self.keep = [nptr, nind, lptr, lind, rptr, rind, nval, lval, mval, uval, dval, work, work2, pivot, nxt]
        self.n, self.s, self.unsymmetric, self.lu = n, s, unsymmetric, False
        self.f = factor_t(
            n, s, <int32_t*>address(nptr), <int32_t*>address(nind), <int32_t*>address(rptr), <int32_t*>address(rind),
            <int32_t*>address(lptr), <int32_t*>address(lind), <double*>address(nval), <double*>address(mval),
            <double*>address(lval), <double*>address(uval), <double*>address(dval), <double*>address(work),
            <double*>address(work2), <int32_t*>address(pivot), <int32_t*>address(nxt))

    def factor(self, Elements e, const double[::1] v, bint lu=False):
        """Forms N of V and factors it; returns the number of pivots lost to rounding."""
        cdef int32_t lost
        self.lu = lu
        with nogil:
            lav_normal_matrix(&e.e, &v[0], &self.f, lu)
            lost = lav_block_lu(&self.f) if lu else lav_block_cholesky(&self.f)
        return lost

    def solve(self, Elements e, const double[::1] x, double[::1] y, double[::1] out):
        """y <- N^-1 K^T x, out <- K y."""
        with nogil:
            lav_to_bodies(&e.e, self.n, &x[0], &y[0])
            if self.lu:
                lav_block_lu_solve(&self.f, &y[0])
            else:
                lav_block_solve(&self.f, &y[0])
            lav_to_rows(&e.e, &y[0], &out[0])

    def gram(self, Elements e, const double[::1] x, double[::1] y, double[::1] out):
        """out <- K K^T x, y <- K^T x."""
        with nogil:
            lav_to_bodies(&e.e, self.n, &x[0], &y[0])
            lav_to_rows(&e.e, &y[0], &out[0])


cdef class Interior:
    """An interior point of the velocity form: `first`, then `step` after `step`."""
    cdef interior_t p
    cdef Elements e
    cdef Factor f
    cdef list keep
    cdef readonly object z, hz

    def __init__(self, Elements e, Factor f, v, bt, u1, u2, speed, double delta, double damping):
        buffer = np.empty((8, e.m + 1))
        y, side = np.empty(f.n * f.s + 1), np.full(e.n + 1, 2, np.int32)
        self.e, self.f = e, f
        self.keep = [v, bt, u1, u2, speed, buffer, y, side]
        self.z, self.hz = buffer[0, : e.m], buffer[1, : e.m]
        cdef double[:, ::1] b = buffer
        cdef double* root = NULL
        if bt is not None:
            root = <double*>address(bt)
        self.p = interior_t(
            delta, damping, 0.0, &b[0, 0], <double*>address(u1), <double*>address(u2), &b[1, 0], <double*>address(v),
            root, &b[2, 0], &b[3, 0], &b[4, 0], &b[5, 0], &b[6, 0],
            <double*>address(y), <double*>address(speed), <int32_t*>address(side), 0, 0.0, 0.0, 0.0, 0.0)

    def first(self, double weight, double free_weight):
        """z with (H + weight) z = g, hz = H z."""
        self.f.lu = False
        with nogil:
            lav_interior_first(&self.e.e, &self.f.f, &self.p, weight, free_weight)

    def refine(self):
        """One refinement of the first point, with the factor of `first`."""
        with nogil:
            lav_interior_refine(&self.e.e, &self.f.f, &self.p)

    def outside(self):
        """How many rows z puts beyond their bounds."""
        cdef int32_t j, count = 0
        for j in range(self.e.m):
            count += z_end(&self.e.e, j, self.p.z[j]) != 0.0
        return count

    def place(self, const double[::1] z):
        """z as the point of `newton`: (|F|, velocity error)."""
        cdef int32_t j
        for j in range(self.e.m):
            self.p.z[j] = z[j]
        times_h(&self.e.e, self.f.n, self.p.z, self.p.y, self.p.hz)
        return self.error()

    def error(self):
        """(|F|, velocity error) of z, hz."""
        lav_convex_error(&self.e.e, self.p.z, self.p.hz, self.p.speed, &self.p.energy, &self.p.velocity)
        return self.p.energy, self.p.velocity

    def newton(self, double eps, int rounds):
        """One Newton step of bounded rows: (whether it is finite, |F|, velocity error)."""
        cdef int32_t ok
        self.f.lu = False
        with nogil:
            ok = lav_interior_newton(&self.e.e, &self.f.f, &self.p, eps, rounds)
        return bool(ok), self.p.energy, self.p.velocity

    def begin(self, double size, bint apart):
        """z, u1, u2 inside their cones, one shift for all of them or each `apart`; returns the degree."""
        if apart:
            self.p.degree = lav_ipm_start_apart(&self.e.e, self.p.hz, size, self.p.z, self.p.u1, self.p.u2)
        else:
            self.p.degree = lav_ipm_start(&self.e.e, self.p.hz, size, self.p.z, self.p.u1, self.p.u2)
        times_h(&self.e.e, self.f.n, self.p.z, self.p.y, self.p.hz)
        return self.p.degree

    def step(self):
        """One predictor-corrector step.

        Returns whether it went, its length, gap / degree before it, |F|, velocity error, and how many rows changed
        their side.
        """
        cdef int32_t ok
        self.f.lu = False
        with nogil:
            ok = lav_interior_step(&self.e.e, &self.f.f, &self.p)
        return bool(ok), self.p.length, self.p.gap, self.p.energy, self.p.velocity, self.p.changed
