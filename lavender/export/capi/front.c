/* -- the functions of lavender.h, which use the kernels above --------------------------------------------------------- */

typedef struct core_block_types_blocks_t blocks_t;
typedef struct core_view_csr_t csr_t;
typedef struct core_view_rows_t rows_t;
typedef struct core_view_generalized_t general_t;
typedef struct judge_score_score_t score_t;

typedef struct where_t { /* A rejected array or count, and the index of the rejected entry. */
  const char *array;
  int32_t index;
} where_t;

enum { MAGIC = 0x4C415631, PATIENCE = 64, LONG_PATIENCE = 500, SPLIT_PATIENCE = 5000 };
/* Tolerances of unit vectors and tensors: EXACT exceeds rounding to float64, ROUNDED that to float32 after some rotations. */
static const double EXACT = 1e-9, ROUNDED = 1e-5;

typedef struct kept_t { /* Impulses of the previous problem, by key. */
  int32_t n_blocks, n_rows, most_blocks, most_rows;
  uint64_t *key;
  int32_t *ptr, *kind;
  double *impulse;
} kept_t;

struct lav_solver {
  uint32_t magic;
  int32_t busy;
  where_t refused;  /* Rejected by the last lav_set. */
  int32_t ready;    /* A problem is set. */
  int32_t begun;    /* The method has run on it. */
  char *base;
  uint64_t bytes, used, peak, begin, needed; /* Memory [bytes]: total, in use, largest use, end of `kept`, needed. */
  lav_options options;
  kept_t kept;
  int32_t form, has_keys, is_short, n_v; /* n_v: number of velocities. */
  int32_t in_rows; /* Every block has one row, and the sweep uses the given order. */
  int32_t rubs;    /* A contact has friction rows: then the law and the supported sweeps matter, even if mu is 0. */
  blocks_t p;
  csr_t a;
  rows_t r;
  general_t g;
  uint64_t *key;
  double *impulse, *v_free, *score_workspace, *compare;
  double start[3]; /* Reference energy E0 [sqrt J] and velocity V0 [m/s], relative residual of the zero impulse. */
  struct core_block_types_islands_t islands;
  double *terms;     /* Terms of each row, for rows without another reference. */
  double *reference; /* E0 and V0 of each island, then the relative residual of its zero impulse. */
  int32_t *order, *empty, *marks, *island_marks;
  int32_t split, mode;
  uint64_t rng;
  struct core_view_view_t read; /* The problem for the judge. */
  struct judge_stopping_test_stopping_test_t stopping_test;
  struct sweep_serial_sweep_run_t swept;
  double deadline;  /* Time on the clock of the budget. */
#ifndef LAV_SWEEPS_ONLY
  struct accelerate_accelerated_acceleration_t acceleration;
  struct core_view_view_t view; /* The problem for newton: rows of A if A was formed. */
  struct core_deadline_deadline_t limit; /* The same time, for the methods that read the clock. */
  struct core_method_options_t newton_options;
  struct core_method_workspace_t drive, newton_memory;
  uint64_t newton_begin;       /* Offset of the memory of Newton's method. */
  int32_t driven;              /* Newton's method has begun with `newton_options`. */
  blocks_t q;                  /* Blocks with d, nu and step of A, for methods that use A. */
  struct pivot_direct_direct_t direct;
  struct pivot_lemke_lemke_t lemke;
  double *table;               /* Lemke's dictionary, or the matrix of admm and its factor. */
  struct accelerate_admm_admm_t splitting;
  struct accelerate_admm_factor_t factor;
  struct factor_linear_linear_t linear;
  int32_t factors, is_broken;
#endif
};

enum { FREE_ROWS = 1, ROWS_ALONE, COULOMB_ALONE, EVERY_LAW }; /* Blocks that a method supports. */

typedef struct method_t {
  int32_t forms, rolling, round; /* Bits 1 << form: supported forms, those with rolling friction, those with round cones. */
  int32_t blocks, patience;      /* patience: checks without progress before it stalls. */
  int64_t (*workspace)(const lav_problem *, const lav_options *, int32_t n_v); /* Doubles in addition to the problem. */
  int32_t (*start)(lav_solver *);                                         /* Prepare the method for a new problem. */
  void (*step)(lav_solver *, const lav_budget *, lav_result *);           /* Continue from the present impulse. */
} method_t;

static const method_t *row_of(int32_t method);

