"""Define `lavender prove`."""

from __future__ import annotations

import click

from lavender.cli.options import ErrorReporter, limit_to_one_thread, print_escaped


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILES...")
@click.option(
    "--solver",
    default="auto",
    show_default=True,
    help="Solver whose result is compared with the exact solution.",
)
@click.option("--tol", type=float, default=1e-12, show_default=True, help="Relative residual to reach.")
def prove(files: tuple[str, ...], solver: str, tol: float) -> None:
    """Solve problems and enclose an exact solution near each result.

    FILES are files, folders or cases of the suite; the extra `proof` is needed. Each line states the largest distance
    of the exact solution, that there is no solution, or why neither could be proven.

    Exit code 1: a result has no proof, or a file in a folder cannot be read. Exit code 2: a named file cannot
    be read.
    """
    from lavender.base.arrays import check_float
    from lavender.lab.bench.cases import resolve_sources
    from lavender.lab.bench.running.worker import Worker, solve_isolated
    from lavender.lab.proof import prove as enclose
    from lavender.lab.proof import require_python_flint
    from lavender.solvers.registry import get

    limit_to_one_thread()
    # Check the arguments before any file is read.
    check_float("tol", tol, low=0.0)
    get(solver)
    require_python_flint()
    unmet, errors = False, ErrorReporter()
    for item in resolve_sources(list(files)):
        with errors(item), Worker() as worker:
            solution = solve_isolated(worker, item.problem, solver, tol=tol)
            proof = enclose(item.problem, solution)
            failure = "" if solution.success else f"; {solver}: {solution.status.name}"
            print_escaped(f"{item.name}: {proof}{failure}")
            unmet |= not (proof.proven or proof.infeasible)
    errors.exit(unmet)
