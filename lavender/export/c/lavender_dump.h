/* A problem as a file of the Python package: `lavender report steps/` reads a folder of them, in the order of their names.
 * With the impulses that the engine itself computed, `lav_dump_answer` also writes the line of the engine's result, and
 * `lav_dump_named` names of bodies and rows, too. `lav_load` reads a file again.
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

/* What tables call the blocks (k) and bodies (n_bodies): "crate and ramp" of contact 3 becomes "contact 3 (crate, ramp)" if it
 * has no name of its own. gap (k) m: distance of a contact's surfaces, NAN of other blocks. Arrays and names may be null. */
typedef struct lav_names {
  const char *const *block;
  const char *const *body;
  const double *gap;
} lav_names;

typedef struct lav_dump_file {
  FILE *file;
  int32_t count, is_bad;
  uint32_t table[256], crc[LAV_DUMP_ENTRIES], size[LAV_DUMP_ENTRIES], at[LAV_DUMP_ENTRIES];
  const char *name[LAV_DUMP_ENTRIES];
  char *text; /* of the entry meta */
  size_t length, room;
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

/* Append text to the entry meta; a name becomes a part of a JSON string. */
static inline void lav_dump_text(lav_dump_file *d, const char *text, int32_t is_name) {
  char own[8];
  for (; *text && !d->is_bad; text++) {
    const int32_t is_odd = is_name && (*text == '"' || *text == '\\' || (unsigned char)*text < 32);
    const size_t n = (size_t)snprintf(own, sizeof own, is_odd ? "\\u%04x" : "%c", is_odd ? (int)(unsigned char)*text : (int)*text);
    if (d->length + n > d->room) {
      char *more = (char *)realloc(d->text, 2 * (d->room + 64));
      if (!more) d->is_bad = 1;
      else d->text = more, d->room = 2 * (d->room + 64);
    }
    if (!d->is_bad) memcpy(d->text + d->length, own, n), d->length += n;
  }
}

/* The names of all blocks as a list of JSON: each one's own, or its number; then its bodies in parentheses. */
static inline void lav_dump_names(lav_dump_file *d, const lav_problem *q, const lav_names *names, const int32_t *kind) {
  char own[32];
  int32_t i, side, contacts = 0;
  for (i = 0; i < q->n_blocks; i++) {
    const int32_t is_contact = kind[i] != LAV_ROW && kind[i] != LAV_ROUND, has_pair = names->body && q->form == LAV_BODIES;
    const int32_t *pair = !has_pair ? NULL : i < q->n_joints ? q->joint_body + 2 * i : q->contact_body + 2 * (i - q->n_joints);
    snprintf(own, sizeof own, is_contact ? "contact %d" : "row %d", (int)(is_contact ? contacts : q->block_ptr ? q->block_ptr[i] : i));
    lav_dump_text(d, i ? ", \"" : "[\"", 0);
    lav_dump_text(d, names->block && names->block[i] ? names->block[i] : own, 1);
    for (side = 0; side < 2 && has_pair; side++) {
      const int32_t body = pair[side];
      snprintf(own, sizeof own, "body %d", (int)body);
      lav_dump_text(d, side ? ", " : " (", 0);
      lav_dump_text(d, body < 0 ? "world" : names->body[body] ? names->body[body] : own, 1);
    }
    lav_dump_text(d, has_pair ? ")\"" : "\"", 0);
    contacts += is_contact;
  }
  lav_dump_text(d, q->n_blocks ? "]" : "[]", 0);
}

/* Write the problem that was set in a solver, with the right-hand side and the velocities v* that it has there, and an
 * impulse (m) [N s] and names unless they are null: for `lavender judge FILE`. */
static inline int32_t lav_dump_with(lav_solver *solver, const lav_problem *q, const char *path, const double *impulse,
                                    const lav_names *names) {
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
  char size[16];
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
  if (names && names->gap) lav_dump_reals(&d, "gap", names->gap, k, "", 1, 0.0);
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
  lav_dump_text(&d, is_bodies ? "{\"operator\": \"rows\"" : general ? "{\"operator\": \"generalized\"" : "{\"operator\": \"csr\"", 0);
  lav_dump_text(&d, q->law == LAV_CONE ? ", \"friction\": \"cone\"" : ", \"friction\": \"coulomb\"", 0);
  lav_dump_text(&d, ", \"name\": \"\", \"names\": ", 0);
  if (names && (names->block || names->body)) lav_dump_names(&d, q, names, kind);
  else lav_dump_text(&d, "null", 0);
  lav_dump_text(&d, general ? ", \"dof_names\": null}" : "}", 0);
  snprintf(size, sizeof size, "%d,", (int)d.length);
  lav_dump_array(&d, "meta", "u1", size, d.text, d.length);
  end[3] = end[4] = (uint32_t)d.count, end[6] = (uint32_t)ftell(d.file);
  for (i = 0; i < d.count; i++) lav_dump_head(&d, i, 1);
  end[5] = (uint32_t)ftell(d.file) - end[6];
  lav_dump_numbers(&d, "42222442", end);
  free(b), free(whole), free(d.text);
  return fclose(d.file) != 0 || d.is_bad ? LAV_ERROR_FILE : LAV_OK;
}

/* Write the problem that was set in a solver. The arrays of q are as in the last lav_set, except for `velocity`, which is
 * not read: it may hold the velocities after the solve. */
static inline int32_t lav_dump(lav_solver *solver, const lav_problem *q, const char *path) {
  return lav_dump_with(solver, q, path, NULL, NULL);
}

/* Write FOLDER/NAME.npz with the impulses (m) [N s] that the engine's own solver computed and with names, which may be null,
 * and append the line of this result to FOLDER/engine.jsonl: its time [s] and the name of the solver, in letters, digits,
 * spaces and -_.()+ (others become _). `lavender report FOLDER` judges these impulses and shows them among the solvers;
 * `lavender judge FOLDER/NAME.npz` shows them row by row. */
static inline int32_t lav_dump_named(lav_solver *solver, const lav_problem *q, const char *folder, const char *name,
                                     const double *impulse, double seconds, const char *method, const lav_names *names) {
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
  code = lav_dump_with(solver, q, path, impulse, names);
  if (code != LAV_OK) return code;
  snprintf(path, sizeof path, "%s/engine.jsonl", plain[0]);
  if (!(lines = fopen(path, "ab"))) return LAV_ERROR_FILE;
  is_bad = fprintf(lines, "{\"file\": \"%s.npz\", \"rows\": %d, \"seconds\": %.9g, \"solver\": \"%s\"}\n", plain[1],
                   (int)q->n_rows, seconds, plain[2]) < 0;
  return fclose(lines) != 0 || is_bad ? LAV_ERROR_FILE : LAV_OK;
}

/* As lav_dump_named, without names. */
static inline int32_t lav_dump_answer(lav_solver *solver, const lav_problem *q, const char *folder, const char *name,
                                      const double *impulse, double seconds, const char *method) {
  return lav_dump_named(solver, q, folder, name, impulse, seconds, method, NULL);
}

/* A problem that lav_load read: give `problem` to lav_set. Its arrays lie in memory that lav_unload frees. */
typedef struct lav_loaded {
  lav_problem problem;
  double *impulse; /* (m) N s, the stored answer; null if the file has none */
  double *gap;     /* (k) m; null if the file has none */
  void *memory[LAV_DUMP_ENTRIES];
  int32_t count, code;
  const unsigned char *file;
  size_t bytes;
} lav_loaded;

static inline void lav_unload(lav_loaded *x) {
  while (x && x->count > 0) free(x->memory[--x->count]);
}

static inline void *lav_load_memory(lav_loaded *x, size_t bytes) {
  void *found = x->count < LAV_DUMP_ENTRIES ? malloc(bytes + 8) : NULL;
  if (found) x->memory[x->count++] = found;
  else x->code = LAV_ERROR_WORKSPACE;
  return found;
}

/* The number of 2 or 4 bytes at a place, the lowest byte first; 0 and an error behind the end of the file. */
static inline size_t lav_load_number(lav_loaded *x, size_t at, int32_t width) {
  size_t found = 0;
  if (at > x->bytes || x->bytes - at < (size_t)width) return x->code = LAV_ERROR_FILE, (size_t)0;
  for (; width > 0; width--) found = found << 8 | x->file[at + (size_t)width - 1];
  return found;
}

/* The bytes of an entry of the archive; null if there is none, or if it is compressed. */
static inline const unsigned char *lav_load_entry(lav_loaded *x, const char *name, size_t *bytes) {
  const size_t wanted = strlen(name);
  size_t end = x->bytes < 22 ? 0 : x->bytes - 22, at, length, n;
  while (end > 0 && memcmp(x->file + end, "PK\5\6", 4)) end--;
  at = lav_load_number(x, end + 16, 4);
  for (n = lav_load_number(x, end + 10, 2); n > 0 && x->code == LAV_OK; n--) {
    length = lav_load_number(x, at + 28, 2);
    if (lav_load_number(x, at, 4) != 0x02014b50 || x->bytes - at < 46 + length) x->code = LAV_ERROR_FILE;
    else if (length == wanted + 4 && !memcmp(x->file + at + 46, name, wanted)) {
      const size_t is_packed = lav_load_number(x, at + 10, 2), start = lav_load_number(x, at + 42, 4);
      const size_t head = 30 + lav_load_number(x, start + 26, 2) + lav_load_number(x, start + 28, 2);
      *bytes = lav_load_number(x, at + 24, 4);
      if (is_packed || x->code != LAV_OK || start > x->bytes || x->bytes - start < head || x->bytes - start - head < *bytes) break;
      return x->file + start + head;
    }
    at += 46 + length + lav_load_number(x, at + 30, 2) + lav_load_number(x, at + 32, 2);
  }
  if (n > 0) x->code = LAV_ERROR_FILE;
  return NULL;
}

/* An array of doubles ('f'), int32 ('i'), uint64 ('u') or bytes ('b') with `count` numbers, which is found if it is -1. Null
 * without such an entry, which is an error if it is needed. */
static inline void *lav_load_array(lav_loaded *x, const char *name, char kind, int64_t *count, int32_t is_needed) {
  const uint16_t one = 1;
  const unsigned char *data = NULL, *from;
  char head[512], *at;
  size_t bytes = 0, skip, n = 1, width, i;
  void *to;
  from = x->code == LAV_OK ? lav_load_entry(x, name, &bytes) : NULL;
  if (!from && is_needed && x->code == LAV_OK) x->code = LAV_ERROR_FILE;
  if (!from || x->code != LAV_OK) return NULL;
  x->code = LAV_ERROR_FILE;
  if (bytes < 12 || memcmp(from, "\x93NUMPY", 6)) return NULL;
  skip = from[6] == 1 ? 10 + from[8] + 256 * (size_t)from[9] : bytes;
  if (skip > bytes || skip - 10 >= sizeof head) return NULL;
  memcpy(head, from + 10, skip - 10), head[skip - 10] = 0, data = from + skip;
  at = strstr(head, "'descr': '");
  if (!at || strlen(at) < 14 || !strstr(head, "'fortran_order': False")) return NULL;
  width = (size_t)(at[12] - '0');
  if (at[10] != (width == 1 ? '|' : *(const char *)&one ? '<' : '>')) return NULL;
  if (!(kind == 'f' ? at[11] == 'f' && width == 8 : kind == 'u' ? at[11] == 'u' && width == 8 : kind == 'b' ? at[11] == 'u' && width == 1
        : at[11] == 'i' && (width == 1 || width == 4 || width == 8))) return NULL;
  {
    const char *shape = strstr(head, "'shape': (");
    if (!shape) return NULL;
    for (shape += 10; *shape && *shape != ')';) {
      char *next;
      const unsigned long size = strtoul(shape, &next, 10);
      if (next == shape) shape++;
      else if (size > 0x7fffffff || (n *= size) > 0x7fffffff) return NULL;
      else shape = next;
    }
  }
  if (n * width > bytes - skip || (*count >= 0 && n != (size_t)*count)) return NULL;
  *count = (int64_t)n;
  x->code = LAV_OK;
  to = lav_load_memory(x, n * (kind == 'i' ? 4 : width) + 1);
  if (!to) return NULL;
  if (kind != 'i' || width == 4) memcpy(to, data, n * width);
  else
    for (i = 0; i < n; i++) {
      int64_t value = (signed char)data[i * width];
      if (width == 8) memcpy(&value, data + 8 * i, 8);
      if (value < -0x7fffffff || value > 0x7fffffff) return x->code = LAV_ERROR_FILE, (void *)NULL;
      ((int32_t *)to)[i] = (int32_t)value;
    }
  if (kind == 'b') ((char *)to)[n] = 0;
  return to;
}

static inline double *lav_load_reals(lav_loaded *x, const char *name, int64_t count, int32_t is_needed) {
  return (double *)lav_load_array(x, name, 'f', &count, is_needed);
}

static inline int32_t *lav_load_whole(lav_loaded *x, const char *name, int64_t count) {
  return (int32_t *)lav_load_array(x, name, 'i', &count, 1);
}

/* Read a file of lav_dump, or an uncompressed one of the package, from which lav_set sets the same problem. LAV_ERROR_FILE: it
 * cannot be read, is compressed, or is no problem; LAV_ERROR_UNSUPPORTED: a quadratic program, or joints of several blocks. */
static inline int32_t lav_load(const char *path, lav_loaded *out) {
  lav_problem *q;
  int32_t *ptr, *joints = NULL, is_bodies, general, k, m = 0, i, j, n;
  int64_t count = 1, entries = -1;
  const char *meta, *law;
  unsigned char *file = NULL;
  FILE *stream;
  size_t bytes;
  long size = -1;
  if (!path || !out) return LAV_ERROR_NULL;
  memset(out, 0, sizeof *out);
  q = &out->problem;
  if (!(stream = fopen(path, "rb"))) return LAV_ERROR_FILE;
  if (!fseek(stream, 0, SEEK_END)) size = ftell(stream);
  if (size > 0 && !fseek(stream, 0, SEEK_SET) && (file = (unsigned char *)malloc((size_t)size)) != NULL)
    if (fread(file, (size_t)size, 1, stream) == 1) out->file = file, out->bytes = (size_t)size;
  fclose(stream);
  out->code = out->file ? LAV_OK : LAV_ERROR_FILE;
  if (out->code == LAV_OK && !lav_load_entry(out, "lavender_format", &bytes)) out->code = LAV_ERROR_FILE;
  meta = (const char *)lav_load_array(out, "meta", 'b', &entries, 1);
  is_bodies = meta && !strncmp(meta, "{\"operator\": \"rows\"", 19);
  general = meta && !strncmp(meta, "{\"operator\": \"generalized\"", 26);
  if (meta && !is_bodies && !general && strncmp(meta, "{\"operator\": \"csr\"", 18) && strncmp(meta, "{\"operator\": \"dense\"", 20))
    out->code = LAV_ERROR_UNSUPPORTED;
  law = out->code == LAV_OK ? strstr(meta, "\"friction\": \"") : NULL;
  lav_default_problem(is_bodies ? LAV_BODIES : general ? LAV_VELOCITIES : LAV_MATRIX, q);
  q->law = law && !strncmp(law + 13, "cone", 4) ? LAV_CONE : LAV_COULOMB;
  entries = -1;
  ptr = (int32_t *)lav_load_array(out, "cones_ptr", 'i', &entries, 1);
  k = out->code == LAV_OK && entries > 0 ? (int32_t)entries - 1 : -1;
  if (k >= 0) m = ptr[k];
  else if (out->code == LAV_OK) out->code = LAV_ERROR_FILE;
  if (out->code == LAV_OK && m < 0) out->code = LAV_ERROR_FILE;
  q->n_blocks = k, q->n_rows = m, q->block_ptr = ptr;
  q->b = lav_load_reals(out, "b", m, 1);
  q->kind = lav_load_whole(out, "cones_kind", k);
  q->lower = lav_load_reals(out, "cones_lower", m, 1);
  q->upper = lav_load_reals(out, "cones_upper", m, 1);
  q->mu = lav_load_reals(out, "cones_mu", k, 1);
  q->patch_radius = lav_load_reals(out, "cones_patch_radius", k, 1);
  q->rolling = lav_load_reals(out, "cones_rolling", k, 0);
  q->impulse = lav_load_reals(out, "guess", m, 0);
  out->impulse = lav_load_reals(out, "impulse", m, 0);
  out->gap = lav_load_reals(out, "gap", k, 0);
  count = k;
  q->key = (const uint64_t *)lav_load_array(out, "key", 'u', &count, 0);
  if (is_bodies || general) q->compliance = lav_load_reals(out, "compliance", m, 1);
  count = entries = -1;
  if (is_bodies) {
    q->inv_mass = (double *)lav_load_array(out, "rows_inv_mass", 'f', &count, 1);
    joints = (int32_t *)lav_load_array(out, "rows_joint_ptr", 'i', &entries, 1);
    q->n_bodies = n = (int32_t)count, q->n_joints = j = out->code == LAV_OK ? (int32_t)entries - 1 : 0;
    for (i = 0; i <= j && out->code == LAV_OK; i++)
      if (j > k || joints[i] != ptr[i]) out->code = LAV_ERROR_UNSUPPORTED;
    q->inv_inertia = lav_load_reals(out, "rows_inv_inertia", 9 * (int64_t)n, 1);
    q->velocity = lav_load_reals(out, "rows_v_free", 6 * (int64_t)n, 1);
    q->jac = lav_load_reals(out, "rows_jac", joints && out->code == LAV_OK ? 12 * (int64_t)joints[j] : 0, 1);
    q->joint_body = lav_load_whole(out, "rows_joint_body", 2 * (int64_t)j);
    q->contact_body = lav_load_whole(out, "rows_contact_body", 2 * ((int64_t)k - j));
    q->normal = lav_load_reals(out, "rows_normal", 3 * ((int64_t)k - j), 1);
    q->tangent = lav_load_reals(out, "rows_tangent", 3 * ((int64_t)k - j), 1);
    q->arm_a = lav_load_reals(out, "rows_arm_a", 3 * ((int64_t)k - j), 1);
    q->arm_b = lav_load_reals(out, "rows_arm_b", 3 * ((int64_t)k - j), 1);
  } else if (general) {
    int32_t *low, *index;
    double *value;
    q->velocity = (double *)lav_load_array(out, "general_v_free", 'f', &count, 1);
    q->n_velocities = n = (int32_t)count;
    q->index_ptr = lav_load_whole(out, "general_jac_indptr", (int64_t)m + 1);
    q->value = (double *)lav_load_array(out, "general_jac_data", 'f', &entries, 1);
    q->n_entries = (int32_t)entries;
    q->index = lav_load_whole(out, "general_jac_indices", entries);
    low = lav_load_whole(out, "general_mass_indptr", (int64_t)n + 1);
    entries = -1;
    value = (double *)lav_load_array(out, "general_mass_data", 'f', &entries, 1);
    index = lav_load_whole(out, "general_mass_indices", entries);
    if (low) low[0] = 0;
    for (i = j = 0, count = 0; i < n && out->code == LAV_OK; i++, low[i] = j) /* the lower triangle */
      for (; count < low[i + 1]; count++)
        if (count < 0 || count >= entries) out->code = LAV_ERROR_FILE, count = low[i + 1];
        else if (index[count] <= i) value[j] = value[count], index[j++] = index[count];
    q->mass_ptr = low, q->mass_index = index, q->mass_value = value, q->n_mass_entries = j;
  } else if (meta && !strncmp(meta, "{\"operator\": \"csr\"", 18)) {
    q->index_ptr = lav_load_whole(out, "A_indptr", (int64_t)m + 1);
    q->value = (double *)lav_load_array(out, "A_data", 'f', &entries, 1);
    q->n_entries = (int32_t)entries;
    q->index = lav_load_whole(out, "A_indices", entries);
  } else {
    q->value = lav_load_reals(out, "A", (int64_t)m * m, 1);
    q->n_entries = out->code == LAV_OK ? m * m : 0;
  }
  free(file);
  out->file = NULL, out->bytes = 0;
  if (out->code != LAV_OK) lav_unload(out);
  return out->code;
}

#endif
