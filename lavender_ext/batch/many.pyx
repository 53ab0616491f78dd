"""Python interface to compiled calls: one problem, or a batch of problems by J and M, by A or by bodies, by `task.pxd`.

`Call` solves one problem for `lavender.solve`. A world is one problem of a batch. `Worlds` holds the worlds and their results.
Each `Worker` belongs to one thread and takes the next world, without the interpreter. A worker leaves some worlds to the
caller, for the general solvers: these are called deferred.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t, int64_t
from libc.math cimport INFINITY, fabs
from libc.stdlib cimport calloc, free, qsort
from libc.string cimport memcpy, memset

cimport cython

import numpy as np

from lavender_ext.core.arrays cimport (C_CONTIGUOUS, DOUBLE, as_double_pointer, as_int_pointer, has_element_type, make_read_only,
                                       ndarray)
from lavender_ext.core.block_types cimport CONE
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.core.checks cimport make_instance
from lavender_ext.core.deadline cimport deadline_t, get_pointer, has_passed, read_clock, reading_interval
from lavender_ext.core.generalized cimport solve_mass_matrix
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.problem cimport Data, Workspace, allocate_bytes, bind_body_arrays, derived_t
from lavender_ext.core.problem import LAWS
from lavender_ext.core.validate cimport all_finite
from lavender_ext.small.call cimport derive_small_problem, judge_task, solve_small
from lavender_ext.small.task cimport (N_CALL_WORKSPACES, N_COUNTS, RESULT_FAILED, RESULT_IS_START, WORK, count_task_scratch,
                                      small_rules_t, task_t)
from lavender_ext.batch.adjoint cimport adjoin_task, adjoint_t, cotangents_t
from lavender_ext.batch.gather cimport gather_tasks, set_places_of_task
from lavender_ext.batch.motion cimport judge_motion, motion_error_t, motion_t
from lavender_ext.batch.task cimport prepare_task, solve_generalized_task, solve_task
from lavender_ext.small.limits cimport estimate_newton_cost_terms, limits_t, max_newton_cost, newton_cost_t
from lavender_ext.host cimport grow_workspace_to, free_workspace
from lavender_ext.batch.lanes cimport (LANE_IS_PLAIN, LANE_RHS, LANE_START_ENERGY, LANE_START_SPEED,
                                       MAX_LANES, add_lane_counts, arrange_lanes, bind_lanes, compute_structure_key,
                                       count_lanes, is_lane_refined,
                                       judge_lanes, lane_number, lane_rows_t, lanes_t, load_lanes,
                                       prepare_lanes, score_of_lane, solve_lanes)
from lavender_ext.batch.world cimport (BAD, BLOCK, BLOCKS, CONE_ROW, FREE, JAC, LATE, LEFT, MASS, MU, N_ARRAYS, PLACES, READY,
                                       AT_ROW, ROWS, SOFT, STARTED, TARGET, TRIED, VELOCITIES, VELOCITY, worker_scratch_t,
                                       convert_generalized_world, worlds_t)
from lavender_ext.judge.measure cimport (Judged, make_judged, relative_floor_of_score, relative_residual_of_score,
                                         residual_above_floor, set_zero_impulse)
from lavender_ext.judge.rounding cimport float32_floor_of_score, compute_squared_float32_rounding
from lavender_ext.judge.tally cimport compute_rhs_energy_norm
from lavender_ext.velocity_newton.soft cimport needs_no_proximal_terms

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

cdef extern from "numpy/arrayobject.h":
    int _import_array() except -1
    ndarray PyArray_SimpleNew(int nd, Py_ssize_t* shape, int type_number)

_import_array()


cdef ndarray new(Py_ssize_t n):
    """Return an uninitialised array (n,) of float64, in a third of the time of `numpy.empty`."""
    return PyArray_SimpleNew(1, &n, DOUBLE)


cdef enum:
    MAX_KEPT_NUMBERS = 1 << 16      # Workspaces are freed at the end of a call if one has more numbers.
    INTERRUPT_CHECK_WORLDS = 256    # worlds between two checks for Ctrl-C
    CACHE_LINE_DOUBLES = 8          # doubles of a cache line, 64 bytes
    MIN_LISTED_ROWS = 8             # Problems of a list with fewer rows take as long alone as to be copied to lanes.
    MAX_LANE_PAUSE = 31             # groups of worlds without lanes, where lanes cover none

cdef enum:                      # indices of a worker's own workspaces, which follow the workspaces of a call
    SLACK_ERROR = N_CALL_WORKSPACES
    BY_ISLAND = N_CALL_WORKSPACES + 1
    LANES = N_CALL_WORKSPACES + 2
    GATHERED = N_CALL_WORKSPACES + 3
    N_WORKSPACES = N_CALL_WORKSPACES + 4


cdef int set_task_from_problem(task_t* j, problem) except -1:
    """Set up a task from a `Problem` that is given by A or by bodies, without derived numbers."""
    cdef Blocks blocks = problem.cones._blocks
    cdef Py_ssize_t m = blocks.at.n_rows
    rows, matrix = problem.rows, problem.matrix
    memset(j, 0, sizeof(task_t))
    j.zero_residual[0], j.v.p = -1.0, blocks.at
    j.v.p.law, j.v.p.b = LAWS[problem.friction], as_double_pointer(problem.b, m)
    if rows is not None:
        j.v.r = &j.r
        bind_body_arrays(&j.r, &j.v.p, (
            rows.jac, rows.joint_body, rows.normal, rows.tangent, rows.arm_a, rows.arm_b, rows.contact_body, rows.inv_mass,
            rows.inv_inertia, problem.compliance,
        ))
        return 0
    j.v.a = &j.a
    if isinstance(matrix, ndarray):
        j.dense = as_double_pointer(matrix, m * m)
    else:
        indptr, indices, data = problem._compressed
        j.a.indptr, j.a.indices = as_int_pointer(indptr, m + 1), as_int_pointer(indices, len(indices))
        j.a.data = as_double_pointer(data, len(data))
    return 0


cdef void set_task_from_data(task_t* j, Data p):
    """Set up a task from the data `p`, which must live as long as the task."""
    memset(j, 0, sizeof(task_t))
    j.v, j.g, j.made, j.has_derived = p.get_pointers(), p.general, p.derived, p.ready
    if p.is_general:
        j.v.g = &j.g
    else:
        j.made.n_empty = <int32_t>len(p.empty)
    j.zero_residual[0], j.zero_residual[1], j.zero_residual[2] = p.reference_energy, p.reference_velocity, p.relative_at_zero


cdef int set_task_start(task_t* j, start, double* lam) except -1:
    """Set the start of a task, (m,) [N s] or None for the zero impulse, in the array lam of its result."""
    j.lam, j.cold = lam, start is None
    if not j.cold:
        memcpy(lam, as_double_pointer(start, j.v.p.n_rows), j.v.p.n_rows * sizeof(double))
    return 0


cdef void store_zero_residual(task_t* j, Data p):
    """Store the residual of the zero impulse that the task has computed in `p`, unless `p` has one."""
    if p.reference_energy < 0.0 and j.zero_residual[0] >= 0.0:
        p.store_reference(j.v.p.islands, j.zero_residual)


cdef void free_workspaces(workspace_t* workspaces, int32_t n) noexcept nogil:
    cdef int32_t i
    for i in range(n):
        free_workspace(&workspaces[i])


cdef class Small:
    """Problem with few rows over A or bodies, or with small islands. A call only reads it.

    Parameters
    ----------
    data : Data
        Problem for the judge. It must hold the residual of the zero impulse.
    over : Data
        For bounded rows A in compressed rows, which is solved; else `data`.
    by_island : bool
        Whether to solve the islands one by one, which the judge has labelled; there are several, with friction.
    """

    cdef Data data, over
    cdef task_t at
    cdef workspace_t workspace

    def __init__(self, Data data, Data over, bint by_island=False):
        self.data, self.over = data, over
        set_task_from_data(&self.at, data)
        self.at.over, self.at.solves_islands = over.get_pointers(), by_island
        if not derive_small_problem(&self.at, &self.workspace):
            raise MemoryError(f"{data.blocks.n_rows} rows")

    def __dealloc__(self):
        free_workspace(&self.workspace)


cdef struct call_workspaces_t:
    workspace_t at[N_CALL_WORKSPACES]


cdef class Call:
    """Compiled call of a solver: its settings, and the workspaces of calls that have ended.

    Parameters
    ----------
    limits : (18,) or None
        Fields of a `limits_t` for problems of J and M; None if it does not accept them.
    decisions
        `DECISIONS` of lavender/solvers/decisions.py.
    pivots, follows : bool
        As in `small_rules_t`.
    get_small_call : callable
        Returns the `Small` of a problem of A or bodies, or None.
    """

    cdef limits_t limits
    cdef small_rules_t rules
    cdef readonly bint has_limits
    cdef object get_small_call
    cdef call_workspaces_t kept

    def __init__(self, limits, decisions, bint pivots, bint follows, get_small_call):
        self.has_limits, self.get_small_call = limits is not None, get_small_call
        if self.has_limits:
            self.limits = (<limits_t*>as_double_pointer(limits, sizeof(limits_t) // sizeof(double)))[0]
        self.rules = small_rules_t(decisions.small_rows, decisions.call_sweeps, decisions.call_island_rows,
                                   decisions.call_factorisations, decisions.call_extrapolation, decisions.warm_residual, pivots,
                                   follows)

    def __dealloc__(self):
        free_workspaces(self.kept.at, N_CALL_WORKSPACES)

    cdef void exchange_kept_workspaces(self, call_workspaces_t* r) noexcept:
        """Exchange workspaces with the kept ones, so that no two calls of different threads use the same."""
        with cython.critical_section(self):
            self.kept, r[0] = r[0], self.kept

    def cost(self, Data p, double work, int islands):
        """Return the estimated and permitted cost [ns] of Newton's method; `work`: multiply-adds to factorise every island."""
        cdef bint soft = needs_no_proximal_terms(&p.blocks, &p.general)
        cdef newton_cost_t cost = estimate_newton_cost_terms(&p.blocks, &p.general, &self.limits)
        return (cost.fixed + cost.per_work * work,
                max_newton_cost(&p.blocks, &p.general, &self.limits, islands, soft))

    def solve(self, problem, start, double tol, deadline=None):
        """Solve and judge a problem from `start` (m,) [N s], or from the zero impulse if it is None.

        Returns (judged result, counters). The result is None if it is above tol, if an empty row violates its target, or if the
        estimated cost exceeds the limits; at the deadline it is the present iterate. The counters are () if no call was made,
        None if `start` is the solution, and zero if nothing was run. Over J and M, d, Y and the residual of the zero impulse
        are stored in the problem's data.
        """
        cdef task_t j
        cdef call_workspaces_t r
        cdef Small small = None
        cdef Data p = problem.derived.view
        cdef Py_ssize_t i, m = p.blocks.n_rows if p is not None else len(problem.b)
        cdef bint had_derived
        cdef int32_t code = RESULT_FAILED
        cdef ndarray impulse, results
        if not tol > 0.0 or not m:
            return None, ()
        if p is not None:
            set_task_from_data(&j, p)
        else:
            small = self.get_small_call(problem)
            if small is None:
                return None, ()
            p, j = small.data, small.at
        impulse, results, had_derived = make_read_only(new(m)), new(2 * m + 1), p.ready
        set_task_start(&j, start, <double*>impulse.data)
        j.slack_error, j.tol, j.deadline = <double*>results.data, tol, get_pointer(deadline)
        memset(&r, 0, sizeof(r))
        self.exchange_kept_workspaces(&r)
        try:
            with nogil:
                if j.v.g == NULL:
                    code = solve_small(&j, &self.rules, r.at)
                elif prepare_task(&j, r.at):
                    code = solve_generalized_task(&j, r.at, &self.limits)
            if p.is_general:
                if not had_derived and j.has_derived:
                    p.adopt_derived(&j.made)
                elif not had_derived:
                    free(j.made.marks)
                    free(j.made.numbers)
                store_zero_residual(&j, p)                 # The workspaces hold its islands.
        finally:
            for i in range(N_CALL_WORKSPACES):
                if max(r.at[i].n_index, r.at[i].n_real) > MAX_KEPT_NUMBERS:
                    break
            else:
                self.exchange_kept_workspaces(&r)
            free_workspaces(r.at, N_CALL_WORKSPACES)
        judged = None
        if code != RESULT_FAILED:
            judged = make_judged(p, impulse, results, &j.score, j.relative, j.floor, j.float64_relative)
        if code == RESULT_IS_START:
            return judged, None
        return judged, (j.counts[0], j.counts[1], j.counts[2], j.counts[3], j.counts[4], j.counts[5], j.counts[6], j.counts[7])


