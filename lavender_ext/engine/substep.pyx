"""LavenderSim's substep: broad phase, narrow phase, contact cache, velocity solve, position projection, integration.

    start       frames, world inverse inertia, v* = v + h g
    pairs       pairs of overlapping bounding boxes
    contacts    joint rows; then manifolds, contact rows, warm start from the cache. After the first substep of a step: only those
                of bodies that have moved (engine/contacts.pxd, (5)); the others keep their rows
    solve       dv = M^-1 J^T lam, then `iterations` sweeps: all joints, then all contacts
    finish      shift of the position projection, v = v* + dv, poses; then gaps, or in the last substep of a step the cache

`prepare_substep` performs the first three stages and does not change the state; if a capacity is too small, it reports the
needed capacity. Between `prepare_substep` and `finish_substep` any solver may replace `solve_substep`: it reads the velocity
problem from the arrays and writes the impulses back.
"""
from libc.stdint cimport int32_t, int64_t, uint64_t

import numpy as np

from lavender_ext.engine.arrays import make_array_views

from lavender_ext.core.block cimport compute_row_error
from lavender_ext.core.validate cimport all_finite
from lavender_ext.core.order cimport (RANDOM, SYMMETRIC, update_sweep_order, find_block_levels, color_blocks_by_bodies,
                                      reverse_blocks, sort_blocks_by_level)
from lavender_ext.core.block_types cimport blocks_t, is_disk_friction_contact
from lavender_ext.core.velocity cimport compute_velocity_change
from lavender_ext.core.view cimport rows_t
from lavender_ext.engine.arrays cimport (ALTERNATING, AT_RANDOM, BOTTOM_UP, CAP_CONTACT, CAP_PAIR, COLORED, COLORED_PAIRS,
                                         H_CONTACTS, H_CONTACT_ROWS, H_ITERATIONS, H_LOST, H_MATCHES, H_NEED_CONTACTS, H_NEED_PAIRS,
                                         H_ORDER, H_PHASE, H_POSITION_ITERATIONS, H_PROJECTED, H_REBUILT, H_SEED, H_SOLVED,
                                         H_STEP, H_SUBSTEPS, H_WARM_START, NEED_CAPACITY, NOT_FINITE, N_BODY, N_DYNAMIC,
                                         N_JOINT, N_JOINT_ROW, OK, REVERSED, ROWS_PER_CONTACT, SYMMETRICALLY, S_BETA,
                                         S_BOUNCE, S_DEPTH, S_H, S_JOINT_ERROR, S_MAX_PUSH, S_OUT, S_RECYCLE, S_SLOP, TOP_DOWN,
                                         bind_engine_arrays, engine_t)
from lavender_ext.engine.bodies cimport advance_bodies, are_contacts_new, begin_body_substep, get_sweep_direction
from lavender_ext.engine.broad_phase cimport update_pair_list
from lavender_ext.engine.contacts cimport (build_contacts, find_due_bodies, finish_contacts, follow_gaps, renew_contacts,
                                            store_contact_cache)
from lavender_ext.engine.joints cimport build_joint_rows, store_joint_impulses
from lavender_ext.engine.projection cimport contact_normal_velocity, count_most_sweeps, project_positions
from lavender_ext.engine.view cimport bind_substep_problem
from lavender_ext.judge.measure cimport score_given_slack
from lavender_ext.judge.score cimport make_empty_score, score_t
from lavender_ext.judge.slack cimport compute_body_slack
from lavender_ext.sweep.manifolds cimport (HAS_MANIFOLDS, check_manifolds, contacts_t, follow_manifolds, free_manifolds, has_avx2,
                                           manifolds_t, pack_manifolds, project_manifolds, refresh_manifolds, store_manifolds,
                                           store_velocities, sweep_along, sweep_manifolds, targets_t)
from lavender_ext.sweep.packed cimport (MAX_PACKED_BLOCKS, pack_blocks_in_order, packed_t, packed_workspace_size,
                                        refresh_packed_contacts, sweep_packed)
from lavender_ext.sweep.pgs cimport sweep_bodies


