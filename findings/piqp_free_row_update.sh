#!/usr/bin/env bash
# PIQP 0.7.0, a row without bounds at setup that gets a bound by update
# Behaviour: min |x|^2/2 - x1 - 2 x2 with x1 + x2 <= h. With h infinite, setup prints that it sets the row of G to zero, and
# update(h_u=[1]) does not bring it back: both interfaces report PIQP_SOLVED at (1, 2), which breaks the row by 2. A bound on
# a variable that is infinite at setup and finite later works, and so does update with G beside h_u.
# Output: dense: h_u PIQP_SOLVED (1.0, 2.0), G and h_u PIQP_SOLVED (0.0, 1.0), x_u PIQP_SOLVED (0.5, 0.5); sparse: the same

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check piqp==0.7.0 numpy==2.4.6 scipy==1.17.1
"$folder/venv/bin/python" - << 'END'
import sys

import numpy as np
import piqp
import scipy.sparse as sp

P, q, G, free = np.eye(2), np.array([-1.0, -2.0]), np.ones((1, 2)), np.array([np.inf])
expected = True
for name, solver_type, convert in (("dense", piqp.DenseSolver, np.asfortranarray), ("sparse", piqp.SparseSolver, sp.csc_matrix)):

    def solve(setup, **change):
        solver = solver_type()
        solver.setup(convert(P), q, **setup)
        assert solver.solve() == piqp.PIQP_SOLVED and np.allclose(solver.result.x, (1, 2))  # no bound, so the free optimum
        solver.update(**change)
        return solver.solve().name, solver.result.x.round(3) + 0.0

    row = {"G": convert(G), "h_l": -free, "h_u": free}
    found = {
        "h_u": solve(row, h_u=np.array([1.0])),
        "G and h_u": solve(row, G=convert(G), h_u=np.array([1.0])),
        "x_u": solve({"x_l": np.full(2, -np.inf), "x_u": np.full(2, np.inf)}, x_u=np.full(2, 0.5)),
    }
    print(f"{name}: " + ", ".join(f"{key} {status} ({x[0]}, {x[1]})" for key, (status, x) in found.items()))
    expected &= all(status == "PIQP_SOLVED" for status, _ in found.values())
    expected &= all(np.allclose(found[key][1], x, atol=1e-3) for key, x in (("h_u", (1, 2)), ("G and h_u", (0, 1)), ("x_u", (0.5, 0.5))))
sys.exit(0 if expected else "the behaviour has changed")
END
