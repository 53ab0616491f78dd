"""Many problems in generalised coordinates, one after the other without the interpreter: prepare, solve, judge.

The same kernels in the same order as on one problem alone (`generalized/newton.pyx`), so the same bits and counts. Of
what is worked out of a problem's data the error of doing nothing stays with it; d and Y are made in the same room for
one after the other, since fresh pages for each cost more than both. A problem that does not end below tol on the judge's
own measure, has empty rows or is counted to cost more than is asked for, is left to the caller.
"""
from cpython.exc cimport PyErr_CheckSignals
from libc.stdint cimport int32_t
from libc.stdlib cimport calloc, free, malloc
from libc.string cimport memcpy

import numpy as np

from lavender_ext.core.block cimport COULOMB, ROW, blocks_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.problem cimport MADE, Data, made_t, make_numbers
from lavender_ext.core.view cimport view_t
from lavender_ext.generalized.islands cimport aim_at, furnish, marks_of, need_t, numbers_of, settle
from lavender_ext.generalized.flow cimport flow_t
from lavender_ext.generalized.newton cimport DONE, descend_all
from lavender_ext.generalized.sparse cimport PER_COLUMN
from lavender_ext.judge.measure cimport do_nothing, general_judge, judge_nothing, judged_from, relative_of
from lavender_ext.judge.score cimport relative, score_t


cdef enum:
    LEFT = 0                    # to the caller
    SOLVED = 1

cdef enum:
    STEPS = 64                  # of newton in all, and
    OF_EACH = 4                 # for each island; as many as `newton` has by default at most
    MOST = 1500
    AT_A_TIME = 256             # problems between two looks for Ctrl-C


cdef struct gate_t:             # what Newton's method may be counted to cost [ns] to be asked at all
    double start
    double row[4]               # by law: linear, lcp, coulomb, cone
    double factor[4]
    double count[4]             # factorisations by law
    double most[4]              # by law


cdef struct job_t:
    blocks_t p
    generalized_t g
    made_t made                 # of the data, or in this call; NULL between
    double begin[3]             # E0, V0, relative residual of doing nothing; E0 < 0 where not known
    int32_t law                 # as `gate_t.count`
    int32_t cold                # 1: from doing nothing, else from lam as it is
    int32_t end
    int32_t counts[5]           # steps, factorisations, updates, rounds, evaluations
    double* lam                 # (m)
    double* both                # (2 m + 1) w, e
    score_t score
    double relative, floor


cdef struct space_t:            # one after the other in the same room
    int32_t* marks
    ssize_t n_marks
    double* numbers
    ssize_t n_numbers


cdef inline int32_t with_numbers(space_t* s, ssize_t n) noexcept nogil:
    if n > s.n_numbers:
        free(s.numbers)
        s.n_numbers = 2 * n
        s.numbers = <double*>malloc(s.n_numbers * sizeof(double))
        if s.numbers == NULL:
            s.n_numbers = 0
            return 0
    return 1


cdef inline int32_t with_marks(space_t* s, ssize_t n) noexcept nogil:
    if n > s.n_marks:
        free(s.marks)
        s.n_marks = 2 * n
        s.marks = <int32_t*>malloc(s.n_marks * sizeof(int32_t))
        if s.marks == NULL:
            s.n_marks = 0
            return 0
    return 1


cdef inline void begin(job_t* j, double* w) noexcept nogil:
    """E0, V0 and the relative residual of doing nothing; w (3 m + n) is scratch."""
    cdef view_t v = view_t(j.p, NULL, NULL, &j.g)
    cdef ssize_t m = j.p.n_rows
    judge_nothing(&v, w + 2 * m, w, w + m, w + 3 * m, False, j.begin)


cdef inline bint is_cheap(const job_t* j, const gate_t* gate, int32_t largest) noexcept nogil:
    """`general_cost` of lavender/solvers/small.py, in the same order of operations, is no more than the gate lets in."""
    cdef double flops = <double>j.g.n * (<double>largest * <double>largest) / 6.0
    if j.law == 2:
        flops = 2.0 * flops
    return gate.start + gate.count[j.law] * (gate.row[j.law] * j.p.n_rows + gate.factor[j.law] * flops) <= gate.most[j.law]


