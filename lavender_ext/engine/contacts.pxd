"""Contacts of a substep: rows and right-hand sides from manifolds, and warm starts from the contact cache.

A contact has a normal row, two tangent rows if mu > 0, and a spin row if mu and the patch radius are positive.
With v the velocities before the substep and v* those after gravity, g the gap and e the restitution,

    target_n = -g/h                     if g > 0: the gap may close, but not more              (1)
             = -beta max(0, g - slop)/h if g > 0 and the cached normal impulse is positive     (2)
             = -e v_n                   if v_n < -bounce, g + h v*_n <= 0, and if larger       (3)
             = 0                        otherwise; the position projection removes penetration
    b = target - J v*                                                                          (4)

(2) lets a tower stay upright with few sweeps. In each substep a warm-started sweep removes a fraction kappa of the
error of a slow mode; that mode oscillates like a damped spring with |z| = sqrt(1 - kappa). (1) closes the whole gap
in one substep: feedback of gain 1 on the same mode, which is unstable if the gain exceeds about kappa. With (2) a
loaded contact has the same slop above the surface as below, and returns at the rate of the projection.

Combined: mu = sqrt(mu_a mu_b), e = max, patch radius = min.

Contacts are built pair by pair in the first substep of a step. In the later substeps a contact keeps its points, normal and rows
while its bodies move little, and its gap follows to first order the displacement s of the bodies,

    g <- g + (J s)_n,   moved <- moved + |s_linear| + r |s_angular|,  r the radius of the body    (5)

A body is *due* if (5), with as much again for the coming substep, exceeds half the margin or r/100: its pairs are then built anew.
So the bodies of a pair that is kept come closer by at most the margin, the normal turns by at most 0.02 rad, and the neglected
term of second order is at most r/20000 for each body. Bodies of joints are always due, because their rows follow each pose.
With S_RECYCLE, contacts are kept over steps, too, until `moved` of a body exceeds it at the end of a step. All bodies with more
than a part of 1/EARLY are then due, since groups of manifolds are formed anew for one new contact as for many, and if these are
most bodies, all contacts are built anew.

Under the alternating order, the sweeps of every second substep run from the last point of the last pair to the first: a sweep in
one direction leaves its error on one side of a face, and the next sweep on the other. The first substep of a step builds its
contacts in the order of its sweeps.

The cache holds key, impulse and arms of the last substep's contacts, sorted by pair like the pair list.
A contact reuses the impulse of the entry with the same key if its point is within the match distance in the
frame of either body. If the key is new (a corner crossed an edge), it reuses the nearest entry of the pair that
no key has matched. A stale entry is not used; the sweeps correct a wrong match.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, uint64_t

from lavender_ext.core.block_types cimport (CONTACT, blocks_t, choose_contact_kind, count_angular_rows,
                                              count_tangent_rows)
from lavender_ext.core.steps cimport finish_pair
from lavender_ext.core.rows cimport (compute_contact_delassus_block, compute_contact_velocity, cross, dot3,
                                     largest_eigenvalue_2x2, reciprocal_or_zero, compute_relative_velocity)
from lavender_ext.core.view cimport rows_t
from lavender_ext.engine.arrays cimport (ALTERNATING, BOX, CAP_CONTACT, H_CACHED, H_CONTACTS, H_CONTACT_ROWS, H_KEPT,
                                         H_FRICTION_SHAPE, H_MATCHES, H_ORDER, H_PAIRS, H_PHASE, H_REBUILT, H_STEP,
                                         H_WARM_START, NO_SHAPE, N_BODY, N_CACHE_IMPULSE, N_DYNAMIC, N_JOINT,
                                         N_JOINT_ROW, ROWS_PER_CONTACT,
                                         S_BETA, S_BOUNCE, S_H, S_MARGIN, S_MATCH, S_RECYCLE, S_ROLLING, S_SLOP, engine_t)
from lavender_ext.engine.bodies cimport rotate_to_body
from lavender_ext.engine.narrow_phase cimport collide_bodies, manifold_t
from lavender_ext.engine.projection cimport contact_normal_velocity
from lavender_ext.core.vectors cimport linear_combination3, copy3, subtract3


cdef enum:
    EARLY = 4


cdef inline uint64_t make_contact_key(int32_t a, int32_t b, int32_t feature) noexcept nogil:
    """Return a contact's cache key: 24 bits for each body and 16 for the feature, sorted like the pair list."""
    return ((<uint64_t>a) << 40) | ((<uint64_t>b) << 16) | (<uint64_t>feature)


