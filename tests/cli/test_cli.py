"""The command line: what it leaves, and what it says when it cannot."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from random_problems import as_matrix, dragged, random_ellipses
from random_trees import random_tree, tree_mass
from stacks import stack

import lavender as lv
from lavender import bench, cli, io, registry
from lavender.cli import main
from lavender.lab import check as checking
from lavender.lab.bench.record import Skip, to_json


@pytest.fixture
def path(tmp_path):
    io.save(stack(8), tmp_path / "stack8.npz")
    return tmp_path / "stack8.npz"


@pytest.fixture
def lavender(capsys, tmp_path, monkeypatch):
    """Runs the command in a folder of its own: (status, stdout, stderr)."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("COLUMNS", "160")

    def run(*words):
        with pytest.raises(SystemExit) as end:
            cli.main([str(w) for w in words])
        out, err = capsys.readouterr()
        return end.value.code, out, err

    return run


QUICK = ("--levels", "1e-3", "1e-6", "--budgets", "2", "4", "--repeats", "1", "--no-figures")


def test_report_leaves_records_and_page_and_prints_times(lavender, path, tmp_path):
    code, out, _ = lavender(
        "report", path, "--solvers", "pgs", "direct", *QUICK, "--tables", "--out", tmp_path / "out"
    )
    assert code == 0
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {"records.jsonl", "records.csv", "records.json", "index.html", "summary.md"}
    records = bench.read(tmp_path / "out")
    assert {r.solver for r in records} == {"pgs", "direct"}
    assert {r.max_iter for r in records if r.mode == "budget"} == {2, 4}
    assert {r.tol for r in records if r.solver == "pgs" and r.mode == "tol"} == {1e-3, 1e-6}
    for word in ("stack8", "to 1e-3", "to 1e-6", "CONVERGED", "Use ", "index.html"):
        assert word in out


def test_lists_take_commas_or_blanks_and_files_may_follow(lavender, path, tmp_path):
    code, *_ = lavender(
        "report", "--levels=1e-2", "--solvers", "pgs,jacobi", "--budgets", "3", "5", path, "--orders", "reverse",
        "--repeats", 1, "--no-figures", "--out", tmp_path / "out",
    )  # fmt: skip
    assert code == 0
    records = bench.read(tmp_path / "out")
    assert {r.solver for r in records} == {"pgs", "jacobi"}
    assert {r.max_iter for r in records if r.mode == "budget"} == {3, 5}
    assert {r.order for r in records} == {"given", "reverse"}


def test_a_contradicted_claim_is_marked(lavender, path, plug_in):
    plug_in(lambda problem, impulse: lv.Claim(lv.Status.CONVERGED, 1), "liar", laws={"lcp"})
    code, out, _ = lavender("report", path, "--solvers", "liar", *QUICK[:3], *QUICK[-3:], "--tables")
    assert code == 0
    assert "✗ contradicted" in out
    assert "false claim (2 of 2): stack8, liar: says CONVERGED" in out
    code, out, _ = lavender("check", path, "--solvers", "liar")
    assert code == 1
    assert "claim contradicted" in out


def test_a_file_of_a_folder_that_cannot_be_read_is_named_and_costs_itself_alone(lavender, path):
    (path.parent / "[bold]x.npz").write_bytes(b"PK")
    for command in ("check", "doctor", "explain"):
        code, out, err = lavender(command, path.parent, *(["--solvers", "direct"] * (command == "check")))
        assert (command, code) == (command, cli.EXIT_UNMET)
        assert "[bold]x: " in out + err and "stack8" in out + f"stack8 {command}" * (command == "doctor")
        assert lavender(command, path.parent / "[bold]x.npz")[0] == cli.EXIT_BAD_INPUT
    assert lavender("explain", path.parent, "--tol", -1)[0] == cli.EXIT_BAD_INPUT


