"""`python -m benchmarks stand`: towers in ours and in others' engines."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import lavender as lv
from benchmarks.stand import ENGINES, Line, Tower, command, has_fallen, measure, missing, table


@pytest.mark.parametrize("name", ENGINES)
def test_a_box_stands_in_every_engine_that_is_installed(name):
    if missing(name):
        with pytest.raises(lv.InputError, match=name):
            measure(name, Tower(1, 1 / 60))
        pytest.skip(missing(name))
    found = measure(name, Tower(1, 1 / 60, seconds=3.0))
    # one box on a plane: soft contacts sink before two seconds are over
    assert found.stands and 0.0 <= found.drift < 1e-3 and found.cost > 0.0
    assert (found.boxes, found.dt, found.seconds) == (1, 1 / 60, 3.0)
    assert (found.sweeps > 0) == bool(ENGINES[name].sweeps) and found.substeps >= 1


def test_ours_is_what_the_scene_says_and_its_centres_are_the_boxes():
    asked = Tower(3, 1 / 60, sweeps=8, substeps=2, order="top_down", seconds=3.0)
    found = measure("lavender", asked)
    assert (found.engine, found.sweeps, found.substeps) == ("lavender, top_down", 8, 2)
    engine = ENGINES["lavender"].make(asked)
    np.testing.assert_allclose(engine.centres(), [[0, 0, 0.5], [0, 0, 1.5], [0, 0, 2.5]], atol=1e-12)
    sim = lv.Simulation(lv.Scene("stack", n=3, dt=1 / 60, solver_iterations=8, substeps=2, order="top_down"))
    for _ in range(5):
        engine.engine.step()
        seen = sim.step()[0]
    np.testing.assert_array_equal(engine.centres(), seen["positions"][1:])


def test_a_tower_that_falls_is_said_to_fall():
    # ten boxes on four sweeps of whole steps in one direction
    found = measure("lavender", Tower(10, 1 / 60, 4, 1, "given", 20.0))
    assert not found.stands and 2.0 < found.stood < 20.0 and found.drift > 0.1
    assert "**fell at" in table([found])


def test_a_tower_has_fallen_when_a_box_is_half_an_edge_lower_and_not_when_it_has_moved_sideways():
    start = np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 1.5]])
    for move, fallen in (
        ((3.0, 0.0, 0.0), False),
        ((0.0, 0.0, 0.6), False),
        ((0.0, 0.0, -0.49), False),
        ((0.0, 0.0, -0.51), True),
        ((np.nan, np.nan, np.nan), True),
    ):
        assert has_fallen(start, start + np.array([[0.0, 0.0, 0.0], move])) == fallen
        assert has_fallen(start, start + np.array([move, [0.0, 0.0, 0.0]])) == fallen


def test_the_command_prints_the_map_and_writes_the_lines(tmp_path):
    out = tmp_path / "stand.json"
    words = ["--engines", "lavender,newton", "--boxes", "2", "--sweeps", "4", "--rates", "60", "--substeps", "0",
             "--seconds", "3", "--out", str(out)]  # fmt: skip
    result = CliRunner().invoke(command, words, catch_exceptions=False)
    assert result.exit_code == 0 and "| 2 | 1/60 | lavender | 4 | 4 | 960 | 3 |" in result.output
    kept = json.loads(out.read_text())
    assert [x["engine"] for x in kept["lines"]] == ["lavender", "lavender newton"]
    assert Line(**kept["lines"][0]).stands
