"""Define `lavender solve`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lavender.base.errors import InputError
from lavender.base.exits import EXIT_INFEASIBLE, EXIT_INTERRUPTED, EXIT_UNMET
from lavender.cli.completion import complete_case_or_file, complete_solver
from lavender.cli.options import PATH, limit_to_one_thread, print_escaped
from lavender.io.stored import check_writable, format_json, write_arrays

if TYPE_CHECKING:
    from lavender.judge.solution import Solution
    from lavender.problem import Problem

#: Fields of the solution and of its residual that --output writes, in addition to its status and solver.
SAVED_FIELDS = ("impulse", "slack", "iterations", "setup_time", "solve_time")
SAVED_RESIDUAL_FIELDS = ("error", "relative", "energy", "velocity", "roundoff_floor")


@click.command()
@click.argument("file", shell_complete=complete_case_or_file)
@click.option(
    "--solver",
    default="auto",
    show_default=True,
    shell_complete=complete_solver,
    help="Name of the solver; see `lavender solvers`.",
)
@click.option(
    "--tol",
    type=float,
    default=1e-6,
    show_default=True,
    help="Relative residual to reach; 0 runs exactly --max-iter iterations.",
)
@click.option(
    "--velocity-tol",
    type=float,
    metavar="M/S",
    help="Velocity error of every row to reach [m/s], in place of --tol.",
)
@click.option("--max-iter", type=int, help="Largest number of iterations; default: the solver's.")
@click.option("--time-limit", type=float, metavar="S", help="Limit of the solve time.")
@click.option("--order", help="Sweep order, for solvers that take one.")
@click.option("--seed", type=int, help="Seed of a random order.")
@click.option(
    "--output", type=PATH, help="Write impulse, slack, status and residual to this .npz file."
)
@click.option(
    "--json",
    "as_json",
    is_flag=True,
    help="Print the judged result as JSON, with impulse and slack.",
)
def solve(
    file: str, solver: str, tol: float, output: Path | None, as_json: bool, **options: Any
) -> None:
    """Solve one problem and print the judged result.

    FILE is a file or a case of the suite. A quadratic program is solved by `lavender.solve_qp`; x, its multipliers y, z
    and z_box and its error take the place of impulse, slack and residual. Exit code 0: the judge accepts the result
    (within --tol or --velocity-tol, or at the floor of float64; with --tol 0 always). 1: the judge rejects it. 3: the
    problem is infeasible, with a certificate that the judge confirms.
    """
    from lavender import report
    from lavender.report.case_kinds import make_case

    limit_to_one_thread()
    if output is not None:
        check_writable(output)
    (item, *more) = report.resolve_sources([file])
    if more:
        raise InputError(f"{file} holds {len(more) + 1} problems; give one file")
    if (
        output is not None
        and output.exists()
        and Path(item.source).exists()
        and output.samefile(item.source)
    ):
        raise InputError(f"--output {output} would overwrite the problem: give another file")
    options = {name: value for name, value in options.items() if value is not None}
    case = make_case(item.problem)
    if "velocity_tol" in options and item.problem.qp is not None:
        raise InputError(
            f"{file} is a quadratic program, which has no velocities: give --tol, its largest error"
        )
    solution = case.solve(solver, tol=tol, **options)
    if output is not None:
        results = _collect_results(item.problem, solution, SAVED_RESIDUAL_FIELDS)
        write_arrays(
            output, results | {"status": solution.status.name, "solver": solution.solver.name}
        )
    if as_json:
        law = item.problem.law if item.problem.qp is None else "program"
        judged = (
            {}
            if item.problem.qp is not None
            else {
                "verdict": solution.residual.verdict,
                "worst_row": solution.residual.worst_label,
            }
        )
        results = {
            "case": item.name,
            "law": law,
            "rows": item.problem.m,
            "solver": solution.solver.name,
            "status": solution.status.name,
            "success": solution.success,
            **judged,
            **_collect_results(
                item.problem, solution, ("relative", "energy", "velocity", "roundoff_floor")
            ),
        }
        click.echo(format_json(results, indent=1))
    else:
        start = "zero impulses" if item.problem.guess is None else "the stored guess"
        kind = f"{item.problem.law}, {item.problem.m} rows, starts from {start}"
        if (qp := item.problem.qp) is not None:
            kind = f"quadratic program, {len(qp.q)} variables, {len(qp.target)} rows"
        print_escaped(f"{item.name}: {kind}")
        print_escaped(str(solution))
        if output is not None:
            print_escaped(f"written: {output}")
    if solution.status.name == "INTERRUPTED":
        raise click.exceptions.Exit(EXIT_INTERRUPTED)
    if solution.status.name == "INFEASIBLE" and solution.claim_check == "confirmed":
        raise click.exceptions.Exit(EXIT_INFEASIBLE)
    if errors := case.describe_zero(solution):
        if not as_json:
            click.echo(
                f"nothing to do: the zero impulse is a solution; this result differs by {errors}"
            )
        return
    if tol > 0.0 and not case.is_solved(solution):
        raise click.exceptions.Exit(EXIT_UNMET)


def _collect_results(problem: Problem, solution: Solution, names: Sequence[str]) -> dict[str, Any]:
    """Return the answer, its counts and times, and of its residual the fields `names`; of a program its error."""
    results = {name: getattr(solution, name) for name in SAVED_FIELDS}
    if problem.qp is None:
        return results | {name: getattr(solution.residual, name) for name in names}
    answer = problem.qp.solution(solution)
    found = {name: getattr(answer, name) for name in ("x", "y", "z", "z_box", "error", "objective")}
    del results["impulse"], results["slack"]
    return results | {name: value for name, value in found.items() if value is not None}
