"""Worlds in the lanes of vectors: 8, 4 or 2 worlds of similar structure at once, with bounded rows and contacts of three rows.

Entry i of an array holds entry i of every world: x[width i + lane]. Worlds with fewer rows than another lane's receive empty
rows, whose impulses are 0 and which change no bit of the others. A world is processed as one problem by the functions
of core and judge, with the same bits: no sum runs over lanes, so that the width changes no bit. Zeros of J, M and Y are processed
as numbers, or left out where every lane has them. Worlds that a lane does not cover are processed alone: invalid numbers,
several islands, a zero impulse that is a solution or violates bounds, results that judge/refine.pxd refines or that are above
tol. From the zero impulse such problems are solved by sweeps over blocks, then Newton steps on the natural map, in batches as in
single calls (`solve_in_one_lane`, with vectors over rows). To change a width, only the list of `LAVENDER_LANES` changes.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memset

from lavender_ext.batch.world cimport (BLOCK, BLOCKS, CONE_ROW, FREE, JAC, MASS, MU, PLACES, ROWS, SOFT, TARGET, VELOCITIES,
                                       AT_ROW, worlds_t)
from lavender_ext.core.block_types cimport ROW, blocks_t, has_independent_rows, is_disk_friction_contact
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.view cimport generalized_t
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.judge.refine cimport min_reported_loss
from lavender_ext.judge.score cimport make_empty_score, relative_residual, score_t, unit_roundoff
from lavender_ext.small.task cimport COUNT_ITERATIONS, COUNT_STEPS_OF_LANE, COUNT_SWEEPS_OF_LANE


cdef extern from "lanes.h":
    ctypedef struct lanes_t "lavender_lanes_t":
        int32_t m, n, law, k, warm
        const int32_t *ptr, *kind
        double asymmetry
        double *jac, *mass, *free, *target, *soft, *mu, *lower, *upper
        double *real
        double *inverse, *root, *y, *d, *b, *zero, *w, *e, *lam, *push, *size, *out
        double *a, *g, *step, *change, *kept
        double tol
        uint64_t *fours, *last
        int32_t *left, *own
    enum:
        LANE_IS_PLAIN, LANE_START_ENERGY, LANE_START_SPEED, LANE_RHS, LANE_CONDITION, LANE_ENERGY, LANE_SPEED, LANE_WORST
        LANE_FLOOR_ENERGY, LANE_FLOOR_SPEED, LANE_WORK, LANE_HEAVIEST, LANE_SWEEPS, LANE_STEPS, LANE_COUNT, LANE_NUMBERS
        MAX_LANE_ROWS "LANE_ROWS"
        MAX_LANE_VELOCITIES "LANE_VELOCITIES"
        LANE_LIST, LANE_TRIANGLE
        FEWEST_LANES "LAVENDER_FEWEST_LANES"
    void list_lane_columns "lavender_list_columns"(uint64_t set, int32_t* out) noexcept nogil
    void prepare_lanes "lavender_prepare_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void solve_lanes "lavender_solve_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void solve_one "lavender_solve_one"(const lanes_t* x, int32_t wide) noexcept nogil
    void judge_lanes "lavender_judge_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void interleave "lavender_interleave"(const void** x, int32_t narrow, int32_t n, const int32_t* at, double* out,
                                          int32_t width) noexcept nogil


cdef enum:
    MAX_LANES = 8


cdef inline int32_t count_lanes() noexcept nogil:
    """Return the number of lanes of this processor's widest instructions."""
    return max(FEWEST_LANES, 8 if has_wide() == 2 else 4 if has_wide() == 1 else 1)


