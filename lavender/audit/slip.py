"""Explain why contacts slip: solve an engine's step again in variants, each of which replaces one more property.

    explanation = lavender.explain_slip(problem, impulse)           # a step's problem and the engine's answer
    print(explanation)                                              # speeds, causes, and the fastest contact

The sliding speed of a contact is the norm of v_t = J_t v+ - target, the tangential relative velocity after the step
minus the velocity of the surface, such as a conveyor belt's. Softened friction rows (with compliance) are an exception:
their target is the damping of an engine and not the velocity of a surface, unless `surface_velocity` is given. v_t is
computed from the impulses of these variants; each variant includes the replacements of the variants above it:

    engine      the engine's answer
    solved      the exact solution of the engine's own problem
    disk        a round friction cone in place of a pyramid or box
    hard        friction rows without compliance and with the surface's velocity as target, in place of softened ones
    coulomb     Coulomb's law in place of the convex relaxation

The difference of v_t between two consecutive variants is the part of the slip that the replaced property causes:
unfinished iterations, the shape of the cone, compliance, the relaxation. The sliding in the last variant remains under
Coulomb's law with friction at its limit, mu times the normal force: the contact slid before the step, or the load along
the surface is above this limit. The parts are norms of vector differences, so the parts of one contact can add up to
more than its speed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float
from lavender.base.errors import InputError
from lavender.base.lazy_import import pandas as pd
from lavender.judge.residuals import residual
from lavender.problem import Problem
from lavender.problem.data import check_problem
from lavender.report.text import NONE, format_size, format_sizes
from lavender.solving.solve import solve

#: {variant: cause of its difference from the next variant}, in the order of replacement.
CAUSES = {
    "engine": "unfinished solving",
    "solved": "shape of the cone",
    "disk": "softness of friction",
    "hard": "convex relaxation",
    "coulomb": "sliding at the friction limit",
}
# [m/s] Slip below this speed is not explained. It is far below the speeds at which objects slip out of a gripper, and
# above the velocity error of solutions to a relative residual of 1e-9.
MIN_EXPLAINED_SLIP = 1e-6
REMEDY_STEPS = 25  # Settings are compared by their mean slip in this number of further steps.
MAX_REMAINING_SLIP = 0.9  # A setting helps if at most this fraction of the slip remains.
# A contact slid already before the step if it then had at least this fraction of its speed after the step.
MIN_EARLIER_FRACTION = 0.5
UNDEFINED_LAW = "Coulomb's law is not defined for its round cones"


@dataclass(frozen=True, eq=False)
class SlipVariant:
    """Slip of the chosen contacts in one variant of the step."""

    name: str  # Key of `CAUSES`.
    # [m/s] tuple of (tangents,) arrays: tangential velocity of each contact after the step.
    velocity: tuple[FloatArray, ...]
    # Relative residual of the impulses in this variant's problem; at most 1e-9 for solutions that were found.
    relative: float
    # Reason why the variant equals the previous one, or why its solution is not accepted; "" otherwise.
    note: str = ""

    @property
    def speeds(self) -> FloatArray:
        """Sliding speed of each contact [m/s]."""
        return np.array([np.linalg.norm(v) for v in self.velocity])


@dataclass(frozen=True)
class Remedy:
    """Slip of the fastest contact with a setting of MuJoCo, simulated from several states.

    Steps in which the geoms do not touch have no slip and do not count.
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
    kept: int = 0  # Number of states in which the geoms touch in the last of these steps.
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
    """Slip of contacts in each variant of one step; `str()` gives the table and the sentences."""

    contacts: tuple[str, ...]  # Names of the chosen contacts.
    variants: tuple[SlipVariant, ...]  # In the order of replacement.
    speeds_before: FloatArray | None = (
        None  # (contacts,) m/s: sliding speed before the step, if it is known.
    )
    # (contacts,): friction force of the engine's answer divided by mu times the normal force, if it is known.
    friction_use: FloatArray | None = None
    # Settings that were simulated, if the model is known and this is its state with the fastest contact.
    remedies: tuple[Remedy, ...] = ()
    n_states: int = 0  # Number of states from which the settings were simulated.
    state: int = 0  # Index of the state among the given ones.

    def __str__(self) -> str:
        from lavender.report.render import format_cells

        return "\n".join([format_cells(self.table).to_string(index=False), *self.sentences])

    @property
    def parts(self) -> dict[str, FloatArray]:
        """Part of each contact's slip (contacts,) [m/s] by its cause."""
        following = [v.velocity for v in self.variants[1:]]
        zero = tuple(np.zeros_like(v) for v in self.variants[-1].velocity)
        parts = {}
        for variant, after in zip(self.variants, [*following, zero], strict=True):
            changes = [np.linalg.norm(a - b) for a, b in zip(variant.velocity, after, strict=True)]
            parts[CAUSES[variant.name]] = np.array(changes)
        return parts

    @property
    def slips(self) -> pd.DataFrame:
        """Slip of each contact and its parts by cause [m/s], and the dominant cause."""
        columns = {
            "contact": self.contacts,
            "points": 1,
            "speed": self.variants[0].speeds,
            **self.parts,
        }
        return _add_dominant_cause(pd.DataFrame(columns))

    @property
    def causes(self) -> tuple[str, ...]:
        """Dominant cause of each contact's slip: the largest part; "no slip" below 1e-6 m/s."""
        return tuple(self.slips["cause"])

    @property
    def table(self) -> pd.DataFrame:
        """Sliding speed of each contact [m/s], its largest part and the cause of this part."""
        return tabulate_slip(self.slips).drop(columns="points")

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
        i = int(np.argmax(self.variants[0].speeds))
        slip = self.slips.iloc[i]
        if slip["cause"] == "no slip":
            return [f"No chosen contact slides faster than {MIN_EXPLAINED_SLIP:g} m/s."]
        lines = [
            f"Fastest: {slip['contact']} with {format_size(slip['speed'])} m/s.",
            f"Largest part: {slip['cause']}, {format_size(slip['part'])} m/s.",
        ]
        use = None if self.friction_use is None else float(self.friction_use[i])
        has_force = use is None or not np.isnan(use)
        if self.speeds_before is not None:
            before = float(self.speeds_before[i])
            after = float(self.variants[-1].speeds[i])
            lines.append(f"Before the step it slid with {format_size(before)} m/s.")
            if slip["cause"] == CAUSES["coulomb"] and before >= MIN_EARLIER_FRACTION * after:
                slows = "slows it" if after < before else "does not slow it"
                lines.append(f"The cause is that it slid already; friction {slows}.")
            elif slip["cause"] == CAUSES["coulomb"] and has_force:
                lines.append("The load along the surface is above mu times the normal force.")
        if not has_force:
            no_force = "has no normal force at this contact, and therefore no friction"
            lines.append(f"The engine's answer {no_force}.")
        elif use is not None:
            share = f"{100.0 * use:.0f} % of mu times the normal force"
            lines.append(f"In the engine's answer its friction force is {share}.")
        noted = [v for v in self.variants if v.note.startswith(("not", UNDEFINED_LAW))]
        return lines + [f"Variant {v.name!r}: {v.note}." for v in noted]

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
            mean = f"{format_size(before)} m/s as it is"
            limit = f"{MIN_EXPLAINED_SLIP:g} m/s"
            return [
                f"No setting is needed: the mean slip {time} is {mean}; up to {limit} count as no slip."
            ]
        stable = [r for r in self.remedies[1:] if r.diverged_step < 0]
        helpful = [r for r in stable if get_slip(r) <= MAX_REMAINING_SLIP * before]
        if not helpful:
            return [f"None of these settings reduces the slip {time} by more than 10 %."]
        head = f"Settings that help (mean slip {time}, {format_size(before)} m/s as it is):"
        helpful.sort(key=get_slip)
        lost = {
            r.setting: f"; {r.kept} of {self.n_states} states keep contact, and {now.kept} as it is"
            for r in helpful
            if r.kept < now.kept
        }
        lines = [
            f"  {r.setting}: {format_size(get_slip(r))} m/s{lost.get(r.setting, '')}"
            for r in helpful
        ]
        return [head, *lines]


