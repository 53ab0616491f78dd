"""Estimated and permitted cost [ns] of Newton's method over J and M, for single problems and batches.

    count (row m_1 + contact_row m_c + entry (2 Y + 4 m) + work w)                                         (1)

m: rows; m_c: rows of contacts with friction; m_1: other rows; Y: entries of J L^-1; w: multiply-adds to factorise N of
every island; count: number of factorisations. Python calls this estimate, too (`estimate_velocity_newton_cost` of
`lavender/solvers/small.py`); the rates are in `lavender/base/rates.json`.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport COULOMB, blocks_t, has_friction, has_independent_rows
from lavender_ext.core.view cimport generalized_t


cdef struct limits_t:           # from `make_limits` of lavender/solvers/small.py
    double entry                # ns, rate of the term 2 Y + 4 m of (1)
    double work                 # ns per multiply-add of a factorisation
    double count                # factorisations, if some row is not free
    double row                  # ns per independent row of a step
    double contact_row          # ns per row of a contact with friction of a step
    double start                # ns, minimum time of a solve outside of this call
    double sweep_row            # ns per row of a sweep outside of this call
    double sweep_cone           # ns per multiply-add of such a sweep under the cone law
    double sweep_entry          # ns per multiply-add of such a sweep under another law
    double sweeps               # number of such sweeps
    double values               # largest number of entries of one island's N
    double max_cost             # ns, largest cost that may be permitted
    double coulomb_rows         # largest number of rows per island under Coulomb's law
    double cone_rows            # largest number of rows per island under the cone law with a rigid contact
    double dense                # coulomb_rows and cone_rows apply only with fewer than this many rows per velocity,
    double columns              # and if no row has more than this many entries: velocities may then belong to bodies.
    double steps                # largest number of steps of all islands together
    double lanes                # 1: contacts that lanes solve (batch/lanes.pxd) are solved so


cdef inline bint has_only_free_rows(const blocks_t* p) noexcept nogil:
    """Return whether every row is free (unbounded)."""
    cdef int32_t i, k
    for i in range(p.n_blocks):
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if not has_independent_rows(p, i) or p.lower[k] > -INFINITY or p.upper[k] < INFINITY:
                return False
    return True


cdef struct newton_cost_t:      # the cost (1) as a linear function of w
    double fixed                # ns
    double per_work             # ns per multiply-add


cdef inline newton_cost_t estimate_newton_cost_terms(const blocks_t* p, const generalized_t* g, const limits_t* l) noexcept nogil:
    """Return the terms of the estimated cost of Newton's method, (1), with w multiply-adds per factorisation."""
    cdef double count = 1.0 if has_only_free_rows(p) else l.count, cost = 0.0
    cdef int32_t i, n
    for i in range(p.n_blocks):                         # projections of the rows and their derivatives
        n = p.ptr[i + 1] - p.ptr[i]
        cost += (l.row if n == 1 or has_independent_rows(p, i) else l.contact_row) * n
    return newton_cost_t(count * (cost + l.entry * (2.0 * g.pval[g.n_panels] + 4.0 * p.n_rows)), count * l.work)


cdef inline double max_newton_cost(const blocks_t* p, const generalized_t* g, const limits_t* l, int32_t islands,
                                   bint soft) noexcept nogil:
    """Return the permitted cost [ns], 0 if Newton's method must not run; with a rigid row at most the estimated cost of sweeps."""
    cdef double max_rows = l.coulomb_rows if p.law == COULOMB else INFINITY if soft else l.cone_rows
    cdef double each
    cdef int32_t b, columns = 0                         # largest number of velocities that one row couples
    for b in range(g.n_panels):
        columns = max(columns, g.pcol[b + 1] - g.pcol[b])
    if islands * max_rows < p.n_rows < l.dense * g.n and has_friction(p) and columns <= l.columns:
        return 0.0
    if soft:
        return l.max_cost
    each = l.sweep_cone if p.law != COULOMB and has_friction(p) else l.sweep_entry
    return min(l.max_cost, l.start + l.sweeps * (l.sweep_row * p.n_rows + each * (2.0 * g.pval[g.n_panels] + 4.0 * p.n_rows)))


cdef inline double max_factorisation_work(const blocks_t* p, const generalized_t* g, const limits_t* l,
                                          const newton_cost_t* cost, bint soft) noexcept nogil:
    """Return the maximum multiply-adds of factorising every island, for any number of islands."""
    return (max_newton_cost(p, g, l, p.n_rows, soft) - cost.fixed) / cost.per_work
