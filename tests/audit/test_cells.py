"""Each number on which a page rests, left out or changed, changes the page, its numbers or the exit status."""

import dataclasses

import numpy as np
import pytest
from test_audit_sentences import LIMIT, draw_audit, draw_tuning

from lavender.audit.pieces import AUDIT_VERDICTS, NOT_JUDGED
from lavender.audit.provenance import describe_provenance
from lavender.audit.slip import CAUSES, REMEDY_STEPS, Remedy, SlipExplanation
from lavender.audit.slip_states import SlipOfStates
from lavender.io.stored import format_json
from lavender.judge.residuals import CLOSE, WRONG


def read_page(page):
    """Return the words, numbers and tables of a page without figures."""
    words = page.make_page(None).render()
    return words, format_json(page.numbers), *(table.to_csv() for table in page.tables)


def read_audit(result):
    return *read_page(result.page), result.is_unmet


@pytest.mark.parametrize("seed", range(4))
def test_each_step_of_an_audit_changes_its_page_or_the_exit_status(seed):
    rng, result = np.random.default_rng(seed), draw_audit(seed)
    before = read_audit(result)
    shape = result.verdict.shape
    for w, s in zip(*(rng.integers(0, n, 3) for n in shape), strict=True):
        kept = result.numbers[:, w, s].copy(), result.verdict[w, s]
        is_lost = kept[1] == NOT_JUDGED
        # A step that is not judged is judged, another one is left out.
        result.numbers[:, w, s] = 0.5 * LIMIT if is_lost else np.nan
        result.verdict[w, s] = AUDIT_VERDICTS.index(CLOSE) if is_lost else NOT_JUDGED
        assert read_audit(result) != before
        # A step is wrong by more than all others.
        result.numbers[:, w, s], result.verdict[w, s] = 1e3 * LIMIT, AUDIT_VERDICTS.index(WRONG)
        assert read_audit(result) != before
        result.numbers[:, w, s], result.verdict[w, s] = kept
        if result.converged is not None:
            claim = result.converged[w, s]
            result.converged[w, s] = -1 if claim >= 0 else 1
            assert read_audit(result) != before
            result.converged[w, s] = claim
    for name, value in (("n_dropped", result.n_dropped + 1), ("is_stopped", True)):
        other = dataclasses.replace(result, **{name: value})
        assert read_audit(other) != before, name
    assert dataclasses.replace(result, n_dropped=1).is_unmet
    assert read_audit(result) == before


@pytest.mark.parametrize("seed", range(5))
def test_each_setting_of_a_tuning_changes_its_page(seed):
    tuning = draw_tuning(seed)
    before = read_page(tuning.page)
    for side in ("measured", "held"):
        for i, m in enumerate(getattr(tuning, side)):
            for changed in (
                dataclasses.replace(m, error=100.0 * m.error + LIMIT),
                dataclasses.replace(m, times=3.0 * m.times),
                None,
            ):
                own = list(getattr(tuning, side))
                own[i : i + 1] = [] if changed is None else [changed]
                if changed is None and i == 0:
                    continue  # The present setting is always there.
                more = {side: own}
                if side == "held":
                    more["held_errors"] = {h.setting: float(h.error.max()) for h in own}
                other = dataclasses.replace(tuning, **more)
                assert read_page(other.page) != before, (side, i)


def draw_remedies(rng, n_states):
    runs = rng.uniform(0.0, 1e-2, (4, n_states, 1 + REMEDY_STEPS))
    runs[rng.random(runs.shape) < 0.1] = np.nan
    remedies = [
        Remedy.of_runs(f"setting {i}", speeds, -1 if i == 0 else int(rng.choice([-1, -1, 3])))
        for i, speeds in enumerate(runs)
    ]
    return runs, tuple(remedies)


