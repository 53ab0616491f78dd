"""Reading of MuJoCo's constraint rows: blocks, bounds, keys, J, M, consistency checks and copies, in one pass each.

Arrays have MuJoCo's layout: efc_type, efc_id (m), contact dim (c), friction (c, 5), geom (c, 2). The
tangent rows of a contact with different coefficients f are scaled by f_j / f_0, so that mu = f_0 bounds them all:

    |(lambda_1 / f_0, ..., lambda_n / f_n)| <= lambda_n   <=>   |lambda'| <= f_0 lambda_n,   lambda'_j = lambda_j f_0 / f_j   (1)

The rotation rows of a weld are torquescale / 2 times an angular velocity; scaled by 2 / torquescale, their unit is rad/s.
"""
from libc.math cimport INFINITY, fabs, sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memcmp, memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer, make_read_only, ndarray
from lavender_ext.core.blocks cimport Blocks, allocate_blocks
from lavender_ext.core.validate cimport all_finite, is_valid_magnitude, is_valid_number, min_magnitude, update_max_abs
from lavender_ext.core.block_types cimport ROW, blocks_t, choose_contact_kind, write_contact_bounds

ctypedef const double* doubles
ctypedef const int32_t* ints
#: Arrays of MjData in the order of `step_t`. Arrays after the first 8 belong to one forward pass.
ARRAYS = tuple((
    "qvel qacc qacc_smooth qfrc_smooth qfrc_constraint M cdof cvel efc_J efc_D efc_R efc_aref efc_force efc_vel efc_b "
    "efc_frictionloss efc_type efc_id efc_J_rownnz efc_J_rowadr efc_J_colind contact").split())


cpdef enum:
    # An equality constraint of at most this many rows is one block. In a larger one, such as a flex, each row is a block,
    # because one block would couple every vertex. It is also the largest condim.
    MAX_BLOCK_ROWS = 6

cdef enum:
    # Values of mjtConstraint.
    EQUALITY, JOINT_FRICTION, TENDON_FRICTION, JOINT_LIMIT, TENDON_LIMIT, FRICTIONLESS, PYRAMIDAL, ELLIPTIC, TYPES
    # [bytes] Lower bounds of the memory that MuJoCo allocates for a row, a contact, and an entry of efc_J with its column.
    ROW_BYTES = 128
    CONTACT_BYTES = 512
    ENTRY_BYTES = 12
    FIRST_ROW_ARRAY = 8                                 # Each row has entries in the arrays from efc_J to efc_id.
    END_ROW_ARRAY = 18
    N_ARRAYS = 22
    WELD = 1                                            # value of mjtEq
    TORQUE_SCALE = 10                                   # index in eq_data of a weld

cdef object new = np.empty, I4 = np.dtype(np.int32), ALIGNED_OFFSETS = 8 * np.arange(N_ARRAYS)


ctypedef struct step_t:
    doubles qvel, qacc, qacc_smooth, qfrc_smooth, qfrc_constraint, M, cdof, cvel
    doubles efc_J, efc_D, efc_R, efc_aref, efc_force, efc_vel, efc_b, efc_frictionloss
    ints efc_type, efc_id, efc_J_rownnz, efc_J_rowadr, efc_J_colind
    const char* contact
    Py_ssize_t dim, geom, friction, stride              # [bytes] offsets in a contact, and its size
    ints M_rowadr, M_rownnz, M_colind, dof_bodyid, body_parentid, eq_type
    doubles eq_data
    int32_t eq_size                                     # numbers of eq_data of each equality
    int32_t m, contacts, n, mass_entries, bodies        # numbers of rows, contacts, velocities, entries of M, and bodies
    int64_t jac_entries
    double dt                                           # [s] time step


