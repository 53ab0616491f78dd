"""The judge: its pass over any form of A, and its functions for Python."""
from libc.math cimport INFINITY, NAN, sqrt
from libc.stdint cimport int32_t
from libc.string cimport memcmp, memcpy

import numpy as np

from lavender_ext.core.validate cimport all_finite as is_finite
from lavender_ext.core.arrays cimport as_double_pointer
from lavender_ext.core.csr cimport csr_row_dot_with_abs_sum
from lavender_ext.core.dot cimport dot
from lavender_ext.core.generalized cimport multiply_whitened_transpose
from lavender_ext.core.islands cimport find_islands, island_workspace_integers
from lavender_ext.core.block_types cimport blocks_t, islands_t
from lavender_ext.core.problem cimport Data, Workspace, allocate_bytes
from lavender_ext.core.velocity cimport compute_velocity_change
from lavender_ext.core.view cimport generalized_t, view_t
from lavender_ext.core.blocks cimport Blocks
from lavender_ext.judge.bounds cimport project_all_on_bounds, project_far_excess, project_on_bounds
from lavender_ext.core.start cimport is_zero_impulse
from lavender_ext.judge.best cimport (begin_at_better_point, best_workspace_size, best_t, bind_best, copy_island_impulse,
                                      copy_score_without_islands, count_islands, seems_without_solution,
                                      store_better_islands, store_start)
from lavender_ext.judge.forms cimport (compute_csr_slack, judge_impulse_over_bodies, judge_impulse_over_generalized,
                                       score_generalized_slack)
from lavender_ext.judge.measure cimport (residual_above_floor, set_zero_impulse, relative_floor_of_score,
                                         relative_residual_of_score, count_judge_scratch)
from lavender_ext.judge.reference cimport compute_reference, compute_terms, has_island_without_scale, is_row_unmoved
from lavender_ext.judge.refine cimport estimate_factor_loss, min_reported_loss, refine_generalized_slack
from lavender_ext.judge.rounding cimport mass_t, relative_size_of_change, compute_squared_float32_rounding
from lavender_ext.judge.score cimport is_at_floor, make_empty_score, relative_residual, score_t
from lavender_ext.judge.slack cimport compute_generalized_slack, compute_body_slack
from lavender_ext.judge.tally cimport (add_block_error, add_island_to_score, compute_rhs_energy_norm, get_block_in_order,
                                       get_row_terms, index_of_island_begin, index_of_island_end, make_empty_tally,
                                       score_all_blocks, tally_t)


cdef void judge_view(const view_t* v, const double* lam, double* w, double* e, double* scratch, bint floor,
                     score_t* out) noexcept nogil:
    """Judge lam (m) [N s]: compute its slack w (m) [m/s], its error e (m) [N s] and the norms in `out`, with `floor` the floors.

    scratch has `count_judge_scratch` doubles; without a floor 6 n suffice over n bodies, and none over A.
    """
    cdef int32_t i
    if v.g != NULL:
        judge_impulse_over_generalized(&v.p, v.g, lam, w, e, scratch, floor, out)
    elif v.r != NULL:
        judge_impulse_over_bodies(&v.p, v.r, lam, w, e, scratch, floor, out)
    elif floor:                                         # scratch (m) receives |A| |lam|.
        for i in range(v.p.n_rows):
            w[i] = csr_row_dot_with_abs_sum(v.a, i, lam, scratch + i) - v.p.b[i]
        score_all_blocks(&v.p, lam, w, e, scratch, out)
    else:
        compute_csr_slack(&v.p, v.a, lam, w)
        score_all_blocks(&v.p, lam, w, e, NULL, out)


cdef bint refine_view(const view_t* v, const double* lam, double* w, double* e, double* scratch, double reference_energy,
                      double reference_velocity, double tol, double relative_, score_t* out) noexcept nogil:
    """Repeat the pass of `judge_view` with refinement if judge/refine.pxd (2) requires it; return whether it was repeated.

    w, e and out are the results of `judge_view`, relative_ is its relative residual. They are unchanged if the pass is not
    repeated. Problems given by A or by bodies need no refinement. scratch (`count_judge_scratch`).
    """
    if v.g == NULL or v.p.n_rows == 0 or not relative_ < 1.0 / 0.0:
        return False
    if estimate_factor_loss(&v.p, v.g, lam, w, scratch, reference_energy, reference_velocity,
                      0.1 * (tol if tol > relative_ else relative_)) == 0.0:
        return False
    refine_generalized_slack(&v.p, v.g, lam, w, e, scratch, out)
    return True