cdef enum:
    MIN_PACKED_SWEEPS = 4       # Pack the blocks from this many sweeps on: packing costs as much as a few sweeps.
    MAX_UNROLLED_SWEEPS = 8     # Groups hold the manifolds of all sweeps of a substep up to this many sweeps,
    MIN_LANES = 2               # and must have this many manifolds on average.
    MAX_POINTS = 4              # of a manifold


cdef inline int32_t prepare_contacts(engine_t* e, blocks_t* p, rows_t* r) noexcept nogil:
    """Build joint rows and contacts of the coming substep, contacts without rows; return OK or NEED_CAPACITY.

    p and r receive the problem; `finish_contacts` completes it.
    """
    cdef int32_t pairs, contacts
    e.head[H_SOLVED] = 0
    # bodies and pairs
    begin_body_substep(e)
    pairs = update_pair_list(e)
    e.head[H_NEED_PAIRS] = pairs
    if pairs > e.size[CAP_PAIR]:
        return NEED_CAPACITY
    # joint rows, contacts
    if e.size[N_JOINT] > 0:
        build_joint_rows(e)
    contacts = build_contacts(e) if are_contacts_new(e) else renew_contacts(e)
    e.head[H_NEED_CONTACTS] = contacts
    if contacts > e.size[CAP_CONTACT]:
        return NEED_CAPACITY
    bind_substep_problem(e, p, r)
    return OK


cdef int32_t prepare_substep(engine_t* e) noexcept nogil:
    """Build the velocity problem of the coming substep; return OK or NEED_CAPACITY."""
    cdef blocks_t p
    cdef rows_t r
    cdef int32_t status = prepare_contacts(e, &p, &r)
    if status == OK:
        finish_contacts(e, &p, &r, False)
    return status


cdef inline void measure_contact_errors(const engine_t* e, double* residual, double* violation) noexcept nogil:
    """Compute max |e_n| [N s] and max(0, -w_n) [m/s] over the contacts, w_n = J dv + c lam - b."""
    cdef int32_t c, row
    cdef double slack, error, inf = 1.0 / 0.0, max_error = 0.0, max_violation = 0.0
    for c in range(e.head[H_CONTACTS]):
        row = e.ptr[e.size[N_JOINT] + c]
        slack = contact_normal_velocity(e, e.dv, c) + (e.compliance[row] * e.impulse[row] - e.b[row])
        error = compute_row_error(e.impulse[row], slack, e.d[row], 0.0, inf)
        error = -error if error < 0.0 else error
        if not error <= max_error:
            max_error = error
        if not -slack <= max_violation:
            max_violation = -slack
    residual[0] = max_error
    violation[0] = max_violation


cdef inline void set_sweep_order_of_blocks(engine_t* e) noexcept nogil:
    """Write the sweep order of all blocks to e.order, as computed by lavender.ordering: joints, then contacts."""
    cdef int32_t kj = e.size[N_JOINT], n = kj + e.head[H_CONTACTS], nd = e.size[N_DYNAMIC]
    cdef int32_t mode = e.head[H_ORDER]
    cdef int32_t* level = e.order_scratch
    cdef int32_t* block_level = level + nd
    cdef int32_t i, levels
    for i in range(n):
        e.order[i] = i
    if mode == REVERSED:
        reverse_blocks(e.order, 0, kj)
        reverse_blocks(e.order, kj, n)
    elif mode == ALTERNATING:
        if get_sweep_direction(e):
            reverse_blocks(e.order, kj, n)
    elif mode == COLORED_PAIRS:
        levels = color_blocks_by_bodies(n - kj, e.contact_body, nd, True, e.color_scratch, block_level)
        sort_blocks_by_level(n - kj, block_level, levels, block_level + n, e.order + kj)
        for i in range(kj, n):
            e.order[i] += kj
        if get_sweep_direction(e):
            reverse_blocks(e.order, kj, n)
    elif mode == BOTTOM_UP or mode == TOP_DOWN or mode == COLORED:
        if mode == COLORED:
            levels = color_blocks_by_bodies(n, e.joint_body, nd, False, e.color_scratch, block_level)
        else:
            levels = find_block_levels(n, e.joint_body, nd, level, block_level)
        if mode == TOP_DOWN:
            for i in range(n):
                block_level[i] = levels - 1 - block_level[i]
        sort_blocks_by_level(kj, block_level, levels, block_level + n, e.order)
        sort_blocks_by_level(n - kj, block_level + kj, levels, block_level + n, e.order + kj)
        for i in range(kj, n):
            e.order[i] += kj


