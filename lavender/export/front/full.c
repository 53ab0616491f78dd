
#ifndef LAV_SWEEPS_ONLY
/* -- accelerated sweeps ----------------------------------------------------------------------------------------------- */

enum { PACK_ACCELERATED = 16 };

static int32_t prepare_accelerated(lav_solver *s) {
  const int32_t rubs = core_block_has_friction(&s->p), is_cone = s->p.law == LAV_CONE && rubs;
  const int32_t memory = s->options.method == LAV_NNCG ? 0 : s->options.memory;
  const int64_t m = s->p.n_rows, work = 3 * (m + s->n_v) + (1 + 2 * (int64_t)memory) * m + 1;
  double *x;
  memset(&s->fast, 0, sizeof s->fast);
  s->fast.exact = s->options.sweep == LAV_BLOCK_SWEEP || (s->options.sweep == LAV_DEFAULT_SWEEP && is_cone);
  s->fast.convex = rubs && !is_cone ? s->options.convex : 0;
  if (s->fast.exact || s->fast.convex > 0) {
    GIVE_BACK(prepare_blocks(s));
    s->fast.start = s->prepared_at;
    s->fast.g = s->prepared;
  }
  x = TAKE(s, double, CONTROL + GRAM + work);
  s->pair_room = NULL;
  s->pairs_asked = s->fast.exact || s->mode == core_order_RANDOM || s->form != LAV_BODIES || s->p.n_blocks < PACK_FROM ||
                   s->split != s->r.n_joints;
  if (!s->pairs_asked) s->pair_room = TAKE(s, double, sweep_packed_room_of(&s->p, &s->r));
  if (s->is_short) return LAV_ERROR_ROOM;
  memset(x, 0, (size_t)(CONTROL + GRAM + work) * sizeof(double));
  s->fast.control = x;
  s->fast.gram = x + CONTROL;
  s->fast.work = x + CONTROL + GRAM;
  s->fast.blocks = &s->p;
  s->fast.csr = s->form == LAV_BODIES ? NULL : &s->a;
  s->fast.rows = &s->r;
  s->fast.general = general_of(s);
  s->fast.cone = s->p;
  s->fast.cone.law = LAV_CONE;
  s->fast.order = s->order;
  s->fast.split = s->split;
  s->fast.mode = s->mode;
  s->fast.memory = memory;
  s->fast.keeps = s->options.keeps;
  s->fast.rng = &s->rng;
  s->fast.v = s->v;
  s->fast.nv = s->n_v;
  s->context = &s->fast;
  s->step = memory == 0 ? accelerate_accelerated_nncg_step : accelerate_accelerated_anderson_step;
  return LAV_OK;
}

/* Blocks in pairs, once sweeps are many: the same bits. */
static void pack_pairs(lav_solver *s, int32_t n) {
  if (s->pairs_asked || s->fast.turn + (int64_t)n < PACK_ACCELERATED) return;
  s->pairs_asked = 1;
  s->fast.backwards = 0;
  if (sweep_packed_pack_order(&s->p, &s->r, s->order, 1, s->pair_room, s->impulse, &s->pairs)) s->fast.packed = &s->pairs;
}

static int32_t restarts_of(const lav_solver *s) {
  return (int32_t)s->fast.control[s->fast.memory == 0 ? 1 : accelerate_mixing_UNDONE];
}

static int32_t begins_again(lav_solver *s) {
  if (s->options.method != LAV_ANDERSON && s->options.method != LAV_NNCG) return 0;
  if (!judge_watch_begins_again(&s->watch, AGAIN)) return 0;
  accelerate_accelerated_forget_all(&s->fast, s->impulse);
  return 1;
}

/* -- newton over velocities ------------------------------------------------------------------------------------------- */

enum { CLOCK = 64 };
static const double MOST_VALUES = 9e6, FLOP = 1e-10, LOOKED_UP = 20.0, WATCHED = 4.0, CLOSEST = 1e-2;

