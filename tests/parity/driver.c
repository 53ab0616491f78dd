/* Scenes and problems of a data file through the kernels: one line for each, with a hash of every bit that was made.
 *
 *     driver DATA        DATA is written by tests/parity/export.py
 *
 * A line is NAME HASH, then "same" or where the first bit differs from what the installed extension made of it. The hash
 * runs over all arrays of the engine after every step (where Newton's method solves, over its work, too), or over d, nu, step, impulse, slack, error and sums of
 * a problem; of one that `direct` pivots with its own factorisation over outcome, impulse and slack.
 * Only kernels are called: no libm, no Python, and nothing is computed here.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef struct { int32_t n_blocks, n_rows, law; const int32_t *ptr, *kind; const double *lower, *upper, *mu, *patch_radius,
                 *b, *d, *nu, *step, *rolling; } blocks_t;
typedef struct { const int32_t *indptr, *indices; const double *data; } csr_t;
typedef struct { int32_t n_bodies, n_joints, n_contacts; const double *jac, *minv_jac; const int32_t *joint_body;
                 const double *normal, *tangent, *arm_a, *arm_b; const int32_t *contact_body;
                 const double *coupling, *swing, *inv_mass, *inv_inertia, *compliance; } rows_t;
typedef struct { double energy, velocity, floor_energy, floor_velocity; int32_t worst, finite; } score_t;

void lav_layout(int32_t *out);
void lav_engine_lengths(const int32_t *size, int32_t *used);
int32_t lav_engine_substeps(const int32_t *size, double *real, int32_t *index, uint64_t *keys, int32_t n, int32_t *done);
int32_t lav_engine_prepare(const int32_t *size, double *real, int32_t *index, uint64_t *keys);
void lav_engine_solve(const int32_t *size, double *real, int32_t *index, uint64_t *keys, int32_t sweep);
int32_t lav_engine_finish(const int32_t *size, double *real, int32_t *index, uint64_t *keys);
int32_t lav_newton_index_room(const int32_t *size, double *real, int32_t *index, uint64_t *keys);
int32_t lav_newton_plan(const int32_t *size, double *real, int32_t *index, uint64_t *keys, int32_t *scratch);
int32_t lav_newton_substep(const int32_t *size, double *real, int32_t *index, uint64_t *keys, double tol, int32_t *scratch,
                           double *numbers, double *trace, double *said);
void lav_engine_more_room(const int32_t *size, double *real, int32_t *index, uint64_t *keys, int32_t *out);
void lav_engine_move(const int32_t *size, double *real, int32_t *index, uint64_t *keys, const int32_t *to_size,
                     double *to_real, int32_t *to_index, uint64_t *to_keys);
void lav_engine_values(const int32_t *size, double *real, int32_t *index, uint64_t *keys, double *out);
void lav_engine_read_settings(const int32_t *size, double *real, int32_t *index, uint64_t *keys, void *out);
void lav_engine_write_settings(const int32_t *size, double *real, int32_t *index, uint64_t *keys, const void *given);
int32_t lav_rows_diagonal(const blocks_t *p, const rows_t *r, double *d, double *nu, double *step, int32_t *empty,
                          double *minv_jac, double *coupling, double *swing);
int32_t lav_csr_diagonal(const blocks_t *p, const csr_t *a, double *d, double *step, int32_t *empty);
void lav_matrix_nu(const blocks_t *p, double *nu);
void lav_rows_velocity(const blocks_t *p, const rows_t *r, const double *lam, double *v);
void lav_impulse_sweeps(const blocks_t *p, const rows_t *r, double *lam, double *v, int32_t *order, int32_t split, int32_t mode,
                        uint64_t *rng, int32_t first, int32_t n);
void lav_pgs_sweeps(const blocks_t *p, const csr_t *a, double *lam, int32_t *order, int32_t split, int32_t mode, uint64_t *rng,
                    int32_t first, int32_t n);
void lav_judge_rows(const blocks_t *p, const rows_t *r, const double *lam, double *w, double *e, double *v, int32_t floor,
                    score_t *out);
void lav_judge_csr(const blocks_t *p, const csr_t *a, const double *lam, double *w, double *e, int32_t floor, score_t *out);

int32_t lav_pivot_boxed(const blocks_t *p, const csr_t *a, int32_t band, const int32_t *order, double tiny, const double *start,
                        int32_t sweeps, int32_t n, double *real, int32_t *whole);

static FILE *file;

static void fail(const char *why) { fprintf(stderr, "%s\n", why); exit(2); }

static void *room(size_t n) {
  void *at = calloc(n / 8 + 2, 8);
  if (!at) fail("no memory");
  return at;
}

static int64_t number(void) {
  int64_t x;
  if (fread(&x, 8, 1, file) != 1) fail("the data file ends early");
  return x;
}

/* An array: its bytes, padded to 8 in the file. */
static void *array(int64_t *bytes) {
  int64_t n = number();
  char *at = room((size_t)n);
  if (n && fread(at, 1, (size_t)((n + 7) / 8 * 8), file) != (size_t)((n + 7) / 8 * 8)) fail("the data file ends early");
  if (bytes) *bytes = n;
  return at;
}