# [s] A limit of at least this does not end the call of few rows, which `solve_general` may repeat if the call fails.
cdef double MIN_LONG_LIMIT = 0.1
cdef tuple NO_CALL = (None, None, None, None), LAWS_OF_ROWS = ("linear", "lcp")
cdef object Problem, Solution, CONVERGED, compute_postponed_fields, make_residual, get_zero_impulse_reference
cdef object name_start


def bind_types(types):
    """Set the classes and functions that `solve_compiled` needs; this package does not import them."""
    global Problem, Solution, CONVERGED, compute_postponed_fields, make_residual, get_zero_impulse_reference
    global name_start
    (Problem, Solution, CONVERGED, compute_postponed_fields, make_residual, get_zero_impulse_reference, name_start) = types


cdef bint is_plain_start(impulse, Py_ssize_t m) noexcept:
    """Return whether a start is a contiguous array (m,) of finite numbers, which needs no conversion."""
    if type(impulse) is not ndarray:
        return False
    cdef ndarray x = <ndarray>impulse
    return (x.nd == 1 and x.dimensions[0] == m and x.flags & C_CONTIGUOUS and has_element_type(x, DOUBLE)
            and all_finite(<const double*>x.data, m))


def solve_compiled(problem, spec, impulse, tol, deadline=None):
    """Solve and judge a problem by the compiled call of a solver, unless the call does not accept the problem.

    Parameters
    ----------
    problem : Problem
    spec : SolverSpec
    impulse : (m,) N s, or None
    tol : float, -
    deadline : Deadline, optional
        Time at which the call ends with the iterate so far.

    Returns
    -------
    tuple
        Four items: the solution, or None if no result is within tol; the judged result, or None; the work counts, or None if
        no call was made or the start is the result; the start (m,) of the call, or None.
    """
    cdef Call call
    solution, view = None, problem.derived.view
    if spec.small is None or not spec.builtin or not isinstance(tol, float) or not 0.0 < <double>tol < INFINITY:
        return NO_CALL
    call = spec.small.call
    if view is not None:
        if not call.has_limits or (<Data>view).has_ellipse:
            return NO_CALL
    elif (not (call.rules.pivots if problem.law in LAWS_OF_ROWS else call.rules.follows) or problem.has_singular_program
            or len(problem.b) > call.rules.small_rows or (<Blocks>problem.cones._blocks).has_ellipse):
        # Islands of larger problems may take long, so `Prepared` solves them between checks of the clock.
        return NO_CALL
    began, first = read_clock(), impulse
    if impulse is None:
        first = problem.guess
    elif not is_plain_start(impulse, len(problem.b)):
        first = problem.make_start(impulse)
    judged, counts = call.solve(problem, first, tol, deadline)
    if judged is None and counts and view is not None and (<Data>view).reference_energy < 0.0:
        get_zero_impulse_reference(problem)             # The reference of a row needs v*.
        judged, counts = call.solve(problem, first, tol, deadline)
    if judged is not None and (<Judged>judged).relative <= <double>tol and (<Judged>judged).roundoff_floor <= <double>tol:
        kept = first if first is None or impulse is None else first.copy()      # The caller may change the array later.
        fields = {
            "impulse": (<Judged>judged).impulse, "status": CONVERGED, "tol": tol, "setup_time": 0.0,
            "solve_time": read_clock() - began, "_late_residual": (make_residual, (problem, judged)),
            "_rest": (compute_postponed_fields, (problem, spec, judged, counts, kept, CONVERGED)),
        }
        if first is not None:
            fields["start"] = name_start(problem.guess, impulse)
        solution = make_instance(Solution, fields)
    return solution, judged, counts, first


