"""Quadratic programs in reports and cross-checks: the call that a user makes, judged by the error of the program."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.sparse as sp
from calls import installed
from worked import python

import lavender as lv
from lavender import report
from lavender.report import case_kinds
from lavender.report.case_kinds import make_case
from lavender.report.cases import hash_problem
from lavender.report.check import UNBOUNDED, cross_check
from lavender.report.timing import format_call
from lavender.solvers import registry

PLAN = report.Plan(tolerances=(1e-3, 1e-8), budgets=(), repeats=1, time_limit=60.0)


def control(n=5, dt=0.1, singular=False):
    """A program of predictive control: n steps of a double integrator with bounds on speed and force."""
    step = np.array([[1.0, dt], [0.0, 1.0]])
    force = np.array([[dt * dt / 2.0], [dt]])
    weight = sp.block_diag(
        [sp.kron(sp.eye(n), np.diag([10.0, 0.0 if singular else 1.0])), 0.1 * sp.eye(n)]
    )
    A = sp.hstack([sp.kron(sp.eye(n, k=-1), step) - sp.eye(2 * n), sp.kron(sp.eye(n), force)])
    b = np.zeros(2 * n)
    b[:2] = -step @ [1.0, -0.5]
    ub = np.append(np.tile([5.0, 0.8], n), np.full(n, 2.0))
    return {"P": weight.tocsc(), "q": np.zeros(3 * n), "A": A.tocsc(), "b": b, "lb": -ub, "ub": ub}


@pytest.mark.parametrize("singular", [False, True])
def test_run_of_a_program_file_times_solve_qp_and_has_the_error_of_the_program(
    tmp_path, singular, monkeypatch
):
    arrays = control(singular=singular)
    np.savez(
        tmp_path / "control.npz",
        **{k: x.toarray() if sp.issparse(x) else x for k, x in arrays.items()},
    )
    calls = []
    real = case_kinds.solve_qp

    def count(problem, solver, **arguments):
        calls.append(solver)
        return real(problem, solver, **arguments)

    monkeypatch.setattr(case_kinds, "solve_qp", count)
    solvers = ["auto", "osqp"] if singular else ["auto", "newton", "osqp"]
    lines = report.run([tmp_path / "control.npz"], solvers, PLAN)
    runs = list(report.select_runs(lines).itertuples(index=False))
    assert {r.solver for r in runs} == set(solvers) <= set(calls)
    problem = lv.io.load(tmp_path / "control.npz")
    for r in runs:
        assert (r.law, r.variables, r.rows, r.status) == ("program", 15, 40, "CONVERGED")
        (line,) = format_call(r)
        assert line.startswith("lv.solve_qp(problem, ") and "max_iter" not in line
        answer = eval(line, {"lv": lv, "problem": problem})
        assert (answer.error, answer.found) == (r.relative, r.success) and r.relative <= r.tol
        assert np.isnan(r.velocity) and json.loads(r.work) == dict(answer.solution.work)
    (kind,) = set(report.select_runs(lines)["structure"])
    assert kind == f"{'singular' if singular else 'definite'} P, dense"  # fewer than 20 variables


def test_printed_call_of_a_program_has_the_limit_of_iterations_that_it_needs():
    problem = lv.Problem.from_qp(**control(n=20), name="control")
    (run,) = report.select_runs(
        report.run([problem], ["pgs"], dataclasses.replace(PLAN, tolerances=(1e-8,)))
    ).itertuples()
    (line,) = format_call(run)
    assert run.iterations > registry.get("pgs").max_iter and "max_iter=" in line
    assert eval(line, {"lv": lv, "problem": problem}).error == run.relative


def test_report_of_programs_has_its_figure_in_errors_of_the_program(tmp_path):
    lines = report.run([lv.Problem.from_qp(**control(), name="control")], ["auto", "osqp"], PLAN)
    page = report.write(lines, tmp_path / "out").read_text()
    assert (
        "lv.solve_qp(problem, " in page
        and "15 variables, 40 rows" in page
        and "error of the program" in page
    )
    assert "m/s" not in page.partition("<details>")[0] and "nan" not in page.lower()


def test_hash_of_a_program_changes_with_every_array():
    arrays = control()
    problems = [lv.Problem.from_qp(**arrays)]
    for name in arrays:
        changed = arrays[name].copy() * (1.0 + 1e-15) + (1e-15 if name == "q" else 0.0)
        problems.append(lv.Problem.from_qp(**arrays | {name: changed}))
    assert len(set(map(hash_problem, problems))) == len(problems)


@pytest.mark.parametrize("singular", [False, True])
def test_cross_check_of_a_program_compares_errors_and_distances(singular):
    problem = lv.Problem.from_qp(**control(singular=singular))
    names = ["auto", "osqp", "pgs", *installed("piqp", "clarabel")]
    found = cross_check(problem, names, tol=1e-7)
    assert found.reference == "osqp" and found.reference_note.startswith("error ")
    assert [row.solver for row in found.refused] == ["pgs"] * singular
    for row in (row for row in found if row.verdict != "refused"):
        assert row.verdict == "agrees" and row.relative <= 1e-7 and row.distance <= row.allowed
        assert row.relative == row.solution.program_error and abs(row.objective) < 1e-5
        x, best = (
            problem.qp.recover_variables(s.impulse) for s in (row.solution, found["osqp"].solution)
        )
        assert row.distance == pytest.approx(
            np.sqrt((x - best) @ (control(singular=singular)["P"] @ (x - best)))
        )
    assert "[√cost]" in str(found) and "m/s" not in str(found)


@pytest.mark.parametrize("seed", range(20))
def test_bound_of_a_distance_holds_for_any_two_points(seed):
    """The distance is compared at points far from the solution, whose multipliers have the right signs."""
    rng = np.random.default_rng(seed)
    problem = lv.Problem.from_qp(**control(n=3, singular=seed % 2 == 1))
    qp = problem.qp
    case = make_case(problem)
    best = lv.solve_qp(problem, "osqp", tol=1e-9)
    for size in (1e-6, 1e-2, 10.0):
        points = []
        for _ in range(2):
            lam = qp.select_row_multipliers(best.impulse) + size * rng.normal(size=len(qp.target))
            lam[qp.free :] = np.maximum(lam[qp.free :], 0.0)
            impulse = (
                np.append(best.x + size * rng.normal(size=len(best.x)), lam)
                if qp.is_singular
                else lam
            )
            points.append(dataclasses.replace(best.solution, impulse=impulse))
        distance, allowed = case.compute_separation(*points)
        assert 0.0 < distance <= allowed


def test_cross_check_names_programs_without_a_solution():
    infeasible = lv.Problem.from_qp(np.eye(1), [0.0], G=[[1.0], [-1.0]], h=[-1.0, -1.0])
    assert {row.verdict for row in cross_check(infeasible, ["auto", "osqp"])} == {
        "no solution, proved"
    }
    unbounded = lv.Problem.from_qp(np.zeros((1, 1)), [1.0], ub=[0.0])
    assert {row.verdict for row in cross_check(unbounded, ["auto", "osqp"])} == {UNBOUNDED}


def test_timed_calls_import_nothing(tmp_path):
    """Every installed solver, on a contact problem and on programs: also the first of its calls."""
    lv.io.save(lv.Problem.from_qp(**control()), tmp_path / "definite.npz")
    lv.io.save(lv.Problem.from_qp(**control(singular=True)), tmp_path / "singular.npz")
    code = """if True:
        import sys
        from lavender import report
        from lavender.report import case_kinds, timing
        timed, late = [], []
        def watch(real):
            def call(problem, solver, **arguments):
                before = set(sys.modules)
                try:
                    return real(problem, solver, **arguments)
                finally:
                    if timed[-1:] == ["now"]:
                        late.extend((solver, name) for name in set(sys.modules) - before)
            return call
        def measure(real):
            def time_call(*arguments, **keywords):
                timed.append("now")
                try:
                    return real(*arguments, **keywords)
                finally:
                    timed[-1] = "done"
            return time_call
        case_kinds.solve, case_kinds.solve_qp = watch(case_kinds.solve), watch(case_kinds.solve_qp)
        timing._time_call = measure(timing._time_call)
        plan = report.Plan(tolerances=(1e-6,), budgets=(), repeats=2, time_limit=0.3)
        report.run([*sys.argv[1:], "two_particles"], None, plan)
        assert len(timed) > 30 and not late, late
    """
    python("-c", code, tmp_path / "definite.npz", tmp_path / "singular.npz")
