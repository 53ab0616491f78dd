/* A problem as a file of the Python package: `lavender report steps/` reads a folder of them, in the order of their names.
 * With the impulses that the engine itself computed, `lav_dump_answer` also writes the line of the engine's result.
 *
 * An .npz archive, uncompressed: arrays as they are, to the last bit. Needs <stdio.h> and malloc, which lavender.c does not.
 */
#ifndef LAVENDER_DUMP_H
#define LAVENDER_DUMP_H

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lavender.h"

enum { LAV_DUMP_ENTRIES = 32, LAV_DUMP_HEAD = 128 };

typedef struct lav_dump_file {
  FILE *file;
  int32_t count, is_bad;
  uint32_t table[256], crc[LAV_DUMP_ENTRIES], size[LAV_DUMP_ENTRIES], at[LAV_DUMP_ENTRIES];
  const char *name[LAV_DUMP_ENTRIES];
} lav_dump_file;

static inline uint32_t lav_dump_crc(const lav_dump_file *d, uint32_t crc, const void *data, size_t bytes) {
  const unsigned char *at = (const unsigned char *)data;
  for (crc = ~crc; bytes > 0; at++, bytes--) crc = d->table[(crc ^ *at) & 255] ^ crc >> 8;
  return ~crc;
}

static inline void lav_dump_bytes(lav_dump_file *d, const void *data, size_t bytes) {
  if (bytes > 0 && fwrite(data, bytes, 1, d->file) != 1) d->is_bad = 1;
}

/* Numbers of 2 or 4 bytes, the lowest first: widths as digits. */
static inline void lav_dump_numbers(lav_dump_file *d, const char *widths, const uint32_t *x) {
  for (; *widths; widths++, x++) {
    const unsigned char four[4] = {(unsigned char)*x, (unsigned char)(*x >> 8), (unsigned char)(*x >> 16), (unsigned char)(*x >> 24)};
    lav_dump_bytes(d, four, (size_t)(*widths - '0'));
  }
}

/* The head of an entry of the archive: in front of it, or again in the list at the end. */
static inline void lav_dump_head(lav_dump_file *d, int32_t i, int32_t at_end) {
  const uint32_t length = (uint32_t)strlen(d->name[i]) + 4, size = d->size[i];
  const uint32_t front[] = {0x04034b50, 20, 0, 0, 0, 33, d->crc[i], size, size, length, 0};
  const uint32_t end[] = {0x02014b50, 20, 20, 0, 0, 0, 33, d->crc[i], size, size, length, 0, 0, 0, 0, 0, d->at[i]};
  if (at_end) lav_dump_numbers(d, "42222224442222244", end);
  else lav_dump_numbers(d, "42222244422", front);
  lav_dump_bytes(d, d->name[i], length - 4);
  lav_dump_bytes(d, ".npy", 4);
}

/* One array; type "f8", "i4", ...; shape as Python writes it. */
static inline void lav_dump_array(lav_dump_file *d, const char *name, const char *type, const char *shape, const void *data,
                                  size_t bytes) {
  const uint16_t one = 1;
  char head[LAV_DUMP_HEAD + 1];
  const int32_t i = d->count++;
  memset(head, ' ', sizeof head);
  memcpy(head, "\x93NUMPY\x01\x00\x76\x00", 10);
  head[10 + snprintf(head + 10, LAV_DUMP_HEAD - 10, "{'descr': '%c%s', 'fortran_order': False, 'shape': (%s), }",
                     type[1] == '1' ? '|' : *(const char *)&one ? '<' : '>', type, shape)] = ' ';
  head[LAV_DUMP_HEAD - 1] = '\n';
  d->name[i] = name;
  d->at[i] = (uint32_t)ftell(d->file);
  d->size[i] = (uint32_t)(LAV_DUMP_HEAD + bytes);
  d->crc[i] = lav_dump_crc(d, lav_dump_crc(d, 0, head, LAV_DUMP_HEAD), data, bytes);
  lav_dump_head(d, i, 0);
  lav_dump_bytes(d, head, LAV_DUMP_HEAD);
  lav_dump_bytes(d, data, bytes);
}

