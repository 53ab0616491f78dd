"""Sums and maxima over the errors of blocks and over their rounding, island by island, from which a `score_t` is computed."""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport compute_block_error, compute_row_error, euclidean_norm
from lavender_ext.core.block_types cimport (CONE, blocks_t, get_disk_component, get_row_groups, is_disk_friction_contact,
                                            has_independent_rows, get_friction_components, friction_components_t)
from lavender_ext.judge.score cimport (floor_hides_residual, is_at_floor, ratio_to_reference, relative_residual, score_t,
                                       unit_roundoff)


cdef struct tally_t:
    double energy               # sum (d e) e
    double fast                 # max (d e) (nu e)
    int32_t worst               # row of the maximum, -1 without rows


cdef struct floor_t:            # norms of F, the rounding of a slack
    double energy               # sum (F / d) F
    double fast                 # max nu (F / d) F
    double own                  # with islands: max F / s; rows of a contact use s of its normal


cdef inline int32_t get_block_in_order(const int32_t* order, int32_t a) noexcept nogil:
    """Return entry `a` of a list of blocks; a NULL list means all blocks."""
    return a if order == NULL else order[a]


cdef inline double get_row_terms(const blocks_t* p, int32_t k) noexcept nogil:
    """Return s_k of judge/reference.pxd, the terms of row k [m/s]."""
    return fabs(p.b[k]) if p.islands == NULL or p.islands.terms == NULL else fabs(p.islands.terms[k])


cdef inline double relative_residual_of_unmoved_rows(const blocks_t* p, const int32_t* order, int32_t first, int32_t end,
                                                     const double* e) noexcept nogil:
    """Return the largest d_k |e_k| / s_k, at most 1, over the rows of blocks order[first:end] that no impulse moves, or 0."""
    cdef int32_t a, i, k
    cdef double r, worst = 0.0
    if p.islands == NULL or p.islands.terms == NULL:
        return 0.0
    for a in range(first, end):
        i = get_block_in_order(order, a)
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if p.islands.terms[k] < 0.0:
                r = ratio_to_reference(p.d[k] * fabs(e[k]), -p.islands.terms[k])
                worst = r if r > worst else worst
    return min(worst, 1.0)


cdef inline double ratio_to_row_terms(const blocks_t* p, int32_t k, double error) noexcept nogil:
    """Return an error [m/s] relative to s_k; 0 if no impulse moves row k and b is 0: it is satisfied, whatever its impulse is.

    Terms are computed if impulses move a row with b = 0 of an island without a scale (`has_island_without_scale`).
    """
    if p.islands != NULL and p.islands.terms == NULL and p.b[k] == 0.0:
        return 0.0
    return ratio_to_reference(error, get_row_terms(p, k))


cdef inline double relative_residual_by_rows(const blocks_t* p, const int32_t* order, int32_t first, int32_t end,
                                             const double* e) noexcept nogil:
    """Return (3) of judge/reference.pxd over blocks order[first:end]; if order is NULL, over blocks [first, end)."""
    cdef int32_t a, i, j, k
    cdef double r, worst = 0.0, s
    for a in range(first, end):
        i = get_block_in_order(order, a)
        j = p.ptr[i]
        if has_independent_rows(p, i):
            for k in range(j, p.ptr[i + 1]):
                r = ratio_to_row_terms(p, k, p.d[k] * fabs(e[k]))
                worst = r if r > worst else worst
            continue
        s = 0.0
        for k in range(j, p.ptr[i + 1]):
            s += (p.d[k] * e[k]) * e[k]
        r = ratio_to_row_terms(p, j, sqrt(p.d[j]) * sqrt(s))
        if r > 1.0 and p.islands != NULL and p.islands.terms != NULL and p.islands.terms[j] < 0.0:
            r = 1.0                                     # Whatever the impulse of a contact that nothing moves is.
        worst = r if r > worst else worst
    return worst


cdef inline tally_t make_empty_tally() noexcept nogil:
    """Return a tally to which no row has been added."""
    cdef tally_t s
    s.energy = 0.0
    s.fast = -1.0
    s.worst = -1
    return s


