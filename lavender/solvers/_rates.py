"""Rates by which the costs of `auto` are counted: constants, the same on every machine; no clock is read.

Nanoseconds of one core, unless another unit is said, from times and counts of drawn problems that `lavender bench auto
--out` writes, which measures what is lost by them as well. One that is off by two moves a choice only where two
candidates cost about the same (`lavender bench auto --rates`). Read as `rates.NAME`, so that one can be moved.
"""

from __future__ import annotations

# For each multiply-add of a sweep, mixing included; the cone law solves each contact exactly.
SWEEP = {"linear": 1.05, "lcp": 1.0, "coulomb": 0.65, "cone": 1.25}
SWEEP_ROW = 5.0  # for each row of a sweep
SWEEP_START = 80e3  # what Python needs for sweeps,
LOOK = 20e3  # for each look at their residual,
ROWS_OF_A = 80e3  # and where they run over rows of A that must be formed first
START = {"direct": 60e3, "newton": 300e3, "lemke": 500e3}  # of a call, before anything is factored
STEP = {"direct": 10e3, "newton": 35e3}  # beside each factor
ROW = 30.0  # for each row beside each factor of `direct`,
NEWTON_ROW = {"linear": 150.0, "lcp": 150.0, "cone": 300.0, "coulomb": 300.0}  # and of `newton`
BODIES_START, BODIES_STEP, BODIES_ROW = 150e3, 8e3, 190.0  # of `newton` over bodies under a convex law
# What it takes to find out what one factor of `newton` costs, of its pattern: a call, each row, and each entry of A.
ASK, ASK_ROW, ASK_ENTRY = 200e3, 400.0, 3.0
ASK_BODIES, ASK_BODIES_ROW = 150e3, 200.0  # over bodies
DENSE, DENSE_ENTRY = 0.03, 3.0  # for each multiply-add of a dense factor, and for each entry of its matrix
BAND = 0.4  # of a band's
# `direct` on few bounded rows, in compiled code, with one shift where A is singular: a call and its rounds, each a row
# and a factor.
FEW_START, FEW_ROUNDS = 45e3, 9.0
FEW_PIVOT = 2e3  # of `lemke`, of whose time a call is most there
BLOCK, PANEL = 0.35, 0.2  # of one over bodies, by block rows and by panels
SPARSE = 100.0  # for each nonzero of a sparse factor's matrix,
SPARSE_ROWS = 1000.0  # as many times more as it has thousands of rows: fill grows with the size
# Of `newton` over rows of A by panels, whose analysis is kept: a factor with its solutions, for each entry of its
# pattern, and each multiply-add.
FILLED, FILLED_ENTRY, FILLED_WORK = 50e3, 6.0, 0.12
PIVOT, PIVOT_ENTRY = 60e3, 0.5  # of each pivot of lemke, and for each entry of its tableau
# Newton over generalised velocities: a call, for each row beside each factor, and each multiply-add of the dense
# factor of an island, most of whose entries are nought unless every contact is inside its cone.
GENERAL_START = 60e3
GENERAL_ROW = {"linear": 40.0, "lcp": 100.0, "cone": 140.0, "coulomb": 400.0}
GENERAL = {"linear": 0.1, "lcp": 0.06, "cone": 0.06, "coulomb": 0.02}
CROWDED = 6.0  # to count factors that fill much, and for their room, for each square of the velocities
GENERAL_STEP_ROW = 150.0  # of a step under Coulomb's law, its tail aside
GENERAL_SOFT = (
    1e-6  # of d: the least softness of a row without a proximal term; where all are soft, one factor ends it
)
# The same under Coulomb's law on few rows as it usually is: a call, steps, each row and multiply-add in one of them;
# and sweeps: all that Python does for them, so many as end half of these, and each row in one of them.
FEW_CALL, FEW_STEPS, FEW_STEP_ROW, FEW_STEP_FLOP = 30e3, 22.0, 60.0, 0.09
FEW_LOOK, FEW_SWEEPS, FEW_SWEEP_ROW = 40e3, 25.0, 40.0
FEW_SWEEP = 150.0  # of a sweep of few rows of A beside its multiply-adds: what it takes to mix
SOFT = 1e-3  # of d, that rows of soft contacts have of their own (`soften` in lavender_ext/generalized/newton.pxd)
# The same under Coulomb's law where soft rows are many: a step, for each row in it, and steps as they usually are (8 to
# 33 on flexes of 1,800 to 10,200 rows; what few rows cost above holds their tails, too).
MANY_STEP, MANY_ROW, MANY_COUNT = 15e3, 110.0, 10.0
MANY_ROWS = 1000  # rows beyond which that is counted
GENERAL_FIRST = 0.6e6  # ns of it up to which nothing else is looked at first
FORM = 1.0  # of each multiply-add of Y Y^T
WITH_A = 2.0  # times what A costs to form, that others cost with their first factor of it
FORMED_ROWS = 6.0  # of each entry of A over bodies
FORMED_START, FORMED = 60e3, 2.0  # of A formed of J and M, and of each of its entries
# The same under friction, before which sweeps that end there are not given up.
RUBBED_START, RUBBED = 280e3, 6.0
ADMM_START, ADMM_ROW, ADMM_ENTRY = (
    500e3,
    40.0,
    0.15,
)  # a call; of each iteration for each row and each entry of L

