"""The iterate of Newton's method over generalised velocities: what is kept of it, and what a point answers (`newton.pxd`).

Rows and blocks of an island stand in runs of panels; errors are those of the judge. With theta > 0 [1/kg] on every row
and s = J (v - v*) - b [m/s], a block's law determines its impulse:

    z = (rho c - s) / theta
    row        lambda = clip(z, lower, upper)
    contact    lambda = Pi(z) of its law in the metric of theta (`core/contact_map.pxd`)                  (1)
    V          -d lambda / d s, of the block's rows

theta is equal on all tangents of a disk, which makes (1) a closed form.
"""
from libc.math cimport sqrt
from libc.stdint cimport int32_t
from libc.string cimport memcpy, memset

from lavender_ext.core.block cimport block_error, row_error
from lavender_ext.core.contact_map cimport contact_map
from lavender_ext.core.generalized cimport panel_transpose_add, panel_times
from lavender_ext.core.block_types cimport blocks_t, is_rows, get_friction_components, friction_components_t
from lavender_ext.core.view cimport generalized_t
from lavender_ext.factor.tiles cimport combine
from lavender_ext.judge.tally cimport empty_tally, tally_block, tally_row, tally_t


cdef struct descent_t:          # Newton steps under one law
    int32_t idle
    int32_t n                   # steps of it
    int32_t fresh               # s was formed anew, not moved
    int32_t stale               # N is to be formed anew
    int32_t known               # lambda and V are those at s
    int32_t moved               # the centre has moved since the last step
    double share                # of d
    double least                # lowest error, that of `best`,
    double lowest               # and of its own steps
    double last_center
    double sizes[3]             # |G| of the last steps


cdef struct wait_t:             # an island whose steps may be used up, to go on with
    int32_t island              # -1: none waits
    int32_t worst               # end of the islands before it
    int32_t cold                # the run began from nothing; asked for Coulomb's law alone
    int32_t at                  # of a round of Coulomb friction
    int32_t rounds              # of Coulomb friction before this one
    double kept                 # error of the island's best, which a cut may have found,
    double least                # and of the best that one run knows of


