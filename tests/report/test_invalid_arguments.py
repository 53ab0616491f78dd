"""Extreme problems are measured by numbers."""

import hypothesis.strategies as st
import numpy as np
import pytest
from extreme_problems import build_problem, problem_data
from hypothesis import given, reject

import lavender as lv

MEASURES = ("kinetic", "energy", "speed", "spin", "rows")


@pytest.mark.fuzz
@pytest.mark.filterwarnings("error")
@given(data=problem_data(), exponent=st.integers(-1070, 1020))
def test_motion_errors_and_ranks_of_extreme_problems_are_numbers(data, exponent):
    """A motion error is finite, or its `note` has the reason."""
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