/* Numbers (n, more), or of a null array the same number n times. */
static inline void lav_dump_reals(lav_dump_file *d, const char *name, const double *x, int32_t n, const char *more, int32_t width,
                                  double otherwise) {
  const size_t count = (size_t)n * (size_t)width;
  double *own = (double *)malloc(8 * count + 8);
  char shape[64];
  size_t i;
  snprintf(shape, sizeof shape, "%d,%s", (int)n, more);
  for (i = 0; own && i < count; i++) own[i] = x ? x[i] : otherwise;
  if (own) lav_dump_array(d, name, "f8", shape, own, 8 * count);
  else d->is_bad = 1;
  free(own);
}

static inline void lav_dump_whole(lav_dump_file *d, const char *name, const int32_t *x, int32_t n, const char *more, int32_t width) {
  char shape[64];
  snprintf(shape, sizeof shape, "%d,%s", (int)n, more);
  lav_dump_array(d, name, "i4", shape, x, 4 * (size_t)n * (size_t)width);
}

/* Rows of a matrix as the package has them: entries of dense ones that are not zero; of M, whose lower triangle is given, both
 * triangles. */
static inline void lav_dump_rows(lav_dump_file *d, const char *const *name, const int32_t *ptr, const int32_t *index,
                                 const double *value, int32_t rows, int32_t columns, int32_t is_lower) {
  const size_t all = (size_t)rows * (size_t)columns;
  double *dense = (double *)calloc(all + 1, 8);
  int32_t *to = (int32_t *)calloc(all + 1, 4), *start = (int32_t *)calloc((size_t)rows + 1, 4), i, j, k, n = 0;
  if (dense && to && start) {
    for (i = 0; i < rows; i++)
      for (k = ptr ? ptr[i] : 0; k < (ptr ? ptr[i + 1] : is_lower ? i + 1 : columns); k++) {
        j = ptr ? index[k] : k;
        dense[(size_t)i * (size_t)columns + (size_t)j] = value[ptr ? (size_t)k : (size_t)i * (size_t)columns + (size_t)k];
        if (is_lower) dense[(size_t)j * (size_t)columns + (size_t)i] = dense[(size_t)i * (size_t)columns + (size_t)j];
      }
    for (i = 0; i < rows; start[++i] = n)
      for (j = 0; j < columns; j++)
        if (dense[(size_t)i * (size_t)columns + (size_t)j] != 0.0) dense[n] = dense[(size_t)i * (size_t)columns + (size_t)j], to[n++] = j;
    lav_dump_reals(d, name[0], dense, n, "", 1, 0.0);
    lav_dump_whole(d, name[1], to, n, "", 1);
    lav_dump_whole(d, name[2], start, rows + 1, "", 1);
  } else d->is_bad = 1;
  free(dense), free(to), free(start);
}

/* Write the problem that was set in a solver, with the right-hand side and the velocities v* that it has there, and an
 * impulse (m) [N s] unless it is null. */