cdef class Step:
    """Addresses of the arrays of an MjData and its model, at the last `read`.

    The model is kept alive; the caller keeps the MjData alive, whose arrays fit the model. `cache` has `mj`, the module mujoco;
    `offsets`, the offset of each of ARRAYS in the struct mjData [bytes], or None; and `contact_layout`, the offsets of dim, geom
    and friction in a contact and its size. `list_addresses` returns the addresses of ARRAYS (22,) if there are no offsets.
    """
    cdef step_t at
    cdef object options, offsets, list_addresses
    cdef const char* struct
    cdef int32_t[TYPES] type_limits                     # number of objects that rows of each type may refer to
    cdef readonly object model, cache
    cdef readonly int32_t m, n                          # numbers of rows and of velocities
    cdef readonly double dt                             # [s] time step
    cdef readonly bint is_sparse, is_discrete           # efc_J is in compressed rows; the last pass used another matrix than M
    cdef readonly bint has_noslip, has_mass             # MuJoCo changes its answer by noslip iterations; M was computed

    def __init__(self, model, data, cache, list_addresses):
        cdef step_t* p = &self.at
        self.model, self.cache, self.options, self.list_addresses = model, cache, model.opt, list_addresses
        self.offsets, self.struct = cache.offsets, <char*><size_t>data._address
        self.n = p.n = model.nv
        p.mass_entries, p.bodies = len(model.M_colind), model.nbody
        p.dim, p.geom, p.friction, p.stride = cache.contact_layout
        for i, (name, size) in enumerate((("M_rowadr", p.n), ("M_rownnz", p.n), ("M_colind", p.mass_entries),
                                          ("dof_bodyid", p.n), ("body_parentid", p.bodies), ("eq_type", model.neq))):
            (<int32_t**>&p.M_rowadr)[i] = as_int_pointer(getattr(model, name), size)
        p.eq_size = model.eq_data.shape[1]
        p.eq_data = as_double_pointer(model.eq_data.reshape(-1), model.neq * p.eq_size)
        for i, size in enumerate((model.neq, p.n, model.ntendon, model.njnt, model.ntendon)):
            self.type_limits[i] = size

    def read(self, data):
        """Read counts, options and addresses again; return whether the arrays fit into the memory of the MjData."""
        cdef step_t* p = &self.at
        cdef int64_t m = data.nefc, contacts = data.ncon, entries = data.nJ
        cdef const char* struct = self.struct
        cdef object offsets = self.offsets, addresses
        if min(m, contacts, entries) < 0 or m * ROW_BYTES + contacts * CONTACT_BYTES + entries * ENTRY_BYTES > data.parena:
            return False
        self.m, p.m, p.contacts, p.jac_entries = <int32_t>m, <int32_t>m, <int32_t>contacts, entries
        self.dt = p.dt = self.options.timestep
        self.is_discrete, self.has_noslip = getattr(data, "efm_active", 0) != 0, self.options.noslip_iterations > 0
        self.is_sparse = self.cache.mj.mj_isSparse(self.model)
        for i in range(FRICTIONLESS, TYPES):
            self.type_limits[i] = p.contacts
        if offsets is None:
            addresses = self.list_addresses(data)
            struct, offsets = (<ndarray>addresses).data, ALIGNED_OFFSETS
        for i in range(N_ARRAYS):
            (<void**>p)[i] = (<void**>(struct + (<int64_t*>(<ndarray>offsets).data)[i]))[0]
            if m and FIRST_ROW_ARRAY <= i < END_ROW_ARRAY and (<void**>p)[i] == NULL:
                return False
        self.has_mass = p.n == 0 or p.M[0] != 0.0
        return not contacts or p.contact != NULL


