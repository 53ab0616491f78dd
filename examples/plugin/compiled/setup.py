"""Build of the kernel; everything else about the package is in pyproject.toml."""

import sys
from pathlib import Path

from Cython.Build import cythonize
from setuptools import Extension, setup

# A fused multiply-add rounds once in place of twice, and not on every processor: without it the bits are the same.
FLAGS = ["/O2", "/fp:precise"] if sys.platform == "win32" else ["-O2", "-ffp-contract=off"]
# The folder with lavender_ext/core/*.pxd. In the isolated build of a clone lavender is not installed.
CLONE = str(Path(__file__).resolve().parents[3])

kernel = Extension("lavender_sgs_kernel", ["lavender_sgs_kernel.pyx"], extra_compile_args=FLAGS)
setup(ext_modules=cythonize(kernel, include_path=[CLONE]))
