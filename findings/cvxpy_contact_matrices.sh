#!/usr/bin/env bash
# CVXPY 1.9.0, quad_form with matrices J J^T
# Behaviour: the test for a semidefinite matrix has an absolute tolerance. J is drawn with shape (12, 6), so that A = J
# M^-1 J^T is semidefinite with rank 6, as of a body with several contacts. Multiplied by 1e-3, all of 100 matrices are
# accepted; as they are, most are refused; multiplied by 1e6, all are refused.
# Output: refused: 0 of 100 at 0.001, 80 of 100 at 1, 100 of 100 at 1e+06

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 cvxpy==1.9.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys
import warnings

import cvxpy
import numpy as np

warnings.simplefilter("ignore")
rng, refused = np.random.default_rng(0), {}
drawn = [rng.normal(size=(12, 6)) for _ in range(100)]
for scale in (1e-3, 1.0, 1e6):
    refused[scale] = 0
    for J in drawn:
        A = scale * (J @ np.diag([1.0, 1.0, 1.0, 100.0, 100.0, 100.0]) @ J.T)
        x = cvxpy.Variable(12)
        objective = cvxpy.Minimize(cvxpy.quad_form(x, (A + A.T) / 2.0))
        refused[scale] += not cvxpy.Problem(objective, [x >= 0]).is_dcp()
print("refused: " + ", ".join(f"{count} of 100 at {scale:g}" for scale, count in refused.items()))
sys.exit(0 if refused[1e-3] == 0 and refused[1.0] > 20 and refused[1e6] == 100 else "the behaviour has changed")
EOF
