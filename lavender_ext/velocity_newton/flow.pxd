"""The iterate of Newton's method over generalised velocities: arrays, impulses of a point, products and errors (`newton.pxd`).

The rows and blocks of an island are in runs of consecutive panels. Errors are computed as the judge computes them. With
theta > 0 [1/kg] on every row and s = J (v - v*) - b [m/s], a block's law determines its impulse:

    z = (rho c - s) / theta
    row        lambda = clip(z, lower, upper)
    contact    lambda = Pi(z) of its law in the metric of theta (`core/block_projection.pxd`)                  (1)
    V          -d lambda / d s, of the block's rows

theta is equal on all tangents of a disk, so that (1) has a closed form.

At a kink, V is the derivative on the side on which the row acts: a row with z at a bound, or a contact with z = 0,
counts as free. All contacts of a stack at rest (b = 0) then act in the first step; otherwise one more acts in each step.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t
from libc.string cimport memcpy, memset

from lavender_ext.core.deadline cimport deadline_t, has_passed
from lavender_ext.core.block_projection cimport project_contact
from lavender_ext.core.block cimport compute_block_error, compute_row_error
from lavender_ext.core.generalized cimport multiply_whitened_panel, add_panel_transpose_product
from lavender_ext.core.block_types cimport blocks_t, friction_components_t, get_friction_components
from lavender_ext.core.view cimport generalized_t
from lavender_ext.factor.linear cimport linear_t
from lavender_ext.factor.tiles cimport combine_rows
from lavender_ext.judge.tally cimport make_empty_tally, add_block_error, add_row_error, tally_t
from lavender_ext.velocity_newton.soft cimport has_bounded_rows_only


cdef struct descent_t:          # state of the Newton steps under one law
    int32_t idle_steps          # consecutive steps that did not lower the lowest error by a tenth
    int32_t steps
    int32_t slack_is_fresh      # s was recomputed from y, not updated along a step
    int32_t needs_matrix        # N must be formed again
    int32_t response_is_known   # lambda and V belong to the present s
    int32_t is_rigid            # some proximal term exceeds rounding
    int32_t is_stiff            # N is not updated by changes of V (theta below 1e-7 d)
    int32_t center_moved        # the centre has moved since the last step
    double softness             # rho as a fraction of d
    double best_error           # error of `best`, in multiples of the limits
    double lowest_error         # lowest error of this descent
    double error_at_last_center     # energy error when the centre moved last; -1: it has not moved yet
    double sizes[3]             # norms of the gradient G at the last three steps


cdef struct paused_t:           # an island with an ended step budget; the next call continues it
    int32_t island              # -1: no island is paused
    int32_t worst               # worst outcome of the islands that were solved before the paused island
    int32_t cold                # the run started from the zero impulse (Coulomb's law only)
    int32_t stage               # CONVEX_STAGE, COULOMB_STAGE or NEXT_ROUND, under Coulomb's law
    int32_t rounds              # completed rounds of Coulomb friction
    double island_error         # lowest error of the island, including impulses at which a call ended
    double best_error           # the same without those impulses, so that interruptions do not change the path


cdef struct flow_t:
    blocks_t p                  # a copy: its law is CONE while a convex problem is solved
    const generalized_t* g
    int32_t law                 # law of the problem
    double softness             # first rho as a fraction of d
    int32_t n_islands
    const int32_t* iptr         # (n_islands + 1) runs of panels of each island in `run`
    const int32_t* run          # (2 runs) first panel and one past the last; runs <= n_panels
    const int32_t* cptr         # (n_islands + 1) columns of each island in `icols`
    const int32_t* icols        # (<= n) ascending within an island
    const int32_t* local        # (n) index of a column within its island
    int32_t bounded_rows_only   # the problem has no contact with friction components
    const int32_t* over_rows    # (n_islands) steps over the rows of A take less work than steps with N
    int32_t sparse              # some island uses N, so that L is known
    const int32_t* lptr         # (n + 1) rows of L, all islands
    const int32_t* lidx         # columns within their island, ascending
    const int32_t* pblock       # (n_panels + 1) first block of each panel
    const int32_t* vptr         # (k + 1) V of each block: the diagonal for bounded rows, else a square matrix
    int32_t island              # the present island
    int32_t is_over_rows        # its steps are over rows: y, u, grad and step are indexed by rows (`normal.pxd`)
    int32_t is_zero             # y of the island is 0
    double* theta               # (m) theta' of `newton.pxd` (2), > 0
    double* inv_theta           # (m) 1 / theta'
    double* sqrt_theta          # (m) theta'^1/2 of contacts
    double* rho                 # (m) proximal weight of `newton.pxd` (2), >= 0
    double* y                   # (max(n, m)) y; mu of `normal.pxd` if over rows
    double* u                   # Y^T lambda; A lambda if over rows
    double* grad                # gradient G; h of `normal.pxd` if over rows
    double* step                # step p; pi of `normal.pxd` if over rows
    double* s                   # (m) Y y - b + phi
    double* q                   # (m) Y p
    double* phi                 # (m) lowering of the normals under Coulomb's law, `newton.pxd` (3)
    double* center              # (m) centre c of the proximal terms
    double* lam                 # (m) impulse lambda
    double* trial               # (m) impulse at the last point that was evaluated on a line
    double* best                # (m) best impulse of one descent
    double* start               # (m) impulse at which the next stage starts; phi while a descent of CONVEX_STAGE is paused
    double* w                   # (m) slack w of the point that was evaluated last
    double* e                   # (m)
    double* v                   # V at s
    double* factored_v          # V with which `normal` was formed
    double* normal              # N of the present island in the pattern of L; under Coulomb's law a full matrix
    double* factor              # factor of `normal`
    linear_t linear             # linear system of N, S or I + A V
    double* weighted_y          # (rows of a panel, columns rounded up to a multiple of four) -V Y
    double* used_y              # (rows of a panel, columns) rows of Y that belong to the rows of -V Y
    double* strip               # (STRIP_ROWS of normal.pxd, columns) rows of Y^T V Y of a panel
    double* local_rhs           # (s)
    int32_t n_free              # rows of S: rows with V != 0
    int32_t rows                # rows of an island over rows, rounded up to a multiple of four; padding is 0
    int32_t wide                # as in `core/method.pxd`
    int32_t* row_list           # (m) rows of an island over rows
    int32_t n_unknowns          # columns of the island, or rows if it is over rows
    const int32_t* unknowns     # (n_unknowns) indices of these columns or rows
    int32_t* places             # (m) index within the island of each free row
    int32_t* columns            # (m) offset of each free row's column of A
    int32_t* picked_columns     # (m) scratch
    int32_t* transpose_offset   # offsets of the rows of Y^T, for each panel
    int32_t* panel_of_column    # (m) panel of each row; -1 - panel if its column of A is not formed
    double* a                   # (rows, rows) A, symmetric
    double* y_transpose         # (s, rows) Y^T
    int32_t keeps_matrix        # the caller starts again with the same J and M: columns of A of a single island stay
    int32_t has_matrix          # every column of A of the single island is formed
    double* sum                 # (2 rows) scratch
    double tol                  # required relative residual of each island
    double reference_energy     # sqrt J, if the problem has one island
    double reference_velocity   # m/s
    double energy_limit         # sqrt J, limit of the present island
    double velocity_limit       # m/s
    int32_t steps               # remaining Newton steps
    deadline_t* deadline        # time at which the steps end, or NULL
    int32_t factorisations
    int32_t rounds              # rounds of Coulomb friction
    int32_t evaluations         # evaluations of lambda(s) along a line
    paused_t paused
    descent_t descent


# -- rows and blocks of a run of panels ------------------------------------------------------------------


cdef inline int32_t first_row_of_run(const flow_t* f, int32_t a) noexcept nogil:
    return f.g.prow[f.run[2 * a]]


cdef inline int32_t end_row_of_run(const flow_t* f, int32_t a) noexcept nogil:
    return f.g.prow[f.run[2 * a + 1]]


cdef inline int32_t first_block_of_run(const flow_t* f, int32_t a) noexcept nogil:
    return f.pblock[f.run[2 * a]]


cdef inline int32_t end_block_of_run(const flow_t* f, int32_t a) noexcept nogil:
    return f.pblock[f.run[2 * a + 1]]


# -- lambda(s) and V -------------------------------------------------------------------------------------


cdef inline void compute_contact_impulse(const flow_t* f, int32_t i, double* lam, double* v) noexcept nogil:
    """Project z (in lam) of contact i by (1), in place, and write V."""
    cdef int32_t j = f.p.ptr[i], n = f.p.ptr[i + 1] - j, k, l
    cdef const double* root = f.sqrt_theta + j
    cdef const double* soft = f.inv_theta + j
    cdef friction_components_t q
    cdef bint is_at_apex = True                         # a contact at rest that carries no impulse
    cdef double y[6]
    cdef double out[6]
    cdef double inv_sqrt_theta[6]
    for k in range(n):
        inv_sqrt_theta[k] = root[k] * soft[k]
        y[k] = root[k] * lam[k]
        is_at_apex = is_at_apex and y[k] == 0.0
    get_friction_components(&f.p, i, &q)
    for k in range(q.n):
        q.friction_coefficient[k] = q.friction_coefficient[k] * root[q.first[k]] * inv_sqrt_theta[0]
    project_contact(f.p.law, &q, y, out, v)
    if is_at_apex:
        for k in range(n):
            v[k * n + k] = 1.0
    for k in range(n):
        lam[k] = lam[k] if out[k] == y[k] else out[k] * inv_sqrt_theta[k]
        for l in range(n):
            v[k * n + l] *= inv_sqrt_theta[k] * inv_sqrt_theta[l]


cdef inline void compute_impulses(const flow_t* f, int32_t first, int32_t last, const double* s, double* lam,
                         double* v) noexcept nogil:
    """Compute lambda and V of blocks [first, last)."""
    cdef int32_t i, j, end, k, at
    # Local copies of pointers: the compiler cannot exclude that the stores below change the struct.
    cdef const int32_t* ptr = f.p.ptr
    cdef const int32_t* vptr = f.vptr
    cdef const double* lower = f.p.lower
    cdef const double* upper = f.p.upper
    cdef const double* rho = f.rho
    cdef const double* center = f.center
    cdef const double* soft = f.inv_theta
    cdef double z, low, high
    cdef bint is_free
    if f.bounded_rows_only:                             # V has one entry for each row, at the row's index
        end = ptr[last]
        for k in range(ptr[first], end):
            z = (rho[k] * center[k] - s[k]) * soft[k]
            low = lower[k]
            high = upper[k]
            is_free = (low <= z) & (z <= high) & (low < high)       # without branches, for vector lanes
            v[k] = soft[k] if is_free else 0.0
            z = low if z < low else z
            lam[k] = high if z > high else z
        return
    for i in range(first, last):
        j = ptr[i]
        end = ptr[i + 1]
        at = vptr[i]
        if has_bounded_rows_only(&f.p, i):
            at -= j
            for k in range(j, end):
                z = (rho[k] * center[k] - s[k]) * soft[k]
                low = lower[k]
                high = upper[k]
                v[at + k] = soft[k] if low <= z <= high and low < high else 0.0
                lam[k] = low if z < low else (high if z > high else z)
            continue
        for k in range(j, end):
            lam[k] = (rho[k] * center[k] - s[k]) * soft[k]
        compute_contact_impulse(f, i, lam + j, v + at)


cdef inline void compute_island_impulses(const flow_t* f, int32_t island, const double* s, double* lam) noexcept nogil:
    """Compute lambda and V of an island."""
    cdef int32_t a
    for a in range(f.iptr[island], f.iptr[island + 1]):
        compute_impulses(f, first_block_of_run(f, a), end_block_of_run(f, a), s, lam, f.v)


# -- products over the rows of A -------------------------------------------------------------------------


cdef inline double combined_product_cost() noexcept nogil:
    """Return the time [ns] of a multiply-add of `combine_rows`."""
    return 0.3


cdef enum:
    UNFORMED = -2147483647      # `panel_of_column` of the first row until Y^T is formed


cdef inline void form_y_transpose(const flow_t* f, int32_t island) noexcept nogil:
    """Form Y^T and mark every column of A as not formed."""
    cdef int32_t a, b, _i, q, nc, row = 0, size = f.cptr[island + 1] - f.cptr[island]
    cdef const int32_t* cols
    cdef int32_t* at
    cdef const double* y
    cdef double* x
    memset(f.y_transpose, 0, <size_t>size * f.rows * sizeof(double))
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for b in range(f.run[2 * a], f.run[2 * a + 1]):
            cols = f.g.cols + f.g.pcol[b]
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            y = f.g.y + f.g.pval[b]
            at = f.transpose_offset + f.g.pcol[b]
            for q in range(nc):
                at[q] = f.local[cols[q]] * f.rows
            for _i in range(f.g.prow[b], f.g.prow[b + 1]):
                x = f.y_transpose + row
                for q in range(nc):
                    x[at[q]] = y[q]
                f.panel_of_column[row] = -1 - b
                y += nc
                row += 1


cdef inline void form_column_of_a(const flow_t* f, int32_t place) noexcept nogil:
    """Form the column of A that belongs to the row with this index in the island, unless it is formed already.

    After the deadline, nothing is formed, and the caller uses no product.
    """
    cdef int32_t b, nc
    cdef const double* y
    if f.panel_of_column[0] == UNFORMED:
        form_y_transpose(f, f.island)
    b = -1 - f.panel_of_column[place]
    if b >= 0:
        nc = f.g.pcol[b + 1] - f.g.pcol[b]
        if f.deadline != NULL and has_passed(f.deadline, combined_product_cost() * nc * f.rows):
            return
        y = f.g.y + f.g.pval[b] + (f.unknowns[place] - f.g.prow[b]) * nc
        combine_rows(f.wide, f.rows, nc, f.y_transpose, f.transpose_offset + f.g.pcol[b], y, f.a + place * f.rows)
        f.panel_of_column[place] = b


cdef inline bint multiply_a(const flow_t* f, const double* x, double* out) noexcept nogil:
    """Compute out = A x on the island's rows; return whether any x is not 0."""
    cdef int32_t a, count = 0, n = f.n_unknowns, rows = f.rows
    cdef const int32_t* own = f.unknowns                # local copies, as in `compute_impulses`
    cdef int32_t* picks = f.picked_columns
    cdef double* sums = f.sum
    cdef double* given = sums + rows
    for a in range(n):
        if x[own[a]] != 0.0:
            form_column_of_a(f, a)
            picks[count] = a * rows
            given[count] = x[own[a]]
            count += 1
    combine_rows(f.wide, rows, count, f.a, picks, given, sums)
    for a in range(n):
        out[own[a]] = sums[a]
    return count > 0


