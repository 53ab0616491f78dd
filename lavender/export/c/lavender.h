/* lavender: solve and judge constraint problems of rigid-body contact without Python.
 *
 * Results have the same bits as in the Python package: lavender.c is extracted from the C code of its kernels.
 *
 * Units      m, kg, s: impulses N s (N m s on rows that turn), velocities m/s (rad/s), A = J M^-1 J^T in 1/kg.
 * Equations  v+ = v* + M^-1 J^T lambda,   w = A lambda - b,   b = target - J v*
 * Ownership  All memory is the caller's. `lav_open` places a solver in it; nothing is allocated or freed, no file, clock
 *            or global variable is touched, nothing is thrown. Arrays of a problem are copied by `lav_set`: they may
 *            change or go as soon as it returns. A solver is gone when its memory is; there is nothing to close.
 * Errors     Every function that can fail returns LAV_OK or a negative number; `lav_text` says it in words. A call that
 *            fails writes nothing into the caller's arrays and does not change the solver; after a `lav_set` that failed
 *            it has no problem until one succeeds, but it keeps its stored impulses.
 * Threads    Only one thread may use a solver at a time; a second one gets LAV_ERROR_BUSY. Solvers share no data.
 * Versions   Structs begin with `size`, the sizeof with which the caller was compiled; the `lav_default_...` functions
 *            write it. Fields are only ever added, at the end.
 *
 * Rows of a block: ROW one or more bounded rows; CONTACT a normal, then 0 to 2 tangents; CONTACT_SPIN the same, then one
 * row of spin about the normal; CONTACT_BOX a normal and two tangents, each bounded by itself; CONTACT_ROLLING a normal, two
 * tangents, perhaps a spin, two rows that roll; ROUND a normal and three to five tangents in one cone (not of bodies).
 * 32-bit integers and doubles, C order, without gaps.
 */
#ifndef LAVENDER_H
#define LAVENDER_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define LAV_VERSION_MAJOR 1
#define LAV_VERSION_MINOR 0

#if defined(_WIN32) && defined(LAV_SHARED)
#ifdef LAV_BUILD
#define LAV_API __declspec(dllexport)
#else
#define LAV_API __declspec(dllimport)
#endif
#elif defined(__GNUC__) && defined(LAV_SHARED)
#define LAV_API __attribute__((visibility("default")))
#else
#define LAV_API
#endif

typedef struct lav_solver lav_solver; /* lies in the caller's memory */

enum { /* what functions return; `lav_text` has these words */
  LAV_OK = 0,                 /* no error */
  LAV_ERROR_NULL = -1,        /* a pointer that is needed is null */
  LAV_ERROR_VERSION = -2,     /* size of a struct is not one of this library's: fill it by a lav_default_... function */
  LAV_ERROR_COUNT = -3,       /* a count is negative, too large, or does not fit another */
  LAV_ERROR_NUMBER = -4,      /* a number is NaN or infinite where it must not be, or beyond 1e60; or a mass, mu, reach, compliance or the largest |b| is below 1e-60 and not 0: change a unit */
  LAV_ERROR_BOUNDS = -5,      /* lower > upper, or an infinite bound on the wrong side */
  LAV_ERROR_FRICTION = -6,    /* mu or patch_radius is negative, or a contact with mu has no row to feel it */
  LAV_ERROR_BLOCKS = -7,      /* block_ptr or kind describe no blocks: sizes, kinds, or joints behind contacts */
  LAV_ERROR_INDEX = -8,       /* a column, body or place in the order is out of range, or columns do not ascend */
  LAV_ERROR_MASS = -9,        /* an inverse mass or a compliance is negative, an inertia is no positive semidefinite tensor, or M is not positive definite */
  LAV_ERROR_WORKSPACE = -10,       /* too little memory: give as many bytes as lav_needed or lav_workspace_size says */
  LAV_ERROR_UNSUPPORTED = -11, /* this method of this build does not take this form, law or kind of block: lav_takes asks beforehand */
  LAV_ERROR_OPTION = -12,     /* an option is out of its range */
  LAV_ERROR_BUSY = -13,       /* another thread is in this solver: one at a time */
  LAV_ERROR_NO_PROBLEM = -14, /* no problem is set: lav_set comes first, and must have succeeded */
  LAV_ERROR_SOLVER = -15,     /* this is no solver: not opened, or its memory was written over */
  LAV_ERROR_SELF_TEST = -16,  /* this build does not round as it must: compile with -ffp-contract=off, without -march=native or fast math */
  LAV_ERROR_PAIR = -17,       /* a contact or joint of a body with itself, or a contact of the world with the world: leave it out */
  LAV_ERROR_FRAME = -18,      /* normal and tangent of a contact are no orthogonal unit vectors, to 1e-5: divide each by its length */
  LAV_ERROR_FACTOR = -19,     /* newton's factor over bodies has 2^31 rows of blocks or more: take sweeps or anderson, or solve islands separately */
  LAV_ERROR_FILE = -20        /* lav_dump cannot write a file (is there such a folder, is there workspace?), or lav_load read it (is it one of lav_dump, uncompressed?) */
};