cdef struct flow_t:
    blocks_t p                  # a copy: its law is that of the convex problem while one is solved
    const generalized_t* g
    int32_t law                 # of the problem
    double share                # of d, that rho is at first
    int32_t n_islands
    const int32_t* iptr         # (n_islands + 1) runs of panels of each island in `run`
    const int32_t* run          # (2 runs) first panel and the one past the last; runs <= n_panels
    const int32_t* cptr         # (n_islands + 1) columns of each island in `icols`
    const int32_t* icols        # (<= n) ascending in each
    const int32_t* local        # (n) number of a column in its island
    int32_t plain               # bounded rows alone
    const int32_t* few          # (n_islands) A is less work than N
    int32_t sparse              # one at least is not few: L is known
    const int32_t* lptr         # (n + 1) rows of the islands' L, one after the other
    const int32_t* lidx         # columns in their island, ascending
    const int32_t* pblock       # (n_panels + 1) first block of each panel
    const int32_t* vptr         # (k + 1) V of each block: its diagonal for bounded rows, else square
    int32_t island              # the present one
    int32_t formed              # it is few: y, u, grad and step hold numbers of its rows (`normal.pxd`)
    int32_t still               # its y is 0
    double* theta               # (m) theta', > 0
    double* soft                # (m) 1 / theta'
    double* root                # (m) theta'^1/2
    double* rho                 # (m) >= 0
    double* y                   # (max(n, m)) y, or mu
    double* u                   # Y^T lambda, or A lambda
    double* grad                # G, or h
    double* step                # p, or pi
    double* s                   # (m) Y y - b + phi
    double* q                   # (m) Y p
    double* phi                 # (m)
    double* center              # (m)
    double* lam                 # (m)
    double* trial               # (m)
    double* best                # (m) of one descent
    double* first_best          # (m) of one island, under the problem's own law
    double* aside               # (m) what a descent that waits began with: phi, under Coulomb's law the impulse
    double* w                   # (m)
    double* e                   # (m)
    double* v                   # V at s
    double* held                # V inside `normal`
    double* normal              # N of the present island where L has entries; or whole: Coulomb
    double* factor              # its factor
    double* inv                 # (s) 1 / D
    double* turned              # (rows of a panel, columns) V times Y
    double* line                # (columns)
    double* local_rhs           # (s)
    int32_t* swap               # (s)
    int32_t n_answering         # rows of S
    int32_t rows                # of an island that is few, and up to three more, which are 0
    int32_t wide                # as `core/method.pxd` has it
    int32_t* listed             # (m) those rows
    int32_t n_own               # velocities of the island, or rows where it is few,
    const int32_t* own          # and which they are
    int32_t* places             # (m) of rows that answer, in the island,
    int32_t* columns            # (m) and where their columns of A begin
    int32_t* picks              # (m) scratch
    int32_t* reached            # of each panel, where rows of Y^T begin
    int32_t* home               # (m) panel of each; -1 - panel where its column of A is not known
    double* a                   # (rows, rows) A, symmetric
    double* across              # (s, rows) Y^T
    double* sum                 # (2 rows) scratch
    double tol                  # relative residual asked of each island
    double reference_energy         # reference of a problem of one island, sqrt J
    double reference_velocity       # m/s
    double energy_limit         # of the present island, sqrt J
    double velocity_limit       # m/s
    int32_t steps               # Newton steps left
    int32_t factorisations
    int32_t rounds              # of Coulomb friction
    int32_t evaluations         # of lambda(s) along a line
    wait_t wait
    descent_t descent


# -- rows and blocks of a run of panels ------------------------------------------------------------------


cdef inline int32_t row_from(const flow_t* f, int32_t a) noexcept nogil:
    return f.g.prow[f.run[2 * a]]


cdef inline int32_t row_end(const flow_t* f, int32_t a) noexcept nogil:
    return f.g.prow[f.run[2 * a + 1]]


cdef inline int32_t block_from(const flow_t* f, int32_t a) noexcept nogil:
    return f.pblock[f.run[2 * a]]


cdef inline int32_t block_end(const flow_t* f, int32_t a) noexcept nogil:
    return f.pblock[f.run[2 * a + 1]]


# -- lambda(s) and V -------------------------------------------------------------------------------------


cdef inline void respond_contact(const flow_t* f, int32_t i, double* lam, double* v) noexcept nogil:
    """(1) of contact i: z in lam becomes lambda, with V."""
    cdef int32_t j = f.p.ptr[i], n = f.p.ptr[i + 1] - j, k, l
    cdef const double* root = f.root + j
    cdef const double* soft = f.soft + j
    cdef friction_components_t q
    cdef double y[6]
    cdef double out[6]
    cdef double back[6]                                 # theta^-1/2
    for k in range(n):
        back[k] = root[k] * soft[k]
        y[k] = root[k] * lam[k]
    get_friction_components(&f.p, i, &q)
    for k in range(q.n):
        q.friction_coefficient[k] = q.friction_coefficient[k] * root[q.first[k]] * back[0]
    contact_map(f.p.law, &q, y, out, v)
    for k in range(n):
        lam[k] = lam[k] if out[k] == y[k] else out[k] * back[k]
        for l in range(n):
            v[k * n + l] *= back[k] * back[l]


