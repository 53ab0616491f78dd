"""`Simulation` as a context manager: `close` ends it, and later calls are refused."""

import pytest

import lavender as lv


def test_closed_simulation_raises_and_keeps_its_settings():
    with lv.Simulation(lv.Scene("stack", n=2, solver_iterations=7)) as sim:
        state = sim.snapshot()
        sim.step()
    calls = (
        sim.step, sim.reset, sim.snapshot, sim.constraint_problem, sim.residual,
        lambda: sim.restore(state), lambda: sim.set_velocity(1, (1.0, 0.0, 0.0)), lambda: sim.set_warm_start(False),
    )  # fmt: skip
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


def test_close_from_inside_a_step_is_refused(plug_in):
    refused = []

    def run(problem, impulse):
        with pytest.raises(lv.LavenderError, match="inside a step"):
            sim.close()
        refused.append(sim.time)
        return lv.Claim(lv.Status.MAX_ITERATIONS, 1)

    plug_in(run, "closer", supports_rolling=True)
    sim = lv.Simulation(lv.Scene("stack", n=2, solver="closer"))
    sim.step()
    assert len(refused) == 1
    sim.step()
