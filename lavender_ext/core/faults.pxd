"""Validation of a problem's structs, for every host: the first fault and its index.

`core/blocks.pyx` and `core/checks.pyx` (Python), `batch/world.pxd` and the C library call these functions and word their own
messages. core/validate.pxd defines the ranges. All checks compare so that NaN is a fault.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport CONTACT_BOX, ROUND, ROW, blocks_t, allows_rows
from lavender_ext.core.validate cimport (find_invalid_magnitude, find_invalid_number, has_invalid_number,
                                         is_valid_magnitude, is_valid_number, is_zero_or_definite_inertia, min_magnitude,
                                         norm_inf)
from lavender_ext.core.view cimport rows_t


cdef enum:                      # faults, and what their index counts; `checks.FAULT_NAMES` has their names
    NO_FAULT = 0
    FAULT_POINTERS = 1          # entry of ptr: it does not begin with 0, increase, and end with the number of rows
    FAULT_KIND = 2              # block: no block of this kind has this number of rows
    FAULT_MU = 3                # block
    FAULT_PATCH_RADIUS = 4      # block
    FAULT_SPIN = 5              # block: mu times the patch radius
    FAULT_ROLLING = 6           # block
    FAULT_BOUNDS = 7            # row: no number is between its bounds
    FAULT_LOWER = 8             # row
    FAULT_UPPER = 9             # row
    FAULT_MASS = 10             # body: negative, or out of range
    FAULT_INERTIA_SIZE = 11     # body: the largest entry is out of range
    FAULT_INERTIA = 12          # body: neither zero nor positive definite and symmetric
    FAULT_JOINT_BODY = 13       # entry of joint_body: no such body
    FAULT_JOINT_PAIR = 14       # joint of a body with itself
    FAULT_CONTACT_BODY = 15     # entry of contact_body: no such body
    FAULT_CONTACT_PAIR = 16     # contact of a body with itself, or of two static bodies
    FAULT_FRAME = 17            # contact: normal and tangent are not orthogonal unit vectors
    FAULT_COLUMN = 18           # entry of a matrix in compressed rows: columns do not ascend within their range
    FAULT_DIAGONAL = 19         # row of a lower triangle without a diagonal entry at its end
    FAULT_RATIO = 20            # block: mu_2 / mu_1 of an ellipse is out of range
    FAULT_NUMBER = 21           # entry of a right-hand side: not finite, or out of range
    FAULT_SMALL_RHS = 22        # the largest entry of a right-hand side is too small
    FAULT_BODY_BLOCK = 23       # block: joints are not followed by contacts without round cones

cdef enum:
    CONTACT_ELLIPSE = 7         # Only Python has this kind: kernels solve and judge `Problem.disk`.


cdef struct body_tolerances_t:
    double frame                # permitted deviation of normal and tangent from orthogonal unit vectors
    double skew                 # permitted asymmetry of an inverse inertia, relative to its largest entry
    double shift                # An inverse inertia plus shift times its largest entry must be positive definite,
    double pivot                # with pivots above this fraction of its largest entry.


# -- pointers ----------------------------------------------------------------------------------------------------

cdef inline int64_t find_pointer_fault(const int32_t* ptr, int64_t n, int32_t end, int32_t min_size) noexcept nogil:
    """Return the first of n + 1 pointers that is not 0, at least `min_size` above the last one, and at most `end`, or -1."""
    cdef int64_t i
    if ptr[0] != 0:
        return 0
    for i in range(1, n + 1):
        if not <int64_t>ptr[i - 1] + min_size <= ptr[i] <= end:
            return i
    return -1


# -- blocks ------------------------------------------------------------------------------------------------------

cdef inline bint is_valid_bound(double x) noexcept nogil:
    return is_valid_number(x) or fabs(x) == INFINITY


cdef inline int32_t find_fault_of_row_bounds(const double* lower, const double* upper, int32_t j) noexcept nogil:
    """Return the fault of the bounds of row j; NULL: unbounded."""
    cdef double low = lower[j] if lower != NULL else -INFINITY, high = upper[j] if upper != NULL else INFINITY
    if not (low <= high and low < INFINITY and high > -INFINITY):
        return FAULT_BOUNDS
    return FAULT_LOWER if not is_valid_bound(low) else FAULT_UPPER if not is_valid_bound(high) else NO_FAULT


cdef inline int32_t find_friction_fault(const blocks_t* p, int32_t kind, int32_t i) noexcept nogil:
    """Return the fault of the coefficients of block i; NULL: zeros, and ratios of 1."""
    cdef double mu = p.mu[i] if p.mu != NULL else 0.0, radius = 1.0 if kind == CONTACT_BOX else 0.0
    if p.patch_radius != NULL:
        radius = p.patch_radius[i]
    if not is_valid_magnitude(mu):
        return FAULT_MU
    if not is_valid_magnitude(radius):
        return FAULT_PATCH_RADIUS
    if kind != ROW and not is_valid_magnitude(mu * radius):
        return FAULT_SPIN
    return FAULT_ROLLING if p.rolling != NULL and not is_valid_magnitude(p.rolling[i]) else NO_FAULT


cdef inline int32_t find_block_fault(const blocks_t* p, int64_t* index) noexcept nogil:
    """Return the first fault of the blocks. Arrays that are NULL have their defaults: single, unbounded rows without friction."""
    cdef int32_t i, j, kind, first, end, fault
    cdef double max_ratio = 2.0**60                     # upper bound of mu_2 / mu_1 and mu_1 / mu_2 of an ellipse
    index[0] = find_pointer_fault(p.ptr, p.n_blocks, p.n_rows, 1) if p.ptr != NULL else -1
    if index[0] >= 0:
        return FAULT_POINTERS
    if (p.ptr[p.n_blocks] if p.ptr != NULL else p.n_blocks) != p.n_rows:
        index[0] = p.n_blocks
        return FAULT_POINTERS
    for i in range(p.n_blocks):
        first, end = p.ptr[i] if p.ptr != NULL else i, p.ptr[i + 1] if p.ptr != NULL else i + 1
        kind = p.kind[i] if p.kind != NULL else ROW
        index[0] = i
        if not allows_rows(CONTACT_BOX if kind == CONTACT_ELLIPSE else kind, end - first):
            return FAULT_KIND
        if kind == CONTACT_ELLIPSE and p.patch_radius != NULL and not 1.0 / max_ratio <= p.patch_radius[i] <= max_ratio:
            return FAULT_RATIO
        fault = find_friction_fault(p, kind, i)
        if fault != NO_FAULT:
            return fault
        for j in range(first, end if kind == ROW else first):
            fault = find_fault_of_row_bounds(p.lower, p.upper, j)
            if fault != NO_FAULT:
                index[0] = j
                return fault
    return NO_FAULT


cdef inline int32_t find_body_block_fault(const blocks_t* p, int32_t n_joints, int64_t* index) noexcept nogil:
    """Return the fault of the first block that is not a joint, among the first n_joints blocks, or not a contact after them."""
    cdef int32_t i, kind
    for i in range(p.n_blocks):
        index[0] = i
        kind = p.kind[i] if p.kind != NULL else ROW
        if (kind == ROW) != (i < n_joints) or kind == ROUND:
            return FAULT_BODY_BLOCK
    return NO_FAULT


# -- bodies ------------------------------------------------------------------------------------------------------

cdef inline int32_t find_pair_fault(const int32_t* pair, int64_t k, int32_t n, bint moves, int64_t* index) noexcept nogil:
    """Return 1 at the first body that does not exist, 2 at the first pair of a body with itself, else 0.

    Bodies are -1 (static) to n - 1; with `moves`, two static bodies are no pair.
    """
    cdef int64_t i
    for i in range(2 * k):
        if not -1 <= pair[i] < n:
            index[0] = i
            return 1
    for i in range(k):
        if pair[2 * i] == pair[2 * i + 1] and (moves or pair[2 * i] >= 0):
            index[0] = i
            return 2
    return 0


cdef inline double measure_frame_error(const double* n, const double* t) noexcept nogil:
    """Return the largest deviation of |n| and |t| from 1 and of n.t from 0, or 0 if it is within rounding."""
    cdef double nn = n[0] * n[0] + n[1] * n[1] + n[2] * n[2], tt = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
    cdef double nt = fabs(n[0] * t[0] + n[1] * t[1] + n[2] * t[2])
    if fabs(nn - 1.0) <= 5e-10 and fabs(tt - 1.0) <= 5e-10 and nt <= 5e-10:
        return 0.0
    return max(max(fabs(sqrt(nn) - 1.0), fabs(sqrt(tt) - 1.0)), nt)


cdef inline void orthonormalise_frame(double* n, double* t) noexcept nogil:
    """Divide n by its length, take the part along n out of t, and divide t by its length."""
    cdef int32_t k
    cdef double size = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]), along = 0.0
    for k in range(3):
        n[k] /= size
    along = n[0] * t[0] + n[1] * t[1] + n[2] * t[2]
    for k in range(3):
        t[k] -= along * n[k]
    size = sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for k in range(3):
        t[k] /= size


cdef inline int32_t find_body_fault(const rows_t* r, const body_tolerances_t* tolerances, int64_t* index) noexcept nogil:
    """Return the first fault of bodies, pairs and frames, whose numbers satisfy (1) of core/validate.pxd."""
    cdef int32_t i, fault
    i = <int32_t>find_invalid_magnitude(r.inv_mass, r.n_bodies)
    index[0] = i
    if i >= 0:
        return FAULT_MASS
    for i in range(r.n_bodies):
        index[0] = i
        if not is_valid_magnitude(norm_inf(r.inv_inertia + 9 * i, 9)):
            return FAULT_INERTIA_SIZE
    fault = find_pair_fault(r.joint_body, r.n_joints, r.n_bodies, False, index)
    if fault:
        return FAULT_JOINT_BODY if fault == 1 else FAULT_JOINT_PAIR
    fault = find_pair_fault(r.contact_body, r.n_contacts, r.n_bodies, True, index)
    if fault:
        return FAULT_CONTACT_BODY if fault == 1 else FAULT_CONTACT_PAIR
    for i in range(r.n_bodies):
        index[0] = i
        if not is_zero_or_definite_inertia(r.inv_inertia + 9 * i, tolerances.skew, tolerances.shift, tolerances.pivot):
            return FAULT_INERTIA
    for i in range(r.n_contacts):
        index[0] = i
        if not measure_frame_error(r.normal + 3 * i, r.tangent + 3 * i) <= tolerances.frame:
            return FAULT_FRAME
    return NO_FAULT


# -- right-hand sides and matrices -------------------------------------------------------------------------------

cdef inline int32_t find_rhs_fault(const double* b, int64_t m, int64_t* index) noexcept nogil:
    """Return the first fault of a right-hand side: every |b_i| must satisfy (1) of core/validate.pxd, the largest one (2)."""
    index[0] = find_invalid_number(b, m) if has_invalid_number(b, m) else 0
    if m > 0 and not is_valid_number(b[index[0]]):
        return FAULT_NUMBER
    return FAULT_SMALL_RHS if 0.0 < norm_inf(b, m) < min_magnitude() else NO_FAULT


cdef inline bint is_valid_rhs(const double* b, int64_t m) noexcept nogil:
    """Return whether a right-hand side has no fault."""
    cdef int64_t index
    return find_rhs_fault(b, m, &index) == NO_FAULT


cdef inline int32_t find_matrix_fault(const int32_t* ptr, const int32_t* column, int32_t n_rows, int32_t n_columns,
                                      int32_t n_entries, bint is_lower, int64_t* index) noexcept nogil:
    """Return the first fault of a matrix in compressed rows; a lower triangle needs a diagonal entry in every row."""
    cdef int32_t i, k
    index[0] = find_pointer_fault(ptr, n_rows, n_entries, 0)
    if index[0] >= 0:
        return FAULT_POINTERS
    if ptr[n_rows] != n_entries:
        index[0] = n_rows
        return FAULT_POINTERS
    for i in range(n_rows):
        for k in range(ptr[i], ptr[i + 1]):
            if not 0 <= column[k] < n_columns or (k > ptr[i] and column[k] <= column[k - 1]):
                index[0] = k
                return FAULT_COLUMN
        if is_lower and (ptr[i] == ptr[i + 1] or column[ptr[i + 1] - 1] != i):
            index[0] = i
            return FAULT_DIAGONAL
    return NO_FAULT
