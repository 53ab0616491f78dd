"""What every QP backend owes its user: its own name, its own words, silence, and never an exception."""

import signal
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from calls import BACKENDS, DEFINITE, installed
from random_problems import random_contact_problem, spd, touching

import lavender as lv
from lavender import registry
from lavender.judge.certificates import check_certificate
from lavender.programs import backends, qp_solver
from lavender.programs.running import Answer

PROVE_INFEASIBLE = {"osqp", "clarabel", "clarabel_cone", "piqp", "qpalm", "scs"}


def replaced(register, name, call):
    """The backend `name` with its call replaced, its spec otherwise as it is."""
    from functools import partial

    backend = next(b for b in backends.BACKENDS if b.name == name)
    register(
        replace(
            registry.get(name), factory=partial(qp_solver.QPSolver, replace(backend, call=call))
        )
    )


def test_every_backend_of_qpsolvers_is_known():
    qpsolvers = pytest.importorskip("qpsolvers")
    assert set(qpsolvers.available_solvers) <= set(BACKENDS)


class Finder:
    """Looks for no module, and says for which it was asked."""

    def __init__(self):
        self.asked = []

    def find_spec(self, name, path=None, target=None):
        self.asked.append(name)


@pytest.mark.parametrize("name", BACKENDS)
def test_backend_prints_nothing_imports_nothing_and_runs_in_threads(name, capfd, monkeypatch):
    """HiGHS greets where it is made; a fork while a module is looked for waits for ever for it."""
    for problem in (lv.Problem.linear(*spd(6)), lv.Problem.lcp(*spd(4))):
        if registry.get(name).refuses(problem) is not None:
            continue
        alone = lv.solve(problem, name)
        finder = Finder()
        before = (sys.stdout, warnings.filters.copy())
        with monkeypatch.context() as patch:
            patch.setattr(sys, "meta_path", [finder, *sys.meta_path])
            lv.solve(problem, name)
        assert finder.asked == []
        with ThreadPoolExecutor(4) as pool:
            for found in pool.map(lambda _, p=problem: lv.solve(p, name), range(8)):
                assert (found.impulse.tobytes(), found.status) == (
                    alone.impulse.tobytes(),
                    alone.status,
                )
        assert (sys.stdout, warnings.filters) == before
    assert capfd.readouterr() == ("", "")
    with pytest.raises(
        KeyboardInterrupt
    ):  # some backends handle Ctrl-C themselves while they solve
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("name", BACKENDS)
def test_backend_on_an_asymmetric_or_negative_matrix_raises_the_reason(name):
    a, b = spd(4)
    a[0, 1] += 1e-3
    with pytest.raises(lv.CapabilityError, match="needs a symmetric A"):
        lv.solve(lv.Problem.lcp(a, b), name)
    with pytest.raises(lv.CapabilityError, match=r"positive semidefinite A; A\[1, 1\] = -1"):
        lv.solve(lv.Problem.lcp(np.diag([1.0, -1.0]), [1.0, 1.0]), name)


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("b", [[0.0, 0.0], [0.0, -1.0]])
def test_backend_on_a_problem_at_rest_returns_exactly_zero(name, b):
    """Nothing is left to be relative to: an impulse of 1e-12 has an infinite residual."""
    solution = lv.solve(lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], b), name)
    assert solution.success and solution.claim_check == "confirmed" and not solution.impulse.any()


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("linear", [True, False])
def test_backend_claim_of_infeasibility_has_a_certificate(name, linear):
    a = np.array([[1.0, -1.0], [-1.0, 1.0]])
    b = np.array([1.0, 1.0])
    problem = lv.Problem.linear(a, b) if linear else lv.Problem.lcp(a, b)
    solution = lv.solve(problem, name, max_iter=500)
    assert not solution.success
    if name in PROVE_INFEASIBLE:
        assert solution.status is lv.Status.INFEASIBLE, str(solution)
        assert check_certificate(problem, solution.certificate) is None
        assert solution.claim_check == "confirmed"
    # A certificate of the backend or of `auto`: a claim that is true is confirmed, whoever proves it.
    if solution.status is lv.Status.INFEASIBLE:
        assert solution.claim_check == "confirmed" and solution.certificate is not None
    assert solution.status is not lv.Status.CONVERGED


