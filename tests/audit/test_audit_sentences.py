"""Sentences of audits and of `tune` say what brute force over random tables finds."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest

from lavender.audit.pieces import AUDIT_VERDICTS, NOT_JUDGED, Prediction
from lavender.audit.result import OUTCOMES, Audit
from lavender.audit.settings import MujocoSetting as Setting
from lavender.audit.simulated_worlds import Divergence, Runs
from lavender.audit.tune import Measured, Tuning
from lavender.causes.difference import Difference, Part
from lavender.io.mujoco import PREDICTION_TOLERANCE
from lavender.judge.residuals import AT_FLOOR, CLOSE, UNCONVERGED, WRONG
from lavender.report.text import format_count, format_number, format_percent, format_speed

LIMIT, THRESHOLD = 1e-3, 1e-6
WORDS = (AT_FLOOR, CLOSE, UNCONVERGED, WRONG, "not judged")


def draw_sizes(rng, n):
    """Draw errors [m/s] on both sides of the limit, at the limit, and none."""
    sizes = LIMIT * np.exp(rng.uniform(-6.0, 2.0, n))
    sizes[rng.random(n) < 0.1] = LIMIT
    sizes[rng.random(n) < 0.1] = 0.0
    return sizes


def draw_audit(seed):
    """Draw an audit of any number of worlds and steps, some of them not judged, at their floor, or diverged."""
    rng = np.random.default_rng(seed)
    shape = tuple(int(n) for n in rng.integers(1, (6, 30)))
    result = Audit.with_size(
        Runs("boxes", None, *shape),
        "theirs",
        has_claims=bool(rng.integers(2)),
        threshold=THRESHOLD,
        error_limit=LIMIT,
    )
    sizes = draw_sizes(rng, shape) * (0.3 if seed % 3 == 0 else 1.0)
    sizes = np.minimum(sizes, LIMIT) if seed % 5 == 0 else sizes
    verdict = rng.choice(
        len(WORDS), shape, p=[0.25, 0.35, 0.2, 0.15, 0.05] if seed % 2 else [0.3, 0.7, 0, 0, 0]
    )
    result.verdict[:] = [[AUDIT_VERDICTS.index(WORDS[v]) for v in line] for line in verdict]
    result.numbers[:] = np.where(result.verdict == NOT_JUDGED, np.nan, sizes)
    result.rows[:] = result.contacts[:] = 1
    if result.converged is not None:
        result.converged[:] = rng.choice([-1, 0, 1], shape, p=[0.1, 0.3, 0.6])
    if seed % 7 == 3:
        world, step = (int(rng.integers(n)) for n in shape)
        result.divergences.append(Divergence(world, step, "speed", bool(rng.integers(2))))
    result.n_dropped = int(rng.integers(1, 9)) if seed % 11 == 5 else 0
    return result


def list_steps(result):
    """Return (world, step, error, word of the verdict) of every step."""
    worlds, steps = result.verdict.shape
    return [
        (w, s, float(result.numbers[0, w, s]), AUDIT_VERDICTS[result.verdict[w, s]])
        for w in range(worlds) for s in range(steps)
    ]  # fmt: skip


@pytest.mark.parametrize("seed", range(60))
def test_audit_sentences_are_those_of_brute_force(seed):
    result = draw_audit(seed)
    steps = list_steps(result)
    judged = [x for x in steps if x[3] != "not judged"]
    lost = len(steps) - len(judged)
    above = [x for x in judged if x[2] > LIMIT and x[3] != AT_FLOOR]
    counted = [x[2] for x in judged if x[3] != AT_FLOOR]
    largest = max(counted, default=0.0)
    verdict, text = result.headline[0], " ".join(result.headline[1:])
    assert result.n_above_limit == len(above) and result.max_velocity_error == largest
    assert result.n_judged == len(judged) and result.n_unjudged == lost
    if above:
        share = format_percent(len(above), len(judged))
        assert f"{len(above)} of {format_number(len(judged))} steps ({share})" in verdict.replace(
            "Of ", "of "
        )
        assert f"the worst by {format_speed(largest, limit=LIMIT)}" in verdict
        worlds = {w for w, *_ in above}
        first = min(s for _, s, *_ in above)
        count = format_count(result.verdict.shape[0], "world")
        assert f"Above the limit from step {first} on, in {len(worlds)} of {count}." in text
    else:
        assert "Above the limit" not in text and ("o step is wrong" in verdict or not judged)
    if largest:
        found = re.search(r"Worst: step (\d+) of world (\d+)", text)
        own = {(w, s): (e, v) for w, s, e, v in steps}
        assert own[int(found[2]), int(found[1])][0] == largest
    assert (f"{format_count(lost, 'step')} not judged" in verdict) == bool(lost)
    assert ("the engine dropped" in verdict) == bool(result.n_dropped)
    assert ("diverged, the first at step" in verdict) == bool(result.divergences)
    if result.divergences:
        d = result.divergences[0]
        until = [(e, v) for w, s, e, v in steps if w == d.world and s < d.step + (not d.is_outside)]
        is_exact = all(v == AT_FLOOR or (v == CLOSE and e <= 1e-6) for e, v in until)
        assert ("was exact" in text) == is_exact == result.has_exact_solves(d)
    else:
        stopped = [x for x in above if x[3] == UNCONVERGED]
        wrong = [x for x in above if x[3] == WRONG]
        assert ("Cause: the solver." in text) == bool(stopped)
        if stopped:
            these = "All these" if len(stopped) == len(above) else f"{len(stopped)} of these"
            assert f"{these} solves stopped before convergence" in text
        assert ("no solution of its own problem" in text) == bool(wrong)
        if wrong:
            assert f"{format_count(len(wrong), 'answer')} of the engine" in text
        early = [x for x in judged if x[3] in (UNCONVERGED, WRONG)]
        assert ("all within the limit" in text) == bool(early and not above)
        assert ("Every solve converged" in text) == bool(judged and not early and not above)
    met = not (above or lost or result.n_dropped or result.divergences)
    assert result.is_unmet == (not met)
    check_trend(result, text)
    check_claims(result, steps, text)


def check_trend(result, text):
    """Errors grow if those that 1 % of the steps exceed are more than twice as large in the last quarter."""
    steps = result.verdict.shape[1]
    quarter = steps // 4
    if not (found := re.search(r"(Growing|Falling|Steady) with time", text)):
        return
    parts = []
    for first, end in ((quarter, 2 * quarter), (steps - quarter, steps)):
        sizes = sorted(
            0.0 if v == AT_FLOOR else e
            for _, s, e, v in list_steps(result)
            if first <= s < end and v != "not judged"
        )
        parts.append(sizes[int(np.ceil(0.99 * (len(sizes) - 1)))])
    early, late = parts
    assert found[1] == (
        "Growing" if late > 2.0 * early else "Falling" if late < early / 2.0 else "Steady"
    )
    assert (
        f"is {format_speed(early)} in steps {quarter} to {2 * quarter - 1} and {format_speed(late)} in"
        in text
    )


def check_claims(result, steps, text):
    """A claim is wrong if the engine calls a solve converged that stopped early, is wrong, or was not judged."""
    if result.converged is None:
        assert "calls converged" not in text
        return
    counts = dict.fromkeys(OUTCOMES, 0)
    for w, s, _, v in steps:
        claim = result.converged[w, s]
        if claim >= 0:
            lost, early = v == "not judged", v in (UNCONVERGED, WRONG)
            counts[OUTCOMES[(4 if claim else 5) if lost else early + (0 if claim else 2)]] += 1
    assert result.claim_counts == counts
    claimed = [v for w, s, _, v in steps if result.converged[w, s] == 1]
    false = sum(v in (UNCONVERGED, WRONG, "not judged") for v in claimed)
    words = f"Of {format_count(len(claimed), 'solve')} that the engine calls converged, {false} "
    assert words in text


@pytest.mark.parametrize("seed", range(20))
def test_shares_against_another_model_are_of_the_steps_that_both_judged(seed):
    result, other = draw_audit(seed), draw_audit(seed)
    rng = np.random.default_rng(seed)
    other.runs = dataclasses.replace(other.runs, name="other")
    other.numbers *= rng.choice([0.5, 1.0, 2.0], other.numbers.shape)
    lost = rng.random(other.verdict.shape) < 0.3
    other.verdict[lost], other.numbers[:, lost] = NOT_JUDGED, np.nan
    result.against = other
    own, its = (
        {(w, s): e for w, s, e, v in list_steps(x) if v != "not judged"} for x in (result, other)
    )
    both = own.keys() & its.keys()
    smaller, larger = (sum(f(own[x], its[x]) for x in both) for f in (float.__lt__, float.__gt__))
    less, more = (format_percent(x, max(len(both), 1), 1) for x in (smaller, larger))
    words = result.compare_in_words()
    assert (
        f"the same {format_count(len(both), 'state')}: the error is smaller in {less} of the"
        in words
    )
    assert f"and larger in {more};" in words


@pytest.mark.parametrize("seed", range(20))
def test_predicted_velocities_are_compared_step_by_step(seed):
    """The first step that moved unlike its answer, and the largest difference, whatever the pieces are."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 40))
    world, step = rng.integers(0, 3, n), rng.permutation(n)
    after = rng.normal(size=(n, 4)) * 10.0 ** rng.uniform(-3.0, 3.0, (n, 1))
    predicted = after + rng.choice([0.0, 1e-12, 1e-3, 1.0], (n, 1)) * rng.normal(size=(n, 4))
    predicted[rng.random(n) < 0.2] = np.nan
    found = Prediction()
    for part in np.array_split(np.arange(n), int(rng.integers(1, 4))):
        found = found.merge(
            Prediction.of_steps(predicted[part], after[part], world[part], step[part])
        )
    gaps = {
        (int(w), int(s)): float(np.abs(p - a).max())
        for w, s, p, a in zip(world, step, predicted, after, strict=True)
        if not np.abs(p - a).max() <= PREDICTION_TOLERANCE * max(np.abs(p).max(), np.abs(a).max(), 1.0)
        and np.isfinite(p).all()
    }  # fmt: skip
    assert found.steps == np.isfinite(predicted).all(axis=1).sum() and found.different == len(gaps)
    assert found.largest == max(gaps.values(), default=0.0)
    # Steps of a piece are in order, so that the first of each piece is its first one.
    assert (found.first is None) == (not gaps) and (found.first is None or found.first in gaps)


