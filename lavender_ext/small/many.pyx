"""Problems by J and M, by A or by bodies, one or many, without the interpreter: lay out, prepare, solve, judge.

The same kernels in the same order as on one problem alone, so the same bits and counts. What
does not end below tol on the judge's own measure, has an empty row that b asks for or is counted to cost more than is
asked for, is left to the caller.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport doubles, ints, ndarray
from lavender_ext.core.assemble cimport lav_assemble, lav_body_blocks, lav_expand_rows
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.door cimport first_outside
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.method cimport MORE, REACHED, ROOM, options_t, room_t, said_t
from lavender_ext.core.parts cimport CONE, blocks_t, is_rows
from lavender_ext.core.csr cimport csr_t
from lavender_ext.core.problem cimport MADE, Data, lav_rows_diagonal, made_t, make_numbers, matrix_numbers
from lavender_ext.core.problem import LAWS
from lavender_ext.core.rows cimport rows_t
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport NEWTON, lav_room, lav_start, lav_step
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.generalized.newton cimport is_soft
from lavender_ext.small.call cimport (COUNTS, ENDED, KEPT, Rules, are_bounded, few_rules_t, few_t, has_call, judge_few,
                                      lay_few, rooms_t, run_few)
from lavender_ext.small.limits cimport allowed, cost_of, limits_t, step_cost
from lavender_ext.small.room cimport has_room, leave
from lavender_ext.small.world cimport (BAD, BESIDE, BLOCK, BLOCKS, CONE_ROW, FREE, JAC, LATE, LEFT, MASS, MU, N_ARRAYS, PLACES,
                                       READY, AT_ROW, FIELDS, ROWS, SOFT, STARTED, TARGET, TRIED, VELOCITIES, VELOCITY, desk_t,
                                       lay_bodies, lay_matrix, lay_world, rows_of, worlds_t)
from lavender_ext.judge.measure cimport (do_nothing, general_floor, general_slack, judge_nothing, judged_from, relative_of,
                                         scratch_of)
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
    bint general                # by J and M,
    bint factored               # by bodies; else by A
    generalized_t g
    csr_t a
    rows_t r
    const double* dense         # A (m, m), of which `a` is to be made
    int64_t row                 # numbers from one row of it to the next
    made_t made                 # of the data, or of this call
    bint known                  # it is this problem's
    double begin[3]             # E0, V0, relative residual of doing nothing; E0 < 0 where not known
    int32_t cold                # 1: from doing nothing, else from lam as it is
    double most                 # ns that it may cost as counted, then what it has come to is the result; inf: to the end
    bint solved
    bint spent                  # what it might cost is
    int32_t counts[COUNTS]      # steps, factorisations, rounds, evaluations; or as of `run_few`
    double* lam                 # (m)
    double* both                # (2 m + 1) w, e
    const double* push          # (n) M^-1 J^T lam of the judge, not of A; in room that the next world takes
    score_t score
    double relative, floor


cdef struct few_rooms_t:        # of one thread
    room_t made                 # A, d, nu and step
    room_t formed               # of `form_matrix`
    room_t kept                 # of `lay_few`
    rooms_t call


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


cdef inline bint make_matrix(job_t* j, room_t* room) noexcept nogil:
    """A in compressed rows, d, nu and step in `room`."""
    cdef int64_t m = j.p.n_rows, entries = m * m + BESIDE if j.dense != NULL else 0
    cdef double* x
    cdef int32_t* empty
    if not has_room(room, 2 * (m + 1) + entries, 3 * (m + 1) + entries):
        return False
    x, empty = room.real, room.index
    if j.dense != NULL:
        j.a.indptr, j.a.indices, j.a.data = empty + m + 1, empty + 2 * (m + 1), x + 3 * (m + 1)
        rows_of(j.dense, j.row, j.p.n_rows, j.p.n_rows, <int32_t*>j.a.indptr, <int32_t*>j.a.indices, <double*>j.a.data)
    j.p.d, j.p.nu, j.p.step = x, x + m + 1, x + 2 * (m + 1)
    j.made.n_empty = matrix_numbers(&j.p, &j.a, x, x + m + 1, x + 2 * (m + 1), empty)
    return True


cdef inline bint make_bodies(job_t* j, room_t* room) noexcept nogil:
    """d, nu, step, M^-1 J^T of joints, coupling and swing of contacts in `room`; within the door?"""
    cdef int64_t m = j.p.n_rows, joints = j.p.ptr[j.r.n_joints], c = j.r.n_contacts
    cdef int64_t n = 3 * (m + 1) + 12 * joints + 5 * c + 6 * (m - joints)
    cdef double* x
    cdef double* of_joints
    if not has_room(room, m + 1, n):
        return False
    x, of_joints = room.real, room.real + 3 * (m + 1)
    memset(x, 0, n * sizeof(double))
    j.p.d, j.p.nu, j.p.step = x, x + m + 1, x + 2 * (m + 1)
    j.r.minv_jac, j.r.coupling, j.r.swing = of_joints, of_joints + 12 * joints, of_joints + 12 * joints + 5 * c
    j.made.n_empty = lav_rows_diagonal(&j.p, &j.r, x, x + m + 1, x + 2 * (m + 1), room.index, of_joints, of_joints + 12 * joints,
                                       of_joints + 12 * joints + 5 * c)
    return first_outside(j.p.d, m) < 0


cdef inline bint form_matrix(job_t* j, few_t* s, room_t* room) noexcept nogil:
    """A of bodies in `room`, to be solved in their stead: d of its own, and nu of theirs."""
    cdef int64_t m = j.p.n_rows, k = j.p.n_blocks, most
    cdef int32_t* start
    cdef int32_t* blocks
    cdef int32_t* near
    cdef int32_t* ptr
    cdef double* x
    if not has_room(room, j.r.n_bodies + 6 * k + 3 * m + m * m + 7, 3 * (m + 1) + 24 * m + m * m + 1):
        return False
    start, x = room.index, room.real
    blocks = start + j.r.n_bodies + 1
    near = blocks + 2 * k + 1
    ptr = near + 4 * k + 2 + m
    lav_body_blocks(&j.p, &j.r, start, blocks, &most)
    j.a.indptr, j.a.indices, j.a.data = ptr, ptr + 2 * (m + 1), x + 3 * (m + 1) + 24 * m
    lav_expand_rows(&j.p, &j.r, x + 3 * (m + 1), x + 3 * (m + 1) + 12 * m)
    lav_assemble(&j.p, &j.r, x + 3 * (m + 1), x + 3 * (m + 1) + 12 * m, start, blocks, near, near + 2 * k + 1, near + 4 * k + 2,
                 ptr, <int32_t*>j.a.indices, <double*>j.a.data)
    s.over = view_t(j.p, &j.a, NULL, NULL)
    s.over.p.d, s.over.p.nu, s.over.p.step = x, j.p.nu, x + 2 * (m + 1)
    matrix_numbers(&s.over.p, &j.a, x, x + m + 1, x + 2 * (m + 1), ptr + m + 1)
    return True


cdef inline view_t view_of(job_t* j) noexcept nogil:
    """As the judge reads it."""
    cdef view_t v = view_t(j.p, NULL, NULL, NULL)
    if j.general:
        v.g = &j.g
    elif j.factored:
        v.r = &j.r
    else:
        v.a = &j.a
    return v


cdef inline bint prepare_few(job_t* j, few_t* s, few_rooms_t* rooms) noexcept nogil:
    """What is worked out of A or bodies before a solve or the judge; False where it is left to the caller, as are empty rows."""
    cdef int64_t m = j.p.n_rows
    cdef double* x
    if not j.known:
        j.known = make_bodies(j, &rooms.made) if j.factored else make_matrix(j, &rooms.made)
    if not j.known or j.made.n_empty:
        return False
    s.v = s.over = view_of(j)
    if j.begin[0] < 0.0:
        if not has_room(&rooms.call.work, 0, 3 * m + scratch_of(&s.v)):
            return False
        x = rooms.call.work.real
        judge_nothing(&s.v, x, x + m, x + 2 * m, x + 3 * m, j.begin)
    s.begin[0], s.begin[1], s.begin[2] = j.begin[0], j.begin[1], j.begin[2]
    return j.begin[2] >= 0.0


cdef inline void found_by(job_t* j, const few_t* s) noexcept nogil:
    j.score, j.relative, j.floor = s.score, s.relative, s.floor


cdef inline int32_t solve_few(job_t* j, few_rooms_t* rooms, const few_rules_t* rules, double tol) noexcept nogil:
    """A or bodies by the call of few rows; LEFT, TRIED, STARTED or READY."""
    cdef few_t s
    cdef int32_t code
    cdef bint pivots = are_bounded(&j.p)
    if j.p.n_rows > rules.rows or not has_call(&j.p) or not (rules.pivots if pivots else rules.follows):
        return LEFT
    if not prepare_few(j, &s, rooms) or (pivots and j.factored and not form_matrix(j, &s, &rooms.formed)):
        return LEFT
    if not lay_few(&s, &rooms.kept):
        return LEFT
    code = run_few(&s, rules, j.lam, j.cold, tol, j.most, j.both, &rooms.call, j.counts)
    found_by(j, &s)
    j.push = rooms.call.work.real + (j.p.n_rows if code == KEPT else 0)
    if code != KEPT and code != ENDED:
        return TRIED
    return LEFT if not s.relative <= tol else STARTED if code == KEPT else READY


cdef int take_given(job_t* j, problem) except -1:
    """The problem of A or of bodies of which nothing was worked out."""
    cdef Blocks blocks = problem.cones._blocks
    cdef Py_ssize_t m = blocks.at.n_rows, n, c, joints
    rows, matrix = problem.rows, problem.matrix
    j.p, j.known, j.begin[0], j.factored = blocks.at, False, -1.0, rows is not None
    j.p.law, j.p.b = LAWS[problem.friction], doubles(problem.b, m)
    if j.factored:
        n, c, joints = len(rows.inv_mass), len(rows.normal), len(rows.joint_body)
        j.r.n_bodies, j.r.n_joints, j.r.n_contacts = <int32_t>n, <int32_t>joints, <int32_t>c
        j.r.jac, j.r.joint_body = doubles(rows.jac, 12 * j.p.ptr[joints]), ints(rows.joint_body, 2 * joints)
        j.r.normal, j.r.tangent = doubles(rows.normal, 3 * c), doubles(rows.tangent, 3 * c)
        j.r.arm_a, j.r.arm_b = doubles(rows.arm_a, 3 * c), doubles(rows.arm_b, 3 * c)
        j.r.contact_body, j.r.compliance = ints(rows.contact_body, 2 * c), doubles(problem.compliance, m)
        j.r.inv_mass, j.r.inv_inertia = doubles(rows.inv_mass, n), doubles(rows.inv_inertia, 9 * n)
    elif isinstance(matrix, ndarray):
        j.dense, j.row = doubles(matrix, m * m), m
    else:
        indptr, indices, data = problem._compressed
        j.a.indptr, j.a.indices, j.a.data = ints(indptr, m + 1), ints(indices, len(indices)), doubles(data, len(data))
    return 0


cdef int take(job_t* j, Data p, start, double* lam, double* both) except -1:
    """The problem of `p` from `start` (m,) [N s], or from doing nothing where it is None."""
    j.p, j.g, j.a, j.r, j.general, j.factored = p.blocks, p.general, p.csr, p.rows, p.is_general, p.factored
    j.known = p.ready
    j.made = p.made
    if not p.is_general:
        j.made.n_empty = <int32_t>len(p.empty)
    j.begin[0], j.begin[1], j.begin[2] = p.start_energy, p.start_velocity, p.start_relative
    return take_start(j, start, lam, both)


cdef int take_start(job_t* j, start, double* lam, double* both) except -1:
    cdef const double[::1] given
    j.lam, j.both = lam, both
    j.solved, j.spent, j.cold, j.most = False, False, start is None, INFINITY
    if not j.cold:
        given = start
        if given.shape[0] != j.p.n_rows:
            raise ValueError(f"{given.shape[0]} numbers for {j.p.n_rows} rows")
        if j.p.n_rows:
            memcpy(lam, &given[0], j.p.n_rows * sizeof(double))
    return 0


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
        leave(&room)
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
CODE = {"left": LEFT, "ready": READY, "bad": BAD, "tried": TRIED, "late": LATE, "started": STARTED}


cdef enum:                      # what `Hand` says in the place of a world's number
    DONE_ALL = -1
    LISTEN = -2                 # to the clock


def data_of(list problems, kind):
    """(Of each problem its Data, True where nothing was worked out, None of one that the loop leaves; rows of each (n,))."""
    cdef Py_ssize_t i, n = len(problems)
    cdef list data = [None] * n
    sizes = np.empty(n, np.int64)
    cdef int64_t[::1] rows = sizes
    for i in range(n):
        problem = problems[i]
        p = problem.derived.view
        rows[i] = problem.m if p is None else (<Data>p).blocks.n_rows
        if type(problem) is not kind or (<Blocks>problem.cones._blocks).has_ellipse:
            continue
        if p is None:
            p = problem.__dict__.get("data", True)
        data[i] = p
    return data, sizes


cdef struct hand_t:             # rooms of one thread
    room_t room
    room_t both
    made_t made
    desk_t desk
    few_rooms_t few


cdef class Worlds:
    """Problems, each made of a few arrays when its turn comes, or given; and what came of them.

    `numbers` (N_NUMBERS, n) are those of the judge, `worst` (n,) his worst row, `counts` (n, COUNTS) as of `job_t`; `code`
    (n,) is LEFT, READY or BAD. `impulse` and `velocity` hold the worlds' one after the other, in the places that `at` says.

    Parameters
    ----------
    problems, data : list
        Of problems that are objects, and `data_of` them. Starts come with it: (m,) [N s] or None.
    at : (n, PLACES) int64
        Of arrays, as in `world.pxd`; of objects its columns ROWS and AT_ROW alone.
    arrays : sequence of 6
        J, M, v*, target, compliance, mu (or None), flat float64 or float32; or A, None, None, b, None, mu.
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
        self.counts, self.code = np.zeros((n + 1, COUNTS), np.int32), np.zeros(n + 1, np.int8)
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
        self.w.blocks, self.w.asymmetry, self.w.general = blocks.at, asymmetry, arrays[1] is not None
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

    def of_bodies(self, fields, pairs, int bodies, int joints, int contacts, Blocks blocks, int law):
        """Of bodies: (array, numbers from one world to the next) of each field of `bodies_t`, and of the pairs."""
        cdef int32_t i
        self.w.blocks, self.w.general, self.w.factored = blocks.at, False, True
        self.w.blocks.law = law
        self.keep += [blocks, fields, pairs]
        for i in range(FIELDS):
            array, self.w.bodies.step[i] = fields[i]
            self.w.bodies.field[i] = doubles(array, array.size)
        for i in range(2):
            array, self.w.bodies.pair_step[i] = pairs[i]
            self.w.bodies.pair[i] = ints(array, array.size)
        self.w.bodies.n, self.w.bodies.joints, self.w.bodies.contacts = bodies, joints, contacts

    def of_objects(self, list problems, list data, list starts):
        """Of problems by their `data_of`, None where one is left to the caller."""
        cdef int64_t i
        cdef job_t* j
        self.jobs = <job_t*>calloc(self.w.n + 1, sizeof(job_t))
        if self.jobs == NULL:
            raise MemoryError(f"{self.w.n} problems")
        self.keep += [problems, data]
        for i in range(self.w.n):
            p, j = data[i], &self.jobs[i]
            if p is True:
                take_given(j, problems[i])
                take_start(j, starts[i], self.lam + self.w.at[i * PLACES + AT_ROW], NULL)
            elif p is not None:
                take(j, p, starts[i], self.lam + self.w.at[i * PLACES + AT_ROW], NULL)

    def remember(self, data):
        """Doing nothing stays with the data of what was solved."""
        cdef int64_t i
        for i in range(self.w.n):
            if self.code_at[i] == READY and data[i] is not True:
                remember(&self.jobs[i], data[i])

    cdef bint is_general(self, int64_t i) noexcept nogil:
        return self.jobs[i].general if self.jobs != NULL else self.w.general

    cdef int32_t lay(self, int64_t i, desk_t* desk, room_t* both, const made_t* made, job_t* j) noexcept nogil:
        """World i for a solve or for the judge."""
        cdef const int64_t* at = self.w.at + i * PLACES
        cdef int32_t code = READY
        if self.jobs != NULL:
            j[0] = self.jobs[i]
            if j.p.n_rows == 0:
                return LEFT
        else:
            j.general, j.factored = self.w.general, self.w.factored
            if j.general:
                code = lay_world(&self.w, i, desk, &j.p, &j.g)
            elif j.factored:
                code = lay_bodies(&self.w, i, desk, &j.p, &j.r)
            else:
                code = lay_matrix(&self.w, i, desk, &j.p, &j.dense, &j.row)
            j.begin[0] = -1.0
            j.solved, j.spent, j.cold, j.known, j.lam = False, False, self.cold, False, self.lam + at[AT_ROW]
        if not j.known and j.general:
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
        if self.jobs == NULL:
            v = self.v + at[VELOCITY]
            for k in range(at[VELOCITIES]):
                v[k] = desk.free[k] + j.push[k]

    cdef int32_t empty(self, int64_t i, const desk_t* desk) noexcept nogil:
        """A world without rows, which nothing moves."""
        memcpy(self.v + self.w.at[i * PLACES + VELOCITY], desk.free,
               self.w.at[i * PLACES + VELOCITIES] * sizeof(double))
        return READY

    cdef int32_t solve(self, int64_t i, hand_t* h, const limits_t* limits, const few_rules_t* rules, double tol,
                       double most) noexcept nogil:
        cdef job_t j
        cdef int32_t code = LEFT
        cdef bint known
        if limits == NULL if self.is_general(i) else rules == NULL:
            return LEFT
        code = self.lay(i, &h.desk, &h.both, &h.made, &j)
        if code != READY:
            return code
        if j.p.n_rows == 0:
            return self.empty(i, &h.desk)
        known, j.most = j.known, most
        if j.general:
            solve_job(&j, &h.room, limits, tol)
            if not known:
                h.made = j.made                         # whose room the next one has
            code = READY if j.solved else TRIED
        else:
            code = solve_few(&j, &h.few, rules, tol)
        if code == READY or code == STARTED:
            self.keep_result(i, &j, &h.desk)
        if code != LEFT:
            memcpy(&self.count[COUNTS * i], j.counts, sizeof(j.counts))
        if self.jobs != NULL:
            self.jobs[i].begin[0], self.jobs[i].begin[1], self.jobs[i].begin[2] = j.begin[0], j.begin[1], j.begin[2]
        return code

    cdef int32_t judge(self, int64_t i, hand_t* h, bint narrow, bint late) noexcept nogil:
        """The judge alone, beside the floor of float32 where `narrow`; empty rows are left to the caller.

        late: so are problems of A and of bodies, whose numbers wait until they are read.
        """
        cdef job_t j
        cdef few_t s
        cdef int32_t k, code = self.lay(i, &h.desk, &h.both, &h.made, &j), m = j.p.n_rows
        cdef bint known = j.known
        cdef double size
        cdef double* x
        if code != READY:
            return code
        if m == 0:
            return self.empty(i, &h.desk)
        code = LEFT
        if not j.general:
            if narrow or (late and self.jobs != NULL) or not prepare_few(&j, &s, &h.few):
                return LEFT
            if not has_room(&h.few.call.work, 0, scratch_of(&s.v)):
                return LEFT
            if j.cold:
                do_nothing(&j.p, j.lam, j.both)
            code = READY
            judge_few(&s, j.lam, j.both, h.few.call.work.real)
            found_by(&j, &s)
            j.push = h.few.call.work.real
        elif has_numbers(&j) and j.made.n_empty == 0 and has_room(&h.room, 0, 4 * <int64_t>m + 5 * j.g.n):
            code, x = READY, h.room.real
            if j.cold:
                do_nothing(&j.p, j.lam, j.both)
            begin(&j, x)
            judge_job(&j, x)
            if narrow:
                x += j.g.n                              # behind what is pushed
                squares32(&j.p, &j.g, &h.desk.mass, h.desk.free, j.lam, x, x + m, x + 2 * m, x + 3 * m)
                for k in range(m):
                    x[k] = x[k] + x[m + k] + x[2 * m + k]
                j.floor = relative_size(&j.p, x, j.begin[0], j.begin[1])
        if code == READY:
            self.keep_result(i, &j, &h.desk)
            norms_of_rhs(&j.p, &self.number[RHS_ENERGY * (self.w.n + 1) + i], &size)
        if j.general and not known:
            h.made = j.made
        return code

    def __dealloc__(self):
        free(self.jobs)


