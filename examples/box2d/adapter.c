/* The contact solver of Box2D v3 replaced by one of lavender; see adapter.h.
 *
 * Box2D splits a step into substeps: velocities are integrated, contacts solved with a push (soft contacts), positions
 * integrated, contacts relaxed without it. The linker gives the functions of its contact solver to `__wrap_...` below
 * (CMakeLists.txt). In Box2D's run they call Box2D's; in ours each solve is one problem in J and M:
 *
 *     w = J v+ + theta lambda - target,   v+ = v* + M^-1 J^T lambda
 *     normal: lambda >= 0 complementary to w,   tangent: |lambda_t| <= mu lambda_n, against sliding
 *     apart (s > 0): target = -s / h      pushed: target = -rate s, theta = k (impulse scale) / (mass scale)
 *     relaxed: target = 0, theta = 0      with k = J M^-1 J^T of the normal row
 */
#include "adapter.h"

#include "body.h"
#include "constraint_graph.h"
#include "contact.h"
#include "contact_solver.h"
#include "physics_world.h"
#include "solver.h"
#include "solver_set.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static struct {
  int ours, method, iterations, substep;
  struct counts counts;
  int n_contacts, n_columns, n_bodies;   /* of the present problem */
  int room_contacts, room_bodies;
  int32_t *ptr, *kind, *block_ptr, *column, *mass_ptr, *mass_index;
  double *mu, *b, *theta, *value, *mass, *velocity, *impulse, *after;
  b2BodyState *before;                   /* states with v*, when a substep began */
  lav_solver *solver;
  void *memory;
  uint64_t bytes;
} run;

void check(int32_t code, const char *what) {
  if (code != LAV_OK) {
    fprintf(stderr, "%s: %s\n", what, lav_text(code));
    exit(1);
  }
}

static void *more(void *old, size_t bytes) {
  void *made = realloc(old, bytes);
  if (made == NULL) exit(2);
  return made;
}

static void make_room(int contacts, int bodies) {
  if (contacts > run.room_contacts) {
    size_t n = run.room_contacts = 2 * contacts, m = 2 * n;
    run.ptr = more(run.ptr, (m + 1) * sizeof(int32_t));
    run.kind = more(run.kind, n * sizeof(int32_t));
    run.block_ptr = more(run.block_ptr, (n + 1) * sizeof(int32_t));
    run.column = more(run.column, 6 * m * sizeof(int32_t));
    run.mu = more(run.mu, n * sizeof(double));
    run.b = more(run.b, m * sizeof(double));
    run.theta = more(run.theta, m * sizeof(double));
    run.impulse = more(run.impulse, m * sizeof(double));
    run.value = more(run.value, 6 * m * sizeof(double));
  }
  if (bodies > run.room_bodies) {
    size_t n = run.room_bodies = 2 * bodies, nv = 3 * n;
    run.before = more(run.before, n * sizeof(b2BodyState));
    run.mass_ptr = more(run.mass_ptr, (nv + 1) * sizeof(int32_t));
    run.mass_index = more(run.mass_index, nv * sizeof(int32_t));
    run.mass = more(run.mass, nv * sizeof(double));
    run.velocity = more(run.velocity, nv * sizeof(double));
    run.after = more(run.after, nv * sizeof(double));
  }
}

/* One body's part of a row along `direction` at `arm`: entries into J, where it moves; its velocity along the row. */
static double part(int body, float inv_mass, float inv_inertia, b2Vec2 arm, b2Vec2 direction, double sign, int32_t *end,
                   double *k) {
  double x = sign * direction.x, y = sign * direction.y;
  double turn = sign * ((double)arm.x * direction.y - (double)arm.y * direction.x);
  if (body == B2_NULL_INDEX) return 0.0;
  const double entry[3] = {x, y, turn};
  for (int i = 0; i < 3; ++i) {
    run.column[*end] = 3 * body + i;
    run.value[(*end)++] = entry[i];
  }
  *k += inv_mass * (x * x + y * y) + inv_inertia * turn * turn;
  const b2BodyState *s = run.before + body;
  return x * s->linearVelocity.x + y * s->linearVelocity.y + turn * s->angularVelocity;
}

