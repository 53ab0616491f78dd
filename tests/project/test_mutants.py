"""`.ci/mutants`: every fault of tests/mutants applies to the present sources and states its effect in a sentence."""

import importlib.machinery
import importlib.util
import sys

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
        if not (
            fault.sentence.endswith(".")
            and fault.sentence[0].isupper()
            and len(fault.sentence.split()) > 4
        ):
            problems.append(
                f"{fault.name}: its first line is {fault.sentence!r}; a sentence on its effect is needed"
            )
    assert not problems, "\n".join(problems)


def test_faults_cover_every_package_and_their_tests_exist():
    folders = [path for root in ("lavender", "lavender_ext") for path in (ROOT / root).iterdir()]
    packages = {path.name for path in folders if (path / "__init__.py").is_file()}
    assert {fault.package for fault in FAULTS} | packages <= mutants.NEAR.keys()
    assert sum(fault.is_kernel for fault in FAULTS) > len(FAULTS) / 3
    for words in mutants.NEAR.values():
        assert [word for word in words.split() if not (ROOT / "tests" / word).exists()] == []


def test_recorded_results_are_of_faults_and_name_a_test_file_that_exists():
    results = mutants.read_results()
    assert results.keys() <= {fault.name for fault in FAULTS}
    files = {test.split("::")[0] for test in results.values() if test.startswith("tests/")}
    assert [name for name in sorted(files) if not (ROOT / name).is_file()] == []


def test_recorded_tests_still_exist():
    """The faults that a removed test found need another one: `.ci/mutants --changed COMMIT --record`."""
    lost = []
    for name, test in mutants.read_results().items():
        if test.startswith("tests/"):
            path, function = test.split("::")[:2]
            if f"def {function.split('[')[0]}(" not in (ROOT / path).read_text(encoding="utf-8"):
                lost.append(f"{name}: {test}")
    assert lost == []


def test_drawn_faults_are_also_those_of_a_tired_person_and_in_headers():
    files = (
        "lavender/solving/prepared.py",
        "lavender/report/tables.py",
        "lavender_ext/batch/many.pyx",
        "lavender_ext/judge/reference.pxd",
        "lavender_ext/batch/lanes_body.h",
    )
    drawn = [*mutants.draw_faults(ROOT, 200, 1, {path: set(range(10_000)) for path in files})]
    operators = {sentence.split(",")[0] for _, sentence, _, _ in drawn}
    assert operators >= {
        "like-named",
        "stale value",
        "wrong unit",
        "wrong default",
        "wrong door",
        "sign",
        "bound",
    }
    assert {path.rpartition(".")[2] for _, _, path, _ in drawn} == {"py", "pyx", "pxd", "h"}
    for name, sentence, path, lines in drawn[::7]:
        text = (ROOT / path).read_text(encoding="utf-8")
        assert mutants.apply_fault(mutants.Fault(name, sentence, path, "", lines), text) != text


def test_nearly_all_faults_of_kernels_can_be_switched():
    """Each other one costs a compilation of minutes."""
    kernels = [fault for fault in FAULTS if fault.is_kernel]
    single = [
        f.name for f in kernels if mutants.switch_fault(f, (ROOT / f.path).read_text(), 1) is None
    ]
    assert len(single) <= 5, single
