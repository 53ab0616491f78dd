"""Commands with installed plug-ins: faults of one of them are reported once, and the others are used."""

import os

import pytest
from worked import python

import lavender as lv

MODULE = """
import os
import lavender as lv

class Solver:
    def prepare(self, problem):
        return problem

    def run(self, state, impulse, n, tol, time_limit=None):
        os._exit(7)

def make_spec(**more):
    return lv.SolverSpec(**({"factory": Solver, "summary": "a plug-in", "laws": {"lcp"}} | more))

GOOD = make_spec(name="good")
OTHER = make_spec(name="other")
TAKEN = make_spec(name="pgs")

def leave():
    raise SystemExit(3)

def misspelt():
    return make_spec(name="misspelt", laws={"lpc"})
"""


@pytest.fixture
def install(tmp_path):
    """Function that installs a package with these lines of entry points; it returns variables of the environment."""

    def write(*lines):
        info = tmp_path / "many_solvers-1.2.dist-info"
        info.mkdir()
        (tmp_path / "plugin_module.py").write_text(MODULE)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: many-solvers\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text("\n".join(("[lavender.solvers]", *lines)) + "\n")
        path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
        return {**os.environ, "PYTHONPATH": path, "COLUMNS": "200"}

    return write


def test_solvers_with_broken_plug_ins_reports_each_once_and_lists_the_rest(install):
    environment = install(
        "good = plugin_module:GOOD", "alias = plugin_module:OTHER", "taken = plugin_module:TAKEN",
        "leave = plugin_module:leave", "misspelt = plugin_module:misspelt", "no_colon = plugin_module:",
    )  # fmt: skip
    done = python("-m", "lavender", "solvers", env=environment)
    warnings = done.stderr.splitlines()
    expected = (
        "'alias' (plugin_module:OTHER) of many-solvers has a solver named 'other': use this name",
        "'taken' (plugin_module:TAKEN) of many-solvers was left out: another solver is named 'pgs'",
        "'leave' (plugin_module:leave) of many-solvers was left out: SystemExit: 3",
        "laws of solver 'misspelt' are {'lpc'}; a set of linear, lcp, coulomb, cone is needed",
        "'no_colon' (plugin_module:) of many-solvers was left out: its entry point is not of the form module:attribute",
    )
    assert len(warnings) == len(expected)
    for line, text in zip(warnings, expected, strict=True):
        assert line.startswith("lavender: warning: solver plug-in ") and text in line
    names = {line.split()[0] for line in done.stdout.splitlines() if line.strip()}
    assert {"good", "other", "pgs"} <= names and not {"alias", "taken", "leave", "misspelt"} & names


def test_solvers_with_an_invalid_table_of_entry_points_names_the_package(install):
    done = python("-m", "lavender", "solvers", env=install("good plugin_module:GOOD"))
    assert done.stderr.count("\n") == 1 and "solver plug-ins of many-solvers were left out" in done.stderr
    assert "pgs" in done.stdout and "good" not in done.stdout


def test_solvers_of_a_plug_in_names_its_package_and_version(install):
    done = python("-m", "lavender", "solvers", "good", env=install("good = plugin_module:GOOD"))
    assert done.stderr == "" and "Plug-in of: many-solvers 1.2" in done.stdout


def test_solve_with_a_plug_in_that_ends_its_process_names_the_solver(install):
    words = ("solve", "toy_stack", "--solver", "good")
    done = python("-m", "lavender", *words, env=install("good = plugin_module:GOOD"), status=1)
    assert done.stderr.startswith("lavender: good: CRASHED (exit status 7)") and "--solvers" not in done.stderr


def test_records_of_a_plug_in_have_the_version_of_its_package(install, tmp_path):
    words = (
        "report", "toy_stack", "--solvers", "good", "pgs", "--repeats", "1", "--no-figures", "--out",
        str(tmp_path / "o"),
    )  # fmt: skip
    python("-m", "lavender", *words, env=install("good = plugin_module:GOOD"))
    runs = lv.report.select_runs(lv.report.read(tmp_path / "o"))
    assert len(runs) and runs["versions"].astype(str).str.contains("many-solvers 1.2").all()


def test_report_with_workers_names_a_broken_plug_in_once(install, tmp_path):
    words = (
        "report",
        "toy_stack",
        "--solvers",
        "pgs",
        "jacobi",
        "--workers",
        "2",
        "--tolerances",
        "1e-3",
        "--budgets",
        "4",
    )
    environment = install("broken = no_such_module:SPEC")
    done = python("-m", "lavender", *words, "--out", str(tmp_path / "o"), env=environment)
    assert done.stderr.count("solver plug-in 'broken'") == 1
