"""Settings of MuJoCo: what is measured, what is chosen, and the line to copy."""

from dataclasses import replace

import numpy as np
import pytest
from approved_texts import check_text
from calls import BOXES, keep_values
from calls import EARLY_BOXES as EARLY

import lavender as lv
from lavender.audit.audit import audit
from lavender.audit.page import StepSizes
from lavender.audit.settings import OPTIONS, PROBLEM_OPTIONS
from lavender.audit.settings import MujocoSetting as Setting
from lavender.audit.simulated_worlds import Runs
from lavender.audit.tune import Measured, Tuning, mujoco_settings, tune
from lavender.audit.tune.mujoco_settings import Stage, list_first_settings
from lavender.report.render import format_cells

mj = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'")


def fewer(monkeypatch):
    keep_values(monkeypatch, mujoco_settings, "MUJOCO", {1e-6, 1e-12, 2, 3, 25}, {"Newton", "CG"})


def test_tune_measures_the_present_setting_on_half_of_the_worlds(boxes, monkeypatch):
    fewer(monkeypatch)
    path = boxes(EARLY)
    found = tune(path, worlds=4, steps=30, repeats=1)
    whole = audit(path, worlds=4, steps=30, workers=1).numbers[0]
    assert found.measured[0].setting == Setting()
    np.testing.assert_allclose(found.measured[0].error, whole[0::2].ravel(), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.held[0].error, whole[1::2].ravel(), rtol=1e-6, atol=1e-12)
    best = min(found.measured, key=lambda m: m.worst_error)
    assert best.worst_error < 1e-6 < found.present_result.worst_error
    assert best.worst_motion < 1e-6 < found.present_result.worst_motion
    assert all(m.mean_step_time > 0.0 for m in found.measured)


def test_tune_of_the_converged_setting_has_no_motion_error(boxes):
    runs = Runs.of_model(boxes(), 1, 20)
    stage = Stage.from_stretches_of_runs(runs, [0], 10)
    same = stage.judge_setting(
        Setting.from_options(mj, runs.model, **mujoco_settings.CONVERGED_OPTIONS)
    )
    assert same.motion.max() == 0.0 and same.worst_error < 1e-9


@pytest.mark.parametrize(
    "options", ["", 'solver="CG" cone="elliptic" jacobian="sparse" impratio="3"']
)
def test_option_line_pasted_into_a_model_gives_the_measured_options(options):
    plain = mj.MjModel.from_xml_string(BOXES.format(options=options))
    for setting in [
        *list_first_settings(mj, plain),
        *mujoco_settings.list_variants(mj, plain, Setting()),
    ]:
        text = setting.option_line.removeprefix("<option").removesuffix("/>")
        names = {name for name, _ in setting.options}
        kept = " ".join(w for w in options.split() if w.partition("=")[0] not in names)
        copied = mj.MjModel.from_xml_string(BOXES.format(options=f"{kept} {text}")).opt
        tried = setting.apply_to(mj, plain).opt
        for name in (*OPTIONS, *PROBLEM_OPTIONS):
            assert getattr(copied, name) == getattr(tried, name), setting
    assert Setting.from_options(mj, plain, iterations=int(plain.opt.iterations)).option_line == ""


def measured(time, error, **options):
    return Measured(
        Setting(tuple(options.items()), iterations=options.get("iterations", 0)),
        "Newton",
        np.full(100, error),
        np.zeros(10),
        np.full(3, time),
    )


def html_of(tuning, folder):
    """Return the page of a tuning."""
    return tuning.page.write(folder).read_text()


def chosen(*some, held=(), threshold=1e-6):
    return Tuning("m.xml", 10, list(some), list(held), threshold)


def of_contacts(tuning, with_contact, can_touch=True):
    """The tuning of 100 steps of which some have contact."""
    contacts = (np.arange(100) < with_contact).astype(int)
    return replace(tuning, sizes=StepSizes(contacts + 1, contacts, can_touch))


def first_step(setting, error):
    """The setting with another error in its first step of a hundred."""
    setting.error[0] = error
    return setting


