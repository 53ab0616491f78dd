#!/usr/bin/env bash
# qpth 0.0.18 with PyTorch 2.13.0, an infeasible program in a batch
# Behaviour: min |x|^2/2 - x1 - 2 x2 with x1 <= -1 and x1 >= 1 has no solution. QPFunction returns a finite point for
# it, without an exception, a warning or a status: alone, and as the second of three programs of a batch, whose other
# two are solved.
# Output: batch: (1, 2), (0.0119, 2), (1, 2)

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==1.26.4 torch==2.13.0 qpth==0.0.18
cd "$folder"
venv/bin/python - << 'EOF'
import sys
import warnings

import torch
from qpth.qp import QPFunction

warnings.simplefilter("error")
kind = torch.float64
G, none = torch.tensor([[1.0, 0.0], [-1.0, 0.0]], dtype=kind), torch.empty(0, dtype=kind)
sides = torch.tensor([[5.0, 5.0], [-1.0, -1.0], [5.0, 5.0]], dtype=kind)
costs = torch.tensor([[-1.0, -2.0]] * 3, dtype=kind)
x = QPFunction()(torch.eye(2, dtype=kind), costs, G, sides, none, none)
print("batch: " + ", ".join(f"({a:.3g}, {b:.3g})" for a, b in x.tolist()))
is_right = torch.allclose(x[[0, 2]], -costs[[0, 2]], atol=1e-6)
sys.exit(0 if is_right and bool(torch.isfinite(x[1]).all()) else "the behaviour has changed")
EOF
