/* Passes over groups of manifolds for one set of instructions, see manifolds.h, which defines and this file removes
 *
 *     FOUR(f)     name of function f
 *     ISA         attribute that selects the instructions
 *     LOAD_FOUR(a, b, c, d, out), STORE_FOUR(a, b, c, d, in)
 *                 transposes: entry k of the vectors out, in (4) holds numbers k of the arrays a, b, c, d
 *     LOAD_TWO, STORE_TWO
 *                 the same with two numbers of each array
 *     ROOT(x), ANY(mask)
 */

/* Velocities (6) of one body of each lane, at the offsets `at`. */
ISA LAVENDER_INLINE_FOUR void FOUR(load_bodies)(const double* v, const int32_t* at, lavender_four* out) {
    const double *a = v + at[0], *b = v + at[1], *c = v + at[2], *d = v + at[3];
    LOAD_FOUR(a, b, c, d, out);
    LOAD_TWO(a + 4, b + 4, c + 4, d + 4, out + 4);
}

ISA LAVENDER_INLINE_FOUR void FOUR(store_bodies)(double* v, const int32_t* at, const lavender_four* in) {
    double *a = v + at[0], *b = v + at[1], *c = v + at[2], *d = v + at[3];
    STORE_FOUR(a, b, c, d, in);
    STORE_TWO(a + 4, b + 4, c + 4, d + 4, in + 4);
}

/* Relative velocity u (3) at a point of each lane, (1) of core/rows.pxd. */
ISA LAVENDER_INLINE_FOUR void FOUR(relative_velocity)(const lavender_point* p, const lavender_four* va, const lavender_four* vb,
                                                      lavender_four* u) {
    const lavender_four *ra = p->arm_a, *rb = p->arm_b;
    u[0] = vb[0] + (vb[4] * rb[2] - vb[5] * rb[1]);
    u[1] = vb[1] + (vb[5] * rb[0] - vb[3] * rb[2]);
    u[2] = vb[2] + (vb[3] * rb[1] - vb[4] * rb[0]);
    u[0] = u[0] - (va[0] + (va[4] * ra[2] - va[5] * ra[1]));
    u[1] = u[1] - (va[1] + (va[5] * ra[0] - va[3] * ra[2]));
    u[2] = u[2] - (va[2] + (va[3] * ra[1] - va[4] * ra[0]));
}

ISA LAVENDER_INLINE_FOUR void FOUR(cross)(const lavender_four* a, const lavender_four* b, lavender_four* out) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

/* Inverse inertias (9, and 3 numbers that nothing reads) of one body of each lane; at: offsets of velocities. */
ISA LAVENDER_INLINE_FOUR void FOUR(load_inertias)(const double* inverse, const int32_t* at, lavender_four* out) {
    const double *a = inverse + 3 * (at[0] / 2), *b = inverse + 3 * (at[1] / 2), *c = inverse + 3 * (at[2] / 2);
    const double* d = inverse + 3 * (at[3] / 2);
    for (int k = 0; k < 12; k += 4) LOAD_FOUR(a + k, b + k, c + k, d + k, out + k);
}

/* Diagonal d (2 of each contact), steps, couplings and I^-1 (arm x axis) of all points: `compute_contact_delassus_block` of
 * core/rows.pxd and `finish_pair` of core/steps.pxd for two tangents in a disk. inverse (bodies + 1, 12): inverse inertia. */
