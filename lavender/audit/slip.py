"""Explain why contacts slip: the difference of an engine's step from the rigid laws, read along contact surfaces.

    explanation = lavender.explain_slip(problem, impulse)           # a step's problem and the engine's answer
    print(explanation)                                              # speeds, causes, and the fastest contact

The sliding velocity of a contact is v_t = J_t v+ - surface, the tangential relative velocity after the step minus the
velocity of the surface, such as a conveyor belt's; the one of a joint with dry friction is its velocity. With the
direction u of v_t, the speed u . v_t is a sum: the parts of `lavender.compare` (unfinished solving, the integrator,
softness, the shape of the cone, the convex relaxation) and the sliding that remains by the rigid laws. There, friction
is at its limit, mu times the normal force: the contact slid before the step, or the load along the surface is above
this limit. Parts may be negative, if a cause reduces the slip.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from lavender.audit.bodies import get_geoms
from lavender.base.arrays import FloatArray, as_array
from lavender.base.errors import InputError
from lavender.base.lazy_import import pandas as pd
from lavender.causes.comparison import Comparison, compare
from lavender.causes.difference import Part
from lavender.causes.problems import record_of_problem
from lavender.diagnostics.forces import ContactForces
from lavender.io import mujoco as adapter
from lavender.io.mujoco_step import step_from_mujoco
from lavender.io.step_record import ConstraintBlock, StepRecord, get_force
from lavender.problem import Problem
from lavender.problem.data import check_problem
from lavender.report.text import NONE, format_sizes, format_speed

#: Part of a comparison -> cause in words, in the order of tables.
CAUSES = {
    "solver": "unfinished solving",
    "lost digits": "lost digits of the forces",
    "noslip": "pass against slip",
    "integrator": "integrator",
    "softness": "softness",
    "shape": "shape of the cone",
    "law": "convex relaxation",
    "rest": "not explained",
    "rigid": "sliding at the friction limit",
}
UNKNOWN_SURFACE = "speed of the surface is not known"
# [-] Friction at a smaller part of its limit does not slide at the limit: the surface may move.
MIN_USE_OF_SLIDING = 0.5
# [m/s] Slip below this speed is not explained. It is far below the speeds at which objects slip out of a gripper, and
# above the velocity error of solutions to a relative residual of 1e-9.
MIN_EXPLAINED_SLIP = 1e-6
REMEDY_STEPS = 25  # Settings are compared by their mean slip in this number of further steps.
MAX_REMAINING_SLIP = 0.9  # A setting helps if at most this fraction of the slip remains.
# A contact slid already before the step if it then had at least this fraction of its speed after the step.
MIN_EARLIER_FRACTION = 0.5


@dataclass(frozen=True)
class Remedy:
    """Slip of the fastest contact with a setting of MuJoCo, simulated from several states.

    Any geoms of the two bodies count. Steps in which the bodies do not touch have no slip and do not count.
    """

    # Text for the model's file; the first remedy of an explanation is the model without a change.
    setting: str
    slip: float  # [m/s] Mean speed of the contact's points in the explained step, simulated with the setting.
    # [m/s] The same, as a mean of the steps with contact among the next `REMEDY_STEPS` steps of all states; nan if
    # there is none, or if a run diverges.
    later: float
    # First step in which MuJoCo restarted one of the runs because it diverged; 0 is the explained step, -1 means that
    # no run diverged.
    diverged_step: int = -1
    touching: float = 0.0  # Fraction of these steps with contact.
    kept: int = 0  # Number of states in which the bodies touch in the last of these steps.
    # [m/s] (1 + REMEDY_STEPS,) tuple: mean speed in each step, from the explained one on; nan without contact.
    speeds: tuple[float, ...] = ()

    @classmethod
    def of_runs(cls, setting: str, speeds: FloatArray, diverged_step: int) -> Remedy:
        """Average the speeds (states, 1 + REMEDY_STEPS) [m/s] of the runs with a setting."""

        def compute_mean(values: FloatArray) -> float:
            finite = values[np.isfinite(values)]
            return float(finite.mean()) if len(finite) else np.nan

        touches = np.isfinite(speeds[:, 1:])
        later = np.nan if diverged_step >= 0 else compute_mean(speeds[:, 1:])
        return cls(
            setting,
            compute_mean(speeds[:, 0]),
            later,
            diverged_step,
            float(touches.mean()),
            int(touches[:, -1].sum()),
            tuple(map(compute_mean, speeds.T)),
        )


@dataclass(frozen=True, eq=False)
class SlipExplanation:
    """Slip of contacts after one step with its parts by cause; `str()` gives the table and the sentences."""

    contacts: tuple[str, ...]  # Names of the chosen contacts, or of joints.
    speeds: FloatArray  # (contacts,) m/s, rad/s: sliding speed after the engine's step.
    # (contacts,) m/s, rad/s by cause: the parts sum to the speeds.
    parts: dict[str, FloatArray]
    # (contacts, 2) m/s, rad/s by cause: smallest and largest part, over the orders of exchange.
    intervals: dict[str, FloatArray]
    rigid_speeds: FloatArray  # (contacts,) m/s, rad/s: sliding speed by the rigid laws.
    comparison: Comparison  # Of the rigid laws and the engine.
    units: tuple[str, ...] = ()  # Of each contact: m/s, or rad/s of a rotating joint.
    # (contacts,) m/s, rad/s: sliding speed before the step, if it is known.
    speeds_before: FloatArray | None = None
    # (contacts,): friction force of the engine's answer divided by its limit; nan without a normal force.
    friction_use: FloatArray | None = None
    knows_surfaces: bool = True  # Whether the velocities of the surfaces are known.
    # Settings that were simulated, if the model is known and this is its state with the fastest contact.
    remedies: tuple[Remedy, ...] = ()
    n_states: int = 0  # Number of states from which the settings were simulated.
    followed: str = (
        ""  # Names of the two bodies with the contacts that are followed in the simulated settings.
    )
    state: int = 0  # Index of the state among the given ones.
    forces: ContactForces | None = None  # Of all contacts, if the model is known.

    def __str__(self) -> str:
        from lavender.report.render import format_cells

        return "\n".join([format_cells(self.table).to_string(index=False), *self.sentences])

    @property
    def slips(self) -> pd.DataFrame:
        """Slip of each contact and its parts by cause [m/s, rad/s], and the dominant cause."""
        use = np.ones(len(self.contacts))
        if self.friction_use is not None and not self.knows_surfaces:
            use = self.friction_use
        columns = {"contact": self.contacts, "points": 1, "speed": self.speeds, "use": use}
        return _add_dominant_cause(pd.DataFrame(columns | self.parts))

    @property
    def unit(self) -> str:
        """Unit of the speeds: m/s, rad/s, or both."""
        return ", ".join(sorted(set(self.units))) or "m/s"

    @property
    def causes(self) -> tuple[str, ...]:
        """Dominant cause of each contact's slip: the largest part; "no slip" below 1e-6 m/s."""
        return tuple(self.slips["cause"])

    @property
    def table(self) -> pd.DataFrame:
        """Sliding speed of each contact [m/s, rad/s], its largest part and the cause of this part."""
        return tabulate_slip(self.slips, self.unit).drop(columns="points")

    @property
    def remedies_table(self) -> pd.DataFrame:
        """Slip of the fastest contact with each setting [m/s], in the explained step and later, as texts."""
        slips, means = (
            format_sizes([getattr(r, name) for r in self.remedies]) for name in ("slip", "later")
        )
        for i, remedy in enumerate(self.remedies):
            if remedy.diverged_step >= 0:
                means[i] = f"diverges in step {remedy.diverged_step}"
        texts = [[text.replace(NONE, "no contact") for text in column] for column in (slips, means)]
        settings = [r.setting for r in self.remedies]
        heads = ["setting", "slip [m/s]", f"mean of the next {REMEDY_STEPS} steps [m/s]"]
        columns = dict(zip(heads, [settings, *texts], strict=True))
        n = self.n_states * REMEDY_STEPS
        columns["steps with contact"] = [f"{r.touching * n:.0f} of {n}" for r in self.remedies]
        columns["states that keep contact"] = [
            f"{r.kept} of {self.n_states}" for r in self.remedies
        ]
        return pd.DataFrame(columns)

    def draw_slip(self, folder: Path) -> str:
        """Draw the slip of the fastest contact over time, as it is and with the settings that change it."""
        from lavender.report.drawing import Label, draw_figure, fit_margins, label_ends, style_line

        def shorten(setting: str) -> str:
            return setting.removeprefix("<option ").removesuffix("/>").replace('"', "")

        def fill(axes: Any) -> str:
            labels: list[Label] = []
            drawn: set[bytes] = set()
            for remedy in self.remedies:
                finite = np.array(remedy.speeds)[np.isfinite(remedy.speeds)]
                # Settings without an effect have the same line.
                if len(finite) and finite.tobytes() not in drawn:
                    style = style_line(len(drawn)) | {"marker": ""}
                    drawn.add(finite.tobytes())
                    axes.plot(remedy.speeds, **style)
                    weight = "normal" if labels else "bold"
                    labels.append(
                        Label(finite[-1], shorten(remedy.setting), style["color"], weight)
                    )
            axes.set_xlim(0, REMEDY_STEPS)
            axes.set_ylim(bottom=0.0)
            axes.set_xlabel("step")
            axes.set_ylabel("slip [m/s]")
            label_ends(axes, labels)
            ends = (f"{label.text}: {label.y:.2g} m/s at the end" for label in labels)
            return f"Slip over time. {'; '.join(ends)}"

        note = f"Means over {self.n_states} states. Steps without contact are gaps."
        margins = fit_margins([shorten(remedy.setting) for remedy in self.remedies])
        return draw_figure("slip-over-time", fill, (4.9, 3.3), margins, note=note, folder=folder)

    @property
    def sentences(self) -> list[str]:
        """Sentences about the contact with the largest slip: its cause and its state."""
        if not self.contacts:
            return ["No contact was chosen."]
        i = int(np.argmax(self.speeds))
        slip = self.slips.iloc[i]
        unit = self.units[i] if self.units else "m/s"
        if slip["cause"] == "no slip":
            return [
                f"No chosen contact slides faster than {format_speed(MIN_EXPLAINED_SLIP, unit)}."
            ]
        lines = [f"Fastest: {slip['contact']} with {format_speed(slip['speed'], unit)}."]
        if slip["cause"] == UNKNOWN_SURFACE:
            lines.append(
                "Its friction force is far below its limit, so that it does not slide at this limit: the speed of its "
                "surface is not known. Give surface_velocity, if the surface moves."
            )
        else:
            lines.append(f"Largest part: {self._describe_part(slip['cause'], i, unit)}.")
        ranked = sorted(self.parts, key=lambda cause: -self.parts[cause][i])
        _, high = self.intervals[ranked[1]][i]
        low, _ = self.intervals[ranked[0]][i]
        if high > low and high > MIN_EXPLAINED_SLIP:
            part = self._describe_part(ranked[1], i, unit)
            lines.append(f"The order of exchange decides; also: {part}.")
        use = None if self.friction_use is None else float(self.friction_use[i])
        is_joint = not slip["contact"].startswith("contact")
        has_force = is_joint or use is None or not np.isnan(use)
        if self.speeds_before is not None:
            before = float(self.speeds_before[i])
            after = float(self.rigid_speeds[i])
            lines.append(f"Before the step it slid with {format_speed(before, unit)}.")
            if slip["cause"] == CAUSES["rigid"] and before >= MIN_EARLIER_FRACTION * after:
                slows = "slows it" if after < before else "does not slow it"
                lines.append(f"The cause is that it slid already; friction {slows}.")
            elif slip["cause"] == CAUSES["rigid"] and has_force:
                limit = "its dry friction" if is_joint else "mu times the normal force"
                lines.append(f"The load along the surface is above {limit}.")
        if not has_force:
            no_force = "has no normal force at this contact, and therefore no friction"
            lines.append(f"The engine's answer {no_force}.")
        elif use is not None and not np.isnan(use):
            limit = "its limit" if is_joint else "mu times the normal force"
            share = f"{100.0 * use:.0f} % of {limit}"
            lines.append(f"In the engine's answer its friction force is {share}.")
        return lines

    def _describe_part(self, cause: str, i: int, unit: str) -> str:
        """Return the part of a cause with its interval."""
        mean, (low, high) = self.parts[cause][i], self.intervals[cause][i]
        text = f"{cause}, {format_speed(mean, unit)}"
        if high - low <= 0.05 * abs(mean):
            return text
        return f"{text} ({format_speed(low, unit)} to {format_speed(high, unit)})"

    @property
    def advice(self) -> list[str]:
        """Lines about the settings that helped when they were simulated, best first; or that none did."""
        if not self.remedies:
            return []
        now = self.remedies[0]
        if now.diverged_step >= 0:
            step = f"step {now.diverged_step} after the state"
            cause = f"as it is, the simulation diverges in {step}, and MuJoCo restarts it"
            return [f"No setting is recommended: {cause}. Find the cause first (lavender audit)."]
        is_later = not np.isnan(now.later)
        get_slip = attrgetter("later" if is_later else "slip")
        before = get_slip(now)
        time = f"in the next {REMEDY_STEPS} steps" if is_later else "in the same step"
        if not before > MIN_EXPLAINED_SLIP:
            mean = f"{format_speed(before)} as it is"
            limit = format_speed(MIN_EXPLAINED_SLIP)
            return [
                f"No setting is needed: the mean slip {time} is {mean}; up to {limit} count as no slip."
            ]
        stable = [r for r in self.remedies[1:] if r.diverged_step < 0]
        helpful = [r for r in stable if get_slip(r) <= MAX_REMAINING_SLIP * before]
        if not helpful:
            return [f"None of these settings reduces the slip {time} by more than 10 %."]
        pair = f" of {self.followed}" if self.followed else ""
        head = f"Settings that help (mean slip{pair} {time}, {format_speed(before)} as it is):"
        helpful.sort(key=get_slip)
        lost = {
            r.setting: f"; {r.kept} of {self.n_states} states keep contact, and {now.kept} as it is"
            for r in helpful
            if r.kept < now.kept
        }
        lines = [
            f"  {r.setting}: {format_speed(get_slip(r))}{lost.get(r.setting, '')}" for r in helpful
        ]
        return [head, *lines]


