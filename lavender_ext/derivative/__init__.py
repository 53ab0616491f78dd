"""Derivative of the judge's natural map at a solution, with a factor, for gradients and states of blocks."""