def explain_slip(
    problem: Problem,
    impulse: Any,
    *,
    contacts: Sequence[int] | Sequence[str] | str | None = None,
    disk: Problem | None = None,
    surface_velocity: Any = None,
    tol: float = 1e-9,
) -> SlipExplanation:
    """Divide the slip of contacts after a step into parts by their causes.

    Parameters
    ----------
    problem : Problem
        The engine's problem, in generalised coordinates or with bodies.
    impulse : (m,) N s
        The engine's answer.
    contacts : block indices, names or a part of names, optional
        Contacts to explain, of `disk` if it is given. Default: all contacts with tangents.
    disk : Problem, optional
        The problem of the same step with friction cones in place of pyramids, over the same velocities. It is needed
        if the rows of `problem` are edges of pyramids, because such rows do not show which rows form a contact.
    surface_velocity : (rows,), m/s, optional
        Velocity of the surface along each row of `disk` if it is given, else of `problem`; only its friction rows are
        read. Default: the target of rows without compliance, 0 on rows with compliance.
    tol : float, default 1e-9
        Relative residual to which each variant is solved.

    Returns
    -------
    SlipExplanation

    Raises
    ------
    InputError
        No contact has tangents, a name fits none, the impulse has another shape, or the problems have different
        velocities.
    CapabilityError
        The problem is a matrix: velocities after the step are not known.
    """
    check_problem(problem)
    tol = check_float("tol", tol, above=0.0)
    answer = as_array("impulse", impulse, (problem.m,), unit="N s")
    measured = problem if disk is None else disk
    check_problem(measured)
    blocks = _choose_contacts(measured, contacts)
    free, own_free = (p.velocity(np.zeros(p.m)) for p in (measured, problem))
    if own_free.shape != free.shape:
        raise InputError(
            f"disk has velocities of shape {free.shape} and problem of shape {own_free.shape}; both must "
            "describe the same step of the same model"
        )
    if surface_velocity is None:
        surface = find_surface_velocity(measured)
    else:
        surface = as_array("surface_velocity", surface_velocity, (measured.m,), unit="m/s")

    def slip(changed: Problem, impulse: FloatArray) -> tuple[FloatArray, ...]:
        return compute_slip(measured, blocks, changed.velocity(impulse).ravel(), surface)

    motion = problem.__dict__.get("engine_motion")
    velocity = problem.velocity(answer)
    if (
        motion is not None
        and motion.moved_by == "acceleration"
        and np.array_equal(motion.impulse, answer)
    ):
        velocity = own_free + motion.change
    own_slip = compute_slip(measured, blocks, velocity.ravel(), surface)
    variants = [SlipVariant("engine", own_slip, residual(problem, answer).relative)]

    def solve_and_add_variant(
        name: str, changed: Problem, start: FloatArray | None, note: str = ""
    ) -> FloatArray:
        if note:
            last = variants[-1]
            variants.append(replace(last, name=name, note=note))
            return np.zeros(0) if start is None else start
        solution = solve(changed, impulse=start, tol=tol)
        is_solved = solution.residual.relative <= max(tol, solution.residual.roundoff_floor)
        failed = "" if is_solved else f"not solved: {solution.status.name}"
        own = slip(changed, solution.impulse)
        variants.append(SlipVariant(name, own, solution.residual.relative, failed))
        return solution.impulse

    start = solve_and_add_variant("solved", problem, answer)
    own_disk = measured
    if disk is None and problem.cones.has_box:
        own_disk = replace(problem, cones=problem.cones.shaped("disk"))
    same = start if own_disk.m == problem.m else None
    start = solve_and_add_variant(
        "disk", own_disk, same, "cones are round" if own_disk is problem else ""
    )
    hard, has_soft_friction = _replace_soft_friction(own_disk, surface)
    start = solve_and_add_variant(
        "hard", hard, start, "" if has_soft_friction else "friction rows are hard"
    )
    law_note = UNDEFINED_LAW if hard.cones.has_round else ""
    law_note = "the law is Coulomb's" if hard.friction == "coulomb" else law_note
    rigid = hard if law_note else hard.relaxed("coulomb")
    start = solve_and_add_variant("coulomb", rigid, start, law_note)
    names = tuple(measured.block_name(k) for k in blocks)
    return SlipExplanation(names, tuple(variants))


