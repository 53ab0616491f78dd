"""Newton's method on one scaled problem for Python: `plan.pxd` turn by turn, and its systems one by one for tests."""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.arrays cimport address
from lavender_ext.core.problem cimport Data
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.newton.elements cimport Elements
from lavender_ext.newton.normal_matrix cimport Factor
from lavender_ext.newton.phases cimport begin_exchanges, exchange_once, sides
from lavender_ext.newton.plan cimport (CERTIFICATE, FLOOR, MORE, REACHED, SPENT, STUCK, newton_start, newton_step)
from lavender_ext.newton.run cimport (APPROACH, DE_SAXCE, EXCHANGES, INTERIOR, N_COUNTED, POLISH, PROXIMAL, PURSUIT,
                                      RELAXED, VECTORS, lay_vectors, newton_t, relative_at)
from lavender_ext.newton.steps cimport begin_interior, duals, interior_step, slips, turn
from lavender_ext.newton.system cimport (BODIES, DENSE, OF_BARRIER, OF_NATURAL, OF_PAIR, SPARSE, dense_room,
                                         natural_times, others_t, solve_natural, solve_refined, system_factor,
                                         system_natural, system_solve, system_times)

OUTCOMES = {"more": MORE, "reached": REACHED, "floor": FLOOR, "stuck": STUCK, "certificate": CERTIFICATE, "spent": SPENT}
FORMS = {"velocity": BODIES, "dense": DENSE, "sparse": SPARSE}
WHATS = {"barrier": OF_BARRIER, "pair": OF_PAIR, "natural": OF_NATURAL}
#: Phases by the bits of `Solve.without`.
PHASES = {
    "exchanges": 1 << EXCHANGES,
    "interior point": 1 << INTERIOR,
    "rounds": 1 << PROXIMAL,
    "pursuit": 1 << PURSUIT,
    "approach": 1 << APPROACH,
    "augmented steps": 1 << POLISH,
    "De Saxce": 1 << DE_SAXCE,
    "relaxation": 1 << RELAXED,
}
#: What `Solve.counts` counts, as the message of a solution names it.
COUNTED = (
    "exchanges",
    "refinements",
    "interior point steps",
    "proximal rounds",
    "De Saxce steps",
    "convex steps",
    "augmented interior point steps",
    "augmented De Saxce steps",
    "augmented steps",
)


cdef int32_t call_factor(void* at, int32_t augmented, int32_t what, double eps) noexcept with gil:
    cdef Solve self = <Solve>at
    try:
        return bool(self.others.factor(augmented, what, eps))
    except BaseException as error:                      # Ctrl-C among them: the turn ends, and its caller raises
        self.raised = error
        self.n.stop = 1
        return 0


cdef void call_solve(void* at, int32_t augmented, double* x) noexcept with gil:
    cdef Solve self = <Solve>at
    cdef double[::1] view = <double[:self.m]>x
    cdef const double[::1] found
    try:
        found = self.others.solve(augmented, np.asarray(view))
        view[:] = found
    except BaseException as error:
        self.raised = error
        self.n.stop = 1
        view[:] = np.nan


