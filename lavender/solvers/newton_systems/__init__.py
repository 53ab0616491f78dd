"""Linear systems of Newton's method; `lavender/solvers/newton.py` uses them.

systems          systems over the bodies or over the rows of A, and their compiled solve
augmented        factorisations for nearly dependent rows of bodies
general          Newton's method over the velocities of generalised coordinates

The scaling z = D^1/2 lambda, the sequence of methods, the exchanges, the interior points and the proximal iterations
are in `lavender_ext/newton/`.
"""
