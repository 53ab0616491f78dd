"""Worlds in the lanes of vectors: 8, 4 or 2 worlds of equal size, with contacts of three rows over a full M, at once.

Entry i of an array holds entry i of every world: x[width i + lane]. A world's arithmetic is that of one problem by the functions
of core and judge, with the same bits: no sum runs over lanes, so that the width changes no bit. Worlds that a lane does not cover
are processed alone: invalid numbers, a zero impulse that is a solution, results that judge/refine.pxd refines or that are above
tol. Such contacts are solved from the zero impulse by sweeps over blocks, then Newton steps on the natural map, in batches as in
single calls (`solve_in_one_lane`). To change a width, only the list of `LAVENDER_LANES` changes.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t
from libc.string cimport memset

from lavender_ext.batch.world cimport (BLOCK, BLOCKS, FREE, JAC, MASS, MU, PLACES, ROWS, SOFT, TARGET, VELOCITIES, AT_ROW,
                                       worlds_t)
from lavender_ext.core.block_types cimport blocks_t, is_disk_friction_contact
from lavender_ext.core.method cimport workspace_t
from lavender_ext.core.view cimport generalized_t
from lavender_ext.factor.factors cimport has_wide
from lavender_ext.host cimport grow_workspace_to
from lavender_ext.judge.refine cimport min_reported_loss
from lavender_ext.judge.score cimport make_empty_score, relative_residual, score_t, unit_roundoff


cdef extern from *:
    r"""
    #include <math.h>
    typedef struct {
        int m, n, law;
        double asymmetry;                       /* permitted asymmetry of M, as in `worlds_t` */
        double *jac, *mass, *free, *target, *soft, *mu, *full;      /* data; `full`: columns of a block's panel in fours */
        double *inverse, *root, *y, *d, *b, *zero, *w, *e, *lam, *push, *size, *out;
        double *a, *g, *step, *change, *kept;   /* for `solve`, to the relative residual `tol` */
        double tol;
    } lavender_lanes_t;
    enum { LANE_IS_PLAIN, LANE_START_ENERGY, LANE_START_SPEED, LANE_RHS, LANE_DETERMINANT, LANE_ENERGY, LANE_SPEED, LANE_WORST,
           LANE_FLOOR_ENERGY, LANE_FLOOR_SPEED, LANE_WORK, LANE_HEAVIEST, LANE_STEPS, LANE_NUMBERS };
    #define LAVENDER_LANES(N, V, I, ISA, ROOT, PICK, ABS) \
    ISA static inline V pick_##N(I mask, V a, V b) { return PICK(V, I, mask, a, b); } \
    ISA static inline V larger_##N(V a, V b) { return PICK(V, I, (I)(a > b), a, b); } \
    ISA static inline V abs_##N(V a) { return ABS(V, I, a); } \
    ISA static inline V root_##N(V a) { return ROOT; } \
    ISA static inline int any_##N(I mask) { \
        long long bits = 0; \
        for (int l = 0; l < N; l++) bits |= ((const long long*)&mask)[l]; \
        return bits != 0; \
    } \
    \
    /* Interleave n numbers from each of N arrays, of float if `narrow`. */ \
    ISA static void interleave_##N(const void* const* from, int narrow, long long n, double* to) { \
        const float* single[N]; \
        const double* wide[N]; \
        for (int l = 0; l < N; l++) { \
            single[l] = from[l]; \
            wide[l] = from[l]; \
        } \
        for (long long i = 0; narrow && i < n; i++) \
            for (int l = 0; l < N; l++) to[N * i + l] = single[l][i]; \
        for (long long i = 0; !narrow && i < n; i++) \
            for (int l = 0; l < N; l++) to[N * i + l] = wide[l][i]; \
    } \
    \
    /* The judge's errors e (m) of impulses with slack w, and sum d e^2, the largest nu d e^2 and its row (judge/tally.pxd). */ \
    ISA static void errors_##N(const lavender_lanes_t* x, const V* lam, const V* w, V* e, V* energy, V* fast, V* worst) { \
        const V *d = (const V*)x->d, *mu = (const V*)x->mu; \
        const V zero = {0.0}; \
        V sum = zero, most = zero - 1.0, at = zero - 1.0; \
        for (int r = 0; r < x->m; r += 3) { \
            const V dn = d[r], dt = d[r + 1], f = mu[r / 3]; \
            const V un = w[r] / dn, u1 = w[r + 1] / dt, u2 = w[r + 2] / dt; \
            if (x->law) { \
                const V rn = root_##N(dn), rt = root_##N(dt), yn = rn * (lam[r] - un), a = f * rt / rn; \
                const V y1 = rt * (lam[r + 1] - u1), y2 = rt * (lam[r + 2] - u2), t = root_##N(y1 * y1 + y2 * y2); \
                const V edge = (yn + a * t) / (1.0 + a * a); \
                V s = pick_##N((I)(yn > 0.0), yn, zero), bound, scale; \
                s = larger_##N(edge, s); \
                bound = a * s; \
                const V size = t * rt; \
                const I beyond = (I)(t > bound); \
                scale = pick_##N((I)(size > 0.0), bound / pick_##N((I)(size > 0.0), size, zero + 1.0), zero); \
                e[r] = pick_##N((I)(s == yn), un, lam[r] - s / rn); \
                e[r + 1] = pick_##N(beyond, lam[r + 1] - scale * y1, u1); \
                e[r + 2] = pick_##N(beyond, lam[r + 2] - scale * y2, u2); \
            } else { \
                const V bound = f * pick_##N((I)(lam[r] > 0.0), lam[r], zero), y1 = lam[r + 1] - u1, y2 = lam[r + 2] - u2; \
                const V t = root_##N(y1 * y1 + y2 * y2), scale = bound / t; \
                const I beyond = (I)(t > bound); \
                e[r] = pick_##N((I)(un > lam[r]), lam[r], un); \
                e[r + 1] = pick_##N(beyond, lam[r + 1] - scale * y1, u1); \
                e[r + 2] = pick_##N(beyond, lam[r + 2] - scale * y2, u2); \
            } \
            { \
                const V v = dn * e[r], v1 = dt * e[r + 1], v2 = dt * e[r + 2]; \
                const V first = v * (dn * e[r]), pair = v1 * (dt * e[r + 1]) + v2 * (dt * e[r + 2]); \
                sum += v * e[r]; \
                sum += v1 * e[r + 1] + v2 * e[r + 2]; \
                at = pick_##N((I)(first > most), zero + (double)r, at); \
                most = larger_##N(first, most); \
                at = pick_##N((I)(pair > most), zero + (double)(r + 1), at); \
                most = larger_##N(pair, most); \
            } \
        } \
        *energy = sum; \
        *fast = most; \
        *worst = at; \
    } \
    \
    /* Check the data; M = L^T D L, Y = J L^-1 D^-1/2, d, b, and the errors of the zero impulse. LANE_IS_PLAIN receives 1 if \
     * no number is out of range, M has no zero entry, and the zero impulse does not solve the world. */ \
    ISA static void prepare_##N(const lavender_lanes_t* x) { \
        const int m = x->m, n = x->n; \
        V *l = (V*)x->mass, *y = (V*)x->y, *d = (V*)x->d, *b = (V*)x->b, *inverse = (V*)x->inverse, *root = (V*)x->root; \
        V *w = (V*)x->w, *e = (V*)x->e, *lam = (V*)x->zero, *push = (V*)x->push, *out = (V*)x->out; \
        const V *jac = (const V*)x->jac, *free = (const V*)x->free, *target = (const V*)x->target, *soft = (const V*)x->soft; \
        const V *mu = (const V*)x->mu, *full = (const V*)x->full; \
        const V zero = {0.0}, one = zero + 1.0; \
        V largest = zero, determinant = one, right = zero, energy, fast, worst; \
        I good = (I)(zero == zero), moves = (I)(zero != zero); \
        for (int i = 0; i < m * n; i++) good &= (I)(abs_##N(jac[i]) <= 1e60); \
        for (int i = 0; i < n; i++) good &= (I)(abs_##N(free[i]) <= 1e60); \
        for (int i = 0; i < m; i++) \
            good &= (I)(abs_##N(target[i]) <= 1e60) & (I)(soft[i] <= 1e60) & ((I)(soft[i] >= 1e-60) | (I)(soft[i] == 0.0)); \
        for (int i = 0; i < m / 3; i++) good &= (I)(mu[i] <= 1e60) & ((I)(mu[i] >= 1e-60) | (I)(mu[i] == 0.0)); \
        for (int i = 0; i < n; i++) \
            for (int j = 0; j <= i; j++) \
                good &= (I)(abs_##N(l[i * n + j]) <= 1e60) & (I)(l[i * n + j] != 0.0); \
        for (int i = 0; i < n; i++)                             /* just within `asymmetry`, so that squares may round */ \
            for (int j = 0; j < i; j++) { \
                const V gap = l[i * n + j] - l[j * n + i], size = l[i * n + i] * l[j * n + j]; \
                good &= (I)(gap == 0.0) | (I)(gap * gap <= 0.99 * x->asymmetry * x->asymmetry * size); \
            } \
        /* factor of M; the diagonal of l keeps D */ \
        for (int i = 0; i < n; i++) inverse[i] = l[i * n + i]; \
        for (int k = n - 1; k >= 0; k--) { \
            V* row = l + k * n; \
            const V size = inverse[k]; \
            good &= (I)(row[k] > 8.8817841970012523e-16 * size) & (I)(row[k] >= 1e-60); \
            inverse[k] = 1.0 / row[k]; \
            root[k] = root_##N(inverse[k]); \
            for (int j = k - 1; j >= 0; j--) { \
                V *to = l + j * n; \
                const V z = row[j] * inverse[k]; \
                to[j] -= z * row[j]; \
                for (int i = 0; i < j; i++) to[i] -= z * row[i]; \
                row[j] = z; \
            } \
            push[k] = size;                                     /* M_kk for the determinant below */ \
        } \
        for (int k = 0; k < n; k++) determinant *= inverse[k] * push[k]; \
        /* Y and b */ \
        for (int r = 0; r < m; r++) { \
            V *row = y + r * n, sum = zero; \
            for (int k = 0; k < n; k++) { \
                row[k] = jac[r * n + k]; \
                sum += row[k] * free[k]; \
            } \
            b[r] = target[r] - sum; \
            largest = larger_##N(abs_##N(b[r]), largest); \
        } \
        good &= (I)(largest <= 1e60) & ((I)(largest >= 1e-60) | (I)(largest == 0.0)); \
        for (int k = n - 1; k >= 0; k--) { \
            const V *from = l + k * n, scale = root[k]; \
            for (int r = 0; r < m; r++) { \
                V* row = y + r * n; \
                const V z = row[k]; \
                for (int i = 0; i < k; i++) row[i] -= from[i] * z; \
                row[k] = z * scale; \
            } \
        } \
        /* d: four running sums over the columns of a panel, and its last columns in the first sum (core/dot.pxd) */ \
        for (int r = 0; r < m; r++) { \
            V sum[4] = {zero, zero, zero, zero}; \
            for (int k = 0; k < n; k++) { \
                const V square = y[r * n + k] * y[r * n + k]; \
                const I in = (I)(full[r / 3] > (double)k); \
                sum[k & 3] += pick_##N(in, square, zero); \
                sum[0] += pick_##N(in, zero, square); \
            } \
            d[r] = ((sum[0] + sum[1]) + (sum[2] + sum[3])) + soft[r]; \
            good &= (I)(d[r] >= 1e-60) & (I)(d[r] <= 1e60); \
        } \
        for (int r = 0; r < m; r += 3) d[r + 1] = d[r + 2] = 0.5 * (d[r + 1] + d[r + 2]); \
        /* the zero impulse */ \
        for (int r = 0; r < m; r++) { \
            lam[r] = zero; \
            w[r] = -b[r]; \
            right += (b[r] / d[r]) * b[r]; \
        } \
        errors_##N(x, lam, w, e, &energy, &fast, &worst); \
        for (int r = 0; r < m; r++) moves |= (I)(d[r] * abs_##N(e[r]) > 3.5527136788005009e-15 * abs_##N(b[r])); \
        good &= moves & (I)(energy > 0.0) & (I)(fast > 0.0) & (I)(energy < 1e300) & (I)(fast < 1e300); \
        out[LANE_START_ENERGY] = root_##N(energy); \
        out[LANE_START_SPEED] = root_##N(fast); \
        out[LANE_RHS] = root_##N(right); \
        out[LANE_DETERMINANT] = determinant; \
        out[LANE_IS_PLAIN] = pick_##N(good, one, zero); \
    } \
    \
    /* Judge lam: slack, errors, norms, floors, and the sums of judge/refine.pxd. */ \
    ISA static void judge_##N(const lavender_lanes_t* x) { \
        const int m = x->m, n = x->n; \
        const V *l = (const V*)x->mass, *y = (const V*)x->y, *d = (const V*)x->d, *b = (const V*)x->b, *lam = (const V*)x->lam; \
        const V *inverse = (const V*)x->inverse, *jac = (const V*)x->jac, *soft = (const V*)x->soft, *mu = (const V*)x->mu; \
        V *w = (V*)x->w, *e = (V*)x->e, *push = (V*)x->push, *out = (V*)x->out, *size = (V*)x->size; \
        const V zero = {0.0}, one = zero + 1.0; \
        V energy, fast, worst, sum[2] = {zero, zero}, heaviest = zero; \
        const double unit = 1.1102230246251565e-16; \
        I good = (I)(out[LANE_IS_PLAIN] > 0.0); \
        /* push = M^-1 J^T lam, w = J push + soft lam - b */ \
        for (int k = 0; k < n; k++) push[k] = size[k] = zero; \
        for (int r = 0; r < m; r++) { \
            const V* row = jac + r * n; \
            for (int k = 0; k < n; k++) push[k] += row[k] * lam[r]; \
        } \
        for (int k = n - 1; k >= 0; k--) { \
            const V z = push[k]; \
            for (int i = 0; i < k; i++) push[i] -= l[k * n + i] * z; \
        } \
        for (int k = 0; k < n; k++) { \
            V z = push[k] * inverse[k]; \
            for (int i = 0; i < k; i++) z -= l[k * n + i] * push[i]; \
            push[k] = z; \
        } \
        for (int r = 0; r < m; r++) { \
            V s = zero; \
            for (int k = 0; k < n; k++) s += jac[r * n + k] * push[k]; \
            w[r] = s + (soft[r] * lam[r] - b[r]); \
            good &= (I)(abs_##N(w[r]) <= 1.7976931348623157e308) & (I)(abs_##N(lam[r]) <= 1e60); \
        } \
        errors_##N(x, lam, w, e, &energy, &fast, &worst); \
        good &= (I)(energy < 1e300) & (I)(fast < 1e300); \
        out[LANE_ENERGY] = root_##N(energy); \
        out[LANE_SPEED] = pick_##N((I)(fast > 0.0), root_##N(larger_##N(fast, zero)), zero); \
        out[LANE_WORST] = worst; \
        /* rounding: |Y| |Y|^T |lam| + soft |lam| and |b| (judge/forms.pxd, add_block_floor of judge/tally.pxd) */ \
        for (int r = 0; r < m; r++) \
            for (int k = 0; k < n; k++) size[k] += abs_##N(y[r * n + k] * lam[r]); \
        energy = fast = zero; \
        for (int r = 0; r < m; r += 3) { \
            V terms[3], rounding, gap = w[r]; \
            I none = (I)(lam[r] == 0.0) & (I)(lam[r + 1] == 0.0) & (I)(lam[r + 2] == 0.0); \
            for (int i = 0; i < 3; i++) { \
                V s = zero; \
                for (int k = 0; k < n; k++) s += abs_##N(y[(r + i) * n + k]) * size[k]; \
                terms[i] = s + soft[r + i] * abs_##N(lam[r + i]); \
            } \
            rounding = unit * (terms[0] + abs_##N(b[r])); \
            if (x->law) { \
                gap -= mu[r / 3] * root_##N(w[r + 1] * w[r + 1] + w[r + 2] * w[r + 2]); \
                for (int i = 1; i < 3; i++) rounding += mu[r / 3] * (unit * (terms[i] + abs_##N(b[r + i]))); \
            } \
            none &= (I)(gap > rounding); \
            for (int i = 0; i < 3; i++) { \
                V s = terms[i], t; \
                if (i) { \
                    const V own = d[r + i] * abs_##N(lam[r + i]); \
                    s = pick_##N((I)(e[r + i] != w[r + i] / d[r + i]) & (I)(own > s), own, s); \
                } \
                rounding = unit * (s + abs_##N(b[r + i])); \
                t = rounding / d[r + i]; \
                energy += pick_##N(none, zero, t * rounding); \
                t = d[r + i] * t * rounding; \
                fast = pick_##N(none, fast, larger_##N(t, fast)); \
            } \
        } \
        out[LANE_FLOOR_ENERGY] = root_##N(energy); \
        out[LANE_FLOOR_SPEED] = root_##N(fast); \
        /* `estimate_factor_loss` in two sums, an odd last row in the first */ \
        for (int r = 0; r < m; r++) { \
            sum[r & 1] += lam[r] * (w[r] + (b[r] - soft[r] * lam[r])); \
            heaviest = larger_##N(d[r], heaviest); \
        } \
        out[LANE_WORK] = sum[0] + sum[1]; \
        out[LANE_HEAVIEST] = heaviest; \
        out[LANE_IS_PLAIN] = pick_##N(good, one, zero); \
    } \
    \
    /* Project y (3) on a contact's bounds in the Euclidean metric: Pi in `to` (3) and P (9) of core/block_projection.pxd. */ \
    ISA static void project_##N(int law, V mu, const V* y, V* to, V* p) { \
        const V zero = {0.0}, one = zero + 1.0, square = mu * mu + 1.0; \
        const V t = root_##N(y[1] * y[1] + y[2] * y[2]), length = pick_##N((I)(t > 0.0), t, one); \
        const V u1 = y[1] / length, u2 = y[2] / length; \
        const V edge = (y[0] + mu * t) / square, flat = larger_##N(y[0], zero); \
        V s = flat, bound, weight = one; \
        if (law) { \
            s = larger_##N(edge, flat); \
            weight = one / square; \
        } \
        bound = mu * s; \
        const I off = (I)(s <= 0.0), inside = (I)(t <= bound); \
        const V scale = pick_##N(off, zero, pick_##N(inside, one, bound / length)), other = pick_##N(inside, zero, scale); \
        V ray1 = pick_##N(inside, zero, mu * u1), ray2 = pick_##N(inside, zero, mu * u2), first = pick_##N(inside, one, weight); \
        to[0] = s; \
        to[1] = scale * y[1]; \
        to[2] = scale * y[2]; \
        if (!p) return; \
        first = pick_##N(off, zero, first); \
        ray1 = pick_##N(off, zero, ray1); \
        ray2 = pick_##N(off, zero, ray2); \
        p[0] = first; \
        p[3] = ray1 * weight; \
        p[6] = ray2 * weight; \
        p[1] = p[2] = zero; \
        p[4] = scale - other * (u1 * u1); \
        p[5] = p[7] = zero - other * (u1 * u2); \
        p[8] = scale - other * (u2 * u2); \
        if (law) { \
            p[1] = p[3]; \
            p[2] = p[6]; \
            p[4] += ray1 * p[3]; \
            p[5] += ray1 * p[6]; \
            p[7] += ray1 * p[6]; \
            p[8] += ray2 * p[6]; \
        } \
    } \
    \
    /* `count` block sweeps over A in lanes that are `on`. */ \
    ISA static void sweep_##N(const lavender_lanes_t* x, int count, I on) { \
        const int m = x->m; \
        const V *a = (const V*)x->a, *b = (const V*)x->b, *mu = (const V*)x->mu, *step = (const V*)x->step; \
        V* lam = (V*)x->lam; \
        while (count--) \
            for (int r = 0; r < m; r += 3) { \
                const V *row = a + r * m, before = lam[r]; \
                V y[3], to[3], w0 = b[r], w1 = b[r + 1], w2 = b[r + 2]; \
                for (int k = 0; k < m; k++) { \
                    w0 -= row[k] * lam[k]; \
                    w1 -= row[m + k] * lam[k]; \
                    w2 -= row[2 * m + k] * lam[k]; \
                } \
                y[0] = before + step[r] * w0; \
                if (!x->law) { \
                    const V zero = {0.0}; \
                    y[0] = larger_##N(y[0], zero); \
                    w1 -= row[m + r] * (y[0] - before); \
                    w2 -= row[2 * m + r] * (y[0] - before); \
                } \
                y[1] = lam[r + 1] + step[r + 1] * w1; \
                y[2] = lam[r + 2] + step[r + 2] * w2; \
                project_##N(x->law, mu[r / 3], y, to, (V*)0); \
                for (int i = 0; i < 3; i++) lam[r + i] = pick_##N(on, to[i], lam[r + i]); \
            } \
    } \
    \
    /* w = A lam - b, and the square of the relative residual (judge/score.pxd). */ \
    ISA static V measure_##N(const lavender_lanes_t* x) { \
        const int m = x->m; \
        const V *a = (const V*)x->a, *b = (const V*)x->b, *lam = (const V*)x->lam, *out = (const V*)x->out; \
        V *w = (V*)x->w, energy, fast, worst; \
        for (int r = 0; r < m; r++) { \
            V s = -b[r]; \
            for (int k = 0; k < m; k++) s += a[r * m + k] * lam[k]; \
            w[r] = s; \
        } \
        errors_##N(x, lam, w, (V*)x->e, &energy, &fast, &worst); \
        energy /= out[LANE_START_ENERGY] * out[LANE_START_ENERGY]; \
        fast /= out[LANE_START_SPEED] * out[LANE_START_SPEED]; \
        return larger_##N(energy, fast); \
    } \
    \
    /* The Newton step of  lam = Pi(lam - step w)  at lam with slack w, written to `change`. */ \
    ISA static void newton_##N(const lavender_lanes_t* x) { \
        const int m = x->m; \
        const V *a = (const V*)x->a, *mu = (const V*)x->mu, *step = (const V*)x->step, *lam = (const V*)x->lam; \
        const V* w = (const V*)x->w; \
        V *g = (V*)x->g, *f = (V*)x->change; \
        for (int r = 0; r < m; r += 3) { \
            const V *row = a + r * m; \
            V y[3], to[3], p[9]; \
            for (int i = 0; i < 3; i++) y[i] = lam[r + i] - step[r + i] * w[r + i]; \
            project_##N(x->law, mu[r / 3], y, to, p); \
            for (int i = 0; i < 3; i++) { \
                const V p0 = p[3 * i] * step[r], p1 = p[3 * i + 1] * step[r + 1], p2 = p[3 * i + 2] * step[r + 2]; \
                V* to_row = g + (r + i) * m; \
                for (int k = 0; k < m; k++) to_row[k] = p0 * row[k] + p1 * row[m + k] + p2 * row[2 * m + k]; \
                for (int k = 0; k < 3; k++) to_row[r + k] -= p[3 * i + k]; \
                to_row[r + i] += 1.0; \
                f[r + i] = to[i] - lam[r + i]; \
            } \
        } \
        /* LU without exchanges: a lost pivot makes the step worse, which `solve` notices */ \
        for (int j = 0; j < m; j++) { \
            const V *from = g + j * m, inverse = 1.0 / from[j]; \
            int i = j + 1; \
            for (; i + 1 < m; i += 2) { \
                V *first = g + i * m, *second = first + m; \
                const V z = first[j] * inverse, t = second[j] * inverse; \
                for (int k = j + 1; k < m; k++) { \
                    first[k] -= z * from[k]; \
                    second[k] -= t * from[k]; \
                } \
                f[i] -= z * f[j]; \
                f[i + 1] -= t * f[j]; \
            } \
            for (; i < m; i++) { \
                V* first = g + i * m; \
                const V z = first[j] * inverse; \
                for (int k = j + 1; k < m; k++) first[k] -= z * from[k]; \
                f[i] -= z * f[j]; \
            } \
            g[j * m + j] = inverse; \
        } \
        for (int j = m - 1; j >= 0; j--) { \
            V s = f[j]; \
            for (int k = j + 1; k < m; k++) s -= g[j * m + k] * f[k]; \
            f[j] = s * g[j * m + j]; \
        } \
    } \
    \
    /* Solve from the zero impulse to `tol`: block sweeps, then Newton steps. Sweeps replace a step that gains nothing; a lane \
     * with MISSES such steps ends. */ \
    ISA static void solve_##N(const lavender_lanes_t* x) { \
        enum { FIRST_SWEEPS = 6, MORE_SWEEPS = 12, ROUNDS = 10, MISSES = 2 }; \
        const int m = x->m, n = x->n; \
        const V *y = (const V*)x->y, *soft = (const V*)x->soft, *mu = (const V*)x->mu, zero = {0.0}, one = zero + 1.0; \
        V *a = (V*)x->a, *lam = (V*)x->lam, *step = (V*)x->step, *change = (V*)x->change, *kept = (V*)x->kept; \
        V* out = (V*)x->out; \
        V now, steps = zero, misses = zero; \
        I on = (I)(out[LANE_IS_PLAIN] > 0.0); \
        for (int r = 0; r < m; r++) { \
            for (int j = 0; j <= r - r % 3; j += 3) { \
                const V *first = y + r * n, *second = y + j * n; \
                V s0 = zero, s1 = zero, s2 = zero; \
                for (int k = 0; k < n; k++) { \
                    s0 += first[k] * second[k]; \
                    s1 += first[k] * second[n + k]; \
                    s2 += first[k] * second[2 * n + k]; \
                } \
                a[r * m + j] = a[j * m + r] = s0; \
                a[r * m + j + 1] = a[(j + 1) * m + r] = s1; \
                a[r * m + j + 2] = a[(j + 2) * m + r] = s2; \
            } \
            lam[r] = zero; \
        } \
        for (int r = 0; r < m; r++) a[r * m + r] += soft[r]; \
        for (int r = 0; r < m; r += 3) { \
            const V n1 = abs_##N(a[r * m + r + 1]), n2 = abs_##N(a[r * m + r + 2]), pair = abs_##N(a[(r + 1) * m + r + 2]); \
            V top = a[r * m + r], low = larger_##N(a[(r + 1) * m + r + 1], a[(r + 2) * m + r + 2]) + pair; \
            if (x->law) { \
                top += n1 + n2; \
                low += larger_##N(n1, n2); \
                top = low = larger_##N(top, low); \
            } \
            step[r] = 1.0 / top; \
            step[r + 1] = step[r + 2] = 1.0 / low; \
        } \
        sweep_##N(x, FIRST_SWEEPS, on); \
        now = measure_##N(x); \
        on &= (I)(now > 0.25 * x->tol * x->tol); \
        for (int round = 0; round < ROUNDS && any_##N(on); round++) { \
            V next; \
            I worse; \
            newton_##N(x); \
            for (int r = 0; r < m; r++) { \
                V to = lam[r] + change[r]; \
                if (r % 3 == 0) to = larger_##N(to, zero); \
                kept[r] = lam[r]; \
                lam[r] = pick_##N(on, to, lam[r]); \
            } \
            next = measure_##N(x); \
            steps += pick_##N(on, one, zero); \
            worse = on & ((I)(next >= 0.81 * now) | (I)(next != next)); \
            misses += pick_##N(worse, one, zero); \
            on &= (I)(misses < (double)MISSES); \
            worse = worse & on; \
            if (any_##N(worse)) { \
                for (int r = 0; r < m; r++) lam[r] = pick_##N(worse, kept[r], lam[r]); \
                sweep_##N(x, MORE_SWEEPS, worse); \
                next = measure_##N(x); \
            } \
            now = next; \
            on &= (I)(now > 0.25 * x->tol * x->tol); \
        } \
        for (int r = 0; r < m; r += 3) { \
            const V s = larger_##N(lam[r], zero), bound = mu[r / 3] * s; \
            const V size = root_##N(lam[r + 1] * lam[r + 1] + lam[r + 2] * lam[r + 2]); \
            const I beyond = (I)(size > (1.0 + 8.0 * 1.1102230246251565e-16) * bound); \
            const V scale = pick_##N(beyond, bound / larger_##N(size, zero + 1e-300), one); \
            lam[r] = s; \
            lam[r + 1] *= scale; \
            lam[r + 2] *= scale; \
        } \
        out[LANE_STEPS] = steps; \
    }
    #if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_PICK(V, I, mask, a, b) (V)(((mask) & (I)(a)) | (~(mask) & (I)(b)))
    #define LAVENDER_ABS(V, I, a) (V)((I)(a) & 0x7FFFFFFFFFFFFFFFLL)
    #define LAVENDER_VECTOR(N, V, I)                                                        \
        typedef double V __attribute__((vector_size(8 * N), aligned(8), may_alias));         \
        typedef long long I __attribute__((vector_size(8 * N), aligned(8), may_alias));
    LAVENDER_VECTOR(2, lanes_2, mask_2)
    #ifdef __x86_64__
    #include <immintrin.h>
    LAVENDER_VECTOR(4, lanes_4, mask_4)
    LAVENDER_VECTOR(8, lanes_8, mask_8)
    LAVENDER_LANES(2, lanes_2, mask_2, , (lanes_2)_mm_sqrt_pd((__m128d)a), LAVENDER_PICK, LAVENDER_ABS)
    LAVENDER_LANES(4, lanes_4, mask_4, __attribute__((target("avx2"))), (lanes_4)_mm256_sqrt_pd((__m256d)a), LAVENDER_PICK,
                   LAVENDER_ABS)
    LAVENDER_LANES(8, lanes_8, mask_8, __attribute__((target("avx512f,avx512dq,avx512vl"))), (lanes_8)_mm512_sqrt_pd((__m512d)a),
                   LAVENDER_PICK, LAVENDER_ABS)
    #define LAVENDER_IN_LANES(width, name, arguments) \
        ((width) == 8 ? name##_8 arguments : (width) == 4 ? name##_4 arguments : name##_2 arguments)
    #else
    LAVENDER_LANES(2, lanes_2, mask_2, , ((lanes_2){sqrt(a[0]), sqrt(a[1])}), LAVENDER_PICK, LAVENDER_ABS)
    #define LAVENDER_IN_LANES(width, name, arguments) name##_2 arguments
    #endif
    #define LAVENDER_FEWEST_LANES 2
    #else
    #define LAVENDER_PICK(V, I, mask, a, b) ((mask) ? (a) : (b))
    #define LAVENDER_ABS(V, I, a) fabs(a)
    LAVENDER_LANES(1, double, long long, , sqrt(a), LAVENDER_PICK, LAVENDER_ABS)
    #define LAVENDER_IN_LANES(width, name, arguments) name##_1 arguments
    #define LAVENDER_FEWEST_LANES 1
    #endif
    #define lavender_prepare_lanes(x, width) LAVENDER_IN_LANES(width, prepare, (x))
    #define lavender_solve_lanes(x, width) LAVENDER_IN_LANES(width, solve, (x))
    #define lavender_judge_lanes(x, width) LAVENDER_IN_LANES(width, judge, (x))
    #define lavender_interleave(from, narrow, n, to, width) LAVENDER_IN_LANES(width, interleave, (from, narrow, n, to))
    """
    ctypedef struct lanes_t "lavender_lanes_t":
        int32_t m, n, law
        double asymmetry
        double* jac
        double* mass
        double* free
        double* target
        double* soft
        double* mu
        double* full
        double* inverse
        double* root
        double* y
        double* d
        double* b
        double* zero
        double* w
        double* e
        double* lam
        double* push
        double* size
        double* out
        double* a
        double* g
        double* step
        double* change
        double* kept
        double tol
    enum:
        LANE_IS_PLAIN, LANE_START_ENERGY, LANE_START_SPEED, LANE_RHS, LANE_DETERMINANT, LANE_ENERGY, LANE_SPEED, LANE_WORST
        LANE_FLOOR_ENERGY, LANE_FLOOR_SPEED, LANE_WORK, LANE_HEAVIEST, LANE_STEPS, LANE_NUMBERS
        FEWEST_LANES "LAVENDER_FEWEST_LANES"
    void prepare_lanes "lavender_prepare_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void solve_lanes "lavender_solve_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void judge_lanes "lavender_judge_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void interleave "lavender_interleave"(const void** x, int32_t narrow, int64_t n, double* out, int32_t width) noexcept nogil


cdef enum:
    MAX_LANE_ROWS = 48              # to judge; to solve at most as many as velocities
    MAX_LANE_VELOCITIES = 40
    MAX_LANES = 8


cdef inline int32_t count_lanes() noexcept nogil:
    """Return the number of lanes of this processor's widest instructions."""
    return 8 if has_wide() == 2 else 4 if has_wide() == 1 else FEWEST_LANES


cdef inline bint fit_lanes(const blocks_t* p) noexcept nogil:
    """Return whether every block is a contact of three rows without further coefficients."""
    cdef int32_t i
    for i in range(p.n_blocks):
        if not is_disk_friction_contact(p, i) or p.patch_radius[i] != 0.0 or p.rolling[i] != 0.0:
            return False
    return True


cdef inline bint are_worlds_equal_in_size(const worlds_t* w, int64_t first, int64_t end) noexcept nogil:
    """Return whether worlds [first, end) have equal sizes, and lanes can hold that many rows and velocities."""
    cdef const int64_t* at = w.at + first * PLACES
    cdef int64_t i
    if not (0 < at[ROWS] <= MAX_LANE_ROWS and 0 < at[VELOCITIES] <= MAX_LANE_VELOCITIES and at[ROWS] == 3 * at[BLOCKS]):
        return False
    for i in range(first + 1, end):
        at = w.at + i * PLACES
        if at[ROWS] != w.at[first * PLACES + ROWS] or at[VELOCITIES] != w.at[first * PLACES + VELOCITIES]:
            return False
    return True


cdef inline int64_t bind_lanes(lanes_t* x, int32_t width, double* memory) noexcept nogil:
    """Take the arrays of lanes of m rows and n velocities from memory; return the number of doubles."""
    cdef int64_t m = x.m, n = x.n, at = 0
    cdef double*** array = [&x.jac, &x.mass, &x.y, &x.free, &x.inverse, &x.root, &x.push, &x.size, &x.target, &x.soft, &x.d, &x.b,
                            &x.zero, &x.w, &x.e, &x.lam, &x.step, &x.change, &x.kept, &x.mu, &x.full, &x.out, &x.a, &x.g]
    cdef int64_t* count = [m * n, n * n, m * n, n, n, n, n, n, m, m, m, m, m, m, m, m, m, m, m, m // 3, m // 3,
                            LANE_NUMBERS, m * m, m * m]
    cdef int32_t i
    for i in range(24):
        array[i][0] = memory + at if memory != NULL else NULL
        at += width * count[i]
    return at


cdef inline void load_lanes(const lanes_t* x, const worlds_t* w, const double* lam, int64_t first, int64_t end,
                            int32_t width) noexcept nogil:
    """Load worlds [first, end) and their impulses to the lanes; further lanes receive the first world again."""
    cdef const int64_t* at[MAX_LANES]
    cdef const void* line[MAX_LANES]
    cdef double** to = [x.jac, x.mass, x.free, x.target, x.soft, x.mu, x.lam]
    cdef int32_t* place = [JAC, MASS, FREE, TARGET, SOFT, MU, AT_ROW]
    cdef int32_t* count = [x.n, x.n, x.n, x.m, x.m, x.m // 3, x.m]
    cdef int32_t* lines = [x.m, x.n, 1, 1, 1, 1, 1]
    cdef int64_t stride
    cdef int32_t i, k, lane, columns, narrow
    cdef const char* array
    for lane in range(width):
        at[lane] = w.at + PLACES * (first + lane if first + lane < end else first)
    for i in range(7):
        array, narrow = <const char*>lam if i == 6 else <const char*>w.array[i], i < 6 and w.narrow[i]
        stride = w.jac_row_stride if i == 0 else w.mass_row if i == 1 else 0
        if stride == 0 or stride == count[i]:           # one line
            stride, count[i], lines[i] = 0, count[i] * lines[i], 1
        for k in range(lines[i]):
            for lane in range(width):
                line[lane] = array + (4 if narrow else 8) * (at[lane][place[i]] + k * stride)
                if array == NULL:
                    line[lane] = w.blocks.mu + at[lane][BLOCK]
            interleave(line, narrow, count[i], to[i] + <int64_t>k * count[i] * width, width)
    for i in range(x.m // 3):
        for lane in range(width):
            columns = x.n
            while columns > 0 and (x.jac[(3 * i * x.n + columns - 1) * width + lane] == 0.0
                                   and x.jac[((3 * i + 1) * x.n + columns - 1) * width + lane] == 0.0
                                   and x.jac[((3 * i + 2) * x.n + columns - 1) * width + lane] == 0.0):
                columns -= 1
            x.full[i * width + lane] = columns & ~3


cdef inline double lane_number(const lanes_t* x, int32_t which, int32_t width, int32_t lane) noexcept nogil:
    """Return a number of `out` of one lane."""
    return x.out[which * width + lane]


cdef inline score_t score_of_lane(const lanes_t* x, int32_t width, int32_t lane) noexcept nogil:
    """Return the score of the judged impulse of a lane."""
    cdef score_t s = make_empty_score()
    s.energy, s.velocity = lane_number(x, LANE_ENERGY, width, lane), lane_number(x, LANE_SPEED, width, lane)
    s.floor_energy, s.floor_velocity = lane_number(x, LANE_FLOOR_ENERGY, width, lane), lane_number(x, LANE_FLOOR_SPEED, width, lane)
    s.worst = <int32_t>lane_number(x, LANE_WORST, width, lane)
    return s


cdef inline bint is_lane_refined(const lanes_t* x, int32_t width, int32_t lane, double tol, double relative) noexcept nogil:
    """Return whether `refine_reported_view` may refine a lane."""
    cdef double energy = sqrt(fabs(lane_number(x, LANE_WORK, width, lane))), size, strictest = 10.0 * min_reported_loss()
    if energy == 0.0 or not tol < 1.0 / 0.0:
        return False
    size = 0.1 * relative_residual(energy, sqrt(lane_number(x, LANE_HEAVIEST, width, lane)) * energy,
                                   lane_number(x, LANE_START_ENERGY, width, lane), lane_number(x, LANE_START_SPEED, width, lane))
    size = x.n * unit_roundoff() * max(size, 1.0)
    return not size * (2.72 * lane_number(x, LANE_DETERMINANT, width, lane)) <= 0.1 * max(min(tol, strictest),
                                                                                         min(relative, strictest))


cdef inline bint is_solved_in_one_lane(const blocks_t* p, const generalized_t* g, const double* zero_residual) noexcept nogil:
    """Return whether a problem is of the kind that lanes solve: contacts of three rows, one island, M without zeros.

    More rows than velocities are left out: A is then singular, and other methods take less time.
    """
    cdef int32_t i, n = g.n
    if (not (0 < p.n_rows <= min(n, MAX_LANE_ROWS) and n <= MAX_LANE_VELOCITIES and p.islands == NULL and zero_residual[2] == 1.0)
            or g.mptr[n] != n * (n + 1) // 2 or not fit_lanes(p)):
        return False
    for i in range(g.mptr[n]):
        if g.mval[i] == 0.0:
            return False
    return True


cdef inline int32_t solve_in_one_lane(const blocks_t* p, const generalized_t* g, const double* zero_residual, double tol,
                                      workspace_t* workspace, double* lam) noexcept nogil:
    """Solve from the zero impulse, with the bits of a lane, into lam (m); return the Newton steps, -1 without memory."""
    cdef lanes_t x
    cdef int32_t i, r, a, lane, nc, width = FEWEST_LANES
    cdef const double* y
    x.m, x.n, x.law, x.tol = p.n_rows, g.n, p.law, tol
    if not grow_workspace_to(workspace, 0, bind_lanes(&x, width, NULL)):
        return -1
    bind_lanes(&x, width, workspace.real)
    memset(x.y, 0, <int64_t>x.m * x.n * width * sizeof(double))
    for lane in range(width):
        for i in range(g.n_panels):
            nc = g.pcol[i + 1] - g.pcol[i]
            for r in range(g.prow[i], g.prow[i + 1]):
                y = g.y + g.pval[i] + <int64_t>(r - g.prow[i]) * nc
                for a in range(nc):
                    x.y[(r * x.n + g.cols[g.pcol[i] + a]) * width + lane] = y[a]
        for r in range(x.m):
            x.b[r * width + lane], x.d[r * width + lane], x.soft[r * width + lane] = p.b[r], p.d[r], g.compliance[r]
        for i in range(p.n_blocks):
            x.mu[i * width + lane] = p.mu[i]
        x.out[LANE_IS_PLAIN * width + lane] = 1.0
        x.out[LANE_START_ENERGY * width + lane] = zero_residual[0]
        x.out[LANE_START_SPEED * width + lane] = zero_residual[1]
    solve_lanes(&x, width)
    for r in range(x.m):
        lam[r] = x.lam[r * width]
    return <int32_t>x.out[LANE_STEPS * width]
