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
WORST_ROW_ERRORS = (
    "velocity",
    "impulse",
    "relative",
    "floor",
)  # Errors of the worst row [m/s, N s, -, -].
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
) -> Piece:
    """Judge the engine's answers to the problems of a frame, one for each step.

    `world` and `step` are the numbers of the steps, and `state_of(i)` returns the state before step i.
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
    n = min(len(with_contact), int(np.ceil(judging.contact_share * len(world))))
    chosen = with_contact[np.arange(n) * len(with_contact) // max(n, 1)]
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
            StepState(int(world[i]), int(step[i]), state_of(i)) for i in chosen.tolist()
        ],
        converged=frame.converged,
        n_dropped=frame.n_dropped,
        lost_digits=[(x.lost_digits, x.acceleration_error) for x in r.without_digits.values()],
    )
