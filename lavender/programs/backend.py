"""Description of a QP backend, and one run of it through qpsolvers or by its own interface."""

from __future__ import annotations

import sys
import threading
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.base.errors import InputError
from lavender.judge.solution import Status
from lavender.programs.convex import ScaledProgram
from lavender.programs.running import FIRST_TOLERANCE, Answer, Call, Limits, classify_status, quiet

# A backend with `prefers_dense` gets dense matrices of up to this many entries, or of MAX_DENSE_FILL times the number
# of their nonzero entries.
MAX_DENSE_ENTRIES = 10**4
MAX_DENSE_FILL = 4
# A backend that replaces the handler of Ctrl-C puts the previous one back. Two of them at the same time would leave the
# handler of one, with which Ctrl-C no longer raises KeyboardInterrupt.
_HANDLER_LOCK = threading.Lock()
# Words in the status of a backend that did not run, because it refused its settings or the program.
REFUSALS = "invalid", "not_run", "unsolved"


@dataclass(frozen=True)
class Backend:
    """Requirements and capabilities of a backend."""

    name: str
    modules: tuple[str, ...]  # Modules that can be imported if the backend is installed.
    install: str  # Packages that pip installs.
    summary: str
    reference: str
    # namespace or None: results of the backend alone on the programs of `backends.json`, found by
    # `findings/probes/backend_probes.py`; None if it was not run.
    behaviour: Any = None
    # Function that calls the backend's own interface. Default: the backend is called through qpsolvers.
    call: Call | None = None
    # Options to pass through qpsolvers: name -> a field of `Limits` (a str), a fixed value, or a list with a value for
    # each of the two calls. None if the backend runs at its own tolerance, or has a function `call`.
    settings: Mapping[str, Any] | None = None
    min_tolerance: float = 0.0  # Smallest tolerance that the backend accepts.
    max_iter: int = 10_000  # Default limit of the iterations of a call.
    # Tolerance of the first call, as a multiple of tol; above 1 if a Newton step is cheaper than the iterations.
    first_tolerance: float = FIRST_TOLERANCE
    # Most iterations of the first call for each variable and row; daqp may cycle for all of `max_iter`.
    row_iterations: float = 1e9
    interior: bool = False  # Whether the backend is an interior-point method.
    dense: bool = False  # Whether the backend accepts dense matrices only.
    prefers_dense: bool = (
        False  # Whether the backend gets dense matrices if they are small or full.
    )
    starts: bool = False  # Whether a start point is passed to the backend.
    stoppable: bool = False  # Whether the backend accepts a time limit.
    # Whether the backend reads its time limit rarely: 20 ms took daqp 2 s on 400 contacts.
    overruns: bool = False
    # Whether the backend rejects infinite bounds, or qpsolvers would pass them as rows with a right-hand side of inf or
    # 1e10. Finite bounds are then passed as rows.
    finite: bool = False
    noisy: bool = False  # Whether the backend prints even if its output is disabled.
    # Whether the backend accepts second-order cones, and so the convex relaxation of friction.
    cones: bool = False
    interrupts: bool = False  # Whether the backend replaces the handler of Ctrl-C while it solves.
    # Whether the backend runs in JAX, which computes in 32 bits unless its option jax_enable_x64 is set.
    jax: bool = False

    @property
    def needs_definite(self) -> bool:
        """Whether the backend needs a positive definite P, as in the velocity form."""
        return self.behaviour is not None and self.behaviour.linear_term is None

    def run(
        self,
        program: ScaledProgram,
        start: tuple[FloatArray, FloatArray] | None,
        limit: Limits,
        settings: dict[str, Any],
    ) -> Answer:
        """Run the backend once, in this process."""
        call = self.call or partial(_call_through_qpsolvers, self)
        with _HANDLER_LOCK if self.interrupts else nullcontext(), quiet(self.noisy):
            return call(program, start, limit, settings)


