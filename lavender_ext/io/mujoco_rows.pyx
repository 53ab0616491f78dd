"""Conversion of MuJoCo's constraint rows to a problem: blocks, bounds, keys, J and consistency checks, in one pass each.

Arrays have MuJoCo's layout: efc_type, efc_id (m), contact dim (c), friction (c, 5), geom (c, 2). The
tangent rows of a contact with different coefficients f are scaled by f_j / f_0, so that mu = f_0 bounds them all:

    |(lambda_1 / f_0, ..., lambda_n / f_n)| <= lambda_n   <=>   |lambda'| <= f_0 lambda_n,   lambda'_j = lambda_j f_0 / f_j   (1)

A `Step` holds the addresses of the arrays (mujoco_step.pyx).
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memcmp, memcpy, memset

import numpy as np

from lavender_ext.core.arrays cimport as_double_pointer, as_int_pointer, make_read_only, ndarray
from lavender_ext.core.blocks cimport Blocks, allocate_blocks
from lavender_ext.core.validate cimport is_valid_number, is_valid_magnitude, update_max_abs
from lavender_ext.core.block_types cimport CONE, ROW, blocks_t, choose_contact_kind, write_contact_bounds
from lavender_ext.core.faults cimport NO_FAULT
from lavender_ext.core.generalized cimport Operator
from lavender_ext.core.problem cimport Workspace, allocate_bytes, bind_generalized_data
from lavender_ext.io.mujoco_step cimport Step, step_t


cpdef enum:
    # An equality constraint of at most this many rows is one block. In a larger one, such as a flex, each row is a block.
    MAX_EQUALITY_ROWS = 6
    CODES = 8                   # number of kinds of constraints

cdef enum:                      # results of reading J; INVALID_ROW - i refers to row i
    NO_JACOBIAN = -1
    UNSORTED = -1
    INVALID_ROW = -2

cdef object new = np.empty, I4 = np.dtype(np.int32)


cdef public int32_t lav_export_blocks(int32_t m, const int32_t* type_, const int32_t* id_, const int32_t* codes,
                                      const int32_t* n_objects, const int32_t* dim, const double* friction,
                                      const int32_t* geom, const double* loss, double dt, int32_t* ptr, int32_t* kind,
                                      double* lower, double* upper, double* mu, double* scale, uint64_t* key) noexcept nogil:
    """Write the blocks of m rows and return their number; -1 - i if row i has an unknown type or an invalid id.

    codes (8) are MuJoCo's types of equality, joint friction, tendon friction, joint limit, tendon limit, frictionless
    contact, pyramidal contact and elliptic contact. n_objects (8) is the number of objects that rows of each code may refer
    to. The dim of a contact is 1 to 6, and its rows must lie within the m rows. ptr has m + 1 entries.
    """
    cdef int32_t i = 0, j, _j, k = 0, t, of, size, count, nth, code
    cdef double inf = 1.0 / 0.0
    ptr[0] = 0
    while i < m:
        t = type_[i]
        of = id_[i]
        size = 1
        count = 1
        code = 0
        while code < CODES and t != codes[code]:
            code += 1
        if code == CODES or not 0 <= of < n_objects[code]:
            return -1 - i
        mu[k] = 0.0
        kind[k] = ROW
        lower[i] = -inf
        upper[i] = inf
        scale[i] = 1.0
        key[k] = (<uint64_t>(t + 1) << 56) | (<uint64_t>of << 32)
        if code == 0:
            while i + size < m and type_[i + size] == t and id_[i + size] == of:
                lower[i + size] = -inf
                upper[i + size] = inf
                scale[i + size] = 1.0
                size += 1
            if size > MAX_EQUALITY_ROWS:                # Form single rows, because one block would couple every vertex.
                count = size
                size = 1
                for j in range(1, count):
                    mu[k + j] = 0.0
                    kind[k + j] = ROW
                    key[k + j] = key[k] + j
        elif code <= 2:
            lower[i] = -dt * loss[i]
            upper[i] = dt * loss[i]
        elif code <= 4:
            lower[i] = 0.0
            if k > 0 and (key[k - 1] | 0xFFFF) == (key[k] | 0xFFFF):
                key[k] = key[k - 1] + 1                 # This is the second limit of the joint.
        else:
            nth = 0
            j = of - 1
            while j >= 0 and geom[2 * j] == geom[2 * of] and geom[2 * j + 1] == geom[2 * of + 1]:
                nth += 1
                j -= 1
            key[k] = ((<uint64_t>1 << 63) | (<uint64_t>((geom[2 * of] + 1) & 0xFFFFF) << 40)
                      | (<uint64_t>((geom[2 * of + 1] + 1) & 0xFFFFF) << 20) | (<uint64_t>(nth & 0xFFFF) << 4))
            lower[i] = 0.0
            if code == 5:
                kind[k] = choose_contact_kind(False, False, False, 0)
            elif not 1 < dim[of] <= MAX_EQUALITY_ROWS:
                return -1 - i
            elif code == 6:
                count = 2 * (dim[of] - 1)               # one row per edge of the pyramid
                if i + count > m:
                    return -1 - i
                for j in range(1, count):
                    lower[i + j] = 0.0
                    upper[i + j] = inf
                    scale[i + j] = 1.0
                    mu[k + j] = 0.0
                    kind[k + j] = ROW
                    key[k + j] = key[k] + j
            else:
                size = dim[of]
                if i + size > m:
                    return -1 - i
                kind[k] = choose_contact_kind(False, False, False, size - 1)
                mu[k] = friction[5 * of]
                for j in range(1, size):
                    lower[i + j] = -inf
                    upper[i + j] = inf
                    scale[i + j] = friction[5 * of + j - 1] / mu[k] if mu[k] > 0.0 else 0.0
        for _j in range(count):
            i += size
            k += 1
            ptr[k] = i
    return k


cdef inline void multiply_mass(int32_t n, const int32_t* at, const int32_t* column, const double* data, const double* x,
                          bint sizes, double* y) noexcept nogil:
    """Compute y = M x from the lower triangle of M, or |M| |x| with `sizes`."""
    cdef int32_t i, q, j, end
    cdef double own, z, term
    for i in range(n):
        own = 0.0
        z = fabs(x[i]) if sizes else x[i]
        end = at[i + 1] - 1
        for q in range(at[i], end):
            j = column[q]
            term = fabs(data[q]) if sizes else data[q]
            own += term * (fabs(x[j]) if sizes else x[j])
            y[j] += term * z
        y[i] = own + (fabs(data[end]) if sizes else data[end]) * z


cdef bint has_row_pattern(tuple like, const step_t* p):
    """Return whether (indptr, indices) is the pattern of MuJoCo's M."""
    cdef const int32_t* at
    cdef int32_t i, n = p.n, nnz = p.mass_entries
    if len(like[0]) != n + 1 or len(like[1]) != nnz:
        return False
    at = as_int_pointer(like[0], n + 1)
    if (at[n] != nnz or memcmp(at, p.M_rowadr, n * sizeof(int32_t))
            or memcmp(as_int_pointer(like[1], nnz), p.M_colind, nnz * sizeof(int32_t))):
        return False
    for i in range(n):
        if at[i + 1] - at[i] != p.M_rownnz[i]:
            return False
    return True


