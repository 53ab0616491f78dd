"""What islands cost beside their solve: the same small problem many times, together and alone.

    python benchmarks/bench_islands.py [--count 1000] [--repeats 7]

CPU time, the least of the repeats, of `auto` and others on all of them as one problem; and what an island costs beside
its solve: laid out, compared with those before, its start judged to be a solution, its impulse put back.
"""

from __future__ import annotations

import argparse

import numpy as np
import scipy.sparse as sp
from clock import cpu

import lavender as lv
from lavender.problem import Problem
from lavender.residuals import judged
from lavender.solvers import _split
from lavender.solvers._islands import islands
from lavender.solvers._log import SolveLog


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


def beyond(problem: Problem, repeats: int) -> float:
    """Of one island [s]: laid out, compared, its start judged to be a solution, and put back."""
    answer = lv.solve(problem, tol=1e-9).impulse
    log = SolveLog(problem, 1e-3, 10**6)
    log.offer(answer)
    count, label = islands(problem)
    options = _split.asked(log, np.inf, 10_000, 1e3)
    wanted = np.ones(count, np.int32)
    matrix = problem.csr_data if options[5] and problem.rows is not None else None
    prepared = _split.gauss_seidel.prepare(problem.metric) if problem.law == "cone" else None

    def once() -> None:
        work = _split.Islands(problem.metric, matrix, label, wanted, answer, prepared)
        work.run(options, _split.GATE, _split.general.ROOM, np.inf, answer.copy())

    judged(problem, answer)
    return cpu(once, repeats) / count


def main() -> None:
    """Print a line for each law, form and kind of islands."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--height", type=int, default=2)
    parser.add_argument("--corners", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--tol", type=float, default=1e-6)
    parser.add_argument("--others", nargs="*", default=["anderson", "newton", "direct"])
    o = parser.parse_args()
    for mu, law in ((None, "none"), (0.5, "coulomb"), (0.5, "cone")):
        for equal in (False, True):
            problem = stacks(o.count, o.height, mu, equal, o.corners)
            if law == "cone":
                problem = problem.relaxed("cone")
            for form, given in forms(problem).items():
                solution = lv.solve(given, tol=o.tol)
                auto = cpu(lambda p=given: lv.solve(fresh(p), tol=o.tol), o.repeats)
                others = []
                for name in o.others:
                    if lv.get(name).refuses(given) is None if hasattr(lv, "get") else True:
                        try:
                            done = lv.solve(given, name, tol=o.tol, time_limit=2.0)
                            t = cpu(
                                lambda p=given, n=name: lv.solve(fresh(p), n, tol=o.tol, time_limit=2.0), 3
                            )
                            others.append(f"{name} {1e3 * t:.1f}{'' if done.success else ' (no)'}")
                        except lv.LavenderError:
                            pass
                print(
                    f"{law:8} {form:8} {'equal' if equal else 'drawn'} {given.m} rows: auto {1e3 * auto:.2f} ms, "
                    f"beyond {1e6 * beyond(given, o.repeats):.2f} us an island, {', '.join(others)}; "
                    f"{solution.message}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
