"""Blocks of a problem, made, joined and checked: one pass over few numbers, in a few arrays.

What Python would do in ten calls of NumPy takes longer than a solve of eight rows. Nothing is said here of what is wrong:
`lavender.problem.cones` finds the words where these functions return None.
"""
from libc.stdint cimport int32_t

import numpy as np

from lavender_ext.core.arrays cimport frozen, ndarray
from lavender_ext.core.door cimport is_number, is_size
from lavender_ext.core.parts cimport (CONTACT, CONTACT_BOX, CONTACT_ROLLING, CONTACT_SPIN, ROUND, ROW, contact_kind, fits,
                                      lay_frictions, spell_bounds)

cdef enum:
    CONTACT_ELLIPSE = 7                                 # no kernel meets it: `Problem.disk` is solved and judged

#: Kinds of blocks by the kernels' numbers.
KINDS = (ROW, CONTACT, CONTACT_SPIN, ROUND, CONTACT_BOX, CONTACT_ROLLING, CONTACT_ELLIPSE)

cdef double INF = 1.0 / 0.0, WIDEST = 2.0 ** 60          # of mu_2 / mu_1 of an ellipse, and of mu_1 / mu_2
cdef object new = np.empty, F8 = np.dtype(np.float64), I4 = np.dtype(np.int32)


cdef class Blocks:
    """Pointers to the arrays of a problem's blocks, which are kept; ValueError where they are no blocks."""

    def __init__(self, ptr, kind, lower, upper, mu, patch_radius, rolling):
        if not self.point(ptr, kind, lower, upper, mu, patch_radius, rolling) or not self.check():
            raise ValueError("arrays that do not fit each other, or hold what no block can have")
        self._arrays = (ptr, kind, lower, upper, mu, patch_radius, rolling)

    @property
    def arrays(self):
        """ptr, kind, lower, upper, mu, patch_radius, rolling: views, made at first use."""
        cdef Py_ssize_t k = self.at.n_blocks, m = self.at.n_rows, at = self.at.mu - self.at.lower
        cdef Py_ssize_t kind = self.at.kind - self.at.ptr, stride = self.at.patch_radius - self.at.mu
        if self._arrays is None:
            x = [self.numbers[at + i * stride:at + i * stride + k] for i in range(3)]
            self._arrays = (self.ints[:k + 1], self.ints[kind:kind + k], self.numbers[:m], self.numbers[m:2 * m], *x)
        return self._arrays

    @property
    def n_blocks(self):
        return self.at.n_blocks

    @property
    def n_rows(self):
        return self.at.n_rows

    cdef bint point(self, const int32_t[::1] ptr, const int32_t[::1] kind, const double[::1] lower,
                    const double[::1] upper, const double[::1] mu, const double[::1] radius, const double[::1] rolling):
        cdef Py_ssize_t k = kind.shape[0], m = lower.shape[0]
        if ptr.shape[0] != k + 1 or mu.shape[0] != k or radius.shape[0] != k or upper.shape[0] != m \
                or rolling.shape[0] != k:
            return False
        if ptr[0] != 0 or ptr[k] != m:
            return False
        self.at.n_blocks = <int32_t>k
        self.at.n_rows = <int32_t>m
        self.at.ptr = &ptr[0]
        if m:
            self.at.kind = &kind[0]
            self.at.lower = &lower[0]
            self.at.upper = &upper[0]
            self.at.mu = &mu[0]
            self.at.patch_radius = &radius[0]
            self.at.rolling = &rolling[0]
        return m > 0 or k == 0

    cdef bint check(self) noexcept:
        # What the blocks are; False where one is none.
        cdef blocks_t* p = &self.at
        cdef int32_t i, j, size, kind
        self.is_free = self.is_bounded_rows = self.single_rows = True
        self.has_round = self.has_rolling = self.has_ellipse = False
        for i in range(p.n_blocks):
            size = p.ptr[i + 1] - p.ptr[i]
            kind = p.kind[i]
            if not is_size(p.mu[i]) or not is_size(p.patch_radius[i]) or not is_size(p.rolling[i]):
                return False
            if kind != ROW and not is_size(p.mu[i] * p.patch_radius[i]):
                return False
            self.has_round |= kind == ROUND
            self.has_rolling |= kind == CONTACT_ROLLING
            if kind == CONTACT_ELLIPSE:
                self.has_ellipse, kind = True, CONTACT_BOX
                if not 1.0 / WIDEST <= p.patch_radius[i] <= WIDEST:
                    return False
            if not fits(kind, size):
                return False
            if kind != ROW or size > 1:
                self.single_rows = False
            if kind != ROW:
                self.is_free = False
                if size > 1:
                    self.is_bounded_rows = False
        for i in range(p.n_blocks):
            for j in range(p.ptr[i], p.ptr[i + 1]):
                if p.kind[i] != ROW:
                    if p.lower[j] != p.lower[j] or p.upper[j] != p.upper[j]:
                        return False
                elif not (p.lower[j] <= p.upper[j] and (p.lower[j] == -INF or is_number(p.lower[j]))
                          and (p.upper[j] == INF or is_number(p.upper[j]))):
                    return False
                elif p.lower[j] != -INF or p.upper[j] != INF:
                    self.is_free = False
        return True


