"""`lavender report`, `explain`: what measures and examines from the command line."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from stacks import idle_problem, stack

import lavender as lv
from lavender import cli, io, report
from lavender import export as export
from lavender.report.store import select_cases, select_skips


def test_explain_command_prints_stages_and_json(lavender):
    code, shown, _ = lavender("explain", "stack(n=200)", "granularF(n=4)")
    assert code in (0, None)
    assert "newton is counted to take" in shown and "granularF(n=4)" in shown and "admm" in shown
    plan = json.loads(lavender("explain", "stack(n=200)", "--json", "--tol", "1e-9")[1])
    assert plan["tol"] == 1e-9 and plan["rows"] == 200 and plan["stages"][0]["solver"] == "direct"


def test_lists_take_commas_or_blanks_and_files_may_follow(lavender, path, tmp_path):
    code, *_ = lavender(
        "report",
        "--tolerances=1e-2",
        "--solvers",
        "pgs",
        "jacobi",
        "--budgets",
        "3",
        "5",
        path,
        "--repeats",
        1,
        "--no-figures",
        "--out",
        tmp_path / "out",
    )
    assert code == 0
    runs = report.select_runs(report.read(tmp_path / "out"))
    assert set(runs["solver"]) == {"pgs", "jacobi"}
    assert set(runs.loc[runs["mode"] == "budget", "max_iter"]) == {3, 5}


def test_report_leaves_out_a_named_file_that_is_broken_and_ends_with_1(lavender, path, tmp_path):
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"PK no archive")
    options = ("--solvers", "pgs", "--tolerances", "1e-3", "--repeats", 1, "--no-figures", "--out")
    code, out, _ = lavender("report", broken, path, *options, tmp_path / "out")
    assert code == 1 and "1 case left out of all numbers" in out
    assert set(report.select_runs(report.read(tmp_path / "out"))["case"]) == {"stack8"}
    assert str(broken) in (tmp_path / "out" / "index.html").read_text()
    code, out, _ = lavender("report", broken, *options, tmp_path / "other")
    assert code == 1 and "nothing was measured" in out and str(broken) in out


def test_quiet_report_prints_the_path_of_the_page_and_writes_the_chosen_figures_and_columns(
    lavender, path, tmp_path
):
    out = tmp_path / "out"
    words = (
        "report",
        path,
        "--solvers",
        "pgs,newton",
        "--tolerances",
        "1e-3,1e-6",
        "--repeats",
        1,
        "--out",
        out,
    )
    code, shown, err = lavender(
        *words, "-q", "--figure-kinds", "pdf,svg", "--columns", "1e-6,solved,slowest"
    )
    assert (code, shown.strip(), err) == (0, str(out / "index.html"), "")
    assert {p.suffix for p in (out / "figures").iterdir()} == {".pdf", ".svg"}
    table = (out / "tables" / "solvers.tex").read_text()
    assert r" & $10^{-6}$ & solved & slowest [ms] \\" in table and r"\toprule" in table
    for options, sign in (
        (("--columns", "fastest"), "no column 'fastest'"),
        (("--figure-kinds", "bmp"), "bmp"),
    ):
        code, shown, err = lavender(*words, *options)
        assert (code, shown) == (2, "") and sign in err


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_report_stopped_by_ctrl_c_keeps_records_and_writes_the_page(tmp_path):
    # A problem that nothing solves in the time: every run to a tolerance takes its limit.
    out = tmp_path / "out"
    a = np.array([[1.0, -1.0], [-1.0, 1.0]])
    n = 300
    big = np.kron(np.eye(n), a) + 1e-9 * np.eye(2 * n)
    io.save(
        lv.Problem.lcp(big, np.random.default_rng(0).standard_normal(2 * n)), tmp_path / "hard.npz"
    )
    io.save(stack(8), tmp_path / "easy.npz")
    command = [
        sys.executable,
        "-m",
        "lavender.cli",
        "report",
        tmp_path / "easy.npz",
        tmp_path / "hard.npz",
    ]
    command += ["--solvers", "pgs,jacobi", "--time-limit", "60", "--no-figures", "--out", out]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    )
    records = out / "records.jsonl"
    while not (records.exists() and '"case": "hard"' in records.read_text()):
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    printed, said = process.communicate(timeout=600)
    assert process.returncode == 130, said
    assert b"Traceback" not in said
    assert b"continues from here" in printed
    assert (out / "index.html").exists()
    kept = [json.loads(line) for line in records.read_text().splitlines()]
    assert any(r["kind"] == "run" and r["case"] == "easy" for r in kept)


def test_a_recorded_scene_is_reported_as_a_sequence(lavender, tmp_path):
    folder = tmp_path / "steps"
    code, out, _ = lavender("run", "stack", "--steps", 4, "--record", folder)
    assert code == 0
    assert "4 problems" in out
    assert len(list(folder.glob("*.npz"))) == 4
    words = (
        "report",
        folder,
        "--solvers",
        "sequential_impulses",
        "--budgets",
        "4",
        "--tolerances",
        "1e-1",
    )
    code, out, _ = lavender(*words, "--no-figures", "--repeats", 1)
    assert code == 0
    assert "it solves all 4 steps of steps, in" in out
    code, out, _ = lavender(*words, "--no-figures", "--repeats", 1, "--compare", "lavender-report")
    assert code == 0
    assert "nothing was compared" in out and "nothing beyond noise" not in out
    summary = (tmp_path / "here/lavender-report/summary.md").read_text()
    assert re.search(r"\| solver \| solved \| accepted \|", summary)
    code, _, err = lavender("run", "stack", "--steps", 5, "--record", folder)
    assert (code, "steps of two recordings" in err) == (2, True)
    assert lavender("run", "stack", "--steps", 3, "--record", folder, "--replace")[0] == 0
    assert len(list(folder.glob("*.npz"))) == 3  # none of the four is left
    assert lavender("report", "--sequence")[0] == 2
    code, _, err = lavender("report", "two_particles", "--solvers", "pgs", "newtn")
    assert (code, "newton" in err) == (2, True)  # A misspelt solver is not read as a case.
    assert lavender("report", "--sequence", folder, "--compare", "nowhere")[0] == 2


ARM = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 {height}"><freejoint/><geom type="{kind}" size=".1 .1 .1"/></body></worldbody></mujoco>"""


