"""Build lavender.c: the kernels that the functions of lavender.h use, followed by those functions (capi/).

Only the standard library is imported, so that setup.py can run this file before anything is built.
"""

from __future__ import annotations

import re
import runpy
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
EXTRACT_C: dict[str, Any] = runpy.run_path(str(HERE.parent / "sim" / "web" / "extract_c.py"))
ExtractionError: type[Exception] = EXTRACT_C["ExtractionError"]
#: Modules of lavender_ext with functions that the library uses.
MODULES = (
    "core.assemble",
    "core.blocks",
    "core.checks",
    "core.generalized",
    "core.order",
    "core.problem",
    "judge.measure",
    "judge.stopping_test",
    "sweep.packed",
    "sweep.pgs",
    "sweep.serial",
    "local.gauss_seidel",
    "accelerate.accelerated",
    "accelerate.admm",
    "driver.driver",
    "newton.solve",
    "pivot.direct",
    "pivot.lemke",
    "pivot.principal",
    "factor.graph",
    "factor.linear",
    "factor.symbolic",
    "engine.arrays",
    "engine.substep",
    "driver.memory",
)
HEADER = HERE / "c" / "lavender.h"
FRONT = [
    HERE / "capi" / f"{name}.c"
    for name in ("front", "problem", "judge", "methods", "pivots", "solve", "full")
]


def hash_sources(root: Path) -> str:
    """Return a hash of all files from which the library is built."""
    return str(EXTRACT_C["hash_sources"](root, MODULES, [HEADER, Path(__file__), *FRONT]))


def generate_name_functions(header: str) -> str:
    """Return C code of `lav_text`, `lav_name` and `lav_outcome` from the header's enums and its comments on errors."""
    errors, methods, outcomes = re.findall(r"enum \{ /\*[^*]*\*/\n(.*?)\n\};", header, re.DOTALL)
    texts = re.findall(r"(LAV_\w+) = -?\d+,?\s*/\* (.*?) \*/", errors)
    lists = {"lav_text(int32_t code)": (texts, '"no such code"')}
    for call, body in (
        ("lav_name(int32_t method)", methods),
        ("lav_outcome(int32_t outcome)", outcomes),
    ):
        names = re.findall(r"(LAV_\w+) = ", body)
        lists[call] = ([(name, name.removeprefix("LAV_").lower()) for name in names], "NULL")
    out = []
    for call, (texts_by_name, default) in lists.items():
        cases = "".join(f'    case {name}: return "{text}";\n' for name, text in texts_by_name)
        out.append(f"\nconst char *{call} {{\n  switch ({call[:-1].split()[-1]}) {{\n{cases}")
        out.append(f"    default: return {default};\n  }}\n}}\n")
    return "".join(out)


def amalgamate(root: Path, cache: Path | None = None) -> str:
    """Return lavender.c from `root`, which contains lavender_ext; `cache` has translations of an ordinary build."""
    front = "".join(path.read_text(encoding="utf-8") for path in FRONT)
    front += generate_name_functions(HEADER.read_text(encoding="utf-8"))
    version = runpy.run_path(str(HERE.parent / "_version.py"))["__version__"]
    with tempfile.TemporaryDirectory() as work:
        kernels = EXTRACT_C["extract_c"](
            EXTRACT_C["translate_modules_to_c"](root, MODULES, Path(work), cache), front
        )
    return (
        f"/* liblavender of lavender {version}: the kernels without Python, then the functions of lavender.h.\n"
        f" * This file is generated: change the kernels instead. Sources {hash_sources(root)}\n */\n"
        f'#include "lavender.h"\n\n{kernels}'
    )
