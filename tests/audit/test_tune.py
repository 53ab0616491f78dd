"""Settings of MuJoCo: what is measured, what is chosen, and the line to copy."""

from dataclasses import replace

import numpy as np
import pytest
from calls import BOXES, keep_values
from calls import EARLY_BOXES as EARLY

import lavender as lv
from lavender.audit.audit import audit
from lavender.audit.page import StepSizes
from lavender.audit.settings import OPTIONS, PROBLEM_OPTIONS
from lavender.audit.settings import MujocoSetting as Setting
from lavender.audit.simulated_worlds import Runs
from lavender.audit.tune import Measured, Tuning, mujoco_settings, sweep, tune
from lavender.audit.tune.mujoco_settings import Stage, list_first_settings

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
    same = stage.judge_setting(Setting.from_options(mj, runs.model, **mujoco_settings.CONVERGED_OPTIONS))
    assert same.motion.max() == 0.0 and same.worst_error < 1e-9


@pytest.mark.parametrize("options", ["", 'solver="CG" cone="elliptic" jacobian="sparse" impratio="3"'])
def test_option_line_pasted_into_a_model_gives_the_measured_options(options):
    plain = mj.MjModel.from_xml_string(BOXES.format(options=options))
    for setting in [*list_first_settings(mj, plain), *mujoco_settings.list_variants(mj, plain, Setting())]:
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
        Setting(tuple(options.items()), iterations=options.get("iterations", 0)), "Newton", np.full(100, error),
        np.zeros(10), np.full(3, time),
    )  # fmt: skip


def html_of(tuning, folder):
    """Return the page of a tuning."""
    return tuning.page.write(folder).read_text()


def chosen(*some, held=(), threshold=1e-6):
    return Tuning("m.xml", 10, list(some), list(held), threshold)


@pytest.mark.parametrize(("with_contact", "is_enough"), [(19, False), (20, True)])
def test_no_line_is_recommended_if_few_steps_have_contact(with_contact, is_enough):
    now, quick = measured(10.0, 1e-3), measured(8.0, 1e-3, iterations=9)
    contacts = (np.arange(100) < with_contact).astype(int)
    found = replace(chosen(now, quick), sizes=StepSizes(contacts + 1, contacts, True))
    assert bool(found.lines) == is_enough == (not found.reason_without_line)
    assert ("No setting is recommended: 19 of 100" in " ".join(found.headline)) != is_enough
    assert "(19.0 %)" in found.reason_without_line or is_enough
    # A model without geoms that can collide is judged by its rows.
    assert replace(found, sizes=StepSizes(contacts + 1, 0 * contacts, False)).lines
    assert not replace(found, sizes=StepSizes(0 * contacts, 0 * contacts, False)).lines


def test_tuning_chooses_the_faster_and_the_more_accurate_setting():
    now = measured(10.0, 1e-3)
    quick, loose = measured(8.0, 1e-3, iterations=9), measured(2.0, 1e-1, iterations=1)
    exact, slow = measured(10.2, 1e-5, tolerance=1e-9), measured(20.0, 1e-9, tolerance=1e-15)
    other = measured(1.0, 0.0, cone="elliptic")
    found = chosen(now, quick, loose, exact, slow, other)
    assert found.faster is quick and found.closer is exact
    assert found.pareto_front == [loose, quick, exact, slow]
    assert '<option iterations="9"/>' in found.lines[0]


def test_errors_on_the_worlds_held_back_do_not_change_the_choice():
    """The second of two equally fast siblings was not judged on the worlds held back."""
    now, first = measured(10.0, 24.0), measured(9.0, 10.8, solver="CG", iterations=3)
    second = measured(8.99, 10.80000001, solver="CG", iterations=3, ls_tolerance=1e-3)
    before = chosen(now, first, second)
    for error in (1e-9, 16.0, 1e9):
        held = [measured(10.0, 31.0), replace(first, error=np.full(100, error))]
        after = replace(before, held=held, held_errors={m.setting: float(m.error.max()) for m in held})
        assert (after.faster, after.closer) == (before.faster, before.closer) == (first, first)
        assert not any("not measured" in line for line in after.lines)


def test_tuning_of_equally_fast_settings_chooses_the_largest_iteration_limit():
    now, few, many, slow = (
        measured(10.0, 1e-3, iterations=15), measured(7.0, 3e-16, iterations=3),
        measured(7.2, 4e-16, iterations=10), measured(8.0, 1e-17, iterations=99),
    )  # fmt: skip
    found = chosen(now, few, many, slow)
    assert found.faster is many and found.closer is None
    assert "not needed, 4.0e-16 m/s is within 1e-06" in found.lines[-1]
    assert chosen(now, few, measured(7.2, 2e-6, iterations=10)).faster is few


