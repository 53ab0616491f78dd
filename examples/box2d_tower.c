/* Box2D v3 with the solver of its step replaced: its contacts as J and M to liblavender, impulses and velocities back.
 *
 *     lavender export c out
 *     cc -std=gnu17 -O2 -I out -I BOX2D/include -I BOX2D/src examples/box2d_tower.c out/lavender.c BOX2D/src/[!p]*.c \
 *        BOX2D/src/p*.c -lm -lpthread -o tower && ./tower [newton | anderson | pgs] [boxes] [steps]
 *
 * BOX2D is your own copy of its source (github.com/erincatto/box2d, tried with 3.2); nothing of it is in this project.
 *
 * Two towers of the same boxes. In one Box2D steps as it does, with 4 sub-steps. In the other Box2D finds the contacts (a
 * step of no length), liblavender solves them, and velocities and places are handed back. Each is judged on the problem of
 * its own step. Box2D's impulses are those it reports: of normals the sum over its sub-steps, of tangents the last
 * sub-step's times their number; it does not try to solve a step to the end, as the residual says.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "box2d/box2d.h"
#include "lavender.h"

enum { SUBSTEPS = 4, MOST = 64, POINTS = 4 * MOST };
static const float DT = 1.0f / 60.0f, GRAVITY = -10.0f, FRICTION = 0.6f;

typedef struct tower_t {
  b2WorldId world;
  b2BodyId body[MOST];
  int n;
  double v[3 * MOST]; /* m/s, m/s, rad/s: ours, in double */
} tower_t;

typedef struct step_t { /* contacts of a step as J and M */
  int32_t c, ptr[POINTS + 1], kind[POINTS], row_ptr[2 * POINTS + 1], column[12 * POINTS], mass_ptr[3 * MOST + 1],
      mass_column[3 * MOST];
  uint64_t key[POINTS];
  double jac[12 * POINTS], mass[3 * MOST], mu[POINTS], target[2 * POINTS], v[3 * MOST], theirs[2 * POINTS];
} step_t;

