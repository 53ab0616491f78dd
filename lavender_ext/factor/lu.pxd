"""Block LU with pivots inside the diagonal blocks, on the pattern of the symmetric factor."""
from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t

from lavender_ext.factor.blocks cimport factor_t


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
        if not top > 0.0:
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


cdef inline int32_t block_lu(const factor_t* f) noexcept nogil:
    """N = L U with the pattern of the symmetric factor; returns the number of zero pivots."""
    if f.s == 3:
        return lu_blocks(f, 3)
    if f.s == 6:
        return lu_blocks(f, 6)
    return lu_blocks(f, f.s)


cdef inline void block_lu_solve(const factor_t* f, double* x) noexcept nogil:
    """x <- N^-1 x after `block_lu`."""
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
