"""Explain the slip of contacts at states of a MuJoCo model, and simulate settings that can reduce it."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from operator import itemgetter
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from lavender.audit.bodies import find_bodies, get_geoms
from lavender.audit.idle_settings import MIN_CHANGE, PHYSICS_OPTIONS, list_idle_settings
from lavender.audit.page import FORCES_NOTE, ResultPage
from lavender.audit.provenance import describe_provenance, format_provenance
from lavender.audit.settings import MujocoSetting, get_option_value
from lavender.audit.simulated_worlds import Runs, count_engine_warnings, simulate_world
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
from lavender.base.errors import CapabilityError, InputError
from lavender.base.lazy_import import markupsafe
from lavender.base.lazy_import import pandas as pd
from lavender.diagnostics.forces import contact_forces, tabulate_contacts
from lavender.io import mujoco as adapter
from lavender.io.contact_friction import find_geom
from lavender.io.mujoco import from_mujoco
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.mujoco_step import ContactReader, step_from_mujoco
from lavender.io.start_states import Control, load_model, read_states
from lavender.report.page import Page, make_shares, tabulate_frame
from lavender.report.runner import Event
from lavender.report.text import format_count, format_speed
from lavender.report.workers import MIN_DURATION_OF_WORKERS, check_workers, map_unordered

MIN_LASTING_SHARE = (
    0.5  # A pair of bodies lasts if it touches in at least this share of the states.
)
MAX_REMEDY_STATES = (
    8  # Settings are simulated from up to this many states, those with the largest slip.
)
# Colours of the causes in the order of `CAUSES`, as the style sheet of pages names them.
CAUSE_COLORS = tuple(
    f"var(--{name})" for name in ("s0", "s1", "s2", "s3", "s4", "h1", "quiet", "line", "ink")
)
FRICTION_FACTOR = 2.0  # The friction coefficient is multiplied by this in one of the settings.


@dataclass(frozen=True, eq=False)
class SlipOfStates:
    """Slip of contacts at several states of a model."""

    # One for each state that has a contact with friction. The one with the fastest contact has `remedies`: settings of
    # MuJoCo, each simulated from up to 8 states, those in which this contact slides fastest.
    explanations: tuple[SlipExplanation, ...]
    n_states: int  # Number of worlds, each with the state of its last step.
    # Indices of the states that are left out, because MuJoCo restarts the simulation in a step up to the explained one:
    # its numbers are not finite, or above 1e10.
    diverged: tuple[int, ...] = ()
    run_notes: tuple[str, ...] = ()  # Sentences about the worlds and their start states.
    left_out: str = ""  # Sentence on settings that were not simulated; else empty.
    provenance: dict[str, Any] = field(default_factory=dict)  # Result of `describe_provenance`.

    @property
    def worst(self) -> SlipExplanation:
        """The explanation with the simulated settings, else the one with the fastest point; there must be one."""
        return next((e for e in self.explanations if e.remedies), self.fastest)

    @property
    def fastest(self) -> SlipExplanation:
        """The explanation with the fastest point."""
        return max(self.explanations, key=lambda e: float(e.speeds.max()))

    @cached_property
    def slips(self) -> pd.DataFrame:
        """Slip of each pair of geoms and its parts by cause [m/s], means over points and states, the fastest first."""
        return average_slip(self.explanations)

    @property
    def table(self) -> pd.DataFrame:
        """Mean sliding speed of each pair of geoms [m/s], its largest part and the cause of this part."""
        return tabulate_slip(self.slips)

    @property
    def verdict(self) -> str:
        """The fastest pair of geoms with its mean slip and the cause, those of the first row of the table."""
        first = self.slips.iloc[0]
        if first["cause"] == "no slip":
            return f"No contact slips faster than {format_speed(MIN_EXPLAINED_SLIP)}."
        n = int(first["points"])
        mean = f" (mean of {format_count(n, 'point')})" if n > 1 else ""
        return f"{first['contact']}: slips {format_speed(first['speed'])}{mean}; cause: {first['cause']}."

    @property
    def sentences(self) -> list[str]:
        """Sentences on the fastest point, with its state, and whether its cause is that of its pair's mean.

        Empty if no contact slips, which the verdict says.
        """
        fastest = self.fastest
        if self.slips.iloc[0]["cause"] == "no slip":
            return []
        lines = fastest.sentences
        if len(self.explanations) > 1:
            lines = [f"State {fastest.state} (counted from 0) has the fastest point.", *lines]
        point = fastest.slips.loc[fastest.slips["speed"].idxmax()]
        mean = self.slips.set_index("contact").loc[get_geoms(point["contact"])]
        if point["cause"] != mean["cause"]:
            lines.append(
                f"The mean over the points of its two geoms has another cause: {mean['cause']}."
            )
        return lines

    @cached_property
    def forces(self) -> pd.DataFrame:
        """Contacts of all states with their forces and errors [N]: `state`, then as `ContactForces.by_contact`."""
        known = [e for e in self.explanations if e.forces is not None]
        table = tabulate_contacts([e.forces for e in known if e.forces is not None])
        states = [e.state for e in known if e.forces is not None for _ in e.forces.contacts]
        table.insert(0, "state", states)
        return table

    @property
    def fastest_forces(self) -> pd.DataFrame:
        """Forces in the state with the fastest point, of the pairs of bodies that have a chosen contact."""
        fastest = self.fastest
        if fastest.forces is None:
            return pd.DataFrame()
        chosen = {get_geoms(name) for name in fastest.contacts}
        pairs = {
            pair
            for name, pair in zip(fastest.forces.contacts, fastest.forces.pairs, strict=True)
            if get_geoms(name) in chosen
        }
        table = fastest.forces.table
        return table[table["bodies"].isin(pairs)]

    @property
    def notes(self) -> list[str]:
        """Sentences about the worlds, their start states, and those that are left out because they diverge."""
        notes = [*self.run_notes]
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
            "verdict": self.verdict,
            "slip": self.table.to_dict("records"),
            "remedies": remedies,
            "provenance": self.provenance,
        }
        tables = [self.table, self.fastest_forces]
        tables += [worst.remedies_table] if remedies else []
        return ResultPage(
            self.make_page, numbers, tables, provenance=format_provenance(self.provenance)
        )

    def make_page(self, folder: Path | None) -> Page:
        """Make the page: the fastest contact with its cause, shares of the causes, slip over time, settings."""
        worst = self.worst
        first = self.slips.iloc[0]
        blocks: list[Any] = []
        if folder is not None:
            shares = first[list(CAUSES.values())].astype(float).clip(lower=0.0)
            total = float(shares.sum()) or 1.0
            parts = [
                (
                    cause,
                    color,
                    float(shares[cause]) / total,
                    [format_speed(first[cause])],
                    "",
                )
                for cause, color in zip(CAUSES.values(), CAUSE_COLORS, strict=True)
            ]
            causes = make_shares(parts, title=f"Causes of the slip of {first['contact']}")
            drawn = [markupsafe.Markup(worst.draw_slip(folder))] if worst.remedies else []
            blocks = [{"pair": [drawn or causes, causes if drawn else []]}]
            blocks.append(tabulate_frame(self.table, title="Slip of each pair of geoms"))
            if len(self.fastest_forces):
                title = f"Contact forces in state {self.fastest.state}"
                blocks.append(tabulate_frame(self.fastest_forces, title=title, note=FORCES_NOTE))
            if worst.remedies:
                blocks.append(tabulate_frame(worst.remedies_table, title="Settings simulated"))
        n = len(self.explanations)
        model = self.provenance.get("model", "")
        source = f"lavender slip · {model} · {format_count(n, 'state')} with contact"
        head, *settings = worst.advice or [""]
        advice = f"{head} {'; '.join(map(str.strip, settings))}." if settings else head
        sentences = [*filter(None, [" ".join(self.sentences), advice])]
        footer = [
            *filter(None, [self.left_out]),
            "Files: forces.csv (contacts of all states), numbers.json, figures/ (PDF, SVG, PNG).",
        ]
        return Page(
            "lavender slip",
            source,
            self.verdict,
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
    worlds: int | None = None,
    steps: int = 1,
    control: Control = "hold",
    seed: int = 0,
    spread: float | None = None,
    workers: int = -1,
    watch: Callable[[Event], None] | None = None,
) -> SlipOfStates:
    """Explain the slip of contacts of a MuJoCo model in the last step of worlds.

    Parameters
    ----------
    model : path of a model (MJCF, .mjb) or mujoco.MjModel
    states : path of an .npz, "keyframes", or arrays, optional
        As for `lavender.audit`: `states.npz` of an audit or a recording. Default: the model's initial state.
    contacts : names or a part of names, optional
        Geoms of the contacts to explain; default: all. States in which these geoms touch nothing are skipped.
    worlds : int, optional
        Worlds that start from the states, as those of `lavender.audit`. Default: one for each state.
    steps : int, default 1
        Steps that are simulated in each world, without sleep; the last one is explained.
    control, seed, spread
        As for `lavender.audit`; default: the controls of the state.
    workers : int
        Processes; -1: one for each core.
    watch : callable, optional
        Called with the progress.

    Returns
    -------
    SlipOfStates
    """
    check_workers(workers)
    mj, loaded = load_model(model)
    starts = None if states is None else read_states(mj, loaded, states)
    n = (1 if starts is None else len(starts)) if worlds is None else worlds
    runs = Runs.of_model(model, n, steps, states=starts, control=control, seed=seed)
    runs = runs.choose_spread(spread, watch)
    model = runs.model
    entries = [contacts] if isinstance(contacts, str) else list(contacts or ())
    geoms = [mj.mj_id2name(model, mj.mjtObj.mjOBJ_GEOM, i) or str(i) for i in range(model.ngeom)]
    for entry in entries:
        if model.nflex == 0 and not any(entry in name for name in geoms):
            known = ", ".join(geoms[:8])
            raise InputError(
                f"contacts names {entry!r}, which no geom's name contains; geoms are {known}"
            )
    begin = perf_counter()
    found = [_explain_world(runs, entries, 0)]
    if workers == -1 and (perf_counter() - begin) * n < MIN_DURATION_OF_WORKERS:
        workers = 1
    tasks = [(runs, entries, world) for world in range(1, n)]
    for i, result in enumerate(map_unordered(_explain_world, tasks, workers, "loky"), 1):
        if watch is not None:
            watch(Event(i, n, "", "", phase="explaining states"))
        found.append(result)
    found.sort(key=lambda result: result[0])
    touching = [(e, state) for _, state, e in found if e is not None and state is not None]
    explanations = [e for e, _ in touching]
    diverged = tuple(world for world, state, _ in found if state is None)
    left_out = ""
    if explanations:
        left_out = _simulate_remedies(
            mj, model, explanations, [state for _, state in touching], workers, watch
        )
    provenance = describe_provenance(model, runs.name)
    return SlipOfStates(tuple(explanations), n, diverged, runs.notes, left_out, provenance)


def _explain_world(
    runs: Runs, entries: list[str], world: int
) -> tuple[int, FloatArray | None, SlipExplanation | None]:
    """Explain the last step of a world, in a worker.

    Returns the world, the state before this step (None if the world diverges up to it), and the explanation (None if no
    chosen contact has friction).
    """
    mj = runs.mj
    with count_engine_warnings(mj):
        states, divergence, _ = simulate_world(runs, world)
        if divergence is not None:
            return world, None, None
        data = mj.MjData(runs.model)
        mj.mj_setState(runs.model, data, states[-1], mj.mjtState.mjSTATE_INTEGRATION)
        mj.mj_forward(runs.model, data)
        explanation = _explain_state(runs.model, data, entries)
    return world, states[-1], None if explanation is None else replace(explanation, state=world)


def _is_diverging(mj: Any, data: Any) -> bool:
    """Return whether MuJoCo will restart the simulation in the step of this forward pass."""
    return not all(
        np.abs(x).max(initial=0.0) <= mj.mjMAXVAL for x in (data.qpos, data.qvel, data.qacc)
    )


def _explain_state(model: Any, data: Any, entries: list[str]) -> SlipExplanation | None:
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
    forces = None
    # A step without a solution, or whose integrator hides its matrix, has no exact forces.
    with contextlib.suppress(InputError, CapabilityError):
        pairs = partial(find_bodies, import_mujoco(), model)
        answer = adapter.impulse(model, data), float(model.opt.timestep)
        forces = contact_forces(from_mujoco(model, data), answer[0], dt=answer[1], pairs=pairs)
    return replace(explain_record(record, touching or None), forces=forces)


def _simulate_remedies(
    mj: Any,
    model: Any,
    explanations: list[SlipExplanation],
    starts: list[FloatArray],
    workers: int,
    watch: Any,
) -> str:
    """Simulate settings from the states in which the followed pair slides fastest, and add their results.

    Settings of physics that hardly change the fastest step are left out; the result is a sentence that names them.

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
        return ""  # No setting changes the slip of a contact without normal force.
    pair, fastest = str(first["bodies"]), int(first["k"])
    own = points[points["bodies"] == pair]
    sliding = own.groupby("k")["speed"].mean().sort_values(ascending=False, kind="stable")
    chosen = [starts[k] for k in sliding.index[:MAX_REMEDY_STATES]]
    settings = list(_change_settings(mj, model, pair, own["contact"]))
    physics = {text: changed for text, changed, is_physics in settings if is_physics}
    idle = list_idle_settings(mj, model, chosen[0], physics)
    settings = [x for x in settings if x[0] not in idle]
    remedies: list[Remedy] = []
    for k, (text, changed, _) in enumerate(settings):
        if watch is not None:
            states = format_count(len(chosen), "state")
            watch(Event(k, len(settings), states, "", phase="simulating settings"))
        tasks = [(changed, state, pair, i) for i, state in enumerate(chosen)]
        found = sorted(map_unordered(_simulate_slip, tasks, workers, "loky"), key=itemgetter(0))
        results = [(speeds, step) for _, speeds, step in found]
        if k == 0 and min(step for _, step in results) < 0:
            # Compare settings only from the states from which the present setting does not diverge.
            chosen = [chosen[i] for i, _, step in found if step < 0]
            results = [result for result in results if result[1] < 0]
        step = min((step for _, step in results if step >= 0), default=-1)
        remedies.append(Remedy.of_runs(text, np.array([speeds for speeds, _ in results]), step))
    explanations[fastest] = replace(
        explanations[fastest], remedies=tuple(remedies), n_states=len(chosen), followed=pair
    )
    change = f"less than {100.0 * MIN_CHANGE:.0f} %"
    names = "; ".join(idle)
    return (
        f"Not simulated, because it changes the fastest step by {change}: {names}." if idle else ""
    )


