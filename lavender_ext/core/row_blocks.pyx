"""Rows of joints and contacts of a step, from points and axes in world coordinates; `lavender.RowBuilder` has the equations.

`RowBlocks` checks each block, appends its rows and returns its key. If a check fails, `fault` and `argument` name the reason,
for which the caller has a message; after NEEDS_CONVERSION the caller converts the arguments and calls again. Single blocks and
arrays of blocks are read into the same `arguments_t`, so that both give the same bits.

Bodies are numbers, -1 is the static world, and the first numbers of two dimensions are those of a plane z = 0 of three.
"""
from libc.math cimport INFINITY, NAN, fabs, fma, isinf, isnan, sqrt
from libc.stdint cimport INT32_MAX, int32_t, int64_t, uint64_t
from libc.string cimport memcpy, memset
from cpython.mem cimport PyMem_Free, PyMem_Realloc

import numpy as np

from lavender_ext.core.arrays cimport C_CONTIGUOUS, DOUBLE, as_double_pointer, as_int_pointer, has_element_type, ndarray
from lavender_ext.core.block_types cimport CONTACT as CONTACT_BLOCK, CONTACT_BOX, ROW, blocks_t, write_contact_bounds
from lavender_ext.core.blocks cimport Blocks, allocate_blocks
from lavender_ext.core.rows cimport cross, dot3, multiply_jacobian
from lavender_ext.core.validate cimport is_valid_number, min_magnitude
from lavender_ext.core.vectors cimport copy3, scale3, subtract3
from lavender_ext.core.view cimport rows_t

#: Vectors and numbers of each type of block; those with "?" may be None. The position of a type is the highest part of a key.
ARGUMENTS = {
    "hinge": (("anchor", "anchor_b?", "axis?", "axis_b?"), ()),
    "ball": (("anchor", "anchor_b?"), ()),
    "weld": (("anchor", "anchor_b?", "angle_error"), ()),
    "slider": (("anchor", "anchor_b?", "axis", "angle_error"), ()),
    "distance": (("anchor_a", "anchor_b"), ("length?",)),
    "motor": (("axis?", "anchor?"), ("speed", "max_torque?", "max_force?")),
    "limit": (("axis?", "anchor?"), ("value", "lower", "upper")),
    "spring": (("anchor_a", "anchor_b"), ("length", "stiffness", "damping")),
    "gear": (("axis_a?", "axis_b?"), ("ratio", "angle_error")),
    "contact": (("point", "normal", "tangent?"), ("gap", "mu", "restitution", "restitution_threshold")),
}
#: Faults of the arguments of a block by number.
FAULTS = ("", "conversion", "axis_given", "axis_missing", "length", "anchor_given", "anchor_missing", "rod", "spring", "motor",
          "limits", "ratio", "normal", "tangent_given", "parallel")

cdef enum:
    HINGE, BALL, WELD, SLIDER, DISTANCE, MOTOR, LIMIT, SPRING, GEAR, CONTACT, N_TYPES
    NO_FAULT = 0, NEEDS_CONVERSION, AXIS_GIVEN, AXIS_MISSING, NO_LENGTH, ANCHOR_GIVEN, ANCHOR_MISSING, ROD, NO_SPRING, NO_BOUND
    NO_LIMITS, NO_RATIO, BAD_NORMAL, TANGENT_GIVEN, PARALLEL
    MAX_FEATURE = 65535             # Larger features do not fit into the 16 bits of a key.
    MAX_ROWS = 6                    # Rows of the largest joint.
    MAX_VECTORS = 4
    MAX_NUMBERS = 4

cdef int32_t[N_TYPES] N_VECTORS = [len(vectors) for vectors, _ in ARGUMENTS.values()]
cdef int32_t[N_TYPES] N_NUMBERS = [len(numbers) for _, numbers in ARGUMENTS.values()]
# [-] A normal is rejected if its length differs from 1 by more; float32 causes 1e-7.
cdef double NORMAL_LENGTH_TOLERANCE = 1e-5

cdef double[3][3] UNIT = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


cdef struct arguments_t:
    int32_t a, b
    bint[MAX_VECTORS] given         # Whether each vector is given.
    double[MAX_VECTORS][3] vector   # Points [m] and directions.
    double[MAX_NUMBERS] number      # NaN: not given.

