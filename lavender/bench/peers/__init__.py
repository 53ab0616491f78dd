"""Solvers of others on the same problems, by their own interface."""
