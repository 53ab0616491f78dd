/* Scenes of a data file stepped through lavender.h: one line for each, with a hash of every bit that was made.
 *
 *     scenes DATA        DATA is written by tests/export/parity/export.py: numbers of 8 bytes, arrays after their bytes
 *
 * A line is a hash, "same" or where the first bit differs from what the package made, and the scene. The hash runs over
 * the eight values of every step and over places and turns of all bodies after it.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lavender.h"

static FILE *file;

static void fail(const char *why) {
  fprintf(stderr, "%s\n", why);
  exit(2);
}

static void check(int32_t code) {
  if (code != LAV_OK) fail(lav_text(code));
}

static int64_t whole(void) {
  int64_t x;
  if (fread(&x, 8, 1, file) != 1) fail("the data file ends early");
  return x;
}

static void *workspace(uint64_t bytes) {
  void *at = calloc((size_t)bytes / 8 + 2, 8);
  if (!at) fail("no memory");
  return at;
}

static void *array(uint64_t *bytes) {
  const uint64_t n = (uint64_t)whole(), padded = (n + 7) / 8 * 8;
  void *at = workspace(n);
  if (padded > 0 && fread(at, (size_t)padded, 1, file) != 1) fail("the data file ends early");
  *bytes = n;
  return at;
}

static lav_engine *opened(void *memory[1], const void *image, uint64_t bytes) {
  lav_engine *engine;
  uint64_t needed;
  check(lav_engine_workspace_size(image, bytes, &needed));
  free(memory[0]);
  memory[0] = workspace(needed);
  check(lav_engine_open(memory[0], needed, image, bytes, &engine));
  return engine;
}

/* One substep; where its contacts outgrow the memory, in a larger one. */
static lav_engine *step(lav_engine *engine, void *memory[1], double *values) {
  int32_t code;
  while ((code = lav_engine_step(engine, 1, values)) == LAV_ERROR_WORKSPACE) {
    uint64_t bytes;
    void *image;
    check(lav_engine_image(engine, NULL, 0, &bytes));
    image = workspace(bytes);
    check(lav_engine_image(engine, image, bytes, &bytes));
    engine = opened(memory, image, bytes);
    free(image);
  }
  check(code);
  return engine;
}

/* Steps from each image to the next one. */
static void scene(void) {
  uint64_t bytes, hash = 0;
  char *name = (char *)array(&bytes);
  const int64_t substeps = whole(), images = whole();
  int64_t differs = 0, done = 0, i, k;
  void *memory[1] = {NULL};
  for (i = 0; i < images; i++) {
    void *image = array(&bytes);
    lav_engine *engine = opened(memory, image, bytes);
    uint64_t end;
    double *made = (double *)array(&end), *at = made, *own;
    int32_t n, bodies;
    free(image);
    check(lav_engine_places(engine, &bodies, NULL, 0));
    n = 8 + 7 * bodies; /* numbers of a step */
    own = (double *)workspace(8 * (uint64_t)n);
    for (; (uint64_t)((char *)at - (char *)made) < end; at += n) {
      for (k = 0; k < substeps; k++) engine = step(engine, memory, own);
      check(lav_engine_places(engine, &bodies, own + 8, n - 8));
      done += 1;
      if (!differs && memcmp(own, at, 8 * (size_t)n) != 0) differs = done;
      hash = lav_hash(own, n, hash);
    }
    free(own), free(made);
  }
  printf("%016llx  ", (unsigned long long)hash);
  if (differs) printf("step %lld", (long long)differs);
  else printf("same");
  printf("  %s\n", name);
  free(memory[0]), free(name);
}

int main(int count, char **words) {
  int64_t n;
  file = count > 1 ? fopen(words[1], "rb") : NULL;
  if (!file) fail("usage: scenes DATA");
  for (n = whole(); n > 0; n--) scene();
  return 0;
}
