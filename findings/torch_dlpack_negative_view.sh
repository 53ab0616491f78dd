#!/usr/bin/env bash
# PyTorch 2.13.0 and NumPy 2.4.6, DLPack of a view with the negative bit
# Behaviour: the imaginary part of a conjugated tensor is a view of the same memory with the negative bit. numpy()
# refuses such a view with a RuntimeError. numpy.from_dlpack reads it without an error, and with the wrong sign. A
# conjugated tensor itself is refused by both.
# Output: tensor [-2.0, 4.0], numpy.from_dlpack [2.0, -4.0], after resolve_neg [-2.0, 4.0]

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check numpy==2.4.6 torch==2.13.0
cd "$folder"
venv/bin/python - << 'EOF'
import sys

import numpy as np
import torch

view = torch.tensor([1.0 + 2.0j, 3.0 - 4.0j]).conj().imag
read, right = np.from_dlpack(view).tolist(), np.from_dlpack(view.resolve_neg()).tolist()
try:
    view.numpy()
    is_refused = False
except RuntimeError:
    is_refused = True
print(f"tensor {view.tolist()}, numpy.from_dlpack {read}, after resolve_neg {right}")
sys.exit(0 if is_refused and read == [2.0, -4.0] and right == view.tolist() else "the behaviour has changed")
EOF
