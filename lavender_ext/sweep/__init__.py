"""Sweeps of Gauss-Seidel and Jacobi type: one thread, several threads, contacts packed in lanes."""
