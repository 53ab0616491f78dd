/* -- impulses carried by key ------------------------------------------------------------------------------------------ */

static void keep_impulses(lav_solver *s) {
  kept_t *kept = &s->kept;
  if (!s->ready) return;
  kept->n_blocks = kept->n_rows = 0;
  if (!s->has_keys || s->p.n_blocks > kept->most_blocks || s->p.n_rows > kept->most_rows) return;
  COPY(kept->key, s->key, s->p.n_blocks);
  COPY(kept->ptr, s->p.ptr, s->p.n_blocks + 1);
  COPY(kept->kind, s->p.kind, s->p.n_blocks);
  COPY(kept->impulse, s->impulse, s->p.n_rows);
  kept->n_blocks = s->p.n_blocks;
  kept->n_rows = s->p.n_rows;
}

/* Enlarge the arrays of stored impulses for a larger problem. They move to higher addresses, so the last array moves first. */
static int32_t grow_kept(lav_solver *s, const lav_problem *q) {
  const kept_t old = s->kept;
  const uint64_t used = s->used;
  lav_problem most = *q;
  if (q->n_blocks <= old.most_blocks && q->n_rows <= old.most_rows) return LAV_OK;
  if (most.n_blocks < old.most_blocks) most.n_blocks = old.most_blocks;
  if (most.n_rows < old.most_rows) most.n_rows = old.most_rows;
  s->used = sizeof(lav_solver);
  s->is_short = 0;
  take_kept(s, &most);
  if (s->is_short) {
    s->kept = old;
    s->used = used;
    return LAV_ERROR_WORKSPACE;
  }
  s->begin = s->used;
  s->kept.n_blocks = old.n_blocks;
  s->kept.n_rows = old.n_rows;
  memmove(s->kept.impulse, old.impulse, (size_t)old.n_rows * sizeof *old.impulse);
  memmove(s->kept.kind, old.kind, (size_t)old.n_blocks * sizeof *old.kind);
  memmove(s->kept.ptr, old.ptr, ((size_t)old.n_blocks + 1) * sizeof *old.ptr);
  return LAV_OK;
}

static uint32_t place_of(uint64_t key, uint32_t mask) {
  key = (key ^ key >> 30) * 0xBF58476D1CE4E5B9u;
  return (uint32_t)(key ^ key >> 31) & mask;
}

/* Copy the stored impulses of blocks with the same key, kind and number of rows; of equal keys, the first one. */
static void carry(lav_solver *s) {
  const kept_t *kept = &s->kept;
  uint32_t size = 1, at;
  int32_t i, j, *table = s->marks; /* Hash table: a power of two, at least twice the number of stored blocks. */
  if (!s->has_keys || kept->n_blocks == 0) return;
  while (size < 2u * (uint32_t)kept->n_blocks) size *= 2;
  for (at = 0; at < size; at++) table[at] = -1;
  for (i = 0; i < kept->n_blocks; i++) {
    for (at = place_of(kept->key[i], size - 1); table[at] >= 0; at = (at + 1) & (size - 1))
      if (kept->key[table[at]] == kept->key[i]) break;
    if (table[at] < 0) table[at] = i;
  }
  for (i = 0; i < s->p.n_blocks; i++) {
    const int32_t rows = s->p.ptr[i + 1] - s->p.ptr[i];
    for (at = place_of(s->key[i], size - 1); table[at] >= 0; at = (at + 1) & (size - 1))
      if (kept->key[table[at]] == s->key[i]) break;
    j = table[at];
    if (j >= 0 && kept->kind[j] == s->p.kind[i] && kept->ptr[j + 1] - kept->ptr[j] == rows)
      COPY(s->impulse + s->p.ptr[i], kept->impulse + kept->ptr[j], rows);
  }
}

/* -- workspace of a method in addition to the problem [doubles]; sizes that depend on arrays are estimated ----------------- */

