/* Sweeps over contacts, four manifolds at a time, with the bits of a sweep over single contacts; see manifolds.pxd.
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
    const int32_t *order, *ptr, *body;
    const double *mu, *b, *step, *normal, *tangent, *arm_a, *arm_b, *inv_mass, *inv_inertia_arm, *coupling;
} lavender_contacts;

#if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
#define LAVENDER_HAS_MANIFOLDS 1
#define LAVENDER_INLINE_FOUR static inline __attribute__((always_inline))
typedef double lavender_four __attribute__((vector_size(32), may_alias));
typedef long long lavender_four_bits __attribute__((vector_size(32), may_alias));
#define LAVENDER_PICK_FOUR(mask, a, b) \
    (lavender_four)(((mask) & (lavender_four_bits)(a)) | (~(mask) & (lavender_four_bits)(b)))
#define LAVENDER_DOT_FOUR(x, y) ((x)[0] * (y)[0] + (x)[1] * (y)[1] + (x)[2] * (y)[2])

typedef struct {
    lavender_four arm_a[3], arm_b[3], step[2], coupling[2], inv_inertia_arm[18];
} lavender_point;

typedef struct {
    int32_t read_a[4], read_b[4], write_a[4], write_b[4];   /* offsets of the velocities of each lane's bodies */
    int32_t contact[4][4];              /* offset of the impulses of point and lane */
    int32_t count[4];                   /* points of each lane, 0 of an empty one */
    int32_t n, n_all, unused[2];        /* points of the longest and of the shortest lane */
    lavender_four normal[3], tangent1[3], tangent2[3], inv_mass_a, inv_mass_b, mu;
    lavender_point point[];             /* (n) */
} lavender_group;

typedef struct {
    int32_t n_groups, n_sweeps;         /* sweeps that one pass over the groups makes */
    size_t* start;                      /* (n_groups) bytes */
    char* groups;
    double *x, *v;                      /* (contacts + 1, 8) impulses and -b; (bodies + 2, 8) velocities */
    int32_t* scratch;
    size_t sizes[5];                    /* allocated bytes: start, groups, x, v, scratch */
} lavender_manifolds;

/* Make room for `size` bytes at a multiple of 64; the content is lost. Return 0 without memory. */
static int lavender_reserve(void** place, size_t* allocated, size_t size) {
    if (size <= *allocated) return 1;
    free(*place);
    *allocated = 0;
    *place = NULL;
    size += size / 2;
    if (posix_memalign(place, 64, size)) return 0;
    *allocated = size;
    return 1;
}

