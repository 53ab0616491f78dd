/* A tower of boxes in Box2D v3, once with its own contact solver and once with one of lavender.
 *
 *     tower [BOXES] [STEPS] [METHOD] [ITERATIONS]        (10 300 newton 100)
 */
#include "adapter.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { MOST = 200, SUBSTEPS = 4 };

double seconds(void) {
  struct timespec t;
  timespec_get(&t, TIME_UTC);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int compare(const void *a, const void *b) {
  double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static void tower(const char *who, int ours, int boxes, int steps, int method, int iterations) {
  b2WorldDef def = b2DefaultWorldDef();
  def.enableSleep = false;
  b2WorldId world = b2CreateWorld(&def);
  b2BodyDef ground = b2DefaultBodyDef();
  b2ShapeDef shape = b2DefaultShapeDef();
  b2Polygon floor = b2MakeOffsetBox(50.0f, 1.0f, (b2Vec2){0.0f, -1.0f}, b2Rot_identity), box = b2MakeBox(0.5f, 0.5f);
  b2CreatePolygonShape(b2CreateBody(world, &ground), &shape, &floor);
  b2BodyId top = b2_nullBodyId;
  for (int i = 0; i < boxes; ++i) {
    b2BodyDef body = b2DefaultBodyDef();
    body.type = b2_dynamicBody;
    body.position = (b2Vec2){i % 2 ? 0.02f : -0.02f, 0.5f + (float)i};
    top = b2CreateBody(world, &body);
    b2CreatePolygonShape(top, &shape, &box);
  }
  b2Vec2 first = b2Body_GetPosition(top);

  double *time = calloc((size_t)steps, sizeof(double)), *relative = calloc((size_t)steps, sizeof(double)), worst = 0.0;
  int solves = 0, missed = 0;
  begin(ours, method, iterations);
  for (int i = 0; i < steps; ++i) {
    lav_verdict verdict;
    struct counts c = step(world, 1.0f / 60.0f, SUBSTEPS, &verdict);
    time[i] = c.seconds, relative[i] = verdict.relative;
    worst = fmax(worst, verdict.velocity);
    solves += c.solves, missed += c.missed;
  }
  b2Vec2 last = b2Body_GetPosition(top);
  qsort(time, (size_t)steps, sizeof(double), compare);
  qsort(relative, (size_t)steps, sizeof(double), compare);
  printf("%-12s %9.1e %9.1e %12.1e %10.1f %10.2f %10.2f", who, relative[steps / 2], relative[steps - 1], worst,
         1e6 * time[steps / 2], 1e3 * (last.x - first.x), 1e3 * (last.y - first.y));
  printf(ours ? "   %d of %d solves above 1e-6\n" : "\n", missed, solves);
  free(time), free(relative);
  b2DestroyWorld(world);
}

int main(int n, char **words) {
  int boxes = n > 1 ? atoi(words[1]) : 10, steps = n > 2 ? atoi(words[2]) : 300, method = LAV_NEWTON;
  if (boxes < 1 || boxes > MOST || steps < 1) {
    fprintf(stderr, "1 to %d boxes and at least one step are needed\n", MOST);
    return 1;
  }
  if (n > 3)
    for (method = 1; lav_name(method) != NULL && strcmp(lav_name(method), words[3]) != 0;) ++method;
  if (lav_name(method) == NULL) {
    fprintf(stderr, "no method is called %s\n", words[3]);
    return 1;
  }
  check(lav_self_test(), "self test");
  printf("%d boxes, %d steps of 1/60 s in %d substeps; relative residual and error of the worst row in a step\n", boxes,
         steps, SUBSTEPS);
  printf("%-12s %9s %9s %12s %10s %10s %10s\n", "solver", "median", "worst", "worst m/s", "us a step", "side mm", "up mm");
  tower("Box2D", 0, boxes, steps, method, 0);
  tower(lav_name(method), 1, boxes, steps, method, n > 4 ? atoi(words[4]) : 100);
  return 0;
}
