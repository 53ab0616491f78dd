/* Rows and sweeps of contacts, four manifolds at a time, with the bits of single contacts; see manifolds.pxd.
 *
 * A manifold is up to four successive contacts of an order between the same bodies, with one normal, tangent and friction
 * coefficient. Manifolds of a group share no moving body: each is one lane of a vector of four doubles. AVX2 is chosen at run
 * time; without it the compiler makes two vectors of two doubles. No operation mixes lanes, and there is no fused multiply-add. */
#ifndef LAVENDER_MANIFOLDS_H
#define LAVENDER_MANIFOLDS_H
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

typedef struct {                        /* contacts with a normal and two tangents each, in an order; arrays as in rows_t */
    int32_t n, n_bodies;
    const int32_t *order, *body;
    const double *mu, *normal, *tangent, *arm_a, *arm_b, *inv_mass, *inv_inertia;
    const int32_t* pair;                /* (n, 2) bodies that restitution is numbered by */
    const double* restitution;          /* NULL: none */
    double *impulse, *gap;              /* (n, 3) N s, (n) m */
    double *b, *target, *d, *step, *coupling, *inv_inertia_arm;     /* rows that `lavender_store_manifolds` writes */
} lavender_contacts;

typedef struct {                        /* what a pass over the groups needs besides them, and what it finds */
    double h, beta, slop, bounce, max_push;                     /* see engine/contacts.pxd and engine/projection.pxd */
    int warm;
    const double* before;               /* (bodies + 2, 8) velocities before the substep, or NULL */
    double* wrench;                     /* (bodies + 2, 8) receives J^T lam, or NULL */
    double most;                        /* largest depth [m], required shift or part of it that is missing */
    int finite, due;
} lavender_targets;

#if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
#define LAVENDER_HAS_MANIFOLDS 1
#define LAVENDER_INLINE_FOUR static inline __attribute__((always_inline))
typedef double lavender_four __attribute__((vector_size(32), may_alias));
typedef long long lavender_four_bits __attribute__((vector_size(32), may_alias));
#define LAVENDER_PICK_FOUR(mask, a, b) \
    (lavender_four)(((mask) & (lavender_four_bits)(a)) | (~(mask) & (lavender_four_bits)(b)))
#define LAVENDER_DOT_FOUR(x, y) ((x)[0] * (y)[0] + (x)[1] * (y)[1] + (x)[2] * (y)[2])

typedef struct {
    lavender_four arm_a[3], arm_b[3];
} lavender_point;

typedef struct {                        /* apart from the points, because only sweeps read them */
    lavender_four step[2], coupling[2], inv_inertia_arm[18];
} lavender_rows;

typedef struct {
    int32_t read_a[4], read_b[4], write_a[4], write_b[4];   /* offsets of the velocities of each lane's bodies */
    int32_t contact[4][4];              /* offset of the impulses of point and lane */
    int32_t count[4];                   /* points of each lane, 0 of an empty one */
    int32_t n, n_all;                   /* points of the longest and of the shortest lane */
    int32_t first_row, unused;          /* rows of its first point */
    lavender_four axis[9], inv_mass_a, inv_mass_b, mu, bounce;  /* axis: normal, both tangents */
    lavender_point point[];             /* (n) */
} lavender_group;

typedef struct {
    int32_t n_groups, n_sweeps;         /* groups of a sweep; sweeps that one pass over them makes */
    int32_t n_once;                     /* groups with each manifold once: the same groups if n_sweeps is 1 */
    int32_t along;                      /* 1: they have the contacts as numbered, -1: backwards, 0: neither */
    size_t *start, *start_once;         /* bytes */
    char* groups;
    lavender_rows* rows;
    double *x, *v, *free, *before;      /* (contacts + 1, 8) as `relax` tells; (bodies + 2, 8) velocities */
    lavender_four* own;                 /* (rows, 8) the same in lanes, or NULL: groups of several sweeps share a contact */
    int32_t* own_at;                    /* (contacts) offset of the first number of each contact in own */
    lavender_four* push;                /* (rows, 4) required shift, multiplier and step of the position projection */
    double *d, *inverse;                /* (contacts + 1, 2) 1/kg; (bodies + 1, 12) inverse inertia */
    void* place[11];                     /* allocated memory, and its sizes in bytes */
    size_t size[11];
} lavender_manifolds;

