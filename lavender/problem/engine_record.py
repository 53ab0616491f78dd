"""An engine's answer to the problem of its step, the velocity that it predicts, and the objects of the engine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from lavender.base.arrays import FloatArray


class EngineSource(NamedTuple):
    """The objects of the engine from which a problem was made."""

    get_data: Callable[[], Any]  # A weak reference to the data.
    model: Any
    velocity: FloatArray  # (nv,) m/s, rad/s of the data when the problem was made.
    is_stepped: bool  # Whether the data were those after the step.


class EngineRecord:
    """An engine's own answer to a problem, and the velocity after the step that it predicts: `Problem.record`.

    Parameters
    ----------
    answer : lavender.io.engine_motion.EngineMotion, or function without arguments, optional
        The part of the engine's answer that `lavender.residual` judges; None if the impulses themselves are judged. A
        function is called at the first use.
    source : EngineSource, optional
    predict : function of `source`, optional
        Returns the velocity after the step (nv,) [m/s, rad/s] by the answer that the engine's integrator uses, or None
        if the source has changed.
    """

    def __init__(
        self,
        answer: Any = None,
        source: EngineSource | None = None,
        predict: Callable[[EngineSource], FloatArray | None] | None = None,
    ) -> None:
        self._answer, self.source, self._predict = answer, source, predict

    @property
    def answer(self) -> Any:
        """The answer that `lavender.residual` judges, a `lavender.io.engine_motion.EngineMotion`, or None."""
        if callable(self._answer):
            self._answer = self._answer()
        return self._answer

    @property
    def prediction(self) -> FloatArray | None:
        """Velocity after the step (nv,) [m/s, rad/s] that the engine's answer predicts; None if it is not known.

        It is NaN where no prediction is possible, as with Runge-Kutta's method. Copies and files do not have it.
        """
        return None if self._predict is None or self.source is None else self._predict(self.source)

    def __reduce__(self) -> tuple[Any, ...]:
        return EngineRecord, (self.answer,)  # The engine's objects stay in their process.