enum { LAV_MATRIX = 1, LAV_BODIES = 2, LAV_VELOCITIES = 3 };      /* form: A; bodies, joints, contacts; J and M */
enum { LAV_COULOMB = 0, LAV_CONE = 1 };                           /* law */
enum { LAV_ROW = 0, LAV_CONTACT = 1, LAV_CONTACT_SPIN = 2, LAV_ROUND = 3, LAV_CONTACT_BOX = 4, LAV_CONTACT_ROLLING = 5 }; /* kind */
enum { LAV_GIVEN = 0, LAV_SYMMETRIC = 1, LAV_RANDOM = 2, LAV_REVERSE = 3 }; /* order of a sweep */
enum { LAV_DEFAULT_SWEEP = 0, LAV_PGS_SWEEP = 1, LAV_BLOCK_SWEEP = 2 };

enum { /* methods; names as in Python, by `lav_name` */
  LAV_SEQUENTIAL_IMPULSES = 1, /* bodies */
  LAV_PGS = 2,                 /* A, J and M */
  LAV_SOR = 3,                 /* A, free rows */
  LAV_GAUSS_SEIDEL = 4,        /* A, free rows */
  LAV_JACOBI = 5,              /* A */
  LAV_BLOCK_GAUSS_SEIDEL = 6,  /* all forms */
  LAV_ANDERSON = 7,            /* all forms */
  LAV_NNCG = 8,                /* all forms */
  LAV_NEWTON = 9,              /* all forms; rolling and round cones with J and M alone */
  LAV_DIRECT = 10,             /* A, bodies; rows alone */
  LAV_LEMKE = 11,              /* A, bodies; rows alone */
  LAV_ADMM = 12                /* A, bodies; dense */
};

enum { /* how a run ended; this is a claim, which `relative` of the verdict may contradict */
  LAV_MAX_ITERATIONS = 0,
  LAV_CONVERGED = 1,
  LAV_DIVERGED = 2,
  LAV_STALLED = 3,
  LAV_ROUNDOFF_LIMIT = 4,      /* rounding prevents a smaller residual */
  LAV_TIME_LIMIT = 5,
  LAV_FAILED = 6               /* a factorisation failed */
};

/* One problem. `lav_default_problem` fills in what is usual; null stands for what is said behind an array. */
typedef struct lav_problem {
  uint32_t size;
  int32_t form;                /* LAV_MATRIX | LAV_BODIES | LAV_VELOCITIES */
  int32_t law;                 /* LAV_COULOMB | LAV_CONE */
  int32_t n_blocks;            /* k; of bodies joints first, each a ROW block, then contacts */
  int32_t n_rows;              /* m */
  int32_t n_entries;           /* of `value`: of A, or of J */
  int32_t n_bodies;
  int32_t n_joints;
  int32_t n_velocities;        /* nv */
  int32_t n_mass_entries;      /* of `mass_value` */
  const int32_t *block_ptr;    /* (k + 1) first row of each block; null: one row each */
  const int32_t *kind;         /* (k); null: ROW */
  const double *lower, *upper; /* (m) N s, read on ROW blocks; null: no bound */
  const double *mu;            /* (k) >= 0; null: 0 */
  const double *patch_radius;  /* (k) m, of CONTACT_BOX mu_2 / mu_1, >= 0; null: 0, of CONTACT_BOX 1 */
  const double *b;             /* (m) m/s; null: target - J velocity */
  const double *target;        /* (m) m/s; null: 0 */
  const double *velocity;      /* v*: (n_bodies, 6) linear, then angular; (nv); null: 0 */
  const double *compliance;    /* (m) 1/kg, >= 0, not of A; null: 0 */
  const double *impulse;       /* (m) N s, where to begin; null: carried by key, else nothing done */
  const uint64_t *key;         /* (k) names of blocks by which impulses are carried to the next problem; null: none */
  const int32_t *order;        /* (k) blocks in the order of a sweep; null: by `order` of the options */
  const int32_t *index_ptr;    /* (m + 1) rows of A, or of J; null: dense, n_entries = m m or m nv */
  const int32_t *index;        /* (n_entries) columns, ascending in each row */
  const double *value;         /* (n_entries) */
  const int32_t *mass_ptr;     /* (nv + 1) rows of M's lower triangle with its diagonal; null: M dense, (nv, nv) */
  const int32_t *mass_index;   /* columns, ascending */
  const double *mass_value;    /* kg, kg m^2 */
  const double *inv_mass;      /* (n_bodies) 1/kg */
  const double *inv_inertia;   /* (n_bodies, 3, 3) 1/(kg m^2), world */
  const int32_t *joint_body;   /* (n_joints, 2) bodies a, b; -1: the world */
  const double *jac;           /* (joint rows, 12) linear and angular on a, then on b */
  const int32_t *contact_body; /* (contacts, 2) */
  const double *normal;        /* (contacts, 3) unit, from a to b */
  const double *tangent;       /* (contacts, 3) unit, at a right angle to it; the second tangent is normal x tangent */
  const double *arm_a, *arm_b; /* (contacts, 3) m, contact point minus centre */
  const double *rolling;       /* (k) m, bound of rolling over the normal impulse, >= 0; null: 0 */
} lav_problem;

