"""Derivatives of many problems: prepared by one compiled call, and each `vjp` of all of them is another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, IntArray, places, several
from lavender.base.errors import InputError
from lavender.batch.solve import Solutions
from lavender.gradient.derivative import ACCEPTED, Derivative, derivative
from lavender.gradient.result import INPUTS, MATRICES, Gradient
from lavender.gradient.system import SMALL
from lavender.judge.residuals import reference
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender_ext.derivative.linear import Linears


class _Each(Sequence[Any]):
    """One thing of each of many problems, made when it is first asked for."""

    def __init__(self, n: int, kept: dict[int, Any]) -> None:
        self._n, self._kept = n, kept

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, i: Any) -> Any:
        """Of problem i, or a list of several."""
        i = places(i, self._n)
        return [self._one(j) for j in i] if isinstance(i, list) else self._one(i)

    def __iter__(self) -> Iterator[Any]:
        return map(self._one, range(self._n))

    def _one(self, i: int) -> Any:
        if i not in self._kept:
            self._kept[i] = self._make(i)
        return self._kept[i]

    def _make(self, i: int) -> Any:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._n} problems>"


class Gradients(_Each):
    """Gradients of many problems: `[i]` is the `Gradient` of problem i. Made by `Derivatives.vjp`.

    `b`, `mu`, `v_free` and what else is no matrix are those of all problems, one after the other in one array.
    """

    def __init__(self, of: Derivatives, numbers: FloatArray, alone: dict[int, Gradient]) -> None:
        super().__init__(len(of), alone)
        self._of, self._numbers, self._whole = of, numbers, not alone

    def _make(self, i: int) -> Gradient:
        return Gradient(self._of._one(i), self._numbers[self._of._linears.place(i)])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name not in INPUTS or name in MATRICES:
            raise AttributeError(
                f"gradients have no {name!r} of all problems; [i] is the gradient of problem i"
            )
        if self._whole and name in ("b", "target", "v_free"):
            of = self._of
            return self._numbers[of._velocities if name == "v_free" else of._rows]
        return np.concatenate([getattr(g, name) for g in self] or [np.zeros(0)])


class Derivatives(_Each):
    """Derivatives of many problems: `[i]` is the `Derivative` of problem i. Made by `lavender.derivatives`."""

    def __init__(self, problems: list[Problem], linears: Linears, alone: dict[int, Derivative]) -> None:
        super().__init__(len(problems), dict(alone))
        self._problems, self._linears, self._alone = problems, linears, alone

    def __reduce__(self) -> tuple[Any, ...]:
        """Copied or pickled they are prepared anew."""
        return derivatives, (self._problems, [one._impulse for one in self])

    def _make(self, i: int) -> Derivative:
        return Derivative(self._problems[i], self._linears.one(i))

    @cached_property
    def _rows(self) -> IntArray:
        return self._linears.places(False)

    @cached_property
    def _velocities(self) -> IntArray:
        return self._linears.places(True)

    def vjp(self, *, velocity: Any = None, impulse: Any = None, slack: Any = None) -> Gradients:
        """Gradients of each problem; cotangents are sequences, one for each, or arrays with problems first.

        Raises
        ------
        InputError
            Another number of cotangents than of problems; as `Derivative.vjp`.
        CapabilityError
            As `Derivative.vjp`.
        """
        n, given = len(self), {"velocity": velocity, "impulse": impulse, "slack": slack}
        each = [
            [None] * n if x is None else several(name, x, "cotangents, one for each problem,")
            for name, x in given.items()
        ]
        for name, x in zip(given, each, strict=True):
            if len(x) != n:
                raise InputError(f"{name} has {len(x)} cotangents for {n} problems; one for each is needed")
        numbers, left = self._linears.adjoint(*each)
        alone = {}
        for i in [*self._alone, *left]:
            try:
                alone[i] = self._one(i).vjp(**{name: x[i] for name, x in zip(given, each, strict=True)})
            except InputError as error:
                raise InputError(f"problem {i}: {error}") from None
        return Gradients(self, numbers, alone)


def derivatives(problems: Iterable[Problem], solutions: Iterable[Any]) -> Derivatives:
    """`derivative` of each of many problems, as `solve_many` solves them; of J and M by one compiled call.

    Parameters
    ----------
    problems : iterable of Problem
    solutions : iterable of Solution, or (m,) N s
        One for each.

    Returns
    -------
    Derivatives
        A sequence; its `vjp` takes cotangents of all.

    Raises
    ------
    InputError
        Another number of solutions than of problems, or as `derivative`, which names the problem.
    """
    if isinstance(problems, Problem):
        raise InputError("problems is one Problem; a list of them is needed, or `derivative`")
    given = several("problems", problems, "Problems")
    many = isinstance(solutions, Solutions) and not solutions.faults
    answers: Any = (
        solutions
        if many
        else [getattr(x, "impulse", x) for x in several("solutions", solutions, "Solutions")]
    )
    if len(given) != len(answers):
        raise InputError(f"{len(answers)} solutions for {len(given)} problems; one for each is needed")
    linears = Linears([_data(p) for p in given], answers.placed if many else answers, SMALL)
    alone = {}
    for i in linears.leave(ACCEPTED):
        try:
            alone[i] = derivative(given[i], answers[i])
        except InputError as error:
            raise InputError(f"problem {i}: {error}") from None
    return Derivatives(given, linears, alone)


def _data(problem: Problem) -> Any:
    """What the judge reads of J and M; None of what `derivative` prepares alone."""
    general = problem.generalized if type(problem) is Problem else None
    if general is None or general.order is not None or problem.cones.has_ellipse:
        return None
    view = problem.derived.view
    assert view is not None
    if view.reference_energy < 0.0:
        reference(problem)
    return view
