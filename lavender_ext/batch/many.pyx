"""Python interface to batches: problems by J and M, by A or by bodies, converted, solved and judged by `task.pxd`.

A world is one problem of a batch. `Worlds` holds the worlds and their results. Each `Worker` belongs to one thread and takes
the next world, without the interpreter. A worker leaves some worlds to the caller, for the general solvers:
these are called deferred.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, fabs
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy, memset

cimport cython

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer, make_read_only, ndarray
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.deadline cimport deadline_t, get_pointer, has_passed, reading_interval
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.problem cimport Data, bind_body_arrays, derived_t
from lavender_ext.core.problem import LAWS
from lavender_ext.small.call cimport N_COUNTS, Rules, small_rules_t, small_problem_t, judge_small_impulse
from lavender_ext.batch.task cimport (copy_small_judgement, compute_missing_derived_numbers, judge_task, judge_zero_impulse_of_task,
                                      judge_task_workspace_size, prepare_task_for_small_call,
                                     solve_small_task, solve_task, task_t, task_workspaces_t)
from lavender_ext.small.limits cimport estimate_newton_cost_terms, limits_t, max_newton_cost, newton_cost_t
from lavender_ext.host cimport grow_workspace_to, free_workspace
from lavender_ext.batch.lanes cimport (LANE_IS_PLAIN, LANE_RHS, LANE_START_ENERGY, LANE_START_SPEED, LANE_STEPS,
                                       MAX_LANES, MAX_LANE_ROWS,
                                       bind_lanes, compute_structure_key, count_lanes, have_worlds_equal_structure,
                                       is_lane_refined, judge_lanes, lane_number, lanes_t, list_lane_blocks, load_lanes,
                                       prepare_lanes, score_of_lane, solve_lanes)
from lavender_ext.batch.world cimport (BAD, BLOCK, BLOCKS, CONE_ROW, FREE, JAC, LATE, LEFT, MASS, MU, N_ARRAYS, PLACES, READY,
                                       AT_ROW, ROWS, SOFT, STARTED, TARGET, TRIED, VELOCITIES, VELOCITY, worker_scratch_t,
                                       convert_generalized_world, worlds_t)
from lavender_ext.judge.measure cimport (count_judge_scratch, make_judged, relative_floor_of_score, relative_residual_of_score,
                                         residual_above_floor, set_zero_impulse)
from lavender_ext.judge.rounding cimport float32_floor_of_score, compute_squared_float32_rounding
from lavender_ext.judge.tally cimport compute_rhs_energy_norm
from lavender_ext.velocity_newton.soft cimport needs_no_proximal_terms

cdef extern from *:
    """
    /* `PyArray_New` and `PyArray_Type` of NumPy's table of functions, whose order has not changed since NumPy 1.0. */
    static void** lav_numpy;
    #define lav_read_numpy(capsule) (lav_numpy = (void**)PyCapsule_GetPointer(capsule, NULL))
    static PyObject* lav_new_array(Py_ssize_t* n) {
        PyObject* (*make_array)(void*, int, Py_ssize_t*, int, void*, void*, int, int, void*);
        memcpy(&make_array, lav_numpy + 93, sizeof make_array);  /* C has no cast of an object pointer to a function pointer */
        return make_array(lav_numpy[2], 1, n, 12, NULL, NULL, 0, 0, NULL);
    }
    #if defined(_MSC_VER)
    #include <intrin.h>
    #define lav_add(p, x) _InterlockedExchangeAdd64((volatile __int64*)(p), (x))
    #else
    #define lav_add(p, x) __atomic_fetch_add((p), (x), __ATOMIC_ACQ_REL)
    #endif
    """
    int64_t lav_add(int64_t* p, int64_t x) noexcept nogil
    void** lav_read_numpy(object capsule) except NULL
    ndarray lav_new_array(Py_ssize_t* n)

lav_read_numpy((np._core if hasattr(np, "_core") else np.core)._multiarray_umath._ARRAY_API)


cdef ndarray new(Py_ssize_t n):
    """Return an uninitialised array (n,) of float64, in a third of the time of `numpy.empty`."""
    return lav_new_array(&n)


cdef enum:
    MAX_KEPT_NUMBERS = 1 << 16      # A workspace with more numbers is freed at the end of a call.
    INTERRUPT_CHECK_WORLDS = 256    # worlds between two checks for Ctrl-C
    MAX_LANE_PAUSE = 31             # groups of worlds without lanes, where lanes cover none


cdef int set_task_from_problem(task_t* j, problem) except -1:
    """Set up a task from a `Problem` that is given by A or by bodies, without derived numbers."""
    cdef Blocks blocks = problem.cones._blocks
    cdef Py_ssize_t m = blocks.at.n_rows
    rows, matrix = problem.rows, problem.matrix
    j.p, j.has_derived, j.zero_residual[0], j.factored = blocks.at, False, -1.0, rows is not None
    j.p.law, j.p.b = LAWS[problem.friction], as_double_pointer(problem.b, m)
    if j.factored:
        bind_body_arrays(&j.r, &j.p, (
            rows.jac, rows.joint_body, rows.normal, rows.tangent, rows.arm_a, rows.arm_b, rows.contact_body, rows.inv_mass,
            rows.inv_inertia, problem.compliance,
        ))
    elif isinstance(matrix, ndarray):
        j.dense, j.row = as_double_pointer(matrix, m * m), m
    else:
        indptr, indices, data = problem._compressed
        j.a.indptr, j.a.indices = as_int_pointer(indptr, m + 1), as_int_pointer(indices, len(indices))
        j.a.data = as_double_pointer(data, len(data))
    return 0


cdef int set_task_from_data(task_t* j, Data p, start, double* lam, double* slack_error) except -1:
    """Set up a task from the data `p`. It starts from `start` (m,) [N s], or from the zero impulse if `start` is None."""
    j.p, j.g, j.a, j.r, j.general, j.factored = p.blocks, p.general, p.csr, p.rows, p.is_general, p.factored
    j.has_derived = p.ready
    j.made = p.derived
    if not p.is_general:
        j.made.n_empty = <int32_t>len(p.empty)
    j.zero_residual[0], j.zero_residual[1], j.zero_residual[2] = p.reference_energy, p.reference_velocity, p.relative_at_zero
    return set_task_start(j, start, lam, slack_error)


cdef int set_task_start(task_t* j, start, double* lam, double* slack_error) except -1:
    """Set the start of a task, (m,) [N s] or None for the zero impulse, and its output arrays; reset its result."""
    cdef const double[::1] values
    j.lam, j.slack_error = lam, slack_error
    j.solved, j.is_late, j.cold, j.deadline, j.by_island = False, False, start is None, NULL, NULL
    j.failed_in_lanes = False
    if not j.cold:
        values = start
        if values.shape[0] != j.p.n_rows:
            raise ValueError(f"{values.shape[0]} numbers for {j.p.n_rows} rows")
        if j.p.n_rows:
            memcpy(lam, &values[0], j.p.n_rows * sizeof(double))
    return 0


cdef make_task_result(task_t* j, Data p, impulse, both):
    """Return (judged result or None, counters as of `Newton.run`)."""
    judged = None
    if j.solved or j.is_late:
        judged = make_judged(p, impulse, both, &j.score, j.relative, j.floor, j.float64_relative)
    return judged, (j.counts[0], j.counts[1], j.counts[2], j.counts[3])


cdef void store_zero_residual(task_t* j, Data p):
    """Store the residual of the zero impulse that the task has computed in `p`, unless `p` has one."""
    if p.reference_energy < 0.0 and j.zero_residual[0] >= 0.0:
        p.store_reference(j.p.islands, j.zero_residual)


cdef struct call_workspaces_t:      # of one call
    workspace_t solve
    workspace_t islands


cdef void free_call_workspaces(call_workspaces_t* r) noexcept nogil:
    free_workspace(&r.solve)
    free_workspace(&r.islands)


cdef class Limits:
    """Cost limits, from the fields of a `limits_t` as an array (18,), and the workspaces of calls that have ended."""
    cdef limits_t at
    cdef call_workspaces_t kept

    def __init__(self, const double[::1] numbers):
        self.at = (<const limits_t*>&numbers[0])[0]

    def __dealloc__(self):
        free_call_workspaces(&self.kept)

    cdef void exchange_kept_workspaces(self, call_workspaces_t* r) noexcept:
        """Exchange workspaces with the kept ones, so that no two calls of different threads use the same."""
        with cython.critical_section(self):
            self.kept, r[0] = r[0], self.kept

    def cost(self, Data p, double work, int islands):
        """Return the estimated and permitted cost [ns] of Newton's method; `work`: multiply-adds to factorise every island."""
        cdef bint soft = needs_no_proximal_terms(&p.blocks, &p.general)
        cdef newton_cost_t cost = estimate_newton_cost_terms(&p.blocks, &p.general, &self.at)
        return (cost.fixed + cost.per_work * work,
                max_newton_cost(&p.blocks, &p.general, &self.at, islands, soft))