static int32_t is_accelerated(const lav_options *o) { return o->method == LAV_ANDERSON || o->method == LAV_NNCG; }

#define GIVE_BACK(call)                                             \
  do {                                                              \
    const int32_t code_ = (call);                                   \
    if (code_ != LAV_OK) return code_;                              \
  } while (0)

/* -- names ------------------------------------------------------------------------------------------------------------ */

uint32_t lav_version(void) { return (uint32_t)LAV_VERSION_MAJOR << 16 | LAV_VERSION_MINOR; }

int32_t lav_default_problem(int32_t form, lav_problem *out) {
  if (!out) return LAV_ERROR_NULL;
  if (form < LAV_MATRIX || form > LAV_VELOCITIES) return LAV_ERROR_OPTION;
  memset(out, 0, sizeof *out);
  out->size = (uint32_t)sizeof *out;
  out->form = form;
  return LAV_OK;
}

int32_t lav_default_options(int32_t method, lav_options *out) {
  if (!out) return LAV_ERROR_NULL;
  if (!lav_name(method)) return LAV_ERROR_OPTION;
  memset(out, 0, sizeof *out);
  out->size = (uint32_t)sizeof *out;
  out->method = method;
  out->memory = method == LAV_ADMM ? 10 : 5;
  out->convex = method == LAV_ANDERSON ? accelerate_accelerated_AUTOMATIC : 0;
  out->omega = method == LAV_SOR ? 1.5 : method == LAV_GAUSS_SEIDEL ? 1.0 : 0.0;
  return LAV_OK;
}

int32_t lav_default_budget(lav_budget *out) {
  if (!out) return LAV_ERROR_NULL;
  memset(out, 0, sizeof *out);
  out->size = (uint32_t)sizeof *out;
  out->iterations = 1000;
  out->tol = 1e-6;
  return LAV_OK;
}

static uint64_t hash_bytes(const void *from, uint64_t bytes, uint64_t seed) {
  const unsigned char *at = (const unsigned char *)from;
  uint64_t h = seed, x;
  for (; bytes >= 8; at += 8, bytes -= 8) {
    memcpy(&x, at, 8);
    h = (h ^ x) * 0x9E3779B97F4A7C15u;
    h ^= h >> 29;
  }
  return h ^ h >> 32;
}

uint64_t lav_hash(const double *x, int32_t n, uint64_t seed) { return hash_bytes(x, x && n > 0 ? 8 * (uint64_t)n : 0, seed); }

/* -- checks of arguments ---------------------------------------------------------------------------------------------- */

static int32_t check_counts(const lav_problem *q) {
  const int64_t m = q->n_rows, n = q->n_velocities;
  if (q->size != sizeof *q) return LAV_ERROR_VERSION;
  if (q->form < LAV_MATRIX || q->form > LAV_VELOCITIES) return LAV_ERROR_OPTION;
  if (q->law != LAV_COULOMB && q->law != LAV_CONE) return LAV_ERROR_OPTION;
  if (q->n_blocks < 0 || q->n_rows < q->n_blocks || q->n_rows > 100000000 || (q->n_rows > 0 && q->n_blocks == 0))
    return LAV_ERROR_COUNT;
  if (q->n_entries < 0 || q->n_bodies < 0 || q->n_joints < 0 || n < 0 || q->n_mass_entries < 0) return LAV_ERROR_COUNT;
  if (q->n_entries > 1000000000 || q->n_bodies > 100000000 || n > 100000000) return LAV_ERROR_COUNT;
  if (q->form == LAV_BODIES && q->n_joints > q->n_blocks) return LAV_ERROR_COUNT;
  if (q->form == LAV_MATRIX && q->value && !q->index_ptr && q->n_entries != m * m) return LAV_ERROR_COUNT;
  if (q->form == LAV_VELOCITIES && q->value && !q->index_ptr && q->n_entries != m * n) return LAV_ERROR_COUNT;
  if (q->form == LAV_VELOCITIES && q->mass_value && !q->mass_ptr && q->n_mass_entries != n * n) return LAV_ERROR_COUNT;
  if (q->form == LAV_VELOCITIES && n == 0 && m > 0) return LAV_ERROR_COUNT;
  return LAV_OK;
}

