#!/usr/bin/env bash
# CVXPY 1.9.0, values of a variable with nonneg=True
# Behaviour: OSQP with tolerances of 1e-3 and without polishing violates x >= 0 by 2e-4. With x >= 0 as a constraint,
# x.value has the entries of the solver. With nonneg=True, x.value has exact zeros instead: the values are projected,
# so that a violation of the solver cannot be seen, and they are not the point of which problem.value is the objective.
# Output: constraint: smallest -0.000195; nonneg=True: smallest 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 cvxpy==1.9.0 osqp==1.1.3
cd "$folder"
venv/bin/python - << 'EOF'
import sys
import warnings

import cvxpy
import numpy as np

warnings.simplefilter("ignore")
q, smallest = np.array([1.0, -1.0, 1.0]), []
for is_attribute in (False, True):
    x = cvxpy.Variable(3, nonneg=is_attribute)
    objective = cvxpy.Minimize(cvxpy.sum_squares(x) + q @ x)
    problem = cvxpy.Problem(objective, [] if is_attribute else [x >= 0])
    problem.solve(solver="OSQP", polishing=False, eps_abs=1e-3, eps_rel=1e-3)
    smallest.append(x.value.min())
print(f"constraint: smallest {smallest[0]:.3g}; nonneg=True: smallest {smallest[1]:.3g}")
sys.exit(0 if smallest[0] < -1e-5 and smallest[1] == 0.0 else "the behaviour has changed")
EOF
