
/* -- memory ----------------------------------------------------------------------------------------------------------- */

static void *take(lav_solver *s, int64_t count, size_t size) {
  const uint64_t at = (s->used + 15) & ~(uint64_t)15;
  s->used = at + (uint64_t)(count + 1) * size; /* One additional entry, so that an empty array has an address, too. */
  if (s->used > s->peak) s->peak = s->used;
  if (s->used <= s->bytes) return s->base + at;
  s->is_short = 1;
  return NULL;
}

#define TAKE(s, type, n) ((type *)take((s), (n), sizeof(type)))

static void take_kept(lav_solver *s, const lav_problem *q) {
  s->kept.most_blocks = q->n_blocks;
  s->kept.most_rows = q->n_rows;
  s->kept.key = TAKE(s, uint64_t, q->n_blocks);
  s->kept.ptr = TAKE(s, int32_t, q->n_blocks + 1);
  s->kept.kind = TAKE(s, int32_t, q->n_blocks);
  s->kept.impulse = TAKE(s, double, q->n_rows);
}

/* Allocate the arrays of every problem. */
static void take_blocks(lav_solver *s, const lav_problem *q) {
  const int64_t k = q->n_blocks, m = q->n_rows, n = q->n_bodies, nv = q->n_velocities;
  s->p.n_blocks = q->n_blocks;
  s->p.n_rows = q->n_rows;
  s->p.law = q->law;
  s->p.ptr = TAKE(s, int32_t, k + 1);
  s->p.kind = TAKE(s, int32_t, k);
  s->p.lower = TAKE(s, double, m);
  s->p.upper = TAKE(s, double, m);
  s->p.mu = TAKE(s, double, k);
  s->p.patch_radius = TAKE(s, double, k);
  s->p.rolling = TAKE(s, double, k);
  s->p.b = TAKE(s, double, m);
  s->p.d = TAKE(s, double, m);
  s->p.nu = TAKE(s, double, m);
  s->p.step = TAKE(s, double, m);
  s->key = TAKE(s, uint64_t, k);
  s->impulse = TAKE(s, double, m);
  s->order = TAKE(s, int32_t, k);
  s->empty = TAKE(s, int32_t, m);
  s->marks = TAKE(s, int32_t, 4 * ((int64_t)s->kept.most_blocks + k) + m + 2 * n + 4 * nv + 16); /* Scratch. */
  s->island_marks = TAKE(s, int32_t, 4 * k + 1 + (q->form == LAV_VELOCITIES ? 2 * nv : q->form == LAV_BODIES ? n : m));
  s->reference = TAKE(s, double, 3 * k);
  s->terms = TAKE(s, double, m);
  s->score_workspace = TAKE(s, double, judge_stopping_test_stopping_test_workspace_size(m, k + 1));
  s->stopping_test.w = TAKE(s, double, m);
  s->stopping_test.e = TAKE(s, double, m);
  s->form = q->form;
  s->n_v = q->form == LAV_BODIES ? 6 * q->n_bodies : q->form == LAV_VELOCITIES ? q->n_velocities : 0;
  s->v_free = TAKE(s, double, s->n_v);
  s->compare = TAKE(s, double, 2 * m + s->n_v);
  s->stopping_test.v = TAKE(s, double, q->form == LAV_BODIES ? 12 * n + m : q->form == LAV_VELOCITIES ? 6 * nv + 2 * m : m);
}

/* Numbers of rows of joints and of contacts of bodies, from block_ptr, or else the largest possible numbers. */
static int32_t joint_rows(const lav_problem *q) {
  const int32_t most = q->n_rows - (q->n_blocks - q->n_joints);
  if (q->n_joints == 0) return 0;
  return q->block_ptr && q->block_ptr[q->n_joints] >= q->n_joints && q->block_ptr[q->n_joints] < most ? q->block_ptr[q->n_joints]
                                                                                                      : most;
}

static int32_t contact_rows(const lav_problem *q) {
  const int64_t most = 6 * ((int64_t)q->n_blocks - q->n_joints), left = q->n_rows - (q->block_ptr ? joint_rows(q) : q->n_joints);
  return (int32_t)(left < most ? left : most);
}

