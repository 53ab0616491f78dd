"""Whole interior point and Newton steps of the velocity form: matrix, factor, directions, step and error in one call.

`interior_step` is the step of `lavender/solvers/_newton/interior_point.py` once more, from the same parts (interior.pxd):
what other systems (A as a matrix, the augmented one, De Saxce's) do call by call. In one call a solve by `newton` takes
1.1 to 1.8 times less where it has a few dozen rows, and 1.02 to 1.14 times less where it has hundreds.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport ROW
from lavender_ext.factor.blocks cimport factor_t
from lavender_ext.factor.cholesky cimport block_cholesky, block_solve
from lavender_ext.newton.cones cimport is_high, is_low
from lavender_ext.newton.elements cimport Elements, element_times, element_times_transposed, elements_t
from lavender_ext.newton.interior cimport ipm_affine, ipm_rhs, ipm_scale, ipm_update
from lavender_ext.newton.natural_map cimport convex_error, z_end
from lavender_ext.newton.normal_matrix cimport Factor, normal_matrix
from lavender_ext.newton.panel cimport to_bodies, to_rows


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
    int32_t* side               # (m) bound that a row rests on by its natural map, before the last Newton step
    int32_t changed             # rows that took another side in it
    double length               # of the last step
    double gap                  # G z . u / degree before it
    double energy               # |F| after it, the judge's energy error
    double velocity             # the judge's velocity error


cdef class Interior:
    cdef interior_t p
    cdef Elements e
    cdef Factor f
    cdef list keep
    cdef readonly object z, hz


cdef inline void times_h(const elements_t* e, int32_t n, const double* z, double* y, double* hz) noexcept nogil:
    cdef int32_t j
    to_bodies(e, n, z, y)
    to_rows(e, y, hz)
    for j in range(e.m):
        hz[j] += e.theta[j] * z[j]


cdef inline void solve_barrier(const elements_t* e, const factor_t* f, const interior_t* p, const double* r,
                               double* out) noexcept nogil:
    # (2) for the V of `p`
    cdef int32_t j
    element_times(e, p.v, r, p.t)
    to_bodies(e, f.n, p.t, p.y)
    block_solve(f, p.y)
    to_rows(e, p.y, p.q)
    for j in range(e.m):
        p.q[j] = r[j] - p.q[j]
    if p.bt == NULL:
        element_times(e, p.v, p.q, out)
    else:
        # B (B^T ...): V itself has lost the small end of its scaling to the large one.
        element_times(e, p.bt, p.q, p.t)
        element_times_transposed(e, p.bt, p.t, out)


cdef inline void interior_first(const elements_t* e, const factor_t* f, interior_t* p, double weight,
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
    normal_matrix(e, p.v, f, 0)
    block_cholesky(f)
    solve_barrier(e, f, p, e.g, p.z)
    times_h(e, f.n, p.z, p.y, p.hz)


cdef inline void solve_free(const elements_t* e, const factor_t* f, const interior_t* p, const double* r,
                            double* out) noexcept nogil:
    # (5) on bounded rows, V = 0 where a row rests on its bound
    cdef int32_t j
    for j in range(e.m):
        p.t[j] = p.v[j] * r[j] if p.v[j] > 0.0 else r[j]
    to_bodies(e, f.n, p.t, p.y)
    block_solve(f, p.y)
    to_rows(e, p.y, p.q)
    for j in range(e.m):
        out[j] = p.v[j] * (r[j] - p.q[j]) if p.v[j] > 0.0 else r[j]


cdef inline int32_t interior_newton(const elements_t* e, const factor_t* f, interior_t* p, double eps,
                                        int32_t rounds) noexcept nogil:
    """One Newton step (5) of bounded rows from z and hz = H z, in which refinement takes eps away again.

    Returns 0 where the step is not finite; z is then as it was.
    """
    cdef int32_t j, _
    cdef double x, left, last = 1.7976931348623157e308, size = 0.0
    for j in range(e.m):
        x = z_end(e, j, p.z[j] - p.hz[j] + e.g[j])
        p.side[j] = <int32_t>x
        p.v[j] = 0.0 if x != 0.0 else 1.0 / (e.theta[j] + eps)
        p.r[j] = -(p.hz[j] - e.g[j]) if x == 0.0 else -(p.z[j] - (e.lower[j] if x < 0.0 else e.upper[j]))
        size = fabs(p.r[j]) if fabs(p.r[j]) > size else size
    normal_matrix(e, p.v, f, 0)
    block_cholesky(f)
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
    convex_error(e, p.z, p.hz, p.speed, &p.energy, &p.velocity)
    p.changed = 0
    for j in range(e.m):
        p.changed += <int32_t>z_end(e, j, p.z[j] - p.hz[j] + e.g[j]) != p.side[j]
    return x == 0.0


cdef inline int32_t interior_step(const elements_t* e, const factor_t* f, interior_t* p) noexcept nogil:
    """(3) and (4) from z, u1, u2 and hz = H z; returns 0 where the factorisation or the step fails.

    The elements' bounds are read at every step, so e may not change between steps.
    """
    cdef int32_t j, lost
    cdef double gap, after, sigma = 0.0, x
    ipm_scale(e, p.z, p.u1, p.u2, p.delta, p.v, p.bt, &gap)
    normal_matrix(e, p.v, f, 0)
    lost = block_cholesky(f)
    if lost > 0 and gap - gap != 0.0:
        return 0
    for j in range(e.m):
        p.r[j] = e.g[j] - p.hz[j]
    solve_barrier(e, f, p, p.r, p.da)
    if p.degree > 0.0 and gap > 0.0:
        ipm_affine(e, p.z, p.u1, p.u2, p.da, &after)
        x = after / gap
        x = 1.0 if x > 1.0 else x if x > 0.0 else 0.0
        sigma = x * x * x
    x = sigma * gap / (p.degree if p.degree > 1.0 else 1.0)
    ipm_rhs(e, p.z, p.u1, p.u2, p.hz, p.da, x, p.r)
    solve_barrier(e, f, p, p.r, p.dz)
    after = 0.0
    for j in range(e.m):
        after += p.dz[j] * 0.0
    if after != 0.0:
        return 0
    p.length = ipm_update(e, p.z, p.u1, p.u2, p.dz, p.da, x, p.damping, p.t, p.q)
    p.gap = gap / (p.degree if p.degree > 1.0 else 1.0)
    times_h(e, f.n, p.z, p.y, p.hz)
    convex_error(e, p.z, p.hz, p.speed, &p.energy, &p.velocity)
    return p.length > 0.0
