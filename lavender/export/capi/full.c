
#ifndef LAV_SWEEPS_ONLY
/* -- islands ---------------------------------------------------------------------------------------------------------- */

int32_t lav_islands(lav_solver *solver, int32_t *label, int32_t n) {
  lav_solver *s = solver;
  int32_t i;
  GIVE_BACK(enter(s));
  if (!s->ready) return leave(s, LAV_ERROR_NO_PROBLEM);
  if (n != s->p.n_blocks) return leave(s, LAV_ERROR_COUNT);
  if (n == 0) return leave(s, 0);
  if (!label) return leave(s, LAV_ERROR_NULL);
  for (i = 0; i < n; i++) label[i] = s->p.islands ? s->islands.label[i] : 0;
  return leave(s, s->p.islands ? s->islands.n : 1);
}

/* -- the engine ------------------------------------------------------------------------------------------------------- */

typedef struct image_t { /* It is followed by 10 sizes, reals, int32 (padded to 8 bytes), keys. */
  uint64_t magic, hash;
} image_t;

struct lav_engine {
  uint64_t magic;
  int32_t size[10], count[3];
  double *real;
  int32_t *index;
  uint64_t *keys;
};

static const uint64_t IMAGE = 0x31474D4956414Cu; /* "LAVIMG1" */

static uint64_t image_bytes_of(const int32_t *count) {
  return sizeof(image_t) + 40 + 8 * (uint64_t)count[0] + 4 * (((uint64_t)count[1] + 1) / 2 * 2) + 8 * (uint64_t)count[2];
}

static int32_t read_image(const void *image, uint64_t bytes, int32_t *size, int32_t *count) {
  const unsigned char *at = (const unsigned char *)image;
  image_t head;
  int32_t i;
  if (!image) return LAV_ERROR_NULL;
  if (bytes < sizeof head + 40) return LAV_ERROR_COUNT;
  memcpy(&head, at, sizeof head);
  if (head.magic != IMAGE) return LAV_ERROR_VERSION;
  memcpy(size, at + sizeof head, 40);
  for (i = 0; i < 10; i++)
    if (size[i] < 0) return LAV_ERROR_COUNT;
  k_engine_lengths(size, count);
  if (count[0] < 0 || count[1] < 0 || count[2] < 0 || image_bytes_of(count) != bytes) return LAV_ERROR_COUNT;
  return hash_bytes(at + sizeof head, bytes - sizeof head, 0) == head.hash ? LAV_OK : LAV_ERROR_NUMBER;
}

int32_t lav_engine_workspace_size(const void *image, uint64_t image_bytes, uint64_t *bytes) {
  int32_t size[10], count[3];
  if (!bytes) return LAV_ERROR_NULL;
  GIVE_BACK(read_image(image, image_bytes, size, count));
  *bytes = sizeof(lav_engine) + image_bytes + 64;
  return LAV_OK;
}

int32_t lav_engine_open(void *memory, uint64_t bytes, const void *image, uint64_t image_bytes, lav_engine **out) {
  const unsigned char *at;
  lav_engine *e;
  int32_t size[10], count[3];
  uint64_t skip;
  if (!memory || !out) return LAV_ERROR_NULL;
  GIVE_BACK(read_image(image, image_bytes, size, count));
  skip = (16 - (uintptr_t)memory % 16) % 16;
  if (bytes < skip + sizeof *e + image_bytes) return LAV_ERROR_WORKSPACE;
  e = (lav_engine *)(void *)((char *)memory + skip);
  e->magic = IMAGE;
  memcpy(e->size, size, sizeof size);
  memcpy(e->count, count, sizeof count);
  e->real = (double *)(void *)(e + 1);
  e->keys = (uint64_t *)(void *)(e->real + count[0]);
  e->index = (int32_t *)(void *)(e->keys + count[2]);
  at = (const unsigned char *)image + sizeof(image_t) + 40;
  memcpy(e->real, at, 8 * (size_t)count[0]);
  at += 8 * (size_t)count[0];
  memcpy(e->index, at, 4 * (size_t)count[1]);
  at += 4 * (((size_t)count[1] + 1) / 2 * 2);
  memcpy(e->keys, at, 8 * (size_t)count[2]);
  *out = e;
  return LAV_OK;
}