cdef (double, double) compare_spatial_velocities(const step_t* p, const double* v):
    """Compare the spatial velocities c (n, 6) with those that v (nv) gives; return the largest difference and the largest term.

        c_i = c_parent(i) + sum over the velocities j of body i of s_j v_j,   s = cdof (nv, 6), c = cvel

    The difference is 0 if s is all zeros, as in a copy that does not fill it, and -1 if the arrays do not describe one tree.
    """
    cdef Py_ssize_t i, j, k, n = p.n, bodies = p.bodies
    cdef double term, z
    cdef double[6] big, gap, lost                       # One number per component; lost is 0, or NaN after a NaN.
    cdef Workspace scratch = allocate_bytes(6 * bodies * sizeof(double))
    cdef double* made = <double*>scratch.at
    cdef const double* c = p.cvel
    cdef const double* s = p.cdof
    cdef const int32_t* of = p.dof_bodyid
    cdef const int32_t* up = p.body_parentid
    cdef double* row
    cdef const double* before
    for i in range(bodies):
        if not 0 <= up[i] < bodies:
            return -1.0, 0.0
    for j in range(n):
        if not 0 <= of[j] < bodies:
            return -1.0, 0.0
    for k in range(6):
        big[k] = gap[k] = lost[k] = made[k] = 0.0
    for i in range(6, 6 * bodies):
        made[i] = -c[i]
    for j in range(n):
        z = v[j]
        row = made + 6 * of[j]
        for k in range(6):
            term = s[6 * j + k] * z
            row[k] += term
            big[k] = max_ignoring_nan(big[k], term)
    for i in range(1, bodies):
        row = made + 6 * i
        before = c + 6 * up[i]
        for k in range(6):
            term = row[k] + before[k]
            gap[k] = max_ignoring_nan(gap[k], term)
            big[k] = max_ignoring_nan(big[k], c[6 * i + k])
            lost[k] += 0.0 * term
    for k in range(6):
        gap[0] = max_ignoring_nan(gap[0], gap[k])
        big[0] = max_ignoring_nan(big[0], big[k])
        lost[0] += lost[k] + 0.0 * made[k]
    i = 0
    while i < 6 * n and not fabs(s[i]) > 0.0:
        i += 1
    return (gap[0] + lost[0] if i < 6 * n else 0.0), big[0] + lost[0]


