"""`Recorder`: selection, files, claims, states, worlds that cannot be judged, and readers of the folder."""

import json

import numpy as np
import pytest

import lavender as lv
from lavender.report.tables import read_engine_answers

CONES = lv.Cones.contacts(0.5, tangents=1)


def batch_of(v_free):
    """Blocks of 1 kg on the ground, one world for each velocity (n, 2) [m/s]: tangent, normal."""
    n = len(v_free)
    jac = np.broadcast_to(np.eye(2)[::-1], (n, 2, 2)).copy()
    return lv.Batch(
        jac, np.broadcast_to(np.eye(2), (n, 2, 2)).copy(), np.array(v_free, float), cones=CONES
    )


def step_of(errors, nan=()):
    """One step in which the normal impulse of each world is wrong by `errors` [N s of 1 kg = m/s]."""
    v_free = np.tile([0.0, -1.0], (len(errors), 1))
    v_free[list(nan)] = np.nan
    batch = batch_of(v_free)
    impulse = np.tile([1.0, 0.0], (len(errors), 1))
    impulse[:, 0] -= errors
    claims = lv.io.Claims(
        np.array(errors) < 0.05, np.arange(len(errors)), {"r_p": np.array(errors, float)}
    )
    return lv.io.EngineStep(batch, impulse, claims)


def lines_of(folder):
    return [json.loads(line) for line in (folder / "engine.jsonl").read_text().splitlines()]


def test_recorder_keeps_the_worst_answers_of_all_steps(tmp_path):
    rng = np.random.default_rng(0)
    steps = rng.uniform(0.0, 0.4, (12, 5))
    with lv.io.Recorder(tmp_path / "worst", keep_worst=4) as recorder:
        for errors in steps:
            recorder.add(step_of(errors), state={"position": np.arange(5.0)[:, None]})
    ranked = sorted(
        ((e, s, w) for s, row in enumerate(steps) for w, e in enumerate(row)), reverse=True
    )[:4]
    expected = {f"step_{s:06d}_world_{w:04d}.npz": (e, w) for e, s, w in ranked}
    assert set(recorder.files) == set(expected)
    assert {p.name for p in (tmp_path / "worst").glob("*.npz")} == set(expected)
    assert {p.name for p in (tmp_path / "worst" / "states").glob("*.npz")} == set(expected)
    for line in lines_of(tmp_path / "worst"):
        error, world = expected[line["file"]]
        assert line["velocity"] == pytest.approx(error) and line["world"] == world
        assert line["claimed"] is False and line["claimed_residuals"]["r_p"] == pytest.approx(error)
        stored = lv.io.read(tmp_path / "worst" / line["file"])
        assert lv.residual(stored.problem, stored.impulse).velocity == pytest.approx(error)
        state = lv.io.read_recorded_state(tmp_path / "worst", line["file"])
        assert state["position"].tolist() == [world]


def test_recorder_with_every_and_when_keeps_selected_and_worst_steps(tmp_path):
    with lv.io.Recorder(
        tmp_path / "a", every=3, keep_worst=1, when=lambda v: v.claimed and v.world == 1
    ) as recorder:
        for _ in range(5):
            recorder.add(step_of([0.3, 0.01]))
    wanted = {(s, w) for s in (0, 3) for w in (0, 1)} | {(s, 1) for s in range(5)}
    assert {(line["step"], line["world"]) for line in lines_of(tmp_path / "a")} == wanted
    verdicts = recorder.n_steps
    assert verdicts == 5


def test_recorder_with_a_world_of_nan_writes_one_line_for_it_and_continues(tmp_path):
    with lv.io.Recorder(tmp_path / "a", keep_worst=2) as recorder:
        for _ in range(3):
            verdicts = recorder.add(step_of([0.1, 0.2, 0.3], nan=[1]))
    assert verdicts[1].verdict == "" and np.isnan(verdicts[1].velocity_error)
    left_out = [line for line in lines_of(tmp_path / "a") if "left_out" in line]
    assert len(left_out) == 1 and left_out[0]["world"] == 1 and "v_free" in left_out[0]["left_out"]
    assert len(recorder.files) == 2


def test_recorder_accepts_single_problems_and_pairs(tmp_path):
    problem = lv.Problem.lcp(np.eye(2), np.ones(2))
    with lv.io.Recorder(tmp_path / "a", every=1) as recorder:
        recorder.add(problem, np.ones(2), state={"time": 0.5})
        recorder.add((problem, np.array([1.0, 0.9])))
        with pytest.raises(lv.InputError, match="impulse is missing"):
            recorder.add(problem)
        with pytest.raises(lv.InputError, match="a list"):
            recorder.add([problem], np.ones(2))
    assert recorder.files == ("step_000000_world_0000.npz", "step_000001_world_0000.npz")
    assert lv.io.read_recorded_state(tmp_path / "a", recorder.files[0])["time"] == 0.5
    with pytest.raises(lv.InputError, match="recorded with state="):
        lv.io.read_recorded_state(tmp_path / "a", recorder.files[1])


def test_recorder_writes_json_without_nan(tmp_path):
    """JSON has no NaN: a time that is not known is null, and readers take it as missing."""
    with lv.io.Recorder(tmp_path / "all", every=1) as recorder:
        recorder.add(step_of([0.0, 0.1]))

    def reject(word):
        raise AssertionError(word)

    lines = (tmp_path / "all" / "engine.jsonl").read_text().splitlines()
    entries = [json.loads(line, parse_constant=reject) for line in lines]
    assert len(entries) == 2 and all(entry["seconds"] is None for entry in entries)
    answers = read_engine_answers([str(tmp_path / "all")], lv.report.run([], ["pgs"]))
    assert answers["seconds"].isna().all() and len(answers) == 2


def test_recorder_with_wrong_arguments_or_folders_raises(tmp_path):
    with pytest.raises(lv.InputError, match="no condition selects steps"):
        lv.io.Recorder(tmp_path / "a")
    with pytest.raises(lv.InputError, match="when is 3"):
        lv.io.Recorder(tmp_path / "a", when=3)
    with lv.io.Recorder(tmp_path / "a", every=1) as recorder:
        recorder.add(step_of([0.1]))
        with pytest.raises(
            lv.InputError, match=r"state 'q' has shape \(3,\); \(1 worlds, ...\) is needed"
        ):
            recorder.add(step_of([0.1]), state={"q": np.zeros(3)})
    with pytest.raises(lv.InputError, match="holds 1 problem files"):
        lv.io.Recorder(tmp_path / "a", every=1)
    with lv.io.Recorder(tmp_path / "a", every=1, replace=True) as recorder:
        assert not list((tmp_path / "a").glob("*.npz"))
