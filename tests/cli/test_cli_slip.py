"""`lavender slip`."""

import pytest

pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[peers]'")

SLOPE = """<mujoco><option timestep="0.002" gravity="5.5 0 -8.1" cone="elliptic"/><worldbody>
  <geom name="slope" type="plane" size="9 9 .1" friction="0.5 0.005 0.0001"/>
  <body pos="0 0 .05"><freejoint/><geom name="box" type="box" size=".2 .2 .05" friction="0.5 0.005 0.0001"/></body>
  </worldbody></mujoco>"""


def test_slip_command_prints_the_cause(lavender, tmp_path):
    (tmp_path / "slope.xml").write_text(SLOPE)
    code, output, error = lavender("slip", tmp_path / "slope.xml", "--steps", 15)
    assert code == 0, error
    assert "slope, box" in output and "sliding at the friction limit" in output
    code, output, error = lavender(
        "slip", tmp_path / "slope.xml", "--steps", 15, "--contact", "hand"
    )
    assert code == 2 and "hand" in error


def test_slip_command_on_a_geom_without_contact_ends_with_1(lavender, tmp_path):
    (tmp_path / "slope.xml").write_text(SLOPE.replace("0 0 .05", "0 0 5"))
    code, output, _ = lavender("slip", tmp_path / "slope.xml", "--contact", "box")
    assert code == 1 and "'box' touches nothing with friction in these states." in output


@pytest.mark.parametrize(
    "command", [("slip", "--steps", 15), ("audit", "--worlds", 1, "--steps", 5)]
)
def test_command_makes_the_folders_of_its_page_and_rejects_a_file_in_their_place(
    command, lavender, tmp_path
):
    model = tmp_path / "slope.xml"
    page = tmp_path / "new" / "of" / "page"
    model.write_text(SLOPE)
    code, _, error = lavender(command[0], model, *command[1:], "--out", page)
    assert code in (0, 1), error
    assert (page / "index.html").is_file()
    code, _, error = lavender(command[0], model, *command[1:], "--out", model / "page")
    assert code == 2 and str(model) in error
