"""Sweeps over blocks packed in pairs, in an order that hides the latency of a block's update, with the same bits.

In a sweep a block waits for the velocities that the previous block of the same body wrote. Blocks that share no body may be
exchanged without a change of bits. With level(c) = 1 + the largest level of the blocks before c on its bodies, blocks of one level
share no body, and sweep s + 1 may begin on a body T levels after sweep s began:

    time of block c in sweep s = level(c) + s T,    T = max over bodies of (last level - first level + 1)     (1)

A slot contains the blocks of equal level mod T, which share no body. Two blocks of one kind in a slot form a record, and each is
one lane of a vector. The last block of a kind in a slot is paired with a block of the next slot if possible. Pass k visits all
slots and updates the blocks that are due: those with 0 <= k - stage < sweeps, stage = floor(level / T). Every block reads the same
velocities as in a sequence of sweeps.

First levels may be chosen. A body with an early first block and late others (a joint, which is swept first, on top of a tower)
begins later, so that T is close to the maximum number of blocks of a body. Independent parts of a scene fill the same slots.

If something is done between two sweeps (`single`), T is the number of levels and there is one stage. Contacts come after all
joints. Two blocks that share a body are in different records, in the sequence of the order; therefore the records of joints, then
the records of contacts, each read backwards, are a sweep of the reversed order.
"""
from libc.stdint cimport int32_t, int64_t, uintptr_t

from lavender_ext.core.block_types cimport blocks_t
from lavender_ext.core.pair cimport LANES, load_pair, pair_t, store_pair
from lavender_ext.core.view cimport get_block_bodies, rows_t
from lavender_ext.sweep.records cimport (CODE, CONTACT_SIZE, HEADER_SIZE, MAX_RECORD_ROWS, N_KINDS, OWNER, UNPACKED, VELOCITY_BYTES,
                                         WRITE_OFFSET, classify_record_kind, decode_record_kind, count_record_rows,
                                         decode_previous_record_size, encode_record_header, record_size_in_pairs, relax_record,
                                         decode_record_size, write_block_record)


cdef enum:                      # doubles of workspace: a record and four int32 for every block
    WORKSPACE_PER_CONTACT = 27
    WORKSPACE_PER_CONTACT_ROW = 29
    WORKSPACE_PER_JOINT = 14
    WORKSPACE_PER_JOINT_ROW = 60
    WORKSPACE_PER_BODY = 8
    EXTRA_WORKSPACE = 16

cdef enum:
    SLOT_LIMIT = 32768          # a number above the number of slots; `place` of a block is SLOT_LIMIT * stage + slot
    MIN_BLOCKS_PER_SLOT = 2     # Orders with fewer blocks per slot are not packed: pairs would be half empty.
    BLOCKS_PER_SLOT = 6         # T is extended until slots have up to this many blocks on average, enough to hide the latency.
    MAX_SHORTENING_ROUNDS = 3   # largest number of times that levels are computed again to shorten T


cdef struct plan_t:             # temporary arrays of `pack_blocks_in_order`
    int32_t* next_level         # (n_bodies) lowest level for the next block of each body
    int32_t* first_level        # (n_bodies) level of its first block, -1 without blocks
    int32_t* start_level        # (n_bodies) level at which its blocks may begin
    int32_t* n_blocks           # (n_bodies) number of its blocks
    int32_t* place              # (k) level, then SLOT_LIMIT * stage + slot, then `lane` of packed_t
    int32_t* by_slot            # (k) blocks sorted by slot, then by kind
    int32_t* kind               # (k) kind of each block, -1 if it has a record
    int32_t* slot_end           # (T) end of each slot in by_slot


cdef struct span_t:             # records that are read in sequence, forwards or backwards
    pair_t* begin
    pair_t* end                 # last record that is read
    bint backwards
    int32_t pass_               # number of the pass,
    int32_t sweeps              # number of sweeps if some lanes may not be due; else 0


cdef inline span_t make_record_span(pair_t* first, pair_t* last, bint backwards) noexcept nogil:
    """Return the span of all records from `first` to `last`."""
    if backwards:
        return span_t(last, first, True, 0, 0)
    return span_t(first, last, False, 0, 0)