cdef inline void compute_tangent(const double* n, double* t) noexcept nogil:
    """Compute a unit tangent: n x the coordinate axis with the smallest component of n, normalised."""
    cdef double x = fabs(n[0]), y = fabs(n[1]), z = fabs(n[2]), s
    if x <= y and x <= z:
        s = 1.0 / sqrt(n[1] * n[1] + n[2] * n[2])
        t[0] = 0.0
        t[1] = n[2] * s
        t[2] = -n[1] * s
    elif y <= z:
        s = 1.0 / sqrt(n[0] * n[0] + n[2] * n[2])
        t[0] = -n[2] * s
        t[1] = 0.0
        t[2] = n[0] * s
    else:
        s = 1.0 / sqrt(n[0] * n[0] + n[1] * n[1])
        t[0] = n[1] * s
        t[1] = -n[0] * s
        t[2] = 0.0


cdef inline double squared_distance(const double* a, const double* b) noexcept nogil:
    """Return the squared distance of two points."""
    cdef double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2]
    return x * x + y * y + z * z


cdef inline double squared_distance_to_cached_contact(const engine_t* e, int32_t c, int32_t entry) noexcept nogil:
    """Return the squared distance [m^2] of a contact from a cached one, the smaller of the two body frames' values."""
    cdef double x = squared_distance(e.cache_local + 6 * entry, e.local + 6 * c)
    cdef double y = squared_distance(e.cache_local + 6 * entry + 3, e.local + 6 * c + 3)
    return x if x < y else y


cdef inline void match_contacts_of_pair_to_cache(const engine_t* e, int32_t c, int32_t n, int32_t first,
                                                 int32_t* entry) noexcept nogil:
    """Find the cache entries of contacts c .. c + n - 1 of one pair; the pair's entries begin at `first`.

    Contacts are matched by key, then by position: a contact with a new key gets the nearest entry that no key has
    matched. entry (n) receives the indices, -1 for none.
    """
    cdef double max_distance2 = e.setting[S_MATCH] * e.setting[S_MATCH], x, min_distance2
    cdef uint64_t pair = e.key[c] >> 16
    cdef int32_t i, j, end = first, used = 0, missing = 0
    while end < e.head[H_CACHED] and end < first + 4 and (e.cache_key[end] >> 16) == pair:
        end += 1
    # match by key
    for j in range(n):
        entry[j] = -1
        for i in range(first, end):
            if (e.cache_key[i] == e.key[c + j] and not (used >> (i - first)) & 1
                    and squared_distance_to_cached_contact(e, c + j, i) <= max_distance2):
                entry[j] = i
                used |= 1 << (i - first)
                break
        missing += entry[j] < 0
    if missing == 0 or used == (1 << (end - first)) - 1:
        return
    # match the remaining contacts by distance
    for j in range(n):
        if entry[j] >= 0:
            continue
        min_distance2 = max_distance2
        for i in range(first, end):
            if not (used >> (i - first)) & 1:
                x = squared_distance_to_cached_contact(e, c + j, i)
                if x <= min_distance2:
                    min_distance2 = x
                    entry[j] = i
        if entry[j] >= 0:
            used |= 1 << (entry[j] - first)


