"""Claims of an engine against verdicts, on steps of known errors."""

import numpy as np
import pytest

import lavender as lv
from lavender.audit.audit import audit_steps
from lavender.audit.engine_scenes import NEWTON_STATE, read_engine_states, step_scene
from lavender.audit.pieces import N_WORST_WORLDS, Judging, judge_steps
from lavender.audit.result import OUTCOMES
from lavender.audit.simulated_worlds import Frame

CONES = lv.Cones.contacts(0.5, tangents=1)


def step_of(errors, claimed, mass=1.0, nan=()):
    """Worlds of a body of `mass` [kg] that falls with 1 m/s; its normal velocity is wrong by `errors` [m/s]."""
    n = len(errors)
    v_free = np.tile([0.0, -1.0], (n, 1))
    v_free[list(nan)] = np.nan
    jac = np.broadcast_to(np.eye(2)[::-1], (n, 2, 2)).copy()
    batch = lv.Batch(jac, mass * np.broadcast_to(np.eye(2), (n, 2, 2)), v_free, cones=CONES)
    batch.names_of = lambda i: ["contact 7 (ground, foot)"]
    impulse = np.tile([mass, 0.0], (n, 1))
    impulse[:, 0] -= mass * np.array(errors)
    return lv.io.EngineStep(batch, impulse, lv.io.Claims(np.array(claimed, bool), np.full(n, 3), {}))


def test_audit_steps_counts_each_outcome_of_claims(tmp_path):
    steps = [
        step_of([0.0, 0.2, 0.0, 0.3, 0.0, 0.0], [1, 1, 0, 0, 1, 0], nan=[4, 5]),
        step_of([0.0, 0.1, 1e-6, 0.0, 0.0, 0.0], [1, 1, 0, 1, 1, 0], nan=[4, 5]),
    ]
    result = audit_steps(steps, engine="theirs", name="boxes", threshold=1e-4)
    assert list(result.claim_counts.values()) == [3, 2, 2, 1, 2, 2]
    assert result.claims["steps"].tolist() == [3, 2, 2, 1, 2, 2]
    assert result.outcome.shape == (6, 2)
    assert result.max_velocity_error == pytest.approx(0.3) and result.is_unmet
    assert result.where == {"contact (ground, foot), normal": (3, pytest.approx(0.3))}
    assert "of 7 that the engine calls converged, 4 wrong" in " ".join(result.headline)
    result.write(tmp_path)
    stored = lv.io.read(tmp_path / "worst" / "worst_1.npz")
    assert lv.residual(stored.problem, stored.impulse).velocity == pytest.approx(0.3)
    text = result.page.write(tmp_path / "page").read_text()
    assert all(name in text for name in OUTCOMES)
    assert (np.load(tmp_path / "records.npz")["converged"] == result.converged).all()


def test_audit_steps_at_their_floor_are_below_every_limit():
    step = step_of([2.0**-52, 0.0], [1, 1])
    result = audit_steps([step], threshold=0.0, max_velocity_error=1e-17)
    assert result.numbers[0, 0, 0] > 1e-17 and (result.verdict[:, 0] == 0).all()
    assert (result.n_above_limit, result.max_velocity_error) == (0, 0.0)


def test_judge_steps_without_keep_keeps_the_worst_step_of_each_world():
    """Two worlds have all of the largest errors; without `keep`, other worlds are kept, too."""
    world, step = np.repeat(np.arange(8), 6), np.tile(np.arange(6), 8)
    errors = np.where(world < 2, 0.4, 0.1) + 1e-3 * step + 1e-4 * world
    answer = step_of(errors, np.ones(48))
    ones = np.ones(48, int)
    frame = Frame(answer.batch, answer.impulse, {}, rows=2 * ones, contacts=ones)
    piece = judge_steps(frame, Judging("float64", 1e-6, None), world, step, lambda i: {})
    expected = sorted(range(8), key=lambda w: (w >= 2, -w))[:N_WORST_WORLDS]
    assert [w.world for w in piece.worst] == expected and {w.step for w in piece.worst} == {5}
    kept = judge_steps(frame, Judging("float64", 1e-6, 4), world, step, lambda i: {})
    assert [(w.world, w.step) for w in kept.worst] == [(1, 5), (0, 5), (1, 4), (0, 4)]


