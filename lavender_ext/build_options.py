"""Compiler options of the kernels: used by setup.py and by other builds of the same sources.

A kernel computes the same bits on every CPU of an architecture: `-ffp-contract=off`, never `-march`.
Directives are set only here, not at the top of a .pyx file, so that the debug build applies to every kernel.
"""

from typing import Any

__all__ = ["COMPILE_FLAGS", "LINK_FLAGS", "directives"]

#: Flags for gcc and clang that make the bits reproducible (no fused multiply-add) and allow pointer casts. The first
#: cancels a -ffast-math in CFLAGS; it precedes the others because it also resets -ffp-contract in clang.
COMPILE_FLAGS = ["-fno-fast-math", "-ffp-contract=off", "-fno-strict-aliasing"]

#: CFLAGS also reach the linker. With fast math (also from -Ofast, which -O3 cancels) gcc links start-up code that
#: flushes subnormal numbers to zero in the whole process, NumPy included, from the import on.
LINK_FLAGS = ["-O3", "-fno-fast-math", "-fno-unsafe-math-optimizations"]


def directives(*, debug: bool = False) -> dict[str, Any]:
    """Return Cython's compiler directives.

    Parameters
    ----------
    debug : bool, default False
        Check every index and every memoryview.

    Returns
    -------
    dict
        {directive: value}, for `cythonize(compiler_directives=...)`.
    """
    return {
        "language_level": 3,
        "boundscheck": debug,
        "wraparound": False,
        "initializedcheck": debug,
        "cdivision": True,
        "embedsignature": True,
        "emit_code_comments": False,  # C code is a third shorter without the Cython lines as comments.
        "auto_pickle": False,  # Classes of lavender.problem and lavender.judge define their own pickling.
        "freethreading_compatible": True,
    }