typedef struct lav_options {
  uint32_t size;
  int32_t method;
  int32_t order;               /* LAV_GIVEN | LAV_SYMMETRIC | LAV_RANDOM | LAV_REVERSE */
  int32_t memory;              /* anderson, admm: iterations that are combined, 1 to 16 */
  int32_t sweep;               /* anderson, nncg: LAV_DEFAULT_SWEEP (blocks under the cone law, else pgs) | ... */
  int32_t convex;              /* anderson, nncg: iterations under the cone law first; anderson: -1 selects them by tests */
  int32_t keeps;               /* nncg: 1 restarts only against the sweep */
  uint64_t seed;               /* of LAV_RANDOM */
  double omega;                /* sor: 0 to 2; jacobi: > 0, or 0 for the safe damping */
} lav_options;

typedef struct lav_budget {
  uint32_t size;
  int32_t iterations;          /* more iterations at most */
  double tol;                  /* relative residual at which it ends; 0: exactly so many iterations, unchecked */
  double seconds;              /* at most; 0: no limit */
  double (*clock)(void *);     /* seconds, never falling; needed with a limit */
  void *clock_data;
  double velocity_tol;         /* m/s, rad/s; above 0 in place of tol: converged if no row has a larger velocity error */
} lav_budget;

typedef struct lav_verdict { /* the judge's result for an impulse */
  uint32_t size;
  int32_t worst;               /* row with the largest velocity error; -1 if there is none */
  int32_t island;              /* of `relative` and `floor`, as lav_islands numbers them; -1 if all blocks are one island */
  int32_t unused;
  double relative;             /* error relative to that of the zero impulse, of the worst island; infinite if not finite */
  double energy;               /* sqrt J */
  double velocity;             /* m/s, of the worst row */
  double floor;                /* what rounding of the impulse costs, and a factor of an ill-conditioned M, relative */
} lav_verdict;

typedef struct lav_motion { /* distance of the motion of an impulse from the motion of a reference */
  uint32_t size;
  int32_t row;                 /* of `rows`, -1 without one */
  int32_t body;                /* of `speed`: body or generalised velocity, -1 without one */
  int32_t unused;
  double kinetic;              /* sqrt J, of the difference of velocities; of A alone as `energy` */
  double energy;               /* sqrt J, with what compliance stores */
  double relative;             /* kinetic over that of the reference's own impulses; infinite where these move nothing */
  double speed, spin;          /* m/s and rad/s of the bodies furthest off; of a generalised velocity its own unit, and 0 */
  double rows;                 /* m/s, largest |A (lambda - reference)| */
} lav_motion;

typedef struct lav_result {
  uint32_t size;
  int32_t outcome;
  int32_t iterations;          /* of this run */
  int32_t sweeps;
  int32_t restarts;            /* of anderson and nncg; blocks without an exact answer; factorisations of the others */
  lav_verdict verdict;
} lav_result;

LAV_API uint32_t lav_version(void);                 /* major << 16 | minor */
LAV_API const char *lav_text(int32_t code);         /* of an error or LAV_OK; never null */
LAV_API const char *lav_name(int32_t method);       /* "anderson"; null if there is no such method */
LAV_API const char *lav_outcome(int32_t outcome);   /* "converged" */
LAV_API int32_t lav_self_test(void);                /* LAV_OK if this build has the bits of the package */

