/* Spheres drop on each other; a ball joint holds the lowest one. Every call that an engine needs is here.
 *
 *     lavender export c liblavender
 *     cc -std=c99 -ffp-contract=off -I liblavender drop.c liblavender/lavender.c -lm -o drop
 *     mkdir steps && ./drop steps         with a folder: the problem of each step as a file
 *     lavender report steps
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "lavender.h"
#include "lavender_dump.h"

enum { N = 12, MOST = N * (N + 1) / 2 }; /* spheres of radius 0.5 m and 1 kg; contacts at most */
static double x[3 * N], v[6 * N], inv_mass[N], inv_inertia[9 * N];
static double normal[3 * MOST], tangent[3 * MOST], arm_a[3 * MOST], arm_b[3 * MOST];
static double target[3 + 3 * MOST], mu[1 + MOST], jac[3 * 12];
static int32_t ptr[2 + MOST], kind[1 + MOST], body[2 * MOST], joint_body[2] = {-1, 0}, contacts;
static uint64_t key[1 + MOST]; /* block 0: the joint of body 0 with the world -1 */

/* A contact of body a, or of the floor -1, with body b, where they are near. */
static void touch(int32_t a, int32_t b, double dt) {
  const int32_t c = contacts, block = 1 + c, row = 3 + 3 * c;
  double n[3] = {0.0, 0.0, x[3 * b + 2] + 0.5}, distance = 0.0;
  int i, k;
  for (i = 0; i < 3; i++) {
    if (a >= 0) n[i] = x[3 * b + i] - x[3 * a + i];
    distance += n[i] * n[i];
  }
  distance = sqrt(distance);
  if (distance > 1.1) return;
  for (i = 0; i < 3; i++) n[i] /= distance;
  k = fabs(n[0]) < 0.6 ? 0 : 1; /* an axis that n is not along */
  for (i = 0; i < 3; i++) {
    normal[3 * c + i] = n[i], tangent[3 * c + i] = ((i == k) - n[k] * n[i]) / sqrt(1.0 - n[k] * n[k]);
    arm_a[3 * c + i] = a < 0 ? 0.0 : 0.5 * n[i], arm_b[3 * c + i] = -0.5 * n[i], target[row + i] = 0.0;
  }
  target[row] = -(distance - 1.0) / dt; /* -gap / dt */
  ptr[block] = row, kind[block] = LAV_CONTACT, mu[block] = 0.4, body[2 * c] = a, body[2 * c + 1] = b;
  key[block] = 1 + (uint64_t)(a + 1) * N + (uint64_t)b; /* the same in the next step: its impulse is carried */
  ptr[block + 1] = row + 3, contacts++;
}

typedef struct { /* a solver in memory that grows with its problems */
  lav_solver *at;
  void *memory;
  uint64_t bytes;
} solver_t;

static int32_t set(solver_t *s, const lav_problem *q, const lav_options *options) {
  void *before = s->memory;
  int32_t code, index = 0;
  const char *array;
  if (!before) {
    if ((code = lav_workspace_size(q, options, &s->bytes)) != LAV_OK) return code;
    s->memory = malloc(s->bytes);
    if ((code = lav_open(s->memory, s->bytes, q, options, &s->at)) != LAV_OK) return code;
  }
  while ((code = lav_set(s->at, q)) == LAV_ERROR_WORKSPACE) { /* at least twice as much; impulses move with it */
    before = s->memory;
    s->bytes = lav_needed(s->at) > 2 * s->bytes ? lav_needed(s->at) : 2 * s->bytes;
    s->memory = malloc(s->bytes);
    if ((code = lav_move(s->at, s->memory, s->bytes, &s->at)) != LAV_OK) return code;
    free(before);
  }
  array = lav_refused(s->at, &index);
  if (array) fprintf(stderr, "%s[%d]: %s\n", array, index, lav_text(code));
  return code;
}

int main(int count, char **words) {
  const double dt = 1.0 / 60;
  char path[256];
  lav_problem q;
  lav_options options;
  lav_budget budget;
  lav_result result;
  solver_t solver = {NULL, NULL, 0};
  int32_t code = lav_self_test(), step, a, b, i;
  lav_default_problem(LAV_BODIES, &q);
  lav_default_options(LAV_NEWTON, &options);
  lav_default_budget(&budget); /* to 1e-6 in at most 1000; exactly eight sweeps are tol 0, iterations 8 */
  result.size = sizeof result;
  for (i = 0; i < N; i++) {
    inv_mass[i] = 1.0, x[3 * i] = 0.3 * (i % 2), x[3 * i + 1] = 0.1 * (i % 3), x[3 * i + 2] = 0.5 + 1.2 * i;
    inv_inertia[9 * i] = inv_inertia[9 * i + 4] = inv_inertia[9 * i + 8] = 10.0; /* 1 / (0.4 m r^2) */
  }
  for (i = 0; i < 3; i++) jac[12 * i + 6 + i] = 1.0; /* a row for each axis: linear and angular on a, then on b */
  kind[0] = LAV_ROW, ptr[1] = 3, q.n_joints = 1, q.joint_body = joint_body, q.jac = jac;
  q.block_ptr = ptr, q.kind = kind, q.key = key, q.mu = mu, q.target = target, q.velocity = v;
  q.n_bodies = N, q.inv_mass = inv_mass, q.inv_inertia = inv_inertia;
  q.contact_body = body, q.normal = normal, q.tangent = tangent, q.arm_a = arm_a, q.arm_b = arm_b;
  for (step = 0; step < 240 && code == LAV_OK; step++) {
    for (contacts = 0, b = 0; b < N; b++)
      for (v[6 * b + 2] -= 9.81 * dt, a = -1; a < b; a++) touch(a, b, dt);
    for (i = 0; i < 3; i++) target[i] = -0.2 * (x[i] - (i == 2 ? 0.5 : 0.0)) / dt; /* -beta C / h */
    q.n_blocks = 1 + contacts, q.n_rows = 3 + 3 * contacts;
    code = set(&solver, &q, &options);
    if (code == LAV_OK) code = lav_run(solver.at, &budget, &result);
    if (count > 1) { /* every step as a file of the package */
      snprintf(path, sizeof path, "%s/%03d.npz", words[1], step);
      if (code == LAV_OK) code = lav_dump(solver.at, &q, path);
    }
    if (code == LAV_OK) code = lav_velocity(solver.at, v, 6 * N);
    for (i = 0; i < 3 * N; i++) x[i] += dt * v[6 * (i / 3) + i % 3];
  }
  if (code != LAV_OK) return fprintf(stderr, "%s\n", lav_text(code)), 1;
  printf("%s, residual %.1e, worst row %d, %.1e m/s\n", lav_outcome(result.outcome), result.verdict.relative,
         result.verdict.worst, result.verdict.velocity);
  free(solver.memory); /* nothing to close */
  return 0;
}