static inline int32_t lav_dump_with(lav_solver *solver, const lav_problem *q, const char *path, const double *impulse) {
  if (!solver || !q || !path) return LAV_ERROR_NULL;
  static const char *const jac[] = {"general_jac_data", "general_jac_indices", "general_jac_indptr"};
  static const char *const mass[] = {"general_mass_data", "general_mass_indices", "general_mass_indptr"};
  static const char *const matrix[] = {"A_data", "A_indices", "A_indptr"};
  const int32_t k = q->n_blocks, m = q->n_rows, n = q->n_bodies, c = k - q->n_joints;
  const int32_t is_bodies = q->form == LAV_BODIES, general = q->form == LAV_VELOCITIES;
  const int64_t version = 1, shape[2] = {m, m};
  const int32_t n_v = is_bodies ? 6 * n : general ? q->n_velocities : 0;
  double *b = (double *)calloc(2 * (size_t)m + (size_t)n_v + 1, 8), *v_free = b ? b + 2 * (size_t)m : NULL;
  int32_t *whole = (int32_t *)calloc(2 * (size_t)k + 2, 4), *kind = whole + k + 1, i, j, code;
  uint32_t end[8] = {0x06054b50, 0, 0, 0, 0, 0, 0, 0};
  char meta[128], size[16];
  lav_dump_file d;
  lav_verdict verdict;
  verdict.size = (uint32_t)sizeof verdict;
  code = b && whole ? lav_judge(solver, b + m, m, b, NULL, &verdict) : LAV_ERROR_WORKSPACE; /* of no impulse: w = -b */
  if (code == LAV_OK && n_v > 0) code = lav_free_velocity(solver, v_free, n_v);
  memset(&d, 0, sizeof d);
  if (code == LAV_OK && !(d.file = fopen(path, "wb"))) code = LAV_ERROR_FILE;
  if (code != LAV_OK) {
    free(b), free(whole);
    return code;
  }
  for (i = 0; i < 256; i++)
    for (d.table[i] = (uint32_t)i, j = 0; j < 8; j++) d.table[i] = d.table[i] >> 1 ^ (d.table[i] & 1 ? 0xedb88320u : 0);
  for (i = 0; i < m; i++) b[i] = 0.0 - b[i];
  for (i = 0; i <= k; i++) whole[i] = q->block_ptr ? q->block_ptr[i] : i;
  for (i = 0; i < k; i++) kind[i] = q->kind ? q->kind[i] : LAV_ROW;
  lav_dump_array(&d, "lavender_format", "i8", "", &version, 8);
  lav_dump_reals(&d, "b", b, m, "", 1, 0.0);
  lav_dump_whole(&d, "cones_ptr", whole, k + 1, "", 1);
  lav_dump_whole(&d, "cones_kind", kind, k, "", 1);
  lav_dump_reals(&d, "cones_lower", q->lower, m, "", 1, -INFINITY);
  lav_dump_reals(&d, "cones_upper", q->upper, m, "", 1, INFINITY);
  lav_dump_reals(&d, "cones_mu", q->mu, k, "", 1, 0.0);
  for (i = 0; i < k; i++) b[m + i] = q->patch_radius ? q->patch_radius[i] : kind[i] == LAV_CONTACT_BOX ? 1.0 : 0.0;
  lav_dump_reals(&d, "cones_patch_radius", b + m, k, "", 1, 0.0);
  if (q->rolling) lav_dump_reals(&d, "cones_rolling", q->rolling, k, "", 1, 0.0);
  if (q->impulse) lav_dump_reals(&d, "guess", q->impulse, m, "", 1, 0.0);
  snprintf(size, sizeof size, "%d,", (int)k);
  if (impulse) lav_dump_reals(&d, "impulse", impulse, m, "", 1, 0.0);
  if (q->key) lav_dump_array(&d, "key", "u8", size, q->key, 8 * (size_t)k);
  if (is_bodies || general) lav_dump_reals(&d, "compliance", q->compliance, m, "", 1, 0.0);
  if (is_bodies) {
    lav_dump_reals(&d, "rows_inv_mass", q->inv_mass, n, "", 1, 0.0);
    lav_dump_reals(&d, "rows_inv_inertia", q->inv_inertia, n, " 3, 3", 9, 0.0);
    lav_dump_reals(&d, "rows_v_free", v_free, n, " 6", 6, 0.0);
    lav_dump_reals(&d, "rows_jac", q->jac, whole[q->n_joints], " 12", 12, 0.0);
    lav_dump_whole(&d, "rows_joint_ptr", whole, q->n_joints + 1, "", 1);
    lav_dump_whole(&d, "rows_joint_body", q->joint_body, q->n_joints, " 2", 2);
    lav_dump_reals(&d, "rows_normal", q->normal, c, " 3", 3, 0.0);
    lav_dump_reals(&d, "rows_tangent", q->tangent, c, " 3", 3, 0.0);
    lav_dump_reals(&d, "rows_arm_a", q->arm_a, c, " 3", 3, 0.0);
    lav_dump_reals(&d, "rows_arm_b", q->arm_b, c, " 3", 3, 0.0);
    lav_dump_whole(&d, "rows_contact_body", q->contact_body, c, " 2", 2);
  } else if (general) {
    lav_dump_rows(&d, jac, q->index_ptr, q->index, q->value, m, q->n_velocities, 0);
    lav_dump_rows(&d, mass, q->mass_ptr, q->mass_index, q->mass_value, q->n_velocities, q->n_velocities, 1);
    lav_dump_reals(&d, "general_v_free", v_free, q->n_velocities, "", 1, 0.0);
  } else {
    lav_dump_rows(&d, matrix, q->index_ptr, q->index, q->value, m, m, 0);
    lav_dump_array(&d, "A_shape", "i8", "2,", shape, 16);
  }
  snprintf(meta, sizeof meta, "{\"operator\": \"%s\", \"friction\": \"%s\", \"name\": \"\", \"names\": null%s}",
           is_bodies ? "rows" : general ? "generalized" : "csr", q->law == LAV_CONE ? "cone" : "coulomb",
           general ? ", \"dof_names\": null" : "");
  snprintf(size, sizeof size, "%d,", (int)strlen(meta));
  lav_dump_array(&d, "meta", "u1", size, meta, strlen(meta));
  end[3] = end[4] = (uint32_t)d.count, end[6] = (uint32_t)ftell(d.file);
  for (i = 0; i < d.count; i++) lav_dump_head(&d, i, 1);
  end[5] = (uint32_t)ftell(d.file) - end[6];
  lav_dump_numbers(&d, "42222442", end);
  free(b), free(whole);
  return fclose(d.file) != 0 || d.is_bad ? LAV_ERROR_FILE : LAV_OK;
}