def explain_slip(
    problem: Problem | StepRecord,
    impulse: Any = None,
    *,
    contacts: Sequence[int] | Sequence[str] | str | None = None,
    surface_velocity: Any = None,
) -> SlipExplanation:
    """Divide the slip of contacts, or the motion of joints with dry friction, after a step into parts by their causes.

    Parameters
    ----------
    problem : Problem or StepRecord
        The engine's problem, in generalised coordinates or with bodies. If `lavender.io.from_mujoco` made it from data
        that have not changed since, MuJoCo's whole step is known: pyramids as contacts, the surfaces' velocities, and
        the integrator. Or the record of a step.
    impulse : (m,) N s, optional
        The engine's answer, of a problem.
    contacts : block indices, names or a part of names, optional
        Contacts, joints with dry friction, or limits to explain. Default: all contacts with friction; if there are
        none, all joints with dry friction and all limits.
    surface_velocity : (m,), m/s, optional
        Velocity of the surface along each row of a problem; only its friction rows are read. Default: the target of
        rows without compliance, 0 on rows with compliance.

    Returns
    -------
    SlipExplanation

    Raises
    ------
    InputError
        Nothing can slip, a name fits none, or the impulse has another shape.
    CapabilityError
        The problem is a matrix, so that velocities after the step are not known; or it is too large.
    """
    if isinstance(problem, StepRecord):
        return explain_record(problem, contacts)
    check_problem(problem)
    answer = as_array("impulse", impulse, (problem.m,), unit="N s")
    surface = None
    if surface_velocity is not None:
        surface = as_array("surface_velocity", surface_velocity, (problem.m,), unit="m/s")
    else:
        model, data, is_stepped = adapter.find_source(problem)
        if (
            data is not None
            and not is_stepped
            and np.array_equal(answer, adapter.impulse(model, data))
        ):
            return explain_record(step_from_mujoco(model, data), contacts)
    record = record_of_problem(problem, answer, surface)
    return explain_record(record, contacts, has_start=False, knows_surfaces=surface is not None)


