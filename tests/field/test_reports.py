"""Problems of public reports and first users: where each was met, the problem, its solvers, and what is right.

The right value is a closed form or one line of NumPy. A row stays when its fault is mended; a new report is a new row.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import lavender as lv
from lavender import registry


@dataclass(frozen=True)
class Report:
    """A problem that somebody met, and its right value."""

    where: str
    make: Callable[[], lv.Problem]
    right: Any  # of `read`, or the variables of a program
    read: Callable[[lv.Problem, lv.Solution], Any] | None = None
    solvers: tuple[str, ...] = ()  # all that accept it, by default
    tol: float = 1e-9
    accuracy: float = 1e-7


def make_paths(noise):
    """Send 1 from node 0 to node 2 at least cost: through node 1 for 1 + 1, or directly for 3."""
    rows = np.array([[-1.0, 0.0, -1.0], [1.0, -1.0, 0.0]])
    cost = np.array([1.0, 1.0, 3.0])
    free = np.zeros(3)
    return lv.Problem.from_qp(
        np.zeros((3, 3)), cost, A=rows, b=np.array([-1.0, noise]), lb=free, ub=free + 10.0
    )


def make_vertex(regularisation):
    """The cheapest of three shares of 1."""
    cost = np.array([1.0, 2.0, 3.0])
    return lv.Problem.from_qp(
        regularisation * np.eye(3), cost, A=np.ones((1, 3)), b=[1.0], lb=np.zeros(3)
    )


def make_constant_force(size):
    """A row with the impulse 1 and three contacts, with b = size."""
    rng = np.random.default_rng(0)
    half = rng.standard_normal((10, 10))
    cones = lv.Cones.bounded([1.0], [1.0]) + lv.Cones.contacts(np.full(3, 0.5))
    return lv.Problem(
        size * rng.standard_normal(10), cones, half @ half.T + 0.1 * np.eye(10), friction="cone"
    )


def drop_box(inside, restitution):
    """A box that meets the floor at 3 m/s with four points, inside of its corners by this share."""
    builder = lv.RowBuilder(
        [1.0], [6.0 * np.eye(3)], [[0, 0, -3.0, 0, 0, 0]], 1 / 60, position=[(0, 0, 0.5)]
    )
    for x in (-0.5, 0.5):
        for y in (-0.5, 0.5):
            point = (inside * x, inside * y, 0.0)
            builder.contact(-1, 0, point, (0, 0, 1), mu=0.3, restitution=restitution)
    return builder.problem()


def make_finger(points):
    """A finger that cannot turn and rests on a table with four points: each has the same row."""
    jac = np.tile(np.eye(3)[[2, 0, 1]], (points, 1))
    free = np.array([0.1, 0.0, -0.1])
    return lv.Problem.from_jacobian(
        jac, np.eye(3), free, cones=lv.Cones.contacts(np.full(points, 0.5))
    )


REPORTS = [
    *(
        Report(
            f"network flow, {noise:g} in place of 0 (0.3 - 0.1 - 0.2)",
            lambda noise=noise: make_paths(noise),
            [1.0, 1.0, 0.0],
            None,
            ("auto", "clarabel", "piqp", "daqp", "highs"),
            1e-6,
            1e-4,
        )
        for noise in (0.0, 0.3 - 0.1 - 0.2, 1e-14)
    ),
    *(
        Report(
            f"linear program with P = {p:g} I, as users regularise",
            lambda p=p: make_vertex(p),
            [1.0, 0.0, 0.0],
            None,
            ("auto", "clarabel", "daqp", "highs", "quadprog"),
            1e-9,
            1e-4,
        )
        for p in (1e-8, 1e-9, 1e-12)
    ),
    *(
        Report(
            f"box that falls, points inside by {inside}, e = {e}",
            lambda i=inside, e=e: drop_box(i, e),
            [0.0, 0.0, 3.0 * e, 0.0, 0.0, 0.0],
            lambda p, s: p.velocity(s.impulse).ravel(),
            (),
            1e-9,
            1e-6,
        )
        for inside in (1.0, 0.4, 0.1)
        for e in (0.0, 0.5, 1.0)
    ),
    *(
        Report(
            f"finger on a slide with {n} points",
            lambda n=n: make_finger(n),
            [0.05, 0.0, 0.0],
            lambda p, s: p.velocity(s.impulse).ravel(),
            (),
            1e-9,
            1e-6,
        )
        for n in (1, 4)
    ),
    *(
        Report(
            f"constant force, |b| about {size:g}",
            lambda size=size: make_constant_force(size),
            1.0,
            lambda p, s: s.impulse[0],
            ("newton", "admm", "auto"),
            1e-9,
        )
        for size in (0.0, 1e-18, 1e-3)
    ),
]


def list_rows():
    """Yield each report with each solver that accepts its problem and is installed."""
    for report in REPORTS:
        problem = report.make()
        for name in report.solvers or lv.available(problem, external=False):
            if registry.get(name).refuses(problem) is None and not registry.get(name).missing():
                yield pytest.param(report, name, id=f"{report.where}-{name}")


@pytest.mark.parametrize(("report", "solver"), list(list_rows()))
def test_reported_problem_has_its_right_value(report, solver):
    problem = report.make()
    if report.read is None:
        answer = lv.solve_qp(problem, solver, tol=report.tol)
        assert answer.found, answer
        value = answer.x
    else:
        solution = lv.solve(problem, solver, tol=report.tol, max_iter=20_000)
        assert solution.success or solution.status is lv.Status.ROUNDOFF_LIMIT, solution
        value = report.read(problem, solution)
    np.testing.assert_allclose(value, report.right, rtol=0, atol=report.accuracy)


@pytest.mark.parametrize("points", [1, 4])
def test_points_of_a_finger_that_cannot_turn_are_no_mistake(points):
    assert not lv.diagnose(make_finger(points))


@pytest.mark.parametrize("solver", ["pgs", "nncg", "admm", "newton", "auto"])
@pytest.mark.parametrize("size", [0.0, 1e-18])
def test_iterates_count_if_b_is_zero(solver, size):
    problem = make_constant_force(size)
    if registry.get(solver).refuses(problem) is not None:
        problem = lv.Problem(problem.b, problem.cones, problem.dense())  # Coulomb's law
    few, many = (lv.solve(problem, solver, tol=tol, max_iter=60) for tol in (1e-2, 1e-17))
    assert many.residual.relative <= max(10.0 * few.residual.relative, 1e-2)
    assert many.claim_check != "contradicted"


def test_start_with_a_higher_objective_than_nothing_is_replaced_by_every_call():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        contacts, n = int(rng.integers(2, 8)), int(rng.integers(6, 20))
        jac = rng.standard_normal((3 * contacts, n))
        free = rng.standard_normal(n)
        mu = np.full(contacts, 0.5)
        problem = lv.Problem.from_jacobian(
            jac, np.eye(n), free, cones=lv.Cones.contacts(mu), friction="cone"
        )
        start = np.tile([1e3, 100.0, -100.0], contacts)
        assert 0.5 * start @ problem.dense() @ start > problem.b @ start
        calls = (
            lv.solve(problem, "newton", impulse=start),
            lv.solve(problem, "newton", impulse=start, max_iter=1000),
            lv.prepare(problem, "newton").solve(impulse=start),
            lv.solve(problem, "newton"),
        )
        assert len({(found.iterations, found.impulse.tobytes()) for found in calls}) == 1