cdef Blocks room_of(Py_ssize_t k, Py_ssize_t m, Py_ssize_t ints=0, Py_ssize_t numbers=0):
    """Blocks over new arrays, read-only for everybody else, whose numbers are still to be written; behind them more workspace."""
    cdef Blocks made = Blocks.__new__(Blocks)
    made.ints, made.numbers = frozen(new(2 * k + 1 + ints, I4)), frozen(new(2 * m + 3 * k + numbers))
    made.at.n_blocks = <int32_t>k
    made.at.n_rows = <int32_t>m
    made.at.ptr = <int32_t*>(<ndarray>made.ints).data
    made.at.kind = made.at.ptr + k + 1
    made.at.lower = <double*>(<ndarray>made.numbers).data
    made.at.upper = made.at.lower + m
    lay_frictions(&made.at, made.at.upper + m, k)
    return made


cdef void put(Blocks to, Py_ssize_t block, Py_ssize_t row, const blocks_t* p) noexcept:
    # The blocks of p, from block and row on.
    cdef Py_ssize_t i
    for i in range(p.n_blocks):
        (<int32_t*>to.at.ptr)[block + i] = p.ptr[i] + <int32_t>row
        (<int32_t*>to.at.kind)[block + i] = p.kind[i]
        (<double*>to.at.mu)[block + i] = p.mu[i]
        (<double*>to.at.patch_radius)[block + i] = p.patch_radius[i]
        (<double*>to.at.rolling)[block + i] = p.rolling[i]
    for i in range(p.n_rows):
        (<double*>to.at.lower)[row + i] = p.lower[i]
        (<double*>to.at.upper)[row + i] = p.upper[i]
    (<int32_t*>to.at.ptr)[block + p.n_blocks] = <int32_t>row + p.n_rows


def joined(list each):
    """The blocks of each, one after the other; None where they have more rows than 32-bit numbers count."""
    cdef Py_ssize_t k = 0, m = 0
    cdef Blocks one
    for one in each:
        k += one.at.n_blocks
        m += one.at.n_rows
    if k >= 2147483647 or m >= 2147483647:
        return None
    cdef Blocks made = room_of(k, m)
    (<int32_t*>made.at.ptr)[0] = 0
    made.is_free = made.is_bounded_rows = made.single_rows = True
    k = m = 0
    for one in each:
        put(made, k, m, &one.at)
        k += one.at.n_blocks
        m += one.at.n_rows
        made.is_free &= one.is_free
        made.is_bounded_rows &= one.is_bounded_rows
        made.single_rows &= one.single_rows
        made.has_round |= one.has_round
        made.has_rolling |= one.has_rolling
        made.has_ellipse |= one.has_ellipse
    return made


def are_joints_then_contacts(Blocks blocks, const int32_t[::1] joint_ptr):
    """Whether blocks begin with ROW blocks of these rows, and all others are contacts of up to two tangents, spin and rolling."""
    cdef int32_t i, kj = <int32_t>joint_ptr.shape[0] - 1
    if kj > blocks.at.n_blocks or blocks.has_round:
        return False
    for i in range(blocks.at.n_blocks):
        if (blocks.at.kind[i] == ROW) != (i < kj):
            return False
    for i in range(kj + 1):
        if blocks.at.ptr[i] != joint_ptr[i]:
            return False
    return True


