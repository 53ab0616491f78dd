"""The front door: what it refuses before anything runs, budgets, clocks, history, callbacks, Ctrl-C."""

import dataclasses
import gc
import os
import signal
import sys
import threading
import time
import weakref
from functools import partial

import numpy as np
import pytest
from stacks import stack

import lavender as lv
from lavender.batch import residuals as loop
from lavender.batch import solve as many

TINY = lv.Problem.lcp([[2.0, 1.0], [1.0, 2.0]], [1.0, -1.0])


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals of POSIX")
@pytest.mark.parametrize("solver", ["pgs", "auto"])
def test_ctrl_c_during_solve_many_starts_no_more_problems(solver, monkeypatch):
    """The signal comes with the first problem that a thread takes, one by one or in the compiled loop."""
    n = 2000
    begun = []
    solve = many.solve
    hand = loop.Worker

    first = threading.Lock()

    def interrupt():
        begun.append(solver)
        if first.acquire(
            blocking=False
        ):  # of two threads that begin at the same time, one sends the signal
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        time.sleep(1e-3)

    def slow(*args, **options):
        interrupt()
        return solve(*args, **options)

    class SlowWorker:
        def __init__(self, worlds, stop):
            self.hand = hand(worlds, stop)
            self.stop = stop

        def process_worlds(self, *args):
            if solver == "pgs":
                return self.hand.process_worlds(*args)
            interrupt()
            end = (
                time.monotonic() + 60.0
            )  # A signal that was lost fails the test instead of stopping all tests.
            while not self.stop[0] and time.monotonic() < end:
                time.sleep(1e-3)
            return self.hand.process_worlds(*args)

    monkeypatch.setattr(many, "solve", slow)
    monkeypatch.setattr(loop, "Worker", SlowWorker)
    with pytest.raises(KeyboardInterrupt):
        lv.solve_many([dataclasses.replace(TINY, copy=False) for _ in range(n)], solver, threads=2)
    assert 1 <= len(begun) < n / 2


def test_prepared_solve_of_another_velocity_keeps_the_targets():
    rng = np.random.default_rng(4)
    jac = rng.normal(size=(6, 9))
    mass = np.diag(rng.uniform(1.0, 2.0, 9))
    target = rng.normal(size=6)
    make = partial(lv.Problem.from_jacobian, jac, mass, target=target, mu=0.5, compliance=0.01)
    prepared = lv.prepare(make(rng.normal(size=9)))
    for _ in range(20):
        velocity = 10.0 * rng.normal(size=9)
        own = prepared.solve(v_free=velocity)
        single = lv.solve(make(velocity))
        np.testing.assert_allclose(own.impulse, single.impulse, rtol=1e-5, atol=1e-5)
        # Rounding of b does not accumulate from call to call.
        np.testing.assert_allclose(
            prepared.problem.b, target - jac @ velocity, rtol=0.0, atol=1e-13
        )
        assert prepared.problem.generalized.v_free.tolist() == velocity.tolist()


def test_problems_that_differ_in_b_share_memory_of_the_operator_and_free_each_other():
    problem = lv.Problem.from_jacobian(np.eye(3), np.eye(3), -np.ones(3), mu=0.5)
    lv.solve(problem)
    prepared = lv.prepare(problem)
    seen = []
    for i in range(5):
        prepared.solve(b=problem.b + 0.01 * i)
        seen.append(weakref.ref(prepared.problem))
    gc.collect()
    assert [ref() is not None for ref in seen] == [False] * 4 + [True]


@pytest.mark.parametrize(
    "arguments", [{}, {"max_iter": 50}, {"time_limit": 5.0}, {"velocity_tol": 1e-6}]
)
@pytest.mark.parametrize("name", ["auto", "pgs", "newton"])
def test_text_of_a_solution_names_its_start(name, arguments):
    problem = stack(6)
    stored = problem.updated(guess=0.5 * lv.solve(problem, "direct").impulse)
    given = np.full(6, 0.25)
    for solve in (lv.solve, lambda p, name, **more: lv.prepare(p, name).solve(**more)):
        assert ", from " not in str(solve(problem, name, **arguments))
        assert "from problem.guess," in str(solve(stored, name, **arguments))
        assert "from the given impulses," in str(solve(stored, name, impulse=given, **arguments))
    starts = [
        solution.start
        for solution in lv.solve_many([problem, stored], name, impulses=[given, None], tol=1e-6)
    ]
    assert starts == ["the given impulses", "problem.guess"]


@pytest.mark.parametrize("name", ["pgs", "newton"])
def test_solve_of_new_problem_computes_each_check_and_array_once(name):
    calls = []
    folder = os.path.dirname(lv.__file__)
    before = sys.getprofile()

    def record(frame, event, _):
        if event == "call" and frame.f_code.co_filename.startswith(folder):
            calls.append(frame.f_code.co_name)

    lv.solve(TINY, name)
    sys.setprofile(record)
    try:
        lv.solve(lv.Problem.lcp(TINY.matrix, TINY.b), name)
    finally:
        sys.setprofile(before)
    once = (
        "check_accepted",
        "check_arguments",
        "get_zero_impulse_reference",
        "_compressed",
        "finish",
    )
    assert {function: calls.count(function) for function in once} == dict.fromkeys(once, 1)