def make_blocks(Step step, int32_t max_equality_rows):
    """Return the blocks, or the number of a row with an unknown type or an invalid id.

    Each row of an equality with more than `max_equality_rows` is a block. If this is 1, contacts without friction are rows, too.
    The blocks have a fault if a bound is not a valid number. Their `ints` hold type, id, dim and geom from index 2 m + 1, their
    `numbers` the factor of each row from index 5 m, and the last m numbers the keys as uint64.
    """
    cdef const step_t* s = &step.at
    cdef int32_t i = 0, j, k = 0, of, size, count, type_, m = s.m, c = s.contacts
    cdef Blocks blocks = allocate_blocks(m, m, 2 * m + 3 * c, 2 * m)
    cdef blocks_t* p = &blocks.at
    cdef int32_t* kind = <int32_t*>p.kind
    cdef int32_t* copied = kind + m
    cdef const int32_t* geom = copied + 2 * m + c
    cdef double* lower = <double*>p.lower
    cdef double* scale = <double*>p.rolling + m
    cdef uint64_t* key = <uint64_t*>(scale + m)
    cdef double low, high, mu, angle_factor
    cdef uint64_t first_key
    cdef const double* friction
    memcpy(copied, s.efc_type, m * sizeof(int32_t))
    memcpy(copied + m, s.efc_id, m * sizeof(int32_t))
    for j in range(c):
        memcpy(&copied[2 * m + j], s.contact + j * s.stride + s.dim, sizeof(int32_t))
        memcpy(&copied[2 * m + c + 2 * j], s.contact + j * s.stride + s.geom, 2 * sizeof(int32_t))
    memset(<double*>p.patch_radius, 0, 2 * m * sizeof(double))
    (<int32_t*>p.ptr)[0] = 0
    while i < m:
        of, type_ = s.efc_id[i], s.efc_type[i]
        if not 0 <= type_ < TYPES or not 0 <= of < step.type_limits[type_]:
            return i
        # The constraint has `count` blocks of `size` rows each.
        size, count, low, high, mu, friction = 1, 1, 0.0, INFINITY, 0.0, NULL
        kind[k], first_key = ROW, (<uint64_t>(type_ + 1) << 56) | (<uint64_t>of << 32)
        if type_ == EQUALITY:
            low = -INFINITY
            while i + size < m and s.efc_type[i + size] == type_ and s.efc_id[i + size] == of:
                size += 1
            if size > max_equality_rows:
                size, count = 1, size
        elif type_ <= TENDON_FRICTION:
            low, high = -s.dt * s.efc_frictionloss[i], s.dt * s.efc_frictionloss[i]
        elif type_ <= TENDON_LIMIT:
            if k > 0 and (key[k - 1] | 0xFFFF) == (first_key | 0xFFFF):
                first_key = key[k - 1] + 1              # This is the second limit of the joint.
        else:
            j = of
            while j > 0 and not memcmp(geom + 2 * of, geom + 2 * (j - 1), 2 * sizeof(int32_t)):
                j -= 1                                  # Contacts of two geoms are numbered in their order.
            first_key = ((<uint64_t>1 << 63) | (<uint64_t>((geom[2 * of] + 1) & 0xFFFFF) << 40)
                         | (<uint64_t>((geom[2 * of + 1] + 1) & 0xFFFFF) << 20) | (<uint64_t>((of - j) & 0xFFFF) << 4))
            size = 1 if type_ == FRICTIONLESS else copied[2 * m + of]
            if type_ != FRICTIONLESS and not 1 < size <= MAX_BLOCK_ROWS:
                return i
            if type_ == PYRAMIDAL:
                size, count = 1, 2 * (size - 1)         # one row per edge of the pyramid
            elif size > 1 or max_equality_rows > 1:
                kind[k] = choose_contact_kind(False, False, False, size - 1)
            if type_ == ELLIPTIC:
                friction = <doubles>(s.contact + of * s.stride + s.friction)
                mu = friction[0]
        if i + count * size > m:
            return i
        angle_factor = 1.0                              # of the rotation rows of a weld
        if type_ == EQUALITY and s.eq_type[of] == WELD and s.eq_data[of * s.eq_size + TORQUE_SCALE] > 0.0:
            angle_factor = 2.0 / s.eq_data[of * s.eq_size + TORQUE_SCALE]
        for j in range(count * size):
            lower[i + j], (<double*>p.upper)[i + j], scale[i + j] = low, high, angle_factor if j >= 3 else 1.0
            if friction != NULL and j > 0:
                lower[i + j], scale[i + j] = -INFINITY, friction[j - 1] / mu if mu > 0.0 else 0.0
        for j in range(count):
            kind[k], (<double*>p.mu)[k], key[k] = kind[k] if j == 0 else ROW, mu, first_key + j
            i, k = i + size, k + 1
            (<int32_t*>p.ptr)[k] = i
    p.n_blocks = k
    blocks.validate()
    write_contact_bounds(p)
    return blocks