NOW = measured(10.0, 1e-3)
QUICK = measured(8.0, 1e-3, iterations=9)
OTHER = measured(1.0, 0.0, cone="elliptic")
SLOW = measured(20.0, 1e-9, tolerance=1e-15)
GOOD, ASTRAY = measured(12.0, 1e-5, tolerance=1e-6), measured(5.0, 1e-10, tolerance=1e-4)
ASTRAY.motion[:] = 1e-3  # Its answers are right, and the bodies are elsewhere.
RARE = first_step(measured(11.0, 1e-5, tolerance=1e-5), 0.5)
FIVE = chosen(measured(10.0, 1e-1), measured(8.0, 1e-2, iterations=9), RARE, GOOD, SLOW, OTHER)
LIMITED = replace(FIVE, error_limit=1e-3)
TUNINGS = {
    "19 of 100 steps have contact": of_contacts(chosen(NOW, QUICK), 19),
    "20 of 100 steps have contact": of_contacts(chosen(NOW, QUICK), 20),
    "no step has contact, and no geoms can touch": of_contacts(chosen(NOW, QUICK), 0, False),
    "a faster, a more accurate, and a setting that changes the problem": chosen(
        NOW,
        QUICK,
        measured(2.0, 1e-1, iterations=1),
        measured(10.2, 1e-5, tolerance=1e-9),
        SLOW,
        OTHER,
    ),
    "of equally fast settings the largest limit of iterations": chosen(
        measured(10.0, 1e-3, iterations=15),
        measured(7.0, 3e-16, iterations=3),
        measured(7.2, 4e-16, iterations=10),
        measured(8.0, 1e-17, iterations=99),
    ),
    "an equally fast setting with a larger error is not as accurate": chosen(
        measured(10.0, 1e-3, iterations=15),
        measured(7.0, 3e-16, iterations=3),
        measured(7.2, 2e-6, iterations=10),
    ),
    "a larger median error is not as accurate, though the largest error is smaller": chosen(
        first_step(measured(10.0, 1e-4), 1e-1), QUICK
    ),
    "a smaller median error is as accurate, though 40 of 100 errors are larger": chosen(
        first_step(measured(10.0, 1e-4), 1e-1),
        replace(QUICK, error=np.repeat([1e-5, 1e-3], [60, 40])),
    ),
    "the fastest of those within 1e-3 in every step": LIMITED,
    "the choice exceeds 1e-3 on the worlds held back": replace(
        LIMITED, held_errors={GOOD.setting: 2e-3}
    ),
    "no setting within 1e-12": replace(LIMITED, error_limit=1e-12),
    "no limit": FIVE,
    "two settings within 1e-3 and the noise of times": replace(
        chosen(measured(10.0, 0.1), GOOD, measured(12.012, 1e-8, iterations=30), SLOW),
        error_limit=1e-3,
    ),
    "the present setting is within 0.2": replace(chosen(NOW, SLOW), error_limit=0.2),
    "gains within noise and below the threshold": chosen(
        measured(10.0, 1e-9),
        measured(9.8, 1e-9, iterations=9),
        measured(10.0, 1e-12, tolerance=1e-12),
    ),
    "an error that is larger than now and below the threshold": chosen(
        measured(10.0, 1e-9), measured(5.0, 1e-7, tolerance=1e-4)
    ),
    "an error of 1 in one step of a hundred": chosen(
        measured(10.0, 1e-9), first_step(measured(5.0, 1e-10, tolerance=1e-4), 1.0)
    ),
    "bodies that end elsewhere": chosen(measured(10.0, 1e-9), ASTRAY),
}


@pytest.mark.parametrize("name", TUNINGS)
def test_tuning_has_its_approved_recommendation(name):
    found = TUNINGS[name]
    of = {"faster": found.faster, "closer": found.closer, "within the limit": found.within_limit}
    of = {word: setting.setting.option_line for word, setting in of.items() if setting is not None}
    front = [m.setting.option_line or "the present setting" for m in found.pareto_front]
    met = (
        f"is_limit_met: {found.page.numbers['is_limit_met']}"
        if found.error_limit is not None
        else ""
    )
    parts = [
        *found.headline,
        format_cells(found.choices).to_string(index=False),
        met,
        f"{of}",
        f"Pareto front: {front}",
    ]
    check_text("tune.txt", name, "\n".join(part for part in parts if part))