cdef inline void record_sweep_error(const engine_t* e, const blocks_t* p, const rows_t* r, double* out,
                                    double* scratch) noexcept nogil:
    """Write max |e_n| [N s] over the contacts and E = sqrt(sum d e^2) [sqrt J] over all rows to out (2); scratch (2 m)."""
    cdef double violation
    cdef score_t s = make_empty_score()
    measure_contact_errors(e, out, &violation)
    compute_body_slack(p, r, e.impulse, e.dv, scratch)
    score_given_slack(p, e.impulse, scratch, scratch + p.n_rows, &s)
    out[1] = s.energy


cdef inline void start_solve(engine_t* e, const blocks_t* p, const rows_t* r, bint measures) noexcept nogil:
    """Apply the warm start; with `measures`, write the error before the first sweep."""
    cdef int32_t i
    if e.head[H_WARM_START]:
        compute_velocity_change(p, r, e.impulse, e.dv)
    else:
        for i in range(6 * e.size[N_DYNAMIC]):
            e.dv[i] = 0.0
    if measures:
        measure_contact_errors(e, e.setting + S_OUT + 4, e.setting + S_OUT + 6)


cdef inline void sweep_single_blocks(engine_t* e, const blocks_t* p, const rows_t* r, double* curve,
                                     double* scratch) noexcept nogil:
    """Run the sweeps of a substep block by block."""
    cdef int32_t i, mode = SYMMETRIC if e.head[H_ORDER] == SYMMETRICALLY else (RANDOM if e.head[H_ORDER] == AT_RANDOM else 0)
    # every substep has its own random stream, a function of seed and substep alone
    cdef uint64_t rng = ((<uint64_t>(<int64_t>e.head[H_SEED])) << 32) ^ (<uint64_t>(<int64_t>e.head[H_STEP]))
    for i in range(e.head[H_ITERATIONS]):               # over joints, then contacts
        update_sweep_order(mode, i == 0, e.order, 0, r.n_joints, &rng)
        update_sweep_order(mode, i == 0, e.order, r.n_joints, p.n_blocks, &rng)
        sweep_bodies(p, r, e.order, p.n_blocks, e.impulse, e.dv)
        if curve != NULL:
            record_sweep_error(e, p, r, curve + 2 * (i + 1), scratch)


cdef inline void solve_substep(engine_t* e, bint sweeps, bint measures, double* curve, double* scratch) noexcept nogil:
    """Solve the substep's velocity problem by sweeps; without `sweeps` only apply the warm start and measure its error.

    With `measures`, the errors before and after the sweeps are measured. curve (iterations + 1, 2) or NULL receives max |e_n| and
    E before the first sweep and after each.
    """
    cdef blocks_t p
    cdef rows_t r
    bind_substep_problem(e, &p, &r)
    start_solve(e, &p, &r, measures)
    if curve != NULL:
        record_sweep_error(e, &p, &r, curve, scratch)
    if not sweeps:
        return
    set_sweep_order_of_blocks(e)
    sweep_single_blocks(e, &p, &r, curve, scratch)
    if measures:
        measure_contact_errors(e, e.setting + S_OUT + 5, e.setting + S_OUT + 7)


cdef inline int32_t first_dynamic_body_of_pair(const engine_t* e, const int32_t* pair) noexcept nogil:
    """Return the first dynamic body of a pair."""
    return pair[0] if pair[0] >= 0 and e.dyn[pair[0]] >= 0 else pair[1]


