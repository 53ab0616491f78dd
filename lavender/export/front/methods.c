
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

static int32_t is_accelerated(const lav_solver *s) {
  return s->options.method == LAV_ANDERSON || s->options.method == LAV_NNCG;
}

/* Blocks in pairs, once sweeps are many: the same bits. */
static void pack_pairs(lav_solver *s, int32_t n) {
  if (!is_accelerated(s) || s->pairs_asked || s->fast.turn + (int64_t)n < PACK_ACCELERATED) return;
  s->pairs_asked = 1;
  s->fast.backwards = 0;
  if (sweep_packed_pack_order(&s->p, &s->r, s->order, 1, s->pair_room, s->impulse, &s->pairs)) s->fast.packed = &s->pairs;
}

static int32_t restarts_of(const lav_solver *s) {
  if (s->options.method == LAV_BLOCK_GAUSS_SEIDEL) return (int32_t)s->local.fallbacks;
  if (s->options.method == LAV_ADMM) return s->factors;
  return is_accelerated(s) ? (int32_t)s->fast.control[s->fast.memory == 0 ? 1 : accelerate_mixing_UNDONE] : 0;
}

static int32_t begins_again(lav_solver *s) {
  if (!is_accelerated(s) || !judge_watch_begins_again(&s->watch, AGAIN)) return 0;
  accelerate_accelerated_forget_all(&s->fast, s->impulse);
  return 1;
}

/* -- methods over A: of bodies it is formed first --------------------------------------------------------------------- */

static int32_t form_matrix(lav_solver *s) {
  const int64_t m = s->p.n_rows, k = s->p.n_blocks;
  int32_t *start, *blocks, *near, *indptr, *index;
  double *data, *jac;
  int64_t most;
  s->q = s->p;
  if (s->form == LAV_MATRIX) return LAV_OK;
  if (s->form == LAV_VELOCITIES) return LAV_ERROR_UNSUPPORTED;
  start = TAKE(s, int32_t, s->r.n_bodies + 1);
  blocks = TAKE(s, int32_t, 2 * k + 1);
  if (s->is_short) return LAV_ERROR_ROOM;
  k_body_blocks(&s->p, &s->r, start, blocks, &most);
  if (most >= 2147483647) return LAV_ERROR_COUNT;
  near = TAKE(s, int32_t, 4 * k + 2 + m);
  indptr = TAKE(s, int32_t, m + 1);
  index = TAKE(s, int32_t, most);
  data = TAKE(s, double, most);
  jac = TAKE(s, double, 24 * m);
  s->q.d = TAKE(s, double, m);
  s->q.nu = TAKE(s, double, m);
  s->q.step = TAKE(s, double, m);
  if (s->is_short) return LAV_ERROR_ROOM;
  k_expand_rows(&s->p, &s->r, jac, jac + 12 * m);
  k_assemble(&s->p, &s->r, jac, jac + 12 * m, start, blocks, near, near + 2 * k + 1, near + 4 * k + 2, indptr, index, data);
  s->a.indptr = indptr;
  s->a.indices = index;
  s->a.data = data;
  k_csr_diagonal(&s->q, &s->a, (double *)(uintptr_t)s->q.d, (double *)(uintptr_t)s->q.step, near);
  k_matrix_nu(&s->q, (double *)(uintptr_t)s->q.nu);
  return LAV_OK;
}

/* -- newton ----------------------------------------------------------------------------------------------------------- */

static const double CLOSEST = 1e-2;

/* On the impulse as it stands; rows of a formed A where it does not go over bodies. */
static int32_t start_newton(lav_solver *s, double tol, int32_t budget, int32_t cold) {
  s->asked.tol = tol;
  s->asked.budget = budget;
  s->asked.cold = cold;
  return k_start(&s->view, &s->asked, &s->drive, s->impulse);
}