def test_tuning_choice_does_not_depend_on_the_worlds_held_back():
    """The second of two equally fast siblings was not judged on the worlds held back."""
    now = measured(10.0, 24.0)
    first = measured(9.0, 10.8, solver="CG", iterations=3)
    second = measured(8.99, 10.80000001, solver="CG", iterations=3, ls_tolerance=1e-3)
    before = chosen(now, first, second)
    for error in (1e-9, 16.0, 1e9):
        held = [measured(10.0, 31.0), replace(first, error=np.full(100, error))]
        after = replace(
            before, held=held, held_errors={m.setting: float(m.error.max()) for m in held}
        )
        assert (after.faster, after.closer) == (before.faster, before.closer) == (first, first)
        assert after.choices["time, held back"].tolist()[1] == "0.90"


@pytest.mark.parametrize(("limit", "is_met"), [(1e-6, True), (0.0, False)])
def test_tune_with_an_error_limit_meets_it_on_held_back_worlds(boxes, monkeypatch, limit, is_met):
    keep_values(
        monkeypatch, mujoco_settings, "MUJOCO", {1e-3, 1e-6, 1e-12, 2, 3, 25}, {"Newton", "CG"}
    )
    found = tune(boxes(EARLY), worlds=4, steps=30, repeats=1, max_velocity_error=limit)
    choice = found.limit_choice
    (held,) = (h for h in found.held if h.setting == choice.setting)
    assert (
        np.isfinite(held.mean_step_time) and found.held_errors[choice.setting] == held.error.max()
    )
    assert (
        (found.within_limit is choice)
        == is_met
        == (max(choice.error.max(), held.error.max()) <= limit)
    )
    for m in found.measured:  # Every faster setting exceeds the limit on one half of the worlds.
        if (
            is_met
            and m.mean_step_time < 0.95 * choice.mean_step_time
            and not m.setting.changes_problem
        ):
            assert max(m.error.max(), found.held_errors.get(m.setting, 0.0)) > limit
    shown = found.choices[found.choices["choice"].str.startswith(("most accurate", "fastest"))]
    assert len(shown) == 1 and "–" not in shown["time, held back"].tolist()


def test_settings_that_are_judged_in_part_do_not_change_the_choice(boxes, monkeypatch):
    """The times of a step follow from the options here, so that both runs choose from equal times."""
    keep_values(
        monkeypatch,
        mujoco_settings,
        "MUJOCO",
        {1e-4, 1e-6, 1e-12, 1, 3, 6, 25},
        {"Newton", "CG", "PGS"},
    )
    run = Stage.run_stretches
    judge = Stage.judge_setting
    n_runs = []

    def take_time_of_options(self, model, states=None):
        n_runs.append(states is None)
        times, ends = run(self, model, states)
        cost = (
            model.opt.iterations - np.log10(max(model.opt.tolerance, 1e-16)) + 20 * model.opt.solver
        )
        return np.full(len(times), 1e-6 * cost), ends

    monkeypatch.setattr(Stage, "run_stretches", take_time_of_options)
    path = boxes('solver="CG" iterations="8" tolerance="1e-5"')
    found = []
    for limit in (None, 1e-4):
        same = {"worlds": 4, "steps": 40, "repeats": 2, "max_velocity_error": limit}
        part = tune(path, **same)
        n_part = n_runs.count(True)
        with monkeypatch.context() as whole:
            whole.setattr(
                Stage, "judge_setting", lambda self, setting, _=None: judge(self, setting)
            )
            all_steps = tune(path, **same)
        assert n_part < n_runs.count(True) - n_part
        n_runs.clear()
        assert len(part.measured[0].error) == len(all_steps.measured[0].error) == 80
        assert min(len(m.error) for m in part.measured) == 20
        for name in ("faster", "closer", "limit_choice"):
            one, other = getattr(part, name), getattr(all_steps, name)
            found.append(one)
            assert (one is None) == (other is None) and (
                one is None or one.setting == other.setting
            )
    assert any(m is not None and m.setting.options for m in found)


def test_tune_measures_the_default_options_of_mujoco(boxes, monkeypatch):
    fewer(monkeypatch)
    path = boxes('solver="CG" iterations="4" ls_iterations="8" tolerance="1e-3"')
    found = tune(path, worlds=2, steps=10, repeats=1, max_velocity_error=1e3)
    (default,) = (m for m in found.measured if m.setting.is_default)
    model = mj.MjModel.from_xml_path(str(path))
    applied = default.setting.apply_to(mj, model).opt
    plain = mj.MjOption()
    assert all(getattr(applied, name) == getattr(plain, name) for name in mujoco_settings.OPTIONS)
    assert model.opt.ls_iterations == 8 and applied.ls_iterations == 50
    assert found.choices["choice"].tolist()[0] == "now"
    assert any(name.startswith("MuJoCo's defaults (") for name in found.choices["option"])
    # A model with the default options: its own setting is not measured twice.
    assert not any(
        m.setting.is_default for m in tune(boxes(), worlds=2, steps=10, repeats=1).measured
    )