cdef object recover_joint_velocity(const step_t* p, double alike):
    """Recover v (nv) from the spatial velocities of `compare_spatial_velocities`; None if s does not determine it.

    Least squares are solved body by body with modified Gram-Schmidt. `alike` is the minimum fraction of an axis s_j that must
    be independent of the other axes of its body.
    """
    cdef Py_ssize_t i, j = 0, k, r, count, n = p.n
    cdef double[36] q, upper
    cdef double[6] residual, x
    cdef double size, dot
    cdef const int32_t* body = p.dof_bodyid
    velocities = new(n)
    cdef double* v = as_double_pointer(velocities, n)
    while j < n:
        count = 1
        while j + count < n and body[j + count] == body[j]:
            count += 1
        if count > 6:
            return None
        for k in range(6):
            residual[k] = p.cvel[6 * body[j] + k] - p.cvel[6 * p.body_parentid[body[j]] + k]
        for i in range(count):
            size = 0.0
            for k in range(6):
                q[6 * i + k] = p.cdof[6 * (j + i) + k]
                size += q[6 * i + k] * q[6 * i + k]
            for r in range(i):
                dot = 0.0
                for k in range(6):
                    dot += q[6 * r + k] * q[6 * i + k]
                upper[6 * r + i] = dot
                for k in range(6):
                    q[6 * i + k] -= dot * q[6 * r + k]
            size *= alike * alike
            dot = 0.0
            for k in range(6):
                dot += q[6 * i + k] * q[6 * i + k]
            if not dot > size:
                return None
            dot = sqrt(dot)
            upper[7 * i] = dot
            x[i] = 0.0
            for k in range(6):
                q[6 * i + k] /= dot
                x[i] += q[6 * i + k] * residual[k]
            for k in range(6):
                residual[k] -= x[i] * q[6 * i + k]
        for i in range(count - 1, -1, -1):
            for r in range(i + 1, count):
                x[i] -= upper[6 * i + r] * x[r]
            x[i] /= upper[7 * i]
            v[j + i] = x[i]
        j += count
    return velocities


cdef inline double max_ignoring_nan(double maximum, double x) noexcept nogil:
    """Return the larger of `maximum` and |x|, ignoring a NaN x."""
    x = fabs(x)
    return x if x > maximum else maximum


cdef inline double* get_row_scales(Blocks blocks) noexcept:
    """Return the factor of each row (m)."""
    return <double*>blocks.at.rolling + blocks.at.n_rows


