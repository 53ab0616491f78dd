"""Sweeps over blocks packed two by two, in an order that hides how long one block takes; the same bits.

A sweep waits: a block reads the velocities that the one before on the same body wrote. Blocks that share no body
may change places without changing a bit. With level(c) = 1 + the largest level of a block before c on one of its
bodies, all blocks of one level are free of each other, and sweep s + 1 of a body may begin when sweep s is through
with it, T levels later:

    time of block c in sweep s = level(c) + s T,    T = max over bodies of last - first level + 1     (1)

Joints and contacts alike. Blocks of one slot, level mod T, share no body: those of one kind stand in pairs, one in
each lane of a vector, the last of a slot beside one of the next. Pass k visits all slots, and in each the blocks
whose sweep k - floor(level / T) is due. Every block still sees its bodies as in one sweep after another.

Levels may begin anywhere. A body whose first block is early and whose others are late (a joint, swept first, on top of
a tower) begins later, so that T is near the largest number of blocks of one body. Parts of a scene that share no body
fill the same slots: none waits for another.
"""
from libc.stdint cimport int32_t, int64_t, uintptr_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.view cimport bodies_of, rows_t
from lavender_ext.sweep.lanes cimport (ALONE, BODY, HEADER, KINDS, MOST_ROWS, P_CODE, P_OWN, P_WRITE, kind_of, pack_blocks,
                                       record_size, relax_record, rows_of)
from lavender_ext.sweep.pair cimport LANES, pair_t


cdef enum:                      # doubles of workspace: records, as every block may stand alone, and four int32
    ROOM_CONTACT = 27
    ROOM_CONTACT_ROW = 29
    ROOM_JOINT = 14
    ROOM_JOINT_ROW = 60
    ROOM_BODY = 8
    ROOM_MORE = 16
    SLOTS = 32768               # more than there are slots: level // SLOTS is the stage, the rest the slot
    MOST = 32767                # blocks, below SLOTS; with twice as many records in memory little is gained
    LEAST = 2                   # blocks of a slot: fewer, and pairs would stand half empty
    WIDTH = 6                   # blocks of a slot: pairs enough to hide how long one takes
    ROUNDS = 3                  # of moving late what begins too early


cdef struct packed_t:           # the blocks of an order, packed; pointers into `workspace`
    int32_t pairs
    int32_t stages
    int32_t* lane               # (k) LANES * place of the record + lane of each block, in the order's order
    pair_t* record
    pair_t* last                # record
    pair_t* last_joint          # with one level of contacts behind those of joints,
    pair_t* contacts            # and the first record of contacts
    double* behind              # what follows the records


cdef struct plan_t:             # bodies and blocks on the way to it
    int32_t* last               # (n_bodies) level behind the last block so far
    int32_t* first              # (n_bodies) of the first, -1 without one
    int32_t* early              # (n_bodies) where levels may begin
    int32_t* count              # (n_bodies) blocks
    int32_t* level              # (k)
    int32_t* line               # (k) blocks in the order of their slots
    int32_t* kind               # (k)
    int32_t* slot               # (T) first place in line, then the end
    int32_t single              # one sweep at a time


cdef inline int64_t allocate_workspace(int64_t joints, int64_t joint_rows, int64_t contacts, int64_t contact_rows,
                             int64_t bodies) noexcept nogil:
    """Doubles that `pack_order` asks for."""
    return (ROOM_JOINT * joints + ROOM_JOINT_ROW * joint_rows + ROOM_CONTACT * contacts
            + ROOM_CONTACT_ROW * contact_rows + ROOM_BODY * bodies + ROOM_MORE)


cdef inline int64_t room_of(const blocks_t* p, const rows_t* r) noexcept nogil:
    cdef int32_t first = p.ptr[r.n_joints]
    return allocate_workspace(r.n_joints, first, r.n_contacts, p.n_rows - first, r.n_bodies)


