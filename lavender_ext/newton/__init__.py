"""Newton's method over rows and bodies: plan of the phases, one file for each phase, linear systems; warm starts."""