static void take_form(lav_solver *s, const lav_problem *q) {
  const int64_t m = q->n_rows, k = q->n_blocks, n = q->n_bodies, c = k - q->n_joints, nv = q->n_velocities;
  const int64_t mj = q->form == LAV_BODIES ? joint_rows(q) : 0, mc = q->form == LAV_BODIES ? contact_rows(q) : 0;
  s->r.compliance = s->g.compliance = NULL;
  if (q->form == LAV_MATRIX) {
    s->a.indptr = TAKE(s, int32_t, m + 1);
    s->a.indices = TAKE(s, int32_t, q->n_entries);
    s->a.data = TAKE(s, double, q->n_entries);
    return;
  }
  s->r.compliance = s->g.compliance = TAKE(s, double, m);
  if (q->form == LAV_VELOCITIES) {
    s->g.n = q->n_velocities;
    s->g.m = q->n_rows;
    s->g.jptr = TAKE(s, int32_t, m + 1);
    s->g.jidx = TAKE(s, int32_t, q->n_entries);
    s->g.jval = TAKE(s, double, q->n_entries);
    s->g.lptr = TAKE(s, int32_t, nv + 1);
    s->g.parent = TAKE(s, int32_t, nv);
    s->g.inv_pivot = TAKE(s, double, nv);
    s->g.root = TAKE(s, double, nv);
    return;
  }
  s->r.n_bodies = q->n_bodies;
  s->r.n_joints = q->n_joints;
  s->r.n_contacts = q->n_blocks - q->n_joints;
  s->r.jac = TAKE(s, double, 12 * mj);
  s->r.minv_jac = TAKE(s, double, 12 * (mj + 1));
  s->r.joint_body = TAKE(s, int32_t, 2 * (int64_t)q->n_joints);
  s->r.normal = TAKE(s, double, 3 * c);
  s->r.tangent = TAKE(s, double, 3 * c);
  s->r.arm_a = TAKE(s, double, 3 * c);
  s->r.arm_b = TAKE(s, double, 3 * c);
  s->r.contact_body = TAKE(s, int32_t, 2 * c);
  s->r.coupling = TAKE(s, double, 5 * (c + 1));
  s->r.inv_inertia_arm = TAKE(s, double, 6 * (mc + 1));
  s->r.inv_mass = TAKE(s, double, n);
  s->r.inv_inertia = TAKE(s, double, 9 * n);
  if (s->is_short) return;
  memset((void *)(uintptr_t)s->r.minv_jac, 0, 12 * (size_t)(mj + 1) * sizeof(double));
  memset((void *)(uintptr_t)s->r.coupling, 0, 5 * (size_t)(c + 1) * sizeof(double));
  memset((void *)(uintptr_t)s->r.inv_inertia_arm, 0, 6 * (size_t)(mc + 1) * sizeof(double));
}

/* -- copy of the problem ---------------------------------------------------------------------------------------------- */

#define COPY(to, from, n) copy_bytes((to), (from), (size_t)(n) * sizeof *(to))

static void copy_bytes(const void *to, const void *from, size_t bytes) {
  if (bytes > 0) memcpy((void *)(uintptr_t)to, from, bytes);
}

static void copy_or(const double *to, const double *from, int64_t n, double otherwise) {
  double *out = (double *)(uintptr_t)to;
  int64_t i;
  for (i = 0; i < n; i++) out[i] = from ? from[i] : otherwise;
}

static int32_t fill_blocks(lav_solver *s, const lav_problem *q) {
  int32_t *ptr = (int32_t *)(uintptr_t)s->p.ptr, *kind = (int32_t *)(uintptr_t)s->p.kind, i, single = 1;
  const int32_t k = q->n_blocks, m = q->n_rows;
  for (i = 0; i <= k; i++) ptr[i] = q->block_ptr ? q->block_ptr[i] : i;
  s->rubs = 0;
  for (i = 0; i < k; i++) {
    kind[i] = q->kind ? q->kind[i] : LAV_ROW;
    if (kind[i] != LAV_ROW || ptr[i + 1] - ptr[i] > 1) single = 0;
    if (kind[i] != LAV_ROW && ptr[i + 1] - ptr[i] > 1) s->rubs = 1;
  }
  copy_or(s->p.lower, q->lower, m, -INFINITY);
  copy_or(s->p.upper, q->upper, m, INFINITY);
  core_block_types_write_contact_bounds(&s->p);
  copy_or(s->p.mu, q->mu, k, 0.0);
  copy_or(s->p.patch_radius, q->patch_radius, k, 0.0);
  for (i = 0; i < k && !q->patch_radius; i++) /* A box without a ratio is a square. */
    if (kind[i] == LAV_CONTACT_BOX) ((double *)(uintptr_t)s->p.patch_radius)[i] = 1.0;
  copy_or(s->p.rolling, q->rolling, k, 0.0);
  s->has_keys = q->key != NULL;
  if (q->key) COPY(s->key, q->key, k);
  s->mode = q->order ? core_order_GIVEN : s->options.order == LAV_REVERSE ? core_order_GIVEN : s->options.order;
  s->split = q->order ? k : q->form == LAV_BODIES ? q->n_joints : 0;
  s->rng = s->options.seed;
  for (i = 0; i < k; i++) s->order[i] = i;
  if (q->order) {
    memset(s->marks, 0, (size_t)k * sizeof(int32_t));
    for (i = 0; i < k; i++) {
      if (q->order[i] < 0 || q->order[i] >= k || s->marks[q->order[i]]++)
        return refuse(&s->refused, LAV_ERROR_INDEX, "order", i);
      s->order[i] = q->order[i];
    }
  } else if (s->options.order == LAV_REVERSE) {
    core_order_reverse_blocks(s->order, 0, s->split);
    core_order_reverse_blocks(s->order, s->split, k);
  }
  s->in_rows = single && !q->order && s->options.order == LAV_GIVEN && q->form == LAV_MATRIX;
  return LAV_OK;
}

