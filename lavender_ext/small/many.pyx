"""Problems in generalised coordinates, one or many, one after the other without the interpreter: prepare, solve, judge.

The same kernels in the same order as on one problem alone (`generalized/newton.pyx`), so the same bits and counts. What
does not end below tol on the judge's own measure, has an empty row that b asks for or is counted to cost more than is
asked for, is left to the caller.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.block cimport COULOMB, ROW, blocks_t, has_friction
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.problem cimport MADE, Data, made_t, make_numbers
from lavender_ext.core.view cimport view_t
from lavender_ext.driver.driver cimport room_t
from lavender_ext.small.room cimport has_room
from lavender_ext.generalized.flow cimport flow_t
from lavender_ext.generalized.islands cimport aim_at, furnish, marks_of, need_t, numbers_of, settle
from lavender_ext.generalized.newton cimport DONE, SPENT, descend_all
from lavender_ext.generalized.sparse cimport per_column
from lavender_ext.judge.measure cimport do_nothing, general_judge, judge_nothing, judged_from, relative_of
from lavender_ext.judge.score cimport relative, score_t


cdef enum:
    STEPS = 128                 # of newton for each island, and in all as many as `newton` has by default
    MOST = 1500
    AT_A_TIME = 256             # problems between two checks for Ctrl-C


cdef struct limits_t:           # ns, as in lavender/solvers/costs.py
    double entry                # each multiply-add of a sweep, and
    double work                 # of a factor,
    double bounded              # factorisations by law
    double coulomb
    double cone
    double values               # of one island's N
    double most                 # what all may cost to be asked at all


cdef struct job_t:
    blocks_t p
    generalized_t g
    made_t made                 # of the data, or in this call; NULL between
    double begin[3]             # E0, V0, relative residual of doing nothing; E0 < 0 where not known
    int32_t cold                # 1: from doing nothing, else from lam as it is
    double most                 # ns that it may cost as counted, then what it has come to is the result; inf: to the end
    bint solved
    bint spent                  # what it might cost is
    int32_t counts[4]           # steps, factorisations, rounds, evaluations
    double* lam                 # (m)
    double* both                # (2 m + 1) w, e
    score_t score
    double relative, floor


cdef inline void begin(job_t* j, double* w) noexcept nogil:
    """E0, V0 and the relative residual of doing nothing; w (3 m + n) is scratch."""
    cdef view_t v = view_t(j.p, NULL, NULL, &j.g)
    cdef ssize_t m = j.p.n_rows
    judge_nothing(&v, w + 2 * m, w, w + m, w + 3 * m, False, j.begin)


cdef inline double step_cost(const blocks_t* p, const generalized_t* g, const limits_t* l, double work) noexcept nogil:
    """One factor of each island, of so many multiply-adds in all [ns]."""
    return l.entry * (2.0 * g.pval[g.n_panels] + 4.0 * p.n_rows) + l.work * work


cdef inline double cost_of(const blocks_t* p, const generalized_t* g, const limits_t* l, double work) noexcept nogil:
    """What Newton's method is counted to cost [ns]: the one gate, for one problem and for many."""
    cdef double count = l.bounded
    if has_friction(p):
        count = l.coulomb if p.law == COULOMB else l.cone
    return count * step_cost(p, g, l, work)


cdef inline bint is_cheap(job_t* j, const limits_t* l, double work, int32_t* steps) noexcept nogil:
    """Is it? No more steps then than `most` of the job is for, counted as if each were of all islands."""
    cdef double fit = j.most / step_cost(&j.p, &j.g, l, work)
    if fit < steps[0]:
        j.spent, steps[0] = True, <int32_t>max(fit, 0.0)
    return cost_of(&j.p, &j.g, l, work) <= l.most


