"""The judge's pass over an impulse, and the stopping test of sweeps, which uses the same arithmetic."""