cpdef make_blocks(Step step, codes):
    """Return the blocks, or the number of a row with an unknown type or an invalid id.

    The blocks have a fault if a bound is not a valid number. Their `ints` hold type, id, dim and geom from index 2 m + 1, their
    `numbers` the factor of each row from index 5 m, and the last m numbers the keys as uint64.
    """
    cdef const step_t* s = &step.at
    cdef int32_t m = <int32_t>s.m, c = <int32_t>s.contacts, k, i
    cdef int32_t limits[CODES]
    cdef Blocks made = allocate_blocks(m, m, 2 * m + 3 * c, 2 * m + 5 * c)
    cdef blocks_t* p = &made.at
    cdef int32_t* held = <int32_t*>p.kind + m
    cdef double* scale = get_row_scales(made)
    cdef double* x = scale + m
    cdef uint64_t* key = <uint64_t*>(x + 5 * c)
    for k in range(CODES):
        limits[k] = step.object_counts[k] if k < 5 else c
    if m:
        memcpy(held, s.efc_type, m * sizeof(int32_t))
        memcpy(held + m, s.efc_id, m * sizeof(int32_t))
    memset(<double*>p.patch_radius, 0, 2 * m * sizeof(double))
    for i in range(c):
        memcpy(&held[2 * m + i], s.dim + i * s.stride, sizeof(int32_t))
        memcpy(&held[2 * m + c + 2 * i], s.geom + i * s.stride, 2 * sizeof(int32_t))
        memcpy(&x[5 * i], s.friction + i * s.stride, 5 * sizeof(double))
    k = lav_export_blocks(m, held, held + m, as_int_pointer(codes, CODES), limits, held + 2 * m, x,
                          held + 2 * m + c, s.efc_frictionloss, s.dt, <int32_t*>p.ptr, <int32_t*>p.kind,
                          <double*>p.lower, <double*>p.upper, <double*>p.mu, scale, key)
    if k < 0:
        return -1 - k
    p.n_blocks = k
    made.validate()
    write_contact_bounds(&made.at)
    return made


def read_jacobian(Step step, scale_):
    """Return (indptr, indices, data) of J, each row times `scale_` (m,); a row's number if its indices are invalid.

    The result is None if columns do not ascend, and -1 if efc_J has fewer entries than a dense J.
    """
    cdef const double* scale = as_double_pointer(scale_, step.at.m)
    cdef int64_t total = count_jacobian_entries(step, scale), at
    if total < 0:
        return -1 if total == NO_JACOBIAN else INVALID_ROW - total
    indptr, indices, data = new(step.at.m + 1, I4), new(total, I4), new(total)
    at = compress_jacobian(step, scale, <int32_t*>(<ndarray>indptr).data, <int32_t*>(<ndarray>indices).data,
                           <double*>(<ndarray>data).data)
    if at < 0:
        return None if at == UNSORTED else INVALID_ROW - at
    return (indptr, indices, data) if at == total else (indptr, indices[:at], data[:at])


cdef int64_t count_jacobian_entries(Step step, const double* scale) noexcept:
    """Return an upper bound of the number of entries of J; NO_JACOBIAN, or INVALID_ROW - i if the position of row i is invalid."""
    cdef const step_t* s = &step.at
    cdef int32_t i, j, m = <int32_t>s.m, n = s.n
    cdef int64_t total = 0
    cdef const int32_t* count = s.efc_J_rownnz
    cdef const int32_t* first = s.efc_J_rowadr
    if not step.is_sparse:
        if s.jac_entries < <int64_t>m * n:
            return NO_JACOBIAN
        for i in range(m):
            for j in range(n):
                total += s.efc_J[i * n + j] * scale[i] != 0.0
        return total
    if m and (count == NULL or first == NULL or s.efc_J_colind == NULL):
        return INVALID_ROW
    for i in range(m):
        if not 0 <= count[i] <= s.jac_entries or not 0 <= first[i] <= s.jac_entries - count[i]:
            return INVALID_ROW - i
        total += count[i]
    return total