static int32_t prepare_newton(lav_solver *s) {
  struct generalized_islands_need_t need;
  int32_t per = generalized_sparse_PER_COLUMN, *marks;
  const uint64_t from = s->used;
  double *numbers;
  for (;; per *= 2) {
    s->used = from;
    marks = TAKE(s, int32_t, generalized_islands_marks_of(&s->p, &s->g, per));
    if (s->is_short) return LAV_ERROR_ROOM;
    generalized_islands_settle(&s->flow, &s->p, &s->g, per, marks, &need);
    if (!need.crowded || 2.0 * per * s->g.n > MOST_VALUES || 4 * per > s->g.n) break;
  }
  if (!(need.values <= MOST_VALUES)) return LAV_ERROR_UNSUPPORTED;
  numbers = TAKE(s, double, generalized_islands_numbers_of(&s->flow, &need));
  if (s->is_short) return LAV_ERROR_ROOM;
  generalized_islands_furnish(&s->flow, &need, numbers);
  s->doubt = need.wide;
  return LAV_OK;
}

static void run_newton(lav_solver *s, const lav_budget *budget, lav_result *out) {
  const int32_t islands = s->flow.n_islands > 1 ? s->flow.n_islands : 1;
  const double begin = budget->seconds > 0.0 ? budget->clock(budget->clock_data) : 0.0;
  const double wide = s->doubt, flops = s->g.n * (wide * wide) / 6.0;
  const int32_t coulomb = s->p.law == LAV_COULOMB && core_block_has_friction(&s->p);
  double slow = LOOKED_UP * FLOP * (coulomb ? 2.0 * flops : flops), share, closer = 1.0;
  int32_t steps, cold = 1, again = 0, wait = -1, end, done, i, same = 1;
  lav_verdict now;
  judge_measure_do_nothing(&s->p, s->watch.e, s->watch.w);
  for (i = 0; i < s->p.n_rows; i++) {
    if (s->impulse[i] != 0.0) cold = 0;
    if (s->impulse[i] != s->watch.e[i]) same = 0;
  }
  cold = cold || same;
  slow = slow > 1e-9 ? slow : 1e-9;
  share = islands * (WATCHED / slow < CLOCK ? WATCHED / slow : (double)CLOCK);
  steps = budget->seconds > 0.0 ? 1 : share > 1.0 ? (share < 2e9 ? (int32_t)share : 2000000000) : 1;
  while (out->iterations < budget->iterations && out->outcome == LAV_MAX_ITERATIONS) {
    if (steps > budget->iterations - out->iterations) steps = budget->iterations - out->iterations;
    wait = again ? s->flow.wait.island : -1;
    generalized_islands_aim_at(&s->flow, closer * budget->tol, steps, s->start[0], s->start[1]);
    s->flow.wait.island = wait;
    end = generalized_newton_descend_all(&s->flow, s->impulse, cold);
    done = steps - s->flow.steps;
    out->iterations += done;
    out->restarts += s->flow.factorisations;
    if (end == generalized_newton_DONE) {
      judge(s, s->impulse, 1, &now);
      out->outcome = now.relative <= budget->tol ? LAV_CONVERGED : closer > CLOSEST ? LAV_MAX_ITERATIONS : LAV_STALLED;
      closer *= 0.25;
      again = cold = 0;
    } else if (end == generalized_newton_SPENT) {
      again = 1;
      if (done <= 0) out->outcome = LAV_STALLED;
    } else out->outcome = end == generalized_newton_STUCK ? LAV_STALLED : end == generalized_newton_LOST ? LAV_DIVERGED : LAV_FAILED;
    if (out->outcome == LAV_MAX_ITERATIONS && budget->seconds > 0.0 &&
        !(budget->clock(budget->clock_data) - begin < budget->seconds))
      out->outcome = LAV_TIME_LIMIT;
  }
}

/* -- direct ----------------------------------------------------------------------------------------------------------- */

static int32_t prepare_direct(lav_solver *s) {
  const double inf = INFINITY;
  int32_t bands[2] = {0, 0}, i;
  double size[2] = {0.0, 0.0}, *x;
  if (s->p.n_rows > 0 && s->a.indptr[s->p.n_rows] > 0) core_csr_scan_entries(&s->a, s->p.n_rows, s->marks, bands, size);
  if (!(size[1] == 0.0 || size[0] / size[1] <= 1e-14)) return LAV_ERROR_UNSUPPORTED; /* not symmetric */
  s->band = bands[0] > bands[1] ? bands[0] : bands[1];
  s->view.p = s->p;
  s->view.a = &s->a;
  x = TAKE(s, double, few_pivots_pivots_real(&s->view, s->band));
  s->sides = TAKE(s, int32_t, few_pivots_pivots_index(&s->view));
  if (s->is_short) return LAV_ERROR_ROOM;
  few_pivots_lay_pivots(&s->trial, &s->view, x);
  s->trial.symmetric = 1;
  s->is_linear = 1;
  for (i = 0; i < s->p.n_blocks; i++)
    if (s->p.kind[i] != LAV_ROW) s->is_linear = 0;
  for (i = 0; i < s->p.n_rows; i++)
    if (s->p.lower[i] != -inf || s->p.upper[i] != inf) s->is_linear = 0;
  return LAV_OK;
}

