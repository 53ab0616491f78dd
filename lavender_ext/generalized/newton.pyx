"""Newton's method over generalised velocities for Python: islands, room, and one call that solves (`newton.pxd`)."""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport blocks_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.problem cimport Data, Room, room_for
from lavender_ext.generalized.flow cimport flow_t
from lavender_ext.generalized.islands cimport aim_at, find_islands, furnish, marks_of, need_t, numbers_of, settle
from lavender_ext.generalized.sparse cimport PER_COLUMN
from lavender_ext.generalized.newton cimport DONE, FAILED, LOST, SPENT, STUCK, solve_island

ENDS = {"done": DONE, "spent": SPENT, "stuck": STUCK, "failed": FAILED, "lost": LOST}


cdef public int32_t lav_general_islands(const blocks_t* p, const generalized_t* g, int32_t* up, int32_t* label,
                                        int32_t* iptr, int32_t* run, int32_t* cptr, int32_t* icols, int32_t* local,
                                        int32_t* pblock, int32_t* vptr, int32_t* most) noexcept nogil:
    """`find_islands`."""
    return find_islands(p, g, up, label, iptr, run, cptr, icols, local, pblock, vptr, most)


cdef int32_t descend_all(flow_t* f, double* impulse, int32_t cold) noexcept nogil:
    cdef int32_t i, end, first = 0, worst = DONE
    if f.wait.island >= 0:
        first = f.wait.island
        worst = f.wait.worst
        cold = f.wait.cold
    for i in range(first, f.n_islands):
        end = solve_island(f, i, impulse, cold)
        if end == SPENT:                                # N is of this one
            f.wait.worst = worst
            f.wait.cold = cold
            return SPENT
        if end > worst:
            worst = end
    return worst


cdef public int32_t lav_general_newton(flow_t* f, double* impulse, int32_t cold) noexcept nogil:
    """All islands from `impulse` (m), or from the one that waits on, into it: DONE, or how the worst of them ended."""
    return descend_all(f, impulse, cold)


cdef class Newton:
    """Room for Newton's method on a problem in generalised coordinates; `run` as often as wanted.

    `largest`: velocities of the island whose factor costs most, or of a dense one that costs the same. Where N of an
    island has more than `most` values (`fits`) there is no room, and no `run`; nor where L fills so much that its rows
    must be counted anew (`crowded`), unless that is `wanted`: it takes many sweeps' time.
    """

    def __init__(self, Data p, double most, bint wanted=True):
        cdef need_t need
        cdef int32_t per = PER_COLUMN
        cdef Room marks, numbers
        self.data = p
        while True:
            marks = room_for(marks_of(&p.blocks, &p.general, per) * sizeof(int32_t))
            settle(&self.f, &p.blocks, &p.general, per, <int32_t*>marks.at, &need)
            if not need.crowded or 2.0 * per * p.general.n > most or 4 * per > p.general.n:
                break                                   # beyond a quarter of its columns a row is best kept dense
            if not wanted:
                self.crowded = True
                return
            per *= 2
        self.largest = need.wide
        self.fits = need.values <= most
        if not self.fits:
            return
        numbers = room_for(numbers_of(&self.f, &need) * sizeof(double))
        furnish(&self.f, &need, <double*>numbers.at)
        self.keep = [marks, numbers]

    cdef void aim(self, double tol, int32_t steps) noexcept:
        aim_at(&self.f, tol, steps, self.data.start_energy, self.data.start_velocity)

    cdef int32_t go(self, double* impulse, bint cold) noexcept nogil:
        return lav_general_newton(&self.f, impulse, cold)

    @property
    def waits(self):
        """A run has used up its steps: `again` goes on from there."""
        return self.f.wait.island >= 0

    @property
    def islands(self):
        """Problems that share no velocity."""
        return self.f.n_islands

    def run(self, double[::1] impulse, double tol, int steps, bint cold, bint again=False):
        """At most `steps` Newton steps on impulse (m,), in place; the judge's start must be known to the data.

        again: on from where the run before, to the same tol, has used up its steps. Under Coulomb's law the best at a
        cut is kept, and may be the end sooner than one run of as many steps finds it; else the bits are those of one.
        Returns how it ended (`ENDS`) and (steps, factorisations, updates of N, rounds, evaluations of a line).
        """
        cdef int32_t end = DONE, waits = self.f.wait.island if again else -1
        if self.f.p.n_rows > 0:
            self.aim(tol, steps)
            self.f.wait.island = waits
            with nogil:
                end = lav_general_newton(&self.f, &impulse[0], cold)
        return end, (steps - self.f.steps, self.f.factorisations, self.f.updates, self.f.rounds, self.f.evaluations)