cdef struct row_t:                  # row of a joint
    double[12] jac                  # linear and angular on a, then on b
    double target, lower, upper, compliance

cdef struct joint_t:
    uint64_t key
    int32_t a, b, n_rows

cdef struct contact_t:
    uint64_t key
    int32_t a, b
    double[4][3] frame              # normal, tangent, arm on a, arm on b
    double mu, target


# -- vectors -----------------------------------------------------------------------------------------------------

cdef inline double norm(const double* x) noexcept nogil:
    """Return |x| of a vector (3,), rounded once: squares and their sum have a correction, as in `math.hypot`."""
    cdef double total = 0.0, error = 0.0, square, before, root
    cdef int32_t k
    for k in range(3):
        square = x[k] * x[k]
        error += fma(x[k], x[k], -square)
        before = total
        total = before + square
        error += (square - (total - before)) if before >= square else (before - (total - square))
    if total == 0.0:
        return 0.0
    root = sqrt(total)
    return root + (fma(-root, root, total) + error) / (2.0 * root)


cdef inline bint normalise(const double* x, double* out) noexcept nogil:
    """Compute x / |x|; return whether x has a direction."""
    cdef double size = norm(x)
    cdef int32_t k
    if not size >= min_magnitude():
        return False
    for k in range(3):
        out[k] = x[k] / size
    return True


cdef inline void complete_frame(const double* axis, double* side, double* other) noexcept nogil:
    """Compute two unit vectors that form a right-handed frame with a unit vector: side, other = axis x side."""
    cdef int32_t k, smallest = 0
    cdef double[3] across
    for k in range(1, 3):
        if fabs(axis[k]) < fabs(axis[smallest]):
            smallest = k
    cross(axis, UNIT[smallest], across)
    normalise(across, side)
    cross(axis, side, other)


# -- arguments of one call ---------------------------------------------------------------------------------------

cdef inline bint read_number(object value, double* out):
    """Read a float or an int; return whether it is one. None is NaN."""
    if value is None:
        out[0] = NAN
    elif isinstance(value, float):
        out[0] = value
        return not isnan(out[0])
    elif type(value) is int:
        try:
            out[0] = value
        except OverflowError:
            return False
    else:
        return False
    return True


cdef inline bint read_vector(object value, int32_t n, double* out):
    """Read n numbers of a list, tuple or contiguous float64 array; return whether they are valid."""
    cdef ndarray array
    cdef int32_t k
    if type(value) is ndarray:
        array = <ndarray>value
        if array.nd != 1 or array.dimensions[0] != n or not (array.flags & C_CONTIGUOUS and has_element_type(array, DOUBLE)):
            return False
        for k in range(n):
            out[k] = (<double*>array.data)[k]
    elif (type(value) is tuple or type(value) is list) and len(value) == n:
        for k in range(n):
            if value[k] is None or not read_number(value[k], out + k):
                return False
    else:
        return False
    for k in range(n):
        if not is_valid_number(out[k]):
            return False
    return True


cdef inline int64_t read_body(object value, int32_t n):
    """Return the number of a body, -1 for the static world, or -2 for another value."""
    if value is None:
        return -1
    if type(value) is not int and not (isinstance(value, np.integer) and not isinstance(value, np.timedelta64)):
        return -2
    return value if -1 <= value < n else -2


cdef int grow(void** memory, int32_t* capacity, int64_t count, size_t size) except -1:
    """Reallocate an array of elements of `size` bytes if its capacity is below `count`."""
    cdef void* larger
    if count > capacity[0]:
        count += count // 2 + 16
        larger = PyMem_Realloc(memory[0], count * size)
        if larger == NULL or count > INT32_MAX:
            raise MemoryError(f"{count} rows or blocks")
        memory[0], capacity[0] = larger, <int32_t>count
    return 0


