"""Our Newton beside MuJoCo's on models of one's own: the command, its table, and what is left out."""

import json

import pytest
from click.testing import CliRunner

from lavender.base.errors import InputError
from lavender.cli.bench import mujoco
from lavender.lab.bench import simulators
from lavender.lab.report import simulators as tables

mj = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[peers]'")

MODEL = """<mujoco><option timestep="0.004"/><worldbody><geom type="plane" size="0 0 1"/>
  <body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/>
    <body><joint name="arm" range="-30 30" limited="true"/>
      <geom type="capsule" fromto="0 0 .1 .3 0 .1" size=".03"/></body>
  </body></worldbody><actuator><motor joint="arm" gear="2"/></actuator></mujoco>"""


def test_both_sides_solve_every_step_to_the_same_residual(tmp_path):
    model = tmp_path / "arm.xml"
    model.write_text(MODEL)
    steps = simulators.measure(mj, model, 3, 10)
    assert len(steps) == 3
    for s in steps:
        assert s.model == "arm"
        assert s.rows > 0
        assert max(s.residual, s.engine_residual) <= simulators.TARGET
        assert s.strict <= simulators.STRICT
        assert min(s.engine, s.many, s.prepare, s.judge, s.kernel) > 0.0
        assert max(s.momentum, s.energy, s.engine_momentum, s.engine_energy) < 1e-4


def test_the_command_writes_a_table_and_says_what_it_left_out(tmp_path):
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
    (tmp_path / "arm.xml").write_text(MODEL)
    words = [str(tmp_path / "arm.xml"), "--steps", "0"]
    done = CliRunner().invoke(mujoco, words)
    assert isinstance(done.exception, InputError) and "no step of these models" in str(done.exception)
    for bad in (["--every", "0"], ["--warm", "-1"], ["--steps", "-1"]):
        assert CliRunner().invoke(mujoco, [*words, *bad]).exit_code == 2
    warm = CliRunner().invoke(mujoco, [*words, "--warm", "40"])
    assert warm.exit_code == 0 and "ours, median" in warm.output and "momentum" not in warm.output


def test_ratios_are_geometric_means_by_the_number_of_rows():
    def step(rows, engine, ours, tolerance=1e-8):
        return simulators.Step(
            "m", 0, rows, engine, ours, 0.0, 0.0, nv=3, law="lcp", tolerance=tolerance, many=ours / 2, kernel=ours / 4,
            prepare=ours / 8, judge=ours / 8, strict=0.0, coulomb=None, momentum=0.0, engine_momentum=0.0, energy=0.0,
            engine_energy=0.0,
        )  # fmt: skip

    text = tables.table([step(4, 1e-6, 2e-6), step(5, 1e-6, 8e-6), step(400, 1e-3, 5e-4, 0.0)])
    assert "| under 10 | 1 | 2 | 1.0 | 4.00 | 2.00 | 1.00 | 0.50 | 0.50 | 2.00 | 8.0 (m, 5 rows) |" in text
    assert "| 300 and more | 1 | 1 | 1000.0 | 0.50 |" in text
    assert "1 that MuJoCo brings" in text
