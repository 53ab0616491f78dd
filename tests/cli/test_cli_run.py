"""`lavender run` and `web`: what steps an engine from the command line."""

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from PIL import Image

from lavender.base.errors import LavenderError
from lavender.cli import cli
from lavender.io import load
from lavender.sim.engine import Simulation
from lavender.sim.web import pages


@pytest.mark.parametrize(
    "asked",
    [
        ("--iterations", "8", "--no-warm-start"),
        ("--set", "solver_iterations=8", "--set", "warm_start=false"),
    ],
    ids=["options", "set"],
)
def test_run_command_writes_the_requested_files(lavender, tmp_path, asked):
    paths = [tmp_path / name for name in ("trace.csv", "figure.svg", "problems")]
    words = [
        "run",
        "stack",
        *asked,
        "--steps",
        "12",
        "--set",
        "n=2",
        "--order",
        "top_down",
        "--residual",
    ]
    files = ["--trace", paths[0], "--plot", paths[1], "--record", paths[2]]
    code, printed, _ = lavender(*words, *files)
    assert not code
    assert (
        "step     12" in printed
        and "contacts     8  matches     0" in printed
        and "worst" in printed
    )
    assert "order top_down" in printed.splitlines()[-1]
    table = np.genfromtxt(paths[0], delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert (
        table.shape == (12,) and np.all(table["iterations"] == 8) and np.all(table["contacts"] == 8)
    )
    assert table["residual_final"].max() < table["residual_initial"].max()
    assert set(table["order"]) == {"top_down"}
    assert (
        paths[1].read_text().lstrip().startswith("<?xml")
        and "order top_down" in paths[1].read_text()
    )
    assert [load(p).n_blocks for p in sorted(paths[2].iterdir())] == 12 * [8]


def test_lavender_run_takes_a_velocity_error_for_a_named_solver(lavender):
    words = ("run", "stack", "--set", "n=2", "--steps", "4", "--velocity-tol", "1e-9")
    code, printed, _ = lavender(*words, "--solver", "newton", "--residual")
    assert not code and "newton" in printed
    code, _, said = lavender(*words)
    assert code == 2 and "name another solver" in said


def test_run_film_writes_one_frame_for_each_40_ms_of_simulated_time(lavender, tmp_path):
    code, out, _ = lavender("run", "spinner", "--steps", "60", "--film", tmp_path / "a.gif")
    assert code == 0 and f"film: {tmp_path / 'a.gif'}" in out
    with Image.open(tmp_path / "a.gif") as film:
        assert (film.n_frames, film.info["duration"]) == (13, 40)  # 60 steps are 0.5 s.


def test_ctrl_c_keeps_the_steps_until_then(lavender, monkeypatch, tmp_path):
    run = Simulation.run

    def stopped(self, n):
        if self.time > 0.04:
            raise KeyboardInterrupt
        return run(self, n)

    monkeypatch.setattr(Simulation, "run", stopped)
    trace, film, problems = (tmp_path / name for name in ("t.csv", "f.gif", "steps"))
    files = ("--trace", trace, "--film", film, "--record", problems)
    code, out, _ = lavender("run", "stack", "--steps", "50", *files)
    assert code == 130 and "5 steps" in out and "Stopped" in out
    rows = pd.read_csv(trace)
    np.testing.assert_allclose(
        rows["time"] / rows["step"], rows["time"][0], rtol=1e-9
    )  # of the state after a step
    assert rows["step"].tolist() == [1, 2, 3, 4, 5] and film.stat().st_size
    assert len(list(problems.iterdir())) >= 5
    monkeypatch.setattr(Simulation, "run", lambda self, n: (_ for _ in ()).throw(KeyboardInterrupt))
    assert lavender("run", "stack")[0] == 130  # nothing to keep


HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


CHECK = ROOT / "tests" / "sim" / "web" / "check_wasm_exports.mjs"


def test_web_check_command_ends_with_the_status_of_its_script(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "get_or_build_module", lambda say, name: name.encode())
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    with pytest.raises(LavenderError, match="part of a checkout"):
        pages.compare_with_native_kernels()
    script = tmp_path / CHECK.relative_to(ROOT)
    script.parent.mkdir(parents=True)
    script.write_text("""
import { readFileSync } from "node:fs";
import { dirname, join } from "node:path";
const newton = readFileSync(join(dirname(process.argv[2]), "newton.wasm"), "utf8");
process.exit(readFileSync(process.argv[2], "utf8") === "lavender" && newton === "newton" && process.env.PYTHON ? 0 : 1);
""")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(LavenderError, match=r"node.*is not installed: install Node 18"):
        pages.compare_with_native_kernels()
    monkeypatch.undo()
    if shutil.which("node") is None:
        pytest.skip("needs Node")
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    for data, code in ((str.encode, 0), (lambda name: b"other", 1)):
        monkeypatch.setattr(pages, "get_or_build_module", lambda say, name, data=data: data(name))
        assert CliRunner().invoke(cli, ["web", "check"]).exit_code == code


def test_command_writes_a_page_without_outside_addresses(lavender, module, tmp_path):
    pytest.importorskip("Cython", reason="the command translates the kernels (extra: test)")
    assert lavender("web", "page", tmp_path / "site")[0] == 0
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
            assert "http:" not in text.replace("http://www.w3.org/", "") and "https:" not in text, (
                name
            )
