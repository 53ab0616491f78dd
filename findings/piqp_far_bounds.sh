#!/usr/bin/env bash
# PIQP 0.7.0, one row with a near upper and a far lower bound
# Behaviour: min |x|^2/2 - x1 - 2 x2 with -b <= x1 + x2 <= 1 has the solution (0, 1) for each b > 1. A bound of 1e30 or more counts
# as absent. From b = 1e10 on, a finite bound ends with PIQP_MAX_ITER_REACHED after 250 iterations in place of 4: with
# b = 1e12 at the solution, with 1e20, which many programs write for "no bound", 0.006 beside it, with 1e29 2,117 beside it.
# Output: b = 1e+09: SOLVED after 25, error 2e-10; 1e+12: MAX_ITER_REACHED after 250, 6e-11; 1e+20: MAX_ITER_REACHED after
# 250, 0.006; 1e+29: MAX_ITER_REACHED after 250, 2e+03; 2e+30: SOLVED after 4, 3e-09

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check piqp==0.7.0 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - << 'END'
import sys

import numpy as np
import piqp


def solve(b):
    solver = piqp.DenseSolver()
    G = np.asfortranarray(np.ones((1, 2)))
    solver.setup(np.asfortranarray(np.eye(2)), np.array([-1.0, -2.0]), G=G, h_l=np.array([-b]), h_u=np.array([1.0]))
    status = solver.solve().name.removeprefix("PIQP_")
    return status, solver.result.info.iter, np.abs(solver.result.x - (0, 1)).max()


found = {b: solve(b) for b in (1e9, 1e12, 1e20, 1e29, 2e30)}
print("; ".join(f"b = {b:.0e}: {status} after {count}, error {error:.0e}" for b, (status, count, error) in found.items()))
expected = all(found[b][0] == "SOLVED" for b in (1e9, 2e30)) and all(found[b][0] == "MAX_ITER_REACHED" for b in (1e12, 1e20, 1e29))
sys.exit(0 if expected and found[1e20][2] > 1e-3 and found[1e29][2] > 100 else "the behaviour has changed")
END
