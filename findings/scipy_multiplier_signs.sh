#!/usr/bin/env bash
# SciPy 1.17.1, the multipliers of SLSQP, trust-constr and linprog for one optimum
# Behaviour: min |x|^2/2 with x1 + x2 >= 4 and x1 <= 1 has the optimum (1, 3), the multiplier 3 of the row and 2 of the bound. SLSQP
# returns multipliers = [3] for the row and none for the bound. v of trust-constr is -3 for the row and +2 for the bound; the row
# written as -x1 - x2 <= -4 has +3. In linprog (min x1 + 2 x2, multipliers 2 and 1) both marginals are negative.
# Output: SLSQP [3.]; trust-constr [-3.] [2. 0.], as <=: [3.] [2. 0.]; linprog -2, -1

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - << 'END' 2> /dev/null
import sys

import numpy as np
from scipy.optimize import LinearConstraint, linprog, minimize

BOUNDS = [(None, 1), (None, None)]
rows = {"x1 + x2 >= 4": LinearConstraint([[1, 1]], 4, np.inf), "-x1 - x2 <= -4": LinearConstraint([[-1, -1]], -np.inf, -4)}


def solve(method, row):
    found = minimize(lambda x: x @ x / 2, np.zeros(2), jac=lambda x: x, method=method, constraints=rows[row], bounds=BOUNDS)
    assert np.allclose(found.x, (1, 3), atol=1e-3)
    return found


first, second = rows
slsqp = [solve("SLSQP", row).multipliers for row in rows]
trust = [solve("trust-constr", row).v for row in rows]
program = linprog([1, 2], A_ub=[[-1, -1]], b_ub=[-4], bounds=BOUNDS)
marginals = program.ineqlin.marginals[0], program.upper.marginals[0]
for row, multipliers, v in zip(rows, slsqp, trust):
    print(f"{row}: SLSQP {np.round(multipliers, 2)}, trust-constr {np.round(v[0], 2)} {np.round(v[1], 2)}")
print("linprog: marginals of the row and the bound {:g}, {:g}".format(*marginals))
same = all(len(multipliers) == 1 and abs(multipliers[0] - 3) < 1e-3 for multipliers in slsqp)
same = same and all(abs(v[0][0] - sign * 3) < 1e-2 and abs(v[1][0] - 2) < 1e-2 for v, sign in zip(trust, (-1, 1)))
sys.exit(0 if same and marginals == (-2.0, -1.0) else "the behaviour has changed")
END
