"""Running solvers on cases: what to measure, one clock, processes of their own, many workers."""
