"""Motion errors on records: what they say, what they cost those who do not ask, tolerances in metres per second."""

from dataclasses import replace

import lavender as lv
from lavender import bench, suite
from lavender.lab.bench import statistics
from lavender.lab.bench.record import from_json, to_json
from lavender.lab.report import write

SHORT = {"budgets": (4,), "repeats": 1, "orders": (), "time_limit": 60.0}


def test_a_record_has_the_motion_error_of_its_run():
    records = bench.run(["stack(n=8)"], ["pgs"], bench.Plan(tolerances=(1e-3,), motion=True, **SHORT))
    problem = suite.case("stack(n=8)").problem
    for r in records:
        again = lv.solve(problem, "pgs", tol=r.tol, max_iter=r.max_iter or None)
        error = again.motion_error()
        assert (r.motion_error, r.motion_speed, r.bound) == (error.relative, error.speed, error.bound)
        assert r.motion_speed > 0.0
        assert from_json(to_json(r)) == r


def test_speed_levels_are_reached_by_tighter_residuals():
    plan = bench.Plan(tolerances=(1e-1,), velocity_tolerances=(1e-2, 1e-4), **SHORT)
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
    plan = bench.Plan(tolerances=(1e-1,), velocity_tolerances=(1e-6, 1e-9), **{**SHORT, "time_limit": 0.02})
    records = bench.run(["hang(n=33, tip_mass=1e4)"], ["jacobi"], plan)
    assert sum(r.mode == "tol" for r in records) <= 2


def test_no_speed_level_without_a_reference():
    """An infeasible problem has no solution to be away from: one solve, and no number."""
    problem = lv.Problem.lcp([[1.0, -1.0], [-1.0, 1.0]], [1.0, 1.0], name="infeasible")
    records = bench.run(
        [problem], ["pgs"], bench.Plan(tolerances=(1e-1,), velocity_tolerances=(1e-3,), **SHORT)
    )
    assert records.records
    assert all(r.motion_speed is None for r in records)


def test_a_case_has_its_difficulty_and_who_gave_the_same_answer_without_an_iteration(tmp_path):
    plan = bench.Plan(tolerances=(1e-3, 1e-6), **SHORT)
    records = bench.run(["stack(n=8)", "threshold"], ["pgs", "newton", "lemke", "direct"], plan)
    stack, border = statistics.compute_difficulties(records)
    assert (
        stack.sweeps > 10 and stack.condition > 10.0 and stack.boundary_fraction == 0.0 and stack.same == ()
    )
    assert border.boundary_fraction == 1.0
    told = [
        replace(r, iterations=0, solution_hash="x") if r.solver in ("lemke", "direct") else r for r in records
    ]
    shared = replace(records, records=told)
    assert statistics.compute_difficulties(shared)[0].same == ("direct", "lemke")
    page = write(shared, tmp_path, figures=False).read_text(encoding="utf-8")
    assert "direct, lemke" in page and "exact solution" not in page


def test_a_guess_makes_no_case_easier():
    problem = suite.case("stack(n=8)").problem
    near = replace(problem, guess=lv.solve(problem, tol=1e-9).impulse * (1.0 + 1e-4), copy=False)
    plan = bench.Plan(tolerances=(1e-3,), **SHORT)
    cold, warm = (
        statistics.compute_difficulties(bench.run([p], ["pgs", "jacobi"], plan))[0] for p in (problem, near)
    )
    assert warm.sweeps == cold.sweeps > 10 and warm.same == ()