cdef inline void warm_start_contact(engine_t* e, int32_t c, int32_t entry, int32_t nt, int32_t n_angular,
                                    double* lam) noexcept nogil:
    """Write the cached impulse to lam in this contact's frame; the cache stores friction as a world vector."""
    cdef double t2[3]
    cdef const double* p = e.cache_impulse + N_CACHE_IMPULSE * entry
    lam[0] = p[0]
    if nt > 0:
        cross(e.normal + 3 * c, e.tangent + 3 * c, t2)
        lam[1] = dot3(p + 1, e.tangent + 3 * c)
        lam[2] = dot3(p + 1, t2)
    if n_angular & 1:
        lam[1 + nt] = p[4]
    if n_angular & 2:
        lam[nt + n_angular - 1] = dot3(e.cache_roll + 3 * entry, e.tangent + 3 * c)
        lam[nt + n_angular] = dot3(e.cache_roll + 3 * entry, t2)


cdef inline void rotate_arm_to_body(const engine_t* e, int32_t body, const double* arm, double* out) noexcept nogil:
    """Copy a contact's arm for the cache: in the body's frame for a box, in the world frame for other shapes."""
    if e.kind_of_shape[body] == BOX:
        rotate_to_body(e.rot + 9 * body, arm, out)
    else:
        copy3(arm, out)


cdef inline void build_contact(engine_t* e, int32_t c, int32_t a, int32_t b, const manifold_t* m, int32_t at,
                               const double* tangent, int32_t nt) noexcept nogil:
    """Write bodies, key and geometry of contact c from point `at` of the manifold; its rows are built later."""
    e.contact_pair[2 * c] = a
    e.contact_pair[2 * c + 1] = b
    e.contact_body[2 * c] = e.dyn[a]
    e.contact_body[2 * c + 1] = e.dyn[b]
    e.key[c] = make_contact_key(a, b, m.feature[at])
    e.gap[c] = m.gap[at]
    copy3(m.point + 3 * at, e.point + 3 * c)
    copy3(m.normal, e.normal + 3 * c)
    subtract3(m.point + 3 * at, e.x + 3 * a, e.arm_a + 3 * c)
    subtract3(m.point + 3 * at, e.x + 3 * b, e.arm_b + 3 * c)
    rotate_arm_to_body(e, a, e.arm_a + 3 * c, e.local + 6 * c)
    rotate_arm_to_body(e, b, e.arm_b + 3 * c, e.local + 6 * c + 3)
    if nt > 0:
        copy3(tangent, e.tangent + 3 * c)


cdef inline void build_contact_rows(engine_t* e, int32_t c, int32_t nt, int32_t n_angular) noexcept nogil:
    """Compute the diagonal of A, the couplings and the step sizes of contact c."""
    cdef double off[2]
    cdef int32_t k, row = e.ptr[e.size[N_JOINT] + c], roll = row + nt + n_angular - 1
    cdef int32_t da = e.contact_body[2 * c], db = e.contact_body[2 * c + 1]
    cdef double* d = e.d + row
    # The common kind has constant sizes, so that the compiler unrolls its loops.
    if nt == 2 and not n_angular:
        compute_contact_delassus_block(e.normal + 3 * c, e.tangent + 3 * c, e.arm_a + 3 * c, e.arm_b + 3 * c, 2, 0, da, db,
                         e.inv_mass, e.inv_inertia, d, off, e.coupling + 5 * c,
                         e.inv_inertia_arm + 6 * (row - e.size[N_JOINT_ROW]))
    else:
        compute_contact_delassus_block(e.normal + 3 * c, e.tangent + 3 * c, e.arm_a + 3 * c, e.arm_b + 3 * c, nt, n_angular,
                         da, db, e.inv_mass, e.inv_inertia, d, off, e.coupling + 5 * c,
                         e.inv_inertia_arm + 6 * (row - e.size[N_JOINT_ROW]))
    for k in range(1 + nt + n_angular):
        d[k] += e.compliance[row + k]
    # step sizes: separate tangents for box friction, else one step from the tangents' largest eigenvalue
    e.step[row] = reciprocal_or_zero(d[0])
    if nt > 0 and e.head[H_FRICTION_SHAPE]:
        e.coupling[5 * c + 2] = off[0]
        e.step[row + 1] = reciprocal_or_zero(d[1])
        e.step[row + 2] = reciprocal_or_zero(d[2])
    elif nt > 0:
        finish_pair(largest_eigenvalue_2x2(d[1], off[0], d[2]), d + 1, e.step + row + 1)
    if n_angular & 1:
        e.step[row + 1 + nt] = reciprocal_or_zero(d[1 + nt])
    if n_angular & 2:
        finish_pair(largest_eigenvalue_2x2(e.d[roll], off[1], e.d[roll + 1]), e.d + roll, e.step + roll)


