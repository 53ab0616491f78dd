#include "lavender.h"

#include <float.h>
#include <math.h>
#include <string.h>

#if defined(__FAST_MATH__) || (defined(_MSC_VER) && defined(_M_FP_FAST))
#error "lavender: -ffast-math changes what the kernels compute; build lavender.c without it"
#endif
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off", "no-tree-slp-vectorize")
#elif defined(_MSC_VER)
#pragma fp_contract(off)
#endif

/* The kernels below come out of a translator: what it declares and never uses is no mistake of theirs. */
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-variable"
#pragma GCC diagnostic ignored "-Wunused-but-set-variable"
#if !defined(__clang__) /* which guesses at arrays that a loop over the size of a block fills */
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"
#endif
#define CYTHON_UNUSED __attribute__((unused))
#else
#define CYTHON_UNUSED
#endif
#define likely(x) (x)
#define unlikely(x) (x)

