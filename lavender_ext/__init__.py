"""Compiled kernels of lavender: they read and write plain arrays. No module of this package imports lavender."""
