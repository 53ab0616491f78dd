#!/usr/bin/env bash
# CasADi 3.8.2, the solver superscs of casadi.conic, a singular Hessian
# Behaviour: min x1^2/2 - x2 with |x1| <= 5, 0 <= x2 <= 1 and x1 + x2 <= 10 has the solution (0, 1) and the minimum -1.
# superscs reports success with x1 = -1.4, where the objective is -0.02. The solvers osqp, highs and qrqp return (0, 1).
# Output: superscs: success True, x = (-1.40065, 1), objective -0.0191; qrqp: success True, x = (0, 1), objective -1

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 casadi==3.8.2
cd "$folder"
cat > solve.py << 'EOF'
import sys

import casadi as ca
import numpy as np

P, A = ca.DM(np.diag([1.0, 0.0])), ca.DM([[1.0, 1.0]])
solver = ca.conic("solver", sys.argv[1], {"h": P.sparsity(), "a": A.sparsity()}, {"error_on_fail": False})
found = solver(h=P, g=[0, -1], a=A, lba=-np.inf, uba=10, lbx=[-5, 0], ubx=[5, 1])
x = np.array(found["x"]).ravel() + 0.0
value, success = x[0] ** 2 / 2 - x[1], solver.stats()["success"]
print(f"\nRESULT {sys.argv[1]}: success {success}, x = ({x[0]:.6g}, {x[1]:.6g}), objective {value:.3g}")
EOF
for name in superscs qrqp; do venv/bin/python solve.py "$name" | sed -n 's/^RESULT //p' | tee "$name"; done
grep -q '^superscs: success True, x = (-1\.4' superscs || { echo "the behaviour has changed"; exit 1; }
