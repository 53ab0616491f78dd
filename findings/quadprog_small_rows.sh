#!/usr/bin/env bash
# quadprog 0.1.13 and cvx-quadprog 0.4.2, feasible programs of 6 variables and 10 inequalities whose rows are multiplied by 1e-8
# Behaviour: the factor changes neither the feasible set nor the solution. As they are, 300 drawn programs are solved. With the
# factor, both packages call 54 of them inconsistent, and 49 answers are wrong by up to 1.3 of the solution, without a
# sign of it. With 1e-6 all are right.
# Output: quadprog: 1e-06: 300 right, 0 wrong, 0 inconsistent; 1e-08: 197 right, 49 wrong, 54 inconsistent; the same for cvx-quadprog

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check quadprog==0.1.13 cvx-quadprog==0.4.2 \
  numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - << 'END'
import sys
from collections import Counter

import numpy as np
import quadprog
from cvx.quadprog import solve_qp

SOLVERS = {"quadprog": lambda *data: quadprog.solve_qp(*data)[0], "cvx-quadprog": lambda *data: solve_qp(*data).x}


def count(solve, factor):
    rng, counts = np.random.default_rng(7), Counter()
    for _ in range(300):
        L = rng.normal(size=(6, 6))
        P, q, G, h = L @ L.T + 0.1 * np.eye(6), rng.normal(size=6), rng.normal(size=(6, 10)), rng.normal(size=10) - 3
        right = quadprog.solve_qp(P, q, G, h)[0]
        assert (G.T @ right - h).min() > -1e-9  # feasible, whatever the factor
        try:
            x = solve(P, q, G * factor, h * factor)
        except ValueError:
            counts["inconsistent"] += 1
        else:
            counts["right" if np.abs(x - right).max() <= 1e-6 * np.abs(right).max() else "wrong"] += 1
    return counts


expected = True
for name, solve in SOLVERS.items():
    found = {factor: count(solve, factor) for factor in (1e-6, 1e-8)}
    text = "; ".join(f"{f:.0e}: " + ", ".join(f"{c[k]} {k}" for k in ("right", "wrong", "inconsistent")) for f, c in found.items())
    print(f"{name}: {text}")
    expected &= found[1e-6]["right"] == 300 and found[1e-8]["wrong"] > 30 and found[1e-8]["inconsistent"] > 30
sys.exit(0 if expected else "the behaviour has changed")
END
