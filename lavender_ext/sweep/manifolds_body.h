/* Sweeps over groups of manifolds for one set of instructions, see manifolds.h, which defines and this file removes
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

/* Update point p of each lane: `relax_contact` of core/contact.pxd for two tangents in a disk and no compliance. The impulses (3)
 * and the negative right-hand sides (3) of a contact are at x + its offset. */
ISA LAVENDER_INLINE_FOUR void FOUR(relax)(const lavender_group* g, const lavender_point* p, const int32_t* at, double* x,
                                          lavender_four* va, lavender_four* vb) {
    const lavender_four zero = {0.0, 0.0, 0.0, 0.0};
    double *x0 = x + at[0], *x1 = x + at[1], *x2 = x + at[2], *x3 = x + at[3];
    lavender_four lam[4], minus_b[4], u[3], impulse[3], change[3];
    LOAD_FOUR(x0, x1, x2, x3, lam);
    LOAD_FOUR(x0 + 4, x1 + 4, x2 + 4, x3 + 4, minus_b);
    /* relative velocity */
    const lavender_four *ra = p->arm_a, *rb = p->arm_b;
    u[0] = vb[0] + (vb[4] * rb[2] - vb[5] * rb[1]);
    u[1] = vb[1] + (vb[5] * rb[0] - vb[3] * rb[2]);
    u[2] = vb[2] + (vb[3] * rb[1] - vb[4] * rb[0]);
    u[0] = u[0] - (va[0] + (va[4] * ra[2] - va[5] * ra[1]));
    u[1] = u[1] - (va[1] + (va[5] * ra[0] - va[3] * ra[2]));
    u[2] = u[2] - (va[2] + (va[3] * ra[1] - va[4] * ra[0]));
    /* normal */
    lavender_four slack = LAVENDER_DOT_FOUR(g->normal, u) + minus_b[0];
    lavender_four normal = lam[0] - slack * p->step[0];
    normal = LAVENDER_PICK_FOUR(normal < zero, zero, normal);
    change[0] = normal - lam[0];
    for (int k = 0; k < 3; k++) impulse[k] = change[0] * g->normal[k];
    /* tangents */
    const lavender_four bound = g->mu * normal;
    slack = (LAVENDER_DOT_FOUR(g->tangent1, u) + minus_b[1]) + p->coupling[0] * change[0];
    lavender_four first = lam[1] - slack * p->step[1];
    slack = (LAVENDER_DOT_FOUR(g->tangent2, u) + minus_b[2]) + p->coupling[1] * change[0];
    lavender_four second = lam[2] - slack * p->step[1];
    const lavender_four square = first * first + second * second;
    const lavender_four_bits outside = square > bound * bound;
    if (ANY(outside)) {
        const lavender_four scale = bound / ROOT(square);
        first = LAVENDER_PICK_FOUR(outside, first * scale, first);
        second = LAVENDER_PICK_FOUR(outside, second * scale, second);
    }
    change[1] = first - lam[1];
    change[2] = second - lam[2];
    lam[0] = normal;
    lam[1] = first;
    lam[2] = second;
    STORE_FOUR(x0, x1, x2, x3, lam);
    for (int k = 0; k < 3; k++) impulse[k] = (impulse[k] + change[1] * g->tangent1[k]) + change[2] * g->tangent2[k];
    /* velocities of both bodies */
    for (int k = 0; k < 3; k++) {
        const lavender_four *i = p->inv_inertia_arm + k, *j = i + 3;
        va[k] = va[k] - g->inv_mass_a * impulse[k];
        va[3 + k] = va[3 + k] - ((change[0] * i[0] + change[1] * i[6]) + change[2] * i[12]);
        vb[k] = vb[k] + g->inv_mass_b * impulse[k];
        vb[3 + k] = vb[3 + k] + ((change[0] * j[0] + change[1] * j[6]) + change[2] * j[12]);
    }
}

/* Update all manifolds of a group. Points that not every lane has change only the lanes that have them. */
ISA LAVENDER_INLINE_FOUR void FOUR(relax_group)(const lavender_group* g, int backwards, double* x, double* v) {
    lavender_four va[6], vb[6], old_a[6], old_b[6];
    FOUR(load_bodies)(v, g->read_a, va);
    FOUR(load_bodies)(v, g->read_b, vb);
    for (int j = 0; j < g->n; j++) {
        const int k = backwards ? g->n - 1 - j : j;
        if (k < g->n_all) {
            FOUR(relax)(g, g->point + k, g->contact[k], x, va, vb);
            continue;
        }
        for (int i = 0; i < 6; i++) {
            old_a[i] = va[i];
            old_b[i] = vb[i];
        }
        FOUR(relax)(g, g->point + k, g->contact[k], x, va, vb);
        const lavender_four_bits has = {-(g->count[0] > k), -(g->count[1] > k), -(g->count[2] > k), -(g->count[3] > k)};
        for (int i = 0; i < 6; i++) {
            va[i] = LAVENDER_PICK_FOUR(has, va[i], old_a[i]);
            vb[i] = LAVENDER_PICK_FOUR(has, vb[i], old_b[i]);
        }
    }
    FOUR(store_bodies)(v, g->write_a, va);
    FOUR(store_bodies)(v, g->write_b, vb);
}

ISA static void FOUR(sweep)(const lavender_manifolds* m, int backwards, double* x, double* v) {
    for (int i = 0; i < m->n_groups; i++) {
        const int k = backwards ? m->n_groups - 1 - i : i;
        FOUR(relax_group)((const lavender_group*)(m->groups + m->start[k]), backwards, x, v);
    }
}

#undef FOUR
#undef ISA
#undef LOAD_FOUR
#undef STORE_FOUR
#undef LOAD_TWO
#undef STORE_TWO
#undef ROOT
#undef ANY
