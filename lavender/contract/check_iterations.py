"""Checks of iterations: budgets, continued runs, time limits, histories, callbacks, starts, orders and seeds."""

from __future__ import annotations

from typing import Any

import numpy as np

from lavender.base.arrays import FloatArray
from lavender.contract.requirement import (
    HISTORY_COUNTS,
    MIN_BUDGET,
    choose_iteration_budget,
    describe_problem,
    make_first_well_posed_problem,
    make_well_posed_problems,
    raise_unless,
    register_check,
)
from lavender.judge.solution import Status
from lavender.problem import Problem
from lavender.problem.cones import Cones
from lavender.solvers.registry import SolverSpec
from lavender.solving.solve import solve

# -- iterations ---------------------------------------------------------------------------------------


@register_check("all solvers except code of another project", lambda spec: not spec.external)
def require_budgets_are_kept(spec: SolverSpec) -> None:
    """Require that iteration limits are kept: 0 returns the start, and with tol = 0 exactly max_iter iterations run."""
    for problem in make_well_posed_problems(spec):
        phrase = describe_problem(problem)
        none = solve(problem, spec.name, tol=1e-12, max_iter=0)
        raise_unless(
            none.status is Status.MAX_ITERATIONS and none.iterations == 0,
            f"for {phrase} max_iter=0 returned {none.status.name} after {none.iterations} iterations",
        )
        raise_unless(
            none.impulse.tobytes() == problem.start().tobytes(),
            f"for {phrase} max_iter=0 changed the start",
        )
        for n in (1, 3, 8):
            few = solve(problem, spec.name, tol=1e-12, max_iter=n)
            raise_unless(few.iterations <= n, f"for {phrase} max_iter={n} ran {few.iterations} iterations")
            raise_unless(
                few.claim_check == "confirmed",
                f"for {phrase} max_iter={n} gave a claim that the judge does not confirm: {few}",
            )
            # The residual of a resumable solver may increase in the first iterations.
            raise_unless(
                few.residual.relative <= 1.0 or spec.resumable,
                f"for {phrase} max_iter={n} returned a result that is worse than the start: {few}",
            )
        if spec.resumable:
            exact = solve(problem, spec.name, tol=0.0, max_iter=5)
            raise_unless(
                exact.status is Status.MAX_ITERATIONS and exact.iterations == 5,
                f"for {phrase} tol=0 and max_iter=5 ended as {exact.status.name} after {exact.iterations} "
                "iterations; exactly 5 are required",
            )
            raise_unless(
                sum(exact.work.values()) >= 5,
                f"for {phrase} 5 iterations count a work of {sum(exact.work.values())}; at least 5 are required",
            )


@register_check(
    "solvers with `resumable`, except code of another project",
    lambda spec: spec.resumable and not spec.external,
)
def require_runs_can_be_continued(spec: SolverSpec) -> None:
    """Require that a run of n1 and then n2 iterations gives the bits of a run of n1 + n2 iterations."""
    for problem in make_well_posed_problems(spec):
        for tol in (0.0, 1e-14):
            whole, parts = (_run_in_parts(spec, problem, sizes, tol) for sizes in ([23], [1, 7, 15]))
            raise_unless(
                whole == parts,
                f"for {describe_problem(problem)} and tol={tol:g}, 1 + 7 + 15 iterations ended as {parts[1].name} "
                f"after {parts[0]} iterations, and 23 iterations as {whole[1].name} after {whole[0]}"
                + (", with other bits of the impulse" if whole[:2] == parts[:2] else "")
                + ". The same result is required: keep everything that changes in the state",
            )


def _run_in_parts(
    spec: SolverSpec, problem: Problem, sizes: list[int], tol: float
) -> tuple[int, Status, bytes]:
    """Return (iterations, last status, bits of the impulse) of consecutive runs of these sizes."""
    solver, impulse, done, status = spec.load()(), problem.start().copy(), 0, Status.MAX_ITERATIONS
    state = solver.prepare(problem.disk)
    for size in sizes:
        claim = solver.run(state, impulse, size, tol, None)
        done, status = done + claim.iterations, claim.status
        if status is not Status.MAX_ITERATIONS:
            break
    return done, status, impulse.tobytes()


@register_check("solvers with `resumable`", lambda spec: spec.resumable)
def require_time_limit_returns_the_iterate(spec: SolverSpec) -> None:
    """Require that a time limit ends a long solve with TIME_LIMIT and at least one iteration."""
    problem = make_first_well_posed_problem(spec)
    solve(problem, spec.name, max_iter=1)  # Solve once before, so that imports do not count.
    solution = solve(problem, spec.name, tol=0.0, max_iter=2**31 - 1, time_limit=0.05)
    raise_unless(
        solution.status is Status.TIME_LIMIT and solution.iterations > 0,
        f"for {describe_problem(problem)} tol=0 and a time limit of 0.05 s ended as {solution.status.name} after "
        f"{solution.iterations} iterations; TIME_LIMIT after at least 1 is required",
    )


@register_check("solvers with `history`", lambda spec: spec.history and not spec.delegates)
def require_history_at_fixed_counts(spec: SolverSpec) -> None:
    """Require that a history records the residual at fixed iteration counts and does not change the result."""
    problem = make_first_well_posed_problem(spec)
    solution = solve(problem, spec.name, history=True, tol=0.0, max_iter=40)
    history = solution.history
    assert history is not None
    counts = history.iterations.tolist()
    raise_unless(
        counts == HISTORY_COUNTS,
        f"the history of 40 iterations has the counts {counts}; {HISTORY_COUNTS} are required",
    )
    raise_unless(
        abs(history.relative[0] - 1.0) <= 1e-6, f"the history begins at {history.relative[0]}, not at 1"
    )
    raise_unless(
        history.relative[-1] == solution.residual.relative,
        f"the history ends at {history.relative[-1]}, but the residual is {solution.residual.relative}",
    )
    raise_unless(bool(np.all(np.diff(history.time) >= 0.0)), "the times of the history decrease")
    without = solve(problem, spec.name, tol=0.0, max_iter=40)
    raise_unless(
        without.impulse.tobytes() == solution.impulse.tobytes(),
        "history=True changes the bits of the result; runs must give the same bits in parts",
    )