static int32_t prepare_newton(lav_solver *s) {
  uint64_t from = s->used;
  int32_t how = driver_driver_ROOM;
  memset(&s->view, 0, sizeof s->view);
  memset(&s->asked, 0, sizeof s->asked);
  s->asked.method = driver_driver_NEWTON;
  s->asked.wide = LAVENDER_HAS_WIDE();
  s->view.p = s->p;
  if (s->form == LAV_MATRIX) s->view.a = &s->a;
  else if (s->form == LAV_BODIES) s->view.r = &s->r;
  else s->view.g = &s->g;
  s->driven = 0;
  if (s->p.n_rows == 0) return LAV_OK;
  if (!k_room(&s->view, &s->asked, &s->drive)) {
    GIVE_BACK(form_matrix(s));
    s->view.r = NULL;
    s->view.a = &s->a;
    if (!k_room(&s->view, &s->asked, &s->drive)) return LAV_ERROR_UNSUPPORTED;
    from = s->used;
  }
  while (how == driver_driver_ROOM) {
    s->used = from;
    s->drive.index = TAKE(s, int32_t, s->drive.n_index);
    s->drive.real = TAKE(s, double, s->drive.n_real);
    if (s->is_short) return LAV_ERROR_ROOM;
    how = s->view.a ? newton_plan_MORE : start_newton(s, 1e-6, 1000, 1); /* tells the room, and begins most runs */
  }
  s->driven = s->view.a == NULL;
  return LAV_OK;
}

static void run_newton(lav_solver *s, const lav_budget *budget, lav_result *out) {
  struct driver_driver_said_t said = {0, 0.0, NULL};
  double closer = 1.0;
  int32_t cold = 1, how = newton_plan_MORE, i, same = 1, before = 0;
  lav_verdict now;
  judge_measure_do_nothing(&s->p, s->watch.e, s->watch.w);
  for (i = 0; i < s->p.n_rows; i++) {
    if (s->impulse[i] != 0.0) cold = 0;
    if (s->impulse[i] != s->watch.e[i]) same = 0;
  }
  cold = cold || same;
  if (!s->driven || budget->tol != s->asked.tol || budget->iterations != s->asked.budget || cold != s->asked.cold)
    how = start_newton(s, budget->tol, budget->iterations, cold);
  s->driven = 0;
  while (out->outcome == LAV_MAX_ITERATIONS && out->iterations < budget->iterations) {
    how = k_step(&s->view, &s->asked, &s->drive, is_timed(budget) ? 1 : 1 << 30, s->impulse, &said);
    out->iterations = before + said.factorisations;
    if (how == newton_plan_SPENT) break;
    if (how == newton_plan_REACHED) {
      judge(s, s->impulse, 1, &now); /* over velocities sums are rounded in another order, and vanish where squares do */
      if (now.relative <= budget->tol) out->outcome = LAV_CONVERGED;
      else if (closer <= CLOSEST || budget->iterations <= out->iterations) out->outcome = LAV_STALLED;
      else {
        before = out->iterations;
        closer *= 0.25;
        start_newton(s, closer * budget->tol, budget->iterations - before, 0);
      }
    } else if (how == newton_plan_FLOOR) out->outcome = LAV_FLOOR;
    else if (how == newton_plan_STUCK) out->outcome = LAV_STALLED;
    else if (is_late(s, budget)) out->outcome = LAV_TIME_LIMIT;
  }
  out->restarts = out->iterations;
}

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
  if (m > 0 && s->a.indptr[m] > 0) k_csr_scan(&s->a, (int32_t)m, s->marks, bands, size);
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

/* Residual of x within its bounds; the best is the result. */
static double look(lav_solver *s) {
  lav_verdict found;
  few_island_clipped(&s->pivots, s->tried);
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
    k_pivot_correct(&s->pivots);
    k_pivot_slack(&s->pivots);
    if (k_pivot_exchange(&s->pivots)) return pivot_principal_ROUNDS;
    relative = look(s);
  }
  return pivot_principal_SOLVED;
}

static int32_t after_rounds(lav_solver *s, int32_t code) {
  double relative;
  if (code == pivot_principal_SMALL || code == pivot_principal_INDEFINITE) return code;
  relative = look(s);
  if (code != pivot_principal_SOLVED || s->pivots.shift != 0.0 || is_good(s)) return code;
  k_pivot_slack(&s->pivots);
  return refine(s, relative);
}

