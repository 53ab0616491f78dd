"""Solvers on problems of structures drawn by lot (`random_families`)."""

import pytest
from calls import check
from random_problems import as_matrix, good

import lavender as lv
from benchmarks.random_families import wild
from lavender import registry


def test_admm_under_a_short_limit_forms_no_matrix():
    """A of J and M is not formed, and a matrix of many entries not analysed, where that would end too late."""
    problem = wild(seed=109, rows=3000).problem
    assert problem.operator == "generalized"
    late = lv.solve(problem, "admm", time_limit=1e-4)
    assert late.status is lv.Status.TIME_LIMIT and late.iterations == 0 and not late.work
    assert not {"csr", "csr_data"} & set(problem.__dict__)
    assert late.impulse.tobytes() == problem.start().tobytes()
    prepared = lv.prepare(problem, "admm")
    assert prepared.solve(time_limit=1e-4).status is lv.Status.TIME_LIMIT
    after = prepared.solve(max_iter=5)
    whole = lv.solve(problem, "admm", max_iter=5)
    assert after.work == whole.work and after.impulse.tobytes() == whole.impulse.tobytes()


# Few rows on which exchanges or Newton's method alone do not end: asymmetric, with joints, symmetric, nearly singular,
# and forests under Coulomb's law.
@pytest.mark.parametrize("seed", [7530, 7845, 4691, 7514, 7375, 6662, 7021, 7597, 1224])
def test_auto_solves_few_rows_that_one_solver_alone_does_not(seed):
    assert check(wild(seed=seed).problem, "auto", tol=1e-6).success


@pytest.mark.parametrize(
    ("seed", "sweeps", "most", "words"),
    [
        # From swept impulses exchanges take few; from nothing 8 to 18.
        *((seed, 60, 4, ()) for seed in (6, 70, 239, 3146)),
        # Joints that nearly depend on each other; interior points take 23 to 35.
        *((seed, 0, 2, ()) for seed in (5080, 5229, 177, 5122)),
        (242, 0, 1, ()),
        # Rows that depend on each other: exchanges that go in circles are given up.
        (3, 0, 28, ("exchanges", "interior point steps")),
        # An asymmetric matrix; from a start that leads nowhere it begins from nothing in the end: 170, else 6.
        (807, 0, 39, ()),
        (807, 64, 399, ()),
    ],
)
def test_newton_on_drawn_problems_takes_few_factorisations(seed, sweeps, most, words):
    problem = wild(seed=seed, rows=120 if seed == 807 else 3000).problem
    start = None
    if sweeps:
        problem = as_matrix(problem)
        start = lv.solve(problem, "anderson", tol=0.0, max_iter=sweeps).impulse
    solution = lv.solve(problem, "newton", impulse=start, tol=1e-6)
    assert good(solution, 1e-6) and solution.work["factorisations"] <= most, solution
    assert all(word in solution.message for word in words)
    assert seed == 807 or not (sweeps and "sweeps" in solution.work)


@pytest.mark.parametrize("solver", ["auto", "direct"])
@pytest.mark.parametrize("seed", [5793, 6452, 7592])
def test_small_bounded_rows_that_depend_on_each_other_are_one_shift(solver, seed):
    problem = wild(seed=seed).problem
    found = check(problem, solver, tol=1e-9)
    assert found.success
    assert found.work["shifts"] == 1
    assert registry.get(solver).small.call.solve(problem, None, 1e-9)[0] is not None
