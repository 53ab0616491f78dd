"""Worlds in the lanes of vectors: 8, 4 or 2 worlds of similar structure at once, with bounded rows and contacts of three rows.

Entry i of an array holds entry i of every world: x[width i + lane]. Worlds with fewer rows than another lane's receive empty
rows, whose impulses are 0 and which change no bit of the others. A world is processed as one problem by the functions
of core and judge, with the same bits: no sum runs over lanes, so that the width changes no bit. Zeros of J, M and Y are processed
as numbers, or left out where every lane has them. Worlds that a lane does not cover are processed alone: invalid numbers,
several islands, a zero impulse that is a solution or violates bounds, results that judge/refine.pxd refines or that are above
tol. From the zero impulse such problems are solved by sweeps over blocks, then Newton steps on the natural map, in batches as in
single calls (`solve_in_one_lane`, with vectors over rows). To change a width, only the list of `LAVENDER_LANES` changes.
"""
from libc.math cimport fabs, sqrt
from libc.stdint cimport int32_t, int64_t, uint64_t
from libc.string cimport memset

from lavender_ext.batch.world cimport (BLOCK, BLOCKS, CONE_ROW, FREE, JAC, MASS, MU, PLACES, ROWS, SOFT, TARGET, VELOCITIES,
                                       AT_ROW, worlds_t)
