"""Exact solution of the problem of one block: w = W lam + q with the other blocks fixed.

W is the diagonal block of A, 1x1 to 8x8, not necessarily symmetric. A contact with one friction component is solved by
local/coulomb.pxd or local/cone.pxd.

If there is a second component of one row s with friction coefficient a, either w_s = 0 and lam_s is eliminated, or
lam_s = +-a lam_n and its column (cone law: also its row) is added to that of the normal. These are three problems with one
component; the solution is the one that satisfies the bound of row s. All other contacts: local/friction_components.pxd.

Blocks of bounded rows are box-constrained complementarity problems, solved by principal pivoting.
"""
from libc.math cimport fabs
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip, cone_error, relax_normal, relax_row, relax_tangents, round_error
from lavender_ext.core.block_types cimport CONE, friction_components_t
from lavender_ext.local.cone cimport cone2, cone3
from lavender_ext.local.coulomb cimport PREPARED, coulomb2, coulomb3, prepare3
from lavender_ext.local.friction_components cimport solve_contact_newton
from lavender_ext.local.small cimport FAILED, MAX_ROWS, OPEN, STICK, eliminate


cdef inline int32_t solve_one_component(int32_t law, int32_t nt, const double* W, const double* q, double mu,
                                   double* lam) noexcept nogil:
    """Solve a contact with one component of nt = 1 or 2 rows for lam (1 + nt); W (1 + nt, 1 + nt)."""
    cdef double g[PREPARED]
    if nt == 1:
        return cone2(W, q, mu, lam) if law == CONE else coulomb2(W, q, mu, lam)
    if law == CONE:
        return cone3(W, q, mu, lam)
    prepare3(W, g)
    return coulomb3(g, q, mu, 0.0, lam)


cdef inline int32_t solve_two_components(int32_t law, int32_t nt, const double* W, const double* q, double mu, double bound,
                                   double* lam) noexcept nogil:
    """Solve for lam (2 + nt); the second component is the last row, with friction coefficient `bound`; W (2 + nt, 2 + nt)."""
    cdef double w[9]
    cdef double c[3]
    cdef double x[3]
    cdef double s, ws, y, size
    cdef int32_t n = 1 + nt, m = 2 + nt, i, j, k, trial, found
    # The first case is that of the present impulse: sliding at a bound, or sticking.
    s = 1.0 if lam[n] >= bound * lam[0] else (-1.0 if lam[n] <= -bound * lam[0] else 0.0)
    for trial in range(3):
        if trial > 0:
            s = (1.0 if s == 0.0 else (-1.0 if s > 0.0 else 0.0))
        if s == 0.0 and not W[m * n + n] > 0.0:
            continue
        for i in range(n):
            y = W[m * i + n] / W[m * n + n] if s == 0.0 else 0.0
            c[i] = q[i] - y * q[n]
            for j in range(n):
                w[n * i + j] = W[m * i + j] - y * W[m * n + j]
            if s != 0.0:
                w[n * i] += s * bound * W[m * i + n]
        if s != 0.0 and law == CONE:
            c[0] += s * bound * q[n]
            for j in range(n):
                w[j] += s * bound * W[m * n + j]
            w[0] += bound * bound * W[m * n + n]
        found = solve_one_component(law, nt, w, c, mu, x)
        if found == FAILED:
            continue
        ws = q[n]
        size = fabs(q[n])
        for j in range(n):
            ws += W[m * n + j] * x[j]
            size += fabs(W[m * n + j] * x[j])
        if s == 0.0:
            y = -ws / W[m * n + n]
            # At the bound both cases have the same solution, and rounding decides.
            if fabs(y) > bound * x[0] + 1e-14 * size / W[m * n + n]:
                continue
            y = clip(y, -bound * x[0], bound * x[0])
        else:
            y = s * bound * x[0]
            ws += W[m * n + n] * y
            size += fabs(W[m * n + n] * y)
            if s * ws > 1e-14 * size:
                continue
        for k in range(n):
            lam[k] = x[k]
        lam[n] = y
        return found
    return FAILED


cdef inline void local_slack(int32_t m, const double* W, const double* q, const double* lam, double* w) noexcept nogil:
    """Compute w (m) = W lam + q."""
    cdef int32_t i, j
    for i in range(m):
        w[i] = q[i]
        for j in range(m):
            w[i] += W[m * i + j] * lam[j]


cdef inline int32_t solve_contact(int32_t law, int32_t m, const double* W, const double* q, const double* d,
                                  const friction_components_t* part, double* lam) noexcept nogil:
    """Solve a contact with friction components for lam (m), starting from the present lam; FAILED if no solution is found."""
    if part.n == 1 and part.size[0] <= 2:
        return solve_one_component(law, part.size[0], W, q, part.friction_coefficient[0], lam)
    if part.n == 2 and part.size[1] == 1:
        return solve_two_components(law, part.size[0], W, q, part.friction_coefficient[0], part.friction_coefficient[1], lam)
    return solve_contact_newton(law, m, W, q, d, part, lam)