@pytest.mark.parametrize("seed", range(60))
def test_second_causes_are_those_whose_intervals_reach_the_first_one(seed):
    rng = np.random.default_rng(seed)
    still = SimpleNamespace(velocity_after=np.zeros(1), precision="float64")
    parts = {}
    for name in ("mass", "softness", "friction", "rest"):
        changes = rng.choice([0.0, 1e-12, 1.0], p=[0.1, 0.1, 0.8]) * rng.normal(size=(4, 1))
        parts[name] = Part(name, changes.mean(axis=0), changes, changes[0], changes[-1])
    difference = Difference(still, still, parts, still, still, None)
    row = np.ones(1)
    ranked = sorted(parts.values(), key=lambda p: -abs(p.mean[0]))
    ranked = [p for p in ranked if abs(p.mean[0]) > 1e-10]
    expected = [p.name for p in ranked[:1]]
    for part in ranked[1:]:
        first, own = (np.sort(p.changes[:, 0]) for p in (ranked[0], part))
        # The smallest size in the interval of the first cause, and the largest of the other one.
        least = 0.0 if first[0] <= 0.0 <= first[-1] else np.abs(first).min()
        if np.abs(own).max() >= least and abs(part.mean[0]) >= 0.1 * abs(ranked[0].mean[0]):
            expected.append(part.name)
    assert difference.list_causes(row) == expected


