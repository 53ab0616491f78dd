"""The best impulse of all checks so far, selected separately for each island.

The impulse of an island is replaced by a later one if either

    the later one solves the island (relative residual r <= tol) and the present one does not; or          (1)
    its energy error E of the island is lower, and its r is not above the r of the start                    (2)

(E and r: score.pxd.) A row that no impulse satisfies, which keeps r at 1, therefore does not affect the results of other
islands, and no island ends with a larger residual than it started with.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.judge.score cimport score_t


cdef struct best_t:
    int32_t n                   # number of islands
    int32_t seen                # number of impulses so far
    double* impulse             # (m) N s
    double* relative            # (n) -, relative residual of `impulse`
    double* energy              # (n) sqrt J, energy error of `impulse`
    double* start               # (n) -, lowest relative residual of the impulses that a run may begin from
    double* now                 # (n, 2) -, sqrt J: relative residual and energy of the next impulse, for `score_t.by_island`


cdef inline int32_t count_islands(const blocks_t* p) noexcept nogil:
    """Return the number of islands, at least 1."""
    return p.islands.n if p.islands != NULL else 1


cdef inline int64_t best_workspace_size(int64_t m, int64_t n) noexcept nogil:
    """Return the number of doubles that `bind_best` needs for m rows in n islands."""
    return m + 5 * n


cdef inline void bind_best(best_t* s, const blocks_t* p, double* workspace) noexcept nogil:
    """Initialise s before the first impulse; workspace (`best_workspace_size`)."""
    cdef int32_t n = count_islands(p)
    s.n, s.seen = n, 0
    s.impulse, s.relative = workspace, workspace + p.n_rows
    s.energy, s.start, s.now = s.relative + n, s.relative + 2 * n, s.relative + 3 * n


cdef inline void copy_score_without_islands(best_t* s, const blocks_t* p, const score_t* x, double relative) noexcept nogil:
    """Write the score x of a pass to `now` if the problem has no islands; with islands the pass has written `now` itself."""
    if p.islands == NULL:
        s.now[0], s.now[1] = relative, x.energy if x.finite else INFINITY


cdef inline void copy_island_impulse(const blocks_t* p, int32_t island, const double* lam, double* out) noexcept nogil:
    """Copy the rows of an island from lam to out (m each)."""
    cdef int32_t a, i
    if p.islands == NULL:
        memcpy(out, lam, p.n_rows * sizeof(double))
        return
    for a in range(p.islands.ptr[island], p.islands.ptr[island + 1]):
        i = p.islands.order[a]
        memcpy(out + p.ptr[i], lam + p.ptr[i], (p.ptr[i + 1] - p.ptr[i]) * sizeof(double))


cdef inline bint is_better_in_island(const best_t* s, int32_t island, double tol) noexcept nogil:
    """Return whether (1) or (2) holds for `now`."""
    cdef double relative = s.now[2 * island]
    if s.relative[island] <= tol:
        return False
    return relative <= tol or (relative <= s.start[island] and s.now[2 * island + 1] < s.energy[island])


cdef inline void store_better_start(best_t* s, const blocks_t* p, const double* lam) noexcept nogil:
    """Store the start lam (m), scored in `now`, in the islands in which no earlier start has a lower relative residual."""
    cdef int32_t i
    for i in range(s.n):
        if s.seen == 0 or s.now[2 * i] < s.start[i]:
            s.relative[i] = s.start[i] = s.now[2 * i]
            s.energy[i] = s.now[2 * i + 1]
            copy_island_impulse(p, i, lam, s.impulse)
    s.seen += 1


cdef inline bint store_better_islands(best_t* s, const blocks_t* p, const double* lam, double tol) noexcept nogil:
    """Store lam (m), scored in `now`, in the islands in which it is better; return whether it is better in any island.

    The first impulse that is stored counts as a start.
    """
    cdef int32_t i
    cdef bint changed = False
    if s.seen == 0:
        store_better_start(s, p, lam)
        return True
    for i in range(s.n):
        if not is_better_in_island(s, i, tol):
            continue
        s.relative[i], s.energy[i] = s.now[2 * i], s.now[2 * i + 1]
        copy_island_impulse(p, i, lam, s.impulse)
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