cdef inline bint fits_lanes(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether block i is a set of bounded rows, or a contact of three rows without further coefficients."""
    return ((has_independent_rows(p, i) or is_disk_friction_contact(p, i))
            and p.patch_radius[i] == 0.0 and p.rolling[i] == 0.0)


cdef struct lane_rows_t:        # places of the worlds of a group in its lanes
    int32_t rows[MAX_LANES]     # number of rows of each world
    int32_t row[MAX_LANE_ROWS * MAX_LANES]      # row of each world that a row of the lanes holds; -1: none
    int32_t block[MAX_LANE_ROWS * MAX_LANES]
    int32_t ptr[MAX_LANE_ROWS + 1]              # blocks of the lanes
    int32_t kind[MAX_LANE_ROWS]


cdef inline int32_t kind_of_block(const blocks_t* p, int32_t i) noexcept nogil:
    """Return a number that is equal for blocks that lanes process alike, smaller for fewer rows."""
    return 2 * (p.ptr[i + 1] - p.ptr[i]) + (p.kind[i] != ROW)


cdef inline int64_t compute_structure_key(const worlds_t* w, int64_t i, int64_t* order) noexcept nogil:
    """Return a number that is equal for worlds that may share a group, and their order; 0 if lanes do not cover world i.

    Worlds with single bounded rows and contacts share groups, others only with equal sizes and kinds of blocks. The order is
    by contacts, bounded rows that follow contacts, and other rows, upwards and downwards in turn.
    """
    cdef const int64_t* at = w.at + i * PLACES
    cdef uint64_t key = 64 * <uint64_t>at[ROWS] + <uint64_t>at[VELOCITIES]
    cdef int32_t k, kind, j = <int32_t>at[BLOCK], contacts = 0, before = 0, after = 0
    order[0] = 0
    if not (0 < at[ROWS] <= MAX_LANE_ROWS and 0 < at[VELOCITIES] <= MAX_LANE_VELOCITIES):
        return 0
    for k in range(j, j + <int32_t>at[BLOCKS]):
        if not fits_lanes(&w.blocks, k):
            return 0
        kind = kind_of_block(&w.blocks, k)
        contacts, before, after = contacts + kind % 2, before + (contacts + kind % 2 == 0), after + (contacts > 0 and kind % 2 == 0)
        key = (key ^ <uint64_t>kind) * <uint64_t>0x100000001B3U         # FNV-1a
    if 3 * contacts + before + after < at[ROWS]:
        return <int64_t>(key | 1)
    order[0] = (contacts * MAX_LANE_ROWS + after) * 2 * MAX_LANE_ROWS
    order[0] += MAX_LANE_ROWS - before if (contacts + after) % 2 else before
    return 2 * at[VELOCITIES]


cdef inline bint arrange_lanes(const worlds_t* w, const int64_t* worlds, int32_t n_worlds, int32_t width, lanes_t* x,
                               lane_rows_t* p) noexcept nogil:
    """Find rows and blocks of lanes that hold every world's (n_worlds) in its order, the smallest first.

    Returns whether lanes take less time than single worlds: the time grows with (rows + 8)^2, and half a group takes as long
    alone. Further lanes hold the first world again.
    """
    cdef const int64_t* at[MAX_LANES]
    cdef int32_t next_block[MAX_LANES]
    cdef int32_t next_row[MAX_LANES]
    cdef int32_t lane, r, kind, own, least
    cdef int64_t order, work = 0
    if n_worlds < 2 or compute_structure_key(w, worlds[0], &order) == 0:
        return False
    for lane in range(width):
        at[lane] = w.at + PLACES * worlds[lane if lane < n_worlds else 0]
        p.rows[lane], next_block[lane], next_row[lane] = <int32_t>at[lane][ROWS], 0, 0
        work += (p.rows[lane] + 8) * (p.rows[lane] + 8) if lane < n_worlds else 0
        if at[lane][VELOCITIES] != at[0][VELOCITIES]:
            return False
    x.n, x.law, x.k, x.m, x.ptr, x.kind, p.ptr[0] = <int32_t>at[0][VELOCITIES], w.blocks.law, 0, 0, p.ptr, p.kind, 0
    while True:
        least = 2 * MAX_LANE_ROWS + 2
        for lane in range(width):
            if next_block[lane] < at[lane][BLOCKS]:
                least = min(least, kind_of_block(&w.blocks, <int32_t>at[lane][BLOCK] + next_block[lane]))
        if x.m + least // 2 > MAX_LANE_ROWS:            # no block is left, or too many rows
            return least == 2 * MAX_LANE_ROWS + 2 and 2 * work > width * (x.m + 8) * (x.m + 8)
        for lane in range(width):
            own = next_block[lane]
            kind = kind_of_block(&w.blocks, <int32_t>at[lane][BLOCK] + own) if own < at[lane][BLOCKS] else -1
            p.block[x.k * width + lane] = own if kind == least else -1
            for r in range(least // 2):
                p.row[(x.m + r) * width + lane] = next_row[lane] + r if kind == least else -1
            if kind == least:
                next_block[lane], next_row[lane] = own + 1, next_row[lane] + least // 2
        p.kind[x.k] = least % 2
        x.k, x.m = x.k + 1, x.m + least // 2
        p.ptr[x.k] = x.m


cdef inline void list_lane_blocks(const blocks_t* p, lanes_t* x, int32_t* ptr, int32_t* kind) noexcept nogil:
    """Write the x.k blocks of a problem to ptr (k + 1) and kind (k) of lanes."""
    cdef int32_t i
    x.ptr, x.kind, ptr[0] = ptr, kind, 0
    for i in range(x.k):
        ptr[i + 1] = p.ptr[i + 1]
        kind[i] = 0 if has_independent_rows(p, i) else 1


cdef inline int64_t bind_lanes(lanes_t* x, int32_t width, double* memory) noexcept nogil:
    """Take the arrays of lanes of m rows and n velocities from memory; return the number of doubles."""
    cdef int64_t m = x.m, n = x.n, at = 0, places = m + 3 & ~3
    cdef double*** array = [&x.jac, &x.mass, &x.y, &x.free, &x.inverse, &x.root, &x.push, &x.size, &x.target, &x.soft,
                            &x.lower, &x.upper, &x.d, &x.b, &x.zero, &x.w, &x.e, &x.lam, &x.step, &x.change, &x.kept, &x.mu,
                            &x.out, &x.a, &x.g, <double**>&x.fours, <double**>&x.last, <double**>&x.left, <double**>&x.own,
                            &x.real]
    cdef int64_t* count = [m * n, n * n, m * n, n, n, n, n, n, m, m, m, m, m, m, m, places, m, m, m, m, m, m,
                           LANE_NUMBERS, places * m, places * max(m, n), m, m, n * LANE_LIST, m * LANE_LIST, m]
    cdef int32_t i
    for i in range(30):
        array[i][0] = memory + at if memory != NULL else NULL
        at += width * count[i]
    return at


cdef inline double read_number(const worlds_t* w, int32_t which, int64_t i) noexcept nogil:
    """Return a number of an array of all worlds."""
    return (<const float*>w.array[which])[i] if w.narrow[which] else (<const double*>w.array[which])[i]


cdef inline void load_lanes(const lanes_t* x, const lane_rows_t* p, const worlds_t* w, const double* lam, const int64_t* worlds,
                            int32_t n_worlds, int32_t width) noexcept nogil:
    """Load worlds (n_worlds) and their impulses to the lanes; further lanes receive the first world again."""
    cdef const int64_t* at[MAX_LANES]
    cdef const void* line[MAX_LANES]
    cdef double zero[MAX_LANE_VELOCITIES]
    cdef int32_t place[MAX_LANE_VELOCITIES]
    cdef int32_t place_in_mass[LANE_TRIANGLE]
    cdef const int32_t* in_mass = place
    cdef int32_t i, k, own, lane, n = x.n
    cdef int64_t j, stride, here
    memset(zero, 0, sizeof(zero))
    for i in range(n):
        place[i] = i
    for lane in range(width):
        at[lane] = w.at + PLACES * worlds[lane if lane < n_worlds else 0]
        x.out[LANE_COUNT * width + lane] = p.rows[lane]
    # M and v*
    for lane in range(width):
        line[lane] = <const char*>w.array[2] + (4 if w.narrow[2] else 8) * at[lane][FREE]
    interleave(line, w.narrow[2], n, place, x.free, width)
    stride = w.mass_row if w.mass_row else n
    if w.mass_ptr != NULL:
        in_mass = place_in_mass
        memset(x.mass, 0, <int64_t>n * n * width * sizeof(double))
        for i in range(n):
            for k in range(w.mass_ptr[i], w.mass_ptr[i + 1]):
                place_in_mass[k] = i * n + w.mass_col[k]
    for i in range(1 if w.mass_ptr != NULL else n):
        for lane in range(width):
            line[lane] = <const char*>w.array[1] + (4 if w.narrow[1] else 8) * (at[lane][MASS] + i * stride)
        interleave(line, w.narrow[1], w.mass_ptr[n] if w.mass_ptr != NULL else n, in_mass,
                   x.mass + <int64_t>i * n * width, width)
    # Fill the rows and blocks. An empty row has a tiny d, so that the largest d of a lane is never that of an empty row.
    stride = w.jac_row_stride if w.jac_row_stride else n
    for i in range(x.m):
        for lane in range(width):
            j = i * width + lane
            own = p.row[j]
            line[lane] = zero
            x.target[j] = x.lower[j] = x.upper[j] = x.lam[j] = 0.0
            x.soft[j] = 1e-60
            if own >= 0:
                line[lane] = <const char*>w.array[0] + (4 if w.narrow[0] else 8) * (at[lane][JAC] + own * stride)
                x.target[j], x.soft[j] = read_number(w, 3, at[lane][TARGET] + own), read_number(w, 4, at[lane][SOFT] + own)
                here = at[lane][CONE_ROW] + own
                x.lower[j], x.upper[j], x.lam[j] = w.blocks.lower[here], w.blocks.upper[here], lam[at[lane][AT_ROW] + own]
        interleave(line, w.narrow[0], n, place, x.jac + <int64_t>i * n * width, width)
    for i in range(x.k):
        for lane in range(width):
            j = i * width + lane
            own = p.block[j]
            x.real[j], x.mu[j] = own >= 0, 0.0
            if own >= 0:
                x.mu[j] = w.blocks.mu[at[lane][BLOCK] + own] if w.array[5] == NULL else read_number(w, 5, at[lane][MU] + own)


cdef inline double lane_number(const lanes_t* x, int32_t which, int32_t width, int32_t lane) noexcept nogil:
    """Return a number of `out` of one lane."""
    return x.out[which * width + lane]


cdef inline void add_lane_counts(const lanes_t* x, int32_t width, int32_t lane, int32_t* counts) noexcept nogil:
    """Add the work of one lane to the counts of a task: sweeps, Newton steps, and both as iterations."""
    cdef int32_t sweeps = <int32_t>lane_number(x, LANE_SWEEPS, width, lane)
    cdef int32_t steps = <int32_t>lane_number(x, LANE_STEPS, width, lane)
    counts[COUNT_SWEEPS_OF_LANE] += sweeps
    counts[COUNT_STEPS_OF_LANE] += steps
    counts[COUNT_ITERATIONS] += sweeps + steps


cdef inline score_t score_of_lane(const lanes_t* x, int32_t width, int32_t lane) noexcept nogil:
    """Return the score of the judged impulse of a lane."""
    cdef score_t s = make_empty_score()
    s.energy, s.velocity = lane_number(x, LANE_ENERGY, width, lane), lane_number(x, LANE_SPEED, width, lane)
    s.floor_energy, s.floor_velocity = lane_number(x, LANE_FLOOR_ENERGY, width, lane), lane_number(x, LANE_FLOOR_SPEED, width, lane)
    s.worst = <int32_t>lane_number(x, LANE_WORST, width, lane)
    return s


cdef inline bint is_lane_refined(const lanes_t* x, int32_t width, int32_t lane, double tol, double relative) noexcept nogil:
    """Return whether `refine_reported_view` may refine a lane."""
    cdef double energy = sqrt(fabs(lane_number(x, LANE_WORK, width, lane))), size, strictest = 10.0 * min_reported_loss()
    if energy == 0.0 or not tol < 1.0 / 0.0:
        return False
    size = 0.1 * relative_residual(energy, sqrt(lane_number(x, LANE_HEAVIEST, width, lane)) * energy,
                                   lane_number(x, LANE_START_ENERGY, width, lane), lane_number(x, LANE_START_SPEED, width, lane))
    size = x.n * unit_roundoff() * max(size, 1.0)
    return not size * lane_number(x, LANE_CONDITION, width, lane) <= 0.1 * max(min(tol, strictest), min(relative, strictest))


cdef inline bint is_solved_in_one_lane(const blocks_t* p, const generalized_t* g, const double* zero_residual) noexcept nogil:
    """Return whether a problem is of the kind that lanes solve: `fits_lanes`, one island, 0 within bounds and not a solution."""
    cdef int32_t i, k
    if not (0 < p.n_rows <= MAX_LANE_ROWS and g.n <= MAX_LANE_VELOCITIES and p.islands == NULL and zero_residual[2] == 1.0):
        return False
    for i in range(p.n_blocks):
        if not fits_lanes(p, i):
            return False
        for k in range(p.ptr[i], p.ptr[i + 1] if has_independent_rows(p, i) else p.ptr[i]):
            if not p.lower[k] <= 0.0 <= p.upper[k]:
                return False
    return True


cdef inline bint solve_in_one_lane(const blocks_t* p, const generalized_t* g, const double* zero_residual, double tol,
                                   bint warm, workspace_t* workspace, double* lam, int32_t* counts) noexcept nogil:
    """Solve with the bits of a lane, from and into lam (m), or from the zero impulse unless `warm`; return False without memory.

    The work is added to counts (`add_lane_counts`).
    """
    cdef lanes_t x
    cdef int32_t i, r, a, nc
    cdef uint64_t columns
    cdef int32_t ptr[MAX_LANE_ROWS + 1]
    cdef int32_t kind[MAX_LANE_ROWS]
    cdef const double* y
    x.m, x.n, x.law, x.tol, x.k, x.warm = p.n_rows, g.n, p.law, tol, p.n_blocks, warm
    if not grow_workspace_to(workspace, 0, bind_lanes(&x, 1, NULL)):
        return False
    bind_lanes(&x, 1, workspace.real)
    list_lane_blocks(p, &x, ptr, kind)
    memset(x.y, 0, <int64_t>x.m * x.n * sizeof(double))
    for i in range(g.n_panels):
        nc = g.pcol[i + 1] - g.pcol[i]
        for r in range(g.prow[i], g.prow[i + 1]):
            y = g.y + g.pval[i] + <int64_t>(r - g.prow[i]) * nc
            for a in range(nc):
                x.y[r * x.n + g.cols[g.pcol[i] + a]] = y[a]
    for i in range(x.k):
        columns = 0
        for a in range(g.pcol[g.home[i]], g.pcol[g.home[i] + 1]):
            columns |= <uint64_t>1 << g.cols[a]
        list_lane_columns(columns, x.own + i * LANE_LIST)
    x.b, x.d, x.soft, x.mu = <double*>p.b, <double*>p.d, <double*>g.compliance, <double*>p.mu
    x.lower, x.upper = <double*>p.lower, <double*>p.upper
    x.out[LANE_IS_PLAIN], x.out[LANE_START_ENERGY], x.out[LANE_START_SPEED] = 1.0, zero_residual[0], zero_residual[1]
    x.out[LANE_COUNT], x.lam = x.m, lam
    solve_one(&x, has_wide())
    add_lane_counts(&x, 1, 0, counts)
    return True
