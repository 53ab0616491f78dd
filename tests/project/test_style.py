"""Habits of this package that no linter knows."""

import ast
from pathlib import Path

import lavender

PACKAGE = Path(lavender.__file__).resolve().parent
MOST = 5  # fields that a reader can tell apart by their places
ROOMS = sorted(PACKAGE.rglob("*.py"))


def classes_with_fields():
    """Names of the package's dataclasses and named tuples."""
    names = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and (
                any("dataclass" in ast.unparse(d) for d in node.decorator_list)
                or any("NamedTuple" in ast.unparse(b) for b in node.bases)
            ):
                names.add(node.name)
    return names


def long_calls(source, names):
    """Line and name of every construction of more than MOST fields by place."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and len(node.args) > MOST:
            name = ast.unparse(node.func).rpartition(".")[2]
            if name in names and not ast.unparse(node.func).startswith("qpsolvers."):
                yield node.lineno, name


def test_no_object_of_many_fields_is_made_by_place():
    names = classes_with_fields()
    assert {"Solution", "QP", "Cones", "Record"} <= names
    found = [
        f"{path.relative_to(PACKAGE)}:{line}: {name}"
        for path in ROOMS
        for line, name in long_calls(path.read_text(encoding="utf-8"), names)
    ]
    assert found == [], f"name the fields in:\n{chr(10).join(found)}"


def test_a_long_call_is_seen():
    source = "a = Solution(1, 2, 3, 4, 5, 6)\nb = m.Solution(1, 2, 3, 4, 5)\nc = other(1, 2, 3, 4, 5, 6)"
    assert list(long_calls(source, {"Solution"})) == [(1, "Solution")]
