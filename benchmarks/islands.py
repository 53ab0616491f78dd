"""What islands cost beside their solve: the same small problem many times, together and alone.

    python -m benchmarks islands [--count 1000] [--repeats 7]

CPU time, the least of the repeats, of `auto` and others on all of them as one problem.
"""

from __future__ import annotations

import click
import numpy as np
import scipy.sparse as sp

import lavender as lv
from benchmarks.clock import cpu
from lavender.problem import Problem


def stacks(
    count: int, height: int, mu: float | None, equal: bool, corners: int = 4, seed: int = 0
) -> Problem:
    """Columns of unit cubes on the ground that touch at so many corners, masses drawn from [0.5, 2]."""
    rng = np.random.default_rng(seed)
    n = count * height
    mass = rng.uniform(0.5, 2.0, (1 if equal else count, height))
    inv_mass = 1.0 / np.broadcast_to(mass, (count, height)).ravel()
    spots = 0.4 * np.array([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8], [0.0, 0.2]])[:corners]
    above = np.repeat(np.arange(n), corners)
    below = np.where(above % height > 0, above - 1, -1)
    arm = np.column_stack([np.tile(spots, (n, 1)), np.full(corners * n, 0.5)])
    v = np.zeros((n, 6))
    v[:, 2] = -9.81 / 60.0
    rows = lv.Rows(
        inv_mass, 6.0 * inv_mass[:, None, None] * np.eye(3), v,
        normal=np.tile([0.0, 0.0, 1.0], (corners * n, 1)), tangent=np.tile([1.0, 0.0, 0.0], (corners * n, 1)),
        arm_a=arm, arm_b=arm * [1.0, 1.0, -1.0], contact_body=np.column_stack([below, above]).astype(np.int32),
    )  # fmt: skip
    return Problem.from_rows(rows, mu=0.0 if mu is None else mu)


def forms(problem: Problem) -> dict[str, Problem]:
    """The same given by bodies, by A and by J and M."""
    rows = problem.rows
    assert rows is not None
    inertia = np.linalg.inv(rows.inv_inertia)
    blocks = np.zeros((rows.n_bodies, 6, 6))
    blocks[:, :3, :3] = np.eye(3) / rows.inv_mass[:, None, None]
    blocks[:, 3:, 3:] = inertia
    mass = sp.block_diag(list(blocks), format="csr")
    general = lv.Generalized(rows.jacobian(problem.cones), mass, rows.v_free.ravel())
    return {
        "bodies": problem,
        "matrix": Problem(problem.b, problem.cones, problem.csr, friction=problem.friction),
        "J and M": Problem(
            problem.b,
            problem.cones,
            generalized=general,
            compliance=problem.compliance,
            friction=problem.friction,
        ),
    }


def fresh(problem: Problem) -> Problem:
    """The same with nothing derived yet."""
    more = {"compliance": problem.compliance, "friction": problem.friction, "copy": False}
    return Problem(
        problem.b, problem.cones, problem.matrix, rows=problem.rows, generalized=problem.generalized, **more
    )


@click.command("islands")
@click.option("--count", default=1000, show_default=True, help="Islands.")
@click.option("--height", default=2, show_default=True, help="Cubes of each.")
@click.option("--corners", default=1, show_default=True, help="Contacts between two cubes.")
@click.option("--repeats", default=7, show_default=True)
@click.option("--tol", default=1e-6, show_default=True)
@click.option("--others", default="anderson,newton,direct", show_default=True, help="Solvers beside auto.")
def command(count: int, height: int, corners: int, repeats: int, tol: float, others: str) -> None:
    """Many small problems as one: a line for each law, form and kind of islands."""
    for mu, law in ((None, "none"), (0.5, "coulomb"), (0.5, "cone")):
        for equal in (False, True):
            problem = stacks(count, height, mu, equal, corners)
            if law == "cone":
                problem = problem.relaxed("cone")
            for form, given in forms(problem).items():
                solution = lv.solve(given, tol=tol)
                auto = cpu(lambda p=given: lv.solve(fresh(p), tol=tol), repeats)
                said = []
                for name in others.replace(",", " ").split():
                    if name in lv.available(given):
                        done = lv.solve(given, name, tol=tol, time_limit=2.0)
                        t = cpu(lambda p=given, n=name: lv.solve(fresh(p), n, tol=tol, time_limit=2.0), 3)
                        said.append(f"{name} {1e3 * t:.1f}{'' if done.success else ' (no)'}")
                click.echo(
                    f"{law:8} {form:8} {'equal' if equal else 'drawn'} {given.m} rows: auto {1e3 * auto:.2f} ms, "
                    f"{', '.join(said)}; {solution.message}"
                )