def make_solve(solve_general, solve_after_call, dict registered):
    """Return `lavender.solve`: the compiled call if all arguments have their defaults, otherwise `solve_general`.

    `solve_after_call` solves a problem that the call did not solve.
    """
    def solve(problem, solver="auto", *surplus, impulse=None, tol=1e-6, velocity_tol=None, max_iter=None, time_limit=None,
              history=False, callback=None, **options):
        if (velocity_tol is None and max_iter is None and callback is None and history is False and not options
                and not surplus and type(problem) is Problem and type(tol) is float and type(solver) is str):
            spec = registered.get(solver)
            if time_limit is None and spec is not None:
                solution, _, counts, _ = solve_compiled(problem, spec, impulse, tol)
                return solution if solution is not None else solve_after_call(problem, spec, impulse, tol, counts)
            if spec is not None and type(time_limit) is float and time_limit >= MIN_LONG_LIMIT and spec.small is not None \
                    and len(problem.b) <= (<Call>spec.small.call).rules.small_rows:
                solution = solve_compiled(problem, spec, impulse, tol)[0]
                if solution is not None:
                    return solution
        return solve_general(problem, solver, *surplus, impulse=impulse, tol=tol, velocity_tol=velocity_tol, max_iter=max_iter,
                             time_limit=time_limit, history=history, callback=callback, **options)

    return solve


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
    workspace_t at[N_WORKSPACES]
    derived_t made
    worker_scratch_t scratch
    int64_t begin, next, end        # taken places of the order; those from `next` on are not processed
    int64_t group[MAX_LANES]        # worlds at these places; -1: none
    int32_t failed                  # bit k: lanes have not solved world k of the group
    int32_t pause, idle             # groups without lanes after the last group that lanes did not cover; those to come


