"""`solve`: check the arguments, try the compiled call for small problems, else prepare a solver and run it.

The last line replaces `solve` by a compiled function of `lavender_ext/batch/many.pyx`, which tries the compiled call
for plain arguments itself, and calls the function below for all others.
"""

from __future__ import annotations

from functools import update_wrapper
from typing import TYPE_CHECKING, Any, NoReturn, cast

import numpy as np

from lavender.base.arrays import ArrayLike
from lavender.base.errors import InputError
from lavender.judge.solution import Solution
from lavender.problem import Problem, check_problem
from lavender.solvers.registry import SolverSpec, get, registered
from lavender.solving.compiled_call import solve_small
from lavender.solving.limits import import_before_limit, start_limit
from lavender.solving.loop import Callback
from lavender.solving.prepared import Prepared, check_arguments
from lavender.solving.velocity import accept_velocity, relative_tolerance
from lavender_ext.batch.many import make_solve

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from lavender.solvers.registry import SolverOptions


def solve(
    problem: Problem,
    solver: str = "auto",
    *surplus: NoReturn,
    impulse: ArrayLike | None = None,
    tol: float = 1e-6,
    velocity_tol: float | None = None,
    max_iter: int | None = None,
    time_limit: float | None = None,
    history: bool = False,
    callback: Callback | None = None,
    **options: Unpack[SolverOptions],
) -> Solution:
    """Solve a constraint problem with the named solver; the default `auto` chooses and combines solvers.

    Parameters
    ----------
    problem : Problem
    solver : str
        A registered name; `available(problem)` lists the installed solvers that accept the problem.
    impulse : (m,) N s, Solution, or (Problem, impulse); optional
        Warm start; the solution of an earlier step is assigned to the blocks by their keys (`Problem.make_start`).
        Default: `problem.guess`, otherwise zero clipped to the bounds.
    tol : float, default 1e-6
        Relative residual to reach: 0 for an exact solution, 1 for zero impulses (see `judge.residuals`). `tol=0` runs
        exactly `max_iter` iterations; `auto` and solvers that factor end earlier if nothing can be gained.
    velocity_tol : float, optional, m/s (rad/s on angular rows)
        Velocity error to reach on every row, given in place of `tol`, whatever the relative residual. Solvers run to
        the relative residual that guarantees it (`lavender.solving.velocity`), and `success` refers to it.
    max_iter : int, optional
        Largest number of iterations, in the solver's own unit (sweeps, steps, pivots). Default: the limit of the
        solver's spec.
    time_limit : float, optional, s
        Wall-clock limit of set-up and iterations; one pass of the judge may follow (`docs/choose.md`). Imports do not
        count. Solvers of other packages get the limit as their own; those without one run in a separate process, which
        is reused by later solves and killed at the limit. `isolate` of these solvers selects the process.
    history : bool
        Record iterations, time and residual at fixed numbers of iterations, in a `History`; with `auto`, of all stages.
    callback : callable (iterations, impulse, residual), optional
        Called whenever history would be recorded; the solve stops if it returns a true value.
    **options
        `order`, `ground`, `seed` and the solver's own options, as listed by its spec.

    Returns
    -------
    Solution
        It is also returned if the solver did not converge; it then holds the best iterate. See `Solution.status` and
        `Solution.success`.

    Raises
    ------
    UnknownName
        The solver or option does not exist.
    SolverUnavailable
        The solver's package is not installed.
    CapabilityError
        The solver does not accept this problem or option; the message has the reason.
    InputError
        `impulse`, `tol`, `velocity_tol`, `max_iter` or `time_limit` is not valid; `velocity_tol` and another `tol`.
    """
    if (
        type(problem) is not Problem
    ):  # Check this first, because a frequent error is to pass A and b.
        check_problem(problem)
    if surplus:
        raise InputError(
            f"solve has {2 + len(surplus)} positional arguments; a problem and the name of a solver are needed, "
            "all others by name: lavender.solve(problem, solver, tol=..., impulse=...)"
        )
    spec = get(solver) if isinstance(solver, str) else _reject_solver(solver)
    deadline = start_limit(time_limit)  # After the import of a plug-in.
    if velocity_tol is not None:
        tol = relative_tolerance(problem, velocity_tol, tol)
    solution: Solution | None = None
    failed_call: tuple[int, ...] | None = None
    if max_iter is None and callback is None and history is False and not options:
        solution, failed_call = solve_small(problem, spec, impulse, tol, deadline)
    if solution is None:
        import_before_limit(spec, deadline)
        prepared = Prepared(problem, spec, cast("dict[str, Any]", options), False)
        tol, max_iter = check_arguments(spec, tol, max_iter, history, callback)
        solution = prepared._solve(
            problem, impulse, tol, max_iter, deadline, history, callback, failed_call
        )
    return solution if velocity_tol is None else accept_velocity(solution, velocity_tol)


def _solve_after_call(
    problem: Problem, spec: SolverSpec, impulse: Any, tol: float, counts: Any
) -> Solution:
    """Solve a problem that the compiled call with these work counts did not solve."""
    if spec.requires:
        get(spec.name)  # Raises SolverUnavailable if a package of a registered solver is missing.
    prepared = Prepared(problem, spec, {}, False)
    return prepared._solve(problem, impulse, *check_arguments(spec, tol, None), failed_call=counts)


def _reject_solver(solver: Any) -> NoReturn:
    """Raise the error for a second argument that is not a name, with the keyword for which it is a value."""
    value = f"a {type(solver).__name__}"
    if isinstance(solver, Solution):
        example = "impulse=solution"
    elif isinstance(solver, np.ndarray | list | tuple):
        example = "impulse=..."
    elif isinstance(solver, float):
        example = "tol=..."
        value = f"{solver:g}"
    elif type(solver) is int:
        example = "max_iter=..."
        value = f"{solver}"
    else:
        get(solver)  # Raises UnknownName with the names of the solvers.
        example = "solver=..."
    raise InputError(
        f"solver is {value}; the name of a solver is needed, all others by name: lavender.solve(problem, {example})"
    )


if not TYPE_CHECKING:
    solve = update_wrapper(make_solve(solve, _solve_after_call, registered), solve)