def solve_new_generalized_problem(Data p, start, double tol, Limits limits, deadline=None):
    """Set up, solve and judge a problem of J and M with at least one row and without derived data, in one call.

    Returns (judged result, counters). None is returned if it is above tol, if an empty row violates its target, or if the
    estimated cost exceeds the limits. The counters are zero if nothing was run. At the deadline the present iterate is
    returned. d, Y and the residual of the zero impulse are stored in the data.
    """
    cdef task_t j
    cdef call_workspaces_t r
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef bint had_derived = p.ready
    impulse, results = make_read_only(new(m)), new(2 * m + 1)
    set_task_from_data(&j, p, start, <double*>(<ndarray>impulse).data, <double*>(<ndarray>results).data)
    j.deadline = get_pointer(deadline)
    memset(&r, 0, sizeof(r))
    limits.exchange_kept_workspaces(&r)
    with nogil:
        r.solve.is_bound = r.solve.tries = 0
        solve_task(&j, &r.solve, &r.islands, &limits.at, tol)
    if not had_derived and j.has_derived:
        p.adopt_derived(&j.made)
    elif not had_derived:
        free(j.made.marks)
        free(j.made.numbers)
    store_zero_residual(&j, p)
    if max(r.solve.n_real, r.solve.n_index, r.islands.n_real, r.islands.n_index) <= MAX_KEPT_NUMBERS:
        limits.exchange_kept_workspaces(&r)
    free_call_workspaces(&r)
    return make_task_result(&j, p, impulse, results)


