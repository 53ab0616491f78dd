"""Sweeps over contacts packed two by two, in an order that hides how long one contact takes; the same bits.

A sweep waits: a contact reads the velocities that the one before on the same body wrote. Contacts that share
no body may change places without changing a bit. With level(c) = 1 + the largest level of a contact before c
on one of its bodies, all contacts of one level are free of each other, and sweep s + 1 of a body may begin
when sweep s is through with it, T levels later:

    time of contact c in sweep s = level(c) + s T,    T = max over bodies of last - first level + 1     (1)

Contacts of one slot, level mod T, share no body: they stand in pairs, one in each lane of a vector. Pass k
visits all slots, and in each the contacts whose sweep k - floor(level / T) is due. Every contact still sees
its bodies as in one sweep after another. Behind joints, which come first in every sweep, T is the number of
levels. A record holds what the update of rows.pxd reads, and the second tangent.
"""
from libc.stdint cimport int32_t, int64_t, uintptr_t

from lavender_ext.block cimport CONTACT, blocks_t, relax_tangents
from lavender_ext.pair cimport LANES, all_within, gather, not_below_zero, pair_t, scatter
from lavender_ext.rows cimport cross, relax_joint, rows_t


cdef enum:                      # one record, in pairs
    R_NORMAL = 0
    R_TANGENT = 3
    R_TANGENT_2 = 6
    R_ARM_A = 9
    R_ARM_B = 12
    R_COMPLIANCE = 15
    R_RHS = 18
    R_STEP = 21                 # of the normal, of the tangents
    R_MU = 23
    R_COUPLING = 24             # A_t1n, A_t2n
    R_MASS_A = 26               # 1/kg
    R_MASS_B = 27
    R_SWING = 28                # (3, 6)
    R_IMPULSE = 46
    R_PLACE = 49                # int64, of each lane: where a, b are read; where they are written; stage
    RECORD = 54
    ROOM_CONTACT = 109          # doubles: a record, as every slot may hold one contact alone, and two int32
    ROOM_BODY = 7
    ROOM_MORE = 16
    SLOTS = 32768               # more than there are slots: level // SLOTS is the stage, the rest the slot
    MOST = 20000                # contacts; more records than a second-level cache holds gain nothing


cdef inline int32_t packs(const blocks_t* p, const rows_t* r) noexcept nogil:
    # contacts with two tangents and no spin alone
    cdef int32_t i
    if not 0 < r.n_contacts <= MOST:
        return 0
    for i in range(r.n_joints, p.n_blocks):
        if p.kind[i] != CONTACT or p.ptr[i + 1] - p.ptr[i] != 3:
            return 0
    return 1


cdef inline int32_t set_levels(const rows_t* r, const int32_t* order, int32_t* last, int32_t* first,
                               int32_t* level, int32_t* top) noexcept nogil:
    """Level of the contacts order (c) into level (c), how many there are into top; returns T of (1)."""
    cdef int32_t i, c, a, b, l, t = 1, most = 0
    for i in range(r.n_bodies):
        last[i] = 0
        first[i] = -1
    for i in range(r.n_contacts):
        c = order[i] - r.n_joints
        a = r.contact_body[2 * c]
        b = r.contact_body[2 * c + 1]
        l = last[a] if a >= 0 else 0
        if b >= 0 and last[b] > l:
            l = last[b]
        level[i] = l
        if a >= 0:
            last[a] = l + 1
            if first[a] < 0:
                first[a] = l
        if b >= 0:
            last[b] = l + 1
            if first[b] < 0:
                first[b] = l
        if l >= most:
            most = l + 1
    for i in range(r.n_bodies):
        if first[i] >= 0 and last[i] - first[i] > t:
            t = last[i] - first[i]
    top[0] = most
    return t


cdef inline void put3(double* out, int32_t field, const double* x) noexcept nogil:
    # three entries of one lane; out is at the lane
    cdef int32_t k
    for k in range(3):
        out[LANES * (field + k)] = x[k]