cdef struct place_t:            # by which worlds are ordered
    int64_t key
    int64_t order
    int64_t world


cdef int compare_places(const void* first, const void* second) noexcept nogil:
    """Compare two places for `qsort`, which need not be stable."""
    cdef const int64_t* a = <const int64_t*>first
    cdef const int64_t* b = <const int64_t*>second
    cdef int32_t i
    for i in range(3):
        if a[i] != b[i]:
            return -1 if a[i] < b[i] else 1
    return 0


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
    cdef Workspace order            # memory of `order_at`
    cdef const int64_t* order_at    # worlds (n_places) in the order in which they are processed in lanes; -1: none
    cdef int64_t n_places
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
            self.w.array[i] = NULL if arrays[i] is None else (<ndarray>arrays[i]).data
            self.w.narrow[i] = arrays[i] is not None and arrays[i].itemsize == sizeof(float)

    cdef place_t find_place(self, int64_t i) noexcept nogil:
        """Return the place of world i; problems with and without a start, or of two laws, have different keys."""
        cdef place_t place = place_t(0, 0, i)
        cdef worlds_t one
        cdef int64_t at[PLACES]
        cdef task_t* j
        if self.tasks == NULL:
            place.key = compute_structure_key(&self.w, i, &place.order)
        elif self.tasks[i].v.g != NULL and self.tasks[i].v.p.n_rows >= MIN_LISTED_ROWS:
            memset(at, 0, sizeof(at))
            j = &self.tasks[i]
            set_places_of_task(j, at)
            one.at, one.blocks = at, j.v.p
            place.key = compute_structure_key(&one, 0, &place.order)
            if place.key != 0:
                place.key = 4 * place.key + 2 * (j.v.p.law == CONE) + j.cold
        return place

    cdef int order_worlds(self) except -1:
        """Order the worlds by their structure, in groups of MAX_LANES; -1 fills the last group of each structure."""
        cdef int64_t i, k = 0, n = self.w.n, size = 0
        cdef int64_t* order
        cdef Workspace ordered, memory = allocate_bytes(n * sizeof(place_t))
        cdef place_t* place = <place_t*>memory.at
        for i in range(n):
            place[i] = self.find_place(i)
        qsort(place, n, sizeof(place_t), &compare_places)
        for i in range(n):                              # number of places
            size += 1 if size % MAX_LANES == 0 or place[i].key == place[i - 1].key else MAX_LANES - size % MAX_LANES + 1
        size = (size + MAX_LANES - 1) // MAX_LANES * MAX_LANES
        ordered = allocate_bytes(size * sizeof(int64_t))
        order = <int64_t*>ordered.at
        memset(order, 255, size * sizeof(int64_t))      # -1
        for i in range(n):
            if i > 0 and place[i].key != place[i - 1].key:
                k = (k + MAX_LANES - 1) // MAX_LANES * MAX_LANES
            order[k] = place[i].world
            k += 1
        if self.order is None:                          # Another thread may have ordered the worlds.
            self.order, self.order_at, self.n_places = ordered, order, size
        return 0

    def set_from_problems(self, list problems, list data, list starts):
        """Set the worlds from problems and their `list_problem_data`; None defers a problem to the caller."""
        cdef int64_t i
        cdef task_t* j
        self.tasks = <task_t*>calloc(self.w.n + 1, sizeof(task_t))
        if self.tasks == NULL:
            raise MemoryError(f"{self.w.n} problems")
        self.references += [problems, data]
        self.width = count_lanes()
        for i in range(self.w.n):
            p, j = data[i], &self.tasks[i]
            if p is None:
                continue
            if p is True:
                set_task_from_problem(j, problems[i])
            else:
                set_task_from_data(j, p)
            set_task_start(j, starts[i], self.lam + self.w.at[i * PLACES + AT_ROW])

    def store_zero_residuals(self, data):
        """Store the residuals of the zero impulse in the data of solved problems."""
        cdef int64_t i
        for i in range(self.w.n):
            if self.code_at[i] == READY and data[i] is not True:
                store_zero_residual(&self.tasks[i], data[i])

    cdef int32_t convert_world(self, int64_t i, worker_t* h, task_t* j) noexcept nogil:
        """Convert world i for a solve or for the judge; return READY, BAD or LEFT."""
        cdef int32_t code = READY
        if self.tasks != NULL:
            j[0] = self.tasks[i]
            if j.v.p.n_rows == 0:
                return LEFT
            if j.v.g != NULL:
                j.v.g = &j.g
            elif not j.has_derived and j.v.a != NULL:
                j.v.a = &j.a
            elif not j.has_derived:
                j.v.r = &j.r
        else:
            memset(j, 0, sizeof(task_t))
            code = convert_generalized_world(&self.w, i, &h.scratch, &j.v.p, &j.g)
            j.v.g, j.zero_residual[0], j.cold, j.lam = &j.g, -1.0, self.cold, self.lam + self.w.at[i * PLACES + AT_ROW]
        if not j.has_derived and j.v.g != NULL:
            j.made = h.made
        if not grow_workspace_to(&h.at[SLACK_ERROR], 0, 2 * <int64_t>j.v.p.n_rows + 1):
            return LEFT
        j.slack_error = h.at[SLACK_ERROR].real
        return code

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
        """Judge or solve worlds (n_worlds) in lanes as `process_world` does; return their number, -1 without lanes.

        The code of worlds that no lane covers or solves stays LEFT.
        """
        cdef lanes_t x
        cdef lane_rows_t rows
        cdef task_t j
        cdef const worlds_t* w = &self.w
        cdef worlds_t gathered
        cdef int64_t places[MAX_LANES * PLACES]
        cdef int64_t own[MAX_LANES]
        cdef const int64_t* at
        cdef const int64_t* which = worlds
        cdef int32_t lane, k, r, done = 0, width = self.width
        cdef double* lam
        cdef int64_t i, n = self.w.n + 1
        cdef double* v
        x.warm = not self.cold
        if self.tasks != NULL:
            if n_worlds < 2 or self.find_place(worlds[0]).key == 0 \
                    or not gather_tasks(self.tasks, worlds, n_worlds, self.w.at, &h.at[GATHERED], places, &gathered):
                return -1
            for lane in range(n_worlds):
                own[lane] = lane
            w, which, x.warm = &gathered, own, not self.tasks[worlds[0]].cold
        if not arrange_lanes(w, which, n_worlds, width, &x, &rows):
            return -1
        x.asymmetry = w.asymmetry if w.mass_ptr == NULL else -1.0
        if not grow_workspace_to(&h.at[LANES], 0, bind_lanes(&x, width, NULL) + CACHE_LINE_DOUBLES):
            return -1
        # A kernel with vectors that lie across two cache lines takes up to 1.3 times as long.
        bind_lanes(&x, width, <double*>((<size_t>h.at[LANES].real + 63) & ~<size_t>63))
        load_lanes(&x, &rows, w, self.lam, which, n_worlds, width)
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
                add_lane_counts(&x, width, lane, &self.count[N_COUNTS * i])
                if not (j.relative <= tol and j.floor <= tol):
                    h.failed |= 1 << lane
                    continue
                lam = self.lam + at[AT_ROW]
                for k in range(x.m):
                    if rows.row[k * width + lane] >= 0:
                        lam[rows.row[k * width + lane]] = x.lam[k * width + lane]
            r = j.score.worst                           # All errors are 0 if this is an empty row: the first row is as bad.
            j.score.worst = max(rows.row[r * width + lane], 0) if r >= 0 else -1
            self.store_judgement(i, &j, x.e[r * width + lane] if r >= 0 else 0.0)
            if judges:
                self.number[RHS_ENERGY * n + i] = lane_number(&x, LANE_RHS, width, lane)
            v = self.v + at[VELOCITY]
            for k in range(x.n if self.tasks == NULL else 0):
                v[k] = x.free[k * width + lane] + x.push[k * width + lane]
            if self.tasks != NULL:
                memcpy(self.tasks[i].zero_residual, j.zero_residual, sizeof(j.zero_residual))
            self.code_at[i] = READY
            done += 1
        return done

    cdef int32_t process_world(self, int64_t i, worker_t* h, double tol, const limits_t* limits, const small_rules_t* rules,
                               deadline_t* deadline, bint judges, bint narrow) noexcept nogil:
        """Solve world i, or judge its start, store its result and return its status. Only a solve accepts empty rows.

        narrow: judge with the round-off floor of float32.
        """
        cdef task_t j
        cdef const int64_t* at = self.w.at + i * PLACES
        cdef double* v = self.v + at[VELOCITY]
        cdef int32_t k, code
        cdef bint had_derived
        if not judges and (limits == NULL if self.tasks == NULL or self.tasks[i].v.g != NULL else rules == NULL):
            return LEFT
        code = self.convert_world(i, h, &j)
        if code != READY:
            return code
        if j.v.p.n_rows == 0:                           # v+ = v*
            memcpy(v, h.scratch.free, at[VELOCITIES] * sizeof(double))
            return READY
        had_derived, j.deadline = j.has_derived, deadline
        j.tol, j.failed_in_lanes = tol, h.failed >> (h.next - 1 - h.begin) & 1
        memcpy(j.counts, &self.count[N_COUNTS * i], sizeof(j.counts))       # work of a lane that has failed
        code = self.judge_start(i, h, &j, narrow) if judges else solve_task(&j, h.at, limits, rules)
        if j.v.g != NULL and not had_derived:
            h.made = j.made                             # The next world reuses the memory of `made`.
        if code == READY or code == STARTED:
            self.store_judgement(i, &j, j.slack_error[j.v.p.n_rows + j.score.worst] if j.score.worst >= 0 else 0.0)
            for k in range(at[VELOCITIES] if self.tasks == NULL else 0):        # v+ after the step, for worlds of arrays
                v[k] = h.scratch.free[k] + j.push[k]
        if judges:
            return code
        if code != LEFT:
            memcpy(&self.count[N_COUNTS * i], j.counts, sizeof(j.counts))
        if self.tasks != NULL and j.v.p.islands == NULL:    # The next world reuses the memory of islands.
            for k in range(3):
                self.tasks[i].zero_residual[k] = j.zero_residual[k]
        return code

    cdef int32_t judge_start(self, int64_t i, worker_t* h, task_t* j, bint narrow) noexcept nogil:
        """Judge the start of world i, refined for tol; return READY or LEFT."""
        cdef int32_t k, m = j.v.p.n_rows
        cdef double* x
        if (narrow and j.v.g == NULL or not prepare_task(j, h.at) or j.made.n_empty
                or not grow_workspace_to(&h.at[WORK], 0, max(count_task_scratch(j), 4 * <int64_t>m + 5 * j.g.n))
                or not grow_workspace_to(&h.at[BY_ISLAND], 0, 2 * <int64_t>j.v.p.n_blocks)):
            return LEFT
        x = h.at[WORK].real
        if j.cold:
            set_zero_impulse(&j.v.p, j.lam, j.slack_error)
        j.by_island = h.at[BY_ISLAND].real
        judge_task(j, x)
        if narrow:
            x += j.g.n                                  # after M^-1 J^T lam
            compute_squared_float32_rounding(&j.v.p, &j.g, &h.scratch.mass, h.scratch.free, j.lam, x, x + m, x + 2 * m, x + 3 * m)
            for k in range(m):
                x[k] = x[k] + x[m + k] + x[2 * m + k]
            j.floor = float32_floor_of_score(&j.v.p, x, &j.score, j.relative, j.zero_residual[0], j.zero_residual[1],
                                             &j.above_floor)
        self.number[RHS_ENERGY * (self.w.n + 1) + i] = compute_rhs_energy_norm(&j.v.p)
        return READY

    cdef bint judge_motion_of_world(self, int64_t i, worker_t* h, double tol, double max_stiff_ratio, double max_excused,
                                    const double** engine, motion_error_t* out) noexcept nogil:
        """Judge the motion of world i (`motion.pxd`), whose start is exact; engine (3): arrays of `motion_t` of all worlds."""
        cdef task_t j
        cdef motion_t x
        cdef const int64_t* at = self.w.at + i * PLACES
        if self.tasks != NULL or self.convert_world(i, h, &j) != READY or j.v.p.n_rows == 0:
            return False
        j.tol = tol
        if self.judge_start(i, h, &j, False) != READY:
            h.made = j.made
            return False
        h.made = j.made                                 # The next world reuses the memory of `made`.
        x.impulse, x.compliance = engine[0] + at[AT_ROW], engine[2] + at[AT_ROW]
        x.change = engine[1] + at[VELOCITY]
        return j.relative <= tol and judge_motion(&j, h.scratch.free, &x, max_stiff_ratio, max_excused, h.at, out)

    cdef bint adjoin_world(self, int64_t i, worker_t* h, int32_t max_rows, double max_residual,
                           const double** y, double** out) noexcept nogil:
        """Compute the results of `adjoin_task` of world i; y (3) are cotangents of all worlds or NULL, out (6) the results."""
        cdef task_t j
        cdef cotangents_t of_world
        cdef adjoint_t results
        cdef const int64_t* at = self.w.at + i * PLACES
        cdef int64_t r = at[AT_ROW], v = at[VELOCITY]
        cdef int32_t k
        cdef bint is_done
        if self.tasks != NULL or self.convert_world(i, h, &j) != READY:
            return False
        of_world.velocity = y[0] + v if y[0] != NULL else NULL
        of_world.impulse = y[1] + r if y[1] != NULL else NULL
        of_world.slack = y[2] + r if y[2] != NULL else NULL
        results.q, results.s, results.e = out[0] + r, out[1] + r, out[2] + r
        results.f, results.p, results.change = out[3] + v, out[4] + v, out[5] + v
        if j.v.p.n_rows == 0:                           # v+ = v*
            for k in range(at[VELOCITIES]):
                results.f[k] = results.p[k] = of_world.velocity[k] if of_world.velocity != NULL else 0.0
            solve_mass_matrix(&j.g, results.p)
            return True
        is_done = adjoin_task(&j, h.at, j.lam, max_rows, max_residual, &of_world, &results)
        h.made = j.made                                 # The next world reuses the memory of `made`.
        return is_done

    def __dealloc__(self):
        free(self.tasks)


