"""Contacts of a substep: manifolds to rows, right-hand sides, and what the cache knows about them.

A contact's rows are normal, two tangents where mu > 0, spin where mu and the patch radius are. With v the
velocities before the substep and v* those after gravity, g the gap and e the restitution,

    target_n = -g/h                     where g > 0: the gap may close, not more               (1)
             = -beta max(0, g - slop)/h where g > 0 and the cache says that the contact bears  (2)
             = -e v_n                   where v_n < -bounce and g + h v*_n <= 0, if more       (3)
             = 0                        otherwise; penetration is left to the position projection
    b = target - J v*                                                                          (4)

(2) is what lets a tower stand on few sweeps. A warm-started sweep takes a share kappa of what is left of a
slow mode in each substep; that mode rings like a spring with a damper of |z| = sqrt(1 - kappa). (1) closes
the whole gap in one substep: feedback of gain 1 on the same mode, unstable where it exceeds kappa or so. A
bearing contact is in place within a slop above as below, and comes back at the rate of the projection.

Combined: mu = sqrt(mu_a mu_b), e = max, patch radius = min.

Contacts are made pair by pair, and under the alternating order in every other substep from the last point of
the last pair to the first: what one direction of sweeping leaves behind on one side of a face, the next
leaves on the other.

The cache holds key, impulse and arms of the last substep's contacts, sorted by pair as the pair list is.
A contact takes the impulse of the entry with its key, if its point is within the match distance in the
frame of either body; where the key is new (a corner crossed an edge) the nearest entry of the pair that
no key has claimed. A stale or false entry is left alone, or corrected by the sweeps.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, uint64_t

from lavender_ext.core.parts cimport contact_kind
from lavender_ext.core.rows cimport (contact_diagonal, contact_slack, cross, dot3, largest_eigenvalue, reciprocal,
                                     relative_velocity)
from lavender_ext.core.view cimport rows_t
from lavender_ext.engine.arrays cimport (ALTERNATING, AVBD, BOX, CAP_CONTACT, H_CACHED, H_CONTACTS, H_CONTACT_ROWS,
                                         H_FRICTION_SHAPE, H_MATCHES, H_ORDER, H_PAIRS, H_STEP, H_STEPPER, H_WARM_START,
                                         N_CACHE_IMPULSE, N_JOINT, N_JOINT_ROW, ROWS_PER_CONTACT,
                                         S_BETA, S_BOUNCE, S_H, S_MARGIN, S_MATCH, S_ROLLING, S_SLOP, engine_t)
from lavender_ext.engine.bodies cimport to_body
from lavender_ext.engine.narrow_phase cimport collide, manifold_t
from lavender_ext.engine.vectors cimport both3, copy3, minus3


cdef inline uint64_t contact_key(int32_t a, int32_t b, int32_t feature) noexcept nogil:
    # 24 bits each for the bodies, 16 for the feature: sorted like the pair list
    return ((<uint64_t>a) << 40) | ((<uint64_t>b) << 16) | (<uint64_t>feature)


cdef inline void tangent_of(const double* n, double* t) noexcept nogil:
    # a unit vector normal to n: the coordinate axis that n is furthest from, made orthogonal
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


cdef inline double distance2(const double* a, const double* b) noexcept nogil:
    cdef double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2]
    return x * x + y * y + z * z


cdef inline double apart2(const engine_t* e, int32_t c, int32_t entry) noexcept nogil:
    # squared distance of a contact from a cached one, in the frame of the body where it moved less
    cdef double x = distance2(e.cache_local + 6 * entry, e.local + 6 * c)
    cdef double y = distance2(e.cache_local + 6 * entry + 3, e.local + 6 * c + 3)
    return x if x < y else y


cdef inline void match_pair(const engine_t* e, int32_t c, int32_t n, int32_t first,
                            int32_t* entry) noexcept nogil:
    """Cached entries of contacts c .. c + n - 1 of one pair, whose entries begin at `first`; -1 for none.

    By key, then by place: a contact whose key is new takes the nearest entry that no key has claimed.
    """
    cdef double reach = e.setting[S_MATCH] * e.setting[S_MATCH], x, least
    cdef uint64_t pair = e.key[c] >> 16
    cdef int32_t i, j, end = first, used = 0, missing = 0
    while end < e.head[H_CACHED] and end < first + 4 and (e.cache_key[end] >> 16) == pair:
        end += 1
    for j in range(n):
        entry[j] = -1
        for i in range(first, end):
            if (e.cache_key[i] == e.key[c + j] and not (used >> (i - first)) & 1
                    and apart2(e, c + j, i) <= reach):
                entry[j] = i
                used |= 1 << (i - first)
                break
        missing += entry[j] < 0
    if missing == 0 or used == (1 << (end - first)) - 1:
        return
    for j in range(n):
        if entry[j] >= 0:
            continue
        least = reach
        for i in range(first, end):
            if not (used >> (i - first)) & 1:
                x = apart2(e, c + j, i)
                if x <= least:
                    least = x
                    entry[j] = i
        if entry[j] >= 0:
            used |= 1 << (entry[j] - first)


cdef inline void guess_contact(engine_t* e, int32_t c, int32_t entry, int32_t nt, int32_t turns,
                               double* lam) noexcept nogil:
    # The cached impulse in this contact's frame: friction is kept as a world vector.
    cdef double t2[3]
    cdef const double* p = e.cache_impulse + N_CACHE_IMPULSE * entry
    lam[0] = p[0]
    if nt > 0:
        cross(e.normal + 3 * c, e.tangent + 3 * c, t2)
        lam[1] = dot3(p + 1, e.tangent + 3 * c)
        lam[2] = dot3(p + 1, t2)
    if turns & 1:
        lam[1 + nt] = p[4]
    if turns & 2:
        lam[nt + turns - 1] = dot3(e.cache_roll + 3 * entry, e.tangent + 3 * c)
        lam[nt + turns] = dot3(e.cache_roll + 3 * entry, t2)
    if e.head[H_STEPPER] == AVBD:
        e.push[e.size[N_JOINT_ROW] + c] = p[4]


cdef inline double restitution_of(const engine_t* e, int32_t a, int32_t b) noexcept nogil:
    return e.restitution[a] if e.restitution[a] > e.restitution[b] else e.restitution[b]


cdef inline double normal_velocity(const engine_t* e, int32_t a, int32_t b, int32_t c) noexcept nogil:
    # closing speed of a contact with the velocities before the substep, static bodies at rest
    cdef double u[3]
    cdef double s[3]
    relative_velocity(e.v, a if e.dyn[a] >= 0 else -1, b if e.dyn[b] >= 0 else -1, e.arm_a + 3 * c,
                      e.arm_b + 3 * c, u, s)
    return dot3(e.normal + 3 * c, u)


cdef inline void local_arm(const engine_t* e, int32_t body, const double* arm, double* out) noexcept nogil:
    # a sphere's contact does not turn with it; a box's does
    if e.kind_of_shape[body] == BOX:
        to_body(e.rot + 9 * body, arm, out)
    else:
        copy3(arm, out)


cdef inline void make_contact(engine_t* e, const rows_t* r, int32_t c, int32_t row, int32_t a, int32_t b,
                              const manifold_t* m, int32_t at, const double* tangent, int32_t nt,
                              int32_t turns) noexcept nogil:
    """Row data of contact c, rows row .. row + nt + turns, of point `at` of the manifold, but for its target."""
    cdef double off[2]
    cdef double w[6]
    cdef int32_t k, roll = row + nt + turns - 1, da = e.dyn[a], db = e.dyn[b]
    cdef double* d = e.d + row
    e.contact_pair[2 * c] = a
    e.contact_pair[2 * c + 1] = b
    e.contact_body[2 * c] = da
    e.contact_body[2 * c + 1] = db
    e.key[c] = contact_key(a, b, m.feature[at])
    e.gap[c] = m.gap[at]
    copy3(m.point + 3 * at, e.point + 3 * c)
    copy3(m.normal, e.normal + 3 * c)
    minus3(m.point + 3 * at, e.x + 3 * a, e.arm_a + 3 * c)
    minus3(m.point + 3 * at, e.x + 3 * b, e.arm_b + 3 * c)
    local_arm(e, a, e.arm_a + 3 * c, e.local + 6 * c)
    local_arm(e, b, e.arm_b + 3 * c, e.local + 6 * c + 3)
    if nt > 0:
        copy3(tangent, e.tangent + 3 * c)
    # the common kind with its size as constants, so that a compiler unrolls it
    if nt == 2 and not turns:
        contact_diagonal(e.normal + 3 * c, e.tangent + 3 * c, e.arm_a + 3 * c, e.arm_b + 3 * c, 2, 0, da, db,
                         e.inv_mass, e.inv_inertia, d, off, e.coupling + 5 * c,
                         e.swing + 6 * (row - e.size[N_JOINT_ROW]))
        contact_slack(r, c, 2, 0, e.v_free, w)
    else:
        contact_diagonal(e.normal + 3 * c, e.tangent + 3 * c, e.arm_a + 3 * c, e.arm_b + 3 * c, nt, turns,
                         da, db, e.inv_mass, e.inv_inertia, d, off, e.coupling + 5 * c,
                         e.swing + 6 * (row - e.size[N_JOINT_ROW]))
        contact_slack(r, c, nt, turns, e.v_free, w)
    for k in range(1 + nt + turns):
        d[k] += e.compliance[row + k]
    e.step[row] = reciprocal(d[0])
    if nt > 0 and e.head[H_FRICTION_SHAPE]:
        e.coupling[5 * c + 2] = off[0]
        e.step[row + 1] = reciprocal(d[1])
        e.step[row + 2] = reciprocal(d[2])
    elif nt > 0:
        e.step[row + 1] = reciprocal(largest_eigenvalue(d[1], off[0], d[2]))
        e.step[row + 2] = e.step[row + 1]
        d[1] = 0.5 * (d[1] + d[2])
        d[2] = d[1]
    if turns & 1:
        e.step[row + 1 + nt] = reciprocal(d[1 + nt])
    if turns & 2:
        e.step[roll] = e.step[roll + 1] = reciprocal(largest_eigenvalue(e.d[roll], off[1], e.d[roll + 1]))
        e.d[roll] = e.d[roll + 1] = 0.5 * (e.d[roll] + e.d[roll + 1])
    for k in range(1 + nt + turns):
        e.target[row + k] = 0.0
        e.b[row + k] = 0.0 - w[k]


cdef inline void aim_contact(engine_t* e, int32_t c, int32_t row, int32_t a, int32_t b, double bounce) noexcept nogil:
    # Target of the normal row, once the guess is there: b = -J v* so far.
    cdef double h = e.setting[S_H], gap = e.gap[c], target = 0.0, vn
    if gap > 0.0:
        if e.impulse[row] > 0.0:                        # (2)
            gap = e.setting[S_BETA] * (gap - e.setting[S_SLOP])
        if gap > 0.0:
            target = -gap / h                           # (1)
    if bounce > 0.0 and e.gap[c] - h * e.b[row] <= 0.0:  # (3)
        vn = normal_velocity(e, a, b, c)
        if vn < -e.setting[S_BOUNCE] and -bounce * vn > target:
            target = -bounce * vn
    e.target[row] = target
    e.b[row] = target + e.b[row]                        # (4)


cdef inline int32_t backwards(const engine_t* e) noexcept nogil:
    return e.head[H_ORDER] == ALTERNATING and e.head[H_STEP] & 1


cdef inline int32_t make_contacts(engine_t* e, const rows_t* r) noexcept nogil:
    """All contacts of the pair list, with guesses from the cache; returns how many there are."""
    cdef manifold_t m
    cdef double tangent[3]
    cdef int32_t entry[4]
    cdef int32_t i, j, k, a, b, nt, turns, box, start, c = 0, row = e.size[N_JOINT_ROW], block
    cdef int32_t matches = 0, last_first = backwards(e), cached = e.head[H_CACHED]
    cdef int32_t first = cached if last_first else 0
    cdef double mu, patch, bounce, margin = e.setting[S_MARGIN]
    cdef uint64_t pair
    e.ptr[e.size[N_JOINT]] = row
    for i in range(e.head[H_PAIRS]):
        k = e.head[H_PAIRS] - 1 - i if last_first else i
        a = e.pair[2 * k]
        b = e.pair[2 * k + 1]
        collide(e, a, b, margin, &m)
        if m.n == 0:
            continue
        if c + m.n > e.size[CAP_CONTACT]:
            c += m.n                                    # only counted from here on
            continue
        mu = sqrt(e.friction[a] * e.friction[b])
        bounce = restitution_of(e, a, b)
        patch = e.patch[a] if e.patch[a] < e.patch[b] else e.patch[b]
        nt = 2 if mu > 0.0 else 0
        turns = 0 if not mu > 0.0 else (1 if patch > 0.0 else 0) + (2 if e.setting[S_ROLLING] > 0.0 else 0)
        if nt > 0:
            tangent_of(m.normal, tangent)
        pair = contact_key(a, b, 0)
        # the first entry of this pair, or where it would stand
        while first < cached and e.cache_key[first] < pair:
            first += 1
        while first > 0 and e.cache_key[first - 1] >= pair:
            first -= 1
        start = c
        for j in range(m.n):
            make_contact(e, r, c, row, a, b, &m, m.n - 1 - j if last_first else j, tangent, nt, turns)
            block = e.size[N_JOINT] + c
            box = nt > 0 and e.head[H_FRICTION_SHAPE]
            e.kind[block] = contact_kind(box, turns & 1, turns & 2, nt)
            e.mu[block] = mu
            e.patch_radius[block] = 1.0 if box else patch if turns & 1 else 0.0
            if e.size[ROWS_PER_CONTACT] > 4:
                e.rolling[block] = e.setting[S_ROLLING] if turns & 2 else 0.0
            for k in range(1 + nt + turns):
                e.impulse[row + k] = 0.0
            e.push[e.size[N_JOINT_ROW] + c] = 0.0
            row += 1 + nt + turns
            c += 1
            e.ptr[block + 1] = row
        if e.head[H_WARM_START] and first < cached:
            match_pair(e, start, m.n, first, entry)
            for j in range(m.n):
                if entry[j] >= 0:
                    k = e.ptr[e.size[N_JOINT] + start + j]
                    guess_contact(e, start + j, entry[j], nt, turns, e.impulse + k)
                    matches += 1
        for j in range(start, c):
            aim_contact(e, j, e.ptr[e.size[N_JOINT] + j], a, b, bounce)
    if c <= e.size[CAP_CONTACT]:
        e.head[H_CONTACTS] = c
        e.head[H_CONTACT_ROWS] = row - e.size[N_JOINT_ROW]
        e.head[H_MATCHES] = matches
    return c


cdef inline void store_contacts(engine_t* e) noexcept nogil:
    """The cache of the next substep; kept up to date whether warm starting is on or not."""
    cdef int32_t c, k, row, nt, at, size, n = e.head[H_CONTACTS], last_first = backwards(e)
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
            both3(e.impulse[row + 1], e.tangent + 3 * c, e.impulse[row + 2], t2, p + 1)
        else:
            p[1] = p[2] = p[3] = 0.0
        size = e.ptr[e.size[N_JOINT] + c + 1] - row
        p[4] = e.impulse[row + 3] if size == 4 or size == 6 else 0.0
        if size > 4:
            both3(e.impulse[row + size - 2], e.tangent + 3 * c, e.impulse[row + size - 1], t2, e.cache_roll + 3 * at)
        elif e.size[ROWS_PER_CONTACT] > 4:
            for k in range(3):
                e.cache_roll[3 * at + k] = 0.0
        if e.head[H_STEPPER] == AVBD:                   # which has no spin: the stiffness of the contact
            p[4] = e.push[e.size[N_JOINT_ROW] + c]
        for k in range(6):
            e.cache_local[6 * at + k] = e.local[6 * c + k]
    e.head[H_CACHED] = n