static int32_t check_options(const lav_options *o) {
  if (o->size != sizeof *o) return LAV_ERROR_VERSION;
  if (!lav_name(o->method) || o->order < LAV_GIVEN || o->order > LAV_REVERSE) return LAV_ERROR_OPTION;
  if (o->memory < 1 || o->memory > 16 || o->sweep < LAV_DEFAULT_SWEEP || o->sweep > LAV_BLOCK_SWEEP) return LAV_ERROR_OPTION;
  if (o->convex < (o->method == LAV_ANDERSON ? accelerate_accelerated_AUTOMATIC : 0) || (o->keeps != 0 && o->keeps != 1)) return LAV_ERROR_OPTION;
  if (o->method == LAV_SOR && !(o->omega > 0.0 && o->omega < 2.0)) return LAV_ERROR_OPTION;
  if (o->method == LAV_JACOBI && !(o->omega >= 0.0 && core_validate_is_valid_number(o->omega))) return LAV_ERROR_OPTION;
  if (o->method == LAV_GAUSS_SEIDEL && o->omega != 1.0) return LAV_ERROR_OPTION;
  return LAV_OK;
}

/* Return whether all blocks are rows, whose bounds do not depend on other impulses. */
static int32_t are_rows(const lav_problem *q) {
  int32_t i;
  for (i = 0; q->kind && i < q->n_blocks; i++)
    if (q->kind[i] != LAV_ROW && (!q->block_ptr || q->block_ptr[i + 1] - q->block_ptr[i] > 1)) return 0;
  return 1;
}

/* Check whether the method supports the form and the counts of a problem, without reading arrays. */
static int32_t takes_counts(const lav_problem *q, const lav_options *o) {
  if (!(row_of(o->method)->forms >> q->form & 1)) return LAV_ERROR_UNSUPPORTED;
#ifdef LAV_SWEEPS_ONLY
  if (q->form == LAV_VELOCITIES) return LAV_ERROR_UNSUPPORTED;
#endif
  return LAV_OK;
}

static int32_t takes(const lav_problem *q, const lav_options *o) {
  const int32_t rows_alone = are_rows(q);
  const method_t *row = row_of(o->method);
  int32_t i, free_rows = 1;
  GIVE_BACK(takes_counts(q, o));
  for (i = 0; q->kind && i < q->n_blocks; i++)
    if (q->kind[i] != LAV_ROW) {
      free_rows = 0;
      if (q->kind[i] == LAV_CONTACT_ROLLING && !(row->rolling >> q->form & 1)) return LAV_ERROR_UNSUPPORTED;
      if (q->kind[i] == LAV_ROUND && !(row->round >> q->form & 1)) return LAV_ERROR_UNSUPPORTED;
      if (q->kind[i] == LAV_ROUND && q->law != LAV_CONE) return LAV_ERROR_UNSUPPORTED;
    }
  for (i = 0; i < q->n_rows; i++)
    if ((q->lower && q->lower[i] > -INFINITY) || (q->upper && q->upper[i] < INFINITY)) free_rows = 0;
  if ((row->blocks == FREE_ROWS && !free_rows) || (row->blocks == ROWS_ALONE && !rows_alone)) return LAV_ERROR_UNSUPPORTED;
  if (q->law == LAV_CONE && !rows_alone) {
    if (row->blocks != EVERY_LAW) return LAV_ERROR_UNSUPPORTED;
    if (is_accelerated(o) && o->sweep == LAV_PGS_SWEEP) return LAV_ERROR_UNSUPPORTED;
  }
  return LAV_OK;
}

static int32_t refuse(where_t *at, int32_t code, const char *array, int64_t index) {
  at->array = array;
  at->index = (int32_t)index;
  return code;
}

