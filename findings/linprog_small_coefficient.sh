#!/usr/bin/env bash
# SciPy 1.17.1, linprog with a coefficient of 5e-10
# Behaviour: HiGHS drops entries of a matrix below 1e-9. min -x1 with 5e-10 x1 + x2 <= 0, 0 <= x1 <= 1e10 and 0 <= x2
# <= 1 has the solution 0. linprog reports success with x1 = 1e10, at which the row is violated by 5, and a slack of 0.
# With the row multiplied by 1e6, it returns 0.
# Output: success True, x1 = 1e+10, row 5 <= 0, slack 0; multiplied: x1 = -0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import numpy as np
from scipy.optimize import linprog

row = np.array([[5e-10, 1.0]])
bounds = [(0.0, 1e10), (0.0, 1.0)]
found, scaled = (linprog([-1.0, 0.0], A_ub=scale * row, b_ub=[0.0], bounds=bounds) for scale in (1.0, 1e6))
value = float((row @ found.x)[0])
print(
    f"success {found.success}, x1 = {found.x[0]:g}, row {value:g} <= 0, slack {found.slack[0]:g}; "
    f"multiplied: x1 = {scaled.x[0]:g}"
)
is_same = found.success and value > 1.0 and found.slack[0] == 0.0 and abs(scaled.x[0]) < 1e-3
sys.exit(0 if is_same else "the behaviour has changed")
EOF