cdef inline double* get_row_scales(Blocks blocks) noexcept:
    """Return the factor of each row (m)."""
    return <double*>blocks.at.rolling + blocks.at.n_rows


def read_jacobian(Step step, Blocks blocks):
    """Return (indptr, indices, data) of J, with scaled rows unless `blocks` is None; a row's number if its indices are invalid.

    The result is None if columns do not ascend, and -1 if efc_J has fewer entries than a dense J.
    """
    cdef const step_t* s = &step.at
    cdef bint is_sparse = step.is_sparse, ascend = True
    cdef int32_t i, j, last, column, count = s.n
    cdef int64_t first, end = 0, total = s.jac_entries if is_sparse else <int64_t>s.m * s.n
    cdef double x, factor
    cdef double* scale = NULL if blocks is None else get_row_scales(blocks)
    if total > s.jac_entries or is_sparse and s.m and (
            s.efc_J_rownnz == NULL or s.efc_J_rowadr == NULL or s.efc_J_colind == NULL):
        return -1
    indptr_, indices_, data_ = new(s.m + 1, I4), new(total, I4), new(total)
    cdef int32_t* indptr = <int32_t*>(<ndarray>indptr_).data
    cdef int32_t* indices = <int32_t*>(<ndarray>indices_).data
    cdef double* data = <double*>(<ndarray>data_).data
    indptr[0] = 0
    for i in range(s.m):
        factor = 1.0 if scale == NULL else scale[i]
        first, last = <int64_t>i * s.n, -1
        if is_sparse:
            count, first = s.efc_J_rownnz[i], s.efc_J_rowadr[i]
            if not 0 <= count <= total - end or not 0 <= first <= total - count:
                return i
        for j in range(count):
            column = s.efc_J_colind[first + j] if is_sparse else j
            if not 0 <= column < s.n:
                return i
            ascend &= last < column
            last = column
            x = s.efc_J[first + j] * factor
            if x != 0.0:
                indices[end], data[end] = column, x
                end += 1
        indptr[i + 1] = <int32_t>end
    if not ascend:
        return None
    if end < total:
        indices_, data_ = indices_[:end].copy(), data_[:end].copy()
    return make_read_only(indptr_), make_read_only(indices_), make_read_only(data_)


def has_mass_pattern(Step step, tuple pattern):
    """Return whether (indptr, indices) is the pattern of the lower triangle of MuJoCo's M."""
    cdef const step_t* p = &step.at
    cdef const int32_t* at = <int32_t*>(<ndarray>pattern[0]).data
    cdef int32_t i
    if (len(pattern[0]) != p.n + 1 or len(pattern[1]) != p.mass_entries or at[p.n] != p.mass_entries
            or memcmp(at, p.M_rowadr, p.n * sizeof(int32_t))
            or memcmp((<ndarray>pattern[1]).data, p.M_colind, p.mass_entries * sizeof(int32_t))):
        return False
    for i in range(p.n):
        if p.M_rownnz[i] != at[i + 1] - at[i]:
            return False
    return True


