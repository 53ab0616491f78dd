"""`lavender slip`."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[peers]'")

SLOPE = """<mujoco><option timestep="0.002" gravity="5.5 0 -8.1" cone="elliptic"/><worldbody>
  <geom name="slope" type="plane" size="9 9 .1" friction="0.5 0.005 0.0001"/>
  <body pos="0 0 .05"><freejoint/><geom name="box" type="box" size=".2 .2 .05" friction="0.5 0.005 0.0001"/></body>
  </worldbody></mujoco>"""


def test_the_table_names_the_cause(lavender, tmp_path):
    (tmp_path / "slope.xml").write_text(SLOPE)
    code, output, error = lavender("slip", tmp_path / "slope.xml", "--steps", 15)
    assert code == 0, error
    assert "slope, box" in output and "sliding at the friction limit" in output
    code, output, error = lavender("slip", tmp_path / "slope.xml", "--steps", 15, "--contact", "hand")
    assert code == 2 and "hand" in error


def test_no_contact_is_stated(lavender, tmp_path):
    (tmp_path / "air.xml").write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    code, output, _ = lavender("slip", tmp_path / "air.xml")
    assert code == 1 and "no contact with friction" in output
    assert lavender("slip", tmp_path / "air.xml", "--steps", 0)[0] == 2


def test_a_geom_that_touches_nothing_is_named(lavender, tmp_path):
    (tmp_path / "slope.xml").write_text(SLOPE.replace("0 0 .05", "0 0 5"))
    code, output, _ = lavender("slip", tmp_path / "slope.xml", "--contact", "box")
    assert code == 1 and "'box' touches nothing with friction in these states." in output


def test_settings_are_shown_with_the_slip_that_they_leave(lavender, tmp_path):
    (tmp_path / "slope.xml").write_text(SLOPE.replace("5.5 0 -8.1", "2 0 -9"))
    code, output, _ = lavender("slip", tmp_path / "slope.xml", "--steps", 100)
    table, helpful = output.split("Settings that help (mean slip in the next 25 steps, ")
    assert code == 0 and '  <option noslip_iterations="20"/>: ' in helpful.splitlines()[1]
    assert "simulated from 1 state" in table
    assert table.count("<option") == 3 and 'solref="0.004 1" of all geoms' in table


def test_a_narrow_terminal_keeps_names_and_causes_whole(lavender, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    long_name = "left_finger_of_the_long_gripper"
    (tmp_path / "slope.xml").write_text(SLOPE.replace('"box" type', f'"{long_name}" type'))
    code, output, error = lavender("slip", tmp_path / "slope.xml", "--steps", 15)
    assert code == 0, error
    table = output.partition("slip: mean")[0]
    assert long_name in table and {"sliding", "at", "the", "friction", "limit"} <= set(table.split())
    assert max(map(len, output.splitlines())) <= 80


def test_the_sentence_names_the_state_of_several(lavender, tmp_path):
    """The second state is in the air; the third slides fastest."""
    (tmp_path / "slope.xml").write_text(SLOPE)
    qpos = np.tile([0.0, 0.0, 0.049, 1.0, 0.0, 0.0, 0.0], (3, 1))
    qpos[1, 2] = 5.0
    qvel = np.zeros((3, 6))
    qvel[2, 0] = 1.0
    np.savez(tmp_path / "states.npz", qpos=qpos, qvel=qvel)
    code, output, error = lavender("slip", tmp_path / "slope.xml", "--states", tmp_path / "states.npz")
    assert code == 0, error
    assert "State 2 (counted from 0) has the fastest contact:" in output and "points of 2 states" in output