def _get_uses(explanation: SlipExplanation) -> FloatArray:
    """Return the friction use of each contact; 0 if it is not known, nan without a normal force."""
    use = explanation.friction_use
    return np.zeros(len(explanation.contacts)) if use is None else use


def _change_settings(
    mj: Any, model: Any, pair: str, contacts: Iterable[str]
) -> Iterator[tuple[str, Any, bool]]:
    """Yield (text, changed model, whether it may be left out) of settings that can reduce the slip of two bodies.

    `contacts` are the names of their contacts. The first model is the model itself. Settings of cones and softness may
    be left out.
    """
    yield "as it is", model, False
    options: list[dict[str, Any]] = [
        {"iterations": 10 * int(model.opt.iterations), "tolerance": 1e-12},
        {"impratio": 10.0 * float(model.opt.impratio)},
        {"noslip_iterations": 20},
    ]
    if get_option_value(mj, model, "cone") == "pyramidal":
        options += [{"cone": "elliptic", **x} for x in ({}, *options[1:])]
    settings = dict.fromkeys(MujocoSetting.from_options(mj, model, **x) for x in options)
    for s in settings:
        if s.options:
            is_physics = all(name in PHYSICS_OPTIONS for name, _ in s.options)
            yield s.option_line, s.apply_to(mj, model), is_physics
    shortest = 2.0 * model.opt.timestep  # MuJoCo uses no shorter time constant.
    if model.geom_solref[:, 0].max(initial=0.0) > shortest:  # Negative values are stiffnesses.
        changed = copy.deepcopy(model)
        for solref in (changed.geom_solref, changed.pair_solref):
            solref[solref[:, 0] > shortest] = shortest, 1.0
        yield f'solref="{shortest:g} 1" of all geoms', changed, True

    names = list(dict.fromkeys(x for c in contacts for x in get_geoms(c).split(", ")))
    numbers = [find_geom(mj, model, name) for name in names]
    if " and " in pair and numbers and min(numbers) >= 0:
        changed = copy.deepcopy(model)
        friction = FRICTION_FACTOR * float(model.geom_friction[numbers, 0].max())
        changed.geom_friction[numbers, 0] = friction
        is_own_pair = np.isin(model.pair_geom1, numbers) & np.isin(model.pair_geom2, numbers)
        changed.pair_friction[is_own_pair, :2] *= FRICTION_FACTOR
        yield f'friction="{friction:g}" of {" and ".join(names)}', changed, False


