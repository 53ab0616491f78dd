/* Functions of lanes.h for one width: each vector holds the same number of WIDTH worlds, which no operation mixes.
 *
 *     lane          0     1     2     3        x->lam[WIDTH * row + lane], and so every array of rows or velocities
 *     row 0        [w0]  [w1]  [w2]  [w0]      a group of three worlds in four lanes: the last lane repeats the first world
 *     row 1        [w0]  [w1]  [ 0]  [w0]      world 2 has no such row: bounds 0, J = 0, a tiny compliance (`load_lanes`)
 *     A[k][row]    x->a[WIDTH * (LAVENDER_PLACES(V, m) * k + row) + lane], column by column
 *     own, left    lists of runs [first, end) of the columns that any lane has (`lavender_list_columns`)
 *
 * Lanes that are finished stay in the loop with a mask `on`. A world has the same bits in every lane and width.
 *
 * lanes.h defines WIDTH, the number of lanes, and for some widths the following names; this file removes all at its end.
 *
 *     MORE        end of the names of functions, if another file of this width exists
 *     ISA         attribute that selects the instructions
 *     ROOT(a), ANY(mask)      their instructions
 *
 * Here V and I are the vectors of doubles and of masks, in which all bits of an entry are set or none, and LANE(f) is the
 * name of function f, such as f_4.
 */
#ifndef ISA
#define ISA
#endif
#ifndef MORE
#define MORE
#endif
#define LANE(f) LAVENDER_NAME(f, WIDTH, MORE)
#if WIDTH == 1
#define V double
#define I long long
#else
#define V LAVENDER_NAME(lanes, WIDTH, )
#define I LAVENDER_NAME(mask, WIDTH, )
#endif

ISA static inline V LANE(pick)(I mask, V a, V b) {
#if WIDTH == 1
    return mask ? a : b;
#else
    return (V)((mask & (I)a) | (~mask & (I)b));
#endif
}
ISA static inline V LANE(larger)(V a, V b) { return LANE(pick)((I)(a > b), a, b); }
ISA static inline V LANE(clip)(V a, V low, V high) { return LANE(pick)((I)(a < low), low, LANE(pick)((I)(a > high), high, a)); }
ISA static inline V LANE(abs)(V a) {
#if WIDTH == 1
    return fabs(a);
#else
    return (V)((I)a & 0x7FFFFFFFFFFFFFFFLL);
#endif
}
ISA static inline V LANE(root)(V a) {
#ifdef ROOT
    return ROOT(a);
#elif WIDTH == 1
    return sqrt(a);
#else
    for (int i = 0; i < WIDTH; i++) a[i] = sqrt(a[i]);
    return a;
#endif
}
ISA static inline int LANE(any)(I mask) {
#ifdef ANY
    return ANY(mask);
#elif WIDTH == 1
    return mask != 0;
#else
    long long bits = 0;
    for (int i = 0; i < WIDTH; i++) bits |= mask[i];
    return bits != 0;
#endif
}
ISA static inline I LANE(all)(I mask) { return sizeof(V) == sizeof(double) ? (I)(0 - mask) : mask; }  /* all bits */

/* The friction law at a normal yn and tangents of length t: the normal s of the point on the bounds that is nearest for a cone
 * (`law` 1), or max(0, yn) for Coulomb's disk (0). Return the disk's radius mu s. Cones are in the Euclidean metric. */
ISA static inline V LANE(limit)(int law, V mu, V yn, V t, V* s) {
    const V zero = {0.0};
    *s = LANE(larger)(yn, zero);
    if (law) *s = LANE(larger)((yn + mu * t) / (mu * mu + 1.0), *s);
    return mu * *s;
}

/* The judge's errors e (m) of impulses with slack w, and sum d e^2, the largest nu d e^2 and its row (judge/tally.pxd). */
ISA static void LANE(errors)(const lavender_lanes_t* x, const V* lam, const V* w, V* e, V* energy, V* fast, V* worst) {
    const V *d = (const V*)x->d, *mu = (const V*)x->mu;
    const V zero = {0.0};
    V sum = zero, most = zero - 1.0, at = zero - 1.0;
    for (int i = 0; i < x->k; i++) {
        int r = x->ptr[i];
        for (; !x->kind[i] && r < x->ptr[i + 1]; r++) {
            e[r] = LANE(clip)(w[r] / d[r], lam[r] - ((const V*)x->upper)[r], lam[r] - ((const V*)x->lower)[r]);
            const V v = d[r] * e[r], square = v * v;
            sum += v * e[r];
            at = LANE(pick)((I)(square > most), zero + (double)r, at);
            most = LANE(larger)(square, most);
        }
        if (!x->kind[i]) continue;
        const V dn = d[r], dt = d[r + 1], f = mu[i];
        const V un = w[r] / dn, u1 = w[r + 1] / dt, u2 = w[r + 2] / dt;
        if (x->law) {
            const V rn = LANE(root)(dn), rt = LANE(root)(dt), yn = rn * (lam[r] - un), a = f * rt / rn;
            const V y1 = rt * (lam[r + 1] - u1), y2 = rt * (lam[r + 2] - u2), t = LANE(root)(y1 * y1 + y2 * y2);
            V s;
            const V bound = LANE(limit)(1, a, yn, t, &s), size = t * rt;
            const I beyond = (I)(t > bound);
            const V scale = LANE(pick)((I)(size > 0.0), bound / LANE(pick)((I)(size > 0.0), size, zero + 1.0), zero);
            e[r] = LANE(pick)((I)(s == yn), un, lam[r] - s / rn);
            e[r + 1] = LANE(pick)(beyond, lam[r + 1] - scale * y1, u1);
            e[r + 2] = LANE(pick)(beyond, lam[r + 2] - scale * y2, u2);
        } else {
            const V y1 = lam[r + 1] - u1, y2 = lam[r + 2] - u2, t = LANE(root)(y1 * y1 + y2 * y2);
            V s;
            const V bound = LANE(limit)(0, f, lam[r], t, &s), scale = bound / t;
            const I beyond = (I)(t > bound);
            e[r] = LANE(pick)((I)(un > lam[r]), lam[r], un);
            e[r + 1] = LANE(pick)(beyond, lam[r + 1] - scale * y1, u1);
            e[r + 2] = LANE(pick)(beyond, lam[r + 2] - scale * y2, u2);
        }
        {
            const V v = dn * e[r], v1 = dt * e[r + 1], v2 = dt * e[r + 2];
            const V first = v * (dn * e[r]), pair = v1 * (dt * e[r + 1]) + v2 * (dt * e[r + 2]);
            sum += v * e[r];
            sum += v1 * e[r + 1] + v2 * e[r + 2];
            at = LANE(pick)((I)(first > most), zero + (double)r, at);
            most = LANE(larger)(first, most);
            at = LANE(pick)((I)(pair > most), zero + (double)(r + 1), at);
            most = LANE(larger)(pair, most);
        }
    }
    *energy = sum;
    *fast = most;
    *worst = at;
}

