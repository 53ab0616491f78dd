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
        if "END" in os.environ:
            os._exit(7)
        return lv.Claim(lv.Status.MAX_ITERATIONS, 1)

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
        "good = plugin_module:GOOD",
        "alias = plugin_module:OTHER",
        "taken = plugin_module:TAKEN",
        "leave = plugin_module:leave",
        "misspelt = plugin_module:misspelt",
    )
    done = python("-m", "lavender", "solvers", env=environment)
    warnings = done.stderr.splitlines()
    expected = (
        "'alias' (plugin_module:OTHER) of many-solvers has a solver named 'other': use this name",
        "'taken' (plugin_module:TAKEN) of many-solvers was left out: another solver is named 'pgs'",
        "'leave' (plugin_module:leave) of many-solvers was left out: SystemExit: 3",
        "laws of solver 'misspelt' is {'lpc'}; a set of linear, lcp, coulomb, cone is needed",
    )
    assert len(warnings) == len(expected)
    for line, text in zip(warnings, expected, strict=True):
        assert line.startswith("lavender: warning: solver plug-in ") and text in line
    names = {line.split()[0] for line in done.stdout.splitlines() if line.strip()}
    assert {"good", "other", "pgs"} <= names and not {"alias", "taken", "leave", "misspelt"} & names


def test_solvers_of_a_plug_in_names_its_package_and_version(install):
    done = python("-m", "lavender", "solvers", "good", env=install("good = plugin_module:GOOD"))
    assert done.stderr == "" and "Plug-in of: many-solvers 1.2" in done.stdout


def test_report_with_a_plug_in_that_ends_the_process_keeps_its_rows_and_continues(
    install, tmp_path
):
    environment = install("good = plugin_module:GOOD", "other = plugin_module:OTHER")
    words = ("report", "toy_stack", "--repeats", "1", "--no-figures", "--out", str(tmp_path / "o"))
    words += ("--solvers", "direct,pgs,good")
    python("-m", "lavender", *words, env=environment | {"END": "1"}, status=7)
    kept = lv.report.select_runs(lv.report.read(tmp_path / "o"))
    assert set(kept["solver"]) == {"direct", "pgs"}
    assert kept["versions"].astype(str).str.contains("many-solvers 1.2").all()
    python("-m", "lavender", *words, env=environment)
    runs = lv.report.select_runs(lv.report.read(tmp_path / "o"))
    assert set(runs["solver"]) == {"direct", "pgs", "good"}
    for name in ("solver", "max_iter", "time", "solution_hash"):  # Nothing was measured again.
        assert runs.loc[runs["solver"] != "good", name].tolist() == kept[name].tolist()
