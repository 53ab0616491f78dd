"""Newton's factor on lattices of spheres, by block rows and by panels, and whole solves beside it.

    python -m benchmarks lattice [--side 6 --side 10] [--ratio 1e4] [--mu 0.5] [--off 0.02] [--keep 1] [--seed 0]
                                 [--solvers auto]

side^3 spheres, each touching its neighbours and the floor, positions `off` the lattice, masses log-uniform over
`ratio`, each contact kept with probability `keep`. Times are CPU time of one thread. With `--mu` equal spheres with
friction instead, and sweeps beside `newton`.
"""

from __future__ import annotations

from dataclasses import replace

import click
import numpy as np
from scipy.spatial import cKDTree

import lavender as lv
from benchmarks.clock import cpu
from lavender.problem import Problem
from lavender.solvers.newton_systems import systems
from lavender.suite.build import Bodies, Contacts
from lavender.suite.families import SPHERE


def lattice(
    side: int, ratio: float, mu: float | None, seed: int = 0, off: float = 0.02, keep: float = 1.0
) -> Problem:
    """side^3 spheres at rest under gravity."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)
    position = grid + np.array([0.0, 0.0, 0.5]) + off * rng.standard_normal(grid.shape)
    a, b = cKDTree(grid).query_pairs(1.01, output_type="ndarray").T
    a, b = np.where(position[a, 2] > position[b, 2], b, a), np.where(position[a, 2] > position[b, 2], a, b)
    away = position[b] - position[a]
    low = np.flatnonzero(grid[:, 2] == 0)
    body = np.concatenate([np.stack([a, b], 1), np.stack([np.full(len(low), -1), low], 1)])
    point = np.concatenate([0.5 * (position[a] + position[b]), position[low] - [0.0, 0.0, 0.5]])
    normal = np.concatenate(
        [away / np.linalg.norm(away, axis=1, keepdims=True), np.tile([0.0, 0.0, 1.0], (len(low), 1))]
    )
    kept = rng.random(len(body)) < keep if keep < 1.0 else np.ones(len(body), bool)
    contacts = Contacts(body[kept], point[kept], normal[kept])
    half = 0.5 * np.log10(ratio)
    mass = np.ones(len(grid)) if mu is not None else 10.0 ** rng.uniform(-half, half, len(grid))
    bodies = Bodies(position, mass, SPHERE)
    arm_a, arm_b = contacts.arms(position)
    rows = bodies.rows(
        jac=np.zeros((0, 12)), joint_ptr=np.zeros(1, np.int32), joint_body=np.zeros((0, 2), np.int32),
        normal=contacts.normal, tangent=contacts.tangent(), arm_a=arm_a, arm_b=arm_b, contact_body=contacts.body,
    )  # fmt: skip
    if mu is None:
        return Problem.from_rows(rows)
    return Problem.from_rows(rows, mu=np.full(len(contacts.body), mu), tangents=2, friction="coulomb")


def factors(problem: Problem) -> None:
    """One factor of newton's matrix over bodies: by block rows, by panels with four lanes and with two."""
    given = systems.PANELS, systems.WIDE
    bits = []
    for label, panels, wide in (
        ("block rows", np.inf, True),
        ("panels, widest", 0.0, True),
        ("panels, baseline", 0.0, False),
    ):
        systems.PANELS, systems.WIDE = panels, wide
        system = systems.make_system(problem, "velocity")
        rng = np.random.default_rng(0)
        solve = system.solve
        solve.v[:] = 10.0 ** rng.uniform(-2.0, 2.0, len(solve.v))
        time = cpu(lambda solve=solve: solve.factor("barrier"), 5)
        bits.append(solve.solve("barrier", rng.normal(size=solve.m)).tobytes())
        print(
            f"  {label:<18}{1e3 * time:8.2f} ms, {system.cost / time / 1e9:5.2f} G multiply-adds/s of {system.cost:.3g}"
        )
    systems.PANELS, systems.WIDE = given
    print(f"  widths give {'the same bits' if bits[1] == bits[2] else 'OTHER BITS'}")


def solves(problem: Problem, names: list[str]) -> None:
    """Whole solves, cold."""
    for tol in (1e-3, 1e-6):
        for name in names:
            solution = None

            def run(name: str = name, tol: float = tol) -> None:
                nonlocal solution
                solution = lv.solve(replace(problem, copy=False), name, tol=tol, time_limit=60.0)

            time = cpu(run, 2)
            assert solution is not None
            print(f"  {name:<10} to {tol:.0e}: {1e3 * time:8.1f} ms {solution.status.name} {solution.work}")


@click.command("lattice")
@click.option("--side", "sides", type=int, multiple=True, default=(6, 10, 14), show_default=True)
@click.option("--ratio", default=1e4, show_default=True, help="Of masses.")
@click.option("--mu", type=float, default=None, help="Friction; equal masses then.")
@click.option("--off", default=0.02, show_default=True, help="The lattice, in diameters.")
@click.option("--keep", default=1.0, show_default=True, help="Probability of each contact.")
@click.option("--seed", default=0, show_default=True)
@click.option("--solvers", default="", help="Names with commas; default: newton, direct or anderson, auto.")
def command(
    sides: tuple[int, ...], ratio: float, mu: float | None, off: float, keep: float, seed: int, solvers: str
) -> None:
    """Newton's factor on lattices of spheres, and whole solves beside it."""
    names = solvers.replace(",", " ").split()
    for side in sides:
        problem = lattice(side, ratio, mu, seed, off, keep)
        click.echo(f"side {side}, {problem.m} rows, {problem.law}")
        if mu is None:
            factors(problem)
        solves(problem, names or ["newton", "direct" if mu is None else "anderson", "auto"])
