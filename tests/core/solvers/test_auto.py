"""auto: what it chooses, that it says so, islands, certificates, and that it gets there."""

import numpy as np
import pytest
import scipy.sparse as sp
from calls import over_velocities
from hypothesis import given
from random_problems import (
    FORMS,
    as_matrix,
    random_contact_problem,
    random_generalized_problem,
    seeds,
    side_by_side,
)

import lavender as lv
from lavender.solvers.islands import find_islands, get_rows_of_blocks, restrict_to_blocks
from lavender.solvers.newton import Newton


@pytest.mark.parametrize("form", FORMS)
@given(seed=seeds)
def test_restrict_to_islands_gives_blocks_of_the_matrix(form, seed):
    rolls = bool(seed % 2)
    problem = FORMS[form](
        random_contact_problem(seed, spin=not rolls, rolling=rolls, bodies=9, joints=2, contacts=6)
    )
    if form == "J and M" and rolls:  # Some velocities of these trees have no rows.
        problem = random_generalized_problem(seed, "coulomb", n=30, contacts=3)
    count, label = find_islands(problem)
    # Blocks that share a body may still not touch in A, where rows happen to be orthogonal; not at random.
    count_of_matrix, label_of_matrix = find_islands(as_matrix(problem))
    assert count == count_of_matrix
    assert np.array_equal(label, label_of_matrix)
    assert np.array_equal(np.unique(label), np.arange(count))
    a = problem.dense()
    lam = np.random.default_rng(seed).normal(size=problem.m)
    for i in range(count):
        blocks = np.flatnonzero(label == i)
        rows = get_rows_of_blocks(problem, blocks)
        part = restrict_to_blocks(problem, blocks, rows)
        assert part.operator == problem.operator
        # Sums over one body in another order: a few roundings.
        np.testing.assert_allclose(
            part.dense(), a[np.ix_(rows, rows)], rtol=0, atol=1e-13 * np.abs(a).max()
        )
        np.testing.assert_array_equal(part.b, problem.b[rows])
        assert [part.block_name(j) for j in range(len(blocks))] == [
            problem.block_name(int(j)) for j in blocks
        ]
        if problem.rows is not None:
            bodies = np.unique(problem.rows.block_bodies[blocks])
            np.testing.assert_array_equal(
                part.rows.v_free, problem.rows.v_free[bodies[bodies >= 0]]
            )
        alone = lv.residual(part, lam[rows]).error
        whole = lv.residual(problem, lam).error[rows]
        np.testing.assert_allclose(alone, whole, rtol=0, atol=1e-9 * np.abs(whole).max())
        others = np.setdiff1d(np.arange(problem.m), rows)
        assert not a[np.ix_(rows, others)].any()


def test_auto_solves_a_resting_pile_by_its_relaxation():
    problem = lv.suite.case("granularF(n=6)").problem
    solution = lv.solve(problem, "auto", tol=1e-6)
    assert solution.success and lv.residual(problem, solution.impulse).relative <= 1e-6
    assert {stage.solver for stage in solution.stages} == {"anderson"}


def test_auto_admm_from_relaxation_solves_pyramid_with_slip():
    problem = lv.suite.case(
        "pyramidF(k=10)"
    ).problem  # The relaxation has the residual 6e-2 under Coulomb's law.
    solution = lv.solve(problem, "auto", tol=1e-6)
    work = {stage.solver: stage.work for stage in solution.stages}
    assert solution.success and lv.residual(problem, solution.impulse).relative <= 1e-6
    # `newton` on Coulomb's law is not needed.
    assert "newton on the relaxation" in work and "newton" not in work


def test_auto_leaves_the_relaxation_of_a_sliding_pyramid_before_it_is_solved():
    problem = lv.suite.case("pyramidF(k=10, sliding=2)").problem
    solution = lv.solve(problem)
    relaxed = lv.solve(problem.relaxed("cone"), "newton")
    assert solution.success
    assert [stage.solver for stage in solution.stages] == ["newton on the relaxation", "newton"]
    assert solution.stages[0].work["factorisations"] < relaxed.work["factorisations"]


