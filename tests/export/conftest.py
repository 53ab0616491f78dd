"""The library written and compiled once; everything here skips, with the reason, without Cython or a compiler."""

import shutil
from importlib.util import find_spec

import pytest
from clib import Library, run

from lavender import export as export
from lavender.base.errors import LavenderError


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("library")
    try:
        export.write(out)
    except LavenderError as error:
        if find_spec("Cython") is not None:  # what it is made with is there: it must be made
            raise
        pytest.skip(str(error))
    return out


@pytest.fixture(scope="session")
def compiler():
    for name in ("gcc", "clang", "cc"):
        if shutil.which(name):
            return name
    pytest.skip("no C compiler (gcc, clang, cc)")


@pytest.fixture(scope="session")
def shared(folder, compiler):
    out = folder / "liblavender.so"
    run(
        compiler,
        "-std=c11",
        "-O0",
        "-fPIC",
        "-shared",
        "-DLAV_SHARED",
        "-fvisibility=hidden",
        "-ffp-contract=off",
        folder / "lavender.c",
        "-lm",
        "-o",
        out,
    )
    return out


@pytest.fixture(scope="session")
def library(shared):
    return Library(shared)
