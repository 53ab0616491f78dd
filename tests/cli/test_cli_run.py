"""`lavender run`, `web` and `record`: what steps an engine from the command line."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mujoco_scene import mj, scene

import lavender as lv
from lavender.base.errors import LavenderError
from lavender.cli import cli
from lavender.sim.engine import Film
from lavender.sim.web import compile as wasm
from lavender.sim.web import pages

PGS = 1e-6  # as in test_io_mujoco.py


def test_what_a_robot_does_not_feel_is_close_enough_and_the_threshold_is_the_users(tmp_path):
    """All but exact answers are above the floor of float64, which rounding alone sets."""
    model = mj.MjModel.from_xml_string(scene(solver="PGS").replace('"1e-15"', '"1e-12"'))
    found = lv.io.record(model, mj.MjData(model), tmp_path / "a", 30)
    assert found.above_floor > 10
    assert found.stopped == 0
    assert str(found).endswith(f"{found.above_floor} above their floor, 0 more than 1e-06 m/s off")
    strict = lv.io.record(model, mj.MjData(model), tmp_path / "b", 30, threshold=0.0)
    assert (strict.above_floor, strict.stopped) == (found.above_floor, found.above_floor)
    lines = [json.loads(line) for line in (tmp_path / "a" / "engine.jsonl").read_text().splitlines()]
    at = next(line for line in lines if line["verdict"] == "close enough")
    stored = lv.io.read(tmp_path / "a" / at["file"])
    for threshold, said in (
        (at["velocity"], "close enough"),
        (0.99 * at["velocity"], "stopped early"),
        (0.0, "stopped early"),
    ):
        judged = lv.residual(stored.problem, stored.impulse, threshold=threshold)
        assert (judged.verdict, judged.relative) == (said, at["relative"])
    for wrong in (-1.0, np.nan, "near"):
        with pytest.raises(lv.InputError, match="threshold"):
            lv.residual(stored.problem, stored.impulse, threshold=wrong)
        with pytest.raises(lv.InputError, match="threshold"):
            lv.io.record(model, mj.MjData(model), tmp_path / "c", 1, threshold=wrong)
    words = ["check", str(tmp_path / "a" / at["file"]), "--solvers", "auto", "--threshold"]
    near, strict = (CliRunner().invoke(cli, [*words, x]) for x in ("1e-6", "0"))
    assert (near.exit_code, strict.exit_code) == (0, 1)
    assert "1 of 1 above their floor, 0 also more than 1e-06 m/s off" in near.output
    assert "1 of 1 above their floor, 1 also more than 0 m/s off" in strict.output


def test_record_and_report_take_the_same_options_with_the_same_defaults():
    names = ("steps", "every", "control", "seed", "threshold")
    both = [{p.name: p for p in cli.get_command(None, name).params} for name in ("record", "report")]
    for name in names:
        one, two = (options[name] for options in both)
        assert (one.opts, one.default, one.type) == (two.opts, two.default, two.type)


def test_record_then_report_from_the_command_line(tmp_path):
    model = tmp_path / "scene.xml"
    model.write_text(scene())
    out = tmp_path / "steps"
    done = CliRunner().invoke(
        cli, ["record", str(model), "--steps", "30", "--every", "15", "--out", str(out)]
    )
    assert done.exit_code == 0, done.output
    assert "2 problems" in done.output
    assert len(list(out.glob("*.npz"))) == 2
    wrong = CliRunner().invoke(
        cli, ["record", str(model), "--controls", "no.npy", "--out", str(tmp_path / "o")]
    )
    page = tmp_path / "report"
    words = [
        "report",
        str(model),
        "--steps",
        "30",
        "--every",
        "10",
        "--controls",
        "zero",
        "--solvers",
        "auto,newton",
    ]
    for again in range(2):  # the second time nothing is recorded anew
        shown = CliRunner().invoke(cli, [*words, "--no-figures", "--tables", "--out", str(page)])
        assert shown.exit_code == 0, shown.output
        assert ("3 problems" in shown.output) == (again == 0)
        assert "Newton (inside the engine)" in shown.output
    (own,) = (page / "recorded").glob("*-scene/engine.jsonl")
    lines = [json.loads(line) for line in own.read_text().splitlines()]
    assert len(lines) == 3
    for text in ((page / "index.html").read_text(), (page / "summary.md").read_text()):
        row = text[text.index("Newton (inside the engine)") :][:400]
        assert "auto" in row or "newton" in row
    assert f"{max(line['relative'] for line in lines):.1e}" in (page / "summary.md").read_text()
    missing = CliRunner().invoke(cli, ["report", str(tmp_path / "none.xml"), "--out", str(page)])
    assert isinstance(missing.exception, lv.errors.InputError)
    assert wrong.exit_code != 0


def test_lavender_run_shows_a_line_and_writes_what_was_asked_for(tmp_path, capsys):
    from lavender.cli import main
    from lavender.io import load

    paths = [tmp_path / name for name in ("trace.csv", "figure.svg", "problems")]
    words = [
        "run",
        "stack",
        "--iterations",
        "8",
        "--no-warm-start",
        "--steps",
        "12",
        "--set",
        "n=2",
        "--order",
        "top_down",
        "--residual",
    ]
    files = ["--trace", paths[0], "--plot", paths[1], "--record", paths[2], "--skip", "9"]
    with pytest.raises(SystemExit) as code:
        main([*words, *map(str, files)])
    assert not code.value.code
    printed = capsys.readouterr().out
    assert "step     12" in printed and "contacts     8  matches     0" in printed and "worst" in printed
    assert "order top_down" in printed.splitlines()[-1]
    table = np.genfromtxt(paths[0], delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert table.shape == (12,) and np.all(table["iterations"] == 8) and np.all(table["contacts"] == 8)
    assert table["residual_final"].max() < table["residual_initial"].max()
    assert set(table["order"]) == {"top_down"}
    assert paths[1].read_text().lstrip().startswith("<?xml") and "order top_down" in paths[1].read_text()
    assert [load(p).n_blocks for p in sorted(paths[2].iterdir())] == [8, 8, 8]


@pytest.mark.parametrize(
    ("words", "last"),
    [
        (["--solver", "newton"], "newton, "),
        (["--solver", "pgs", "--order", "bottom_up"], "pgs, order bottom_up, "),
        (["--stepper", "xpbd", "--order", "reverse"], "order reverse, "),
    ],
)
def test_the_last_line_says_solver_and_order(words, last, capsys):
    from lavender.cli import main

    with pytest.raises(SystemExit) as code:
        main(["run", "stack", "--set", "n=2", "--steps", "3", *words])
    assert not code.value.code
    assert f" s, {last}" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize(
    "words",
    [
        ["run", "stac"],
        ["run", "stack", "--set", "n"],
        ["run", "stack", "--set", "mu=1"],
        ["run", "stack", "--iterations", "3"],
        ["run", "stack", "--solver", "newtn"],
        ["run", "stack", "--order", "up"],
        ["run", "stack", "--solver", "newton", "--order", "bottom_up"],
        ["run", "stack", "--order", "given", "--set", "order=reverse"],
        ["run", "stack", "--stepper", "xpbd", "--solver", "newton"],
    ],
)
def test_lavender_run_refuses_what_it_cannot_do(words, capsys):
    from lavender.cli import main

    with pytest.raises(SystemExit) as code:
        main(words)
    assert code.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def run(sim, steps):
    return [sim.step()[0] for _ in range(steps)]


def test_lavender_run_writes_films_and_pictures(tmp_path, capsys):
    from lavender.cli import main

    for name in ("a.film", "a.gif"):
        with pytest.raises(SystemExit) as code:
            main(["run", "spinner", "--steps", "5", "--film", str(tmp_path / name)])
        assert not code.value.code
        assert name in capsys.readouterr().out
    assert len(Film.load(tmp_path / "a.film")) == 6
    with pytest.raises(SystemExit) as code:
        main(["view", str(tmp_path / "a.gif")])
    assert code.value.code == 2
    assert "no film" in capsys.readouterr().err


def test_lavender_run_shows_itself_until_ctrl_c(monkeypatch, capsys):
    from lavender.cli import main
    from lavender.sim.web import view

    opened, waited = [], []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(view.Viewer, "wait", lambda self: waited.append(len(self.film)))
    with pytest.raises(SystemExit) as code:
        main(["run", "spinner", "--steps", "4", "--view"])
    assert not code.value.code
    assert waited == [5]
    assert opened[0] in capsys.readouterr().out


HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


CHECK = ROOT / "tests" / "sim" / "web" / "check_wasm_exports.mjs"


@pytest.fixture(scope="session")
def module():
    """The module of these sources, as bytes; built once for each state of the sources."""
    try:
        return pages.module()
    except LavenderError as error:
        pytest.skip(str(error))


def test_lavender_web_check_says_what_it_needs_and_ends_as_its_script_does(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "module", lambda say, name: name.encode())
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    with pytest.raises(LavenderError, match="in tests/sim/web of a checkout"):
        pages.check()
    script = tmp_path / CHECK.relative_to(ROOT)
    script.parent.mkdir(parents=True)
    script.write_text("""
