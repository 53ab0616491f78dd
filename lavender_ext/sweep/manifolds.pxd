"""Rows and sweeps of contacts in groups of four manifolds, one in each lane of a vector, with the bits of single contacts.

A manifold waits for the earlier manifolds of its bodies only. It enters the first group after theirs that has an empty lane, so
that the manifolds of a group share no moving body and every body sees the same sequence of updates. Where one sweep fills few
lanes, as in a tower, groups also hold the manifolds of later sweeps. The groups read backwards are a sweep of the reversed order.

Only contacts with two tangents in a disk and without compliance enter lanes. The groups hold their rows, and beside the groups
lie impulses, gaps and right-hand sides, so that a substep with the same contacts needs no packing (manifolds.h).
"""
from libc.stdint cimport int32_t


cdef extern from "lavender_ext/sweep/manifolds.h":
    ctypedef struct contacts_t "lavender_contacts":
        int32_t n
        int32_t n_bodies
        const int32_t* order
        const int32_t* body
        const double* mu
        const double* normal
        const double* tangent
        const double* arm_a
        const double* arm_b
        const double* inv_mass
        const double* inv_inertia
        const int32_t* pair
        const double* restitution
        double* impulse
        double* gap
        double* b
        double* target
        double* d
        double* step
        double* coupling
        double* inv_inertia_arm
    ctypedef struct targets_t "lavender_targets":
        double h
        double beta
        double slop
        double bounce
        double max_push
        int warm
        double most
        int finite
    ctypedef struct manifolds_t "lavender_manifolds":
        int32_t n_groups
        double* v
    int HAS_MANIFOLDS "LAVENDER_HAS_MANIFOLDS"
    int has_avx2 "lavender_has_avx2"() noexcept nogil
    void free_manifolds "lavender_free_manifolds"(manifolds_t* m) noexcept nogil
    int pack_manifolds "lavender_pack_manifolds"(const contacts_t* c, int wide, int32_t n_sweeps, double least,
                                                 manifolds_t* m) noexcept nogil
    void refresh_manifolds "lavender_refresh_manifolds"(const contacts_t* c, manifolds_t* m, int wide, targets_t* t,
                                                        const double* free, const double* before,
                                                        const int32_t* body_of) noexcept nogil
    void sweep_manifolds "lavender_sweep_manifolds"(manifolds_t* m, int wide, int32_t sweeps, int backwards) noexcept nogil
    void follow_manifolds "lavender_follow_manifolds"(const contacts_t* c, manifolds_t* m, int wide,
                                                      const double* s) noexcept nogil
    void check_manifolds "lavender_check_manifolds"(const manifolds_t* m, int wide, targets_t* t) noexcept nogil
    int sweep_along "lavender_sweep_along"(const manifolds_t* m) noexcept nogil
    int32_t project_manifolds "lavender_project_manifolds"(const contacts_t* c, manifolds_t* m, int wide, targets_t* t,
                                                           int32_t least, int32_t most, int last_first, const double* v_free,
                                                           const double* dv, double* shift) noexcept nogil
    void store_manifolds "lavender_store_manifolds"(const contacts_t* c, const manifolds_t* m, int rows) noexcept nogil
    void store_velocities "lavender_store_velocities"(int32_t n, const double* from_, double* to) noexcept nogil
