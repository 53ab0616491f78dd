"""`lavender record` and the report of what it wrote."""

import json

import numpy as np
import pytest
from mujoco_scene import mj, scene

import lavender as lv
from lavender.judge.residuals import AT_FLOOR

PGS = 1e-6  # as in test_io_mujoco.py


def test_record_verdict_follows_the_threshold_of_the_user(lavender, tmp_path):
    """All but exact answers are above the floor of float64, which rounding alone sets."""
    model = mj.MjModel.from_xml_string(scene(solver="PGS").replace('"1e-15"', '"1e-12"'))
    found = lv.io.record(model, mj.MjData(model), tmp_path / "a", 30)
    above = sum(line["verdict"] != AT_FLOOR for line in found.lines)
    assert above > 10
    assert str(found).endswith(f"{above} above their floor, 0 more than 1e-6 m/s off")
    strict = lv.io.record(model, mj.MjData(model), tmp_path / "b", 30, threshold=0.0)
    assert f"{above} above their floor, {above} more than 0 m/s off" in str(strict)
    lines = [json.loads(line) for line in (tmp_path / "a" / "engine.jsonl").read_text().splitlines()]
    at = next(line for line in lines if line["verdict"] == "close enough")
    stored = lv.io.read(tmp_path / "a" / at["file"])
    for threshold, said in (
        (at["velocity"], "close enough"),
        (0.99 * at["velocity"], "stopped before convergence"),
        (0.0, "stopped before convergence"),
    ):
        judged = lv.residual(stored.problem, stored.impulse, threshold=threshold)
        assert (judged.verdict, judged.relative) == (said, at["relative"])
    for wrong in (-1.0, np.nan, "near"):
        with pytest.raises(lv.InputError, match="threshold"):
            lv.residual(stored.problem, stored.impulse, threshold=wrong)
        with pytest.raises(lv.InputError, match="threshold"):
            lv.io.record(model, mj.MjData(model), tmp_path / "c", 1, threshold=wrong)
    words = ("check", tmp_path / "a" / at["file"], "--solvers", "auto", "--threshold")
    for threshold, status, told in (("1e-6", 0, "0 also more than 1e-6"), ("0", 1, "1 also more than 0")):
        code, out, _ = lavender(*words, threshold)
        assert code == status and f"1 of 1 above their floor, {told} m/s off" in " ".join(out.split())


def test_record_without_a_selected_constraint_counts_the_steps_between(lavender, boxes, tmp_path):
    """The only selected step is after the end; every other step has contact."""
    code, _, err = lavender("record", boxes(), "--steps", 100, "--record-every", 1000, "--out", tmp_path / "r")
    assert code == 2 and "or every step (--record-every is 1000)" in err
