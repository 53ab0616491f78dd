/* A planar engine on the C library: two disks roll down a slope, in contact with it and with each other.
 *
 *     lavender export c liblavender
 *     cc -std=c99 -ffp-contract=off -I liblavender planar.c liblavender/lavender.c -lm -o planar
 *     ./planar [FOLDER]         with a folder: every step as a file, with the engine's own impulses
 *     lavender report FOLDER
 *
 * A planar body uses the x and y components and the rotation about z of a body of the library. Its inverse inertia has one
 * entry, zz; the rotations about x and y and the motion along z are never driven, so their entries may be 0 and v_z stays 0.
 * A contact has two rows, the normal and one tangent: the tangent lies in the plane, and all arms have z = 0.
 *
 * The engine's own solver is a plain loop of projected Gauss-Seidel over the same rows.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "lavender.h"
#include "lavender_dump.h"

enum { N = 2, MAX_CONTACTS = 3, STEPS = 60, SWEEPS = 200 };
static const double RADIUS = 0.5, MASS = 1.0, MU = 0.8, SLOPE = 0.3, GRAVITY = 9.81, DT = 1.0 / 60; /* m, kg, -, rad, m/s^2, s */

typedef struct { double x, y, vx, vy, spin; } disk_t;
typedef struct { int a, b; double n[2], arm_a[2], arm_b[2]; } contact_t; /* normal from a to b; -1: the slope */

/* Find contacts of both disks with the slope, the line y = 0 in tilted axes, and with each other. */
static int find_contacts(const disk_t *d, contact_t *c) {
  int count = 0, i;
  double nx = d[1].x - d[0].x, ny = d[1].y - d[0].y, distance = sqrt(nx * nx + ny * ny);
  for (i = 0; i < N; i++)
    if (d[i].y < RADIUS + 1e-3) c[count++] = (contact_t){-1, i, {0, 1}, {0, 0}, {0, -RADIUS}};
  nx /= distance, ny /= distance;
  if (distance < 2 * RADIUS + 1e-3)
    c[count++] = (contact_t){0, 1, {nx, ny}, {RADIUS * nx, RADIUS * ny}, {-RADIUS * nx, -RADIUS * ny}};
  return count;
}

/* Relative velocity along a direction (u): J v of one row. */
static double relative_velocity(const contact_t *c, const double *u, const double *v) {
  double sum = 0.0;
  if (c->a >= 0) sum -= u[0] * v[6 * c->a] + u[1] * v[6 * c->a + 1] + (c->arm_a[0] * u[1] - c->arm_a[1] * u[0]) * v[6 * c->a + 5];
  return sum + u[0] * v[6 * c->b] + u[1] * v[6 * c->b + 1] + (c->arm_b[0] * u[1] - c->arm_b[1] * u[0]) * v[6 * c->b + 5];
}

static double apply(const contact_t *c, const double *u, double impulse, double *v) { /* v += M^-1 J^T impulse; returns A_ii */
  const double inv_inertia = 2.0 / (MASS * RADIUS * RADIUS);
  double diagonal = 0.0;
  int side;
  for (side = 0; side < 2; side++) {
    const int body = side ? c->b : c->a;
    const double *arm = side ? c->arm_b : c->arm_a, sign = side ? 1.0 : -1.0, turn = arm[0] * u[1] - arm[1] * u[0];
    if (body < 0) continue;
    v[6 * body] += sign * u[0] * impulse / MASS, v[6 * body + 1] += sign * u[1] * impulse / MASS;
    v[6 * body + 5] += sign * turn * inv_inertia * impulse;
    diagonal += 1.0 / MASS + turn * turn * inv_inertia;
  }
  return diagonal;
}

