
/* -- sweeps, accelerated or not --------------------------------------------------------------------------------------- */

#ifndef LAV_SWEEPS_ONLY
static int32_t restarts_of(const lav_solver *s) {
  if (s->options.method == LAV_ADMM) return s->factors;
  return (int32_t)(is_accelerated(&s->options) ? accelerate_accelerated_count_undone_steps(&s->acceleration) : s->swept.context.fallbacks);
}
#endif

static int32_t start_sweeps(lav_solver *s) {
  const lav_options *o = &s->options;
  struct sweep_serial_sweep_run_t *x = &s->swept;
  int32_t *place = NULL;
  int64_t numbers, more = 0;
  double *workspace;
#ifndef LAV_SWEEPS_ONLY
  const int32_t rubs = s->rubs, is_cone = s->p.law == LAV_CONE && rubs;
  const int32_t memory = o->method == LAV_NNCG ? 0 : o->memory, convex = rubs && !is_cone ? o->convex : 0,
                cone_sweeps = accelerate_accelerated_count_convex_iterations(s->p.n_rows, convex);
  x->packing.single = is_accelerated(o);
  x->context.exact = o->method == LAV_BLOCK_GAUSS_SEIDEL;
  if (x->packing.single) {
    x->context.exact = o->sweep == LAV_BLOCK_SWEEP || (o->sweep == LAV_DEFAULT_SWEEP && is_cone);
    more = accelerate_accelerated_accelerated_workspace_size(s->p.n_rows, s->n_v, memory);
  }
  if (x->context.exact || (x->packing.single && cone_sweeps > 0)) {
    place = TAKE(s, int32_t, s->p.n_blocks);
    if (s->is_short) return LAV_ERROR_WORKSPACE;
  }
#endif
  x->context.order = o->method == LAV_PGS && s->in_rows ? NULL : s->order;
  x->context.split = s->split;
  x->context.mode = s->mode;
  x->context.rng = &s->rng;
  x->context.omega = o->method == LAV_JACOBI && o->omega == 0.0 ? sweep_serial_compute_jacobi_damping(&s->p, &s->a, s->stopping_test.e) : o->omega;
  x->context.method = o->method == LAV_JACOBI                                     ? sweep_serial_JACOBI
                      : o->method == LAV_SOR || o->method == LAV_GAUSS_SEIDEL ? sweep_serial_SOR
                                                                              : sweep_serial_SWEEPS;
  x->step = sweep_serial_run_sweep_chunk;
  numbers = sweep_serial_sweeps_workspace_size(x, &s->read, place);
  if (numbers < 0) return LAV_ERROR_COUNT;
  workspace = TAKE(s, double, numbers + more);
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  memset(workspace, 0, (size_t)(numbers + more) * sizeof(double));
  sweep_serial_start_sweeps(x, &s->read, place, workspace);
#ifndef LAV_SWEEPS_ONLY
  if (x->packing.single) accelerate_accelerated_start_accelerated_sweeps(x, &s->acceleration, memory, convex, o->keeps, workspace + numbers);
  if (sweep_serial_can_pack_blocks(x, &s->read)) {
    x->context.packing = &x->packing;
    x->packing.workspace = TAKE(s, double, sweep_packed_packed_workspace_size_of_blocks(&s->p, &s->r));
  }
#endif
  return s->is_short ? LAV_ERROR_WORKSPACE : LAV_OK;
}

static int32_t is_timed(const lav_budget *budget) { return budget->seconds > 0.0; }

static int32_t is_late(const lav_solver *s, const lav_budget *budget) {
  return is_timed(budget) && !(budget->clock(budget->clock_data) < s->deadline);
}

/* Run sweeps until a check, the budget or the clock ends them. */
static void run_sweeps(lav_solver *s, const lav_budget *budget, lav_result *out) {
  const double begin = is_timed(budget) ? budget->clock(budget->clock_data) : 0.0;
  double now = begin, left;
  int32_t status = judge_stopping_test_RUNNING, n = is_timed(budget) ? 1 : budget->iterations, done;

#ifndef LAV_SWEEPS_ONLY
  const int32_t before = s->options.method == LAV_BLOCK_GAUSS_SEIDEL || s->options.method == LAV_ADMM ? restarts_of(s) : 0;
#endif
  while (out->iterations < budget->iterations && status == judge_stopping_test_RUNNING) {
    if (n > budget->iterations - out->iterations) n = budget->iterations - out->iterations;
    status = sweep_serial_run_sweeps(&s->swept, &s->stopping_test, &s->read, NULL, s->impulse, n, budget->tol, &done);
    out->iterations += done;
#ifndef LAV_SWEEPS_ONLY
    if (s->is_broken) {
      out->outcome = LAV_FAILED;
      break;
    }
#endif
    if (is_timed(budget) && status == judge_stopping_test_RUNNING) {
      now = budget->clock(budget->clock_data);
      left = s->deadline - now;
      if (!(left > 0.0)) {
        out->outcome = LAV_TIME_LIMIT;
        break;
      }
      left = 0.5 * left * out->iterations / (now > begin ? now - begin : 1e-7); /* Iterations for half of the remaining time. */
      n = left < 1.0 ? 1 : left > 4.0 * n ? (n < 250000000 ? 4 * n : n) : (int32_t)left;
    }
  }
  if (status != judge_stopping_test_RUNNING) out->outcome = status; /* Both enums have the same numbers. */
  out->sweeps = out->iterations;
#ifndef LAV_SWEEPS_ONLY
  out->restarts = restarts_of(s) - before;
  if (s->mode == core_order_SYMMETRIC && is_accelerated(&s->options)) out->sweeps *= 2;
#endif
  if (budget->tol > 0.0 && s->stopping_test.best_at >= 0 && out->outcome != LAV_CONVERGED) { /* The residual may have risen: return the best iterate. */
    if (see(s, s->impulse, budget->tol) > budget->tol) {
      judge_stopping_test_restore_at_end(&s->stopping_test, &s->read, s->impulse, budget->tol);
      sweep_serial_compute_sweep_velocities(&s->swept.context, s->impulse);
    }
  }
}

