"""How the kernels are compiled: read by setup.py and by whoever compiles the same sources elsewhere.

A kernel gives the same bits on every CPU of an architecture: `-ffp-contract=off`, never `-march`.
Directives stand here alone, not at the head of a .pyx file, so that the debug build reaches every kernel.
"""

from typing import Any

__all__ = ["COMPILE_FLAGS", "LINK_FLAGS", "directives"]

#: Flags for gcc and clang that fix the bits (no fused multiply-add) and the meaning of a cast pointer. The first takes
#: back a -ffast-math of CFLAGS, and stands first, since clang's resets -ffp-contract too.
COMPILE_FLAGS = ["-fno-fast-math", "-ffp-contract=off", "-fno-strict-aliasing"]

#: CFLAGS reach the linker, too. For fast math, also that of -Ofast, which -O3 takes back, gcc's adds code that makes
#: the whole process, NumPy as well, round subnormal numbers to zero from the import on.
LINK_FLAGS = ["-O3", "-fno-fast-math", "-fno-unsafe-math-optimizations"]


def directives(*, debug: bool = False) -> dict[str, Any]:
    """Cython's compiler directives.

    Parameters
    ----------
    debug : bool, default False
        Check every index and every memoryview.

    Returns
    -------
    dict
        Directive to value, as `cythonize(compiler_directives=...)` takes it.
    """
    return {
        "language_level": 3,
        "boundscheck": debug,
        "wraparound": False,
        "initializedcheck": debug,
        "cdivision": True,
        "embedsignature": True,
        "auto_pickle": False,  # what is copied says itself how (lavender.problem, lavender.judge)
        "freethreading_compatible": True,
    }
