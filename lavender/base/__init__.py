"""Modules that every layer uses: arrays, errors, deadlines, calls in other processes, lazy imports."""