cdef inline int32_t find_nonfinite_body(const engine_t* e) noexcept nogil:
    """Return a dynamic body of the first block with an impulse or error that is not finite, or -1 if all are finite."""
    cdef int32_t i, kj = e.size[N_JOINT], c = e.head[H_CONTACTS]
    if (all_finite(e.impulse, e.size[N_JOINT_ROW] + e.head[H_CONTACT_ROWS]) and all_finite(e.gap, c)
            and all_finite(e.setting + S_OUT, 8)):
        return -1
    for i in range(kj):
        if not all_finite(e.impulse + e.ptr[i], e.ptr[i + 1] - e.ptr[i]):
            return first_dynamic_body_of_pair(e, e.joint_bodies + 2 * i)
    for i in range(kj, kj + c):
        if not (all_finite(e.impulse + e.ptr[i], e.ptr[i + 1] - e.ptr[i]) and all_finite(e.b + e.ptr[i], 1)
                and all_finite(e.gap + (i - kj), 1)):
            return first_dynamic_body_of_pair(e, e.contact_pair + 2 * (i - kj))
    return first_dynamic_body_of_pair(e, e.contact_pair) if c > 0 else e.body_of[0]


cdef inline void store_statistics(engine_t* e) noexcept nogil:
    """Write the statistics of the sweeps, and the impulses of the joints for the next warm start."""
    cdef double* out = e.setting + S_OUT
    out[0] = e.head[H_ITERATIONS]
    out[1] = 1.0 if e.head[H_WARM_START] else 0.0
    out[2] = e.head[H_CONTACTS]
    out[3] = e.head[H_MATCHES]
    store_joint_impulses(e)


cdef inline int32_t end_substep(engine_t* e) noexcept nogil:
    """Count the substep; return OK or NOT_FINITE."""
    e.head[H_PHASE] = 0 if e.head[H_PHASE] + 1 >= e.head[H_SUBSTEPS] else e.head[H_PHASE] + 1
    e.head[H_SOLVED] = 1
    e.head[H_STEP] = 0 if e.head[H_STEP] == 2147483647 else e.head[H_STEP] + 1
    return OK if e.head[H_LOST] < 0 else NOT_FINITE


cdef int32_t finish_substep(engine_t* e) noexcept nogil:
    """Write the statistics, project and advance the bodies, prepare the next substep's contacts; return OK or NOT_FINITE."""
    cdef int32_t shifted, nonfinite_body, any_due, ends
    store_statistics(e)
    # projection, integration
    nonfinite_body = find_nonfinite_body(e)
    shifted = project_positions(e)
    e.head[H_LOST] = advance_bodies(e, shifted)
    if e.head[H_LOST] < 0:
        e.head[H_LOST] = nonfinite_body
    # gaps and cache for the next substep
    ends = e.head[H_PHASE] + 1 >= e.head[H_SUBSTEPS]
    any_due = 0
    if not ends or e.setting[S_RECYCLE] > 0.0:
        any_due = find_due_bodies(e, shifted, ends)
        follow_gaps(e)
    if ends or any_due:
        store_contact_cache(e)
    return end_substep(e)


cdef public int32_t lav_engine_prepare(const int32_t* size, double* real, int32_t* index, uint64_t* keys) noexcept nogil:
    """Build the coming substep's velocity problem without changing the state; return OK or NEED_CAPACITY."""
    cdef engine_t e
    cdef int64_t n[3]
    bind_engine_arrays(size, real, index, keys, &e, n)
    return prepare_substep(&e)


cdef public void lav_engine_solve(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                  int32_t sweeps) noexcept nogil:
    """Solve the prepared problem; sweeps = 0 only applies and measures the warm start."""
    cdef engine_t e
    cdef int64_t n[3]
    bind_engine_arrays(size, real, index, keys, &e, n)
    solve_substep(&e, sweeps != 0, True, NULL, NULL)


cdef public void lav_engine_solve_watched(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                          double* curve, double* scratch) noexcept nogil:
    """Run all sweeps, with the same bits as `lav_engine_solve`, and record the error before the first and after each.

    curve (iterations + 1, 2) receives max |e_n| [N s] over the contacts and E [sqrt J] over all rows; scratch (2 m).
    """
    cdef engine_t e
    cdef int64_t n[3]
    bind_engine_arrays(size, real, index, keys, &e, n)
    solve_substep(&e, True, True, curve, scratch)