static void run_direct(lav_solver *s, const lav_budget *budget, lav_result *out) {
  struct few_pivots_trial_t *t = &s->trial;
  t->linear = s->is_linear;
  t->e0 = s->start[0];
  t->v0 = s->start[1];
  t->tol = budget->tol > 0.0 ? budget->tol : INFINITY;
  few_pivots_begin_pivots(t, &s->a, &s->p, s->band, s->sides);
  out->outcome = LAV_FAILED;
  if (!few_pivots_pivot(t, s->impulse)) return;
  COPY(s->impulse, t->best, s->p.n_rows);
  out->outcome = LAV_CONVERGED;
  out->iterations = t->done;
  out->sweeps = t->swept ? 2 : 0;
  out->restarts = t->s.factorisations;
}

static int32_t prepare_full(lav_solver *s) {
  if (s->options.method == LAV_NEWTON) return prepare_newton(s);
  return s->options.method == LAV_DIRECT ? prepare_direct(s) : prepare_accelerated(s);
}

static void run_full(lav_solver *s, const lav_budget *budget, lav_result *out) {
  if (s->options.method == LAV_NEWTON) run_newton(s, budget, out);
  else run_direct(s, budget, out);
}

/* -- islands ---------------------------------------------------------------------------------------------------------- */

int32_t lav_islands(lav_solver *solver, int32_t *label, int32_t n) {
  lav_solver *s = solver;
  int32_t i, j, count, *parent, *first;
  GIVE_BACK(enter(s));
  if (!s->ready) return leave(s, LAV_ERROR_NO_PROBLEM);
  if (n != s->p.n_blocks) return leave(s, LAV_ERROR_COUNT);
  if (n == 0) return leave(s, 0);
  if (!label) return leave(s, LAV_ERROR_NULL);
  parent = s->marks;
  first = s->marks + n;
  if (s->form == LAV_VELOCITIES) count = k_tree_components(n, s->p.ptr, &s->g, parent, first, label);
  else if (s->form == LAV_BODIES) {
    int32_t *body = first + s->r.n_bodies;
    for (i = 0; i < 2 * s->r.n_joints; i++) body[i] = s->r.joint_body[i];
    for (i = 0; i < 2 * s->r.n_contacts; i++) body[2 * s->r.n_joints + i] = s->r.contact_body[i];
    count = k_body_components(n, body, s->r.n_bodies, parent, first, label);
  } else {
    for (i = 0; i < n; i++)
      for (j = s->p.ptr[i]; j < s->p.ptr[i + 1]; j++) first[j] = i;
    count = k_matrix_components(n, s->p.ptr, first, s->a.indptr, s->a.indices, parent, label);
  }
  return leave(s, count);
}

/* -- the engine ------------------------------------------------------------------------------------------------------- */

typedef struct image_t { /* then 10 sizes, reals, int32 (padded to 8 bytes), keys */
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

static uint64_t hash_bytes(const unsigned char *at, uint64_t bytes) {
  uint64_t h = 0, x;
  for (; bytes >= 8; at += 8, bytes -= 8) {
    memcpy(&x, at, 8);
    h = (h ^ x) * 0x9E3779B97F4A7C15u;
    h ^= h >> 29;
  }
  return h ^ h >> 32;
}

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
  return hash_bytes(at + sizeof head, bytes - sizeof head) == head.hash ? LAV_OK : LAV_ERROR_NUMBER;
}

int32_t lav_engine_room(const void *image, uint64_t image_bytes, uint64_t *bytes) {
  int32_t size[10], count[3];
  if (!bytes) return LAV_ERROR_NULL;
  GIVE_BACK(read_image(image, image_bytes, size, count));
  *bytes = sizeof(lav_engine) + image_bytes + 64;
  return LAV_OK;
}