def copy_mass(Step step, tuple pattern):
    """Return the entries of the lower triangle of M, and max |M x - y| / max |y| with x = qacc_smooth, y = qfrc_smooth."""
    cdef const step_t* p = &step.at
    cdef const int32_t* at = <int32_t*>(<ndarray>pattern[0]).data
    cdef int32_t i, q, end
    cdef double row, x, gap = 0.0, size = 0.0
    values, product_ = new(p.mass_entries), new(p.n)
    cdef double* product = <double*>(<ndarray>product_).data
    memcpy(<double*>(<ndarray>values).data, p.M, p.mass_entries * sizeof(double))
    for i in range(p.n):
        row, x, end = 0.0, p.qacc_smooth[i], at[i + 1] - 1
        for q in range(at[i], end):
            row += p.M[q] * p.qacc_smooth[p.M_colind[q]]
            product[p.M_colind[q]] += p.M[q] * x
        product[i] = row + p.M[end] * x
    for i in range(p.n):
        gap = update_max_abs(gap, product[i] - p.qfrc_smooth[i])
        size = update_max_abs(size, p.qfrc_smooth[i])
    return make_read_only(values), gap / size if size > 0.0 else gap


cdef int32_t compare_spatial_velocities(const step_t* p, const double* v, double tolerance) noexcept:
    """Return whether v (nv) gives the spatial velocities c (n, 6) of the bodies; -1 if the arrays do not describe a tree.

        c_i = c_parent(i) + sum over the velocities j of body i of s_j v_j,   s = cdof (nv, 6), c = cvel

    `tolerance` is the largest accepted difference relative to the largest term. Every v agrees with an s of zeros, as in a copy
    that does not fill it.
    """
    cdef Py_ssize_t i, k, q, j = 0, end
    cdef double term, rest, gap = 0.0, size = 0.0
    cdef bint is_filled = False
    for i in range(1, p.bodies):
        if not 0 <= p.body_parentid[i] < p.bodies:
            return -1
        end = j
        while end < p.n and p.dof_bodyid[end] == i:     # The velocities of a body are consecutive.
            end += 1
        for k in range(6):
            rest = p.cvel[6 * p.body_parentid[i] + k] - p.cvel[6 * i + k]
            size = update_max_abs(size, p.cvel[6 * i + k])
            for q in range(j, end):
                term = p.cdof[6 * q + k] * v[q]
                rest += term
                size = update_max_abs(size, term)
                is_filled |= fabs(p.cdof[6 * q + k]) > 0.0
            gap = update_max_abs(gap, rest)
        j = end
    return -1 if j < p.n else gap <= tolerance * size or not is_filled


cdef inline double dot6(const double* x, const double* y) noexcept nogil:
    """Return x.y of 6 numbers each."""
    cdef Py_ssize_t k
    cdef double total = 0.0
    for k in range(6):
        total += x[k] * y[k]
    return total


cdef object recover_joint_velocity(const step_t* p, double alike):
    """Recover v (nv) from the spatial velocities of `compare_spatial_velocities`; None if s does not determine it.

    Least squares are solved body by body with modified Gram-Schmidt. `alike` is the minimum fraction of an axis s_j that must
    be independent of the other axes of its body.
    """
    cdef Py_ssize_t i, j = 0, k, r, count
    cdef double[6][6] q, upper
    cdef double[6] residual, x
    cdef const int32_t* body = p.dof_bodyid
    velocities = new(p.n)
    cdef double* v = <double*>(<ndarray>velocities).data
    while j < p.n:
        count = 0
        for k in range(6):
            residual[k] = p.cvel[6 * body[j] + k] - p.cvel[6 * p.body_parentid[body[j]] + k]
        while j + count < p.n and body[j + count] == body[j]:
            if count == 6:
                return None
            # Subtract the components along earlier axes, and normalise the rest.
            i, count = count, count + 1
            memcpy(q[i], p.cdof + 6 * (j + i), 6 * sizeof(double))
            for r in range(i):
                upper[r][i] = dot6(q[r], q[i])
                for k in range(6):
                    q[i][k] -= upper[r][i] * q[r][k]
            upper[i][i] = dot6(q[i], q[i])
            if not upper[i][i] > dot6(p.cdof + 6 * (j + i), p.cdof + 6 * (j + i)) * (alike * alike):
                return None
            upper[i][i] = sqrt(upper[i][i])
            for k in range(6):
                q[i][k] /= upper[i][i]
            x[i] = dot6(q[i], residual)
            for k in range(6):
                residual[k] -= x[i] * q[i][k]
        for i in range(count - 1, -1, -1):
            for r in range(i + 1, count):
                x[i] -= upper[i][r] * x[r]
            x[i] /= upper[i][i]
            v[j + i] = x[i]
        j += count
    return velocities


