"""Threads: a problem is shared freely, a prepared solver serves one of them at a time and says so."""

import sysconfig
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from random_problems import random_lcp
from worked import python

import lavender as lv
import lavender_ext
from lavender.base import threads
from lavender.base.errors import InUse

KERNELS = Path(lavender_ext.__file__).parent


def test_prepared_solver_in_a_second_thread_raises():
    solver = lv.prepare(random_lcp(1), "pgs")
    inside, leave = threading.Event(), threading.Event()

    def callback(iterations, impulse, residual):
        inside.set()
        assert leave.wait(600)
        return True

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(solver.solve, tol=1e-12, callback=callback)
        try:
            assert inside.wait(600)
            with pytest.raises(InUse, match="make one for each thread"):
                solver.solve()
        finally:
            leave.set()
        assert first.result().status is lv.Status.INTERRUPTED
    assert solver.solve(tol=1e-6, max_iter=10_000).success  # free again


@pytest.mark.skipif(not sysconfig.get_config_var("Py_GIL_DISABLED"), reason="this Python has a GIL")
def test_kernels_do_not_enable_the_gil():
    modules = [
        ".".join(p.relative_to(KERNELS.parent).with_suffix("").parts)
        for p in KERNELS.rglob("*.pyx")
    ]
    code = f"""
import importlib, sys
import lavender
for name in {modules}:
    importlib.import_module(name)
    assert not sys._is_gil_enabled(), name
"""
    python("-W", "error", "-c", code)


def test_an_error_of_one_thread_stops_the_others():
    """This one waits for the error of the other, and is told to begin nothing more."""
    both = threading.Barrier(2, timeout=10.0)
    told = []

    def work(stop):
        both.wait()
        if threading.current_thread() is not threading.main_thread():
            raise ZeroDivisionError("planted")
        end = time.monotonic() + 10.0
        while not stop[0] and time.monotonic() < end:
            time.sleep(1e-3)
        told.append(stop[0])

    with pytest.raises(ZeroDivisionError, match="planted"):
        threads.run_on_threads(work, 2)
    assert told == [1]


def test_solve_many_inside_threads_does_not_deadlock(monkeypatch):
    """All that are kept are busy with calls that want more: what nobody begins is nobody's."""
    monkeypatch.setattr(threads, "MAX_THREADS", 1)
    threads.get_thread_pool.cache_clear()
    two = threading.Barrier(2, timeout=10.0)
    inner = []

    def work(stop):
        two.wait()
        inner.append(threads.run_on_threads(lambda stop: None, 3))

    threads.run_on_threads(work, 2)
    threads.get_thread_pool.cache_clear()
    assert len(inner) == 2 and min(map(len, inner)) == 1
