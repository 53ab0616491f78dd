"""The class `Deadline`: the struct of `deadline.pxd`, with the monotonic clock, for Python."""
from libc.math cimport INFINITY

from lavender_ext.core.deadline cimport deadline_t

cdef extern from *:
    """
    #if defined(_WIN32)
    #include <windows.h>
    static double lav_read_clock(void) {
      LARGE_INTEGER count, rate;
      QueryPerformanceCounter(&count);
      QueryPerformanceFrequency(&rate);
      return (double)count.QuadPart / (double)rate.QuadPart;
    }
    #else
    #include <time.h>
    static double lav_read_clock(void) {
      struct timespec now;
      clock_gettime(CLOCK_MONOTONIC, &now);
      return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
    }
    #endif
    """
    double lav_read_clock() noexcept nogil

cdef object played = None


def play_clock(clock):
    """Replace the clock by a function without arguments [s], for tests; None restores it."""
    global played
    played = clock


cpdef double read_clock():
    """Return the time of the monotonic clock [s]."""
    return lav_read_clock() if played is None else played()


cdef double read_monotonic_clock(void* at) noexcept nogil:
    return lav_read_clock()


cdef double read_played_clock(void* at) noexcept with gil:
    return played()


cdef deadline_t* get_pointer(Deadline deadline) noexcept:
    """Return the struct of a deadline, NULL without a limit; a deadline from Python may be None."""
    return NULL if deadline is None or deadline.at.end == INFINITY else &deadline.at


cdef class Deadline:
    """A time after which a solve must end.

    Parameters
    ----------
    limit : float or None, s
        Time from `start` to the deadline; None for no deadline.
    start : float, optional, s
        Reading of `read_clock`. Default: now.
    """

    def __init__(self, limit=None, start=None):
        self.at.end = INFINITY
        if limit is not None:
            self.at.end = (read_clock() if start is None else <double>start) + <double>limit
        self.at.now = read_monotonic_clock if played is None else read_played_clock

    @property
    def is_set(self):
        """Whether there is a time limit."""
        return self.at.end < INFINITY

    @property
    def counted(self):
        """Counted work [ns]: all that led to readings of the clock by kernels, and the largest between two readings."""
        return self.at.total, self.at.longest

    def extend(self, double seconds):
        """Move the deadline by `seconds` that do not count."""
        self.at.end, self.at.passed = self.at.end + seconds, 0

    def has_passed(self):
        """Read the clock and return whether the deadline has passed."""
        if self.at.end < INFINITY and not self.at.passed:
            self.at.work = 0.0
            self.at.passed = read_clock() >= self.at.end
        return bool(self.at.passed)

    def fits(self, double cost):
        """Return whether a step of this estimated cost [ns] that starts now ends before the deadline."""
        return self.at.end == INFINITY or read_clock() + 1e-9 * cost < self.at.end

    def get_remaining_nanoseconds(self):
        """Return the remaining time [ns], the unit of estimated costs; inf without a limit."""
        return 1e9 * (self.at.end - read_clock())

    def get_remaining_seconds(self, double minimum=0.0):
        """Return the remaining time [s], at least `minimum`; None without a limit."""
        return None if self.at.end == INFINITY else max(self.at.end - read_clock(), minimum)