cdef inline void add_row_error(const blocks_t* p, int32_t k, double e, tally_t* s) noexcept nogil:
    """Add the error e [N s] of row k to the tally s."""
    cdef double v = p.d[k] * e, t = v * (p.nu[k] * e)
    s.energy += v * e
    if t > s.fast:
        s.fast = t
        s.worst = k


cdef inline void add_pair_error(const blocks_t* p, int32_t k, const double* e, tally_t* s) noexcept nogil:
    """Add the errors of rows k and k + 1 to the tally s; the norm of both errors enters its maximum."""
    cdef double x = p.d[k] * e[k], y = p.d[k] * e[k + 1]
    s.energy += x * e[k] + y * e[k + 1]
    x = x * (p.nu[k] * e[k]) + y * (p.nu[k] * e[k + 1])
    if x > s.fast:
        s.fast = x
        s.worst = k


cdef inline void add_block_error(const blocks_t* p, int32_t i, const double* e, tally_t* s) noexcept nogil:
    """Add the errors of block i to the tally s; e (m) [N s] has the errors of all rows."""
    cdef int32_t k, g, j = p.ptr[i]
    cdef friction_components_t q
    if has_independent_rows(p, i):
        for k in range(j, p.ptr[i + 1]):
            add_row_error(p, k, e[k], s)
        return
    add_row_error(p, j, e[j], s)
    if is_disk_friction_contact(p, i):                                   # the common case, compiled with constant sizes
        add_pair_error(p, j + 1, e, s)
        return
    get_row_groups(p, i, &q)
    for g in range(q.n):
        if q.size[g] == 2:
            add_pair_error(p, j + q.first[g], e, s)
        else:
            add_row_error(p, j + q.first[g], e[j + q.first[g]], s)


cdef inline double compute_rhs_energy_norm(const blocks_t* p) noexcept nogil:
    """Return sqrt(sum b^2 / d) [sqrt J]."""
    cdef int32_t k
    cdef double sum_ = 0.0
    for k in range(p.n_rows):
        sum_ += (p.b[k] / p.d[k]) * p.b[k]
    return sqrt(sum_)


cdef inline double slack_rounding_of_row(const blocks_t* p, int32_t k, double size) noexcept nogil:
    """Return F_k, the rounding of the slack of row k, with size = (|A| |lam|)_k."""
    return unit_roundoff() * (size + fabs(p.b[k]))


cdef inline void add_slack_rounding(const blocks_t* p, int32_t k, int32_t first, double f, floor_t* s) noexcept nogil:
    """Add the rounding f of the slack of row k to the floor; `first` is the normal of a contact, otherwise k."""
    cdef double t = f / p.d[k]
    s.energy += t * f
    t = p.nu[k] * t * f
    if t > s.fast:
        s.fast = t
    if p.islands != NULL:
        t = ratio_to_reference(f * sqrt(p.d[first] / p.d[k]), get_row_terms(p, first))
        if t > s.own:
            s.own = t


cdef inline void add_row_floor(const blocks_t* p, int32_t k, double lam, double w, double size, floor_t* s) noexcept nogil:
    """Add the rounding of the bounded row k, unless its slack exceeds it and keeps the row at a bound: its error is then 0."""
    cdef double f = slack_rounding_of_row(p, k, size)
    # Without branches, because active rows are hard to predict.
    cdef bint is_active = ((lam == p.lower[k]) & (w > f)) | ((lam == p.upper[k]) & (-w > f))
    add_slack_rounding(p, k, k, 0.0 if is_active else f, s)


cdef inline bint is_satisfied_at_zero_with_rounding(const blocks_t* p, int32_t i, const double* lam, const double* w,
                                                    const double* size) noexcept nogil:
    """Return whether contact i has no impulse and its slack is positive beyond rounding: its error is then 0."""
    cdef int32_t k, g, j = p.ptr[i], n = p.ptr[i + 1] - j
    cdef double gap = w[j], rounding
    cdef friction_components_t q
    for k in range(n):
        if lam[j + k] != 0.0:
            return False
    rounding = slack_rounding_of_row(p, j, size[0])
    if p.law == CONE:
        get_friction_components(p, i, &q)
        for g in range(q.n):
            gap -= q.friction_coefficient[g] * euclidean_norm(w + j + q.first[g], q.size[g])
            for k in range(q.first[g], q.first[g] + q.size[g]):
                rounding += q.friction_coefficient[g] * slack_rounding_of_row(p, j + k, size[k])
    return gap > rounding