/* Project y (3) on a contact's bounds in the Euclidean metric: Pi in `to` (3) and P (9) of core/block_projection.pxd. */
ISA static void LANE(project)(int law, V mu, const V* y, V* to, V* p) {
    const V zero = {0.0}, one = zero + 1.0, square = mu * mu + 1.0;
    const V t = LANE(root)(y[1] * y[1] + y[2] * y[2]), length = LANE(pick)((I)(t > 0.0), t, one);
    const V u1 = y[1] / length, u2 = y[2] / length;
    V s, weight = one;
    const V bound = LANE(limit)(law, mu, y[0], t, &s);
    if (law) weight = one / square;
    const I off = (I)(s <= 0.0), inside = (I)(t <= bound);
    const V scale = LANE(pick)(off, zero, LANE(pick)(inside, one, bound / length)), other = LANE(pick)(inside, zero, scale);
    V ray1 = LANE(pick)(inside, zero, mu * u1), ray2 = LANE(pick)(inside, zero, mu * u2), first = LANE(pick)(inside, one, weight);
    to[0] = s;
    to[1] = scale * y[1];
    to[2] = scale * y[2];
    if (!p) return;
    first = LANE(pick)(off, zero, first);
    ray1 = LANE(pick)(off, zero, ray1);
    ray2 = LANE(pick)(off, zero, ray2);
    p[0] = first;
    p[3] = ray1 * weight;
    p[6] = ray2 * weight;
    p[1] = p[2] = zero;
    p[4] = scale - other * (u1 * u1);
    p[5] = p[7] = zero - other * (u1 * u2);
    p[8] = scale - other * (u2 * u2);
    if (law) {
        p[1] = p[3];
        p[2] = p[6];
        p[4] += ray1 * p[3];
        p[5] += ray1 * p[6];
        p[7] += ray1 * p[6];
        p[8] += ray2 * p[6];
    }
}

/* w = A lam - b, four columns of A at a time. */
ISA static void LANE(multiply)(const lavender_lanes_t* x) {
    const int m = x->m, ld = LAVENDER_PLACES(V, m);
    const V *a = (const V*)x->a, *b = (const V*)x->b, *lam = (const V*)x->lam;
    V* w = (V*)x->w;
    int k = 0;
    for (int r = 0; r < m; r++) w[r] = -b[r];
    for (int r = m; r < ld; r++) w[r] = b[0] - b[0];
    for (; k + 4 <= m; k += 4, a += 4 * ld) {
        const V l0 = lam[k], l1 = lam[k + 1], l2 = lam[k + 2], l3 = lam[k + 3];
        const V *a1 = a + ld, *a2 = a1 + ld, *a3 = a2 + ld;
        LAVENDER_APART
        for (int r = 0; r < ld; r++) w[r] = (((w[r] + a[r] * l0) + a1[r] * l1) + a2[r] * l2) + a3[r] * l3;
    }
    for (; k < m; k++, a += ld) {
        const V l0 = lam[k];
        LAVENDER_APART
        for (int r = 0; r < ld; r++) w[r] += a[r] * l0;
    }
}

/* `count` sweeps over blocks in lanes that are `on`. Columns of A whose rows do not change in any lane are not read. */
ISA static void LANE(sweep)(const lavender_lanes_t* x, int count, I on) {
    const int m = x->m, ld = LAVENDER_PLACES(V, m);
    const V *a = (const V*)x->a, *mu = (const V*)x->mu, *step = (const V*)x->step, zero = {0.0};
    const V *lower = (const V*)x->lower, *upper = (const V*)x->upper;
    V *lam = (V*)x->lam, *w = (V*)x->w;
    LANE(multiply)(x);
    while (count--)
        for (int i = 0; i < x->k; i++) {
            int r = x->ptr[i];
            for (; !x->kind[i] && r < x->ptr[i + 1]; r++) {
                const V *row = a + r * ld, to = LANE(clip)(lam[r] - step[r] * w[r], lower[r], upper[r]);
                const V change = LANE(pick)(on, to - lam[r], zero);
                lam[r] = LANE(pick)(on, to, lam[r]);
                if (LANE(any)((I)(change != 0.0))) {
                    LAVENDER_APART
                    for (int k = 0; k < ld; k++) w[k] += row[k] * change;
                }
            }
            if (!x->kind[i]) continue;
            const V* row = a + r * ld;
            V y[3], to[3], w1 = w[r + 1], w2 = w[r + 2];
            y[0] = lam[r] - step[r] * w[r];
            if (!x->law) {
                y[0] = LANE(larger)(y[0], zero);
                w1 += row[ld + r] * (y[0] - lam[r]);
                w2 += row[2 * ld + r] * (y[0] - lam[r]);
            }
            y[1] = lam[r + 1] - step[r + 1] * w1;
            y[2] = lam[r + 2] - step[r + 2] * w2;
            LANE(project)(x->law, mu[i], y, to, (V*)0);
            for (int j = 0; j < 3; j++) {
                y[j] = LANE(pick)(on, to[j] - lam[r + j], zero);
                lam[r + j] = LANE(pick)(on, to[j], lam[r + j]);
            }
            if (LANE(any)((I)(y[0] != 0.0) | (I)(y[1] != 0.0) | (I)(y[2] != 0.0))) {
                const V c0 = y[0], c1 = y[1], c2 = y[2], *row1 = row + ld, *row2 = row1 + ld;
                LAVENDER_APART
                for (int k = 0; k < ld; k++) w[k] = ((w[k] + row[k] * c0) + row1[k] * c1) + row2[k] * c2;
            }
        }
}

