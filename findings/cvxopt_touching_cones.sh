#!/usr/bin/env bash
# CVXOPT 1.3.3, second-order cones that touch at one point
# Behaviour: min x2 with |(x1, x2)| <= 1 and |(x1 - 2, x2)| <= 1 has the one feasible point (1, 0). solvers.socp raises
# ValueError instead of returning a status. With the objective x1, it returns "optimal" and the point.
# Output: min x1: optimal, x = (1, 0); min x2: ValueError: math domain error

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check cvxopt==1.3.3
cd "$folder"
venv/bin/python - << 'EOF'
import sys

from cvxopt import matrix, solvers

solvers.options["show_progress"] = False
rows = matrix([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
sides = [matrix([1.0, 0.0, 0.0]), matrix([1.0, -2.0, 0.0])]
results = []
for name, objective in (("x1", [1.0, 0.0]), ("x2", [0.0, 1.0])):
    try:
        found = solvers.socp(matrix(objective), Gq=[rows, rows], hq=sides)
        x = ", ".join(f"{v + 0.0:.4g}" for v in (round(v, 5) for v in found["x"]))
        results.append(f"min {name}: {found['status']}, x = ({x})")
    except ValueError as error:
        results.append(f"min {name}: ValueError: {error}")
print("; ".join(results))
sys.exit(0 if "optimal" in results[0] and "ValueError" in results[1] else "the behaviour has changed")
EOF
