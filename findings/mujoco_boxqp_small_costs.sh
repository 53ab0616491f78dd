#!/usr/bin/env bash
# MuJoCo 4.0.0, mju_boxQP with small costs
# Behaviour: the solver stops at an absolute size of the gradient. 100 drawn programs of five variables within [-1, 1]
# are solved as they are, and with H and g multiplied by 1e-8, which does not change the solution. With the small
# costs, the function returns success, and 17 solutions are wrong by more than 1 % of the box.
# Output: success for 100 of 100, wrong 17 of 100

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 mujoco==4.0.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import mujoco
import numpy as np

rng, n, successes, wrong = np.random.default_rng(0), 5, 0, 0
for _ in range(100):
    root = rng.normal(size=(n, n))
    H, g = root @ root.T + np.eye(n), rng.normal(size=n)
    solutions = []
    for scale in (1.0, 1e-8):
        x, factor, index = np.zeros(n), np.zeros(n * (n + 7)), np.zeros(n, np.int32)
        rank = mujoco.mju_boxQP(x, factor, index, scale * H, scale * g, -np.ones(n), np.ones(n))
        solutions.append(x)
    successes += rank >= 0  # -1 is a failure.
    wrong += np.abs(solutions[1] - solutions[0]).max() > 0.01
print(f"success for {successes} of 100, wrong {wrong} of 100")
sys.exit(0 if successes == 100 and wrong > 5 else "the behaviour has changed")
EOF