/* w = A lam - b, and the square of the relative residual (judge/score.pxd). */
ISA static V LANE(measure)(const lavender_lanes_t* x) {
    const V *lam = (const V*)x->lam, *out = (const V*)x->out;
    V energy, fast, worst;
    LANE(multiply)(x);
    LANE(errors)(x, lam, (const V*)x->w, (V*)x->e, &energy, &fast, &worst);
    energy /= out[LANE_START_ENERGY] * out[LANE_START_ENERGY];
    fast /= out[LANE_START_SPEED] * out[LANE_START_SPEED];
    return LANE(larger)(energy, fast);
}

/* The Newton step of  lam = Pi(lam - step w)  at lam with slack w, written to `change`. Return the lanes that lose a pivot.
 * Rows that no bound leaves free in any lane are rows of the unit matrix, and are not eliminated. */
ISA static I LANE(newton)(const lavender_lanes_t* x) {
    const int m = x->m, ld = LAVENDER_PLACES(V, m);
    const V *a = (const V*)x->a, *mu = (const V*)x->mu, *step = (const V*)x->step, *lam = (const V*)x->lam;
    const V *w = (const V*)x->w, *lower = (const V*)x->lower, *upper = (const V*)x->upper, zero = {0.0}, one = zero + 1.0;
    V *g = (V*)x->g, *f = (V*)x->change;
    int free[LANE_ROWS], count = 0, first = 0;
    I lost = (I)(zero != zero);
    for (int i = 0; i < x->k; i++) {
        const int rows = x->kind[i] ? 3 : 1;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r += rows) {
            const V* row = a + r * ld;
            V y[3], to[3], p[9];
            for (int j = 0; j < rows; j++) y[j] = lam[r + j] - step[r + j] * w[r + j];
            if (x->kind[i]) LANE(project)(x->law, mu[i], y, to, p);
            else {
                to[0] = LANE(clip)(y[0], lower[r], upper[r]);
                p[0] = LANE(pick)((I)(y[0] > lower[r]) & (I)(y[0] < upper[r]), one, zero);
            }
            for (int j = 0; j < rows; j++) {
                V* to_row = g + (r + j) * ld;
                const V* q = p + 3 * j;
                f[r + j] = to[j] - lam[r + j];
                if (rows == 1 && LANE(any)((I)(p[0] != 0.0))) {
                    const V q0 = p[0] * step[r];
                    free[count++] = r;
                    LAVENDER_APART
                    for (int k = 0; k < ld; k++) to_row[k] = q0 * row[k];
                } else if (rows == 3 && LANE(any)((I)(q[0] != 0.0) | (I)(q[1] != 0.0) | (I)(q[2] != 0.0))) {
                    const V q0 = q[0] * step[r], q1 = q[1] * step[r + 1], q2 = q[2] * step[r + 2];
                const V *row1 = row + ld, *row2 = row1 + ld;
                    free[count++] = r + j;
                    LAVENDER_APART
                    for (int k = 0; k < ld; k++) to_row[k] = q0 * row[k] + q1 * row1[k] + q2 * row2[k];
                } else
                    for (int k = 0; k < ld; k++) to_row[k] = zero;
                for (int k = 0; k < rows; k++) to_row[r + k] -= p[3 * j + k];
                to_row[r + j] += 1.0;
            }
        }
    }
    /* LU without exchanges */
    for (int j = 0; j < m; j++) {
        const V* from = g + j * ld;
        if (first == count || free[first] != j) {
            for (int t = first; t < count; t++) f[free[t]] -= g[free[t] * ld + j] * f[j];
            continue;
        }
        const V inverse = 1.0 / from[j];
        int t = ++first;
        lost |= (I)(LANE(abs)(inverse) > 1e300) | (I)(inverse != inverse);
        for (; t + 1 < count; t += 2) {
            V *up = g + free[t] * ld, *low = g + free[t + 1] * ld;
            const V z = up[j] * inverse, s = low[j] * inverse;
            LAVENDER_APART
            for (int k = LAVENDER_FROM(V, j); k < ld; k++) {
                up[k] -= z * from[k];
                low[k] -= s * from[k];
            }
            f[free[t]] -= z * f[j];
            f[free[t + 1]] -= s * f[j];
        }
        if (t < count) {
            V* up = g + free[t] * ld;
            const V z = up[j] * inverse;
            LAVENDER_APART
            for (int k = LAVENDER_FROM(V, j); k < ld; k++) up[k] -= z * from[k];
            f[free[t]] -= z * f[j];
        }
        g[j * ld + j] = inverse;
    }
    for (int j = m - 1; j >= 0; j--) {
        if (first > 0 && free[first - 1] == j) {
            first--;
            f[j] *= g[j * ld + j];
        }
        lost |= (I)(LANE(abs)(f[j]) > 1e300) | (I)(f[j] != f[j]);
        for (int t = 0; t < first; t++) f[free[t]] -= g[free[t] * ld + j] * f[j];
    }
    return lost;
}

