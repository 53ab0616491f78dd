"""A simulation of MuJoCo as a folder of problems, with its own answers judged beside them."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from mujoco_scene import mj, scene, state

import lavender as lv
from lavender.cli import cli
from lavender.io import recording

PGS = 1e-6  # as in test_io_mujoco.py


def test_a_recording_is_a_folder_of_problems_with_the_engines_own_answer(tmp_path):
    model, data = state(steps=1)
    found = lv.io.record(model, data, tmp_path / "steps", 40, every=10)
    assert len(found.files) == 4
    assert found.left_out == ()
    lines = [json.loads(line) for line in (tmp_path / "steps" / "engine.jsonl").read_text().splitlines()]
    assert [line["file"] for line in lines] == list(found.files)
    for line in lines:
        stored = lv.io.read(tmp_path / "steps" / line["file"])
        judged = lv.residual(stored.problem, stored.impulse)
        assert judged.relative == line["relative"] < PGS
        assert stored.problem.key is not None
        assert line["rows"] == stored.problem.m
        assert line["seconds"] > 0.0
        assert line["solver"] == "NEWTON"


def test_a_step_on_which_mujoco_stopped_early_is_kept_and_told_in_metres_per_second(tmp_path):
    text = scene(cone="pyramidal").replace('iterations="2000"', 'iterations="1"')
    model = mj.MjModel.from_xml_string(text)
    found = lv.io.record(model, mj.MjData(model), tmp_path / "early", 30)
    assert (len(found.files), found.left_out) == (30, ())
    lines = [json.loads(x) for x in (tmp_path / "early" / "engine.jsonl").read_text().splitlines()]
    worst = max(lines, key=lambda line: line["velocity"])
    assert worst["velocity"] > 1e-3
    assert 0 < found.stopped == sum(line["velocity"] > 1e-6 for line in lines) <= found.above_floor
    where = f"{worst['velocity']:.2g} m/s short at {worst['worst']} (step {worst['step']})"
    assert str(found).endswith(f"MuJoCo stopped {where} in the worst")


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


def test_what_cannot_be_exported_is_counted_not_fatal(tmp_path):
    if not hasattr(mj.mjtIntegrator, "mjINT_DISCRETE"):
        pytest.skip("this MuJoCo has no such integrator")
    text = scene()
    model = mj.MjModel.from_xml_string(text.replace('name="door"', 'name="door" damping="2"'))
    model.opt.integrator = mj.mjtIntegrator.mjINT_DISCRETE
    found = lv.io.record(model, mj.MjData(model), tmp_path, 20, every=10)
    assert (len(found.files), len(found.left_out)) == (0, 2)
    assert "discrete" in str(found)


def test_controls_are_played_drawn_or_called(tmp_path):
    text = """<mujoco><worldbody><body><joint name="j" range="-1 1" limited="true"/><geom size=".1"/></body></worldbody>
      <actuator><motor joint="j" ctrlrange="-2 3" ctrllimited="true"/></actuator></mujoco>"""
    model = mj.MjModel.from_xml_string(text)
    seen = []

    def watch(model, data, step):
        seen.append(float(data.ctrl[0]))
        return [0.5 * step]

    lv.io.record(model, mj.MjData(model), tmp_path, 3, control=watch)
    assert seen == [0.0, 0.0, 0.5]
    data = mj.MjData(model)
    lv.io.record(model, data, tmp_path, 3, control=np.array([[1.0], [2.0]]))
    assert data.ctrl[0] == 1.0
    lv.io.record(model, data, tmp_path, 1, control="random", seed=3)
    assert -2.0 <= data.ctrl[0] <= 3.0
    calls = [lambda *_, given=given: given for given in ([np.nan], [1.0, 2.0], "fast")]
    for wrong in ("ramp", np.zeros((3, 2)), np.zeros((0, 1)), *calls):
        with pytest.raises(lv.InputError, match="control"):
            lv.io.record(model, data, tmp_path, 1, control=wrong)
    with pytest.raises(lv.InputError, match="seed is -1"):
        lv.io.record(model, data, tmp_path, 1, control="random", seed=-1)
    with pytest.raises(lv.InputError, match="replace is 'no'"):
        lv.io.record(model, data, tmp_path, 1, replace="no")
    with pytest.raises(lv.InputError, match="steps is 0"):
        lv.io.record(model, data, tmp_path, 0)


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


@pytest.mark.parametrize(
    "kind", ["archive", "words", "objects", "one row", "short", "huge", "folder", "nothing"]
)
def test_controls_of_another_thing_are_refused_by_name(tmp_path, kind):
    (tmp_path / "model.xml").write_text(scene())
    path = tmp_path / "controls.npy"
    if kind == "archive":
        np.savez(tmp_path / "controls.npz", a=np.zeros((3, 1)), b=np.zeros(2))
        path = tmp_path / "controls.npz"
    elif kind == "words":
        np.save(path, np.array([["a"]]))
    elif kind == "objects":
        np.save(path, np.array([[None]]), allow_pickle=True)
    elif kind == "one row":
        np.save(path, np.zeros(3))
    elif kind == "folder":
        path.mkdir()
    elif kind == "huge":
        path.write_bytes(b"\x93NUMPY\x01\x00\x76\x00" + (
            b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 1), }".ljust(117) + b"\n"
        ))  # fmt: skip
    elif kind == "short":
        path.write_bytes(b"\x93NUMPY")
    with pytest.raises(lv.InputError, match="control"):
        recording.record_file(tmp_path / "model.xml", tmp_path / "out", 3, control=str(path))
