"""Arithmetic of an update, for one block or for two blocks of one kind at once.

`number_t` is a double, or a pair (core/pair.pxd) that holds the same quantity of two blocks. Both have the same operations in the
same order, so that a block gets the same bits alone and in a pair.
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport clip, project_to_disk
from lavender_ext.core.pair cimport LANES, all_within, any_outside, broadcast, clip_at_zero, clip_pair, pair_t


ctypedef fused number_t:
    double
    pair_t


cdef inline number_t convert_to_type_of(const number_t* like, double x) noexcept nogil:
    """Return x as a number of the type that `like` points at."""
    if number_t is double:
        return x
    else:
        return broadcast(x)


cdef inline number_t dot_numbers(const number_t* x, const number_t* y) noexcept nogil:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


cdef inline number_t clip_below_zero(number_t x) noexcept nogil:
    """Return max(0, x), and NaN for NaN."""
    if number_t is double:
        return 0.0 if x < 0.0 else x
    else:
        return clip_at_zero(x)


cdef inline number_t clip_number(number_t x, number_t low, number_t high) noexcept nogil:
    """Clip x to [low, high]."""
    if number_t is double:
        return clip(x, low, high)
    else:
        return clip_pair(x, low, high)


cdef inline number_t clip_to_bound(number_t x, number_t bound) noexcept nogil:
    """Clip x to [-bound, bound]. If both numbers of a pair are inside, x is returned at once, without waiting for the bound."""
    if number_t is double:
        return clip(x, -bound, bound)
    else:
        if any_outside(x, bound):
            return clip_pair(x, -bound, bound)
        return x


cdef inline void project_disk(number_t* x, number_t* y, number_t radius) noexcept nogil:
    """Project (x, y) radially to the disk. A pair needs no square root if both points are inside."""
    cdef int32_t k
    if number_t is double:
        project_to_disk(x, y, radius)
    elif not all_within(x[0] * x[0] + y[0] * y[0], radius * radius):
        for k in range(LANES):
            project_to_disk(<double*>x + k, <double*>y + k, (<double*>&radius)[k])


cdef inline void compute_relative_angular_velocity(const number_t* va, const number_t* vb, int32_t body_a, int32_t body_b,
                                                   number_t* omega) noexcept nogil:
    """Compute omega_b - omega_a from the velocities (6) of the bodies; a negative body is static."""
    cdef int32_t k
    for k in range(3):
        omega[k] = convert_to_type_of(omega, 0.0)
        if body_b >= 0:
            omega[k] = vb[3 + k]
        if body_a >= 0:
            omega[k] = omega[k] - va[3 + k]


cdef inline void apply_contact_impulse_changes_to_body(number_t* v, const number_t* inv_mass, const number_t* inv_inertia_arm,
                                                       const number_t* impulse, const number_t* change, int32_t nt, bint spins,
                                                       int32_t sign) noexcept nogil:
    """Apply the impulse changes of one contact to the velocity v (6) of one body by (3) of core/rows.pxd.

    change (4) belongs to normal, t1, t2 and spin, and `impulse` (3) is their linear impulse. inv_inertia_arm points at the first
    row of the contact, on the side of this body. sign is -1 for body a, 1 for body b.
    """
    cdef int32_t k
    cdef number_t angular
    for k in range(3):
        angular = change[0] * inv_inertia_arm[k]
        if nt > 0:
            angular = angular + change[1] * inv_inertia_arm[6 + k]
        if nt > 1:
            angular = angular + change[2] * inv_inertia_arm[12 + k]
        if spins:
            angular = angular + change[3] * inv_inertia_arm[6 * (1 + nt) + k]
        if sign < 0:
            v[k] = v[k] - inv_mass[0] * impulse[k]
            v[3 + k] = v[3 + k] - angular
        else:
            v[k] = v[k] + inv_mass[0] * impulse[k]
            v[3 + k] = v[3 + k] + angular
