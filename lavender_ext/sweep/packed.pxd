"""Sweeps over contacts packed two by two, in an order that hides how long one contact takes; the same bits.

A sweep waits: a contact reads the velocities that the one before on the same body wrote. Contacts that share
no body may change places without changing a bit. With level(c) = 1 + the largest level of a contact before c
on one of its bodies, all contacts of one level are free of each other, and sweep s + 1 of a body may begin
when sweep s is through with it, T levels later:

    time of contact c in sweep s = level(c) + s T,    T = max over bodies of last - first level + 1     (1)

Contacts of one slot, level mod T, share no body: they stand in pairs, one in each lane of a vector, the last
of a slot beside one of the next. Pass k visits all slots, and in each the contacts whose sweep
k - floor(level / T) is due. Every contact still sees
its bodies as in one sweep after another. Behind joints, which come first in every sweep, T is the number of
levels. A record holds what the update of core/rows.pxd reads, and the second tangent.
"""
from libc.stdint cimport int32_t, int64_t, uintptr_t

from lavender_ext.core.block cimport CONTACT, blocks_t, relax_tangents
from lavender_ext.core.rows cimport cross, relax_joint, rows_t
from lavender_ext.sweep.pair cimport LANES, all_within, gather, not_below_zero, pair_t, scatter


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
    ROOM_CONTACT = 110          # doubles: a record, as every contact may stand alone, and three int32
    ROOM_BODY = 7
    ROOM_MORE = 16
    SLOTS = 32768               # more than there are slots: level // SLOTS is the stage, the rest the slot
    MOST = 32767                # contacts, below SLOTS; with twice as many records in memory little is gained


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


cdef inline void put(pair_t* out, int32_t n, const double* x, const double* y) noexcept nogil:
    cdef int32_t k
    for k in range(n):
        out[k] = gather(x + k, y + k)


cdef inline void pack_contacts(const blocks_t* p, const rows_t* r, int32_t c, int32_t d, int32_t stage_c,
                               int32_t stage_d, const double* lam, pair_t* out) noexcept nogil:
    """The record of contacts c and d; d = c where it stands alone: the other lane then stays as it is."""
    cdef int32_t i = p.ptr[r.n_joints + c], j = p.ptr[r.n_joints + d], k, a, b, first = p.ptr[r.n_joints]
    cdef double t2[6]
    cdef double mass[4]
    cdef int64_t* place = <int64_t*>(out + R_PLACE)
    cdef double* x = <double*>out
    put(out + R_NORMAL, 3, r.normal + 3 * c, r.normal + 3 * d)
    put(out + R_TANGENT, 3, r.tangent + 3 * c, r.tangent + 3 * d)
    cross(r.normal + 3 * c, r.tangent + 3 * c, t2)
    cross(r.normal + 3 * d, r.tangent + 3 * d, t2 + 3)
    put(out + R_TANGENT_2, 3, t2, t2 + 3)
    put(out + R_ARM_A, 3, r.arm_a + 3 * c, r.arm_a + 3 * d)
    put(out + R_ARM_B, 3, r.arm_b + 3 * c, r.arm_b + 3 * d)
    put(out + R_COMPLIANCE, 3, r.compliance + i, r.compliance + j)
    put(out + R_RHS, 3, p.b + i, p.b + j)
    put(out + R_STEP, 2, p.step + i, p.step + j)
    put(out + R_MU, 1, p.mu + r.n_joints + c, p.mu + r.n_joints + d)
    put(out + R_COUPLING, 2, r.coupling + 5 * c, r.coupling + 5 * d)
    put(out + R_SWING, 18, r.swing + 6 * (i - first), r.swing + 6 * (j - first))
    put(out + R_IMPULSE, 3, lam + i, lam + j)
    for k in range(LANES):
        a = r.contact_body[2 * (c if k == 0 else d)]
        b = r.contact_body[2 * (c if k == 0 else d) + 1]
        mass[k] = r.inv_mass[a] if a >= 0 else 0.0
        mass[2 + k] = r.inv_mass[b] if b >= 0 else 0.0
        # behind the last body: zeros that are read for a static one, and a place that nobody reads
        place[k] = 6 * <int64_t>(a if a >= 0 else r.n_bodies)
        place[LANES + k] = 6 * <int64_t>(b if b >= 0 else r.n_bodies)
        place[2 * LANES + k] = 6 * <int64_t>(a if a >= 0 else r.n_bodies + 1)
        place[3 * LANES + k] = 6 * <int64_t>(b if b >= 0 else r.n_bodies + 1)
        place[4 * LANES + k] = stage_c if k == 0 else stage_d
    out[R_MASS_A] = gather(mass, mass + 1)
    out[R_MASS_B] = gather(mass + 2, mass + 3)
    if LANES > 1 and c == d:
        # no step, sticking well inside its disk
        for k in range(R_COMPLIANCE, R_MASS_A):
            x[2 * k + 1] = 1.0 if k == R_MU else 0.0
        for k in range(3):
            x[2 * (R_IMPULSE + k) + 1] = 1.0 - 0.5 * k
        for k in range(4):
            place[2 * k + 1] = 6 * <int64_t>(r.n_bodies if k < 2 else r.n_bodies + 1)