int32_t lav_engine_step(lav_engine *engine, int32_t substeps, double *values) {
  int32_t done, status;
  if (!engine) return LAV_ERROR_NULL;
  if ((uintptr_t)engine % 8 != 0 || engine->magic != IMAGE) return LAV_ERROR_SOLVER;
  if (substeps < 0) return LAV_ERROR_COUNT;
  status = k_engine_substeps(engine->size, engine->real, engine->index, engine->keys, substeps, &done);
  if (values) k_engine_values(engine->size, engine->real, engine->index, engine->keys, values);
  return status == 0 ? LAV_OK : status == 1 ? LAV_ERROR_WORKSPACE : LAV_ERROR_NUMBER;
}

int32_t lav_engine_image(lav_engine *engine, void *out, uint64_t out_bytes, uint64_t *bytes) {
  lav_engine *e = engine;
  int32_t size[10], count[3];
  unsigned char *at;
  image_t head;
  if (!e || !bytes) return LAV_ERROR_NULL;
  if ((uintptr_t)e % 8 != 0 || e->magic != IMAGE) return LAV_ERROR_SOLVER;
  k_engine_grow_workspace(e->size, e->real, e->index, e->keys, size);
  k_engine_lengths(size, count);
  if (count[0] < 0 || count[1] < 0 || count[2] < 0) return LAV_ERROR_COUNT;
  *bytes = image_bytes_of(count);
  if (!out) return LAV_OK; /* Only the size is requested. */
  if ((uintptr_t)out % 8 != 0 || out_bytes < *bytes) return LAV_ERROR_WORKSPACE;
  memset(out, 0, (size_t)*bytes);
  at = (unsigned char *)out + sizeof(image_t);
  memcpy(at, size, 40);
  {
    double *real = (double *)(void *)(at + 40);
    int32_t *index = (int32_t *)(void *)(real + count[0]);
    uint64_t *keys = (uint64_t *)(void *)(index + (count[1] + 1) / 2 * 2);
    int32_t i, same = 1;
    for (i = 0; i < 10; i++) same = same && size[i] == e->size[i];
    if (same) {
      memcpy(real, e->real, 8 * (size_t)count[0]);
      memcpy(index, e->index, 4 * (size_t)count[1]);
      memcpy(keys, e->keys, 8 * (size_t)count[2]);
    } else k_engine_move(e->size, e->real, e->index, e->keys, size, real, index, keys);
  }
  head.magic = IMAGE;
  head.hash = hash_bytes(at, *bytes - sizeof head, 0);
  memcpy(out, &head, sizeof head);
  return LAV_OK;
}

int32_t lav_engine_places(const lav_engine *engine, int32_t *n_bodies, double *out, int32_t n) {
  int32_t at[80], i, k;
  if (!engine || !n_bodies) return LAV_ERROR_NULL;
  if ((uintptr_t)engine % 8 != 0 || engine->magic != IMAGE) return LAV_ERROR_SOLVER;
  *n_bodies = engine->size[0];
  if (!out) return LAV_OK;
  if (n != 7 * engine->size[0]) return LAV_ERROR_COUNT;
  k_engine_offsets(engine->size, engine->real, engine->index, engine->keys, at);
  for (i = 0; i < engine->size[0]; i++) {
    for (k = 0; k < 3; k++) out[7 * i + k] = engine->real[at[1] + 3 * i + k];
    for (k = 0; k < 4; k++) out[7 * i + 3 + k] = engine->real[at[2] + 4 * i + k];
  }
  return LAV_OK;
}

