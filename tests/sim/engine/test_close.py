"""`Simulation` as a context manager: `close` ends it, and later calls are refused."""

import pytest

import lavender as lv


def test_closed_simulation_raises_and_keeps_its_settings():
    with lv.Simulation(lv.Scene("stack", n=2, solver_iterations=7)) as sim:
        state = sim.snapshot()
        sim.step()
    calls = (
        sim.step,
        sim.reset,
        sim.snapshot,
        sim.constraint_problem,
        sim.residual,
        lambda: sim.restore(state),
        lambda: sim.set_velocity(1, (1.0, 0.0, 0.0)),
        lambda: sim.set_warm_start(False),
    )
    for call in calls:
        with pytest.raises(lv.LavenderError, match="closed"):
            call()
    assert (sim.steps, sim.time, sim.solver_iterations, sim.warm_start) == (1, 1 / 120, 7, True)
    sim.close()  # once more


def test_simulation_closes_when_its_block_raises():
    with pytest.raises(ZeroDivisionError), lv.Simulation("stack") as sim:
        raise ZeroDivisionError
    with pytest.raises(lv.LavenderError, match="closed"):
        sim.step()
