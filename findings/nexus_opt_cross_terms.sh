#!/usr/bin/env bash
# nexus-opt 0.1.0, Model.minimize with a product of two variables: x^2 + y^2 + d x y - x - 2 y, convex for |d| < 2, |x|, |y| <= 100
# Behaviour: the product of two different variables counts twice. The point returned is the minimum for 2 d, with the status
# optimal and the objective of that other program: (0, 1) for d = 0.5, where (0.267, 0.933) is right, and (-99.5, 100) for d = 1, where
# (0, 1) is right. HiGHS and OSQP, forced as solver, get the same program. For 1 < |d| < 2 OSQP refuses the convex program as
# non-convex. Squares are right, and so is quad_form, which turns the form into a cone.
# Output: d = 0.2: (0.3125, 0.9375), right (0.4040, 0.9596); 0.5: (0, 1), right (0.2667, 0.9333); 0.9: (-2.1053, 2.8947), right
# (0.0627, 0.9718); quad_form with d = 0.5: (0.2667, 0.9333)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check nexus-opt==0.1.0 numpy==2.4.6 scipy==1.17.1 \
    highspy==1.16.0 osqp==1.1.3 clarabel==0.11.1
cd "$folder"
venv/bin/python - > lines.txt << 'END' || { cat lines.txt; exit 1; }
import sys

import nexus_opt
import numpy as np


def minimize(d, solver, use_form=False):
    """Return the status, the reported objective and the point."""
    model = nexus_opt.Model()
    x, y = (model.variable(name, lower=-100, upper=100) for name in "xy")
    square = nexus_opt.quad_form(model, [x, y], [[1, d / 2], [d / 2, 1]]) if use_form else x * x + y * y + d * (x * y)
    model.minimize(square - 1 * x - 2 * y)
    result = model.solve(solver=solver) if solver else model.solve()
    return result.status, result.objective, np.array([result.value(x), result.value(y)])


def optimum(d):
    return np.linalg.solve([[2, d], [d, 2]], [1, 2])


def cost(d, point):
    x, y = point
    return x * x + y * y + d * x * y - x - 2 * y


same = True
for d in (0.2, 0.5, 0.9):
    for solver in (None, "highs", "osqp"):
        status, objective, point = minimize(d, solver)
        print(f"found: d = {d}, {solver or 'default'}: {status}, {point.round(4)}, right {optimum(d).round(4)}; "
              f"objective {objective:.4f}, of this point {cost(d, point):.4f}, smallest {cost(d, optimum(d)):.4f}")
        same &= status == "optimal" and np.abs(point - optimum(2 * d)).max() < 1e-3 and abs(objective - cost(2 * d, point)) < 1e-3
status, _, point = minimize(0.5, None, use_form=True)
print(f"found: quad_form, d = 0.5: {status}, {point.round(4)}")
same &= np.abs(point - optimum(0.5)).max() < 1e-3
status, _, point = minimize(1.0, None)
print(f"found: d = 1: {status}, {point.round(1)}, right {optimum(1.0).round(4)}")
same &= status == "optimal" and abs(point[0] - optimum(1.0)[0]) > 50
sys.exit(0 if same else "the behaviour has changed")
END
grep "^found" lines.txt | cut -c 8-