def explain_record(
    record: StepRecord, contacts: Any = None, has_start: bool = True, knows_surfaces: bool = True
) -> SlipExplanation:
    """Explain the slip in a recorded step.

    `has_start`: its velocity is the one before the step; `knows_surfaces`: it has the surfaces' velocities.
    """
    chosen = _choose_blocks(record, contacts)
    names = name_blocks(record)
    found = compare(record)
    velocities = [read_slip(record.blocks[k]) for k in chosen]
    speeds, rigid, uses, before = [], [], [], []
    parts: dict[str, list[float]] = {cause: [] for cause in CAUSES.values()}
    intervals: dict[str, list[tuple[float, float]]] = {cause: [] for cause in CAUSES.values()}
    flat = _flatten_parts(found)
    for k, (rows, surface) in zip(chosen, velocities, strict=True):
        slip = rows @ record.velocity_after - surface
        ideal = rows @ found.a.velocity_after - surface
        speed = float(np.linalg.norm(slip))
        direction = slip / speed if speed > 0.0 else np.eye(len(slip))[0]
        row = direction @ rows
        for name, cause in CAUSES.items():
            part = flat.get(name)
            values = (0.0, 0.0, 0.0) if part is None else part.measure(row)
            if name == "rigid":
                values = (float(direction @ ideal),) * 3
            parts[cause].append(values[0])
            intervals[cause].append(values[1:])
        speeds.append(speed)
        rigid.append(float(np.linalg.norm(ideal)))
        before.append(float(np.linalg.norm(rows @ record.velocity - surface)))
        uses.append(measure_friction_use(record.blocks[k]))
    return SlipExplanation(
        tuple(names[k] for k in chosen), np.array(speeds),
        {cause: np.array(x) for cause, x in parts.items()},
        {cause: np.array(x) for cause, x in intervals.items()}, np.array(rigid), found,
        units=tuple(_find_unit(record, record.blocks[k]) for k in chosen),
        speeds_before=np.array(before) if has_start else None, friction_use=np.array(uses),
        knows_surfaces=knows_surfaces,
    )  # fmt: skip


