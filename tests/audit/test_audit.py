"""Every step of many worlds judged: MuJoCo's own answers, which stopped before convergence, and the worst states."""

import io
import itertools
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from calls import BOXES
from calls import EARLY_BOXES as EARLY
from mujoco_scene import mj, whole_mass
from rich.console import Console

import lavender as lv
from lavender.audit import audit as module
from lavender.audit.audit import audit
from lavender.audit.page import AuditCounts
from lavender.audit.pieces import AUDIT_VERDICTS
from lavender.audit.result import Audit
from lavender.audit.simulated_worlds import Frame, Runs, iterate_frames, simulate_world
from lavender.io.efc import from_efc


def words_of(found):
    """Return the headline and the notes of an audit."""
    return " ".join([*found.headline, *found.advice])


def own_errors(path, world, steps, seed=0, spread=0.1):
    """The judge on the forward pass of each step, in the run itself, by the importer of one problem."""
    made = mj.MjModel.from_xml_path(str(path))
    data = mj.MjData(made)
    rng = np.random.default_rng(seed + world)
    if world:
        data.qvel[:] += spread * np.random.default_rng([seed, world]).standard_normal(made.nv)
    out = []
    for _ in range(steps):
        data.ctrl[:] = rng.uniform(-1.0, 1.0, made.nu)
        mj.mj_forward(made, data)
        out.append(lv.residual(lv.io.from_mujoco(made, data), lv.io.mujoco.impulse(made, data)))
        mj.mj_step(made, data)
    return out


@pytest.mark.parametrize(
    "options", [EARLY, f'{EARLY} cone="elliptic"', EARLY + ' jacobian="sparse"']
)
def test_audit_of_two_worlds_equals_the_judge_on_each_step(boxes, options):
    path = boxes(options)
    found = audit(path, worlds=2, steps=30, workers=1)
    for world in range(2):
        want = own_errors(path, world, 30)
        np.testing.assert_allclose(
            found.numbers[0, world], [r.velocity for r in want], rtol=1e-6, atol=1e-12
        )
        pushes = [abs(r.error[r.worst_row]) if r.worst_row >= 0 else 0.0 for r in want]
        np.testing.assert_allclose(found.numbers[1, world], pushes, rtol=1e-6, atol=1e-12)
        assert found.is_unconverged[world].tolist() == [
            r.verdict in ("stopped before convergence", "wrong") for r in want
        ]
    assert found.is_unconverged.any()


def test_audit_worst_states_give_the_same_impulses_in_mujoco(boxes, tmp_path):
    path = boxes(EARLY)
    found = audit(path, worlds=3, steps=25, workers=1, max_velocity_error=1e-9)
    found.write(tmp_path / "out")
    short = Console(file=io.StringIO(), width=1000)
    found.page.print_short(short)
    assert f"--states {tmp_path / 'out' / 'states.npz'}" in short.file.getvalue()
    made = mj.MjModel.from_xml_path(str(path))
    states = np.load(tmp_path / "out" / "states.npz")
    speeds = np.where(found.is_unconverged, found.numbers[0], 0.0)
    assert states["world"].tolist() == np.argsort(-speeds.max(axis=1)).tolist()
    for i, (world, step) in enumerate(zip(states["world"], states["step"], strict=True)):
        stored = lv.io.read(tmp_path / "out" / "worst" / f"worst_{i + 1}.npz")
        assert lv.residual(stored.problem, stored.impulse).velocity == pytest.approx(
            speeds[world].max()
        )
        data = mj.MjData(made)
        for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
            getattr(data, name)[:] = states[name][i]
        mj.mj_forward(made, data)
        np.testing.assert_allclose(
            lv.io.mujoco.impulse(made, data), stored.impulse, rtol=1e-9, atol=1e-12
        )
        assert speeds[world].argmax() == step


