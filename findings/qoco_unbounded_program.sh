#!/usr/bin/env bash
# QOCO 0.3.2, an unbounded program
# Behaviour: min x1^2/2 - x2 with x >= 0 has no minimum. QOCO reports QOCO_SOLVED with x2 of about 7e15.
# Output: QOCO_SOLVED, x2 = 6.97513e+15

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 jinja2 qoco==0.3.2
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import numpy as np
import qoco
import scipy.sparse as sp

solver = qoco.QOCO()
P, c, G = sp.csc_matrix(np.diag([1.0, 0.0])), np.array([0.0, -1.0]), sp.csc_matrix(-np.eye(2))
solver.setup(2, 2, 0, P, c, None, None, G, np.zeros(2), 2, 0, None)
result = solver.solve()
print(f"{result.status}, x2 = {result.x[1]:g}")
sys.exit(0 if result.status == "QOCO_SOLVED" and result.x[1] > 1e12 else "the behaviour has changed")
EOF
