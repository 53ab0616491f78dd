"""Creation, concatenation and checks of blocks, in one pass over a few small arrays.

The same work in ten NumPy calls takes longer than a solve of eight rows. If a function returns None, the arrays need
conversion, or have a fault of core/faults.pxd: `lavender.problem.cones` converts them and raises.
"""
from libc.stdint cimport int32_t, int64_t

import numpy as np

from lavender_ext.core.arrays cimport DOUBLE, INT, make_read_only, has_element_type, ndarray
from lavender_ext.core.faults cimport CONTACT_ELLIPSE, NO_FAULT, find_block_fault, find_body_block_fault
from lavender_ext.core.block_types cimport (CONTACT, CONTACT_BOX, CONTACT_ROLLING, CONTACT_SPIN, ROUND, ROW, blocks_t,
                                            choose_contact_kind, write_contact_bounds)

#: Kernel numbers of the kinds of blocks.
KINDS = (ROW, CONTACT, CONTACT_SPIN, ROUND, CONTACT_BOX, CONTACT_ROLLING, CONTACT_ELLIPSE)

cdef double INF = 1.0 / 0.0
cdef object new = np.empty, F8 = np.dtype(np.float64), I4 = np.dtype(np.int32)


cdef class Blocks:
    """Pointers to the arrays of a problem's blocks, which are kept alive (`make_blocks_over_arrays`)."""

    def __init__(self):
        raise TypeError("blocks are made by make_blocks_from_copied_arrays or make_blocks_over_arrays")

    @property
    def arrays(self):
        """Arrays (ptr, kind, lower, upper, mu, patch_radius, rolling): views, created at first use."""
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

    cdef bint bind_arrays(self, const int32_t[::1] ptr, const int32_t[::1] kind, const double[::1] lower,
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

    cdef bint validate(self) noexcept:
        """Set the first fault, or the flags of the blocks; return whether there is no fault."""
        cdef blocks_t* p = &self.at
        cdef int32_t i, j, size, kind
        self.fault = find_block_fault(p, &self.index)
        if self.fault != NO_FAULT:
            return False
        self.is_free = self.is_bounded_rows = self.single_rows = True
        self.has_round = self.has_rolling = self.has_ellipse = False
        for i in range(p.n_blocks):
            size = p.ptr[i + 1] - p.ptr[i]
            kind = p.kind[i]
            self.has_round |= kind == ROUND
            self.has_rolling |= kind == CONTACT_ROLLING
            self.has_ellipse |= kind == CONTACT_ELLIPSE
            if kind != ROW or size > 1:
                self.single_rows = False
            if kind != ROW:
                self.is_free = False
                if size > 1:
                    self.is_bounded_rows = False
            for j in range(p.ptr[i], p.ptr[i + 1] if self.is_free else p.ptr[i]):
                if p.lower[j] != -INF or p.upper[j] != INF:
                    self.is_free = False
        return True


cdef Blocks allocate_blocks(Py_ssize_t k, Py_ssize_t m, Py_ssize_t ints=0, Py_ssize_t numbers=0):
    """Create k blocks of m rows over new, uninitialised arrays, which are read-only for Python.

    `ints` int32 and `numbers` float64 of extra memory follow at the end of the arrays.
    """
    cdef Blocks blocks = Blocks.__new__(Blocks)
    blocks.ints, blocks.numbers = make_read_only(new(2 * k + 1 + ints, I4)), make_read_only(new(2 * m + 3 * k + numbers))
    blocks.at.n_blocks = <int32_t>k
    blocks.at.n_rows = <int32_t>m
    blocks.at.ptr = <int32_t*>(<ndarray>blocks.ints).data
    blocks.at.kind = blocks.at.ptr + k + 1
    blocks.at.lower = <double*>(<ndarray>blocks.numbers).data
    blocks.at.upper = blocks.at.lower + m
    blocks.at.mu = blocks.at.upper + m
    blocks.at.patch_radius, blocks.at.rolling = blocks.at.mu + k, blocks.at.mu + 2 * k
    return blocks


cdef void copy_blocks(Blocks to, Py_ssize_t block, Py_ssize_t row, const blocks_t* p) noexcept:
    """Copy the blocks of p into `to`, beginning at this block and row."""
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


def concatenate_blocks(list each):
    """Return the blocks of all items of `each` in sequence, or None if the rows exceed 32-bit indices."""
    cdef Py_ssize_t k = 0, m = 0
    cdef Blocks one
    for one in each:
        k += one.at.n_blocks
        m += one.at.n_rows
    if k >= 2147483647 or m >= 2147483647:
        return None
    cdef Blocks blocks = allocate_blocks(k, m)
    (<int32_t*>blocks.at.ptr)[0] = 0
    k = m = 0
    for one in each:
        copy_blocks(blocks, k, m, &one.at)
        k += one.at.n_blocks
        m += one.at.n_rows
    blocks.validate()
    return blocks


def are_joints_then_contacts(Blocks blocks, const int32_t[::1] joint_ptr):
    """Return whether the blocks are ROW blocks with these pointers, followed only by contacts without round cones."""
    cdef int32_t i, kj = <int32_t>joint_ptr.shape[0] - 1
    cdef int64_t index
    if kj > blocks.at.n_blocks or find_body_block_fault(&blocks.at, kj, &index) != NO_FAULT:
        return False
    for i in range(kj + 1):
        if blocks.at.ptr[i] != joint_ptr[i]:
            return False
    return True


def make_blocks_from_copied_arrays(ptr, kind, lower, upper, mu, patch_radius, rolling):
    """Return blocks over a copy of these arrays, whose `fault` is set; None if the arrays need conversion or have NaN bounds."""
    cdef Blocks source = Blocks.__new__(Blocks), blocks
    cdef Py_ssize_t j
    for x, type_number in ((ptr, INT), (kind, INT), (lower, DOUBLE), (upper, DOUBLE), (mu, DOUBLE), (patch_radius, DOUBLE),
                           (rolling, DOUBLE)):
        if type(x) is not ndarray or not has_element_type(x, type_number) or x.ndim != 1 or not x.flags.c_contiguous:
            return None
    if not source.bind_arrays(ptr, kind, lower, upper, mu, patch_radius, rolling):
        return None
    for j in range(source.at.n_rows):
        if source.at.lower[j] != source.at.lower[j] or source.at.upper[j] != source.at.upper[j]:
            return None
    blocks = allocate_blocks(source.at.n_blocks, source.at.n_rows)
    copy_blocks(blocks, 0, 0, &source.at)
    if blocks.validate():
        write_contact_bounds(&blocks.at)
    return blocks


def make_blocks_over_arrays(ptr, kind, lower, upper, mu, patch_radius, rolling):
    """Return blocks that read these arrays in place; raise ValueError if they do not fit each other or have a fault."""
    cdef Blocks blocks = Blocks.__new__(Blocks)
    if not blocks.bind_arrays(ptr, kind, lower, upper, mu, patch_radius, rolling) or not blocks.validate():
        raise ValueError("the arrays of the blocks have different lengths or invalid values; arrays of valid blocks are needed")
    blocks._arrays = (ptr, kind, lower, upper, mu, patch_radius, rolling)
    return blocks


def make_free_rows(Py_ssize_t m):
    """Return m unbounded rows, each a block; None if m is negative or exceeds 32-bit indices."""
    if not 0 <= m < 2147483647:
        return None
    return make_equally_bounded_rows(m, NULL, NULL)


def make_bounded_rows(lower, upper):
    """Return one row per pair of bounds; `upper` may be inf for all rows. Return None if the arrays need detailed validation."""
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
    return make_equally_bounded_rows(m, &low[0] if m else NULL, &high[0] if m and not open_ else NULL)


cdef Blocks make_equally_bounded_rows(Py_ssize_t m, const double* lower, const double* upper):
    """Return m single-row blocks with these bounds, or None if a bound is invalid; NULL means unbounded."""
    cdef Blocks blocks = allocate_blocks(m, m)
    cdef Py_ssize_t i
    (<int32_t*>blocks.at.ptr)[0] = 0
    for i in range(m):
        (<int32_t*>blocks.at.ptr)[i + 1] = <int32_t>i + 1
        (<int32_t*>blocks.at.kind)[i] = ROW
        (<double*>blocks.at.mu)[i] = (<double*>blocks.at.patch_radius)[i] = (<double*>blocks.at.rolling)[i] = 0.0
        (<double*>blocks.at.lower)[i] = -INF if lower == NULL else lower[i]
        (<double*>blocks.at.upper)[i] = INF if upper == NULL else upper[i]
    return blocks if blocks.validate() else None


def make_contact_blocks(Py_ssize_t k, int32_t tangents, mu, radius, rolling, int32_t sides=0):
    """Return k contacts, whose `fault` is set; None if they have too many rows.

    Each contact has `tangents` tangent rows, a spin row if `radius` (k,) is given, and two rolling rows if `rolling` (k,)
    [m], mu_r, is given. mu is a float or an array (k,). `sides` is CONTACT_BOX or CONTACT_ELLIPSE (two tangents; `radius` is
    then mu_2 / mu_1), otherwise 0.
    """
    cdef bint spin = radius is not None and not sides, has_rolling = rolling is not None
    cdef int32_t size = 1 + tangents + spin + 2 * has_rolling, kind
    cdef const double[::1] each = None, patch = None, moment = None
    cdef double one = 0.0
    cdef Py_ssize_t i
    kind = sides if sides else choose_contact_kind(False, spin, has_rolling, tangents)
    if not 0 <= k < 2147483647 // size:
        return None
    if type(mu) is float:
        one = mu
    else:
        each = mu
    if radius is not None:
        patch = radius
    if has_rolling:
        moment = rolling
    cdef Blocks blocks = allocate_blocks(k, k * size)
    (<int32_t*>blocks.at.ptr)[0] = 0
    for i in range(k):
        (<int32_t*>blocks.at.ptr)[i + 1] = <int32_t>(i + 1) * size
        (<int32_t*>blocks.at.kind)[i] = kind
        (<double*>blocks.at.mu)[i] = one if each is None else each[i]
        (<double*>blocks.at.patch_radius)[i] = 0.0 if patch is None else patch[i]
        (<double*>blocks.at.rolling)[i] = moment[i] if has_rolling else 0.0
    write_contact_bounds(&blocks.at)
    blocks.validate()
    return blocks
