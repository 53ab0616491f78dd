"""`lavender prove`."""

from __future__ import annotations

import click

from lavender.cli.options import Reading, one_thread, say


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@click.option(
    "--solver", default="auto", show_default=True, help="Whose answer is held to the exact solution."
)
@click.option("--tol", type=float, default=1e-12, show_default=True, help="Relative residual asked of it.")
def prove(files: tuple[str, ...], solver: str, tol: float) -> None:
    """Solve problems (files, folders or cases of the suite) and prove an exact solution near each answer.

    Needs the extra `proof`. Each line says how far the exact solution is at most, that there is none, or what could not
    be decided.

    Exit code 1: an answer without a proof, or a file in a folder that cannot be read. Exit code 2: a named file cannot
    be read.
    """
    from lavender.base.arrays import check_float
    from lavender.lab.bench.cases import resolve
    from lavender.lab.bench.running.worker import Worker, solve_isolated
    from lavender.lab.proof import prove as enclose
    from lavender.lab.proof import require
    from lavender.solvers.registry import get

    one_thread()
    check_float(
        "tol", tol, low=0.0
    )  # refused before anything is read, as are an unknown solver and a missing package
    get(solver)
    require()
    unmet, reading = False, Reading()
    for item in resolve(list(files)):
        with reading(item), Worker() as worker:
            solution = solve_isolated(worker, item.problem, solver, tol=tol)
            found = enclose(item.problem, solution)
            short = "" if solution.success else f"; {solver}: {solution.status.name}"
            say(f"{item.name}: {found}{short}")
            unmet |= not (found.proven or found.infeasible)
    reading.end(unmet)
