"""Checks of arrays for what most callers give: float64 that lies together, of the shape asked for.

Nothing is said here of what is wrong: where a function says no, the long way checks again, decides, and finds the words.
"""
from libc.stdint cimport int32_t

from lavender_ext.core cimport door
from lavender_ext.core.arrays cimport DOUBLE, TOGETHER, doubles, is_of, ndarray
from lavender_ext.core.door cimport first_unsized, has_outside, is_definite, is_frame, is_size, least, most

#: The largest and the least size that a number of a problem may have.
MOST, LEAST = most(), least()


def plain(value, tuple shape, bint finite, bint copy):
    """`value`, or a copy of it, read-only; None where it is not such an array and the long way finds the words.

    None in `shape` stands for any length; `finite`: what core/door.pxd (1) excludes is left to the long way.
    """
    cdef ndarray held
    cdef Py_ssize_t i, n = 1
    if type(value) is not ndarray:
        return None
    held = <ndarray>value
    if held.nd != len(shape) or not held.flags & TOGETHER or not is_of(held, DOUBLE):
        return None
    for i in range(held.nd):
        wanted = shape[i]
        n *= held.dimensions[i]
        if wanted is not None and wanted != held.dimensions[i]:
            return None
    if finite and has_outside(<const double*>held.data, n):
        return None
    made = value.copy() if copy else value
    made.setflags(False)
    return made


def inside(x):
    """Whether every number of an array of float64 is at most MOST in size, none NaN: (1) of core/door.pxd."""
    return not has_outside(doubles(x, x.size), x.size)


def unsized(const double[::1] x):
    """The first number that is neither 0 nor from LEAST to MOST, or -1: (2) of core/door.pxd."""
    return first_unsized(&x[0], x.shape[0]) if x.shape[0] else -1


def largest(numbers):
    """max |x_i| of float64: 0 without entries, NaN where one is."""
    return door.largest(doubles(numbers, numbers.size), numbers.size)


def has_negative(const double[::1] x):
    """Whether any number is below 0."""
    cdef Py_ssize_t i
    for i in range(x.shape[0]):
        if x[i] < 0.0:
            return True
    return False


def counts_up(const int32_t[::1] ptr):
    """Whether pointers begin with 0 and increase."""
    cdef Py_ssize_t i
    if ptr.shape[0] == 0 or ptr[0] != 0:
        return False
    for i in range(1, ptr.shape[0]):
        if ptr[i] <= ptr[i - 1]:
            return False
    return True


def are_pairs(const int32_t[:, ::1] pair, int32_t n, bint moves):
    """`are_pairs` of core/door.pxd, (k, 2)."""
    return pair.shape[0] == 0 or door.are_pairs(&pair[0, 0], pair.shape[0], n, moves)


def are_frames(const double[:, ::1] normal, const double[:, ::1] tangent):
    """Whether normals and tangents (c, 3) are orthogonal unit vectors, to half of what is allowed."""
    cdef Py_ssize_t i
    for i in range(normal.shape[0]):
        if not is_frame(&normal[i, 0], &tangent[i, 0], 5e-10):
            return False
    return True


def are_definite(const double[:, :, ::1] tensor):
    """Whether every tensor (n, 3, 3) is zero, or symmetric to half of what is allowed with pivots well above 0."""
    cdef Py_ssize_t i
    for i in range(tensor.shape[0]):
        if not (is_size(door.largest(&tensor[i, 0, 0], 9)) and is_definite(&tensor[i, 0, 0], 5e-10, 0.0, 1e-6)):
            return False
    return True
