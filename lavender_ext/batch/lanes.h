/* Arithmetic of worlds in lanes, see lanes.pxd: one file of functions, lanes_body.h, compiled for each width. */
#ifndef LAVENDER_LANES_H
#define LAVENDER_LANES_H
#include <math.h>
typedef struct {
    int m, n, law, k, warm;                 /* warm: `solve` begins at lam, else at the zero impulse */
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
       LANE_FLOOR_ENERGY, LANE_FLOOR_SPEED, LANE_WORK, LANE_HEAVIEST, LANE_SWEEPS, LANE_STEPS, LANE_COUNT,
       LANE_NUMBERS, LANE_ROWS = 48,
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
#if defined(__clang__)
#define LAVENDER_APART _Pragma("clang loop vectorize(assume_safety)")
#define LAVENDER_AVX512 __attribute__((target("avx512f,avx512dq,avx512vl"), __min_vector_width__(512)))
#elif defined(__GNUC__)
#define LAVENDER_APART _Pragma("GCC ivdep")
#define LAVENDER_AVX512 __attribute__((target("avx512f,avx512dq,avx512vl,prefer-vector-width=512")))
#else
#define LAVENDER_APART
#endif
#define LAVENDER_NAME_OF_WIDTH(f, width, more) f##_##width##more
#define LAVENDER_NAME(f, width, more) LAVENDER_NAME_OF_WIDTH(f, width, more)

#if defined(__GNUC__) && !defined(LAVENDER_ONE_LANE)
#define LAVENDER_VECTOR(N) \
    typedef double lanes_##N __attribute__((vector_size(8 * N), aligned(8), may_alias)); \
    typedef long long mask_##N __attribute__((vector_size(8 * N), aligned(8), may_alias));
LAVENDER_VECTOR(2)
#ifdef LAVENDER_GENERIC_LANES
#define LAVENDER_FEWEST_LANES 8
#else
#define LAVENDER_FEWEST_LANES 2
#endif
#define LAVENDER_IN_ALL_LANES(width, name, arguments) \
    ((width) == 8 ? name##_8 arguments : (width) == 4 ? name##_4 arguments : name##_2 arguments)
#define WIDTH 1
#include "lanes_body.h"

/* With LAVENDER_GENERIC_LANES the compiler makes all widths of the instructions that every processor has. */
#ifdef LAVENDER_GENERIC_LANES
LAVENDER_VECTOR(4)
LAVENDER_VECTOR(8)
#define LAVENDER_IN_LANES LAVENDER_IN_ALL_LANES
#define WIDTH 2
#include "lanes_body.h"
#define WIDTH 4
#include "lanes_body.h"
#define WIDTH 8
#include "lanes_body.h"
#elif defined(__x86_64__)
#include <immintrin.h>
LAVENDER_VECTOR(4)
LAVENDER_VECTOR(8)
#define LAVENDER_IN_LANES LAVENDER_IN_ALL_LANES
#define WIDTH 2
#define ROOT(a) ((lanes_2)_mm_sqrt_pd((__m128d)(a)))
#define ANY(mask) (_mm_movemask_pd((__m128d)(mask)) != 0)
#include "lanes_body.h"

#define WIDTH 4
#define ISA __attribute__((target("avx2")))
#define ROOT(a) ((lanes_4)_mm256_sqrt_pd((__m256d)(a)))
#define ANY(mask) (_mm256_movemask_pd((__m256d)(mask)) != 0)
#include "lanes_body.h"

#define WIDTH 8
#define ISA LAVENDER_AVX512
#define ROOT(a) ((lanes_8)_mm512_sqrt_pd((__m512d)(a)))
#define ANY(mask) (_mm512_movepi64_mask((__m512i)(mask)) != 0)
#include "lanes_body.h"

#define WIDTH 1
#define MORE _avx2
#define ISA __attribute__((target("avx2")))
#include "lanes_body.h"
#define lavender_solve_one(x, wide) ((wide) ? solve_1_avx2(x) : solve_1(x))
#else
#define LAVENDER_IN_LANES(width, name, arguments) name##_2 arguments
#define WIDTH 2
#include "lanes_body.h"
#endif
#else
#define LAVENDER_FEWEST_LANES 1
#define LAVENDER_IN_LANES(width, name, arguments) name##_1 arguments
#define WIDTH 1
#include "lanes_body.h"
#endif
#ifndef lavender_solve_one
#define lavender_solve_one(x, wide) solve_1(x)
#endif
#define lavender_prepare_lanes(x, width) LAVENDER_IN_LANES(width, prepare, (x))
#define lavender_solve_lanes(x, width) LAVENDER_IN_LANES(width, solve, (x))
#define lavender_judge_lanes(x, width) LAVENDER_IN_LANES(width, judge, (x))
#define lavender_interleave(from, narrow, n, at, to, width) LAVENDER_IN_LANES(width, interleave, (from, narrow, n, at, to))
#endif