def test_tuning_rejects_a_setting_with_a_larger_median_error():
    now, quick = measured(10.0, 1e-4), measured(8.0, 1e-3, iterations=9)
    now.error[0] = 1e-1
    assert quick.error.max() < now.error.max() and chosen(now, quick).faster is None
    quick.error[:60] = 1e-5
    assert chosen(now, quick).faster is quick


def test_tuning_with_an_error_limit_chooses_the_fastest_setting_within_it(tmp_path):
    now, quick = measured(10.0, 1e-1), measured(8.0, 1e-2, iterations=9)
    rare, good = measured(11.0, 1e-5, tolerance=1e-5), measured(12.0, 1e-5, tolerance=1e-6)
    rare.error[0] = 0.5  # One step in a hundred: the limit is for every step.
    slow, other = measured(20.0, 1e-9, tolerance=1e-15), measured(1.0, 0.0, cone="elliptic")
    found = replace(chosen(now, quick, rare, good, slow, other), error_limit=1e-3)
    assert found.within_limit is found.limit_choice is good
    assert found.lines[0] == '<option tolerance="1e-06"/>  <!-- error at most 0.001 m/s, fastest -->'
    assert found.lines[1].endswith("(at most 1.0e-5 in 100 steps)") and "not measured" in found.lines[2]
    assert "On other states they can be larger" in html_of(found, tmp_path)
    # What exceeds the limit on the worlds held back is not within it.
    refuted = replace(found, held_errors={good.setting: 2e-3})
    assert refuted.within_limit is slow
    none = replace(found, error_limit=1e-12)
    assert none.within_limit is None and none.most_accurate is slow
    assert none.lines[:2] == [
        "error at most 1e-12 m/s: none of 5 settings; the most accurate is",
        '<option tolerance="1e-15"/>  <!-- most accurate -->',
    ]
    assert none.page.numbers["is_limit_met"] is False
    equal = measured(12.0 * (1.0 + 1e-3), 1e-8, iterations=30)  # within the noise of times
    assert replace(chosen(now, good, equal, slow), error_limit=1e-3).within_limit is equal
    own = replace(chosen(now, slow), error_limit=0.2)
    assert own.lines[0] == "error at most 0.2 m/s, fastest: the model's own setting"
    assert "error at most" not in "".join(replace(found, error_limit=None).lines)


@pytest.mark.parametrize(("limit", "is_met"), [(1e-6, True), (0.0, False)])
def test_tune_with_an_error_limit_meets_it_on_held_back_worlds(boxes, monkeypatch, limit, is_met):
    keep_values(monkeypatch, mujoco_settings, "MUJOCO", {1e-3, 1e-6, 1e-12, 2, 3, 25}, {"Newton", "CG"})
    found = tune(boxes(EARLY), worlds=4, steps=30, repeats=1, max_velocity_error=limit)
    choice = found.limit_choice
    (held,) = (h for h in found.held if h.setting == choice.setting)
    assert np.isfinite(held.mean_step_time) and found.held_errors[choice.setting] == held.error.max()
    assert (found.within_limit is choice) == is_met == (max(choice.error.max(), held.error.max()) <= limit)
    for m in found.measured:  # Every faster setting exceeds the limit on one half of the worlds.
        if is_met and m.mean_step_time < 0.95 * choice.mean_step_time and not m.setting.changes_problem:
            assert max(m.error.max(), found.held_errors.get(m.setting, 0.0)) > limit
    assert "held back: not measured" not in "".join(found.lines)


def test_tune_measures_the_default_options_of_mujoco(boxes, monkeypatch):
    fewer(monkeypatch)
    path = boxes('solver="CG" iterations="4" ls_iterations="8" tolerance="1e-3"')
    found = tune(path, worlds=2, steps=10, repeats=1, max_velocity_error=1e3)
    (default,) = (m for m in found.measured if m.setting.is_default)
    model = mj.MjModel.from_xml_path(str(path))
    applied, plain = default.setting.apply_to(mj, model).opt, mj.MjOption()
    assert all(getattr(applied, name) == getattr(plain, name) for name in mujoco_settings.OPTIONS)
    assert model.opt.ls_iterations == 8 and applied.ls_iterations == 50
    (section,) = (s for s in found.page.sections if s.short_frame is not None)
    assert any(name.startswith("MuJoCo's defaults (") for name in section.short_frame["setting"])
    assert default in found.terminal_settings and found.terminal_settings[0] is found.present_result
    line = replace(chosen(measured(10.0, 1.0), replace(default, times=np.full(10, 1.0)))).lines[0]
    assert line.endswith("<!-- as accurate as now, faster, MuJoCo's defaults -->")
    # A model with the default options: its own setting is not measured twice.
    assert not any(m.setting.is_default for m in tune(boxes(), worlds=2, steps=10, repeats=1).measured)