#ifndef LAV_SWEEPS_ONLY
/* -- methods that use A; of bodies, A is formed first ----------------------------------------------------------------- */

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
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  k_list_blocks_of_bodies(&s->p, &s->r, start, blocks, &most);
  if (most >= 2147483647) return LAV_ERROR_COUNT;
  near = TAKE(s, int32_t, 4 * k + 2 + m);
  indptr = TAKE(s, int32_t, m + 1);
  index = TAKE(s, int32_t, most);
  data = TAKE(s, double, most);
  jac = TAKE(s, double, 24 * m);
  s->q.d = TAKE(s, double, m);
  s->q.nu = TAKE(s, double, m);
  s->q.step = TAKE(s, double, m);
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  k_form_delassus_matrix(&s->p, &s->r, start, blocks, jac, near, indptr, index, data);
  s->a.indptr = indptr;
  s->a.indices = index;
  s->a.data = data;
  k_compute_csr_diagonal(&s->q, &s->a, near);
  return LAV_OK;
}

/* -- newton ----------------------------------------------------------------------------------------------------------- */

static const double CLOSEST = 1e-2;

/* Take the memory of Newton's method after that of the problem; return 0 if the workspace is too small. */
static int32_t grow_newton(struct core_method_workspace_t *memory, int64_t n_index, int64_t n_real) {
  lav_solver *s = (lav_solver *)(void *)((char *)memory - offsetof(lav_solver, newton_memory));
  s->used = s->newton_begin;
  memory->index = TAKE(s, int32_t, n_index);
  memory->real = TAKE(s, double, n_real);
  return !s->is_short;
}

/* Start Newton's method at the present impulse, over bodies or over the rows of A if A was formed. */
static int32_t begin_newton(lav_solver *s, double tol, int32_t budget) {
  s->newton_options.tol = tol;
  s->newton_options.budget = budget;
  s->newton_options.e0 = s->start[0];
  s->newton_options.v0 = s->start[1];
  s->newton_options.most = INFINITY;
  return k_start(&s->view, &s->newton_options, &s->drive, s->impulse, &s->newton_memory, grow_newton);
}

static int32_t start_newton(lav_solver *s) {
  int32_t outcome;
  s->newton_options.method = driver_driver_NEWTON;
  s->newton_options.wide = LAVENDER_HAS_WIDE();
  s->view = s->read;
  s->driven = 0;
  if (s->p.n_rows == 0) return LAV_OK;
  if (!k_workspace_size(&s->view, &s->newton_options, &s->drive)) {
    GIVE_BACK(form_matrix(s));
    s->view.r = NULL;
    s->view.a = &s->a;
    if (!k_workspace_size(&s->view, &s->newton_options, &s->drive)) return LAV_ERROR_UNSUPPORTED;
  }
  s->newton_begin = s->used;
  outcome = begin_newton(s, s->newton_options.tol, s->newton_options.budget); /* Starting with the last options gives the workspace size. */
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  if (outcome == core_method_UNFIT) return LAV_ERROR_FACTOR;
  s->driven = 1;
  return LAV_OK;
}

