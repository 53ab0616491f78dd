"""Work on several threads at the same time, by threads that are kept from call to call.

A thread takes 0.07 ms to begin and to end, one that waits 0.01: as much as some calls have to do.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import ThreadPoolExecutor

T = TypeVar("T")

MOST = 1024  # one is begun when there is work and none waits


@cache
def helpers() -> ThreadPoolExecutor:
    """The threads."""
    from concurrent.futures import ThreadPoolExecutor  # 5 ms to import, needed only here

    return ThreadPoolExecutor(MOST, thread_name_prefix="lavender")


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=helpers.cache_clear)  # a fork's child has none of them


def together(work: Callable[[bytearray], T], threads: int) -> list[T]:
    """What `work(stop)` returns on this thread and on up to `threads - 1` others.

    Each call takes what is to do from one place until nothing is left, so one that no thread began meanwhile never is.
    It begins nothing more when `stop[0]` is not 0, which is so after an error or Ctrl-C; either comes out when all have
    ended.
    """
    stop = bytearray(1)

    def working() -> T:
        try:
            return work(stop)
        except BaseException:
            stop[0] = 1
            raise

    others = [helpers().submit(working) for _ in range(threads - 1)]
    try:
        return [working(), *(other.result() for other in others if not other.cancel())]
    finally:
        stop[0] = 1  # Ctrl-C may come while this thread waits
        for other in others:
            if not other.cancel():
                other.exception()
