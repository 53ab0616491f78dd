
#ifndef LAV_SWEEPS_ONLY
/* -- direct and lemke: pivots on bounded rows ------------------------------------------------------------------------- */

enum { GUESS_SWEEPS = 2, BATCH = 32, CORRECTIONS = 100, PASSES = 100, STAYING = 6, HALVINGS = 41, SHIFTS = 5 };
static const double GOOD = 1e-13, RUNAWAY = 1e-6, TINY_PIVOT = 1e-13, TINY_PATH = 1e-11, SLOP = 8.0;
static const double SHIFT[SHIFTS] = {1e-2, 1e-4, 1e-6, 1e-8, 1e-10}; /* of d: far above rounding, below mass ratios */

static int32_t prepare_pivots(lav_solver *s) {
  const int64_t m = s->p.n_rows;
  int32_t bands[2] = {0, 0}, i;
  int64_t n = m;
  double size[2] = {0.0, 0.0};
  GIVE_BACK(form_matrix(s));
  if (m > 0 && s->a.indptr[m] > 0) core_csr_scan_entries(&s->a, (int32_t)m, s->marks, bands, size);
  s->is_symmetric = size[1] == 0.0 || size[0] / size[1] <= 1e-14;
  s->band = !s->is_symmetric ? (int32_t)m - 1 : bands[0] > bands[1] ? bands[0] : bands[1];
  s->is_linear = 1;
  for (i = 0; i < m; i++) {
    if (s->p.lower[i] != -INFINITY || s->p.upper[i] != INFINITY) s->is_linear = 0;
    n += s->p.lower[i] != -INFINITY && s->p.upper[i] != INFINITY;
  }
  for (i = 0; i < s->p.n_blocks; i++)
    if (s->p.kind[i] != LAV_ROW) s->is_linear = 0;
  s->pivot_room = TAKE(s, double, 11 * m + m * (int64_t)(s->band + 1));
  s->pivot_marks = TAKE(s, int32_t, 4 * m);
  if (s->options.method == LAV_LEMKE) {
    s->table = TAKE(s, double, n * (n + 2));
    s->whole = TAKE(s, int32_t, 13 * m + 2);
  }
  return s->is_short ? LAV_ERROR_ROOM : LAV_OK;
}

static int32_t is_good(const lav_solver *s) { /* a floor above 1e-6 belongs to an impulse that ran away */
  const double floor = s->best_floor < RUNAWAY ? s->best_floor : RUNAWAY;
  return s->best <= (floor > GOOD ? floor : GOOD);
}

static int32_t is_end(const lav_solver *s) { /* where every row is free, rounding is all that can be left */
  const double floor = s->best_floor < RUNAWAY ? s->best_floor : RUNAWAY;
  return is_good(s) || (s->is_linear && s->best <= 2.0 * floor && s->best < 1.0);
}

/* x within its bounds. */
static void clip_rows(const lav_solver *s, double *out) {
  const double *x = s->pivots.x;
  int32_t i;
  for (i = 0; i < s->p.n_rows; i++) out[i] = x[i] < s->q.lower[i] ? s->q.lower[i] : x[i] > s->q.upper[i] ? s->q.upper[i] : x[i];
}

/* Its residual; the best is the result. */
static double look(lav_solver *s) {
  lav_verdict found;
  clip_rows(s, s->tried);
  judge(s, s->tried, 1, &found);
  if (found.relative < s->best) {
    s->best = found.relative;
    s->best_floor = found.floor;
    COPY(s->impulse, s->tried, s->p.n_rows);
  }
  return found.relative;
}

/* x <- x - A_FF^-1 w_F while that halves the residual; ROUNDS where it changes a sign. */
static int32_t refine(lav_solver *s, double relative) {
  double previous = INFINITY;
  int32_t i;
  for (i = 0; i < CORRECTIONS && !is_good(s) && relative < 0.5 * previous; i++) {
    previous = relative;
    pivot_principal_pivots_correct(&s->pivots);
    pivot_principal_pivots_slack(&s->pivots);
    if (pivot_principal_pivots_exchange(&s->pivots)) return pivot_principal_ROUNDS;
    relative = look(s);
  }
  return pivot_principal_SOLVED;
}

static int32_t after_rounds(lav_solver *s, int32_t code) {
  double relative;
  if (code == pivot_principal_SMALL || code == pivot_principal_INDEFINITE) return code;
  relative = look(s);
  if (code != pivot_principal_SOLVED || s->pivots.shift != 0.0 || is_good(s)) return code;
  pivot_principal_pivots_slack(&s->pivots);
  return refine(s, relative);
}

/* Rounds of solving and exchanging, until no sign is wrong or the budget is used up. */
static int32_t rounds(lav_solver *s, const lav_budget *budget) {
  int32_t code, before;
  do {
    before = s->pivots.n_rounds;
    code = after_rounds(s, pivot_principal_pivots_rounds(&s->pivots, s->left < BATCH ? s->left : BATCH));
    s->left -= s->pivots.n_rounds - before;
  } while (code == pivot_principal_ROUNDS && !is_good(s) && s->left > 0 && !is_late(s, budget));
  return code;
}