cdef inline int32_t set_levels(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t apart, plan_t* x,
                               int32_t* top) noexcept nogil:
    """Levels of the blocks order (k), how many there are into top; returns T of (1). Those of blocks from `apart` on
    begin behind all others."""
    cdef int32_t i, a, b, l, t = 1, most = 0, least = 0
    cdef const int32_t* body
    for i in range(r.n_bodies):
        x.last[i] = x.early[i]
        x.first[i] = -1
        x.count[i] = 0
    for i in range(p.n_blocks):
        if i == apart:
            least = most
        body = bodies_of(r, order[i])
        a = body[0]
        b = body[1]
        l = least
        if a >= 0 and x.last[a] > l:
            l = x.last[a]
        if b >= 0 and x.last[b] > l:
            l = x.last[b]
        x.level[i] = l
        if a >= 0:
            x.last[a] = l + 1
            x.count[a] += 1
            if x.first[a] < 0:
                x.first[a] = l
        if b >= 0:
            x.last[b] = l + 1
            x.count[b] += 1
            if x.first[b] < 0:
                x.first[b] = l
        if l >= most:
            most = l + 1
    for i in range(r.n_bodies):
        if x.first[i] >= 0 and x.last[i] - x.first[i] > t:
            t = x.last[i] - x.first[i]
    top[0] = most
    return t


cdef inline int32_t shorten(const blocks_t* p, const rows_t* r, const int32_t* order, plan_t* x, int32_t t,
                            int32_t* top) noexcept nogil:
    """Levels with a shorter T than t, if some body's blocks need not stand so far apart."""
    cdef int32_t i, least = p.n_blocks // WIDTH, _round
    for i in range(r.n_bodies):
        if x.count[i] > least:
            least = x.count[i]
    for _round in range(ROUNDS):
        if t <= least:
            break
        for i in range(r.n_bodies):
            if x.first[i] >= 0 and x.last[i] - x.first[i] > least:
                x.early[i] = x.last[i] - least
        t = set_levels(p, r, order, p.n_blocks, x, top)
    return t


cdef inline int32_t set_slots(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t t,
                              plan_t* x) noexcept nogil:
    """The line by slot and kind, levels as slot and stage; 0 where most blocks would stand alone."""
    cdef int32_t i, j, k = 0, stage, kind, alone = 0, n = p.n_blocks
    cdef int32_t kinds = 0
    for i in range(t):
        x.slot[i] = 0
    for i in range(n):
        stage = x.level[i] // t
        x.level[i] -= stage * t
        x.slot[x.level[i]] += 1
        x.level[i] += SLOTS * stage
        kind = kind_of(p, r, order[i])
        alone += kind == ALONE
        x.kind[i] = kind
        kinds |= 1 << kind
    if 2 * alone > n:
        return 0
    for i in range(t):
        j = x.slot[i]
        x.slot[i] = k
        k += j
    for kind in range(KINDS):
        if kinds >> kind & 1:
            for i in range(n):
                if x.kind[i] == kind:
                    j = x.level[i] % SLOTS
                    x.line[x.slot[j]] = i
                    x.slot[j] += 1
    return 1


cdef inline int32_t share(const int32_t* x, const int32_t* y) noexcept nogil:
    # a moving body in common
    return (x[0] >= 0 and (x[0] == y[0] or x[0] == y[1])) or (x[1] >= 0 and (x[1] == y[0] or x[1] == y[1]))


cdef inline int32_t find_partner(const rows_t* r, const int32_t* order, const plan_t* x, const int32_t* odd, int32_t n_odd,
                                 int32_t begin, int32_t end) noexcept nogil:
    """A block of the next slot, line[begin:end], that may stand beside odd[0]: of its kind, without a body in common with
    any of odd (n_odd), which come before it; or -1."""
    cdef int32_t i, k, c
    for i in range(begin, end):
        c = x.line[i]
        if x.kind[c] != x.kind[odd[0]]:
            continue
        for k in range(n_odd):
            if share(bodies_of(r, order[c]), bodies_of(r, order[odd[k]])):
                break
        else:
            return c
    return -1