cdef inline void project_locally(int32_t law, bint round_, int32_t m, const double* W, const double* q, const double* d,
                                 const double* step, const friction_components_t* part, double* lam) noexcept nogil:
    """Iterate the update of core/block.pxd (cone law: projected gradient) on the block, if no exact solution is found."""
    cdef int32_t _sweep, i, g
    cdef double w[MAX_ROWS]
    cdef double e[MAX_ROWS]
    cdef double high[MAX_ROWS]
    cdef double change
    for _sweep in range(20):
        change = 0.0
        for i in range(m):
            e[i] = lam[i]
        if law == CONE:
            for i in range(m):
                high[i] = m * d[i]
            local_slack(m, W, q, lam, w)
            if round_:
                round_error(lam, w, high, part.friction_coefficient[0], m - 1, e)
            else:
                cone_error(lam, w, high, part, e)
            for i in range(m):
                lam[i] -= e[i]
                change += fabs(e[i])
        else:
            local_slack(m, W, q, lam, w)
            lam[0] = relax_normal(lam[0], w[0], step[0])
            for g in range(part.n):
                i = part.first[g]
                local_slack(m, W, q, lam, w)
                relax_tangents(lam + i, w + i, step[i], part.friction_coefficient[g] * lam[0], part.size[g])
            for i in range(m):
                change += fabs(lam[i] - e[i])
        if not change > 1e-12 * fabs(lam[0]):
            break


cdef inline int32_t solve_boxed_rows(int32_t n, const double* W, const double* w, const double* step, const double* low,
                               const double* high, double* lam) noexcept nogil:
    """Solve for lam (n) between its bounds, complementary to W (lam - lam_0) + w, from the present lam_0.

    Principal pivoting exchanges all violated rows at once, later only the first one (Murty). Returns STICK. If pivoting does
    not end, the rows are swept and the result is FAILED.
    """
    cdef int32_t at[MAX_ROWS]   # -1 lower, 1 upper, 0 free
    cdef int32_t row[MAX_ROWS]
    cdef double a[MAX_ROWS * MAX_ROWS]
    cdef double x[MAX_ROWS]
    cdef double y[MAX_ROWS]
    cdef double z[MAX_ROWS]
    cdef double s, size, change
    cdef int32_t i, j, m, trial, wrong, _sweep
    for i in range(n):
        s = lam[i] - w[i] * step[i]
        at[i] = -1 if s < low[i] else (1 if s > high[i] else 0)
    for trial in range(20 + 6 * n):
        m = 0
        for i in range(n):
            if at[i] == 0:
                row[m] = i
                m += 1
            y[i] = (low[i] if at[i] < 0 else high[i]) - lam[i] if at[i] != 0 else 0.0     # the change
        for i in range(m):
            x[i] = -w[row[i]]
            for j in range(n):
                if at[j] != 0:
                    x[i] -= W[n * row[i] + j] * y[j]
            for j in range(m):
                a[m * i + j] = W[n * row[i] + row[j]]
        eliminate(m, a, x)
        for i in range(m):
            y[row[i]] = x[i]
        wrong = 0
        for i in range(n):
            z[i] = w[i]
            size = fabs(w[i])
            for j in range(n):
                z[i] += W[n * i + j] * y[j]
                size += fabs(W[n * i + j] * y[j])
            if at[i] == 0:
                s = lam[i] + y[i]
                j = -1 if s < low[i] else (1 if s > high[i] else 0)
                if fabs(z[i]) > 1e-10 * size:           # an unsatisfied, linearly dependent row
                    wrong = -1
                    break
            else:
                j = 0 if at[i] * z[i] > 1e-14 * size else at[i]
            if j != at[i]:
                wrong = 1
                at[i] = j
                if trial >= 6:
                    break
        if wrong == 0:
            for i in range(n):
                lam[i] = low[i] if at[i] < 0 else (high[i] if at[i] > 0 else lam[i] + y[i])
            return STICK
        if wrong < 0:
            break
    for i in range(n):
        x[i] = lam[i]
    for _sweep in range(50):
        change = 0.0
        for i in range(n):
            s = w[i]
            for j in range(n):
                s += W[n * i + j] * (lam[j] - x[j])
            s = relax_row(lam[i], s, step[i], low[i], high[i])
            change += fabs(s - lam[i])
            lam[i] = s
        if not change > 1e-14 * fabs(lam[0]):
            break
    return FAILED
