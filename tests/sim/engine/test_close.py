"""`Simulation` as a context manager: `close` ends films and viewers, and later calls are refused."""

import urllib.error
import urllib.request

import pytest

import lavender as lv


def test_a_closed_simulation_refuses_calls_and_still_tells_its_settings():
    with lv.Simulation(lv.Scene("stack", n=2, solver_iterations=7)) as sim:
        state = sim.snapshot()
        sim.step()
    calls = (
        sim.step, sim.reset, sim.snapshot, sim.constraint_problem, sim.residual, sim.start_film,
        lambda: sim.restore(state), lambda: sim.set_velocity(1, (1.0, 0.0, 0.0)), lambda: sim.film(2),
        lambda: sim.frames("x.png"), lambda: sim.set_warm_start(False), lambda: sim.view(browser=False),
    )  # fmt: skip
    for call in calls:
        with pytest.raises(lv.LavenderError, match="closed"):
            call()
    assert (sim.steps, sim.time, sim.solver_iterations, sim.warm_start) == (1, 1 / 120, 7, True)
    sim.close()  # once more


def test_close_ends_films_and_viewers_in_whatever_order():
    sim = lv.Simulation(lv.Scene("stack", n=2))
    film = sim.start_film()
    first, second = sim.view(browser=False), sim.view(browser=False)
    sim.step()
    first.close()
    sim.close()
    assert film.ended and first.film.ended and second.film.ended and sim.films == []
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(second.address, timeout=5)
    assert len(film) == len(second.film) == 2
    sim.end_film(film)
    second.close()


def test_an_error_inside_the_block_closes_and_passes_on():
    with pytest.raises(ZeroDivisionError), lv.Simulation("stack") as sim:
        raise ZeroDivisionError
    with pytest.raises(lv.LavenderError, match="closed"):
        sim.step()


def test_close_from_inside_a_step_is_refused(plug_in):
    refused = []

    def run(problem, impulse):
        for call in (sim.close, lambda: sim.end_film(film)):
            with pytest.raises(lv.LavenderError, match="inside a step"):
                call()
            refused.append(call)
        return lv.Claim(lv.Status.MAX_ITERATIONS, 1)

    plug_in(run, "closer", supports_rolling=True)
    sim = lv.Simulation(lv.Scene("stack", n=2, solver="closer"))
    film = sim.start_film()
    sim.step()
    assert len(refused) == 2 and not film.ended
    sim.step()
