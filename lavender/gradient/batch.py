"""Derivatives of many problems, whose gradients are one compiled call where that can be."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from lavender.base.errors import InputError
from lavender.gradient.derivative import Derivative, derivative
from lavender.gradient.result import Gradient
from lavender.problem import Problem

__all__ = ["Derivatives", "derivatives"]


class Derivatives(Sequence[Derivative]):
    """Derivatives of many problems; `vjp` of all of them is one compiled call where they are of J and M.

    Made by `lavender.derivatives`.
    """

    def __init__(self, of: list[Derivative]) -> None:
        self._of = of

    def __len__(self) -> int:
        return len(self._of)

    def __getitem__(self, i: Any) -> Any:
        return self._of[i]

    def vjp(self, *, velocity: Any = None, impulse: Any = None) -> list[Gradient]:
        """Gradients of each problem; cotangents are sequences, one for each, or arrays with problems first.

        Raises
        ------
        InputError
            Another number of cotangents than of problems; as `Derivative.vjp`.
        CapabilityError
            As `Derivative.vjp`.
        """
        for name, x in (("velocity", velocity), ("impulse", impulse)):
            if x is not None and len(x) != len(self):
                raise InputError(
                    f"{name} has {len(x)} cotangents for {len(self)} problems; one for each is needed"
                )
        nothing = [None] * len(self)
        cotangents = (nothing if x is None else x for x in (velocity, impulse))
        found = []
        for i, (d, y, c) in enumerate(zip(self._of, *cotangents, strict=True)):
            try:
                found.append(d.vjp(velocity=y, impulse=c))
            except InputError as error:
                raise InputError(f"problem {i}: {error}") from None
        return found


def derivatives(problems: Iterable[Problem], solutions: Iterable[Any]) -> Derivatives:
    """`derivative` of each of many problems, as `solve_many` solves them.

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
    given, answers = list(problems), list(solutions)
    if len(given) != len(answers):
        raise InputError(f"{len(answers)} solutions for {len(given)} problems; one for each is needed")
    found = []
    for i, (problem, solution) in enumerate(zip(given, answers, strict=True)):
        try:
            found.append(derivative(problem, solution))
        except InputError as error:
            raise InputError(f"problem {i}: {error}") from None
    return Derivatives(found)