/* Project lam on its bounds: normals and bounded rows if `to_cones` is 0. */
ISA static void LANE(bound)(const lavender_lanes_t* x, V* lam, int to_cones) {
    const V *mu = (const V*)x->mu, *lower = (const V*)x->lower, *upper = (const V*)x->upper, zero = {0.0};
    for (int i = 0; i < x->k; i++) {
        int r = x->ptr[i];
        for (; !x->kind[i] && r < x->ptr[i + 1]; r++) lam[r] = LANE(clip)(lam[r], lower[r], upper[r]);
        if (!x->kind[i]) continue;
        const V bound = LANE(limit)(0, mu[i], lam[r], zero, &lam[r]);
        if (to_cones) {
            const V size = LANE(root)(lam[r + 1] * lam[r + 1] + lam[r + 2] * lam[r + 2]);
            const I beyond = (I)(size > (1.0 + 8.0 * 1.1102230246251565e-16) * bound);
            const V scale = LANE(pick)(beyond, bound / LANE(larger)(size, zero + 1e-300), zero + 1.0);
            lam[r + 1] *= scale;
            lam[r + 2] *= scale;
        }
    }
}

/* Choose where lanes with a start begin, from Y^T in `across`: lam projected on its bounds, or the zero impulse if that has
 * the lower objective f = 1/2 lam.(w - b) (judge/best.pxd). Return the lanes that are not solved there; `now` receives the
 * square of the relative residual, 1 at the zero impulse. */
ISA static I LANE(start)(const lavender_lanes_t* x, const V* across, V* now) {
    const int m = x->m, n = x->n, ld = LAVENDER_PLACES(V, m);
    const V *y = (const V*)x->y, *soft = (const V*)x->soft, *b = (const V*)x->b, *out = (const V*)x->out;
    const V zero = {0.0}, one = zero + 1.0;
    V *lam = (V*)x->lam, *w = (V*)x->w, *push = (V*)x->push, energy, fast, worst, objective = zero;
    LANE(bound)(x, lam, 1);
    for (int k = 0; k < n; k++) push[k] = zero;
    for (int r = 0; r < m; r++) {
        const V impulse = lam[r], *row = y + r * n;
        if (!LANE(any)((I)(impulse != 0.0))) continue;
        LAVENDER_APART
        for (int k = 0; k < n; k++) push[k] += row[k] * impulse;
    }
    for (int r = 0; r < m; r++) w[r] = soft[r] * lam[r] - b[r];
    for (int r = m; r < ld; r++) w[r] = zero;
    for (int k = 0; k < n; k++) {
        const V *column = across + k * ld, z = push[k];
        LAVENDER_APART
        for (int r = 0; r < ld; r++) w[r] += column[r] * z;
    }
    LANE(errors)(x, lam, w, (V*)x->e, &energy, &fast, &worst);
    for (int r = 0; r < m; r++) objective += lam[r] * (w[r] - b[r]);
    energy /= out[LANE_START_ENERGY] * out[LANE_START_ENERGY];
    fast /= out[LANE_START_SPEED] * out[LANE_START_SPEED];
    *now = LANE(larger)(energy, fast);
    const I solved = (I)(*now <= x->tol * x->tol), better = solved | (I)(objective < 0.0);
    for (int r = 0; r < m; r++) lam[r] = LANE(pick)(better, lam[r], zero);
    *now = LANE(pick)(better, *now, one);
    return ~solved;
}

/* Solve to `tol` from lam if `warm`, else from the zero impulse: block sweeps, then Newton steps. A start that is a solution
 * is only projected on its bounds. Sweeps replace a step that gains nothing; a lane with MISSES such steps ends. A singular
 * A is not solved: more rows than velocities need compliance. */
