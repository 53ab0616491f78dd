"""`.ci/mutants`: every fault of tests/mutants applies to the present sources and states its effect in a sentence."""

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