cdef inline void pack_contact(const blocks_t* p, const rows_t* r, int32_t c, const double* lam, int32_t stage,
                              double* out, int64_t* place) noexcept nogil:
    cdef int32_t i = r.n_joints + c, j = p.ptr[i], k, a = r.contact_body[2 * c], b = r.contact_body[2 * c + 1]
    cdef double t2[3]
    cdef const double* swing = r.swing + 6 * (j - p.ptr[r.n_joints])
    put3(out, R_NORMAL, r.normal + 3 * c)
    put3(out, R_TANGENT, r.tangent + 3 * c)
    cross(r.normal + 3 * c, r.tangent + 3 * c, t2)
    put3(out, R_TANGENT_2, t2)
    put3(out, R_ARM_A, r.arm_a + 3 * c)
    put3(out, R_ARM_B, r.arm_b + 3 * c)
    put3(out, R_COMPLIANCE, r.compliance + j)
    put3(out, R_RHS, p.b + j)
    put3(out, R_IMPULSE, lam + j)
    for k in range(6):
        put3(out, R_SWING + 3 * k, swing + 3 * k)
    out[LANES * R_STEP] = p.step[j]
    out[LANES * (R_STEP + 1)] = p.step[j + 1]
    out[LANES * R_MU] = p.mu[i]
    out[LANES * R_COUPLING] = r.coupling[5 * c]
    out[LANES * (R_COUPLING + 1)] = r.coupling[5 * c + 1]
    out[LANES * R_MASS_A] = r.inv_mass[a] if a >= 0 else 0.0
    out[LANES * R_MASS_B] = r.inv_mass[b] if b >= 0 else 0.0
    # behind the last body: zeros that are read for a static one, and a place that nobody reads
    place[0] = 6 * <int64_t>(a if a >= 0 else r.n_bodies)
    place[LANES] = 6 * <int64_t>(b if b >= 0 else r.n_bodies)
    place[2 * LANES] = 6 * <int64_t>(a if a >= 0 else r.n_bodies + 1)
    place[3 * LANES] = 6 * <int64_t>(b if b >= 0 else r.n_bodies + 1)
    place[4 * LANES] = stage


cdef inline void pack_nothing(const rows_t* r, double* out, int64_t* place) noexcept nogil:
    # a lane that stays as it is: no step, sticking well inside its disk
    cdef int32_t k
    for k in range(R_PLACE):
        out[LANES * k] = 0.0
    out[LANES * R_MU] = 1.0
    out[LANES * R_IMPULSE] = 1.0
    out[LANES * (R_IMPULSE + 1)] = 0.5
    for k in range(2):
        place[k * LANES] = 6 * <int64_t>r.n_bodies
        place[(2 + k) * LANES] = 6 * <int64_t>(r.n_bodies + 1)
    place[4 * LANES] = 0


