#!/usr/bin/env bash
# NLopt 2.11.0, a strictly convex program whose two inequality constraints contradict each other
# Behaviour: x1 <= -1 and x1 >= 1 have no solution. MMA and CCSAQ end with XTOL_REACHED, a positive code that counts as
# success, at x = (0, 1), which breaks both constraints by 1. SLSQP raises RoundoffLimited. Nothing names the constraints.
# Output: LD_MMA: code 4, x = (0.0, 1.0), constraints broken by 1.0; LD_CCSAQ: the same

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 nlopt==2.11.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import nlopt
import numpy as np

G, h, q = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-1.0, -1.0]), np.array([-1.0, -1.0])


def cost(x, gradient):
    if gradient.size:
        gradient[:] = x + q
    return float(x @ x / 2 + q @ x)


def constrain(values, x, gradient):
    if gradient.size:
        gradient[:] = G
    values[:] = G @ x - h


same = True
for name in ("LD_MMA", "LD_CCSAQ"):
    problem = nlopt.opt(getattr(nlopt, name), 2)
    problem.set_min_objective(cost)
    problem.add_inequality_mconstraint(constrain, np.full(2, 1e-10))
    problem.set_xtol_rel(1e-10)
    problem.set_maxeval(5000)
    x, code = problem.optimize(np.zeros(2)), problem.last_optimize_result()
    broken = float((G @ x - h).max())
    print(f"{name}: code {code}, x = {tuple(map(float, np.round(x, 6)))}, constraints broken by {broken:.1f}")
    same = same and code == nlopt.XTOL_REACHED and broken > 0.5
sys.exit(0 if same else "the behaviour has changed")
EOF