# -- tune --------------------------------------------------------------------------------------------------------------


def draw_setting(rng, i):
    error = np.repeat(LIMIT * np.exp(rng.uniform(-9.0, 2.0, 2)), [98, 2])
    if rng.random() < 0.3:
        error[-2:] = error[0]  # No worse step.
    options = (
        {"iterations": i, "cone": "elliptic"} if rng.random() < 0.15 and i else {"iterations": i}
    )
    time = 1e-5 * float(rng.choice([5.0, 8.0, 9.7, 10.0, 10.2, 10.4, 14.0]))
    return Measured(
        Setting(tuple(options.items()) if i else (), iterations=i), "Newton", error,
        np.full(10, float(rng.choice([0.0, 1e-7, 1e-2]))), np.full(100, time),
    )  # fmt: skip


def draw_tuning(seed):
    rng = np.random.default_rng(seed)
    some = [draw_setting(rng, i) for i in range(int(rng.integers(1, 8)))]
    tuning = Tuning("m.xml", 10, some, [], THRESHOLD, error_limit=LIMIT if seed % 2 else None)
    advised = [m for m in (tuning.faster, tuning.closer, tuning.limit_choice) if m is not None]
    held = [some[0], *{id(m): m for m in advised if m is not some[0]}.values()]
    own = [Measured(m.setting, "Newton", m.error[::2] * float(rng.uniform(0.5, 3.0)), m.motion,
                    m.times * float(rng.uniform(0.5, 2.0))) for m in held]  # fmt: skip
    return Tuning("m.xml", 10, some, own, THRESHOLD, error_limit=tuning.error_limit, n_held_worlds=4,
                  held_errors={h.setting: float(h.error.max()) for h in own})  # fmt: skip


def exceeded_by_one_percent(error):
    ordered = np.sort(error)
    return float(ordered[int(np.ceil(0.99 * (len(ordered) - 1)))])