def adjoin_worlds(Worlds worlds, int32_t max_rows, double max_residual, cotangents, results):
    """Compute the results of `adjoint.pxd` (1) at the starts of worlds that are given by arrays.

    Parameters
    ----------
    worlds : Worlds
    max_rows : int
        Largest system that is factored.
    max_residual : float, -
        Largest relative residual of a solution.
    cotangents : sequence of 3
        Flat arrays of all worlds, by v+, lambda and w, or None.
    results : sequence of 6
        Flat arrays for q, s, e of all rows and f, p, v' of all velocities, filled with zeros.

    Returns
    -------
    list of int
        Worlds that the caller must differentiate by themselves.
    """
    cdef Worker worker = Worker(worlds, b"\0")
    cdef const double* y[3]
    cdef double* out[6]
    cdef int64_t i, n = worlds.w.n
    cdef int32_t k
    cdef list left = []
    cdef Py_ssize_t rows = worlds.impulse.size, velocities = worlds.velocity.size
    for k in range(3):
        y[k] = NULL
        if cotangents[k] is not None:
            y[k] = as_double_pointer(cotangents[k], rows if k else velocities)
    for k in range(6):
        out[k] = as_double_pointer(results[k], rows if k < 3 else velocities)
    for i in range(n):
        with nogil:
            k = worlds.adjoin_world(i, &worker.h, max_rows, max_residual, y, out)
        if not k:
            left.append(i)
        if i % INTERRUPT_CHECK_WORLDS == 0:
            PyErr_CheckSignals()
    return left