int main(int count, char **words) {
  disk_t d[N] = {{0, RADIUS, 0, 0, 0}, {-2 * RADIUS, RADIUS, 0, 0, 0}};
  static double v[6 * N], after[6 * N], own[2 * MAX_CONTACTS], inv_mass[N], inv_inertia[9 * N], memory[1 << 16];
  double normal[3 * MAX_CONTACTS], tangent[3 * MAX_CONTACTS], arm_a[3 * MAX_CONTACTS], arm_b[3 * MAX_CONTACTS], mu[MAX_CONTACTS];
  int32_t ptr[MAX_CONTACTS + 1] = {0}, kind[MAX_CONTACTS], body[2 * MAX_CONTACTS], code = LAV_OK, step, i, k;
  uint64_t key[MAX_CONTACTS];
  contact_t c[MAX_CONTACTS];
  lav_problem q;
  lav_options options;
  lav_budget budget;
  lav_result result;
  lav_solver *solver = NULL;
  result.size = sizeof result;
  lav_default_problem(LAV_BODIES, &q), lav_default_options(LAV_NEWTON, &options), lav_default_budget(&budget);
  for (i = 0; i < N; i++) inv_mass[i] = 1.0 / MASS, inv_inertia[9 * i + 8] = 2.0 / (MASS * RADIUS * RADIUS); /* zz */
  q.n_bodies = N, q.inv_mass = inv_mass, q.inv_inertia = inv_inertia, q.velocity = v;
  q.block_ptr = ptr, q.kind = kind, q.mu = mu, q.key = key, q.contact_body = body;
  q.normal = normal, q.tangent = tangent, q.arm_a = arm_a, q.arm_b = arm_b;
  q.n_blocks = MAX_CONTACTS, q.n_rows = 2 * MAX_CONTACTS; /* the largest problem, for which the memory must suffice */
  for (k = 0; k < MAX_CONTACTS; k++) ptr[k + 1] = 2 * (k + 1), kind[k] = LAV_CONTACT;
  code = lav_open(memory, sizeof memory, &q, &options, &solver);
  for (step = 0; step < STEPS && code == LAV_OK; step++) {
    int contacts = find_contacts(d, c), sweep;
    for (i = 0; i < N; i++) { /* v*: gravity along the tilted axes */
      v[6 * i] = d[i].vx + DT * GRAVITY * sin(SLOPE), v[6 * i + 1] = d[i].vy - DT * GRAVITY * cos(SLOPE), v[6 * i + 5] = d[i].spin;
    }
    for (k = 0; k < contacts; k++) {
      const double frame[6] = {c[k].n[0], c[k].n[1], 0, -c[k].n[1], c[k].n[0], 0};
      for (i = 0; i < 3; i++) {
        normal[3 * k + i] = frame[i], tangent[3 * k + i] = frame[3 + i];
        arm_a[3 * k + i] = i < 2 ? c[k].arm_a[i] : 0, arm_b[3 * k + i] = i < 2 ? c[k].arm_b[i] : 0;
      }
      body[2 * k] = c[k].a, body[2 * k + 1] = c[k].b, mu[k] = MU, key[k] = (uint64_t)(10 * (c[k].a + 1) + c[k].b);
    }
    q.n_blocks = contacts, q.n_rows = 2 * contacts;
    if ((code = lav_set(solver, &q)) != LAV_OK || (code = lav_run(solver, &budget, &result)) != LAV_OK) break;
    if (count > 1) { /* the engine's own solver: projected Gauss-Seidel */
      char name[32];
      for (i = 0; i < 6 * N; i++) after[i] = v[i];
      for (i = 0; i < 2 * contacts; i++) own[i] = 0.0;
      for (sweep = 0; sweep < SWEEPS; sweep++)
        for (i = 0; i < 2 * contacts; i++) {
          const contact_t *at = &c[i / 2];
          const double t[2] = {-at->n[1], at->n[0]}, *u = i % 2 ? t : at->n, bound = MU * own[i - i % 2];
          double diagonal = apply(at, u, 0.0, after), next = own[i] - relative_velocity(at, u, after) / diagonal;
          next = i % 2 ? fmax(-bound, fmin(bound, next)) : fmax(0.0, next);
          apply(at, u, next - own[i], after), own[i] = next;
        }
      snprintf(name, sizeof name, "step_%03d", step);
      if ((code = lav_dump_answer(solver, &q, words[1], name, own, 0.0, "own PGS")) != LAV_OK) break;
    }
    if ((code = lav_velocity(solver, after, 6 * N)) != LAV_OK) break;
    for (i = 0; i < N; i++) {
      d[i].vx = after[6 * i], d[i].vy = after[6 * i + 1], d[i].spin = after[6 * i + 5];
      d[i].x += DT * d[i].vx, d[i].y += DT * d[i].vy;
    }
  }
  if (code != LAV_OK) return fprintf(stderr, "%s\n", lav_text(code)), 1;
  printf("speed %.17g m/s, spin %.17g rad/s, residual %.1e\n", d[0].vx, d[0].spin, result.verdict.relative);
  return 0;
}