cdef bint refine_reported_view(const view_t* v, const double* lam, double* w, double* e, double* scratch, double reference_energy,
                               double reference_velocity, double tol, double relative_, score_t* out) noexcept nogil:
    """Repeat a pass whose numbers are reported: as `refine_view`, and if the factor of M may cause an error above 1e-8.

    With an infinite tol the pass is not repeated.
    """
    cdef double strictest = 10.0 * min_reported_loss()
    if not tol < 1.0 / 0.0:
        return False
    return refine_view(v, lam, w, e, scratch, reference_energy, reference_velocity, tol if tol < strictest else strictest,
                       relative_ if relative_ < strictest or not relative_ < 1.0 / 0.0 else strictest, out)


cdef void score_given_generalized_slack(const blocks_t* p, const generalized_t* g, const double* lam, const double* w,
                                        double* e, double* x, score_t* out) noexcept nogil:
    """Compute errors e (m) from the slack w over J and M, their norms and floors; x (n + m) is scratch."""
    score_generalized_slack(p, g, lam, w, e, x, NULL, out)


cdef void score_given_slack(const blocks_t* p, const double* lam, const double* w, double* e, score_t* out) noexcept nogil:
    """Compute errors e (m) from the slack w and their norms, without floors."""
    score_all_blocks(p, lam, w, e, NULL, out)


cdef void find_reference(blocks_t* p, const double* x, const double* w, const double* e, double* out) noexcept nogil:
    """Call `compute_reference` of judge/reference.pxd, which is compiled here for other modules."""
    compute_reference(p, x, w, e, out)


cdef bint judge_zero_impulse(view_t* v, int32_t* index, islands_t* islands, double* reference, const int32_t* empty,
                             const double* free, double* terms, double* x, double* w, double* e, double* scratch,
                             double* out) noexcept nogil:
    """Judge the zero impulse, written to x (m), and write the results of `compute_reference` to out (3).

    If there are several islands, v.p receives them with their references. index (`island_workspace_integers`), islands,
    reference (3 k) and terms (m) must live as long as v. empty (m) marks the zero rows of A, free is v* (`compute_row_terms`);
    either may be NULL. w, e (m) and scratch (as in `judge_view` without a floor) are scratch. If terms is NULL, return whether
    a row needs it; the references are then not valid.
    """
    cdef score_t s = make_empty_score()
    cdef bint unmoved = False                           # whether no impulse moves a row with b != 0
    cdef int32_t i, k
    for i in range(v.p.n_blocks if empty != NULL else 0):
        for k in range(v.p.ptr[i], v.p.ptr[i + 1]):
            unmoved = unmoved or (is_row_unmoved(&v.p, empty, i, k) and v.p.b[k] != 0.0)
    v.p.islands = NULL
    if set_zero_impulse(&v.p, x, w):
        judge_view(v, x, w, e, scratch, False, &s)
    else:
        score_all_blocks(&v.p, x, w, e, NULL, &s)
    islands.reference = reference
    if find_islands(v, index, islands) > 1:
        v.p.islands = islands
    compute_reference(&v.p, x, w, e, out)
    if v.p.islands == NULL and (unmoved or out[0] < 0.0 and v.p.n_rows > 0):    # (3) of judge/reference.pxd needs a list.
        k = v.p.n_blocks
        for i in range(k):
            index[i], index[k + i] = 0, i
        index[2 * k], index[2 * k + 1] = 0, k
        islands.n, islands.label, islands.order, islands.ptr = 1, index, index + k, index + 2 * k
        islands.terms = NULL
        v.p.islands = islands
        compute_reference(&v.p, x, w, e, out)
    if not unmoved and not has_island_without_scale(&v.p, empty):
        return False
    if terms == NULL:
        return True
    compute_terms(v, empty, free, out[0], e, terms)
    islands.terms = terms
    compute_reference(&v.p, x, w, e, out)
    return False