cdef inline void relax_pair(pair_t* c, double* v, const int64_t* to_a, const int64_t* to_b) noexcept nogil:
    """relax_contact of rows.pxd for two tangents without spin, operation by operation in each lane."""
    cdef const int64_t* place = <const int64_t*>(c + R_PLACE)
    cdef const double* v0 = v + place[0]
    cdef const double* v1 = v + place[LANES - 1]
    cdef double* x0
    cdef double* x1
    cdef pair_t* lam = c + R_IMPULSE
    cdef const pair_t* n = c + R_NORMAL
    cdef const pair_t* t1 = c + R_TANGENT
    cdef const pair_t* t2 = c + R_TANGENT_2
    cdef const pair_t* q = c + R_ARM_A
    cdef const pair_t* s = c + R_SWING
    cdef pair_t a[6]
    cdef pair_t b[6]
    cdef pair_t u[3]
    cdef pair_t w[2]
    cdef pair_t x[2]
    cdef double one[2]
    cdef double both[2]
    cdef double* lane
    cdef pair_t y, dn, d0, d1, radius, p0, p1, p2, square
    cdef int32_t k
    for k in range(6):
        a[k] = gather(v0 + k, v1 + k)
    v0 = v + place[LANES]
    v1 = v + place[2 * LANES - 1]
    for k in range(6):
        b[k] = gather(v0 + k, v1 + k)
    u[0] = (b[0] + (b[4] * q[5] - b[5] * q[4])) - (a[0] + (a[4] * q[2] - a[5] * q[1]))
    u[1] = (b[1] + (b[5] * q[3] - b[3] * q[5])) - (a[1] + (a[5] * q[0] - a[3] * q[2]))
    u[2] = (b[2] + (b[3] * q[4] - b[4] * q[3])) - (a[2] + (a[3] * q[1] - a[4] * q[0]))
    y = (n[0] * u[0] + n[1] * u[1] + n[2] * u[2]) + (c[R_COMPLIANCE] * lam[0] - c[R_RHS])
    y = not_below_zero(lam[0] - y * c[R_STEP])
    dn = y - lam[0]
    lam[0] = y
    w[0] = ((t1[0] * u[0] + t1[1] * u[1] + t1[2] * u[2])
            + (c[R_COMPLIANCE + 1] * lam[1] - c[R_RHS + 1])) + c[R_COUPLING] * dn
    w[1] = ((t2[0] * u[0] + t2[1] * u[1] + t2[2] * u[2])
            + (c[R_COMPLIANCE + 2] * lam[2] - c[R_RHS + 2])) + c[R_COUPLING + 1] * dn
    d0 = lam[1]
    d1 = lam[2]
    x[0] = d0 - w[0] * c[R_STEP + 1]
    x[1] = d1 - w[1] * c[R_STEP + 1]
    square = x[0] * x[0] + x[1] * x[1]
    radius = c[R_MU] * y
    if not all_within(square, radius * radius):
        # lane by lane; the step was taken
        lane = <double*>&x[0]
        for k in range(LANES):
            both[0] = lane[k]
            both[1] = lane[LANES + k]
            one[0] = 0.0
            one[1] = 0.0
            relax_tangents(both, one, 0.0, (<double*>&radius)[k], 2)
            lane[k] = both[0]
            lane[LANES + k] = both[1]
    lam[1] = x[0]
    lam[2] = x[1]
    d0 = x[0] - d0
    d1 = x[1] - d1
    p0 = dn * n[0] + d0 * t1[0] + d1 * t2[0]
    p1 = dn * n[1] + d0 * t1[1] + d1 * t2[1]
    p2 = dn * n[2] + d0 * t1[2] + d1 * t2[2]
    x0 = v + to_a[0]
    x1 = v + to_a[LANES - 1]
    scatter(x0, x1, a[0] - c[R_MASS_A] * p0)
    scatter(x0 + 1, x1 + 1, a[1] - c[R_MASS_A] * p1)
    scatter(x0 + 2, x1 + 2, a[2] - c[R_MASS_A] * p2)
    for k in range(3):
        scatter(x0 + 3 + k, x1 + 3 + k, a[3 + k] - (dn * s[k] + d0 * s[6 + k] + d1 * s[12 + k]))
    x0 = v + to_b[0]
    x1 = v + to_b[LANES - 1]
    scatter(x0, x1, b[0] + c[R_MASS_B] * p0)
    scatter(x0 + 1, x1 + 1, b[1] + c[R_MASS_B] * p1)
    scatter(x0 + 2, x1 + 2, b[2] + c[R_MASS_B] * p2)
    for k in range(3):
        scatter(x0 + 3 + k, x1 + 3 + k, b[3 + k] + (dn * s[3 + k] + d0 * s[9 + k] + d1 * s[15 + k]))