def find_velocity_before(Step step, double tolerance, double alike):
    """Return the velocity (nv,) of the last forward pass; None if it is qvel.

    After a step it is recovered from the velocities of bodies before the step; -2 if that fails, -1 if their tree is invalid.
    """
    cdef const step_t* p = &step.at
    cdef int64_t i
    cdef bint is_set = False, is_finite = True
    cdef int32_t agrees = compare_spatial_velocities(p, p.qvel, tolerance)
    if agrees:
        return None if agrees > 0 else -1
    for i in range(6 * p.bodies):                       # In a copy of the data, cvel may be unset.
        is_set |= p.cvel[i] != 0.0
    for i in range(0 if is_set else p.m):
        if p.efc_vel[i] != 0.0:
            return None
    for i in range(p.n):
        is_finite &= is_valid_number(p.qvel[i])
    v = recover_joint_velocity(p, alike) if is_finite else None
    if v is None or compare_spatial_velocities(p, as_double_pointer(v, p.n), tolerance) != 1:
        return -2
    return v


cdef ndarray copy_array(const double* x, Py_ssize_t n):
    cdef ndarray out = new(n)
    memcpy(out.data, x, n * sizeof(double))
    return out


def compute_problem_numbers(Step step, Blocks blocks, tuple jac, v_, double tolerance, double compliance_tolerance, double usual):
    """Return (b, compliance, v*, is_regular, max |efc_R efc_D - 1|, gaps, least compliance) of J with scaled rows.

        b = dt (aref - J a0),   v* = v + dt a0,   a0 = qacc_smooth

    A b with all entries below 1e-60 m/s counts as 0, as of bodies that friction has brought to rest.
    `is_regular`: all numbers are valid, no gap exceeds its tolerance, and compliances are at most `usual`. The gaps are errors of
    J v = efc_vel with v before the step (None: qvel), J a0 - aref = efc_b and J^T efc_force = qfrc_constraint, divided by the
    sizes of the terms. They are 0 if the stored vector is 0, as in a copy. The fourth gap is NaN if an acceleration is not finite.
    """
    cdef const step_t* p = &step.at
    cdef int32_t i, j, q, m = p.m, n = p.n
    cdef const int32_t* jptr = as_int_pointer(jac[0], m + 1)
    cdef const int32_t* jidx = as_int_pointer(jac[1], jptr[m])
    cdef const double* jval = as_double_pointer(jac[2], jptr[m])
    cdef const double* scale = get_row_scales(blocks)
    cdef const double* v = p.qvel if v_ is None else as_double_pointer(v_, n)
    b_, compliance_, free_, scratch_ = new(m), new(m), new(n), new(3 * n)
    cdef double* b = <double*>(<ndarray>b_).data
    cdef double* compliance = <double*>(<ndarray>compliance_).data
    cdef double* free = <double*>(<ndarray>free_).data
    cdef double* force = <double*>(<ndarray>scratch_).data  # J^T f, then |J|^T |f| and dt a0
    cdef double* force_size = force + n
    cdef double* change = force + 2 * n
    cdef double dt = p.dt, x, size, row_v, row_change, f
    cdef double finite = 0.0, compliance_gap = 0.0, max_b = 0.0, max_v = 0.0, max_change = 0.0, least = INFINITY
    cdef double[3] gap = [0.0, 0.0, 0.0], terms = [0.0, 0.0, 0.0], stored = [0.0, 0.0, 0.0]
    cdef bint is_regular = True
    for j in range(n):
        change[j], force[j], force_size[j] = dt * p.qacc_smooth[j], 0.0, 0.0
        free[j] = v[j] + change[j]
        is_regular &= is_valid_number(free[j])
        max_v, max_change = update_max_abs(max_v, v[j]), update_max_abs(max_change, change[j])
        finite += 0.0 * p.qacc[j]
    for i in range(m):
        size = row_v = row_change = 0.0
        f = p.efc_force[i] / scale[i] if scale[i] != 0.0 else 0.0
        for q in range(jptr[i], jptr[i + 1]):
            j, x = jidx[q], jval[q]
            row_v += x * v[j]
            row_change += x * change[j]
            size += fabs(x)
            force[j] += x * f
            force_size[j] += fabs(x * f)
        b[i] = dt * scale[i] * p.efc_aref[i] - row_change
        compliance[i] = p.efc_R[i] * scale[i] * scale[i]
        least = min(least, compliance[i])
        max_b = update_max_abs(max_b, b[i])
        is_regular &= is_valid_magnitude(compliance[i]) and compliance[i] <= usual
        compliance_gap = update_max_abs(compliance_gap, p.efc_R[i] * p.efc_D[i] - 1.0)
        x = scale[i] * p.efc_vel[i]
        gap[0], stored[0] = update_max_abs(gap[0], row_v - x), update_max_abs(stored[0], p.efc_vel[i])
        terms[0] = update_max_abs(terms[0], size * max_v + fabs(x))
        x = scale[i] * dt * p.efc_b[i]
        gap[1], stored[1] = update_max_abs(gap[1], b[i] + x), update_max_abs(stored[1], p.efc_b[i])
        terms[1] = update_max_abs(terms[1], size * max_change + fabs(b[i]) + fabs(x))
    if 0.0 < max_b < min_magnitude():                   # The bodies are at rest: a problem refuses such a b.
        memset(b, 0, m * sizeof(double))
        max_b = 0.0
    for j in range(n):
        x = p.qfrc_constraint[j]
        gap[2], stored[2] = update_max_abs(gap[2], force[j] - x), update_max_abs(stored[2], x)
        terms[2] = update_max_abs(terms[2], force_size[j] + fabs(x))
    if getattr(step.model, "flg_surfacevel", 0):        # efc_vel contains the velocities of surfaces, too.
        stored[0] = 0.0
    for j in range(3):
        gap[j] = gap[j] / terms[j] if stored[j] != 0.0 and terms[j] != 0.0 else 0.0
        is_regular &= gap[j] <= tolerance
    is_regular &= compliance_gap <= compliance_tolerance and finite == 0.0 and is_valid_magnitude(max_b)
    return (make_read_only(b_), make_read_only(compliance_), make_read_only(free_), is_regular, compliance_gap,
            (gap[0], gap[1], gap[2], finite), least)