cdef inline void solve_made(job_t* j, space_t* space, const gate_t* gate, double tol, double most) noexcept nogil:
    cdef flow_t f
    cdef need_t need
    cdef int32_t m = j.p.n_rows, end, i, steps
    cdef bint cold = j.cold
    if j.made.n_empty:
        return
    if j.begin[0] < 0.0:
        if not with_numbers(space, 3 * <ssize_t>m + j.g.n):
            return
        begin(j, space.numbers)
    if not with_marks(space, marks_of(&j.p, &j.g, PER_COLUMN)):
        return
    settle(&f, &j.p, &j.g, PER_COLUMN, space.marks, &need)
    if need.crowded or need.values > most or not is_cheap(j, gate, need.wide):
        return
    if not with_numbers(space, numbers_of(&f, &need)):
        return
    furnish(&f, &need, space.numbers)
    if cold:
        do_nothing(&j.p, j.lam, j.both)
    else:                                               # doing nothing, given as a start, is cold as well
        cold = True
        for i in range(m):
            if j.lam[i] != 0.0:
                cold = False
                break
        if not cold:
            do_nothing(&j.p, j.both, j.both + m)
            cold = True
            for i in range(m):
                if j.lam[i] != j.both[i]:
                    cold = False
                    break
    steps = MOST
    if f.n_islands < (MOST - STEPS) / OF_EACH:
        steps = STEPS + OF_EACH * f.n_islands
    aim_at(&f, tol, steps, j.begin[0], j.begin[1])
    end = descend_all(&f, j.lam, cold)
    j.counts[0] = steps - f.steps
    if end != DONE:
        return
    j.counts[1] = f.factorisations
    j.counts[2] = f.updates
    j.counts[3] = f.rounds
    j.counts[4] = f.evaluations
    if not with_numbers(space, <ssize_t>j.g.n + m):
        return
    j.score = score_t(0.0, 0.0, 0.0, 0.0, -1, 1)
    general_judge(&j.p, &j.g, j.lam, j.both, j.both + m, space.numbers, True, &j.score)
    j.relative = relative_of(&j.score, j.both, m, j.begin[0], j.begin[1])
    j.floor = relative(j.score.floor_energy, j.score.floor_velocity, j.begin[0], j.begin[1])
    if j.relative <= tol:
        j.end = SOLVED


cdef inline void solve_job(job_t* j, space_t* space, const gate_t* gate, double tol, double most) noexcept nogil:
    cdef bint known = j.made.marks != NULL
    if not known and make_numbers(&j.p, &j.g, &j.made) != MADE:
        return
    solve_made(j, space, gate, tol, most)
    if not known:
        free(j.made.marks)
        free(j.made.numbers)
    j.made.marks = NULL
    j.made.numbers = NULL


cdef inline int32_t law_of(const blocks_t* p) noexcept nogil:
    """0 where every row is free, 1 where bounds are constants, 2 with Coulomb's friction, 3 with the cone's."""
    cdef int32_t i, k, law = 0
    cdef double inf = 1.0 / 0.0
    for i in range(p.n_blocks):
        if p.kind[i] != ROW:
            if p.ptr[i + 1] - p.ptr[i] > 1:
                return 2 if p.law == COULOMB else 3
            law = 1
        elif law == 0:
            for k in range(p.ptr[i], p.ptr[i + 1]):
                if p.lower[k] != -inf or p.upper[k] != inf:
                    law = 1
                    break
    return law


cdef class Gate:
    """What Newton's method may be counted to cost to be asked, in the words of `general_cost`.

    Parameters
    ----------
    rates : tuple (start, rows, factors, counts)
        ns; by law.
    most : tuple
        ns; by law.
    """
    cdef gate_t at

    def __init__(self, rates, most):
        self.at.start, rows, factors, counts = rates
        for i in range(4):
            self.at.row[i], self.at.factor[i], self.at.count[i], self.at.most[i] = rows[i], factors[i], counts[i], most[i]


