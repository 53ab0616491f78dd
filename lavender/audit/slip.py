"""Explain why contacts slip: solve an engine's step again in variants, each of which replaces one more property.

    explanation = lavender.explain_slip(problem, impulse)           # a step's problem and the engine's answer
    print(explanation.table); print(explanation.sentence)

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
unfinished iterations, the shape of the cone, compliance, the relaxation. The sliding in the last variant cannot be
prevented by Coulomb friction, because the load along the surface exceeds mu times the normal force. The parts are
norms of vector differences, so the parts of one contact can add up to more than its speed.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array, check_float
from lavender.base.errors import InputError
from lavender.judge.residuals import residual
from lavender.problem import Problem
from lavender.problem.data import check_problem
from lavender.report.table import Table
from lavender.report.text import NONE, format_size
from lavender.solving.solve import solve

#: {variant: cause of its difference from the next variant}, in the order of replacement.
CAUSES = {
    "engine": "unfinished solving",
    "solved": "shape of the cone",
    "disk": "softness of friction",
    "hard": "convex relaxation",
    "coulomb": "load above the friction limit",
}
#: Remedy of each cause, with the names of MuJoCo's settings.
REMEDIES = {
    "unfinished solving": "more iterations or a smaller tolerance of the engine's solver",
    "shape of the cone": 'elliptic friction cones (MuJoCo: cone="elliptic")',
    "softness of friction": "stiffer friction rows (MuJoCo: impratio above 1, or a shorter time constant in solref)",
    "convex relaxation": "an engine with Coulomb's law; shorter time steps reduce this part",
    "load above the friction limit": "a larger friction coefficient or normal force",
}
# [m/s] Slip below this speed is not explained. It is far below the speeds at which objects slip out of a gripper, and
# above the velocity error of solutions to a relative residual of 1e-9.
MIN_EXPLAINED_SLIP = 1e-6
# Settings are compared again after this number of further steps, when creep has become steady.
REMEDY_STEPS = 25
UNDEFINED_LAW = "Coulomb's law is not defined for its round cones"


@dataclass(frozen=True, eq=False)
class SlipVariant:
    """Slip of the chosen contacts in one variant of the step.

    Parameters
    ----------
    name : str
        Key of `CAUSES`.
    velocity : tuple of (tangents,) arrays, m/s
        Tangential velocity of each contact after the step.
    relative : float
        Relative residual of the impulses in this variant's problem; at most 1e-9 for solutions that were found.
    note : str
        Reason why the variant equals the previous one, or why its solution is not accepted; "" otherwise.
    """

    name: str
    velocity: tuple[FloatArray, ...]
    relative: float
    note: str = ""

    @property
    def speeds(self) -> FloatArray:
        """Sliding speed of each contact [m/s]."""
        return np.array([np.linalg.norm(v) for v in self.velocity])


@dataclass(frozen=True)
class Remedy:
    """Slip of the fastest contact with a setting of MuJoCo.

    Parameters
    ----------
    setting : str
        Text for the model's file; the first remedy of an explanation is the model without a change.
    slip : float, m/s
        Mean speed of the contact's points in the explained step, simulated with the setting.
    later : float, m/s
        The same after `REMEDY_STEPS` further steps; nan if the geoms no longer touch.
    """

    setting: str
    slip: float
    later: float


@dataclass(frozen=True, eq=False)
class SlipExplanation:
    """Slip of contacts in each variant of one step; `str()` gives the table and the sentence.

    Parameters
    ----------
    contacts : tuple of str
        Names of the chosen contacts.
    variants : tuple of SlipVariant
        In the order of replacement.
    remedies : tuple of Remedy
        Settings that were simulated, if the model is known and this is its state with the fastest contact.
    """

    contacts: tuple[str, ...]
    variants: tuple[SlipVariant, ...]
    remedies: tuple[Remedy, ...] = ()

    def __str__(self) -> str:
        rows = [self.table.heads, *self.table.rows]
        return "\n".join("  ".join(map(str, row)) for row in rows) + f"\n{self.sentence}"

    @property
    def parts(self) -> dict[str, FloatArray]:
        """Part of each contact's slip (contacts,) [m/s] by its cause."""
        following = [v.velocity for v in self.variants[1:]]
        zero = tuple(np.zeros_like(v) for v in self.variants[-1].velocity)
        return {
            CAUSES[variant.name]: np.array(
                [np.linalg.norm(a - b) for a, b in zip(variant.velocity, after, strict=True)]
            )
            for variant, after in zip(self.variants, [*following, zero], strict=True)
        }

    @property
    def causes(self) -> tuple[str, ...]:
        """Dominant cause of each contact's slip: the largest part; "no slip" below 1e-6 m/s."""
        parts, speeds = self.parts, self.variants[0].speeds
        names = list(parts)
        largest = np.argmax(np.array(list(parts.values())).reshape(len(names), -1), axis=0)
        return tuple(
            names[i] if speed > MIN_EXPLAINED_SLIP else "no slip"
            for i, speed in zip(largest, speeds, strict=True)
        )

    @property
    def table(self) -> Table:
        """Sliding speed of each contact in each variant [m/s], and the dominant cause."""
        heads = ["contact", *(f"{v.name} [m/s]" for v in self.variants), "dominant cause"]
        rows = []
        for i, name in enumerate(self.contacts):
            speeds = [_format_contact_speed(v, i) for v in self.variants]
            rows.append([name, *speeds, self.causes[i]])
        return Table(heads, rows, words=frozenset({"contact", "dominant cause"}))

    @property
    def remedies_table(self) -> Table:
        """Slip of the fastest contact with each setting [m/s], in the explained step and later."""
        heads = ["setting", "slip [m/s]", f"{REMEDY_STEPS} steps later [m/s]"]
        rows = [
            [r.setting, *(NONE if np.isnan(x) else format_size(x) for x in (r.slip, r.later))]
            for r in self.remedies
        ]
        return Table(heads, rows, words=frozenset({"setting"}))

    @property
    def sentence(self) -> str:
        """The contact with the largest slip and its cause in one sentence."""
        if not self.contacts:
            return "No contact was chosen."
        i = int(np.argmax(self.variants[0].speeds))
        speed, cause = self.variants[0].speeds[i], self.causes[i]
        if cause == "no slip":
            return f"No chosen contact slides faster than {MIN_EXPLAINED_SLIP:g} m/s."
        part = self.parts[cause][i]
        notes = "".join(f" ({v.name}: {v.note})" for v in self.variants if v.note)
        return (
            f"{self.contacts[i]} slides fastest, with {format_size(speed)} m/s; the largest part, "
            f"{format_size(part)} m/s, is caused by: {cause}.{notes} Remedy: {REMEDIES[cause]}."
            f"{self._format_best_remedy()}"
        )

    def _format_best_remedy(self) -> str:
        """Return a sentence about the setting with the least slip later, or nothing if none reduces it."""
        kept = [r for r in self.remedies if not np.isnan(r.later)]
        best = min(kept, key=lambda r: r.later, default=None)
        if best is None or best is self.remedies[0]:
            return ""
        return (
            f" Of the settings below, {best.setting} leaves the least slip: {format_size(best.later)} m/s after "
            f"{REMEDY_STEPS} further steps, in place of {format_size(kept[0].later)} m/s."
        )


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
    surface = (
        _find_surface_velocity(measured)
        if surface_velocity is None
        else as_array("surface_velocity", surface_velocity, (measured.m,), unit="m/s")
    )

    def slip(changed: Problem, impulse: FloatArray) -> tuple[FloatArray, ...]:
        return _compute_slip(measured, blocks, changed.velocity(impulse).ravel(), surface)

    variants = [SlipVariant("engine", slip(problem, answer), residual(problem, answer).relative)]

    def solve_and_add_variant(
        name: str, changed: Problem, start: FloatArray | None, note: str = ""
    ) -> FloatArray:
        if note:
            last = variants[-1]
            variants.append(replace(last, name=name, note=note))
            return np.zeros(0) if start is None else start
        solution = solve(changed, impulse=start, tol=tol)
        failed = "" if solution.residual.relative <= max(tol, solution.residual.roundoff_floor) else (
            f"not solved: {solution.status.name}"
        )  # fmt: skip
        velocity = slip(changed, solution.impulse)
        variants.append(SlipVariant(name, velocity, solution.residual.relative, failed))
        return solution.impulse

    start = solve_and_add_variant("solved", problem, answer)
    own_disk = measured if disk is not None else _as_disk(problem)
    is_same_shape = own_disk is problem
    start = solve_and_add_variant(
        "disk",
        own_disk,
        start if own_disk.m == problem.m else None,
        "cones are round" if is_same_shape else "",
    )
    hard, has_soft_friction = _replace_soft_friction(own_disk, surface)
    start = solve_and_add_variant("hard", hard, start, "" if has_soft_friction else "friction rows are hard")
    law_note = "the law is Coulomb's" if hard.friction == "coulomb" else (
        UNDEFINED_LAW if hard.cones.has_round else ""
    )  # fmt: skip
    rigid = hard if law_note else hard.relaxed("coulomb")
    start = solve_and_add_variant("coulomb", rigid, start, law_note)
    names = tuple(measured.block_name(k) for k in blocks)
    return SlipExplanation(names, tuple(variants))