cdef inline void relax_due(pair_t* c, double* v, int32_t pass_, int32_t sweeps, int64_t nowhere) noexcept nogil:
    # relax_pair where a lane may not be due: it writes nowhere and keeps its impulse
    cdef const int64_t* place = <const int64_t*>(c + R_PLACE)
    cdef double* lam = <double*>(c + R_IMPULSE)
    cdef int64_t to[4]
    cdef double kept[6]
    cdef int32_t live[2]
    cdef int32_t k, l, n = 0
    for l in range(LANES):
        live[l] = 0 <= pass_ - place[4 * LANES + l] < sweeps
        n += live[l]
        to[l] = place[2 * LANES + l] if live[l] else nowhere
        to[LANES + l] = place[3 * LANES + l] if live[l] else nowhere
        for k in range(3):
            kept[3 * l + k] = lam[LANES * k + l]
    if n == 0:
        return
    relax_pair(c, v, to, to + LANES)
    for l in range(LANES):
        if not live[l]:
            for k in range(3):
                lam[LANES * k + l] = kept[3 * l + k]


cdef inline void sweep_packed(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t sweeps,
                              double* room, double* lam, double* v) noexcept nogil:
    """`sweeps` sweeps over joints and contacts, order (k) of blocks; v (n_bodies, 6).

    room: ROOM_CONTACT c + ROOM_BODY n_bodies + ROOM_MORE doubles, scratch.
    """
    cdef int32_t n = r.n_contacts, kj = r.n_joints
    cdef int32_t* first = <int32_t*>room
    cdef int32_t* level = first + 2 * r.n_bodies
    cdef int32_t* start = level + n
    cdef int32_t i, _i, j, k, l, t, top, stages, pairs, stage
    cdef const int32_t* contacts = order + kj
    cdef pair_t* record
    cdef pair_t* x
    cdef double* body
    t = set_levels(r, contacts, first + r.n_bodies, first, level, &top)
    if kj > 0:
        t = top
    stages = (top + t - 1) // t
    for i in range(t):
        start[i] = 0
    for i in range(n):
        stage = level[i] // t
        level[i] -= stage * t
        start[level[i]] += 1
        level[i] += SLOTS * stage
    pairs = 0
    for i in range(t):
        k = start[i]
        start[i] = LANES * pairs                        # place of the slot's next contact
        pairs += (k + LANES - 1) // LANES
    room += r.n_bodies + n + 1
    # records begin on a multiple of 16 bytes
    record = <pair_t*>(room + ((<uintptr_t>room >> 3) & 1))
    body = <double*>(record + <int64_t>pairs * RECORD)
    for i in range(n):
        stage = level[i] // SLOTS
        j = level[i] % SLOTS
        k = start[j]
        start[j] += 1
        level[i] = k
        x = record + <int64_t>(k // LANES) * RECORD
        l = k % LANES
        pack_contact(p, r, contacts[i] - kj, lam, stage, <double*>x + l, <int64_t*>(x + R_PLACE) + l)
    for i in range(t):
        k = start[i]
        if k % LANES != 0:
            x = record + <int64_t>(k // LANES) * RECORD
            pack_nothing(r, <double*>x + 1, <int64_t*>(x + R_PLACE) + 1)
    for i in range(6 * r.n_bodies):
        body[i] = v[i]
    for i in range(12):
        body[6 * r.n_bodies + i] = 0.0
    for k in range(sweeps + stages - 1):
        x = record
        for i in range(kj):
            relax_joint(p, r, order[i], lam, body)
        if k < stages - 1 or k >= sweeps:
            for _i in range(pairs):
                relax_due(x, body, k, sweeps, 6 * <int64_t>(r.n_bodies + 1))
                x += RECORD
        else:
            for _i in range(pairs):
                relax_pair(x, body, <const int64_t*>(x + R_PLACE) + 2 * LANES,
                           <const int64_t*>(x + R_PLACE) + 3 * LANES)
                x += RECORD
    for i in range(6 * r.n_bodies):
        v[i] = body[i]
    for i in range(n):
        x = record + <int64_t>(level[i] // LANES) * RECORD + R_IMPULSE
        j = p.ptr[contacts[i]]
        for k in range(3):
            lam[j + k] = (<double*>(x + k))[level[i] % LANES]