cdef class Hand:
    """One thread at work on `Worlds`: it takes the next one as long as there is one, by an atomic counter.

    stop : (1,) bytes
        What is not begun when it becomes nonzero never is: Ctrl-C comes to another thread than this.
    """

    cdef Worlds worlds
    cdef hand_t h
    cdef const unsigned char[::1] stop

    def __init__(self, Worlds worlds, const unsigned char[::1] stop):
        self.worlds, self.stop, self.h.desk.n_tree = worlds, stop, -1

    def __dealloc__(self):
        leave(&self.h.room)
        leave(&self.h.both)
        leave(&self.h.desk.room)
        leave(&self.h.desk.tree)
        leave(&self.h.few.made)
        leave(&self.h.few.formed)
        leave(&self.h.few.kept)
        leave(&self.h.few.call.work)
        leave(&self.h.few.call.more)
        free(self.h.made.marks)
        free(self.h.made.numbers)

    def solve(self, double tol, Limits limits, Rules rules, double most=INFINITY):
        """Solve worlds until one is left to the caller, which is returned; DONE_ALL where there are no more.

        Without limits every world of J and M is left, without rules every other. most : counted cost [ns] of a world at which it
        is; LISTEN is then returned after each.
        """
        return self.run(tol, limits, rules, most, 0, False)

    def judge(self, bint narrow, bint late=False):
        """Judge the impulses of worlds until one is left to the caller; narrow: beside the floor of float32.

        late: as what they keep where there was no time to solve.
        """
        return self.run(0.0, None, None, INFINITY, LATE if late else READY, narrow)

    cdef int64_t run(self, double tol, Limits limits, Rules rules, double most, int32_t judges, bint narrow) except? -3:
        cdef Worlds w = self.worlds
        cdef const limits_t* at = &limits.at if limits is not None else NULL
        cdef const few_rules_t* few = &rules.at if rules is not None else NULL
        cdef int64_t i, n = w.w.n
        cdef int32_t code, done = 0
        with nogil:
            while not self.stop[0]:
                i = lav_add(&w.taken, 1)
                if i >= n:
                    return DONE_ALL
                if judges:
                    code = w.judge(i, &self.h, narrow, judges == LATE)
                    if code == READY:
                        code = judges
                else:
                    code = w.solve(i, &self.h, at, few, tol, most)
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
