"""Explain the slip of contacts at states of a MuJoCo model."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.audit.page import ResultPage
from lavender.audit.provenance import describe_provenance, format_provenance
from lavender.audit.simulated_worlds import count_engine_warnings, has_diverged
from lavender.audit.slip import (
    CAUSES,
    MIN_EXPLAINED_SLIP,
    SlipExplanation,
    average_slip,
    compute_slip,
    explain_slip,
    find_surface_velocity,
    tabulate_slip,
)
from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.io import mujoco as adapter
from lavender.io.mujoco_memory import import_mujoco
from lavender.io.start_states import name_model, read_states, without_sleep
from lavender.problem import Problem
from lavender.report.page import Page, make_table, tabulate_frame
from lavender.report.runner import Event
from lavender.report.text import format_count, format_speed

if TYPE_CHECKING:
    import pandas as pd

#: {cause of a slip: attributes of MuJoCo that reduce it}, after its documentation on slip in contacts.
MUJOCO_ADVICE = {
    "unfinished solving": "more iterations, a smaller tolerance",
    "shape of the cone": 'cone="elliptic"',
    "softness of friction": "a larger impratio, noslip_iterations, a shorter solref",
    "sliding at the friction limit": "a larger friction, or a larger normal force",
}


@dataclass(frozen=True, eq=False)
class SlipOfStates:
    """Slip of contacts at several states of a model."""

    explanations: tuple[SlipExplanation, ...]  # One for each state that has a contact with friction.
    n_states: int  # Number of states.
    # Indices of the states that are left out, because MuJoCo restarts the simulation in a step up to the explained one:
    # its numbers are not finite, or above 1e10.
    diverged: tuple[int, ...] = ()
    misfit: str = ""  # Sentence on states that do not fit the model; else empty.
    provenance: dict[str, Any] = field(default_factory=dict)  # Result of `describe_provenance`.

    @property
    def worst(self) -> SlipExplanation:
        """The explanation with the fastest contact; there must be at least one explanation."""
        return max(self.explanations, key=lambda e: e.variants[0].speeds.max())

    @property
    def table(self) -> pd.DataFrame:
        """Mean sliding speed of each pair of geoms [m/s], its largest part and the cause of this part."""
        return tabulate_slip(average_slip(self.explanations))

    @property
    def notes(self) -> list[str]:
        """Sentences about states that do not fit the model, and that are left out because they diverge."""
        notes = [self.misfit] if self.misfit else []
        if not self.diverged:
            return notes
        n, first = len(self.diverged), self.diverged[0]
        are = "is" if n == 1 else "are"
        left_out = f"{format_count(n, 'state')} of {self.n_states} {are} left out, the first is state {first}"
        return [
            *notes,
            f"{left_out}: MuJoCo restarts the simulation, which diverges up to the explained step.",
        ]

    @property
    def sentences(self) -> list[str]:
        """Sentences about the fastest contact, and MuJoCo's attributes that reduce its slip."""
        slips = self.worst.slips
        attributes = MUJOCO_ADVICE.get(slips["cause"][slips["speed"].idxmax()])
        return [*self.worst.sentences, *([f"MuJoCo's remedies: {attributes}."] if attributes else [])]

    @property
    def page(self) -> ResultPage:
        """Page with the slip of each pair of geoms."""
        numbers = {
            "states": self.n_states, "explained": len(self.explanations), "state": self.worst.state,
            "slip": self.table.to_dict("records"), "provenance": self.provenance,
        }  # fmt: skip
        return ResultPage(
            self.make_page, numbers, [self.table], provenance=format_provenance(self.provenance)
        )

    def make_page(self, folder: Path | None) -> Page:
        """Make the page: the fastest contact with its cause, and the shares of the causes."""
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
            from markupsafe import Markup

            parts = {cause: float(first[cause]) for cause in CAUSES.values()}
            total = sum(parts.values()) or 1.0
            colors = [f"var(--s{i})" for i in range(len(parts))]
            bar = [
                (f"{100.0 * x / total:.1f}", color) for x, color in zip(parts.values(), colors, strict=True)
            ]
            rows: list[Any] = [
                [
                    Markup('<span class="swatch" style="background:{}"></span> {}').format(color, cause),
                    format_speed(x),
                ]
                for (cause, x), color in zip(parts.items(), colors, strict=True)
            ]
            alt = ", ".join(f"{cause} {format_speed(x)}" for cause, x in parts.items())
            causes = [make_table(rows, title="Causes of this slip", classes="full"), {"bar": bar, "alt": alt}]
            blocks = [{"pair": [causes, [tabulate_frame(self.table, title="Slip of each pair of geoms")]]}]
        n = len(self.explanations)
        source = (
            f"lavender slip · {self.provenance.get('model', '')} · {format_count(n, 'state')} with contact"
        )
        sentences, footer = [" ".join(self.sentences)], ["Files: numbers.json."]
        return Page(
            "lavender slip", source, verdict, sentences, warnings=self.notes, blocks=blocks, footer=footer
        )


