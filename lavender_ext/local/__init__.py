"""Exact solution of the problem of one block, and block Gauss-Seidel sweeps."""
