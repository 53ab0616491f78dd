"""Verdicts on stored answers of float32 engines, in records and reports."""

import dataclasses
import json

import pytest
from calls import robot

import lavender as lv
from lavender.report import resolve_sources
from lavender.report.cases import describe_case
from lavender.report.records import Records, from_json, to_json
from lavender.report.tables import read_engine_answers


def test_a_report_shows_the_verdict_of_a_stored_answer_in_float32(tmp_path):
    problem = dataclasses.replace(robot(2), precision="float32")
    lv.io.save(problem, tmp_path / "early.npz", impulse=0.9 * lv.solve(problem, tol=1e-11).impulse)
    (item,) = resolve_sources([tmp_path / "early.npz"])
    info = describe_case(item, "run")
    assert info.stored_verdict.startswith("stopped before convergence, ")
    assert from_json(to_json(info)) == info


def test_a_recording_of_a_float32_engine_counts_its_early_answers(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option solver="CG" tolerance="1e-5"/><worldbody>
        <geom type="plane" size="5 5 .1"/>
        <body pos="0 0 .09"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
        <body pos=".05 0 .28" euler="5 9 20"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
        </worldbody></mujoco>"""
    )
    found = lv.io.record(model, mujoco.MjData(model), tmp_path, 6, precision="float32")
    assert lv.load(tmp_path / found.files[0]).precision == "float32"
    lines = [json.loads(line) for line in (tmp_path / "engine.jsonl").read_text().splitlines()]
    early = sum(line["verdict"] != "at its floor" for line in lines)
    assert all(line["precision"] == "float32" and line["floor"] > 1e-9 for line in lines)
    assert early > 0  # at its tolerance, far above the floor
    (engine,) = read_engine_answers([str(tmp_path)], Records())
    assert engine.unconverged == early
    with pytest.raises(lv.InputError, match="precision is 'half'"):
        lv.io.record(model, mujoco.MjData(model), tmp_path / "other", 1, precision="half")


def test_verdicts_of_a_recording_are_counted(tmp_path):
    line = {"rows": 3, "seconds": 1e-5, "relative": 1e-3, "solver": "PGS", "file": "step_1.npz"}
    verdicts = ("stopped before convergence", "wrong", "close enough", "at its floor")
    lines = [json.dumps(line | {"verdict": verdict}) for verdict in verdicts]
    (tmp_path / "engine.jsonl").write_text("\n".join(lines))
    (engine,) = read_engine_answers([str(tmp_path)], Records())
    assert (engine.unconverged, engine.above_floor) == (2, 3)
