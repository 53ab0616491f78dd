"""Extreme problems are measured by numbers, and claims about slow ones are confirmed."""

import hypothesis.strategies as st
import numpy as np
import pytest
from extreme_problems import build_problem, problem_data
from hypothesis import given, reject

import lavender as lv

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