static void run_newton(lav_solver *s, const lav_budget *budget, lav_result *out) {
  struct core_method_info_t info = {0, 0, 0, 0, 0.0, NULL, NULL};
  double closer = 1.0;
  int32_t how = core_method_MORE, before = 0;
  lav_verdict now;
  if (!s->driven || budget->tol != s->newton_options.tol || budget->iterations != s->newton_options.budget)
    how = begin_newton(s, budget->tol, budget->iterations);
  s->driven = 0;
  COPY(s->compare, s->impulse, s->p.n_rows);
  while (out->outcome == LAV_MAX_ITERATIONS && out->iterations < budget->iterations) {
    how = k_step(&s->view, &s->newton_options, &s->drive, 1 << 30, s->impulse, &info);
    out->iterations = before + info.work;
    if (how == core_method_SPENT) {
      if (out->iterations < budget->iterations && is_late(s, budget)) out->outcome = LAV_TIME_LIMIT;
      break;
    }
    if (how == core_method_REACHED) {
      judge(s, s->impulse, 1, INFINITY, &now); /* Confirm it: the velocity form rounds sums in another order, and its squares may underflow. */
      if (now.relative <= budget->tol) {
        out->outcome = LAV_CONVERGED;
        if (out->iterations == 0) { /* Scaling has rounded a start that is a solution. */
          judge(s, s->compare, 1, INFINITY, &now);
          if (now.relative <= budget->tol) COPY(s->impulse, s->compare, s->p.n_rows);
        }
      } else if (closer <= CLOSEST || budget->iterations <= out->iterations) out->outcome = LAV_STALLED;
      else {
        before = out->iterations;
        closer *= 0.25;
        begin_newton(s, closer * budget->tol, budget->iterations - before);
        info.work = 0;
      }
    } else if (how == core_method_ROUNDOFF_LIMIT) out->outcome = LAV_ROUNDOFF_LIMIT;
    else if (how != core_method_MORE && how != core_method_CERTIFICATE) out->outcome = LAV_STALLED;
    else if (is_late(s, budget)) out->outcome = LAV_TIME_LIMIT;
  }
  if (out->outcome != LAV_CONVERGED && out->outcome != LAV_ROUNDOFF_LIMIT) {
    /* Keep in each island the best of its result and its start. */
    if (s->stopping_test.best.seen == 0) {
      judge_measure_set_zero_impulse(&s->p, s->compare, s->stopping_test.w);
      see(s, s->compare, -budget->tol);
    }
    if (see(s, s->impulse, budget->tol) > budget->tol) COPY(s->impulse, s->stopping_test.best.impulse, s->p.n_rows);
  }
  s->newton_options.tol = budget->tol;
  s->newton_options.budget = budget->iterations;
  out->restarts = out->iterations;
}

/* -- admm on a dense factor ------------------------------------------------------------------------------------------- */

static const double FIRST_RHO = 0.1, RELAXATION = 1.6;

/* Compute L of L L^T = D^-1/2 A D^-1/2 + rho, stored behind that matrix; return 0 if a pivot is not positive. */
static int32_t factor_shifted(lav_solver *s) {
  const int32_t m = s->p.n_rows;
  const double *root = s->splitting.root;
  int32_t i, q;
  s->factors += 1;
  memset(s->table, 0, (size_t)m * m * sizeof(double));
  for (i = 0; i < m; i++) {
    double *row = s->table + (int64_t)i * m;
    for (q = s->a.indptr[i]; q < s->a.indptr[i + 1]; q++)
      row[s->a.indices[q]] = s->a.data[q] / (root[i] * root[s->a.indices[q]]);
    row[i] += s->splitting.rho;
  }
  return factor_linear_factor_linear_system_matrix(&s->linear) == 0;
}

static void admm_step(void *context, double *lam, int32_t first, int32_t n) {
  lav_solver *s = (lav_solver *)context;
  struct accelerate_admm_admm_t *c = &s->splitting;
  int32_t i;
  if (first) { /* At a solution, the first iteration does not change it. */
    for (i = 0; i < s->p.n_rows; i++) c->x[i] = core_csr_csr_row_dot(&s->a, i, lam) - s->p.b[i];
    k_admm_start(c, lam, c->x);
  }
  while (n > 0 && !s->is_broken) {
    const double rho = k_admm(c, &s->factor, lam, &n);
    if (rho > 0.0) {
      c->rho = rho;
      s->is_broken = !factor_shifted(s);
    }
  }
}

static int32_t start_admm(lav_solver *s) {
  const int64_t m = s->p.n_rows, numbers = (int64_t)k_admm_workspace_size(s->p.n_rows, s->options.memory);
  double *x;
  int32_t bands[2];
  GIVE_BACK(form_matrix(s));
  if (m > 0 && s->a.indptr[m] > 0 && core_csr_measure_asymmetry_and_bandwidth(&s->a, s->p.d, (int32_t)m, s->marks, bands) > 1e-14)
    return LAV_ERROR_UNSUPPORTED; /* A is not symmetric; the factorisation needs it. */
  s->table = TAKE(s, double, m * m + factor_linear_cholesky_workspace_size(s->p.n_rows));
  x = TAKE(s, double, numbers);
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  memset(x, 0, (size_t)numbers * sizeof(double));
  k_begin_admm(&s->splitting, &s->p, s->options.memory, FIRST_RHO, RELAXATION, x);
  memset(&s->factor, 0, sizeof s->factor);
  memset(&s->linear, 0, sizeof s->linear);
  factor_linear_analyse_dense(&s->linear, (int32_t)m);
  s->linear.by = factor_linear_CHOLESKY;
  s->linear.wide = LAVENDER_HAS_WIDE();
  s->linear.matrix = s->table;
  s->linear.lower = s->table + m * m;
  s->factor.linear = &s->linear;
  s->factors = 0;
  s->is_broken = !factor_shifted(s);
  s->swept.step_context = s;
  s->swept.step = admm_step;
  return LAV_OK;
}
#endif