enum {
    LAVENDER_SWEEP, LAVENDER_ROWS, LAVENDER_REFRESH, LAVENDER_FOLLOW, LAVENDER_CHECK, LAVENDER_AIM, LAVENDER_PROJECT, LAVENDER_MISS
};
#define LAVENDER_HAS_POINT(g, k) \
    (lavender_four_bits) { -(g->count[0] > k), -(g->count[1] > k), -(g->count[2] > k), -(g->count[3] > k) }

/* Return memory number k of `size` bytes at a multiple of 64, or NULL; it keeps its content only while it is large enough. */
static void* lavender_reserve(lavender_manifolds* m, int k, size_t size) {
    if (size <= m->size[k]) return m->place[k];
    free(m->place[k]);
    m->place[k] = NULL;
    m->size[k] = 0;
    size += size / 2;
    if (posix_memalign(&m->place[k], 64, size)) return m->place[k] = NULL;
    m->size[k] = size;
    return m->place[k];
}

static void lavender_free_manifolds(lavender_manifolds* m) {
    for (int k = 0; k < 11; k++) free(m->place[k]);
    memset(m, 0, sizeof *m);
}

#define FOUR(f) lavender_##f##_plain
#define ISA
#define LOAD_TWO(a, b, c, d, out) \
    for (int k_ = 0; k_ < 2; k_++) (out)[k_] = (lavender_four){(a)[k_], (b)[k_], (c)[k_], (d)[k_]}
#define LOAD_FOUR(a, b, c, d, out) \
    for (int k_ = 0; k_ < 4; k_++) (out)[k_] = (lavender_four){(a)[k_], (b)[k_], (c)[k_], (d)[k_]}
#define STORE_TWO(a, b, c, d, in) \
    for (int k_ = 0; k_ < 2; k_++) (a)[k_] = (in)[k_][0], (b)[k_] = (in)[k_][1], (c)[k_] = (in)[k_][2], (d)[k_] = (in)[k_][3]
#define STORE_FOUR(a, b, c, d, in) \
    for (int k_ = 0; k_ < 4; k_++) (a)[k_] = (in)[k_][0], (b)[k_] = (in)[k_][1], (c)[k_] = (in)[k_][2], (d)[k_] = (in)[k_][3]
#define ROOT(x) ((lavender_four){sqrt((x)[0]), sqrt((x)[1]), sqrt((x)[2]), sqrt((x)[3])})
#define ANY(mask) (((mask)[0] | (mask)[1] | (mask)[2] | (mask)[3]) != 0)
#include "manifolds_body.h"

#ifdef __x86_64__
#include <immintrin.h>
#define FOUR(f) lavender_##f##_avx2
#define ISA __attribute__((target("avx2")))
#define LOAD_FOUR(a, b, c, d, out) \
    do { \
        const __m256d a_ = _mm256_load_pd(a), b_ = _mm256_load_pd(b), c_ = _mm256_load_pd(c), d_ = _mm256_load_pd(d); \
        const __m256d p_ = _mm256_unpacklo_pd(a_, b_), q_ = _mm256_unpackhi_pd(a_, b_); \
        const __m256d r_ = _mm256_unpacklo_pd(c_, d_), s_ = _mm256_unpackhi_pd(c_, d_); \
        (out)[0] = (lavender_four)_mm256_permute2f128_pd(p_, r_, 0x20); \
        (out)[1] = (lavender_four)_mm256_permute2f128_pd(q_, s_, 0x20); \
        (out)[2] = (lavender_four)_mm256_permute2f128_pd(p_, r_, 0x31); \
        (out)[3] = (lavender_four)_mm256_permute2f128_pd(q_, s_, 0x31); \
    } while (0)
#define STORE_FOUR(a, b, c, d, in) \
    do { \
        const __m256d a_ = (__m256d)(in)[0], b_ = (__m256d)(in)[1], c_ = (__m256d)(in)[2], d_ = (__m256d)(in)[3]; \
        const __m256d p_ = _mm256_unpacklo_pd(a_, b_), q_ = _mm256_unpackhi_pd(a_, b_); \
        const __m256d r_ = _mm256_unpacklo_pd(c_, d_), s_ = _mm256_unpackhi_pd(c_, d_); \
        _mm256_store_pd(a, _mm256_permute2f128_pd(p_, r_, 0x20)); \
        _mm256_store_pd(b, _mm256_permute2f128_pd(q_, s_, 0x20)); \
        _mm256_store_pd(c, _mm256_permute2f128_pd(p_, r_, 0x31)); \
        _mm256_store_pd(d, _mm256_permute2f128_pd(q_, s_, 0x31)); \
    } while (0)