cdef enum:                      # rows of `Worlds.numbers`: results of each world
    RELATIVE = 0
    ENERGY = 1                  # sqrt J, energy error
    SPEED = 2                   # m/s, velocity error
    FLOOR = 3
    START_ENERGY = 4            # sqrt J, energy error of the zero impulse
    START_SPEED = 5
    START_RELATIVE = 6
    RHS_ENERGY = 7              # energy norm of b; set by `judge` only
    PUSH = 8                    # N s, |e| of the worst row
    ABOVE_FLOOR = 9             # part of the relative residual above the round-off floor
    N_NUMBERS = 10


#: {name: column of the argument `at` of `Worlds`}.
PLACE = {"rows": ROWS, "velocities": VELOCITIES, "blocks": BLOCKS, "jac": JAC, "mass": MASS, "free": FREE, "target": TARGET,
         "soft": SOFT, "mu": MU, "block": BLOCK, "cone_row": CONE_ROW, "row": AT_ROW, "velocity": VELOCITY}


#: Rows of `Worlds.numbers`, and status codes of worlds, by name.
NUMBER = {"relative": RELATIVE, "energy": ENERGY, "speed": SPEED, "roundoff_floor": FLOOR, "reference_energy": START_ENERGY,
          "reference_speed": START_SPEED, "relative_at_zero": START_RELATIVE, "rhs_energy": RHS_ENERGY, "push": PUSH,
          "above_floor": ABOVE_FLOOR}
CODE = {"left": LEFT, "ready": READY, "bad": BAD, "tried": TRIED, "late": LATE, "started": STARTED}


cdef enum:                      # results of `Worker.process_worlds` other than the index of a deferred world
    DONE_ALL = -1


def list_problem_data(list problems, kind):
    """Return (data, at, number of all rows) of n problems: a list, and an argument `at` of `Worlds`.

    An item of `data` is the `Data` of a problem, True if its derived numbers are not computed, or None if workers do not
    support it.
    """
    cdef Py_ssize_t i, n = len(problems)
    cdef int64_t m = 0
    cdef list data = [None] * n
    places = np.zeros((n, PLACES), np.int64)
    cdef int64_t[:, ::1] at = places
    for i in range(n):
        problem = problems[i]
        p = problem.derived.view
        at[i, ROWS], at[i, AT_ROW] = problem.m if p is None else (<Data>p).blocks.n_rows, m
        m += at[i, ROWS]
        if type(problem) is not kind:
            continue
        if p is None:
            if (<Blocks>problem.cones._blocks).has_ellipse or problem.has_singular_program:
                continue
            p = problem.__dict__.get("data", True)
        elif p.has_ellipse:
            continue
        data[i] = p
    return data, places, m