/* Copy the nonzero entries of a matrix to compressed rows. `lower`: the lower triangle and every diagonal entry. */
static void fill_matrix(const int32_t *to_ptr, const int32_t *to_index, const double *to_value, const int32_t *ptr,
                        const int32_t *index, const double *value, int32_t rows, int32_t columns, int32_t lower) {
  int32_t *out = (int32_t *)(uintptr_t)to_ptr, *to = (int32_t *)(uintptr_t)to_index, i, j, at = 0;
  double *x = (double *)(uintptr_t)to_value;
  out[0] = 0;
  for (i = 0; i < rows; i++) {
    if (ptr)
      for (j = ptr[i]; j < ptr[i + 1]; j++) {
        to[at] = index[j];
        x[at] = value[j];
        at += value[j] != 0.0 || (lower && index[j] == i);
      }
    else
      for (j = 0; j < (lower ? i + 1 : columns); j++)
        if (value[(int64_t)i * columns + j] != 0.0 || (lower && j == i)) {
          to[at] = j;
          x[at++] = value[(int64_t)i * columns + j];
        }
    out[i + 1] = at;
  }
}

static void fill_bodies(lav_solver *s, const lav_problem *q) {
  const int64_t n = q->n_bodies, c = s->r.n_contacts, mj = s->p.ptr[q->n_joints];
  double *b = (double *)(uintptr_t)s->p.b;
  double *normal = (double *)(uintptr_t)s->r.normal, *tangent = (double *)(uintptr_t)s->r.tangent;
  int32_t i;
  COPY(s->r.inv_mass, q->inv_mass, n);
  COPY(s->r.inv_inertia, q->inv_inertia, 9 * n);
  COPY(s->r.joint_body, q->joint_body, 2 * (int64_t)q->n_joints);
  COPY(s->r.jac, q->jac, 12 * mj);
  COPY(s->r.contact_body, q->contact_body, 2 * c);
  COPY(normal, q->normal, 3 * c);
  COPY(tangent, q->tangent, 3 * c);
  for (i = 0; i < c; i++, normal += 3, tangent += 3) /* Frames accurate to float32: n / |n|, then t orthonormalised. */
    if (!(core_faults_measure_frame_error(normal, tangent) <= EXACT)) core_faults_orthonormalise_frame(normal, tangent);
  COPY(s->r.arm_a, q->arm_a, 3 * c);
  COPY(s->r.arm_b, q->arm_b, 3 * c);
  copy_or(s->r.compliance, q->compliance, q->n_rows, 0.0);
  copy_or(s->v_free, q->velocity, 6 * n, 0.0);
  copy_or(b, q->b, q->n_rows, 0.0);
  if (!q->b) {
    core_rows_multiply_jacobian(&s->p, &s->r, s->v_free, s->stopping_test.w);
    for (i = 0; i < q->n_rows; i++) b[i] = (q->target ? q->target[i] : 0.0) - s->stopping_test.w[i];
  }
  k_compute_body_diagonal(&s->p, &s->r, s->empty);
}

