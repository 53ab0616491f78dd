"""Verdicts on stored answers of float32 engines, in records and reports."""

import dataclasses
import json

import pytest
from calls import robot

import lavender as lv
from lavender.report import resolve_sources
from lavender.report.cases import describe_case
from lavender.report.store import make_lines
from lavender.report.tables import read_engine_answers


def test_a_report_shows_the_verdict_of_a_stored_answer_in_float32(tmp_path):
    problem = dataclasses.replace(robot(2), precision="float32")
    lv.io.save(problem, tmp_path / "early.npz", impulse=0.9 * lv.solve(problem, tol=1e-11).impulse)
    (item,) = resolve_sources([tmp_path / "early.npz"])
    assert item.judge_stored_answer().verdict == "stopped before convergence"


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
    engine = read_engine_answers([str(tmp_path)], make_lines([]))
    assert engine["verdict"].isin(["stopped before convergence", "wrong"]).sum() == early
    with pytest.raises(lv.InputError, match="precision is 'half'"):
        lv.io.record(model, mujoco.MjData(model), tmp_path / "other", 1, precision="half")


def test_read_engine_answers_with_a_stored_impulse_judges_it(tmp_path):
    """As a dump of a C engine writes them, with the impulse in the problem file; and files without any list."""
    p = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, 1.0])
    early = lv.solve(p, "pgs", tol=0.0, max_iter=1).impulse
    for i in range(2):
        p.save(tmp_path / f"step_{i}.npz", impulse=early)
    # Two steps have an impulse, the others only a line, the last one without a residual.
    lines = [
        {"file": f"step_{i}.npz", "rows": 2, "seconds": 1e-5, "solver": "PGS"} for i in range(4)
    ]
    lines[1] |= {"relative": 1e-12, "velocity": 0.0, "verdict": "at its floor"}
    lines[2] |= {"relative": 1e-3, "verdict": "wrong"}
    (tmp_path / "engine.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n[1]\ntorn")
    engine = read_engine_answers([str(tmp_path)], make_lines([]))
    judged = lv.residual(p, early)
    assert engine["relative"].tolist() == [judged.relative] * 2 + [1e-3]
    assert engine["velocity"].tolist()[:2] == [judged.velocity] * 2 and judged.velocity > 0.1
    assert engine["verdict"].isin(["stopped before convergence", "wrong"]).all()
    (tmp_path / "engine.jsonl").unlink()
    (first, second) = (
        describe_case(item, "run") for item in resolve_sources([tmp_path], sequences=True)
    )
    engine = read_engine_answers([], make_lines([first, second]))
    assert engine["relative"].tolist() == [judged.relative] * 2 and set(engine["solver"]) == {
        "engine"
    }
