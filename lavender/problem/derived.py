"""What is worked out of a problem once: by one thread, while the others wait, and kept in one declared place."""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import RLock
from typing import TYPE_CHECKING, Any, Generic, TypeVar, overload

if TYPE_CHECKING:
    from lavender.base.arrays import FloatArray
    from lavender_ext.core.problem import Data
    from lavender_ext.judge.measure import Judged

T = TypeVar("T")


class Derived:
    """Numbers that a problem keeps beside its data; a field is None until it is first needed.

    Every field is written whole and read once, so threads that share a problem see a value or None; two that find
    None work out the same numbers, to the bit.
    """

    __slots__ = (
        "bodies",
        "factor",
        "judged",
        "lock",
        "motion",
        "process",
        "proof",
        "small",
        "spread",
        "start",
        "suspicions",
        "vain",
        "view",
    )

    def __init__(self) -> None:
        self.lock, self.process = RLock(), _process  # held while a `once` is worked out, in this process
        self.judged: Judged | None = None  # the judge's pass over a result that is about to be returned
        self.proof: Any = None  # the last certificate that was looked at, and what it proves
        self.view: Data | None = None  # in generalised coordinates: what kernels read, from the beginning
        self.spread: int | None = None  # how far apart blocks that share a body stand
        self.small: Any = None  # the compiled call of a problem of few rows, False where it has none
        self.factor: Any = None  # the factorisation that suits A: its name, half bandwidth, order
        # Whose one compiled call did not end, to what tol and from where, and what it did (`SmallCall.in_vain`).
        self.vain: tuple[tuple[str, float, bytes], tuple[int, ...]] | None = None
        self.start: FloatArray | None = None  # (m,) N s, doing nothing
        self.bodies: Any = None  # `bodies_of` of lavender.lab.suspicions, in a tuple
        self.suspicions: Any = None  # what its checks found of the problem alone
        self.motion: Any = None  # `Kept` of lavender.lab.motion: the reference of motion errors, its operator


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