@register_check("solvers with `callback`", lambda spec: spec.callback)
def require_callback_may_stop(spec: SolverSpec) -> None:
    """Require that a callback receives copies of the iterates and can stop the solve."""
    problem, counts = make_first_well_posed_problem(spec), []

    def callback(n: int, impulse: FloatArray, _: Any) -> bool:
        counts.append(n)
        impulse[:] = np.nan  # The callback gets a copy, so this must not change the solve.
        return n >= 3

    solution = solve(problem, spec.name, callback=callback, tol=0.0, max_iter=50)
    raise_unless(
        solution.status is Status.INTERRUPTED and counts == [0, 1, 2, 3],
        f"a callback that stops at iteration 3 was called at {counts}, and the status is {solution.status.name}; "
        "[0, 1, 2, 3] and INTERRUPTED are required",
    )
    raise_unless(
        bool(np.isfinite(solution.impulse).all()), "a callback that overwrites its impulse changed the result"
    )


# -- starts, orders and seeds -------------------------------------------------------------------------


@register_check("solvers with `impulse`", lambda spec: spec.impulse)
def require_a_solution_as_start_is_kept(spec: SolverSpec) -> None:
    """Require that a solve that starts at a solution ends there, and does not modify the array of the start."""
    for problem in make_well_posed_problems(spec):
        first = solve(problem, spec.name, tol=1e-9, max_iter=choose_iteration_budget(spec))
        if not first.success:
            continue
        start = first.impulse.copy()
        again = solve(problem, spec.name, tol=1e-8, impulse=start)
        text = f"for {describe_problem(problem)}, a solve that starts at the solution ended as: {again}"
        raise_unless(again.success, f"{text}. CONVERGED is required")
        raise_unless(again.iterations == 0 or not spec.resumable, f"{text}. 0 iterations are required")
        raise_unless(
            start.tobytes() == first.impulse.tobytes(), f"{text}. The array of the start was modified"
        )


@register_check(
    "solvers of the law cone with `impulse`, except code of another project",
    lambda spec: spec.impulse and not spec.external and "cone" in spec.laws,
)
def require_a_normal_without_inverse_mass_bears_friction(spec: SolverSpec) -> None:
    """Require that a normal with a zero row of A may bear the friction of the relaxed law.

    The solution then has w_n = mu |w_t| > 0 and lambda_n > 0.
    """
    b, impulse = np.array([-0.5, 2.0, 0.0]), np.array([2.0, 1.0, 0.0])  # The slack is w = (0.5, -1, 0) m/s.
    problems = [
        Problem.contact(np.diag([0.0, 1.0, 1.0]), b, [0.5], friction="cone"),
        Problem.from_jacobian(
            np.eye(3)[:, 1:], np.eye(2), [0, 0], target=b, cones=Cones.contacts([0.5]), friction="cone"
        ),
    ]
    for problem in problems:
        if spec.refuses(problem) is not None:
            continue
        kept = solve(problem, spec.name, tol=1e-9, impulse=impulse)
        raise_unless(
            kept.status is Status.CONVERGED
            and kept.iterations == 0
            and bool(np.array_equal(kept.impulse, impulse)),
            f"for {describe_problem(problem)}, the start is a solution and was not kept: {kept}",
        )
        cold = solve(problem, spec.name, tol=1e-9)
        raise_unless(
            cold.success, f"for {describe_problem(problem)} the result is: {cold}. CONVERGED is required"
        )


@register_check("solvers with `order`", lambda spec: spec.order)
def require_orders_change_the_sweep(spec: SolverSpec) -> None:
    """Require that each order sweeps differently and all orders lead to a solution."""
    problem = next((p for p in make_well_posed_problems(spec) if p.law != "coulomb"), None)
    if problem is None:
        problem = make_first_well_posed_problem(spec)
    early: dict[bytes, str] = {}
    for order in ("given", "reverse", "random", "colored"):
        solution = solve(problem, spec.name, order=order, tol=1e-10, max_iter=MIN_BUDGET)
        raise_unless(
            solution.success,
            f"for {describe_problem(problem)} the order {order!r} ended as: {solution}. CONVERGED is required",
        )
        bits = solve(problem, spec.name, order=order, tol=0.0, max_iter=2).impulse.tobytes()
        raise_unless(
            bits not in early,
            f"for {describe_problem(problem)} the orders {early.get(bits)!r} and {order!r} give the same bits "
            "after 2 sweeps; each order must sweep differently",
        )
        early[bits] = order


@register_check("solvers with `seed`", lambda spec: spec.seed)
def require_seeds_change_random_sweeps(spec: SolverSpec) -> None:
    """Require that equal seeds give equal bits and different seeds give different random sweeps."""
    problem = make_first_well_posed_problem(spec)
    first, same, other = (
        solve(problem, spec.name, order="random", seed=seed, tol=0.0, max_iter=2).impulse.tobytes()
        for seed in (1, 1, 2)
    )
    raise_unless(first == same, "two random sweeps with seed=1 differ; equal bits are required")
    raise_unless(first != other, "random sweeps with seed=1 and seed=2 are equal; the seed has no effect")