@pytest.mark.parametrize("name", installed("osqp", "clarabel"))
def test_contradicting_rows_are_proved_in_the_velocity_form(name):
    rows = touching([[-1, 0], [-1, 0]], normal=np.array([[0.0, 0, 1], [0, 0, -1.0]]))
    problem = lv.Problem.from_rows(rows, [1.0, 1.0])  # up and down at 1 m/s
    solution = lv.solve(problem, name, form="velocity")
    assert solution.status is lv.Status.INFEASIBLE, str(solution)
    assert check_certificate(problem, solution.certificate) is None


@pytest.mark.parametrize("name", BACKENDS)
def test_backend_on_empty_or_fixed_problems_is_not_called(name):
    empty = lv.Problem.lcp(np.zeros((0, 0)), [])  # no row is bounded: its law is linear
    if registry.get(name).refuses(empty) is None:
        assert lv.solve(empty, name).success
    fixed = lv.solve(
        lv.Problem.lcp(np.eye(2), [1.0, 1.0], lower=[0.5, 2.0], upper=[0.5, 2.0]), name
    )
    assert fixed.success
    assert fixed.impulse.tolist() == [0.5, 2.0]
    assert fixed.work == {"backend_calls": 0}
    assert "determined by its bounds" in fixed.message


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("form", ["impulse", "velocity"])
def test_backend_dual_fulfils_the_kkt_conditions(name, form):
    problem = random_contact_problem(34, tangents=0, spin=False)
    c = problem.cones
    above = np.isfinite(c.upper) & (np.arange(problem.m) < 3)  # which have an upper bound alone
    assert above.any() and (np.isfinite(c.upper) & ~above).any()
    cones = replace(c, lower=np.where(above, -np.inf, c.lower))
    problem = replace(problem, cones=cones, compliance=problem.compliance + 0.3)
    if form == "velocity" and name in DEFINITE:
        # Rows with two finite bounds add unknowns without a cost of their own: P is singular and gets a shift.
        assert "added to the diagonal" in lv.solve(problem, name, form=form).message
        form = "auto"
    solution = lv.solve(problem, name, form=form, tol=1e-8)
    assert solution.success, str(solution)
    assert solution.dual.shape == (problem.m,)
    # The multipliers z of min 1/2 l.A l - b.l satisfy A l - b + z = 0; z > 0 only at an upper bound, z < 0 at a lower.
    lam = solution.impulse
    z = solution.dual
    speed = np.abs(problem.b).max()
    bound = np.where(z > 0.0, cones.upper, cones.lower)
    is_bounded = np.isfinite(bound)
    # 1e-8 relative, times the condition number of this problem (below 100).
    assert np.abs(problem.slack(lam) + z).max() <= 1e-6 * speed
    assert np.abs(z[~is_bounded]).max(initial=0.0) <= 1e-6 * speed
    assert abs(z[is_bounded] @ (bound - lam)[is_bounded]) <= 1e-6 * speed * np.abs(lam).sum()


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("seed", range(12))
def test_multipliers_of_inequalities_are_a_proof(name, seed):
    """They are at least 0, and 0 exactly where the inequality is far from active, whatever the backend returned."""
    rng = np.random.default_rng(seed)
    n = 6
    half = rng.normal(size=(n, n))
    rows, limit = rng.normal(size=(8, n)), rng.uniform(0.1, 1.0, 8)
    ends = np.full(n, 1.0)
    try:
        answer = lv.solve_qp(
            half @ half.T + 0.1 * np.eye(n), rng.normal(size=n), rows, limit, lb=-ends, ub=ends, solver=name, tol=1e-6
        )  # fmt: skip
    except (lv.SolverUnavailable, lv.CapabilityError) as error:
        pytest.skip(str(error))
    assert answer.found and answer.z.min() >= 0.0
    assert not answer.z[limit - rows @ answer.x > 1e-3].any()


@pytest.mark.parametrize("name", BACKENDS)
def test_backend_uses_a_start_if_its_spec_says_so(name):
    problem = lv.Problem.lcp(*spd(40, seed=5))
    cold = lv.solve(problem, name, tol=1e-6)
    warm = lv.solve(problem, name, tol=1e-6, impulse=lv.solve(problem, "direct").impulse)
    if registry.get(name).impulse:
        assert warm.work.get("iterations", 0) <= cold.work.get("iterations", 0)
        assert warm.impulse.tobytes() != cold.impulse.tobytes() or warm.work != cold.work
    else:
        assert warm.impulse.tobytes() == cold.impulse.tobytes()
        assert warm.work == cold.work


APART = [
    b.name for b in backends.BACKENDS if (not b.stoppable or b.overruns) and b.name in BACKENDS
]


