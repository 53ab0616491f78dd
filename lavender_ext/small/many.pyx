"""Problems in generalised coordinates, one or many, without the interpreter: lay out, prepare, solve, judge.

The same kernels in the same order as on one problem alone, so the same bits and counts. What
does not end below tol on the judge's own measure, has an empty row that b asks for or is counted to cost more than is
asked for, is left to the caller.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.arrays cimport doubles
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.door cimport first_outside
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.method cimport MORE, REACHED, ROOM, options_t, room_t, said_t
from lavender_ext.core.parts cimport CONE, blocks_t, is_rows
from lavender_ext.core.problem cimport MADE, Data, made_t, make_numbers
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, lav_room, lav_start, lav_step
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.generalized.newton cimport is_soft
from lavender_ext.small.limits cimport allowed, cost_of, limits_t, step_cost
from lavender_ext.small.room cimport has_room
from lavender_ext.small.world cimport (BAD, BLOCK, BLOCKS, CONE_ROW, FREE, JAC, LATE, LEFT, MASS, MU, N_ARRAYS, PLACES, READY,
                                       AT_ROW, ROWS, SOFT, TARGET, TRIED, VELOCITIES, VELOCITY, desk_t, lay_world, worlds_t)
from lavender_ext.judge.measure cimport do_nothing, general_floor, general_slack, judge_nothing, judged_from, relative_of
from lavender_ext.judge.rounding cimport relative_size, squares32
from lavender_ext.judge.score cimport norms_of_rhs, relative, score_rows, score_t

cdef object new = np.empty

cdef extern from *:
    """
    #if defined(_MSC_VER)
    #include <intrin.h>
    #define lav_add(p, x) _InterlockedExchangeAdd64((volatile __int64*)(p), (x))
    #else
    #define lav_add(p, x) __atomic_fetch_add((p), (x), __ATOMIC_ACQ_REL)
    #endif
    """
    int64_t lav_add(int64_t* p, int64_t x) noexcept nogil


cdef enum:
    STEPS = 128                 # of newton for each island
    AT_A_TIME = 256             # problems between two checks for Ctrl-C
    # Counted in readings of all entries, fitted to 500 drawn problems; within 1.4 times what nine of ten take.
    READ = 10                   # what is worked out and judged
    FORMED = 3                  # N, beside half of its counted factor
    LINE = 11                   # each row of an evaluation along a line
    LOOKS = 3                   # evaluations of a step


cdef struct job_t:
    blocks_t p
    generalized_t g
    made_t made                 # of the data, or of this call
    bint known                  # it is this problem's
    double begin[3]             # E0, V0, relative residual of doing nothing; E0 < 0 where not known
    int32_t cold                # 1: from doing nothing, else from lam as it is
    double most                 # ns that it may cost as counted, then what it has come to is the result; inf: to the end
    bint solved
    bint spent                  # what it might cost is
    int32_t counts[4]           # steps, factorisations, rounds, evaluations
    double* lam                 # (m)
    double* both                # (2 m + 1) w, e
    const double* push          # (n) M^-1 J^T lam of the judge, in room that the next world takes
    score_t score
    double relative, floor


cdef inline void begin(job_t* j, double* w) noexcept nogil:
    """E0, V0 and the relative residual of doing nothing; w (3 m + n) is scratch."""
    cdef view_t v = view_t(j.p, NULL, NULL, &j.g)
    cdef ssize_t m = j.p.n_rows
    judge_nothing(&v, w + 2 * m, w, w + m, w + 3 * m, j.begin)


cdef inline double spent_by(const job_t* j, const limits_t* l, double work, int32_t factored, double lines) noexcept nogil:
    """What so many factorisations and evaluations along lines are counted to have cost, with what is read before and after [ns]."""
    cdef double once = step_cost(&j.p, &j.g, l, 0.0)
    return (READ + FORMED * factored) * once + 0.5 * factored * l.work * work + LINE * l.entry * j.p.n_rows * lines


cdef inline int32_t step_within(job_t* j, const view_t* v, const options_t* o, const room_t* r, const limits_t* l) noexcept nogil:
    """Steps for as long as what they did is counted to cost less than `most` of the job: `spent` where it is not over then.

    Those that factor nothing are cheap, so it is asked again for as many as what is left is for if each did.
    """
    cdef said_t said = said_t(0, 0, 0, 0, 0.0, NULL, NULL)
    cdef int32_t code = MORE
    cdef double each = spent_by(j, l, r.work, 1, LOOKS) - spent_by(j, l, r.work, 0, 0.0), fit = 1.0
    while code == MORE and fit >= 1.0:
        fit = (j.most - spent_by(j, l, r.work, said.factorisations, said.evaluations)) / each
        code = lav_step(v, o, r, <int32_t>max(fit, 0.0) if fit < o.budget else o.budget, j.lam, &said)
    j.counts[0], j.counts[1], j.counts[2], j.counts[3] = said.work, said.factorisations, said.rounds, said.evaluations
    j.spent = code == MORE
    return code


cdef inline bint settle_empty_rows(const job_t* j, double tol) noexcept nogil:
    """Rows of zeros at the bound that b asks for, as `decide_empty_rows` of lavender/solving/outcome.py.

    0 where that is infinite and b alone is above tol, or where A_ii is 0 only because products of small numbers vanish.
    """
    cdef const blocks_t* p = &j.p
    cdef int32_t i, k, q
    cdef double bound
    for i in range(p.n_blocks):
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if not j.made.empty[k]:
                continue
            for q in range(j.g.jptr[k], j.g.jptr[k + 1]):
                if j.g.jval[q] != 0.0:
                    return False
            if p.b[k] == 0.0 or (not is_rows(p, i) and k > p.ptr[i]):
                continue                                # asks nothing: tangents and spin have bounds of mu lambda_n
            if p.b[k] < 0.0 and p.law == CONE and not is_rows(p, i) and p.ptr[i + 1] - p.ptr[i] > 1:
                continue                                # a normal that separates bears friction of a contact that slides
            bound = p.upper[k] if p.b[k] > 0.0 else p.lower[k]
            if fabs(bound) < INFINITY:
                j.lam[k] = bound
            elif fabs(p.b[k]) * sqrt(p.nu[k] / p.d[k]) > tol * j.begin[1]:
                return False
    return True


cdef inline void judge_job(job_t* j, double* x) noexcept nogil:
    """The judge's pass over lam, `general_judge` with what it pushes kept; x (2 n + m) is scratch."""
    cdef int32_t m = j.p.n_rows
    j.score = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    general_slack(&j.p, &j.g, j.lam, x, j.both)
    score_rows(&j.p, j.lam, j.both, j.both + m, &j.score)
    general_floor(&j.p, &j.g, j.lam, j.both, j.both + m, x + j.g.n, &j.score)
    j.push = x
    j.relative = relative_of(&j.score, j.both, m, j.begin[0], j.begin[1])
    j.floor = relative(j.score.floor_energy, j.score.floor_velocity, j.begin[0], j.begin[1])


