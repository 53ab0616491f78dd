"""Derivatives of many problems, whose gradients are one compiled call where that can be."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray, as_array
from lavender.base.errors import InputError
from lavender.gradient.derivative import Derivative, derivative
from lavender.gradient.result import Gradient
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender_ext.derivative.linear import adjoint_all

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

    @cached_property
    def _together(self) -> tuple[Any, ...] | None:
        """The kernel's objects, and where velocities, rows and results of each stand end to end; None: not all can."""
        if not all(d._plain for d in self._of):
            return None
        sizes = [(d.problem.generalized.nv, d.problem.m) for d in self._of]  # type: ignore[union-attr]
        nv, m = np.array(sizes, np.int64).reshape(-1, 2).T
        ends = (np.concatenate([[0], np.cumsum(x)]) for x in (nv, m, 2 * (nv + m)))
        return ([d._linear for d in self._of], *ends)

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
        if velocity is None and impulse is None:
            raise InputError("give velocity= or impulse=: what the scalar weighs of the solutions")
        together = self._together
        if together is None or not self._of:
            nothing = [None] * len(self)
            pairs = zip(
                self._of,
                nothing if velocity is None else velocity,
                nothing if impulse is None else impulse,
                strict=True,
            )
            return [d.vjp(velocity=y, impulse=c) for d, y, c in pairs]
        linears, of_nv, of_m, ends = together
        y = None if velocity is None else _end_to_end("velocity", velocity, of_nv)
        c = np.zeros(of_m[-1]) if impulse is None else _end_to_end("impulse", impulse, of_m)
        given, out = (None if impulse is None else c.copy()), np.empty(ends[-1])
        adjoint_all(linears, of_nv, np.empty(0) if y is None else y, of_m, c, ends, out)
        found = []
        rows, columns, starts = of_m.tolist(), of_nv.tolist(), ends.tolist()
        for i, d in enumerate(self._of):
            m, n, at = rows[i + 1] - rows[i], columns[i + 1] - columns[i], starts[i]
            s = at + m
            f = s + m
            found.append(
                Gradient(
                    d,
                    out[at:s],
                    out[s:f],
                    None if y is None else y[columns[i] : columns[i + 1]],
                    None if given is None else given[rows[i] : rows[i + 1]],
                    (out[f : f + n], out[f + n : f + 2 * n]),
                )
            )
        return found


def _end_to_end(name: str, given: Any, at: Any) -> FloatArray:
    """Cotangents of many problems as one array, checked."""
    sizes = np.diff(at)
    if isinstance(given, np.ndarray) and given.ndim == 2 and (sizes == given.shape[1]).all():
        return as_array(name, given.reshape(-1), (None,)).copy()
    parts = [
        as_array(f"{name}[{i}]", x, (int(n),)) for i, (x, n) in enumerate(zip(given, sizes, strict=True))
    ]
    return np.concatenate(parts) if parts else np.zeros(0)


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