cdef inline void relax_pair(const pair_t* c, pair_t* lam, double* v, const int64_t* to_a,
                            const int64_t* to_b) noexcept nogil:
    """relax_contact of core/rows.pxd for two tangents without spin, operation by operation in each lane; lam (3)."""
    cdef const int64_t* place = <const int64_t*>(c + R_PLACE)
    cdef const double* v0 = v + place[0]
    cdef const double* v1 = v + place[LANES - 1]
    cdef double* x0
    cdef double* x1
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
    relax_pair(c, c + R_IMPULSE, v, to, to + LANES)
    for l in range(LANES):
        if not live[l]:
            for k in range(3):
                lam[LANES * k + l] = kept[3 * l + k]


cdef inline int32_t share(const rows_t* r, int32_t c, int32_t d) noexcept nogil:
    # a moving body in common
    cdef int32_t a = r.contact_body[2 * c], b = r.contact_body[2 * c + 1]
    cdef int32_t e = r.contact_body[2 * d], f = r.contact_body[2 * d + 1]
    return (a >= 0 and (a == e or a == f)) or (b >= 0 and (b == e or b == f))


cdef inline int32_t find_partner(const rows_t* r, const int32_t* contacts, int32_t kj, int32_t* line, int32_t i,
                                 int32_t end, const int32_t* level, const int32_t* ends) noexcept nogil:
    """Whether line[i + 1] may stand beside line[i]: of one slot, which ends at `end`, or, the last of it, beside
    one of the next slot that shares no body with it and is brought to the front."""
    cdef int32_t q, top
    if i + 1 < end:
        return 1
    top = ends[level[line[i + 1]] % SLOTS]
    for q in range(i + 1, top):
        if not share(r, contacts[line[i]] - kj, contacts[line[q]] - kj):
            top = line[q]
            line[q] = line[i + 1]
            line[i + 1] = top
            return 1
    return 0


cdef struct packed_t:           # the contacts of an order, packed; pointers into `room`
    int32_t pairs
    int32_t stages
    int32_t* lane               # (n_contacts) LANES * record + lane of each contact, in the order's order
    pair_t* record              # (pairs, RECORD)
    double* behind              # what follows the records


