#!/usr/bin/env bash
# jaxopt 0.8.5 (jax 0.10.2), quadratic programs over a box whose matrix has a zero on its diagonal
# Behaviour: BoxCDQP leaves an unknown without curvature at its start, whatever its cost is, and reports an error of 0 after two
# iterations. For x1 of cost -1 in [0, 1] the minimum is at 1, the answer is 0; with the box [0, inf) the program has no
# minimum, and the answer and the error are the same. A start of 0.25 stays 0.25.
# Output: box [0, 1], start 0: x = (1, 0), error 0, cost -0.5 for -1.5; box [0, inf), start 0: x = (1, 0), error 0;
# box [0, 1], start 0.25: x = (1, 0.25), error 0

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 jax==0.10.2 jaxlib==0.10.2 \
    jaxopt==0.8.5
cd "$folder"
JAX_PLATFORMS=cpu venv/bin/python - << 'EOF'
import sys
import warnings

warnings.simplefilter("ignore")
import jax

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
from jaxopt import BoxCDQP

Q, c = jnp.diag(jnp.array([1.0, 0.0])), jnp.array([-1.0, -1.0])
same = True
for upper, start in ((1.0, 0.0), (jnp.inf, 0.0), (1.0, 0.25)):
    box = jnp.zeros(2), jnp.array([1.0, upper])
    x, state = BoxCDQP(maxiter=1000, tol=1e-10).run(jnp.full(2, start), params_obj=(Q, c), params_ineq=box)
    cost = float(x @ Q @ x / 2 + c @ x)
    print(f"box [0, {upper}], start {start}: x = ({x[0]:g}, {x[1]:g}), error {state.error:g}, cost {cost:g}")
    same = same and float(x[1]) == start and float(state.error) == 0.0
sys.exit(0 if same else "the behaviour has changed")
EOF
