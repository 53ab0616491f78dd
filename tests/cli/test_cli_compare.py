"""`lavender compare`."""

import json

import pytest

pytest.importorskip("mujoco", reason="needs MuJoCo: pip install 'lavender-contact[peers]'")

BOX = """<mujoco><option timestep="0.002" gravity="3 0 -9" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="9 9 .1"/><body name="box" pos="0 0 .0999"><freejoint name="box"/>
  <geom name="box" type="box" size=".1 .1 .1" {}/></body></worldbody></mujoco>"""


@pytest.fixture
def models(tmp_path):
    for name, extra in (("soft", 'solref="0.05 1"'), ("stiff", "")):
        (tmp_path / f"{name}.xml").write_text(BOX.format(extra))
    return tmp_path


def test_compare_names_the_cause_and_what_to_try(lavender, models):
    code, output, error = lavender(
        "compare", models / "stiff.xml", models / "soft.xml", "--steps", 5
    )
    assert code == 0, error
    assert "compare: stiff and soft, one step of 2 ms" in output
    assert "softness" in output and "solref 0.02 1 and solref" in output
    assert "falls by 100 %" in output


def test_compare_with_an_option_changes_a_copy_of_the_model(lavender, models):
    code, output, error = lavender(
        "compare", models / "stiff.xml", "--option", "cone=pyramidal", "--steps", 9
    )
    assert code == 0, error
    assert "friction" in output and "cone of" in output


def test_compare_of_one_model_compares_with_the_rigid_laws_in_smaller_steps(lavender, models):
    page = models / "page"
    code, output, error = lavender("compare", models / "stiff.xml", "--steps", 40, "--out", page)
    assert code == 0, error
    assert "against the rigid laws in 16 smaller steps" in output
    (state,) = json.loads((page / "numbers.json").read_text(encoding="utf-8"))["states"]
    assert {"mean", "alone_in_a", "alone_in_b"} <= set(state["parts"]["time step"])


def test_compare_writes_a_page_with_a_picture_and_all_numbers(lavender, models):
    page = models / "page"
    code, _, error = lavender(
        "compare", models / "stiff.xml", models / "soft.xml", "--steps", 5, "--out", page
    )
    assert code == 0, error
    assert "<svg" in (page / "index.html").read_text(encoding="utf-8")
    assert (page / "figures" / "waterfall-0.png").is_file()
    (state,) = json.loads((page / "numbers.json").read_text(encoding="utf-8"))["states"]
    total = [b - a for a, b in zip(state["velocity_a"], state["velocity_b"], strict=True)]
    parts = [sum(x) for x in zip(*(p["mean"] for p in state["parts"].values()), strict=True)]
    assert parts == pytest.approx(total, abs=1e-13)


def test_compare_of_a_stored_step_equals_the_comparison_of_models(lavender, models):
    step = models / "step.npz"
    code, direct, error = lavender(
        "compare", models / "stiff.xml", models / "soft.xml", "--steps", 5, "--save", step
    )
    assert code == 0, error
    code, stored, error = lavender("compare", step, models / "soft.xml")
    assert code == 0, error

    def read_numbers(text):
        return [
            line.split("(")[0] for line in text.splitlines() if line.startswith("   softness  ")
        ]

    assert read_numbers(stored) == read_numbers(direct) != []


@pytest.mark.parametrize(("arguments", "words"), [
    (("--option", "cone"), "NAME=VALUE"),
    (("--option", "shape=round"), "shape"),
    (("--option", "cone=square"), "square"),
    (("--option", "timestep=0.001"), "time step"),
])  # fmt: skip
def test_compare_with_a_wrong_option_names_it(arguments, words, lavender, models):
    code, _, error = lavender("compare", models / "stiff.xml", *arguments)
    assert code == 2 and words in error