def solve_first(Data p, start, double tol, Gate gate, double most):
    """A problem of at least one row that nobody has looked at: what is worked out of its data, solved, judged, at once.

    From `start` (m,) [N s], or from doing nothing where it is None. What the judge finds and the counts, as
    `Batch.judged`; False where it does not end below tol, None where it was not tried: it has empty rows or costs more than
    the gate lets in. d, Y and the error of doing nothing stay with the data.
    """
    cdef job_t j
    cdef space_t space
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef double[::1] lam, both
    cdef const double[::1] given
    cdef made_t made
    cdef bint known = p.ready
    impulse = np.empty(m)
    results = np.empty(2 * m + 1)
    lam = impulse
    both = results
    j.p = p.blocks
    j.g = p.general
    j.begin[0] = p.start_energy
    j.begin[1] = p.start_velocity
    j.begin[2] = p.start_relative
    j.law = law_of(&j.p)
    j.cold = start is None
    if not j.cold:
        given = start
        memcpy(&lam[0], &given[0], m * sizeof(double))
    j.lam = &lam[0]
    j.both = &both[0]
    j.end = LEFT
    j.counts[0] = 0
    space.marks = NULL
    space.numbers = NULL
    space.n_marks = space.n_numbers = 0
    with nogil:
        if known or make_numbers(&j.p, &j.g, &made) == MADE:
            if not known:
                j.made = made
            else:
                j.made = p.made
            solve_made(&j, &space, &gate.at, tol, most)
        else:
            j.end = -1
    free(space.marks)
    free(space.numbers)
    if j.end < 0:
        return None                                     # which `prepare` puts in words
    if not known:
        p.adopt(&made)
    if p.start_energy < 0.0 and j.begin[0] >= 0.0:
        p.set_start(j.begin[0], j.begin[1])
        p.start_relative = j.begin[2]
    if j.end != SOLVED:
        return False if j.counts[0] > 0 else None
    return judged_from(p, impulse, results, &j.score, j.relative, j.floor), (
        j.counts[0], j.counts[1], j.counts[2], j.counts[3], j.counts[4])


cdef class Batch:
    """Problems and what came of them; `run` once.

    Parameters
    ----------
    data : list of Data
        In generalised coordinates, each of a problem of at least one row.
    starts : list of (m,) N s or None
        None: from doing nothing.
    gate : Gate
    most : float
        Values of one island's N, as of `Newton`.
    """

    cdef job_t* jobs
    cdef Py_ssize_t n
    cdef space_t space
    cdef list data
    cdef object impulses, both
    cdef gate_t gate
    cdef double tol, most

    def __init__(self, list data, list starts, double tol, Gate gate, double most):
        cdef Py_ssize_t i, at = 0, n = len(data)
        cdef Data p
        cdef job_t* j
        cdef double[::1] whole, measured
        cdef const double[::1] given
        self.data, self.tol, self.most = data, tol, most
        self.gate = gate.at
        for i in range(n):
            p = data[i]
            at += p.blocks.n_rows
        self.jobs = <job_t*>calloc(n if n else 1, sizeof(job_t))
        if self.jobs == NULL:
            raise MemoryError(f"{n} problems")
        self.n = n
        self.impulses = whole = np.empty(at + 1)
        self.both = measured = np.empty(2 * at + n + 1)
        at = 0
        for i in range(n):
            p = data[i]
            j = &self.jobs[i]
            j.p = p.blocks
            j.g = p.general
            j.begin[0] = j.begin[1] = j.begin[2] = -1.0
            if p.ready:
                j.made = p.made
                j.begin[0] = p.start_energy
                j.begin[1] = p.start_velocity
            j.law = law_of(&j.p)
            j.lam = &whole[0] + at
            j.both = &measured[0] + 2 * at + i
            j.cold = starts[i] is None
            if not j.cold:
                given = starts[i]
                if given.shape[0] != j.p.n_rows:
                    raise ValueError(f"{given.shape[0]} numbers for {j.p.n_rows} rows")
                memcpy(j.lam, &given[0], j.p.n_rows * sizeof(double))
            at += j.p.n_rows

    def __dealloc__(self):
        free(self.jobs)
        free(self.space.marks)
        free(self.space.numbers)

    def run(self):
        """Solve; how many were."""
        cdef Py_ssize_t i = 0, end, solved = 0
        cdef Data p
        cdef job_t* j
        while i < self.n:
            end = i + AT_A_TIME if i + AT_A_TIME < self.n else self.n
            with nogil:
                while i < end:
                    if self.jobs[i].p.n_rows > 0:
                        solve_job(&self.jobs[i], &self.space, &self.gate, self.tol, self.most)
                    i += 1
            PyErr_CheckSignals()
        for i in range(self.n):
            j = &self.jobs[i]
            p = self.data[i]
            if j.end != SOLVED:
                continue
            solved += 1
            if p.start_energy < 0.0:
                p.set_start(j.begin[0], j.begin[1])
                p.start_relative = j.begin[2]
        return solved

    def hand_out(self, type kind, function, common, list at, list made):
        """Into `made`, at the places `at`, an empty `kind` for each problem solved, which knows how to fill itself.

        Its `_rest` is (function, (common, i)).
        """
        cdef Py_ssize_t i
        for i in range(self.n):
            if self.jobs[i].end == SOLVED:
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
        return judged_from(self.data[i], impulse, self.both[at:at + 2 * m + 1].copy(), &j.score, j.relative, j.floor), (
            j.counts[0], j.counts[1], j.counts[2], j.counts[3], j.counts[4])
