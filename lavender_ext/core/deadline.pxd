"""The deadline of a solve: an absolute time on a clock, which long loops read between pieces of work.

A loop counts its work in nanoseconds by the rates of `lavender/base/rates.json`, and the clock is read when `reading_interval` of
it is due. Without a limit the deadline is NULL: nothing is counted or read.
"""
from libc.stdint cimport int32_t

cdef extern from *:
    """
    #ifndef LAVENDER_READ_CLOCK
    #ifdef __wasm__
    #define LAVENDER_READ_CLOCK(d) 0.0  /* WebAssembly has no limits: a call by a pointer would need a table of functions. */
    #else
    #define LAVENDER_READ_CLOCK(d) ((d)->now((d)->at))
    #endif
    #endif
    """
    double call_clock "LAVENDER_READ_CLOCK"(deadline_t* d) noexcept nogil


cdef struct deadline_t:
    double end                  # s, on the clock
    double (*now)(void* at) noexcept nogil          # the clock, s
    void* at
    double work                 # ns, counted work since the last reading
    double longest              # ns, largest counted work between two readings
    double total                # ns, counted work
    int32_t passed              # whether a reading was at or after `end`


cdef inline double reading_interval() noexcept nogil:
    """Return the counted work [ns] from which on the clock is read. A reading takes 30 ns."""
    return 5e5


cdef inline double product_cost() noexcept nogil:
    """Return the time [ns] of a multiply-add of a product of dense matrices: "dense" of the rates."""
    return 0.04


cdef inline double entry_cost() noexcept nogil:
    """Return the time [ns] to update an entry of a matrix in addition to its multiply-adds."""
    return 1.0


cdef inline bint has_passed(deadline_t* d, double work) noexcept nogil:
    """Count `work` [ns], and return whether the deadline has passed at the last reading of the clock."""
    if d == NULL:
        return False
    d.work += work
    if d.work >= reading_interval() and not d.passed:
        d.longest, d.total = max(d.longest, d.work), d.total + d.work
        d.work = 0.0
        d.passed = call_clock(d) >= d.end
    return d.passed


cdef class Deadline:
    cdef deadline_t at


cpdef double read_clock()
cdef deadline_t* get_pointer(Deadline deadline) noexcept