def _compute_slip(
    problem: Problem, blocks: Sequence[int], velocity: FloatArray, surface: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the tangential velocity of each contact minus the surface's (tangents,) [m/s]."""
    jacobian, cones = problem.jacobian.tocsr(), problem.cones
    starts = [int(cones.ptr[k]) + 1 for k in blocks]
    rows_of_contacts = [
        slice(start, start + min(2, int(cones.n_tangents[k])))
        for start, k in zip(starts, blocks, strict=True)
    ]
    return tuple(jacobian[rows] @ velocity - surface[rows] for rows in rows_of_contacts)


def _choose_contacts(problem: Problem, contacts: Any) -> list[int]:
    """Return the indices of the chosen contacts."""
    sliding = np.flatnonzero(problem.cones.n_tangents > 0).tolist()
    if not sliding:
        raise InputError(
            "the problem has no contact with tangents: no contact can slide (give disk= for pyramids)"
        )
    if contacts is None:
        return sliding
    chosen: list[int] = []
    for entry in [contacts] if isinstance(contacts, str) else contacts:
        if isinstance(entry, str):
            fitting = [k for k in sliding if entry in problem.block_name(k)]
            if not fitting:
                known = ", ".join(problem.block_name(k) for k in sliding[:8])
                raise InputError(
                    f"contacts names {entry!r}, but no contact's name contains it; the contacts are {known}"
                )
            chosen += fitting
        elif entry in sliding:
            chosen.append(int(entry))
        else:
            raise InputError(
                f"contacts names {entry!r}, which is not a contact with tangents; give one of the blocks "
                f"{sliding[:20]}"
            )
    return list(dict.fromkeys(chosen))


def _as_disk(problem: Problem) -> Problem:
    """Return the problem with disks in place of boxes, or the same object if it has no boxes."""
    if not problem.cones.has_box:
        return problem
    return replace(problem, cones=problem.cones.shaped("disk"))


def _compute_free_row_velocities(problem: Problem) -> FloatArray:
    """Return J v* (m,) [m/s]."""
    return np.asarray(problem.jacobian @ problem.velocity(np.zeros(problem.m)).ravel())


def _find_surface_velocity(problem: Problem) -> FloatArray:
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
    rounding = 8.0 * np.finfo(float).eps * (np.abs(problem.b[rows]) + np.abs(wanted) + np.abs(surface[rows]))
    if not soft[rows].any() and not (np.abs(problem.b[rows] - wanted) > rounding).any():
        return problem, False
    b = np.array(problem.b)
    b[rows] = wanted
    soft[rows] = 0.0
    return replace(problem, b=b, compliance=soft), True


def _format_contact_speed(variant: SlipVariant, i: int) -> str:
    """Format a contact's speed."""
    if variant.note.startswith("not solved") or variant.note == UNDEFINED_LAW:
        return NONE
    return format_size(float(variant.speeds[i]))


def explain_slip_of_states(
    model: Any, states: Any = None, *, contacts: Sequence[str] | str | None = None, steps: int = 1
) -> list[SlipExplanation]:
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

    Returns
    -------
    list of SlipExplanation
        One for each state that has a contact with friction. The one with the fastest contact has `remedies`: settings
        of MuJoCo, each simulated from this state.

    Raises
    ------
    InputError
        No geom has one of the names.
    """
    from lavender.io import mujoco as adapter
    from lavender.io.recorder import read_states, without_sleep

    mj = adapter.import_mujoco()
    model = without_sleep(mj, model)
    entries = [contacts] if isinstance(contacts, str) else list(contacts or ())
    geoms = [mj.mj_id2name(model, mj.mjtObj.mjOBJ_GEOM, i) or str(i) for i in range(model.ngeom)]
    for entry in entries:
        if model.nflex == 0 and not any(entry in name for name in geoms):
            known = ", ".join(geoms[:8])
            raise InputError(
                f"contacts names {entry!r}, but no geom's name contains it; the geoms are {known}"
            )
    data, before = mj.MjData(model), np.empty(mj.mj_stateSize(model, mj.mjtState.mjSTATE_INTEGRATION))
    vectors = [None] if states is None else list(read_states(mj, model, states).vectors)
    explanations, fastest, start = [], -1, before
    for vector in vectors:
        mj.mj_resetData(model, data)
        if vector is not None:
            mj.mj_setState(model, data, vector, mj.mjtState.mjSTATE_INTEGRATION)
        for _ in range(steps - 1):
            mj.mj_step(model, data)
        mj.mj_forward(model, data)
        mj.mj_getState(model, data, before, mj.mjtState.mjSTATE_INTEGRATION)
        problem, disk, surface = _read_step(mj, model, data)
        measured = problem if disk is None else disk
        names = [measured.block_name(k) for k in np.flatnonzero(measured.cones.n_tangents > 0).tolist()]
        touching = [entry for entry in entries if any(entry in name for name in names)]
        if touching or (names and not entries):
            explanations.append(
                explain_slip(
                    problem,
                    adapter.impulse(model, data),
                    contacts=touching or None,
                    disk=disk,
                    surface_velocity=surface,
                )
            )
            if fastest < 0 or _get_largest_speed(explanations[-1]) > _get_largest_speed(
                explanations[fastest]
            ):
                fastest, start = len(explanations) - 1, before.copy()
    if fastest >= 0 and _get_largest_speed(explanations[fastest]) > MIN_EXPLAINED_SLIP:
        speeds = explanations[fastest].variants[0].speeds
        name = _get_geoms(explanations[fastest].contacts[int(np.argmax(speeds))])
        remedies = tuple(
            Remedy(text, *(_simulate_slip(mj, changed, start, name, n) for n in (0, REMEDY_STEPS)))
            for text, changed in _change_settings(mj, model)
        )
        explanations[fastest] = replace(explanations[fastest], remedies=remedies)
    return explanations


def _get_largest_speed(explanation: SlipExplanation) -> float:
    """Return the sliding speed of the fastest contact [m/s]."""
    return float(explanation.variants[0].speeds.max(initial=0.0))


def _get_geoms(contact: str) -> str:
    """Return the names of both geoms of a contact, without the contact's number."""
    return contact.partition(" (")[2].rstrip(")") or contact


def _read_step(mj: Any, model: Any, data: Any) -> tuple[Problem, Problem | None, FloatArray | None]:
    """Return a step's problem, the one with disks if cones are pyramids, and surface velocities if geoms have them."""
    from lavender.io import mujoco as adapter

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
    if not getattr(model, "flg_surfacevel", False):
        return problem, disk, None
    measured = problem if disk is None else disk  # MuJoCo subtracts the surfaces' velocities from J v.
    return problem, disk, measured.jacobian @ data.qvel - final.efc_vel


def _change_settings(mj: Any, model: Any) -> Iterator[tuple[str, Any]]:
    """Yield the text of each setting that can reduce slip, with the changed model; first the model as it is."""
    yield "as it is", model
    ratio, iterations = 10.0 * model.opt.impratio, 10 * int(model.opt.iterations)
    options: dict[str, dict[str, Any]] = {
        f'iterations="{iterations}" tolerance="1e-12"': {"iterations": iterations, "tolerance": 1e-12},
        f'impratio="{ratio:g}"': {"impratio": ratio},
        'noslip_iterations="20"': {"noslip_iterations": 20},
    }
    if model.opt.cone == mj.mjtCone.mjCONE_PYRAMIDAL:
        cone = {"cone": mj.mjtCone.mjCONE_ELLIPTIC}
        options |= {'cone="elliptic"': cone} | {
            f'cone="elliptic" {text}': cone | values for text, values in list(options.items())[1:]
        }
    for text, values in options.items():
        changed = copy.deepcopy(model)
        for name, value in values.items():
            setattr(changed.opt, name, value)
        yield f"<option {text}/>", changed
    shortest = 2.0 * model.opt.timestep  # MuJoCo uses no shorter time constant.
    if model.geom_solref[:, 0].max(initial=0.0) > shortest:  # Negative values are stiffnesses.
        changed = copy.deepcopy(model)
        for solref in (changed.geom_solref, changed.pair_solref):
            solref[solref[:, 0] > shortest] = shortest, 1.0
        yield f'<geom solref="{shortest:g} 1"/>', changed


def _simulate_slip(mj: Any, model: Any, state: FloatArray, geoms: str, steps: int) -> float:
    """Return the mean sliding speed [m/s] of two geoms in the step after `steps` steps; nan if they do not touch."""
    data = mj.MjData(model)
    mj.mj_setState(model, data, state, mj.mjtState.mjSTATE_INTEGRATION)
    for _ in range(steps):
        mj.mj_step(model, data)
    mj.mj_forward(model, data)
    problem, disk, surface = _read_step(mj, model, data)
    measured = problem if disk is None else disk
    sliding = np.flatnonzero(measured.cones.n_tangents > 0).tolist()
    blocks = [k for k in sliding if _get_geoms(measured.block_name(k)) == geoms]
    surface = _find_surface_velocity(measured) if surface is None else surface
    mj.mj_step(model, data)
    speeds = [np.linalg.norm(v) for v in _compute_slip(measured, blocks, data.qvel, surface)]
    return float(np.mean(speeds)) if speeds else np.nan


@dataclass(frozen=True, eq=False)
class AverageSlip:
    """Slip of one contact, averaged over the points and steps in which it occurred.

    Parameters
    ----------
    contact : str
        Names of both geoms, without the number of the contact.
    count : int
        Number of contact points between these geoms, summed over all steps.
    speeds : (variants,) m/s
    parts : dict
        Cause -> part of the slip [m/s].
    """

    contact: str
    count: int
    speeds: FloatArray
    parts: dict[str, float]

    @property
    def cause(self) -> str:
        """Dominant cause: the largest part; "no slip" below 1e-6 m/s."""
        return (
            max(self.parts, key=lambda c: self.parts[c]) if self.speeds[0] > MIN_EXPLAINED_SLIP else "no slip"
        )


def average_slip(explanations: Iterable[SlipExplanation]) -> list[AverageSlip]:
    """Return the slip of each contact, averaged over its points in several steps."""
    speeds: dict[str, list[list[float]]] = {}
    parts: dict[str, dict[str, float]] = {}
    for explanation in explanations:
        for i, contact in enumerate(explanation.contacts):
            key = _get_geoms(contact)
            speeds.setdefault(key, []).append([float(v.speeds[i]) for v in explanation.variants])
            sums = parts.setdefault(key, dict.fromkeys(CAUSES.values(), 0.0))
            for cause, sizes in explanation.parts.items():
                sums[cause] += float(sizes[i])
    return [
        AverageSlip(
            key, len(values), np.mean(values, axis=0), {c: x / len(values) for c, x in parts[key].items()}
        )
        for key, values in speeds.items()
    ]


def summarize_slip(explanations: Iterable[SlipExplanation]) -> Table:
    """Return the mean sliding speed of each contact [m/s] in each variant over several steps, and its main cause."""
    explanations = list(explanations)
    names = [variant.name for variant in explanations[0].variants] if explanations else []
    undefined = {  # Variants without values in one of the steps.
        k for e in explanations for k, variant in enumerate(e.variants) if variant.note == UNDEFINED_LAW
    }
    rows = []
    for a in average_slip(explanations):
        speeds = [NONE if k in undefined else format_size(x) for k, x in enumerate(a.speeds.tolist())]
        rows.append([a.contact, str(a.count), *speeds, a.cause])
    heads = ["contact", "steps x points", *(f"{name} [m/s]" for name in names), "dominant cause"]
    return Table(heads, rows, words=frozenset({"contact", "dominant cause"}))