ISA static void LANE(solve)(const lavender_lanes_t* x) {
    enum { FIRST_SWEEPS = 6, NEAR_SWEEPS = 1, MORE_SWEEPS = 12, ROUNDS = 10, MISSES = 3 };
    const double NEAR = 0.5;                /* relative residual below which a start needs fewer sweeps */
    const int m = x->m, n = x->n, ld = LAVENDER_PLACES(V, m);
    const V *y = (const V*)x->y, *soft = (const V*)x->soft, *d = (const V*)x->d, zero = {0.0}, one = zero + 1.0;
    V *a = (V*)x->a, *lam = (V*)x->lam, *step = (V*)x->step, *change = (V*)x->change, *kept = (V*)x->kept;
    V *out = (V*)x->out, *across = (V*)x->g;
    V now, sweeps, steps = zero, misses = zero;
    int own[LANE_VELOCITIES];
    I on = (I)(out[LANE_IS_PLAIN] > 0.0);
    out[LANE_SWEEPS] = out[LANE_STEPS] = zero;
    for (int r = 0; r < m; r++) {
        if (!x->warm) lam[r] = zero;
        on &= (I)(out[LANE_COUNT] <= (double)n) | (I)(soft[r] >= 1e-5 * d[r]);
        for (int k = 0; k < n; k++) across[k * ld + r] = y[r * n + k];
    }
    for (int k = 0; k < n; k++)
        for (int r = m; r < ld; r++) across[k * ld + r] = zero;
    if (x->warm) on &= LANE(start)(x, across, &now);
    if (!LANE(any)(on)) return;
    const I ran = on;
    for (int i = 0; i < x->k; i++) {
        int count = 0;
        LAVENDER_UP(k, x->own + i * LANE_LIST) own[count++] = k;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) {
            const V* row = y + r * n;
            V* to_row = a + r * ld;
            const int end = LAVENDER_PLACES(V, r + 1);
            int t = 0;
            for (int j = 0; j < ld; j++) to_row[j] = zero;
            for (; t + 4 <= count; t += 4) {
                const int k = own[t], k1 = own[t + 1], k2 = own[t + 2], k3 = own[t + 3];
                const V *c = across + k * ld, *c1 = across + k1 * ld, *c2 = across + k2 * ld, *c3 = across + k3 * ld;
                const V y0 = row[k], y1 = row[k1], y2 = row[k2], y3 = row[k3];
                LAVENDER_APART
                for (int j = 0; j < end; j++)
                    to_row[j] = (((to_row[j] + c[j] * y0) + c1[j] * y1) + c2[j] * y2) + c3[j] * y3;
            }
            for (; t < count; t++) {
                const V *c = across + own[t] * ld, y0 = row[own[t]];
                LAVENDER_APART
                for (int j = 0; j < end; j++) to_row[j] += c[j] * y0;
            }
            for (int j = 0; j < r; j++) a[j * ld + r] = to_row[j];
            to_row[r] += soft[r];
        }
    }
    for (int i = 0; i < x->k; i++) {
        int r = x->ptr[i];
        for (; !x->kind[i] && r < x->ptr[i + 1]; r++) step[r] = 1.0 / a[r * ld + r];
        if (!x->kind[i]) continue;
        const V n1 = LANE(abs)(a[r * ld + r + 1]), n2 = LANE(abs)(a[r * ld + r + 2]), pair = LANE(abs)(a[(r + 1) * ld + r + 2]);
        V top = a[r * ld + r], low = LANE(larger)(a[(r + 1) * ld + r + 1], a[(r + 2) * ld + r + 2]) + pair;
        if (x->law) {
            top += n1 + n2;
            low += LANE(larger)(n1, n2);
            top = low = LANE(larger)(top, low);
        }
        step[r] = 1.0 / top;
        step[r + 1] = step[r + 2] = 1.0 / low;
    }
    if (x->warm) {
        const I far = on & (I)(now > NEAR * NEAR);
        sweeps = LANE(pick)(far, zero + (double)FIRST_SWEEPS, LANE(pick)(on, zero + (double)NEAR_SWEEPS, zero));
        if (LANE(any)(far)) LANE(sweep)(x, FIRST_SWEEPS - NEAR_SWEEPS, far);
        LANE(sweep)(x, NEAR_SWEEPS, on);
    } else {
        LANE(sweep)(x, FIRST_SWEEPS, on);
        sweeps = LANE(pick)(on, zero + (double)FIRST_SWEEPS, zero);
    }
    now = LANE(measure)(x);
    on &= (I)(now > 0.25 * x->tol * x->tol);
    for (int round = 0; round < ROUNDS && LANE(any)(on); round++) {
        I worse = LANE(newton)(x);
        V next;
        for (int r = 0; r < m; r++) {
            kept[r] = lam[r];
            change[r] += lam[r];
        }
        LANE(bound)(x, change, 0);
        for (int r = 0; r < m; r++) lam[r] = LANE(pick)(on, change[r], lam[r]);
        next = LANE(measure)(x);
        steps += LANE(pick)(on, one, zero);
        worse = on & (worse | (I)(next >= 0.81 * now) | (I)(next != next));
        misses += LANE(pick)(worse, one, zero);
        on &= (I)(misses < (double)MISSES);
        worse = worse & on;
        if (LANE(any)(worse)) {
            for (int r = 0; r < m; r++) lam[r] = LANE(pick)(worse, kept[r], lam[r]);
            LANE(sweep)(x, MORE_SWEEPS, worse);
            sweeps += LANE(pick)(worse, zero + (double)MORE_SWEEPS, zero);
            next = LANE(measure)(x);
        }
        now = next;
        on &= (I)(now > 0.25 * x->tol * x->tol);
    }
    LANE(bound)(x, lam, 1);
    for (int r = 0; r < m; r++) lam[r] = LANE(pick)(ran, lam[r] + 0.0, lam[r]);
    out[LANE_SWEEPS] = sweeps;
    out[LANE_STEPS] = steps;
}

#if WIDTH > 1 || LAVENDER_FEWEST_LANES == 1

/* Interleave n numbers from each of WIDTH arrays, of float if `narrow`, number i to place at[i]. */
ISA static void LANE(interleave)(const void* const* from, int narrow, int n, const int* at, double* to) {
    for (int l = 0; l < WIDTH; l++) {
        const float* single = from[l];
        const double* wide = from[l];
        for (int i = 0; narrow && i < n; i++) to[WIDTH * at[i] + l] = single[i];
        for (int i = 0; !narrow && i < n; i++) to[WIDTH * at[i] + l] = wide[i];
    }
}

/* Overwrite v (n) with M^-1 v. */
ISA static void LANE(solve_mass)(const lavender_lanes_t* x, V* v) {
    const int n = x->n;
    const V *l = (const V*)x->mass, *inverse = (const V*)x->inverse;
    for (int k = n - 1; k >= 0; k--) {
        const int* left = x->left + k * LANE_LIST;
        const V z = v[k];
        LAVENDER_UP(i, left) v[i] -= l[k * n + i] * z;
    }
    for (int k = 0; k < n; k++) {
        const int* left = x->left + k * LANE_LIST;
        V z = v[k] * inverse[k];
        LAVENDER_UP(i, left) z -= l[k * n + i] * v[i];
        v[k] = z;
    }
}

/* The norm of v (n), with the sums of core/dot.pxd. */
ISA static V LANE(norm)(const V* v, int n) {
    const V zero = {0.0};
    V sum[4] = {zero, zero, zero, zero};
    for (int i = 0; i < n; i++) sum[i < (n & ~3) ? i & 3 : 0] += v[i] * v[i];
    return LANE(root)((sum[0] + sum[1]) + (sum[2] + sum[3]));
}