cdef inline void respond(const flow_t* f, int32_t first, int32_t last, const double* s, double* lam,
                         double* v) noexcept nogil:
    """lambda and V of blocks [first, last)."""
    cdef int32_t i, j, end, k, at
    # Hoisted: what is stored to might be any of them, for all a compiler knows.
    cdef const int32_t* ptr = f.p.ptr
    cdef const int32_t* vptr = f.vptr
    cdef const double* lower = f.p.lower
    cdef const double* upper = f.p.upper
    cdef const double* rho = f.rho
    cdef const double* center = f.center
    cdef const double* soft = f.soft
    cdef double z, low, high
    if f.plain:                                         # V of a row stands in its place
        end = ptr[last]
        for k in range(ptr[first], end):
            z = (rho[k] * center[k] - s[k]) * soft[k]
            low = lower[k]
            high = upper[k]
            v[k] = soft[k] if low < z < high else 0.0
            lam[k] = low if z < low else (high if z > high else z)
        return
    for i in range(first, last):
        j = ptr[i]
        end = ptr[i + 1]
        at = vptr[i]
        if is_rows(&f.p, i):
            at -= j
            for k in range(j, end):
                z = (rho[k] * center[k] - s[k]) * soft[k]
                low = lower[k]
                high = upper[k]
                v[at + k] = soft[k] if low < z < high else 0.0
                lam[k] = low if z < low else (high if z > high else z)
            continue
        for k in range(j, end):
            lam[k] = (rho[k] * center[k] - s[k]) * soft[k]
        respond_contact(f, i, lam + j, v + at)


cdef inline void respond_all(const flow_t* f, int32_t island, const double* s, double* lam) noexcept nogil:
    cdef int32_t a
    for a in range(f.iptr[island], f.iptr[island + 1]):
        respond(f, block_from(f, a), block_end(f, a), s, lam, f.v)


# -- A of an island that is few --------------------------------------------------------------------------


cdef enum:
    NOWHERE = -2147483647       # `home` of the first row, until Y^T is there


cdef inline void lay_across(const flow_t* f, int32_t island) noexcept nogil:
    """Y^T; no column of A is known."""
    cdef int32_t a, b, _i, q, nc, row = 0, size = f.cptr[island + 1] - f.cptr[island]
    cdef const int32_t* cols
    cdef int32_t* at
    cdef const double* y
    cdef double* x
    memset(f.across, 0, <size_t>size * f.rows * sizeof(double))
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for b in range(f.run[2 * a], f.run[2 * a + 1]):
            cols = f.g.cols + f.g.pcol[b]
            nc = f.g.pcol[b + 1] - f.g.pcol[b]
            y = f.g.y + f.g.pval[b]
            at = f.reached + f.g.pcol[b]
            for q in range(nc):
                at[q] = f.local[cols[q]] * f.rows
            for _i in range(f.g.prow[b], f.g.prow[b + 1]):
                x = f.across + row
                for q in range(nc):
                    x[at[q]] = y[q]
                f.home[row] = -1 - b
                y += nc
                row += 1


cdef inline void find_column(const flow_t* f, int32_t place) noexcept nogil:
    """Of A, of the row at this place of the island."""
    cdef int32_t b, nc
    if f.home[0] == NOWHERE:
        lay_across(f, f.island)
    b = -1 - f.home[place]
    if b >= 0:
        nc = f.g.pcol[b + 1] - f.g.pcol[b]
        combine(f.wide, f.rows, nc, f.across, f.reached + f.g.pcol[b], f.g.y + f.g.pval[b] + (f.own[place] - f.g.prow[b]) * nc,
                f.a + place * f.rows)
        f.home[place] = b


cdef inline bint times_a(const flow_t* f, const double* x, double* out) noexcept nogil:
    """out = A x on the island's rows; whether any x is other than 0."""
    cdef int32_t a, count = 0, n = f.n_own, rows = f.rows
    cdef const int32_t* own = f.own                     # hoisted, as in `respond`
    cdef int32_t* picks = f.picks
    cdef double* sums = f.sum
    cdef double* given = sums + rows
    for a in range(n):
        if x[own[a]] != 0.0:
            find_column(f, a)
            picks[count] = a * rows
            given[count] = x[own[a]]
            count += 1
    combine(f.wide, rows, count, f.a, picks, given, sums)
    for a in range(n):
        out[own[a]] = sums[a]
    return count > 0