#define LOAD_TWO(a, b, c, d, out) \
    do { \
        const __m128d a_ = _mm_load_pd(a), b_ = _mm_load_pd(b), c_ = _mm_load_pd(c), d_ = _mm_load_pd(d); \
        (out)[0] = (lavender_four)_mm256_set_m128d(_mm_unpacklo_pd(c_, d_), _mm_unpacklo_pd(a_, b_)); \
        (out)[1] = (lavender_four)_mm256_set_m128d(_mm_unpackhi_pd(c_, d_), _mm_unpackhi_pd(a_, b_)); \
    } while (0)
#define STORE_TWO(a, b, c, d, in) \
    do { \
        const __m256d a_ = (__m256d)(in)[0], b_ = (__m256d)(in)[1]; \
        const __m256d p_ = _mm256_unpacklo_pd(a_, b_), q_ = _mm256_unpackhi_pd(a_, b_); \
        _mm_store_pd(a, _mm256_castpd256_pd128(p_)); \
        _mm_store_pd(b, _mm256_castpd256_pd128(q_)); \
        _mm_store_pd(c, _mm256_extractf128_pd(p_, 1)); \
        _mm_store_pd(d, _mm256_extractf128_pd(q_, 1)); \
    } while (0)
#define ROOT(x) ((lavender_four)_mm256_sqrt_pd((__m256d)(x)))
#define ANY(mask) (_mm256_movemask_pd((__m256d)(mask)) != 0)
#include "manifolds_body.h"
#define lavender_run_groups(wide, ...) ((wide) ? lavender_run_avx2(__VA_ARGS__) : lavender_run_plain(__VA_ARGS__))
static int lavender_has_avx2(void) { return __builtin_cpu_supports("avx2") != 0; }
#else
#define lavender_run_groups(wide, ...) lavender_run_plain(__VA_ARGS__)
static int lavender_has_avx2(void) { return 0; }
#endif

/* Write manifold `first` .. `first` + `count` of the order to a lane of a group, without its rows. */
static void lavender_fill_lane(const lavender_contacts* c, int32_t first, int32_t count, lavender_group* g, lavender_four* own,
                               int32_t* own_at, int lane) {
    const int32_t i = c->order[first], *body = c->body + 2 * i;
    const double *n = c->normal + 3 * i, *t = c->tangent + 3 * i;
    double* axis = (double*)g->axis + lane;
    g->read_a[lane] = 8 * (body[0] >= 0 ? body[0] : c->n_bodies);
    g->read_b[lane] = 8 * (body[1] >= 0 ? body[1] : c->n_bodies);
    g->write_a[lane] = 8 * (body[0] >= 0 ? body[0] : c->n_bodies + 1);
    g->write_b[lane] = 8 * (body[1] >= 0 ? body[1] : c->n_bodies + 1);
    g->count[lane] = count;
    for (int k = 0; k < 3; k++) {
        axis[4 * k] = n[k];
        axis[4 * (3 + k)] = t[k];
    }
    axis[4 * 6] = n[1] * t[2] - n[2] * t[1];
    axis[4 * 7] = n[2] * t[0] - n[0] * t[2];
    axis[4 * 8] = n[0] * t[1] - n[1] * t[0];
    axis[4 * 9] = body[0] >= 0 ? c->inv_mass[body[0]] : 0.0;
    axis[4 * 10] = body[1] >= 0 ? c->inv_mass[body[1]] : 0.0;
    axis[4 * 11] = c->mu[i];
    axis[4 * 12] = 0.0;
    if (c->restitution) {
        const double x = c->restitution[c->pair[2 * i]], y = c->restitution[c->pair[2 * i + 1]];
        axis[4 * 12] = x > y ? x : y;
    }
    for (int j = 0; j < count; j++) {
        const int32_t at = c->order[first + j];
        double* p = (double*)(g->point + j) + lane;
        g->contact[j][lane] = 8 * at;
        for (int q = 0; q < 3; q++) {
            p[4 * q] = c->arm_a[3 * at + q];
            p[4 * (3 + q)] = c->arm_b[3 * at + q];
        }
        if (!own) continue;
        own_at[at] = 32 * (g->first_row + j) + lane;
        p = (double*)(own + 8 * j) + lane;
        for (int q = 0; q < 3; q++) p[4 * q] = c->impulse[3 * at + q];
        p[4 * 3] = c->gap[at];
    }
}

