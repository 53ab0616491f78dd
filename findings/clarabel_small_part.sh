#!/usr/bin/env bash
# Clarabel 0.11.1, two independent parts of different size
# Behaviour: the program has two parts without common variables. The linear terms are 3e6 in one and 1 in the other.
# Clarabel reports Solved with its default tolerances of 1e-8, and returns 42 for a variable whose value is 0.5: its
# tolerances are relative to the largest numbers of the program. Alone, the second part is solved to 1e-8.
# Output: together Solved, x3 = 42.1; alone Solved, x3 = 0.5

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 clarabel==0.11.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import clarabel
import numpy as np
import scipy.sparse as sp

pair = np.array([[2.0, 1.0], [1.0, 2.0]])


def solve(P, q):
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    n = len(q)
    cones = [clarabel.NonnegativeConeT(n)]
    P, A = sp.csc_matrix(np.triu(P)), sp.csc_matrix(-np.eye(n))
    solution = clarabel.DefaultSolver(P, q, A, np.zeros(n), cones, settings).solve()
    return str(solution.status), np.array(solution.x)


status, x = solve(np.kron(np.eye(2), pair), np.array([-3e6, -3e6, -1.0, 1.0]))
alone, part = solve(pair, np.array([-1.0, 1.0]))
print(f"together {status}, x3 = {x[2]:.3g}; alone {alone}, x3 = {part[0]:.3g}")
is_same = status == alone == "Solved" and abs(x[2] - 0.5) > 0.1 and abs(part[0] - 0.5) < 1e-6
sys.exit(0 if is_same else "the behaviour has changed")
EOF
