"""Derivatives of many problems: one compiled call prepares them, and each `vjp` of all problems is one further call."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lavender.base.arrays import FloatArray, check_sequence, resolve_index
from lavender.base.errors import InputError
from lavender.batch.data import Batch
from lavender.batch.solve import Solutions
from lavender.gradient.derivative import MAX_ACCEPTED_RESIDUAL, Derivative, derivative
from lavender.gradient.result import INPUTS, MATRICES, Gradient, GradientArrays
from lavender.gradient.system import MAX_KERNEL_ROWS
from lavender.gradient.worlds import WorldDerivatives
from lavender.judge.residuals import get_zero_impulse_reference
from lavender.problem import Problem
from lavender.problem.derived import cached_property
from lavender_ext.derivative.linear import Linears


class _PerProblem(Sequence[Any]):
    """Sequence with one object for each problem; `_items`, a list, is made when one of them is first read."""

    _items: list[Any]
    _n: int

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, i: Any) -> Any:
        """Return the object of problem i, or a list of objects for a slice, a mask or a list of integers."""
        i = resolve_index(i, self._n)
        return [self._items[j] for j in i] if isinstance(i, list) else self._items[i]

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self._n} problems>"


class Gradients(_PerProblem, GradientArrays):
    """Gradients of many problems, computed by `Derivatives.vjp`: `[i]` is the `Gradient` of problem i.

    Attributes such as `b`, `mu` and `v_free` hold the concatenated gradients of all problems. Gradients by matrices
    (A, J, M) have no such attribute.
    """

    def __init__(self, of: Derivatives, numbers: FloatArray, separate: dict[int, Gradient]) -> None:
        self._n = len(of)
        self._of = of
        self._numbers = numbers
        self._separate = separate

    @cached_property
    def _items(self) -> list[Gradient]:
        parts = map(self._of._linears.result_slice, range(self._n))
        made = (
            Gradient(d, self._numbers[part]) for d, part in zip(self._of._items, parts, strict=True)
        )
        return [self._separate.get(i, gradient) for i, gradient in enumerate(made)]

    if (
        not TYPE_CHECKING
    ):  # Hide `__getattr__` from type checkers, so that they report unknown names.

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_") or name not in INPUTS or name in MATRICES:
                raise AttributeError(
                    f"gradients of all problems have no {name!r}; gradients[i] may have it"
                )
            if not self._separate and name in ("b", "target", "v_free"):
                return self._numbers[self._of._linears.result_indices(name == "v_free")]
            return np.concatenate([getattr(g, name) for g in self] or [np.zeros(0)])


class Derivatives(_PerProblem):
    """Derivatives of many problems, prepared by `lavender.derivatives`: `[i]` is the `Derivative` of problem i."""

    def __init__(
        self, problems: list[Problem], linears: Linears, separate: dict[int, Derivative]
    ) -> None:
        self._n = len(problems)
        self._problems = problems
        self._linears = linears
        self._separate = separate

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle problems and impulses only; the copy prepares the derivatives again."""
        return derivatives, (self._problems, [each._impulse for each in self])

    @cached_property
    def _items(self) -> list[Derivative]:
        get, item = self._separate.get, self._linears.item
        return [get(i) or Derivative(problem, item(i)) for i, problem in enumerate(self._problems)]

    def vjp(self, *, velocity: Any = None, impulse: Any = None, slack: Any = None) -> Gradients:
        """Compute the gradients of each problem.

        Parameters
        ----------
        velocity, impulse, slack : sequence or array, optional
            Cotangents as for `Derivative.vjp`, one for each problem; the first axis of an array is the problem.

        Raises
        ------
        InputError
            The number of cotangents differs from the number of problems, or `Derivative.vjp` raises it.
        CapabilityError
            `Derivative.vjp` raises it.
        """
        n = len(self)
        arguments = {"velocity": velocity, "impulse": impulse, "slack": slack}
        cotangents = {
            name: [None] * n
            if x is None
            else check_sequence(name, x, "cotangents, one for each problem,")
            for name, x in arguments.items()
        }
        for name, x in cotangents.items():
            if len(x) != n:
                raise InputError(
                    f"{name} has {len(x)} cotangents for {n} problems; one for each is needed"
                )
        numbers, remaining = self._linears.adjoint(*cotangents.values())
        separate = {}
        for i in [*self._separate, *remaining]:
            try:
                separate[i] = self._items[i].vjp(**{name: x[i] for name, x in cotangents.items()})
            except InputError as error:
                raise InputError(f"problem {i}: {error}") from None
        return Gradients(self, numbers, separate)


def derivatives(
    problems: Batch | Iterable[Problem], solutions: Any
) -> Derivatives | WorldDerivatives:
    """Prepare the derivative of each of many problems; problems with J and M are prepared by one compiled call.

    Parameters
    ----------
    problems : Batch, or iterable of Problem
    solutions : iterable of Solution, or (m,) N s
        One for each problem, for example from `solve_many`. For a batch also an array of its shape.

    Returns
    -------
    Derivatives, or WorldDerivatives of a batch
        A sequence; its `vjp` takes cotangents of all problems, for a batch as arrays of its shapes.

    Raises
    ------
    InputError
        The number of solutions differs from the number of problems, or `derivative` raises it; the message then has
        the problem's index.
    """
    if isinstance(problems, Problem):
        raise InputError(
            "problems is one Problem; a list of problems is needed, or `lavender.derivative`"
        )
    if type(problems) is Batch and not problems.cones.has_ellipse:
        return WorldDerivatives(problems, problems.flatten_impulses("solutions", solutions))
    problems = check_sequence("problems", problems, "Problems")
    is_batch = isinstance(solutions, Solutions) and not solutions.faults
    impulses: Any = solutions
    if not is_batch:
        impulses = [
            getattr(x, "impulse", x) for x in check_sequence("solutions", solutions, "Solutions")
        ]
    if len(problems) != len(impulses):
        raise InputError(
            f"{len(impulses)} solutions for {len(problems)} problems; one for each is needed"
        )
    flat = impulses.flat_impulses if is_batch else impulses
    linears = Linears([_get_data(p) for p in problems], flat, MAX_KERNEL_ROWS)
    separate = {}
    for i in linears.skip_unsolvable(MAX_ACCEPTED_RESIDUAL):
        try:
            separate[i] = derivative(problems[i], impulses[i])
        except InputError as error:
            raise InputError(f"problem {i}: {error}") from None
    return Derivatives(problems, linears, separate)


def _get_data(problem: Problem) -> Any:
    """Return the judge's data of a problem with J and M, or None if `derivative` must prepare it separately."""
    general = problem.generalized if type(problem) is Problem else None
    if general is None or general.order is not None or problem.cones.has_ellipse:
        return None
    view = problem.derived.view
    assert view is not None
    if view.reference_energy < 0.0:
        get_zero_impulse_reference(problem)
    return view
