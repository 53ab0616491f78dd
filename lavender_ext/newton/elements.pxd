"""The scaled problem and its elements, each a bounded row or a contact with small square matrices of at most 6 x 6.

With d = diag(A): z = D^1/2 lambda [sqrt J], g = D^-1/2 b, s = H z - g,

    H = D^-1/2 A D^-1/2 = K K^T + diag(theta),   K = D^-1/2 J M^-1/2                              (1)

A contact has a normal and friction components g with the cones |z_g| <= a_g z_n. The interior point and the natural map
both solve (H + W) dz = r with one small W for each element. Over bodies, with V = (theta + W)^-1 for each element,

    N = I + K^T V K,   N dy = K^T V r,   dz = V (r - K dy)                                        (2)

and N (normal_matrix.pxd), with a block of `s` columns for each body, is factored by block Cholesky in a fixed order. The
condition of N is that of J squared once, not twice, and linearly dependent rows do no harm.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t


cdef struct elements_t:
    int32_t n                   # elements
    int32_t m                   # rows
    int32_t s                   # columns of a body in the panel
    const int32_t* ptr          # (n + 1) first row
    const int32_t* part         # (n + 1) first friction component; an element without components is a bounded row
    const int32_t* wptr         # (n + 1) first entry of the element's small square matrices
    const int32_t* node         # (n, 2) block columns of the bodies, the larger first, -1: static
    const int32_t* slot         # (n, 3) blocks of N: first-first, second-second, first-second
    int32_t n_groups            # groups of consecutive elements between the same two bodies, usually one contact manifold each
    const int32_t* group        # (n_groups + 1) first element
    const double* panel         # (m, 2 s) K
    const double* theta         # (m)
    const double* g             # (m)
    const double* lower         # (m) scaled, read on bounded rows
    const double* upper         # (m)
    const int32_t* first        # first row of each friction component
    const int32_t* size         # number of rows of each friction component, 1 or 2
    const double* reach         # a_g, friction coefficient of each component in z
    double* scaling             # (components, CONE_SCALING_SIZE) written by `compute_scaling`


cdef inline bint is_row(const elements_t* e, int32_t i) noexcept nogil:
    """Return whether element i is a bounded row."""
    return e.part[i] == e.part[i + 1]


cdef inline void invert_and_multiply(double* a, const double* p, double* inv, double* v, int32_t n) noexcept nogil:
    """Write the inverse of a (n, n) to inv, by Gauss-Jordan elimination with row exchanges, and inv p to v.

    A pivot of 0 leaves zeros in its column. a is overwritten.
    """
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
        x = 1.0 / x if fabs(x) > 0.0 else 0.0
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
    for i in range(n):
        for j in range(n):
            x = 0.0
            for k in range(n):
                x += inv[i * n + k] * p[k * n + j]
            v[i * n + j] = x


cdef inline void multiply_by_element_matrices(const elements_t* e, const double* w, const double* x, double* out,
                               const bint turned) noexcept nogil:
    """Compute out = W x, or W^T x, with one small matrix for each element."""
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
                t += w[e.wptr[i] + (c * nr + r if turned else r * nr + c)] * x[j + c]
            out[j + r] = t
