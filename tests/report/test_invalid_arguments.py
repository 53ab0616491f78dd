"""Extreme problems are measured by numbers, and claims about slow ones are confirmed."""

import hypothesis.strategies as st
import numpy as np
import pytest
from extreme_problems import build_problem, problem_data
from hypothesis import assume, given, reject
from random_problems import nearly_singular, seeds, warmed
from worked import after

import lavender as lv
from benchmarks.random_families import wild
from lavender import suite
from lavender.suite import hard

# -- extreme numbers ------------------------------------------------------------------------------------------------

MEASURES = ("kinetic", "energy", "speed", "spin", "rows")


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(data=problem_data(), exponent=st.integers(-1070, 1020))
def test_motion_errors_and_ranks_of_extreme_problems_are_numbers(data, exponent):
    """A motion error is finite, or its `note` says why there is none."""
    try:
        problem = build_problem(data)
    except lv.InputError:
        reject()
    for impulse in (np.full(problem.m, 2.0**exponent), lv.solve(problem).impulse):
        if not np.isfinite(impulse).all():
            continue
        error = lv.motion_error(problem, impulse)
        values = {name: getattr(error, name) for name in MEASURES}
        assert [name for name, value in values.items() if value is not None and not np.isfinite(value)] == []
        assert error.relative is None or np.isfinite(error.relative) or error.note
        assert str(error)
    if problem.m and problem.is_symmetric:
        result = lv.redundancy(problem)
        assert 0 <= result.rank == problem.m - len(result.rows)


#: Scenes and their parameters, of which one value each is drawn.
SCENES = {
    "stack": {"n": (3, 6, 10)}, "pyramid": {"base": (3, 4)}, "card_house": {"levels": (2, 3)}, "chain": {"n": (5, 20)},
    "bridge": {"n": (6, 12)}, "heavy_on_light": {"ratio": (1.0, 10.0, 1e3)}, "table": {"legs": (3, 4, 9)},
    "four_bar": {}, "ramp": {"angle": (0.1, 0.35, 0.6)}, "pile": {"n": (8, 16)},
}  # fmt: skip


@st.composite
def slow_problems(draw):
    """A problem on which sweeps creep, stop or diverge, and its name."""
    source, seed = draw(st.sampled_from(("scene", "scene", "hard", "singular", "wild", "warm"))), draw(seeds)
    if source == "scene":
        name = draw(st.sampled_from(sorted(SCENES)))
        parameters = {key: draw(st.sampled_from(values)) for key, values in SCENES[name].items()}
        parameters["solver_iterations"] = draw(st.sampled_from((4, 8, 16, 32)))
        return after(draw(st.integers(1, 120)), name, **parameters).constraint_problem()
    if source == "hard":
        return suite.case(draw(st.sampled_from(hard.SET))).problem
    if source == "singular":
        return nearly_singular(seed)
    problem = wild(seed=seed % 10**6, rows=200).problem
    return problem if source == "wild" else warmed(problem, seed) or problem


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(
    problem=slow_problems(),
    solver=st.sampled_from(lv.available(external=False, resumable=True)),
    tol=st.sampled_from((1e-6, 1e-6, 1e-9, 1e-12)),
    max_iter=st.sampled_from((None, None, None, 200, 3000)),
)
def test_claims_of_iterative_solvers_that_make_little_progress_are_confirmed(problem, solver, tol, max_iter):
    assume(0 < problem.m <= 700 and not lv.get(solver).refuses(problem))
    solution = lv.solve(problem, solver, tol=tol, **({} if max_iter is None else {"max_iter": max_iter}))
    assert solution.claim_check == "confirmed", solution.status_conflict
    assert np.isnan(solution.sweeps_per_decade) or 0.0 < solution.sweeps_per_decade < np.inf