/* `estimate_condition` of core/condition.pxd, from the factor of M and its diagonal. */
ISA static V LANE(condition)(const lavender_lanes_t* x, const V* diagonal) {
    const int n = x->n;
    const V *l = (const V*)x->mass, zero = {0.0};
    V *s = (V*)x->size, v[LANE_VELOCITIES], first, second;
    for (int i = 0; i < n; i++) {
        s[i] = LANE(root)(diagonal[i]);
        v[i] = zero;
    }
    for (int i = n - 1; i >= 0; i--) {
        const int* left = x->left + i * LANE_LIST;
        v[i] += LANE(pick)((I)(v[i] >= 0.0), s[i], -s[i]);
        LAVENDER_UP(j, left) v[j] -= l[i * n + j] * v[i];
    }
    for (int i = 0; i < n; i++) {
        const int* left = x->left + i * LANE_LIST;
        V z = v[i] * ((const V*)x->inverse)[i];
        LAVENDER_UP(j, left) z -= v[j] * l[i * n + j];
        v[i] = z;
    }
    for (int i = 0; i < n; i++) v[i] *= s[i];
    first = LANE(norm)(v, n);
    for (int i = 0; i < n; i++) v[i] = s[i] * (v[i] / first);
    LANE(solve_mass)(x, v);
    for (int i = 0; i < n; i++) v[i] *= s[i];
    second = LANE(norm)(v, n);
    second = LANE(larger)(LANE(larger)(second, first / sqrt((double)n)), zero + 1.0);
    return LANE(pick)((I)(first > 0.0) & (I)(first < 1e300), second, zero + 1e300);
}

/* List the columns of L and of each block, with their ancestors. Return the lanes whose blocks are one island. */
ISA static I LANE(list_columns)(const lavender_lanes_t* x) {
    enum { LANES = sizeof(V) / sizeof(double) };
    const int n = x->n;
    const V *jac = (const V*)x->jac, *l = (const V*)x->mass;
    const I none = {0};
    I left[LANE_VELOCITIES], above[LANE_VELOCITIES], full = none - 1, common = none - 1, roots = none;
    unsigned long long at[2][LANE_VELOCITIES], differs = 0;
    for (int i = 0; i < n; i++) {
        left[i] = none;
        for (int j = 0; j < i; j++) left[i] |= LANE(all)((I)(l[i * n + j] != 0.0)) & 1LL << j;
        full &= LANE(all)((I)(left[i] == (1LL << i) - 1));
        for (int k = 1; k < LANES; k++)
            differs |= ((unsigned long long*)(left + i))[k] ^ ((unsigned long long*)(left + i))[0];
    }
    for (int k = 0; k < LANES; k++) {
        for (int i = 0; i < n && (k == 0 || differs); i++) at[0][i] = ((unsigned long long*)(left + i))[k];
        if (k == 0 || differs) lavender_close_columns(n, at[0], at[1]);
        for (int i = 0; i < n; i++) {
            ((unsigned long long*)(left + i))[k] = at[0][i];
            ((unsigned long long*)(above + i))[k] = at[1][i];
        }
    }
    for (int i = 0; i < n; i++) {
        unsigned long long set = 0;
        for (int k = 0; k < LANES; k++) set |= ((unsigned long long*)(left + i))[k];
        lavender_list_columns(set, x->left + i * LANE_LIST);
        roots |= LANE(all)((I)(left[i] == 0)) & 1LL << i;
    }
    for (int i = 0; i < x->k; i++) {
        int* own = x->own + i * LANE_LIST;
        I columns = none, last = none, count = none;
        unsigned long long set = 0;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++)
            for (int k = 0; k < n; k++) columns |= LANE(all)((I)(jac[r * n + k] != 0.0)) & above[k];
        for (int k = 0; k < LANES; k++) set |= ((unsigned long long*)&columns)[k];
        lavender_list_columns(set, own);
        LAVENDER_UP(k, own) count += columns >> k & 1;
        count &= 3;
        LAVENDER_DOWN(k, own) {
            const I one = LANE(all)((I)(count > 0)) & columns >> k & 1;
            last |= one << k;
            count -= one;
        }
        ((I*)x->fours)[i] = columns ^ last;
        ((I*)x->last)[i] = last;
        common &= columns | LANE(all)((I)(((const V*)x->real)[i] == 0.0));
    }
    return (I)((common & roots) != 0) & (full | (n < LANE_VELOCITIES ? -1 : 0));
}
/* Check the data; M = L^T D L, Y = J L^-1 D^-1/2, d, b, and the errors of the zero impulse. LANE_IS_PLAIN receives 1 if
 * no number is out of range, the rows form one island, and the zero impulse is within its bounds and not a solution. */