/* Copy what a lane of a group has besides vectors to a lane of another one. */
static void lavender_copy_lane(const lavender_group* from, int i, lavender_group* to, int k) {
    to->read_a[k] = from->read_a[i];
    to->read_b[k] = from->read_b[i];
    to->write_a[k] = from->write_a[i];
    to->write_b[k] = from->write_b[i];
    to->count[k] = from->count[i];
    for (int j = 0; j < 4; j++) to->contact[j][k] = from->contact[j][i];
}

/* Write n vectors whose lanes begin at the four places. */
static void lavender_copy_vectors(const double* const* from, lavender_four* to, int n) {
    const double *a = from[0], *b = from[1], *c = from[2], *d = from[3];
    for (size_t q = 0; q < (size_t)n; q++) to[q] = (lavender_four){a[4 * q], b[4 * q], c[4 * q], d[4 * q]};
}

/* Open a group: all lanes are empty. An empty lane reads zeros, and nothing reads what it writes. */
static lavender_group* lavender_open_group(const lavender_contacts* c, char* place, int32_t first_row) {
    lavender_group* g = (lavender_group*)place;
    memset(g, 0, sizeof *g);
    g->first_row = first_row;
    for (int lane = 0; lane < 4; lane++) {
        g->read_a[lane] = g->read_b[lane] = 8 * c->n_bodies;
        g->write_a[lane] = g->write_b[lane] = 8 * (c->n_bodies + 1);
    }
    g->n_all = 4;
    return g;
}

/* Close a group, and return its size in bytes. Points that a lane does not have are zero and belong to contact n. */
static size_t lavender_close_group(const lavender_contacts* c, lavender_group* g, lavender_rows* rows, lavender_four* own) {
    for (int lane = 0; lane < 4; lane++) {
        if (g->count[lane] > g->n) g->n = g->count[lane];
        if (g->count[lane] && g->count[lane] < g->n_all) g->n_all = g->count[lane];
    }
    for (int lane = 0; lane < 4; lane++)
        for (int j = g->count[lane]; j < g->n; j++) {
            double* p = (double*)(g->point + j) + lane;
            for (int q = 0; q < 6; q++) p[4 * q] = 0.0;
            rows[j].step[0][lane] = rows[j].step[1][lane] = 0.0;    /* The impulse stays 0. */
            for (int q = 0; q < 8 && own; q++) ((double*)(own + 8 * j))[4 * q + lane] = 0.0;
            g->contact[j][lane] = 8 * c->n;
        }
    return sizeof *g + (size_t)g->n * sizeof *g->point;
}

/* Form manifolds, and write the place of the first contact of each to `first` (n + 1); return their number. */
static int32_t lavender_find_manifolds(const lavender_contacts* c, int32_t* first) {
    int32_t m = 0, before = -1;
    for (int32_t k = 0; k < c->n; k++) {
        const int32_t i = c->order[k], *body = c->body + 2 * i;
        if (!(before >= 0 && k - first[m - 1] < 4 && body[0] == c->body[2 * before] && body[1] == c->body[2 * before + 1]
              && !memcmp(c->normal + 3 * i, c->normal + 3 * before, 24)
              && !memcmp(c->tangent + 3 * i, c->tangent + 3 * before, 24) && c->mu[i] == c->mu[before])) first[m++] = k;
        before = i;
    }
    first[m] = c->n;
    return m;
}

/* Find a group for each of `count` manifolds in `sweeps` sweeps: the first with an empty lane after the groups of all earlier
 * updates of its bodies, or one soon after that in which all lanes have as many points. Return the number of groups.
 *
 * group, open, used, points (count sweeps); last (n_bodies) */
