#!/usr/bin/env bash
# CasADi 3.8.2, its own interior point method ipqp in casadi.conic, strictly convex programs with one and with two equations
# Behaviour: min |x|^2/2 + g'x with the equations x1 = 0.5 and x2 = 0.1 as rows has the solution (0.5, 0.1, -2). ipqp returns nan for
# each x, with success True. With one equation it is right, and so is qrqp with one and two. An equation beside an inequality gives
# nan, too, with success False.
# Output: 2 equations: qrqp success True, x = (0.5, 0.1, -2); ipqp success True, x = (nan, nan, nan)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 casadi==3.8.2
cd "$folder"
venv/bin/python - << 'END'
import sys

import casadi
import numpy as np

A = np.array([[1.0, 0, 0], [0, 1, 0]])
QUIET = {"print_time": False, "print_iter": False, "print_header": False}


def solve(name, lower, upper):
    options = dict(QUIET, print_info=False, error_on_fail=False) if name == "ipqp" else QUIET
    rows = A[: len(lower)]
    pattern = {"h": casadi.DM(np.eye(3)).sparsity(), "a": casadi.DM(rows).sparsity()}
    solver = casadi.conic("solver", name, pattern, options)
    result = solver(h=np.eye(3), g=[-4.0, -3, 2], a=rows, lba=lower, uba=upper)
    return np.array(result["x"]).ravel(), solver.stats()["success"]


found = {}
for label, *bounds in (("1 equation", [0.5], [0.5]), ("2 equations", [0.5, 0.1], [0.5, 0.1]), ("with a row", [-9.0, 0.1], [0.5, 0.1])):
    for name in ("qrqp", "ipqp"):
        found[label, name] = solve(name, *bounds)
    told = [f"{name} success {found[label, name][1]}, x = ({', '.join(f'{v:g}' for v in found[label, name][0])})" for name in ("qrqp", "ipqp")]
    print(f"{label}: " + "; ".join(told))
same = found["2 equations", "ipqp"][1] and np.isnan(found["2 equations", "ipqp"][0]).all()
same = same and np.isnan(found["with a row", "ipqp"][0]).all() and not found["with a row", "ipqp"][1]
same = same and np.allclose(found["1 equation", "ipqp"][0], (0.5, 3, -2)) and np.allclose(found["2 equations", "qrqp"][0], (0.5, 0.1, -2))
sys.exit(0 if same else "the behaviour has changed")
END