static int64_t sweeps_workspace_size(const lav_problem *q, const lav_options *o, int32_t n_v) {
  int64_t numbers = n_v + 76;
#ifndef LAV_SWEEPS_ONLY
  const int32_t fast = is_accelerated(o), packs = q->form == LAV_BODIES && q->n_blocks >= sweep_serial_MIN_PACKED_BLOCKS;
  const int32_t exact = o->method == LAV_BLOCK_GAUSS_SEIDEL || (fast && (o->sweep == LAV_BLOCK_SWEEP || q->law == LAV_CONE));
  if (!exact && packs)
    numbers += sweep_packed_packed_workspace_size(q->n_joints, joint_rows(q), q->n_blocks - q->n_joints, contact_rows(q), q->n_bodies);
  if (exact || (fast && accelerate_accelerated_count_convex_iterations(q->n_rows, o->convex) > 0)) numbers += 9 * (int64_t)q->n_rows + 26 * (int64_t)q->n_blocks;
  if (fast) numbers += accelerate_accelerated_accelerated_workspace_size(q->n_rows, n_v, o->method == LAV_NNCG ? 0 : o->memory);
#else
  (void)q, (void)o;
#endif
  return numbers;
}

#ifndef LAV_SWEEPS_ONLY
static int64_t newton_workspace_size(const lav_problem *q, const lav_options *o, int32_t n_v) {
  const int64_t m = q->n_rows, k = q->n_blocks, nv = q->n_velocities, sparse = 40 * (int64_t)q->n_entries + 100 * m;
  (void)o, (void)n_v;
  if (q->form == LAV_VELOCITIES) return 60 * m + 18 * k + 2 * nv * (nv < 180 ? nv : 180) + 2048;
  if (q->form == LAV_BODIES) return 170 * m + 12 * k + 450 * (int64_t)q->n_bodies + 2048;
  return 200 * m + 12 * k + (m <= 150 || 3 * m * m < sparse ? 3 * m * m : sparse) + 2048; /* A dense A needs the first, a sparse A depends on its fill. */
}

/* Workspace to form A of bodies. */
static int64_t formed_workspace_size(const lav_problem *q) {
  return (q->form == LAV_BODIES ? 90 * (int64_t)q->n_rows + 6 * (int64_t)q->n_blocks + q->n_bodies : 0) + 64;
}

static int64_t pivots_workspace_size(const lav_problem *q, const lav_options *o, int32_t n_v) {
  const int64_t m = q->n_rows, each = q->form == LAV_MATRIX && m > 0 ? q->n_entries / m : 0, band = each > 64 ? each : 64;
  const int64_t table = o->method == LAV_LEMKE ? 4 * m * m + 9 * m : 0; /* Each row has two columns in the dictionary. */
  (void)n_v;
  return 22 * m + (q->form == LAV_BODIES ? 12 * (int64_t)q->n_bodies : 0) + m * (m < band ? m : band) + table + formed_workspace_size(q);
}

static int64_t admm_workspace_size(const lav_problem *q, const lav_options *o, int32_t n_v) {
  const int64_t m = q->n_rows;
  (void)n_v;
  return m * m + factor_linear_cholesky_workspace_size(q->n_rows) + (int64_t)k_admm_workspace_size(q->n_rows, o->memory) + formed_workspace_size(q);
}
#endif

/* -- the methods ------------------------------------------------------------------------------------------------------ */