def explain_slip_of_states(
    model: Any, states: Any = None, *, contacts: Sequence[str] | str | None = None, steps: int = 1,
    watch: Callable[[Event], None] | None = None,
) -> SlipOfStates:  # fmt: skip
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
            raise InputError(f"contacts names {entry!r}, which no geom's name contains; geoms are {known}")
    starts = None if states is None else read_states(mj, model, states)
    vectors = [None] if starts is None else list(starts.vectors)
    misfit = "" if starts is None else starts.misfit
    explanations: list[SlipExplanation] = []
    diverged: list[int] = []
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
    # MuJoCo will restart the simulation in the step of this forward pass if a number is larger.
    is_bounded = all(np.abs(x).max(initial=0.0) <= mj.mjMAXVAL for x in (data.qpos, data.qvel, data.qacc))
    return data if is_bounded else None


def _explain_state(mj: Any, model: Any, data: Any, entries: list[str]) -> SlipExplanation | None:
    """Explain the step after a forward pass; None if no chosen contact has friction."""
    problem, disk, surface = _read_step(mj, model, data)
    measured = problem if disk is None else disk
    blocks = np.flatnonzero(measured.cones.n_tangents > 0).tolist()
    names = [measured.block_name(k) for k in blocks]
    touching = [entry for entry in entries if any(entry in name for name in names)]
    if not names or (entries and not touching):
        return None
    answer = adapter.impulse(model, data)
    explanation = explain_slip(
        problem, answer, contacts=touching or None, disk=disk, surface_velocity=surface
    )
    chosen = [blocks[names.index(name)] for name in explanation.contacts]
    slips = compute_slip(measured, chosen, data.qvel, surface)
    use = [_compute_friction_use(mj, model, data, name) for name in explanation.contacts]
    speeds = np.array([np.linalg.norm(v) for v in slips])
    return replace(explanation, speeds_before=speeds, friction_use=np.array(use))


def _compute_friction_use(mj: Any, model: Any, data: Any, name: str) -> float:
    """Return the friction force of a contact divided by mu times its normal force; nan without a normal force."""
    k, force = int(name.split()[1]), np.empty(6)
    mj.mj_contactForce(model, data, k, force)
    return (
        float(np.hypot(*(force[1:3] / data.contact[k].friction[:2]))) / force[0] if force[0] > 0.0 else np.nan
    )


def _read_step(mj: Any, model: Any, data: Any) -> tuple[Problem, Problem | None, FloatArray]:
    """Return a step's problem, the one with disks if cones are pyramids, and velocities of the surfaces."""
    problem, disk, final = adapter.from_mujoco(model, data), None, data
    if model.opt.cone == mj.mjtCone.mjCONE_PYRAMIDAL:
        round_model = copy.deepcopy(model)
        round_model.opt.cone = mj.mjtCone.mjCONE_ELLIPTIC
        final = mj.MjData(round_model)
        state = np.empty(mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION))
        mj.mj_getState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
        mj.mj_setState(round_model, final, state, mj.mjtState.mjSTATE_INTEGRATION)
        mj.mj_forward(round_model, final)
        disk = adapter.from_mujoco(round_model, final)
    measured = problem if disk is None else disk
    if not getattr(model, "flg_surfacevel", False):
        return problem, disk, find_surface_velocity(measured)
    # MuJoCo subtracts the surfaces' velocities from J v.
    return problem, disk, measured.jacobian @ data.qvel - final.efc_vel
