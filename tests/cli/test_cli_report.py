"""`lavender report`, `phenomena`, `prove`, `explain`: what measures and examines from the command line."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from lavender import bench
from lavender import out as export
from lavender.base.errors import InputError
from lavender.cli import cli, main
from lavender.cli.bench import mujoco
from lavender.lab.bench import simulators
from lavender.lab.phenomena import PHENOMENA
from lavender.out import vectors

MODEL = """<mujoco><option timestep="0.004"/><worldbody><geom type="plane" size="0 0 1"/>
  <body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/>
    <body><joint name="arm" range="-30 30" limited="true"/>
      <geom type="capsule" fromto="0 0 .1 .3 0 .1" size=".03"/></body>
  </body></worldbody><actuator><motor joint="arm" gear="2"/></actuator></mujoco>"""


def test_the_command_writes_a_table_and_says_what_it_left_out(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(MODEL)
    (tmp_path / "torn.xml").write_text("<mujoco><worldbody>")
    out = tmp_path / "steps.jsonl"
    words = [
        str(tmp_path / "arm.xml"),
        str(tmp_path / "torn.xml"),
        "--steps",
        "2",
        "--warm",
        "40",
        "--out",
        str(out),
    ]
    done = CliRunner().invoke(mujoco, words)
    assert done.exit_code == 1, done.output
    assert done.output.count("torn.xml: left out") == 2  # at once, and below the tables
    assert "2 of 2 solved" in done.output
    assert "| momentum |" in done.output
    assert "ours, median" in done.output.split("| kinetic energy |")[1]  # the second table
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert "mujoco" in lines[0]
    assert {line["model"] for line in lines[1:]} == {"arm"}
    assert sum("kernel" in line for line in lines[1:]) == 2
    assert max(line["residual"] for line in lines[1:]) <= simulators.TARGET


def test_without_a_problem_nothing_is_printed_but_why(tmp_path):
    pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(MODEL)
    words = [str(tmp_path / "arm.xml"), "--steps", "0"]
    done = CliRunner().invoke(mujoco, words)
    assert isinstance(done.exception, InputError) and "no step of these models" in str(done.exception)
    for bad in (["--every", "0"], ["--warm", "-1"], ["--steps", "-1"]):
        assert CliRunner().invoke(mujoco, [*words, *bad]).exit_code == 2
    warm = CliRunner().invoke(mujoco, [*words, "--warm", "40"])
    assert warm.exit_code == 0 and "ours, median" in warm.output and "momentum" not in warm.output


def test_the_command_refuses_what_it_does_not_know(capsys):
    from lavender.cli import main

    with pytest.raises(SystemExit) as ended:
        main(["prove", "stack(n=2)", "--solver", "foo"])
    assert ended.value.code == 2 and "foo" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(["prove", "stack(n=64)", "--solver", "pgs"])
    assert "pgs: MAX_ITERATIONS" in capsys.readouterr().out or ended.value.code == 0


def test_the_command(tmp_path):
    out = tmp_path / "found.json"
    done = CliRunner().invoke(cli, ["phenomena", "lift", "--steppers", "impulses,avbd", "--out", str(out)])
    assert done.exit_code == 0
    assert "| impulses | 0 m, 2/2 |" in done.output
    told = json.loads(out.read_text())
    assert {r["engine"] for r in told["records"]} == {
        "impulses",
        "impulses 16x4",
        "impulses newton",
        "avbd",
        "avbd 16x4",
    }
    assert all(r["setting"] for r in told["records"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nothing"], "unknown phenomenon"),
        (["stick", "--set", "slope=3"], "0 to 0.99 is needed"),
        (["stick", "--set", "speed=3"], "speed"),
        (["stick", "--set", "slope"], "NAME=VALUE"),
        (["stick", "--steppers", "fast"], "unknown stepper"),
        (["stick", "--engines", "fast"], "unknown engine"),
        (["stick", "--steppers", "none"], "no stepper and no engine"),
        (["stick", "--out", "no/such/folder/x.json"], "is not there; make it first"),
    ],
)
def test_bad_words_end_with_one_line_and_status_2(words, said, capsys):
    from lavender.cli.entry import main

    with pytest.raises(SystemExit) as end:
        main(["phenomena", *words])
    assert end.value.code == 2
    assert said in capsys.readouterr().err


def test_the_list_tells_truths_without_running():
    done = CliRunner().invoke(cli, ["phenomena", "--list"])
    assert done.exit_code == 0
    for name, p in PHENOMENA.items():
        assert f"{name}: {p.title}" in done.output


def idle_problem():
    return lv.Problem.lcp(np.eye(3), [-1.0, -2.0, -1.0], name="flying apart")


def test_the_terminal_shows_speeds_on_request(tmp_path):
    args = [
        "report",
        "stack(n=8)",
        "--solvers",
        "pgs",
        "--levels",
        "1e-3",
        "--budgets",
        "4",
        "--repeats",
        "1",
    ]
    asked = CliRunner().invoke(cli, [*args, "--speed-levels", "1e-2", "1e-3", "--out", str(tmp_path / "a")])
    assert asked.exit_code == 0, asked.output
    assert "to 1e-3 m/s" in asked.output
    assert "to 1e-3 m/s" in asked.output
    plain = CliRunner().invoke(cli, [*args, "--out", str(tmp_path / "b")])
    assert "motion" not in plain.output


def test_references_are_written_beside_files_and_used(tmp_path, monkeypatch, capsys):
    problem = lv.suite.case("stack(n=8)").problem
    lv.io.save(problem, tmp_path / "pile.npz")
    with pytest.raises(SystemExit) as end:
        main(["reference", str(tmp_path)])
    assert end.value.code == 0
    assert (tmp_path / "pile.npz.reference").is_file()
    assert "auto" in capsys.readouterr().out
    used = []
    import lavender.lab.bench.running.runner as runner

    load = runner.load_reference
    monkeypatch.setattr(runner, "load_reference", lambda p, path: used.append(load(p, path)))
    plan = bench.Plan(levels=(1e-3,), budgets=(), repeats=1, orders=(), motion=True)
    found = bench.run([tmp_path], ["pgs"], plan)  # the folder holds one problem: a reference is none
    assert len(found.cases) == 1
    assert used[0].accepted


def test_nothing_solves_it_is_an_exit_code(tmp_path):
    lv.io.save(lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0]), tmp_path / "impossible.npz")
    for words, code in (([str(tmp_path / "impossible.npz")], 1), (["stack(n=4)"], 1)):
        with pytest.raises(SystemExit) as end:
            main(["reference", *words])
        assert end.value.code == code


def test_solving_what_has_nothing_to_do_is_no_failure(tmp_path, capsys):
    path = tmp_path / "idle.npz"
    lv.io.save(idle_problem(), path)
    with pytest.raises(SystemExit) as end:
        main(["solve", str(path), "--solver", "pgs"])
    assert end.value.code == 0
    assert "nothing to do" in capsys.readouterr().out


def test_the_command_shows_the_way_and_gives_it_as_data(capsys):
    with pytest.raises(SystemExit) as end:
        main(["explain", "stack(n=200)", "granularF(n=4)"])
    assert end.value.code in (0, None)
    shown = capsys.readouterr().out
    assert "newton is counted to take" in shown and "granularF(n=4)" in shown and "relaxation" in shown
    with pytest.raises(SystemExit):
        main(["explain", "stack(n=200)", "--json", "--tol", "1e-9"])
    plan = json.loads(capsys.readouterr().out)
    assert plan["tol"] == 1e-9 and plan["rows"] == 200 and plan["stages"][0]["solver"] == "anderson"
    with pytest.raises(SystemExit) as end:
        main(["explain", "stack(n=200)", "--tol", "0"])
    assert end.value.code == 2


def test_vectors_are_of_the_problems_that_the_report_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(export.library, "source", lambda: "of another test")
    rng = np.random.default_rng(0)
    b = rng.normal(size=(9, 9))
    mine = lv.Problem.lcp(b @ b.T + np.eye(9), np.ones(9))
    mine.save(tmp_path / "ring.npz")  # the name of a case of the suite, too
    records, out = tmp_path / "records.jsonl", tmp_path / "library"
    bench.run([tmp_path / "ring.npz"], ["direct"], bench.Plan(levels=(1e-6,), budgets=(), repeats=1), records)
    command = ["export", "c", str(out), "--for", str(records), "--solver", "direct"]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 0, done.output
    assert vectors.pack_problem(mine) in (out / "vectors.bin").read_bytes()
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    lv.Problem.lcp(2.0 * mine.dense(), np.ones(9)).save(tmp_path / "ring.npz")
    changed = CliRunner().invoke(cli, command)
    assert isinstance(changed.exception, lv.InputError) and "is another problem here" in str(
        changed.exception
    )
    mine.save(tmp_path / "ring.npz")
    before["vectors.bin"] = b"mine"
    (out / "vectors.bin").write_bytes(b"mine")
    (out / "chosen.h").unlink()
    del before["chosen.h"]
    refused = CliRunner().invoke(cli, command)
    assert isinstance(refused.exception, lv.InputError) and "--replace" in str(refused.exception)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