static uint64_t mix(uint64_t h, const void *data, size_t bytes) {
  const unsigned char *at = data;
  uint64_t x;
  for (; bytes >= 8; at += 8, bytes -= 8) {
    memcpy(&x, at, 8);
    h = (h ^ x) * 0x9E3779B97F4A7C15u;
    h ^= h >> 29;
  }
  x = 0;
  memcpy(&x, at, bytes);
  h = (h ^ x) * 0x9E3779B97F4A7C15u;
  return h ^ (h >> 32);
}

static void say(const char *name, uint64_t hash, int64_t differs, const char *what) {
  printf("%016llx  ", (unsigned long long)hash);
  if (differs < 0) printf("same     ");
  else printf("%s %lld  ", what, (long long)differs);
  printf("  %s\n", name);
  fflush(stdout);
}

/* An engine: sizes and three buffers. */
typedef struct { int32_t *size; double *real; int32_t *index; uint64_t *keys; } engine_t;
#define BUFFERS(e) (e)->size, (e)->real, (e)->index, (e)->keys

static void grow(engine_t *e) {
  int32_t *to = room(64), n[3];
  lav_engine_more_room(BUFFERS(e), to);
  lav_engine_lengths(to, n);
  engine_t larger = {to, room(8 * (size_t)n[0]), room(4 * (size_t)n[1]), room(8 * (size_t)n[2])};
  lav_engine_move(BUFFERS(e), BUFFERS(&larger));
  free(e->size), free(e->real), free(e->index), free(e->keys);
  *e = larger;
}

/* Sweeps, as many as the settings say. */
static void swept_step(engine_t *e, int32_t left) {
  int32_t status, done;
  while ((status = lav_engine_substeps(BUFFERS(e), left, &done)) == 1) {
    left -= done;
    grow(e);
  }
  if (status) fail("a scene is lost");
}

/* Newton's method to the tolerance; what each solve said is hashed, too. */
static void newton_step(engine_t *e, int32_t substeps, double tol, uint64_t *hash) {
  double said[4];
  int32_t i;
  for (i = 0; i < substeps; i++) {
    while (lav_engine_prepare(BUFFERS(e)) == 1) grow(e);
    lav_engine_solve(BUFFERS(e), 0);
    int32_t *scratch = room(4 * (size_t)lav_newton_index_room(BUFFERS(e)));
    double *numbers = room(8 * (size_t)lav_newton_plan(BUFFERS(e), scratch));
    lav_newton_substep(BUFFERS(e), tol, scratch, numbers, 0, said);
    *hash = mix(*hash, said, 24);
    free(scratch), free(numbers);
    if (lav_engine_finish(BUFFERS(e))) fail("a scene is lost");
  }
}

static void scene(void) {
  char *name = array(0);
  int64_t substeps = number(), steps = number(), bytes, c, step, differs = -1;
  double *tol = array(0); /* 0: sweeps */
  engine_t e;
  e.size = array(0), e.real = array(0), e.index = array(0), e.keys = array(0);
  int32_t used[3];
  double values[8];
  uint64_t hash = 1;
  int32_t *change = array(&bytes);
  int64_t changes = bytes / 12, last_bytes;
  double *expected = array(0), *last = array(&last_bytes);
  char settings[1024];
  for (step = 0; step < steps; step++) {
    for (c = 0; c < changes; c++)
      if (change[3 * c] == step) {
        lav_engine_read_settings(BUFFERS(&e), settings);
        memcpy(settings + change[3 * c + 1], change + 3 * c + 2, 4);
        lav_engine_write_settings(BUFFERS(&e), settings);
      }
    if (*tol > 0) newton_step(&e, (int32_t)substeps, *tol, &hash);
    else swept_step(&e, (int32_t)substeps);
    lav_engine_values(BUFFERS(&e), values);
    if (differs < 0 && memcmp(values, expected + 8 * step, 64)) differs = step + 1;
    lav_engine_lengths(e.size, used);
    hash = mix(hash, e.real, 8 * (size_t)used[0]);
    hash = mix(hash, e.index, 4 * (size_t)used[1]);
    hash = mix(hash, e.keys, 8 * (size_t)used[2]);
  }
  if (differs < 0 && (last_bytes != 8 * (int64_t)used[0] || memcmp(e.real, last, (size_t)last_bytes))) differs = steps;
  say(name, hash, differs, "step");
  free(name), free(tol), free(e.size), free(e.real), free(e.index), free(e.keys), free(change), free(expected), free(last);
}

