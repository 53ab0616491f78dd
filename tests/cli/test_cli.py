"""The command line: what it leaves, and what it says when it cannot."""

import importlib
import json
import re
import signal
import subprocess
import sys

import click
import numpy as np
import pytest
from calls import robot
from stacks import stack

import lavender as lv
from lavender import cli
from lavender.cli import entry

QUICK = ("--tolerances", "1e-3,1e-6", "--budgets", "2,4", "--repeats", "1", "--no-figures")


def test_report_and_check_of_a_false_claim_mark_it_contradicted(lavender, path, plug_in):
    plug_in(lambda problem, impulse: lv.Claim(lv.Status.CONVERGED, 1), "liar", laws={"lcp"})
    code, out, _ = lavender(
        "report", path, "--solvers", "liar", *QUICK[:2], *QUICK[-3:], "--tables"
    )
    assert code == 0
    assert (
        "false claim, the first of 2: liar on stack8: says CONVERGED" in out
        and "✗ says CONVERGED" in out
    )
    code, out, _ = lavender("check", path, "--solvers", "liar")
    assert code == 1
    assert "claim contradicted" in out and "1 claims are contradicted" in out


@pytest.mark.parametrize(("a", "code"), [(-1.0, 3), (0.0, 1)])
def test_solve_command_ends_with_3_only_for_a_proven_claim_of_infeasibility(
    lavender, tmp_path, plug_in, a, code
):
    """With A = [[1, -1], [-1, 1]] and b = (1, 1), y = (1, 1) proves that there is no solution."""
    plug_in(
        lambda problem, impulse: lv.Claim(lv.Status.INFEASIBLE, 1, certificate=np.ones(2)),
        "unsure",
        laws={"lcp"},
    )
    lv.Problem.lcp([[1.0, a], [a, 1.0]], [1.0, 1.0]).save(tmp_path / "p.npz")
    assert lavender("solve", tmp_path / "p.npz", "--solver", "unsure")[0] == code


def test_contract_of_a_false_solver_ends_with_1_and_names_unmet_requirements(
    lavender, plug_in, tmp_path
):
    code, out, _ = lavender("contract", "sor")
    assert code == 0 and "NOT MET" not in out
    assert "orders_change_the_sweep" not in out  # sor has orders
    plug_in(
        lambda problem, impulse: lv.Claim(lv.Status.CONVERGED, 1, {"sweeps": 1}),
        "liar",
        laws={"lcp"},
    )
    code, out, _ = lavender("contract", "liar", "--out", str(tmp_path / "unmet"))
    assert code == cli.EXIT_UNMET
    assert "NOT MET  Every problem that the spec accepts is solved" in out
    assert "for a stack of boxes without friction (law lcp) the result is: liar" in out
    assert lv.load(tmp_path / "unmet" / "problems_are_solved.npz").m > 0
    code, out, _ = lavender("contract", "liar", "--list")
    assert code == 0 and "problems_are_solved, all solvers" in out and "met " not in out


#: The words with which a command would run, where it has an option of a real number.
RUNS = {
    "audit": ("m.xml", "--worlds", 1, "--steps", 1, "--workers", 1),
    "tune": ("m.xml", "--worlds", 2, "--steps", 2),
    "record": ("m.xml", "--steps", 1, "--out", "out"),
    "check": ("stack(n=2)", "--solvers", "pgs"),
    "judge": ("stack(n=2)",),
    "explain": ("stack(n=2)",),
    "report": ("stack(n=2)", "m.xml", "--solvers", "pgs", *QUICK),
    "run": ("stack", "--solver", "newton"),
    "solve": ("stack(n=2)",),
}


def options_of_real_numbers():
    """(Command, option) of every command."""
    for command in entry.cli.list_commands(click.Context(entry.cli)):
        for option in entry.cli.get_command(click.Context(entry.cli), command).params:
            if (
                getattr(
                    option.type, "kind", float if option.type.name.startswith("float") else None
                )
                is float
            ):
                yield command, option.opts[0]


@pytest.mark.parametrize("asked", ["nan", "-1"])
@pytest.mark.parametrize(("command", "option"), list(options_of_real_numbers()))
def test_command_with_nan_or_a_negative_number_ends_with_2(lavender, command, option, asked):
    from mujoco_scene import scene

    with open("m.xml", "w") as file:
        file.write(scene())
    code, _, err = lavender(command, *RUNS[command], f"{option}={asked}")
    assert code == cli.EXIT_BAD_INPUT
    assert asked in err or option in err


