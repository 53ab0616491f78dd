"""Newton's method over generalised velocities for Python: islands, room, and one call that solves (`newton.pxd`)."""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.block cimport ROW, blocks_t
from lavender_ext.core.generalized cimport generalized_t
from lavender_ext.core.problem cimport Data, Room, room_for
from lavender_ext.generalized.newton cimport DONE, FAILED, LOST, SPENT, STUCK, flow_t, solve_island

ENDS = {"done": DONE, "spent": SPENT, "stuck": STUCK, "failed": FAILED, "lost": LOST}


cdef inline int32_t root_of(int32_t* up, int32_t i) noexcept nogil:
    while up[i] != i:
        up[i] = up[up[i]]
        i = up[i]
    return i


cdef public int32_t lav_general_islands(const blocks_t* p, const generalized_t* g, int32_t* up, int32_t* label,
                                        int32_t* iptr, int32_t* ipanel, int32_t* cptr, int32_t* icols, int32_t* local,
                                        int32_t* pblock, int32_t* vptr, int32_t* most) noexcept nogil:
    """Islands: panels that share no column, directly or through others, in the order of their first panel.

    up (n) and label (max(n, n_panels)) are scratch; what is found stands in arrays as `flow_t` has them (iptr and cptr
    with room for n_panels + 1). most (3): columns of the largest island, of the widest panel, and rows x columns of
    the largest panel. A panel without columns is an island of its own.
    """
    cdef int32_t b, q, r, i, k, n = 0, size, nc, rows
    for i in range(g.n):
        up[i] = i
        local[i] = -1
    i = 0
    for b in range(g.n_panels):
        for q in range(g.pcol[b] + 1, g.pcol[b + 1]):
            r = root_of(up, g.cols[g.pcol[b]])
            k = root_of(up, g.cols[q])
            if r < k:
                up[k] = r
            elif k < r:
                up[r] = k
        while p.ptr[i] < g.prow[b]:
            i += 1
        pblock[b] = i
    pblock[g.n_panels] = p.n_blocks
    vptr[0] = 0
    for i in range(p.n_blocks):
        size = p.ptr[i + 1] - p.ptr[i]
        vptr[i + 1] = vptr[i] + (size if p.kind[i] == ROW else size * size)
    # `local` numbers the islands by their root, until it numbers columns
    for b in range(g.n_panels):
        if g.pcol[b + 1] == g.pcol[b]:
            label[b] = n
            n += 1
            continue
        r = root_of(up, g.cols[g.pcol[b]])
        if local[r] < 0:
            local[r] = n
            n += 1
        label[b] = local[r]
    for i in range(n + 1):
        iptr[i] = 0
        cptr[i] = 0
    for b in range(g.n_panels):
        iptr[label[b] + 1] += 1
    for i in range(n):
        iptr[i + 1] += iptr[i]
    for b in range(g.n_panels):
        ipanel[iptr[label[b]]] = b
        iptr[label[b]] += 1
    for i in range(n, 0, -1):
        iptr[i] = iptr[i - 1]
    iptr[0] = 0
    most[0] = most[1] = most[2] = 0
    for b in range(g.n_panels):
        nc = g.pcol[b + 1] - g.pcol[b]
        rows = g.prow[b + 1] - g.prow[b]
        if nc > most[1]:
            most[1] = nc
        if rows * nc > most[2]:
            most[2] = rows * nc
        if rows > most[3]:
            most[3] = rows
    # columns of each island, ascending: an island is a set of roots
    for i in range(g.n):
        label[i] = -1
    for b in range(n):
        for i in range(iptr[b], iptr[b + 1]):
            for q in range(g.pcol[ipanel[i]], g.pcol[ipanel[i] + 1]):
                label[root_of(up, g.cols[q])] = b
                break
    for i in range(g.n):
        r = label[root_of(up, i)]
        if r >= 0:
            cptr[r + 1] += 1
    for b in range(n):
        cptr[b + 1] += cptr[b]
    for i in range(g.n):
        r = label[root_of(up, i)]
        if r >= 0:
            local[i] = cptr[r]
            icols[cptr[r]] = i
            cptr[r] += 1
    for b in range(n, 0, -1):
        cptr[b] = cptr[b - 1]
    cptr[0] = 0
    for b in range(n):
        if cptr[b + 1] - cptr[b] > most[0]:
            most[0] = cptr[b + 1] - cptr[b]
        for i in range(cptr[b], cptr[b + 1]):
            local[icols[i]] = i - cptr[b]
    return n


cdef public int32_t lav_general_newton(flow_t* f, double* impulse, int32_t cold, double soft) noexcept nogil:
    """All islands from `impulse` (m), into it: DONE, or how the worst of them ended."""
    cdef int32_t i, end, worst = DONE
    for i in range(f.n_islands):
        end = solve_island(f, i, impulse, cold, soft)
        if end > worst:
            worst = end
    return worst


