"""Habits of this package that no linter knows."""

import ast
import re
from pathlib import Path

from worked import syntax_of_package

import lavender as lv

MOST = 5  # fields that a reader can tell apart by their places


def classes_with_fields():
    """Names of the package's dataclasses and named tuples."""
    names = set()
    for tree in syntax_of_package().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and (
                any("dataclass" in ast.unparse(d) for d in node.decorator_list)
                or any("NamedTuple" in ast.unparse(b) for b in node.bases)
            ):
                names.add(node.name)
    return names


def called(node):
    """The last word of what a call calls."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def long_calls(tree, names):
    """Line and name of every construction of more than MOST fields by place."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and len(node.args) > MOST:
            name = called(node)
            if name in names and not ast.unparse(node.func).startswith("qpsolvers."):
                yield node.lineno, name


def test_no_object_of_many_fields_is_made_by_place():
    names = classes_with_fields()
    assert {"Solution", "Cones"} <= names
    found = [
        f"{path}:{line}: {name}" for path, tree in syntax_of_package().items() for line, name in long_calls(tree, names)
    ]
    assert found == [], f"name the fields in:\n{chr(10).join(found)}"


def test_a_long_call_is_seen():
    source = "a = Solution(1, 2, 3, 4, 5, 6)\nb = m.Solution(1, 2, 3, 4, 5)\nc = other(1, 2, 3, 4, 5, 6)"
    assert list(long_calls(ast.parse(source), {"Solution"})) == [(1, "Solution")]


#: Documented in spite of their underscore: named tuples, ctypes, IPython, sys and os.
DOCUMENTED = {"_asdict", "_replace", "_fields_", "_repr_html_", "_current_frames", "_exit"}
#: Attributes of other engines that the importers read, which tests of the importers imitate.
DOCUMENTED |= {"_solver_kamino", "_contacts_kamino", "_jacobians", "_model", "_config", "_options", "_initialized"}
PRIVATE = re.compile(r"_[a-zA-Z]\w*")
TAKEN = re.compile(r"(\b(import|from)\b.*|[.'\"])\b_[a-zA-Z]")


def private_names(tree):
    """Line and text of every private module, name or attribute that is taken from elsewhere."""
    for node in ast.walk(tree):
        taken = []
        if isinstance(node, ast.ImportFrom):
            taken = [*(node.module or "").split("."), *(name.name for name in node.names)]
            taken = taken if taken[0] in ("lavender", "lavender_ext", "benchmarks") else []
        elif isinstance(node, ast.Import):
            taken = [part for name in node.names for part in name.name.split(".")[1:]]
        elif isinstance(node, ast.Attribute):
            own = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
            taken = [] if own else [node.attr]
        elif isinstance(node, ast.Call) and called(node) in ("setattr", "getattr"):
            words = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            taken = [part for word in words[:1] for part in word.split(".")]
        if any(PRIVATE.fullmatch(part) and part not in DOCUMENTED for part in taken):
            yield node.lineno, ".".join(taken)


def test_tests_take_public_names_only():
    """A layout that tests have taken hold of cannot change: what needs a test is its room's public name."""
    tests = Path(__file__).resolve().parent.parent
    texts = {path.relative_to(tests): path.read_text(encoding="utf-8") for path in sorted(tests.rglob("*.py"))}
    found = [
        f"{path}:{line}: {name}"
        for path, text in texts.items()
        if TAKEN.search(text)  # else no tree is needed
        for line, name in private_names(ast.parse(text))
    ]
    assert found == [], f"take a public way, or make public:\n{chr(10).join(found)}"


def test_no_test_imports_a_conftest():
    """There are several, and which one Python finds first is a matter of the folders that pytest is given."""
    tests = Path(__file__).resolve().parent.parent
    texts = {path: path.read_text(encoding="utf-8") for path in tests.rglob("*.py")}
    found = [path.name for path, text in texts.items() if re.search(r"^\s*(from|import) conftest\b", text, re.M)]
    assert found == []


def test_a_private_name_is_seen():
    source = """
from lavender.solvers._plan import plan
from lavender.solving.solve import _claim
import lavender._plan
problem._state, self._state, numpy.float64, named._replace
monkeypatch.setattr(registry, "_registered", {})
monkeypatch.setattr("lavender.solving.solve._claim", None)
import _thread
"""
    assert [line for line, _ in private_names(ast.parse(source))] == [2, 3, 4, 6, 7, 5]


def test_dir_holds_the_public_names_alone():
    assert dir(lv) == sorted(lv.__all__)
    assert not {"Any", "TYPE_CHECKING", "import_module"} & set(dir(lv))
    for name in dir(lv):
        getattr(lv, name)