cdef inline bint has_numbers(job_t* j) noexcept nogil:
    """d, Y and what goes with them, worked out now unless they are known; within the door?"""
    if not j.known:
        j.known = make_numbers(&j.p, &j.g, &j.made) == MADE
    return j.known and first_outside(j.p.d, j.p.n_rows) < 0


cdef inline void solve_job(job_t* j, room_t* room, const limits_t* limits, double tol) noexcept nogil:
    cdef view_t v
    cdef options_t o = options_t(NEWTON, STEPS, 0, 0, has_wide(), tol, 0.0, 0.0, limits.values)
    cdef room_t r
    cdef int32_t m = j.p.n_rows, code = ROOM
    cdef bint soft
    j.counts[0] = j.counts[1] = j.counts[2] = j.counts[3] = 0
    if not has_numbers(j):
        return
    if not has_room(room, 0, 3 * <ssize_t>m + j.g.n):
        return
    if j.begin[0] < 0.0:
        begin(j, room.real)
    v = view_t(j.p, NULL, NULL, &j.g)
    lav_room(&v, &o, &r)
    while code == ROOM and not r.laid:
        if not has_room(room, r.n_index, 0):
            return
        r.index = room.index
        code = lav_start(&v, &o, &r, j.lam)
    soft = is_soft(&j.p, &j.g)
    if code != ROOM or cost_of(&j.p, &j.g, limits, r.work, soft) > allowed(&j.p, &j.g, limits, r.islands, soft):
        return
    if not has_room(room, 0, r.n_real):
        return
    r.real = room.real
    o.budget = <int32_t>min(<double>STEPS * r.islands, limits.steps)
    o.e0, o.v0 = j.begin[0], j.begin[1]
    if j.cold:
        do_nothing(&j.p, j.lam, j.both)
    if j.made.n_empty and not settle_empty_rows(j, tol):
        return
    lav_start(&v, &o, &r, j.lam)
    code = step_within(j, &v, &o, &r, limits)
    if code != REACHED and not j.spent:
        return
    if not has_room(room, 0, 2 * <ssize_t>j.g.n + m):
        return
    judge_job(j, room.real)
    j.solved = j.relative <= tol


