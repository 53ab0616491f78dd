"""Record the history of a solve by `auto`: the residual after each recorded iteration of each stage.

A stage of sweeps or of another resumable solver is recorded after 1, 2, ..., 16 iterations of the stage, and then each
time after an eighth more. Newton's method and `direct` are recorded at the end of their stage. The compiled call for
small problems is repeated with smaller limits of its estimated cost, since it returns the iterate at the limit.
Recording does not change the result.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Stopwatch
from lavender.judge.residuals import residual
from lavender.judge.solution import Claim
from lavender.solvers.loop import Loop, Record
from lavender.solvers.small import SmallCall

if TYPE_CHECKING:
    from collections.abc import Iterable

MIN_SAMPLED_COST = 100.0  # [ns] Smallest limit of the counted cost in repeated compiled calls.
SAMPLED_COST_RATIO = 1.25  # [-] Ratio of consecutive limits of the counted cost.


@dataclass
class Recorder:
    """Writes the records of one solve by `auto`.

    Parameters
    ----------
    solve : Loop
        The loop of the solve, which holds the records, their solvers and the time of recording.
    watch : Stopwatch
        Time since the beginning of the solve.
    """

    solve: Loop
    watch: Stopwatch = field(default_factory=Stopwatch)

    @property
    def records(self) -> list[Record]:
        """The records so far."""
        return self.solve.records or []

    @property
    def time(self) -> float:
        """Time of the solve without recording [s]."""
        return self.watch.elapsed_seconds - self.solve.recording_time

    def append_later_records(self, solver: str, records: Iterable[Record]) -> None:
        """Append the records with more iterations than the last one."""
        assert self.solve.records is not None
        for record in records:
            if not self.solve.records or record[0] > self.solve.records[-1][0]:
                self.solve.records.append(record)
                self.solve.record_solvers.append(solver)

    def record_impulse(
        self, solver: str, iterations: int, impulse: FloatArray, time: float | None = None
    ) -> None:
        """Record an impulse (m,) [N s] after this number of iterations of all stages."""
        time = self.time if time is None else time
        watch = Stopwatch()
        r = residual(self.solve.problem, impulse, "float64")
        self.append_later_records(solver, [(iterations, time, r.relative, r.energy, r.velocity)])
        self.solve.recording_time += watch.elapsed_seconds

    def append_loop_records(self, solver: str, iterations: int, time: float, loop: Loop) -> None:
        """Append the records of a loop that began at this number of iterations and this time [s]."""
        self.solve.recording_time += loop.recording_time
        self.append_later_records(
            solver, [(iterations + r[0], time + r[1], *r[2:]) for r in loop.records or ()]
        )

    def finish(self, claim: Claim, impulse: FloatArray) -> None:
        """Record the result, an impulse (m,) [N s], unless its number of iterations is recorded already."""
        self.record_impulse(claim.stages[-1].solver if claim.stages else "start", claim.iterations, impulse)

    def record_compiled_call(self, call: SmallCall, start: FloatArray, tol: float, claim: Claim) -> None:
        """Record the compiled call from `start` (m,) [N s], which is repeated with smaller limits of its cost."""
        call_end = self.time  # A repetition that the system interrupts may take longer than the call itself.
        problem, excluded, cost = self.solve.problem, Stopwatch(), MIN_SAMPLED_COST
        before = self.solve.recording_time
        while claim.iterations > self.records[-1][0]:
            watch = Stopwatch()
            result, counts = call.solve_and_judge(problem, start, tol, cost)
            seconds = min(max(watch.elapsed_seconds, self.records[-1][1]), call_end)
            if result is not None:
                part = call.make_claim(problem, counts, start, result.relative)
                if part.iterations <= claim.iterations:
                    name = part.stages[-1].solver if part.stages else call.name
                    self.record_impulse(name, part.iterations, result.impulse, seconds)
                if result.relative <= tol:
                    break
            cost *= SAMPLED_COST_RATIO
        self.solve.recording_time = before + excluded.elapsed_seconds
