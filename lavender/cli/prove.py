"""Define `lavender prove`."""

from __future__ import annotations

import click

from lavender.cli.options import Reading, echo, set_one_thread


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILES...")
@click.option(
    "--solver",
    default="auto",
    show_default=True,
    help="Solver whose answer is compared with the exact solution.",
)
@click.option("--tol", type=float, default=1e-12, show_default=True, help="Relative residual of that answer.")
def prove(files: tuple[str, ...], solver: str, tol: float) -> None:
    """Prove that an exact solution is near an answer.

    Solves problems (files, folders or cases of the suite); needs the extra `proof`. Each line gives the largest
    distance of the exact solution, or says that there is none, or names the undecided condition.

    Exit code 1: a result has no proof, or a file in a folder cannot be read. Exit code 2: a named file cannot
    be read.
    """
    from lavender.base.arrays import check_float
    from lavender.lab.bench.cases import resolve
    from lavender.lab.bench.running.worker import Worker, solve_isolated
    from lavender.lab.proof import prove as enclose
    from lavender.lab.proof import require_python_flint
    from lavender.solvers.registry import get

    set_one_thread()
    # Invalid arguments and missing packages raise an error before any file is read.
    number("tol", tol, low=0.0)
    get(solver)
    require_python_flint()
    unmet, reading = False, Reading()
    for item in resolve(list(files)):
        with errors(item), Worker() as worker:
            solution = solve_isolated(worker, item.problem, solver, tol=tol)
            enclosure = enclose(item.problem, solution)
            suffix = "" if solution.success else f"; {solver}: {solution.status.name}"
            echo(f"{item.name}: {enclosure}{suffix}")
            unmet |= not (enclosure.proven or enclosure.infeasible)
    reading.end(unmet)
