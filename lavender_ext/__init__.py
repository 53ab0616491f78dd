"""Compiled kernels of lavender: raw arrays in, numbers out. Nothing here imports lavender."""
