"""Records of two blocks of one kind, one in each lane of a pair, for the updates of core/contact.pxd.

The kind determines the code of an update: the rows of a contact, or the number of rows of a joint and which of its bodies move.
A block of another kind, or with more rows, is UNPACKED: its record has its number only, and it is updated as in a sweep over
single blocks.

A record holds the arrays of an update as pairs, with one entry for each lane:

    header      byte offsets of the velocities of both bodies to read and to write; owner; code (`encode_record_header`)
    impulses    n
    contact     normal 3, arm_a 3, arm_b 3, inverse masses 2, compliance n, b n, step n, inv_inertia_arm 6 n;
                with tangents t1 3, t2 3, mu, A_t1n, A_t2n; box A_t2t1, mu_2; spin row A_sn, A_st1, A_st2, mu r; rolling mu_r
    joint       compliance n, b n, step n, lower n, upper n, J 12 n, M^-1 J^T 12 n

A record of one block has this block in both lanes; the second lane writes its velocities to an unused place.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block_types cimport blocks_t, friction_components_t, is_box_friction_contact, count_tangent_rows
from lavender_ext.core.contact cimport (bind_contact_arrays, bind_contact_friction, contact_kind_t, contact_t, disk_t, normal_t,
                                        other_contact_t, relax_contact)
from lavender_ext.core.joint cimport bind_joint_arrays, joint_t, relax_joint
from lavender_ext.core.pair cimport LANES, byte_offset, load_pair, load_six, pair_t, store_six
from lavender_ext.core.view cimport get_block_bodies, rows_t
from lavender_ext.sweep.pgs cimport sweep_bodies


cdef enum:                      # kinds; NORMAL, DISK, SPIN, ROLL and ROLL_SPIN are also the number of rows
    UNPACKED = 0
    NORMAL = 1
    BOX = 2
    DISK = 3
    SPIN = 4
    ROLL = 5
    ROLL_SPIN = 6
    JOINT = 7                   # plus 4 (rows - 1), plus 2 if body a moves, plus 1 if body b moves
    MAX_RECORD_ROWS = 6
    N_KINDS = 31

cdef enum:                      # int64 entries of the header, one for each lane
    READ_OFFSET = 0             # offsets for bodies a and b; for an UNPACKED block its number
    WRITE_OFFSET = 2            # offsets for bodies a and b
    OWNER = 4                   # set by the caller: the stage of the block, or the index of its first row
    CODE = 5

cdef enum:                      # sizes in pairs
    HEADER_SIZE = 6
    CONTACT_SIZE = 11
    CONTACT_ROW_SIZE = 9
    TANGENTS_SIZE = 9
    SPIN_SIZE = 4
    BOX_SIZE = 2
    JOINT_ROW_SIZE = 29
    VELOCITY_BYTES = 48         # six doubles


cdef inline int32_t classify_record_kind(const blocks_t* p, const rows_t* r, int32_t i) noexcept nogil:
    """Return the kind of block i."""
    cdef int32_t n = p.ptr[i + 1] - p.ptr[i]
    if i < r.n_joints:
        if n > MAX_RECORD_ROWS:
            return UNPACKED
        return JOINT + 4 * (n - 1) + 2 * (r.joint_body[2 * i] >= 0) + (r.joint_body[2 * i + 1] >= 0)
    if is_box_friction_contact(p, i):
        return BOX
    return n if n == NORMAL or count_tangent_rows(p, i) == 2 else UNPACKED


cdef inline int32_t count_record_rows(int32_t kind) noexcept nogil:
    """Return the number of impulses in a record, 0 for an UNPACKED block."""
    return 3 if kind == BOX else kind if kind < JOINT else 1 + (kind - JOINT) // 4


cdef inline int32_t record_size_in_pairs(int32_t kind) noexcept nogil:
    """Return the size of a record in pairs."""
    cdef int32_t n = count_record_rows(kind)
    if kind == UNPACKED:
        return HEADER_SIZE
    if kind >= JOINT:
        return HEADER_SIZE + (1 + JOINT_ROW_SIZE) * n
    return (HEADER_SIZE + CONTACT_SIZE + (1 + CONTACT_ROW_SIZE) * n + (TANGENTS_SIZE if n > 1 else 0)
            + (SPIN_SIZE if kind == SPIN or kind == ROLL_SPIN else 0) + (BOX_SIZE if kind == BOX else 0) + (kind >= ROLL))


cdef inline int64_t encode_record_header(int32_t kind, int64_t previous_size) noexcept nogil:
    """Return kind + 2^8 (size of this record) + 2^32 (size of the record before it), both sizes in pairs."""
    return kind + (<int64_t>record_size_in_pairs(kind) << 8) + (previous_size << 32)


cdef inline int32_t decode_record_kind(int64_t code) noexcept nogil:
    return code & 255


cdef inline int64_t decode_record_size(int64_t code) noexcept nogil:
    return (code >> 8) & 0xffffff


cdef inline int64_t decode_previous_record_size(int64_t code) noexcept nogil:
    return code >> 32


cdef inline pair_t* interleave_pairs(pair_t* out, int32_t n, const double* x, const double* y) noexcept nogil:
    """Store the pairs of x (n) and y (n) to `out`; return the address after the last pair."""
    cdef int32_t k
    for k in range(n):
        out[k] = load_pair(x + k, y + k)
    return out + n


cdef inline void write_contact_record(const blocks_t* p, const rows_t* r, int32_t kind, int32_t i, int32_t j,
                                      pair_t* out) noexcept nogil:
    """Write the arrays of contacts i and j, in the order of `bind_contact_to_record`."""
    cdef contact_t x, y
    cdef friction_components_t components_x, components_y
    cdef double tangent2_x[3]
    cdef double tangent2_y[3]
    cdef double zero = 0.0
    cdef int32_t n = count_record_rows(kind)
    bind_contact_arrays(p, r, i, &x)
    bind_contact_arrays(p, r, j, &y)
    out = interleave_pairs(out, 3, x.normal, y.normal)
    out = interleave_pairs(out, 3, x.arm_a, y.arm_a)
    out = interleave_pairs(out, 3, x.arm_b, y.arm_b)
    out = interleave_pairs(out, 1, x.inv_mass_a if x.body_a >= 0 else &zero, y.inv_mass_a if y.body_a >= 0 else &zero)
    out = interleave_pairs(out, 1, x.inv_mass_b if x.body_b >= 0 else &zero, y.inv_mass_b if y.body_b >= 0 else &zero)
    out = interleave_pairs(out, n, x.compliance, y.compliance)
    out = interleave_pairs(out, n, x.b, y.b)
    out = interleave_pairs(out, n, x.step, y.step)
    out = interleave_pairs(out, 6 * n, x.inv_inertia_arm, y.inv_inertia_arm)
    if kind == NORMAL:
        return
    bind_contact_friction(p, i, &components_x, tangent2_x, &x)
    bind_contact_friction(p, j, &components_y, tangent2_y, &y)
    out = interleave_pairs(out, 3, x.tangent1, y.tangent1)
    out = interleave_pairs(out, 3, x.tangent2, y.tangent2)
    out = interleave_pairs(out, 1, x.mu, y.mu)
    out = interleave_pairs(out, 3 if kind == BOX else 5 if x.spins else 2, x.coupling, y.coupling)
    if kind == BOX or x.spins:
        out = interleave_pairs(out, 1, x.second_mu, y.second_mu)
    if x.rolls:
        interleave_pairs(out, 1, x.rolling_mu, y.rolling_mu)


cdef inline void write_joint_record(const blocks_t* p, const rows_t* r, int32_t i, int32_t j, pair_t* out) noexcept nogil:
    """Write the arrays of joints i and j, in the order of `relax_joint_record`."""
    cdef joint_t x, y
    bind_joint_arrays(p, r, i, &x)
    bind_joint_arrays(p, r, j, &y)
    out = interleave_pairs(out, x.n_rows, x.compliance, y.compliance)
    out = interleave_pairs(out, x.n_rows, x.b, y.b)
    out = interleave_pairs(out, x.n_rows, x.step, y.step)
    out = interleave_pairs(out, x.n_rows, x.lower, y.lower)
    out = interleave_pairs(out, x.n_rows, x.upper, y.upper)
    out = interleave_pairs(out, 12 * x.n_rows, x.jac, y.jac)
    interleave_pairs(out, 12 * x.n_rows, x.minv_jac, y.minv_jac)


cdef inline void write_block_record(const blocks_t* p, const rows_t* r, int32_t kind, int32_t i, int32_t j, int64_t owner_i,
                                    int64_t owner_j, const double* lam, pair_t* out) noexcept nogil:
    """Write the record of blocks i and j of one kind, without its code; j = i for one block."""
    cdef int64_t* header = <int64_t*>out
    cdef const int32_t* body
    cdef int32_t side, lane, n = count_record_rows(kind)
    header[OWNER * LANES] = owner_i
    header[OWNER * LANES + LANES - 1] = owner_j if LANES > 1 else owner_i
    if kind == UNPACKED:
        header[READ_OFFSET] = i
        return
    for lane in range(LANES):
        body = get_block_bodies(r, i if lane == 0 else j)
        for side in range(2):
            # After the last body: six zeros that are read for static bodies, then six unused doubles that are written for them.
            header[(READ_OFFSET + side) * LANES + lane] = VELOCITY_BYTES * <int64_t>(
                body[side] if body[side] >= 0 else r.n_bodies)
            header[(WRITE_OFFSET + side) * LANES + lane] = VELOCITY_BYTES * <int64_t>(
                body[side] if body[side] >= 0 and (lane == 0 or i != j) else r.n_bodies + 1)
    out = interleave_pairs(out + HEADER_SIZE, n, lam + p.ptr[i], lam + p.ptr[j])
    if kind >= JOINT:
        write_joint_record(p, r, i, j, out)
    else:
        write_contact_record(p, r, kind, i, j, out)


cdef inline void bind_contact_to_record(const pair_t* record, int32_t kind, contact_t* out) noexcept nogil:
    """Point `out` at the arrays of a record of contacts of this kind."""
    cdef int32_t n = count_record_rows(kind)
    cdef const pair_t* x = record + HEADER_SIZE + n
    out.box, out.spins, out.rolls = kind == BOX, kind == SPIN or kind == ROLL_SPIN, kind >= ROLL
    out.n_tangents = 0 if kind == NORMAL else 2
    out.normal, out.arm_a, out.arm_b = <const double*>x, <const double*>(x + 3), <const double*>(x + 6)
    out.inv_mass_a, out.inv_mass_b = <const double*>(x + 9), <const double*>(x + 10)
    x += CONTACT_SIZE
    out.compliance, out.b, out.step = <const double*>x, <const double*>(x + n), <const double*>(x + 2 * n)
    out.inv_inertia_arm = <const double*>(x + 3 * n)
    if kind == NORMAL:
        return
    x += CONTACT_ROW_SIZE * n
    out.tangent1, out.tangent2 = <const double*>x, <const double*>(x + 3)
    out.mu, out.coupling = <const double*>(x + 6), <const double*>(x + 7)
    x += 10 if out.box else 12 if out.spins else 9
    out.second_mu = <const double*>x
    out.rolling_mu = <const double*>(x + (1 if out.spins else 0))


cdef inline void relax_contact_record(const contact_kind_t* contacts, const int64_t* read_offset, const int64_t* write_offset,
                                      pair_t* lam, double* v) noexcept nogil:
    """Update two contacts; lam (n) are their impulses in pairs, v the velocities of all bodies.

    The offsets locate the velocities of both bodies of each contact in v.
    """
    cdef pair_t va[6]
    cdef pair_t vb[6]
    load_six(byte_offset(v, read_offset[0]), byte_offset(v, read_offset[LANES - 1]), va)
    load_six(byte_offset(v, read_offset[LANES]), byte_offset(v, read_offset[2 * LANES - 1]), vb)
    relax_contact(contacts, lam, va, vb)
    store_six(byte_offset(v, write_offset[0]), byte_offset(v, write_offset[LANES - 1]), va)
    store_six(byte_offset(v, write_offset[LANES]), byte_offset(v, write_offset[2 * LANES - 1]), vb)


cdef inline void relax_joint_record(const pair_t* record, int32_t kind, pair_t* lam, double* v,
                                    const int64_t* write_offset) noexcept nogil:
    """Update two joints of this kind; arguments as for `relax_contact_record`."""
    cdef const int64_t* read_offset = <const int64_t*>record
    cdef int32_t n = count_record_rows(kind)
    cdef const pair_t* x = record + HEADER_SIZE + n
    cdef joint_t joints
    cdef pair_t va[6]
    cdef pair_t vb[6]
    joints.n_rows, joints.body_a, joints.body_b = n, 0 if (kind - JOINT) & 2 else -1, 0 if (kind - JOINT) & 1 else -1
    joints.compliance, joints.b, joints.step = <const double*>x, <const double*>(x + n), <const double*>(x + 2 * n)
    joints.lower, joints.upper = <const double*>(x + 3 * n), <const double*>(x + 4 * n)
    joints.jac, joints.minv_jac = <const double*>(x + 5 * n), <const double*>(x + 17 * n)
    load_six(byte_offset(v, read_offset[0]), byte_offset(v, read_offset[LANES - 1]), va)
    load_six(byte_offset(v, read_offset[LANES]), byte_offset(v, read_offset[2 * LANES - 1]), vb)
    relax_joint(&joints, lam, va, vb)
    store_six(byte_offset(v, write_offset[0]), byte_offset(v, write_offset[LANES - 1]), va)
    store_six(byte_offset(v, write_offset[LANES]), byte_offset(v, write_offset[2 * LANES - 1]), vb)


cdef inline void relax_record(const blocks_t* p, const rows_t* r, const pair_t* record, int32_t kind, pair_t* lam, double* v,
                              const int64_t* write_offset, double* all_lam) noexcept nogil:
    """Update the blocks of a record; lam: its impulses, all_lam (m): those of UNPACKED blocks, v (n_bodies + 2, 6)."""
    cdef const int64_t* read_offset = <const int64_t*>record
    cdef contact_t contacts
    cdef int32_t i
    # Each branch binds only the arrays that its kind reads.
    if kind == DISK:
        bind_contact_to_record(record, DISK, &contacts)
        relax_contact_record(<const disk_t*>&contacts, read_offset, write_offset, lam, v)
    elif kind == NORMAL:
        bind_contact_to_record(record, NORMAL, &contacts)
        relax_contact_record(<const normal_t*>&contacts, read_offset, write_offset, lam, v)
    elif kind >= JOINT:
        relax_joint_record(record, kind, lam, v, write_offset)
    elif kind == UNPACKED:
        i = <int32_t>read_offset[READ_OFFSET]
        sweep_bodies(p, r, &i, 1, all_lam, v)
    else:
        bind_contact_to_record(record, kind, &contacts)
        relax_contact_record(<const other_contact_t*>&contacts, read_offset, write_offset, lam, v)