/* Projected Newton steps on the energy with a line search: no set of free rows comes back (Bertsekas 1982). */
static int32_t descend(lav_solver *s, const lav_budget *budget) {
  struct pivot_principal_pivoting_t *t = &s->pivots;
  const int32_t m = s->p.n_rows;
  double *x = s->search, *w = x + m, *step = w + m, length, promised, gained;
  int32_t *at = s->pivot_marks + 3 * m, i, half, fixed, same, whole, done;
  clip_rows(s, t->x);
  pivot_principal_pivots_slack(t);
  COPY(x, t->x, m);
  COPY(w, t->w, m);
  for (; s->left > 0; s->left--) {
    for (i = 0, same = t->is_factored; i < m; i++) {
      const double slop = SLOP * t->f[i];
      fixed = s->q.lower[i] == s->q.upper[i] || (x[i] <= s->q.lower[i] && w[i] >= -slop);
      at[i] = fixed ? -1 : x[i] >= s->q.upper[i] && w[i] <= slop;
      if (at[i] != t->at[i]) same = 0;
    }
    if (!same) {
      COPY(t->at, at, m);
      pivot_principal_factor_free(t, NULL);
      if (t->found.negative > 0) return pivot_principal_INDEFINITE;
      if (t->found.small > 0) return pivot_principal_SMALL;
    }
    pivot_principal_pivots_correct(t);
    for (i = 0; i < m; i++) step[i] = t->x[i] - x[i];
    for (half = 0, length = 1.0; half < HALVINGS; half++) {
      for (i = 0; i < m; i++) {
        const double y = x[i] + length * step[i];
        t->x[i] = y < s->q.lower[i] ? s->q.lower[i] : y > s->q.upper[i] ? s->q.upper[i] : y;
      }
      pivot_principal_pivots_slack(t);
      for (i = 0, promised = gained = 0.0; i < m; i++) { /* phi(y) - phi(x) = 1/2 (w(x) + w(y)).(y - x) */
        promised += w[i] * (t->x[i] - x[i]);
        gained += (w[i] + t->w[i]) * (t->x[i] - x[i]);
      }
      if (0.5 * gained <= 1e-4 * promised) break;
      length *= 0.5;
    }
    for (i = 0, whole = length == 1.0, done = 1; i < m; i++) {
      const double slop = SLOP * t->f[i], reach = slop / s->q.d[i], y = x[i] + step[i];
      if (!(y >= s->q.lower[i] - reach && y <= s->q.upper[i] + reach)) whole = 0;
      if ((at[i] < 0 && s->q.lower[i] != s->q.upper[i] && t->w[i] < -slop) || (at[i] > 0 && t->w[i] > slop)) done = 0;
    }
    COPY(x, t->x, m);
    COPY(w, t->w, m);
    if (whole && done) {
      s->left--;
      return pivot_principal_SOLVED;
    }
    if (is_late(s, budget)) break;
  }
  return pivot_principal_ROUNDS;
}

/* Passes on A + s D around the last answer, where A is singular; along falling s where exchanges are stuck. */
static int32_t proximal(lav_solver *s, const lav_budget *budget, int32_t stuck) {
  struct pivot_principal_pivoting_t *t = &s->pivots;
  const int32_t m = s->p.n_rows;
  int32_t at = stuck ? 0 : SHIFTS - 1, pass, i, code, waited = 0;
  double reference = INFINITY, relative, previous, shift = 0.0, next = 0.0;
  COPY(t->x, s->best_floor <= RUNAWAY && s->best < INFINITY ? s->impulse : s->from, m);
  for (pass = 0; pass < PASSES && waited < STAYING; pass++) {
    COPY(t->center, t->x, m);
    if (next > 0.0 || at < SHIFTS) {
      shift = next > 0.0 ? next : SHIFT[at++];
      next = 0.0;
      pivot_principal_pivots_start(t, shift);
    }
    pivot_principal_pivots_restart(t);
    code = stuck ? descend(s, budget) : rounds(s, budget);
    relative = stuck && (code == pivot_principal_SOLVED || code == pivot_principal_ROUNDS) ? look(s) : s->best;
    if (is_end(s)) return LAV_CONVERGED;
    if (code == pivot_principal_ROUNDS) return is_late(s, budget) ? LAV_TIME_LIMIT : LAV_MAX_ITERATIONS;
    if (code == pivot_principal_STUCK) {
      if (!s->is_symmetric) return LAV_STALLED;
      stuck = 1, at = 0;
      COPY(t->x, t->center, m);
      clip_rows(s, t->x);
      continue;
    }
    if (code != pivot_principal_SOLVED) {
      if (shift >= SHIFT[0]) return LAV_FAILED;
      next = 100.0 * shift, at = SHIFTS;
      COPY(t->x, t->center, m);
      continue;
    }
    clip_rows(s, s->tried);
    { /* refine on the rows found, whatever signs rounding gives */
      lav_verdict now;
      judge(s, s->tried, 1, &now);
      relative = now.relative;
    }
    for (i = 0, previous = INFINITY; i < CORRECTIONS && !is_good(s) && relative < 0.5 * previous; i++) {
      previous = relative;
      COPY(t->center, t->x, m);
      pivot_principal_pivots_slack(t);
      pivot_principal_pivots_correct(t);
      pivot_principal_pivots_slack(t);
      relative = look(s);
      if (!(relative < previous)) COPY(t->x, t->center, m);
    }
    if (is_end(s)) return LAV_CONVERGED;
    if (at < SHIFTS || s->best <= 0.5 * reference) reference = s->best, waited = 0;
    else waited += 1;
    if (is_late(s, budget)) return LAV_TIME_LIMIT;
  }
  return LAV_STALLED;
}