ISA static void FOUR(rows)(const lavender_group* g, lavender_rows* rows, const double* inverse, double* d) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0}, one = zero + 1.0, half = zero + 0.5;
    const lavender_four* axis = g->axis;
    const lavender_four mass = (zero + g->inv_mass_a) + g->inv_mass_b;
    const lavender_four d_n = mass * LAVENDER_DOT_FOUR(axis, axis), d_1 = mass * LAVENDER_DOT_FOUR(axis + 3, axis + 3);
    const lavender_four d_2 = mass * LAVENDER_DOT_FOUR(axis + 6, axis + 6), c_1 = mass * LAVENDER_DOT_FOUR(axis + 3, axis);
    const lavender_four c_2 = mass * LAVENDER_DOT_FOUR(axis + 6, axis), off_12 = mass * LAVENDER_DOT_FOUR(axis + 3, axis + 6);
    lavender_four inv[2][12];
    FOUR(load_inertias)(inverse, g->read_a, inv[0]);
    FOUR(load_inertias)(inverse, g->read_b, inv[1]);
    for (int j = 0; j < g->n; j++) {
        const lavender_point* p = g->point + j;
        lavender_rows* out = rows + j;
        lavender_four sum[6] = {zero, zero, zero, zero, zero, zero};    /* d, coupling, A_t1t2 */
        for (int side = 0; side < 2; side++) {
            lavender_four l[9], k[9];
            for (int i = 0; i < 9; i += 3) {
                FOUR(cross)(side ? p->arm_b : p->arm_a, axis + i, l + i);
                for (int q = 0; q < 3; q++) {
                    k[i + q] = LAVENDER_DOT_FOUR(inv[side] + 3 * q, l + i);
                    out->inv_inertia_arm[2 * i + 3 * side + q] = k[i + q];
                }
                sum[i / 3] = sum[i / 3] + LAVENDER_DOT_FOUR(l + i, k + i);
            }
            sum[3] = sum[3] + LAVENDER_DOT_FOUR(l + 3, k);
            sum[4] = sum[4] + LAVENDER_DOT_FOUR(l + 6, k);
            sum[5] = sum[5] + LAVENDER_DOT_FOUR(l + 3, k + 6);
        }
        const lavender_four a = sum[1] + d_1, b = sum[5] + off_12, c = sum[2] + d_2, h = half * (a - c);
        const lavender_four eigenvalue = half * (a + c) + ROOT(h * h + b * b), pair = half * (a + c);
        const lavender_four most = LAVENDER_PICK_FOUR(eigenvalue > zero, eigenvalue, pair);
        lavender_four both[2];
        both[0] = sum[0] + d_n;
        both[1] = pair;
        out->step[0] = LAVENDER_PICK_FOUR(both[0] > zero, one / both[0], zero);
        out->step[1] = LAVENDER_PICK_FOUR(most > zero, one / most, zero);
        out->coupling[0] = sum[3] + c_1;
        out->coupling[1] = sum[4] + c_2;
        const int32_t* at = g->contact[j];
        double *d0 = d + at[0] / 4, *d1 = d + at[1] / 4, *d2 = d + at[2] / 4, *d3 = d + at[3] / 4;
        STORE_TWO(d0, d1, d2, d3, both);
    }
}

/* Let the gaps follow the displacement of the bodies, (5) of engine/contacts.pxd. */
ISA static void FOUR(follow)(const lavender_group* g, const double* shift, double* x, lavender_four* own) {
    lavender_four sa[6], sb[6], u[3];
    FOUR(load_bodies)(shift, g->read_a, sa);
    FOUR(load_bodies)(shift, g->read_b, sb);
    for (int j = 0; j < g->n; j++) {
        const int32_t* at = g->contact[j];
        FOUR(relative_velocity)(g->point + j, sa, sb, u);
        const lavender_four closing = LAVENDER_DOT_FOUR(g->axis, u);
        if (own) {
            own[8 * j + 3] = own[8 * j + 3] + closing;
            continue;
        }
        for (int lane = 0; lane < 4; lane++) x[at[lane] + 3] += closing[lane];
    }
}

/* Largest -gap of the points, at least `depth`; bad: not 0 if a gap or impulse is not finite. */
ISA static void FOUR(check)(const lavender_group* g, const double* x, const lavender_four* own, lavender_four* depth,
                            lavender_four* bad) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0};
    for (int j = 0; j < g->n; j++) {
        const int32_t* at = g->contact[j];
        lavender_four lam[4];
        if (own) for (int k = 0; k < 4; k++) lam[k] = own[8 * j + k];
        else LOAD_FOUR(x + at[0], x + at[1], x + at[2], x + at[3], lam);
        if (j >= g->n_all) lam[3] = LAVENDER_PICK_FOUR(LAVENDER_HAS_POINT(g, j), lam[3], zero);
        for (int k = 0; k < 4; k++) *bad = *bad + zero * lam[k];
        *depth = LAVENDER_PICK_FOUR(-lam[3] > *depth, -lam[3], *depth);
    }
}

/* Write the shift that each point requires for the velocities v by (1) of engine/projection.pxd, its multiplier 0, and its step,
 * 0 where a lane has no point, to `push`. most: largest required shift; due: whether one is positive. */
