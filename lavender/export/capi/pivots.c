
#ifndef LAV_SWEEPS_ONLY
/* -- direct and lemke: pivots on bounded rows ------------------------------------------------------------------------- */

enum { GUESS_SWEEPS = 2, BATCH = 32 }; /* BATCH: exchanges or pivots between two checks of the clock. */
static const double TINY_PIVOT = 1e-13;

static void bind_pivots(lav_solver *s, struct core_arena_arena_t *arena) {
  pivot_direct_bind_direct_arrays(&s->direct, arena);
  if (s->options.method == LAV_LEMKE) pivot_lemke_bind_lemke_arrays(&s->lemke, &s->direct, arena);
}

static int32_t start_pivots(lav_solver *s) {
  struct pivot_direct_direct_t *t = &s->direct;
  const int64_t m = s->p.n_rows;
  struct core_arena_arena_t counted = {NULL, NULL, 0, 0}, arena = {NULL, NULL, 0, 0};
  int32_t bands[2] = {0, 0}, band, i;
  double asymmetry = 0.0;
  GIVE_BACK(form_matrix(s));
  if (m > 0 && s->a.indptr[m] > 0) asymmetry = core_csr_measure_asymmetry_and_bandwidth(&s->a, s->p.d, (int32_t)m, s->marks, bands);
  t->symmetric = asymmetry <= 1e-14;
  band = !t->symmetric ? (int32_t)m - 1 : bands[0] > bands[1] ? bands[0] : bands[1];
  t->linear = 1;
  for (i = 0; i < m; i++)
    if (s->p.lower[i] != -INFINITY || s->p.upper[i] != INFINITY) t->linear = 0;
  for (i = 0; i < s->p.n_blocks; i++)
    if (s->p.kind[i] != LAV_ROW) t->linear = 0;
  t->e0 = s->start[0];
  t->v0 = s->start[1];
  t->least = 1e-13;
  t->sweeps = GUESS_SWEEPS;
  t->v = s->read;
  t->s.a = &s->a;
  t->s.p = &s->q;
  t->s.band = band;
  t->s.order = NULL;
  t->s.linear.tiny = TINY_PIVOT;
  bind_pivots(s, &counted);
  arena.real = TAKE(s, double, counted.n_real);
  arena.index = TAKE(s, int32_t, counted.n_index);
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  bind_pivots(s, &arena);
  return LAV_OK;
}

/* Return the number of exchanges until the next check of the clock, within the budget. */
static int32_t rounds_left(const lav_solver *s, const lav_budget *budget) {
  const int32_t left = budget->iterations - s->direct.s.n_rounds;
  return left < BATCH ? left : BATCH;
}

static int32_t pivot_all(lav_solver *s, const lav_budget *budget) {
  int32_t code;
  do {
    code = pivot_direct_step_direct_solve(&s->direct, rounds_left(s, budget));
    if (code == pivot_principal_SOLVED) return LAV_CONVERGED;
    if (code == pivot_principal_INDEFINITE) return LAV_FAILED; /* The package continues with LAPACK. */
    if (s->direct.is_over) return LAV_STALLED;
  } while (rounds_left(s, budget) > 0 && !is_late(s, budget));
  return rounds_left(s, budget) <= 0 ? LAV_MAX_ITERATIONS : LAV_TIME_LIMIT;
}

static int32_t follow_paths(lav_solver *s, const lav_budget *budget) {
  struct pivot_lemke_lemke_t *l = &s->lemke;
  int32_t code, left;
  pivot_lemke_begin_lemke_solve(l);
  do {
    left = budget->iterations - l->n_pivots;
    code = pivot_lemke_follow_lemke_paths(l, is_timed(budget) && left > BATCH ? BATCH : left);
    if (code == pivot_lemke_DONE) return LAV_STALLED;
  } while ((code == pivot_lemke_EXCHANGES || l->n_pivots < budget->iterations) && !is_late(s, budget));
  pivot_lemke_judge_unfinished_path(l);
  return l->n_pivots < budget->iterations ? LAV_TIME_LIMIT : LAV_MAX_ITERATIONS;
}

static void run_pivots(lav_solver *s, const lav_budget *budget, lav_result *out) {
  struct pivot_direct_direct_t *t = &s->direct;
  pivot_direct_begin_direct_solve(t, s->impulse);
  out->outcome = s->options.method == LAV_LEMKE ? follow_paths(s, budget) : pivot_all(s, budget);
  if (t->relative < INFINITY) COPY(s->impulse, t->best, s->p.n_rows);
  if (out->outcome == LAV_CONVERGED || out->outcome == LAV_STALLED)
    out->outcome = t->relative <= budget->tol || (budget->tol == 0.0 && pivot_direct_is_solved_to_rounding(t)) ? LAV_CONVERGED
                   : judge_score_is_at_floor(t->relative, t->floor)                            ? LAV_ROUNDOFF_LIMIT
                                                                                                : LAV_STALLED;
  out->iterations = s->options.method == LAV_LEMKE ? s->lemke.n_pivots : t->s.n_rounds;
  out->restarts = t->s.factorisations;
  out->sweeps = 2 * GUESS_SWEEPS * t->swept;
}
#endif
