"""`newton`, `admm` and `auto` on built-in problems, whose structure these properties need."""

import numpy as np
import pytest
from random_problems import as_matrix, good

import lavender as lv
from benchmarks.random_families import wild
from lavender import registry, suite
from lavender.judge.solution import Status
from lavender.solvers.newton import Newton, NewtonState
from lavender.solvers.newton_systems.systems import make_system
from lavender.suite import box_stack


@pytest.mark.parametrize(("ratio", "speed"), [(1.0, 0.5), (1e3, 0.0), (1e3, 0.5), (1e6, 0.5)])
def test_admm_under_coulomb_with_mass_ratios_converges(ratio, speed):
    # Sweeps do not get below 1e-2 here in 20,000.
    problem = box_stack(4, ratio, "coulomb", speed).problem
    solution = lv.solve(problem, "admm", tol=1e-7, max_iter=20_000)
    assert solution.success, solution


@pytest.mark.parametrize(
    "problem",
    [
        lambda: suite.stack(n=200).problem,
        lambda: suite.hang(n=24).problem,
        lambda: suite.granular(n=4).problem,
        lambda: suite.granular(n=3, friction="coulomb").problem,
        lambda: suite.granular(n=3, friction="coulomb").problem.relaxed("cone"),
        lambda: suite.pyramid(k=6, mass_ratio=1e6).problem,
        lambda: suite.pyramid(k=5, mass_ratio=1e6, friction="coulomb").problem,
        lambda: wild(seed=7921).problem,
    ],
)
def test_auto_stages_sum_to_the_work_and_end_at_the_residual(problem):
    problem = problem()
    solution = lv.solve(problem, "auto", tol=1e-6)
    assert solution.success, solution
    work: dict[str, int] = {}
    for stage in solution.stages:
        assert stage.solver.split()[0] in registry.specs() and stage.solver in solution.message
        assert not stage.after > stage.before  # the least so far; nan where nobody looked
        for kind, count in stage.work.items():
            work[kind] = work.get(kind, 0) + count
    assert {kind: count for kind, count in work.items() if count} == {
        kind: count for kind, count in solution.work.items() if count
    }
    assert solution.stages[-1].after == solution.residual.relative
    begun = lv.residual(problem, problem.start()).relative
    assert solution.stages[0].before == pytest.approx(begun, rel=1e-12)
    assert lv.solve(problem, "newton").stages == ()


BOXES = {
    "pyramid": lambda ratio: suite.pyramid(k=5, mass_ratio=ratio),
    "boxes": lambda ratio: suite.box_stack(n=8, mass_ratio=ratio),
    "with friction": lambda ratio: suite.pyramid(k=4, mass_ratio=ratio, friction="coulomb"),
    "sliding": lambda ratio: suite.pyramid(k=6, mass_ratio=ratio, friction="coulomb", sliding=0.5),
    "slow": lambda ratio: suite.box_stack(n=5, mass_ratio=ratio, friction="coulomb", sliding=0.05),
}


@pytest.mark.parametrize("ratio", [1.0, 1e6])
@pytest.mark.parametrize("form", ["velocity", "impulse", "cone", "matrix", "auto"])
@pytest.mark.parametrize("name", BOXES)
def test_redundant_boxes_cold_at_every_mass_ratio(name, form, ratio):
    problem = BOXES[name](ratio).problem
    if form == "cone" or form == "matrix":
        problem = problem.relaxed("cone") if form == "cone" else as_matrix(problem)
    asked = {"form": form} if form in ("velocity", "impulse") else {}
    solution = lv.solve(problem, "auto" if form == "auto" else "newton", tol=1e-8, **asked)
    assert good(solution, 1e-8), solution
    assert not asked or solution.solver.form == form


def test_newton_under_the_cone_law_continues_where_the_first_interior_point_stops():
    problem = suite.pyramid(k=30, friction="coulomb").problem.relaxed("cone")
    solution = lv.solve(problem, "newton", tol=1e-9)
    assert good(solution, 1e-9), solution


