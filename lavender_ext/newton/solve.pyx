"""Newton's method over the rows of A, dense, or over bodies, as workspace, start and step (`core/method.pxd`).

The unit of work is a factorisation; a step may do one or two more than it was asked for. After CERTIFICATE `options_t.proven`
= 1 ends it; without, the next step goes on.

Everything of the method is compiled here once: other modules call the functions that `solve.pxd` declares by pointer. The
classes are the same for Python, over arrays that `newton_t` points into, and its systems one by one for tests.
"""
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport address, zeros
from lavender_ext.core.method cimport (CERTIFICATE, MORE, NEEDS_WORKSPACE, UNFIT, Method, require_workspace, method_t, options_t,
                                       workspace_t, info_t)
from lavender_ext.core.block_types cimport COULOMB
from lavender_ext.core.problem cimport Data
from lavender_ext.core.view cimport rows_t, view_t
from lavender_ext.factor.blocks cimport (analyse_blocks, block_factor_index_size, block_factor_size, block_matrix_t,
                                         block_pattern_index_size)
from lavender_ext.factor.tiles cimport has_wide
from lavender_ext.newton.bodies cimport (bind_bodies, bind_body_workspace, furnish_factor, bind_pattern_workspace,
                                         body_workspace_size, factor_index_size, index_workspace_size, max_index_size,
                                         order_index, order_bodies, order_elements, panel_of, panel_of_velocities, pattern_t)
from lavender_ext.newton.elements cimport elements_t
from lavender_ext.newton.interior cimport ipm_scale
from lavender_ext.newton.path cimport path_compliance, smooth
from lavender_ext.newton.phases cimport begin_exchanges, exchange_once, sides
from lavender_ext.newton.plan cimport newton_start, newton_step
from lavender_ext.newton.run cimport (APPROACH, DE_SAXCE, EXCHANGES, INTERIOR, N_COUNTED, PATH, POLISH, PROXIMAL, PURSUIT,
                                      RELAXED, aim, bind_real_workspace, impulse_of, judge_workspace_size,
                                      bind_index_workspace, bind_judge_workspace, newton_t, own_index, own_workspace_size,
                                      proof_of, relative_at, set_reference)
from lavender_ext.newton.scaling cimport dense_matrix, find_elements, is_known
from lavender_ext.newton.steps cimport begin_interior, duals, interior_step, slips, turn
from lavender_ext.newton.system cimport (DENSE, OF_BARRIER, OF_NATURAL, OF_PAIR, SPARSE, dense_workspace_size,
                                         natural_times, others_t, solve_natural, solve_refined, system_factor,
                                         system_natural, system_sign, system_solve, system_times)

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
    "path": 1 << PATH,
}
#: Of s on z, along a path of smoothed problems.
COMPLIANCE = path_compliance()
#: What `Solve.ran` counts, as the message of a solution names it.
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
    "path steps",
)


# -- the method on plain structs --------------------------------------------------------------------------------


cdef struct state_t:            # at the beginning of the workspace's whole numbers
    newton_t n
    pattern_t a


cdef inline int64_t head() noexcept nogil:
    """Whole numbers of it."""
    return sizeof(state_t) // sizeof(int32_t)


cdef inline newton_t* state_of(const workspace_t* r) noexcept nogil:
    return &(<state_t*>r.index).n


cdef inline int32_t begin(newton_t* n, const options_t* o, const double* lam) noexcept nogil:
    """From lam (m), furnished."""
    n.tol, n.budget = o.tol, o.budget
    set_reference(&n.problem, o.e0, o.v0)
    newton_start(n, lam)
    return MORE


cdef int32_t system_step(const view_t* v, const options_t* o, const workspace_t* r, int32_t work, double* lam,
                                info_t* info) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef int32_t how
    n.budget, n.proven, n.stop = o.budget, o.proven, o.stop
    how = newton_step(n, work)
    if n.best <= n.tol or n.kept.seen == 0:
        impulse_of(n, n.best_z, lam)
    else:
        memcpy(lam, n.kept.impulse, v.p.n_rows * sizeof(double))
    info.work = info.factorisations = n.s.factorisations
    info.relative, info.tried = n.best, n.lam
    info.direction = proof_of(n) if how == CERTIFICATE else NULL
    return how


