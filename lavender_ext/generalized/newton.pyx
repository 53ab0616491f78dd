"""Newton's method over generalised velocities for Python: islands, room, and one call that solves (`newton.pxd`)."""
from libc.stdint cimport int32_t

from lavender_ext.core.problem cimport Data, Room, room_for
from lavender_ext.generalized.flow cimport flow_t
from lavender_ext.generalized.islands cimport aim_at, furnish, marks_of, need_t, numbers_of, settle
from lavender_ext.generalized.sparse cimport per_column
from lavender_ext.generalized.newton cimport DONE, FAILED, LOST, SPENT, STUCK, descend_all, is_soft

ENDS = {"done": DONE, "spent": SPENT, "stuck": STUCK, "failed": FAILED, "lost": LOST}


cdef class Newton:
    """Room for Newton's method on a problem in generalised coordinates; `run` as often as wanted.

    `work`: multiply-adds of N and one factor of each island. `soft`: no row needs a proximal term. Where N of an island
    has more than `most` values (`fits`) there is no room, and no `run`.
    """
    cdef flow_t f
    cdef Data data
    cdef list keep
    cdef readonly double work
    cdef readonly bint fits, soft

    def __init__(self, Data p, double most):
        cdef need_t need
        cdef int32_t per = per_column(p.general.n)
        cdef Room marks, numbers
        self.data = p
        while True:
            marks = room_for(marks_of(&p.blocks, &p.general, per) * sizeof(int32_t))
            settle(&self.f, &p.blocks, &p.general, per, <int32_t*>marks.at, &need)
            if not need.crowded or <double>per * p.general.n > most:
                break
            per *= 2
        self.work = need.work
        self.soft = is_soft(&p.blocks, &p.general)
        self.fits = not need.crowded and need.values <= most
        if not self.fits:
            return
        numbers = room_for(numbers_of(&self.f, &need) * sizeof(double))
        furnish(&self.f, &need, <double*>numbers.at)
        self.keep = [marks, numbers]

    @property
    def waits(self):
        """A run has used up its steps: `again` goes on from there."""
        return self.f.wait.island >= 0

    @property
    def islands(self):
        """Problems that share no velocity."""
        return self.f.n_islands

    def run(self, double[::1] impulse, double tol, int steps, bint again=False):
        """At most `steps` Newton steps on impulse (m,), in place; the judge's start must be known to the data.

        again: on from where the run before, to the same tol, has used up its steps. Under Coulomb's law the best at a
        cut is kept, and may be the end sooner than one run of as many steps finds it; else the bits are those of one.
        Returns how it ended (`ENDS`) and (steps, factorisations, rounds, evaluations of a line).
        """
        cdef int32_t end = DONE, waits = self.f.wait.island if again else -1
        if self.f.p.n_rows > 0:
            aim_at(&self.f, tol, steps, self.data.start_energy, self.data.start_velocity)
            self.f.wait.island = waits
            with nogil:
                end = descend_all(&self.f, &impulse[0])
        return end, (steps - self.f.steps, self.f.factorisations, self.f.rounds, self.f.evaluations)
