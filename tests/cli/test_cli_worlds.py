"""`lavender audit` and `lavender tune`."""

import json

import numpy as np
import pytest
from calls import EARLY_BOXES as EARLY
from calls import keep_values

import lavender as lv
from lavender.audit.tune import mujoco_settings as tuning

pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'")


def test_audit_command_exit_code_follows_the_error_limit(lavender, boxes, tmp_path):
    words = (
        "--worlds",
        2,
        "--steps",
        20,
        "--workers",
        1,
        "--out",
        tmp_path / "out",
        "--max-velocity-error",
        "1e-3",
    )
    code, out, _ = lavender("audit", boxes(EARLY), *words)
    assert code == 1 and "stopped before convergence" in out
    page = (tmp_path / "out" / "index.html").read_text()
    assert "worst_1.npz" in page and "<svg" in page
    told = json.loads((tmp_path / "out" / "numbers.json").read_text())
    assert told["unconverged"] > 0 and told["largest"] > 1e-3
    assert told["contacts"]["maximum"] > 0 and told["judged"] == 40
    # The reason of the exit code: the records have the same count.
    records = np.load(tmp_path / "out" / "records.npz")
    above = np.count_nonzero((records["velocity"] > 1e-3) & (records["verdict"] > 0))
    assert 0 < above == told["above_limit"] and told["error_limit"] == 1e-3
    code, out, _ = lavender("audit", boxes(), *words)
    assert code == 0 and "No step is wrong beyond rounding" in out
    assert (
        json.loads((tmp_path / "out-1" / "numbers.json").read_text()) == told
    )  # The earlier audit was moved aside.
    assert not list((tmp_path / "out" / "worst").glob("*.npz"))  # files of another run are gone


def test_states_that_an_audit_saves_are_read_by_the_other_commands(lavender, boxes, tmp_path):
    path = boxes(EARLY)
    file = tmp_path / "contact.npz"
    words = ("--worlds", 2, "--steps", 40, "--workers", 1, "--out", tmp_path / "a")
    code, out, _ = lavender("audit", path, *words, "--save-states", "contact", file, "--keep", 5)
    assert code == 0 and f"{file}: " in out and "states for --states" in out
    assert len(np.load(file)["state"]) > 5 == len(np.load(tmp_path / "a" / "states.npz")["state"])
    assert lavender("record", path, "--states", file, "--steps", 5, "--out", tmp_path / "r")[0] == 0
    assert "floor" in lavender("slip", path, "--states", file)[1]
    code, _, err = lavender("audit", path, *words, "--save-states", "best", file)
    assert code == 2 and "'best' is not one of 'contact', 'worst'" in err


def test_a_model_changed_after_loading_is_read_as_mjb_by_each_command(
    lavender, boxes, tmp_path, monkeypatch
):
    keep_values(monkeypatch, tuning, "MUJOCO", {3}, {"CG"})
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(boxes(EARLY)))
    model.geom_friction[:] = 0.02
    mujoco.mj_saveModel(model, str(tmp_path / "changed.mjb"))
    words = ("--steps", 20, "--out", tmp_path / "out")
    assert (
        lavender("audit", tmp_path / "changed.mjb", "--worlds", 1, "--workers", 1, *words)[0] == 0
    )
    assert lavender("tune", tmp_path / "changed.mjb", "--worlds", 2, "--repeats", 1, *words)[0] == 0
    assert lavender("slip", tmp_path / "changed.mjb", "--steps", 20)[0] == 0
    assert (
        lavender("record", tmp_path / "changed.mjb", "--steps", 20, "--out", tmp_path / "steps")[0]
        == 0
    )
    recorded = lv.load(next((tmp_path / "steps").glob("step_*.npz")))
    assert recorded.m > 0
    report = (
        "report",
        tmp_path / "changed.mjb",
        "--steps",
        10,
        "--solvers",
        "newton",
        "--no-figures",
    )
    assert lavender(*report, "--out", tmp_path / "page")[0] == 0