#ifndef LAV_SWEEPS_ONLY
/* Copy M, factor it as L^T D L, and estimate its condition. */
static int32_t factor_mass(lav_solver *s, const lav_problem *q) {
  const int32_t n = q->n_velocities;
  const int64_t most = (int64_t)n * n / 2 + 1;
  int32_t *mptr = TAKE(s, int32_t, n + 1), *midx = TAKE(s, int32_t, q->n_mass_entries), *columns = NULL, *lidx, count;
  double *mval = TAKE(s, double, q->n_mass_entries), *values, *lval;
  const uint64_t from = s->used;
  int64_t workspace = (int64_t)q->n_mass_entries + 1;
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  fill_matrix(mptr, midx, mval, q->mass_ptr, q->mass_index, q->mass_value, n, n, 1);
  for (;; workspace = 2 * workspace < most ? 2 * workspace : most) {
    s->used = from;
    columns = TAKE(s, int32_t, workspace);
    if (s->is_short) return LAV_ERROR_WORKSPACE;
    count = core_tree_find_tree_factor_pattern(n, mptr, midx, (int32_t)workspace, (int32_t *)(uintptr_t)s->g.lptr, columns,
                                          (int32_t *)(uintptr_t)s->g.parent, s->marks, s->marks + n, s->marks + 2 * n);
    if (count >= 0) break;
    if (workspace >= most) return LAV_ERROR_MASS;
  }
  values = TAKE(s, double, count);
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  s->g.mptr = mptr, s->g.midx = midx, s->g.mval = mval, s->g.lidx = columns;
  if (core_mass_factor_mass(&s->g, values, (double *)(uintptr_t)s->g.inv_pivot, (double *)(uintptr_t)s->g.root) >= 0)
    return LAV_ERROR_MASS;
  s->used = from; /* Move L directly behind M, with its final size. */
  s->g.lidx = lidx = TAKE(s, int32_t, count);
  s->g.lval = lval = TAKE(s, double, count);
  memmove(lidx, columns, (size_t)count * sizeof *lidx);
  memmove(lval, values, (size_t)count * sizeof *lval);
  s->g.condition = core_condition_estimate_condition(&s->g, s->stopping_test.v);
  return LAV_OK;
}

/* Copy J and M, factor M, and compute Y of J and M. */
static int32_t fill_velocities(lav_solver *s, const lav_problem *q) {
  const int32_t n = q->n_velocities, m = q->n_rows, k = q->n_blocks;
  int32_t *columns, *pcol, *pval, *home, n_columns = 0, i, j;
  double *b = (double *)(uintptr_t)s->p.b, values = 0.0;
  int64_t workspace = (int64_t)q->n_entries + 64;
  uint64_t from;
  fill_matrix(s->g.jptr, s->g.jidx, s->g.jval, q->index_ptr, q->index, q->value, m, n, 0);
  GIVE_BACK(factor_mass(s, q));
  copy_or(s->g.compliance, q->compliance, m, 0.0);
  copy_or(s->v_free, q->velocity, n, 0.0);
  for (i = 0; i < m; i++)
    b[i] = q->b ? q->b[i] : (q->target ? q->target[i] : 0.0) - core_generalized_multiply_jacobian_row(&s->g, i, s->v_free);
  s->g.prow = TAKE(s, int32_t, k + 1);
  s->g.pcol = pcol = TAKE(s, int32_t, k + 1);
  s->g.pval = pval = TAKE(s, int32_t, k + 1);
  s->g.home = home = TAKE(s, int32_t, k);
  for (from = s->used;; workspace *= 2) {
    s->used = from;
    s->g.cols = columns = TAKE(s, int32_t, workspace);
    if (s->is_short) return LAV_ERROR_WORKSPACE;
    s->g.n_panels = core_whiten_find_panel_pattern(&s->g, k, s->p.ptr, s->marks, (int32_t *)(uintptr_t)s->g.prow, pcol, pval,
                                                   columns, workspace < 2147483647 ? (int32_t)workspace : 2147483647, &n_columns,
                                                   &values);
    if (s->g.n_panels >= 0) break;
    if (workspace >= 2147483647) return LAV_ERROR_COUNT;
  }
  if (values >= 2147483647.0) return LAV_ERROR_COUNT;
  s->used = from;
  s->g.cols = TAKE(s, int32_t, n_columns); /* The same place, with its final size. */
  s->g.y = TAKE(s, double, (int64_t)values);
  if (s->is_short) return LAV_ERROR_WORKSPACE;
  for (i = j = 0; i < k; i++) {
    while (s->g.prow[j + 1] <= s->p.ptr[i]) j++;
    home[i] = j;
  }
  k_compute_generalized_diagonal(&s->p, &s->g, s->empty, s->marks);
  return LAV_OK;
}
#endif
