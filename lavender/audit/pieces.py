"""Judge steps: the errors and verdicts of a batch of problems with an engine's answers, as a piece of an audit."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from lavender.audit.bodies import find_bodies
from lavender.audit.simulated_worlds import Divergence, Frame, Runs
from lavender.base.arrays import FloatArray
from lavender.base.lazy_import import pandas as pd
from lavender.batch.residuals import residual_many
from lavender.batch.solve import solve_many
from lavender.diagnostics.forces import (
    REFERENCE_TOL,
    ContactForces,
    is_reference,
    measure_forces,
    tabulate_contacts,
)
from lavender.io.contact_friction import find_friction
from lavender.io.mujoco import PREDICTION_TOLERANCE
from lavender.io.mujoco_memory import import_mujoco
from lavender.judge.residuals import UNCONVERGED, VERDICTS, WRONG
from lavender.problem import Problem

AUDIT_VERDICTS = (*VERDICTS, "not judged")
NOT_JUDGED = len(VERDICTS)
WORST_ROW_ERRORS = (
    "velocity",
    "impulse",
    "relative",
    "floor",
)  # Errors of the worst row [m/s, N s, -, -].
# About 3 ms a step, so that an audit of a minute takes about 5 s more: each step needs an exact solve and a rank.
MAX_FORCE_STEPS = 2000
N_WORST_WORLDS = 3  # Number of worlds for which the worst step is written to a file.
# Numbers of contacts differ between steps and are removed from the names of rows.
CONTACT_NUMBER = re.compile(r"^(contact|limit) \d+\b ?")


class Judging(NamedTuple):
    """Options of an audit: they decide how it judges steps and which steps it keeps."""

    precision: str  # {"float64", "float32"}
    threshold: float  # [m/s]
    # Number of worst steps to keep; None: the worst step of each of `N_WORST_WORLDS` worlds.
    keep: int | None = None
    # Up to this fraction of the steps have contact and their state before the step kept.
    contact_share: float = 0.0
    # Up to this fraction of the steps have contact and their contact forces compared with those of a solution.
    force_share: float = 0.0

    def with_forces(self, runs: Runs) -> Judging:
        """Return this judging of runs with contact forces of up to about `MAX_FORCE_STEPS` steps."""
        return self._replace(force_share=min(1.0, MAX_FORCE_STEPS / (runs.worlds * runs.steps)))


class Prediction(NamedTuple):
    """Comparison of velocities after steps with those that the judged answers predict."""

    steps: int = 0  # Steps that were compared.
    different: int = 0  # Steps with a difference above `PREDICTION_TOLERANCE`.
    largest: float = 0.0  # [m/s or rad/s] Largest difference of these steps.
    first: tuple[int, int] | None = None  # (world, step): the first of these steps.

    @classmethod
    def of_steps(
        cls, predicted: FloatArray, after: FloatArray, world: Any, step: Any
    ) -> Prediction:
        """Compare velocities (n, nv) of steps; those with a NaN are not compared."""
        gap = np.abs(predicted - after).max(axis=1, initial=0.0)
        size = np.maximum(np.abs(predicted), np.abs(after)).max(axis=1, initial=0.0)
        different = np.flatnonzero(gap > PREDICTION_TOLERANCE * np.maximum(size, 1.0))
        first = (int(world[different[0]]), int(step[different[0]])) if len(different) else None
        largest = float(gap[different].max(initial=0.0))
        return cls(int(np.isfinite(gap).sum()), len(different), largest, first)

    def merge(self, other: Prediction) -> Prediction:
        """Return the union of two sets of steps."""
        first = min((x.first for x in (self, other) if x.first is not None), default=None)
        n, different = self.steps + other.steps, self.different + other.different
        return Prediction(n, different, max(self.largest, other.largest), first)


class StepState(NamedTuple):
    """The state before a step, a dict by the engine's names."""

    world: int
    step: int
    state: dict[str, FloatArray]


@dataclass(frozen=True)
class Worst:
    """The worst step of a world."""

    velocity: float  # [m/s] Largest velocity error of a row.
    world: int
    step: int
    where: str  # Name of the row with this error.
    problem: Problem = field(repr=False)
    impulse: FloatArray = field(repr=False)  # (m,) N s: the engine's answer.
    state: dict[str, FloatArray] = field(
        repr=False
    )  # State before the step, by the engine's names.


class Piece(NamedTuple):
    """Results of k judged steps."""

    # (k,) int: world and number of each step.
    world: Any
    step: Any
    # (len(WORST_ROW_ERRORS), k): errors of the worst row of each step, one row for each name in `WORST_ROW_ERRORS`.
    numbers: FloatArray
    verdict: Any  # (k,) int: indices in AUDIT_VERDICTS.
    rows: Any  # (k,) int
    contacts: Any  # (k,) int
    # list of (int, str): index of a step that stopped before convergence, and the name of its worst row.
    where: list[tuple[int, str]]
    worst: list[Worst]
    converged: Any = None  # (k,) bool: the engine's claims.
    divergences: Sequence[Divergence] = ()
    # MuJoCo's own warnings, and how often each occurred.
    engine_warnings: Mapping[str, int] = MappingProxyType({})
    contact_states: Sequence[StepState] = ()
    n_dropped: int = 0  # Number of constraint rows for which the engine had no memory.
    # For each step with forces that have lost digits, because R is far below the diagonal of J M^-1 J^T: the number of
    # digits, and the velocity error of the acceleration [m/s] if the integrator moves the step by the forces, else nan.
    lost_digits: Sequence[tuple[float, float]] = ()
    prediction: Prediction = Prediction()
    # Contacts of steps with their forces and errors [N] (`tabulate_forces`); None if the time step is not known.
    forces: pd.DataFrame | None = None
    against: Piece | None = None  # Results of the other model on the same states.

    @classmethod
    def of_lost_steps(cls, world: int, step: Any, divergence: Divergence) -> Piece:
        """Make the piece of the steps of a world after it diverged."""
        k = len(step)
        numbers = np.full((len(WORST_ROW_ERRORS), k), np.nan)
        zeros = np.zeros(k, int)
        verdict = np.full(k, NOT_JUDGED, np.int8)
        worlds = np.full(k, world)
        return cls(worlds, step, numbers, verdict, zeros, zeros, [], [], divergences=[divergence])