def draw_slip(seed):
    """Draw the slip of some contacts in some states, with settings simulated from the fastest one."""
    rng = np.random.default_rng(seed)
    found = []
    for state in range(int(rng.integers(1, 4))):
        names = tuple(f"contact {k} (box{k % 2}, floor)" for k in range(int(rng.integers(1, 4))))
        shares = rng.dirichlet(np.full(len(CAUSES), 0.3), len(names))
        speeds = rng.uniform(1e-3, 1e-1, len(names))
        parts = {c: shares[:, i] * speeds for i, c in enumerate(CAUSES.values())}
        found.append(SlipExplanation(
            names, speeds, parts, {c: np.stack([0.9 * x, 1.1 * x], 1) for c, x in parts.items()},
            parts["sliding at the friction limit"], None, units=("m/s",) * len(names),
            speeds_before=0.5 * speeds, friction_use=rng.uniform(0.1, 1.0, len(names)), state=state,
        ))  # fmt: skip
    fastest = max(range(len(found)), key=lambda k: found[k].speeds.max())
    _, remedies = draw_remedies(rng, 2)
    found[fastest] = dataclasses.replace(
        found[fastest], remedies=remedies, n_states=2, followed="box0 and floor"
    )
    provenance = describe_provenance(None, "m.xml")
    return SlipOfStates(tuple(found), len(found), provenance=provenance), fastest


@pytest.mark.parametrize("seed", range(4))
def test_each_point_and_setting_of_a_slip_changes_its_page(seed):
    result, fastest = draw_slip(seed)
    before = read_page(result.page)

    def read_with(k, **more):
        own = list(result.explanations)
        own[k] = dataclasses.replace(own[k], **more)
        return read_page(dataclasses.replace(result, explanations=tuple(own)).page)

    for k, e in enumerate(result.explanations):
        for i in range(len(e.contacts)):
            factor = np.where(np.arange(len(e.contacts)) == i, 3.0, 1.0)
            parts = {c: factor * x for c, x in e.parts.items()}
            assert read_with(k, speeds=factor * e.speeds, parts=parts) != before
    e = result.explanations[fastest]
    for i, remedy in enumerate(e.remedies):
        rest = (*e.remedies[:i], *e.remedies[i + 1 :])
        assert read_with(fastest, remedies=rest) != before
        for changed in (
            {"later": 0.01 * remedy.later}, {"slip": 0.01 * remedy.slip}, {"kept": 1 - min(remedy.kept, 1)},
            {"diverged_step": 7}, {"touching": 0.5 * remedy.touching},
        ):  # fmt: skip
            if "later" in changed and remedy.diverged_step >= 0:
                continue
            own = (*e.remedies[:i], dataclasses.replace(remedy, **changed), *e.remedies[i + 1 :])
            assert read_with(fastest, remedies=own) != before, changed
    if len(result.explanations) > 1:
        fewer = dataclasses.replace(result, diverged=(7,))
        assert read_page(fewer.page) != before


@pytest.mark.parametrize("seed", range(12))
def test_advice_on_slip_is_that_of_brute_force(seed):
    """Means and counts are over the further steps alone; a setting with which a run diverges is never advised."""
    rng = np.random.default_rng(seed)
    n_states = int(rng.integers(1, 5))
    runs, remedies = draw_remedies(rng, n_states)
    result, fastest = draw_slip(seed)
    e = dataclasses.replace(result.explanations[fastest], remedies=remedies, n_states=n_states)
    table, text = e.remedies_table, "\n".join(e.advice)
    later = {}
    for i, (remedy, speeds) in enumerate(zip(remedies, runs, strict=True)):
        touching = sum(v == v for run in speeds for v in run[1:])
        assert table["steps with contact"][i] == f"{touching} of {n_states * REMEDY_STEPS}"
        kept = sum(run[-1] == run[-1] for run in speeds)
        assert table["states that keep contact"][i] == f"{kept} of {n_states}"
        values = [v for run in speeds for v in run[1:] if v == v]
        if remedy.diverged_step < 0:
            later[remedy.setting] = sum(values) / len(values)
        assert (f"step {remedy.diverged_step}" in table.iloc[i, 2]) == (remedy.diverged_step >= 0)
    now = later["setting 0"]
    helpful = {s for s, x in later.items() if s != "setting 0" and x <= 0.9 * now}
    assert {r.setting for r in remedies if f"{r.setting}:" in text} == helpful
