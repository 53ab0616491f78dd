"""What builds the package: setuptools, with the WebAssembly modules made first where a source distribution is made.

A wheel made of the source distribution then holds them, wherever it is made, without a compiler for WebAssembly. A
source distribution made in isolation gets the compiler and Cython in the versions `PINNED`; without isolation those
that are there are taken. Modules that lie in the tree and are of its sources are taken as they are.
"""

import os
import runpy
from pathlib import Path

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403 - the other hooks

PINNED = ["cython==3.3.1", "ziglang==0.17.0"]
WASM = runpy.run_path("lavender/sim/web/compile.py")  # a frontend calls from the root of the project


def missing():
    """Files of modules that are not of these sources, with their parts."""
    files = ((Path("lavender", "sim", "web", f"{name}.wasm"), part) for name, part in WASM["PARTS"].items())
    return [(path, part) for path, part in files if not WASM["is_current"](path, Path(), part)]


def get_requires_for_build_sdist(config_settings=None):
    """The compiler, where a module is to be built by it."""
    more = PINNED if missing() and not os.environ.get("LAVENDER_WASM_CC") else []
    return [*build_meta.get_requires_for_build_sdist(config_settings), *more]


def build_sdist(sdist_directory, config_settings=None):
    """Build what is missing, then as setuptools does."""
    for path, part in missing():
        reason = WASM["why_not"]()
        if reason:
            raise SystemExit(
                f"a source distribution holds {path}, which is not there, or of other sources: {reason}"
            )
        WASM["build"](path, Path().resolve(), part.modules, beside=part.beside)
    return build_meta.build_sdist(sdist_directory, config_settings)
