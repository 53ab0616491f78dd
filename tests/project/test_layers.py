"""Every room imports only rooms below it (the order is the flow of a problem from scene to report)."""

import ast
import re
from pathlib import Path

import pytest

import lavender

PACKAGE = Path(lavender.__file__).resolve().parent
ROOT = Path(__file__).resolve().parent.parent.parent

#: Bottom to top; names on one line are of one level and do not import each other.
LEVELS = [
    {"_version", "_built"},
    {"errors"},
    {"_arrays", "_derived", "_lu", "apart"},
    {"cones"},
    {"generalized", "rows"},
    {"problem"},
    {"residuals", "measures", "certificates"},
    {"solution"},
    {"io", "ordering"},
    {"registry"},
    {"external", "solvers"},
    {"solve"},
    {"check", "many", "motion", "plan", "redundancy"},
    {"scene"},
    {"engine"},
    {"suite"},
    {"bench"},
    {"report"},
    {"web"},
    {"cli"},
    {"__main__"},
]
#: Imports upwards that happen inside a function, when it is first called, or for a type checker alone.
LATE = {
    ("_derived", "motion"),  # a problem keeps its reference, whose type is known above
    ("problem", "io"),  # Problem.save
    ("bench", "report"),  # Records.plot
    ("engine", "web"),  # Simulation.view shows itself in the page
    ("solution", "motion"),  # Solution.motion_error is a short way to lavender.motion_error
}
HEIGHT = {name: height for height, level in enumerate(LEVELS) for name in level}

#: The same for the rooms of lavender_ext, whose modules share inline headers by cimport.
KERNEL_LEVELS = [
    {"core"},
    {"factor", "judge"},
    {"generalized", "local", "newton", "pivot", "sweep"},
    {"accelerate", "engine"},
    {"warm"},
    {"bench", "few", "host"},
]
KERNEL_HEIGHT = {name: height for height, level in enumerate(KERNEL_LEVELS) for name in level}


def room_of(path: Path, package: Path) -> str:
    """`solvers` for lavender/solvers/pgs.py, `cones` for lavender/cones.py, `` for lavender/__init__.py."""
    first = path.relative_to(package).parts[0].removesuffix(".py")
    return "" if first == "__init__" else first


def _is_type_checking(test: ast.expr) -> bool:
    return isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"


def imports(path: Path, package: Path) -> list[tuple[int, str, bool]]:
    """Line, dotted name, and whether inside a function, of everything that a file imports from lavender."""
    found = []
    inside = ["lavender", *path.relative_to(package).parent.parts]
    tree = ast.parse(path.read_text(encoding="utf-8"))
    functions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)
    late = {id(node) for f in ast.walk(tree) if isinstance(f, functions) for node in ast.walk(f)}
    # What only a type checker reads counts as late too: nothing is imported.
    checked = [node for node in ast.walk(tree) if isinstance(node, ast.If) and _is_type_checking(node.test)]
    late |= {id(node) for branch in checked for part in branch.body for node in ast.walk(part)}
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
            found.append(f"{where}: the room {room!r} has no place in LEVELS of tests/project/test_layers.py")
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
            found.append(
                f"{where}: the room {room!r} has no place in KERNEL_LEVELS of tests/project/test_layers.py"
            )
            continue
        for name in statement.findall(path.read_text(encoding="utf-8")):
            other = name.split(".")[1] if name else ""
            if other not in KERNEL_HEIGHT:
                found.append(f"{where}: cimports lavender_ext{name}: name the room and the module")
            elif other != room and KERNEL_HEIGHT[other] >= KERNEL_HEIGHT[room]:
                found.append(f"{where}: {room} cimports lavender_ext{name}, which stands above or beside it")
    return found


def test_every_import_goes_down():
    assert breaches(PACKAGE) == []


