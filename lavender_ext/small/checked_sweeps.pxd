"""What sweeps promise, for other compiled loops."""

cpdef double sweeps_left(double done, double before, double now, double tol) noexcept nogil
