"""Blocks without friction, and the compliance above which rows of J and M need no proximal term."""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport CONE, blocks_t, has_independent_rows
from lavender_ext.core.view cimport generalized_t


cdef inline bint has_bounded_rows_only(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether block i consists of bounded rows: no contact, or a contact of one row."""
    return has_independent_rows(p, i) or p.ptr[i + 1] - p.ptr[i] == 1


cdef inline double min_relative_compliance(const blocks_t* p, int32_t law, int32_t i) noexcept nogil:
    """Return the compliance, as a fraction of d, from which a block needs no proximal term under the problem's law.

    With less, Newton's method without a proximal term takes more steps, since the kinks of lambda(s) are sharper. Under the
    cone law, contacts of robots between 1e-4 d and 1e-3 d take 0.62 of the steps without the term; Coulomb's law gains nothing.
    """
    return 1e-6 if has_bounded_rows_only(p, i) else 1e-4 if law == CONE else 1e-3


cdef inline bint needs_no_proximal_terms(const blocks_t* p, const generalized_t* g) noexcept nogil:
    """Return whether no block needs a proximal term."""
    cdef int32_t i, k
    for i in range(p.n_blocks):
        for k in range(p.ptr[i], p.ptr[i + 1]):
            if not g.compliance[k] >= min_relative_compliance(p, p.law, i) * p.d[k]:
                return False
    return True
