"""Problems of few rows given by bodies or as A: look, solve and judge in one call, with what is prepared kept.

    pivots       the factor of A, linear or boxed, with one shift where it is singular, and its refinement
                 (pivot/direct.pyx); where exchanges are stuck Lemke's path, if asked for       (pivot/tableau.pyx)
    sweeps       the first look of accelerated sweeps                                   (accelerate/accelerated.pyx)

The same kernels in the same order as the solvers call them on any problem, Lemke's path aside, so the same bits and
counts. What does not end as one hopes, below tol on the judge's own measure, is nobody's result: the caller starts
again the long way.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t
from libc.string cimport memcpy

import numpy as np

from lavender_ext.accelerate.accelerated import allocate
from lavender_ext.accelerate.accelerated import run as accelerate
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport view_t
from lavender_ext.judge.measure cimport Judged
from lavender_ext.judge.measure import same_bits, velocity_change
from lavender_ext.judge.watch import Watch
from lavender_ext.local import gauss_seidel
from lavender_ext.pivot.direct cimport (HALVED, after_rounds, direct_begin, direct_begin_passes, direct_factor, direct_first,
                                        direct_index, direct_lay, direct_linear, direct_pass, direct_real, direct_t, is_end,
                                        judge_now)
from lavender_ext.pivot.principal cimport INDEFINITE, SMALL, SOLVED, pivots_rounds, pivots_start
from lavender_ext.pivot.tableau import DONE as FOLLOWED
from lavender_ext.pivot.tableau import follow as lemke

TINY = 1e-11                    # of the largest entry of a column, as `lemke` has it


cdef enum:
    SWEEPS = 2                  # that guess the free rows
    ROUNDS = 32                 # of exchanges
    PATH = 8                    # pivots of Lemke's for each row
    MEMORY = 5                  # sweeps that are combined
    PATIENCE = 500              # of their watch


cdef inline bint met(const direct_t* t, double tol, bint enough) noexcept nogil:
    # Below tol and to rounding; where bounded rows are exchanged to the end and that is `enough`, below tol alone.
    return t.relative <= tol and (is_end(t) or (enough and t.solved and not t.linear))


cdef inline bint pivot(direct_t* t, const double* start, double tol, bint enough) noexcept nogil:
    """Into `best`; did it end below tol? Passes end where one does not halve the residual, or is stuck."""
    cdef int32_t code
    direct_begin(t, start)
    if t.linear:
        code = direct_factor(t)
        if code == INDEFINITE:
            return False
        if code == SOLVED:
            code = direct_linear(t)
    else:
        code = direct_first(t, SWEEPS, ROUNDS)
    if t.symmetric and (code == SMALL or (t.linear and not is_end(t))):
        direct_begin_passes(t, 0)
        code = HALVED
        while code == HALVED:
            code = direct_pass(t, ROUNDS)
            if not t.relative < INFINITY:
                return False
    return met(t, tol, enough)


cdef class Chain:
    """One problem of few rows, its error of doing nothing known to `data`; `run` serves one thread at a time.

    Parameters
    ----------
    data : Data
        What the judge reads.
    start : (m,) N s
        Pi(0), read-only.
    start_relative : float
        Relative residual of `start`.
    matrix : Data, or None for sweeps
        Of A in compressed rows, for pivots.
    band, linear, symmetric : int, bool, bool, of pivots
        Half bandwidth of A, m - 1 where it is not symmetric; whether every row is free.
    split, exact, first_look : int, bool, int, of sweeps
        Blocks before it are swept before the others: joints, contacts; whether each is solved exactly; sweeps before
        the residual is looked at.
    """

    cdef readonly Data data
    cdef readonly bint pivots
    cdef readonly object start
    cdef double start_relative
    cdef bint busy
    cdef Data matrix
    cdef direct_t trial
    cdef double[::1] real
    cdef int32_t[::1] index
    cdef object order, rng, prepared
    cdef int split, first_look

    def __init__(self, Data data, start, double start_relative, Data matrix=None, int band=0, bint linear=False,
                 bint symmetric=True, int split=0, bint exact=False, int first_look=0):
        cdef view_t view
        self.data, self.start, self.start_relative = data, start, start_relative
        self.split, self.first_look = split, first_look
        self.pivots = matrix is not None
        if not self.pivots:
            self.order = np.arange(data.blocks.n_blocks, dtype=np.int32)
            self.rng = np.zeros(1, np.uint64)
            self.prepared = gauss_seidel.prepare(data) if exact else None
            return
        self.matrix = matrix
        view = view_t(data.blocks, NULL, NULL, NULL)
        if data.factored:
            view.r = &data.rows
        else:
            view.a = &data.csr
        self.real, self.index = np.empty(direct_real(&view, band)), np.empty(direct_index(&view), np.int32)
        self.trial.e0, self.trial.v0, self.trial.least = data.start_energy, data.start_velocity, 1e-13
        self.trial.linear, self.trial.symmetric = linear, symmetric
        direct_lay(&self.trial, &view, &matrix.csr, &matrix.blocks, band, NULL, 1e-13, &self.real[0], &self.index[0])

    def run(self, impulse, double tol, bint look, double warm, bint follow=False):
        """From `impulse` (m,) [N s], or from `start` where it is None: (what the judge finds, what was done).

        look: something else comes next. Is `impulse` a solution? And where its residual is above `warm`, pivots start
        from `start`. follow: Lemke's path where exchanges are stuck; and what pivots find is good where it is below
        tol, not to rounding alone. False where it does not end below tol, None where another thread is here.

        What was done is None where `impulse` is the solution, else counts: of pivots (rounds, whether swept,
        refinements, factorisations, pivots, shifts, rank of a singular linear system or 0, pivots of Lemke's path); of
        sweeps (iterations, sweeps, restarts).
        """
        if self.busy:
            return None
        self.busy = True
        try:
            return self.look_and_solve(impulse, tol, look, warm, follow)
        finally:
            self.busy = False

    cdef look_and_solve(self, impulse, double tol, bint look, double warm, bint follow):
        cdef Judged found
        cdef double before = self.start_relative
        if look:
            if impulse is not None and not same_bits(impulse, self.start):
                found = Judged(self.data, impulse)
                before = found.relative
                if before <= tol:
                    return Judged(self.data, impulse.copy()), None
            elif before <= tol:
                return Judged(self.data, self.start.copy()), None
            if self.pivots and not before <= warm:
                impulse = None
        own = (self.start if impulse is None else impulse).copy()
        return self.by_pivots(own, tol, follow) if self.pivots else self.sweep(own, tol)

    cdef by_pivots(self, own, double tol, bint follow):
        cdef double[::1] start = own
        cdef direct_t* t = &self.trial
        cdef int32_t path = 0
        cdef bint ended
        with nogil:
            ended = pivot(t, &start[0], tol, follow)
        if not ended:
            if not follow or t.linear or t.solved:
                return False
            path = self.followed(own, tol)
            if path < 0:
                return False
        memcpy(&start[0], t.best, t.s.n * sizeof(double))
        return Judged(self.data, own), (t.s.n_rounds, bool(t.swept), t.refined, t.s.factorisations, t.s.exchanged, t.shifts,
                                        t.rank, path)

    cdef int followed(self, own, double tol) except -2:
        """Where exchanges are stuck: the sides on which Lemke's path leaves the rows, and exchanges from there.

        Pivots of the path, -1 where it does not end below tol.
        """
        cdef direct_t* t = &self.trial
        cdef int32_t m = t.s.n
        cdef double[::1] start = own
        at, x = np.asarray(<int32_t[:m]>t.s.at), np.asarray(<double[:m]>t.s.x)
        x[:] = own
        end, path = lemke(self.matrix, TINY, PATH * m, at, x)
        if end != FOLLOWED:
            return -1
        t.relative = INFINITY
        t.refined = t.shifts = 0
        judge_now(t)
        memcpy(&start[0], t.best, m * sizeof(double))   # where exchanges from there are no better
        end_of_path = t.relative
        pivots_start(&t.s, 0.0)
        if pivots_rounds(&t.s, ROUNDS) == SOLVED:
            t.relative = INFINITY
            after_rounds(t, SOLVED)
            if met(t, tol, True):
                return path
        if not end_of_path <= tol:
            return -1
        t.refined = 0
        memcpy(t.best, &start[0], m * sizeof(double))
        return path

    cdef sweep(self, own, double tol):
        cdef Judged found
        space = allocate(self.data, MEMORY)
        if self.data.factored:
            velocity_change(self.data, own, space[3])
        _status, done, sweeps, restarts = accelerate(
            self.data, Watch(self.data, PATIENCE), own, self.first_look, tol, MEMORY, self.prepared,
            self.prepared is not None, 0, space, self.order, self.split, 0, self.rng)
        found = Judged(self.data, own)
        if not found.relative <= tol:
            return False
        return found, (done, sweeps, restarts)