cdef inline void set_contact_target(engine_t* e, int32_t c, int32_t row, int32_t a, int32_t b, double bounce) noexcept nogil:
    """Set the normal row's target after the warm start; on entry b = -J v*."""
    cdef double h = e.setting[S_H], gap = e.gap[c], target = 0.0, relative_normal_velocity
    cdef double u[3]
    cdef double s[3]
    if gap > 0.0:
        if e.impulse[row] > 0.0:                        # (2)
            gap = e.setting[S_BETA] * (gap - e.setting[S_SLOP])
        if gap > 0.0:
            target = -gap / h                           # (1)
    if bounce > 0.0 and e.gap[c] - h * e.b[row] <= 0.0:  # (3)
        # The velocity before the substep; static bodies are at rest.
        compute_relative_velocity(e.v, a if e.dyn[a] >= 0 else -1, b if e.dyn[b] >= 0 else -1, e.arm_a + 3 * c, e.arm_b + 3 * c,
                                  u, s)
        relative_normal_velocity = dot3(e.normal + 3 * c, u)
        if relative_normal_velocity < -e.setting[S_BOUNCE] and -bounce * relative_normal_velocity > target:
            target = -bounce * relative_normal_velocity
    e.target[row] = target
    e.b[row] = target + e.b[row]                        # (4)


cdef inline int32_t is_contact_order_reversed(const engine_t* e) noexcept nogil:
    """Return whether the contacts of this step were built from the last pair to the first."""
    return e.head[H_ORDER] == ALTERNATING and (e.head[H_STEP] - e.head[H_PHASE]) & 1


cdef struct pair_properties_t:      # what the contacts of a pair have in common
    double mu                       # -
    double patch                    # m
    int32_t n_tangents
    int32_t n_angular               # bit 0: a spin row, bit 1: two rolling rows


cdef inline pair_properties_t combine_materials(const engine_t* e, int32_t a, int32_t b) noexcept nogil:
    """Return the properties of the contacts of bodies a and b."""
    cdef pair_properties_t out
    out.mu = sqrt(e.friction[a] * e.friction[b])
    out.patch = e.patch[a] if e.patch[a] < e.patch[b] else e.patch[b]
    out.n_tangents = 2 if out.mu > 0.0 else 0
    out.n_angular = 0
    if out.mu > 0.0:
        out.n_angular = (1 if out.patch > 0.0 else 0) + (2 if e.setting[S_ROLLING] > 0.0 else 0)
    return out


cdef inline int32_t count_contact_rows(const pair_properties_t* x) noexcept nogil:
    """Return the number of rows of a contact."""
    return 1 + x.n_tangents + (x.n_angular & 1) + (x.n_angular & 2)