cdef struct worker_t:             # memory of one thread
    workspace_t workspace
    workspace_t slack_error
    derived_t made
    worker_scratch_t scratch
    task_workspaces_t small
    workspace_t by_island
    workspace_t lanes
    int64_t begin, next, end        # taken places of the order; those from `next` on are not processed
    int64_t group[MAX_LANES]        # worlds at these places; -1: none
    int32_t failed                  # bit k: lanes have not solved world k of the group
    int32_t pause, idle             # groups without lanes after the last group that lanes did not cover; those to come


cdef class Worlds:
    """Problems of a batch and their results. Problems are objects, or are converted from a few arrays when they are solved.

    `numbers` (N_NUMBERS, n) are the judge's results, `worst` (n,) its worst rows, `counts` (n, N_COUNTS) as in `task_t`; `code`
    (n,) is the status, LEFT, READY, BAD, ... `impulse` and `velocity` hold the worlds one after the other, at the offsets in `at`.

    Parameters
    ----------
    problems, data : list
        Problems that are objects, and the result of `list_problem_data` for them, with starts (m,) [N s] or None.
    at : (n, PLACES) int64
        Sizes and offsets as in `world.pxd`; for objects only the columns ROWS and AT_ROW.
    arrays : sequence of 6
        J, M, v*, target, compliance, mu (or None), flat float64 or float32; or A, None, None, b, None, mu.
    strides : (int, int)
        Strides of the rows of J and of M; 0: number of velocities.
    pattern : (indptr, indices) int32, or None
        Pattern of M, if it holds lower triangles in compressed rows with one shared pattern.
    impulse, velocity : float64
        Results; for arrays the impulse holds the starts on entry, unless `cold`.
    """

    cdef task_t* tasks            # tasks of problems that are objects
    cdef worlds_t w
    cdef int64_t taken
    cdef bint cold
    cdef public int width           # number of worlds that a worker takes at a time, to process them in lanes: 1, 2, 4 or 8
    cdef object order               # worlds (places,) in the order in which they are processed in lanes; -1: none
    cdef const int64_t* order_at
    cdef readonly object numbers, worst, counts, code, impulse, velocity
    cdef list references
    cdef double* lam
    cdef double* v
    cdef double* number
    cdef int32_t* worst_at
    cdef int32_t* count
    cdef signed char* code_at

    def __init__(self, const int64_t[:, ::1] at, impulse, velocity, bint cold):
        cdef Py_ssize_t n = at.shape[0], i
        cdef ndarray numbers = np.zeros((N_NUMBERS, n + 1)), worst = np.empty(n + 1, np.int32)
        cdef ndarray counts = np.zeros((n + 1, N_COUNTS), np.int32), code = np.zeros(n + 1, np.int8)
        self.impulse, self.velocity, self.cold, self.references = impulse, velocity, cold, [at]
        self.numbers, self.worst, self.counts, self.code = numbers, worst, counts, code
        self.w.n, self.width = n, 1
        if n:
            self.w.at = &at[0, 0]
        self.lam, self.v = as_double_pointer(impulse, impulse.size), as_double_pointer(velocity, velocity.size)
        self.number, self.worst_at = <double*>numbers.data, <int32_t*>worst.data
        self.count, self.code_at = <int32_t*>counts.data, <signed char*>code.data
        for i in range(n + 1):
            self.worst_at[i] = -1

    def set_from_arrays(self, arrays, strides, pattern, Blocks blocks, int law, double asymmetry):
        """Set the worlds from arrays with checked shapes and types. Their values are checked when a world is converted."""
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
        self.w.jac_row_stride, self.w.mass_row = strides
        self.width = count_lanes()
        self.references += [blocks, pattern, *arrays]
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
        self.order_worlds()

    cdef void order_worlds(self):
        """Order the worlds by their structure, in groups of MAX_LANES; -1 fills the last group of each structure."""
        cdef int64_t i
        cdef int64_t[::1] key
        cdef const int64_t[::1] order
        keys = np.empty(self.w.n, np.int64)
        key = keys
        for i in range(self.w.n):
            key[i] = compute_structure_key(&self.w, i)
        by = np.argsort(keys, kind="stable")
        sizes = np.diff(np.flatnonzero(np.diff(keys[by])) + 1, prepend=0, append=self.w.n)
        places = -(-sizes // MAX_LANES) * MAX_LANES
        self.order = np.full(places.sum(), -1)
        self.order[np.arange(self.w.n) + np.repeat(np.cumsum(places - sizes) - (places - sizes), sizes)] = by
        order = self.order
        if self.w.n:
            self.order_at = &order[0]

    def set_from_problems(self, list problems, list data, list starts):
        """Set the worlds from problems and their `list_problem_data`; None defers a problem to the caller."""
        cdef int64_t i
        cdef task_t* j
        self.tasks = <task_t*>calloc(self.w.n + 1, sizeof(task_t))
        if self.tasks == NULL:
            raise MemoryError(f"{self.w.n} problems")
        self.references += [problems, data]
        for i in range(self.w.n):
            p, j = data[i], &self.tasks[i]
            if p is True:
                set_task_from_problem(j, problems[i])
                set_task_start(j, starts[i], self.lam + self.w.at[i * PLACES + AT_ROW], NULL)
            elif p is not None:
                set_task_from_data(j, p, starts[i], self.lam + self.w.at[i * PLACES + AT_ROW], NULL)

    def store_zero_residuals(self, data):
        """Store the residuals of the zero impulse in the data of solved problems."""
        cdef int64_t i
        for i in range(self.w.n):
            if self.code_at[i] == READY and data[i] is not True:
                store_zero_residual(&self.tasks[i], data[i])

    cdef bint is_general(self, int64_t i) noexcept nogil:
        return self.tasks == NULL or self.tasks[i].general

    cdef int32_t convert_world(self, int64_t i, worker_scratch_t* scratch, workspace_t* slack_error, const derived_t* made,
                               task_t* j) noexcept nogil:
        """Convert world i for a solve or for the judge; return READY, BAD or LEFT."""
        cdef const int64_t* at = self.w.at + i * PLACES
        cdef int32_t code = READY
        if self.tasks != NULL:
            j[0] = self.tasks[i]
            if j.p.n_rows == 0:
                return LEFT
        else:
            j.general, j.factored = True, False
            code = convert_generalized_world(&self.w, i, scratch, &j.p, &j.g)
            j.zero_residual[0] = -1.0
            j.by_island = NULL
            j.solved, j.is_late, j.cold, j.has_derived, j.lam = False, False, self.cold, False, self.lam + at[AT_ROW]
        if not j.has_derived and j.general:
            j.made = made[0]
        j.deadline = NULL
        if not grow_workspace_to(slack_error, 0, 2 * at[ROWS] + 1):
            return LEFT
        j.slack_error = slack_error.real
        return code

    cdef void store_result(self, int64_t i, const task_t* j, const worker_scratch_t* scratch) noexcept nogil:
        """Store the judge's results of world i, and its velocity v+ after the step if the worlds are given as arrays."""
        cdef const int64_t* at = self.w.at + i * PLACES
        cdef double* v
        cdef int32_t k
        self.store_judgement(i, j, j.slack_error[j.p.n_rows + j.score.worst] if j.score.worst >= 0 else 0.0)
        if self.tasks == NULL:
            v = self.v + at[VELOCITY]
            for k in range(at[VELOCITIES]):
                v[k] = scratch.free[k] + j.push[k]

    cdef void store_judgement(self, int64_t i, const task_t* j, double push) noexcept nogil:
        """Store the judge's results of world i; push: e of the worst row [N s]."""
        cdef int64_t n = self.w.n + 1
        cdef int32_t k
        self.number[RELATIVE * n + i], self.number[FLOOR * n + i] = j.relative, j.floor
        self.number[ABOVE_FLOOR * n + i] = j.above_floor
        self.number[ENERGY * n + i] = j.score.energy if j.score.finite else INFINITY
        self.number[SPEED * n + i] = j.score.velocity if j.score.finite else INFINITY
        for k in range(3):
            self.number[(START_ENERGY + k) * n + i] = j.zero_residual[k]
        self.worst_at[i] = j.score.worst
        self.number[PUSH * n + i] = fabs(push)

    cdef int32_t process_in_lanes(self, const int64_t* worlds, int32_t n_worlds, worker_t* h, double tol,
                                  bint judges) noexcept nogil:
        """Judge or solve worlds (n_worlds) in lanes as `judge_world` and `solve_world` do; return their number, -1 without lanes.

        The code of worlds that no lane covers or solves stays LEFT. Half a group takes as long alone as in lanes.
        """
        cdef lanes_t x
        cdef task_t j
        cdef const int64_t* at
        cdef int32_t ptr[MAX_LANE_ROWS + 1]
        cdef int32_t kind[MAX_LANE_ROWS]
        cdef int32_t lane, k, done = 0, width = self.width
        cdef double* lam
        cdef int64_t i, n = self.w.n + 1
        cdef double* v
        if n_worlds < 2 or 2 * n_worlds <= width or compute_structure_key(&self.w, worlds[0]) == 0:
            return -1
        for lane in range(1, n_worlds):
            if not have_worlds_equal_structure(&self.w, worlds[0], worlds[lane]):
                return -1
        at = self.w.at + worlds[0] * PLACES
        x.m, x.n, x.law, x.k = <int32_t>at[ROWS], <int32_t>at[VELOCITIES], self.w.blocks.law, <int32_t>at[BLOCKS]
        x.asymmetry = self.w.asymmetry if self.w.mass_ptr == NULL else -1.0
        if not grow_workspace_to(&h.lanes, 0, bind_lanes(&x, width, NULL)):
            return -1
        bind_lanes(&x, width, h.lanes.real)
        list_lane_blocks(&self.w.blocks, <int32_t>at[BLOCK], &x, ptr, kind)
        load_lanes(&x, &self.w, self.lam, worlds, n_worlds, width)
        prepare_lanes(&x, width)
        x.tol = tol
        if not judges:
            solve_lanes(&x, width)
        judge_lanes(&x, width)
        for lane in range(n_worlds):
            i, at = worlds[lane], self.w.at + worlds[lane] * PLACES
            if not lane_number(&x, LANE_IS_PLAIN, width, lane) > 0.0:
                continue
            j.score = score_of_lane(&x, width, lane)
            j.zero_residual[0] = lane_number(&x, LANE_START_ENERGY, width, lane)
            j.zero_residual[1], j.zero_residual[2] = lane_number(&x, LANE_START_SPEED, width, lane), 1.0
            j.relative = relative_residual_of_score(&j.score, NULL, 0, j.zero_residual[0], j.zero_residual[1])
            if is_lane_refined(&x, width, lane, tol, j.relative):
                continue
            j.floor = relative_floor_of_score(&j.score, j.zero_residual[0], j.zero_residual[1])
            j.above_floor = residual_above_floor(&j.score, j.relative, j.floor)
            if not judges:
                if not (j.relative <= tol and j.floor <= tol):
                    h.failed |= 1 << lane
                    continue
                lam = self.lam + at[AT_ROW]
                for k in range(x.m):
                    lam[k] = x.lam[k * width + lane]
                k = <int32_t>lane_number(&x, LANE_STEPS, width, lane)
                self.count[N_COUNTS * i] = self.count[N_COUNTS * i + 1] = k
            self.store_judgement(i, &j, x.e[j.score.worst * width + lane] if j.score.worst >= 0 else 0.0)
            if judges:
                self.number[RHS_ENERGY * n + i] = lane_number(&x, LANE_RHS, width, lane)
            v = self.v + at[VELOCITY]
            for k in range(x.n):
                v[k] = x.free[k * width + lane] + x.push[k * width + lane]
            self.code_at[i] = READY
            done += 1
        return done

    cdef int32_t store_empty_world(self, int64_t i, const worker_scratch_t* scratch) noexcept nogil:
        """Store the velocity v+ after the step of a world without rows, which is v*."""
        memcpy(self.v + self.w.at[i * PLACES + VELOCITY], scratch.free,
               self.w.at[i * PLACES + VELOCITIES] * sizeof(double))
        return READY

    cdef int32_t solve_world(self, int64_t i, worker_t* h, const limits_t* limits, const small_rules_t* rules, double tol,
                             deadline_t* deadline) noexcept nogil:
        """Solve world i, store its result and return its status."""
        cdef task_t j
        cdef int32_t k, code = LEFT
        cdef bint had_derived
        if limits == NULL if self.is_general(i) else rules == NULL:
            return LEFT
        code = self.convert_world(i, &h.scratch, &h.slack_error, &h.made, &j)
        if code != READY:
            return code
        if j.p.n_rows == 0:
            return self.store_empty_world(i, &h.scratch)
        had_derived, j.deadline = j.has_derived, deadline
        j.failed_in_lanes = h.failed >> (h.next - 1 - h.begin) & 1
        if j.general:
            solve_task(&j, &h.workspace, &h.small.islands, limits, tol)
            if not had_derived:
                h.made = j.made                         # The next world reuses the memory of `made`.
            # Without a reference no solver has run; the single call computes it.
            code = READY if j.solved else TRIED if j.zero_residual[0] >= 0.0 else LEFT
        else:
            code = solve_small_task(&j, &h.small, rules, tol)
        if code == READY or code == STARTED:
            self.store_result(i, &j, &h.scratch)
        if code != LEFT:
            memcpy(&self.count[N_COUNTS * i], j.counts, sizeof(j.counts))
        if self.tasks != NULL and j.p.islands == NULL:   # the next world reuses the memory of islands
            for k in range(3):
                self.tasks[i].zero_residual[k] = j.zero_residual[k]
        return code

    cdef int32_t judge_world(self, int64_t i, worker_t* h, double tol, bint narrow) noexcept nogil:
        """Judge world i without solving, refined for `tol`, and return its status; worlds with empty rows are deferred.

        narrow: with the round-off floor of float32.
        """
        cdef task_t j
        cdef small_problem_t s
        cdef int32_t k, code = self.convert_world(i, &h.scratch, &h.slack_error, &h.made, &j), m = j.p.n_rows
        cdef bint had_derived = j.has_derived
        cdef double* x
        if code != READY:
            return code
        if m == 0:
            return self.store_empty_world(i, &h.scratch)
        code = LEFT
        if not j.general:
            if narrow or not prepare_task_for_small_call(&j, &s, &h.small):
                return LEFT
            if not grow_workspace_to(&h.small.call.work, 0, count_judge_scratch(&s.v)):
                return LEFT
            if j.cold:
                set_zero_impulse(&j.p, j.lam, j.slack_error)
            code = READY
            judge_small_impulse(&s, j.lam, j.slack_error, h.small.call.work.real)
            copy_small_judgement(&j, &s)
            j.push = h.small.call.work.real
        elif (compute_missing_derived_numbers(&j) and j.made.n_empty == 0
              and grow_workspace_to(&h.workspace, 0, max(judge_task_workspace_size(&j), 4 * <int64_t>m + 5 * j.g.n))
              and grow_workspace_to(&h.by_island, 0, 2 * <int64_t>j.p.n_blocks)
              and judge_zero_impulse_of_task(&j, &h.small.islands, h.workspace.real)):
            code, x = READY, h.workspace.real
            if j.cold:
                set_zero_impulse(&j.p, j.lam, j.slack_error)
            j.by_island = h.by_island.real
            judge_task(&j, tol, x)
            if narrow:
                x += j.g.n                              # after M^-1 J^T lam
                compute_squared_float32_rounding(&j.p, &j.g, &h.scratch.mass, h.scratch.free, j.lam, x, x + m, x + 2 * m, x + 3 * m)
                for k in range(m):
                    x[k] = x[k] + x[m + k] + x[2 * m + k]
                j.floor = float32_floor_of_score(&j.p, x, &j.score, j.relative, j.zero_residual[0], j.zero_residual[1],
                                                 &j.above_floor)
        if code == READY:
            self.store_result(i, &j, &h.scratch)
            self.number[RHS_ENERGY * (self.w.n + 1) + i] = compute_rhs_energy_norm(&j.p)
        if j.general and not had_derived:
            h.made = j.made
        return code

    def __dealloc__(self):
        free(self.tasks)


cdef class Worker:
    """Worker of one thread: processes the next of `Worlds`, selected by an atomic counter, until there are no more.

    stop : (1,) bytes
        No world is started after it becomes nonzero: another thread receives Ctrl-C.
    """

    cdef Worlds worlds
    cdef worker_t h
    cdef const unsigned char[::1] stop

    def __init__(self, Worlds worlds, const unsigned char[::1] stop):
        self.worlds, self.stop, self.h.scratch.n_tree = worlds, stop, -1

    def __dealloc__(self):
        free_workspace(&self.h.workspace)
        free_workspace(&self.h.slack_error)
        free_workspace(&self.h.scratch.workspace)
        free_workspace(&self.h.scratch.tree)
        free_workspace(&self.h.by_island)
        free_workspace(&self.h.lanes)
        free_workspace(&self.h.small.islands)
        free_workspace(&self.h.small.made)
        free_workspace(&self.h.small.formed)
        free_workspace(&self.h.small.bound)
        free_workspace(&self.h.small.call.work)
        free_workspace(&self.h.small.call.more)
        free(self.h.made.marks)
        free(self.h.made.numbers)

    def solve_worlds(self, double tol, Limits limits, Rules rules, deadline=None):
        """Solve worlds until one is deferred and return its index, or DONE_ALL if there are no more.

        Without limits all worlds of J and M are deferred, without rules all others. At the deadline the present iterate of a
        world is its result, and the starts of the worlds after it are judged.
        """
        return self.process_worlds(tol, limits, rules, deadline, False, False)

    def judge_worlds(self, double tol, bint narrow):
        """Judge the impulses of worlds until one is deferred, and return its index, or DONE_ALL if there are no more.

        narrow: use the round-off floor of float32.
        """
        return self.process_worlds(tol, None, None, None, True, narrow)

    cdef int64_t process_worlds(self, double tol, Limits limits, Rules rules, deadline, bint judges, bint narrow) except? -3:
        """Solve worlds, or judge them, until one is deferred."""
        cdef Worlds w = self.worlds
        cdef const limits_t* at = &limits.at if limits is not None else NULL
        cdef const small_rules_t* small_rules = &rules.at if rules is not None else NULL
        cdef const int64_t* order = NULL
        cdef int64_t i, n = w.w.n
        cdef int32_t code, n_group, n_done = 0
        cdef bint uses_lanes = not narrow
        cdef deadline_t own                             # Other threads read the clock for themselves.
        cdef deadline_t* until = get_pointer(deadline)
        if until != NULL:
            own = until[0]
            until = &own
        if not judges:
            uses_lanes = at != NULL and at.lanes != 0.0 and w.cold
        if uses_lanes and w.width > 1 and until == NULL:        # With a limit of time, worlds are solved in their own order.
            order, n = w.order_at, len(w.order)
        with nogil:
            while not self.stop[0]:
                if self.h.next == self.h.end:
                    i = lav_add(&w.taken, w.width)
                    if i >= n:
                        return DONE_ALL
                    self.h.begin, self.h.next, self.h.end, self.h.failed, n_group = i, i, min(i + w.width, n), 0, 0
                    for i in range(self.h.begin, self.h.end):
                        self.h.group[i - self.h.begin] = i if order == NULL else order[i]
                        n_group += self.h.group[i - self.h.begin] >= 0
                    if w.width > 1 and uses_lanes and not has_passed(until, 0.0):
                        if self.h.idle > 0:
                            self.h.idle -= 1
                        else:
                            n_group = w.process_in_lanes(self.h.group, n_group, &self.h, tol, judges)
                            if n_group > 0:
                                self.h.pause = 0
                            elif n_group == 0:
                                self.h.pause = self.h.idle = min(2 * self.h.pause + 1, MAX_LANE_PAUSE)
                i = self.h.group[self.h.next - self.h.begin]
                self.h.next += 1
                if i < 0:
                    continue
                if w.code_at[i] == READY:               # A lane has processed this world.
                    code = READY
                elif has_passed(until, reading_interval()):
                    code = w.judge_world(i, &self.h, tol, narrow)
                    if code == READY:
                        code = LATE
                elif judges:
                    code = w.judge_world(i, &self.h, tol, narrow)
                else:
                    code = w.solve_world(i, &self.h, at, small_rules, tol, until)
                w.code_at[i] = <signed char>code
                if code == LEFT or code == TRIED:
                    return i
                n_done += 1
                if n_done % INTERRUPT_CHECK_WORLDS == 0:
                    with gil:
                        PyErr_CheckSignals()
        return DONE_ALL