cdef public int32_t lav_engine_finish(const int32_t* size, double* real, int32_t* index, uint64_t* keys) noexcept nogil:
    """Update positions, velocities and cache after the solve; return OK or NOT_FINITE."""
    cdef engine_t e
    cdef int64_t n[3]
    bind_engine_arrays(size, real, index, keys, &e, n)
    return finish_substep(&e)


cdef inline int32_t run_substeps(engine_t* e, int32_t n, int32_t* done) noexcept nogil:
    """Run up to n substeps; `done` receives the number completed. The errors of the sweeps are measured in the last one."""
    cdef int32_t status = OK
    done[0] = 0
    while status == OK and done[0] < n:
        status = prepare_substep(e)
        if status == OK:
            solve_substep(e, True, done[0] == n - 1, NULL, NULL)
            status = finish_substep(e)
            done[0] += 1
    return status


cdef public int32_t lav_engine_substeps(const int32_t* size, double* real, int32_t* index, uint64_t* keys,
                                        int32_t n_substeps, int32_t* done) noexcept nogil:
    """Run complete substeps; `done` receives the number completed before the returned status."""
    cdef engine_t e
    cdef int64_t n[3]
    bind_engine_arrays(size, real, index, keys, &e, n)
    return run_substeps(&e, n_substeps, done)


cdef struct packs_t:            # packed blocks of the substeps of a call: in odd phases the contacts are visited in reverse
    manifolds_t manifolds       # groups of manifolds, in the order of the substep `way`
    bint has_manifolds          # They hold the contacts of the present substep; the rows of the engine's arrays are out of date.
    bint tried                  # It is known whether groups can hold the contacts.
    bint stored                 # The arrays have these rows, too.
    bint all_rows               # Without groups, the rows of kept contacts must be built, too.
    int32_t way
    int32_t lanes
    packed_t packed[2]          # pairs of blocks, for each order
    double* workspace[2]
    bint is_valid[2]


cdef inline bint sweep_packed_blocks(engine_t* e, const blocks_t* p, const rows_t* r, packs_t* packs) noexcept nogil:
    """Run the sweeps over pairs of blocks, with the same bits, and return True, or return False if they cannot be packed.

    Pairs are used again in a later substep if all rows are still the same, except for the right-hand sides of contacts.
    """
    cdef int32_t way = get_sweep_direction(e), sweeps = e.head[H_ITERATIONS]
    if e.head[H_ORDER] == SYMMETRICALLY or e.head[H_ORDER] == AT_RANDOM or sweeps < MIN_PACKED_SWEEPS:
        return False                                    # The order changes from sweep to sweep, or packing does not pay.
    if e.head[H_REBUILT] or r.n_joints > 0:
        packs.is_valid[0] = packs.is_valid[1] = False
    if packs.is_valid[way]:
        refresh_packed_contacts(p, e.order, &packs.packed[way], e.impulse)
    elif not pack_blocks_in_order(p, r, e.order, False, packs.workspace[way], e.impulse, &packs.packed[way]):
        return False
    packs.is_valid[way] = True
    sweep_packed(p, r, e.order, &packs.packed[way], sweeps, e.impulse, e.dv)
    return True


cdef inline contacts_t bind_contacts(const engine_t* e) noexcept nogil:
    """Return the contacts of a scene without joints."""
    cdef contacts_t c
    cdef int32_t i
    c.n, c.n_bodies, c.order, c.body = e.head[H_CONTACTS], e.size[N_DYNAMIC], e.order, e.contact_body
    c.mu, c.normal, c.tangent, c.arm_a, c.arm_b = e.mu, e.normal, e.tangent, e.arm_a, e.arm_b
    c.inv_mass, c.inv_inertia, c.impulse, c.gap = e.inv_mass, e.inv_inertia, e.impulse, e.gap
    c.b, c.target, c.d, c.step, c.coupling, c.inv_inertia_arm = e.b, e.target, e.d, e.step, e.coupling, e.inv_inertia_arm
    c.pair, c.restitution = e.contact_pair, NULL
    for i in range(e.size[N_BODY]):
        if e.restitution[i] > 0.0:
            c.restitution = e.restitution
    return c


