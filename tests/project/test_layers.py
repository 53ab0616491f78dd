"""Packages of the kernels cimport only from below; import-linter holds those of Python (pyproject.toml)."""

import ast
import re
import sys
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

ROOT = Path(__file__).resolve().parent.parent.parent
KERNELS = ROOT / "lavender_ext"
#: Packages of lavender_ext, bottom to top, whose modules share inline headers by cimport.
LEVELS = (
    {"core"},
    {"factor", "judge", "local", "program"},
    {"derivative", "io", "sweep", "velocity_newton"},
    {"newton", "pivot"},
    {"accelerate", "engine"},
    {"driver"},
    {"small"},
    {"batch"},
)
HEIGHT = {name: height for height, level in enumerate(LEVELS) for name in level}
IMPORT = re.compile(r"^\s*(?:from|c?import)\s+(lavender\w*)([.\w]*)", re.MULTILINE)


def find_breaches(package, text):
    """Return the imports of a kernel's text that go up, sideways, to Python, or to the root except `host.pxd`."""
    found = []
    for root, name in IMPORT.findall(text):
        other = name.split(".")[1] if name else ""
        is_below = other in {package, "host"} or HEIGHT.get(other, 99) < HEIGHT[package]
        if root != "lavender_ext" or not is_below:
            found.append(root + name)
    return found


def test_kernel_imports_only_packages_below_its_own():
    paths = [p for p in KERNELS.glob("*/*") if p.suffix in {".py", ".pyx", ".pxd"}]
    assert len(paths) > 100
    assert {
        str(p): x
        for p in paths
        if (x := find_breaches(p.parent.name, p.read_text(encoding="utf-8")))
    } == {}


def test_readme_of_kernels_lists_packages_in_order_and_files_that_exist():
    text = (KERNELS / "README.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| `(\w+)/` \| (.+) \|$", text, re.MULTILINE))
    texts = {name: (KERNELS / name / "__init__.py").read_text() for name in HEIGHT}
    assert listed == {name: ast.get_docstring(ast.parse(text)) for name, text in texts.items()}
    assert [HEIGHT[name] for name in listed] == sorted(HEIGHT.values())
    paths = re.findall(r"`((?:lavender|lavender_ext|tests|\.ci)/[\w./]+)`", text)
    assert [path for path in paths if "NAME" not in path and not (ROOT / path).exists()] == []


def test_contributing_lists_layers_in_the_order_of_their_contract():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "importlinter"
    ]
    (layers,) = (c["layers"] for c in settings["contracts"] if c.get("containers") == ["lavender"])
    above = layers[layers.index("cli") : layers.index("io") + 1]
    page = (ROOT / ".github" / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = page[page.index("### Layers") : page.index("### Data flow")]
    listed = re.findall(r"^\| `([\w.]+)`", table, re.MULTILINE)
    assert listed == [*(f"lavender.{layer}" for layer in above), "lavender"]
