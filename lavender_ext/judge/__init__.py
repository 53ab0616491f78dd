"""The judge's pass over an impulse, and the stopping test of sweep solvers that uses the same arithmetic."""
