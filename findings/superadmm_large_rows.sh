#!/usr/bin/env bash
# superADMM 0.7.2, one row and its bound multiplied by a number, as by other units
# Behaviour: min |x|^2/2 - x1 - 2 x2 with f (x1 + x2) <= f has the solution (0, 1) for each f > 0. With f = 1,000 it is found within
# 6 iterations. With f = 1e4 the status is 2, "solved inaccurate" (the requested tolerance cannot be achieved), after 26
# iterations at (-0.33, 0.67), away from the row, whose slack is 0.66; with 1e6 it is (-0.50, 0.50).
# Output: f = 1e+03: 1 solved, (0.00, 1.00); 1e+04: 2 solved inaccurate, (-0.33, 0.67); 1e+06: 2 solved inaccurate, (-0.50, 0.50)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check superADMM==0.7.2 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - << 'END'
import sys

import numpy as np
from superADMM import getOptimOpts, superADMM

options = {**getOptimOpts(), "verbose": 0}


def solve(f):
    q, A, low, high = np.array([-1.0, -2.0]), np.full((1, 2), f), np.array([-np.inf]), np.array([f])
    x, _, flag, info = superADMM(np.eye(2), q, A, low, high, options=options)
    return flag, info["status"].decode(), np.ravel(x) + 0.0


found = {f: solve(f) for f in (1e3, 1e4, 1e6)}
print("; ".join(f"f = {f:.0e}: {flag} {text}, ({x[0]:.2f}, {x[1]:.2f})" for f, (flag, text, x) in found.items()))
expected = found[1e3][0] == 1 and np.allclose(found[1e3][2], (0, 1), atol=1e-6)
expected &= all(found[f][0] == 2 and np.abs(found[f][2] - (0, 1)).max() > 0.2 for f in (1e4, 1e6))
sys.exit(0 if expected else "the behaviour has changed")
END