cdef int take(job_t* j, Data p, start, double* lam, double* both) except -1:
    """The problem of `p` from `start` (m,) [N s], or from doing nothing where it is None."""
    cdef const double[::1] given
    j.p, j.g = p.blocks, p.general
    j.known = p.ready
    j.made = p.made
    j.begin[0], j.begin[1], j.begin[2] = p.start_energy, p.start_velocity, p.start_relative
    j.lam, j.both = lam, both
    j.solved, j.spent, j.cold, j.most = False, False, start is None, INFINITY
    if not j.cold:
        given = start
        if given.shape[0] != j.p.n_rows:
            raise ValueError(f"{given.shape[0]} numbers for {j.p.n_rows} rows")
        memcpy(lam, &given[0], j.p.n_rows * sizeof(double))


cdef result(job_t* j, Data p, impulse, both):
    """(What the judge found, None where nobody asked him, counts as of `Newton.run`)."""
    found = judged_from(p, impulse, both, &j.score, j.relative, j.floor) if j.solved or j.spent else None
    return found, (j.counts[0], j.counts[1], j.counts[2], j.counts[3])


cdef void remember(job_t* j, Data p):
    if p.start_energy < 0.0 and j.begin[0] >= 0.0:
        p.set_start(j.begin[0], j.begin[1])
        p.start_relative = j.begin[2]


cdef class Limits:
    """Of the numbers of a `limits_t` (18,)."""
    cdef limits_t at

    def __init__(self, const double[::1] numbers):
        self.at = (<const limits_t*>&numbers[0])[0]

    def cost(self, Data p, double work, int islands):
        """What Newton's method is counted to cost [ns], `work` multiply-adds of a factor of each island; and may cost."""
        cdef bint soft = is_soft(&p.blocks, &p.general)
        return (cost_of(&p.blocks, &p.general, &self.at, work, soft),
                allowed(&p.blocks, &p.general, &self.at, islands, soft))


def solve_first(Data p, start, double tol, Limits limits, double most=INFINITY):
    """A problem of at least one row of which nothing was worked out: what is worked out of its data, solved, judged, at once.

    What the judge finds, None where it does not end below tol, an empty row cannot be met or it costs more than the limits
    (`limits_t`) let in, and the counts, zeros where nothing was done; most: counted cost [ns] where what was found by then
    is the result. d, Y and the error of doing nothing stay with the data.
    """
    cdef job_t j
    cdef room_t room = room_t(0, 0, NULL, NULL, 0, 0, 0, 0.0)
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef bint known = p.ready
    impulse, results = new(m), new(2 * m + 1)
    take(&j, p, start, doubles(impulse, m), doubles(results, 2 * m + 1))
    j.most = most
    with nogil:
        solve_job(&j, &room, &limits.at, tol)
        free(room.index)
        free(room.real)
    if not known and j.known:
        p.adopt(&j.made)
    elif not known:
        free(j.made.marks)
        free(j.made.numbers)
    remember(&j, p)
    return result(&j, p, impulse, results)


cdef enum:                      # what is known of a world when it is done, rows of `Worlds.numbers`
    RELATIVE = 0
    ENERGY = 1                  # sqrt J
    SPEED = 2                   # m/s
    FLOOR = 3
    START_ENERGY = 4            # of doing nothing
    START_SPEED = 5
    START_RELATIVE = 6
    RHS_ENERGY = 7              # of b, where the judge alone was asked
    PUSH = 8                    # N s, |e| of the worst row
    N_NUMBERS = 9


#: Columns of `at`, by their names.
PLACE = {"rows": ROWS, "velocities": VELOCITIES, "blocks": BLOCKS, "jac": JAC, "mass": MASS, "free": FREE, "target": TARGET,
         "soft": SOFT, "mu": MU, "block": BLOCK, "cone_row": CONE_ROW, "row": AT_ROW, "velocity": VELOCITY}