def judge_motions(Worlds worlds, double tol, double max_stiff_ratio, double max_excused, engine, list indices, numbers,
                  int32_t[::1] worst):
    """Judge the motions of an engine in some worlds, and write their numbers in place of those of the forces.

    Parameters
    ----------
    worlds : Worlds
        Their starts are exact, to the relative residual `tol`.
    engine : sequence of 3
        Flat arrays of all worlds: the engine's impulses, velocity changes and compliances (`motion.pxd`).
    indices : list of int
        Worlds to be judged.
    numbers, worst
        Arrays of the `Worlds` that receive the results.

    Returns
    -------
    list of int
        Worlds that the caller must judge by themselves.
    """
    cdef Worker worker = Worker(worlds, b"\0")
    cdef const double* x[3]
    cdef double[:, ::1] out = numbers
    cdef motion_error_t found
    cdef list left = []
    cdef int64_t i
    cdef bint is_done
    x[0] = as_double_pointer(engine[0], worlds.impulse.size)
    x[1] = as_double_pointer(engine[1], worlds.velocity.size)
    x[2] = as_double_pointer(engine[2], worlds.impulse.size)
    for i in indices:
        with nogil:
            is_done = worlds.judge_motion_of_world(i, &worker.h, tol, max_stiff_ratio, max_excused, x, &found)
        if not is_done:
            left.append(i)
            continue
        out[RELATIVE, i], out[FLOOR, i], out[ABOVE_FLOOR, i] = found.relative, found.floor, found.above_floor
        out[ENERGY, i], out[SPEED, i], out[PUSH, i] = found.energy, found.velocity, found.push
        worst[i] = found.worst
    return left


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
        free_workspaces(self.h.at, N_WORKSPACES)
        free_workspace(&self.h.scratch.workspace)
        free_workspace(&self.h.scratch.tree)
        free(self.h.made.marks)
        free(self.h.made.numbers)

    cpdef int64_t process_worlds(self, double tol, Call call=None, deadline=None, bint judges=False, bint narrow=False) except? -3:
        """Solve worlds, or judge their impulses. Return the index of the first deferred world, or DONE_ALL if no world is left.

        Without a call all worlds are deferred, and without its limits all worlds of J and M. At the deadline the present
        iterate of a world is its result, and the starts of the worlds after it are judged. narrow: judge with the round-off
        floor of float32.
        """
        cdef Worlds w = self.worlds
        cdef const limits_t* limits = &call.limits if call is not None and call.has_limits else NULL
        cdef const small_rules_t* rules = &call.rules if call is not None else NULL
        cdef const int64_t* order = NULL
        cdef int64_t i, n = w.w.n
        cdef int32_t code, n_group, n_done = 0
        cdef bint is_late, uses_lanes = not narrow and w.tasks == NULL     # Single judgements of a list take as long.
        cdef deadline_t own                             # Other threads read the clock for themselves.
        cdef deadline_t* until = get_pointer(deadline)
        if until != NULL:
            own = until[0]
            until = &own
        if not judges:          # Problems of a list share groups only in the order by structure.
            uses_lanes = limits != NULL and limits.lanes != 0.0 and (w.tasks == NULL or until == NULL)
        if uses_lanes and w.width > 1 and until == NULL:        # With a limit of time, worlds are solved in their own order.
            if w.order is None:                         # Only lanes need the order.
                w.order_worlds()
            order, n = w.order_at, w.n_places
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
                else:
                    is_late = has_passed(until, reading_interval())
                    code = w.process_world(i, &self.h, tol, limits, rules, until, judges or is_late, narrow)
                    if is_late and code == READY:
                        code = LATE
                w.code_at[i] = <signed char>code
                if code == LEFT or code == TRIED:
                    return i
                n_done += 1
                if n_done % INTERRUPT_CHECK_WORLDS == 0:
                    with gil:
                        PyErr_CheckSignals()
        return DONE_ALL
