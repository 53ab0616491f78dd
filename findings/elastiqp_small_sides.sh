#!/usr/bin/env bash
# ElastiQP 0.2.0, its three methods on one program with small numbers
# Behaviour: min |x|^2/2 - e (x1 + 2 x2) with x1 + x2 <= e has the solution (0, e). With e = 1e-7, the three methods return three
# answers with the status Solved: das (the default) and pdal the point (e, 2 e), which breaks the inequality by 2 e, and ipm a
# point 6,000 times as large as the solution. With e = 1, all three return (0, 1).
# Output: e = 1e-07, x / e: das (1.0, 2.0), pdal (1.0, 2.0), ipm (-6098.1, -6097.1), all Solved; e = 1: (0.0, 1.0) three times

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check elastiqp==0.2.0 numpy==2.4.6
"$folder/venv/bin/python" - << 'END'
import sys

import elastiqp
import numpy as np


def solve(e, method):
    Q, G = np.asfortranarray(np.eye(2)), np.asfortranarray([[1.0, 1.0]])
    return elastiqp.solve(Q, np.array([-e, -2 * e]), G, np.array([e]), 1e3, method=method)


answers = {(e, method): solve(e, method) for e in (1.0, 1e-7) for method in elastiqp.METHODS}
for (e, method), s in answers.items():
    print(f"e = {e:g}: {method} {s.status.name}, x / e = ({s.x[0] / e:.1f}, {s.x[1] / e:.1f})")
solved = all(s.status == elastiqp.Status.Solved for s in answers.values())
right = all(np.allclose(answers[1.0, m].x, [0, 1], atol=1e-6) for m in elastiqp.METHODS)
small = {m: np.asarray(answers[1e-7, m].x) / 1e-7 for m in elastiqp.METHODS}
wrong = small["das"].sum() > 2.9 and small["pdal"].sum() > 2.9 and abs(small["ipm"]).max() > 1000
sys.exit(0 if solved and right and wrong else "the behaviour has changed")
END
