"""Audits of models as they are: changed after loading, in an environment, against another model, and resumed."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from calls import BOXES
from calls import EARLY_BOXES as EARLY
from mujoco_scene import get_state, mj

import lavender as lv
from lavender.audit import audit as module
from lavender.audit.audit import audit
from lavender.io.start_states import hash_model, load_model, read_states


def judge_forward(model, data):
    """Return the judge's velocity error [m/s] of MuJoCo's answer in the present state."""
    copied = mj.MjData(model)
    mj.mj_setState(model, copied, get_state(model, data), mj.mjtState.mjSTATE_INTEGRATION)
    mj.mj_forward(model, copied)
    return lv.residual(
        lv.io.from_mujoco(model, copied), lv.io.mujoco.impulse(model, copied)
    ).velocity


def make_changed_model(options=EARLY):
    """Return a model whose friction, masses and gravity were changed after loading."""
    model = mj.MjModel.from_xml_string(BOXES.format(options=options))
    model.geom_friction[:] *= 0.1
    model.body_mass[:] *= 3.0
    model.opt.gravity[0] = 2.0
    return model


def test_audit_judges_the_changed_model_in_memory_and_as_mjb_alike(boxes, tmp_path):
    model = make_changed_model()
    mj.mj_saveModel(model, str(tmp_path / "changed.mjb"))
    data = mj.MjData(model)
    rng = np.random.default_rng(0)
    expected = []
    for _ in range(30):
        data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        expected.append(judge_forward(model, data))
        mj.mj_step(model, data)
    for source in (model, tmp_path / "changed.mjb", str(tmp_path / "changed.mjb")):
        found = audit(source, worlds=1, steps=30, workers=1)
        np.testing.assert_allclose(found.numbers[0, 0], expected, rtol=1e-6, atol=1e-12)
    assert not np.allclose(
        audit(boxes(EARLY), worlds=1, steps=30, workers=1).numbers[0, 0], expected
    )


def test_audit_with_control_hold_keeps_the_controls_of_the_start_state(boxes, tmp_path):
    path = boxes(EARLY)
    model = mj.MjModel.from_xml_path(str(path))
    states = {
        "qpos": model.qpos0[None],
        "qvel": np.zeros((1, model.nv)),
        "ctrl": np.full((1, model.nu), 0.7),
    }
    found = audit(path, worlds=1, steps=10, workers=1, control="hold", states=states)
    same = audit(
        path, worlds=1, steps=10, workers=1, control=np.full((1, model.nu), 0.7), states=states
    )
    assert (found.numbers == same.numbers).all()


class Environment:
    """An environment of the boxes that changes their friction in each reset and in each step, like randomisation."""

    spec = SimpleNamespace(id="Boxes-v0")

    def __init__(self, length=4, options=EARLY):
        self.model = mj.MjModel.from_xml_string(BOXES.format(options=options))
        self.data = mj.MjData(self.model)
        self.unwrapped = self
        self.length = length
        self.action_space = SimpleNamespace(
            seed=self.seed_actions, sample=lambda: self.rng.uniform(-1.0, 1.0, 1)
        )
        self.errors = []  # Of every step, by the judge of one problem.

    def seed_actions(self, seed):
        self.rng = np.random.default_rng(seed)

    def reset(self, seed=None):
        self.count = 0
        if seed is not None:
            self.random = np.random.default_rng(seed)
        mj.mj_resetData(self.model, self.data)
        self.model.geom_friction[:, 0] = self.random.uniform(0.05, 1.0)
        self.data.qvel[:] = self.random.normal(size=self.model.nv)
        mj.mj_step(self.model, self.data)  # A step of the reset is not judged.
        return self.data.qpos.copy(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        self.model.body_mass[1] *= 1.01
        for _ in range(3):
            self.errors.append(judge_forward(self.model, self.data))
            mj.mj_step(self.model, self.data)
        mj.mj_step(self.model, mj.MjData(self.model))  # Data of a planner are not judged.
        self.count += 1
        return self.data.qpos.copy(), 0.0, self.count == self.length, False, {}


def test_audit_of_an_environment_judges_each_step_with_the_model_at_its_time(tmp_path):
    env = Environment()
    mj_step = mj.mj_step
    found = audit(env, worlds=2, steps=30, policy=lambda observation: np.sin(observation[:1]))
    assert mj.mj_step is mj_step and (found.runs.name, found.runs.worlds) == ("Boxes-v0", 2)
    expected = np.array(env.errors).reshape(2, 30)
    np.testing.assert_allclose(found.numbers[0], expected, rtol=1e-6, atol=1e-12)
    assert found.is_unconverged.any() and len(found.worst) == 2
    found.write(tmp_path)
    # A state of the environment does not belong to the model that was loaded.
    loaded = mj.MjModel.from_xml_string(BOXES.format(options=EARLY))
    assert (
        "are of a model with other bodies"
        in read_states(mj, loaded, tmp_path / "states.npz").misfit
    )
    notes = audit(loaded, worlds=1, steps=1, workers=1, states=tmp_path / "states.npz").advice
    assert any("give the changed model" in note for note in notes)


@pytest.mark.filterwarnings("ignore")
def test_audit_of_a_gymnasium_environment_counts_its_steps():
    gymnasium = pytest.importorskip("gymnasium")
    pytest.importorskip("imageio", reason="needs the extra mujoco of gymnasium")
    env = gymnasium.make("Hopper-v5")
    found = audit(env, worlds=2, steps=20)
    assert found.n_judged == 40 and found.runs.name == "Hopper-v5" and found.rows.max() > 0


def test_read_states_of_a_model_with_other_options_accepts_them(boxes, tmp_path):
    audit(boxes(EARLY), worlds=2, steps=30, workers=1).write(tmp_path)
    model = mj.MjModel.from_xml_string(BOXES.format(options='solver="CG" iterations="3"'))
    assert read_states(mj, model, tmp_path / "states.npz").misfit == ""
    model.geom_rgba[:] = 0.3  # The appearance does not count.
    assert hash_model(model) == hash_model(load_model(boxes(EARLY))[1])
    model.dof_damping[0] = 1.0
    assert "other bodies, geoms, joints" in read_states(mj, model, tmp_path / "states.npz").misfit


def test_audit_against_another_model_judges_both_on_the_same_states(boxes, tmp_path):
    path = boxes(EARLY)
    other = tmp_path / "other.xml"
    other.write_text(BOXES.format(options='solver="Newton" iterations="100" tolerance="1e-15"'))
    found = audit(path, worlds=2, steps=30, workers=1, against=other)
    alone = audit(path, worlds=2, steps=30, workers=1)
    assert found.numbers.tobytes() == alone.numbers.tobytes()
    model = mj.MjModel.from_xml_path(str(path))
    converged = mj.MjModel.from_xml_path(str(other))
    data = mj.MjData(model)
    copied = mj.MjData(converged)
    rng = np.random.default_rng(0)
    expected = []
    for _ in range(30):
        data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
        mj.mj_setState(converged, copied, get_state(model, data), mj.mjtState.mjSTATE_INTEGRATION)
        expected.append(judge_forward(converged, copied))
        mj.mj_step(model, data)
    np.testing.assert_allclose(found.against.numbers[0, 0], expected, rtol=1e-6, atol=1e-13)
    table = found.comparison
    assert table.columns.tolist()[1:] == [f"{path.name} [m/s]", "against other.xml [m/s]"]
    assert table.iloc[-1, 1:].tolist() == [alone.numbers[0].max(), found.against.numbers[0].max()]
    assert "Against other.xml, on the same 60 states" in found.headline[-1]
    own, its = (x.numbers[0][x.is_judged] for x in (found, found.against))
    smaller, larger = map(
        float,
        re.search(r"smaller in ([\d.]+) % .* larger in ([\d.]+) %", found.headline[-1]).groups(),
    )
    assert (smaller, larger) == pytest.approx(
        (100 * (own < its).mean(), 100 * (own > its).mean()), abs=0.06
    )
    assert smaller != larger
    found.write(tmp_path / "out")
    assert (np.load(tmp_path / "out" / "records.npz")["against"] == found.against.numbers[0]).all()


def test_audit_stopped_by_ctrl_c_has_the_complete_worlds(boxes, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "STEPS_PER_TASK", 20)

    def stop(event):
        if event.done >= 40:
            raise KeyboardInterrupt

    path = boxes(EARLY)
    found = audit(path, worlds=4, steps=20, workers=1, watch=stop)
    assert found.is_stopped and found.n_processed == 40
    whole = audit(path, worlds=4, steps=20, workers=1)
    assert (
        found.numbers[:, :2].tobytes() == whole.numbers[:, :2].tobytes()
        and (found.verdict[2:] == -1).all()
    )
    found.write(tmp_path / "out")
    assert (np.load(tmp_path / "out" / "records.npz")["verdict"] == found.verdict).all()
    assert "Stopped before the end" in found.page.write(tmp_path / "out").read_text()


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_audit_compares_the_next_velocities_with_the_predicted_ones(integrator, tmp_path):
    (tmp_path / "box.xml").write_text(
        f"""<mujoco><option integrator="{integrator}" iterations="2"/><worldbody><geom type="plane" size="5 5 1"/>
        <body pos="0 0 .099"><freejoint/><geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""
    )
    model = mj.MjModel.from_xml_path(str(tmp_path / "box.xml"))
    whole = audit(model, worlds=2, steps=10, workers=1)
    assert whole.prediction == (20, 0, 0.0, None)
    assert "predicts" not in " ".join(whole.advice)

    class Hooked:
        """An environment with a hook that pushes the body within the third step of MuJoCo."""

        def __init__(self):
            self.unwrapped = self
            self.model = model
            self.data = mj.MjData(model)
            self.n = 0
            self.action_space = type(
                "Space", (), {"seed": lambda self, seed: None, "sample": lambda self: None}
            )()

        def reset(self, seed=None):
            self.n = 0
            mj.mj_resetData(self.model, self.data)
            return None, {}

        def step(self, action):
            self.n += 1
            self.model.opt.gravity[0] = 0.0
            mj.set_mjcb_control(self.push if self.n == 3 else None)
            mj.mj_step(self.model, self.data)
            mj.set_mjcb_control(None)
            return None, 0.0, False, False, {}

        def push(self, model, data):
            data.qfrc_applied[0] = 7.0

    found = audit(Hooked(), policy=lambda observation: None, worlds=1, steps=5)
    assert (found.prediction.steps, found.prediction.different, found.prediction.first) == (
        5,
        1,
        (0, 2),
    )
    assert "did not move as the judged answer predicts" in " ".join(found.advice)


def test_audit_names_versions_settings_model_and_date():
    model = mj.MjModel.from_xml_string(BOXES.format(options=EARLY))
    found = audit(model, worlds=1, steps=5, workers=1).totals["provenance"]
    assert (found["engine"], found["engine_version"], found["mujoco"]) == (
        "mujoco",
        mj.__version__,
        mj.__version__,
    )
    assert found["lavender"] == lv.__version__
    assert found["model_hash"] == hash_model(model, options=True)[:12]
    assert found["integrator"] == "Euler" and found["timestep"] == model.opt.timestep
    assert found["command"] is None or found["command"].startswith("lavender")
    assert found["date"].endswith("+00:00")
