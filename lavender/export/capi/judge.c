
/* -- judge ------------------------------------------------------------------------------------------------------------ */

#ifndef LAV_SWEEPS_ONLY
static const general_t *general_of(const lav_solver *s) { return s->form == LAV_VELOCITIES ? &s->g : NULL; }
#else
static const general_t *general_of(const lav_solver *s) { return (void)s, (const general_t *)NULL; }
#endif

/* Judge an impulse. The pass is refined if M is so ill-conditioned that its rounding may hide a residual of tol; with tol =
 * INFINITY it is never refined. Return the residual of the first pass, or NAN if it was not refined. */
static double judge(lav_solver *s, const double *impulse, int32_t floor, double tol, lav_verdict *out) {
  score_t t = judge_score_make_empty_score();
  double first = NAN, found;
  if (s->p.n_rows > 0) judge_measure_judge_view(&s->read, impulse, s->stopping_test.w, s->stopping_test.e, s->stopping_test.v, floor, &t);
#ifndef LAV_SWEEPS_ONLY
  found = judge_measure_relative_residual_of_score(&t, s->stopping_test.w, s->p.n_rows, s->start[0], s->start[1]);
  if (floor && judge_measure_refine_reported_view(&s->read, impulse, s->stopping_test.w, s->stopping_test.e, s->stopping_test.v, s->start[0], s->start[1], tol,
                                        found, &t))
    first = found;
#else
  (void)tol, (void)found;
#endif
  out->worst = t.worst;
  out->island = t.island;
  out->unused = 0;
  out->energy = t.finite ? t.energy : INFINITY;
  out->velocity = t.finite ? t.velocity : INFINITY;
  out->relative = judge_measure_relative_residual_of_score(&t, s->stopping_test.w, s->p.n_rows, s->start[0], s->start[1]);
  out->floor = floor ? judge_measure_relative_floor_of_score(&t, s->start[0], s->start[1]) : 0.0;
  return first;
}

/* Return the relative residual of an impulse, and keep it in the islands that it improves. -tol marks the start, which
 * becomes the zero impulse in islands that begin there; the result is then whether it changed. */
static double see(lav_solver *s, double *impulse, double tol) {
  struct judge_best_best_t *best = &s->stopping_test.best;
  score_t t = judge_score_make_empty_score();
  double relative;
  t.by_island = best->now;
  judge_measure_judge_view(&s->read, impulse, s->stopping_test.w, s->stopping_test.e, s->stopping_test.v, 0, &t);
  relative = judge_measure_relative_residual_of_score(&t, s->stopping_test.w, s->p.n_rows, s->start[0], s->start[1]);
  judge_best_copy_score_without_islands(best, &s->p, &t, relative);
  if (tol < 0.0) return judge_best_store_start(best, &s->read, s->stopping_test.w, s->start[2], -tol, impulse);
  judge_best_store_better_islands(best, &s->read, impulse, s->stopping_test.w, tol);
  return relative;
}

#ifndef LAV_SWEEPS_ONLY
/* Keep the start, and begin at the better of it and the zero impulse; sweeps do so at their first check. */
static void begin_at_start(lav_solver *s, double tol) {
  int32_t i = 0;
  while (i < s->p.n_rows && s->impulse[i] == core_start_clip_zero_to_row_bounds(&s->p, i)) i++;
  if (i == s->p.n_rows) return;
  judge_bounds_project_on_bounds(&s->p, s->impulse);
  if (see(s, s->impulse, -tol) != 0.0) s->driven = 0;
}
#endif

static int32_t enter(lav_solver *s) {
  if (!s) return LAV_ERROR_NULL;
  if ((uintptr_t)s % 16 != 0 || s->magic != MAGIC) return LAV_ERROR_SOLVER;
#if defined(__GNUC__)
  return __atomic_exchange_n(&s->busy, 1, __ATOMIC_ACQUIRE) ? LAV_ERROR_BUSY : LAV_OK;
#else
  if (s->busy) return LAV_ERROR_BUSY;
  s->busy = 1;
  return LAV_OK;
#endif
}

static int32_t leave(lav_solver *s, int32_t code) {
#if defined(__GNUC__)
  __atomic_store_n(&s->busy, 0, __ATOMIC_RELEASE);
#else
  s->busy = 0;
#endif
  return code;
}

int32_t lav_judge(lav_solver *solver, const double *impulse, int32_t n, double *slack, double *error, lav_verdict *out) {
  lav_verdict found;
  GIVE_BACK(enter(solver));
  if (!solver->ready) return leave(solver, LAV_ERROR_NO_PROBLEM);
  if (n != solver->p.n_rows) return leave(solver, LAV_ERROR_COUNT);
  if (!out || (!impulse && n > 0)) return leave(solver, LAV_ERROR_NULL);
  if (out->size != sizeof *out) return leave(solver, LAV_ERROR_VERSION);
  found.size = out->size;
  judge(solver, impulse, 1, 1e-6, &found);
  *out = found;
  if (slack && n > 0) COPY(slack, solver->stopping_test.w, n);
  if (error && n > 0) COPY(error, solver->stopping_test.e, n);
  return leave(solver, LAV_OK);
}

