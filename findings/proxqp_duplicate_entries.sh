#!/usr/bin/env bash
# ProxQP (proxsuite 0.8.0), a sparse matrix with two stored values for one entry
# Behaviour: SciPy adds the values 1 + 1 of the entry (0, 0) of P. ProxQP's sparse interface uses another matrix,
# reports PROXQP_SOLVED, and returns (0.2, 0.4). After P.sum_duplicates() it returns (1/3, 1/3).
# Output: solved (0.2, 0.4), after sum_duplicates (0.33333, 0.33333)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 proxsuite==0.8.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import numpy as np
import scipy.sparse as sp
from proxsuite import proxqp

# P = [[2, 1], [1, 2]], with two values for the entry (0, 0); min x.P x / 2 - x1 - x2 has the solution (1/3, 1/3).
P = sp.csc_matrix((np.array([1.0, 1.0, 1.0, 2.0, 1.0]), np.array([0, 0, 1, 1, 0]), np.array([0, 3, 5])), shape=(2, 2))


def solve(matrix):
    qp = proxqp.sparse.QP(2, 0, 2)
    low, high = np.full(2, -9.0), np.full(2, 9.0)
    qp.init(matrix, -np.ones(2), None, None, sp.csc_matrix(np.eye(2)), low, high)
    qp.solve()
    return qp.results.info.status == proxqp.PROXQP_SOLVED, qp.results.x.round(5)


is_solved, x = solve(P)
summed = P.copy()
summed.sum_duplicates()
_, right = solve(summed)
print(f"{'solved' if is_solved else 'not solved'} {tuple(map(float, x))}, after sum_duplicates {tuple(map(float, right))}")
is_same = is_solved and np.abs(x - 1 / 3).max() > 0.05 and np.abs(right - 1 / 3).max() < 1e-3
sys.exit(0 if is_same else "the behaviour has changed")
EOF
