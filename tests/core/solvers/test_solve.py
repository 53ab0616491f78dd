"""The front door: what it refuses before anything runs, budgets, clocks, history, callbacks, Ctrl-C."""

import dataclasses
import signal
import threading
import time

import numpy as np
import pytest
from calls import over_velocities
from random_problems import random_contact_problem, random_lcp

import lavender as lv
from lavender.batch import residuals as loop
from lavender.batch import solve as many
from lavender.judge import residuals
from lavender.solvers import direct
from lavender.solvers.newton_systems import general

TINY = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])

INVALID_PROBLEM = {
    "no problem": (lambda: lv.solve(np.eye(2), "pgs"), lv.InputError, "Problem"),
    "a matrix and a vector": (lambda: lv.solve(np.eye(2), [1.0, -1.0]), lv.InputError, "Problem.lcp"),
    "no such solver": (lambda: lv.solve(TINY, "psg"), lv.UnknownName, "pgs"),
    "no such option": (lambda: lv.solve(TINY, "jacobi", omgea=1.0), lv.UnknownName, "omega"),
    "negative tol": (lambda: lv.solve(TINY, "pgs", tol=-1.0), lv.InputError, "tol"),
    "a tol that no float holds": (
        lambda: lv.solve(TINY, "pgs", tol=10**400),
        lv.InputError,
        "tol is inf; a finite number is needed",
    ),
    "no time": (lambda: lv.solve(TINY, "pgs", time_limit=-1.0), lv.InputError, "time_limit"),
    "one start of many": (lambda: lv.solve_many([TINY], impulse=[0.0, 0.0]), lv.InputError, "impulses="),
    "a start too few": (
        lambda: lv.solve_many([TINY] * 2, impulses=[None]),
        lv.InputError,
        "1 entries for 2",
    ),
    "one for many": (lambda: lv.solve_many(TINY), lv.InputError, "one Problem; a list"),
    "many of a name": (lambda: lv.solve_many([TINY], "pgss"), lv.UnknownName, "pgs"),
    "many numbers": (lambda: lv.solve_many([3]), lv.InputError, "Problem"),
    "many by no thread": (lambda: lv.solve_many([TINY], threads=0), lv.InputError, "threads is 0"),
    "threads of a sweep": (
        lambda: lv.solve(TINY, "pgs", order="colored", threads=2),
        lv.UnknownName,
        "threads",
    ),
    **{
        f"{name} with {option} {x}": (
            lambda name=name, option=option, x=x: lv.solve(TINY, name, **{option: x}),
            lv.InputError,
            option,
        )
        for name, option, values in (
            ("jacobi", "omega", (0.0, -1.0, np.inf)),
            ("anderson", "memory", (0, 17)),
            ("admm", "memory", (-1, 17, 0.5)),
            ("admm", "relaxation", (0.0, 2.0)),
        )
        for x in values
    },
    "sweeps of another law": (
        lambda: lv.solve(random_contact_problem(1, friction="cone"), "nncg", sweep="pgs"),
        lv.InputError,
        "cone law",
    ),
    "no convex iterations": (lambda: lv.solve(TINY, "nncg", convex=-1), lv.InputError, "convex"),
    "cannot call a callback": (lambda: lv.solve(TINY, "pgs", callback=3), lv.InputError, "callback"),
}


@pytest.mark.parametrize("name", INVALID_PROBLEM)
def test_a_senseless_request_is_refused_with_its_reason(name):
    call, error, sign = INVALID_PROBLEM[name]
    with pytest.raises(error, match=sign):
        call()


@pytest.mark.parametrize("name", ["pgs", "auto"])
def test_another_problem_replaces_the_prepared_one_unless_an_error_is_raised(name):
    """Too late for an answer, too: the next solve is of the problem that was given last."""
    other = dataclasses.replace(TINY, b=-2.0 * TINY.b)
    right = [lv.solve(p, name, tol=1e-9).impulse for p in (TINY, other)]
    assert (right[0] != right[1]).any()
    prepared = lv.prepare(TINY, name)
    for options in ({"tol": -1.0}, {"impulse": np.ones(TINY.m + 1)}, {"max_iter": -1}):
        with pytest.raises(lv.InputError):
            prepared.solve(other, **options)
        np.testing.assert_array_equal(prepared.solve(tol=1e-9).impulse, right[0])
    with pytest.raises(lv.InputError, match="Problem"):
        prepared.solve(TINY.matrix, time_limit=1.0)
    prepared.solve(other, time_limit=1e-9)
    np.testing.assert_array_equal(prepared.solve(tol=1e-9).impulse, right[1])


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals of POSIX")
@pytest.mark.parametrize("solver", ["pgs", "auto"])
def test_ctrl_c_while_many_are_handed_out_to_threads_begins_no_more(solver, monkeypatch):
    """The signal comes with the first problem that a thread takes, one by one or in the compiled loop."""
    n, begun, solve, hand = 2000, [], many.solve, loop.Worker

    first = threading.Lock()

    def interrupt():
        begun.append(solver)
        if first.acquire(blocking=False):  # of two threads that begin at the same time, one sends the signal
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(1e-3)

    def slow(*args, **options):
        interrupt()
        return solve(*args, **options)

    class SlowWorker:
        def __init__(self, worlds, stop):
            self.hand, self.stop = hand(worlds, stop), stop

        def solve_worlds(self, *args):
            if solver == "pgs":
                return self.hand.solve_worlds(*args)
            interrupt()
            while not self.stop[0]:
                time.sleep(1e-3)
            return self.hand.solve_worlds(*args)

    monkeypatch.setattr(many, "solve", slow)
    monkeypatch.setattr(loop, "Worker", SlowWorker)
    with pytest.raises(KeyboardInterrupt):
        lv.solve_many([dataclasses.replace(TINY, copy=False) for _ in range(n)], solver, threads=2)
    assert 1 <= len(begun) < n / 2


@pytest.mark.parametrize("name", ["auto", "newton", "direct", "pgs", "anderson", "lemke"])
def test_a_solve_leaves_no_result_with_its_problem(name):
    """A residual was stored with the problem for the next call of the judge."""
    problem = random_lcp(3, m=90)
    lv.solve(problem, name)
    keys = set(problem.derived.cache)
    assert lv.solve(problem, name).success and set(problem.derived.cache) == keys
    assert not any("judged" in str(key) for key in keys)


@pytest.mark.parametrize("name", ["newton", "direct"])
def test_the_judge_measures_the_result_of_a_solver_that_judged_it_once(name, monkeypatch):
    problem, counted = random_lcp(3, m=90), []
    if name == "newton":
        problem = over_velocities(30, 60, compliance=0.1)
    prepared, judge = lv.prepare(problem, name), residuals.judge_impulse

    def count(of, impulse):
        counted.append(impulse.tobytes())
        return judge(of, impulse)

    for module in (residuals, general, direct):
        monkeypatch.setattr(module, "judge_impulse", count)
    solution = prepared.solve(tol=1e-8)
    assert solution.success and counted.count(solution.impulse.tobytes()) <= 1