def test_check_fails_on_a_file_it_cannot_read(lavender, path):
    broken = path.parent / "broken.npz"
    broken.write_bytes(path.read_bytes()[:100])
    code, out, _ = lavender("check", broken, path, "--solvers", "direct")
    assert code == cli.EXIT_BAD_INPUT
    assert "broken" in out
    assert "agrees" in out  # what can be read is checked all the same


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="the device that is always full is Linux's")
def test_a_full_disk_behind_stdout_is_one_line():
    words = [sys.executable, "-m", "lavender", "solvers"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == cli.EXIT_BAD_INPUT
    assert done.stderr.startswith("lavender: ")
    assert "Traceback" not in done.stderr


def test_the_package_runs_as_a_module():
    words = [sys.executable, "-m", "lavender", "--version"]
    assert lv.__version__ in subprocess.run(words, capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize(
    "wrong", [("--tol", "nan"), ("--tol", "inf"), ("--tol=-1",), ("--reference", "nobody")]
)
def test_check_refuses_its_options_before_it_looks_at_a_folder(lavender, path, wrong):
    code, out, err = lavender("check", path.parent, "--solvers", "pgs", *wrong)
    assert code == cli.EXIT_BAD_INPUT
    assert "tol is" in err or "unknown solver 'nobody'" in err
    assert not out


def test_check_passes_honest_solvers(lavender, path):
    code, out, _ = lavender("check", path, "--solvers", "pgs", "direct")
    assert code == 0
    assert out.count(checking.AGREES) >= 2


def test_records_are_shown_again_without_solving(lavender, path, tmp_path, monkeypatch):
    bench.run([path], ["pgs"], bench.Plan((1e-3,), (4,), repeats=1), tmp_path / "r.jsonl")
    before = (tmp_path / "r.jsonl").read_bytes()
    monkeypatch.setattr(bench, "run", None)
    out_to = ("--out", tmp_path / "again", "--no-figures", "--paper")
    code, out, _ = lavender("report", tmp_path / "r.jsonl", *out_to)
    assert code == 0
    assert "it solves your stack" in out
    assert (tmp_path / "again" / "index.html").exists()
    assert "lcp" in (tmp_path / "again" / "paper" / "tables.tex").read_text(encoding="utf-8")
    assert (tmp_path / "r.jsonl").read_bytes() == before


def test_solve_prints_one_line_and_writes_the_answer(lavender, path, tmp_path):
    target = tmp_path / "answer.npz"
    code, out, _ = lavender("solve", path, "--solver", "pgs", "--tol", 1e-10, "--history", "--output", target)
    assert code == 0
    assert "pgs: CONVERGED" in out
    assert "iterations" in out
    with np.load(target, allow_pickle=False) as answer:
        exact = lv.solve(stack(8), "pgs", tol=1e-10)
        np.testing.assert_array_equal(answer["impulse"], exact.impulse)
        assert answer["relative"] == exact.residual.relative
        assert str(answer["status"]) == "CONVERGED"


def test_solvers_lists_all_with_reasons(lavender):
    code, out, _ = lavender("solvers")
    assert code == 0
    for name, spec in registry.specs().items():
        assert name in out
        assert spec.missing() is None or "pip install" in out
    lines = out.splitlines()
    place = {line.split()[0]: i for i, line in enumerate(lines) if line.strip()}
    reasons = registry.known()
    here = [place[n] for n, reason in reasons.items() if reason is None]
    away = [place[n] for n, reason in reasons.items() if reason is not None]
    assert max(here) < min(away, default=len(lines)), "those that are here come first"
    code, out, _ = lavender("solvers", "--problem", "stack(n=8)")
    assert code == 0
    assert "takes laws linear" in out  # gauss_seidel, sor


@pytest.mark.parametrize(
    ("words", "sign"),
    [
        (("report", "--solvers", "pgz"), "did you mean 'pgs'"),
        (("report", "stack(n=8)", "--solvers", "auto", "pgz"), "unknown solver 'pgz'; did you mean 'pgs'"),
        (("report", "--solvers", "pgs", "stak(n=8)"), "unknown case 'stak'"),
        (("report", "no/such.npz"), "no such file"),
        (("report", "stak(n=8)"), "did you mean"),
        (("report", "--levels", "0"), "level is 0;"),
        (("report", "--budgets", "-4"), "budget is -4"),
        (("report", "--repeats", "0"), "repeats is 0"),
        (("report", "--time-limit", "-1"), "time_limit is -1"),
        (("report", "--orders", "sideways"), "sideways"),
        (("report", "a.jsonl", "b.npz"), "shown alone"),
        (("report", "missing.jsonl"), "cannot read"),
        (("solve", "stack(n=4)", "--solver", "nobody"), "unknown solver 'nobody'"),
        (("solve", "stack(n=4)", "--solver", "pgs", "--tol", "-1"), "tol"),
        (("solve", "stack(n=4)", "--solver", "pgs", "--max-iter", "-1"), "max_iter"),
        (("solve", "stack(n=4)", "--solver", "direct", "--order", "reverse"), "order"),
        (("solve", "stack(n=4)", "--solver", "pgs", "--output", "no/such/folder.npz"), "cannot write"),
        (("check", "nothing.npz"), "no such file"),
        (("report", "--levels", "many"), "not a list of numbers"),
        (("report", "--campaign", "--seeds", "9:3"), "whole numbers with A < B"),
        (("report", "--time-budgets", "0"), "time budget 0.0 must be"),
        (("report", "stack(n=4)", "--seeds", "3"), "--seeds has no effect without --campaign"),
        (("report", "stack(n=4)", "--steps", "3"), "--steps has no effect without a MODEL.xml"),
        (("report", "stack(n=4)", "--pass-limit", "3"), "--pass-limit has no effect without a sequence"),
        (("report", "stack(n=4)", "--solvers", "direct", "--budgets", "3"), "--budgets has no effect"),
        (("report", "stack(n=4)", "--solvers", "direct", "--orders", "reverse"), "--orders has no effect"),
        (("report", "--campaign", "--time-limit", "3"), "--time-limit has no effect with --campaign"),
        (("report", "a.jsonl", "--levels", "1e-3"), "--levels has no effect where records are shown again"),
        (("report", "stack(n=4)", "--solvers", "pgs", "--memory", "3"), "--memory has no effect"),
        (("run", "stack", "--skip", "3"), "--skip has no effect without --record"),
        (
            ("record", "a.xml", "--out", "o", "--seed", "3", "--controls", "zero"),
            "--seed has no effect without --controls random",
        ),
        (
            ("report", "a.xml", "--seed", "3", "--controls", "zero"),
            "--seed has no effect without --controls random",
        ),
        (("report", "stack(n=4)", "--seed", "3"), "--seed has no effect without a MODEL.xml"),
        (("check", ""), "an empty argument"),
        (("report", "stack(n=4)", "--out", ""), "an empty argument"),
        (("nonsense",), "unknown command 'nonsense'"),
        (("slove", "stack(n=4)"), "did you mean 'solve'"),
        (("run", "stack", "--set", "m=3"), "unknown parameter 'm' of scene 'stack'"),
        (("report", "random_spd", "--campaign", "--seeds", "0:1000000000000"), "1000000000000 seeds"),
        (("solve", "random_spd(n=10000000)"), "not enough memory"),  # 8e14 bytes
        *(
            (("report", "stack(n=4)", "--campaign", "--workers", n), f"workers is {n}")
            for n in (0, -2, 1_000_000_000)
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(lavender, words, sign):
    code, out, err = lavender(*words)
    assert code == 2
    assert sign in err
    assert "Traceback" not in err + out


def test_the_time_of_a_solve_holds_no_loading_of_modules():
    code = (
        "import sys, lavender; s = sys.modules['lavender.solving.solve']; real = s.solve\n"
        "def watched(*args, **more):\n    print('scipy.sparse' in sys.modules)\n    return real(*args, **more)\n"
        "s.solve = watched\nfrom lavender.cli import main; main(['solve', 'stack(n=3)', '--solver', 'jacobi'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("True\n")


def test_a_model_and_the_folder_of_a_report_are_no_problems_and_the_way_on_is_told(lavender, tmp_path):
    model, folder = tmp_path / "model.xml", tmp_path / "reported"
    model.write_text("<mujoco/>")
    folder.mkdir()
    (folder / "records.jsonl").write_text("")
    code, _, err = lavender("solve", model)
    assert (code, err.count("\n")) == (2, 1) and "`lavender record` writes such files" in err
    code, _, err = lavender("report", folder)
    assert code == 2 and f"{folder / 'records.jsonl'} shows its report again" in err


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 broken", b"\x89HDF broken"])
def test_a_broken_file_is_named(lavender, tmp_path, content):
    for suffix in (".npz", ".hdf5"):
        bad = tmp_path / f"bad{suffix}"
        bad.write_bytes(content)
        code, _, err = lavender("solve", bad, "--solver", "pgs")
        assert code == 2
        assert "bad" in err
        assert err.count("\n") == 1


def test_an_unwritable_report_is_refused_before_anything_is_solved(lavender, path, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "run", None)  # calling it would be a TypeError
    (tmp_path / "file").write_text("")
    code, _, err = lavender("report", path, "--out", tmp_path / "file" / "out")
    assert code == 2
    assert "cannot write" in err


def test_help_is_quick_and_names_every_command():
    code = "import sys, lavender.cli as c\ntry: c.main(['--help'])\nfinally: print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name in ("report", "bench", "check", "solve", "solvers"):
        assert name in done.stdout
    # What takes time to load is loaded by the command that needs it.
    assert (
        set(done.stderr.split()) & {"matplotlib", "h5py", "qpsolvers", "pandas", "rich.table", "jinja2"}
        == set()
    )


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_keeps_the_records_and_writes_the_page(tmp_path):
    # A problem that nothing solves in the time: every run to a level takes its limit.
    out = tmp_path / "out"
    a = np.array([[1.0, -1.0], [-1.0, 1.0]])
    n = 300
    big = np.kron(np.eye(n), a) + 1e-9 * np.eye(2 * n)
    io.save(lv.Problem.lcp(big, np.random.default_rng(0).standard_normal(2 * n)), tmp_path / "hard.npz")
    io.save(stack(8), tmp_path / "easy.npz")
    command = [sys.executable, "-m", "lavender.cli", "report", tmp_path / "easy.npz", tmp_path / "hard.npz"]
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
    assert any(r["kind"] == "record" and r["case"] == "easy" for r in kept)


def test_campaigns_over_parts_of_the_seeds_are_one_when_put_together(lavender, tmp_path):
    more = ("--solvers", "pgs", "--levels", "1e-3", "--budgets", "4", "--workers", 1)
    parts = []
    for name, seeds in (("a", "2"), ("b", "2:4")):
        code, *_ = lavender(
            "report", "--campaign", "granular(n=2)", "--seeds", seeds, *more, "--out", tmp_path / name
        )
        assert code == 0
        parts.append((tmp_path / name / "records.jsonl").read_text())
    (tmp_path / "all.jsonl").write_text("".join(parts))
    code, out, _ = lavender("report", tmp_path / "all.jsonl", "--out", tmp_path / "all")
    assert code == 0
    assert "4 cases" in (tmp_path / "all" / "index.html").read_text()
    assert "100.0 %" in out


def test_a_recorded_scene_is_reported_as_a_sequence(lavender, tmp_path):
    folder = tmp_path / "steps"
    code, out, _ = lavender("run", "stack", "--steps", 5, "--skip", 1, "--record", folder)
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
        "--levels",
        "1e-1",
    )
    code, out, _ = lavender(*words, "--no-figures", "--repeats", 1)
    assert code == 0
    assert "it solves the 4 steps of steps in" in out
    code, out, _ = lavender(*words, "--no-figures", "--repeats", 1, "--compare", "lavender-report")
    assert code == 0
    assert "steps of sequences are not compared" in out and "nothing beyond noise" not in out
    assert (
        "| sequential_impulses | 4 iterations |" in (tmp_path / "here/lavender-report/summary.md").read_text()
    )
    code, _, err = lavender("run", "stack", "--steps", 5, "--record", folder)
    assert (code, "steps of two recordings" in err) == (2, True)
    assert lavender("run", "stack", "--steps", 3, "--record", folder, "--replace")[0] == 0
    assert len(list(folder.glob("*.npz"))) == 3  # none of the four is left
    assert lavender("run", "no such scene")[0] == 2
    assert lavender("report", "--sequence")[0] == 2
    assert lavender("report", "--sequence", folder, "--compare", "nowhere")[0] == 2


def test_the_recommendation_comes_first_and_tables_on_request(lavender, path, tmp_path):
    words = ("report", path, "stack(n=8)", *QUICK[:-1], "--out", tmp_path / "out", "--no-figures")
    code, out, _ = lavender(*words)
    assert code == 0
    said, _, rest = out.strip().partition("\n    lv.solve(problem, ")
    assert said.startswith("Use ") and "\n" not in said  # in a pipe a sentence is a line
    assert "to 1e-6" in rest and "CONVERGED" not in out and "By structure" not in out
    assert len(out.splitlines()) <= 25
    code, out, _ = lavender(*words, "--tables")
    assert "CONVERGED" in out and "By structure" in out
    n = len(bench.read(tmp_path / "out"))
    plain = len([r for r in bench.read(tmp_path / "out") if not r.turns])
    assert f"{n} of {n} runs reused of 20" in out
    code, out, _ = lavender(*words, "--fresh")
    assert "reused" not in out
    again = [r for r in bench.read(tmp_path / "out") if not r.turns]
    assert len(again) == plain  # made again, they stand for the earlier ones


def test_nothing_is_cut_off_in_a_pipe(path, tmp_path):
    long = tmp_path / ("a" * 100 + ".npz")
    io.save(stack(8), long)
    words = [
        sys.executable,
        "-m",
        "lavender",
        "report",
        long,
        "--solvers",
        "sequential_impulses,pgs",
        *QUICK,
        "--tables",
    ]
    done = subprocess.run(
        [*map(str, words), "--out", tmp_path / "o"], capture_output=True, text=True, check=True
    )
    assert "…" not in done.stdout
    assert "a" * 100 in done.stdout.replace("\n", "")
    assert f"page: {tmp_path / 'o' / 'index.html'}\n" in done.stdout


def test_a_named_file_that_does_not_load_touches_nothing_and_one_in_a_folder_is_counted(
    lavender, path, tmp_path
):
    folder = tmp_path / "problems"
    folder.mkdir()
    io.save(stack(8), folder / "good.npz")
    broken = folder / "broken.npz"
    broken.write_bytes(path.read_bytes()[:100])
    more = ("--solvers", "pgs", *QUICK[:-1], "--out", tmp_path / "out")
    code, _, err = lavender("report", folder / "good.npz", broken, *more)
    assert code == cli.EXIT_BAD_INPUT
    assert "broken.npz" in err
    assert not (tmp_path / "out" / "index.html").exists()
    code, _, _ = lavender("report", folder, *more[:-1], tmp_path / "out")
    assert code == cli.EXIT_UNMET
    assert (tmp_path / "out" / "index.html").exists()
    assert lavender("check", folder, "--solvers", "pgs")[0] == cli.EXIT_UNMET
    assert lavender("check", broken, "--solvers", "pgs")[0] == cli.EXIT_BAD_INPUT
    assert lavender("report", "--campaign", broken, *more[:-1], tmp_path / "c")[0] == cli.EXIT_BAD_INPUT


def test_solve_says_by_its_exit_code_what_came_of_it(lavender, path, tmp_path):
    assert lavender("solve", path)[0] == 0  # auto
    assert "auto: CONVERGED" in lavender("solve", path)[1]
    assert "8 rows" in lavender("solve", "stack(n=8)", "--solver", "direct")[1]
    assert lavender("solve", path, "--solver", "pgs", "--max-iter", 1)[0] == cli.EXIT_UNMET
    assert (
        lavender("solve", path, "--solver", "pgs", "--tol", 0, "--max-iter", 1)[0] == 0
    )  # a budget, as asked
    impossible = lv.Problem.lcp(np.array([[1.0, -1.0], [-1.0, 1.0]]), np.ones(2))
    io.save(impossible, tmp_path / "impossible.npz")
    code, out, _ = lavender("solve", tmp_path / "impossible.npz", "--solver", "direct")
    assert ("INFEASIBLE" in out, code) == (True, cli.EXIT_INFEASIBLE)
    # An impulse that ran away is accepted nowhere, nor is one that moves where nothing was to do.
    away = lv.Problem.linear([[1.0, 1.0], [1.0, 1.0]], [1.0, 2.0], guess=[1e17, -1e17])
    idle = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [-1.0, -1.0], guess=[1e6, 0.0])
    for wrong, more in ((away, ()), (idle, ("--max-iter", 0))):
        io.save(wrong, tmp_path / "wrong.npz")
        assert lavender("solve", tmp_path / "wrong.npz", "--solver", "pgs", *more)[0] == cli.EXIT_UNMET


def test_an_answer_is_not_written_over_its_problem(lavender, path):
    before = path.read_bytes()
    link = path.with_name("link.npz")
    link.symlink_to(path)
    for output in (path, link):
        assert lavender("solve", path, "--output", output)[0] == cli.EXIT_BAD_INPUT
        assert path.read_bytes() == before


def test_the_nearest_name_is_found_whatever_its_case(lavender):
    assert "did you mean 'pgs'" in lavender("solve", "stack(n=4)", "--solver", "PGS")[2]
    with pytest.raises(lv.UnknownName, match="did you mean 'max_iter'"):
        lv.solve(stack(8), "pgs", max_iters=3)


def test_cases_lists_families_with_parameters_and_reasons(lavender):
    from lavender.lab.suite.case import FAMILIES

    code, out, _ = lavender("cases")
    assert code == 0
    for name, family in FAMILIES.items():
        assert f"\n{name}(" in "\n" + out
        assert family.summary in out
    code, out, _ = lavender("cases", "hang")
    assert "hang(n=" in out
    assert "pyramid(" not in out
    assert "8 rows" in lavender("cases", "toy_stack", "--size")[1]
    assert lavender("cases", "nosuchthing")[0] == 2


# -- what nobody should ask for ---------------------------------------------------------------------------


def test_memory_that_ends_elsewhere_is_told_in_a_line(lavender, path, monkeypatch):
    def none(*_, **__):
        raise MemoryError

    monkeypatch.setattr(bench, "resolve", none)
    code, _, err = lavender("solve", path)
    assert code == 2
    assert "not enough memory" in err


def long_file(path, start=b""):
    """A file of ten gigabytes that takes no room."""
    with path.open("wb") as stream:
        stream.write(start)
        stream.truncate(10**10)
    return path


def test_files_of_ten_gigabytes_are_refused_by_their_size(lavender, tmp_path):
    for words in (
        ("report", long_file(tmp_path / "records.jsonl")),
        ("report", tmp_path / "records.jsonl", "--out", tmp_path / "out"),
        ("view", long_file(tmp_path / "a.film", b"LAVENDERFILM"), "--no-browser"),
    ):
        code, out, err = lavender(*words)
        assert code == 2
        assert "10000000000 bytes" in out + err
    with pytest.raises(lv.InputError, match="10000000000 bytes"):
        lv.Snapshot.load(tmp_path / "a.film")


def test_a_line_without_end_is_refused(tmp_path):
    path = tmp_path / "records.jsonl"
    with path.open("wb") as stream:
        stream.truncate(2**27)
    with pytest.raises(lv.InputError, match="has a line of more than"):
        bench.read(path)


@pytest.mark.parametrize("tail", [b"", b"torn", b"x" * 70_000, b"x" * 65_536])
@pytest.mark.parametrize("reasons", [[], ["why"] * 3, ["y" * 65_400, "why"], ["y" * 70_000]])
def test_a_torn_line_is_cut_wherever_it_begins(tmp_path, reasons, tail):
    entries = [to_json(Skip("run", f"case {i}", "", reason)) for i, reason in enumerate(reasons)]
    head = b"".join(json.dumps(entry).encode() + b"\n" for entry in entries)
    (tmp_path / "a.jsonl").write_bytes(head + tail)
    with bench.Store(tmp_path / "a.jsonl") as store:
        assert [skip.reason for skip in store.records.skips] == reasons
    assert (tmp_path / "a.jsonl").read_bytes() == head


INTERRUPT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == os.environ["INTERRUPTED"]:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder())
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="signals of POSIX")
@pytest.mark.parametrize(
    ("way", "module"),
    [
        (("-m", "lavender"), "numpy"),
        (("-m", "lavender"), "lavender.cli.solvers"),
        (("-m", "lavender.cli"), "lavender.problem"),
        (("-m", "lavender.cli"), "lavender.cli.options"),
    ],
)
def test_ctrl_c_while_the_command_is_imported_ends_with_130(way, module, tmp_path):
    """The signal comes where the import of a module begins, whatever the machine's speed."""
    (tmp_path / "sitecustomize.py").write_text(INTERRUPT)  # which Python imports first
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "INTERRUPTED": module}
    command = [sys.executable, *way, "solvers"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 130
    assert "lavender: stopped" in done.stderr
    assert "Traceback" not in done.stderr


WORKER = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "joblib.hashing":
            os.killpg(0, signal.SIGINT)
if "popen_loky" in " ".join(sys.orig_argv):
    sys.meta_path.insert(0, Finder())
"""


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="signals of POSIX")
def test_ctrl_c_while_workers_of_a_campaign_start_is_answered_by_the_command_alone(tmp_path):
    """The terminal sends the signal to all of its processes, where the first worker begins its imports."""
    (tmp_path / "sitecustomize.py").write_text(WORKER)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    command = [
        sys.executable,
        "-m",
        "lavender",
        "report",
        "--campaign",
        "granular(n=2)",
        "--seeds",
        "20",
    ]
    command += ["--workers", "2", "--solvers", "pgs", "--no-figures", "--out", str(tmp_path / "out")]
    more = {"env": environment, "capture_output": True, "text": True, "timeout": 600, "check": False}
    done = subprocess.run(command, start_new_session=True, **more)
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert "continues from here" in done.stdout


@pytest.mark.parametrize("columns", ["0", "1", "19"])
@pytest.mark.parametrize(
    "words", [("solvers",), ("cases", "stack"), ("check", "stack(n=4)", "--solvers", "pgs")]
)
def test_names_are_whole_in_the_narrowest_terminal(lavender, monkeypatch, words, columns):
    wide = lavender(*words)[1]
    monkeypatch.setenv("COLUMNS", columns)
    code, narrow, _ = lavender(*words)
    assert code == 0
    names = re.findall(r"^\w+", wide, re.MULTILINE)
    assert names and set(names) <= set(re.findall(r"^\w+", narrow, re.MULTILINE))


@pytest.mark.skipif(os.name == "nt", reason="no folder in use can be removed")
@pytest.mark.parametrize("words", [("report", "stack(n=4)"), ("report", "F.npz")])
def test_a_working_directory_that_is_gone_is_named(lavender, tmp_path, words):
    (tmp_path / "here").rmdir()
    code, _, said = lavender(*words)
    assert code == cli.EXIT_BAD_INPUT
    assert "working directory is gone" in said


def test_another_program_keeps_its_own_ctrl_c():
    words = "import signal, lavender, lavender.cli; assert signal.getsignal(2) is signal.default_int_handler"
    subprocess.run([sys.executable, "-c", words, "lavender"], check=True, timeout=600)


MODEL = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/>
<body pos="0 0 {height}"><freejoint/><geom type="{kind}" size=".1 .1 .1"/></body></worldbody></mujoco>"""


def test_models_of_one_file_name_are_kept_apart(lavender, tmp_path):
    pytest.importorskip("mujoco")
    for name, kind in (("h1", "box"), ("g1", "sphere")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.xml").write_text(MODEL.format(height=0.1, kind=kind))
    words = (
        "--steps",
        20,
        "--every",
        5,
        "--solvers",
        "auto",
        "--repeats",
        1,
        "--no-figures",
        "--out",
        tmp_path / "o",
    )
    models = [tmp_path / name / "scene.xml" for name in ("h1", "g1")]
    assert lavender("report", *models, *words)[0] == 0
    found = bench.read(tmp_path / "o")
    rows = {info.sequence: info.rows for info in found.cases.values()}
    assert set(rows) == {"h1-scene", "g1-scene"}
    assert rows["h1-scene"] > rows["g1-scene"]  # a box has more contacts than a sphere
    folders = {p.name for p in (tmp_path / "o" / "recorded").iterdir()}
    assert lavender("report", *models, *words)[0] == 0
    assert {p.name for p in (tmp_path / "o" / "recorded").iterdir()} == folders


def test_what_is_left_out_stands_beside_what_is_left(lavender, tmp_path, monkeypatch):
    """Steps that could not be recorded: on the page, in the summary, the terminal, the files, and the exit code."""
    recording = pytest.importorskip("lavender.io.recording")
    pytest.importorskip("mujoco")
    (tmp_path / "box.xml").write_text(MODEL.format(height=0.1, kind="box"))
    true = recording.adapter.from_mujoco

    def some(model, data, name):
        if int(name.split()[1]) % 15 == 0:
            raise lv.CapabilityError(f"{name} is of another <problem>")
        return true(model, data, name=name)

    monkeypatch.setattr(recording.adapter, "from_mujoco", some)
    more = ("--solvers", "auto", "pgs", "--repeats", 1, "--time-limit", 0.02)
    more += ("--no-figures", "--tables", "--paper", "--out", tmp_path / "o")
    model = (tmp_path / "box.xml", "--steps", 45)
    for _ in range(2):  # recorded, and found recorded
        code, out, _ = lavender("report", *model, *more)
        assert code == cli.EXIT_UNMET
        summary, page = ((tmp_path / "o" / name).read_text() for name in ("summary.md", "index.html"))
        (name,) = {info.sequence for info in bench.read(tmp_path / "o").cases.values()}
        for said in (out, summary, page):
            assert f"steps of {name} (3 left out)" in " ".join(said.split())  # the headline
            assert said.count("(3 left out)") >= 3  # and the tables
            assert f"3 steps of {name}" in said
        assert "step 15 is of another <problem>" in " ".join(out.split())
        assert all(f"step {k} is of another &lt;problem&gt;" in page for k in (15, 30, 45))
        assert "6 problems (3 left out)" in (tmp_path / "o" / "paper" / "method.tex").read_text()
        skips = json.loads((tmp_path / "o" / "records.json").read_text())["skips"]
        assert [(s["sequence"], s["solver"]) for s in skips if "of another" in s["reason"]] == [
            (name, "")
        ] * 3
    assert lavender("report", tmp_path / "o" / "records.jsonl", *more[7:])[0] == 0  # shown again
    (folder,) = (tmp_path / "o" / "recorded").iterdir()
    code, out, _ = lavender(
        "report", "--campaign", folder, "--solvers", "pgs", "--workers", 1, "--out", tmp_path / "c"
    )
    assert code == cli.EXIT_UNMET and "left out (1 of 3)" in out
    assert lavender("check", folder, "--solvers", "pgs")[0] == cli.EXIT_UNMET
    monkeypatch.setattr(recording.adapter, "from_mujoco", true)
    code, out, _ = lavender("report", *model, *more, "--fresh")
    assert (code, "left out" in out) == (0, False)


def test_a_model_is_recorded_again_when_what_it_is_made_of_has_changed(lavender, tmp_path, monkeypatch):
    mujoco, recording = pytest.importorskip("mujoco"), pytest.importorskip("lavender.io.recording")
    if not hasattr(mujoco, "mju_getXMLDependencies"):
        pytest.skip("this MuJoCo does not tell what a model includes")
    model, part, played = (tmp_path / name for name in ("scene.xml", "part.xml", "played.npy"))
    body = MODEL.format(height=0.1, kind="box")
    part.write_text(
        f"<mujocoinclude>{body[body.index('<worldbody>') : body.index('</mujoco>')]}</mujocoinclude>"
    )
    model.write_text('<mujoco><include file="part.xml"/></mujoco>')
    np.save(played, np.zeros((1, 0)))
    calls, kept = [], recording.record_file
    words = [
        "report",
        model,
        "--controls",
        played,
        "--steps",
        10,
        "--every",
        5,
        "--solvers",
        "auto",
        "--no-figures",
    ]

    def recorded(*given, **more):
        calls.append(given)
        return kept(*given, **more)

    def stopped(*given, **more):
        recorded(*given, **more)
        raise KeyboardInterrupt

    monkeypatch.setattr(recording, "record_file", recorded)
    assert (lavender(*words)[0], lavender(*words)[0], len(calls)) == (0, 0, 1)
    for count, changed in ((2, part), (3, played)):
        os.utime(changed, (1e9, 1e9 + count))
        assert (lavender(*words)[0], len(calls)) == (0, count)
    monkeypatch.setattr(recording, "record_file", stopped)  # on the way, for all that anybody knows
    assert lavender(*words, "--fresh")[0] == cli.EXIT_INTERRUPTED
    monkeypatch.setattr(recording, "record_file", recorded)
    assert (lavender(*words)[0], len(calls)) == (0, 5)


def test_doctor_tells_what_looks_wrong_in_a_problem(lavender, path, tmp_path):
    assert lavender("doctor", path)[:2] == (0, "1 looked at, none suspicious\n")
    code, out, _ = lavender("doctor", path, "duplicated(k=3)")
    assert (code, out.splitlines()[-1]) == (1, "2 looked at, 1 suspicious")
    assert out.startswith("duplicated(k=3): duplicate rows: 2 contacts")
    assert json.loads(lavender("doctor", "duplicated(k=3)", "--json")[1])["duplicated(k=3)"][0]["blocks"] == [
        1,
        2,
    ]
    assert lavender("doctor", tmp_path / "none.npz")[0] == 2


def test_a_report_tells_what_looks_wrong(lavender, tmp_path):
    code, out, _ = lavender(
        "report", "duplicated(k=3)", "--solvers", "pgs", *QUICK, "--out", tmp_path / "out"
    )
    assert code == 0
    told = "duplicate rows: 2 contacts stand where another of the pair does"
    assert told in out
    assert told in (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert bench.read(tmp_path / "out").cases["duplicated(k=3)"].suspicions[0].startswith(told)


def _must_not_begin(*_, **__):
    raise AssertionError("the work began")


@pytest.mark.parametrize(
    ("words", "work"),
    [
        ("run stack --plot {}/x.svg", "lavender.sim.engine.Simulation.step"),
        ("run stack --trace {}/x.csv", "lavender.sim.engine.Simulation.step"),
        ("run stack --film {}/x.film", "lavender.sim.engine.Simulation.step"),
        ("run stack --film {}/x.gif", "lavender.sim.engine.Simulation.step"),
        ("solve toy_stack --output {}/x.npz", "lavender.lab.bench.resolve"),
        ("phenomena lift --out {}/x.json", "lavender.cli.phenomena.run"),
        ("web build {}/x.wasm", "lavender.sim.web.compile.build"),
        ("export c {}/sub", "lavender.out.library.source"),
        ("export npm {}/sub", "lavender.out.library.source"),
        ("web page {}/sub", "lavender.sim.web.pages.module"),
        ("report toy_stack --out {}/sub", "lavender.lab.bench.resolve"),
        ("report toy_stack --campaign --out {}/sub", "lavender.lab.bench.resolve"),
        ("run stack --record {}/sub", "lavender.sim.engine.Simulation.step"),
    ],
)
def test_what_cannot_be_written_is_refused_before_the_work(lavender, monkeypatch, tmp_path, words, work):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(work, _must_not_begin)
    for place in ("file",) if "/sub" in words else ("file", "absent"):  # a folder is made, with its parents
        code, out, err = lavender(*words.format(tmp_path / place).split())
        assert (code, out) == (cli.EXIT_BAD_INPUT, "")
        assert re.search(r"^lavender: cannot write .*; (make|give) ", err)
        assert str(tmp_path / place) in err


def test_a_format_that_nobody_writes_is_refused_before_the_work(lavender, monkeypatch):
    monkeypatch.setattr("lavender.sim.engine.Simulation.step", _must_not_begin)
    code, _, err = lavender("run", "stack", "--plot", "x.plot")
    assert code == cli.EXIT_BAD_INPUT and "suffix" in err and "svg" in err
    monkeypatch.setattr("lavender.sim.engine.picture.which", lambda name: None)
    code, _, err = lavender("run", "stack", "--film", "x.mp4")
    assert code == cli.EXIT_BAD_INPUT and "ffmpeg" in err


@pytest.mark.parametrize("words", ["--workers 2", "--workers 1", "--solvers pgs --budgets 2 --no-figures"])
def test_a_working_directory_that_is_gone_is_said(lavender, path, tmp_path, words):
    os.rmdir(os.getcwd())
    words = words if "--solvers" in words else f"--campaign --solvers pgs --no-figures {words}"
    code, _, err = lavender("report", path, *words.split(), "--out", tmp_path / "out")
    assert code == 0 or (code == cli.EXIT_BAD_INPUT and "the working directory is gone" in err)
    for words in ("run stack --steps 2 --record r", "export c c", "solve toy_stack --output x.npz"):
        code, _, err = lavender(*words.split())
        assert code == cli.EXIT_BAD_INPUT and "the working directory is gone" in err


def _unread(*words):
    """Exit code and words of errors of a command whose output nobody reads."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "lavender", *map(str, words)]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    return done.returncode, done.stderr


@pytest.mark.parametrize("words", ["cases", "solvers", "--help", "run --help", "explain toy_stack"])
def test_a_pipe_that_nobody_reads_ends_a_command_quietly(words):
    assert _unread(*words.split()) == (0, "")


def test_files_are_written_whoever_reads(path, tmp_path):
    made = [tmp_path / name for name in ("x.csv", "x.svg", "x.npz")]
    words = ("run", "stack", "--steps", 3, "--trace", made[0], "--plot", made[1])
    assert _unread(*words) == (0, "")
    assert _unread("solve", path, "--output", made[2]) == (0, "")
    assert _unread("reference", path) == (0, "")
    assert all(p.is_file() for p in (*made, path.with_name(path.name + ".reference")))


def says(status, **more):
    return lv.Claim(status, 1, **more)


def test_the_command_of_a_check_fails_on_a_liar(plug_in, capsys):
    from lavender.cli import main

    def run(_, impulse):
        impulse[:] = 1000.0
        return says(lv.Status.CONVERGED)

    liar = plug_in(run, operators={"matrix"})
    with pytest.raises(SystemExit) as end:
        main(["check", "granular(n=3)", "--solvers", liar])
    assert end.value.code == 1
    assert "1 claims are contradicted" in capsys.readouterr().out


LAWS = ("coulomb", "cone")


def free(seed, contacts=3, friction="coulomb", mu=None):
    return dragged(seed, contacts, mu, friction=friction)


def on_rows(seed, friction="coulomb", **sizes):
    """Bodies with joints and contacts, an ellipse each."""
    base = random_ellipses(seed, friction, **sizes)
    return replace(base, compliance=base.compliance + 0.3)


FORMS = {"generalized": free, "matrix": lambda *a, **k: as_matrix(free(*a, **k)), "rows": on_rows}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("law", LAWS)
def test_every_door_gives_the_same(form, law, tmp_path):
    problem = FORMS[form](1, friction=law)
    found = lv.solve(problem, tol=1e-9)
    assert found.success
    assert lv.solve_many([problem, problem], tol=1e-9)[1].impulse.tobytes() == found.impulse.tobytes()
    prepared = lv.prepare(problem, "newton")
    first = prepared.solve(tol=1e-9).impulse
    again = prepared.solve(replace(problem, name="again"), impulse=first, tol=1e-8)
    assert again.success
    np.testing.assert_allclose(again.impulse, first, rtol=1e-6, atol=1e-9)
    assert lv.solve(problem, "newton", impulse=found.impulse, tol=1e-8, max_iter=1).success
    path = tmp_path / "ellipse.npz"
    problem.save(path)
    back = lv.load(path)
    assert back == problem
    assert (
        lv.residual(back, found.impulse).relative == found.residual.relative
    )  # of the numbers that were handed out
    with pytest.raises(SystemExit) as ended:
        main(["reference", str(path)])
    assert ended.value.code in (0, None)
    best = lv.solve(problem, tol=1e-12)
    assert best.motion_error(best).rows == 0.0
    error = lv.motion_error(problem, 1.1 * found.impulse)
    assert error.rows > 1e-3
    near = lv.motion_error(problem, found.impulse)
    assert near.rows < 1e-6
    if law == "cone":
        assert near.bound < 1e-6 * error.bound
        assert lv.cross_check(problem, ["newton", "admm", "anderson"]).ok
    np.testing.assert_array_equal(problem.carry(found), found.impulse)
    single = np.float32(found.impulse)
    assert lv.residual(problem, single, "float32").verdict == "at its floor"
    assert lv.residual(problem, 1.001 * single, "float32").verdict == "stopped early"
    assert str(lv.explain(problem))


def robot(seed, m=12, n=10, soft=True, number=np.float64):
    """Bounded rows on a random forest, as soft as those of engines (2 to 20 % of the diagonal of A)."""
    rng = np.random.default_rng(seed)
    mass = tree_mass(rng, random_tree(rng, n))
    jac = rng.normal(size=(m, n)) * (rng.random((m, n)) < 0.6)
    jac[:, 0] += 0.3
    compliance = rng.uniform(0.02, 0.2, m) * np.einsum("ij,ij->i", jac, np.linalg.solve(mass, jac.T).T)
    upper = np.where(rng.random(m) < 0.3, rng.uniform(0.05, 0.5, m), np.inf)
    return lv.Problem.from_jacobian(
        jac.astype(number), mass.astype(number), rng.normal(size=n).astype(number), target=rng.uniform(-0.1, 0.1, m),
        cones=lv.Cones.bounded(np.zeros(m), upper), compliance=compliance if soft else None, name=f"robot {seed}",
    )  # fmt: skip


def test_check_judges_a_stored_answer_for_the_precision_it_was_made_in(tmp_path):
    problem = robot(2)
    exact = lv.solve(problem, tol=1e-11).impulse
    for name, impulse in (("done", exact.astype(np.float32)), ("early", 0.9 * exact)):
        lv.io.save(problem, tmp_path / f"{name}.npz", impulse=impulse)
    told = ["--solvers", "pgs", "--precision", "float32"]
    done = CliRunner().invoke(cli.cli, ["check", str(tmp_path / "done.npz"), *told])
    assert done.exit_code == 0, done.output
    assert "stored answer: at its floor of float32" in " ".join(done.output.split())
    early = CliRunner().invoke(cli.cli, ["check", str(tmp_path / "early.npz"), *told])
    assert early.exit_code == 1
    assert "stored answer: stopped early, " in early.output
    # Without the option the precision is the problem's, and the exit code that of the claims.
    assert CliRunner().invoke(cli.cli, ["check", str(tmp_path / "early.npz"), *told[:2]]).exit_code == 0
    lv.io.save(problem, tmp_path / "none.npz")
    none = CliRunner().invoke(cli.cli, ["check", str(tmp_path / "none.npz"), *told])
    assert isinstance(none.exception, lv.InputError)
    assert "no file holds an answer" in str(none.exception)
    other = CliRunner().invoke(cli.cli, ["check", str(tmp_path / "done.npz"), "--precision", "half"])
    assert other.exit_code == 2
    assert "'half' is not one of 'float64', 'float32'" in other.output