static int32_t lavender_schedule(const lavender_contacts* c, const int32_t* first, int32_t count, int32_t sweeps, int32_t* group,
                                 int32_t* open, int32_t* used, int32_t* points, int32_t* last) {
    int32_t n = 0;
    for (int32_t i = 0; i < c->n_bodies; i++) last[i] = -1;
    for (int32_t item = 0; item < count * sweeps; item++) {
        const int32_t k = item % count, *body = c->body + 2 * c->order[first[k]], size = first[k + 1] - first[k];
        int32_t g = -1, best = -1;
        for (int side = 0; side < 2; side++)
            if (body[side] >= 0 && last[body[side]] > g) g = last[body[side]];
        g++;
        for (int tries = 0; tries < 6; tries++, g++) {
            while (g < n && open[g] != g) g = open[g] = open[g] < n ? open[open[g]] : open[g];
            if (best < 0) best = g;
            if (g >= n) break;
            if (points[g] == size) {
                best = g;
                break;
            }
        }
        g = best;
        if (g >= n) {
            used[n] = 0;
            points[n] = size;
            open[n] = n;
            g = n++;
        }
        group[item] = g;
        if (++used[g] == 4) open[g] = g + 1;
        for (int side = 0; side < 2; side++)
            if (body[side] >= 0) last[body[side]] = g;
    }
    return n;
}

/* Pack the contacts of an order into groups whose passes make n_sweeps sweeps each, or one sweep; compute their rows, and load
 * impulses and gaps. Return 0 if a sweep would have fewer than `least` manifolds in a group on average, or without memory. */