FIRST_LOOK, LAST_LOOK = 16, 64  # sweeps before the first look at the residual: so many at least and at most,
LOOKED = 60e3  # ns, or as cost so much: a look and a cut in the sweeps are not free

# Sweeps that A costs at least as much to form as, with their call, where one body carries many; and those tried there.
CARRIED, TRIED = 12.0, 8
GLANCED = 200e3  # ns of a first look at sweeps that may come before anything else is found out
GLANCE = 0.35  # share of a finite solver's cost for which a first look at sweeps is always worth it

# Factorisations to expect, by law: medians over drawn problems. Friction has a long tail.
DIRECT = {"linear": 1.5, "lcp": 6.0}
NEWTON = {"linear": 2.0, "lcp": 9.0, "cone": 14.0, "coulomb": 8.0}
NEWTON_DECADE = {"linear": 0.0, "lcp": 0.0, "cone": 1.5, "coulomb": 0.0}  # and more for each decade above six
PER_ROW = {
    "linear": 0.0,
    "lcp": 0.0,
    "cone": 0.0,
    "coulomb": 1.0 / 40.0,
}  # more of them: contacts change their side
TAIL_LEAST, TAIL_TIME = 6, 2e6  # of them at least under Coulomb's law, else as many as take so long [ns]
BUDGET = {"linear": 2.0, "lcp": 2.0, "cone": 2.0, "coulomb": 1.2}  # times as many that its first turn has
TAIL = {"linear": 2, "lcp": 10, "cone": 40, "coulomb": 24}  # more that are granted before another is asked
MOST = 30.0  # of what rows add
GENERAL_COUNT = {"linear": 5.0, "lcp": 5.0, "cone": 12.0, "coulomb": 30.0}  # over generalised velocities
ADMM_COUNT, ADMM_FACTORS = 80.0, 2.0  # iterations to six decades where it gets there, and how often rho moves
# Share of problems on which it does, over bodies and over rows of A: of candidates that may fail, those of least cost
# for each chance come first.
ADMM_LUCK_BODIES, ADMM_LUCK = 0.15, 0.4
ADMM_FILL = 6.0  # entries of L for each of A
DIRECT_ROUNDS = 40  # of `direct` on bounded rows that are granted before another is asked
# Times what `newton` costs on an asymmetric A with few entries: it often takes many times as many factorisations.
ASYMMETRIC = {"linear": 1.0, "lcp": 3.0, "cone": 1.5, "coulomb": 3.0}
AT_REST = 8.0  # of faces on faces, most of whose rows hold
UNSYMMETRIC = 2.0  # LU against Cholesky, where friction or A asks for it
SINGULAR = 6.0  # times as many of `direct` where A is singular and one shift does not end it,
STUCK = 10.0  # and where exchanges were stuck

# Sweeps to expect before anything was swept, to six decades: median over drawn problems, and where the same weight
# rests on more points than are needed.
SWEEPS, SWEEPS_REDUNDANT = 60.0, 400.0

ISLAND = 400e3  # what Python takes for an island of its own
# Islands in compiled code: a call, as it showed in `wild` with them and without; for each island beside its solve, and
# for each of its rows (`python -m benchmarks islands`).
TOGETHER, TOGETHER_ISLAND, TOGETHER_ROW = 200e3, 1e3, 60.0
BAND_AT_ONCE = 4e6  # ns of `direct` on a narrow band up to which nothing else is looked at
LU_ROWS = 300  # of a linear system that is not symmetric, up to which sweeps are looked at before its factor
FEW_JOINTS = 300  # rows up to which a linear system is not looked at more closely
NARROW_ENTRIES = 12  # of A in a row up to which a narrow band is looked for
NARROW = 40  # half bandwidth up to which a band is what `direct` takes
TREE = 1.05  # neighbours of a body, in the mean, up to which bodies form trees
LOOKS = 4  # at so many sweeps
# Steps that it then has, beside those that are expected of each island but one; under Coulomb's law, where it ends soon
# or late, as many as in one compiled call.
GENERAL_STEPS = {"linear": 256, "lcp": 256, "cone": 256, "coulomb": 64}
# Steps over generalised velocities, in each island, that are granted beside twice those expected.
GENERAL_TAIL = 60
ADMM_GENERAL = 1500  # rows up to which A of J and M, whose entries are not known, is formed for `admm`
LEMKE_ROWS = 1000  # beyond, a dense tableau of 8 MB and more
