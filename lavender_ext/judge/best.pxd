"""The impulse that a solve returns if tol is not met, selected separately for each island.

    (1) A is symmetric, and the island has bounded rows or cones: the iterate with the lowest objective f
    (2) otherwise: from Gauss-Seidel sweeps the last iterate, from every other method the iterate with the smallest E
    (3) a start that the user gives is projected on its bounds and counts as an iterate in each island in which it is then not
        zero; under (2), the zero impulse, from which a solve begins by default, does not count, because E rises while a motor
        runs up to its bound

    f = 1/2 lam.A lam - b.lam = 1/2 lam.(w - b)

An island that one iterate has solved keeps it. Two kinds of iterates do not count: an iterate that is not finite, and an iterate
so large that rounding of its slack may hide a thousandth of b and of the zero impulse's error E0.

E decides if rounding may explain the difference of two f. E also decides in a problem without a solution, because f then falls
without end, and there the zero impulse counts. A problem counts as one without a solution if this is proven (`by_energy`), or
if an island diverges or has a residual above 1 after 64 sweeps. The second case does not apply while a bounded row, such as a
motor, still runs up to a bound.

A start that does not meet tol is replaced by the zero impulse in two cases: if A is symmetric and the zero impulse has the lower
f, or if the zero impulse solves the island. The zero impulse then counts.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

from lavender_ext.core.block_types cimport CONE, blocks_t, friction_components_t, get_friction_components, has_independent_rows
from lavender_ext.core.csr cimport measure_asymmetry_and_bandwidth
from lavender_ext.core.start cimport clip_zero_to_row_bounds, is_zero_impulse
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.score cimport score_t, unit_roundoff
from lavender_ext.judge.tally cimport get_island_block, index_of_island_begin, index_of_island_end, is_island_unmoved


cdef struct objective_t:
    double value                # J, f of an impulse in one island
    double rounding             # J, what rounding may change in it
    int32_t hides_zero          # whether rounding of the slack may hide a thousandth of b and of E0


cdef struct best_t:
    int32_t n                   # number of islands
    int32_t seen                # number of impulses so far
    int32_t symmetric           # whether A is symmetric, -1 if not known
    int32_t by_energy           # E decides in each island
    double reference_energy     # sqrt J, E0 of a problem without islands
    double* impulse             # (m) N s
    double* begin               # (m) N s, the impulse at which the run begins
    double* begin_energy        # (n) sqrt J, its energy error
    double* relative            # (n) -, relative residual of `impulse`
    double* energy              # (n) sqrt J, energy error of `impulse`; infinite for the zero impulse under (3)
    double* objective           # (n) J, f of `impulse`
    double* now                 # (n, 2) -, sqrt J: relative residual and energy of the next impulse, for `score_t.by_island`
    int32_t* cursor             # (m) scratch


cdef inline int32_t count_islands(const blocks_t* p) noexcept nogil:
    """Return the number of islands, at least 1."""
    return p.islands.n if p.islands != NULL else 1


cdef inline int64_t best_workspace_size(int64_t m, int64_t n) noexcept nogil:
    """Return the number of doubles that `bind_best` needs for m rows in n islands."""
    return 2 * m + 6 * n + (m + 1) // 2


cdef inline void bind_best(best_t* s, const blocks_t* p, double* workspace) noexcept nogil:
    """Initialise s before the first impulse; workspace (`best_workspace_size`)."""
    cdef int32_t n = count_islands(p)
    s.n, s.seen, s.symmetric, s.by_energy, s.reference_energy = n, 0, -1, 0, 0.0
    s.impulse, s.begin, s.begin_energy = workspace, workspace + p.n_rows, workspace + 2 * <ssize_t>p.n_rows
    s.relative = s.begin_energy + n
    s.energy, s.objective, s.now = s.relative + n, s.relative + 2 * n, s.relative + 3 * n
    s.cursor = <int32_t*>(s.relative + 5 * n)


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


cdef inline objective_t measure_objective(const blocks_t* p, int32_t island, const double* lam, const double* w,
                                          double energy_at_zero) noexcept nogil:
    """Return the f of lam (m) with slack w (m) in an island with the reference E0, and what rounding may change in it.

    A slack and b are sums over dozens of terms. On a stack of six boxes the f of two solutions differ by 1.6e-15 J, four times
    as much as 8 roundings of each row's largest terms. In 60 steps of such stacks, 64 roundings were not enough in two.
    """
    cdef int32_t a, i, k
    cdef double total = 0.0, size = 0.0, largest = 0.0, velocity = 0.0, energy = 0.0
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        for k in range(p.ptr[i], p.ptr[i + 1]):
            total += 0.5 * lam[k] * (w[k] - p.b[k])
            size += fabs(lam[k]) * ((fabs(w[k]) + fabs(p.b[k])) + p.d[k] * fabs(lam[k]))
            largest, velocity = max(largest, fabs(p.b[k])), max(velocity, p.d[k] * fabs(lam[k]))
            energy = max(energy, sqrt(p.d[k]) * fabs(lam[k]))
    return objective_t(total, 1024.0 * unit_roundoff() * size, unit_roundoff() * velocity > 1e-3 * largest
                       and unit_roundoff() * energy > 1e-3 * energy_at_zero)


cdef inline double energy_error_at_zero(const blocks_t* p, int32_t island, double of_all) noexcept nogil:
    """Return E0 of an island; of_all is that of a problem without islands."""
    return p.islands.reference[2 * island] if p.islands != NULL else of_all


cdef inline bint is_matrix_symmetric(best_t* s, const view_t* v) noexcept nogil:
    """Return whether A is symmetric; A in compressed rows is examined when this is first needed."""
    cdef int32_t band[2]
    if s.symmetric < 0:
        s.symmetric = v.a == NULL or measure_asymmetry_and_bandwidth(v.a, v.p.d, v.p.n_rows, s.cursor, band) <= 1e-14
    return s.symmetric


cdef inline bint minimises_objective(best_t* s, const view_t* v, int32_t island) noexcept nogil:
    """Return whether (1) applies to the island: A is symmetric, impulses move it, and no friction is bounded by Coulomb's law.

    Where no impulse moves a row, f = -b lam falls without end.
    """
    cdef const blocks_t* p = &v.p
    cdef int32_t a, g
    cdef friction_components_t q
    if s.by_energy or is_island_unmoved(p, island):
        return False
    if p.law != CONE:
        for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
            get_friction_components(p, get_island_block(p, a), &q)
            for g in range(q.n):
                if q.friction_coefficient[g] > 0.0:
                    return False
    return is_matrix_symmetric(s, v)


# -- iterates ---------------------------------------------------------------------------------------------------------


cdef inline bint is_better_in_island(best_t* s, const view_t* v, int32_t island, const objective_t* f, double tol) noexcept nogil:
    """Return whether the impulse scored in `now`, with objective f, is returned rather than `impulse`."""
    cdef double difference = f.value - s.objective[island]
    cdef bint better = s.now[2 * island + 1] < s.energy[island]
    if s.relative[island] <= tol or s.now[2 * island] <= tol:
        return not s.relative[island] <= tol
    if better != (difference < 0.0) and fabs(difference) > f.rounding and minimises_objective(s, v, island):
        better = difference < 0.0
    return better and not f.hides_zero and s.now[2 * island] < INFINITY


cdef inline bint store_better_islands(best_t* s, const view_t* v, const double* lam, const double* w, double tol) noexcept nogil:
    """Store lam (m), scored in `now`, with slack w (m), in the islands in which it is better; return whether there is one."""
    cdef int32_t i
    cdef objective_t f
    cdef bint changed = False
    for i in range(s.n):
        f = measure_objective(&v.p, i, lam, w, energy_error_at_zero(&v.p, i, s.reference_energy))
        if s.seen == 0 or is_better_in_island(s, v, i, &f, tol):
            s.relative[i], s.energy[i], s.objective[i] = s.now[2 * i], s.now[2 * i + 1], f.value
            copy_island_impulse(&v.p, i, lam, s.impulse)
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


cdef inline bint runs_up_to_bound(const blocks_t* p, int32_t island, const double* lam, const double* w) noexcept nogil:
    """Return whether the step of a bounded row from lam (m), slack w (m), leads away from zero to a finite bound."""
    cdef int32_t a, i, k
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        for k in range(p.ptr[i], p.ptr[i + 1] if has_independent_rows(p, i) else 0):
            if (w[k] < 0.0 <= lam[k] < p.upper[k] < INFINITY) or (-INFINITY < p.lower[k] < lam[k] <= 0.0 < w[k]):
                return True
    return False


cdef inline bint seems_without_solution(const best_t* s, const blocks_t* p, int32_t island, double relative, double energy,
                                        const double* lam, const double* w) noexcept nogil:
    """Return whether an island seems to have no solution after a long or failed run that ends at lam (m), slack w (m).

    relative and energy are the errors of the impulse that would be returned.
    """
    return relative > 1.0 and s.begin_energy[island] < energy and not runs_up_to_bound(p, island, lam, w)


cdef inline void restore_best_islands(best_t* s, const view_t* v, const double* w, double* lam, double tol, bint keeps_last,
                                      bint is_long) noexcept nogil:
    """Replace lam (m), scored in `now`, with slack w (m), by the best impulse, or with `keeps_last` (2) by the last one.

    is_long is whether the run has had so many sweeps that impulses that still grow may grow without end.
    """
    cdef int32_t i
    cdef bint last
    for i in range(s.n):
        last = keeps_last and not s.relative[i] <= tol and s.now[2 * i] < INFINITY and not minimises_objective(s, v, i)
        if is_long and seems_without_solution(s, &v.p, i, s.now[2 * i] if last else s.relative[i],
                                              s.now[2 * i + 1] if last else s.energy[i], lam, w):
            copy_island_impulse(&v.p, i, s.begin, lam)
        elif not last:
            copy_island_impulse(&v.p, i, s.impulse, lam)


# -- starts -----------------------------------------------------------------------------------------------------------


cdef inline double relative_residual_at_zero(const blocks_t* p, int32_t island, double of_all) noexcept nogil:
    """Return the relative residual of the zero impulse in an island; of_all is that of all rows."""
    return p.islands.reference[2 * p.islands.n + island] if p.islands != NULL else of_all


cdef inline bint is_zero_impulse_of_island(const blocks_t* p, int32_t island, const double* lam) noexcept nogil:
    """Return whether lam (m) is the zero impulse, clipped to its bounds, in an island; without lam, whether that is 0."""
    cdef int32_t a, i, k
    for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
        i = get_island_block(p, a)
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if (lam[k] if lam != NULL else 0.0) != (clip_zero_to_row_bounds(p, k) if has_independent_rows(p, i) else 0.0):
                return False
    return True


cdef inline bint begin_at_better_point(const blocks_t* p, const double* now, double at_zero, const double* w, bint symmetric,
                                       double tol, double* lam) noexcept nogil:
    """Set lam (m), with slack w (m), to the zero impulse in islands that begin there; return whether lam changed.

    now (n, 2) has the relative residuals of lam, at_zero is that of the zero impulse over all rows.
    """
    cdef int32_t island, a, i, k
    cdef double zero
    cdef objective_t f
    cdef bint changed = False
    for island in range(count_islands(p)):
        zero, f = relative_residual_at_zero(p, island, at_zero), measure_objective(p, island, lam, w, 0.0)
        if now[2 * island] <= tol or now[2 * island] < INFINITY and not (zero < 0.5 and zero < now[2 * island]) and not (
                symmetric and f.value > f.rounding and is_zero_impulse_of_island(p, island, NULL)):
            continue
        for a in range(index_of_island_begin(p, island), index_of_island_end(p, island)):
            i = get_island_block(p, a)
            for k in range(p.ptr[i], p.ptr[i + 1]):
                zero = clip_zero_to_row_bounds(p, k) if has_independent_rows(p, i) else 0.0
                changed |= lam[k] != zero
                lam[k] = zero
    return changed


cdef inline bint store_start(best_t* s, const view_t* v, const double* w, double at_zero, double tol, double* lam) noexcept nogil:
    """Store the start lam (m), scored in `now`, with slack w (m), and call `begin_at_better_point`; return its result.

    at_zero is the relative residual of the zero impulse over all rows.
    """
    cdef int32_t i
    cdef double energy
    cdef bint changed = False, default
    store_better_islands(s, v, lam, w, 0.0)
    if s.by_energy:
        return False
    if not is_zero_impulse(&v.p, lam):
        changed = begin_at_better_point(&v.p, s.now, at_zero, w, is_matrix_symmetric(s, v), tol, lam)
    memcpy(s.begin, lam, v.p.n_rows * sizeof(double))
    for i in range(s.n):
        s.begin_energy[i] = s.energy[i]
        if not is_zero_impulse_of_island(&v.p, i, lam):
            continue
        default = is_zero_impulse_of_island(&v.p, i, s.impulse)
        energy = max(energy_error_at_zero(&v.p, i, s.reference_energy), 0.0)
        energy *= min(relative_residual_at_zero(&v.p, i, at_zero), 1.0)
        s.begin_energy[i] = energy
        if default or not energy > s.energy[i] or not s.relative[i] < INFINITY or minimises_objective(s, v, i):
            copy_island_impulse(&v.p, i, lam, s.impulse)
            s.relative[i], s.energy[i] = relative_residual_at_zero(&v.p, i, at_zero), INFINITY if default else energy
            s.objective[i] = 0.0 if is_zero_impulse_of_island(&v.p, i, NULL) else s.objective[i]
    return changed