cdef void choose_start(const view_t* v, bint symmetric, const double* zero_residual, double tol, double* lam,
                       double* scratch) noexcept nogil:
    """Project the start lam (m) on its bounds, and set it to the zero impulse in islands that begin there (judge/best.pxd).

    zero_residual (3): E0, V0 and the relative residual of the zero impulse; scratch (`count_start_scratch`).
    """
    cdef score_t s = make_empty_score()
    cdef double* now = scratch + 2 * <ssize_t>v.p.n_rows
    cdef double energy, objective
    cdef int32_t i
    project_on_bounds(&v.p, lam)
    if is_zero_impulse(&v.p, lam):
        return
    if v.g != NULL and v.p.islands == NULL and zero_residual[2] >= 0.5:
        # A start whose objective f = 1/2 |Y^T lam|^2 + 1/2 compliance lam^2 - b.lam is clearly below 0 is kept.
        multiply_whitened_transpose(v.g, lam, now)
        energy = objective = 0.5 * dot(now, now, v.g.n)
        for i in range(v.p.n_rows):
            objective += lam[i] * (0.5 * v.g.compliance[i] * lam[i] - v.p.b[i])
        if -INFINITY < objective < -1e-6 * energy:      # M with a condition up to 1e8 may change f by 1e-6 of the energy.
            return
    s.by_island = now
    judge_view(v, lam, scratch, scratch + v.p.n_rows, now + 2 * count_islands(&v.p), False, &s)
    if v.p.islands == NULL:
        now[0] = relative_residual_of_score(&s, scratch, v.p.n_rows, zero_residual[0], zero_residual[1])
    begin_at_better_point(&v.p, now, zero_residual[2], scratch, symmetric, tol, lam)


def compute_slack(Data p, const double[::1] lam, double[::1] w):
    """Compute w (m,) = A lam - b [m/s]."""
    cdef double[::1] v
    if p.blocks.n_rows == 0:
        return
    if p.is_general:
        v = np.empty(p.general.n + 1)
        with nogil:
            compute_generalized_slack(&p.blocks, &p.general, &lam[0], &v[0], &w[0])
    elif p.factored:
        v = np.empty(6 * p.rows.n_bodies + 1)
        with nogil:
            compute_velocity_change(&p.blocks, &p.rows, &lam[0], &v[0])
            compute_body_slack(&p.blocks, &p.rows, &lam[0], &v[0], &w[0])
    else:
        with nogil:
            compute_csr_slack(&p.blocks, &p.csr, &lam[0], &w[0])


def is_residual_at_floor(double relative_, double floor):
    """Return `is_at_floor` of judge/score.pxd."""
    return is_at_floor(relative_, floor)


cdef Judged make_judged(Data p, impulse, both, const score_t* s, double relative_, double floor, double float64_relative=NAN):
    """Create the result of a pass over `impulse`, with w and e in `both` (2 m + 1)."""
    cdef Judged judged = Judged.__new__(Judged)
    judged.set_score(p, impulse, both, s, relative_, floor, float64_relative)
    return judged


