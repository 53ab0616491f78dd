"""The examples run, and the relations that they show hold."""

import importlib.util
from pathlib import Path

FOLDER = Path(__file__).resolve().parent.parent.parent / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
