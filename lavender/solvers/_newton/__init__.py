"""Newton's method in parts; `lavender/solvers/newton.py` puts them together.

scaled           the rows that move, in the unknown z = D^1/2 lambda
pattern          order of elimination over bodies
systems          H and its Newton systems: over the bodies, or over the rows of A
interior_point   a cold Mehrotra predictor-corrector
run, polish      budget and best iterate; exchanges of bounded rows
proximal         proximal point rounds around Newton steps
augmented        the same where rows nearly depend on each other
convex, coulomb  what is tried when, for bounded rows and cones, for Coulomb friction
desaxce          interior points of Coulomb's law
general          over the velocities of generalised coordinates
warm             the first phase from a warm start
"""