ISA static void FOUR(aim)(const lavender_group* g, const lavender_rows* rows, const lavender_targets* t, const double* v,
                          const double* x, const lavender_four* own, lavender_four* push, lavender_four* most,
                          lavender_four_bits* due) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0}, h = zero + t->h, limit = zero + t->max_push;
    lavender_four va[6], vb[6], u[3];
    FOUR(load_bodies)(v, g->read_a, va);
    FOUR(load_bodies)(v, g->read_b, vb);
    for (int j = 0; j < g->n; j++) {
        const int32_t* at = g->contact[j];
        const lavender_four gap = own ? own[8 * j + 3]
                                      : (lavender_four){x[at[0] + 3], x[at[1] + 3], x[at[2] + 3], x[at[3] + 3]};
        FOUR(relative_velocity)(g->point + j, va, vb, u);
        lavender_four goal = -t->beta * (gap + h * LAVENDER_DOT_FOUR(g->axis, u) + t->slop);
        const lavender_four_bits has = LAVENDER_HAS_POINT(g, j);
        goal = LAVENDER_PICK_FOUR(has, goal, zero);
        *due = *due | (goal > zero);
        goal = LAVENDER_PICK_FOUR(goal < limit, goal, limit);
        *most = LAVENDER_PICK_FOUR(goal > *most, goal, *most);
        push[4 * j] = goal;
        push[4 * j + 1] = zero;
        push[4 * j + 2] = LAVENDER_PICK_FOUR(has, rows[j].step[0], zero);
    }
}

/* Update the multipliers and the shift s of the bodies: a sweep of `project_positions` in engine/projection.pxd. */
ISA static void FOUR(project)(const lavender_group* g, int backwards, const double* inverse, lavender_four* push, double* s) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0};
    lavender_four sa[6], sb[6], inv_a[12], inv_b[12], u[3], impulse[3], l[3];
    FOUR(load_bodies)(s, g->read_a, sa);
    FOUR(load_bodies)(s, g->read_b, sb);
    FOUR(load_inertias)(inverse, g->read_a, inv_a);
    FOUR(load_inertias)(inverse, g->read_b, inv_b);
    for (int j = 0; j < g->n; j++) {
        const int k = backwards ? g->n - 1 - j : j;
        const lavender_point* p = g->point + k;
        lavender_four* at = push + 4 * k;
        FOUR(relative_velocity)(p, sa, sb, u);
        lavender_four multiplier = at[1] - (LAVENDER_DOT_FOUR(g->axis, u) - at[0]) * at[2];
        multiplier = LAVENDER_PICK_FOUR(multiplier < zero, zero, multiplier);
        const lavender_four change = multiplier - at[1];
        if (!ANY(change != zero)) continue;
        at[1] = multiplier;
        for (int i = 0; i < 3; i++) impulse[i] = change * g->axis[i];
        FOUR(cross)(p->arm_a, impulse, l);
        for (int i = 0; i < 3; i++) {
            sa[i] = sa[i] - g->inv_mass_a * impulse[i];
            sa[3 + i] = sa[3 + i] - LAVENDER_DOT_FOUR(inv_a + 3 * i, l);
        }
        FOUR(cross)(p->arm_b, impulse, l);
        for (int i = 0; i < 3; i++) {
            sb[i] = sb[i] + g->inv_mass_b * impulse[i];
            sb[3 + i] = sb[3 + i] + LAVENDER_DOT_FOUR(inv_b + 3 * i, l);
        }
    }
    FOUR(store_bodies)(s, g->write_a, sa);
    FOUR(store_bodies)(s, g->write_b, sb);
}

/* Largest part of a required shift that s does not make, at least `most`. */
ISA static void FOUR(miss)(const lavender_group* g, const lavender_four* push, const double* s, lavender_four* most) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0};
    lavender_four sa[6], sb[6], u[3];
    FOUR(load_bodies)(s, g->read_a, sa);
    FOUR(load_bodies)(s, g->read_b, sb);
    for (int j = 0; j < g->n; j++) {
        FOUR(relative_velocity)(g->point + j, sa, sb, u);
        lavender_four rest = push[4 * j] - LAVENDER_DOT_FOUR(g->axis, u);
        if (j >= g->n_all) rest = LAVENDER_PICK_FOUR(LAVENDER_HAS_POINT(g, j), rest, zero);
        *most = LAVENDER_PICK_FOUR(rest > *most, rest, *most);
    }
}