ISA static void LANE(prepare)(const lavender_lanes_t* x) {
    const int m = x->m, n = x->n;
    V *l = (V*)x->mass, *y = (V*)x->y, *d = (V*)x->d, *b = (V*)x->b, *inverse = (V*)x->inverse, *root = (V*)x->root;
    V *w = (V*)x->w, *e = (V*)x->e, *lam = (V*)x->zero, *push = (V*)x->push, *out = (V*)x->out;
    const V *jac = (const V*)x->jac, *free = (const V*)x->free, *target = (const V*)x->target, *soft = (const V*)x->soft;
    const V *mu = (const V*)x->mu, *lower = (const V*)x->lower, *upper = (const V*)x->upper;
    const V zero = {0.0}, one = zero + 1.0;
    V largest = zero, determinant = one, right = zero, energy, fast, worst;
    I good = (I)(zero == zero), moves = (I)(zero != zero);
    for (int i = 0; i < m * n; i++) good &= (I)(LANE(abs)(jac[i]) <= 1e60);
    for (int i = 0; i < n; i++) good &= (I)(LANE(abs)(free[i]) <= 1e60);
    for (int i = 0; i < m; i++)
        good &= (I)(LANE(abs)(target[i]) <= 1e60) & (I)(soft[i] <= 1e60) & ((I)(soft[i] >= 1e-60) | (I)(soft[i] == 0.0));
    for (int i = 0; i < x->k; i++) good &= (I)(mu[i] <= 1e60) & ((I)(mu[i] >= 1e-60) | (I)(mu[i] == 0.0));
    for (int i = 0; i < x->k; i++)
        for (int r = x->ptr[i]; !x->kind[i] && r < x->ptr[i + 1]; r++)
            good &= (I)(lower[r] <= 0.0) & (I)(upper[r] >= 0.0);
    for (int i = 0; i < n; i++)
        for (int j = 0; j <= i; j++) good &= (I)(LANE(abs)(l[i * n + j]) <= 1e60);
    for (int i = 0; x->asymmetry >= 0.0 && i < n; i++)      /* just within `asymmetry`, so that squares may round */
        for (int j = 0; j < i; j++) {
            const V gap = l[i * n + j] - l[j * n + i], size = l[i * n + i] * l[j * n + j];
            good &= (I)(gap == 0.0) | (I)(gap * gap <= 0.99 * x->asymmetry * x->asymmetry * size);
        }
    good &= LANE(list_columns)(x);
    /* factor of M; the diagonal of l keeps D */
    for (int i = 0; i < n; i++) inverse[i] = l[i * n + i];
    for (int k = n - 1; k >= 0; k--) {
        V* row = l + k * n;
        const V size = inverse[k];
        const int* left = x->left + k * LANE_LIST;
        good &= (I)(row[k] > 8.8817841970012523e-16 * size) & (I)(row[k] >= 1e-60);
        inverse[k] = 1.0 / row[k];
        root[k] = LANE(root)(inverse[k]);
        LAVENDER_DOWN(j, left) {
            V* to = l + j * n;
            const V z = row[j] * inverse[k];
            to[j] -= z * row[j];
            LAVENDER_UP(i, x->left + j * LANE_LIST) to[i] -= z * row[i];
            row[j] = z;
        }
        push[k] = size;                                     /* M_kk for the determinant below */
    }
    for (int k = 0; k < n; k++) determinant *= inverse[k] * push[k];
    out[LANE_CONDITION] = 2.72 * determinant;
    if (LANE(any)((I)(determinant > 1e3))) out[LANE_CONDITION] = LANE(condition)(x, push);
    /* Y and b */
    for (int i = 0; i < x->k; i++) {
        const int* own = x->own + i * LANE_LIST;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) {
            V *row = y + r * n, sum = zero;
            for (int k = 0; k < n; k++) row[k] = jac[r * n + k];
            LAVENDER_UP(k, own) sum += row[k] * free[k];
            b[r] = target[r] - sum;
            largest = LANE(larger)(LANE(abs)(b[r]), largest);
            LAVENDER_DOWN(k, own) {
                const V *from = l + k * n, z = row[k];
                LAVENDER_UP(j, x->left + k * LANE_LIST) row[j] -= from[j] * z;
                row[k] = z * root[k];
            }
        }
    }
    good &= (I)(largest <= 1e60) & ((I)(largest >= 1e-60) | (I)(largest == 0.0));
    /* d: four running sums over the columns of a block, and its last columns in the first sum (core/dot.pxd); the sums
     * change places after each column */
    for (int i = 0; i < x->k; i++) {
        const I fours = ((const I*)x->fours)[i], last = ((const I*)x->last)[i];
        const int* own = x->own + i * LANE_LIST;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) {
            V s0 = zero, s1 = zero, s2 = zero, s3 = zero;
            LAVENDER_UP(k, own) {
                const I turns = 0 - (fours >> k & 1), end = 0 - (last >> k & 1);
                const V square = y[r * n + k] * y[r * n + k], sum = s0 + square;
                s0 = LANE(pick)(turns, s1, s0);
                s1 = LANE(pick)(turns, s2, s1);
                s2 = LANE(pick)(turns, s3, s2);
                s3 = LANE(pick)(turns, sum, s3);
                s0 += LANE(pick)(end, square, zero);
            }
            d[r] = ((s0 + s1) + (s2 + s3)) + soft[r];
            good &= (I)(d[r] >= 1e-60) & (I)(d[r] <= 1e60);
        }
        if (x->kind[i]) d[x->ptr[i] + 1] = d[x->ptr[i] + 2] = 0.5 * (d[x->ptr[i] + 1] + d[x->ptr[i] + 2]);
    }
    /* the zero impulse */
    for (int r = 0; r < m; r++) {
        lam[r] = zero;
        w[r] = -b[r];
        right += (b[r] / d[r]) * b[r];
    }
    LANE(errors)(x, lam, w, e, &energy, &fast, &worst);
    for (int r = 0; r < m; r++) moves |= (I)(d[r] * LANE(abs)(e[r]) > 3.5527136788005009e-15 * LANE(abs)(b[r]));
    good &= moves & (I)(energy > 0.0) & (I)(fast > 0.0) & (I)(energy < 1e300) & (I)(fast < 1e300);
    out[LANE_START_ENERGY] = LANE(root)(energy);
    out[LANE_START_SPEED] = LANE(root)(fast);
    out[LANE_RHS] = LANE(root)(right);
    out[LANE_IS_PLAIN] = LANE(pick)(good, one, zero);
}

