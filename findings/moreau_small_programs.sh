#!/usr/bin/env bash
# Moreau 0.4.1, two programs of two variables with the default settings and with solver="ipm"
# Behaviour: small programs go to an active-set method. P = [[1, -1], [-1, 1]], q = (-1, -1), x >= 0 falls without bound
# along (1, 1): the default says Solved at x = (2000001, 2000000), the interior point DualInfeasible. An equality that is
# given twice ends with NumericalError and x = 0, the interior point solves it.
# Output: unbounded: default Solved [2000001. 2000000.], ipm DualInfeasible; equality given twice: default NumericalError
# [0. 0.], ipm Solved [0.5 0.5]

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 moreau==0.4.1
cd "$folder"
venv/bin/python - << 'EOF'
import sys
import warnings

import moreau
import numpy as np
import scipy.sparse

warnings.simplefilter("ignore")


def solve(P, q, A, b, equalities, rows, **settings):
    cones = moreau.Cones(num_zero_cones=equalities, num_nonneg_cones=rows)
    matrices = scipy.sparse.csr_matrix(np.array(P)), np.array(q), scipy.sparse.csr_matrix(np.array(A)), np.array(b)
    solver = moreau.Solver(*matrices, cones, moreau.Settings(**settings))
    return solver, solver.solve()


def tell(*program):
    told = []
    for name in ("auto", "ipm"):
        solver, solution = solve(*program, solver=name)
        told.append((solver.info.status.name, np.round(solution.x, 6)))
    return told


unbounded = tell([[1.0, -1], [-1, 1]], [-1.0, -1], -np.eye(2), np.zeros(2), 0, 2)
twice = tell(np.eye(2), [-1.0, -1], np.ones((2, 2)), np.ones(2), 2, 0)
print("unbounded:", unbounded)
print("equality given twice:", twice)
statuses = [status for status, _ in unbounded + twice]
same = statuses == ["Solved", "DualInfeasible", "NumericalError", "Solved"] and unbounded[0][1].min() > 1e6
sys.exit(0 if same else "the behaviour has changed")
EOF
