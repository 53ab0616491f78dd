"""Coloured sweeps on several threads: projected Gauss-Seidel on A, sequential impulses on bodies.

Blocks of one colour read and write nothing in common, so a colour may be swept in any order or at once:
the result has the same bits for every number of threads, and those of the serial sweep in colour order.
Colours are slices color_ptr[c] .. color_ptr[c + 1] of `order`; the threads meet after each.

One thread leads: it opens a colour, sweeps chunks of it, and opens the next when every chunk is done. The
others help: each starts on a range of its own, the same in each sweep, then takes chunks from other ranges.
What is left of a range is one number, (colour, next place), so that taking a chunk says of which colour it is.
Nobody waits for a thread that the system has put aside, or has not started, unless it holds a chunk; who waits
spins for some microseconds, yields its core, then sleeps. A leader that had to yield works alone for a while,
twice as long each time and half as long after a sweep without it: on busy cores a second thread costs little,
on idle ones nothing is lost. The threads are the caller's: Python's serve, where
OpenMP would make the end of every run wait for all of them.
"""
from libc.stdint cimport int32_t, int64_t

from lavender_ext.judge.watch cimport CONVERGED, RUNNING, Watch, watched
from lavender_ext.sweep.pgs cimport relax_bodies, relax_matrix
from lavender_ext.sweep.serial cimport Sweeps, context_t, form_velocity


cdef extern from *:
    """
    #if defined(_MSC_VER)
    #include <intrin.h>
    #include <windows.h>
    #define lav_add(p, x) _InterlockedExchangeAdd64((volatile __int64*)(p), (x))
    #define lav_load(p) _InterlockedExchangeAdd64((volatile __int64*)(p), 0)
    #define lav_store(p, x) ((void)_InterlockedExchange64((volatile __int64*)(p), (x)))
    #define lav_pause() YieldProcessor()
    #define lav_yield() ((void)SwitchToThread())
    #define lav_nap() Sleep(1)
    #else
    #include <sched.h>
    #include <time.h>
    #define lav_add(p, x) __atomic_fetch_add((p), (x), __ATOMIC_ACQ_REL)
    #define lav_load(p) __atomic_load_n((p), __ATOMIC_ACQUIRE)
    #define lav_store(p, x) __atomic_store_n((p), (x), __ATOMIC_RELEASE)
    #if defined(__x86_64__) || defined(__i386__)
    #define lav_pause() __builtin_ia32_pause()
    #else
    #define lav_pause() ((void)0)
    #endif
    #define lav_yield() ((void)sched_yield())
    #define lav_nap() do { struct timespec t = {0, 50000}; nanosleep(&t, NULL); } while (0)
    #endif
    """
    int64_t lav_add(int64_t* p, int64_t x) noexcept nogil
    int64_t lav_load(int64_t* p) noexcept nogil
    void lav_store(int64_t* p, int64_t x) noexcept nogil
    void lav_pause() noexcept nogil
    void lav_yield() noexcept nogil
    void lav_nap() noexcept nogil


cdef enum:
    MOST = 64                   # threads
    LINE = 16                   # int64 of two cache lines: counters of threads stay apart
    CHUNK = 32                  # blocks taken at once, about a microsecond of work
    SPINS = 1000                # pauses before a waiting thread yields its core,
    YIELDS = 200                # and how often it does before it sleeps
    ALONE = 50_000              # blocks that a leader sweeps alone after its first wait, about a millisecond,
    LONGEST = 12_800_000        # and at most


cdef struct colored_t:
    const context_t* c          # over A, or bodies; its order is by colour
    double* lam                 # (m)
    const int32_t* color_ptr    # (n_colors + 1)
    int32_t n_colors
    int32_t team                # threads that may take part, one range each
    int64_t penalty             # blocks to sweep alone after the next wait
    int64_t alone               # blocks still to sweep alone
    int64_t stop[LINE]          # 1: no more sweeps
    int64_t done[LINE]          # blocks of the open colour that are done
    int64_t left[LINE * MOST]   # of each range: 2^32 colour + first place that nobody has taken