/* Judge lam: slack, errors, norms, floors, and the sums of judge/refine.pxd. */
ISA static void LANE(judge)(const lavender_lanes_t* x) {
    const int n = x->n;
    const V *y = (const V*)x->y, *d = (const V*)x->d, *b = (const V*)x->b, *lam = (const V*)x->lam;
    const V *jac = (const V*)x->jac, *soft = (const V*)x->soft, *mu = (const V*)x->mu;
    const V *lower = (const V*)x->lower, *upper = (const V*)x->upper;
    V *w = (V*)x->w, *e = (V*)x->e, *push = (V*)x->push, *out = (V*)x->out, *size = (V*)x->size;
    const V zero = {0.0}, one = zero + 1.0;
    V energy, fast, worst, sum[2] = {zero, zero}, heaviest = zero;
    const double unit = 1.1102230246251565e-16;
    I good = (I)(out[LANE_IS_PLAIN] > 0.0), odd = (I)(zero != zero);
    /* push = M^-1 J^T lam, w = J push + soft lam - b */
    for (int k = 0; k < n; k++) push[k] = size[k] = zero;
    for (int i = 0; i < x->k; i++) {
        const int* own = x->own + i * LANE_LIST;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++)
            LAVENDER_UP(k, own) push[k] += jac[r * n + k] * lam[r];
    }
    LANE(solve_mass)(x, push);
    for (int i = 0; i < x->k; i++) {
        const int* own = x->own + i * LANE_LIST;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) {
            V s = zero;
            LAVENDER_UP(k, own) s += jac[r * n + k] * push[k];
            w[r] = s + (soft[r] * lam[r] - b[r]);
            good &= (I)(LANE(abs)(w[r]) <= 1.7976931348623157e308) & (I)(LANE(abs)(lam[r]) <= 1e60);
        }
    }
    LANE(errors)(x, lam, w, e, &energy, &fast, &worst);
    good &= (I)(energy < 1e300) & (I)(fast < 1e300);
    out[LANE_ENERGY] = LANE(root)(energy);
    out[LANE_SPEED] = LANE(pick)((I)(fast > 0.0), LANE(root)(LANE(larger)(fast, zero)), zero);
    out[LANE_WORST] = worst;
    /* rounding: |Y| |Y|^T |lam| + soft |lam| and |b| (judge/forms.pxd, add_block_floor of judge/tally.pxd) */
    for (int i = 0; i < x->k; i++) {
        const int* own = x->own + i * LANE_LIST;
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++)
            LAVENDER_UP(k, own) size[k] += LANE(abs)(y[r * n + k] * lam[r]);
    }
    energy = fast = zero;
    for (int i = 0; i < x->k; i++) {
        const int end = x->ptr[i + 1], *own = x->own + i * LANE_LIST;
        V terms[LANE_ROWS], rounding, t;
        int r = x->ptr[i];
        for (int j = r; j < end; j++) {
            V s = zero;
            LAVENDER_UP(k, own) s += LANE(abs)(y[j * n + k]) * size[k];
            terms[j - r] = s + soft[j] * LANE(abs)(lam[j]);
        }
        for (int j = r; !x->kind[i] && j < end; j++) {
            rounding = unit * (terms[j - r] + LANE(abs)(b[j]));
            const I none = ((I)(lam[j] == lower[j]) & (I)(w[j] > rounding))
                | ((I)(lam[j] == upper[j]) & (I)(-w[j] > rounding));
            rounding = LANE(pick)(none, zero, rounding);
            t = rounding / d[j];
            energy += t * rounding;
            t = d[j] * t * rounding;
            fast = LANE(larger)(t, fast);
        }
        if (!x->kind[i]) continue;
        V gap = w[r];
        I none = (I)(lam[r] == 0.0) & (I)(lam[r + 1] == 0.0) & (I)(lam[r + 2] == 0.0);
        rounding = unit * (terms[0] + LANE(abs)(b[r]));
        if (x->law) {
            gap -= mu[i] * LANE(root)(w[r + 1] * w[r + 1] + w[r + 2] * w[r + 2]);
            for (int j = 1; j < 3; j++) rounding += mu[i] * (unit * (terms[j] + LANE(abs)(b[r + j])));
        }
        none &= (I)(gap > rounding);
        for (int j = 0; j < 3; j++) {
            V s = terms[j];
            if (j) {
                const V own = d[r + j] * LANE(abs)(lam[r + j]);
                s = LANE(pick)((I)(e[r + j] != w[r + j] / d[r + j]) & (I)(own > s), own, s);
            }
            rounding = unit * (s + LANE(abs)(b[r + j]));
            t = rounding / d[r + j];
            energy += LANE(pick)(none, zero, t * rounding);
            t = d[r + j] * t * rounding;
            fast = LANE(pick)(none, fast, LANE(larger)(t, fast));
        }
    }
    out[LANE_FLOOR_ENERGY] = LANE(root)(energy);
    out[LANE_FLOOR_SPEED] = LANE(root)(fast);
    /* `estimate_factor_loss` in two sums, an odd last row in the first */
    for (int i = 0; i < x->k; i++) {
        const I real = (I)(((const V*)x->real)[i] > 0.0);
        for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) {
            const V work = lam[r] * (w[r] + (b[r] - soft[r] * lam[r]));
            sum[0] += LANE(pick)(odd, zero, work);
            sum[1] += LANE(pick)(odd, work, zero);
            odd ^= real;
            heaviest = LANE(larger)(d[r], heaviest);
        }
    }
    out[LANE_WORK] = sum[0] + sum[1];
    out[LANE_HEAVIEST] = heaviest;
    out[LANE_IS_PLAIN] = LANE(pick)(good, one, zero);
}

#endif
#undef LANE
#undef WIDTH
#undef MORE
#undef V
#undef I
#undef ISA
#undef ROOT
#undef ANY