@pytest.mark.parametrize(("layers", "ratio"), [(5, 1e6), (7, 1e6), (6, 1e5), (6, 1e7)])
def test_sliding_pyramid_under_cone_law_needs_third_proximal_weight(layers, ratio):
    pyramid = suite.pyramid(k=layers, mass_ratio=ratio, friction="coulomb", sliding=0.5).problem
    solution = lv.solve(pyramid.relaxed("cone"), "newton", tol=1e-8, max_iter=300)
    assert good(solution, 1e-8), solution


SLIDING_PILE = "granularF(n=4, sliding=2, seed=10)"  # Four of its 293 contacts slide.


def run_newton_claim(problem, budget=300, impulse=None):
    """Run `newton` without `auto` and the judge; return its claim and the impulse."""
    system = make_system(problem, "velocity" if problem.matrix is None else "impulse")
    impulse = (problem.start() if impulse is None else impulse).copy()
    return Newton().run(NewtonState(problem, system), impulse, budget, 1e-6, None), impulse


def test_euler_steps_pile_slides_solves_coulomb_and_shifted_cone_law():
    problem = suite.case(SLIDING_PILE).problem
    claim, impulse = run_newton_claim(problem)
    assert claim.status is Status.CONVERGED, claim
    assert lv.residual(problem, impulse).relative <= 1e-6
    # De Saxce: with the normals lowered by mu |v_t| the impulse solves the cone law.
    matrix = as_matrix(problem)
    slack = matrix.matrix @ impulse - matrix.b
    normal = problem.cones.normal_rows
    tangents = slack.reshape(-1, 3)[:, 1:]
    shift = problem.cones.mu * np.linalg.norm(tangents, axis=1)
    b = matrix.b.copy()
    b[normal] -= shift
    assert np.count_nonzero(shift > 1e-3 * np.abs(slack).max()) >= 3
    shifted = lv.Problem(b, problem.cones, matrix.matrix, friction="cone")
    # Both laws have other references and metrics of the same error: a factor of ten.
    assert lv.residual(shifted, impulse).relative <= 1e-5


def test_newton_from_the_convex_solution_solves_a_pyramid_of_which_most_contacts_slide():
    problem = suite.case("pyramidF(k=8, sliding=0.5)").problem
    convex = lv.solve(problem.relaxed("cone"), "newton", tol=1e-8).impulse
    claim, _ = run_newton_claim(problem, impulse=convex)
    assert claim.status is Status.CONVERGED, claim


def test_newton_claims_of_a_symmetric_matrix_and_a_slightly_asymmetric_one_are_true():
    problem = suite.case(SLIDING_PILE).problem
    matrix = as_matrix(problem).delassus().toarray()
    skew = np.random.default_rng(1).normal(size=matrix.shape) * 1e-7 * matrix.diagonal().mean()
    symmetric = lv.Problem(problem.b, problem.cones, matrix, friction="coulomb")
    asymmetric = lv.Problem(problem.b, problem.cones, matrix + skew - skew.T, friction="coulomb")
    convex = lv.solve(problem.relaxed("cone"), "newton", tol=1e-8).impulse
    for given_problem in (symmetric, asymmetric):
        claim, impulse = run_newton_claim(given_problem, budget=60, impulse=convex)
        assert (claim.status is Status.CONVERGED) == (
            lv.residual(given_problem, impulse).relative <= 1e-6
        ), claim
        assert claim.status is Status.CONVERGED or given_problem is asymmetric


def test_newton_sliding_pyramid_of_unequal_masses_needs_the_last_euler_steps():
    """Paths with other ratios of smoothing end at 2e-5 after 2,500 factorisations."""
    problem = lv.suite.case("pyramidF(k=12, sliding=2, mass_ratio=1e6)").problem
    solution = lv.solve(problem, "newton", tol=1e-8)
    assert good(solution, 1e-8), solution


def test_newton_pyramid_with_slip_needs_euler_steps():
    """Without Euler steps, 360 factorisations end at 9e-6."""
    problem = lv.suite.case("pyramidF(k=14)").problem
    solution = lv.solve(problem, "newton", tol=1e-6, max_iter=150)
    assert solution.success
    assert lv.residual(problem, solution.impulse).relative <= 1e-6
