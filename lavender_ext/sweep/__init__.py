"""Sweeps of Gauss-Seidel and Jacobi type: blocks one after the other, contacts packed in lanes."""