def test_auto_turn_of_newton_that_halves_the_residual_continues():
    problem = lv.suite.case("granularF(n=6, sliding=2, seed=4)").problem
    solution = lv.solve(problem, "auto", tol=1e-6)
    assert solution.success and lv.residual(problem, solution.impulse).relative <= 1e-6
    turns = [stage.work["factorisations"] for stage in solution.stages if stage.solver == "newton"]
    # After the first turn of 180, the residual is 3e-3; 30 factorisations before it was 1e-2.
    assert len(turns) == 1 and 180 < turns[0] <= 270
    assert "admm" not in {stage.solver for stage in solution.stages}


def test_fraction_near_sliding_of_interior_point_equals_that_of_its_impulses():
    problem = lv.suite.case("pyramidF(k=10)").problem.relaxed("cone")
    state = Newton().prepare(problem)
    impulse = problem.start()
    Newton().advance(state, impulse, 8, 1e-9)
    state.system.solve.write_interior_impulse(impulse)
    # In z = D^1/2 impulse, as in the kernel: the mean load of contacts depends on the scale.
    z = impulse * np.sqrt(problem.d)
    normal = problem.cones.normal_rows
    bound = problem.cones.friction_coefficient[normal + 1] * impulse[normal]
    loaded = z[normal] > 1e-3 * z[normal].mean()
    near = np.hypot(impulse[normal + 1], impulse[normal + 2]) > 0.95 * bound
    assert 0.0 < near[loaded].mean() < 1.0
    assert state.system.solve.fraction_near_sliding == near[loaded].mean()


def test_auto_continues_only_with_islands_that_the_relaxation_has_not_solved():
    """Beside a pile that rests, a pyramid that slips takes about as many factorisations as alone."""
    pile, pyramid = (
        lv.suite.case(name).problem for name in ("granularF(n=6)", "pyramidF(k=6, sliding=0.5)")
    )
    problem = side_by_side([pile, pyramid])
    solution = lv.solve(problem, "auto", tol=1e-6)
    assert solution.success and lv.residual(problem, solution.impulse).relative <= 1e-6
    sweeps = [
        s.work["sweeps"] for s in solution.stages if s.solver == "anderson" and s.before > 0.1
    ]
    assert (
        sum(sweeps) <= 128
    )  # The pile needs fewer than 128; the sweeps end when half of the blocks are solved.


def test_auto_with_stages_left_out_for_lack_of_time_ends_with_the_status_time_limit(monkeypatch):
    """Sweeps diverge here, and Newton's method, which solves it, is counted to need a second for its set-up."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(100, 100))
    problem = lv.Problem.lcp(0.05 * np.eye(100) + (noise - noise.T) / 10.0, rng.normal(size=100))
    for name in ("estimate_setup_cost", "estimate_total_cost"):
        monkeypatch.setattr(Newton, name, lambda self, problem: 1e9)
    solution = lv.solve(problem, "auto", tol=1e-6, time_limit=0.02)
    assert solution.status is lv.Status.TIME_LIMIT and solution.stages[0].solver == "anderson"
    monkeypatch.undo()
    assert lv.solve(problem, "auto", tol=1e-6).success


@pytest.mark.parametrize("law", ["coulomb", "cone"])
@pytest.mark.parametrize(("rows", "velocities"), [(9, 12), (12, 9), (24, 18)])
def test_more_islands_of_one_size_are_solved_by_the_same_method(law, rows, velocities):
    """The rows of an island, not of all islands, decide what is too large for Newton's method."""
    methods = []
    for copies in (4, 12, 40):
        parts = [over_velocities(rows, velocities, seed=s).generalized for s in range(copies)]
        problem = lv.Problem.from_jacobian(
            sp.block_diag([g.jac for g in parts]),
            sp.block_diag([g.mass for g in parts]),
            np.concatenate([g.v_free for g in parts]),
            cones=lv.Cones.contacts(np.full(rows // 3 * copies, 0.5)),
            compliance=0.02,
            friction=law,
        )
        solution = lv.solve(problem)
        assert solution.success
        methods.append({stage.solver for stage in solution.stages})
    assert methods[0] == methods[1] == methods[2]
