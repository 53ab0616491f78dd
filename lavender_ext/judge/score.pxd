"""Scores of an impulse: sums over the rows' errors, what rounding leaves of them, and both against doing nothing.

    E   = sqrt(sum d e^2)                       [sqrt J]
    V   = max sqrt(nu d) |e|                    [m/s], |e| the pair's norm on tangents
    relative = max(E / E0, V / V0)              E0, V0 of doing nothing                            (1)

The judge, the watch of a run of sweeps and warm starts score by these lines, and the polishes of Newton's method take (1)
from here.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t

from lavender_ext.core.block cimport block_error
from lavender_ext.core.parts cimport blocks_t, disk_of, groups_of, is_disk, is_rows, parts_t


cdef struct score_t:
    double energy               # sqrt J
    double velocity             # m/s
    double floor_energy         # sqrt J
    double floor_velocity       # m/s
    int32_t worst               # row of the largest velocity error, -1 where there is none
    int32_t finite              # 0 where e holds a NaN or an infinity


cdef struct tally_t:
    double energy               # sum (d e) e
    double fast                 # max (d e) (nu e)
    int32_t worst


cdef struct floor_t:            # of F, what rounding leaves of a slack
    double energy               # sum (F / d) F
    double fast                 # max nu (F / d) F


cdef inline double unit_roundoff() noexcept nogil:
    """2^-53: the largest relative error of one operation."""
    return 1.1102230246251565e-16


cdef inline int32_t are_numbers(const double* x, int32_t n) noexcept nogil:
    """Does x hold neither NaN nor infinity? A slack that overflows has lost its sign, and a bound would hide it."""
    cdef int32_t i
    cdef double s = 0.0                                 # stays 0, or becomes NaN
    for i in range(n):
        s += 0.0 * x[i]
    return s == 0.0


cdef inline double ratio(double x, double reference) noexcept nogil:
    """0 where x is, inf where x is not finite or has nothing to be compared with."""
    if x == 0.0:
        return 0.0
    return x / reference if x < 1.0 / 0.0 and reference > 0.0 else 1.0 / 0.0


cdef inline double relative(double energy, double velocity, double start_energy, double start_velocity) noexcept nogil:
    """(1)"""
    cdef double x = ratio(energy, start_energy), y = ratio(velocity, start_velocity)
    return x if x > y else y


cdef inline tally_t nothing() noexcept nogil:
    cdef tally_t s
    s.energy = 0.0
    s.fast = -1.0
    s.worst = -1
    return s


cdef inline void tally_row(const blocks_t* p, int32_t k, double e, tally_t* s) noexcept nogil:
    cdef double v = p.d[k] * e, t = v * (p.nu[k] * e)
    s.energy += v * e
    if t > s.fast:
        s.fast = t
        s.worst = k


cdef inline void tally_pair(const blocks_t* p, int32_t k, const double* e, tally_t* s) noexcept nogil:
    # Rows k, k + 1, by the norm of the two in the maximum.
    cdef double x = p.d[k] * e[k], y = p.d[k] * e[k + 1]
    s.energy += x * e[k] + y * e[k + 1]
    x = x * (p.nu[k] * e[k]) + y * (p.nu[k] * e[k + 1])
    if x > s.fast:
        s.fast = x
        s.worst = k


cdef inline void tally_block(const blocks_t* p, int32_t i, const double* e, tally_t* s) noexcept nogil:
    cdef int32_t k, g, j = p.ptr[i]
    cdef parts_t q
    if is_rows(p, i):
        for k in range(j, p.ptr[i + 1]):
            tally_row(p, k, e[k], s)
        return
    tally_row(p, j, e[j], s)
    if is_disk(p, i):                                   # compiled apart
        tally_pair(p, j + 1, e, s)
        return
    groups_of(p, i, &q)
    for g in range(q.n):
        if q.size[g] == 2:
            tally_pair(p, j + q.first[g], e, s)
        else:
            tally_row(p, j + q.first[g], e[j + q.first[g]], s)


cdef inline int32_t lost_row(const double* e, int32_t m) noexcept nogil:
    """The first row whose error is no number, or -1."""
    cdef int32_t i
    for i in range(m):
        if not fabs(e[i]) < 1.0 / 0.0:
            return i
    return -1


cdef inline void score_from(const blocks_t* p, const double* e, const tally_t* s, score_t* out) noexcept nogil:
    """The two sums over e (m); the floor entries are left alone."""
    out.energy = sqrt(s.energy)
    out.velocity = sqrt(s.fast) if s.fast > 0.0 else 0.0
    out.worst = s.worst
    out.finite = out.energy + out.velocity < 1.0 / 0.0
    if not out.finite:
        out.velocity = 1.0 / 0.0
        out.worst = lost_row(e, p.n_rows)
        if out.worst < 0:
            out.worst = s.worst


cdef inline void score_rows(const blocks_t* p, const double* lam, const double* w, double* e, score_t* out) noexcept nogil:
    """Errors e (m) of all blocks and their two sums; the floor entries are left alone."""
    cdef int32_t i
    cdef tally_t s = nothing()
    for i in range(p.n_blocks):
        block_error(p, i, lam, w, e)
        tally_block(p, i, e, &s)
    score_from(p, e, &s, out)


cdef inline void norms_of_rhs(const blocks_t* p, double* energy, double* velocity) noexcept nogil:
    """sqrt(sum b^2 / d) and max |b| sqrt(nu / d), of two rows of a part by their norm."""
    cdef int32_t i, j, k, g
    cdef double t, pair, sum_ = 0.0, fast = 0.0
    cdef parts_t q
    for i in range(p.n_blocks):
        j = p.ptr[i]
        for k in range(j, p.ptr[i + 1]):
            t = (p.b[k] / p.d[k]) * p.b[k]
            sum_ += t
            t = t * p.nu[k]
            if t > fast:
                fast = t
        groups_of(p, i, &q)
        for g in range(q.n):
            if q.size[g] == 2:
                k = j + q.first[g]
                pair = (p.b[k] / p.d[k]) * p.b[k] + (p.b[k + 1] / p.d[k + 1]) * p.b[k + 1]
                pair = pair * p.nu[k]
                if pair > fast:
                    fast = pair
    energy[0] = sqrt(sum_)
    velocity[0] = sqrt(fast)


cdef inline bint hides(double floor) noexcept nogil:
    """Whether rounding hides a thousandth of what doing nothing leaves: then the floor is the residual."""
    return floor >= 1e-3


cdef inline bint is_at_floor(double relative, double floor) noexcept nogil:
    """Whether a relative residual is within twice its floor, and at most 1e-5; no floor hides it (`hides`).

    The floor grows with the impulse, so one that runs away, as where there is no solution, excuses any residual: it
    says nothing of the problem. At 1e-5 A lambda is made of terms 1e11 times as large as what they leave, or what
    float64 makes of M^-1 J^T lambda is off by as much, as with an M of condition 1e12 (judge/refine.pxd).
    """
    return relative <= 2.0 * floor and relative <= 1e-5 and not hides(floor)


cdef inline floor_t no_floor() noexcept nogil:
    return floor_t(0.0, 0.0)


cdef inline void add_floor(const blocks_t* p, int32_t k, double size, floor_t* s) noexcept nogil:
    """What rounding leaves of row k, size = (|A| |lam|)_k."""
    cdef double f = unit_roundoff() * (size + fabs(p.b[k])), t = f / p.d[k]
    s.energy += t * f
    t = p.nu[k] * t * f
    if t > s.fast:
        s.fast = t


cdef inline void add_block_floor(const blocks_t* p, int32_t i, const double* lam, const double* w, const double* e,
                                 const double* size, floor_t* s) noexcept nogil:
    """`add_floor` of a block's rows; size from its first row on, of at least |A_kk| |lam_k|.

    Where the norm of two rows is cut to its bound, e = lam - Pi has the rounding of lam itself, (2^-53 |lam_k|) d_k as a
    velocity; d_k, of both rows, may be far above A_kk.
    """
    cdef int32_t k, g, j = p.ptr[i], n = p.ptr[i + 1] - j
    cdef parts_t q
    cdef double x, own
    if is_rows(p, i):
        for k in range(n):
            add_floor(p, j + k, size[k], s)
        return
    add_floor(p, j, size[0], s)
    if is_disk(p, i):                                   # compiled apart
        disk_of(p, i, &q)
    else:
        groups_of(p, i, &q)
    for g in range(q.n):
        for k in range(q.first[g], q.first[g] + q.size[g]):
            x = size[k]
            if q.size[g] == 2 and e[j + k] != w[j + k] / p.d[j + k]:
                own = p.d[j + k] * fabs(lam[j + k])
                x = own if own > x else x
            add_floor(p, j + k, x, s)


cdef inline void floor_from(const floor_t* s, score_t* out) noexcept nogil:
    """The floor entries of out."""
    out.floor_energy = sqrt(s.energy)
    out.floor_velocity = sqrt(s.fast)
