#!/usr/bin/env bash
# DAQP 0.11.0 called by qpsolvers 4.13.0, contradictory equalities
# Behaviour: x1 + x2 = 1 and x1 + x2 = 2 have no solution. DAQP's own interface returns the exit flag -6 (its initial
# working set is overdetermined). qpsolvers returns found=True with x = (0.5, 0.5), which violates the second equality.
# Output: DAQP exit flag -6; qpsolvers found True, x = (0.5, 0.5)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 qpsolvers==4.13.0 daqp==0.11.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import daqp
import numpy as np
import qpsolvers

A, b = np.ones((2, 2)), np.array([1.0, 2.0])
flag = daqp.solve(np.eye(2), np.zeros(2), A, b, b, np.full(2, 5, np.int32))[2]
solution = qpsolvers.solve_problem(qpsolvers.Problem(np.eye(2), np.zeros(2), A=A, b=b), "daqp")
print(f"DAQP exit flag {flag}; qpsolvers found {solution.found}, x = {tuple(map(float, np.round(solution.x, 6)))}")
sys.exit(0 if flag == -6 and solution.found else "the behaviour has changed")
EOF
