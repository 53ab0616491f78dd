"""Rooms of the kernels cimport only from below; those of Python are held by import-linter (pyproject.toml)."""

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

#: Bottom to top, the rooms of lavender_ext, whose modules share inline headers by cimport.
KERNEL_LEVELS = [
    {"core"},
    {"factor", "judge", "local"},
    {"derivative", "io", "sweep", "velocity_newton"},
    {"newton", "pivot"},
    {"accelerate", "engine"},
    {"driver", "host"},
    {"small"},
    {"batch"},
]
KERNEL_HEIGHT = {name: height for height, level in enumerate(KERNEL_LEVELS) for name in level}


def kernel_breaches(package: Path) -> list[str]:
    """Every cimport or import within lavender_ext that goes up, or sideways within a level."""
    found = []
    statement = re.compile(r"^\s*(?:from|c?import)\s+lavender_ext([.\w]*)", re.MULTILINE)
    for path in sorted(package.rglob("*.p*")):
        inside = path.relative_to(package).parts[:-1]
        if path.suffix not in {".py", ".pyx", ".pxd"} or not inside:
            continue  # what lies beside the rooms describes the package and its build
        room, where = inside[0], path.relative_to(package.parent).as_posix()
        if room not in KERNEL_HEIGHT:
            found.append(f"{where}: the room {room!r} has no place in KERNEL_LEVELS of tests/project/test_layers.py")
            continue
        for name in statement.findall(path.read_text(encoding="utf-8")):
            other = name.split(".")[1] if name else ""
            if other not in KERNEL_HEIGHT:
                found.append(f"{where}: cimports lavender_ext{name}: name the room and the module")
            elif other != room and KERNEL_HEIGHT[other] >= KERNEL_HEIGHT[room]:
                found.append(f"{where}: {room} cimports lavender_ext{name}, which stands above or beside it")
    return found


def test_kernels_import_nothing_of_lavender():
    # Kernels and their inline headers, and the few lines of Python beside them.
    statement = re.compile(r"^\s*(from|import|cimport)\s+lavender\b(?!_)", re.MULTILINE)
    paths = [path for suffix in ("*.pyx", "*.pxd", "*.py") for path in (ROOT / "lavender_ext").rglob(suffix)]
    assert any(path.suffix == ".pyx" for path in paths)
    assert [path.name for path in paths if statement.search(path.read_text(encoding="utf-8"))] == []


def test_every_cimport_goes_down():
    assert kernel_breaches(ROOT / "lavender_ext") == []


def test_every_room_of_the_kernels_says_what_it_is():
    rooms = {path.parent.name for path in (ROOT / "lavender_ext").glob("*/__init__.py")}
    assert rooms == set(KERNEL_HEIGHT)
    text = (ROOT / "lavender_ext" / "README.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| `(\w+)/` \| (.+) \|$", text, re.MULTILINE))
    heads = {
        room: ast.get_docstring(ast.parse((ROOT / "lavender_ext" / room / "__init__.py").read_text())) for room in rooms
    }
    assert listed == heads
    heights = [KERNEL_HEIGHT[room] for room in listed]
    assert heights == sorted(heights)


@pytest.mark.parametrize(
    ("file", "line", "sign"),
    [
        ("core/rows.pxd", "from lavender_ext.judge.measure cimport score_t", "core cimports lavender_ext.judge"),
        ("judge/measure.pyx", "from lavender_ext.local.cone cimport (eliminate,", "judge cimports lavender_ext.local"),
        ("core/order.pyx", "import lavender_ext.sweep.serial", "core cimports lavender_ext.sweep"),
        ("core/order.pyx", "from lavender_ext cimport rows", "name the room"),
        ("attic/old.pyx", "cimport numpy", "has no place"),
    ],
)  # fmt: skip
def test_a_breach_between_kernels_is_named(tmp_path, file, line, sign):
    path = tmp_path / "lavender_ext" / file
    path.parent.mkdir(parents=True)
    path.write_text(line)
    (found,) = kernel_breaches(tmp_path / "lavender_ext")
    assert sign in found


def test_architecture_layers_are_listed_in_the_order_of_their_contract():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    (layers,) = (c["layers"] for c in settings["contracts"] if c.get("containers") == ["lavender"])
    above = layers[layers.index("cli") : layers.index("io") + 1]
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = page[page.index("## Layers") : page.index("## Data flow")]
    listed = re.findall(r"^\| `([\w.]+)`", table, re.MULTILINE)
    assert listed == [*(f"lavender.{layer}" for layer in above), "lavender"]


def test_readme_of_kernels_names_files_that_exist():
    page = (ROOT / "lavender_ext" / "README.md").read_text(encoding="utf-8")
    paths = re.findall(r"`((?:lavender|lavender_ext|tests|\.ci)/[\w./]+)`", page)
    assert len(paths) > 10
    assert [path for path in paths if "NAME" not in path and not (ROOT / path).exists()] == []
