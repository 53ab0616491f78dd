"""Explain the slip of contacts at states of a MuJoCo model, and simulate settings that can reduce it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lavender.audit.bodies import find_bodies, find_geom, get_geoms
from lavender.audit.page import ResultPage
from lavender.audit.provenance import describe_provenance, format_provenance
from lavender.audit.settings import MujocoSetting, get_option_value
from lavender.audit.simulated_worlds import count_engine_warnings, has_diverged
from lavender.audit.slip import (
    CAUSES,
    MIN_EXPLAINED_SLIP,
    REMEDY_STEPS,
    Remedy,
    SlipExplanation,
    average_slip,
    explain_record,
    name_blocks,
    read_slip,
    tabulate_slip,
)
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.base.lazy_import import markupsafe
from lavender.base.lazy_import import pandas as pd
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.mujoco_step import step_from_mujoco
from lavender.io.start_states import name_model, read_states, without_sleep
from lavender.report.page import Page, make_shares, tabulate_frame
from lavender.report.runner import Event
from lavender.report.text import format_count, format_speed

MIN_LASTING_SHARE = (
    0.5  # A pair of bodies lasts if it touches in at least this share of the states.
)
MAX_REMEDY_STATES = (
    8  # Settings are simulated from up to this many states, those with the largest slip.
)
FRICTION_FACTOR = 2.0  # The friction coefficient is multiplied by this in one of the settings.


@dataclass(frozen=True, eq=False)
class SlipOfStates:
    """Slip of contacts at several states of a model."""

    # One for each state that has a contact with friction. The one with the fastest contact has `remedies`: settings of
    # MuJoCo, each simulated from up to 8 states, those in which this contact slides fastest.
    explanations: tuple[SlipExplanation, ...]
    n_states: int  # Number of states.
    # Indices of the states that are left out, because MuJoCo restarts the simulation in a step up to the explained one:
    # its numbers are not finite, or above 1e10.
    diverged: tuple[int, ...] = ()
    misfit: str = ""  # Sentence on states that do not fit the model; else empty.
    provenance: dict[str, Any] = field(default_factory=dict)  # Result of `describe_provenance`.

    @property
    def worst(self) -> SlipExplanation:
        """The explanation that has settings, else the one with the fastest contact; there must be at least one."""
        simulated = (e for e in self.explanations if e.remedies)
        return next(simulated, max(self.explanations, key=lambda e: e.speeds.max()))

    @property
    def table(self) -> pd.DataFrame:
        """Mean sliding speed of each pair of geoms [m/s], its largest part and the cause of this part."""
        return tabulate_slip(average_slip(self.explanations))

    @property
    def notes(self) -> list[str]:
        """Sentences about states that do not fit the model, and that are left out because they diverge."""
        notes = [self.misfit] if self.misfit else []
        if n := len(self.diverged):
            left_out = f"{format_count(n, 'state')} of {self.n_states} {'is' if n == 1 else 'are'} left out"
            why = "MuJoCo restarts the simulation, which diverges up to the explained step"
            notes.append(f"{left_out}, the first is state {self.diverged[0]}: {why}.")
        return notes

    @property
    def page(self) -> ResultPage:
        """Page with the slip of each pair of geoms, the settings simulated, and the slip over time."""
        worst = self.worst
        remedies = [r.__dict__ | {"speeds": list(r.speeds)} for r in worst.remedies]
        numbers = {
            "states": self.n_states,
            "explained": len(self.explanations),
            "state": worst.state,
            "slip": self.table.to_dict("records"),
            "remedies": remedies,
            "provenance": self.provenance,
        }
        tables = [self.table, worst.remedies_table] if remedies else [self.table]
        return ResultPage(
            self.make_page, numbers, tables, provenance=format_provenance(self.provenance)
        )

    def make_page(self, folder: Path | None) -> Page:
        """Make the page: the fastest contact with its cause, shares of the causes, slip over time, settings."""
        worst = self.worst
        slips = self.worst.slips
        first = slips.loc[slips["speed"].idxmax()]
        verdict = f"No contact slips faster than {format_speed(MIN_EXPLAINED_SLIP)}."
        if first["cause"] != "no slip":
            verdict = (
                f"Contact {first['contact'].removeprefix('contact ')} slips {format_speed(first['speed'])}; "
                f"cause: {first['cause']}."
            )
        blocks: list[Any] = []
        if folder is not None:
            shares = first[list(CAUSES.values())].astype(float).clip(lower=0.0)
            total = float(shares.sum()) or 1.0
            parts = [
                (
                    cause,
                    f"var(--s{i})",
                    float(shares[cause]) / total,
                    [format_speed(first[cause])],
                    "",
                )
                for i, cause in enumerate(CAUSES.values())
            ]
            causes = make_shares(parts, title="Causes of this slip")
            drawn = [markupsafe.Markup(worst.draw_slip(folder))] if worst.remedies else []
            blocks = [{"pair": [drawn or causes, causes if drawn else []]}]
            blocks.append(tabulate_frame(self.table, title="Slip of each pair of geoms"))
            if worst.remedies:
                blocks.append(tabulate_frame(worst.remedies_table, title="Settings simulated"))
        n = len(self.explanations)
        model = self.provenance.get("model", "")
        source = f"lavender slip · {model} · {format_count(n, 'state')} with contact"
        head, *settings = worst.advice or [""]
        advice = f"{head} {'; '.join(map(str.strip, settings))}." if settings else head
        sentences = [" ".join(worst.sentences), *filter(None, [advice])]
        footer = ["Files: numbers.json, figures/ (PDF, SVG, PNG)."]
        return Page(
            "lavender slip",
            source,
            verdict,
            sentences,
            warnings=self.notes,
            blocks=blocks,
            footer=footer,
        )


def explain_slip_of_states(
    model: Any,
    states: Any = None,
    *,
    contacts: Sequence[str] | str | None = None,
    steps: int = 1,
    watch: Callable[[Event], None] | None = None,
) -> SlipOfStates:
    """Explain the slip of contacts of a MuJoCo model at given states.

    Parameters
    ----------
    model : mujoco.MjModel
    states : path of an .npz, "keyframes", or arrays, optional
        As for `lavender.audit`: `states.npz` of an audit or a recording. Default: the model's initial state.
    contacts : names or a part of names, optional
        Geoms of the contacts to explain; default: all. States in which these geoms touch nothing are skipped.
    steps : int, default 1
        Steps that are simulated from each state, with its controls and without sleep; the last one is explained.
    watch : callable, optional
        Called with the progress.

    Returns
    -------
    SlipOfStates
    """
    mj = import_mujoco()
    model = without_sleep(mj, model)
    entries = [contacts] if isinstance(contacts, str) else list(contacts or ())
    geoms = [mj.mj_id2name(model, mj.mjtObj.mjOBJ_GEOM, i) or str(i) for i in range(model.ngeom)]
    for entry in entries:
        if model.nflex == 0 and not any(entry in name for name in geoms):
            known = ", ".join(geoms[:8])
            raise InputError(
                f"contacts names {entry!r}, which no geom's name contains; geoms are {known}"
            )
    starts = None if states is None else read_states(mj, model, states)
    vectors = [None] if starts is None else list(starts.vectors)
    misfit = "" if starts is None else starts.misfit
    explanations: list[SlipExplanation] = []
    diverged: list[int] = []
    explained = []  # State vector of each explanation.
    with count_engine_warnings(mj):
        for i, vector in enumerate(vectors):
            if watch is not None:
                watch(Event(i, len(vectors), "", "", phase="explaining states"))
            data = _advance(mj, model, vector, steps)
            if data is None:
                diverged.append(i)
                continue
            explanation = _explain_state(mj, model, data, entries)
            if explanation is not None:
                explanations.append(replace(explanation, state=i))
                own = np.empty(mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION))
                mj.mj_getState(model, data, own, mj.mjtState.mjSTATE_INTEGRATION)
                explained.append(own)
        if explanations:
            _simulate_remedies(mj, model, explanations, explained, watch)
    found = describe_provenance(model, name_model(model))
    return SlipOfStates(tuple(explanations), len(vectors), tuple(diverged), misfit, found)


def _advance(mj: Any, model: Any, vector: FloatArray | None, steps: int) -> Any:
    """Return data after the forward pass of step number `steps` from a state; None if the simulation diverges."""
    data = mj.MjData(model)
    if vector is not None:
        mj.mj_setState(model, data, vector, mj.mjtState.mjSTATE_INTEGRATION)
    try:
        for _ in range(steps - 1):
            mj.mj_step(model, data)
            if has_diverged(mj, data):
                return None
        mj.mj_forward(model, data)
    except mj.FatalError:
        return None
    return None if _is_diverging(mj, data) else data


def _is_diverging(mj: Any, data: Any) -> bool:
    """Return whether MuJoCo will restart the simulation in the step of this forward pass."""
    return not all(
        np.abs(x).max(initial=0.0) <= mj.mjMAXVAL for x in (data.qpos, data.qvel, data.qacc)
    )


def _explain_state(mj: Any, model: Any, data: Any, entries: list[str]) -> SlipExplanation | None:
    """Explain the step after a forward pass; None if no chosen contact has friction."""
    record = step_from_mujoco(model, data)
    names = [
        name
        for name, block in zip(name_blocks(record), record.blocks, strict=True)
        if block.has_friction
    ]
    touching = [entry for entry in entries if any(entry in name for name in names)]
    if not names or (entries and not touching):
        return None
    return explain_record(record, touching or None)


def _simulate_remedies(
    mj: Any, model: Any, explanations: list[SlipExplanation], starts: list[FloatArray], watch: Any
) -> None:
    """Simulate settings from the states in which the followed pair slides fastest, and add their results.

    The followed pair of bodies has the fastest contact of the pairs that touch in at least half of the states: any
    geoms of the two bodies count, because a pad may hold when the mesh beside it separates.
    """
    points = pd.concat([e.slips.assign(k=k, use=_get_uses(e)) for k, e in enumerate(explanations)])
    points["bodies"] = [find_bodies(mj, model, contact) for contact in points["contact"]]
    lasting = points.groupby("bodies")["k"].nunique()
    lasting = lasting.index[lasting >= MIN_LASTING_SHARE * len(explanations)]
    candidates = points[points["bodies"].isin(lasting)] if len(lasting) else points
    first = candidates.iloc[int(candidates["speed"].to_numpy().argmax())]
    if not first["speed"] > MIN_EXPLAINED_SLIP or np.isnan(first["use"]):
        return  # No setting changes the slip of a contact without normal force.
    pair, fastest = str(first["bodies"]), int(first["k"])
    own = points[points["bodies"] == pair]
    sliding = own.groupby("k")["speed"].mean().sort_values(ascending=False, kind="stable")
    chosen = [starts[k] for k in sliding.index[:MAX_REMEDY_STATES]]
    settings = list(_change_settings(mj, model, pair, own["contact"]))
    remedies: list[Remedy] = []
    for k, (text, changed) in enumerate(settings):
        if watch is not None:
            states = format_count(len(chosen), "state")
            watch(Event(k, len(settings), states, "", phase="simulating settings"))
        results = [_simulate_slip(mj, changed, state, pair) for state in chosen]
        steps = [step for _, step in results]
        if k == 0 and min(steps) < 0:
            # Compare settings only from the states from which the present setting does not diverge.
            chosen = [state for state, step in zip(chosen, steps, strict=True) if step < 0]
            results = [result for result in results if result[1] < 0]
            steps = [-1]
        step = min((step for step in steps if step >= 0), default=-1)
        remedies.append(Remedy.of_runs(text, np.array([speeds for speeds, _ in results]), step))
    explanations[fastest] = replace(
        explanations[fastest], remedies=tuple(remedies), n_states=len(chosen), followed=pair
    )


def _get_uses(explanation: SlipExplanation) -> FloatArray:
    """Return the friction use of each contact; 0 if it is not known, nan without a normal force."""
    use = explanation.friction_use
    return np.zeros(len(explanation.contacts)) if use is None else use


def _change_settings(
    mj: Any, model: Any, pair: str, contacts: Iterable[str]
) -> Iterator[tuple[str, Any]]:
    """Yield the text of each setting that can reduce the slip of two bodies, with the changed model.

    `contacts` are the names of their contacts. The first model is the model itself.
    """
    yield "as it is", model
    options: list[dict[str, Any]] = [
        {"iterations": 10 * int(model.opt.iterations), "tolerance": 1e-12},
        {"impratio": 10.0 * float(model.opt.impratio)},
        {"noslip_iterations": 20},
    ]
    if get_option_value(mj, model, "cone") == "pyramidal":
        options += [{"cone": "elliptic", **x} for x in ({}, *options[1:])]
    settings = dict.fromkeys(MujocoSetting.from_options(mj, model, **x) for x in options)
    yield from ((s.option_line, s.apply_to(mj, model)) for s in settings if s.options)
    shortest = 2.0 * model.opt.timestep  # MuJoCo uses no shorter time constant.
    if model.geom_solref[:, 0].max(initial=0.0) > shortest:  # Negative values are stiffnesses.
        changed = copy.deepcopy(model)
        for solref in (changed.geom_solref, changed.pair_solref):
            solref[solref[:, 0] > shortest] = shortest, 1.0
        yield f'solref="{shortest:g} 1" of all geoms', changed

    names = list(dict.fromkeys(x for c in contacts for x in get_geoms(c).split(", ")))
    numbers = [find_geom(mj, model, name) for name in names]
    if " and " in pair and numbers and min(numbers) >= 0:
        changed = copy.deepcopy(model)
        friction = FRICTION_FACTOR * float(model.geom_friction[numbers, 0].max())
        changed.geom_friction[numbers, 0] = friction
        is_own_pair = np.isin(model.pair_geom1, numbers) & np.isin(model.pair_geom2, numbers)
        changed.pair_friction[is_own_pair, :2] *= FRICTION_FACTOR
        yield f'friction="{friction:g}" of {" and ".join(names)}', changed


def _simulate_slip(mj: Any, model: Any, state: FloatArray, pair: str) -> tuple[FloatArray, int]:
    """Return the sliding speeds of two bodies (1 + REMEDY_STEPS,) [m/s] in the steps from a state.

    A speed is nan if no geoms of the two bodies touch in this step. The second result is the step in which the
    simulation diverges (0 is the first), from which on all speeds are nan, or -1.
    """
    data = mj.MjData(model)
    means = np.full(REMEDY_STEPS + 1, np.nan)
    mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
    for step in range(REMEDY_STEPS + 1):
        try:
            mj.mj_forward(model, data)
            if _is_diverging(mj, data):
                return means, step
            record = step_from_mujoco(model, data)
            mj.mj_step(model, data)
        except mj.FatalError:
            return means, step
        names = name_blocks(record)
        sliding = [
            read_slip(block) for name, block in zip(names, record.blocks, strict=True)
            if block.has_friction and find_bodies(mj, model, name) == pair
        ]  # fmt: skip
        speeds = [np.linalg.norm(rows @ data.qvel - surface) for rows, surface in sliding]
        if speeds:
            means[step] = np.mean(speeds)
    return means, -1
