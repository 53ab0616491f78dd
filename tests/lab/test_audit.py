"""Every step of many worlds judged: MuJoCo's own answers, what ended early, and the way back to the worst."""

import numpy as np
import pytest
from calls import EARLY_BOXES as EARLY
from mujoco_scene import mj, whole_mass

import lavender as lv
from lavender.io.efc import from_efc
from lavender.lab import audit as module
from lavender.lab.audit import VERDICTS, audit
from lavender.lab.worlds import Frame, Runs


def own_errors(path, world, steps, seed=0, spread=0.1):
    """The judge on the forward pass of each step, in the run itself, by the importer of one problem."""
    made = mj.MjModel.from_xml_path(str(path))
    data, rng = mj.MjData(made), np.random.default_rng(seed + world)
    if world:
        data.qvel[:] += spread * np.random.default_rng([seed, world]).standard_normal(made.nv)
    out = []
    for _ in range(steps):
        data.ctrl[:] = rng.uniform(-1.0, 1.0, made.nu)
        mj.mj_forward(made, data)
        out.append(lv.residual(lv.io.from_mujoco(made, data), lv.io.mujoco.impulse(made, data)))
        mj.mj_step(made, data)
    return out


@pytest.mark.parametrize("options", [EARLY, f'{EARLY} cone="elliptic"', EARLY + ' jacobian="sparse"'])
def test_numbers_are_those_of_the_run_itself(boxes, options):
    path = boxes(options)
    found = audit(path, worlds=2, steps=30, workers=1)
    for world in range(2):
        want = own_errors(path, world, 30)
        np.testing.assert_allclose(found.numbers[0, world], [r.velocity for r in want], rtol=1e-6, atol=1e-12)
        pushes = [abs(r.error[r.worst_row]) if r.worst_row >= 0 else 0.0 for r in want]
        np.testing.assert_allclose(found.numbers[1, world], pushes, rtol=1e-6, atol=1e-12)
        assert found.early[world].tolist() == [
            r.verdict in ("stopped before convergence", "wrong") for r in want
        ]
    assert found.early.any()


def test_workers_change_no_bit(boxes, monkeypatch):
    monkeypatch.setattr(module, "TASK", 20)
    path = boxes(EARLY)
    one, two = (audit(path, worlds=4, steps=20, workers=n) for n in (1, 2))
    assert one.numbers.tobytes() == two.numbers.tobytes()
    assert one.where == two.where
    assert [(w.world, w.step) for w in one.worst] == [(w.world, w.step) for w in two.worst]


def test_the_worst_can_be_gone_back_to(boxes, tmp_path):
    path = boxes(EARLY)
    found = audit(path, worlds=3, steps=25, workers=1)
    found.write(tmp_path / "out")
    made = mj.MjModel.from_xml_path(str(path))
    states = np.load(tmp_path / "out" / "states.npz")
    speeds = np.where(found.early, found.numbers[0], 0.0)
    assert states["world"].tolist() == np.argsort(-speeds.max(axis=1)).tolist()
    for i, (world, step) in enumerate(zip(states["world"], states["step"], strict=True)):
        stored = lv.io.read(tmp_path / "out" / "worst" / f"worst_{i + 1}.npz")
        assert lv.residual(stored.problem, stored.impulse).velocity == pytest.approx(speeds[world].max())
        data = mj.MjData(made)
        for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
            getattr(data, name)[:] = states[name][i]
        mj.mj_forward(made, data)
        np.testing.assert_allclose(lv.io.mujoco.impulse(made, data), stored.impulse, rtol=1e-9, atol=1e-12)
        assert speeds[world].argmax() == step


def frames_in_float32(planted):
    """Answers of MuJoCo rounded to float32, some of them a hundredth short."""

    def frames(engine, runs):
        _, made = runs.load()
        data = mj.MjData(made)
        for step in range(runs.steps):
            mj.mj_forward(made, data)
            whole = whole_mass(made, data)
            force = data.efc_force * (0.99 if step in planted else 1.0)
            efc = {
                "J": data.efc_J.reshape(1, -1, made.nv),
                "D": data.efc_D[None],
                "aref": data.efc_aref[None],
            }
            given = {f"efc_{name}": x.astype(np.float32) for name, x in efc.items()}
            rest = {"M": whole[None], "qvel": data.qvel[None], "qacc_smooth": data.qacc_smooth[None]}
            yield Frame(*from_efc(
                **given, **{name: x.astype(np.float32) for name, x in rest.items()}, efc_type=data.efc_type[None],
                efc_force=force[None].astype(np.float32), timestep=made.opt.timestep,
            ), {"qpos": data.qpos[None].copy()})  # fmt: skip
            mj.mj_step(made, data)

    return frames


def test_the_floor_of_float32_is_told_from_an_early_stop(boxes, monkeypatch):
    planted = {3, 9, 12}
    monkeypatch.setattr(module, "frames", frames_in_float32(planted))
    found = audit(boxes('jacobian="dense"'), worlds=1, steps=16, engine="mjx", threshold=0.0)
    assert set(np.flatnonzero(found.early[0])) == planted
    assert (found.numbers[0, 0] > 1e-9).sum() > len(planted)  # rounding leaves errors that float64 would not