static int32_t pivot_all(lav_solver *s, const lav_budget *budget, lav_result *out) {
  struct pivot_principal_pivoting_t *t = &s->pivots;
  int32_t code, swept = 0;
  if (s->is_linear) {
    pivot_principal_pivots_factor_all(t);
    s->left -= 1;
    if (t->found.negative > 0) return LAV_FAILED; /* the package goes on with LAPACK */
    if (t->found.small == 0) {
      pivot_principal_pivots_solve_free(t);
      if (look(s) > 0.0 && !is_good(s)) {
        pivot_principal_pivots_slack(t);
        refine(s, s->best);
      }
      return is_end(s) ? LAV_CONVERGED : s->is_symmetric ? proximal(s, budget, 0) : LAV_STALLED;
    }
    return s->is_symmetric ? proximal(s, budget, 0) : LAV_FAILED;
  }
  code = pivot_principal_pivots_solve(t, s->from, GUESS_SWEEPS, s->left < BATCH ? s->left : BATCH, &swept);
  s->left -= t->n_rounds;
  out->sweeps = 2 * GUESS_SWEEPS * swept;
  code = after_rounds(s, code);
  if (code == pivot_principal_ROUNDS && !is_good(s) && s->left > 0 && !is_late(s, budget)) code = rounds(s, budget);
  if (is_good(s)) return LAV_CONVERGED;
  if (code == pivot_principal_ROUNDS) return is_late(s, budget) ? LAV_TIME_LIMIT : LAV_MAX_ITERATIONS;
  if (code == pivot_principal_INDEFINITE) return LAV_FAILED;
  if (code == pivot_principal_STUCK && !s->is_symmetric) return LAV_STALLED; /* no energy to descend on; see lemke */
  return proximal(s, budget, code == pivot_principal_STUCK);
}

/* Lemke's path, then exchanges from the sides on which it leaves the rows. */
static int32_t follow_path(lav_solver *s, const lav_budget *budget, lav_result *out) {
  struct pivot_principal_pivoting_t *t = &s->pivots;
  int32_t done = 0, code;
  COPY(t->x, s->from, s->p.n_rows);
  code = k_lemke_rows(&s->q, &s->a, TINY_PATH, s->left, s->table, s->whole, t->at, t->x, &done);
  s->left -= done;
  if (code != pivot_tableau_DONE) return code == pivot_tableau_PIVOTS ? LAV_MAX_ITERATIONS : LAV_STALLED;
  look(s);
  pivot_principal_pivots_start(t, 0.0);
  out->iterations = done;
  if (!is_good(s)) {
    s->left = BATCH;
    rounds(s, budget);
    s->left = budget->iterations - done;
  }
  return LAV_STALLED;
}

static void run_pivots(lav_solver *s, const lav_budget *budget, lav_result *out) {
  const int64_t m = s->p.n_rows;
  memset(s->pivot_room, 0, (size_t)(6 * m + 1) * sizeof(double));
  memset(s->pivot_marks, 0, (size_t)(4 * m) * sizeof(int32_t));
  s->from = s->pivot_room + 6 * m;
  s->tried = s->from + m;
  s->search = s->tried + m;
  COPY(s->from, s->impulse, m);
  s->left = budget->iterations;
  s->best = INFINITY;
  s->best_floor = 0.0;
  pivot_principal_pivots_on(&s->pivots, &s->a, &s->q, s->band, TINY_PIVOT, s->pivot_room, s->pivot_marks);
  s->pivots.c = s->search + 3 * m;
  if (!s->is_symmetric) s->pivots.swap = s->pivot_marks + 2 * m;
  out->outcome = s->options.method == LAV_LEMKE ? follow_path(s, budget, out) : pivot_all(s, budget, out);
  if (out->outcome == LAV_CONVERGED || out->outcome == LAV_STALLED)
    out->outcome = s->best <= budget->tol || (budget->tol == 0.0 && is_end(s)) ? LAV_CONVERGED
                   : s->best <= 2.0 * s->best_floor && s->best < 1.0           ? LAV_FLOOR
                                                                               : LAV_STALLED;
  out->iterations = budget->iterations - s->left;
  out->restarts = s->pivots.factorisations;
}
#endif