cdef class Newton:
    """Room for Newton's method on a problem in generalised coordinates; `run` as often as wanted.

    Where an island has more than `limit` velocities (`largest`) there is no room, and no `run`.
    """

    def __init__(self, Data p, int limit):
        cdef int32_t n = p.general.n, m = p.blocks.n_rows, k = p.blocks.n_blocks, panels = p.general.n_panels
        cdef int32_t most[4]
        cdef Py_ssize_t at, nv, size
        cdef int32_t wide = n if n > panels else panels
        cdef Room whole = room_for((3 * <Py_ssize_t>n + wide + 4 * panels + k + 8) * sizeof(int32_t)), room
        cdef int32_t* w = <int32_t*>whole.at
        cdef double* x
        most[0] = most[1] = most[2] = most[3] = 0
        self.data = p
        self.f.p = p.blocks
        self.f.law = p.blocks.law
        self.f.g = &p.general
        at = n + wide
        self.f.iptr = w + at
        self.f.cptr = w + at + panels + 1
        self.f.ipanel = w + at + 2 * panels + 2
        self.f.pblock = w + at + 3 * panels + 2
        at += 4 * panels + 3
        self.f.icols = w + at
        self.f.local = w + at + n
        self.f.vptr = w + at + 2 * n
        self.f.n_islands = lav_general_islands(
            &p.blocks, &p.general, w, w + n, <int32_t*>self.f.iptr, <int32_t*>self.f.ipanel, <int32_t*>self.f.cptr,
            <int32_t*>self.f.icols, <int32_t*>self.f.local, <int32_t*>self.f.pblock, <int32_t*>self.f.vptr, most)
        self.f.swap = w                                 # scratch of before
        self.largest = most[0]
        if most[0] > limit:
            return
        size = most[0]
        nv = self.f.vptr[k]
        room = room_for(sizeof(double) * (4 * n + 12 * <Py_ssize_t>m + 2 * nv + 2 * size * size + 2 * size + most[2]
                                          + most[1] + most[3] + 1))
        x = <double*>room.at
        self.f.y = x
        self.f.u = x + n
        self.f.grad = x + 2 * n
        self.f.step = x + 3 * n
        x += 4 * n
        self.f.theta = x
        self.f.rho = x + m
        self.f.s = x + 2 * m
        self.f.q = x + 3 * m
        self.f.phi = x + 4 * m
        self.f.center = x + 5 * m
        self.f.lam = x + 6 * m
        self.f.trial = x + 7 * m
        self.f.best = x + 8 * m
        self.f.first_best = x + 9 * m
        self.f.w = x + 10 * m
        self.f.e = x + 11 * m
        x += 12 * m
        self.f.v = x
        self.f.held = x + nv
        x += 2 * nv
        self.f.normal = x
        self.f.factor = x + size * size
        x += 2 * size * size
        self.f.inv = x
        self.f.local_rhs = x + size
        self.f.turned = x + 2 * size
        self.f.line = x + 2 * size + most[2]
        self.keep = [whole, room]

    cdef void aim(self, double tol, int32_t steps) noexcept:
        # What is asked of each island, and counts from nothing.
        cdef double share = 1.0 / (<double>self.f.n_islands) ** 0.5 if self.f.n_islands > 1 else 1.0
        self.f.energy_limit = tol * self.data.start_energy * share
        self.f.velocity_limit = tol * self.data.start_velocity
        self.f.steps = steps
        self.f.factorisations = self.f.updates = self.f.rounds = self.f.evaluations = 0

    cdef int32_t go(self, double* impulse, bint cold) noexcept nogil:
        return lav_general_newton(&self.f, impulse, cold, 1e-4)

    @property
    def islands(self):
        """Problems that share no velocity."""
        return self.f.n_islands

    def run(self, double[::1] impulse, double tol, int steps, bint cold, double soft=1e-4):
        """At most `steps` Newton steps on impulse (m,), in place; the judge's start must be known to the data.

        Returns how it ended (`ENDS`) and (steps, factorisations, updates of N, rounds, evaluations of a line).
        """
        cdef int32_t end = DONE
        if self.f.p.n_rows > 0:
            self.aim(tol, steps)
            with nogil:
                end = lav_general_newton(&self.f, &impulse[0], cold, soft)
        return end, (steps - self.f.steps, self.f.factorisations, self.f.updates, self.f.rounds, self.f.evaluations)


def run_many(list kernels, list impulses, double tol, int steps, cold, double soft=1e-4):
    """`Newton.run` on each impulse (m,) in turn, in one loop without the interpreter.

    cold (n,) bool. Returns (n,) how each ended and (n, 5) what each took, as `run` does.
    """
    cdef Py_ssize_t i, n = len(kernels)
    cdef Newton kernel
    cdef double[::1] impulse
    ends_ = np.zeros(n, np.int32)
    counts_ = np.zeros((n, 5), np.int64)
    flows_ = np.empty(n, np.intp)
    places_ = np.empty(n, np.intp)
    cdef int32_t[::1] ends = ends_
    cdef int64_t[:, ::1] counts = counts_
    cdef Py_ssize_t[::1] flows = flows_, places = places_
    cdef const unsigned char[::1] is_cold = np.ascontiguousarray(cold, np.uint8)
    cdef flow_t* f
    for i in range(n):
        kernel = kernels[i]
        impulse = impulses[i]
        kernel.aim(tol, steps)
        flows[i] = <Py_ssize_t>&kernel.f
        places[i] = <Py_ssize_t>&impulse[0] if impulse.shape[0] else 0
    with nogil:
        for i in range(n):
            f = <flow_t*>flows[i]
            if places[i]:
                ends[i] = lav_general_newton(f, <double*>places[i], is_cold[i], soft)
                counts[i, 0] = steps - f.steps
                counts[i, 1] = f.factorisations
                counts[i, 2] = f.updates
                counts[i, 3] = f.rounds
                counts[i, 4] = f.evaluations
    return ends_, counts_
