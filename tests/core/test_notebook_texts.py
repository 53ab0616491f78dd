"""Short texts, tables and figures of results in a notebook, and completion of names in namespaces."""

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
    assert [text.get_text() for text in worst.get_yticklabels()][
        -1
    ] == f"{solution.residual.worst_name} [m/s]"
    np.testing.assert_array_equal(history.lines[0].get_ydata(), solution.history.relative)


def test_repr_of_results_has_one_line_with_their_numbers(problem, solution, tmp_path):
    with lv.io.Recorder(tmp_path, every=1) as recorder:
        recorder.add(problem, solution.impulse)
        texts = {
            f"relative {solution.residual.relative:.2e}": repr(solution.residual),
            f"{len(solution.history.iterations)} records": repr(solution.history),
            "8 contacts and 2 other blocks, 10 rows": repr(problem.cones + lv.Cones.free(2)),
            "pgs for <Problem 'toy_stack'": repr(lv.prepare(problem, "pgs")),
            "1 steps, 1 files": repr(recorder),
            "2 agree": repr(lv.cross_check(problem, ["direct", "pgs"])),
        }
    for part, text in texts.items():
        assert part in text and "\n" not in text and len(text) < 200


def test_repr_html_has_the_numbers_of_a_result(problem, solution):
    floor = f"{solution.residual.roundoff_floor:.1e}"
    assert floor in solution._repr_html_() and floor in solution.residual._repr_html_()
    html = lv.cross_check(problem, ["direct", "pgs"])._repr_html_()
    assert html.count("<tr") == 3 and "agrees" in html


def test_solutions_as_a_table_of_pandas_and_of_html_have_the_numbers_of_each_world(problem):
    bad = lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [2.0, -1.0])
    many = lv.solve_many([problem, bad, problem], "pgs")
    table = many.to_pandas()
    assert list(table["status"]) == [s.name for s in many.status] and len(table) == 3
    for name in ("relative", "energy", "velocity_error", "roundoff_floor", "iterations", "success"):
        np.testing.assert_array_equal(table[name], getattr(many, name))
    assert list(table["worst_row"]) == [many[i].residual.worst_name for i in range(3)]
    html = many._repr_html_()
    assert "1, relative residual" in html and "2 to 1e-06" in html and "STALLED 1" in html
    assert len(lv.solve_many([], "pgs").to_pandas()) == 0