def make_frames(change):
    """Return frames of MuJoCo as frames of another engine, with `change(arrays of one world, step)` instead of them."""
    names = ("qpos", "qvel", "qacc", "qacc_smooth", "qfrc_smooth", "efc_D", "efc_aref", "efc_force")

    def frames(engine, runs, njmax=None):
        model = runs.model
        data = mj.MjData(model)
        for step in range(runs.steps):
            mj.mj_forward(model, data)
            arrays = {name: np.array(getattr(data, name))[None] for name in names}
            arrays |= {
                "efc_J": data.efc_J.reshape(1, -1, model.nv),
                "M": whole_mass(model, data)[None],
            }
            arrays = change(arrays, step)
            state = {"qpos": arrays.pop("qpos")}
            n = len(state["qpos"])
            problems = from_efc(**arrays, efc_type=data.efc_type, timestep=model.opt.timestep)
            yield Frame(*problems, state, np.full(n, data.nefc), np.full(n, data.ncon))
            mj.mj_step(model, data)

    return frames


def test_audit_of_float32_separates_rounding_from_an_early_stop(boxes, monkeypatch):
    planted = {3, 9, 12}

    def change(arrays, step):
        arrays["efc_force"] *= 0.99 if step in planted else 1.0
        return {
            name: x.astype(np.float32)
            for name, x in arrays.items()
            if name not in ("qacc", "qfrc_smooth")
        }

    monkeypatch.setattr(module, "iterate_frames", make_frames(change))
    found = audit(boxes('jacobian="dense"'), worlds=1, steps=16, engine="mjx", threshold=0.0)
    assert set(np.flatnonzero(found.is_unconverged[0])) == planted
    assert (found.numbers[0, 0] > 1e-9).sum() > len(
        planted
    )  # rounding leaves errors that float64 would not


def test_audit_of_a_world_that_diverges_judges_the_other_worlds(boxes, monkeypatch):
    """MJX and MuJoCo Warp go on with numbers that are not finite."""

    def change(arrays, step):
        bad = np.nan if step >= 4 else 1.0
        return {
            name: np.concatenate([x, bad * x]).astype(np.float32)
            for name, x in arrays.items()
            if name != "qacc"
        }

    monkeypatch.setattr(module, "iterate_frames", make_frames(change))
    found = audit(boxes('jacobian="dense"'), worlds=2, steps=10, engine="mjx")
    assert (found.n_judged, found.n_unjudged, found.n_diverged) == (14, 6, 1)
    assert [(d.world, d.step, d.is_outside) for d in found.divergences] == [(1, 4, True)]
    assert "1 world diverged, the first at step 4; " in words_of(
        found
    ) and "; 6 steps not judged." in words_of(found)


def test_audit_of_a_world_that_ends_in_a_mujoco_error_judges_only_steps_before(boxes, monkeypatch):
    step = mj.mj_step

    def dies(boxes, data):
        if data.time > 0.03:
            raise mj.FatalError("out of memory")
        step(boxes, data)

    monkeypatch.setattr(mj, "mj_step", dies)
    found = audit(boxes(), worlds=1, steps=12, workers=1)
    assert [AUDIT_VERDICTS[i] == "not judged" for i in found.verdict[0]] == [
        k >= 8 for k in range(12)
    ]
    assert (found.n_judged, found.n_unjudged, found.n_diverged) == (8, 4, 1)
    assert "1 world diverged, the first at step 8; no step is wrong" in words_of(found)
    assert "4 steps not judged" in words_of(found)
    assert "out of memory" in found.divergences[0].cause
    assert "outside" not in words_of(found)  # An error of MuJoCo does not concern the solver.