cdef inline void put_record(const blocks_t* p, const rows_t* r, const int32_t* order, const double* lam, plan_t* x,
                            int32_t i, int32_t j, packed_t* out) noexcept nogil:
    """Blocks order[i] and order[j], j < 0 where it has no partner, behind the records so far."""
    cdef pair_t* next_ = <pair_t*>out.behind
    cdef int32_t kind = x.kind[i], at = LANES * <int32_t>(next_ - out.record), size = record_size(kind)
    cdef int64_t before = next_ - out.last
    cdef int32_t k = i if j < 0 else j
    if x.single:                                        # where impulses are, or the stage
        pack_blocks(p, r, kind, order[i], order[k], p.ptr[order[i]], p.ptr[order[k]], lam, next_)
    else:
        pack_blocks(p, r, kind, order[i], order[k], x.level[i] // SLOTS, x.level[k] // SLOTS, lam, next_)
    if j >= 0:
        x.level[j] = at + 1
        x.kind[j] = -1
    (<int64_t*>next_)[P_CODE * LANES] = kind + (<int64_t>size << 8) + (before << 32)
    x.level[i] = at
    x.kind[i] = -1
    out.last = next_
    out.behind = <double*>(next_ + size)
    out.pairs += 1


cdef inline void put_slot(const blocks_t* p, const rows_t* r, const int32_t* order, const double* lam, plan_t* x,
                          int32_t begin, int32_t end, int32_t next_end, packed_t* out) noexcept nogil:
    """Records of the blocks line[begin:end] of one slot; those without a partner last."""
    cdef int32_t odd[KINDS]
    cdef int32_t i, k, held = -1, n_odd = 0
    for i in range(begin, end):
        k = x.line[i]
        if x.kind[k] < 0:
            continue                                    # beside one of the slot before
        if x.kind[k] == ALONE or LANES == 1:
            put_record(p, r, order, lam, x, k, -1, out)
        elif held >= 0 and x.kind[held] == x.kind[k]:
            put_record(p, r, order, lam, x, held, k, out)
            held = -1
        else:
            if held >= 0:
                odd[n_odd] = held
                n_odd += 1
            held = k
    if held >= 0:
        odd[n_odd] = held
        n_odd += 1
    for i in range(n_odd):
        k = find_partner(r, order, x, odd + i, n_odd - i, end, next_end)
        put_record(p, r, order, lam, x, odd[i], k, out)


cdef inline int32_t pack_order(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t single, double* workspace,
                               const double* lam, packed_t* out) noexcept nogil:
    """Records of the blocks order (k); 0, and none, where a slot has fewer than LEAST on average or most have no lanes.

    Any T from that of (1) on will do; a longer one, up to all levels, makes fewer stages, and slots of fewer blocks. T
    is as long as slots of WIDTH blocks on average allow; `single`: all levels, those of contacts behind those of joints.

    workspace: `room_of` doubles.
    """
    cdef int32_t n = p.n_blocks, i, t, top = 0, begin = 0, end, next_end
    cdef plan_t x
    x.single = single
    x.last = <int32_t*>workspace
    x.first = x.last + r.n_bodies
    x.early = x.first + r.n_bodies
    x.count = x.early + r.n_bodies
    workspace += 2 * r.n_bodies
    x.level = <int32_t*>workspace
    x.line = x.level + n
    x.kind = x.line + n
    x.slot = x.kind + n
    workspace += 2 * n
    if not 0 < n <= MOST:
        return 0
    for i in range(r.n_bodies):
        x.early[i] = 0
    t = set_levels(p, r, order, r.n_joints if single else n, &x, &top)
    if single:
        t = top
    else:
        if t > n // WIDTH:
            t = shorten(p, r, order, &x, t, &top)
        if t < n // WIDTH:
            t = n // WIDTH if n // WIDTH < top else top
    if n < LEAST * t or not set_slots(p, r, order, t, &x):
        return 0
    # records begin on a multiple of 16 bytes
    out.record = <pair_t*>(workspace + ((<uintptr_t>workspace >> 3) & 1))
    out.last = out.record
    out.behind = <double*>out.record
    out.lane = x.level
    out.stages = (top + t - 1) // t
    out.pairs = 0
    for i in range(t):
        if begin == r.n_joints:
            out.last_joint = out.last
            out.contacts = <pair_t*>out.behind
        end = x.slot[i]
        next_end = x.slot[i + 1] if i + 1 < t else end
        put_slot(p, r, order, lam, &x, begin, end, next_end, out)
        begin = end
    if r.n_contacts == 0:
        out.last_joint = out.last
    return 1


cdef inline void move_impulses(const blocks_t* p, const int32_t* order, const packed_t* packed, int32_t take,
                               double* lam) noexcept nogil:
    """Impulses lam (m) into the records, or back."""
    cdef int32_t i, j, k, n
    cdef double* x
    for i in range(p.n_blocks):
        x = <double*>(packed.record + packed.lane[i] // LANES)
        n = rows_of((<int64_t*>x)[P_CODE * LANES] & 255)
        x += LANES * HEADER + packed.lane[i] % LANES
        j = p.ptr[order[i]]
        for k in range(n):
            if take:
                lam[j + k] = x[LANES * k]
            else:
                x[LANES * k] = lam[j + k]


cdef inline int32_t due(const int64_t* place, int32_t pass_, int32_t sweeps) noexcept nogil:
    # lanes that are, a bit each
    cdef int32_t l, live = 0
    for l in range(LANES):
        live |= (0 <= pass_ - place[P_OWN * LANES + l] < sweeps) << l
    return live


cdef inline void hold(const pair_t* x, int32_t n, int32_t live, int64_t nowhere, int64_t* to, double* kept) noexcept nogil:
    """For lanes that are not live: nowhere to write (to), and their impulses as they are (kept)."""
    cdef const int64_t* place = <const int64_t*>x + P_WRITE * LANES
    cdef int32_t k
    for k in range(2 * LANES):
        to[k] = place[k] if live >> (k % LANES) & 1 else nowhere
    for k in range(LANES * n):
        kept[k] = (<const double*>(x + HEADER))[k]


cdef inline void let_go(pair_t* x, int32_t n, int32_t live, const double* kept) noexcept nogil:
    cdef int32_t k
    for k in range(LANES * n):
        if not live >> (k % LANES) & 1:
            (<double*>(x + HEADER))[k] = kept[k]


cdef inline void sweep_records(const blocks_t* p, const rows_t* r, const packed_t* packed, int32_t sweeps, double* lam,
                               double* body) noexcept nogil:
    """`sweeps` sweeps over the records, drained at the end; body (n_bodies + 2, 6), behind the last body zeros.
    Impulses stay in the records, but for those of blocks alone."""
    cdef int32_t k, _i, kind, live, draining, every = (1 << LANES) - 1, stages = packed.stages
    cdef int64_t code, nowhere = BODY * <int64_t>(r.n_bodies + 1)
    cdef int64_t held[4]
    cdef double kept[2 * MOST_ROWS]
    cdef const int64_t* to
    cdef pair_t* x
    for k in range(sweeps + stages - 1):
        draining = k < stages - 1 or k >= sweeps
        x = packed.record
        for _i in range(packed.pairs):
            code = (<int64_t*>x)[P_CODE * LANES]
            kind = code & 255
            to = <int64_t*>x + P_WRITE * LANES
            live = due(<int64_t*>x, k, sweeps) if draining else every
            if live == every:
                relax_record(p, r, x, kind, x + HEADER, body, to, lam)
            elif live:
                hold(x, rows_of(kind), live, nowhere, held, kept)
                relax_record(p, r, x, kind, x + HEADER, body, held, lam)
                let_go(x, rows_of(kind), live, kept)
            x += (code >> 8) & 0xffffff


cdef inline int32_t sweep_packed(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t sweeps,
                                 double* workspace, double* lam, double* v) noexcept nogil:
    """`sweeps` sweeps over the blocks order (k), or 0 and none, as `pack_order`; v (n_bodies, 6)."""
    cdef packed_t packed
    cdef double* body
    cdef int32_t i
    if not pack_order(p, r, order, 0, workspace, lam, &packed):
        return 0
    body = packed.behind
    for i in range(6 * r.n_bodies):
        body[i] = v[i]
    for i in range(12):
        body[6 * r.n_bodies + i] = 0.0
    sweep_records(p, r, &packed, sweeps, lam, body)
    for i in range(6 * r.n_bodies):
        v[i] = body[i]
    move_impulses(p, order, &packed, 1, lam)
    return 1
