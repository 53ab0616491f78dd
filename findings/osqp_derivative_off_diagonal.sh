#!/usr/bin/env bash
# OSQP 1.1.3, adjoint_derivative_compute and entries of P beside the diagonal
# Behaviour: setup takes the upper triangle of P, so that one stored entry stands for two entries of P. The derivative
# by such an entry has half of the change of the solution that a change of the stored entry causes. The derivatives by
# entries on the diagonal and by q agree with differences.
# Output: d x1 / d P12: osqp -0.2, differences -0.4; d x1 / d P22: osqp 0.2, differences 0.2

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 osqp==1.1.3
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import numpy as np
import osqp
import scipy.sparse as sp

q, bound = np.array([-1.0, -2.0]), np.full(2, 10.0)


def solve(stored):
    solver = osqp.OSQP()
    P = sp.csc_matrix(([stored[0], stored[1], stored[2]], ([0, 0, 1], [0, 1, 1])), shape=(2, 2))
    settings = {"verbose": False, "eps_abs": 1e-10, "eps_rel": 1e-10}
    solver.setup(P, q, sp.csc_matrix(np.eye(2)), -bound, bound, **settings)
    return solver, solver.solve().x


stored, step = np.array([3.0, 1.0, 2.0]), 1e-4  # P11, P12, P22
solver, _ = solve(stored)
solver.adjoint_derivative_compute(dx=np.array([1.0, 0.0]))
derivative = np.asarray(solver.adjoint_derivative_get_mat()[0])
theirs = derivative[0, 1], derivative[1, 1]
differences = [(solve(stored + step * e)[1][0] - solve(stored - step * e)[1][0]) / (2 * step) for e in np.eye(3)[1:]]
print(
    f"d x1 / d P12: osqp {theirs[0]:.3g}, differences {differences[0]:.3g}; "
    f"d x1 / d P22: osqp {theirs[1]:.3g}, differences {differences[1]:.3g}"
)
is_same = np.isclose(2.0 * theirs[0], differences[0], rtol=1e-3) and np.isclose(theirs[1], differences[1], rtol=1e-3)
sys.exit(0 if is_same else "the behaviour has changed")
EOF