/* Compute v = M^-1 J^T x of bodies or generalised velocities. */
static void change_of(lav_solver *s, const double *x, double *v) {
  if (s->n_v > 0) memset(v, 0, (size_t)s->n_v * sizeof(double));
  if (s->n_v == 0 || s->p.n_rows == 0) return;
#ifndef LAV_SWEEPS_ONLY
  if (s->form == LAV_VELOCITIES) {
    core_generalized_multiply_jacobian_transpose(&s->g, x, v);
    core_generalized_solve_mass_matrix(&s->g, v);
    return;
  }
#endif
  core_velocity_compute_velocity_change(&s->p, &s->r, x, v);
}

/* Return an energy from a sum that rounding may have made negative (0) or overflow NaN (INFINITY). */
static double energy_from(double sum) { return sum < 0.0 ? 0.0 : sum < INFINITY ? sum : INFINITY; }

/* Compute A x into out (m) and the energy 1/2 x.A x [J]; `kinetic` is the energy of v = change_of(x) without compliance. */
static double energy_of(lav_solver *s, const double *x, double *v, double *out, double *kinetic) {
  double whole = 0.0, moving = 0.0;
  int32_t i;
  change_of(s, x, v);
  if (s->form == LAV_BODIES) core_rows_multiply_jacobian(&s->p, &s->r, v, out);
  for (i = 0; i < s->p.n_rows; i++) {
    if (s->form == LAV_MATRIX) out[i] = core_csr_csr_row_dot(&s->a, i, x);
#ifndef LAV_SWEEPS_ONLY
    if (s->form == LAV_VELOCITIES) out[i] = core_generalized_multiply_jacobian_row(&s->g, i, v);
#endif
    moving += 0.5 * x[i] * out[i];
    out[i] += s->form == LAV_MATRIX ? 0.0 : s->r.compliance[i] * x[i];
    whole += 0.5 * x[i] * out[i];
  }
  *kinetic = energy_from(moving);
  return energy_from(whole);
}

int32_t lav_motion_error(lav_solver *solver, const double *impulse, const double *reference, int32_t n, lav_motion *out) {
  lav_solver *s = solver;
  lav_motion found;
  double *delta, *slope, *v, own = 0.0, x = 0.0, y = 0.0;
  int32_t i, k;
  GIVE_BACK(enter(s));
  if (!s->ready) return leave(s, LAV_ERROR_NO_PROBLEM);
  if (n != s->p.n_rows) return leave(s, LAV_ERROR_COUNT);
  if (!out || ((!impulse || !reference) && n > 0)) return leave(s, LAV_ERROR_NULL);
  if (out->size != sizeof *out) return leave(s, LAV_ERROR_VERSION);
  if (n > 0 && (core_validate_find_invalid_number(impulse, n) >= 0 || core_validate_find_invalid_number(reference, n) >= 0)) return leave(s, LAV_ERROR_NUMBER);
  memset(&found, 0, sizeof found);
  found.size = out->size;
  found.row = found.body = -1;
  delta = s->compare, slope = delta + n, v = slope + n;
  for (i = 0; i < n; i++) delta[i] = impulse[i] - reference[i];
  if (n > 0) {
    energy_of(s, reference, v, slope, &own);
    x = energy_of(s, delta, v, slope, &y);
  }
  found.energy = sqrt(x);
  found.kinetic = sqrt(y);
  found.relative = y == 0.0 ? 0.0 : own > 0.0 && y < INFINITY ? sqrt(y / own) : INFINITY;
  for (i = 0; i < n; i++)
    if (fabs(slope[i]) > found.rows || found.row < 0) found.rows = fabs(slope[i]), found.row = i;
  for (i = 0; n > 0 && i < (s->form == LAV_BODIES ? s->n_v / 6 : s->n_v); i++) {
    const double *at = s->form == LAV_BODIES ? v + 6 * i : v + i;
    for (k = 0, x = y = 0.0; k < (s->form == LAV_BODIES ? 3 : 1); k++) {
      x += at[k] * at[k];
      y += s->form == LAV_BODIES ? at[3 + k] * at[3 + k] : 0.0;
    }
    if (sqrt(x) > found.speed || found.body < 0) found.speed = sqrt(x), found.body = i;
    if (sqrt(y) > found.spin) found.spin = sqrt(y);
  }
  *out = found;
  return leave(s, LAV_OK);
}
