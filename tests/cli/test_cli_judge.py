"""`lavender judge`: one stored answer, row by row."""

import json
from dataclasses import replace

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


def test_judge_shows_bodies_and_gaps(lavender, problem, tmp_path):
    names = [f"contact {k} (crate {k}, shelf)" for k in range(problem.n_blocks)]
    named = replace(problem, names=tuple(names))
    gap = np.linspace(-2e-3, 1e-3, problem.n_blocks)
    early = lv.solve(named, "pgs", max_iter=5).impulse
    lv.io.save(named, tmp_path / "named.npz", impulse=early, gap=gap)
    assert lv.io.read(tmp_path / "named.npz").gap.tolist() == gap.tolist()
    _, out, _ = lavender("judge", tmp_path / "named.npz", "--csv", tmp_path / "rows.csv")
    table = pd.read_csv(tmp_path / "rows.csv").set_index("row")
    for k, name in enumerate(names):
        assert table.loc[f"{name}, normal", "gap [mm]"] == pytest.approx(1e3 * gap[k])
        assert table.loc[f"{name}, normal", "bodies"] == f"crate {k} and shelf"
        assert np.isnan(table.loc[f"{name}, tangent 1", "gap [mm]"])
    assert "gap" in out
    with pytest.raises(lv.InputError, match=r"gap \[m\] has shape"):
        lv.io.save(named, tmp_path / "bad.npz", gap=gap[1:])
    with pytest.raises(lv.InputError, match=r"npz is needed"):
        lv.io.save(named, tmp_path / "bad.h5", gap=gap)


def test_judge_of_recorded_steps_of_mujoco_has_the_distances_of_its_contacts(lavender, tmp_path):
    mujoco = pytest.importorskip(
        "mujoco", reason="needs MuJoCo: pip install 'lavender-contact[mujoco]'"
    )
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><geom type="plane" size="0 0 1"/>
      <body pos="0 0 .0995"><freejoint/><geom name="box" type="box" size=".1 .1 .1"/></body></worldbody></mujoco>""")
    lv.io.record(model, mujoco.MjData(model), tmp_path / "steps", 3)
    data = mujoco.MjData(model)
    for step in range(1, 4):
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        stored = lv.io.read(tmp_path / "steps" / f"step_{step}.npz")
        wanted = np.repeat(data.contact.dist, 4)  # Edges of pyramids.
        np.testing.assert_allclose(stored.gap, wanted, rtol=1e-12)
    path = tmp_path / "steps" / "step_3.npz"
    assert lavender("judge", path, "--csv", tmp_path / "rows.csv")[0] == 0
    table = pd.read_csv(tmp_path / "rows.csv")
    assert table["gap [mm]"].min() == pytest.approx(1e3 * wanted.min(), rel=1e-9)
    assert set(table["bodies"]) == {"0 and box"}
