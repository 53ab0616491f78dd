#!/usr/bin/env bash
# CasADi 3.8.2, conic("f", "fatrop"), a bounded strictly convex program of three variables
# Behaviour: the plugin finds the optimum x = (0.41304, 0.08696, 0) and says success, but the output "cost" is 0; the
# cost of that x is -0.258696, which qpOASES' plugin returns.
# Output: fatrop: success True, cost 0.000000, cost of its x -0.258696; qpoases: success True, cost -0.258696

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 casadi==3.8.2
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import casadi
import numpy as np

P, q = np.array([[2.0, 0.6, 0.3], [0.6, 1.5, -0.4], [0.3, -0.4, 1.0]]), np.array([-1.0, -0.5, 0.8])
shapes = {"h": casadi.Sparsity.dense(3, 3), "a": casadi.Sparsity.dense(1, 3)}
costs = {}
for name, options in (("fatrop", {"print_time": False}), ("qpoases", {"printLevel": "none", "print_time": False})):
    solver = casadi.conic("f", name, shapes, options)
    result = solver(h=P, g=q, a=np.ones((1, 3)), lba=-np.inf, uba=0.5, lbx=0, ubx=np.inf)
    x = np.ravel(result["x"])
    costs[name] = float(result["cost"]), x @ P @ x / 2 + q @ x
    told = solver.stats()["success"]
    print(f"{name}: success {told}, cost {costs[name][0]:.6f}, cost of its x {costs[name][1]:.6f}")
same = costs["fatrop"][0] == 0 and abs(costs["fatrop"][1] - costs["qpoases"][0]) < 1e-6
sys.exit(0 if same else "the behaviour has changed")
EOF
