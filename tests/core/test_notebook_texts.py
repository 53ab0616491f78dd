"""Short texts, tables and figures of results in a notebook, and completion of names in namespaces."""

import importlib

import numpy as np
import pytest

import lavender as lv


@pytest.fixture(scope="module")
def problem():
    return lv.suite.case("toy_stack").problem


@pytest.fixture(scope="module")
def solution(problem):
    return lv.solve(problem, "pgs", tol=1e-8, history=True)


def test_plot_of_a_solution_shows_worst_rows_and_history(solution):
    worst, history = solution.plot(rows=3).axes
    widths = [bar.get_width() for bar in worst.patches]
    assert widths == sorted(solution.residual.velocity_by_row)[-3:]
    assert [text.get_text() for text in worst.get_yticklabels()][-1] == solution.residual.worst_name
    np.testing.assert_array_equal(history.lines[0].get_ydata(), solution.history.relative)
    with pytest.raises(lv.InputError, match="rows is 0"):
        solution.plot(rows=0)


@pytest.mark.parametrize("name", ["io", "suite", "report", "contract", "export", "engine", "scene"])
def test_completion_of_a_namespace_shows_public_names_only(name):
    module = importlib.import_module(getattr(lv, name).__name__)
    assert dir(module) == sorted(module.__all__)
