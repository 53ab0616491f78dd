"""`python -m benchmarks stand`: towers in ours and in others' engines."""

import numpy as np
import pytest

import lavender as lv
from benchmarks.stand import ENGINES, Tower, has_fallen, measure, missing


@pytest.mark.parametrize("name", ENGINES)
def test_bench_stand_of_a_box_at_rest_keeps_its_place_in_every_installed_engine(name):
    if missing(name):
        with pytest.raises(lv.InputError, match=name):
            measure(name, Tower(1, 1 / 60))
        pytest.skip(missing(name))
    found = measure(name, Tower(1, 1 / 60, seconds=3.0))
    # one box on a plane: soft contacts sink before two seconds are over
    assert found.stands and 0.0 <= found.drift < 1e-3 and found.cost > 0.0
    assert (found.boxes, found.dt, found.seconds) == (1, 1 / 60, 3.0)
    assert (found.sweeps > 0) == bool(ENGINES[name].sweeps) and found.substeps >= 1


def test_bench_stand_of_lavender_has_the_parameters_of_the_scene():
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


def test_bench_stand_has_fallen_of_a_lower_box_is_true_and_of_a_moved_box_false():
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