#else
int32_t lav_islands(lav_solver *solver, int32_t *label, int32_t n) { return !solver || (!label && n > 0) ? LAV_ERROR_NULL : LAV_ERROR_UNSUPPORTED; }
int32_t lav_engine_workspace_size(const void *image, uint64_t image_bytes, uint64_t *bytes) { return image && image_bytes && bytes ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_open(void *memory, uint64_t bytes, const void *image, uint64_t image_bytes, lav_engine **out) { return memory && bytes && image && image_bytes && out ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_step(lav_engine *engine, int32_t substeps, double *values) { return engine || values || substeps ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_image(lav_engine *engine, void *out, uint64_t out_bytes, uint64_t *bytes) { return engine || out || out_bytes || bytes ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_places(const lav_engine *engine, int32_t *n_bodies, double *out, int32_t n) { return engine || n_bodies || out || n ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
#endif

/* -- self-test: compare this build with the bits of the package ------------------------------------------------------- */

enum { TEST_BODIES = 3, TEST_CONTACTS = 12 };
static const uint64_t TEST_HASH = 0x55045c0a444e3c2cu;

int32_t lav_self_test(void) {
  static const double side[4][2] = {{-0.5, -0.5}, {0.5, -0.5}, {-0.5, 0.5}, {0.5, 0.5}};
  double inv_mass[TEST_BODIES], inv_inertia[9 * TEST_BODIES], velocity[6 * TEST_BODIES], normal[3 * TEST_CONTACTS],
      tangent[3 * TEST_CONTACTS], arm_a[3 * TEST_CONTACTS], arm_b[3 * TEST_CONTACTS], mu[TEST_CONTACTS],
      impulse[3 * TEST_CONTACTS], workspace[5200];
  int32_t ptr[TEST_CONTACTS + 1], kind[TEST_CONTACTS], body[2 * TEST_CONTACTS], i, c, k;
  lav_problem q;
  lav_options options;
  lav_budget budget;
  lav_result result;
  lav_solver *s;
  if (sizeof(double) != 8 || FLT_EVAL_METHOD != 0) return LAV_ERROR_SELF_TEST;
  memset(inv_inertia, 0, sizeof inv_inertia);
  for (i = 0; i < TEST_BODIES; i++) {
    inv_mass[i] = 1.0 / (1.0 + 0.3 * i);
    for (k = 0; k < 3; k++) inv_inertia[9 * i + 4 * k] = (6.0 + 0.1 * k) * inv_mass[i];
    for (k = 0; k < 6; k++) velocity[6 * i + k] = 0.01 * (k + 1) / (i + 3);
    velocity[6 * i + 2] = -9.81 / 60.0;
  }
  for (c = 0; c < TEST_CONTACTS; c++) {
    i = c / 4;
    ptr[c] = 3 * c;
    kind[c] = LAV_CONTACT;
    body[2 * c] = i - 1;
    body[2 * c + 1] = i;
    mu[c] = 0.1 + 0.05 * c;
    for (k = 0; k < 3; k++) {
      normal[3 * c + k] = k == 2;
      tangent[3 * c + k] = k == 0 ? 0.6 : k == 1 ? 0.8 : 0.0;
      arm_a[3 * c + k] = i == 0 ? 0.0 : k == 2 ? 0.5 : side[c % 4][k];
      arm_b[3 * c + k] = k == 2 ? -0.5 : side[c % 4][k];
    }
  }
  ptr[TEST_CONTACTS] = 3 * TEST_CONTACTS;
  lav_default_problem(LAV_BODIES, &q);
  lav_default_options(LAV_SEQUENTIAL_IMPULSES, &options);
  lav_default_budget(&budget);
  q.n_blocks = TEST_CONTACTS, q.n_rows = 3 * TEST_CONTACTS, q.n_bodies = TEST_BODIES;
  q.block_ptr = ptr, q.kind = kind, q.mu = mu, q.velocity = velocity, q.inv_mass = inv_mass, q.inv_inertia = inv_inertia;
  q.contact_body = body, q.normal = normal, q.tangent = tangent, q.arm_a = arm_a, q.arm_b = arm_b;
  result.size = (uint32_t)sizeof result;
  budget.iterations = 40;
  budget.tol = 0.0;
  GIVE_BACK(lav_open(workspace, sizeof workspace, &q, &options, &s));
  GIVE_BACK(lav_set(s, &q));
  GIVE_BACK(lav_run(s, &budget, &result));
  GIVE_BACK(lav_impulse(s, impulse, 3 * TEST_CONTACTS));
  return lav_hash(impulse, 3 * TEST_CONTACTS, lav_hash(&result.verdict.relative, 1, 0)) == TEST_HASH ? LAV_OK
                                                                                                     : LAV_ERROR_SELF_TEST;
}
