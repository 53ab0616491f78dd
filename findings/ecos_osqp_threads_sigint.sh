#!/usr/bin/env bash
# ECOS 2.0.14, OSQP 1.1.3 and SCS 3.3.1 called by qpsolvers 4.13.0, each on four threads
# Behaviour: all three replace the C handler of SIGINT during a solve. ECOS and OSQP store the previous handler in one
# variable of the process. If two threads solve at the same time, each with its own problem, the handler of the solver
# stays installed after both have ended. signal.getsignal still returns Python's handler, but SIGINT no longer raises
# KeyboardInterrupt. After signal.signal(SIGINT, signal.getsignal(SIGINT)) it does. SCS leaves Python's handler.
# Output: ecos: raised before True, after False, again True
#         osqp: raised before True, after False, again True
#         scs: raised before True, after True, again True

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 scipy==1.17.1 qpsolvers==4.13.0 \
  ecos==2.0.14 osqp==1.1.3 scs==3.3.1
cd "$folder"
cat > program.py << 'EOF'
import signal
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import qpsolvers
import scipy.sparse as sp

warnings.simplefilter("ignore")
signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell may start this process with SIGINT ignored.
name, n = sys.argv[1], 60
rng = np.random.default_rng(0)
root = rng.normal(size=(n, n))
P, q = sp.csc_matrix(root @ root.T + np.eye(n)), rng.normal(size=n)


def solve(_):
    return qpsolvers.solve_qp(P, q, lb=np.zeros(n), ub=np.full(n, 1e3), solver=name)


def is_raised():
    try:
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.1)
    except KeyboardInterrupt:
        return True
    return False


solve(0)
found = [is_raised()]
with ThreadPoolExecutor(4) as threads:
    list(threads.map(solve, range(200)))
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
found.append(is_raised())
signal.signal(signal.SIGINT, signal.getsignal(signal.SIGINT))
found.append(is_raised())
print(f"{name}: raised before {found[0]}, after {found[1]}, again {found[2]}")
sys.exit(0 if found == [True, name == "scs", True] else "the behaviour has changed")
EOF
for name in ecos osqp scs; do venv/bin/python program.py "$name"; done