cdef class Judged:
    """Result of the judge's pass over one impulse, with its floor.

    `p` must know the references of the zero impulse. `impulse` (m,) is not copied and must not change afterwards; the other
    arrays belong to this object.
    """

    def __init__(self, Data p, impulse):
        cdef const double[::1] lam = impulse
        cdef Py_ssize_t m = lam.shape[0]
        cdef double[::1] both
        cdef double* w
        cdef double* e
        cdef Workspace workspace
        cdef view_t v = p.get_pointers()
        cdef score_t s = make_empty_score()
        numbers = both = np.empty(2 * m + 1)
        w = &both[0]
        e = w + m
        if m > 0:
            workspace = allocate_bytes(count_judge_scratch(&v) * sizeof(double))
            with nogil:
                judge_view(&v, &lam[0], w, e, <double*>workspace.at, True, &s)
        self.set_score(p, impulse, numbers, &s,
                       relative_residual_of_score(&s, w, p.blocks.n_rows, p.reference_energy, p.reference_velocity),
                       relative_floor_of_score(&s, p.reference_energy, p.reference_velocity), NAN)

    cdef void set_score(self, Data p, impulse, both, const score_t* s, double relative_, double floor, double float64_relative):
        """Set the fields from the score of a pass over `impulse`, with w and e in `both` (2 m + 1)."""
        self.data, self.impulse, self.both = p, impulse, both
        self.energy = s.energy if s.finite else 1.0 / 0.0
        self.velocity = s.velocity if s.finite else 1.0 / 0.0
        self.floor_energy, self.worst, self.island = s.floor_energy, s.worst, s.island
        self.relative, self.roundoff_floor, self.above_floor = relative_, floor, residual_above_floor(s, relative_, floor)
        self.float64_relative = float64_relative
        self.known_loss = -1.0 if p.is_general and float64_relative != float64_relative else 0.0

    @property
    def loss(self):
        """Possible error due to the factor of M, as a relative residual (judge/refine.pxd (2)); 0 after refinement."""
        cdef Data p = self.data
        cdef const double[::1] lam, w
        cdef Workspace workspace
        if self.known_loss < 0.0 and p.blocks.n_rows > 0:
            lam, w = self.impulse, self.both
            workspace = allocate_bytes(2 * <Py_ssize_t>p.general.n * sizeof(double))
            self.known_loss = estimate_factor_loss(&p.blocks, &p.general, &lam[0], &w[0], <double*>workspace.at,
                                                   p.reference_energy, p.reference_velocity, 0.0)
        return max(self.known_loss, 0.0)

    def refine(self, double tol):
        """Return the refined pass if `tol` or a report requires it (judge/refine.pxd (2)), otherwise self."""
        cdef Data p = self.data
        cdef int32_t m = p.blocks.n_rows
        cdef view_t v = p.get_pointers()
        cdef score_t s = make_empty_score()
        cdef const double[::1] lam
        cdef const double[::1] first
        cdef double[::1] both
        cdef Workspace workspace
        if not (self.relative < 1.0 / 0.0 and self.loss > min(0.1 * max(tol, self.relative), min_reported_loss())):
            return self
        lam, first = self.impulse, self.both
        workspace = allocate_bytes((2 * m + count_judge_scratch(&v)) * sizeof(double))
        memcpy(workspace.at, &first[0], m * sizeof(double))
        with nogil:
            refine_generalized_slack(&p.blocks, &p.general, &lam[0], <double*>workspace.at, <double*>workspace.at + m,
                           <double*>workspace.at + 2 * m, &s)
        results = both = np.empty(2 * m + 1)
        memcpy(&both[0], workspace.at, 2 * m * sizeof(double))
        return make_judged(p, self.impulse, results, &s,
                           relative_residual_of_score(&s, &both[0], m, p.reference_energy, p.reference_velocity),
                           relative_floor_of_score(&s, p.reference_energy, p.reference_velocity), self.relative)

    @property
    def slack(self):
        """Slack w (m,) [m/s]."""
        return self.both[:self.data.blocks.n_rows]

    @property
    def error(self):
        """Error e (m,) [N s]."""
        return self.both[self.data.blocks.n_rows:2 * self.data.blocks.n_rows]


def list_residual_fields(Judged judged, problem, rest):
    """Return the fields of a `Residual` of the package; `rest` computes those with one number for each row."""
    return {
        "relative": judged.relative, "energy": judged.energy, "velocity": judged.velocity,
        "roundoff_floor": judged.roundoff_floor, "above_floor": judged.above_floor, "worst_island": judged.island,
        "floor_energy": judged.floor_energy, "worst_row": judged.worst, "energy_at_zero": judged.data.reference_energy,
        "velocity_at_zero": judged.data.reference_velocity, "_problem": problem, "_impulse": judged.impulse,
        "precision": "float64", "rounding": None, "_float64_relative": judged.float64_relative,
        "_rest": (rest, (judged,)),
    }


def make_relative_score(double energy, double velocity, double reference_energy, double reference_velocity):
    """Return the relative residual: the larger ratio of an error to its reference; inf if a number is not finite."""
    return relative_residual(energy, velocity, reference_energy, reference_velocity)