cdef int64_t compress_jacobian(Step step, const double* scale, int32_t* indptr, int32_t* indices, double* data) noexcept:
    """Write J with scaled rows and return its number of entries; UNSORTED, or INVALID_ROW - i if a column of row i is invalid."""
    cdef const step_t* s = &step.at
    cdef int32_t i, j, is_invalid, m = <int32_t>s.m, n = s.n
    cdef int64_t q, begin, end, at = 0
    cdef double x, factor
    cdef bint ascend = True
    cdef const double* value = s.efc_J
    cdef const int32_t* column = s.efc_J_colind
    indptr[0] = 0
    for i in range(m):
        factor = scale[i]
        if not step.is_sparse:
            for j in range(n):
                x = value[i * n + j] * factor
                if x != 0.0:
                    indices[at] = j
                    data[at] = x
                    at += 1
            indptr[i + 1] = <int32_t>at
            continue
        begin = s.efc_J_rowadr[i]
        end = begin + s.efc_J_rownnz[i]
        is_invalid = 0
        for q in range(begin, end):
            is_invalid |= not 0 <= column[q] < n
        if is_invalid:
            return INVALID_ROW - i
        for q in range(begin + 1, end):
            is_invalid |= column[q] <= column[q - 1]
        ascend &= not is_invalid
        for q in range(begin, end):
            x = value[q] * factor
            if x != 0.0:
                indices[at] = column[q]
                data[at] = x
                at += 1
        indptr[i + 1] = <int32_t>at
    return at if ascend else UNSORTED


cdef double compare_smooth_force(const step_t* p, const int32_t* at, const int32_t* column, const double* data, double bound,
                                 double* product) noexcept:
    """Return the relative difference of M x and y of `extract_lower_triangle_of_mass`; product (n) is scratch."""
    cdef int32_t i
    cdef double gap = 0.0, big = 0.0
    multiply_mass(p.n, at, column, data, p.qacc_smooth, False, product)
    for i in range(p.n):
        gap = update_max_abs(gap, product[i] - p.qfrc_smooth[i])
        big = update_max_abs(big, p.qfrc_smooth[i])
    if not gap <= bound * big:
        big = 0.0
        multiply_mass(p.n, at, column, data, p.qacc_smooth, True, product)
        for i in range(p.n):
            big = update_max_abs(big, product[i] + fabs(p.qfrc_smooth[i]))
    return gap / big if big > 0.0 else gap


def extract_lower_triangle_of_mass(Step step, double bound, tuple like):
    """Return the lower triangle of M as (indptr, indices, data), and max |M x - y| over max (|M| |x| + |y|).

    x and y are qacc_smooth and qfrc_smooth. The second number is max |M x - y| / max |y| instead, if that is at most
    `bound`. The result is None if rows of M are not consecutive or their columns do not ascend to the diagonal entry.
    `like` is (indptr, indices) of a lower triangle; these arrays are reused if the pattern is the same.
    """
    cdef const step_t* p = &step.at
    cdef int32_t i, q, last, n = p.n, nnz = p.mass_entries
    cdef Workspace product
    cdef int32_t* whole
    cdef double* data
    if n == 0:
        return None if nnz else ((np.zeros(1, I4), new(0, I4), new(0)), 0.0)
    if not has_row_pattern(like, p):
        like = new(n + 1, I4), new(nnz, I4)
        whole = as_int_pointer(like[0], n + 1)
        memcpy(as_int_pointer(like[1], nnz), p.M_colind, nnz * sizeof(int32_t))
        whole[0] = 0
        for i in range(n):
            if p.M_rowadr[i] != whole[i] or not 0 < p.M_rownnz[i] <= nnz - whole[i]:
                return None
            whole[i + 1] = whole[i] + p.M_rownnz[i]
            last = -1
            for q in range(whole[i], whole[i + 1]):
                if not last < p.M_colind[q] <= i:
                    return None
                last = p.M_colind[q]
            if last != i:
                return None
        if whole[n] != nnz:
            return None
        for made_ in like:
            make_read_only(made_)
    copy, product = new(nnz), allocate_bytes(n * sizeof(double))
    data = as_double_pointer(copy, nnz)
    memcpy(data, p.M, nnz * sizeof(double))
    return (like[0], like[1], copy), compare_smooth_force(p, as_int_pointer(like[0], n + 1), as_int_pointer(like[1], nnz), data,
                                                          bound, <double*>product.at)