cdef inline bint enter_lanes(engine_t* e, const blocks_t* p, packs_t* packs) noexcept nogil:
    """Return whether groups hold the contacts of the substep; form them if the contacts are new."""
    cdef contacts_t c
    cdef int32_t i, sweeps = e.head[H_ITERATIONS]
    if packs.tried and not e.head[H_REBUILT]:
        return packs.has_manifolds
    packs.tried = True
    packs.all_rows = packs.has_manifolds                # The arrays have no rows of kept contacts.
    packs.has_manifolds = (HAS_MANIFOLDS and packs.lanes > 1 and e.size[N_JOINT] == 0 and p.n_blocks > MAX_POINTS
                           and e.head[H_ORDER] != SYMMETRICALLY and e.head[H_ORDER] != AT_RANDOM)
    for i in range(p.n_blocks):
        packs.has_manifolds = packs.has_manifolds and is_disk_friction_contact(p, i)
    if packs.has_manifolds:
        set_sweep_order_of_blocks(e)
        packs.all_rows = True                           # The scratch memory no longer tells the new contacts.
        packs.way = get_sweep_direction(e)
        c = bind_contacts(e)
        packs.has_manifolds = pack_manifolds(&c, packs.lanes == 4, sweeps if sweeps <= MAX_UNROLLED_SWEEPS else 1, MIN_LANES,
                                             &packs.manifolds)
        packs.stored = False
    return packs.has_manifolds


cdef inline void store_lanes(engine_t* e, packs_t* packs, bint rows) noexcept nogil:
    """Write impulses, gaps, and with `rows` also the rows to the engine's arrays."""
    cdef contacts_t c = bind_contacts(e)
    store_manifolds(&c, &packs.manifolds, rows)
    packs.stored = packs.stored or rows


cdef inline targets_t bind_targets(const engine_t* e) noexcept nogil:
    """Return the settings that the groups need."""
    cdef targets_t t
    t.h, t.beta, t.slop, t.bounce = e.setting[S_H], e.setting[S_BETA], e.setting[S_SLOP], e.setting[S_BOUNCE]
    t.max_push, t.warm = e.setting[S_MAX_PUSH], e.head[H_WARM_START]
    t.most, t.finite = 0.0, True
    return t


cdef inline void solve_in_lanes(engine_t* e, packs_t* packs, bint measures) noexcept nogil:
    """Complete and solve the substep's problem in the groups; with `measures`, write it to the arrays, and measure its errors."""
    cdef contacts_t c = bind_contacts(e)
    cdef targets_t t = bind_targets(e)
    cdef bint wide = packs.lanes == 4
    refresh_manifolds(&c, &packs.manifolds, wide, &t, e.v_free, e.v, e.body_of)
    if measures:
        set_sweep_order_of_blocks(e)
        store_lanes(e, packs, True)
        store_velocities(c.n_bodies, packs.manifolds.v, e.dv)
        measure_contact_errors(e, e.setting + S_OUT + 4, e.setting + S_OUT + 6)
    sweep_manifolds(&packs.manifolds, wide, e.head[H_ITERATIONS], get_sweep_direction(e) != packs.way)
    store_velocities(c.n_bodies, packs.manifolds.v, e.dv)
    if measures:
        store_lanes(e, packs, False)
        measure_contact_errors(e, e.setting + S_OUT + 5, e.setting + S_OUT + 7)