/* The contacts of all colours as one problem; with `store`, impulses go the other way, into Box2D's manifolds. */
static void each_contact(b2StepContext *context, int push, int store) {
  int32_t end = 0, block = 0;
  for (int c = 0; c < B2_GRAPH_COLOR_COUNT; ++c) {
    b2GraphColor *color = context->graph->colors + c;
    for (int i = 0; i < color->contactSims.count; ++i) {
      b2ContactSim *sim = color->contactSims.data + i;
      b2Vec2 n = sim->manifold.normal, t = b2RightPerp(n);
      int a = sim->bodySimIndexA, b = sim->bodySimIndexB;
      const b2BodyState still = b2_identityBodyState;
      const b2BodyState *sa = a == B2_NULL_INDEX ? &still : context->states + a;
      const b2BodyState *sb = b == B2_NULL_INDEX ? &still : context->states + b;
      b2Softness soft = a == B2_NULL_INDEX || b == B2_NULL_INDEX ? context->staticSoftness : context->contactSoftness;
      if (sim->rollingResistance != 0.0f || sim->restitution != 0.0f || sim->tangentSpeed != 0.0f) {
        fprintf(stderr, "rolling resistance, bounce and moving surfaces are not in this adapter\n");
        exit(1);
      }
      for (int j = 0; j < sim->manifold.pointCount; ++j, ++block) {
        b2ManifoldPoint *p = sim->manifold.points + j;
        if (store) {
          p->normalImpulse = (float)run.impulse[2 * block];
          p->tangentImpulse = (float)run.impulse[2 * block + 1];
          p->totalNormalImpulse += p->normalImpulse;
          continue;
        }
        b2Vec2 gap = b2Sub(b2RotateVector(sb->deltaRotation, p->anchorB), b2RotateVector(sa->deltaRotation, p->anchorA));
        gap = b2Add(gap, b2Sub(sb->deltaPosition, sa->deltaPosition));
        float s = p->separation + b2Dot(b2Sub(gap, b2Sub(p->anchorB, p->anchorA)), n);
        double target = s > 0.0f ? -s * context->inv_h : 0.0, theta = 0.0, k = 0.0;
        for (int row = 0; row < 2; ++row) {
          b2Vec2 along = row == 0 ? n : t;
          int first = a < b;  /* columns of a row ascend */
          double v = 0.0, unused = 0.0, *size = row == 0 ? &k : &unused;
          if (first) v += part(a, sim->invMassA, sim->invIA, p->anchorA, along, -1.0, &end, size);
          v += part(b, sim->invMassB, sim->invIB, p->anchorB, along, 1.0, &end, size);
          if (!first) v += part(a, sim->invMassA, sim->invIA, p->anchorA, along, -1.0, &end, size);
          if (row == 0 && push && s <= 0.0f) {
            target = fmin(-soft.biasRate * s, context->world->contactSpeed / soft.massScale);
            theta = k * soft.impulseScale / soft.massScale;
          }
          run.b[2 * block + row] = (row == 0 ? target : 0.0) - v;
          run.theta[2 * block + row] = row == 0 ? theta : 0.0;
          run.ptr[2 * block + row + 1] = end;
        }
        run.impulse[2 * block] = p->normalImpulse;
        run.impulse[2 * block + 1] = p->tangentImpulse;
        run.mu[block] = sim->friction;
        run.kind[block] = LAV_CONTACT;
        run.block_ptr[block + 1] = 2 * block + 2;
      }
    }
  }
}

static void set_problem(b2StepContext *context, int push) {
  int contacts = 0, bodies = context->world->solverSets.data[b2_awakeSet].bodySims.count;
  for (int c = 0; c < B2_GRAPH_COLOR_COUNT; ++c)
    for (int i = 0; i < context->graph->colors[c].contactSims.count; ++i)
      contacts += context->graph->colors[c].contactSims.data[i].manifold.pointCount;
  run.n_contacts = contacts;
  run.n_bodies = bodies;
  if (contacts == 0) return;
  run.ptr[0] = run.block_ptr[0] = run.mass_ptr[0] = 0;
  for (int i = 0; i < bodies; ++i)
    for (int j = 0; j < 3; ++j) {
      float inverse = j < 2 ? context->sims[i].invMass : context->sims[i].invInertia;
      if (inverse == 0.0f) {
        fprintf(stderr, "bodies that are awake and cannot move are not in this adapter\n");
        exit(1);
      }
      run.mass[3 * i + j] = 1.0 / inverse;
      run.mass_index[3 * i + j] = 3 * i + j;
      run.mass_ptr[3 * i + j + 1] = 3 * i + j + 1;
      run.velocity[3 * i + j] = j == 0   ? run.before[i].linearVelocity.x
                                : j == 1 ? run.before[i].linearVelocity.y
                                         : run.before[i].angularVelocity;
    }
  each_contact(context, push, 0);

  lav_problem p;
  lav_options o;
  check(lav_default_problem(LAV_VELOCITIES, &p), "problem");
  check(lav_default_options(run.method, &o), "method");
  p.n_blocks = contacts, p.n_rows = 2 * contacts, p.n_velocities = p.n_mass_entries = 3 * bodies;
  p.n_entries = run.ptr[2 * contacts];
  p.block_ptr = run.block_ptr, p.kind = run.kind, p.mu = run.mu, p.b = run.b, p.velocity = run.velocity;
  p.compliance = run.theta, p.impulse = run.impulse;
  p.index_ptr = run.ptr, p.index = run.column, p.value = run.value;
  p.mass_ptr = run.mass_ptr, p.mass_index = run.mass_index, p.mass_value = run.mass;
  int32_t code = run.solver == NULL ? LAV_ERROR_WORKSPACE : lav_set(run.solver, &p);
  while (code == LAV_ERROR_WORKSPACE || code == LAV_ERROR_COUNT) {  /* more contacts than before, or another fill */
    uint64_t bytes = 0, asked = run.solver == NULL ? 0 : lav_needed(run.solver);
    check(lav_room(&p, &o, &bytes), "room");
    run.bytes = 2 * (bytes > asked ? bytes : asked);
    run.memory = more(run.memory, run.bytes);
    check(lav_open(run.memory, run.bytes, &p, &o, &run.solver), "open");
    code = lav_set(run.solver, &p);
  }
  check(code, "problem");
}