def judge_steps(
    frame: Frame,
    judging: Judging,
    world: Any,
    step: Any,
    state_of: Callable[[int], dict[str, FloatArray]],
    model: Any = None,
) -> Piece:
    """Judge the engine's answers to the problems of a frame, one for each step.

    `world` and `step` are the numbers of the steps, and `state_of(i)` returns the state before step i. `model` is the
    mujoco.MjModel with the time step and the names of the bodies, if there is one.
    """
    batch = frame.batch
    options: Any = {"precision": judging.precision, "threshold": judging.threshold}
    r = residual_many(batch, frame.impulse, **options, errors="status")
    verdicts = r.verdict
    numbers = np.array([r.velocity_error, r.impulse_error, r.relative, r.roundoff_floor])
    verdict = np.full(len(verdicts), NOT_JUDGED, np.int8)
    measured = np.isfinite(numbers[0])
    for i, word in enumerate(VERDICTS):
        verdict[measured & (verdicts == word)] = i
    numbers[:, verdict == NOT_JUDGED] = np.nan
    rows, contacts = (np.where(verdict == NOT_JUDGED, 0, x) for x in (frame.rows, frame.contacts))
    unconverged = np.flatnonzero(
        np.isin(verdict, [VERDICTS.index(UNCONVERGED), VERDICTS.index(WRONG)])
    )
    judged = {int(i): r[int(i)] for i in unconverged}
    order = unconverged[np.argsort(-numbers[0, unconverged], kind="stable")]
    if judging.keep is None:
        order = order[np.sort(np.unique(world[order], return_index=True)[1])]
    flat = frame.impulse.reshape(-1)
    worst = []
    for i in order[: N_WORST_WORLDS if judging.keep is None else judging.keep].tolist():
        impulse = flat[batch.rows_of(i)].copy()
        name = judged[i].worst_label
        at = float(numbers[0, i]), int(world[i]), int(step[i])
        worst.append(Worst(*at, name, batch[i], impulse, state_of(i)))
    with_contact = np.flatnonzero(contacts > 0)

    def choose_evenly(share: float) -> list[int]:
        """Choose steps with contact, up to this share of all steps."""
        n = min(len(with_contact), int(np.ceil(share * len(world))))
        chosen: list[int] = with_contact[np.arange(n) * len(with_contact) // max(n, 1)].tolist()
        return chosen

    forces = None
    if model is not None and judging.force_share:
        steps = choose_evenly(judging.force_share)
        forces = tabulate_forces(frame, steps, world, step, model)
    return Piece(
        world,
        step,
        numbers,
        verdict=verdict,
        rows=rows,
        contacts=contacts,
        worst=worst,
        where=[
            (i, CONTACT_NUMBER.sub(r"\1 ", one.worst_label).strip()) for i, one in judged.items()
        ],
        contact_states=[
            StepState(int(world[i]), int(step[i]), state_of(i))
            for i in choose_evenly(judging.contact_share)
        ],
        converged=frame.converged,
        n_dropped=frame.n_dropped,
        forces=forces,
        lost_digits=[(x.lost_digits, x.acceleration_error) for x in r.without_digits.values()],
    )


def tabulate_forces(
    frame: Frame, steps: Sequence[int], world: Any, step: Any, model: Any
) -> pd.DataFrame:
    """Return the contacts of some steps of a frame with their forces, as `ContactForces.by_contact`.

    The first columns are `world` and `step`. Steps without an exact solution are left out.
    """
    problems = frame.batch[list(steps)]
    flat = np.asarray(frame.impulse, float).reshape(-1)
    answers = [flat[frame.batch.rows_of(i)] for i in steps]
    exact = solve_many(problems, impulses=answers, tol=REFERENCE_TOL, errors="status")
    pairs = cache(partial(find_bodies, import_mujoco(), model))
    friction = cache(partial(find_friction, model))
    dt = float(model.opt.timestep)
    found: list[ContactForces] = []
    places: list[tuple[int, int]] = []
    for k, (i, problem, answer) in enumerate(zip(steps, problems, answers, strict=True)):
        solution = exact[k]
        if is_reference(solution.residual):
            forces = measure_forces(
                problem, answer, solution.impulse, dt, pairs, solution.residual, friction
            )
            found.append(forces)
            places += [(int(world[i]), int(step[i]))] * len(forces.contacts)
    table = tabulate_contacts(found)
    table.insert(0, "world", [at for at, _ in places])
    table.insert(1, "step", [at for _, at in places])
    return table