/* 1 where a problem's numbers differ from those of the extension. */
static int problem(uint64_t *hash) {
  int64_t blocks = number(), rows = number(), bodies = number(), joints = number(), contacts = number(), law = number();
  int64_t factored = number(), split = number(), mode = number(), sweeps = number();
  uint64_t rng = (uint64_t)number();
  int32_t *ptr = array(0), *kind = array(0), *order = array(0);
  double *lower = array(0), *upper = array(0), *mu = array(0), *patch = array(0), *b = array(0), *lam = array(0);
  double *d = room(8 * rows), *nu = room(8 * rows), *step = room(8 * rows), *w = room(8 * rows), *e = room(8 * rows);
  int32_t *empty = room(4 * rows);
  score_t s;
  blocks_t p = {(int32_t)blocks, (int32_t)rows, (int32_t)law, ptr, kind, lower, upper, mu, patch, b, d, nu, step};
  memset(&s, 0, sizeof s);
  if (factored) {
    int32_t *jb = array(0), *cb = array(0);
    double *x[8], *more[3] = {room(96 * rows), room(40 * contacts), room(48 * rows)};
    double *v = room(48 * bodies), *scratch = room(96 * bodies);
    int i;
    for (i = 0; i < 8; i++) x[i] = array(0);
    rows_t r = {(int32_t)bodies, (int32_t)joints, (int32_t)contacts, x[0], more[0], jb, x[1], x[2], x[3], x[4], cb,
                more[1], more[2], x[5], x[6], x[7]};
    lav_rows_diagonal(&p, &r, d, nu, step, empty, more[0], more[1], more[2]);
    lav_rows_velocity(&p, &r, lam, v);
    lav_impulse_sweeps(&p, &r, lam, v, order, (int32_t)split, (int32_t)mode, &rng, 1, (int32_t)sweeps);
    lav_judge_rows(&p, &r, lam, w, e, scratch, 1, &s);
  } else {
    csr_t a;
    a.indptr = array(0), a.indices = array(0), a.data = array(0);
    lav_csr_diagonal(&p, &a, d, step, empty);
    lav_matrix_nu(&p, nu);
    lav_pgs_sweeps(&p, &a, lam, order, (int32_t)split, (int32_t)mode, &rng, 1, (int32_t)sweeps);
    lav_judge_csr(&p, &a, lam, w, e, 1, &s);
  }
  double *made[6] = {d, nu, step, lam, w, e};
  int i, wrong = 0;
  for (i = 0; i < 6; i++) {
    double *expected = array(0);
    wrong |= memcmp(made[i], expected, 8 * (size_t)rows) != 0;
    *hash = mix(*hash, made[i], 8 * (size_t)rows);
    free(expected);
  }
  double *sums = array(0);
  wrong |= memcmp(&s.energy, sums, 8) || memcmp(&s.velocity, sums + 1, 8);
  *hash = mix(*hash, &s, 32);
  return wrong;
}

/* A boxed problem by pivoting; 1 where outcome, x or w are not those of the extension. */
static int pivoted(uint64_t *hash) {
  int64_t blocks = number(), rows = number(), band = number(), sweeps = number(), rounds = number(), code;
  double *tiny = array(0);
  int32_t *ptr = array(0), *kind = array(0), *order = array(0);
  double *lower = array(0), *upper = array(0), *mu = array(0), *patch = array(0), *b = array(0), *d = array(0);
  double *nu = array(0), *step = array(0);
  double *start = array(0), *real = room(8 * (size_t)(6 * rows + rows * (band + 1) + 1));
  int32_t *whole = room(4 * (size_t)(2 * rows + 1));
  csr_t a;
  a.indptr = array(0), a.indices = array(0), a.data = array(0);
  blocks_t p = {(int32_t)blocks, (int32_t)rows, 0, ptr, kind, lower, upper, mu, patch, b, d, nu, step};
  code = lav_pivot_boxed(&p, &a, (int32_t)band, order, *tiny, start, (int32_t)sweeps, (int32_t)rounds, real, whole);
  int wrong = code != number();
  wrong |= memcmp(real, array(0), 8 * (size_t)rows) != 0;
  wrong |= memcmp(real + rows, array(0), 8 * (size_t)rows) != 0;
  *hash = mix(*hash, &code, 8);
  *hash = mix(*hash, real, 16 * (size_t)rows);
  return wrong;
}

int main(int argc, char **argv) {
  int64_t n, i, differs = -1;
  int32_t layout[256];
  uint64_t hash = 1;
  char told[64];
  file = argc > 1 ? fopen(argv[1], "rb") : 0;
  if (!file || number() != 0x31524150564F414C) fail("usage: driver DATA");
  /* sizes of the four structs that are built here, as the kernels have them */
  memset(layout, 0, sizeof layout);
  lav_layout(layout);
  int32_t own[4] = {sizeof(blocks_t), sizeof(csr_t), sizeof(rows_t), sizeof(score_t)};
  for (i = 0; i < 4; i++)
    if (layout[number()] != own[i]) fail("a struct of the kernels has another size");
  n = number();
  for (i = 0; i < n; i++) scene();
  n = number();
  for (i = 0; i < n; i++)
    if (problem(&hash) && differs < 0) differs = i + 1;
  snprintf(told, sizeof told, "%lld problems", (long long)n);
  say(told, hash, differs, "problem");
  n = number(), hash = 1, differs = -1;
  for (i = 0; i < n; i++)
    if (pivoted(&hash) && differs < 0) differs = i + 1;
  snprintf(told, sizeof told, "%lld pivoted problems", (long long)n);
  say(told, hash, differs, "problem");
  return 0;
}
