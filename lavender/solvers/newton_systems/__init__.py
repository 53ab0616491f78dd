"""Newton's method in parts; `lavender/solvers/newton.py` puts them together.

systems          what is factored, over the bodies or over the rows of A, and its compiled solve
sparse           matrices of few entries, for that
augmented        rows that nearly depend on each other, likewise
general          over the velocities of generalised coordinates

The rows that move, in the unknown z = D^1/2 lambda, what is tried when, the exchanges, interior points and proximal
rounds stand in `lavender_ext/newton/`.
"""