@pytest.mark.parametrize("seed", range(80))
def test_tuned_settings_are_those_of_brute_force(seed):
    tuning = draw_tuning(seed)
    now, same = tuning.measured[0], [m for m in tuning.measured if not m.setting.changes_problem]
    time = {m.setting: float(m.times.mean()) for m in same}
    one = {m.setting: exceeded_by_one_percent(m.error) for m in same}
    held = {h.setting: h for h in tuning.held}
    most = {
        m.setting: max(
            float(m.error.max()), float(held[m.setting].error.max()) if m.setting in held else 0.0
        )
        for m in same
    }

    def is_as_accurate(m):
        return all(
            f(m) <= max(f(now), THRESHOLD)
            for f in (lambda m: float(m.error.max()), lambda m: float(np.median(m.error)),
                      lambda m: exceeded_by_one_percent(m.motion))
        )  # fmt: skip

    good = [
        m for m in same if is_as_accurate(m) and one[m.setting] <= max(one[now.setting], THRESHOLD)
    ]
    quick = [m for m in good if time[m.setting] < 0.95 * time[now.setting]]
    faster = tuning.faster
    assert (faster is None) == (not quick)
    if quick:
        fastest = min(time[m.setting] for m in quick)
        ties = [m for m in quick if 0.95 * time[m.setting] <= fastest]
        assert faster in ties
        assert max(float(faster.error.max()), THRESHOLD) == min(
            max(float(m.error.max()), THRESHOLD) for m in ties
        )
    closer = tuning.closer
    slow = [m for m in same if is_as_accurate(m) and time[m.setting] <= 1.05 * time[now.setting]]
    if closer is not None:
        assert (
            closer in slow
            and one[closer.setting] == min(one[m.setting] for m in slow) < one[now.setting]
        )
        assert faster is None or one[faster.setting] > THRESHOLD
    elif one[now.setting] > THRESHOLD and (faster is None or one[faster.setting] > THRESHOLD):
        assert min(one[m.setting] for m in slow) >= one[now.setting]
    if tuning.error_limit is not None:
        within = [m for m in same if most[m.setting] <= LIMIT]
        assert (tuning.within_limit is None) == (not within)
        if within:
            fastest = min(time[m.setting] for m in within)
            assert (
                0.95 * time[tuning.within_limit.setting] <= fastest
                and most[tuning.within_limit.setting] <= LIMIT
            )
        assert tuning.page.numbers["is_limit_met"] == bool(within)
    check_headline(tuning, time, one, most, held, len(same))


def check_headline(tuning, time, one, most, held, n):
    """Every number of the headline and of the table of choices is that of its setting."""
    now, m, (first, *rest) = tuning.measured[0], tuning.advised, tuning.headline
    own = next(text for text in tuning.headline if text.startswith("Now 1 %"))
    limit = tuning.shown_limit
    assert (
        f"errors above {format_speed(one[now.setting])}, the worst {format_speed(most[now.setting], limit=limit)}"
        in own
    )
    if m is None:
        assert first.startswith("Keep")
        lost = [x for x in (tuning.closer, tuning.faster) if x is not None]
        if tuning.error_limit is None and lost:
            assert f"{lost[0].setting.short_name} has no gain on the worlds held back" in first
            for x in lost:  # Neither is faster nor more accurate there.
                h, own = held[x.setting], held[now.setting]
                assert h.times.mean() >= 0.95 * own.times.mean()
                assert max(h.error.max(), THRESHOLD) >= max(own.error.max(), THRESHOLD)
        else:
            assert f"none of {n} settings" in first
    else:
        ratio = time[m.setting] / time[now.setting]
        words = (
            "the same time per step"
            if abs(ratio - 1.0) <= 0.05
            else f"{ratio:.2f} of the time per step"
        )
        new, old = (format_speed(most[x.setting]) for x in (m, now))
        assert f"Set {m.setting.short_name}: {words}" in first and (
            f"{new} instead of {old}" in first
        ) == (new != old)
        if tuning.error_limit is None and m.setting in held:  # A gain counts in the same worlds.
            h, own = held[m.setting], held[now.setting]
            is_faster = h.times.mean() < 0.95 * own.times.mean()
            assert is_faster or max(h.error.max(), THRESHOLD) < max(own.error.max(), THRESHOLD)
        assert len(rest) == 1 + (
            m.setting in held
        )  # Errors on worlds held back may lead to a setting not timed there.
        if m.setting in held:
            h = held[m.setting]
            ratio = float(h.times.mean() / held[now.setting].times.mean())
            worst = format_speed(float(h.error.max()))
            assert (
                f"held back from the choice: {ratio:.2f} of the time, worst error {worst}"
                in rest[-1]
            )
            assert f"in {len(held[now.setting].error)} steps" in rest[-1]
    for row in tuning.choices.itertuples(index=False):
        chosen = next(x for x in tuning.measured if x.setting.short_name == row.option)
        h = held.get(chosen.setting)
        assert row.time == f"{time[chosen.setting] / time[now.setting]:.2f}"
        expected = (
            "–" if h is None else f"{float(h.times.mean() / held[now.setting].times.mean()):.2f}"
        )
        assert row[-2] == expected
        assert row[-1] == ("–" if h is None else format_speed(float(h.error.max())))
