"""Judges of points of programs, each with a Newton step: of a quadratic program, and of a contact problem's form."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.deadline import Deadline
from lavender.judge.residuals import judge_impulse
from lavender.judge.solution import Status
from lavender.programs.convex import ConvexProgram
from lavender.programs.forms import Form

# [-] A claim "solved" is false if the error exceeds this multiple of tol, and at least MIN_FALSE_CLAIM: the tests of
# backends use other norms.
FALSE_CLAIM_RATIO, MIN_FALSE_CLAIM = 1e3, 1e-6
MAX_STEPS = 3  # Newton steps with updated active rows; further steps follow only while the error exceeds tol.
STEP_ERROR = 1e-12  # A point of a program with a larger error is improved by a Newton step.
MAX_STEP_SIZE = 20_000  # No Newton step is done with more variables and active rows.
# [s] With less time left, steps of more equations than MAX_SHORT_STEP_SIZE are not done: 300 take 2 ms, 1000 take 50.
LONG_STEP_TIME, MAX_SHORT_STEP_SIZE = 0.05, 300
# With more variables and rows, the Newton step is done only if the error exceeds tol.
MAX_FREE_STEP_SIZE = 500


def is_false_claim(status: Status, error: float, tol: float) -> bool:
    """Return whether a claim "solved" at tol is false."""
    return status is Status.CONVERGED and error > max(FALSE_CLAIM_RATIO * tol, MIN_FALSE_CLAIM)


class ProgramJudge:
    """Judges points of a quadratic program, improves them by a Newton step, and keeps the best.

    Attributes
    ----------
    x, lam : (n,), (m,)
        The best point, with complementary multipliers; None without a point.
    error, strict_error, hidden_error : float
        Its errors by `judge_program`; the strict one compares rows and columns with their right-hand
        side and q alone, the hidden one is that of rows with a right-hand side that is rounding or 0.
    """

    def __init__(self, program: ConvexProgram, tol: float, deadline: Deadline) -> None:
        self.program, self.tol, self.deadline = program, tol, deadline
        self.error = self.strict_error = self.hidden_error = np.inf
        self.x: FloatArray | None = None
        self.lam: FloatArray | None = None
        self.has_step = False

    def accepts(self, x: FloatArray, lam: FloatArray, is_last: bool = True) -> bool:
        """Judge a point and its Newton steps; return whether the best point meets tol.

        Steps of degenerate vertices are done only if `is_last`: they seldom succeed where a second call would not.
        """
        _, active, complementary = self.keep(x, lam)
        size = len(x) + len(lam)
        if self.strict_error > (
            STEP_ERROR if size <= MAX_FREE_STEP_SIZE else max(self.tol, STEP_ERROR)
        ):
            first = self._polish(x, lam, self.program.compare_multipliers_with_slacks(x, lam))
            near = None
            if not is_last:
                return self.error <= self.tol
            if (
                self.error > self.tol
            ):  # Rows of almost no slack may be active with a multiplier of 0.
                near = self._take_step(x, lam, self.program.find_near_rows(x))
            if near is not None:
                for multipliers in (near[1], complementary, lam if first is None else first[1]):
                    self.keep(near[0], multipliers, True)
                if self.error > self.tol and not self.deadline.has_passed():
                    fitted = self.program.fit_multipliers(
                        near[0], self.program.find_near_rows(near[0])
                    )
                    if fitted is not None:
                        self.keep(near[0], fitted, True)
            if self.error > self.tol:
                self._polish(x, complementary, active)
        return self.error <= self.tol

    def _take_step(
        self, x: FloatArray, lam: FloatArray, active: Any
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the Newton step of a point; None if it is not possible, or too long before the deadline."""
        left = self.deadline.get_remaining_seconds() if self.deadline.is_set else LONG_STEP_TIME
        max_size = (
            MAX_STEP_SIZE if left >= LONG_STEP_TIME else MAX_SHORT_STEP_SIZE if left > 0.0 else 0
        )
        return self.program.polish(x, lam, active, max_size) if max_size else None

    def _polish(
        self, x: FloatArray, lam: FloatArray, active: Any
    ) -> tuple[FloatArray, FloatArray] | None:
        """Judge the Newton steps from a point with these active rows (m,); return the first one."""
        first = None
        for _ in range(MAX_STEPS):
            point = self._take_step(x, lam, active)
            if point is None:
                break
            first = first or point
            error, _, lam = self.keep(*point, True)
            # Steps from a point without a right digit lead nowhere.
            if self.error <= self.tol or not error <= 1.0:
                break
            x = point[0]
            active = self.program.update_active_rows(*point, active, self.tol)
        return first

    def keep(
        self, x: FloatArray, lam: FloatArray, has_step: bool = False
    ) -> tuple[float, Any, FloatArray]:
        """Judge a point, clipped to the bounds of the variables, and store it if it is the best."""
        x = self.program.clip_to_bounds(x)
        error, strict_error, _, _, active, complementary, hidden = self.program.judge(x, lam)
        if error > self.tol and np.isfinite(x).all():
            for near in self.program.list_rounded_points(x):
                judged = self.program.judge(near, lam)
                if judged[0] < error:
                    x = near
                    error, strict_error, _, _, active, complementary, hidden = judged
        if error < self.error or self.x is None:
            self.x, self.lam, self.has_step = x, complementary, has_step
            self.error, self.strict_error, self.hidden_error = error, strict_error, hidden
        return error, active, complementary


class ContactJudge:
    """Judges points of a form of a constraint problem by the residual of its impulses, and keeps the best impulses.

    Parameters
    ----------
    form : Form
    impulse : (m,), N s
        Receives the best impulses.
    tol : float, -

    Attributes
    ----------
    relative, above : float, -
        Relative residual of the best impulses, and its part above rounding; inf without a point.
    """

    def __init__(self, form: Form, impulse: FloatArray, tol: float) -> None:
        self.form, self.impulse, self.tol = form, impulse, tol
        self.relative = self.above = np.inf
        self.dual: FloatArray | None = None

    def accepts(self, x: FloatArray, lam: FloatArray, is_last: bool = True) -> bool:
        """Judge a point, and its Newton step if the point does not meet tol; return whether the best point does."""
        self._keep(x, lam)
        program = self.form.program
        if self.above > self.tol and not program.cones:
            active, complementary = program.judge(x, lam)[4:6]
            point = program.polish(x, complementary, active, MAX_STEP_SIZE)
            if point is not None:
                self._keep(*point)
        return self.above <= self.tol

    def _keep(self, x: FloatArray, lam: FloatArray) -> None:
        impulse = self.form.recover_impulse(x, lam)
        if not np.isfinite(impulse).all():
            return
        judged = judge_impulse(self.form.problem, impulse)
        if judged.relative < self.relative or self.dual is None:
            self.relative = judged.relative
            self.above = judged.above_floor
            self.impulse[:] = impulse
            self.dual = self.form.recover_bound_multiplier(x, lam, impulse)
