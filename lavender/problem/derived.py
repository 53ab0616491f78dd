"""Values computed once per problem and shared between threads: `Derived`, `cached_property`, `once`."""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import RLock
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

if TYPE_CHECKING:
    from lavender.base.arrays import FloatArray
    from lavender_ext.core.problem import Data

T = TypeVar("T")


class Derived:
    """Hold what is computed from a problem's data; copies of a problem do not share it.

    Every entry is written whole and read once, so a thread that shares the problem sees a complete value or none; two
    threads that find none compute the same bits.
    """

    __slots__ = ("cache", "lock", "process", "start", "view")

    def __init__(self) -> None:
        self.lock, self.process = RLock(), _process  # held while a `once` is computed in this process
        self.view: Data | None = (
            None  # arrays that kernels read in generalised coordinates, set with the problem
        )
        self.start: FloatArray | None = None  # (m,) N s, the zero impulse clipped to the bounds
        self.cache: dict[
            str, Any
        ] = {}  # values of other modules; the key begins with the owner's module name


_process = object()  # another one in a fork's child, where no thread is left to give a lock back


def _forked() -> None:
    global _process
    _process = object()


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(after_in_child=_forked)


class cached_property(Generic[T]):
    """A property of an object, worked out at first use, then an attribute; two threads may do so, to the same bits.

    That of functools holds one lock for all objects before Python 3.12: threads wait for what others work out of
    other problems, and a process that is forked meanwhile waits for ever.
    """

    def __init__(self, function: Callable[[Any], T]) -> None:
        self.function = function
        self.__doc__ = function.__doc__
        self.name = function.__name__

    @overload
    def __get__(self, instance: None, owner: type) -> cached_property[T]: ...

    @overload
    def __get__(self, instance: object, owner: type) -> T: ...

    def __get__(self, instance: Any, owner: type) -> Any:
        return self if instance is None else self._worked_out(instance)

    def _worked_out(self, instance: Any) -> T:
        found: T = instance.__dict__.setdefault(self.name, self.function(instance))
        return found


class once(cached_property[T]):
    """The same of an object with `derived`, worked out by one thread while the others wait."""

    def _worked_out(self, instance: Any) -> T:
        kept, derived = instance.__dict__, instance.derived
        if derived.process is not _process:
            derived.lock, derived.process = RLock(), _process
        with derived.lock:
            if self.name not in kept:
                kept[self.name] = self.function(instance)
            found: T = kept[self.name]
            return found