#: Rows of `Worlds.numbers` and codes of worlds by their names.
NUMBER = {"relative": RELATIVE, "energy": ENERGY, "speed": SPEED, "floor": FLOOR, "start_energy": START_ENERGY,
          "start_speed": START_SPEED, "start_relative": START_RELATIVE, "rhs_energy": RHS_ENERGY, "push": PUSH}
CODE = {"left": LEFT, "ready": READY, "bad": BAD, "tried": TRIED, "late": LATE}


cdef enum:                      # what `Hand` says in the place of a world's number
    DONE_ALL = -1
    LISTEN = -2                 # to the clock


def data_of(list problems, kind):
    """(Data of each problem in generalised coordinates, None of one that the loop leaves; rows of each (n,))."""
    cdef Py_ssize_t i, n = len(problems)
    cdef Data p
    cdef list data = [None] * n
    sizes = np.empty(n, np.int64)
    cdef int64_t[::1] rows = sizes
    for i in range(n):
        problem = problems[i]
        p = problem.derived.view
        if p is None:
            rows[i] = problem.m
            continue
        rows[i] = p.blocks.n_rows
        if type(problem) is kind and not (<Blocks>p.keep[0]).has_ellipse:
            data[i] = p
    return data, sizes


cdef class Worlds:
    """Problems in generalised coordinates, each made of a few arrays when its turn comes, or given; and what came of them.

    `numbers` (N_NUMBERS, n) are those of the judge, `worst` (n,) his worst row, `counts` (n, 4) as of `Newton.run`; `code`
    (n,) is LEFT, READY or BAD. `impulse` and `velocity` hold the worlds' one after the other, in the places that `at` says.

    Parameters
    ----------
    data : list of Data or None
        Of problems that are objects; None of one that is left to the caller. Starts come with it: (m,) [N s] or None.
    at : (n, PLACES) int64
        Of arrays, as in `world.pxd`; of objects its columns ROWS and AT_ROW alone.
    arrays : sequence of 6
        J, M, v*, target, compliance, mu (or None), flat float64 or float32.
    strides : (int, int)
        Numbers from one row to the next of J and of M, 0: as many as velocities.
    pattern : (indptr, indices) int32, or None
        Of M, where it holds lower triangles in compressed rows of one pattern.
    impulse, velocity : float64
        Of the results; of arrays the impulse holds the starts, unless `cold`.
    """

    cdef job_t* jobs            # of objects
    cdef worlds_t w
    cdef int64_t taken
    cdef bint cold
    cdef readonly object numbers, worst, counts, code, impulse, velocity
    cdef list keep
    cdef double* lam
    cdef double* v
    cdef double* number
    cdef int32_t* worst_at
    cdef int32_t* count
    cdef signed char* code_at

    def __init__(self, const int64_t[:, ::1] at, double[::1] impulse, double[::1] velocity, bint cold):
        cdef Py_ssize_t n = at.shape[0]
        self.impulse, self.velocity, self.cold = impulse.base, velocity.base, cold
        self.numbers, self.worst = np.zeros((N_NUMBERS, n + 1)), np.full(n + 1, -1, np.int32)
        self.counts, self.code = np.zeros((n + 1, 4), np.int32), np.zeros(n + 1, np.int8)
        cdef double[:, ::1] numbers = self.numbers
        cdef int32_t[::1] worst = self.worst
        cdef int32_t[:, ::1] counts = self.counts
        cdef signed char[::1] code = self.code
        self.keep = [at]
        self.w.n = n
        if n:
            self.w.at = &at[0, 0]
        self.lam = &impulse[0] if impulse.shape[0] else NULL
        self.v = &velocity[0] if velocity.shape[0] else NULL
        self.number, self.worst_at, self.count, self.code_at = &numbers[0, 0], &worst[0], &counts[0, 0], &code[0]

    def of_arrays(self, arrays, strides, pattern, Blocks blocks, int law, double asymmetry):
        """Of arrays, which have passed every check but that of their numbers."""
        cdef const double[::1] wide
        cdef const float[::1] narrow
        cdef const int32_t[::1] ptr, col
        cdef int32_t i
        self.w.mass_ptr = NULL
        if pattern is not None:
            ptr, col = pattern
            self.w.mass_ptr, self.w.mass_col = &ptr[0], &col[0]
        self.w.blocks, self.w.asymmetry = blocks.at, asymmetry
        self.w.blocks.law = law
        self.w.jac_row, self.w.mass_row = strides
        self.keep += [blocks, pattern, *arrays]
        for i in range(N_ARRAYS):
            self.w.array[i] = NULL
            self.w.narrow[i] = arrays[i] is not None and arrays[i].itemsize == sizeof(float)
            if arrays[i] is None or not len(arrays[i]):
                continue
            if self.w.narrow[i]:
                narrow = arrays[i]
                self.w.array[i] = &narrow[0]
            else:
                wide = arrays[i]
                self.w.array[i] = &wide[0]

    def of_objects(self, list data, list starts):
        """Of Data, None where one is left to the caller."""
        cdef int64_t i
        cdef Data p
        self.jobs = <job_t*>calloc(self.w.n + 1, sizeof(job_t))
        if self.jobs == NULL:
            raise MemoryError(f"{self.w.n} problems")
        self.keep.append(data)
        for i in range(self.w.n):
            p = data[i]
            if p is not None:
                take(&self.jobs[i], p, starts[i], self.lam + self.w.at[i * PLACES + AT_ROW], NULL)

    def remember(self, data):
        """Doing nothing stays with the data of what was solved."""
        cdef int64_t i
        for i in range(self.w.n):
            if self.code_at[i] == READY:
                remember(&self.jobs[i], data[i])

    cdef int32_t lay(self, int64_t i, desk_t* desk, room_t* both, const made_t* made, job_t* j) noexcept nogil:
        """World i for `solve_job` or for the judge."""
        cdef const int64_t* at = self.w.at + i * PLACES
        cdef int32_t code = READY
        if self.jobs != NULL:
            j[0] = self.jobs[i]
            if j.p.n_rows == 0:
                return LEFT
        else:
            code = lay_world(&self.w, i, desk, &j.p, &j.g)
            j.begin[0] = -1.0
            j.solved, j.spent, j.cold, j.known, j.lam = False, False, self.cold, False, self.lam + at[AT_ROW]
        if not j.known:
            j.made = made[0]
        j.most = INFINITY
        if not has_room(both, 0, 2 * at[ROWS] + 1):
            return LEFT
        j.both = both.real
        return code

    cdef void keep_result(self, int64_t i, const job_t* j, const desk_t* desk) noexcept nogil:
        """The judge's numbers, and v+ of arrays."""
        cdef const int64_t* at = self.w.at + i * PLACES
        cdef double* v
        cdef int64_t n = self.w.n + 1
        cdef int32_t k
        self.number[RELATIVE * n + i], self.number[FLOOR * n + i] = j.relative, j.floor
        self.number[ENERGY * n + i] = j.score.energy if j.score.finite else INFINITY
        self.number[SPEED * n + i] = j.score.velocity if j.score.finite else INFINITY
        for k in range(3):
            self.number[(START_ENERGY + k) * n + i] = j.begin[k]
        self.worst_at[i] = j.score.worst
        self.number[PUSH * n + i] = fabs(j.both[j.p.n_rows + j.score.worst]) if j.score.worst >= 0 else 0.0
        for k in range(4):
            self.count[4 * i + k] = j.counts[k]
        if self.jobs == NULL:
            v = self.v + at[VELOCITY]
            for k in range(j.g.n):
                v[k] = desk.free[k] + j.push[k]

    cdef int32_t empty(self, int64_t i, const desk_t* desk) noexcept nogil:
        """A world without rows, which nothing moves."""
        memcpy(self.v + self.w.at[i * PLACES + VELOCITY], desk.free,
               self.w.at[i * PLACES + VELOCITIES] * sizeof(double))
        return READY

    cdef int32_t solve(self, int64_t i, desk_t* desk, room_t* room, room_t* both, made_t* made, const limits_t* limits,
                       double tol, double most) noexcept nogil:
        cdef job_t j
        cdef int32_t code = self.lay(i, desk, both, made, &j)
        cdef bint known = j.known
        if code != READY:
            return code
        if j.p.n_rows == 0:
            return self.empty(i, desk)
        j.most = most
        solve_job(&j, room, limits, tol)
        if j.solved:
            self.keep_result(i, &j, desk)
        else:
            memcpy(&self.count[4 * i], j.counts, sizeof(j.counts))
        if not known:
            made[0] = j.made                            # whose room the next one has
        if self.jobs != NULL:
            self.jobs[i].begin[0], self.jobs[i].begin[1], self.jobs[i].begin[2] = j.begin[0], j.begin[1], j.begin[2]
        return READY if j.solved else TRIED

    cdef int32_t judge(self, int64_t i, desk_t* desk, room_t* room, room_t* both, made_t* made, bint narrow) noexcept nogil:
        """The judge alone, beside the floor of float32 where `narrow`; empty rows are left to the caller."""
        cdef job_t j
        cdef int32_t k, code = self.lay(i, desk, both, made, &j), m = j.p.n_rows
        cdef bint known = j.known
        cdef double size
        cdef double* x
        if code != READY:
            return code
        if m == 0:
            return self.empty(i, desk)
        code = LEFT
        if has_numbers(&j) and j.made.n_empty == 0 and has_room(room, 0, 4 * <int64_t>m + 5 * j.g.n):
            code, x = READY, room.real
            if j.cold:
                do_nothing(&j.p, j.lam, j.both)
            begin(&j, x)
            judge_job(&j, x)
            for k in range(4):
                j.counts[k] = 0
            if narrow:
                x += j.g.n                              # behind what is pushed
                squares32(&j.p, &j.g, &desk.mass, desk.free, j.lam, x, x + m, x + 2 * m, x + 3 * m)
                for k in range(m):
                    x[k] = x[k] + x[m + k] + x[2 * m + k]
                j.floor = relative_size(&j.p, x, j.begin[0], j.begin[1])
            self.keep_result(i, &j, desk)
            norms_of_rhs(&j.p, &self.number[RHS_ENERGY * (self.w.n + 1) + i], &size)
        if not known:
            made[0] = j.made
        return code

    def __dealloc__(self):
        free(self.jobs)