cdef int64_t packed_workspace_size(int64_t joints, int64_t joint_rows, int64_t contacts, int64_t contact_rows,
                                   int64_t bodies) noexcept nogil:
    """Return the number of doubles of workspace of `pack_blocks_in_order`."""
    return (WORKSPACE_PER_JOINT * joints + WORKSPACE_PER_JOINT_ROW * joint_rows + WORKSPACE_PER_CONTACT * contacts
            + WORKSPACE_PER_CONTACT_ROW * contact_rows + WORKSPACE_PER_BODY * bodies + EXTRA_WORKSPACE)


cdef int64_t packed_workspace_size_of_blocks(const blocks_t* p, const rows_t* r) noexcept nogil:
    """Return the number of doubles of workspace of `pack_blocks_in_order` for the blocks p between the bodies r."""
    cdef int32_t joint_rows = p.ptr[r.n_joints]
    return packed_workspace_size(r.n_joints, joint_rows, r.n_contacts, p.n_rows - joint_rows, r.n_bodies)


cdef inline int32_t compute_schedule_levels(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t second_part,
                                            plan_t* x, int32_t* n_levels) noexcept nogil:
    """Compute the levels of the blocks and their number, and return T of (1).

    The levels of blocks from order[second_part] on begin after all levels before.
    """
    cdef int32_t i, side, level, t = 1, top = 0, lowest = 0
    cdef const int32_t* body
    for i in range(r.n_bodies):
        x.next_level[i] = x.start_level[i]
        x.first_level[i] = -1
        x.n_blocks[i] = 0
    for i in range(p.n_blocks):
        if i == second_part:
            lowest = top
        body = get_block_bodies(r, order[i])
        level = lowest
        for side in range(2):
            if body[side] >= 0 and x.next_level[body[side]] > level:
                level = x.next_level[body[side]]
        x.place[i] = level
        for side in range(2):
            if body[side] >= 0:
                x.next_level[body[side]] = level + 1
                x.n_blocks[body[side]] += 1
                if x.first_level[body[side]] < 0:
                    x.first_level[body[side]] = level
        if level >= top:
            top = level + 1
    for i in range(r.n_bodies):
        if x.first_level[i] >= 0 and x.next_level[i] - x.first_level[i] > t:
            t = x.next_level[i] - x.first_level[i]
    n_levels[0] = top
    return t


cdef inline int32_t delay_wide_bodies(const blocks_t* p, const rows_t* r, const int32_t* order, plan_t* x, int32_t t,
                                      int32_t* n_levels) noexcept nogil:
    """Let bodies whose blocks span more levels than necessary begin later; return the T of the new levels."""
    cdef int32_t i, shortest = p.n_blocks // BLOCKS_PER_SLOT, _round
    for i in range(r.n_bodies):
        if x.n_blocks[i] > shortest:
            shortest = x.n_blocks[i]
    for _round in range(MAX_SHORTENING_ROUNDS):
        if t <= shortest:
            break
        for i in range(r.n_bodies):
            if x.first_level[i] >= 0 and x.next_level[i] - x.first_level[i] > shortest:
                x.start_level[i] = x.next_level[i] - shortest
        t = compute_schedule_levels(p, r, order, p.n_blocks, x, n_levels)
    return t


cdef inline bint sort_blocks_by_slot(const blocks_t* p, const rows_t* r, const int32_t* order, int32_t t, plan_t* x) noexcept nogil:
    """Replace levels by slot and stage, and sort the blocks by slot and kind; return False if most blocks are UNPACKED."""
    cdef int32_t i, slot, count, start = 0, stage, kind, unpacked = 0, n = p.n_blocks
    cdef int32_t kinds = 0                              # bit set of the kinds of the blocks
    for i in range(t):
        x.slot_end[i] = 0
    for i in range(n):
        stage = x.place[i] // t
        slot = x.place[i] - stage * t
        x.slot_end[slot] += 1
        x.place[i] = SLOT_LIMIT * stage + slot
        kind = classify_record_kind(p, r, order[i])
        unpacked += kind == UNPACKED
        x.kind[i] = kind
        kinds |= 1 << kind
    if 2 * unpacked > n:
        return False
    # Counting sort by slot, one kind after the other.
    for i in range(t):
        count = x.slot_end[i]
        x.slot_end[i] = start
        start += count
    for kind in range(N_KINDS):
        if kinds >> kind & 1:
            for i in range(n):
                if x.kind[i] == kind:
                    slot = x.place[i] % SLOT_LIMIT
                    x.by_slot[x.slot_end[slot]] = i
                    x.slot_end[slot] += 1
    return True


