"""Measure the CPU time that a backend spends in its own set-up and solve during a call of `lv.solve`.

The class or function of the backend's own interface is wrapped while the call runs.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

from benchmarks.pairs import run_timed

SETUP_METHODS = ("setup", "init")  # Methods of the backends' classes that receive the data.

#: Functions of each backend that are timed, as "module:class.method" or "module:function". These are the names by
#: which lavender.programs and qpsolvers call them.
BACKEND_ENTRY_POINTS = {
    "clarabel": ("clarabel:DefaultSolver.solve",),
    "clarabel_cone": ("clarabel:DefaultSolver.solve",),
    "daqp": ("daqp:solve",),
    "highs": ("highspy:Highs.run",),
    "osqp": ("osqp:OSQP.solve",),
    "piqp": ("piqp:DenseSolver.solve", "piqp:SparseSolver.solve"),
    "proxqp": (
        "proxsuite.proxqp.dense:QP.solve",
        "proxsuite.proxqp.dense:solve",
        "proxsuite.proxqp.sparse:QP.solve",
        "proxsuite.proxqp.sparse:solve",
    ),
    "qpalm": ("qpalm:Solver.solve",),
    "quadprog": ("qpsolvers.solvers.quadprog_:solve_qp",),
    "scs": ("qpsolvers.solvers.scs_:solve",),
}


class _TimedObject:
    """A backend's object with some methods timed."""

    def __init__(self, inner: Any, methods: Sequence[str], timed: Callable[..., Any]) -> None:
        object.__setattr__(self, "_inner", inner)
        for method in methods:
            if hasattr(inner, method):
                object.__setattr__(self, method, timed(getattr(inner, method)))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._inner, name, value)


@contextmanager
def measure_backend_time(
    solver: str,
) -> Iterator[list[float]]:
    """Yield a list that receives the CPU time [s] of each set-up and solve of a backend."""
    spent: list[float] = []

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function so that the time of each call is appended to `spent`."""

        def call(*args: Any, **kwargs: Any) -> Any:
            result, seconds = run_timed(lambda: function(*args, **kwargs))
            spent.append(seconds)
            return result

        return call

    with ExitStack() as stack:
        for entry_point in BACKEND_ENTRY_POINTS.get(solver, ()):
            path, _, name = entry_point.partition(":")
            name, _, method = name.partition(".")
            module = pkgutil.resolve_name(path)
            original = getattr(module, name)

            def make_timed(
                *args: Any, original: Any = original, method: str = method, **kwargs: Any
            ) -> Any:
                made = timed(original)(*args, **kwargs)
                return _TimedObject(made, (method, *SETUP_METHODS), timed)

            stack.callback(setattr, module, name, original)
            setattr(module, name, make_timed if method else timed(original))
        yield spent
