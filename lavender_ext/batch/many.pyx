"""Problems by J and M, by A or by bodies, one or many, for Python: laid out, solved and judged as `job.pxd` has it.

`Worlds` are problems and what came of them; each `Hand` is a thread that takes the next one without the interpreter. What a job
leaves, its caller solves the long way.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, fabs
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.arrays cimport doubles, ints, ndarray
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.problem cimport Data, made_t
from lavender_ext.core.problem import LAWS
from lavender_ext.core.view cimport view_t
from lavender_ext.small.call cimport COUNTS, Rules, few_rules_t, few_t, judge_few
from lavender_ext.batch.job cimport (few_rooms_t, begin, found_by, has_numbers, job_t, judge_job, judging_size, prepare_few,
                                     solve_few, solve_job)
from lavender_ext.small.limits cimport allowed, cost_of, limits_t
from lavender_ext.small.workspace cimport has_workspace_size, leave
from lavender_ext.batch.world cimport (BAD, BLOCK, BLOCKS, CONE_ROW, FREE, JAC, LATE, LEFT, MASS, MU, N_ARRAYS, PLACES,
                                       READY, AT_ROW, FIELDS, ROWS, SOFT, STARTED, TARGET, TRIED, VELOCITIES, VELOCITY,
                                       desk_t, lay_bodies, lay_matrix, lay_world, worlds_t)
from lavender_ext.judge.measure cimport set_zero_impulse, judged_from, scratch_of
from lavender_ext.judge.rounding cimport floor_in_float32, squares32
from lavender_ext.judge.tally cimport norms_of_rhs
from lavender_ext.velocity_newton.soft cimport is_soft

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
    AT_A_TIME = 256             # problems between two checks for Ctrl-C


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
    j.begin[0], j.begin[1], j.begin[2] = p.reference_energy, p.reference_velocity, p.relative_at_zero
    return take_start(j, start, lam, both)


cdef int take_start(job_t* j, start, double* lam, double* both) except -1:
    cdef const double[::1] given
    j.lam, j.both = lam, both
    j.solved, j.spent, j.cold, j.most, j.by_island = False, False, start is None, INFINITY, NULL
    if not j.cold:
        given = start
        if given.shape[0] != j.p.n_rows:
            raise ValueError(f"{given.shape[0]} numbers for {j.p.n_rows} rows")
        if j.p.n_rows:
            memcpy(lam, &given[0], j.p.n_rows * sizeof(double))
    return 0


cdef result(job_t* j, Data p, impulse, both):
    """(What the judge found, None where nobody asked him, counts as of `Newton.run`)."""
    found = None
    if j.solved or j.spent:
        found = judged_from(p, impulse, both, &j.score, j.relative, j.floor, j.float64_relative)
    return found, (j.counts[0], j.counts[1], j.counts[2], j.counts[3])


cdef void remember(job_t* j, Data p):
    if p.reference_energy < 0.0 and j.begin[0] >= 0.0:
        p.keep_reference(j.p.islands, j.begin)


cdef class Limits:
    """Of the numbers of a `limits_t` (16,)."""
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
    cdef workspace_t workspace = workspace_t(0, 0, NULL, NULL, 0, 0, 0, 0.0), islands = workspace
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef bint known = p.ready
    impulse, results = new(m), new(2 * m + 1)
    take(&j, p, start, doubles(impulse, m), doubles(results, 2 * m + 1))
    j.most = most
    with nogil:
        solve_job(&j, &workspace, &islands, &limits.at, tol)
        leave(&workspace)
    if not known and j.known:
        p.adopt(&j.made)
    elif not known:
        free(j.made.marks)
        free(j.made.numbers)
    remember(&j, p)
    leave(&islands)
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
    ABOVE_FLOOR = 9             # relative residual that rounding does not explain
    N_NUMBERS = 10


#: Columns of `at`, by their names.
PLACE = {"rows": ROWS, "velocities": VELOCITIES, "blocks": BLOCKS, "jac": JAC, "mass": MASS, "free": FREE, "target": TARGET,
         "soft": SOFT, "mu": MU, "block": BLOCK, "cone_row": CONE_ROW, "row": AT_ROW, "velocity": VELOCITY}


#: Rows of `Worlds.numbers` and codes of worlds by their names.
NUMBER = {"relative": RELATIVE, "energy": ENERGY, "speed": SPEED, "roundoff_floor": FLOOR, "reference_energy": START_ENERGY,
          "reference_speed": START_SPEED, "relative_at_zero": START_RELATIVE, "rhs_energy": RHS_ENERGY, "push": PUSH,
          "above_floor": ABOVE_FLOOR}
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
            if problem.has_singular_program:
                continue
            p = problem.__dict__.get("data", True)
        data[i] = p
    return data, sizes


cdef struct hand_t:             # rooms of one thread
    workspace_t workspace
    workspace_t both
    made_t made
    desk_t desk
    few_rooms_t few
    workspace_t by_island


cdef inline bint begin_world(job_t* j, hand_t* h) noexcept nogil:
    """`begin` of a world by J and M."""
    cdef view_t v = view_t(j.p, NULL, NULL, &j.g)
    return begin(j, &v, &h.few.islands, h.workspace.real)


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

    cdef int32_t lay(self, int64_t i, desk_t* desk, workspace_t* both, const made_t* made, job_t* j) noexcept nogil:
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
            j.by_island = NULL
            j.solved, j.spent, j.cold, j.known, j.lam = False, False, self.cold, False, self.lam + at[AT_ROW]
        if not j.known and j.general:
            j.made = made[0]
        j.most = INFINITY
        if not has_workspace_size(both, 0, 2 * at[ROWS] + 1):
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
        self.number[ABOVE_FLOOR * n + i] = j.above_floor
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
            solve_job(&j, &h.workspace, &h.few.islands, limits, tol)
            if not known:
                h.made = j.made                         # whose workspace the next one has
            code = READY if j.solved else TRIED
        else:
            code = solve_few(&j, &h.few, rules, tol)
        if code == READY or code == STARTED:
            self.keep_result(i, &j, &h.desk)
        if code != LEFT:
            memcpy(&self.count[COUNTS * i], j.counts, sizeof(j.counts))
        if self.jobs != NULL and j.p.islands == NULL:   # islands are in memory that the next world uses
            self.jobs[i].begin[0], self.jobs[i].begin[1], self.jobs[i].begin[2] = j.begin[0], j.begin[1], j.begin[2]
        return code

    cdef int32_t judge(self, int64_t i, hand_t* h, double tol, bint narrow, bint late) noexcept nogil:
        """The judge alone, refined for `tol`, beside the floor of float32 where `narrow`; empty rows are left to the caller.

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
            if not has_workspace_size(&h.few.call.work, 0, scratch_of(&s.v)):
                return LEFT
            if j.cold:
                set_zero_impulse(&j.p, j.lam, j.both)
            code = READY
            judge_few(&s, j.lam, j.both, h.few.call.work.real)
            found_by(&j, &s)
            j.push = h.few.call.work.real
        elif (has_numbers(&j) and j.made.n_empty == 0
              and has_workspace_size(&h.workspace, 0, max(judging_size(&j), 4 * <int64_t>m + 5 * j.g.n))
              and has_workspace_size(&h.by_island, 0, 2 * <int64_t>j.p.n_blocks) and begin_world(&j, h)):
            code, x = READY, h.workspace.real
            if j.cold:
                set_zero_impulse(&j.p, j.lam, j.both)
            j.by_island = h.by_island.real
            judge_job(&j, tol, x)
            if narrow:
                x += j.g.n                              # behind what is pushed
                squares32(&j.p, &j.g, &h.desk.mass, h.desk.free, j.lam, x, x + m, x + 2 * m, x + 3 * m)
                for k in range(m):
                    x[k] = x[k] + x[m + k] + x[2 * m + k]
                j.floor = floor_in_float32(&j.p, x, &j.score, j.relative, j.begin[0], j.begin[1], &j.above_floor)
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
        leave(&self.h.workspace)
        leave(&self.h.both)
        leave(&self.h.desk.workspace)
        leave(&self.h.desk.tree)
        leave(&self.h.by_island)
        leave(&self.h.few.islands)
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

    def judge(self, double tol, bint narrow, bint late=False):
        """Judge the impulses of worlds until one is left to the caller; narrow: beside the floor of float32.

        late: as what they keep where there was no time to solve.
        """
        return self.run(tol, None, None, INFINITY, LATE if late else READY, narrow)

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
                    code = w.judge(i, &self.h, tol, narrow, judges == LATE)
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
