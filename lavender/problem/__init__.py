"""The constraint problem of one step: w = A lambda - b, with bounds of lambda.

    A = J M^-1 J^T + diag(compliance)  [1/kg],   b = target - J v*  [m/s],   w = A lambda - b  [m/s]

`Problem` holds one of three forms of A: rows (J and M^-1 of bodies, `lavender/problem/rows.py`), J and M in generalised
coordinates (`lavender/problem/generalized.py`), or a matrix. Other quantities are derived at their first use.

Each of these files builds on the files before it: `data.py` (fields and their checks), `operators.py` (A, J and the
metric), `program.py` (quadratic programs), `builders.py` (class methods that build problems), `problem.py` (`Problem`
and its conversions), `row_builder.py` (`RowBuilder`: joints and contacts in world coordinates).
"""

from lavender.problem.data import FRICTION_LAWS, LAWS, OPERATORS, PRECISIONS, Names, check_problem
from lavender.problem.problem import Problem, VelocityForm
from lavender.problem.program import QPSolution

__all__ = [
    "FRICTION_LAWS",
    "LAWS",
    "OPERATORS",
    "PRECISIONS",
    "Names",
    "Problem",
    "QPSolution",
    "VelocityForm",
    "check_problem",
]