static int lavender_pack_manifolds(const lavender_contacts* c, int wide, int32_t n_sweeps, double least, lavender_manifolds* m) {
    const size_t n = (size_t)c->n, n_bodies = (size_t)c->n_bodies, most = sizeof(lavender_group) + 4 * sizeof(lavender_point);
    size_t bytes = 0;
    int32_t* first = (int32_t*)lavender_reserve(m, 0, 4 * (n + 1 + n_bodies));
    if (!first) return 0;
    int32_t* last = first + n + 1;
    const int32_t count = lavender_find_manifolds(c, first);
    /* the group of each manifold; if one sweep fills few lanes, groups of several sweeps */
    int32_t* group = (int32_t*)lavender_reserve(m, 1, 4 * 5 * (size_t)count * (size_t)n_sweeps);
    if (!group) return 0;
    int32_t *open = group + count * n_sweeps, *used = open + count * n_sweeps, *points = used + count * n_sweeps;
    int32_t *sorted = points + count * n_sweeps, more = 0;
    m->n_sweeps = 1;
    m->n_groups = m->n_once = lavender_schedule(c, first, count, 1, group, open, used, points, last);
    if (n_sweeps > 1 && 2 * count < 7 * m->n_groups) {
        more = lavender_schedule(c, first, count, n_sweeps, group, open, used, points, last);
        if (5 * more < 4 * n_sweeps * m->n_groups) {
            m->n_sweeps = n_sweeps;
            m->n_groups = more;
            m->n_once = (count + 3) / 4;
        } else lavender_schedule(c, first, count, 1, group, open, used, points, last);
    }
    if (m->n_groups == 0 || (double)count * m->n_sweeps < least * m->n_groups) return 0;
    m->along = c->order[0] == 0 ? 1 : -1;
    for (int32_t k = 0; k < c->n && m->along; k++)
        if (c->order[k] != (m->along > 0 ? k : c->n - 1 - k)) m->along = 0;
    /* memory */
    const size_t every = (size_t)m->n_groups + (m->n_sweeps > 1 ? (size_t)m->n_once : 0);
    m->start = (size_t*)lavender_reserve(m, 2, sizeof(size_t) * every);
    m->groups = (char*)lavender_reserve(m, 3, most * every);
    m->own = NULL;
    const int has_own = m->n_sweeps == 1;
    m->x = (double*)lavender_reserve(m, 4, has_own ? 4 * every * 8 * sizeof(lavender_four) : 8 * 8 * (n + 1));
    m->v = (double*)lavender_reserve(m, 5, 3 * 8 * 8 * (n_bodies + 2));
    m->d = (double*)lavender_reserve(m, 6, 8 * 2 * (n + 1));
    m->inverse = (double*)lavender_reserve(m, 7, 8 * 12 * (n_bodies + 1));
    m->rows = (lavender_rows*)lavender_reserve(m, 8, 4 * every * sizeof(lavender_rows));
    m->push = (lavender_four*)lavender_reserve(m, 9, 16 * (size_t)m->n_once * sizeof(lavender_four));
    m->own_at = (int32_t*)lavender_reserve(m, 10, 4 * (n + 1));
    if (!(m->start && m->groups && m->x && m->v && m->d && m->inverse && m->rows && m->push && m->own_at)) return 0;
    m->start_once = m->n_sweeps > 1 ? m->start + m->n_groups : m->start;
    m->free = m->v + 8 * (n_bodies + 2);
    m->before = m->free + 8 * (n_bodies + 2);
    memset(m->v, 0, 3 * 8 * 8 * (n_bodies + 2));
    for (size_t i = 0; i < n_bodies; i++) {
        for (int k = 0; k < 9; k++) m->inverse[12 * i + (size_t)k] = c->inv_inertia[9 * i + (size_t)k];
        m->inverse[12 * i + 9] = m->inverse[12 * i + 10] = m->inverse[12 * i + 11] = 0.0;
    }
    memset(m->inverse + 12 * n_bodies, 0, 8 * 12);
    if (has_own) m->own = (lavender_four*)m->x;
    else memset(m->x + 8 * n, 0, 8 * 8);
    for (size_t i = 0; i < n && !has_own; i++) {
        for (int k = 0; k < 3; k++) m->x[8 * i + (size_t)k] = c->impulse[3 * i + (size_t)k];
        m->x[8 * i + 3] = c->gap[i];
    }
    /* Sort the updates by group: `used` becomes the end of each group. */
    for (int32_t k = 0, sum = 0; k < m->n_groups; k++) {
        sum += used[k];
        used[k] = sum - used[k];
    }
    for (int32_t item = 0; item < count * m->n_sweeps; item++) sorted[used[group[item]]++] = item % count;
    /* groups with every manifold once, by these groups or one after the other */
    int32_t row = 0;
    for (int32_t k = 0, i = 0; k < m->n_once; k++) {
        lavender_group* g = lavender_open_group(c, m->groups + bytes, row);
        lavender_four* own = m->own ? m->own + 8 * (size_t)row : NULL;
        const int32_t stop = m->n_sweeps == 1 ? used[k] : (i + 4 < count ? i + 4 : count);
        for (int lane = 0; i < stop; lane++, i++) {
            const int32_t at = m->n_sweeps == 1 ? sorted[i] : i;
            lavender_fill_lane(c, first[at], first[at + 1] - first[at], g, own, m->own_at, lane);
        }
        m->start_once[k] = bytes;
        bytes += lavender_close_group(c, g, m->rows + row, own);
        row += g->n;
    }
    lavender_run_groups(wide, m, LAVENDER_ROWS, 0, NULL);
    /* groups of several sweeps */
    for (int32_t k = 0, i = 0; k < m->n_groups && m->n_sweeps > 1; k++) {
        lavender_group* g = lavender_open_group(c, m->groups + bytes, row);
        const double *vectors[4], *rows[4];
        int points = 0;
        for (int lane = 0; lane < 4; lane++) {
            const int32_t at = sorted[i < used[k] ? i : i - 1];     /* An empty lane has the numbers of the one before it. */
            const lavender_group* from = (const lavender_group*)(m->groups + m->start_once[at / 4]);
            vectors[lane] = (const double*)from->axis + at % 4;
            rows[lane] = (const double*)(m->rows + from->first_row) + at % 4;
            if (i == used[k]) continue;
            lavender_copy_lane(from, at % 4, g, lane);
            if (g->count[lane] > points) points = g->count[lane];
            i++;
        }
        lavender_copy_vectors(vectors, g->axis, 13 + 6 * points);
        lavender_copy_vectors(rows, (lavender_four*)(m->rows + row), 22 * points);
        m->start[k] = bytes;
        bytes += lavender_close_group(c, g, m->rows + row, NULL);
        row += g->n;
    }
    return 1;
}

/* Return whether groups in their order, or backwards, visit the contacts as numbered. */
static int lavender_sweep_along(const lavender_manifolds* m) { return m->along && m->n_sweeps == 1; }

static void lavender_load_velocities(int32_t n, const double* from, double* to) {
    for (size_t i = 0; i < (size_t)n; i++)
        for (int k = 0; k < 6; k++) to[8 * i + (size_t)k] = from[6 * i + (size_t)k];
}