cdef inline void add_block_floor(const blocks_t* p, int32_t i, const double* lam, const double* w, const double* e,
                                 const double* size, floor_t* s) noexcept nogil:
    """Add the rounding of the rows of block i to the floor, for the rows with an error that it changes.

    size begins at the first row of the block and is at least |A_kk| |lam_k|. If the norm of two rows is projected to its
    bound, e = lam - Pi also has the rounding of lam, (2^-53 |lam_k|) d_k as a velocity; the common d_k of both rows may be
    far above A_kk.
    """
    cdef int32_t k, g, j = p.ptr[i], n = p.ptr[i + 1] - j
    cdef friction_components_t q
    cdef double x, own
    cdef bint is_active
    if has_independent_rows(p, i):
        for k in range(n):
            add_row_floor(p, j + k, lam[j + k], w[j + k], size[k], s)
        return
    if n == 1:
        x = slack_rounding_of_row(p, j, size[0])
        is_active = (lam[j] == 0.0) & (w[j] > x)
        add_slack_rounding(p, j, j, 0.0 if is_active else x, s)
        return
    if is_satisfied_at_zero_with_rounding(p, i, lam, w, size):
        return
    add_slack_rounding(p, j, j, slack_rounding_of_row(p, j, size[0]), s)
    if is_disk_friction_contact(p, i):                                   # the common case, compiled with constant sizes
        get_disk_component(p, i, &q)
    else:
        get_row_groups(p, i, &q)
    for g in range(q.n):
        for k in range(q.first[g], q.first[g] + q.size[g]):
            x = size[k]
            if q.size[g] == 2 and e[j + k] != w[j + k] / p.d[j + k]:
                own = p.d[j + k] * fabs(lam[j + k])
                x = own if own > x else x
            add_slack_rounding(p, j + k, j, slack_rounding_of_row(p, j + k, x), s)


cdef inline int32_t get_island_block(const blocks_t* p, int32_t a) noexcept nogil:
    """Return the block at index `a` of the list of islands; without islands block a."""
    return p.islands.order[a] if p.islands != NULL else a


cdef inline int32_t index_of_island_begin(const blocks_t* p, int32_t island) noexcept nogil:
    """Return the index in `order` of the first block of an island; without islands all blocks form one."""
    return p.islands.ptr[island] if p.islands != NULL else 0


cdef inline int32_t index_of_island_end(const blocks_t* p, int32_t island) noexcept nogil:
    """Return one past the index in `order` of the last block of an island."""
    return p.islands.ptr[island + 1] if p.islands != NULL else p.n_blocks


cdef inline bint is_island_unmoved(const blocks_t* p, int32_t island) noexcept nogil:
    """Return whether no impulse moves a row of the island, by the signs of its terms."""
    cdef int32_t a, i, k
    if p.islands == NULL or p.islands.terms == NULL:
        return False
    for a in range(p.islands.ptr[island], p.islands.ptr[island + 1]):
        i = p.islands.order[a]
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if not p.islands.terms[k] < 0.0:
                return False
    return True