@pytest.mark.parametrize("name", BACKENDS)
def test_backend_with_a_time_limit_runs_in_a_separate_process_if_it_has_none_of_its_own(
    name, monkeypatch
):
    from lavender.programs import isolated

    problem = lv.Problem.lcp(*spd(12, seed=3))
    plain = lv.solve(problem, name)
    calls = []
    run = isolated.run_isolated
    monkeypatch.setattr(qp_solver, "run_isolated", lambda *a: calls.append(run(*a)) or calls[-1])
    there = lv.solve(problem, name, time_limit=600.0, isolate=True)
    assert calls
    calls.clear()
    lv.solve(problem, name, time_limit=600.0)
    assert bool(calls) == (name in APART)
    lv.solve(problem, name, isolate=True)
    assert calls
    calls.clear()
    here = lv.solve(problem, name, time_limit=600.0, isolate=False)
    assert not calls
    if name in APART:
        assert "ran in a separate process" in there.message and "ran to its end" in here.message
    assert plain.success and "time limit" not in plain.message
    for other in (there, here):
        assert ("; the backend " in other.message and " and ran " in other.message) == (
            name in APART
        )
        assert other.status is plain.status
        assert other.work == plain.work
        if (
            name == "proxqp"
        ):  # Its vectorised sums depend on the alignment of memory, in one process, too.
            np.testing.assert_allclose(other.impulse, plain.impulse, rtol=0.0, atol=1e-13)
        else:
            assert other.impulse.tobytes() == plain.impulse.tobytes()


def test_backend_beyond_its_time_limit_is_ended_and_the_next_call_starts_another_process():
    if "quadprog" not in BACKENDS:
        pytest.skip("quadprog is not installed")
    # A thousand rows: to send them takes longer than this limit.
    problem = lv.Problem.lcp(*spd(1000, seed=3))
    prepared = lv.prepare(problem, "quadprog")
    late = prepared.solve(time_limit=1e-6)
    assert late.status is lv.Status.TIME_LIMIT
    assert "ended at the time limit" in late.message
    assert late.impulse.tobytes() == problem.start().tobytes()
    small = lv.Problem.lcp(*spd(5))
    after = lv.solve(small, "quadprog", time_limit=600.0)
    assert after.success and "ran in a separate process" in after.message


def end_idle_processes():
    from lavender.programs.isolated import idle_processes, is_starting_spare

    deadline = time.monotonic() + 60.0
    while is_starting_spare() and time.monotonic() < deadline:
        time.sleep(0.01)
    while idle_processes:
        idle_processes.pop().close()


@pytest.mark.skipif(not APART, reason="no backend without a time limit is installed")
def test_isolated_process_is_reused_and_replaced_after_its_death(monkeypatch):
    from lavender.programs import isolated
    from lavender.programs.isolated import idle_processes

    problem = lv.Problem.lcp(*spd(5))
    end_idle_processes()
    monkeypatch.setattr(isolated, "KEPT_PROCESSES", 1)
    lv.solve(problem, APART[0], time_limit=600.0)
    (process,) = idle_processes
    before = process.popen
    lv.solve(problem, APART[0], time_limit=600.0)
    assert process in idle_processes and process.popen is before
    before.kill()
    before.wait()
    assert lv.solve(problem, APART[0], time_limit=600.0).success
    assert process in idle_processes and process.popen is not before


@pytest.mark.skipif(not APART, reason="no backend without a time limit is installed")
def test_isolated_process_goes_on_beyond_a_limit_and_serves_later_calls(monkeypatch):
    from lavender.programs import isolated

    monkeypatch.setattr(isolated, "MAX_OVERRUN", 600.0)
    monkeypatch.setattr(isolated, "START_TIME", 600.0)
    monkeypatch.setattr(isolated, "KEPT_PROCESSES", 1)
    end_idle_processes()
    large, small = lv.Problem.lcp(*spd(400, seed=3)), lv.Problem.lcp(*spd(5))
    lv.solve(small, APART[0], time_limit=300.0)
    (process,) = isolated.idle_processes
    before = process.popen
    monkeypatch.setattr(isolated, "MAX_OVERRUNNING", 0)  # No other process is started.
    late = lv.prepare(large, APART[0]).solve(time_limit=1e-6)
    assert late.status is lv.Status.TIME_LIMIT and "ended at the time limit" in late.message
    deadline = time.monotonic() + 60.0
    while process.is_busy and time.monotonic() < deadline:
        time.sleep(0.01)
    assert lv.solve(small, APART[0], time_limit=300.0).success
    assert isolated.idle_processes == [process] and process.popen is before


