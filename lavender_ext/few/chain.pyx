"""Problems of few rows: look, solve and judge in one call, with what is prepared kept from one call to the next.

    velocities   newton on J and M, from the impulse given                              (generalized/newton.pxd)
    pivots       the factor of A, linear or boxed, with one shift where it is singular, and its refinement
                                                                                        (pivot/principal.pyx);
                 where exchanges are stuck Lemke's path, if asked for               (pivot/tableau.pyx)
    sweeps       the first look of accelerated sweeps                                   (accelerate/accelerated.pyx)

The same kernels in the same order as the solvers call them on any problem, Lemke's path aside, so the same bits and
counts. What does not end as one hopes, below tol on the judge's own measure, is nobody's result: the caller starts
again the long way.
"""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.accelerate.accelerated import allocate
from lavender_ext.accelerate.accelerated import run as accelerate
from lavender_ext.core.problem cimport Data
from lavender_ext.generalized.newton cimport DONE, Newton
from lavender_ext.judge.measure cimport Judged
from lavender_ext.judge.measure import same_bits, velocity_change
from lavender_ext.judge.watch import Watch
from lavender_ext.local import gauss_seidel
from lavender_ext.pivot.principal import SMALL, SOLVED, Pivoting
from lavender_ext.pivot.tableau import DONE as FOLLOWED
from lavender_ext.pivot.tableau import follow as lemke

SHIFT = 1e-10                   # of d, as `direct` has it
TINY = 1e-11                    # of the largest entry of a column, as `lemke` has it


cpdef enum:                     # kinds
    VELOCITIES = 0
    PIVOTS = 1
    SWEEPS = 2

