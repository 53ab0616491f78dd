/* Check that this build reproduces the measured results: solve every test vector again and compare all bits. */
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
    const int32_t code_ = (call);                                                               \
    if (code_ != LAV_OK) return fprintf(stderr, "%s: %s\n", #call, lav_text(code_)), 1;         \
  } while (0)

typedef struct step_t {
  lav_options options;
  lav_budget budget;
} step_t;

static step_t read_step(void) {
  step_t s;
  lav_default_options((int32_t)whole(), &s.options);
  lav_default_budget(&s.budget);
  s.options.order = (int32_t)whole(), s.options.memory = (int32_t)whole(), s.options.sweep = (int32_t)whole();
  s.options.convex = (int32_t)whole(), s.options.keeps = (int32_t)whole(), s.options.seed = (uint64_t)whole();
  s.options.omega = real(), s.budget.iterations = (int32_t)whole(), s.budget.tol = real();
  return s;
}

static void read_problem(lav_problem *q) {
  const void **at, **end;
  lav_default_problem((int32_t)whole(), q);
  q->law = (int32_t)whole(), q->n_blocks = (int32_t)whole(), q->n_rows = (int32_t)whole(), q->n_entries = (int32_t)whole();
  q->n_bodies = (int32_t)whole(), q->n_joints = (int32_t)whole(), q->n_velocities = (int32_t)whole();
  q->n_mass_entries = (int32_t)whole();
  at = (const void **)(void *)&q->block_ptr, end = (const void **)(void *)(q + 1); /* The rest of the struct are pointers. */
  for (; at < end; at++) {
    const int64_t size = whole();
    *at = size < 0 ? NULL : array(size);
  }
}

/* Open a solver with a problem, in its own memory, which is enlarged if the solver requests it. */
static int set(const lav_options *options, const lav_problem *q, void **memory, lav_solver **solver) {
  uint64_t bytes;
  int32_t code = LAV_ERROR_WORKSPACE;
  CHECK(lav_workspace_size(q, options, &bytes));
  while (code == LAV_ERROR_WORKSPACE) {
    free(*memory);
    *memory = malloc(bytes);
    CHECK(lav_open(*memory, bytes, q, options, solver));
    code = lav_set(*solver, q);
    bytes = lav_needed(*solver);
  }
  CHECK(code);
  return 0;
}

/* Run one step on a problem, from q->impulse if it is not null, and store the result in found. */
static int run_step(const step_t *s, const lav_problem *q, double *found, lav_result *result, void **memory) {
  lav_solver *solver = NULL;
  lav_budget budget = s->budget;
  if (set(&s->options, q, memory, &solver)) return 1;
  CHECK(lav_run(solver, &budget, result));
  CHECK(lav_impulse(solver, found, q->n_rows));
  return 0;
}

static int solve_one(void) {
  const int64_t n = whole();
  step_t *steps = (step_t *)calloc((size_t)n, sizeof *steps);
  lav_problem q;
  lav_result result;
  double relative, *impulse = NULL, *found;
  void *memory = NULL;
  int64_t i;
  int is_met, same;
  for (i = 0; i < n; i++) steps[i] = read_step();
  read_problem(&q);
  is_met = (int)whole(), relative = real(); /* Either the residual must be reached, or all bits must be equal. */
  if (!is_met) impulse = (double *)array(8 * (int64_t)q.n_rows);
  found = (double *)calloc((size_t)q.n_rows + 1, 8);
  memset(&result, 0, sizeof result);
  result.size = sizeof result;
  for (i = 0; i < n; i++) {
    if (run_step(&steps[i], &q, found, &result, &memory)) return 1;
    if (result.verdict.relative <= steps[i].budget.tol) break;
    q.impulse = found;
  }
  i = i < n ? i : n - 1;
  same = is_met ? result.verdict.relative <= relative
                : memcmp(found, impulse, 8 * (size_t)q.n_rows) == 0 && memcmp(&relative, &result.verdict.relative, 8) == 0;
  printf("%s  %016llx  %s on %d rows: %s, residual %.2e\n", !same ? "DIFFERS" : is_met ? "met    " : "same   ",
         (unsigned long long)lav_hash(found, q.n_rows, 0), lav_name(steps[i].options.method), q.n_rows,
         lav_outcome(result.outcome), result.verdict.relative);
  free(found), free(steps), free(memory);
  return !same;
}

int main(int count, char **words) {
  char magic[8];
  int64_t n, i;
  int bad = 0;
  CHECK(lav_self_test());
  file = fopen(count > 1 ? words[1] : "vectors.bin", "rb");
  if (!file || fread(magic, 8, 1, file) != 1 || memcmp(magic, "LAVVEC3", 8) != 0) return fprintf(stderr, "no vectors.bin here\n"), 2;
  for (n = whole(), i = 0; i < n; i++) bad += solve_one();
  return bad > 0;
}