def test_tune_stopped_by_ctrl_c_returns_the_measured_settings(boxes, monkeypatch, tmp_path):
    fewer(monkeypatch)

    def watch(event):
        if event.case.startswith("timing"):
            seen.append(event)  # before each timing
            if len(seen) == 6:
                raise KeyboardInterrupt

    seen = []
    found = tune(boxes(EARLY), worlds=2, steps=10, repeats=1, watch=watch)
    assert found.stopped and len(found.measured) == 5 and not found.held
    assert "Stopped before the end" in html_of(found, tmp_path)
    assert (found.choices["time, held back"] == "–").all()


def test_ctrl_c_before_the_first_round_stops_tune(boxes, monkeypatch):
    fewer(monkeypatch)

    def stop_at_timing(event):
        if event.case.startswith("timing"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune(boxes(EARLY), worlds=4, steps=20, repeats=1, watch=stop_at_timing)


def test_tune_leaves_out_a_setting_that_ends_mujoco_in_an_error(boxes, monkeypatch):
    fewer(monkeypatch)
    run = Stage.run_stretches

    def dies(self, model, states=None):
        if model.opt.iterations == 25:
            raise mj.FatalError("out of memory")
        return run(self, model, states)

    monkeypatch.setattr(Stage, "run_stretches", dies)
    found = tune(boxes(), worlds=2, steps=10, repeats=1)
    assert not any(dict(m.setting.options).get("iterations") == 25 for m in found.measured)
    monkeypatch.setattr(Stage, "judge_setting", lambda self, *given: measured(np.inf, np.inf))
    with pytest.raises(lv.InputError, match="diverge"):
        tune(boxes(), worlds=2, steps=10, repeats=1)


def test_setting_without_gain_on_the_worlds_held_back_is_not_recommended():
    now = measured(1.0, 5e-4)
    better = measured(0.9, 1e-5, iterations=5)
    held = [measured(1.0, 5e-15), measured(1.0, 5e-15, iterations=5)]
    tuning = chosen(now, better, held=held)
    first, *_ = tuning.headline
    assert tuning.closer is better or tuning.faster is better
    assert tuning.advised is None and "has no gain on the worlds held back" in first
    assert (
        first.startswith("Keep the model's own setting: ") and not tuning.page.make_page(None).code
    )
    held[1] = measured(0.8, 5e-15, iterations=5)
    assert chosen(now, better, held=held).advised is better


def test_figure_of_settings_has_a_logarithmic_time_axis(tmp_path):
    times = [1.0, 0.98, 1.02, 1.1, 1.2, 25.0]
    some = [
        measured(t, 10.0 ** -(i + 2), **({"iterations": i} if i else {}))
        for i, t in enumerate(times)
    ]
    svg = chosen(*some).draw_settings(tmp_path)
    assert all(f">{tick}<" in svg for tick in ("1", "1.1", "1.2", "10", "20"))


def test_errors_of_hinges_are_in_rad_per_second(boxes):
    """The limit of a joint is the only row: its velocity is angular."""
    xml = """<mujoco><option iterations="1" ls_iterations="1"/><worldbody><body pos="0 0 1"><joint type="hinge"
     axis="0 1 0" limited="true" range="-0.1 0.1"/><geom type="capsule" size=".05 .3" pos="0 0 -.3"/></body>
     </worldbody></mujoco>"""
    model = mj.MjModel.from_xml_string(xml)
    data = mj.MjData(model)
    data.qvel[:] = 3.0
    states = []
    for _ in range(40):
        mj.mj_step(model, data)
        state = np.empty(mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION))
        mj.mj_getState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
        states.append(state)
    runs = Runs.of_model(model, 4, 10, states={"state": np.array(states)})
    judged = Stage.from_stretches_of_runs(runs, range(4), 10).judge_setting(Setting())
    assert judged.unit == "rad/s"
