#!/usr/bin/env bash
# HiGHS 1.16.0 (highspy), quadratic programs with small solutions
# Behaviour: min |x|^2/2 - e (x1 + 2 x2) with x >= 0 has the solution (e, 2 e). With e = 1e-5, HiGHS reports Optimal and
# returns exact zeros. A row without bounds does not change this. With 1024 times the linear term, it returns 1024 times
# the solution.
# Output: e = 1e-05: Optimal [0. 0.], with a free row [0. 0.], scaled [1e-05 2e-05]

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 highspy==1.16.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import highspy
import numpy as np


def solve(e, free_row=False):
    model = highspy.HighsModel()
    model.hessian_.dim_ = 2
    start, index = np.array([0, 1, 2]), np.array([0, 1])
    model.hessian_.start_, model.hessian_.index_, model.hessian_.value_ = start, index, np.ones(2)
    lp = model.lp_
    lp.num_col_, lp.col_cost_ = 2, np.array([-e, -2 * e])
    lp.col_lower_, lp.col_upper_ = np.zeros(2), np.full(2, np.inf)
    if free_row:
        lp.num_row_, lp.row_lower_, lp.row_upper_ = 1, np.array([-np.inf]), np.array([np.inf])
        lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        lp.a_matrix_.num_row_, lp.a_matrix_.num_col_ = 1, 2
        lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = np.array([0, 1, 1]), np.array([0]), np.ones(1)
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    highs.passModel(model)
    highs.run()
    return highs.modelStatusToString(highs.getModelStatus()), np.array(highs.getSolution().col_value)


status, x = solve(1e-5)
_, free = solve(1e-5, free_row=True)
_, scaled = solve(1024e-5)
print(f"e = 1e-05: {status} {x}, with a free row {free}, scaled {np.round(scaled / 1024, 9)}")
is_same = status == "Optimal" and not x.any() and not free.any() and np.allclose(scaled, [1024e-5, 2048e-5], rtol=1e-3)
sys.exit(0 if is_same else "the behaviour has changed")
EOF
