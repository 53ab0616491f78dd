"""Two blocks of one kind at once, one in each lane: the update of core/rows.pxd, operation by operation.

A kind is what a compiler or a branch must know: a contact's rows (a normal; with two tangents in a disk or a box; one that
spins; two that roll), or a joint's number of rows and which of its bodies move. The scalar update stays the truth; a
block of another kind, or of more rows, has the kind ALONE and is updated by it.

A record holds what an update reads, in pairs, one entry for each lane:

    header      places of both bodies in v [bytes], where read, where written; a number of its owner's; kind and size
    impulses    n
    contact     normal 3, arms 3 and 3, inverse masses 2; of each row compliance, b, step, swing 6;
                with tangents t1 3, t2 3, mu, A_t1n, A_t2n; with spin mu r, A_sn, A_st1, A_st2; of a box mu_2, A_t2t1;
                with two that roll mu_r
    joint       of each row compliance, b, step, lower, upper, J 12, M^-1 J^T 12

Where a block has no partner both lanes hold it, and what the second computes is written where nobody reads.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.core.block cimport relax_tangents
from lavender_ext.core.block_types cimport blocks_t, is_box, n_tangents, get_friction_components, friction_components_t
from lavender_ext.core.rows cimport cross, relax_rows_block
from lavender_ext.core.view cimport bodies_of, rows_t
from lavender_ext.sweep.pair cimport (LANES, all_within, any_beyond, at, both, clip_pair, gather, gather_six,
                                      not_below_zero, pair_t, scatter_six)


cdef enum:                      # kinds
    ALONE = 0
    NORMAL = 1
    SQUARE = 2                  # a box
    DISK = 3
    SPIN = 4
    ROLL = 5
    ROLL_SPIN = 6
    JOINT = 7                   # + 4 (rows - 1) + 2 where a moves + 1 where b does
    MOST_ROWS = 6
    KINDS = 31

cdef enum:                      # int64 in the header, one of each lane
    P_READ = 0                  # a, b; of a block alone its number
    P_WRITE = 2                 # a, b
    P_OWN = 4
    P_CODE = 5                  # kind + 2^8 size + 2^32 size of the record before, in pairs

cdef enum:                      # pairs
    BODY = 48                   # bytes of a velocity
    HEADER = 6
    C_NORMAL = 0                # behind the impulses of a contact
    C_ARM_A = 3
    C_ARM_B = 6
    C_MASS = 9
    C_ROW = 11                  # compliance, b, step, swing
    C_ROW_SIZE = 9
    T_MU = 6                    # behind the rows
    T_COUPLING = 7
    T_SIZE = 9
    S_SIZE = 4
    B_SIZE = 2
    J_ROW_SIZE = 29


cdef struct normal_t:           # records of contacts: the type says how many rows, so that a compiler knows
    pair_t header
cdef struct disk_t:
    pair_t header
cdef struct spin_t:
    pair_t header
cdef struct square_t:
    pair_t header
cdef struct roll_t:
    pair_t header
cdef struct roll_spin_t:
    pair_t header

ctypedef fused contact_t:
    normal_t
    disk_t
    spin_t
    square_t
    roll_t
    roll_spin_t


cdef inline int32_t kind_of(const blocks_t* p, const rows_t* r, int32_t i) noexcept nogil:
    cdef int32_t n = p.ptr[i + 1] - p.ptr[i]
    if i < r.n_joints:
        if n > MOST_ROWS:
            return ALONE
        return JOINT + 4 * (n - 1) + 2 * (r.joint_body[2 * i] >= 0) + (r.joint_body[2 * i + 1] >= 0)
    if is_box(p, i):
        return SQUARE
    return n if n == NORMAL or n_tangents(p, i) == 2 else ALONE


cdef inline int32_t rows_of(int32_t kind) noexcept nogil:
    # impulses in a record; a block alone has its own where they were
    return 3 if kind == SQUARE else kind if kind < JOINT else 1 + (kind - JOINT) // 4


cdef inline int32_t record_size(int32_t kind) noexcept nogil:
    cdef int32_t n = rows_of(kind)
    if kind >= JOINT:
        return HEADER + (1 + J_ROW_SIZE) * n
    return HEADER + (0 if kind == ALONE else n + C_ROW + C_ROW_SIZE * n
                     + (T_SIZE if n > 1 else 0) + (S_SIZE if n == SPIN or n == ROLL_SPIN else 0)
                     + (B_SIZE if kind == SQUARE else 0) + (n >= ROLL))


cdef inline void put(pair_t* out, int32_t n, const double* x, const double* y) noexcept nogil:
    cdef int32_t k
    for k in range(n):
        out[k] = gather(x + k, y + k)


cdef inline void pack_contact(const blocks_t* p, const rows_t* r, int32_t i, int32_t j, int32_t n,
                              pair_t* out) noexcept nogil:
    # out is behind the impulses
    cdef int32_t c = i - r.n_joints, d = j - r.n_joints, e = p.ptr[i], f = p.ptr[j], first = p.ptr[r.n_joints], k
    cdef const int32_t* x = r.contact_body + 2 * c
    cdef const int32_t* y = r.contact_body + 2 * d
    cdef friction_components_t part_i, part_j
    cdef double t2[6]
    cdef double m[2]
    put(out + C_NORMAL, 3, r.normal + 3 * c, r.normal + 3 * d)
    put(out + C_ARM_A, 3, r.arm_a + 3 * c, r.arm_a + 3 * d)
    put(out + C_ARM_B, 3, r.arm_b + 3 * c, r.arm_b + 3 * d)
    for k in range(2):
        m[0] = r.inv_mass[x[k]] if x[k] >= 0 else 0.0
        m[1] = r.inv_mass[y[k]] if y[k] >= 0 else 0.0
        out[C_MASS + k] = gather(m, m + 1)
    out += C_ROW
    for k in range(n):
        out[0] = gather(r.compliance + e + k, r.compliance + f + k)
        out[1] = gather(p.b + e + k, p.b + f + k)
        out[2] = gather(p.step + e + k, p.step + f + k)
        put(out + 3, 6, r.inv_inertia_arm + 6 * (e - first + k), r.inv_inertia_arm + 6 * (f - first + k))
        out += C_ROW_SIZE
    if n == NORMAL:
        return
    put(out, 3, r.tangent + 3 * c, r.tangent + 3 * d)
    cross(r.normal + 3 * c, r.tangent + 3 * c, t2)
    cross(r.normal + 3 * d, r.tangent + 3 * d, t2 + 3)
    put(out + 3, 3, t2, t2 + 3)
    get_friction_components(p, i, &part_i)
    get_friction_components(p, j, &part_j)
    out[T_MU] = gather(part_i.friction_coefficient, part_j.friction_coefficient)
    put(out + T_COUPLING, 2, r.coupling + 5 * c, r.coupling + 5 * d)
    out += T_SIZE
    if n == SPIN or n == ROLL_SPIN or is_box(p, i):
        out[0] = gather(part_i.friction_coefficient + 1, part_j.friction_coefficient + 1)
        if is_box(p, i):
            m[0] = r.coupling[5 * c + 2] * p.step[e + 2]
            m[1] = r.coupling[5 * d + 2] * p.step[f + 2]
            out[1] = gather(m, m + 1)
            return
        put(out + 1, 3, r.coupling + 5 * c + 2, r.coupling + 5 * d + 2)
        out += S_SIZE
    if n >= ROLL:
        out[0] = gather(part_i.friction_coefficient + part_i.n - 1, part_j.friction_coefficient + part_j.n - 1)


cdef inline void pack_joint(const blocks_t* p, const rows_t* r, int32_t i, int32_t j, int32_t n,
                            pair_t* out) noexcept nogil:
    cdef int32_t _k, e = p.ptr[i], f = p.ptr[j]
    for _k in range(n):
        out[0] = gather(r.compliance + e, r.compliance + f)
        out[1] = gather(p.b + e, p.b + f)
        out[2] = gather(p.step + e, p.step + f)
        out[3] = gather(p.lower + e, p.lower + f)
        out[4] = gather(p.upper + e, p.upper + f)
        put(out + 5, 12, r.jac + 12 * e, r.jac + 12 * f)
        put(out + 17, 12, r.minv_jac + 12 * e, r.minv_jac + 12 * f)
        out += J_ROW_SIZE
        e += 1
        f += 1


cdef inline void pack_blocks(const blocks_t* p, const rows_t* r, int32_t kind, int32_t i, int32_t j, int64_t own_i,
                             int64_t own_j, const double* lam, pair_t* out) noexcept nogil:
    """The record of blocks i and j of one kind but for its code; j = i where it stands without a partner."""
    cdef int64_t* place = <int64_t*>out
    cdef const int32_t* x
    cdef int32_t k, l, n = rows_of(kind)
    place[P_OWN * LANES] = own_i
    place[P_OWN * LANES + LANES - 1] = own_j if LANES > 1 else own_i
    if kind == ALONE:
        place[P_READ] = i
        return
    for l in range(LANES):
        x = bodies_of(r, i if l == 0 else j)
        for k in range(2):
            # behind the last body: zeros that are read for a static one, and a place that nobody reads
            place[(P_READ + k) * LANES + l] = BODY * <int64_t>(x[k] if x[k] >= 0 else r.n_bodies)
            place[(P_WRITE + k) * LANES + l] = BODY * <int64_t>(x[k] if x[k] >= 0 and (l == 0 or i != j) else r.n_bodies + 1)
    put(out + HEADER, n, lam + p.ptr[i], lam + p.ptr[j])
    if kind >= JOINT:
        pack_joint(p, r, i, j, n, out + HEADER + n)
    else:
        pack_contact(p, r, i, j, n, out + HEADER + n)


cdef inline pair_t dot_pair(const pair_t* x, const pair_t* y) noexcept nogil:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


cdef inline void project_tangents(pair_t* x, pair_t radius) noexcept nogil:
    """(3) of core/block.pxd, the step being taken; lane by lane where one slides."""
    cdef pair_t square = x[0] * x[0] + x[1] * x[1]
    cdef double* lane = <double*>x
    cdef double two[2]
    cdef double none[2]
    cdef int32_t l
    if all_within(square, radius * radius):
        return
    for l in range(LANES):
        two[0] = lane[l]
        two[1] = lane[LANES + l]
        none[0] = 0.0
        none[1] = 0.0
        relax_tangents(two, none, 0.0, (<double*>&radius)[l], 2)
        lane[l] = two[0]
        lane[LANES + l] = two[1]


cdef inline void relax_contact_lanes(const contact_t* c, pair_t* lam, double* v, const int64_t* to) noexcept nogil:
    """relax_contact of core/rows.pxd for no tangents or two, then relax_rolling; lam (1 + nt + spin + roll), to: where a and
    b are written."""
    cdef int32_t nt = 0 if contact_t is normal_t else 2, spin = 1 if contact_t is spin_t or contact_t is roll_spin_t else 0
    cdef int32_t roll = 2 if contact_t is roll_t or contact_t is roll_spin_t else 0
    cdef const int64_t* place = <const int64_t*>c
    cdef const pair_t* n = <const pair_t*>c + HEADER + 1 + nt + spin + roll
    cdef const pair_t* q = n + C_ARM_A
    cdef const pair_t* row = n + C_ROW
    cdef const pair_t* t = row + C_ROW_SIZE * (1 + nt + spin + roll)
    cdef pair_t a[6]
    cdef pair_t b[6]
    cdef pair_t u[3]
    cdef pair_t turn[3]
    cdef pair_t x[2]
    cdef pair_t d0 = both(0.0), d1 = d0, ds = d0, y, z, dn, normal, impulse, swing_a, swing_b
    cdef int32_t k
    gather_six(at(v, place[0]), at(v, place[LANES - 1]), a)
    gather_six(at(v, place[LANES]), at(v, place[2 * LANES - 1]), b)
    u[0] = (b[0] + (b[4] * q[5] - b[5] * q[4])) - (a[0] + (a[4] * q[2] - a[5] * q[1]))
    u[1] = (b[1] + (b[5] * q[3] - b[3] * q[5])) - (a[1] + (a[5] * q[0] - a[3] * q[2]))
    u[2] = (b[2] + (b[3] * q[4] - b[4] * q[3])) - (a[2] + (a[3] * q[1] - a[4] * q[0]))
    y = not_below_zero(lam[0] - (dot_pair(n, u) + (row[0] * lam[0] - row[1])) * row[2])
    dn = y - lam[0]
    lam[0] = y
    normal = y
    if nt > 0:
        row += C_ROW_SIZE
        d0 = lam[1]
        x[0] = d0 - ((dot_pair(t, u) + (row[0] * d0 - row[1])) + t[T_COUPLING] * dn) * row[2]
        z = row[2]                                      # one step for both
        row += C_ROW_SIZE
        d1 = lam[2]
        x[1] = (dot_pair(t + 3, u) + (row[0] * d1 - row[1])) + t[T_COUPLING + 1] * dn
        if contact_t is square_t:
            z = t[T_MU] * y
            # What the first moved comes last; one that holds is not clipped, so that nothing waits for its bound.
            x[1] = d1 - x[1] * row[2]
            if any_beyond(x[0], z):
                x[0] = clip_pair(x[0], -z, z)
            x[1] = x[1] - (x[0] - d0) * t[T_SIZE + 1]
            z = t[T_SIZE] * y
            if any_beyond(x[1], z):
                x[1] = clip_pair(x[1], -z, z)
        else:
            x[1] = d1 - x[1] * z
            project_tangents(x, t[T_MU] * y)
        lam[1] = x[0]
        lam[2] = x[1]
        d0 = x[0] - d0
        d1 = x[1] - d1
    if spin:
        row += C_ROW_SIZE
        for k in range(3):
            turn[k] = b[3 + k] - a[3 + k]
        ds = lam[3]
        z = dot_pair(n, turn) + (row[0] * ds - row[1])
        z = z + t[T_SIZE + 1] * dn + t[T_SIZE + 2] * d0 + t[T_SIZE + 3] * d1
        y = t[T_SIZE] * y
        y = clip_pair(ds - z * row[2], -y, y)
        lam[3] = y
        ds = y - ds
    row = n + C_ROW + 3                                 # swing
    for k in range(3):
        impulse = dn * n[k]
        swing_a = dn * row[k]
        swing_b = dn * row[3 + k]
        if nt > 0:
            impulse = impulse + d0 * t[k] + d1 * t[3 + k]
            swing_a = swing_a + d0 * row[C_ROW_SIZE + k] + d1 * row[2 * C_ROW_SIZE + k]
            swing_b = swing_b + d0 * row[C_ROW_SIZE + 3 + k] + d1 * row[2 * C_ROW_SIZE + 3 + k]
        if spin:
            swing_a = swing_a + ds * row[3 * C_ROW_SIZE + k]
            swing_b = swing_b + ds * row[3 * C_ROW_SIZE + 3 + k]
        a[k] = a[k] - n[C_MASS] * impulse
        a[3 + k] = a[3 + k] - swing_a
        b[k] = b[k] + n[C_MASS + 1] * impulse
        b[3 + k] = b[3 + k] + swing_b
    if roll:
        for k in range(3):
            turn[k] = b[3 + k] - a[3 + k]
        row = n + C_ROW + C_ROW_SIZE * (1 + nt + spin)
        lam += 1 + nt + spin
        d0 = lam[0]
        d1 = lam[1]
        z = row[2]                                      # one step for both
        x[0] = d0 - (dot_pair(t, turn) + (row[0] * d0 - row[1])) * z
        x[1] = d1 - (dot_pair(t + 3, turn) + (row[C_ROW_SIZE] * d1 - row[C_ROW_SIZE + 1])) * z
        project_tangents(x, t[T_SIZE + (S_SIZE if spin else 0)] * normal)
        lam[0] = x[0]
        lam[1] = x[1]
        d0 = x[0] - d0
        d1 = x[1] - d1
        row += 3
        for k in range(3):
            a[3 + k] = a[3 + k] - (d0 * row[k] + d1 * row[C_ROW_SIZE + k])
            b[3 + k] = b[3 + k] + (d0 * row[3 + k] + d1 * row[C_ROW_SIZE + 3 + k])
    scatter_six(at(v, to[0]), at(v, to[LANES - 1]), a)
    scatter_six(at(v, to[LANES]), at(v, to[2 * LANES - 1]), b)


cdef inline void relax_joint_lanes(const pair_t* c, int32_t kind, pair_t* lam, double* v, const int64_t* to) noexcept nogil:
    """relax_joint of core/rows.pxd."""
    cdef const int64_t* place = <const int64_t*>c
    cdef int32_t i, k, n = rows_of(kind), moves_a = (kind - JOINT) & 2, moves_b = (kind - JOINT) & 1
    cdef const pair_t* row = c + HEADER + n
    cdef pair_t a[6]
    cdef pair_t b[6]
    cdef pair_t s, t, y
    gather_six(at(v, place[0]), at(v, place[LANES - 1]), a)
    gather_six(at(v, place[LANES]), at(v, place[2 * LANES - 1]), b)
    for i in range(n):
        s = both(0.0)
        t = both(0.0)
        if moves_a:
            for k in range(6):
                s = s + row[5 + k] * a[k]
        if moves_b:
            for k in range(6):
                t = t + row[11 + k] * b[k]
        y = clip_pair(lam[i] - (((s + t) + row[0] * lam[i]) - row[1]) * row[2], row[3], row[4])
        s = y - lam[i]
        lam[i] = y
        if moves_a:
            for k in range(6):
                a[k] = a[k] + s * row[17 + k]
        if moves_b:
            for k in range(6):
                b[k] = b[k] + s * row[23 + k]
        row += J_ROW_SIZE
    scatter_six(at(v, to[0]), at(v, to[LANES - 1]), a)
    scatter_six(at(v, to[LANES]), at(v, to[2 * LANES - 1]), b)


cdef inline void relax_record(const blocks_t* p, const rows_t* r, const pair_t* c, int32_t kind, pair_t* lam, double* v,
                              const int64_t* to, double* all_lam) noexcept nogil:
    """The blocks of a record; lam its impulses, all_lam (m) those of blocks alone, v (n_bodies + 2, 6)."""
    if kind == DISK:
        relax_contact_lanes(<const disk_t*>c, lam, v, to)
    elif kind == NORMAL:
        relax_contact_lanes(<const normal_t*>c, lam, v, to)
    elif kind == SQUARE:
        relax_contact_lanes(<const square_t*>c, lam, v, to)
    elif kind == SPIN:
        relax_contact_lanes(<const spin_t*>c, lam, v, to)
    elif kind == ROLL:
        relax_contact_lanes(<const roll_t*>c, lam, v, to)
    elif kind == ROLL_SPIN:
        relax_contact_lanes(<const roll_spin_t*>c, lam, v, to)
    elif kind >= JOINT:
        relax_joint_lanes(c, kind, lam, v, to)
    else:
        relax_rows_block(p, r, <int32_t>(<const int64_t*>c)[P_READ], all_lam, v)
