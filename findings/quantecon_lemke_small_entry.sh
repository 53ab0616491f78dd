#!/usr/bin/env bash
# QuantEcon 0.11.4, lcp_lemke with a small diagonal entry
# Behaviour: M = diag(1e-12, 1) is a P-matrix, so w = M z - (1, 1) >= 0, z >= 0, w.z = 0 has the one solution
# z = (1e12, 1). lcp_lemke reports success=False, status 2 (no solution found: secondary ray). With 1e-6 it solves the
# same problem.
# Output: 1e-06: success True, status 0; 1e-12: success False, status 2

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 numba requests sympy quantecon==0.11.4
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import numpy as np
from quantecon.optimize import lcp_lemke

found = {e: lcp_lemke(np.diag([e, 1.0]), -np.ones(2)) for e in (1e-6, 1e-12)}
print("; ".join(f"{e:g}: success {r.success}, status {r.status}" for e, r in found.items()))
is_same = found[1e-6].success and np.allclose(found[1e-6].z, [1e6, 1.0]) and not found[1e-12].success
sys.exit(0 if is_same else "the behaviour has changed")
EOF
