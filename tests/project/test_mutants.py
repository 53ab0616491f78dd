"""`.ci/mutants`: every fault of tests/mutants applies to the present sources and states its effect in a sentence."""

import importlib.machinery
import importlib.util
import sys

import pytest
from worked import ROOT


def load_command():
    """Import `.ci/mutants`, which has no suffix."""
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