@pytest.mark.skipif(not APART, reason="no backend without a time limit is installed")
def test_call_after_one_beyond_its_limit_begins_in_a_process_that_is_kept(monkeypatch):
    from lavender.programs import isolated

    monkeypatch.setattr(isolated, "MAX_OVERRUN", 600.0)
    end_idle_processes()
    small = lv.Problem.lcp(*spd(5))
    lv.solve(small, APART[0], time_limit=300.0)
    deadline = time.monotonic() + 60.0
    while isolated.is_starting_spare() and time.monotonic() < deadline:
        time.sleep(0.01)
    busy = isolated.idle_processes[0]
    with pytest.raises(TimeoutError):
        busy.call_function(time.sleep, 30.0, timeout=0.01)
    kept = isolated.idle_processes[-1].popen
    assert lv.solve(small, APART[0], time_limit=1.0).success  # Less than START_TIME.
    assert busy.is_busy and kept in [process.popen for process in isolated.idle_processes]
    end_idle_processes()


@pytest.mark.skipif(not APART, reason="no backend without a time limit is installed")
def test_isolated_process_that_goes_on_for_long_is_killed_and_replaced(monkeypatch):
    from lavender.programs import isolated

    monkeypatch.setattr(isolated, "MAX_OVERRUN", 0.01)
    end_idle_processes()
    process = isolated.Process()
    with pytest.raises(TimeoutError):
        process.call_function(time.sleep, 600.0, timeout=0.05)
    isolated.idle_processes.append(process)
    deadline = time.monotonic() + 60.0
    while process in isolated.idle_processes and time.monotonic() < deadline:
        time.sleep(0.01)
    while isolated.is_starting_spare() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert process.popen is None and len(isolated.idle_processes) == 1


@pytest.mark.parametrize("name", installed("clarabel", "osqp"))
def test_isolated_process_survives_a_limit_of_the_backend(name, monkeypatch):
    from lavender.programs import isolated
    from lavender.programs.isolated import idle_processes

    monkeypatch.setattr(
        isolated, "MIN_STOPPABLE_TIME", 600.0
    )  # Only the backend's own limit ends the call.
    problem = lv.Problem.lcp(*spd(300, seed=3))
    lv.solve(lv.Problem.lcp(*spd(5)), name, isolate=True)
    before = [process.popen for process in idle_processes]
    late = lv.solve(problem, name, time_limit=1e-3, tol=1e-12, isolate=True)
    assert late.status is lv.Status.TIME_LIMIT and "ended at the time limit" not in late.message
    assert [process.popen for process in idle_processes] == before


@pytest.mark.skipif(not APART, reason="no backend without a time limit is installed")
def test_isolated_process_errors_equal_errors_of_a_direct_call():
    problem = lv.Problem.lcp(*spd(5))
    with pytest.raises(lv.InputError, match="isolate"):
        lv.solve(problem, APART[0], isolate="yes")
    with pytest.raises(lv.InputError, match="isolate=False"):
        lv.solve(problem, APART[0], time_limit=600.0, settings={"verbose": lambda: None})
    wrong = {"settings": {"bogus": 1}}
    here = lv.solve(problem, APART[0], time_limit=600.0, isolate=False, **wrong)
    there = lv.solve(problem, APART[0], time_limit=600.0, **wrong)
    assert there.status is here.status
    assert there.message.split(";")[0] == here.message.split(";")[0]


def test_settings_reach_the_backend_or_are_an_input_error():
    problem = lv.Problem.lcp(*spd(20))
    one = lv.solve(problem, "osqp", settings={"max_iter": 25, "polishing": False, "rho": 1e-6})
    assert (one.work["iterations"], one.status) == (25, lv.Status.MAX_ITERATIONS)
    assert "polish" not in one.message
    for name in installed("osqp", "clarabel", "clarabel_cone"):
        for wrong, word in (({"bogus": 1}, "bogus"), ([1], "mapping")):
            with pytest.raises(lv.InputError, match=word):
                lv.solve(problem, name, settings=wrong)


def answers(register, *given):
    """osqp gives these, one after the other, the last again and again: an error is raised."""
    asked = []
    left = list(given)

    def call(program, start, limit, extra):
        asked.append(limit)
        answer = left.pop(0) if len(left) > 1 else left[0]
        if isinstance(answer, BaseException):
            raise answer
        return answer(program, limit) if callable(answer) else answer

    replaced(register, "osqp", call)
    return asked