int32_t lav_engine_open(void *memory, uint64_t bytes, const void *image, uint64_t image_bytes, lav_engine **out) {
  const unsigned char *at = (const unsigned char *)image + sizeof(image_t) + 40;
  lav_engine *e;
  int32_t size[10], count[3];
  uint64_t skip;
  if (!memory || !out) return LAV_ERROR_NULL;
  GIVE_BACK(read_image(image, image_bytes, size, count));
  skip = (16 - (uintptr_t)memory % 16) % 16;
  if (bytes < skip + sizeof *e + image_bytes) return LAV_ERROR_ROOM;
  e = (lav_engine *)(void *)((char *)memory + skip);
  e->magic = IMAGE;
  memcpy(e->size, size, sizeof size);
  memcpy(e->count, count, sizeof count);
  e->real = (double *)(void *)(e + 1);
  e->keys = (uint64_t *)(void *)(e->real + count[0]);
  e->index = (int32_t *)(void *)(e->keys + count[2]);
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
  return status == 0 ? LAV_OK : status == 1 ? LAV_ERROR_ROOM : LAV_ERROR_NUMBER;
}

int32_t lav_engine_image(lav_engine *engine, void *out, uint64_t out_bytes, uint64_t *bytes) {
  lav_engine *e = engine;
  int32_t size[10], count[3];
  unsigned char *at = (unsigned char *)out + sizeof(image_t);
  image_t head;
  if (!e || !bytes) return LAV_ERROR_NULL;
  if ((uintptr_t)e % 8 != 0 || e->magic != IMAGE) return LAV_ERROR_SOLVER;
  k_engine_more_room(e->size, e->real, e->index, e->keys, size);
  k_engine_lengths(size, count);
  if (count[0] < 0 || count[1] < 0 || count[2] < 0) return LAV_ERROR_COUNT;
  *bytes = image_bytes_of(count);
  if (!out) return LAV_OK; /* asks how many */
  if ((uintptr_t)out % 8 != 0 || out_bytes < *bytes) return LAV_ERROR_ROOM;
  memset(out, 0, (size_t)*bytes);
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
  head.hash = hash_bytes(at, *bytes - sizeof head);
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
int32_t lav_engine_room(const void *image, uint64_t image_bytes, uint64_t *bytes) { return image && image_bytes && bytes ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_open(void *memory, uint64_t bytes, const void *image, uint64_t image_bytes, lav_engine **out) { return memory && bytes && image && image_bytes && out ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_step(lav_engine *engine, int32_t substeps, double *values) { return engine || values || substeps ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_image(lav_engine *engine, void *out, uint64_t out_bytes, uint64_t *bytes) { return engine || out || out_bytes || bytes ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
int32_t lav_engine_places(const lav_engine *engine, int32_t *n_bodies, double *out, int32_t n) { return engine || n_bodies || out || n ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_NULL; }
#endif

/* -- does this build have the bits of the package? -------------------------------------------------------------------- */

enum { TEST_BODIES = 3, TEST_CONTACTS = 12 };
static const uint64_t TEST_HASH = 0x55045c0a444e3c2cu;

int32_t lav_self_test(void) {
  static const double side[4][2] = {{-0.5, -0.5}, {0.5, -0.5}, {-0.5, 0.5}, {0.5, 0.5}};
  double inv_mass[TEST_BODIES], inv_inertia[9 * TEST_BODIES], velocity[6 * TEST_BODIES], normal[3 * TEST_CONTACTS],
      tangent[3 * TEST_CONTACTS], arm_a[3 * TEST_CONTACTS], arm_b[3 * TEST_CONTACTS], mu[TEST_CONTACTS],
      impulse[3 * TEST_CONTACTS], room[5200];
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
  GIVE_BACK(lav_open(room, sizeof room, &q, &options, &s));
  GIVE_BACK(lav_set(s, &q));
  GIVE_BACK(lav_run(s, &budget, &result));
  GIVE_BACK(lav_impulse(s, impulse, 3 * TEST_CONTACTS));
  return lav_hash(impulse, 3 * TEST_CONTACTS, lav_hash(&result.verdict.relative, 1, 0)) == TEST_HASH ? LAV_OK
                                                                                                     : LAV_ERROR_SELF_TEST;
}
