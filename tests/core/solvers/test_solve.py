"""The front door: what it refuses before anything runs, budgets, clocks, history, callbacks, Ctrl-C."""

import dataclasses
import signal
import threading
import time

import numpy as np
import pytest
from random_problems import random_lcp

import lavender as lv
from lavender.batch import residuals as loop
from lavender.batch import solve as many

TINY = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])


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
            end = time.monotonic() + 60.0  # A signal that was lost fails the test instead of stopping all tests.
            while not self.stop[0] and time.monotonic() < end:
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