cdef inline void add_island_to_score(const blocks_t* p, int32_t island, const double* w, const double* e, const tally_t* s,
                                     const floor_t* f, tally_t* total, score_t* out) noexcept nogil:
    """Add the sums of an island to the total and its relative residual to the score; f is NULL without a floor.

    If the problem has no list of islands, only the sums are added; the caller computes the relative residual from them.
    """
    cdef const double* reference
    cdef double now, energy, velocity, floor = 0.0
    cdef double check = 0.0                             # This stays 0, or becomes NaN at an infinite or NaN slack.
    cdef int32_t a, i, k
    if p.islands == NULL:
        total[0] = s[0]
        return
    # the relative residual (1) of judge/score.pxd
    reference = p.islands.reference + 2 * island
    energy, velocity = sqrt(s.energy), sqrt(s.fast) if s.fast > 0.0 else 0.0
    if not energy + velocity < 1.0 / 0.0:
        now = 1.0 / 0.0
    elif reference[0] < 0.0:
        now = relative_residual_by_rows(p, p.islands.order, p.islands.ptr[island], p.islands.ptr[island + 1], e)
    else:
        now = max(relative_residual(energy, velocity, reference[0], reference[1]),
                  relative_residual_of_unmoved_rows(p, p.islands.order, p.islands.ptr[island], p.islands.ptr[island + 1], e))
    for a in range(p.islands.ptr[island], p.islands.ptr[island + 1]):
        i = p.islands.order[a]
        for k in range(p.ptr[i], p.ptr[i + 1]):
            check += 0.0 * w[k]
    if check != 0.0:
        now = 1.0 / 0.0
    if f != NULL:
        floor = f.own if reference[0] < 0.0 else relative_residual(sqrt(f.energy), sqrt(f.fast), reference[0], reference[1])
        if floor_hides_residual(floor) and now < floor < 1.0 / 0.0:
            now = floor
        if not is_at_floor(now, floor) and now > out.above_floor:
            out.above_floor = now
    if out.by_island != NULL:
        out.by_island[2 * island] = now
        out.by_island[2 * island + 1] = sqrt(s.energy)
    if now > out.relative or island == 0:
        out.relative, out.floor, out.island = now, floor, island
    total.energy += s.energy
    if s.fast > total.fast:
        total.fast, total.worst = s.fast, s.worst


cdef inline void score_all_blocks(const blocks_t* p, const double* lam, const double* w, double* e, const double* sizes,
                                  score_t* out) noexcept nogil:
    """Compute the errors e (m) of all blocks and their norms, island by island.

    sizes (m) is an upper bound of |A| |lam|, from which the floors are computed. If it is NULL, the floor entries are not changed.
    """
    cdef int32_t island, a, i, k, end
    cdef const int32_t* order = p.islands.order if p.islands != NULL else NULL
    cdef tally_t own, s = make_empty_tally()
    cdef floor_t floor, f = floor_t(0.0, 0.0, 0.0)
    if p.islands != NULL:
        out.relative = out.floor = out.above_floor = 0.0
        out.island = 0
    for island in range(p.islands.n if p.islands != NULL else 1):
        own, floor = make_empty_tally(), floor_t(0.0, 0.0, 0.0)
        end = index_of_island_end(p, island)
        for a in range(index_of_island_begin(p, island), end):
            i = get_block_in_order(order, a)
            if has_independent_rows(p, i):              # the common case, compiled without calls
                for k in range(p.ptr[i], p.ptr[i + 1]):
                    e[k] = compute_row_error(lam[k], w[k], p.d[k], p.lower[k], p.upper[k])
                    add_row_error(p, k, e[k], &own)
                    if sizes != NULL:
                        add_row_floor(p, k, lam[k], w[k], sizes[k], &floor)
                continue
            compute_block_error(p, i, lam, w, e)
            add_block_error(p, i, e, &own)
            if sizes != NULL:
                add_block_floor(p, i, lam, w, e, sizes + p.ptr[i], &floor)
        add_island_to_score(p, island, w, e, &own, &floor if sizes != NULL else NULL, &s, out)
        f.energy += floor.energy
        f.fast = floor.fast if floor.fast > f.fast else f.fast
    out.energy = sqrt(s.energy)
    out.velocity = sqrt(s.fast) if s.fast > 0.0 else 0.0
    out.worst = s.worst
    out.finite = out.energy + out.velocity < 1.0 / 0.0
    if not out.finite:
        out.velocity = 1.0 / 0.0
        for k in range(p.n_rows):
            if not fabs(e[k]) < 1.0 / 0.0:
                out.worst = k
                break
    if sizes != NULL:
        out.floor_energy, out.floor_velocity = sqrt(f.energy), sqrt(f.fast)