# A motor that drives itself: its force grows with the velocity, so that no answer of the constraint solver helps.
RUNAWAY = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="5 5 .1"/>
  <body pos="0 0 .099"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  <body pos="2 0 1"><joint name="j" axis="0 1 0"/><geom size=".1" mass="1" pos=".1 0 0"/></body></worldbody>
  <actuator><general joint="j" biastype="affine" biasprm="0 0 {gain}" gainprm="1"/></actuator></mujoco>"""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "threshold", [1e-6, 1e3]
)  # What is close enough to the user need not be exact.
@pytest.mark.parametrize("options", ["", 'solver="PGS" iterations="1"'])
def test_audit_of_a_divergence_after_exact_solves_blames_the_model(
    tmp_path, monkeypatch, options, threshold
):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    (tmp_path / "runaway.xml").write_text(
        RUNAWAY.format(gain=60).replace('"0.01"', f'"0.01" {options}')
    )
    found = audit("runaway.xml", worlds=3, steps=60, workers=1, threshold=threshold)
    assert (
        found.n_diverged == 3
        and found.n_unjudged > 0
        and "random velocities" not in words_of(found)
    )
    assert found.n_judged + found.n_unjudged == found.verdict.size
    assert found.n_judged == np.isfinite(found.numbers[0]).sum()
    assert "3 worlds diverged, the first at step " in words_of(found) and "inf" not in words_of(
        found
    )
    assert np.isfinite(found.max_velocity_error)
    exact = options == ""  # One sweep of PGS does not hold the box.
    assert found.is_unconverged.any() == (not exact and threshold < 1.0)
    assert ("outside the constraint solver" in words_of(found)) == exact
    # Otherwise a sentence explains how to separate the solver from the model.
    assert ('audit again with <option solver="Newton"' in words_of(found)) != exact
    assert found.diverged["solves until then"].tolist() == ["exact" if exact else "not exact"] * 3


def test_audit_rows_and_contacts_equal_those_of_mujoco(boxes):
    path = boxes()
    found = audit(path, worlds=2, steps=60, workers=1)
    made = mj.MjModel.from_xml_path(str(path))
    data = mj.MjData(made)
    rng = np.random.default_rng(0)
    for step in range(60):
        data.ctrl[:] = rng.uniform(-1.0, 1.0, made.nu)
        mj.mj_forward(made, data)
        acting = np.count_nonzero(data.contact.efc_address >= 0) if data.ncon else 0
        assert (found.rows[0, step], found.contacts[0, step]) == (data.nefc, acting)
        mj.mj_step(made, data)
    assert found.judged_sizes.has_enough_contact and found.contacts.max() >= 8
    assert found.totals["contacts"]["maximum"] == found.contacts.max()
    assert found.totals["contacts"]["share"] == np.mean(found.contacts > 0)


def test_audit_of_steps_without_contact_is_unmet(tmp_path):
    (tmp_path / "high.xml").write_text(
        BOXES.format(options="").replace("0 0 0.099", "0 0 9").replace("0.32", "20")
    )
    found = audit(tmp_path / "high.xml", worlds=2, steps=20, workers=1)
    assert (
        "Only 0 of 40 steps judged have contact (0 %), fewer than 20 %" in words_of(found)
        and found.is_unmet
    )
    none = BOXES.format(options="").replace('type="box"', 'type="box" contype="0" conaffinity="0"')
    (tmp_path / "none.xml").write_text(
        none.replace('type="capsule"', 'type="capsule" contype="0" conaffinity="0"')
    )
    found = audit(tmp_path / "none.xml", worlds=1, steps=20, workers=1)
    assert not found.can_touch and "0 of 20 steps judged have a constraint (0 %)" in words_of(found)


@pytest.mark.parametrize(
    "names", [("state",), ("qpos", "qvel", "act", "ctrl", "qacc_warmstart", "world", "step")]
)
def test_audit_from_stored_states_repeats_their_errors(boxes, tmp_path, names):
    path = boxes(EARLY)
    found = audit(path, worlds=3, steps=25, workers=1)
    found.write(tmp_path / "out")
    states = np.load(tmp_path / "out" / "states.npz")
    np.savez(tmp_path / "some.npz", **{name: states[name] for name in names})
    again = audit(path, worlds=4, steps=2, workers=1, states=tmp_path / "some.npz")
    # The fourth world starts from the first state with other velocities.
    assert [w.velocity for w in found.worst] == again.numbers[0, :3, 0].tolist()
    assert again.numbers[0, 3, 0] != again.numbers[0, 0, 0]


KEYFRAMES = """<keyframe><key qpos="0 0 .099 1 0 0 0  0 0 .5 1 0 0 0  0" ctrl=".5"/>
  <key qpos="0 0 2 1 0 0 0  0 0 3 1 0 0 0  0"/></keyframe></mujoco>"""


def test_audit_from_keyframes_starts_worlds_in_them(tmp_path, monkeypatch):
    (tmp_path / "keyed.xml").write_text(BOXES.format(options="").replace("</mujoco>", KEYFRAMES))
    found = audit(tmp_path / "keyed.xml", worlds=2, steps=1, workers=1, states="keyframes")
    assert found.contacts[:, 0].tolist() == [4, 0]
    assert (
        len(
            audit(
                tmp_path / "keyed.xml", worlds=1, steps=1, workers=1, states="keyframes"
            ).runs.starts
        )
        == 1
    )
    monkeypatch.setattr(module, "MAX_DEFAULT_WORLDS", 2)
    found = audit(tmp_path / "keyed.xml", steps=1, workers=1, states="keyframes")
    assert found.contacts[:, 0].tolist() == [4, 0]


NV, NQ = 13, 15
REFUSED = [
    *(
        ({"states": arrays}, words)
        for arrays, words in (
            ({"qpos": np.zeros((2, NQ))}, "has no qvel"),
            (
                {"qpos": np.zeros((2, NQ)), "qvel": np.zeros((3, NV))},
                "2 of qpos, 3 of qvel; one number above 0",
            ),
            ({"qpos": np.zeros((2, NQ - 1)), "qvel": np.zeros((2, NV))}, "qpos"),
            ({"qpos": np.full((1, NQ), np.nan), "qvel": np.zeros((1, NV))}, "qpos"),
            (
                {"qpos": np.zeros((0, NQ)), "qvel": np.zeros((0, NV))},
                "0 of qpos, 0 of qvel; one number above 0",
            ),
            (
                {"qpos": np.zeros((1, NQ)), "qvel": np.zeros((1, NV)), "speed": np.zeros(1)},
                "has an array 'speed'",
            ),
            ({"state": np.zeros((2, 3))}, "mjSTATE_INTEGRATION"),
        )
    ),
    ({"states": "torn.npz"}, "torn.npz"),
    ({"states": "no.npz"}, "no.npz"),
    ({"states": "keyframes"}, "the model has none; a keyframe is needed"),
    ({"engine": "bullet"}, "engine"),
    ({"worlds": 0}, "worlds"),
    ({"control": "zero", "seed": -1}, "seed"),
    ({"spread": -1.0}, "spread"),
    ({"precision": "float16"}, "precision"),
    ({"workers": 0}, "workers"),
    ({"control": "sometimes"}, "controls sometimes"),
    ({"backend": "carrier pigeon"}, "backend"),
]


@pytest.mark.parametrize(("given", "words"), REFUSED)
def test_audit_with_a_wrong_argument_raises_an_error_that_names_it(
    boxes, tmp_path, monkeypatch, given, words
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torn.npz").write_bytes(b"PK torn")
    if isinstance(given.get("states"), dict):
        np.savez("bad.npz", **given["states"])
        given = {"states": "bad.npz"}
    with pytest.raises(lv.LavenderError, match=words):
        audit(boxes(), **{"worlds": 1, "steps": 2, "workers": 1} | given)


# A joint whose damping is negative above 0.025 rad/s: it runs away from larger velocities, and from no smaller one.
FRAGILE = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="5 5 .1"/>
  <body pos="0 0 .099"><joint type="slide" axis="0 0 1"/><geom type="box" size=".1 .1 .1"/></body>
  <body pos="2 0 1"><joint axis="0 1 0" damping="0.5 -20 0"/><inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>
  </body></worldbody></mujoco>"""


