#!/usr/bin/env bash
# primalsolver 0.1.3, the triangle of a quadratic objective, and an objective that is not convex
# Behaviour: the documentation of Model.qobj asks for the upper triangle. An entry (0, 1) raises SolverError (1001), an entry (1, 0)
# is taken and counts twice. A saddle and a concave objective in a box are not refused: both are reported as
# optimal (solsta 1), here at their global minima (0, 2) and (2, 2).
# Output: upper: SolverError; lower: x = (0.333, 0.333); saddle: solsta 1, (0, 2); concave: solsta 1, (2, 2)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check primalsolver==0.1.3
cd "$folder"
venv/bin/python - << 'END'
import sys

from primalsolver import BK, Model, SolverError


def solve(entries, costs, low=-1.0, high=2.0):
    with Model(maxcon=2, maxvar=2) as model:
        model.obj([0, 1], costs)
        for i, j, value in entries:
            model.qobj_ij(i, j, value)
        for i in (0, 1):
            model.var_bounds(i, BK.RA, low, high)
        found = model.solve()
        return [round(x, 3) + 0.0 for x in found.x], found.solsta


try:
    solve([(0, 0, 2.0), (0, 1, 1.0), (1, 1, 2.0)], [-1.0, -1.0])
    refused = False
except SolverError as error:
    refused = True
    print("upper:", error)
found = {
    "lower": solve([(0, 0, 2.0), (1, 0, 1.0), (1, 1, 2.0)], [-1.0, -1.0]),
    "saddle": solve([(0, 0, 1.0), (1, 1, -1.0)], [0.0, 0.0]),
    "concave": solve([(0, 0, -1.0), (1, 1, -1.0)], [0.1, 0.2]),
}
for name, (x, status) in found.items():
    print(f"{name}: solsta {status}, x = {x}")
expected = {"lower": ([0.333, 0.333], 1), "saddle": ([0.0, 2.0], 1), "concave": ([2.0, 2.0], 1)}
sys.exit(0 if refused and found == expected else "the behaviour has changed")
END
