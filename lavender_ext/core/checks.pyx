"""Fast checks of the usual arrays: contiguous float64 of the expected shape.

These functions report no reasons. If a check fails, the caller validates again in detail, decides, and writes the message.
"""
from libc.stdint cimport int32_t

from lavender_ext.core cimport validate
from lavender_ext.core.arrays cimport DOUBLE, C_CONTIGUOUS, doubles, is_of, ndarray
from lavender_ext.core.validate cimport (first_invalid_magnitude, has_invalid, is_definite, is_frame, is_valid_magnitude,
                                         min_magnitude, max_magnitude)

#: The largest and the smallest nonzero magnitude of a number of a problem.
MAX_MAGNITUDE, MIN_MAGNITUDE = max_magnitude(), min_magnitude()


def as_plain_array(value, tuple shape, bint finite, bint copy):
    """Return `value`, or a copy of it, read-only; None if it needs conversion or detailed validation.

    The result is None unless `value` is a contiguous float64 array of this shape, in which None stands for any length. With
    `finite` it is also None if a number violates core/validate.pxd (1).
    """
    cdef ndarray array
    cdef Py_ssize_t i, n = 1
    if type(value) is not ndarray:
        return None
    array = <ndarray>value
    if array.nd != len(shape) or not array.flags & C_CONTIGUOUS or not is_of(array, DOUBLE):
        return None
    for i in range(array.nd):
        length = shape[i]
        n *= array.dimensions[i]
        if length is not None and length != array.dimensions[i]:
            return None
    if finite and has_invalid(<const double*>array.data, n):
        return None
    result = value.copy() if copy else value
    result.setflags(False)
    return result


def all_valid(x):
    """Return whether every number of a float64 array satisfies core/validate.pxd (1): no NaN, at most MAX_MAGNITUDE."""
    return not has_invalid(doubles(x, x.size), x.size)


def first_invalid_magnitude_of(const double[::1] x):
    """Return the index of the first number that is neither 0 nor in [MIN_MAGNITUDE, MAX_MAGNITUDE], or -1."""
    return first_invalid_magnitude(&x[0], x.shape[0]) if x.shape[0] else -1


def norm_inf(x):
    """Return max |x_i| of a float64 array: 0 if it is empty, NaN if any entry is NaN."""
    return validate.norm_inf(doubles(x, x.size), x.size)


def has_negative(const double[::1] x):
    """Return whether any number is below 0."""
    cdef Py_ssize_t i
    for i in range(x.shape[0]):
        if x[i] < 0.0:
            return True
    return False


def counts_up(const int32_t[::1] ptr):
    """Return whether the pointers begin with 0 and strictly increase."""
    cdef Py_ssize_t i
    if ptr.shape[0] == 0 or ptr[0] != 0:
        return False
    for i in range(1, ptr.shape[0]):
        if ptr[i] <= ptr[i - 1]:
            return False
    return True


def are_pairs(const int32_t[:, ::1] pair, int32_t n, bint moves):
    """Return `are_pairs` of core/validate.pxd for body pairs (k, 2)."""
    return pair.shape[0] == 0 or validate.are_pairs(&pair[0, 0], pair.shape[0], n, moves)


def are_frames(const double[:, ::1] normal, const double[:, ::1] tangent):
    """Return whether normals and tangents (c, 3) are orthogonal unit vectors, within half of the accepted tolerance."""
    cdef Py_ssize_t i
    for i in range(normal.shape[0]):
        if not is_frame(&normal[i, 0], &tangent[i, 0], 5e-10):
            return False
    return True


def are_definite(const double[:, :, ::1] tensor):
    """Return whether every tensor (n, 3, 3) is zero, or clearly positive definite and symmetric within half the tolerance."""
    cdef Py_ssize_t i
    for i in range(tensor.shape[0]):
        if not (is_valid_magnitude(validate.norm_inf(&tensor[i, 0, 0], 9)) and is_definite(&tensor[i, 0, 0], 5e-10, 0.0, 1e-6)):
            return False
    return True
