"""Quadratic programs from a call to a judged answer: `solve_qp`, over `lavender.solving`.

The data and the conversion to a constraint problem are in `lavender/problem/program.py`.
"""