def _call_through_qpsolvers(
    backend: Backend,
    program: ScaledProgram,
    start: tuple[FloatArray, FloatArray] | None,
    limit: Limits,
    extra: dict[str, Any],
) -> Answer:
    """Call a backend through qpsolvers."""
    import qpsolvers

    limits = {**vars(limit), "eps": max(limit.eps, backend.min_tolerance)}
    options = {
        name: limits[x] if isinstance(x, str) else x[limit.attempt] if isinstance(x, list) else x
        for name, x in (backend.settings or {}).items()
    }
    settings = {
        name: x for name, x in options.items() if x is not None
    }  # Leave out a time limit of None.
    n = program.n
    dense = backend.dense
    if backend.prefers_dense:
        size = n * (n + len(program.t))
        nonzeros = len(program.P[2]) + len(program.J[2])
        dense = size <= max(MAX_DENSE_ENTRIES, MAX_DENSE_FILL * nonzeros)
    x0 = start[0] if start is not None and backend.starts else None
    if start is not None and backend.name == "proxqp":
        from proxsuite import proxqp

        y, z, box = program.split_multipliers(start[1])
        z = np.concatenate([z, box]) if (program.variable >= 0).any() else z
        settings |= {name: part for name, part in (("y", y), ("z", z)) if len(part)}
        settings["initial_guess"] = proxqp.InitialGuess.WARM_START
    settings |= extra
    equations, inequalities, lb, ub = program.split_rows(backend.finite)
    a = b = g = h = None
    if len(equations):
        a = program.select_rows(equations, 1.0, dense)
        b = program.t[equations]
    if len(inequalities):
        g = program.select_rows(inequalities, -1.0, dense)
        h = -program.t[inequalities]
    elif not len(equations) and lb is None:
        # Many backends need a row or a bound, and qpsolvers passes programs without them to LSQR: add 0 x <= 1.
        g = program.select_rows(np.zeros(0, np.int32), 1.0, dense)
        h = np.ones(1)
        g.resize((1, n))
    problem = qpsolvers.Problem(program.get_hessian(dense), program.q, g, h, a, b, lb, ub)
    try:
        solution = qpsolvers.solve_problem(problem, backend.name, initvals=x0, **settings)
    except TypeError as error:
        if not extra:
            raise
        raise InputError(
            f"{backend.name} rejected the settings {', '.join(extra)}: {error}"
        ) from None
    # Collect the status, the iterate and the multipliers.
    extras = solution.extras or {}
    status, text = _get_status(solution, extras)
    if any(
        word in text.lower() for word in REFUSALS
    ):  # The point and the counts were never written.
        return Answer(Status.NUMERICAL_ERROR, text)
    x = None if solution.x is None else np.asarray(solution.x, float).ravel()
    lam = program.join_multipliers(solution.y, solution.z, solution.z_box, backend.finite)
    count = _find_value(
        extras,
        "iter",
        "iterations",
        "num_iterations",
        "nbIter",
        "num_iter",
        "iter_num",
        "nWSR",
        "stats",
    )
    if isinstance(count, list) and count and isinstance(count[0], dict):
        count = len(count)  # qtqp returns the statistics of each iteration.
    # quadprog returns two counts, of added and of dropped constraints.
    count = count[0] if isinstance(count, (tuple, list, np.ndarray)) and len(count) else count
    work = {"iterations": int(count)} if isinstance(count, (int, np.integer)) else {}
    unsolved = "not solved" if x is not None else "not solved, nothing returned"
    message = text or ("solved" if solution.found else unsolved)
    if backend.settings is None:
        message += ", at its own tolerance"
    if backend.jax and not sys.modules["jax"].config.jax_enable_x64:
        message += (
            "; JAX computes in 32 bits: jax.config.update('jax_enable_x64', True) changes that"
        )
    return Answer(status, message, x, lam, work)


def _find_value(extras: dict[str, Any], *names: str) -> Any:
    """Return the first of the named values in the additional data of a backend; None without one."""
    for source in (extras.get("info", extras.get("sip_output", extras)), extras):
        for name in names:
            value = source.get(name) if isinstance(source, dict) else getattr(source, name, None)
            if value is not None:
                return value
    return None


def _get_status(solution: Any, extras: dict[str, Any]) -> tuple[Status, str]:
    """Return the status, and the backend's text for it if qpsolvers returns one."""
    value = _find_value(extras, "status", "exitFlag", "exit_status")
    flag = _find_value(extras, "exitFlag")
    text = "" if value is None else str(getattr(value, "name", value))
    text = f"status {text}" if text.lstrip("-").isdigit() else text
    if solution.found:
        return Status.CONVERGED, text
    if flag is not None:
        ecos = {
            1: Status.INFEASIBLE,
            2: Status.INFEASIBLE,
            10: Status.STALLED,
            -1: Status.MAX_ITERATIONS,
        }
        return ecos.get(int(flag), Status.NUMERICAL_ERROR), text
    status = classify_status(text)
    return Status.NUMERICAL_ERROR if status is Status.CONVERGED else status, text