from lavender_ext.core.block_types cimport ROW, blocks_t, has_independent_rows, is_disk_friction_contact
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
        int m, n, law, k;
        const int *ptr, *kind;                  /* blocks of every lane: first rows (k + 1), 0 for bounded rows (k) */
        double asymmetry;                       /* permitted asymmetry of M, as in `worlds_t`; below 0: M is a lower triangle */
        double *jac, *mass, *free, *target, *soft, *mu, *lower, *upper;         /* data */
        double *real;                           /* (k) 1 for blocks of the world, 0 for those that only other lanes have */
        double *inverse, *root, *y, *d, *b, *zero, *w, *e, *lam, *push, *size, *out;
        double *a, *g, *step, *change, *kept;   /* for `solve`, to the relative residual `tol` */
        double tol;
        unsigned long long *fours, *last;       /* (k) sets of the columns of each block: all but the last, and these */
        int *left, *own;        /* lists (LANE_LIST) of the columns of each row of L and of each block that any lane has */
    } lavender_lanes_t;
    enum { LANE_IS_PLAIN, LANE_START_ENERGY, LANE_START_SPEED, LANE_RHS, LANE_CONDITION, LANE_ENERGY, LANE_SPEED, LANE_WORST,
           LANE_FLOOR_ENERGY, LANE_FLOOR_SPEED, LANE_WORK, LANE_HEAVIEST, LANE_STEPS, LANE_COUNT, LANE_NUMBERS, LANE_ROWS = 48,
           LANE_VELOCITIES = 40, LANE_LIST = LANE_VELOCITIES + 1,
           LANE_TRIANGLE = LANE_VELOCITIES * LANE_LIST / 2 };
    /* Replace the columns of M left of the diagonal (n sets) by the columns of L, and write the ancestors of each column, itself
     * included, to `above` (n). */
    static void lavender_close_columns(int n, unsigned long long* left, unsigned long long* above) {
        const unsigned long long one = 1;
        int last[LANE_VELOCITIES];
        for (int i = n - 1; i >= 0; i--) {              /* row i is added to the row of its last column */
            int j = i - 1;
            while (j >= 0 && !(left[i] >> j & 1)) j--;
            if (j >= 0) left[j] |= left[i] & ((one << j) - 1);
            last[i] = j;
        }
        for (int i = 0; i < n; i++) above[i] = (last[i] >= 0 ? above[last[i]] : 0) | one << i;
    }
    /* Write the number of runs of columns in a set, and the first column and the end of each run. */
    static void lavender_list_columns(unsigned long long set, int* list) {
        int inside = 0;
        list[0] = 0;
        for (int k = 0; set || inside; k++, set >>= 1) {
            if (!inside && (set & 1)) list[2 * list[0] + 1] = k;
            if (inside && !(set & 1)) list[2 * list[0]++ + 2] = k;
            inside = set & 1;
        }
    }
    /* for (all columns k of a list), upwards and downwards */
    #define LAVENDER_UP(k, list) \
        for (const int *run_ = (list) + 1, *end_ = run_ + 2 * (list)[0]; run_ < end_; run_ += 2) \
            for (int k = run_[0], stop_ = run_[1]; k < stop_; k++)
    #define LAVENDER_DOWN(k, list) \
        for (const int *run_ = (list) + 2 * (list)[0] - 1; run_ > (list); run_ -= 2) \
            for (int k = run_[1] - 1, stop_ = run_[0]; k >= stop_; k--)
    /* One lane has vectors over rows: places of n numbers in fours, and a place from which all numbers after j are reached. */
    #define LAVENDER_PLACES(V, n) (sizeof(V) == sizeof(double) ? ((n) + 3) & ~3 : (n))
    #define LAVENDER_FROM(V, j) (sizeof(V) == sizeof(double) ? ((j) + 1) & ~3 : (j) + 1)
    #define LAVENDER_SOLVER(N, V, I, ISA, ROOT, PICK, ABS, ANY) \
    ISA static inline V pick_##N(I mask, V a, V b) { return PICK(V, I, mask, a, b); } \
    ISA static inline V larger_##N(V a, V b) { return PICK(V, I, (I)(a > b), a, b); } \
    ISA static inline V clip_##N(V a, V low, V high) { return pick_##N((I)(a < low), low, pick_##N((I)(a > high), high, a)); } \
    ISA static inline V abs_##N(V a) { return ABS(V, I, a); } \
    ISA static inline V root_##N(V a) { return ROOT; } \
    ISA static inline int any_##N(I mask) { return ANY; } \
    ISA static inline I all_##N(I mask) { return sizeof(V) == sizeof(double) ? (I)(0 - mask) : mask; }  /* all bits */ \
    \
    /* The judge's errors e (m) of impulses with slack w, and sum d e^2, the largest nu d e^2 and its row (judge/tally.pxd). */ \
    ISA static void errors_##N(const lavender_lanes_t* x, const V* lam, const V* w, V* e, V* energy, V* fast, V* worst) { \
        const V *d = (const V*)x->d, *mu = (const V*)x->mu; \
        const V zero = {0.0}; \
        V sum = zero, most = zero - 1.0, at = zero - 1.0; \
        for (int i = 0; i < x->k; i++) { \
            int r = x->ptr[i]; \
            for (; !x->kind[i] && r < x->ptr[i + 1]; r++) { \
                e[r] = clip_##N(w[r] / d[r], lam[r] - ((const V*)x->upper)[r], lam[r] - ((const V*)x->lower)[r]); \
                const V v = d[r] * e[r], square = v * v; \
                sum += v * e[r]; \
                at = pick_##N((I)(square > most), zero + (double)r, at); \
                most = larger_##N(square, most); \
            } \
            if (!x->kind[i]) continue; \
            const V dn = d[r], dt = d[r + 1], f = mu[i]; \
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
    /* w = A lam - b, four columns of A at a time. */ \
    ISA static void multiply_##N(const lavender_lanes_t* x) { \
        const int m = x->m, ld = LAVENDER_PLACES(V, m); \
        const V *a = (const V*)x->a, *b = (const V*)x->b, *lam = (const V*)x->lam; \
        V* w = (V*)x->w; \
        int k = 0; \
        for (int r = 0; r < m; r++) w[r] = -b[r]; \
        for (int r = m; r < ld; r++) w[r] = b[0] - b[0]; \
        for (; k + 4 <= m; k += 4, a += 4 * ld) { \
            const V l0 = lam[k], l1 = lam[k + 1], l2 = lam[k + 2], l3 = lam[k + 3]; \
            const V *a1 = a + ld, *a2 = a1 + ld, *a3 = a2 + ld; \
            LAVENDER_APART \
            for (int r = 0; r < ld; r++) w[r] = (((w[r] + a[r] * l0) + a1[r] * l1) + a2[r] * l2) + a3[r] * l3; \
        } \
        for (; k < m; k++, a += ld) { \
            const V l0 = lam[k]; \
            LAVENDER_APART \
            for (int r = 0; r < ld; r++) w[r] += a[r] * l0; \
        } \
    } \
    \
    /* `count` sweeps over blocks in lanes that are `on`. Columns of A whose rows do not change in any lane are not read. */ \
    ISA static void sweep_##N(const lavender_lanes_t* x, int count, I on) { \
        const int m = x->m, ld = LAVENDER_PLACES(V, m); \
        const V *a = (const V*)x->a, *mu = (const V*)x->mu, *step = (const V*)x->step, zero = {0.0}; \
        const V *lower = (const V*)x->lower, *upper = (const V*)x->upper; \
        V *lam = (V*)x->lam, *w = (V*)x->w; \
        multiply_##N(x); \
        while (count--) \
            for (int i = 0; i < x->k; i++) { \
                int r = x->ptr[i]; \
                for (; !x->kind[i] && r < x->ptr[i + 1]; r++) { \
                    const V *row = a + r * ld, to = clip_##N(lam[r] - step[r] * w[r], lower[r], upper[r]); \
                    const V change = pick_##N(on, to - lam[r], zero); \
                    lam[r] = pick_##N(on, to, lam[r]); \
                    if (any_##N((I)(change != 0.0))) { \
                        LAVENDER_APART \
                        for (int k = 0; k < ld; k++) w[k] += row[k] * change; \
                    } \
                } \
                if (!x->kind[i]) continue; \
                const V* row = a + r * ld; \
                V y[3], to[3], w1 = w[r + 1], w2 = w[r + 2]; \
                y[0] = lam[r] - step[r] * w[r]; \
                if (!x->law) { \
                    y[0] = larger_##N(y[0], zero); \
                    w1 += row[ld + r] * (y[0] - lam[r]); \
                    w2 += row[2 * ld + r] * (y[0] - lam[r]); \
                } \
                y[1] = lam[r + 1] - step[r + 1] * w1; \
                y[2] = lam[r + 2] - step[r + 2] * w2; \
                project_##N(x->law, mu[i], y, to, (V*)0); \
                for (int j = 0; j < 3; j++) { \
                    y[j] = pick_##N(on, to[j] - lam[r + j], zero); \
                    lam[r + j] = pick_##N(on, to[j], lam[r + j]); \
                } \
                if (any_##N((I)(y[0] != 0.0) | (I)(y[1] != 0.0) | (I)(y[2] != 0.0))) { \
                    const V c0 = y[0], c1 = y[1], c2 = y[2], *row1 = row + ld, *row2 = row1 + ld; \
                    LAVENDER_APART \
                    for (int k = 0; k < ld; k++) w[k] = ((w[k] + row[k] * c0) + row1[k] * c1) + row2[k] * c2; \
                } \
            } \
    } \
    \
    /* w = A lam - b, and the square of the relative residual (judge/score.pxd). */ \
    ISA static V measure_##N(const lavender_lanes_t* x) { \
        const V *lam = (const V*)x->lam, *out = (const V*)x->out; \
        V energy, fast, worst; \
        multiply_##N(x); \
        errors_##N(x, lam, (const V*)x->w, (V*)x->e, &energy, &fast, &worst); \
        energy /= out[LANE_START_ENERGY] * out[LANE_START_ENERGY]; \
        fast /= out[LANE_START_SPEED] * out[LANE_START_SPEED]; \
        return larger_##N(energy, fast); \
    } \
    \
    /* The Newton step of  lam = Pi(lam - step w)  at lam with slack w, written to `change`. Return the lanes that lose a pivot. \
     * Rows that no bound leaves free in any lane are rows of the unit matrix, and are not eliminated. */ \
    ISA static I newton_##N(const lavender_lanes_t* x) { \
        const int m = x->m, ld = LAVENDER_PLACES(V, m); \
        const V *a = (const V*)x->a, *mu = (const V*)x->mu, *step = (const V*)x->step, *lam = (const V*)x->lam; \
        const V *w = (const V*)x->w, *lower = (const V*)x->lower, *upper = (const V*)x->upper, zero = {0.0}, one = zero + 1.0; \
        V *g = (V*)x->g, *f = (V*)x->change; \
        int free[LANE_ROWS], count = 0, first = 0; \
        I lost = (I)(zero != zero); \
        for (int i = 0; i < x->k; i++) { \
            const int rows = x->kind[i] ? 3 : 1; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r += rows) { \
                const V* row = a + r * ld; \
                V y[3], to[3], p[9]; \
                for (int j = 0; j < rows; j++) y[j] = lam[r + j] - step[r + j] * w[r + j]; \
                if (x->kind[i]) project_##N(x->law, mu[i], y, to, p); \
                else { \
                    to[0] = clip_##N(y[0], lower[r], upper[r]); \
                    p[0] = pick_##N((I)(y[0] > lower[r]) & (I)(y[0] < upper[r]), one, zero); \
                } \
                for (int j = 0; j < rows; j++) { \
                    V* to_row = g + (r + j) * ld; \
                    const V* q = p + 3 * j; \
                    f[r + j] = to[j] - lam[r + j]; \
                    if (rows == 1 && any_##N((I)(p[0] != 0.0))) { \
                        const V q0 = p[0] * step[r]; \
                        free[count++] = r; \
                        LAVENDER_APART \
                        for (int k = 0; k < ld; k++) to_row[k] = q0 * row[k]; \
                    } else if (rows == 3 && any_##N((I)(q[0] != 0.0) | (I)(q[1] != 0.0) | (I)(q[2] != 0.0))) { \
                        const V q0 = q[0] * step[r], q1 = q[1] * step[r + 1], q2 = q[2] * step[r + 2]; \
                    const V *row1 = row + ld, *row2 = row1 + ld; \
                        free[count++] = r + j; \
                        LAVENDER_APART \
                        for (int k = 0; k < ld; k++) to_row[k] = q0 * row[k] + q1 * row1[k] + q2 * row2[k]; \
                    } else \
                        for (int k = 0; k < ld; k++) to_row[k] = zero; \
                    for (int k = 0; k < rows; k++) to_row[r + k] -= p[3 * j + k]; \
                    to_row[r + j] += 1.0; \
                } \
            } \
        } \
        /* LU without exchanges */ \
        for (int j = 0; j < m; j++) { \
            const V* from = g + j * ld; \
            if (first == count || free[first] != j) { \
                for (int t = first; t < count; t++) f[free[t]] -= g[free[t] * ld + j] * f[j]; \
                continue; \
            } \
            const V inverse = 1.0 / from[j]; \
            int t = ++first; \
            lost |= (I)(abs_##N(inverse) > 1e300) | (I)(inverse != inverse); \
            for (; t + 1 < count; t += 2) { \
                V *up = g + free[t] * ld, *low = g + free[t + 1] * ld; \
                const V z = up[j] * inverse, s = low[j] * inverse; \
                LAVENDER_APART \
                for (int k = LAVENDER_FROM(V, j); k < ld; k++) { \
                    up[k] -= z * from[k]; \
                    low[k] -= s * from[k]; \
                } \
                f[free[t]] -= z * f[j]; \
                f[free[t + 1]] -= s * f[j]; \
            } \
            if (t < count) { \
                V* up = g + free[t] * ld; \
                const V z = up[j] * inverse; \
                LAVENDER_APART \
                for (int k = LAVENDER_FROM(V, j); k < ld; k++) up[k] -= z * from[k]; \
                f[free[t]] -= z * f[j]; \
            } \
            g[j * ld + j] = inverse; \
        } \
        for (int j = m - 1; j >= 0; j--) { \
            if (first > 0 && free[first - 1] == j) { \
                first--; \
                f[j] *= g[j * ld + j]; \
            } \
            lost |= (I)(abs_##N(f[j]) > 1e300) | (I)(f[j] != f[j]); \
            for (int t = 0; t < first; t++) f[free[t]] -= g[free[t] * ld + j] * f[j]; \
        } \
        return lost; \
    } \
    \
    /* Project lam on its bounds: normals and bounded rows if `to_cones` is 0. */ \
    ISA static void bound_##N(const lavender_lanes_t* x, V* lam, int to_cones) { \
        const V *mu = (const V*)x->mu, *lower = (const V*)x->lower, *upper = (const V*)x->upper, zero = {0.0}; \
        for (int i = 0; i < x->k; i++) { \
            int r = x->ptr[i]; \
            for (; !x->kind[i] && r < x->ptr[i + 1]; r++) lam[r] = clip_##N(lam[r], lower[r], upper[r]); \
            if (!x->kind[i]) continue; \
            lam[r] = larger_##N(lam[r], zero); \
            if (to_cones) { \
                const V bound = mu[i] * lam[r], size = root_##N(lam[r + 1] * lam[r + 1] + lam[r + 2] * lam[r + 2]); \
                const I beyond = (I)(size > (1.0 + 8.0 * 1.1102230246251565e-16) * bound); \
                const V scale = pick_##N(beyond, bound / larger_##N(size, zero + 1e-300), zero + 1.0); \
                lam[r + 1] *= scale; \
                lam[r + 2] *= scale; \
            } \
        } \
    } \
    \
    /* Solve from the zero impulse to `tol`: block sweeps, then Newton steps. Sweeps replace a step that gains nothing; a lane \
     * with MISSES such steps ends. A singular A is not solved: more rows than velocities need compliance. */ \
    ISA static void solve_##N(const lavender_lanes_t* x) { \
        enum { FIRST_SWEEPS = 6, MORE_SWEEPS = 12, ROUNDS = 10, MISSES = 3 }; \
        const int m = x->m, n = x->n, ld = LAVENDER_PLACES(V, m); \
        const V *y = (const V*)x->y, *soft = (const V*)x->soft, *d = (const V*)x->d, zero = {0.0}, one = zero + 1.0; \
        V *a = (V*)x->a, *lam = (V*)x->lam, *step = (V*)x->step, *change = (V*)x->change, *kept = (V*)x->kept; \
        V *out = (V*)x->out, *across = (V*)x->g; \
        V now, steps = zero, misses = zero; \
        int own[LANE_VELOCITIES]; \
        I on = (I)(out[LANE_IS_PLAIN] > 0.0); \
        for (int r = 0; r < m; r++) { \
            lam[r] = zero; \
            on &= (I)(out[LANE_COUNT] <= (double)n) | (I)(soft[r] >= 1e-5 * d[r]); \
            for (int k = 0; k < n; k++) across[k * ld + r] = y[r * n + k]; \
        } \
        for (int k = 0; k < n; k++) \
            for (int r = m; r < ld; r++) across[k * ld + r] = zero; \
        if (!any_##N(on)) return; \
        for (int i = 0; i < x->k; i++) { \
            int count = 0; \
            LAVENDER_UP(k, x->own + i * LANE_LIST) own[count++] = k; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) { \
                const V* row = y + r * n; \
                V* to_row = a + r * ld; \
                const int end = LAVENDER_PLACES(V, r + 1); \
                int t = 0; \
                for (int j = 0; j < ld; j++) to_row[j] = zero; \
                for (; t + 4 <= count; t += 4) { \
                    const int k = own[t], k1 = own[t + 1], k2 = own[t + 2], k3 = own[t + 3]; \
                    const V *c = across + k * ld, *c1 = across + k1 * ld, *c2 = across + k2 * ld, *c3 = across + k3 * ld; \
                    const V y0 = row[k], y1 = row[k1], y2 = row[k2], y3 = row[k3]; \
                    LAVENDER_APART \
                    for (int j = 0; j < end; j++) \
                        to_row[j] = (((to_row[j] + c[j] * y0) + c1[j] * y1) + c2[j] * y2) + c3[j] * y3; \
                } \
                for (; t < count; t++) { \
                    const V *c = across + own[t] * ld, y0 = row[own[t]]; \
                    LAVENDER_APART \
                    for (int j = 0; j < end; j++) to_row[j] += c[j] * y0; \
                } \
                for (int j = 0; j < r; j++) a[j * ld + r] = to_row[j]; \
                to_row[r] += soft[r]; \
            } \
        } \
        for (int i = 0; i < x->k; i++) { \
            int r = x->ptr[i]; \
            for (; !x->kind[i] && r < x->ptr[i + 1]; r++) step[r] = 1.0 / a[r * ld + r]; \
            if (!x->kind[i]) continue; \
            const V n1 = abs_##N(a[r * ld + r + 1]), n2 = abs_##N(a[r * ld + r + 2]), pair = abs_##N(a[(r + 1) * ld + r + 2]); \
            V top = a[r * ld + r], low = larger_##N(a[(r + 1) * ld + r + 1], a[(r + 2) * ld + r + 2]) + pair; \
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
            I worse = newton_##N(x); \
            V next; \
            for (int r = 0; r < m; r++) { \
                kept[r] = lam[r]; \
                change[r] += lam[r]; \
            } \
            bound_##N(x, change, 0); \
            for (int r = 0; r < m; r++) lam[r] = pick_##N(on, change[r], lam[r]); \
            next = measure_##N(x); \
            steps += pick_##N(on, one, zero); \
            worse = on & (worse | (I)(next >= 0.81 * now) | (I)(next != next)); \
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
        bound_##N(x, lam, 1); \
        for (int r = 0; r < m; r++) lam[r] += 0.0; \
        out[LANE_STEPS] = steps; \
    }
    #define LAVENDER_LANES(N, V, I, ISA) \
    /* Interleave n numbers from each of N arrays, of float if `narrow`, number i to place at[i]. */ \
    ISA static void interleave_##N(const void* const* from, int narrow, int n, const int* at, double* to) { \
        for (int l = 0; l < N; l++) { \
            const float* single = from[l]; \
            const double* wide = from[l]; \
            for (int i = 0; narrow && i < n; i++) to[N * at[i] + l] = single[i]; \
            for (int i = 0; !narrow && i < n; i++) to[N * at[i] + l] = wide[i]; \
        } \
    } \
    \
    /* Overwrite v (n) with M^-1 v. */ \
    ISA static void solve_mass_##N(const lavender_lanes_t* x, V* v) { \
        const int n = x->n; \
        const V *l = (const V*)x->mass, *inverse = (const V*)x->inverse; \
        for (int k = n - 1; k >= 0; k--) { \
            const int* left = x->left + k * LANE_LIST; \
            const V z = v[k]; \
            LAVENDER_UP(i, left) v[i] -= l[k * n + i] * z; \
        } \
        for (int k = 0; k < n; k++) { \
            const int* left = x->left + k * LANE_LIST; \
            V z = v[k] * inverse[k]; \
            LAVENDER_UP(i, left) z -= l[k * n + i] * v[i]; \
            v[k] = z; \
        } \
    } \
    \
    /* The norm of v (n), with the sums of core/dot.pxd. */ \
    ISA static V norm_##N(const V* v, int n) { \
        const V zero = {0.0}; \
        V sum[4] = {zero, zero, zero, zero}; \
        for (int i = 0; i < n; i++) sum[i < (n & ~3) ? i & 3 : 0] += v[i] * v[i]; \
        return root_##N((sum[0] + sum[1]) + (sum[2] + sum[3])); \
    } \
    \
    /* `estimate_condition` of core/condition.pxd, from the factor of M and its diagonal. */ \
    ISA static V condition_##N(const lavender_lanes_t* x, const V* diagonal) { \
        const int n = x->n; \
        const V *l = (const V*)x->mass, zero = {0.0}; \
        V *s = (V*)x->size, v[LANE_VELOCITIES], first, second; \
        for (int i = 0; i < n; i++) { \
            s[i] = root_##N(diagonal[i]); \
            v[i] = zero; \
        } \
        for (int i = n - 1; i >= 0; i--) { \
            const int* left = x->left + i * LANE_LIST; \
            v[i] += pick_##N((I)(v[i] >= 0.0), s[i], -s[i]); \
            LAVENDER_UP(j, left) v[j] -= l[i * n + j] * v[i]; \
        } \
        for (int i = 0; i < n; i++) { \
            const int* left = x->left + i * LANE_LIST; \
            V z = v[i] * ((const V*)x->inverse)[i]; \
            LAVENDER_UP(j, left) z -= v[j] * l[i * n + j]; \
            v[i] = z; \
        } \
        for (int i = 0; i < n; i++) v[i] *= s[i]; \
        first = norm_##N(v, n); \
        for (int i = 0; i < n; i++) v[i] = s[i] * (v[i] / first); \
        solve_mass_##N(x, v); \
        for (int i = 0; i < n; i++) v[i] *= s[i]; \
        second = norm_##N(v, n); \
        second = larger_##N(larger_##N(second, first / sqrt((double)n)), zero + 1.0); \
        return pick_##N((I)(first > 0.0) & (I)(first < 1e300), second, zero + 1e300); \
    } \
    \
    /* List the columns of L and of each block, with their ancestors. Return the lanes whose blocks are one island. */ \
    ISA static I list_columns_##N(const lavender_lanes_t* x) { \
        enum { LANES = sizeof(V) / sizeof(double) }; \
        const int n = x->n; \
        const V *jac = (const V*)x->jac, *l = (const V*)x->mass; \
        const I none = {0}; \
        I left[LANE_VELOCITIES], above[LANE_VELOCITIES], full = none - 1, common = none - 1, roots = none; \
        unsigned long long at[2][LANE_VELOCITIES], differs = 0; \
        for (int i = 0; i < n; i++) { \
            left[i] = none; \
            for (int j = 0; j < i; j++) left[i] |= all_##N((I)(l[i * n + j] != 0.0)) & 1LL << j; \
            full &= all_##N((I)(left[i] == (1LL << i) - 1)); \
            for (int k = 1; k < LANES; k++) \
                differs |= ((unsigned long long*)(left + i))[k] ^ ((unsigned long long*)(left + i))[0]; \
        } \
        for (int k = 0; k < LANES; k++) { \
            for (int i = 0; i < n && (k == 0 || differs); i++) at[0][i] = ((unsigned long long*)(left + i))[k]; \
            if (k == 0 || differs) lavender_close_columns(n, at[0], at[1]); \
            for (int i = 0; i < n; i++) { \
                ((unsigned long long*)(left + i))[k] = at[0][i]; \
                ((unsigned long long*)(above + i))[k] = at[1][i]; \
            } \
        } \
        for (int i = 0; i < n; i++) { \
            unsigned long long set = 0; \
            for (int k = 0; k < LANES; k++) set |= ((unsigned long long*)(left + i))[k]; \
            lavender_list_columns(set, x->left + i * LANE_LIST); \
            roots |= all_##N((I)(left[i] == 0)) & 1LL << i; \
        } \
        for (int i = 0; i < x->k; i++) { \
            int* own = x->own + i * LANE_LIST; \
            I columns = none, last = none, count = none; \
            unsigned long long set = 0; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) \
                for (int k = 0; k < n; k++) columns |= all_##N((I)(jac[r * n + k] != 0.0)) & above[k]; \
            for (int k = 0; k < LANES; k++) set |= ((unsigned long long*)&columns)[k]; \
            lavender_list_columns(set, own); \
            LAVENDER_UP(k, own) count += columns >> k & 1; \
            count &= 3; \
            LAVENDER_DOWN(k, own) { \
                const I one = all_##N((I)(count > 0)) & columns >> k & 1; \
                last |= one << k; \
                count -= one; \
            } \
            ((I*)x->fours)[i] = columns ^ last; \
            ((I*)x->last)[i] = last; \
            common &= columns | all_##N((I)(((const V*)x->real)[i] == 0.0)); \
        } \
        return (I)((common & roots) != 0) & (full | (n < LANE_VELOCITIES ? -1 : 0)); \
    } \
    /* Check the data; M = L^T D L, Y = J L^-1 D^-1/2, d, b, and the errors of the zero impulse. LANE_IS_PLAIN receives 1 if \
     * no number is out of range, the rows form one island, and the zero impulse is within its bounds and not a solution. */ \
    ISA static void prepare_##N(const lavender_lanes_t* x) { \
        const int m = x->m, n = x->n; \
        V *l = (V*)x->mass, *y = (V*)x->y, *d = (V*)x->d, *b = (V*)x->b, *inverse = (V*)x->inverse, *root = (V*)x->root; \
        V *w = (V*)x->w, *e = (V*)x->e, *lam = (V*)x->zero, *push = (V*)x->push, *out = (V*)x->out; \
        const V *jac = (const V*)x->jac, *free = (const V*)x->free, *target = (const V*)x->target, *soft = (const V*)x->soft; \
        const V *mu = (const V*)x->mu, *lower = (const V*)x->lower, *upper = (const V*)x->upper; \
        const V zero = {0.0}, one = zero + 1.0; \
        V largest = zero, determinant = one, right = zero, energy, fast, worst; \
        I good = (I)(zero == zero), moves = (I)(zero != zero); \
        for (int i = 0; i < m * n; i++) good &= (I)(abs_##N(jac[i]) <= 1e60); \
        for (int i = 0; i < n; i++) good &= (I)(abs_##N(free[i]) <= 1e60); \
        for (int i = 0; i < m; i++) \
            good &= (I)(abs_##N(target[i]) <= 1e60) & (I)(soft[i] <= 1e60) & ((I)(soft[i] >= 1e-60) | (I)(soft[i] == 0.0)); \
        for (int i = 0; i < x->k; i++) good &= (I)(mu[i] <= 1e60) & ((I)(mu[i] >= 1e-60) | (I)(mu[i] == 0.0)); \
        for (int i = 0; i < x->k; i++) \
            for (int r = x->ptr[i]; !x->kind[i] && r < x->ptr[i + 1]; r++) \
                good &= (I)(lower[r] <= 0.0) & (I)(upper[r] >= 0.0); \
        for (int i = 0; i < n; i++) \
            for (int j = 0; j <= i; j++) good &= (I)(abs_##N(l[i * n + j]) <= 1e60); \
        for (int i = 0; x->asymmetry >= 0.0 && i < n; i++)      /* just within `asymmetry`, so that squares may round */ \
            for (int j = 0; j < i; j++) { \
                const V gap = l[i * n + j] - l[j * n + i], size = l[i * n + i] * l[j * n + j]; \
                good &= (I)(gap == 0.0) | (I)(gap * gap <= 0.99 * x->asymmetry * x->asymmetry * size); \
            } \
        good &= list_columns_##N(x); \
        /* factor of M; the diagonal of l keeps D */ \
        for (int i = 0; i < n; i++) inverse[i] = l[i * n + i]; \
        for (int k = n - 1; k >= 0; k--) { \
            V* row = l + k * n; \
            const V size = inverse[k]; \
            const int* left = x->left + k * LANE_LIST; \
            good &= (I)(row[k] > 8.8817841970012523e-16 * size) & (I)(row[k] >= 1e-60); \
            inverse[k] = 1.0 / row[k]; \
            root[k] = root_##N(inverse[k]); \
            LAVENDER_DOWN(j, left) { \
                V* to = l + j * n; \
                const V z = row[j] * inverse[k]; \
                to[j] -= z * row[j]; \
                LAVENDER_UP(i, x->left + j * LANE_LIST) to[i] -= z * row[i]; \
                row[j] = z; \
            } \
            push[k] = size;                                     /* M_kk for the determinant below */ \
        } \
        for (int k = 0; k < n; k++) determinant *= inverse[k] * push[k]; \
        out[LANE_CONDITION] = 2.72 * determinant; \
        if (any_##N((I)(determinant > 1e3))) out[LANE_CONDITION] = condition_##N(x, push); \
        /* Y and b */ \
        for (int i = 0; i < x->k; i++) { \
            const int* own = x->own + i * LANE_LIST; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) { \
                V *row = y + r * n, sum = zero; \
                for (int k = 0; k < n; k++) row[k] = jac[r * n + k]; \
                LAVENDER_UP(k, own) sum += row[k] * free[k]; \
                b[r] = target[r] - sum; \
                largest = larger_##N(abs_##N(b[r]), largest); \
                LAVENDER_DOWN(k, own) { \
                    const V *from = l + k * n, z = row[k]; \
                    LAVENDER_UP(j, x->left + k * LANE_LIST) row[j] -= from[j] * z; \
                    row[k] = z * root[k]; \
                } \
            } \
        } \
        good &= (I)(largest <= 1e60) & ((I)(largest >= 1e-60) | (I)(largest == 0.0)); \
        /* d: four running sums over the columns of a block, and its last columns in the first sum (core/dot.pxd); the sums \
         * change places after each column */ \
        for (int i = 0; i < x->k; i++) { \
            const I fours = ((const I*)x->fours)[i], last = ((const I*)x->last)[i]; \
            const int* own = x->own + i * LANE_LIST; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) { \
                V s0 = zero, s1 = zero, s2 = zero, s3 = zero; \
                LAVENDER_UP(k, own) { \
                    const I turns = 0 - (fours >> k & 1), end = 0 - (last >> k & 1); \
                    const V square = y[r * n + k] * y[r * n + k], sum = s0 + square; \
                    s0 = pick_##N(turns, s1, s0); \
                    s1 = pick_##N(turns, s2, s1); \
                    s2 = pick_##N(turns, s3, s2); \
                    s3 = pick_##N(turns, sum, s3); \
                    s0 += pick_##N(end, square, zero); \
                } \
                d[r] = ((s0 + s1) + (s2 + s3)) + soft[r]; \
                good &= (I)(d[r] >= 1e-60) & (I)(d[r] <= 1e60); \
            } \
            if (x->kind[i]) d[x->ptr[i] + 1] = d[x->ptr[i] + 2] = 0.5 * (d[x->ptr[i] + 1] + d[x->ptr[i] + 2]); \
        } \
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
        out[LANE_IS_PLAIN] = pick_##N(good, one, zero); \
    } \
    \
    /* Judge lam: slack, errors, norms, floors, and the sums of judge/refine.pxd. */ \
    ISA static void judge_##N(const lavender_lanes_t* x) { \
        const int n = x->n; \
        const V *y = (const V*)x->y, *d = (const V*)x->d, *b = (const V*)x->b, *lam = (const V*)x->lam; \
        const V *jac = (const V*)x->jac, *soft = (const V*)x->soft, *mu = (const V*)x->mu; \
        const V *lower = (const V*)x->lower, *upper = (const V*)x->upper; \
        V *w = (V*)x->w, *e = (V*)x->e, *push = (V*)x->push, *out = (V*)x->out, *size = (V*)x->size; \
        const V zero = {0.0}, one = zero + 1.0; \
        V energy, fast, worst, sum[2] = {zero, zero}, heaviest = zero; \
        const double unit = 1.1102230246251565e-16; \
        I good = (I)(out[LANE_IS_PLAIN] > 0.0), odd = (I)(zero != zero); \
        /* push = M^-1 J^T lam, w = J push + soft lam - b */ \
        for (int k = 0; k < n; k++) push[k] = size[k] = zero; \
        for (int i = 0; i < x->k; i++) { \
            const int* own = x->own + i * LANE_LIST; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) \
                LAVENDER_UP(k, own) push[k] += jac[r * n + k] * lam[r]; \
        } \
        solve_mass_##N(x, push); \
        for (int i = 0; i < x->k; i++) { \
            const int* own = x->own + i * LANE_LIST; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) { \
                V s = zero; \
                LAVENDER_UP(k, own) s += jac[r * n + k] * push[k]; \
                w[r] = s + (soft[r] * lam[r] - b[r]); \
                good &= (I)(abs_##N(w[r]) <= 1.7976931348623157e308) & (I)(abs_##N(lam[r]) <= 1e60); \
            } \
        } \
        errors_##N(x, lam, w, e, &energy, &fast, &worst); \
        good &= (I)(energy < 1e300) & (I)(fast < 1e300); \
        out[LANE_ENERGY] = root_##N(energy); \
        out[LANE_SPEED] = pick_##N((I)(fast > 0.0), root_##N(larger_##N(fast, zero)), zero); \
        out[LANE_WORST] = worst; \
        /* rounding: |Y| |Y|^T |lam| + soft |lam| and |b| (judge/forms.pxd, add_block_floor of judge/tally.pxd) */ \
        for (int i = 0; i < x->k; i++) { \
            const int* own = x->own + i * LANE_LIST; \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) \
                LAVENDER_UP(k, own) size[k] += abs_##N(y[r * n + k] * lam[r]); \
        } \
        energy = fast = zero; \
        for (int i = 0; i < x->k; i++) { \
            const int end = x->ptr[i + 1], *own = x->own + i * LANE_LIST; \
            V terms[LANE_ROWS], rounding, t; \
            int r = x->ptr[i]; \
            for (int j = r; j < end; j++) { \
                V s = zero; \
                LAVENDER_UP(k, own) s += abs_##N(y[j * n + k]) * size[k]; \
                terms[j - r] = s + soft[j] * abs_##N(lam[j]); \
            } \
            for (int j = r; !x->kind[i] && j < end; j++) { \
                rounding = unit * (terms[j - r] + abs_##N(b[j])); \
                const I none = ((I)(lam[j] == lower[j]) & (I)(w[j] > rounding)) \
                    | ((I)(lam[j] == upper[j]) & (I)(-w[j] > rounding)); \
                rounding = pick_##N(none, zero, rounding); \
                t = rounding / d[j]; \
                energy += t * rounding; \
                t = d[j] * t * rounding; \
                fast = larger_##N(t, fast); \
            } \
            if (!x->kind[i]) continue; \
            V gap = w[r]; \
            I none = (I)(lam[r] == 0.0) & (I)(lam[r + 1] == 0.0) & (I)(lam[r + 2] == 0.0); \
            rounding = unit * (terms[0] + abs_##N(b[r])); \
            if (x->law) { \
                gap -= mu[i] * root_##N(w[r + 1] * w[r + 1] + w[r + 2] * w[r + 2]); \
                for (int j = 1; j < 3; j++) rounding += mu[i] * (unit * (terms[j] + abs_##N(b[r + j]))); \
            } \
            none &= (I)(gap > rounding); \
            for (int j = 0; j < 3; j++) { \
                V s = terms[j]; \
                if (j) { \
                    const V own = d[r + j] * abs_##N(lam[r + j]); \
                    s = pick_##N((I)(e[r + j] != w[r + j] / d[r + j]) & (I)(own > s), own, s); \
                } \
                rounding = unit * (s + abs_##N(b[r + j])); \
                t = rounding / d[r + j]; \
                energy += pick_##N(none, zero, t * rounding); \
                t = d[r + j] * t * rounding; \
                fast = pick_##N(none, fast, larger_##N(t, fast)); \
            } \
        } \
        out[LANE_FLOOR_ENERGY] = root_##N(energy); \
        out[LANE_FLOOR_SPEED] = root_##N(fast); \
        /* `estimate_factor_loss` in two sums, an odd last row in the first */ \
        for (int i = 0; i < x->k; i++) { \
            const I real = (I)(((const V*)x->real)[i] > 0.0); \
            for (int r = x->ptr[i]; r < x->ptr[i + 1]; r++) { \
                const V work = lam[r] * (w[r] + (b[r] - soft[r] * lam[r])); \
                sum[0] += pick_##N(odd, zero, work); \
                sum[1] += pick_##N(odd, work, zero); \
                odd ^= real; \
                heaviest = larger_##N(d[r], heaviest); \
            } \
        } \
        out[LANE_WORK] = sum[0] + sum[1]; \
        out[LANE_HEAVIEST] = heaviest; \
        out[LANE_IS_PLAIN] = pick_##N(good, one, zero); \
    }
    #if defined(__clang__)
    #define LAVENDER_APART _Pragma("clang loop vectorize(assume_safety)")
    #elif defined(__GNUC__)
    #define LAVENDER_APART _Pragma("GCC ivdep")
    #else
    #define LAVENDER_APART
    #endif
    #define LAVENDER_CHOOSE(V, I, mask, a, b) ((mask) ? (a) : (b))
    #define LAVENDER_FABS(V, I, a) fabs(a)
    #define LAVENDER_ONE(N, ISA) LAVENDER_SOLVER(N, double, long long, ISA, sqrt(a), LAVENDER_CHOOSE, LAVENDER_FABS, mask != 0)
    LAVENDER_ONE(1, )
    #if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
    #define LAVENDER_PICK(V, I, mask, a, b) (V)(((mask) & (I)(a)) | (~(mask) & (I)(b)))
    #define LAVENDER_ABS(V, I, a) (V)((I)(a) & 0x7FFFFFFFFFFFFFFFLL)
    #define LAVENDER_VECTOR(N, V, I)                                                        \
        typedef double V __attribute__((vector_size(8 * N), aligned(8), may_alias));         \
        typedef long long I __attribute__((vector_size(8 * N), aligned(8), may_alias));
    LAVENDER_VECTOR(2, lanes_2, mask_2)
    #ifdef __x86_64__
    #include <immintrin.h>
    #define LAVENDER_AVX2 __attribute__((target("avx2")))
    #define LAVENDER_AVX512 __attribute__((target("avx512f,avx512dq,avx512vl,prefer-vector-width=512")))
    LAVENDER_VECTOR(4, lanes_4, mask_4)
    LAVENDER_VECTOR(8, lanes_8, mask_8)
    LAVENDER_SOLVER(2, lanes_2, mask_2, , (lanes_2)_mm_sqrt_pd((__m128d)a), LAVENDER_PICK, LAVENDER_ABS,
                    _mm_movemask_pd((__m128d)mask) != 0)
    LAVENDER_SOLVER(4, lanes_4, mask_4, LAVENDER_AVX2, (lanes_4)_mm256_sqrt_pd((__m256d)a), LAVENDER_PICK, LAVENDER_ABS,
                    _mm256_movemask_pd((__m256d)mask) != 0)
    LAVENDER_SOLVER(8, lanes_8, mask_8, LAVENDER_AVX512, (lanes_8)_mm512_sqrt_pd((__m512d)a), LAVENDER_PICK, LAVENDER_ABS,
                    _mm512_movepi64_mask((__m512i)mask) != 0)
    LAVENDER_LANES(2, lanes_2, mask_2, )
    LAVENDER_LANES(4, lanes_4, mask_4, LAVENDER_AVX2)
    LAVENDER_LANES(8, lanes_8, mask_8, LAVENDER_AVX512)
    LAVENDER_ONE(1_avx2, LAVENDER_AVX2)
    #define lavender_solve_one(x, wide) ((wide) ? solve_1_avx2(x) : solve_1(x))
    #define LAVENDER_IN_LANES(width, name, arguments) \
        ((width) == 8 ? name##_8 arguments : (width) == 4 ? name##_4 arguments : name##_2 arguments)
    #else
    LAVENDER_SOLVER(2, lanes_2, mask_2, , ((lanes_2){sqrt(a[0]), sqrt(a[1])}), LAVENDER_PICK, LAVENDER_ABS,
                    (mask[0] | mask[1]) != 0)
    LAVENDER_LANES(2, lanes_2, mask_2, )
    #define lavender_solve_one(x, wide) solve_1(x)
    #define LAVENDER_IN_LANES(width, name, arguments) name##_2 arguments
    #endif
    #define LAVENDER_FEWEST_LANES 2
    #else
    LAVENDER_LANES(1, double, long long, )
    #define lavender_solve_one(x, wide) solve_1(x)
    #define LAVENDER_IN_LANES(width, name, arguments) name##_1 arguments
    #define LAVENDER_FEWEST_LANES 1
    #endif
    #define lavender_prepare_lanes(x, width) LAVENDER_IN_LANES(width, prepare, (x))
    #define lavender_solve_lanes(x, width) LAVENDER_IN_LANES(width, solve, (x))
    #define lavender_judge_lanes(x, width) LAVENDER_IN_LANES(width, judge, (x))
    #define lavender_interleave(from, narrow, n, at, to, width) LAVENDER_IN_LANES(width, interleave, (from, narrow, n, at, to))
    """
    ctypedef struct lanes_t "lavender_lanes_t":
        int32_t m, n, law, k
        const int32_t *ptr, *kind
        double asymmetry
        double *jac, *mass, *free, *target, *soft, *mu, *lower, *upper
        double *real
        double *inverse, *root, *y, *d, *b, *zero, *w, *e, *lam, *push, *size, *out
        double *a, *g, *step, *change, *kept
        double tol
        uint64_t *fours, *last
        int32_t *left, *own
    enum:
        LANE_IS_PLAIN, LANE_START_ENERGY, LANE_START_SPEED, LANE_RHS, LANE_CONDITION, LANE_ENERGY, LANE_SPEED, LANE_WORST
        LANE_FLOOR_ENERGY, LANE_FLOOR_SPEED, LANE_WORK, LANE_HEAVIEST, LANE_STEPS, LANE_COUNT, LANE_NUMBERS
        MAX_LANE_ROWS "LANE_ROWS"
        MAX_LANE_VELOCITIES "LANE_VELOCITIES"
        LANE_LIST, LANE_TRIANGLE
        FEWEST_LANES "LAVENDER_FEWEST_LANES"
    void list_lane_columns "lavender_list_columns"(uint64_t set, int32_t* out) noexcept nogil
    void prepare_lanes "lavender_prepare_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void solve_lanes "lavender_solve_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void solve_one "lavender_solve_one"(const lanes_t* x, int32_t wide) noexcept nogil
    void judge_lanes "lavender_judge_lanes"(const lanes_t* x, int32_t width) noexcept nogil
    void interleave "lavender_interleave"(const void** x, int32_t narrow, int32_t n, const int32_t* at, double* out,
                                          int32_t width) noexcept nogil


cdef enum:
    MAX_LANES = 8


cdef inline int32_t count_lanes() noexcept nogil:
    """Return the number of lanes of this processor's widest instructions."""
    return 8 if has_wide() == 2 else 4 if has_wide() == 1 else FEWEST_LANES


cdef inline bint fits_lanes(const blocks_t* p, int32_t i) noexcept nogil:
    """Return whether block i is a set of bounded rows, or a contact of three rows without further coefficients."""
    return ((has_independent_rows(p, i) or is_disk_friction_contact(p, i))
            and p.patch_radius[i] == 0.0 and p.rolling[i] == 0.0)


cdef struct lane_rows_t:        # places of the worlds of a group in its lanes
    int32_t rows[MAX_LANES]     # number of rows of each world
    int32_t row[MAX_LANE_ROWS * MAX_LANES]      # row of each world that a row of the lanes holds; -1: none
    int32_t block[MAX_LANE_ROWS * MAX_LANES]
    int32_t ptr[MAX_LANE_ROWS + 1]              # blocks of the lanes
    int32_t kind[MAX_LANE_ROWS]


cdef inline int32_t kind_of_block(const blocks_t* p, int32_t i) noexcept nogil:
    """Return a number that is equal for blocks that lanes process alike, smaller for fewer rows."""
    return 2 * (p.ptr[i + 1] - p.ptr[i]) + (p.kind[i] != ROW)


cdef inline int64_t compute_structure_key(const worlds_t* w, int64_t i, int64_t* order) noexcept nogil:
    """Return a number that is equal for worlds that may share a group, and their order; 0 if lanes do not cover world i.

    Worlds with single bounded rows and contacts share groups, others only with equal sizes and kinds of blocks. The order is
    by contacts, bounded rows that follow contacts, and other rows, upwards and downwards in turn.
    """
    cdef const int64_t* at = w.at + i * PLACES
    cdef uint64_t key = 64 * <uint64_t>at[ROWS] + <uint64_t>at[VELOCITIES]
    cdef int32_t k, kind, j = <int32_t>at[BLOCK], contacts = 0, before = 0, after = 0
    order[0] = 0
    if not (0 < at[ROWS] <= MAX_LANE_ROWS and 0 < at[VELOCITIES] <= MAX_LANE_VELOCITIES):
        return 0
    for k in range(j, j + <int32_t>at[BLOCKS]):
        if not fits_lanes(&w.blocks, k):
            return 0
        kind = kind_of_block(&w.blocks, k)
        contacts, before, after = contacts + kind % 2, before + (contacts + kind % 2 == 0), after + (contacts > 0 and kind % 2 == 0)
        key = (key ^ <uint64_t>kind) * <uint64_t>0x100000001B3U         # FNV-1a
    if 3 * contacts + before + after < at[ROWS]:
        return <int64_t>(key | 1)
    order[0] = (contacts * MAX_LANE_ROWS + after) * 2 * MAX_LANE_ROWS
    order[0] += MAX_LANE_ROWS - before if (contacts + after) % 2 else before
    return 2 * at[VELOCITIES]


cdef inline bint arrange_lanes(const worlds_t* w, const int64_t* worlds, int32_t n_worlds, int32_t width, lanes_t* x,
                               lane_rows_t* p) noexcept nogil:
    """Find rows and blocks of lanes that hold every world's (n_worlds) in its order, the smallest first.

    Returns whether lanes take less time than single worlds: the time grows with (rows + 8)^2, and half a group takes as long
    alone. Further lanes hold the first world again.
    """
    cdef const int64_t* at[MAX_LANES]
    cdef int32_t next_block[MAX_LANES]
    cdef int32_t next_row[MAX_LANES]
    cdef int32_t lane, r, kind, own, least
    cdef int64_t order, work = 0
    if n_worlds < 2 or compute_structure_key(w, worlds[0], &order) == 0:
        return False
    for lane in range(width):
        at[lane] = w.at + PLACES * worlds[lane if lane < n_worlds else 0]
        p.rows[lane], next_block[lane], next_row[lane] = <int32_t>at[lane][ROWS], 0, 0
        work += (p.rows[lane] + 8) * (p.rows[lane] + 8) if lane < n_worlds else 0
        if at[lane][VELOCITIES] != at[0][VELOCITIES]:
            return False
    x.n, x.law, x.k, x.m, x.ptr, x.kind, p.ptr[0] = <int32_t>at[0][VELOCITIES], w.blocks.law, 0, 0, p.ptr, p.kind, 0
    while True:
        least = 2 * MAX_LANE_ROWS + 2
        for lane in range(width):
            if next_block[lane] < at[lane][BLOCKS]:
                least = min(least, kind_of_block(&w.blocks, <int32_t>at[lane][BLOCK] + next_block[lane]))
        if x.m + least // 2 > MAX_LANE_ROWS:            # no block is left, or too many rows
            return least == 2 * MAX_LANE_ROWS + 2 and 2 * work > width * (x.m + 8) * (x.m + 8)
        for lane in range(width):
            own = next_block[lane]
            kind = kind_of_block(&w.blocks, <int32_t>at[lane][BLOCK] + own) if own < at[lane][BLOCKS] else -1
            p.block[x.k * width + lane] = own if kind == least else -1
            for r in range(least // 2):
                p.row[(x.m + r) * width + lane] = next_row[lane] + r if kind == least else -1
            if kind == least:
                next_block[lane], next_row[lane] = own + 1, next_row[lane] + least // 2
        p.kind[x.k] = least % 2
        x.k, x.m = x.k + 1, x.m + least // 2
        p.ptr[x.k] = x.m


cdef inline void list_lane_blocks(const blocks_t* p, lanes_t* x, int32_t* ptr, int32_t* kind) noexcept nogil:
    """Write the x.k blocks of a problem to ptr (k + 1) and kind (k) of lanes."""
    cdef int32_t i
    x.ptr, x.kind, ptr[0] = ptr, kind, 0
    for i in range(x.k):
        ptr[i + 1] = p.ptr[i + 1]
        kind[i] = 0 if has_independent_rows(p, i) else 1


cdef inline int64_t bind_lanes(lanes_t* x, int32_t width, double* memory) noexcept nogil:
    """Take the arrays of lanes of m rows and n velocities from memory; return the number of doubles."""
    cdef int64_t m = x.m, n = x.n, at = 0, places = m + 3 & ~3
    cdef double*** array = [&x.jac, &x.mass, &x.y, &x.free, &x.inverse, &x.root, &x.push, &x.size, &x.target, &x.soft,
                            &x.lower, &x.upper, &x.d, &x.b, &x.zero, &x.w, &x.e, &x.lam, &x.step, &x.change, &x.kept, &x.mu,
                            &x.out, &x.a, &x.g, <double**>&x.fours, <double**>&x.last, <double**>&x.left, <double**>&x.own,
                            &x.real]
    cdef int64_t* count = [m * n, n * n, m * n, n, n, n, n, n, m, m, m, m, m, m, m, places, m, m, m, m, m, m,
                           LANE_NUMBERS, places * m, places * max(m, n), m, m, n * LANE_LIST, m * LANE_LIST, m]
    cdef int32_t i
    for i in range(30):
        array[i][0] = memory + at if memory != NULL else NULL
        at += width * count[i]
    return at


cdef inline double read_number(const worlds_t* w, int32_t which, int64_t i) noexcept nogil:
    """Return a number of an array of all worlds."""
    return (<const float*>w.array[which])[i] if w.narrow[which] else (<const double*>w.array[which])[i]


cdef inline void load_lanes(const lanes_t* x, const lane_rows_t* p, const worlds_t* w, const double* lam, const int64_t* worlds,
                            int32_t n_worlds, int32_t width) noexcept nogil:
    """Load worlds (n_worlds) and their impulses to the lanes; further lanes receive the first world again."""
    cdef const int64_t* at[MAX_LANES]
    cdef const void* line[MAX_LANES]
    cdef double zero[MAX_LANE_VELOCITIES]
    cdef int32_t place[MAX_LANE_VELOCITIES]
    cdef int32_t place_in_mass[LANE_TRIANGLE]
    cdef const int32_t* in_mass = place
    cdef int32_t i, k, own, lane, n = x.n
    cdef int64_t j, stride, here
    memset(zero, 0, sizeof(zero))
    for i in range(n):
        place[i] = i
    for lane in range(width):
        at[lane] = w.at + PLACES * worlds[lane if lane < n_worlds else 0]
        x.out[LANE_COUNT * width + lane] = p.rows[lane]
    # M and v*
    for lane in range(width):
        line[lane] = <const char*>w.array[2] + (4 if w.narrow[2] else 8) * at[lane][FREE]
    interleave(line, w.narrow[2], n, place, x.free, width)
    stride = w.mass_row if w.mass_row else n
    if w.mass_ptr != NULL:
        in_mass = place_in_mass
        memset(x.mass, 0, <int64_t>n * n * width * sizeof(double))
        for i in range(n):
            for k in range(w.mass_ptr[i], w.mass_ptr[i + 1]):
                place_in_mass[k] = i * n + w.mass_col[k]
    for i in range(1 if w.mass_ptr != NULL else n):
        for lane in range(width):
            line[lane] = <const char*>w.array[1] + (4 if w.narrow[1] else 8) * (at[lane][MASS] + i * stride)
        interleave(line, w.narrow[1], w.mass_ptr[n] if w.mass_ptr != NULL else n, in_mass,
                   x.mass + <int64_t>i * n * width, width)
    # Fill the rows and blocks. An empty row has a tiny d, so that the largest d of a lane is never that of an empty row.
    stride = w.jac_row_stride if w.jac_row_stride else n
    for i in range(x.m):
        for lane in range(width):
            j = i * width + lane
            own = p.row[j]
            line[lane] = zero
            x.target[j] = x.lower[j] = x.upper[j] = x.lam[j] = 0.0
            x.soft[j] = 1e-60
            if own >= 0:
                line[lane] = <const char*>w.array[0] + (4 if w.narrow[0] else 8) * (at[lane][JAC] + own * stride)
                x.target[j], x.soft[j] = read_number(w, 3, at[lane][TARGET] + own), read_number(w, 4, at[lane][SOFT] + own)
                here = at[lane][CONE_ROW] + own
                x.lower[j], x.upper[j], x.lam[j] = w.blocks.lower[here], w.blocks.upper[here], lam[at[lane][AT_ROW] + own]
        interleave(line, w.narrow[0], n, place, x.jac + <int64_t>i * n * width, width)
    for i in range(x.k):
        for lane in range(width):
            j = i * width + lane
            own = p.block[j]
            x.real[j], x.mu[j] = own >= 0, 0.0
            if own >= 0:
                x.mu[j] = w.blocks.mu[at[lane][BLOCK] + own] if w.array[5] == NULL else read_number(w, 5, at[lane][MU] + own)


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
    return not size * lane_number(x, LANE_CONDITION, width, lane) <= 0.1 * max(min(tol, strictest), min(relative, strictest))


cdef inline bint is_solved_in_one_lane(const blocks_t* p, const generalized_t* g, const double* zero_residual) noexcept nogil:
    """Return whether a problem is of the kind that lanes solve: `fits_lanes`, one island, 0 within bounds and not a solution."""
    cdef int32_t i, k
    if not (0 < p.n_rows <= MAX_LANE_ROWS and g.n <= MAX_LANE_VELOCITIES and p.islands == NULL and zero_residual[2] == 1.0):
        return False
    for i in range(p.n_blocks):
        if not fits_lanes(p, i):
            return False
        for k in range(p.ptr[i], p.ptr[i + 1] if has_independent_rows(p, i) else p.ptr[i]):
            if not p.lower[k] <= 0.0 <= p.upper[k]:
                return False
    return True


cdef inline int32_t solve_in_one_lane(const blocks_t* p, const generalized_t* g, const double* zero_residual, double tol,
                                      workspace_t* workspace, double* lam) noexcept nogil:
    """Solve from the zero impulse, with the bits of a lane, into lam (m); return the Newton steps, -1 without memory."""
    cdef lanes_t x
    cdef int32_t i, r, a, nc
    cdef uint64_t columns
    cdef int32_t ptr[MAX_LANE_ROWS + 1]
    cdef int32_t kind[MAX_LANE_ROWS]
    cdef const double* y
    x.m, x.n, x.law, x.tol, x.k = p.n_rows, g.n, p.law, tol, p.n_blocks
    if not grow_workspace_to(workspace, 0, bind_lanes(&x, 1, NULL)):
        return -1
    bind_lanes(&x, 1, workspace.real)
    list_lane_blocks(p, &x, ptr, kind)
    memset(x.y, 0, <int64_t>x.m * x.n * sizeof(double))
    for i in range(g.n_panels):
        nc = g.pcol[i + 1] - g.pcol[i]
        for r in range(g.prow[i], g.prow[i + 1]):
            y = g.y + g.pval[i] + <int64_t>(r - g.prow[i]) * nc
            for a in range(nc):
                x.y[r * x.n + g.cols[g.pcol[i] + a]] = y[a]
    for i in range(x.k):
        columns = 0
        for a in range(g.pcol[g.home[i]], g.pcol[g.home[i] + 1]):
            columns |= <uint64_t>1 << g.cols[a]
        list_lane_columns(columns, x.own + i * LANE_LIST)
    x.b, x.d, x.soft, x.mu = <double*>p.b, <double*>p.d, <double*>g.compliance, <double*>p.mu
    x.lower, x.upper = <double*>p.lower, <double*>p.upper
    x.out[LANE_IS_PLAIN], x.out[LANE_START_ENERGY], x.out[LANE_START_SPEED] = 1.0, zero_residual[0], zero_residual[1]
    x.out[LANE_STEPS], x.out[LANE_COUNT], x.lam = 0.0, x.m, lam
    solve_one(&x, has_wide())
    return <int32_t>x.out[LANE_STEPS]