def combine_references(Data p, const int32_t[::1] rows):
    """Return E0 [sqrt J] and V0 [m/s] over the islands with these ascending rows.

    They are the norms of the rows' own terms if no impulse moves any of the rows, and in an island without E0 and V0.
    """
    cdef const islands_t* s = p.blocks.islands
    cdef int32_t block = 0, i, k
    cdef double energy = 0.0, fast = 0.0, own
    cdef bint unmoved = True
    if s == NULL:
        return p.reference_energy, p.reference_velocity
    seen = set()
    for k in rows:
        unmoved = unmoved and s.terms != NULL and s.terms[k] < 0.0
    for k in rows:
        while p.blocks.ptr[block + 1] <= k:
            block += 1
        i = s.label[block]
        if unmoved or s.reference[2 * i] < 0.0:
            own = get_row_terms(&p.blocks, k)
            energy += own / p.blocks.d[k] * own
            fast = max(fast, sqrt(p.blocks.nu[k] / p.blocks.d[k]) * own)
        elif i not in seen:
            seen.add(i)
            energy += s.reference[2 * i] * s.reference[2 * i]
            fast = max(fast, s.reference[2 * i + 1])
    return sqrt(energy), fast


def all_finite(const double[::1] x):
    """Return whether x holds neither NaN nor infinity."""
    return is_finite(&x[0], x.shape[0]) if x.shape[0] else True


def compute_rhs_energy(Data p):
    """Return the energy norm of b [sqrt J]."""
    return compute_rhs_energy_norm(&p.blocks)


def are_bit_identical(const double[::1] x, const double[::1] y):
    """Return whether two arrays are bit-identical."""
    cdef Py_ssize_t n = x.shape[0]
    return y.shape[0] == n and (n == 0 or memcmp(&x[0], &y[0], n * sizeof(double)) == 0)


def store_zero_impulse_residual(Data p, const double[::1] velocity=None):
    """Judge the zero impulse, store islands, references and its relative residual in the data, and return it (m,), read-only.

    velocity is v*, (6 n,) over bodies and (n,) over J and M in the order of the factor.
    """
    cdef Py_ssize_t m = p.blocks.n_rows, k = p.blocks.n_blocks
    cdef view_t v = p.get_pointers()
    cdef double[::1] x
    cdef double out[3]
    cdef islands_t islands
    cdef Workspace workspace = allocate_bytes((3 * m + 3 * k + count_judge_scratch(&v)) * sizeof(double))
    cdef Workspace marks = allocate_bytes(island_workspace_integers(&v) * sizeof(int32_t))
    cdef double* w = <double*>workspace.at
    cdef int32_t[::1] empty = None
    start = np.zeros(m)
    x = start
    if len(p.empty):
        empty = np.isin(np.arange(m), p.empty).astype(np.int32)
    judge_zero_impulse(&v, <int32_t*>marks.at, &islands, w + 3 * m, &empty[0] if empty is not None else NULL,
                       &velocity[0] if velocity is not None and velocity.shape[0] else NULL, w + 2 * m, &x[0] if m else NULL, w,
                       w + m, w + 3 * m + 3 * k, out)
    start.setflags(write=False)
    p.store_reference(v.p.islands, out)
    return start


def residuals_by_island(Data p, const double[::1] lam, double tol=INFINITY):
    """Return the islands of the blocks (k,) and a table (n, 5) of an impulse (m,) [N s], with one row per island.

    Columns: relative residual, E [sqrt J], V [m/s], E0 [sqrt J], V0 [m/s] of judge/score.pxd; E0 and V0 are -1 if no row acts.
    With a finite tol they are the numbers that are reported, with floors and refined for tol.
    """
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef view_t v = p.get_pointers()
    cdef const islands_t* s = p.blocks.islands
    cdef int32_t i, a, n = s.n if s != NULL else 1
    cdef score_t score = make_empty_score()
    cdef tally_t t
    cdef double now
    cdef double[::1] w = np.empty(2 * m + 2 * n + count_judge_scratch(&v) + 1)
    label_, table_ = np.zeros(p.blocks.n_blocks, np.int32), np.zeros((n, 5))
    cdef int32_t[::1] label = label_
    cdef double[:, ::1] table = table_
    if m == 0:
        return label_, table_[:0]
    score.by_island = &w[2 * m]
    judge_view(&v, &lam[0], &w[0], &w[m], &w[2 * m + 2 * n], tol < INFINITY, &score)
    if tol < INFINITY:
        now = relative_residual_of_score(&score, &w[0], m, p.reference_energy, p.reference_velocity)
        refine_reported_view(&v, &lam[0], &w[0], &w[m], &w[2 * m + 2 * n], p.reference_energy, p.reference_velocity, tol, now,
                             &score)
    if s == NULL:
        table[0, 0] = relative_residual_of_score(&score, &w[0], m, p.reference_energy, p.reference_velocity)
        table[0, 1], table[0, 2] = score.energy, score.velocity
        table[0, 3], table[0, 4] = p.reference_energy, p.reference_velocity
        return label_, table_
    for i in range(p.blocks.n_blocks):
        label[i] = s.label[i]
    for i in range(n):
        t = make_empty_tally()
        for a in range(s.ptr[i], s.ptr[i + 1]):
            add_block_error(&p.blocks, s.order[a], &w[m], &t)
        table[i, 0], table[i, 1] = score.by_island[2 * i], score.by_island[2 * i + 1]
        table[i, 2] = sqrt(t.fast) if t.fast > 0.0 else 0.0
        table[i, 3], table[i, 4] = s.reference[2 * i], s.reference[2 * i + 1]
    return label_, table_