cpdef find_velocity_before(Step step, double tolerance, double alike):
    """Return the velocity (nv,) of the last forward pass; None if it is qvel.

    After a step it is recovered from the velocities of bodies, which MuJoCo computes before the step. The result is -1 if
    the body tree is invalid, and -2 if the velocities cannot be recovered: `alike` is the minimum fraction of a joint's
    axis that must be independent of the axes before it in the same body; `tolerance` is the largest accepted difference of
    a velocity, relative to the largest term.
    """
    cdef step_t* p = &step.at
    cdef int64_t i = 0
    gap, size = compare_spatial_velocities(p, p.qvel)
    if gap < 0.0:
        return -1
    if gap <= tolerance * size:
        return None
    while i < 6 * p.bodies and p.cvel[i] == 0.0:
        i += 1
    if i == 6 * p.bodies:                           # In a copy of the data, cvel may be unset.
        for i in range(p.m):
            if p.efc_vel[i] != 0.0:
                return None
    v = recover_joint_velocity(p, alike)
    if v is None or not compare_spatial_velocities(p, as_double_pointer(v, p.n))[0] <= tolerance * size:
        return -2
    return v


def compute_problem_numbers(Step step, tuple jac, scale, v):
    """Return (b, compliance, v*, max |efc_R efc_D - 1|, gaps) of J with scaled rows.

        b = dt (aref - J a0),   v* = v + dt a0,   a0 = qacc_smooth

    The gaps are the relative errors of products of J that MuJoCo stored, each divided by the size of its terms:

        J v = efc_vel   (1)      J a0 - aref = efc_b   (2)      J^T f = qfrc_constraint   (3)

    with v before the step and f = efc_force. A gap is 0 if the stored vector is all zeros, as in a copy that does not fill it.
    The size of terms is |J_i|_1 |x|_max for (1) and (2), max |J|^T |f| for (3). The fourth gap is NaN if a is not finite.
    """
    cdef const step_t* p = &step.at
    cdef Py_ssize_t m = p.m, n = p.n
    cdef double[5] gap
    cdef Workspace scratch = allocate_bytes(3 * n * sizeof(double))
    cdef const int32_t* jptr = as_int_pointer(jac[0], m + 1)
    rhs, compliance, free = new(m), new(m), new(n)
    multiply_problem_numbers(p, jptr, as_int_pointer(jac[1], jptr[m]), as_double_pointer(jac[2], jptr[m]),
                             as_double_pointer(scale, m), p.qvel if v is None else as_double_pointer(v, n), 0.0,
                             <double*>(<ndarray>rhs).data, <double*>(<ndarray>compliance).data,
                             <double*>(<ndarray>free).data, <double*>scratch.at, gap)
    return rhs, compliance, free, gap[0], (gap[1], gap[2], gap[3], gap[4])


