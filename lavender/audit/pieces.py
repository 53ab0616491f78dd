"""Judge steps: the errors and verdicts of a batch of problems with an engine's answers, as a piece of an audit."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from lavender.audit.simulated_worlds import Divergence, Frame
from lavender.base.arrays import FloatArray
from lavender.batch.residuals import residual_many
from lavender.io.mujoco import PREDICTION_TOLERANCE
from lavender.judge.residuals import UNCONVERGED, VERDICTS, WRONG
from lavender.problem import Problem

AUDIT_VERDICTS = (*VERDICTS, "not judged")
NOT_JUDGED = len(VERDICTS)
WORST_ROW_ERRORS = ("velocity", "impulse", "relative", "floor")  # Errors of the worst row [m/s, N s, -, -].
N_WORST_WORLDS = 3  # Number of worlds for which the worst step is written to a file.
# Numbers of contacts differ between steps and are removed from the names of rows.
CONTACT_NUMBER = re.compile(r"^(contact|limit) \d+\b ?")


class Judging(NamedTuple):
    """How steps are judged and which are kept.

    Parameters
    ----------
    precision : {"float64", "float32"}
    threshold : float, m/s
    keep : int or None
        Number of worst steps to keep; None: the worst step of each of `N_WORST_WORLDS` worlds.
    contact_share : float
        Up to this fraction of the steps have contact and their state before the step kept.
    """

    precision: str
    threshold: float
    keep: int | None = None
    contact_share: float = 0.0


class LostDigits(NamedTuple):
    """Steps with forces that have lost digits, because R is far below the diagonal of J M^-1 J^T.

    Parameters
    ----------
    steps : int
    digits : float
        Largest number of digits.
    moved_by_forces : int
        Steps with an acceleration that is exact to `acceleration_error`, which the integrator moves by the forces.
    acceleration_error : float, m/s
        Largest velocity error of the accelerations of these steps.
    """

    steps: int = 0
    digits: float = 0.0
    moved_by_forces: int = 0
    acceleration_error: float = 0.0

    def merge(self, other: LostDigits) -> LostDigits:
        """Return the union of two sets of steps."""
        (a, b, c, d), (e, f, g, h) = self, other
        return LostDigits(a + e, max(b, f), c + g, max(d, h))


class Prediction(NamedTuple):
    """Comparison of velocities after steps with those that the judged answers predict.

    Parameters
    ----------
    steps : int
        Steps that were compared.
    different : int
        Steps with a difference above `PREDICTION_TOLERANCE`.
    largest : float, m/s or rad/s
        Largest difference of these steps.
    first : (world, step), optional
        The first of these steps.
    """

    steps: int = 0
    different: int = 0
    largest: float = 0.0
    first: tuple[int, int] | None = None

    @classmethod
    def of_steps(cls, predicted: FloatArray, after: FloatArray, world: Any, step: Any) -> Prediction:
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
    """The worst step of a world.

    Parameters
    ----------
    velocity : float, m/s
        Largest velocity error of a row.
    world, step : int
    where : str
        Name of the row with this error.
    problem : Problem
    impulse : (m,) N s
        The engine's answer.
    state : dict
        State before the step, by the engine's names.
    """

    velocity: float
    world: int
    step: int
    where: str
    problem: Problem = field(repr=False)
    impulse: FloatArray = field(repr=False)
    state: dict[str, FloatArray] = field(repr=False)


class Piece(NamedTuple):
    """Results of k judged steps.

    Parameters
    ----------
    world, step : (k,) int
        World and number of each step.
    numbers : (len(WORST_ROW_ERRORS), k)
        Errors of the worst row of each step, one row for each name in `WORST_ROW_ERRORS`.
    verdict : (k,) int
        Indices in AUDIT_VERDICTS.
    rows, contacts : (k,) int
    where : list of (int, str)
        Index of a step that stopped before convergence, and the name of its worst row.
    worst : list of Worst
    converged : (k,) bool, optional
        The engine's claims.
    divergences : sequence of Divergence
    engine_warnings : dict
        MuJoCo's own warnings, and how often each occurred.
    contact_states : sequence of StepState
    n_dropped : int
        Number of constraint rows for which the engine had no memory.
    lost_digits : LostDigits
    prediction : Prediction
    against : Piece, optional
        Results of the other model on the same states.
    """

    world: Any
    step: Any
    numbers: FloatArray
    verdict: Any
    rows: Any
    contacts: Any
    where: list[tuple[int, str]]
    worst: list[Worst]
    converged: Any = None
    divergences: Sequence[Divergence] = ()
    engine_warnings: Mapping[str, int] = MappingProxyType({})
    contact_states: Sequence[StepState] = ()
    n_dropped: int = 0
    lost_digits: LostDigits = LostDigits()
    prediction: Prediction = Prediction()
    against: Piece | None = None

    @classmethod
    def of_lost_steps(cls, world: int, step: Any, divergence: Divergence) -> Piece:
        """Make the piece of the steps of a world after it diverged."""
        k = len(step)
        numbers, zeros = np.full((len(WORST_ROW_ERRORS), k), np.nan), np.zeros(k, int)
        verdict = np.full(k, NOT_JUDGED, np.int8)
        worlds = np.full(k, world)
        return cls(worlds, step, numbers, verdict, zeros, zeros, [], [], divergences=[divergence])


def judge_steps(
    frame: Frame, judging: Judging, world: Any, step: Any, state_of: Callable[[int], dict[str, FloatArray]]
) -> Piece:
    """Judge the engine's answers to the problems of a frame, one for each step.

    `world` and `step` are the numbers of the steps, and `state_of(i)` returns the state before step i.
    """
    batch = frame.batch
    residuals = residual_many(
        batch, frame.impulse, precision=judging.precision, threshold=judging.threshold, errors="status"
    )
    errors = residuals.velocity_error, residuals.impulse_error, residuals.relative, residuals.roundoff_floor
    numbers = np.array(errors)
    verdicts = residuals.verdict
    verdict = np.full(len(verdicts), NOT_JUDGED, np.int8)
    measured = np.isfinite(numbers[0])
    for i, word in enumerate(VERDICTS):
        verdict[measured & (verdicts == word)] = i
    numbers[:, verdict == NOT_JUDGED] = np.nan
    rows, contacts = (np.where(verdict == NOT_JUDGED, 0, x) for x in (frame.rows, frame.contacts))
    unconverged = np.flatnonzero(np.isin(verdict, [VERDICTS.index(UNCONVERGED), VERDICTS.index(WRONG)]))
    judged = {int(i): residuals[int(i)] for i in unconverged}
    order = unconverged[np.argsort(-numbers[0, unconverged], kind="stable")]
    if judging.keep is None:
        order = order[np.sort(np.unique(world[order], return_index=True)[1])]
    flat, worst = frame.impulse.reshape(-1), []
    for i in order[: N_WORST_WORLDS if judging.keep is None else judging.keep].tolist():
        impulse, name = flat[batch.rows_of(i)].copy(), judged[i].worst_label
        at = float(numbers[0, i]), int(world[i]), int(step[i])
        worst.append(Worst(*at, name, batch[i], impulse, state_of(i)))
    with_contact = np.flatnonzero(contacts > 0)
    n = min(len(with_contact), int(np.ceil(judging.contact_share * len(world))))
    chosen = with_contact[np.arange(n) * len(with_contact) // max(n, 1)]
    without_digits = residuals.without_digits.values()
    by_forces = [x.acceleration_error for x in without_digits if np.isfinite(x.acceleration_error)]
    digits = max((x.lost_digits for x in without_digits), default=0.0)
    lost = LostDigits(len(without_digits), digits, len(by_forces), max(by_forces, default=0.0))
    return Piece(
        world, step, numbers, verdict=verdict, rows=rows, contacts=contacts, worst=worst,
        where=[(i, CONTACT_NUMBER.sub(r"\1 ", one.worst_label).strip()) for i, one in judged.items()],
        contact_states=[StepState(int(world[i]), int(step[i]), state_of(i)) for i in chosen.tolist()],
        converged=frame.converged, n_dropped=frame.n_dropped,
        lost_digits=lost,
    )  # fmt: skip