@pytest.fixture
def fragile(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there.
    if not hasattr(mj.MjModel, "dof_dampingpoly"):
        pytest.skip("this MuJoCo has no damping that depends on the velocity")
    path = tmp_path / "fragile.xml"
    path.write_text(FRAGILE)
    return path


@pytest.mark.filterwarnings("ignore")
def test_audit_without_a_spread_chooses_one_that_trial_worlds_survive(fragile, boxes):
    found = audit(fragile, worlds=4, steps=50, workers=1)
    assert (found.runs.spread, found.n_diverged) == (0.01, 0)
    assert "0.01 m/s (rad/s) only, because worlds diverged with 0.1 m/s" in words_of(found)
    found = audit(boxes(), worlds=2, steps=5, workers=1)
    assert found.runs.spread == 0.1 and not any("start velocities" in note for note in found.notes)


def test_audit_with_keep_has_the_worst_steps_of_a_world(boxes, tmp_path):
    found = audit(boxes(EARLY), worlds=1, steps=40, workers=1, keep=7)
    speeds = np.where(found.is_unconverged, found.numbers[0], 0.0)[0]
    assert [w.step for w in found.worst] == np.argsort(-speeds, kind="stable")[:7].tolist()
    found.write(tmp_path)
    assert len(np.load(tmp_path / "states.npz")["state"]) == 7
    terminal = Console(file=io.StringIO(), width=200)
    found.page.print_short(terminal)
    assert [f"worst_{i}.npz" in terminal.file.getvalue() for i in range(1, 9)] == [True] * 7 + [
        False
    ]


def test_audit_keeps_states_before_steps_with_contact(boxes, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_CONTACT_STATES", 20)
    path = boxes(EARLY)
    found = audit(path, worlds=2, steps=60, workers=1, keep_contact_states=True)
    n = found.save_states("contact", tmp_path / "states.npz")
    assert 20 <= n <= 22  # Up to one more for each of the batches.
    stored = np.load(tmp_path / "states.npz")
    assert (found.contacts[stored["world"], stored["step"]] > 0).all()
    again = audit(path, worlds=n, steps=1, workers=1, states=tmp_path / "states.npz")
    assert again.numbers[0, :, 0] == pytest.approx(
        found.numbers[0, stored["world"], stored["step"]]
    )
    with pytest.raises(lv.InputError, match="kind"):
        found.save_states("best", tmp_path / "states.npz")


def test_audit_of_an_engine_whose_acceleration_is_not_finite_does_not_judge_its_forces(
    boxes, monkeypatch
):
    """MJX returns forces of 0 with an acceleration of NaN, and goes on."""

    def change(arrays, step):
        arrays["efc_force"] *= step != 3
        arrays["qacc"] *= np.nan if step == 3 else 1.0
        return arrays

    monkeypatch.setattr(module, "iterate_frames", make_frames(change))
    found = audit(boxes('jacobian="dense"'), worlds=1, steps=6, engine="mjx", spread=0.0)
    assert np.flatnonzero(found.verdict[0] == AUDIT_VERDICTS.index("not judged")).tolist() == [3]
    assert [(d.step, d.is_outside) for d in found.divergences] == [(3, False)]
    assert "; 1 step not judged." in words_of(found)
    assert "--engine mujoco" in words_of(found)


HANGING = """<mujoco><option iterations="2" cone="elliptic" jacobian="dense"><flag eulerdamp="{}"/></option>
<worldbody><geom type="plane" size="5 5 1"/>
<body name="a" pos="0 0 .099"><freejoint/><geom size=".1"/></body>
<body pos=".5 0 .15"><joint damping="{}" armature=".01"/><geom type="capsule" fromto="0 0 0 .2 0 -.1" size=".04"/>
<body name="b" pos=".2 0 -.1"><joint frictionloss=".3"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".04"/></body>
</body></worldbody><equality><weld body1="a" body2="b" torquescale=".3"/></equality></mujoco>"""


@pytest.mark.parametrize("engine", ["mjx", "mujoco_warp"])
@pytest.mark.parametrize(("eulerdamp", "damping"), [("disable", 0.3), ("enable", 0.0)])
def test_next_velocity_of_an_engine_follows_from_its_judged_answer(engine, eulerdamp, damping):
    """Two iterations leave forces and acceleration apart by 0.1 of the velocity, in a weld that moves."""
    pytest.importorskip({"mjx": "mujoco.mjx", "mujoco_warp": "mujoco_warp"}[engine])
    runs = Runs.of_model(mj.MjModel.from_xml_string(HANGING.format(eulerdamp, damping)), 2, 5)
    frames = list(iterate_frames(engine, replace(runs, spread=0.3)))
    for now, after in itertools.pairwise(frames):
        for i in range(2):
            problem = now.batch[i]
            motion = now.batch.engine_motions.get(i)
            if motion is None:
                predicted = problem.velocity(now.impulse[i][: problem.m])
            else:
                predicted = problem.generalized.v_free + motion.change
            # Rounding of float32, to which the matrix of MJX adds its condition.
            np.testing.assert_allclose(after.state["qvel"][i], predicted, atol=2e-5)


def test_isolated_spikes_are_no_trend():
    """The quantile of 1 % of the last quarter is that of spikes; a trend needs 5 % of its steps."""

    def describe(errors):
        result = Audit.with_size(Runs("boxes", None, *errors.shape), "theirs")
        result.numbers[0], result.verdict[:] = (
            errors,
            AUDIT_VERDICTS.index("stopped before convergence"),
        )
        return " ".join(AuditCounts(result).sentences)

    quiet = np.full((12, 100), 1e-5)
    spikes = quiet.copy()
    spikes[np.arange(12), np.linspace(20, 99, 12).astype(int)] = 1e-1
    spikes[0, 20] = 1.0
    assert "Steady with time" in describe(spikes)
    growing = quiet * np.exp(np.arange(100) / 10.0)
    assert "Growing with time" in describe(growing) and "Falling with time" in describe(
        growing[:, ::-1]
    )
    tiny = describe(1e-10 * growing)
    assert "Worst: step" in tiny and "with time" not in tiny


def test_audit_prints_the_next_command_as_it_can_be_pasted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "my robots"
    folder.mkdir()
    (folder / "model.xml").write_text(BOXES.format(options='iterations="1" ls_iterations="2"'))
    found = audit(
        "my robots/model.xml",
        worlds=2,
        steps=20,
        workers=1,
        control="hold",
        max_velocity_error=1e-9,
    )
    found.write("out dir")
    (code,) = found.page.make_page(None).code
    words = shlex.split(code)
    assert words[:3] == ["lavender", "tune", "my robots/model.xml"]
    assert words[words.index("--controls") + 1] == "hold"
    assert Path(words[words.index("--states") + 1]).exists()
    # A model in memory has no path that a command could name.
    model = mj.MjModel.from_xml_path("my robots/model.xml")
    own = audit(model, worlds=2, steps=20, workers=1, max_velocity_error=1e-9)
    own.write("own")
    assert not own.page.make_page(None).code


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_audit_writes_the_contact_forces_of_its_steps(cone, tmp_path):
    """The forces are those of mj_contactForce, the exact ones those of a converged solver in the same state."""
    path = tmp_path / "tripod.xml"
    path.write_text(f"""<mujoco><option solver="CG" iterations="2" cone="{cone}" timestep="0.004"/><worldbody>
      <geom name="floor" type="plane" size="0 0 1"/><body name="stool" pos="0 0 .5"><freejoint/>
      <geom type="box" size=".3 .3 .02" mass="3"/><geom name="a" type="sphere" size=".05" pos=".3 0 -.45"/>
      <geom name="b" type="sphere" size=".05" pos="-.2 .3 -.45"/>
      <geom name="c" type="sphere" size=".05" pos="-.2 -.3 -.45"/></body></worldbody></mujoco>""")
    found = audit(path, worlds=2, steps=30, spread=0.01, workers=1, keep=2)
    found.write(tmp_path / "out")
    table = pd.read_csv(tmp_path / "out" / "forces.csv")
    model = mj.MjModel.from_xml_path(str(path))
    exact = mj.MjModel.from_xml_path(str(path))
    exact.opt.solver, exact.opt.iterations, exact.opt.tolerance = 2, 1000, 0.0  # Newton
    for world in range(2):
        states, _, _ = simulate_world(found.runs, world)
        for step, state in enumerate(states):
            own = table[(table["world"] == world) & (table["step"] == step)]
            forces = []
            for solver in (model, exact):
                data = mj.MjData(solver)
                mj.mj_setState(solver, data, state, mj.mjtState.mjSTATE_INTEGRATION)
                mj.mj_forward(solver, data)
                force = np.zeros((data.ncon, 6))
                for k in range(data.ncon):
                    mj.mj_contactForce(solver, data, k, force[k])
                forces.append(force[:, 0])
            np.testing.assert_allclose(own["normal force [N]"], forces[0], rtol=1e-9, atol=1e-9)
            if data.ncon == 3:  # Three feet determine their normal forces, and not their friction.
                assert set(own["determined"]) == {"contact"}
                assert set(own["bodies"]) == {"stool and world"}
                np.testing.assert_allclose(own["exact normal force [N]"], forces[1], rtol=1e-5)
                gap = np.abs(forces[0] - forces[1])
                np.testing.assert_allclose(own["error [N]"], gap, rtol=1e-4, atol=1e-4)
                total = np.full(3, abs(forces[0].sum() - forces[1].sum()))
                np.testing.assert_allclose(own["pair error [N]"], total, rtol=1e-4, atol=1e-4)
    steps = int((found.contacts > 0).sum())
    assert found.forces_note.startswith(f"{steps} of {steps} steps")
    text = found.page.write(tmp_path / "page").read_text()
    assert "Normal forces of bodies" in text and "Contact forces of the worst steps" in text
    pair = found.pair_forces.set_index("bodies").loc["stool and world"]
    assert pair["largest error [N]"] == table["pair error [N]"].max()