@pytest.mark.parametrize(
    ("given", "status", "words"),
    [
        (ValueError("it broke"), lv.Status.NUMERICAL_ERROR, "ValueError: it broke"),
        (MemoryError("it broke"), lv.Status.NUMERICAL_ERROR, "MemoryError: it broke"),
        (
            type("Panic", (BaseException,), {})("it broke"),
            lv.Status.NUMERICAL_ERROR,
            "Panic: it broke",
        ),
        (KeyboardInterrupt(), lv.Status.INTERRUPTED, ""),
        *(
            (
                Answer(lv.Status.CONVERGED, "gave up", x),
                lv.Status.NUMERICAL_ERROR,
                "gave up; no iterate",
            )
            for x in (None, np.array([np.nan, 1.0, 1.0]), np.zeros(2))
        ),
    ],
)
def test_an_exception_and_no_iterate_become_a_result_at_the_start_point(
    register, given, status, words
):
    answers(register, given)
    start = np.array([0.1, 0.2, 0.3])
    solution = lv.solve(lv.Problem.lcp(*spd(3)), "osqp", impulse=start)
    assert solution.status is status and words in solution.message
    assert np.array_equal(solution.impulse, start) and solution.dual is None


@pytest.mark.parametrize(
    ("feasible", "search", "check", "words"),
    [
        (False, True, "confirmed", "auto found the certificate"),
        (True, True, "contradicted", "auto found a solution"),
        (
            True,
            False,
            "not proven",
            "not proven: no certificate was given",
        ),  # too many rows for our own search
    ],
)
def test_backend_claim_of_infeasibility_without_a_certificate_is_checked_by_auto(
    feasible, search, check, words, register, monkeypatch
):
    answers(register, Answer(lv.Status.INFEASIBLE, "infeasible"))
    if not search:
        monkeypatch.setattr("lavender.solvers.certify.CERTIFICATE_ROWS", 1)
    a = np.array([[1.0, -1.0], [-1.0, 2.0 if feasible else 1.0]])
    solution = lv.solve(lv.Problem.lcp(a, [1.0, 1.0]), "osqp")
    assert solution.status is lv.Status.INFEASIBLE and solution.claim_check == check
    assert words in solution.message + solution.status_conflict
    contradicted = check == "contradicted"
    assert (solution.status_conflict != "") is ("CONTRADICTED" in str(solution)) is contradicted
    assert (solution.certificate is None) is feasible


def test_newton_step_removes_an_error_of_the_backend(register):
    def rough(program, limit):  # A is the unit matrix: the solution is -q
        return Answer(
            lv.Status.CONVERGED,
            "solved",
            -1.001 * program.q,
            np.zeros(len(program.t)),
            {"iterations": 7},
        )

    asked = answers(register, rough)
    solution = lv.solve(lv.Problem.lcp(np.eye(3), np.ones(3)), "osqp", tol=1e-12)
    assert solution.success and len(asked) == 1 and solution.iterations == 7


@pytest.mark.parametrize(
    "later", [lv.Status.INFEASIBLE, lv.Status.NUMERICAL_ERROR, lv.Status.TIME_LIMIT]
)
def test_backend_second_call_that_fails_keeps_the_first_answer(later, register, monkeypatch):
    def inexact(program, limit):
        x = -(1.0 + 1e-9) * program.q
        return Answer(lv.Status.CONVERGED, "solved", x, np.zeros(len(program.t)))

    monkeypatch.setattr("lavender.programs.convex.ConvexProgram.polish", lambda *given: None)
    asked = answers(register, inexact, Answer(later, "failed"))
    solution = lv.solve(lv.Problem.lcp(np.eye(3), np.ones(3)), "osqp", tol=1e-12)
    assert len(asked) == 2 and solution.residual.relative < 2e-9
    assert solution.claim_check == "confirmed" or later is lv.Status.INFEASIBLE


def test_backend_at_tol_zero_runs_at_its_tightest_tolerance():
    solution = lv.solve(lv.Problem.lcp(*spd(10)), "clarabel", tol=0.0)
    assert solution.status in (lv.Status.STALLED, lv.Status.ROUNDOFF_LIMIT)
    assert solution.residual.relative <= 1e-10


def test_a_solver_whose_package_is_missing_says_so_in_every_call():
    problem = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])
    for name, reason in lv.known().items():
        for _ in range(2 if reason else 0):
            with pytest.raises(lv.SolverUnavailable, match=f"{name}.*needs"):
                lv.solve(problem, name)