static void solve(b2StepContext *context, int push) {
  lav_budget budget;
  lav_result result = {.size = sizeof result};
  set_problem(context, push);
  if (run.n_contacts == 0) return;
  check(lav_default_budget(&budget), "budget");
  budget.iterations = run.iterations;
  check(lav_run(run.solver, &budget, &result), "solve");
  run.counts.solves += 1;
  run.counts.missed += result.verdict.relative > budget.tol;
  check(lav_impulse(run.solver, run.impulse, 2 * run.n_contacts), "impulse");
  check(lav_velocity(run.solver, run.after, 3 * run.n_bodies), "velocity");
  each_contact(context, push, 1);
  for (int i = 0; i < run.n_bodies; ++i) {
    context->states[i].linearVelocity = (b2Vec2){(float)run.after[3 * i], (float)run.after[3 * i + 1]};
    context->states[i].angularVelocity = (float)run.after[3 * i + 2];
  }
}

void begin(int ours, int method, int iterations) {
  run.ours = ours, run.method = method, run.iterations = iterations;
  run.solver = NULL;
  run.counts = (struct counts){0};
}

struct counts step(b2WorldId id, float dt, int substeps, lav_verdict *verdict) {
  b2ConstraintGraph *graph = &b2GetWorldFromId(id)->constraintGraph;
  run.counts = (struct counts){0};
  run.substep = run.n_contacts = 0;
  double since = seconds();
  b2World_Step(id, dt, substeps);
  run.counts.seconds = seconds() - since - run.counts.measuring;
  *verdict = (lav_verdict){.size = sizeof(lav_verdict), .worst = -1};
  if (run.n_contacts == 0) return run.counts;
  int n = 0; /* as Box2D keeps them */
  for (int c = 0; c < B2_GRAPH_COLOR_COUNT; ++c)
    for (int i = 0; i < graph->colors[c].contactSims.count; ++i)
      for (int j = 0; j < graph->colors[c].contactSims.data[i].manifold.pointCount; ++j) {
        const b2ManifoldPoint *p = graph->colors[c].contactSims.data[i].manifold.points + j;
        run.impulse[n++] = p->normalImpulse;
        run.impulse[n++] = p->tangentImpulse;
      }
  check(lav_judge(run.solver, run.impulse, n, NULL, NULL, verdict), "judge");
  return run.counts;
}

/* -- what the linker puts in the place of Box2D's contact solver -------------------------------------------------- */

#define BOX2D(name, parameters, arguments) \
  void __real_##name parameters;           \
  void __wrap_##name parameters {          \
    if (!run.ours) __real_##name arguments; \
  }

BOX2D(b2PrepareContactsTask, (b2SolverBlock block, b2StepContext *context), (block, context))
BOX2D(b2WarmStartContactsTask, (b2SolverBlock block, b2StepContext *context), (block, context))
BOX2D(b2SolveContactsTask, (b2SolverBlock block, b2StepContext *context, bool push), (block, context, push))
BOX2D(b2ApplyRestitutionTask, (b2SolverBlock block, b2StepContext *context), (block, context))
BOX2D(b2StoreImpulsesTask, (b2SolverBlock block, b2StepContext *context, int worker), (block, context, worker))
BOX2D(b2PrepareContacts_Overflow, (b2StepContext *context), (context))
BOX2D(b2ApplyRestitution_Overflow, (b2StepContext *context), (context))
BOX2D(b2StoreImpulses_Overflow, (b2StepContext *context), (context))

void __real_b2WarmStartContacts_Overflow(b2StepContext *context);
void __wrap_b2WarmStartContacts_Overflow(b2StepContext *context) { /* velocities are integrated: v* */
  double since = seconds();
  b2SolverSet *awake = context->world->solverSets.data + b2_awakeSet;
  int points = 0;
  for (int c = 0; c < B2_GRAPH_COLOR_COUNT; ++c) points += 2 * context->graph->colors[c].contactSims.count;
  make_room(points, awake->bodySims.count);
  memcpy(run.before, context->states, (size_t)awake->bodySims.count * sizeof(b2BodyState));
  run.substep += 1;
  if (run.ours) return;
  run.counts.measuring += seconds() - since;
  __real_b2WarmStartContacts_Overflow(context);
}

void __real_b2SolveContacts_Overflow(b2StepContext *context, bool push);
void __wrap_b2SolveContacts_Overflow(b2StepContext *context, bool push) {
  if (run.ours) {
    solve(context, push);
    return;
  }
  if (!push && run.substep == context->subStepCount) {
    double since = seconds();
    set_problem(context, 0);
    run.counts.measuring += seconds() - since;
  }
  __real_b2SolveContacts_Overflow(context, push);
}