def test_solve_prints_one_line_and_writes_the_answer(lavender, path, tmp_path):
    target = tmp_path / "answer.npz"
    code, out, _ = lavender("solve", path, "--solver", "pgs", "--tol", 1e-10, "--output", target)
    assert code == 0
    assert "pgs: CONVERGED" in out
    with np.load(target, allow_pickle=False) as answer:
        exact = lv.solve(stack(8), "pgs", tol=1e-10)
        np.testing.assert_array_equal(answer["impulse"], exact.impulse)
        assert answer["relative"] == exact.residual.relative
        assert str(answer["status"]) == "CONVERGED"


def test_solve_command_with_output_equal_to_the_problem_ends_with_2(lavender, path):
    before = path.read_bytes()
    link = path.with_name("link.npz")
    link.symlink_to(path)
    for output in (path, link):
        assert lavender("solve", path, "--output", output)[0] == cli.EXIT_BAD_INPUT
        assert path.read_bytes() == before


@pytest.mark.parametrize("command", ["audit", "tune"])
def test_ctrl_c_in_a_command_ends_with_130(tmp_path, monkeypatch, capsys, command):
    pytest.importorskip("mujoco")
    from lavender.cli import main

    def stop(*arguments, **options):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(importlib.import_module(f"lavender.audit.{command}"), command, stop)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.xml").write_text("<mujoco/>")
    with pytest.raises(SystemExit) as end:
        main([command, "model.xml"])
    assert end.value.code == 130
    assert "lavender: stopped" in capsys.readouterr().err


def test_doctor_of_a_problem_with_duplicates_lists_them(lavender, path):
    assert lavender("doctor", path)[:2] == (0, "1 problems checked, none with diagnostics\n")
    code, out, _ = lavender("doctor", path, "duplicated(k=3)")
    assert (code, out.splitlines()[-1]) == (1, "2 problems checked, 1 with diagnostics")
    assert out.startswith("duplicated(k=3): duplicate rows: 2 contacts")
    assert json.loads(lavender("doctor", "duplicated(k=3)", "--json")[1])["duplicated(k=3)"][0][
        "blocks"
    ] == [1, 2]


def _must_not_begin(*_, **__):
    raise AssertionError("the work began")


@pytest.mark.parametrize(
    ("words", "work"),
    [
        ("run stack --plot {}/x.svg", "lavender.sim.engine.Simulation.step"),
        ("run stack --trace {}/x.csv", "lavender.sim.engine.Simulation.step"),
        ("run stack --film {}/x.gif", "lavender.sim.engine.Simulation.step"),
        ("solve toy_stack --output {}/x.npz", "lavender.report.resolve_sources"),
        ("web build {}/x.wasm", "lavender.sim.web.compile.build"),
        ("export c {}/sub", "lavender.export.library.source"),
        ("web page {}/sub", "lavender.sim.web.pages.get_or_build_module"),
        ("report toy_stack --out {}/sub", "lavender.report.resolve_sources"),
        ("report toy_stack --workers 1 --out {}/sub", "lavender.report.resolve_sources"),
        ("run stack --record {}/sub", "lavender.sim.engine.Simulation.step"),
    ],
)
def test_command_with_an_unwritable_output_ends_with_2_before_work(
    lavender, monkeypatch, tmp_path, words, work
):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(work, _must_not_begin)
    for place in (
        ("file",) if "/sub" in words else ("file", "absent")
    ):  # a folder is made, with its parents
        code, out, err = lavender(*words.format(tmp_path / place).split())
        assert (code, out) == (cli.EXIT_BAD_INPUT, "")
        assert re.search(r"^lavender: cannot (write|create) .*", err)
        assert str(tmp_path / place) in err


def test_check_judges_a_stored_answer_for_the_precision_it_was_made_in(lavender, tmp_path):
    problem = robot(2)
    exact = lv.solve(problem, tol=1e-11).impulse
    for name, impulse in (
        ("done", exact.astype(np.float32)),
        ("early", 0.9 * exact),
        ("none", None),
    ):
        lv.io.save(problem, tmp_path / f"{name}.npz", impulse=impulse)
    told = ("--solvers", "pgs", "--precision", "float32")
    code, out, err = lavender("check", tmp_path / "done.npz", *told)
    assert code == 0, out + err
    assert "stored solution (float32): at its floor" in " ".join(out.split())
    code, out, _ = lavender("check", tmp_path / "early.npz", *told)
    assert code == 1 and "stored solution (float32): stopped before convergence, " in out
    # Without the option the precision is the problem's, and the exit code that of the claims.
    assert lavender("check", tmp_path / "early.npz", *told[:2])[0] == 0
    code, _, err = lavender("check", tmp_path / "none.npz", *told)
    assert code == cli.EXIT_BAD_INPUT and "no file has one" in err
    code, _, err = lavender("check", tmp_path / "done.npz", "--precision", "half")
    assert code == cli.EXIT_BAD_INPUT and "'half' is not one of 'float64', 'float32'" in err