def _flatten_parts(comparison: Comparison) -> dict[str, Part]:
    """Return the parts by name, with the parts within friction; coefficients do not differ from the rigid laws'."""
    parts = dict(comparison.parts)
    friction = parts.pop("friction", None)
    return parts | ({} if friction is None else {p.name: p for p in friction.parts})


def name_blocks(record: StepRecord) -> list[str]:
    """Return the names of the blocks, with the numbers and geoms of contacts."""
    names, number = [], 0
    for block in record.blocks:
        if block.geoms:
            names.append(f"contact {number} ({', '.join(block.geoms)})")
        else:
            names.append(block.key)
        number += block.role == "contact"
    return names


def read_slip(block: ConstraintBlock) -> tuple[FloatArray, FloatArray]:
    """Return the rows and the surface's velocity of a block's slip: up to two tangents, or the row of a joint."""
    first, count = (1, min(2, block.condim - 1)) if block.role == "contact" else (0, 1)
    rows = block.jacobian[first : first + count]
    moving = block.surface_velocity
    surface = np.zeros(count) if moving is None else moving[first : first + count]
    return rows, surface


def _find_unit(record: StepRecord, block: ConstraintBlock) -> str:
    """Return the unit of a block's slip."""
    moved = record.angular[np.abs(block.jacobian[0]) > 0.0]
    return "rad/s" if block.role != "contact" and len(moved) and moved.all() else "m/s"