static void lavender_store_velocities(int32_t n, const double* from, double* to) {
    for (size_t i = 0; i < (size_t)n; i++)
        for (int k = 0; k < 6; k++) to[6 * i + (size_t)k] = from[8 * i + (size_t)k];
}

/* Compute the right-hand sides for the velocities `free` (n_bodies, 6) and those before the substep of all bodies, `before`, and
 * the velocities M^-1 J^T lam of the warm start: `compute_velocity_change` of core/velocity.pxd. */
static void lavender_refresh_manifolds(const lavender_contacts* c, lavender_manifolds* m, int wide, lavender_targets* t,
                                       const double* free, const double* before, const int32_t* body_of) {
    const int in_lanes = lavender_sweep_along(m);
    double *v = m->v, l[3];
    lavender_load_velocities(c->n_bodies, free, m->free);
    for (int32_t i = 0; c->restitution && i < c->n_bodies; i++)
        for (int k = 0; k < 6; k++) m->before[8 * i + k] = before[6 * body_of[i] + k];
    memset(v, 0, 64 * (size_t)(c->n_bodies + 2));
    t->before = c->restitution ? m->before : NULL;
    t->wrench = t->warm && in_lanes ? v : NULL;
    lavender_run_groups(wide, m, LAVENDER_REFRESH, m->along < 0, t);
    for (int32_t i = 0; i < c->n && t->warm && !in_lanes; i++) {
        const double *n = c->normal + 3 * i, *s = c->tangent + 3 * i;
        const double* x = m->own ? (const double*)m->own + m->own_at[i] : m->x + 8 * (size_t)i;
        const size_t next = m->own ? 4 : 1;
        const double u[3] = {n[1] * s[2] - n[2] * s[1], n[2] * s[0] - n[0] * s[2], n[0] * s[1] - n[1] * s[0]};
        double f[3];
        for (int k = 0; k < 3; k++) f[k] = (x[0] * n[k] + x[next] * s[k]) + x[2 * next] * u[k];
        for (int side = 0; side < 2; side++) {
            const int32_t body = c->body[2 * i + side];
            const double* r = (side ? c->arm_b : c->arm_a) + 3 * i;
            double* to = v + 8 * (size_t)(body >= 0 ? body : c->n_bodies + 1);
            l[0] = r[1] * f[2] - r[2] * f[1];
            l[1] = r[2] * f[0] - r[0] * f[2];
            l[2] = r[0] * f[1] - r[1] * f[0];
            for (int k = 0; k < 3; k++) {
                to[k] = side ? to[k] + f[k] : to[k] - f[k];
                to[3 + k] = side ? to[3 + k] + l[k] : to[3 + k] - l[k];
            }
        }
    }
    for (int32_t i = 0; i < c->n_bodies; i++, v += 8) {
        const double* inv = c->inv_inertia + 9 * i;
        for (int k = 0; k < 3; k++) {
            v[k] *= c->inv_mass[i];
            l[k] = v[3 + k];
        }
        for (int k = 0; k < 3; k++) v[3 + k] = inv[3 * k] * l[0] + inv[3 * k + 1] * l[1] + inv[3 * k + 2] * l[2];
    }
}

static void lavender_sweep_manifolds(lavender_manifolds* m, int wide, int32_t sweeps, int backwards) {
    for (int32_t s = 0; s < sweeps; s += m->n_sweeps) lavender_run_groups(wide, m, LAVENDER_SWEEP, backwards, NULL);
}

/* Let the gaps follow the displacement s (n_bodies, 6) of the bodies. */
static void lavender_follow_manifolds(const lavender_contacts* c, lavender_manifolds* m, int wide, const double* s) {
    lavender_load_velocities(c->n_bodies, s, m->free);
    lavender_run_groups(wide, m, LAVENDER_FOLLOW, 0, NULL);
}

/* Find the largest -gap, t->most, and whether all gaps and impulses are finite. */
static void lavender_check_manifolds(const lavender_manifolds* m, int wide, lavender_targets* t) {
    lavender_run_groups(wide, m, LAVENDER_CHECK, 0, t);
}