cdef enum:
    STEPS = 64                  # of newton
    PIVOT_SWEEPS = 2            # that guess the free rows
    PIVOT_ROUNDS = 32
    CORRECTIONS = 100           # refinements
    PATH = 8                    # pivots of Lemke's for each row
    PASSES = 100                # around the last answer, where A is singular
    MEMORY = 5                  # sweeps that are combined
    PATIENCE = 500              # of their watch


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
    newton : Newton, with VELOCITIES
        Over generalised velocities.
    matrix : Data, with PIVOTS
        Of A in compressed rows.
    band, linear, symmetric : int, bool, bool, with PIVOTS
        Half bandwidth of A, m - 1 where it is not symmetric; whether every row is free.
    split, exact, first_look : int, bool, int, with SWEEPS
        Blocks before it are swept before the others: joints, contacts; whether each is solved exactly; sweeps before
        the residual is looked at.
    """

    cdef readonly Data data
    cdef readonly int kind
    cdef readonly object start
    cdef double start_relative
    cdef bint busy
    cdef Newton newton
    cdef object pivoting                                # Pivoting
    cdef Data matrix
    cdef bint linear, symmetric
    cdef object order, rng, prepared
    cdef int split, first_look

    def __init__(self, Data data, start, double start_relative, Newton newton=None, Data matrix=None,
                 int band=0, bint linear=False, bint symmetric=True, int split=0, bint exact=False,
                 int first_look=0):
        self.data, self.start, self.start_relative = data, start, start_relative
        self.newton, self.linear, self.split, self.first_look = newton, linear, split, first_look
        self.symmetric = symmetric
        if newton is not None:
            self.kind = VELOCITIES
        elif matrix is not None:
            self.kind = PIVOTS
            self.pivoting, self.matrix = Pivoting(matrix, band, None, 1e-13, symmetric), matrix
        else:
            self.kind = SWEEPS
            self.order = np.arange(data.blocks.n_blocks, dtype=np.int32)
            self.rng = np.zeros(1, np.uint64)
            self.prepared = gauss_seidel.prepare(data) if exact else None

    def run(self, impulse, double tol, bint look, double warm, bint follow=False):
        """From `impulse` (m,) [N s], or from `start` where it is None: (what the judge finds, what was done).

        look: something else comes next. Is `impulse` a solution? And where its residual is above `warm`, pivots start
        from `start`. follow: Lemke's path where exchanges are stuck; and what pivots find is good where it is below
        tol, not to rounding alone. None where it does not end below tol, or another thread is here.

        What was done is None where `impulse` is the solution, else counts: of newton (steps, factorisations, updates,
        rounds, evaluations); of pivots (rounds, whether swept, refinements, factorisations, pivots, shifts, rank of a
        singular linear system or 0, pivots of Lemke's path); of sweeps (iterations, sweeps, restarts).
        """
        if self.busy:
            return None
        self.busy = True
        try:
            if self.kind == VELOCITIES:
                return self.descend(impulse, tol)
            return self.look_and_solve(impulse, tol, look, warm, follow)
        finally:
            self.busy = False

    cdef descend(self, impulse, double tol):
        cdef double[::1] lam
        cdef int32_t i, end, m = self.data.blocks.n_rows
        cdef bint cold = True
        cdef Newton newton = self.newton
        own = (self.start if impulse is None else impulse).copy()
        lam = own
        if impulse is not None:
            for i in range(m):
                if lam[i] != 0.0:
                    cold = bool(np.array_equal(own, self.start))
                    break
        newton.aim(tol, STEPS)
        with nogil:
            end = newton.go(&lam[0], cold)
        if end != DONE:
            return None
        found = Judged(self.data, own)
        if not found.relative <= tol:
            return None
        return found, (STEPS - newton.f.steps, newton.f.factorisations, newton.f.updates, newton.f.rounds,
                       newton.f.evaluations)

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
            if self.kind == PIVOTS and not before <= warm:
                impulse = None
        own = (self.start if impulse is None else impulse).copy()
        return self.pivot(own, tol, follow) if self.kind == PIVOTS else self.sweep(own, tol)

    cdef pivot(self, own, double tol, bint follow):
        cdef int done = 1
        rows = self.pivoting
        rows.renew()
        code, swept = SOLVED, False
        if self.linear:
            small, negative = rows.factor_all()
            if negative or (small and not self.symmetric):
                return None
            if small:
                return self.shifted(own, tol, None, 0, 0, self.data.blocks.n_rows - small, False)
            rows.solve_free()
        else:
            code, swept = rows.solve(own, PIVOT_SWEEPS, PIVOT_ROUNDS)
            done = rows.n_rounds
            if code == SMALL and self.symmetric:
                made = self.shifted(own, tol, None, done, 0, 0, bool(swept))
                if made is not None or not follow:
                    return made
        if code == SOLVED:
            return self.refined(own, tol, done, bool(swept), 0, follow and not self.linear)
        return self.followed(own, tol, bool(swept)) if follow else None

    cdef refined(self, own, double tol, int done, bint swept, int path, bint enough):
        """Refinements of the rows found free; `enough`: below tol is."""
        cdef Judged best, found
        cdef double previous = 1.0 / 0.0
        cdef int k = 0
        rows = self.pivoting
        found = best = self.judged(rows)
        if not is_good(best):
            rows.slack()
            while k < CORRECTIONS and not is_good(best) and found.relative < 0.5 * previous:
                previous = found.relative
                rows.correct()
                rows.slack()
                k += 1
                if rows.exchange():
                    if enough:
                        break
                    return None
                found = self.judged(rows)
                if found.relative < best.relative:
                    best = found
        if not (enough or self.is_end(best)):
            return self.shifted(own, tol, best, done, k, 0, False) if self.linear and self.symmetric else None
        if not best.relative <= tol:
            return None
        return best, (done, swept, k, rows.factorisations, rows.exchanged, 0, 0, path)

    cdef followed(self, own, double tol, bint swept):
        """Where exchanges are stuck: the sides on which Lemke's path leaves the rows, and exchanges from there."""
        rows = self.pivoting
        rows.x[:] = own
        end, path = lemke(self.matrix, TINY, PATH * self.data.blocks.n_rows, rows.at, rows.x)
        if end != FOLLOWED:
            return None
        found = self.judged(rows)
        rows.start(0.0)
        if rows.rounds(PIVOT_ROUNDS) == SOLVED:
            made = self.refined(own, tol, rows.n_rounds, swept, path, True)
            if made is not None:
                return made
        if not found.relative <= tol:
            return None
        return found, (rows.n_rounds, swept, 0, rows.factorisations, rows.exchanged, 0, 0, path)

    cdef shifted(self, own, double tol, Judged best, int done, int k, int rank, bint swept):
        """Passes on A + s D around the last answer, which `best` or `own` is; `rank`: 0, or what it is, all rows free.

        As `direct` does where A is singular; given up where a pass does not halve the residual, or is stuck.
        """
        cdef Judged found
        cdef double previous, reference = 1.0 / 0.0, least = 1.0 / 0.0
        rows = self.pivoting
        rows.x[:] = own if best is None or best.floor > 1e-6 else best.impulse
        if best is not None:
            least = best.relative
        for _ in range(PASSES):
            rows.recenter()
            if not rows.shift:
                rows.start(SHIFT)
            rows.restart()
            before = rows.n_rounds
            if rows.rounds(1 if self.linear else PIVOT_ROUNDS) != SOLVED:
                return None
            done += rows.n_rounds - before
            found = self.judged(rows)
            previous = 1.0 / 0.0
            whole = True                                # just after a solve
            while True:
                if found.relative < least:
                    best, least = found, found.relative
                if best is None:
                    return None                         # not a number
                if is_good(best) or (whole and self.is_end(best)) or k == CORRECTIONS:
                    break
                if not found.relative < 0.5 * previous:
                    break
                whole = False
                previous = found.relative
                rows.recenter()
                rows.slack()
                rows.correct()
                k += 1
                found = self.judged(rows)
                if not found.relative < previous:
                    rows.x[:] = rows.center
            if self.is_end(best) or not least <= 0.5 * reference:
                break
            reference = least
        if not self.is_end(best) or not least <= tol:
            return None
        return best, (done, swept, k, rows.factorisations, rows.exchanged, 1, rank, 0)

    cdef bint is_end(self, Judged x):
        # Where every row is free, rounding is all that can be left.
        return is_good(x) or (self.linear and is_rounded(x))

    cdef judged(self, rows):
        x = np.empty(self.data.blocks.n_rows)
        rows.clipped(x)
        return Judged(self.data, x)

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
            return None
        return found, (done, sweeps, restarts)


cdef inline bint is_good(Judged x) noexcept:
    # As `direct`: to rounding, or to the floor where that is not of an impulse that ran away.
    cdef double floor = x.floor if x.floor < 1e-6 else 1e-6
    return x.relative <= (floor if floor > 1e-13 else 1e-13)


cdef inline bint is_rounded(Judged x) noexcept:
    # As `direct` where refinement has ended.
    cdef double floor = x.floor if x.floor < 1e-6 else 1e-6
    return x.relative <= 2.0 * floor
