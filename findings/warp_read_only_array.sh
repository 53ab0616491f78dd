#!/usr/bin/env bash
# Warp 1.19.0 and NumPy 2.4.6, wp.array(x, copy=False) of an array that NumPy has marked as read-only
# Behaviour: Warp takes the memory of x without asking whether it may be written. fill_ and kernels change x, whose writeable flag
# stays False, and so the array of which x is a read-only view. PyTorch's from_numpy warns of such an array, and NumPy raises. Without
# copy=False, Warp copies. A dtype that needs a conversion also copies, without a word, so that writes then do not reach x.
# Output: read-only float32: x becomes [3. 3. 3.], flag False; float64 read as float32 with copy=False: x stays [0. 0. 0.]

set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-compile --disable-pip-version-check warp-lang==1.19.0 numpy==2.4.6
cd "$folder"
WARP_CACHE_PATH="$folder/cache" venv/bin/python - << 'END'
import sys
import warnings

import numpy as np
import warp as wp

wp.config.quiet = True
with warnings.catch_warnings(record=True) as seen:
    warnings.simplefilter("always")
    owner = np.zeros(3, np.float32)
    view = owner.view()
    view.flags.writeable = False
    wp.array(view, dtype=float, copy=False, device="cpu").fill_(3.0)
    wide = np.zeros(3)
    wp.array(wide, dtype=float, copy=False, device="cpu").fill_(3.0)
    safe = np.zeros(3, np.float32)
    wp.array(safe, dtype=float, device="cpu").fill_(3.0)
print(f"read-only float32: {view}, flag {view.flags.writeable}, owner {owner}; warnings {len(seen)}")
print(f"float64 read as float32 with copy=False: {wide}; default: {safe}")
same = view.tolist() == owner.tolist() == [3, 3, 3] and not view.flags.writeable and not wide.any() and not safe.any()
sys.exit(0 if same and not seen else "the behaviour has changed")
END