cdef inline int32_t add_contacts_of_pair(engine_t* e, int32_t a, int32_t b, const manifold_t* m, int32_t c, int32_t row,
                                         int32_t* first) noexcept nogil:
    """Add contacts c .. c + m.n - 1 of a pair from `row` on, warm-started from the cache; return how many were matched.

    `first` is the cache entry at which the search for the pair begins.
    """
    cdef pair_properties_t x = combine_materials(e, a, b)
    cdef double tangent[3]
    cdef int32_t entry[4]
    cdef int32_t j, k, block, matches = 0, start = c, cached = e.head[H_CACHED], last_first = is_contact_order_reversed(e)
    cdef int32_t box = x.n_tangents > 0 and e.head[H_FRICTION_SHAPE], n_rows = count_contact_rows(&x)
    cdef uint64_t pair = make_contact_key(a, b, 0)
    if x.n_tangents > 0:
        compute_tangent(m.normal, tangent)
    for j in range(m.n):
        build_contact(e, c, a, b, m, m.n - 1 - j if last_first else j, tangent, x.n_tangents)
        block = e.size[N_JOINT] + c
        e.kind[block] = choose_contact_kind(box, x.n_angular & 1, x.n_angular & 2, x.n_tangents)
        e.mu[block] = x.mu
        e.patch_radius[block] = 1.0 if box else x.patch if x.n_angular & 1 else 0.0
        if e.size[ROWS_PER_CONTACT] > 4:
            e.rolling[block] = e.setting[S_ROLLING] if x.n_angular & 2 else 0.0
        for k in range(n_rows):
            e.impulse[row + k] = 0.0
        row += n_rows
        c += 1
        e.ptr[block + 1] = row
    # first cache entry of this pair, or its insertion position
    while first[0] < cached and e.cache_key[first[0]] < pair:
        first[0] += 1
    while first[0] > 0 and e.cache_key[first[0] - 1] >= pair:
        first[0] -= 1
    if e.head[H_WARM_START] and first[0] < cached:
        match_contacts_of_pair_to_cache(e, start, m.n, first[0], entry)
        for j in range(m.n):
            if entry[j] >= 0:
                k = e.ptr[e.size[N_JOINT] + start + j]
                warm_start_contact(e, start + j, entry[j], x.n_tangents, x.n_angular, e.impulse + k)
                matches += 1
    return matches


cdef inline int32_t build_contacts(engine_t* e) noexcept nogil:
    """Build all contacts of the pair list without their rows, warm-started from the cache, and return their number."""
    cdef manifold_t m
    cdef int32_t i, k, a, b, c = 0, row = e.size[N_JOINT_ROW], matches = 0, last_first = is_contact_order_reversed(e)
    cdef int32_t first = e.head[H_CACHED] if last_first else 0
    e.head[H_REBUILT] = 1
    for i in range(e.size[N_BODY]):
        e.moved[i] = 0.0
        e.due[i] = 0
    e.ptr[e.size[N_JOINT]] = row
    for i in range(e.head[H_PAIRS]):
        k = e.head[H_PAIRS] - 1 - i if last_first else i
        a = e.pair[2 * k]
        b = e.pair[2 * k + 1]
        collide_bodies(e, a, b, e.setting[S_MARGIN], &m)
        if m.n == 0:
            continue
        if c + m.n <= e.size[CAP_CONTACT]:
            matches += add_contacts_of_pair(e, a, b, &m, c, row, &first)
            row = e.ptr[e.size[N_JOINT] + c + m.n]
        c += m.n                                        # Only count contacts beyond the capacity.
    if c <= e.size[CAP_CONTACT]:
        e.head[H_CONTACTS] = c
        e.head[H_CONTACT_ROWS] = row - e.size[N_JOINT_ROW]
        e.head[H_MATCHES] = matches
        for i in range(c):
            e.order_scratch[i] = -1                     # every contact is new
    return c


