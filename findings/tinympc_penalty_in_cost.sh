#!/usr/bin/env bash
# TinyMPC 0.0.8, a double integrator without active bounds, horizon 10, tolerances 1e-9, three penalties rho
# Behaviour: rho is the penalty of the ADMM iteration, so a converged answer does not depend on it. Here the first input
# is -5.74, -2.84 and -1.47 for rho = 0.1, 1 and 10, where Riccati's recursion with the weights Q and R gives -7.34 (last
# weight Q) or -7.61 (last weight of the infinite horizon). The three inputs are the optima for the weights Q + rho I and
# R + rho I. Bounds on states or inputs that are far away change nothing.
# Output: rho 0.1: -5.7406, with Q + rho I and R + rho I -5.7406, with Q and R -7.6130 (and two lines more)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==1.26.4 "scipy>=1.11.4" setuptools==80.9.0 tinympc==0.0.8
cd "$folder"
venv/bin/python - << 'EOF'
import contextlib
import io
import sys

import numpy as np
import scipy.linalg
import tinympc

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
Q, R, N, x0 = np.diag([10.0, 1.0]), np.array([[0.1]]), 10, np.array([1.0, 0.0])


def find_first_input(Q, R, last):
    for _ in range(N - 1):
        K = np.linalg.solve(R + B.T @ last @ B, B.T @ last @ A)
        last = Q + A.T @ last @ (A - B @ K)
    return -(K @ x0)[0]


exact = find_first_input(Q, R, scipy.linalg.solve_discrete_are(A, B, Q, R))
same = True
for rho in (0.1, 1.0, 10.0):
    solver = tinympc.TinyMPC()
    with contextlib.redirect_stdout(io.StringIO()):
        solver.setup(A, B, Q, R, N, rho=rho, abs_pri_tol=1e-9, abs_dua_tol=1e-9, max_iter=50000)
        solver.set_x0(x0)
        first = np.ravel(solver.solve()["controls_all"])[0]
    once, twice = (([Q + k * rho * np.eye(2), R + k * rho]) for k in (1, 2))
    last = scipy.linalg.solve_discrete_are(A, B, *twice) - rho * np.eye(2)
    shifted = find_first_input(*once, last)
    print(f"rho {rho}: {first:.4f}, with Q + rho I and R + rho I {shifted:.4f}, with Q and R {exact:.4f}")
    same = same and abs(first - shifted) < 1e-3 and abs(first - exact) > 1
sys.exit(0 if same else "the behaviour has changed")
EOF