def _simulate_slip(
    model: Any, state: FloatArray, pair: str, number: int
) -> tuple[int, FloatArray, int]:
    """Simulate the steps from a state, in a worker.

    Returns the state's number, the sliding speeds of two bodies (1 + REMEDY_STEPS,) [m/s], nan in a step in which no
    geoms of the two touch, and the step in which the simulation diverges (0 is the first), from which on all speeds are
    nan, or -1.
    """
    mj = import_mujoco()
    data = mj.MjData(model)
    reader = ContactReader(mj, model, data)

    @cache
    def find_pair(geoms: tuple[str, ...]) -> str:
        return find_bodies(mj, model, f"contact ({', '.join(geoms)})")

    means = np.full(REMEDY_STEPS + 1, np.nan)
    mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
    with count_engine_warnings(mj):
        for step in range(REMEDY_STEPS + 1):
            try:
                mj.mj_forward(model, data)
                if _is_diverging(mj, data):
                    return number, means, step
                sliding = [
                    read_slip(block)
                    for block in reader.read_contacts()
                    if block.has_friction and find_pair(block.geoms or (block.key,)) == pair
                ]
                mj.mj_step(model, data)
            except mj.FatalError:
                return number, means, step
            speeds = [np.linalg.norm(rows @ data.qvel - surface) for rows, surface in sliding]
            if speeds:
                means[step] = np.mean(speeds)
    return number, means, -1