static int32_t check_blocks(const lav_problem *q, where_t *at) {
  blocks_t p; /* The check reads only the fields that are set here. */
  int64_t index = 0;
  int32_t i;
  p.n_blocks = q->n_blocks;
  p.n_rows = q->n_rows;
  p.ptr = q->block_ptr;
  p.kind = q->kind;
  p.lower = q->lower;
  p.upper = q->upper;
  p.mu = q->mu;
  p.patch_radius = q->patch_radius;
  p.rolling = q->rolling;
  if (q->n_rows > 0 && !q->block_ptr && q->n_blocks != q->n_rows) return refuse(at, LAV_ERROR_BLOCKS, "n_blocks", 0);
  for (i = 0; q->kind && i < q->n_blocks; i++)
    if (q->kind[i] < LAV_ROW || q->kind[i] > LAV_CONTACT_ROLLING) return refuse(at, LAV_ERROR_BLOCKS, "kind", i);
  switch (core_faults_find_block_fault(&p, &index)) {
    case core_faults_FAULT_POINTERS: return refuse(at, LAV_ERROR_BLOCKS, "block_ptr", index);
    case core_faults_FAULT_KIND: return refuse(at, LAV_ERROR_BLOCKS, "block_ptr", index + 1);
    case core_faults_FAULT_MU: return refuse(at, LAV_ERROR_FRICTION, "mu", index);
    case core_faults_FAULT_PATCH_RADIUS:
    case core_faults_FAULT_SPIN: return refuse(at, LAV_ERROR_FRICTION, "patch_radius", index);
    case core_faults_FAULT_ROLLING: return refuse(at, LAV_ERROR_FRICTION, "rolling", index);
    case core_faults_FAULT_BOUNDS: return refuse(at, LAV_ERROR_BOUNDS, "lower", index);
    case core_faults_FAULT_LOWER: return refuse(at, LAV_ERROR_NUMBER, "lower", index);
    case core_faults_FAULT_UPPER: return refuse(at, LAV_ERROR_NUMBER, "upper", index);
  }
  if (q->form != LAV_BODIES) return LAV_OK;
  if (core_faults_find_body_block_fault(&p, q->n_joints, &index))
    return refuse(at, q->kind && q->kind[index] == LAV_ROUND ? LAV_ERROR_UNSUPPORTED : LAV_ERROR_BLOCKS, "kind", index);
  for (i = q->n_joints; q->mu && i < q->n_blocks; i++) {
    const int32_t rows = q->block_ptr ? q->block_ptr[i + 1] - q->block_ptr[i] : 1;
    if (q->kind[i] == LAV_CONTACT && rows == 1 && q->mu[i] > 0.0) return refuse(at, LAV_ERROR_FRICTION, "mu", i);
  }
  return LAV_OK;
}

static int32_t check_columns(const int32_t *ptr, const int32_t *index, int32_t rows, int32_t columns, int32_t entries,
                             int32_t is_lower, const char *name, where_t *at) {
  int64_t i = 0;
  if (!ptr || (entries > 0 && !index)) return refuse(at, LAV_ERROR_NULL, name, 0);
  switch (core_faults_find_matrix_fault(ptr, index, rows, columns, entries, is_lower, &i)) {
    case core_faults_FAULT_POINTERS: return refuse(at, LAV_ERROR_COUNT, name, i);
    case core_faults_FAULT_COLUMN: return refuse(at, LAV_ERROR_INDEX, is_lower ? "mass_index" : "index", i);
    case core_faults_FAULT_DIAGONAL: return refuse(at, LAV_ERROR_INDEX, name, i);
  }
  return LAV_OK;
}

static int32_t check_numbers(const double *x, int64_t n, int32_t is_needed, const char *name, where_t *at) {
  int64_t i;
  if (!x) return is_needed && n > 0 ? refuse(at, LAV_ERROR_NULL, name, 0) : LAV_OK;
  i = core_validate_find_invalid_number(x, n);
  return i < 0 ? LAV_OK : refuse(at, LAV_ERROR_NUMBER, name, i);
}

#define OPTIONAL(name, n) GIVE_BACK(check_numbers(q->name, (n), 0, #name, at))
#define NEEDED(name, n) GIVE_BACK(check_numbers(q->name, (n), 1, #name, at))