def test_report_counts_steps_that_were_not_recorded(lavender, tmp_path, monkeypatch):
    """In the terminal, the records and the exit code, at once, found recorded, as a campaign and in a check."""
    recording = pytest.importorskip("lavender.io.recording")
    pytest.importorskip("mujoco")
    (tmp_path / "box.xml").write_text(ARM.format(height=0.1, kind="box"))
    true = recording.adapter.from_mujoco

    def some(model, data, name):
        if int(name.split()[1]) % 15 == 0:
            raise lv.CapabilityError(f"{name} is of another <problem>")
        return true(model, data, name=name)

    monkeypatch.setattr(recording.adapter, "from_mujoco", some)
    more = ("--solvers", "auto,pgs", "--repeats", 1, "--time-limit", 0.02)
    shown = ("--no-figures", "--tables", "--out", tmp_path / "o")
    model = (tmp_path / "box.xml", "--steps", 45)
    for _ in range(2):  # The second recording replaces the first.
        code, out, _ = lavender("report", *model, *more, *shown)
        lines = report.read(tmp_path / "o")
        (name,) = set(select_cases(lines)["sequence"])
        assert code == cli.EXIT_UNMET and f"steps of {name} (3 left out)" in " ".join(out.split())
        assert "step 15 is of another <problem>" in " ".join(out.split())
        skips = select_skips(lines)
        skips = skips[skips["reason"].str.contains("of another")]
        assert skips[["sequence", "solver"]].to_numpy().tolist() == [[name, ""]] * 3
    assert lavender("report", tmp_path / "o" / "records.jsonl", *shown)[0] == 0  # shown again
    (folder,) = (tmp_path / "o" / "recorded").iterdir()
    code, out, _ = lavender(
        "report", folder, "--solvers", "pgs", "--workers", 1, "--out", tmp_path / "c"
    )
    assert code == cli.EXIT_UNMET and "left out, the first of 3: " in out
    assert lavender("check", folder, "--solvers", "pgs")[0] == cli.EXIT_UNMET
    monkeypatch.setattr(recording.adapter, "from_mujoco", true)
    code, out, _ = lavender("report", *model, *more, *shown, "--no-reuse")
    assert (code, "left out" in out) == (0, False)


def test_solve_command_of_a_problem_at_rest_prints_nothing_to_do(lavender, tmp_path):
    lv.io.save(idle_problem(), tmp_path / "idle.npz")
    code, out, _ = lavender("solve", tmp_path / "idle.npz", "--solver", "pgs")
    assert code == 0 and "nothing to do" in out


def test_report_that_measured_nothing_prints_the_reason(lavender, tmp_path):
    lv.Problem.contact(np.eye(3), [1.0, 2.0, 0.0], mu=[0.5]).save(tmp_path / "friction.npz")
    code, out, _ = lavender("report", tmp_path / "friction.npz", "--solvers", "direct")
    assert code == 1
    assert "nothing was measured: takes laws linear, lcp, not 'coulomb'" in out
