"""The judge's pass over an impulse, and when sweeps stop: by the same arithmetic, and where they get nowhere."""
