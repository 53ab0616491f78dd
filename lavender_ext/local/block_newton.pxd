"""Solution of one block of any kind with the other blocks fixed, by Newton's method on its natural map.

With z = sqrt(d) lam, s = w / sqrt(d), H = D^-1/2 W D^-1/2, from the present z_0 with slack s_0, and with the projection Pi of
the block and its derivative P (core/block_projection.pxd)

    s = s_0 + H (z - z_0),   y = z - t s,   F = z - Pi(y) = 0,   (I - P + t P H) dz = -F                        (1)

Each step is halved while |F| does not fall. Under Coulomb's law this is the method of Alart and Curnier (1991). On bounded rows
it exchanges all rows that violate their bounds at once.

A solution is the same for every t > 0, but Newton's method may cycle for some t. It is therefore started again with other t,
each time from the result of projected steps z = Pi(z - s / trace H). Of 8,000 random contacts with rolling friction and a W of
condition 1e6 it fails on 305 for t = 1 alone, on 10 for all t of `solve_block_newton`.

The rows of a friction component share one d, also those of a round cone. Prepared numbers of a block (`prepare_block_newton`):
H (n, n), sqrt(d) (n), 1 / sqrt(d) (n).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.block_projection cimport classify_active_bound, evaluate_natural_map
from lavender_ext.core.block_types cimport CONE, friction_components_t
from lavender_ext.local.small cimport FAILED, MAX_ROWS, OPEN, STICK, solve_by_elimination, solve_three


cdef enum:
    MAX_NEWTON_STEPS = 40
    MAX_STEP_HALVINGS = 6       # After this many halvings the step is taken even if |F| does not fall.
    # Newton's method stops after this many steps that reduce the residual by less than 10 %; all 40 steps cost as much as a
    # hundred updates of the block.
    MAX_SLOW_STEPS = 4
    N_SCALES = 11               # number of values of t that are tried for contacts: 1, 0.1, 10, 0.01, 100, ...
    N_ROW_SCALES = 4            # number of values of t for bounded rows; all values fail if rows contradict each other
    N_PROJECTED_STEPS = 20      # number of projected steps before the next value of t


cdef struct scaled_block_t:
    int32_t law                 # COULOMB | CONE
    int32_t n                   # number of rows, at most MAX_ROWS
    bint bounded                # bounded rows, otherwise a contact
    const double* H             # (n, n)
    friction_components_t components    # friction components of a contact, with the coefficients of z
    double lower[MAX_ROWS]      # bounds of z
    double upper[MAX_ROWS]
    double z0[MAX_ROWS]
    double s0[MAX_ROWS]
    double start[MAX_ROWS]      # z at which Newton's method starts
    double z[MAX_ROWS]
    double projected[MAX_ROWS]  # Pi(y)
    double F[MAX_ROWS]
    double P[MAX_ROWS * MAX_ROWS]
    double size                 # largest sum of absolute terms of a row, for the tolerance


cdef inline void prepare_block_newton(int32_t n, const double* W, const double* d, const friction_components_t* components,
                                      double* g) noexcept nogil:
    """Compute the prepared numbers g (n n + 2 n) of a block; components.n is 0 for bounded rows."""
    cdef double* root = g + n * n
    cdef double* inverse = root + n
    cdef int32_t i, j
    for i in range(n):
        root[i] = sqrt(d[i])
    for j in range(components.n):
        for i in range(components.first[j] + 1, components.first[j] + components.size[j]):
            root[i] = root[components.first[j]]
    for i in range(n):
        inverse[i] = 1.0 / root[i]
    for i in range(n):
        for j in range(n):
            g[n * i + j] = W[n * i + j] * (inverse[i] * inverse[j])


cdef inline double evaluate_natural_residual(scaled_block_t* x, const int32_t n, double t) noexcept nogil:
    """Compute Pi(y), F, P and `size` of x at its z, for the scale t of (1), and return |F|."""
    cdef double ts[MAX_ROWS]
    cdef double change[MAX_ROWS]
    cdef double total = 0.0, size = 0.0, s
    cdef int32_t i, j, side
    for i in range(n):
        change[i] = x.z[i] - x.z0[i]
        s = fabs(x.z[i]) + fabs(x.s0[i]) + fabs(change[i])
        size = s if s > size else size
    x.size = size
    for i in range(n):
        s = x.s0[i]
        for j in range(n):
            s += x.H[n * i + j] * change[j]
        ts[i] = t * s
    if x.bounded:
        for i in range(n * n):
            x.P[i] = 0.0
        for i in range(n):
            side = classify_active_bound(x.z[i] - ts[i], x.lower[i], x.upper[i])
            x.projected[i] = x.z[i] - ts[i] if side == 0 else x.lower[i] if side < 0 else x.upper[i]
            x.F[i] = ts[i] if side == 0 else x.z[i] - x.projected[i]
            x.P[(n + 1) * i] = 1.0 if side == 0 else 0.0
    else:
        evaluate_natural_map(x.law, &x.components, n, x.z, ts, x.projected, x.F, x.P)
    for i in range(n):
        total += x.F[i] * x.F[i]
    return sqrt(total)


cdef inline bint run_damped_newton_iterations(scaled_block_t* x, const int32_t n, double t) noexcept nogil:
    """Take damped Newton steps (1) from the z of x; return whether |F| is then 0 within rounding."""
    cdef double A[MAX_ROWS * MAX_ROWS]
    cdef double f[MAX_ROWS]
    cdef double z[MAX_ROWS]
    cdef double projected[MAX_ROWS]
    cdef double now = evaluate_natural_residual(x, n, t), next_, a, fraction, size
    cdef int32_t i, j, k, _step, _halving, slow = 0
    for _step in range(MAX_NEWTON_STEPS):
        size = x.size
        if not now > 1e-15 * size:
            break
        for i in range(n):
            z[i], projected[i], f[i] = x.z[i], x.projected[i], -x.F[i]
            for j in range(n):
                a = 0.0
                for k in range(n):
                    a += x.P[n * i + k] * x.H[n * k + j]
                A[n * i + j] = (1.0 if i == j else 0.0) - x.P[n * i + j] + t * a
        if n != 3 or not solve_three(A, f):
            solve_by_elimination(n, A, f)
        fraction = 1.0
        for _halving in range(MAX_STEP_HALVINGS):
            for i in range(n):
                x.z[i] = z[i] + fraction * f[i]
            next_ = evaluate_natural_residual(x, n, t)
            if next_ < now or now <= 1e-13 * size:      # Shorter steps do not reduce rounding.
                break
            fraction *= 0.5
        if not next_ < now and now <= 1e-13 * size:
            for i in range(n):
                x.z[i], x.projected[i] = z[i], projected[i]
            return True
        slow += not next_ < 0.9 * now
        now = next_
        if slow > MAX_SLOW_STEPS:
            break
    return now <= 1e-13 * x.size


cdef inline bint solve_scaled_block(scaled_block_t* x, double t) noexcept nogil:
    """Solve (1) from `start`, or else from the point with w = 0; return False if both fail."""
    cdef double A[MAX_ROWS * MAX_ROWS]
    cdef int32_t i
    for i in range(x.n):
        x.z[i] = x.start[i]
    # The common sizes are compiled with a constant n.
    if (run_damped_newton_iterations(x, 2, t) if x.n == 2 else run_damped_newton_iterations(x, 3, t) if x.n == 3
            else run_damped_newton_iterations(x, 4, t) if x.n == 4 else run_damped_newton_iterations(x, x.n, t)):
        return True
    for i in range(x.n):
        x.z[i] = -x.s0[i]
    for i in range(x.n * x.n):
        A[i] = x.H[i]
    solve_by_elimination(x.n, A, x.z)
    for i in range(x.n):
        x.z[i] += x.z0[i]
    return run_damped_newton_iterations(x, x.n, t)


cdef inline bint is_contact_open(const scaled_block_t* x) noexcept nogil:
    """Return whether lam = 0 solves a contact: whether s at z = 0 is in the dual cone."""
    cdef double s[MAX_ROWS]
    cdef int32_t i, j, g
    for i in range(x.n):
        s[i] = x.s0[i]
        for j in range(x.n):
            s[i] -= x.H[x.n * i + j] * x.z0[j]
        if x.law != CONE or s[0] < 0.0:
            return s[0] >= 0.0
    for g in range(x.components.n):
        s[0] -= x.components.friction_coefficient[g] * euclidean_norm(s + x.components.first[g], x.components.size[g])
    return s[0] >= 0.0


cdef inline void store_block_impulse(const scaled_block_t* x, const double* inverse, double* lam) noexcept nogil:
    """Write the impulse of Pi(y) to lam (n) [N s]; `inverse` (n) is 1 / sqrt(d)."""
    cdef int32_t i
    for i in range(x.n):
        lam[i] = x.projected[i] * inverse[i]


cdef inline int32_t solve_block_newton(scaled_block_t* x, const double* g, const double* w, const double* lower,
                                       const double* upper, double* lam) noexcept nogil:
    """Solve a block for lam (n) from its slack w (n), with prepared numbers g; return FAILED if projected steps were used.

    law, n, bounded and the friction components of x are set; lower and upper (n) are read for bounded rows.
    """
    cdef const double* root = g + x.n * x.n
    cdef const double* inverse = root + x.n
    cdef double t = 1.0, trace
    cdef int32_t i, attempt, _step
    x.H = g
    for i in range(x.n):
        x.start[i] = x.z0[i] = root[i] * lam[i]
        x.s0[i] = w[i] * inverse[i]
    if x.bounded:
        for i in range(x.n):
            x.lower[i] = root[i] * lower[i]
            x.upper[i] = root[i] * upper[i]
    else:
        for i in range(x.components.n):
            x.components.friction_coefficient[i] *= root[x.components.first[i]] * inverse[0]
        if is_contact_open(x):
            for i in range(x.n):
                lam[i] = 0.0
            return OPEN
    for attempt in range(N_ROW_SCALES if x.bounded else N_SCALES):
        if (x.bounded or x.H[0] > 0.0) and solve_scaled_block(x, t):
            store_block_impulse(x, inverse, lam)
            if attempt > 0 and run_damped_newton_iterations(x, x.n, 1.0):         # F is most accurate for t = 1.
                store_block_impulse(x, inverse, lam)
            return STICK
        # Replace `start` by the result of steps z = Pi(z - s / trace H) from it. No eigenvalue of a symmetric H exceeds its trace.
        trace = 0.0
        for i in range(x.n):
            x.z[i] = x.start[i]
            trace += fabs(x.H[(x.n + 1) * i])
        for _step in range(N_PROJECTED_STEPS if trace > 0.0 else 0):
            evaluate_natural_residual(x, x.n, 1.0 / trace)
            for i in range(x.n):
                x.z[i] = x.start[i] = x.projected[i]
        if attempt == 0:
            for i in range(x.n):
                lam[i] = x.start[i] * inverse[i]
        t = 1.0 / t if attempt & 1 else 0.1 / t
    return FAILED