cdef class Hand:
    """One thread at work on `Worlds`: it takes the next one as long as there is one, by an atomic counter.

    stop : (1,) bytes
        What is not begun when it becomes nonzero never is: Ctrl-C comes to another thread than this.
    """

    cdef Worlds worlds
    cdef room_t room
    cdef room_t both
    cdef made_t made
    cdef desk_t desk
    cdef const unsigned char[::1] stop

    def __init__(self, Worlds worlds, const unsigned char[::1] stop):
        self.worlds, self.stop, self.desk.n_tree = worlds, stop, -1

    def __dealloc__(self):
        free(self.room.index)
        free(self.room.real)
        free(self.both.index)
        free(self.both.real)
        free(self.made.marks)
        free(self.made.numbers)
        free(self.desk.room.index)
        free(self.desk.room.real)
        free(self.desk.tree.index)
        free(self.desk.tree.real)

    def solve(self, double tol, Limits limits, double most=INFINITY):
        """Solve worlds until one is left to the caller, which is returned; DONE_ALL where there are no more.

        Without limits every world is left. most : counted cost [ns] of a world at which it is; LISTEN is then returned after
        each.
        """
        return self.run(tol, limits, most, 0, False)

    def judge(self, bint narrow, bint late=False):
        """Judge the impulses of worlds until one is left to the caller; narrow: beside the floor of float32.

        late: as what they keep where there was no time to solve.
        """
        return self.run(0.0, None, INFINITY, LATE if late else READY, narrow)

    cdef int64_t run(self, double tol, Limits limits, double most, int32_t judges, bint narrow) except? -3:
        cdef Worlds w = self.worlds
        cdef const limits_t* at = &limits.at if limits is not None else NULL
        cdef int64_t i, n = w.w.n
        cdef int32_t code, done = 0
        with nogil:
            while not self.stop[0]:
                i = lav_add(&w.taken, 1)
                if i >= n:
                    return DONE_ALL
                if judges:
                    code = w.judge(i, &self.desk, &self.room, &self.both, &self.made, narrow)
                    if code == READY:
                        code = judges
                elif at == NULL:
                    code = LEFT
                else:
                    code = w.solve(i, &self.desk, &self.room, &self.both, &self.made, at, tol, most)
                w.code_at[i] = <signed char>code
                if code == LEFT or code == TRIED:
                    return i
                if most < INFINITY:
                    return LISTEN
                done += 1
                if done % AT_A_TIME == 0:
                    with gil:
                        PyErr_CheckSignals()
        return DONE_ALL