cdef inline bint settle_empty_rows(const job_t* j, double tol) noexcept nogil:
    """Rows of zeros at the bound that b asks for, as `decide_empty_rows` of lavender/outcome.py.

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
            if p.b[k] == 0.0 or (p.kind[i] != ROW and k > p.ptr[i]):
                continue                                # asks nothing: tangents and spin have bounds of mu lambda_n
            bound = p.upper[k] if p.b[k] > 0.0 else p.lower[k]
            if fabs(bound) < INFINITY:
                j.lam[k] = bound
            elif fabs(p.b[k]) * sqrt(p.nu[k] / p.d[k]) > tol * j.begin[1]:
                return False
    return True


cdef inline void solve_job(job_t* j, room_t* room, const limits_t* limits, double tol) noexcept nogil:
    cdef flow_t f
    cdef need_t need
    cdef int32_t m = j.p.n_rows, steps = MOST, per = per_column(j.g.n), code
    if j.made.marks == NULL and make_numbers(&j.p, &j.g, &j.made) != MADE:
        return
    if not has_room(room, marks_of(&j.p, &j.g, per), 3 * <ssize_t>m + j.g.n):
        return
    if j.begin[0] < 0.0:
        begin(j, room.real)
    settle(&f, &j.p, &j.g, per, room.index, &need)
    if f.n_islands <= MOST // STEPS:
        steps = STEPS * f.n_islands
    if need.crowded or need.values > limits.values or not is_cheap(j, limits, need.work, &steps):
        j.spent = False
        return
    if not has_room(room, 0, numbers_of(&f, &need)):
        return
    furnish(&f, &need, room.real)
    if j.cold:
        do_nothing(&j.p, j.lam, j.both)
    if j.made.n_empty and not settle_empty_rows(j, tol):
        j.spent = False
        return
    aim_at(&f, tol, steps, j.begin[0], j.begin[1])
    code = descend_all(&f, j.lam)
    j.spent = j.spent and code == SPENT
    if code != DONE and not j.spent:
        return
    j.counts[0], j.counts[1], j.counts[2], j.counts[3] = steps - f.steps, f.factorisations, f.rounds, f.evaluations
    if not has_room(room, 0, <ssize_t>j.g.n + m):
        return
    j.score = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    general_judge(&j.p, &j.g, j.lam, j.both, j.both + m, room.real, True, &j.score)
    j.relative = relative_of(&j.score, j.both, m, j.begin[0], j.begin[1])
    j.floor = relative(j.score.floor_energy, j.score.floor_velocity, j.begin[0], j.begin[1])
    j.solved = j.relative <= tol


cdef inline void solve_alone(job_t* j, room_t* room, const limits_t* limits, double tol) noexcept nogil:
    """One of many: what was worked out of its data goes with it."""
    cdef bint known = j.made.marks != NULL
    if j.p.n_rows > 0:
        solve_job(j, room, limits, tol)
    if not known:
        free(j.made.marks)
        free(j.made.numbers)
    j.made.marks = NULL
    j.made.numbers = NULL


cdef int take(job_t* j, Data p, start, double* lam, double* both) except -1:
    """The problem of `p` from `start` (m,) [N s], or from doing nothing where it is None."""
    cdef const double[::1] given
    j.p, j.g = p.blocks, p.general
    j.made.marks = NULL
    j.made.numbers = NULL
    if p.ready:
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
    """(What the judge found, counts as of `Newton.run`); doing nothing is kept with the data."""
    return judged_from(p, impulse, both, &j.score, j.relative, j.floor), (
        j.counts[0], j.counts[1], j.counts[2], j.counts[3])


cdef void remember(job_t* j, Data p):
    if p.start_energy < 0.0 and j.begin[0] >= 0.0:
        p.set_start(j.begin[0], j.begin[1])
        p.start_relative = j.begin[2]


cdef class Limits:
    """Of the numbers of a `limits_t` (7,)."""
    cdef limits_t at

    def __init__(self, const double[::1] numbers):
        self.at = (<const limits_t*>&numbers[0])[0]

    def cost(self, Data p, double work):
        """What Newton's method is counted to cost [ns], `work` multiply-adds of a factor of each island; and of a step."""
        return cost_of(&p.blocks, &p.general, &self.at, work), step_cost(&p.blocks, &p.general, &self.at, work)

    @property
    def most(self):
        """What it may cost to be asked at all [ns]."""
        return self.at.most


