"""Blocks and their update, bodies and rows, sparse matrices, derived numbers of a problem, sweep orders."""