LAV_API int32_t lav_default_problem(int32_t form, lav_problem *out);
LAV_API int32_t lav_default_options(int32_t method, lav_options *out);
LAV_API int32_t lav_default_budget(lav_budget *out); /* 1000 iterations, tol 1e-6, no clock, no velocity_tol */

/* Whether a method supports a problem of this form, law and kinds of blocks; LAV_OK or LAV_ERROR_UNSUPPORTED. */
LAV_API int32_t lav_takes(const lav_problem *problem, const lav_options *options);

/* Bytes for a solver of problems with at most these counts (a hint: what binds later is memory alone). Arrays may be null; block_ptr alone is read, where there are
 * joints: it tells their rows from those of contacts. What a factor fills and which columns M's trees join is guessed:
 * `lav_set` tells when it is more. */
LAV_API int32_t lav_workspace_size(const lav_problem *problem, const lav_options *options, uint64_t *bytes);
LAV_API int32_t lav_open(void *memory, uint64_t bytes, const lav_problem *largest, const lav_options *options,
                         lav_solver **out);
LAV_API uint64_t lav_needed(const lav_solver *solver); /* bytes that the last `lav_set` needed */
/* The solver in other memory, with its options and the impulses that it carries: for one that lav_set found too small. What
 * it was in before is the caller's again. */
LAV_API int32_t lav_move(lav_solver *solver, void *memory, uint64_t bytes, lav_solver **out);
/* The array or count that the last lav_set rejected, and the index of the invalid entry; null if it rejected none. Of a
 * normal, tangent or inertia whose entries contradict each other, it is the first entry: the contact is index / 3. */
LAV_API const char *lav_refused(const lav_solver *solver, int32_t *index);

/* Set a problem. It starts from `impulse`, from stored impulses of blocks of the same key, kind and rows, or from Pi(0). */
LAV_API int32_t lav_set(lav_solver *solver, const lav_problem *problem);
/* More iterations, from where the last run ended. The best impulse found is kept, a budget of tol 0 keeps the last;
 * newton's is never worse than its start or than doing nothing. */
LAV_API int32_t lav_run(lav_solver *solver, const lav_budget *budget, lav_result *out);
/* Problems first, first + stride, ... of a batch: a thread for each `first`. results (n); the worst error of all. */
LAV_API int32_t lav_run_many(lav_solver *const *solvers, int32_t n, int32_t first, int32_t stride,
                             const lav_budget *budget, lav_result *results);

LAV_API int32_t lav_impulse(lav_solver *solver, double *out, int32_t n);  /* (m) N s */
LAV_API int32_t lav_velocity(lav_solver *solver, double *out, int32_t n); /* v+, (6 n_bodies) or (nv), with v* as given */
LAV_API int32_t lav_free_velocity(lav_solver *solver, double *out, int32_t n); /* v* of the problem that was set */
/* The judge on any impulse (m): slack w and error e (m) where not null. An ill-conditioned M hides no residual above 1e-6. */
LAV_API int32_t lav_judge(lav_solver *solver, const double *impulse, int32_t n, double *slack, double *error,
                          lav_verdict *out);
/* Error of the motion of an impulse (m), relative to a reference (m) that was solved more accurately. */
LAV_API int32_t lav_motion_error(lav_solver *solver, const double *impulse, const double *reference, int32_t n,
                                 lav_motion *out);
/* Island of each block (k); islands share no moving body, velocity or entry of A. Returns their number, or an error. */
LAV_API int32_t lav_islands(lav_solver *solver, int32_t *label, int32_t n);
/* Hash of the bits of numbers, as in test vectors. */
LAV_API uint64_t lav_hash(const double *x, int32_t n, uint64_t seed);

/* The engine of the package, stepped from a snapshot that it wrote: `lavender.export.engine_image(simulation)`. */
typedef struct lav_engine lav_engine;
LAV_API int32_t lav_engine_workspace_size(const void *image, uint64_t image_bytes, uint64_t *bytes);
LAV_API int32_t lav_engine_open(void *memory, uint64_t bytes, const void *image, uint64_t image_bytes, lav_engine **out);
/* Whole substeps; the eight solver values of the last one into values (8) where not null. On LAV_ERROR_WORKSPACE the contacts
 * have outgrown the memory: write an image, open it with lav_engine_workspace_size's new size, go on. */
LAV_API int32_t lav_engine_step(lav_engine *engine, int32_t substeps, double *values);
LAV_API int32_t lav_engine_image(lav_engine *engine, void *out, uint64_t out_bytes, uint64_t *bytes);
LAV_API int32_t lav_engine_places(const lav_engine *engine, int32_t *n_bodies, double *out, int32_t n); /* (n_bodies, 7) */

#ifdef __cplusplus
}
#endif
#endif