cdef class Solve:
    """A scaled problem and its Newton systems; `start`, then `step` after `step`.

    Every array is C-contiguous, float64 or int32, of m rows that move (`keep`, None: all), checked by the caller.
    matrix: H (m, m), or its (indptr, indices, data), or the `Factor` over bodies. others: who factors what is not
    factored here, or None.
    """

    def __init__(self, Data data, Elements e, matrix, bint symmetric, bint cones, scale, fixed, keep, speed, others=None,
                 bint wide=True):
        cdef newton_t* n = &self.n
        cdef Factor f
        cdef int rows = data.blocks.n_rows
        m = self.m = e.m
        small = np.zeros((5, e.n_small + 1))
        self.v, self.einv, self.p, self.pair = small[:4, : e.n_small]
        room = np.zeros(VECTORS * m + 1)
        judge = np.empty(3 * rows + 12 * data.rows.n_bodies * data.factored + (data.general.n + rows) * data.is_general + 1)
        marks = np.zeros((3, m + 1), np.int32)
        self.keep = [data, e, matrix, scale, fixed, keep, speed, small, room, judge, marks]
        cdef double[::1] r = room
        cdef double[::1] j = judge
        cdef double[:, ::1] w = small
        cdef int32_t[:, ::1] k = marks
        lay_vectors(n, &r[0], m)
        n.scale, n.fixed, n.speed = <double*>address(scale), <double*>address(fixed), <double*>address(speed)
        n.keep = NULL
        if keep is not None:
            n.keep = <int32_t*>address(keep)
        n.problem.p = data.blocks
        n.problem.a = NULL
        n.problem.r = NULL
        n.problem.g = NULL
        if data.is_general:
            n.problem.g = &data.general
        elif data.factored:
            n.problem.r = &data.rows
        else:
            n.problem.a = &data.csr
        n.problem.e0, n.problem.v0 = data.start_energy, data.start_velocity
        n.lam, n.problem.w, n.problem.error, n.problem.x = &j[0], &j[0] + rows, &j[0] + 2 * rows, &j[0] + 3 * rows
        n.exchange.side = &k[0, 0]
        n.s.e = &e.e
        n.s.symmetric, n.s.wide = symmetric, wide and has_wide()
        n.without = 0
        n.s.augmented = n.s.factorisations = 0
        n.s.v, n.s.einv, n.s.p, n.s.pair = &w[0, 0], &w[1, 0], &w[2, 0], &w[3, 0]
        n.s.bt = NULL
        if cones:
            n.s.bt = &w[4, 0]
            self.bt = small[4, : e.n_small]
        n.s.swap, n.s.free = &k[1, 0], &k[2, 0]
        n.s.others = NULL
        self.others = others
        self.calls = others_t(<void*>self, call_factor, call_solve)
        if others is not None:
            n.s.others = &self.calls
        if isinstance(matrix, Factor):
            f = matrix
            n.s.form = BODIES
            n.s.f = &f.f
            self._hold_bodies(f.n * f.s)
        elif isinstance(matrix, tuple):
            n.s.form = SPARSE
            n.s.a.indptr, n.s.a.indices = <int32_t*>address(matrix[0]), <int32_t*>address(matrix[1])
            n.s.a.data = <double*>address(matrix[2])
        else:
            n.s.form = DENSE
            n.s.h = <double*>address(matrix)
            self._hold_dense(cones)

    def _hold_bodies(self, int unknowns):
        cdef double[::1] y = np.zeros(unknowns + 1)
        self.keep.append(y)
        self.n.s.y = &y[0]

    def _hold_dense(self, bint cones):
        cdef double[::1] whole = np.empty(self.m * self.m + 1), lower = np.empty(dense_room(self.m, cones) + 1)
        self.keep += [whole, lower]
        self.n.s.whole, self.n.s.lower = &whole[0], &lower[0]

    def start(self, const double[::1] z, double tol, int budget, bint coulomb, bint cold):
        """From z (m,), to a relative residual of tol, with so many factorisations; `coulomb`: a contact rubs so."""
        self.n.tol, self.n.budget, self.n.cold = tol, budget, cold
        self.raised = None
        with nogil:
            newton_start(&self.n, &z[0], coulomb)

    def step(self, int work):
        """`work` factorisations or a few more; one of `OUTCOMES`."""
        cdef int32_t how
        with nogil:
            how = newton_step(&self.n, work)
        if self.raised is not None:
            error, self.raised = self.raised, None
            raise error
        return how

    def stop(self):
        """There is no time for another factorisation: the next step judges what is there, and ends."""
        self.n.stop = 1

    def prove(self):
        """`direction` is a proof that there is no solution."""
        self.n.proven = 1

    @property
    def factorisations(self):
        """Done since the start."""
        return self.n.s.factorisations

    @property
    def best(self):
        """Lowest relative residual."""
        return self.n.best

    @property
    def best_z(self):
        """(m,) of that."""
        return np.asarray(<double[:self.m]>self.n.best_z).copy()

    @property
    def direction(self):
        """(m,) along which a certificate was asked for."""
        return np.asarray(<double[:self.m]>self.n.direction).copy()

    @property
    def counts(self):
        """What ran, in the order of `COUNTED`."""
        return [self.n.counts[i] for i in range(N_COUNTED)]

    @property
    def without(self):
        """Bits of `PHASES` that are left out."""
        return self.n.without

    @without.setter
    def without(self, int phases):
        self.n.without = phases

    # -- one by one --------------------------------------------------------------------------------

    def times(self, const double[::1] x):
        """H x."""
        out_array = np.empty(self.m)
        cdef double[::1] out = out_array
        system_times(&self.n.s, &x[0], &out[0])
        return out_array

    def natural(self, const double[::1] z, const double[::1] s, int law, double eps):
        """F (m,) of the map `law`; its derivative's small matrices into p, einv and v."""
        f_array = np.empty(self.m)
        cdef double[::1] f = f_array
        system_natural(&self.n.s, &z[0], &s[0], law, eps, &f[0])
        return f_array

    def natural_times(self, const double[::1] dz):
        """(I - P) dz + P H dz."""
        out_array = np.empty(self.m)
        cdef double[::1] out = out_array
        natural_times(&self.n.s, &dz[0], &out[0])
        return out_array

    def factor(self, str what, double eps=0.0, bint augmented=False):
        """Factor "barrier", "pair" or "natural"; whether no pivot was lost."""
        self.n.s.augmented = augmented
        return bool(system_factor(&self.n.s, WHATS[what], eps))

    def solve(self, str what, const double[::1] r, bint refined=False):
        """With the last factor."""
        out_array = np.empty(self.m)
        cdef double[::1] out = out_array
        if what != "natural":
            system_solve(&self.n.s, WHATS[what], &r[0], &out[0])
        elif refined:
            solve_refined(&self.n.s, &r[0], &out[0], self.n.r, self.n.da)
        else:
            solve_natural(&self.n.s, &r[0], &out[0])
        return out_array

    def exchange(self, const double[::1] z):
        """One exchange from z (m,): (whether it is finite, z after it, relative residual, rows that changed)."""
        cdef newton_t* n = &self.n
        n.depth = 0
        begin_exchanges(n, &z[0])
        n.depth = 0
        finite = exchange_once(n)
        z_array = np.asarray(<double[:self.m]>n.exchange.z).copy()
        found = relative_at(n, n.exchange.z, n.exchange.hz)
        return finite, z_array, found, sides(n.s.e, n.exchange.z, n.exchange.hz, n.exchange.side, True)

    def begin(self, double delta, double share=0.0, bint apart=False):
        """The first point of an interior point."""
        begin_interior(&self.n, delta, share, apart)

    def advance(self):
        """A step of it: (whether it went, its length, gap before it, |F| and velocity error after it)."""
        went = interior_step(&self.n)
        return went, self.n.ip.length, self.n.ip.gap, self.n.ip.energy, self.n.ip.velocity

    @property
    def point(self):
        """z, u1, u2 (m,) of it."""
        cdef newton_t* n = &self.n
        return tuple(np.asarray(x).copy() for x in (
            <double[:self.m]>n.ip.z, <double[:self.m]>n.ip.u1, <double[:self.m]>n.ip.u2))

    def weigh(self, Elements e, double delta):
        """The interior point's V and B into v and bt, by its elements."""
        z, u1, u2 = self.point
        return e.scale(z, u1, u2, delta, self.v, self.bt)

    def slip(self, const double[::1] s, double share=1.0):
        """phi on normals and psi (m,) of s (m,)."""
        phi_array, psi_array = np.empty(self.m), np.empty(self.m)
        cdef double[::1] phi = phi_array, psi = psi_array
        slips(self.n.s.e, &s[0], share, &phi[0], &psi[0])
        return phi_array, psi_array

    def turn(self, double share):
        """De Saxce's small matrices of the interior point, into pair or v; psi (m,)."""
        duals(self.n.s.e, &self.n.ip, self.n.u)
        slips(self.n.s.e, self.n.u, share, self.n.c, self.n.psi)
        turn(&self.n.s, self.n.psi)
        return np.asarray(<double[:self.m]>self.n.psi).copy()
