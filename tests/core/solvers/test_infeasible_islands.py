"""A failed solve: an island without a solution costs no other its impulse, and no island is worse than its start."""

import copy
import pickle

import numpy as np
import pytest

import lavender as lv

TOL = 1e-6
BALLS = 10  # each an island of its own: a contact with friction that slides
OWN = lv.available(external=False)
# Its penalty is one number for all islands: that of the island without a solution keeps the others from Coulomb's law.
ONE_PENALTY = {("admm", "coulomb")}


def skip_if_refused(name, problem):
    if name not in lv.available(problem):
        pytest.skip("takes another law or form")


def jam(kind):
    """Rows over the one velocity of a body, their cones and targets [m/s]: no impulse gives what they ask for."""
    rows = {"motors": [1.0, 1.0], "limits": [1.0, -1.0], "nearly equal": [1.0, 1.0 + 1e-9], "an empty row": [1.0, 0.0]}
    target = [1.0, 1.0] if kind in ("limits", "an empty row") else [1.0, -1.0]
    cones = lv.Cones.bounded([0.0, 0.0], [np.inf, np.inf]) if kind == "limits" else lv.Cones.free(2)
    return np.array(rows[kind])[:, None], cones, target


def balls_beside_jams(kind, friction, jams=1):
    rows, cones, target = jam(kind)
    m, n = 3 * BALLS, 3 * BALLS
    jac = np.zeros((m + 2 * jams, n + jams))
    jac[:m, :n] = np.eye(n)
    every = lv.Cones.contacts(0.5, count=BALLS)
    for k in range(jams):
        jac[m + 2 * k : m + 2 * k + 2, n + k : n + k + 1] = rows
        every = every + cones
    v_free = np.r_[np.tile([-0.1635, 0.3, 0.0], BALLS), np.zeros(jams)]
    target = [0.0] * m + target * jams
    return lv.Problem.from_jacobian(jac, np.eye(n + jams), v_free, target=target, cones=every, friction=friction)


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("kind", ["motors", "limits", "nearly equal", "an empty row"])
@pytest.mark.parametrize("name", OWN)
def test_balls_are_held_beside_a_jam(name, kind, friction):
    problem = balls_beside_jams(kind, friction)
    skip_if_refused(name, problem)
    solution = lv.solve(problem, name, tol=TOL)
    relative = solution.residual.islands.relative
    assert not solution.success
    assert relative.max() <= 1.0 + 1e-3  # of the start, with what rounding of the large impulses hides
    if (name, friction) not in ONE_PENALTY:
        assert (relative[:BALLS] <= TOL).all()


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
def test_balls_are_held_beside_many_jams(friction):
    problem = balls_beside_jams("motors", friction, jams=40)
    for name in ("auto", "newton"):
        solution = lv.solve(problem, name, tol=TOL)
        assert (solution.residual.islands.relative[:BALLS] <= TOL).all(), name


def test_an_infeasible_solve_counts_the_work_for_the_other_islands():
    problem = balls_beside_jams("motors", "cone")
    alone = lv.Problem.from_jacobian(
        problem.generalized.jac[-2:].toarray()[:, -1:], np.eye(1), [0.0], target=[1.0, -1.0], cones=lv.Cones.free(2)
    )
    solution, jammed = (lv.solve(p, "newton", tol=TOL) for p in (problem, alone))
    assert solution.status is jammed.status is lv.Status.INFEASIBLE
    assert solution.iterations > jammed.iterations


@pytest.mark.parametrize("form", ["J and M", "A"])
@pytest.mark.parametrize("name", OWN)
def test_contradictory_limits_leave_no_impulse_that_is_worse_than_zero(name, form):
    """Impulses between opposed limits grow until float64 loses b; none of those is returned."""
    for seed in range(30):
        random = np.random.default_rng(seed)
        n = int(random.integers(2, 5))
        limit = random.normal(size=(1, n))
        jac = np.vstack([random.normal(size=(2, n)), limit, -limit])
        problem = lv.Problem.from_jacobian(
            jac, np.eye(n), random.normal(size=n), target=[0.0, 0.0, 5.0, 5.0],
            cones=lv.Cones.bounded([0.0] * 4, [np.inf] * 4),
        )  # fmt: skip
        if form == "A":
            problem = lv.Problem.lcp(jac @ jac.T, problem.b)
        skip_if_refused(name, problem)
        solution = lv.solve(problem, name, tol=TOL)
        assert solution.residual.relative <= 1.0 + 1e-12, seed  # its own summation's rounding


@pytest.mark.parametrize("name", OWN)
def test_a_warm_start_of_a_problem_at_rest_is_swept(name):
    """Zero impulses solve it, so that any error is infinite as a share of theirs; sweeps converge all the same."""
    problem = lv.Problem.lcp(np.eye(2), [-1.0, 0.0])
    skip_if_refused(name, problem)
    solution = lv.solve(problem, name, impulse=[0.1, 0.1], tol=TOL)
    assert solution.status is not lv.Status.DIVERGED
    assert np.abs(solution.impulse).max() < 0.1


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copied_solution_has_the_errors_of_its_islands(copied):
    problem = lv.Problem.from_jacobian(
        np.eye(2), np.eye(2), [-1.0, -3.0], cones=lv.Cones.bounded([0.0, 0.0], [np.inf, np.inf])
    )
    solution = lv.solve(problem, "pgs", tol=0.0, max_iter=1)
    again = copied(solution).residual.islands  # before the original's were read
    for value, original in zip(again, solution.residual.islands, strict=True):
        np.testing.assert_array_equal(value, original)