cdef inline bint gather(const flow_t* f, int32_t island, const double* lam, double* x) noexcept nogil:
    """x = Y^T lam on the island's columns, or A lam; whether any lam is other than 0."""
    cdef int32_t a, b, k
    cdef bint moves = False
    if f.formed:
        return times_a(f, lam, x)
    for a in range(f.cptr[island], f.cptr[island + 1]):
        x[f.icols[a]] = 0.0
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            if lam[k] != 0.0:
                moves = True
                break
        if moves:
            for b in range(f.run[2 * a], f.run[2 * a + 1]):
                panel_transpose_add(f.g, b, lam, x)
    return moves


cdef inline void spread(const flow_t* f, int32_t island, const double* x, double* out) noexcept nogil:
    """out = Y x on the island's rows."""
    cdef int32_t a, b, end
    for a in range(f.iptr[island], f.iptr[island + 1]):
        end = f.run[2 * a + 1]
        for b in range(f.run[2 * a], end):
            panel_times(f.g, b, x, out)


cdef inline void keep(const flow_t* f, int32_t island, const double* x, double* to) noexcept nogil:
    """to = x on the island's rows."""
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        k = row_from(f, a)
        memcpy(to + k, x + k, (row_end(f, a) - k) * sizeof(double))


cdef inline void blank(const flow_t* f, int32_t island, double* out) noexcept nogil:
    """out = 0 on the island's rows."""
    cdef int32_t a, k
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            out[k] = 0.0


cdef inline void renew(const flow_t* f, int32_t island) noexcept nogil:
    """s = Y y - b + phi."""
    cdef int32_t a, k
    cdef double* s = f.s
    cdef const double* phi = f.phi
    cdef const double* b = f.p.b
    if f.still:
        blank(f, island, s)
    elif f.formed:
        times_a(f, f.y, s)
    else:
        spread(f, island, f.y, s)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            s[k] += phi[k] - b[k]


cdef inline double measure(const flow_t* f, int32_t island, const double* lam, bint moves,
                           double* velocity) noexcept nogil:
    """Energy [sqrt J] and velocity [m/s] of the errors of lam, with u of `gather`, 0 unless it `moves`; NaN: not finite."""
    cdef int32_t a, i, k, end, last
    cdef const int32_t* ptr = f.p.ptr
    cdef const double* lower = f.p.lower
    cdef const double* upper = f.p.upper
    cdef const double* d = f.p.d
    cdef const double* b = f.p.b
    cdef const double* phi = f.phi
    cdef const double* compliance = f.g.compliance
    cdef double* w = f.w
    cdef tally_t t = empty_tally()
    if not moves:
        blank(f, island, w)
    elif f.formed:
        keep(f, island, f.u, w)
    else:
        spread(f, island, f.u, w)
    for a in range(f.iptr[island], f.iptr[island + 1]):
        for k in range(row_from(f, a), row_end(f, a)):
            w[k] += compliance[k] * lam[k] - b[k] + phi[k]
        if f.plain:
            for k in range(row_from(f, a), row_end(f, a)):
                tally_row(&f.p, k, row_error(lam[k], w[k], d[k], lower[k], upper[k]), &t)
            continue
        last = block_end(f, a)
        for i in range(block_from(f, a), last):
            if is_rows(&f.p, i):
                end = ptr[i + 1]
                for k in range(ptr[i], end):
                    tally_row(&f.p, k, row_error(lam[k], w[k], d[k], lower[k], upper[k]), &t)
            else:
                block_error(&f.p, i, lam, w, f.e)
                tally_block(&f.p, i, f.e, &t)
    velocity[0] = sqrt(t.fast) if t.fast > 0.0 else 0.0
    return sqrt(t.energy)