def copy_answer(Step step):
    """Return copies of efc_force (m,), and of qacc, qacc_smooth and qvel (nv,)."""
    return (copy_array(step.at.efc_force, step.m), copy_array(step.at.qacc, step.n), copy_array(step.at.qacc_smooth, step.n),
            copy_array(step.at.qvel, step.n))


def copy_rows(Step step, Blocks blocks):
    """Return J (m, nv) with scaled rows; (m, 5) efc_D, efc_aref, efc_force, efc_vel, factor of the row; the number of contacts."""
    cdef const step_t* p = &step.at
    cdef int32_t i, k, count, m = p.m, n = p.n, contacts = 0
    cdef int64_t first
    jac_, numbers_ = (np.zeros if step.is_sparse else new)((m, n)), new((m, 5))
    cdef double* jac = <double*>(<ndarray>jac_).data
    cdef double* numbers = <double*>(<ndarray>numbers_).data
    cdef const double** columns = [p.efc_D, p.efc_aref, p.efc_force, p.efc_vel, get_row_scales(blocks)]
    for i in range(m):
        for k in range(5):
            numbers[5 * i + k] = columns[k][i]
        contacts += p.efc_type[i] >= FRICTIONLESS and (i == 0 or p.efc_id[i] != p.efc_id[i - 1] or p.efc_type[i - 1] < FRICTIONLESS)
        count = p.efc_J_rownnz[i] if step.is_sparse else n
        first = p.efc_J_rowadr[i] if step.is_sparse else <int64_t>i * n
        for k in range(count):
            jac[<int64_t>i * n + (p.efc_J_colind[first + k] if step.is_sparse else k)] = p.efc_J[first + k] * columns[4][i]
    return jac_, numbers_, contacts