def measure_error(Data p, const double[::1] e):
    """Return E [sqrt J], V [m/s] and the worst row of errors e (m) [N s], and the relative residual of each island (n,)."""
    cdef const islands_t* s = p.blocks.islands
    cdef int32_t i, a, n = s.n if s != NULL else 1
    cdef score_t score = make_empty_score()
    cdef tally_t t, total = make_empty_tally()
    cdef double[:, ::1] table = np.zeros((n, 2))
    cdef double energy, velocity
    score.by_island = &table[0, 0]
    for i in range(n):
        t = make_empty_tally()
        for a in range(index_of_island_begin(&p.blocks, i), index_of_island_end(&p.blocks, i)):
            add_block_error(&p.blocks, get_block_in_order(s.order if s != NULL else NULL, a), &e[0], &t)
        add_island_to_score(&p.blocks, i, &e[0], &e[0], &t, NULL, &total, &score)
    energy, velocity = sqrt(total.energy), sqrt(total.fast) if total.fast > 0.0 else 0.0
    if s == NULL:
        table[0, 0] = relative_residual(energy, velocity, p.reference_energy, p.reference_velocity)
    return energy, velocity, total.worst, np.asarray(table)[:, 0].tolist()


cdef class BestImpulse:
    """The best impulse of a solve in each island, by judge/best.pxd.

    Parameters
    ----------
    p : Data
        Problem that knows the references of the zero impulse.
    start : (m,) N s
        Start of the solve, which is projected on its bounds.
    tol : float, -
        Relative residual at which an island is solved.
    by_energy : bool
        Whether E decides in each island.
    """

    cdef Data p
    cdef view_t v
    cdef best_t best
    cdef double[::1] x
    cdef double tol
    cdef readonly object begin  # Impulse (m,) [N s] at which the solve begins.

    def __init__(self, Data p, start, double tol, bint by_energy=False):
        cdef Py_ssize_t m = p.blocks.n_rows
        cdef double[::1] begin
        self.p, self.v, self.tol = p, p.get_pointers(), tol
        self.x = np.empty(best_workspace_size(m, count_islands(&p.blocks)) + 2 * m + count_judge_scratch(&self.v) + 1)
        self.begin = begin = np.array(start, float)
        bind_best(&self.best, &p.blocks, &self.x[0])
        self.best.by_energy, self.best.reference_energy = by_energy, p.reference_energy
        if m:
            project_on_bounds(&p.blocks, &begin[0])
            self.judge(&begin[0])
            store_start(&self.best, &self.v, self.slack(), p.relative_at_zero, tol, &begin[0])

    cdef double* slack(self):
        """Return the slack (m) [m/s] of the impulse that was judged last."""
        return &self.x[best_workspace_size(self.p.blocks.n_rows, count_islands(&self.p.blocks))]

    cdef void judge(self, const double* lam):
        """Judge lam (m) [N s] island by island."""
        cdef int32_t m = self.p.blocks.n_rows
        cdef double* w = self.slack()
        cdef score_t s = make_empty_score()
        s.by_island = self.best.now
        judge_view(&self.v, lam, w, w + m, w + 2 * m, False, &s)
        copy_score_without_islands(&self.best, &self.p.blocks, &s,
                                   relative_residual_of_score(&s, w, m, self.p.reference_energy, self.p.reference_velocity))

    def store(self, impulse):
        """Store an impulse (m,) [N s] in the islands in which it is the best."""
        cdef Py_ssize_t m = self.p.blocks.n_rows
        cdef const double* lam
        if m:
            lam = as_double_pointer(impulse, m)
            self.judge(lam)
            store_better_islands(&self.best, &self.v, lam, self.slack(), self.tol)

    def replace_growing_islands(self, last, other):
        """Return the best impulse (m,) [N s], and `other` (m,) in islands that seem to have no solution.

        They are those of `seems_without_solution` in judge/best.pxd; `last` (m,) is the impulse at the end of the run.
        """
        cdef int32_t i
        cdef const double* lam
        cdef const double* replacement
        cdef double[::1] result = self.impulse
        if self.p.blocks.n_rows:
            lam, replacement = as_double_pointer(last, self.p.blocks.n_rows), as_double_pointer(other, self.p.blocks.n_rows)
            self.judge(lam)
            for i in range(self.best.n):
                if seems_without_solution(&self.best, &self.p.blocks, i, self.best.relative[i], self.best.energy[i], lam,
                                          self.slack()):
                    copy_island_impulse(&self.p.blocks, i, replacement, &result[0])
        return np.asarray(result)

    @property
    def impulse(self):
        """The best impulse (m,) [N s], a new array."""
        return np.array(self.x[:self.p.blocks.n_rows])