cdef int32_t rows_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """More than enough, whatever the numbers: as if every row moved, in contacts of six rows that rub."""
    cdef int64_t m = v.p.n_rows
    r.n_index = head() + own_index(m)
    r.n_real = judge_workspace_size(&v.p, NULL, NULL) + own_workspace_size(m, 6 * m) + 2 * m * m + dense_workspace_size(m, True) + 8
    return is_known(&v.p)


cdef int32_t rows_start(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef int64_t m = v.p.n_rows
    cdef workspace_t need
    cdef double* x
    rows_workspace_size(v, o, &need)
    if not require_workspace(r, need.n_index, need.n_real):
        return NEEDS_WORKSPACE
    memset(n, 0, sizeof(newton_t))
    aim(n, &v.p, v.a, NULL, NULL)
    x = bind_judge_workspace(n, r.real)
    bind_index_workspace(n, m, r.index + head())
    find_elements(&n.sc, v)
    memset(x, 0, own_workspace_size(m, n.sc.small) * sizeof(double))
    x = bind_real_workspace(n, v, x)
    n.s.form, n.s.wide = DENSE, o.wide
    n.s.h, n.s.whole, n.s.lower = x, x + m * m, x + 2 * m * m
    n.s.symmetric = dense_matrix(&n.sc, v.a, <int32_t>m, n.s.swap, x)
    return begin(n, o, lam)


cdef int32_t bodies_workspace_size(const view_t* v, const options_t* o, workspace_t* r) noexcept nogil:
    """Write the integers of the elimination order; `start` computes the sizes for the factor."""
    cdef int64_t size = index_workspace_size(&v.p, v.r)
    r.n_index, r.n_real = head() + size, 0
    return size > 0


cdef int64_t max_bodies_index_size(const view_t* v) noexcept nogil:
    """Return integers that always suffice, for a host that cannot enlarge them; 0 if the method does not apply."""
    cdef int64_t size = max_index_size(&v.p, v.r)
    return head() + size if size > 0 else 0


cdef int32_t bodies_start(const view_t* v, const options_t* o, workspace_t* r, const double* lam) noexcept nogil:
    cdef newton_t* n = state_of(r)
    cdef pattern_t* a = &(<state_t*>r.index).a
    cdef int64_t below, first = head() + index_workspace_size(&v.p, v.r), needed
    cdef int32_t* index = r.index + first + first % 2       # a multiple of 8 bytes
    if not r.is_bound:
        if not require_workspace(r, first, 0):
            return NEEDS_WORKSPACE
        memset(n, 0, sizeof(newton_t))
        bind_bodies(n, a, r.index + head(), &v.p, v.r)
        find_elements(&n.sc, v)
        below = order_elements(&n.sc, a, v.r)
        if 6 * below > 2147483647:
            return UNFIT
        needed = first + 1 + factor_index_size(a.n, a.nptr[a.n], below)
        if not require_workspace(r, needed, 0):
            return NEEDS_WORKSPACE
        r.work = analyse_blocks(&n.blocks, a.n, 6, a.nptr, a.nind, a.parent, a.lptr, index)
        r.is_bound = 1
    if not require_workspace(r, r.n_index, judge_workspace_size(&v.p, v.r, NULL) + body_workspace_size(n, &v.p, v.r)):
        return NEEDS_WORKSPACE
    aim(n, &v.p, NULL, v.r, NULL)
    index += block_pattern_index_size(a.n, 6, a.nptr[a.n], a.lptr[a.n])
    bind_body_workspace(n, a, bind_judge_workspace(n, r.real), v, o.wide, index)
    return begin(n, o, lam)


# -- for Python ------------------------------------------------------------------------------------------------


cdef class Solve(Method)        # defined below


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
        self.raised = self.raised or error              # the first one, of which this may come
        self.n.stop = 1
        view[:] = np.nan


cdef inline object part(object array, const void* at, Py_ssize_t n):
    cdef Py_ssize_t i = (<const char*>at - <const char*>address(array)) // <Py_ssize_t>array.itemsize
    return array[i:i + n]


cdef class Layout:
    """Elimination order of n bodies with s unknowns each, and the pattern of a factor; it may be reused between problems.

    body (k, 2) are the bodies of each element, -1 static.
    """
    cdef pattern_t a
    cdef block_matrix_t blocks
    cdef object index, pattern
    cdef readonly object body, node                     # (k, 2) bodies and block columns of each element
    cdef readonly object turned                        # (k,) whether an element's bodies are exchanged
    cdef readonly object nptr, lptr                     # (n + 1) blocks of N by rows, and of L by columns
    cdef readonly int n, s, supernodes
    cdef readonly double work                           # multiply-adds of a factor, without stored zeros

    def __init__(self, const int32_t[:, ::1] body, int n, int s):
        cdef pattern_t* a = &self.a
        cdef int64_t k = body.shape[0], below
        cdef int32_t i
        self.index = np.empty(order_index(n, k) + 2, np.int32)
        bind_pattern_workspace(a, <int32_t*>address(self.index), n, k)
        if k:
            memcpy(a.body, &body[0, 0], 2 * k * sizeof(int32_t))
        with nogil:
            below = order_bodies(a)
        if s * below >= 2**31:
            raise OverflowError("the factor has 2^31 rows of blocks or more")
        self.pattern = np.empty(block_pattern_index_size(n, s, a.nptr[n], below), np.int32)
        analyse_blocks(&self.blocks, n, s, a.nptr, a.nind, a.parent, a.lptr, <int32_t*>address(self.pattern))
        self.n, self.s, self.supernodes = n, s, self.blocks.factor.supernodes
        for i in range(n):
            self.work += 0.5 * <double>(a.lptr[i + 1] - a.lptr[i]) * (a.lptr[i + 1] - a.lptr[i])
        self.work = s**3 * (self.work + below + n)
        self.body, self.node = part(self.index, a.body, 2 * k).reshape(k, 2), part(self.index, a.node, 2 * k).reshape(k, 2)
        self.turned = part(self.index, a.turned, k)
        self.nptr, self.lptr = part(self.index, a.nptr, n + 1), part(self.index, a.lptr, n + 1)

    def serves(self, body, int n, int s):
        """Whether it is that of n bodies, s unknowns each, with these elements (k, 2)."""
        return self.n == n and self.s == s and np.array_equal(self.body, body)


cdef class Solve(Method):
    """A problem as Newton's method has it, and what factors it by one of `over_...`; `start`, then `step` after `step`.

    Fixed rows (equal bounds, mu = 0 tangents, empty rows) are taken out: keep (m,) are the rows that move, block (n,) that
    of each element, fixed (rows,) the impulse of the others; scale (m,) is D^-1/2; ptr, part, wptr, lower, upper, theta, g,
    reach are those of `elements_t`, v, einv, p, pair and bt its small matrices.

    Parameters
    ----------
    data : Data
        With d and nu, its error of doing nothing known.
    matrix : Data or None
        Of A in compressed rows; None: over the bodies of `data`, or what `graph.bodies_in` tells of its velocities.
    """
    cdef newton_t* n
    cdef others_t calls
    cdef list held
    cdef object others, raised, real, index
    cdef readonly object keep, block, ptr, part, wptr, fixed, scale, theta, g, lower, upper, reach
    cdef readonly object v, einv, p, pair, bt           # small matrices of every element
    cdef readonly int m

    def __init__(self, Data data, Data matrix=None):
        cdef newton_t* n
        cdef view_t v = data.view() if matrix is None else view_t(data.blocks, &matrix.csr, NULL, NULL)
        cdef int64_t rows = data.blocks.n_rows, k
        self.data, self.view, self.own = data, data.view(), method_t(NULL, NULL, system_step)
        self.index = np.zeros(head() + own_index(rows) + 1, np.int32)
        self.space.index = <int32_t*>address(self.index)
        n = self.n = state_of(&self.space)
        aim(n, &self.view.p, self.view.a, self.view.r, self.view.g)
        set_reference(&n.problem, data.reference_energy, data.reference_velocity)
        judge = zeros(judge_workspace_size(&n.problem.p, n.problem.r, n.problem.g))
        self.held = [matrix, judge]
        bind_judge_workspace(n, <double*>address(judge))
        bind_index_workspace(n, rows, self.space.index + head())
        find_elements(&n.sc, &v)
        self.real = zeros(own_workspace_size(rows, n.sc.small))
        bind_real_workspace(n, &v, <double*>address(self.real))
        m = self.m = n.sc.e.m
        k = n.sc.e.n
        self.keep, self.block = part(self.index, n.sc.keep, m), part(self.index, n.sc.block, k)
        self.ptr = part(self.index, n.sc.e.ptr, k + 1)
        self.wptr, self.part = part(self.index, n.sc.e.wptr, k + 1), part(self.index, n.sc.e.part, k + 1)
        self.fixed, self.scale = part(self.real, n.sc.fixed, rows), part(self.real, n.sc.scale, m)
        self.theta, self.g = part(self.real, n.sc.e.theta, m), part(self.real, n.sc.e.g, m)
        self.lower, self.upper = part(self.real, n.sc.e.lower, m), part(self.real, n.sc.e.upper, m)
        self.reach = part(self.real, n.sc.e.reach, int(self.part[k]))
        self.v, self.einv = part(self.real, n.s.v, n.sc.small), part(self.real, n.s.einv, n.sc.small)
        self.p, self.pair = part(self.real, n.s.p, n.sc.small), part(self.real, n.s.pair, n.sc.small)
        self.bt = part(self.real, n.s.bt, n.sc.small) if n.s.bt != NULL else None
        self.calls = others_t(<void*>self, call_factor, call_solve)

    @property
    def whole(self):
        """Every row moves."""
        return bool(self.n.sc.whole)

    @property
    def has_friction(self):
        """Some element has more rows than one: a contact with tangents or spin that move."""
        return self.n.sc.e.n < self.n.sc.e.m

    # -- what factors it ---------------------------------------------------------------------------

    def ask(self, others):
        """Who factors and solves what is not factored here."""
        self.others, self.n.s.others = others, &self.calls

    def over_rows(self, double[:, ::1] h, bint symmetric, bint wide):
        """H (m, m), dense."""
        cdef double[::1] whole = np.empty(self.m * self.m + 1)
        cdef double[::1] lower = np.empty(dense_workspace_size(self.m, self.has_friction) + 1)
        self.held += [h, whole, lower]
        self.n.s.form, self.n.s.symmetric, self.n.s.wide = DENSE, symmetric, wide and has_wide()
        self.n.s.h, self.n.s.whole, self.n.s.lower = &h[0, 0] if self.m else NULL, &whole[0], &lower[0]

    def over_entries(self, indptr, indices, values, bint symmetric):
        """H in compressed rows, which others factor."""
        self.held += [indptr, indices, values]
        self.n.s.form, self.n.s.symmetric = SPARSE, symmetric
        self.n.s.a.indptr, self.n.s.a.indices = <int32_t*>address(indptr), <int32_t*>address(indices)
        self.n.s.a.data = <double*>address(values)

    def jacobian(self, const int32_t[:, ::1] pair, const int32_t[::1] column=None):
        """K = D^-1/2 J M^-1/2 (rows, 12) of the bodies, and which of a body's six columns are kept: 1, 2, 3 or 6.

        pair (blocks, 2) are the bodies of each block; with J and M column (nv,) as well, of `graph.bodies_in`. What is at
        most 1e-9 (spheres turned by the rounding of their arms) is nothing: H = K K^T + theta has a unit diagonal, and
        feels 1e-18 of it.
        """
        cdef const rows_t* r = &self.data.rows
        cdef int64_t i, rows = self.data.blocks.n_rows
        cdef int32_t used = 0
        panel = np.zeros((rows, 12))
        cdef double* k = <double*>address(panel)
        cdef double[::1] root = np.empty(10 * r.n_bodies + 1)
        with nogil:
            if column is not None:
                panel_of_velocities(&self.data.blocks, &self.data.general, &pair[0, 0], &column[0], k)
            elif r.n_bodies:
                panel_of(&self.data.blocks, r, &root[0], k)
            for i in range(12 * rows):
                if not -1e-9 <= k[i] <= 1e-9:
                    used = used | (1 << (i % 6))
                    if used == 63:
                        break
        columns = [c for c in range(6) if used >> c & 1] or [0]
        return panel, np.array(columns if len(columns) <= 3 else range(6), np.int32)

    def over_bodies(self, panel, const int32_t[::1] columns, Layout layout, bint lu, bint wide):
        """Use K of `jacobian`, which is overwritten, with these columns of each body; lu: N may have to be factored as L U."""
        cdef block_matrix_t* f = &self.n.blocks
        cdef pattern_t a = layout.a
        cdef int32_t factored = a.n * layout.s
        f[0] = layout.blocks
        own = np.empty(block_factor_index_size(a.n, layout.s) + len(self.ptr) + 1, np.int32)
        a.group = <int32_t*>address(own) + block_factor_index_size(a.n, layout.s)
        values = np.empty(factored + block_factor_size(f, lu) + 1)
        self.held += [panel, layout, own, values]
        furnish_factor(self.n, &a, <double*>address(panel), &columns[0], layout.s, lu, wide and has_wide(), <int32_t*>address(own),
                    <double*>address(values), <double*>address(values) + factored)

    # -- turns -------------------------------------------------------------------------------------

    def start(self, const double[::1] impulse, double tol, int budget):
        """From impulse (rows,), to a relative residual of tol, with so many factorisations."""
        self.aim(tol, budget)
        self.raised = None
        with nogil:
            begin(self.n, &self.options, &impulse[0])

    def step(self, int work, double[::1] impulse):
        """`work` factorisations or a few more; how it stands, impulse (rows,) the best so far."""
        Method.step(self, work, impulse)
        if self.raised is not None:
            error, self.raised = self.raised, None
            raise error
        return self.how

    @property
    def ran(self):
        """How often what ran, in the order of `COUNTED`."""
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

    def smooth(self, const double[::1] z, double tau, double wide=1.0):
        """F (m,) of path.pxd with c = wide, and dF / d log tau (m,); its derivative's small matrices into p, einv and v."""
        cdef newton_t* n = self.n
        n.s.law, n.path.wide, n.path.eps = COULOMB, wide, path_compliance()
        smooth(n, &z[0], tau, True)
        return np.asarray(<double[:self.m]>n.f).copy(), np.asarray(<double[:self.m]>n.c).copy()

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

    @property
    def sign(self):
        """Of the determinant of the last "natural" factor; 0 where others factor."""
        return system_sign(&self.n.s)

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
        cdef newton_t* n = self.n
        n.depth = 0
        begin_exchanges(n, &z[0])
        n.depth = 0
        finite = exchange_once(n)
        z_array = np.asarray(<double[:self.m]>n.exchange.z).copy()
        found = relative_at(n, n.exchange.z, n.exchange.hz)
        return finite, z_array, found, sides(n.s.e, n.exchange.z, n.exchange.hz, n.exchange.side, True)

    def begin(self, double delta, double share=0.0):
        """The first point of an interior point."""
        begin_interior(self.n, delta, share)

    def advance(self):
        """A step of it: (whether it went, its length, gap before it, |F| and velocity error after it)."""
        went = interior_step(self.n)
        return went, self.n.ip.length, self.n.ip.gap, self.n.ip.energy, self.n.ip.velocity

    @property
    def point(self):
        """z, u1, u2 (m,) of it."""
        cdef newton_t* n = self.n
        return tuple(np.asarray(x).copy() for x in (
            <double[:self.m]>n.ip.z, <double[:self.m]>n.ip.u1, <double[:self.m]>n.ip.u2))

    def weigh(self, double delta):
        """The interior point's V = (W + theta + delta)^-1 and B, V = B B^T, into v and bt; the gap."""
        cdef newton_t* n = self.n
        cdef double gap
        ipm_scale(n.s.e, n.ip.z, n.ip.u1, n.ip.u2, delta, n.s.v, n.s.bt, &gap)
        return gap

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


cdef const elements_t* elements_of(object solve) except NULL:
    """Elements of a `Solve`."""
    return &(<Solve?>solve).n.sc.e