@pytest.mark.parametrize(("threshold", "code"), [("1e-3", 0), ("1e-5", 1), ("0", 1)])
def test_check_of_a_stored_answer_ends_with_1_only_if_its_error_exceeds_the_threshold(
    lavender, tmp_path, threshold, code
):
    problem = robot(2)
    impulse = lv.solve(problem, tol=1e-11).impulse * (1.0 + 1e-4)
    assert 1e-5 < lv.residual(problem, impulse).velocity < 1e-3
    lv.io.save(problem, tmp_path / "p.npz", impulse=impulse)
    assert (
        lavender("check", tmp_path / "p.npz", "--solvers", "auto", "--threshold", threshold)[0]
        == code
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("import lavender.cli", "the command line needs click, rich: pip install click rich"),
        (
            "lv.report.run(['granularF(n=3)'], ['pgs'])",
            "a measurement needs joblib, pandas: pip install 'lavender-",
        ),
        (
            "lv.report.read('records.jsonl')",
            "a table of runs needs pandas: pip install 'lavender-contact[report]'",
        ),
        (
            "lv.cross_check(lcp, ['pgs', 'direct']).frame",
            "a table or page needs pandas: pip install 'lavender-contact",
        ),
        (
            "lv.solve(lcp, 'pgs', history=True).history.plot()",
            "History.plot needs matplotlib: pip install",
        ),
        ("lv.suite; print(lv.solve(lcp, 'osqp'), lv.solve(lcp, 'direct'))", "CONVERGED"),
    ],
)
def test_call_without_an_optional_package_names_the_command_to_install_it(call, message):
    names = ["click", "rich", "joblib", "matplotlib", "pandas"]  # OSQP needs jinja2
    code = f"import sys\nfor name in {names}: sys.modules[name] = None\nimport lavender as lv\n"
    code += f"lcp = lv.Problem.lcp([[2.0]], [1.0])\n{call}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert message in done.stdout + done.stderr
    assert "ModuleNotFoundError" not in done.stderr


@pytest.mark.parametrize(
    "command", ["report", "audit box.xml", "slip box.xml", "tune box.xml", "check stack(n=4)"]
)
def test_command_without_the_extra_report_names_it(command):
    """`lavender solve`, `solvers` and `explain` do their work without it."""
    block = "import sys\nsys.modules['pandas'] = None\n"
    code = f"{block}from lavender.cli import main\nmain({command.split()})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert (
        "pip install 'lavender-contact[report]', or in a clone pip install -e '.[report]'"
        in done.stderr
    )


@pytest.mark.parametrize("command", ["solvers", "solve stack(n=4)", "explain stack(n=4)"])
def test_command_of_the_core_works_without_the_extra_report(command):
    block = "import sys\nsys.modules['pandas'] = None\n"
    code = f"{block}from lavender.cli import main\nmain({command.split()})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def reject_constant(word):
    """Raise an error for a number that JSON does not have."""
    raise AssertionError(word)


def test_solve_json_has_the_judged_result(lavender, path):
    code, out, _ = lavender("solve", path, "--json")
    result = json.loads(out, parse_constant=reject_constant)
    problem = lv.load(path)
    judged = lv.residual(problem, np.array(result["impulse"]))
    assert code == 0 and result["status"] == "CONVERGED" and result["success"] is True
    assert (result["relative"], result["velocity"]) == (judged.relative, judged.velocity)
    assert result["rows"] == problem.m and result["worst_row"] == judged.worst_name


def test_check_json_is_the_only_output(lavender, path):
    code, out, _ = lavender("check", path, path, "--solvers", "newton,pgs", "--json")
    entries = json.loads(out, parse_constant=reject_constant)
    assert code == 0 and len(entries) == 2
    assert [row["solver"] for row in entries[0]["solvers"]] == ["newton", "pgs"]
    assert entries[0]["solvers"][0]["verdict"] == "agrees"


@pytest.mark.parametrize("columns", ["0", "19"])
@pytest.mark.parametrize(
    "words", [("solvers",), ("report", "--list"), ("check", "stack(n=4)", "--solvers", "pgs")]
)
def test_command_in_a_narrow_terminal_prints_whole_names(lavender, monkeypatch, words, columns):
    wide = lavender(*words)[1]
    monkeypatch.setenv("COLUMNS", columns)
    code, narrow, _ = lavender(*words)
    assert code == 0
    names = re.findall(r"^\w+", wide, re.MULTILINE)
    assert names and set(names) <= set(re.findall(r"^\w+", narrow, re.MULTILINE))
