"""Reference errors E0 [sqrt J] and V0 [m/s] of an island, the denominators of its relative residual.

They are E and V (score.pxd) of the zero impulse x = Pi(0), slack w = A x - b, error e, unless the zero impulse solves the island.
It does if no row's error is more than the rounding of the row's right-hand side, s_k = |b_k|:

    d_k |e_k| <= 2^-48 s_k                                  for each row k of the island                   (1)

An island with (1) is at rest. Its references are the norms of s over the rows that act, those not strictly inactive:

    E0 = sqrt(sum s_k^2 / d_k),   V0 = max s_k sqrt(nu_k / d_k)                                            (2)

    strictly inactive   row       x_k at a bound, w_k pushes it there by more than 2^-48 s_k, or both bounds are equal
                        contact   w_n > 2^-48 s_n; under the cone law w_n - sum a_g |w_g| > 2^-48 (s_n + sum a_g |s_g|)

If (2) is zero, no row acts: each row is compared with its own terms, a contact with its normal's terms (E0 = V0 = -1):

    relative = max d_k |e_k| / s_k,   of a contact sqrt(d_n sum d_k e_k^2) / s_n       (3) `relative_residual_by_rows`

    of a contact that no impulse moves at most 1

A row that does not act therefore does not change the residual of rows that do, however large its b is. A row with b = 0 has

    s_k = |target_k| + sum_j |J_kj v*_j|, or |b_k| if A is given,   of b = target - J v*                                 (4)

or, if impulses move it and (4) is 0, 2^-51 sqrt(d_k) sqrt(sum E0_i^2), so that an error far below rounding counts as 0.

A row that no impulse moves has w = -b, whatever the impulse is. Its s_k is its error d_k |e_k| at the zero impulse if this exceeds
2^-48 of (4), so that a row that its bounds do not satisfy has the residual 1. Otherwise s_k is (4). The rows of a contact share
one s: the error (3) at the zero impulse, or the largest (4). If impulses move its tangents but not its normal, only an
approaching normal counts as a row that no impulse moves, with s_n = b_n. The residual of an island is at least
max min(1, d_k |e_k| / s_k) over its rows that no impulse moves; (3) applies if it has no others. A b of such a row of at most
2^-51 max |b| is the rounding of a computation that ended in 0 (s_k = infinity).
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport euclidean_norm
from lavender_ext.core.block_types cimport (CONE, blocks_t, get_row_groups, has_independent_rows, islands_t,
                                            get_friction_components, friction_components_t)
from lavender_ext.core.rows cimport get_block_jacobian
from lavender_ext.core.view cimport get_block_bodies, view_t
from lavender_ext.judge.score cimport relative_residual, unit_roundoff
from lavender_ext.judge.tally cimport (add_block_error, get_block_in_order, is_island_unmoved, make_empty_tally,
                                       relative_residual_by_rows, relative_residual_of_unmoved_rows, tally_t)


cdef inline double max_rounding_ratio() noexcept nogil:
    """Return 2^-48, the largest ratio of an error to the terms of its row that counts as rounding."""
    return 3.5527136788005009e-15


cdef inline bint is_strictly_inactive_row(const blocks_t* p, int32_t k, double x, double w) noexcept nogil:
    """Return whether the bounded row k is strictly inactive at x with slack w."""
    cdef double rounding = max_rounding_ratio() * fabs(p.b[k])
    if p.lower[k] == p.upper[k]:
        return True
    return (x == p.lower[k] and w > rounding) or (x == p.upper[k] and -w > rounding)


cdef inline bint is_strictly_inactive_contact(const blocks_t* p, int32_t i, const double* w) noexcept nogil:
    """Return whether contact i is strictly inactive at zero impulse with slack w (m)."""
    cdef int32_t g, j = p.ptr[i]
    cdef double gap = w[j], size = fabs(p.b[j])
    cdef friction_components_t q
    if p.law == CONE:
        get_friction_components(p, i, &q)
        for g in range(q.n):
            gap -= q.friction_coefficient[g] * euclidean_norm(w + j + q.first[g], q.size[g])
            size += q.friction_coefficient[g] * euclidean_norm(p.b + j + q.first[g], q.size[g])
    return gap > max_rounding_ratio() * size


cdef inline void add_row_terms(const blocks_t* p, int32_t k, int32_t n, double* energy, double* fast) noexcept nogil:
    """Add rows [k, k + n) to the sum and the maximum of (2); the maximum is over the norm of these rows."""
    cdef int32_t i
    cdef double t, both = 0.0
    for i in range(k, k + n):
        t = (p.b[i] / p.d[i]) * p.b[i]
        energy[0] += t
        both += t * p.nu[i]
    if both > fast[0]:
        fast[0] = both


cdef inline void add_block_terms(const blocks_t* p, int32_t i, const double* x, const double* w, double* energy,
                                 double* fast) noexcept nogil:
    """Add the rows of block i that act to the sum and the maximum of (2)."""
    cdef int32_t k, g, j = p.ptr[i]
    cdef friction_components_t q
    if has_independent_rows(p, i):
        for k in range(j, p.ptr[i + 1]):
            if not is_strictly_inactive_row(p, k, x[k], w[k]):
                add_row_terms(p, k, 1, energy, fast)
        return
    if is_strictly_inactive_contact(p, i, w):
        return
    add_row_terms(p, j, 1, energy, fast)
    get_row_groups(p, i, &q)
    for g in range(q.n):
        add_row_terms(p, j + q.first[g], q.size[g], energy, fast)


cdef inline double compute_island_reference(const blocks_t* p, const int32_t* order, int32_t first, int32_t end,
                                            const double* x, const double* w, const double* e, double* out) noexcept nogil:
    """Write E0 and V0 of blocks order[first:end] to out (2); return the relative residual of the zero impulse x.

    If an error is not finite both are 0, which makes every relative residual infinite.
    """
    cdef int32_t a, i, k
    cdef double energy = 0.0, fast = 0.0, check = 0.0       # check stays 0, or becomes NaN at a slack that is not finite.
    cdef bint rest = True                               # (1) holds for all rows.
    cdef tally_t s = make_empty_tally()
    for a in range(first, end):
        i = get_block_in_order(order, a)
        add_block_error(p, i, e, &s)
        for k in range(p.ptr[i], p.ptr[i + 1]):
            rest = rest and p.d[k] * fabs(e[k]) <= max_rounding_ratio() * fabs(p.b[k])
            check += 0.0 * w[k]
    s.energy = sqrt(s.energy)
    s.fast = sqrt(s.fast) if s.fast > 0.0 else 0.0
    if not s.energy + s.fast < 1.0 / 0.0 or check != 0.0:
        out[0] = out[1] = 0.0
        return 1.0 / 0.0
    if not rest:
        out[0], out[1] = s.energy, s.fast
        return max(relative_residual(s.energy, s.fast, out[0], out[1]), relative_residual_of_unmoved_rows(p, order, first, end, e))
    for a in range(first, end):
        add_block_terms(p, get_block_in_order(order, a), x, w, &energy, &fast)
    if energy > 0.0:
        out[0], out[1] = sqrt(energy), sqrt(fast)
        return relative_residual(s.energy, s.fast, out[0], out[1])
    out[0] = out[1] = -1.0
    return relative_residual_by_rows(p, order, first, end, e)    # This is 0, or small because of (1).


cdef inline void compute_reference(blocks_t* p, const double* x, const double* w, const double* e, double* out) noexcept nogil:
    """Write E0 [sqrt J], V0 [m/s] and the relative residual of the zero impulse x, slack w, error e (m each) to out (3).

    With several islands their references and residuals are set, and the first two are sqrt(sum E0_i^2) and max V0_i
    over the islands with a positive reference.
    """
    cdef islands_t* s = <islands_t*>p.islands
    cdef int32_t i
    cdef double r, sum_ = 0.0
    if s == NULL:
        out[2] = compute_island_reference(p, NULL, 0, p.n_blocks, x, w, e, out)
        return
    out[1] = out[2] = 0.0
    for i in range(s.n):
        r = compute_island_reference(p, s.order, s.ptr[i], s.ptr[i + 1], x, w, e, s.reference + 2 * i)
        if s.reference[2 * i] > 0.0:
            sum_ += s.reference[2 * i] * s.reference[2 * i]
            if s.reference[2 * i + 1] > out[1]:
                out[1] = s.reference[2 * i + 1]
            if is_island_unmoved(p, i):
                s.reference[2 * i] = s.reference[2 * i + 1] = -1.0
                r = relative_residual_by_rows(p, s.order, s.ptr[i], s.ptr[i + 1], e)
        s.reference[2 * s.n + i] = r
        out[2] = r if r > out[2] else out[2]
    out[0] = sqrt(sum_)


# -- terms of rows ----------------------------------------------------------------------------------------------------


cdef inline bint is_row_unmoved(const blocks_t* p, const int32_t* empty, int32_t i, int32_t k) noexcept nogil:
    """Return whether no impulse moves row k of block i, and it is not a friction row of a contact with a normal that moves.

    empty (m) marks zero rows of A; NULL if there are none.
    """
    return empty != NULL and empty[k] and (has_independent_rows(p, i) or empty[p.ptr[i]])


cdef inline bint has_island_without_scale(const blocks_t* p, const int32_t* empty) noexcept nogil:
    """Return whether (3) applies to a row with b = 0, or to a contact whose normal has b = 0, that impulses move."""
    cdef int32_t a, i, island, k
    for island in range(p.islands.n if p.islands != NULL else 0):
        if p.islands.reference[2 * island] < 0.0:
            for a in range(p.islands.ptr[island], p.islands.ptr[island + 1]):
                i = p.islands.order[a]
                for k in range(p.ptr[i], p.ptr[i + 1]):     # b of the normal is that of all rows of a contact.
                    if (p.b[k if has_independent_rows(p, i) else p.ptr[i]] == 0.0
                            and not (empty != NULL and empty[k])):
                        return True
    return False


cdef inline double compute_row_terms(const view_t* v, const double* free, int32_t i, int32_t k) noexcept nogil:
    """Return (4) for row k of block i; free is v* (6 n over bodies, n over J and M), NULL if it is not known."""
    cdef double x, velocity = 0.0, size = 0.0
    cdef double scratch[72]
    cdef const double* row
    cdef int32_t q, body
    if free != NULL and v.g != NULL:
        for q in range(v.g.jptr[k], v.g.jptr[k + 1]):
            x = v.g.jval[q] * free[v.g.jidx[q]]
            velocity += x
            size += fabs(x)
    elif free != NULL and v.r != NULL:
        row = get_block_jacobian(&v.p, v.r, i, scratch) + 12 * (k - v.p.ptr[i])
        for q in range(12):
            body = get_block_bodies(v.r, i)[q // 6]
            if body >= 0:
                x = row[q] * free[6 * <ssize_t>body + q % 6]
                velocity += x
                size += fabs(x)
    return fabs(v.p.b[k] + velocity) + size


cdef inline double unmoved_error_at_zero(const blocks_t* p, const int32_t* empty, int32_t i, int32_t k,
                                         const double* e) noexcept nogil:
    """Return the error at the zero impulse, with errors e (m), of row k of block i, which no impulse moves [m/s].

    Of a contact it is (3); if impulses move its tangents, b of the normal, or -1 if that is satisfied.
    """
    cdef int32_t q, j = p.ptr[i]
    cdef double total = 0.0
    if has_independent_rows(p, i):
        return p.d[k] * fabs(e[k])
    for q in range(j, p.ptr[i + 1]):
        if not empty[q]:
            return p.b[j] if k == j and p.b[j] > 0.0 else -1.0
        total += (p.d[q] * e[q]) * e[q]
    return sqrt(p.d[j]) * sqrt(total)


cdef inline void compute_terms(const view_t* v, const int32_t* empty, const double* free, double energy, const double* e,
                               double* terms) noexcept nogil:
    """Compute `islands_t.terms` (m): s_k, negative on rows that no impulse moves.

    energy is E0 of all rows, e (m) are the errors of the zero impulse.
    """
    cdef const blocks_t* p = &v.p
    cdef int32_t i, k
    cdef double largest, error, all_rows = 0.0
    for k in range(p.n_rows):
        all_rows = max(all_rows, fabs(p.b[k]))
    for i in range(p.n_blocks):
        largest = 0.0
        for k in range(p.ptr[i], p.ptr[i + 1]):
            terms[k] = fabs(p.b[k])
            if p.b[k] == 0.0 or is_row_unmoved(p, empty, i, k):
                terms[k] = compute_row_terms(v, free, i, k)
                if terms[k] == 0.0 and not is_row_unmoved(p, empty, i, k):
                    terms[k] = 4.0 * unit_roundoff() * sqrt(p.d[k]) * energy
            if is_row_unmoved(p, empty, i, k):
                largest = max(largest, terms[k])
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if is_row_unmoved(p, empty, i, k):
                error = unmoved_error_at_zero(p, empty, i, k, e)
                if error < 0.0:
                    terms[k] = max(terms[k], 4.0 * unit_roundoff() * sqrt(p.d[k]) * energy) if p.b[k] == 0.0 else fabs(p.b[k])
                    continue
                largest = terms[k] if has_independent_rows(p, i) else largest
                terms[k] = -error if error > max_rounding_ratio() * largest else -largest
                if fabs(p.b[k]) <= 4.0 * unit_roundoff() * all_rows:
                    terms[k] = -INFINITY
