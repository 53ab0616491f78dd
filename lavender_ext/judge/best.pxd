"""The best impulse of all checks so far, selected separately for each island.

The impulse of an island is replaced by a later one if

    the later one solves the island (relative residual r <= tol) and the present one does not;             (1)
    A is symmetric, the island has bounded rows or cones, and its objective is lower,
        f = 1/2 lam.A lam - b.lam = 1/2 lam.(w - b),
        and r is not above the r of the start, or (5) holds                                                (2)
    or, under Coulomb's law, for an asymmetric A, and if rounding may explain the difference of f,
    its energy error E of the island is lower, and its r is not above the r of the start;                  (3)
    or, if (3) applies, the present r is at least 1/2, as that of the zero impulse, and r at most 4 times the r of the start:
        f is lower and (5) holds; for an asymmetric A, V over the rows whose step leads to no finite bound is lower     (4)

(E, V and r: score.pxd.) A row that no impulse satisfies, which keeps r at 1, therefore does not affect the results of other
islands. While a force-limited motor runs up to its bound, E, V and r rise, although f falls in every sweep and the joints hold:

    rows whose step leads away from zero to a finite bound have at least a quarter of E^2                  (5)

Without (5), a larger r counts against an impulse: in an island without a solution, f falls without end while impulses grow
against each other. An impulse outside its bounds has no f, and neither has one so large that rounding of its slack may hide a
thousandth of b. Impulses of a problem that is proven to have no solution are compared by (1) and (3) alone (`by_residual`).
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.block_types cimport (CONE, ROUND, blocks_t, friction_components_t, get_friction_components,
                                            has_independent_rows)
from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.start cimport clip_zero_to_row_bounds
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.score cimport score_t, unit_roundoff
from lavender_ext.judge.tally cimport get_island_block, index_of_island_begin, index_of_island_end


cdef struct best_t:
    int32_t n                   # number of islands
    int32_t seen                # number of impulses so far
    int32_t symmetric           # whether A is symmetric, -1 if not known
    int32_t by_residual         # only (1) and (3) are used
    double* impulse             # (m) N s
    double* relative            # (n) -, relative residual of `impulse`
    double* energy              # (n) sqrt J, energy error of `impulse`
    double* start               # (n) -, lowest relative residual of the impulses that a run may begin from
    double* now                 # (n, 2) -, sqrt J: relative residual and energy of the next impulse, for `score_t.by_island`
    double* objective           # (n) J, f of `impulse`
    double* objective_now       # (n) J, f of the next impulse
    double* speed               # (n) m/s, V of (4) of `impulse`, if A is given and r is at least 1/2
    int32_t* cursor             # (m) scratch


cdef inline int32_t count_islands(const blocks_t* p) noexcept nogil:
    """Return the number of islands, at least 1."""
    return p.islands.n if p.islands != NULL else 1


cdef inline int64_t best_workspace_size(int64_t m, int64_t n) noexcept nogil:
    """Return the number of doubles that `bind_best` needs for m rows in n islands."""
    return m + 8 * n + (m + 1) // 2


cdef inline void bind_best(best_t* s, const blocks_t* p, double* workspace) noexcept nogil:
    """Initialise s before the first impulse; workspace (`best_workspace_size`)."""
    cdef int32_t n = count_islands(p)
    s.n, s.seen, s.symmetric, s.by_residual = n, 0, -1, 0
    s.impulse, s.relative = workspace, workspace + p.n_rows
    s.energy, s.start, s.now = s.relative + n, s.relative + 2 * n, s.relative + 3 * n
    s.objective, s.objective_now, s.speed = s.relative + 5 * n, s.relative + 6 * n, s.relative + 7 * n
    s.cursor = <int32_t*>(s.relative + 8 * n)


cdef inline void copy_score_without_islands(best_t* s, const blocks_t* p, const score_t* x, double relative) noexcept nogil:
    """Write the score x of a pass to `now` if the problem has no islands; with islands the pass has written `now` itself."""
    if p.islands == NULL:
        s.now[0], s.now[1] = relative, x.energy if x.finite else INFINITY


cdef inline void copy_island_impulse(const blocks_t* p, int32_t island, const double* lam, double* out) noexcept nogil:
    """Copy the rows of an island from lam to out (m each)."""
    cdef int32_t a, i
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        memcpy(out + p.ptr[i], lam + p.ptr[i], (p.ptr[i + 1] - p.ptr[i]) * sizeof(double))


# -- objectives -------------------------------------------------------------------------------------------------------


cdef inline double objective_of_rows(const blocks_t* p, int32_t first, int32_t end, const double* lam,
                                     const double* w) noexcept nogil:
    """Return f over rows [first, end); four sums shorten the chain of additions."""
    cdef double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0
    cdef int32_t k = first
    while k + 4 <= end:
        s0 += lam[k] * (w[k] - p.b[k])
        s1 += lam[k + 1] * (w[k + 1] - p.b[k + 1])
        s2 += lam[k + 2] * (w[k + 2] - p.b[k + 2])
        s3 += lam[k + 3] * (w[k + 3] - p.b[k + 3])
        k += 4
    while k < end:
        s0 += lam[k] * (w[k] - p.b[k])
        k += 1
    return 0.5 * ((s0 + s1) + (s2 + s3))


cdef inline void compute_objectives(best_t* s, const blocks_t* p, const double* lam, const double* w) noexcept nogil:
    """Compute `objective_now` of lam (m) with slack w (m), unless it is not used."""
    cdef int32_t island, a, i
    if s.by_residual:
        return
    if p.islands == NULL:                               # The sums over all rows have another order than the sums of blocks.
        s.objective_now[0] = objective_of_rows(p, 0, p.n_rows, lam, w)
        return
    for island in range(s.n):
        s.objective_now[island] = 0.0
        for a in range(p.islands.ptr[island], p.islands.ptr[island + 1]):
            i = p.islands.order[a]
            s.objective_now[island] += objective_of_rows(p, p.ptr[i], p.ptr[i + 1], lam, w)


cdef inline double max_outside_fraction() noexcept nogil:
    """Return the relative distance from a bound below which an impulse counts as inside; rounding causes smaller ones."""
    return 1e-12


cdef inline bint is_block_inside_bounds(const blocks_t* p, int32_t i, const double* lam) noexcept nogil:
    """Return whether the impulse of block i is inside its bounds; tangents of a round cone count as inside."""
    cdef int32_t g, k, j = p.ptr[i]
    cdef double slack
    cdef friction_components_t q
    if has_independent_rows(p, i):
        for k in range(j, p.ptr[i + 1]):
            slack = max_outside_fraction() * fabs(lam[k])
            if not p.lower[k] - slack <= lam[k] <= p.upper[k] + slack:
                return False
        return True
    if lam[j] < 0.0 or p.kind[i] == ROUND:
        return lam[j] >= 0.0
    get_friction_components(p, i, &q)
    for g in range(q.n):
        if euclidean_norm(lam + j + q.first[g], q.size[g]) > (1.0 + max_outside_fraction()) * q.friction_coefficient[g] * lam[j]:
            return False
    return True


cdef inline bint has_objective(const blocks_t* p, int32_t island, const double* lam) noexcept nogil:
    """Return whether lam (m) has an objective: it is inside its bounds, and rounding hides no thousandth of b."""
    cdef int32_t a, i, k
    cdef double largest = 0.0, velocity = 0.0
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        if not is_block_inside_bounds(p, i, lam):
            return False
        for k in range(p.ptr[i], p.ptr[i + 1]):
            largest = max(largest, fabs(p.b[k]))
            velocity = max(velocity, p.d[k] * fabs(lam[k]))
    return unit_roundoff() * velocity <= 1e-3 * largest


cdef inline double rounding_of_objective(const blocks_t* p, int32_t island, const double* lam, const double* w) noexcept nogil:
    """Return what rounding may change in the f of lam (m) [J]."""
    cdef int32_t a, i, k
    cdef double size = 0.0
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        for k in range(p.ptr[i], p.ptr[i + 1]):
            size += fabs(lam[k]) * (fabs(w[k]) + fabs(p.b[k]))
    return 4.0 * unit_roundoff() * size


cdef inline int32_t compare_objectives(const best_t* s, const blocks_t* p, int32_t island, const double* lam,
                                       const double* w) noexcept nogil:
    """Return -1 if the f of lam (m), slack w (m), is lower than that of `impulse`, 1 if it is higher, 0 if that is not known.

    It is not known if rounding explains the difference, or if one of both impulses has no objective.
    """
    cdef double difference = s.objective_now[island] - s.objective[island]
    if not fabs(difference) > 2.0 * rounding_of_objective(p, island, lam, w):
        return 0
    if not (has_objective(p, island, lam) and has_objective(p, island, s.impulse)):
        return 0
    return -1 if difference < 0.0 else 1


cdef inline bint leads_away_to_bound(const blocks_t* p, int32_t k, double lam, double w) noexcept nogil:
    """Return whether the step of the bounded row k leads away from zero to a finite bound."""
    return (w < 0.0 <= lam and p.upper[k] < INFINITY) or (lam <= 0.0 < w and p.lower[k] > -INFINITY)


cdef inline bint is_force_limited(const best_t* s, const blocks_t* p, int32_t island, const double* lam, const double* w,
                                  const double* e) noexcept nogil:
    """Return whether (5) holds for lam, scored in `now`, with slack w and error e (m each)."""
    cdef int32_t a, i, k
    cdef double limited = 0.0
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        if has_independent_rows(p, i):
            for k in range(p.ptr[i], p.ptr[i + 1]):
                if leads_away_to_bound(p, k, lam[k], w[k]):
                    limited += (p.d[k] * e[k]) * e[k]
    return limited > 0.0 and limited >= 0.25 * s.now[2 * island + 1] * s.now[2 * island + 1]


cdef inline double compute_free_velocity_error(const blocks_t* p, int32_t island, const double* w, const double* e) noexcept nogil:
    """Return V over the rows whose step leads to no finite bound [m/s], from slack w and error e (m each)."""
    cdef int32_t a, i, k
    cdef double speed = 0.0
    cdef bint rows
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        rows = has_independent_rows(p, i)
        for k in range(p.ptr[i], p.ptr[i + 1] if rows else p.ptr[i] + 1):       # the normal alone of a contact
            if (w[k] < 0.0 and (not rows or p.upper[k] == INFINITY)) or (w[k] > 0.0 and rows and p.lower[k] == -INFINITY):
                speed = max(speed, sqrt(p.nu[k] * p.d[k]) * fabs(e[k]))
    return speed


cdef inline bint is_matrix_symmetric(best_t* s, const view_t* v) noexcept nogil:
    """Return whether A is symmetric; A in compressed rows is examined when this is first needed."""
    cdef int32_t band[2]
    if s.symmetric < 0:
        s.symmetric = v.a == NULL or measure_asymmetry_and_bandwidth(v.a, v.p.d, v.p.n_rows, s.cursor, band) <= 1e-14
    return s.symmetric


cdef inline bint minimises_objective(best_t* s, const view_t* v, int32_t island) noexcept nogil:
    """Return whether the island's solutions minimise f: A is symmetric, and no friction is bounded by Coulomb's law."""
    cdef const blocks_t* p = &v.p
    cdef int32_t a, g
    cdef friction_components_t q
    if s.by_residual:
        return False
    if p.law != CONE:
        for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
            get_friction_components(p, get_island_block(p, a), &q)
            for g in range(q.n):
                if q.friction_coefficient[g] > 0.0:
                    return False
    return is_matrix_symmetric(s, v)


# -- selection --------------------------------------------------------------------------------------------------------


cdef inline bint is_better_in_island(best_t* s, const view_t* v, int32_t island, const double* lam, const double* w,
                                     const double* e, double tol) noexcept nogil:
    """Return whether one of (1) to (4) holds for lam, scored in `now`, with slack w and error e (m each)."""
    cdef double relative = s.now[2 * island]
    cdef bint lower_error, lower, at_rest
    if s.relative[island] <= tol:
        return False
    if relative <= tol:
        return True
    lower_error = relative <= s.start[island] and s.now[2 * island + 1] < s.energy[island]
    lower = s.objective_now[island] < s.objective[island]
    at_rest = not s.relative[island] >= 0.5 or not relative <= 4.0 * s.start[island]    # (4) does not apply.
    if s.by_residual or not relative < INFINITY or (lower_error == lower and (lower or at_rest or v.a == NULL)):
        return lower_error
    if lower_error != lower and compare_objectives(s, &v.p, island, lam, w) != 0:
        if minimises_objective(s, v, island):
            return lower and (relative <= s.start[island] or is_force_limited(s, &v.p, island, lam, w, e))
        if lower and not at_rest and is_force_limited(s, &v.p, island, lam, w, e) and is_matrix_symmetric(s, v):
            return True
    if lower_error or at_rest or v.a == NULL:
        return lower_error
    return compute_free_velocity_error(&v.p, island, w, e) < s.speed[island] and not is_matrix_symmetric(s, v)


cdef inline void store_island(best_t* s, const view_t* v, int32_t island, const double* lam, const double* w,
                              const double* e) noexcept nogil:
    """Store lam (m), scored in `now`, with slack w and error e (m each), in one island."""
    s.relative[island], s.energy[island] = s.now[2 * island], s.now[2 * island + 1]
    s.objective[island] = s.objective_now[island]
    if v.a != NULL and s.relative[island] >= 0.5:
        s.speed[island] = compute_free_velocity_error(&v.p, island, w, e)
    copy_island_impulse(&v.p, island, lam, s.impulse)


cdef inline void store_better_start(best_t* s, const view_t* v, const double* lam, const double* w,
                                    const double* e) noexcept nogil:
    """Store the start lam (m), scored in `now`, in the islands in which no earlier start is better.

    The better start has the lower objective if it is minimised, otherwise the lower relative residual. w and e (m) are the
    slack and the error of lam.
    """
    cdef int32_t i
    cdef bint first = s.seen == 0, better, lower
    compute_objectives(s, &v.p, lam, w)
    for i in range(s.n):
        better = first or s.now[2 * i] < s.start[i]
        if not (first or s.by_residual) and s.now[2 * i] < INFINITY:
            lower = s.objective_now[i] < s.objective[i]
            if better != lower and compare_objectives(s, &v.p, i, lam, w) != 0 and minimises_objective(s, v, i):
                better = lower
        if first or s.now[2 * i] < s.start[i]:
            s.start[i] = s.now[2 * i]
        if better:
            store_island(s, v, i, lam, w, e)
    s.seen += 1


cdef inline bint store_better_islands(best_t* s, const view_t* v, const double* lam, const double* w, const double* e,
                                      double tol) noexcept nogil:
    """Store lam (m), scored in `now`, in the islands in which it is better; return whether it is better in any island.

    w and e (m) are the slack and the error of lam. The first impulse that is stored counts as a start.
    """
    cdef int32_t i
    cdef bint changed = False
    if s.seen == 0:
        store_better_start(s, v, lam, w, e)
        return True
    compute_objectives(s, &v.p, lam, w)
    for i in range(s.n):
        if is_better_in_island(s, v, i, lam, w, e, tol):
            store_island(s, v, i, lam, w, e)
            changed = True
    s.seen += 1
    return changed


cdef inline double relative_residual_of_best(const best_t* s) noexcept nogil:
    """Return the relative residual of the best impulse: the largest over its islands."""
    cdef double worst = 0.0
    cdef int32_t i
    for i in range(s.n):
        if not s.relative[i] <= worst:
            worst = s.relative[i]
    return worst


# -- the zero impulse -------------------------------------------------------------------------------------------------


cdef inline double relative_residual_at_zero(const blocks_t* p, int32_t island, double of_all) noexcept nogil:
    """Return the relative residual of the zero impulse in an island; of_all is that of all rows."""
    return p.islands.reference[2 * p.islands.n + island] if p.islands != NULL else of_all


cdef inline bint replace_stale_islands(const blocks_t* p, const double* now, double at_zero, double* lam) noexcept nogil:
    """Set lam (m) to zero, clipped to its bounds, in the islands in which that has a lower relative residual.

    now (n, 2) has the relative residuals of lam, at_zero is that of the zero impulse over all rows. Return whether lam changed.
    """
    cdef int32_t island, a, i, k
    cdef double x
    cdef bint changed = False
    for island in range(count_islands(p)):
        if not now[2 * island] > relative_residual_at_zero(p, island, at_zero):
            continue
        for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
            i = get_island_block(p, a)
            for k in range(p.ptr[i], p.ptr[i + 1]):
                x = clip_zero_to_row_bounds(p, k) if has_independent_rows(p, i) else 0.0
                changed |= lam[k] != x
                lam[k] = x
    return changed


cdef inline void store_zero_if_better(best_t* s, const view_t* v, double energy_at_zero, double at_zero) noexcept nogil:
    """Store the zero impulse in the islands that minimise f and in which the stored start has f > 0 = f(0).

    energy_at_zero [sqrt J] and at_zero are E0 and the relative residual of the zero impulse over all rows.
    """
    cdef const blocks_t* p = &v.p
    cdef int32_t i, a, k, block
    cdef double relative, energy
    cdef bint at_bound
    for i in range(s.n):
        if not s.objective[i] > 0.0 or not has_objective(p, i, s.impulse) or not minimises_objective(s, v, i):
            continue
        at_bound = False
        for a in range(index_of_island_begin(p, i), index_of_island_end(p, i)):
            block = get_island_block(p, a)
            for k in range(p.ptr[block], p.ptr[block + 1]):
                at_bound = at_bound or clip_zero_to_row_bounds(p, k) != 0.0
        if at_bound:                                    # f of the clipped zero impulse is not known without a pass.
            continue
        relative = relative_residual_at_zero(p, i, at_zero)
        energy = p.islands.reference[2 * i] if p.islands != NULL else energy_at_zero
        s.relative[i] = relative
        s.energy[i] = max(energy, 0.0) * min(relative, 1.0)
        s.start[i] = min(s.start[i], relative)
        s.objective[i] = 0.0
        for a in range(index_of_island_begin(p, i), index_of_island_end(p, i)):
            block = get_island_block(p, a)
            for k in range(p.ptr[block], p.ptr[block + 1]):
                s.impulse[k] = 0.0
