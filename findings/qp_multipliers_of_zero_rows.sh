#!/usr/bin/env bash
# Clarabel 0.11.1, CVXOPT 1.3.3, ECOS 2.0.14, PIQP 0.7.0, HiGHS 1.16.0 and DAQP 0.11.0 called by qpsolvers 4.13.0
# Behaviour: min |x|^2/2 - 3 x1 - 2 x2 with x1 + x2 <= 1 has the multiplier 2. An added row 0 <= 0 gets a multiplier of its own from
# three interior-point methods, larger than 0.9, and 0 from PIQP, which is one, too. Written as the equality of two opposite rows,
# the same four give 5.1 and 3.1, 3.0 and 1.0, 3.3 and 1.3, and 2.0 and 0.0; only the difference of 2 is determined.
# Output: zero row: Clarabel 2.39, CVXOPT 1.00, ECOS 1.73, the others 0; opposite row: Clarabel 3.09, CVXOPT 0.96, ECOS 1.30, others 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 qpsolvers==4.13.0 clarabel==0.11.1 \
  cvxopt==1.3.3 ecos==2.0.14 piqp==0.7.0 highspy==1.16.0 daqp==0.11.0
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys

import numpy as np
import qpsolvers
from scipy.sparse import csc_matrix

P, q = np.eye(2), np.array([-3.0, -2.0])
ROWS = {"zero row": ([[1.0, 1.0], [0.0, 0.0]], [1.0, 0.0]), "opposite row": ([[1.0, 1.0], [-1.0, -1.0]], [1.0, -1.0])}
INTERIOR, OTHERS = ("clarabel", "cvxopt", "ecos"), ("piqp", "highs", "daqp")
same = True
for name, (G, h) in ROWS.items():
    for solver in INTERIOR + OTHERS:
        convert = csc_matrix if solver in qpsolvers.sparse_solvers else np.array
        found = qpsolvers.solve_problem(qpsolvers.Problem(convert(P), q, convert(G), np.array(h)), solver=solver)
        first, second = found.z
        print(f"{name}, {solver}: {first:.2f}, {second:.2f}")
        same = same and abs(first - (second if name == "opposite row" else 0.0) - 2.0) < 1e-3
        same = same and (second > 0.9 if solver in INTERIOR else abs(second) < 1e-3)
sys.exit(0 if same else "the behaviour has changed")
END