cdef inline int32_t finish_in_lanes(engine_t* e, packs_t* packs, bint last) noexcept nogil:
    """Do what `finish_substep` does after `solve_in_lanes`, with the same bits; arrays that no substep reads only if `last`."""
    cdef contacts_t c = bind_contacts(e)
    cdef targets_t t = bind_targets(e)
    cdef bint ends = e.head[H_PHASE] + 1 >= e.head[H_SUBSTEPS], recycles = e.setting[S_RECYCLE] > 0.0
    cdef bint wide = packs.lanes == 4
    cdef int32_t shifted = 0, nonfinite_body = -1, any_due = 0, n_sweeps = e.head[H_POSITION_ITERATIONS]
    cdef double depth
    check_manifolds(&packs.manifolds, wide, &t)
    depth = t.most
    store_statistics(e)
    # projection, integration
    if not t.finite or not all_finite(e.setting + S_OUT, 8):
        store_lanes(e, packs, True)
        nonfinite_body = find_nonfinite_body(e)
    if not depth > e.setting[S_SLOP] or n_sweeps == 0 or sweep_along(&packs.manifolds):
        e.head[H_PROJECTED] = 0
        e.setting[S_DEPTH] = depth
        e.setting[S_JOINT_ERROR] = 0.0
        if depth > e.setting[S_SLOP] and n_sweeps > 0:
            e.head[H_PROJECTED] = project_manifolds(&c, &packs.manifolds, wide, &t, n_sweeps, count_most_sweeps(e),
                                                    get_sweep_direction(e), e.v_free, e.dv, e.shift)
            shifted = e.head[H_PROJECTED] > 0
    else:
        store_lanes(e, packs, not packs.stored)
        shifted = project_positions(e)
    e.head[H_LOST] = advance_bodies(e, shifted)
    if e.head[H_LOST] < 0:
        e.head[H_LOST] = nonfinite_body
    # gaps and cache for the next substep
    if not ends or recycles:
        any_due = find_due_bodies(e, shifted, ends)
        follow_manifolds(&c, &packs.manifolds, wide, e.shift)
    if any_due or ends and (last or not recycles):
        store_lanes(e, packs, False)
        store_contact_cache(e)
    if e.head[H_LOST] >= 0:
        store_lanes(e, packs, not packs.stored)
    return end_substep(e)


cdef inline void solve_packed_substep(engine_t* e, const blocks_t* p, const rows_t* r, packs_t* packs,
                                      bint measures) noexcept nogil:
    """Complete and solve the substep's problem as `solve_substep`, with the same bits, over packed blocks if that pays."""
    finish_contacts(e, p, r, packs.all_rows)
    start_solve(e, p, r, measures)
    set_sweep_order_of_blocks(e)
    if packs.lanes == 0 or not sweep_packed_blocks(e, p, r, packs):
        sweep_single_blocks(e, p, r, NULL, NULL)
    if measures:
        measure_contact_errors(e, e.setting + S_OUT + 5, e.setting + S_OUT + 7)


cdef inline int32_t run_packed_substeps(engine_t* e, int32_t n, packs_t* packs, int32_t* done) noexcept nogil:
    """Run up to n substeps as `run_substeps`, with the same bits."""
    cdef blocks_t p
    cdef rows_t r
    cdef int32_t status = OK
    cdef bint last
    done[0] = 0
    packs.tried = packs.has_manifolds = packs.all_rows = packs.is_valid[0] = packs.is_valid[1] = False
    while status == OK and done[0] < n:
        last = done[0] == n - 1
        status = prepare_contacts(e, &p, &r)
        if status != OK:
            if packs.has_manifolds:
                store_lanes(e, packs, not packs.stored)
        elif enter_lanes(e, &p, packs):
            solve_in_lanes(e, packs, last)
            status = finish_in_lanes(e, packs, last)
            done[0] += 1
        else:
            solve_packed_substep(e, &p, &r, packs, last)
            status = finish_substep(e)
            done[0] += 1
    return status


