"""Coloured sweeps on several threads: projected Gauss-Seidel on A, sequential impulses on bodies.

Blocks of one colour read and write nothing in common, so a colour may be swept in any order or at once:
the result has the same bits for every number of threads, and those of the serial sweep in colour order.
Colours are slices color_ptr[c] .. color_ptr[c + 1] of `order`; the threads meet after each.
"""
from cython.parallel cimport parallel, prange
from libc.stdint cimport int32_t

from lavender_ext.block cimport blocks_t
from lavender_ext.csr cimport csr_t
from lavender_ext.pgs cimport relax_csr_block
from lavender_ext.problem cimport Data
from lavender_ext.rows cimport relax_rows_block, rows_t
from lavender_ext.watch cimport CONVERGED, RUNNING, Watch, sweep_t


cdef struct colored_t:          # what a sweep needs besides lam
    const blocks_t* blocks
    const csr_t* csr
    const rows_t* rows
    double* v                   # (n_bodies, 6), sequential impulses
    const int32_t* order        # (k) by colour
    const int32_t* color_ptr    # (n_colors + 1)
    int32_t n_colors
    int32_t threads


cdef void pgs_step(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    cdef colored_t* x = <colored_t*>context
    cdef int32_t s, c, k, first, end
    with parallel(num_threads=x.threads):
        for s in range(n):
            for c in range(x.n_colors):
                first = x.color_ptr[c]
                end = x.color_ptr[c + 1]
                for k in prange(first, end, schedule="static"):
                    relax_csr_block(x.blocks, x.csr, x.order[k], lam)


cdef void impulse_step(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    cdef colored_t* x = <colored_t*>context
    cdef int32_t s, c, k, first, end
    with parallel(num_threads=x.threads):
        for s in range(n):
            for c in range(x.n_colors):
                first = x.color_ptr[c]
                end = x.color_ptr[c + 1]
                for k in prange(first, end, schedule="static"):
                    relax_rows_block(x.blocks, x.rows, x.order[k], lam, x.v)


def run(Data p, Watch watch, double[::1] lam, int n, double tol, const int32_t[::1] order,
        const int32_t[::1] color_ptr, int threads, double[::1] v=None):
    """`n` coloured sweeps in place under `watch`, GIL released: (status, sweeps done).

    With v (6 (n_bodies + 1),) = M^-1 J^T lam: sequential impulses; without: projected Gauss-Seidel on A.
    """
    cdef colored_t x
    cdef int32_t status, done = 0
    cdef sweep_t step = pgs_step if v is None else impulse_step
    if lam.shape[0] == 0:
        if tol > 0.0:
            return CONVERGED, 0
        return RUNNING, n
    x.blocks = &p.blocks
    x.csr = &p.csr
    x.rows = &p.rows
    x.v = NULL
    if v is not None:
        x.v = &v[0]
    x.order = &order[0]
    x.color_ptr = &color_ptr[0]
    x.n_colors = <int32_t>color_ptr.shape[0] - 1
    x.threads = threads
    with nogil:
        status = watch.run(step, &x, &lam[0], n, tol, &done)
    return status, done