def test_tuning_ignores_gains_within_noise_or_threshold():
    now, noise = measured(10.0, 1e-9), measured(9.8, 1e-9, iterations=9)
    found = chosen(now, noise, measured(10.0, 1e-12, tolerance=1e-12))
    assert found.faster is None and found.closer is None
    assert "not needed" in found.lines[1]
    loose = measured(5.0, 1e-7, tolerance=1e-4)
    assert chosen(now, loose).faster is loose  # further off than now, and no further than anybody asks
    rare = measured(5.0, 1e-10, tolerance=1e-4)
    rare.error[0] = 1.0  # one step in a hundred: below the quantile, not below the worst
    assert chosen(now, rare).faster is None
    astray = measured(5.0, 1e-10, tolerance=1e-4)
    astray.motion[:] = 1e-3  # its answers are right, and the bodies elsewhere
    assert chosen(now, astray).faster is None


def test_ctrl_c_keeps_what_there_is(boxes, monkeypatch, tmp_path):
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
    assert "not measured" in "".join(found.lines) or found.faster is found.closer is None


def test_ctrl_c_before_the_first_round_returns_the_present_setting(boxes, monkeypatch, tmp_path):
    fewer(monkeypatch)
    simulate = sweep.Stage.from_stretches_of_runs.__func__

    def stop_after_first_stage(cls, runs, worlds, horizon):
        if runs.steps > horizon:
            raise KeyboardInterrupt
        return simulate(cls, runs, worlds, horizon)

    def stop_at_timing(event):
        if event.case.startswith("timing"):
            raise KeyboardInterrupt

    whole = tune(boxes(EARLY), worlds=4, steps=20, repeats=1, watch=stop_at_timing)
    monkeypatch.setattr(sweep.Stage, "from_stretches_of_runs", classmethod(stop_after_first_stage))
    brief = tune(boxes(EARLY), worlds=4, steps=20, repeats=1)
    for found, n_steps in ((whole, 2 * 20), (brief, 10)):  # two of the four worlds; one stretch
        assert found.stopped and [m.setting.options for m in found.measured] == [()]
        assert len(found.measured[0].error) == n_steps and not found.held
        assert "Stopped before the end" in html_of(found, tmp_path)


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
    monkeypatch.setattr(Stage, "judge_setting", lambda self, setting: measured(np.inf, np.inf))
    with pytest.raises(lv.InputError, match="diverge"):
        tune(boxes(), worlds=2, steps=10, repeats=1)


def test_tune_resumed_after_ctrl_c_reuses_judged_settings(boxes, monkeypatch, tmp_path):
    fewer(monkeypatch)
    path, judged, judge_setting = boxes(EARLY), [], Stage.judge_setting
    monkeypatch.setattr(
        Stage, "judge_setting", lambda self, setting: judged.append(setting) or judge_setting(self, setting)
    )

    def stop(event):
        if event.case.startswith("timing"):
            raise KeyboardInterrupt

    same = {"worlds": 2, "steps": 20, "repeats": 1, "folder": tmp_path}
    first = tune(path, **same, watch=stop)
    n = len(judged)
    assert first.stopped and n > 3
    judged.clear()
    second = tune(path, **same)
    assert not second.stopped and f"The errors of {n - 1} settings are reused (--no-reuse)." in second.notes
    judged_again = [setting for setting in judged if setting.options][: n - 1]
    assert not {s.options for s in judged_again} & {m.setting.options for m in first.measured if m.setting.options}
    judged.clear()
    whole = tune(path, **same, reuse=False)
    assert len(judged) >= n and not any("reused" in note for note in whole.notes)
    for m in whole.measured:
        for other in second.measured:
            if other.setting == m.setting:
                assert (other.error == m.error).all() and (other.motion == m.motion).all()
    # Another model or parameter is not reused.
    assert not any("reused" in note for note in tune(path, **same | {"seed": 3}).notes)