/* Rounds of solving and exchanging, until no sign is wrong or the budget is used up. */
static int32_t rounds(lav_solver *s, const lav_budget *budget) {
  int32_t code, before;
  do {
    before = s->pivots.n_rounds;
    code = after_rounds(s, k_pivot_rounds(&s->pivots, s->left < BATCH ? s->left : BATCH));
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
  few_island_clipped(t, t->x);
  k_pivot_slack(t);
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
      k_pivot_factor(t);
      if (t->found.negative > 0) return pivot_principal_INDEFINITE;
      if (t->found.small > 0) return pivot_principal_SMALL;
    }
    k_pivot_correct(t);
    for (i = 0; i < m; i++) step[i] = t->x[i] - x[i];
    for (half = 0, length = 1.0; half < HALVINGS; half++) {
      for (i = 0; i < m; i++) {
        const double y = x[i] + length * step[i];
        t->x[i] = y < s->q.lower[i] ? s->q.lower[i] : y > s->q.upper[i] ? s->q.upper[i] : y;
      }
      k_pivot_slack(t);
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
      few_island_clipped(t, t->x);
      continue;
    }
    if (code != pivot_principal_SOLVED) {
      if (shift >= SHIFT[0]) return LAV_FAILED;
      next = 100.0 * shift, at = SHIFTS;
      COPY(t->x, t->center, m);
      continue;
    }
    few_island_clipped(t, s->tried);
    { /* refine on the rows found, whatever signs rounding gives */
      lav_verdict now;
      judge(s, s->tried, 1, &now);
      relative = now.relative;
    }
    for (i = 0, previous = INFINITY; i < CORRECTIONS && !is_good(s) && relative < 0.5 * previous; i++) {
      previous = relative;
      COPY(t->center, t->x, m);
      k_pivot_slack(t);
      k_pivot_correct(t);
      k_pivot_slack(t);
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
    k_pivot_factor_all(t);
    s->left -= 1;
    if (t->found.negative > 0) return LAV_FAILED; /* the package goes on with LAPACK */
    if (t->found.small == 0) {
      k_pivot_solve_free(t);
      if (look(s) > 0.0 && !is_good(s)) {
        k_pivot_slack(t);
        refine(s, s->best);
      }
      return is_end(s) ? LAV_CONVERGED : s->is_symmetric ? proximal(s, budget, 0) : LAV_STALLED;
    }
    return s->is_symmetric ? proximal(s, budget, 0) : LAV_FAILED;
  }
  code = k_pivot_solve(t, s->from, GUESS_SWEEPS, s->left < BATCH ? s->left : BATCH, &swept);
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

/* -- admm on a dense factor ------------------------------------------------------------------------------------------- */

static const double FIRST_RHO = 0.1, RELAXATION = 1.6;

/* L L^T = D^-1/2 A D^-1/2 + rho, row by row; 0 where a pivot is not positive. */
static int32_t factor_shifted(lav_solver *s) {
  const int32_t m = s->p.n_rows;
  const double *root = s->splitting.root;
  int32_t i, j, q;
  s->factors += 1;
  for (i = 0; i < m; i++) {
    double *row = s->table + (int64_t)i * m;
    memset(row, 0, (size_t)(i + 1) * sizeof(double));
    for (q = s->a.indptr[i]; q < s->a.indptr[i + 1]; q++)
      if (s->a.indices[q] <= i) row[s->a.indices[q]] += s->a.data[q] / (root[i] * root[s->a.indices[q]]);
    row[i] += s->splitting.rho;
    for (j = 0; j < i; j++) {
      const double *to = s->table + (int64_t)j * m;
      row[j] = (row[j] - accelerate_mixing_product(row, to, j)) / to[j];
    }
    row[i] -= accelerate_mixing_product(row, row, i);
    if (!(row[i] > 0.0)) return 0;
    row[i] = sqrt(row[i]);
  }
  return 1;
}

static void admm_step(void *context, double *lam, int32_t first, int32_t n) {
  lav_solver *s = (lav_solver *)context;
  struct accelerate_admm_admm_t *c = &s->splitting;
  int32_t i;
  if (first) { /* at a solution the first iteration stays there */
    for (i = 0; i < s->p.n_rows; i++) c->x[i] = core_csr_csr_dot(&s->a, i, lam) - s->p.b[i];
    k_admm_start(&s->p, lam, c->x, c->root, c->rho, c->u, c->y);
  }
  while (n > 0 && !s->is_broken) {
    const double rho = k_admm(c, &s->factor, &s->mixing, lam, &n);
    if (rho > 0.0) {
      c->rho = rho;
      s->is_broken = !factor_shifted(s);
    }
  }
}

static int32_t prepare_admm(lav_solver *s) {
  const int64_t m = s->p.n_rows;
  struct accelerate_admm_admm_t *c = &s->splitting;
  const int32_t memory = s->options.memory;
  double *x, *root, *shift, size[2] = {0.0, 0.0};
  int32_t i, bands[2];
  GIVE_BACK(form_matrix(s));
  if (m > 0 && s->a.indptr[m] > 0) k_csr_scan(&s->a, (int32_t)m, s->marks, bands, size);
  if (size[1] > 0.0 && size[0] / size[1] > 1e-14) return LAV_ERROR_UNSUPPORTED; /* L L^T alone: A is not symmetric */
  s->table = TAKE(s, double, m * m);
  x = TAKE(s, double, (10 + 2 * (int64_t)memory) * m + CONTROL + GRAM + 4);
  if (s->is_short) return LAV_ERROR_ROOM;
  memset(x, 0, (size_t)((10 + 2 * (int64_t)memory) * m + CONTROL + GRAM + 4) * sizeof(double));
  c->blocks = &s->p;
  c->turn = x;
  s->mixing.control = x + 4;
  s->mixing.gram = s->mixing.control + CONTROL;
  root = s->mixing.gram + GRAM;
  shift = root + m;
  c->u = shift + m;
  c->z = c->u + m;
  c->y = c->z + m;
  c->x = c->y + m;
  c->g = c->x + m;
  c->before = c->g + m;
  c->work = NULL;
  s->mixing.v = c->before + m;
  s->mixing.g = s->mixing.v + m;
  s->mixing.dv = s->mixing.g + m;
  s->mixing.dg = s->mixing.dv + memory * m;
  s->mixing.m = (int32_t)m;
  s->mixing.memory = memory;
  for (i = 0; i < m; i++) {
    root[i] = sqrt(s->p.d[i]);
    shift[i] = s->p.b[i] / root[i];
  }
  c->root = root;
  c->c = shift;
  c->rho = FIRST_RHO;
  c->alpha = RELAXATION;
  memset(&s->factor, 0, sizeof s->factor);
  s->factor.kind = accelerate_admm_DENSE;
  s->factor.n = (int32_t)m;
  s->factor.dense = s->table;
  s->factors = 0;
  s->is_broken = !factor_shifted(s);
  s->context = s;
  s->step = admm_step;
  return LAV_OK;
}

/* -- auto: one method after the other, each for its share ------------------------------------------------------------- */

/* Turns of the library's own, by form, size and what the blocks are; returns how many. */
static int32_t usual_turns(const lav_problem *q, int32_t *turns) {
  const int32_t few = q->n_rows <= FEW_ROWS, rows = are_rows(q);
  int32_t n = 0;
  if (q->form == LAV_VELOCITIES) turns[n++] = LAV_NEWTON, turns[n++] = 200;
  else if (rows && few) turns[n++] = LAV_DIRECT, turns[n++] = 100;
  turns[n++] = LAV_ANDERSON, turns[n++] = 200;
  if (q->form == LAV_BODIES || (q->form == LAV_MATRIX && few)) turns[n++] = LAV_NEWTON, turns[n++] = 100;
  turns[n++] = LAV_NNCG, turns[n++] = 200;
  if (q->form != LAV_VELOCITIES && few) {
    turns[n++] = LAV_ADMM, turns[n++] = 400;
    if (rows) turns[n++] = LAV_LEMKE, turns[n++] = 8 * q->n_rows;
  }
  return n / 2;
}

/* The method of turn i laid out in the memory behind the problem. */
static int32_t take_turn(lav_solver *s, int32_t i) {
  s->options.method = s->turns[2 * i];
  s->used = s->common;
  s->is_short = 0;
  return prepare(s);
}

static int32_t prepare_auto(lav_solver *s, const lav_problem *q) {
  int32_t i, kept = 0, code = LAV_ERROR_UNSUPPORTED;
  s->n_turns = s->options.n_turns;
  if (s->n_turns > 0) COPY(s->turns, s->given_turns, 2 * s->n_turns);
  else s->n_turns = usual_turns(q, s->turns);
  s->chosen = TAKE(s, double, s->p.n_rows);
  s->common = s->used;
  for (i = 0; i < s->n_turns; i++) { /* those that take it */
    s->options.method = s->turns[2 * i];
    if (takes(q, &s->options) != LAV_OK) continue;
    s->turns[2 * kept] = s->turns[2 * i];
    s->turns[2 * kept++ + 1] = s->turns[2 * i + 1];
  }
  s->n_turns = kept;
  if (kept > 0) code = s->is_short ? LAV_ERROR_ROOM : take_turn(s, 0);
  s->options.method = LAV_AUTO;
  s->at_turn = 0;
  return code;
}

static int32_t run_auto(lav_solver *s, const lav_budget *budget, lav_result *out) {
  double best = INFINITY;
  int32_t i = 0, n, round = 1, worked, code = LAV_OK, short_of = 0;
  COPY(s->chosen, s->impulse, s->p.n_rows);
  out->method = s->turns[0];
  for (worked = 0;; i++) {
    lav_budget turn = *budget;
    lav_result part = *out;
    lav_verdict found;
    if (i == s->n_turns) { /* again, four times as long; none of them works: there is nothing to do */
      if (!worked || out->iterations >= budget->iterations) break;
      i = worked = 0;
      if (round < 1 << 20) round *= 4;
    }
    n = s->turns[2 * i + 1] < (1 << 30) / round ? round * s->turns[2 * i + 1] : 1 << 30;
    turn.iterations = n < budget->iterations - out->iterations ? n : budget->iterations - out->iterations;
    if (turn.iterations <= 0 || is_late(s, budget)) break;
    if (s->at_turn != i) {
      COPY(s->impulse, s->chosen, s->p.n_rows);
      code = take_turn(s, i);
      if (code == LAV_ERROR_ROOM) short_of = s->used + 32 > s->needed ? (s->needed = s->used + 32, 1) : 1;
      s->at_turn = code == LAV_OK ? i : -1;
      if (code != LAV_OK) continue;
    } else s->options.method = s->turns[2 * i];
    part.outcome = LAV_MAX_ITERATIONS;
    part.iterations = part.sweeps = part.restarts = 0;
    begin_method(s);
    run_method(s, &turn, &part);
    s->at_turn = -1;
    out->iterations += part.iterations;
    out->sweeps += part.sweeps;
    worked += part.iterations;
    judge(s, s->impulse, 1, &found);
    if (found.relative < best || best == INFINITY) {
      best = found.relative;
      COPY(s->chosen, s->impulse, s->p.n_rows);
      out->method = s->options.method;
    }
    if (best <= budget->tol || (best <= 2.0 * found.floor && best < 1.0 && found.relative == best)) {
      out->outcome = best <= budget->tol ? LAV_CONVERGED : LAV_FLOOR;
      break;
    }
  }
  COPY(s->impulse, s->chosen, s->p.n_rows);
  s->options.method = LAV_AUTO;
  if (out->outcome == LAV_MAX_ITERATIONS && is_late(s, budget)) out->outcome = LAV_TIME_LIMIT;
  else if (out->outcome == LAV_MAX_ITERATIONS && out->iterations < budget->iterations) out->outcome = LAV_STALLED;
  return short_of && out->outcome != LAV_CONVERGED ? LAV_ERROR_ROOM : LAV_OK;
}
#endif
