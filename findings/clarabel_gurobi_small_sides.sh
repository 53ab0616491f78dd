#!/usr/bin/env bash
# Clarabel 0.11.1 and Gurobi 13.0.3 called by qpsolvers 4.13.0, a small right-hand side
# Behaviour: min x1^2/2 + x2^2 with x1 + x2 >= 1e-6 has the solution (2/3, 1/3) 1e-6. Both report a solution at their
# default settings, which is 65 and 99 times as large. DAQP, ProxQP and QPALM report (0, 0). OSQP is right within 1 %.
# Output: in 1e-6: clarabel (43, 21.5), gurobi (66, 33), daqp (0, 0), osqp (0.665, 0.332)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 \
  qpsolvers==4.13.0 clarabel==0.11.1 gurobipy==13.0.3 daqp==0.11.0 osqp==1.1.3
cd "$folder"
venv/bin/python - << 'EOF'
import sys
import warnings

import numpy as np
import qpsolvers
import scipy.sparse as sp

warnings.simplefilter("ignore")
SIDE = 1e-6
P, G = sp.csc_matrix(np.diag([1.0, 2.0])), sp.csc_matrix([[-1.0, -1.0]])
program, found = qpsolvers.Problem(P, np.zeros(2), G, np.array([-SIDE])), {}
for name in ("clarabel", "gurobi", "daqp", "osqp"):
    solution = qpsolvers.solve_problem(program, name)
    assert solution.found
    found[name] = solution.x / SIDE + 0.0
print("in 1e-6: " + ", ".join(f"{name} ({x[0]:.3g}, {x[1]:.3g})" for name, x in found.items()))
is_large = found["clarabel"][0] > 10.0 and found["gurobi"][0] > 10.0
is_same = is_large and not found["daqp"].any() and np.allclose(found["osqp"], [2 / 3, 1 / 3], rtol=0.01)
sys.exit(0 if is_same else "the behaviour has changed")
EOF