cdef inline bint have_common_moving_body(const int32_t* x, const int32_t* y) noexcept nogil:
    """Return whether two pairs of bodies have a moving body in common."""
    return (x[0] >= 0 and (x[0] == y[0] or x[0] == y[1])) or (x[1] >= 0 and (x[1] == y[0] or x[1] == y[1]))


cdef inline int32_t find_block_for_same_record(const rows_t* r, const int32_t* order, const plan_t* x, const int32_t* unpaired,
                                               int32_t n_unpaired, int32_t begin, int32_t end) noexcept nogil:
    """Return a block of the next slot, by_slot[begin:end], that may be paired with the block unpaired[0], or -1.

    The returned block has the kind of unpaired[0], and no body of any block in unpaired (n_unpaired). All of these come before
    it in the order.
    """
    cdef int32_t i, k, candidate
    for i in range(begin, end):
        candidate = x.by_slot[i]
        if x.kind[candidate] != x.kind[unpaired[0]]:
            continue
        for k in range(n_unpaired):
            if have_common_moving_body(get_block_bodies(r, order[candidate]), get_block_bodies(r, order[unpaired[k]])):
                break
        else:
            return candidate
    return -1


cdef inline void append_packed_record(const blocks_t* p, const rows_t* r, const int32_t* order, const double* lam, plan_t* x,
                                      int32_t i, int32_t j, packed_t* out) noexcept nogil:
    """Append the record of blocks order[i] and order[j]; j = -1 for one block."""
    cdef pair_t* record = <pair_t*>out.end
    cdef int32_t kind = x.kind[i], k = i if j < 0 else j
    cdef int32_t lane = LANES * <int32_t>(record - out.first)
    if out.single:
        write_block_record(p, r, kind, order[i], order[k], p.ptr[order[i]], p.ptr[order[k]], lam, record)
    else:
        write_block_record(p, r, kind, order[i], order[k], x.place[i] // SLOT_LIMIT, x.place[k] // SLOT_LIMIT, lam, record)
    (<int64_t*>record)[CODE * LANES] = encode_record_header(kind, record - out.last)
    if j >= 0:
        x.place[j] = lane + 1
        x.kind[j] = -1
    x.place[i] = lane
    x.kind[i] = -1
    out.last = record
    out.end = <double*>(record + record_size_in_pairs(kind))
    out.n_records += 1


cdef inline void append_records_of_slot(const blocks_t* p, const rows_t* r, const int32_t* order, const double* lam, plan_t* x,
                                        int32_t begin, int32_t end, int32_t next_end, packed_t* out) noexcept nogil:
    """Append the records of one slot, the blocks by_slot[begin:end], two blocks of one kind per record.

    Blocks that stay single come last. Each is paired with a block of the next slot, by_slot[end:next_end], if possible.
    """
    cdef int32_t unpaired[N_KINDS]
    cdef int32_t i, block, waiting = -1, partner, n_unpaired = 0
    for i in range(begin, end):
        block = x.by_slot[i]
        if x.kind[block] < 0:                           # The block is in a record of the slot before.
            continue
        if x.kind[block] == UNPACKED or LANES == 1:
            append_packed_record(p, r, order, lam, x, block, -1, out)
        elif waiting >= 0 and x.kind[waiting] == x.kind[block]:
            append_packed_record(p, r, order, lam, x, waiting, block, out)
            waiting = -1
        else:
            if waiting >= 0:
                unpaired[n_unpaired] = waiting
                n_unpaired += 1
            waiting = block
    if waiting >= 0:
        unpaired[n_unpaired] = waiting
        n_unpaired += 1
    for i in range(n_unpaired):
        partner = find_block_for_same_record(r, order, x, unpaired + i, n_unpaired - i, end, next_end)
        append_packed_record(p, r, order, lam, x, unpaired[i], partner, out)


cdef int32_t pack_blocks_in_order(const blocks_t* p, const rows_t* r, const int32_t* order, bint single, double* workspace,
                                  const double* lam, packed_t* out) noexcept nogil:
    """Pack the blocks of an order (k) with their impulses lam (m) into records in `workspace` (`packed_workspace_size`).

    Return 0 without records if slots have fewer than MIN_BLOCKS_PER_SLOT blocks on average, or if most blocks are UNPACKED. Every
    T from (1) up to the number of levels is valid; a longer one has fewer stages and fewer blocks in each slot. T is
    the longest with BLOCKS_PER_SLOT blocks per slot on average, or the number of levels if `single`.
    """
    cdef int32_t n = p.n_blocks, i, t, n_levels = 0, begin = 0, end, next_end
    cdef plan_t x
    # Bind the temporary arrays.
    x.next_level = <int32_t*>workspace
    x.first_level = x.next_level + r.n_bodies
    x.start_level = x.first_level + r.n_bodies
    x.n_blocks = x.start_level + r.n_bodies
    workspace += 2 * r.n_bodies
    x.place = <int32_t*>workspace
    x.by_slot = x.place + n
    x.kind = x.by_slot + n
    x.slot_end = x.kind + n
    workspace += 2 * n
    if not 0 < n <= MAX_PACKED_BLOCKS:
        return 0
    # Compute levels and T.
    for i in range(r.n_bodies):
        x.start_level[i] = 0
    t = compute_schedule_levels(p, r, order, r.n_joints if single else n, &x, &n_levels)
    if single:
        t = n_levels
    else:
        if t > n // BLOCKS_PER_SLOT:
            t = delay_wide_bodies(p, r, order, &x, t, &n_levels)
        if t < n // BLOCKS_PER_SLOT:
            t = min(n // BLOCKS_PER_SLOT, n_levels)
    if n < MIN_BLOCKS_PER_SLOT * t or not sort_blocks_by_slot(p, r, order, t, &x):
        return 0
    # Write the records, which begin at a multiple of 16 bytes.
    out.first = <pair_t*>(workspace + ((<uintptr_t>workspace >> 3) & 1))
    out.last = out.last_joint = out.first_contact = out.first
    out.end = <double*>out.first
    out.lane = x.place
    out.single = single
    out.n_stages = (n_levels + t - 1) // t
    out.n_records = 0
    for i in range(t):
        if begin == r.n_joints:
            out.last_joint = out.last
            out.first_contact = <pair_t*>out.end
        end = x.slot_end[i]
        next_end = x.slot_end[i + 1] if i + 1 < t else end
        append_records_of_slot(p, r, order, lam, &x, begin, end, next_end, out)
        begin = end
    if r.n_contacts == 0:
        out.last_joint = out.last
    return 1


cdef void copy_packed_impulses(const blocks_t* p, const int32_t* order, const packed_t* packed, bint into,
                               double* lam) noexcept nogil:
    """Copy the impulses in the records to lam (m), or with `into` lam into the records."""
    cdef int32_t i, k, n
    cdef double* x
    for i in range(p.n_blocks):
        x = <double*>(packed.first + packed.lane[i] // LANES)
        n = count_record_rows(decode_record_kind((<int64_t*>x)[CODE * LANES]))
        x += LANES * HEADER_SIZE + packed.lane[i] % LANES   # Successive impulses of a block are LANES doubles apart.
        for k in range(n):
            if into:
                x[LANES * k] = lam[p.ptr[order[i]] + k]
            else:
                lam[p.ptr[order[i]] + k] = x[LANES * k]


cdef inline void mask_inactive_lanes(const pair_t* record, int32_t n, int32_t due, int64_t unused, int64_t* write_offset,
                                     double* saved) noexcept nogil:
    """Redirect the velocities of lanes that are not due to an unused place, and save the impulses of the record."""
    cdef const int64_t* header = <const int64_t*>record
    cdef int32_t k
    for k in range(2 * LANES):
        write_offset[k] = header[WRITE_OFFSET * LANES + k] if due >> (k % LANES) & 1 else unused
    for k in range(LANES * n):
        saved[k] = (<const double*>(record + HEADER_SIZE))[k]


cdef inline void relax_records(const blocks_t* p, const rows_t* r, const packed_t* packed, const span_t* span, double* lam,
                               double* v) noexcept nogil:
    """Update the blocks of the records of a span that are due."""
    cdef int32_t kind, n, due, k, all_lanes = (1 << LANES) - 1
    cdef int64_t code, unused = VELOCITY_BYTES * <int64_t>(r.n_bodies + 1)
    cdef int64_t held_offset[4]
    cdef double saved[2 * MAX_RECORD_ROWS]
    cdef pair_t outside[MAX_RECORD_ROWS]
    cdef const int64_t* write_offset
    cdef const int64_t* owner
    cdef pair_t* record = span.begin
    cdef pair_t* impulses
    while True:
        code = (<int64_t*>record)[CODE * LANES]
        kind = decode_record_kind(code)
        n = count_record_rows(kind)
        # Load the impulses, and find the lanes that are due.
        impulses = record + HEADER_SIZE
        write_offset = <int64_t*>record + WRITE_OFFSET * LANES
        owner = <int64_t*>record + OWNER * LANES
        due = all_lanes
        if packed.single:
            for k in range(n):
                outside[k] = load_pair(lam + owner[0] + k, lam + owner[LANES - 1] + k)
            impulses = outside
        elif span.sweeps > 0:
            due = 0
            for k in range(LANES):
                due |= (0 <= span.pass_ - owner[k] < span.sweeps) << k
            if due != all_lanes:
                mask_inactive_lanes(record, n, due, unused, held_offset, saved)
                write_offset = held_offset
        # Update the blocks.
        if due:
            relax_record(p, r, record, kind, impulses, v, write_offset, lam)
        if packed.single:
            for k in range(n):
                store_pair(lam + owner[0] + k, lam + owner[LANES - 1] + k, outside[k])
        elif due != all_lanes:
            for k in range(LANES * n):
                if not due >> (k % LANES) & 1:
                    (<double*>impulses)[k] = saved[k]
        # Go to the next record.
        if record == span.end:
            return
        record += -decode_previous_record_size(code) if span.backwards else decode_record_size(code)


cdef void sweep_records(const blocks_t* p, const rows_t* r, const packed_t* packed, int32_t sweeps, bint backwards,
                        double* lam, double* v) noexcept nogil:
    """Run sweeps over the records; v (n_bodies + 2, 6), with zeros after the last body.

    Impulses remain in the records, except those of UNPACKED blocks. If `single`, one sweep over joints, then contacts, is run in
    the order or its reverse, with the impulses in lam (m).
    """
    cdef span_t span[2]
    cdef int32_t k, i, n_spans = 0, n_passes = 1 if packed.single else sweeps + packed.n_stages - 1
    if not packed.single:
        span[0] = make_record_span(packed.first, packed.last, False)
        n_spans = 1
    else:
        if r.n_joints > 0:
            span[0] = make_record_span(packed.first, packed.last_joint, backwards)
            n_spans = 1
        if r.n_contacts > 0:
            span[n_spans] = make_record_span(packed.first_contact, packed.last, backwards)
            n_spans += 1
    for k in range(n_passes):
        for i in range(n_spans):
            span[i].pass_ = k
            # In the first and the last passes some blocks are not due.
            span[i].sweeps = sweeps if k < packed.n_stages - 1 or k >= sweeps else 0
            relax_records(p, r, packed, &span[i], lam, v)


cdef void refresh_packed_contacts(const blocks_t* p, const int32_t* order, const packed_t* packed,
                                  const double* lam) noexcept nogil:
    """Write new right-hand sides and impulses lam (m) to the records of contacts, which are the same otherwise."""
    cdef int32_t i, k, n, row
    cdef double* x
    for i in range(p.n_blocks):
        x = <double*>(packed.first + packed.lane[i] // LANES)
        n = count_record_rows(decode_record_kind((<int64_t*>x)[CODE * LANES]))
        row = p.ptr[order[i]]
        x += LANES * HEADER_SIZE + packed.lane[i] % LANES
        for k in range(n):
            x[LANES * k] = lam[row + k]
            x[LANES * (CONTACT_SIZE + 2 * n + k)] = p.b[row + k]


cdef void sweep_packed(const blocks_t* p, const rows_t* r, const int32_t* order, const packed_t* packed, int32_t sweeps,
                       double* lam, double* v) noexcept nogil:
    """Run sweeps over packed blocks, which hold the impulses; v (n_bodies, 6). lam (m) receives the impulses."""
    cdef double* body = packed.end
    cdef int32_t i
    for i in range(6 * r.n_bodies):
        body[i] = v[i]
    for i in range(12):
        body[6 * r.n_bodies + i] = 0.0
    sweep_records(p, r, packed, sweeps, False, lam, body)
    for i in range(6 * r.n_bodies):
        v[i] = body[i]
    copy_packed_impulses(p, order, packed, False, lam)