cdef inline int32_t find_due_bodies(engine_t* e, int32_t shifted, int32_t ends) noexcept nogil:
    """Write the displacement of the bodies to e.shift after they have moved, and return whether a body is due, (5).

    `ends`: this was the last substep of a step.
    """
    cdef int32_t i, k, b, any_due = 0, n_due = 0
    cdef double h = e.setting[S_H], step, radius, limit
    cdef double* s
    cdef const double* size
    for i in range(e.size[N_DYNAMIC]):
        b = e.body_of[i]
        s = e.shift + 6 * i
        for k in range(6):
            s[k] = h * (e.v_free[6 * i + k] + e.dv[6 * i + k]) + (s[k] if shifted else 0.0)
        if e.kind_of_shape[b] == NO_SHAPE:
            continue
        size = e.shape + 4 * b
        radius = sqrt(dot3(size, size)) if e.kind_of_shape[b] == BOX else size[0]
        step = sqrt(dot3(s, s))
        if e.kind_of_shape[b] == BOX or e.uneven[b]:    # The surface of a sphere stays where it is when it turns.
            step += radius * sqrt(dot3(s + 3, s + 3))
        limit = min(0.5 * e.setting[S_MARGIN], 0.01 * radius)
        e.moved[b] += step
        e.due[b] = not e.moved[b] + step <= limit or (ends and e.moved[b] > e.setting[S_RECYCLE])
        any_due |= e.due[b]
    for i in range(2 * e.size[N_JOINT]):
        b = e.joint_bodies[i]
        if b >= 0 and e.kind_of_shape[b] != NO_SHAPE:
            e.due[b] = e.dyn[b] >= 0
            any_due |= e.due[b]
    if ends:
        for i in range(e.size[N_DYNAMIC]):
            b = e.body_of[i]
            if any_due and EARLY * e.moved[b] > e.setting[S_RECYCLE]:
                e.due[b] = 1
            n_due += e.due[b]
        e.head[H_KEPT] = 2 * n_due <= e.size[N_DYNAMIC]
    return any_due


cdef inline void follow_gaps(engine_t* e) noexcept nogil:
    """Move the gaps of all contacts by (5)."""
    cdef int32_t c
    for c in range(e.head[H_CONTACTS]):
        e.gap[c] += contact_normal_velocity(e, e.shift, c)


cdef inline void move_doubles(double* x, int32_t n, int32_t source, int32_t goal) noexcept nogil:
    """Copy entry `source` of x (., n) to entry `goal`."""
    cdef int32_t k
    for k in range(n):
        x[n * goal + k] = x[n * source + k]


cdef inline void move_contact(engine_t* e, int32_t source, int32_t goal) noexcept nogil:
    """Copy what belongs to a contact, except for its rows."""
    cdef int32_t kj = e.size[N_JOINT], k
    for k in range(2):
        e.contact_pair[2 * goal + k] = e.contact_pair[2 * source + k]
        e.contact_body[2 * goal + k] = e.contact_body[2 * source + k]
    e.key[goal] = e.key[source]
    e.kind[kj + goal] = e.kind[kj + source]
    move_doubles(e.gap, 1, source, goal)
    move_doubles(e.point, 3, source, goal)
    move_doubles(e.normal, 3, source, goal)
    move_doubles(e.arm_a, 3, source, goal)
    move_doubles(e.arm_b, 3, source, goal)
    move_doubles(e.local, 6, source, goal)
    move_doubles(e.mu + kj, 1, source, goal)
    move_doubles(e.patch_radius + kj, 1, source, goal)
    if e.size[ROWS_PER_CONTACT] > 1:
        move_doubles(e.tangent, 3, source, goal)
        move_doubles(e.coupling, 5, source, goal)
    if e.size[ROWS_PER_CONTACT] > 4:
        move_doubles(e.rolling + kj, 1, source, goal)


cdef inline void move_contact_rows(engine_t* e, int32_t n, int32_t source, int32_t goal) noexcept nogil:
    """Copy n rows, from row `source` to row `goal`; if these overlap, forwards to a lower row, backwards to a higher one."""
    cdef int32_t i, k, mj = e.size[N_JOINT_ROW]
    for i in range(n):
        k = i if goal < source else n - 1 - i
        move_doubles(e.inv_inertia_arm, 6, source + k - mj, goal + k - mj)
        move_doubles(e.d, 1, source + k, goal + k)
        move_doubles(e.step, 1, source + k, goal + k)
        move_doubles(e.impulse, 1, source + k, goal + k)