static void lavender_free_manifolds(lavender_manifolds* m) {
    free(m->start);
    free(m->groups);
    free(m->x);
    free(m->v);
    free(m->scratch);
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
#define lavender_sweep_groups(wide, ...) ((wide) ? lavender_sweep_avx2(__VA_ARGS__) : lavender_sweep_plain(__VA_ARGS__))
static int lavender_has_avx2(void) { return __builtin_cpu_supports("avx2") != 0; }
#else
#define lavender_sweep_groups(wide, ...) lavender_sweep_plain(__VA_ARGS__)
static int lavender_has_avx2(void) { return 0; }
#endif

/* Write manifold `first` .. `first` + `count` of the order to a lane of a group. */
static void lavender_fill_lane(const lavender_contacts* c, int32_t first, int32_t count, lavender_group* g, int lane) {
    const int32_t i = c->order[first], *body = c->body + 2 * i;
    const double *n = c->normal + 3 * i, *t = c->tangent + 3 * i;
    g->read_a[lane] = 8 * (body[0] >= 0 ? body[0] : c->n_bodies);
    g->read_b[lane] = 8 * (body[1] >= 0 ? body[1] : c->n_bodies);
    g->write_a[lane] = 8 * (body[0] >= 0 ? body[0] : c->n_bodies + 1);
    g->write_b[lane] = 8 * (body[1] >= 0 ? body[1] : c->n_bodies + 1);
    g->count[lane] = count;
    for (int k = 0; k < 3; k++) {
        g->normal[k][lane] = n[k];
        g->tangent1[k][lane] = t[k];
    }
    g->tangent2[0][lane] = n[1] * t[2] - n[2] * t[1];
    g->tangent2[1][lane] = n[2] * t[0] - n[0] * t[2];
    g->tangent2[2][lane] = n[0] * t[1] - n[1] * t[0];
    g->inv_mass_a[lane] = body[0] >= 0 ? c->inv_mass[body[0]] : 0.0;
    g->inv_mass_b[lane] = body[1] >= 0 ? c->inv_mass[body[1]] : 0.0;
    g->mu[lane] = c->mu[i];
    for (int j = 0; j < count; j++) {
        const int32_t at = c->order[first + j], row = c->ptr[at];
        double* p = (double*)(g->point + j) + lane;
        const double *ra = c->arm_a + 3 * at, *rb = c->arm_b + 3 * at, *k = c->inv_inertia_arm + 6 * (row - c->ptr[0]);
        g->contact[j][lane] = 8 * at;
        for (int q = 0; q < 3; q++) {
            p[4 * q] = ra[q];
            p[4 * (3 + q)] = rb[q];
        }
        p[4 * 6] = c->step[row];
        p[4 * 7] = c->step[row + 1];
        p[4 * 8] = c->coupling[5 * at];
        p[4 * 9] = c->coupling[5 * at + 1];
        for (int q = 0; q < 18; q++) p[4 * (10 + q)] = k[q];
    }
}

/* Let a lane be empty: it reads zeros, and nothing reads what it writes. */
static void lavender_empty_lane(const lavender_contacts* c, lavender_group* g, int lane) {
    double* x = (double*)g->normal + lane;
    g->read_a[lane] = g->read_b[lane] = 8 * c->n_bodies;
    g->write_a[lane] = g->write_b[lane] = 8 * (c->n_bodies + 1);
    g->count[lane] = 0;
    for (int k = 0; k < 12; k++) x[4 * k] = 0.0;
}

/* Form manifolds and their levels; `first` (n + 1), `level` (n), `next` and `begin` (n_bodies). Return the number of manifolds.
 *
 * The level of a manifold is one above those of all earlier manifolds of its moving bodies. period: largest number of levels
 * between the first and the last manifold of a body, both included. */
static int32_t lavender_find_manifolds(const lavender_contacts* c, int32_t* first, int32_t* level, int32_t* next, int32_t* begin,
                                       int32_t* levels, int32_t* period) {
    int32_t m = 0, before = -1;
    *levels = 0;
    *period = 1;
    for (int32_t i = 0; i < c->n_bodies; i++) next[i] = 0, begin[i] = -1;
    for (int32_t k = 0; k < c->n; k++) {
        const int32_t i = c->order[k], *body = c->body + 2 * i;
        if (before >= 0 && k - first[m - 1] < 4 && body[0] == c->body[2 * before] && body[1] == c->body[2 * before + 1]
            && !memcmp(c->normal + 3 * i, c->normal + 3 * before, 24) && !memcmp(c->tangent + 3 * i, c->tangent + 3 * before, 24)
            && c->mu[i] == c->mu[before]) {
            before = i;
            continue;
        }
        int32_t top = 0;
        for (int side = 0; side < 2; side++)
            if (body[side] >= 0 && next[body[side]] > top) top = next[body[side]];
        for (int side = 0; side < 2; side++)
            if (body[side] >= 0) {
                next[body[side]] = top + 1;
                if (begin[body[side]] < 0) begin[body[side]] = top;
                if (top + 1 - begin[body[side]] > *period) *period = top + 1 - begin[body[side]];
            }
        first[m] = k;
        level[m++] = top;
        if (top >= *levels) *levels = top + 1;
        before = i;
    }
    first[m] = c->n;
    return m;
}

/* Pack the contacts of an order into groups whose passes make n_sweeps sweeps each, or one sweep. Return 0 if the groups would
 * have fewer than `least` manifolds on average, or without memory.
 *
 * Manifolds of equal level share no moving body. If they fill few lanes, one pass makes all sweeps: manifold k in sweep s waits
 * until level(k) + s period, and shares no body with the others of that time. */
static int lavender_pack_manifolds(const lavender_contacts* c, int32_t n_sweeps, double least, lavender_manifolds* m) {
    const size_t n = (size_t)c->n, n_bodies = (size_t)c->n_bodies;
    int32_t levels, period, groups = 0, unrolled = 0, time = 0;
    size_t bytes = 0;
    if (!lavender_reserve((void**)&m->scratch, &m->sizes[4], 4 * (3 * n + 2 + 2 * n_bodies))) return 0;
    int32_t *first = m->scratch, *level = first + n + 1, *by_level = level + n, *next = by_level + n, *begin = next + n_bodies;
    const int32_t count = lavender_find_manifolds(c, first, level, next, begin, &levels, &period);
    /* size of each level, and of each time; by_level: manifolds by level, those with most points first */
    const int32_t times = levels + (n_sweeps - 1) * period;
    if (!lavender_reserve((void**)&m->start, &m->sizes[0], sizeof(size_t) * ((size_t)count * (size_t)n_sweeps + 1)
                          + 4 * ((size_t)times + 6 * (size_t)levels + 6))) return 0;
    int32_t *end = (int32_t*)(m->start + (size_t)count * (size_t)n_sweeps + 1), *size = end + 5 * levels + 1;
    memset(end, 0, 4 * (5 * (size_t)levels + 1));
    memset(size, 0, 4 * (size_t)times);
    for (int32_t k = 0; k < count; k++) end[4 * level[k] + 4 - (first[k + 1] - first[k]) + 1]++;
    for (int32_t k = 1; k <= 4 * levels; k++) end[k] += end[k - 1];
    for (int32_t k = 0; k < levels; k++) {
        const int32_t of_level = end[4 * k + 4] - end[4 * k];
        groups += (of_level + 3) / 4;
        for (int32_t s = 0; s < n_sweeps; s++) size[k + s * period] += of_level;
    }
    for (int32_t k = 0; k < times; k++) unrolled += (size[k] + 3) / 4;
    m->n_sweeps = 5 * unrolled < 4 * n_sweeps * groups ? n_sweeps : 1;
    m->n_groups = m->n_sweeps > 1 ? unrolled : groups;
    if (m->n_groups == 0 || (double)count * m->n_sweeps < least * m->n_groups) return 0;
    int32_t* place = size + times;      /* (levels) first manifold of each level */
    for (int32_t k = 0; k < levels; k++) place[k] = end[4 * k];
    for (int32_t k = 0; k < count; k++) by_level[end[4 * level[k] + 4 - (first[k + 1] - first[k])]++] = k;
    /* Now end[4 k + 3] is the end of level k. */
    if (!lavender_reserve((void**)&m->x, &m->sizes[2], 64 * (n + 1)) || !lavender_reserve((void**)&m->v, &m->sizes[3], 64 * (n_bodies + 2)))
        return 0;
    const size_t most = sizeof(lavender_group) + 4 * sizeof(lavender_point);
    if (!lavender_reserve((void**)&m->groups, &m->sizes[1], most * (size_t)m->n_groups)) return 0;
    groups = 0;
    for (time = 0; time < (m->n_sweeps > 1 ? times : levels); time++) {
        lavender_group* g = NULL;
        int lane = 4;
        for (int32_t s = 0; s < m->n_sweeps && s * period <= time; s++) {
            const int32_t at = time - s * period;
            if (at >= levels) continue;
            for (int32_t k = place[at]; k < end[4 * at + 3]; k++) {
                const int32_t f = first[by_level[k]], points = first[by_level[k] + 1] - f;
                if (lane == 4) {
                    if (g) bytes += sizeof *g + (size_t)g->n * sizeof *g->point;
                    m->start[groups++] = bytes;
                    g = (lavender_group*)(m->groups + bytes);
                    g->n = 0;
                    g->n_all = 4;
                    lane = 0;
                }
                lavender_fill_lane(c, f, points, g, lane++);
                if (points > g->n) g->n = points;
                if (points < g->n_all) g->n_all = points;
            }
        }
        if (!g) continue;
        /* Close the last group of this time, in which lanes may be empty. */
        bytes += sizeof *g + (size_t)g->n * sizeof *g->point;
        for (; lane < 4; lane++) lavender_empty_lane(c, g, lane), g->n_all = 0;
    }
    /* Points that a lane does not have. */
    for (int32_t k = 0; k < m->n_groups; k++) {
        lavender_group* g = (lavender_group*)(m->groups + m->start[k]);
        for (int j = g->n_all; j < g->n; j++)
            for (int lane = 0; lane < 4; lane++)
                if (g->count[lane] <= j) {
                    double* p = (double*)(g->point + j) + lane;
                    for (int q = 0; q < 28; q++) p[4 * q] = 0.0;
                    g->contact[j][lane] = 8 * c->n;
                }
    }
    return 1;
}

/* Run sweeps over packed contacts; b and lam (rows), v (n_bodies, 6). */
static void lavender_sweep_manifolds(const lavender_contacts* c, lavender_manifolds* m, int wide, int32_t sweeps, int backwards,
                                     double* lam, double* v) {
    double *x = m->x, *w = m->v;
    for (int32_t k = 0; k < c->n; k++) {
        const int32_t i = c->order[k];
        const double *from = lam + c->ptr[i], *b = c->b + c->ptr[i];
        double* to = x + 8 * (size_t)i;
        for (int q = 0; q < 3; q++) {
            to[q] = from[q];
            to[4 + q] = 0.0 - b[q];
        }
        to[3] = to[7] = 0.0;
    }
    memset(x + 8 * (size_t)c->n, 0, 64);
    for (int32_t i = 0; i < c->n_bodies; i++) {
        for (int q = 0; q < 6; q++) w[8 * (size_t)i + q] = v[6 * (size_t)i + q];
        w[8 * (size_t)i + 6] = w[8 * (size_t)i + 7] = 0.0;
    }
    memset(w + 8 * (size_t)c->n_bodies, 0, 128);
    for (int32_t s = 0; s < sweeps; s += m->n_sweeps) lavender_sweep_groups(wide, m, backwards, x, w);
    for (int32_t k = 0; k < c->n; k++) {
        const int32_t i = c->order[k];
        for (int q = 0; q < 3; q++) lam[c->ptr[i] + q] = x[8 * (size_t)i + q];
    }
    for (int32_t i = 0; i < c->n_bodies; i++)
        for (int q = 0; q < 6; q++) v[6 * (size_t)i + q] = w[8 * (size_t)i + q];
}
#else
typedef struct {
    int32_t n_groups;
} lavender_manifolds;
#define LAVENDER_HAS_MANIFOLDS 0
#define lavender_free_manifolds(m) ((void)(m))
#define lavender_has_avx2() 0
#define lavender_pack_manifolds(c, n_sweeps, least, m) ((void)(c), (void)(n_sweeps), 0)
#define lavender_sweep_manifolds(c, m, wide, sweeps, backwards, lam, v) ((void)(c), (void)(sweeps), (void)(backwards))
#endif
#endif
