"""`newton`, `admm` and `auto` on built-in problems, whose structure these properties need."""

from itertools import pairwise

import pytest
from random_families import wild
from random_problems import as_matrix, good

import lavender as lv
from lavender import registry, suite
from lavender.suite import box_stack


@pytest.mark.parametrize(("ratio", "speed"), [(1.0, 0.5), (1e3, 0.0), (1e3, 0.5), (1e6, 0.5)])
def test_coulomb_with_mass_ratios(ratio, speed):
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
def test_turns_say_what_ran_and_what_came_of_it(problem):
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


def test_a_looser_tolerance_costs_no_more():
    problem = suite.granular(n=6, friction="coulomb", seed=8).problem
    found = [lv.solve(problem, tol=tol) for tol in (1e-3, 1e-4)]
    assert all(solution.success for solution in found), found
    # A check ends sweeps where too many are predicted to be left at that tolerance: others then begin later.
    for loose, tight in pairwise(solution.work["sweeps"] for solution in found):
        assert loose <= 2.0 * tight, found


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
    if asked and problem.law == "lcp":
        assert solution.work["factorisations"] <= 30 and solution.solver.form == form


@pytest.mark.parametrize(
    ("name", "case"), [("newton", "pyramidF(k=4)"), ("auto", "pyramidF(k=4, mass_ratio=1e3)")]
)
def test_ctrl_c_returns_the_best_iterate(name, case, interrupted_newton):
    """Interrupted after the fifth turn: what was found until then is kept, and `auto` begins nothing more."""
    looks = interrupted_newton
    solution = lv.solve(lv.suite.case(case).problem, name, tol=1e-12)
    assert solution.status is lv.Status.INTERRUPTED
    assert len(looks) == 5
    assert min(looks) < 1.0 and solution.residual.energy < solution.residual.energy_at_zero
    assert solution.residual.relative < 1.0


def test_faces_under_the_cone_law_where_the_first_interior_point_stops_short():
    problem = suite.pyramid(k=30, friction="coulomb").problem.relaxed("cone")
    solution = lv.solve(problem, "newton", tol=1e-9)
    assert good(solution, 1e-9), solution
    assert solution.work["factorisations"] <= 300, solution
