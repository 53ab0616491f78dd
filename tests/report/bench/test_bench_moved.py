"""Measures of difficulty of a case, and records of runs without an iteration."""

from dataclasses import replace

import lavender as lv
from lavender import bench, suite
from lavender.report import write
from lavender.report.bench import statistics

SHORT = {"budgets": (4,), "repeats": 1, "orders": (), "time_limit": 60.0}


def test_a_case_has_its_difficulty_and_who_gave_the_same_answer_without_an_iteration(tmp_path):
    plan = bench.Plan(tolerances=(1e-3, 1e-6), **SHORT)
    records = bench.run(["stack(n=8)", "threshold"], ["pgs", "newton", "lemke", "direct"], plan)
    stack, _ = statistics.compute_difficulties(records)
    assert stack.sweeps > 10 and stack.condition > 10.0 and stack.same == ()
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