cdef bint multiply_problem_numbers(const step_t* p, const int32_t* jptr, const int32_t* jidx, const double* jval,
                                   const double* scale, const double* v, double usual, double* rhs, double* compliance,
                                   double* free, double* force_sum, double* gap) noexcept:
    """Compute the results of `compute_problem_numbers`, with five gaps; force_sum (3 n) receives J^T f, |J|^T |f| and scratch.

    Returns whether all numbers are valid, and compliances are at most `usual`.
    """
    cdef int32_t i, j, m = <int32_t>p.m, n = p.n
    cdef Py_ssize_t q
    cdef double dt = p.dt, c, size, s_v, s_free, f, finite = 0.0, gap_0 = 0.0, gap_1 = 0.0, gap_2 = 0.0, gap_3 = 0.0
    cdef double big_1 = 0.0, big_2 = 0.0, big_3 = 0.0, stored_1 = 0.0, stored_2 = 0.0, stored_3 = 0.0
    cdef double top_v = 0.0, top_free = 0.0, top_b = 0.0
    cdef bint sound = True
    cdef double* change = force_sum + 2 * n                # dt a0
    for j in range(n):
        change[j] = dt * p.qacc_smooth[j]
        force_sum[j] = force_sum[n + j] = 0.0
        free[j] = v[j] + change[j]
        sound &= is_valid_number(free[j])
        top_v = update_max_abs(top_v, v[j])
        top_free = update_max_abs(top_free, change[j])
        stored_3 = update_max_abs(stored_3, p.qfrc_constraint[j])
        finite += 0.0 * p.qacc[j]
    for i in range(m):
        size = s_v = s_free = 0.0
        f = p.efc_force[i] / scale[i] if scale[i] != 0.0 else 0.0
        for q in range(jptr[i], jptr[i + 1]):
            j = jidx[q]
            c = jval[q]
            s_v += c * v[j]
            s_free += c * change[j]
            size += fabs(c)
            c *= f
            force_sum[j] += c
            force_sum[n + j] += fabs(c)
        rhs[i] = dt * scale[i] * p.efc_aref[i] - s_free
        compliance[i] = p.efc_R[i] * scale[i] * scale[i]
        top_b = update_max_abs(top_b, rhs[i])
        sound &= is_valid_magnitude(compliance[i]) and compliance[i] <= usual
        gap_0 = update_max_abs(gap_0, p.efc_R[i] * p.efc_D[i] - 1.0)
        c = scale[i] * p.efc_vel[i]
        gap_1 = update_max_abs(gap_1, s_v - c)
        big_1 = update_max_abs(big_1, size * top_v + fabs(c))
        stored_1 = update_max_abs(stored_1, p.efc_vel[i])
        c = scale[i] * dt * p.efc_b[i]
        gap_2 = update_max_abs(gap_2, rhs[i] + c)
        big_2 = update_max_abs(big_2, size * top_free + fabs(rhs[i]) + fabs(c))
        stored_2 = update_max_abs(stored_2, p.efc_b[i])
    for j in range(n):
        gap_3 = update_max_abs(gap_3, force_sum[j] - p.qfrc_constraint[j])
        big_3 = update_max_abs(big_3, force_sum[n + j] + fabs(p.qfrc_constraint[j]))
    if p.has_moving_surfaces:                           # efc_vel contains the velocities of surfaces, too.
        stored_1 = 0.0
    gap[0], gap[4] = gap_0, finite
    gap[1] = gap_1 / big_1 if stored_1 != 0.0 and big_1 != 0.0 else 0.0
    gap[2] = gap_2 / big_2 if stored_2 != 0.0 and big_2 != 0.0 else 0.0
    gap[3] = gap_3 / big_3 if stored_3 != 0.0 and big_3 != 0.0 else 0.0
    return sound and is_valid_magnitude(top_b)


