"""Promises of docs/residual.md about every solve: every registered name on problems of every law, kind and form.

Bits of prepared, batched and recorded solves: tests/core/test_bit_equality.py. Time limits: test_deadline.py.
"""

import functools

import numpy as np
import pytest
from random_problems import (
    make_problems_of_every_kind,
    nearly_singular,
    random_lcp,
    without_solution,
)

import lavender as lv
from lavender import registry
from lavender.problem.cones import project_impulse

OWN = lv.available(external=False)
#: Under Coulomb's law these return their last iterate, as in an engine.
LAST_ITERATE = [name for name in OWN if registry.get(name).load().keeps_last]
TOL = 1e-6


@functools.cache
def examples():
    """Return a problem of every law and kind of block in every form, and bounded rows with finite bounds."""
    kinds = make_problems_of_every_kind().items()
    return [*(p for _, (forms, _) in kinds for p in forms), *map(random_lcp, range(4))]


def accepted(name, *more):
    """Return the examples, and more problems, that a solver accepts."""
    return [p for p in (*examples(), *more) if registry.get(name).refuses(p) is None]


def objective(problem, impulse):
    return 0.5 * impulse @ (problem.slack(impulse) - problem.b)


@pytest.mark.parametrize("name", OWN)
def test_solve_from_a_stale_start_is_not_behind_it_by_the_rule(name):
    rng = np.random.default_rng(0)
    for problem in accepted(name):
        for size in (0.3, 30.0, 1e4):
            start = size * rng.normal(size=problem.m)
            inside = project_impulse(problem.cones, start)
            solution = lv.solve(problem, name, impulse=start, tol=1e-12, max_iter=1)
            held = project_impulse(problem.cones, solution.impulse)
            np.testing.assert_allclose(held, solution.impulse, rtol=1e-12)
            found = solution.residual.islands
            if problem.law == "coulomb" and name not in LAST_ITERATE:
                begun = lv.residual(problem, inside).islands.energy
                assert (found.energy <= begun * (1.0 + 1e-9)).all(), (problem, size)
            elif problem.law not in ("coulomb", "linear"):
                most = min(objective(problem, inside), 0.0)
                is_below = objective(problem, solution.impulse) <= most + 1e-9 * abs(most)
                assert is_below or solution.success, (problem, size)


@pytest.mark.parametrize("name", OWN)
def test_solve_within_a_budget_makes_true_claims(name):
    for problem in accepted(
        name, *(without_solution(seed, 6) for seed in range(9)), *map(nearly_singular, range(20))
    ):
        for budget in (0, 1, 7):
            solution = lv.solve(problem, name, max_iter=budget, tol=TOL)
            judged = lv.residual(problem, solution.impulse)
            assert solution.claim_check == "confirmed" and solution.iterations <= budget, str(
                solution
            )
            assert solution.residual.relative == judged.relative
            assert solution.success == (judged.relative <= TOL) or judged.roundoff_floor > TOL
            if solution.status is lv.Status.INFEASIBLE:
                assert (
                    solution.certificate is not None
                    and judged.energy <= judged.energy_at_zero * (1.0 + 1e-14)
                )
                assert (solution.impulse >= problem.cones.lower).all() and (
                    solution.impulse <= problem.cones.upper
                ).all()


@pytest.mark.parametrize("name", OWN)
@pytest.mark.parametrize("velocity_tol", [1e-3, 1e-6])
def test_solve_to_a_velocity_error_meets_it_on_every_row(name, velocity_tol):
    for problem in accepted(name):
        solution = lv.solve(problem, name, velocity_tol=velocity_tol, max_iter=20_000)
        worst = lv.residual(problem, solution.impulse).velocity
        assert solution.success == (worst <= velocity_tol) and solution.success, (
            problem,
            str(solution),
            worst,
        )
        again = lv.solve(problem, name, impulse=solution.impulse, velocity_tol=velocity_tol)
        assert again.success and (again.iterations <= 1 or not registry.get(name).resumable)
        many = lv.solve_many([problem] * 2, name, velocity_tol=velocity_tol, max_iter=20_000)
        assert many.success.all() and many[1].velocity_tol == velocity_tol


def test_velocity_tol_of_masses_times_1000_and_speeds_times_10_takes_the_same_sweeps():
    A = np.array([[2.0, 1.0], [1.0, 2.0]])
    b = np.array([1.0, 0.5])
    own = lv.solve(lv.Problem.lcp(A, b), "pgs", velocity_tol=1e-4)
    assert (
        own.iterations
        == lv.solve(lv.Problem.lcp(A / 1000.0, 10.0 * b), "pgs", velocity_tol=1e-3).iterations
    )


BALLS = 10  # Each is an island of its own: a contact with friction that slides.
#: Rows on the velocity of one body, and targets [m/s] that no impulse meets.
JAMS = {
    "motors": ([1.0, 1.0], [1.0, -1.0]),
    "limits": ([1.0, -1.0], [1.0, 1.0]),
    "nearly equal": ([1.0, 1.0 + 1e-9], [1.0, -1.0]),
    "an empty row": ([1.0, 0.0], [1.0, 1.0]),
}


def balls_beside_jams(kind, friction, jams=1):
    """Return contacts of balls, and `jams` bodies with two contradictory rows each."""
    rows, target = JAMS[kind]
    cones = lv.Cones.bounded([0.0, 0.0], [np.inf, np.inf]) if kind == "limits" else lv.Cones.free(2)
    m = n = 3 * BALLS
    jac = np.zeros((m + 2 * jams, n + jams))
    jac[:m, :n] = np.eye(n)
    every = lv.Cones.contacts(0.5, count=BALLS)
    for k in range(jams):
        jac[m + 2 * k : m + 2 * k + 2, n + k] = rows
        every = every + cones
    v_free = np.r_[np.tile([-0.1635, 0.3, 0.0], BALLS), np.zeros(jams)]
    target = [0.0] * m + target * jams
    return lv.Problem.from_jacobian(
        jac, np.eye(n + jams), v_free, target=target, cones=every, friction=friction
    )


@pytest.mark.parametrize("friction", ["coulomb", "cone"])
@pytest.mark.parametrize("name", OWN)
def test_islands_next_to_an_infeasible_one_meet_the_tolerance(name, friction):
    for kind in JAMS:
        problem = balls_beside_jams(kind, friction, 1 if kind != "motors" else 5)
        if registry.get(name).refuses(problem) is not None:
            continue
        relative = lv.solve(problem, name, tol=TOL).residual.islands.relative
        assert relative.max() <= 1.0 + 1e-3, (
            kind
        )  # of the start, with what rounding of the large impulses hides
        # ADMM has one penalty for all islands: one without a solution keeps the others from Coulomb's law.
        assert (relative[:BALLS] <= TOL).all() or (name, friction) == ("admm", "coulomb"), kind


@pytest.mark.parametrize("name", OWN)
def test_opposed_limits_that_contradict_each_other_leave_no_impulse_worse_than_zero(name):
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 5))
        limit = rng.normal(size=(1, n))
        jac = np.vstack([rng.normal(size=(2, n)), limit, -limit])
        ends = np.full(4, np.inf)
        general = lv.Problem.from_jacobian(
            jac,
            np.eye(n),
            rng.normal(size=n),
            target=[0.0, 0.0, 5.0, 5.0],
            cones=lv.Cones.bounded(np.zeros(4), ends),
        )
        for problem in (general, lv.Problem.lcp(jac @ jac.T, general.b)):
            if registry.get(name).refuses(problem) is None:
                assert lv.solve(problem, name, tol=TOL).residual.relative <= 1.0 + 1e-12, seed
