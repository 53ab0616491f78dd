"""lavender.c: the kernels that the functions of lavender.h use, then those functions (front/).

Only the standard library is imported, so that setup.py can run this before anything is built.
"""

from __future__ import annotations

import runpy
import tempfile
from pathlib import Path
from typing import Any

__all__ = ["FRONT", "MODULES", "CutFailed", "amalgamate", "source_hash"]

HERE = Path(__file__).resolve().parent
CUT: dict[str, Any] = runpy.run_path(str(HERE.parent / "web" / "cut.py"))
CutFailed: type[Exception] = CUT["CutFailed"]
#: Modules of lavender_ext that the library reaches into.
MODULES = (
    "core.assemble",
    "core.generalized",
    "core.order",
    "core.problem",
    "judge.measure",
    "judge.watch",
    "sweep.serial",
    "local.gauss_seidel",
    "accelerate.accelerated",
    "accelerate.admm",
    "driver.driver",
    "pivot.principal",
    "pivot.tableau",
    "factor.graph",
    "factor.sparse",
    "engine.arrays",
    "engine.substep",
    "host.memory",
)
FRONT = [
    HERE / "front" / f"{name}.c"
    for name in ("front", "problem", "judge", "solve", "methods", "pivots", "full")
]


def source_hash(root: Path) -> str:
    """Hash of everything that the library is made of."""
    return str(CUT["source_hash"](root, MODULES, FRONT))


def amalgamate(root: Path, made: Path | None = None) -> str:
    """lavender.c, from the sources of lavender_ext below `root`; `made`: translations of an ordinary build.

    Raises
    ------
    CutFailed
        The kernels cannot be translated, or need Python.
    """
    front = "".join(path.read_text(encoding="utf-8") for path in FRONT)
    version = runpy.run_path(str(HERE.parent / "_version.py"))["__version__"]
    with tempfile.TemporaryDirectory() as work:
        kernels = CUT["cut"](CUT["translate"](root, MODULES, Path(work), made), front)
    return (
        f"/* liblavender of lavender {version}: the kernels without Python, then the functions of lavender.h.\n"
        f" * Made, not written: changes belong into the kernels. Sources {source_hash(root)}\n */\n"
        f'#include "lavender.h"\n\n{kernels}'
    )
