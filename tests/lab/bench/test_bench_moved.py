"""Motion errors on records: what they say, what they cost those who do not ask, levels in metres per second."""

import math

import pytest

import lavender as lv
from lavender import bench, suite
from lavender.lab.bench.record import from_json, to_json

SHORT = {"budgets": (4,), "repeats": 1, "orders": (), "time_limit": 60.0}


def test_a_record_has_the_motion_error_of_its_run():
    records = bench.run(["stack(n=8)"], ["pgs"], bench.Plan(levels=(1e-3,), motion=True, **SHORT))
    problem = suite.case("stack(n=8)").problem
    for r in records:
        again = lv.solve(problem, "pgs", tol=r.tol, max_iter=r.max_iter or None)
        error = again.motion_error()
        assert (r.motion, r.motion_speed, r.bound) == (error.relative, error.speed, error.bound)
        assert r.motion_speed > 0.0
        assert from_json(to_json(r)) == r


def test_without_asking_there_is_none(monkeypatch):
    monkeypatch.setattr("lavender.lab.bench.running.runner.with_motion", None)
    for r in bench.run(["stack(n=8)"], ["pgs"], bench.Plan(levels=(1e-3,), **SHORT)):
        assert r.motion is None
        assert from_json(to_json(r)) == r


def test_a_solver_in_a_process_of_its_own_has_one_too():
    records = bench.run(
        ["box_stackF(n=2)", "stack(n=4)"], ["osqp"], bench.Plan(levels=(1e-3,), motion=True, **SHORT)
    )
    assert all(0.0 <= r.motion < 1.0 for r in records)


def test_a_campaign_has_motion_errors():
    plan = bench.CampaignPlan(levels=(1e-3,), budgets=(4,), orders=(), motion=True)
    records = bench.campaign(["stack(n=8)"], ["pgs"], plan, workers=1)
    assert all(r.motion_speed > 0.0 for r in records)


def test_speed_levels_are_reached_by_tighter_residuals():
    plan = bench.Plan(levels=(1e-1,), speed_levels=(1e-2, 1e-4), **SHORT)
    assert plan.motion
    records = bench.run(["stack(n=16)"], ["pgs", "anderson", "jacobi"], plan)
    for solver in ("pgs", "anderson"):
        mine = [r for r in records if r.solver == solver and r.mode == "tol"]
        assert min(r.motion_speed for r in mine) <= 1e-4
        assert len({r.tol for r in mine}) == len(mine)  # nothing is asked for twice
        # One decade of speed is about one of residual: no solve is much tighter than it must be.
        assert min(r.tol for r in mine) >= 1e-7


def test_speed_levels_end_where_a_solver_does():
    """A solver that misses its residual is not asked for a tighter one; every loop is counted."""
    plan = bench.Plan(levels=(1e-1,), speed_levels=(1e-6, 1e-9), **{**SHORT, "time_limit": 0.02})
    records = bench.run(["hang(n=33, tip_mass=1e4)"], ["jacobi"], plan)
    assert sum(r.mode == "tol" for r in records) <= 2


def test_no_speed_level_without_a_reference():
    """An infeasible problem has no solution to be away from: one solve, and no number."""
    problem = lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0], name="infeasible")
    records = bench.run([problem], ["pgs"], bench.Plan(levels=(1e-1,), speed_levels=(1e-3,), **SHORT))
    assert records.records
    assert all(r.motion_speed is None for r in records)


@pytest.mark.parametrize("level", [0.0, -1.0, math.nan])
def test_senseless_speed_levels_are_refused(level):
    with pytest.raises(lv.InputError, match="speed level"):
        bench.Plan(speed_levels=(level,))


def test_what_has_nothing_to_do_is_described_so():
    from lavender.lab.bench.cases import describe, resolve

    (idle,) = resolve([lv.Problem.lcp([[1.0]], [-1.0], name="idle")])
    (busy,) = resolve(["stack(n=4)"])
    assert describe(idle, "run").nothing_to_do
    assert not describe(busy, "run").nothing_to_do
