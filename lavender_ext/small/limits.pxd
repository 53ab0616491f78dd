"""What Newton's method is counted to cost over J and M, and may cost [ns]: the gate of one problem and of many.

    count (entry (2 Y + 4 m) + work w)                                                                     (1)

Y entries, m rows, w multiply-adds of a factor of each island; count as in `lavender/solvers/costs.py`.
"""
from libc.math cimport INFINITY
from libc.stdint cimport int32_t

from lavender_ext.core.parts cimport COULOMB, blocks_t, has_friction, is_rows
from lavender_ext.core.view cimport generalized_t


cdef struct limits_t:           # ns, as in lavender/solvers/costs.py
    double entry                # each multiply-add of a sweep, and
    double work                 # of a factor,
    double count                # factorisations where not all rows are free,
    double rigid                # times as many, but of bounded rows, with a rigid row,
    double soft                 # and where none is, but of free ones
    double start                # what a solve beside this call takes at least,
    double sweep_row            # each row and multiply-add of one of its sweeps, under the cone law,
    double sweep_cone
    double sweeps               # and how many of them
    double values               # of one island's N
    double most                 # what all may cost to be asked at all
    double coulomb_rows         # of an island beyond which it is not under Coulomb's law,
    double cone_rows            # and where a contact of the cone law is rigid,
    double dense                # unless so many rows share a velocity,
    double columns              # or a row reaches more of them: else they may be those of bodies (`graph.bodies_in`)
    double steps                # of all islands at most


cdef inline double step_cost(const blocks_t* p, const generalized_t* g, const limits_t* l, double work) noexcept nogil:
    """One factor of each island, of so many multiply-adds in all [ns]."""
    return l.entry * (2.0 * g.pval[g.n_panels] + 4.0 * p.n_rows) + l.work * work


cdef inline bint is_linear(const blocks_t* p) noexcept nogil:
    """Is every row free?"""
    cdef int32_t i, k
    for i in range(p.n_blocks):
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if not is_rows(p, i) or p.lower[k] > -INFINITY or p.upper[k] < INFINITY:
                return False
    return True


cdef inline double cost_of(const blocks_t* p, const generalized_t* g, const limits_t* l, double work, bint soft) noexcept nogil:
    """What Newton's method is counted to cost [ns]: the one gate, for one problem and for many. soft: as `is_soft`."""
    cdef bint linear = is_linear(p)
    cdef double count = 1.0 if linear else l.count
    if soft and not linear:
        count *= l.soft
    elif not soft and (linear or has_friction(p)):
        count *= l.rigid
    return count * step_cost(p, g, l, work)


cdef inline bint are_short(const generalized_t* g, double columns) noexcept nogil:
    """Does no row reach more velocities?"""
    cdef int32_t b
    for b in range(g.n_panels):
        if g.pcol[b + 1] - g.pcol[b] > columns:
            return False
    return True


cdef inline double allowed(const blocks_t* p, const generalized_t* g, const limits_t* l, int32_t islands,
                           bint soft) noexcept nogil:
    """What it may cost [ns], 0 where it is not asked: with a rigid row as much as sweeps, which may do with less."""
    cdef bint rubs = has_friction(p)
    cdef double each = l.sweep_cone if p.law != COULOMB and rubs else l.entry
    cdef double sweep = l.sweep_row * p.n_rows + each * (2.0 * g.pval[g.n_panels] + 4.0 * p.n_rows)
    cdef double most = l.coulomb_rows if p.law == COULOMB else INFINITY if soft else l.cone_rows
    if rubs and islands * most < p.n_rows < l.dense * g.n and are_short(g, l.columns):
        return 0.0
    return l.most if soft else min(l.most, l.start + l.sweeps * sweep)


cdef inline double work_within(const blocks_t* p, const generalized_t* g, const limits_t* l, bint soft) noexcept nogil:
    """Multiply-adds of a factor of each island that it may have at most, into however many islands it falls."""
    cdef double read = cost_of(p, g, l, 0.0, soft)
    return (allowed(p, g, l, p.n_rows, soft) - read) / (cost_of(p, g, l, 1.0, soft) - read)