def convert_regular_step(Step step, codes, Operator like, double mass_tolerance, double tolerance, double alike,
                         double compliance_tolerance, double usual):
    """Return (data, blocks, operator, numbers) with the factor of M; None if one of the checks needs its own message.

    The functions above describe the arguments. M must have the pattern of `like`, and all entries must be at most `usual`.
    `numbers` begins with b (m), the compliance (m) and v* (n).
    """
    cdef const step_t* p = &step.at
    cdef Py_ssize_t m = p.m, n = p.n
    cdef int64_t total
    cdef Operator operator
    cdef Blocks blocks
    cdef double[5] gap
    cdef const double* scale
    cdef double* rhs
    cdef double* jval
    cdef double* mval
    cdef double* factor
    cdef int32_t* jptr
    if not 0.0 < p.dt < 1.0 / 0.0 or p.is_discrete or not step.has_mass or not has_row_pattern(like.mass, p):
        return None
    made = make_blocks(step, codes)
    if type(made) is int:
        return None
    blocks = made
    scale = get_row_scales(blocks)
    total = count_jacobian_entries(step, scale)
    if blocks.fault != NO_FAULT or total < 0:
        return None
    numbers = make_read_only(new(2 * m + n + total + p.mass_entries + like.get_factor_size()))
    ints = make_read_only(new(m + 1 + total, I4))
    rhs, jptr = <double*>(<ndarray>numbers).data, <int32_t*>(<ndarray>ints).data
    jval = rhs + 2 * m + n
    mval = jval + total
    factor = mval + p.mass_entries                      # scratch before M is factored
    memcpy(mval, p.M, p.mass_entries * sizeof(double))
    if not compare_smooth_force(p, like.g.mptr, like.g.midx, mval, mass_tolerance, factor) <= mass_tolerance:
        return None
    v = find_velocity_before(step, tolerance, alike)
    if type(v) is int or compress_jacobian(step, scale, jptr, jptr + m + 1, jval) < 0:
        return None
    if not multiply_problem_numbers(p, jptr, jptr + m + 1, jval, scale, p.qvel if v is None else as_double_pointer(v, n), usual,
                                    rhs, rhs + m, rhs + 2 * m, factor, gap):
        return None
    if not gap[0] <= compliance_tolerance or gap[4] != 0.0:
        return None
    for i in range(1, 4):
        if not gap[i] <= tolerance:
            return None
    operator = Operator.__new__(Operator)
    operator.share_memory(like, <int32_t>m, numbers, ints, jval, mval)
    operator.factor_into(factor)
    if operator.failed >= 0 or operator.has_entry_above(usual):
        return None
    data = bind_generalized_data(blocks, operator, CONE, rhs, rhs + m, [blocks, operator, numbers])
    return data, blocks, operator, numbers


def copy_rows(Step step):
    """Return copies of the rows and contacts of a forward pass: J (m, nv), and the arrays (m, 5), (m, 2), (c, 4), (c, 5).

    Their columns are efc_D, efc_aref, efc_force, efc_frictionloss and efc_vel; efc_type and efc_id; efc_address, dim and geom of
    the contacts; friction of the contacts.
    """
    cdef const step_t* p = &step.at
    cdef int32_t i, k, m = <int32_t>p.m, c = <int32_t>p.contacts, n = p.n
    cdef int64_t q
    jac_, numbers_, ints_ = new((m, n)), new((m, 5)), new((m, 2), I4)
    contacts_, friction_ = new((c, 4), I4), new((c, 5))
    cdef double* jac = as_double_pointer(jac_, <Py_ssize_t>m * n)
    cdef double* numbers = as_double_pointer(numbers_, 5 * m)
    cdef int32_t* ints = as_int_pointer(ints_, 2 * m)
    cdef int32_t* contacts = as_int_pointer(contacts_, 4 * c)
    cdef double* friction = as_double_pointer(friction_, 5 * c)
    cdef const double** columns = [p.efc_D, p.efc_aref, p.efc_force, p.efc_frictionloss, p.efc_vel]
    if m and not step.is_sparse:
        memcpy(jac, p.efc_J, <size_t>m * n * sizeof(double))
    else:
        memset(jac, 0, <size_t>m * n * sizeof(double))
    for i in range(m):
        if step.is_sparse:
            for q in range(p.efc_J_rowadr[i], p.efc_J_rowadr[i] + p.efc_J_rownnz[i]):
                jac[<Py_ssize_t>i * n + p.efc_J_colind[q]] = p.efc_J[q]
        for k in range(5):
            numbers[5 * i + k] = columns[k][i]
        ints[2 * i] = p.efc_type[i]
        ints[2 * i + 1] = p.efc_id[i]
    for i in range(c):
        memcpy(contacts + 4 * i, p.efc_address + i * p.stride, sizeof(int32_t))
        memcpy(contacts + 4 * i + 1, p.dim + i * p.stride, sizeof(int32_t))
        memcpy(contacts + 4 * i + 2, p.geom + i * p.stride, 2 * sizeof(int32_t))
        memcpy(friction + 5 * i, p.friction + i * p.stride, 5 * sizeof(double))
    return jac_, numbers_, ints_, contacts_, friction_