def test_kernels_import_nothing_of_lavender():
    # Kernels and their inline headers, and the few lines of Python beside them.
    statement = re.compile(r"^\s*(from|import|cimport)\s+lavender\b(?!_)", re.MULTILINE)
    paths = [path for suffix in ("*.pyx", "*.pxd", "*.py") for path in (ROOT / "lavender_ext").rglob(suffix)]
    assert any(path.suffix == ".pyx" for path in paths)
    assert [path.name for path in paths if statement.search(path.read_text(encoding="utf-8"))] == []


def test_every_cimport_goes_down():
    assert kernel_breaches(ROOT / "lavender_ext") == []


def test_every_room_of_the_kernels_says_what_it_is():
    rooms = {path.parent.name for path in (ROOT / "lavender_ext").glob("*/*.pyx")}
    assert rooms == set(KERNEL_HEIGHT)
    text = (ROOT / "lavender_ext" / "README.md").read_text(encoding="utf-8")
    listed = dict(re.findall(r"^\| `(\w+)/` \| (.+) \|$", text, re.MULTILINE))
    heads = {
        room: ast.get_docstring(ast.parse((ROOT / "lavender_ext" / room / "__init__.py").read_text()))
        for room in rooms
    }
    assert listed == heads
    heights = [KERNEL_HEIGHT[room] for room in listed]
    assert heights == sorted(heights)


@pytest.mark.parametrize(
    ("file", "line", "sign"),
    [
        (
            "core/rows.pxd",
            "from lavender_ext.judge.measure cimport score_t",
            "core cimports lavender_ext.judge",
        ),
        (
            "judge/measure.pyx",
            "from lavender_ext.local.exact cimport (cone3,",
            "judge cimports lavender_ext.local",
        ),
        ("core/order.pyx", "import lavender_ext.sweep.serial", "core cimports lavender_ext.sweep"),
        ("core/order.pyx", "from lavender_ext cimport rows", "name the room"),
        ("attic/old.pyx", "cimport numpy", "has no place"),
    ],
)
def test_a_breach_between_kernels_is_named(tmp_path, file, line, sign):
    path = tmp_path / "lavender_ext" / file
    path.parent.mkdir(parents=True)
    path.write_text(line)
    (found,) = kernel_breaches(tmp_path / "lavender_ext")
    assert sign in found


@pytest.mark.parametrize(
    ("file", "line"),
    [
        ("judge/watch.pxd", "from lavender_ext.judge.measure cimport score_t"),
        ("warm/start.pyx", "from lavender_ext.engine.view cimport view"),
        ("core/block.pxd", "from libc.math cimport sqrt"),
    ],
)
def test_a_cimport_downwards_passes(tmp_path, file, line):
    path = tmp_path / "lavender_ext" / file
    path.parent.mkdir(parents=True)
    path.write_text(line)
    assert kernel_breaches(tmp_path / "lavender_ext") == []


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
        ("cones.py", "import lavender_ext.judge.measure"),
        ("solution.py", "def motion_error():\n    from lavender.motion import motion_error"),
    ],
)
def test_an_import_downwards_passes(tmp_path, file, line):
    path = tmp_path / "lavender" / file
    path.parent.mkdir(parents=True)
    path.write_text(line)
    assert breaches(tmp_path / "lavender") == []


def test_the_page_on_architecture_names_every_room():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rooms = {room for room in HEIGHT if not room.startswith("_")}
    named = set(re.findall(r"`(\w+)`", page[page.index("## The rooms of `lavender`") :]))
    assert rooms - named == set()
    kernels = (ROOT / "lavender_ext" / "README.md").read_text(encoding="utf-8")
    assert set(KERNEL_HEIGHT) == set(re.findall(r"^\| `(\w+)/`", kernels, re.MULTILINE))


def test_files_that_the_page_on_architecture_names_are_there():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    paths = re.findall(r"`((?:lavender|lavender_ext|tests|\.ci)/[\w./]+)`", page)
    assert len(paths) > 10
    assert [path for path in paths if "NAME" not in path and not (ROOT / path).exists()] == []