static int32_t check_bodies(const lav_problem *q, where_t *at) {
  const int64_t n = q->n_bodies, c = q->n_blocks - q->n_joints, mj = q->block_ptr ? q->block_ptr[q->n_joints] : q->n_joints;
  rows_t r; /* The check reads only the fields that are set here. */
  const struct core_faults_body_tolerances_t tolerances = {ROUNDED, ROUNDED, ROUNDED, 0.0};
  const char *vector;
  double length;
  int64_t i = 0;
  r.n_bodies = q->n_bodies;
  r.n_joints = q->n_joints;
  r.n_contacts = (int32_t)c;
  r.inv_mass = q->inv_mass;
  r.inv_inertia = q->inv_inertia;
  r.normal = q->normal;
  r.tangent = q->tangent;
  r.joint_body = q->joint_body;
  r.contact_body = q->contact_body;
  NEEDED(inv_mass, n);
  NEEDED(inv_inertia, 9 * n);
  OPTIONAL(velocity, 6 * n);
  NEEDED(jac, 12 * mj);
  NEEDED(normal, 3 * c);
  NEEDED(tangent, 3 * c);
  NEEDED(arm_a, 3 * c);
  NEEDED(arm_b, 3 * c);
  if (q->n_joints > 0 && !q->joint_body) return refuse(at, LAV_ERROR_NULL, "joint_body", 0);
  if (c > 0 && !q->contact_body) return refuse(at, LAV_ERROR_NULL, "contact_body", 0);
  switch (core_faults_find_body_fault(&r, &tolerances, &i)) {
    case core_faults_FAULT_MASS: return refuse(at, q->inv_mass[i] < 0.0 ? LAV_ERROR_MASS : LAV_ERROR_NUMBER, "inv_mass", i);
    case core_faults_FAULT_INERTIA_SIZE: return refuse(at, LAV_ERROR_NUMBER, "inv_inertia", 9 * i);
    case core_faults_FAULT_INERTIA: return refuse(at, LAV_ERROR_MASS, "inv_inertia", 9 * i);
    case core_faults_FAULT_JOINT_BODY: return refuse(at, LAV_ERROR_INDEX, "joint_body", i);
    case core_faults_FAULT_JOINT_PAIR: return refuse(at, LAV_ERROR_PAIR, "joint_body", 2 * i);
    case core_faults_FAULT_CONTACT_BODY: return refuse(at, LAV_ERROR_INDEX, "contact_body", i);
    case core_faults_FAULT_CONTACT_PAIR: return refuse(at, LAV_ERROR_PAIR, "contact_body", 2 * i);
    case core_faults_FAULT_FRAME:
      length = core_rows_dot3(q->normal + 3 * i, q->normal + 3 * i);
      vector = fabs(sqrt(length) - 1.0) <= ROUNDED ? "tangent" : "normal";
      return refuse(at, LAV_ERROR_FRAME, vector, 3 * i);
  }
  return LAV_OK;
}

static int32_t check_velocities(const lav_problem *q, where_t *at) {
  const int32_t n = q->n_velocities;
  if (q->index_ptr) GIVE_BACK(check_columns(q->index_ptr, q->index, q->n_rows, n, q->n_entries, 0, "index_ptr", at));
  NEEDED(value, q->n_entries);
  if (q->mass_ptr) GIVE_BACK(check_columns(q->mass_ptr, q->mass_index, n, n, q->n_mass_entries, 1, "mass_ptr", at));
  NEEDED(mass_value, q->n_mass_entries);
  OPTIONAL(velocity, n);
  return q->n_rows > 0 && q->n_entries == 0 && !q->index_ptr ? refuse(at, LAV_ERROR_COUNT, "n_entries", 0) : LAV_OK;
}

static int32_t check_problem(const lav_problem *q, where_t *at) {
  const int64_t m = q->n_rows;
  int64_t at_fault;
  int32_t i;
  GIVE_BACK(check_counts(q));
  GIVE_BACK(check_blocks(q, at));
  OPTIONAL(b, m);
  OPTIONAL(target, m);
  OPTIONAL(compliance, m);
  for (i = 0; q->impulse && i < m; i++) /* The size is not limited: the judge measures it. */
    if (!isfinite(q->impulse[i])) return refuse(at, LAV_ERROR_NUMBER, "impulse", i);
  at_fault = q->compliance ? core_validate_find_invalid_magnitude(q->compliance, m) : -1;
  if (at_fault >= 0) return refuse(at, q->compliance[at_fault] < 0.0 ? LAV_ERROR_MASS : LAV_ERROR_NUMBER, "compliance", at_fault);
  if (q->form == LAV_BODIES) return check_bodies(q, at);
  if (q->form == LAV_VELOCITIES) return check_velocities(q, at);
  if (m > 0 && (!q->b || !q->value)) return refuse(at, LAV_ERROR_NULL, q->b ? "value" : "b", 0);
  if (q->index_ptr) GIVE_BACK(check_columns(q->index_ptr, q->index, q->n_rows, q->n_rows, q->n_entries, 0, "index_ptr", at));
  NEEDED(value, q->n_entries);
  return LAV_OK;
}

int32_t lav_takes(const lav_problem *problem, const lav_options *options) {
  where_t at;
  if (!problem || !options) return LAV_ERROR_NULL;
  GIVE_BACK(check_options(options));
  GIVE_BACK(check_counts(problem));
  GIVE_BACK(check_blocks(problem, &at));
  return takes(problem, options);
}