/* Right-hand sides for the velocities `free`, the gaps and the impulses: (1) to (4) of engine/contacts.pxd. With f, also add
 * J^T lam to the wrenches f of the bodies: `add_contact_wrench` of core/velocity.pxd. */
ISA static void FOUR(refresh)(const lavender_group* g, const lavender_targets* t, int backwards, const double* free,
                              const double* before, double* x, lavender_four* own, double* f) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0}, h = zero + t->h;
    lavender_four va[6], vb[6], ua[6], ub[6], fa[6], fb[6], old_a[6], old_b[6];
    FOUR(load_bodies)(free, g->read_a, va);
    FOUR(load_bodies)(free, g->read_b, vb);
    if (before) {
        FOUR(load_bodies)(before, g->read_a, ua);
        FOUR(load_bodies)(before, g->read_b, ub);
    }
    if (f) {
        FOUR(load_bodies)(f, g->read_a, fa);
        FOUR(load_bodies)(f, g->read_b, fb);
    }
    for (int j = 0; j < g->n; j++) {
        const int k = backwards ? g->n - 1 - j : j;
        const lavender_point* p = g->point + k;
        const int32_t* at = g->contact[k];
        double *x0 = x + at[0], *x1 = x + at[1], *x2 = x + at[2], *x3 = x + at[3];
        lavender_four lam[4], u[3], out[4], b, force[3], l[3];
        if (own) {
            if (!t->warm) own[8 * k] = own[8 * k + 1] = own[8 * k + 2] = zero;
            for (int i = 0; i < 4; i++) lam[i] = own[8 * k + i];
        } else {
            if (!t->warm) x0[0] = x1[0] = x2[0] = x3[0] = x0[1] = x1[1] = x2[1] = x3[1] = x0[2] = x1[2] = x2[2] = x3[2] = 0.0;
            LOAD_FOUR(x0, x1, x2, x3, lam);
        }
        FOUR(relative_velocity)(p, va, vb, u);
        lavender_four gap = lam[3];
        const lavender_four_bits open = gap > zero;
        gap = LAVENDER_PICK_FOUR(lam[0] > zero, t->beta * (gap - t->slop), gap);
        lavender_four target = LAVENDER_PICK_FOUR(open & (gap > zero), -gap / h, zero);
        b = zero - LAVENDER_DOT_FOUR(g->axis, u);
        if (before) {
            lavender_four v[3];
            FOUR(relative_velocity)(p, ua, ub, v);
            const lavender_four speed = LAVENDER_DOT_FOUR(g->axis, v), back = -g->bounce * speed;
            const lavender_four_bits closes = (g->bounce > zero) & (lam[3] - h * b <= zero) & (speed < -(zero + t->bounce));
            target = LAVENDER_PICK_FOUR(closes & (back > target), back, target);
        }
        out[0] = zero - (target + b);
        out[1] = zero - (zero - LAVENDER_DOT_FOUR(g->axis + 3, u));
        out[2] = zero - (zero - LAVENDER_DOT_FOUR(g->axis + 6, u));
        out[3] = target;
        if (own) for (int i = 0; i < 4; i++) own[8 * k + 4 + i] = out[i];
        else STORE_FOUR(x0 + 4, x1 + 4, x2 + 4, x3 + 4, out);
        if (!f) continue;
        for (int i = 0; i < 6; i++) {
            old_a[i] = fa[i];
            old_b[i] = fb[i];
        }
        for (int i = 0; i < 3; i++) force[i] = (lam[0] * g->axis[i] + lam[1] * g->axis[3 + i]) + lam[2] * g->axis[6 + i];
        FOUR(cross)(p->arm_a, force, l);
        for (int i = 0; i < 3; i++) {
            fa[i] = fa[i] - force[i];
            fa[3 + i] = fa[3 + i] - l[i];
        }
        FOUR(cross)(p->arm_b, force, l);
        for (int i = 0; i < 3; i++) {
            fb[i] = fb[i] + force[i];
            fb[3 + i] = fb[3 + i] + l[i];
        }
        if (k < g->n_all) continue;
        const lavender_four_bits has = LAVENDER_HAS_POINT(g, k);
        for (int i = 0; i < 6; i++) {
            fa[i] = LAVENDER_PICK_FOUR(has, fa[i], old_a[i]);
            fb[i] = LAVENDER_PICK_FOUR(has, fb[i], old_b[i]);
        }
    }
    if (f) {
        FOUR(store_bodies)(f, g->write_a, fa);
        FOUR(store_bodies)(f, g->write_b, fb);
    }
}