def measure_friction_use(block: ConstraintBlock) -> float:
    """Return the friction force of the engine's answer divided by its limit; nan without a normal force."""
    force = get_force(block)
    if block.role == "friction":
        return abs(float(force[0])) / block.loss if block.loss > 0.0 else float("nan")
    if block.role != "contact":
        return float("nan")
    count = min(2, block.condim - 1)
    tangents = force[1 : 1 + count] / block.friction[:count]
    return float(np.linalg.norm(tangents)) / float(force[0]) if force[0] > 0.0 else float("nan")


def _choose_blocks(record: StepRecord, contacts: Any) -> list[int]:
    """Return the indices of the chosen blocks."""
    names = name_blocks(record)
    touching = [k for k, x in enumerate(record.blocks) if x.has_friction]
    rubbing = [
        k for k, x in enumerate(record.blocks)
        if x.role in ("friction", "limit") or (x.role == "bounds" and _is_dry_friction(x))
    ]  # fmt: skip
    if not touching and not rubbing:
        raise InputError(
            "the step has no contact with tangents, no dry friction and no limit; rows of pyramids do not show their "
            "contacts: give the record of the step (lavender.io.step_from_mujoco)"
        )
    if contacts is None:
        return touching or rubbing
    chosen: list[int] = []
    valid = sorted(touching + rubbing)
    for entry in [contacts] if isinstance(contacts, str) else contacts:
        if isinstance(entry, str):
            fitting = [k for k in valid if entry in names[k]]
            if not fitting:
                known = ", ".join(names[k] for k in valid[:8])
                raise InputError(
                    f"contacts names {entry!r}, which no contact's name contains; they are {known}"
                )
            chosen += fitting
        elif entry in valid:
            chosen.append(int(entry))
        else:
            known = f"give one of the blocks {valid[:20]}"
            raise InputError(
                f"contacts names {entry!r}, which is not a contact with tangents; {known}"
            )
    return list(dict.fromkeys(chosen))