static const method_t *row_of(int32_t method) {
  enum { A = 1 << LAV_MATRIX, B = 1 << LAV_BODIES, V = 1 << LAV_VELOCITIES, ALL = A | B | V };
  static const method_t table[LAV_ADMM + 1] = {
    {0, 0, 0, 0, 0, NULL, NULL, NULL},
    /* forms, with rolling friction, with round cones; blocks, patience; workspace, start, step */
    {B, B, 0, COULOMB_ALONE, PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
    {A | V, A | V, 0, COULOMB_ALONE, PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
    {A, 0, 0, FREE_ROWS, PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
    {A, 0, 0, FREE_ROWS, PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
    {A, A, 0, COULOMB_ALONE, PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
#ifndef LAV_SWEEPS_ONLY
    {ALL, ALL, A | V, EVERY_LAW, PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
    {ALL, ALL, 0, EVERY_LAW, LONG_PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
    {ALL, ALL, A | V, EVERY_LAW, LONG_PATIENCE, sweeps_workspace_size, start_sweeps, run_sweeps},
    {ALL, V, V, EVERY_LAW, PATIENCE, newton_workspace_size, start_newton, run_newton},
    {A | B, 0, 0, ROWS_ALONE, PATIENCE, pivots_workspace_size, start_pivots, run_pivots},
    {A | B, 0, 0, ROWS_ALONE, PATIENCE, pivots_workspace_size, start_pivots, run_pivots},
    {A | B, A | B, A, EVERY_LAW, SPLIT_PATIENCE, admm_workspace_size, start_admm, run_sweeps},
#endif
  };
  return table + method;
}

/* -- the calls -------------------------------------------------------------------------------------------------------- */

int32_t lav_workspace_size(const lav_problem *problem, const lav_options *options, uint64_t *bytes) {
  lav_solver s; /* It has no memory and only counts bytes. */
  int64_t m, k, n, nv, numbers;
  if (!problem || !options || !bytes) return LAV_ERROR_NULL;
  GIVE_BACK(check_counts(problem));
  GIVE_BACK(check_options(options));
  GIVE_BACK(takes_counts(problem, options));
  memset(&s, 0, sizeof s);
  s.used = sizeof(lav_solver);
  m = problem->n_rows, k = problem->n_blocks, n = problem->n_bodies, nv = problem->n_velocities;
  (void)m, (void)k, (void)n, (void)nv;
  take_kept(&s, problem);
  take_blocks(&s, problem);
  take_form(&s, problem);
  numbers = 0;
  if (problem->form == LAV_VELOCITIES) { /* Assume that the factor of M has no fill, and Y has 1.25 times the entries of J. */
    const int64_t filled = (int64_t)problem->n_entries + problem->n_entries / 4 + 256;
    numbers += 2 * nv + 4 * (int64_t)problem->n_mass_entries + 2 * k + problem->n_entries / 4 + (m * nv < filled ? m * nv : filled);
  }
  numbers += row_of(options->method)->workspace(problem, options, s.n_v);
  *bytes = s.used + 8 * (uint64_t)numbers + 4096;
  return LAV_OK;
}

int32_t lav_open(void *memory, uint64_t bytes, const lav_problem *largest, const lav_options *options, lav_solver **out) {
  lav_solver *s, probe;
  uint64_t skip;
  if (!memory || !largest || !options || !out) return LAV_ERROR_NULL;
  GIVE_BACK(check_counts(largest));
  GIVE_BACK(check_options(options));
  GIVE_BACK(takes_counts(largest, options));
  skip = (16 - (uintptr_t)memory % 16) % 16;
  memset(&probe, 0, sizeof probe);
  probe.used = sizeof(lav_solver);
  take_kept(&probe, largest);
  if (bytes < skip + probe.used) return LAV_ERROR_WORKSPACE;
  s = (lav_solver *)(void *)((char *)memory + skip);
  memset(s, 0, sizeof *s);
  s->base = (char *)s;
  s->bytes = bytes - skip;
  s->used = sizeof(lav_solver);
  s->options = *options;
  take_kept(s, largest);
  s->begin = s->used;
#ifndef LAV_SWEEPS_ONLY
  s->newton_options.tol = 1e-6;
  s->newton_options.budget = 1000;
#endif
  s->magic = MAGIC;
  *out = s;
  return LAV_OK;
}

#define MOVED(array, type) (to->kept.array = (type *)(void *)(to->base + ((char *)s->kept.array - s->base)))

int32_t lav_move(lav_solver *solver, void *memory, uint64_t bytes, lav_solver **out) {
  lav_solver *s = solver, *to;
  const uint64_t skip = (16 - (uintptr_t)memory % 16) % 16;
  GIVE_BACK(enter(s));
  if (!memory || !out) return leave(s, LAV_ERROR_NULL);
  if (bytes < skip + s->begin) return leave(s, LAV_ERROR_WORKSPACE);
  keep_impulses(s);
  to = (lav_solver *)(void *)((char *)memory + skip);
  memcpy(to, s, s->begin); /* The stored impulses are behind the struct. */
  to->base = (char *)to;
  to->bytes = bytes - skip;
  MOVED(key, uint64_t), MOVED(ptr, int32_t), MOVED(kind, int32_t), MOVED(impulse, double);
  to->busy = to->ready = 0;
  *out = to;
  return leave(s, LAV_OK);
}

const char *lav_refused(const lav_solver *solver, int32_t *index) {
  if (!solver || (uintptr_t)solver % 16 != 0 || solver->magic != MAGIC || !solver->refused.array) return NULL;
  if (index) *index = solver->refused.index;
  return solver->refused.array;
}

uint64_t lav_needed(const lav_solver *solver) {
  return solver && (uintptr_t)solver % 16 == 0 && solver->magic == MAGIC ? solver->needed : 0;
}

static int32_t set_problem(lav_solver *s, const lav_problem *q) {
  int32_t code = LAV_OK;
  int64_t at = 0;
  keep_impulses(s);
  s->ready = s->begun = 0; /* If an error follows, results of the previous problem must not be returned for this one. */
  s->refused.array = NULL;
  GIVE_BACK(check_problem(q, &s->refused));
  GIVE_BACK(takes(q, &s->options));
  GIVE_BACK(grow_kept(s, q));
  s->used = s->peak = s->begin;
  s->is_short = 0;
  take_blocks(s, q);
  take_form(s, q);
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  GIVE_BACK(fill_blocks(s, q));
  if (q->form == LAV_MATRIX) {
    copy_or(s->p.b, q->b, q->n_rows, 0.0);
    fill_matrix(s->a.indptr, s->a.indices, s->a.data, q->index_ptr, q->index, q->value, q->n_rows, q->n_rows, 0);
    if (q->n_rows > 0) k_compute_csr_diagonal(&s->p, &s->a, s->empty);
  } else if (q->form == LAV_BODIES) fill_bodies(s, q);
#ifndef LAV_SWEEPS_ONLY
  else code = fill_velocities(s, q);
#endif
  if (code != LAV_OK) return code;
  if (core_faults_find_rhs_fault(s->p.b, q->n_rows, &at)) /* The range of computed numbers: b, and A_ii of J and M. */
    return refuse(&s->refused, LAV_ERROR_NUMBER, q->b ? "b" : "target", at);
  at = core_validate_find_invalid_number(s->p.d, q->n_rows);
  if (at >= 0) return refuse(&s->refused, LAV_ERROR_NUMBER, q->form == LAV_BODIES ? "inv_mass" : "value", at);
  memset(&s->swept, 0, sizeof s->swept);
  memset(&s->read, 0, sizeof s->read);
  s->p.islands = NULL;
  s->read.p = s->p;
  if (q->form == LAV_MATRIX) s->read.a = &s->a;
  else if (q->form == LAV_BODIES) s->read.r = &s->r;
  else s->read.g = general_of(s);
  judge_measure_judge_zero_impulse(&s->read, s->island_marks, &s->islands, s->reference, s->empty, q->form == LAV_MATRIX ? NULL : s->v_free,
                              s->terms, s->impulse, s->stopping_test.w, s->stopping_test.e, s->stopping_test.v, s->start);
  s->p.islands = s->read.p.islands;
  if (q->impulse) COPY(s->impulse, q->impulse, q->n_rows);
  else carry(s);
#ifndef LAV_SWEEPS_ONLY
  s->is_broken = 0;
#endif
  GIVE_BACK(row_of(s->options.method)->start(s));
  s->ready = 1;
  return LAV_OK;
}

int32_t lav_set(lav_solver *solver, const lav_problem *problem) {
  int32_t code;
  uint64_t wanted = 0;
  GIVE_BACK(enter(solver));
  if (!problem) return leave(solver, LAV_ERROR_NULL);
  code = set_problem(solver, problem);
  if (code == LAV_ERROR_WORKSPACE) {
    if (lav_workspace_size(problem, &solver->options, &wanted) != LAV_OK) wanted = 0;
    if (solver->used + solver->used / 2 > wanted) wanted = solver->used + solver->used / 2; /* The sizes of later arrays are not known yet. */
  }
  solver->needed = code == LAV_ERROR_WORKSPACE ? wanted + 32 : solver->peak + 32;
  return leave(solver, code);
}

static int32_t run(lav_solver *s, const lav_budget *requested, lav_result *out) {
  const method_t *row = row_of(s->options.method);
  const double reference = s->p.n_rows > 0 ? s->start[1] : 0.0; /* V0, the velocity error of the zero impulse. */
  lav_budget limits;
  const lav_budget *budget = &limits;
  double first; /* Residual of the result before refinement. */
  if (!s->ready) return LAV_ERROR_NO_PROBLEM;
  if (requested->size != sizeof *requested || out->size != sizeof *out) return LAV_ERROR_VERSION;
  limits = *requested; /* This tol guarantees velocity_tol: relative <= velocity_tol / V0 => V <= velocity_tol. */
  if (limits.velocity_tol > 0.0) limits.tol = limits.velocity_tol < reference ? limits.velocity_tol / reference : 1.0;
  if (budget->iterations < 0 || !(budget->tol >= 0.0 && budget->tol < INFINITY)) return LAV_ERROR_OPTION;
  if (!(budget->velocity_tol >= 0.0 && budget->velocity_tol < INFINITY)) return LAV_ERROR_OPTION;
  if (!(budget->seconds >= 0.0 && budget->seconds < INFINITY)) return LAV_ERROR_OPTION;
  if (budget->seconds > 0.0 && !budget->clock) return LAV_ERROR_NULL;
  out->outcome = LAV_MAX_ITERATIONS;
  out->iterations = out->sweeps = out->restarts = 0;
  s->deadline = is_timed(budget) ? budget->clock(budget->clock_data) + budget->seconds : 0.0;
#ifndef LAV_SWEEPS_ONLY
  memset(&s->limit, 0, sizeof s->limit);
  s->limit.end = s->deadline;
  s->limit.now = budget->clock;
  s->limit.at = budget->clock_data;
  s->newton_options.deadline = s->direct.s.deadline = is_timed(budget) ? &s->limit : NULL;
#endif
  if (!s->begun) {
    judge_stopping_test_begin_stopping_test(&s->stopping_test, &s->p, s->start[0], s->start[1], s->start[2], row->patience, s->score_workspace);
    s->stopping_test.keeps_last = s->options.method == LAV_PGS || s->options.method == LAV_SEQUENTIAL_IMPULSES
                                  || s->options.method == LAV_BLOCK_GAUSS_SEIDEL || s->options.method == LAV_GAUSS_SEIDEL;
  }
#ifndef LAV_SWEEPS_ONLY
  if (!s->begun && budget->tol > 0.0 && row->step != run_sweeps) begin_at_start(s, budget->tol);
#endif
  s->begun = 1;
  if (s->p.n_rows == 0) {
    if (budget->tol > 0.0) out->outcome = LAV_CONVERGED;
    else out->iterations = budget->iterations;
  }
  else row->step(s, budget, out);
  out->verdict.size = (uint32_t)sizeof out->verdict;
  first = judge(s, s->impulse, 1, budget->tol, &out->verdict);
  if (budget->tol > 0.0 && out->verdict.relative <= budget->tol
      && (out->outcome == LAV_MAX_ITERATIONS || out->outcome == LAV_TIME_LIMIT || out->outcome == LAV_STALLED))
    out->outcome = LAV_CONVERGED; /* The tolerance was reached between two checks of the method. */
  if (budget->tol > 0.0 && budget->tol < out->verdict.relative /* The claim was correct only before refinement. */
      && (out->outcome == LAV_ROUNDOFF_LIMIT ? first == first
          : first <= budget->tol && (out->outcome == LAV_CONVERGED || out->outcome == LAV_STALLED
                                     || out->outcome == LAV_MAX_ITERATIONS || out->outcome == LAV_TIME_LIMIT)))
    out->outcome = judge_score_is_at_floor(out->verdict.relative, out->verdict.floor) ? LAV_ROUNDOFF_LIMIT : LAV_STALLED;
  if (out->outcome == LAV_CONVERGED && budget->tol > 0.0 && out->verdict.floor > budget->tol) /* Rounding alone can exceed tol. */
    out->outcome = out->verdict.relative <= budget->tol ? LAV_ROUNDOFF_LIMIT : LAV_STALLED;
  if (out->verdict.velocity <= budget->velocity_tol && budget->velocity_tol > 0.0 /* `tol` was stricter than needed. */
      && (out->outcome == LAV_MAX_ITERATIONS || out->outcome == LAV_TIME_LIMIT || out->outcome == LAV_STALLED))
    out->outcome = LAV_CONVERGED;
  return LAV_OK;
}

int32_t lav_run(lav_solver *solver, const lav_budget *budget, lav_result *out) {
  lav_result found;
  int32_t code;
  GIVE_BACK(enter(solver));
  if (!budget || !out) return leave(solver, LAV_ERROR_NULL);
  found = *out;
  code = run(solver, budget, &found);
  if (code == LAV_OK) *out = found;
  return leave(solver, code);
}

int32_t lav_run_many(lav_solver *const *solvers, int32_t n, int32_t first, int32_t stride, const lav_budget *budget,
                     lav_result *results) {
  int32_t i, code, worst = LAV_OK;
  if (n > 0 && (!solvers || !budget || !results)) return LAV_ERROR_NULL;
  if (n < 0 || first < 0 || stride < 1) return LAV_ERROR_COUNT;
  for (i = first; i < n; i += stride) {
    code = lav_run(solvers[i], budget, results + i);
    if (code < worst) worst = code;
    if (stride > n - i) break;
  }
  return worst;
}

int32_t lav_impulse(lav_solver *solver, double *out, int32_t n) {
  GIVE_BACK(enter(solver));
  if (!solver->ready) return leave(solver, LAV_ERROR_NO_PROBLEM);
  if (n != solver->p.n_rows) return leave(solver, LAV_ERROR_COUNT);
  if (!out && n > 0) return leave(solver, LAV_ERROR_NULL);
  if (n > 0) COPY(out, solver->impulse, n);
  return leave(solver, LAV_OK);
}

int32_t lav_free_velocity(lav_solver *solver, double *out, int32_t n) {
  GIVE_BACK(enter(solver));
  if (!solver->ready) return leave(solver, LAV_ERROR_NO_PROBLEM);
  if (solver->form == LAV_MATRIX) return leave(solver, LAV_ERROR_UNSUPPORTED);
  if (n != solver->n_v) return leave(solver, LAV_ERROR_COUNT);
  if (!out && n > 0) return leave(solver, LAV_ERROR_NULL);
  COPY(out, solver->v_free, n);
  return leave(solver, LAV_OK);
}

int32_t lav_velocity(lav_solver *solver, double *out, int32_t n) {
  int32_t i;
  GIVE_BACK(lav_free_velocity(solver, out, n));
  GIVE_BACK(enter(solver));
  change_of(solver, solver->impulse, solver->compare);
  for (i = 0; i < n; i++) out[i] += solver->compare[i];
  return leave(solver, LAV_OK);
}