/* Update point p of each lane: `relax_contact` of core/contact.pxd for two tangents in a disk and no compliance. At x + its
 * offset, or without x in own, a contact has its impulses (3), gap, negative right-hand sides (3) and target. */
ISA LAVENDER_INLINE_FOUR void FOUR(relax)(const lavender_group* g, const lavender_point* p, const lavender_rows* r,
                                          const int32_t* at, double* x, lavender_four* own, lavender_four* va,
                                          lavender_four* vb) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0};
    double *x0 = x ? x + at[0] : x, *x1 = x ? x + at[1] : x, *x2 = x ? x + at[2] : x, *x3 = x ? x + at[3] : x;
    lavender_four lam[4], minus_b[4], u[3], impulse[3], change[3];
    if (x) {
        LOAD_FOUR(x0, x1, x2, x3, lam);
        LOAD_FOUR(x0 + 4, x1 + 4, x2 + 4, x3 + 4, minus_b);
    } else {
        for (int k = 0; k < 3; k++) {
            lam[k] = own[k];
            minus_b[k] = own[4 + k];
        }
    }
    FOUR(relative_velocity)(p, va, vb, u);
    /* normal */
    lavender_four slack = LAVENDER_DOT_FOUR(g->axis, u) + minus_b[0];
    lavender_four normal = lam[0] - slack * r->step[0];
    normal = LAVENDER_PICK_FOUR(normal < zero, zero, normal);
    change[0] = normal - lam[0];
    for (int k = 0; k < 3; k++) impulse[k] = change[0] * g->axis[k];
    /* tangents */
    const lavender_four bound = g->mu * normal;
    slack = (LAVENDER_DOT_FOUR(g->axis + 3, u) + minus_b[1]) + r->coupling[0] * change[0];
    lavender_four first = lam[1] - slack * r->step[1];
    slack = (LAVENDER_DOT_FOUR(g->axis + 6, u) + minus_b[2]) + r->coupling[1] * change[0];
    lavender_four second = lam[2] - slack * r->step[1];
    const lavender_four square = first * first + second * second;
    const lavender_four_bits outside = square > bound * bound;
    if (ANY(outside)) {
        /* Without a normal impulse the scale is 0, and no root is needed. */
        const lavender_four_bits loaded = bound > zero;
        lavender_four scale = bound;
        if (ANY(outside & loaded)) scale = LAVENDER_PICK_FOUR(loaded, bound / ROOT(square), bound);
        first = LAVENDER_PICK_FOUR(outside, first * scale, first);
        second = LAVENDER_PICK_FOUR(outside, second * scale, second);
    }
    change[1] = first - lam[1];
    change[2] = second - lam[2];
    lam[0] = normal;
    lam[1] = first;
    lam[2] = second;
    if (x) STORE_FOUR(x0, x1, x2, x3, lam);
    else for (int k = 0; k < 3; k++) own[k] = lam[k];
    for (int k = 0; k < 3; k++) impulse[k] = (impulse[k] + change[1] * g->axis[3 + k]) + change[2] * g->axis[6 + k];
    /* velocities of both bodies */
    for (int k = 0; k < 3; k++) {
        const lavender_four *i = r->inv_inertia_arm + k, *j = i + 3;
        va[k] = va[k] - g->inv_mass_a * impulse[k];
        va[3 + k] = va[3 + k] - ((change[0] * i[0] + change[1] * i[6]) + change[2] * i[12]);
        vb[k] = vb[k] + g->inv_mass_b * impulse[k];
        vb[3 + k] = vb[3 + k] + ((change[0] * j[0] + change[1] * j[6]) + change[2] * j[12]);
    }
}

