"""Sweeps over contacts in groups of four manifolds, one in each lane of a vector, with the bits of single contacts (manifolds.h).

A manifold waits for the earlier manifolds of its bodies only. Manifolds of equal level, as in `packed.pyx`, share no moving body
and may be updated at once; every body still sees the same sequence of updates. Where levels fill few lanes, as in a tower, the
groups also hold the manifolds of later sweeps, (1) of `packed.pyx`. The groups read backwards are a sweep of the reversed order.

Only contacts with two tangents in a disk and without compliance enter lanes. Impulses and right-hand sides remain outside of the
groups, so that a later call with the same rows needs no packing.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t, is_disk_friction_contact
from lavender_ext.core.view cimport rows_t


cdef extern from "lavender_ext/sweep/manifolds.h":
    ctypedef struct contacts_t "lavender_contacts":
        int32_t n
        int32_t n_bodies
        const int32_t* order
        const int32_t* ptr
        const int32_t* body
        const double* mu
        const double* b
        const double* step
        const double* normal
        const double* tangent
        const double* arm_a
        const double* arm_b
        const double* inv_mass
        const double* inv_inertia_arm
        const double* coupling
    ctypedef struct manifolds_t "lavender_manifolds":
        int32_t n_groups
        int32_t n_sweeps            # sweeps that one pass over the groups makes
    int HAS_MANIFOLDS "LAVENDER_HAS_MANIFOLDS"
    int has_avx2 "lavender_has_avx2"() noexcept nogil
    int pack_manifolds "lavender_pack_manifolds"(const contacts_t* c, int32_t n_sweeps, double least,
                                                 manifolds_t* m) noexcept nogil
    void sweep_manifolds "lavender_sweep_manifolds"(const contacts_t* c, manifolds_t* m, int wide, int32_t sweeps, int backwards,
                                                    double* lam, double* v) noexcept nogil
    void free_manifolds "lavender_free_manifolds"(manifolds_t* m) noexcept nogil


cdef inline contacts_t bind_contacts(const blocks_t* p, const rows_t* r, const int32_t* order) noexcept nogil:
    """Return the contacts of a problem without joints in an order (k)."""
    cdef contacts_t c
    c.n, c.n_bodies, c.order, c.ptr, c.body, c.mu, c.b, c.step = (
        p.n_blocks, r.n_bodies, order, p.ptr, r.contact_body, p.mu, p.b, p.step)
    c.normal, c.tangent, c.arm_a, c.arm_b = r.normal, r.tangent, r.arm_a, r.arm_b
    c.inv_mass, c.inv_inertia_arm, c.coupling = r.inv_mass, r.inv_inertia_arm, r.coupling
    return c


cdef inline bint fits_lanes(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Return whether all blocks are contacts with two tangents in a disk and without compliance."""
    cdef int32_t i
    if not HAS_MANIFOLDS or r.n_joints > 0 or p.n_blocks == 0:
        return False
    for i in range(p.n_blocks):
        if not is_disk_friction_contact(p, i):
            return False
    for i in range(p.n_rows):
        if r.compliance[i] != 0.0:
            return False
    return True
