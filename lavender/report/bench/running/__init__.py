"""Run solvers on cases: plans, time measurement, isolated processes, distribution to workers."""