def test_audit_steps_of_float32_rounding_counts_no_error():
    step = step_of([1e-7], [1])
    step.batch.precision = "float32"
    assert audit_steps([step], threshold=1e-9).claim_counts["claimed and right"] == 1


def test_audit_steps_stopped_by_ctrl_c_keeps_the_steps_so_far():
    def steps():
        yield step_of([0.0], [1])
        raise KeyboardInterrupt

    result = audit_steps(steps(), total=5)
    assert result.is_stopped and result.n_processed == 1


def test_audit_steps_writes_the_states_before_the_worst_answers(tmp_path):
    steps = [
        step_of([0.0, 0.2, 0.0], [1, 1, 0])._replace(state={"joint_q": np.array([[0.0], [1.0], [2.0]])}),
        step_of([0.0, 0.0, 0.3], [1, 1, 0])._replace(state={"joint_q": np.array([[3.0], [4.0], [5.0]])}),
    ]
    audit_steps(steps, threshold=1e-4).write(tmp_path)
    with np.load(tmp_path / "states.npz") as file:
        found = {(s, w): q[0] for s, w, q in zip(file["step"], file["world"], file["joint_q"], strict=True)}
    assert found[0, 1] == 1.0 and found[1, 2] == 5.0
    states = read_engine_states(tmp_path / "states.npz", NEWTON_STATE)
    assert list(states) == ["joint_q"] and states["joint_q"].shape == (len(found), 1)


def test_step_scene_of_newton_starts_from_stored_states(tmp_path):
    """The worst answers of an audit occur again when it starts from the states that it wrote."""
    pytest.importorskip("newton")
    scene = "boxes_stacked_on_plane"
    first = audit_steps(step_scene(scene, "kamino", worlds=3, steps=4, spread=0.1))
    first.write(tmp_path)
    states = read_engine_states(tmp_path / "states.npz", NEWTON_STATE)
    n = len(states["body_q"])
    running = list(step_scene(scene, "kamino", worlds=n, steps=1, states=tmp_path / "states.npz"))
    again = running[0].state
    for name in NEWTON_STATE:
        np.testing.assert_allclose(again[name], states[name], atol=1e-6)
    assert first.outcome.shape == (3, 4) and len(running[0].batch) == n
    with pytest.raises(lv.InputError, match="body_q has"):
        step_scene(scene, "kamino", worlds=1, states={"body_q": np.zeros((1, 3, 7)), "body_qd": np.zeros((1, 3, 6))})
    noisy = next(step_scene(scene, "kamino", worlds=3, steps=1, spread=0.1)).state
    assert np.ptp(noisy["body_qd"], axis=0).max() > 0.01
    assert not noisy["body_qd"][0].any()


def test_step_scene_of_a_wrong_scene_raises(tmp_path):
    with pytest.raises(lv.UnknownName, match="kamin"):
        step_scene("x", "kamin")
    with pytest.raises(lv.InputError, match="does not exist"):
        step_scene(tmp_path / "scene.py", "genesis")
    (tmp_path / "scene.py").write_text("x = 1\n")
    with pytest.raises(lv.InputError, match="no function build"):
        step_scene(tmp_path / "scene.py", "kamino")
    with pytest.raises(lv.InputError, match="a Python file"):
        step_scene("boxes", "genesis")


def test_audit_steps_of_other_sizes_or_none_raises():
    with pytest.raises(lv.InputError, match="steps is empty"):
        audit_steps([])
    with pytest.raises(lv.InputError, match="2 worlds, and the first step 1"):
        audit_steps([step_of([0.0], [1]), step_of([0.0, 0.0], [1, 1])])
