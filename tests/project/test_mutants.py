"""`.ci/mutants`: every fault of tests/mutants applies to the present sources and states its effect in a sentence."""

import ast
import importlib.machinery
import importlib.util
import sys

import pytest
from worked import ROOT


def load_command():
    """Import `.ci/mutants`, which has no suffix."""
    sys.path.insert(0, str(ROOT / ".ci"))  # for the module that it imports
    loader = importlib.machinery.SourceFileLoader("mutants", str(ROOT / ".ci" / "mutants"))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("mutants", loader))
    sys.modules["mutants"] = module  # NamedTuple looks its module up
    loader.exec_module(module)
    return module


mutants = load_command()
from fault_draw import OPERATORS, list_places  # noqa: E402 (found by the line above)

FAULTS = mutants.list_faults([])


def test_every_fault_applies_once_changes_its_file_and_has_a_sentence():
    problems = []
    for fault in FAULTS:
        try:
            text = (ROOT / fault.path).read_text()
            if mutants.apply_fault(fault, text) == text:
                problems.append(f"{fault.name} changes nothing")
        except (OSError, ValueError) as error:
            problems.append(str(error))
        if not (fault.sentence.endswith(".") and fault.sentence[0].isupper() and len(fault.sentence.split()) > 4):
            problems.append(f"{fault.name}: its first line is {fault.sentence!r}; a sentence on its effect is needed")
    assert not problems, "\n".join(problems)


def test_faults_cover_every_package_and_their_tests_exist():
    assert {fault.package for fault in FAULTS} <= mutants.NEAR.keys()
    assert sum(fault.is_kernel for fault in FAULTS) > len(FAULTS) / 3
    for words in mutants.NEAR.values():
        assert [word for word in words.split() if not (ROOT / "tests" / word).exists()] == []


def test_recorded_results_are_of_faults_and_name_a_test_file_that_exists():
    results = mutants.read_results()
    assert results.keys() <= {fault.name for fault in FAULTS}
    files = {test.split("::")[0] for test in results.values() if test.startswith("tests/")}
    assert [name for name in sorted(files) if not (ROOT / name).is_file()] == []


def test_record_result_replaces_the_line_of_its_fault_and_drops_faults_that_were_deleted(tmp_path, monkeypatch):
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.patch").touch()
    monkeypatch.setattr(mutants, "FAULTS", tmp_path)
    monkeypatch.setattr(mutants, "RESULTS", tmp_path / "results.txt")
    mutants.RESULTS.write_text("b: survives\nc: tests/x.py::test[1: 2]\nz: survives\n")
    mutants.record_result("b", "tests/y.py::test")
    mutants.record_result("a", "")
    assert mutants.read_results() == {"a": "survives", "b": "tests/y.py::test", "c": "tests/x.py::test[1: 2]"}


def test_apply_fault_finds_indented_lines_after_its_anchor_and_rejects_repeated_ones():
    fault = mutants.Fault("name", "A sentence.", "path", "def second", [" a = 1", "-b = a", "+b = -a", "+c = b"])
    text = (
        "def first():\n    a = 1\n    b = a\n\ndef second():\n    if x:\n        a = 1\n        b = a\n    return b\n"
    )
    expected = text.replace("        b = a\n", "        b = -a\n        c = b\n")
    assert mutants.apply_fault(fault, text) == expected
    for changed in (text.replace("b = a\n", "b = 2 * a\n"), text + "a = 1\nb = a\n"):
        with pytest.raises(ValueError, match=r"does not apply: its lines occur [02] times"):
            mutants.apply_fault(fault, changed)


KERNEL = """from libc.math cimport fabs

cdef inline double f(double x, int n) noexcept nogil:
    cdef int i
    if x > 0.0:                 # a condition
        x += 1.0
    for i in range(n):
        x = fabs(x,
                 1.0) + n
    return x
"""


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (["-if x > 0.0:                 # a condition", "+if x > 1.0:"], ["if ((x > 1.0) if N else (x > 0.0)):"]),
        (["-for i in range(n):", "+for i in range(n - 1):"], ["for i in range(((n - 1) if N else (n))):"]),
        (["-    x += 1.0", "+    x -= 1.0"], ["    if N:", "        x -= 1.0", "    else:", "        x += 1.0"]),
        (["-             1.0) + n", "+             1.0)"],
         ["    if N:", "        x = fabs(x,", "                 1.0)", "    else:", "        x = fabs(x,"]),
        (["-if x > 0.0:                 # a condition", "-    x += 1.0", " for i in range(n):"],
         ["if N:", "    pass", "else:", "    if x > 0.0:                 # a condition", "        x += 1.0"]),
        (["-cdef int i", "+cdef long i"], None),
        (["-if x > 0.0:                 # a condition", "+while x > 0.0:"], None),
    ],
)  # fmt: skip
def test_switch_fault_makes_branches_of_whole_statements_or_refuses(lines, expected):
    fault = mutants.Fault("name", "A sentence.", "path", "cdef inline double f", lines)
    switched = mutants.switch_fault(fault, KERNEL, 7)
    assert (switched is None) == (expected is None)
    if expected is not None:
        block = "\n".join("    " + line for line in expected).replace("N", "fault_number() == 7")
        assert block in switched and mutants.insert_import(switched).startswith("from lavender_ext.core.fault cimport")


