"""Blocks and their update, rows and bodies, matrices in compressed rows, a problem's derived numbers, sweep orders."""
