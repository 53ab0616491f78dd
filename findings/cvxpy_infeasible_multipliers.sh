#!/usr/bin/env bash
# CVXPY 1.9.0, dual values after an infeasible program
# Behaviour: x1 + x2 = 1 and x1 + x2 = 2 have no solution. The status is "infeasible" and the variables are None, but
# dual_value of both constraints is set: it has the certificate of infeasibility instead of multipliers, with Clarabel,
# OSQP and SCS.
# Output: CLARABEL, OSQP, SCS: infeasible, x None, dual values (1, -1)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 cvxpy==1.9.0 clarabel==0.11.1 osqp==1.1.3 scs==3.3.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys
import warnings

import cvxpy
import numpy as np

warnings.simplefilter("ignore")
found = []
for name in ("CLARABEL", "OSQP", "SCS"):
    x = cvxpy.Variable(2)
    rows = [x[0] + x[1] == 1, x[0] + x[1] == 2]
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(x)), rows)
    problem.solve(solver=name)
    values = [row.dual_value for row in rows]
    print(f"{name}: {problem.status}, x {x.value}, dual values ({values[0]:.3g}, {values[1]:.3g})")
    is_certificate = np.isclose(values[0], -values[1], rtol=1e-2) and abs(values[0]) > 0.1
    found.append(problem.status == "infeasible" and x.value is None and is_certificate)
sys.exit(0 if all(found) else "the behaviour has changed")
EOF
