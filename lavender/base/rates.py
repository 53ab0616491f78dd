"""Rates [ns] of counted operations, measured by `python -m benchmarks rates`, which writes `rates.json`.

Estimated costs are counts times these rates (`lavender/solvers/costs.py`). The same problem has the same cost on every
machine that has the same file.
"""

from __future__ import annotations

import json
import os
from typing import Any

# os.path is used because pathlib would take 4 % of the time of `import lavender`.
RATES_PATH = os.path.join(os.path.dirname(__file__), "rates.json")

with open(RATES_PATH, encoding="utf-8") as _file:
    RATES: dict[str, Any] = json.load(_file)
