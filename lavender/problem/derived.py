"""Values computed once, also by several threads: `Derived`, `cached_property`, `computed_once`, `late_field`."""

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
    """Values that are computed from a problem's data and cached; copies of a problem do not share them.

    Every entry is set by one assignment of a complete value, so another thread reads a complete value or None. Two
    threads that read None compute identical bits.

    Attributes
    ----------
    view : Data or None
        Arrays that kernels read in generalised coordinates; set when the problem is created.
    start : (m,) or None, N s
        The zero impulse clipped to the bounds.
    cache : dict
        Values of other modules; each key begins with the name of its module. The key of the lock, which is held while
        a `computed_once` property is computed, is `_process`.
    """

    __slots__ = ("cache", "start", "view")

    def __init__(self, view: Data | None = None) -> None:
        self.view = view
        self.start: FloatArray | None = None
        self.cache: dict[Any, Any] = {}


# Identity of this process. A forked process gets a new object and then new locks, because threads that hold the old
# locks do not exist in it.
_process = object()


def _replace_process_after_fork() -> None:
    global _process
    _process = object()


if hasattr(os, "register_at_fork"):  # Windows has no fork.
    os.register_at_fork(after_in_child=_replace_process_after_fork)


class cached_property(Generic[T]):
    """A property that is computed at its first use and then stored as an attribute of the object.

    Two threads may compute it at the same time, with identical bits. `functools.cached_property` is not used: before
    Python 3.12 it holds one lock for all objects, so that threads wait for properties of other problems, and a process
    that is forked at that moment waits forever.
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
        if instance is None:
            return self
        return instance.__dict__.setdefault(self.name, self.function(instance))


class computed_once(cached_property[T]):
    """A `cached_property` of an object with `derived`, which one thread computes while others wait."""

    def __get__(self, instance: Any, owner: type) -> Any:
        """Compute the property under the lock of the object, unless another thread has done so."""
        if instance is None:
            return self
        attributes, cache = instance.__dict__, instance.derived.cache
        with cache.get(_process) or cache.setdefault(_process, RLock()):
            if self.name not in attributes:
                attributes[self.name] = self.function(instance)
            return attributes[self.name]


class late_field:
    """A field of a dataclass that is computed, if it was not set, when it is first read; set after the decoration.

    The attribute `_rest` of the object is a function and its arguments; the function returns the late fields by name.
    `_late_<name>` is a function and its arguments that compute one field without the others.
    """

    def __init__(self, name: str) -> None:
        self.name, self.own = name, f"_late_{name}"

    def __get__(self, instance: Any, owner: type) -> Any:
        """Compute this field, or all fields that were not set, and return this one."""
        if instance is None:
            return self
        attributes = instance.__dict__
        if (own := attributes.get(self.own)) is not None:
            return attributes.setdefault(self.name, own[0](*own[1]))
        rest = attributes.get("_rest")
        if rest is not None:
            function, arguments = rest
            for name, value in function(*arguments).items():
                attributes.setdefault(name, value)  # Another thread may have set an equal value.
            attributes.pop("_rest", None)
        if self.name not in attributes:
            raise AttributeError(f"{type(instance).__name__!r} object has no attribute {self.name!r}")
        return attributes[self.name]
