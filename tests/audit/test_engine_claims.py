"""Claims of an engine against verdicts, on steps of known errors."""

import io
import json

import numpy as np
import pytest
from approved_texts import check_text
from rich.console import Console

import lavender as lv
from lavender.audit.audit import audit_steps
from lavender.audit.engine_scenes import NEWTON_STATE, read_engine_states, step_scene
from lavender.audit.pieces import N_WORST_WORLDS, Judging, judge_steps
from lavender.audit.result import OUTCOMES, Audit
from lavender.audit.simulated_worlds import Divergence, Frame, Runs

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
    return lv.io.EngineStep(
        batch, impulse, lv.io.Claims(np.array(claimed, bool), np.full(n, 3), {})
    )


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
    result.write(tmp_path)
    stored = lv.io.read(tmp_path / "worst" / "worst_1.npz")
    assert lv.residual(stored.problem, stored.impulse).velocity == pytest.approx(0.3)
    result.provenance |= {"date": "2026-01-01T00:00:00+00:00", "lavender": "0.1.0", "command": None}
    terminal = io.StringIO()
    result.page.print_short(Console(file=terminal, width=100))
    check_text("audit.txt", "terminal", terminal.getvalue())
    check_text("audit.txt", "numbers of the page", json.dumps(result.page.numbers, indent=1))
    assert all(name in result.page.write(tmp_path / "page").read_text() for name in OUTCOMES)
    assert (np.load(tmp_path / "records.npz")["converged"] == result.converged).all()


@pytest.mark.parametrize(("bad_step", "is_exact"), [(None, True), (0, False), (1, False)])
def test_solves_before_a_divergence_are_exact_only_if_every_one_is(bad_step, is_exact):
    steps = [step_of([0.2 if k == bad_step else 0.0], [1]) for k in range(3)]
    result = audit_steps(
        steps, threshold=1e3
    )  # a wrong step is close enough to the user, and not exact
    assert result.has_exact_solves(Divergence(0, 2, "speed", False)) == is_exact


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
        step_of([0.0, 0.2, 0.0], [1, 1, 0])._replace(
            state={"joint_q": np.array([[0.0], [1.0], [2.0]])}
        ),
        step_of([0.0, 0.0, 0.3], [1, 1, 0])._replace(
            state={"joint_q": np.array([[3.0], [4.0], [5.0]])}
        ),
    ]
    audit_steps(steps, threshold=1e-4).write(tmp_path)
    with np.load(tmp_path / "states.npz") as file:
        found = {
            (s, w): q[0]
            for s, w, q in zip(file["step"], file["world"], file["joint_q"], strict=True)
        }
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
        step_scene(
            scene,
            "kamino",
            worlds=1,
            states={"body_q": np.zeros((1, 3, 7)), "body_qd": np.zeros((1, 3, 6))},
        )
    noisy = next(step_scene(scene, "kamino", worlds=3, steps=1, spread=0.1)).state
    assert np.ptp(noisy["body_qd"], axis=0).max() > 0.01
    assert not noisy["body_qd"][0].any()


def test_audit_of_steps_judged_in_pieces_equals_the_audit_of_one_piece(tmp_path):
    worlds, steps = 8, 6
    world, step = np.repeat(np.arange(worlds), steps), np.tile(np.arange(steps), worlds)
    errors = np.where(step % 2 == 0, 0.0, 0.1 + 1e-3 * step + 1e-2 * world)
    found = []
    for sizes in ([48], [12, 36], [7, 1, 20, 20]):
        one = Audit.with_size(Runs("boxes", None, worlds, steps), "theirs")
        for at in np.split(np.arange(48), np.cumsum(sizes)[:-1]):
            answer = step_of(errors[at], np.ones(len(at)))
            ones = np.ones(len(at), int)
            frame = Frame(
                answer.batch, answer.impulse, {}, rows=2 * ones, contacts=ones, n_dropped=len(at)
            )
            judging = Judging("float64", 1e-6, None, contact_share=0.25)
            one.add_piece(
                judge_steps(frame, judging, world[at], step[at], lambda i: {"q": np.zeros(1)}), None
            )
        found.append(one)
        assert one.n_dropped == 48 and one.where == found[0].where
        np.testing.assert_array_equal(one.numbers, found[0].numbers)
        assert [(w.world, w.step, w.velocity) for w in one.worst] == [
            (w, 5, one.numbers[0, w, 5]) for w in (7, 6, 5)
        ]
        wrong = np.sort(one.numbers[0][one.is_unconverged])
        assert len(wrong) == 24 and one.errors["velocity, unconverged [m/s]"].iloc[0] == wrong[12]
        assert one.errors["velocity [m/s]"].iloc[0] == np.quantile(
            one.numbers[0], 0.5, method="higher"
        )
    first, last = (found[0].contact_states[i] for i in (0, -1))
    assert len(found[0].contact_states) == 12 and (first.world, last.world) == (
        0,
        7,
    )  # All worlds have contact.


def test_audit_is_unmet_for_each_reason_alone():
    answer = [step_of([0.0, 0.0], [1, 1])]
    assert not audit_steps(answer, max_velocity_error=0.1).is_unmet
    assert audit_steps([step_of([0.0, 0.2], [1, 1])], max_velocity_error=0.1).is_unmet
    assert audit_steps([step_of([0.0, 0.0], [1, 1], nan=[1])], max_velocity_error=0.1).is_unmet
    for change in ({"n_dropped": 1}, {"divergences": [Divergence(0, 0, "qvel", False)]}):
        found = audit_steps(answer, max_velocity_error=0.1)
        vars(found).update(change)
        assert found.is_unmet
