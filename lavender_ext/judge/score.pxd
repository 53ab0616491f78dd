"""Scores of an impulse: norms of the errors of its rows, their round-off floors, and both relative to the zero impulse.

    E   = sqrt(sum d e^2)                       [sqrt J]
    V   = max sqrt(nu d) |e|                    [m/s], |e| is the norm of the pair on tangents
    relative = max(E / E0, V / V0)              E0, V0 of the zero impulse (reference.pxd)         (1)

With several islands (1) is the maximum over the islands, with E, V, E0, V0 over the rows of each island; so is the floor.
The judge, the stopping test of sweeps and warm starts use these functions, and Newton's refinement uses (1).
"""
from libc.stdint cimport int32_t

from lavender_ext.core.block_types cimport blocks_t


cdef struct score_t:
    double energy               # sqrt J
    double velocity             # m/s
    double floor_energy         # sqrt J
    double floor_velocity       # m/s
    int32_t worst               # row of the largest velocity error, -1 without rows
    int32_t finite              # 0 if e holds a NaN or an infinity
    int32_t island              # with islands: island with the largest relative residual; -1 without
    double relative             # with islands: (1), infinite if a slack or an error is not finite; -1 without
    double floor                # with islands: floor of `island`, as a relative residual
    double above_floor          # with islands: largest (1) over the islands that are not at their floor
    double* by_island           # NULL, or (n, 2): receives (1) and E of each island


cdef inline score_t make_empty_score() noexcept nogil:
    """Return the score of a problem without rows."""
    return score_t(0.0, 0.0, 0.0, 0.0, -1, 1, -1, -1.0, 0.0, 0.0, NULL)


cdef inline double unit_roundoff() noexcept nogil:
    """Return 2^-53, the largest relative rounding error of one operation."""
    return 1.1102230246251565e-16


cdef inline double ratio_to_reference(double x, double reference) noexcept nogil:
    """Return x / reference: 0 if x is 0, inf if x is not finite or the reference is not positive."""
    if x == 0.0:
        return 0.0
    return x / reference if x < 1.0 / 0.0 and reference > 0.0 else 1.0 / 0.0


cdef inline double relative_residual(double energy, double velocity, double reference_energy,
                                     double reference_velocity) noexcept nogil:
    """Return the relative residual (1)."""
    cdef double x = ratio_to_reference(energy, reference_energy), y = ratio_to_reference(velocity, reference_velocity)
    return x if x > y else y


cdef inline bint floor_hides_residual(double floor) noexcept nogil:
    """Return whether the floor is at least a thousandth of the zero impulse's error; it then replaces the residual."""
    return floor >= 1e-3


cdef inline bint is_at_floor(double relative, double floor) noexcept nogil:
    """Return whether a relative residual is at most twice its floor and at most 1e-5, and the floor does not hide it.

    The floor grows with the impulse. The floor of a diverging impulse, as in a problem without a solution, would therefore
    explain any residual. At a residual of 1e-5 the terms of A lambda are 1e11 times as large as their sum, or M^-1 J^T lambda
    in float64 has an equally large relative error, as with an M of condition 1e12 (judge/refine.pxd).
    """
    return relative <= 2.0 * floor and relative <= 1e-5 and not floor_hides_residual(floor)


cdef inline void take_smallest_island_reference(const blocks_t* p, double* energy, double* velocity) noexcept nogil:
    """Replace E0 and V0 of all rows by the smallest of any island, for estimates over all rows that must hold in each island."""
    cdef const double* own
    cdef int32_t i
    if p.islands == NULL:
        return
    for i in range(p.islands.n):
        own = p.islands.reference + 2 * i
        if own[0] > 0.0:
            energy[0] = own[0] if own[0] < energy[0] else energy[0]
            velocity[0] = own[1] if own[1] < velocity[0] else velocity[0]