cdef inline bint multiply_y_transpose(const flow_t* f, int32_t island, const double* lam, double* x) noexcept nogil:
    """Compute x = Y^T lam on the island's columns, or A lam over rows; return whether any lam is not 0."""
    cdef int32_t a, b, k
    cdef bint moves = False
    if f.is_over_rows:
        return multiply_a(f, lam, x)
    for a in range(f.cptr[island], f.cptr[island + 1]):
        x[f.icols[a]] = 0.0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            if lam[k] != 0.0:
                moves = True
                break
        if moves:
            for b in range(f.run[2 * a], f.run[2 * a + 1]):
                add_panel_transpose_product(f.g, b, lam, x)
    return moves


cdef inline void multiply_y(const flow_t* f, int32_t island, const double* x, double* out) noexcept nogil:
    """Compute out = Y x on the island's rows."""
    cdef int32_t a, b, end
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.run[2 * a + 1]
        for b in range(f.run[2 * a], end):
            multiply_whitened_panel(f.g, b, x, out)


cdef inline void copy_rows(const flow_t* f, int32_t island, const double* x, double* to) noexcept nogil:
    """Copy x to `to` on the island's rows."""
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        k = first_row_of_run(f, a)
        memcpy(to + k, x + k, (end_row_of_run(f, a) - k) * sizeof(double))


