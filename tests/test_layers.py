"""Every room imports only rooms below it (the order is the flow of a problem from scene to report)."""

import ast
import re
from pathlib import Path

import pytest

import lavender

PACKAGE = Path(lavender.__file__).resolve().parent
ROOT = Path(__file__).resolve().parent.parent

#: Bottom to top; names on one line are of one level and do not import each other.
LEVELS = [
    {"_version", "_built"},
    {"errors"},
    {"_arrays"},
    {"cones"},
    {"rows"},
    {"problem"},
    {"residuals"},
    {"solution"},
    {"io", "ordering"},
    {"registry"},
    {"external"},
    {"solvers"},  # its table lists the external ones too
    {"solve"},
    {"check", "redundancy"},
    {"scene"},
    {"engine"},
    {"suite"},
    {"bench"},
    {"report"},
    {"web"},
    {"cli"},
    {"__main__"},
]
#: Imports upwards that happen inside a function, when it is first called.
LATE = {("registry", "solvers")}  # the registry reads the table of built-in solvers when it is first asked
HEIGHT = {name: height for height, level in enumerate(LEVELS) for name in level}


def room_of(path: Path, package: Path) -> str:
    """`solvers` for lavender/solvers/pgs.py, `cones` for lavender/cones.py, `` for lavender/__init__.py."""
    first = path.relative_to(package).parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


def imports(path: Path, package: Path) -> list[tuple[int, str, bool]]:
    """Line, dotted name, and whether inside a function, of everything that a file imports from lavender."""
    found = []
    inside = ["lavender", *path.relative_to(package).parent.parts]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    late = {id(node) for f in ast.walk(tree) if isinstance(f, functions) for node in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name, id(node) in late) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = inside[: len(inside) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # In `from lavender import x` each x may be a module.
            names = [f"lavender.{alias.name}" for alias in node.names] if module == "lavender" else [module]
            found += [(node.lineno, name, id(node) in late) for name in names]
    return [entry for entry in found if entry[1] == "lavender" or entry[1].startswith("lavender.")]


def breaches(package: Path) -> list[str]:
    """Every import that goes up, sideways within a level, or round by `import lavender`."""
    found = []
    for path in sorted(package.rglob("*.py")):
        room = room_of(path, package)
        where = path.relative_to(package.parent).as_posix()
        if room == "":
            continue  # lavender/__init__.py holds the public names: it may import every room
        if room not in HEIGHT:
            found.append(f"{where}: the room {room!r} has no place in LEVELS of tests/test_layers.py")
            continue
        for line, name, late in imports(path, package):
            other = name.split(".")[1] if "." in name else ""
            if other == room or (late and (room, other) in LATE):
                continue
            if other not in HEIGHT:
                found.append(f"{where}:{line}: imports {name}: name the module it comes from")
            elif HEIGHT[other] >= HEIGHT[room]:
                found.append(f"{where}:{line}: {room} imports {name}, which stands above or beside it")
    return found


def test_every_import_goes_down():
    assert breaches(PACKAGE) == []


def test_kernels_import_nothing_of_lavender():
    # Kernels and their inline headers, and the few lines of Python beside them.
    statement = re.compile(r"^\s*(from|import|cimport)\s+lavender\b(?!_)", re.MULTILINE)
    paths = [path for suffix in ("*.pyx", "*.pxd", "*.py") for path in (ROOT / "lavender_ext").glob(suffix)]
    assert any(path.suffix == ".pyx" for path in paths)
    assert [path.name for path in paths if statement.search(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    ("file", "line", "sign"),
    [
        ("cones.py", "from lavender.problem import Problem", "cones imports lavender.problem"),
        ("cones.py", "from .problem import Problem", "cones imports lavender.problem"),
        ("solvers/pgs.py", "from ..report import tables", "solvers imports lavender.report"),
        ("external/qp.py", "from lavender.solvers.pgs import f", "external imports lavender.solvers"),
        ("problem.py", "def f():\n    import lavender.solve", "problem imports lavender.solve"),
        ("registry.py", "from lavender.solvers import SPECS", "registry imports lavender.solvers"),
        ("engine/step.py", "import lavender as lv", "name the module"),
        ("engine/step.py", "from lavender import Problem", "name the module"),
        ("attic.py", "import os", "has no place"),
    ],
)
def test_a_breach_is_named(tmp_path, file, line, sign):
    path = tmp_path / "lavender" / file
    path.parent.mkdir(parents=True)
    path.write_text(line)
    assert len(breaches(tmp_path / "lavender")) == 1
    assert sign in breaches(tmp_path / "lavender")[0]


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("problem.py", "from lavender import cones"),
        (
            "solvers/pgs.py",
            "from .jacobi import f\nfrom lavender.solvers import gauss\nfrom ..problem import Problem",
        ),
        ("cli.py", "from lavender import bench, report"),
        ("__init__.py", "from lavender.solve import solve"),
        ("cones.py", "import lavender_ext.judge"),
        ("registry.py", "def specs():\n    from lavender.solvers import SPECS"),
    ],
)
def test_an_import_downwards_passes(tmp_path, file, line):
    path = tmp_path / "lavender" / file
    path.parent.mkdir(parents=True)
    path.write_text(line)
    assert breaches(tmp_path / "lavender") == []