def compute_slip(
    problem: Problem, blocks: Sequence[int], velocity: FloatArray, surface: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the tangential velocity of each contact minus the surface's (tangents,) [m/s]."""
    jacobian = problem.jacobian.tocsr()
    cones = problem.cones
    starts = [int(cones.ptr[k]) + 1 for k in blocks]
    counts = [min(2, int(cones.n_tangents[k])) for k in blocks]
    rows_of_contacts = [slice(start, start + n) for start, n in zip(starts, counts, strict=True)]
    return tuple(jacobian[rows] @ velocity - surface[rows] for rows in rows_of_contacts)


def _choose_contacts(problem: Problem, contacts: Any) -> list[int]:
    """Return the indices of the chosen contacts."""
    sliding = np.flatnonzero(problem.cones.n_tangents > 0).tolist()
    if not sliding:
        raise InputError("the problem has no contact with tangents; give disk= for pyramids")
    if contacts is None:
        return sliding
    chosen: list[int] = []
    for entry in [contacts] if isinstance(contacts, str) else contacts:
        if isinstance(entry, str):
            fitting = [k for k in sliding if entry in problem.block_name(k)]
            if not fitting:
                known = ", ".join(problem.block_name(k) for k in sliding[:8])
                raise InputError(
                    f"contacts names {entry!r}, which no contact's name contains; they are {known}"
                )
            chosen += fitting
        elif entry in sliding:
            chosen.append(int(entry))
        else:
            known = f"give one of the blocks {sliding[:20]}"
            raise InputError(
                f"contacts names {entry!r}, which is not a contact with tangents; {known}"
            )
    return list(dict.fromkeys(chosen))


def _compute_free_row_velocities(problem: Problem) -> FloatArray:
    """Return J v* (m,) [m/s]."""
    return np.asarray(problem.jacobian @ problem.velocity(np.zeros(problem.m)).ravel())


def find_surface_velocity(problem: Problem) -> FloatArray:
    """Return the target (m,) [m/s] of rows without compliance, 0 on other rows and if the target is rounding."""
    free = _compute_free_row_velocities(problem)
    target = problem.b + free
    # The target is computed as b + J v*.
    target[np.abs(target) <= 8.0 * np.finfo(float).eps * (np.abs(problem.b) + np.abs(free))] = 0.0
    return target if problem.compliance is None else np.where(problem.compliance > 0.0, 0.0, target)


def _replace_soft_friction(problem: Problem, surface: FloatArray) -> tuple[Problem, bool]:
    """Return the problem with hard friction rows at the velocity of the surface (m,), and whether a row changed."""
    rows = problem.cones.friction_rows
    wanted = surface[rows] - _compute_free_row_velocities(problem)[rows]
    soft = np.zeros(problem.m) if problem.compliance is None else np.array(problem.compliance)
    rounding = (
        8.0
        * np.finfo(float).eps
        * (np.abs(problem.b[rows]) + np.abs(wanted) + np.abs(surface[rows]))
    )
    if not soft[rows].any() and not (np.abs(problem.b[rows] - wanted) > rounding).any():
        return problem, False
    b = np.array(problem.b)
    b[rows] = wanted
    soft[rows] = 0.0
    return replace(problem, b=b, compliance=soft), True


def get_geoms(contact: str) -> str:
    """Return the names of both geoms of a contact, without the contact's number."""
    return contact.partition(" (")[2].rstrip(")") or contact


def _add_dominant_cause(slips: pd.DataFrame) -> pd.DataFrame:
    """Add the largest part of each contact's slip and its cause: `part` [m/s] and `cause`, "no slip" below 1e-6 m/s."""
    parts = slips[list(CAUSES.values())]
    slides = slips["speed"] > MIN_EXPLAINED_SLIP
    cause = parts.idxmax(axis=1) if len(slips) else slips["contact"]
    return slips.assign(
        cause=cause.where(slides, "no slip"), part=parts.max(axis=1).where(slides, 0.0)
    )


def average_slip(explanations: Iterable[SlipExplanation]) -> pd.DataFrame:
    """Return the slip of each pair of geoms, averaged over its points in several states."""
    slips = pd.concat([explanation.slips for explanation in explanations])
    groups = slips.drop(columns=["cause", "part"]).groupby(
        slips["contact"].map(get_geoms), sort=False
    )
    means = groups.mean(numeric_only=True).assign(points=groups["points"].sum())
    return _add_dominant_cause(means.reset_index())


def tabulate_slip(slips: pd.DataFrame) -> pd.DataFrame:
    """Return a table of contacts, with speeds in m/s; a contact without slip has no part."""
    heads = {
        "contact": "contact",
        "points": "points",
        "speed": "slip [m/s]",
        "part": "largest part [m/s]",
        "cause": "cause of this part",
    }
    return slips[list(heads)].rename(columns=heads)
