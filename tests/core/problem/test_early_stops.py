"""Stops before convergence in float32: the judge finds them, and calls no answer at its floor one."""

import numpy as np
from calls import robot
from early_stops import CUT, FLOOR, exchange, newton, planted

import lavender as lv


def test_early_stops_are_found_and_no_answer_at_its_floor_is_called_early():
    rng = np.random.default_rng(0)
    stops = [stop for seed in range(20) for stop in planted(robot(seed), rng)]
    for method in ("velocities", "impulses"):
        ended = [s for s in stops if s.kind == f"{method}: {FLOOR}"]
        cut = [s for s in stops if s.kind == f"{method}: {CUT}"]
        assert len(ended) == 20
        assert len(cut) > 15
        assert all(s.verdict == "at its floor" for s in ended)
        assert sum(s.verdict != "at its floor" for s in cut) >= 0.95 * len(cut)


def test_these_newtons_solve_in_float64_what_lavender_solves():
    p = robot(11)
    want = lv.solve(p, tol=1e-11).impulse
    np.testing.assert_allclose(newton(p, np.float64)[-1][1], want, rtol=0, atol=1e-8 * abs(want).max())
    np.testing.assert_allclose(exchange(p)[-1], want, rtol=0, atol=1e-4 * abs(want).max())
    assert newton(p, np.float32)[-1][1].dtype == np.float32
