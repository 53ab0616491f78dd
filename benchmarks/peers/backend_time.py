"""Measure the time that a backend spends in its own solve during a call of `lv.solve`.

The class or function of the backend's own interface is wrapped while the call runs. For backends that set up and solve
in one function (daqp, quadprog, scs), the time includes the set-up.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from time import perf_counter
from typing import Any

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
    solver: str, clock: Callable[[], float] = perf_counter, setup: bool = False
) -> Iterator[list[float]]:
    """Yield a list that receives the time [s] of each call into the backend; it stays empty for unknown backends.

    With `setup` the time includes the backend's set-up.
    """
    spent: list[float] = []

    def timed(function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function so that the time of each call is appended to `spent`."""

        def call(*args: Any, **kwargs: Any) -> Any:
            begun = clock()
            try:
                return function(*args, **kwargs)
            finally:
                spent.append(clock() - begun)

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
                make, more = (timed(original), SETUP_METHODS) if setup else (original, ())
                return _TimedObject(make(*args, **kwargs), (method, *more), timed)

            stack.callback(setattr, module, name, original)
            setattr(module, name, make_timed if method else timed(original))
        yield spent