static double seconds(void *nothing) {
  struct timespec t;
  (void)nothing;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void check(int32_t code) {
  if (code < 0) fprintf(stderr, "lavender: %s\n", lav_text(code)), exit(1);
}

static void build(tower_t *t, int n) {
  b2WorldDef world = b2DefaultWorldDef();
  b2BodyDef ground = b2DefaultBodyDef();
  b2ShapeDef shape = b2DefaultShapeDef();
  const b2Polygon floor_ = b2MakeBox(50.0f, 1.0f), box = b2MakeBox(0.5f, 0.5f);
  world.gravity = (b2Vec2){0.0f, GRAVITY};
  world.enableSleep = false;
  shape.material.friction = FRICTION;
  memset(t, 0, sizeof *t);
  t->world = b2CreateWorld(&world);
  t->n = n;
  ground.position.y = -1.0f;
  b2CreatePolygonShape(b2CreateBody(t->world, &ground), &shape, &floor_);
  for (int i = 0; i < n; i++) {
    b2BodyDef def = b2DefaultBodyDef();
    def.type = b2_dynamicBody;
    def.position.x = 0.02f * (float)(i % 3);
    def.position.y = 0.5f + 1.0f * (float)i;
    def.userData = (void *)(intptr_t)(i + 1);
    t->body[i] = b2CreateBody(t->world, &def);
    b2CreatePolygonShape(t->body[i], &shape, &box);
  }
}

static int number_of(b2ShapeId shape) { return (int)(intptr_t)b2Body_GetUserData(b2Shape_GetBody(shape)) - 1; }

/* One row: velocity of b minus that of a at the point, along an axis. */
static void put_row(step_t *s, int32_t row, int a, int b, b2Vec2 axis, b2Vec2 ra, b2Vec2 rb) {
  const int bodies[2] = {a < b ? a : b, a < b ? b : a};
  int32_t at = s->row_ptr[row];
  for (int side = 0; side < 2; side++) {
    const int i = bodies[side];
    const double sign = i == b ? 1.0 : -1.0;
    const b2Vec2 r = i == b ? rb : ra;
    if (i < 0) continue;
    for (int k = 0; k < 3; k++) s->column[at + k] = 3 * i + k;
    s->jac[at] = sign * axis.x, s->jac[at + 1] = sign * axis.y;
    s->jac[at + 2] = sign * ((double)r.x * axis.y - (double)r.y * axis.x);
    at += 3;
  }
  s->row_ptr[row + 1] = at;
}

/* What Box2D touches now, and the velocities without contact impulses. */
static void read_step(tower_t *t, step_t *s, int ours) {
  s->c = 0;
  s->row_ptr[0] = s->ptr[0] = 0;
  for (int i = 0; i < t->n; i++) {
    const b2Vec2 v = b2Body_GetLinearVelocity(t->body[i]);
    const double now[3] = {v.x, v.y, b2Body_GetAngularVelocity(t->body[i])};
    for (int k = 0; k < 3; k++) s->v[3 * i + k] = ours ? t->v[3 * i + k] : now[k];
    s->v[3 * i + 1] += (double)GRAVITY * DT;
    for (int k = 0; k < 3; k++) {
      s->mass_ptr[3 * i + k] = s->mass_column[3 * i + k] = 3 * i + k;
      s->mass[3 * i + k] = k < 2 ? b2Body_GetMass(t->body[i]) : b2Body_GetRotationalInertia(t->body[i]);
    }
  }
  s->mass_ptr[3 * t->n] = 3 * t->n;
  for (int i = 0; i < t->n; i++) {
    b2ContactData data[16];
    const int count = b2Body_GetContactData(t->body[i], data, 16);
    for (int q = 0; q < count; q++) {
      const int a = number_of(data[q].shapeIdA), b = number_of(data[q].shapeIdB);
      const b2Manifold *m = &data[q].manifold;
      const b2Vec2 tangent = {m->normal.y, -m->normal.x};
      if (i != (a >= 0 ? a : b)) continue; /* each once */
      for (int p = 0; p < m->pointCount && s->c < POINTS; p++) {
        const b2ManifoldPoint *point = &m->points[p];
        const int32_t c = s->c++;
        s->kind[c] = LAV_CONTACT, s->mu[c] = FRICTION, s->ptr[c + 1] = 2 * c + 2;
        s->key[c] = ((uint64_t)data[q].shapeIdA.index1 << 40) ^ ((uint64_t)data[q].shapeIdB.index1 << 16) ^ point->id;
        put_row(s, 2 * c, a, b, m->normal, point->anchorA, point->anchorB);
        put_row(s, 2 * c + 1, a, b, tangent, point->anchorA, point->anchorB);
        /* a gap may close, a depth beyond the slop of 5 mm is pushed out by a fifth a step */
        s->target[2 * c] = point->separation > 0.0f ? -point->separation / DT
                           : point->separation < -0.005f ? 0.2 * (-point->separation - 0.005) / DT : 0.0;
        s->target[2 * c + 1] = 0.0;
        s->theirs[2 * c] = point->totalNormalImpulse;
        s->theirs[2 * c + 1] = SUBSTEPS * (double)point->tangentImpulse;
      }
    }
  }
}

static lav_problem problem_of(const tower_t *t, const step_t *s) {
  lav_problem q;
  check(lav_default_problem(LAV_VELOCITIES, &q));
  q.n_blocks = s->c, q.n_rows = 2 * s->c, q.n_velocities = 3 * t->n, q.n_entries = s->row_ptr[2 * s->c];
  q.n_mass_entries = 3 * t->n, q.block_ptr = s->ptr, q.kind = s->kind, q.mu = s->mu, q.key = s->key, q.target = s->target;
  q.velocity = s->v, q.index_ptr = s->row_ptr, q.index = s->column, q.value = s->jac;
  q.mass_ptr = s->mass_ptr, q.mass_index = s->mass_column, q.mass_value = s->mass;
  return q;
}

/* A solver in memory of our own that grows when a problem asks for more. */
static void set(lav_solver **solver, const lav_problem *q, const lav_options *options) {
  uint64_t bytes;
  int32_t code = *solver ? lav_set(*solver, q) : LAV_ERROR_ROOM;
  while (code == LAV_ERROR_ROOM) {
    check(lav_room(q, options, &bytes));
    if (*solver && lav_needed(*solver) > bytes) bytes = lav_needed(*solver);
    bytes = 2 * bytes;
    check(lav_open(malloc(bytes), bytes, q, options, solver)); /* the old memory is left: towers grow twice at most */
    code = lav_set(*solver, q);
  }
  check(code);
}

int main(int count, char **words) {
  const char *method = count > 1 ? words[1] : "newton";
  const int n = count > 2 ? atoi(words[2]) : 12, steps = count > 3 ? atoi(words[3]) : 300;
  static tower_t theirs, ours;
  static step_t step;
  lav_options options, judging;
  lav_budget budget;
  lav_result result;
  lav_verdict verdict;
  lav_solver *solver = NULL, *judge = NULL;
  double time[2] = {0.0, 0.0}, worst[2] = {0.0, 0.0}, sum[2] = {0.0, 0.0}, depth[2] = {0.0, 0.0}, begin;
  check(lav_self_test());
  check(lav_default_options(strcmp(method, "pgs") == 0 ? LAV_PGS : strcmp(method, "anderson") == 0 ? LAV_ANDERSON : LAV_NEWTON,
                            &options));
  check(lav_default_options(LAV_PGS, &judging));
  check(lav_default_budget(&budget));
  budget.tol = 1e-6;
  if (n < 1 || n > MOST) return fprintf(stderr, "1 to %d boxes\n", MOST), 2;
  build(&theirs, n);
  build(&ours, n);
  memset(&result, 0, sizeof result);
  result.size = sizeof result, verdict.size = sizeof verdict;
  for (int k = 0; k < steps; k++) {
    lav_problem q;
    b2World_Step(theirs.world, 0.0f, SUBSTEPS); /* contacts of where the bodies are; nobody moves */
    read_step(&theirs, &step, 0);
    {
      static step_t before;
      before = step;
      begin = seconds(NULL);
      b2World_Step(theirs.world, DT, SUBSTEPS);
      time[0] += seconds(NULL) - begin;
      read_step(&theirs, &step, 0); /* the impulses, by key, on the problem of before */
      for (int32_t c = 0; c < before.c; c++) {
        before.theirs[2 * c] = before.theirs[2 * c + 1] = 0.0;
        for (int32_t i = 0; i < step.c; i++)
          if (step.key[i] == before.key[c]) memcpy(before.theirs + 2 * c, step.theirs + 2 * i, 2 * sizeof(double));
      }
      q = problem_of(&theirs, &before);
      set(&judge, &q, &judging);
      check(lav_judge(judge, before.theirs, q.n_rows, NULL, NULL, &verdict));
      sum[0] += verdict.relative;
      if (verdict.relative > worst[0]) worst[0] = verdict.relative;
    }
    begin = seconds(NULL);
    b2World_Step(ours.world, 0.0f, SUBSTEPS);
    read_step(&ours, &step, 1);
    q = problem_of(&ours, &step);
    set(&solver, &q, &options);
    check(lav_run(solver, &budget, &result));
    check(lav_velocity(solver, ours.v, 3 * n));
    for (int i = 0; i < n; i++) {
      const double *v = ours.v + 3 * i;
      const b2Pos p = b2Body_GetPosition(ours.body[i]);
      const b2Rot r = b2Body_GetRotation(ours.body[i]);
      b2Body_SetTransform(ours.body[i], (b2Pos){p.x + (float)(DT * v[0]), p.y + (float)(DT * v[1])},
                          b2IntegrateRotation(r, (float)(DT * v[2])));
    }
    time[1] += seconds(NULL) - begin;
    sum[1] += result.verdict.relative;
    if (result.verdict.relative > worst[1]) worst[1] = result.verdict.relative;
  }
  for (int side = 0; side < 2; side++) {
    tower_t *t = side ? &ours : &theirs;
    const b2Pos top = b2Body_GetPosition(t->body[n - 1]);
    b2World_Step(t->world, 0.0f, SUBSTEPS);
    read_step(t, &step, side);
    for (int i = 0; i < t->n; i++) {
      b2ContactData data[16];
      const int found = b2Body_GetContactData(t->body[i], data, 16);
      for (int c = 0; c < found; c++)
        for (int p = 0; p < data[c].manifold.pointCount; p++)
          if (-data[c].manifold.points[p].separation > depth[side]) depth[side] = -data[c].manifold.points[p].separation;
    }
    printf("%-22s residual mean %.1e, worst %.1e; deepest %.2f mm; top at (%.3f, %.3f) m; %.1f us a step\n",
           side ? lav_name(options.method) : "Box2D, 4 sub-steps", sum[side] / steps, worst[side], 1e3 * depth[side], top.x,
           top.y, 1e6 * time[side] / steps);
  }
  return 0;
}
