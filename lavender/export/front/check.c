/* Does this build have what the report measured? Every test vector solved again and compared to the last bit. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lavender.h"

static FILE *file;

static int64_t whole(void) {
  int64_t x;
  if (fread(&x, 8, 1, file) != 1) fprintf(stderr, "vectors.bin ends early\n"), exit(2);
  return x;
}

static double real(void) {
  const int64_t bits = whole();
  double x;
  memcpy(&x, &bits, 8);
  return x;
}

static void *array(int64_t bytes) {
  void *at = calloc((size_t)(bytes > 0 ? (bytes + 7) / 8 : 1), 8);
  if (!at || (bytes > 0 && fread(at, (size_t)((bytes + 7) / 8 * 8), 1, file) != 1)) fprintf(stderr, "vectors.bin ends early\n"), exit(2);
  return at;
}

#define CHECK(call)                                                                             \
  do {                                                                                          \
    const int32_t code = (call);                                                                \
    if (code != LAV_OK) return fprintf(stderr, "%s: %s\n", #call, lav_text(code)), 1;           \
  } while (0)

static int solve_one(int64_t number) {
  lav_problem q;
  lav_options options;
  lav_budget budget;
  lav_result result;
  lav_solver *solver = NULL;
  uint64_t bytes, i;
  double relative, *impulse = NULL, *found;
  int32_t turns[32], is_met;
  CHECK(lav_default_options((int32_t)whole(), &options));
  CHECK(lav_default_budget(&budget));
  options.order = (int32_t)whole(), options.memory = (int32_t)whole(), options.sweep = (int32_t)whole();
  options.convex = (int32_t)whole(), options.keeps = (int32_t)whole(), options.seed = (uint64_t)whole(), options.omega = real();
  budget.iterations = (int32_t)whole(), budget.tol = real();
  options.n_turns = (int32_t)whole(), options.turns = turns;
  for (i = 0; i < 2 * (uint64_t)options.n_turns && i < 32; i++) turns[i] = (int32_t)whole();
  CHECK(lav_default_problem((int32_t)whole(), &q));
  q.law = (int32_t)whole(), q.n_blocks = (int32_t)whole(), q.n_rows = (int32_t)whole(), q.n_entries = (int32_t)whole();
  q.n_bodies = (int32_t)whole(), q.n_joints = (int32_t)whole(), q.n_velocities = (int32_t)whole();
  q.n_mass_entries = (int32_t)whole();
  {
    const void **at = (const void **)(void *)&q.block_ptr, **end = (const void **)(void *)(&q + 1); /* pointers to the end */
    for (; at < end; at++) {
      const int64_t size = whole();
      *at = size < 0 ? NULL : array(size);
    }
  }
  is_met = (int32_t)whole(), relative = real(); /* a residual to be met, or bits */
  if (!is_met) impulse = (double *)array(8 * (int64_t)q.n_rows);
  found = (double *)calloc((size_t)q.n_rows + 1, 8);
  memset(&result, 0, sizeof result);
  result.size = sizeof result;
  CHECK(lav_room(&q, &options, &bytes));
  for (;;) {
    int32_t set;
    CHECK(lav_open(malloc(bytes), bytes, &q, &options, &solver));
    set = lav_set(solver, &q);
    if (set != LAV_ERROR_ROOM) {
      CHECK(set);
      break;
    }
    bytes = lav_needed(solver);
  }
  CHECK(lav_run(solver, &budget, &result));
  CHECK(lav_impulse(solver, found, q.n_rows));
  {
    const int same = is_met ? result.verdict.relative <= relative
                            : memcmp(found, impulse, 8 * (size_t)q.n_rows) == 0 && memcmp(&relative, &result.verdict.relative, 8) == 0;
    printf("%s  %016llx  %s on %d rows: %s, residual %.2e\n", !same ? "DIFFERS" : is_met ? "met    " : "same   ",
           (unsigned long long)lav_hash(found, q.n_rows, 0), lav_name(options.method), q.n_rows, lav_outcome(result.outcome),
           result.verdict.relative);
    (void)number;
    return !same;
  }
}

int main(int count, char **words) {
  char magic[8];
  int64_t n, i;
  int bad = 0;
  CHECK(lav_self_test());
  file = fopen(count > 1 ? words[1] : "vectors.bin", "rb");
  if (!file || fread(magic, 8, 1, file) != 1 || memcmp(magic, "LAVVEC1", 8) != 0) return fprintf(stderr, "no vectors.bin here\n"), 2;
  for (n = whole(), i = 0; i < n; i++) bad += solve_one(i);
  return bad > 0;
}