/* Compute the shift (n_bodies, 6) of the position projection for the velocities v_free + dv by `least` sweeps, or without slop by
 * up to `most`, over the contacts as numbered or from the last to the first. Return the number of sweeps; 0: there is no shift. */
static int32_t lavender_project_manifolds(const lavender_contacts* c, lavender_manifolds* m, int wide, lavender_targets* t,
                                          int32_t least, int32_t most, int last_first, const double* v_free, const double* dv,
                                          double* shift) {
    int32_t sweep = 0;
    lavender_load_velocities(c->n_bodies, v_free, m->free);
    for (size_t i = 0; i < (size_t)c->n_bodies; i++)
        for (size_t k = 0; k < 6; k++) m->free[8 * i + k] += dv[6 * i + k];
    lavender_run_groups(wide, m, LAVENDER_AIM, 0, t);
    if (!t->due) return 0;
    const double before = t->most;
    memset(m->v, 0, 64 * (size_t)(c->n_bodies + 2));
    do {
        if (sweep == most) return 0;
        lavender_run_groups(wide, m, LAVENDER_PROJECT, (m->along < 0) != last_first, t);
        if (++sweep >= least && t->slop == 0.0) lavender_run_groups(wide, m, LAVENDER_MISS, 0, t);
    } while (sweep < least || (t->slop == 0.0 && !(t->most <= before)));
    lavender_store_velocities(c->n_bodies, m->v, shift);
    return sweep;
}

/* Write impulses and gaps back; with `rows` also right-hand sides and rows, as single contacts have them. */
static void lavender_store_manifolds(const lavender_contacts* c, const lavender_manifolds* m, int rows) {
    for (int32_t k = 0; k < m->n_once; k++) {
        const lavender_group* g = (const lavender_group*)(m->groups + m->start_once[k]);
        for (int lane = 0; lane < 4; lane++)
            for (int j = 0; j < g->count[lane]; j++) {
                const size_t at = (size_t)g->first_row + (size_t)j, i = (size_t)g->contact[j][lane] / 8, next = m->own ? 4 : 1;
                const double* x = m->own ? (const double*)(m->own + 8 * at) + lane : m->x + 8 * i;
                const double* p = (const double*)(m->rows + at) + lane;
                for (size_t q = 0; q < 3; q++) c->impulse[3 * i + q] = x[next * q];
                c->gap[i] = x[next * 3];
                if (!rows) continue;
                for (size_t q = 0; q < 3; q++) {
                    c->b[3 * i + q] = 0.0 - x[next * (4 + q)];
                    c->target[3 * i + q] = q ? 0.0 : x[next * 7];
                    c->d[3 * i + q] = m->d[2 * i + (q > 0)];
                }
                c->step[3 * i] = p[4 * 0];
                c->step[3 * i + 1] = c->step[3 * i + 2] = p[4 * 1];
                for (size_t q = 0; q < 5; q++) c->coupling[5 * i + q] = q < 2 ? p[4 * (2 + q)] : 0.0;
                for (size_t q = 0; q < 18; q++)
                    c->inv_inertia_arm[18 * i + q] = c->body[2 * i + q / 3 % 2] >= 0 ? p[4 * (4 + q)] : 0.0;
            }
    }
}
#else
typedef struct {
    int32_t n_groups;
} lavender_manifolds;
#define LAVENDER_HAS_MANIFOLDS 0
#define lavender_has_avx2() 0
#define lavender_free_manifolds(m) ((void)(m))
#define lavender_pack_manifolds(c, wide, n_sweeps, least, m) ((void)(c), (void)(wide), (void)(n_sweeps), 0)
#define lavender_refresh_manifolds(c, m, wide, t, free, before, body_of) ((void)(c), (void)(t))
#define lavender_sweep_manifolds(m, wide, sweeps, backwards) ((void)(wide), (void)(sweeps), (void)(backwards))
#define lavender_follow_manifolds(c, m, wide, s) ((void)(c))
#define lavender_check_manifolds(m, wide, t) ((void)(wide), (void)(t))
#define lavender_sweep_along(m) 0
#define lavender_project_manifolds(c, m, wide, t, least, most, last_first, v_free, dv, shift) ((void)(last_first), 0)
#define lavender_store_manifolds(c, m, rows) ((void)(c), (void)(rows))
#define lavender_store_velocities(n, from, to) ((void)(n))
#endif
#endif