cdef inline void refresh_contact(engine_t* e, const blocks_t* p, const rows_t* r, int32_t c) noexcept nogil:
    """Write the right-hand side of a contact for the present velocities, gap and impulse."""
    cdef double w[6]
    cdef int32_t block = e.size[N_JOINT] + c, row = e.ptr[block], k, n = e.ptr[block + 1] - row
    cdef int32_t a = e.contact_pair[2 * c], b = e.contact_pair[2 * c + 1]
    if n == 3 and e.kind[block] == CONTACT:             # The common kind has constant sizes, so that loops are unrolled.
        compute_contact_velocity(r, c, 2, 0, e.v_free, w)
    else:
        compute_contact_velocity(r, c, count_tangent_rows(p, block), count_angular_rows(p, block), e.v_free, w)
    for k in range(n):
        e.target[row + k] = 0.0
        e.b[row + k] = 0.0 - w[k]
        if not e.head[H_WARM_START]:
            e.impulse[row + k] = 0.0
    set_contact_target(e, c, row, a, b, e.restitution[a] if e.restitution[a] > e.restitution[b] else e.restitution[b])


cdef inline int32_t plan_kept_contacts(engine_t* e, int32_t* source, int32_t* new_row, int32_t* n_rows) noexcept nogil:
    """Find where the contacts of this substep come from, and return their number; nothing is changed.

    source (cap) receives the present number of a kept contact, -1 for a new one, and new_row (cap) the first row.
    """
    cdef manifold_t m
    cdef pair_properties_t x
    cdef int32_t i, j, k, a, b, n, renewed, c = 0, row = e.size[N_JOINT_ROW], old = 0
    cdef int32_t last_first = is_contact_order_reversed(e)
    cdef uint64_t pair, own
    for i in range(e.head[H_PAIRS]):
        k = e.head[H_PAIRS] - 1 - i if last_first else i
        a = e.pair[2 * k]
        b = e.pair[2 * k + 1]
        pair = make_contact_key(a, b, 0) >> 16
        # the pair's contacts so far; a pair that has left the list loses its contacts
        n = 0
        while old + n < e.head[H_CONTACTS]:
            own = e.key[old + n] >> 16
            if own == pair:
                n += 1
            elif n == 0 and (own > pair if last_first else own < pair):
                old += 1
            else:
                break
        renewed = e.due[a] or e.due[b]
        if renewed:
            collide_bodies(e, a, b, e.setting[S_MARGIN], &m)
        x = combine_materials(e, a, b)
        for j in range(m.n if renewed else n):
            if c < e.size[CAP_CONTACT]:
                source[c] = -1 if renewed else old + j
                new_row[c] = row
            row += count_contact_rows(&x)
            c += 1
        old += n
    n_rows[0] = row - e.size[N_JOINT_ROW]
    return c


