"""Conjugate gradients on (I + K^T E K) t = b over bodies, with the 6 x 6 blocks of the bodies as preconditioner.

K (m, 6 n_bodies) is stored by rows, E is diagonal. A solve starts from the solution of the solve before and ends when its
residual is at most 0.05 of the residual of that start (0.03 to 0.1 cost about the same), so that the accuracy follows the
changes of b. No factor is stored: an iteration takes two multiply-adds per entry of K.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.dot cimport dot


cdef enum:
    BODY_SIZE = 6
    MAX_BODY_ITERATIONS = 200   # Iterations of one solve; piles need 4 to 10, towers up to 38.


cdef struct body_solve_t:
    int32_t m
    int32_t n                   # number of velocities, a multiple of BODY_SIZE
    const int32_t* k_ptr
    const int32_t* k_col
    const double* k_val
    const double* e             # (m) diagonal of E
    double* inverse             # (n / 6, 6, 6) inverses of the diagonal blocks
    double* t                   # (n) last solution
    double* residual            # (n)
    double* direction           # (n)
    double* product             # (n)
    double iterations           # number of iterations of all solves


cdef inline void invert_body_block(double* a) noexcept nogil:
    """Replace a symmetric positive definite a (6, 6) by its inverse, by Gauss-Jordan elimination without exchanges."""
    cdef int32_t i, j, k
    cdef double pivot, x
    for k in range(BODY_SIZE):
        pivot = 1.0 / a[BODY_SIZE * k + k]
        a[BODY_SIZE * k + k] = 1.0
        for j in range(BODY_SIZE):
            a[BODY_SIZE * k + j] *= pivot
        for i in range(BODY_SIZE):
            if i == k:
                continue
            x = a[BODY_SIZE * i + k]
            a[BODY_SIZE * i + k] = 0.0
            for j in range(BODY_SIZE):
                a[BODY_SIZE * i + j] -= x * a[BODY_SIZE * k + j]


cdef inline void compute_body_inverses(const body_solve_t* f) noexcept nogil:
    """Compute the inverses of the diagonal blocks of I + K^T E K."""
    cdef int32_t i, k, l, body, block = BODY_SIZE * BODY_SIZE
    cdef double x
    for i in range(f.n * BODY_SIZE):
        f.inverse[i] = 0.0
    for i in range(f.n):
        f.inverse[i // BODY_SIZE * block + i % BODY_SIZE * (BODY_SIZE + 1)] = 1.0
    for i in range(f.m):
        for k in range(f.k_ptr[i], f.k_ptr[i + 1]):
            body = f.k_col[k] // BODY_SIZE
            x = f.e[i] * f.k_val[k]
            for l in range(f.k_ptr[i], f.k_ptr[i + 1]):
                if f.k_col[l] // BODY_SIZE == body:
                    f.inverse[body * block + f.k_col[k] % BODY_SIZE * BODY_SIZE + f.k_col[l] % BODY_SIZE] += x * f.k_val[l]
    for body in range(f.n // BODY_SIZE):
        invert_body_block(f.inverse + body * block)


cdef inline void multiply_body_system(const body_solve_t* f, const double* x, double* y) noexcept nogil:
    """Compute y = (I + K^T E K) x; x and y have n entries."""
    cdef int32_t i, k
    cdef double s
    for i in range(f.n):
        y[i] = x[i]
    for i in range(f.m):
        s = 0.0
        for k in range(f.k_ptr[i], f.k_ptr[i + 1]):
            s += f.k_val[k] * x[f.k_col[k]]
        s *= f.e[i]
        for k in range(f.k_ptr[i], f.k_ptr[i + 1]):
            y[f.k_col[k]] += f.k_val[k] * s


cdef inline double precondition_residual(const body_solve_t* f) noexcept nogil:
    """Write the preconditioned residual to `product`; return its product with the residual."""
    cdef int32_t _body, i, j
    cdef const double* a = f.inverse
    cdef const double* r = f.residual
    cdef double* y = f.product
    cdef double s, total = 0.0
    for _body in range(f.n // BODY_SIZE):
        for i in range(BODY_SIZE):
            s = 0.0
            for j in range(BODY_SIZE):
                s += a[BODY_SIZE * i + j] * r[j]
            y[i] = s
            total += s * r[i]
        a += BODY_SIZE * BODY_SIZE
        r += BODY_SIZE
        y += BODY_SIZE
    return total


cdef inline void solve_body_system(body_solve_t* f, const double* b) noexcept nogil:
    """Solve for `t` from the last `t`, with the right-hand side b (n)."""
    cdef int32_t i, k
    cdef double limit, size, product, before = 1.0, alpha, beta
    multiply_body_system(f, f.t, f.product)
    for i in range(f.n):
        f.residual[i] = b[i] - f.product[i]
    size = sqrt(dot(f.residual, f.residual, f.n))
    limit = 0.05 * size
    beta = 1e-13 * sqrt(dot(b, b, f.n))                 # Rounding errors prevent a smaller residual.
    limit = beta if beta > limit else limit
    for k in range(MAX_BODY_ITERATIONS):
        if not size > limit:
            break
        f.iterations += 1.0
        product = precondition_residual(f)
        beta = product / before
        before = product
        for i in range(f.n):
            f.direction[i] = f.product[i] + (beta * f.direction[i] if k > 0 else 0.0)
        multiply_body_system(f, f.direction, f.product)
        alpha = product / dot(f.direction, f.product, f.n)
        for i in range(f.n):
            f.t[i] += alpha * f.direction[i]
            f.residual[i] -= alpha * f.product[i]
        size = sqrt(dot(f.residual, f.residual, f.n))
