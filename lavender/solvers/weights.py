"""Weights of factors and sweeps as kernels make them, and where the compiled calls for few rows have their limits.

Nanoseconds of one core; constants, the same on every machine: no clock is read. What `auto` expects of a solver as a
whole are the fitted rates of `rates.json` (`costs.py`).
"""

from __future__ import annotations

SWEEP = {"linear": 1.05, "lcp": 1.0, "coulomb": 0.65, "cone": 1.25}  # for each multiply-add of a sweep,
SWEEP_ROW = 5.0  # and each of its rows
DENSE, DENSE_ENTRY = 0.03, 3.0  # for each multiply-add of a dense factor, and for each entry of its matrix
BAND = 0.4  # of a band's
BLOCK, PANEL = 0.35, 0.2  # of one over bodies, by block rows and by panels
SPARSE = 100.0  # for each nonzero of a sparse factor's matrix,
SPARSE_ROWS = 1000.0  # as many times more as it has thousands of rows: fill grows with the size
# Of `newton` over rows of A by panels, whose analysis is kept: a factor with its solutions, for each entry of its
# pattern, and each multiply-add.
FILLED, FILLED_ENTRY, FILLED_WORK = 50e3, 6.0, 0.12

# Newton over generalised velocities: a call, for each row beside each factor, each multiply-add of the dense factor of
# an island, most of whose entries are nought unless every contact is inside its cone, and steps to expect.
GENERAL_START = 60e3
GENERAL_ROW = {"linear": 40.0, "lcp": 100.0, "cone": 140.0, "coulomb": 400.0}
GENERAL = {"linear": 0.1, "lcp": 0.06, "cone": 0.06, "coulomb": 0.02}
GENERAL_COUNT = {"linear": 5.0, "lcp": 5.0, "cone": 12.0, "coulomb": 30.0}
# ns of it up to which nothing else is looked at first; bounded rows and cones it mostly ends soonest,
GENERAL_FIRST = {"linear": 0.9e6, "lcp": 2e6, "cone": 2e6, "coulomb": 0.9e6}
GENERAL_MOST = 1e7  # and up to which nobody looks at the clock in between
FORMED_START, FORMED = 60e3, 2.0  # of A formed of J and M, and of each of its entries,