import { readFileSync } from "node:fs";
import { dirname, join } from "node:path";
const newton = readFileSync(join(dirname(process.argv[2]), "newton.wasm"), "utf8");
process.exit(readFileSync(process.argv[2], "utf8") === "lavender" && newton === "newton" && process.env.PYTHON ? 0 : 1);
""")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(LavenderError, match=r"node is not there.*install Node 18"):
        pages.check()
    monkeypatch.undo()
    if shutil.which("node") is None:
        pytest.skip("needs Node")
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    for data, code in ((str.encode, 0), (lambda name: b"other", 1)):
        monkeypatch.setattr(pages, "module", lambda say, name, data=data: data(name))
        assert CliRunner().invoke(cli, ["web", "check"]).exit_code == code


def node(*arguments):
    if shutil.which("node") is None:
        pytest.skip("Node is not installed")
    return subprocess.run(["node", *map(str, arguments)], capture_output=True, text=True, check=False)


needs_compiler = pytest.mark.skipif(bool(wasm.why_not()), reason=wasm.why_not())


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "lavender.cli", "web", *map(str, arguments)],
        capture_output=True, text=True, check=False, cwd=ROOT, env={**os.environ, "COLUMNS": "100"},
    )  # fmt: skip


def test_command_writes_a_page_without_outside_addresses(module, tmp_path):
    done = command("page", tmp_path / "site")
    assert done.returncode == 0, done.stderr
    files = {
        path.relative_to(tmp_path / "site").as_posix()
        for path in (tmp_path / "site").rglob("*")
        if path.is_file()
    }
    assert {"index.html", "lavender.js", "scenes.json", "vendor/uPlot-LICENSE.txt"} <= files
    assert {"lavender.wasm", "newton.wasm"} <= files
    assert (tmp_path / "site" / "lavender.wasm").read_bytes() == module
    for name in sorted(files):
        if name.endswith((".html", ".js", ".css")) and not name.startswith("vendor/"):
            text = (tmp_path / "site" / name).read_text(encoding="utf-8")
            assert "http:" not in text.replace("http://www.w3.org/", "") and "https:" not in text, name


@needs_compiler
def test_command_says_why_it_cannot_build(tmp_path):
    done = command("build", tmp_path / "none" / "a.wasm")
    assert done.returncode == 2
    assert "is not there; make it first" in done.stderr