def private(ptr, kind, lower, upper, mu, patch_radius, rolling):
    """Blocks over a copy of these arrays; None where anything is amiss."""
    cdef Blocks given = Blocks.__new__(Blocks), made
    for x, dtype in ((ptr, I4), (kind, I4), (lower, F8), (upper, F8), (mu, F8), (patch_radius, F8),
                     (rolling, F8)):
        if type(x) is not ndarray or x.dtype is not dtype or x.ndim != 1 or not x.flags.c_contiguous:
            return None
    try:
        if not given.point(ptr, kind, lower, upper, mu, patch_radius, rolling):
            return None
    except ValueError:                                  # not aligned
        return None
    made = room_of(given.at.n_blocks, given.at.n_rows)
    put(made, 0, 0, &given.at)
    if not made.check():
        return None
    spell_bounds(&made.at)
    return made


def free_rows(Py_ssize_t m):
    """m unbounded rows, each its own block; None below 0 and beyond 32 bits."""
    if not 0 <= m < 2147483647:
        return None
    return rows_between(m, NULL, NULL)


def bounded_rows(lower, upper):
    """One row for each pair of bounds, `upper` perhaps inf for all; None where anything is amiss."""
    cdef const double[::1] low, high
    cdef Py_ssize_t m
    cdef bint open_ = type(upper) is float and upper == INF
    for x in (lower, lower if open_ else upper):
        if type(x) is not ndarray or x.dtype is not F8 or x.ndim != 1 or not x.flags.c_contiguous:
            return None
    low, high = lower, lower if open_ else upper
    m = low.shape[0]
    if high.shape[0] != m or m >= 2147483647:
        return None
    return rows_between(m, &low[0] if m else NULL, &high[0] if m and not open_ else NULL)


cdef Blocks rows_between(Py_ssize_t m, const double* lower, const double* upper):
    cdef Blocks made = room_of(m, m)
    cdef Py_ssize_t i
    (<int32_t*>made.at.ptr)[0] = 0
    for i in range(m):
        (<int32_t*>made.at.ptr)[i + 1] = <int32_t>i + 1
        (<int32_t*>made.at.kind)[i] = ROW
        (<double*>made.at.mu)[i] = (<double*>made.at.patch_radius)[i] = (<double*>made.at.rolling)[i] = 0.0
        (<double*>made.at.lower)[i] = -INF if lower == NULL else lower[i]
        (<double*>made.at.upper)[i] = INF if upper == NULL else upper[i]
    return made if made.check() else None


def contacts(Py_ssize_t k, int32_t tangents, mu, radius, rolling, int32_t sides=0):
    """k contacts of so many tangents, with a spin row where there is a radius (k,), two that roll where there is mu_r (k,).

    mu is a float or (k,) array.

    sides: CONTACT_BOX or CONTACT_ELLIPSE, which have two tangents, and as radius mu_2 / mu_1; else 0.

    None where anything is amiss.
    """
    cdef bint spin = radius is not None and not sides, rolls = rolling is not None
    cdef int32_t size = 1 + tangents + spin + 2 * rolls, kind
    cdef const double[::1] each = None, patch = None, moment = None
    cdef double one = 0.0
    cdef Py_ssize_t i
    kind = sides if sides else contact_kind(False, spin, rolls, tangents)
    if not 0 <= k < 2147483647 // size:
        return None
    if type(mu) is float:
        one = mu
    else:
        each = mu
        if each.shape[0] != k:
            return None
    if radius is not None:
        patch = radius
        if patch.shape[0] != k:
            return None
    if rolls:
        moment = rolling
        if moment.shape[0] != k:
            return None
    cdef Blocks made = room_of(k, k * size)
    (<int32_t*>made.at.ptr)[0] = 0
    for i in range(k):
        (<int32_t*>made.at.ptr)[i + 1] = <int32_t>(i + 1) * size
        (<int32_t*>made.at.kind)[i] = kind
        (<double*>made.at.mu)[i] = one if each is None else each[i]
        (<double*>made.at.patch_radius)[i] = 0.0 if patch is None else patch[i]
        (<double*>made.at.rolling)[i] = moment[i] if rolls else 0.0
    spell_bounds(&made.at)
    return made if made.check() else None