cdef inline void clear_rows(const flow_t* f, int32_t island, double* out) noexcept nogil:
    """Set out = 0 on the island's rows."""
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            out[k] = 0.0


cdef inline void recompute_slack(const flow_t* f, int32_t island) noexcept nogil:
    """Compute s = Y y - b + phi."""
    cdef int32_t a, k
    cdef double* s = f.s
    cdef const double* phi = f.phi
    cdef const double* b = f.p.b
    if f.is_zero:
        clear_rows(f, island, s)
    elif f.is_over_rows:
        multiply_a(f, f.y, s)
    else:
        multiply_y(f, island, f.y, s)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            s[k] += phi[k] - b[k]


cdef inline double measure_impulse_errors(const flow_t* f, int32_t island, const double* lam, bint moves,
                           double* velocity) noexcept nogil:
    """Compute the energy [sqrt J] and velocity [m/s] of the errors of lam; NaN if they are not finite.

    `u` must hold `multiply_y_transpose` of lam; it is taken as 0 unless `moves`.
    """
    cdef int32_t a, i, k, end, last
    cdef const int32_t* ptr = f.p.ptr
    cdef const double* lower = f.p.lower
    cdef const double* upper = f.p.upper
    cdef const double* d = f.p.d
    cdef const double* b = f.p.b
    cdef const double* phi = f.phi
    cdef const double* compliance = f.g.compliance
    cdef double* w = f.w
    cdef tally_t t = make_empty_tally()
    if not moves:
        clear_rows(f, island, w)
    elif f.is_over_rows:
        copy_rows(f, island, f.u, w)
    else:
        multiply_y(f, island, f.u, w)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
            w[k] += compliance[k] * lam[k] - b[k] + phi[k]
        if f.bounded_rows_only:
            for k in range(first_row_of_run(f, a), end_row_of_run(f, a)):
                add_row_error(&f.p, k, compute_row_error(lam[k], w[k], d[k], lower[k], upper[k]), &t)
            continue
        last = end_block_of_run(f, a)
        for i in range(first_block_of_run(f, a), last):
            if has_bounded_rows_only(&f.p, i):
                end = ptr[i + 1]
                for k in range(ptr[i], end):
                    add_row_error(&f.p, k, compute_row_error(lam[k], w[k], d[k], lower[k], upper[k]), &t)
            else:
                compute_block_error(&f.p, i, lam, w, f.e)
                add_block_error(&f.p, i, f.e, &t)
    velocity[0] = sqrt(t.fast) if t.fast > 0.0 else 0.0
    return sqrt(t.energy)