cdef class Buffers:
    """The engine's three buffers and their sizes, kept alive for the kernels; `arrays()` returns the arrays in them by name.

    The buffers must have at least `lengths(size)` entries.
    """
    cdef engine_t e
    cdef const int32_t[::1] size
    cdef double[::1] real
    cdef int32_t[::1] index
    cdef uint64_t[::1] keys
    cdef double[::1] workspace
    cdef packs_t packs

    def __init__(self, const int32_t[::1] size, double[::1] real, int32_t[::1] index, uint64_t[::1] keys):
        self.size = size
        self.real = real
        self.index = index
        self.keys = keys
        cdef int64_t used[3]
        bind_engine_arrays(&size[0], &real[0], &index[0], &keys[0], &self.e, used)
        cdef int64_t contacts = min(<int64_t>size[CAP_CONTACT], MAX_PACKED_BLOCKS), joints = size[N_JOINT]
        cdef int64_t length = 1
        if joints <= MAX_PACKED_BLOCKS:
            length = packed_workspace_size(joints, size[N_JOINT_ROW], contacts, contacts * size[ROWS_PER_CONTACT], size[N_DYNAMIC])
        self.workspace = np.empty(2 * length)
        self.packs.workspace[0] = &self.workspace[0]
        self.packs.workspace[1] = &self.workspace[length]
        self.packs.lanes = 4 if has_avx2() else 2

    def __dealloc__(self):
        free_manifolds(&self.packs.manifolds)

    @property
    def lanes(self):
        """4 with AVX2, 2 without it; 1: pairs of blocks, 0: single blocks. The bits are the same."""
        return self.packs.lanes

    @lanes.setter
    def lanes(self, int32_t n):
        self.packs.lanes = n

    @property
    def groups(self):
        """Number of groups of manifolds in the last substep, 0 if contacts were not in lanes."""
        return self.packs.manifolds.n_groups if self.packs.has_manifolds else 0

    def count_broad_phase_pairs(self):
        """Run the broad phase alone, for the kernel benchmark, and return the number of pairs needed."""
        cdef int32_t n
        with nogil:
            begin_body_substep(&self.e)
            n = update_pair_list(&self.e)
        return n

    def prepare_substep(self):
        """Build the velocity problem of the coming substep; return OK or NEED_CAPACITY."""
        cdef int32_t status
        with nogil:
            status = prepare_substep(&self.e)
        return status

    def solve(self, bint sweeps=True):
        """Solve the prepared problem; without `sweeps` only apply and measure the warm start."""
        with nogil:
            solve_substep(&self.e, sweeps, True, NULL, NULL)

    def sweep_and_record_errors(self, double[:, ::1] curve):
        """Run all sweeps; curve (iterations + 1, 2) receives max |e_n| [N s] and E [sqrt J] before the first and after each."""
        rows = self.size[N_JOINT_ROW] + self.size[CAP_CONTACT] * self.size[ROWS_PER_CONTACT]
        cdef double[::1] scratch = np.empty(2 * rows + 1)
        with nogil:
            solve_substep(&self.e, True, True, &curve[0, 0], &scratch[0])

    def apply_impulses(self):
        """Compute dv and the final error of impulses that another solver has written."""
        cdef blocks_t p
        cdef rows_t r
        with nogil:
            bind_substep_problem(&self.e, &p, &r)
            compute_velocity_change(&p, &r, self.e.impulse, self.e.dv)
            measure_contact_errors(&self.e, self.e.setting + S_OUT + 5, self.e.setting + S_OUT + 7)

    def compute_sweep_order(self):
        """Return the blocks (k,) of the prepared substep in the order of its first sweep."""
        set_sweep_order_of_blocks(&self.e)
        return np.array([self.e.order[i] for i in range(self.e.size[N_JOINT] + self.e.head[H_CONTACTS])], np.int32)

    def finish_substep(self):
        """Update positions, velocities and cache after the solve; return OK or NOT_FINITE."""
        cdef int32_t status
        with nogil:
            status = finish_substep(&self.e)
        return status

    def run_substeps(self, int32_t n):
        """Run n substeps; return (status, number of completed substeps)."""
        cdef int32_t status, done = 0
        with nogil:
            status = run_packed_substeps(&self.e, n, &self.packs, &done)
        return status, done

    def arrays(self):
        """Return {array name: writable view into its buffer}, with the shapes of engine/arrays.pyx."""
        return make_array_views(self.size, np.asarray(self.real), np.asarray(self.index), np.asarray(self.keys))