def test_nearly_all_faults_of_kernels_can_be_switched():
    """Each other one costs a compilation of minutes."""
    kernels = [fault for fault in FAULTS if fault.is_kernel]
    single = [f.name for f in kernels if mutants.switch_fault(f, (ROOT / f.path).read_text(), 1) is None]
    assert len(single) <= 5, single


def test_drawn_faults_are_those_of_their_seed_and_each_applies_and_changes_one_line():
    files = [*(ROOT / "lavender" / "solving").glob("*.py"), *(ROOT / "lavender_ext" / "newton").glob("*.pxd")]
    lines = {path.relative_to(ROOT).as_posix(): set(range(100, 400)) for path in files}
    drawn = [mutants.Fault(*own[:3], "", own[3]) for own in mutants.draw_faults(ROOT, 64, 5, lines)]
    assert drawn == [mutants.Fault(*own[:3], "", own[3]) for own in mutants.draw_faults(ROOT, 64, 5, lines)]
    assert {fault.path for fault in drawn} <= lines.keys()
    assert all(100 < int(fault.sentence.split()[-3]) <= 400 for fault in drawn)
    assert len({(fault.path, *fault.lines) for fault in drawn}) == len(drawn) == 64
    assert sum(fault.is_kernel for fault in drawn) == 32
    assert len({fault.sentence.split(",")[0] for fault in drawn}) == len(OPERATORS)
    for fault in drawn:
        text = (ROOT / fault.path).read_text()
        changed = mutants.apply_fault(fault, text)
        differ = [a for a, b in zip(text.splitlines(), changed.splitlines(), strict=True) if a != b]
        assert len(differ) == 1
        assert not differ[0].strip().startswith(("def ", "import ", "from ", "#"))


@pytest.mark.parametrize(
    ("operator", "line", "expected"),
    [
        ("sign", "    x = a - b", "    x = a + b"),
        ("sign", "    x = f(-y)", "    x = f(y)"),
        ("bound", "    return x < 1", "    return x <= 1"),
        ("row", "    y = x[3 * i + 2]", "    y = x[3 * i]"),
        ("row", "    y = x[0]", "    y = x[1]"),
        ("other of a pair", "    r = arm_a", "    r = arm_b"),
        ("dropped branch", "    if x and y:", "    if False:"),
        ("stale state", "    s.at[k] = 2.0", "    pass"),
        ("ignored argument", "    f(x, tol=tol)", "    f(x)"),
        ("ignored argument", "    if g(x, deadline):", "    if g(x, NULL):"),
    ],
)
def test_operator_changes_code_but_no_text_comment_or_declaration(operator, line, expected):
    lines = [line, f'    y = "{line.strip()}"', f"    # {line.strip()}", f"def f(x={line.strip()!r}):"]
    [place] = list_places("x.py", "\n".join(lines))[operator]
    assert (place.line, f"{line[: place.begin]}{place.text}{line[place.end :]}") == (0, expected)


def test_marks_enter_every_function_of_a_module():
    text = (ROOT / "lavender" / "solving" / "limits.py").read_text()
    functions = [x for x in ast.walk(ast.parse(text)) if isinstance(x, ast.FunctionDef)]
    marked = [
        x
        for x in ast.walk(ast.parse(mutants.fault_reach.insert_marks(text, 7, is_kernel=False)))
        if isinstance(x, ast.FunctionDef) and any("mark(7)" in ast.unparse(y) for y in x.body[:2])
    ]
    assert len(marked) == len(functions) > 1
    lines = mutants.fault_reach.insert_marks(KERNEL, 2, is_kernel=True).splitlines()
    assert lines[lines.index("    mark(2)") - 1].startswith("cdef inline double f(")