cdef class RowBlocks:
    """Joints and contacts of a step; `add` and `add_many` append to them.

    Parameters
    ----------
    centres : ndarray (n, 3), m
    velocity, velocity_before : ndarray (n, 6), m/s and rad/s
    dimensions : int
        2 or 3.
    dt, baumgarte, slop : float
        As in `lavender.RowBuilder`.
    """

    cdef object keep                # the arrays of the next pointers
    cdef const double* centres
    cdef const double* velocity
    cdef const double* velocity_before
    cdef int32_t n_bodies, dimensions
    cdef double dt, baumgarte, slop
    cdef row_t* rows
    cdef joint_t* joints
    cdef contact_t* contacts
    cdef int32_t n_rows, n_joints, n_contacts, row_capacity, joint_capacity, contact_capacity
    cdef readonly dict next_feature  # number of the next block by its key without a feature
    cdef readonly set keys
    cdef readonly int32_t fault, argument   # fault of the last block, and the argument that it refers to

    def __cinit__(self, centres, velocity, velocity_before, int32_t dimensions, double dt, double baumgarte, double slop):
        self.n_bodies, self.dimensions = <int32_t>len(centres), dimensions
        self.dt, self.baumgarte, self.slop = dt, baumgarte, slop
        self.keep = (centres, velocity, velocity_before)
        self.centres = as_double_pointer(centres, 3 * self.n_bodies)
        self.velocity = as_double_pointer(velocity, 6 * self.n_bodies)
        self.velocity_before = as_double_pointer(velocity_before, 6 * self.n_bodies)
        self.next_feature, self.keys = {}, set()

    def __dealloc__(self):
        PyMem_Free(self.rows)
        PyMem_Free(self.joints)
        PyMem_Free(self.contacts)

    # -- rows ----------------------------------------------------------------------------------------------------

    cdef inline bint reject(self, int32_t fault, int32_t argument=0) noexcept:
        """Store the fault of a block and return False."""
        self.fault, self.argument = fault, argument
        return False

    cdef inline bint normalise_argument(self, const arguments_t* x, int32_t which, double* out) noexcept:
        """Compute the unit vector of an argument; return whether it has a direction."""
        return normalise(x.vector[which], out) or self.reject(NO_LENGTH, which)

    cdef inline row_t* append_row(self, double error) noexcept:
        """Append a rigid row (eq. 1) without its Jacobian."""
        cdef row_t* row = self.rows + self.n_rows
        self.n_rows += 1
        memset(row, 0, sizeof(row_t))
        row.target, row.lower, row.upper = -self.baumgarte * error / self.dt, -INFINITY, INFINITY
        return row

    cdef inline void compute_arm(self, int32_t body, const double* point, double* out) noexcept:
        """Compute a point minus the centre of a body; 0 for the static world."""
        if body < 0:
            memset(out, 0, 3 * sizeof(double))
        else:
            subtract3(point, self.centres + 3 * body, out)

    cdef row_t* append_linear_row(self, const arguments_t* x, const double* axis, const double* point_a,
                                  const double* point_b, double error) noexcept:
        """Append axis.(v_b + omega_b x arm_b - v_a - omega_a x arm_a); its error is a distance [m]."""
        cdef row_t* row = self.append_row(error)
        cdef double[3] arm, moment
        if x.a >= 0:
            self.compute_arm(x.a, point_a, arm)
            cross(arm, axis, moment)
            scale3(-1.0, axis, row.jac)
            scale3(-1.0, moment, row.jac + 3)
        if x.b >= 0:
            self.compute_arm(x.b, point_b, arm)
            cross(arm, axis, row.jac + 9)
            copy3(axis, row.jac + 6)
        return row

    cdef row_t* append_angular_row(self, const arguments_t* x, const double* axis_a, const double* axis_b,
                                   double error) noexcept:
        """Append axis_b.omega_b - axis_a.omega_a; its error is an angle [rad]."""
        cdef row_t* row = self.append_row(error)
        if x.a >= 0:
            scale3(-1.0, axis_a, row.jac + 3)
        if x.b >= 0:
            copy3(axis_b, row.jac + 9)
        return row

    cdef void append_point_rows(self, const arguments_t* x) noexcept:
        """Append the rows that hold the second point on b at the first point on a."""
        cdef double[3] offset
        cdef int32_t k
        subtract3(x.vector[1], x.vector[0], offset)
        for k in range(self.dimensions):
            self.append_linear_row(x, UNIT[k], x.vector[0], x.vector[1], offset[k])

    cdef void append_orientation_rows(self, const arguments_t* x, const double* error) noexcept:
        """Append the rows that hold the relative orientation, with the errors of a rotation vector [rad]."""
        cdef int32_t k
        for k in range(2 if self.dimensions == 2 else 0, 3):
            self.append_angular_row(x, UNIT[k], UNIT[k], error[k])

    cdef bint compute_line(self, const arguments_t* x, double* direction, double* size) noexcept:
        """Compute unit vector and length of the line between both points; return whether they are given.

        If the points coincide, the vector is y in two dimensions and z in three.
        """
        cdef double[3] offset
        if not (x.given[0] and x.given[1]):
            return False
        subtract3(x.vector[1], x.vector[0], offset)
        size[0] = norm(offset)
        if size[0] > min_magnitude():
            scale3(1.0 / size[0], offset, direction)
        else:
            copy3(UNIT[1 if self.dimensions == 2 else 2], direction)
        return True

    cdef bint compute_rotation_axis(self, const arguments_t* x, int32_t which, double* out) noexcept:
        """Compute the unit vector of an axis of rotation, z in two dimensions; return whether the arguments are valid."""
        if self.dimensions == 2:
            copy3(UNIT[2], out)
            return not x.given[which] or self.reject(AXIS_GIVEN, which)
        if not x.given[which]:
            return self.reject(AXIS_MISSING, which)
        return self.normalise_argument(x, which, out)

    cdef row_t* append_motor_row(self, const arguments_t* x, bint is_linear) noexcept:
        """Append the row of a motor or limit, of travel at a point or of rotation; NULL for invalid arguments."""
        cdef double[3] direction
        if not is_linear:
            if x.given[1]:
                self.reject(ANCHOR_GIVEN)
                return NULL
            if not self.compute_rotation_axis(x, 0, direction):
                return NULL
            return self.append_angular_row(x, direction, direction, 0.0)
        if not (x.given[0] and x.given[1]):
            self.reject(AXIS_MISSING if x.given[1] else ANCHOR_MISSING)
            return NULL
        if not self.normalise_argument(x, 0, direction):
            return NULL
        return self.append_linear_row(x, direction, x.vector[1], x.vector[1], 0.0)

    cdef inline double compute_stop_velocity(self, double travel) noexcept:
        """Return the smallest velocity away from a limit [m/s or rad/s] if `travel` remains up to it (eq. 4)."""
        return (-travel if travel > 0.0 else -self.baumgarte * travel) / self.dt

    cdef bint append_joint_rows(self, int32_t kind, arguments_t* x) noexcept:
        """Append the rows of a joint; return whether its arguments are valid."""
        cdef double[3] first, second, error
        cdef double size, resistance, stiffness, damping, bound
        cdef double* number = x.number
        cdef row_t* row
        cdef int32_t k
        if kind in (BALL, HINGE, WELD, SLIDER):
            if not x.given[0]:
                return self.reject(NEEDS_CONVERSION)
            if not x.given[1]:
                copy3(x.vector[0], x.vector[1])
        if kind == BALL or kind == HINGE or kind == WELD:
            self.append_point_rows(x)
        if kind == HINGE:
            if not self.compute_rotation_axis(x, 2, first):
                return False
            if not x.given[3]:
                copy3(first, second)
            elif not self.compute_rotation_axis(x, 3, second):
                return False
            if self.dimensions == 3:
                cross(first, second, error)
                complete_frame(first, x.vector[2], x.vector[3])
                for k in range(2, 4):
                    self.append_angular_row(x, x.vector[k], x.vector[k], dot3(x.vector[k], error))
        elif kind == WELD:
            if not x.given[2]:
                return self.reject(NEEDS_CONVERSION)
            self.append_orientation_rows(x, x.vector[2])
        elif kind == SLIDER:
            if not (x.given[2] and x.given[3]):
                return self.reject(NEEDS_CONVERSION)
            if not self.normalise_argument(x, 2, x.vector[2]):
                return False
            subtract3(x.vector[1], x.vector[0], error)
            if self.dimensions == 2:
                cross(UNIT[2], x.vector[2], first)
            else:
                complete_frame(x.vector[2], first, second)
            # The line is fixed to a: use the velocity of the point of a that coincides with the point of b.
            self.append_linear_row(x, first, x.vector[1], x.vector[1], dot3(first, error))
            if self.dimensions == 3:
                self.append_linear_row(x, second, x.vector[1], x.vector[1], dot3(second, error))
            self.append_orientation_rows(x, x.vector[3])
        elif kind == DISTANCE:
            if not self.compute_line(x, first, &size) or number[0] < 0.0:
                return self.reject(NEEDS_CONVERSION)
            bound = size if isnan(number[0]) else number[0]
            if not bound > min_magnitude():                # A rod of length 0 has no direction.
                return self.reject(ROD)
            self.append_linear_row(x, first, x.vector[0], x.vector[1], size - bound)
        elif kind == SPRING:
            stiffness, damping = number[1], number[2]
            resistance = damping + self.dt * stiffness
            if not (self.compute_line(x, first, &size) and number[0] >= 0.0 and stiffness >= 0.0 and damping >= 0.0):
                return self.reject(NEEDS_CONVERSION)
            if not self.dt * resistance >= min_magnitude():
                return self.reject(NO_SPRING)
            row = self.append_linear_row(x, first, x.vector[0], x.vector[1], 0.0)
            row.target = -stiffness * (size - number[0]) / resistance
            row.compliance = 1.0 / (self.dt * resistance)
        elif kind == MOTOR:
            bound = number[2] if isnan(number[1]) else number[1]
            if isnan(number[1]) == isnan(number[2]):
                return self.reject(NO_BOUND)
            if isnan(number[0]) or not bound >= 0.0:
                return self.reject(NEEDS_CONVERSION)
            row = self.append_motor_row(x, isnan(number[1]))
            if row == NULL:
                return False
            row.target, row.lower, row.upper = number[0], -(self.dt * bound), self.dt * bound
        elif kind == LIMIT:
            if isnan(number[0]) or isnan(number[1]) or isnan(number[2]) or number[1] == INFINITY or number[2] == -INFINITY:
                return self.reject(NEEDS_CONVERSION)
            if number[1] > number[2] or (isinf(number[1]) and isinf(number[2])):
                return self.reject(NO_LIMITS)
            row = self.append_motor_row(x, x.given[1])
            if row == NULL:
                return False
            row.lower, row.target = 0.0, self.compute_stop_velocity(number[0] - number[1])
            if number[2] < INFINITY:
                if number[1] > -INFINITY:               # The row of the upper limit follows that of the lower.
                    row[1] = row[0]
                    row += 1
                    self.n_rows += 1
                for k in range(12):
                    row.jac[k] = -row.jac[k]
                row.target = self.compute_stop_velocity(number[2] - number[0])
        elif kind == GEAR:
            if not self.compute_rotation_axis(x, 0, first):
                return False
            if isnan(number[0]) or isnan(number[1]):
                return self.reject(NEEDS_CONVERSION)
            if number[0] == 0.0:
                return self.reject(NO_RATIO)
            if not x.given[1]:
                copy3(first, second)
            elif not self.compute_rotation_axis(x, 1, second):
                return False
            scale3(number[0], second, second)
            scale3(-1.0, first, first)
            self.append_angular_row(x, first, second, number[1])
        return True

    cdef double compute_normal_velocity(self, const contact_t* c, const double* velocity) noexcept:
        """Return the normal velocity of b relative to a at a contact [m/s] if the bodies move at `velocity` (n, 6)."""
        cdef double u = 0.0
        cdef double[3] moment
        if c.a >= 0:
            cross(c.frame[2], c.frame[0], moment)
            u -= dot3(velocity + 6 * c.a, c.frame[0]) + dot3(velocity + 6 * c.a + 3, moment)
        if c.b >= 0:
            cross(c.frame[3], c.frame[0], moment)
            u += dot3(velocity + 6 * c.b, c.frame[0]) + dot3(velocity + 6 * c.b + 3, moment)
        return u

    cdef bint append_contact(self, const arguments_t* x) noexcept:
        """Append a contact (eq. 5); return whether its arguments are valid."""
        cdef contact_t* c = self.contacts + self.n_contacts
        cdef double gap = x.number[0], restitution = x.number[2], threshold = x.number[3], bounce, size, depth
        cdef double[3] moment, other
        cdef double* normal = c.frame[0]
        if not (x.given[0] and x.given[1] and x.number[1] >= 0.0 and 0.0 <= restitution <= 1.0 and threshold >= 0.0
                and not isnan(gap)):
            return self.reject(NEEDS_CONVERSION)
        size = norm(x.vector[1])
        if not fabs(size - 1.0) <= NORMAL_LENGTH_TOLERANCE:
            return self.reject(BAD_NORMAL, 1)
        scale3(1.0 / size, x.vector[1], normal)
        c.a, c.b, c.mu = x.a, x.b, x.number[1]
        if self.dimensions == 2:
            if x.given[2]:
                return self.reject(TANGENT_GIVEN)
            cross(UNIT[2], normal, c.frame[1])
        elif x.given[2]:
            if not self.normalise_argument(x, 2, moment):
                return False
            scale3(dot3(moment, normal), normal, other)
            subtract3(moment, other, moment)
            if not norm(moment) >= NORMAL_LENGTH_TOLERANCE:
                return self.reject(PARALLEL)
            normalise(moment, c.frame[1])
        else:
            complete_frame(normal, c.frame[1], other)
        self.compute_arm(c.a, x.vector[0], c.frame[2])
        self.compute_arm(c.b, x.vector[0], c.frame[3])
        depth = -gap - self.slop
        c.target = (-gap if gap > 0.0 else self.baumgarte * (depth if depth > 0.0 else 0.0)) / self.dt
        # The contact bounces only if the bodies touch within the step.
        bounce = self.compute_normal_velocity(c, self.velocity_before) if restitution > 0.0 else 0.0
        if bounce < -threshold and (c.target >= 0.0 or self.compute_normal_velocity(c, self.velocity) < c.target):
            c.target = max(c.target, -restitution * bounce)
        return True

    # -- blocks --------------------------------------------------------------------------------------------------

    cdef int reserve(self, int32_t kind, int64_t n) except -1:
        """Allocate memory for n more blocks of a type."""
        if kind == CONTACT:
            return grow(<void**>&self.contacts, &self.contact_capacity, self.n_contacts + n, sizeof(contact_t))
        grow(<void**>&self.rows, &self.row_capacity, self.n_rows + MAX_ROWS * n, sizeof(row_t))
        return grow(<void**>&self.joints, &self.joint_capacity, self.n_joints + n, sizeof(joint_t))

    cdef object append_block(self, int32_t kind, arguments_t* x, int64_t feature):
        """Append a block and return its key; None for invalid arguments. A negative feature: the next one."""
        cdef uint64_t base, key
        cdef int32_t n_rows = self.n_rows
        self.reject(NEEDS_CONVERSION)
        if not (-1 <= x.a < self.n_bodies and -1 <= x.b < self.n_bodies) or x.a == x.b:
            return None
        base = <uint64_t>kind << 60 | <uint64_t>(x.a + 1) << 38 | <uint64_t>(x.b + 1) << 16
        if feature < 0:
            feature = self.next_feature.get(base, 0)
        key = base | <uint64_t>feature
        result = key
        if feature > MAX_FEATURE or result in self.keys:
            return None
        self.fault = NO_FAULT
        if not (self.append_contact(x) if kind == CONTACT else self.append_joint_rows(kind, x)):
            self.n_rows = n_rows
            return None
        if kind == CONTACT:
            self.contacts[self.n_contacts].key = key
            self.n_contacts += 1
        else:
            self.joints[self.n_joints] = joint_t(key, x.a, x.b, self.n_rows - n_rows)
            self.n_joints += 1
        self.keys.add(result)
        self.next_feature[base] = feature + 1
        return result

    def add(self, int32_t kind, a, b, feature, tuple values):
        """Append one block and return its key, or None for arguments that are invalid or need a conversion.

        `values` has the ARGUMENTS of the block's type; None: not given.
        """
        cdef arguments_t x
        self.reject(NEEDS_CONVERSION)
        cdef int32_t k, vectors = N_VECTORS[kind]
        cdef int64_t at = -1 if feature is None else read_body(feature, MAX_FEATURE + 1)
        x.a, x.b = <int32_t>read_body(a, self.n_bodies), <int32_t>read_body(b, self.n_bodies)
        if x.a == -2 or x.b == -2 or (feature is not None and at < 0):
            return None
        memset(x.vector, 0, sizeof(x.vector))
        for k in range(vectors):
            value = values[k]
            x.given[k] = value is not None
            if value is None:
                continue
            # In two dimensions, an orientation error is an angle about z; in three, a number is repeated.
            if kind == WELD and k == 2 or kind == SLIDER and k == 3:
                if self.dimensions == 2 or type(value) is float:
                    if not read_number(value, &x.vector[k][2]) or not is_valid_number(x.vector[k][2]):
                        return None
                    x.vector[k][0] = x.vector[k][1] = x.vector[k][2]
                elif not read_vector(value, 3, x.vector[k]):
                    return None
            elif not read_vector(value, self.dimensions, x.vector[k]):
                return None
        for k in range(N_NUMBERS[kind]):
            if not read_number(values[vectors + k], &x.number[k]):
                return None
            if not (is_valid_number(x.number[k]) or isnan(x.number[k]) or kind == LIMIT and k > 0 and isinf(x.number[k])):
                return None
        self.reserve(kind, 1)
        return self.append_block(kind, &x, at)

    def add_many(self, int32_t kind, pairs, features, tuple values, uint64_t[::1] keys):
        """Append n blocks and write their keys; return -1, or the first invalid block, and then append none.

        `pairs` is (n, 2) int32, `features` (n,) int32 or None. `values` are arrays (n, dimensions) of the vectors, with the
        orientation errors (n, 3), and (n,) of the numbers, or None. All numbers of vectors are valid.
        """
        cdef arguments_t x
        cdef const double* data[MAX_VECTORS + MAX_NUMBERS]
        cdef int32_t k, j, width, vectors = N_VECTORS[kind], total = vectors + N_NUMBERS[kind]
        cdef int32_t n = <int32_t>len(pairs), i
        cdef int32_t n_rows = self.n_rows, n_joints = self.n_joints, n_contacts = self.n_contacts
        cdef const int32_t* bodies = as_int_pointer(pairs, 2 * n)
        cdef const int32_t* numbers = NULL if features is None else as_int_pointer(features, n)
        cdef int32_t[MAX_VECTORS] widths
        for k in range(total):
            if values[k] is None:
                data[k] = NULL
                continue
            width = 1 if k >= vectors else 3 if kind == WELD and k == 2 or kind == SLIDER and k == 3 else self.dimensions
            data[k] = as_double_pointer(values[k], width * n)
            if k < vectors:
                widths[k] = width
        before = self.next_feature.copy()
        self.reserve(kind, n)
        for i in range(n):
            x.a, x.b = bodies[2 * i], bodies[2 * i + 1]
            memset(x.vector, 0, sizeof(x.vector))
            for k in range(vectors):
                x.given[k] = data[k] != NULL
                if x.given[k]:
                    for j in range(widths[k]):
                        x.vector[k][j] = data[k][widths[k] * i + j]
            for k in range(vectors, total):
                x.number[k - vectors] = NAN if data[k] == NULL else data[k][i]
            key = None if numbers != NULL and numbers[i] < 0 else self.append_block(kind, &x, -1 if numbers == NULL else numbers[i])
            if key is None:
                self.n_rows, self.n_joints, self.n_contacts = n_rows, n_joints, n_contacts
                self.next_feature = before
                for j in range(i):
                    self.keys.discard(keys[j])
                return i
            keys[i] = key
        return -1

    # -- results -------------------------------------------------------------------------------------------------

    def export(self, bint is_box):
        """Return blocks, rows, b (m,) [m/s], compliance (m,) [1/kg] and keys (k,) of the problem, joints before contacts.

        The blocks may have a fault; `rows` are the arguments of `lavender.Rows` that describe joints and contacts. Contacts with
        mu = 0 have a normal row only. `is_box`: two tangents have bounds of their own.
        """
        cdef int32_t kj = self.n_joints, c = self.n_contacts, mj = self.n_rows, tangents = self.dimensions - 1, m = mj, i, k, at
        cdef bint is_square
        cdef contact_t* contact
        for i in range(c):
            m += 1 + tangents if self.contacts[i].mu > 0.0 else 1
        cdef Blocks blocks = allocate_blocks(kj + c, m)
        cdef blocks_t* p = &blocks.at
        names, frames = ("jac", "normal", "tangent", "arm_a", "arm_b"), [np.empty((mj, 12)), *[np.empty((c, 3)) for _ in range(4)]]
        rhs, softness, velocity, identity = np.empty(m), np.zeros(m), np.zeros(m + 1), np.empty(kj + c, np.uint64)
        starts, bodies, pairs = np.empty(kj + 1, np.int32), np.empty((kj, 2), np.int32), np.empty((c, 2), np.int32)
        cdef double[::1] b = rhs, compliance = softness, jv = velocity
        cdef uint64_t[::1] keys = identity
        cdef int32_t[::1] joint_ptr = starts
        cdef int32_t* joint_body = as_int_pointer(bodies, 2 * kj)
        cdef int32_t* contact_body = as_int_pointer(pairs, 2 * c)
        cdef double* jac = as_double_pointer(frames[0], 12 * mj)
        cdef double* vectors[4]
        for k in range(4):
            vectors[k] = as_double_pointer(frames[k + 1], 3 * c)
        # joints
        memset(<void*>p.mu, 0, 3 * (kj + c) * sizeof(double))
        (<int32_t*>p.ptr)[0] = joint_ptr[0] = 0
        for i in range(kj):
            keys[i], joint_body[2 * i], joint_body[2 * i + 1] = self.joints[i].key, self.joints[i].a, self.joints[i].b
            (<int32_t*>p.kind)[i] = ROW
            (<int32_t*>p.ptr)[i + 1] = joint_ptr[i + 1] = joint_ptr[i] + self.joints[i].n_rows
        for i in range(mj):
            memcpy(jac + 12 * i, self.rows[i].jac, 12 * sizeof(double))
            b[i], compliance[i] = self.rows[i].target, self.rows[i].compliance
            (<double*>p.lower)[i], (<double*>p.upper)[i] = self.rows[i].lower, self.rows[i].upper
        # contacts
        at = mj
        for i in range(c):
            contact = self.contacts + i
            keys[kj + i], contact_body[2 * i], contact_body[2 * i + 1] = contact.key, contact.a, contact.b
            for k in range(4):
                copy3(contact.frame[k], vectors[k] + 3 * i)
            is_square = is_box and tangents == 2 and contact.mu > 0.0
            (<int32_t*>p.kind)[kj + i] = CONTACT_BOX if is_square else CONTACT_BLOCK
            (<double*>p.mu)[kj + i], (<double*>p.patch_radius)[kj + i] = contact.mu, 1.0 if is_square else 0.0
            b[at] = contact.target
            for k in range(tangents if contact.mu > 0.0 else 0):
                b[at + 1 + k] = 0.0
            at += 1 + tangents if contact.mu > 0.0 else 1
            (<int32_t*>p.ptr)[kj + i + 1] = at
        write_contact_bounds(p)
        blocks.validate()
        # b = target - J v*
        cdef rows_t r = rows_t(n_bodies=self.n_bodies, n_joints=kj, n_contacts=c, jac=jac, joint_body=joint_body, normal=vectors[0],
                               tangent=vectors[1], arm_a=vectors[2], arm_b=vectors[3], contact_body=contact_body)
        multiply_jacobian(p, &r, self.velocity, &jv[0])
        for i in range(m):
            b[i] -= jv[i]
        rows = dict(zip(names, frames), joint_ptr=starts, joint_body=bodies, contact_body=pairs)
        return blocks, rows, rhs, softness, identity

    def find_rows(self, uint64_t key):
        """Return (first row, number of rows) of a block in the problem, or None if no block has the key."""
        cdef int32_t i, size, start = 0
        for i in range(self.n_joints):
            if self.joints[i].key == key:
                return start, self.joints[i].n_rows
            start += self.joints[i].n_rows
        for i in range(self.n_contacts):
            size = self.dimensions if self.contacts[i].mu > 0.0 else 1
            if self.contacts[i].key == key:
                return start, size
            start += size
        return None
