"""Habits of this package that no linter knows."""

import ast

from worked import syntax_of_package

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


def long_calls(tree, names):
    """Line and name of every construction of more than MOST fields by place."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and len(node.args) > MOST:
            name = ast.unparse(node.func).rpartition(".")[2]
            if name in names and not ast.unparse(node.func).startswith("qpsolvers."):
                yield node.lineno, name


def test_no_object_of_many_fields_is_made_by_place():
    names = classes_with_fields()
    assert {"Solution", "QP", "Cones", "Record"} <= names
    found = [
        f"{path}:{line}: {name}"
        for path, tree in syntax_of_package().items()
        for line, name in long_calls(tree, names)
    ]
    assert found == [], f"name the fields in:\n{chr(10).join(found)}"


def test_a_long_call_is_seen():
    source = "a = Solution(1, 2, 3, 4, 5, 6)\nb = m.Solution(1, 2, 3, 4, 5)\nc = other(1, 2, 3, 4, 5, 6)"
    assert list(long_calls(ast.parse(source), {"Solution"})) == [(1, "Solution")]