cdef inline int32_t renew_contacts(engine_t* e) noexcept nogil:
    """Keep the contacts whose bodies are not due, and build the others anew without their rows; return their number."""
    cdef manifold_t m
    cdef int32_t* source = e.order_scratch
    cdef int32_t* new_row = source + e.size[CAP_CONTACT]
    cdef int32_t i, k, a, b, c, n, n_rows, kj = e.size[N_JOINT], any_due = 0, last_first = is_contact_order_reversed(e)
    cdef int32_t first = e.head[H_CACHED] if last_first else 0
    for i in range(e.size[N_BODY]):
        any_due |= e.due[i]
    e.head[H_REBUILT] = any_due
    n = e.head[H_CONTACTS]
    if any_due:
        n = plan_kept_contacts(e, source, new_row, &n_rows)
        if n > e.size[CAP_CONTACT]:
            return n
        # Both orders of kept contacts are the same, so that moving to lower numbers from the first on, then to higher
        # ones from the last on, overwrites no contact that is still to be moved.
        for c in range(n):
            if source[c] > c:
                move_contact(e, source[c], c)
        for c in range(n - 1, -1, -1):
            if 0 <= source[c] < c:
                move_contact(e, source[c], c)
        for c in range(n):
            if source[c] >= 0 and e.ptr[kj + source[c]] > new_row[c]:
                move_contact_rows(e, e.ptr[kj + source[c] + 1] - e.ptr[kj + source[c]], e.ptr[kj + source[c]], new_row[c])
        for c in range(n - 1, -1, -1):
            if source[c] >= 0 and e.ptr[kj + source[c]] < new_row[c]:
                move_contact_rows(e, e.ptr[kj + source[c] + 1] - e.ptr[kj + source[c]], e.ptr[kj + source[c]], new_row[c])
        for c in range(n):
            e.ptr[kj + c] = new_row[c]
        e.ptr[kj + n] = e.size[N_JOINT_ROW] + n_rows
        e.head[H_CONTACTS] = n
        e.head[H_CONTACT_ROWS] = n_rows
    e.head[H_MATCHES] = 0
    for c in range(n):
        if not any_due or source[c] >= 0:
            e.head[H_MATCHES] += e.head[H_WARM_START]
    # the others
    if any_due:
        c = 0
        for i in range(e.head[H_PAIRS]):
            k = e.head[H_PAIRS] - 1 - i if last_first else i
            a = e.pair[2 * k]
            b = e.pair[2 * k + 1]
            if e.due[a] or e.due[b]:
                collide_bodies(e, a, b, e.setting[S_MARGIN], &m)
                if m.n > 0:
                    e.head[H_MATCHES] += add_contacts_of_pair(e, a, b, &m, c, new_row[c], &first)
                c += m.n
            else:
                while c < n and source[c] >= 0 and e.contact_pair[2 * c] == a and e.contact_pair[2 * c + 1] == b:
                    c += 1
        for i in range(e.size[N_BODY]):
            if e.due[i]:
                e.moved[i] = 0.0
                e.due[i] = 0
    return n


cdef inline void finish_contacts(engine_t* e, const blocks_t* p, const rows_t* r, bint all_rows) noexcept nogil:
    """Build the rows of the new contacts, or with `all_rows` of all contacts, and write the right-hand sides of all."""
    cdef int32_t c, block
    for c in range(e.head[H_CONTACTS]):
        if e.head[H_REBUILT] and (all_rows or e.order_scratch[c] < 0):
            block = e.size[N_JOINT] + c
            build_contact_rows(e, c, count_tangent_rows(p, block), count_angular_rows(p, block))
        refresh_contact(e, p, r, c)


cdef inline void store_contact_cache(engine_t* e) noexcept nogil:
    """Write the contact cache for the next substep, whether warm starting is on or not."""
    cdef int32_t c, k, row, nt, at, size, n = e.head[H_CONTACTS], last_first = is_contact_order_reversed(e)
    cdef double t2[3]
    cdef double* p
    for c in range(n):
        at = n - 1 - c if last_first else c
        row = e.ptr[e.size[N_JOINT] + c]
        nt = 2 if e.mu[e.size[N_JOINT] + c] > 0.0 else 0
        p = e.cache_impulse + N_CACHE_IMPULSE * at
        e.cache_key[at] = e.key[c]
        p[0] = e.impulse[row]
        if nt > 0:
            cross(e.normal + 3 * c, e.tangent + 3 * c, t2)
            linear_combination3(e.impulse[row + 1], e.tangent + 3 * c, e.impulse[row + 2], t2, p + 1)
        else:
            p[1] = p[2] = p[3] = 0.0
        size = e.ptr[e.size[N_JOINT] + c + 1] - row
        p[4] = e.impulse[row + 3] if size == 4 or size == 6 else 0.0
        if size > 4:
            linear_combination3(e.impulse[row + size - 2], e.tangent + 3 * c, e.impulse[row + size - 1], t2, e.cache_roll + 3 * at)
        elif e.size[ROWS_PER_CONTACT] > 4:
            for k in range(3):
                e.cache_roll[3 * at + k] = 0.0
        for k in range(6):
            e.cache_local[6 * at + k] = e.local[6 * c + k]
    e.head[H_CACHED] = n
