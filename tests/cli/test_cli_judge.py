"""`lavender judge`: one stored answer, row by row."""

import json

import numpy as np
import pandas as pd
import pytest

import lavender as lv
from lavender import cli


@pytest.fixture
def problem():
    return lv.suite.case("box_stackF(n=2)").problem


def test_judge_prints_the_rows_with_the_largest_errors_first(lavender, problem, tmp_path):
    early = lv.solve(problem, "pgs", max_iter=5)
    path = tmp_path / "early.npz"
    lv.io.save(problem, path, impulse=early.impulse)
    code, out, _ = lavender("judge", path, "--rows", "3", "--csv", tmp_path / "rows.csv")
    judged = early.residual
    assert code == cli.EXIT_UNMET and "stopped before convergence" in out
    table = pd.read_csv(tmp_path / "rows.csv")
    assert len(table) == problem.m and f"{problem.m - 3} of {problem.m} rows" in out
    assert table["row"][0] == judged.worst_name and judged.worst_name in out
    order = np.argsort(-judged.velocity_by_row, kind="stable")
    np.testing.assert_allclose(table["impulse [N s]"], early.impulse[order], rtol=1e-12)
    np.testing.assert_allclose(
        table["error [m/s, rad/s]"], judged.velocity_by_row[order], rtol=1e-9
    )
    exact = np.empty(problem.m)
    exact[order] = table["exact [N s]"]
    assert lv.residual(problem, exact).relative <= 1e-8
    assert set(table["bodies"]) == {"ground and body 0", "body 0 and body 1"}
    code, out, _ = lavender("judge", path, "--json")
    found = json.loads(out)
    assert found["verdict"] == judged.verdict and len(found["rows"]) == problem.m
    assert code == cli.EXIT_UNMET


def test_judge_of_a_solution_ends_with_0_and_names_the_unit_of_joints(lavender, tmp_path):
    problem = lv.suite.case("chain(n=4)").problem
    lv.io.save(problem, tmp_path / "done.npz", impulse=lv.solve(problem, tol=1e-12).impulse)
    code, out, _ = lavender("judge", tmp_path / "done.npz")
    assert code == 0 and "at its floor" in out and "row" in out


def test_judge_without_an_answer_names_what_is_needed(lavender, problem, tmp_path):
    lv.io.save(problem, tmp_path / "none.npz")
    code, _, err = lavender("judge", tmp_path / "none.npz")
    assert code == cli.EXIT_BAD_INPUT and "entry 'impulse'" in err and "lavender check" in err