def copy_state(Step step, Py_ssize_t i, moves, mass):
    """Write qvel, qacc_smooth, qacc and dt qfrc_constraint to moves[i] (4, n), and M to mass[i]; return whether qacc is finite."""
    cdef const step_t* p = &step.at
    cdef double* to = <double*>(<ndarray>moves).data + 4 * i * p.n
    cdef const double** sources = [p.qvel, p.qacc_smooth, p.qacc]
    cdef int32_t k
    for k in range(3):
        memcpy(to + k * p.n, sources[k], p.n * sizeof(double))
    for k in range(p.n):
        to[3 * p.n + k] = p.dt * p.qfrc_constraint[k]
    memcpy(<double*>(<ndarray>mass).data + i * p.mass_entries, p.M, p.mass_entries * sizeof(double))
    return all_finite(p.qacc, p.n)


def join_worlds(list worlds, moves, double dt):
    """Join worlds: rows as (J, numbers, number of contacts, blocks), or None for a world without; `moves` as in `copy_state`.

    Returns J (m, n); targets, compliances and impulses (3, m) in the units of a problem; v* (worlds, n); velocity changes by
    the constraints (worlds, n); first rows and first blocks of the worlds, with their ends; numbers of contacts.
    """
    cdef Py_ssize_t count = len(worlds), n = moves.shape[2], i, k, m = 0
    places_, contacts_ = np.zeros((2, count + 1), np.int64), np.zeros(count, np.int64)
    free_, change_ = new((count, n)), new((count, n))
    cdef int64_t[:, ::1] places = places_
    cdef int64_t[::1] contacts = contacts_
    cdef const double* x = <double*>(<ndarray>moves).data
    cdef double* free = <double*>(<ndarray>free_).data
    cdef double* change = <double*>(<ndarray>change_).data
    cdef double* jac
    cdef double* numbers
    for i in range(count):
        for k in range(n):
            free[i * n + k], change[i * n + k] = x[k] + dt * x[n + k], dt * (x[2 * n + k] - x[n + k])
        x += 4 * n
        places[0, i + 1], places[1, i + 1] = places[0, i], places[1, i]
        if worlds[i] is not None:
            places[0, i + 1] += (<Blocks>worlds[i][3]).at.n_rows
            places[1, i + 1] += (<Blocks>worlds[i][3]).at.n_blocks
            contacts[i] = worlds[i][2]
    m = places[0, count]
    jac_, numbers_ = new((m, n)), new((3, m))
    jac, numbers = <double*>(<ndarray>jac_).data, <double*>(<ndarray>numbers_).data
    for i in range(count):
        if worlds[i] is None:
            continue
        k = places[0, i]
        memcpy(jac + k * n, (<ndarray>worlds[i][0]).data, (places[0, i + 1] - k) * n * sizeof(double))
        x = <double*>(<ndarray>worlds[i][1]).data
        for k in range(k, places[0, i + 1]):
            numbers[k], numbers[m + k], numbers[2 * m + k] = (dt * x[1] + x[3]) * x[4], 1.0 / x[0] * x[4] * x[4], dt * x[2] / x[4]
            x += 5
    return jac_, numbers_, free_, change_, places_, contacts_