def _is_dry_friction(block: ConstraintBlock) -> bool:
    """Return whether the bounds of a row are a friction loss."""
    assert block.bounds is not None
    lower, upper = block.bounds
    return len(lower) == 1 and bool(np.isfinite(upper[0])) and float(upper[0]) == -float(lower[0])


def _add_dominant_cause(slips: pd.DataFrame) -> pd.DataFrame:
    """Add the largest part of each contact's slip and its cause: `part` [m/s] and `cause`, "no slip" below 1e-6 m/s.

    Sliding at the friction limit has a friction force at this limit (`use`, a part of it; nan without a normal force;
    1 if the surfaces' velocities are known).
    """
    parts = slips[list(CAUSES.values())]
    slides = slips["speed"] > MIN_EXPLAINED_SLIP
    cause = parts.idxmax(axis=1) if len(slips) else slips["contact"]
    is_unused = (cause == CAUSES["rigid"]) & (slips["use"].fillna(1.0) < MIN_USE_OF_SLIDING)
    cause = cause.where(slides, "no slip").where(~(slides & is_unused), UNKNOWN_SURFACE)
    return slips.assign(cause=cause, part=parts.max(axis=1).where(slides, 0.0))


def average_slip(explanations: Iterable[SlipExplanation]) -> pd.DataFrame:
    """Return the slip of each pair of geoms, averaged over its points in several states, the fastest pair first."""
    slips = pd.concat([explanation.slips for explanation in explanations])
    groups = slips.drop(columns=["cause", "part"]).groupby(
        slips["contact"].map(get_geoms), sort=False
    )
    means = groups.mean(numeric_only=True).assign(points=groups["points"].sum())
    means = means.sort_values("speed", ascending=False, kind="stable")
    return _add_dominant_cause(means.reset_index())


def tabulate_slip(slips: pd.DataFrame, unit: str = "m/s") -> pd.DataFrame:
    """Return a table of contacts, with their speeds; a contact without slip has no part."""
    heads = {
        "contact": "contact",
        "points": "points",
        "speed": f"slip [{unit}]",
        "part": f"largest part [{unit}]",
        "cause": "cause of this part",
    }
    return slips[list(heads)].rename(columns=heads)
