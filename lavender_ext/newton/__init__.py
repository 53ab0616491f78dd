"""Newton's method over rows and bodies, in phases: linear systems, interior points, exchanges; warm starts."""
