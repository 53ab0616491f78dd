"""Fast checks of the usual arrays, contiguous float64 of the expected shape, and objects from checked attributes.

The checks report no reasons. If a check fails, the caller validates again in detail, decides, and writes the message.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.arrays cimport DOUBLE, C_CONTIGUOUS, as_double_pointer, as_int_pointer, has_element_type, ndarray
from lavender_ext.core.faults cimport (NO_FAULT, body_tolerances_t, find_body_fault as find_body_fault_of, find_matrix_fault,
                                        find_pointer_fault, is_valid_rhs, measure_frame_error, orthonormalise_frame)
from lavender_ext.core.validate cimport (any_magnitude_above, find_invalid_magnitude, has_invalid_number, max_magnitude,
                                         min_magnitude, norm_inf)
from lavender_ext.core.view cimport rows_t

cdef extern from "Python.h":
    """
    #define lav_make_object(cls, none) PyBaseObject_Type.tp_new((PyTypeObject*)(cls), none, NULL)
    """
    object lav_make_object(object cls, tuple none)
    int PyObject_GenericSetDict(object, object, void*) except -1

cdef tuple NO_ARGUMENTS = ()

#: Names of the faults of core/faults.pxd, by number.
FAULT_NAMES = (
    "", "pointers", "kind", "mu", "patch_radius", "spin", "rolling", "bounds", "lower", "upper", "mass", "inertia_size",
    "inertia", "joint_body", "joint_pair", "contact_body", "contact_pair", "frame", "column", "diagonal", "ratio",
    "number", "small_rhs", "body_block",
)
#: The largest and the smallest nonzero magnitude of a number of a problem.
MAX_MAGNITUDE, MIN_MAGNITUDE = max_magnitude(), min_magnitude()


cpdef make_instance(cls, dict attributes):
    """Return an object of the Python class `cls` with these attributes, without calling `__init__` or `__setattr__`."""
    made = lav_make_object(cls, NO_ARGUMENTS)
    PyObject_GenericSetDict(made, attributes, NULL)
    return made


def as_plain_array(value, tuple shape, bint finite, bint copy):
    """Return `value`, or a copy of it, read-only; None if it needs conversion or detailed validation.

    None is returned unless `value` is a contiguous float64 array of this shape, in which None stands for any length. With
    `finite` it is also None if a number violates core/validate.pxd (1).
    """
    cdef ndarray array
    cdef Py_ssize_t i, n = 1
    if type(value) is not ndarray:
        return None
    array = <ndarray>value
    if array.nd != len(shape) or not array.flags & C_CONTIGUOUS or not has_element_type(array, DOUBLE):
        return None
    for i in range(array.nd):
        length = shape[i]
        n *= array.dimensions[i]
        if length is not None and length != array.dimensions[i]:
            return None
    if finite and has_invalid_number(<const double*>array.data, n):
        return None
    result = value.copy() if copy else value
    result.setflags(False)
    return result


def all_in_valid_range(x):
    """Return whether every number of a float64 array satisfies core/validate.pxd (1): no NaN, at most MAX_MAGNITUDE."""
    return not has_invalid_number(as_double_pointer(x, x.size), x.size)


def find_invalid_magnitude_in_array(x):
    """Return the index of the first number that is neither 0 nor in [MIN_MAGNITUDE, MAX_MAGNITUDE], or -1."""
    return find_invalid_magnitude(as_double_pointer(x, x.size), x.size)


def max_abs_of_array(x):
    """Return max |x_i| of a float64 array: 0 if it is empty, NaN if any entry is NaN."""
    return norm_inf(as_double_pointer(x, x.size), x.size)


def has_entry_above(double bound, *arrays):
    """Return whether any |x_i| of these float64 arrays is above `bound` or NaN."""
    for x in arrays:
        if any_magnitude_above(as_double_pointer(x, x.size), x.size, bound):
            return True
    return False


def are_pointers_valid(ptr, int min_size):
    """Return whether the pointers (int32) begin with 0 and increase by at least min_size."""
    n = len(ptr)
    return n > 0 and find_pointer_fault(as_int_pointer(ptr, n), n - 1, 2147483647, min_size) < 0


def is_rhs_valid(b):
    """Return whether a right-hand side has no fault (core/faults.pxd)."""
    return len(b) == 0 or is_valid_rhs(as_double_pointer(b, len(b)), len(b))


def are_lower_triangles_valid(const int32_t[::1] indptr, const int32_t[::1] indices):
    """Return whether this is the pattern of a lower triangle in compressed rows, with every diagonal entry."""
    cdef int64_t index
    cdef int32_t n = <int32_t>indptr.shape[0] - 1, entries = <int32_t>indices.shape[0]
    return n >= 0 and find_matrix_fault(&indptr[0], &indices[0] if entries else NULL, n, n, entries, True, &index) == NO_FAULT


def correct_frames(double[:, ::1] normal, double[:, ::1] tangent, double min_error):
    """Orthonormalise the frames (c, 3) that are off by more than min_error; return the index of the largest error, and this error.

    Errors are those before the correction.
    """
    cdef Py_ssize_t i, worst = 0
    cdef double error, largest = -1.0
    for i in range(normal.shape[0]):
        error = measure_frame_error(&normal[i, 0], &tangent[i, 0])
        if error > largest:
            worst, largest = i, error
        if error > min_error:
            orthonormalise_frame(&normal[i, 0], &tangent[i, 0])
    return worst, largest


def find_body_fault(inv_mass, inv_inertia, joint_body, contact_body, normal, tangent, bint checks_inertia):
    """Return (name, index) of the first fault of bodies, pairs and frames (core/faults.pxd), ("", -1) if there is none.

    The arrays have valid numbers and shapes. Tolerances are half of those of `Rows`, so that arrays without a fault need no
    correction; without `checks_inertia`, inertias need not be symmetric or definite.
    """
    cdef rows_t r
    cdef int64_t index = -1
    cdef double loose = 0.0 if checks_inertia else 1.0 / 0.0
    cdef body_tolerances_t tolerances = body_tolerances_t(5e-10, 5e-10 + loose, loose, 1e-6)
    r.n_bodies, r.n_joints, r.n_contacts = <int32_t>len(inv_mass), <int32_t>len(joint_body), <int32_t>len(contact_body)
    r.inv_mass, r.inv_inertia = as_double_pointer(inv_mass, r.n_bodies), as_double_pointer(inv_inertia, 9 * r.n_bodies)
    r.joint_body, r.contact_body = as_int_pointer(joint_body, 2 * r.n_joints), as_int_pointer(contact_body, 2 * r.n_contacts)
    r.normal, r.tangent = as_double_pointer(normal, 3 * r.n_contacts), as_double_pointer(tangent, 3 * r.n_contacts)
    cdef int32_t fault = find_body_fault_of(&r, &tolerances, &index)
    return FAULT_NAMES[fault], index if fault else -1