/* Write the problem that was set in a solver. The arrays of q are as in the last lav_set, except for `velocity`, which is
 * not read: it may hold the velocities after the solve. */
static inline int32_t lav_dump(lav_solver *solver, const lav_problem *q, const char *path) {
  return lav_dump_with(solver, q, path, NULL);
}

/* Write FOLDER/NAME.npz with the impulses (m) [N s] that the engine's own solver computed, and append the line of this
 * result to FOLDER/engine.jsonl: its time [s] and the name of the solver, in letters, digits, spaces and -_.()+ (others
 * become _). `lavender report FOLDER` judges these impulses and shows them among the solvers. */
static inline int32_t lav_dump_answer(lav_solver *solver, const lav_problem *q, const char *folder, const char *name,
                                      const double *impulse, double seconds, const char *method) {
  const char *const texts[] = {folder, name, method};
  char path[2100], plain[3][1024];
  FILE *lines;
  int32_t i, j, code, is_bad;
  if (!q || !folder || !name || !method || (!impulse && q->n_rows > 0)) return LAV_ERROR_NULL;
  if (!(seconds >= 0.0 && seconds < INFINITY)) return LAV_ERROR_NUMBER;
  for (i = 0; i < 3; i++) {
    if (strlen(texts[i]) >= sizeof plain[i]) return LAV_ERROR_FILE;
    strcpy(plain[i], texts[i]);
  }
  for (i = 1; i < 3; i++)
    for (j = 0; plain[i][j]; j++)
      if (!strchr("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 -_.()+", plain[i][j])) plain[i][j] = '_';
  snprintf(path, sizeof path, "%s/%s.npz", plain[0], plain[1]);
  code = lav_dump_with(solver, q, path, impulse);
  if (code != LAV_OK) return code;
  snprintf(path, sizeof path, "%s/engine.jsonl", plain[0]);
  if (!(lines = fopen(path, "ab"))) return LAV_ERROR_FILE;
  is_bad = fprintf(lines, "{\"file\": \"%s.npz\", \"rows\": %d, \"seconds\": %.9g, \"solver\": \"%s\"}\n", plain[1],
                   (int)q->n_rows, seconds, plain[2]) < 0;
  return fclose(lines) != 0 || is_bad ? LAV_ERROR_FILE : LAV_OK;
}

#endif