def test_ctrl_c_keeps_what_there_is(boxes, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "TASK", 20)

    def watch(event):
        raise KeyboardInterrupt

    found = audit(boxes(EARLY), worlds=3, steps=20, workers=1, watch=watch)
    assert found.stopped and found.done == 20
    assert np.isnan(found.numbers[:, 1:]).all()
    found.write(tmp_path / "out")
    assert "Stopped before the end" in found.sheet.write(tmp_path / "out").read_text()


def test_what_is_close_enough_may_still_not_be_accepted(boxes):
    found = audit(boxes(EARLY), worlds=1, steps=10, workers=1, threshold=1e3)
    assert not found.early.any() and found.largest == found.numbers[0].max() > 1e-3


def test_a_world_that_is_not_finite_is_accepted_by_nobody(boxes, monkeypatch):
    states_of = module.states_of

    def spoiled(*given):
        states = states_of(*given)
        states[5] = np.nan
        return states

    monkeypatch.setattr(module, "states_of", spoiled)
    found = audit(boxes(), worlds=1, steps=10, workers=1)
    assert VERDICTS[found.verdict[0, 5]] == "not finite" and found.largest == np.inf


def test_a_world_in_which_mujoco_ends_in_an_error_is_not_finite_from_there_on(boxes, monkeypatch):
    step = mj.mj_step

    def dies(boxes, data):
        if data.time > 0.03:
            raise mj.FatalError("out of memory")
        step(boxes, data)

    monkeypatch.setattr(mj, "mj_step", dies)
    found = audit(boxes(), worlds=1, steps=12, workers=1)
    assert [VERDICTS[i] == "not finite" for i in found.verdict[0]] == [k >= 8 for k in range(12)]
    assert found.head.endswith("ended early. 1 world flew apart, of which no step is judged from there on.")
    assert found.told["worlds_apart"] == 1


def test_a_model_whose_start_ends_mujoco_in_an_error_is_refused(boxes, monkeypatch):
    def ends(*_):
        raise mj.FatalError("not supported")

    monkeypatch.setattr(mj, "mj_forward", ends)
    with pytest.raises(lv.InputError, match="state 0: MuJoCo ends in an error, not supported"):
        audit(boxes(), worlds=1, steps=12, workers=1)


@pytest.mark.filterwarnings("ignore")
def test_a_world_that_mujoco_begins_anew_ends_there(boxes, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    found = audit(boxes(), worlds=2, steps=10, workers=1, spread=1e12)
    assert (found.verdict[1, 1:] == VERDICTS.index("not finite")).all()
    assert (found.verdict[0] < VERDICTS.index("not finite")).all() and found.largest == np.inf


@pytest.mark.parametrize(
    ("options", "given", "words"),
    [
        ("", {"engine": "bullet"}, "engine"),
        ("", {"worlds": 0}, "worlds"),
        ("", {"control": "zero", "seed": -1}, "seed"),
        ("", {"spread": -1.0}, "spread"),
        ("", {"precision": "float16"}, "precision"),
        ("", {"control": "sometimes"}, "controls sometimes"),
        ("", {"workers": 0}, "workers"),
        ("", {"backend": "carrier pigeon"}, "backend"),
    ],
)
def test_bad_words_are_told(boxes, options, given, words):
    with pytest.raises(lv.LavenderError, match=words):
        audit(boxes(options), **{"worlds": 1, "steps": 2, "workers": 1} | given)


def test_a_file_that_is_no_model_is_told(tmp_path):
    (tmp_path / "torn.xml").write_text("<mujoco><worldbody>")
    with pytest.raises(lv.InputError, match=r"torn\.xml"):
        audit(tmp_path / "torn.xml", worlds=1, steps=2)


@pytest.mark.parametrize(("engine", "package"), [("mjx", "mujoco.mjx"), ("mujoco_warp", "mujoco_warp")])
def test_an_engine_that_is_not_installed_says_how(boxes, engine, package, monkeypatch):
    import sys

    for name in (package, "jax", "warp"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(lv.InputError, match="pip install mujoco-"):
        audit(boxes(), worlds=1, steps=2, engine=engine)


@pytest.mark.parametrize("options", ['solver="Newton"', 'solver="Newton" cone="elliptic"'])
@pytest.mark.parametrize(("engine", "package"), [("mjx", "mujoco.mjx"), ("mujoco_warp", "mujoco_warp")])
@pytest.mark.filterwarnings("ignore")
def test_other_engines_pose_the_problem_that_mujoco_poses(boxes, engine, package, options):
    pytest.importorskip(package, reason="needs the engine")
    path = str(boxes(options + ' iterations="100" ls_iterations="50"'))
    (frame,) = list(module.frames(engine, Runs(path, 2, 1)))
    made = mj.MjModel.from_xml_path(path)
    for world in range(2):
        data = mj.MjData(made)
        for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
            getattr(data, name)[:] = frame.state[name][world]
        mj.mj_forward(made, data)
        want = lv.io.from_mujoco(made, data)
        moved = want.velocity(lv.solve(want, tol=1e-9).impulse)
        own = frame.batch[world]
        np.testing.assert_allclose(own.velocity(lv.solve(own, tol=1e-6).impulse), moved, atol=2e-3)
        assert any("floor" in name for name in frame.batch.names_of(world))
