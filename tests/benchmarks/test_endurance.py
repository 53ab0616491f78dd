"""Scenes of the gallery over some seconds: nothing is lost, nothing gains energy, what stands stands still.

The short form of `python -m benchmarks gallery`, which runs ten minutes.
"""

import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks import gallery
from benchmarks.gallery import table
from lavender.sim.scene import SCENES

SECONDS = 5.0
STANDING = {"stack", "card_house", "heavy_on_light", "table", "ramp", "pyramid"}
SMALLER = {"pyramid": {"base": 5}, "pile": {"n": 30, "kind": "mixed"}}  # the same with less to compute


@pytest.mark.parametrize("rate", gallery.STEPS_PER_SECOND)
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_of_the_gallery_keeps_its_energy_and_its_place(name, rate):
    found = gallery.stay(name, 1.0 / rate, SECONDS, **SMALLER.get(name, {}))
    assert (found.lost, found.failed, found.seconds) == ("", 0, pytest.approx(SECONDS))
    # What the projection lifts: a slop for each body's weight, and a thousandth of what moves in impacts.
    weight = sum(b.mass for b in lv.Scene(name, **SMALLER.get(name, {})).bodies) * 9.81
    assert found.gain <= 1e-3 * weight + 1e-3 * abs(found.start)
    assert found.end <= found.start + 1e-3 * weight
    assert found.depth < 5e-3
    if name in STANDING:
        assert found.drift < 5e-3


@pytest.mark.parametrize("name", ["bridge", "four_bar", "stack", "heavy_on_light"])
def test_newton_keeps_them_too(name):
    # A second of the bridge, of which every step is a hundred joints and contacts, costs what the others take.
    found = gallery.stay(name, 1 / 60, 1.0 if name == "bridge" else 2.5, solver="newton")
    # one step of the bridge, joints and friction together, ends at 1.6e-6 for 1e-6 when its iterations are used up
    assert found.lost == "" and found.failed <= (name == "bridge")
    assert found.gain <= 1e-2 * abs(found.start)


def test_energy_is_that_of_the_textbook():
    # a box of 1 x 2 x 3 m and 12 kg at 5 m, turning by 2 rad/s about its first axis, which looks along y
    scene = lv.Scene(gravity=10.0)
    half = np.sqrt(0.5)
    scene.add_plane()
    scene.add_box(
        (1, 2, 3),
        12.0,
        position=(0, 0, 5),
        quaternion=(half, 0, 0, half),
        velocity=(3, 0, 4),
        angular_velocity=(0, 2, 0),
    )
    observation = lv.Simulation(scene).reset()[0]
    expected = 0.5 * 12 * 25 + 0.5 * (4 + 9) * 4 + 12 * 10 * 5
    assert gallery.energy(scene, observation) == pytest.approx(expected, rel=1e-14)


def test_a_lost_scene_says_so_and_the_command_writes_its_table():
    words = ["spinner", "ramp", "--seconds", "0.5"]
    done = CliRunner().invoke(gallery.command, words, catch_exceptions=False)
    assert done.exit_code == 0
    printed = done.output.splitlines()
    assert len(printed) == 6 and printed[0].startswith("| scene")
    assert [line.split(" | ")[0] for line in printed[2:]] == ["| spinner"] * 2 + ["| ramp"] * 2
    fast = gallery.stay("ramp", 1 / 60, 1.0, gravity=1e60)
    assert fast.lost == "box 1" and "| box 1 |" in table([fast])
    for words in (["--seconds", "0"], ["no_such_scene"], ["--solvers", "nwton", "ramp"]):
        assert isinstance(CliRunner().invoke(gallery.command, words).exception, lv.LavenderError)


def test_newton_swings_the_redundant_loop_where_no_projection_moves_its_rows_apart():
    found = gallery.stay("four_bar", 1 / 120, 3.0, solver="newton", position_iterations=0)
    assert (found.lost, found.failed) == ("", 0)
    assert found.drift > 0.1  # m