def solve_first(Data p, start, double tol, Limits limits, double most=INFINITY):
    """A problem of at least one row of which nothing was worked out: what is worked out of its data, solved, judged, at once.

    What the judge finds and the counts, as `Batch.judged`; None where it does not end below tol, an empty row cannot be
    met or it costs more than the limits (`limits_t`) let in; most: counted cost [ns] where what was found by then is the
    result. d, Y and the error of doing nothing stay with the data.
    """
    cdef job_t j
    cdef room_t room = room_t(0, 0, NULL, NULL)
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef double[::1] lam, both
    cdef bint known = p.ready
    impulse, results = np.empty(m), np.empty(2 * m + 1)
    lam, both = impulse, results
    take(&j, p, start, &lam[0], &both[0])
    j.most = most
    with nogil:
        solve_job(&j, &room, &limits.at, tol)
        free(room.index)
        free(room.real)
    if not known and j.made.numbers != NULL:
        p.adopt(&j.made)
    remember(&j, p)
    return result(&j, p, impulse, results) if j.solved or j.spent else None


cdef class Batch:
    """Problems and what came of them; of what is worked out of their data the error of doing nothing stays with it.

    Parameters
    ----------
    data : list of Data
        In generalised coordinates, each of a problem of at least one row.
    starts : list of (m,) N s or None
        None: from doing nothing.
    limits : Limits
    stop : (1,) bytes
        What is not begun when it becomes nonzero is left to the caller: Ctrl-C comes to another thread than this.
    """

    cdef job_t* jobs
    cdef list data
    cdef object impulses, both

    def __init__(self, list data, list starts, double tol, Limits limits, const unsigned char[::1] stop):
        cdef Py_ssize_t i, end, done = 0, at = 0, n = len(data)
        cdef room_t room = room_t(0, 0, NULL, NULL)
        cdef Data p
        cdef double[::1] whole, measured
        self.data = data
        for p in data:
            at += p.blocks.n_rows
        self.jobs = <job_t*>calloc(n + 1, sizeof(job_t))
        if self.jobs == NULL:
            raise MemoryError(f"{n} problems")
        self.impulses = whole = np.empty(at + 1)
        self.both = measured = np.empty(2 * at + n + 1)
        at = 0
        try:
            for i in range(n):
                p = data[i]
                take(&self.jobs[i], p, starts[i], &whole[0] + at, &measured[0] + 2 * at + i)
                at += p.blocks.n_rows
            while done < n and not stop[0]:
                end = done + AT_A_TIME if done + AT_A_TIME < n else n
                with nogil:
                    while done < end and not stop[0]:
                        solve_alone(&self.jobs[done], &room, &limits.at, tol)
                        done += 1
                PyErr_CheckSignals()
        finally:
            free(room.index)
            free(room.real)
        for i in range(n):
            remember(&self.jobs[i], data[i])

    def __dealloc__(self):
        free(self.jobs)

    def hand_out(self, type kind, function, common, list at, list made):
        """Into `made`, at the places `at`, an empty `kind` for each problem solved, which knows how to fill itself.

        Its `_rest` is (function, (common, i)).
        """
        cdef Py_ssize_t i
        for i in range(len(at)):
            if self.jobs[i].solved:
                x = object.__new__(kind)
                x.__dict__["_rest"] = (function, (common, i))
                made[at[i]] = x

    def judged(self, Py_ssize_t i):
        """What the judge found of problem i, solved, with its impulse (m,) [N s]; and its counts, as `Newton.run`."""
        cdef job_t* j = &self.jobs[i]
        cdef Py_ssize_t at = j.lam - self.jobs[0].lam, m = j.p.n_rows
        impulse = self.impulses[at:at + m].copy()
        impulse.setflags(write=False)
        at = j.both - self.jobs[0].both
        return result(j, self.data[i], impulse, self.both[at:at + 2 * m + 1].copy())
