"""Run a function on several threads, which are reused by later calls.

Starting and ending a thread takes 0.07 ms, waking a waiting thread 0.01 ms. Some calls take no longer than 0.07 ms.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

T = TypeVar("T")

# Largest number of threads of the pool; further calls wait. It starts a thread only if no thread is idle.
MAX_THREADS = 1024


@cache
def get_thread_pool() -> ThreadPoolExecutor:
    """Return the pool of threads of this process."""
    # Imported here: it takes 5 ms, and only this function needs it.
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(MAX_THREADS, thread_name_prefix="lavender")


if hasattr(os, "register_at_fork"):  # Windows cannot fork.
    # A forked process has no threads of its parent and needs a new pool.
    os.register_at_fork(after_in_child=get_thread_pool.cache_clear)


@contextmanager
def _defer_sigint() -> Iterator[None]:
    """Defer Ctrl-C until the block ends: if it interrupts the start of a thread, the pool cannot end that thread."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows has no signal masks.
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def run_on_threads(work: Callable[[bytearray], T], threads: int) -> list[T]:
    """Call `work(stop)` on this thread and on up to `threads - 1` others, and return all results.

    Each call processes items of a common queue until the queue is empty. Calls that have not started by then are
    cancelled. After an error or Ctrl-C, `stop[0]` is set to 1; `work` must then start no further item. The exception
    is raised when all calls have ended.
    """
    stop = bytearray(1)
    if threads <= 1:
        return [work(stop)]

    def run() -> T:
        try:
            return work(stop)
        except BaseException:
            stop[0] = 1
            raise

    futures: list[Any] = []
    try:
        with _defer_sigint():
            futures += [get_thread_pool().submit(run) for _ in range(threads - 1)]
        return [run(), *(future.result() for future in futures if not future.cancel())]
    finally:
        stop[0] = (
            1  # Stop the other threads also if Ctrl-C interrupted this thread while it waited for them.
        )
        for future in futures:
            if not future.cancel():
                future.exception()