def project_impulse_on_bounds(Blocks blocks, impulse):
    """Return an impulse (m,) [N s] projected by `project_all_on_bounds`, as a new array."""
    out = np.array(impulse, float)
    cdef double* lam = as_double_pointer(out, blocks.at.n_rows)
    with nogil:
        project_all_on_bounds(&blocks.at, lam)
    return out


def project_far_excess_of(Data p, impulse):
    """Return an impulse (m,) [N s] as `project_far_excess` projects it, or the impulse itself if it stays as it is."""
    cdef Py_ssize_t m = p.blocks.n_rows
    cdef double[::1] inside
    both = inside = np.concatenate([impulse, impulse])
    return both[:m] if m and project_far_excess(&p.blocks, &inside[0], &inside[m]) else impulse


def write_velocity_change(Data p, const double[::1] lam, double[:, ::1] v):
    """Write M^-1 J^T lam (n, 6) of a factored problem, or Y^T lam (nv) over J and M, to v."""
    if p.is_general and p.blocks.n_rows > 0:
        multiply_whitened_transpose(&p.general, &lam[0], &v[0, 0])
        return
    if not p.factored or p.rows.n_bodies == 0:
        return
    if p.blocks.n_rows == 0:
        v[:, :] = 0.0
        return
    with nogil:
        compute_velocity_change(&p.blocks, &p.rows, &lam[0], &v[0, 0])


def squared_float32_rounding(Data p, mass, const double[::1] free, const double[::1] lam):
    """Return the squared changes of w (3, m) [m2/s2] by rounding to float32: (1), (4), (5) of judge/rounding.pxd.

    mass is (indptr, indices, data) of the lower triangle of M, free (n,) is v*, both in the order of the factor.
    """
    cdef const int32_t[::1] ptr = mass[0], idx = mass[1]
    cdef const double[::1] val = mass[2]
    cdef mass_t at
    cdef const double* v = NULL
    cdef Py_ssize_t m = p.blocks.n_rows, n = p.general.n
    out = np.zeros((3, m))
    cdef double[:, ::1] x = out
    cdef double[::1] work = np.empty(4 * n + m + 1)
    at.ptr, at.idx, at.val = &ptr[0], NULL, NULL
    if n:
        at.idx, at.val, v = &idx[0], &val[0], &free[0]
    if m:
        with nogil:
            compute_squared_float32_rounding(&p.blocks, &p.general, &at, v, &lam[0], &x[0, 0], &x[1, 0], &x[2, 0], &work[0])
    return out


def relative_size_by_island(Data p, const double[::1] square):
    """Return the size of a change of w relative to the zero impulse in each island, from its squares (m) [m2/s2]."""
    cdef const double* x = &square[0] if square.shape[0] else NULL
    cdef const islands_t* s = p.blocks.islands
    cdef int32_t i
    if s == NULL:
        return [relative_size_of_change(&p.blocks, -1, x, p.reference_energy, p.reference_velocity)]
    return [relative_size_of_change(&p.blocks, i, x, s.reference[2 * i], s.reference[2 * i + 1]) for i in range(s.n)]
