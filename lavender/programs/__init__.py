"""Quadratic programs from a call to a judged answer, and solvers of other packages ("backends").

`solve_qp` (`quadratic.py`) and `lavender.solve` (`qp_solver.py`) run one task (`task.py`): backends in turn
(`running.py` calls each, in this process or another one, `isolated.py`) on a scaled program (`convex.py`), the best
point of a judge (`judges.py`), and proofs that there is no solution (`proofs.py`). `backends` has a table of the
backends' specs; contact problems reach them in one of three forms (`forms.py`). The data of a program and its
conversion to a constraint problem are in `lavender/problem/program.py`, its error and rows in `lavender_ext/program`.
"""

from __future__ import annotations

from lavender.programs.backends import SPECS

__all__ = ["SPECS"]
