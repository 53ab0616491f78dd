"""The examples and the sources, each loaded once for all tests."""

import ast
import functools
import importlib.util
from pathlib import Path

import lavender

ROOT = Path(__file__).resolve().parent.parent


@functools.cache
def example(name):
    """The module of an example; what its numbers() gives is computed once, whoever asks."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if hasattr(module, "numbers"):
        module.numbers = functools.cache(module.numbers)
    return module


@functools.cache
def syntax_of_package():
    """Path to syntax tree of every file of the package."""
    files = sorted(Path(lavender.__file__).parent.rglob("*.py"))
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in files}
