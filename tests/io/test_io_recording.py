"""A simulation of MuJoCo as a folder of problems, with its own answers judged beside them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from mujoco_scene import mj, scene, state

import lavender as lv
from lavender.io import recording
from lavender.io.start_states import StartStates

PGS = 1e-6  # as in test_io_mujoco.py


def test_record_writes_a_folder_of_problems_with_the_answers_of_the_engine(tmp_path):
    model, data = state(steps=1)
    found = lv.io.record(model, data, tmp_path / "steps", 40, every=10)
    assert len(found.files) == 4
    assert found.left_out == ()
    lines = [
        json.loads(line) for line in (tmp_path / "steps" / "engine.jsonl").read_text().splitlines()
    ]
    assert [line["file"] for line in lines] == list(found.files)
    for line in lines:
        stored = lv.io.read(tmp_path / "steps" / line["file"])
        judged = lv.residual(stored.problem, stored.impulse)
        assert judged.relative == line["relative"] < PGS
        assert stored.problem.key is not None
        assert line["rows"] == stored.problem.m
        assert line["seconds"] > 0.0
        assert line["solver"] == "NEWTON"


def test_record_of_a_step_stopped_before_convergence_has_its_error_in_metres_per_second(tmp_path):
    text = scene(cone="pyramidal").replace('iterations="2000"', 'iterations="1"')
    model = mj.MjModel.from_xml_string(text)
    found = lv.io.record(model, mj.MjData(model), tmp_path / "early", 30)
    assert (len(found.files), found.left_out) == (30, ())
    lines = [json.loads(x) for x in (tmp_path / "early" / "engine.jsonl").read_text().splitlines()]
    worst = max(lines, key=lambda line: line["velocity"])
    assert worst["velocity"] > 1e-3
    stopped = sum(line["velocity"] > 1e-6 for line in lines)
    assert stopped > 0 and f"above their floor, {stopped} more than 1e-6 m/s off" in str(found)
    where = f"{worst['velocity']:.2g} m/s off at {worst['worst']}, step {worst['step']}"
    verdict = {"wrong": "is wrong"}.get(worst["verdict"], "stopped before convergence")
    assert str(found).splitlines()[-1] == f"worst: {where}: it {verdict}"


def test_record_ctrl_c_keeps_the_steps_until_then(tmp_path):
    def interrupt(model, data, step):
        if step == 5:
            raise KeyboardInterrupt

    found = lv.io.record(*state(steps=1), tmp_path, 20, control=interrupt)
    lines = [json.loads(line) for line in (tmp_path / "engine.jsonl").read_text().splitlines()]
    assert found.is_interrupted and [line["file"] for line in lines] == list(found.files)
    assert (
        sorted(path.name for path in tmp_path.glob("*.npz")) == list(found.files)
        and len(lines) == 5
    )
    assert len(lv.report.resolve_sources(tmp_path)) == 5


def test_record_from_different_states_makes_independent_steps(tmp_path):
    model, data = state(steps=20)
    arrays = {"qpos": np.tile(data.qpos, (3, 1)), "qvel": np.tile(data.qvel, (3, 1))}
    found = lv.io.record(model, data, tmp_path / "six", 6, states=arrays)
    assert "from 3 start states; steps from different states are independent" in str(found)
    lines = [
        json.loads(line) for line in (tmp_path / "six" / "engine.jsonl").read_text().splitlines()
    ]
    assert [line["start"] for line in lines] == [0, 0, 1, 1, 2, 2]
    items = lv.report.resolve_sources(tmp_path / "six")
    assert [(i.sequence, i.step) for i in items[2:4]] == [("six, state 1", 0), ("six, state 1", 1)]
    lv.io.record(model, data, tmp_path / "three", 3, states=arrays)
    # A single step of each state is a single problem, which is solved cold.
    items = lv.report.resolve_sources(tmp_path / "three", sequences=True)
    assert [(i.name, i.sequence, i.step) for i in items] == [
        (f"three, state {k}", "", -1) for k in range(3)
    ]


@pytest.mark.parametrize(
    ("steps", "every", "count"), [(20, 1, 3), (20, 2, 3), (17, 3, 5), (9, 4, 1)]
)
def test_steps_from_start_states_are_counted_from_each_and_begin_under_its_controls(
    steps, every, count
):
    model, data = state(steps=1)
    vectors = np.empty((9, mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION)))
    for row in vectors:
        mj.mj_step(model, data)
        mj.mj_getState(model, data, row, mj.mjtState.mjSTATE_INTEGRATION)
    starts = StartStates(vectors, controls=np.arange(9.0)[:, None]).select_evenly(count)
    kept = [9 * i // count for i in range(count)]
    assert (
        starts.vectors.tobytes() == vectors[kept].tobytes()
        and starts.controls.ravel().tolist() == kept
    )
    starts = replace(starts, controls=None)
    found = list(recording.iterate_steps(mj, model, data, steps, every, lambda *_: None, starts))
    ends = [steps * i // count for i in range(count + 1)]
    assert found == [(k + 1, i) for i in range(count) for k in range(ends[i], ends[i + 1], every)]


def test_record_of_steps_that_cannot_be_exported_counts_them(tmp_path, monkeypatch):
    def refuse(model, data, name):
        raise lv.CapabilityError(f"{name} has a constraint of an unknown type")

    monkeypatch.setattr(recording.adapter, "from_mujoco", refuse)
    found = lv.io.record(*state(steps=1), tmp_path, 20, every=10)
    assert (len(found.files), len(found.left_out)) == (0, 2)
    assert "unknown type" in str(found)


def make_row_of_boxes(n, options=""):
    """Return a model of n sliding boxes that do not touch each other, and its data after some steps."""
    boxes = "".join(
        f'<body pos="{0.5 * i} 0 .1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
        for i in range(n)
    )
    model = mj.MjModel.from_xml_string(
        f'<mujoco><option cone="elliptic" {options}/><worldbody><geom type="plane" size="99 9 .1"/>{boxes}'
        "</worldbody></mujoco>"
    )
    data = mj.MjData(model)
    data.qvel[::6] = 0.3
    return model, data


def test_record_with_noslip_separates_its_iterations(tmp_path):
    lines = []
    for options in ("", 'noslip_iterations="5" noslip_tolerance="0"'):
        model, data = make_row_of_boxes(2, options)
        mj.mj_resetData(model, data)  # At rest, noslip changes no velocity and so no later step.
        lv.io.record(model, data, tmp_path / f"n{len(lines)}", 1)
        (line,) = map(
            json.loads, (tmp_path / f"n{len(lines)}" / "engine.jsonl").read_text().splitlines()
        )
        lines.append(line)
    assert np.sum(data.solver_niter) == lines[1]["iterations"] + lines[1]["noslip_iterations"]
    assert lines[0]["iterations"] == lines[1]["iterations"] > 0
    assert (lines[0]["noslip_iterations"], lines[1]["noslip_iterations"]) == (0, 10)


def test_record_with_controls_plays_draws_or_calls_them(tmp_path):
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
    for given, words in (
        *(
            ({"control": wrong}, "control")
            for wrong in ("ramp", np.zeros((3, 2)), np.zeros((0, 1)), *calls)
        ),
        ({"control": "random", "seed": -1}, "seed is -1"),
        ({"replace": "no"}, "replace is 'no'"),
        ({"steps": 0}, "steps is 0"),
    ):
        with pytest.raises(lv.InputError, match=words):
            lv.io.record(model, data, tmp_path, **{"steps": 1} | given)