cdef inline int32_t range_start(const colored_t* x, int32_t color, int32_t t) noexcept nogil:
    # First place of range t in a colour; t = team gives the end of the last.
    cdef int64_t first = x.color_ptr[color], size = x.color_ptr[color + 1] - first
    return <int32_t>(first + size * t // x.team)


cdef inline void sweep_chunk(const colored_t* x, int32_t first, int32_t end) noexcept nogil:
    if x.c.csr != NULL:
        relax_matrix(x.c.blocks, x.c.csr, x.c.order, first, end, x.lam)
    else:
        relax_bodies(x.c.blocks, x.c.rows, x.c.order, first, end, x.lam, x.c.v)


cdef int32_t take_part(colored_t* x, int32_t thread) noexcept nogil:
    """Chunks of the open colour, own range first, until none is left; how many blocks that were."""
    cdef int32_t d, t, color, k, end, blocks = 0
    cdef int64_t left
    for d in range(x.team):
        t = thread + d if thread + d < x.team else thread + d - x.team
        while True:
            left = lav_load(&x.left[LINE * t])
            if <int32_t>left >= range_start(x, <int32_t>(left >> 32), t + 1):
                break
            left = lav_add(&x.left[LINE * t], CHUNK)
            color = <int32_t>(left >> 32)
            k = <int32_t>left
            end = range_start(x, color, t + 1)
            if k >= end:
                break
            if end > k + CHUNK:
                end = k + CHUNK
            sweep_chunk(x, k, end)
            lav_add(&x.done[0], end - k)
            blocks += end - k
    return blocks


cdef inline void wait(int32_t* spins) noexcept nogil:
    spins[0] += 1
    if spins[0] < SPINS:
        lav_pause()
    elif spins[0] < SPINS + YIELDS:
        lav_yield()
    else:
        lav_nap()
        spins[0] = SPINS


cdef void lead(void* context, double* lam, int32_t first_sweep, int32_t n) noexcept nogil:
    cdef colored_t* x = <colored_t*>context
    cdef int32_t _s, c, t, spins, size, waited
    for _s in range(n):
        waited = 0
        for c in range(x.n_colors):
            size = x.color_ptr[c + 1] - x.color_ptr[c]
            if x.alone > 0:
                x.alone -= size
                waited = 1
                sweep_chunk(x, x.color_ptr[c], x.color_ptr[c + 1])
                continue
            lav_store(&x.done[0], 0)
            for t in range(x.team):
                lav_store(&x.left[LINE * t], (<int64_t>c << 32) + range_start(x, c, t))
            take_part(x, 0)
            spins = 0
            while lav_load(&x.done[0]) < size:
                wait(&spins)
            if spins >= SPINS:
                waited = 1
                x.alone = x.penalty
                x.penalty = min(2 * x.penalty, <int64_t>LONGEST)
        if not waited and x.penalty > ALONE:
            x.penalty = x.penalty // 2


cdef void follow(colored_t* x, int32_t thread) noexcept nogil:
    cdef int32_t spins = 0
    while not lav_load(&x.stop[0]):
        if take_part(x, thread):
            spins = 0
        else:
            wait(&spins)


cdef class Team:
    """One run of coloured sweeps, for one thread that calls `lead` and others that call `help`.

    sweeps: over A or bodies, in an order by colour; color_ptr is the first place of each.
    """
    cdef colored_t x
    cdef Watch watch
    cdef object keep

    def __init__(self, Sweeps sweeps, Watch watch, double[::1] lam, const int32_t[::1] color_ptr, int threads,
                 alone=(0, ALONE)):
        cdef int32_t t
        self.x.alone, self.x.penalty = alone
        self.watch = watch
        self.keep = (sweeps, lam, color_ptr)
        self.x.c = &sweeps.x.c
        self.x.n_colors = <int32_t>color_ptr.shape[0] - 1
        self.x.color_ptr = &color_ptr[0]
        self.x.lam = &lam[0] if lam.shape[0] > 0 else NULL
        self.x.team = min(threads, MOST)
        self.x.stop[0] = self.x.done[0] = 0
        for t in range(self.x.team):
            self.x.left[LINE * t] = 2147483647          # no colour is open

    def lead(self, int n, double tol):
        """`n` sweeps in place under the watch: (status, sweeps done). Once; helpers then come home."""
        cdef int32_t status = RUNNING, done = 0
        if self.x.lam == NULL:
            self.x.stop[0] = 1
            if tol > 0.0:
                return CONVERGED, 0
            return RUNNING, n
        with nogil:
            if self.watch.state.total == 0:
                form_velocity(self.x.c, self.x.lam)
            status = watched(&self.watch.state, &self.watch.view, self.watch.confirm, lead, &self.x, self.x.lam, n, tol, &done)
            lav_store(&self.x.stop[0], 1)
        return status, done

    @property
    def alone(self):
        """(blocks still to sweep alone, blocks after the next wait): where the next run of these sweeps goes on."""
        return self.x.alone, self.x.penalty

    def help(self, int thread):
        """Sweep chunks until the leader has done; thread = 1, 2, ... names the range to begin with."""
        if 0 < thread < self.x.team:
            with nogil:
                follow(&self.x, thread)