/* Update all manifolds of a group. A point that not every lane has changes only the lanes that have it. */
ISA LAVENDER_INLINE_FOUR void FOUR(relax_group)(const lavender_group* g, const lavender_rows* rows, int backwards, double* x,
                                                lavender_four* own, double* v) {
    lavender_four va[6], vb[6], old_a[6], old_b[6];
    FOUR(load_bodies)(v, g->read_a, va);
    FOUR(load_bodies)(v, g->read_b, vb);
    for (int j = 0; j < g->n; j++) {
        const int k = backwards ? g->n - 1 - j : j;
        lavender_four* at = own ? own + 8 * k : own;
        if (k < g->n_all) {
            FOUR(relax)(g, g->point + k, rows + k, g->contact[k], x, at, va, vb);
            continue;
        }
        for (int i = 0; i < 6; i++) {
            old_a[i] = va[i];
            old_b[i] = vb[i];
        }
        FOUR(relax)(g, g->point + k, rows + k, g->contact[k], x, at, va, vb);
        const lavender_four_bits has = LAVENDER_HAS_POINT(g, k);
        for (int i = 0; i < 6; i++) {
            va[i] = LAVENDER_PICK_FOUR(has, va[i], old_a[i]);
            vb[i] = LAVENDER_PICK_FOUR(has, vb[i], old_b[i]);
        }
    }
    FOUR(store_bodies)(v, g->write_a, va);
    FOUR(store_bodies)(v, g->write_b, vb);
}

/* A sweep, or several, over all groups; two functions, so that the compiler sees which of x and own there is. */
ISA static __attribute__((noinline)) void FOUR(sweep)(const lavender_manifolds* m, int backwards) {
    for (int i = 0; i < m->n_groups; i++) {
        const lavender_group* g = (const lavender_group*)(m->groups + m->start[backwards ? m->n_groups - 1 - i : i]);
        FOUR(relax_group)(g, m->rows + g->first_row, backwards, m->x, NULL, m->v);
    }
}

ISA static __attribute__((noinline)) void FOUR(sweep_own)(const lavender_manifolds* m, int backwards) {
    for (int i = 0; i < m->n_groups; i++) {
        const lavender_group* g = (const lavender_group*)(m->groups + m->start[backwards ? m->n_groups - 1 - i : i]);
        FOUR(relax_group)(g, m->rows + g->first_row, backwards, NULL, m->own + 8 * (size_t)g->first_row, m->v);
    }
}

/* One pass, with the numbers and arrays of `t` that it needs. */
ISA static void FOUR(run)(const lavender_manifolds* m, int what, int backwards, lavender_targets* t) {
    lavender_four most = {0.0, 0.0, 0.0, 0.0}, bad = most;
    lavender_four_bits due = (lavender_four_bits)most;
    if (what == LAVENDER_SWEEP) {
        if (m->own) FOUR(sweep_own)(m, backwards);
        else FOUR(sweep)(m, backwards);
        return;
    }
    for (int i = 0; i < m->n_once; i++) {
        const lavender_group* g = (const lavender_group*)(m->groups + m->start_once[backwards ? m->n_once - 1 - i : i]);
        const size_t row = (size_t)g->first_row;
        lavender_rows* rows = m->rows + row;
        lavender_four *own = m->own ? m->own + 8 * row : NULL, *push = m->push + 4 * row;
        if (what == LAVENDER_ROWS) FOUR(rows)(g, rows, m->inverse, m->d);
        else if (what == LAVENDER_REFRESH) FOUR(refresh)(g, t, backwards, m->free, t->before, m->x, own, t->wrench);
        else if (what == LAVENDER_FOLLOW) FOUR(follow)(g, m->free, m->x, own);
        else if (what == LAVENDER_CHECK) FOUR(check)(g, m->x, own, &most, &bad);
        else if (what == LAVENDER_AIM) FOUR(aim)(g, rows, t, m->free, m->x, own, push, &most, &due);
        else if (what == LAVENDER_PROJECT) FOUR(project)(g, backwards, m->inverse, push, m->v);
        else FOUR(miss)(g, push, m->v, &most);
    }
    if (!t) return;
    t->most = 0.0;
    for (int lane = 0; lane < 4; lane++)
        if (most[lane] > t->most) t->most = most[lane];
    t->finite = (bad[0] + bad[1]) + (bad[2] + bad[3]) == 0.0;
    t->due = ANY(due);
}

#undef FOUR
#undef ISA
#undef LOAD_FOUR
#undef STORE_FOUR
#undef LOAD_TWO
#undef STORE_TWO
#undef ROOT
#undef ANY
