/* A tower of boxes, stepped by an engine of one page: its contact list in, impulses out, judged in every step.
 *
 *     lavender export c liblavender
 *     cc -std=c11 -ffp-contract=off -I liblavender tower.c liblavender/lavender.c -lm -o tower
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lavender.h"

enum { BOXES = 8, CONTACTS = 4 * BOXES };

#define CHECK(call)                                                             \
  do {                                                                          \
    int32_t code = (call);                                                      \
    if (code != LAV_OK) return fprintf(stderr, "%s: %s\n", #call, lav_text(code)), 1; \
  } while (0)

int main(void) {
  const double dt = 1.0 / 64, side[4][2] = {{-0.5, -0.5}, {0.5, -0.5}, {-0.5, 0.5}, {0.5, 0.5}};
  double inv_mass[BOXES], inv_inertia[9 * BOXES] = {0}, x[3 * BOXES], v[6 * BOXES] = {0}, normal[3 * CONTACTS],
      tangent[3 * CONTACTS], arm_a[3 * CONTACTS], arm_b[3 * CONTACTS], target[3 * CONTACTS], mu[CONTACTS];
  int32_t ptr[CONTACTS + 1], kind[CONTACTS], body[2 * CONTACTS], i, c, k, step;
  uint64_t key[CONTACTS], bytes;
  lav_problem q;
  lav_options options;
  lav_budget budget;
  lav_result result;
  lav_solver *solver;
  void *memory;
  CHECK(lav_self_test());
  lav_default_problem(LAV_BODIES, &q);
  lav_default_options(LAV_SEQUENTIAL_IMPULSES, &options);
  lav_default_budget(&budget);
  memset(&result, 0, sizeof result);
  result.size = sizeof result;
  for (i = 0; i < BOXES; i++) {
    inv_mass[i] = 1.0;
    for (k = 0; k < 3; k++) inv_inertia[9 * i + 4 * k] = 6.0;
    x[3 * i] = 0.0625 * (i % 3), x[3 * i + 1] = 0.03125 * (i % 2), x[3 * i + 2] = 0.5 + 1.0 * i;
  }
  q.n_blocks = CONTACTS, q.n_rows = 3 * CONTACTS, q.n_bodies = BOXES, q.block_ptr = ptr, q.kind = kind, q.key = key;
  q.mu = mu, q.target = target, q.velocity = v, q.inv_mass = inv_mass, q.inv_inertia = inv_inertia;
  q.contact_body = body, q.normal = normal, q.tangent = tangent, q.arm_a = arm_a, q.arm_b = arm_b;
  CHECK(lav_workspace_size(&q, &options, &bytes));
  memory = malloc(bytes);
  CHECK(lav_open(memory, bytes, &q, &options, &solver));
  for (step = 0; step < 120; step++) {
    for (i = 0; i < BOXES; i++) v[6 * i + 2] -= 9.75 * dt;
    for (c = 0; c <= CONTACTS; c++) ptr[c] = 3 * c;
    for (c = 0; c < CONTACTS; c++) { /* the corners of each box on what is below it */
      i = c / 4, kind[c] = LAV_CONTACT, key[c] = (uint64_t)c, mu[c] = 0.5, body[2 * c] = i - 1, body[2 * c + 1] = i;
      for (k = 0; k < 3; k++) {
        normal[3 * c + k] = k == 2, tangent[3 * c + k] = k == 0, target[3 * c + k] = 0.0;
        arm_b[3 * c + k] = k == 2 ? -0.5 : side[c % 4][k];
        arm_a[3 * c + k] = i == 0 ? 0.0 : x[3 * i + k] + arm_b[3 * c + k] - x[3 * i - 3 + k];
      }
      target[3 * c] = -(x[3 * i + 2] - 0.5 - (i == 0 ? 0.0 : x[3 * i - 1] + 0.5)) / dt; /* -gap / dt */
    }
    CHECK(lav_set(solver, &q));
    CHECK(lav_run(solver, &budget, &result));
    CHECK(lav_velocity(solver, v, 6 * BOXES));
    for (i = 0; i < BOXES; i++)
      for (k = 0; k < 3; k++) x[3 * i + k] += dt * v[6 * i + k];
  }
  printf("%s after %d sweeps, residual %.2e, floor %.0e, worst row %d\n", lav_outcome(result.outcome), result.sweeps,
         result.verdict.relative, result.verdict.floor, result.verdict.worst);
  printf("%016llx\n", (unsigned long long)lav_hash(v, 6 * BOXES, lav_hash(x, 3 * BOXES, 0)));
  free(memory); /* nothing to close */
  return 0;
}
