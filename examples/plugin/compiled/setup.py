"""Build of the kernel; everything else about the package is in pyproject.toml."""

import importlib.util
import sys
from pathlib import Path

from Cython.Build import cythonize
from setuptools import Extension, setup

# A fused multiply-add rounds once in place of twice, and not on every processor: without it the bits are the same.
FLAGS = ["/O2", "/fp:precise"] if sys.platform == "win32" else ["-O2", "-ffp-contract=off"]
# The folder with lavender_ext/core/*.pxd: of the installed lavender, or in the isolated build of a clone its root.
INSTALLED = getattr(importlib.util.find_spec("lavender_ext"), "submodule_search_locations", None)
CLONE = Path(__file__).resolve().parent.joinpath("..", "..", "..").resolve()
HEADERS = Path(INSTALLED[0]).parent if INSTALLED else CLONE
if not (HEADERS / "lavender_ext" / "core" / "block.pxd").exists():
    raise SystemExit(
        "lavender is not installed in the environment of this build, and this folder is not in a clone: install "
        "lavender, Cython and setuptools, then give pip --no-build-isolation"
    )

kernel = Extension("lavender_sgs_kernel", ["lavender_sgs_kernel.pyx"], extra_compile_args=FLAGS)
setup(ext_modules=cythonize(kernel, include_path=[str(HEADERS)]))