cdef inline int32_t pack_order(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t width,
                               int32_t least, double* room, const double* lam, packed_t* out) noexcept nogil:
    """Records of the contacts of order (k), joints first; 0, and none, where a slot has fewer than `least` on average.

    Any T from that of (1) on will do; a longer one, up to all levels, makes fewer stages, and slots of fewer
    contacts. T is as long as slots of `width` contacts on average allow.

    room: ROOM_CONTACT c + ROOM_BODY n_bodies + ROOM_MORE doubles.
    """
    cdef int32_t n = r.n_contacts, kj = r.n_joints
    cdef int32_t* first = <int32_t*>room
    cdef int32_t* level = first + 2 * r.n_bodies
    cdef int32_t* line = level + n                      # contacts in the order of their slots
    cdef int32_t* start = line + n                      # of each slot; then its end
    cdef int32_t i, j, k, t, top, pairs, stage
    cdef const int32_t* contacts = order + kj
    cdef pair_t* x
    t = set_levels(r, contacts, first + r.n_bodies, first, level, &top)
    if kj > 0:
        t = top
    if t < n // width:
        t = n // width if n // width < top else top
    if n < least * t:
        return 0
    for i in range(t):
        start[i] = 0
    for i in range(n):
        stage = level[i] // t
        level[i] -= stage * t
        start[level[i]] += 1
        level[i] += SLOTS * stage
    k = 0
    for i in range(t):
        j = start[i]
        start[i] = k
        k += j
    for i in range(n):
        j = level[i] % SLOTS
        line[start[j]] = i
        start[j] += 1
    room += r.n_bodies + n + n // 2 + 2
    # records begin on a multiple of 16 bytes
    out.record = <pair_t*>(room + ((<uintptr_t>room >> 3) & 1))
    out.lane = level
    out.stages = (top + t - 1) // t
    x = out.record
    pairs = 0
    i = 0
    while i < n:
        k = line[i]
        stage = level[k] // SLOTS
        j = level[k] % SLOTS
        level[k] = LANES * pairs
        if LANES > 1 and i + 1 < n and find_partner(r, contacts, kj, line, i, start[j], level, start):
            i += 1
            j = line[i]
            pack_contacts(p, r, contacts[k] - kj, contacts[j] - kj, stage, level[j] // SLOTS, lam, x)
            level[j] = LANES * pairs + 1
        else:
            pack_contacts(p, r, contacts[k] - kj, contacts[k] - kj, stage, stage, lam, x)
        pairs += 1
        i += 1
        x += RECORD
    out.pairs = pairs
    out.behind = <double*>x
    return 1


cdef inline void put_impulses(const blocks_t* p, const rows_t* r, const int32_t* order, const packed_t* packed,
                              const double* lam) noexcept nogil:
    cdef int32_t i, j, k
    cdef pair_t* x
    for i in range(r.n_contacts):
        x = packed.record + <int64_t>(packed.lane[i] // LANES) * RECORD + R_IMPULSE
        j = p.ptr[order[r.n_joints + i]]
        for k in range(3):
            (<double*>(x + k))[packed.lane[i] % LANES] = lam[j + k]


cdef inline void take_impulses(const blocks_t* p, const rows_t* r, const int32_t* order, const packed_t* packed,
                               double* lam) noexcept nogil:
    cdef int32_t i, j, k
    cdef pair_t* x
    for i in range(r.n_contacts):
        x = packed.record + <int64_t>(packed.lane[i] // LANES) * RECORD + R_IMPULSE
        j = p.ptr[order[r.n_joints + i]]
        for k in range(3):
            lam[j + k] = (<double*>(x + k))[packed.lane[i] % LANES]


cdef inline void sweep_records(const blocks_t* p, const rows_t* r, const int32_t* order, const packed_t* packed,
                               int32_t sweeps, double* lam, double* body) noexcept nogil:
    """`sweeps` sweeps over joints and records, drained at the end; body (n_bodies + 2, 6), behind the last body
    zeros. The impulses of contacts stay in the records."""
    cdef int32_t k, i, _i, stages = packed.stages
    cdef pair_t* x
    for k in range(sweeps + stages - 1):
        x = packed.record
        for i in range(r.n_joints):
            relax_joint(p, r, order[i], lam, body)
        if k < stages - 1 or k >= sweeps:
            for _i in range(packed.pairs):
                relax_due(x, body, k, sweeps, 6 * <int64_t>(r.n_bodies + 1))
                x += RECORD
        else:
            for _i in range(packed.pairs):
                relax_pair(x, x + R_IMPULSE, body, <const int64_t*>(x + R_PLACE) + 2 * LANES,
                           <const int64_t*>(x + R_PLACE) + 3 * LANES)
                x += RECORD


cdef inline void sweep_packed(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t sweeps,
                              double* room, double* lam, double* v) noexcept nogil:
    """`sweeps` sweeps over joints and contacts, order (k) of blocks; v (n_bodies, 6); room as of pack_order."""
    cdef packed_t packed
    cdef double* body
    cdef int32_t i
    pack_order(p, r, order, MOST + 1, 0, room, lam, &packed)
    body = packed.behind
    for i in range(6 * r.n_bodies):
        body[i] = v[i]
    for i in range(12):
        body[6 * r.n_bodies + i] = 0.0
    sweep_records(p, r, order, &packed, sweeps, lam, body)
    for i in range(6 * r.n_bodies):
        v[i] = body[i]
    take_impulses(p, r, order, &packed, lam)
